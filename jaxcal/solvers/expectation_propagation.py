"""Expectation propagation: unknowns that are Gaussian but for what the offsets' law says of them.

Linearised, the unknowns x (X, target, the offsets' mean and whatever else) have the Gaussian
likelihood exp(-x' L x / 2 + e' x) of the measurements, and image i's offset is u_i = o_i + h_i' x.
Its law p(u_i) is not Gaussian; expectation propagation (EP) puts a Gaussian *site* in its place,
exp(nu_i u - tau_i u^2 / 2), which reproduces mean and variance of u_i under all the other sites
times the true law:

    C = (L + sum tau_i h_i h_i')^-1,  m = C (e + sum (nu_i - tau_i o_i) h_i)       the belief now
    v_i = h_i' C h_i,  1/w_i = 1/v_i - tau_i,                                      without site i
    c_i = w_i ((o_i + h_i' m) / v_i - nu_i)
    mass Z_i, mean and variance of p(u) N(u; c_i, w_i)                             a quadrature
    tau_i <- 1/variance - 1/w_i,  nu_i <- mean/variance - c_i/w_i                  all i, damped

A sweep is O(n p^2). It starts from the Gaussian law of the same SD, for which it is exact, or from
the sites of the same law with another SD, and a fixed number of sweeps is taken, so it can be
differentiated like any other array code. With it comes the evidence, the probability of the data
under that law, by which laws are compared.

Reference: Minka 2001; Rasmussen and Williams 2006, section 3.6.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.model.shapes import Family, Moments, tilted
from jaxcal.solvers import dense

AHEAD = 3
"""Sweeps under a family's first law before the following."""

SWEEPS = 3
"""Sweeps under each law, from the sites of the one before it."""

DAMPING = 0.8

LEAST_ROOM = 1e-3
"""Least 1 - tau_i v_i: with less, what is left without site i is no Gaussian any more."""


class Linear(eqx.Module):
    """A linearised problem.

    Attributes:
        information: L, of everything but the offsets' law.
        gradient: e.
        direction: rows h_i.
        offset: o_i, mm.
        used: 1 for used images.
        lower: least u_i that is allowed, or None.
        upper: largest.
    """

    information: Float[Array, "p p"]
    gradient: Float[Array, " p"]
    direction: Float[Array, "n p"]
    offset: Float[Array, " n"]
    used: Float[Array, " n"]
    lower: Float[Array, " n"] | None = None
    upper: Float[Array, " n"] | None = None


class Posterior(eqx.Module):
    """The belief about the unknowns under each law.

    Attributes:
        mean: of x.
        covariance: of x.
        log_evidence: up to a constant that the laws share.
        change: how far the last sweep moved the mean, in SDs (the length (d' S d)^1/2, S the
            information); infinite where a site leaves nothing for the others: sites that run away
            can pause for a sweep, with an evidence that is only large.
    """

    mean: Float[Array, "k p"]
    covariance: Float[Array, "k p p"]
    log_evidence: Float[Array, " k"]
    change: Float[Array, " k"]


def propagate(
    linear: Linear,
    families: tuple[Family, ...],
    sd: Float[Array, " k"],
    ahead: int = AHEAD,
    sweeps: int = SWEEPS,
) -> Posterior:
    """Belief and evidence under every law.

    Laws of one family are taken in their order, each from the sites of the one before.

    Args:
        linear: the linearised problem.
        families: of the laws.
        sd: their SDs, mm; of a family with edges, the widest first, which leaves no image out.
        ahead: sweeps under a family's first law before those that each law gets.
        sweeps: how many under each law, at least one.
    """
    parts, order = [], []
    for family in dict.fromkeys(families):
        members = [k for k, name in enumerate(families) if name == family]
        parts.append(_in_turn(linear, family, sd[np.asarray(members)], ahead, sweeps))
        order += members
    back = np.argsort(order)
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[back], *parts)


def _in_turn(
    linear: Linear, family: Family, sd: Float[Array, " k"], ahead: int, sweeps: int
) -> Posterior:
    """Belief and evidence under the laws of one family, one after the other."""
    h, used, offset = linear.direction, linear.used, linear.offset
    size = h.shape[1]
    # Symmetric p x p matrices are kept as one row of their upper triangle: sums over the images
    # are then plain matrix products.
    row, column = np.triu_indices(size)
    squares = h[:, row] * h[:, column]
    twice = jnp.asarray(np.where(row == column, 1.0, 2.0), h.dtype)
    place = np.zeros((size, size), int)
    place[row, column] = place[column, row] = np.arange(len(row))

    def belief(tau: Array, nu: Array) -> tuple[Array, Array, Array, Array, Array]:
        information = linear.information + (tau @ squares)[place]
        rhs = linear.gradient + (nu - tau * offset) @ h
        covariance, log_determinant = dense.inverse_positive(information)
        return covariance, covariance @ rhs, information, rhs, log_determinant

    def found_at(
        scale: Array, tau: Array, nu: Array, covariance: Array, mean: Array
    ) -> tuple[Moments, Array, Array]:
        variance = squares @ (covariance[row, column] * twice)
        shrink = 1 / jnp.maximum(1 - tau * variance, LEAST_ROOM)
        centre = shrink * (offset + h @ mean - variance * nu)
        without = jnp.where(used > 0, variance * shrink, 1.0)
        found = tilted(
            family, scale[None], centre[None], without[None], linear.lower, linear.upper
        )  # fmt: skip
        return jax.tree.map(lambda leaf: leaf[0], found), centre, without

    def refresh(
        tau: Array, nu: Array, found: Moments, centre: Array, without: Array
    ) -> tuple[Array, Array]:
        new_tau, new_nu = refreshed(found, centre, without)
        tau = tau + DAMPING * used * (new_tau - tau)
        return tau, nu + DAMPING * used * (new_nu - nu)

    def swept(times: int, scale: Array, state: tuple) -> tuple:
        def sweep(_: Array, state: tuple) -> tuple:
            tau, nu = state
            covariance, mean = belief(tau, nu)[:2]
            return refresh(tau, nu, *found_at(scale, tau, nu, covariance, mean))

        return jax.lax.fori_loop(0, times, sweep, state)

    def law(state: tuple, scale: Array) -> tuple[tuple, tuple[Array, Array, Array, Array]]:
        tau, nu = swept(sweeps - 1, scale, state)
        covariance, before, _, rhs, log_determinant = belief(tau, nu)
        found, centre, without = found_at(scale, tau, nu, covariance, before)
        # The evidence is stationary in the sites, so it is as good before the last sweep as after.
        joined = 1 + tau * without
        site = found.log_mass + 0.5 * jnp.log(joined)
        site = site - 0.5 * ((centre + without * nu) ** 2 / joined - centre**2) / without
        site = site + nu * offset - 0.5 * tau * offset**2
        evidence = jnp.sum(used * site) + 0.5 * rhs @ before - 0.5 * log_determinant
        # tau w = tau v / (1 - tau v) shows how much room there was.
        crowded = jnp.any(tau * without * used > 0.99 / LEAST_ROOM)

        tau, nu = refresh(tau, nu, found, centre, without)
        covariance, mean, information, *_ = belief(tau, nu)
        step = mean - before
        change = jnp.sqrt(jnp.maximum(step @ information @ step, 0.0))
        change = jnp.where(crowded, jnp.inf, change)
        return (tau, nu), (mean, covariance, evidence, change)

    tau = used / sd[0] ** 2
    start = swept(ahead, sd[0], (tau, jnp.zeros_like(tau)))
    return Posterior(*jax.lax.scan(law, start, sd)[1])


def refreshed(found: Moments, centre: Array, without: Array) -> tuple[Array, Array]:
    """The sites (tau, nu) that reproduce moments found, beside the Gaussian without them."""
    tau = 1 / found.variance - 1 / without
    # Beyond a heavy tail's bend a site is negative; a little of that is all that EP bears.
    tau = jnp.maximum(tau, -0.2 / without)
    return tau, (tau + 1 / without) * found.mean - centre / without
