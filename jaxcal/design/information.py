"""The information of an image at a pose (its whitened Jacobian) and that of a calibration.

With q = X^-1 B^-1 c the target in the image of a probe at pose B, and X Exp([v, omega]), c + u
(mm, rad, mm), to first order

    dq = -v + [q]x omega + M u,    M = R_X' R_B',

and the image's errors are dq's lateral, axial (range) and elevational components divided by their
SDs: three rows, the 3x9 matrix G. Near the plane the range has the same derivative as the axial
position. Unknown pixel scales add two columns, for the logarithms of the lateral and axial scale.

Information adds up: after n images it is J = prior + sum_i G_i'G_i, and S = J^-1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import check_poses, targets_in_images
from jaxcal.design.noise import Noise, check_result, used_images
from jaxcal.diagnostics.image_errors import motion
from jaxcal.model.unknowns import RIGID, TABLE, block_slice, count_unknowns
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import array_tree, is_traced, outline, static
from jaxcal.runtime.given_values import check_flag, check_made, is_number, real_array

BELIEVED_SD = {"translation": 50.0, "rotation": 0.5, "point": 50.0, "scale": 0.3}
"""Prior SDs before any image (our choice): of X's translation (mm) and rotation (rad), of the
target (mm) and of a pixel scale's logarithm. This prior is weak: five images tell more."""

_EFFICIENCY = (0.2, 5.0)
_HALVINGS = 22
"""So often the interval of the factor's logarithm is halved, which gives it to 1e-6."""


@dataclass(frozen=True, eq=False)
class Known:
    """The information before a plan.

    Attributes:
        information: (p, p) about the unknowns, including the prior with which every plan begins.
        images: number of images from which it comes.
        tuned: whether the SDs were tuned to these images.
    """

    information: Float[np.ndarray, "p p"]
    images: int = 0
    tuned: bool = False

    __repr__ = outline


@array_tree
class Model:
    """Everything that the Jacobian of a pose depends on, except the pose (a tree of arrays).

    Attributes:
        image_to_probe: X as far as it is known, mm.
        point: the target in the tracker's frame, mm.
        noise: SDs.
        scale: whether the two pixel scales are unknown, too (static).
        face_offset_mm: range of pixel row 0, which pixel scales do not stretch.
    """

    image_to_probe: Float[Any, "4 4"] = field(default_factory=lambda: np.eye(4))
    point: Float[Any, " 3"] = field(default_factory=lambda: np.zeros(3))
    noise: Noise = field(default_factory=lambda: Noise.constant((0.5, 0.3, 1.0)))
    scale: bool = static(default=False)
    face_offset_mm: float = 0.0

    def __post_init__(self) -> None:
        for name, shape in (("image_to_probe", (4, 4)), ("point", (3,))):
            value = getattr(self, name)
            if np.shape(value) != shape:
                raise InputError(f"{name} of the model must be an array of shape {shape}")
            if not is_traced(value):
                value = real_array(value, f"{name} of the model")
                if not np.isfinite(value).all():
                    raise InputError(f"{name} of the model must be finite")
                object.__setattr__(self, name, value)
        if not is_traced(self.image_to_probe):
            check_poses(self.image_to_probe[None], what="image_to_probe of the model")
        check_made("noise", self.noise, Noise, "jaxcal.design.Noise")
        check_flag("scale of the model", self.scale)
        if not (is_traced(self.face_offset_mm) or is_number(self.face_offset_mm)):
            raise InputError(
                f"face_offset_mm of the model must be a number of mm, not {self.face_offset_mm!r}"
            )

    @property
    def size(self) -> int:
        """Number of unknowns p."""
        return count_unknowns(self.blocks)

    @property
    def blocks(self) -> tuple[str, ...]:
        """The unknowns by name, in order."""
        return (*RIGID, "scale") if self.scale else RIGID

    def targets(self, poses: Float[Any, "*n 4 4"]) -> Float[Any, "*n 3"]:
        """Where the target is in the images of a probe at these poses, mm (traceable)."""
        return targets_in_images(poses, self.image_to_probe, self.point)

    def jacobian(self, poses: Float[Any, "*n 4 4"]) -> Float[Any, "*n 3 p"]:
        """G of poses probe -> tracker (mm); numpy or JAX, traceable, differentiable in the pose."""
        xp = poses.__array_namespace__()
        q = self.targets(poses)
        turned = xp.swapaxes(poses[..., :3, :3] @ self.image_to_probe[:3, :3], -1, -2)
        rows = motion(q, turned, RIGID)
        if self.scale:
            zero = xp.zeros_like(q[..., 0])
            lateral = xp.stack([-q[..., 0], zero, zero], axis=-1)
            axial = xp.stack([zero, zero, self.face_offset_mm - q[..., 2]], axis=-1)
            rows = xp.concatenate([rows, xp.stack([lateral, axial], axis=-1)], axis=-1)
        return rows[..., [0, 2, 1], :] / self.noise.sigma(q)[..., None]

    def information(self, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "p p"]:
        """Sum of G'G over poses."""
        rows = self.jacobian(poses).reshape(-1, self.size)
        return rows.T @ rows

    def beliefs(self) -> Float[np.ndarray, "p p"]:
        """Information before any image (:data:`BELIEVED_SD`)."""
        sd = [BELIEVED_SD[name] for name in self.blocks for _ in TABLE[name].tangents]
        return np.diag(1.0 / np.square(sd))


def covariance_of(information: Float[np.ndarray, "*k p p"]) -> Float[np.ndarray, "*k p p"]:
    """Inverse of information, first scaled to a unit diagonal, since mm and rad differ in size."""
    size = 1.0 / np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    inverse = np.linalg.inv(information * size[..., :, None] * size[..., None, :])
    found = inverse * size[..., :, None] * size[..., None, :]
    return 0.5 * (found + np.swapaxes(found, -1, -2))


def known_information(
    result: Calibration, model: Model, poses: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "p p"]:
    """Information of a calibration about all unknowns, including its weak directions.

    It is the inverse of the calibration's covariance of these unknowns. If this covariance is not
    known (X is not observable), it is the information of the images' poses plus the prior with
    which every plan begins.

    Args:
        result: of one problem.
        model: with the calibration's X and target.
        poses: of the images, probe -> tracker, mm.
    """
    check_result(result)
    check_made("model", model, Model, "jaxcal.design.Model")
    poses = check_poses(poses)
    used = used_images(result, len(poses))
    covariance = _of_model(result, model)
    if covariance is None:
        return model.information(poses[used]) + model.beliefs()
    return covariance_of(covariance)


def _of_model(result: Calibration, model: Model) -> Float[np.ndarray, "p p"] | None:
    """The calibration's covariance of a model's unknowns; None where it is not known."""
    if not set(model.blocks) <= set(result.blocks):
        raise InputError(
            "the model's pixel scales are unknown, but the calibration did not estimate them: make "
            "the candidates with candidates_around(recording, result)"
        )
    rows = np.concatenate([np.r_[block_slice(result.blocks, name)] for name in model.blocks])
    covariance = np.asarray(result.numpy().unknowns_covariance, float)[rows[:, None], rows]
    if not np.isfinite(covariance).all():
        return None
    unit = np.sqrt(np.diagonal(covariance))
    if not (unit > 0).all() or np.linalg.eigvalsh(covariance / np.outer(unit, unit))[0] <= 0:
        return None
    return covariance


def effective_elevational(
    result: Calibration,
    model: Model,
    poses: Float[np.ndarray, "n 4 4"],
    weight: Float[np.ndarray, "p p"],
) -> float:
    """Factor on the elevational SD with which the images tell as much as the calibration says.

    If the offsets' law has edges, an offset tells more than its SD says; if their mean must be
    estimated, it tells less. The factor applies to further images of the same kind, too.
    """
    covariance = _of_model(result, model)
    used = used_images(result, len(poses))
    if covariance is None:
        return 1.0
    said = float(np.sum(weight * covariance))
    rows = model.jacobian(poses[used])

    def excess(log_factor: float) -> float:
        scaled = rows / np.array([1.0, 1.0, np.exp(log_factor)])[:, None]
        flat = scaled.reshape(-1, model.size)
        told = float(np.sum(weight * covariance_of(flat.T @ flat + model.beliefs())))
        return float(np.log(told / said))

    low, high = np.log(_EFFICIENCY)
    if not said > 0:
        return 1.0
    if not excess(low) < 0 < excess(high):
        return _EFFICIENCY[0] if excess(low) >= 0 else _EFFICIENCY[1]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return float(np.exp(0.5 * (low + high)))
