"""Gross outliers: the robust solve against an oracle that knows which images are spoilt.

A tenth and three tenths of the images are spoilt by 20 to 100 mm (``contamination``: wrong echo,
wrong click, wrong pose, slipped mount), for three distributions of the offsets and five cells of
the paper's grid at n = 50; each kind by itself, and 12, 20 and 200 images, in the middle cell. Mean
reconstruction precision of the robust solve (prior auto, points alone), of the same solve with the
spoilt images masked, and of the solve that does nothing about them; the share of the spoilt images
that are named, and of clean ones that are (false alarms); in how many trials a spoilt image stayed.
Rows with fraction 0 say what robustness costs clean data.

Seed 20261126, another than that on which the consensus was tried out; trial k of a cell is
fold_in(root, cell * 10^6 + k).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from common import (
    arguments,
    machine,
    paired_ratio,
    precision,
    save_figure,
    write_table,
)
from contamination import OutlierKind, contaminate
from jaxtyping import Array

from jaxcal import Protocol, calibrate_batch, simulate
from jaxcal.runtime.jax_cache import enable_compilation_cache
from jaxcal.study.offsets import LawName

SEED = 20261126
LAWS: tuple[LawName, ...] = ("uniform", "normal", "heavy-tailed")
SIZES_MM = ((0.5, 0.5), (0.5, 10.0), (2.0, 2.0), (5.0, 0.5), (5.0, 10.0))
"""Elevational size and noise: the corners of the paper's grid without zeros, and its middle."""
FRACTIONS = (0.0, 0.1, 0.3)
MIDDLE = (2.0, 2.0)
KINDS: tuple[OutlierKind, ...] = ("echo", "click", "pose", "slip")
IMAGES = (12, 20, 200)
LARGEST_RATIO, LEAST_NAMED, MOST_FALSE = 1.10, 0.95, 0.02


@dataclass(frozen=True)
class Cell:
    """One condition."""

    law: LawName
    elevation_mm: float
    noise_mm: float
    fraction: float
    kind: OutlierKind = "mixed"
    images: int = 50


def cells(quick: bool) -> list[Cell]:
    """A dozen and twenty images in the middle of the grid, the grid, the kinds, many images."""
    grid = [
        Cell(law, *size, fraction)
        for law, fraction, size in itertools.product(LAWS, FRACTIONS, SIZES_MM)
        if not quick or size == MIDDLE or law == "uniform"
    ]
    kinds = [
        Cell("uniform", *MIDDLE, fraction, kind)
        for kind, fraction in itertools.product(KINDS, FRACTIONS[1:])
    ]
    sizes = [
        Cell(law, *MIDDLE, fraction, images=images)
        for images, law, fraction in itertools.product(
            IMAGES[:1] if quick else IMAGES, LAWS, FRACTIONS
        )
        if law == LAWS[0] or images < 50
    ]
    few = [cell for cell in sizes if cell.images < 50]
    return few + grid + kinds + [cell for cell in sizes if cell.images > 50]


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
    # Which images agree does not depend on the method: the cheapest one to compile finds them, and
    # the three solves are one program.
    agreed = calibrate_batch(problems, "conventional", robust=True).mask
    robust = calibrate_batch(replace(problems, mask=agreed))
    oracle = calibrate_batch(replace(problems, mask=problems.mask - outlier))
    plain = calibrate_batch(problems)
    tests = experiments.test_poses, experiments.test_points
    robust_rp, oracle_rp, plain_rp = (
        precision(found.image_to_probe, *tests) for found in (robust, oracle, plain)
    )
    spoilt, left = np.asarray(outlier), 1 - np.asarray(agreed)
    named = float((left * spoilt).sum() / spoilt.sum()) if spoilt.any() else float("nan")
    false = float((left * (1 - spoilt)).sum() / (1 - spoilt).sum())
    ratio, half = paired_ratio(robust_rp, oracle_rp)
    median = float(np.median(robust_rp / oracle_rp))
    stayed = int(((1 - left) * spoilt).any(axis=1).sum())
    failed = int((~np.asarray(robust.converged)).sum())
    return [*vars(cell).values(), trials, float(robust_rp.mean()), float(oracle_rp.mean()),
            float(plain_rp.mean()), ratio, half, median, named, false, stayed,
            failed]  # fmt: skip


HEADER = ["law", "elevation_mm", "noise_mm", "fraction", "kind", "images", "trials",
          "rp_robust_mm", "rp_oracle_mm", "rp_plain_mm", "robust_over_oracle",
          "ci95_half_of_ratio", "median_robust_over_oracle", "named", "false_alarms",
          "trials_with_one_left_in", "not_converged"]  # fmt: skip


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 24 if quick else 200
    enable_compilation_cache()
    rows: list[list] = []
    for index, cell in enumerate(cells(quick)):
        rows.append(run_cell(index, cell, trials))
        print(dict(zip(HEADER, rows[-1], strict=True)), flush=True)
        write_table(folder / "outliers.csv", HEADER, rows)
    spoilt = [row for row in rows if row[3]]
    clean = [row for row in rows if not row[3]]
    missed = [
        row for row in spoilt
        if row[10] > LARGEST_RATIO or row[13] < LEAST_NAMED or row[14] > MOST_FALSE
    ]  # fmt: skip
    print(
        f"spoilt: robust over oracle at most {max(row[10] for row in spoilt):.3f}, named at least "
        f"{min(row[13] for row in spoilt):.4f}, false alarms at most "
        f"{max(row[14] for row in spoilt):.4f}; clean: over oracle "
        f"{min(row[10] for row in clean):.3f} to {max(row[10] for row in clean):.3f}, false "
        f"alarms at most {max(row[14] for row in clean):.4f}; {machine()}"
    )
    for row in missed:
        print("beyond a bar:", row)
    plot(folder / "outliers.png", [row for row in rows if row[4] == "mixed"])


def plot(path, rows: list[list]) -> None:
    """Ratio to the oracle, share named and false alarms, cell by cell."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    names = [f"{e:g}, {s:g}" for e, s in SIZES_MM]
    names += [f"n = {images}" for images in IMAGES]

    def name_of(row: list) -> str:
        return f"{row[1]:g}, {row[2]:g}" if row[5] == 50 else f"n = {row[5]}"

    for law, fraction in itertools.product(LAWS, FRACTIONS):
        chosen = {name_of(r): r for r in rows if r[0] == law and r[3] == fraction}
        x = [k for k, name in enumerate(names) if name in chosen]
        style = {"marker": "osv"[LAWS.index(law)], "color": "kbr"[FRACTIONS.index(fraction)],
                 "linestyle": "", "fillstyle": "none",
                 "label": f"{law}, {100 * fraction:g} %"}  # fmt: skip
        for panel, column in zip(panels, (10, 13, 14), strict=True):
            panel.plot(x, [chosen[names[k]][column] for k in x], **style)
    for panel, bar, label in zip(
        panels, (LARGEST_RATIO, LEAST_NAMED, MOST_FALSE),
        ("mean RP over the oracle's", "outliers named", "clean images named"), strict=True,
    ):  # fmt: skip
        panel.axhline(bar, color="grey", linewidth=0.8, label="limit asked for")
        panel.set_ylabel(label)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4,
                  fontsize="x-small")  # fmt: skip
    panels[-1].set_xticks(range(len(names)), names)
    panels[-1].set_xlabel(
        "elevational size, noise (mm), n = 50; and 2, 2 at other numbers of images"
    )
    save_figure(figure, path, dpi=150)


if __name__ == "__main__":
    main()
