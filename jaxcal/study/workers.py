"""Worker processes of a study on this machine, which talk through pipes.

A pipe has no address: nobody else on the machine can reach the workers, and none of their results
are unpickled. The parent writes a line of JSON for each chunk, the worker answers with a line of
JSON (names, types and shapes) and the arrays' bytes. A worker that dies costs the chunk that it was
computing: another process takes its place and computes that chunk again.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import select
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from functools import cache
from typing import Any, BinaryIO

import numpy as np

from jaxcal import CalibrationError
from jaxcal.io.given_files import one_line
from jaxcal.runtime import jax_cache
from jaxcal.runtime.isolated import python_command
from jaxcal.study.interface import Chunk, Results, Study, computed, study_from, where_defined

MOST_DEATHS = 3
"""Workers that may die over one chunk before the study gives up."""

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


class Worker:
    """One worker process.

    Args:
        spec: the study.
        cores: the only ones that the process may use.
    """

    def __init__(self, spec: Study, cores: set[int]) -> None:
        # Workers keep compiled programs in the same folder as this process.
        folder = None
        if "jax" in sys.modules and not jax_cache.is_wanted():
            folder = getattr(sys.modules["jax"].config, "jax_compilation_cache_dir", None)
        environment = {**os.environ, **_ONE_THREAD}
        if folder is not None:
            environment.setdefault("JAX_COMPILATION_CACHE_DIR", folder)
        # In a session of its own: Ctrl-C reaches the parent, which ends its workers.
        self.process = subprocess.Popen(
            python_command("jaxcal.study.workers"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self._to, self._from = self.process.stdin, self.process.stdout
        with contextlib.suppress(OSError):
            self._say(
                {
                    "spec": spec.canonical(),
                    "where": where_defined(spec),
                    "cores": sorted(cores),
                    "cache": jax_cache.is_wanted(),
                }
            )

    def compute(self, chunk: Chunk) -> Results | None:
        """A chunk's arrays and what computed them; None where the worker died.

        Raises:
            CalibrationError: the chunk cannot be computed.
        """
        try:
            self._say({"chunk": chunk.index})
            header = json.loads(self._from.readline())
            if "error" in header:
                raise CalibrationError(
                    f"chunk {chunk.index} could not be computed: {header['error']}"
                )
            arrays = {}
            for name, dtype, shape in header["arrays"]:
                kind = np.dtype(dtype)
                size = int(np.prod(shape, dtype=object)) * kind.itemsize
                body = self._from.read(size)
                if len(body) < size:
                    return None
                arrays[name] = np.frombuffer(body, kind).reshape(shape).copy()
            return arrays, header["maker"]
        except (OSError, ValueError):
            return None

    def end(self) -> None:
        """Kill the process; safe to repeat."""
        self.process.kill()
        self.process.wait()
        for pipe in (self._to, self._from):
            with contextlib.suppress(OSError):
                pipe.close()

    def _say(self, message: dict[str, Any]) -> None:
        self._to.write(json.dumps(message).encode() + b"\n")
        self._to.flush()


def compute_on_workers(
    spec: Study, chunks: list[Chunk], groups: list[set[int]]
) -> Iterator[tuple[Chunk, *Results]]:
    """Compute chunks on worker processes; yields them as they are done.

    Args:
        spec: the study.
        chunks: what to compute.
        groups: the cores of each worker (:func:`core_groups`).

    Raises:
        CalibrationError: a chunk could not be computed, or killed its workers.
    """
    ahead, waiting, pending = 2 * len(groups), list(reversed(chunks)), set()
    with ThreadPoolExecutor(len(groups)) as pool, _Crew(spec, groups) as crew:
        while waiting or pending:
            # Not all at once: a slow disk would fill this process's memory with results.
            while waiting and len(pending) < ahead:
                pending.add(pool.submit(crew.compute, waiting.pop()))
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()


class _Crew:
    """The worker processes, each of which computes for one thread at a time; a context manager."""

    def __init__(self, spec: Study, groups: list[set[int]]) -> None:
        self._spec, self._groups = spec, groups
        self._workers: dict[int, Worker] = {}
        self._ending = threading.Event()
        self._idle: queue.SimpleQueue[int] = queue.SimpleQueue()
        for place in range(len(groups)):
            self._idle.put(place)

    def __enter__(self) -> _Crew:
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        for worker in list(self._workers.values()):
            worker.end()

    def compute(self, chunk: Chunk) -> tuple[Chunk, *Results]:
        """A chunk's results; a worker that dies is replaced."""
        place = self._idle.get()
        try:
            for _ in range(MOST_DEATHS):
                if self._ending.is_set():
                    break
                if place not in self._workers:
                    self._workers[place] = Worker(self._spec, self._groups[place])
                # Ended meanwhile, it may have been too late to be among those that were killed.
                found = None if self._ending.is_set() else self._workers[place].compute(chunk)
                if found is not None:
                    return chunk, *found
                self._workers.pop(place).end()
            raise CalibrationError(f"chunk {chunk.index}: {MOST_DEATHS} workers died computing it")
        finally:
            self._idle.put(place)


def core_groups(workers: int) -> list[set[int]]:
    """This process's cores shared out to workers, as evenly as can be.

    If there are more workers than cores, some share a core.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    cores = cores or list(range(os.cpu_count() or 1))
    if workers > len(cores):
        return [{cores[k % len(cores)]} for k in range(workers)]
    return [{int(core) for core in part} for part in np.array_split(cores, workers)]


def main() -> None:
    """What a worker does, until its standard input ends."""
    answers = os.fdopen(os.dup(1), "wb")
    # JAX or a library may print, but the pipe to the parent must carry only answers.
    os.dup2(2, 1)
    requests = sys.stdin.buffer
    given = json.loads(requests.readline())
    if hasattr(select, "poll"):  # not on Windows
        threading.Thread(target=_end_with_parent, daemon=True).start()
    if given["cores"] and hasattr(os, "sched_setaffinity"):
        # Before JAX is imported, since JAX counts the cores.
        os.sched_setaffinity(0, given["cores"])
    if given["cache"]:
        jax_cache.enable_compilation_cache()

    @cache
    def spec() -> Study:
        return study_from(given["where"], given["spec"])

    try:
        for line in requests:
            _answer(answers, spec, json.loads(line)["chunk"])
    except OSError:  # of the pipes: what a chunk raises is an answer
        # The parent was killed: nobody reads an answer, nor a traceback of what cannot be flushed.
        os._exit(1)


def _end_with_parent() -> None:
    """Wait until the parent is gone, then end this process: nobody wants its chunk."""
    requests = select.poll()
    # The end of a pipe is reported whatever is asked for. Its lines are the main thread's.
    requests.register(0, 0)
    requests.poll()
    os._exit(1)


def _answer(answers: BinaryIO, spec: Callable[[], Study], index: int) -> None:
    try:
        study = spec()
        arrays, maker = computed(study, study.chunk(index))
        found = {name: np.asarray(values, order="C") for name, values in arrays.items()}
        described = [[name, values.dtype.str, list(values.shape)] for name, values in found.items()]
        header: dict[str, Any] = {"arrays": described, "maker": maker}
    except Exception as error:
        found = {}
        header = {"error": f"{type(error).__name__}: {one_line(error)[:300]}"}
    answers.write(json.dumps(header).encode() + b"\n")
    for values in found.values():
        answers.write(values.tobytes())
    answers.flush()


if __name__ == "__main__":
    main()
