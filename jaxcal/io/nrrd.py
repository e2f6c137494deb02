"""NRRD sequences: ``.igs.nrrd`` and ``.seq.nrrd``."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from jaxcal import FormatError
from jaxcal.io.columns import TIMES_S
from jaxcal.io.pixel_stream import Packing
from jaxcal.io.sequence import Pixels, TrackedSequence
from jaxcal.io.sequence_header import (
    SequenceHeader,
    check_count,
    checked_pixels,
    header_lines,
    orientation_and_kind,
    sequence_of,
    stated_pixel_size,
    whole_numbers,
    written_orientation,
)
from jaxcal.runtime.messages import quoted

_AS_ONE = ": only pixels that follow the header are read (save both as one file, .nrrd)"
_NRRD_TYPES = {
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i1": ("char", "signed char", "int8", "int8_t"),
    "i2": ("short", "short int", "signed short", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "uint16", "uint16_t"),
    "f4": ("float",),
    "f8": ("double",),
}
_DTYPES = {name: np.dtype(dtype) for dtype, names in _NRRD_TYPES.items() for name in names}


def read_nrrd(path: Path) -> TrackedSequence:
    """Read a header; neither its errors nor the sequence name the file."""
    header = SequenceHeader()
    for line, text, end in header_lines(path):
        if line == 1:
            if not text.startswith("NRRD00"):
                raise FormatError("is not an NRRD file")
            continue
        if not text:
            header.end = end
            break
        if text.startswith("#"):
            continue
        own, found, value = text.partition(": ")
        key, pair, other = text.partition(":=")
        if pair and (not found or len(key) <= len(own)):
            header.take(key.strip(), other.strip(), line)
        elif found:
            header.take(own.strip().lower(), value.strip(), line)
        else:
            raise FormatError(f"line {line} is not a field: {quoted(text)}")
    fields = header.fields
    if not header.end:
        raise FormatError(f"its pixels are in another file{_AS_ONE}")
    for key in ("data file", "datafile", "line skip", "lineskip", "byte skip", "byteskip"):
        if key in fields:
            raise FormatError(f"has {quoted(key)}{_AS_ONE}")
    columns, rows, channels, count = _nrrd_size(fields)
    check_count(count, header)
    pixels = None
    if columns > 1 and rows > 1:
        pixels = _nrrd_pixels(path, header, (columns, rows, channels), count)
    found = sequence_of(header, count, pixels, "Status")
    if not np.isfinite(found.time).any() and (time := _index_times(fields, count)) is not None:
        return replace(found, time=time)
    return found


def _index_times(fields: dict[str, str], count: int) -> np.ndarray | None:
    """Times, s, that 3D Slicer gives to the images of a volume sequence; None if there are none.

    Slicer calls them values of the index of the axis that lists the images. An index may also be
    something else than time: it counts only if its unit or its name says so.
    """
    axis = 0 if fields.get("kinds", "").startswith("list") else len(fields["sizes"].split()) - 1
    values = fields.get(f"axis {axis} index values", fields.get("axis 0 index values"))
    if values is None:
        return None
    unit, label = (_of_axis(fields.get(name, ""), axis) for name in ("units", "labels"))
    factor = TIMES_S.get(unit)
    if factor is None and not (unit == "" and label.lower() == "time"):
        return None
    try:
        time = np.array([float(each) for each in unquote(values).split()])
    except ValueError:
        raise FormatError(f"index values {quoted(values)} are not numbers") from None
    if len(time) != count or not np.isfinite(time).all():
        raise FormatError(f"has {len(time)} index values for {count} images, or not all are finite")
    return time * (factor or 1.0)


def _of_axis(texts: str, axis: int) -> str:
    """One axis' text in a field of quoted texts, or nothing."""
    found = re.findall(r'"([^"]*)"', texts)
    return found[axis] if axis < len(found) else ""


def _nrrd_size(fields: dict[str, str]) -> tuple[int, int, int, int]:
    """Columns, rows, channels and frames, from sizes and kinds."""
    sizes = whole_numbers(fields.get("sizes", ""), "sizes")
    kinds = ["domain" if kind == "space" else kind for kind in fields.get("kinds", "").split()]
    if not kinds:
        kinds = ["domain", "domain", "list"][: len(sizes)]
    if len(kinds) != len(sizes) or len(sizes) > 5:
        raise FormatError(f"has {len(sizes)} sizes, but {len(kinds)} kinds")
    plane = [size for size, kind in zip(sizes, kinds, strict=True) if kind == "domain"]
    listed = [size for size, kind in zip(sizes, kinds, strict=True) if kind in ("list", "time")]
    others = kinds[0] in ("vector", "RGB-color", "RGBA-color", "3-color", "4-color")
    if kinds[0] == "list":
        kinds = [*kinds[1:], "list"]
    regular = kinds[others:] == ["domain"] * len(plane) + kinds[len(kinds) - len(listed) :]
    # Without a list axis the third one counts the frames.
    if len(plane) == 3 and not listed:
        plane, listed = plane[:2], plane[2:]
    if len(plane) == 3 and plane[2] == 1:
        plane = plane[:2]
    if len(plane) != 2 or len(listed) > 1 or not regular:
        raise FormatError(
            f"sizes {quoted(fields['sizes'])} of kinds {quoted(fields.get('kinds', ''))} are no "
            "sequence of plane images"
        )
    return plane[0], plane[1], sizes[0] if others else 1, listed[0] if listed else 1


def _nrrd_pixels(
    path: Path, header: SequenceHeader, size: tuple[int, int, int], count: int
) -> Pixels:
    fields = header.fields
    kind = fields.get("type", "").lower()
    if kind not in _DTYPES:
        raise FormatError(f"type {quoted(kind)} is not read")
    encoding = fields.get("encoding", "raw").lower()
    packings: dict[str, Packing] = {"raw": "raw", "gz": "gzip", "gzip": "gzip"}
    if encoding not in packings:
        raise FormatError(f"encoding {quoted(encoding)} is not read: write raw or gzip")
    order = ">" if fields.get("endian", "little").lower() == "big" else "<"
    columns, rows, channels = size
    return checked_pixels(
        Pixels(
            path,
            header.end,
            packings[encoding],
            columns,
            rows,
            channels,
            _DTYPES[kind].newbyteorder(order),
            *orientation_and_kind(
                _either(fields, "ultrasound image orientation"),
                _either(fields, "ultrasound image type"),
            ),
            # As Slicer documents its volume sequences; it may also list frames along the last axis.
            interleaved=fields.get("kinds", "").startswith("list"),
            stated_mm=stated_pixel_size(_axes(fields)),
        ),
        count,
    )


def _either(fields: dict[str, str], name: str) -> str:
    """A field as PLUS names it in NRRD, or else in MetaImage; nothing where it is missing."""
    as_one_word = "".join(word.capitalize() for word in name.split())
    return fields.get(name, fields.get(as_one_word, ""))


def _axes(fields: dict[str, str]) -> list[str]:
    """Directions or spacings of the axes that have them, the plane's first."""
    if "space directions" in fields:
        return re.findall(r"\(([^)]*)\)", fields["space directions"])
    return [each for each in fields.get("spacings", "").split() if each.lower() != "nan"]


def nrrd_header(stack: np.ndarray, orientation: str, compressed: bool) -> list[str]:
    """The lines of a header before the fields of frames."""
    colour = stack.ndim == 4
    sizes = f"{stack.shape[2]} {stack.shape[1]} {stack.shape[0]}"
    return [
        "NRRD0004",
        "# Complete NRRD file format specification at:",
        "# http://teem.sourceforge.net/nrrd/format.html",
        f"type: {'uint8' if stack.dtype == np.uint8 else 'int16'}",
        f"dimension: {4 if colour else 3}",
        f"sizes: {'3 ' if colour else ''}{sizes}",
        f"kinds: {'vector ' if colour else ''}domain domain list",
        "endian: little",
        f"encoding: {'gzip' if compressed else 'raw'}",
        "space dimension: 2",
        f"space directions: {'none ' if colour else ''}(1,0) (0,1) none",
        "space origin: (0,0)",
        f"ultrasound image orientation:={written_orientation(orientation)}",
        "ultrasound image type:=BRIGHTNESS",
    ]
