"""Do the offsets follow the laws that were weighed? A test of fit for each, and words.

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

import numpy as np
from scipy import special

from jaxcal.diagnostics.residual_checks import FEWEST_TO_CHECK
from jaxcal.model.distributions import FAMILIES, SHAPES
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float

CONTRADICTED: dict[str, float] = {"uniform": 1.25, "bell": 1.25, "gaussian": 1.25, "student": 1.9}
"""The largest sqrt(n) D for each family of :data:`jaxcal.model.distributions.FAMILIES`."""

MEDIAN_OF_STUDENT = 0.5237
"""Median magnitude of Student's t4, divided by its SD."""

BAYES_FACTOR = 10.0
"""The data tell two distributions apart if they are so many times as probable under one of them."""

_FAMILY = {
    "uniform": "uniform with sharp limits",
    "bell": "bell-shaped with sharp limits",
    "gaussian": "Gaussian",
    "student": "heavy-tailed",
}


def contradicted(offsets: Float[np.ndarray, " n"]) -> dict[str, bool]:
    """Which laws the offsets contradict.

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
    for family, limit in CONTRADICTED.items():
        expected = distribution(family, centred / (middle if family == "student" else spread))
        apart = np.maximum(expected - below, above - expected).max()
        found[family] = bool(np.sqrt(count) * apart > limit)
    return found


def distribution(family: str, u: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Distribution function of a law of unit SD (:mod:`jaxcal.model.shapes`)."""
    if family == "uniform":
        return np.clip(0.5 + u / (2 * 3**0.5), 0.0, 1.0)
    if family == "bell":
        v = np.clip(u / 7**0.5, -1.0, 1.0)
        return 0.5 + 15 / 16 * (v - 2 / 3 * v**3 + v**5 / 5)
    # t4 has the variance 2.
    return np.asarray(special.ndtr(u) if family == "gaussian" else special.stdtr(4, u * 2**0.5))


def offset_law(result: Calibration) -> dict[str, object] | None:
    """What the data say about the offsets' law and the noise, as plain values and in words."""
    law = result.offset_law
    if law is None:
        return None
    weighed = bool(law.weighed)
    probability = {
        family: float(value) for family, value in zip(FAMILIES, law.probability, strict=True)
    }
    own = float(law.own_probability)
    mean_probability = float(law.mean_probability)
    words = "The distributions of the offsets could not be compared; Gaussian is assumed"
    wrong = None
    if weighed:
        wrong = _contradicted(result)
        considered = ("uniform",) if result.prior == "uniform" else FAMILIES
        if np.asarray(result.convergence.sigma_floored)[2]:
            words = "The offsets are too small to tell their distribution"
        else:
            words = _law_in_words({name: probability[name] for name in considered}, wrong)
        if mean_probability > 0.5:
            words += f", about a mean of {float(law.mean):.2f} +- {float(law.mean_sd):.2f} mm"
        noise = "each image's own covariance" if own > 0.5 else "the same SDs in all images"
        words += f". The measurement errors are weighted by {noise}"
    words += "."
    return {
        "weighed": weighed,
        "probability": probability if weighed else None,
        "contradicted": wrong,
        "mean_mm": float(law.mean),
        "mean_sd_mm": float(law.mean_sd),
        "mean_probability": mean_probability,
        "own_covariances_probability": own,
        "words": words,
    }


def _contradicted(result: Calibration) -> list[str]:
    """The laws that the estimated offsets do not follow; none are tested with few images."""
    offsets = np.asarray(result.elevation, dtype=float)[np.asarray(result.mask) > 0]
    if len(offsets) < FEWEST_TO_CHECK or not np.std(offsets) > 0:
        return []
    return [family for family, wrong in contradicted(offsets).items() if wrong]


def _law_in_words(probability: dict[str, float], wrong: list[str]) -> str:
    ranked = sorted(probability.items(), key=lambda item: -item[1])
    named = [(name, p) for name, p in ranked if p >= 0.1]
    told = ", then ".join(f"{_FAMILY[name]} ({100 * p:.0f} %)" for name, p in named)
    compared = len(probability) > 1
    if wrong and all(name in wrong for name, _ in named):
        fitting = [words for name, words in _FAMILY.items() if name not in wrong]
        if fitting:
            return (
                f"The estimate assumes offsets that are {told}, but the estimated offsets look "
                f"{' or '.join(fitting)}"
            )
        if compared:
            return f"None of the distributions compared fits the offsets; the least bad is {told}"
    if not compared:
        return f"The offsets are taken to be {_FAMILY[ranked[0][0]]}, as asked for"
    if _told_apart(probability):
        return f"Of the distributions of the offsets that were compared, the most probable: {told}"
    return f"These images hardly tell the distributions of the offsets apart: {told}"


def _told_apart(probability: dict[str, float]) -> bool:
    """Whether the data make some distribution clearly more probable than it was, and another less.

    The probabilities alone do not say this: the uniform distribution has 40 % before any image.
    """
    before = {name: sum(each.prior for each in SHAPES if each.family == name) for name in FAMILIES}
    factors = [p / before[name] for name, p in probability.items()]
    return max(factors) > BAYES_FACTOR * min(factors)
