"""What the experiments share: where results go, how they are written, and what machine it was."""

from __future__ import annotations

import argparse
import csv
import os
import platform
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxcal import Problem, Protocol, reconstruction_precision, simulate
from jaxcal.io.atomic import atomic_path
from jaxcal.report.svg import ink
from jaxcal.study.laws import LawName
from jaxcal.study.simulation import NUMBERS, Experiment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# The scripts' own arrays; jaxcal computes in 64 bits anyway.
jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parent / "results"

ELEVATIONS_MM = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
NOISES_MM = (0.0, 0.5, 2.0, 4.0, 6.0, 8.0, 10.0)
"""The grid of the paper's Tables 1 and 2."""

LAWS: tuple[LawName, ...] = ("uniform", "normal", "one-sided", "heavy-tailed", "triangular")
"""Distributions of the offsets in most experiments."""

POINTS_MM = np.stack(
    np.meshgrid(np.linspace(-20, 20, 5), np.linspace(20, 80, 4), indexing="ij"), axis=-1
).reshape(-1, 2)
"""Lateral positions and depths at which stated and actual errors are compared."""


def arguments(description: str | None) -> tuple[bool, Path]:
    """Whether ``--quick`` was asked for, and the folder for its results."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="few trials; minutes on two cores")
    quick = parser.parse_args().quick
    return quick, results_folder(quick)


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


def write_rows(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """As :func:`write_table`, from rows whose keys are the columns."""
    write_table(path, rows[0], [row.values() for row in rows])


def read_rows(path: Path) -> list[dict[str, Any]]:
    """What :func:`write_rows` wrote, numbers as such: to draw a figure again without its script."""
    with path.open(newline="") as stream:
        return [
            {name: _number(cell) for name, cell in row.items()} for row in csv.DictReader(stream)
        ]


def _number(cell: str) -> float | str:
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


def show(row: Iterable[object]) -> None:
    """Print a row with short numbers."""
    print(*(f"{v:.4g}" if isinstance(v, float) else v for v in row), sep=", ", flush=True)


def save_figure(figure: Figure, path: Path, dpi: int) -> None:
    """Write a figure whole or not at all."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi)


def plain_ticks(axis: Axis, values: Sequence[float]) -> None:
    """Mark these values in plain numbers, as an axis with a logarithmic scale does not."""
    axis.set_ticks(list(values), [f"{value:g}" for value in values])
    axis.set_minor_formatter("")


def grid_panel(panel: Axes, grid: Float[np.ndarray, "elevations noises"], half: float) -> None:
    """Draw ratios on the paper's grid with their numbers; colours go from 1 - half to 1 + half.

    Args:
        panel: where.
        grid: a row for each of the last elevations, a column for each noise; NaN for none.
        half: of the range of colours.
    """
    from matplotlib.colors import to_hex

    image = panel.imshow(grid, cmap="RdBu_r", vmin=1 - half, vmax=1 + half, origin="lower")
    for i, j in np.argwhere(np.isfinite(grid)):
        red, green, blue, _ = image.to_rgba(grid[i, j])
        panel.text(
            j, i, f"{grid[i, j]:.2f}", ha="center", va="center", fontsize="small",
            color=ink(to_hex((red, green, blue))),
        )  # fmt: skip
    panel.set_xticks(range(len(NOISES_MM)), [f"{noise:g}" for noise in NOISES_MM])
    panel.set_yticks(range(len(grid)), [f"{size:g}" for size in ELEVATIONS_MM[-len(grid) :]])
    panel.set(xlabel="noise on each distance, SD (mm)", ylabel="size of the offsets (mm)")


def experiments(seed: int, indices: Array, protocol: Protocol) -> Experiment:
    """Simulated experiments: trial k is drawn from fold_in(key(seed), k).

    The tracker is perfect. Protocols that differ in numbers only share one compiled program.
    """
    names = [name for name in NUMBERS if not name.startswith("tracker")]
    numbers = {name: getattr(protocol, name) for name in names}
    usual = replace(protocol, **{name: getattr(Protocol, name) for name in names})
    return _experiments(seed, usual, indices, numbers)


@partial(jax.jit, static_argnums=(0, 1))
def _experiments(
    seed: int, protocol: Protocol, indices: Array, numbers: dict[str, Any]
) -> Experiment:
    protocol = replace(protocol, **numbers)
    root = jax.random.key(seed)
    return jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol))(indices)


def problems_of(drawn: Experiment, *, covariances: bool) -> Problem:
    """The problems of a batch of experiments.

    Args:
        drawn: by :func:`experiments`.
        covariances: with those of the points; without noise these are zero, and are left away.
    """
    problems = jax.vmap(lambda experiment: experiment.problem())(drawn)
    if covariances and np.any(np.asarray(drawn.covariance)):
        return replace(problems, covariance=drawn.covariance)
    return problems


def precision(
    x: Float[Array | np.ndarray, "t 4 4"],
    poses: Float[Array | np.ndarray, "t n 4 4"],
    points: Float[Array | np.ndarray, "t n 2"],
) -> Float[np.ndarray, " t"]:
    """Eq. 8 of every trial's X on its own test images, mm."""
    return np.asarray(_precision(x, poses, points))


_precision = jax.jit(jax.vmap(reconstruction_precision))


def right_errors(
    estimate: Float[np.ndarray, "t 4 4"], truth: Float[np.ndarray, "t 4 4"]
) -> Float[np.ndarray, "t 6"]:
    """Right perturbations [shift, turn] from estimates to truths, mm and rad."""
    inverse = estimate[:, :3, :3].swapaxes(1, 2)
    turn = Rotation.from_matrix(inverse @ truth[:, :3, :3]).as_rotvec()
    shift = np.einsum("kij,kj->ki", inverse, truth[:, :3, 3] - estimate[:, :3, 3])
    return np.concatenate([shift, turn], axis=1)


def point_errors(
    estimate: Float[np.ndarray, "t 4 4"], truth: Float[np.ndarray, "t 4 4"]
) -> Float[np.ndarray, "t points"]:
    """How far the points of :data:`POINTS_MM` are off, mm."""
    lateral, depth = POINTS_MM.T
    there = np.stack([lateral, 0 * lateral, depth, np.ones(len(POINTS_MM))])
    return np.linalg.norm(((estimate - truth) @ there)[:, :3], axis=1)


def rms(values: np.ndarray, axis: int | None = None):
    """Root mean square of what is known, along an axis or of all."""
    return np.sqrt(np.nanmean(np.square(values), axis=axis))


def half_95(values: np.ndarray) -> float:
    """Half the 95 % interval of the mean of independent values."""
    return float(1.96 * values.std(ddof=1) / np.sqrt(len(values)))


def paired_ratio(values: np.ndarray, to: np.ndarray) -> tuple[float, float]:
    """Ratio of the means of paired trials, and half its 95 % interval (linearised)."""
    quotient = float(values.mean() / to.mean())
    apart = values - quotient * to
    return quotient, half_95(apart) / float(to.mean())


def batch_of(
    sets: Sequence[tuple[np.ndarray, np.ndarray]], most: int, bounds: np.ndarray | None = None
) -> Problem:
    """Problems side by side; those with fewer images have masked ones in their place.

    Args:
        sets: of each problem, poses (n, 4, 4) and points [lateral, range] (n, 2), mm.
        most: images of every problem of the batch.
        bounds: on the offsets of the images, (problems, n), mm.
    """
    count = len(sets)
    poses = np.tile(np.eye(4), (count, most, 1, 1))
    points, mask = np.ones((count, most, 2)), np.zeros((count, most))
    for k, (some, where) in enumerate(sets):
        poses[k, : len(some)], points[k, : len(some)], mask[k, : len(some)] = some, where, 1.0
    limits = None
    if bounds is not None:
        limits = jnp.pad(bounds, [(0, 0), (0, most - bounds.shape[1])], constant_values=1.0)
    return Problem(
        poses=jnp.asarray(poses),
        measurements=jnp.asarray(points),
        mask=jnp.asarray(mask),
        spacing=jnp.ones((count, 2)),
        face_offset=jnp.zeros(count),
        max_elevation=limits,
    )


def machine() -> str:
    """Processor, cores and versions, printed at the end of a run."""
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
