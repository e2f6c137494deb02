"""The fit with Gaussian offsets and tuned SDs, beside answers whose offsets have sharp limits.

Offsets that are free within a bound absorb errors that the model leaves out, and hide a wrong
bound. If the bound is larger than the offsets, all answers in an interval fit equally well; if
offsets exceed it, the answer is biased. It is also biased if offsets without sharp limits are taken
to be uniform.

If offsets are uniform and taken to be so, the fit with Gaussian offsets is right as well, only less
precise, and the answer differs from it by hardly more than the error of that fit (Hausman 1978).
With the prior ``bounded`` that does not hold: even within the right bound the answer is often less
accurate than that fit, and differs from it by more (``experiments/sharp_limits.py``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxcal.diagnostics.image_errors import ImageErrors, Whitened, quadratic
from jaxcal.diagnostics.intervals import image_jacobian
from jaxcal.model.image_points import mean_of_squares
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import batch_of_one
from jaxcal.solvers.plan import TUNED

Array = np.ndarray

_ROUNDS = 8
"""Rounds of tuning the SDs."""
_STEPS = 4
"""Gauss-Newton steps from the answer."""


@dataclass(frozen=True)
class GaussianOffsets:
    """The fit of one problem.

    Attributes:
        seen: the errors at it.
        rows: their derivatives, :func:`shortened`, in SDs of the answer where it has SDs.
        variance: mean squared errors of each kind, in the square of the same unit.
        step: from the answer, in the order of the unknowns.
    """

    seen: ImageErrors
    rows: Float[Array, "m 3 p"]
    variance: Float[Array, " 3"]
    step: Float[Array, " p"]

    @classmethod
    def of(cls, answer: Calibration) -> GaussianOffsets:
        """The fit to the images of an answer (leading axis of length 1)."""
        used = np.asarray(answer.mask)[0] > 0
        images = int(used.sum())
        seen = ImageErrors.of_answer(answer).centred(answer)
        rows, variance, whole = seen.rows[0], np.ones(3), np.zeros(seen.rows.shape[-1])
        for _ in range(_STEPS):
            scaled = in_sds(answer, seen)
            errors, rows = shortened(scaled.errors[0][used], scaled.rows[0][used])
            variance, step = tuned(errors, rows, images)
            unknowns = seen.unknowns.moved(step[None], seen.blocks)
            seen = ImageErrors.of(unknowns, seen.problem, seen.blocks).centred(answer)
            whole = whole + step
        return cls(seen, rows, variance, whole)


def away_from_gaussian(
    answer: Calibration, grid: Float[Array, "m 2"]
) -> tuple[float, float] | None:
    """How far an answer with sharp limits is from that with Gaussian offsets, in the image, mm.

    Args:
        answer: of one problem, on numpy arrays.
        grid: points of the image, [lateral, axial], mm.

    Returns:
        The distance, and the error of the fit with Gaussian offsets by its own covariance, both
        root mean squares over the points; None for other answers, and with fewer
        images than SDs are tuned for.
    """
    images = int(np.sum(np.asarray(answer.mask) > 0))
    limited = answer.prior in ("bounded", "uniform") and answer.data == "points"
    if answer.problem is None or not limited or images < MINIMUM_SELF_TUNING:
        return None
    fit = GaussianOffsets.of(batch_of_one(answer))
    variance = fit.variance / (1 - leverage(fit.rows, fit.variance) / images)
    information = np.einsum("mkp,mkq->pq", fit.rows / variance[:, None], fit.rows)
    weight = mean_of_squares(image_jacobian(answer, grid))
    error = np.trace(weight @ np.linalg.pinv(information, hermitian=True))
    apart = quadratic(fit.step[None, None], weight[None])[0, 0]
    return float(np.sqrt(apart)), float(np.sqrt(error))


def in_sds(answer: Calibration, seen: ImageErrors) -> Whitened | ImageErrors:
    """Errors and rows in SDs; in mm for answers without SDs, which are tuned anyway."""
    return Whitened.of(answer, seen) if answer.prior in TUNED else seen


def shortened(
    errors: Float[Array, "n 3"], rows: Float[Array, "n 3 q"]
) -> tuple[Float[Array, "m 3"], Float[Array, "m 3 q"]]:
    """At most q + 1 errors of each kind and their rows, for the same fits as all n of them.

    The triangle of each kind's rows and errors has the same sums of squares.
    """
    both = np.concatenate([rows, errors[..., None]], axis=-1)
    triangle = np.asarray(np.linalg.qr(np.swapaxes(both, 0, 1), mode="r"))
    return triangle[..., -1].T, np.swapaxes(triangle[..., :-1], 0, 1)


def tuned(
    errors: Float[Array, "m kinds"], rows: Float[Array, "m kinds q"], images: int
) -> tuple[Float[Array, " kinds"], Float[Array, " q"]]:
    """Mean squared errors of each kind after the fit with tuned SDs, and the step."""
    scale = 1 / np.sqrt(np.maximum(np.sum(rows**2, axis=(0, 1)), 1e-300))
    variance = np.ones(errors.shape[1])
    step = np.zeros(rows.shape[-1])
    for _ in range(_ROUNDS):
        weight = 1 / np.sqrt(variance)[:, None]
        design = (rows * scale * weight).reshape(-1, rows.shape[-1])
        step = -scale * np.linalg.lstsq(design, (errors * weight[:, 0]).ravel(), rcond=1e-12)[0]
        left = errors + rows @ step
        variance = np.maximum(np.sum(left**2, axis=0) / images, 1e-12)
    return variance, step


def leverage(
    rows: Float[Array, "m kinds q"], variance: Float[Array, " kinds"]
) -> Float[Array, " kinds"]:
    """How many degrees of freedom of each kind of errors a fit with these variances takes.

    The sum of the kind's diagonal elements of the projection (hat) matrix of the weighted fit.
    """
    scale = np.sqrt(np.maximum(np.sum(rows**2, axis=(0, 1)), 1e-300))
    weighted = rows / scale / np.sqrt(variance)[:, None]
    basis = np.linalg.qr(weighted.reshape(-1, rows.shape[-1]))[0]
    return np.sum(basis.reshape(rows.shape) ** 2, axis=(0, 2))
