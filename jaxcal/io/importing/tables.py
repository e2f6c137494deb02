"""Tables with poses and points, and the pair of files of the public cross-wire recordings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxcal import InputError
from jaxcal.io.importing.imported import Imported, good_time, naming_pose_units, pixel_size
from jaxcal.io.importing.poses_by_time import PoseTrack
from jaxcal.io.importing.sources import ImportOptions, kind_of, read_rows, refuse, selected
from jaxcal.io.importing.two_tables import one_of_two_tables
from jaxcal.io.table import first_line
from jaxcal.io.text import MATRIX_WIDTHS, PoseTable, read_pair, recording_of, width_without_header

_FEWEST, _LONG_S, _SMALL_STEP = 20, 5.0, 0.25
"""The unit of times is in doubt if so many images are so far apart, but the probe moves from image
to image by less than this share of the distance of images half a recording apart."""


def from_tables(sources: Sequence[str | os.PathLike[str]], options: ImportOptions) -> Imported:
    """The recording of one table, of a table with poses and one with points, or of the pair."""
    if options.poses is not None:
        raise InputError("--poses goes with a sequence or a folder of PNG images")
    kinds = [kind_of(source) for source in sources]
    two = len(sources) == 2 and "markups" not in kinds
    unused = "source", "target", "points", "target_kind", "region", "orientation"
    refuse(options, unused, "does not go with a table of poses and points: it is for sequences")
    options = replace(options, spacing_mm=pixel_size(None, options), spacing_from=None)
    if two and not _is_pair(sources):
        tables = [read_rows(each, options, ignore_time=options.ignore_time) for each in sources]
        return _from_table(*_of_two(tables, options), options)
    refuse(options, ("lag_s",), "is for poses that are matched to images by their times")
    if two:
        if options.units == "mm":
            raise InputError("a pair of text files holds pixels: --units mm does not go with it")
        unused = "quaternion", "skip_invalid", "ignore_time"
        refuse(options, unused, "does not go with a pair of text files, poses and points")
        units, invert = options.pose_units or "mm", options.invert_poses
        table = read_pair(*sources, pose_units=units, invert_poses=invert)
    elif len(sources) != 1 or kinds[0] != "table":
        raise InputError(
            f"{os.fspath(sources[0])}: holds no poses: a sequence, a tracker's export or a table "
            "with poses is needed"
        )
    else:
        table = read_rows(sources[0], options, ignore_time=options.ignore_time)
    table, told = _selected_rows(table, options)
    return _from_table(table, table.notes + told + _unit_in_doubt(table), 0, options)


def _is_pair(sources: Sequence[str | os.PathLike[str]]) -> bool:
    """Whether two text files are matrices without a header and points, and not two tables."""
    of_poses, of_points = (first_line(source)[1] for source in sources)
    if not (of_poses or of_points):
        return True
    width = width_without_header(sources[0])
    # Rows R t may follow a comment that reads like a header.
    return width == 4 or (width in MATRIX_WIDTHS and not of_poses)


def _of_two(given: Sequence[PoseTable], options: ImportOptions) -> tuple[PoseTable, list[str], int]:
    """Poses and points of two tables as one (:func:`one_of_two_tables`), of the selected frames."""
    tables, told, in_order = [], [], True
    for table in given:
        named = table.frame is not None or table.file is not None or table.time is not None
        # Rows that belong together by their order are selected later: that needs all of them.
        if named and table.poses is None:
            in_order = False
            table, told = _selected_rows(table, options)
        tables.append(table)
    table, notes, lost = one_of_two_tables(*tables, lag_s=options.lag_s)
    if in_order:
        table, told = _selected_rows(table, options)
    return table, notes + told, lost


def _selected_rows(table: PoseTable, options: ImportOptions) -> tuple[PoseTable, list[str]]:
    """The rows of a table that are used, by their frames, else by their places; and a note."""
    numbers = np.array(table.rows) if table.frame is None else table.frame
    chosen, told = selected(numbers, options, table.name)
    return (table.of(np.flatnonzero(chosen)) if told else table), told


def _unit_in_doubt(table: PoseTable) -> list[str]:
    """A note if a probe that moves on has images many s apart; no lag would be found in them."""
    if table.time is None or table.poses is None or table.time_stated or len(table) < _FEWEST:
        return []
    interval_s = np.median(np.diff(table.time))
    if interval_s < _LONG_S:
        return []
    at = table.poses[:, :3, 3]
    step = np.median(np.linalg.norm(np.diff(at, axis=0), axis=1))
    apart = np.median(np.linalg.norm(at - np.roll(at, len(at) // 2, axis=0), axis=1))
    if step > _SMALL_STEP * apart:
        return []
    return [
        f"images of {table.name} are {interval_s:.3g} s apart if times are in s (no header "
        "states their unit), and the probe hardly moves between them: are they in ms, us or ns? "
        "Name the column time [ms], [us], [ns] or [s]"
    ]


def _from_table(table: PoseTable, notes: list[str], lost: int, options: ImportOptions) -> Imported:
    """The recording of a table with poses and points; ``lost`` further points have no pose."""
    if table.time is None and options.ignore_time:
        notes = [*notes, "time stamps are missing or cannot be read: not kept"]
    if table.time is not None:
        time, said = good_time(table.time, lambda row: f"{table.name}:{table.lines[row]}", options)
        table, notes = replace(table, time=time), notes + said
        poses = table.poses
        if poses is not None and time is not None and len(time) > 1 and table.velocity is None:
            track = PoseTrack(time, poses, np.ones(len(time), bool), table.name)
            table = replace(table, velocity=track.velocities(time))
    with naming_pose_units(options, table.length_stated):
        recording = recording_of(table, options.spacing_mm, options.minimum)
    return Imported(recording, notes, most_lost=len(table) < lost)
