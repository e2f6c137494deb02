"""How certain an answer is, and which directions the data do not see.

The Schur complement S of the whitened arrow (:mod:`jaxcal.solvers.arrow`) is the marginal
information of the shared unknowns: S^-1 is their covariance (the Cramer-Rao bound, where no bound
on an offset is active), and eigenvectors of S with small eigenvalues are directions that the images
barely determine. To compare mm with rad and log units, rotations and scales are multiplied by the
lever arm, the root mean square distance of the measured points from the image origin: all are then
mm at the target.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal.model.parameters import BLOCK_SIZE, RIGID, Blocks, Parameters, retract, size
from jaxcal.model.priors import AbstractPrior, ChannelGaussian, InPlane, channels_of
from jaxcal.model.residuals import channel_residual, measured_points, measurement_residual
from jaxcal.problem import Problem
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers import dense
from jaxcal.solvers.fused import Guess, Held, Images, accumulate
from jaxcal.solvers.least_squares import linearise

SINGULAR = 1e-11
"""Eigenvalue ratio of the unweighted design below which the poses are called degenerate."""

LARGEST_SD = 0.5
"""A direction whose SD exceeds this fraction of the lever arm is not known in any useful sense."""


class Uncertainty(eqx.Module):
    """Covariances and observability at a solution (of a batch: with leading axes).

    Attributes:
        covariance: (p, p) of the shared unknowns' tangent; NaN where singular.
        elevation_sd: (n,) mm; NaN where an offset rests on its bound or an image is left out.
        condition: largest over smallest eigenvalue of the scaled information.
        weakest: (p,) unit vector of the smallest, in scaled units.
        weakest_sd: SD along it, mm; NaN where singular.
        prior_direction: (p,) direction that the measurements alone leave undetermined.
        degenerate: whether the poses do not determine the unknowns.
        singular: whether the information (with the bounds that are active) is singular.
        at_bound: (n,) 1 where an offset rests on its bound.
        weakest_hold: least force with which a bound holds an offset, in root mean square residuals;
            inf where no bound is active.
    """

    covariance: Float[Array, "*batch p p"]
    elevation_sd: Float[Array, "*batch n"]
    condition: Float[Array, "*batch"]
    weakest: Float[Array, "*batch p"]
    weakest_sd: Float[Array, "*batch"]
    prior_direction: Float[Array, "*batch p"]
    degenerate: Bool[Array, "*batch"]
    singular: Bool[Array, "*batch"]
    at_bound: Float[Array, "*batch n"]
    weakest_hold: Float[Array, "*batch"]


def assess(
    parameters: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    problem: Problem,
    blocks: Blocks,
    *,
    whitened: bool,
    uses_prior: bool,
) -> Uncertainty:
    """Covariance and observability at a solution.

    Args:
        parameters: the solution.
        offset: its offset unknowns.
        prior: the objective's residuals.
        problem: the data.
        blocks: the free unknowns.
        whitened: residuals are in SDs; otherwise in mm and their variance is estimated.
        uses_prior: offsets are unknown and only the prior ties them to the plane.
    """
    arrow, _, _ = linearise(parameters, offset, prior, problem, blocks)
    information, _ = arrows.schur(arrow)
    used = jnp.sum(problem.mask)
    offsets = offset.shape[0] > 0
    resting = problem.mask * (1 - arrow.free) if offsets else jnp.zeros_like(problem.mask)
    variance = jnp.ones((), problem.mask.dtype)
    if not whitened:
        free = jnp.sum(problem.mask) - jnp.sum(resting) if offsets else 0.0
        variance = arrow.cost / jnp.maximum(3 * used - size(blocks) - free, 1.0)

    hold = jnp.asarray(jnp.inf, problem.mask.dtype)
    if offsets:
        force = jnp.abs(arrow.offset_gradient) / jnp.sqrt(arrow.diagonal)
        typical = jnp.sqrt(arrow.cost / (3 * used)) + jnp.finfo(force.dtype).tiny
        hold = jnp.min(jnp.where(resting > 0, force / typical, jnp.inf))

    scale = unit_scale(parameters, problem, blocks)
    values, vectors = _spectrum(information, scale)
    floor = jnp.finfo(values.dtype).eps * values[-1]
    smallest = jnp.maximum(values[0], floor)
    threshold = jnp.maximum(SINGULAR, 100 * jnp.finfo(values.dtype).eps)
    singular = values[0] < threshold * values[-1]

    channels = isinstance(prior, ChannelGaussian)
    design = _design(*jax.lax.stop_gradient((parameters, problem)), blocks, channels=channels)
    design_values, design_vectors = _spectrum(design, scale)
    degenerate = design_values[0] < threshold * design_values[-1]

    weakest_sd = jnp.sqrt(variance / smallest)
    unseen = one_of_many(design_vectors, design_values < threshold * design_values[-1])
    weakest = jnp.where(degenerate, unseen, vectors[:, 0])
    inverse = arrows.inverse_symmetric(information, jnp.diagonal(arrow.shared))
    unknown = degenerate | (singular & jnp.logical_not(whitened))
    covariance = jnp.where(unknown, jnp.nan, variance * 0.5 * (inverse + inverse.T))
    return Uncertainty(
        covariance=covariance,
        elevation_sd=_elevation_sd(
            parameters, offset, prior, problem, blocks, arrow, covariance, variance
        ),
        condition=values[-1] / smallest,
        weakest=weakest,
        weakest_sd=jnp.where(unknown, jnp.nan, weakest_sd),
        prior_direction=_unseen(parameters, problem, blocks, scale, threshold, channels=channels)
        if uses_prior
        else jnp.zeros_like(scale),
        degenerate=degenerate,
        singular=singular,
        at_bound=resting,
        weakest_hold=hold,
    )


def _design(
    parameters: Parameters, problem: Problem, blocks: Blocks, *, channels: bool
) -> Float[Array, "p p"]:
    """The information of the unweighted residuals, offsets taken as known."""
    if blocks == RIGID and not channels:
        alone = jax.tree.map(lambda leaf: leaf[None], (parameters, problem))
        images = Images.of(alone[1])
        held = Held(jnp.zeros_like(images.mask))
        normal = accumulate(Guess.of(alone[0]), held, images, jnp.zeros_like(images.used))
        return jnp.stack([jnp.stack(row) for row in normal.matrix()])[..., 0]
    none = jnp.zeros(0, problem.mask.dtype)
    unweighted = ChannelGaussian(jnp.ones(2, none.dtype)) if channels else InPlane()
    return linearise(parameters, none, unweighted, problem, blocks)[0].shared


def lever_arm(parameters: Parameters, problem: Problem) -> Float[Array, ""]:
    """Root mean square distance of the measured points from the image origin, mm."""
    points = problem.mask[:, None] * measured_points(parameters, problem)
    return jnp.sqrt(jnp.sum(points**2) / jnp.sum(problem.mask))


def unit_scale(parameters: Parameters, problem: Problem, blocks: Blocks) -> Float[Array, " p"]:
    """What makes each unknown's tangent mm at the target: 1 for mm, the lever arm otherwise."""
    lever = lever_arm(parameters, problem)
    one = jnp.ones_like(lever)
    parts = [
        jnp.full(BLOCK_SIZE[name], lever if name in ("rotation", "scale", "sound-speed") else one)
        for name in blocks
    ]
    return jnp.concatenate(parts)


def _spectrum(
    information: Float[Array, "p p"], scale: Float[Array, " p"]
) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
    scaled = jax.lax.stop_gradient(information / (scale[:, None] * scale[None, :]))
    # Of a positive semidefinite matrix the singular values are the eigenvalues.
    found = dense.singular_values(scaled)
    return found.values, found.right


def one_of_many(vectors: Float[Array, "p p"], null: Bool[Array, " p"]) -> Float[Array, " p"]:
    """The unit vector of a null space that lies closest to one single unknown, X's shift first.

    Where the space has several dimensions its eigenvectors are any mixture; this one has a name.
    """
    projector = (vectors * null) @ vectors.T
    purity = jnp.diagonal(projector)
    chosen = jnp.argmax(purity > 0.5 * jnp.max(purity))
    picked = projector @ (jnp.arange(len(purity)) == chosen).astype(projector.dtype)
    length = jnp.linalg.norm(picked)
    return picked / jnp.where(length > 0, length, 1.0)


def _unseen(
    parameters: Parameters,
    problem: Problem,
    blocks: Blocks,
    scale: Float[Array, " p"],
    threshold: Float[Array, ""],
    *,
    channels: bool,
) -> Float[Array, " p"]:
    """The direction that the measurements do not see without a prior; zeros if they see all."""

    def residual(tangent: Float[Array, " p"]) -> Float[Array, "n m"]:
        moved = retract(parameters, tangent, blocks)
        if channels:
            return channel_residual(moved, channels_of(problem), problem)
        return measurement_residual(moved, problem)[:, :2]

    jacobian = jax.jacfwd(residual)(jnp.zeros_like(scale))
    values, vectors = _spectrum(jnp.einsum("nma,nmb->ab", jacobian, jacobian), scale)
    return jnp.where(values[0] < threshold * values[-1], vectors[:, 0], 0.0)


def _elevation_sd(
    parameters: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    problem: Problem,
    blocks: Blocks,
    arrow: arrows.Arrow,
    covariance: Float[Array, "p p"],
    variance: Float[Array, ""],
) -> Float[Array, " n"]:
    """SD of y_i(unknowns, offset_i), the offset's own uncertainty and that of X together."""

    def elevation(tangent: Float[Array, " p"], offset: Float[Array, " k"]) -> Float[Array, " n"]:
        return prior.elevation(retract(parameters, tangent, blocks), offset, problem)

    zero = jnp.zeros(size(blocks), problem.mask.dtype)
    along = jax.jacfwd(elevation)(zero, offset)
    own = jnp.zeros_like(problem.mask)
    if offset.shape[0]:
        # y_i sees only its own offset, so one tangent reads all n derivatives.
        _, slope = jax.jvp(lambda y: elevation(zero, y), (offset,), (jnp.ones_like(offset),))
        along = along - (slope / arrow.diagonal)[:, None] * arrow.coupling
        own = variance * slope**2 / arrow.diagonal
    total = jnp.einsum("na,ab,nb->n", along, covariance, along) + own
    known = problem.mask > 0
    if offset.shape[0]:
        known = known & (arrow.free > 0)
    return jnp.where(known, jnp.sqrt(jnp.where(known, total, 1.0)), jnp.nan)
