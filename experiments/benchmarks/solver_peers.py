"""The fused joint solver against the solvers that people would otherwise use, on the same problems.

Explicit joint problem (peer_solvers.py), n = 50 images, float64: offsets to 2 mm, 2 mm of noise on
each element's distance, 0.5 mm taken for the SD of every component of q - p and 2 / sqrt(3) mm for
that of the offsets. Starts: X turned by 20 degrees about a random axis and moved by 20 mm, the
target moved by 20 mm. Everything runs pinned to one core; rounds are interleaved, each solver
taking its share of the problems in each, and ratios are medians over the rounds. The table counts
the problems whose objective is within 1e-8 (relative) of the lowest that any solver found.

Further tables: from how far the optimum is reached (4,096 problems); scaling with images, batch and
cores; one warm problem; float32. Seed 20261125.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

CORES = sorted(os.sched_getaffinity(0))
os.sched_setaffinity(0, {CORES[0]})  # before JAX counts them
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
import peer_solvers as peers  # noqa: E402
from common import arguments, machine, results_folder, write_table  # noqa: E402
from peer_solvers import Batch, Solved  # noqa: E402

from jaxcal.compiler import fast_to_run  # noqa: E402
from jaxcal.io.atomic import atomic_path  # noqa: E402
from jaxcal.model.parameters import Parameters  # noqa: E402
from jaxcal.simulation import Protocol, simulate  # noqa: E402
from jaxcal.solvers import lanes  # noqa: E402
from jaxcal.solvers.fused import Circle, Guess, Images  # noqa: E402

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


def fused_solver(
    batch: Batch, *, dtype: type = np.float64, options: dict | None = None, chunk: int = LANES
) -> Callable[[Batch], Solved]:
    """Jaxcal's kernel, compiled for batches of this size.

    Args:
        batch: of the size that will be solved.
        dtype: precision.
        options: of the compiler; jaxcal's own by default.
        chunk: problems side by side.
    """
    count = len(batch)
    chunk = min(chunk, count)
    if count % chunk:
        raise ValueError(f"{count} problems are no multiple of {chunk}")

    def solve(part):
        poses, points, matrix, point = part
        guess = Guess(
            jnp.moveaxis(matrix[:, :3, :3], 0, -1), matrix[:, :3, 3].T, point.T
        )  # fmt: skip
        images = Images(
            jnp.stack([poses[..., i, j] for i in range(3) for j in range(3)]),
            jnp.stack([poses[..., i, 3] for i in range(3)]),
            points[..., 0], points[..., 1], jnp.ones(points.shape[:2], points.dtype),
        )  # fmt: skip
        sigma = jnp.full((3, points.shape[0]), SIGMA_MM, points.dtype)
        belief = Circle(
            sigma, jnp.full(points.shape[0], OFFSET_SD_MM, points.dtype),
            jnp.full(points.shape[:2], jnp.inf, points.dtype),
        )  # fmt: skip
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

    def device(batch: Batch):
        return [
            jnp.asarray(part, dtype)
            for part in (batch.poses, batch.points, batch.matrix, batch.point)
        ]

    parts = device(batch)
    options = fast_to_run(jax.default_backend()) if options is None else options
    program = jax.jit(whole).lower(*parts).compile(compiler_options=options)
    jax.block_until_ready(program(*parts))

    def run(batch: Batch) -> Solved:
        parts = jax.block_until_ready(device(batch))
        begun = time.perf_counter()
        done = jax.block_until_ready(program(*parts))
        seconds = time.perf_counter() - begun
        matrix, point, offset, iterations = (np.asarray(part) for part in done)
        return Solved(matrix, point, offset, iterations, seconds)

    return run


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


def basins(count: int) -> list[list[object]]:
    """From how far away the optimum is reached: share of problems, against starts at the truth."""
    rows: list[list[object]] = []
    near = draw(count, 50, 0.0, 0.0)
    solve = fused_solver(near)
    best, _ = peers.judge(near, solve(near))
    for degrees, millimetres in ((5, 5), (20, 20), (40, 20), (60, 20), (90, 20)):
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

    def measure(label: str, batch: Batch, **arguments) -> Solved:
        solve = fused_solver(batch, **arguments)
        solved = [solve(batch) for _ in range(5)]
        seconds = float(np.median([one.seconds for one in solved]))
        again = all(np.array_equal(solved[0].matrix, one.matrix) for one in solved[1:])
        rows.append([label, batch.points.shape[1], len(batch), 1e6 * seconds / len(batch),
                     len(batch) / seconds, again])  # fmt: skip
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
        print(f"{label}: X's origin differs by at most {moved.max():.2e} mm", flush=True)
        rows.append([f"largest difference of X's origin, {label} (mm)", 50, len(batch),
                     float(moved.max()), float(np.median(moved)), ""])  # fmt: skip
    return rows


SCALING_HEADER = (
    "what",
    "images",
    "problems",
    "us_per_problem",
    "solves_per_s",
    "reruns_bitwise_equal",
)


def cores(quick: bool) -> list[list[object]]:
    """One process on one core against two processes on two, each with its own problems."""
    if len(CORES) < 2:
        print("cores: there is only one", flush=True)
        return []
    rounds = 3 if quick else 9
    command = [sys.executable, __file__, "--worker"]

    def together(chosen: list[int]) -> float:
        running = [
            subprocess.Popen(
                [*command, str(core)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            for core in chosen
        ]
        for process in running:
            assert process.stdout is not None
            process.stdout.readline()
        rates = []
        for process in running:
            assert process.stdin is not None
            process.stdin.write("go\n")
            process.stdin.flush()
        for process in running:
            assert process.stdout is not None
            rates.append(float(process.stdout.readline()))
            process.wait()
        return sum(rates)

    one = [together(CORES[:1]) for _ in range(rounds)]
    two = [together(CORES[:2]) for _ in range(rounds)]
    ratio = float(np.median(two) / np.median(one))
    return [["one core", float(np.median(one)), 1.0], ["two cores", float(np.median(two)), ratio]]


def worker(core: int) -> None:
    """Solve for three seconds on one core when told to."""
    os.sched_setaffinity(0, {core})
    batch = draw(4096, 50, 20.0, 20.0)
    solve = fused_solver(batch)
    print("ready", flush=True)
    sys.stdin.readline()
    begun, done = time.perf_counter(), 0
    while time.perf_counter() - begun < 3.0:
        solve(batch)
        done += len(batch)
    print(done / (time.perf_counter() - begun), flush=True)


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


def figure(path: Path, rows: list[list[object]], scaled: list[list[object]]) -> None:
    """Solves a second of every solver; time a problem against images and batch."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(13, 4.5), layout="constrained")
    left, middle, right = drawing.subplots(1, 3, width_ratios=(1.6, 1, 1))
    main = [row for row in rows if row[1] == 50]
    names = [str(row[0]) for row in main][::-1]
    speed = [float(str(row[3])) for row in main][::-1]
    left.barh(names, speed, color="tab:blue")
    left.set(xscale="log", xlabel="solves/s, one core, n = 50, float64")
    for panel, label, column in ((middle, "images", 1), (right, "batch", 2)):
        chosen = [row for row in scaled if row[0] == label]
        x = [float(str(row[column])) for row in chosen]
        panel.loglog(x, [float(str(row[3])) for row in chosen], "o-", label="fused")
        panel.set(xlabel="images" if label == "images" else "problems at once", ylabel="us/problem")
        panel.grid(alpha=0.3)
    for name in {str(row[0]) for row in rows if "Ceres" in str(row[0])}:
        chosen = sorted((row for row in rows if row[0] == name), key=lambda row: int(str(row[1])))
        middle.loglog([int(str(row[1])) for row in chosen],
                      [1e6 / float(str(row[3])) for row in chosen], "s--", label=name)  # fmt: skip
    middle.legend(fontsize="x-small")
    with atomic_path(path) as temporary:
        drawing.savefig(temporary, dpi=110)


def main() -> None:
    if "--worker" in sys.argv:
        worker(int(sys.argv[sys.argv.index("--worker") + 1]))
        return
    quick = arguments(__doc__ or "").quick
    folder = results_folder(quick)
    rounds = 3 if quick else 15
    print(machine(), flush=True)
    rows = race(50, rounds, quick)
    for images in (200, 1000):
        rows += race(images, max(3, rounds // 3), quick)
    scaled = scaling(quick)
    tables = {
        "solver_peers": (RACE_HEADER, rows),
        "solver_basins": (BASIN_HEADER, basins(1024 if quick else 4096)),
        "solver_scaling": (SCALING_HEADER, scaled),
        "solver_cores": (("cores", "solves_per_s", "ratio"), cores(quick)),
        "solver_latency": (("solver", "us"), latency()),
    }
    for name, (header, lines) in tables.items():
        write_table(folder / f"{name}.csv", header, [*lines, [machine()]])
        for line in lines:
            print(", ".join(f"{head} {value:.4g}" if isinstance(value, float) else f"{head} {value}"
                            for head, value in zip(header, line, strict=True)))  # fmt: skip
    figure(folder / "solver_peers.png", rows, scaled)


if __name__ == "__main__":
    main()
