"""``jaxcal study``: run a Monte-Carlo study, and look at one."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from jaxcal import CalibrationError, InputError, MissingExtraError
from jaxcal.cli.common import Commands, ExitCode, json_option, print_json, print_page
from jaxcal.runtime.messages import command_line, counted

if TYPE_CHECKING:
    from jaxcal.study.run import Watcher


@click.group(
    cls=Commands,
    no_args_is_help=False,
    short_help="Monte-Carlo studies of conditions, methods and trials.",
)
def study() -> None:
    """Monte-Carlo studies: a grid of conditions x methods x trials, from a TOML spec."""


@study.command()
@click.argument("spec", type=click.Path(), metavar="SPEC.toml")
@click.option("--out", type=click.Path(), required=True, metavar="DIR", help="Folder of results.")
@click.option("--resume", is_flag=True, help="Continue the study that is in DIR.")
@click.option(
    "--workers",
    type=click.IntRange(1, 4096),
    metavar="N",
    help="Number of processes on this machine, each on cores of its own.",
)
@click.option(
    "--dask",
    metavar="ADDRESS",
    help="Workers of a running Dask scheduler, e.g. tcp://127.0.0.1:8786.",
)
def run(spec: str, out: str, resume: bool, workers: int | None, dask: str | None) -> int:
    """Compute the study that SPEC.toml describes into DIR, chunk by chunk.

    If it is interrupted or killed, --resume continues it: at most the chunks in progress are lost.
    """
    if workers is not None and dask is not None:
        raise click.UsageError("--workers and --dask exclude each other")
    from jaxcal.study.spec import load_spec

    checked = load_spec(spec)
    from jaxcal.runtime.jax_cache import enable_compilation_cache
    from jaxcal.study.run import run_study
    from jaxcal.study.store import Store

    enable_compilation_cache()
    store, again = Store(out, checked), _command(spec, out, workers, dask)

    def kept() -> str:
        done = len(store.present())
        return f"{done} of {checked.chunk_count} chunks are done; continue with: {again}"

    try:
        with _watching() as watcher:
            summary = run_study(
                checked, out, resume=resume, workers=workers or 0, scheduler=dask, watcher=watcher
            )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted: {kept()}") from None
    except (InputError, MissingExtraError):
        raise
    except CalibrationError as error:
        raise CalibrationError(f"{error}; {kept()}" if store.is_begun() else str(error)) from error
    rate = _rate(summary.trials, summary.seconds)
    click.echo(
        f"{out}: {counted(summary.chunks, 'chunk', 'is', 'are')} done, {summary.computed} of them "
        f"now ({counted(summary.trials, 'trial')} in {summary.seconds:.1f} s, {rate})"
    )
    return ExitCode.CONVERGED


@study.command(short_help="Print a study's means, SDs, intervals and failures.")
@click.argument("folder", type=click.Path(), metavar="DIR")
@json_option
@click.option("--csv", "csv_file", type=click.Path(), metavar="FILE", help="Write the table here.")
def show(folder: str, as_json: bool, csv_file: str | None) -> int:
    """Print mean, SD, 95 % interval, failures and paired differences of the study in DIR."""
    from jaxcal.io.atomic import write_text
    from jaxcal.io.outputs import begins_with, check_output
    from jaxcal.study import show as tables
    from jaxcal.study.store import Store

    store = Store.open(folder)
    cells = tables.summarise(store)
    if csv_file is not None:
        text = tables.as_csv(store.spec, cells)
        check_output(csv_file, "such a table", begins_with(text.partition("\n")[0].encode()))
        write_text(csv_file, text)
    if as_json:
        print_json(tables.as_record(store, cells))
        return ExitCode.CONVERGED
    done, chunks = len(store.present()), store.spec.chunk_count
    notes = [] if done == chunks else [f"{done} of {chunks} chunks are done; the rest is missing."]
    print_page(tables.as_table(store.spec, cells), *notes)
    return ExitCode.CONVERGED


def _command(spec: str, out: str, workers: int | None, dask: str | None) -> str:
    parts = ["jaxcal", "study", "run", spec, "--out", out]
    parts += ["--workers", str(workers)] if workers else []
    parts += ["--dask", dask] if dask else []
    return command_line([*parts, "--resume"])


_LINE_EVERY_S = 60.0
"""Time between two lines of progress if standard error is no terminal."""


class _Lines:
    """A line a minute, for the log of a batch job."""

    def begin(self, trials: int, done: int) -> None:
        self._trials, self._done, self._told = trials, done, time.monotonic()

    def advance(self, trials: int) -> None:
        self._done += trials
        if time.monotonic() - self._told >= _LINE_EVERY_S:
            self._told = time.monotonic()
            click.echo(f"{self._done} of {self._trials} trials done", err=True)

    def note(self, message: str) -> None:
        click.echo(f"jaxcal: note: {message}", err=True)


def _rate(trials: int, seconds: float) -> str:
    """Trials a second; slow ones with two digits."""
    rate = trials / max(seconds, 1e-9)
    return f"{rate:.0f} a second" if rate > 10 else f"{rate:.2g} a second"


class _Bar:
    """Trials done, trials a second and time left, on standard error."""

    def __init__(self, progress: Any) -> None:
        self._progress = progress
        self._task = progress.add_task("starting", total=None, rate="")
        self._begun, self._done = time.monotonic(), 0

    def begin(self, trials: int, done: int) -> None:
        self._progress.update(self._task, description="trials", total=trials, completed=done)
        self._begun = time.monotonic()

    def advance(self, trials: int) -> None:
        self._done += trials
        seconds = time.monotonic() - self._begun
        self._progress.update(self._task, advance=trials, rate=_rate(self._done, seconds))

    def note(self, message: str) -> None:
        self._progress.console.print(f"jaxcal: note: {message}", soft_wrap=True)


@contextmanager
def _watching() -> Iterator[Watcher]:
    if sys.stderr is None or not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True, markup=False, highlight=False)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    # An hour's average: a chunk may take minutes.
    with Progress(*columns, console=console, speed_estimate_period=3600) as progress:
        yield _Bar(progress)
