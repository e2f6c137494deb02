"""``jaxcal simulate``: a simulated experiment as a recording, with truth and test images."""

from __future__ import annotations

import click

from jaxcal.cli.common import NOT_NEGATIVE, ExitCode, import_engine, progress
from jaxcal.errors import InputError


@click.command()
@click.argument("out", type=click.Path(), metavar="OUT.h5")
@click.option("--images", type=int, default=50, show_default=True, help="Calibration images.")
@click.option(
    "--elevation",
    type=NOT_NEGATIVE,
    default=1.0,
    show_default=True,
    metavar="MM",
    help="Elevational offsets: their bound (uniform) or SD (normal).",
)
@click.option(
    "--elevation-distribution",
    type=click.Choice(["uniform", "normal"]),
    default="uniform",
    show_default=True,
    help="How the elevational offsets are distributed.",
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
    type=click.Choice(["linear", "curvilinear"]),
    default="linear",
    show_default=True,
    help="Transducer.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**63 - 1),
    default=0,
    show_default=True,
    metavar="N",
    help="Seed of the random draws.",
)
def simulate(
    out: str,
    images: int,
    elevation: float,
    elevation_distribution: str,
    noise: float,
    probe: str,
    seed: int,
) -> int:
    """Simulate an experiment after the paper's section 3.1 and write it to OUT.h5.

    The file holds the calibration images, noise-free test images and the truth.
    """
    if probe != "linear":
        raise InputError("this version simulates linear probes only")
    import_engine()
    from jaxcal.cli.cache import enable_compilation_cache
    from jaxcal.io.hdf5 import save
    from jaxcal.simulation import Protocol, simulate_recording

    protocol = Protocol(
        images=images,
        elevation_mm=elevation,
        elevation_distribution="normal" if elevation_distribution == "normal" else "uniform",
        noise_mm=noise,
    )
    enable_compilation_cache()
    with progress("simulating"):
        recording = simulate_recording(protocol, seed)
    save(recording, out)
    click.echo(f"{out}: {images} images, {protocol.test_images} test images, seed {seed}")
    return ExitCode.CONVERGED
