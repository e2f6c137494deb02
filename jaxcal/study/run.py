"""Compute what is missing of a study: here, on this machine's cores, or on a cluster."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from jaxcal import FormatError, InputError, OutputError
from jaxcal.io.atomic import lock
from jaxcal.io.given_files import one_line
from jaxcal.runtime.given_values import check_flag, whole_number
from jaxcal.runtime.interrupts import no_interrupt_lost
from jaxcal.runtime.messages import shown
from jaxcal.study.cluster import compute_on_cluster, connected
from jaxcal.study.interface import Chunk, Results, Study, computed, where_defined
from jaxcal.study.store import Store, versions_in_words

if TYPE_CHECKING:
    from distributed import Client

_MOST_WORKERS = 10_000
_log = logging.getLogger(__name__)


@runtime_checkable
class Watcher(Protocol):
    """Is told about the progress of a study."""

    def begin(self, trials: int, done: int) -> None:
        """``trials`` are to be done in all; ``done`` of them were done before."""

    def advance(self, trials: int) -> None:
        """``trials`` more are done and written."""

    def note(self, message: str) -> None:
        """Something that a person should know."""


class Silence(Watcher):
    """A watcher that shows no progress."""

    def note(self, message: str) -> None:
        """Into Python's log, which prints it where nobody has set it up."""
        _log.warning(message)


@dataclass(frozen=True)
class RunSummary:
    """How a run ended.

    Attributes:
        chunks: of the study; all of them exist now.
        computed: chunks that this run computed.
        trials: that this run computed.
        seconds: that it took, compilation included.
    """

    chunks: int
    computed: int
    trials: int
    seconds: float


def run_study(
    spec: Study,
    folder: str | os.PathLike[str],
    *,
    resume: bool = False,
    workers: int = 0,
    scheduler: Any = None,
    watcher: Watcher | None = None,
) -> RunSummary:
    """Compute the missing chunks of a study and write each when it is done.

    If it is killed or interrupted at any moment, the same call with ``resume`` continues it. The
    files are then the same as without the interruption (on one machine).

    Args:
        spec: the study: a :class:`jaxcal.study.Spec`, or a caller's own
            (:class:`jaxcal.study.Study`).
        folder: where its files are.
        resume: continue what is there; without it a folder that holds a study is refused.
        workers: processes on this machine, each on cores of its own; 0 computes in this process.
        scheduler: instead, the address of a running Dask scheduler, or a Dask cluster (whatever
            ``distributed.Client`` takes), e.g. a ``dask_jobqueue.SLURMCluster``.
        watcher: is told about the progress; without one, what a person should know is logged as a
            warning (damaged files, several versions, workers left out).

    Raises:
        InputError: no study, one whose class other processes cannot import, another spec's results
            are there, the folder is in use, or no scheduler answers; nothing was written then.
        OutputError: the folder or a file cannot be written; what was written before stays.
        MissingExtraError: Dask is needed and not installed.
        CalibrationError: the cluster was lost, or a chunk failed in another process, whose error is
            told; ``resume`` continues. In this process the chunk's own error is raised.
    """
    # A class has the members, too.
    if isinstance(spec, type) or not isinstance(spec, Study):
        raise InputError(
            f"run_study takes a study, not {shown(spec)}: jaxcal.study.load_spec(path) reads one"
        )
    if type(spec).from_canonical(spec.canonical()).sha256 != spec.sha256:
        raise InputError(
            "the study's from_canonical does not give back the study that canonical describes: it "
            "could not be resumed"
        )
    if whole_number("workers", workers, 0, _MOST_WORKERS) and scheduler is not None:
        raise InputError("workers must not be given together with a scheduler")
    check_flag("resume", resume)
    watcher = Silence() if watcher is None else watcher
    if not isinstance(watcher, Watcher):
        raise InputError(f"watcher must have begin, advance and note, not {shown(watcher)}")
    if workers or scheduler is not None:
        where_defined(spec)  # says if other processes cannot import it
    begun = time.monotonic()
    # First of all, so that no folder is made where nothing can be computed.
    with (
        no_interrupt_lost(),
        nullcontext() if scheduler is None else connected(scheduler) as client,
    ):
        store = Store(folder, spec)
        store.prepare(resume=resume)
        with _locked(store.folder):
            store.begin(resume=resume)
            store.sweep()
            missing, done, makers = _missing(store, watcher)
            watcher.begin(spec.condition_count * spec.trials, done)
            trials = 0
            with closing(_computed(spec, missing, workers, client, watcher)) as results:
                for chunk, arrays, maker in results:
                    store.write(chunk, arrays, maker)
                    if (found := versions_in_words(maker)) not in makers:
                        makers.add(found)
                        _note_makers(makers, watcher)
                    trials += chunk.stop - chunk.start
                    watcher.advance(chunk.stop - chunk.start)
    return RunSummary(spec.chunk_count, len(missing), trials, time.monotonic() - begun)


def _missing(store: Store, watcher: Watcher) -> tuple[list[Chunk], int, set[str]]:
    """The chunks to compute, how many trials are done, and what computed these, in words."""
    sound, done, makers = set(), 0, set()
    for index in store.present():
        chunk = store.spec.chunk(index)
        try:
            store.read(chunk)
        except FormatError as error:
            watcher.note(f"{error}; it is computed again")
            continue
        makers.add(store.versions(chunk))
        sound.add(index)
        done += chunk.stop - chunk.start
    missing = [store.spec.chunk(k) for k in range(store.spec.chunk_count) if k not in sound]
    _note_makers(makers, watcher)
    return missing, done, makers


def _note_makers(makers: set[str], watcher: Watcher) -> None:
    if len(makers) > 1:
        watcher.note(
            f"the chunks were computed by {len(makers)} different set-ups: "
            f"{'; '.join(sorted(makers))}"
        )


def _computed(
    spec: Study, missing: list[Chunk], workers: int, client: Client | None, watcher: Watcher
) -> Generator[tuple[Chunk, *Results]]:
    """The chunks one after the other, each with its results and what computed them."""
    if not missing:
        return
    if client is not None:
        yield from compute_on_cluster(client, spec, missing, watcher.note)
    elif workers:
        from jaxcal.study.workers import compute_on_workers, core_groups

        groups = core_groups(min(workers, len(missing)))
        yield from compute_on_workers(spec, missing, groups)
    else:
        for chunk in missing:
            yield (chunk, *computed(spec, chunk))


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes from computing the same study; the lock ends with its process."""
    path = folder / ".lock"
    try:
        file = path.open("wb")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {one_line(error)}") from error
    with file:
        if lock(file.fileno()) is False:
            raise InputError(f"{folder}: is being computed by another process")
        yield
