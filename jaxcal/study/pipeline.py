"""One chunk of a study: draw, segment, solve by every method, compare with the truth.

One compiled program draws (for each law of the offsets and number of images) and one solves (for
each method and set of static options); elevation, noise, bounds and all other numbers are
arguments, so that a whole grid runs through the same programs. They take blocks of a fixed number
of trials, whatever the chunks; a short last block is filled up, and what was filled in dropped.

The programs are compiled for one thread each: trials are independent, so that processes, one for
each group of cores (:mod:`jaxcal.study.cluster`), use several cores better than XLA's thread pool
does, and neither results nor progress depend on how that pool is scheduled.

Where a host has several devices each takes its share of a block.
"""

from __future__ import annotations

import dataclasses
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int

from jaxcal.compiler import fast_to_run
from jaxcal.metrics import reconstruction_precision
from jaxcal.offsets import OffsetLaw, nominal_bound
from jaxcal.probe import LinearProbe
from jaxcal.simulation import Experiment, Protocol, simulate
from jaxcal.solve import Options, calibrate_batch
from jaxcal.study.spec import Chunk, Condition, MethodSpec, Spec

LANES = {"cpu": 64}
"""Trials drawn or solved side by side on a device; on a CPU what they need stays in its caches."""

OTHER_LANES = 4096
"""And on whatever else: enough to fill it."""

_ONE_THREAD: dict[str, Any] = {"xla_cpu_multi_thread_eigen": False}
"""Beside :func:`jaxcal.compiler.fast_to_run`."""

Devices = tuple[Any, ...]
"""jax.Device, which is no type to the type checker."""

COMPONENTS = ("lateral", "range", "elevation")
"""Of the SDs, in their order."""


class Measured(eqx.Module):
    """What one method makes of a batch of experiments.

    Attributes:
        rp: point reconstruction precision on the test images (Eq. 8), mm.
        rotation_error: angle between X and the truth, rad.
        translation_error: distance between their origins, mm.
        point_error: distance of the target from the truth, mm.
        sigma: estimated SDs of lateral position, range and elevational offset, mm.
        status: a :class:`jaxcal.Status`.
        iterations: linearisations or rounds.
    """

    rp: Float[Array, " trials"]
    rotation_error: Float[Array, " trials"]
    translation_error: Float[Array, " trials"]
    point_error: Float[Array, " trials"]
    sigma: Float[Array, "trials 3"]
    status: Int[Array, " trials"]
    iterations: Int[Array, " trials"]


@dataclasses.dataclass(frozen=True)
class Shape:
    """All that is static about a draw."""

    law: OffsetLaw
    images: int
    test_images: int
    probe: LinearProbe


def compute_chunk(spec: Spec, chunk: Chunk) -> dict[str, np.ndarray]:
    """All results of one chunk.

    Args:
        spec: the study.
        chunk: one of its chunks.

    Returns:
        Arrays by name: those of :class:`Measured` (methods, trials, ...) and ``realised`` (trials,
        3), the root mean square errors of lateral position, range and elevational offset that were
        drawn, mm. They are the same whatever was computed before, and on whatever worker.
    """
    condition = spec.condition(chunk.condition)
    shape = shape_of(condition, spec.probe)
    devices = tuple(jax.local_devices())
    block = len(devices) * LANES.get(devices[0].platform, OTHER_LANES)
    seed = np.asarray(spec.seed, np.uint64)
    draw = draw_program(shape, devices)
    blocks = []
    for start in range(chunk.start, chunk.stop, block):
        trials = np.minimum(start + np.arange(block), chunk.stop - 1)
        indices = (chunk.condition * spec.trials + trials).astype(np.uint32)
        drawn, realised = draw(indices, seed, numbers_of(condition))
        measured = [solve_one(method, condition, drawn, devices) for method in spec.methods]
        results = {name: np.stack([one[name] for one in measured]) for name in measured[0]}
        blocks.append((results, np.asarray(realised)))
    count = chunk.stop - chunk.start
    together = {
        name: np.concatenate([results[name] for results, _ in blocks], axis=1)[:, :count]
        for name in blocks[0][0]
    }
    together["realised"] = np.concatenate([realised for _, realised in blocks])[:count]
    return together


def solve_one(
    method: MethodSpec, condition: Condition, drawn: Experiment, devices: Devices
) -> dict[str, np.ndarray]:
    """What one method makes of a block: the arrays of :class:`Measured`."""
    prior, options = _static(method)
    bound = jnp.asarray(bound_mm(method, condition)) if method.bounded else None
    measured = _solve_program(method.method, prior, options, devices)(drawn, bound)
    return {name: np.asarray(value) for name, value in vars(measured).items()}


def device_name() -> str:
    """What computes in this process, in words."""
    devices = jax.local_devices()
    return f"{len(devices)} x {devices[0].platform} {devices[0].device_kind}"


def bound_mm(method: MethodSpec, condition: Condition) -> float:
    """The bound that a method is told in a condition, mm; NaN where it takes none."""
    if method.max_elevation_mm is not None:
        return method.max_elevation_mm
    if method.max_elevation_factor is None:
        return float("nan")
    law: OffsetLaw = condition.elevation_distribution  # type: ignore[assignment]
    return method.max_elevation_factor * nominal_bound(law, condition.elevation_mm)


def protocol(condition: Condition, probe: LinearProbe) -> Protocol:
    """The distributions of one condition."""
    return Protocol(
        images=condition.images,
        test_images=condition.test_images,
        elevation_distribution=condition.elevation_distribution,  # type: ignore[arg-type]
        probe=probe,
        **numbers_of(condition),
    )


def shape_of(condition: Condition, probe: LinearProbe) -> Shape:
    """What is static about a condition's draws."""
    law: OffsetLaw = condition.elevation_distribution  # type: ignore[assignment]
    return Shape(law, condition.images, condition.test_images, probe)


def numbers_of(condition: Condition) -> dict[str, Any]:
    """The numeric fields of its protocol."""
    return {
        "elevation_mm": condition.elevation_mm,
        "noise_mm": condition.noise_mm,
        "lateral_mm": condition.lateral_mm,
        "depth_mm": (condition.depth_min_mm, condition.depth_max_mm),
        "rotation_rad": float(np.radians(condition.rotation_deg)),
        "test_fraction": condition.test_fraction,
        "tracker_mm": condition.tracker_mm,
        "tracker_rad": float(np.radians(condition.tracker_deg)),
    }


def _static(method: MethodSpec) -> tuple[str, Options]:
    options = Options(
        tolerance_rad=method.tolerance_rad,
        tolerance_mm=method.tolerance_mm,
        max_rounds=method.max_rounds,
        inner_steps=method.inner_steps,
        max_iterations=method.max_iterations,
    )
    return method.prior, options


def _compile(function: Any, devices: Devices, *, fast: bool = True) -> Any:
    """Compile a function whose first argument is cut by trial where there are several devices."""
    platform = devices[0].platform
    options = (fast_to_run(platform) or {}) if fast else {}
    options = options | _ONE_THREAD if platform == "cpu" else None
    if len(devices) == 1:
        return jax.jit(function, compiler_options=options)
    mesh = Mesh(np.asarray(devices), ("trials",))
    cut, whole = PartitionSpec("trials"), PartitionSpec()

    def spread(batch: Any, *shared: Any) -> Any:
        specs = (cut, *(whole for _ in shared))
        mapped = jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=cut, check_vma=False)
        return mapped(batch, *shared)

    return jax.jit(spread, compiler_options=options)


@cache
def draw_program(shape: Shape, devices: Devices) -> Any:
    """From (trial indices, seed, numbers) to experiments and :func:`realised_errors`, compiled."""

    def draw(indices: Array, seed: Array, numbers: dict[str, Any]) -> tuple[Experiment, Array]:
        numbers = jax.tree.map(jnp.asarray, numbers)
        given = Protocol(
            images=shape.images, test_images=shape.test_images,
            elevation_distribution=shape.law, probe=shape.probe, **numbers,
        )  # fmt: skip
        root = jax.random.key(seed)

        def one(index: Array) -> tuple[Experiment, Array]:
            experiment = simulate(jax.random.fold_in(root, index), given)
            return experiment, realised_errors(experiment)

        return jax.vmap(one)(indices)

    return _compile(draw, devices)


@cache
def _solve_program(method: str, prior: str, options: Options, devices: Devices) -> Any:
    # The joint bounded method takes the general road, whose rounding is left as it was tested.
    fast = not (method == "joint" and prior == "bounded")
    return _compile(partial(_solve, method, prior, options), devices, fast=fast)


def _solve(
    method: Any, prior: Any, options: Options, drawn: Experiment, bound: Array | None
) -> Measured:
    problems = jax.vmap(lambda experiment: experiment.problem())(drawn)
    result = calibrate_batch(
        problems, method, prior, max_elevation=bound, options=options,
        chunk=drawn.points.shape[0],
    )  # fmt: skip
    x, truth = result.image_to_probe, drawn.image_to_probe
    precision = jax.vmap(reconstruction_precision)(x, drawn.test_poses, drawn.test_points)
    chord = jnp.linalg.norm(x[:, :3, :3] - truth[:, :3, :3], axis=(1, 2))
    return Measured(
        rp=precision,
        # 2 asin(|R1 - R2| / sqrt 8), the angle, keeps its digits where acos would lose them.
        rotation_error=2 * jnp.arcsin(jnp.minimum(chord / np.sqrt(8.0), 1.0)),
        translation_error=jnp.linalg.norm(x[:, :3, 3] - truth[:, :3, 3], axis=1),
        point_error=jnp.linalg.norm(result.point - drawn.point, axis=1),
        sigma=result.sigma,
        status=result.status_code.astype(jnp.int8),
        iterations=result.iterations.astype(jnp.int32),
    )


def realised_errors(experiment: Experiment) -> Float[Array, " 3"]:
    """Root mean square of the drawn lateral, range and elevational errors of one experiment, mm.

    They are what the self-tuned SDs estimate; a tracker's errors are among them.
    """
    poses, x = experiment.poses, experiment.image_to_probe
    in_probe = jnp.einsum("nji,nj->ni", poses[:, :3, :3], experiment.point - poses[:, :3, 3])
    q = (in_probe - x[:3, 3]) @ x[:3, :3]
    lateral, distance = experiment.points[:, 0], experiment.points[:, 1]
    errors = [lateral - q[:, 0], distance - jnp.hypot(q[:, 1], q[:, 2]), q[:, 1]]
    return jnp.sqrt(jnp.mean(jnp.stack(errors) ** 2, axis=1))
