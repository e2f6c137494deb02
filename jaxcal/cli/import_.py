"""``jaxcal import``: text recordings as HDF5."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from jaxcal.cli.common import POSITIVE, ExitCode, import_engine
from jaxcal.errors import InputError

if TYPE_CHECKING:
    from jaxcal.recording import Recording

_PLUS = (".mha", ".mhd", ".nrrd", ".nhdr")


@click.command("import")
@click.argument("sources", nargs=-1, required=True, type=click.Path(), metavar="SOURCE...")
@click.argument("out", type=click.Path(), metavar="OUT.h5")
@click.option(
    "--spacing",
    type=POSITIVE,
    nargs=2,
    metavar="LATERAL AXIAL",
    help="Size of a pixel, mm.",
)
@click.option(
    "--units",
    type=click.Choice(["px", "mm"]),
    help="Unit of u and v in a CSV: px (lateral and axial pixel, the default) or mm (lateral "
    "position and range).",
)
def import_(
    sources: tuple[str, ...],
    out: str,
    spacing: tuple[float, float] | None,
    units: Literal["px", "mm"] | None,
) -> int:
    """Turn tables into a recording, OUT.h5.

    SOURCE is one CSV file with a row "time, pose, u, v" for each image (pose: probe -> tracker, mm,
    12 or 16 numbers row by row), or two text files: POSES (three rows of four numbers for each
    image) and POINTS (a row "u v" in pixels for each image).
    """
    _check(sources, out)
    if len(sources) == 2 and units == "mm":
        raise click.BadParameter("a pair of text files holds pixels", param_hint="--units")
    if spacing is not None and units == "mm":
        raise click.BadParameter("points in mm have no pixel size", param_hint="--spacing")
    import_engine()
    from jaxcal.io.hdf5 import save

    recording = _read(sources, spacing, units or "px")
    save(recording, out)
    images = recording.calibration
    unscaled = images.kind == "pixel" and images.spacing_mm is None
    hint = "; their size is not known: calibrate with --estimate scale" if unscaled else ""
    click.echo(f"{out}: {len(images)} images, {images.kind}s{hint}")
    return ExitCode.CONVERGED


def _read(
    sources: tuple[str, ...], spacing: tuple[float, float] | None, units: Literal["px", "mm"]
) -> Recording:
    from jaxcal.io.text import read_crosswire, read_csv

    first, *rest = sources
    if rest:
        return read_crosswire(first, rest[0], spacing_mm=spacing)
    return read_csv(first, spacing_mm=spacing, units=units)


def _check(sources: tuple[str, ...], out: str) -> None:
    if len(sources) > 2:
        raise click.UsageError(
            f"{len(sources)} sources; one CSV, or POSES and POINTS, are read (OUT.h5 comes last)"
        )
    sequence = next((source for source in sources if source.lower().endswith(_PLUS)), None)
    if sequence is not None:
        raise InputError(f"{sequence}: this version does not read PLUS sequences")
    # Whoever forgets OUT.h5 names a source last: it must not be overwritten.
    try:
        with Path(out).open("rb") as existing:
            start = existing.read(8)
    except (OSError, ValueError):
        return
    if start and start != b"\x89HDF\r\n\x1a\n":
        raise InputError(f"{out}: exists and is not a recording; name the output file last")
