"""Predicted errors of poses, and how many images a wanted error takes.

The prediction is the Cramer-Rao bound under the model's SDs. After a calibration, whose SDs were
tuned to its images, it is multiplied by Student's factor, as the errors that the calibration itself
states are (:mod:`jaxcal.diagnostics.intervals`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jaxcal import InputError
from jaxcal.design.candidates import Candidates
from jaxcal.design.criteria import rp_weight, tre_weight
from jaxcal.design.information import covariance_of
from jaxcal.diagnostics.intervals import student_variance
from jaxcal.runtime.array_types import Float, Int
from jaxcal.runtime.arrays import is_number

if TYPE_CHECKING:
    from jaxcal.calibration.result import Calibration
    from jaxcal.design.planning import Known, Plan

MOST_IMAGES = 1000
_ENOUGH = 1000
"""Number of candidates for counting images; more of them change the count by less than 1 %."""


def tuned_factor(known: Known, more: Int[np.ndarray, "*n"], size: int) -> Float[np.ndarray, "*n"]:
    """By how much squared errors with so many more images exceed the bound: 1 for given SDs."""
    left = known.images + more - size / 3
    return np.asarray(student_variance(left if known.tuned else np.full_like(left, np.inf)))


def curve(
    candidates: Candidates, known: Known, poses: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, " n1"], Float[np.ndarray, " n1"]]:
    """Predicted TRE and RP with the first 0, 1, ... n of the poses, mm."""
    model = candidates.model
    rows = model.jacobian(poses)
    steps = np.einsum("nia,nib->nab", rows, rows)
    total = known.information + np.concatenate([np.zeros((1, *steps.shape[1:])), steps.cumsum(0)])
    covariance = covariance_of(total)
    weights = (
        tre_weight(candidates.constraints.region.grid(), model),
        rp_weight(candidates.poses, model),
    )
    factor = tuned_factor(known, np.arange(len(total)), model.size)
    tre, rp = (np.sqrt(factor * np.einsum("ab,nab->n", weight, covariance)) for weight in weights)
    return tre, rp


def images_to(
    result: Calibration | Plan,
    tre_mm: float,
    candidates: Candidates | None = None,
) -> int:
    """How many more images a wanted target registration error takes.

    Args:
        result: a plan, whose poses come first and which is then continued; or a calibration of
            the images ``candidates.taken``.
        tre_mm: wanted root mean square TRE over the region, mm.
        candidates: to choose further poses from; a plan's own by default.

    Returns:
        The number of images; 0 if the error is reached already.

    Raises:
        InputError: more than 1000 would be needed.
    """
    from jaxcal.design.greedy import MOST_POSES
    from jaxcal.design.planning import Plan, next_poses

    if not (is_number(tre_mm) and tre_mm > 0):
        raise InputError(f"the wanted error must be a positive number of mm, not {tre_mm!r}")
    first = 0
    if isinstance(result, Plan):
        reached = np.flatnonzero(result.tre_mm <= tre_mm)
        if len(reached):
            return int(reached[0])
        candidates = result.candidates if candidates is None else candidates
        first = len(result)
    elif candidates is None:
        raise InputError(
            "how many images a calibration lacks depends on the poses to choose from: give "
            "candidates_around(recording, result)"
        )
    assert candidates is not None
    candidates = replace(candidates, poses=candidates.poses[:: -(-len(candidates) // _ENOUGH)])
    # A plan is continued by its own criterion, which may need more images.
    criterion = result.criterion if isinstance(result, Plan) else "tre"
    size, now = 16, math.inf
    while size <= min(MOST_IMAGES, MOST_POSES):
        more = next_poses(result, candidates, size, criterion)
        reached = np.flatnonzero(more.tre_mm <= tre_mm)
        if len(reached):
            return first + int(reached[0])
        now = float(more.tre_mm[-1])
        # The squared error falls as 1 / n: jump to the number at which it is small enough.
        wanted = size * min(8.0, max(2.0, 1.3 * (now / tre_mm) ** 2))
        if size < MOST_IMAGES < wanted:
            wanted = MOST_IMAGES
        size = int(wanted)
    raise InputError(
        f"{tre_mm:g} mm would take more than {MOST_IMAGES} images ({now:.3g} mm with so many): "
        "tilt the probe farther, or make each image better"
    )
