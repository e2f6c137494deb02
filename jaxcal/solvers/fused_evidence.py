"""Which Gaussian belief the data ask for (:mod:`evidence`), on sums over the images.

A belief's components (lateral position, range and offset, each with its SD s_k; or, with own
covariances C_i up to one factor, both measurements together and the offset) leave of one pass
over the images their rss_k, g_k and N_k, as in :mod:`jaxcal.solvers.fused_variance`. A mean b of
the offsets needs no further sum: it moves q_iy - b as v_y does, so its row of N_y is that of v_y,
and

    rss_y(b) = rss_y - 2 b sum q_iy + n b^2,      sum q_iy = -g_y[v_y],      n = N_y[v_y, v_y].

On these sums the SDs are updated :data:`~jaxcal.solvers.evidence.UPDATES` times, the step that
belongs to them is taken, and the next round passes again. Common SDs without a mean are REML's own
belief, which has been tuned already. The reference is :func:`jaxcal.solvers.evidence.tune`.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.solvers import unrolled
from jaxcal.solvers.evidence import MEAN_SD, ROUNDS, UPDATES
from jaxcal.solvers.fused import UNKNOWNS, Guess, Images, Term, contributions, targets, total
from jaxcal.solvers.fused_variance import components, together, with_floor
from jaxcal.solvers.lanes import apart
from jaxcal.solvers.unrolled import Vector

V_Y = 1
BORDERED = [(i, j) for i in range(UNKNOWNS + 1) for j in range(i, UNKNOWNS + 1)]
"""Places of the upper triangle with b as the last unknown."""


class Sums(eqx.Module):
    """What one pass leaves of the images, lanes last; the offsets are the last component.

    Attributes:
        squares: rss_k. gradient: g_k. matrix: N_k, upper triangles.
    """

    squares: Float[Array, "k lanes"]
    gradient: Float[Array, "k 9 lanes"]
    matrix: Float[Array, "k 45 lanes"]


class Belief(eqx.Module):
    """A Gaussian belief at work, lanes last.

    Attributes:
        guess: X and c. mean: b, mm. scale: s_k, the components' SDs. sums: there. with_mean: 1
            where the offsets may have a mean. log_evidence: ln Z, up to a constant.
    """

    guess: Guess
    mean: Float[Array, " lanes"]
    scale: Float[Array, "k lanes"]
    sums: Sums
    with_mean: Float[Array, " lanes"]
    log_evidence: Float[Array, " lanes"]


Pass = Callable[[Guess], Sums]


def common(images: Images) -> Pass:
    """The pass for common SDs: lateral position, range, offset."""

    def sums(guess: Guess) -> Sums:
        found = components(guess, images, None)
        return Sums(found.squares, found.gradient, found.matrix)

    return sums


def own(images: Images, weight: Float[Array, "3 lanes n"]) -> Pass:
    """The pass for own covariances: measurements, offset.

    Args:
        images: the data.
        weight: inverse covariances: lateral, mixed, range, mm^-2.
    """

    def sums(guess: Guess) -> Sums:
        q, turned = targets(guess, images)
        square = q[1] * q[1] + q[2] * q[2]
        inverse = jax.lax.rsqrt(square)
        y, z = q[1] * inverse, q[2] * inverse
        errors = [q[0] - images.lateral, square * inverse - images.distance]
        first, mixed, second = (images.mask * plane for plane in weight)
        pull = [
            first * errors[0] + mixed * errors[1], mixed * errors[0] + second * errors[1]
        ]  # fmt: skip
        measured = Term(
            unrolled.dot(pull, errors),
            [pull[0], pull[1] * y, pull[1] * z],
            [
                [first, mixed * y, mixed * z],
                [mixed * y, second * y * y, second * y * z],
                [mixed * z, second * y * z, second * z * z],
            ],
        )
        offset = images.mask * q[1]
        across = Term(
            offset * q[1], [0, offset, 0], [[0, 0, 0], [0, images.mask, 0], [0, 0, 0]]
        )  # fmt: skip
        planes = [measured.cost, across.cost]
        for term in (measured, across):
            matrix, gradient = contributions(q, turned, term, 0)
            planes += [*gradient, *matrix]
        found = jnp.stack(total(planes))
        apiece = found[2:].reshape(2, -1, found.shape[1])
        return Sums(found[:2], apiece[:, :UNKNOWNS], apiece[:, UNKNOWNS:])

    return sums


class _System(eqx.Module):
    """The normal equations with b as the last unknown, as rows of lanes."""

    matrix: list[Vector]
    gradient: list[Vector]
    squares: Vector

    @classmethod
    def of(cls, sums: Sums, mean: Array, with_mean: Array) -> _System:
        """About a mean."""
        matrix = [unrolled.rows_of(row) for row in sums.matrix]
        gradient = [unrolled.rows_of(row) for row in sums.gradient]
        squares = unrolled.rows_of(sums.squares)
        offsets = unrolled.symmetric(matrix[-1])
        count = offsets[V_Y][V_Y]
        squares[-1] = squares[-1] + mean * (2 * gradient[-1][V_Y] + mean * count)
        pull = [g + mean * n for g, n in zip(gradient[-1], offsets[V_Y], strict=True)]
        gradient[-1] = pull
        border = [with_mean * entry for entry in offsets[V_Y]]
        wide: list[Vector] = []
        for k, flat in enumerate(matrix):
            full = unrolled.symmetric(flat)
            last = k == len(matrix) - 1
            wide.append(
                [
                    full[i][j] if j < UNKNOWNS
                    else (border[i] if i < UNKNOWNS else border[V_Y]) if last
                    else 0
                    for i, j in BORDERED
                ]
            )  # fmt: skip
            gradient[k] = [*gradient[k], with_mean * pull[V_Y] if last else 0]
        return cls(wide, gradient, squares)

    def weighted(self, scale: Array, precision: Array, mean: Array) -> tuple[Vector, Vector]:
        """Matrix (upper triangle) and gradient with given SDs and the belief about b."""
        weight = unrolled.rows_of(1 / scale**2)
        matrix, gradient = (
            [
                unrolled.add(
                    *(unrolled.times(w, row[k]) for w, row in zip(weight, rows, strict=True))
                )
                for k in range(len(rows[0]))
            ]
            for rows in (self.matrix, self.gradient)
        )
        matrix[-1] = matrix[-1] + precision
        gradient[-1] = gradient[-1] + precision * mean
        return together(matrix), together(gradient)


def mean_precision(offset_sd: Array, with_mean: Array) -> Array:
    """1 / (2 sigma_y)^2; without a mean, its unknown is held at zero by a precision of one."""
    return jnp.where(with_mean > 0, (MEAN_SD * offset_sd) ** -2.0, 1.0)


def tune(
    pass_over: Pass,
    guess: Guess,
    scale: Float[Array, "k lanes"],
    with_mean: Float[Array, " lanes"],
    count: Float[Array, "k lanes"],
    rounds: int = ROUNDS,
) -> Belief:
    """Tune the SDs, the unknowns and the mean from a nearby solution.

    Args:
        pass_over: the images.
        guess: to start from.
        scale: SDs to start from.
        with_mean: 1 where the offsets may have a mean.
        count: residuals of each component.
        rounds: passes before the last.
    """

    def update(_: Array, state: tuple, sums: Sums, mean: Array) -> tuple:
        scale, _ = state
        system = _System.of(sums, mean, with_mean)
        precision = mean_precision(scale[-1], with_mean)
        matrix, gradient = system.weighted(scale, precision, mean)
        flat, _ = unrolled.inverse(unrolled.symmetric(matrix))
        flat = together(flat)
        step = together([-x for x in unrolled.apply(unrolled.symmetric(flat), gradient)])
        factors = []
        for k, part in enumerate(system.matrix):
            twice = [1.0 if i == j else 2.0 for i, j in BORDERED]
            leverage = unrolled.add(
                *(unrolled.times(t * c, n) for t, c, n in zip(twice, flat, part, strict=True))
            )
            bent = unrolled.add(
                *(
                    unrolled.times(t * step[i] * step[j], n)
                    for t, (i, j), n in zip(twice, BORDERED, part, strict=True)
                )
            )
            left = system.squares[k] + 2 * unrolled.dot(system.gradient[k], step) + bent
            freedom = jnp.maximum(count[k] - leverage / scale[k] ** 2, 0.05 * count[k])
            factors.append(jnp.sqrt(jnp.maximum(left, 0.0) / freedom))
        return with_floor(jnp.stack(factors)), jnp.stack(step)

    def one_round(_: Array, state: tuple) -> tuple:
        guess, mean, scale = state
        sums = apart(pass_over(guess))
        none = jnp.zeros((UNKNOWNS + 1, mean.shape[0]), mean.dtype)
        scale, step = jax.lax.fori_loop(
            0, UPDATES, lambda k, state: update(k, state, sums, mean), (scale, none)
        )
        step = unrolled.rows_of(step)
        return apart((guess.moved(step[:UNKNOWNS]), mean + step[-1], scale))

    state = (guess, jnp.zeros_like(with_mean), scale)
    guess, mean, scale = jax.lax.fori_loop(0, rounds, one_round, state)
    return judged(pass_over(guess), guess, scale, mean, with_mean, count)


def judged(
    sums: Sums,
    guess: Guess,
    scale: Float[Array, "k lanes"],
    mean: Float[Array, " lanes"],
    with_mean: Float[Array, " lanes"],
    count: Float[Array, "k lanes"],
) -> Belief:
    """A belief with its Laplace evidence, but for the covariances' determinants."""
    sums = apart(sums)
    system = _System.of(sums, mean, with_mean)
    precision = mean_precision(scale[-1], with_mean)
    matrix, gradient = system.weighted(scale, precision, mean)
    factor, inverse = unrolled.cholesky(unrolled.symmetric(matrix))
    inverse = together(inverse)
    half = unrolled.forward(factor, inverse, gradient)
    cost = jnp.sum(jnp.stack(system.squares) / scale**2, axis=0) + precision * mean**2
    # The minimum is still a small step away.
    cost = cost - unrolled.dot(half, half)
    log_determinant = -2 * jnp.sum(jnp.log(jnp.stack(inverse)), axis=0)
    evidence = 0.5 * (jnp.log(precision) - cost - log_determinant)
    evidence = evidence - jnp.sum(count * jnp.log(scale), axis=0)
    return Belief(guess, mean, scale, sums, with_mean, evidence)
