"""What is to be said of a solution: offsets, sizes of errors, uncertainty, a second look, status.

For one problem, by any method; the reference of :mod:`jaxcal.fused_findings`, which finds the same
for batches of plain problems in a few passes over their images. Afterwards a calibration is only
put together (:func:`jaxcal.pipeline.assemble`).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.calibration import Status
from jaxcal.inspection import Inspection, inspect
from jaxcal.metrics import root_mean_square
from jaxcal.model.parameters import Parameters
from jaxcal.model.priors import (
    AbstractPrior,
    Bounded,
    ChannelGaussian,
    Gaussian,
    channels_of,
)
from jaxcal.model.residuals import circle_residual, measurement_residual, target_in_image
from jaxcal.options import Plan
from jaxcal.problem import Problem
from jaxcal.recording import MINIMUM_IMAGES
from jaxcal.solvers.auto import Averaged
from jaxcal.uncertainty import LARGEST_SD, Uncertainty, assess, lever_arm


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


class Findings(eqx.Module):
    """What was found at a solution, for one problem or (leading axis) for a batch.

    Attributes:
        elevation: the offsets, mm. sigma: SDs of lateral position, range and offset, mm. residual:
            q_i - p_i with p_i in the plane, mm. rms: of its length, mm.
        uncertainty, inspection: see there.
        status: a :class:`jaxcal.calibration.Status`. differentiable: whether the implicit function
            theorem's conditions hold.
    """

    elevation: Float[Array, "*batch n"]
    sigma: Float[Array, "*batch 3"]
    residual: Float[Array, "*batch n 3"]
    rms: Float[Array, "*batch"]
    uncertainty: Uncertainty
    inspection: Inspection
    status: Int[Array, "*batch"]
    differentiable: Bool[Array, "*batch"]


def find(
    solution: Solution,
    parameters: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    averaged: Averaged | None,
    problem: Problem,
    everything: Problem,
    plan: Plan,
) -> Findings:
    """Look at a solution.

    Args:
        solution: where the method stopped.
        parameters: the unknowns, as functions of the data.
        offset: likewise.
        prior: the objective, likewise.
        averaged: the average over the offsets' laws, where they were weighed.
        problem: the images in use.
        everything: with those that were left out because they do not agree.
        plan: what was asked for.
    """
    uncertainty = assess(
        parameters, offset, prior, problem, plan.blocks,
        whitened=plan.prior == "gaussian", uses_prior=plan.prior != "none",
    )  # fmt: skip
    if averaged is not None:
        uncertainty = of_the_laws(uncertainty, averaged)
    elevation = prior.elevation(parameters, offset, problem)
    sigma = _three_sigmas(prior, parameters, elevation, uncertainty, problem)
    inspection = inspect(
        parameters, offset, prior, problem, everything, plan.blocks, sigma=sigma,
        weakest=uncertainty.weakest, left_out=plan.robust,
    )  # fmt: skip
    residual = circle_residual(parameters, jnp.zeros_like(problem.mask), problem)
    lever, used = lever_arm(parameters, problem), jnp.sum(problem.mask)
    status = judge(solution, parameters, uncertainty, lever, used, plan)
    gap = None
    if isinstance(prior, Bounded):
        away = jnp.abs(prior.limit(solution.parameters, problem) - jnp.abs(offset))
        gap = jnp.min(jnp.where((uncertainty.at_bound > 0) | (problem.mask == 0), jnp.inf, away))
    return Findings(
        elevation=elevation, sigma=sigma, residual=residual,
        rms=root_mean_square(residual, problem.mask), uncertainty=uncertainty,
        inspection=inspection, status=status,
        differentiable=differentiable(solution, uncertainty, gap, status),
    )  # fmt: skip


def of_the_laws(uncertainty: Uncertainty, averaged: Averaged) -> Uncertainty:
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


def judge(
    solution: Solution,
    parameters: Parameters,
    uncertainty: Uncertainty,
    lever: Float[Array, ""],
    used: Float[Array, ""],
    plan: Plan,
) -> Int[Array, ""]:
    """The status of a solution, from its numbers alone.

    Args:
        solution: where the method stopped.
        parameters: the unknowns.
        uncertainty: theirs.
        lever: root mean square distance of the used points from the image origin, mm.
        used: number of used images.
        plan: what was asked for.
    """
    finite = jnp.all(jnp.isfinite(parameters.matrix())) & jnp.all(jnp.isfinite(parameters.point))
    finite = finite & jnp.isfinite(solution.cost) & jnp.all(jnp.isfinite(parameters.scale))
    failed = jnp.logical_not(finite) | (used < MINIMUM_IMAGES)
    unobservable = uncertainty.degenerate
    if plan.prior != "bounded":
        # Within bounds a direction that nothing determines is still confined to an interval: that
        # is a warning. Without bounds nothing confines it.
        unobservable = unobservable | (uncertainty.weakest_sd > LARGEST_SD * lever)
    status = jnp.where(solution.arrived, Status.CONVERGED, Status.MAX_ITERATIONS)
    status = jnp.where(unobservable, Status.UNOBSERVABLE, status)
    return jnp.where(failed, Status.FAILED, status).astype(jnp.int32)


def differentiable(
    solution: Solution,
    uncertainty: Uncertainty,
    gap: Float[Array, ""] | None,
    status: Int[Array, ""],
) -> Bool[Array, ""]:
    """Whether the implicit function theorem's conditions hold at the solution.

    Args:
        solution: where the method stopped.
        uncertainty: its uncertainty.
        gap: how far the nearest free offset is from its bound, mm; None where there are no bounds.
        status: of the solution.
    """
    still = 1e-6 if float(jnp.finfo(solution.cost.dtype).eps) < 1e-10 else 1e-3
    good = (status == Status.CONVERGED) & (solution.stationarity <= still)
    good = good & jnp.logical_not(jnp.any(solution.sigma_floored))
    if gap is not None:
        # An offset about to reach its bound, or to leave it, makes the answer's kink.
        good = good & (gap > 1e-6) & (uncertainty.weakest_hold > 1e-6)
        good = good & jnp.logical_not(uncertainty.singular)
    return good
