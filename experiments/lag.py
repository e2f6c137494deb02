"""Images that lag behind the poses of a moving probe: is it told, and what does the verdict say?

A tracked probe moves by hand (sums of three sines with up to 0.3 Hz, about 40 mm/s), and sees a
target at rest within 1 mm of the image plane. Tracker: 30 poses a second, noise of 0.1 mm and 0.7
mrad. Points: 0.3 mm, independent or alike in successive images (correlation 0.6). Images come at
intervals of 1 s, 0.9 s and 0.2 s and show what was earlier by the lag. Poses are interpolated at
the stamps of the images, as ``jaxcal import --poses`` does.

For each: in which share a lag is reported at the import (:func:`jaxcal.data.timing.fitted_lag`) and
by the verdict of the calibration with the default prior, the root mean square errors of both
estimates where they are told, in which share a recording is refused (fewer than four poses differ)
or another fault is reported, in which the verdict is good or fair, in which it is so
although the actual error exceeds the end of its 95 % interval, and the median of the actual error.
The last columns are of calibrations in which the lag of the import was stated.

Seed 20261128; trial k of a condition is the k-th child of (seed, condition).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from common import arguments, machine, save_figure, write_table
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.data.recording import Recording, make_images
from jaxcal.data.timing import (
    LAG_EVIDENCE,
    FittedLag,
    fitted_lag,
    interpolate_poses,
    pose_velocities,
)
from jaxcal.report.accuracy import region_of
from jaxcal.report.record import calibration_record
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261128
TIMES = ((20, 1.0), (40, 0.9), (100, 0.2))
"""Number of images, and s between them."""
LAGS_S = (0.0, 0.02, 0.05, 0.1, 0.2)
ALIKE = (0.0, 0.6)
TRACKER_HZ, TRACKER_MM, TRACKER_RAD, POINT_MM = 30.0, 0.1, 0.0007, 0.3
GAP_S = 0.17
HEADER = [
    "images", "every_s", "alike", "lag_s", "trials", "speed_mm_s", "told_at_import",
    "import_error_s", "told_by_verdict", "verdict_error_s", "refused", "other_told",
    "good_or_fair", "good_and_wrong", "error_mm", "told_once_stated", "error_once_stated_mm",
]  # fmt: skip


@dataclass(frozen=True)
class Scan:
    """One scan: how the probe moves, and what it sees.

    Attributes:
        image_to_probe: X, mm.
        amplitude: (6, 3) of the sines of three turns and three coordinates of the target.
        frequency: Hz.
        phase: rad.
    """

    image_to_probe: np.ndarray
    amplitude: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Scan:
        """A random one."""
        x = np.eye(4)
        x[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        x[:3, 3] = rng.normal(0, 60, 3)
        size = (6, 3)
        return cls(
            x,
            rng.uniform(0.25, 0.85, size),
            rng.uniform(0.05, 0.3, size),
            rng.uniform(0, 6.3, size),
        )

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses at some times, mm, and the target in the image frame, mm."""
        waves = self.amplitude * np.sin(2 * np.pi * self.frequency * t[:, None, None] + self.phase)
        wave = waves.sum(axis=2)
        seen = [0.0, 0.0, 50.0] + wave[:, 3:] * [18.0, 1.0, 15.0]
        in_probe = seen @ self.image_to_probe[:3, :3].T + self.image_to_probe[:3, 3]
        poses = np.tile(np.eye(4), (len(t), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(0.35 * wave[:, :3] + [1.0, 0.3, -2.0]).as_matrix()
        turned = np.einsum("nij,nj->ni", poses[:, :3, :3], in_probe)
        poses[:, :3, 3] = [100.0, -50.0, -900.0] - turned
        return poses, seen


@dataclass(frozen=True)
class Trial:
    """A scan as it was recorded.

    Attributes:
        scan: the true motion.
        stamps: of the images, s.
        points: in them, mm.
        t: times of the poses, s.
        poses: with the tracker's noise, mm.
    """

    scan: Scan
    stamps: np.ndarray
    points: np.ndarray
    t: np.ndarray
    poses: np.ndarray

    @classmethod
    def drawn(
        cls, rng: np.random.Generator, images: int, every_s: float, alike: float, lag_s: float
    ) -> Trial:
        """One that has a lag."""
        scan = Scan.drawn(rng)
        t, stamps = (
            np.arange(0, 4 + images * every_s, 1 / TRACKER_HZ),
            2 + every_s * np.arange(images),
        )
        poses, _ = scan.at(t)
        poses[:, :3, 3] += rng.normal(0, TRACKER_MM, (len(t), 3))
        turns = Rotation.from_rotvec(rng.normal(0, TRACKER_RAD, (len(t), 3))).as_matrix()
        poses[:, :3, :3] = poses[:, :3, :3] @ turns
        errors = rng.normal(0, POINT_MM, (images, 2))
        for row in range(1, images):
            errors[row] = alike * errors[row - 1] + np.sqrt(1 - alike**2) * errors[row]
        return cls(scan, stamps, scan.at(stamps - lag_s)[1][:, [0, 2]] + errors, t, poses)

    def found_lag(self) -> FittedLag | None:
        """What the import finds."""
        return fitted_lag(self.stamps, self.points, self.t, self.poses, max_gap_s=GAP_S)

    def recording(self, lag_s: float = 0.0) -> Recording:
        """With poses that were looked up at the stamps less a stated lag."""
        asked = self.stamps - lag_s
        poses = interpolate_poses(self.t, self.poses, asked, max_gap_s=GAP_S)
        velocity = pose_velocities(self.t, self.poses, asked, max_gap_s=GAP_S)
        return Recording(make_images(poses, self.points, time=self.stamps, velocity=velocity))

    def error_mm(self, result: jaxcal.Calibration, recording: Recording) -> float:
        """Root mean square over the region of the report."""
        grid = region_of(result, recording).grid()
        apart = np.asarray(result.image_to_probe) - self.scan.image_to_probe
        moved = grid @ apart[:3, :3].T + apart[:3, 3]
        return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def calibrated(
    trials: list[Trial], recordings: list[Recording]
) -> tuple[list[float | None], np.ndarray]:
    """The lag of each verdict; and: refused, another kind reported, good or fair, wrong, error."""
    lags: list[float | None] = []
    rows: list[list[float]] = []
    for trial, recording in zip(trials, recordings, strict=True):
        try:
            result = jaxcal.calibrate(recording)
        except jaxcal.InputError:
            lags.append(None)
            rows.append([1.0, 0.0, 0.0, 0.0, np.nan])
            continue
        record = calibration_record(result, recording)
        tre, error = record["tre"], trial.error_mm(result, recording)
        told = None if tre is None else tre["unmodelled"]
        lag = told is not None and told["kind"] == "lag"
        lags.append(float(told["values"][0]) if told is not None and lag else None)
        good = record["verdict"] in ("good", "fair")
        wrong = good and tre is not None and error > tre["interval_95_mm"][1]
        other = record["wrong_frames"] is not None or (told is not None and not lag)
        rows.append([0.0, float(other), float(good), float(wrong), error])
    return lags, np.array(rows)


def off_by(found: list[float], lag_s: float) -> float | str:
    """Root mean square error, s; nothing where none was told."""
    return float(np.sqrt(np.mean((np.array(found) - lag_s) ** 2))) if found else ""


def figure(rows: list[list[object]], path) -> None:
    """Shares against the lag: told at the import, told by the verdict, verdict good or fair."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(9.0, 3.0), layout="constrained")
    panels = drawn.subplots(1, len(TIMES), sharey=True)
    shown = (("told_at_import", "named at the import"), ("told_by_verdict", "named by the verdict"),
             ("good_or_fair", "verdict good or fair"),
             ("other_told", "verdict names another error"))  # fmt: skip
    for panel, (images, every_s) in zip(panels, TIMES, strict=True):
        of = [row for row in rows if row[:3] == [images, every_s, 0.0]]
        for (column, label), style in zip(shown, ("o-", "s-", "^--", "x:"), strict=True):
            shares = [row[HEADER.index(column)] for row in of]
            panel.plot([1000 * lag for lag in LAGS_S], shares, style, label=label)
        panel.set_title(f"{images} images, one every {every_s:g} s", fontsize=9)
        panel.set_xlabel("lag (ms)")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("share of recordings")
    panels[0].legend(fontsize=7)
    save_figure(drawn, path, dpi=150)


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    rows: list[list[object]] = []
    conditions = [(n, every, alike, lag) for n, every in TIMES for alike in ALIKE for lag in LAGS_S]
    for condition, (images, every_s, alike, lag_s) in enumerate(conditions):
        count = 5 if quick else 300 if lag_s == 0 else 60
        seeds = np.random.SeedSequence([SEED, condition]).spawn(count)
        trials = [
            Trial.drawn(np.random.default_rng(seed), images, every_s, alike, lag_s)
            for seed in seeds
        ]
        found = [trial.found_lag() for trial in trials]
        told = [
            each.lag_s if each is not None and each.evidence > LAG_EVIDENCE else None
            for each in found
        ]
        recordings = [trial.recording() for trial in trials]
        lags, first = calibrated(trials, recordings)
        stated = [trial.recording(lag or 0.0) for trial, lag in zip(trials, told, strict=True)]
        again, then = calibrated(trials, stated)
        velocities = [recording.calibration.velocity for recording in recordings]
        speed = np.mean(
            [np.linalg.norm(v[:, :3], axis=1).mean() for v in velocities if v is not None]
        )
        at_import, by_verdict = ([lag for lag in each if lag is not None] for each in (told, lags))
        rows.append([
            images, every_s, alike, lag_s, count, float(speed),
            len(at_import) / count, off_by(at_import, lag_s),
            len(by_verdict) / count, off_by(by_verdict, lag_s),
            *map(float, first[:, :4].mean(axis=0)), float(np.nanmedian(first[:, 4])),
            float(np.mean([lag is not None for lag in again])), float(np.nanmedian(then[:, 4])),
        ])  # fmt: skip
        print(*rows[-1], sep=", ", flush=True)
    write_table(folder / "lag.csv", HEADER, rows)
    figure(rows, folder / "lag.png")
    print(machine())


if __name__ == "__main__":
    main()
