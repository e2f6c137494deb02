"""The pure functions that are compiled, and their forms compiled by JAX.

:mod:`jaxcal.calibration.engine` decides which of them solves a problem; on a CPU it keeps their
machine code (:mod:`jaxcal.runtime.executables`) instead of compiling them here.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int

from jaxcal.calibration.pipeline import solve_problems
from jaxcal.data.problem import Problem
from jaxcal.result.calibration import Calibration
from jaxcal.runtime import compiler
from jaxcal.solvers.closed_form.single import Start
from jaxcal.solvers.plan import Given, SolvePlan
from jaxcal.solvers.start import ConventionalStart


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
