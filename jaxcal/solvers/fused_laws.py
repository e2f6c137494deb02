"""Expectation propagation on the fused pass: many problems side by side, one pass a sweep.

It is :func:`jaxcal.solvers.expectation_propagation.propagate`, sweep for sweep, which is the
reference; what is particular here is that six unknowns suffice. An image's offset q_iy - b is, to
first order in the step (v, w, d) of X and the target,

    u_i = o_i - s + q_iz w_x - q_ix w_z + (row y of M_i) d,      s = v_y + b,

so the sites never see v_x, v_z, w_y, and see v_y and the mean b only together. These four are
eliminated once, exactly, from what the measurements say (:func:`marginal`); the sweeps run on
z = (s, w_x, w_z, d), 21 + 6 sums over the images and a 6x6 inverse each; and what comes out, after
the laws' median, is carried back to all unknowns (:meth:`Marginal.lifted`).

The laws of one family share a program, and each begins with the sites of the one before. The
Gaussian law needs no sweep: its sites are the sums that the evidence step left.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.model.shapes import Family, Moments, tilted
from jaxcal.solvers import dense, unrolled
from jaxcal.solvers.expectation_propagation import (
    AHEAD,
    DAMPING,
    LEAST_ROOM,
    SWEEPS,
    refreshed,
)
from jaxcal.solvers.fused import PAIRS, total
from jaxcal.solvers.lanes import apart
from jaxcal.solvers.unrolled import Matrix, Vector

HIDDEN = (0, 2, 4)
"""v_x, v_z and w_y: the sites do not see them."""

SEEN = (1, 3, 5, 6, 7, 8)
"""v_y (as s), w_x, w_z and d."""

ELEVATION = SEEN[0]

TRIANGLE = [(i, j) for i in range(6) for j in range(i, 6)]


class Sites(eqx.Module):
    """The offsets as the sites see them, one plane (lanes, n) for every number.

    Attributes:
        direction: h_i, in the order of z. offset: o_i, mm. used: 1 for used images. lower, upper:
            least and largest u_i that are allowed, mm, or None.
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
        information: of z. gradient: of the log likelihood at z = 0. shift: the
            four others at z = 0. slope: rows B of others = shift + B z. spread: their covariance
            for given z. with_mean: 1 where there is a mean.
    """

    information: Float[Array, "6 6 lanes"]
    gradient: Float[Array, "6 lanes"]
    shift: Float[Array, "4 lanes"]
    slope: Float[Array, "4 6 lanes"]
    spread: Float[Array, "4 4 lanes"]
    with_mean: Float[Array, " lanes"]

    def lifted(
        self, mean: Float[Array, "6 lanes"], covariance: Float[Array, "6 6 lanes"]
    ) -> tuple[Float[Array, "10 lanes"], Float[Array, "10 10 lanes"]]:
        """Mean and covariance of all ten unknowns, b last, from those of z."""
        others = self.shift + dense.product_abreast(self.slope, mean)
        across = dense.product_abreast(self.slope, covariance)
        own = self.spread + dense.product_abreast(across, jnp.swapaxes(self.slope, 0, 1))
        upper = jnp.concatenate([own, across], axis=1)
        lower = jnp.concatenate([jnp.swapaxes(across, 0, 1), covariance], axis=1)
        whole, matrix = jnp.concatenate([others, mean]), jnp.concatenate([upper, lower])
        order = [*HIDDEN, 9, *SEEN]
        back = [order.index(k) for k in range(10)]
        whole = jnp.stack([whole[k] for k in back])
        matrix = jnp.stack([jnp.stack([matrix[i, j] for j in back]) for i in back])
        # From s back to v_y = s - b.
        shear = jnp.where(np.arange(10)[:, None] == ELEVATION, self.with_mean, 0.0)
        whole = whole - shear * whole[9]
        matrix = matrix - shear[:, None] * matrix[9]
        return whole, matrix - shear[None] * matrix[:, 9, None]

    def of_mean(
        self, mean: Float[Array, "6 k lanes"], covariance: Float[Array, "6 6 k lanes"]
    ) -> tuple[Float[Array, "k lanes"], Float[Array, "k lanes"], Float[Array, "6 k lanes"]]:
        """Expectation and variance of b, and its covariances with z, from beliefs about z."""
        slope = self.slope[3, :, None]
        along = jnp.sum(covariance * slope, axis=1)
        expected = self.shift[3] + jnp.sum(slope * mean, axis=0)
        return expected, self.spread[3, 3] + jnp.sum(slope * along, axis=0), along

    def held(self, mean: Float[Array, " lanes"]) -> Marginal:
        """The same where b is known."""
        share = self.spread[:, 3] / self.spread[3, 3]
        shift = self.shift + share * (mean - self.shift[3])
        slope = self.slope - share[:, None] * self.slope[3]
        spread = self.spread - share[:, None] * self.spread[3]
        return Marginal(
            self.information, self.gradient, shift, slope, spread, self.with_mean
        )  # fmt: skip


def marginal(
    information: Float[Array, "45 lanes"],
    gradient: Float[Array, "9 lanes"],
    precision: Float[Array, " lanes"],
    mean: Float[Array, " lanes"],
    with_mean: Float[Array, " lanes"],
) -> Marginal:
    """Eliminate what the sites do not see.

    Args:
        information: of X and the target in the measurements, upper triangle.
        gradient: of half the measurements' cost.
        precision: of b before the data are seen.
        mean: b here, mm.
        with_mean: 1 where there is a mean; without one its deviation is held at zero.
    """
    full = [[information[PAIRS.index((min(i, j), max(i, j)))] for j in range(9)] for i in range(9)]
    # b moves q_iy against s - v_y: in (s, b), b takes v_y's information along.
    for i in range(9):
        full[i].append(-with_mean * full[i][ELEVATION])
    full.append([full[j][9] for j in range(9)])
    full[9].append(with_mean * full[ELEVATION][ELEVATION] + precision)
    force = jnp.concatenate([-gradient, (with_mean * gradient[ELEVATION] - precision * mean)[None]])
    hidden, seen = [*HIDDEN, 9], [*SEEN]

    def block(rows: list[int], columns: list[int]) -> Array:
        return jnp.stack([jnp.stack([full[i][j] for j in columns]) for i in rows])

    own, mixed, left = apart((block(hidden, hidden), block(hidden, seen), block(seen, seen)))
    spread, _ = dense.inverse_abreast(own)
    slope = apart(-dense.product_abreast(spread, mixed))
    pull = jnp.stack([force[k] for k in hidden])
    return apart(
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
        mean, covariance: of z. log_evidence: up to a constant that the laws share.
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
        )  # fmt: skip
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
    squares: Float[Array, "45 lanes"], pull: Float[Array, "9 lanes"]
) -> tuple[Float[Array, "6 6 lanes"], Float[Array, "6 lanes"]]:
    """Of sums of h_i h_i' (upper triangle) and h_i o_i over all nine unknowns, those for z."""
    matrix = _full([squares[PAIRS.index((SEEN[i], SEEN[j]))] for i, j in TRIANGLE])
    return matrix, jnp.stack([pull[k] for k in SEEN])


def _full(flat: Vector) -> Array:
    """A symmetric 6x6 matrix from its upper triangle."""
    return jnp.stack([jnp.stack(row) for row in unrolled.symmetric(flat)])


def _solved(information: Float[Array, "6 6 lanes"], rhs: Float[Array, "6 lanes"]) -> _Belief:
    """The Gaussian of an information matrix and a right-hand side."""
    information, rhs = apart((information, rhs))
    covariance, log_determinant = apart(dense.inverse_abreast(information))
    mean = dense.product_abreast(covariance, rhs)
    return apart(_Belief(covariance, mean, information, rhs, log_determinant))


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
        tau, nu = apart((tau, nu))
        weighted = [tau * row for row in h]
        force = nu - tau * offset
        planes = [weighted[i] * h[j] for i, j in TRIANGLE]
        sums = total([*planes, *(force * row for row in h)])
        return tau, nu, _solved(information + _full(sums[:21]), gradient + jnp.stack(sums[21:]))

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
