"""Frames of a held or slowly moving probe: are the answers as certain as they say?

Holds: k poses with m frames each, 60 in all; every frame adds 0.05 mm of jitter to pose and point,
errors and offset belong to the hold. Sweeps: 20 frames a second of a probe that moves slowly, with
offsets (and a part of the other errors) that change over about a second. Each trial is calibrated
twice: with every frame as an image of its own, and as ``jaxcal.calibrate`` does it, with one image
for each different pose and, of a sweep, every so many (:mod:`jaxcal.calibration.dependence`).

The table has the coverage of the 95 % intervals of X's six parameters (the mean and the lowest),
the root mean square errors of X and what was stated, the share of trials that would be called good
or fair, by the stated target registration error, although the truth is outside the 99 % interval of
some parameter, and how many were refused for having fewer than four different poses. Of 400 trials
(a quarter of them with every frame an image) a share is known to +- 2 %.

Seed 20261122; trial t of condition k has the generator (seed, k, t).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from common import arguments, batch_of, machine, right_errors, write_table
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.calibration.dependence import independent
from jaxcal.data.recording import make_images
from jaxcal.report.accuracy import FAIR_MM, GOOD_MM
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261122
JITTER_MM = 0.05
NOISE_MM = np.array([0.4, 0.2])
"""SDs of lateral position and range."""
OFFSET_MM = 1.0
"""Offsets of holds are uniform within this."""
RATE_HZ = 20
HEADER = [
    "condition", "frames_as", "trials", "refused", "not_converged", "images_mean",
    "cover_95_mean", "cover_95_lowest", "cover_95_highest", "error_mm", "stated_mm", "error_deg",
    "stated_deg", "good", "good_outside_99", "fair_outside_99",
]  # fmt: skip


@dataclass(frozen=True)
class Frames:
    """One recording and its truth."""

    poses: np.ndarray
    points: np.ndarray
    image_to_probe: np.ndarray


def placed(q: np.ndarray, rotations: np.ndarray, rng: np.random.Generator):
    """A random X and the poses that put the target at q in the image."""
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    transform[:3, 3] = 50 * rng.normal(size=3)
    poses = np.tile(np.eye(4), (len(q), 1, 1))
    poses[:, :3, :3] = rotations
    in_probe = q @ transform[:3, :3].T + transform[:3, 3]
    poses[:, :3, 3] = 100 * rng.normal(size=3) - np.einsum("nij,nj->ni", rotations, in_probe)
    return transform, poses


def jittered(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Every pose moved by the jitter, at the tracked origin and 100 mm from it."""
    each = JITTER_MM / np.sqrt(3)
    moved = poses.copy()
    turns = Rotation.from_rotvec(each / 100 * rng.normal(size=(len(poses), 3))).as_matrix()
    moved[:, :3, :3] = poses[:, :3, :3] @ turns
    moved[:, :3, 3] += each * rng.normal(size=(len(poses), 3))
    return moved


def held(holds: int, frames: int, rng: np.random.Generator) -> Frames:
    """A probe held still in so many poses, for so many frames each."""
    axes = rng.normal(size=(holds, 3))
    axes *= (
        np.radians(30)
        * rng.uniform(-1, 1, (holds, 1))
        / np.linalg.norm(axes, axis=1, keepdims=True)
    )
    q = np.stack(
        [
            rng.uniform(-25, 25, holds),
            rng.uniform(-OFFSET_MM, OFFSET_MM, holds),
            rng.uniform(15, 85, holds),
        ],
        axis=1,
    )
    transform, poses = placed(q, Rotation.from_rotvec(axes).as_matrix(), rng)
    points = seen(q) + NOISE_MM * rng.normal(size=(holds, 2))
    poses, points = np.repeat(poses, frames, axis=0), np.repeat(points, frames, axis=0)
    points = points + JITTER_MM * rng.normal(size=points.shape)
    return Frames(jittered(poses, rng), points, transform)


def swept(seconds: float, alike_s: float, rng: np.random.Generator) -> Frames:
    """A probe that moves slowly, with errors alike over so many seconds."""
    count = round(RATE_HZ * seconds)
    time = np.arange(count) / RATE_HZ

    def path(size: float) -> np.ndarray:
        periods, phases = rng.uniform(6, 20, 2), rng.uniform(0, 2 * np.pi, 2)
        waves = np.sin(2 * np.pi * time[:, None] / periods + phases)
        return size * waves @ [0.7, 0.5]

    rotations = Rotation.from_rotvec(np.stack([path(0.35) for _ in range(3)], axis=1))
    offset = 0.6 * OFFSET_MM * slow(count, alike_s, rng)
    q = np.stack([path(20), offset, 45 + path(22)], axis=1)
    transform, poses = placed(q, rotations.as_matrix(), rng)
    drifting = np.stack([slow(count, alike_s, rng) for _ in range(2)], axis=1)
    errors = 0.8 * rng.normal(size=(count, 2)) + 0.6 * drifting
    return Frames(jittered(poses, rng), seen(q) + NOISE_MM * errors, transform)


def seen(q: np.ndarray) -> np.ndarray:
    """Lateral position and range of the target."""
    return np.stack([q[:, 0], np.hypot(q[:, 1], q[:, 2])], axis=1)


def slow(count: int, alike_s: float, rng: np.random.Generator) -> np.ndarray:
    """Standard normal numbers with an exponential correlation in time."""
    share = np.exp(-1 / (RATE_HZ * alike_s))
    steps = rng.normal(size=count)
    values = np.empty(count)
    values[0] = steps[0]
    for index in range(1, count):
        values[index] = share * values[index - 1] + np.sqrt(1 - share**2) * steps[index]
    return values


CONDITIONS: dict[str, Callable[[np.random.Generator], Frames]] = {
    "3 holds x 20": lambda rng: held(3, 20, rng),
    "4 holds x 15": lambda rng: held(4, 15, rng),
    "6 holds x 10": lambda rng: held(6, 10, rng),
    "10 holds x 6": lambda rng: held(10, 6, rng),
    "20 holds x 3": lambda rng: held(20, 3, rng),
    "sweep 30 s, alike for 0.5 s": lambda rng: swept(30, 0.5, rng),
    "sweep 30 s, alike for 1 s": lambda rng: swept(30, 1.0, rng),
    "sweep 60 s, alike for 1 s": lambda rng: swept(60, 1.0, rng),
}


def stated_tre(results: Calibration) -> np.ndarray:
    """Root mean square target registration error over the image, by which answers are judged."""
    lateral, axial = np.meshgrid(np.linspace(-25, 25, 5), np.linspace(15, 85, 5))
    points = np.stack([lateral, axial], axis=-1).reshape(-1, 2)
    found = np.asarray(jaxcal.predicted_tre(results, points))
    return np.sqrt(np.mean(found**2, axis=-1))


def row_of(result: Calibration, truth: np.ndarray) -> list[object]:
    """What the table says of some answers."""
    answer = result.numpy()
    converged = np.asarray(result.converged)
    error = right_errors(np.asarray(answer.image_to_probe), truth)[converged]
    kept = answer[converged]
    inside, outside = (
        np.abs(error) <= jaxcal.transform_intervals(kept, 0.95),
        (np.abs(error) > jaxcal.transform_intervals(kept, 0.99)).any(axis=1),
    )
    variance = np.diagonal(np.asarray(kept.covariance), axis1=1, axis2=2)
    stated = np.sqrt(variance.reshape(-1, 2, 3).sum(axis=2)) * [1.0, np.degrees(1.0)]
    worst = stated_tre(kept)
    actual = np.sqrt((error.reshape(-1, 2, 3) ** 2).sum(axis=2)) * [1.0, np.degrees(1.0)]
    error_mm, error_deg = np.sqrt(np.mean(actual**2, axis=0))
    stated_mm, stated_deg = np.sqrt(np.mean(stated**2, axis=0))
    covered = inside.mean(axis=0)
    return [
        int((~converged).sum()), float(np.mean(np.sum(answer.mask, axis=1))),
        float(covered.mean()), float(covered.min()), float(covered.max()),
        float(error_mm), float(stated_mm), float(error_deg), float(stated_deg),
        float(np.mean(worst <= GOOD_MM)), float(np.mean((worst <= GOOD_MM) & outside)),
        float(np.mean((worst > GOOD_MM) & (worst <= FAIR_MM) & outside)),
    ]  # fmt: skip


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 40 if quick else 400
    enable_compilation_cache()
    rows: list[list[object]] = []
    for condition, (name, make) in enumerate(CONDITIONS.items()):
        sets = [make(np.random.default_rng([SEED, condition, t])) for t in range(trials)]
        counted: list[tuple[np.ndarray, np.ndarray]] = []
        truth: list[np.ndarray] = []
        for one in sets:
            try:
                images, found = independent(make_images(one.poses, one.points))
            except jaxcal.InputError:
                continue
            counted.append((images.poses[found.keep], images.measurements[found.keep]))
            truth.append(one.image_to_probe)
        # Every frame as an image takes longest, and a quarter of the trials shows what comes of it.
        every = [(one.poses, one.points) for one in sets[: trials // 4]]
        truths = np.array([one.image_to_probe for one in sets[: trials // 4]])
        for how, tried, some, those in (
            ("every frame", len(every), every, truths),
            ("one image a pose", trials, counted, np.array(truth)),
        ):
            head: list[object] = [name, how, tried, tried - len(some)]
            rest: list[object] = [""] * (len(HEADER) - 4)
            if some:
                # Padded to few sizes, each of which is a program.
                most = -(-max(len(poses) for poses, _ in some) // 16) * 16
                rest = row_of(jaxcal.calibrate_batch(batch_of(some, most), chunk=40), those)
            rows.append(head + rest)
            print(*rows[-1], flush=True)
    write_table(folder / "dependent_frames.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
