"""``jaxcal import``: recordings of other programs as HDF5."""

from __future__ import annotations

from typing import Any, get_args

import click

from jaxcal import InputError, OutputError
from jaxcal.cli.common import ExitCode, progress
from jaxcal.cli.sequence_options import SEARCH, TABLES, TRACKING, by_hand, with_options
from jaxcal.data.names import Assignment, PointUnit
from jaxcal.io.atomic import check_writable
from jaxcal.io.outputs import RECORDING, check_output, is_hdf5_recording, is_recording
from jaxcal.runtime.messages import counted


@click.command("import")
@click.argument("sources", nargs=-1, type=click.Path(), metavar="SOURCE...")
@click.argument("out", type=click.Path(), metavar="OUT.h5")
@click.option(
    "--units",
    type=click.Choice(get_args(PointUnit)),
    help="Unit of u and v in a table: px (lateral and axial pixel, the default) or mm (lateral "
    "position and range).",
)
@with_options(TABLES)
@with_options(TRACKING)
@click.option(
    "--points",
    type=click.Choice(get_args(Assignment)),
    help="How points of Slicer belong to frames: by the number that ends each label, or one for "
    "each frame.",
)
@with_options(SEARCH)
@click.option(
    "--add-to",
    type=click.Path(),
    metavar="REC.h5",
    help="Recording to which the images are added: OUT.h5 has those of both. The target must be "
    "where it was, and the markers on the probe as well. SOURCE may then be a recording, too.",
)
def import_(sources: tuple[str, ...], out: str, add_to: str | None, **options: Any) -> int:
    """Turn other programs' files into a recording, OUT.h5.

    SOURCE is one of: a table (CSV) with a pose and a point in each row, or two tables, one with the
    poses and one with the points; a tracked sequence of PLUS or Slicer (.igs.mha, .igs.mhd,
    .igs.nrrd, .seq.nrrd), or a folder of PNG with --poses, whose frames show the target; such a
    sequence, or an export of NDI ToolBox or Motive, and a file of points (a table with frame or
    time, u and v, or Slicer's .mrk.json or .fcsv); or POSES (for each image three rows of four
    numbers, or a row of 12 or 16) and POINTS (a row "u v" in pixels).
    docs/reference/formats.md says what each must hold.
    """
    _check(sources, out, add_to, options)
    from jaxcal.data.recording import MINIMUM_IMAGES, OF_SOME, joined, shared_images
    from jaxcal.io.hdf5 import load, save
    from jaxcal.io.importing.files import import_files
    from jaxcal.io.importing.sources import ImportOptions

    first = None if add_to is None else load(add_to)
    with progress("importing"):
        if first is not None and len(sources) == 1 and is_hdf5_recording(sources[0]):
            if ImportOptions(**options) != ImportOptions():
                raise InputError(f"{sources[0]}: is a recording: only --add-to goes with it")
            recording, notes, frames, most_lost = load(sources[0]), [], None, False
        else:
            least = MINIMUM_IMAGES if first is None else 1
            asked = ImportOptions(**options, minimum=least)
            recording, notes, frames, most_lost = import_files(sources, asked)
    if first is None:
        save(recording, out, frames)
    else:
        added = len(recording)
        if shared := shared_images(recording.calibration, first.calibration):
            raise InputError(
                f"{recording.source}: {shared} of its {added} images are in {add_to} already, and "
                "an image counts once"
            )
        notes = [f"{counted(added, 'image')} added to the {len(first)} of {add_to}", *notes]
        pair = first.calibration, recording.calibration
        held = [{name for name in OF_SOME if getattr(each, name) is not None} for each in pair]
        if lost := [words for name, words in OF_SOME.items() if name in held[0] ^ held[1]]:
            notes.append(f"{', '.join(lost)} are left out: only some images have them")
        recording = joined(first, recording)
        save(recording, out)
    images = recording.calibration
    unscaled = images.kind == "pixel" and images.spacing_mm is None
    hint = "; their size is not known: calibrate with --estimate scale" if unscaled else ""
    click.echo(f"{out}: {counted(len(images), 'image')}, {images.kind}s{hint}")
    for note in notes:
        click.echo(f"- {note}")
    for line in [] if frames is None else by_hand(sources[0], frames, options):
        click.echo(line)
    return ExitCode.NOT_CONVERGED if most_lost else ExitCode.CONVERGED


def _check(sources: tuple[str, ...], out: str, add_to: str | None, options: dict[str, Any]) -> None:
    if not sources:
        raise click.UsageError(f"{out}: name what to import, and then the recording to write")
    if len(sources) > 2:
        raise click.UsageError(
            f"{len(sources)} sources; one table or sequence, or two files that belong together, "
            "are read (OUT.h5 comes last)"
        )
    if options["spacing_mm"] is not None and options["units"] == "mm":
        raise click.BadParameter("points in mm have no pixel size", param_hint="--spacing")
    named = [*sources, add_to, options["poses"], options["spacing_from"]]
    read = [each for each in named if each is not None]
    try:
        check_output(out, "a recording", is_recording, read, endings=RECORDING)
        check_writable(out)
    except (InputError, OutputError) as error:
        # Whoever forgets OUT.h5 names a source last.
        raise type(error)(f"{error} (name the output file last)") from None
