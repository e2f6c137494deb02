"""Poses in another unit than mm, pixels of unknown size: told or silent, and right ones accused?

With the size of pixels unknown, poses in cm fit as well as poses in mm. What is left to tell them
apart is how large everything comes out (:func:`jaxcal.diagnostics.frame_checks.doubtful_unit`), and
small probes of high frequency are small as well.

Recordings of 12 to 60 images are drawn apart from jaxcal's own simulation. Ordinary probes: pixels
of 0.05 to 0.4 mm, markers 40 to 300 mm from the image, offsets of SD 0.2 to 2 mm. Small ones: 0.015
to 0.05 mm, 10 to 100 mm, 0.05 to 0.8 mm. Both: 350 to 900 pixels along each axis, of which the
target fills 30 to 90 %; points picked to 0.5 to 3 pixels, most of them whole; tilts of up to 12 to
40 degrees. Trackers: optical (the target 0.9 to 2.4 m from the origin), electromagnetic (120 to 500
mm), or with a reference as origin (20 to 400 mm), whose positions have errors of 0.05 to 0.5 mm
(root mean square) and 0.02 to 0.4 degrees; and robots (0.3 to 1 m, 0.02 to 0.1 mm, 0.01 to 0.05
degrees).

``named``: the verdict is "Do not use"; ``doubted``: it is "Uncertain", since the unit may be
another; ``silent``: nothing is said. Poses in mm that are taken for cm come out ten times too
large.

Seed 20261128; recording k of a tracker has the generator (seed, small, tracker, k).
"""

from __future__ import annotations

import numpy as np
from common import arguments, machine, write_table
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import Problem
from jaxcal.data.recording import make_images
from jaxcal.diagnostics.frame_checks import doubtful_unit, wrong_frames

SEED = 20261128
TRACKERS_MM = {
    "optical": (900, 2400),
    "electromagnetic": (120, 500),
    "reference": (20, 400),
    "robot": (300, 1000),
}
GROUPS = (
    ("ordinary probe, mm", False, 1.0),
    ("small probe, mm", True, 1.0),
    ("ordinary probe, cm", False, 0.1),
    ("ordinary probe, inches", False, 1 / 25.4),
    ("ordinary probe, mm taken for cm", False, 10.0),
)
HEADER = ["group", "tracker", "recordings", "named", "doubted", "silent"]


def recorded(small: bool, tracker: str, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses (mm) and points (px) of one recording."""
    rng = np.random.default_rng([SEED, small, list(TRACKERS_MM).index(tracker), number])

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    count = int(rng.integers(12, 61))
    pixel, arm, spread = (
        (between(0.015, 0.05), between(10, 100), between(0.05, 0.8))
        if small
        else (between(0.05, 0.4), between(40, 300), between(0.2, 2.0))
    )
    position, angle = between(0.05, 0.5), rng.uniform(0.02, 0.4)
    if tracker == "robot":
        position, angle = rng.uniform(0.02, 0.1), rng.uniform(0.01, 0.05)
    size = pixel * np.array([1.0, rng.uniform(0.7, 1.4)])
    frame, filled = rng.uniform(350, 900, 2), rng.uniform(0.3, 0.9)
    u, v = (frame * (0.5 + filled * rng.uniform(-0.5, 0.5, (count, 2)))).T
    seen = np.stack([(u - frame[0] / 2) * size[0], spread * rng.normal(size=count), v * size[1]], 1)
    tilts = rng.normal(size=(count, 3))
    tilts *= rng.uniform(0.2, 1, (count, 1)) / np.linalg.norm(tilts, axis=1, keepdims=True)
    first, mount = Rotation.from_quat(rng.normal(size=(2, 4)))
    turns = (first * Rotation.from_rotvec(np.radians(rng.uniform(12, 40)) * tilts)).as_matrix()
    away, lever = rng.normal(size=(2, 3))
    target = rng.uniform(*TRACKERS_MM[tracker]) * away / np.linalg.norm(away)
    x, images = np.eye(4), np.tile(np.eye(4), (count, 1, 1))
    x[:3, :3], x[:3, 3] = mount.as_matrix(), arm * lever / np.linalg.norm(lever)
    images[:, :3, :3] = turns
    images[:, :3, 3] = target - np.einsum("nij,nj->ni", turns, seen)
    poses = images @ np.linalg.inv(x)
    poses[:, :3, 3] += position / np.sqrt(3) * rng.normal(size=(count, 3))
    wrong = Rotation.from_rotvec(np.radians(angle) * rng.normal(size=(count, 3))).as_matrix()
    poses[:, :3, :3] = wrong @ poses[:, :3, :3]
    rows = np.hypot(seen[:, 1], seen[:, 2]) / size[1]
    points = np.stack([u, rows], 1) + rng.uniform(0.5, 3) * rng.normal(size=(count, 2)) * [1, 0.6]
    return poses, np.round(points) if rng.random() < 0.7 else points


def told(poses: np.ndarray, points: np.ndarray) -> str:
    """What the verdict says of the unit."""
    try:
        problem = Problem.from_recording(make_images(poses, points, "pixel"))
    except jaxcal.InputError:
        return "named"
    if wrong_frames(problem, ("scale",)) is not None:
        return "named"
    return "silent" if doubtful_unit(problem) is None else "doubted"


def main() -> None:
    quick, folder = arguments(__doc__)
    count = 10 if quick else 250
    rows: list[list[object]] = []
    for group, small, factor in GROUPS:
        for tracker in TRACKERS_MM:
            found = []
            for number in range(count):
                poses, points = recorded(small, tracker, number)
                poses[:, :3, 3] *= factor
                found.append(told(poses, points))
            rows.append([group, tracker, count, *map(found.count, HEADER[3:])])
            print(*rows[-1], sep=", ", flush=True)
    write_table(folder / "pose_unit.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
