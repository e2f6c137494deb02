"""Which poses: errors against the number of images for random, Sobol and planned poses.

A linear probe (L14-5) sees the target within 24 mm either way and 15 to 82 mm deep. Elevational
offsets follow one of five laws of SD 1 mm, every element's distance errs by 0.5 mm (SD), so lateral
position and range by what Eq. 5 makes of it at that place. The probe tilts within a cone of 40
degrees and turns by 90 (wide), or tilts and turns by 10 (narrow). Poses:

- random: drawn anew for each trial; Sobol: the first n of the sequence, with a seed for each trial;
- optimal: ``jaxcal.design.plan`` for the TRE, which takes the SDs for uncertain by a factor of 3;
- wrong SDs: the same, told an elevational SD three times too large (wrong+) or too small (wrong-);
- re-planned: 8 optimal poses, then what is best given the calibration so far, up to 12, 30 and 60
  (a plan for each trial).

Methods are prior ``auto`` (points without covariances) and conventional. TRE is the root mean
square over trials and over a grid of image points, RP (Eq. 8) the mean over trials on 50 noise-free
test images of random poses within the same limits. *predicted* is the root mean square of what each
calibration's own covariance predicts, *planned* what the plan promised before any image. Standard
errors are in the table.

Part ``predicted``: actual TRE of ``auto`` at planned and random poses against two predictions made
before any image: that of simulated recordings under the law (``design.simulate_errors``) and that
of the plan, which knows the SDs only (the root mean square over the sets for random poses). 4,000
recordings each.

Part ``bench``: emulated benches without sockets, the target placed by amplitude scans: 36 planned
poses (the planner knows a drawing and guesses at the SDs) against 60 and 36 of the Sobol plan.

Part ``bound``: predicted TRE of 400 random sets, of the plan, and the bound that no set of the pool
goes below (``jaxcal.design.least_error``).

Part ``real``: of the 54 images of the real cross-wire recording (where it is at hand) 27 are chosen
by the criterion from their poses alone, as candidates of a plan; they predict the other 27. The
same for 200 random halves. Part ``figure``: what a lab needs, images against error.

Seed 20261129. Full: 2,000 trials a cell. ``--trials N`` for fewer (the committed table says how
many), ``--quick`` for 24 of two laws.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from common import machine, results_folder, write_table
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import design
from jaxcal.design.candidates import sobol_poses
from jaxcal.design.greedy import Rules
from jaxcal.design.predict import curve
from jaxcal.io.atomic import atomic_path
from jaxcal.io.text import read_crosswire
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261129
LAWS = ("uniform", "normal", "one-sided", "heavy-tailed", "triangular")
CONES = {"wide": (40.0, 90.0), "narrow": (10.0, 10.0)}
COUNTS = (8, 12, 30, 60)
MOST = max(COUNTS)
SD_MM, CHANNEL_MM = 1.0, 0.5
POOL = 4000
RATIO_ASKED = {"wide": 0.75, "narrow": 0.60}
SIMULATED = 4000
"""Recordings from which errors are predicted."""
PARTS = ("all", "simulated", "predicted", "bound", "bench", "real", "figure")
ARMS = ("random", "sobol", "optimal", "wrong+", "wrong-", "replanned")
DATA = Path(__file__).parents[2] / "shared" / "data" / "crosswire"

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


def problems(poses: list[np.ndarray], points: list[np.ndarray]) -> jaxcal.Problem:
    """A batch, padded to the largest number of images so that it is compiled once."""
    count = len(poses)
    all_poses = np.tile(np.eye(4), (count, MOST, 1, 1))
    all_points, mask = np.ones((count, MOST, 2)), np.zeros((count, MOST))
    for k, (some, where) in enumerate(zip(poses, points, strict=True)):
        all_poses[k, : len(some)], all_points[k, : len(some)] = some, where
        mask[k, : len(some)] = 1
    return jaxcal.Problem(
        poses=jnp.asarray(all_poses), measurements=jnp.asarray(all_points), mask=jnp.asarray(mask),
        spacing=jnp.ones((count, 2)), face_offset=jnp.zeros(count),
    )  # fmt: skip


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
        batch = problems(*map(list, zip(*images, strict=True)))
        results = solve(batch, "auto").numpy()
        for k, (poses, points) in enumerate(images):
            have = len(poses)
            all_poses, all_points = np.asarray(batch.poses[k]), np.asarray(batch.measurements[k])
            used = np.arange(MOST) < have
            one = jaxcal.Recording(jaxcal.make_images(all_poses, all_points, mask=used))
            result = results[k]
            bounds = pool(cone).constraints
            candidates = design.candidates_around(one, result, count=1500, constraints=bounds)
            rules = Rules()
            more = design.plan(candidates, count - have, "tre", result, polish=False, rules=rules)
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
                        again = again or replanned(cone, law, min(trials, 48), rng)
                        images = again[count]
                    else:
                        images = [
                            taken(pose_set(arm, cone, count, k, rng), law, rng)
                            for k in range(trials)
                        ]
                    batch = problems(*map(list, zip(*images, strict=True)))
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
                        print(*(f"{v:.3g}" if isinstance(v, float) else v for v in rows[-1]),
                              flush=True)  # fmt: skip
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


def crosswire(folder: Path, halves: int) -> list[list[object]]:
    """Chosen halves against random ones: RP on the images left out (joint, scales estimated)."""
    recording = read_crosswire(
        folder / "crossWirePhantomTransformations.txt", folder / "crossWirePhantom2DPoints.txt"
    )
    data = jaxcal.Problem.from_recording(recording)
    count = data.images
    whole = jaxcal.calibrate(data, prior="gaussian", estimate=("scale",))
    around = design.candidates_around(recording, whole, count=8)
    poses = recording.calibration.poses
    candidates = design.Candidates(poses, around.model, around.constraints)
    rules = Rules(space_filling=0.2, replicates=count)
    sets = {}
    for criterion in ("tre", "rp", "d"):
        chosen = design.plan(candidates, count // 2, criterion, polish=False, rules=rules).rows
        sets[criterion] = np.isin(np.arange(count), chosen)
    rng = np.random.default_rng(SEED)
    drawn = [np.isin(np.arange(count), rng.permutation(count)[: count // 2]) for _ in range(halves)]
    masks = np.array([*sets.values(), *drawn], float)
    batch = jaxcal.stack([replace(data, mask=jnp.asarray(mask)) for mask in masks])
    rows: list[list[object]] = []
    for method in ("joint", "conventional"):
        arguments: dict[str, Any] = {"prior": "gaussian"} if method == "joint" else {}
        result = jaxcal.calibrate_batch(batch, method, estimate=("scale",), **arguments)
        scored = []
        for k, mask in enumerate(masks):
            scale = np.asarray(result.scale_mm_per_px)[k]
            points = np.asarray(data.measurements) * scale
            left = mask == 0
            scored.append(float(jaxcal.reconstruction_precision(
                np.asarray(result.image_to_probe)[k], poses[left], points[left])))  # fmt: skip
        random = np.array(scored[len(sets) :])
        for k, name in enumerate(sets):
            rows.append([
                method, name, scored[k], float(np.median(random)),
                float(np.quantile(random, 0.05)), float(np.quantile(random, 0.95)),
                float((random < scored[k]).mean()), len(random),
            ])  # fmt: skip
            print(*(f"{v:.3g}" if isinstance(v, float) else v for v in rows[-1]), flush=True)
    return rows


def planning_curves(folder: Path) -> None:
    """Images against predicted TRE and RP: planned poses, and any (random) ones."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    rows: list[list[object]] = []
    for panel, cone in zip(figure.subplots(1, 2, sharey=True), CONES, strict=True):
        for elevational, colour in ((0.3, "tab:green"), (1.0, "tab:blue"), (3.0, "tab:red")):
            candidates = pool(cone, elevational)
            plan = design.plan(candidates, 100, polish=False)
            rng = np.random.default_rng(SEED)
            known = design.plan(candidates, 4, polish=False).known
            random = np.mean([
                curve(
                    candidates, known, candidates.poses[rng.choice(POOL, 100, replace=False)]
                )[0] ** 2 for _ in range(10)
            ], axis=0) ** 0.5  # fmt: skip
            panel.loglog(range(8, 101), plan.tre_mm[8:], color=colour,
                         label=f"planned, offsets {elevational:g} mm (SD)")  # fmt: skip
            panel.loglog(range(8, 101), random[8:], "--", color=colour, label="random")
            for count in (8, 12, 20, 30, 45, 60, 100):
                rows.append([cone, elevational, count, float(plan.tre_mm[count]),
                             float(plan.rp_mm[count]), float(random[count])])  # fmt: skip
        tilt, turn = CONES[cone]
        panel.set(xlabel="images", title=f"tilts to {tilt:g}, turns to {turn:g} degrees")
        panel.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel("predicted TRE over the image (mm)")
    figure.axes[0].legend(fontsize="x-small", ncols=2)
    with atomic_path(folder / "pose_design_planning.png") as temporary:
        figure.savefig(temporary, dpi=130)
    write_table(folder / "pose_design_planning.csv", ["cone", "offset_sd_mm", "images",
                "planned_tre_mm", "planned_rp_mm", "random_tre_mm"], rows)  # fmt: skip


def plot(path: Path, rows: list[list[object]]) -> None:
    """TRE and RP against the number of images, mean over the laws."""
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
                                     label=f"{arm}, {method}")  # fmt: skip
            panel.set(title=f"{cone} cone", xlabel="images", ylabel=name.replace("_", " ("))
            panel.set_ylabel(f"{name[:-3].upper()} (mm)")
            panel.set_xticks(COUNTS, [str(count) for count in COUNTS])
            panel.grid(alpha=0.3, which="both")
    panels[0, 0].legend(fontsize="x-small")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=130)


def benches(count: int) -> list[list[object]]:
    """Emulated benches without sockets: 36 poses of a plan against 60 of the Sobol plan."""
    from hw.bench.stage import WorldStage
    from hw.bench.world import make_world
    from hw.midplane.amplitude_scan import amplitude_scan
    from hw.midplane.search import PlacementError
    from hw.pool import BENCH_RULES, BENCH_SDS_MM
    from hw.poses import Extent, constraints_of, plan_poses

    # All benches share one drawing, and so one plan.
    scene, extent = make_world(0).scene, Extent()
    drawn = design.Model(scene.image_to_probe, scene.point_mm, design.Noise.constant(BENCH_SDS_MM))
    bounds = constraints_of(scene, extent)
    candidates = design.make_candidates(count=2000, constraints=bounds, model=drawn)
    chosen = design.plan(candidates, 36, rules=BENCH_RULES).poses
    arms = {
        "sobol 60": lambda seed: plan_poses(60, scene, extent, seed).poses,
        "sobol 36": lambda seed: plan_poses(36, scene, extent, seed).poses,
        "optimal 36": lambda seed: chosen,
    }
    points = bounds.region.grid()
    rows: list[list[object]] = []
    for name, poses_of in arms.items():
        built, truths = [], []
        for seed in range(count):
            world = make_world(seed)
            rng = np.random.default_rng([seed, list(arms).index(name)])
            kept, times = [], []
            for pose in poses_of(seed):
                stage = WorldStage(world, pose, rng, position_sd_mm=0.1)
                try:
                    amplitude_scan(stage)
                except PlacementError:
                    continue
                kept.append(stage.reported_pose)
                times.append(stage.times_of_flight(9))
            mask = np.arange(MOST) < len(kept)
            kept += [kept[0]] * (MOST - len(kept))
            times += [times[0]] * (MOST - len(times))
            images = jaxcal.make_images(
                np.array(kept), np.array(times), "time_of_flight", mask=mask
            )
            one = jaxcal.Problem.from_recording(jaxcal.Recording(images, probe=world.probe))
            # On a linear probe the points with their covariances say all that the times do.
            built.append(replace(one, channels=None))
            truths.append(world)
        found = np.asarray(jaxcal.calibrate_batch(jaxcal.stack(built)).image_to_probe)
        squared, rp = [], []
        for x, world in zip(found, truths, strict=True):
            off = x - world.image_to_probe
            squared.append(((points @ off[:3, :3].T + off[:3, 3]) ** 2).sum(1).mean())
            rp.append(float(jaxcal.reconstruction_precision(x, *world.test_set())))
        tre, root = np.sqrt(squared), np.sqrt(count)
        rows.append([name, count, float(tre.mean()), float(tre.std() / root), float(np.mean(rp)),
                     float(np.std(rp) / root)])  # fmt: skip
        print(*(f"{v:.3g}" if isinstance(v, float) else v for v in rows[-1]), flush=True)
    return rows


def predictions(trials: int, folder: Path) -> None:
    """Actual TRE against what is predicted before any image; draws of its own."""
    header = ["cone", "law", "poses", "images", "trials", "tre_mm", "tre_error_mm",
              "simulated_tre_mm", "simulated_tre_error_mm", "simulated_over_actual",
              "planned_tre_mm", "planned_over_actual"]  # fmt: skip
    rows: list[list[object]] = []
    for cone, count, arm in itertools.product(CONES, COUNTS, ("random", "optimal")):
        candidates = pool(cone)
        points = candidates.constraints.region.grid()
        tests = candidates.poses[:2]
        known = design.plan(candidates, 4, polish=False).known
        rng = np.random.default_rng([SEED, list(CONES).index(cone), count, ARMS.index(arm), 7])
        if arm == "optimal":
            foreseen = planned(cone, count).poses
            told = float(planned(cone, count).tre_mm[-1])
        else:
            foreseen = np.stack([pose_set(arm, cone, count, 0, rng) for _ in range(SIMULATED)])
            each = [curve(candidates, known, poses)[0][-1] ** 2 for poses in foreseen[:400]]
            told = float(np.sqrt(np.mean(each)))
        for law in LAWS:
            images = [taken(pose_set(arm, cone, count, k, rng), law, rng) for k in range(trials)]
            found = solve(problems(*map(list, zip(*images, strict=True))), "auto")
            squared, _ = errors(np.asarray(found.image_to_probe), tests, points)
            tre = float(np.sqrt(squared.mean()))
            simulation = design.simulate_errors(
                foreseen, law, candidates, trials=SIMULATED, seed=count
            )
            rows.append([
                cone, law, arm, count, trials, tre,
                float(squared.std() / np.sqrt(trials) / 2 / tre), simulation.tre_mm,
                simulation.tre_error_mm, simulation.tre_mm / tre, told, told / tre,
            ])  # fmt: skip
            print(*(f"{v:.3g}" if isinstance(v, float) else v for v in rows[-1]), flush=True)
    write_table(folder / "pose_design_predicted.csv", header, rows)
    for name, column in (("simulated", 9), ("planned", 11)):
        ratios = np.array([row[column] for row in rows], float)
        within = int(np.sum(np.abs(ratios - 1) <= 0.1))
        print(f"{name} over actual: {ratios.min():.2f} to {ratios.max():.2f}, "
              f"within 10 % in {within} of {len(rows)} cells")  # fmt: skip


def bounds() -> list[list[object]]:
    """Predicted TRE of random and planned poses, and what no set of the pool goes below."""
    rows: list[list[object]] = []
    for cone in CONES:
        candidates = pool(cone)
        known = design.plan(candidates, 4, polish=False).known
        for count in COUNTS:
            rng = np.random.default_rng([SEED, count])
            random = np.sqrt(np.mean([
                curve(candidates, known, candidates.poses[rng.choice(POOL, count, replace=False)])[
                    0
                ][-1] ** 2 for _ in range(400)
            ]))  # fmt: skip
            least = design.least_error(candidates, count)
            mine = float(planned(cone, count).tre_mm[-1])
            rows.append([cone, count, random, mine, least, mine / random, least / random])
            print(*(f"{v:.3g}" if isinstance(v, float) else v for v in rows[-1]), flush=True)
    return rows


def timings() -> list[str]:
    """A plan of 60 from 5,000, the next pose, warm."""
    candidates = design.make_candidates(jaxcal.LinearProbe(), count=5000)
    plan = design.plan(candidates, 60)
    told = []
    for name, call in (("plan of 60 from 5,000", lambda: design.plan(candidates, 60)),
                       ("next pose", lambda: design.next_poses(plan, candidates, 1))):  # fmt: skip
        seconds, work = [], []
        for _ in range(5):
            began, before = time.perf_counter(), time.process_time()
            call()
            seconds.append(time.perf_counter() - began)
            work.append(time.process_time() - before)
        told.append(
            f"{name}: {1e3 * min(seconds):.0f} ms, {1e3 * min(work):.0f} ms of CPU (best of 5)"
        )
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few trials of two laws")
    parser.add_argument("--trials", type=int, default=2000, help="of each cell")
    parser.add_argument("--benches", type=int, default=64, help="emulated benches")
    parser.add_argument("--part", choices=PARTS, default="all")
    given = parser.parse_args()
    enable_compilation_cache()
    folder = results_folder(given.quick)
    if given.part in ("all", "figure"):
        print("\n".join(timings()))
        planning_curves(folder)
    if given.part in ("all", "bound"):
        header = ["cone", "images", "random_tre_mm", "planned_tre_mm", "least_tre_mm",
                  "planned_over_random", "least_over_random"]  # fmt: skip
        write_table(folder / "pose_design_bound.csv", header, bounds())
    if given.part in ("all", "predicted"):
        predictions(24 if given.quick else SIMULATED, folder)
    if given.part in ("all", "real"):
        if DATA.is_dir():
            rows = crosswire(DATA, 40 if given.quick else 200)
            header = ["method", "criterion", "chosen_rp_mm", "random_median_mm", "random_5_mm",
                      "random_95_mm", "share_better", "random_halves"]  # fmt: skip
            write_table(folder / "pose_design_crosswire.csv", header, rows)
        else:
            print(f"{DATA}: the recording is not here")
    if given.part in ("all", "bench"):
        rows = benches(4 if given.quick else given.benches)
        header = ["poses", "benches", "tre_mm", "tre_error_mm", "rp_mm", "rp_error_mm"]
        write_table(folder / "pose_design_benches.csv", header, rows)
    if given.part in ("all", "simulated"):
        trials = 24 if given.quick else given.trials
        rows = simulated(trials, LAWS[:2] if given.quick else LAWS, folder)
        print("\n".join(verdict(rows)))
        plot(folder / "pose_design.png", rows)
    print(machine())


if __name__ == "__main__":
    main()
