"""Where the residuals contradict the noise model, in words."""

from __future__ import annotations

import numpy as np

from jaxcal.diagnostics.residual_checks import FEWEST_TO_CHECK
from jaxcal.result.calibration import Calibration
from jaxcal.result.diagnostics import MISFITS
from jaxcal.runtime.array_types import AnyArray

MISFIT_SCORE = 3.3
"""A standard normal score beyond this contradicts the noise model. Where the model holds, one data
set in 170 has such a score among its nine."""
DRIFT_SCORE = 2.8
"""The same limit for correlation in time. Without such correlation, one data set in 45 has a score
beyond this, among three scores of successive images and three of the trend."""
WITHIN_THE_IMAGE = ("lateral errors", "range errors")
"""Errors within the image, in the order of the residuals."""
LARGEST_OF_GROUPS = 1.5
"""Errors with a larger kurtosis are not called two groups."""


def noise_model(result: Calibration) -> dict[str, object]:
    """How well the noise model fits the residuals: scores by name, kurtosis, and complaints."""
    scores = np.asarray(result.inspection.misfit, dtype=float)
    return {
        "checked": int(result.images_used) >= FEWEST_TO_CHECK,
        "kurtosis": result.inspection.kurtosis,
        "scores": dict(zip(MISFITS, scores, strict=True)),
        "complaints": misfits(result),
    }


def misfits(result: Calibration) -> list[str]:
    """Where the residuals contradict the noise model, in words; empty where they do not."""
    scores = np.asarray(result.inspection.misfit, dtype=float)
    kurtosis = np.asarray(result.inspection.kurtosis, dtype=float)
    found = []
    for k, name in enumerate((*WITHIN_THE_IMAGE, "elevational offsets")):
        tails, skewness, depth, _, _ = scores[:, k]
        if tails > MISFIT_SCORE:
            found.append(
                f"the {name} have heavier tails than assumed (kurtosis {kurtosis[k]:.1f}, "
                "Gaussian 3)"
            )
        # Offsets may have edges of their own.
        if name in WITHIN_THE_IMAGE and in_two_groups(tails, kurtosis[k]):
            found.append(
                f"the {name} come in two groups (kurtosis {kurtosis[k]:.1f}, Gaussian 3): two "
                "targets, or a second echo?"
            )
        if abs(skewness) > MISFIT_SCORE:
            found.append(f"the {name} are skewed to one side")
        if depth > MISFIT_SCORE:
            found.append(f"the {name} grow with depth, but are assumed not to")
        found += _in_time(name, scores[:, k], int(result.images_used))
    return found


def in_two_groups(score: float | None, kurtosis: float | None) -> bool:
    """Whether errors of one kind lie in two groups, by the score of their tails and the kurtosis.

    Equal groups have a kurtosis of 1, those of 40 and 60 % 1.17, uniform errors 1.8.
    """
    if score is None or kurtosis is None:
        return False
    return bool(score < -MISFIT_SCORE and kurtosis < LARGEST_OF_GROUPS)


def _in_time(name: str, scores: AnyArray, count: int) -> list[str]:
    """How one kind of error changes during the recording."""
    drift, trend = (float(scores[MISFITS.index(kind)]) for kind in ("drift", "trend"))
    parts = []
    if drift > DRIFT_SCORE:
        parts.append(f"are correlated in successive images ({drift / (count - 1) ** 0.5:.2f})")
    if abs(trend) > DRIFT_SCORE:
        correlation = np.tanh(trend / np.sqrt(count - 3))
        parts.append(f"drift in the course of the recording (correlation {correlation:.2f})")
    if not parts:
        return []
    return [
        f"the {name} {' and '.join(parts)}: latency, a slipping mount, a moving target or another "
        "depth setting?"
    ]
