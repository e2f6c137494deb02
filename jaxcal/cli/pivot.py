"""``jaxcal pivot``: a tracked tool's tip from poses taken while it turns about its tip."""

from __future__ import annotations

from typing import Any

import click

from jaxcal import InputError
from jaxcal.cli.common import (
    ExitCode,
    exit_code,
    import_engine,
    json_option,
    prepare_jax,
    print_json,
    print_page,
    progress,
)
from jaxcal.cli.sequence_options import TABLES, with_options


@click.command()
@click.argument("poses", type=click.Path(), metavar="POSES")
@click.option(
    "--from", "source", metavar="FRAME", help="Tracked tool; Stylus by default if it was tracked."
)
@click.option(
    "--to",
    "target",
    metavar="FRAME",
    help="Frame in which the pivot point does not move; by default Reference if it was tracked.",
)
@with_options(TABLES)
@click.option(
    "--no-robust", is_flag=True, help="Use every pose, also those that do not fit the rest."
)
@json_option
def pivot(poses: str, no_robust: bool, as_json: bool, **options: Any) -> int:
    """Find the tip of a tracked tool that was turned about its tip.

    POSES is a sequence of PLUS or Slicer, an export of NDI ToolBox or Motive, a table (CSV) with a
    header, or a text file of poses, tool -> tracker, mm: for each a row of x, y, z and a quaternion
    (--quaternion says its order), the matrix row by row (12 or 16 numbers), or three rows of four
    numbers. Poses that do not fit the rest are left out and named; they are counted from 0, without
    those that were not tracked. The status is 5 if the SD of the tip exceeds 1 mm along some
    direction.
    """
    import_engine()
    from jaxcal.calibration.pivot import calibrate_pivot
    from jaxcal.data.recording import MetresError
    from jaxcal.io.given_files import naming
    from jaxcal.io.importing.frame_poses import tool_poses
    from jaxcal.io.importing.sources import ImportOptions
    from jaxcal.report.pivot import pivot_lines

    measured, notes = tool_poses(poses, ImportOptions(**options))
    prepare_jax()
    with progress("calibrating the pivot"), naming(poses):
        try:
            record = calibrate_pivot(measured, robust=not no_robust).record()
        except MetresError as error:
            raise InputError(f"{error} (--pose-units m)") from None
    if as_json:
        print_json(record | {"notes": notes})
    else:
        print_page(*pivot_lines(record), *(f"- {note}" for note in notes))
    return exit_code([record]) or (ExitCode.UNCERTAIN if record["uncertain"] else 0)
