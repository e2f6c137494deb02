"""A study on a Dask cluster: worker processes compute chunks, this process writes the files.

Workers get the spec as text and a chunk's number and send arrays back, so they need jaxcal and no
common file system. A worker that dies costs the chunk that it was computing: Dask gives it to
another one, and what had been sent back is on the disk already. Only a few chunks for each worker
are handed out at a time, so that neither side's memory grows with the study.

Whoever reaches a Dask scheduler can run programs on it, every user of the scheduler's machine
included: keep it behind TLS, or on the loopback of a machine of your own. Workers on this machine
need no scheduler (:mod:`jaxcal.study.workers`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from jaxcal import CalibrationError, InputError, MissingExtraError
from jaxcal.io.readable import one_line, quoted
from jaxcal.study.own import Study, study_from, where_defined
from jaxcal.study.spec import Chunk

if TYPE_CHECKING:
    from distributed import Client

CHUNKS_AHEAD = 2
"""Chunks handed out for each worker's thread: one to compute and the next one."""

CONNECT_SECONDS = 30

# Others than these, such as inproc://, are Dask's own affair.
_ADDRESS = re.compile(r"((tcp|tls|wss?|ucx)://)?\S+:\d{1,5}|(?!(tcp|tls|wss?|ucx):)\w+://\S+")


def connected(scheduler: Any) -> Client:
    """A client of a scheduler, to be used as a context manager.

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
    return client


def compute_from_text(
    canonical: str, where: tuple[tuple[str, str], ...], index: int
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """What a worker does: chunk ``index`` of the study with this canonical text and class."""
    from jaxcal.study.pipeline import made_by

    spec = _spec(canonical, where)
    return spec.compute(spec.chunk(index)), made_by()


@lru_cache(maxsize=4)
def _spec(canonical: str, where: tuple[tuple[str, str], ...]) -> Study:
    return study_from(dict(where), canonical)


def _threads(client: Client) -> dict[str, int]:
    # A synchronous client, as ours is, returns the answer; an asynchronous one an awaitable.
    return cast("dict[str, int]", client.nthreads())


def compute_on_cluster(
    client: Client, spec: Study, chunks: list[Chunk]
) -> Iterator[tuple[Chunk, dict[str, np.ndarray], dict[str, str]]]:
    """Compute chunks on worker processes; yields them as they are done.

    Args:
        client: of :func:`connected`.
        spec: the study.
        chunks: what to compute.

    Raises:
        CalibrationError: a chunk could not be computed, or the scheduler was lost.
    """
    from distributed import as_completed

    canonical, waiting = spec.canonical(), list(reversed(chunks))
    where = tuple(where_defined(spec).items())
    by_key: dict[Any, Chunk] = {}
    done = as_completed([], loop=client.loop)

    def hand_out() -> None:
        chunk = waiting.pop()
        future = client.submit(compute_from_text, canonical, where, chunk.index, pure=False)
        by_key[future.key] = chunk
        done.add(future)

    try:
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        ahead = CHUNKS_AHEAD * max(1, sum(_threads(client).values()))
        for _ in range(min(ahead, len(waiting))):
            hand_out()
        for future in done:
            chunk = by_key.pop(future.key)
            try:
                arrays, maker = future.result()
            except Exception as error:
                raise CalibrationError(
                    f"chunk {chunk.index} could not be computed on the cluster: "
                    f"{type(error).__name__}: {one_line(error)[:300]}"
                ) from error
            future.release()
            if waiting:
                hand_out()
            yield chunk, arrays, maker
    except TimeoutError:
        raise CalibrationError("the cluster has no worker") from None
    except OSError as error:
        raise CalibrationError(f"the cluster was lost: {one_line(error)}") from error
