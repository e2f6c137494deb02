"""The entry point ``jaxcal``."""

from __future__ import annotations

import gc
import sys
from collections.abc import Sequence

import click

from jaxcal import __version__
from jaxcal.cli.apply import apply
from jaxcal.cli.cache import cache
from jaxcal.cli.calibrate import calibrate
from jaxcal.cli.common import Commands
from jaxcal.cli.compare import compare
from jaxcal.cli.demo import demo
from jaxcal.cli.export import export
from jaxcal.cli.import_ import import_
from jaxcal.cli.pick import pick
from jaxcal.cli.pivot import pivot
from jaxcal.cli.plan import plan
from jaxcal.cli.run import run
from jaxcal.cli.segment import segment
from jaxcal.cli.serve import serve
from jaxcal.cli.simulate import simulate
from jaxcal.cli.study import study


@click.group(
    cls=Commands,
    no_args_is_help=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Exit status: 0 converged; 2 bad usage or input, with one line that says what; "
    "3 solved, but not converged or not determined by the images, or imported without most of the "
    "frames; 5 less accurate than required.",
)
@click.version_option(__version__, prog_name="jaxcal")
def commands() -> None:
    """Calibrate a tracked or robotic ultrasound probe from images of one small fixed target."""


for _command in (
    demo,
    simulate,
    import_,
    segment,
    pick,
    calibrate,
    export,
    apply,
    compare,
    serve,
    plan,
    pivot,
    study,
    cache,
):
    commands.add_command(_command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``jaxcal``; see :func:`jaxcal.cli.run.run`."""
    # Tracing makes millions of objects that die young. Looking through them at Python's own
    # threshold (700) takes 6 to 10 % of the time to a first answer.
    gc.set_threshold(50_000, 20, 50)
    return run(commands, "jaxcal", arguments)


if __name__ == "__main__":
    sys.exit(main())
