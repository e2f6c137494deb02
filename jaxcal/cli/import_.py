"""``jaxcal import``: recordings of other programs as HDF5."""

from __future__ import annotations

from typing import Any

import click

from jaxcal import InputError, OutputError
from jaxcal.cli.common import ExitCode, progress
from jaxcal.cli.sequence_options import by_hand, search_options, table_options, tracking_options
from jaxcal.io.atomic import check_writable
from jaxcal.io.outputs import RECORDING, check_output, is_recording


@click.command("import")
@click.argument("sources", nargs=-1, required=True, type=click.Path(), metavar="SOURCE...")
@click.argument("out", type=click.Path(), metavar="OUT.h5")
@click.option(
    "--units",
    type=click.Choice(["px", "mm"]),
    help="Unit of u and v in a table: px (lateral and axial pixel, the default) or mm (lateral "
    "position and range).",
)
@table_options
@tracking_options
@click.option(
    "--points",
    type=click.Choice(["labels", "order"]),
    help="How points of Slicer belong to frames: by the number that ends each label, or one for "
    "each frame.",
)
@search_options
def import_(sources: tuple[str, ...], out: str, **options: Any) -> int:
    """Turn other programs' files into a recording, OUT.h5.

    SOURCE is one of: a table (CSV) with a pose and a point in each row; a tracked sequence of PLUS
    or Slicer (.igs.mha, .igs.mhd, .igs.nrrd, .seq.nrrd), or a folder of PNG with --poses, whose
    frames show the target; such a sequence, or an export of NDI ToolBox or Motive, and a file of
    points (a table with frame or time, u and v, or Slicer's .mrk.json or .fcsv); or POSES (three
    rows of four numbers for each image) and POINTS (a row "u v" in pixels).
    docs/reference/formats.md says what each must hold.
    """
    _check(sources, out, options)
    from jaxcal.io.hdf5 import save
    from jaxcal.io.import_options import ImportOptions
    from jaxcal.io.importing import import_files

    with progress("importing"):
        recording, notes, frames = import_files(sources, ImportOptions(**options))
    save(recording, out, frames)
    images = recording.calibration
    unscaled = images.kind == "pixel" and images.spacing_mm is None
    hint = "; their size is not known: calibrate with --estimate scale" if unscaled else ""
    click.echo(f"{out}: {len(images)} images, {images.kind}s{hint}")
    for note in notes:
        click.echo(f"- {note}")
    for line in [] if frames is None else by_hand(sources[0], frames, options):
        click.echo(line)
    return ExitCode.CONVERGED


def _check(sources: tuple[str, ...], out: str, options: dict[str, Any]) -> None:
    if len(sources) > 2:
        raise click.UsageError(
            f"{len(sources)} sources; one table or sequence, or two files that belong together, "
            "are read (OUT.h5 comes last)"
        )
    if options["spacing_mm"] is not None and options["units"] == "mm":
        raise click.BadParameter("points in mm have no pixel size", param_hint="--spacing")
    named = [*sources, options["poses"], options["spacing_from"]]
    read = [each for each in named if each is not None]
    try:
        check_output(out, "a recording", is_recording, read, endings=RECORDING)
        check_writable(out)
    except (InputError, OutputError) as error:
        # Whoever forgets OUT.h5 names a source last.
        raise type(error)(f"{error} (name the output file last)") from None
