"""``jaxcal serve``: a calibration over OpenIGTLink."""

from __future__ import annotations

import click

from jaxcal.cli.common import POSITIVE, ExitCode

PORT = 18945
"""Default port; 18944 is PlusServer's."""


@click.command(short_help="Serve a calibration over OpenIGTLink.")
@click.argument("calibration", type=click.Path(), metavar="CAL")
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen at. Any other than the default lets other machines connect.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=PORT,
    show_default=True,
    metavar="N",
    help="Port to listen at; 0: any free one.",
)
@click.option(
    "--rate", type=POSITIVE, default=2.0, show_default=True, metavar="HZ", help="Messages a second."
)
@click.option(
    "--name",
    help="Name of the transform.  [default: ImageToProbe, or with the recording's name for Probe]",
)
def serve(calibration: str, host: str, port: int, rate: float, name: str | None) -> int:
    """Serve the calibration CAL as an OpenIGTLink TRANSFORM until Ctrl-C.

    In Slicer's OpenIGTLinkIF, add a connector of type client for this host and port. The matrix is
    PLUS's ImageToProbe, with the pixel size in it: leave the image's own spacing at 1.
    """
    from jaxcal.io.frame_names import probe_name
    from jaxcal.io.serving import TransformServer
    from jaxcal.result.saved import load_calibration

    transform = load_calibration(calibration)
    transform.check_usable()
    if transform.doubtful_unit is not None:
        click.echo(f"- {calibration}: {transform.doubtful_unit}", err=True)
    name = f"ImageTo{probe_name(transform.probe_frame)}" if name is None else name
    with TransformServer(name, transform.plus_matrix(), host, port) as server:
        click.echo(f"{name} at {host}:{server.port}, {rate:g} times a second; Ctrl-C ends")
        server.serve(1 / rate)
    return ExitCode.CONVERGED
