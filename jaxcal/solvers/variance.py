"""Self-tuning: the SDs of the measurements and of the elevational offset from the data themselves.

Restricted maximum likelihood (REML) by Helmert's iteration for variance components: solve with the
current SDs, then set each component's variance to

    sigma_k^2 = |residual_k|^2 / (n_k - leverage_k),

where leverage_k, the trace of S^-1 J_k' J_k, is the number of degrees of freedom that the unknowns
take from component k, and again until the SDs stand still. So no noise level and no maximum
elevational distance is chosen by hand.

The components are those of the belief in use (:class:`jaxcal.model.priors.AbstractSelfTuned`):
lateral position, range and offset, or the elements' distances and the offset.

A component whose error truly vanishes (no noise, or every target in the plane) would drive its SD
to zero and the weights to infinity; it is held at a thousandth of the largest SD, which is as good
as exact for X.

References: Helmert 1924; Patterson and Thompson 1971 (REML); Foerstner 1979.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxcal.model.parameters import Blocks, Parameters
from jaxcal.model.priors import AbstractSelfTuned
from jaxcal.problem import Problem
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers.least_squares import Fit, linearise, minimise

MINIMUM_SELF_TUNING = 8
"""With fewer used images the residuals cannot tell three SDs apart from nine unknowns."""

RELATIVE_FLOOR = 1e-3
ABSOLUTE_FLOOR_MM = 1e-6


class SelfTuned(eqx.Module):
    """A self-tuned fit.

    Attributes:
        fit: the last weighted solve; ``iterations`` counts all linearisations.
        sigma: SD of each component, mm.
        rounds: variance updates.
        settled: whether the SDs stood still at the end.
        floored: which SDs rest on their floor.
    """

    fit: Fit
    sigma: Float[Array, " components"]
    rounds: Int[Array, ""]
    settled: Bool[Array, ""]
    floored: Bool[Array, " components"]


def self_tuned(
    start: Parameters,
    belief: AbstractSelfTuned,
    problem: Problem,
    blocks: Blocks,
    *,
    tolerance: float | None = None,
    max_rounds: int = 60,
    max_steps: int = 100,
    trace: int = 0,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> SelfTuned:
    """Solve with a Gaussian belief, its SDs estimated by REML.

    Args:
        start: a conventional fit.
        belief: the Gaussian belief; its SDs are those that are held where there are too few images
            (fewer than 8 used ones) to estimate them.
        problem: one problem.
        blocks: the free unknowns.
        tolerance: relative change of the SDs to stop at; 1e-9 in float64, 1e-4 in float32.
        max_rounds: most variance updates.
        max_steps: most linearisations in each weighted solve.
        trace: how many values of the last solve's objective to keep.
        solver: another optimistix solver for the weighted solves.
    """
    dtype = problem.mask.dtype
    if tolerance is None:
        tolerance = 1e-9 if float(jnp.finfo(dtype).eps) < 1e-10 else 1e-4
    enough = jnp.sum(problem.mask) >= MINIMUM_SELF_TUNING
    unit = belief.with_sigma(jnp.ones_like(belief.sigma))
    errors = unit.residual(start, unit.start(start, problem), problem)
    rms = jnp.sqrt(_sums(errors**2, unit, problem) / unit.count(problem))
    first = jnp.where(enough, with_floor(rms), belief.sigma)

    tightest = tolerance / 10

    def solve(parameters: Parameters, sigma: Float[Array, " k"], change: Float[Array, ""]) -> Fit:
        # No use in solving far beyond how well the SDs are known yet.
        wanted = jnp.clip(0.01 * change, tightest, 1e-3)
        return minimise(
            parameters, belief.with_sigma(sigma), problem, blocks, damping=1e-6,
            max_steps=max_steps, exact=True, tolerance=wanted, trace=trace, solver=solver,
        )  # fmt: skip

    def unfinished(state: tuple) -> Bool[Array, ""]:
        _, _, rounds, change, _ = state
        return (rounds == 0) | ((change > tolerance) & (rounds < max_rounds))

    def one_round(state: tuple) -> tuple:
        fit, sigma, rounds, change, iterations = state
        fit = solve(fit.parameters, sigma, change)
        updated = update_or_hold(fit.parameters, sigma, belief, problem, blocks)
        change = jnp.max(jnp.abs(jnp.log(updated / sigma)))
        # With held SDs only the solve itself has to arrive.
        change = jnp.where(enough, change, jnp.minimum(change, fit.stationarity))
        # A lane that is lost (NaN) must stop, not hold up its neighbours.
        change = jnp.where(jnp.isfinite(change), change, 0.0)
        return fit, updated, rounds + 1, change, iterations + fit.iterations

    shapes = jax.eval_shape(solve, start, first, first[0])
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    empty = eqx.tree_at(lambda fit: fit.parameters, empty, start)
    zero = jnp.zeros((), jnp.int32)
    state = (empty, first, zero, jnp.ones((), dtype), jnp.zeros_like(empty.iterations))
    fit, sigma, rounds, change, iterations = jax.lax.while_loop(unfinished, one_round, state)
    fit = eqx.tree_at(lambda fit: fit.iterations, fit, iterations)
    floor = RELATIVE_FLOOR * jnp.max(sigma)
    return SelfTuned(fit, sigma, rounds, change <= tolerance, sigma <= 1.001 * floor)


def update(
    parameters: Parameters,
    sigma: Float[Array, " components"],
    belief: AbstractSelfTuned,
    problem: Problem,
    blocks: Blocks,
) -> Float[Array, " components"]:
    """One Helmert update of the SDs (mm) at a weighted solution."""
    prior = belief.with_sigma(sigma)
    none = jnp.zeros(0, problem.mask.dtype)
    arrow, jacobian, residual = linearise(parameters, none, prior, problem, blocks)
    inverse = arrows.inverse_symmetric(arrow.shared, jnp.diagonal(arrow.shared))
    leverage = jnp.einsum("anm,ab,bnm->nm", jacobian, inverse, jacobian)
    count = prior.count(problem)
    freedom = jnp.maximum(count - _sums(leverage, prior, problem), 0.05 * count)
    return with_floor(sigma * jnp.sqrt(_sums(residual**2, prior, problem) / freedom))


def _sums(
    values: Float[Array, "n columns"], belief: AbstractSelfTuned, problem: Problem
) -> Float[Array, " components"]:
    """Sums over the images and the columns of each component."""
    over_images = jnp.sum(values, axis=0)
    return jnp.stack([jnp.sum(over_images[columns]) for columns in belief.columns(problem)])


def update_or_hold(
    parameters: Parameters,
    sigma: Float[Array, " components"],
    belief: AbstractSelfTuned,
    problem: Problem,
    blocks: Blocks,
) -> Float[Array, " components"]:
    """:func:`update`, or the belief's own SDs where there are too few images to estimate them."""
    enough = jnp.sum(problem.mask) >= MINIMUM_SELF_TUNING
    return jnp.where(enough, update(parameters, sigma, belief, problem, blocks), belief.sigma)


def with_floor(sigma: Float[Array, " components ..."]) -> Float[Array, " components ..."]:
    """The SDs, none below a thousandth of the largest."""
    return jnp.maximum(sigma, least_sigma(sigma))


def least_sigma(sigma: Float[Array, " components ..."]) -> Float[Array, " ..."]:
    """The floor of SDs, mm: a thousandth of the largest."""
    return jnp.maximum(RELATIVE_FLOOR * jnp.max(sigma, axis=0), ABSOLUTE_FLOOR_MM)
