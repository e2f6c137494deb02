"""A folder of PNG images, and the table that says which pose belongs to which of them."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.recording import MOST_IMAGES
from jaxcal.io.given_files import one_line
from jaxcal.io.png import png_size
from jaxcal.io.sequence import FolderPixels, TrackedSequence
from jaxcal.io.text import PoseTable
from jaxcal.runtime.array_types import Int
from jaxcal.runtime.messages import quoted

_OTHERS = {".bmp", ".gif", ".jpeg", ".jpg", ".pgm", ".tif", ".tiff"}
"""Endings of images that are not read."""
PROBE_TO_TRACKER = ("Probe", "Tracker")


def read_folder(path: str | os.PathLike[str]) -> TrackedSequence:
    """The PNG images of a folder in the order of their numbers; no poses, no times.

    Args:
        path: of the folder. ``b2.png`` comes before ``b10.png``; other files, hidden ones too, are
            passed over.

    Raises:
        FormatError: no such folder, no PNG in it, images of different sizes, a link to another
            folder; one line that starts with the path.
    """
    folder, name = Path(path), os.fspath(path)
    try:
        # Macs leave a hidden ``._a.png``, which is no image, beside each ``a.png``.
        listed = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise FormatError(f"{name}: cannot be read: {one_line(error)}") from None
    paths = [entry for entry in listed if entry.suffix.lower() == ".png"]
    if not paths:
        others = sorted({entry.suffix.lower() for entry in listed} & _OTHERS)
        hint = f" ({' and '.join(others)} must be converted to PNG first)" if others else ""
        raise FormatError(f"{name}: holds no PNG images{hint}")
    if len(paths) > MOST_IMAGES:
        raise FormatError(f"{name}: holds {len(paths)} images (at most {MOST_IMAGES})")
    inside = folder.resolve()
    for each in paths:
        if each.resolve().parent != inside:
            raise FormatError(f"{each}: is a link to another folder")
    paths.sort(key=lambda each: _natural(each.name))
    size = png_size(paths[0])
    for each in paths[1:]:
        other = png_size(each)
        if other != size:
            raise FormatError(
                f"{each}: has {other[0]} x {other[1]} px, {paths[0].name} has {size[0]} x {size[1]}"
            )
    count = len(paths)
    # The number that ends a name is how tables call an image.
    endings = [re.search(r"(\d{1,9})$", each.stem) for each in paths]
    return TrackedSequence(
        {},
        {},
        np.full(count, np.nan),
        np.ones(count, bool),
        FolderPixels(tuple(paths), *size),
        name,
        np.array([-1 if found is None else int(found[1]) for found in endings]),
    )


def with_pose_table(images: TrackedSequence, table: PoseTable) -> tuple[TrackedSequence, list[str]]:
    """Images with the poses of a table.

    Args:
        images: of :func:`read_folder`.
        table: of poses from probe to tracker. Rows belong to images by a column ``file``, by a
            column ``frame`` (the number that ends the name of the file), or, without either, in
            their order; then there must be as many rows as images.

    Returns:
        The sequence, in which images without a pose are not valid; and notes for the user.

    Raises:
        InputError: a row that belongs to no image, or two rows of the same image; one line with
            file and line.
    """
    if table.poses is None:
        raise InputError(f"{table.name}: holds no poses")
    if table.points is not None:
        raise InputError(
            f"{table.name}: holds points as well as poses: import it by itself, without images"
        )
    count, rows = len(images), rows_by_name(images, table)
    if rows is None:
        if len(table) != count:
            raise InputError(
                f"{table.name}: {len(table)} poses, but {images.source} has {count} images: name "
                "the images in a column file or frame"
            )
        rows = np.arange(count)
    if (twice := first_repeated(rows)) is not None:
        raise InputError(f"{table.name}: has two poses for {images.frame_name(twice)}")
    poses, valid = np.full((count, 4, 4), np.nan), np.zeros(count, bool)
    poses[rows], valid[rows] = table.poses, True
    time = np.full(count, np.nan)
    if table.time is not None:
        time[rows] = table.time
    notes = table.notes
    missing = count - len(rows)
    if missing:
        notes.append(f"{missing} of {count} images have no pose in {table.name}")
    return replace(
        images,
        transforms={PROBE_TO_TRACKER: poses},
        valid={PROBE_TO_TRACKER: valid},
        time=time,
        clock=table.clock,
        length_stated=table.length_stated,
    ), notes


def rows_by_name(sequence: TrackedSequence, table: PoseTable) -> Int[np.ndarray, " m"] | None:
    """The frame that each row of a table belongs to, by its column ``file`` or ``frame``.

    ``file`` is for the images of a folder. None for a table without such a column.

    Raises:
        InputError: a name or number that no frame has; one line with file and line.
    """
    if (named := table.file_names) is not None and (files := sequence.files):
        places = {Path(name).stem: index for index, name in enumerate(files)}
        # A whole name counts before another's without its ending.
        places |= {name: index for index, name in enumerate(files)}
        unknown = [row for row, text in enumerate(named) if text not in places]
        if unknown:
            raise InputError(
                f"{table.name}:{table.lines[unknown[0]]}: there is no image "
                f"{quoted(named[unknown[0]])} in {sequence.source}"
            )
        return np.array([places[text] for text in named])
    if table.frame is None:
        return None
    return sequence.rows_of(table.frame, [f"{table.name}:{line}" for line in table.lines])


def first_repeated(rows: Int[np.ndarray, " m"]) -> int | None:
    """The least number that is there more than once."""
    values, counts = np.unique(rows, return_counts=True)
    return next(iter(values[counts > 1].tolist()), None)


def _natural(name: str) -> list[tuple[int, int | str]]:
    parts = re.split(r"(\d{1,18})", name)
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts]
