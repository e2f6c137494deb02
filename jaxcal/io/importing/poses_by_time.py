"""Frames from one file, poses from another, matched by their time stamps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from jaxcal import InputError
from jaxcal.data.timing import (
    LAG_EVIDENCE,
    LARGEST_LAG_S,
    LARGEST_LAG_SD_S,
    FittedLag,
    can_interpolate,
    fitted_lag,
    interpolate_poses,
    interpolation_error,
    pose_velocities,
)
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.text import PoseTable
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.messages import counted, seconds

LONGEST_GAP = 5.0
"""Longest time between two poses that is bridged, in median intervals."""
_SHORT = 0.02
"""Images of less than this part of the tracking make one ask for the unit of its times, as does
tracking of less than this part of the images."""
_SHARED = 0.2
"""Largest share of poses with the time stamp of another; stamps that are rounded to 1.25 intervals
between poses give this share."""
_FEWEST_ROUNDED = 5
"""So many times that are all whole seconds are not so by chance."""
_TOLD_MM = 0.5
"""Larger errors of interpolation are reported; a tracker's noise looks like smaller ones."""
_LONGEST_GAP_OF_VELOCITY_S = 0.25
"""Longest time between two poses from which a velocity is taken."""
_ROUNDED_S = 1e-6
"""Times that were written as text and read again may be off by so much."""


@dataclass(frozen=True)
class PoseTrack:
    """Poses of which the times are known and increase.

    Attributes:
        time: s.
        poses: probe -> tracker, mm.
        valid: False where a pose cannot be used.
        source: the file.
    """

    time: Float[np.ndarray, " m"]
    poses: Float[np.ndarray, "m 4 4"]
    valid: Bool[np.ndarray, " m"]
    source: str

    @cached_property
    def interval_s(self) -> float:
        """Median time between two poses."""
        return float(np.median(np.diff(self.time)))

    @property
    def gap_s(self) -> float:
        """Longest time between two poses that is bridged."""
        return LONGEST_GAP * self.interval_s

    @classmethod
    def of(cls, tracking: TrackedSequence) -> PoseTrack:
        """The poses of a sequence that holds those of one tool only.

        Raises:
            InputError: no times, times that go back, or the same time for many different poses.
        """
        ((pair, poses),) = tracking.transforms.items()
        source, time, usable = tracking.source, tracking.time, tracking.valid[pair]
        known = np.flatnonzero(np.isfinite(time))
        if len(known) < 2:
            raise InputError(
                f"{source}: states no times: its poses cannot be matched to the images"
            )
        steps = np.diff(time[known])
        back = np.flatnonzero(steps < 0)
        if len(back):
            raise InputError(
                f"{source}: the time stamp of pose {back[0] + 1} is before the one before it: two "
                "recordings in one?"
            )
        # A tracker that was asked faster than it measures gives the same pose twice. Of one time
        # the first pose that can be used counts.
        group = np.cumsum(np.concatenate([[0], steps > 0]))
        order = np.lexsort((~usable[known], group))
        kept = known[order[np.diff(group[order], prepend=-1) > 0]]
        if len(kept) < 2:
            raise InputError(f"{source}: all its poses have one time stamp")
        good = known[usable[known]]
        moved = (poses[good[1:]] != poses[good[:-1]]).any(axis=(1, 2))
        shared = int((moved & (time[good[1:]] == time[good[:-1]])).sum())
        if shared > _SHARED * len(good):
            raise InputError(
                f"{source}: {shared} of {len(good)} poses have the time stamp of the pose before, "
                "but differ from it: were times written with too few digits, or poses stamped in "
                "groups?"
            )
        return cls(time[kept], poses[kept], usable[kept], source)

    def velocities(self, time: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 6"] | None:
        """How the probe moved at these times (:func:`pose_velocities`); None if it is not known."""
        found = pose_velocities(
            self.time,
            self.poses,
            time,
            max_gap_s=min(self.gap_s, _LONGEST_GAP_OF_VELOCITY_S),
            valid=self.valid,
        )
        return found if np.isfinite(found).any() else None

    def lag_of(
        self, time: Float[np.ndarray, " n"], points: Float[np.ndarray, "n 2"]
    ) -> FittedLag | None:
        """The lag at which the points of images stamped so fit best (:func:`fitted_lag`)."""
        return fitted_lag(
            time, points, self.time, self.poses, max_gap_s=self.gap_s, valid=self.valid
        )


def times_of_table(table: PoseTable, sequence: TrackedSequence) -> Float[np.ndarray, " m"]:
    """Times of a table on the clock of a sequence, s.

    Raises:
        InputError: dates beside seconds, or with a time zone beside without: two clocks.
    """
    assert table.time is not None
    if table.clock is None and sequence.clock is None:
        return table.time
    if table.clock is None or sequence.clock is None:
        dated = ("seconds", "dates") if table.clock is None else ("dates", "seconds")
        raise InputError(
            f"{table.name}: its times are {dated[0]}, those of {sequence.source} {dated[1]}: "
            "give them on the same clock"
        )
    if (table.clock.tzinfo is None) != (sequence.clock.tzinfo is None):
        raise InputError(
            f"{table.name}: give its dates a time zone if those of {sequence.source} have one, and "
            "none if they have none"
        )
    return table.time + (table.clock - sequence.clock).total_seconds()


def _without_pose(
    asked: Float[np.ndarray, " n"], between: Bool[np.ndarray, " n"], track: PoseTrack
) -> str:
    """How many images have no pose, and for what reasons."""
    lost = asked[~between]
    outside = int(((lost < track.time[0]) | (lost > track.time[-1])).sum())
    # With every pose as if it could be used, those beside one that cannot be are not lost.
    beside = int(can_interpolate(track.time, lost, max_gap_s=track.gap_s).sum())
    reasons = {
        "outside the time of the poses": outside,
        "beside a pose whose tracking was not OK": beside,
        f"between poses more than {track.gap_s:.3g} s apart": len(lost) - outside - beside,
    }
    said = ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
    return f"{len(lost)} of {len(asked)} images have no pose at their time: {said}"


def with_poses_by_time(
    images: TrackedSequence, tracking: TrackedSequence, lag_s: float = 0.0
) -> tuple[TrackedSequence, list[str]]:
    """Frames of one sequence with poses of another, interpolated at their times on one clock.

    An image stamped t shows what was at t - ``lag_s``. The sequence's own transforms are dropped,
    and those of ``tracking`` are only the poses.

    Returns:
        The sequence, valid where a pose could be interpolated; and notes for the user.

    Raises:
        InputError: images or poses without times, times that go back, no pose with the status OK,
            no image between poses, or times of poses that are taken for seconds, though hardly any
            could be of the images.
    """
    track = PoseTrack.of(tracking)
    if not track.valid.any():
        raise InputError(f"{track.source}: none of its {len(track.time)} poses has the status OK")
    if untimed := int((~np.isfinite(images.time)).sum()):
        raise InputError(
            f"{images.source}: {untimed} of {len(images)} images have no time stamp, so their "
            f"poses cannot be looked up in {track.source}"
        )
    if not tracking.time_stated:
        _check_unit(images, track)
    time, poses, valid, gap = track.time, track.poses, track.valid, track.gap_s
    asked = _within(images.time - lag_s, time[valid])
    between = can_interpolate(time, asked, max_gap_s=gap, valid=valid)
    too_long = len(images) > 1 and np.ptp(asked) * _SHORT > time[-1] - time[0]
    if too_long or not between.any():
        raise InputError(
            f"{images.source}: {between.sum() or 'none'} of {counted(len(images), 'image')} "
            f"between poses of {track.source}: images are from {seconds(asked.min())} to "
            f"{seconds(asked.max())}, poses from {seconds(time[0])} to {seconds(time[-1])}: do "
            "they use the same clock, and seconds (milliseconds are read from a column "
            "'time (ms)')?"
        )
    found = np.full((len(images), 4, 4), np.nan)
    found[between] = interpolate_poses(time, poses, asked[between], max_gap_s=gap, valid=valid)
    less = f" less {lag_s:g} s" if lag_s else ""
    notes = [f"poses of {track.source} at the images' times{less}"]
    cost = interpolation_error(time[valid], poses[valid], asked[between], max_gap_s=gap)
    if cost > _TOLD_MM:
        notes.append(
            f"poses are {track.interval_s:.3g} s apart, and the probe moves between them: "
            f"interpolated poses are wrong by about {cost:.1f} mm (RMS, from leaving poses out); "
            "record poses more often, or hold the probe still for each image"
        )
    notes += _whole_seconds(images, track)
    if not between.all():
        notes.append(_without_pose(asked, between, track))
    return replace(
        images,
        transforms=dict.fromkeys(tracking.transforms, found),
        valid=dict.fromkeys(tracking.transforms, between),
        length_stated=tracking.length_stated,
        without_status=(),
    ), notes


def _whole_seconds(images: TrackedSequence, track: PoseTrack) -> list[str]:
    """A note if images of a moving probe are stamped with whole seconds, as files' dates are."""
    if len(images) < _FEWEST_ROUNDED or (images.time % 1).any() or not (track.time % 1).any():
        return []
    velocity = track.velocities(images.time)
    if velocity is None:
        return []
    # Of a time that was rounded by an equally probable part of a second.
    error = np.sqrt(np.nanmean(np.sum(velocity[:, :3] ** 2, axis=1)) / 12)
    if error <= _TOLD_MM:
        return []
    return [
        f"times of {images.source} are whole seconds, and the probe moves: if they were rounded, "
        f"poses are wrong by about {error:.1f} mm (RMS), which no lag corrects; record fractions "
        "of a second, or hold the probe still for each image"
    ]


def better_lag(
    time: Float[np.ndarray, " n"], points: Float[np.ndarray, "n 2"], track: PoseTrack, lag_s: float
) -> list[str]:
    """A note if another lag fits the points far better than ``lag_s``, which was used.

    Args:
        time: of the images, s, on the clock of the poses.
        points: the target in them, px or mm.
        track: all poses.
        lag_s: by which images lag behind poses.
    """
    found = track.lag_of(time - lag_s, points)
    if found is None or found.evidence <= LAG_EVIDENCE:
        return []
    told = lag_s + found.lag_s
    sure = f" (SD {found.sd_s:.2g} s)"
    advice = f"state it (--lag {told:.3f}), or hold the probe still for each image"
    if not np.isfinite(found.sd_s):
        sure, advice = ", where the search ends,", "do images and poses use the same clock?"
    return [
        f"the points fit the poses better at a lag of {told:.3f} s{sure} than at {lag_s:g} s: the "
        f"target comes out within {found.misfit_mm:.2g} mm of one place (RMS), not "
        f"{found.given_mm:.2g} mm; {advice}"
    ]


def lag_of_points(
    time: Float[np.ndarray, " n"], points: Float[np.ndarray, "n 2"], track: PoseTrack
) -> tuple[float, str]:
    """By how much images lag behind poses, from a target at rest in images of a moving probe.

    The arguments are those of :func:`better_lag`.

    Returns:
        The lag, s, and a note for the user.

    Raises:
        InputError: too few images, too little motion, a lag where the search ends, or several that
            fit equally well.
    """
    found = track.lag_of(time, points)
    if found is None:
        raise InputError(
            "--lag auto: too few images show the target with poses from "
            f"{LARGEST_LAG_S:g} s before to {LARGEST_LAG_S:g} s after them (or state the lag: "
            "--lag SECONDS)"
        )
    if found.rival_s is not None:
        why = (
            f"lags of {found.lag_s:.3f} and {found.rival_s:.3f} s fit equally well: move the "
            "probe less regularly"
        )
    elif not np.isfinite(found.sd_s) and found.contrast > LAG_EVIDENCE:
        why = (
            f"the lag is {found.lag_s:.3g} s or beyond, where the search ends: subtract about "
            "that from the images' times, and estimate the rest"
        )
    elif not np.isfinite(found.sd_s):
        why = (
            f"the images do not tell the lag: it is beyond the {LARGEST_LAG_S:g} s that are "
            "searched (do images and poses use the same clock?), or the probe hardly moved"
        )
    elif found.sd_s > LARGEST_LAG_SD_S:
        why = (
            f"the images do not tell the lag (SD {found.sd_s:.2g} s, at most {LARGEST_LAG_SD_S:g} "
            "s is needed): move the probe farther or faster, or take more images"
        )
    else:
        return found.lag_s, (
            f"images lag by {found.lag_s:.4f} s behind poses (SD {found.sd_s:.2g} s), estimated "
            f"from {len(points)} points: the target comes out within {found.misfit_mm:.2g} mm of "
            "one place (RMS)"
        )
    raise InputError(f"--lag auto: {why} (or state the lag: --lag SECONDS)")


def _check_unit(images: TrackedSequence, track: PoseTrack) -> None:
    """Refuse a tracking that is far longer than the images and slower: its times may be in ms."""
    covered, whole = float(np.ptp(images.time)), float(track.time[-1] - track.time[0])
    if len(images) < 2 or covered >= _SHORT * whole:
        return
    of_images = float(np.median(np.diff(np.sort(images.time))))
    if track.interval_s > of_images:
        raise InputError(
            f"{track.source}: its poses last {whole:.4g} s, one every {track.interval_s:.3g} s, "
            f"the images {covered:.3g} s, one every {of_images:.3g} s: is its time in ms, us or "
            "ns? State the unit in the header: time [ms], [us], [ns], or [s]"
        )


def _within(asked: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"]) -> np.ndarray:
    """Times, those that only rounding puts before the first or after the last pose at that pose."""
    nearest = np.clip(asked, time[0], time[-1])
    return np.where(np.abs(asked - nearest) <= _ROUNDED_S, nearest, asked)
