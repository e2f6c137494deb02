"""``jaxcal-hw bench``: the emulated bench as a server."""

from __future__ import annotations

import click

from hw.cli.common import controller_option, pose_hz_of, speed_option
from jaxcal.cli.common import ExitCode


@click.command(short_help="Serve an emulated bench until Ctrl-C.")
@speed_option
@controller_option
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    metavar="N",
    help="Seed of the simulated world.",
)
def bench(speed: float | None, controller: str | None, seed: int) -> int:
    """Serve an emulated bench until Ctrl-C; prints one JSON line with its addresses."""
    from hw.bench.run import BenchOptions, serve

    pose_hz = pose_hz_of(controller)
    serve(BenchOptions(speed=1.0 if speed is None else speed, seed=seed, pose_hz=pose_hz))
    return ExitCode.CONVERGED
