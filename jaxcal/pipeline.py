"""The road that every problem takes, whatever the method, as one pure function of arrays.

The conventional fit from the closed-form start; the method itself from there; derivatives by the
implicit function theorem; the average over the offsets' laws where they are to be weighed;
uncertainty at the solution; and all of it put together as a :class:`Calibration`.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal.calibration import Calibration, Status
from jaxcal.inspection import Inspection, inspect
from jaxcal.metrics import root_mean_square
from jaxcal.model.parameters import Parameters, block_slice, retract
from jaxcal.model.priors import (
    AbstractPrior,
    AbstractSelfTuned,
    Bounded,
    ChannelGaussian,
    Gaussian,
    InPlane,
    channels_of,
    covariance_shape,
)
from jaxcal.model.residuals import circle_residual, measurement_residual, target_in_image
from jaxcal.options import DEFAULT_MAX_ELEVATION_MM, Given, Plan
from jaxcal.problem import Problem
from jaxcal.recording import MINIMUM_IMAGES
from jaxcal.solvers import implicit
from jaxcal.solvers.alternating import alternate
from jaxcal.solvers.auto import Averaged, OffsetLaw, average_over_laws
from jaxcal.solvers.consensus import find_consensus, rigid_model
from jaxcal.solvers.conventional import from_scratch, pairwise_gradient
from jaxcal.solvers.joint import joint
from jaxcal.solvers.variance import MINIMUM_SELF_TUNING, self_tuned
from jaxcal.sound import WATER_M_S
from jaxcal.uncertainty import LARGEST_SD, Uncertainty, assess, lever_arm

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


def solve_problem(problem: Problem, given: Given, plan: Plan) -> Calibration:
    """Solve one problem (vmap it for a batch); plain ones take :mod:`jaxcal.abreast` instead."""
    everything, problem = problem, agreeing(problem, plan)
    frozen = jax.lax.stop_gradient((problem, given))
    return finish(_run_method(*frozen, plan), problem, everything, given, plan)


def agreeing(problem: Problem, plan: Plan) -> Problem:
    """The problem with only those images that agree, where the plan is to find them first."""
    if not plan.robust:
        return problem
    # Which images are left out is piecewise constant in the data: no derivative passes here.
    agreed = find_consensus(jax.lax.stop_gradient(problem), rigid_model(plan.blocks))
    return replace(problem, mask=agreed.keep)


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
    # The solver saw constants; here its answer becomes a function of the data again.
    parameters, offset, prior = _attach(solution, problem, given, plan)
    averaged = None
    if plan.laws and isinstance(prior, AbstractSelfTuned):
        averaged = average_over_laws(parameters, prior, problem, plan.blocks, plan.laws)
        parameters, prior = averaged.parameters, averaged.belief
    uncertainty = assess(
        parameters, offset, prior, problem, plan.blocks,
        whitened=plan.prior == "gaussian", uses_prior=plan.prior != "none",
    )  # fmt: skip
    if averaged is not None:
        uncertainty = _of_the_laws(uncertainty, averaged)
    law = None if averaged is None else averaged.law
    elevation = prior.elevation(parameters, offset, problem)
    sigma = _three_sigmas(prior, parameters, elevation, uncertainty, problem)
    inspection = inspect(
        parameters, offset, prior, problem, everything, plan.blocks, sigma=sigma,
        weakest=uncertainty.weakest, left_out=plan.robust,
    )  # fmt: skip
    return _assemble(
        solution, parameters, offset, prior, uncertainty, inspection, law, problem, given, plan
    )


def _of_the_laws(uncertainty: Uncertainty, averaged: Averaged) -> Uncertainty:
    """The Gaussian solution's uncertainty with the covariances of the average over the laws."""
    weighed = averaged.law.weighed

    def either(new: Array, old: Array) -> Array:
        # What the Gaussian solution cannot tell at all stays unknown.
        return jnp.where(weighed & jnp.isfinite(old), new, old)

    return eqx.tree_at(
        lambda u: (u.covariance, u.elevation_sd),
        uncertainty,
        (
            either(averaged.covariance, uncertainty.covariance),
            either(averaged.elevation_sd, uncertainty.elevation_sd),
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


def nominal_sound_speed(problem: Problem) -> Float[Array, ""]:
    """By which the problem's times of flight became distances, m/s; water's where unknown."""
    if problem.sound_speed is None:
        return jnp.full((), WATER_M_S, problem.mask.dtype)
    return problem.sound_speed


def _run_method(problem: Problem, given: Given, plan: Plan) -> Solution:
    options, blocks = plan.options, plan.blocks
    conventional = plan.method == "conventional"
    historical = options.solver == "gradient"
    begun = from_scratch(
        problem, blocks,
        solver=options.solver if conventional and not historical else "lm",
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

    if plan.self_tuning and isinstance(prior, AbstractSelfTuned):
        tuned = self_tuned(
            start, prior, problem, blocks, max_steps=options.max_iterations, trace=options.trace
        )
        return solution(
            tuned.fit, prior.with_sigma(tuned.sigma), tuned.fit.settled & tuned.settled,
            sigma_floored=tuned.floored, variance_rounds=tuned.rounds,
        )  # fmt: skip
    fit = joint(
        start, prior, problem, blocks, max_steps=options.max_iterations, trace=options.trace
    )
    return solution(fit, prior, fit.settled)


def _attach(
    solution: Solution, problem: Problem, given: Given, plan: Plan
) -> tuple[Parameters, Array, AbstractPrior]:
    """The solution as a differentiable function of the problem (and of given numbers)."""
    reference, offset = solution.parameters, solution.offset
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


def _assemble(
    solution: Solution,
    parameters: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    uncertainty: Uncertainty,
    inspection: Inspection,
    law: OffsetLaw | None,
    problem: Problem,
    given: Given,
    plan: Plan,
) -> Calibration:
    matrix = parameters.matrix()
    residual = circle_residual(parameters, jnp.zeros_like(problem.mask), problem)
    used = jnp.sum(problem.mask)
    elevation = prior.elevation(parameters, offset, problem)
    status = _status(solution, matrix, uncertainty, parameters, problem, plan)
    usable = status != Status.UNOBSERVABLE
    covariance = jnp.where(usable, uncertainty.covariance, jnp.nan)
    point = block_slice(plan.blocks, "point")
    floored = solution.sigma_floored
    medium = _medium(parameters, covariance, problem, given, plan)
    return Calibration(
        image_to_probe=matrix,
        point=parameters.point,
        elevation=elevation,
        elevation_sd=uncertainty.elevation_sd,
        sigma=_three_sigmas(prior, parameters, elevation, uncertainty, problem),
        offset_law=law,
        channel_sigma=prior.sigma[0] if isinstance(prior, ChannelGaussian) else None,
        covariance=covariance[:6, :6],
        point_covariance=covariance[point, point],
        scale_mm_per_px=problem.spacing * parameters.scale if problem.pixels else None,
        **medium,
        residual=residual,
        rms=root_mean_square(residual, problem.mask),
        mask=problem.mask,
        at_bound=uncertainty.at_bound,
        status_code=status,
        iterations=solution.iterations,
        variance_rounds=solution.variance_rounds,
        cost=solution.cost,
        stationarity=solution.stationarity,
        condition=uncertainty.condition,
        weakest=uncertainty.weakest,
        weakest_sd=uncertainty.weakest_sd,
        prior_direction=uncertainty.prior_direction,
        searched_start=solution.searched_start,
        inspection=inspection,
        sigma_tuned=jnp.asarray(plan.self_tuning) & (used >= MINIMUM_SELF_TUNING),
        sigma_floored=floored[jnp.asarray([0, 0, 1])] if plan.channels else floored,
        tolerance_met=solution.arrived,
        differentiable=_differentiable(solution, uncertainty, prior, offset, problem, status),
        rotation_change=solution.rotation_change,
        translation_change=solution.translation_change,
        trace=solution.trace,
        method=plan.method,
        prior=plan.reported_prior,
        data="channels" if plan.channels else "points",
        blocks=plan.blocks,
        robust=plan.robust,
    )


def _medium(
    parameters: Parameters,
    covariance: Float[Array, "p p"],
    problem: Problem,
    given: Given,
    plan: Plan,
) -> dict[str, Array | None]:
    """Sound speed and delay in their units, with SDs; None where they were not estimated."""
    speed = nominal_sound_speed(problem)
    found: dict[str, Array | None] = dict.fromkeys(
        ("sound_speed_m_s", "sound_speed_sd_m_s", "sound_speed_prior_m_s",
         "delay_s", "delay_sd_s", "delay_prior_s")
    )  # fmt: skip
    if "sound-speed" in plan.blocks:
        at = block_slice(plan.blocks, "sound-speed").start
        estimate = speed * parameters.sound_speed
        found["sound_speed_m_s"] = estimate
        found["sound_speed_sd_m_s"] = estimate * jnp.sqrt(covariance[at, at])
        found["sound_speed_prior_m_s"] = None if given.medium_sd is None else given.medium_sd[0]
    if "delay" in plan.blocks:
        at = block_slice(plan.blocks, "delay").start
        before = 0.0 if problem.delay is None else problem.delay
        found["delay_s"] = before + parameters.delay / (1e3 * speed)
        found["delay_sd_s"] = jnp.sqrt(covariance[at, at]) / (1e3 * speed)
        found["delay_prior_s"] = None if given.medium_sd is None else given.medium_sd[1]
    return found


def _three_sigmas(
    prior: AbstractPrior,
    parameters: Parameters,
    elevation: Float[Array, " n"],
    uncertainty: Uncertainty,
    problem: Problem,
) -> Float[Array, 3]:
    """SDs of lateral position, range and offset, mm: the belief's own or those of the residuals."""
    if isinstance(prior, Gaussian):
        return prior.sigma
    if isinstance(prior, ChannelGaussian):
        point_sd = prior.sigma[0] * _point_sd(parameters, problem)
        return jnp.concatenate([point_sd, prior.sigma[1:]])
    used = jnp.sum(problem.mask)
    errors = measurement_residual(parameters, problem).at[:, 2].set(elevation)
    # The unknowns' degrees of freedom are shared equally by the three components.
    freedom = jnp.maximum(used - uncertainty.weakest.shape[0] / 3, 1.0)
    mean_square = jnp.sum(errors**2, axis=0) / freedom
    if isinstance(prior, Bounded):
        # Offsets within a bound have a root mean square within it, too.
        mean_square = mean_square.at[2].set(jnp.sum(elevation**2) / used)
    return jnp.sqrt(mean_square)


def _point_sd(parameters: Parameters, problem: Problem) -> Float[Array, 2]:
    """Root mean square SD of (lateral, axial) from an image's elements alone, per unit of theirs.

    The inverse of the 2x2 information of Eq. 5 (or 6) with the offset held.
    """
    channels = channels_of(problem)
    apart = target_in_image(parameters, problem)[:, None, :] - channels.elements
    distance = jnp.sqrt(jnp.sum(apart**2, axis=-1))
    weight = problem.mask[:, None] * channels.heard
    slope = weight[..., None] * apart[..., jnp.asarray([0, 2])] / distance[..., None]
    a, c = jnp.sum(slope[..., 0] ** 2, axis=1), jnp.sum(slope[..., 1] ** 2, axis=1)
    b = jnp.sum(slope[..., 0] * slope[..., 1], axis=1)
    determinant = a * c - b**2
    known = determinant > 0
    variance = jnp.stack([c, a], axis=1) / jnp.where(known, determinant, 1.0)[:, None]
    known = known[:, None] & (problem.mask[:, None] > 0)
    return jnp.sqrt(jnp.sum(jnp.where(known, variance, 0.0), axis=0) / jnp.sum(known, axis=0))


def _status(
    solution: Solution,
    matrix: Float[Array, "4 4"],
    uncertainty: Uncertainty,
    parameters: Parameters,
    problem: Problem,
    plan: Plan,
) -> Array:
    finite = jnp.all(jnp.isfinite(matrix)) & jnp.all(jnp.isfinite(parameters.point))
    finite = finite & jnp.isfinite(solution.cost) & jnp.all(jnp.isfinite(parameters.scale))
    failed = jnp.logical_not(finite) | (jnp.sum(problem.mask) < MINIMUM_IMAGES)
    unobservable = uncertainty.degenerate
    if plan.prior != "bounded":
        # Within bounds a direction that nothing determines is still confined to an interval: that
        # is a warning. Without bounds nothing confines it.
        lever = lever_arm(parameters, problem)
        unobservable = unobservable | (uncertainty.weakest_sd > LARGEST_SD * lever)
    status = jnp.where(solution.arrived, Status.CONVERGED, Status.MAX_ITERATIONS)
    status = jnp.where(unobservable, Status.UNOBSERVABLE, status)
    return jnp.where(failed, Status.FAILED, status).astype(jnp.int32)


def _differentiable(
    solution: Solution,
    uncertainty: Uncertainty,
    prior: AbstractPrior,
    offset: Float[Array, " k"],
    problem: Problem,
    status: Array,
) -> Bool[Array, ""]:
    """Whether the implicit function theorem's conditions hold at the solution."""
    still = 1e-6 if float(jnp.finfo(problem.mask.dtype).eps) < 1e-10 else 1e-3
    good = (status == Status.CONVERGED) & (solution.stationarity <= still)
    good = good & jnp.logical_not(jnp.any(solution.sigma_floored))
    if isinstance(prior, Bounded):
        # An offset about to reach its bound, or to leave it, makes the answer's kink.
        gap = jnp.abs(prior.limit(solution.parameters, problem) - jnp.abs(offset))
        closest = jnp.where((uncertainty.at_bound > 0) | (problem.mask == 0), jnp.inf, gap)
        good = good & (jnp.min(closest) > 1e-6) & (uncertainty.weakest_hold > 1e-6)
        good = good & jnp.logical_not(uncertainty.singular)
    return good
