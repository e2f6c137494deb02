"""``jaxcal pick``: points placed by hand, on a page of this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from jaxcal.cli.common import ExitCode
from jaxcal.cli.sequence_options import TABLES, TRACKING, beside, given_options, with_options
from jaxcal.runtime.messages import command_line, counted


@click.command(short_help="Place the target's point in each frame by a click.")
@click.argument("frames", type=click.Path(), metavar="SOURCE")
@click.argument("picks", type=click.Path(), metavar="[PICKS.csv]", required=False)
@with_options(TRACKING)
@with_options(TABLES)
@click.option(
    "--every",
    type=click.IntRange(1),
    default=1,
    metavar="N",
    help="Show every N-th of the frames that have tracking.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    metavar="N",
    help="Port of the page, on 127.0.0.1; by default any free one.",
)
def pick(frames: str, picks: str | None, every: int, port: int, **options: Any) -> int:
    """Place the target's point in each frame of SOURCE by a click, and save them in PICKS.csv.

    For frames in which `jaxcal import` finds no credible target. SOURCE is a sequence or a folder
    of PNG. Prints the address of a local web page, which can be opened only on this machine and
    only with this address. Every click is saved at once; run the same command again to continue. By
    default PICKS.csv is beside SOURCE and has its name.
    """
    from jaxcal.io.atomic import check_writable
    from jaxcal.io.importing.frame_poses import frames_to_show, open_sequence
    from jaxcal.io.importing.sources import ImportOptions
    from jaxcal.io.picker.frames import Frames
    from jaxcal.io.picker.picks import Picks
    from jaxcal.io.picker.server import Picker

    asked = ImportOptions(**options)
    name = Path(os.path.abspath(frames)).name
    out = beside(frames, "-picks.csv") if picks is None else picks
    sequence, notes = open_sequence(frames, asked)
    shown, size, further = frames_to_show(sequence, asked, every)
    check_writable(out)
    placed = Picks(out, name, size, len(sequence), shown, sequence.files, asked.orientation)
    pictures = Frames(sequence, asked.orientation)
    # What cannot be shown is said here, not on the page.
    pictures.png(shown[0])
    for note in [*notes, *further]:
        click.echo(f"- {note}")
    with Picker(placed, pictures, name, port) as page:
        try:
            click.echo(f"{counted(len(shown), 'frame')} to show; open {page.url}")
            click.echo("to end: Finish on the page, or Ctrl-C; every click is saved")
            while not page.wait(0.5):
                pass
        except KeyboardInterrupt:
            click.echo()
    _tell(placed, frames, out, options)
    return ExitCode.CONVERGED


def _tell(placed: Any, source: str, out: str, options: dict[str, Any]) -> None:
    count, left = len(placed.points), len(placed.left)
    if not placed.points and not placed.skipped:
        click.echo(f"no points; {out} was not made")
        return
    click.echo(
        f"{out}: {counted(count, 'point')}, {counted(len(placed.skipped), 'frame')} skipped"
        + (f", {left} still to do (the same command continues)" if left else "")
    )
    if count:
        import_them = ["jaxcal", "import", source, out, "OUT.h5", *given_options(options)]
        click.echo(f"next: {command_line(import_them)}")
