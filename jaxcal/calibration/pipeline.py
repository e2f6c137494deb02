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

from jaxcal.calibration.answer import Average, Solved, assemble
from jaxcal.data.problem import Problem
from jaxcal.model.batch import ImagePlanes, barrier
from jaxcal.model.observations import BoundedOffsets, LocalUnknown, local_unknowns
from jaxcal.model.unknowns import Blocks
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.jax_modes import in_standard_promotion
from jaxcal.solvers import methods
from jaxcal.solvers.consensus import find_consensus, rigid_model
from jaxcal.solvers.methods import Solution
from jaxcal.solvers.normal_equations import accumulate, information_and_design
from jaxcal.solvers.plan import Given, SolvePlan
from jaxcal.solvers.start import ConventionalStart, GivenStart


def solve_problems(
    problems: Problem,
    given: Given,
    plan: SolvePlan,
    agreed: Float[Array, "batch n"] | None = None,
    begun: ConventionalStart | GivenStart | None = None,
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
    if plan.one_by_one:
        solution = jax.lax.map(
            lambda problem: _solved(*_alone(problem, plan), given, plan), problems
        )
        solved, averaged = jax.tree.map(lambda leaf: leaf[:, 0], solution)
        images = ImagePlanes.of(problems)
    else:
        images = ImagePlanes.of(problems, channels=plan.channels)
        solved, averaged = _solved(problems, images, given, plan, begun)
    return assemble(solved, averaged, problems, images, given, plan)


def _one_at_a_time(blocks: Blocks):
    # One problem at a time, even in a batch: its finalists fill the vector units, and several
    # problems at once would not fit in the cache.
    agreed = in_standard_promotion(lambda problem: agreed_images(problem, blocks))
    return jax.custom_batching.sequential_vmap(agreed)


def agreed_images(problem: Problem, blocks: Blocks) -> Float[Array, " n"]:
    """1 for the used images of one problem that agree with each other."""
    return find_consensus(jax.lax.stop_gradient(problem), rigid_model(blocks)).keep


def _alone(problem: Problem, plan: SolvePlan) -> tuple[Problem, ImagePlanes]:
    """A batch of one."""
    batch = jax.tree.map(lambda leaf: leaf[None], problem)
    return batch, ImagePlanes.of(batch, channels=plan.channels)


def _solved(
    problems: Problem,
    images: ImagePlanes,
    given: Given,
    plan: SolvePlan,
    begun: ConventionalStart | GivenStart | None = None,
) -> tuple[Solved, Average | None]:
    """The method's solution with its normal matrices, problems first."""
    found = methods.solve(problems, images, given, plan, begun)
    observation = found.observation
    information, design = barrier(_normal_matrices(found, images))
    offset = jnp.zeros((images.batch_size, 0), images.mask.dtype)
    if isinstance(observation, LocalUnknown):
        offset = local_unknowns(found.iterate, observation, images)
    solved = Solved(
        parameters=found.iterate.parameters(),
        offset=offset,
        sigma=observation.sigma.T[:, [*observation.error_sd]] if observation.whitened else None,
        bound=observation.bound if isinstance(observation, BoundedOffsets) else None,
        information=jnp.moveaxis(information, -1, 0),
        design=jnp.moveaxis(design, -1, 0),
        convergence=found.convergence,
        prior_sd=None if found.medium is None else found.medium.sd.T,
    )
    if found.covariance is None or found.elevation_sd is None or found.law is None:
        return solved, None
    covariance = jnp.moveaxis(found.covariance, -1, 0)
    return solved, Average(covariance, found.elevation_sd, found.law)


def _normal_matrices(
    found: Solution, images: ImagePlanes
) -> tuple[Float[Array, "p p batch"], Float[Array, "p p batch"]]:
    """The weighted normal matrix at a solution, and that of the unweighted components."""
    observation, iterate = found.observation, found.iterate
    geometry = observation.geometry(images, iterate.blocks)
    if geometry is observation and observation.whitened:
        return information_and_design(iterate, observation, images, found.medium)
    weighted = accumulate(iterate, observation, images, None, found.medium).stacked()
    if geometry is observation:
        return weighted, weighted
    return weighted, accumulate(iterate, geometry, images, None).stacked()
