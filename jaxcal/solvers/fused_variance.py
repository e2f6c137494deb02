"""Self-tuning (:mod:`jaxcal.solvers.variance`) with one pass over the images a round.

The pass keeps the three components apart: per component k (lateral position, range, offset) the sum
of squares rss_k, the gradient g_k and the Gauss-Newton matrix N_k of the unweighted residuals, and
once, with the weights of the round, the rest C of the exact second derivatives. To first order in
the step d that is all there is to know, whatever the SDs:

    H(s) = sum N_k / s_k^2,      d(s) = -(H(s) + C)^-1 sum g_k / s_k^2,
    rss_k(d) = rss_k + 2 g_k' d + d' N_k d,
    s_k^2 <- rss_k(d) / (n - tr(H(s)^-1 N_k) / s_k^2),

so the SDs are updated a few times on these sums alone, the step that belongs to them is taken, and
the next pass tells the truth. Steps are accepted by the decrease of the weighted cost with the new
SDs, and damped as everywhere. A lane has arrived when, at one and the same place, the update leaves
the SDs and the gradient leaves the unknowns where they are: the fixed point of Helmert's iteration
that the reference finds by whole solves between two updates.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcal.solvers import unrolled
from jaxcal.solvers.fused import (
    PAIRS,
    UNKNOWNS,
    Guess,
    Images,
    Term,
    contributions,
    targets,
    total,
    with_twist,
)
from jaxcal.solvers.lanes import IDLE, apart, choose, default_tolerance
from jaxcal.solvers.unrolled import Matrix, Vector, symmetric
from jaxcal.solvers.variance import MINIMUM_SELF_TUNING, with_floor

GATE = 0.03
"""Gradient cosine below which second derivatives are exact."""

UPDATES = 3
"""Updates of the SDs on the sums of one pass."""

COMPONENTS = 3

DIAGONAL = np.array([PAIRS.index((k, k)) for k in range(UNKNOWNS)])


class Sums(eqx.Module):
    """What one pass leaves of the images, lanes last.

    Attributes:
        squares: rss_k, mm^2. gradient: g_k. matrix: N_k, upper triangles. curvature: C.
    """

    squares: Float[Array, "3 lanes"]
    gradient: Float[Array, "3 9 lanes"]
    matrix: Float[Array, "3 45 lanes"]
    curvature: Float[Array, "45 lanes"]


class Tuned(eqx.Module):
    """The state of every lane; at the end, its answer.

    Attributes:
        guess: X and c. sigma: the SDs, mm. updated: the SDs after one more update there. cost: of
            the weighted residuals. change: largest relative change of the SDs by that update.
            cosine: gradient cosine. candidate: the place to look at next. proposed: the SDs there.
            again: whether that is the guess once more, with more damping. weighed: the SDs that
            belong to the step to the candidate. half: half the cost before it, with these.
            predicted: how much less it should be after it. gate: 1 where the step came from exact
            second derivatives. damping: Marquardt's lambda. idle: steps without a gain. rounds:
            passes. settled: arrived, as far as rounding allows. active: whether a lane goes on.
    """

    guess: Guess
    sigma: Float[Array, "3 lanes"]
    updated: Float[Array, "3 lanes"]
    cost: Float[Array, " lanes"]
    change: Float[Array, " lanes"]
    cosine: Float[Array, " lanes"]
    candidate: Guess
    proposed: Float[Array, "3 lanes"]
    again: Bool[Array, " lanes"]
    weighed: Float[Array, "3 lanes"]
    half: Float[Array, " lanes"]
    predicted: Float[Array, " lanes"]
    gate: Float[Array, " lanes"]
    damping: Float[Array, " lanes"]
    idle: Int[Array, " lanes"]
    rounds: Int[Array, " lanes"]
    settled: Bool[Array, " lanes"]
    active: Bool[Array, " lanes"]

    @classmethod
    def before(cls, start: Guess) -> Tuned:
        """Nothing looked at yet; with infinite SDs, C vanishes."""
        number = jnp.zeros_like(start.point[0])
        no, count = jnp.zeros(number.shape, bool), jnp.zeros(number.shape, jnp.int32)
        sigma = jnp.zeros_like(start.point) + jnp.inf
        return cls(
            guess=start, sigma=sigma, updated=sigma, cost=number, change=number, cosine=number,
            candidate=start, proposed=sigma, again=~no, weighed=sigma, half=number,
            predicted=number, gate=number, damping=number + 1e-6, idle=count, rounds=count,
            settled=no, active=~no,
        )  # fmt: skip


def components(guess: Guess, images: Images, sigma: Float[Array, "3 lanes"] | None) -> Sums:
    """One pass at a guess; C with the given SDs, or left out (zeros)."""
    q, turned = targets(guess, images)
    square = q[1] * q[1] + q[2] * q[2]
    inverse = jax.lax.rsqrt(square)
    along = [q[1] * inverse, q[2] * inverse]
    mask = images.mask
    errors = [q[0] - images.lateral, square * inverse - images.distance, q[1]]
    pull = [mask * error for error in errors]
    slope = [mask * along[0], mask * along[1]]
    terms = [
        Term(pull[0] * errors[0], [pull[0], 0, 0], [[mask, 0, 0], [0, 0, 0], [0, 0, 0]]),
        Term(
            pull[1] * errors[1],
            [0, pull[1] * along[0], pull[1] * along[1]],
            [
                [0, 0, 0],
                [0, slope[0] * along[0], slope[0] * along[1]],
                [0, slope[1] * along[0], slope[1] * along[1]],
            ],
        ),
        Term(pull[2] * errors[2], [0, pull[2], 0], [[0, 0, 0], [0, mask, 0], [0, 0, 0]]),
    ]
    planes: Vector = [term.cost for term in terms]
    for term in terms:
        matrix, gradient = contributions(q, turned, term, 0)
        planes += [*gradient, *matrix]
    if sigma is not None:
        weight = [(1 / (sd * sd))[:, None] for sd in sigma]
        bend = weight[1] * pull[1] * inverse
        mixed = -bend * along[0] * along[1]
        # Along the circle the range curves: what it has across the line of sight.
        bent = [[0, 0, 0], [0, bend * along[1] ** 2, mixed], [0, mixed, bend * along[0] ** 2]]
        weighted = [
            weight[0] * pull[0],
            weight[1] * pull[1] * along[0] + weight[2] * pull[2],
            weight[1] * pull[1] * along[1],
        ]
        planes += contributions(q, turned, Term(terms[0].cost, weighted, bent), 1)[0]
    sums = total(planes)
    squares, sums = sums[:3], sums[3:]
    each = UNKNOWNS + len(PAIRS)
    parts = [sums[k * each : (k + 1) * each] for k in range(COMPONENTS)]
    gradient = [part[:UNKNOWNS] for part in parts]
    if sigma is None:
        curvature = [jnp.zeros_like(squares[0])] * len(PAIRS)
    else:
        along = _weighted([row[:6] for row in gradient], 1 / sigma**2)
        curvature = with_twist(sums[COMPONENTS * each :], along)
    return Sums(
        jnp.stack(squares),
        jnp.stack([jnp.stack(row) for row in gradient]),
        jnp.stack([jnp.stack(part[UNKNOWNS:]) for part in parts]),
        jnp.stack(curvature),
    )


def _weighted(rows: list[Vector], weight: Float[Array, "3 lanes"]) -> Vector:
    """Sum over the components of weight times each entry."""
    return [
        unrolled.add(*(unrolled.times(w, row[k]) for w, row in zip(weight, rows, strict=True)))
        for k in range(len(rows[0]))
    ]


class _Model(eqx.Module):
    """The sums as rows of lanes."""

    squares: Vector
    gradient: list[Vector]
    matrix: list[Vector]
    curvature: Vector

    @classmethod
    def of(cls, sums: Sums) -> _Model:
        """Unpack."""
        return cls(
            unrolled.rows_of(sums.squares),
            [unrolled.rows_of(row) for row in sums.gradient],
            [unrolled.rows_of(row) for row in sums.matrix],
            unrolled.rows_of(sums.curvature),
        )

    def step(
        self, weight: Float[Array, "3 lanes"], damping: Array, gate: Array
    ) -> tuple[Vector, Matrix, Vector]:
        """The step, the matrix and the gradient with given weights; NaN where indefinite."""
        flat = together(_weighted(self.matrix, weight))
        gradient = together(_weighted(self.gradient, weight))
        full = symmetric([h + gate * c for h, c in zip(flat, self.curvature, strict=True)])
        plain = symmetric(flat)
        for k in range(UNKNOWNS):
            full[k][k] = full[k][k] + damping * jnp.where(plain[k][k] > 0, plain[k][k], 1.0)
        flat = together([full[i][j] for i, j in PAIRS])
        return together(unrolled.solve(symmetric(flat), [-g for g in gradient])), plain, gradient

    def updated(
        self,
        sigma: Float[Array, "3 lanes"],
        move: Vector,
        plain: Matrix,
        used: Float[Array, " lanes"],
    ) -> Float[Array, "3 lanes"]:
        """Helmert's update after a step."""
        eps = jnp.finfo(used.dtype).eps
        scale = [jax.lax.rsqrt(jnp.where(plain[k][k] > 0, plain[k][k], 1.0)) for k in range(9)]
        scale = together(scale)

        def scaled(flat: Vector) -> Matrix:
            return symmetric(
                [v * scale[i] * scale[j] for (i, j), v in zip(PAIRS, flat, strict=True)]
            )

        unit = symmetric(together(unrolled.upper(scaled(unrolled.upper(plain)))))
        for k in range(UNKNOWNS):
            unit[k][k] = unit[k][k] + 16 * eps
        leverage = unrolled.traces(unit, [scaled(matrix) for matrix in self.matrix])
        found = []
        for k in range(COMPONENTS):
            bent = [
                (1 if i == j else 2) * entry * move[i] * move[j]
                for (i, j), entry in zip(PAIRS, self.matrix[k], strict=True)
            ]
            left = self.squares[k] + 2 * unrolled.dot(self.gradient[k], move) + sum(bent)
            freedom = jnp.maximum(used - leverage[k] / sigma[k] ** 2, 0.05 * used)
            found.append(jnp.sqrt(jnp.maximum(left, 0.0) / freedom))
        return with_floor(jnp.stack(found))


def together(entries: Vector) -> Vector:
    """The same entries, computed here and once."""
    return unrolled.rows_of(apart(jnp.stack(entries)))


def self_tuned(
    start: Guess,
    held: Float[Array, "3 lanes"],
    images: Images,
    *,
    tolerance: float | None = None,
    max_rounds: int = 100,
) -> Tuned:
    """Solve every lane with a Gaussian belief, its SDs estimated by REML.

    Args:
        start: a conventional fit.
        held: the SDs of lanes with too few images (fewer than 8 used ones) to estimate them, mm.
        images: the data.
        tolerance: relative change of the SDs to stop at; 1e-9 in float64, 1e-4 in float32. The
            gradient cosine stops at a tenth of it (at the same in float32).
        max_rounds: most passes.
    """
    used = images.used
    standing = default_tolerance(images.mask.dtype)
    tolerance = max(10 * standing, 1e-9) if tolerance is None else tolerance
    enough = used >= MINIMUM_SELF_TUNING
    reach = jnp.max(jnp.abs(images.origin) * images.mask, axis=(0, 2))
    reach = jnp.maximum(reach, jnp.max(jnp.abs(start.point), axis=0))
    eps = jnp.finfo(reach.dtype).eps
    reach, used, enough = apart((eps * reach, used, enough))

    def update(sums: Sums, sigma: Array, damping: Array, gate: Array) -> tuple[Array, ...]:
        """The step that belongs to SDs, the SDs after it, and where the matrix was indefinite."""
        model = _Model.of(sums)
        move, plain, _ = model.step(1 / sigma**2, damping, gate)
        lost = jnp.logical_not(jnp.isfinite(sum(move)))
        move = [jnp.where(lost, 0.0, value) for value in move]
        after = apart(model.updated(sigma, move, plain, used))
        after = jnp.where(enough & jnp.isfinite(after), after, jnp.where(enough, sigma, held))
        return jnp.stack(move), after, lost

    def judge(guess: Guess, sums: Sums, sigma: Array) -> tuple[Array, Array]:
        """The weighted cost and the gradient cosine."""
        weight = 1 / sigma**2
        cost = jnp.sum(weight * sums.squares, axis=0)
        gradient = jnp.sum(weight[:, None] * sums.gradient, axis=0)
        diagonal = jnp.sum(weight[:, None] * sums.matrix[:, DIAGONAL], axis=0)
        length = jnp.sqrt(diagonal * cost)
        cosine = jnp.max(jnp.abs(gradient) / jnp.where(length > 0, length, 1.0), axis=0)
        rounding = reach / jnp.min(sigma, axis=0)
        vanished = cost <= 3 * images.mask.shape[1] * (2 * rounding) ** 2
        return cost, jnp.where(vanished, 0.0, jnp.where(jnp.isfinite(cost), cosine, jnp.nan))

    def propose(sums: Sums, sigma: Array, damping: Array, gate: Array) -> tuple[Array, ...]:
        """What the sums of a place say of the next: a few updates of the SDs and their step."""

        def again(carry: tuple) -> tuple:
            count, sigma, _, _, first, gate, _ = carry
            move, after, lost = update(sums, sigma, damping, gate)
            first = jnp.where(count == 0, after, first)
            return count + 1, after, sigma, move, first, jnp.where(lost, 0.0, gate), lost

        none = jnp.zeros_like(sums.gradient[0])
        carry = (jnp.zeros((), jnp.int32), sigma, sigma, none, sigma, gate, gate > 1)
        carry = jax.lax.while_loop(lambda carry: carry[0] < UPDATES, again, carry)
        _, after, weighed, move, first, gate, lost = carry
        weight = 1 / weighed**2
        half = 0.5 * jnp.sum(weight * sums.squares, axis=0)
        gradient = jnp.sum(weight[:, None] * sums.gradient, axis=0)
        diagonal = jnp.sum(weight[:, None] * sums.matrix[:, DIAGONAL], axis=0)
        predicted = 0.5 * jnp.sum(move * (damping * diagonal * move - gradient), axis=0)
        return move, after, weighed, first, gate, lost, half, predicted

    def iterate(state: Tuned) -> Tuned:
        sums = apart(components(state.candidate, images, state.proposed))
        crude = jnp.where(enough, with_floor(jnp.sqrt(sums.squares / used)), held)
        proposed = jnp.where(state.rounds == 0, crude, state.proposed)
        cost, cosine = judge(state.candidate, sums, proposed)

        rounding = reach / jnp.min(proposed, axis=0)
        noise = 8 * eps * state.half + 2 * rounding * jnp.sqrt(state.half)
        decrease = state.half - 0.5 * jnp.sum(sums.squares / state.weighed**2, axis=0)
        accept = (decrease >= 1e-4 * state.predicted - noise) | state.again
        good = (decrease >= 0.25 * state.predicted - noise) & jnp.logical_not(state.again)
        factor = jnp.where(good, jnp.where(state.gate > 0, 1e-4, 0.1), 1.0)
        raised = jnp.maximum(10 * state.damping, 1e-8)
        damping = jnp.where(accept, factor * state.damping, raised)
        gained = jnp.where(decrease > noise, 0, state.idle + 1)
        idle = jnp.where(accept & jnp.logical_not(state.again), gained, state.idle)
        guess, sigma, cost, cosine = apart(
            choose(
                accept & state.active,
                (state.candidate, proposed, cost, cosine),
                (state.guess, state.sigma, state.cost, state.cosine),
            )
        )

        # Where the place was not taken, what its sums propose is not used.
        gate = jnp.where(cosine <= GATE, 1.0, 0.0).astype(reach.dtype)
        move, after, weighed, first, gate, bad, half, predicted = propose(
            sums, sigma, damping + 16 * eps, gate
        )
        change = jnp.where(accept, jnp.max(jnp.abs(jnp.log(first / sigma)), axis=0), state.change)
        there = (cosine <= standing) | (idle >= IDLE)
        done = there & (change <= tolerance) & accept
        damping = jnp.where(bad & accept, jnp.maximum(10 * damping, 1e-8), damping)
        rounds = state.rounds + 1
        over = (damping > 1e12) | (rounds >= max_rounds) | jnp.logical_not(jnp.isfinite(cost))
        again = bad | jnp.logical_not(accept)
        new = Tuned(
            guess=guess,
            sigma=sigma,
            updated=jnp.where(accept, first, state.updated),
            cost=cost,
            change=change,
            cosine=cosine,
            candidate=choose(again, guess, guess.moved(unrolled.rows_of(apart(move)))),
            proposed=jnp.where(again, sigma, after),
            again=again,
            weighed=weighed,
            half=half,
            predicted=predicted,
            gate=gate,
            damping=damping,
            idle=idle,
            rounds=rounds,
            settled=done,
            active=jnp.logical_not(done | over),
        )
        return choose(state.active, new, state)

    begun = Tuned.before(apart(start))
    return jax.lax.while_loop(lambda state: jnp.any(state.active), iterate, begun)
