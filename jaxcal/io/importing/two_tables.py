"""A table of poses and a table of points as one: which rows of the two are of the same image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import numpy as np

from jaxcal import InputError
from jaxcal.io.importing.frame_poses import tracking_of_table
from jaxcal.io.importing.poses_by_time import (
    PoseTrack,
    better_lag,
    lag_of_points,
    with_poses_by_time,
)
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.text import PoseTable
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.messages import counted

_SLOW_S = 1.0
"""Poses at least so far apart make one ask for the unit of times: trackers are faster, and one of
1 kHz has this interval if its ms are taken for s."""
_FAST_S = 1e-4
"""So do poses that are nearer to one another: days, as MATLAB counts, taken for s."""


def one_of_two_tables(
    first: PoseTable, second: PoseTable, *, lag_s: float | Literal["auto"] = 0.0
) -> tuple[PoseTable, list[str], int]:
    """The points of one table with the poses of the other, in the order of the points.

    Rows belong together by a column ``file`` or ``frame`` that both tables have; else by time, and
    poses are interpolated; else in their order, if there are as many poses as points and the table
    of points names neither file nor frame nor time.

    Args:
        first: one of the two tables.
        second: the other one.
        lag_s: of rows that are matched by time: a point stamped t was seen at t - lag; ``auto``:
            estimated from the points.

    Returns:
        The table, notes for the user, and how many points were left out because they have no pose.

    Raises:
        InputError: not poses in one table and points in the other, rows that cannot be matched,
            two poses of one image, or a lag of rows that are not matched by time.
    """
    poses, points = (first, second) if first.poses is not None else (second, first)
    missing = poses.poses is None or points.points is None
    if missing or poses.points is not None or points.poses is not None:
        raise InputError(
            f"{first.name} and {second.name}: one table must hold the poses, the other one the "
            "points (u and v, or lateral and range); a table with both is imported by itself"
        )
    found, has_pose, velocity, said = _poses_of(poses, points, lag_s)
    lost = int((~has_pose).sum())
    if lost == len(points):
        raise InputError(f"{points.name}: {poses.name} has the pose of none of its points")
    kept = np.flatnonzero(has_pose)
    table = replace(
        points.of(kept),
        name=f"{poses.name} with {points.name}",
        poses=found[kept],
        velocity=None if velocity is None else velocity[kept],
        length_stated=poses.length_stated,
    )
    return table, poses.notes + points.notes + said, lost


def _poses_of(
    poses: PoseTable, points: PoseTable, lag_s: float | Literal["auto"]
) -> tuple[
    Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"], Float[np.ndarray, "n 6"] | None, list[str]
]:
    """A pose for each point, whether it has one, the probe's velocities if known, and notes."""
    assert poses.poses is not None
    assert points.points is not None
    of_file = poses.file_names, points.file_names
    for named, wanted in (of_file, (poses.frame, points.frame)):
        if named is not None and wanted is not None:
            places = _rows_by_image(poses, named)
            rows = np.array([places.get(image, -1) for image in _rows_by_image(points, wanted)])
            notes = _contradicting_times(poses, points, rows)
            left = _left_out(poses, rows)
            if left and wanted is points.frame:
                left[0] += _counted_otherwise(poses, points)
            notes += left
            _refuse_lag(lag_s)
            return poses.poses[rows], rows >= 0, None, notes
    if poses.time is not None and points.time is not None:
        everywhere = np.ones(len(points), bool)
        images = TrackedSequence(
            {}, {}, points.time, everywhere, source=points.name, clock=points.clock
        )
        tracking = tracking_of_table(poses, images)
        track = PoseTrack.of(tracking)
        doubt = _unit_in_doubt(poses, points, track)
        if lag_s == "auto" and doubt:
            raise InputError(f"--lag auto: {doubt[0]}")
        if lag_s == "auto":
            lag_s, told = lag_of_points(points.time, points.points, track)
            notes = [told]
        else:
            notes = better_lag(points.time, points.points, track, lag_s)
        images, said = with_poses_by_time(images, tracking, lag_s)
        (found,), (valid,) = images.transforms.values(), images.valid.values()
        return found, valid, track.velocities(points.time - lag_s), said + notes + doubt
    _refuse_lag(lag_s)
    unnamed = points.file is None and points.frame is None and points.time is None
    if unnamed and len(poses) + len(poses.skipped) == len(points) + len(points.skipped):
        # Rows that were left out of one table as invalid have partners in the other.
        places = {row: place for place, row in enumerate(poses.rows)}
        rows = np.array([places.get(row, -1) for row in points.rows])
        return poses.poses[rows], rows >= 0, None, _left_out(poses, rows)
    if unnamed and len(poses) == len(points) and not points.skipped:
        return poses.poses, np.ones(len(points), bool), None, []
    raise InputError(
        f"{points.name}: which pose of {poses.name} belongs to which point? Give both tables a "
        "column frame, file or time (without one, as many poses as points, in the same order)"
    )


def _left_out(poses: PoseTable, rows: Int[np.ndarray, " n"]) -> list[str]:
    """A note if points have no pose; ``rows`` are the poses of the points, -1 for none."""
    lost = int((rows < 0).sum())
    left = f"{counted(lost, 'point')} left out: {poses.name} has no pose of that image"
    return [left] if lost else []


def _contradicting_times(
    poses: PoseTable, points: PoseTable, rows: Int[np.ndarray, " n"]
) -> list[str]:
    """A note if what was matched by number or name was not taken at the same times.

    Two clocks may be apart, but by the same time throughout. ``rows`` as of :func:`_left_out`.
    """
    if poses.time is None or points.time is None or (rows >= 0).sum() < 2:
        return []
    asked = points.time[rows >= 0]
    apart = asked - poses.time[rows[rows >= 0]]
    apart = np.abs(apart - np.median(apart))
    if np.median(apart) <= np.median(np.diff(np.sort(asked))):
        return []
    return [
        f"times of {points.name} and of the poses that it names differ by up to {apart.max():.3g} "
        "s more than usual: do both count the same images, and time in the same unit? (without a "
        "column frame or file they are matched by time)"
    ]


def _counted_otherwise(poses: PoseTable, points: PoseTable) -> str:
    """A hint if one table seems to number the images from 0 and the other one from 1."""
    assert poses.frame is not None
    assert points.frame is not None
    first, other = int(points.frame.min()), int(poses.frame.min())
    found, if_alike = (np.isin(points.frame - by, poses.frame).sum() for by in (0, first - other))
    if {first, other} != {0, 1} or if_alike <= found:
        return ""
    return (
        f" (numbers begin with {first} in {points.name}, with {other} in {poses.name}: are images "
        "counted from 0 in one and from 1 in the other? Then all points have a wrong pose)"
    )


def _unit_in_doubt(poses: PoseTable, points: PoseTable, track: PoseTrack) -> list[str]:
    """A note if times of both tables are hardly in s, so that a lag, which is, is another one."""
    stated = poses.time_stated or points.time_stated
    if stated or _FAST_S < track.interval_s < _SLOW_S:
        return []
    advice = (
        "are they in ms, us or ns? Name the columns time [ms], [us], [ns] or [s]"
        if track.interval_s >= _SLOW_S
        else "are they in days or hours? Give them in s"
    )
    return [
        f"poses of {poses.name} are {track.interval_s:.3g} s apart if times are in s (no header "
        f"states their unit): {advice}"
    ]


def _refuse_lag(lag_s: float | Literal["auto"]) -> None:
    if lag_s:
        raise InputError("--lag is for poses that are matched by time, with times in both tables")


def _rows_by_image(table: PoseTable, images: Iterable[object]) -> dict[object, int]:
    """The row of each image."""
    rows: dict[object, int] = {}
    for row, image in enumerate(images):
        if image in rows:
            raise InputError(f"{table.name}:{table.lines[row]}: image {image} is there twice")
        rows[image] = row
    return rows
