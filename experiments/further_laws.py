"""Prior ``auto`` on distributions of the offsets that differ from those which it weighs.

Exponential, two-humped, drifting, outlying, off-centre and sometimes off-centre offsets
(:mod:`jaxcal.study.offsets`) for 8, 20 and 50 images and five pairs of size and noise, and the five
distributions of ``auto_grid`` for 8 images. On the same draws: conventional calibration, the
paper's alternation (1 mm), and the priors ``auto`` and ``gaussian``, from points with covariances
and from points alone (``auto_points``, ``gaussian_points``).

A cell in which a ratio that should be at most 1 is not is run again on ten times as many fresh
draws (``further_laws_again.csv``): a cell picked for being the worst of many says little alone.

Seed 20261124; trial k of a cell is fold_in(root, (1000 + cell) * 10^6 + k); the repetitions begin
at k = 500,000.
"""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
from auto_grid import COMPARED, SUBSET, Cell, run_cell
from common import LAWS, arguments, machine, write_rows

from jaxcal.runtime.jax_cache import enable_compilation_cache
from jaxcal.study.laws import OFFSET_LAWS

TRIALS, AGAIN = 400, 4000
FIRST = 1000
"""Cells are counted from here: ``auto_grid`` has those before."""
SIZES = (8, 20, 50)


def cells(quick: bool) -> list[Cell]:
    """Further distributions for all numbers of images, the others for the smallest."""
    sizes = SUBSET[1:3] if quick else SUBSET
    return [
        Cell(law, images, *size)
        for images, law in itertools.product(SIZES[:1] if quick else SIZES, OFFSET_LAWS)
        if law not in LAWS or images == SIZES[0]
        for size in sizes
    ]


def main() -> None:
    quick, folder = arguments(__doc__)
    trials, again = (50, 200) if quick else (TRIALS, AGAIN)
    enable_compilation_cache()
    todo = cells(quick)
    rows: list[dict[str, Any]] = []
    repeated: list[dict[str, Any]] = []
    for index, cell in enumerate(todo):
        if index and cell.images != todo[index - 1].images:
            jax.clear_caches()  # a process may map only so many compiled programs
        first = (FIRST + index) * 1_000_000
        rows.append(run_cell(cell, first + jnp.arange(trials), with_hindsight=False))
        write_rows(folder / "further_laws.csv", rows)
        told = ", ".join(f"{name} {rows[-1][name]:.4g}" for name in (*COMPARED, "auto_loses"))
        print(f"{cell}: {told}", flush=True)
        if any(rows[-1][name] > 1 for name in COMPARED):
            first += 500_000
            repeated.append(run_cell(cell, first + jnp.arange(again), with_hindsight=False))
            write_rows(folder / "further_laws_again.csv", repeated)
            print("again: " + ", ".join(
                f"{name} {repeated[-1][name]:.4f} +- {repeated[-1][f'{name}_ci95_half']:.4f}"
                for name in COMPARED
            ), flush=True)  # fmt: skip
    if not repeated:
        (folder / "further_laws_again.csv").unlink(missing_ok=True)
    for name in COMPARED:
        worst = max(range(len(rows)), key=lambda row, name=name: rows[row][name])
        print(f"{name}: worst {rows[worst][name]:.3f} ({todo[worst]})")
    print(machine())


if __name__ == "__main__":
    main()
