"""A study on a Dask cluster: worker processes compute chunks, this process writes the files.

Workers get the spec as text and a chunk's number and send arrays back, so they need jaxcal and no
common file system. A worker that dies costs the chunk that it was computing: Dask gives it to
another one, and what had been sent back is on the disk already. Only a few chunks for each worker
are handed out at a time, so that neither side's memory grows with the study.

Whoever reaches a Dask scheduler can run programs on it: keep it on loopback or behind TLS.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack
from functools import lru_cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from jaxcal.errors import CalibrationError, InputError, MissingExtraError
from jaxcal.io.readable import one_line
from jaxcal.study.spec import Chunk, Spec, spec_from_canonical

if TYPE_CHECKING:
    from distributed import Client

CHUNKS_AHEAD = 2
"""Chunks handed out for each worker's thread: one to compute, one to go on with."""

CONNECT_SECONDS = 30


def compute_on_cluster(
    spec: Spec, chunks: list[Chunk], *, workers: int = 0, scheduler: Any = None
) -> Iterator[tuple[Chunk, dict[str, np.ndarray], str]]:
    """Compute chunks on worker processes; yields them as they are done.

    Args:
        spec: the study.
        chunks: what to compute.
        workers: so many processes on this machine, on loopback, each on cores of its own; or
        scheduler: address of a running scheduler, e.g. ``tcp://127.0.0.1:8786``, or a Dask cluster.

    Raises:
        MissingExtraError: Dask is not installed.
        InputError: the scheduler cannot be reached.
        CalibrationError: a chunk could not be computed, or the scheduler was lost.
    """
    try:
        import distributed
    except ImportError:
        raise MissingExtraError("workers need Dask: pip install 'jaxcal[cluster]'") from None

    with ExitStack() as stack:
        if scheduler is None:
            cluster = stack.enter_context(_local_cluster(min(workers, len(chunks))))
            client = stack.enter_context(distributed.Client(cluster))
        else:
            client = stack.enter_context(_connect(scheduler))
        yield from _distribute(client, spec, chunks)


def _connect(scheduler: Any) -> Client:
    from distributed import Client

    try:
        return Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"no Dask scheduler answers at {scheduler}: {one_line(error)}") from None


def _local_cluster(workers: int) -> Any:
    import jax
    from distributed import LocalCluster
    from distributed.diagnostics.plugin import WorkerPlugin

    # Where this process keeps its compiled programs its workers may, too.
    cache = getattr(jax.config, "jax_compilation_cache_dir", None)
    groups = core_groups(workers)

    class OneGroup(WorkerPlugin):
        """Keeps a worker on its cores, before it imports JAX, which counts them."""

        name = "jaxcal-cores"

        def setup(self, worker: Any) -> None:
            if hasattr(os, "sched_setaffinity"):
                os.sched_setaffinity(0, groups[int(worker.name) % len(groups)])
            if cache is not None:
                os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", cache)

    cluster = LocalCluster(
        # None: no dashboard, which would listen on a port.
        n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1",
        dashboard_address=cast("str", None), silence_logs=logging.CRITICAL, memory_limit=0,
    )  # fmt: skip
    with ExitStack() as undo:
        undo.callback(cluster.close)
        from distributed import Client

        with Client(cluster, set_as_default=False) as client:
            client.register_plugin(OneGroup())
        undo.pop_all()
    return cluster


def core_groups(workers: int) -> list[set[int]]:
    """This process's cores shared out to workers, as evenly as can be.

    More workers than cores share them.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    cores = cores or list(range(os.cpu_count() or 1))
    if workers > len(cores):
        return [{cores[k % len(cores)]} for k in range(workers)]
    return [{int(core) for core in part} for part in np.array_split(cores, workers)]


def compute_from_text(canonical: str, index: int) -> tuple[dict[str, np.ndarray], str]:
    """What a worker does: chunk ``index`` of the spec with this canonical text."""
    from jaxcal.study.pipeline import compute_chunk, device_name

    spec = _spec(canonical)
    return compute_chunk(spec, spec.chunk(index)), device_name()


@lru_cache(maxsize=4)
def _spec(canonical: str) -> Spec:
    return spec_from_canonical(canonical)


def _threads(client: Client) -> dict[str, int]:
    # Synchronous clients answer, asynchronous ones (not ours) promise to.
    return cast("dict[str, int]", client.nthreads())


def _distribute(
    client: Client, spec: Spec, chunks: list[Chunk]
) -> Iterator[tuple[Chunk, dict[str, np.ndarray], str]]:
    from distributed import as_completed

    canonical, waiting = spec.canonical(), list(reversed(chunks))
    by_key: dict[Any, Chunk] = {}
    done = as_completed([], loop=client.loop)

    def hand_out() -> None:
        chunk = waiting.pop()
        future = client.submit(compute_from_text, canonical, chunk.index, pure=False)
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
                arrays, device = future.result()
            except Exception as error:
                raise CalibrationError(
                    f"chunk {chunk.index} could not be computed on the cluster: "
                    f"{type(error).__name__}: {one_line(error)[:300]}"
                ) from error
            future.release()
            if waiting:
                hand_out()
            yield chunk, arrays, device
    except TimeoutError:
        raise CalibrationError("the cluster has no worker") from None
    except OSError as error:
        raise CalibrationError(f"the cluster was lost: {one_line(error)}") from error
