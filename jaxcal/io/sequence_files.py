"""Tracked sequences to and from files, as PLUS and Slicer write them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxcal import InputError
from jaxcal.data.names import Orientation
from jaxcal.io.atomic import atomic_path, write_bytes
from jaxcal.io.frame_names import FramePair
from jaxcal.io.given_files import check_readable, naming
from jaxcal.io.metaimage import check_data_name, metaimage_header, read_metaimage
from jaxcal.io.nrrd import nrrd_header, read_nrrd
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.sequence_header import check_written, frame_fields, packed_pixels, stacked

EXTENSIONS = (".mha", ".mhd", ".nrrd", ".nhdr")


def read_sequence(path: str | os.PathLike[str]) -> TrackedSequence:
    """Read a sequence's header: transforms, statuses and times. Pixels stay in the file.

    Args:
        path: a ``.mha``, ``.mhd`` or ``.nrrd`` file as PLUS or Slicer writes it.

    Raises:
        FormatError: not such a file, damaged, absurd sizes, pixels in another folder, a transform
            that is not 16 finite numbers though its status is OK; one line that starts with the
            path.
    """
    check_readable(path)
    name = os.fspath(path)
    read = read_nrrd if name.lower().endswith((".nrrd", ".nhdr")) else read_metaimage
    with naming(path):
        return replace(read(Path(path)), source=name)


def write_sequence(
    path: str | os.PathLike[str],
    transforms: Mapping[FramePair, np.ndarray],
    time: np.ndarray,
    *,
    valid: Mapping[FramePair, np.ndarray] | None = None,
    images: Iterable[np.ndarray] | None = None,
    orientation: Orientation = "MF",
    compressed: bool = True,
) -> None:
    """Write a sequence that PLUS and Slicer read, complete or not at all.

    Args:
        path: ends in ``.mha``, ``.mhd`` or ``.nrrd``; the pixels of ``.mhd`` go to a ``.raw`` or
            ``.zraw`` beside it.
        transforms: (n, 4, 4), mm, by their frames (from, to).
        time: (n,) s, at least a millisecond apart: Slicer knows frames by rounded milliseconds.
        valid: (n,) by the same frames; where False the status is INVALID. All by default.
        images: n arrays (rows, columns), or (rows, columns, 3), uint8 or int16. None: tracking
            alone, one dummy pixel a frame, as PLUS writes it.
        orientation: of the pixels.
        compressed: zlib for MetaImage, gzip for NRRD.

    Raises:
        InputError: shapes that differ, other types, names or times that cannot be written.
        OutputError: the file could not be written; it is as it was.
    """
    name = os.fspath(path)
    if not name.lower().endswith((".mha", ".mhd", ".nrrd")):
        raise InputError(f"{name}: a sequence's name ends in .mha, .mhd or .nrrd")
    time = np.asarray(time, dtype=np.float64)
    check_written(transforms, time)
    stack = stacked(images, len(time))
    nrrd = name.lower().endswith(".nrrd")
    status = None if images is None else "Status" if nrrd else "ImageStatus"
    packed = packed_pixels(stack, "raw" if not compressed else "gzip" if nrrd else "zlib")
    equals, last, beside = (":=" if nrrd else " = "), "", None
    if nrrd:
        head = nrrd_header(stack, orientation, compressed)
    else:
        head = metaimage_header(stack, orientation, images is not None, compressed, len(packed))
        last = "ElementDataFile = LOCAL"
    lines = [
        f"{key}{equals}{value}" for key, value in frame_fields(transforms, valid, time, status)
    ]
    if name.lower().endswith(".mhd"):
        beside = Path(name).with_suffix(".zraw" if compressed else ".raw")
        last = f"ElementDataFile = {beside.name}"
        with naming(path):
            check_data_name(beside.name)
    header = "\n".join([*head, *lines, last, ""]).encode()
    if beside is None:
        write_bytes(path, header + packed)
        return
    # Both are on the disk before one of them takes its name, the pixels first: a header without
    # them would be half a recording.
    with atomic_path(path) as prepared:
        prepared.write_bytes(header)
        write_bytes(beside, packed)
