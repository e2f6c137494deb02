"""``jaxcal cache``: compiled programs kept between runs, in the user's own cache folder.

A calibration takes milliseconds and its compilation seconds, so the second run is much faster.
:mod:`jaxcal.runtime.program_cache` says what is kept, and when it is trusted. ``JAXCAL_NO_CACHE=1``
turns it off.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, get_args

import click

from jaxcal import InputError, OutputError
from jaxcal.cli.common import Commands, ExitCode, json_option, print_json, print_page, progress
from jaxcal.report.paragraphs import simple_table
from jaxcal.runtime import jax_cache, program_cache
from jaxcal.runtime.messages import counted
from jaxcal.solvers.names import Method

if TYPE_CHECKING:
    from jaxcal.data.problem import Problem

WARMED_IMAGES = (64,)
"""Numbers of images that ``warm`` prepares for, unless it is told others."""


@click.group(
    cls=Commands, no_args_is_help=False, short_help="Show, prepare or remove the compiled programs."
)
def cache() -> None:
    """Show, prepare or remove the compiled programs that are kept between runs."""


@cache.command(short_help="List the programs that are kept.")
@json_option
def show(as_json: bool) -> int:
    """List the programs: plan, number of images, size, time to compile, last use."""
    try:
        folder, found = program_cache.private_folder(), program_cache.entries()
    except (OSError, RuntimeError) as error:
        raise InputError(f"the cache cannot be used: {error}") from error
    now = time.time()
    rows = [
        {
            **entry.header.get("label", {}),
            "bytes": entry.size,
            "compile_s": entry.header.get("seconds"),
            "used_s_ago": round(max(now - entry.used, 0.0)),
            "refused": not entry.header,
        }
        for entry in found
    ]
    total = sum(entry.size for entry in found)
    if as_json:
        print_json(
            {"folder": str(folder), "bytes": total, "on": program_cache.is_on(), "programs": rows}
        )
        return ExitCode.CONVERGED
    off = [] if program_cache.is_on() else [f"It is off: {program_cache.SWITCH} is set."]
    size = f"{total / 2**20:.1f} of {program_cache.LIMIT_BYTES >> 20} MiB"
    said = f"{counted(len(rows), 'program')}, {size}, in {folder}"
    print_page(*([_table(rows)] if rows else []), said, *off)
    return ExitCode.CONVERGED


@cache.command()
@click.argument("recording", type=click.Path(), metavar="[REC]", required=False)
@click.option(
    "--images",
    type=click.IntRange(4, 100_000),
    multiple=True,
    default=WARMED_IMAGES,
    show_default=True,
    metavar="N",
    help="Number of images; may be repeated. One program serves every number of images up to the "
    "next of 64, 128, 256, 512, ...",
)
@click.option(
    "--method",
    "methods",
    type=click.Choice(get_args(Method)),
    multiple=True,
    default=("joint",),
    show_default=True,
    help="May be repeated.",
)
@click.option(
    "--estimate",
    metavar="LIST",
    help="Further unknowns, as of jaxcal calibrate; with scale the points are pixels.",
)
def warm(
    recording: str | None,
    images: tuple[int, ...],
    methods: tuple[Method, ...],
    estimate: str | None,
) -> int:
    """Compile now what later runs of "jaxcal calibrate" need.

    Compiles for recordings of the same kind as REC; without REC, for points in mm or, with
    --estimate scale, in pixels.
    """
    if not program_cache.is_on():
        raise InputError(f"the cache is off: {program_cache.SWITCH} is set")
    try:
        program_cache.private_folder()
    except (OSError, RuntimeError) as error:
        raise OutputError(f"the cache cannot be used: {error}") from error
    from jaxcal.calibration.calibrate import calibrate
    from jaxcal.data.problem import taken
    from jaxcal.model.unknowns import unknown_names
    from jaxcal.runtime.executables import padded_images

    names = unknown_names(estimate)
    like = _problem(recording, "scale" in names)
    for method in methods:
        for count in sorted({padded_images(count) for count in images}):
            with progress(f"compiling ({method}, {count} images)"):
                began = time.perf_counter()
                # The first images over and over.
                many = taken(like, [k % like.images for k in range(count)])
                calibrate(many, method, estimate=names)
            seconds = time.perf_counter() - began
            print_page(f"{method}, up to {count} images: {seconds:.1f} s")
    return ExitCode.CONVERGED


@cache.command()
def clear() -> int:
    """Remove all kept programs."""
    try:
        removed = program_cache.clear()
        jax_cache.prune(jax_cache.folder(), 0)
    except (OSError, RuntimeError) as error:
        raise OutputError(f"the cache cannot be cleared: {error}") from error
    print_page(f"{counted(removed, 'program')} removed")
    return ExitCode.CONVERGED


def _table(rows: list[dict[str, Any]]) -> Any:
    names = ("method", "prior", "unknowns", "data")
    table = simple_table((*names, "images", "size (MB)", "compiled in (s)", "last used"), names)
    for row in rows:
        words = [str(row.get(name, "-")) for name in names]
        if row["refused"]:
            words[0] = "refused"
        seconds = "-" if row["compile_s"] is None else f"{row['compile_s']:.1f}"
        images, size = str(row.get("images", "-")), f"{row['bytes'] / 1e6:.1f}"
        table.add_row(*words, images, size, seconds, _ago(row["used_s_ago"]))
    return table


def _ago(seconds: int) -> str:
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"


def _problem(recording: str | None, pixels: bool) -> Problem:
    """A problem of the kind to prepare for; what it measured does not matter."""
    from jaxcal.data.problem import Problem

    if recording is not None:
        from jaxcal.io.hdf5 import load

        return Problem.from_recording(load(recording))
    import numpy as np

    from jaxcal.data.poses import matrices_from_rotations, rotations_from_vectors

    draws = np.random.default_rng(0)
    turns = rotations_from_vectors(draws.normal(size=(8, 3)))
    poses = matrices_from_rotations(turns, np.zeros((8, 3)))
    points = draws.uniform(10.0, 50.0, (8, 2))
    return Problem.from_arrays(poses, points, kind="pixel" if pixels else "point")
