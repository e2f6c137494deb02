"""From other programs' files to a recording: poses from one, points from another, or from pixels.

A sequence (:mod:`jaxcal.io.sequence`) has the poses and perhaps the frames. Where the target is in
them comes from a table, from points placed in Slicer, or from segmenting the frames. Frames whose
tracking was not OK are left out and counted, as are those without a point; what was assumed is
told in words.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.poses import QuaternionOrder
from jaxcal.data.recording import MINIMUM_IMAGES, Recording, make_images
from jaxcal.io.frame_names import capitalised
from jaxcal.io.readable import naming, quoted
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.sequence_files import EXTENSIONS, read_sequence
from jaxcal.io.slicer import EXTENSIONS as MARKUPS
from jaxcal.io.slicer import pixels_from_markups, read_markups
from jaxcal.io.text import LengthUnit, PoseTable, read_crosswire, read_pose_table, recording_of
from jaxcal.io.trackers import is_tracker_export, read_tracker
from jaxcal.runtime.array_types import Bool, Float, Int

Points = Literal["order", "labels"]
"""How points without a time or a frame's number belong to frames: one for each frame in their
order, or by the number that ends each point's label, frames counted from 0."""

_SLACK = 0.5
"""A point belongs to the frame nearest in time, within this part of the median interval."""


@dataclass(frozen=True)
class ImportOptions:
    """What is asked for beside the files.

    Attributes:
        source: tracked frame on the probe; the sequence's only one, or ``Probe``, by default.
        target: frame that the target rests in; ``Reference`` where it was tracked, else
            ``Tracker``, by default.
        spacing_mm: [lateral, axial] mm per px, when known.
        units: of u and v in tables.
        quaternion: where a quaternion's scalar stands.
        pose_units: of translations in tables.
        skip_invalid: leave out rows of tables that are marked as invalid, and count them.
        points: how points without time or number belong to frames.
        target_kind: what to look for in frames where no points are given: ``echo`` or ``cross``.
        region: (first column, first row, columns, rows) to look in, px.
        orientation: of the stored pixels, where the file does not say.
        ignore_time: time stamps that repeat or go back are no error, and are not kept.
    """

    source: str | None = None
    target: str | None = None
    spacing_mm: tuple[float, float] | None = None
    units: Literal["px", "mm"] | None = None
    quaternion: QuaternionOrder | None = None
    pose_units: LengthUnit | None = None
    skip_invalid: bool = False
    points: Points | None = None
    target_kind: Literal["echo", "cross"] = "echo"
    region: tuple[int, int, int, int] | None = None
    orientation: Literal["MF", "UF", "MN", "UN"] | None = None
    ignore_time: bool = False


def import_files(
    sources: Sequence[str | os.PathLike[str]], options: ImportOptions | None = None
) -> tuple[Recording, list[str]]:
    """Make a recording of other programs' files.

    Args:
        sources: one of: a table with poses and points; a sequence or a tracker's export with points
            (a table or Slicer's markups); a sequence with frames, which are segmented; the
            cross-wire pair POSES POINTS.
        options: what is asked for.

    Returns:
        The recording, and what was assumed, left out and counted, in words.

    Raises:
        InputError: files that cannot be read or do not belong together; one line that names the
            file, and where possible the line.
    """
    options = options or ImportOptions()
    kinds = [_kind(source) for source in sources]
    tracked = [
        source for source, kind in zip(sources, kinds, strict=True)
        if kind in ("sequence", "tracker", "scan")
    ]  # fmt: skip
    if tracked:
        return _from_sequence(sources, kinds, tracked, options)
    if len(sources) == 2 and "markups" not in kinds:
        if options.units == "mm":
            raise InputError("a pair of text files holds pixels: --units mm does not go with it")
        return read_crosswire(*sources, spacing_mm=options.spacing_mm), []
    if len(sources) != 1 or kinds[0] != "table":
        raise InputError(
            f"{os.fspath(sources[0])}: holds no poses: a sequence, a tracker's export or a table "
            "with poses is needed"
        )
    table = _table(sources[0], options)
    notes = _skipped(table)
    table, said = _with_good_time(table, options)
    return recording_of(table, options.spacing_mm), notes + said


def _kind(source: str | os.PathLike[str]) -> str:
    name = os.fspath(source).lower()
    if name.endswith(EXTENSIONS):
        return "sequence"
    if name.endswith(MARKUPS):
        return "markups"
    if name.endswith((".h5", ".hdf5")):
        return "scan"
    if name.endswith((".xml", ".png", ".dcm", ".vtk", ".seq.mrb", ".mrb")):
        raise FormatError(f"{os.fspath(source)}: is not a recording that can be imported")
    return "tracker" if is_tracker_export(source) else "table"


def _table(source: str | os.PathLike[str], options: ImportOptions) -> PoseTable:
    return read_pose_table(
        source, quaternion=options.quaternion, pose_units=options.pose_units,
        units=options.units, skip_invalid=options.skip_invalid,
    )  # fmt: skip


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
    kinds: list[str],
    tracked: list[str | os.PathLike[str]],
    options: ImportOptions,
) -> tuple[Recording, list[str]]:
    if len(tracked) > 1 or len(sources) > 2:
        raise InputError(
            f"{', '.join(str(source) for source in sources)}: one sequence, and at most one file "
            "of points, make a recording"
        )
    kind = kinds[list(sources).index(tracked[0])]
    sequence = _read_tracked(tracked[0], kind)
    start, end, notes = _frames(sequence, options)
    poses, valid = sequence.poses(start, end)
    lost = len(sequence) - int(valid.sum())
    if lost:
        notes.append(f"{lost} of {len(sequence)} frames left out: their tracking was not OK")
    if not valid.any():
        raise InputError(f"{sequence.source}: no frame has tracking from {start} to {end}")
    points = next((source for source in sources if source not in tracked), None)
    if points is None:
        return _segmented(sequence, poses, valid, options, notes)
    rows, measured, point_kind, said = _points(points, sequence, options)
    notes += said
    used = valid[rows]
    if (~used).any():
        notes.append(f"{int((~used).sum())} points left out: their frame's tracking was not OK")
    rows, measured = rows[used], measured[used]
    time, said = _time(sequence, rows, options)
    images = make_images(
        poses[rows], measured, point_kind, time=time,
        spacing_mm=options.spacing_mm, where=sequence.source,
    )  # fmt: skip
    return Recording(images, source=sequence.source), notes + said


def _read_tracked(source: str | os.PathLike[str], kind: str) -> TrackedSequence:
    if kind == "tracker":
        return read_tracker(source)
    if kind == "scan":
        from jaxcal.io.tus_rec import read_scan

        return read_scan(source)
    return read_sequence(source)


def _frames(sequence: TrackedSequence, options: ImportOptions) -> tuple[str, str, list[str]]:
    """The frames of the poses, and what was assumed about them."""
    pairs = list(sequence.transforms)
    if not pairs:
        raise InputError(
            f"{sequence.source}: holds no transforms: its poses are in another file, which must be "
            "merged first (PLUS: EditSequenceFile --operation=MIX)"
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


def _points(
    source: str | os.PathLike[str], sequence: TrackedSequence, options: ImportOptions
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "m 2"], Literal["pixel", "point"], list[str]]:
    """Frames that points are in, the points, what they are, and what there is to say."""
    name = os.fspath(source)
    if name.lower().endswith(MARKUPS):
        markups = read_markups(source)
        with naming(source):
            pixels = pixels_from_markups(markups)
            rows = _rows_of_markups(markups.labels, sequence, options)
        said = [f"{name}: {markups.unplaced} points were not placed"] if markups.unplaced else []
        return _distinct(rows, name), pixels, "pixel", said
    table = _table(source, options)
    if table.points is None:
        raise InputError(f"{name}: holds no points (columns u and v, or lateral and range)")
    with naming(source):
        rows = _rows_of_table(table, sequence, options)
    return _distinct(rows, name), table.points, table.kind, _skipped(table)


def _distinct(rows: Int[np.ndarray, " m"], name: str) -> Int[np.ndarray, " m"]:
    values, counts = np.unique(rows, return_counts=True)
    if (counts > 1).any():
        raise InputError(f"{name}: frame {values[counts > 1][0]} has more than one point")
    return rows


def _in_range(rows: Int[np.ndarray, " m"], sequence: TrackedSequence) -> Int[np.ndarray, " m"]:
    bad = np.flatnonzero((rows < 0) | (rows >= len(sequence)))
    if len(bad):
        raise InputError(
            f"frame {rows[bad[0]]} is not in the sequence, which has frames 0 to "
            f"{len(sequence) - 1}"
        )
    return rows


def _in_order(count: int, sequence: TrackedSequence) -> Int[np.ndarray, " m"]:
    if count != len(sequence):
        raise InputError(f"{count} points, but the sequence has {len(sequence)} frames")
    return np.arange(count)


def _rows_of_markups(
    labels: Sequence[str], sequence: TrackedSequence, options: ImportOptions
) -> Int[np.ndarray, " m"]:
    if options.points is None:
        raise InputError(
            "say how points belong to frames: --points labels (each label ends in a frame's "
            "number, from 0) or --points order (one point for each frame)"
        )
    if options.points == "order":
        return _in_order(len(labels), sequence)
    rows = []
    for index, label in enumerate(labels):
        digits = label[len(label.rstrip("0123456789")) :]
        if not digits or len(digits) > 9:
            raise InputError(
                f"point {index + 1}: its label {quoted(label)} does not end in a frame's number"
            )
        rows.append(int(digits))
    return _in_range(np.array(rows, dtype=np.int64), sequence)


def _rows_of_table(
    table: PoseTable, sequence: TrackedSequence, options: ImportOptions
) -> Int[np.ndarray, " m"]:
    if table.frame is not None:
        return _in_range(table.frame, sequence)
    if table.time is not None and np.isfinite(sequence.time).all() and len(sequence) > 1:
        return _nearest_in_time(table, sequence)
    if options.points == "order" or len(table) == len(sequence):
        return _in_order(len(table), sequence)
    raise InputError(
        "has neither a column frame nor time stamps that the sequence has: which frames are the "
        "points in?"
    )


def _nearest_in_time(table: PoseTable, sequence: TrackedSequence) -> Int[np.ndarray, " m"]:
    assert table.time is not None
    order = np.argsort(sequence.time, kind="stable")
    time = sequence.time[order]
    slack = _SLACK * float(np.median(np.diff(time)))
    after = np.clip(np.searchsorted(time, table.time), 1, len(time) - 1)
    nearer = after - (table.time - time[after - 1] < time[after] - table.time)
    far = np.flatnonzero(np.abs(time[nearer] - table.time) > slack)
    if len(far):
        raise InputError(
            f"line {table.lines[int(far[0])]}: no frame was taken at {table.time[far[0]]:.6g} s "
            f"(the sequence lasts from {time[0]:.6g} to {time[-1]:.6g} s)"
        )
    return order[nearer]


def _segmented(
    sequence: TrackedSequence,
    poses: Float[np.ndarray, "n 4 4"],
    valid: Bool[np.ndarray, " n"],
    options: ImportOptions,
    notes: list[str],
) -> tuple[Recording, list[str]]:
    """The target looked for in every frame that was tracked, one frame in memory at a time."""
    if sequence.pixels is None:
        raise InputError(
            f"{sequence.source}: holds no pixels: name a file with the target's points as well"
        )
    from jaxcal.data.segmentation.image import localise

    blank = valid & ~sequence.image_valid
    if blank.any():
        notes.append(f"{int(blank.sum())} frames left out: their image was not OK")
    rows = np.flatnonzero(valid & sequence.image_valid)
    found: list[int] = []
    reasons: list[str] = []
    position: list[np.ndarray] = []
    covariance: list[np.ndarray] = []
    search: dict[str, Any] = {"region": options.region}
    for row, frame in zip(
        rows, sequence.images(rows, orientation=options.orientation), strict=True
    ):
        with naming(f"{sequence.source}: frame {row}"):
            located = localise(frame, options.target_kind, **search)
        if located.found[0]:
            found.append(int(row))
            position.append(located.position[0])
            covariance.append(located.covariance[0])
        else:
            reasons.append(located.reason[0].partition(":")[0])
    if len(found) < MINIMUM_IMAGES:
        most = max(set(reasons), key=reasons.count) if reasons else "there are no frames"
        raise InputError(
            f"{sequence.source}: only {len(found)} of {len(rows)} frames show a credible target, "
            f"at least {MINIMUM_IMAGES} are needed (most often: {most})"
        )
    if reasons:
        notes.append(f"{len(reasons)} of {len(rows)} frames left out: no credible target in them")
    used = np.array(found)
    time, said = _time(sequence, used, options)
    images = make_images(
        poses[used], np.array(position), "pixel", covariance=np.array(covariance), time=time,
        spacing_mm=options.spacing_mm, where=sequence.source,
    )  # fmt: skip
    return Recording(images, source=sequence.source), notes + said
