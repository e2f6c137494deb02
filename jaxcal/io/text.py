"""Recordings as text: the cross-wire pair of files, and comma-separated tables.

Blank lines and lines that start with ``#`` are skipped; numbers have a decimal point. A file is
UTF-8 (or ASCII) of at most 64 MiB.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxcal.errors import FormatError, InputError
from jaxcal.io.readable import check_readable, one_line, quoted
from jaxcal.recording import Recording, make_images

MAXIMUM_BYTES = 64 * 2**20
"""Largest text file that is read."""

_QUATERNION_TOLERANCE = 1e-2


def read_crosswire(
    transforms_path: str | os.PathLike[str],
    points_path: str | os.PathLike[str],
    *,
    spacing_mm: np.ndarray | tuple[float, float] | None = None,
) -> Recording:
    """Read a cross-wire recording: a text file of poses and one of pixels.

    Args:
        transforms_path: 3 rows ``R_i0 R_i1 R_i2 t_i`` for each image, i = 0, 1, 2: probe ->
            tracker, mm; separated by white space. The row 0 0 0 1 is left out.
        points_path: a row ``u v`` for each image: lateral and axial, px.
        spacing_mm: [lateral, axial] mm per px, when known.

    Returns:
        Images of kind ``pixel``; rotations are projected to SO(3).

    Raises:
        FormatError: a file that cannot be read, a row of another length, something that is not a
            number, rows that do not make whole poses, or files of different lengths; the file and
            the line are named.
        InputError: poses or pixels that cannot be used (see :func:`jaxcal.recording.make_images`).
    """
    rows, lines = _table(transforms_path, None, (4,), "3 rotation numbers and a translation")
    if len(rows) % 3:
        raise FormatError(
            f"{os.fspath(transforms_path)}:{lines[-1]}: {len(rows)} rows are not whole poses: each "
            "takes 3 rows"
        )
    pixels, _ = _table(points_path, None, (2,), "u and v")
    name = f"{os.fspath(transforms_path)} with {os.fspath(points_path)}"
    if len(rows) // 3 != len(pixels):
        raise FormatError(f"{name}: {len(rows) // 3} poses but {len(pixels)} points")
    images = make_images(rows.reshape(-1, 3, 4), pixels, "pixel", spacing_mm=spacing_mm, where=name)
    return Recording(images, source=name)


def read_csv(
    path: str | os.PathLike[str],
    *,
    spacing_mm: np.ndarray | tuple[float, float] | None = None,
    units: Literal["px", "mm"] = "px",
) -> Recording:
    """Read a table with a row ``time, pose, u, v`` for each image.

    Args:
        path: comma-separated columns: time (s); the pose, probe -> tracker, mm, row by row, 12
            numbers (without the row 0 0 0 1) or 16; u and v. One header line may come first.
        spacing_mm: [lateral, axial] mm per px, when known; pixels only.
        units: of u and v: "px" (lateral and axial pixel) or "mm" (lateral and range).

    Returns:
        Images of kind ``pixel`` or ``point`` with their times; rotations are projected to SO(3).

    Raises:
        FormatError: a file that cannot be read, a row of another length, something that is not a
            number; the file and the line are named.
        InputError: units other than these, or images that cannot be used (see
            :func:`jaxcal.recording.make_images`).
    """
    if units not in ("px", "mm"):
        raise InputError(f"units must be px or mm, not {quoted(str(units))}")
    rows, _ = _table(path, ",", (15, 19), "time, 12 or 16 pose numbers, u and v", header=True)
    images = make_images(
        rows[:, 1:-2].reshape(len(rows), -1, 4),
        rows[:, -2:],
        "pixel" if units == "px" else "point",
        time=rows[:, 0],
        spacing_mm=spacing_mm,
        where=os.fspath(path),
    )
    return Recording(images, source=os.fspath(path))


def read_poses(path: str | os.PathLike[str]) -> Float[np.ndarray, "n 4 4"]:
    """Read a text file of poses, one a row, separated by white space.

    Args:
        path: rows of 7 numbers, ``x y z qx qy qz qs`` (mm and a unit quaternion, scalar last), or
            of 12 or 16, the matrix row by row.

    Returns:
        (n, 4, 4), mm; quaternions are normalised, other rotations as they stand.

    Raises:
        FormatError: a file that cannot be read, a row of another length, something that is not a
            number, or a quaternion whose length is not 1; the file and the line are named.
    """
    rows, lines = _table(path, None, (7, 12, 16), "x y z qx qy qz qs, or a matrix row by row")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows.shape[1] != 7:
        matrices = rows.reshape(len(rows), -1, 4)
        poses[:, : matrices.shape[1]] = matrices
        return poses
    length = np.linalg.norm(rows[:, 3:], axis=1)
    off = np.flatnonzero(~(np.abs(length - 1) < _QUATERNION_TOLERANCE))
    if len(off):
        raise FormatError(
            f"{os.fspath(path)}:{lines[off[0]]}: the quaternion's length is {length[off[0]]:g}, "
            "not 1"
        )
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 3:]).as_matrix()
    poses[:, :3, 3] = rows[:, :3]
    return poses


def _table(
    path: str | os.PathLike[str],
    separator: str | None,
    widths: tuple[int, ...],
    columns: str,
    *,
    header: bool = False,
) -> tuple[Float[np.ndarray, "rows columns"], list[int]]:
    """A file's numbers, every row as long as the first, and the line that each row stands in."""
    name = os.fspath(path)
    rows: list[list[float]] = []
    lines: list[int] = []
    for line, content in _lines(path):
        fields = [field.strip() for field in content.split(separator)]
        values = [_number(field) for field in fields]
        # A line without any number is a header; one with some is a row with a slip in it.
        if header and not rows and all(value is None for value in values):
            header = False
            continue
        if len(fields) not in (widths if not rows else (len(rows[0]),)):
            needed = " or ".join(map(str, widths)) if not rows else f"{len(rows[0])} as before"
            separated = "by commas" if separator else "by white space"
            raise FormatError(
                f"{name}:{line}: {len(fields)} columns; {needed} are needed ({columns}, separated "
                f"{separated})"
            )
        row = [value for value in values if value is not None]
        if len(row) < len(values):
            column = values.index(None)
            raise FormatError(
                f"{name}:{line}: column {column + 1} is not a number: {quoted(fields[column])}"
            )
        rows.append(row)
        lines.append(line)
    if not rows:
        raise FormatError(f"{name}: holds no rows of numbers")
    return np.array(rows, dtype=np.float64), lines


def _lines(path: str | os.PathLike[str]) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file, without blank lines and comments."""
    name = os.fspath(path)
    check_readable(path, maximum_bytes=MAXIMUM_BYTES)
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise FormatError(f"{name}: cannot be read: {one_line(error)}") from None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise FormatError(f"{name}:{line}: is not text (UTF-8)") from None
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise FormatError(f"{name}:{line}: is not text (UTF-8): it holds a zero byte")
    del content
    # Not splitlines: it also breaks at form feeds and the like, and then no editor's numbers match.
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line


def _number(field: str) -> float | None:
    # float() takes 1_000, which no program that writes tables means.
    if "_" in field:
        return None
    try:
        return float(field)
    except ValueError:
        return None
