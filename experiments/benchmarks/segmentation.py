"""Time per trial of 50 frames and 128 elements: the fused kernel against numpy and scipy in a loop.

Both fit (lateral, range) of Eq. 5 to the same noisy distances: jaxcal in one batch of trials;
scipy.optimize.least_squares frame by frame from the closed-form start, once as one would write it
(default method and tolerances, no Jacobian) and once at its best (MINPACK's Levenberg-Marquardt,
exact Jacobian). Robust: jaxcal's MM-estimator against scipy's soft-L1 loss with the exact Jacobian,
the nearest that scipy has. The runs alternate in one process; medians are reported. Seed
20261121.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import arguments, machine, write_table

from jaxcal.data.probe import C5_2, L14_5
from jaxcal.data.segmentation.segment import compiled_fit

SEED, FRAMES, NOISE = 20261121, 50, 0.5


def draw(trials: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances to the elements of the linear and of the curvilinear array, mm."""
    generator = np.random.default_rng(SEED)
    depth = generator.uniform(10, 90, (trials, FRAMES))
    lateral = generator.uniform(-29.25, 29.25, (trials, FRAMES))
    angle = 0.9 * C5_2.half_angle_rad * generator.uniform(-1, 1, (trials, FRAMES))
    found = []
    for probe, plane in (
        (L14_5, np.stack([lateral, depth], -1)),
        (C5_2, C5_2.polar_to_cartesian(angle, depth)),
    ):
        elements = probe.element_positions()[:, [0, 2]]
        exact = np.linalg.norm(plane[:, :, None] - elements, axis=-1)
        found.append(exact + NOISE * generator.normal(size=exact.shape))
    return found[0], found[1]


def scipy_frame(distances: np.ndarray, elements: np.ndarray, how: str) -> np.ndarray:
    """One frame by scipy."""
    square = distances**2 - elements**2
    x = -0.5 * (square @ elements) / (elements @ elements)
    r = np.sqrt(max(square.mean() - x**2, 1.0))

    def residual(p):
        return np.hypot(p[0] - elements, p[1]) - distances

    def jacobian(p):
        along = p[0] - elements
        return np.stack([along, np.full_like(along, p[1])], axis=1) / np.hypot(along, p[1])[:, None]

    if how == "plain":
        return least_squares(residual, (x, r)).x
    if how == "best":
        options: dict[str, Any] = {"method": "lm"}
    else:
        options = {"loss": "soft_l1", "f_scale": NOISE}
    return least_squares(residual, (x, r), **options, jac=jacobian).x  # pyright: ignore[reportArgumentType]


def main() -> None:
    quick, folder = arguments(__doc__)
    trials, looped, rounds = (64, 1, 3) if quick else (256, 2, 15)
    linear, curved = draw(trials)
    elements = L14_5.element_positions()
    lateral = elements[:, 0]
    cases = {
        "least squares": (False, False, linear, elements),
        "robust": (False, True, linear, elements),
        "curvilinear, least squares": (True, False, curved, C5_2.element_positions()),
        "curvilinear, robust": (True, True, curved, C5_2.element_positions()),
    }
    against = {"least squares": ("plain", "best"), "robust": ("soft-L1",)}
    ours: dict[str, list[float]] = {name: [] for name in cases}
    theirs: dict[str, list[float]] = {how: [] for hows in against.values() for how in hows}
    placed = {name: jax.device_put(case[2]) for name, case in cases.items()}
    for name, (bent, robust, _, positions) in cases.items():
        jax.block_until_ready(compiled_fit(bent, robust)(placed[name], positions))
    agreement, load = 0.0, os.getloadavg()[0]
    for _ in range(rounds):
        for name, (bent, robust, data, positions) in cases.items():
            began = time.perf_counter()
            fit = jax.block_until_ready(compiled_fit(bent, robust)(placed[name], positions))
            ours[name].append((time.perf_counter() - began) / trials)
            for how in against.get(name, ()):
                frames = data[:looped].reshape(-1, 128)
                began = time.perf_counter()
                other = [scipy_frame(row, lateral, how) for row in frames]
                theirs[how].append((time.perf_counter() - began) / looped)
                if not robust:
                    points = np.asarray(fit.position)[:looped].reshape(-1, 2)
                    agreement = max(agreement, float(np.abs(np.array(other) - points).max()))
    rows: list[list[object]] = []
    for name, times in ours.items():
        for how in against.get(name, ("",)):
            other = theirs.get(how, [])
            ratios = [b / a for a, b in zip(times, other, strict=True)] if other else []
            rows.append(
                [name, 1e6 * float(np.median(times)), f"scipy, {how}" if how else "",
                 1e6 * float(np.median(other)) if other else "",
                 float(np.median(ratios)) if ratios else ""]
            )  # fmt: skip
    rows += [
        ["largest difference from scipy's points (mm)", agreement, "", "", ""],
        ["trials in a batch; in the loop; rounds", trials, looped, rounds, ""],
        ["load average before and after", load, os.getloadavg()[0], "", ""],
        [machine(), "", "", "", ""],
    ]
    header = ["case", "jaxcal_us_per_trial", "against", "us_per_trial", "median_ratio"]
    write_table(folder / "benchmark_segmentation.csv", header, rows)
    for row in rows:
        print(*row)


if __name__ == "__main__":
    main()
