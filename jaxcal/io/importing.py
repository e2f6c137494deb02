"""Recordings from other programs' files: poses from one, points from another, or from pixels.

A sequence (:mod:`jaxcal.io.sequence`) has the poses and perhaps the frames. The target's position
in the frames comes from a table, from points placed in Slicer, or from segmenting the frames.
Frames whose tracking was not OK are left out and counted, as are those without a point. Notes say
in words what was assumed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxcal import InputError
from jaxcal.data.recording import MetresError, Recording, make_images
from jaxcal.io.frame_points import FramePoints, points_of_markups, points_of_table
from jaxcal.io.frame_poses import opened, tracked_poses
from jaxcal.io.poses_by_time import PoseTrack, better_lag, lag_of_points, with_poses_by_time
from jaxcal.io.sequence import Pixels, TrackedSequence
from jaxcal.io.sources import SEQUENCES, ImportOptions, kind_of, read_rows, refuse
from jaxcal.io.table import first_line, parse_numbers, read_table
from jaxcal.io.target_search import FrameResults, search_target
from jaxcal.io.text import PoseTable, read_crosswire, recording_of
from jaxcal.io.two_tables import one_of_two_tables
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.messages import counted

_AT_ONE_PLACE_PX = 0.5
_MOVED_MM = 1.0
"""A real target moves in the image by more than the first where a probe moves by the second."""


class Imported(NamedTuple):
    """A recording and how it was made.

    Attributes:
        recording: of the files.
        notes: what was assumed, left out and counted, in words.
        frames: what became of every frame, where the target was looked for in them.
        most_lost: whether fewer than half of the frames, or of the points of another file, are in
            the recording.
    """

    recording: Recording
    notes: list[str]
    frames: FrameResults | None = None
    most_lost: bool = False


def import_files(
    sources: Sequence[str | os.PathLike[str]], options: ImportOptions | None = None
) -> Imported:
    """Make a recording from other programs' files.

    Args:
        sources: one of: a table with poses and points; a sequence, a folder of PNG or a tracker's
            export with points (a table or Slicer's markups); a sequence or folder with frames,
            which are segmented; the cross-wire pair POSES POINTS.
        options: what is asked for.

    Returns:
        The recording, with notes, and with results for every frame if frames were segmented.

    Raises:
        InputError: files that cannot be read or do not belong together; one line that names the
            file, and where possible the line.
    """
    options = options or ImportOptions()
    kinds = [kind_of(source) for source in sources]
    tracked = [source for source, kind in zip(sources, kinds, strict=True) if kind in SEQUENCES]
    if tracked:
        return _from_sequence(sources, tracked, options)
    if options.poses is not None:
        raise InputError("--poses goes with a sequence or a folder of PNG images")
    unused = "source", "target", "points", "target_kind", "region", "orientation"
    refuse(options, unused, "does not go with a table of poses and points: it is for sequences")
    options = replace(options, spacing_mm=_spacing(None, options), spacing_from=None)
    if len(sources) == 2 and "markups" not in kinds and _have_headers(sources):
        tables = [read_rows(each, options, ignore_time=options.ignore_time) for each in sources]
        return _from_table(*one_of_two_tables(*tables, lag_s=options.lag_s), options)
    refuse(options, ("lag_s",), "is for poses that are matched to images by their times")
    if len(sources) == 2 and "markups" not in kinds:
        if options.units == "mm":
            raise InputError("a pair of text files holds pixels: --units mm does not go with it")
        unused = "quaternion", "skip_invalid", "ignore_time"
        refuse(options, unused, "does not go with a pair of text files, poses and points")
        with _naming_pose_units(options):
            pair = read_crosswire(
                *sources,
                spacing_mm=options.spacing_mm,
                pose_units=options.pose_units or "mm",
                invert_poses=options.invert_poses,
                minimum=options.minimum,
            )
        return Imported(pair, [])
    if len(sources) != 1 or kinds[0] != "table":
        raise InputError(
            f"{os.fspath(sources[0])}: holds no poses: a sequence, a tracker's export or a table "
            "with poses is needed"
        )
    table = read_rows(sources[0], options, ignore_time=options.ignore_time)
    return _from_table(table, table.notes, 0, options)


def _have_headers(sources: Sequence[str | os.PathLike[str]]) -> bool:
    """Whether two text files are tables with headers, and not the pair of rows R|t and u v."""
    if not any(first_line(source)[1] for source in sources):
        return False
    first = parse_numbers(read_table(sources[0], header=False).rows[0])
    return len(first) != 4 or None in first


def _from_table(table: PoseTable, notes: list[str], lost: int, options: ImportOptions) -> Imported:
    """The recording of a table with poses and points; ``lost`` further points have no pose."""
    if table.time is None and options.ignore_time:
        notes = [*notes, "time stamps are missing or cannot be read: not kept"]
    if table.time is not None:
        time, said = _good_time(table.time, lambda row: f"{table.name}:{table.lines[row]}", options)
        table, notes = replace(table, time=time), notes + said
        if time is not None and table.velocity is None:
            table = replace(table, velocity=_velocities(time, table))
    with _naming_pose_units(options, table.length_stated):
        recording = recording_of(table, options.spacing_mm, options.minimum)
    return Imported(recording, notes, most_lost=len(table) < lost)


def _velocities(time: Float[np.ndarray, " n"], table: PoseTable) -> Float[np.ndarray, "n 6"] | None:
    """How the probe moved, from the poses of neighbouring rows; None where they do not tell."""
    if table.poses is None or len(time) < 2:
        return None
    return PoseTrack.of_table(time, table.poses, table.name).velocities(time)


@contextmanager
def _naming_pose_units(options: ImportOptions, stated: bool = False) -> Iterator[None]:
    """Name the option that converts poses that look like metres, if no unit was ``stated``."""
    try:
        yield
    except MetresError as error:
        if stated or options.pose_units is not None:
            raise
        raise InputError(f"{error} (jaxcal import converts them with --pose-units m)") from None


def _good_time(
    time: Float[np.ndarray, " n"],
    place: Callable[[int], str],
    options: ImportOptions,
    by_time: bool = False,
) -> tuple[Float[np.ndarray, " n"] | None, list[str]]:
    """The times, unless they repeat or go back, which mostly are two recordings in one; and notes.

    ``place`` says where a row stands, ``by_time`` whether poses were looked up by these times.
    """
    back = np.flatnonzero(np.diff(time) <= 0)
    if not len(back):
        return time, []
    if not options.ignore_time:
        row = int(back[0]) + 1
        guess = "too few digits, or " * bool(time[row] == time[row - 1])
        then = "imports images with poses at such times" if by_time else "imports without times"
        raise InputError(
            f"{place(row)}: the time stamp is not later than the one before: {guess}two recordings "
            f"in one? (--ignore-time {then})"
        )
    wrong = ", but poses are those at these times: if times are wrong, poses are, too" * by_time
    return None, [f"time stamps repeat or go back: not kept{wrong}"]


def _from_sequence(
    sources: Sequence[str | os.PathLike[str]],
    tracked: list[str | os.PathLike[str]],
    options: ImportOptions,
) -> Imported:
    if len(tracked) > 1 or len(sources) > 2:
        raise InputError(
            f"{', '.join(str(source) for source in sources)}: one sequence, and at most one file "
            "of points, make a recording (poses in another file: --poses)"
        )
    points = next((source for source in sources if source not in tracked), None)
    _refuse_unused(points, options)
    sequence, tracking, notes = opened(tracked[0], options)
    placed = None if points is None else _points(points, sequence, options)
    results, lag_s, track = None, options.lag_s, None
    if tracking is not None:
        track = PoseTrack.of(tracking)
        if lag_s == "auto":
            lag_s, note, results = _estimated_lag(sequence, placed, track, options)
            notes.append(note)
        sequence, said = with_poses_by_time(sequence, tracking, lag_s)
        notes += said
    assert lag_s != "auto"
    poses, valid, frames, said = tracked_poses(sequence, options)
    notes += said
    if track is None:
        with suppress(InputError):
            track = PoseTrack.of(
                replace(sequence, transforms={frames: poses}, valid={frames: valid})
            )
    spacing = _spacing(sequence, options)
    with _naming_pose_units(options, sequence.length_stated):
        where = sequence.source
        if placed is None or points is None:
            results = (
                search_target(sequence, valid, options)
                if results is None
                else results.of_tracked(valid)
            )
            used = _found_points(sequence, results, options.minimum)
            notes += _fixed_mark(used.points, poses[used.rows])
            given, what = len(sequence), "frames"
        else:
            where += f" with {os.fspath(points)}"
            notes += placed.notes + _mirrored(sequence, points)
            used = _usable_points(sequence, placed, valid)
            given, what = len(placed.rows), "points"
        time, velocity, said = None, None, []
        stamps = sequence.time[used.rows]
        if np.isfinite(stamps).all():
            if track is not None:
                velocity = track.velocities(stamps - lag_s)
                if options.lag_s != "auto":
                    notes += better_lag(stamps, used.points, track, lag_s)
            time, said = _good_time(
                stamps,
                lambda row: f"{sequence.source}: {sequence.frame_name(int(used.rows[row]))}",
                options,
                by_time=tracking is not None,
            )
        pixels = sequence.pixels
        size = None if pixels is None else (pixels.columns, pixels.rows)
        images = make_images(
            poses[used.rows],
            used.points,
            used.kind,
            covariance=used.covariance,
            time=time,
            velocity=velocity,
            spacing_mm=spacing,
            frame=sequence.numbers_of(used.rows),
            frame_size=size if used.kind == "pixel" else None,
            minimum=options.minimum,
            where=where,
        )
    notes += used.notes + said
    most_lost = len(used.rows) < given / 2
    if most_lost:
        notes.insert(0, f"only {len(used.rows)} of {given} {what} can be used: see below")
    # A table of poses does not name their frames.
    named = options.poses is None or kind_of(options.poses) != "table"
    recording = Recording(images, source=sequence.source, pose_frames=frames if named else None)
    return Imported(recording, notes, results, most_lost)


def _estimated_lag(
    sequence: TrackedSequence,
    placed: FramePoints | None,
    track: PoseTrack,
    options: ImportOptions,
) -> tuple[float, str, FrameResults | None]:
    """The lag and a note, and the target in all frames if it had to be looked for."""
    results = None
    if placed is None:
        results = search_target(sequence, np.ones(len(sequence), bool), options)
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
        return points_of_markups(source, sequence, options.points)
    table = read_rows(source, options)
    if table.poses is None and (options.poses is None or kind_of(options.poses) != "table"):
        refuse(options, ("quaternion",), "is for tables with poses, and none is read")
    return points_of_table(table, sequence, options.points)


def _shown(sequence: TrackedSequence, rows: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
    """Whether frames' images were OK; all are where the file holds tracking alone."""
    return sequence.image_valid[rows] | (sequence.pixels is None)


def _mirrored(sequence: TrackedSequence, points: str | os.PathLike[str]) -> list[str]:
    """A note where points of the pixels as they are stored would be mirrored."""
    pixels = sequence.pixels
    stored = pixels.orientation if isinstance(pixels, Pixels) else None
    if pixels is None or stored is None or stored == "MF":
        return []
    mirrored = {"U": f"u = {pixels.columns - 1} - u", "N": f"v = {pixels.rows - 1} - v"}
    told = " and ".join(text for letter, text in mirrored.items() if letter in stored)
    return [
        f"u and v of {os.fspath(points)} are taken in the orientation MF, as jaxcal pick shows it; "
        f"{sequence.source} is stored as {stored}: points of its stored pixels must be mirrored "
        f"first ({told})"
    ]


def _spacing(
    sequence: TrackedSequence | None, options: ImportOptions
) -> tuple[float, float] | None:
    """The pixel size that is stated, or read from a clip of the same image size."""
    if options.spacing_from is None:
        return options.spacing_mm
    if options.spacing_mm is not None:
        raise InputError("give either --spacing or --spacing-from")
    from jaxcal.io.dicom import read_pixel_size

    stated = read_pixel_size(options.spacing_from)
    pixels = None if sequence is None else sequence.pixels
    if pixels is not None and (pixels.columns, pixels.rows) != (stated.columns, stated.rows):
        raise InputError(
            f"{options.spacing_from}: its images are {stated.columns} x {stated.rows} px, the "
            f"frames {pixels.columns} x {pixels.rows}: their pixels need not be of one size "
            "(--spacing states it)"
        )
    return stated.spacing_mm


def _fixed_mark(points: Float[np.ndarray, "n 2"], poses: Float[np.ndarray, "n 4 4"]) -> list[str]:
    """A note if most frames show the target at one place although the probe moved."""
    middle = np.median(points, axis=0)
    same = (np.abs(points - middle) < _AT_ONE_PLACE_PX).all(axis=1)
    if 2 * same.sum() < len(points) or np.ptp(poses[same, :3, 3], axis=0).max() < _MOVED_MM:
        return []
    return [
        f"in {same.sum()} of {len(points)} frames the target is at the same place, "
        f"u = {middle[0]:.0f}, v = {middle[1]:.0f}, although the probe moved: is it a mark of the "
        "machine? --region leaves it out"
    ]


def _found_points(sequence: TrackedSequence, results: FrameResults, minimum: int) -> FramePoints:
    """The target as it was found in the frames."""
    counts, used = results.counts, results.found
    blank, hidden = counts["image not OK"], counts["not credible"]
    if len(used) < minimum:
        most = next(iter(results.reasons), "there are no frames")
        raise InputError(
            f"{sequence.source}: only {len(used)} of {len(used) + hidden} frames show a credible "
            f"target, at least {minimum} are needed (most often: {most}); "
            "check --region and --target, or place the points by hand: jaxcal pick"
        )
    notes = []
    if blank:
        notes.append(f"{blank} of {len(results)} frames left out: their image was not OK")
    if hidden:
        why = "; ".join(f"{reason}: {count}" for reason, count in results.reasons.items())
        notes.append(
            f"{hidden} of {len(results)} frames left out: no credible target in them ({why})"
        )
    return FramePoints(used, results.position[used], "pixel", notes, results.covariance[used])
