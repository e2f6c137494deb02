"""MetaImage sequences: ``.igs.mha``, and ``.igs.mhd`` with ``.raw`` or ``.zraw`` beside it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxcal import FormatError
from jaxcal.io.given_files import check_readable
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

_META_TYPES = {
    "MET_UCHAR": np.dtype("u1"),
    "MET_CHAR": np.dtype("i1"),
    "MET_SHORT": np.dtype("i2"),
    "MET_USHORT": np.dtype("u2"),
    "MET_FLOAT": np.dtype("f4"),
    "MET_DOUBLE": np.dtype("f8"),
}

_LOCAL = ("LOCAL", "Local", "local")
"""Names of the file of the pixels that MetaIO takes for the header's own."""


def read_metaimage(path: Path) -> TrackedSequence:
    """Read a header; neither its errors nor the sequence name the file."""
    header = SequenceHeader()
    for line, text, end in header_lines(path):
        key, separator, value = text.partition("=")
        key, value = key.strip(), value.strip()
        if not key and not separator:
            continue
        if not separator:
            raise FormatError(f"line {line} is not KEY = VALUE: {quoted(text)}")
        header.take(key, value, line)
        if key == "ElementDataFile":
            header.end = end
            break
    fields = header.fields
    if "ElementDataFile" not in fields or "DimSize" not in fields:
        raise FormatError("is not a MetaImage sequence: DimSize or ElementDataFile is missing")
    columns, rows, count = _metaimage_size(fields)
    check_count(count, header)
    check_data_name(fields["ElementDataFile"])
    kind = fields.get("ElementType", "")
    pixels = None
    # Tracking alone has three forms: 0 0 N with either type, or 1 1 N with a dummy pixel a frame.
    if kind != "MET_OTHER" and columns > 1 and rows > 1:
        pixels = _metaimage_pixels(path, header, columns, rows, count)
    return sequence_of(header, count, pixels, "ImageStatus")


def _metaimage_size(fields: dict[str, str]) -> tuple[int, int, int]:
    size = whole_numbers(fields["DimSize"], "DimSize")
    dimensions = whole_numbers(fields.get("NDims", str(len(size))), "NDims")[0]
    if len(size) != dimensions or dimensions not in (2, 3, 4):
        raise FormatError(f"DimSize has {len(size)} numbers, NDims is {dimensions}")
    if dimensions == 4 and size[2] > 1:
        raise FormatError(f"holds volumes of depth {size[2]}; plane images are read")
    return size[0], size[1], size[-1] if dimensions > 2 else 1


def _metaimage_pixels(
    path: Path, header: SequenceHeader, columns: int, rows: int, count: int
) -> Pixels:
    fields = header.fields
    if fields.get("ElementType") not in _META_TYPES:
        raise FormatError(f"ElementType {quoted(fields.get('ElementType', ''))} is not read")
    if not _flag(fields, "BinaryData", default=True):
        raise FormatError("holds pixels as text; only binary ones are read")
    big = _flag(fields, "BinaryDataByteOrderMSB", "ElementByteOrderMSB")
    dtype = _META_TYPES[fields["ElementType"]].newbyteorder(">" if big else "<")
    data = fields["ElementDataFile"]
    data = "" if data in _LOCAL else data
    pixels = Pixels(
        _beside(path, data) if data else path,
        0 if data else header.end,
        "zlib" if _flag(fields, "CompressedData") else "raw",
        columns,
        rows,
        whole_numbers(fields.get("ElementNumberOfChannels", "1"), "ElementNumberOfChannels")[0],
        dtype,
        *orientation_and_kind(
            fields.get("UltrasoundImageOrientation", ""), fields.get("UltrasoundImageType", "")
        ),
        stated_mm=stated_pixel_size(fields.get("ElementSpacing", "").split()),
    )
    skipped = fields.get("HeaderSize", "0")
    if skipped != "0":
        pixels = replace(pixels, start=_after_header(skipped, data, pixels, count))
    return checked_pixels(pixels, count)


def _flag(fields: dict[str, str], *names: str, default: bool = False) -> bool:
    """Whether a field, which may have several names, is True."""
    stated = {name: fields[name] for name in names if name in fields}
    known = {"true": True, "1": True, "false": False, "0": False}
    for name, value in stated.items():
        if value.lower() not in known:
            raise FormatError(f"{name} must be True or False, not {quoted(value)}")
    found = {known[value.lower()] for value in stated.values()}
    if len(found) > 1:
        raise FormatError(f"{' and '.join(stated)} contradict each other: remove the wrong one")
    return found.pop() if found else default


def _after_header(stated: str, data: str, pixels: Pixels, count: int) -> int:
    """Where pixels begin in their file, by HeaderSize: -1 says that they are its end."""
    if not data:
        raise FormatError(
            f"HeaderSize = {quoted(stated)}: applies only to pixels in another file, but these "
            "follow the header: remove the line"
        )
    if stated != "-1":
        numbers = whole_numbers(stated, "HeaderSize")
        if len(numbers) > 1:
            raise FormatError(f"HeaderSize must be one number, not {quoted(stated)}")
        return numbers[0]
    if pixels.packing != "raw":
        raise FormatError(
            "HeaderSize = -1: is for raw pixels: state where the compressed ones begin"
        )
    # A file that is too short is told from its size.
    return max(pixels.path.stat().st_size - pixels.frame_bytes * count, 0)


def check_data_name(data: str) -> None:
    """Refuse a name of another folder, a list of files (``LIST 2D``) and a pattern (``f%03d``)."""
    if data.split()[:1] in ([], ["LIST"], ["."], [".."]) or re.search(r"[/\\%:\0\n\r]", data):
        raise FormatError(
            f"ElementDataFile = {quoted(data)}: only LOCAL, or a file beside the header, is "
            "read (no / \\ % or : in its name)"
        )


def _beside(path: Path, data: str) -> Path:
    """The file of pixels that a header names: in its own folder, and nowhere else."""
    file = path.parent / data
    try:
        check_readable(file)
        inside = file.resolve().parent == path.resolve().parent
    except FormatError as error:
        raise FormatError(f"its pixels, {error}") from None
    if not inside:
        raise FormatError(f"ElementDataFile = {quoted(data)}: is a link to another folder")
    return file


def metaimage_header(
    stack: np.ndarray, orientation: str, pixels: bool, compressed: bool, size: int
) -> list[str]:
    """The lines of a header before the fields of frames."""
    channels = stack.shape[3] if stack.ndim == 4 else 1
    head = [
        "ObjectType = Image",
        "NDims = 3",
        "AnatomicalOrientation = RAI",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CenterOfRotation = 0 0 0",
        f"CompressedData = {compressed}",
    ]
    if compressed:
        head.append(f"CompressedDataSize = {size}")
    head += [
        f"DimSize = {stack.shape[2]} {stack.shape[1]} {stack.shape[0]}",
        "Kinds = domain domain list",
        "ElementSpacing = 1 1 1",
        f"ElementType = {'MET_UCHAR' if stack.dtype == np.uint8 else 'MET_SHORT'}",
        "Offset = 0 0 0",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        f"UltrasoundImageOrientation = {written_orientation(orientation)}",
        "UltrasoundImageType = BRIGHTNESS",
    ]
    if pixels:
        head.append(f"ElementNumberOfChannels = {channels}")
    return head
