"""Which images stand out by their errors, for solvers and diagnostics. Needs no JAX."""

from __future__ import annotations

from jaxcal.model.thresholds import MAD
from jaxcal.runtime.array_types import AnyArray, Bool, Float, HeldArray
from jaxcal.runtime.arrays import array_module

CUT = 6.0
"""SDs beyond which an image stands out. Heavy tails (Student's t4) put 0.3 % of images there."""

FEW_IMAGES = 30
"""With fewer images in use, n, the limit is wider by sqrt(30 / n): 9.5 SDs for a dozen."""

GROSS_SHARE = 0.02
"""No component's SD is taken to be less than this share of the largest: smaller errors are no
gross ones."""

LEAST_ERROR_LEFT = 0.05
"""Least share of an image's error that a fit is taken to leave in its residual (1 - leverage)."""


def with_gross_floor(sigma: Float[AnyArray, "*batch 3"]) -> Float[HeldArray, "*batch 3"]:
    """The components' SDs, mm, none below its floor."""
    xp = array_module(sigma)
    return xp.maximum(sigma, xp.maximum(GROSS_SHARE * xp.max(sigma, -1, keepdims=True), 1e-6))


def robust_sd(
    medians: Float[AnyArray, "*batch 3"], count: Float[AnyArray, "*#batch"], unknowns: int
) -> Float[HeldArray, "*batch 3"]:
    """SDs of the components from the median magnitudes of their errors, mm.

    Args:
        medians: over the images in use, mm.
        count: number of these images.
        unknowns: number that was fitted; the components share its degrees of freedom equally.
    """
    xp = array_module(medians, count)
    freedom = xp.maximum(1 - unknowns / (3 * count), 0.1)
    return with_gross_floor(MAD * medians / xp.sqrt(freedom)[..., None])


def studentise(
    errors: Float[AnyArray, "*batch n 3"],
    leverage: Float[AnyArray, "*batch n 3"],
    sigma: Float[AnyArray, "*batch 3"],
    kept: Float[AnyArray, "*batch n"],
) -> Float[HeldArray, "*batch n 3"]:
    """Errors in SDs, corrected for leverage.

    An image in use pulls the fit towards itself; the fit predicts an image that is not in use.
    """
    xp = array_module(errors, leverage, sigma, kept)
    left = xp.where(kept[..., None] > 0, xp.maximum(1 - leverage, LEAST_ERROR_LEFT), 1 + leverage)
    return errors / xp.sqrt(left) / sigma[..., None, :]


def stands_out(
    studentised: Float[AnyArray, "*batch n 3"], kept: Float[AnyArray, "*batch n"]
) -> Bool[AnyArray, "*batch n"]:
    """Whether an image's errors are larger than the images in use can explain (traceable).

    A median of a dozen images is itself uncertain, so the limit is wider with few images. It is
    not wider for an image that was left out: the prediction from few images is uncertain, too, and
    an outlier that returned through the wide limit would bring the others back with it.
    """
    xp = array_module(studentised, kept)
    count = xp.maximum(xp.sum(kept, axis=-1, keepdims=True), 1.0)
    limit = CUT * xp.where(kept > 0, xp.sqrt(xp.maximum(FEW_IMAGES / count, 1.0)), 1.0)
    return xp.any(xp.abs(studentised) > limit[..., None], axis=-1)
