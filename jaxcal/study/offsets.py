"""Laws of the elevational offset: how far from the image plane the target is, image by image.

Every law has one size in mm, a bound m or a standard deviation s:

    uniform       uniform in [-m, m], the paper's
    one-sided     uniform in [0, m]: the target is always on the same side
    triangular    symmetric, in [-m, m]
    normal        of SD s
    heavy-tailed  Student's t with four degrees of freedom, scaled to SD s

Laws other than those that the prior ``auto`` weighs (the last is what it assumes of the mean):

    exponential   of SD s, and so of mean s: mostly near the plane, always on the same side
    two-humped    half of them near -m, half near m, each hump of SD m / 4
    drifting      normal, of SD s, correlated from one image to the next (0.9)
    outlying      normal, of SD s, one in ten drawn from a normal five times as wide
    off-centre    normal, of SD s, with a mean of 3 s
    sometimes off-centre  normal, of SD s, one time in ten with a mean that is normal, of SD 2 s

One draw is a pure function of a key, so a law is the only thing that differs between two studies of
the same seed.
"""

from __future__ import annotations

from typing import assert_never

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxcal.study import draws
from jaxcal.study.laws import LawName, check_law

DEGREES_OF_FREEDOM = 4.0
"""Of the heavy-tailed law, Student's t."""

_BOUNDED = ("uniform", "one-sided", "triangular", "two-humped")
_HUMP = 0.25
"""SD of a hump over its distance from the plane."""
_ALIKE = 0.9
"""Correlation of the drifting law between successive images."""
_OUTLYING, _WIDER = 0.1, 5.0
"""Share of the outlying offsets, and how much wider their law is."""
_FAR = 3.0
"""Mean of the off-centre law."""
_SOMETIMES, _MEAN_SD = 0.1, 2.0
"""How often the sometimes off-centre law has a mean; the mean's SD. Prior ``auto`` assumes both."""


def standard_offsets(key: Key[Array, ""], law: LawName, count: int) -> Float[Array, " count"]:
    """Draw ``count`` offsets of size 1 mm (bound or SD), to be multiplied by another size.

    Args:
        key: of the draw.
        law: one of :data:`jaxcal.study.laws.OFFSET_LAWS`.
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
    if law == "exponential":
        return -jnp.log(draws.uniforms(key, 0, count))
    if law == "two-humped":
        side = jnp.sign(draws.uniforms(key, 1, count) - 0.5)
        return side + _HUMP * draws.normals(key, 0, count)
    if law == "drifting":
        steps = draws.normals(key, 0, count)
        fresh = np.sqrt(1 - _ALIKE**2)

        def move(last: Array, step: Array) -> tuple[Array, Array]:
            now = _ALIKE * last + fresh * step
            return now, now

        return jnp.append(steps[:1], jax.lax.scan(move, steps[0], steps[1:])[1])
    if law == "outlying":
        wide = draws.uniforms(key, 1, count) < _OUTLYING
        unit = (1 + _OUTLYING * (_WIDER**2 - 1)) ** -0.5
        return unit * jnp.where(wide, _WIDER, 1.0) * draws.normals(key, 0, count)
    if law == "off-centre":
        return _FAR + draws.normals(key, 0, count)
    if law == "sometimes off-centre":
        there = draws.uniforms(key, 1, 1) < _SOMETIMES
        mean = jnp.where(there, _MEAN_SD * draws.normals(key, 2, 1), 0.0)
        return mean + draws.normals(key, 0, count)
    if law == "triangular":
        pair = draws.uniforms(key, 0, 2 * count).reshape(2, count)
        return pair[0] - pair[1]
    if law == "uniform":
        return 2 * draws.uniforms(key, 0, count) - 1
    assert_never(law)


def nominal_bound(law: LawName, size: float) -> float:
    """The bound that counts as the true one of a law, mm.

    It is m for laws with a bound. Laws with an SD have none: sqrt(3) s, the bound of the uniform
    law with the same SD, takes its place.
    """
    check_law(law)
    return size if law in _BOUNDED else float(np.sqrt(3.0)) * size


def standard_deviation(law: LawName) -> float:
    """SD about the mean of one recording's offsets, for a law of size 1."""
    check_law(law)
    squares = {
        "uniform": 1 / 3,
        "one-sided": 1 / 12,
        "triangular": 1 / 6,
        "two-humped": 1 + _HUMP**2,
    }
    return float(np.sqrt(squares.get(law, 1.0)))
