"""Options of the commands that read tracked sequences: which poses, which part of the frames."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import click

from jaxcal.cli.common import POSITIVE, ImageNumbers
from jaxcal.data.names import LengthUnit, Orientation, QuaternionOrder, Target
from jaxcal.report.paragraphs import Verbatim
from jaxcal.runtime.messages import command_line

if TYPE_CHECKING:
    from jaxcal.io.importing.target_search import FrameResults

Command = Callable[..., Any]

_EXTENSION = re.compile(r"(?:\.(?:igs|seq))?\.[^.]*$", re.I)


class _Lag(click.ParamType):
    """Finite seconds, or ``auto``."""

    name = "seconds"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        if value == "auto":
            return value
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if not math.isfinite(seconds):
            self.fail(f"{value!r} is neither a number of seconds nor auto", param, ctx)
        return seconds


probe_frame_option = click.option(
    "--from", "source", metavar="FRAME", help="Tracked frame on the probe, e.g. Probe."
)
TRACKING = (
    probe_frame_option,
    click.option(
        "--to",
        "target",
        metavar="FRAME",
        help="Frame in which the target does not move, e.g. Reference.",
    ),
    click.option(
        "--poses",
        "--poses-from",
        "poses",
        type=click.Path(),
        metavar="FILE",
        help="File with the poses of the frames: for a folder of PNG a table with a column file "
        "or frame (or a row for each image); for a sequence another sequence, a tracker's export "
        "or a table, matched by time.",
    ),
    click.option(
        "--lag",
        "lag_s",
        type=_Lag(),
        default=0.0,
        metavar="SECONDS",
        help="An image stamped t shows what was at t - SECONDS: poses are looked up there; auto: "
        "estimated from the target in the images (not for jaxcal pick).",
    ),
    click.option(
        "--orientation",
        type=click.Choice(get_args(Orientation)),
        help="Orientation of the frames, if their file does not say it.",
    ),
)
"""Which poses the frames have."""
TABLES = (
    click.option(
        "--pose-units",
        type=click.Choice(get_args(LengthUnit)),
        help="Unit of translations if the file of the poses does not say it; mm by default. Some "
        "electromagnetic trackers send inches (in).",
    ),
    click.option(
        "--quaternion",
        type=click.Choice(get_args(QuaternionOrder)),
        help="Whether a quaternion's scalar is the last or the first of its numbers.",
    ),
    click.option(
        "--skip-invalid",
        is_flag=True,
        help="Leave out rows of tables that are marked as invalid, have gaps or a pose of zeros.",
    ),
    click.option(
        "--invert-poses",
        is_flag=True,
        help="The file's poses are from the tracker to the probe (or tool): take their inverses.",
    ),
)
"""How poses, and tables of them, are read."""
spacing_option = click.option(
    "--spacing",
    "spacing_mm",
    type=POSITIVE,
    nargs=2,
    metavar="LATERAL AXIAL",
    help="Size of a pixel, mm.",
)
region_option = click.option(
    "--region",
    type=int,
    nargs=4,
    metavar="COLUMN ROW COLUMNS ROWS",
    help="Part of the frames to look in, px: its first column and row, and its size.",
)
SEARCH = (
    click.option(
        "--frames",
        type=ImageNumbers(),
        metavar="LIST",
        help="Use only these frames of a sequence, or rows of a table, e.g. 10-50,60: by their own "
        "numbers if the file has some, else from 0.",
    ),
    click.option(
        "--target",
        "target_kind",
        type=click.Choice(get_args(Target)),
        help="What to look for in frames: one bright spot (the default), or a crossing of wires.",
    ),
    region_option,
    spacing_option,
    click.option(
        "--spacing-from",
        type=click.Path(),
        metavar="CLIP.dcm",
        help="DICOM clip of the same machine and depth, which states the size of a pixel "
        "(jaxcal[dicom]).",
    ),
    click.option(
        "--ignore-time",
        is_flag=True,
        help="If times repeat, go back or are missing, import without them.",
    ),
)
"""What to look for, where, and how large a pixel is."""


def with_options(options: tuple[Callable[[Command], Command], ...]) -> Callable[[Command], Command]:
    """A decorator that adds options to a command, in their order."""

    def decorated(command: Command) -> Command:
        for option in reversed(options):
            command = option(command)
        return command

    return decorated


def given_options(options: dict[str, Any], *, orientation: bool = False) -> list[str]:
    """The options of poses that were given, to type them again with ``jaxcal pick`` or import.

    ``orientation``: with that of the frames, which an import of points refuses.
    """
    names = {"poses": "poses", "from": "source", "to": "target", "lag": "lag_s"}
    names |= {"orientation": "orientation"} if orientation else {}
    names |= {"pose-units": "pose_units", "quaternion": "quaternion"}
    stated: list[str] = []
    for name, key in names.items():
        # Nothing is estimated where points are yet to be placed.
        if options[key] and options[key] != "auto":
            stated += [f"--{name}", f"{options[key]}"]
    flags = [("--skip-invalid", "skip_invalid"), ("--invert-poses", "invert_poses")]
    return stated + [flag for flag, key in flags if options[key]]


def by_hand(source: str, found: FrameResults, options: dict[str, Any]) -> list[str]:
    """The command that places points by hand, where the target was found in few frames."""
    if found.counts["not credible"] <= found.counts["found"]:
        return []
    again = given_options(options, orientation=True)
    later = ", and import them with --lag auto" if options["lag_s"] == "auto" else ""
    return [
        "- few show a credible target: check --region and --target, or place the points by "
        f"hand{later}:",
        Verbatim("  " + command_line(["jaxcal", "pick", source, *again])),
    ]


def beside(frames: str, ending: str) -> str:
    """Where a command writes by default: ``a.igs.mha``, or a folder ``a``, becomes ``a`` + ending.

    Only the sequence's own extension goes: what is before it may hold dots, as dates and depths do.
    """
    path = Path(frames)
    if path.name in ("", ".."):
        path = Path(os.path.abspath(frames))
    name = path.name if path.is_dir() else _EXTENSION.sub("", path.name)
    return str(path.with_name(name + ending))
