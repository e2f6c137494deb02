"""Recordings in wrong frames and units: is each named or refused, and no right one accused?

Forty recordings of 20 to 32 images, in mm, in pixels of known spacing and in pixels of unknown
size, are calibrated as they are and after each of the slips below. ``named``: the calibration says
what is wrong (:mod:`jaxcal.diagnostics.frame_checks`), its verdict is "Do not use" and its exit
status 3; ``refused``: one line before anything is solved. ``rightly``: what is said names this slip
(of slips that have the same effect, either). ``good or fair`` counts verdicts that somebody would
believe.

Mirrored pixels, and swapped ones of unknown size, are no error that these data could show, nor one
that they suffer: the last column is how far the answer puts the measured points from where it puts
them without the slip (mm in the tracker's frame, root mean square).

Seed 20261123; recording k has the generator (seed, k).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from common import arguments, machine, write_table
from dependent_frames import placed, seen
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.cli.common import ExitCode, exit_code
from jaxcal.data.poses import inverse_poses
from jaxcal.data.recording import Images, make_images
from jaxcal.report.record import calibration_record
from jaxcal.report.verdict import verdict
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261123
SPACING_MM = (0.10, 0.12)
ORIGIN_PX = 320.0
HEADER = [
    "slip", "form", "recordings", "named", "rightly", "refused", "good_or_fair", "points_moved_mm",
]  # fmt: skip


@dataclass(frozen=True)
class Arrays:
    """What a file holds."""

    poses: np.ndarray
    points: np.ndarray
    form: str
    spacing: tuple[float, float] | None = None

    def images(self) -> Images:
        """Checked, as an import would."""
        kind = "point" if self.form == "mm" else "pixel"
        return make_images(self.poses, self.points, kind, spacing_mm=self.spacing)


def recorded(number: int, form: str) -> Arrays:
    """One right recording."""
    rng = np.random.default_rng([SEED, number])
    count = int(rng.integers(20, 33))
    axes = rng.normal(size=(count, 3))
    axes *= rng.uniform(0.1, 0.52, (count, 1)) / np.linalg.norm(axes, axis=1, keepdims=True)
    offset = rng.uniform(0.2, 2.0) * rng.uniform(-1, 1, count)
    q = np.stack([rng.uniform(-25, 25, count), offset, rng.uniform(15, 85, count)], axis=1)
    _, poses = placed(q, Rotation.from_rotvec(axes).as_matrix(), rng)
    points = seen(q) + rng.uniform(0.1, 0.6) * rng.normal(size=(count, 2)) * [1.0, 0.5]
    if form == "mm":
        return Arrays(poses, points, form)
    pixels = points / SPACING_MM + [ORIGIN_PX, 0.0]
    return Arrays(poses, pixels, form, SPACING_MM if form == "px, known" else None)


def with_poses(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Arrays], Arrays]:
    return lambda arrays: replace(arrays, poses=change(arrays.poses.copy()))


def scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(poses: np.ndarray) -> np.ndarray:
        poses[:, :3, 3] *= factor
        return poses

    return change


def all_scaled(arrays: Arrays) -> Arrays:
    """Everything in metres."""
    made = with_poses(scaled(1e-3))(arrays)
    if arrays.form == "mm":
        return replace(made, points=made.points / 1e3)
    spacing = None if arrays.spacing is None else tuple(each / 1e3 for each in arrays.spacing)
    return replace(made, spacing=spacing)


def transposed(poses: np.ndarray) -> np.ndarray:
    poses[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return poses


def quaternions_misread(poses: np.ndarray) -> np.ndarray:
    found = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    poses[:, :3, :3] = Rotation.from_quat(found[:, [3, 0, 1, 2]]).as_matrix()
    return poses


def euler_misread(poses: np.ndarray) -> np.ndarray:
    """Angles about moving axes, read as about fixed ones."""
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("XYZ")
    poses[:, :3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    return poses


def radians_as_degrees(poses: np.ndarray) -> np.ndarray:
    vectors = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    poses[:, :3, :3] = Rotation.from_rotvec(vectors, degrees=True).as_matrix()
    return poses


def mirrored(poses: np.ndarray) -> np.ndarray:
    poses[:, 1, 3] *= -1
    return poses


def exchanged(poses: np.ndarray) -> np.ndarray:
    poses[:, :3, 3] = poses[:, [1, 0, 2], 3]
    return poses


def left_handed(poses: np.ndarray) -> np.ndarray:
    """The tracker's z axis reversed, rotations and all: a reflection."""
    poses[:, 2] *= [-1, -1, -1, -1]
    return poses


def other_columns(arrays: Arrays) -> Arrays:
    return replace(arrays, points=arrays.points[:, ::-1].copy())


def flipped(arrays: Arrays) -> Arrays:
    last = 2 * ORIGIN_PX if arrays.form != "mm" else 0.0
    return replace(arrays, points=np.array([last, 0.0]) + arrays.points * [-1.0, 1.0])


def out_of_step(arrays: Arrays) -> Arrays:
    return replace(arrays, poses=arrays.poses[:-1], points=arrays.points[1:])


SLIPS: dict[str, tuple[Callable[[Arrays], Arrays], tuple[str, ...]]] = {
    "none": (lambda arrays: arrays, ()),
    "all in metres": (all_scaled, ("metres",)),
    "poses in metres": (with_poses(scaled(1e-3)), ("metres",)),
    "poses in cm": (with_poses(scaled(0.1)), ("cm",)),
    "inverse poses": (with_poses(inverse_poses), ("invert",)),
    "transposed rotations": (with_poses(transposed), ("transpose",)),
    "quaternions misread": (with_poses(quaternions_misread), ("first but is read as last",)),
    "Euler angles misread": (with_poses(euler_misread), ("in place of Rx Ry Rz",)),
    "radians as degrees": (with_poses(radians_as_degrees), ("radians",)),
    "one translation mirrored": (with_poses(mirrored), ("wrong sign",)),
    "translations exchanged": (with_poses(exchanged), ("exchanged",)),
    "left-handed poses": (with_poses(left_handed), ("reflection",)),
    "one row out of step": (out_of_step, ("out of step",)),
    "u and v swapped": (other_columns, ("exchanged", "not positive")),
    "u mirrored": (flipped, ()),
}
FORMS = ("mm", "px, known", "px, unknown")


def outcome(arrays: Arrays) -> tuple[str, str, np.ndarray | None]:
    """How it ends, what is said, and where the points go."""
    estimate = ("scale",) if arrays.form == "px, unknown" else ()
    try:
        recording = jaxcal.Recording(arrays.images())
        result = jaxcal.calibrate(recording, estimate=estimate)
    except jaxcal.InputError as error:
        return "refused", str(error), None
    record = calibration_record(result, recording)
    headline = verdict(record)[0]
    scale = np.ones(2) if result.scale_mm_per_px is None else np.asarray(result.scale_mm_per_px)
    flat = np.zeros((len(arrays.points), 4))
    flat[:, [0, 2]], flat[:, 3] = arrays.points * scale, 1.0
    there = (arrays.poses @ (np.asarray(result.image_to_probe) @ flat.T).T[..., None])[:, :3, 0]
    if record["wrong_frames"]:
        assert exit_code([record]) == ExitCode.NOT_CONVERGED
        assert headline.startswith("Do not use")
        return "named", record["wrong_frames"], there
    return ("believed" if record["verdict"] in ("good", "fair") else "doubted"), headline, there


def main() -> None:
    quick, folder = arguments(__doc__)
    count = 8 if quick else 40
    enable_compilation_cache()
    rows: list[list[object]] = []
    for form in FORMS:
        right = [recorded(number, form) for number in range(count)]
        places = [outcome(arrays)[2] for arrays in right]
        for slip, (make, words) in SLIPS.items():
            ends = [outcome(make(arrays)) for arrays in right]
            how = [end[0] for end in ends]
            apart = [
                float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))
                for a, (_, _, b) in zip(places, ends, strict=True)
                if a is not None and b is not None and a.shape == b.shape
            ]
            rightly = sum(any(word in said for word in words) for _, said, _ in ends)
            rows.append([
                slip, form, count, how.count("named"), rightly, how.count("refused"),
                how.count("believed"), float(np.mean(apart)) if apart else "",
            ])  # fmt: skip
            print(*rows[-1], sep=", ", flush=True)
            for end, said, _ in ends[:1]:
                print(f"    {end}: {said}")
    write_table(folder / "wrong_frames.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
