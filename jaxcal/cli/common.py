"""What the commands share: numbers that are numbers, points, progress, JSON, exit codes."""

from __future__ import annotations

import enum
import importlib
import json
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from jaxcal import InputError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from jaxcal.data.recording import Recording


class ExitCode(enum.IntEnum):
    """How the process ends; the last two are the shell's names for signals 2 and 13.

    Only an acquisition ends with 4: stopped early, by a device or a person, and to be resumed. 5 is
    a calibration that converged and is less accurate than was required (fair, if not told
    otherwise), or a tip with an SD beyond 1 mm. An import that had to leave out most frames ends
    with 3.
    """

    CONVERGED = 0
    INTERNAL_ERROR = 1
    BAD_INPUT = 2
    NOT_CONVERGED = 3
    STOPPED = 4
    UNCERTAIN = 5
    INTERRUPTED = 130
    BROKEN_PIPE = 141


class Number(click.ParamType):
    """A finite number, positive (or, if asked for, zero), up to ``largest``."""

    name = "number"

    def __init__(self, *, zero: bool = False, largest: float = math.inf) -> None:
        self.zero, self.largest = zero, largest

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number, or a usage error."""
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        good = math.isfinite(number) and 0 <= number <= self.largest
        if not good or (number == 0 and not self.zero):
            wanted = "zero or a positive number" if self.zero else "a positive number"
            bound = "" if self.largest == math.inf else f" up to {self.largest:g}"
            self.fail(f"{value!r} is not {wanted}{bound}", param, ctx)
        return number


class Server(click.ParamType):
    """HOST, HOST:PORT or [HOST]:PORT (IPv6) as host and port; without a port, OpenIGTLink's."""

    name = "server"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, int]:
        """The host and the port, or a usage error."""
        from jaxcal.io.openigtlink import PORT

        ipv6_alone = value.count(":") > 1 and not value.startswith("[")
        text = f"[{value}]" if ipv6_alone else value
        found = re.fullmatch(r"(\[[^][]+\]|[^][:]+)(?::([0-9]{1,5}))?", text)
        port = int(found[2] or PORT) if found else 0
        if not (found and 0 < port < 65536):
            self.fail(f"{value!r} is not HOST or HOST:PORT", param, ctx)
        return found[1].strip("[]"), port


class ImageNumbers(click.ParamType):
    """Numbers of images and ranges of them, separated by commas: 11,12,20-25."""

    name = "numbers"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        """The numbers in order, each once, or a usage error."""
        found: set[int] = set()
        for part in value.split(","):
            ends = re.fullmatch(r"\s*([0-9]{1,6})(?:-([0-9]{1,6}))?\s*", part)
            first, last = (int(ends[1]), int(ends[2] or ends[1])) if ends else (1, 0)
            if last < first:
                self.fail(f"{value!r} is no list of images, such as 11,12,20-25", param, ctx)
            found.update(range(first, last + 1))
        return tuple(sorted(found))


POSITIVE = Number()
NOT_NEGATIVE = Number(zero=True)
CONE = Number(zero=True, largest=85.0)

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object and nothing else."
)


def seed_option(what: str):
    """--seed, with what it is the seed of."""
    return click.option(
        "--seed",
        type=click.IntRange(0, 2**63 - 1),
        default=0,
        show_default=True,
        metavar="N",
        help=what,
    )


def exit_code(records: Iterable[dict[str, Any]]) -> ExitCode:
    """0 where every calibration converged, on data in the right frames; else 3."""
    converged = all(record["converged"] and not record.get("wrong_frames") for record in records)
    return ExitCode.CONVERGED if converged else ExitCode.NOT_CONVERGED


WORDS = ("good", "fair", "uncertain")
"""Verdicts, best first."""
REQUIRED = "fair"
"""The worst verdict that ends with status 0, if nothing else is required."""


def verdict_code(record: dict[str, Any], required: str = REQUIRED) -> ExitCode:
    """:func:`exit_code`, and 5 where the verdict is worse than what is required."""
    code = exit_code([record])
    if code or WORDS.index(record["verdict"] or "uncertain") <= WORDS.index(required):
        return code
    return ExitCode.UNCERTAIN


class Commands(click.Group):
    """Commands that are listed in the order in which they were added: that of the work."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names of the commands."""
        return list(self.commands)


def prepare_jax() -> None:
    """Let JAX keep its programs, and start on the processor only; it is not imported here.

    One calibration takes milliseconds there, by a program that is kept. On a GPU it would be
    compiled anew by every process, and the GPU's memory be taken for it. Only studies fill a GPU.
    Whoever sets ``JAX_PLATFORMS`` decides.
    """
    from jaxcal.runtime.jax_cache import enable_compilation_cache
    from jaxcal.runtime.when_jax import when_jax_is_imported

    enable_compilation_cache()
    if "jax" not in sys.modules:  # else somebody's process, which may want its other devices
        when_jax_is_imported(_only_processor)


def _only_processor() -> None:
    import jax

    if not jax.config.jax_platforms:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_platforms", "cpu")


def print_json(record: dict[str, Any]) -> None:
    """One JSON object on one line of standard output; arrays as lists, null for NaN and Inf."""
    from jaxcal.runtime.arrays import plain

    click.echo(json.dumps(plain(record), allow_nan=False))


def print_page(*parts: RenderableType) -> None:
    """Print tables, sentences wrapped to the page, and verbatim lines, on standard output."""
    from jaxcal.report.paragraphs import page_text

    # What goes to a file or a pipe must not be cut to the width of no terminal.
    width = None if sys.stdout is not None and sys.stdout.isatty() else 100
    # Not straight from rich, which leaves the process when the pipe is closed early.
    click.echo(page_text(parts, width, styled=True), nl=False)


def segmented(recording: Recording) -> tuple[Recording, list[str]]:
    """A recording with points in the place of times of flight, and what there is to say of them."""
    test = recording.test
    raw = recording.calibration.kind == "time_of_flight"
    if not raw and (test is None or test.kind != "time_of_flight"):
        return recording, []
    if not raw:
        raise InputError(
            f"{recording.source}: the test images hold times of flight, but the calibration "
            "images do not: both must hold points, or both times"
        )
    from jaxcal.data.segmentation.segment import segment_recording
    from jaxcal.io.given_files import naming

    with naming(recording.source):
        points, found = segment_recording(recording)
    return points, list(found.warnings)


@contextmanager
def progress(message: str) -> Iterator[Callable[[str], None]]:
    """Show what is being done on standard error, if somebody is watching.

    Yields:
        A function that shows something else instead.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda message: None
        return
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True, markup=False, highlight=False).status(Text(message)) as status:
        yield lambda message: status.update(Text(message))


def import_engine() -> None:
    """Import the numerical libraries, which takes most of a second; Ctrl-C then leaves at once.

    Nothing has been written yet, and a KeyboardInterrupt inside their C code would come out as
    tracebacks and import errors.
    """

    def leave(*_: object) -> None:
        os.write(2, b"jaxcal: interrupted\n")
        os._exit(ExitCode.INTERRUPTED)

    def load() -> None:
        importlib.import_module("jaxcal.calibration.calibrate")
        importlib.import_module("jaxcal.io.hdf5")

    # Python handles signals in its main thread only, and there only if nobody took them over.
    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        load()
        return
    previous = signal.signal(signal.SIGINT, leave)
    try:
        load()
    finally:
        signal.signal(signal.SIGINT, previous)
