"""Points that were placed in 3D Slicer: markups as ``.mrk.json`` or ``.fcsv``.

Positions come back in RAS, mm, whatever the file's own system: LPS (Slicer's default today) is RAS
with x and y negated.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxcal import FormatError
from jaxcal.io.given_files import naming, one_line, read_bytes
from jaxcal.io.lines import cells_of, text_lines
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

MAXIMUM_BYTES = 16 * 2**20
MOST_POINTS = 100_000

EXTENSIONS = (".json", ".fcsv")
"""Slicer writes points as ``.mrk.json`` or ``.json``, and as ``.fcsv``."""


@dataclass(frozen=True)
class Markups:
    """Points in the order of the file; those that were not placed are left out.

    Attributes:
        positions: (n, 3) RAS, mm.
        labels: what Slicer shows beside each.
        unplaced: how many were left out: not defined, or not selected.
    """

    positions: Float[np.ndarray, "n 3"]
    labels: tuple[str, ...]
    unplaced: int


def read_markups(path: str | os.PathLike[str]) -> Markups:
    """Read a list of points; the file is not trusted.

    Raises:
        FormatError: not such a file, no points, or positions that are not three finite numbers; one
            line with the path and the point.
    """
    name = os.fspath(path)
    with naming(path):
        found = _read_json(path) if name.lower().endswith(".json") else _read_fcsv(path)
    if not len(found.positions):
        raise FormatError(f"{name}: holds no points")
    return found


def _read_json(path: str | os.PathLike[str]) -> Markups:
    content = read_bytes(path, MAXIMUM_BYTES)
    try:
        document: Any = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"is not JSON: {one_line(error)}") from None
    markups = document.get("markups") if isinstance(document, dict) else None
    if not isinstance(markups, list) or not markups:
        raise FormatError("holds no markups: save the points from Slicer as Markups JSON")
    if len(markups) > 1 or not isinstance(markups[0], dict):
        raise FormatError(f"holds {len(markups)} markups; it must hold only one list of points")
    markup = markups[0]
    if markup.get("coordinateUnits", "mm") not in ("mm", ["mm"], "millimeter"):
        raise FormatError(f"coordinateUnits {quoted(str(markup['coordinateUnits']))} are not mm")
    points = markup.get("controlPoints", [])
    if not isinstance(points, list) or len(points) > MOST_POINTS:
        raise FormatError(f"controlPoints must be a list of at most {MOST_POINTS} points")
    sign = _signs(markup.get("coordinateSystem", "LPS"))
    positions, labels = [], []
    for index, point in enumerate(points):
        if not isinstance(point, dict):
            raise FormatError(f"point {index + 1} is not an object")
        if point.get("positionStatus", "defined") != "defined" or point.get("selected") is False:
            continue
        positions.append(sign * _three(point.get("position"), f"point {index + 1}"))
        labels.append(str(point.get("label", "")))
    return _markups(positions, labels, len(points))


def _read_fcsv(path: str | os.PathLike[str]) -> Markups:
    sign, names = _signs("RAS"), list(_FCSV)
    positions, labels, total = [], [], 0
    for line, content in text_lines(path, comments=True):
        if content.startswith("#"):
            key, _, value = content[1:].partition("=")
            if key.strip() == "CoordinateSystem":
                sign = _signs({"0": "RAS", "1": "LPS"}.get(value.strip(), value.strip()))
            elif key.strip() == "columns":
                names = [name.strip() for name in value.split(",")]
            continue
        # Slicer puts a label that has a comma in quotes.
        cells = [cell.strip() for cell in cells_of(f"line {line}", content)]
        if len(cells) < 4 or not {"x", "y", "z"} <= set(names[: len(cells)]):
            raise FormatError(f"line {line}: {len(cells)} columns are no point of Slicer")
        row = dict(zip(names, cells, strict=False))
        total += 1
        if total > MOST_POINTS:
            raise FormatError(f"line {line}: more than {MOST_POINTS} points")
        if row.get("sel", "1") == "0":
            continue
        try:
            numbers = [float(row[axis]) for axis in "xyz"]
        except ValueError:
            raise FormatError(f"line {line}: x, y or z is not a number") from None
        positions.append(sign * _three(numbers, f"line {line}"))
        labels.append(row.get("label", ""))
    return _markups(positions, labels, total)


_FCSV = ("id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label", "desc")


def _markups(positions: list[np.ndarray], labels: list[str], total: int) -> Markups:
    return Markups(np.reshape(positions, (-1, 3)), tuple(labels), total - len(positions))


def _signs(system: object) -> Float[np.ndarray, " 3"]:
    if system not in ("LPS", "RAS"):
        raise FormatError(f"coordinate system {quoted(str(system))} is neither LPS nor RAS")
    return np.array([-1.0, -1.0, 1.0] if system == "LPS" else [1.0, 1.0, 1.0])


def _three(value: object, what: str) -> Float[np.ndarray, " 3"]:
    numbers = value if isinstance(value, list) else []
    real = [part for part in numbers if isinstance(part, int | float)]
    # A whole number of JSON may have more digits than a float can hold.
    finite = all(abs(part) <= sys.float_info.max for part in real)
    if len(numbers) != 3 or len(real) != 3 or not finite:
        raise FormatError(f"{what}: a position is three finite numbers")
    return np.array(real, dtype=np.float64)


def pixels_from_markups(markups: Markups) -> Float[np.ndarray, "n 2"]:
    """[u, v] px of points that were placed on the image itself: spacing 1, origin 0, no transform.

    Whether x and y are u and v or their negatives depends on how the image got into Slicer
    (OpenIGTLink: RAS; a file: LPS). Pixels are not negative, so the signs tell. z is 0.

    Raises:
        FormatError: points off the image's plane, or with coordinates of both signs.
    """
    plane, height = markups.positions[:, :2], markups.positions[:, 2]
    half = 0.5
    off = np.flatnonzero(np.abs(height) > half)
    if len(off):
        raise FormatError(
            f"point {quoted(markups.labels[off[0]])} lies {height[off[0]]:.4g} mm off the image's "
            "plane: place points on the image alone, at z = 0, with no transform above it, and not "
            "on slices of a volume"
        )
    if (plane > -half).all():
        return plane + 0.0
    if (plane < half).all():
        return -plane + 0.0
    raise FormatError(
        "points are not pixels of one image: their x and y have both signs. Place them on the "
        "image alone, with spacing 1 and no transform above it"
    )
