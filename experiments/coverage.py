"""Do the intervals of prior ``auto`` cover, and does the predicted TRE tell the actual one?

1,000 trials for 50 and for 12 images and for uniform, Gaussian and heavy-tailed offsets of 2 mm
(bound or SD) at 2 mm of noise: how often the 95 % intervals of X's six parameters cover the true
values, and the root mean square target registration error over a grid of image points, predicted
against actual.
Seed 20261125; trial k of a condition is fold_in(root, condition * 10^6 + k).
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from common import arguments, machine, results_folder, write_table
from jaxtyping import Array

from jaxcal import Protocol, calibrate_batch, predicted_tre, simulate, transform_intervals
from jaxcal.io.atomic import atomic_path
from jaxcal.offsets import OffsetLaw

SEED = 20261125
LAWS: tuple[OffsetLaw, ...] = ("uniform", "normal", "heavy-tailed")
AXES = ("t_lateral", "t_elevational", "t_axial", "r_lateral", "r_elevational", "r_axial")
ELEVATION_MM, NOISE_MM = 2.0, 2.0
POINTS_MM = np.stack(
    np.meshgrid(np.linspace(-20, 20, 5), np.linspace(20, 80, 4), indexing="ij"), axis=-1
)
HEADER = [
    "elevation_distribution", "images", "trials",
    *(f"cover_{axis}" for axis in AXES),
    "tre_actual_mm", "tre_predicted_mm", "predicted_over_actual", "not_converged",
]  # fmt: skip


@partial(jax.jit, static_argnums=(0, 1))
def draw(law: OffsetLaw, images: int, indices: Array):
    """Experiments of one condition."""
    protocol = Protocol(
        images=images, test_images=2, elevation_distribution=law,
        elevation_mm=ELEVATION_MM, noise_mm=NOISE_MM,
    )  # fmt: skip
    root = jax.random.key(SEED)
    return jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol))(indices)


@jax.jit
def errors(estimate: Array, truth: Array) -> tuple[Array, Array]:
    """The right perturbation from estimate to truth (6), and how far the points are off, mm."""

    def one(x: Array, true: Array) -> tuple[Array, Array]:
        turn = jaxlie.SO3.from_matrix(x[:3, :3].T @ true[:3, :3]).log()
        shift = x[:3, :3].T @ (true[:3, 3] - x[:3, 3])
        points = jnp.asarray(POINTS_MM)
        there = jnp.stack([points[..., 0], 0 * points[..., 0], points[..., 1]], axis=-1)
        apart = there @ (x - true)[:3, :3].T + (x - true)[:3, 3]
        return jnp.concatenate([shift, turn]), jnp.linalg.norm(apart, axis=-1)

    return jax.vmap(one)(estimate, truth)


def main() -> None:
    quick = arguments(__doc__ or "").quick
    trials = 200 if quick else 1000
    rows: list[list[object]] = []
    conditions = list(itertools.product((50, 12), LAWS))
    for condition, (images, law) in enumerate(conditions):
        experiments = draw(law, images, condition * 1_000_000 + jnp.arange(trials))
        plain = jax.vmap(lambda experiment: experiment.problem())(experiments)
        problems = replace(plain, covariance=experiments.covariance)
        result = calibrate_batch(problems, "joint", chunk=50)
        error, distance = errors(result.image_to_probe, experiments.image_to_probe)
        cover = np.abs(error) <= transform_intervals(result)
        predicted = np.asarray(predicted_tre(result, POINTS_MM))
        actual = float(np.sqrt(np.mean(np.asarray(distance) ** 2)))
        told = float(np.sqrt(np.mean(predicted**2)))
        row = [law, images, trials, *map(float, cover.mean(axis=0)), actual, told,
               told / actual, int(np.sum(~np.asarray(result.converged)))]  # fmt: skip
        rows.append(row)
        shares = np.round(cover.mean(axis=0), 3).tolist()
        print(f"{law}, n = {images}: covers {shares}; TRE {actual:.3f} mm, predicted "
              f"{told:.3f} mm ({told / actual:.3f}); not converged {row[-1]}",
              flush=True)  # fmt: skip
    folder = results_folder(quick)
    write_table(folder / "coverage.csv", HEADER, rows)
    print(machine())
    plot(folder / "coverage.png", rows)


def plot(path: Path, rows: list[list[object]]) -> None:
    """Coverage of every parameter, and predicted over actual TRE."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    names = [f"{row[0]}\nn = {row[1]}" for row in rows]
    for k, axis in enumerate(AXES):
        left.plot([float(str(row[3 + k])) for row in rows], "o", label=axis, markersize=4)
    left.axhspan(0.92, 0.98, color="0.9")
    left.axhline(0.95, color="black", linewidth=0.8)
    left.set(ylabel="coverage of 95 % intervals", ylim=(0.85, 1))
    left.legend(fontsize="x-small", ncols=3)
    right.plot([float(str(row[11])) for row in rows], "o")
    right.axhspan(0.9, 1.1, color="0.9")
    right.axhline(1, color="black", linewidth=0.8)
    right.set(ylabel="predicted over actual TRE", ylim=(0.7, 1.3))
    for panel in (left, right):
        panel.set_xticks(range(len(rows)), names, fontsize=7)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)


if __name__ == "__main__":
    main()
