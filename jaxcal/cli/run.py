"""Running a command line: what becomes of everything that can go wrong."""

from __future__ import annotations

import codecs
import errno
import io
import logging
import os
import sys
from collections.abc import Sequence

import click

from jaxcal import CalibrationError
from jaxcal.cli.common import ExitCode
from jaxcal.runtime.interrupts import no_interrupt_lost

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""What a system says of a file or terminal that takes no more."""


def run(commands: click.Group, name: str, arguments: Sequence[str] | None = None) -> int:
    """Run a command line, by default ``sys.argv``'s; returns the exit status.

    Errors have been reported on standard error by then, in one line.
    """
    if arguments is None:
        if sys.stdout is None:
            # Nobody would see the answer, and the next file to be opened would take its place.
            return _report(
                name,
                "error: standard output is closed; > /dev/null discards what is printed",
                ExitCode.BAD_INPUT,
            )
        _print_anything()
    # It warns of a home that is read-only, and makes its folder elsewhere; nothing is to be done.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        if arguments is None and (instruction := os.environ.get(_completion_variable(name))):
            from click.shell_completion import shell_complete

            return shell_complete(commands, {}, name, _completion_variable(name), instruction)
        code = _invoke(commands, name, sys.argv[1:] if arguments is None else arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except (KeyboardInterrupt, click.Abort) as interruption:
        _report(name, _interrupted(interruption), ExitCode.INTERRUPTED)
        if arguments is None:
            # Under the threads of an interrupted compilation an orderly exit may crash.
            os._exit(ExitCode.INTERRUPTED)
        return ExitCode.INTERRUPTED
    except click.ClickException as error:
        return _report(name, f"error: {error.format_message()}{_hint(error)}", ExitCode.BAD_INPUT)
    except CalibrationError as error:
        return _report(name, f"error: {error}", _status(error) or ExitCode.BAD_INPUT)
    except OSError as error:
        # A pipe that was closed early (| head) or a full disk; Python would flush once more.
        _drop(sys.stdout)
        # Of a closed pipe Windows says that the argument is invalid.
        closed = (errno.EPIPE,) if os.name != "nt" else (errno.EPIPE, errno.EINVAL)
        if error.errno in closed and error.filename is None:
            return ExitCode.BROKEN_PIPE
        said = _current_folder() or error.strerror or error
        # What files do not take is an error of jaxcal's, above.
        if error.errno in _NO_ROOM and error.filename is None:
            said = (
                f"standard output: {said} (not all was printed; files that were asked for may have "
                "been written)"
            )
        return _report(name, f"error: {said}", ExitCode.BAD_INPUT)
    except Exception as error:
        if os.environ.get("JAXCAL_TRACEBACK"):
            raise
        status = _status(error)
        if status is not None:
            return _report(name, f"error: {error}", status)
        return _report(
            name,
            f"internal error: {type(error).__name__}: {str(error)[:300]} (please report it; "
            "JAXCAL_TRACEBACK=1 shows where)",
            ExitCode.INTERNAL_ERROR,
        )


def _current_folder() -> str | None:
    """What is wrong with the folder that relative names begin at: it may have been removed."""
    try:
        os.getcwd()
    except OSError:
        return "the current folder is no longer there: change to another one"
    return None


def _print_anything() -> None:
    """Write what the terminal's encoding lacks with backslashes, as Python does on standard error.

    A file's name may hold it, and no answer is to be lost by a name.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        lacking = codecs.lookup(sys.stdout.encoding).name != "utf-8"
        if sys.stdout.errors == "strict" or (sys.stdout.errors == "surrogateescape" and lacking):
            sys.stdout.reconfigure(errors="backslashreplace")


def _completion_variable(name: str) -> str:
    """The variable by which a shell asks for completions, named as click names it."""
    return f"_{name}_COMPLETE".replace("-", "_").upper()


def _invoke(commands: click.Group, name: str, arguments: Sequence[str]) -> int:
    # Not click's own main(): it prints a blank line when interrupted, and ends the process itself
    # when a pipe was closed early.
    try:
        with no_interrupt_lost(), commands.make_context(name, list(arguments)) as context:
            return commands.invoke(context) or 0
    except click.exceptions.Exit as done:
        return done.exit_code


def _interrupted(error: BaseException) -> str:
    """What to tell after an interrupt, also where a further one came during the first."""
    text, cause = str(error), error.__context__
    while not text and cause is not None:
        if _status(cause) is not None:
            text = f"error: {cause}"
        cause = cause.__context__
    return text or "interrupted"


def _status(error: BaseException) -> ExitCode | None:
    """Errors meant for a person may say how the program is to end (those of ``hw`` do)."""
    status = getattr(error, "exit_code", None)
    return None if status is None else ExitCode(status)


def _hint(error: click.ClickException) -> str:
    context = error.ctx if isinstance(error, click.UsageError) else None
    return "" if context is None else f" (see '{context.command_path} --help')"


def _report(name: str, message: str, code: ExitCode) -> ExitCode:
    """One line on standard error, whatever a file's name may hold."""
    line = " ".join(f"{name}: {message}".split())
    shown = "".join(
        char if char.isprintable() else char.encode("unicode_escape").decode() for char in line
    )
    try:
        click.echo(shown, err=True)
    except OSError:
        _drop(sys.stderr)
    return code


def _drop(stream: object) -> None:
    """Send what is still buffered nowhere."""
    try:
        descriptor = stream.fileno()  # type: ignore[attr-defined]
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, descriptor)
        os.close(nowhere)
    except (AttributeError, OSError, ValueError):
        pass
