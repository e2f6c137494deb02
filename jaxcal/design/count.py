"""How many images a wanted error takes, and a plan of so many poses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from jaxcal import InputError
from jaxcal.design.candidates import Candidates
from jaxcal.design.names import Criterion
from jaxcal.design.planning import Plan, next_poses, plan
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.given_values import check_made, is_number

MOST_IMAGES = 1000
_ENOUGH = 1000
"""Number of candidates for counting images; more of them change the count by less than 1 %."""


def images_to(
    result: Calibration | Plan, tre_mm: float, candidates: Candidates | None = None
) -> int:
    """How many more images are needed for a wanted target registration error.

    Args:
        result: a plan, whose poses come first and which is then continued; or a calibration of
            the images ``candidates.taken``.
        tre_mm: wanted root mean square TRE over the region, mm.
        candidates: to choose further poses from; a plan's own by default.

    Returns:
        The number of images; 0 if the error is reached already.

    Raises:
        InputError: more than 1000 would be needed; a wanted error that is not positive; a
            calibration without candidates.
    """
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
    check_made("candidates", candidates, Candidates, "make_candidates or candidates_around")
    assert candidates is not None
    candidates = replace(candidates, poses=candidates.poses[:: -(-len(candidates) // _ENOUGH)])
    # A plan is continued by its own criterion, which may need more images.
    criterion = result.criterion if isinstance(result, Plan) else "tre"
    size, now = 16, math.inf
    while size <= MOST_IMAGES:
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


def plan_until(
    candidates: Candidates,
    tre_mm: float,
    criterion: Criterion = "tre",
    result: Calibration | None = None,
) -> Plan:
    """A plan of as many poses as a wanted target registration error takes.

    Args:
        candidates: to choose from.
        tre_mm: wanted root mean square TRE over the region, mm.
        criterion: of the plan.
        result: a calibration of the images ``candidates.taken``, to which poses are added. Without
            it, the plan has at least as many poses as are needed to estimate the SDs.

    Raises:
        InputError: more than 1000 poses would be needed.
    """
    if result is None:
        least = MINIMUM_SELF_TUNING
        count = images_to(plan(candidates, least, criterion, polish=False), tre_mm)
    else:
        least = 1
        count = images_to(result, tre_mm, candidates)
    found = plan(candidates, max(count, least), criterion, result)
    # A plan by another criterion, or one whose poses fill space, may need more than counted.
    while found.tre_mm[-1] > tre_mm:
        more = max(images_to(found, tre_mm) - len(found), 1)
        found = plan(candidates, len(found) + more, criterion, result)
    # Exchange and polish may have made fewer poses enough.
    enough = (k for k, error in enumerate(found.tre_mm) if error <= tre_mm)
    return found.first(max(next(enough, len(found)), least))
