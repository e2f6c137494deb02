"""Prior ``auto`` on the paper's 7 x 7 grid: five distributions of the offsets, 12 to 200 images.

On the same draws: conventional calibration, the paper's alternation (1 mm, jaxcal's default
stopping rule, since the paper states none), and the joint method with prior ``auto``, from points
with the covariances that the times of flight give (``auto``) and from points alone
(``auto_points``), and with prior ``gaussian`` and estimated SDs, from the same two (``gaussian``,
``gaussian_points``). Beside them the alternation with its best bound *and* its best stop, chosen in
hindsight for each cell by the true error (nobody could): ten bounds from an eighth of the true one
to four times it, and for each 1 to 256 rounds and the default stopping rule. Its choice is made on
the trials it is then judged by, which flatters it a little.

A cell in which a ratio that should be at most 1 is not is run again on twenty times as many fresh
draws (``auto_grid_again.csv``): a cell picked for being the worst of hundreds says little alone.

Seed 20261124; trial k of a cell is fold_in(root, cell * 10^6 + k), cells counted over all
distributions; the repetitions begin at k = 500,000. Offsets of zero have no distribution: that row
of the grid is run once.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import (
    ELEVATIONS_MM,
    LAWS,
    NOISES_MM,
    arguments,
    experiments,
    grid_panel,
    machine,
    paired_ratio,
    precision,
    problems_of,
    save_figure,
    write_rows,
)
from jaxtyping import Array

from jaxcal import Problem, Protocol, calibrate_batch, reconstruction_precision
from jaxcal.backend import RIGID, BoundedOffsets, ImagePlanes, Iterate, Parameters
from jaxcal.runtime.compiler import fast_to_run
from jaxcal.runtime.jax_cache import enable_compilation_cache
from jaxcal.solvers.alternating import alternate
from jaxcal.solvers.plan import Options
from jaxcal.study.offsets import LawName, nominal_bound
from jaxcal.study.simulation import Experiment

SEED = 20261124
TRIALS, AGAIN = 200, 4000
FACTORS = np.array([0.125, 0.25, 0.375, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0])
"""Bounds of the hindsight alternation over the true one."""
ROUNDS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 256])
RULE = 0
"""In the table's column of rounds: jaxcal's default stopping rule."""
SIDE_BY_SIDE = 10
"""Trials whose bounds are alternated together: 100 problems of one batch."""
SUBSET = ((0.5, 6.0), (1.0, 0.5), (3.0, 2.0), (5.0, 0.5), (5.0, 6.0))
SIZES = (12, 20, 200)
COMPARED = (
    "auto_over_conventional", "auto_points_over_conventional", "auto_over_alternating",
    "auto_points_over_alternating",
)  # fmt: skip
BY_GAUSSIAN = ("auto_over_gaussian", "auto_points_over_gaussian_points")
"""Ratios that may well be above 1: such cells are not run again."""


@dataclass(frozen=True)
class Cell:
    """One condition."""

    law: LawName
    images: int
    elevation_mm: float
    noise_mm: float

    def __str__(self) -> str:
        law = self.law if self.elevation_mm else "none"
        return f"{law} {self.elevation_mm:g} mm, noise {self.noise_mm:g} mm, n = {self.images}"


def cells(quick: bool) -> list[Cell]:
    """The grid at 50 images for every distribution, then a part of it at other numbers."""
    elevations = (1.0, 5.0) if quick else ELEVATIONS_MM
    noises = (0.5, 6.0) if quick else NOISES_MM
    grid = [
        Cell(law, 50, elevation, noise)
        for law, elevation, noise in itertools.product(LAWS, elevations, noises)
        if elevation or law == LAWS[0]
    ]
    sizes = [
        Cell(law, images, *size)
        for images, law in itertools.product(SIZES[:1] if quick else SIZES, LAWS)
        for size in (SUBSET[:2] if quick else SUBSET)
    ]
    return grid + sizes


def hindsight(begun, problems: Problem, drawn: Experiment, bounds: Array) -> Array:
    """RP of the alternation at each of ROUNDS and by its rule: (trials, bounds, rounds + 1)."""
    rule = Options()

    def some(batch: tuple) -> Array:
        x, point, problems, test_poses, test_points = batch
        count = bounds.shape[0]

        def each(tree: Any) -> Any:
            return jax.tree.map(lambda leaf: jnp.repeat(leaf, count, axis=0), tree)

        wide, x, point = each(problems), each(x), each(point)
        images = ImagePlanes.of(wide)
        limit = jnp.tile(bounds, len(test_poses))[:, None] * wide.mask
        bounded = BoundedOffsets.of(limit, images)
        start = Iterate.of(jax.vmap(Parameters.of)(x[:, :3, :3], x[:, :3, 3], point), RIGID)
        test_poses, test_points = each(test_poses), each(test_points)

        def judged(place: Iterate) -> Array:
            matrix = jax.vmap(Parameters.matrix)(place.parameters())
            return jnp.asarray(jax.vmap(reconstruction_precision)(matrix, test_poses, test_points))

        def go_on(place: Iterate, rounds: Array) -> tuple[Iterate, Array]:
            done = alternate(
                place,
                bounded,
                images,
                tolerance_rad=0.0,
                tolerance_mm=0.0,
                max_rounds=rounds,
                inner_steps=rule.inner_steps,
            )
            return done.iterate, judged(done.iterate)

        steps = jnp.asarray(np.diff(ROUNDS, prepend=0))
        by_rounds = jax.lax.scan(go_on, start, steps)[1]
        by_rule = alternate(
            start,
            bounded,
            images,
            tolerance_rad=rule.tolerance_rad,
            tolerance_mm=rule.tolerance_mm,
            max_rounds=rule.max_rounds,
            inner_steps=rule.inner_steps,
        )
        found = jnp.concatenate([by_rounds, judged(by_rule.iterate)[None]])
        return found.T.reshape(-1, count, len(ROUNDS) + 1)

    batch = (begun.image_to_probe, begun.point, problems, drawn.test_poses, drawn.test_points)
    parts = jax.tree.map(lambda leaf: leaf.reshape(-1, SIDE_BY_SIDE, *leaf.shape[1:]), batch)
    return jax.lax.map(some, parts).reshape(-1, bounds.shape[0], len(ROUNDS) + 1)


_hindsight = jax.jit(hindsight, compiler_options=fast_to_run(jax.default_backend()))


def run_cell(cell: Cell, indices: Array, *, with_hindsight: bool = True) -> dict[str, object]:
    """One row of the table."""
    size, noise = cell.elevation_mm, cell.noise_mm
    protocol = Protocol(
        images=cell.images, elevation_distribution=cell.law, elevation_mm=size, noise_mm=noise
    )
    drawn = experiments(SEED, indices, protocol)
    plain = problems_of(drawn, covariances=False)
    weighted = problems_of(drawn, covariances=True)
    results = {
        "conventional": calibrate_batch(plain, "conventional"),
        "alternating": calibrate_batch(plain, "alternating"),
        "auto": calibrate_batch(weighted, "joint"),
        "auto_points": calibrate_batch(plain, "joint"),
        "gaussian": calibrate_batch(weighted, "joint", "gaussian"),
        "gaussian_points": calibrate_batch(plain, "joint", "gaussian"),
    }
    tests = drawn.test_poses, drawn.test_points
    rp = {name: precision(found.image_to_probe, *tests) for name, found in results.items()}
    law = results["auto"].offset_law
    assert law is not None
    row: dict[str, object] = {
        "elevation_distribution": cell.law if size else "none", "images": cell.images,
        "elevation_mm": size, "noise_mm": noise, "trials": len(indices),
    }  # fmt: skip
    row |= {f"rp_{name}_mm": float(values.mean()) for name, values in rp.items()}
    exact = not size and not noise
    for name in (*COMPARED, *BY_GAUSSIAN):
        one, other = name.split("_over_")
        row[name], row[f"{name}_ci95_half"] = (
            (np.nan, np.nan) if exact else paired_ratio(rp[one], rp[other])
        )
    row |= {
        "auto_loses": float(np.mean(rp["auto"] > rp["conventional"])),
        "auto_points_loses_to_gaussian": float(np.mean(rp["auto_points"] > rp["gaussian_points"])),
        "mean_probability": float(np.mean(np.asarray(law.mean_probability))),
        "own_probability": float(np.mean(np.asarray(law.own_probability))),
        "not_converged": int(sum(np.sum(~np.asarray(r.converged)) for r in results.values())),
    }
    if not with_hindsight:
        return row
    row |= {f"hindsight_{name}": np.nan for name in ("bound_over_true", "bound_mm", "rounds")}
    row |= {f"hindsight_over_{one}{half}": np.nan
            for one in ("auto", "auto_points") for half in ("", "_ci95_half")}  # fmt: skip
    row |= {"rp_hindsight_mm": np.nan, "rp_hindsight_rule_mm": np.nan}
    if not size:
        return row
    bounds = FACTORS * nominal_bound(cell.law, size)
    found = np.asarray(_hindsight(results["conventional"], plain, drawn, jnp.asarray(bounds)))
    table = found.mean(axis=0)
    bound, stop = np.unravel_index(np.argmin(table), table.shape)
    best = found[:, bound, stop]
    rounds = RULE if stop == len(ROUNDS) else int(ROUNDS[stop])
    row |= {"hindsight_bound_over_true": float(FACTORS[bound]),
            "hindsight_bound_mm": float(bounds[bound]), "hindsight_rounds": rounds,
            "rp_hindsight_mm": float(best.mean()),
            "rp_hindsight_rule_mm": float(table[:, -1].min())}  # fmt: skip
    for one in ("auto", "auto_points"):
        name = f"hindsight_over_{one}"
        row[name], row[f"{name}_ci95_half"] = paired_ratio(best, rp[one])
    return row


def main() -> None:
    quick, folder = arguments(__doc__)
    trials, again = (50, 200) if quick else (TRIALS, AGAIN)
    enable_compilation_cache()
    todo = cells(quick)
    rows: list[dict[str, Any]] = []
    for index, cell in enumerate(todo):
        if index and cell.images != todo[index - 1].images:
            jax.clear_caches()  # a process may map only so many compiled programs
        rows.append(run_cell(cell, index * 1_000_000 + jnp.arange(trials)))
        told = (*COMPARED[:3], *BY_GAUSSIAN, "not_converged", "hindsight_over_auto",
                "hindsight_bound_over_true", "hindsight_rounds")  # fmt: skip
        print(f"{cell}: " + ", ".join(f"{name} {rows[-1][name]:.4g}" for name in told), flush=True)
        write_rows(folder / "auto_grid.csv", rows)
    jax.clear_caches()
    repeated = []
    for index, (cell, row) in enumerate(zip(todo, rows, strict=True)):
        if any(row[name] > 1 for name in COMPARED):
            first = index * 1_000_000 + 500_000
            repeated.append(run_cell(cell, first + jnp.arange(again), with_hindsight=False))
            print(f"again, {cell}: " + ", ".join(
                f"{name} {row[name]:.4f}, now {repeated[-1][name]:.4f} +- "
                f"{repeated[-1][f'{name}_ci95_half']:.4f}" for name in COMPARED
            ), flush=True)  # fmt: skip
    if repeated:
        write_rows(folder / "auto_grid_again.csv", repeated)
    else:
        (folder / "auto_grid_again.csv").unlink(missing_ok=True)
    summary(todo, rows)
    plot(folder / "auto_grid.png", rows)


def summary(todo: list[Cell], rows: list[dict[str, Any]]) -> None:
    """The worst cells, and those where somebody else is better."""
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    for images in sorted(set(column["images"])):
        chosen = column["images"] == images
        for name in (*COMPARED, *BY_GAUSSIAN):
            values = np.where(chosen, column[name], np.nan)
            worst = int(np.nanargmax(values))
            above, of = int(np.sum(values > 1)), int(np.sum(np.isfinite(values)))
            print(f"n = {images}: {name} worst {values[worst]:.3f} +- "
                  f"{rows[worst][name + '_ci95_half']:.3f} ({todo[worst]}); above 1 in {above} of "
                  f"{of} cells")  # fmt: skip
    for one in ("auto", "auto_points"):
        values = column[f"hindsight_over_{one}"]
        wins = np.flatnonzero(values < 1)
        print(f"hindsight alternation below {one} in {len(wins)} of {np.isfinite(values).sum()}:")
        for at in wins:
            row = rows[at]
            print(f"  {todo[at]}: {values[at]:.3f} +- {row[f'hindsight_over_{one}_ci95_half']:.3f},"
                  f" bound {row['hindsight_bound_over_true']:g} of the true one, rounds "
                  f"{row['hindsight_rounds'] or 'by the rule'}")  # fmt: skip
    for name, values in (("bound_over_true", FACTORS), ("rounds", [RULE, *ROUNDS])):
        found = column[f"hindsight_{name}"]
        print(f"hindsight's best {name}: " + ", ".join(
            f"{value:g} in {int(np.sum(found == value))}" for value in values
        ))  # fmt: skip
    print(machine())


def plot(path: Path, rows: list[dict[str, Any]]) -> None:
    """Auto over conventional with 50 images, by distribution, and all cells against the others."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7.5), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    for panel, law in zip(panels, LAWS, strict=False):
        grid = np.full((len(ELEVATIONS_MM), len(NOISES_MM)), np.nan)
        for row in rows:
            if row["images"] == 50 and row["elevation_distribution"] in (law, "none"):
                at = ELEVATIONS_MM.index(row["elevation_mm"]), NOISES_MM.index(row["noise_mm"])
                grid[at] = row["auto_over_conventional"]
        grid_panel(panel, grid, half=1.0)
        panel.set(title=f"{law}: over conventional, n = 50")
    panel = panels[-1]
    others = (
        ("over conventional", lambda row: row["auto_over_conventional"], -0.18, "C0"),
        ("over the paper's alternation", lambda row: row["auto_over_alternating"], -0.06, "C1"),
        ("over the alternation's best", lambda row: 1 / row["hindsight_over_auto"], 0.06, "C2"),
        ("over prior gaussian, both from points alone",
         lambda row: row["auto_points_over_gaussian_points"], 0.18, "C3"),
    )  # fmt: skip
    sizes = sorted({row["images"] for row in rows})
    for label, value, shift, colour in others:
        at = [sizes.index(row["images"]) + shift for row in rows]
        panel.plot(at, [value(row) for row in rows], "_", color=colour, label=label)
    panel.axhline(1, color="black", linewidth=0.8)
    panel.set_xticks(range(len(sizes)), [str(size) for size in sizes])
    panel.set(xlabel="images", ylabel="mean RP of auto over another's", title="all cells",
              ylim=(0, None))  # fmt: skip
    # Below the data: at 12 and at 200 images there are marks up to the top.
    panel.legend(fontsize="x-small", loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    figure.suptitle("Mean RP of prior auto")
    save_figure(figure, path, dpi=120)


if __name__ == "__main__":
    main()
