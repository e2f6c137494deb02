"""Poses of a sequence's frames: from its own file or from another, and between which frames."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import inverse_poses
from jaxcal.io.folder import PROBE_TO_TRACKER, with_pose_table
from jaxcal.io.frame_names import FramePair, capitalised
from jaxcal.io.importing.poses_by_time import times_of_table, with_poses_by_time
from jaxcal.io.importing.sources import ImportOptions, kind_of, read_rows, read_tracked, refuse
from jaxcal.io.sequence import FolderPixels, TrackedSequence
from jaxcal.io.table import first_line
from jaxcal.io.text import PoseTable, read_poses
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.messages import quoted


def open_sequence(
    source: str | os.PathLike[str], options: ImportOptions
) -> tuple[TrackedSequence, list[str]]:
    """A sequence of any kind with the poses that belong to it, and notes for the user.

    Raises:
        InputError: files that cannot be read or do not belong together; one line.
    """
    if not options.poses_in_table:
        refuse(options, ("quaternion", "skip_invalid"), "is for tables, but no table is read")
    sequence, tracking, notes = opened(source, options)
    if tracking is None:
        return sequence, notes
    if options.lag_s == "auto":
        raise InputError("--lag auto is estimated from points: it is an option of jaxcal import")
    merged, said = with_poses_by_time(sequence, tracking, options.lag_s)
    return merged, notes + said


def opened(
    source: str | os.PathLike[str], options: ImportOptions
) -> tuple[TrackedSequence, TrackedSequence | None, list[str]]:
    """A sequence, and another with the poses alone, if they are to be matched to it by time."""
    if options.poses is None:
        sequence = read_tracked(source, options.pose_units)
        if not options.lag_s:
            return sequence, None, []
        if isinstance(sequence.pixels, FolderPixels):
            refuse(options, ("lag_s",), "needs --poses: a folder of images has no poses")
        return sequence, *_one_tool(sequence, options)
    sequence = read_tracked(source)
    of_table = kind_of(options.poses) == "table"
    if of_table:
        why = f"does not go with a table of poses, {options.poses}: they are from probe to tracker"
        refuse(options, ("source", "target"), why)
    if isinstance(sequence.pixels, FolderPixels):
        if not of_table:
            raise InputError(
                f"{options.poses}: the poses of a folder of images come from a table with columns "
                "file or frame"
            )
        refuse(options, ("lag_s",), "is for poses that are matched by time, not to a folder")
        table = read_rows(options.poses, options, ignore_time=options.ignore_time)
        merged, notes = with_pose_table(sequence, table)
        return merged, None, notes
    if of_table:
        table = read_rows(options.poses, options)
        return sequence, tracking_of_table(table, sequence), table.notes
    return sequence, *_one_tool(read_tracked(options.poses, options.pose_units), options)


def _one_tool(
    sequence: TrackedSequence, options: ImportOptions
) -> tuple[TrackedSequence, list[str]]:
    """A sequence's poses between the frames that are asked for, and what was assumed."""
    start, end, notes = _frames(sequence, options)
    poses, valid = sequence.poses(start, end)
    poses = inverse_poses(poses) if options.invert_poses else poses
    pair = start, end
    return replace(sequence, transforms={pair: poses}, valid={pair: valid}, pixels=None), notes


def tracking_of_table(table: PoseTable, images: TrackedSequence) -> TrackedSequence:
    """The poses of a table, with their times on the clock of the images.

    Raises:
        InputError: no times or no poses, or another clock.
    """
    if table.poses is None or table.time is None:
        raise InputError(f"{table.name}: needs columns of times and of poses")
    return TrackedSequence(
        {PROBE_TO_TRACKER: table.poses},
        {PROBE_TO_TRACKER: np.ones(len(table), bool)},
        times_of_table(table, images),
        np.zeros(len(table), bool),
        source=table.name,
        length_stated=table.length_stated,
        time_stated=table.time_stated,
    )


def tracked_poses(
    sequence: TrackedSequence,
    options: ImportOptions,
    selected: Bool[np.ndarray, " n"] | None = None,
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"], FramePair, list[str]]:
    """Poses of a sequence, where they can be used, their frames, and what was assumed and left out.

    Frames that are not ``selected`` are not counted.

    Raises:
        InputError: no way between the frames, or no frame with tracking.
    """
    if options.by_time:
        # The assumptions were noted, and poses inverted, when the poses were matched.
        (start, end), notes = next(iter(sequence.transforms)), []
    else:
        start, end, notes = _frames(sequence, options)
    poses, valid = sequence.poses(start, end)
    if options.invert_poses and not options.by_time:
        poses = inverse_poses(poses)
    wanted = np.ones(len(sequence), bool) if selected is None else selected
    lost, count = int((wanted & ~valid).sum()), int(wanted.sum())
    if lost and not options.by_time:
        notes.append(f"{lost} of {count} frames left out: their tracking was not OK")
    if lost == count:
        which = "no frame" if count == len(sequence) else "no frame that is used"
        raise InputError(f"{sequence.source}: {which} has tracking from {start} to {end}")
    return poses, valid, (start, end), notes


def tool_poses(
    source: str | os.PathLike[str], options: ImportOptions
) -> tuple[Float[np.ndarray, "n 4 4"], list[str]]:
    """Poses of a tracked tool, mm, from a sequence, a tracker's export or a table; and notes.

    Of a sequence, the tool is the stylus if none is named and one was tracked.

    Raises:
        InputError: a file that cannot be read or holds no poses, or an option that is not used.
    """
    kind = kind_of(source)
    if kind in ("sequence", "tracker", "scan"):
        refuse(options, ("quaternion", "skip_invalid"), "is for tables, but no table is read")
        sequence = read_tracked(source, options.pose_units)
        tracked = "Stylus" in sequence.frames()
        named = options.source is not None
        chosen = options if named or not tracked else replace(options, source="Stylus")
        poses, valid, _, notes = tracked_poses(sequence, chosen)
        if not (named or tracked):
            notes.append(f"{sequence.source}: no Stylus was tracked, so another tool was taken")
        return poses[valid], notes
    if kind != "table":
        raise InputError(f"{os.fspath(source)}: holds no poses of a tool")
    refuse(options, ("source", "target"), "is for sequences and trackers' exports, not for a table")
    if not first_line(source)[1]:
        refuse(options, ("skip_invalid",), "is for tables with a header")
        poses = read_poses(
            source,
            quaternion=options.quaternion,
            pose_units=options.pose_units or "mm",
            invert_poses=options.invert_poses,
        )
        return poses, []
    table = read_rows(source, options, ignore_time=True)
    if table.poses is None:
        raise InputError(f"{table.name}: holds no poses")
    return table.poses, table.notes


def frames_to_show(
    sequence: TrackedSequence, options: ImportOptions, every: int = 1
) -> tuple[list[int], tuple[int, int], list[str]]:
    """Frames in which a person is to place points: every n-th of those that can be used.

    Without any transforms every image can be used.

    Returns:
        Numbers of the frames, their columns and rows, and what was left out, in words.

    Raises:
        InputError: no pixels, or no frame that can be used.
    """
    if sequence.pixels is None:
        raise InputError(f"{sequence.source}: holds no pixels, only transforms")
    usable, notes = sequence.image_valid, []
    if sequence.transforms:
        _, valid, _, notes = tracked_poses(sequence, options)
        usable = usable & valid
    if not usable.any():
        raise InputError(f"{sequence.source}: no frame can be used")
    shown = [int(number) for number in np.flatnonzero(usable)[::every]]
    return shown, (sequence.pixels.columns, sequence.pixels.rows), notes


def _frames(sequence: TrackedSequence, options: ImportOptions) -> tuple[str, str, list[str]]:
    """The frames of the poses, and what was assumed about them and about statuses."""
    start, end, notes = _chosen_frames(sequence, options)
    if sequence.without_status:
        names = ", ".join("To".join(pair) for pair in sequence.without_status)
        notes.append(
            f"{sequence.source}: {names} without a status is taken as OK (PLUS refuses such frames)"
        )
    return start, end, notes


def _chosen_frames(sequence: TrackedSequence, options: ImportOptions) -> tuple[str, str, list[str]]:
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
            f"{sequence.source}: name the tracked frame on the probe or tool (--from); there are "
            f"{', '.join(map(quoted, tools or names))}"
        )
    start = start if start in names else capitalised(start)
    if options.target is not None:
        end = options.target if options.target in names else capitalised(options.target)
        return start, end, []
    of_reference = [pair for pair in pairs if set(pair) == set(resting)]
    tracked = [pair for pair in of_reference if sequence.valid[pair].any()]
    lost = ""
    if tracked and start != "Reference":
        end = "Reference"
    else:
        ends = [target for source, target in pairs if source == start]
        ends += [source for source, target in pairs if target == start and source in resting]
        end = next(iter(ends), "Tracker")
        if of_reference and not tracked and start != "Reference":
            lost = "; the tracking of Reference was OK in no frame"
    inverted = (end, start) in pairs and (start, end) not in pairs
    how = f", inverted from {end} to {start}" if inverted else ""
    tip = ""
    for pair in pairs:
        of_stylus = "Stylus" in pair and start != "Stylus" and not set(resting).isdisjoint(pair)
        if of_stylus and 2 * sequence.valid[pair].sum() > len(sequence):
            tip = "; --to Stylus if its tip is the target"
    told = f"poses from {start} to {end}{how} (--from and --to choose others{tip}){lost}"
    return start, end, [told]
