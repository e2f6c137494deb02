"""What commands of ``jaxcal-hw`` share: options of the bench, and how a bench is found."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import datetime
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from hw.runtime.choices import CONTROLLERS, PHANTOMS
from jaxcal import InputError
from jaxcal.cli.common import POSITIVE
from jaxcal.io.outputs import RECORDING

if TYPE_CHECKING:
    from hw.bench.run import Bench
    from hw.setup.description import Setup

bench_option = click.option("--bench", is_flag=True, help="The emulated bench: no hardware at all.")
setup_option = click.option(
    "--setup", "setup_path", type=click.Path(), metavar="TOML", help="The bench's description."
)
speed_option = click.option(
    "--speed", type=POSITIVE, metavar="K", help="Emulated bench: times faster than real time."
)
controller_option = click.option(
    "--controller",
    type=click.Choice(CONTROLLERS),
    help="Emulated bench: series of the robot, CB (125 poses/s) or e-Series (500).  [default: cb]",
)
bench_seed_option = click.option(
    "--bench-seed",
    type=click.IntRange(min=0),
    metavar="N",
    help="Emulated bench: seed of the simulated world.",
)


def recording_path(recording: str | None, default: str, resume: bool) -> str:
    """The file of a run: named after the time by default; a new one is named as recordings are.

    A file that cannot be made is refused here, before anything that takes time.

    Args:
        recording: as the person named it; with ``resume`` not None.
        default: how a name begins that nobody gave.
        resume: whether the file is there, whatever its name.

    Raises:
        InputError: a name that hides from other programs, and from people, what is in the file.
        OutputError: a new one is there already, or its folder is missing.
    """
    if recording is None:
        recording = f"{default}-{datetime.now():%Y%m%d-%H%M%S}.h5"
    elif not resume and not recording.lower().endswith(RECORDING):
        raise InputError(f"{recording}: a recording is named {' or '.join(RECORDING)}")
    if not resume:
        from hw.recording.file import check_new

        check_new(recording)
    return recording


def check_resumed(recording: str | None, *allowed: str) -> None:
    """Refuse --resume without a recording, or with options but the allowed: the recording knows."""
    if recording is None:
        raise InputError("--resume needs the RECORDING to continue")
    context = click.get_current_context()
    for option in context.command.params:
        source = context.get_parameter_source(str(option.name))
        if (
            isinstance(option, click.Option)
            and source is ParameterSource.COMMANDLINE
            and option.name not in ("resume", *allowed)
        ):
            raise InputError(
                f"{option.opts[0]} cannot be used with --resume: the recording holds this setting"
            )


def started(
    stack: ExitStack,
    bench: bool,
    seed: int | None,
    speed: float | None,
    controller: str | None,
    phantom: str | None = None,
) -> Bench | None:
    """Start the emulated bench if it was asked for."""
    if not bench:
        return None
    from hw.setup.emulated import SPEED, start

    speed = SPEED if speed is None else speed
    return stack.enter_context(
        start(seed or 0, speed, pose_hz_of(controller), phantom or PHANTOMS[0])
    )


def pose_hz_of(controller: str | None) -> int:
    """Poses a second of the emulated robot of a series; None: of the default."""
    from hw.bench.assembly import VERSIONS

    rates: dict[str, int] = dict(zip(CONTROLLERS, VERSIONS, strict=True))
    return rates[controller or CONTROLLERS[0]]


def setup_of(path: str | None, emulated: Bench | None) -> Setup:
    """The description of the emulated bench, or of the one in a file."""
    if emulated is not None:
        from hw.setup import emulated as emulation

        return emulation.setup_of(emulated)
    from hw.setup.description import load_setup

    assert path is not None
    return load_setup(path)
