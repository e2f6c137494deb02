"""The distribution of the offsets in words: as estimated, and as the offsets look."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxcal.diagnostics.offset_fit import contradicted
from jaxcal.diagnostics.residual_checks import FEWEST_TO_CHECK
from jaxcal.model.distributions import FAMILIES

if TYPE_CHECKING:
    from jaxcal.result.calibration import Calibration

_FAMILY = {
    "uniform": "uniform with sharp limits",
    "bell": "bell-shaped with sharp limits",
    "gaussian": "Gaussian",
    "student": "heavy-tailed",
}


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
    words, wrong = (
        "The distributions of the offsets could not be compared; Gaussian is assumed",
        None,
    )
    if weighed:
        wrong = _contradicted(result)
        words = _law_in_words(probability, wrong)
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
    told = " or ".join(f"{_FAMILY[name]} ({100 * p:.0f} %)" for name, p in named)
    if not wrong or any(name not in wrong for name, _ in named):
        return f"Of the distributions of the offsets that were compared, the data prefer: {told}"
    fitting = [words for name, words in _FAMILY.items() if name not in wrong]
    if not fitting:
        return f"None of the distributions compared fits the offsets; the least bad is {told}"
    return (
        f"The estimate assumes offsets that are {told}, but the estimated offsets look "
        f"{' or '.join(fitting)}"
    )
