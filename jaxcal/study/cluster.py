"""A study on a Dask cluster: worker processes compute chunks, this process writes the files.

Workers get the spec as text and a chunk's number and send arrays back, so they need jaxcal and no
common file system. A worker that dies costs the chunk that it was computing: Dask gives it to
another one, and what had been sent back is on the disk already. Only a few chunks for each worker
are handed out at a time, so that neither side's memory grows with the study.

Each worker is asked before it gets a chunk whether it has this version of jaxcal and can import the
study. One without jaxcal could not even read the message that names the chunk, and Dask tells
nothing of that to the process that waits for the result. Such a worker is named and left out.

Whoever reaches a Dask scheduler can run programs on it, every user of the scheduler's machine
included: keep it behind TLS, or on the loopback of a machine of your own. Workers on this machine
need no scheduler (:mod:`jaxcal.study.workers`).
"""

from __future__ import annotations

import logging
import pkgutil
import re
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import lru_cache, partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, cast

from jaxcal import CalibrationError, InputError, MissingExtraError, __version__
from jaxcal.io.given_files import one_line
from jaxcal.runtime.messages import quoted
from jaxcal.study.interface import (
    Chunk,
    Results,
    Study,
    computed,
    made_by,
    study_from,
    where_defined,
)

if TYPE_CHECKING:
    from distributed import Client, Future

CHUNKS_AHEAD = 2
"""Chunks handed out for each worker's thread: one to compute and the next one."""

CONNECT_SECONDS = 30

LOOK_SECONDS = 2.0
"""How often to look which workers there are."""

MOST_NAMED = 3
"""Workers named of those with the same reason."""

_VERSION = "jaxcal:__version__"
_TALKING = ("distributed", "distributed.client")
"""Dask's logs that have a level of their own."""

_LOST = "the cluster was lost: its scheduler no longer answers"

# Dask itself checks addresses of other kinds, such as inproc://.
_ADDRESS = re.compile(r"((tcp|tls|wss?|ucx)://)?\S+:\d{1,5}|(?!(tcp|tls|wss?|ucx):)\w+://\S+")


@contextmanager
def connected(scheduler: Any) -> Iterator[Client]:
    """A client of a scheduler.

    Args:
        scheduler: address of a running scheduler, e.g. ``tls://host:8786``, or a Dask cluster.

    Raises:
        MissingExtraError: Dask is not installed.
        InputError: an address without a port, or one at which no scheduler answers.
    """
    if isinstance(scheduler, str) and not _ADDRESS.fullmatch(scheduler):
        raise InputError(
            f"{quoted(scheduler)} is no address of a Dask scheduler: HOST:PORT is needed, e.g. "
            "tcp://127.0.0.1:8786"
        )
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtraError("a cluster needs Dask: pip install 'jaxcal[cluster]'") from None

    client = Client.__new__(Client)
    try:
        client.__init__(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
    # Whatever else listens there may answer anything.
    except Exception as error:
        # Else it closes itself when it is deleted: seconds, and a traceback.
        client.status = "closed"
        raise InputError(f"no Dask scheduler answers at {scheduler}: {one_line(error)}") from None
    # A lost scheduler is an error of ours; Dask would add tracebacks of what it was doing.
    logs = {log: log.level for log in map(logging.getLogger, _TALKING)}
    for log in logs:
        log.setLevel(logging.CRITICAL)
    try:
        with client:
            yield client
    finally:
        for log, level in logs.items():
            log.setLevel(level)


def compute_from_text(canonical: str, where: tuple[tuple[str, str], ...], index: int) -> Results:
    """What a worker does: chunk ``index`` of the study with this canonical text and class."""
    spec = _spec(canonical, where)
    return computed(spec, spec.chunk(index))


def prepare(canonical: str, where: tuple[tuple[str, str], ...]) -> None:
    """What a worker does first: import all that a chunk needs, or raise an error that says why."""
    import jaxcal.study.pipeline  # noqa: F401

    _spec(canonical, where)
    made_by()


@lru_cache(maxsize=4)
def _spec(canonical: str, where: tuple[tuple[str, str], ...]) -> Study:
    return study_from(dict(where), canonical)


class _Team:
    """The workers of a cluster, and which of them can compute a study.

    Attributes:
        threads: of each worker that can, by address.
    """

    def __init__(self, client: Client, study: tuple[Any, ...], note: Callable[[str], None]) -> None:
        self._client, self._study, self._note = client, study, note
        self._wrong: dict[str, str | None] = {}
        self.threads: dict[str, int] = {}

    def look(self) -> None:
        """Who is there now; those who are new are asked whether they can compute.

        Raises:
            CalibrationError: nobody could so far, and those who are there cannot.
        """
        # A synchronous client, as ours is, returns the answer; an asynchronous one an awaitable.
        there = cast("dict[str, int]", self._client.nthreads())
        known = {worker: self._wrong[worker] for worker in there if worker in self._wrong}
        new = self._asked([worker for worker in there if worker not in known])
        self._wrong = known | new
        before = self.threads
        self.threads = {w: n for w, n in there.items() if self._wrong.get(w, "") is None}
        left_out = _in_words(new)
        if left_out and not (before or self.threads):
            raise CalibrationError(f"no worker of the cluster can compute this study: {left_out}")
        if left_out:
            self._note(f"workers left out: {left_out}")
        if before and not self.threads:
            self._note("the cluster has no worker left that can compute; waiting for one")

    def wait(self) -> None:
        """Until there is a worker that can compute.

        Raises:
            CalibrationError: none came.
        """
        deadline = time.monotonic() + CONNECT_SECONDS
        self.look()
        while not self.threads:
            if time.monotonic() > deadline:
                raise CalibrationError("the cluster has no worker")
            time.sleep(0.1)
            self.look()

    def _asked(self, workers: list[str]) -> dict[str, str | None]:
        """What is wrong with each of these workers; None if nothing is."""
        if not workers:
            return {}
        # First by a function of Python's own, which a worker without jaxcal can import as well.
        ask = partial(self._client.run, on_error="return")
        found = cast("dict[str, Any]", ask(pkgutil.resolve_name, _VERSION, workers=workers))
        wrong: dict[str, str | None] = {
            worker: one_line(answer)
            if isinstance(answer, Exception)
            else f"jaxcal {answer}, this is {__version__}"
            for worker, answer in found.items()
            if answer != __version__
        }
        alike = [worker for worker in found if worker not in wrong]
        if alike:
            found = cast("dict[str, Any]", ask(prepare, *self._study, workers=alike))
            wrong |= {w: None if error is None else one_line(error) for w, error in found.items()}
        return wrong


def _in_words(wrong: dict[str, str | None]) -> str:
    """Which workers have what wrong with them."""
    by_reason: dict[str, list[str]] = {}
    for worker, reason in wrong.items():
        if reason is not None:
            by_reason.setdefault(reason[:200], []).append(worker)
    said = []
    for reason, workers in by_reason.items():
        further = f" and {len(workers) - MOST_NAMED} more" if len(workers) > MOST_NAMED else ""
        said.append(f"{', '.join(sorted(workers)[:MOST_NAMED])}{further} ({reason})")
    return "; ".join(said)


def compute_on_cluster(
    client: Client, spec: Study, chunks: list[Chunk], note: Callable[[str], None]
) -> Iterator[tuple[Chunk, *Results]]:
    """Compute chunks on worker processes; yields them as they are done.

    Args:
        client: of :func:`connected`.
        spec: the study.
        chunks: what to compute.
        note: is told what a person should know.

    Raises:
        CalibrationError: a chunk could not be computed, no worker can compute, or the scheduler was
            lost.
    """
    study = (spec.canonical(), tuple(where_defined(spec).items()))
    team, waiting = _Team(client, study, note), list(reversed(chunks))
    handed_out: dict[Any, tuple[Chunk, Future, set[str]]] = {}
    done: SimpleQueue[Future] = SimpleQueue()

    def hand_out() -> None:
        able = set(team.threads)
        ahead = CHUNKS_AHEAD * sum(max(count, 1) for count in team.threads.values())
        while waiting and len(handed_out) < ahead:
            chunk = waiting.pop()
            future = client.submit(
                compute_from_text, *study, chunk.index, pure=False, workers=sorted(able)
            )
            handed_out[future.key] = (chunk, future, able)
            future.add_done_callback(done.put)

    def take_back() -> None:
        """Chunks all of whose workers are gone; they would not be given to those who came later."""
        for key, (chunk, future, able) in list(handed_out.items()):
            if team.threads and not able & team.threads.keys():
                del handed_out[key]
                future.cancel()
                waiting.append(chunk)

    try:
        team.wait()
        looked = time.monotonic()
        while waiting or handed_out:
            hand_out()
            try:
                future = done.get(timeout=LOOK_SECONDS)
            except Empty:
                future = None
            if client.status != "running":
                raise CalibrationError(_LOST)
            if time.monotonic() - looked > LOOK_SECONDS:
                team.look()
                take_back()
                looked = time.monotonic()
            if future is None or future.key not in handed_out:
                continue
            chunk, *_ = handed_out.pop(future.key)
            if future.status == "error":
                error = cast("Any", future.exception())
                raise CalibrationError(
                    f"chunk {chunk.index} could not be computed on the cluster: "
                    f"{type(error).__name__}: {one_line(error)[:300]}"
                )
            arrays, maker = cast("Any", future.result())
            future.release()
            yield chunk, arrays, maker
    # Dask tells of a lost scheduler by these, according to what was being done.
    except (OSError, CancelledError) as error:
        raise CalibrationError(_LOST) from error
