"""Do the offsets follow the laws that were weighed? A test of fit for each.

The probability of a law (:mod:`jaxcal.solvers.auto`) is relative to the others: if all the laws are
wrong, one still fits best. A law may also be excluded by a detail: if a single image oversteps the
edges by rounding, the uniform law is excluded, even if it seems to describe 5,000 offsets well. So
the estimated offsets are compared with each law of their own mean and spread, by the largest
distance D of the distribution functions (Kolmogorov, Lilliefors). A law is contradicted where
sqrt(n) D exceeds ``CONTRADICTED``. Of sets of n offsets that follow the law, with mean and spread
estimated, fewer than one in a thousand exceed it.

References: Lilliefors 1967 (estimated parameters); the limits are from 4,000 simulated sets of 50.
"""

from __future__ import annotations

import math

import numpy as np

from jaxcal.runtime.array_types import Float

CONTRADICTED: dict[str, float] = {"uniform": 1.25, "bell": 1.25, "gaussian": 1.25, "student": 1.9}
"""The largest sqrt(n) D for each family of :data:`jaxcal.model.distributions.FAMILIES`."""

MEDIAN_OF_STUDENT = 0.5237
"""Median magnitude of Student's t4, divided by its SD."""


def law_distances(offsets: Float[np.ndarray, " n"]) -> dict[str, float]:
    """The distance sqrt(n) D of the offsets from each law.

    Args:
        offsets: of the used images, mm; at least two, not all alike.
    """
    count = len(offsets)
    centred = np.sort(offsets - offsets.mean())
    spread = centred.std(ddof=1)
    # With heavy tails the SD depends on a few offsets; the median magnitude does not.
    middle = np.median(np.abs(centred - np.median(centred))) / MEDIAN_OF_STUDENT
    below, above = np.arange(count) / count, np.arange(1, count + 1) / count
    found = {}
    for family, size in (
        ("uniform", spread),
        ("bell", spread),
        ("gaussian", spread),
        ("student", middle),
    ):
        expected = distribution(family, centred / size)
        apart = np.maximum(expected - below, above - expected).max()
        found[family] = float(np.sqrt(count) * apart)
    return found


def contradicted(offsets: Float[np.ndarray, " n"]) -> dict[str, bool]:
    """Which laws the offsets contradict."""
    apart = law_distances(offsets)
    return {family: apart[family] > limit for family, limit in CONTRADICTED.items()}


def distribution(family: str, u: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Distribution function of a law of unit SD (:mod:`jaxcal.model.shapes`)."""
    if family == "uniform":
        return np.clip(0.5 + u / (2 * 3**0.5), 0.0, 1.0)
    if family == "bell":
        v = np.clip(u / 7**0.5, -1.0, 1.0)
        return 0.5 + 15 / 16 * (v - 2 / 3 * v**3 + v**5 / 5)
    if family == "gaussian":
        return np.array([0.5 * math.erfc(-each / 2**0.5) for each in u])
    # t4 has the variance 2.
    t = u * 2**0.5
    share = t / np.sqrt(4 + t**2)
    return 0.5 + 0.75 * (share - share**3 / 3)
