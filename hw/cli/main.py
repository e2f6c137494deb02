"""The entry point ``jaxcal-hw``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import click

from hw.cli.acquire import acquire
from hw.cli.bench import bench
from hw.cli.check import check
from hw.cli.free_hand import free_hand
from hw.cli.setup import setup
from hw.runtime.interrupts import as_interrupts
from jaxcal import __version__
from jaxcal.cli.common import Commands
from jaxcal.cli.run import run


@click.group(
    cls=Commands,
    no_args_is_help=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Exit status: 0 done; 2 bad usage or input, with one line that says what; 3 done, but "
    "the calibration did not converge; 4 a device failed: motion has ended, and the recording can "
    "be resumed; 5 done, but the calibration is less than fair; 130 interrupted: motion has "
    "ended, as for 4.",
)
@click.version_option(__version__, prog_name="jaxcal-hw")
def commands() -> None:
    """Acquire recordings for jaxcal: robot, active echo element and ultrasound machine.

    The operator is responsible for the robot: its own safety configuration and emergency stop come
    first, and nothing here replaces them.
    """


for _command in (setup, check, acquire, free_hand, bench):
    commands.add_command(_command)


def _open_standard_error() -> None:
    """Discard what is told there where it is closed, as in some jobs without a terminal.

    The processes that are started inherit it.
    """
    number = os.open(os.devnull, os.O_WRONLY)
    try:
        os.fstat(2)
    except OSError:
        os.dup2(number, 2)
    sys.stderr = open(number, "w", encoding="utf-8")  # noqa: SIM115


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``jaxcal-hw``; see :func:`jaxcal.cli.run.run`."""
    if sys.stderr is None:
        _open_standard_error()
    with as_interrupts():
        return run(commands, "jaxcal-hw", arguments)


if __name__ == "__main__":
    sys.exit(main())
