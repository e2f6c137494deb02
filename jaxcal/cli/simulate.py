"""``jaxcal simulate``: a simulated experiment as a recording, with truth and test images."""

from __future__ import annotations

from typing import get_args

import click

from jaxcal import InputError
from jaxcal.cli.common import (
    NOT_NEGATIVE,
    POSITIVE,
    ExitCode,
    import_engine,
    prepare_jax,
    progress,
    seed_option,
)
from jaxcal.data.names import ProbeKind
from jaxcal.study.laws import OFFSET_LAWS, LawName


@click.command(short_help="Simulate an experiment and write its recording.")
@click.argument("out", type=click.Path(), metavar="OUT.h5")
@click.option("--images", type=int, default=50, show_default=True, help="Calibration images.")
@click.option(
    "--elevation",
    type=NOT_NEGATIVE,
    default=1.0,
    show_default=True,
    metavar="MM",
    help="Elevational offsets: their bound or SD, whichever their distribution has.",
)
@click.option(
    "--elevation-distribution",
    type=click.Choice(OFFSET_LAWS),
    default="uniform",
    show_default=True,
    metavar="LAW",
    help=f"How the elevational offsets are distributed: {', '.join(OFFSET_LAWS)}.",
)
@click.option(
    "--noise",
    type=NOT_NEGATIVE,
    default=0.5,
    show_default=True,
    metavar="MM",
    help="SD of the noise on each element's distance.",
)
@click.option(
    "--probe",
    type=click.Choice(get_args(ProbeKind)),
    default="linear",
    show_default=True,
    help="Transducer: L14-5 or C5-2. The data of a curvilinear one are its times of flight.",
)
@click.option("--raw", is_flag=True, help="Write times of flight, not the points fitted to them.")
@click.option(
    "--clock-mhz",
    type=POSITIVE,
    metavar="MHZ",
    help="Round times of flight to a clock of this frequency.",
)
@seed_option("Seed of the random draws.")
def simulate(
    out: str,
    images: int,
    elevation: float,
    elevation_distribution: LawName,
    noise: float,
    probe: ProbeKind,
    raw: bool,
    clock_mhz: float | None,
    seed: int,
) -> int:
    """Simulate an experiment like that of the paper's section 3.1 and write it to OUT.h5.

    The file holds the calibration images, noise-free test images and the truth. Calibration images
    are points, or times of flight with --raw and of curvilinear probes; test images are points.
    """
    raw = raw or probe == "curvilinear"
    if clock_mhz is not None and not raw:
        raise InputError("--clock-mhz rounds times of flight: it needs --raw")
    from jaxcal.io.outputs import RECORDING, check_output, is_simulated

    check_output(out, "a simulated recording", is_simulated, endings=RECORDING)
    import_engine()
    from jaxcal.data.probe import PRESETS
    from jaxcal.io.hdf5 import save
    from jaxcal.study.simulation import Protocol, simulate_recording

    protocol = Protocol(
        images=images,
        elevation_mm=elevation,
        elevation_distribution=elevation_distribution,
        noise_mm=noise,
        probe=PRESETS[probe],
        raw=raw,
    )
    prepare_jax()
    with progress("simulating"):
        clock = None if clock_mhz is None else 1e6 * clock_mhz
        recording = simulate_recording(protocol, seed, clock_hz=clock)
    save(recording, out)
    what = "images of times of flight" if raw else "images"
    click.echo(f"{out}: {images} {what}, {protocol.test_images} test images, seed {seed}")
    return ExitCode.CONVERGED
