"""How the parts of the paper's experiment run, and where their results go."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import Lines, results_folder, write_table
from tank_grid import Grid, read_all

from jaxcal.runtime.jax_cache import enable_compilation_cache
from jaxcal.study import run_study

SEED = 20261122
TRIALS, QUICK_TRIALS = 128, 16
CHUNK = 64
PARTS = ("validation", "table4", "sensitivity", "planning", "bounds")


@dataclass(frozen=True)
class Run:
    """What was asked for on the command line.

    Attributes:
        quick: few experiments.
        workers: processes; 0: this one.
        dask: address of a scheduler, or None.
    """

    quick: bool = False
    workers: int = 0
    dask: str | None = None

    @property
    def trials(self) -> int:
        """Experiments in a cell."""
        return QUICK_TRIALS if self.quick else TRIALS

    @property
    def folder(self) -> Path:
        """For tables and figures."""
        return results_folder(self.quick)

    def study(self, name: str, grid: Grid) -> dict[str, np.ndarray]:
        """Compute what is missing of a study, and read all of it."""
        enable_compilation_cache()
        folder = Path(__file__).parent / "studies" / (f"{name}_quick" if self.quick else name)
        summary = run_study(
            grid, folder, resume=True, workers=self.workers, scheduler=self.dask, watcher=Lines()
        )
        if summary.trials:
            print(f"{name}: {summary.trials} experiments in {summary.seconds:.0f} s", flush=True)
        return read_all(folder, grid)

    def statements(self, part: str, rows: list[list[str]]) -> None:
        """Put what a part found out into the table of statements, instead of what it had.

        Args:
            part: of the experiment.
            rows: section, statement, verdict, evidence.
        """
        path = self.folder / "paper_experiment_statements.csv"
        kept: list[list[str]] = []
        if path.exists():
            with path.open(newline="") as stream:
                kept = [row for row in list(csv.reader(stream))[1:] if row[0] != part]
        for section, statement, verdict, evidence in rows:
            print(f"{section}: {verdict}: {statement}: {evidence}", flush=True)
        together = sorted(
            kept + [[part, *row] for row in rows], key=lambda row: PARTS.index(row[0])
        )
        write_table(path, ["part", "section", "statement", "verdict", "evidence"], together)

    def grid(self, kind: type[Grid], conditions: tuple) -> Grid:
        """A grid with this run's seed and trials."""
        return kind(SEED, self.trials, min(CHUNK, self.trials), conditions)
