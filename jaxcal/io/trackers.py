"""What trackers' own programs export: NDI ToolBox CSV and OptiTrack Motive CSV.

In both, columns are found by their names, never by their numbers. Every tool becomes a transform
from the tool to ``Tracker``.
"""

from __future__ import annotations

import csv
import itertools
import math
import os
import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from jaxcal import FormatError
from jaxcal.data.poses import rotations_from_quaternions
from jaxcal.io.columns import LENGTHS_MM, LengthUnit
from jaxcal.io.frame_names import FramePair
from jaxcal.io.lines import text_lines
from jaxcal.io.readable import naming
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.table import parse_number
from jaxcal.runtime.messages import quoted

TRACKER = "Tracker"
_BEGINNING = re.compile(r"(Tools|Format Version)\s*[,;\t]")
MOST_ROWS = 1_000_000
_ABSENT = -1e20
"""A number below this is missing: NDI writes -3.697314E28 in its place."""
_METRES = {"meters": 1e3, "centimeters": 10.0, "millimeters": 1.0}


def is_tracker_export(path: str | os.PathLike[str]) -> bool:
    """Whether a text file begins like an export of NDI ToolBox or Motive."""
    _, first = next(text_lines(path), (0, ""))
    return _BEGINNING.match(first) is not None


def read_tracker(
    path: str | os.PathLike[str], pose_units: LengthUnit | None = None
) -> TrackedSequence:
    """Read an export of NDI ToolBox or of Motive; the file is not trusted.

    Args:
        path: of the file.
        pose_units: of translations; NDI's file does not state them, and mm is the default.

    Returns:
        Transforms, mm, by (tool, ``Tracker``), valid where the tool was seen. Frames have the
        numbers of the file's column Frame.

    Raises:
        FormatError: neither of the two, a row that cannot be read, or another unit than the file
            states; file and line are named.
    """
    name = os.fspath(path)
    rows = ((line, next(csv.reader([content]))) for line, content in text_lines(path))
    with naming(path):
        line, first = next(rows, (1, [""]))
        if first[0].strip() == "Tools":
            found = _read_ndi(line, [cell.strip() for cell in first], rows, name)
            return found.scaled(pose_units or "mm")
        if first[0].strip() == "Format Version":
            return replace(_read_motive(first, rows, name, pose_units), length_stated=True)
        raise FormatError(
            "is no export of NDI ToolBox or Motive with commas between cells: if a spreadsheet "
            "has saved it anew, import the file that the tracker's program wrote"
        )


class _Tool:
    """Poses of one tool, collected row by row."""

    def __init__(self) -> None:
        self.quaternions: list[list[float]] = []
        self.positions: list[list[float]] = []
        self.valid: list[bool] = []

    def add(self, quaternion: list[float] | None, position: list[float] | None) -> None:
        good = quaternion is not None and position is not None
        self.quaternions.append(quaternion if quaternion and good else [0.0, 0.0, 0.0, 1.0])
        self.positions.append(position if position and good else [0.0, 0.0, 0.0])
        self.valid.append(good)


def _sequence(
    tools: dict[str, _Tool],
    time: list[float],
    numbers: list[int],
    lines: list[int],
    factor: float,
    name: str,
) -> TrackedSequence:
    if not time:
        raise FormatError("holds no rows")
    transforms: dict[FramePair, np.ndarray] = {}
    valid: dict[FramePair, np.ndarray] = {}
    labels = [f"in line {line}" for line in lines]
    for tool, found in tools.items():
        poses = np.tile(np.eye(4), (len(time), 1, 1))
        poses[:, :3, :3] = rotations_from_quaternions(
            np.array(found.quaternions), "xyzw", labels=labels
        )
        poses[:, :3, 3] = factor * np.array(found.positions)
        good = np.array(found.valid)
        poses[~good] = np.nan
        transforms[tool, TRACKER], valid[tool, TRACKER] = poses, good
    return TrackedSequence(
        transforms,
        valid,
        np.array(time),
        np.zeros(len(time), bool),
        source=name,
        numbers=np.array(numbers),
    )


def _numbers(cells: list[str], columns: list[int], line: int) -> list[float] | None:
    """Numbers of some cells; None where one is blank or NDI's mark of a missing number."""
    values: list[float] = []
    for column in columns:
        text = cells[column].strip() if column < len(cells) else ""
        if not text:
            return None
        value = parse_number(text)
        if value is None:
            raise FormatError(f"line {line}: column {column + 1} is not a number: {quoted(text)}")
        if not math.isfinite(value) or value < _ABSENT:
            return None
        values.append(value)
    return values


def _frame_number(cells: list[str], columns: list[int]) -> int:
    """The frame's number, where all these columns that hold one agree; else -1."""
    found = {cells[column].strip() for column in columns if column < len(cells)} - {""}
    text = found.pop() if len(found) == 1 else ""
    return int(text) if re.fullmatch(r"\d{1,18}", text) else -1


# NDI ToolBox: one row a frame; a group of columns for each tool, which begins with "Port ...".


def _read_ndi(
    line: int, header: list[str], rows: Iterator[tuple[int, list[str]]], name: str
) -> TrackedSequence:
    starts = [index for index, cell in enumerate(header) if cell.startswith("Port")]
    if not starts:
        raise FormatError(f"line {line}: the header names no port")
    tools: dict[str, _Tool] = {}
    groups: list[tuple[_Tool, dict[str, int]]] = []
    for start, end in zip(starts, [*starts[1:], len(header)], strict=True):
        columns: dict[str, int] = {}
        for index in range(start + 1, end):
            # State, Tx, Ty and Tz come again for every marker: the first ones are the tool's.
            columns.setdefault(header[index], index)
        missing = {"State", "Q0", "Qx", "Qy", "Qz", "Tx", "Ty", "Tz"} - set(columns)
        if missing:
            raise FormatError(f"line {line}: {quoted(header[start])} has no {sorted(missing)[0]}")
        tool = _Tool()
        tools[_tool_name(header[start], set(tools))] = tool
        groups.append((tool, columns))
    time: list[float] = []
    numbers: list[int] = []
    lines: list[int] = []
    first = groups[0][1]
    for number, cells in rows:
        if len(time) >= MOST_ROWS:
            raise FormatError(f"line {number}: more than {MOST_ROWS} rows")
        counters: list[int] = []
        for tool, columns in groups:
            state = columns["State"]
            seen = state < len(cells) and cells[state].strip() == "OK"
            quaternion = [columns[key] for key in ("Qx", "Qy", "Qz", "Q0")]
            position = [columns[key] for key in ("Tx", "Ty", "Tz")]
            tool.add(
                _numbers(cells, quaternion, number) if seen else None,
                _numbers(cells, position, number) if seen else None,
            )
            # The counter of a tool that is not seen may stand still.
            counters += [columns["Frame"]] if seen and "Frame" in columns else []
        every = [columns["Frame"] for _, columns in groups if "Frame" in columns]
        numbers.append(_frame_number(cells, counters or every))
        stamp = None
        if "Time [sec]" in first:
            stamp = _numbers(cells, [first["Time [sec]"]], number)
        elif "Time [sec]" in header:
            stamp = _numbers(cells, [header.index("Time [sec]")], number)
        time.append(math.nan if stamp is None else stamp[0])
        lines.append(number)
    return _sequence(tools, time, numbers, lines, 1.0, name)


def _tool_name(cell: str, taken: set[str]) -> str:
    """The tool in ``Port 0x01: JJH Probe  s/n:3E4C880C``; a bare port keeps its name."""
    _, colon, rest = cell.partition(":")
    words = re.sub(r"\s*s/n:.*$", "", rest).strip() if colon else ""
    name = words or cell.strip()
    return name if name not in taken else cell.strip()


# Motive: key,value pairs; rows Type, Name, ID, Parent; what a column is; its axis; then data.


def _read_motive(
    first: list[str],
    rows: Iterator[tuple[int, list[str]]],
    name: str,
    pose_units: LengthUnit | None,
) -> TrackedSequence:
    cells = [cell.strip() for cell in first]
    # Not by pairs of cells: the take's name may have commas.
    stated = dict(itertools.pairwise(cells))
    rotation = stated.get("Rotation Type", "Quaternion")
    if rotation != "Quaternion":
        raise FormatError(
            f"rotations are exported as {quoted(rotation)}: export quaternions from Motive"
        )
    unit = stated.get("Length Units", "").lower()
    if unit not in _METRES:
        raise FormatError(f"Length Units {quoted(unit)} are not known")
    if pose_units is not None and LENGTHS_MM[pose_units] != _METRES[unit]:
        raise FormatError(f"its Length Units are {unit}, not {pose_units}: leave --pose-units out")
    names: list[str] = []
    types: list[str] = []
    what: list[str] = []
    for line, cells in rows:
        label = cells[1].strip() if len(cells) > 1 and not cells[0].strip() else cells[0].strip()
        if label == "Type":
            types = cells
        elif label == "Name":
            names = cells
        elif label == "Frame":
            return _motive_rows(types, names, what, cells, line, rows, _METRES[unit], name)
        elif "Rotation" in cells or "Position" in cells:
            what = cells
    raise FormatError("has no row that begins with Frame: not a whole export of Motive")


def _motive_rows(
    types: list[str],
    names: list[str],
    what: list[str],
    axes: list[str],
    line: int,
    rows: Iterator[tuple[int, list[str]]],
    factor: float,
    name: str,
) -> TrackedSequence:
    columns: dict[str, dict[tuple[str, str], int]] = {}
    for index in range(min(map(len, (types, names, what, axes)))):
        if types[index].strip() == "Rigid Body" and what[index].strip() in ("Rotation", "Position"):
            key = what[index].strip(), axes[index].strip().upper()
            columns.setdefault(names[index].strip(), {})[key] = index
    wanted = [("Rotation", axis) for axis in "XYZW"], [("Position", axis) for axis in "XYZ"]
    for tool, found in columns.items():
        for key in (*wanted[0], *wanted[1]):
            if key not in found:
                raise FormatError(f"line {line}: {quoted(tool)} has no {' '.join(key)}")
    if not columns:
        raise FormatError(f"line {line}: names no rigid body")
    stamps = [index for index, cell in enumerate(axes) if cell.strip().startswith("Time (")]
    counters = [index for index, cell in enumerate(axes) if cell.strip() == "Frame"]
    tools = {tool: _Tool() for tool in columns}
    time: list[float] = []
    numbers: list[int] = []
    lines: list[int] = []
    for number, cells in rows:
        if len(time) >= MOST_ROWS:
            raise FormatError(f"line {number}: more than {MOST_ROWS} rows")
        for tool, found in columns.items():
            quaternion, position = ([found[key] for key in part] for part in wanted)
            tools[tool].add(_numbers(cells, quaternion, number), _numbers(cells, position, number))
        numbers.append(_frame_number(cells, counters))
        stamp = _numbers(cells, stamps[:1], number) if stamps else None
        time.append(math.nan if stamp is None else stamp[0])
        lines.append(number)
    return _sequence(tools, time, numbers, lines, factor, name)
