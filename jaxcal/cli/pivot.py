"""``jaxcal pivot``: a tracked tool's tip from poses taken while it turns about its tip."""

from __future__ import annotations

import click

from jaxcal.cli.common import (
    exit_code,
    import_engine,
    json_option,
    print_json,
    print_page,
    progress,
)


@click.command()
@click.argument("poses", type=click.Path(), metavar="POSES")
@click.option(
    "--no-robust", is_flag=True, help="Use every pose, also those that do not fit the rest."
)
@json_option
def pivot(poses: str, no_robust: bool, as_json: bool) -> int:
    """Find the tip of a tracked tool that was turned about its tip.

    POSES is a text file with a row for each pose, tool -> tracker, mm: x y z qx qy qz qs, or the
    matrix row by row (12 or 16 numbers). Poses that do not fit the rest are left out and named.
    """
    import_engine()
    from jaxcal.calibration.pivot import calibrate_pivot
    from jaxcal.io.given_files import naming
    from jaxcal.io.text import read_poses
    from jaxcal.report.pivot import pivot_lines
    from jaxcal.runtime.jax_cache import enable_compilation_cache

    measured = read_poses(poses)
    enable_compilation_cache()
    with progress("calibrating the pivot"), naming(poses):
        record = calibrate_pivot(measured, robust=not no_robust).record()
    if as_json:
        print_json(record)
    else:
        print_page(*pivot_lines(record))
    return exit_code([record])
