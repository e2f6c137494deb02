"""Curvilinear probes: the joint fit of every element's distance, the paper's way, and conventional.

For each bound of the offsets and each channel noise, mean reconstruction precision (RP) over 500
simulated experiments (n = 50) of

- conventional: points of the in-plane fit, y = 0 (Eq. 7);
- the paper's way: |y| image by image from Eq. 6, where it comes out real; the sign chosen with a
  conventional fit on the reduced subset of images whose |y| is smallest (section 2.4), then Eq. 7
  with the offsets held;
- joint: every element's distance at once, offsets under the self-tuned prior, one in-plane start;

and the share of images whose offset has the right sign, of those with |y| above a tenth of the
bound. Seed 20261121; trial k of a cell is fold_in(root, cell * 10^6 + k).
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from common import (
    arguments,
    experiments,
    half_95,
    machine,
    precision,
    save_figure,
    write_table,
)
from jaxtyping import Array, Float

from jaxcal import Protocol, calibrate_batch
from jaxcal.backend import RIGID, ImagePlanes, Iterate, Parameters, minimise, target_in_image
from jaxcal.data.probe import C5_2
from jaxcal.data.problem import Problem
from jaxcal.data.segmentation.time_of_flight import fit_out_of_plane
from jaxcal.model.observations import HeldOffsets

SEED = 20261121
BOUNDS_MM = (1.0, 3.0, 5.0)
NOISES_MM = (0.05, 0.2, 0.5, 1.0, 2.0)
SUBSET = 0.3
"""Share of the images, those of least |y|, that the paper's way calibrates with first."""


def paper_way(problems: Problem) -> Float[Array, "trials 4 4"]:
    """Image by image: |y| from Eq. 6, signs from a fit on the reduced subset, Eq. 7 with both."""
    known, size = _image_by_image(problems)
    few = jnp.sort(size, axis=1)[:, max(int(SUBSET * size.shape[1]), 9) - 1]
    subset = replace(known, mask=jnp.where(size <= few[:, None], known.mask, 0.0))
    first = calibrate_batch(subset, "conventional")
    return _with_signs(known, size, first.image_to_probe, first.point)


@jax.jit
def _image_by_image(problems: Problem) -> tuple[Problem, Float[Array, "trials n"]]:
    """The problems with ranges that know of |y|, and |y|, mm."""

    def one(problem: Problem) -> tuple[Problem, Array]:
        channels = problem.channels
        assert channels is not None
        measured = jnp.where(channels.heard > 0, channels.distances, jnp.nan)
        _, full = fit_out_of_plane(measured, channels.elements, robust=False)
        lateral, axial, square = jnp.moveaxis(full.position, -1, 0)
        size = jnp.sqrt(jnp.maximum(square, 0.0))
        # Eq. 5's range for a straight line through the apex: what the residuals take for r_i.
        points = jnp.stack([lateral, jnp.hypot(axial, size)], axis=1)
        return replace(problem, measurements=points, channels=None, covariance=None), size

    return jax.lax.map(one, problems, batch_size=64)


@jax.jit
def _with_signs(
    known: Problem, size: Float[Array, "trials n"], x: Float[Array, "trials 4 4"], point: Array
) -> Float[Array, "trials 4 4"]:
    """Eq. 7 with offsets of the given sizes, whose signs are those that X and the target say."""
    first = jax.vmap(Parameters.of)(x[:, :3, :3], x[:, :3, 3], point)
    y = jax.vmap(target_in_image)(first, known)[..., 1]
    images = ImagePlanes.of(known)
    held = HeldOffsets.of(jnp.where(y < 0, -size, size), images)
    found = minimise(Iterate.of(first, RIGID), held, images).iterate.parameters()
    return jax.vmap(Parameters.matrix)(found)


def run_cell(cell: int, bound: float, noise: float, trials: int) -> dict[str, np.ndarray]:
    indices = cell * 1_000_000 + jnp.arange(trials)
    protocol = Protocol(elevation_mm=bound, noise_mm=noise, probe=C5_2)
    drawn = experiments(SEED, indices, protocol)
    problems = jax.jit(jax.vmap(lambda e: e.problem(probe=C5_2)))(drawn)
    conventional = calibrate_batch(problems, method="conventional")
    joint = calibrate_batch(problems, method="joint", prior="gaussian")
    answers = {
        "conventional": conventional.image_to_probe,
        "paper": paper_way(problems),
        "joint": joint.image_to_probe,
    }
    tests = drawn.test_poses, drawn.test_points
    out = {name: precision(x, *tests) for name, x in answers.items()}
    truth = np.asarray(drawn.elevation)
    visible = np.abs(truth) > 0.1 * bound
    right = np.sign(np.asarray(joint.elevation)) == np.sign(truth)
    out["sign"] = np.array([right[visible].mean()])
    out["converged"] = np.asarray(joint.converged)
    out["sigma"] = np.asarray(joint.sigma)[:, 2] / np.sqrt(np.mean(truth**2, axis=1))
    assert joint.channel_sigma is not None
    out["channel"] = np.asarray(joint.channel_sigma) / noise
    return out


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 50 if quick else 500
    rows = []
    ratios = np.zeros((len(BOUNDS_MM), len(NOISES_MM)))
    for cell, (bound, noise) in enumerate(itertools.product(BOUNDS_MM, NOISES_MM)):
        got = run_cell(cell, bound, noise, trials)
        mean = {name: float(got[name].mean()) for name in ("conventional", "paper", "joint")}
        paired = got["joint"] - got["conventional"]
        half = half_95(paired)
        ratio = mean["joint"] / mean["conventional"]
        ratios[BOUNDS_MM.index(bound), NOISES_MM.index(noise)] = ratio
        signs, failures = float(got["sign"][0]), int((~got["converged"]).sum())
        rows.append([bound, noise, trials, *mean.values(), ratio,
                     mean["paper"] / mean["conventional"], float(paired.mean()), half, signs,
                     float(got["channel"].mean()), float(got["sigma"].mean()),
                     failures])  # fmt: skip
        print(
            f"offsets to {bound:g} mm, noise {noise:g} mm: RP "
            + ", ".join(f"{name} {value:.4f}" for name, value in mean.items())
            + f" mm; joint/conventional {ratio:.3f}; signs {100 * signs:.2f} %; "
            f"not converged {failures}",
            flush=True,
        )
    write_table(
        folder / "curvilinear_joint.csv",
        ["offset_bound_mm", "channel_noise_mm", "trials", "rp_conventional_mm", "rp_paper_way_mm",
         "rp_joint_mm", "joint_over_conventional", "paper_way_over_conventional",
         "paired_difference_mm", "ci95_half_mm", "right_signs", "channel_sigma_over_true",
         "sigma_elevation_over_realised", "joint_not_converged"],
        rows,
    )  # fmt: skip
    print(f"worst ratio {ratios.max():.3f}; fewest right signs "
          f"{100 * min(row[10] for row in rows):.2f} %; {machine()}")  # fmt: skip
    plot(folder / "curvilinear_joint.png", rows)


def plot(path, rows: list) -> None:
    """Mean RP against channel noise for the three ways, a panel for each bound."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    panels = figure.subplots(1, len(BOUNDS_MM), sharey=True)
    for axes, bound in zip(panels, BOUNDS_MM, strict=True):
        own = [row for row in rows if row[0] == bound]
        noise = [row[1] for row in own]
        for column, name in ((3, "conventional"), (4, "the paper's way"), (5, "joint")):
            axes.loglog(noise, [row[column] for row in own], "o-", label=name)
        axes.set(title=f"offsets to {bound:g} mm", xlabel="channel noise, SD (mm)")
        axes.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("mean reconstruction precision (mm)")
    panels[0].legend()
    figure.suptitle("Curvilinear probe, n = 50")
    save_figure(figure, path, dpi=150)


if __name__ == "__main__":
    main()
