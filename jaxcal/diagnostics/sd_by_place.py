"""How the SD of an error depends on where the target is in the image.

Beams are worst in the corners of an image, so errors of measurement are larger there. The logarithm
of an SD is taken for a polynomial of the target's place,

    ln s = a_0 + a_1 d + a_2 d^2 + a_3 x^2,   d = depth / 50 mm - 1,  x = lateral / 25 mm.

Its slopes a_1 to a_3 come from squared errors by a Gamma regression with a logarithmic link (Fisher
scoring), in which a normal prior holds them near zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcal.runtime.array_types import Float

_DEPTH_MM, _LATERAL_MM = 50.0, 25.0
_PRIOR_SD = 0.3
"""Prior SD of the slopes (our choice): a factor of e^0.3 for 50 mm of depth is common."""
_SCORING_STEPS = 30
_LARGEST_SDS = 2.0
"""Larger errors count as this many SDs, so that a few wrong images do not raise the SD about them.
"""


def basis_at(target: Float[Any, "*n 3"]) -> Float[Any, "*n 4"]:
    """1, d, d^2 and x^2 of targets in the image frame, mm (traceable)."""
    xp = target.__array_namespace__()
    deeper = target[..., 2] / _DEPTH_MM - 1.0
    aside = target[..., 0] / _LATERAL_MM
    return xp.stack([xp.ones_like(deeper), deeper, deeper**2, aside**2], axis=-1)


def log_sd_slopes(
    basis: Float[np.ndarray, "*#k n 4"],
    squares: Float[np.ndarray, "*k n"],
    mask: Float[np.ndarray, "*k n"],
) -> Float[np.ndarray, "*k 3"]:
    """a_1 to a_3, which maximise sum(-ln v - r / v) / 2, v = s^2, plus the log prior.

    Args:
        basis: of the places, with the means of the last three columns taken out.
        squares: of the errors, r, in any unit.
        mask: 1 for the images that count, at least one.
    """
    ratio = squares / np.maximum(mean_over(squares, mask), 1e-12)[..., None]
    precision = np.array([0.0, *np.full(3, 0.25 / _PRIOR_SD**2)])
    counted = np.swapaxes(mask[..., None] * basis, -1, -2)
    # A squared normal error has the Fisher information 1/2 about its log variance.
    inverse = np.linalg.inv(0.5 * counted @ basis + np.diag(precision))
    slopes = np.zeros((*mask.shape[:-1], 4, 1))
    for _ in range(_SCORING_STEPS):
        part = ratio[..., None] * np.exp(-basis @ slopes)
        step = inverse @ (0.5 * counted @ (part - 1) - precision[:, None] * slopes)
        slopes += np.clip(step, -1.0, 1.0)
        if np.abs(step).max(initial=0.0) < 1e-10:
            break
    return 0.5 * slopes[..., 1:, 0]


def relative_sd(
    target: Float[np.ndarray, "*k n 3"],
    errors: Float[np.ndarray, "*k n"],
    mask: Float[np.ndarray, "*k n"],
) -> Float[np.ndarray, "*k n"]:
    """By how much errors are larger at an image's place than on average, as a factor on their SD.

    Args:
        target: places in the image frame, mm.
        errors: one of each image, in SDs.
        mask: 1 for the images that count, at least one.
    """
    basis = basis_at(target)
    basis[..., 1:] -= mean_over(basis[..., 1:], mask[..., None], axis=-2)[..., None, :]
    slopes = log_sd_slopes(basis, np.minimum(errors**2, _LARGEST_SDS**2), mask)
    return np.exp((basis[..., 1:] @ slopes[..., None])[..., 0])


def mean_over(values: np.ndarray, mask: np.ndarray, axis: int = -1) -> np.ndarray:
    """The mean of the values that count."""
    return np.asarray(np.sum(mask * values, axis=axis) / np.sum(mask, axis=axis))
