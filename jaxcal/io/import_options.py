"""The options of an import, and the refusal of those that would not be used."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from jaxcal import InputError
from jaxcal.data.poses import QuaternionOrder
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.io.columns import LengthUnit
from jaxcal.io.frame_points import Assignment


@dataclass(frozen=True)
class ImportOptions:
    """The options of an import.

    Attributes:
        source: tracked frame on the probe; the sequence's only one, or ``Probe``, by default.
        target: frame that the target rests in; ``Reference`` where it was tracked, else
            ``Tracker``, by default.
        spacing_mm: [lateral, axial] mm per px, when known.
        units: of u and v in tables.
        quaternion: where a quaternion's scalar stands.
        pose_units: of translations where the file of the poses does not say; mm by default.
        skip_invalid: leave out rows of tables that are marked as invalid, and count them.
        points: how points without time or number are assigned to frames.
        target_kind: what to look for in frames where no points are given: ``echo``, the default,
            or ``cross``.
        region: (first column, first row, columns, rows) to look in, px.
        orientation: of the stored pixels of frames that are searched, where the file does not say.
        ignore_time: time stamps that repeat, go back or are missing are no error: none are kept.
        poses: file with the poses of the frames: a table for a folder of images; a sequence, a
            tracker's export or a table with times for a sequence.
        lag_s: with ``poses``: an image stamped t shows what was at t - lag; ``auto``: estimated
            from the motion of the points in the images.
        spacing_from: DICOM clip that states the pixel size.
        minimum: least number of images.
    """

    source: str | None = None
    target: str | None = None
    spacing_mm: tuple[float, float] | None = None
    units: Literal["px", "mm"] | None = None
    quaternion: QuaternionOrder | None = None
    pose_units: LengthUnit | None = None
    skip_invalid: bool = False
    points: Assignment | None = None
    target_kind: Literal["echo", "cross"] | None = None
    region: tuple[int, int, int, int] | None = None
    orientation: Literal["MF", "UF", "MN", "UN"] | None = None
    ignore_time: bool = False
    poses: str | os.PathLike[str] | None = None
    lag_s: float | Literal["auto"] = 0.0
    spacing_from: str | os.PathLike[str] | None = None
    minimum: int = MINIMUM_IMAGES


_FLAGS = {
    "source": "--from",
    "target": "--to",
    "units": "--units",
    "quaternion": "--quaternion",
    "skip_invalid": "--skip-invalid",
    "points": "--points",
    "target_kind": "--target",
    "region": "--region",
    "orientation": "--orientation",
    "ignore_time": "--ignore-time",
    "lag_s": "--lag",
}


def refuse(options: ImportOptions, names: Sequence[str], why: str) -> None:
    """Refuse options that were given and would not be used."""
    for name in names:
        if getattr(options, name) != getattr(ImportOptions, name):
            raise InputError(f"{_FLAGS[name]} {why}")
