"""Builds a :class:`jaxcal.Calibration` from a method's solution, in plain array operations.

Offsets, SDs, covariance and status are computed here, so they are available under jit, vmap and
grad. Everything else about an answer is computed when it is read (:mod:`jaxcal.diagnostics`), from
the problem and two p x p matrices:

- S, the *information* of the shared unknowns: the normal matrix of the whitened residuals with the
  offsets eliminated. Its inverse, times the residuals' variance where they are in mm, is the
  covariance (the Cramer-Rao bound, where no offset rests on its bound). The conventional method's
  has a variance for each axis (:func:`jaxcal.diagnostics.uncertainty.covariance_by_axis`).
- D, the *design*: the normal matrix of the unweighted residuals with the offsets known.

The status needs no spectrum. Rotations, scales and sound speed are multiplied by the lever arm L,
the root mean square distance of the points from the image origin, so that all unknowns are mm at
the target. The poses are degenerate if the smallest eigenvalue of D is below a threshold times its
trace. A direction is unknown if the smallest eigenvalue of S is below variance / (L / 2)^2. The
pivots of A - c 1 show whether the smallest eigenvalue of a matrix A exceeds a number c.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.data.problem import Problem
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.diagnostics.uncertainty import (
    LARGEST_SD,
    component_freedom,
    covariance_by_axis,
    mm_at_target,
    threshold,
    variances_by_axis,
)
from jaxcal.model.arc import OnArc
from jaxcal.model.batch import ImagePlanes, Iterate, barrier, targets
from jaxcal.model.observations import (
    BoundedOffsets,
    FurtherUnknowns,
    InPlane,
    LocalUnknown,
    local_unknowns,
)
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING, STATIONARY
from jaxcal.model.unknowns import Blocks, count_unknowns, split_further
from jaxcal.result.calibration import Calibration, Linearisation, Medium, Status
from jaxcal.solvers.auto import Averaged
from jaxcal.solvers.convergence import Convergence
from jaxcal.solvers.dense import inverse_batch_last
from jaxcal.solvers.methods import Solution
from jaxcal.solvers.normal_equations import ComponentSums, accumulate, component_sums, stacked
from jaxcal.solvers.plan import Given, SolvePlan

LEAST_GAP_MM = 1e-6
"""An offset is about to reach its bound if it is nearer to it than this."""

LEAST_HOLD = 1e-6
"""An offset is about to leave its bound if the force that holds it there is smaller than this, in
root mean square residuals."""


def assemble(
    found: Solution, problem: Problem, images: ImagePlanes, given: Given, plan: SolvePlan
) -> Calibration:
    """A calibration without its problem, which the caller adds.

    Args:
        found: where the method stopped. If the answer is to be differentiated, its arrays are
            functions of the data.
        problem: the images in use, with one leading axis.
        images: the same as planes.
        given: the numbers in the request, without leading axes.
        plan: what is static about the request.
    """
    problem = problem.cleared(problem.mask)
    observation = found.observation
    information, design, axes = barrier(_normal_matrices(found, images))
    # Without this barrier the compiler would repeat the end of the solve for every image.
    iterate, local, sigma, bound, convergence = barrier(
        (
            found.iterate,
            local_unknowns(found.iterate, observation, images)
            if isinstance(observation, LocalUnknown)
            else None,
            observation.sigma.T[:, [*observation.error_sd]] if observation.whitened else None,
            observation.bound if isinstance(observation, BoundedOffsets) else None,
            found.convergence,
        )
    )
    blocks, mask, parameters = plan.blocks, problem.mask, iterate.parameters()
    used = jnp.sum(mask, axis=-1)
    errors = Errors.of(iterate, images)
    in_plane = errors.squares(errors.q[1], errors.distance)
    elevation, bounds, tracker_sd = _offsets(errors, local, bound, given)

    variance = _residual_variance(used, in_plane, bounds, plan)
    lever = jax.lax.stop_gradient(errors.lever())
    inverse, information, observed = _inverse(
        information, design, axes, variance=variance, lever=lever, used=used, plan=plan
    )
    status, averaged = _status(iterate, convergence, observed, used), found.averaged
    covariance = _covariance(jnp.moveaxis(variance * inverse, -1, 0), averaged, status)
    prior_sd = None
    if given.prior_sd is not None:
        prior_sd = jnp.broadcast_to(given.prior_sd, (*used.shape, *given.prior_sd.shape))
    return Calibration(
        image_to_probe=parameters.matrix(),
        point=parameters.point,
        elevation=elevation,
        sigma=_error_sds(sigma, errors, elevation, problem, plan),
        offset_law=None if averaged is None else averaged.law,
        channel_sigma=None if sigma is None or not plan.channels else sigma[..., 0],
        unknowns_covariance=covariance,
        scale_mm_per_px=problem.spacing * parameters.scale if problem.pixels else None,
        medium=Medium.of(
            split_further(iterate.further_values.T, blocks), covariance, blocks, problem, prior_sd
        ),
        rms=jnp.sqrt(in_plane / used),
        mask=mask,
        status_code=status,
        differentiable=_is_differentiable(convergence, bounds, observed, status, plan),
        sigma_tuned=jnp.asarray(plan.self_tuning) & (used >= MINIMUM_SELF_TUNING),
        convergence=convergence,
        linearisation=Linearisation(
            information=jnp.moveaxis(information, -1, 0),
            design=jnp.moveaxis(design, -1, 0),
            variance=variance,
            tracker_sd=tracker_sd,
            average_elevation_sd=None if averaged is None else averaged.elevation_sd,
            further=iterate.further_values.T if len(iterate.further_values) else None,
            prior_sd=None if found.medium is None else found.medium.sd.T,
        ),
        problem=None,
        method=plan.method,
        prior=plan.reported_prior,
        data="channels" if plan.channels else "points",
        blocks=blocks,
        robust=plan.robust,
    )


def _normal_matrices(
    found: Solution, images: ImagePlanes
) -> tuple[Float[Array, "p p batch"], Float[Array, "p p batch"], ComponentSums | None]:
    """S and D at a solution, and the parts of the axes of a fit with equal weights to all three."""
    observation, iterate = found.observation, found.iterate
    geometry = observation.geometry(images, iterate.blocks)
    if isinstance(observation, InPlane):
        sums = component_sums(iterate, observation.by_axis(), images, None)
        design = stacked(jnp.sum(sums.matrix, axis=0))
        return design, design, sums
    if geometry is observation and observation.whitened:
        sums = component_sums(iterate, observation, images, None, found.medium)
        weighted = sums.weighted(1 / observation.sigma**2).stacked()
        return weighted, stacked(jnp.sum(sums.matrix, 0)), None
    weighted = accumulate(iterate, observation, images, None, found.medium).stacked()
    if geometry is observation:
        return weighted, weighted, None
    return weighted, accumulate(iterate, geometry, images, None).stacked(), None


def _offsets(
    errors: Errors, local: Array | None, bound: Array | None, given: Given
) -> tuple[Float[Array, "*batch n"], ActiveBounds | None, Float[Array, "*batch"] | None]:
    """The offsets, mm; the state of their bounds and the SD of tracked positions, if they have any.

    Args:
        errors: at the solution.
        local: every image's own unknown: its offset where there are bounds, else the tracker's
            elevational error in SDs; None without one.
        bound: largest offsets, mm, or None.
        given: the numbers in the request.
    """
    mask = errors.mask
    if local is not None and bound is not None:
        return mask * local, ActiveBounds.of(errors, local, bound), None
    if local is not None and given.tracker_sd is not None:
        tracker_sd = jnp.broadcast_to(given.tracker_sd, mask.shape[:-1])
        return mask * (errors.q[1] + given.tracker_sd * local), None, tracker_sd
    return mask * errors.q[1], None, None


def _inverse(
    information: Float[Array, "p p batch"],
    design: Float[Array, "p p batch"],
    axes: ComponentSums | None,
    *,
    variance: Float[Array, " batch"],
    lever: Float[Array, " batch"],
    used: Float[Array, " batch"],
    plan: SolvePlan,
) -> tuple[Float[Array, "p p batch"], Float[Array, "p p batch"], Observability]:
    """The covariance for residuals of variance 1, its inverse, and what is observable.

    Args:
        information: S.
        design: D.
        axes: the parts of the axes, where each has a variance of its own.
        variance: of the residuals.
        lever: root mean square distance of the points from the image origin, mm.
        used: number of images in use.
        plan: of the solve.
    """
    inverse, observed = inverse_and_observability(
        information,
        design,
        variance,
        mm_at_target(lever, plan.blocks).T,
        LARGEST_SD * lever,
        bounded=plan.prior == "bounded",
    )
    if axes is not None:
        parts = jax.vmap(stacked)(axes.matrix)
        variances = variances_by_axis(parts, axes.squares, used, inverse, lever)
        inverse = covariance_by_axis(parts, variances, inverse)
        observable = jnp.logical_not(observed.degenerate | observed.weak)
        information = jnp.where(observable, inverse_batch_last(inverse)[0], information)
    return inverse, information, observed


def _residual_variance(
    used: Float[Array, "*batch"],
    in_plane: Float[Array, "*batch"],
    bounds: ActiveBounds | None,
    plan: SolvePlan,
) -> Float[Array, "*batch"]:
    """Variance of the residuals of fits in mm, mm^2; 1 for residuals in SDs.

    ``in_plane`` is the sum of squared errors from targets in the image plane, mm^2, over the
    ``used`` images.
    """
    known = count_unknowns(plan.blocks)
    if bounds is not None:
        free = used - jnp.sum(bounds.resting, axis=-1)
        return bounds.cost / jnp.maximum(3 * used - known - free, 1.0)
    if plan.prior == "none":
        return in_plane / jnp.maximum(3 * used - known, 1.0)
    return jnp.ones_like(used)


def _covariance(
    plain: Float[Array, "*batch p p"], averaged: Averaged | None, status: Int[Array, "*batch"]
) -> Float[Array, "*batch p p"]:
    """The covariance to report: the average's if laws were weighed, NaN where nothing is known."""
    covariance = plain
    if averaged is not None:
        # What the Gaussian solution cannot determine at all stays unknown.
        better = averaged.law.weighed[..., None, None] & jnp.isfinite(covariance)
        covariance = jnp.where(better, jnp.moveaxis(averaged.covariance, -1, 0), covariance)
    # A finite covariance would be false where the poses do not determine the unknowns, or without
    # a solve.
    known = (status != Status.UNOBSERVABLE) & (status != Status.FAILED)
    return jnp.where(known[..., None, None], covariance, jnp.nan)


class Errors(eqx.Module):
    """The target in every image, and what was measured; arrays are (batch, n).

    Attributes:
        q: lateral, elevational and axial coordinate of the target, mm; (0, 0, 1) where left out.
        lateral: measured, mm.
        distance: measured range, mm.
        mask: 1 for used images.
    """

    q: tuple[Array, Array, Array]
    lateral: Array
    distance: Array
    mask: Array

    @classmethod
    def of(cls, iterate: Iterate, images: ImagePlanes) -> Errors:
        """The errors at given unknowns."""
        q, _ = targets(iterate, images)
        lateral, distance = FurtherUnknowns.at(iterate).points(images)
        # The range has no derivative at 0, and an image left out may put the target there.
        x, y, z = (
            jnp.where(images.mask > 0, value, unused)
            for value, unused in zip(q, (0, 0, 1), strict=True)
        )
        return cls((x, y, z), lateral, distance, images.mask)

    def squares(self, elevational: Array, axial: Array) -> Float[Array, "*batch"]:
        """Sum over the images of |q - (lateral, y, axial)|^2 with q_y - y ``elevational``."""
        parts = (self.q[0] - self.lateral, elevational, self.q[2] - axial)
        return jnp.sum(self.mask * sum(part**2 for part in parts), axis=-1)

    def lever(self) -> Float[Array, "*batch"]:
        """Root mean square distance of the measured points from the image origin, mm."""
        squares = self.mask * (self.lateral**2 + self.distance**2)
        return jnp.sqrt(jnp.sum(squares, axis=-1) / jnp.sum(self.mask, axis=-1))


class ActiveBounds(eqx.Module):
    """The state of bounded offsets at a solution.

    Attributes:
        resting: 1 where an offset rests on its bound.
        cost: sum of squared residuals q - p(y), mm^2.
        gap: distance of the nearest free offset from its bound, mm.
        hold: least force that holds an offset on its bound, in root mean square residuals; infinite
            where none is held.
    """

    resting: Float[Array, "*batch n"]
    cost: Float[Array, "*batch"]
    gap: Float[Array, "*batch"]
    hold: Float[Array, "*batch"]

    @classmethod
    def of(cls, errors: Errors, y: Float[Array, "*batch n"], bound: Array) -> ActiveBounds:
        """The state at offsets y."""
        mask = errors.mask
        arc = OnArc.at(y, errors.q[1:], errors.distance, bound)
        cost = errors.squares(errors.q[1] - y, arc.axial)
        resting = mask * arc.resting
        size = jnp.sqrt(1 + arc.slope**2)
        typical = jnp.sqrt(cost / (3 * jnp.sum(mask, axis=-1)))
        typical = typical + jnp.finfo(typical.dtype).tiny
        hold = jnp.where(resting > 0, jnp.abs(arc.force) / size / typical[..., None], jnp.inf)
        gap = jnp.where((resting > 0) | (mask == 0), jnp.inf, jnp.abs(arc.limit - jnp.abs(y)))
        return cls(resting, cost, jnp.min(gap, axis=-1), jnp.min(hold, axis=-1))


class Observability(eqx.Module):
    """What the pivots of two matrices show about the unknowns.

    Attributes:
        degenerate: the poses do not determine the unknowns.
        weak: the SD of some direction is too large to be useful.
        singular: degenerate, or the information with the active bounds is singular.
    """

    degenerate: Bool[Array, " batch"]
    weak: Bool[Array, " batch"]
    singular: Bool[Array, " batch"]


def inverse_and_observability(
    information: Float[Array, "p p batch"],
    design: Float[Array, "p p batch"],
    variance: Float[Array, " batch"],
    scale: Float[Array, "p batch"],
    largest_sd: Float[Array, " batch"],
    *,
    bounded: bool = False,
) -> tuple[Float[Array, "p p batch"], Observability]:
    """S^-1 (NaN where there is none) and observability, by one elimination; batch axis last.

    Args:
        information: of the unknowns, offsets eliminated.
        design: of the unweighted residuals, offsets known.
        variance: of the residuals from which ``information`` was formed.
        scale: factors that turn every unknown's tangent into mm at the target.
        largest_sd: largest useful SD of a direction, mm.
        bounded: bounds confine the offsets, and with them every direction, so all that matters
            about the information is whether it is singular.
    """
    count, eps = variance.shape[0], float(jnp.finfo(scale.dtype).eps)
    eye = jnp.eye(len(scale), dtype=scale.dtype)[..., None]
    both = scale[:, None] * scale
    weighted, unweighted = jax.lax.stop_gradient((information / both, design / both))
    total = jnp.trace(weighted)
    least = threshold(eps) * total if bounded else jax.lax.stop_gradient(variance / largest_sd**2)
    floor = threshold(eps) * jnp.trace(unweighted)
    # A ridge at the level of rounding keeps an unobservable direction finite.
    ridge = jax.lax.stop_gradient(16 * eps * (design if bounded else information) * eye)
    # A pivot that is not positive makes the logarithm of the determinant not finite.
    matrices = [information + ridge, unweighted - floor * eye]
    inverse, log_determinant = inverse_batch_last(jnp.concatenate(matrices, axis=-1))
    inverse = inverse[..., :count]
    positive, observable = jnp.isfinite(log_determinant).reshape(2, count)

    def exceeding() -> Bool[Array, " batch"]:
        return jnp.isfinite(inverse_batch_last(weighted - least * eye)[1])

    # No eigenvalue of an inverse exceeds its trace; this test nearly always suffices.
    largest = jnp.sum(jnp.diagonal(inverse).T * scale**2, axis=0)
    clearly = jax.lax.stop_gradient(2 * least * largest < 1) & (largest > 0) & (not bounded)
    exceeds = jax.lax.cond(jnp.all(clearly), lambda: clearly, exceeding)

    degenerate = jnp.logical_not(observable)
    # With nearly exact data the limit is below rounding, and then no direction counts as weak.
    below = jnp.logical_not(exceeds) & (bounded | (eps * total < least))
    # SDs so different that the matrix is singular to rounding determine nothing either: a pivot is
    # not positive, or the smallest eigenvalue is less than the rounding of the largest.
    below = below | jnp.logical_not(positive) | (largest * eps * total > 1)
    found = Observability(
        degenerate=degenerate, weak=below & (not bounded), singular=degenerate | (below & bounded)
    )
    return jnp.where(found.singular, jnp.nan, inverse), found


def _status(
    iterate: Iterate,
    convergence: Convergence,
    observed: Observability,
    used: Float[Array, "*batch"],
) -> Int[Array, "*batch"]:
    finite = jnp.isfinite(convergence.cost)
    for leaf in jax.tree.leaves(iterate):
        finite = finite & jnp.all(jnp.isfinite(leaf), axis=tuple(range(leaf.ndim - 1)))
    failed = jnp.logical_not(finite) | (used < MINIMUM_IMAGES)
    status = jnp.where(convergence.tolerance_met, Status.CONVERGED, Status.MAX_ITERATIONS)
    status = jnp.where(observed.degenerate | observed.weak, Status.UNOBSERVABLE, status)
    return jnp.where(failed, Status.FAILED, status).astype(jnp.int32)


def _is_differentiable(
    convergence: Convergence,
    bounds: ActiveBounds | None,
    observed: Observability,
    status: Int[Array, "*batch"],
    plan: SolvePlan,
) -> Bool[Array, "*batch"]:
    """Whether the implicit function theorem's conditions hold at the solution."""
    still = STATIONARY if float(jnp.finfo(convergence.cost.dtype).eps) < 1e-10 else 1e-3
    good = (status == Status.CONVERGED) & (convergence.stationarity <= still)
    good = good & jnp.logical_not(jnp.any(convergence.sigma_floored, axis=-1))
    if bounds is not None:
        # The answer has a kink where an offset reaches its bound or leaves it.
        good = good & (bounds.gap > LEAST_GAP_MM) & (bounds.hold > LEAST_HOLD)
        good = good & jnp.logical_not(observed.singular)
    return good & plan.options.differentiate


def _error_sds(
    sigma: Float[Array, "*batch components"] | None,
    errors: Errors,
    elevation: Float[Array, "*batch n"],
    problem: Problem,
    plan: SolvePlan,
) -> Float[Array, "*batch 3"]:
    """SDs of lateral position, range and offset, mm, from those of the solve if it had any."""
    if sigma is None:
        bounded = plan.prior == "bounded"
        return _residual_sds(errors, elevation, plan.blocks, bounded=bounded)
    if plan.channels:
        point_sd = sigma[..., :2] * _point_sd(errors, problem)
        return jnp.concatenate([point_sd, sigma[..., 2:]], axis=-1)
    return sigma


def _residual_sds(
    errors: Errors, elevation: Float[Array, "*batch n"], blocks: Blocks, *, bounded: bool
) -> Float[Array, "*batch 3"]:
    """SDs of lateral position, range and offset, mm, from the residuals of a fit in mm."""
    used = jnp.sum(errors.mask, axis=-1)
    freedom = component_freedom(used, blocks)
    distance = jnp.sqrt(errors.q[1] ** 2 + errors.q[2] ** 2)
    lateral, axial = (
        jnp.sum(errors.mask * error**2, axis=-1) / freedom
        for error in (errors.q[0] - errors.lateral, distance - errors.distance)
    )
    # Offsets within a bound have a root mean square within it, too.
    own = used if bounded else freedom
    return jnp.sqrt(jnp.stack([lateral, axial, jnp.sum(elevation**2, axis=-1) / own], axis=-1))


def _point_sd(errors: Errors, problem: Problem) -> Float[Array, "*batch 2"]:
    """SD of (lateral, axial) from an image's elements alone, for elements with an SD of 1.

    It is the root mean square over the images; each image's variance is from the inverse of the 2x2
    information of Eq. 5 (or 6) with the offset held.
    """
    assert problem.channels is not None
    channels, mask = problem.channels, problem.mask
    target = jnp.stack(errors.q, axis=-1)[..., :, None, :]
    apart = target - channels.elements[..., None, :, :]
    distance = jnp.sqrt(jnp.sum(apart**2, axis=-1))
    weight = mask[..., None] * channels.heard
    lateral, axial = apart[..., 0] / distance, apart[..., 2] / distance
    a, b, c = (
        jnp.sum(weight * product, axis=-1) for product in (lateral**2, lateral * axial, axial**2)
    )
    # Weights are 0 or 1, so they equal their squares.
    determinant = a * c - b**2
    known = determinant > 0
    variance = jnp.stack([c, a], axis=-1) / jnp.where(known, determinant, 1.0)[..., None]
    known = (known & (mask > 0))[..., None]
    return jnp.sqrt(jnp.sum(jnp.where(known, variance, 0.0), axis=-2) / jnp.sum(known, axis=-2))
