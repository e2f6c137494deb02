"""What the experiments share: where results go, how they are written, and what machine it was."""

from __future__ import annotations

import argparse
import csv
import os
import platform
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import jax

from jaxcal.io.atomic import atomic_path
from jaxcal.study.laws import OffsetLaw

# The scripts' own arrays; jaxcal computes in 64 bits anyway.
jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parent / "results"

ELEVATIONS_MM = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
NOISES_MM = (0.0, 0.5, 2.0, 4.0, 6.0, 8.0, 10.0)
"""The grid of the paper's Tables 1 and 2."""

LAWS: tuple[OffsetLaw, ...] = ("uniform", "normal", "one-sided", "heavy-tailed", "triangular")
"""Of the offsets, in most experiments."""


def arguments(description: str) -> argparse.Namespace:
    """Parse ``--quick``."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="few trials; minutes on two cores")
    return parser.parse_args()


def results_folder(quick: bool) -> Path:
    """The folder for tables and figures, made if need be."""
    folder = RESULTS / "quick" if quick else RESULTS
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_table(path: Path, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV whole or not at all; floats with six significant digits."""
    with atomic_path(path) as temporary, temporary.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        for row in rows:
            writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in row])


def machine() -> str:
    """Processor, cores and versions, for a table's foot."""
    import jax

    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if os.name == "posix" else ():
        if line.startswith("model name"):
            model = line.split(":", 1)[1].strip()
            break
    cores, python = os.cpu_count(), platform.python_version()
    return f"{model}, {cores} cores, Python {python}, jax {jax.__version__}"


def open_study(name: str, *, trials: int | None, quick: bool):
    """Run (or go on with) the study ``name``.toml and open its results.

    Args:
        name: of the spec beside this file.
        trials: in each condition, instead of the spec's.
        quick: the quick one has a folder of its own.
    """
    from jaxcal.runtime.jax_cache import enable_compilation_cache
    from jaxcal.study import load_spec, open_results, run_study

    here = Path(__file__).parent
    spec = load_spec(here / f"{name}.toml")
    if trials is not None:
        spec = replace(spec, trials=trials, chunk_trials=min(trials, spec.chunk_trials))
    enable_compilation_cache()
    folder = here / "studies" / (f"{name}_quick" if quick else name)
    summary = run_study(spec, folder, resume=True, watcher=Lines())
    if summary.trials:
        print(f"{name}: {summary.trials} trials in {summary.seconds:.0f} s")
    return open_results(folder)


class Lines:
    """Tells now and then how far a study is."""

    def begin(self, trials: int, done: int) -> None:
        """Start counting."""
        self._trials, self._done, self._told = trials, done, time.monotonic()

    def advance(self, trials: int) -> None:
        """Count."""
        self._done += trials
        if time.monotonic() - self._told > 30:
            self._told = time.monotonic()
            print(f"{self._done} of {self._trials} trials", flush=True)

    def note(self, message: str) -> None:
        """Pass on."""
        print(message, flush=True)
