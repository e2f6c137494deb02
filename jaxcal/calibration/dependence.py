"""Images with the same errors: repeated poses, and streams whose errors change slowly.

Calibration assumes that the errors of different images are independent. They are not if a probe is
held still while frames come in at 20 Hz: the target's offset from the image plane is one number for
the whole hold, and so are the errors of tracking and speckle. Sixty frames of three holds tell only
as much as three images, however small their residuals are.

*Repeated poses.* Two poses are the same if no point within ``LEVER_MM`` of the tracked origin moves
by more than ``SAME_POSE_MM`` between them. This is the error of an optical tracker at such a lever
(0.25 to 0.35 mm at a marker, more beyond it). It is less than the thickness of an ultrasound beam
and less than the offsets, so such images share their offset and their speckle. Images linked by
such pairs are one pose while they stay within ``HOLD_MM``; a longer chain is a slow sweep, and is
cut into pieces of ``SAME_POSE_MM``. Every group becomes one image with the mean pose and the mean
point (the median from five frames on, so one wrong click in a hold does no harm). Its errors are
those *between* holds, which the solver estimates from the holds' residuals; they include what the
mean leaves of the errors *within* a hold. The other frames of a group are masked out.

*Frozen tracking.* Many trackers repeat the last pose while the tool is not seen; filters and
interpolation between poses change it slightly. Frames whose poses differ by at most ``FROZEN_MM``,
in which the target lies in different places, have a wrong pose and are left out.

*Streams.* Images of a moving probe may differ in pose and still share slowly changing errors. The
residuals of the conventional fit (closed form, :mod:`jaxcal.solvers.closed_form.single`) have an
integrated autocorrelation time t, and n images are worth n / t independent ones. Where t reaches
``LEAST_STREAM_TIME`` images and chance does not explain it, images are left out at equal intervals.
At least ``KEPT_OF_TIME`` of every time t are kept, and ``KEPT_OF_STREAM`` of a whole stream, since
the correlation that remains widens the covariance
(:mod:`jaxcal.calibration.serial_correlation`), and does so better the more images show it. Where it
cannot, one of a time t is kept.

References: Wiles, Thompson and Frantz 2004 (accuracy of optical trackers); Sokal 1997,
section 3 (integrated autocorrelation time); Liang and Zeger 1986 (clustered data).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import nearest_rotations
from jaxcal.data.problem import Problem
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.data.timing import LEVER_MM
from jaxcal.diagnostics.frame_checks import wrong_frames
from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.model.thresholds import MAD
from jaxcal.model.unknowns import RIGID
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.arrays import like
from jaxcal.runtime.messages import runs_in_words
from jaxcal.solvers.closed_form.single import solve_problem

SAME_POSE_MM = 1.0
"""Two poses are the same if no point within the lever moves farther than this between them."""

HOLD_MM = 3.0
"""Images linked by pairs of the same pose are one hold if they all lie within this."""

MEDIAN_FROM = 5
"""From so many frames on, the point of a group is the median of its frames' points."""

FROZEN_MM = 0.1
"""Poses that are nearer than this to each other may be repetitions of one."""

MOVED_SHARE = 0.25
"""Frames of one pose contradict it if their points differ by more than this share of the spread of
all points, and by more than ``LEAST_MOVED``."""
LEAST_MOVED = 3.0
"""px for pixels, mm for points: what noise of the points can do where they hardly differ."""

LEAST_STREAM_TIME = 4.0
"""Least autocorrelation time of a stream, in images."""

KEPT_OF_TIME, KEPT_OF_STREAM = 2.5, 60
"""Least number of images that are kept of an autocorrelation time, and of a whole stream. With
fewer images errors are larger, and intervals do not hold more often; with all images of a stream
errors are not smaller (``experiments/stream_images.py``)."""

STREAM_SCORE = 5.0
"""In a stream the correlation of successive errors is more than so many SDs above zero."""

SHORTEST_STREAM = 40
"""Recordings with fewer images are not examined for slowly changing errors."""

CONTINUOUS_SHARE = 0.25
"""In a stream the probe moves between successive images by less than this share of the distance of
poses half a recording apart."""

NEGLIGIBLE_SHARE = 0.01
"""Kinds of error below this share of the variance (a tenth in size) do not make a stream."""

ABSORBED_ERRORS = 6.0
"""Independent elevational errors that the fit absorbs: the number of unknowns that move them."""
LEAST_SHARE_LEFT = 0.4
"""At least this share of the errors is assumed to be left after the fit."""


@dataclass(frozen=True)
class IndependentImages:
    """Which images of a recording are used, and why others are not.

    Attributes:
        group: (n,) number of each image's pose; -1 where it is not used.
        keep: (n,) True for the one image that stands for its group.
        frames: number of used images.
        poses: number of different poses among them.
        stride: one of so many poses of a stream is kept; 1 where the recording is no stream.
        alike: for how many poses the errors of a stream stay alike; 1 for other recordings.
        frozen: images left out, since their pose is repeated while the target moves.
    """

    group: Int[np.ndarray, " n"]
    keep: Bool[np.ndarray, " n"]
    frames: int
    poses: int
    stride: int = 1
    alike: float = 1.0
    frozen: tuple[int, ...] = ()

    @property
    def images(self) -> int:
        """How many images remain."""
        return int(self.keep.sum())

    @property
    def words(self) -> list[str]:
        """What was done, in a sentence each; empty where all images are used and independent."""
        told = []
        if self.frozen:
            told.append(
                f"left out {len(self.frozen)} images, counted from 0, whose pose is that of "
                f"another one (within {FROZEN_MM:g} mm) while the target moves in them (was "
                f"tracking frozen?): {runs_in_words(self.frozen, 10)}"
            )
        if self.stride > 1:
            alike = self.alike * self.frames / self.poses
            told.append(
                f"{self.frames} frames of a moving probe, whose errors stay alike for about "
                f"{alike:.0f} frames (a lag between images and poses, a slipped mount, or another "
                f"depth setting?): {self.images} of them {'is' if self.images == 1 else 'are'} used"
            )
        elif self.images < self.frames:
            told.append(
                f"{self.frames} frames, {self.poses} different poses: the frames of each pose "
                f"(within {SAME_POSE_MM:g} mm) count as one image"
            )
        return told


def independent(
    problem: Problem, estimate: tuple[str, ...] = (), *, widened: bool = False
) -> tuple[Problem, IndependentImages]:
    """Let every pose count once.

    Args:
        problem: one problem with concrete values.
        estimate: what the calibration will estimate; the fit in this module estimates the pixel
            size or the sound speed where it does, and a pixel size that is not known.
        widened: whether errors that are alike in successive images will widen the covariance
            (:func:`jaxcal.calibration.serial_correlation.widens`).

    Returns:
        The problem, and which images are used. The problem has the same shape: one image of every
        group has the group's mean pose and point, and the others are masked out. Where all images
        are used, it is the same object.

    Raises:
        InputError: fewer than 4 different poses.
    """
    poses, mask = np.asarray(problem.poses, dtype=float), np.asarray(problem.mask) > 0
    group = same_pose(poses, mask)
    frozen = _frozen(poses, np.asarray(problem.measurements, dtype=float), group)
    if frozen.any():
        mask = mask & ~frozen
        group = same_pose(poses, mask)
    found = replace(_representatives(group, mask), frozen=tuple(np.flatnonzero(frozen).tolist()))
    if found.poses < MINIMUM_IMAGES:
        left_out = f" ({found.words[0]})" if found.frozen else ""
        raise InputError(
            f"{found.frames} images{left_out}, but only {found.poses} different "
            f"pose{'s' * (found.poses != 1)}: at least {MINIMUM_IMAGES} are needed (poses closer "
            f"than {SAME_POSE_MM:g} mm count once)"
        )
    if found.frozen:
        problem = _with_arrays(problem, {"mask": mask})
    if found.poses < found.frames:
        problem = _with_group_averages(problem, found)
    if found.images >= SHORTEST_STREAM:
        alike = _alike_for(problem, estimate)
        stride = int(alike)
        if widened:
            stride = max(int(min(alike / KEPT_OF_TIME, found.images / KEPT_OF_STREAM)), 1)
        if stride > 1:
            left = np.flatnonzero(found.keep)
            keep = np.zeros_like(found.keep)
            # Keep the middle of every piece.
            keep[left[stride // 2 :: stride]] = True
            found = replace(found, keep=keep, stride=stride, alike=alike)
            problem = _with_arrays(problem, {"mask": keep})
    return problem, found


def same_pose(
    poses: Float[np.ndarray, "n 4 4"], mask: Bool[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """Number of each image's pose, in order of first appearance; -1 where it is not used.

    Args:
        poses: probe -> tracker, mm.
        mask: which images are used.
    """
    used = np.flatnonzero(mask)
    group = np.full(len(mask), -1)
    label = _linked(poses[used])
    for members in _members(label):
        label[members] = members[_pieces(poses[used[members]])]
    _, order, inverse = np.unique(label, return_index=True, return_inverse=True)
    group[used] = np.argsort(np.argsort(order))[inverse]
    return group


def displacement(
    first: Float[np.ndarray, "*#k 4 4"], second: Float[np.ndarray, "*#k 4 4"]
) -> Float[np.ndarray, "*k"]:
    """A bound on how far points within the lever of the tracked origin move, mm."""
    shift = np.linalg.norm(first[..., :3, 3] - second[..., :3, 3], axis=-1)
    # |R1 - R2| = sqrt(8) sin(angle / 2), and a chord is 2 L sin(angle / 2).
    turn = np.linalg.norm(first[..., :3, :3] - second[..., :3, :3], axis=(-2, -1)) / np.sqrt(2)
    return shift + LEVER_MM * turn


def _linked(poses: Float[np.ndarray, "n 4 4"]) -> Int[np.ndarray, " n"]:
    """For every pose, the least index of those that pairs of the same pose link it to.

    Every pose is compared with the later ones of its own strip and those of the next strip. Strips
    are of one coordinate and sorted by another; in them, poses that are known to be connected are
    passed over, so that a long hold takes no more time and memory than as many different poses.
    (scipy's search tree would list all pairs of a hold: 125 million for 40 holds of 2,500 frames.)
    """
    count, limit = len(poses), 2 * SAME_POSE_MM
    label = np.arange(count)
    if count < 2:
        return label
    first_axis, second_axis = probe_points(poses)[:2]
    strip = np.floor(first_axis / limit)
    order = np.lexsort((second_axis, strip))
    poses, strip, second_axis = poses[order], strip[order], second_axis[order]
    places = probe_points(poses).T
    # One number for strip and place in it; strips are farther apart than poses that may be near.
    wide = np.ptp(second_axis) + 2 * limit
    line = strip * wide + second_axis
    pairs = np.zeros((2, 0), int)
    for further in (0, 1):  # this strip, then the next one
        at = np.arange(count)
        other = np.searchsorted(line, line + wide - limit) if further else at + 1
        end = np.searchsorted(line, line + further * wide + limit)
        passed = _ends_of_runs(label)
        # Every pose goes through its neighbours from ``other`` up to ``end``, all poses at once.
        while True:
            at, other, end = (each[other < end] for each in (at, other, end))
            if not len(at):
                break
            known = label[at] == label[other]
            first, second = at[~known], other[~known]
            near = (np.abs(places[first] - places[second]) < limit).all(axis=1)
            first, second = first[near], second[near]
            near = displacement(poses[first], poses[second]) <= SAME_POSE_MM
            pairs = np.concatenate([pairs, [first[near], second[near]]], axis=1)
            other = np.where(known, passed[other], other + 1)
            if pairs.shape[1] > count // 8:  # enough news to be worth the search for components
                label, pairs = _components(count, *label[pairs])[label], pairs[:, :0]
                passed = _ends_of_runs(label)
        label, pairs = _components(count, *label[pairs])[label], pairs[:, :0]
    least = np.full(count, count)
    np.minimum.at(least, label, order)
    found = np.empty(count, int)
    found[order] = least[label]
    return found


def _ends_of_runs(label: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """For every place, the first one behind it with another label."""
    starts = np.flatnonzero(np.diff(label)) + 1
    ends = np.append(starts, len(label))
    return ends[np.searchsorted(starts, np.arange(len(label)), side="right")]


def _frozen(
    poses: Float[np.ndarray, "n 4 4"],
    points: Float[np.ndarray, "n 2"],
    group: Int[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Frames that repeat one pose, while the target lies in different places in them."""
    used, frozen = np.flatnonzero(group >= 0), np.zeros(len(group), bool)
    if not len(used):
        return frozen
    limit = max(MOVED_SHARE * np.sqrt(points[used].var(axis=0).sum()), LEAST_MOVED)

    def apart(rows: Int[np.ndarray, " m"]) -> bool:
        # One wrong click does no harm where the hold's point is a median.
        away = np.linalg.norm(points[rows] - np.median(points[rows], axis=0), axis=1)
        return bool((np.median(away) if len(rows) >= MEDIAN_FROM else away.max()) > limit)

    for rows in map(used.__getitem__, _members(group[used])):
        while len(rows) and apart(rows):
            near = displacement(poses[rows], poses[rows[:1]]) <= FROZEN_MM
            frozen[rows[near]] = apart(rows[near])
            rows = rows[~near]
    return frozen


def _components(
    count: int, first: Int[np.ndarray, " k"], second: Int[np.ndarray, " k"]
) -> Int[np.ndarray, " n"]:
    """For every pose, the least index in its connected component."""
    label = np.arange(count)
    while True:
        least = np.minimum(label[first], label[second])
        after = label.copy()
        np.minimum.at(after, first, least)
        np.minimum.at(after, second, least)
        after = after[after]
        if np.array_equal(after, label):
            return label
        label = after


def _members(label: Int[np.ndarray, " n"]) -> list[Int[np.ndarray, " m"]]:
    """The members of every component that has several."""
    order = np.argsort(label, kind="stable")
    _, starts, sizes = np.unique(label[order], return_index=True, return_counts=True)
    several = sizes > 1
    ends = starts + sizes
    return [order[a:b] for a, b in zip(starts[several], ends[several], strict=True)]


def _pieces(poses: Float[np.ndarray, "m 4 4"]) -> Int[np.ndarray, " m"]:
    """The piece of every pose: 0 for all of a hold; in a chain, the index of the piece's first."""
    if displacement(poses, poses[:1]).max() <= HOLD_MM:
        return np.zeros(len(poses), int)
    count, limit = len(poses), 2 * SAME_POSE_MM
    first, second = probe_points(poses)[:2]
    order = np.argsort(first)
    starts, ends = np.searchsorted(first[order], [first - limit, first + limit])
    piece, least = np.arange(count), np.full(count, np.inf)
    for index in range(count):
        if least[index] <= SAME_POSE_MM:
            continue
        near = order[starts[index] : ends[index]]
        near = near[(near > index) & (np.abs(second[near] - second[index]) < limit)]
        apart = displacement(poses[near], poses[index])
        closer = (apart <= SAME_POSE_MM) & (apart < least[near])
        piece[near[closer]], least[near[closer]] = index, apart[closer]
    return piece


def probe_points(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "12 n"]:
    """Coordinates of four points of the probe, mm, those that vary most first.

    Between two poses none moves farther than twice their displacement.
    """
    corners = np.concatenate([poses[:, :3, 3:], poses[:, :3, :3] * LEVER_MM + poses[:, :3, 3:]], 2)
    places = corners.reshape(len(poses), 12).T
    return places[np.argsort(-np.ptp(places, axis=1))]


def _representatives(
    group: Int[np.ndarray, " n"], mask: Bool[np.ndarray, " n"]
) -> IndependentImages:
    """The middle frame of every group stands for it."""
    keep = np.zeros(len(group), bool)
    used = np.flatnonzero(mask)
    order = used[np.argsort(group[used], kind="stable")]
    _, starts, sizes = np.unique(group[order], return_index=True, return_counts=True)
    keep[order[starts + sizes // 2]] = True
    return IndependentImages(group, keep, frames=len(used), poses=len(starts))


def _with_group_averages(problem: Problem, found: IndependentImages) -> Problem:
    """The problem with one image for every group, at the index of the image that is kept."""
    names, channels = ("poses", "measurements", "covariance", "max_elevation"), problem.channels
    given = {name: getattr(problem, name) for name in names}
    before = {name: np.asarray(each) for name, each in given.items() if each is not None}
    if channels is not None:
        before["distances"] = np.asarray(channels.distances)
        before["heard"] = np.asarray(channels.heard)
    after = {name: each.copy() for name, each in before.items()}
    used = np.flatnonzero(found.group >= 0)
    for rows in map(used.__getitem__, _members(found.group[used])):
        kept = rows[found.keep[rows]][0]
        for name, values in before.items():
            after[name][kept] = values[rows].mean(axis=0)
        pose = after["poses"][kept]
        # The mean of rotation matrices is no rotation.
        pose[:3, :3] = nearest_rotations(pose[None, :3, :3])[0][0]
        if len(rows) >= MEDIAN_FROM:
            after["measurements"][kept] = np.median(before["measurements"][rows], axis=0)
        if channels is not None:
            weight = before["heard"][rows]
            total = weight.sum(axis=0)
            sums = (weight * np.where(weight > 0, before["distances"][rows], 0.0)).sum(axis=0)
            after["distances"][kept] = sums / np.where(total > 0, total, 1.0)
            after["heard"][kept] = total >= 0.5 * len(rows)
    if channels is not None:
        heard = {name: after.pop(name) for name in ("distances", "heard")}
        problem = replace(problem, channels=_with_arrays(channels, heard))
    return _with_arrays(problem, {"mask": found.keep, **after})


def _with_arrays(data: Any, values: dict[str, np.ndarray]) -> Any:
    """The data with other arrays; each is a numpy or JAX array like the one that it replaces."""
    changed = {name: like(getattr(data, name), value) for name, value in values.items()}
    return replace(data, **changed)


def _alike_for(problem: Problem, estimate: tuple[str, ...]) -> float:
    """For how many images of a stream the errors stay alike; 1 for other recordings."""
    poses = np.asarray(problem.poses, float)[np.asarray(problem.mask) > 0]
    if not step_share(poses) < CONTINUOUS_SHARE:
        # Errors that are alike for long are then no stream's: a mount has slipped, say.
        return 1.0
    errors = _conventional_errors(problem, estimate)
    if errors is None:
        return 1.0
    time = alike_for(errors)
    if time < LEAST_STREAM_TIME or wrong_frames(problem, estimate):
        # Errors of wrong poses are alike for as long as the motion lasts, but no image has them:
        # of the few that were kept, a fit would show nothing.
        return 1.0
    return time


def step_share(poses: Float[np.ndarray, "n 4 4"]) -> float:
    """The median step from image to image over the median distance half a recording apart.

    Args:
        poses: of successive images, probe -> tracker, mm.
    """
    steps = displacement(poses[1:], poses[:-1])
    apart = displacement(poses, np.roll(poses, len(poses) // 2, axis=0))
    return float(np.median(steps) / max(np.median(apart), 1e-300))


def alike_for(errors: Float[np.ndarray, "n k"]) -> float:
    """The longest correlation time of the kinds of errors; 1 if chance explains the correlation.

    Args:
        errors: in the order in which they were made, mm.
    """
    time, cut = 1.0, clipped(errors)
    for values in cut.T:
        # Errors much smaller than the others do not count, however slowly they change.
        if np.var(values) < NEGLIGIBLE_SHARE * np.sum(np.var(cut, axis=0)):
            continue
        correlation = autocorrelation(values)
        if correlation[1] * np.sqrt(len(values)) > STREAM_SCORE:
            time = max(time, correlation_time(correlation))
    return time


def clipped(errors: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """Errors less their mean, after clipping at three robust SDs from the median."""
    middle = np.median(errors, axis=0)
    limit = 3 * MAD * np.median(np.abs(errors - middle), axis=0)
    cut = np.clip(errors, middle - limit, middle + limit)
    return cut - cut.mean(axis=0)


def autocorrelation(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Autocorrelation at lags 0, 1, ..., by the fast Fourier transform; zeros if nothing varies."""
    count = len(values)
    power = np.abs(np.fft.rfft(values, 2 * count)) ** 2
    found = np.fft.irfft(power)[:count]
    return found / found[0] if found[0] > 0 else np.zeros(count)


def correlation_time(correlation: Float[np.ndarray, " n"]) -> float:
    """The integrated autocorrelation time, in images, of an exponential correlation.

    It is twice the lag at which the correlation is 1 / e. That lag is computed from the lag where
    the correlation has fallen to half, since sums over all lags scatter more. The fall to half is
    counted from lag 1, not from lag 0, so that independent noise has no effect. The result is then
    enlarged, since the fit absorbs the slowest changes: ``ABSORBED_ERRORS`` of the independent
    errors.
    """
    below = np.flatnonzero(correlation[1:] < 0.5 * correlation[1])
    if not len(below):
        return float(len(correlation))
    high, low = correlation[below[0]], correlation[below[0] + 1]
    half = below[0] - 1 + (high - 0.5 * correlation[1]) / (high - low)
    time = max(2 * half / np.log(2), 1.0)
    return float(time / max(1 - ABSORBED_ERRORS * time / len(correlation), LEAST_SHARE_LEFT))


def _conventional_errors(
    problem: Problem, estimate: tuple[str, ...]
) -> Float[np.ndarray, "m 3"] | None:
    """Errors of the used images under the conventional fit in closed form, in their order, mm.

    They are along the image's lateral, elevational and axial axes. None where there is no such fit.
    """
    free = tuple(name for name in ("scale", "sound-speed") if name in estimate)
    try:
        found = solve_problem(problem, free if problem.spacing_known else ("scale",))
    except InputError:
        return None
    seen = ImageErrors.of_closed_form(found, problem, RIGID)
    in_plane, _ = seen.from_circle(np.zeros_like(seen.mask))
    return in_plane[seen.mask > 0]
