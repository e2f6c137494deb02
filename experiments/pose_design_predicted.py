"""Is the TRE that is predicted before any image the actual one?

Actual TRE of ``auto`` at planned and random poses (those of pose_design.py, with draws of their
own) against two predictions made before any image: that of simulated recordings under the
distribution (``design.simulate_errors``) and that of the plan, which knows the SDs only (the root
mean square over the sets for random poses). 4,000 recordings each (``--quick``: 24). Seed 20261129.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from common import LAWS, arguments, batch_of, machine, show, write_table
from pose_design import (
    ARMS,
    CONES,
    COUNTS,
    MOST,
    SEED,
    errors,
    planned,
    pool,
    pose_set,
    solve,
    taken,
)

from jaxcal import design
from jaxcal.design.criteria import curve
from jaxcal.runtime.jax_cache import enable_compilation_cache

SIMULATED = 4000
"""Recordings from which errors are predicted."""
HEADER = [
    "cone", "law", "poses", "images", "trials", "tre_mm", "tre_error_mm", "simulated_tre_mm",
    "simulated_tre_error_mm", "simulated_over_actual", "planned_tre_mm", "planned_over_actual",
]  # fmt: skip


def predictions(trials: int, folder: Path) -> None:
    """Actual TRE against what is predicted before any image; draws of its own."""
    rows: list[list[object]] = []
    for cone, count, arm in itertools.product(CONES, COUNTS, ("random", "optimal")):
        candidates = pool(cone)
        points = candidates.constraints.region.grid()
        tests = candidates.poses[:2]
        known = design.plan(candidates, 4, polish=False).known
        rng = np.random.default_rng([SEED, list(CONES).index(cone), count, ARMS.index(arm), 7])
        if arm == "optimal":
            foreseen = planned(cone, count).poses
            told = float(planned(cone, count).tre_mm[-1])
        else:
            foreseen = np.stack([pose_set(arm, cone, count, 0, rng) for _ in range(SIMULATED)])
            each = [curve(candidates, known, poses)[0][-1] ** 2 for poses in foreseen[:400]]
            told = float(np.sqrt(np.mean(each)))
        for law in LAWS:
            images = [taken(pose_set(arm, cone, count, k, rng), law, rng) for k in range(trials)]
            found = solve(batch_of(images, MOST), "auto")
            squared, _ = errors(np.asarray(found.image_to_probe), tests, points)
            tre = float(np.sqrt(squared.mean()))
            simulation = design.simulate_errors(
                foreseen, law, candidates, trials=SIMULATED, seed=count
            )
            rows.append([
                cone, law, arm, count, trials, tre,
                float(squared.std() / np.sqrt(trials) / 2 / tre), simulation.tre_mm,
                simulation.tre_error_mm, simulation.tre_mm / tre, told, told / tre,
            ])  # fmt: skip
            show(rows[-1])
    write_table(folder / "pose_design_predicted.csv", HEADER, rows)
    for name, column in (("simulated", 9), ("planned", 11)):
        ratios = np.array([row[column] for row in rows], float)
        within = int(np.sum(np.abs(ratios - 1) <= 0.1))
        print(f"{name} over actual: {ratios.min():.2f} to {ratios.max():.2f}, "
              f"within 10 % in {within} of {len(rows)} cells")  # fmt: skip


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    predictions(24 if quick else SIMULATED, folder)
    print(machine())


if __name__ == "__main__":
    main()
