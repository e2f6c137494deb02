"""Which frames of a sequence the points of another file belong to."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from jaxcal import InputError
from jaxcal.data.names import Assignment
from jaxcal.io.folder import first_repeated, rows_by_name
from jaxcal.io.given_files import naming
from jaxcal.io.importing.poses_by_time import times_of_table
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.slicer import pixels_from_markups, read_markups
from jaxcal.io.text import PoseTable
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.messages import counted, quoted, seconds

_SLACK = 0.5
"""A point belongs to the frame nearest in time, within this part of the median interval."""


class FramePoints(NamedTuple):
    """Points and the frames that they are in.

    Attributes:
        rows: (m,) places of the frames in the sequence, none twice.
        points: (m, 2): [u, v] px, or [lateral, range] mm.
        kind: of the points.
        notes: what was left out, in words.
        covariance: (m, 2, 2) of the points, in their unit squared, or None.
    """

    rows: Int[np.ndarray, " m"]
    points: Float[np.ndarray, "m 2"]
    kind: Literal["pixel", "point"]
    notes: list[str]
    covariance: Float[np.ndarray, "m 2 2"] | None = None

    def of(self, selected: Bool[np.ndarray, " n"]) -> FramePoints:
        """Those in selected ones of all n frames."""
        kept = selected[self.rows]
        covariance = None if self.covariance is None else self.covariance[kept]
        return self._replace(rows=self.rows[kept], points=self.points[kept], covariance=covariance)


def points_of_markups(
    source: str | os.PathLike[str], sequence: TrackedSequence, assignment: Assignment | None
) -> FramePoints:
    """Points placed in Slicer.

    Raises:
        InputError: a list that cannot be read, a point in no frame, or two points in the same one.
    """
    name = os.fspath(source)
    markups = read_markups(source)
    with naming(source):
        pixels = pixels_from_markups(markups)
        rows = _rows_of_markups(markups.labels, sequence, assignment)
    unplaced = counted(markups.unplaced, "point", "was", "were")
    notes = [f"{name}: {unplaced} not placed"] if markups.unplaced else []
    as_placed = assignment == "labels" and np.array_equal(rows, np.arange(1, len(rows) + 1))
    if as_placed and sequence.numbers is None:
        notes.append(
            f"{name}: labels end in 1 to {len(rows)}, as Slicer numbers points by itself: were "
            "they placed in these frames? (the first of a sequence is 0)"
        )
    return FramePoints(_distinct(rows, sequence, name), pixels, "pixel", notes)


def points_of_table(
    table: PoseTable, sequence: TrackedSequence, assignment: Assignment | None
) -> FramePoints:
    """Points of a table, by frame, by time, or in order.

    Raises:
        InputError: no points, or poses beside them; a point in no frame, or two points in the same
            one.
    """
    if table.points is None:
        raise InputError(f"{table.name}: holds no points (columns u and v, or lateral and range)")
    if table.poses is not None:
        raise InputError(
            f"{table.name}: holds poses as well as points: import it by itself, without images, or "
            "leave its poses out"
        )
    if assignment == "labels":
        raise InputError(f"{table.name}: holds no labels: --points labels is for points of Slicer")
    named = "frame" if table.frame is not None else "file" if sequence.files and table.file else ""
    if assignment == "order" and named:
        raise InputError(f"{table.name}: has a column {named}: leave --points order out")
    with naming(table.name):
        rows = _rows_of_table(table, sequence, assignment)
    rows = _distinct(rows, sequence, table.name)
    return FramePoints(rows, table.points, table.kind, table.notes)


def _distinct(
    rows: Int[np.ndarray, " m"], sequence: TrackedSequence, name: str
) -> Int[np.ndarray, " m"]:
    if (twice := first_repeated(rows)) is not None:
        raise InputError(f"{name}: {sequence.frame_name(twice)} has more than one point")
    return rows


def _in_order(count: int, sequence: TrackedSequence) -> Int[np.ndarray, " m"]:
    if count != len(sequence):
        raise InputError(f"{count} points, but the sequence has {len(sequence)} frames")
    return np.arange(count)


def _rows_of_markups(
    labels: Sequence[str], sequence: TrackedSequence, assignment: Assignment | None
) -> Int[np.ndarray, " m"]:
    if assignment is None:
        raise InputError(
            "say how points belong to frames: --points labels (each label ends in a frame's "
            "number) or --points order (one point for each frame)"
        )
    if assignment == "order":
        return _in_order(len(labels), sequence)
    rows = []
    for index, label in enumerate(labels):
        digits = label[len(label.rstrip("0123456789")) :]
        if not digits or len(digits) > 9:
            raise InputError(
                f"point {index + 1}: its label {quoted(label)} does not end in a frame's number"
            )
        rows.append(int(digits))
    places = [f"point {index + 1}" for index in range(len(rows))]
    return sequence.rows_of(np.array(rows, dtype=np.int64), places)


def _rows_of_table(
    table: PoseTable, sequence: TrackedSequence, assignment: Assignment | None
) -> Int[np.ndarray, " m"]:
    if (rows := rows_by_name(sequence, table)) is not None:
        return rows
    if assignment == "order":
        return _in_order(len(table), sequence)
    if table.time is not None:
        return _nearest_in_time(table, sequence)
    if len(table) == len(sequence):
        return _in_order(len(table), sequence)
    raise InputError(
        "has neither a column frame nor a column time: which frames are the points in?"
    )


def _nearest_in_time(table: PoseTable, sequence: TrackedSequence) -> Int[np.ndarray, " m"]:
    timed = np.flatnonzero(np.isfinite(sequence.time))
    unknown = len(sequence) - len(timed)
    untimed = f"{unknown} of {len(sequence)} frames of {sequence.source} have no time stamp"
    if len(timed) < 2:
        raise InputError(
            f"its points cannot be matched by time: {untimed} (name frames in a column frame, or "
            "say --points order if there is one point for each frame)"
        )
    asked = times_of_table(table, sequence)
    order = timed[np.argsort(sequence.time[timed], kind="stable")]
    time = sequence.time[order]
    # From one frame to the next, also across frames without a time stamp.
    slack = _SLACK * float(np.median(np.diff(time) / np.abs(np.diff(order))))
    after = np.clip(np.searchsorted(time, asked), 1, len(time) - 1)
    nearer = after - (asked - time[after - 1] < time[after] - asked)
    far = np.flatnonzero(np.abs(time[nearer] - asked) > slack)
    if len(far):
        raise InputError(
            f"line {table.lines[int(far[0])]}: no frame was taken at {seconds(asked[int(far[0])])} "
            f"(the sequence lasts from {seconds(time[0])} to {seconds(time[-1])}"
            + (f"; {untimed}: name frames in a column frame)" if unknown else ")")
        )
    return order[nearer]
