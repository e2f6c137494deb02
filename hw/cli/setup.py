"""``jaxcal-hw setup``: the description of a bench, to fill in."""

from __future__ import annotations

from pathlib import Path

import click

from jaxcal import InputError
from jaxcal.cli.common import ExitCode


@click.command("setup", short_help="Write a commented description of a bench, to fill in.")
@click.argument("out", type=click.Path(), metavar="[OUT.toml]", required=False)
def setup(out: str | None) -> int:
    """Write a commented description of a bench, to fill in, to OUT.toml or to standard output."""
    from importlib.resources import files

    from jaxcal.io.atomic import write_text
    from jaxcal.runtime.messages import command_line

    text = files("hw.setup").joinpath("example_setup.toml").read_text("utf-8")
    if out is None:
        click.echo(text, nl=False)
        return ExitCode.CONVERGED
    if Path(out).exists():
        raise InputError(f"{out}: exists; name another file")
    write_text(out, text)
    check = command_line(["jaxcal-hw", "check", "--setup", out])
    click.echo(f"{out}: written; fill it in, then {check}")
    return ExitCode.CONVERGED
