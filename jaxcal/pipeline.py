"""The road that every problem takes, whatever the method, as one pure function of arrays.

The conventional fit from the closed-form start; the method itself from there; derivatives by the
implicit function theorem; the average over the offsets' laws where they are to be weighed;
uncertainty at the solution; and all of it put together as a :class:`Calibration`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal import answer
from jaxcal.answer import nominal_sound_speed
from jaxcal.calibration import Calibration, Convergence
from jaxcal.model.parameters import RIGID, Blocks, Parameters, retract
from jaxcal.model.priors import (
    AbstractPrior,
    AbstractSelfTuned,
    Bounded,
    ChannelGaussian,
    Gaussian,
    InPlane,
    covariance_shape,
)
from jaxcal.options import DEFAULT_MAX_ELEVATION_MM, Given, Plan
from jaxcal.precision import in_standard_promotion
from jaxcal.problem import Problem
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers import implicit
from jaxcal.solvers.alternating import alternate
from jaxcal.solvers.auto import average_over_laws
from jaxcal.solvers.consensus import find_consensus, rigid_model
from jaxcal.solvers.conventional import from_scratch, pairwise_gradient
from jaxcal.solvers.joint import joint
from jaxcal.solvers.least_squares import linearise, minimise
from jaxcal.solvers.variance import self_tuned

HELD_SIGMA = (0.5, 0.5, 1.0)
"""SDs of lateral position, range and offset (mm), where too few images leave them unknown."""

HELD_CHANNEL_SIGMA = (0.5, 1.0)
"""SDs of an element's distance and of the offset (mm), likewise."""


class Solution(eqx.Module):
    """What the methods have in common when they are done."""

    parameters: Parameters
    offset: Float[Array, " k"]
    prior: AbstractPrior
    sigma_floored: Bool[Array, " components"]
    cost: Float[Array, ""]
    stationarity: Float[Array, ""]
    arrived: Bool[Array, ""]
    iterations: Array
    variance_rounds: Array
    rotation_change: Float[Array, ""]
    translation_change: Float[Array, ""]
    trace: Float[Array, " trace"] | None
    searched_start: Bool[Array, ""]


def solve_problem(
    problem: Problem, given: Given, plan: Plan, agreed: Float[Array, " n"] | None = None
) -> Calibration:
    """Solve one problem (vmap it for a batch); plain ones take :mod:`jaxcal.abreast` instead.

    Args:
        problem: the problem.
        given: numbers that came with the request.
        plan: what is static about it.
        agreed: what :func:`agreed_images` found, where it was asked before.
    """
    if not plan.options.differentiate:
        problem, given = jax.lax.stop_gradient((problem, given))
    everything = problem = problem.cleared(problem.mask)
    problem = agreeing(problem, plan) if agreed is None else replace(problem, mask=agreed)
    frozen = jax.lax.stop_gradient((problem, given))
    return finish(_run_method(*frozen, plan), problem, everything, given, plan)


def agreeing(problem: Problem, plan: Plan) -> Problem:
    """The problem with only those images that agree, where the plan is to find them first."""
    if not plan.robust:
        return problem
    # One problem at a time, in a batch too: its finalists fill the vector units, and more problems
    # at once would only leave the cache.
    agreed = in_standard_promotion(lambda p: agreed_images(p, plan.blocks))
    found = jax.custom_batching.sequential_vmap(agreed)
    # Which images are left out is piecewise constant in the data: no derivative passes here.
    return replace(problem, mask=found(jax.lax.stop_gradient(seen(problem))))


def agreed_images(problem: Problem, blocks: Blocks) -> Float[Array, " n"]:
    """1 for the used images that agree with each other."""
    return find_consensus(jax.lax.stop_gradient(problem), rigid_model(blocks)).keep


def seen(problem: Problem) -> Problem:
    """What the agreement of images is about: their points and poses."""
    return replace(
        problem, channels=None, covariance=None, max_elevation=None, sound_speed=None, delay=None
    )


def finish(
    solution: Solution, problem: Problem, everything: Problem, given: Given, plan: Plan
) -> Calibration:
    """Derivatives, uncertainty and status of a solution.

    Args:
        solution: where the method stopped.
        problem: the images in use.
        everything: with those that were left out because they do not agree.
        given: numbers that came with the request.
        plan: what is static about it.
    """
    problem, everything = problem.cleared(everything.mask), everything.cleared(everything.mask)
    # The solver saw constants; here its answer becomes a function of the data again.
    parameters, offset, prior = _attach(solution, problem, given, plan)
    averaged = None
    if plan.laws and isinstance(prior, AbstractSelfTuned):
        averaged = average_over_laws(parameters, prior, problem, plan.blocks, plan.laws)
        parameters, prior = averaged.parameters, averaged.belief
    whole = linearise(parameters, offset, prior, problem, plan.blocks)[0]
    design = whole.shared
    if plan.prior == "gaussian" or plan.blocks != RIGID:
        design = _design(*jax.lax.stop_gradient((parameters, problem)), plan)
    solved = solved_by(solution, parameters, offset, prior, arrows.schur(whole)[0], design, plan)
    return answer.assemble(solved, averaged, problem, given, plan)


def _design(parameters: Parameters, problem: Problem, plan: Plan) -> Float[Array, "p p"]:
    """The information of the unweighted residuals, offsets taken as known."""
    none = jnp.zeros(0, problem.mask.dtype)
    unweighted = ChannelGaussian(jnp.ones(2, none.dtype)) if plan.channels else InPlane()
    return linearise(parameters, none, unweighted, problem, plan.blocks)[0].shared


def solved_by(
    solution: Solution,
    parameters: Parameters,
    offset: Float[Array, "*batch k"],
    prior: AbstractPrior,
    information: Float[Array, "*batch p p"],
    design: Float[Array, "*batch p p"],
    plan: Plan,
) -> answer.Solved:
    """What :func:`jaxcal.answer.assemble` is told of a solution."""
    floored = solution.sigma_floored
    return answer.Solved(
        parameters=parameters,
        offset=offset,
        sigma=prior.sigma if isinstance(prior, AbstractSelfTuned) else None,
        bound=prior.bound if isinstance(prior, Bounded) else None,
        information=information,
        design=design,
        convergence=Convergence(
            cost=solution.cost,
            stationarity=solution.stationarity,
            tolerance_met=solution.arrived,
            iterations=solution.iterations,
            variance_rounds=solution.variance_rounds,
            searched_start=solution.searched_start,
            # Of an element's distance come both SDs of a point.
            sigma_floored=floored[..., jnp.asarray([0, 0, 1])] if plan.channels else floored,
            rotation_change=solution.rotation_change,
            translation_change=solution.translation_change,
            trace=solution.trace,
        ),
    )


def belief(problem: Problem, given: Given, plan: Plan) -> AbstractPrior:
    """The residuals of the plan's objective; where SDs are tuned, with those to hold instead."""
    if plan.prior == "none":
        return InPlane()
    if plan.prior == "bounded":
        bound = problem.max_elevation
        if bound is None:
            bound = jnp.full_like(problem.mask, DEFAULT_MAX_ELEVATION_MM)
        return Bounded(bound)
    held = HELD_CHANNEL_SIGMA if plan.channels else HELD_SIGMA
    sigma = jnp.asarray(held, problem.mask.dtype) if given.sigma is None else given.sigma
    medium = None
    if given.medium_sd is not None:
        speed = nominal_sound_speed(problem)
        # A delay in s is a distance in mm at the nominal speed.
        medium = jnp.stack([given.medium_sd[0] / speed, given.medium_sd[1] * speed * 1e3])
    if plan.channels:
        return ChannelGaussian(sigma, medium)
    # Where laws are weighed, so are the covariances, and the first fit does without.
    covariance = None if plan.laws else covariance_shape(problem)
    return Gaussian(sigma, covariance, given.tracker_sd, medium)


def _run_method(problem: Problem, given: Given, plan: Plan) -> Solution:
    options, blocks = plan.options, plan.blocks
    conventional = plan.method == "conventional"
    historical, other = options.solver == "gradient", plan.other_solver
    undamped = conventional and options.solver == "gauss-newton"
    begun = from_scratch(
        problem, blocks,
        solver="gauss-newton" if undamped else "lm",
        exact=conventional and options.solver == "lm",
        max_steps=options.max_iterations,
        trace=options.trace if conventional else 0,
    )  # fmt: skip
    start = begun.fit.parameters
    prior = belief(problem, given, plan)

    def solution(fit, prior: AbstractPrior, arrived, **others) -> Solution:
        zero = jnp.zeros((), problem.mask.dtype)
        common = {
            "sigma_floored": jnp.zeros(3, bool), "variance_rounds": jnp.zeros((), jnp.int32),
            "rotation_change": zero, "translation_change": zero,
        }  # fmt: skip
        return Solution(
            parameters=fit.parameters, offset=fit.offset, prior=prior, cost=fit.cost,
            stationarity=fit.stationarity, arrived=arrived, iterations=fit.iterations,
            trace=fit.trace, searched_start=begun.searched, **(common | others),
        )  # fmt: skip

    if conventional:
        fit = begun.fit
        if historical:
            fit = pairwise_gradient(
                begun.start, problem, blocks, tolerance=options.gradient_tolerance,
                max_steps=100 * options.max_iterations, trace=options.trace,
            )  # fmt: skip
        if other is not None:
            fit = minimise(
                begun.start, InPlane(), problem, blocks, max_steps=options.max_iterations,
                trace=options.trace, solver=other,
            )  # fmt: skip
        return solution(fit, prior, fit.settled)

    if plan.method == "alternating" and isinstance(prior, Bounded):
        done = alternate(
            start, prior, problem, blocks, tolerance_rad=options.tolerance_rad,
            tolerance_mm=options.tolerance_mm, max_rounds=options.max_rounds,
            inner_steps=options.inner_steps, trace=options.trace,
        )  # fmt: skip
        return solution(
            done, prior, done.tolerance_met, rotation_change=done.rotation_change,
            translation_change=done.translation_change,
        )  # fmt: skip

    common: dict[str, Any] = {
        "max_steps": options.max_iterations,
        "trace": options.trace,
        "solver": other,
    }
    if plan.self_tuning and isinstance(prior, AbstractSelfTuned):
        tuned = self_tuned(start, prior, problem, blocks, **common)
        return solution(
            tuned.fit, prior.with_sigma(tuned.sigma), tuned.fit.settled & tuned.settled,
            sigma_floored=tuned.floored, variance_rounds=tuned.rounds,
        )  # fmt: skip
    fit = joint(start, prior, problem, blocks, **common)
    return solution(fit, prior, fit.settled)


def _attach(
    solution: Solution, problem: Problem, given: Given, plan: Plan
) -> tuple[Parameters, Array, AbstractPrior]:
    """The solution as a differentiable function of the problem (and of given numbers)."""
    reference, offset = solution.parameters, solution.offset
    if not plan.options.differentiate:
        return reference, offset, solution.prior
    prior = belief(problem, given, plan)
    if plan.self_tuning:
        assert isinstance(prior, AbstractSelfTuned)
        assert isinstance(solution.prior, AbstractSelfTuned)
        tangent, sigma = implicit.self_tuned_optimum(
            plan.blocks, reference, solution.prior.sigma, prior, problem
        )
        return retract(reference, tangent, plan.blocks), offset, prior.with_sigma(sigma)
    tangent, offset = implicit.optimum(plan.blocks, reference, offset, prior, problem)
    return retract(reference, tangent, plan.blocks), offset, prior
