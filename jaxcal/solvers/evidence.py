"""How probable the data are under a Gaussian belief, with its SDs and the offsets' mean tuned.

Two questions are put to the data before any law of the offsets is: do the covariances that came
with the measurements describe their errors better than common SDs do, and do the offsets have a
mean other than zero? Own covariances fix the ratios of all measurements' SDs, so one factor is
tuned for them, and one SD for the offsets; common SDs are tuned separately. Each combination is
tuned by a few rounds of Gauss-Newton with Helmert variance updates (:mod:`jaxcal.solvers.variance`)
from the plain self-tuned fit, and judged by its Laplace evidence

    ln Z = -1/2 sum r' W r - 1/2 sum (q_y - b)^2 / sigma_y^2 + 1/2 sum ln |W| - n ln sigma_y
           + 1/2 ln tau - 1/2 tau b^2 - 1/2 ln |H|,

W_i the information of image i's measurements, H the curvature with respect to all unknowns, and
b ~ N(0, 1/tau) with 1/tau = (2 sigma_y)^2 where there is a mean.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.model.parameters import Blocks, Parameters, retract
from jaxcal.model.priors import AbstractSelfTuned, Gaussian
from jaxcal.problem import Problem
from jaxcal.solvers import dense
from jaxcal.solvers.expectation_propagation import Linear
from jaxcal.solvers.least_squares import linearise
from jaxcal.solvers.variance import least_sigma

ROUNDS = 2
"""Linearisations."""

UPDATES = 2
"""Updates of the SDs on each of them."""

MEAN_SD = 2.0
"""SD of the offsets' mean before the data are seen, in SDs of the offsets."""


class Tuned(eqx.Module):
    """A Gaussian belief tuned to the data.

    Attributes:
        parameters: the unknowns.
        mean: b, mm.
        sigma: SD of each component, mm.
        log_evidence: ln Z, up to a constant.
        linear: the problem linearised there; the last unknown is b's deviation.
    """

    parameters: Parameters
    mean: Float[Array, ""]
    sigma: Float[Array, " components"]
    log_evidence: Float[Array, ""]
    linear: Linear


def tune(
    parameters: Parameters,
    belief: AbstractSelfTuned,
    problem: Problem,
    blocks: Blocks,
    with_mean: Float[Array, ""],
    tied: Float[Array, ""],
    rounds: int = ROUNDS,
) -> Tuned:
    """Tune the belief's SDs, the unknowns and the offsets' mean from a nearby solution.

    Args:
        parameters: to start from.
        belief: with SDs to start from.
        problem: one problem.
        blocks: the free unknowns.
        with_mean: 1 where the offsets may have a mean, else 0.
        tied: 1 where the measurements' SDs keep their ratio and only a common factor is tuned.
        rounds: how many.
    """
    columns = belief.columns(problem)
    at = columns[-1].start
    none = jnp.zeros(0, problem.mask.dtype)
    count = belief.count(problem)
    # One floor for all models: one that followed each model's own offset SD would count a gain in
    # that SD three times in the evidence, where data are exact.
    floor = least_sigma(belief.sigma)

    def system(parameters: Parameters, mean: Array, sigma: Array):
        prior = belief.with_sigma(sigma)
        _, jacobian, residual = linearise(parameters, none, prior, problem, blocks)
        residual = residual.at[:, at].add(-problem.mask * mean / sigma[-1])
        along = jnp.zeros_like(residual).at[:, at].set(-with_mean * problem.mask / sigma[-1])
        return jnp.concatenate([jacobian, along[None]]), residual

    def mean_precision(sigma: Array) -> Array:
        # Without a mean its unknown is held at zero.
        return jnp.where(with_mean > 0, (MEAN_SD * sigma[-1]) ** -2.0, 1.0)

    def curvature(jacobian: Array, precision: Array) -> Array:
        return jnp.einsum("anm,bnm->ab", jacobian, jacobian).at[-1, -1].add(precision)

    def one_round(_: Array, state: tuple) -> tuple:
        parameters, mean, sigma = state
        here = system(parameters, mean, sigma)

        def update(_: Array, state: tuple) -> tuple:
            now, _ = state
            ratio = jnp.ones_like(here[1][0])
            for k, part in enumerate(columns):
                ratio = ratio.at[part].set(sigma[k] / now[k])
            jacobian, residual = ratio * here[0], ratio * here[1]
            precision = mean_precision(now)
            inverse, _ = dense.inverse_positive(curvature(jacobian, precision))
            gradient = jnp.einsum("anm,nm->a", jacobian, residual).at[-1].add(precision * mean)
            step = -inverse @ gradient
            residual = residual + jnp.einsum("a,anm->nm", step, jacobian)
            leverage = jnp.einsum("anm,ab,bnm->nm", jacobian, inverse, jacobian)
            freedom = jnp.maximum(count - _sums(leverage, columns), 0.05 * count)
            squares = _sums(residual**2, columns)
            factor = squares / freedom
            pooled = jnp.sum(squares[:-1]) / jnp.sum(freedom[:-1])
            factor = factor.at[:-1].set(jnp.where(tied > 0, pooled, factor[:-1]))
            return jnp.maximum(now * jnp.sqrt(factor), floor), step

        none = jnp.zeros(here[0].shape[0], sigma.dtype)
        sigma, step = jax.lax.fori_loop(0, UPDATES, update, (sigma, none))
        return retract(parameters, step[:-1], blocks), mean + step[-1], sigma

    zero = jnp.zeros((), problem.mask.dtype)
    state = (parameters, zero, belief.sigma)
    parameters, mean, sigma = jax.lax.fori_loop(0, rounds, one_round, state)

    jacobian, residual = system(parameters, mean, sigma)
    precision = mean_precision(sigma)
    inverse, log_determinant = dense.inverse_positive(curvature(jacobian, precision))
    gradient = jnp.einsum("anm,nm->a", jacobian, residual).at[-1].add(precision * mean)
    # The minimum is still a small step away.
    cost = jnp.sum(residual**2) + precision * mean**2 - gradient @ inverse @ gradient
    evidence = 0.5 * (jnp.log(precision) - cost - log_determinant)
    evidence = evidence - jnp.sum(count * jnp.log(sigma))
    evidence = evidence - 0.5 * _log_shape(belief, problem)
    # The measurements' part, and the offsets in mm.
    direction = sigma[-1] * jacobian[:, :, at].T
    offset = sigma[-1] * residual[:, at]
    noise_jacobian = jacobian.at[:, :, at].set(0.0)
    downhill = -jnp.einsum("anm,nm->a", noise_jacobian, residual)
    gradient = downhill.at[-1].add(-precision * mean)
    lower, upper = None, None
    if problem.max_elevation is not None:
        lower, upper = -problem.max_elevation - mean, problem.max_elevation - mean
    linear = Linear(
        curvature(noise_jacobian, precision), gradient, direction, offset, problem.mask,
        lower, upper,
    )  # fmt: skip
    return Tuned(parameters, mean, sigma, evidence, linear)


def _sums(values: Float[Array, "n columns"], columns: tuple[slice, ...]) -> Array:
    over_images = jnp.sum(values, axis=0)
    return jnp.stack([jnp.sum(over_images[part]) for part in columns])


def _log_shape(belief: AbstractSelfTuned, problem: Problem) -> Float[Array, ""]:
    """Log determinants of the covariances' shapes, over the used images."""
    if not isinstance(belief, Gaussian) or belief.covariance is None:
        return jnp.zeros((), problem.mask.dtype)
    shape = belief.covariance
    determinant = shape[:, 0, 0] * shape[:, 1, 1] - shape[:, 0, 1] ** 2
    return jnp.sum(problem.mask * jnp.log(jnp.where(problem.mask > 0, determinant, 1.0)))
