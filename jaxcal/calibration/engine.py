"""Solves a problem or a batch by a compiled program of :mod:`jaxcal.calibration.pipeline`.

On a CPU, machine code is kept between processes (:mod:`jaxcal.runtime.executables`), in sizes that
serve many problems. If a program is kept, the pipeline is neither imported, traced nor compiled. So
one problem is solved on a CPU, unless its arrays were put elsewhere. On other devices, inside
somebody's jit, vmap or grad, and with a solver of the caller's own, JAX compiles the pipeline.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding

from jaxcal import InputError
from jaxcal.data.problem import Problem, lengthened
from jaxcal.model.unknowns import MEDIUM
from jaxcal.result.calibration import Calibration
from jaxcal.runtime import compiler, executables
from jaxcal.runtime.array_types import Int
from jaxcal.runtime.arrays import each_image, first_images, map_arrays
from jaxcal.runtime.executables import bucket, padded_images
from jaxcal.runtime.jax_modes import in_own_modes, inside_transformation
from jaxcal.solvers.closed_form.single import closed_form_start
from jaxcal.solvers.plan import Given, SolvePlan

T = TypeVar("T")

BATCH_CHUNK = 32
"""Problems solved side by side: enough to fill the vector units, few enough for their normal
matrices (20 kB) to stay in the first-level cache. Measured with 12 to 1000 images."""

LAWS_CHUNK = 64
"""The same where laws are weighed: most of that time goes by the images, not by the matrices."""

CHANNELS_CHUNK = 8
"""The same for solves on channels, whose problems are a hundred times larger."""

ACCELERATOR_ROWS = 2**20
"""On an accelerator, images (times elements, on channels) side by side: enough to fill it, few
enough for its memory."""

FEW_PROBLEMS = 1024
"""Up to so many problems of a batch are padded to a bucket of images, or of problems."""


@in_own_modes
def solve_problem(problem: Problem, given: Given, plan: SolvePlan) -> Calibration:
    """Solve one problem; the result does not hold the problem (traceable)."""
    executables.refuse_after_fork()  # a program that JAX compiles would hang there, too
    if _is_kept(problem, plan, inside=inside_transformation(problem, given)):
        return _solve_kept(problem, given, plan)
    return _solve_compiled(problem, given, plan)


def _solve_compiled(problem: Problem, given: Given, plan: SolvePlan) -> Calibration:
    """Solve one problem by a program that JAX compiles."""
    from jaxcal.calibration.pipeline import agreed_images, solve_one

    platform = None
    if not inside_transformation(problem, given):
        platform = _devices(problem)[0].platform
    agreed = None
    if plan.robust:
        search = compiler.compiled(agreed_images, 1, platform)
        agreed = search(problem.points_only(), plan.blocks)
    return compiler.compiled(solve_one, 4, platform)(problem, given, agreed, None, plan)


def _solve_kept(problem: Problem, given: Given, plan: SolvePlan) -> Calibration:
    """Solve one problem by kept programs, which serve several numbers of images."""
    problem = _as_read(problem, plan)
    padded = lengthened(problem, padded_images(problem.images))
    run = partial(executables.run, flags=compiler.ONE_PROBLEM)
    label = _label(plan, padded.images)
    agreed, used = None, problem
    if plan.robust:
        agreed = np.zeros(padded.images, padded.mask.dtype)
        seen, points = _to_search(problem.points_only())
        search = label | {"method": "robust", "prior": "none", "images": points.images}
        found = run(
            "jaxcal.calibration.pipeline:agreed_images", (points,), plan.blocks, label=search
        )
        agreed[seen] = found[: len(seen)]
        used = replace(problem, mask=agreed[: problem.images])
    start = None if plan.method == "conventional" else closed_form_start(used, plan.blocks)
    arguments = (padded, given, agreed, start)
    result = run("jaxcal.calibration.pipeline:solve_one", arguments, plan, label=label)
    return as_jax_holds(first_images(result, problem.images), problem)


def _to_search(problem: Problem) -> tuple[Int[np.ndarray, " m"], Problem]:
    """The images in which those that agree are searched, and a problem of them alone, padded.

    The images of a long stream that are masked out would take most of the search's time.
    """
    used = np.flatnonzero(problem.mask)
    if padded_images(len(used)) == padded_images(problem.images):
        used = np.arange(problem.images)
    kept = each_image(problem, lambda values, axis: np.asarray(values).take(used, axis))
    return used, lengthened(kept, padded_images(len(used)))


@in_own_modes
def solve_batch(problems: Problem, given: Given, plan: SolvePlan, chunk: int | None) -> Calibration:
    """Solve a batch; the result holds its problems (traceable).

    Args:
        problems: with any leading axes.
        given: numbers that came with the request.
        plan: what is static about it.
        chunk: number of problems solved side by side; None: what suits the data and the device.
    """
    executables.refuse_after_fork()
    shape = problems.batch_shape
    inside = inside_transformation(problems, given)
    if not inside:
        problems = _with_automatic_axes(problems)
    flat = problems
    if len(shape) > 1:
        flat = map_arrays(lambda leaf: leaf.reshape((-1, *leaf.shape[len(shape) :])), problems)
    largest = chunk or _side_by_side(problems, plan, inside=inside)
    count = flat.mask.shape[0]
    kept = count > 0 and _is_kept(problems, plan, inside=inside)
    if kept:
        result, done = _solve_chunks_kept(flat, given, plan, largest, flat is problems)
        if done:
            return replace(result, problem=problems)
    else:
        result = _solve_chunks_compiled(flat, given, plan, largest)
    result = map_arrays(lambda leaf: leaf[:count].reshape((*shape, *leaf.shape[1:])), result)
    # Moved after it is cut: a slice of a numpy array is a view, one of a JAX array a copy.
    return replace(as_jax_holds(result, problems) if kept else result, problem=problems)


def _with_automatic_axes(problems: Problem) -> Problem:
    """The problems divided as they are, by a mesh that leaves it to JAX how results are divided.

    The axes of ``jax.make_mesh`` are explicit: each operation would have to say it of its result.
    """

    def is_explicit(leaf: Any) -> bool:
        sharding = getattr(leaf, "sharding", None)
        return isinstance(sharding, NamedSharding) and bool(sharding.mesh.explicit_axes)

    def automatic(leaf: Any) -> Any:
        if not is_explicit(leaf):
            return leaf
        mesh = Mesh(leaf.sharding.mesh.devices, leaf.sharding.mesh.axis_names)
        return jax.device_put(leaf, NamedSharding(mesh, leaf.sharding.spec))

    if not any(map(is_explicit, jax.tree.leaves(problems))):
        return problems
    if jax.sharding.get_abstract_mesh().explicit_axes:
        raise InputError(
            "jax.set_mesh makes the axes of a mesh explicit: call jaxcal.calibrate_batch outside "
            "of it, or make the mesh with axis_types=(jax.sharding.AxisType.Auto,)"
        )
    return map_arrays(automatic, problems)


def _side_by_side(problems: Problem, plan: SolvePlan, *, inside: bool) -> int:
    """Number of problems that are solved side by side by default."""
    platform = jax.default_backend() if inside else _devices(problems)[0].platform
    if platform == "cpu":
        if plan.channels:
            return CHANNELS_CHUNK
        return LAWS_CHUNK if plan.laws else BATCH_CHUNK
    rows = problems.images
    if plan.channels and problems.channels is not None:
        rows *= problems.channels.distances.shape[-1]
    return max(ACCELERATOR_ROWS // max(rows, 1), 1)


def _solve_chunks_kept(
    problems: Problem, given: Given, plan: SolvePlan, largest: int, last: bool
) -> tuple[Calibration, bool]:
    """Solve a batch (one leading axis) by a kept program, which serves batches of nearly its size.

    At most ``largest`` problems are solved side by side.

    Returns:
        The result and True: finished, in JAX arrays, if the caller does nothing to it afterwards
        (``last``) and the batch needed no padding. Else the result in numpy arrays, padding
        included, and False.
    """
    count, images = problems.mask.shape
    chunk = min(bucket(count), largest)
    pieces = -(-count // chunk)
    padded = problems = _as_read(problems, plan)
    if count <= FEW_PROBLEMS:
        # Here a person waits for the compiler; of thousands, masked images would cost run time.
        padded = lengthened(problems, bucket(images))
    size = bucket(pieces) if pieces > 1 else 1
    done = last and size * chunk == count and padded.images == images
    if size * chunk != count:
        # A copy of everything, which costs as much as the cheapest solves.
        rows = np.arange(size * chunk) % count
        padded = map_arrays(lambda leaf: np.asarray(leaf)[rows], padded)
    label = _label(plan, padded.images) | {"problems": size * chunk}
    result = executables.run(
        "jaxcal.calibration.pipeline:solve_some_chunks",
        (padded, given, np.asarray(pieces, np.int32)),
        (plan, chunk),
        flags=compiler.batch_flags(),
        label=label,
        convert=partial(_kept_as_jax_holds, problem=problems) if done else executables.in_numpy,
    )
    return (result, True) if done else (first_images(result, images), False)


def _as_read(problem: Problem, plan: SolvePlan) -> Problem:
    """The problem without what a solve does not read.

    Otherwise a recording with a probe would need other programs than arrays in memory.
    """
    if plan.channels:
        return problem
    problem = replace(problem, channels=None)
    return problem if {*MEDIUM} & {*plan.blocks} else replace(problem, sound_speed=None, delay=None)


def _solve_chunks_compiled(
    problems: Problem, given: Given, plan: SolvePlan, largest: int
) -> Calibration:
    """Solve a batch (one leading axis) by a program that JAX compiles.

    If its arrays are not committed to a device, all of the local devices share it.
    """
    from jaxcal.calibration import pipeline

    count = problems.mask.shape[0]
    alone = not inside_transformation(problems, given)
    devices = _devices(problems) if alone else tuple(jax.local_devices())[:1]
    # Chunks of one size, the last one filled up: a remainder would be compiled as a second program.
    pieces = max(-(-count // largest), 1)
    if pieces >= len(devices):
        pieces = -(-pieces // len(devices)) * len(devices)
    else:
        devices = devices[:1]
    size = max(-(-count // pieces), 1)
    if alone and 0 < count <= FEW_PROBLEMS and not plan.one_by_one:
        size = min(bucket(size), largest)  # so that one program serves several sizes
    if count and pieces * size != count:
        rows = jnp.arange(pieces * size) % count
        problems = jax.tree.map(lambda leaf: leaf[rows], problems)
    return pipeline.chunks(devices, alone)(problems, given, plan, size)


def _label(plan: SolvePlan, images: int) -> dict[str, Any]:
    """What a kept program is, for ``jaxcal cache show``."""
    return {
        "method": plan.method,
        "prior": plan.reported_prior,
        "unknowns": ", ".join(plan.blocks),
        "data": "channels" if plan.channels else "points",
        "images": images,
    }


def _is_kept(problems: Problem, plan: SolvePlan, *, inside: bool) -> bool:
    """Whether a kept program solves one problem or many: on one CPU, and by our own solvers.

    It does not if this is ``inside`` a jit, vmap or grad of the caller's.
    """
    if inside or not executables.is_describable(plan):
        return False
    interpreted = jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
    devices = _devices(problems)
    if not problems.batch_shape:
        devices = (_held(problems) or (executables.processor() or devices[0],))[:1]
    return len(devices) == 1 and devices[0].platform == "cpu" and not interpreted


def as_jax_holds(arrays: T, problem: Problem) -> T:
    """JAX arrays on the device of the problem's."""
    return jax.device_put(arrays, next(iter(_held(problem)), None))


def _kept_as_jax_holds(arrays: list[Any], problem: Problem) -> list[Any]:
    """A program's arrays, moved from its device to that of the problem's."""
    if len(jax.devices()) == 1 and jax.default_backend() == "cpu":
        return arrays  # there is no other place
    return as_jax_holds(executables.in_numpy(arrays), problem)


def _devices(problems: Problem) -> tuple[Any, ...]:
    """The devices that hold a problem's arrays; all local ones if these are not committed."""
    return _held(problems) or tuple(jax.local_devices())


def _held(problems: Problem) -> tuple[Any, ...]:
    """The devices that hold a problem's arrays; none if these are not committed to a device."""
    leaves = [leaf for leaf in jax.tree.leaves(problems) if isinstance(leaf, jax.Array)]
    held = {frozenset(leaf.devices()) for leaf in leaves if leaf.committed}
    if len(held) > 1:
        raise InputError(
            "the problem's arrays lie on different devices: put all of them on the same ones "
            "(jax.device_put takes a whole problem)"
        )
    return tuple(sorted(held.pop(), key=lambda d: d.id)) if held else ()
