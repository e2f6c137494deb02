"""Laws of the elevational offset: how far from the image plane the target is, image by image.

Every law has one size in mm, a bound m or a standard deviation s:

    uniform       uniform in [-m, m], the paper's
    one-sided     uniform in [0, m]: the target is always on the same side
    triangular    symmetric, in [-m, m]
    normal        of SD s
    heavy-tailed  Student's t with four degrees of freedom, scaled to SD s

One draw is a pure function of a key, so a law is the only thing that differs between two studies of
the same seed.
"""

from __future__ import annotations

from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxcal import InputError
from jaxcal.study import draws

OffsetLaw = Literal["uniform", "normal", "one-sided", "heavy-tailed", "triangular"]

OFFSET_LAWS: tuple[OffsetLaw, ...] = get_args(OffsetLaw)

DEGREES_OF_FREEDOM = 4.0
"""Of the heavy-tailed law: the fewest whole ones with a variance that settles in a sample."""

_SIZED_BY_SD = ("normal", "heavy-tailed")


def check_law(law: str) -> None:
    """Raise InputError for a name that is no law."""
    if law not in OFFSET_LAWS:
        raise InputError(
            f"elevation_distribution must be {', '.join(OFFSET_LAWS[:-1])} or "
            f"{OFFSET_LAWS[-1]}, not {law!r}"
        )


def standard_offsets(key: Key[Array, ""], law: OffsetLaw, count: int) -> Float[Array, " count"]:
    """Draw ``count`` offsets of size 1 mm (bound or SD); times a size they have that size.

    Args:
        key: of the draw.
        law: one of :data:`OFFSET_LAWS`.
        count: how many.

    Raises:
        InputError: an unknown law.
    """
    check_law(law)
    if law == "normal":
        return draws.normals(key, 0, count)
    if law == "heavy-tailed":
        # Student's t: a normal over the root of chi squared / 4, which for four degrees of freedom
        # is -2 ln of a product of two uniforms. Its variance is nu / (nu - 2).
        one, other = draws.uniforms(key, 1, 2 * count).reshape(2, count)
        chi_square = -2 * jnp.log(one * other)
        unit = np.sqrt(DEGREES_OF_FREEDOM - 2)
        return unit * draws.normals(key, 0, count) * jax.lax.rsqrt(chi_square)
    if law == "one-sided":
        return draws.uniforms(key, 0, count)
    if law == "triangular":
        pair = draws.uniforms(key, 0, 2 * count).reshape(2, count)
        return pair[0] - pair[1]
    return 2 * draws.uniforms(key, 0, count) - 1


def nominal_bound(law: OffsetLaw, size: float) -> float:
    """The bound that a method is told when it is told "the true one", mm.

    It is m itself where the law has one. Normal and heavy-tailed offsets have none: sqrt(3) s is
    the bound of the uniform law with the same SD.
    """
    check_law(law)
    return float(np.sqrt(3.0)) * size if law in _SIZED_BY_SD else size


def standard_deviation(law: OffsetLaw) -> float:
    """SD about the mean of a law of size 1."""
    check_law(law)
    squares = {"uniform": 1 / 3, "one-sided": 1 / 12, "triangular": 1 / 6}
    return float(jnp.sqrt(squares.get(law, 1.0)))
