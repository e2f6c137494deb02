"""The fit with Gaussian offsets and tuned SDs of the images of an answer within bounds.

Offsets that are free within a bound hide errors: those that the model leaves out, and that of the
bound itself. If it is larger than the offsets, all answers in an interval fit equally well; if
offsets exceed it, they move the answer. If the bound is right, the fit with Gaussian offsets is
also right, only less precise, and the answer is from it by no more than its own error (Hausman
1978).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxcal.diagnostics.image_errors import ImageErrors, quadratic
from jaxcal.diagnostics.intervals import image_jacobian
from jaxcal.model.image_points import mean_of_squares
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.arrays import map_arrays

Array = np.ndarray

FEWEST = 8
"""With fewer images in use the SDs of the errors are not estimated well enough."""

_ROUNDS = 8
"""Rounds of tuning the SDs."""
_STEPS = 4
"""Gauss-Newton steps from an answer within bounds."""


@dataclass(frozen=True)
class GaussianOffsets:
    """The fit of one problem.

    Attributes:
        seen: the errors at it.
        variance: mean squared errors of each kind, mm^2.
        step: from the answer within bounds, in the order of the unknowns.
    """

    seen: ImageErrors
    variance: Float[Array, " 3"]
    step: Float[Array, " p"]

    @classmethod
    def of(cls, seen: ImageErrors, used: Bool[Array, " n"]) -> GaussianOffsets:
        """The fit from the errors at an answer within bounds (leading axis of length 1)."""
        variance, whole = np.ones(3), np.zeros(seen.rows.shape[-1])
        for _ in range(_STEPS):
            variance, step = tuned(seen.errors[0][used], seen.rows[0][used], int(used.sum()))
            seen = ImageErrors.of(
                seen.unknowns.moved(step[None], seen.blocks), seen.problem, seen.blocks
            )
            whole = whole + step
        return cls(seen, variance, whole)


def moved_by_bound(answer: Calibration, grid: Float[Array, "m 2"]) -> tuple[float, float] | None:
    """How far an answer within bounds is from the fit with Gaussian offsets, in the image, mm.

    Args:
        answer: of one problem, on numpy arrays.
        grid: points of the image, [lateral, axial], mm.

    Returns:
        The distance, and the error of the fit with Gaussian offsets by its own covariance, both
        root mean squares over the points; None for other answers and with few images.
    """
    used = np.asarray(answer.mask) > 0
    images = int(used.sum())
    if answer.prior != "bounded" or answer.problem is None or images < FEWEST:
        return None
    one = map_arrays(lambda leaf: np.asarray(leaf)[None], answer)
    fit = GaussianOffsets.of(ImageErrors.of_answer(one), used)
    rows = fit.seen.rows[0][used]
    # Every kind gives a third of the unknowns' degrees of freedom.
    variance = fit.variance / (1 - rows.shape[-1] / (3 * images))
    weighted = rows / variance[:, None]
    information = np.einsum("mkp,mkq->pq", weighted, rows)
    weight = mean_of_squares(image_jacobian(answer, grid))
    error = np.trace(weight @ np.linalg.pinv(information, hermitian=True))
    moved = quadratic(fit.step[None, None], weight[None])[0, 0]
    return float(np.sqrt(moved)), float(np.sqrt(error))


def tuned(
    errors: Float[Array, "m 3"], rows: Float[Array, "m 3 q"], images: int
) -> tuple[Float[Array, " 3"], Float[Array, " q"]]:
    """Mean squared errors of each kind after the fit with tuned SDs, and the step."""
    scale = 1 / np.sqrt(np.maximum(np.sum(rows**2, axis=(0, 1)), 1e-300))
    variance = np.ones(3)
    step = np.zeros(rows.shape[-1])
    for _ in range(_ROUNDS):
        weight = 1 / np.sqrt(variance)[:, None]
        design = (rows * scale * weight).reshape(-1, rows.shape[-1])
        step = -scale * np.linalg.lstsq(design, (errors * weight[:, 0]).ravel(), rcond=1e-12)[0]
        left = errors + rows @ step
        variance = np.maximum(np.sum(left**2, axis=0) / images, 1e-12)
    return variance, step
