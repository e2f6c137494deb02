"""How large a mean of the offsets do the images show, and what does the stated error say of it?

Normal offsets of SD 1 or 0.5 mm about a mean, 400 recordings a condition, solved by the default
method: how often the 95 % interval of X's elevational translation covers the true value, how far
that translation is off, and how often the intervals of TRE at twenty image points hold the actual
one. A mean is a shift along the elevational axis, but for the range, which it changes by y^2 /
(2 r). So it matters how accurate ranges are: the noise of 0.5 mm on each element's distance makes
range errors of about 0.07 mm, as from times of flight; that of 3 mm about 0.4 mm, as from clicks.

Seed 20261127; trial k of a condition is fold_in(root, condition * 10^6 + k), the same draws for
every mean: the probe is moved along the image's elevational axis.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from common import (
    POINTS_MM,
    arguments,
    experiments,
    machine,
    point_errors,
    problems_of,
    right_errors,
    save_figure,
    write_rows,
)
from matplotlib.figure import Figure

from jaxcal import Protocol, calibrate_batch, transform_intervals
from jaxcal.diagnostics.intervals import tre_at
from jaxcal.study.simulation import Experiment

SEED = 20261127
TRIALS = 400
NOISES_MM = (0.5, 3.0)
"""On each element's distance."""
SIZES = (25, 100)
MEANS_MM = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
SDS_MM = (1.0, 0.5)
ELEVATIONAL = 1


def moved(drawn: Experiment, mean: float) -> Experiment:
    """The probe is moved, so that the target lies by ``mean`` mm farther along the image's y."""
    across = jnp.einsum("knij,kj->kni", drawn.poses[..., :3, :3], drawn.image_to_probe[:, :3, 1])
    there = np.linalg.inv(np.asarray(drawn.poses @ drawn.image_to_probe[:, None]))
    axial = jnp.einsum("knj,kj->kn", there[..., 2, :3], drawn.point) + there[..., 2, 3]
    before, after = (jnp.hypot(drawn.elevation + by, axial) for by in (0.0, mean))
    return replace(
        drawn,
        poses=drawn.poses.at[..., :3, 3].add(-mean * across),
        points=drawn.points.at[..., 1].add(after - before),
        elevation=drawn.elevation + mean,
    )


def draw(rows: list[dict[str, float]]) -> Figure:
    """Coverage against the mean of the offsets, a line for each number of images and noise."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = figure.subplots(1, len(SDS_MM), sharey=True)
    for axes, sd in zip(panels, SDS_MM, strict=True):
        for (images, noise), marker in zip(
            itertools.product(SIZES, NOISES_MM), "so^v", strict=True
        ):
            wanted = (sd, images, noise)
            shown = [
                row for row in rows if (row["sd_mm"], row["images"], row["noise_mm"]) == wanted
            ]
            axes.plot(
                [row["mean_mm"] for row in shown],
                [100 * row["cover_t_elevational"] for row in shown],
                marker=marker,
                label=f"{images} images, ranges +- {shown[0]['range_sd_mm']:.2f} mm",
            )
        axes.axhline(95, color="0.5", linestyle=":", linewidth=1)
        axes.set(xlabel=f"mean of the offsets (mm), their SD is {sd:g} mm", ylim=(0, 102))
    panels[0].set_ylabel("95 % intervals of X's elevational\ntranslation that hold (%)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2,
                  fontsize="small")  # fmt: skip
    return figure


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 50 if quick else TRIALS
    rows: list[dict[str, float]] = []
    conditions = itertools.product(SDS_MM, SIZES, NOISES_MM)
    for condition, (sd, images, noise) in enumerate(conditions):
        protocol = Protocol(
            images=images, test_images=2, elevation_distribution="normal", elevation_mm=sd,
            noise_mm=noise,
        )  # fmt: skip
        centred = experiments(SEED, condition * 1_000_000 + jnp.arange(trials), protocol)
        for mean in MEANS_MM:
            drawn = moved(centred, mean)
            result = calibrate_batch(problems_of(drawn, covariances=True), chunk=50)
            assert result.offset_law is not None
            found, truth = np.asarray(result.image_to_probe), np.asarray(drawn.image_to_probe)
            off, half = right_errors(found, truth), np.asarray(transform_intervals(result))
            shift = np.abs(off[:, ELEVATIONAL])
            error = point_errors(found, truth)
            stated = tre_at(result, POINTS_MM)
            rows.append(
                {
                    "sd_mm": sd,
                    "images": images,
                    "noise_mm": noise,
                    "range_sd_mm": float(np.sqrt(np.mean(np.asarray(drawn.covariance)[..., 1, 1]))),
                    "mean_mm": mean,
                    "trials": trials,
                    "cover_t_elevational": float(np.mean(shift <= half[:, ELEVATIONAL])),
                    "median_shift_mm": float(np.median(shift)),
                    "held_at_points": float(
                        np.mean((error >= stated.lower) & (error <= stated.upper))
                    ),
                    "mean_probability": float(
                        np.mean(np.asarray(result.offset_law.mean_probability))
                    ),
                    "not_converged": int(np.sum(~np.asarray(result.converged))),
                }
            )
            print(", ".join(f"{k} {v:.4g}" for k, v in rows[-1].items()), flush=True)
            write_rows(folder / "off_centre.csv", rows)
    save_figure(draw(rows), folder / "off_centre.png", 150)
    print(machine())


if __name__ == "__main__":
    main()
