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
from jaxtyping import Array, Bool, Float, Int

from jaxcal.data.problem import Problem
from jaxcal.data.sound import WATER_M_S
from jaxcal.model.batch import ImagePlanes, Iterate
from jaxcal.model.distributions import OffsetLaw
from jaxcal.model.observations import (
    BoundedOffsets,
    ChannelDistances,
    InPlane,
    MediumPrior,
    Observation,
    OwnCovariances,
    Points,
    TrackedPoints,
    local_unknowns,
    unit_shape,
    variance_planes,
)
from jaxcal.model.unknowns import MEDIUM
from jaxcal.solvers import implicit
from jaxcal.solvers.alternating import alternate, bounded
from jaxcal.solvers.auto import average_over_laws
from jaxcal.solvers.gradient_descent import pairwise_gradient
from jaxcal.solvers.levenberg_marquardt import minimise
from jaxcal.solvers.other import minimise_with, self_tuned_with
from jaxcal.solvers.plan import DEFAULT_MAX_ELEVATION_MM, Given, Options, SolvePlan
from jaxcal.solvers.reml import floored, self_tuned
from jaxcal.solvers.start import ConventionalStart, GivenStart, conventional

HELD_SIGMA = (0.5, 0.5, 1.0)
"""SDs of lateral position, range and offset (mm), used where too few images determine them."""

HELD_CHANNEL_SIGMA = (0.5, 1.0)
"""SDs of an element's distance and of the offset (mm), used in the same case."""


class Solution(eqx.Module):
    """Where a method stopped; lanes last, except in the law.

    Attributes:
        place: X, c and the further unknowns.
        observation: the objective there, with its SDs.
        medium: what was known of sound speed and delay beforehand, or None.
        offset: y_i, mm, where offsets are bounded unknowns of their own; else None.
        cost: sum of squared (whitened) residuals.
        cosine: gradient cosine.
        arrived: it stopped because it had converged.
        iterations: passes over the images, or rounds of the alternation.
        variance_rounds: of these, passes that updated SDs.
        sigma_floored: which SDs rest on their floor.
        rotation_change: of the alternation's last round, rad.
        translation_change: of the alternation's last round, mm.
        trace: the objective's values; None: not kept.
        searched: whether the start had to be searched for.
        covariance: of the unknowns over all laws of the offsets, where they were weighed.
        elevation_sd: SDs of the offsets over all laws, mm, where they were weighed.
        law: what was found out about the offsets' law, where laws were weighed.
    """

    place: Iterate
    observation: Observation
    medium: MediumPrior | None
    offset: Float[Array, "lanes n"] | None
    cost: Float[Array, " lanes"]
    cosine: Float[Array, " lanes"]
    arrived: Bool[Array, " lanes"]
    iterations: Int[Array, " lanes"]
    variance_rounds: Int[Array, " lanes"]
    sigma_floored: Bool[Array, "components lanes"]
    rotation_change: Float[Array, " lanes"]
    translation_change: Float[Array, " lanes"]
    trace: Float[Array, "trace lanes"] | None
    searched: Bool[Array, " lanes"]
    covariance: Float[Array, "p p lanes"] | None = None
    elevation_sd: Float[Array, "lanes n"] | None = None
    law: OffsetLaw | None = None


def solve(
    problems: Problem,
    images: ImagePlanes,
    given: Given,
    plan: SolvePlan,
    begun: ConventionalStart | GivenStart | None = None,
) -> Solution:
    """Solve a batch (one leading axis); images left out must hold harmless values.

    Args:
        problems: the batch.
        images: its planes.
        given: numbers that came with the request.
        plan: the static part of the request.
        begun: the batch's conventional fits, where they have been made before.
    """
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
    held = HELD_CHANNEL_SIGMA if plan.channels else HELD_SIGMA
    dtype = images.mask.dtype
    sigma = jnp.asarray(held, dtype) if given.sigma is None else given.sigma
    sigma = jnp.broadcast_to(sigma[:, None], (len(held), images.lanes))
    medium = None
    if given.medium_sd is not None and any(name in plan.blocks for name in MEDIUM):
        speed = nominal_sound_speed(problems)
        # A delay in s is a distance in mm at the nominal speed.
        sd = jnp.stack([given.medium_sd[0] / speed, given.medium_sd[1] * speed * 1e3])
        medium = MediumPrior(sd, plan.blocks)
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


def nominal_sound_speed(problem: Problem) -> Float[Array, "*batch"]:
    """The speed by which times of flight became distances, m/s; water's where unknown."""
    if problem.sound_speed is None:
        return jnp.full(problem.batch_shape, WATER_M_S, problem.mask.dtype)
    return problem.sound_speed


def run(
    begun: ConventionalStart | GivenStart,
    problems: Problem,
    images: ImagePlanes,
    given: Given,
    plan: SolvePlan,
) -> Solution:
    """The plan's method from conventional fits."""
    observation, medium = observe(problems, images, given, plan)
    start = begun.place
    if plan.method == "conventional":
        assert isinstance(begun, ConventionalStart)
        found, own = _conventional(begun, observation, images, plan)
    elif isinstance(observation, BoundedOffsets):
        solved = _alternating if plan.method == "alternating" else _bounded
        found, own = solved(start, observation, images, plan)
    elif plan.self_tuning:
        found, own = _self_tuned(start, observation, images, medium, plan)
    else:
        found, own = _with_given_sds(start, observation, images, medium, plan)
    zero = jnp.zeros_like(images.mask[:, 0])
    common = {
        "place": found.place,
        "observation": observation,
        "medium": medium,
        "offset": None,
        "cost": found.cost,
        "cosine": found.cosine,
        "iterations": found.iterations,
        "variance_rounds": jnp.zeros(zero.shape, jnp.int32),
        "sigma_floored": jnp.zeros((observation.sigma.shape[0], *zero.shape), bool),
        "rotation_change": zero,
        "translation_change": zero,
        "trace": getattr(found, "trace", None),
        "searched": begun.searched,
    }
    return Solution(**(common | own))


# Each of the following returns where a method stopped, and the fields of the solution that only it
# can fill.


def _conventional(
    begun: ConventionalStart, observation: Observation, images: ImagePlanes, plan: SolvePlan
) -> tuple[Any, dict[str, Any]]:
    fit = begun.fit
    if plan.options.solver == "gradient":
        fit = pairwise_gradient(begun.start, images, plan.options)
    if plan.other_solver is not None:
        fit = minimise_with(plan.other_solver, begun.start, observation, images, None, plan.options)
    return fit, {"arrived": fit.settled}


def _alternating(
    start: Iterate, observation: BoundedOffsets, images: ImagePlanes, plan: SolvePlan
) -> tuple[Any, dict[str, Any]]:
    done = alternate(
        start,
        observation,
        images,
        tolerance_rad=plan.options.tolerance_rad,
        tolerance_mm=plan.options.tolerance_mm,
        max_rounds=plan.options.max_rounds,
        inner_steps=plan.options.inner_steps,
        trace=plan.options.trace,
    )
    return done, {
        "arrived": done.tolerance_met,
        "offset": done.offset,
        "rotation_change": done.rotation_change,
        "translation_change": done.translation_change,
    }


def _bounded(
    start: Iterate, observation: BoundedOffsets, images: ImagePlanes, plan: SolvePlan
) -> tuple[Any, dict[str, Any]]:
    limits = {"max_steps": plan.options.max_iterations, "trace": plan.options.trace}
    fit = bounded(start, observation, images, **limits)
    offset = local_unknowns(fit.place, observation, images)
    return fit, {"arrived": fit.settled, "offset": offset}


def _with_given_sds(
    start: Iterate,
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None,
    plan: SolvePlan,
) -> tuple[Any, dict[str, Any]]:
    other, options = plan.other_solver, plan.options
    if other is not None:
        fit = minimise_with(other, start, observation, images, medium, options)
    else:
        fit = minimise(
            start,
            observation,
            images,
            medium=medium,
            damping=1e-6,
            max_steps=options.max_iterations,
            trace=options.trace,
        )
    return fit, {"arrived": fit.settled}


def _self_tuned(
    start: Iterate,
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None,
    plan: SolvePlan,
) -> tuple[Any, dict[str, Any]]:
    other, options = plan.other_solver, plan.options
    if other is not None:
        tuned = self_tuned_with(other, start, observation, images, medium, options)
    else:
        tuned = self_tuned(
            start,
            observation,
            images,
            medium=medium,
            max_rounds=options.max_iterations,
            trace=options.trace,
        )
    return tuned, {
        "arrived": tuned.settled,
        "observation": observation.with_sigma(tuned.updated),
        "sigma_floored": floored(tuned.updated),
        "variance_rounds": tuned.iterations,
    }


def _attached(
    found: Solution, images: ImagePlanes, problems: Problem, given: Given, plan: SolvePlan
) -> Solution:
    """The solution as a differentiable function of the problems (and of given numbers)."""
    observation, medium = observe(problems, images, given, plan)
    if plan.self_tuning:
        step, sigma = implicit.self_tuned_optimum(
            found.place, found.observation.sigma, observation, images, medium
        )
        observation = observation.with_sigma(sigma)
    elif plan.method == "alternating" and not _ends_still(plan.options):
        step = implicit.stopped_short(found.place, observation, images)
    else:
        step = implicit.optimum(found.place, observation, images, medium)
    place = found.place.moved(step)
    offset = found.offset
    if isinstance(observation, BoundedOffsets):
        offset = local_unknowns(place, observation, images)
    return replace(found, place=place, observation=observation, medium=medium, offset=offset)


def _ends_still(options: Options) -> bool:
    near = options.tolerance_mm <= implicit.STILL_MM
    return near and options.tolerance_rad <= implicit.STILL_RAD


def _averaged(found: Solution, images: ImagePlanes, problems: Problem, plan: SolvePlan) -> Solution:
    """The average over the laws that the plan has."""
    variances = None
    if problems.covariance is not None and not plan.channels:
        # In mm: the noise model of the images' own covariances compares lateral SDs with ranges'.
        size = problems.spacing * found.place.parameters().scale
        variances = variance_planes(
            problems.covariance * (size[:, None, :, None] * size[:, None, None])
        )
    over = average_over_laws(
        found.place,
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
    return replace(
        found,
        place=over.place,
        observation=observation,
        covariance=over.covariance,
        elevation_sd=over.elevation_sd,
        law=over.law,
    )
