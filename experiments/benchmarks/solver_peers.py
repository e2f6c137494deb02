"""The public calls against the solvers that people would otherwise use, in interleaved rounds.

One objective for all (peer_solvers.py): points with given SDs, n = 50 images, float64, offsets to
2 mm, 2 mm of noise on each element's distance. ``calibrate_batch`` finds its own start, and its
status and covariance are read; ``jaxcal.backend.minimise`` and the peers start at the same place: X
turned by 20 degrees about a random axis and moved by 20 mm, the target moved by 20 mm. Ceres also
starts at the conventional fit, which costs it nothing here; no peer computes a covariance. Beside
them other public calls, whose objectives are their own: REML, auto, the alternation, bounded
offsets, pixels of unknown scale, channels (32 elements). Everything runs pinned to one core; each
solver takes its share of the problems in each round, and ratios are medians over the rounds. The
table counts the problems whose objective is within 1e-8 (relative) of the lowest that any found.

Ceres needs cmake, a C++ compiler and Ceres 2.1; without them only ``--quick`` runs, which leaves it
out. Seed 20261125.
"""

from __future__ import annotations

import csv
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before JAX counts the cores
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
import peer_solvers as peers  # noqa: E402
import public_calls  # noqa: E402
from common import (  # noqa: E402
    arguments,
    batch_of,
    experiments,
    machine,
    save_figure,
    show,
    write_table,
)
from peer_solvers import Batch, Solved  # noqa: E402

import jaxcal  # noqa: E402
from jaxcal.backend import RIGID, ImagePlanes, Iterate, Parameters, Points, minimise  # noqa: E402
from jaxcal.runtime.compiler import fast_to_run  # noqa: E402

SEED = 20261125
SIGMA_MM = public_calls.SIGMA
AGREEMENT = 1e-8
ELEVATION_MM, NOISE_MM = 2.0, 2.0
IMAGES, BATCH_SIZE = 50, 64
JUDGED = 512
"""Answers of each solver that are judged."""

CALIBRATE, MINIMISE = "calibrate_batch, given SDs", "backend.minimise, given SDs"
SCHUR = "Ceres DENSE_SCHUR, 1e-9"
FAR, SCRATCH, FITTED = "20 degrees, 20 mm off", "none", "conventional fit"
"""Starts."""


def draw(count: int, degrees: float, millimetres: float) -> Batch:
    """Problems with starts so far from the truth."""
    protocol = jaxcal.Protocol(
        images=IMAGES, elevation_mm=ELEVATION_MM, noise_mm=NOISE_MM, test_images=2
    )
    drawn = experiments(SEED, jnp.arange(count), protocol)
    poses, points, matrix, point = (
        np.array(part) for part in (drawn.poses, drawn.points, drawn.image_to_probe, drawn.point)
    )
    random = np.random.default_rng(SEED)
    direction = random.normal(size=(3, count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    turn = Rotation.from_rotvec(np.radians(degrees) * direction[0]).as_matrix()
    matrix[:, :3, :3] = matrix[:, :3, :3] @ turn
    matrix[:, :3, 3] += millimetres * direction[1]
    return Batch(poses, points, matrix, point + millimetres * direction[2], SIGMA_MM)


def problems_of(batch: Batch) -> jaxcal.Problem:
    """As jaxcal takes them, on the device."""
    return batch_of(list(zip(batch.poses, batch.points, strict=True)), IMAGES)


def read(problems: jaxcal.Problem, **keywords: Any) -> tuple[jaxcal.Calibration, float]:
    """``calibrate_batch`` with its status and covariance read, and the seconds that it took."""
    begun = time.perf_counter()
    found = jaxcal.calibrate_batch(problems, **keywords)
    status, _ = found.status, np.asarray(found.covariance)
    seconds = time.perf_counter() - begun
    if np.mean(status == "converged") < 0.9:
        raise SystemExit(f"{keywords}: {np.unique(status, return_counts=True)}")
    return found, seconds


def calibrated(batch: Batch) -> Solved:
    """``calibrate_batch`` with given SDs."""
    problems = jax.block_until_ready(problems_of(batch))
    found, seconds = read(problems, sigma=SIGMA_MM)
    parts = (found.image_to_probe, found.point, found.convergence.iterations)
    matrix, point, iterations = (np.asarray(part, float) for part in parts)
    return Solved(matrix, point, iterations, seconds)


@dataclass(frozen=True)
class Minimiser:
    """``jaxcal.backend.minimise`` from the batch's starts, compiled for batches of one size."""

    program: Any

    @classmethod
    def of(cls, batch: Batch) -> Minimiser:
        """Compile, with the flags that jaxcal compiles its own batches with."""
        size = min(BATCH_SIZE, len(batch))
        if len(batch) % size:
            raise ValueError(f"{len(batch)} problems are no multiple of {size}")

        def solve(part: tuple) -> tuple:
            problems, matrix, point = part
            start = jax.vmap(Parameters.of)(matrix[:, :3, :3], matrix[:, :3, 3], point)
            points = Points(jnp.tile(jnp.asarray(SIGMA_MM)[:, None], size))
            fit = minimise(Iterate.of(start, RIGID), points, ImagePlanes.of(problems))
            found = fit.iterate.parameters()
            return jax.vmap(Parameters.matrix)(found), found.point, fit.iterations

        def whole(*parts):
            def split(leaf):
                return leaf.reshape(-1, size, *leaf.shape[1:])

            done = jax.lax.map(solve, jax.tree.map(split, parts))
            return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), done)

        parts = (problems_of(batch), jnp.asarray(batch.matrix), jnp.asarray(batch.point))
        options = fast_to_run(jax.default_backend())
        return cls(jax.jit(whole).lower(*parts).compile(compiler_options=options))

    def __call__(self, batch: Batch) -> Solved:
        """Solve, timed without the copies to and from JAX."""
        parts = (problems_of(batch), jnp.asarray(batch.matrix), jnp.asarray(batch.point))
        jax.block_until_ready(parts)
        begun = time.perf_counter()
        done = jax.block_until_ready(self.program(*parts))
        seconds = time.perf_counter() - begun
        matrix, point, iterations = (np.asarray(part) for part in done)
        return Solved(matrix, point, iterations, seconds)


@dataclass(frozen=True)
class Contestant:
    """Who solves.

    Attributes:
        solve: a batch of the common problems; None: their objective is their own.
        call: seconds of one call on problems of their own.
        start: where they begin.
        count: problems in a round.
    """

    solve: Callable[[Batch], Solved] | None
    call: Callable[[], float] | None
    start: str
    count: int


def from_conventional(batch: Batch) -> Batch:
    """The same problems, started at their conventional fits."""
    fit = jaxcal.calibrate_batch(problems_of(batch), "conventional")
    return replace(batch, matrix=np.array(fit.image_to_probe), point=np.array(fit.point))


def contestants(quick: bool) -> dict[str, Contestant]:
    """Every solver at hand, and how many problems it gets in a round.

    Raises:
        SystemExit: Ceres is not at hand, and all are wanted: the table would be kept without it.
    """
    few = 4 if quick else 1
    most = 4096 // few

    def ours(name: str) -> Contestant:
        kind, keywords = public_calls.METHODS[name]
        count = public_calls.CHANNEL_PROBLEMS if kind == "channels" else public_calls.PROBLEMS
        problems = public_calls.draw(kind, count // few)
        return Contestant(None, lambda: read(problems, **keywords)[1], SCRATCH, count // few)

    batch = draw(most, 20.0, 20.0)
    found = {
        CALIBRATE: Contestant(calibrated, None, SCRATCH, most),
        MINIMISE: Contestant(Minimiser.of(batch), None, FAR, most),
    }
    program = peers.build_ceres()
    if isinstance(program, str):
        if not quick:
            raise SystemExit(f"{program}: only --quick does without Ceres")
        print(f"Ceres is left out: {program}", flush=True)
    else:
        for name, solver, tolerance in (
            (SCHUR, "schur", 1e-9),
            ("Ceres DENSE_SCHUR, 1e-13", "schur", 1e-13),
            ("Ceres DENSE_NORMAL_CHOLESKY, 1e-9", "normal", 1e-9),
            ("Ceres TinySolver, 1e-9", "tiny", 1e-9),
        ):
            solve = peers.ceres_solver(program, solver, tolerance)
            found[name] = Contestant(solve, None, FAR, 512 // few)
            if tolerance == 1e-9:
                fitted = f"{name}, from the conventional fit"
                found[fitted] = Contestant(solve, None, FITTED, 512 // few)
    for name, solve, count in (
        ("scipy lm", peers.scipy_solver("lm"), 64),
        ("scipy lm, 1e-8 (its default)", peers.scipy_solver("lm", 1e-8), 64),
        (
            "scipy lm, 1e-8, numerical Jacobian (its default)",
            peers.scipy_solver("lm", 1e-8, exact=False),
            32,
        ),
        ("scipy trf", peers.scipy_solver("trf"), 32),
        (
            "optimistix LM, vmapped, 1e-8",
            peers.optimistix_solver(batch.first(512 // few), 1e-8),
            512,
        ),
        (
            "optimistix LM, vmapped, 1e-3",
            peers.optimistix_solver(batch.first(512 // few), 1e-3),
            512,
        ),
    ):
        found[name] = Contestant(solve, None, FAR, count // few)
    if peers.missing("pyceres"):
        print("pyceres is left out: not installed", flush=True)
    else:
        found["pyceres, numpy cost"] = Contestant(peers.pyceres_solver, None, FAR, 32 // few)
    others = [name for name in public_calls.METHODS if name != "given SDs"]
    return found | {f"calibrate_batch, {name}": ours(name) for name in others}


def race(solvers: dict[str, Contestant], rounds: int) -> list[list[object]]:
    """Interleaved rounds of every solver on one set of problems; a row of the table each."""
    far = draw(max(one.count for one in solvers.values()), 20.0, 20.0)
    batches = {FAR: far, SCRATCH: far, FITTED: from_conventional(far)}
    rates: dict[str, list[float]] = {name: [] for name in solvers}
    last: dict[str, Solved] = {}
    for number in range(-1, rounds):  # the first one compiles
        for name, one in solvers.items():
            if one.solve is not None:
                last[name] = one.solve(batches[one.start].first(one.count))
                seconds = last[name].seconds
            else:
                assert one.call is not None
                seconds = one.call()
            if number >= 0:
                rates[name].append(one.count / seconds)
        print(f"round {number + 1} of {rounds}", flush=True)
    judged = {name: peers.judge(far, _first(solved)) for name, solved in last.items()}
    lowest = np.full(JUDGED, np.inf)
    for cost, _ in judged.values():
        lowest[: len(cost)] = np.fmin(lowest[: len(cost)], cost)
    ours, schur = np.array(rates[CALIBRATE]), rates.get(SCHUR)
    rows: list[list[object]] = []
    for name, one in solvers.items():
        mine = np.array(rates[name])
        ratios = [ours / mine, mine / np.array(schur) if schur else np.full(rounds, np.nan)]
        row: list[object] = [name, one.start, IMAGES, one.count]
        row += [float(value) for value in (np.median(mine), mine.min(), mine.max())]
        row += [1e6 / float(np.median(mine))]
        for ratio in ratios:
            row += [float(value) for value in (np.median(ratio), ratio.min(), ratio.max())]
        if name in judged:
            cost, cosine = judged[name]
            excess = cost / lowest[: len(cost)] - 1
            row += [float(np.mean(last[name].iterations)), len(cost)]
            row += [int(np.sum(excess <= AGREEMENT)), float(np.max(excess))]
            row += [float(np.median(cosine)), float(cosine.max())]
        else:
            row += ["its own objective"] + [""] * 5
        rows.append(row)
    return rows


HEADER = [
    "solver", "start", "images", "problems_a_round", "solves_per_s_median", "solves_per_s_min",
    "solves_per_s_max", "us_per_problem", "calibrate_batch_over_it_median",
    "calibrate_batch_over_it_min", "calibrate_batch_over_it_max", "it_over_dense_schur_median",
    "it_over_dense_schur_min", "it_over_dense_schur_max", "iterations_mean", "problems_judged",
    "at_the_lowest_objective", "largest_relative_excess", "gradient_cosine_median",
    "gradient_cosine_max",
]  # fmt: skip


def _first(solved: Solved) -> Solved:
    names = ("matrix", "point", "iterations")
    return replace(solved, **{name: getattr(solved, name)[:JUDGED] for name in names})


def figure(folder: Path) -> None:
    """Solves a second of every solver, from the table."""
    from matplotlib.figure import Figure

    with (folder / "solver_peers.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))[-2::-1]  # the last one says what machine it was
    drawing = Figure(figsize=(8, 5.5), layout="constrained")
    axes = drawing.subplots()
    speed = [float(row["solves_per_s_median"]) for row in rows]
    bars = axes.barh([row["solver"] for row in rows], speed, color="tab:blue")
    axes.bar_label(bars, fmt="%.3g", padding=3, fontsize="small")
    axes.tick_params(axis="y", labelsize="small")
    axes.set(xscale="log", xlabel=f"solves/s, one core, n = {IMAGES}, float64")
    axes.set_xlim(right=1e6)
    save_figure(drawing, folder / "solver_peers.png", dpi=110)


def load_of_the_machine(before: float) -> str:
    """For a table's foot."""
    return f"{machine()}; load average {before:.1f} before and {os.getloadavg()[0]:.1f} after"


def main() -> None:
    quick, folder = arguments(__doc__)
    load = os.getloadavg()[0]
    rows = race(contestants(quick), 3 if quick else 15)
    write_table(folder / "solver_peers.csv", HEADER, [*rows, [load_of_the_machine(load)]])
    for row in rows:
        show(row)
    figure(folder)


if __name__ == "__main__":
    main()
