"""Recordings from other programs' files: poses from one, points from another, or from pixels.

A sequence (:mod:`jaxcal.io.sequence`) has the poses and perhaps the frames. The target's position
in the frames comes from a table, from points placed in Slicer, or from segmenting the frames.
Frames whose tracking was not OK are left out and counted, as are those without a point. Notes say
in words what was assumed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.poses import QuaternionOrder
from jaxcal.data.recording import MINIMUM_IMAGES, MetresError, Recording, make_images
from jaxcal.io.columns import LengthUnit
from jaxcal.io.folder import PROBE_TO_TRACKER, read_folder, with_pose_table
from jaxcal.io.frame_names import FramePair, capitalised
from jaxcal.io.frame_points import Assignment, FramePoints, points_of_markups, points_of_table
from jaxcal.io.poses_by_time import lag_of_points, times_of_table, with_poses_by_time
from jaxcal.io.readable import quoted
from jaxcal.io.sequence import FolderPixels, Pixels, TrackedSequence
from jaxcal.io.sequence_files import EXTENSIONS, read_sequence
from jaxcal.io.slicer import EXTENSIONS as MARKUPS
from jaxcal.io.target_search import FrameResults, search_target
from jaxcal.io.text import PoseTable, read_crosswire, read_pose_table, recording_of
from jaxcal.io.trackers import is_tracker_export, read_tracker
from jaxcal.runtime.array_types import Bool, Float, Int


@dataclass(frozen=True)
class ImportOptions:
    """The options of an import.

    Attributes:
        source: tracked frame on the probe; the sequence's only one, or ``Probe``, by default.
        target: frame that the target rests in; ``Reference`` where it was tracked, else
            ``Tracker``, by default.
        spacing_mm: [lateral, axial] mm per px, when known.
        units: of u and v in tables.
        quaternion: where a quaternion's scalar stands.
        pose_units: of translations where the file of the poses does not say; mm by default.
        skip_invalid: leave out rows of tables that are marked as invalid, and count them.
        points: how points without time or number are assigned to frames.
        target_kind: what to look for in frames where no points are given: ``echo``, the default,
            or ``cross``.
        region: (first column, first row, columns, rows) to look in, px.
        orientation: of the stored pixels of frames that are searched, where the file does not say.
        ignore_time: time stamps that repeat or go back are no error, and are not kept.
        poses: file with the poses of the frames: a table for a folder of images; a sequence, a
            tracker's export or a table with times for a sequence.
        lag_s: with ``poses``: an image stamped t shows what was at t - lag; ``auto``: estimated
            from the motion of the points in the images.
        spacing_from: DICOM clip that states the pixel size.
    """

    source: str | None = None
    target: str | None = None
    spacing_mm: tuple[float, float] | None = None
    units: Literal["px", "mm"] | None = None
    quaternion: QuaternionOrder | None = None
    pose_units: LengthUnit | None = None
    skip_invalid: bool = False
    points: Assignment | None = None
    target_kind: Literal["echo", "cross"] | None = None
    region: tuple[int, int, int, int] | None = None
    orientation: Literal["MF", "UF", "MN", "UN"] | None = None
    ignore_time: bool = False
    poses: str | os.PathLike[str] | None = None
    lag_s: float | Literal["auto"] = 0.0
    spacing_from: str | os.PathLike[str] | None = None


_FLAGS = {
    "source": "--from",
    "target": "--to",
    "units": "--units",
    "quaternion": "--quaternion",
    "skip_invalid": "--skip-invalid",
    "points": "--points",
    "target_kind": "--target",
    "region": "--region",
    "orientation": "--orientation",
    "ignore_time": "--ignore-time",
    "lag_s": "--lag",
}


def _refuse(options: ImportOptions, names: Sequence[str], why: str) -> None:
    """Refuse options that were given and would not be used."""
    for name in names:
        if getattr(options, name) != getattr(ImportOptions, name):
            raise InputError(f"{_FLAGS[name]} {why}")


class Imported(NamedTuple):
    """A recording and how it was made.

    Attributes:
        recording: of the files.
        notes: what was assumed, left out and counted, in words.
        frames: what became of every frame, where the target was looked for in them.
    """

    recording: Recording
    notes: list[str]
    frames: FrameResults | None = None


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
    kinds = [_kind(source) for source in sources]
    tracked = [source for source, kind in zip(sources, kinds, strict=True) if kind in _SEQUENCES]
    if tracked:
        return _from_sequence(sources, tracked, options)
    if options.poses is not None:
        raise InputError("--poses goes with a sequence or a folder of PNG images")
    unused = "source", "target", "lag_s", "points", "target_kind", "region", "orientation"
    _refuse(options, unused, "does not go with a table of poses and points: it is for sequences")
    options = replace(options, spacing_mm=_spacing(None, options), spacing_from=None)
    if len(sources) == 2 and "markups" not in kinds:
        if options.units == "mm":
            raise InputError("a pair of text files holds pixels: --units mm does not go with it")
        unused = "quaternion", "skip_invalid", "ignore_time"
        _refuse(options, unused, "does not go with a pair of text files, poses and points")
        with _naming_pose_units(options):
            pair = read_crosswire(
                *sources, spacing_mm=options.spacing_mm, pose_units=options.pose_units or "mm"
            )
        return Imported(pair, [])
    if len(sources) != 1 or kinds[0] != "table":
        raise InputError(
            f"{os.fspath(sources[0])}: holds no poses: a sequence, a tracker's export or a table "
            "with poses is needed"
        )
    table = _table(sources[0], options)
    notes = _skipped(table)
    table, said = _with_good_time(table, options)
    with _naming_pose_units(options, table.length_stated):
        return Imported(recording_of(table, options.spacing_mm), notes + said)


@contextmanager
def _naming_pose_units(options: ImportOptions, stated: bool = False) -> Iterator[None]:
    """Name the option that converts poses that look like metres, if no unit was ``stated``."""
    try:
        yield
    except MetresError as error:
        if stated or options.pose_units is not None:
            raise
        raise InputError(f"{error} (jaxcal import converts them with --pose-units m)") from None


_SEQUENCES = ("sequence", "tracker", "scan", "folder")


def _kind(source: str | os.PathLike[str]) -> str:
    name = os.fspath(source).lower()
    if Path(source).is_dir():
        return "folder"
    if name.endswith(EXTENSIONS):
        return "sequence"
    if name.endswith(MARKUPS):
        return "markups"
    if name.endswith((".h5", ".hdf5")):
        return "scan"
    if name.endswith((".xml", ".png", ".dcm", ".vtk", ".seq.mrb", ".mrb")):
        raise FormatError(
            f"{os.fspath(source)}: is not a recording that can be imported (PNG images: name their "
            "folder)"
        )
    return "tracker" if is_tracker_export(source) else "table"


def _table(source: str | os.PathLike[str], options: ImportOptions) -> PoseTable:
    return read_pose_table(
        source,
        quaternion=options.quaternion,
        pose_units=options.pose_units,
        units=options.units,
        skip_invalid=options.skip_invalid,
    )


def _skipped(table: PoseTable) -> list[str]:
    return [f"{table.name}: {table.skipped} invalid rows left out"] if table.skipped else []


def _with_good_time(table: PoseTable, options: ImportOptions) -> tuple[PoseTable, list[str]]:
    """Refuse time stamps that repeat or go back, which mostly are two recordings in one."""
    if table.time is None:
        return table, []
    back = np.flatnonzero(np.diff(table.time) <= 0)
    if not len(back):
        return table, []
    where = f"{table.name}:{table.lines[int(back[0]) + 1]}"
    return _without_time(table, where, options)


def _without_time(
    table: PoseTable, where: str, options: ImportOptions
) -> tuple[PoseTable, list[str]]:
    if not options.ignore_time:
        raise InputError(
            f"{where}: the time stamp is not later than the one before: two recordings in one? "
            "(--ignore-time imports without times)"
        )
    return replace(table, time=None), ["time stamps repeat or go back: not kept"]


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
    sequence, tracking, notes = _opened(tracked[0], options)
    placed = None if points is None else _points(points, sequence, options)
    results, lag_s = None, options.lag_s
    if tracking is not None:
        if lag_s == "auto":
            lag_s, note, results = _estimated_lag(sequence, placed, tracking, options)
            notes.append(note)
        sequence, said = _merged(sequence, tracking, lag_s)
        notes += said
    poses, valid, said = tracked_poses(sequence, options)
    notes += said
    spacing = _spacing(sequence, options)
    with _naming_pose_units(options, sequence.length_stated):
        if placed is None or points is None:
            return _segmented(sequence, poses, valid, spacing, options, notes, results)
        notes += placed.notes + _mirrored(sequence, points)
        return _with_points(sequence, poses, valid, placed, spacing, options, notes)


def _estimated_lag(
    sequence: TrackedSequence,
    placed: FramePoints | None,
    tracking: _Tracking,
    options: ImportOptions,
) -> tuple[float, str, FrameResults | None]:
    """The lag and a note, and the target in all frames if it had to be looked for."""
    results = None
    if placed is None:
        results = _search(sequence, np.ones(len(sequence), bool), options)
        rows, points = results.found, results.position[results.found]
    else:
        shown = _shown(sequence, placed.rows)
        rows, points = placed.rows[shown], placed.points[shown]
    time, poses, valid, _, source, _ = tracking
    return *lag_of_points(sequence, rows, points, time, poses, valid, source), results


def _refuse_unused(points: str | os.PathLike[str] | None, options: ImportOptions) -> None:
    """Refuse options that a sequence with these points does not use."""
    kinds = [None if source is None else _kind(source) for source in (points, options.poses)]
    if "table" not in kinds:
        _refuse(options, ("quaternion", "skip_invalid"), "is for tables, and none is read")
    if kinds[0] != "table":
        _refuse(options, ("units",), "is for tables of points, and none is read")
    if points is None:
        _refuse(options, ("points",), "is for points of another file, and none is named")
    else:
        why = f"is for the search in frames, and the points come from {os.fspath(points)}"
        _refuse(options, ("target_kind", "region", "orientation"), why)


def _with_points(
    sequence: TrackedSequence,
    poses: Float[np.ndarray, "n 4 4"],
    valid: Bool[np.ndarray, " n"],
    placed: FramePoints,
    spacing: tuple[float, float] | None,
    options: ImportOptions,
    notes: list[str],
) -> Imported:
    """The target's points come from another file."""
    # In the order of the frames, so that times do not go back.
    order = np.argsort(placed.rows)
    rows = placed.rows[order]
    tracked, shown = valid[rows], _shown(sequence, rows)
    for lost, what in ((~tracked, "tracking"), (tracked & ~shown, "image")):
        if lost.any():
            notes.append(f"{int(lost.sum())} points left out: their frame's {what} was not OK")
    used = tracked & shown
    rows = rows[used]
    time, said = _time(sequence, rows, options)
    images = make_images(
        poses[rows],
        placed.points[order][used],
        placed.kind,
        time=time,
        spacing_mm=spacing,
        where=sequence.source,
    )
    return Imported(Recording(images, source=sequence.source), notes + said)


def _points(
    source: str | os.PathLike[str], sequence: TrackedSequence, options: ImportOptions
) -> FramePoints:
    if _kind(source) == "markups":
        return points_of_markups(source, sequence, options.points)
    table = _table(source, options)
    if table.poses is None and (options.poses is None or _kind(options.poses) != "table"):
        _refuse(options, ("quaternion",), "is for tables with poses, and none is read")
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


class _Tracking(NamedTuple):
    """Poses that are to be matched to images by time."""

    time: Float[np.ndarray, " m"]
    poses: Float[np.ndarray, "m 4 4"]
    valid: Bool[np.ndarray, " m"]
    pair: FramePair
    source: str
    length_stated: bool


def open_sequence(
    source: str | os.PathLike[str], options: ImportOptions
) -> tuple[TrackedSequence, list[str]]:
    """A sequence of any kind with the poses that belong to it, and notes for the user.

    Args:
        source: a sequence, a folder of PNG, a tracker's export or a TUS-REC scan.
        options: ``poses`` names the file of the poses where they are not in ``source``.

    Raises:
        InputError: files that cannot be read or do not belong together; one line.
    """
    sequence, tracking, notes = _opened(source, options)
    if tracking is None:
        return sequence, notes
    if options.lag_s == "auto":
        raise InputError("--lag auto is estimated from points: it is an option of jaxcal import")
    merged, said = _merged(sequence, tracking, options.lag_s)
    return merged, notes + said


def _merged(
    sequence: TrackedSequence, tracking: _Tracking, lag_s: float
) -> tuple[TrackedSequence, list[str]]:
    merged, notes = with_poses_by_time(sequence, *tracking[:-1], lag_s)
    return replace(merged, length_stated=tracking.length_stated), notes


def _opened(
    source: str | os.PathLike[str], options: ImportOptions
) -> tuple[TrackedSequence, _Tracking | None, list[str]]:
    """A sequence, and the poses that are to be matched to it by time, if there are such."""
    if options.poses is None:
        _refuse(options, ("lag_s",), "needs --poses: it is between images and poses of two files")
        return _read_tracked(source, options.pose_units), None, []
    sequence = _read_tracked(source)
    of_table = _kind(options.poses) == "table"
    if of_table:
        why = f"does not go with a table of poses, {options.poses}: they are from probe to tracker"
        _refuse(options, ("source", "target"), why)
    if isinstance(sequence.pixels, FolderPixels):
        if not of_table:
            raise InputError(
                f"{options.poses}: the poses of a folder of images come from a table with columns "
                "file or frame"
            )
        _refuse(options, ("lag_s",), "is for poses that are matched by time, not to a folder")
        merged, notes = with_pose_table(sequence, _table(options.poses, options))
        return merged, None, notes
    if of_table:
        table = _table(options.poses, options)
        if table.poses is None or table.time is None:
            raise InputError(f"{table.name}: needs columns of times and of poses")
        time, valid = times_of_table(table, sequence), np.ones(len(table), bool)
        found = _Tracking(
            time, table.poses, valid, PROBE_TO_TRACKER, table.name, table.length_stated
        )
        return sequence, found, _skipped(table)
    tracking = _read_tracked(options.poses, options.pose_units)
    start, end, said = _frames(tracking, options)
    poses, valid = tracking.poses(start, end)
    pair, name = (start, end), os.fspath(options.poses)
    found = _Tracking(tracking.time, poses, valid, pair, name, tracking.length_stated)
    return sequence, found, said


def tracked_poses(
    sequence: TrackedSequence, options: ImportOptions
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"], list[str]]:
    """Poses of a sequence, where they can be used, and what was assumed and left out.

    Raises:
        InputError: no way between the frames, or no frame with tracking.
    """
    if options.poses is None:
        start, end, notes = _frames(sequence, options)
    else:
        # The assumptions were noted when the poses were matched.
        (start, end), notes = next(iter(sequence.transforms)), []
    poses, valid = sequence.poses(start, end)
    lost = len(sequence) - int(valid.sum())
    if lost and options.poses is None:
        notes.append(f"{lost} of {len(sequence)} frames left out: their tracking was not OK")
    if not valid.any():
        raise InputError(f"{sequence.source}: no frame has tracking from {start} to {end}")
    return poses, valid, notes


def frames_to_show(
    sequence: TrackedSequence, options: ImportOptions, every: int = 1
) -> tuple[list[int], tuple[int, int], list[str]]:
    """Frames in which a person is to place points.

    Args:
        sequence: with pixels; without any transforms every image is shown.
        options: which poses are needed.
        every: of the frames that can be used, every n-th.

    Returns:
        Numbers of the frames, their columns and rows, and what was left out, in words.

    Raises:
        InputError: no pixels, or no frame that can be used.
    """
    if sequence.pixels is None:
        raise InputError(f"{sequence.source}: holds no pixels, only transforms")
    usable, notes = sequence.image_valid, []
    if sequence.transforms:
        _, valid, notes = tracked_poses(sequence, options)
        usable = usable & valid
    if not usable.any():
        raise InputError(f"{sequence.source}: no frame can be used")
    shown = [int(number) for number in np.flatnonzero(usable)[::every]]
    return shown, (sequence.pixels.columns, sequence.pixels.rows), notes


def _read_tracked(
    source: str | os.PathLike[str], pose_units: LengthUnit | None = None
) -> TrackedSequence:
    match _kind(source):
        case "tracker":
            return read_tracker(source, pose_units)
        case "scan":
            from jaxcal.io.tus_rec import read_scan

            return read_scan(source).scaled(pose_units or "mm")
        case "folder":
            return read_folder(source)
    return read_sequence(source).scaled(pose_units or "mm")


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


def _frames(sequence: TrackedSequence, options: ImportOptions) -> tuple[str, str, list[str]]:
    """The frames of the poses, and what was assumed about them."""
    pairs: list[FramePair] = list(sequence.transforms)
    if not pairs:
        raise InputError(
            f"{sequence.source}: holds no transforms: name the file with its poses (--poses)"
        )
    names = sequence.frames()
    resting = "Tracker", "Reference"
    # The pose of the tracker in the frame of a tool tells the same, inverted.
    moving = (target if source in resting else source for source, target in pairs)
    tools = list(dict.fromkeys(name for name in moving if name not in resting))
    start = options.source
    if start is None:
        start = "Probe" if "Probe" in tools else tools[0] if len(tools) == 1 else None
    if start is None:
        raise InputError(
            f"{sequence.source}: name the tracked frame on the probe (--from); there are "
            f"{', '.join(map(quoted, tools))}"
        )
    start = start if start in names else capitalised(start)
    if options.target is not None:
        end = options.target if options.target in names else capitalised(options.target)
        return start, end, []
    tracked = [pair for pair in pairs if set(pair) == set(resting) and sequence.valid[pair].any()]
    if tracked and start != "Reference":
        end = "Reference"
    else:
        ends = [target for source, target in pairs if source == start]
        ends += [source for source, target in pairs if target == start and source in resting]
        end = next(iter(ends), "Tracker")
    inverted = (end, start) in pairs and (start, end) not in pairs
    how = f", inverted from {end} to {start}" if inverted else ""
    return start, end, [f"poses from {start} to {end}{how} (--from and --to choose others)"]


def _time(
    sequence: TrackedSequence, rows: Int[np.ndarray, " m"], options: ImportOptions
) -> tuple[Float[np.ndarray, " m"] | None, list[str]]:
    time = sequence.time[rows]
    if not np.isfinite(time).all():
        return None, []
    order = np.argsort(rows, kind="stable")
    back = np.flatnonzero(np.diff(time[order]) <= 0)
    if not len(back):
        return time, []
    if options.ignore_time:
        return None, ["time stamps repeat or go back: not kept"]
    name = sequence.frame_name(int(rows[order][back[0] + 1]))
    raise InputError(
        f"{sequence.source}: {name}: the time stamp is not later than "
        "the one before: two recordings in one? (--ignore-time imports without times)"
    )


def _search(
    sequence: TrackedSequence, tracked: Bool[np.ndarray, " n"], options: ImportOptions
) -> FrameResults:
    return search_target(
        sequence,
        tracked,
        options.target_kind or "echo",
        region=options.region,
        orientation=options.orientation,
    )


def _segmented(
    sequence: TrackedSequence,
    poses: Float[np.ndarray, "n 4 4"],
    valid: Bool[np.ndarray, " n"],
    spacing: tuple[float, float] | None,
    options: ImportOptions,
    notes: list[str],
    results: FrameResults | None,
) -> Imported:
    """The target as it is found in every frame that was tracked, if it was not yet looked for."""
    results = _search(sequence, valid, options) if results is None else results.of_tracked(valid)
    counts, used = results.counts, results.found
    blank, hidden = counts["image not OK"], counts["not credible"]
    if blank:
        notes.append(f"{blank} frames left out: their image was not OK")
    if len(used) < MINIMUM_IMAGES:
        most = next(iter(results.reasons), "there are no frames")
        raise InputError(
            f"{sequence.source}: only {len(used)} of {len(used) + hidden} frames show a credible "
            f"target, at least {MINIMUM_IMAGES} are needed (most often: {most}); place the points "
            "by hand: jaxcal pick"
        )
    if hidden:
        notes.append(
            f"{hidden} of {len(used) + hidden} frames left out: no credible target in them"
        )
    time, said = _time(sequence, used, options)
    images = make_images(
        poses[used],
        results.position[used],
        "pixel",
        covariance=results.covariance[used],
        time=time,
        spacing_mm=spacing,
        where=sequence.source,
    )
    return Imported(Recording(images, source=sequence.source), notes + said, results)
