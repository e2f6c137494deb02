"""Prior ``auto`` on the paper's 7 x 7 grid for five laws of the offsets, and for 12 to 200 images.

On the same draws: conventional calibration, the paper's alternation (1 mm, its stopping rule), and
the joint method with prior ``auto``, from points with the covariances that the times of flight give
(``auto``) and from points alone (``auto_points``). Beside them, at n = 50, the alternation with its
best bound and best number of rounds, chosen in hindsight for each cell by the true error (nobody
could): four bounds up to the true one, 1 to 16 rounds.

Seed 20261124; trial k of a cell is fold_in(root, cell * 10^6 + k), cells counted over all laws.
Offsets of zero have no law: that row of the grid is run once.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import ELEVATIONS_MM, NOISES_MM, arguments, machine, results_folder, write_table
from jaxtyping import Array

from jaxcal import Protocol, calibrate_batch, reconstruction_precision, simulate
from jaxcal.io.atomic import atomic_path
from jaxcal.model.parameters import RIGID, Parameters
from jaxcal.model.priors import Bounded
from jaxcal.offsets import OFFSET_LAWS, OffsetLaw, nominal_bound
from jaxcal.solvers.alternating import alternate

SEED = 20261124
FACTORS = np.array([0.25, 0.5, 0.75, 1.0])
ROUNDS = np.array([1, 2, 4, 8, 16])
SUBSET = ((0.5, 6.0), (1.0, 0.5), (3.0, 2.0), (5.0, 0.5), (5.0, 6.0))
HEADER = [
    "elevation_distribution", "images", "elevation_mm", "noise_mm", "trials", "rp_conventional_mm",
    "rp_alternating_mm", "rp_auto_mm", "rp_auto_points_mm", "auto_over_conventional",
    "ci95_half", "auto_points_over_conventional", "auto_over_alternating", "auto_loses", "has_mean",
    "own_covariances", "not_converged", "rp_hindsight_mm", "hindsight_bound_mm",
    "hindsight_rounds", "hindsight_over_auto", "hindsight_over_auto_points",
]  # fmt: skip


@partial(jax.jit, static_argnums=(0, 1))
def draw(law: OffsetLaw, images: int, indices: Array, elevation: Array, noise: Array):
    """Experiments of one cell."""
    protocol = Protocol(images=images, elevation_distribution=law)
    protocol = replace(protocol, elevation_mm=elevation, noise_mm=noise)
    root = jax.random.key(SEED)
    return jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol))(indices)


@jax.jit
def precision(x: Array, experiments) -> Array:
    """Eq. 8 of every trial."""
    return jax.vmap(reconstruction_precision)(x, experiments.test_poses, experiments.test_points)


@jax.jit
def hindsight(x: Array, point: Array, problems, experiments, bounds: Array) -> Array:
    """RP of the alternation after each of ROUNDS, for every bound: (trials, bounds, rounds)."""

    def trial(arguments) -> Array:
        x, point, problem, test_poses, test_points = arguments
        start = Parameters.of(x[:3, :3], x[:3, 3], point)

        def one_bound(bound: Array) -> Array:
            def go_on(parameters: Parameters, rounds: Array):
                done = alternate(
                    parameters, Bounded(bound * problem.mask), problem, RIGID,
                    tolerance_rad=0.0, tolerance_mm=0.0, max_rounds=rounds,
                )  # fmt: skip
                matrix = done.parameters.matrix()
                return done.parameters, reconstruction_precision(matrix, test_poses, test_points)

            steps = jnp.asarray(np.diff(ROUNDS, prepend=0))
            return jax.lax.scan(go_on, start, steps)[1]

        return jax.vmap(one_bound)(bounds)

    batch = (x, point, problems, experiments.test_poses, experiments.test_points)
    return jax.lax.map(trial, batch, batch_size=50)


def run_cell(
    law: OffsetLaw, images: int, elevation: float, noise: float, indices: Array
) -> list[object]:
    """One row of the table."""
    experiments = draw(law, images, indices, elevation, noise)
    plain = jax.vmap(lambda experiment: experiment.problem())(experiments)
    weighted = replace(plain, covariance=experiments.covariance)
    results = {
        "conventional": calibrate_batch(plain, "conventional", chunk=50),
        "alternating": calibrate_batch(plain, "alternating", chunk=50),
        "auto": calibrate_batch(weighted, "joint", chunk=50),
        "auto_points": calibrate_batch(plain, "joint", chunk=50),
    }
    rp = {k: np.asarray(precision(r.image_to_probe, experiments)) for k, r in results.items()}
    mean = {name: float(values.mean()) for name, values in rp.items()}
    trials, flat = len(indices), mean["conventional"]
    exact = elevation == 0 and noise == 0
    half = 1.96 * (rp["auto"] - rp["conventional"]).std(ddof=1) / np.sqrt(trials) / flat
    law_found = results["auto"].offset_law
    assert law_found is not None
    row: list[object] = [
        law if elevation else "none", images, elevation, noise, trials, *mean.values(),
        np.nan if exact else mean["auto"] / flat, np.nan if exact else float(half),
        np.nan if exact else mean["auto_points"] / flat,
        np.nan if exact else mean["auto"] / mean["alternating"],
        float(np.mean(rp["auto"] > rp["conventional"])),
        float(np.mean(law_found.has_mean)), float(np.mean(law_found.own_covariances)),
        int(sum(np.sum(~np.asarray(r.converged)) for r in results.values())),
    ]  # fmt: skip
    if images != 50 or exact or not elevation:
        return [*row, *[np.nan] * 5]
    bounds = FACTORS * nominal_bound(law, elevation)
    begun = results["conventional"]
    found = hindsight(
        begun.image_to_probe, begun.point, plain, experiments, jnp.asarray(bounds)
    )  # fmt: skip
    table = np.asarray(found).mean(axis=0)
    at = np.unravel_index(np.argmin(table), table.shape)
    best = float(table[at])
    return [*row, best, float(bounds[at[0]]), int(ROUNDS[at[1]]),
            best / mean["auto"], best / mean["auto_points"]]  # fmt: skip


def main() -> None:
    quick = arguments(__doc__ or "").quick
    trials = 50 if quick else 200
    cells: list[tuple[OffsetLaw, int, float, float]] = []
    elevations = (1.0, 5.0) if quick else ELEVATIONS_MM
    noises = (0.5, 6.0) if quick else NOISES_MM
    for law, elevation, noise in itertools.product(OFFSET_LAWS, elevations, noises):
        if elevation or law == OFFSET_LAWS[0]:
            cells.append((law, 50, elevation, noise))
    for images, law in itertools.product((12,) if quick else (12, 20, 200), OFFSET_LAWS):
        subset = SUBSET[:2] if quick else SUBSET
        for elevation, noise in subset:
            cells.append((law, images, elevation, noise))
    folder, rows = results_folder(quick), []
    for cell, (law, images, elevation, noise) in enumerate(cells):
        row = run_cell(law, images, elevation, noise, cell * 1_000_000 + jnp.arange(trials))
        rows.append(row)
        shown = dict(zip(HEADER, row, strict=True))
        print(", ".join(
            f"{name} {shown[name]:.4g}" if isinstance(shown[name], float) else str(shown[name])
            for name in (*HEADER[:4], *HEADER[5:14], "not_converged", *HEADER[17:21])
        ), flush=True)  # fmt: skip
        write_table(folder / "auto_grid.csv", HEADER, rows)
    summary(rows)
    plot(folder / "auto_grid.png", rows)


def summary(rows: list[list[object]]) -> None:
    """The worst cells, and those where somebody else is better."""
    column = {name: np.array([row[k] for row in rows]) for k, name in enumerate(HEADER)}
    for images in sorted({int(str(row[1])) for row in rows}):
        chosen = column["images"] == images
        for name in ("auto_over_conventional", "auto_points_over_conventional",
                     "auto_over_alternating"):  # fmt: skip
            values = np.where(chosen, column[name], np.nan)
            worst = int(np.nanargmax(values))
            where = f"{rows[worst][0]}, {rows[worst][2]:g} mm, noise {rows[worst][3]:g} mm"
            above, of = int(np.sum(values > 1)), int(np.sum(np.isfinite(values)))
            print(f"n = {images}: {name} worst {values[worst]:.3f} ({where}); "
                  f"above 1 in {above} of {of} cells")  # fmt: skip
    wins = column["hindsight_over_auto"] < 1
    print(f"hindsight alternation below auto in {int(wins.sum())} of "
          f"{int(np.sum(np.isfinite(column['hindsight_over_auto'])))} cells:")  # fmt: skip
    for row in (rows[k] for k in np.flatnonzero(wins)):
        print(f"  {row[0]} {row[2]:g} mm, noise {row[3]:g} mm: {row[20]:.3f}")
    print(machine())


def plot(path: Path, rows: list[list[object]]) -> None:
    """Auto over conventional, a panel for each law at 50 images."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7.5), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    for panel, law in zip(panels, OFFSET_LAWS, strict=False):
        grid = np.full((len(ELEVATIONS_MM), len(NOISES_MM)), np.nan)
        for row in rows:
            if row[1] == 50 and row[0] in (law, "none"):
                at = ELEVATIONS_MM.index(float(str(row[2]))), NOISES_MM.index(float(str(row[3])))
                grid[at] = float(str(row[9]))
        panel.imshow(grid, cmap="RdBu_r", vmin=0, vmax=2, origin="lower")
        for i, j in np.argwhere(np.isfinite(grid)):
            panel.text(j, i, f"{grid[i, j]:.2f}", ha="center", va="center", fontsize="small")
        panel.set_xticks(range(len(NOISES_MM)), [f"{noise:g}" for noise in NOISES_MM])
        panel.set_yticks(range(len(ELEVATIONS_MM)), [f"{e:g}" for e in ELEVATIONS_MM])
        panel.set(xlabel="noise on each distance, SD (mm)", ylabel="size of the offsets (mm)",
                  title=law)  # fmt: skip
    panel = panels[-1]
    for images in sorted({int(str(row[1])) for row in rows}):
        values = [float(str(row[9])) for row in rows if row[1] == images]
        panel.plot(np.full(len(values), images), values, "_", markersize=12)
    panel.axhline(1, color="black", linewidth=0.8)
    panel.set(xscale="log", xlabel="images", ylabel="mean RP, auto over conventional",
              title="all cells", ylim=(0, 1.3))  # fmt: skip
    figure.suptitle("Mean RP of prior auto over conventional calibration")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120)


if __name__ == "__main__":
    main()
