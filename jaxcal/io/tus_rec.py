"""TUS-REC challenge data: scans in HDF5, and the calibration as ``calib_matrix.csv``.

The baseline of the challenge counts pixels from 1, so that its matrices' origin lies one pixel
before ours.

Source: UCL, tus-rec-challenge.
"""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.recording import MOST_IMAGES
from jaxcal.io.given_files import check_readable, naming
from jaxcal.io.lines import text_lines
from jaxcal.io.sequence import Hdf5Pixels, TrackedSequence
from jaxcal.io.sequence_header import LARGEST_FRAME
from jaxcal.io.table import finite_numbers
from jaxcal.io.untrusted import UpTo, array, check_rows, child, open_root
from jaxcal.runtime.array_types import Float

FRAMES = "Tool", "Tracker"

_SCALING = "scaling_from_pixel_to_mm"
_CALIBRATION = "spatial_calibration_from_image_coordinate_system_to_tracking_tool_coordinate_system"


def read_scan(path: str | os.PathLike[str]) -> TrackedSequence:
    """Read a scan; the file is not trusted.

    Args:
        path: HDF5 with ``tforms`` (n, 4, 4), tool -> camera, mm, and ``frames`` (n, rows, columns),
            uint8; without time stamps.

    Returns:
        The transforms from ``Tool`` to ``Tracker``; frames are assumed to be MF-oriented.

    Raises:
        FormatError: not such a file; one line that starts with the path.
    """
    check_readable(path)
    with naming(path), open_root(path) as root:
        transforms = child(root, "tforms")
        if transforms is None and child(root, "calibration") is not None:
            raise FormatError(
                "is a recording of jaxcal already: jaxcal calibrate takes it; other commands take "
                "the file from which it was imported"
            )
        if transforms is None:
            raise FormatError("is no scan of TUS-REC: /tforms is missing")
        poses = array(transforms, (UpTo(MOST_IMAGES, "frames"), 4, 4))
        if not len(poses):
            raise FormatError("holds no frames")
        frames = child(root, "frames")
        pixels = None
        if frames is not None:
            count, rows, columns = check_rows(frames, 3, LARGEST_FRAME, "u")
            if count != len(poses):
                raise FormatError(f"/frames has {count} frames, /tforms {len(poses)}")
            pixels = Hdf5Pixels(Path(path), columns, rows)
        valid = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
        return TrackedSequence(
            {FRAMES: poses},
            {FRAMES: valid},
            np.full(len(poses), np.nan),
            np.full(len(poses), pixels is not None),
            pixels,
            os.fspath(path),
        )


def calib_matrix(
    image_to_probe: Float[np.ndarray, "4 4"], scale_mm_per_px: Float[np.ndarray, " 2"]
) -> str:
    """``calib_matrix.csv`` of a calibration from pixels, which are counted from 1 there.

    Args:
        image_to_probe: rigid, from the Image frame in mm (lateral, axial, and their cross product)
            to the probe.
        scale_mm_per_px: [lateral, axial].
    """
    scaling = np.diag([*scale_mm_per_px, 1.0, 1.0])
    rigid = np.array(image_to_probe, dtype=np.float64)
    rigid[:3, 3] -= rigid[:3, :2] @ np.asarray(scale_mm_per_px)
    lines = [_SCALING, *_rows(scaling), _CALIBRATION, *_rows(rigid)]
    return "\n".join(lines) + "\n"


def _rows(matrix: np.ndarray) -> list[str]:
    return [",".join(repr(value + 0.0) for value in row) for row in matrix.tolist()]


def read_calib_matrix(
    path: str | os.PathLike[str],
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, " 2"]]:
    """What :func:`calib_matrix` was made from; the file is not trusted.

    Raises:
        FormatError: not such a file; file and line are named. Lines after the first ten, and
            what follows a heading, are not read.
    """
    with naming(path):
        found = list(itertools.islice(text_lines(path), 10))
        titles = [line for _, line in found[::5]]
        if len(found) != 10 or not all(map(str.startswith, titles, (_SCALING, _CALIBRATION))):
            raise FormatError(
                "is no calib_matrix.csv of TUS-REC: its first ten lines are a line that begins "
                f"with {_SCALING}, four rows, one that begins with {_CALIBRATION}, four rows"
            )
        scaling, rigid = (_four_rows(found[start : start + 4]) for start in (1, 6))
        if np.abs(scaling - np.diag(np.diag(scaling))).max() > 0 or (np.diag(scaling) <= 0).any():
            raise FormatError("its scaling is not a diagonal of positive numbers")
        scale = np.diag(scaling)[:2].copy()
        rigid[:3, 3] += rigid[:3, :2] @ scale
        return rigid, scale


def _four_rows(lines: list[tuple[int, str]]) -> Float[np.ndarray, "4 4"]:
    rows = np.array([finite_numbers(row, 4, f"line {line}: a row", ",") for line, row in lines])
    if np.abs(rows[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(f"line {lines[3][0]}: the last row of a matrix is 0 0 0 1")
    return rows
