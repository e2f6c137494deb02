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

It starts from the Gaussian law of the same SD, for which it is exact, or from the sites of the same
law with another SD, and a fixed number of sweeps is taken, so it can be differentiated like any
other array code. With it comes the evidence, the probability of the data under that law, by which
laws are compared.

Six unknowns suffice. An image's offset q_iy - b is, to first order in the step (v, w, d) of X and
the target,

    u_i = o_i - s + q_iz w_x - q_ix w_z + (row y of M_i) d,      s = v_y + b,

so the sites never see v_x, v_z, w_y nor the further unknowns, and see v_y and the mean b only
together. All these are eliminated once, exactly, from what the measurements say (:func:`marginal`);
the sweeps run on z = (s, w_x, w_z, d), 21 + 6 sums over the images and a 6x6 inverse each; and what
comes out, after the laws' median, is carried back to all unknowns (:meth:`Marginal.lifted`).

The laws of one family share a program, and each begins with the sites of the one before. The
Gaussian law needs no sweep: its sites are the sums that the evidence step left.

Reference: Minka 2001; Rasmussen and Williams 2006, section 3.6.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.model import unrolled
from jaxcal.model.batch import RIGID_UNKNOWNS, barrier, total
from jaxcal.model.shapes import Family, Moments, tilted
from jaxcal.model.unrolled import Matrix, Vector
from jaxcal.solvers import dense
from jaxcal.solvers.normal_equations import pairs, stacked

AHEAD = 3
"""Sweeps under a family's first law before the following."""

SWEEPS = 3
"""Sweeps under each law, from the sites of the one before it."""

DAMPING = 0.8

LEAST_ROOM = 1e-3
"""Least 1 - tau_i v_i: with less, what is left without site i is no Gaussian any more."""

SEEN = (1, 3, 5, 6, 7, 8)
"""v_y (as s), w_x, w_z and d: what the sites see."""

ELEVATION = SEEN[0]

TRIANGLE = pairs(len(SEEN))


def hidden(unknowns: int) -> list[int]:
    """What the sites do not see: v_x, v_z, w_y, the further unknowns, and b, which is the last."""
    return [0, 2, 4, *range(RIGID_UNKNOWNS, unknowns + 1)]


class Sites(eqx.Module):
    """The offsets as the sites see them, one plane (lanes, n) for every number.

    Attributes:
        direction: h_i, in the order of z.
        offset: o_i, mm.
        used: 1 for used images.
        lower: least u_i that is allowed, mm, or None.
        upper: largest.
    """

    direction: Vector
    offset: Float[Array, "lanes n"]
    used: Float[Array, "lanes n"]
    lower: Float[Array, "lanes n"] | None
    upper: Float[Array, "lanes n"] | None

    @classmethod
    def of(
        cls,
        q: Vector,
        turned: Matrix,
        used: Float[Array, "lanes n"],
        mean: Float[Array, " lanes"],
        bound: Float[Array, "lanes n"] | None,
    ) -> Sites:
        """From q_i and M_i, about a mean b of the offsets, within bounds on |q_iy|."""
        about = mean[:, None]
        lower, upper = (None, None) if bound is None else (-bound - about, bound - about)
        direction = [jnp.full_like(q[1], -1.0), q[2], -q[0], *turned[1]]
        return cls(direction, q[1] - about, used, lower, upper)


class Marginal(eqx.Module):
    """What the measurements say of z, and how the other unknowns follow from it; lanes last.

    Attributes:
        information: of z.
        gradient: of the log likelihood at z = 0.
        shift: the others (:func:`hidden`) at z = 0.
        slope: rows B of others = shift + B z.
        spread: their covariance for given z.
        with_mean: 1 where there is a mean.
    """

    information: Float[Array, "6 6 lanes"]
    gradient: Float[Array, "6 lanes"]
    shift: Float[Array, "h lanes"]
    slope: Float[Array, "h 6 lanes"]
    spread: Float[Array, "h h lanes"]
    with_mean: Float[Array, " lanes"]

    def lifted(
        self, mean: Float[Array, "6 lanes"], covariance: Float[Array, "6 6 lanes"]
    ) -> tuple[Float[Array, "q lanes"], Float[Array, "q q lanes"]]:
        """Mean and covariance of all unknowns, b last, from those of z."""
        others = self.shift + dense.product_abreast(self.slope, mean)
        across = dense.product_abreast(self.slope, covariance)
        own = self.spread + dense.product_abreast(across, jnp.swapaxes(self.slope, 0, 1))
        upper = jnp.concatenate([own, across], axis=1)
        lower = jnp.concatenate([jnp.swapaxes(across, 0, 1), covariance], axis=1)
        whole, matrix = jnp.concatenate([others, mean]), jnp.concatenate([upper, lower])
        size = len(whole)
        order = [*hidden(size - 1), *SEEN]
        back = [order.index(k) for k in range(size)]
        whole = jnp.stack([whole[k] for k in back])
        matrix = jnp.stack([jnp.stack([matrix[i, j] for j in back]) for i in back])
        # From s back to v_y = s - b.
        shear = jnp.where(np.arange(size)[:, None] == ELEVATION, self.with_mean, 0.0)
        whole = whole - shear * whole[-1]
        matrix = matrix - shear[:, None] * matrix[-1]
        return whole, matrix - shear[None] * matrix[:, -1, None]

    def of_mean(
        self, mean: Float[Array, "6 k lanes"], covariance: Float[Array, "6 6 k lanes"]
    ) -> tuple[Float[Array, "k lanes"], Float[Array, "k lanes"], Float[Array, "6 k lanes"]]:
        """Expectation and variance of b, and its covariances with z, from beliefs about z."""
        slope = self.slope[-1, :, None]
        along = jnp.sum(covariance * slope, axis=1)
        expected = self.shift[-1] + jnp.sum(slope * mean, axis=0)
        return expected, self.spread[-1, -1] + jnp.sum(slope * along, axis=0), along

    def held(self, mean: Float[Array, " lanes"]) -> Marginal:
        """The same where b is known."""
        share = self.spread[:, -1] / self.spread[-1, -1]
        shift = self.shift + share * (mean - self.shift[-1])
        slope = self.slope - share[:, None] * self.slope[-1]
        spread = self.spread - share[:, None] * self.spread[-1]
        return Marginal(self.information, self.gradient, shift, slope, spread, self.with_mean)


def marginal(
    information: Float[Array, "triangle lanes"],
    gradient: Float[Array, "p lanes"],
    precision: Float[Array, " lanes"],
    mean: Float[Array, " lanes"],
    with_mean: Float[Array, " lanes"],
) -> Marginal:
    """Eliminate what the sites do not see.

    Args:
        information: of X, the target and the further unknowns in the measurements, upper triangle.
        gradient: of half the measurements' cost.
        precision: of b before the data are seen.
        mean: b here, mm.
        with_mean: 1 where there is a mean; without one its deviation is held at zero.
    """
    unknowns = gradient.shape[0]
    full = unrolled.symmetric(unrolled.rows_of(information))
    # b moves q_iy against s - v_y: in (s, b), b takes v_y's information along.
    for i in range(unknowns):
        full[i].append(-with_mean * full[i][ELEVATION])
    full.append([full[j][unknowns] for j in range(unknowns)])
    full[unknowns].append(with_mean * full[ELEVATION][ELEVATION] + precision)
    force = jnp.concatenate([-gradient, (with_mean * gradient[ELEVATION] - precision * mean)[None]])
    others, seen = hidden(unknowns), [*SEEN]

    def block(rows: list[int], columns: list[int]) -> Array:
        return jnp.stack([jnp.stack([full[i][j] for j in columns]) for i in rows])

    own, mixed, left = barrier((block(others, others), block(others, seen), block(seen, seen)))
    spread, _ = dense.inverse_abreast(own)
    slope = barrier(-dense.product_abreast(spread, mixed))
    pull = jnp.stack([force[k] for k in others])
    return barrier(
        Marginal(
            left + dense.product_abreast(jnp.swapaxes(mixed, 0, 1), slope),
            jnp.stack([force[k] for k in seen])
            + dense.product_abreast(jnp.swapaxes(slope, 0, 1), pull),
            dense.product_abreast(spread, pull),
            slope,
            spread,
            with_mean,
        )
    )


class Posterior(eqx.Module):
    """The belief about z under each law.

    Attributes:
        mean: of z.
        covariance: of z.
        log_evidence: up to a constant that the laws share.
        change: length of the last sweep's move of the mean, in SDs.
    """

    mean: Float[Array, "6 k lanes"]
    covariance: Float[Array, "6 6 k lanes"]
    log_evidence: Float[Array, "k lanes"]
    change: Float[Array, "k lanes"]


def propagate(
    known: Marginal,
    sites: Sites,
    squares: Float[Array, "6 6 lanes"],
    pull: Float[Array, "6 lanes"],
    families: Sequence[Family],
    sd: Float[Array, "k lanes"],
    ahead: int = AHEAD,
    sweeps: int = SWEEPS,
) -> Posterior:
    """Belief and evidence under every law.

    Args:
        known: what the measurements say.
        sites: the offsets.
        squares: sum of h_i h_i' over the used images.
        pull: sum of h_i o_i.
        families: of the laws.
        sd: their SDs, mm; of a family with edges, the widest first.
        ahead: sweeps under a family's first law before those that each law gets.
        sweeps: how many under each law.
    """
    parts, order = [], []
    for family in dict.fromkeys(families):
        at = [k for k, name in enumerate(families) if name == family]
        found = _in_turn(
            family, jnp.stack([sd[k] for k in at]), sites, known, (squares, pull), ahead, sweeps
        )
        parts.append([jnp.moveaxis(each, 0, -2) for each in found])
        order += at
    back = [order.index(k) for k in range(len(order))]
    mean, covariance, evidence, change = (
        jnp.concatenate([part[k] for part in parts], axis=-2)[..., jnp.asarray(back), :]
        for k in range(4)
    )
    return Posterior(mean, covariance, evidence, change)


class _Belief(eqx.Module):
    covariance: Float[Array, "6 6 lanes"]
    mean: Float[Array, "6 lanes"]
    information: Float[Array, "6 6 lanes"]
    rhs: Float[Array, "6 lanes"]
    log_determinant: Float[Array, " lanes"]


def seen(
    squares: Float[Array, "triangle lanes"], pull: Float[Array, "p lanes"]
) -> tuple[Float[Array, "6 6 lanes"], Float[Array, "6 lanes"]]:
    """Of sums of h_i h_i' (upper triangle) and h_i o_i over all unknowns, those for z."""
    places = pairs(pull.shape[0])
    matrix = jnp.stack([squares[places.index((SEEN[i], SEEN[j]))] for i, j in TRIANGLE])
    return stacked(matrix), jnp.stack([pull[k] for k in SEEN])


def _solved(information: Float[Array, "6 6 lanes"], rhs: Float[Array, "6 lanes"]) -> _Belief:
    """The Gaussian of an information matrix and a right-hand side."""
    information, rhs = barrier((information, rhs))
    covariance, log_determinant = barrier(dense.inverse_abreast(information))
    mean = dense.product_abreast(covariance, rhs)
    return barrier(_Belief(covariance, mean, information, rhs, log_determinant))


def _in_turn(
    family: Family,
    sd: Float[Array, "k lanes"],
    sites: Sites,
    known: Marginal,
    sums: tuple[Float[Array, "6 6 lanes"], Float[Array, "6 lanes"]],
    ahead: int,
    sweeps: int,
) -> tuple[Array, Array, Array, Array]:
    """Mean, covariance, log evidence and last change under laws of one family, one by one."""
    h, offset, used = sites.direction, sites.offset, sites.used
    information, gradient = known.information, known.gradient

    def begun(sd: Array) -> tuple[Array, Array, _Belief]:
        """The sites of the Gaussian law."""
        squares, pull = sums
        tau = used / (sd * sd)[:, None]
        belief = _solved(information + squares / sd**2, gradient - pull / sd**2)
        return tau, jnp.zeros_like(tau), belief

    def cavity(tau: Array, nu: Array, belief: _Belief) -> tuple[Array, Array]:
        entry = belief.covariance[..., None]
        doubled = [
            unrolled.add(*((1 if i == j else 2) * entry[i, j] * h[j] for j in range(i, 6)))
            for i in range(6)
        ]
        variance = unrolled.dot(h, doubled)
        at = offset + unrolled.dot(h, [row[:, None] for row in belief.mean])
        shrink = 1 / jnp.maximum(1 - tau * variance, LEAST_ROOM)
        centre = shrink * (at - variance * nu)
        return centre, jnp.where(used > 0, variance * shrink, 1.0)

    def moments(sd: Array, tau: Array, nu: Array, belief: _Belief) -> tuple[Moments, Array, Array]:
        centre, without = cavity(tau, nu, belief)
        found = tilted(family, sd, centre, without, sites.lower, sites.upper)
        return found, centre, without

    def refresh(
        tau: Array, nu: Array, before: _Belief, found: Moments, centre: Array, without: Array
    ) -> tuple[Array, Array, _Belief]:
        new_tau, new_nu = refreshed(found, centre, without)
        tau = tau + DAMPING * used * (new_tau - tau)
        nu = nu + DAMPING * used * (new_nu - nu)
        tau, nu = barrier((tau, nu))
        weighted = [tau * row for row in h]
        force = nu - tau * offset
        planes = [weighted[i] * h[j] for i, j in TRIANGLE]
        sums = total([*planes, *(force * row for row in h)])
        return (
            tau,
            nu,
            _solved(information + stacked(jnp.stack(sums[:21])), gradient + jnp.stack(sums[21:])),
        )

    def swept(times: int, sd: Array, state: tuple) -> tuple:
        def sweep(_: Array, state: tuple) -> tuple:
            tau, nu, belief = state
            return refresh(tau, nu, belief, *moments(sd, tau, nu, belief))

        return jax.lax.fori_loop(0, times, sweep, state)

    def judged(sd: Array, state: tuple) -> tuple[Array, Array, tuple[Moments, Array, Array]]:
        """Log evidence, whether a site leaves nothing for the others, and what was found."""
        tau, nu, belief = state
        found, centre, without = moments(sd, tau, nu, belief)
        # The evidence is stationary in the sites, so it is as good before the last sweep as after.
        joined = 1 + tau * without
        site = found.log_mass + 0.5 * jnp.log(joined)
        site = site - 0.5 * ((centre + without * nu) ** 2 / joined - centre**2) / without
        site = site + nu * offset - 0.5 * tau * offset**2
        gained = jnp.sum(belief.rhs * belief.mean, axis=0)
        crowded = jnp.where(tau * without > 0.99 / LEAST_ROOM, used, 0.0)
        site, crowded = total([used * site, crowded])
        evidence = site + 0.5 * gained - 0.5 * belief.log_determinant
        return evidence, crowded > 0, (found, centre, without)

    def law(state: tuple, sd: Array) -> tuple[tuple, tuple[Array, Array, Array, Array]]:
        tau, nu, before = state = swept(sweeps - 1, sd, state)
        evidence, crowded, found = judged(sd, state)
        after = refresh(tau, nu, before, *found)
        belief = after[-1]
        step = belief.mean - before.mean
        length = jnp.sum(step * dense.product_abreast(belief.information, step), axis=0)
        change = jnp.where(crowded, jnp.inf, jnp.sqrt(jnp.maximum(length, 0.0)))
        return after, (belief.mean, belief.covariance, evidence, change)

    def exact(sd: Array) -> tuple[Array, Array, Array, Array]:
        state = begun(sd)
        evidence, crowded, _ = judged(sd, state)
        belief = state[-1]
        return belief.mean, belief.covariance, evidence, jnp.where(crowded, jnp.inf, 0.0)

    # One after the other: side by side they would not stay in the second-level cache.
    if family == "gaussian" and sites.lower is None:
        return jax.lax.map(exact, sd)
    return jax.lax.scan(law, swept(ahead, sd[0], begun(sd[0])), sd)[1]


def refreshed(found: Moments, centre: Array, without: Array) -> tuple[Array, Array]:
    """The sites (tau, nu) that reproduce moments found, beside the Gaussian without them."""
    tau = 1 / found.variance - 1 / without
    # Beyond a heavy tail's bend a site is negative; a little of that is all that EP bears.
    tau = jnp.maximum(tau, -0.2 / without)
    return tau, (tau + 1 / without) * found.mean - centre / without
