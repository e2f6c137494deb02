"""The fused joint solver against the solvers that people would otherwise use, on the same problems.

Explicit joint problem (peer_solvers.py), n = 50 images, float64: offsets to 2 mm, 2 mm of noise on
each element's distance, 0.5 mm taken for the SD of every component of q - p and 2 / sqrt(3) mm for
that of the offsets. Starts: X turned by 20 degrees about a random axis and moved by 20 mm, the
target moved by 20 mm. Everything runs pinned to one core; rounds are interleaved, each solver
taking its share of the problems in each, and ratios are medians over the rounds. The table counts
the problems whose objective is within 1e-8 (relative) of the lowest that any solver found.

Further tables: from how far the optimum is reached (4,096 problems); scaling with images and batch,
memory, float32; cores; one warm problem. ``--part`` runs one of them alone; the figure is drawn
from the tables that are there. Seed 20261125.
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
from jax.sharding import Mesh, NamedSharding, PartitionSpec  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
import peer_solvers as peers  # noqa: E402
from common import machine, results_folder, write_table  # noqa: E402
from peer_solvers import Batch, Solved  # noqa: E402

from jaxcal.compiler import fast_to_run  # noqa: E402
from jaxcal.io.atomic import atomic_path  # noqa: E402
from jaxcal.model.parameters import Parameters  # noqa: E402
from jaxcal.simulation import Protocol, simulate  # noqa: E402
from jaxcal.solvers import lanes  # noqa: E402
from jaxcal.solvers.fused import Circle, Guess, Images  # noqa: E402
from jaxcal.solvers.fused_methods import closed_form  # noqa: E402

SEED = 20261125
SIGMA_MM, OFFSET_SD_MM = 0.5, 2 / np.sqrt(3)
AGREEMENT = 1e-8
ELEVATION_MM, NOISE_MM = 2.0, 2.0
LANES = 64


def draw(count: int, images: int, degrees: float, millimetres: float, seed: int = SEED) -> Batch:
    """Problems with starts so far from the truth."""
    protocol = Protocol(images=images, elevation_mm=ELEVATION_MM, noise_mm=NOISE_MM, test_images=2)
    root = jax.random.key(seed)

    @jax.jit
    def one(indices):
        def trial(index):
            drawn = simulate(jax.random.fold_in(root, index), protocol)
            return drawn.poses, drawn.points, drawn.image_to_probe, drawn.point

        return jax.lax.map(trial, indices, batch_size=64)

    poses, points, matrix, point = (np.array(part) for part in one(jnp.arange(count)))
    random = np.random.default_rng(seed)
    direction = random.normal(size=(3, count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    turn = Rotation.from_rotvec(np.radians(degrees) * direction[0]).as_matrix()
    matrix[:, :3, :3] = matrix[:, :3, :3] @ turn
    matrix[:, :3, 3] += millimetres * direction[1]
    weight = np.full(3, 1 / SIGMA_MM)
    return Batch(poses, points, matrix, point + millimetres * direction[2], weight,
                 1 / OFFSET_SD_MM)  # fmt: skip


def images_of(poses, points) -> Images:
    """What the kernel takes of a batch."""
    return Images(
        jnp.stack([poses[..., i, j] for i in range(3) for j in range(3)]),
        jnp.stack([poses[..., i, 3] for i in range(3)]),
        points[..., 0], points[..., 1], jnp.ones(points.shape[:2], points.dtype),
    )  # fmt: skip


def to_device(batch: Batch, dtype: type) -> list[jax.Array]:
    """What the kernel takes, as JAX's arrays."""
    parts = (batch.poses, batch.points, batch.matrix, batch.point)
    return [jnp.asarray(part, dtype) for part in parts]


@dataclass(frozen=True)
class FusedSolver:
    """Jaxcal's kernel, compiled.

    Attributes:
        program: from four arrays to X, c, y and the numbers of passes. dtype: of them.
        temporary_bytes: memory beside arguments and results.
        placed: the batch where it lies on several devices; then no other one can be solved.
    """

    program: Any
    dtype: type
    temporary_bytes: int
    placed: list[jax.Array] | None = None

    def __call__(self, batch: Batch) -> Solved:
        """Solve, timed without the copies to and from JAX."""
        parts = self.placed or jax.block_until_ready(to_device(batch, self.dtype))
        begun = time.perf_counter()
        done = jax.block_until_ready(self.program(*parts))
        seconds = time.perf_counter() - begun
        matrix, point, offset, iterations = (np.asarray(part) for part in done)
        return Solved(matrix, point, offset, iterations, seconds)


def fused_solver(
    batch: Batch,
    *,
    dtype: type = np.float64,
    options: dict | None = None,
    chunk: int = LANES,
    devices: int = 1,
) -> FusedSolver:
    """Jaxcal's kernel, compiled for batches of this size.

    Args:
        batch: of the size that will be solved.
        dtype: precision.
        options: of the compiler; jaxcal's own by default.
        chunk: problems side by side.
        devices: of JAX's that share the batch.
    """
    count = len(batch)
    chunk = min(chunk, count)
    if count % (chunk * devices):
        raise ValueError(f"{count} problems are no multiple of {chunk} on {devices} devices")

    def solve(part):
        poses, points, matrix, point = part
        guess = Guess(
            jnp.moveaxis(matrix[:, :3, :3], 0, -1), matrix[:, :3, 3].T, point.T
        )  # fmt: skip
        images = images_of(poses, points)
        sigma = jnp.full((3, points.shape[0]), SIGMA_MM, points.dtype)
        belief = Circle(sigma, jnp.full(points.shape[0], OFFSET_SD_MM, points.dtype))
        done = lanes.minimise(guess, belief, images)
        found = done.guess.parameters()
        return (
            jax.vmap(Parameters.matrix)(found),
            found.point,
            belief.offset(done.guess, images),
            done.iterations,
        )

    def whole(*parts):
        split = tuple(part.reshape(-1, chunk, *part.shape[1:]) for part in parts)
        done = jax.lax.map(solve, split)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), done)

    parts = to_device(batch, dtype)
    options = fast_to_run(jax.default_backend()) if options is None else options
    function = whole
    if devices > 1:
        mesh, cut = (
            Mesh(np.asarray(jax.devices()[:devices]), ("problems",)),
            PartitionSpec("problems"),
        )
        function = jax.shard_map(whole, mesh=mesh, in_specs=cut, out_specs=cut, check_vma=False)
        placed = [jax.device_put(part, NamedSharding(mesh, cut)) for part in parts]
        program = jax.jit(function).lower(*placed).compile(compiler_options=options)
    else:
        placed = parts
        program = jax.jit(function).lower(*parts).compile(compiler_options=options)
    jax.block_until_ready(program(*placed))

    memory = program.memory_analysis()
    temporary = int(memory.temp_size_in_bytes) if memory is not None else 0
    return FusedSolver(program, dtype, temporary, placed if devices > 1 else None)


def contestants(quick: bool, images: int) -> dict[str, tuple[Callable[[Batch], Solved], int]]:
    """Every solver at hand, and how many problems it gets in a round."""
    few = 4 if quick else 1
    fused = max(LANES, 4096 // few * 50 // images // LANES * LANES)

    def share(count: int) -> int:
        return max(4, count // few * 50 // images)

    batch = draw(max(fused, share(64)), images, 20.0, 20.0)
    found: dict[str, tuple[Callable[[Batch], Solved], int]] = {
        "jaxcal, fused": (fused_solver(batch.first(fused)), fused)
    }
    program = peers.build_ceres()
    if isinstance(program, str):
        print(f"Ceres in C++ is left out: {program}", flush=True)
    else:
        for name, solver, tolerance in (
            ("Ceres DENSE_SCHUR, 1e-9", "schur", 1e-9),
            ("Ceres DENSE_SCHUR, 1e-13", "schur", 1e-13),
            ("Ceres TinySolver by hand, 1e-9", "tiny", 1e-9),
        ):
            found[name] = peers.ceres_solver(program, solver, tolerance), share(512)
    if images <= 50:
        found["scipy lm"] = peers.scipy_solver("lm"), share(32)
        found["scipy lm, 1e-8 (its default)"] = peers.scipy_solver("lm", 1e-8), share(32)
        found["scipy lm, 1e-8, numerical Jacobian (its default)"] = (
            peers.scipy_solver("lm", 1e-8, exact=False), share(4)
        )  # fmt: skip
        found["scipy trf"] = peers.scipy_solver("trf"), share(16)
        dense = share(64)
        found["optimistix LM, dense, vmapped"] = (
            peers.optimistix_solver(batch.first(dense)), dense
        )  # fmt: skip
        if peers.missing("pyceres"):
            print("pyceres is left out: not installed", flush=True)
        else:
            found["pyceres, numpy cost"] = peers.pyceres_solver, share(32)
    return found


def race(images: int, rounds: int, quick: bool) -> list[list[object]]:
    """Interleaved rounds of every solver on one set of problems; a row of the table each."""
    solvers = contestants(quick, images)
    batch = draw(max(count for _, count in solvers.values()), images, 20.0, 20.0)
    rates: dict[str, list[float]] = {name: [] for name in solvers}
    last: dict[str, Solved] = {}
    for number in range(rounds):
        for name, (solve, count) in solvers.items():
            solved = solve(batch.first(count))
            last[name] = solved
            rates[name].append(count / solved.seconds)
        print(f"n = {images}: round {number + 1} of {rounds}", flush=True)
    judged = {name: peers.judge(batch, _first(solved, 512)) for name, solved in last.items()}
    lowest = np.full(512, np.inf)
    for cost, _ in judged.values():
        lowest[: len(cost)] = np.minimum(lowest[: len(cost)], cost)
    rows: list[list[object]] = []
    ours = np.array(rates["jaxcal, fused"])
    for name, (cost, cosine) in judged.items():
        excess = float(np.max(cost / lowest[: len(cost)] - 1))
        mine = np.array(rates[name])
        ratio = ours / mine
        reached = int(np.sum(cost / lowest[: len(cost)] - 1 <= AGREEMENT))
        rows.append([
            name, images, solvers[name][1], float(np.median(mine)), float(mine.min()),
            float(mine.max()), float(np.median(ratio)), float(ratio.min()), float(ratio.max()),
            float(np.mean(last[name].iterations)), len(cost), reached, excess,
            float(np.median(cosine)), float(cosine.max()),
        ])  # fmt: skip
    return rows


RACE_HEADER = (
    "solver", "images", "problems_a_round", "solves_per_s_median", "solves_per_s_min",
    "solves_per_s_max", "fused_over_it_median", "fused_over_it_min", "fused_over_it_max",
    "iterations_mean", "problems_judged", "at_the_lowest_objective", "largest_relative_excess",
    "gradient_cosine_median", "gradient_cosine_max",
)  # fmt: skip


def _first(solved: Solved, count: int) -> Solved:
    names = ("matrix", "point", "offset", "iterations")
    return replace(solved, **{name: getattr(solved, name)[:count] for name in names})


def from_closed_form(batch: Batch) -> Batch:
    """The same problems, started where jaxcal starts by itself."""

    def start(poses, points):
        guess, _, _ = closed_form(images_of(poses, points))
        return jax.vmap(Parameters.matrix)(guess.parameters()), guess.point.T

    matrix, point = jax.jit(start)(batch.poses, batch.points)
    return replace(batch, matrix=np.asarray(matrix), point=np.asarray(point))


def basins(count: int) -> list[list[object]]:
    """From how far away the optimum is reached: share of problems, against starts at the truth."""
    rows: list[list[object]] = []
    near = draw(count, 50, 0.0, 0.0)
    solve = fused_solver(near)
    best, _ = peers.judge(near, solve(near))
    for degrees, millimetres in (
        (5, 5),
        (20, 20),
        (40, 20),
        (60, 20),
        (90, 20),
        ("closed", "form"),
    ):
        if isinstance(degrees, str) or isinstance(millimetres, str):
            batch = from_closed_form(near)
        else:
            batch = draw(count, 50, degrees, millimetres)
        solved = solve(batch)
        cost, cosine = peers.judge(batch, solved)
        finite = int(np.sum(np.isfinite(cost)))
        reached = float(np.mean(cost <= best * (1 + AGREEMENT)))
        rows.append([degrees, millimetres, count, reached, count - finite,
                     float(np.median(solved.iterations)), int(solved.iterations.max()),
                     float(np.nanmax(cosine)), float(count / solved.seconds)])  # fmt: skip
    return rows


BASIN_HEADER = (
    "degrees_off", "mm_off", "problems", "share_at_optimum", "not_finite", "iterations_median",
    "iterations_max", "gradient_cosine_max", "solves_per_s",
)  # fmt: skip


def scaling(quick: bool) -> list[list[object]]:
    """Time against the number of images and of problems, precision and compiler options."""
    rows: list[list[object]] = []
    costs: list[np.ndarray] = []

    def measure(label: str, batch: Batch, **arguments) -> Solved:
        solve = fused_solver(batch, **arguments)
        solved = [solve(batch) for _ in range(5)]
        seconds = float(np.median([one.seconds for one in solved]))
        again = all(np.array_equal(solved[0].matrix, one.matrix) for one in solved[1:])
        cost, cosine = peers.judge(batch, _first(solved[0], 512))
        megabytes = sum(part.nbytes for part in to_device(batch, solve.dtype)) / 1e6
        rows.append([label, batch.points.shape[1], len(batch), 1e6 * seconds / len(batch),
                     len(batch) / seconds, float(np.max(cosine)), megabytes,
                     solve.temporary_bytes / 1e6, again])  # fmt: skip
        costs.append(cost)
        print(f"scaling: {rows[-1]}", flush=True)
        return solved[0]

    for images in (10, 20, 50, 100, 200, 500, 1000):
        count = max(LANES, (1024 if quick else 4096) * 50 // images // LANES * LANES)
        measure("images", draw(count, images, 20.0, 20.0))
    for count in (1, 8, 64, 512, 4096, 32768, 102400):
        if not (quick and count > 4096):
            measure("batch", draw(count, 50, 20.0, 20.0))
    for chunk in (8, 16, 32, 64, 128, 256):
        measure(f"chunks of {chunk}", draw(4096, 50, 20.0, 20.0), chunk=chunk)
    batch = draw(4096, 50, 20.0, 20.0)
    usual = measure("jaxcal's compiler options", batch)
    plain = measure("default compiler options", batch, options={})
    single = measure("float32", batch, dtype=np.float32)
    for label, other in (("default options", plain), ("float32", single)):
        moved = np.linalg.norm(other.matrix[:, :3, 3] - usual.matrix[:, :3, 3], axis=1)
        turned = np.linalg.norm(other.matrix[:, :3, :3] - usual.matrix[:, :3, :3], axis=(1, 2))
        for what, values in (
            ("X's origin (mm)", moved),
            ("X's rotation (rad)", turned / np.sqrt(2)),
        ):
            for name, value in (("largest", values.max()), ("median", np.median(values))):
                rows.append([f"{label}: {name} difference of {what}", 50, len(batch), float(value)])
    excess = float(np.max(costs[-1] / costs[-3] - 1))
    rows.append(["float32: largest relative excess of the objective", 50, len(costs[-1]), excess])
    return rows


SCALING_HEADER = (
    "what", "images", "problems", "us_per_problem_or_difference", "solves_per_s",
    "gradient_cosine_max", "arguments_MB", "temporary_MB", "reruns_bitwise_equal",
)  # fmt: skip


def cores(quick: bool) -> list[list[object]]:
    """One core against two: a process on each, or one with two devices that share every batch."""
    if len(CORES) < 2:
        print("cores: there is only one", flush=True)
        return []
    rounds = 3 if quick else 7
    setups = {
        "one process on one core": [("--core", str(CORES[0]))],
        "two processes on two cores": [("--core", str(core)) for core in CORES[:2]],
        "one process, two devices (jax_num_cpu_devices=2, shard_map)": [("--devices", "2")],
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
        [name, float(np.median(each)), float(min(each)), float(max(each)),
         float(np.median(np.array(each) / one))]
        for name, each in rates.items()
    ]  # fmt: skip


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
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )  # fmt: skip
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
    batch = draw(4096, 50, 20.0, 20.0)
    solve = fused_solver(batch, devices=devices)
    print("ready", flush=True)
    for _ in sys.stdin:
        # Only solving counts: copying a batch to JAX is no part of it in the other tables either.
        seconds, done = 0.0, 0
        while seconds < 2.0:
            seconds += solve(batch).seconds
            done += len(batch)
        print(done / seconds, flush=True)


def latency() -> list[list[object]]:
    """One warm problem: the fused kernel and Ceres, microseconds."""
    batch = draw(LANES, 50, 20.0, 20.0)
    one = [replace(batch, **{name: getattr(batch, name)[k : k + 1]
                             for name in ("poses", "points", "matrix", "point")})
           for k in range(len(batch))]  # fmt: skip
    solve = fused_solver(one[0])
    rows: list[list[object]] = []
    times = np.array([[solve(problem).seconds for problem in one] for _ in range(5)])
    rows.append(["jaxcal, fused, one problem", 1e6 * float(np.median(times))])
    program = peers.build_ceres()
    if not isinstance(program, str):
        for name, solver in (("Ceres DENSE_SCHUR, 1e-9", "schur"), ("TinySolver, 1e-9", "tiny")):
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
    drawing = Figure(figsize=(14, 4.5), layout="constrained")
    left, middle, right = drawing.subplots(1, 3, width_ratios=(1.5, 1, 1))
    main = [row for row in rows if row["images"] == "50"][::-1]
    speed = [float(row["solves_per_s_median"]) for row in main]
    bars = left.barh([row["solver"] for row in main], speed, color="tab:blue")
    left.bar_label(bars, fmt="%.3g", padding=3, fontsize="small")
    left.set(xscale="log", xlabel="solves/s, one core, n = 50, float64")
    left.set_xlim(right=1e6)
    for panel, label, column in ((middle, "images", "images"), (right, "batch", "problems")):
        chosen = [row for row in scaled if row["what"] == label]
        times = [float(row["us_per_problem_or_difference"]) for row in chosen]
        panel.loglog([float(row[column]) for row in chosen], times, "o-", label="jaxcal, fused")
        text = "images" if label == "images" else "problems at once"
        panel.set(xlabel=text, ylabel="us a problem")
        panel.grid(alpha=0.3)
    for name in sorted({row["solver"] for row in rows if "Ceres" in row["solver"]}):
        chosen = sorted((row for row in rows if row["solver"] == name),
                        key=lambda row: int(row["images"]))  # fmt: skip
        middle.loglog([int(row["images"]) for row in chosen],
                      [1e6 / float(row["solves_per_s_median"]) for row in chosen],
                      "s--", label=name)  # fmt: skip
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
        lines = rows()
        write_table(folder / f"solver_{name}.csv", header, [*lines, [machine()]])
        for line in lines:
            print(", ".join(f"{head} {value:.4g}" if isinstance(value, float) else f"{head} {value}"
                            for head, value in zip(header, line, strict=False)))  # fmt: skip
    figure(folder)


if __name__ == "__main__":
    main()
