"""Every method on a batch of problems, as one pure function of arrays.

The steps are: the start in closed form, and the conventional fit from it where answers may depend
on the start; the method itself; derivatives by the implicit function theorem; and the average over
the offsets' laws where they are weighed. One problem is a batch of one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxcal.data.problem import Problem
from jaxcal.model.batch import ImagePlanes, Iterate
from jaxcal.model.observations import (
    BoundedOffsets,
    ChannelDistances,
    InPlane,
    MediumPrior,
    Observation,
    OwnCovariances,
    Points,
    TrackedPoints,
    unit_shape,
    variance_planes,
)
from jaxcal.model.thresholds import FALLBACK_SIGMA
from jaxcal.model.unknowns import TABLE, with_prior
from jaxcal.solvers import implicit
from jaxcal.solvers.alternating import Alternation, alternate, bounded
from jaxcal.solvers.auto import Averaged, average_over_laws
from jaxcal.solvers.convergence import Convergence
from jaxcal.solvers.gradient_descent import pairwise_gradient
from jaxcal.solvers.levenberg_marquardt import Minimum, minimise
from jaxcal.solvers.plan import DEFAULT_MAX_ELEVATION_MM, Given, SolvePlan
from jaxcal.solvers.reml import SelfTuned, on_floor, self_tuned
from jaxcal.solvers.start import ConventionalStart, conventional
from jaxcal.solvers.with_optimistix import Fit, minimise_with, self_tuned_with

FALLBACK_CHANNEL_SIGMA = (0.5, 1.0)
"""SDs of an element's distance and of the offset (mm), used in the case of ``FALLBACK_SIGMA``."""


class Solution(eqx.Module):
    """Where a method stopped; the batch axis is last, except in the convergence.

    Attributes:
        iterate: X, c and the further unknowns.
        observation: the objective, with its SDs.
        medium: prior of further unknowns, or None.
        convergence: how the method ended.
        averaged: the average over the offsets' laws, where they were weighed; ``iterate`` and
            the SDs of ``observation`` are then the average's.
    """

    iterate: Iterate
    observation: Observation
    medium: MediumPrior | None
    convergence: Convergence
    averaged: Averaged | None = None


def solve(
    problems: Problem,
    images: ImagePlanes,
    given: Given,
    plan: SolvePlan,
    begun: ConventionalStart | None = None,
) -> Solution:
    """Solve a batch (one leading axis); images left out must hold harmless values."""
    # The solvers see constants; their answers become functions of the data again afterwards.
    frozen, planes, numbers = jax.lax.stop_gradient((problems, images, given))
    begun = begin(planes, plan) if begun is None else begun
    found = run(begun, frozen, planes, numbers, plan)
    if plan.options.differentiate:
        found = _attached(found, images, problems, given, plan)
    if not plan.laws:
        return found
    return _averaged(found, images, problems, plan)


def begin(images: ImagePlanes, plan: SolvePlan) -> ConventionalStart:
    """The conventional fits from which every method starts."""
    alone = plan.method == "conventional"
    return conventional(
        replace(images, channels=None),
        plan.blocks,
        max_steps=plan.options.max_iterations,
        undamped=alone and plan.options.solver == "gauss-newton",
        trace=plan.options.trace if alone else 0,
        # Gaussian offsets converge from the closed form in as many passes; answers within bounds
        # may depend on the start.
        fitted=alone or plan.prior == "bounded",
    )


def observe(
    problems: Problem, images: ImagePlanes, given: Given, plan: SolvePlan
) -> tuple[Observation, MediumPrior | None]:
    """The plan's objective (if SDs are tuned: with the SDs to fall back on), and medium prior."""
    if plan.prior == "none":
        return InPlane.of(images), None
    if plan.prior == "bounded":
        bound = problems.max_elevation
        if bound is None:
            bound = jnp.full_like(images.mask, DEFAULT_MAX_ELEVATION_MM)
        return BoundedOffsets.of(bound, images), None
    fallback = FALLBACK_CHANNEL_SIGMA if plan.channels else FALLBACK_SIGMA
    dtype = images.mask.dtype
    sigma = jnp.asarray(fallback, dtype) if given.sigma is None else given.sigma
    sigma = jnp.broadcast_to(sigma[:, None], (len(fallback), images.batch_size))
    medium = None
    if given.prior_sd is not None:
        names = [TABLE[name].prior_name for name in with_prior(plan.blocks)]
        medium = MediumPrior.of(
            problems, plan.blocks, **dict(zip(names, given.prior_sd, strict=True))
        )
    if plan.channels:
        return ChannelDistances(sigma), medium
    shape = None
    # Where laws are weighed, the covariances are weighed as well; the first fit does without them.
    if problems.covariance is not None and not plan.laws:
        shape, _ = unit_shape(variance_planes(problems.covariance), images)
    if given.tracker_sd is not None:
        tracker = jnp.broadcast_to(given.tracker_sd, sigma.shape[1:])
        return TrackedPoints(sigma, tracker, shape), medium
    if shape is not None:
        return OwnCovariances(sigma, shape, sigma[1] / sigma[0]), medium
    return Points(sigma), medium


def run(
    begun: ConventionalStart, problems: Problem, images: ImagePlanes, given: Given, plan: SolvePlan
) -> Solution:
    """The plan's method from conventional fits."""
    observation, medium = observe(problems, images, given, plan)
    found = _descended(begun, observation, medium, images, plan)
    floored, rounds = jnp.zeros((images.batch_size, 3), bool), jnp.zeros_like(found.iterations)
    if plan.self_tuning:
        assert isinstance(found, SelfTuned | Fit)
        observation = observation.with_sigma(found.updated)
        floored = on_floor(found.updated).T[:, [*observation.error_sd]]
        # Every pass of the package's own solver updates the SDs.
        rounds = found.rounds if isinstance(found, Fit) else found.iterations
    moves = (jnp.zeros_like(found.cost),) * 2
    if isinstance(found, Alternation):
        moves = (found.rotation_change, found.translation_change)
    convergence = Convergence(
        cost=found.cost,
        stationarity=found.cosine,
        tolerance_met=found.converged,
        iterations=found.iterations,
        variance_rounds=rounds,
        searched_start=begun.searched,
        sigma_floored=floored,
        rotation_change=moves[0],
        translation_change=moves[1],
        trace=None if found.trace is None else found.trace.T,
    )
    return Solution(found.iterate, observation, medium, convergence)


def _descended(
    begun: ConventionalStart,
    observation: Observation,
    medium: MediumPrior | None,
    images: ImagePlanes,
    plan: SolvePlan,
) -> Minimum:
    """Where the plan's method stops."""
    options, other, start = plan.options, plan.other_solver, begun.iterate
    limits: dict[str, Any] = {"max_steps": options.max_iterations, "trace": options.trace}
    if plan.method == "conventional":
        if options.solver == "gradient":
            return pairwise_gradient(begun.start, images, options)
        if other is not None:
            return minimise_with(other, begun.start, observation, images, None, options)
        assert begun.fit is not None  # the closed form alone is no start of this method
        return begun.fit
    if isinstance(observation, BoundedOffsets):
        if plan.method != "alternating":
            return bounded(start, observation, images, **limits)
        return alternate(
            start,
            observation,
            images,
            tolerance_rad=options.tolerance_rad,
            tolerance_mm=options.tolerance_mm,
            max_rounds=options.max_rounds,
            inner_steps=options.inner_steps,
            trace=options.trace,
        )
    if other is not None:
        solve_with = self_tuned_with if plan.self_tuning else minimise_with
        return solve_with(other, start, observation, images, medium, options)
    if plan.self_tuning:
        return self_tuned(start, observation, images, medium=medium, **limits)
    return minimise(start, observation, images, medium=medium, damping=1e-6, **limits)


def _attached(
    found: Solution, images: ImagePlanes, problems: Problem, given: Given, plan: SolvePlan
) -> Solution:
    """The solution as a differentiable function of the problems (and of given numbers)."""
    observation, medium = observe(problems, images, given, plan)
    if plan.self_tuning:
        step, sigma = implicit.self_tuned_tangent(
            found.iterate, found.observation.sigma, observation, images, medium
        )
        observation = observation.with_sigma(sigma)
    elif plan.method == "alternating" and not (
        plan.options.tolerance_mm <= implicit.STILL_MM
        and plan.options.tolerance_rad <= implicit.STILL_RAD
    ):
        step = implicit.undefined_tangent(found.iterate, observation, images)
    else:
        step = implicit.implicit_tangent(found.iterate, observation, images, medium)
    iterate = found.iterate.moved(step)
    cost = implicit.minimum(found.convergence.cost, iterate, observation, images, medium)
    convergence = replace(found.convergence, cost=cost)
    return Solution(iterate, observation, medium, convergence)


def _averaged(found: Solution, images: ImagePlanes, problems: Problem, plan: SolvePlan) -> Solution:
    """The average over the laws that the plan has."""
    variances = None
    if problems.covariance is not None and not plan.channels:
        # In mm: the noise model of the images' own covariances compares lateral SDs with ranges'.
        size = problems.spacing * found.iterate.parameters().scale
        variances = variance_planes(
            problems.covariance * (size[:, None, :, None] * size[:, None, None])
        )
    over = average_over_laws(
        found.iterate,
        found.observation,
        images,
        plan.laws,
        variances=variances,
        bound=problems.max_elevation,
        medium=found.medium,
    )
    observation = found.observation.with_sigma(over.sigma)
    if variances is not None:
        shape, _ = unit_shape(variances, images)
        unit = jnp.asarray([1.0, 0.0, 1.0], shape.dtype)[:, None, None]
        shape = jnp.where(over.own_covariances[:, None], shape, unit)
        observation = OwnCovariances(over.sigma, shape, over.sigma[1] / over.sigma[0])
    return replace(found, iterate=over.iterate, observation=observation, averaged=over)
