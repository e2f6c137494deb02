"""What an import makes, and what tables and sequences have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from jaxcal import InputError
from jaxcal.data.recording import MetresError, Recording
from jaxcal.io.importing.sources import ImportOptions
from jaxcal.io.importing.target_search import FrameResults
from jaxcal.io.sequence import TrackedSequence
from jaxcal.runtime.array_types import Float


class Imported(NamedTuple):
    """A recording and how it was made.

    Attributes:
        recording: of the files.
        notes: what was assumed, left out and counted, in words.
        frames: what became of every frame, where the target was looked for in them.
        most_lost: whether fewer than half of the frames, or of the points of another file, are in
            the recording.
    """

    recording: Recording
    notes: list[str]
    frames: FrameResults | None = None
    most_lost: bool = False


@contextmanager
def naming_pose_units(options: ImportOptions, stated: bool = False) -> Iterator[None]:
    """Name the option that converts poses that look like metres, if no unit was ``stated``."""
    try:
        yield
    except MetresError as error:
        if stated or options.pose_units is not None:
            raise
        raise InputError(f"{error} (jaxcal import converts them with --pose-units m)") from None


def good_time(
    time: Float[np.ndarray, " n"],
    place: Callable[[int], str],
    options: ImportOptions,
    by_time: bool = False,
) -> tuple[Float[np.ndarray, " n"] | None, list[str]]:
    """The times, unless they repeat or go back, which mostly are two recordings in one; and notes.

    ``place`` says where a row stands, ``by_time`` whether poses were looked up by these times.
    """
    back = np.flatnonzero(np.diff(time) <= 0)
    if not len(back):
        return time, []
    if not options.ignore_time:
        row = int(back[0]) + 1
        guess = "too few digits, or " * bool(time[row] == time[row - 1])
        then = "imports images with poses at such times" if by_time else "imports without times"
        raise InputError(
            f"{place(row)}: the time stamp is not later than the one before: {guess}two recordings "
            f"in one? (--ignore-time {then})"
        )
    wrong = ", but poses are those at these times: if times are wrong, poses are, too" * by_time
    return None, [f"time stamps repeat or go back: not kept{wrong}"]


def pixel_size(
    sequence: TrackedSequence | None, options: ImportOptions
) -> tuple[float, float] | None:
    """The pixel size that is stated, or read from a clip of the same image size."""
    if options.spacing_from is None:
        return options.spacing_mm
    if options.spacing_mm is not None:
        raise InputError("give either --spacing or --spacing-from")
    from jaxcal.io.dicom import read_pixel_size

    stated = read_pixel_size(options.spacing_from)
    pixels = None if sequence is None else sequence.pixels
    if pixels is not None and (pixels.columns, pixels.rows) != (stated.columns, stated.rows):
        raise InputError(
            f"{options.spacing_from}: its images are {stated.columns} x {stated.rows} px, the "
            f"frames {pixels.columns} x {pixels.rows}: their pixels need not be of one size "
            "(--spacing states it)"
        )
    return stated.spacing_mm
