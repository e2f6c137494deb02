"""Which poses: errors against the number of images for random, Sobol and planned poses.

A linear probe (L14-5) sees the target within 24 mm either way and 15 to 82 mm deep. Elevational
offsets follow one of five distributions of SD 1 mm, every element's distance errs by 0.5 mm (SD),
so lateral position and range by what Eq. 5 makes of it at that place. The probe tilts within a cone
of 40 degrees and turns by 90 (wide), or tilts and turns by 10 (narrow). Poses:

- random: drawn anew for each trial; Sobol: the first n of the sequence, with a seed for each trial;
- optimal: ``jaxcal.design.plan`` for the TRE, which takes the SDs for uncertain by a factor of 3;
- wrong SDs: the same, told an elevational SD three times too large (wrong+) or too small (wrong-);
- re-planned: 8 optimal poses, then what is best given the calibration so far, up to 12, 30 and 60
  (a plan for each of 192 trials).

Methods are prior ``auto`` (points without covariances) and conventional. TRE is the root mean
square over trials and over a grid of image points, RP (Eq. 8) the mean over trials on 50 noise-free
test images of random poses within the same limits. *predicted* is the root mean square of what each
calibration's own covariance predicts, *planned* what the plan promised before any image. Standard
errors are in the table.

Seed 20261129; 2,000 trials a cell (``--quick``: 24, of two distributions).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from common import (
    LAWS,
    arguments,
    batch_of,
    machine,
    plain_ticks,
    save_figure,
    show,
    write_table,
)
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import design
from jaxcal.design.candidates import sobol_poses
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261129
CONES = {"wide": (40.0, 90.0), "narrow": (10.0, 10.0)}
COUNTS = (8, 12, 30, 60)
MOST = max(COUNTS)
SD_MM, CHANNEL_MM = 1.0, 0.5
POOL = 4000
RATIO_ASKED = {"wide": 0.75, "narrow": 0.60}
TRIALS = 2000
ARMS = ("random", "sobol", "optimal", "wrong+", "wrong-", "replanned")

MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_rotvec([0.4, -0.8, 1.1]).as_matrix()
MOUNT[:3, 3] = [20.0, -35.0, 60.0]
TARGET = np.array([250.0, -120.0, 80.0])
HEADER = [
    "cone", "law", "method", "poses", "images", "trials", "tre_mm", "tre_error_mm", "rp_mm",
    "rp_error_mm", "predicted_tre_mm", "planned_tre_mm", "predicted_over_actual",
    "tre_over_random", "rp_over_random", "not_converged",
]  # fmt: skip


def model(elevational_mm: float = SD_MM) -> design.Model:
    noise = design.Noise.of_probe(jaxcal.LinearProbe(), CHANNEL_MM)
    coefficients = noise.coefficients.copy()
    coefficients[2] = [np.log(elevational_mm), 0.0, 0.0, 0.0]
    return design.Model(MOUNT, TARGET, replace(noise, coefficients=coefficients))


@cache
def pool(cone: str, elevational_mm: float = SD_MM) -> design.Candidates:
    tilt, turn = CONES[cone]
    bounds = design.Constraints(cone_deg=tilt, turn_deg=turn)
    return design.make_candidates(count=POOL, constraints=bounds, model=model(elevational_mm))


@cache
def planned(cone: str, count: int, elevational_mm: float = SD_MM) -> design.Plan:
    return design.plan(pool(cone, elevational_mm), count)


def offsets(law: str, rng: np.random.Generator, size: int) -> np.ndarray:
    """Elevational offsets of SD 1 mm (about their mean)."""
    match law:
        case "uniform":
            return rng.uniform(-1, 1, size) * np.sqrt(3)
        case "one-sided":
            return rng.uniform(0, 1, size) * np.sqrt(12)
        case "triangular":
            return rng.triangular(-1, 0, 1, size) * np.sqrt(6)
        case "heavy-tailed":
            return rng.standard_t(4, size) / np.sqrt(2)
    return rng.normal(size=size)


def taken(poses: np.ndarray, law: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Images at these poses: tracked poses and measured [lateral, range]."""
    true = model()
    place = true.targets(poses)
    offset = SD_MM * offsets(law, rng, len(poses))
    moved = poses.copy()
    # The probe is off along the elevational axis, so that the target is off the plane.
    moved[:, :3, 3] -= offset[:, None] * (poses[:, :3, :3] @ MOUNT[:3, 1])
    points = np.column_stack([place[:, 0], np.hypot(place[:, 2], offset)])
    points += rng.normal(size=points.shape) * true.noise.sigma(place)[:, :2]
    return moved, points


def solve(batch: jaxcal.Problem, method: str) -> jaxcal.Calibration:
    """Padded to whole chunks, so that every call runs the program compiled first."""
    if method == "auto":
        return jaxcal.calibrate_batch(batch, chunk=24)
    return jaxcal.calibrate_batch(batch, "conventional", chunk=24)


def pose_set(arm: str, cone: str, count: int, trial: int, rng: np.random.Generator) -> np.ndarray:
    candidates = pool(cone)
    match arm:
        case "random":
            return candidates.poses[rng.choice(POOL, count, replace=False)]
        case "sobol":
            return sobol_poses(count, candidates.model, candidates.constraints, trial)[0]
        case "wrong+":
            return planned(cone, count, 3 * SD_MM).poses
        case "wrong-":
            return planned(cone, count, SD_MM / 3).poses
    return planned(cone, count).poses


def replanned(cone: str, law: str, trials: int, rng: np.random.Generator) -> dict:
    """Images of every trial at 12, 30 and 60, planned on from the calibration before."""
    start = planned(cone, 8).poses
    images = [taken(start, law, rng) for _ in range(trials)]
    found = {}
    for count in COUNTS[1:]:
        batch = batch_of(images, MOST)
        results = solve(batch, "auto").numpy()
        for k, (poses, points) in enumerate(images):
            have = len(poses)
            all_poses, all_points = np.asarray(batch.poses[k]), np.asarray(batch.measurements[k])
            used = np.arange(MOST) < have
            one = jaxcal.Recording(jaxcal.make_images(all_poses, all_points, mask=used))
            result = results[k]
            bounds = pool(cone).constraints
            candidates = design.candidates_around(one, result, count=POOL, constraints=bounds)
            more = design.plan(candidates, count - have, "tre", result)
            # The planner's X is the estimate; the probe goes where it says.
            added = taken_at(more.poses, law, rng)
            images[k] = (np.concatenate([poses, added[0]]), np.concatenate([points, added[1]]))
        found[count] = list(images)
    return found


def taken_at(poses: np.ndarray, law: str, rng: np.random.Generator):
    """As :func:`taken`, for poses that are somewhat off the plane: placement mends it."""
    off = model().targets(poses)[:, 1]
    centred = poses.copy()
    centred[:, :3, 3] += off[:, None] * (poses[:, :3, :3] @ MOUNT[:3, 1])
    return taken(centred, law, rng)


def errors(found: np.ndarray, tests: np.ndarray, points: np.ndarray) -> tuple:
    """Mean squared TRE and RP of each trial's X."""
    apart = np.einsum("kij,pj->kpi", (found - MOUNT)[:, :3, :3], points)
    apart += (found - MOUNT)[:, None, :3, 3]
    places = model().targets(tests)
    cloud = np.einsum("kij,nj->kni", found[:, :3, :3], places) + found[:, None, :3, 3]
    cloud = np.einsum("nij,knj->kni", tests[:, :3, :3], cloud) + tests[:, :3, 3]
    return (apart**2).sum(-1).mean(1), np.sqrt(cloud.var(axis=1, ddof=1).sum(-1))


def simulated(trials: int, laws: tuple[str, ...], folder: Path) -> list[list[object]]:
    rows: list[list[object]] = []
    for cone in CONES:
        candidates = pool(cone)
        points = candidates.constraints.region.grid()
        tests = candidates.poses[np.random.default_rng(SEED).choice(POOL, 50, replace=False)]
        for law in laws:
            reference: dict[tuple[str, int], tuple[float, float]] = {}
            again = None
            for arm in ARMS:
                for count in COUNTS:
                    keys = [SEED, list(CONES).index(cone), LAWS.index(law), ARMS.index(arm), count]
                    rng = np.random.default_rng(keys)
                    if arm == "replanned":
                        if count == COUNTS[0]:
                            continue
                        again = again or replanned(cone, law, min(trials, 192), rng)
                        images = again[count]
                    else:
                        images = [
                            taken(pose_set(arm, cone, count, k, rng), law, rng)
                            for k in range(trials)
                        ]
                    batch = batch_of(images, MOST)
                    for method in ("auto", "conventional"):
                        if arm == "replanned" and method == "conventional":
                            continue
                        result = solve(batch, method)
                        squared, rp = errors(np.asarray(result.image_to_probe), tests, points)
                        told = np.asarray(jaxcal.predicted_tre(result, points[:, [0, 2]]))
                        told = float(np.sqrt(np.nanmean(told**2)))
                        tre, mean = float(np.sqrt(squared.mean())), float(rp.mean())
                        if arm == "random":
                            reference[method, count] = (tre, mean)
                        base = reference[method, count]
                        promise = float(planned(cone, count).tre_mm[-1]) if arm == "optimal" else ""
                        root = np.sqrt(len(squared))
                        rows.append([
                            cone, law, method, arm, count, len(squared), tre,
                            float(squared.std() / root / 2 / tre), mean, float(rp.std() / root),
                            told, promise, told / tre, tre / base[0], mean / base[1],
                            int((~np.asarray(result.converged)).sum()),
                        ])  # fmt: skip
                        show(rows[-1])
            write_table(folder / "pose_design.csv", HEADER, rows)
    return rows


def verdict(rows: list[list[object]]) -> list[str]:
    """What was asked for, and where it is not reached."""
    said = []
    shown = [dict(zip(HEADER, row, strict=True)) for row in rows]
    for cone, asked in RATIO_ASKED.items():
        for name in ("tre", "rp"):
            some = [
                float(row[f"{name}_over_random"]) for row in shown  # pyright: ignore[reportArgumentType]
                if (row["cone"], row["method"], row["poses"]) == (cone, "auto", "optimal")
                and row["images"] != 8
            ]  # fmt: skip
            said.append(
                f"{cone}: optimal over random {name.upper()} {min(some):.2f} to {max(some):.2f}, "
                f"mean {np.mean(some):.2f} (asked: at most {asked})"
            )
    for arm in ("random", "optimal"):
        some = [
            float(row["predicted_over_actual"]) for row in shown  # pyright: ignore[reportArgumentType]
            if (row["method"], row["poses"]) == ("auto", arm)
        ]  # fmt: skip
        said.append(f"predicted over actual TRE, auto, {arm} poses: {min(some):.2f} to "
                    f"{max(some):.2f}")  # fmt: skip
    return said


SHOWN = {
    "random": "random", "sobol": "Sobol", "optimal": "planned",
    "wrong+": "planned, elevational SD assumed 3 times too large",
    "wrong-": "planned, elevational SD assumed 3 times too small", "replanned": "re-planned",
}  # fmt: skip
"""Names of the arms in the figure."""


def plot(path: Path, rows: list[list[object]]) -> None:
    """TRE and RP against the number of images, mean over the distributions."""
    from matplotlib.figure import Figure

    shown = [dict(zip(HEADER, row, strict=True)) for row in rows]
    figure = Figure(figsize=(11, 8), layout="constrained")
    panels = figure.subplots(2, 2)
    for across, cone in enumerate(CONES):
        for down, name in enumerate(("tre_mm", "rp_mm")):
            panel = panels[down, across]
            for arm, colour in zip(ARMS, ("0.5", "tab:orange", "tab:blue", "tab:red", "tab:purple",
                                          "tab:green"), strict=True):  # fmt: skip
                for method, style in (("auto", "o-"), ("conventional", "s--")):
                    means = []
                    for count in COUNTS:
                        some = [
                            float(row[name]) for row in shown  # pyright: ignore[reportArgumentType]
                            if (row["cone"], row["method"], row["poses"], row["images"])
                            == (cone, method, arm, count)
                        ]  # fmt: skip
                        means.append(np.sqrt(np.mean(np.square(some))) if some else np.nan)
                    if np.isfinite(means).any() and not (method != "auto" and "wrong" in arm):
                        panel.loglog(COUNTS, means, style, color=colour, markersize=4,
                                     label=f"{SHOWN[arm]}, {method}")  # fmt: skip
            panel.set(title=f"{cone} cone", xlabel="images", ylabel=f"{name[:-3].upper()} (mm)")
            plain_ticks(panel.xaxis, COUNTS)
            plain_ticks(panel.yaxis, (0.1, 0.2, 0.5, 1, 2) if down == 0 else (0.1, 0.2, 0.5, 1))
            panel.grid(alpha=0.3, which="both")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3,
                  fontsize="small")  # fmt: skip
    save_figure(figure, path, dpi=130)


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    rows = simulated(24 if quick else TRIALS, LAWS[:2] if quick else LAWS, folder)
    print("\n".join(verdict(rows)))
    plot(folder / "pose_design.png", rows)
    print(machine())


if __name__ == "__main__":
    main()
