"""``jaxcal-hw check``: what is wrong with the devices."""

from __future__ import annotations

from contextlib import ExitStack

import click

from hw.cli.common import (
    bench_option,
    controller_option,
    setup_of,
    setup_option,
    speed_option,
    started,
)
from jaxcal import InputError
from jaxcal.cli.common import ExitCode


@click.command()
@bench_option
@setup_option
@speed_option
@controller_option
def check(bench: bool, setup_path: str | None, speed: float | None, controller: str | None) -> int:
    """Check each device and say what is wrong; nothing moves."""
    if bench == (setup_path is not None):
        raise InputError("give either --bench or --setup TOML")
    if (speed, controller) != (None, None) and not bench:
        raise InputError("--speed and --controller need --bench")
    from hw.setup.check import check as look

    with ExitStack() as stack:
        found = look(setup_of(setup_path, started(stack, bench, None, speed or 1.0, controller)))
    for finding in found:
        click.echo(f"{finding.device}: {'wrong' if finding.wrong else 'good'}: {finding.facts}")
        for line in finding.wrong:
            click.echo(f"  {line}")
    return ExitCode.STOPPED if any(finding.wrong for finding in found) else ExitCode.CONVERGED
