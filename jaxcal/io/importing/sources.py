"""What an import is given: its options, and the kind of each source with its reader."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.names import (
    Assignment,
    LengthUnit,
    Orientation,
    PointUnit,
    QuaternionOrder,
    Target,
)
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.io.folder import read_folder
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.sequence_files import EXTENSIONS, read_sequence
from jaxcal.io.slicer import EXTENSIONS as MARKUPS
from jaxcal.io.text import PoseTable, read_pose_table
from jaxcal.io.trackers import is_tracker_export, read_tracker
from jaxcal.runtime.array_types import Bool, Int
from jaxcal.runtime.messages import runs_in_words


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
        invert_poses: the file's poses are tracker -> probe, and their inverses are taken.
        points: how points without time or number are assigned to frames.
        target_kind: what to look for in frames where no points are given: ``echo``, the default,
            or ``cross``.
        region: (first column, first row, columns, rows) to look in, px.
        orientation: of the stored pixels of frames that are searched, where the file does not say.
        ignore_time: time stamps that repeat, go back or are missing are no error: none are kept.
        poses: file with the poses of the frames: a table for a folder of images; a sequence, a
            tracker's export or a table with times for a sequence.
        lag_s: an image stamped t shows what was at t - lag; ``auto``: estimated from the points.
        spacing_from: DICOM clip that states the pixel size.
        frames: numbers of the frames, or of the rows of a table, that are used; None: all.
        minimum: least number of images.
    """

    source: str | None = None
    target: str | None = None
    spacing_mm: tuple[float, float] | None = None
    units: PointUnit | None = None
    quaternion: QuaternionOrder | None = None
    pose_units: LengthUnit | None = None
    skip_invalid: bool = False
    invert_poses: bool = False
    points: Assignment | None = None
    target_kind: Target | None = None
    region: tuple[int, int, int, int] | None = None
    orientation: Orientation | None = None
    ignore_time: bool = False
    poses: str | os.PathLike[str] | None = None
    lag_s: float | Literal["auto"] = 0.0
    spacing_from: str | os.PathLike[str] | None = None
    frames: tuple[int, ...] | None = None
    minimum: int = MINIMUM_IMAGES

    @property
    def by_time(self) -> bool:
        """Whether frames do not have the poses that stand with them in their file."""
        return self.poses is not None or self.lag_s != 0

    @property
    def poses_in_table(self) -> bool:
        """Whether the poses are in a table of their own, which does not name their frames."""
        return self.poses is not None and kind_of(self.poses) == "table"


_FLAGS = {"source": "--from", "target": "--to", "target_kind": "--target", "lag_s": "--lag"}
"""Options of the command line that have other names than those here."""


def refuse(options: ImportOptions, names: Sequence[str], why: str) -> None:
    """Refuse options that were given and would not be used."""
    for name in names:
        if getattr(options, name) != getattr(ImportOptions, name):
            flag = _FLAGS.get(name, f"--{name.replace('_', '-')}")
            raise InputError(f"{flag} {why}")


def selected(
    numbers: Int[np.ndarray, " n"], options: ImportOptions, name: str
) -> tuple[Bool[np.ndarray, " n"], list[str]]:
    """Which of the frames with these numbers are used, and a note if not all are asked for.

    A frame without a number has -1.

    Raises:
        InputError: no frame that is used.
    """
    if options.frames is None:
        return np.ones(len(numbers), bool), []
    chosen, asked = np.isin(numbers, options.frames), runs_in_words(options.frames)
    if not chosen.any():
        known = numbers[numbers >= 0]
        there = f"frames {known.min()} to {known.max()}" if len(known) else "frames without numbers"
        raise InputError(f"{name}: has {there}, none of --frames {asked}")
    unknown = len(options.frames) - len(np.unique(numbers[chosen]))
    lost = f" ({unknown} of these {len(options.frames)} numbers name no frame)" if unknown else ""
    return chosen, [f"only frames {asked} of {name} are used{lost}"]


SEQUENCES = ("sequence", "tracker", "scan", "folder")

_AS_TABLE = " (save its numbers as a table, CSV)"
_NOT_IMPORTED = {
    ".xml": " (jaxcal export, apply and compare read PLUS's calibration in it)",
    **dict.fromkeys(
        (".tfm", ".yaml", ".yml"), " (jaxcal export, apply and compare take it as CAL)"
    ),
    ".png": " (name the folder of the PNG images)",
    ".dcm": " (--spacing-from reads its pixel size)",
    ".vtk": "",
    **dict.fromkeys((".avi", ".mp4", ".mov"), " (save its frames as PNG in a folder)"),
    ".mkv": " (record as .igs.mha, or try PLUS's EditSequenceFile, or save its frames as PNG in a "
    "folder)",
    **dict.fromkeys(
        (".bag", ".mcap", ".db3"),
        " (save its poses as a table, CSV, and its images as PNG in a folder)",
    ),
    **dict.fromkeys((".mrml", ".mrb"), " (save its sequence from Slicer as .seq.nrrd)"),
    **dict.fromkeys((".mat", ".npy", ".npz", ".xls", ".xlsx", ".ods"), _AS_TABLE),
}
"""Endings of other files, and what to do with these."""


def kind_of(source: str | os.PathLike[str]) -> str:
    """One of :data:`SEQUENCES`, ``markups`` or ``table``.

    Raises:
        FormatError: a text file that cannot be read, or a kind that cannot be imported.
    """
    name = os.fspath(source).lower()
    if os.path.isdir(source):
        return "folder"
    if name.endswith(EXTENSIONS):
        return "sequence"
    if name.endswith(MARKUPS):
        return "markups"
    if name.endswith((".h5", ".hdf5")):
        return "scan"
    for ending, hint in _NOT_IMPORTED.items():
        if name.endswith(ending):
            raise FormatError(f"{os.fspath(source)}: is not a recording that can be imported{hint}")
    return "tracker" if is_tracker_export(source) else "table"


def read_rows(
    source: str | os.PathLike[str], options: ImportOptions, *, ignore_time: bool = False
) -> PoseTable:
    """The table of a source of the kind ``table``.

    ``ignore_time`` is not taken from the options: times that pair poses with frames are always
    read.
    """
    return read_pose_table(
        source,
        quaternion=options.quaternion,
        pose_units=options.pose_units,
        units=options.units,
        skip_invalid=options.skip_invalid,
        invert_poses=options.invert_poses,
        ignore_time=ignore_time,
    )


def read_tracked(
    source: str | os.PathLike[str], pose_units: LengthUnit | None = None
) -> TrackedSequence:
    """A source of one of :data:`SEQUENCES`.

    ``pose_units`` are those of translations where the file does not state it; mm by default.
    """
    match kind_of(source):
        case "tracker":
            return read_tracker(source, pose_units)
        case "scan":
            from jaxcal.io.tus_rec import read_scan

            return read_scan(source).scaled(pose_units or "mm")
        case "folder":
            return read_folder(source)
    return read_sequence(source).scaled(pose_units or "mm")
