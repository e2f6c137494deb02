"""Gross outliers: the robust solve against an oracle that knows which images are spoilt.

A tenth and three tenths of the images are spoilt by 20 to 100 mm (``jaxcal.contamination``: wrong
echo, wrong click, wrong pose, slipped mount), for three laws of the offsets and nine cells of the
paper's grid at n = 50; each kind by itself and other numbers of images in the middle cell. Mean
reconstruction precision of the robust solve, of the same solve with the spoilt images masked, and
of the solve that does nothing about them; the share of the spoilt images that are named, and of
clean ones that are (false alarms). Rows with fraction 0 say what robustness costs clean data.

Seed 20261125; trial k of a cell is fold_in(root, cell * 10^6 + k).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, machine, results_folder, write_table
from jaxtyping import Array

from jaxcal import Protocol, calibrate_batch, reconstruction_precision, simulate
from jaxcal.cli.cache import enable_compilation_cache
from jaxcal.contamination import OutlierKind, contaminate
from jaxcal.io.atomic import atomic_path
from jaxcal.offsets import OffsetLaw

SEED = 20261125
LAWS: tuple[OffsetLaw, ...] = ("uniform", "normal", "heavy-tailed")
ELEVATIONS_MM = (0.5, 2.0, 5.0)
NOISES_MM = (0.5, 2.0, 10.0)
FRACTIONS = (0.0, 0.1, 0.3)
MIDDLE = (2.0, 2.0)
KINDS: tuple[OutlierKind, ...] = ("echo", "click", "pose", "slip")
IMAGES = (12, 20, 200)
LARGEST_RATIO, LEAST_NAMED, MOST_FALSE = 1.10, 0.95, 0.02


@dataclass(frozen=True)
class Cell:
    """One condition."""

    law: OffsetLaw
    elevation_mm: float
    noise_mm: float
    fraction: float
    kind: OutlierKind = "mixed"
    images: int = 50


def cells(quick: bool) -> list[Cell]:
    """The grid, then each kind and each number of images in its middle."""
    grid = [
        Cell(law, elevation, noise, fraction)
        for law, fraction, elevation, noise in itertools.product(
            LAWS, FRACTIONS, ELEVATIONS_MM, NOISES_MM
        )
        if not quick or (elevation, noise) == MIDDLE or law == "uniform"
    ]
    kinds = [
        Cell("uniform", *MIDDLE, fraction, kind)
        for kind, fraction in itertools.product(KINDS, FRACTIONS[1:])
    ]
    sizes = [
        Cell("uniform", *MIDDLE, fraction, images=images)
        for images, fraction in itertools.product(IMAGES[:1] if quick else IMAGES, FRACTIONS)
    ]
    return grid + kinds + sizes


@partial(jax.jit, static_argnames=("law", "fraction", "kind", "images"))
def draw(indices: Array, elevation_mm, noise_mm, *, law, fraction, kind, images):
    """Experiments, their spoilt problems and which images are spoilt."""
    protocol = Protocol(images=images, elevation_distribution=law)
    protocol = replace(protocol, elevation_mm=elevation_mm, noise_mm=noise_mm)

    def one(index: Array):
        key = jax.random.fold_in(jax.random.key(SEED), index)
        experiment = simulate(key, protocol)
        spoilt, outlier = contaminate(
            jax.random.fold_in(key, 1), experiment.problem(), fraction, kind
        )
        return experiment, spoilt, outlier

    return jax.vmap(one)(indices)


def run_cell(index: int, cell: Cell, trials: int) -> list[object]:
    """A row of the table."""
    experiments, problems, outlier = draw(
        index * 1_000_000 + jnp.arange(trials), cell.elevation_mm, cell.noise_mm, law=cell.law,
        fraction=cell.fraction, kind=cell.kind, images=cell.images,
    )  # fmt: skip
    robust = calibrate_batch(problems, robust=True)
    oracle = calibrate_batch(replace(problems, mask=problems.mask - outlier))
    plain = calibrate_batch(problems)
    precision = jax.vmap(reconstruction_precision)

    def rp(result) -> np.ndarray:
        return np.asarray(
            precision(result.image_to_probe, experiments.test_poses, experiments.test_points)
        )

    robust_rp, oracle_rp, plain_rp = rp(robust), rp(oracle), rp(plain)
    spoilt, left = np.asarray(outlier), np.asarray(robust.outlier)
    named = float((left * spoilt).sum() / spoilt.sum()) if spoilt.any() else float("nan")
    false = float((left * (1 - spoilt)).sum() / (1 - spoilt).sum())
    ratio = float(robust_rp.mean() / oracle_rp.mean())
    difference = robust_rp - oracle_rp
    half = float(1.96 * difference.std(ddof=1) / np.sqrt(trials) / oracle_rp.mean())
    failed = int((~np.asarray(robust.converged)).sum())
    return [*vars(cell).values(), trials, float(robust_rp.mean()), float(oracle_rp.mean()),
            float(plain_rp.mean()), ratio, half, named, false, failed]  # fmt: skip


HEADER = ["law", "elevation_mm", "noise_mm", "fraction", "kind", "images", "trials",
          "rp_robust_mm", "rp_oracle_mm", "rp_plain_mm", "robust_over_oracle",
          "ci95_half_of_ratio", "named", "false_alarms", "not_converged"]  # fmt: skip


def main() -> None:
    quick = arguments(__doc__ or "").quick
    trials = 24 if quick else 200
    enable_compilation_cache()
    rows = []
    for index, cell in enumerate(cells(quick)):
        rows.append(run_cell(index, cell, trials))
        print(dict(zip(HEADER, rows[-1], strict=True)), flush=True)
    folder = results_folder(quick)
    write_table(folder / "outliers.csv", HEADER, rows)
    spoilt = [row for row in rows if row[3]]
    clean = [row for row in rows if not row[3]]
    missed = [
        row for row in spoilt
        if row[10] > LARGEST_RATIO or row[12] < LEAST_NAMED or row[13] > MOST_FALSE
    ]  # fmt: skip
    print(
        f"spoilt: robust over oracle at most {max(row[10] for row in spoilt):.3f}, named at least "
        f"{min(row[12] for row in spoilt):.4f}, false alarms at most "
        f"{max(row[13] for row in spoilt):.4f}; clean: over oracle "
        f"{min(row[10] for row in clean):.3f} to {max(row[10] for row in clean):.3f}, false "
        f"alarms at most {max(row[13] for row in clean):.4f}; {machine()}"
    )
    for row in missed:
        print("beyond a bar:", row)
    plot(folder / "outliers.png", [row for row in rows if row[4] == "mixed" and row[5] == 50])


def plot(path, rows: list[list]) -> None:
    """Ratio to the oracle, share named and false alarms, cell by cell."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    names = [f"{e:g}, {s:g}" for e, s in itertools.product(ELEVATIONS_MM, NOISES_MM)]
    for law, fraction in itertools.product(LAWS, FRACTIONS):
        chosen = {f"{r[1]:g}, {r[2]:g}": r for r in rows if r[0] == law and r[3] == fraction}
        x = [k for k, name in enumerate(names) if name in chosen]
        style = {"marker": "osv"[LAWS.index(law)], "color": "kbr"[FRACTIONS.index(fraction)],
                 "linestyle": "", "fillstyle": "none",
                 "label": f"{law}, {100 * fraction:g} %"}  # fmt: skip
        for panel, column in zip(panels, (10, 12, 13), strict=True):
            panel.plot(x, [chosen[names[k]][column] for k in x], **style)
    for panel, bar, label in zip(
        panels, (LARGEST_RATIO, LEAST_NAMED, MOST_FALSE),
        ("mean RP over the oracle's", "outliers named", "clean images named"), strict=True,
    ):  # fmt: skip
        panel.axhline(bar, color="grey", linewidth=0.8)
        panel.set_ylabel(label)
    panels[0].legend(ncols=3, fontsize="x-small")
    panels[-1].set_xticks(range(len(names)), names)
    panels[-1].set_xlabel("elevational size, noise (mm)")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150)


if __name__ == "__main__":
    main()
