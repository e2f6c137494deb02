"""Derivatives of an optimum with respect to the data, without unrolling the solver.

At a solution the stationarity conditions F(unknowns, data) = 0 hold, so by the implicit function
theorem d unknowns = -(dF/d unknowns)^-1 dF/d data. The first matrix is the exact Hessian, which has
the arrow's shape: p tangents and one all-ones offset tangent read it, and the offsets are
eliminated by scalar divisions (:mod:`jaxcal.solvers.arrow`). Offsets resting on their bound move
with the bound. For the self-tuned solve the conditions are those of X and c together with those of
the SDs.

Both functions return the tangent (zero in value) by which the solution moves with the data; being
``jax.custom_jvp`` with rules that call themselves, they work in forward and reverse mode, to any
order, under vmap and jit. They hold where the solution is an isolated minimum with a fixed active
set; ``Calibration.differentiable`` says whether that is so.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.model.parameters import Blocks, Parameters, retract, size
from jaxcal.model.priors import AbstractPrior, AbstractSelfTuned
from jaxcal.precision import in_standard_promotion
from jaxcal.problem import Problem
from jaxcal.solvers import dense, variance


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def optimum(
    blocks: Blocks,
    reference: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    problem: Problem,
) -> tuple[Float[Array, " p"], Float[Array, " k"]]:
    """How the minimiser of a prior's objective moves with the problem and the prior's numbers.

    Args:
        blocks: the free unknowns.
        reference: the solution (not differentiated).
        offset: its offset unknowns (not differentiated).
        prior: the objective.
        problem: the data.

    Returns:
        tangent of the shared unknowns about the reference (zero in value), and the offsets.
    """
    return _no_move(blocks, reference), offset


@optimum.defjvp
@in_standard_promotion
def _optimum_jvp(blocks: Blocks, primals: tuple, tangents: tuple) -> tuple:
    reference, offset, prior, problem = primals
    _, _, prior_dot, problem_dot = tangents
    tangent, offset = optimum(blocks, reference, offset, prior, problem)

    def cost(x: Array, y: Array, prior: AbstractPrior, problem: Problem) -> Array:
        moved = retract(reference, x, blocks)
        return 0.5 * jnp.sum(prior.residual(moved, y, problem) ** 2)

    gradient = jax.grad(cost, argnums=(0, 1))
    (_, offset_gradient), push = jax.linearize(
        lambda x, y: gradient(x, y, prior, problem), tangent, offset
    )
    unit = jnp.eye(tangent.shape[0], dtype=tangent.dtype)
    matrix, coupling = jax.vmap(lambda x: push(x, jnp.zeros_like(offset)))(unit)
    _, diagonal = push(jnp.zeros_like(tangent), jnp.ones_like(offset))
    _, (data, offset_data) = jax.jvp(
        lambda prior, problem: gradient(tangent, offset, prior, problem),
        (prior, problem),
        (prior_dot, problem_dot),
    )
    limit, limit_dot = jax.jvp(
        lambda prior, problem: prior.limit(reference, problem),
        (prior, problem),
        (prior_dot, problem_dot),
    )
    resting = (jnp.abs(offset) >= limit) & (offset_gradient * jnp.sign(offset) <= 0)
    # A bound at infinity has no tangent worth multiplying.
    resting_dot = jnp.where(resting, jnp.sign(offset) * limit_dot, 0.0)
    seen = jnp.abs(diagonal) > 0
    weight = jnp.where(resting | jnp.logical_not(seen), 0.0, 1 / jnp.where(seen, diagonal, 1.0))
    schur = matrix - (coupling * weight) @ coupling.T
    rhs = -data + coupling @ (weight * offset_data) - coupling @ resting_dot
    tangent_dot = dense.inverse(schur) @ rhs
    offset_dot = resting_dot - weight * (offset_data + tangent_dot @ coupling)
    return (tangent, offset), (tangent_dot, offset_dot)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def self_tuned_optimum(
    blocks: Blocks,
    reference: Parameters,
    sigma: Float[Array, " components"],
    belief: AbstractSelfTuned,
    problem: Problem,
) -> tuple[Float[Array, " p"], Float[Array, " components"]]:
    """How a self-tuned solution and its SDs move with the problem.

    Args:
        blocks: the free unknowns.
        reference: the solution (not differentiated).
        sigma: its SDs, mm (not differentiated).
        belief: the belief that was tuned, with the SDs to hold where there are too few images.
        problem: the data.

    Returns:
        tangent of the shared unknowns about the reference (zero in value), and the SDs.
    """
    return _no_move(blocks, reference), sigma


@self_tuned_optimum.defjvp
@in_standard_promotion
def _self_tuned_jvp(blocks: Blocks, primals: tuple, tangents: tuple) -> tuple:
    reference, sigma, belief, problem = primals
    _, _, belief_dot, problem_dot = tangents
    tangent, sigma = self_tuned_optimum(blocks, reference, sigma, belief, problem)
    count = tangent.shape[0]

    def conditions(unknowns: Array, belief: AbstractSelfTuned, problem: Problem) -> Array:
        x, log_sigma = unknowns[:count], unknowns[count:]
        none = jnp.zeros(0, x.dtype)

        def cost(x: Array) -> Array:
            prior = belief.with_sigma(jnp.exp(log_sigma))
            residual = prior.residual(retract(reference, x, blocks), none, problem)
            return 0.5 * jnp.sum(residual**2)

        parameters = retract(reference, x, blocks)
        updated = variance.update_or_hold(parameters, jnp.exp(log_sigma), belief, problem, blocks)
        return jnp.concatenate([jax.grad(cost)(x), log_sigma - jnp.log(updated)])

    here = jnp.concatenate([tangent, jnp.log(sigma)])
    matrix = jax.jacfwd(conditions)(here, belief, problem)
    _, data = jax.jvp(
        lambda belief, problem: conditions(here, belief, problem),
        (belief, problem),
        (belief_dot, problem_dot),
    )
    # Gradients of X come in 1/sigma^2, conditions of the SDs in units of one: balance the rows.
    scale = 1 / jnp.max(jnp.abs(matrix), axis=1)
    moved = -dense.inverse(scale[:, None] * matrix) @ (scale * data)
    return (tangent, sigma), (moved[:count], sigma * moved[count:])


def _no_move(blocks: Blocks, reference: Parameters) -> Float[Array, " p"]:
    # Zeros that depend on the lane: where only a custom rule's tangent is batched and its value is
    # not, JAX (0.10.2) mixes them up in the linearisation of a scan over batches.
    zero = jnp.where(jnp.isfinite(reference.translation[0]), 0.0, 0.0)
    return jnp.full(size(blocks), zero.astype(reference.translation.dtype))
