"""From a batch of problems to its calibrations, as one pure function of arrays.

If the plan is robust, the images that do not agree are found first. Then the plan's method solves
the problems (:mod:`jaxcal.solvers.methods`), and the answer is put together
(:mod:`jaxcal.calibration.answer`). :mod:`jaxcal.calibration.engine` decides in which of the forms
at the end of this module it is compiled, and whether their machine code is kept.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from jaxcal.calibration.answer import assemble
from jaxcal.data.poses import LAST_ROW, LAST_ROW_TOLERANCE, ROTATION_TOLERANCE
from jaxcal.data.problem import Problem
from jaxcal.model.batch import ImagePlanes
from jaxcal.model.unknowns import Blocks
from jaxcal.result.calibration import Calibration
from jaxcal.runtime import compiler
from jaxcal.runtime.jax_modes import in_standard_promotion
from jaxcal.solvers import methods
from jaxcal.solvers.closed_form.single import Start
from jaxcal.solvers.consensus import find_consensus, rigid_model
from jaxcal.solvers.plan import Given, SolvePlan
from jaxcal.solvers.start import ConventionalStart


def solve_problems(
    problems: Problem,
    given: Given,
    plan: SolvePlan,
    agreed: Float[Array, "batch n"] | None = None,
    begun: ConventionalStart | None = None,
) -> Calibration:
    """Solve a batch of problems (one leading axis).

    Args:
        problems: the batch.
        given: the numbers in the request.
        plan: the static part of the request.
        agreed: the result of :func:`agreed_images`, if it was called before.
        begun: conventional fits of the problems, if they were made before.
    """
    if not plan.options.differentiate:
        problems, given = jax.lax.stop_gradient((problems, given))
    sound = (problems.mask == 0) | (problems.mask == 1)
    problems = problems.cleared(problems.mask)
    sound &= _rigid(problems.poses) & (problems.spacing > 0).all(axis=-1, keepdims=True)
    if (covariance := problems.covariance) is not None:
        sound &= (covariance[..., 0, 0] > 0) & (jnp.linalg.det(covariance) > 0)
    if problems.max_elevation is not None:
        sound &= problems.max_elevation >= 0
    for sds in (given.sigma, given.prior_sd):
        if sds is not None:
            sound &= (sds > 0).all()
    if given.tracker_sd is not None:
        sound &= given.tracker_sd >= 0
    if plan.robust:
        if agreed is None:
            # One problem at a time: its finalists fill the vector units, and several problems at
            # once would not fit in the cache. Which images are left out is piecewise constant in
            # the data, so it has no derivative.
            search = in_standard_promotion(lambda problem: agreed_images(problem, plan.blocks))
            seen = jax.lax.stop_gradient(problems.points_only())
            agreed = jax.vmap(jax.custom_batching.sequential_vmap(search))(seen)
        problems = replace(problems, mask=agreed)
    # Where a mask holds anything but 0 and 1, or an image has no pose, pixel size, covariance or
    # bound that could be one, or a given SD could be none, the problem fails.
    mask = jnp.where(sound, problems.mask, jnp.nan)
    # A mask is 0 or 1, and has no derivative; that of an image left out would be one of the
    # harmless values.
    problems = replace(problems, mask=jax.lax.stop_gradient(mask))
    if not plan.one_by_one:
        return _solved(problems, given, plan, begun)

    def alone(problem: Problem) -> Calibration:
        one = _solved(jax.tree.map(lambda leaf: leaf[None], problem), given, plan)
        return jax.tree.map(lambda leaf: leaf[0], one)

    return jax.lax.map(alone, problems)


def _rigid(poses: Float[Array, "batch n 4 4"]) -> Bool[Array, "batch n"]:
    """Whether poses are right-handed rigid transforms, up to what is taken for rounding."""
    x, y, z = (poses[..., :3, column] for column in range(3))
    # Axes of length 1 are at right angles, and right-handed, if each is the product of the others.
    off = jnp.stack([jnp.cross(x, y) - z, jnp.cross(y, z) - x, jnp.cross(z, x) - y], axis=-1)
    last = poses[..., 3, :] - jnp.asarray(LAST_ROW, poses.dtype)
    # Errors of two axes, and that of the third, add up.
    turns = (jnp.abs(off) < 3 * ROTATION_TOLERANCE).all(axis=(-2, -1))
    return turns & (jnp.abs(last) <= LAST_ROW_TOLERANCE).all(axis=-1)


def _solved(
    problems: Problem, given: Given, plan: SolvePlan, begun: ConventionalStart | None = None
) -> Calibration:
    images = ImagePlanes.of(problems, channels=plan.channels)
    found = methods.solve(problems, images, given, plan, begun)
    return assemble(found, problems, images, given, plan)


def agreed_images(problem: Problem, blocks: Blocks) -> Float[Array, " n"]:
    """1 for the used images of one problem that agree with each other."""
    # A NaN in an image left out would spoil every proposal, and then no image is an outlier.
    problem = jax.lax.stop_gradient(problem.cleared(problem.mask))
    return find_consensus(problem, rigid_model(blocks))


def solve_one(
    problem: Problem,
    given: Given,
    agreed: Float[Array, " n"] | None,
    start: Start | None,
    plan: SolvePlan,
) -> Calibration:
    """Solve one problem as a batch of one (traceable).

    Args:
        problem: checked.
        given: numbers that came with the request.
        agreed: 1 for the images to use, where a robust search was made before.
        start: of all methods but the conventional; without it the program finds one.
        plan: what is static about the request.
    """
    alone = jax.tree.map(lambda leaf: leaf[None], (problem, agreed, start))
    begun = None if start is None else ConventionalStart.of(alone[2], plan.blocks)
    result = solve_problems(alone[0], given, plan, alone[1], begun)
    return jax.tree.map(lambda leaf: leaf[0], result)


def solve_chunks(problems: Problem, given: Given, plan: SolvePlan, chunk: int) -> Calibration:
    """Solve a batch whose size is a multiple of the chunk's (traceable)."""
    count = problems.mask.shape[0]
    if count == chunk:
        return solve_problems(problems, given, plan)
    chunks = jax.tree.map(lambda leaf: leaf.reshape((-1, chunk, *leaf.shape[1:])), problems)
    result = jax.lax.map(lambda part: solve_problems(part, given, plan), chunks)
    return jax.tree.map(lambda leaf: leaf.reshape((count, *leaf.shape[2:])), result)


def solve_some_chunks(
    problems: Problem, given: Given, used: Int[Array, ""], how: tuple[SolvePlan, int]
) -> Calibration:
    """Solve the first chunks of a batch. The others may hold anything; their results are zeros.

    Args:
        problems: a batch whose size is a multiple of the chunk's.
        given: numbers that came with the request.
        used: how many chunks to solve.
        how: the plan and the chunk's size.
    """
    plan, chunk = how
    count = problems.mask.shape[0]
    if count == chunk:
        return solve_problems(problems, given, plan)
    parts = jax.tree.map(lambda leaf: leaf.reshape((-1, chunk, *leaf.shape[1:])), problems)

    def solved(index: Array) -> Calibration:
        return solve_problems(jax.tree.map(lambda leaf: leaf[index], parts), given, plan)

    solved, nothing = compiler.traced_once(solved, used)

    def body(index: Array, found: Calibration) -> Calibration:
        one = solved(index)
        return jax.tree.map(lambda all_of, part: all_of.at[index].set(part), found, one)

    empty = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (count // chunk, *leaf.shape)), nothing
    )
    found = jax.lax.fori_loop(0, used, body, empty)
    return jax.tree.map(lambda leaf: leaf.reshape((count, *leaf.shape[2:])), found)


@cache
def chunks(devices: tuple[Any, ...], alone: bool):
    """The compiled solve of chunks, shared by the devices; ``alone``: as a program of its own."""
    options = compiler.fast_to_run(devices[0].platform) if alone else None
    if len(devices) == 1:
        return jax.jit(solve_chunks, static_argnums=(2, 3), compiler_options=options)
    mesh, cut = Mesh(np.asarray(devices), ("problems",)), PartitionSpec("problems")

    def spread(problems: Problem, given: Given, plan: SolvePlan, chunk: int) -> Calibration:
        def share(problems: Problem, given: Given) -> Calibration:
            return solve_chunks(problems, given, plan, chunk)

        specs = (cut, PartitionSpec())
        mapped = jax.shard_map(share, mesh=mesh, in_specs=specs, out_specs=cut, check_vma=False)
        return mapped(problems, given)

    return jax.jit(spread, static_argnums=(2, 3), compiler_options=options)
