"""What an accelerator does with a batch: problems a second, beside all cores of its own machine.

Recordings of 20 and 50 images (offsets to 1 mm, noise 0.5 mm), calibrated by ``calibrate_batch``
with its defaults, in float64: 65,536 problems on the accelerator, 8,192 of them on the processor
(one JAX device a core). Best of three calls after the first, X and status read. ``largest_apart``
is how far the two answers are apart, of X's translation in mm. Needs a machine with an
accelerator that JAX sees; says so and ends where there is none.

    python experiments/benchmarks/accelerator.py

Seed 20261205.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import jax
import numpy as np

import jaxcal
from jaxcal import Problem, Protocol, calibrate_batch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common import machine, results_folder, write_table

jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)

SEED = 20261205
IMAGES = (20, 50)
MANY, FEW, CALLS = 65_536, 8_192, 3
METHODS = (
    ("conventional", "auto"),
    ("alternating", "auto"),
    ("joint", "gaussian"),
    ("joint", "auto"),
    ("joint", "bounded"),
)
HEADER = ["method", "prior", "images", "accelerator", "problems", "first_call_s",
          "problems_per_s", "cores", "cores_problems_per_s", "ratio", "largest_apart_mm",
          "not_converged"]  # fmt: skip


def drawn(images: int) -> Problem:
    """Problems on the host, so that they may go anywhere."""
    protocol = Protocol(images=images, test_images=2)
    keys = jax.random.split(jax.random.key(SEED), MANY)
    build = jax.jit(jax.vmap(lambda key: jaxcal.simulate(key, protocol).problem()))
    return jax.tree.map(np.asarray, build(keys))


def timed(problems: Problem, method: str, prior: str) -> tuple[float, float, np.ndarray, int]:
    """Seconds of the first call and of the best of the next ones; X; how many did not converge."""
    bound = {"max_elevation": 1.0} if method == "alternating" or prior == "bounded" else {}
    seconds: list[float] = []
    x = status = np.zeros(0)
    for _ in range(CALLS + 1):
        began = time.perf_counter()
        result = calibrate_batch(problems, method, prior, **bound)  # pyright: ignore[reportArgumentType]
        x, status = np.asarray(result.image_to_probe), np.asarray(result.status_code)
        seconds.append(time.perf_counter() - began)
    return seconds[0], min(seconds[1:]), x, int((status != 0).sum())


def main() -> None:
    accelerator = jax.devices()[0]
    if accelerator.platform == "cpu":
        print("JAX sees no accelerator here: nothing to measure")
        return
    processor = jax.devices("cpu")
    rows: list[list[object]] = []
    for images in IMAGES:
        problems = drawn(images)
        there = jax.device_put(problems, accelerator)
        mesh = jax.sharding.Mesh(np.array(processor), ("batch",))
        spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("batch"))
        here = jax.device_put(jax.tree.map(lambda leaf: leaf[:FEW], problems), spread)
        for method, prior in METHODS:
            first, fast, x, failed = timed(there, method, prior)
            _, slow, same, _ = timed(here, method, prior)
            apart = float(np.abs(x[:FEW] - same)[:, :3, 3].max())
            rows.append([method, prior, images, accelerator.device_kind, MANY, first, MANY / fast,
                         len(processor), FEW / slow, MANY / fast * slow / FEW, apart,
                         failed])  # fmt: skip
            print(*(f"{v:.4g}" if isinstance(v, float) else v for v in rows[-1]), flush=True)
            write_table(results_folder(False) / "accelerator.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
