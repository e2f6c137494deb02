"""Gaussian noise models with a mean of the offsets: how they are tuned, and their evidence.

Two questions are put to the data before the laws of the offsets are compared: whether the offsets
have a mean other than zero (:mod:`jaxcal.solvers.offset_mean`), and whether the covariances that
came with the measurements describe their errors better than common SDs do. Own covariances fix the
ratios of all measurements' SDs, so one factor is tuned for them, and one SD for the offsets; common
SDs are tuned separately. Each noise model is tuned from the self-tuned fit by a few rounds of
Gauss-Newton with Helmert's updates (:mod:`jaxcal.solvers.reml`). Every round sets the mean to its
expectation under the belief about it. The model is judged by its Laplace evidence

    ln Z = -1/2 sum r' W r - 1/2 sum (q_y - b)^2 / s_y^2 + 1/2 sum ln |W| - n ln s_y
           + 1/2 ln tau - 1/2 tau b^2 - 1/2 ln |H|,

W_i the information of image i's measurements, H the curvature with respect to all unknowns, and
b ~ N(0, 1/tau) with 1/tau = (2 s_y)^2.

Everything is computed from the sums that one pass over the images forms for each component
(:func:`jaxcal.solvers.normal_equations.component_sums`). A mean b needs no further sum: it moves
q_iy - b as v_y does, so its row of N_y is that of v_y, and

    rss_y(b) = rss_y - 2 b sum q_iy + n b^2,      sum q_iy = -g_y[v_y],      n = N_y[v_y, v_y].
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.model.batch import ImagePlanes, Iterate, barrier
from jaxcal.model.observations import MediumPrior, Observation
from jaxcal.runtime.compiler import traced_once
from jaxcal.solvers import dense
from jaxcal.solvers.normal_equations import (
    V_Y,
    ComponentSums,
    component_sums,
    row_of,
    stacked,
    traces,
)
from jaxcal.solvers.offset_mean import MEAN_SD, influences, log_evidence_gain, mean_belief, trust_in
from jaxcal.solvers.reml import helmert, least_sigma

ROUNDS = 2
"""Number of linearisations."""

UPDATES = 2
"""Updates of the SDs in each linearisation."""


class NoiseModel(eqx.Module):
    """A Gaussian noise model tuned to the data; batch axis last.

    Attributes:
        iterate: X, c and the further unknowns.
        mean: b, mm.
        sigma: SD of each component, mm.
        sums: of the images at ``iterate``.
        trust: share of the data's information about b that is used.
    """

    iterate: Iterate
    mean: Float[Array, " batch"]
    sigma: Float[Array, "k batch"]
    sums: ComponentSums
    trust: Float[Array, " batch"]

    def log_evidence(self, count: Float[Array, "k batch"]) -> Float[Array, " batch"]:
        """Ln Z, up to a constant and the covariances' determinants.

        Args:
            count: residuals of each component.
        """
        system = System.of(self.sums, self.mean)
        inverse, step, evidence = system.solved(self.sigma, self.mean)
        with_mean = mean_belief(self.mean + step[-1], inverse[-1, -1], self.sigma[-1], self.trust)
        return (
            evidence + log_evidence_gain(with_mean) - jnp.sum(count * jnp.log(self.sigma), axis=0)
        )


class System(eqx.Module):
    """Every component's normal equations about a mean b, which is the last unknown.

    Attributes:
        sums: of the images.
        border: b's row of the offsets' matrix; the other components do not depend on b.
        gradient: of every component, b's entry last.
        squares: rss_k.
    """

    sums: ComponentSums
    border: Float[Array, "q batch"]
    gradient: Float[Array, "k q batch"]
    squares: Float[Array, "k batch"]

    @classmethod
    def of(cls, sums: ComponentSums, mean: Array) -> System:
        """From the sums of a pass."""
        only = np.eye(len(sums.squares), dtype=mean.dtype)[-1][:, None]
        along = row_of(sums.matrix[-1], V_Y)
        squares = mean * (2 * sums.gradient[-1, V_Y] + mean * along[V_Y])
        gradient = sums.gradient + only[:, None] * mean * along
        last = only * gradient[:, V_Y]
        border = jnp.concatenate([along, along[V_Y, None]])
        gradient = jnp.concatenate([gradient, last[:, None]], axis=1)
        return barrier(cls(sums, border, gradient, sums.squares + only * squares))

    def solved(self, sigma: Array, mean: Array) -> tuple[Array, Array, Array]:
        """Inverse and step with given SDs if there is a mean, and ln Z without the SDs' terms."""
        weight, precision = 1 / sigma**2, (MEAN_SD * sigma[-1]) ** -2.0
        normal = self.sums.weighted(weight)
        unknowns = normal.gradient.shape[0]
        last = (np.arange(unknowns + 1) == unknowns)[:, None]
        border = weight[-1] * self.border + jnp.where(last, precision, 0.0)
        gradient = jnp.sum(weight[:, None] * self.gradient, axis=0)
        gradient = gradient + jnp.where(last, precision * mean, 0.0)
        cost = jnp.sum(weight * self.squares, axis=0) + precision * mean**2
        if self.sums.prior is not None:
            away, slope, _ = self.sums.prior
            gradient = gradient + jnp.concatenate([slope, jnp.zeros_like(slope[:1])])
            cost = cost + away
        flat, border, gradient = barrier((normal.curvature, border, gradient))
        whole = jnp.concatenate([stacked(flat), border[:-1, None]], axis=1)
        whole = jnp.concatenate([whole, border[None]])
        inverse, log_determinant = dense.inverse_batch_last(whole)
        step = -dense.product_batch_last(inverse, gradient)
        # The cost at the minimum, which is a small step away.
        cost = cost + jnp.sum(gradient * step, axis=0)
        return inverse, step, 0.5 * (jnp.log(precision) - cost - log_determinant)

    def traces(self, matrix: Float[Array, "q q batch"]) -> Float[Array, "k batch"]:
        """tr(A N_k) of every component, A symmetric."""
        found = traces(matrix, self.sums.matrix)
        crossed = jnp.sum(2 * matrix[-1, :-1] * self.border[:-1], axis=0)
        own = crossed + matrix[-1, -1] * self.border[-1]
        return found + np.eye(len(found), dtype=matrix.dtype)[-1][:, None] * own


def tune(
    iterate: Iterate, observation: Observation, images: ImagePlanes, medium: MediumPrior | None
) -> NoiseModel:
    """Tune the SDs, the unknowns and the mean from a nearby solution.

    Args:
        iterate: to start from.
        observation: with the SDs to start from, mm.
        images: the data.
        medium: prior of further unknowns, or None.
    """
    count, start = observation.count(images), observation.sigma
    # One floor for all rounds: where data are exact, a floor that followed a model's own offset SD
    # would count a gain in that SD three times in the evidence.
    floor = least_sigma(start)
    used = images.mask > 0
    gaps = jnp.any(used[:, 1:] & ~used[:, :-1])

    # Images in use are neighbours in time even if others between them were left out.
    def without_gaps(planes: tuple[Array, Array]) -> tuple[Array, ...]:
        order = jnp.argsort(~used, axis=1)
        return tuple(jnp.take_along_axis(plane, order, axis=1) for plane in planes)

    def sums_at(iterate: Iterate) -> ComponentSums:
        return barrier(component_sums(iterate, observation, images, None, medium))

    def improved(sums: ComponentSums, iterate: Iterate, mean: Array, sigma: Array) -> tuple:
        system = System.of(sums, mean)
        inverse, step, _ = barrier(system.solved(sigma, mean))
        moved, share = influences(
            iterate, observation, images, 1 / sigma**2, mean, along=inverse[:, -1], step=step
        )
        # Sorting takes a tenth of a calibration's time, and most recordings have no gaps.
        moved, share = jax.lax.cond(gaps, without_gaps, lambda planes: planes, (moved, share))
        trust = trust_in(inverse[-1, -1], moved, share)

        def update(_: Array, state: tuple) -> tuple:
            sigma, _ = state
            inverse, step, _ = barrier(system.solved(sigma, mean))
            variance = inverse[-1, -1]
            belief = mean_belief(mean + step[-1], variance, sigma[-1], trust)
            # The other unknowns follow b.
            along = inverse[:, -1] / variance
            step = step + along * (belief.mean - mean - step[-1])
            inverse = inverse + along[:, None] * along * (belief.variance - variance)
            inverse, step = barrier((inverse, step))
            bent = system.traces(step[:, None] * step)
            left = system.squares + 2 * jnp.sum(system.gradient * step, axis=1) + bent
            updated = helmert(left, system.traces(inverse), count, sigma)
            return jnp.maximum(updated, floor), step

        none = jnp.zeros((iterate.unknowns + 1, mean.shape[0]), mean.dtype)
        sigma, step = jax.lax.fori_loop(0, UPDATES, update, (sigma, none))
        return barrier((iterate.moved(step[:-1]), mean + step[-1], sigma, trust))

    sums_at, none = traced_once(sums_at, iterate)

    # The code of the sums appears once, for the rounds and the result: it is half of the program.
    def one_round(index: Array, state: tuple) -> tuple:
        iterate, mean, sigma, trust, _ = state
        sums = sums_at(iterate)
        iterate, mean, sigma, trust = jax.lax.cond(
            index < ROUNDS,
            lambda: improved(sums, iterate, mean, sigma),
            lambda: (iterate, mean, sigma, trust),
        )
        return iterate, mean, sigma, trust, sums

    zero = jnp.zeros_like(start[0])
    state = (iterate, zero, start, zero + 1, none)
    iterate, mean, sigma, trust, sums = jax.lax.fori_loop(0, ROUNDS + 1, one_round, state)
    return NoiseModel(iterate, mean, sigma, sums, trust)
