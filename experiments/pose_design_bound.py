"""How far a plan is from the best set of poses that there can be.

Predicted TRE of 400 random sets of the candidates of pose_design.py, of the plan, and the bound
that no set of the candidates goes below (``jaxcal.design.least_error``). Seed 20261129.
"""

from __future__ import annotations

import numpy as np
from common import arguments, machine, show, write_table
from pose_design import CONES, COUNTS, POOL, SEED, planned, pool

from jaxcal import design
from jaxcal.design.criteria import curve
from jaxcal.runtime.jax_cache import enable_compilation_cache

RANDOM = 400
HEADER = [
    "cone", "images", "random_tre_mm", "planned_tre_mm", "least_tre_mm", "planned_over_random",
    "least_over_random",
]  # fmt: skip


def bounds() -> list[list[object]]:
    """Predicted TRE of random and planned poses, and what no set of the pool goes below."""
    rows: list[list[object]] = []
    for cone in CONES:
        candidates = pool(cone)
        known = design.plan(candidates, 4, polish=False).known
        for count in COUNTS:
            rng = np.random.default_rng([SEED, count])
            drawn = (
                candidates.poses[rng.choice(POOL, count, replace=False)] for _ in range(RANDOM)
            )
            squares = [curve(candidates, known, poses)[0][-1] ** 2 for poses in drawn]
            random = np.sqrt(np.mean(squares))
            least = design.least_error(candidates, count)
            mine = float(planned(cone, count).tre_mm[-1])
            rows.append([cone, count, random, mine, least, mine / random, least / random])
            show(rows[-1])
    return rows


def main() -> None:
    _, folder = arguments(__doc__)
    enable_compilation_cache()
    write_table(folder / "pose_design_bound.csv", HEADER, bounds())
    print(machine())


if __name__ == "__main__":
    main()
