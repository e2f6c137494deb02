"""From a batch of problems to its calibrations, as one pure function of arrays.

If the plan is robust, the images that do not agree are found first. Then the plan's method solves
the problems (:mod:`jaxcal.solvers.methods`), and the answer is put together
(:mod:`jaxcal.calibration.answer`). :mod:`jaxcal.calibration.programs` compiles this function.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.calibration.answer import assemble
from jaxcal.data.problem import Problem
from jaxcal.model.batch import ImagePlanes
from jaxcal.model.unknowns import Blocks
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.jax_modes import in_standard_promotion
from jaxcal.solvers import methods
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
    is_mask = (problems.mask == 0) | (problems.mask == 1)
    problems = problems.cleared(problems.mask)
    if plan.robust:
        if agreed is None:
            # Which images are left out is piecewise constant in the data, so it has no derivative.
            seen = jax.lax.stop_gradient(problems.points_only())
            agreed = jax.vmap(_one_at_a_time(plan.blocks))(seen)
        problems = replace(problems, mask=agreed)
    # What is neither used nor left out must not count as something between: its problem fails.
    problems = replace(problems, mask=jnp.where(is_mask, problems.mask, jnp.nan))
    if not plan.one_by_one:
        return _solved(problems, given, plan, begun)

    def alone(problem: Problem) -> Calibration:
        one = _solved(jax.tree.map(lambda leaf: leaf[None], problem), given, plan)
        return jax.tree.map(lambda leaf: leaf[0], one)

    return jax.lax.map(alone, problems)


def _solved(
    problems: Problem,
    given: Given,
    plan: SolvePlan,
    begun: ConventionalStart | None = None,
) -> Calibration:
    images = ImagePlanes.of(problems, channels=plan.channels)
    found = methods.solve(problems, images, given, plan, begun)
    return assemble(found, problems, images, given, plan)


def _one_at_a_time(blocks: Blocks):
    # One problem at a time, even in a batch: its finalists fill the vector units, and several
    # problems at once would not fit in the cache.
    agreed = in_standard_promotion(lambda problem: agreed_images(problem, blocks))
    return jax.custom_batching.sequential_vmap(agreed)


def agreed_images(problem: Problem, blocks: Blocks) -> Float[Array, " n"]:
    """1 for the used images of one problem that agree with each other."""
    return find_consensus(jax.lax.stop_gradient(problem), rigid_model(blocks)).keep
