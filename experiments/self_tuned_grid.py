"""Three methods on the paper's 7 x 7 grid (elevation x noise, uniform offsets, n = 50).

Mean reconstruction precision of conventional calibration, the paper's alternation (1 mm, its
stopping rule) and the self-tuned joint solver (Gaussian offsets, REML), all on the same draws; and
the self-tuned SDs against what was realised. Seed 20261121; trial k of a cell is
fold_in(root, cell * 10^6 + k).
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from common import ELEVATIONS_MM, NOISES_MM, arguments, machine, results_folder, write_table
from jaxtyping import Array

from jaxcal import Protocol, calibrate_batch, reconstruction_precision, simulate
from jaxcal.io.atomic import atomic_path

SEED = 20261121


def run_cell(cell: int, elevation: float, noise: float, trials: int) -> dict[str, np.ndarray]:
    """All trials of one cell: RP of every method, estimated and realised SDs (mm)."""
    protocol = Protocol(elevation_mm=elevation, noise_mm=noise)
    indices = cell * 1_000_000 + jnp.arange(trials)

    @jax.jit
    def draw(indices: Array):
        root = jax.random.key(SEED)
        return jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol))(indices)

    experiments = draw(indices)
    problems = jax.vmap(lambda experiment: experiment.problem())(experiments)
    results = {
        "conventional": calibrate_batch(problems, method="conventional"),
        "alternating": calibrate_batch(problems, method="alternating"),
        "joint": calibrate_batch(problems, method="joint", prior="gaussian"),
    }
    precision = jax.vmap(reconstruction_precision)
    out: dict[str, np.ndarray] = {}
    for name, result in results.items():
        rp = precision(result.image_to_probe, experiments.test_poses, experiments.test_points)
        out[name] = np.asarray(rp)
        out[f"{name}_converged"] = np.asarray(result.converged)
    out["sigma"] = np.asarray(results["joint"].sigma)
    out["realised"] = np.asarray(realised(experiments))
    return out


@jax.jit
def realised(experiments) -> Array:
    """Root mean square of the true lateral, range and elevational errors of each trial, mm."""

    def one(e):
        in_probe = jnp.einsum("nji,nj->ni", e.poses[:, :3, :3], e.point - e.poses[:, :3, 3])
        q = (in_probe - e.image_to_probe[:3, 3]) @ e.image_to_probe[:3, :3]
        errors = [e.points[:, 0] - q[:, 0], e.points[:, 1] - jnp.hypot(q[:, 1], q[:, 2]), q[:, 1]]
        return jnp.sqrt(jnp.mean(jnp.stack(errors) ** 2, axis=1))

    return jax.vmap(one)(experiments)


def main() -> None:
    quick = arguments(__doc__ or "").quick
    trials = 40 if quick else 200
    rows, ratios, worst = [], np.zeros((7, 7)), 0.0
    for cell, (elevation, noise) in enumerate(itertools.product(ELEVATIONS_MM, NOISES_MM)):
        got = run_cell(cell, elevation, noise, trials)
        mean = {name: float(got[name].mean()) for name in ("conventional", "alternating", "joint")}
        paired = got["joint"] - got["conventional"]
        half = float(1.96 * paired.std(ddof=1) / np.sqrt(trials))
        # A component without error has nothing to be compared with.
        truth = got["realised"]
        true = truth.mean(axis=0)
        sigma = [
            float((got["sigma"][:, k] / truth[:, k]).mean()) if true[k] > 1e-6 else float("nan")
            for k in range(3)
        ]
        ratio = mean["joint"] / mean["conventional"] if elevation or noise else float("nan")
        ratios[ELEVATIONS_MM.index(elevation), NOISES_MM.index(noise)] = ratio
        worst = max(worst, ratio if np.isfinite(ratio) else 0.0)
        failures = int(sum((~got[f"{m}_converged"]).sum() for m in mean))
        rows.append([elevation, noise, trials, *mean.values(), ratio, float(paired.mean()), half,
                     *sigma, failures])  # fmt: skip
        means = ", ".join(f"{name} {value:.4f}" for name, value in mean.items())
        print(
            f"elevation {elevation:g} noise {noise:g} mm: RP {means} mm; ratio {ratio:.3f}; "
            f"sigma/realised {np.round(sigma, 3).tolist()}; not converged {failures}",
            flush=True,
        )
    folder = results_folder(quick)
    write_table(
        folder / "self_tuned_grid.csv",
        ["elevation_mm", "noise_mm", "trials", "rp_conventional_mm", "rp_alternating_mm",
         "rp_joint_mm", "joint_over_conventional", "paired_difference_mm", "ci95_half_mm",
         "sigma_lateral_over_realised", "sigma_range_over_realised",
         "sigma_elevation_over_realised", "not_converged"],
        rows,
    )  # fmt: skip
    off = np.array([row[9:12] for row in rows], dtype=float)
    print(f"worst ratio {worst:.3f}; sigmas over realised between {np.nanmin(off):.3f} and "
          f"{np.nanmax(off):.3f}; {machine()}")  # fmt: skip
    plot(folder / "self_tuned_grid.png", ratios)


def plot(path, ratios: np.ndarray) -> None:
    """Joint over conventional, cell by cell."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.5, 5), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(ratios, cmap="RdBu_r", vmin=0, vmax=2, origin="lower")
    for i, j in itertools.product(range(7), range(7)):
        if np.isfinite(ratios[i, j]):
            axes.text(j, i, f"{ratios[i, j]:.2f}", ha="center", va="center")
    axes.set_xticks(range(7), [f"{noise:g}" for noise in NOISES_MM])
    axes.set_yticks(range(7), [f"{elevation:g}" for elevation in ELEVATIONS_MM])
    axes.set(xlabel="noise on each distance, SD (mm)", ylabel="elevational offset, bound (mm)",
             title="Mean RP, self-tuned joint over conventional")  # fmt: skip
    figure.colorbar(image, ax=axes, label="ratio (below 1: joint better)")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)


if __name__ == "__main__":
    main()
