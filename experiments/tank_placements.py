"""Placements on the emulated bench, many of each procedure: offsets, brackets, amplitudes, seconds.

The library is a study of its own (a condition is a procedure, a trial a bench); planning and
bounds draw from its table. ``offset_mm`` is the target's from the plane of the reported pose, which
a calibration meets; the last stop's own error is between it and the true one. Procedures are those
of hw/midplane on the bench's world, their seconds those of :class:`hw.bench.stage.Pace`; a person's
are assumed, as in placement.py.
"""

from __future__ import annotations

import csv
import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from common import write_table
from placement import DECIDE_S, FRAMES, NEXT_POSE_S, by_hand_unplaced, travel_seconds
from tank import Tank
from tank_grid import Grid
from tank_run import SEED, Run

from hw.bench.frames import Camera
from hw.bench.phantoms import CrossWire
from hw.bench.stage import Pace, WorldStage
from hw.bench.tank import Look
from hw.bench.world import World, make_world
from hw.midplane.amplitude_scan import amplitude_scan
from hw.midplane.bracket import Bracket
from hw.midplane.pattern_injection import SteadyOperator, pattern_injection
from hw.midplane.search import PlacementError, first_seen
from hw.midplane.threshold_climb import threshold_climb
from hw.planning.poses import Extent, plan_poses
from jaxcal import InputError
from jaxcal.study import ArraySpec, Chunk

PROCEDURES = (
    "seen, by hand",
    "first seen, robot",
    "amplitude scan",
    "pattern injection",
    "threshold climb",
    "image scan, cross-wire",
)
POSES, BENCHES = 16, 16
"""Poses of each bench, and benches: 256 placements of each procedure."""
COLUMNS = (
    "lateral_mm",
    "range_mm",
    "offset_mm",
    "true_offset_mm",
    "half_mm",
    "sd_mm",
    "amplitude",
    "amplitude_in_plane",
    "seconds",
)
TABLE = "paper_experiment_placements.csv"
LOOKS = 7
"""Looks of a person who brings a cross-wire into the plane by eye, :data:`DECIDE_S` each
(assumption)."""
BY_EYE_S = NEXT_POSE_S + LOOKS * DECIDE_S


@dataclass(frozen=True)
class Procedure:
    """A condition of the library."""

    name: str


@dataclass(frozen=True)
class Library(Grid):
    """Many placements."""

    kind = Procedure

    def arrays(self, chunk: Chunk) -> dict[str, ArraySpec]:
        """One array for each column; NaN where a placement was given up."""
        trials = chunk.stop - chunk.start
        units = {"amplitude": "counts", "amplitude_in_plane": "counts", "seconds": "s"}
        return {name: ArraySpec(units.get(name, "mm"), (POSES, trials)) for name in COLUMNS}

    def compute(self, chunk: Chunk) -> dict[str, np.ndarray]:
        """Placements of as many benches as the chunk has trials."""
        name = self.conditions[chunk.condition].name
        benches = [bench_rows(name, self.seed, trial) for trial in range(chunk.start, chunk.stop)]
        return dict(zip(COLUMNS, np.array(benches).transpose(2, 1, 0), strict=True))


def bench_rows(name: str, seed: int, trial: int) -> np.ndarray:
    """Placements of one procedure on one bench: (poses, columns)."""
    rng = np.random.default_rng([seed, PROCEDURES.index(name), trial])
    tank = Tank()
    world = make_world(trial, phantom=CrossWire()) if "wire" in name else make_world(trial)
    quiet = make_world(trial, response_mm=0.0)
    camera = Camera(world, Look(), seed=trial) if "wire" in name else None
    extent = Extent(cone_deg=tank.cone_deg, turn_deg=tank.turn_deg)
    rows = []
    for pose in plan_poses(POSES, world.scene, extent, trial).poses:
        try:
            rows.append(one(name, world, quiet, camera, pose, rng))
        except PlacementError:
            rows.append([np.nan] * len(COLUMNS))
    return np.array(rows)


def one(
    name: str,
    world: World,
    quiet: World,
    camera: Camera | None,
    pose: np.ndarray,
    rng: np.random.Generator,
) -> list[float]:
    """One placement."""
    stage = WorldStage(world, pose, rng, position_sd_mm=Tank().repeatability_mm)
    bracket: Bracket
    if name == "seen, by hand":
        image = by_hand_unplaced(world, pose, rng)
        # The same place again, to hear how loud it is there.
        axis = pose[:3, :3] @ world.image_to_probe[:3, 1]
        stage.true_pose = pose.copy()
        stage.true_pose[:3, 3] += (world.truth(pose).elevation_mm - image.elevation_mm) * axis
        bracket, seconds = image.bracket, image.seconds
    else:
        match name:
            case "first seen, robot":
                bracket = first_seen(stage).bracket
            case "amplitude scan":
                bracket = amplitude_scan(stage).bracket
            case "pattern injection":
                bracket = pattern_injection(stage, stage, SteadyOperator()).bracket
            case "threshold climb":
                bracket = threshold_climb(stage).bracket
            case _:
                from tank_validation import image_bench

                from hw.midplane.image_scan import image_scan

                assert camera is not None
                bracket = image_scan(image_bench(stage, camera, rng)).bracket
        seconds = stage.seconds + FRAMES * stage.pace.frame_s
    truth = world.truth(stage.true_pose)
    # By hand the place is the true one: somebody looked at it.
    reported = stage.true_pose if name == "seen, by hand" else stage.reported_pose
    stage.set_threshold(100)
    loud = stage.read(3).peak
    return [
        truth.lateral_mm,
        truth.range_mm,
        world.truth(reported).elevation_mm,
        truth.elevation_mm,
        bracket.max_elevation_mm,
        bracket.sd_mm,
        loud,
        in_plane(quiet, stage.true_pose),
        seconds,
    ]


def in_plane(world: World, pose: np.ndarray) -> float:
    """Amplitude at the same lateral position and range in the mid-plane, as procedures read it."""
    moved = pose.copy()
    axis = pose[:3, :3] @ world.image_to_probe[:3, 1]
    moved[:3, 3] += world.truth(pose).elevation_mm * axis
    return float(np.sort(world.loudness(moved))[-8:].mean())


def library(run: Run) -> Path:
    """Compute the library and write its table."""
    grid = Library(SEED, BENCHES, BENCHES, tuple(Procedure(name) for name in PROCEDURES))
    data = run.study("paper_experiment_placements", grid)
    rows = []
    for c, name in enumerate(PROCEDURES):
        flat = np.stack([data[column][c].ravel() for column in COLUMNS], axis=1)
        rows += [[name, *map(float, row)] for row in flat if np.isfinite(row).all()]
    path = run.folder / TABLE
    write_table(path, ["procedure", *COLUMNS], rows)
    for name in PROCEDURES:
        chosen = np.array([row[1:] for row in rows if row[0] == name])
        offset, true, half, seconds = (
            part(chosen, column) for column in ("offset_mm", "true_offset_mm", "half_mm", "seconds")
        )
        print(
            f"{name}: {len(chosen)} placements, offset {offset.mean():+.2f} +- {offset.std():.2f} "
            f"mm, bracket +-{half.mean():.2f} mm holds {np.mean(np.abs(true) <= half):.1%}, "
            f"{seconds.mean():.1f} s"
        )
    return path


def digest(path: Path) -> str:
    """SHA-256 of the table, which studies that draw from it carry."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def beside(path: Path) -> str:
    """The table's path from this folder, which is the same on every machine."""
    return path.resolve().relative_to(Path(__file__).resolve().parent).as_posix()


@lru_cache(maxsize=4)
def rows_of(name: str, sha256: str) -> dict[str, np.ndarray]:
    """The table's rows by procedure: (k, columns).

    Raises:
        InputError: the table has changed since the study was described.
    """
    path = Path(__file__).resolve().parent / name
    if digest(path) != sha256:
        raise InputError(f"{path}: is not the table that the study was begun with")
    found: dict[str, list[list[float]]] = {name: [] for name in PROCEDURES}
    with path.open(newline="") as stream:
        for row in csv.DictReader(stream):
            found[row["procedure"]].append([float(row[name]) for name in COLUMNS])
    return {name: np.array(rows) for name, rows in found.items()}


def part(rows: np.ndarray, name: str) -> np.ndarray:
    """One column of rows of the table."""
    return rows[..., COLUMNS.index(name)]


def sampled(
    rows: np.ndarray, range_mm: np.ndarray, rng: np.random.Generator, near_mm: float = 8.0
) -> np.ndarray:
    """For every image a placement at about its range: (n, columns)."""
    order = np.argsort(part(rows, "range_mm"))
    ranges = part(rows, "range_mm")[order]
    low = np.searchsorted(ranges, range_mm - near_mm)
    high = np.maximum(np.searchsorted(ranges, range_mm + near_mm), low + 1)
    place = low + (rng.random(len(range_mm)) * (high - low)).astype(int)
    return rows[order[np.minimum(place, len(order) - 1)]]


@lru_cache(maxsize=64)
def travel_s(images: int, seed: int) -> float:
    """Bench seconds between the poses of a plan, all together."""
    tank = Tank()
    world = make_world(seed)
    plan = plan_poses(
        images, world.scene, Extent(cone_deg=tank.cone_deg, turn_deg=tank.turn_deg), seed
    )
    return travel_seconds(plan.poses, plan.tips_mm, Pace())
