"""One chunk of a study: draw, segment, solve by every method, compare with the truth.

There is one compiled program that draws and segments for each law of the offsets and number of
images, one that makes the conventional fits, and one that solves for each method and set of static
options. Elevation, noise, bounds and all other numbers are arguments, so that a whole grid runs
through the same programs. They take blocks of a fixed number of trials, whatever the size of the
chunks. A short last block is filled up, and the results of the added trials are dropped.

All methods are computed by :mod:`jaxcal.study.trials`.

The programs are compiled for one thread each: trials are independent, so that processes, one for
each group of cores (:mod:`jaxcal.study.workers`), use several cores better than XLA's thread pool
does, and neither results nor progress depend on how that pool is scheduled.

If a host has several devices, each takes its share of a block.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from jaxcal.data.probe import LinearProbe
from jaxcal.model.unknowns import RIGID
from jaxcal.runtime.compiler import fast_to_run, single_threaded
from jaxcal.runtime.jax_modes import in_own_modes
from jaxcal.solvers.plan import Options
from jaxcal.solvers.start import ConventionalStart, conventional
from jaxcal.study.interface import Chunk
from jaxcal.study.offsets import nominal_bound
from jaxcal.study.simulation import Protocol, join_protocol, split_protocol
from jaxcal.study.spec import Condition, MethodSpec, Spec
from jaxcal.study.trials import Kind, experiments, solve

BATCH_SIZE = {"cpu": 64}
"""Trials drawn or solved side by side on a device; on a CPU what they need stays in its caches."""

OTHER_BATCH_SIZE = 4096
"""The same for other devices: enough to fill one."""

MOST_PIECES = 8
"""Most such groups of trials for a device in one call, one by one; a call takes 0.1 ms."""

Devices = tuple[Any, ...]
"""Of jax.Device, which the type checker does not accept as a type."""

COMPONENTS = ("lateral", "range", "elevation")
"""Components of the SDs, in this order."""


@in_own_modes
def compute_chunk(spec: Spec, chunk: Chunk) -> dict[str, np.ndarray]:
    """All results of one chunk.

    Args:
        spec: the study.
        chunk: one of its chunks.

    Returns:
        Arrays by name: those of :class:`jaxcal.study.trials.TrialResults` (methods, trials, ...)
        and ``realised`` (trials, 3), the root mean square errors of lateral position, range and
        elevational offset that were drawn, mm. They depend neither on what was computed before nor
        on the worker.
    """
    condition, devices = spec.condition(chunk.condition), tuple(jax.local_devices())
    pieces, size = _block(spec, devices)
    blocks = []
    for start in range(chunk.start, chunk.stop, pieces * size):
        trials = np.minimum(start + np.arange(pieces * size), chunk.stop - 1)
        indices = (chunk.condition * spec.trials + trials).astype(np.uint32)
        indices = indices.reshape(pieces, size)
        drawn = Block(spec, condition, indices, devices)
        measured = [drawn.measured(method) for method in spec.methods]
        results = {name: np.stack([one[name] for one in measured]) for name in measured[0]}
        blocks.append((results, _trials(drawn.realised)))
    count = chunk.stop - chunk.start
    together = {
        name: np.concatenate([results[name] for results, _ in blocks], axis=1)[:, :count]
        for name in blocks[0][0]
    }
    together["realised"] = np.concatenate([realised for _, realised in blocks])[:count]
    return together


def _block(spec: Spec, devices: Devices) -> tuple[int, int]:
    """How many pieces of how many trials a call gets: the same for all chunks of a study."""
    size = BATCH_SIZE.get(devices[0].platform, OTHER_BATCH_SIZE)
    needed = -(-spec.chunk_trials // (size * len(devices)))
    calls = -(-needed // MOST_PIECES)
    return -(-needed // calls) * len(devices), size


class Block:
    """Pieces of trials drawn side by side, and what methods make of them.

    All arrays between the programs have the pieces as their first axis.
    """

    def __init__(
        self, spec: Spec, condition: Condition, indices: np.ndarray, devices: Devices
    ) -> None:
        self._condition, self._devices = condition, devices
        shape, numbers = split_protocol(protocol(condition, spec.probe))
        drawn = draw_program(shape, devices)(indices, np.asarray(spec.seed, np.uint64), numbers)
        self.batch, self.truth, self.realised = drawn
        self._begun: dict[int, ConventionalStart] = {}

    def begun(self, max_steps: int) -> ConventionalStart:
        """The conventional fits, made once."""
        if max_steps not in self._begun:
            program = begin_program(max_steps, self._devices)
            self._begun[max_steps] = program(self.batch)
        return self._begun[max_steps]

    def measured(self, method: MethodSpec) -> dict[str, np.ndarray]:
        """What one method makes of it: the arrays of :class:`jaxcal.study.trials.TrialResults`."""
        given = method.bound_given is not None
        bound = np.asarray(bound_mm(method, self._condition)) if given else None
        kind: Kind = (method.method, method.prior)
        program = solve_program(kind, method.options, self._devices)
        begun = self.begun(method.max_iterations)
        measured = program(self.batch, self.truth, begun, bound)
        return {name: _trials(value) for name, value in vars(measured).items()}


def bound_mm(method: MethodSpec, condition: Condition) -> float:
    """The bound that a method is told in a condition, mm; NaN if none."""
    if method.max_elevation_mm is not None:
        return method.max_elevation_mm
    if method.max_elevation_factor is None:
        return float("nan")
    bound = nominal_bound(condition.elevation_distribution, condition.elevation_mm)
    return method.max_elevation_factor * bound


def protocol(condition: Condition, probe: LinearProbe) -> Protocol:
    """The distributions of one condition."""
    given = dict(vars(condition))
    return Protocol(
        depth_mm=(given.pop("depth_min_mm"), given.pop("depth_max_mm")),
        rotation_rad=float(np.radians(given.pop("rotation_deg"))),
        tracker_rad=float(np.radians(given.pop("tracker_deg"))),
        probe=probe,
        **given,
    )


def _trials(value: Array) -> np.ndarray:
    """The array with the axis of pieces merged into that of trials."""
    return np.asarray(value).reshape(-1, *value.shape[2:])


def compile_pieces(function: Any, devices: Devices, *, pieces: int) -> Any:
    """Compile a function of one piece for many pieces, which several devices share.

    Args:
        function: of arrays and nothing static.
        devices: one, or several that share the pieces.
        pieces: number of leading arguments that are given for every piece; further arguments are
            the same for all pieces.
    """
    platform = devices[0].platform
    options = fast_to_run(platform) or {}
    options = (options | single_threaded(platform)) or None

    def each(*given: Any) -> Any:
        shared = given[pieces:]
        return jax.lax.map(lambda piece: function(*piece, *shared), given[:pieces])

    if len(devices) == 1:
        return jax.jit(each, compiler_options=options)
    mesh = Mesh(np.asarray(devices), ("pieces",))
    cut, whole = PartitionSpec("pieces"), PartitionSpec()

    def spread(*given: Any) -> Any:
        specs = tuple(cut if k < pieces else whole for k in range(len(given)))
        mapped = jax.shard_map(each, mesh=mesh, in_specs=specs, out_specs=cut, check_vma=False)
        return mapped(*given)

    return jax.jit(spread, compiler_options=options)


@cache
def draw_program(shape: Protocol, devices: Devices) -> Any:
    """From (trial indices, seed, numbers) to :func:`jaxcal.study.trials.experiments`, compiled."""

    def program(indices: Array, seed: Array, numbers: dict[str, Any]) -> Any:
        return experiments(trial_keys(indices, seed), join_protocol(shape, numbers))

    return compile_pieces(program, devices, pieces=1)


def trial_keys(indices: Array, seed: Array) -> Array:
    """The keys of trials by their numbers: draws depend on nothing else."""
    root = jax.random.key(seed)
    return jax.vmap(lambda index: jax.random.fold_in(root, index))(indices)


@cache
def begin_program(max_steps: int, devices: Devices) -> Any:
    """From experiments to their conventional fits, compiled."""
    return compile_pieces(
        lambda batch: conventional(batch.images, RIGID, max_steps=max_steps), devices, pieces=1
    )


@cache
def solve_program(kind: Kind, options: Options, devices: Devices) -> Any:
    """From experiments, truth, conventional fits and bound to :func:`jaxcal.study.trials.solve`."""
    return compile_pieces(partial(solve, kind, options), devices, pieces=3)
