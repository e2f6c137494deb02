"""Which kind of file a source of an import is, and its reader."""

from __future__ import annotations

import os

from jaxcal import FormatError
from jaxcal.io.columns import LengthUnit
from jaxcal.io.folder import read_folder
from jaxcal.io.import_options import ImportOptions
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.sequence_files import EXTENSIONS, read_sequence
from jaxcal.io.slicer import EXTENSIONS as MARKUPS
from jaxcal.io.text import PoseTable, read_pose_table
from jaxcal.io.trackers import is_tracker_export, read_tracker

SEQUENCES = ("sequence", "tracker", "scan", "folder")


_AS_TABLE = " (save its numbers as a table, CSV)"
_NOT_IMPORTED = {
    ".xml": " (jaxcal export, apply and compare read PLUS's calibration in it)",
    ".png": " (name the folder of the PNG images)",
    ".dcm": " (--spacing-from reads its pixel size)",
    ".vtk": "",
    ".mrb": "",
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

    ``ignore_time`` is not taken from the options: times that pair poses or points with frames are
    always read.
    """
    return read_pose_table(
        source,
        quaternion=options.quaternion,
        pose_units=options.pose_units,
        units=options.units,
        skip_invalid=options.skip_invalid,
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
