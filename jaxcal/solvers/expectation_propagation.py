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

A sweep is O(n p^2). It starts from the Gaussian law of the same SD, for which it is exact, and a
fixed number of sweeps is taken, so it can be differentiated like any other array code. With it
comes the evidence, the probability of the data under that law, by which laws are compared.

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

SWEEPS = 6
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
    linear: Linear, families: tuple[Family, ...], sd: Float[Array, " k"], sweeps: int = SWEEPS
) -> Posterior:
    """Belief and evidence under every law.

    Args:
        linear: the linearised problem.
        families: of the laws.
        sd: their SDs, mm.
        sweeps: how many, at least one.
    """
    h, used = linear.direction, linear.used
    size = h.shape[1]
    # Symmetric p x p matrices are kept as one row of their upper triangle: sums over the images
    # are then plain matrix products.
    row, column = np.triu_indices(size)
    squares = h[:, row] * h[:, column]
    twice = jnp.asarray(np.where(row == column, 1.0, 2.0), h.dtype)
    place = np.zeros((size, size), int)
    place[row, column] = place[column, row] = np.arange(len(row))
    groups: dict[Family, list[int]] = {}
    for k, family in enumerate(families):
        groups.setdefault(family, []).append(k)
    precision = jnp.broadcast_to((1 / sd**2)[:, None], (len(families), len(used))) * used
    start = (precision, jnp.zeros_like(precision))

    def belief(tau: Array, nu: Array) -> tuple[Array, Array, Array, Array]:
        information = linear.information + (tau @ squares)[:, place]
        rhs = linear.gradient + (nu - tau * linear.offset) @ h
        covariance, log_determinant = jax.vmap(dense.inverse_positive)(information)
        return covariance, jnp.sum(covariance * rhs[:, None, :], axis=2), rhs, log_determinant

    def cavity(tau: Array, nu: Array, covariance: Array, mean: Array) -> tuple[Array, Array]:
        variance = (covariance[:, row, column] * twice) @ squares.T
        shrink = 1 / jnp.maximum(1 - tau * variance, LEAST_ROOM)
        centre = shrink * (linear.offset + mean @ h.T - variance * nu)
        return centre, jnp.where(used > 0, variance * shrink, 1.0)

    def moments(centre: Array, without: Array) -> Moments:
        parts = []
        for family, members in groups.items():
            at = np.asarray(members)
            parts.append(
                tilted(family, sd[at], centre[at], without[at], linear.lower, linear.upper)
            )
        order = np.argsort(np.concatenate(list(groups.values())))
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[order], *parts)

    def found_at(
        tau: Array, nu: Array, covariance: Array, mean: Array
    ) -> tuple[Moments, Array, Array]:
        centre, without = cavity(tau, nu, covariance, mean)
        return moments(centre, without), centre, without

    def refresh(
        tau: Array, nu: Array, found: Moments, centre: Array, without: Array
    ) -> tuple[Array, Array]:
        new_tau, new_nu = refreshed(found, centre, without)
        tau = tau + DAMPING * used * (new_tau - tau)
        return tau, nu + DAMPING * used * (new_nu - nu)

    def sweep(_: Array, state: tuple) -> tuple:
        tau, nu = state
        covariance, mean, _, _ = belief(tau, nu)
        return refresh(tau, nu, *found_at(tau, nu, covariance, mean))

    tau, nu = jax.lax.fori_loop(0, sweeps - 1, sweep, start)
    covariance, before, rhs, log_determinant = belief(tau, nu)
    found, centre, without = found_at(tau, nu, covariance, before)
    # The evidence is stationary in the sites, so it is as good before the last sweep as after.
    joined = 1 + tau * without
    site = found.log_mass + 0.5 * jnp.log(joined)
    site = site - 0.5 * ((centre + without * nu) ** 2 / joined - centre**2) / without
    site = site + nu * linear.offset - 0.5 * tau * linear.offset**2
    evidence = jnp.sum(used * site, axis=1) + 0.5 * jnp.sum(rhs * before, axis=1)
    evidence = evidence - 0.5 * log_determinant
    # tau w = tau v / (1 - tau v) shows how much room there was.
    crowded = jnp.any(tau * without * used > 0.99 / LEAST_ROOM, axis=1)

    tau, nu = refresh(tau, nu, found, centre, without)
    covariance, mean, _, _ = belief(tau, nu)
    information = linear.information + (tau @ squares)[:, place]
    step = mean - before
    change = jnp.sqrt(jnp.maximum(jnp.einsum("kp,kpq,kq->k", step, information, step), 0.0))
    return Posterior(mean, covariance, evidence, jnp.where(crowded, jnp.inf, change))


def refreshed(found: Moments, centre: Array, without: Array) -> tuple[Array, Array]:
    """The sites (tau, nu) that reproduce moments found, beside the Gaussian without them."""
    tau = 1 / found.variance - 1 / without
    # Beyond a heavy tail's bend a site is negative; a little of that is all that EP bears.
    tau = jnp.maximum(tau, -0.2 / without)
    return tau, (tau + 1 / without) * found.mean - centre / without
