"""The tank's experiments as a study of the engine: calibrate from each set, judge on each other.

A condition is one :class:`tank.Tank`, a trial one experiment: AE, CW and OH data at shared
orientations, each segmented by as many persons as :data:`tank.PERSONS`, or automatically. Trials of
all conditions share their random numbers, so that conditions are compared in pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from common import precision
from jaxtyping import Float
from tank import PERSONS, Points, Tank, draw
from tank_grid import Grid, padded_problems

from jaxcal import calibrate_batch
from jaxcal.data.poses import rotation_angle
from jaxcal.study import ArraySpec, Chunk

SETS = ("AE", "CW", "Auto-AE", "Auto-AE, shortest")
"""Calibration sets; the last takes Eqs. 2 and 3 for the segmentation, the one before Eq. 5."""
METHODS: dict[str, dict[str, Any]] = {
    "without": {"method": "conventional"},
    "alternating": {"method": "alternating", "max_elevation": 1.0},
    "joint": {"method": "joint"},
}
"""Without out-of-plane estimation, the paper's with its bound of 1 mm (section 4.1), and ours."""
TESTS = ("CW", "AE", "OH", "exact")
"""Test sets; ``exact`` are in-plane images without errors: the error of X alone."""


@dataclass(frozen=True)
class TankStudy(Grid):
    """The paper's experiment; conditions are tanks."""

    kind = Tank

    def arrays(self, chunk: Chunk) -> dict[str, ArraySpec]:
        """Precisions and errors; trials are the last axis of each array."""
        trials = chunk.stop - chunk.start
        arms = (len(SETS), len(METHODS), PERSONS)
        return {
            "rp": ArraySpec("mm", (*arms, len(TESTS), trials)),
            "own_rp": ArraySpec("mm", (PERSONS, len(TESTS), trials)),
            "rotation_error": ArraySpec("rad", (*arms, trials)),
            "translation_error": ArraySpec("mm", (*arms, trials)),
            "status": ArraySpec("1", (*arms, trials), "i"),
        }

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """Draw, calibrate from every set by every method, judge on every test set.

        Automatic sets have one segmentation: it is repeated in the place of every person's.
        ``own_rp`` is what the test sets say of the true X: their own scatter.
        """
        tank = self.conditions[chunk.condition]
        drawn = draw(tank, (self.seed,), range(chunk.start, chunk.stop))
        truth = drawn.image_to_probe
        tests = [by_person(drawn.sets.get(name, [drawn.exact])) for name in TESTS]
        found: dict[str, list] = {"rp": [], "rotation_error": [], "translation_error": []}
        status = []
        for name in SETS:
            people = drawn.sets[name]
            # One person at a time: every call then has as many problems, and runs one program.
            batches = [padded_problems(one.poses, one.points) for one in people]
            for arguments in METHODS.values():
                results = [calibrate_batch(batch, **arguments) for batch in batches]
                x = np.array([np.asarray(result.image_to_probe) for result in results])
                x = np.broadcast_to(x, (PERSONS, *x.shape[1:]))
                codes = np.array([np.asarray(result.status_code) for result in results])
                status.append(np.broadcast_to(codes, (PERSONS, codes.shape[1])))
                found["rp"].append(precisions(x, tests))
                found["rotation_error"].append(turns(x, truth))
                shift = x[..., :3, 3] - truth[:, :3, 3]
                found["translation_error"].append(np.linalg.norm(shift, axis=-1))
        arms = (len(SETS), len(METHODS))
        arrays: dict[str, np.ndarray] = {
            name: np.array(values).reshape(*arms, *np.shape(values)[1:])
            for name, values in found.items()
        }
        everybody = np.broadcast_to(truth, (PERSONS, *truth.shape))
        arrays["own_rp"] = precisions(everybody, tests)
        arrays["status"] = np.asarray(status, np.int32).reshape(*arms, PERSONS, -1)
        return arrays


def by_person(people: Sequence[Points]) -> list[Points]:
    """One set a person; an automatic one is everybody's."""
    return list(people) if len(people) == PERSONS else [people[0]] * PERSONS


def precisions(
    x: Float[np.ndarray, "persons t 4 4"], tests: Sequence[Sequence[Points]]
) -> Float[np.ndarray, "persons tests t"]:
    """Eq. 8 of everybody's X on everybody's own test sets, mm."""
    return np.array(
        [
            [precision(x[p], people[p].poses, people[p].points) for people in tests]
            for p in range(len(x))
        ]
    )


def turns(x: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Rotation error of every X, rad."""
    return np.array(
        [[rotation_angle(a, b) for a, b in zip(found, truth, strict=True)] for found in x]
    )
