"""Which images stand out by their errors, for solvers and diagnostics. Needs no JAX."""

from __future__ import annotations

from jaxcal.runtime.array_types import AnyArray, Bool, Float
from jaxcal.runtime.arrays import array_module

CUT = 6.0
"""SDs beyond which an image stands out. Heavy tails (Student's t4) put 0.3 % of images there."""

FEW_IMAGES = 30
"""With fewer images in use, n, the limit is wider by sqrt(30 / n): 9.5 SDs for a dozen."""


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
