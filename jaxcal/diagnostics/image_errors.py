"""Every image's errors at an answer, and their derivatives by the unknowns.

With q = X^-1 B^-1 c the target in an image's frame (:mod:`jaxcal.model.residuals`), a step of the
unknowns X Exp([v, w]), c + d moves

    q    by  -v + [q]x w + M d,    M = R' B_R',

and further unknowns move the measured lateral position x and range r
(:func:`jaxcal.model.unknowns.measured`). The three errors of an image are q_x - x, |(q_y, q_z)| - r
and the offset q_y. :class:`Whitened` has them in SDs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxcal.data.poses import rotations_from_vectors
from jaxcal.data.problem import Problem
from jaxcal.model import unknowns as model
from jaxcal.model.arc import axial_on_circle
from jaxcal.model.unknowns import (
    RIGID_UNKNOWNS,
    TINY,
    Blocks,
    block_slice,
    count_unknowns,
    further_derivatives,
    split_further,
    step_between,
    stepped,
    with_prior,
)
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.runtime.arrays import array_module, batch_of_one
from jaxcal.solvers.closed_form.single import ClosedForm
from jaxcal.solvers.plan import TUNED

Array = np.ndarray

KINDS = ("lateral", "range", "elevational")
"""Kinds of errors."""


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of a batch (one leading axis, k).

    Attributes:
        rotation: of X.
        translation: of X, mm.
        point: the target in the tracker's frame, mm.
        further: the free ones of the further unknowns, by name, with an array (k,) for each
            component: factors on the problem's spacing and sound speed, and the delay in mm at the
            nominal sound speed.
    """

    rotation: Float[Array, "k 3 3"]
    translation: Float[Array, "k 3"]
    point: Float[Array, "k 3"]
    further: Mapping[str, Sequence[Float[Array, " k"]]] = field(default_factory=dict)

    @classmethod
    def of(cls, answer: Calibration) -> Unknowns:
        """The unknowns of calibrations with one leading axis."""
        x = np.asarray(answer.image_to_probe)
        further = split_further(answer.linearisation.further, answer.blocks)
        return cls(x[:, :3, :3], x[:, :3, 3], np.asarray(answer.point), further)

    @classmethod
    def of_closed_form(cls, found: ClosedForm, problem: Problem) -> Unknowns:
        """The unknowns of a closed form of one problem, with a leading axis of length 1."""
        further = {"sound-speed": [np.array([found.sound_speed_factor])]}
        if found.scale_mm_per_px is not None:
            factors = np.asarray(found.scale_mm_per_px) / np.asarray(problem.spacing)
            further["scale"] = list(factors[:, None])
        x = np.asarray(found.image_to_probe)[None]
        return cls(x[:, :3, :3], x[:, :3, 3], np.asarray(found.point)[None], further)

    def moved(self, step: Float[Array, "k p"], blocks: Blocks) -> Unknowns:
        """The unknowns after a step, in the order of ``blocks``."""
        turn = rotations_from_vectors(step[:, 3:6])
        along = (self.rotation @ step[:, :3, None])[..., 0]
        further = {
            name: [
                stepped(name, value, by, np.exp)
                for value, by in zip(values, step[:, block_slice(blocks, name)].T, strict=True)
            ]
            for name, values in self.further.items()
        }
        point = self.point + step[:, 6:RIGID_UNKNOWNS]
        return Unknowns(self.rotation @ turn, self.translation + along, point, further)

    def along(self, axes: int) -> dict[str, list[Array]]:
        """Further unknowns with ``axes`` axes of length 1 after the leading one."""
        behind = (...,) + (None,) * axes
        return {name: [part[behind] for part in parts] for name, parts in self.further.items()}


@dataclass(frozen=True)
class ImageErrors:
    """Errors of every image of a batch (one leading axis, k).

    Attributes:
        q: target in the image frame, mm; (0, 0, 1) where left out.
        tracker_to_image: M, the rotation to the image's frame: the derivative of q by the target.
        lateral: measured lateral position, mm.
        distance: measured range, mm.
        errors: lateral, range and elevational, mm; 0 where left out.
        rows: derivatives of ``errors`` by the unknowns (order of ``blocks``); 0 where left out.
        mask: 1 for images that count.
        unknowns: at which the errors are.
        problem: whose images they are.
        blocks: the free unknowns.
    """

    q: Float[Array, "k n 3"]
    tracker_to_image: Float[Array, "k n 3 3"]
    lateral: Float[Array, "k n"]
    distance: Float[Array, "k n"]
    errors: Float[Array, "k n 3"]
    rows: Float[Array, "k n 3 p"]
    mask: Float[Array, "k n"]
    unknowns: Unknowns
    problem: Problem
    blocks: Blocks

    @classmethod
    def of_answer(cls, answer: Calibration) -> ImageErrors:
        """The errors of calibrations with one leading axis, which hold their problem."""
        assert answer.problem is not None
        return cls.of(Unknowns.of(answer), answer.problem, answer.blocks)

    @classmethod
    def of_closed_form(cls, found: ClosedForm, problem: Problem, blocks: Blocks) -> ImageErrors:
        """The errors of a closed form of one problem, with a leading axis of length 1."""
        return cls.of(Unknowns.of_closed_form(found, problem), batch_of_one(problem), blocks)

    @classmethod
    def of(
        cls,
        unknowns: Unknowns,
        problem: Problem,
        blocks: Blocks,
        shift: Float[Array, "k n"] | float = 0.0,
    ) -> ImageErrors:
        """The errors at given unknowns.

        Args:
            unknowns: X, target and further unknowns.
            problem: with one leading axis.
            blocks: the free unknowns.
            shift: by which the target's elevation differs from q_y (tracker noise), mm.
        """
        mask = np.asarray(problem.mask, float)
        used = mask > 0
        poses = np.where(used[..., None, None], problem.poses, np.eye(4))
        measured = np.where(used[..., None], problem.measurements, 1.0)
        away = unknowns.point[:, None] - poses[..., :3, 3]
        tracker_to_image = np.swapaxes(poses[..., :3, :3] @ unknowns.rotation[:, None], -1, -2)
        home = np.einsum("kji,kj->ki", unknowns.rotation, unknowns.translation)
        q = (tracker_to_image @ away[..., None])[..., 0] - home[:, None]
        q = np.where(used[..., None], q, [0.0, 0.0, 1.0])

        across, deep = np.moveaxis(measured * np.asarray(problem.spacing)[:, None], -1, 0)
        face = np.asarray(problem.face_offset)[:, None]
        further = unknowns.along(1)
        lateral, distance = model.measured(across, deep, face, further)
        elevation = q[..., 1] + shift
        far = np.hypot(elevation, q[..., 2])
        errors = np.stack([q[..., 0] - lateral, far - distance, elevation], axis=-1)

        along = motion(q, tracker_to_image, blocks)
        rows = np.empty_like(along)
        rows[..., 0, :], rows[..., 2, :] = along[..., 0, :], along[..., 1, :]
        rows[..., 1, :] = (elevation / far)[..., None] * along[..., 1, :]
        rows[..., 1, :] += (q[..., 2] / far)[..., None] * along[..., 2, :]
        for column, moved in further_derivatives(
            lambda values: model.measured(across, deep, face, values), further, blocks
        ):
            rows[..., 0, column], rows[..., 1, column] = -moved[0], -moved[1]
        rows *= mask[..., None, None]
        errors = mask[..., None] * errors
        return cls(
            q, tracker_to_image, lateral, distance, errors, rows, mask, unknowns, problem, blocks
        )

    def shifted(self, answer: Calibration) -> ImageErrors:
        """These errors with the target moved by the estimated error of the tracker, if any."""
        if answer.linearisation.tracker_sd is None:
            return self
        shift = np.where(answer.mask > 0, answer.elevation - self.q[..., 1], 0.0)
        return ImageErrors.of(self.unknowns, self.problem, self.blocks, shift)

    def centred(self, answer: Calibration) -> ImageErrors:
        """These errors of one calibration, the offsets about the mean that it found for them."""
        if answer.offset_law is None:
            return self
        mean = float(np.asarray(answer.offset_law.mean)[0])
        return replace(self, errors=self.errors - mean * self.mask[..., None] * [0.0, 0.0, 1.0])

    def in_plane(self, unknowns: slice | tuple[int, ...]) -> Float[Array, "n 3 _"]:
        """Derivatives of one calibration's errors by some unknowns, 0 for elevational errors."""
        return self.rows[0][..., unknowns] * [[1.0], [1.0], [0.0]]

    def lever(self, mask: Float[Array, "k n"]) -> Float[Array, " k"]:
        """Root mean square distance of the measured points from the image origin, mm."""
        squares = np.where(mask > 0, self.lateral**2 + self.distance**2, 0.0)
        return np.sqrt(squares.sum(axis=1) / mask.sum(axis=1))

    def from_circle(
        self, elevation: Float[Array, "k n"]
    ) -> tuple[Float[Array, "k n 3"], Float[Array, "k n"]]:
        """The residual q - p(y) of Eq. 5, mm (0 where left out), and p's axial coordinate."""
        axial = axial_on_circle(self.distance, elevation)
        residual = self.q - np.stack([self.lateral, elevation, axial], axis=-1)
        return self.mask[..., None] * residual, axial

    def circle_rows(self, axial: Float[Array, "k n"]) -> Float[Array, "k n 3 p"]:
        """Derivatives of :meth:`from_circle` by the unknowns, the elevation held."""
        rows = np.asarray(motion(self.q, self.tracker_to_image, self.blocks))
        rows = rows * self.mask[..., None, None]
        further = RIGID_UNKNOWNS
        # Further unknowns move the measured point instead of q.
        rows[..., 0, further:] = self.rows[..., 0, further:]
        stretch = self.distance / axial
        rows[..., 2, further:] = stretch[..., None] * self.rows[..., 1, further:]
        return rows

    def channel_errors(self) -> Float[Array, "k n elements"]:
        """Every element's distance error, prediction less measurement, mm; 0 if not heard."""
        channels = self.problem.channels
        assert channels is not None
        far = np.linalg.norm(self.q[:, :, None] - np.asarray(channels.elements)[:, None], axis=-1)
        predicted = model.predicted_distance(far, self.unknowns.along(2))
        weight = self.mask[..., None] * np.nan_to_num(np.asarray(channels.heard))
        measured = np.nan_to_num(np.asarray(channels.distances))
        return np.where(weight > 0, predicted - measured, 0.0)

    def channel_rows(self) -> Float[Array, "k m p"]:
        """Derivatives of every element's distance error, mm; m is n times the number of elements.

        The model of a measured distance is |q - e| / s + delay.
        """
        channels = self.problem.channels
        assert channels is not None
        apart = self.q[:, :, None] - np.asarray(channels.elements)[:, None]
        far = np.linalg.norm(apart, axis=-1)
        further = self.unknowns.along(2)
        # The derivative by the distance is a complex step, too.
        gain = np.imag(model.predicted_distance(far + 1j * TINY, further)) / TINY
        rows = (gain / far)[..., None] * (
            apart @ motion(self.q, self.tracker_to_image, self.blocks)
        )
        for column, (change,) in further_derivatives(
            lambda values: [model.predicted_distance(far, values)], further, self.blocks
        ):
            rows[..., column] = change
        weight = self.mask[..., None] * np.nan_to_num(np.asarray(channels.heard))
        rows = np.where(weight[..., None] > 0, rows, 0.0) * weight[..., None]
        return flattened(rows)


@dataclass(frozen=True)
class Whitened:
    """Errors under a Gaussian prior, in SDs, decorrelated where images have their own covariances.

    Attributes:
        errors: of lateral position, range and offset.
        rows: their derivatives by the shared unknowns.
        offset_rows: their derivatives by the image's own offset unknown, or None where there is no
            such unknown (it belongs to a given tracker SD).
        offset_precision: D of that unknown; 1 if there is none.
        offset_response: E / D, by which that unknown follows the shared ones; zeros if there is
            none.
        log_sd: sum of the logarithms of an image's SDs, mm.
    """

    errors: Float[Array, "k n 3"]
    rows: Float[Array, "k n 3 p"]
    offset_rows: Float[Array, "k n 3"] | None
    offset_precision: Float[Array, "k n"]
    offset_response: Float[Array, "k n p"]
    log_sd: Float[Array, "k n"]

    @classmethod
    def of(cls, answer: Calibration, seen: ImageErrors) -> Whitened:
        """The errors of calibrations on points with Gaussian errors."""
        sigma, tau = np.asarray(answer.sigma), answer.linearisation.tracker_sd
        offset, shape = None, own_covariance(answer, seen.problem)
        if tau is not None:
            sigma = np.hypot(sigma, tau[:, None] * [1.0, 1.0, 0.0])
            far = np.hypot(seen.errors[..., 2], seen.q[..., 2])
            one = np.ones_like(far)
            offset = np.stack([0 * one, seen.errors[..., 2] / far, one], axis=-1)
            offset = tau[:, None, None] * seen.mask[..., None] * offset
        parts: list[Any] = [seen.errors[..., None], seen.rows]
        parts += [] if offset is None else [offset[..., None]]
        parts = [_decorrelated(np.asarray(p / sigma[:, None, :, None]), shape) for p in parts]
        errors, rows = parts[0][..., 0], parts[1]
        weight, response = np.ones(seen.mask.shape), np.zeros_like(rows[..., 0, :])
        if offset is not None:
            offset = parts[2][..., 0]
            weight = np.sum(offset**2, axis=-1) + 1
            response = np.einsum("knm,knmp->knp", offset, rows) / weight[..., None]
        log_sd = np.zeros(seen.mask.shape) + np.sum(np.log(sigma), axis=-1, keepdims=True)
        if shape is not None:
            log_sd = log_sd + 0.5 * np.log(np.linalg.det(shape))
        return cls(errors, rows, offset, weight, response, log_sd)

    def information(
        self, kept: Float[Array, "k n"], precision: Float[Array, "k p"]
    ) -> Float[Array, "k p p"]:
        """Of images with independent errors, with the precisions of the unknowns' priors."""
        rows = flattened(self.rows * kept[..., None, None])
        weighed = self.offset_response * (kept * self.offset_precision)[..., None]
        taken = np.swapaxes(weighed, 1, 2) @ self.offset_response
        return np.swapaxes(rows, 1, 2) @ rows - taken + precision[:, None] * np.eye(rows.shape[-1])

    def leverage(self, inverse: Float[Array, "k p p"]) -> Float[Array, "k n 3"]:
        """The share of each error's variance that the fit absorbs."""
        rows, own = self.rows, 0.0
        if self.offset_rows is not None:
            rows = rows - self.offset_rows[..., None] * self.offset_response[:, :, None]
            own = self.offset_rows**2 / self.offset_precision[..., None]
        return quadratic(flattened(rows), inverse).reshape(rows.shape[:-1]) + own


def error_sd(answer: Calibration) -> Float[AnyArray, "*batch 3"]:
    """SDs of the images' lateral, range and elevational errors, those of the tracker included."""
    tracker = answer.linearisation.tracker_sd
    if tracker is None:
        return answer.sigma
    return array_module(answer.sigma).hypot(answer.sigma, tracker[..., None])


def further_prior(answer: Calibration) -> tuple[Float[Array, "k p"], Float[Array, "k p"]]:
    """Precisions of the priors on further unknowns, and how far the answer is from nominal.

    The answer has one leading axis. Both are in the order of its unknowns, in the units of their
    steps; 0 for those without a prior.
    """
    precision, away = np.zeros((2, len(answer.mask), count_unknowns(answer.blocks)))
    prior_sd = answer.linearisation.prior_sd
    if prior_sd is None:
        return precision, away
    further = Unknowns.of(answer).further
    for name, sd in zip(with_prior(answer.blocks), np.asarray(prior_sd).T, strict=True):
        nominal = model.TABLE[name].nominal
        at = block_slice(answer.blocks, name)
        precision[:, at] = sd[:, None] ** -2.0
        away[:, at] = np.stack(
            [step_between(name, nominal, value, np.log) for value in further[name]], axis=1
        )
    return precision, away


def noise_covariance(answer: Calibration, problem: Problem) -> Float[AnyArray, "*batch n 3 3"]:
    """Covariance of every image's lateral, range and elevational errors, mm^2.

    It is that of the noise model that the answer was estimated with, the tracker's errors included.
    Images that the answer left out have theirs as well.
    """
    xp = array_module(answer.sigma, answer.mask, problem.covariance)
    own = None
    if answer.prior in TUNED and answer.data == "points":
        own = own_covariance(answer, problem)
    shape = xp.broadcast_to(xp.eye(3), (*np.shape(answer.mask), 3, 3))
    if own is not None:
        shape = xp.pad(own, [(0, 0)] * (own.ndim - 2) + [(0, 1)] * 2)
        shape = shape + xp.diag(xp.asarray([0.0, 0.0, 1.0]))
    sd = error_sd(answer)[..., None, :]
    return shape * sd[..., :, None] * sd[..., None, :]


def own_covariance(answer: Calibration, problem: Problem) -> Float[AnyArray, "*batch n 2 2"] | None:
    """The images' own covariances in units of the common SDs, if these whiten errors; else None.

    A tracker's variance is part of both.
    """
    given = problem.covariance
    if given is None:
        return None
    xp = array_module(answer.sigma, answer.mask, given)
    seen, kept = (xp.asarray(mask)[..., None] > 0 for mask in (problem.mask, answer.mask))
    covariance = xp.where(seen[..., None], given, xp.eye(2))
    variances = xp.where(kept, xp.diagonal(covariance, axis1=-2, axis2=-1), 0.0)
    mean = variances.sum(axis=-2) / kept.sum(axis=-2)
    shaped = (mean > 0).all(axis=-1)
    if answer.offset_law is not None:
        shaped = shaped & (xp.asarray(answer.offset_law.own_probability) > 0.5)
    scale = 1 / xp.sqrt(xp.where(mean > 0, mean, 1.0))
    shape = covariance * (scale[..., :, None] * scale[..., None, :])[..., None, :, :]
    shape = xp.where(shaped[..., None, None, None], shape, xp.eye(2))
    tau = answer.linearisation.tracker_sd
    if tau is None:
        return shape
    # The tracker adds the same variance to the errors of all images.
    sigma = xp.asarray(answer.sigma)[..., :2]
    own = sigma / xp.hypot(sigma, xp.asarray(tau)[..., None])
    shape = shape * (own[..., :, None] * own[..., None, :])[..., None, :, :]
    return shape + (1 - own**2)[..., None, :, None] * xp.eye(2)


def _decorrelated(
    values: Float[Array, "k n 3 c"], shape: Float[AnyArray, "k n 2 2"] | None
) -> Float[Array, "k n 3 c"]:
    """Rows multiplied by the inverse Cholesky factor of every image's 2x2 covariance."""
    if shape is None:
        return values
    first = np.sqrt(shape[..., 0, 0])[..., None]
    mixed = np.asarray(shape[..., 1, 0])[..., None] / first
    second = np.sqrt(shape[..., 1, 1][..., None] - mixed**2)
    lateral = values[..., 0, :] / first
    distance = (values[..., 1, :] - mixed * lateral) / second
    return np.stack([lateral, distance, values[..., 2, :]], axis=-2)


def flattened(rows: Float[Array, "k n m p"]) -> Float[Array, "k nm p"]:
    """Rows of all images one after the other; also for no problems, where -1 is ambiguous."""
    return rows.reshape(len(rows), rows.shape[1] * rows.shape[2], rows.shape[3])


def quadratic(rows: Float[Array, "k m p"], matrix: Float[Array, "k p p"]) -> Float[Array, "k m"]:
    """The quadratic form r' C r of every row r, with C the matrix."""
    return np.einsum("kmp,kmp->km", rows @ matrix, rows)


def motion(
    q: Float[AnyArray, "*n 3"], tracker_to_image: Float[AnyArray, "*n 3 3"], blocks: Blocks
) -> Float[AnyArray, "*n 3 p"]:
    """Derivatives of q by the unknowns (traceable); blocks begin with X and the target."""
    xp = array_module(q)
    x, y, z = q[..., 0], q[..., 1], q[..., 2]
    zero, one = xp.zeros_like(x), xp.ones_like(x)
    rows = [
        [-one, zero, zero, zero, -z, y],
        [zero, -one, zero, z, zero, -x],
        [zero, zero, -one, -y, x, zero],
    ]
    along = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    further = xp.zeros((*q.shape, count_unknowns(blocks) - RIGID_UNKNOWNS), q.dtype)
    return xp.concatenate([along, tracker_to_image, further], axis=-1)
