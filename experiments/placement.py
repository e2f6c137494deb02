"""Robotic placement in the mid-plane against a free hand and against none.

The same simulated benches (a true X, a target, a beam and a response shift each) are calibrated
from 60 images of every kind; a placement that gives up is an image less.

- none, by hand: the probe is held anywhere where the element is plainly seen, which is what
  conventional practice does with a cross-wire: uniform over the stretch where the response is at
  least 0.3 of its maximum;
- none, by robot: the arm stops where a coarse raster hears the element first, always from the same
  side of the beam;
- free hand: a sweep of about 4 mm/s through the plane with tremor, the loudest frame is taken;
- amplitude scan, pattern injection (an operator who follows the bar by rule) and threshold climb
  with the robot.

Hidden errors are the bench's defaults: response shift 0.3 mm SD (fixed for a pose), 0.1 mm SD of
every stop, 100 MHz clock, 20 ns of timing noise, 1 % of the lines reflections. The tracked pose of
a hand-held probe has the same 0.1 mm, so that only placement differs. Time is bench time at the
pace of :class:`hw.bench.stage.Pace`; a person is taken to need 6 s to bring the probe to the next
pose, and 2 s to look and to decide (assumed, not measured). RP is Eq. 8 on each bench's noise-free
in-plane test set. ``joint`` is the joint method with prior ``auto``; the priors ``gaussian`` and
``bounded`` and the conventional method calibrate the same images. Ratios have half their 95 %
interval, of the paired benches. Seeds 0 to N - 1 for the benches; N = 64 (full) or 4 (quick).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, machine, paired_ratio, plain_ticks, save_figure, show, write_rows

from hw.bench.stage import Pace, WorldStage
from hw.bench.world import World, make_world
from hw.midplane.amplitude_scan import amplitude_scan, fit_peak
from hw.midplane.bracket import Bracket
from hw.midplane.pattern_injection import SteadyOperator, pattern_injection
from hw.midplane.search import PlacementError, Settings, first_seen
from hw.midplane.threshold_climb import threshold_climb
from hw.planning.poses import plan_poses
from hw.runtime.rigid import rigid
from jaxcal import Problem, Recording, calibrate_batch, make_images, reconstruction_precision, stack
from jaxcal.data.poses import rotation_angle

IMAGES = 60
TRACKER_SD_MM = 0.1
FRAMES = 9
"""Active-echo frames that a standing probe's times of flight are the median of."""
NEXT_POSE_S, DECIDE_S = 6.0, 2.0
"""What a person needs, s (assumed)."""
SEEN_FRACTION = 0.3
SWEEP_MM_S, TREMOR_MM, TREMOR_DEG, TIMING_S = 4.0, 0.15, 0.2, 0.005


@dataclass(frozen=True)
class Image:
    """One placed image: what was recorded, and what is true."""

    pose: np.ndarray
    times: np.ndarray
    bracket: Bracket
    elevation_mm: float
    seconds: float


Place = Callable[[World, np.ndarray, np.random.Generator], Image]


def standing(stage: WorldStage, bracket: Bracket, seconds: float = 0.0) -> Image:
    """Record where the probe stands."""
    times = stage.times_of_flight(FRAMES)
    return Image(stage.reported_pose, times, bracket, stage.elevation_mm, stage.seconds + seconds)


def by_robot(procedure: Callable[[WorldStage], Bracket]) -> Place:
    def place(world: World, pose: np.ndarray, rng: np.random.Generator) -> Image:
        stage = WorldStage(world, pose, rng, position_sd_mm=TRACKER_SD_MM)
        return standing(stage, procedure(stage))

    return place


def by_hand_unplaced(world: World, pose: np.ndarray, rng: np.random.Generator) -> Image:
    """Anywhere where the element is plainly seen."""
    offsets = np.arange(-12.0, 12.0, 0.1)
    axis = pose[:3, :3] @ world.scene.elevational
    loud = []
    for offset in offsets:
        there = pose.copy()
        there[:3, 3] += offset * axis
        loud.append(world.loudness(there).max())
    seen = offsets[np.array(loud) >= SEEN_FRACTION * max(loud)]
    stage = WorldStage(world, pose, rng, position_sd_mm=TRACKER_SD_MM)
    stage.set_threshold(Settings().low_threshold)
    stage.move(float(rng.choice(seen)))
    stage.seconds = 0.0
    half = Settings().beam_half_mm
    return standing(stage, Bracket(0.0, -half, half, half / np.sqrt(3.0)), NEXT_POSE_S + DECIDE_S)


def by_hand_swept(world: World, pose: np.ndarray, rng: np.random.Generator) -> Image:
    """One sweep through the plane, again if it missed; the loudest frame."""
    settings = Settings(position_sd_mm=TRACKER_SD_MM)
    seconds = NEXT_POSE_S
    pace = Pace()
    axis = pose[:3, :3] @ world.scene.elevational
    for _ in range(5):
        reach = rng.uniform(7.0, 10.0)
        frames = int(2 * reach / SWEEP_MM_S / pace.frame_s)
        seconds += frames * pace.frame_s + DECIDE_S
        # Tremor as a first-order process of about 2 Hz.
        keep = np.exp(-2 * np.pi * 2.0 * pace.frame_s)
        shake = np.zeros((frames, 6))
        for k in range(1, frames):
            shake[k] = keep * shake[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=6)
        shake *= np.repeat([TREMOR_MM, np.radians(TREMOR_DEG)], 3)
        error = TRACKER_SD_MM * rng.normal(size=3)
        poses, places, echoes = [], [], []
        for k in range(frames):
            true = pose @ rigid(shake[k, 3:], np.zeros(3))
            true[:3, 3] += shake[k, :3] + (-reach + k * pace.frame_s * SWEEP_MM_S) * axis
            late = SWEEP_MM_S * TIMING_S * rng.normal() * axis
            tracked = true.copy()
            tracked[:3, 3] += error + late
            poses.append((true, tracked))
            places.append(-float(world.scene.expected(tracked)[1]))
            echoes.append(world.echo(true, settings.low_threshold, rng))
        top = [float(np.sort(amplitude)[-8:].mean()) for _, amplitude in echoes]
        try:
            peak = fit_peak(np.array(places), np.array(top), settings.full_scale)
        except PlacementError:
            continue
        # The loudest frame, as in the paper; if that is saturated, the one nearest to the maximum.
        best = int(np.argmax(top))
        if top[best] >= 0.98 * settings.full_scale:
            best = int(np.argmin(np.abs(np.array(places) - peak.place_mm)))
        bracket = peak.bracket(places[best], settings)
        true, tracked = poses[best]
        offset = world.truth(true).elevation_mm
        return Image(tracked, echoes[best][0], bracket, offset, seconds)
    raise PlacementError("five sweeps missed the plane")


ARMS: dict[str, Place] = {
    "none, by hand": by_hand_unplaced,
    "none, by robot": by_robot(lambda stage: first_seen(stage).bracket),
    "free hand": by_hand_swept,
    "amplitude scan": by_robot(lambda stage: amplitude_scan(stage).bracket),
    "pattern injection": by_robot(
        lambda stage: pattern_injection(stage, stage, SteadyOperator()).bracket
    ),
    "threshold climb": by_robot(lambda stage: threshold_climb(stage).bracket),
}


def travel_seconds(poses: np.ndarray, tips: np.ndarray, pace: Pace) -> float:
    """Bench time of a robot's moves between the poses of a plan."""
    way = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    turns = [rotation_angle(a, b) for a, b in itertools.pairwise(poses)]
    turning = np.degrees(turns) / pace.turn_deg_s
    return float(np.maximum(way / pace.travel_mm_s, turning).sum()) + len(poses) * pace.settle_s


@dataclass
class Run:
    """One bench, one way of placing."""

    problem: Problem
    world: World
    offsets: np.ndarray
    inside: np.ndarray
    half: np.ndarray
    given_up: int
    seconds: float


def run(name: str, seed: int) -> Run:
    world = make_world(seed)
    plan = plan_poses(IMAGES, world.scene, seed=seed)
    rng = np.random.default_rng([seed, list(ARMS).index(name)])
    images: list[Image | None] = []
    for pose in plan.poses:
        try:
            images.append(ARMS[name](world, pose, rng))
        except PlacementError:
            images.append(None)
    good = [image for image in images if image is not None]
    filler = good[0]
    rows = [filler if image is None else image for image in images]
    recorded = make_images(
        np.array([image.pose for image in rows]), np.array([image.times for image in rows]),
        "time_of_flight", mask=np.array([image is not None for image in images]),
        max_elevation=np.array([image.bracket.max_elevation_mm for image in rows]),
    )  # fmt: skip
    seconds = sum(image.seconds for image in good)
    if "hand" not in name:
        seconds += travel_seconds(plan.poses, plan.tips_mm, Pace())
    return Run(
        Problem.from_recording(Recording(recorded, probe=world.probe)), world,
        np.array([image.elevation_mm for image in good]),
        np.array([image.bracket.contains(image.elevation_mm) for image in good]),
        np.array([image.bracket.max_elevation_mm for image in good]),
        len(images) - len(good), seconds,
    )  # fmt: skip


def precision(transforms: np.ndarray, runs: list[Run]) -> np.ndarray:
    return np.array([
        float(reconstruction_precision(x, *one.world.test_set()))
        for x, one in zip(np.asarray(transforms), runs, strict=True)
    ])  # fmt: skip


def main() -> None:
    quick, folder = arguments(__doc__)
    benches = 4 if quick else 64
    rows: list[dict[str, Any]] = []
    spread: dict[str, np.ndarray] = {}
    for name in ARMS:
        runs = [run(name, seed) for seed in range(benches)]
        problems = stack([one.problem for one in runs])
        joint = calibrate_batch(problems)
        others = {
            "gaussian": calibrate_batch(problems, prior="gaussian"),
            "bounded": calibrate_batch(problems, prior="bounded"),
            "conventional": calibrate_batch(problems, method="conventional"),
        }
        found = np.asarray(joint.image_to_probe)
        rp = {"joint": precision(found, runs)}
        rp |= {key: precision(np.asarray(one.image_to_probe), runs) for key, one in others.items()}
        spread[name] = rp["joint"]
        true = [one.world.image_to_probe for one in runs]
        moved = [np.linalg.norm(x[:3, 3] - t[:3, 3]) for x, t in zip(found, true, strict=True)]
        turned = [rotation_angle(x, t) for x, t in zip(found, true, strict=True)]
        offsets = np.concatenate([one.offsets for one in runs])
        inside = np.concatenate([one.inside for one in runs])
        half = np.concatenate([one.half for one in runs])
        minutes = sum(one.seconds for one in runs) / 60
        row: dict[str, Any] = {"placement": name, "benches": benches, "images": IMAGES}
        row |= {f"rp_{key}_mm": float(values.mean()) for key, values in rp.items()}
        for key in ("conventional", "gaussian"):
            ratio = paired_ratio(rp["joint"], rp[key])
            row[f"joint_over_{key}"], row[f"joint_over_{key}_ci95_half"] = ratio
        row |= {
            "rp_joint_95_mm": float(np.quantile(rp["joint"], 0.95)),
            "rp_joint_worst_mm": float(rp["joint"].max()),
            "x_error_mm": float(np.mean(moved)),
            "x_error_deg": float(np.degrees(np.mean(turned))),
            "offset_mean_mm": float(offsets.mean()),
            "offset_sd_mm": float(offsets.std()),
            "bracket_half_mm": float(half.mean()),
            "inside_bracket": float(inside.mean()),
            "inside_bracket_worst_bench": float(min(one.inside.mean() for one in runs)),
            "images_per_minute": len(offsets) / minutes,
            "given_up": sum(one.given_up for one in runs),
            "not_converged": int((~np.asarray(joint.converged)).sum()),
        }
        rows.append(row)
        show(row.values())
    for row in rows:
        ratio = paired_ratio(spread[row["placement"]], spread["free hand"])
        row["joint_over_free_hand"], row["joint_over_free_hand_ci95_half"] = ratio
    write_rows(folder / "placement.csv", rows)
    plot(folder / "placement.png", rows, spread)
    print(machine())


def plot(path: Path, rows: list[dict[str, Any]], spread: dict[str, np.ndarray]) -> None:
    """RP of every bench by placement, and what it costs in time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    boxes, pace = figure.subplots(1, 2)
    boxes.boxplot(list(spread.values()), orientation="horizontal", tick_labels=list(spread))
    boxes.set(xscale="log", xlabel="reconstruction precision (mm), joint", title="60 images")
    boxes.invert_yaxis()
    plain_ticks(boxes.xaxis, (0.02, 0.05, 0.1, 0.2, 0.5))
    # A legend, not words beside the marks: four of them lie close together.
    for row, marker in zip(rows, "osv^Dp", strict=True):
        pace.plot(row["images_per_minute"], row["rp_joint_mm"], marker, label=row["placement"])
    pace.set(yscale="log", xlabel="images per minute of bench time", ylabel="mean RP (mm)")
    plain_ticks(pace.yaxis, (0.05, 0.1, 0.2, 0.5))
    pace.legend(fontsize="small")
    for axes in (boxes, pace):
        axes.grid(alpha=0.3, which="both")
    save_figure(figure, path, dpi=150)


if __name__ == "__main__":
    main()
