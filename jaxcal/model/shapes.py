"""Shapes of the law of the elevational offsets, and their moments against a Gaussian.

A shape is a symmetric density of unit SD, to be stretched to an SD of s and shifted to a mean of b.
All are of Pearson's family

    p(u) ~ (1 - (u/a)^2)^e within |u| < a  (type II)     or     (1 + (u/a)^2)^-e  (type VII):

e = 0 is uniform, e = 2 a bell with edges (near the triangular law), e -> infinity Gaussian, and
type VII with e = 5/2 is Student's t with four degrees of freedom.

What inference needs of a shape is one function, :func:`tilted`: mass, mean and variance of the
shape times a Gaussian, cut to an interval. It is one quadrature over where both factors are, on
equidistant nodes with Gregory's end corrections: there the Gaussian needs three exponentials, each
node's following from the last one's by two products.

Reference for the corrections: Hildebrand, Introduction to Numerical Analysis, 5.9.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

INTERVALS = 20
WEIGHTS = np.ones(INTERVALS + 1)
REACH = 4.5
"""The Gaussian factor is taken to end this many SDs from its mean."""

END_WEIGHTS = np.array([475.0, 1902.0, 1104.0, 1586.0, 1413.0]) / 1440.0
"""Gregory's weights of the first and the last nodes; those between have weight one."""

WEIGHTS[: len(END_WEIGHTS)] = END_WEIGHTS
WEIGHTS[-len(END_WEIGHTS) :] = END_WEIGHTS[::-1]

Family = Literal["uniform", "bell", "gaussian", "student"]

FAMILIES: tuple[Family, ...] = get_args(Family)

EDGE: dict[Family, float] = {"uniform": 3**0.5, "bell": 7**0.5, "gaussian": 1e3, "student": 1e3}
"""Where each family's density of unit SD ends; the last two have no end that matters."""


@dataclass(frozen=True)
class Shape:
    """One candidate for the law of the offsets.

    Attributes:
        family: which density.
        stretch: its SD in units of the SD that the Gaussian fit found.
        prior: probability before the data are seen.
    """

    family: Family
    stretch: float
    prior: float


def density(family: Family, square: Array) -> Array | float:
    """Density of a family with unit SD, at points whose squares are given and within its edge."""
    if family == "uniform":
        return 1 / (2 * 3**0.5)
    if family == "bell":
        inside = 1 - square / 7
        return (15 / (16 * 7**0.5)) * inside * inside
    if family == "gaussian":
        return (2 * np.pi) ** -0.5 * jnp.exp(-0.5 * square)
    t = 1 / (1 + 0.5 * square)
    return (0.375 * 2**0.5) * t * t * jnp.sqrt(t)


class Moments(eqx.Module):
    """Of a shape times a normalised Gaussian: log of the mass, mean and variance."""

    log_mass: Float[Array, "k n"]
    mean: Float[Array, "k n"]
    variance: Float[Array, "k n"]


def tilted(
    family: Family,
    sd: Float[Array, " k"],
    mean: Float[Array, "k n"],
    variance: Float[Array, "k n"],
    lower: Float[Array, " n"] | None = None,
    upper: Float[Array, " n"] | None = None,
) -> Moments:
    """Moments of shapes of one family times every image's Gaussian.

    Args:
        family: of the shapes.
        sd: SD of each shape, mm.
        mean: of the Gaussian factor, about the shape's centre, mm.
        variance: of the Gaussian factor, mm^2.
        lower: cut the product below this, mm.
        upper: cut the product above this, mm.
    """
    sd = sd[:, None]
    if family == "gaussian" and lower is None and upper is None:
        both = variance + sd**2
        log_mass = -0.5 * (jnp.log(2 * np.pi * both) + mean**2 / both)
        return Moments(log_mass, mean * sd**2 / both, variance * sd**2 / both)
    edge = EDGE[family] * sd
    low = -edge if lower is None else jnp.clip(lower, -edge, edge)
    high = edge if upper is None else jnp.clip(upper, -edge, edge)
    # From the point of the interval nearest to the Gaussian's mean the Gaussian falls by
    # exp(-REACH^2 / 2) within ``fall``, be the mean inside or far out.
    nearest = jnp.clip(mean, low, high)
    out = mean - nearest
    reach = REACH**2 * variance
    fall = reach / (jnp.abs(out) + jnp.sqrt(out**2 + reach))
    low, high = jnp.maximum(low, nearest - fall), jnp.minimum(high, nearest + fall)
    step = (high - low) / INTERVALS
    total, line, parabola = _sums(family, (low, nearest, out, step, variance, sd))
    place = line / total
    spread = parabola / total - place**2
    log_mass = jnp.log(total * step / sd) - 0.5 * (
        jnp.log(2 * np.pi * variance) + out**2 / variance
    )
    return Moments(log_mass, low + place * step, spread * step**2)


Window = tuple[Array, Array, Array, Array, Array, Array]
"""Lower end, nearest point to the Gaussian's mean, how far out that is, step, variance, SD."""


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sums(family: Family, window: Window) -> tuple[Array, Array, Array]:
    """Sums over the nodes k of (1, k, k^2) times shape times Gaussian, relative to ``nearest``."""
    low, nearest, out, step, variance, sd = window
    # Relative to its value at ``nearest`` the Gaussian is exp(out t / w - t^2 / 2 w), t = u -
    # nearest, out the mean minus it; from node to node the exponent changes
    # linearly.
    first = low - nearest
    value = jnp.exp((out * first - 0.5 * first**2) / variance)
    ratio = jnp.exp(step * (out - first - 0.5 * step) / variance)
    bend = jnp.exp(-(step**2) / variance)
    start, pace = low / sd, step / sd
    total = jnp.zeros_like(value)
    line, parabola = total, total
    for node, weight in enumerate(WEIGHTS):
        mass = value * density(family, (start + node * pace) ** 2)
        mass = mass if weight == 1 else float(weight) * mass
        total = total + mass
        line = line + node * mass
        parabola = parabola + node**2 * mass
        value, ratio = value * ratio, ratio * bend
    return total, line, parabola


def _sums_at_once(family: Family, window: Window) -> tuple[Array, Array, Array]:
    """The same with an axis of nodes: slower to run, but its derivative is quick to compile."""
    low, nearest, out, step, variance, sd = window
    node = np.arange(INTERVALS + 1.0)[:, None, None]
    u = low + node * step
    from_nearest = u - nearest
    gauss = jnp.exp((out * from_nearest - 0.5 * from_nearest**2) / variance)
    mass = WEIGHTS[:, None, None] * gauss * density(family, (u / sd) ** 2)
    return jnp.sum(mass, 0), jnp.sum(node * mass, 0), jnp.sum(node**2 * mass, 0)


@_sums.defjvp
def _sums_jvp(family: Family, primals: tuple[Window], tangents: tuple[Window]) -> tuple:
    return jax.jvp(partial(_sums_at_once, family), primals, tangents)
