"""Every image's errors at an answer, and their derivatives by the unknowns.

With q = X^-1 B^-1 c the target in an image's frame (:mod:`jaxcal.model.residuals`), a step of the
unknowns X Exp([v, w]), c + d, and of the logarithms of scales and sound speed moves

    q                by  -v + [q]x w + M d,   M = R' B_R',
    lateral x        by  x ds_lateral,
    range r          by  s (u_axial ds_axial + (u_axial + face - delay) ds - ddelay),

with u_axial the scaled axial pixel coordinate, s the factor on the sound speed and delay in mm. The
three errors of an image are q_x - x, |(q_y, q_z)| - r and the offset q_y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jaxcal.data.sound import WATER_M_S
from jaxcal.model.blocks import block_slice, size
from jaxcal.runtime.array_types import Float

if TYPE_CHECKING:
    from jaxcal.calibration.result import Calibration
    from jaxcal.data.problem import Problem
    from jaxcal.model.blocks import Blocks

Array = np.ndarray


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of a batch (one leading axis, k).

    Attributes:
        rotation: of X.
        translation: of X, mm.
        point: the target in the tracker's frame, mm.
        scale: factors on the problem's [lateral, axial] spacing.
        sound_speed: factor on the nominal one.
        delay: mm at the nominal sound speed.
    """

    rotation: Float[Array, "k 3 3"]
    translation: Float[Array, "k 3"]
    point: Float[Array, "k 3"]
    scale: Float[Array, "k 2"]
    sound_speed: Float[Array, " k"]
    delay: Float[Array, " k"]

    @classmethod
    def of(cls, answer: Calibration, problem: Problem) -> Unknowns:
        """Of calibrations with one leading axis."""
        x = np.asarray(answer.image_to_probe)
        scale, speed, delay = np.ones((len(x), 2)), np.ones(len(x)), np.zeros(len(x))
        nominal = np.full(len(x), WATER_M_S)
        if problem.sound_speed is not None:
            nominal = np.asarray(problem.sound_speed)
        if answer.scale_mm_per_px is not None:
            scale = np.asarray(answer.scale_mm_per_px) / np.asarray(problem.spacing)
        if answer.sound_speed_m_s is not None:
            speed = np.asarray(answer.sound_speed_m_s) / nominal
        if answer.delay_s is not None:
            before = 0.0 if problem.delay is None else np.asarray(problem.delay)
            delay = (np.asarray(answer.delay_s) - before) * 1e3 * nominal
        return cls(x[:, :3, :3], x[:, :3, 3], np.asarray(answer.point), scale, speed, delay)


@dataclass(frozen=True)
class ImageErrors:
    """Errors of every image of a batch (one leading axis, k).

    Attributes:
        q: target in the image frame, mm; (0, 0, 1) where left out.
        turned: M, by which the target's motion enters.
        lateral: measured lateral position, mm.
        distance: measured range, mm.
        errors: lateral, range and elevational, mm; 0 where left out.
        rows: derivatives of ``errors`` by the unknowns (order of ``blocks``); 0 where left out.
        mask: 1 for images that count.
    """

    q: Float[Array, "k n 3"]
    turned: Float[Array, "k n 3 3"]
    lateral: Float[Array, "k n"]
    distance: Float[Array, "k n"]
    errors: Float[Array, "k n 3"]
    rows: Float[Array, "k n 3 p"]
    mask: Float[Array, "k n"]

    @classmethod
    def of(
        cls,
        unknowns: Unknowns,
        problem: Problem,
        blocks: Blocks,
        shift: Float[Array, "k n"] | float = 0.0,
    ) -> ImageErrors:
        """At some unknowns.

        Args:
            unknowns: where.
            problem: with one leading axis.
            blocks: the free unknowns.
            shift: by which the target's elevation differs from q_y (tracker noise), mm.
        """
        mask = np.asarray(problem.mask, float)
        used = mask > 0
        poses = np.where(used[..., None, None], problem.poses, np.eye(4))
        measured = np.where(used[..., None], problem.measurements, 1.0)
        away = unknowns.point[:, None] - poses[..., :3, 3]
        turned = np.swapaxes(poses[..., :3, :3] @ unknowns.rotation[:, None], -1, -2)
        home = np.einsum("kji,kj->ki", unknowns.rotation, unknowns.translation)
        q = (turned @ away[..., None])[..., 0] - home[:, None]
        q = np.where(used[..., None], q, [0.0, 0.0, 1.0])

        unit = problem.spacing * unknowns.scale
        speed, delay = unknowns.sound_speed[:, None], unknowns.delay[:, None]
        lateral, axial = np.moveaxis(measured * unit[:, None], -1, 0)
        distance = (axial + np.asarray(problem.face_offset)[:, None] - delay) * speed
        elevation = q[..., 1] + shift
        far = np.hypot(elevation, q[..., 2])
        errors = np.stack([q[..., 0] - lateral, far - distance, elevation], axis=-1)

        along = motion(q, turned, blocks)
        rows = np.empty_like(along)
        rows[..., 0, :], rows[..., 2, :] = along[..., 0, :], along[..., 1, :]
        rows[..., 1, :] = (elevation / far)[..., None] * along[..., 1, :]
        rows[..., 1, :] += (q[..., 2] / far)[..., None] * along[..., 2, :]
        if "scale" in blocks:
            at = block_slice(blocks, "scale").start
            rows[..., 0, at] = -lateral
            rows[..., 1, at + 1] = -axial * speed
        if "sound-speed" in blocks:
            rows[..., 1, block_slice(blocks, "sound-speed").start] = -distance
        if "delay" in blocks:
            rows[..., 1, block_slice(blocks, "delay").start] = speed
        rows *= mask[..., None, None]
        return cls(q, turned, lateral, distance, mask[..., None] * errors, rows, mask)

    def lever(self, mask: Float[Array, "k n"]) -> Float[Array, " k"]:
        """Root mean square distance of the measured points from the image origin, mm."""
        squares = np.where(mask > 0, self.lateral**2 + self.distance**2, 0.0)
        return np.sqrt(squares.sum(axis=1) / mask.sum(axis=1))

    def from_circle(
        self, elevation: Float[Array, "k n"]
    ) -> tuple[Float[Array, "k n 3"], Float[Array, "k n"]]:
        """Q - p(y) of Eq. 5, mm (0 where left out), and p's axial coordinate."""
        axial = np.sqrt(np.maximum(self.distance**2 - elevation**2, (1e-6 * self.distance) ** 2))
        residual = self.q - np.stack([self.lateral, elevation, axial], axis=-1)
        return self.mask[..., None] * residual, axial

    def circle_rows(
        self, elevation: Float[Array, "k n"], axial: Float[Array, "k n"], blocks: Blocks
    ) -> Float[Array, "k n 3 p"]:
        """Derivatives of :meth:`from_circle` by the unknowns, the elevation held."""
        rows = motion(self.q, self.turned, blocks) * self.mask[..., None, None]
        further = size(("translation", "rotation", "point"))
        # The measured point moves by the unknowns between a measurement and mm.
        rows[..., 0, further:] = self.rows[..., 0, further:]
        stretch = self.distance / axial
        rows[..., 2, further:] = stretch[..., None] * self.rows[..., 1, further:]
        return rows


def motion(
    q: Float[Array, "k n 3"], turned: Float[Array, "k n 3 3"], blocks: Blocks
) -> Float[Array, "k n 3 p"]:
    """Derivatives of q by the unknowns; blocks begin with X and the target."""
    x, y, z = np.moveaxis(q, -1, 0)
    along = np.zeros((*q.shape, size(blocks)))
    along[..., [0, 1, 2], [0, 1, 2]] = -1.0
    along[..., 0, 4], along[..., 0, 5] = -z, y
    along[..., 1, 3], along[..., 1, 5] = z, -x
    along[..., 2, 3], along[..., 2, 4] = -y, x
    along[..., 6:9] = turned
    return along


def channel_rows(
    seen: ImageErrors, unknowns: Unknowns, problem: Problem, blocks: Blocks
) -> Float[Array, "k m p"]:
    """Derivatives of every element's distance error |q - e| / s + delay, mm; m = n elements."""
    channels = problem.channels
    assert channels is not None
    elements = np.asarray(channels.elements)
    apart = seen.q[:, :, None] - elements[:, None]
    far = np.linalg.norm(apart, axis=-1)
    speed = unknowns.sound_speed[:, None, None]
    rows = (apart / (far * speed)[..., None]) @ motion(seen.q, seen.turned, blocks)
    if "sound-speed" in blocks:
        rows[..., block_slice(blocks, "sound-speed").start] = -far / speed
    if "delay" in blocks:
        rows[..., block_slice(blocks, "delay").start] = 1.0
    weight = seen.mask[..., None] * np.nan_to_num(np.asarray(channels.heard))
    rows = np.where(weight[..., None] > 0, rows, 0.0) * weight[..., None]
    return rows.reshape(len(rows), -1, rows.shape[-1])
