"""Cost of prior ``auto`` over that of the self-tuned Gaussian solve, in a batch.

``calibrate_batch`` with all that a solve returns (status and covariance; what is computed when it
is read is not), one core, float64: the Gaussian REML solve and ``auto`` on the same problems
without covariances, and ``auto`` on the same with the covariances that the times of flight give.
Rounds are interleaved, each with its own order; times are medians over the rounds, the ratio is the
median of the rounds' ratios. Compilation is timed apart. Uniform offsets to 2 mm, 2 mm of noise on
each element's distance. Seed 20261126.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace

CORES = sorted(os.sched_getaffinity(0))
os.sched_setaffinity(0, {CORES[0]})  # before JAX counts them

import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import arguments, machine, write_table  # noqa: E402

from jaxcal import Problem, calibrate_batch  # noqa: E402
from jaxcal.study.simulation import Protocol, simulate  # noqa: E402

SEED = 20261126
SIZES = ((50, 512), (12, 512))
QUICK = ((50, 512),)
ROUNDS, QUICK_ROUNDS = 15, 5
HEADER = ["images", "batch", "rounds", "contestant", "us_per_problem", "us_quartile_low",
          "us_quartile_high", "over_gaussian", "over_gaussian_low", "over_gaussian_high",
          "compile_s"]  # fmt: skip


def draw(images: int, count: int) -> tuple[Problem, Problem]:
    """Problems without and with covariances."""
    protocol = Protocol(images=images, elevation_mm=2.0, noise_mm=2.0, test_images=2)
    root = jax.random.key(SEED)

    @jax.jit
    def some(indices):
        return jax.lax.map(
            lambda k: simulate(jax.random.fold_in(root, k), protocol), indices, batch_size=64
        )

    experiments = some(jnp.arange(count))
    plain = jax.vmap(lambda experiment: experiment.problem())(experiments)
    return plain, replace(plain, covariance=experiments.covariance)


def measure(images: int, batch: int, rounds: int) -> list[list[object]]:
    """The rows of one size."""
    plain, weighted = draw(images, batch)
    contestants = {
        "gaussian": lambda: calibrate_batch(plain, "joint", prior="gaussian"),
        "auto": lambda: calibrate_batch(plain, "joint"),
        "auto, covariances": lambda: calibrate_batch(weighted, "joint"),
    }

    def seconds(name: str) -> float:
        begun = time.perf_counter()
        jax.block_until_ready(contestants[name]())
        return time.perf_counter() - begun

    compiled = {name: seconds(name) for name in contestants}
    for name in contestants:
        seconds(name)
    random = np.random.default_rng(SEED)
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name in random.permutation(list(contestants)):
            times[name].append(1e6 * seconds(name) / batch)
    base = np.array(times["gaussian"])
    rows: list[list[object]] = []
    for name, values in times.items():
        ratio = np.array(values) / base
        row = [
            images, batch, rounds, name,
            *(float(np.quantile(values, q)) for q in (0.5, 0.25, 0.75)),
            *(float(np.quantile(ratio, q)) for q in (0.5, 0.25, 0.75)),
            compiled[name],
        ]  # fmt: skip
        rows.append(row)
        said = f"n {images:4d} batch {batch:5d} {name:18s} {row[4]:7.1f} us  {row[7]:.2f} "
        said += f"({row[8]:.2f} to {row[9]:.2f})  compiled in {row[10]:.0f} s"
        print(said, flush=True)
    return rows


def main() -> None:
    """Measure and write the table."""
    quick, folder = arguments(__doc__)
    print(machine())
    rows: list[list[object]] = []
    for images, batch in QUICK if quick else SIZES:
        rows += measure(images, batch, QUICK_ROUNDS if quick else ROUNDS)
    rows.append([f"# {machine()}, one core"])
    write_table(folder / "auto_cost.csv", HEADER, rows)


if __name__ == "__main__":
    main()
