"""What is noticed in tracked sequences and may spoil a calibration, in words."""

from __future__ import annotations

import os

import numpy as np

from jaxcal.io.importing.target_search import FrameResults
from jaxcal.io.lines import text_lines
from jaxcal.io.picker.picks import HEAD
from jaxcal.io.sequence import Pixels, TrackedSequence
from jaxcal.runtime.array_types import Float

_AT_ONE_PLACE_PX = 0.5
_MOVED_MM = 1.0
"""A real target moves in the image by more than the first where a probe moves by the second."""
_SAME_SIZE = 0.01
"""Sizes of pixels that differ by less than this share are the same."""


def mirrored(sequence: TrackedSequence, points: str | os.PathLike[str]) -> list[str]:
    """A note where points of the pixels as they are stored would be mirrored.

    ``jaxcal pick`` shows frames in MF: its own points need no note.
    """
    pixels = sequence.pixels
    stored = pixels.orientation if isinstance(pixels, Pixels) else None
    if pixels is None or stored is None or stored == "MF":
        return []
    _, first = next(text_lines(points, comments=True), (0, ""))
    if first.startswith(HEAD):
        return []
    mirrored = {"U": f"u = {pixels.columns - 1} - u", "N": f"v = {pixels.rows - 1} - v"}
    told = " and ".join(text for letter, text in mirrored.items() if letter in stored)
    return [
        f"u and v of {os.fspath(points)} are taken in the orientation MF, as jaxcal pick shows it; "
        f"{sequence.source} is stored as {stored}: points of its stored pixels must be mirrored "
        f"first ({told})"
    ]


def size_in_header(sequence: TrackedSequence) -> tuple[float, float] | None:
    """The size of a pixel (mm across, mm in depth) that the header states, if it does."""
    return sequence.pixels.stated_mm if isinstance(sequence.pixels, Pixels) else None


def other_pixel_size(sequence: TrackedSequence, spacing: tuple[float, float] | None) -> list[str]:
    """A note where a sequence's header states another pixel size than the one that is used."""
    stated = size_in_header(sequence)
    if stated is None or (spacing is not None and np.allclose(spacing, stated, rtol=_SAME_SIZE)):
        return []
    size = f"{stated[0]:.6g} {stated[1]:.6g}"
    return [
        f"{sequence.source}: its header states pixels of {size.replace(' ', ' x ')} mm, which is "
        f"not used: if that is their size in the image, give --spacing {size}"
    ]


def fixed_mark(points: Float[np.ndarray, "n 2"], poses: Float[np.ndarray, "n 4 4"]) -> list[str]:
    """A note if most frames show the target at one place although the probe moved."""
    middle = np.median(points, axis=0)
    same = (np.abs(points - middle) < _AT_ONE_PLACE_PX).all(axis=1)
    if 2 * same.sum() < len(points) or np.ptp(poses[same, :3, 3], axis=0).max() < _MOVED_MM:
        return []
    return [
        f"in {same.sum()} of {len(points)} frames the target is at the same place, "
        f"u = {middle[0]:.0f}, v = {middle[1]:.0f}, although the probe moved: is it a mark of the "
        "machine? --region leaves it out"
    ]


def tail_of_echoes(results: FrameResults, spacing_mm: tuple[float, float] | None) -> list[str]:
    """A note if the target is mostly longer in depth than across, as no point spread is.

    It is for a single spot: wires of a crossing may be steep. Pixels of unknown size count as
    square.
    """
    width = results.width[results.found] * (1.0 if spacing_mm is None else np.array(spacing_mm))
    long = width[:, 1] > width[:, 0]
    if results.target != "echo" or 2 * long.sum() <= len(long):
        return []
    return [
        f"in {long.sum()} of {len(long)} frames the target is longer in depth than across: the "
        "tail of echoes behind a bead or wire of metal? Then all points are too deep, and so is "
        "the calibrated image, which no residual shows. With less gain the tail is shorter; "
        "jaxcal pick places points where the echo begins"
    ]
