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
from jaxcal.io.folder import read_folder, with_pose_table
from jaxcal.io.frame_names import FramePair, capitalised
from jaxcal.io.frame_points import Assignment, points_of_markups, points_of_table
from jaxcal.io.poses_by_time import with_poses_by_time
from jaxcal.io.readable import quoted
from jaxcal.io.sequence import FolderPixels, TrackedSequence
from jaxcal.io.sequence_files import EXTENSIONS, read_sequence
from jaxcal.io.slicer import EXTENSIONS as MARKUPS
from jaxcal.io.target_search import FrameResults, search_target
from jaxcal.io.text import LengthUnit, PoseTable, read_crosswire, read_pose_table, recording_of
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
        pose_units: of translations in tables and in pairs of text files.
        skip_invalid: leave out rows of tables that are marked as invalid, and count them.
        points: how points without time or number are assigned to frames.
        target_kind: what to look for in frames where no points are given: ``echo`` or ``cross``.
        region: (first column, first row, columns, rows) to look in, px.
        orientation: of the stored pixels, where the file does not say.
        ignore_time: time stamps that repeat or go back are no error, and are not kept.
        poses: file with the poses of the frames: a table for a folder of images; a sequence, a
            tracker's export or a table with times for a sequence.
        lag_s: with ``poses``: an image stamped t shows what was at t - lag.
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
    target_kind: Literal["echo", "cross"] = "echo"
    region: tuple[int, int, int, int] | None = None
    orientation: Literal["MF", "UF", "MN", "UN"] | None = None
    ignore_time: bool = False
    poses: str | os.PathLike[str] | None = None
    lag_s: float = 0.0
    spacing_from: str | os.PathLike[str] | None = None


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
        with _naming_pose_units(options.poses is not None):
            return _from_sequence(sources, tracked, options)
    if options.poses is not None:
        raise InputError("--poses goes with a sequence or a folder of PNG images")
    options = replace(options, spacing_mm=_spacing(None, options), spacing_from=None)
    if len(sources) == 2 and "markups" not in kinds:
        if options.units == "mm":
            raise InputError("a pair of text files holds pixels: --units mm does not go with it")
        if options.quaternion is not None:
            raise InputError("a pair of text files holds no quaternions: leave --quaternion out")
        with _naming_pose_units():
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
    with _naming_pose_units():
        return Imported(recording_of(table, options.spacing_mm), notes + said)


@contextmanager
def _naming_pose_units(converts: bool = True) -> Iterator[None]:
    """Name the option that converts poses that look like metres, where it ``converts`` them."""
    try:
        yield
    except MetresError as error:
        if not converts:
            raise
        raise InputError(f"{error} (--pose-units m converts them)") from None


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
    sequence, notes = open_sequence(tracked[0], options)
    poses, valid, said = tracked_poses(sequence, options)
    notes += said
    spacing = _spacing(sequence, options)
    points = next((source for source in sources if source not in tracked), None)
    if points is None:
        return _segmented(sequence, poses, valid, spacing, options, notes)
    if os.fspath(points).lower().endswith(MARKUPS):
        placed = points_of_markups(points, sequence, options.points)
    else:
        placed = points_of_table(_table(points, options), sequence, options.points)
    used = valid[placed.rows]
    notes += placed.notes
    if (~used).any():
        notes.append(f"{int((~used).sum())} points left out: their frame's tracking was not OK")
    rows = placed.rows[used]
    time, said = _time(sequence, rows, options)
    images = make_images(
        poses[rows],
        placed.points[used],
        placed.kind,
        time=time,
        spacing_mm=spacing,
        where=sequence.source,
    )
    return Imported(Recording(images, source=sequence.source), notes + said)


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
    sequence = _read_tracked(source)
    if options.poses is None:
        return sequence, []
    if isinstance(sequence.pixels, FolderPixels):
        if _kind(options.poses) != "table":
            raise InputError(
                f"{options.poses}: the poses of a folder of images come from a table with columns "
                "file or frame"
            )
        return with_pose_table(sequence, _table(options.poses, options))
    if _kind(options.poses) == "table":
        table = _table(options.poses, options)
        if table.poses is None or table.time is None:
            raise InputError(f"{table.name}: needs columns of times and of poses")
        found, valid = table.poses, np.ones(len(table), bool)
        pair, time, said = ("Probe", "Tracker"), table.time, _skipped(table)
    else:
        tracking = _read_tracked(options.poses)
        start, end, said = _frames(tracking, options)
        found, valid = tracking.poses(start, end)
        pair, time = (start, end), tracking.time
    name = os.fspath(options.poses)
    merged, more = with_poses_by_time(sequence, time, found, valid, pair, name, options.lag_s)
    return merged, said + more


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


def _read_tracked(source: str | os.PathLike[str]) -> TrackedSequence:
    match _kind(source):
        case "tracker":
            return read_tracker(source)
        case "scan":
            from jaxcal.io.tus_rec import read_scan

            return read_scan(source)
        case "folder":
            return read_folder(source)
    return read_sequence(source)


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
    tools = list(dict.fromkeys(source for source, _ in pairs if source != "Reference"))
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
    reference = ("Reference", "Tracker")
    if reference in sequence.valid and sequence.valid[reference].any() and start != "Reference":
        end = "Reference"
    else:
        end = next((target for source, target in pairs if source == start), "Tracker")
    return start, end, [f"poses from {start} to {end} (--from and --to choose others)"]


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
    raise InputError(
        f"{sequence.source}: frame {rows[order][back[0] + 1]}: the time stamp is not later than "
        "the one before: two recordings in one? (--ignore-time imports without times)"
    )


def _segmented(
    sequence: TrackedSequence,
    poses: Float[np.ndarray, "n 4 4"],
    valid: Bool[np.ndarray, " n"],
    spacing: tuple[float, float] | None,
    options: ImportOptions,
    notes: list[str],
) -> Imported:
    """Search for the target in every frame that was tracked."""
    results = search_target(
        sequence, valid, options.target_kind, region=options.region, orientation=options.orientation
    )
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
