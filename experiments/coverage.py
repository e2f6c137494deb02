"""Do the intervals cover, and does the predicted TRE tell the actual one?

1,000 trials for 50 and for 12 images, for uniform, Gaussian and heavy-tailed offsets, and for three
sizes of offsets (bound or SD) and noise: how often the 95 % intervals of X's six parameters cover
the true values, and the root mean square target registration error over a grid of image points,
predicted against actual. A share of 1,000 trials is known to +- 1.4 % (two SDs); what lies outside
the limits asked for is named. ``coverage.csv`` is of the joint method with prior ``auto``,
``coverage_conventional.csv`` of the conventional method in the same trials.

Seed 20261125; trial k of a condition is fold_in(root, condition * 10^6 + k).
"""

from __future__ import annotations

import itertools
from pathlib import Path

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
    write_table,
)

from jaxcal import Protocol, calibrate_batch, predicted_tre, transform_intervals
from jaxcal.solvers.names import Method
from jaxcal.study.laws import LawName

SEED = 20261125
FILES: dict[Method, str] = {"joint": "coverage", "conventional": "coverage_conventional"}
"""The table of each method."""
LAWS: tuple[LawName, ...] = ("uniform", "normal", "heavy-tailed")
AXES = ("t_lateral", "t_elevational", "t_axial", "r_lateral", "r_elevational", "r_axial")
SIZES_MM = ((2.0, 2.0), (1.0, 0.5), (5.0, 2.0))
"""Offsets and noise."""
ASKED = {50: (0.92, 0.98), 12: (0.90, 0.98)}
"""Coverage asked for, by the number of images."""
TRE_WITHIN = 0.1
HEADER = [
    "elevation_distribution", "images", "elevation_mm", "noise_mm", "trials",
    *(f"cover_{axis}" for axis in AXES),
    "tre_actual_mm", "tre_predicted_mm", "predicted_over_actual", "not_converged",
]  # fmt: skip


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 200 if quick else 1000
    tables: dict[Method, list[list[object]]] = {method: [] for method in FILES}
    conditions = list(itertools.product(SIZES_MM[:1] if quick else SIZES_MM, ASKED, LAWS))
    for condition, ((elevation, noise), images, law) in enumerate(conditions):
        indices = condition * 1_000_000 + jnp.arange(trials)
        protocol = Protocol(
            images=images, test_images=2, elevation_distribution=law, elevation_mm=elevation,
            noise_mm=noise,
        )  # fmt: skip
        drawn = experiments(SEED, indices, protocol)
        problems = problems_of(drawn, covariances=True)
        for method, rows in tables.items():
            result = calibrate_batch(problems, method, chunk=50)
            found, truth = np.asarray(result.image_to_probe), np.asarray(drawn.image_to_probe)
            cover = np.abs(right_errors(found, truth)) <= transform_intervals(result)
            predicted = np.asarray(predicted_tre(result, POINTS_MM))
            # An answer that is not observable has no interval, and states no error.
            known = np.isfinite(predicted).all(axis=1)
            actual = float(np.sqrt(np.mean(point_errors(found, truth)[known] ** 2)))
            told = float(np.sqrt(np.mean(predicted[known] ** 2)))
            row = [law, images, elevation, noise, trials, *map(float, cover.mean(axis=0)), actual,
                   told, told / actual, int(np.sum(~np.asarray(result.converged)))]  # fmt: skip
            rows.append(row)
            shares = np.round(cover.mean(axis=0), 3).tolist()
            print(f"{method}, {law}, n = {images}, {elevation:g} mm, noise {noise:g} mm: "
                  f"covers {shares}; TRE {actual:.3f} mm, predicted {told:.3f} mm "
                  f"({told / actual:.3f}); not converged {row[-1]}", flush=True)  # fmt: skip
            write_table(folder / f"{FILES[method]}.csv", HEADER, rows)
    for method, rows in tables.items():
        for line in misses(rows):
            print(f"{method}: {line}")
    print(machine())
    plot(folder / f"{FILES['joint']}.png", tables["joint"])


def misses(rows: list[list[object]]) -> list[str]:
    """What lies outside the limits asked for."""
    lines = []
    for row in rows:
        shown = dict(zip(HEADER, row, strict=True))
        where = f"{row[0]}, n = {row[1]}, {row[2]:g} mm, noise {row[3]:g} mm"
        low, high = ASKED[int(str(row[1]))]
        for axis in AXES:
            share = float(str(shown[f"cover_{axis}"]))
            if not low <= share <= high:
                lines.append(f"misses: {where}: {axis} covers {share:.3f}")
        ratio = float(str(shown["predicted_over_actual"]))
        if abs(ratio - 1) > TRE_WITHIN:
            lines.append(f"misses: {where}: predicted over actual TRE {ratio:.3f}")
    return lines or ["nothing lies outside the limits asked for"]


def plot(path: Path, rows: list[list[object]]) -> None:
    """Coverage of every parameter, and predicted over actual TRE."""
    from matplotlib.figure import Figure

    column = {name: [row[k] for row in rows] for k, name in enumerate(HEADER)}
    figure = Figure(figsize=(12, 8), layout="constrained")
    upper, lower = figure.subplots(2, 1)
    names = [f"{row[0]}\nn = {row[1]}\n{row[2]:g}, {row[3]:g} mm" for row in rows]
    for axis in AXES:
        kind = {"t": "translation", "r": "rotation"}[axis[0]]
        upper.plot(column[f"cover_{axis}"], "o", label=f"{kind}, {axis[2:]}", markersize=4)
    for k, row in enumerate(rows):
        upper.fill_between([k - 0.5, k + 0.5], *ASKED[int(str(row[1]))], color="0.9",
                           label=None if k else "asked for")  # fmt: skip
    upper.axhline(0.95, color="black", linewidth=0.8)
    upper.set(ylabel="coverage of 95 % intervals", ylim=(0.85, 1))
    upper.legend(fontsize="x-small", ncols=7)
    lower.plot(column["predicted_over_actual"], "o")
    lower.axhspan(1 - TRE_WITHIN, 1 + TRE_WITHIN, color="0.9", label="within 10 %")
    lower.legend(fontsize="x-small")
    lower.axhline(1, color="black", linewidth=0.8)
    lower.set(
        ylabel="predicted over actual TRE",
        xlabel="distribution of the offsets; images; size of offsets, noise",
    )
    for panel in (upper, lower):
        panel.set_xticks(range(len(rows)), names, fontsize=7)
    save_figure(figure, path, dpi=130)


if __name__ == "__main__":
    main()
