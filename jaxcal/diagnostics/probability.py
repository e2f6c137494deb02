"""Normal, Student's, chi-squared and F distributions in numpy.

``scipy.special`` has the same; importing it takes longer than a calibration. Tests compare the two.

References: Wichura 1988 (AS 241, the normal quantile); Abramowitz and Stegun 1964, 6.5.22 (the
incomplete gamma function's recurrence), 26.5.8 (the incomplete beta function's continued fraction).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.runtime.array_types import Float

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

MOST_FREEDOM = 1e6
"""Degrees of freedom from which Student's distribution is taken for the normal one."""

# AS 241, PPND16: numerators and denominators, highest power first.
_CENTRE = (
    (
        2509.0809287301226727,
        33430.575583588128105,
        67265.770927008700853,
        45921.953931549871457,
        13731.693765509461125,
        1971.5909503065514427,
        133.14166789178437745,
        3.387132872796366608,
    ),
    (
        5226.495278852854561,
        28729.085735721942674,
        39307.89580009271061,
        21213.794301586595867,
        5394.1960214247511077,
        687.1870074920579083,
        42.313330701600911252,
        1.0,
    ),
)
_SHOULDER = (
    (
        7.7454501427834140764e-4,
        0.0227238449892691845833,
        0.24178072517745061177,
        1.27045825245236838258,
        3.64784832476320460504,
        5.7694972214606914055,
        4.6303378461565452959,
        1.42343711074968357734,
    ),
    (
        1.05075007164441684324e-9,
        5.475938084995344946e-4,
        0.0151986665636164571966,
        0.14810397642748007459,
        0.68976733498510000455,
        1.6763848301838038494,
        2.05319162663775882187,
        1.0,
    ),
)
_TAIL = (
    (
        2.01033439929228813265e-7,
        2.71155556874348757815e-5,
        0.0012426609473880784386,
        0.026532189526576123093,
        0.29656057182850489123,
        1.7848265399172913358,
        5.4637849111641143699,
        6.6579046435011037772,
    ),
    (
        2.04426310338993978564e-15,
        1.4215117583164458887e-7,
        1.8463183175100546818e-5,
        7.868691311456132591e-4,
        0.0148753612908506148525,
        0.13692988092273580531,
        0.59983220655588793769,
        1.0,
    ),
)


def normal_quantile(chance: ArrayLike) -> Float[np.ndarray, "*shape"]:
    """Where the standard normal distribution reaches a probability between 0 and 1."""
    chance = np.asarray(chance, float)
    away = chance - 0.5
    depth = np.sqrt(-np.log(np.minimum(chance, 1 - chance)))

    def ratio(of: tuple, at: Any) -> Any:
        return np.polyval(of[0], at) / np.polyval(of[1], at)

    centre = away * ratio(_CENTRE, 0.180625 - np.minimum(np.abs(away), 0.425) ** 2)
    outer = np.where(depth <= 5, ratio(_SHOULDER, depth - 1.6), ratio(_TAIL, depth - 5))
    return np.where(np.abs(away) <= 0.425, centre, np.copysign(outer, away))


def chi_squared_below(
    dimensions: int, value: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Probability that the squared length of a standard normal vector is below a value."""
    half = np.asarray(0.5 * value, float)
    if dimensions % 2:
        a, below = 0.5, np.vectorize(math.erf, otypes=[float])(np.sqrt(half))
    else:
        a, below = 1.0, -np.expm1(-half)
    while a < 0.5 * dimensions:
        below = below - half**a * np.exp(-half) / math.gamma(a + 1)
        a += 1
    return np.maximum(below, 0.0)


def f_below(
    dimensions: int, freedom: float, value: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Probability that an F distributed number is below a value."""
    value = np.asarray(value, float)
    share = dimensions * value / (dimensions * value + freedom)
    rest = freedom / (dimensions * value + freedom)
    return incomplete_beta(0.5 * dimensions, 0.5 * freedom, share, rest)


def student_quantile(freedom: ArrayLike, chance: float) -> Float[np.ndarray, "*shape"]:
    """Where Student's distribution reaches a probability.

    Args:
        freedom: degrees of freedom, more than 0; inf for the normal distribution.
        chance: between 0 and 1.
    """
    freedoms = np.asarray(freedom, float)
    normal = float(normal_quantile(chance))
    if normal == 0:
        return np.zeros(freedoms.shape)
    each, places = np.unique(freedoms, return_inverse=True)
    tail = min(chance, 1 - chance)
    found = [_student_beyond(f, tail) if f < MOST_FREEDOM else abs(normal) for f in each.tolist()]
    return np.asarray(np.copysign(np.array(found)[places].reshape(freedoms.shape), normal))


def _student_beyond(freedom: float, tail: float) -> float:
    """The t beyond which there is as much as that of Student's distribution."""
    at = math.log(abs(float(normal_quantile(tail))))
    # The logarithm of the tail is a falling, concave function of that of t: Newton's method
    # converges from wherever it starts. The density is that of t.
    constant = (
        math.lgamma(0.5 * freedom + 0.5)
        - math.lgamma(0.5 * freedom)
        - 0.5 * math.log(math.pi * freedom)
    )
    for _ in range(100):
        t = math.exp(at)
        inside = t * t / (freedom + t * t)
        beyond = 0.5 * incomplete_beta(
            0.5 * freedom, 0.5, np.array(freedom / (freedom + t * t)), np.array(inside)
        )
        slope = math.exp(constant - (0.5 * freedom + 0.5) * math.log1p(t * t / freedom) + at)
        step = math.log(float(beyond) / tail) * float(beyond) / slope
        at += step
        if abs(step) < 1e-15:
            break
    return math.exp(at)


def incomplete_beta(
    a: float, b: float, x: Float[np.ndarray, "*shape"], rest: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """The regularised incomplete beta function.

    Args:
        a: more than 0.
        b: more than 0.
        x: between 0 and 1.
        rest: 1 - x, which is not computed here for the sake of x near 1.
    """
    # The continued fraction converges fast below the mean, and the rest is the other tail.
    turned = x > (a + 1) / (a + b + 2)
    first, second = np.where(turned, b, a), np.where(turned, a, b)
    at, beside = np.where(turned, rest, x), np.where(turned, x, rest)
    fraction = np.ones_like(at)
    for m in range(40 + math.ceil(3 * math.sqrt(max(a, b))), 0, -1):
        odd = (first + m - 1) * (first + second + m - 1) / (first + 2 * m - 2)
        even = m * (second - m) / (first + 2 * m)
        share = at / (first + 2 * m - 1)
        fraction = 1 - odd * share / (1 + even * share / fraction)
    with np.errstate(divide="ignore"):
        front = first * np.log(at) + second * np.log(beside)
    front = np.exp(front + math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)) / first
    return np.where(turned, 1 - front / fraction, front / fraction)
