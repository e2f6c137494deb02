"""What trackers' own programs export: NDI ToolBox CSV and OptiTrack Motive CSV.

In both, columns are found by their names, never by their numbers. Every tool becomes a transform
from the tool to ``Tracker``.
"""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxcal import FormatError
from jaxcal.data.names import LengthUnit
from jaxcal.data.poses import matrices_from_rotations, rotations_from_quaternions
from jaxcal.io.frame_names import FramePair
from jaxcal.io.given_files import naming
from jaxcal.io.lines import cells_of, text_lines
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.table import ABSENT, parse_number
from jaxcal.runtime.messages import quoted

TRACKER = "Tracker"
_BEGINNING = re.compile(r"(Tools|Format Version)\s*[,;\t]")
MOST_POSES = 1_000_000
"""Of all tools in all rows."""
_UNITS: dict[str, LengthUnit] = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
"""What Motive calls them."""


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
    rows = ((line, cells_of(f"line {line}", content)) for line, content in text_lines(path))
    with naming(path):
        line, first = next(rows, (1, [""]))
        if first[0].strip() == "Tools":
            found = _read_ndi(line, [cell.strip() for cell in first], rows)
            return replace(found.scaled(pose_units or "mm"), source=os.fspath(path))
        if first[0].strip() == "Format Version":
            found = _read_motive(first, rows, pose_units)
            return replace(found, source=os.fspath(path), length_stated=True)
        raise FormatError(
            "is no export of NDI ToolBox or Motive with commas between cells: if a spreadsheet "
            "program saved it, import the original file of the tracker's program"
        )


class _Tool(NamedTuple):
    """Columns of one tool; ``state`` says OK where it was seen, ``counter`` counts its frames."""

    quaternion: list[int]
    position: list[int]
    state: int | None = None
    counter: int | None = None


Rows = Iterator[tuple[int, list[str]]]
"""Numbers and cells of lines."""


def _read_rows(
    rows: Rows, tools: dict[str, _Tool], stamp: int | None, counters: list[int]
) -> TrackedSequence:
    """The poses of all tools, in the file's unit, with times from the column ``stamp``.

    ``counters`` are the columns of the frame's number where no tool that was seen has its own.
    """
    poses: dict[str, list[list[float]]] = {tool: [] for tool in tools}
    time: list[float] = []
    numbers: list[int] = []
    labels: list[str] = []
    for line, cells in rows:
        if (len(time) + 1) * len(tools) > MOST_POSES:
            raise FormatError(f"line {line}: more than {MOST_POSES} poses of {len(tools)} tools")
        own: list[int] = []
        for tool, columns in tools.items():
            pose = [math.nan] * 7
            if columns.state is None or _cell(cells, columns.state) == "OK":
                quaternion = _numbers(cells, columns.quaternion, line)
                position = _numbers(cells, columns.position, line)
                if quaternion is not None and position is not None:
                    pose = quaternion + position
                # The counter of a tool that is not seen may stand still.
                own += [] if columns.counter is None else [columns.counter]
            poses[tool].append(pose)
        numbers.append(_frame_number(cells, own or counters))
        at = None if stamp is None else _numbers(cells, [stamp], line)
        time.append(math.nan if at is None else at[0])
        labels.append(f"in line {line}")
    if not time:
        raise FormatError("holds no rows")
    transforms: dict[FramePair, np.ndarray] = {}
    valid: dict[FramePair, np.ndarray] = {}
    for tool, found in poses.items():
        values = np.array(found)
        good = ~np.isnan(values[:, 0])
        values[~good, :4] = 0.0, 0.0, 0.0, 1.0
        rotations = rotations_from_quaternions(values[:, :4], "xyzw", labels=labels)
        matrices = matrices_from_rotations(rotations, values[:, 4:])
        matrices[~good] = np.nan
        transforms[tool, TRACKER], valid[tool, TRACKER] = matrices, good
    no_images = np.zeros(len(time), bool)
    return TrackedSequence(transforms, valid, np.array(time), no_images, numbers=np.array(numbers))


def _cell(cells: list[str], column: int) -> str:
    return cells[column].strip() if column < len(cells) else ""


def _numbers(cells: list[str], columns: list[int], line: int) -> list[float] | None:
    """Numbers of some cells; None where one is blank or NDI's mark of a missing number."""
    values: list[float] = []
    for column in columns:
        text = _cell(cells, column)
        if not text:
            return None
        value = parse_number(text)
        if value is None:
            raise FormatError(f"line {line}: column {column + 1} is not a number: {quoted(text)}")
        if not math.isfinite(value) or value < ABSENT:
            return None
        values.append(value)
    return values


def _frame_number(cells: list[str], columns: list[int]) -> int:
    """The frame's number, where all these columns that hold one agree; else -1."""
    found = {_cell(cells, column) for column in columns} - {""}
    text = found.pop() if len(found) == 1 else ""
    return int(text) if re.fullmatch(r"\d{1,18}", text) else -1


def _read_ndi(line: int, header: list[str], rows: Rows) -> TrackedSequence:
    """NDI ToolBox: one row a frame; a group of columns a tool, which begins with "Port ..."."""
    starts = [index for index, cell in enumerate(header) if cell.startswith("Port")]
    if not starts:
        raise FormatError(f"line {line}: the header names no port")
    tools: dict[str, _Tool] = {}
    first: dict[str, int] = {}
    for start, end in itertools.pairwise([*starts, len(header)]):
        columns: dict[str, int] = {}
        for index in range(start + 1, end):
            # State, Tx, Ty and Tz come again for every marker: the first ones are the tool's.
            columns.setdefault(header[index], index)
        first = first or columns
        missing = {"State", "Q0", "Qx", "Qy", "Qz", "Tx", "Ty", "Tz"} - set(columns)
        if missing:
            raise FormatError(f"line {line}: {quoted(header[start])} has no {sorted(missing)[0]}")
        tools[_tool_name(header[start], set(tools))] = _Tool(
            [columns[key] for key in ("Qx", "Qy", "Qz", "Q0")],
            [columns[key] for key in ("Tx", "Ty", "Tz")],
            columns["State"],
            columns.get("Frame"),
        )
    stamps = [index for index, cell in enumerate(header) if cell == "Time [sec]"]
    stamp = first.get("Time [sec]", next(iter(stamps), None))
    counters = [tool.counter for tool in tools.values() if tool.counter is not None]
    return _read_rows(rows, tools, stamp, counters)


def _tool_name(cell: str, taken: set[str]) -> str:
    """The tool in ``Port 0x01: JJH Probe  s/n:3E4C880C``; a bare port keeps its name."""
    _, colon, rest = cell.partition(":")
    words = re.sub(r"\s*s/n:.*$", "", rest).strip() if colon else ""
    name = words or cell.strip()
    return name if name not in taken else cell.strip()


def _read_motive(first: list[str], rows: Rows, pose_units: LengthUnit | None) -> TrackedSequence:
    """Motive: key,value pairs; rows Type, Name, ID, Parent; what a column is; its axis; data."""
    # Not by pairs of cells: the take's name may have commas.
    stated = dict(itertools.pairwise(cell.strip() for cell in first))
    rotation = stated.get("Rotation Type", "Quaternion")
    if rotation != "Quaternion":
        raise FormatError(
            f"rotations are exported as {quoted(rotation)}: export quaternions from Motive"
        )
    unit = stated.get("Length Units", "").lower()
    if unit not in _UNITS:
        raise FormatError(f"Length Units {quoted(unit)} are not known")
    if pose_units not in (None, _UNITS[unit]):
        raise FormatError(f"its Length Units are {unit}, not {pose_units}: leave --pose-units out")
    names: list[str] = []
    types: list[str] = []
    what: list[str] = []
    for line, row in rows:
        cells = [cell.strip() for cell in row]
        label = cells[1] if len(cells) > 1 and not cells[0] else cells[0]
        if label == "Type":
            types = cells
        elif label == "Name":
            names = cells
        elif label == "Frame":
            tools = _motive_tools(list(zip(types, names, what, cells, strict=False)), line)
            stamps = [index for index, cell in enumerate(cells) if cell.startswith("Time (")]
            counters = [index for index, cell in enumerate(cells) if cell == "Frame"]
            stamp = next(iter(stamps), None)
            return _read_rows(rows, tools, stamp, counters).scaled(_UNITS[unit])
        elif "Rotation" in cells or "Position" in cells:
            what = cells
    raise FormatError("has no row that begins with Frame: not a whole export of Motive")


def _motive_tools(header: list[tuple[str, str, str, str]], line: int) -> dict[str, _Tool]:
    """Rigid bodies by type, name, quantity and axis of every column."""
    columns: dict[str, dict[tuple[str, str], int]] = {}
    for index, (kind, tool, what, axis) in enumerate(header):
        if kind == "Rigid Body" and what in ("Rotation", "Position"):
            columns.setdefault(tool, {})[what, axis.upper()] = index
    quaternion = [("Rotation", axis) for axis in "XYZW"]
    position = [("Position", axis) for axis in "XYZ"]
    for tool, found in columns.items():
        for key in quaternion + position:
            if key not in found:
                raise FormatError(f"line {line}: {quoted(tool)} has no {' '.join(key)}")
    if not columns:
        raise FormatError(f"line {line}: names no rigid body")
    return {
        tool: _Tool([found[key] for key in quaternion], [found[key] for key in position])
        for tool, found in columns.items()
    }
