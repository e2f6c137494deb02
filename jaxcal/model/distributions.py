"""Candidate distributions of the elevational offsets, and what was found out about them.

The densities themselves are in :mod:`jaxcal.model.shapes`; this module needs no JAX.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from jaxcal.runtime.array_types import Bool, Float, HeldArray
from jaxcal.runtime.arrays import array_tree

Family = Literal["uniform", "bell", "gaussian", "student"]

FAMILIES: tuple[Family, ...] = get_args(Family)


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


UNIFORM: tuple[Shape, ...] = tuple(
    Shape("uniform", math.exp(0.14 - 0.055 * k), 0.08) for k in range(5)
)
"""Flat, with several edges since these are uncertain: even steps of ln SD, widest first."""

SHAPES: tuple[Shape, ...] = (
    *UNIFORM,
    Shape("bell", 1.05, 1 / 5),
    Shape("gaussian", 1.0, 1 / 5),
    Shape("student", 1.10, 1 / 5),
)
"""The laws that are weighed: a prior of a fifth for each family, two fifths for the uniform one.

With equal priors the answer is farthest from the Bayes limit where offsets are uniform. A larger
prior of the uniform laws costs accuracy where offsets are triangular, and where images are few.
"""


@array_tree
class OffsetLaw:
    """What was found out about the offsets and the noise; zeros where nothing was weighed.

    Attributes:
        probability: of the families uniform, bell, gaussian and student, in this order.
        mean: expectation of the offsets' mean, mm.
        mean_sd: standard deviation of that mean, mm.
        mean_probability: that there is a mean other than zero.
        trust: share of the data's information about the mean that is used: below 1 where the
            residuals have heavy tails, or are correlated between successive images.
        own_probability: that the images' own covariances describe the errors better than common
            SDs do; 0 where there are none.
        weighed: the distributions were weighed; if not, the answer is that of the Gaussian one.
    """

    probability: Float[HeldArray, "*batch families"]
    mean: Float[HeldArray, "*batch"]
    mean_sd: Float[HeldArray, "*batch"]
    mean_probability: Float[HeldArray, "*batch"]
    trust: Float[HeldArray, "*batch"]
    own_probability: Float[HeldArray, "*batch"]
    weighed: Bool[HeldArray, "*batch"]
