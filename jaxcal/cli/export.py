"""``jaxcal export``: a calibration for PLUS, Slicer, ITK, ROS, TUS-REC and numpy."""

from __future__ import annotations

import datetime
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from jaxcal.cli.common import POSITIVE, ExitCode, Server
from jaxcal.cli.sequence_options import with_options

if TYPE_CHECKING:
    from jaxcal.result.transform import ImageTransform, SaveFormat

TEXTS: dict[SaveFormat, str] = {
    "plus": "PLUS's <Transform> to paste into CoordinateDefinitions.",
    "slicer": "An ITK transform that Slicer loads (OUT.tfm, .txt or .h5).",
    "itk": "The same, for other programs that use ITK.",
    "ros": "YAML of easy_handeye and the command of tf2: metres, rigid.",
    "tusrec": "calib_matrix.csv of the TUS-REC challenge.",
    "numpy": "PLUS's matrix (OUT.npy), or all that is known (OUT.npz).",
}
"""What is written for other programs, by the options' names."""

NAMING = ("plus", "ros")
"""Formats that name the frames."""


def _one_format(_: click.Context, __: click.Parameter, given: tuple[str, ...]) -> str | None:
    """The one format that was asked for."""
    if len(given) > 1:
        listed = " and ".join(f"--{name}" for name in given)
        raise click.UsageError(f"{listed}: one format at a time")
    return given[0] if given else None


_FORMATS = tuple(
    click.option(
        f"--{name}", "format", flag_value=name, help=text, callback=_one_format, multiple=True
    )
    for name, text in TEXTS.items()
)


@click.command(short_help="Write a calibration for PLUS, Slicer, ITK, ROS or numpy.")
@click.argument("calibration", type=click.Path(), metavar="CAL")
@click.argument("out", type=click.Path(), metavar="[OUT]", required=False)
@with_options(_FORMATS)
@click.option(
    "--plus-config",
    type=click.Path(),
    metavar="CONFIG.xml",
    help="Put the transform into this configuration of PLUS, in place, or into a copy, OUT.",
)
@click.option(
    "--plus-server",
    type=Server(),
    metavar="HOST[:PORT]",
    help="Set the transform in a PlusServer that is running (port 18944 by default).",
)
@click.option(
    "--image-frame",
    default="Image",
    show_default=True,
    metavar="FRAME",
    help="What the other program calls the image's frame.",
)
@click.option(
    "--probe-frame",
    metavar="FRAME",
    help="What it calls the frame that is tracked on the probe.  [default: the recording's name of "
    "it, or Probe]",
)
@click.option(
    "--pixel-size",
    type=POSITIVE,
    nargs=2,
    metavar="LATERAL AXIAL",
    help="For a calibration from points in mm: size of a pixel, mm.",
)
@click.option(
    "--origin",
    type=float,
    nargs=2,
    metavar="U V",
    help="With --pixel-size: the pixel of lateral 0 and range 0 (0 0 by default).",
)
def export(
    calibration: str,
    out: str | None,
    format: SaveFormat | None,
    plus_config: str | None,
    plus_server: tuple[str, int] | None,
    image_frame: str,
    probe_frame: str | None,
    pixel_size: tuple[float, float] | None,
    origin: tuple[float, float] | None,
) -> int:
    """Write the calibration CAL for another program, to OUT or to standard output.

    The ending of OUT names the format if no option does (.xml, .tfm, .yaml, .csv, .npz, ...).

    CAL is the JSON of "jaxcal calibrate", or another program's calibration (a configuration or fCal
    result of PLUS, an ITK transform, calib_matrix.csv, a YAML of easy_handeye). PLUS's and Slicer's
    ImageToProbe takes pixels (u, v, 0, 1) to the probe in mm; ROS gets the rigid transform from the
    image plane in metres.
    """
    from jaxcal.io.frame_names import probe_name
    from jaxcal.result.saved import check_target, load_calibration, renamed

    asked = sum(chosen is not None for chosen in (format, plus_config, plus_server))
    if asked == 0 and out is not None:
        format, asked = check_target(out, None, [calibration]), 1
    if asked != 1:
        names = ", ".join(f"--{name}" for name in (*TEXTS, "plus-config"))
        raise click.UsageError(f"name one format: {names} or --plus-server")
    if plus_server is not None and out is not None:
        raise click.UsageError("--plus-server writes no file: leave OUT out")
    if origin is not None and pixel_size is None:
        raise click.BadParameter("needs --pixel-size", param_hint="--origin")
    named = format is None or format in NAMING
    if (image_frame, probe_frame or "Probe") != ("Image", "Probe") and not named:
        raise click.UsageError(
            f"--{format} names no frames: leave --image-frame, --probe-frame out"
        )
    if plus_config is None and out is not None:
        format = check_target(out, format, [calibration])
    transform = load_calibration(calibration)
    transform.check_usable()
    frames = image_frame, probe_frame or probe_name(transform.probe_frame)
    if plus_config is not None:
        check_configuration(plus_config, out, [calibration], frames)
    if pixel_size is not None:
        transform = transform.with_pixels(pixel_size, origin or (0.0, 0.0))
    if plus_config is not None:
        said = patched(transform, plus_config, out, frames)
    elif plus_server is not None:
        said = [sent(transform, plus_server, frames)]
    elif out is not None:
        said = written(transform, out, format, frames)
    else:
        assert format is not None
        said = [transform.text(format, frames=frames).removesuffix("\n")]
    click.echo("\n".join(said))
    if named and probe_frame is None and (note := renamed(transform)) is not None:
        click.echo(f"- {note}", err=True)
    if transform.doubtful_unit is not None:
        click.echo(f"- {transform.doubtful_unit}", err=True)
    return ExitCode.CONVERGED


def check_configuration(
    path: str, out: str | None, inputs: Sequence[str], frames: tuple[str, str]
) -> None:
    """Check that a transform can be put into a configuration of PLUS, in place or in a copy.

    Raises:
        InputError: the configuration cannot take it, or what would be replaced is one of the
            inputs, or no configuration.
    """
    import numpy as np

    from jaxcal.io.given_files import naming
    from jaxcal.io.outputs import check_output
    from jaxcal.io.plus import patched_configuration
    from jaxcal.io.xml import read_xml

    def is_one(path: str | os.PathLike[str]) -> bool:
        # What is wrong with the configuration itself is said below.
        return out is None or read_xml(path)[0].tag == "PlusConfiguration"

    check_output(path if out is None else out, "a configuration of PLUS", is_one, inputs)
    _, content = read_xml(path)
    with naming(path):
        patched_configuration(content, frames, np.eye(4))


def written(
    transform: ImageTransform,
    path: str,
    format: SaveFormat | None,
    frames: tuple[str, str] | None = None,
) -> list[str]:
    """Write a transform; what was done and what should be known."""
    transform.save(path, format, frames=frames)
    if format is None or path.lower().endswith(".npz"):
        return [f"{path}: written"]
    note = transform.left_out(format)
    return [f"{path}: written", *([] if note is None else [f"- {note}"])]


def patched(
    transform: ImageTransform, config: str, out: str | None, frames: tuple[str, str]
) -> list[str]:
    """Put a transform into a configuration of PLUS; what was done and what should be known."""
    from jaxcal.io.plus import patch_configuration

    notes = patch_configuration(
        config,
        frames,
        transform.plus_matrix(),
        out=out,
        error_mm=transform.error_mm,
        date=_made(transform),
    )
    written = f"{config if out is None else out}: {frames[0]} to {frames[1]} written"
    said = [*notes, transform.left_out("plus")]
    return [written, *(f"- {note}" for note in said if note is not None)]


def _made(transform: ImageTransform) -> datetime.datetime:
    """When the calibration was made, in local time; the present where that is not known."""
    if transform.date is None:
        return datetime.datetime.now()
    return datetime.datetime.fromisoformat(transform.date).astimezone()


def sent(transform: ImageTransform, server: tuple[str, int], frames: tuple[str, str]) -> str:
    """Set a transform in a running PlusServer; what was done."""
    from jaxcal.io.plus_server import update_transform

    host, port = server
    said = update_transform(
        frames, transform.plus_matrix(), host, port, error_mm=transform.error_mm
    )
    return f"{host}:{port}: {frames[0]} to {frames[1]} set; {said}"
