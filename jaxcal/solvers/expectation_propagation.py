"""Expectation propagation: unknowns that are Gaussian except for the law of the offsets.

Linearised, the measurements' likelihood of the unknowns x (X, target, the offsets' mean and all
others) is the Gaussian exp(-x' L x / 2 + e' x), and image i's offset is u_i = o_i + h_i' x. The law
p(u_i) is not Gaussian. Expectation propagation (EP) replaces it by a Gaussian *site*,
exp(nu_i u - tau_i u^2 / 2), chosen so that u_i keeps the mean and variance that it has under all
the other sites times the true law:

    C = (L + sum tau_i h_i h_i')^-1,  m = C (e + sum (nu_i - tau_i o_i) h_i)       the belief now
    v_i = h_i' C h_i,  1/w_i = 1/v_i - tau_i,                                      without site i
    c_i = w_i ((o_i + h_i' m) / v_i - nu_i)
    mass Z_i, mean and variance of p(u) N(u; c_i, w_i)                             a quadrature
    tau_i <- 1/variance - 1/w_i,  nu_i <- mean/variance - c_i/w_i                  all i, damped

It starts from the Gaussian law of the same SD, which needs no sweep, or from the sites of the same
law with another SD. The number of sweeps is fixed, so it can be differentiated like any other array
code. It also gives the evidence, the probability of the data under that law, by which laws are
compared.

Six unknowns suffice. An image's offset q_iy - b is, to first order in the step (v, w, d) of X and
the target,

    u_i = o_i - s + q_iz w_x - q_ix w_z + (row y of M_i) d,      s = v_y + b,

so the sites do not depend on v_x, v_z, w_y or the further unknowns, and on v_y and the mean b only
by their sum s. All other unknowns are eliminated once, exactly, from the measurements' likelihood
(:func:`marginal`). The sweeps run on z = (s, w_x, w_z, d); each takes 21 + 6 sums over the images
and a 6x6 inverse. The result under each law is carried back to all unknowns
(:meth:`Marginal.lifted`).

All laws share one program, in which only the quadratures of the moments differ. Within a family,
each law starts with the sites of the law before it.

Reference: Minka 2001; Rasmussen and Williams 2006, section 3.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.model import unrolled
from jaxcal.model.batch import barrier, picked, total
from jaxcal.model.shapes import Family, Interval, Moments, tilted
from jaxcal.model.unknowns import RIGID_UNKNOWNS
from jaxcal.model.unrolled import Matrix, Vector
from jaxcal.runtime.compiler import traced_once
from jaxcal.solvers import dense
from jaxcal.solvers.normal_equations import V_Y, pairs, square_indices, stacked

SWEEPS = 3
"""Sweeps under each law, from the sites of the law before; a family's first gets twice as many."""

DAMPING = 0.8

LEAST_ROOM = 1e-3
"""Least 1 - tau_i v_i: at zero, the belief without site i is no Gaussian any more."""

SITE_UNKNOWNS = (V_Y, 3, 5, 6, 7, 8)
"""v_y (as s), w_x, w_z and d: the unknowns on which the sites depend."""

TRIANGLE = pairs(len(SITE_UNKNOWNS))


def eliminated(unknowns: int) -> list[int]:
    """The unknowns that z leaves out: v_x, v_z, w_y, the further unknowns and, last of all, b."""
    return [0, 2, 4, *range(RIGID_UNKNOWNS, unknowns + 1)]


class Sites(eqx.Module):
    """The offsets as the sites see them, one plane (batch, n) for every number.

    Attributes:
        direction: h_i, in the order of z.
        offset: o_i, mm.
        used: 1 for used images.
        interval: where u_i may lie, or None.
    """

    direction: Vector
    offset: Float[Array, "batch n"]
    used: Float[Array, "batch n"]
    interval: Interval | None

    @classmethod
    def of(
        cls,
        q: Vector,
        tracker_to_image: Matrix,
        used: Float[Array, "batch n"],
        mean: Float[Array, " batch"],
        bound: Float[Array, "batch n"] | None,
    ) -> Sites:
        """From q_i and M_i, about a mean b of the offsets, within bounds on |q_iy|."""
        about = mean[:, None]
        interval = None if bound is None else (-bound - about, bound - about)
        direction = [jnp.full_like(q[1], -1.0), q[2], -q[0], *tracker_to_image[1]]
        return cls(direction, q[1] - about, used, interval)

    @jax.jit
    def variance(self, covariance: Float[Array, "6 6 batch"]) -> Float[Array, "batch n"]:
        """h_i' C h_i, mm^2: the variance of every image's offset."""
        h, size = self.direction, len(self.direction)
        # Of the entries off the diagonal both are counted at once.
        both = 2.0 - np.eye(size, dtype=covariance.dtype)
        entry = (both[..., None] * covariance)[..., None]
        doubled = [unrolled.add(*(entry[i, j] * h[j] for j in range(i, size))) for i in range(size)]
        return unrolled.dot(h, doubled)


class Marginal(eqx.Module):
    """What the measurements say of z, and how the other unknowns follow from it; batch axis last.

    Attributes:
        information: of z.
        gradient: of the log likelihood at z = 0.
        shift: the others (:func:`eliminated`) at z = 0.
        slope: rows B of others = shift + B z.
        spread: their covariance for given z.
    """

    information: Float[Array, "6 6 batch"]
    gradient: Float[Array, "6 batch"]
    shift: Float[Array, "h batch"]
    slope: Float[Array, "h 6 batch"]
    spread: Float[Array, "h h batch"]

    def lifted(
        self, mean: Float[Array, "6 k batch"], covariance: Float[Array, "6 6 k batch"]
    ) -> tuple[Float[Array, "q k batch"], Float[Array, "q q k batch"]]:
        """Mean and covariance of all unknowns, b last, from those of z.

        They are x = shift + slope z, with a spread for given z.
        """
        size = len(SITE_UNKNOWNS)
        eye = jnp.eye(size, dtype=self.gradient.dtype)[..., None]
        seen = jnp.broadcast_to(eye, (size, *self.gradient.shape))
        shift = jnp.concatenate([self.shift, jnp.zeros_like(self.gradient)])
        slope = jnp.concatenate([self.slope, seen])
        spread = jnp.pad(self.spread, [(0, size), (0, size), (0, 0)])
        order = [*eliminated(len(shift) - 1), *SITE_UNKNOWNS]
        back = np.argsort(order)
        whole = jnp.concatenate([shift[:, None], slope, spread], axis=1)[back]
        # From s back to v_y = s - b.
        whole = whole - (np.arange(len(back)) == V_Y)[:, None, None] * whole[-1]
        spread = whole[:, 1 + size :][:, back]
        sheared = (np.arange(len(back)) == V_Y)[None, :, None]
        spread = spread - sheared * spread[:, -1, None]
        shift, slope, spread = barrier((whole[:, 0], whole[:, 1 : 1 + size], spread))
        slope = slope[:, :, None]
        found = shift[:, None] + dense.product_batch_last(slope, mean)
        across = barrier(dense.product_batch_last(slope, covariance))
        back = jnp.swapaxes(slope, 0, 1)
        return found, spread[:, :, None] + dense.product_batch_last(across, back)


def marginal(
    information: Float[Array, "triangle batch"],
    gradient: Float[Array, "p batch"],
    precision: Float[Array, " batch"],
    mean: Float[Array, " batch"],
) -> Marginal:
    """Eliminate the unknowns that z leaves out (:func:`eliminated`).

    Args:
        information: of X, the target and the further unknowns in the measurements, upper triangle.
        gradient: of half the measurements' cost.
        precision: of b before the data are seen.
        mean: b here, mm.
    """
    unknowns = gradient.shape[0]
    # With v_y = s - b, b has the rows and columns of v_y, with the opposite sign.
    order = np.array([*eliminated(unknowns), *SITE_UNKNOWNS])
    is_mean = order == unknowns
    from_flat = np.where(is_mean, V_Y, order)
    indices = square_indices(unknowns)[np.ix_(from_flat, from_flat)]
    sign = np.where(is_mean, -1, 1).astype(information.dtype)
    last = is_mean[:, None, None] & is_mean[:, None]
    full = picked(information, indices) * (sign[:, None] * sign)[..., None]
    full = full + jnp.where(last, precision, 0.0)
    force = -picked(gradient, from_flat) * sign[:, None]
    force = force - jnp.where(is_mean[:, None], precision * mean, 0.0)
    count = len(order) - len(SITE_UNKNOWNS)
    own, mixed, left = barrier((full[:count, :count], full[:count, count:], full[count:, count:]))
    spread, _ = dense.inverse_batch_last(own)
    slope = barrier(-dense.product_batch_last(spread, mixed))
    pull = force[:count]
    return barrier(
        Marginal(
            left + dense.product_batch_last(jnp.swapaxes(mixed, 0, 1), slope),
            force[count:] + dense.product_batch_last(jnp.swapaxes(slope, 0, 1), pull),
            dense.product_batch_last(spread, pull),
            slope,
            spread,
        )
    )


class Posterior(eqx.Module):
    """The belief about z under a law, or under each of k laws.

    Attributes:
        mean: of z.
        covariance: of z.
        log_evidence: up to a constant that the laws share.
        log_evidence_change: by how much the last sweep but one changed it.
        change: length of the last sweep's move of the mean, in SDs.
    """

    mean: Float[Array, "6 *k batch"]
    covariance: Float[Array, "6 6 *k batch"]
    log_evidence: Float[Array, "*k batch"]
    log_evidence_change: Float[Array, "*k batch"]
    change: Float[Array, "*k batch"]


def propagate(
    known: Marginal,
    sites: Sites,
    squares: Float[Array, "6 6 batch"],
    pull: Float[Array, "6 batch"],
    families: Sequence[Family],
    sd: Float[Array, "k batch"],
    sweeps: int = SWEEPS,
) -> Posterior:
    """Belief and evidence under every law, one law after the other.

    All laws side by side would not fit in the second-level cache.

    Args:
        known: what the measurements say.
        sites: the offsets.
        squares: sum of h_i h_i' over the used images.
        pull: sum of h_i o_i.
        families: of the laws.
        sd: their SDs, mm; in a family with edges, the widest first.
        sweeps: how many under each law; the first of a family gets twice as many, since each of the
            others starts with the sites of the law before it.
    """
    plan = _Schedule.of(families, cut=sites.interval is not None)
    under = _Laws(plan.names, sites, known, squares, pull)
    parts: list[Posterior] = []
    if plan.turns:
        family, law, fresh = (jnp.asarray(column) for column in zip(*plan.turns, strict=True))
        # The first turn starts afresh, so it does not use this state.
        gaussian, start = traced_once(under.gaussian, sd[0])

        def one(state: _Propagation, turn: tuple) -> tuple[_Propagation, Posterior]:
            family, sd, fresh = turn
            state = jax.lax.cond(fresh, lambda: gaussian(sd), lambda: state)
            return under.swept(family, sd, state, sweeps)

        parts.append(jax.lax.scan(one, start, (family, sd[law], fresh))[1])
    for k in plan.exact:
        parts.append(jax.tree.map(lambda leaf: leaf[None], under.under_gaussian(sd[k])))
    order = jnp.asarray(plan.order)
    return barrier(
        jax.tree.map(lambda *leaf: jnp.moveaxis(jnp.concatenate(leaf)[order], 0, -2), *parts)
    )


@dataclass(frozen=True)
class _Schedule:
    """In which order the laws are swept.

    Attributes:
        names: families whose laws need sweeps.
        turns: (index in ``names``, number of the law, whether it starts afresh), one after the
            other. The first law of a family has two turns, and each of the others starts with the
            sites of the law before it.
        exact: numbers of the laws that need no sweep; their results follow those of the turns.
        order: for every law, which of these results is its own.
    """

    names: tuple[Family, ...]
    turns: list[tuple[int, int, bool]]
    exact: list[int]
    order: list[int]

    @classmethod
    def of(cls, families: Sequence[Family], *, cut: bool) -> _Schedule:
        """The schedule of laws; ``cut``: the offsets are confined to intervals."""
        # Under the Gaussian law the first sites are exact, unless it is cut.
        exact = [k for k, name in enumerate(families) if name == "gaussian" and not cut]
        swept: list[Family] = [name for k, name in enumerate(families) if k not in exact]
        names = tuple(dict.fromkeys(swept))
        turns: list[tuple[int, int, bool]] = []
        place: dict[int, int] = {}
        for which, name in enumerate(names):
            laws = [k for k, family in enumerate(families) if family == name]
            turns.append((which, laws[0], True))
            for k in laws:
                place[k] = len(turns)
                turns.append((which, k, False))
        place |= {k: len(turns) + position for position, k in enumerate(exact)}
        return cls(names, turns, exact, [place[k] for k in range(len(families))])


class _Belief(eqx.Module):
    covariance: Float[Array, "6 6 batch"]
    mean: Float[Array, "6 batch"]
    information: Float[Array, "6 6 batch"]
    rhs: Float[Array, "6 batch"]
    log_determinant: Float[Array, " batch"]

    def evidence(self, site: Float[Array, " batch"]) -> Float[Array, " batch"]:
        """The log evidence, from the sites' part of it."""
        gained = jnp.sum(self.rhs * self.mean, axis=0)
        return site + 0.5 * gained - 0.5 * self.log_determinant


class _Propagation(eqx.Module):
    """The sites (tau, nu) of every image, and the belief that they make."""

    tau: Float[Array, "batch n"]
    nu: Float[Array, "batch n"]
    belief: _Belief


def site_part(
    squares: Float[Array, "triangle batch"], pull: Float[Array, "p batch"]
) -> tuple[Float[Array, "6 6 batch"], Float[Array, "6 batch"]]:
    """The parts for z of sums of h_i h_i' (upper triangle) and h_i o_i over all unknowns."""
    at = np.array(SITE_UNKNOWNS)
    return picked(squares, square_indices(pull.shape[0])[np.ix_(at, at)]), picked(pull, at)


def _solved(information: Float[Array, "6 6 batch"], rhs: Float[Array, "6 batch"]) -> _Belief:
    """The Gaussian of an information matrix and a right-hand side."""
    information, rhs = barrier((information, rhs))
    covariance, log_determinant = barrier(dense.inverse_batch_last(information))
    mean = dense.product_batch_last(covariance, rhs)
    return barrier(_Belief(covariance, mean, information, rhs, log_determinant))


class _Laws(eqx.Module):
    """The problem, and what one law's sweeps do to the sites."""

    families: Sequence[Family] = eqx.field(static=True)
    sites: Sites
    known: Marginal
    squares: Float[Array, "6 6 batch"]
    pull: Float[Array, "6 batch"]

    def gaussian(self, sd: Float[Array, " batch"]) -> _Propagation:
        """The sites of the Gaussian law."""
        tau = self.sites.used / (sd * sd)[:, None]
        belief = _solved(
            self.known.information + self.squares / sd**2, self.known.gradient - self.pull / sd**2
        )
        return _Propagation(tau, jnp.zeros_like(tau), belief)

    def under_gaussian(self, sd: Float[Array, " batch"]) -> Posterior:
        """The result under the Gaussian law itself."""
        belief = self.gaussian(sd).belief
        used, square = total([self.sites.used, self.sites.used * self.sites.offset**2])
        site = -0.5 * (used * jnp.log(2 * np.pi * sd**2) + square / sd**2)
        none = jnp.zeros_like(sd)
        return Posterior(belief.mean, belief.covariance, belief.evidence(site), none, none)

    def swept(
        self, family: Array, sd: Float[Array, " batch"], state: _Propagation, sweeps: int
    ) -> tuple[_Propagation, Posterior]:
        """Take ``sweeps`` sweeps under a law; the evidence is that before the last one."""

        def sweep(k: Array, carry: tuple) -> tuple:
            before, (earlier, _, _) = carry
            after, evidence, dominated = self.sweep(family, sd, before, k >= sweeps - 2)
            step = after.belief.mean - before.belief.mean
            length = jnp.sum(
                step * dense.product_batch_last(after.belief.information, step), axis=0
            )
            change = jnp.where(dominated, jnp.inf, jnp.sqrt(jnp.maximum(length, 0.0)))
            return after, (evidence, evidence - earlier, change)

        none = jnp.zeros_like(sd)
        state, found = jax.lax.fori_loop(0, sweeps, sweep, (state, (none, none, none)))
        return state, Posterior(state.belief.mean, state.belief.covariance, *found)

    def sweep(
        self, family: Array, sd: Float[Array, " batch"], state: _Propagation, late: Array
    ) -> tuple[_Propagation, Array, Array]:
        """Update all sites once; the log evidence before, and where a site dominates the others.

        These two are computed in the last two sweeps, and are without meaning in the others.
        """
        h, offset, used = self.sites.direction, self.sites.offset, self.sites.used
        tau, nu, belief = state.tau, state.nu, state.belief
        variance = self.sites.variance(belief.covariance)
        at = offset + unrolled.dot(h, unrolled.rows_of(belief.mean[..., None]))
        shrink = 1 / jnp.maximum(1 - tau * variance, LEAST_ROOM)
        centre = shrink * (at - variance * nu)
        without = jnp.where(used > 0, variance * shrink, 1.0)
        centre, without = barrier((centre, without))
        ways = [partial(tilted, name, interval=self.sites.interval) for name in self.families]
        found = jax.lax.switch(family, ways, sd, centre, without)

        def judged() -> tuple[Array, ...]:
            joined = 1 + tau * without
            site = found.log_factor + jnp.log(found.mass * jnp.sqrt(joined))
            site = site - 0.5 * ((centre + without * nu) ** 2 / joined - centre**2) / without
            site = site + nu * offset - 0.5 * tau * offset**2
            dominated = jnp.where(tau * without > 0.99 / LEAST_ROOM, used, 0.0)
            return tuple(total([used * site, dominated]))

        # The evidence is stationary in the sites, so it is as good before the last sweep as after.
        none = jnp.zeros_like(sd)
        site, dominated = jax.lax.cond(late, judged, lambda: (none, none))

        new_tau, new_nu = refreshed(found, centre, without)
        tau = tau + DAMPING * used * (new_tau - tau)
        nu = nu + DAMPING * used * (new_nu - nu)
        tau, nu = barrier((tau, nu))
        weighted = [tau * row for row in h]
        force = nu - tau * offset
        planes = [weighted[i] * h[j] for i, j in TRIANGLE]
        sums = total([*planes, *(force * row for row in h)])
        evidence = belief.evidence(site)
        size = len(TRIANGLE)
        after = _solved(
            self.known.information + stacked(unrolled.as_array(sums[:size])),
            self.known.gradient + unrolled.as_array(sums[size:]),
        )
        return _Propagation(tau, nu, after), evidence, dominated > 0


def refreshed(found: Moments, centre: Array, without: Array) -> tuple[Array, Array]:
    """The sites (tau, nu) that reproduce the given moments, times the Gaussian without them."""
    tau = 1 / found.variance - 1 / without
    # Far out in a heavy tail a site's tau is negative; EP tolerates only a little of that.
    tau = jnp.maximum(tau, -0.2 / without)
    return tau, (tau + 1 / without) * found.mean - centre / without
