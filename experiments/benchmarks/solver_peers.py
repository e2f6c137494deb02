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

Further tables: from how far the optimum is reached; scaling with images, batch and chunk, float32;
cores; one warm problem. ``--part`` runs one of them alone; the figure is drawn from the tables that
are there. Seed 20261125.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import IO, Any

CORES = sorted(os.sched_getaffinity(0))
if "--devices" not in sys.argv:
    os.sched_setaffinity(0, {CORES[0]})  # before JAX counts them
    os.environ["BENCHMARK_CORES"] = ",".join(map(str, CORES))
else:
    # A process inherits the one core of the one that started it.
    os.sched_setaffinity(0, {int(core) for core in os.environ["BENCHMARK_CORES"].split(",")})
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
import peer_solvers as peers  # noqa: E402
import public_calls  # noqa: E402
from common import machine, results_folder, write_table  # noqa: E402
from peer_solvers import Batch, Solved  # noqa: E402

import jaxcal  # noqa: E402
from jaxcal.backend import RIGID, ImagePlanes, Iterate, Parameters, Points, minimise  # noqa: E402
from jaxcal.io.atomic import atomic_path  # noqa: E402
from jaxcal.runtime.compiler import fast_to_run  # noqa: E402

SEED = 20261125
SIGMA_MM = public_calls.SIGMA
AGREEMENT = 1e-8
ELEVATION_MM, NOISE_MM = 2.0, 2.0
LANES = 64
JUDGED = 512
"""Answers of each solver that are judged."""

CALIBRATE, MINIMISE = "calibrate_batch, given SDs", "backend.minimise, given SDs"
SCHUR = "Ceres DENSE_SCHUR, 1e-9"
FAR, SCRATCH, FITTED = "20 degrees, 20 mm off", "none", "conventional fit"
"""Starts."""


def draw(count: int, images: int, degrees: float, millimetres: float) -> Batch:
    """Problems with starts so far from the truth."""
    protocol = jaxcal.Protocol(
        images=images, elevation_mm=ELEVATION_MM, noise_mm=NOISE_MM, test_images=2
    )
    root = jax.random.key(SEED)

    @jax.jit
    def one(indices):
        def trial(index):
            drawn = jaxcal.simulate(jax.random.fold_in(root, index), protocol)
            return drawn.poses, drawn.points, drawn.image_to_probe, drawn.point

        return jax.lax.map(trial, indices, batch_size=64)

    poses, points, matrix, point = (np.array(part) for part in one(jnp.arange(count)))
    random = np.random.default_rng(SEED)
    direction = random.normal(size=(3, count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    turn = Rotation.from_rotvec(np.radians(degrees) * direction[0]).as_matrix()
    matrix[:, :3, :3] = matrix[:, :3, :3] @ turn
    matrix[:, :3, 3] += millimetres * direction[1]
    return Batch(poses, points, matrix, point + millimetres * direction[2], SIGMA_MM)


def problems_of(batch: Batch) -> jaxcal.Problem:
    """As jaxcal takes them, on the device."""
    count, images = batch.points.shape[:2]
    return jaxcal.Problem(
        poses=jnp.asarray(batch.poses),
        measurements=jnp.asarray(batch.points),
        mask=jnp.ones((count, images)),
        spacing=jnp.ones((count, 2)),
        face_offset=jnp.zeros(count),
    )


def read(problems: jaxcal.Problem, **keywords: Any) -> tuple[jaxcal.Calibration, float]:
    """``calibrate_batch`` with its status and covariance read, and the seconds that it took."""
    begun = time.perf_counter()
    found = jaxcal.calibrate_batch(problems, **keywords)
    status, _ = found.status, np.asarray(found.covariance)
    seconds = time.perf_counter() - begun
    if np.mean(status == "converged") < 0.9:
        raise SystemExit(f"{keywords}: {np.unique(status, return_counts=True)}")
    return found, seconds


def calibrated(batch: Batch, **keywords: Any) -> Solved:
    """``calibrate_batch`` with given SDs."""
    problems = jax.block_until_ready(problems_of(batch))
    found, seconds = read(problems, sigma=SIGMA_MM, **keywords)
    parts = (found.image_to_probe, found.point, found.iterations)
    matrix, point, iterations = (np.asarray(part, float) for part in parts)
    return Solved(matrix, point, iterations, seconds)


@dataclass(frozen=True)
class Minimiser:
    """``jaxcal.backend.minimise`` from the batch's starts, compiled for batches of one size."""

    program: Any

    @classmethod
    def of(cls, batch: Batch) -> Minimiser:
        """Compile, with the flags that jaxcal compiles its own batches with."""
        lanes = min(LANES, len(batch))
        if len(batch) % lanes:
            raise ValueError(f"{len(batch)} problems are no multiple of {lanes}")

        def solve(part: tuple) -> tuple:
            problems, matrix, point = part
            start = jax.vmap(Parameters.of)(matrix[:, :3, :3], matrix[:, :3, 3], point)
            points = Points(jnp.tile(jnp.asarray(SIGMA_MM)[:, None], lanes))
            fit = minimise(Iterate.of(start, RIGID), points, ImagePlanes.of(problems))
            found = fit.place.parameters()
            return jax.vmap(Parameters.matrix)(found), found.point, fit.iterations

        def whole(*parts):
            def split(leaf):
                return leaf.reshape(-1, lanes, *leaf.shape[1:])

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


@cache
def ceres_program() -> Path | None:
    """The compiled C++ peers, or None, with the reason told."""
    program = peers.build_ceres()
    if isinstance(program, str):
        print(f"Ceres is left out: {program}", flush=True)
        return None
    return program


def contestants(quick: bool, images: int) -> dict[str, Contestant]:
    """Every solver at hand, and how many problems it gets in a round."""
    few = 4 if quick else 1
    most = max(LANES, 4096 // few * 50 // images // LANES * LANES)

    def share(count: int) -> int:
        return max(4, count // few * 50 // images)

    def ours(name: str) -> Contestant:
        kind, keywords = public_calls.METHODS[name]
        count = public_calls.CHANNEL_PROBLEMS if kind == "channels" else public_calls.PROBLEMS
        problems = public_calls.draw(kind, count // few)
        return Contestant(None, lambda: read(problems, **keywords)[1], SCRATCH, count // few)

    batch = draw(most, images, 20.0, 20.0)
    found = {
        CALIBRATE: Contestant(calibrated, None, SCRATCH, most),
        MINIMISE: Contestant(Minimiser.of(batch), None, FAR, most),
    }
    program = ceres_program()
    if program is not None:
        for name, solver, tolerance in (
            (SCHUR, "schur", 1e-9),
            ("Ceres DENSE_SCHUR, 1e-13", "schur", 1e-13),
            ("Ceres DENSE_NORMAL_CHOLESKY, 1e-9", "normal", 1e-9),
            ("Ceres TinySolver, 1e-9", "tiny", 1e-9),
        ):
            solve = peers.ceres_solver(program, solver, tolerance)
            found[name] = Contestant(solve, None, FAR, share(512))
            if tolerance == 1e-9:
                fitted = f"{name}, from the conventional fit"
                found[fitted] = Contestant(solve, None, FITTED, share(512))
    if images > 50:
        return found
    for name, solve, count in (
        ("scipy lm", peers.scipy_solver("lm"), 64),
        ("scipy lm, 1e-8 (its default)", peers.scipy_solver("lm", 1e-8), 64),
        (
            "scipy lm, 1e-8, numerical Jacobian (its default)",
            peers.scipy_solver("lm", 1e-8, exact=False),
            32,
        ),
        ("scipy trf", peers.scipy_solver("trf"), 32),
        ("optimistix LM, vmapped", peers.optimistix_solver(batch.first(share(512))), 512),
    ):
        found[name] = Contestant(solve, None, FAR, share(count))
    if peers.missing("pyceres"):
        print("pyceres is left out: not installed", flush=True)
    else:
        found["pyceres, numpy cost"] = Contestant(peers.pyceres_solver, None, FAR, share(32))
    others = [name for name in public_calls.METHODS if name != "given SDs"]
    return found | {f"calibrate_batch, {name}": ours(name) for name in others}


def race(images: int, rounds: int, quick: bool) -> list[list[object]]:
    """Interleaved rounds of every solver on one set of problems; a row of the table each."""
    solvers = contestants(quick, images)
    far = draw(max(one.count for one in solvers.values()), images, 20.0, 20.0)
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
        print(f"n = {images}: round {number + 1} of {rounds}", flush=True)
    judged = {name: peers.judge(far, _first(solved)) for name, solved in last.items()}
    lowest = np.full(JUDGED, np.inf)
    for cost, _ in judged.values():
        lowest[: len(cost)] = np.fmin(lowest[: len(cost)], cost)
    ours, schur = np.array(rates[CALIBRATE]), rates.get(SCHUR)
    rows: list[list[object]] = []
    for name, one in solvers.items():
        mine = np.array(rates[name])
        ratios = [ours / mine, mine / np.array(schur) if schur else np.full(rounds, np.nan)]
        row: list[object] = [name, one.start, images, one.count]
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


RACE_HEADER = (
    "solver",
    "start",
    "images",
    "problems_a_round",
    "solves_per_s_median",
    "solves_per_s_min",
    "solves_per_s_max",
    "us_per_problem",
    "calibrate_batch_over_it_median",
    "calibrate_batch_over_it_min",
    "calibrate_batch_over_it_max",
    "it_over_dense_schur_median",
    "it_over_dense_schur_min",
    "it_over_dense_schur_max",
    "iterations_mean",
    "problems_judged",
    "at_the_lowest_objective",
    "largest_relative_excess",
    "gradient_cosine_median",
    "gradient_cosine_max",
)


def _first(solved: Solved) -> Solved:
    names = ("matrix", "point", "iterations")
    return replace(solved, **{name: getattr(solved, name)[:JUDGED] for name in names})


def basins(count: int) -> list[list[object]]:
    """From how far away the optimum is reached: share of problems, against starts at the truth."""
    rows: list[list[object]] = []
    near = draw(count, 50, 0.0, 0.0)
    solve = Minimiser.of(near)
    best, _ = peers.judge(near, solve(near))
    for degrees, millimetres in ((5, 5), (20, 20), (40, 20), (60, 20), (90, 20), (None, None)):
        if degrees is None or millimetres is None:
            solved, told = calibrated(near), ["calibrate_batch", ""]
        else:
            batch = draw(count, 50, degrees, millimetres)
            solved, told = solve(batch), [degrees, millimetres]
        cost, cosine = peers.judge(near, solved)
        reached = float(np.mean(cost <= best * (1 + AGREEMENT)))
        rows.append(
            [
                *told,
                count,
                reached,
                int(np.sum(~np.isfinite(cost))),
                float(np.median(solved.iterations)),
                int(solved.iterations.max()),
                float(np.nanmax(cosine)),
            ]
        )
    return rows


BASIN_HEADER = (
    "degrees_off",
    "mm_off",
    "problems",
    "share_at_optimum",
    "not_finite",
    "iterations_median",
    "iterations_max",
    "gradient_cosine_max",
)


def scaling(quick: bool) -> list[list[object]]:
    """Time of ``calibrate_batch`` against images, problems and chunk, and in float32."""
    rows: list[list[object]] = []

    def measure(label: str, batch: Batch, **keywords: Any) -> Solved:
        calibrated(batch, **keywords)
        solved = [calibrated(batch, **keywords) for _ in range(5)]
        seconds = float(np.median([one.seconds for one in solved]))
        again = all(np.array_equal(solved[0].matrix, one.matrix) for one in solved[1:])
        cost, cosine = peers.judge(batch, _first(solved[0]))
        rows.append(
            [
                label,
                batch.points.shape[1],
                len(batch),
                1e6 * seconds / len(batch),
                len(batch) / seconds,
                float(np.max(cosine)),
                again,
            ]
        )
        costs.append(cost)
        print(f"scaling: {rows[-1]}", flush=True)
        return solved[0]

    costs: list[np.ndarray] = []
    for images in (10, 20, 50, 100, 200, 500, 1000):
        count = max(LANES, (1024 if quick else 4096) * 50 // images // LANES * LANES)
        measure("images", draw(count, images, 0.0, 0.0))
    for count in (1, 8, 64, 512, 4096, 32768, 102400):
        if not (quick and count > 4096):
            measure("batch", draw(count, 50, 0.0, 0.0))
    batch = draw(1024 if quick else 4096, 50, 0.0, 0.0)
    for chunk in (16, 32, 128, 256):
        measure(f"chunks of {chunk}", batch, chunk=chunk)
    usual = measure("float64", batch)
    single = measure("float32", batch, options=jaxcal.Options(precision="float32"))
    moved = np.linalg.norm(single.matrix[:, :3, 3] - usual.matrix[:, :3, 3], axis=1)
    turned = np.linalg.norm(single.matrix[:, :3, :3] - usual.matrix[:, :3, :3], axis=(1, 2))
    for what, values in (("X's origin (mm)", moved), ("X's rotation (rad)", turned / np.sqrt(2))):
        for name, value in (("largest", values.max()), ("median", np.median(values))):
            rows.append([f"float32: {name} difference of {what}", 50, len(batch), float(value)])
    excess = float(np.max(costs[-1] / costs[-2] - 1))
    rows.append(["float32: largest relative excess of the objective", 50, len(costs[-1]), excess])
    return rows


SCALING_HEADER = (
    "what",
    "images",
    "problems",
    "us_per_problem_or_difference",
    "solves_per_s",
    "gradient_cosine_max",
    "reruns_bitwise_equal",
)


def cores(quick: bool) -> list[list[object]]:
    """One core against two: a process on each, or one with two devices that share every batch."""
    if len(CORES) < 2:
        print("cores: there is only one", flush=True)
        return []
    rounds = 3 if quick else 7
    setups = {
        "one process on one core": [("--core", str(CORES[0]))],
        "two processes on two cores": [("--core", str(core)) for core in CORES[:2]],
        "one process, two devices (jax_num_cpu_devices=2)": [("--devices", "2")],
    }
    workers = {name: [_started(option) for option in options] for name, options in setups.items()}
    rates = {name: [] for name in setups}
    for number in range(rounds):
        for name, running in workers.items():
            for process in running:
                _pipe(process.stdin).write("go\n")
                _pipe(process.stdin).flush()
            rates[name].append(sum(float(_pipe(process.stdout).readline()) for process in running))
        print(f"cores: round {number + 1} of {rounds}", flush=True)
    for process in (process for running in workers.values() for process in running):
        _pipe(process.stdin).close()
        process.wait()
    one = np.array(rates["one process on one core"])
    return [
        [
            name,
            float(np.median(each)),
            float(min(each)),
            float(max(each)),
            float(np.median(np.array(each) / one)),
        ]
        for name, each in rates.items()
    ]


CORES_HEADER = (
    "cores",
    "solves_per_s_median",
    "solves_per_s_min",
    "solves_per_s_max",
    "ratio_median",
)


def _started(option: tuple[str, str]) -> subprocess.Popen[str]:
    """A worker that is ready."""
    command = [sys.executable, __file__, "--worker", *option]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    _pipe(process.stdout).readline()
    return process


def _pipe(stream: IO[str] | None) -> IO[str]:
    assert stream is not None
    return stream


def worker(core: int | None, devices: int) -> None:
    """Solve for two seconds on one core, or on so many devices, whenever told to."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    jax.config.update("jax_num_cpu_devices", devices)
    problems = problems_of(draw(4096, 50, 0.0, 0.0))
    read(problems, sigma=SIGMA_MM)
    print("ready", flush=True)
    for _ in sys.stdin:
        seconds, done = 0.0, 0
        while seconds < 2.0:
            seconds += read(problems, sigma=SIGMA_MM)[1]
            done += problems.mask.shape[0]
        print(done / seconds, flush=True)


def latency() -> list[list[object]]:
    """One warm problem, microseconds: ``calibrate``, status and covariance read, and Ceres."""
    batch = draw(LANES, 50, 20.0, 20.0)
    problems = jax.block_until_ready(problems_of(batch))
    one = [jax.tree.map(lambda leaf, k=k: leaf[k], problems) for k in range(len(batch))]

    def seconds(problem: jaxcal.Problem, keywords: dict[str, Any]) -> float:
        begun = time.perf_counter()
        found = jaxcal.calibrate(problem, **keywords)
        if found.status == "failed" or not np.isfinite(np.asarray(found.covariance)).all():
            raise SystemExit(f"{keywords}: a problem was not solved")
        return time.perf_counter() - begun

    rows: list[list[object]] = []
    calls: dict[str, dict[str, Any]] = {"given SDs": {"sigma": SIGMA_MM}, "auto": {}}
    for name, keywords in calls.items():
        seconds(one[0], keywords)
        times = [seconds(problem, keywords) for _ in range(5) for problem in one]
        rows.append([f"calibrate, {name}", 1e6 * float(np.median(times))])
    program = ceres_program()
    if program is not None:
        for name, solver in ((SCHUR, "schur"), ("Ceres TinySolver, 1e-9", "tiny")):
            solved = peers.ceres_solver(program, solver, 1e-9, repeats=9)(batch)
            rows.append([name, 1e6 * solved.seconds / len(batch)])
    return rows


def figure(folder: Path) -> None:
    """Solves a second of every solver; time a problem against images and batch; from the tables."""
    from matplotlib.figure import Figure

    rows, scaled = (_table(folder / f"solver_{name}.csv") for name in ("peers", "scaling"))
    rows += _table(folder / "solver_peers_large.csv")
    if not rows:
        return
    drawing = Figure(figsize=(14, 5.5), layout="constrained")
    left, middle, right = drawing.subplots(1, 3, width_ratios=(1.5, 1, 1))
    main = [row for row in rows if row["images"] == "50"][::-1]
    speed = [float(row["solves_per_s_median"]) for row in main]
    bars = left.barh([row["solver"] for row in main], speed, color="tab:blue")
    left.bar_label(bars, fmt="%.3g", padding=3, fontsize="small")
    left.tick_params(axis="y", labelsize="small")
    left.set(xscale="log", xlabel="solves/s, one core, n = 50, float64")
    left.set_xlim(right=1e6)
    for panel, label, column in ((middle, "images", "images"), (right, "batch", "problems")):
        chosen = [row for row in scaled if row["what"] == label]
        times = [float(row["us_per_problem_or_difference"]) for row in chosen]
        panel.loglog([float(row[column]) for row in chosen], times, "o-", label=CALIBRATE)
        text = "images" if label == "images" else "problems at once"
        panel.set(xlabel=text, ylabel="us a problem")
        panel.grid(alpha=0.3)
    for name in sorted({row["solver"] for row in rows if "Ceres" in row["solver"]}):
        chosen = sorted(
            (row for row in rows if row["solver"] == name), key=lambda row: int(row["images"])
        )
        middle.loglog(
            [int(row["images"]) for row in chosen],
            [float(row["us_per_problem"]) for row in chosen],
            "s--",
            label=name,
        )
    middle.legend(fontsize="x-small")
    with atomic_path(folder / "solver_peers.png") as temporary:
        drawing.savefig(temporary, dpi=110, format="png")


def _table(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return rows[:-1]  # the last one says what machine it was


def main() -> None:
    """Run every part, or one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few problems; minutes on two cores")
    parts = ("peers", "large", "basins", "scaling", "cores", "latency")
    parser.add_argument("--part", choices=parts, help="one table alone")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--core", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--devices", type=int, default=1, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    quick = chosen.quick
    if chosen.worker:
        worker(chosen.core, chosen.devices)
        return
    folder = results_folder(quick)
    rounds = 3 if quick else 15

    def large() -> list[list[object]]:
        return [row for images in (200, 1000) for row in race(images, max(3, rounds // 3), quick)]

    tables = {
        "peers": (RACE_HEADER, lambda: race(50, rounds, quick)),
        "peers_large": (RACE_HEADER, large),
        "basins": (BASIN_HEADER, lambda: basins(1024 if quick else 4096)),
        "scaling": (SCALING_HEADER, lambda: scaling(quick)),
        "cores": (CORES_HEADER, lambda: cores(quick)),
        "latency": (("solver", "us"), latency),
    }
    print(machine(), flush=True)
    for name, (header, rows) in tables.items():
        if chosen.part is not None and chosen.part not in (name, name.removeprefix("peers_")):
            continue
        load = os.getloadavg()[0]
        lines = rows()
        loads = f"load average {load:.1f} before and {os.getloadavg()[0]:.1f} after"
        write_table(folder / f"solver_{name}.csv", header, [*lines, [f"{machine()}; {loads}"]])
        for line in lines:
            print(
                ", ".join(
                    f"{head} {value:.4g}" if isinstance(value, float) else f"{head} {value}"
                    for head, value in zip(header, line, strict=False)
                )
            )
    figure(folder)


if __name__ == "__main__":
    main()
