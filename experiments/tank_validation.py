"""The fast model of the tank, quantity by quantity, against the emulated bench it stands for.

- A person's pick: on frames of the emulated machine, the middle of everything near the target that
  is brighter than half of the brightest, off by ``tank.PICK`` of its width; the fast model never
  draws a frame.
- A person's mid-plane of a cross-wire: on frames, the offsets up to which the brightness along the
  lateral direction has one maximum.
- Placement by electronics and by image: the procedures of hw/midplane on the bench's world.
- Automatic segmentation: the bench's times of flight, reflections among them, and the fit of Eq. 5;
  for frames :func:`jaxcal.data.segmentation.image.localise`, which the fast model does not use.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import tank
from common import show, write_rows
from tank import FWHM, PICK, QUALITIES, Tank
from tank_run import SEED, Run

from hw.acquisition.stage import IMAGE_AGE_S
from hw.bench.frames import COLUMNS, DECIBELS, Camera
from hw.bench.phantoms import ActiveEcho, CrossWire, Hydrophone
from hw.bench.stage import WorldStage
from hw.bench.tank import Look
from hw.bench.world import World, make_world
from hw.midplane.amplitude_scan import amplitude_scan
from hw.midplane.image_scan import ImageBench, image_scan, pixel_of
from hw.midplane.search import PlacementError
from hw.planning.poses import Extent, plan_poses
from jaxcal import Images, segment
from jaxcal.data.segmentation.image import Target, localise

WIRED = CrossWire(directions=tuple(tuple(float(v) for v in row) for row in tank.WIRES))  # pyright: ignore[reportArgumentType]
VISIBLE = 1.0 - 10 ** (-2.0 / 20)
"""A dip that a person sees: 2 dB (assumption)."""
_NEAR_PX = (60, 30)
_GRID_MM = np.arange(0.0, 4.01, 0.1)


def poses_of(world: World, count: int, seed: int) -> np.ndarray:
    """Planned poses of the tank's protocol."""
    condition = Tank()
    extent = Extent(cone_deg=condition.cone_deg, turn_deg=condition.turn_deg)
    return plan_poses(count, world.scene, extent, seed).poses


def at_offset(world: World, pose: np.ndarray, elevation_mm: float) -> np.ndarray:
    """The pose moved along the elevational axis until the target is at an offset."""
    moved = pose.copy()
    axis = pose[:3, :3] @ world.image_to_probe[:3, 1]
    moved[:3, 3] += (world.truth(pose).elevation_mm - elevation_mm) * axis
    return moved


def near(frame: np.ndarray, u: float, v: float) -> tuple[np.ndarray, int, int]:
    """Envelope near a place, and the place of its first pixel."""
    left, top = max(int(u) - _NEAR_PX[0], 0), max(int(v) - _NEAR_PX[1], 0)
    part = frame[top : int(v) + _NEAR_PX[1], left : int(u) + _NEAR_PX[0]].astype(float)
    return 10 ** ((part / 255.0 - 1.0) * DECIBELS / 20.0), left, top


def person(frame: np.ndarray, u: float, v: float, rng: np.random.Generator) -> np.ndarray:
    """Where a person picks the target, px."""
    envelope, left, top = near(frame, u, v)
    rows, columns = np.nonzero(envelope >= 0.5 * envelope.max())
    low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
    return 0.5 * (low + high) + [left, top] + PICK * (high - low + 1) * rng.normal(size=2)


def one_spot(frame: np.ndarray, u: float, v: float) -> bool:
    """Whether the two wires look like one: no dip of 2 dB between two maxima of the profile."""
    from scipy.signal import find_peaks

    envelope, _, _ = near(frame, u, v)
    profile = envelope.max(axis=0)
    top = profile.max()
    peaks, _ = find_peaks(profile, height=0.5 * top, prominence=VISIBLE * top)
    return len(peaks) <= 1


def validation(run: Run) -> None:
    """Compare, and write the table."""
    count = 24 if run.quick else 120
    rows: list[dict[str, Any]] = []
    for name in QUALITIES:
        rows += [*picks(name, count), *person_reach(name, count // 2)]
    rows += [*placements(count), *times(count), *frames(count)]
    write_rows(run.folder / "paper_experiment_validation.csv", rows)
    for one in rows:
        show(one.values())


def row(quantity: str, experiment: str, n: int, fast: float | None, bench: float) -> dict[str, Any]:
    """One line of the table."""
    return {
        "quantity": quantity,
        "experiment": experiment,
        "images": n,
        "fast_model": "" if fast is None else fast,
        "bench": bench,
        "unit": "mm",
        "bench_over_fast": "" if fast is None else bench / fast,
    }


def by_axis(
    quantity: str, experiment: str, n: int, fast: np.ndarray | None, bench: np.ndarray
) -> list[dict[str, Any]]:
    """Two lines, lateral position and range, in the place of ``{}``."""
    return [
        row(quantity.format(axis), experiment, n, None if fast is None else float(fast[k]),
            float(bench[k]))
        for k, axis in enumerate(("lateral", "range"))
    ]  # fmt: skip


def picks(name: str, count: int) -> list[dict[str, Any]]:
    """SDs of a person's picks in the plane."""
    condition, found = Tank(quality=name), []
    # A reflection is no matter of a pick's spread; background and focus are.
    look = replace(condition.look, ghost=0.0, wire=Look.wire)
    for label, phantom in (("AE", ActiveEcho()), ("CW", WIRED)):
        rng = np.random.default_rng([SEED, 1])
        world = make_world(0, phantom=phantom)
        drawn_look = replace(look, wire=0.0) if label == "AE" else look
        camera = Camera(world, drawn_look, seed=1)
        errors, fast = [], []
        for pose in poses_of(world, count, 0):
            pose = at_offset(world, pose, 0.0)
            truth = world.truth(pose)
            frame = camera.frame(pose, rng)
            u, v = camera.pixel(truth.lateral_mm, truth.range_mm)
            errors.append((person(frame, u, v, rng) - [u, v]) * camera.spacing_mm)
            if label == "AE":
                lateral = tank.echo_width_mm(condition)
            else:
                wires = wires_in_image(world, pose)
                widths = tank.wire_widths_mm(condition, np.array([truth.range_mm]), wires)
                lateral = tank.CROSSING * widths.mean()
            scatter = tank.SCATTER_MM if label == "CW" else 0.0
            fast.append(
                [
                    np.hypot(PICK * FWHM * lateral, scatter),
                    np.hypot(PICK * FWHM * look.axial_mm, scatter),
                ]
            )
        sd = np.std(errors, axis=0)
        expected = np.sqrt(np.mean(np.square(fast), axis=0))
        quantity = f"{label}: SD of a person's pick in the plane, {{}}"
        found += by_axis(quantity, name, count, expected, sd)
    return found


def wires_in_image(world: World, pose: np.ndarray) -> np.ndarray:
    """As :attr:`tank.Orientations.wires`, of one true pose: (1, 2)."""
    along = tank.WIRES @ pose[:3, :3] @ world.image_to_probe[:3, :3]
    return (-along[:, 0] / along[:, 1])[None]


def person_reach(name: str, count: int) -> list[dict[str, Any]]:
    """Offset up to which two wires look like one."""
    condition = Tank(quality=name)
    look = condition.look
    world = make_world(0, phantom=WIRED)
    camera, rng = Camera(world, look, seed=2), np.random.default_rng([SEED, 2])
    seen, fast = [], []
    for pose in poses_of(world, count, 1):
        reached = 0.0
        for offset in _GRID_MM:
            there = at_offset(world, pose, float(offset))
            truth = world.truth(there)
            u, v = camera.pixel(truth.lateral_mm, truth.range_mm)
            if not one_spot(camera.frame(there, rng), u, v):
                break
            reached = float(offset)
        seen.append(reached)
        wires = wires_in_image(world, pose)
        depth = np.array([world.truth(pose).range_mm])
        fast.append(float(tank.parted_mm(condition, depth, wires)[0]))
    quantity = "CW: offset up to which two wires look like one"
    return [row(quantity, name, count, float(np.mean(fast)), float(np.mean(seen)))]


def placements(count: int) -> list[dict[str, Any]]:
    """SDs of the offsets that placements leave."""
    condition = Tank()
    stop = condition.repeatability_mm
    point = float(np.hypot(tank.SEARCH_MM, stop))
    expected = {
        "AE: SD of the offset after an amplitude scan": (
            ActiveEcho(),
            float(np.hypot(tank.element_sd_mm(condition), point)),
        ),
        "AE of 1 mm: the same": (
            ActiveEcho(1.0),
            float(np.hypot(tank.element_sd_mm(Tank(element_mm=1.0)), point)),
        ),
        "OH: SD of the offset after an amplitude scan": (Hydrophone(), point),
        "CW: SD of the offset after an image scan by robot": (WIRED, None),
    }
    found = []
    for quantity, (phantom, fast) in expected.items():
        offsets = []
        for seed in range(4):
            world = make_world(seed, phantom=phantom)
            rng = np.random.default_rng([SEED, 3, seed])
            camera = Camera(world, seed=seed)
            for pose in poses_of(world, count // 4, seed):
                stage = WorldStage(world, pose, rng, position_sd_mm=stop)
                try:
                    if phantom is WIRED:
                        image_scan(image_bench(stage, camera, rng))
                    else:
                        amplitude_scan(stage)
                except PlacementError:
                    continue
                offsets.append(stage.elevation_mm)
        found.append(row(quantity, "all", len(offsets), fast, float(np.std(offsets))))
    return found


def image_bench(stage: WorldStage, camera: Camera, rng: np.random.Generator) -> ImageBench:
    """A stage that is seen through frames; waiting for each counts."""
    world = stage.world

    def see() -> np.ndarray:
        stage.seconds += IMAGE_AGE_S + stage.pace.frame_s
        return camera.frame(stage.true_pose, rng)

    expected = world.scene.expected(stage.plan_pose)[[0, 2]]
    place = pixel_of(expected, camera.spacing_mm, COLUMNS)
    return ImageBench(stage.move, see, place, 120.0)


def times(count: int) -> list[dict[str, Any]]:
    """SDs of points from times of flight, the bench's against the fast model's."""
    found = []
    for name, phantom in (("Auto-AE", ActiveEcho()), ("OH", Hydrophone())):
        world = make_world(0, phantom=phantom)
        rng = np.random.default_rng([SEED, 4])
        truth, bench = [], []
        poses = [at_offset(world, pose, 0.0) for pose in poses_of(world, count, 2)]
        for pose in poses:
            told = np.array([world.echo(pose, 100, rng)[0] for _ in range(tank.FRAMES)])
            answered = 2 * np.isfinite(told).sum(axis=0) >= tank.FRAMES
            middle = np.full(told.shape[1], np.nan)
            middle[answered] = np.nanmedian(told[:, answered], axis=0)
            bench.append(middle)
            place = world.truth(pose)
            truth.append([place.lateral_mm, place.range_mm])
        exact = np.array(truth)
        for method in ("least-squares", "shortest") if name == "Auto-AE" else ("least-squares",):
            sds = []
            for measured in (tank.heard(exact, rng), np.array(bench)):
                images = Images(
                    np.array(poses), measured, "time_of_flight", np.ones(len(poses), bool)
                )
                points = segment(images, world.probe, method=method).images
                errors = (points.measurements - exact)[points.mask]
                sds.append(np.std(errors, axis=0))
            found += by_axis(f"{name}: SD of the point by {method}, {{}}", "all", count, *sds)
    return found


def frames(count: int) -> list[dict[str, Any]]:
    """SDs of automatic points from frames; the fast model has none."""
    found = []
    cases: tuple[tuple[str, ActiveEcho | CrossWire, Target], ...] = (
        ("AE", ActiveEcho(), "echo"),
        ("CW", WIRED, "cross"),
    )
    for name, phantom, target in cases:
        for offset in (0.0, 0.3):
            world = make_world(0, phantom=phantom)
            rng = np.random.default_rng([SEED, 5])
            camera = Camera(world, Tank().look, seed=3)
            drawn, exact = [], []
            for pose in poses_of(world, count, 3):
                there = at_offset(world, pose, offset)
                truth = world.truth(there)
                drawn.append(camera.frame(there, rng))
                exact.append(camera.pixel(truth.lateral_mm, truth.range_mm))
            located = localise(np.array(drawn), target, near=np.array(exact), within_px=80.0)
            errors = (located.position - exact) * camera.spacing_mm
            quantity = f"{name}: SD of the point localised in frames, {{}}, offset {offset:g} mm"
            sds = np.nanstd(errors, axis=0)
            found += by_axis(quantity, "Exp. 3", int(located.found.sum()), None, sds)
    return found
