"""Frames of a held or slowly moving probe: are the answers as certain as they say?

Holds: k poses with m frames each, 60 in all; every frame adds 0.05 mm of jitter to pose and point,
errors and offset belong to the hold. Sweeps: 20 frames a second of a probe that moves slowly, with
offsets (and a part of the other errors) that change over about a second. Paths: 24 to 100 frames,
0.3 s apart, of the same movement (or of one in random order), with offsets and errors that have a
given correlation in successive frames. Smooth sweeps: 12 to 100 frames, 0.05 to 0.5 s apart, of a
shorter and quieter movement (errors of 0.12 and 0.06 mm), with offsets as smooth as the movement
itself, or drawn anew for each frame; in the last ones tracked positions have an error, too. Each
trial is calibrated twice: with every frame as an image of its own (``jaxcal.calibrate_batch``), and
by ``jaxcal.calibrate``, which takes one image for each different pose and, of a sweep, every so
many (:mod:`jaxcal.calibration.dependence`), and widens the covariance for errors that are alike in
successive images (:mod:`jaxcal.calibration.serial_correlation`).

The table has the coverage of the 95 % intervals of X's six parameters (the mean, the lowest and the
highest), the root mean square errors of X and what was stated, and how many were refused for having
fewer than four different poses. ``good`` is the share of trials whose stated target registration
error alone would make them good, ``good_outside_99`` that of trials that would be good although the
truth is outside the 99 % interval of some parameter; ``fair_outside_99`` those that would be fair.
A share of 400 trials is known to +- 5 % at worst (95 %), one of 100 to +- 10 %. Every frame as an
image takes long: 100 trials show what comes of it, and a row of its own has ``jaxcal.calibrate`` on
the same trials. On these, ``verdict_...`` count the words of the real verdict (holds and sweeps).

Seed 20261122; trial t of condition k has the generator (seed, k, t).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from common import arguments, batch_of, machine, right_errors, rms, show, write_rows
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.report.accuracy import FAIR_MM, GOOD_MM
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261122
JITTER_MM = 0.05
NOISE_MM = np.array([0.4, 0.2])
"""SDs of lateral position and range."""
OFFSET_MM = 1.0
"""Offsets of holds are uniform within this."""
QUIET_MM = np.array([0.12, 0.06])
"""The SDs in smooth sweeps."""
TRACKER_MM = 0.1
"""SD of tracked positions in the last smooth sweeps, each axis."""
RATE_HZ = 20
SAME = "calibrate, same trials"
"""In the table's second column: by ``jaxcal.calibrate``, of the trials of "every frame" only."""
MEASURED = [
    "not_converged", "images_mean", "cover_95_mean", "cover_95_lowest", "cover_95_highest",
    "error_mm", "stated_mm", "error_deg", "stated_deg", "good", "good_outside_99",
    "fair_outside_99", "verdict_good", "verdict_fair", "verdict_good_outside_99",
    "verdict_fair_outside_99",
]  # fmt: skip
"""Columns of :func:`row_of`."""


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
    share = np.exp(-1 / (RATE_HZ * alike_s))
    rotations, q = moved(np.arange(count) / RATE_HZ, rng)
    q[:, 1] = 0.6 * OFFSET_MM * slow(count, share, rng)
    transform, poses = placed(q, rotations, rng)
    drifting = np.stack([slow(count, share, rng) for _ in range(2)], axis=1)
    errors = 0.8 * rng.normal(size=(count, 2)) + 0.6 * drifting
    return Frames(jittered(poses, rng), seen(q) + NOISE_MM * errors, transform)


def along(count: int, correlation: float, rng: np.random.Generator, shuffled=False) -> Frames:
    """Frames of a moving probe whose errors have this correlation in successive ones."""
    rotations, q = moved(0.3 * np.arange(count), rng)
    order = rng.permutation(count) if shuffled else np.arange(count)
    rotations, q = rotations[order], q[order]
    errors = np.stack([slow(count, correlation, rng) for _ in range(3)], axis=1)
    q[:, 1] = 0.6 * OFFSET_MM * errors[:, 2]
    transform, poses = placed(q, rotations, rng)
    return Frames(poses, seen(q) + NOISE_MM * errors[:, :2], transform)


def moved(time: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotations, and where the target lies in the mid-plane, at times (s) of a smooth movement."""
    turns = np.stack([waves(time, 0.35, rng) for _ in range(3)], axis=1)
    lateral, axial = waves(time, 20, rng), 45 + waves(time, 22, rng)
    return Rotation.from_rotvec(turns).as_matrix(), np.stack([lateral, 0 * time, axial], axis=1)


def waves(time: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """The sum of two sines, of random periods (s) and phases, at these times."""
    periods, phases = rng.uniform(6, 20, 2), rng.uniform(0, 2 * np.pi, 2)
    return size * np.sin(2 * np.pi * time[:, None] / periods + phases) @ [0.7, 0.5]


def smooth(
    count: int,
    step_s: float,
    rng: np.random.Generator,
    *,
    anew: bool = False,
    tracker_mm: float = 0.0,
) -> Frames:
    """Frames of a moving probe whose offsets are as smooth as the movement, or drawn anew.

    Tracked positions are off by so many mm (SD, each axis).
    """
    time = step_s * np.arange(count)
    rotations, q = moved(time, rng)
    q[:, 1] = 0.5 * rng.normal(size=count) if anew else waves(time, 0.8, rng)
    transform, poses = placed(q, rotations, rng)
    points = seen(q) + QUIET_MM * rng.normal(size=(count, 2))
    poses[:, :3, 3] += tracker_mm * rng.normal(size=(count, 3))
    return Frames(poses, points, transform)


def seen(q: np.ndarray) -> np.ndarray:
    """Lateral position and range of the target."""
    return np.stack([q[:, 0], np.hypot(q[:, 1], q[:, 2])], axis=1)


def slow(count: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """Standard normal numbers, successive ones with a correlation of this share."""
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
    "path of 24, correlation 0": lambda rng: along(24, 0.0, rng),
    "path of 24, correlation 0.6": lambda rng: along(24, 0.6, rng),
    "path of 40, correlation 0": lambda rng: along(40, 0.0, rng),
    "path of 40, correlation 0.3": lambda rng: along(40, 0.3, rng),
    "path of 40, correlation 0.6": lambda rng: along(40, 0.6, rng),
    "path of 100, correlation 0": lambda rng: along(100, 0.0, rng),
    "path of 100, correlation 0.3": lambda rng: along(100, 0.3, rng),
    "path of 100, correlation 0.6": lambda rng: along(100, 0.6, rng),
    "random order of 40, correlation 0": lambda rng: along(40, 0.0, rng, shuffled=True),
    "random order of 40, correlation 0.6": lambda rng: along(40, 0.6, rng, shuffled=True),
    "smooth sweep of 12, 0.5 s apart": lambda rng: smooth(12, 0.5, rng),
    "smooth sweep of 20, 0.5 s apart": lambda rng: smooth(20, 0.5, rng),
    "smooth sweep of 30, 0.5 s apart": lambda rng: smooth(30, 0.5, rng),
    "smooth sweep of 100, 0.05 s apart": lambda rng: smooth(100, 0.05, rng),
    "sweep of 12, 0.5 s apart, offsets anew": lambda rng: smooth(12, 0.5, rng, anew=True),
    "sweep of 20, 0.5 s apart, offsets anew": lambda rng: smooth(20, 0.5, rng, anew=True),
    "sweep of 30, 0.5 s apart, offsets anew": lambda rng: smooth(30, 0.5, rng, anew=True),
    **{
        f"smooth sweep of {count}, {step_s:g} s apart, tracker {TRACKER_MM:g} mm": partial(
            smooth, count, step_s, tracker_mm=TRACKER_MM
        )
        for count, step_s in ((20, 0.5), (30, 0.5), (100, 0.05), (100, 0.2))
    },
}


def stated_tre(results: Calibration) -> np.ndarray:
    """Root mean square target registration error over the image, by which answers are judged."""
    lateral, axial = np.meshgrid(np.linspace(-25, 25, 5), np.linspace(15, 85, 5))
    points = np.stack([lateral, axial], axis=-1).reshape(-1, 2)
    return rms(np.asarray(jaxcal.predicted_tre(results, points)), axis=-1)


@dataclass(frozen=True)
class Answers:
    """What the table needs of answers, each with a leading axis."""

    converged: np.ndarray
    images: np.ndarray
    transform: np.ndarray
    half_95: np.ndarray
    half_99: np.ndarray
    variance: np.ndarray
    tre: np.ndarray

    @classmethod
    def of(cls, result: Calibration) -> Answers:
        """Those of a calibration, of one problem or a batch."""
        answer = result.numpy()
        half_95, half_99 = (jaxcal.transform_intervals(answer, level) for level in (0.95, 0.99))
        variance = np.diagonal(answer.covariance, axis1=-2, axis2=-1)
        images = np.sum(answer.mask, axis=-1)
        found = (answer.image_to_probe, half_95, half_99, variance, stated_tre(answer))
        alone = answer.image_to_probe.ndim == 2
        whole = (np.asarray(result.converged), images, *found)
        return cls(*(np.asarray(each)[None] if alone else np.asarray(each) for each in whole))


def row_of(answers: list[Answers], truth: np.ndarray, words: list[str]) -> dict[str, object]:
    """What the table says of some answers, and of their verdicts if these are known."""
    row: dict[str, object] = dict.fromkeys(MEASURED, "")
    if not answers:
        return row
    joined = {
        field.name: np.concatenate([getattr(each, field.name) for each in answers])
        for field in fields(Answers)
    }
    converged = joined["converged"]
    error = right_errors(joined["transform"], truth)[converged]
    inside = np.abs(error) <= joined["half_95"][converged]
    outside = (np.abs(error) > joined["half_99"][converged]).any(axis=1)
    variance, worst = joined["variance"][converged], joined["tre"][converged]
    stated = np.sqrt(variance.reshape(-1, 2, 3).sum(axis=2)) * [1.0, np.degrees(1.0)]
    actual = np.sqrt((error.reshape(-1, 2, 3) ** 2).sum(axis=2)) * [1.0, np.degrees(1.0)]
    covered = inside.mean(axis=0)
    fair = (worst > GOOD_MM) & (worst <= FAIR_MM)
    row |= {"not_converged": int((~converged).sum()),
            "images_mean": float(np.mean(joined["images"])),
            "cover_95_mean": float(covered.mean()), "cover_95_lowest": float(covered.min()),
            "cover_95_highest": float(covered.max())}  # fmt: skip
    for name, values in (("error", actual), ("stated", stated)):
        row[f"{name}_mm"], row[f"{name}_deg"] = map(float, rms(values, axis=0))
    row |= {"good": float(np.mean(worst <= GOOD_MM)),
            "good_outside_99": float(np.mean((worst <= GOOD_MM) & outside)),
            "fair_outside_99": float(np.mean(fair & outside))}  # fmt: skip
    if words:
        said = np.array(words)[converged]
        for word in ("good", "fair"):
            row[f"verdict_{word}"] = float(np.mean(said == word))
            row[f"verdict_{word}_outside_99"] = float(np.mean((said == word) & outside))
    return row


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 40 if quick else 400
    enable_compilation_cache()
    rows: list[dict[str, object]] = []
    for condition, (name, make) in enumerate(CONDITIONS.items()):
        sets = [make(np.random.default_rng([SEED, condition, t])) for t in range(trials)]
        some = trials // 4
        every = batch_of([(one.poses, one.points) for one in sets[:some]], len(sets[0].poses))
        answers: list[Answers | None] = []
        words: list[str] = []
        for trial, one in enumerate(sets):
            try:
                result = jaxcal.calibrate(jaxcal.Problem.from_arrays(one.poses, one.points))
            except jaxcal.InputError:
                answers.append(None)
                continue
            answers.append(Answers.of(result))
            if trial < some and ("holds" in name or "sweep" in name):
                words.append(result.record()["verdict"] or "none")
        truth = np.array([one.image_to_probe for one in sets])
        batch = [Answers.of(jaxcal.calibrate_batch(every, chunk=40))]
        everything = {"condition": name, "frames_as": "every frame", "trials": some, "refused": 0}
        rows.append(everything | row_of(batch, truth[:some], []))
        for how, tried, said in ((SAME, some, words), ("calibrate", trials, [])):
            answered = np.array([each is not None for each in answers[:tried]])
            found = [each for each in answers[:tried] if each is not None]
            row = {"condition": name, "frames_as": how, "trials": tried}
            row |= {"refused": tried - len(found)}
            rows.append(row | row_of(found, truth[:tried][answered], said))
        for row in rows[-3:]:
            show(row.values())
    write_rows(folder / "dependent_frames.csv", rows)
    print(machine())


if __name__ == "__main__":
    main()
