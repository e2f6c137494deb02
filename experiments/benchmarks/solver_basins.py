"""From how far away do solves with given SDs reach the optimum?

The problems of solver_peers.py, 4,096 of them: ``jaxcal.backend.minimise`` from X turned and moved
by so much at random, and ``calibrate_batch``, which finds its own start. The table has the share of
the problems whose objective is within 1e-8 (relative) of where the descent from the truth ends.
Seed 20261125.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import peer_solvers as peers
from solver_peers import (
    AGREEMENT,
    Batch,
    Minimiser,
    Solved,
    arguments,
    calibrated,
    draw,
    load_of_the_machine,
    show,
    write_table,
)

STARTS = ((5, 5), (20, 20), (40, 20), (60, 20), (90, 20))
"""Degrees and mm off the truth."""
HEADER = [
    "degrees_off", "mm_off", "problems", "share_at_optimum", "not_finite", "iterations_median",
    "iterations_max", "gradient_cosine_max",
]  # fmt: skip


def main() -> None:
    quick, folder = arguments(__doc__)
    load, count = os.getloadavg()[0], 1024 if quick else 4096
    near = draw(count, 0.0, 0.0)
    solve = Minimiser.of(near)
    best, _ = peers.judge(near, solve(near))
    answers: list[tuple[list[object], Batch, Callable[[Batch], Solved]]]
    answers = [([*start], draw(count, *start), solve) for start in STARTS]
    answers.append((["calibrate_batch", ""], near, calibrated))
    rows: list[list[object]] = []
    for start, batch, solver in answers:
        solved = solver(batch)
        cost, cosine = peers.judge(near, solved)
        reached = float(np.mean(cost <= best * (1 + AGREEMENT)))
        rows.append([
            *start, count, reached, int(np.sum(~np.isfinite(cost))),
            float(np.median(solved.iterations)), int(solved.iterations.max()),
            float(np.nanmax(cosine)),
        ])  # fmt: skip
        show(rows[-1])
    foot = [load_of_the_machine(load)]
    write_table(folder / "solver_basins.csv", HEADER, [*rows, foot])


if __name__ == "__main__":
    main()
