"""The front door: one problem or a batch, by any method, to a :class:`Calibration`.

What was asked for is checked in :mod:`jaxcal.options`; :mod:`jaxcal.pipeline` is the road that
every problem takes, one pure function of arrays; here it is compiled, once for each combination of
shapes and options, and mapped over batches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from jaxcal import buckets, compiler, executables
from jaxcal.calibration import Calibration
from jaxcal.dependence import independent
from jaxcal.diagnostics.serial_correlation import widened
from jaxcal.errors import InputError
from jaxcal.inputs import as_batch, as_problem, unknown_names
from jaxcal.options import (
    DELAY_SD_S,
    SOUND_SPEED_SD_M_S,
    Data,
    Given,
    Method,
    Options,
    Plan,
    PriorName,
    Request,
    check_values,
    prepare,
    with_bound,
)
from jaxcal.pipeline import agreed_images, seen_by_agreement, solve_problems
from jaxcal.precision import in_own_modes, require_float64, with_dtype
from jaxcal.problem import Problem, is_traced
from jaxcal.recording import Recording

BATCH_CHUNK = 64
"""Problems solved side by side: enough to fill the vector units, few enough to stay in cache."""

CHANNELS_CHUNK = 8
"""The same for solves on channels, whose problems are a hundred times larger."""


@in_own_modes
def calibrate(
    problem: Problem | Recording,
    method: Method = "joint",
    prior: PriorName = "auto",
    *,
    max_elevation: float | np.ndarray | Array | None = None,
    sigma: tuple[float, ...] | np.ndarray | Array | None = None,
    tracker_sd: float | Array | None = None,
    estimate: str | tuple[str, ...] = (),
    data: Data = "auto",
    sound_speed_sd: float | Array = SOUND_SPEED_SD_M_S,
    delay_sd: float | Array = DELAY_SD_S,
    options: Options | None = None,
    robust: bool = False,
) -> Calibration:
    """Find X, the target and the elevational offsets; nobody supplies a starting guess.

    Args:
        problem: one problem (a batch is handed to :func:`calibrate_batch`), or a recording.
        method: ``joint`` (X, c and every offset together), ``alternating`` (the paper's Fig. 4) or
            ``conventional`` (Eq. 7, every target in the plane).
        prior: of the joint method. ``auto``: errors have self-tuned SDs, and the law of the
            offsets, their mean and the noise are weighed by the data (:mod:`jaxcal.solvers.auto`).
            ``uniform``: the same with offsets that are uniform between unknown edges.
            ``gaussian``: offsets and errors are Gaussian, with the SDs of ``sigma`` or, without it,
            self-tuned by REML. ``bounded``: |y_i| <= max_elevation with equal weights, the
            alternation's objective. With given ``sigma``, ``auto`` is ``gaussian``.
        max_elevation: bound m on |y|, mm, one number or (n,); overrides the problem's own. The
            alternation and ``bounded`` take 1 mm where there is neither; ``auto`` and ``uniform``
            cut the law of each image's offset there.
        sigma: given SDs of lateral position, range and elevational offset, mm; on channels, of an
            element's distance and the elevational offset.
        tracker_sd: isotropic SD of the tracked position, mm, beside given ``sigma``.
        estimate: further unknowns: ``scale`` (the pixels' size), ``sound-speed``, ``delay``; one
            name, or several.
        data: ``channels``: the joint method's residuals are those of every element's time of flight
            (the recording must hold them); ``points``: those of the segmented points; ``auto``:
            channels where they say more, on curvilinear probes and for sound speed or delay.
        sound_speed_sd: how far the sound speed may be from nominal, m/s (joint only, not bounded).
        delay_sd: how far the delay may be from nominal, s (joint only, not bounded).
        options: tolerances and limits.
        robust: first find the images that agree with each other, whatever up to nearly half of the
            others are (:mod:`jaxcal.solvers.consensus`), and leave those out: ``outlier`` and
            ``departure`` say which and why. Where no image is gravely wrong none is left out, and
            the answer is the one without.

    Returns:
        A :class:`Calibration`; ask its ``status`` and ``warnings`` before using it. Frames of one
        pose count once (:mod:`jaxcal.dependence`): the others are masked out in the answer and in
        its ``problem``. Errors that are alike in successive images widen its covariance
        (:mod:`jaxcal.diagnostics.serial_correlation`). Both are for one problem with concrete
        arrays; under jit, vmap or grad, and in batches, images are taken for independent.

    Raises:
        InputError: options that contradict each other or the problem; with concrete arrays also
            NaN, Inf and fewer than 4 different poses. Under jit, vmap or grad values cannot be
            looked at, and such problems come back with status ``failed``.
    """
    problem, estimate = as_problem(problem, "jaxcal.calibrate"), unknown_names(estimate)
    problem = _in_asked_precision(problem, options, "jaxcal.calibrate")
    request = Request(
        method,
        prior,
        max_elevation,
        sigma,
        tracker_sd,
        estimate,
        data,
        sound_speed_sd,
        delay_sd,
        options,
        robust,
    )
    plan, given = prepare(problem, request)
    if problem.batch_shape:
        return _solve_batch(problem, given, plan, None)
    check_values(problem)
    problem = with_bound(problem, given)
    if not any(is_traced(leaf) for leaf in jax.tree.leaves((problem, given))):
        joined, found = independent(problem, estimate)
        result = _solve_alone(joined, given, plan).with_problem(joined)
        result = replace(result, notes=() if found.words is None else (found.words,))
        return widened(result)
    return _solve_alone(problem, given, plan).with_problem(problem)


def _solve_alone(problem: Problem, given: Given, plan: Plan) -> Calibration:
    """One problem, without it in the result (traceable)."""
    alone = compiler.is_whole_program(problem, given)
    platform = _devices(problem)[0].platform if alone else None
    interpreted = jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
    if platform == "cpu" and executables.is_describable(plan) and not interpreted:
        return _solve_kept(problem, given, plan)
    # A program of its own, which serves every method and prior.
    agreed = _agreement(platform)(seen_by_agreement(problem), plan.blocks) if plan.robust else None
    return _one_problem(platform)(problem, given, plan, agreed)


@in_own_modes
def calibrate_batch(
    problems: Problem | Sequence[Problem | Recording],
    method: Method = "joint",
    prior: PriorName = "auto",
    *,
    max_elevation: float | np.ndarray | Array | None = None,
    sigma: tuple[float, ...] | np.ndarray | Array | None = None,
    tracker_sd: float | Array | None = None,
    estimate: str | tuple[str, ...] = (),
    data: Data = "auto",
    sound_speed_sd: float | Array = SOUND_SPEED_SD_M_S,
    delay_sd: float | Array = DELAY_SD_S,
    options: Options | None = None,
    robust: bool = False,
    chunk: int | None = None,
) -> Calibration:
    """:func:`calibrate` for a batch: compiled, vmapped, in chunks of lanes.

    A lane that is bad (NaN, degenerate) gets its own status and leaves its neighbours alone.

    Plain problems are shared out among all of JAX's local devices: a processor is one device unless
    ``jax.config.update("jax_num_cpu_devices", n)`` (or JAX_NUM_CPU_DEVICES=n) says before JAX's
    first use that it is n, one a core. Results do not depend on it.

    Args:
        problems: leading axes of any shape; see :func:`jaxcal.stack`. A list of problems or
            recordings with as many images each is stacked.
        method: as for :func:`calibrate`, and so are the following.
        prior: see there.
        max_elevation: see there.
        sigma: see there.
        tracker_sd: see there.
        estimate: see there.
        data: see there.
        sound_speed_sd: see there.
        delay_sd: see there.
        options: see there.
        robust: see there; it takes longer than the solve.
        chunk: lanes solved side by side; by default 64, on channels 8.

    Returns:
        A :class:`Calibration` whose arrays have the problems' leading axes.

    Raises:
        InputError: contradicting options, or problems without a leading axis.
    """
    problems = as_batch(problems, "jaxcal.calibrate_batch")
    estimate = unknown_names(estimate)
    if not problems.batch_shape:
        raise InputError("calibrate_batch needs problems with a leading axis; use calibrate")
    if chunk is not None and chunk < 1:
        raise InputError(f"chunk must be at least 1, not {chunk}")
    problems = _in_asked_precision(problems, options, "jaxcal.calibrate_batch")
    request = Request(
        method,
        prior,
        max_elevation,
        sigma,
        tracker_sd,
        estimate,
        data,
        sound_speed_sd,
        delay_sd,
        options,
        robust,
    )
    plan, given = prepare(problems, request)
    return _solve_batch(problems, given, plan, chunk)


def _solve_kept(problem: Problem, given: Given, plan: Plan) -> Calibration:
    """One problem by programs that are kept, which serve every number of images of a bucket."""
    padded = buckets.padded(problem)
    given = replace(given, max_elevation=None)  # the problem has it
    run = partial(executables.run, flags=compiler.ONE_PROBLEM)
    label = {
        "method": plan.method,
        "prior": plan.reported_prior,
        "unknowns": ", ".join(plan.blocks),
        "data": "channels" if plan.channels else "points",
        "images": padded.images,
    }
    agreed = None
    if plan.robust:
        search = label | {"method": "robust", "prior": "none"}
        agreed = run(agreed_images, (seen_by_agreement(padded),), plan.blocks, label=search)
    result = run(_solve_agreeing, (padded, given, agreed), plan, label=label)
    return jax.device_put(buckets.cut(result, problem.images), next(iter(_held(problem)), None))


def _solve_agreeing(
    problem: Problem, given: Given, agreed: Array | None, plan: Plan
) -> Calibration:
    return solve_one(problem, given, plan, agreed)


def _in_asked_precision(problem: Problem, options: Options | None, name: str) -> Problem:
    precision = Options.precision if options is None else options.precision
    if precision == "float64":
        require_float64(name)
    return with_dtype(problem, np.dtype(precision))


def _devices(problems: Problem) -> tuple[Any, ...]:
    """The devices that hold a problem's arrays, or all local ones where they may go anywhere."""
    return _held(problems) or tuple(jax.local_devices())


def _held(problems: Problem) -> tuple[Any, ...]:
    """The devices that hold a problem's arrays; none where they may go anywhere."""
    leaves = [leaf for leaf in jax.tree.leaves(problems) if isinstance(leaf, jax.Array)]
    held = {frozenset(leaf.devices()) for leaf in leaves if leaf.committed}
    if len(held) > 1:
        raise InputError(
            "the problem's arrays lie on different devices: put all of them on the same ones "
            "(jax.device_put takes a whole problem)"
        )
    return tuple(sorted(held.pop(), key=lambda d: d.id)) if held else ()


def _solve_batch(problems: Problem, given: Given, plan: Plan, chunk: int | None) -> Calibration:
    shape = problems.batch_shape
    problems = with_bound(problems, given)
    flat = jax.tree.map(lambda leaf: leaf.reshape((-1, *leaf.shape[len(shape) :])), problems)
    largest = chunk or (CHANNELS_CHUNK if plan.channels else BATCH_CHUNK)
    count = flat.mask.shape[0]
    # Chunks of one size, the last one filled up: a remainder would be compiled as a second program.
    pieces = max(-(-count // largest), 1)
    program, devices = _chunks_program(flat, given, plan)
    if pieces >= len(devices):
        pieces = -(-pieces // len(devices)) * len(devices)
    else:
        program, devices = _chunks_program(flat, given, plan, spread=False)
    lanes = max(-(-count // pieces), 1)
    if count and pieces * lanes != count:
        rows = jnp.arange(pieces * lanes) % count
        flat = jax.tree.map(lambda leaf: leaf[rows], flat)
    result = program(flat, given, plan, lanes)
    result = jax.tree.map(lambda leaf: leaf[:count].reshape((*shape, *leaf.shape[1:])), result)
    return result.with_problem(problems)


def solve_one(
    problem: Problem, given: Given, plan: Plan, agreed: Float[Array, " n"] | None
) -> Calibration:
    """One problem is a batch of one (traceable)."""
    alone = jax.tree.map(lambda leaf: leaf[None], (problem, agreed))
    result = solve_problems(alone[0], given, plan, alone[1])
    return jax.tree.map(lambda leaf: leaf[0], result)


@cache
def _one_problem(platform: str | None):
    """The compiled solve of one problem; with a platform, as a program of its own."""
    flags = None if platform is None else compiler.quick_to_compile(platform)
    return jax.jit(solve_one, static_argnums=2, compiler_options=flags)


@cache
def _agreement(platform: str | None):
    """The compiled consensus of one problem's images, likewise."""
    flags = None if platform is None else compiler.quick_to_compile(platform)
    return jax.jit(agreed_images, static_argnums=1, compiler_options=flags)


def solve_chunks(problems: Problem, given: Given, plan: Plan, chunk: int) -> Calibration:
    """Solve a batch whose size is a multiple of the chunk's (traceable)."""
    count = problems.mask.shape[0]
    if count == chunk:
        return solve_problems(problems, given, plan)
    chunks = jax.tree.map(lambda leaf: leaf.reshape((-1, chunk, *leaf.shape[1:])), problems)
    result = jax.lax.map(lambda part: solve_problems(part, given, plan), chunks)
    return jax.tree.map(lambda leaf: leaf.reshape((count, *leaf.shape[2:])), result)


@cache
def _chunks(devices: tuple[Any, ...], alone: bool):
    """The compiled solve of chunks, which several devices share; alone: a program of its own."""
    options = compiler.fast_to_run(devices[0].platform) if alone else None
    if len(devices) == 1:
        return jax.jit(solve_chunks, static_argnums=(2, 3), compiler_options=options)
    mesh, cut = Mesh(np.asarray(devices), ("problems",)), PartitionSpec("problems")

    def spread(problems: Problem, given: Given, plan: Plan, chunk: int) -> Calibration:
        def share(problems: Problem, given: Given) -> Calibration:
            return solve_chunks(problems, given, plan, chunk)

        specs = (cut, PartitionSpec())
        mapped = jax.shard_map(share, mesh=mesh, in_specs=specs, out_specs=cut, check_vma=False)
        return mapped(problems, given)

    return jax.jit(spread, static_argnums=(2, 3), compiler_options=options)


def _chunks_program(problems: Problem, given: Given, plan: Plan, *, spread: bool = True):
    """The compiled form, and the devices that it runs on."""
    alone = compiler.is_whole_program(problems, given)
    devices = _devices(problems) if alone else tuple(jax.local_devices())
    devices = devices if alone and spread else devices[:1]
    return _chunks(devices, alone), devices
