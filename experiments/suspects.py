"""How often are images, drifts and other misfits of clean recordings named, and real ones found?

Simulated recordings without any fault, for 30, 54 and 200 images and for uniform, Gaussian and
heavy-tailed offsets, calibrated with the default prior: the share in which some image is suspected,
or a kind of error is said to have heavy tails, to lean, to grow with depth, or to be alike in
successive images or drift. Heavy-tailed offsets have heavy tails: that is no false alarm. Then the
same with faults: three successive images with the range 5 SDs too long, and offsets that drift by
1.5 SDs from the first image to the last. Of 250 trials a share is known to +- 1 to 3 %.

Seed 20261124; trial k of a condition is fold_in(root, condition * 10^6 + k).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, machine, write_table
from jaxtyping import Array

import jaxcal
from jaxcal.diagnostics.misfits import misfits
from jaxcal.diagnostics.outliers import outliers, suspects
from jaxcal.runtime.jax_cache import enable_compilation_cache
from jaxcal.study.laws import LawName

SEED = 20261124
LAWS: tuple[LawName, ...] = ("uniform", "normal", "heavy-tailed")
FAULTS = ("none", "three images", "drift")
KINDS = {
    "heavier tails": "tails", "skewed to one side": "one side", "grow with depth": "depth",
    "correlated in successive": "alike", "drift in the course": "drift",
}  # fmt: skip
HEADER = [
    "elevation_distribution", "images", "fault", "trials", "suspects", "outliers", "fault_named",
    *(f"said_{kind}" for kind in ("tails", "one side", "depth", "alike", "drift")),
]  # fmt: skip


@partial(jax.jit, static_argnums=(0, 1, 2))
def draw(law: LawName, images: int, fault: str, indices: Array):
    """Problems of one condition."""
    protocol = jaxcal.Protocol(
        images=images, test_images=2, elevation_distribution=law, elevation_mm=1.0, noise_mm=1.0
    )
    root = jax.random.key(SEED)

    def one(k: Array) -> jaxcal.Problem:
        drawn = jaxcal.simulate(jax.random.fold_in(root, k), protocol)
        problem = drawn.problem()
        if fault == "three images":
            sd = jnp.sqrt(jnp.mean(drawn.covariance[:, 1, 1]))
            points = problem.measurements.at[11:14, 1].add(5 * sd)
            return replace(problem, measurements=points)
        if fault == "drift":
            # The probe is taken for shifted along the elevational axis, more and more.
            slope = 1.5 * jnp.std(drawn.elevation) * jnp.linspace(-0.5, 0.5, images)
            along = problem.poses[:, :3, :3] @ drawn.image_to_probe[:3, 1]
            return replace(problem, poses=problem.poses.at[:, :3, 3].add(slope[:, None] * along))
        return problem

    return jax.vmap(one)(indices)


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 60 if quick else 250
    enable_compilation_cache()
    rows: list[list[object]] = []
    condition = 0
    for images in (54,) if quick else (30, 54, 200):
        for law in LAWS:
            for fault in FAULTS:
                indices = condition * 1_000_000 + jnp.arange(trials)
                condition += 1
                result = jaxcal.calibrate_batch(draw(law, images, fault, indices)).numpy()
                said = dict.fromkeys(KINDS.values(), 0)
                suspected = left = named = 0
                for k in range(trials):
                    one = result[k]
                    suspicious, wrong = suspects(one), outliers(one)
                    suspected += bool(suspicious)
                    left += bool(wrong)
                    complaints = misfits(one)
                    for words, kind in KINDS.items():
                        said[kind] += any(words in text for text in complaints)
                    found = {each["image"] for each in suspicious} | set(wrong)
                    if fault == "three images":
                        named += bool(found & {11, 12, 13})
                    elif fault == "drift":
                        named += any("elevational" in text and "drift in" in text
                                     for text in complaints)  # fmt: skip
                counts = [suspected, left, named, *said.values()]
                shares = [float(np.mean(count / trials)) for count in counts]
                rows.append([law, images, fault, trials, *shares])
                print(*rows[-1], sep=", ", flush=True)
    write_table(folder / "suspects.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
