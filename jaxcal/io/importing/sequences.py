"""Sequences with poses: every frame's pose and point, and the recording of them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxcal import InputError
from jaxcal.data.recording import Images, Recording, make_images
from jaxcal.io.frame_names import FramePair
from jaxcal.io.importing.frame_points import FramePoints, points_of_markups, points_of_table
from jaxcal.io.importing.frame_poses import opened, tracked_poses
from jaxcal.io.importing.imported import Imported, good_time, naming_pose_units, pixel_size
from jaxcal.io.importing.noticed import (
    fixed_mark,
    mirrored,
    other_pixel_size,
    size_in_header,
    tail_of_echoes,
)
from jaxcal.io.importing.poses_by_time import (
    PoseTrack,
    better_lag,
    lag_of_points,
    with_poses_by_time,
)
from jaxcal.io.importing.sources import ImportOptions, kind_of, read_rows, refuse, selected
from jaxcal.io.importing.target_search import FrameResults, search_target
from jaxcal.io.sequence import TrackedSequence
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.messages import counted


def from_sequence(
    sources: Sequence[str | os.PathLike[str]],
    tracked: list[str | os.PathLike[str]],
    options: ImportOptions,
) -> Imported:
    """The recording of a sequence (the only one in ``tracked``), and perhaps a file of points."""
    if len(tracked) > 1 or len(sources) > 2:
        raise InputError(
            f"{', '.join(str(source) for source in sources)}: one sequence, and at most one file "
            "of points, make a recording (poses in another file: --poses)"
        )
    points = next((source for source in sources if source not in tracked), None)
    _refuse_unused(points, options)
    sequence, tracking, notes = opened(tracked[0], options)
    used, told = selected(sequence.all_numbers, options, sequence.source)
    notes += told
    placed = None if points is None else _points(points, sequence, options).of(used)
    posed = _posed(sequence, tracking, placed, used, options)
    sequence, spacing = posed.sequence, pixel_size(posed.sequence, options)
    notes += posed.notes
    with naming_pose_units(options, sequence.length_stated):
        if placed is None or points is None:
            results = posed.results
            if results is None:
                results = search_target(sequence, posed.valid, used, options)
            else:
                results = results.of_tracked(posed.valid)
            seen = _found_points(sequence, results, options.minimum)
            notes += fixed_mark(seen.points, posed.poses[seen.rows])
            notes += tail_of_echoes(results, spacing)
            given, what, where = results.asked, "frames", sequence.source
        else:
            results, seen = None, _usable_points(sequence, placed, posed.valid)
            notes += placed.notes + mirrored(sequence, points)
            given, what = len(placed.rows), "points"
            where = f"{sequence.source} with {os.fspath(points)}"
        images, of_times = _images_of(posed, seen, spacing, where, options)
    notes += [*seen.notes, *of_times]
    if images.kind == "pixel":
        notes += other_pixel_size(sequence, spacing)
    most_lost = len(images) < given / 2
    if most_lost:
        notes.insert(0, f"only {len(images)} of {given} {what} can be used: see below")
    # A table of poses does not name their frames.
    frames = None if options.poses_in_table else posed.frames
    recording = Recording(images, source=sequence.source, pose_frames=frames)
    return Imported(recording, notes, results, most_lost)


class _Posed(NamedTuple):
    """A sequence with the poses of its frames.

    Attributes:
        sequence: of n frames.
        poses: (n, 4, 4) probe -> tracker, mm.
        valid: (n,) True for the selected frames whose pose can be used.
        frames: between which the poses lead.
        track: how the probe moved between the frames; None where that is not known.
        lag_s: by how much images lag behind these poses.
        by_time: whether the poses were looked up by the times of the frames.
        results: of all frames, if the target was looked for to find the lag.
        notes: what was assumed.
    """

    sequence: TrackedSequence
    poses: Float[np.ndarray, "n 4 4"]
    valid: Bool[np.ndarray, " n"]
    frames: FramePair
    track: PoseTrack | None
    lag_s: float
    by_time: bool
    results: FrameResults | None
    notes: list[str]


def _posed(
    sequence: TrackedSequence,
    tracking: TrackedSequence | None,
    placed: FramePoints | None,
    used: Bool[np.ndarray, " n"],
    options: ImportOptions,
) -> _Posed:
    """The frames with their own poses, or with those of ``tracking`` at their times."""
    notes: list[str] = []
    results, lag_s, track = None, options.lag_s, None
    if tracking is not None:
        track = PoseTrack.of(tracking)
        if lag_s == "auto":
            lag_s, note, results = _estimated_lag(sequence, placed, track, used, options)
            notes.append(note)
        sequence, said = with_poses_by_time(sequence, tracking, lag_s)
        notes += said
    assert lag_s != "auto"
    poses, valid, frames, said = tracked_poses(sequence, options, used)
    notes += said
    if track is None:
        own = replace(sequence, transforms={frames: poses}, valid={frames: valid})
        with suppress(InputError):
            track = PoseTrack.of(own)
    by_time = tracking is not None
    return _Posed(sequence, poses, valid & used, frames, track, lag_s, by_time, results, notes)


def _images_of(
    posed: _Posed,
    used: FramePoints,
    spacing: tuple[float, float] | None,
    where: str,
    options: ImportOptions,
) -> tuple[Images, list[str]]:
    """The images of a recording, and notes about their times."""
    sequence, track, notes = posed.sequence, posed.track, []
    time, velocity = None, None
    stamps = sequence.time[used.rows]
    if np.isfinite(stamps).all():
        if track is not None:
            velocity = track.velocities(stamps - posed.lag_s)
            if options.lag_s != "auto":
                notes += better_lag(stamps, used.points, track, posed.lag_s)
        time, said = good_time(
            stamps,
            lambda row: f"{sequence.source}: {sequence.frame_name(int(used.rows[row]))}",
            options,
            by_time=posed.by_time,
        )
        notes += said
    pixels = sequence.pixels
    size = None if pixels is None else (pixels.columns, pixels.rows)
    numbers = sequence.all_numbers[used.rows]
    images = make_images(
        posed.poses[used.rows],
        used.points,
        used.kind,
        covariance=used.covariance,
        time=time,
        velocity=velocity,
        spacing_mm=spacing,
        frame=numbers if (numbers >= 0).all() else None,
        frame_size=size if used.kind == "pixel" else None,
        minimum=options.minimum,
        where=where,
    )
    return images, notes


def _estimated_lag(
    sequence: TrackedSequence,
    placed: FramePoints | None,
    track: PoseTrack,
    used: Bool[np.ndarray, " n"],
    options: ImportOptions,
) -> tuple[float, str, FrameResults | None]:
    """The lag and a note, and the target in all frames if it had to be looked for."""
    results = None
    if placed is None:
        results = search_target(sequence, np.ones(len(sequence), bool), used, options)
        rows, points = results.found, results.position[results.found]
    else:
        shown = _shown(sequence, placed.rows)
        rows, points = placed.rows[shown], placed.points[shown]
    return *lag_of_points(sequence.time[rows], points, track), results


def _refuse_unused(points: str | os.PathLike[str] | None, options: ImportOptions) -> None:
    """Refuse options that a sequence with these points does not use."""
    kinds = [None if source is None else kind_of(source) for source in (points, options.poses)]
    if "table" not in kinds:
        refuse(options, ("quaternion", "skip_invalid"), "is for tables, but no table is read")
    if kinds[0] != "table":
        refuse(options, ("units",), "is for tables of points, and none is read")
    if points is None:
        refuse(options, ("points",), "is for points of another file, and none is named")
    else:
        why = f"is for the search in frames, and the points come from {os.fspath(points)}"
        refuse(options, ("target_kind", "region", "orientation"), why)


def _usable_points(
    sequence: TrackedSequence, placed: FramePoints, valid: Bool[np.ndarray, " n"]
) -> FramePoints:
    """Points of another file, where their frames can be used, in the order of the frames."""
    order = np.argsort(placed.rows)
    rows = placed.rows[order]
    tracked, shown = valid[rows], _shown(sequence, rows)
    notes = [
        f"{counted(int(lost.sum()), 'point')} left out, in frames whose {what} was not OK"
        for lost, what in ((~tracked, "tracking"), (tracked & ~shown, "image"))
        if lost.any()
    ]
    used = tracked & shown
    return FramePoints(rows[used], placed.points[order][used], placed.kind, notes)


def _points(
    source: str | os.PathLike[str], sequence: TrackedSequence, options: ImportOptions
) -> FramePoints:
    if kind_of(source) == "markups":
        if size := size_in_header(sequence):
            raise InputError(
                f"{os.fspath(source)}: Slicer's points count pixels only on an image with spacing "
                f"1, but the header of {sequence.source} states {size[0]:.6g} x {size[1]:.6g} mm: "
                "change it to 1 and place the points again"
            )
        return points_of_markups(source, sequence, options.points)
    table = read_rows(source, options, ignore_time=options.ignore_time)
    if table.poses is None and not options.poses_in_table:
        refuse(options, ("quaternion",), "is for tables with poses, and none is read")
    return points_of_table(table, sequence, options.points)


def _shown(sequence: TrackedSequence, rows: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
    """Whether frames' images were OK; all are where the file holds tracking alone."""
    return sequence.image_valid[rows] | (sequence.pixels is None)


def _found_points(sequence: TrackedSequence, results: FrameResults, minimum: int) -> FramePoints:
    """The target as it was found in the frames."""
    counts, used = results.counts, results.found
    blank, hidden = counts["image not OK"], counts["not credible"]
    if len(used) < minimum:
        if not hidden:
            raise InputError(
                f"{sequence.source}: only {len(used)} of {results.asked} frames have an image and "
                f"tracking that are OK, at least {minimum} are needed"
            )
        raise InputError(
            f"{sequence.source}: only {len(used)} of {len(used) + hidden} frames show a credible "
            f"target, at least {minimum} are needed (most often: {next(iter(results.reasons))}); "
            "check --region and --target, or place the points by hand: jaxcal pick"
        )
    notes = []
    if blank:
        notes.append(f"{blank} of {results.asked} frames left out: their image was not OK")
    if hidden:
        why = "; ".join(f"{reason}: {count}" for reason, count in results.reasons.items())
        notes.append(
            f"{hidden} of {results.asked} frames left out: no credible target in them ({why})"
        )
    return FramePoints(used, results.position[used], "pixel", notes, results.covariance[used])
