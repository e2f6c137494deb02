"""Frames from one file, poses from another, matched by their time stamps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import check_poses
from jaxcal.data.timing import (
    can_interpolate,
    fitted_lag,
    interpolate_poses,
    interpolation_error,
    latency_of_positions,
)
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.text import PoseTable
from jaxcal.runtime.array_types import Float, Int
from jaxcal.runtime.messages import seconds

LONGEST_GAP = 5.0
"""Longest time between two poses that is bridged, in median intervals."""
_SHORT = 0.02
"""Images of less than this part of the tracking make one ask for the unit of its times."""
_SHARED = 0.2
"""Largest share of poses with the time stamp of another: it is that of stamps which are rounded to
1.25 intervals between poses."""
_TOLD_MM = 0.5
"""Larger errors of interpolation are told; the noise of a tracker looks like smaller ones."""
_LAG_EVIDENCE = 25.0
"""A lag is told if its evidence is larger: a normal variable's square at 5 SD."""
_ROUNDED_S = 1e-6
"""Times that were written as text and read again may be off by so much."""


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


def with_poses_by_time(
    images: TrackedSequence, tracking: TrackedSequence, lag_s: float = 0.0
) -> tuple[TrackedSequence, list[str]]:
    """Frames of one sequence with poses of another, interpolated at their times on one clock.

    An image stamped t shows what was at t - ``lag_s``. The sequence's own transforms are dropped,
    and those of ``tracking`` are only the poses.

    Returns:
        The sequence, valid where a pose could be interpolated; and notes for the user.

    Raises:
        InputError: images or poses without times, times that go back, no image between poses, or
            times of poses that are taken for seconds, though hardly any could be of the images.
    """
    source = tracking.source
    ((pair, poses),) = tracking.transforms.items()
    if untimed := int((~np.isfinite(images.time)).sum()):
        raise InputError(
            f"{images.source}: {untimed} of {len(images)} images have no time stamp, so their "
            f"poses cannot be looked up in {source}"
        )
    kept = _increasing(tracking)
    time, poses, valid = tracking.time[kept], poses[kept], tracking.valid[pair][kept]
    interval = float(np.median(np.diff(time)))
    if not tracking.time_stated:
        _check_unit(images, time, interval, source)
    gap = LONGEST_GAP * interval
    asked = _within(images.time - lag_s, time[valid])
    between = can_interpolate(time, asked, max_gap_s=gap, valid=valid)
    if not between.any():
        raise InputError(
            f"{images.source}: no image lies between poses of {source}: images are from "
            f"{seconds(asked.min())} to {seconds(asked.max())}, poses from {seconds(time[0])} to "
            f"{seconds(time[-1])}: do they use the same clock?"
        )
    found = np.full((len(images), 4, 4), np.nan)
    found[between] = interpolate_poses(time, poses, asked[between], max_gap_s=gap, valid=valid)
    notes = [f"poses of {source} at the images' times" + (f" less {lag_s:g} s" if lag_s else "")]
    cost = interpolation_error(time[valid], poses[valid], asked[between], max_gap_s=gap)
    if cost > _TOLD_MM:
        notes.append(
            f"poses are {interval:.3g} s apart, and the probe moves between them: interpolated "
            f"poses are wrong by about {cost:.1f} mm (RMS, from leaving poses out); record poses "
            "more often, or hold the probe still for each image"
        )
    lost = int((~between).sum())
    if lost:
        notes.append(
            f"{lost} of {len(images)} images have no pose near their time (gaps of up to "
            f"{gap:.3g} s are bridged)"
        )
    return replace(
        images,
        transforms={pair: found},
        valid={pair: between},
        length_stated=tracking.length_stated,
        without_status=(),
    ), notes


def better_lag(
    time: Float[np.ndarray, " n"],
    points: Float[np.ndarray, "n 2"],
    tracking: TrackedSequence,
    lag_s: float | None = 0.0,
) -> list[str]:
    """A note if another lag fits the points far better than the one that was used.

    Args:
        time: of the images, s, on the clock of ``tracking``.
        points: the target in them, px or mm.
        tracking: the poses alone, which :func:`with_poses_by_time` has taken.
        lag_s: the lag that was used; None if times have to be changed to state one.
    """
    ((pair, poses),) = tracking.transforms.items()
    kept = _increasing(tracking)
    times, valid, given = tracking.time[kept], tracking.valid[pair][kept], lag_s or 0.0
    gap = LONGEST_GAP * float(np.median(np.diff(times)))
    poses = poses[kept]
    found = fitted_lag(time - given, points, times, poses, max_gap_s=gap, valid=valid)
    if found is None or found.evidence <= _LAG_EVIDENCE:
        return []
    told = given + found.lag_s
    sure, state = f" (SD {found.sd_s:.2g} s)", f"state it (--lag {told:.3f})"
    if not np.isfinite(found.sd_s):
        sure, state = ", where the search ends,", "do images and poses use the same clock?"
    elif lag_s is None:
        change = ("subtract", "from") if told > 0 else ("add", "to")
        state = f"{change[0]} {abs(told):.3f} s {change[1]} the images' times"
    return [
        f"the points fit the poses better at a lag of {told:.3f} s{sure} than at {given:g} s: the "
        f"target comes out within {found.misfit_mm:.2g} mm of one place (RMS), not "
        f"{found.given_mm:.2g} mm; {state}, or hold the probe still for each image"
    ]


def _check_unit(
    images: TrackedSequence, time: Float[np.ndarray, " m"], interval: float, source: str
) -> None:
    """Refuse a tracking that is far longer than the images and slower: its times may be in ms."""
    covered, whole = float(np.ptp(images.time)), float(time[-1] - time[0])
    if len(images) < 2 or covered >= _SHORT * whole:
        return
    of_images = float(np.median(np.diff(np.sort(images.time))))
    if interval > of_images:
        raise InputError(
            f"{source}: its poses last {whole:.4g} s, one every {interval:.3g} s, the images "
            f"{covered:.3g} s, one every {of_images:.3g} s: is its time in ms, us or ns? State the "
            "unit in the header: time [ms], [us], [ns], or [s]"
        )


def _within(asked: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"]) -> np.ndarray:
    """Times, those that only rounding puts before the first or after the last pose at that pose."""
    if not len(time):
        return asked
    nearest = np.clip(asked, time[0], time[-1])
    return np.where(np.abs(asked - nearest) <= _ROUNDED_S, nearest, asked)


def _increasing(tracking: TrackedSequence) -> Int[np.ndarray, " k"]:
    """The poses whose times are stated and later than the one before."""
    source, time = tracking.source, tracking.time
    known = np.flatnonzero(np.isfinite(time))
    if len(known) < 2:
        raise InputError(f"{source}: states no times: its poses cannot be matched to the images")
    steps = np.diff(time[known])
    back = np.flatnonzero(steps < 0)
    if len(back):
        raise InputError(
            f"{source}: the time stamp of pose {back[0] + 1} is before the one before it: two "
            "recordings in one?"
        )
    # A tracker that was asked faster than it measures gives the same pose twice.
    kept = known[np.concatenate([[True], steps > 0])]
    if len(kept) < 2:
        raise InputError(f"{source}: all its poses have one time stamp")
    ((pair, poses),) = tracking.transforms.items()
    good = known[tracking.valid[pair][known]]
    moved = (poses[good[1:]] != poses[good[:-1]]).any(axis=(1, 2))
    shared = int((moved & (time[good[1:]] == time[good[:-1]])).sum())
    if shared > _SHARED * len(good):
        raise InputError(
            f"{source}: {shared} of {len(good)} poses have the time stamp of the pose before, but "
            "differ from it: were times written with too few digits, or poses stamped in groups?"
        )
    return kept


def lag_of_points(
    images: TrackedSequence,
    rows: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 2"],
    tracking: TrackedSequence,
) -> tuple[float, str]:
    """By how much images lag behind poses, from the motion of a target at rest in the images.

    It was found at ``points`` (px or mm) in the frames ``rows``.

    Returns:
        The lag, s, and a note for the user.

    Raises:
        InputError: times missing, too little motion, or motions that do not agree; see
            :func:`jaxcal.data.timing.latency_of_positions`.
    """
    ((pair, poses),) = tracking.transforms.items()
    kept = _increasing(tracking)
    kept = kept[tracking.valid[pair][kept]]
    order = np.argsort(rows)
    try:
        if not len(kept) or not len(rows):
            raise InputError("there are no poses, or no points")
        positions = check_poses(poses[kept])[:, :3, 3]
        found = latency_of_positions(
            images.time[rows[order]], points[order], tracking.time[kept], positions
        )
    except InputError as error:
        raise InputError(f"--lag auto: {error} (or state the lag: --lag SECONDS)") from None
    return found.lag_s, (
        f"images lag by {found.lag_s:.4f} s behind poses (SD {found.sd_s:.2g} s), estimated from "
        f"{len(rows)} points: their motion has a correlation of {abs(found.correlation):.2f} with "
        "the probe's"
    )
