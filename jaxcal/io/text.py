"""Poses and points as text: tables with or without a header, and the cross-wire pair of files.

Blank lines and lines that start with ``#`` are skipped. A file is UTF-8 (or ASCII) of at most
64 MiB. :mod:`jaxcal.io.columns` has the names that headers may use.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Literal

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.names import LengthUnit, PointUnit, QuaternionOrder
from jaxcal.data.poses import (
    check_poses,
    inverse_poses,
    matrices_from_rotations,
    rotations_from_quaternions,
)
from jaxcal.data.recording import MINIMUM_IMAGES, Recording, make_images
from jaxcal.io.columns import CONVERT, LENGTHS_MM, Columns, columns_of_header
from jaxcal.io.given_files import naming
from jaxcal.io.lines import text_lines
from jaxcal.io.table import ABSENT, Table, first_line, parse_numbers, read_table
from jaxcal.runtime.array_types import Float, Int
from jaxcal.runtime.messages import counted, quoted, runs_in_words

_LATEST_S = 1e11
"""Latest time, s after any beginning: three thousand years. Stamps in ms or ns are beyond it."""
MATRIX_WIDTHS = (4, 12, 16)
"""Columns of poses without a header: 3 or 4 rows for each, or the matrix row by row."""
_MOST_NAMED = 20
"""Largest number of rows that are named."""

_MISSING = frozenset(("", "nan", "inf", "infinity", "na", "n/a", "null", "none"))
_TRUE = frozenset(("1", "1.0", "true", "yes", "ok", "valid", "good", "tracked"))
_FALSE = {"", "0", "0.0", "false", "no", "invalid", "missing", "bad", "lost"}
_FALSE |= {"out_of_view", "out of view", "out_of_volume", "partially out of volume"}
_FALSE |= {"too few markers", "req_timeout"}


@dataclass(frozen=True)
class PoseTable:
    """What a table holds, row by row; None for what it does not have.

    Attributes:
        name: of the file.
        lines: (n,) where each row stands.
        rows: (n,) which row of the table each is, counted from 0 without header and comments.
        poses: (n, 4, 4), mm, rotations projected to SO(3).
        points: (n, 2): [u, v] px, or [lateral, range] mm.
        kind: of the points.
        time: (n,) s.
        clock: the date from which times count; None where they are numbers.
        velocity: (n, 6) mm/s and rad/s, of the probe at these times, if poses were looked up.
        frame: (n,) number of the image.
        file: n names of images' files.
        skipped: the rows of the table that were left out as invalid.
        length_stated: whether the header states the unit of translations.
        time_stated: whether times are dates, or the header states their unit.
        not_read: names of columns of a ROS message that were not read.
    """

    name: str
    lines: list[int]
    rows: list[int]
    poses: Float[np.ndarray, "n 4 4"] | None = None
    points: Float[np.ndarray, "n 2"] | None = None
    kind: Literal["pixel", "point"] = "pixel"
    time: Float[np.ndarray, " n"] | None = None
    clock: datetime | None = None
    velocity: Float[np.ndarray, "n 6"] | None = None
    frame: Int[np.ndarray, " n"] | None = None
    file: tuple[str, ...] | None = None
    skipped: tuple[int, ...] = ()
    length_stated: bool = False
    time_stated: bool = False
    not_read: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def file_names(self) -> list[str] | None:
        """Names of the images' files, without folders."""
        return None if self.file is None else [re.split(r"[/\\]", name)[-1] for name in self.file]

    def of(self, kept: Int[np.ndarray, " m"]) -> PoseTable:
        """Some of its rows."""
        chosen = {
            name: None if (values := getattr(self, name)) is None else values[kept]
            for name in ("poses", "points", "time", "velocity", "frame")
        }
        return replace(
            self,
            lines=[self.lines[row] for row in kept],
            rows=[self.rows[row] for row in kept],
            file=None if self.file is None else tuple(self.file[row] for row in kept),
            **chosen,
        )

    @property
    def notes(self) -> list[str]:
        """What was left out, in words."""
        said = []
        if self.not_read:
            columns = ", ".join(map(quoted, self.not_read))
            said.append(f"{self.name}: columns that are not read: {columns}")
        if self.skipped:
            rows = counted(len(self.skipped), "invalid row")
            numbers = runs_in_words(self.skipped, _MOST_NAMED)
            said.append(f"{self.name}: {rows} left out ({numbers}, counted from 0)")
        return said


def read_pose_table(
    path: str | os.PathLike[str],
    *,
    quaternion: QuaternionOrder | None = None,
    pose_units: LengthUnit | None = None,
    units: PointUnit | None = None,
    skip_invalid: bool = False,
    invert_poses: bool = False,
    ignore_time: bool = False,
) -> PoseTable:
    """Read a table of poses, points or both.

    Args:
        path: with a header, columns in any order and units as it says. Without one, columns are
            time (s), a pose (12 or 16 numbers row by row, or x y z and a quaternion), u and v.
        quaternion: where the scalar stands. It is never guessed: it is needed where columns are
            not named.
        pose_units: of translations; mm if neither this nor the header states it.
        units: of u and v, where the header does not say; px by default.
        skip_invalid: leave out rows that a column ``valid`` or ``status`` marks as invalid, and
            rows with empty cells, NaN, Inf or a pose of zeros; otherwise they are errors.
        invert_poses: those of the file are tracker -> probe; their inverses are returned.
        ignore_time: times that are missing or cannot be read are no errors: the table has none.

    Raises:
        FormatError: a file, a header or a row that cannot be read; file and line are named.
        InputError: poses that are no rigid transforms; the line is named.
    """
    table = read_table(path)
    with naming(path):
        columns = _columns(table, quaternion)
        if quaternion is not None and columns.matrix is not None:
            raise FormatError("its poses are matrices: leave --quaternion out")
        needed = replace(columns, time=None, nanoseconds=None) if ignore_time else columns
        rows, skipped = _used_rows(table, needed, skip_invalid)
        if units is not None and columns.point_unit not in (None, units):
            raise FormatError(
                f"the header says that points are in {columns.point_unit}, not {units}"
            )
        unit = columns.point_unit or units or "px"
        points = None if columns.point is None else table.numbers(columns.point, rows)
        if points is not None and unit != "px":
            points *= LENGTHS_MM[unit]
        try:
            time, clock = _times(table, columns, rows)
        except FormatError:
            if not ignore_time:
                raise
            time, clock = None, None
        frame = None if columns.frame is None else _whole_numbers(table, columns.frame, rows)
        file = None
        if columns.file is not None:
            file = tuple(table.rows[row][columns.file].strip().strip('"') for row in rows)
        poses = _poses(table, columns, rows, pose_units)
        return PoseTable(
            name=table.name,
            lines=[table.lines[row] for row in rows],
            rows=rows,
            poses=inverse_poses(poses) if invert_poses and poses is not None else poses,
            points=points,
            kind="pixel" if unit == "px" else "point",
            time=time,
            clock=clock,
            frame=frame,
            file=file,
            skipped=skipped,
            length_stated=columns.length_mm is not None,
            time_stated=clock is not None or columns.time_s is not None,
            not_read=columns.not_read,
        )


def recording_of(
    table: PoseTable,
    spacing_mm: np.ndarray | tuple[float, float] | None = None,
    minimum: int = MINIMUM_IMAGES,
) -> Recording:
    """The recording of a table that has poses and points.

    Raises:
        InputError: poses or points missing, or images that cannot be used.
    """
    if table.poses is None or table.points is None:
        missing = "poses" if table.poses is None else "points (u and v, or lateral and range)"
        raise InputError(f"{table.name}: holds no {missing}: name the file that has them as well")
    frame = table.frame
    if frame is None and table.rows != list(range(len(table))):
        # A person looks for an image by its row.
        frame = np.array(table.rows)
    images = make_images(
        table.poses,
        table.points,
        table.kind,
        time=table.time,
        velocity=table.velocity,
        spacing_mm=spacing_mm,
        frame=frame,
        minimum=minimum,
        where=table.name,
    )
    return Recording(images, source=table.name)


def read_pair(
    transforms_path: str | os.PathLike[str],
    points_path: str | os.PathLike[str],
    *,
    pose_units: LengthUnit = "mm",
    invert_poses: bool = False,
) -> PoseTable:
    """Read a text file of poses without a header and one of pixels, as of cross-wire recordings.

    Args:
        transforms_path: 3 rows ``R_i0 R_i1 R_i2 t_i`` for each image, i = 0, 1, 2: probe ->
            tracker. The row 0 0 0 1 may follow in all images. Or a row of 12 or 16 numbers for each
            image, the matrix row by row.
        points_path: a row ``u v`` for each image: lateral and axial, px. A header may name the two
            columns, and no others.
        pose_units: of translations in the file.
        invert_poses: those of the file are tracker -> probe; their inverses are taken.

    Returns:
        Poses as they stand, with their points in pixels.

    Raises:
        FormatError: a file that cannot be read, a row of another length, something that is not a
            number, rows that do not make whole poses, a header of the points that names more than
            u and v, or files of different lengths; the file and the line are named.
        InputError: poses that are to be inverted and are no rigid transforms.
    """
    transforms = _plain_table(transforms_path)
    columns = "3 rotation numbers and a translation, or a matrix row by row; points come second"
    poses, _ = _stacked(transforms, _fixed(transforms, MATRIX_WIDTHS, columns))
    pixels = _pixels_in_order(points_path, transforms.name)
    name = f"{transforms.name} with {os.fspath(points_path)}"
    if len(poses) != len(pixels):
        raise FormatError(
            f"{name}: {len(poses)} poses but {len(pixels)} points: each image has one pose "
            "(3 rows R t, or 1 row with the whole matrix) and one point (1 row)"
        )
    poses[:, :3, 3] *= LENGTHS_MM[pose_units]
    if invert_poses:
        with naming(transforms_path):
            poses = inverse_poses(check_poses(poses))
    rows = list(range(len(pixels)))
    return PoseTable(name=name, lines=rows, rows=rows, poses=poses, points=pixels)


def read_crosswire(
    transforms_path: str | os.PathLike[str],
    points_path: str | os.PathLike[str],
    *,
    spacing_mm: np.ndarray | tuple[float, float] | None = None,
    pose_units: LengthUnit = "mm",
) -> Recording:
    """The recording of :func:`read_pair`; ``spacing_mm`` is [lateral, axial] mm per px, if known.

    Raises:
        InputError: what :func:`read_pair` or :func:`recording_of` refuses.
    """
    return recording_of(read_pair(transforms_path, points_path, pose_units=pose_units), spacing_mm)


def read_poses(
    path: str | os.PathLike[str],
    *,
    quaternion: QuaternionOrder | None = None,
    pose_units: LengthUnit = "mm",
    invert_poses: bool = False,
) -> Float[np.ndarray, "n 4 4"]:
    """Read a table of poses without a header.

    Args:
        path: a row for each pose, of 7 numbers, ``x y z`` and a unit quaternion, or of 12 or 16,
            the matrix row by row; or 3 or 4 rows of 4 numbers, as in :func:`read_pair`.
        quaternion: where the scalar stands; needed for rows of 7 numbers, and refused for others.
        pose_units: of translations in the file.
        invert_poses: return the inverses of the file's poses.

    Returns:
        (n, 4, 4), mm; quaternions are normalised, other rotations as they stand.

    Raises:
        FormatError: a file that cannot be read, a row of another length, something that is not a
            number, a quaternion whose order is not stated or whose length is not 1, or what is to
            be inverted and is no pose; the file and the line are named.
    """
    table = _plain_table(path)
    columns = "x y z and a quaternion, a matrix row by row, or 3 rows R t"
    rows = _fixed(table, (7, *MATRIX_WIDTHS), columns, finite=False)
    lines = table.lines
    with naming(path):
        try:
            if rows.shape[1] != 7:
                if quaternion is not None:
                    raise FormatError("its poses are matrices: leave --quaternion out")
                poses, lines = _stacked(table, rows)
            elif quaternion is None:
                raise _order_unknown(table)
            else:
                turns = rotations_from_quaternions(rows[:, 3:], quaternion, labels=_labels(lines))
                poses = matrices_from_rotations(turns, rows[:, :3])
            poses[:, :3, 3] *= LENGTHS_MM[pose_units]
            if invert_poses:
                # The inverse of what is no pose may look like one.
                poses = inverse_poses(check_poses(poses, labels=_labels(lines)))
            return poses
        except InputError as error:
            raise FormatError(str(error)) from None


def width_without_header(path: str | os.PathLike[str]) -> int:
    """How many numbers the first row of a text file has; 0 where it is not numbers alone."""
    table = _plain_table(path)
    numbers = parse_numbers(table.rows[0], decimal_comma=table.separator != ",")
    return 0 if None in numbers else len(numbers)


def _pixels_in_order(path: str | os.PathLike[str], poses: str) -> Float[np.ndarray, "n 2"]:
    """Rows u and v that belong to the poses in a file without a header, in their order."""
    if not first_line(path)[1]:
        return _fixed(_plain_table(path), (2,), "u and v")
    table = read_table(path)
    with naming(path):
        columns = columns_of_header(table.header or [], None)
        both = f"{poses} has no header: give it one that names its columns as well"
        if columns.point is None or len(table.header or []) > len(columns.point):
            raise FormatError(
                f"its header names other columns than u and v, but {both}; or keep u and v alone, "
                "one point for each pose in the same order"
            )
        if columns.point_unit not in (None, "px"):
            raise FormatError(
                f"its header says that points are in {columns.point_unit}, but {both}"
            )
        return table.numbers(columns.point)


def _plain_table(path: str | os.PathLike[str]) -> Table:
    """A table without a header; blanks or tabs may separate numbers with decimal commas."""
    _, first = next(text_lines(path), (0, ""))
    cells = parse_numbers(first.split(), decimal_comma=True)
    white_space = len(cells) > 1 and None not in cells
    return read_table(path, header=False, separator="" if white_space else None)


def _stacked(
    table: Table, rows: Float[np.ndarray, "rows columns"]
) -> tuple[Float[np.ndarray, "n 4 4"], list[int]]:
    """Matrices from rows of 12, 16 or 4 numbers, and the line of each.

    Raises:
        FormatError: rows of 4 numbers that are not whole poses.
    """
    if rows.shape[1] != 4:
        return _with_last_row(rows.reshape(len(rows), -1, 4)), table.lines
    matrices = rows.reshape(-1, 4, 4) if len(rows) % 4 == 0 else np.empty((0, 4, 4))
    edge = [0, 0, 0, 1]
    # Whole matrices: no row of a rotation is zero.
    if len(matrices) and (matrices[:, 3] == edge).all():
        return matrices, table.lines[::4]
    if len(matrices) and (matrices[:, :, 3] == edge).all():
        raise FormatError(
            f"{table.row(3)}: the matrices are transposed: 0 0 0 1 is their last column, and "
            "should be their last row"
        )
    if len(rows) % 3:
        raise FormatError(
            f"{table.row(-1)}: {len(rows)} rows are not whole poses: each takes 3 rows"
        )
    return _with_last_row(rows.reshape(-1, 3, 4)), table.lines[::3]


def _with_last_row(matrices: Float[np.ndarray, "n k 4"]) -> Float[np.ndarray, "n 4 4"]:
    whole = np.tile(np.eye(4), (len(matrices), 1, 1))
    whole[:, : matrices.shape[1]] = matrices
    return whole


def _labels(lines: list[int]) -> list[str]:
    return [f"in line {line}" for line in lines]


def _fixed(
    table: Table, widths: tuple[int, ...], columns: str, *, finite: bool = True
) -> Float[np.ndarray, "rows columns"]:
    """All numbers of a table that has no header."""
    width = len(table.rows[0])
    if width not in widths:
        hint = f"; {CONVERT}" if width == 6 else ""
        raise FormatError(
            f"{table.row(0)}: {width} columns; {' or '.join(map(str, widths))} are needed "
            f"({columns}){hint}"
        )
    return table.numbers(tuple(range(width)), finite=finite)


def _columns(table: Table, quaternion: QuaternionOrder | None) -> Columns:
    if table.header is not None:
        return columns_of_header(table.header, quaternion)
    width = len(table.rows[0])
    if width in (15, 19):
        matrix = tuple(range(1, width - 2))
        return Columns(matrix=matrix, time=0, point=(width - 2, width - 1))
    if width != 10:
        hint = ", or a first line that names the columns"
        if width in (2, 3):
            names = "u,v" if width == 2 else "frame,u,v"
            hint = f" (name {width} columns of points by a first line {names})"
        if width in MATRIX_WIDTHS:
            hint = " (poses alone are the first of two files: POSES POINTS OUT.h5)"
        raise FormatError(
            f"{table.row(0)}: {width} columns without a header; 15 or 19 (time, 12 or 16 "
            f"pose numbers, u and v) or 10 (time, x, y, z, a quaternion, u and v) are needed{hint}"
        )
    if quaternion is None:
        raise _order_unknown(table)
    order = (5, 6, 7, 4) if quaternion == "wxyz" else (4, 5, 6, 7)
    return Columns(translation=(1, 2, 3), quaternion=order, time=0, point=(8, 9))


def _order_unknown(table: Table) -> FormatError:
    return FormatError(
        f"{table.row(0)}: {len(table.rows[0])} columns hold a quaternion: say whether its scalar "
        "comes first or last (--quaternion wxyz or xyzw)"
    )


def _used_rows(
    table: Table, columns: Columns, skip_invalid: bool
) -> tuple[list[int], tuple[int, ...]]:
    """Rows to use, and those that are left out as invalid."""
    needed = [
        *(columns.matrix or ()),
        *(columns.translation or ()),
        *(columns.quaternion or ()),
        *(columns.point or ()),
        *(each for each in (columns.time, columns.nanoseconds) if each is not None),
    ]
    pose, comma = columns.quaternion or columns.matrix or (), table.separator != ","
    kept: list[int] = []
    skipped: list[int] = []
    for row, cells in enumerate(table.rows):
        missing = _first_missing(cells, needed)
        if columns.valid is not None and not _is_valid(table, row, columns.valid):
            why = f"the row is marked as invalid ({quoted(cells[columns.valid])})"
        elif missing is not None:
            why = f"{table.column(missing)} is {quoted(cells[missing])[1:-1] or 'empty'}"
        elif _not_seen(parse_numbers([cells[k] for k in pose], decimal_comma=comma)):
            why = "the rotation is all zeros or -3.7e28, as of a tool that was not seen"
        else:
            kept.append(row)
            continue
        if not skip_invalid:
            raise FormatError(f"{table.row(row)}: {why}: leave such rows out with --skip-invalid")
        skipped.append(row)
    if not kept:
        raise FormatError(f"all {len(table.rows)} rows are marked as invalid")
    return kept, tuple(skipped)


def _not_seen(rotation: list[float | None]) -> bool:
    return set(rotation) == {0.0} or any(each is not None and each < ABSENT for each in rotation)


def _first_missing(cells: list[str], columns: list[int]) -> int | None:
    """The first of the columns whose cell holds no number, as programs mark it; None: all do."""
    for column in columns:
        cell = cells[column]
        if cell.startswith("#") or cell.lower().lstrip("+-") in _MISSING:
            return column
    return None


def _is_valid(table: Table, row: int, column: int) -> bool:
    text = table.rows[row][column].strip().lower()
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    raise FormatError(
        f"{table.row(row)}: column {column + 1} is neither OK nor INVALID (nor 1, 0, true, false): "
        f"{quoted(text)}"
    )


def _poses(
    table: Table, columns: Columns, rows: list[int], pose_units: LengthUnit | None
) -> Float[np.ndarray, "n 4 4"] | None:
    stated = None if pose_units is None else LENGTHS_MM[pose_units]
    if stated is not None and columns.length_mm not in (None, stated):
        raise FormatError(f"the header's unit of translations is not {pose_units}")
    factor = columns.length_mm or stated or 1.0
    labels = _labels([table.lines[row] for row in rows])
    if columns.matrix is not None:
        matrices = table.numbers(columns.matrix, rows).reshape(len(rows), -1, 4)
        matrices[:, :3, 3] *= factor
        return check_poses(matrices, labels=labels)
    if columns.translation is None or columns.quaternion is None:
        return None
    translations = table.numbers(columns.translation, rows) * factor
    quaternions = table.numbers(columns.quaternion, rows)
    turns = rotations_from_quaternions(quaternions, "xyzw", labels=labels)
    return matrices_from_rotations(turns, translations)


def _whole_numbers(table: Table, column: int, rows: list[int]) -> Int[np.ndarray, " n"]:
    values = table.numbers((column,), rows)[:, 0]
    bad = np.flatnonzero((values != np.round(values)) | (values < 0) | (values > 1e9))
    if len(bad):
        row = rows[int(bad[0])]
        raise FormatError(
            f"{table.row(row)}: column {column + 1} is not the number of an image: "
            f"{quoted(table.rows[row][column])}"
        )
    return values.astype(np.int64)


def _times(
    table: Table, columns: Columns, rows: list[int]
) -> tuple[Float[np.ndarray, " n"] | None, datetime | None]:
    """Seconds, and for dates by ISO 8601 the first one, from which they count."""
    column = columns.time
    if column is None:
        return None, None
    dates = [_date(table.rows[row][column]) for row in rows]
    if dates[0] is None:
        if ":" in table.rows[rows[0]][column]:
            raise FormatError(
                f"{table.row(rows[0])}: {table.column(column)} is neither seconds nor a date by "
                f"ISO 8601 (2026-11-26T08:15:00): {quoted(table.rows[rows[0]][column])}"
            )
        time = table.numbers((column,), rows)[:, 0] * (columns.time_s or 1.0)
        if columns.nanoseconds is not None:
            time += 1e-9 * table.numbers((columns.nanoseconds,), rows)[:, 0]
        late = np.flatnonzero(np.abs(time) > _LATEST_S)
        if len(late):
            raise FormatError(
                f"{table.row(rows[late[0]])}: {table.column(column)} is {time[late[0]]:.3g} s, in "
                "the distant future: state its unit in the header: time [ms], [us] or [ns]"
            )
        return time, None
    values = []
    for row, date in zip(rows, dates, strict=True):
        if date is None or (date.tzinfo is None) != (dates[0].tzinfo is None):
            raise FormatError(
                f"{table.row(row)}: column {column + 1} is not a date like those before: "
                f"{quoted(table.rows[row][column])}"
            )
        values.append((date - dates[0]).total_seconds())
    return np.array(values), dates[0]


def _date(text: str) -> datetime | None:
    if "-" not in text or ":" not in text:
        return None
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        return None
