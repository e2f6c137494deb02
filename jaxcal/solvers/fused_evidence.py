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
import numpy as np
from jaxtyping import Array, Float

from jaxcal.solvers import dense, unrolled
from jaxcal.solvers.evidence import MEAN_SD, ROUNDS, UPDATES
from jaxcal.solvers.fused import PAIRS, UNKNOWNS, Guess, Images, Term, contributions, targets, total
from jaxcal.solvers.fused_variance import components
from jaxcal.solvers.lanes import apart
from jaxcal.solvers.variance import least_sigma

V_Y = 1
"""The unknown that moves every q_iy by -1."""


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
    """Every component's normal equations about a mean b, which is the last unknown.

    Attributes:
        matrix: of X and c, upper triangles. border: b's row, of the offsets alone. gradient: b's
            last. squares: rss_k.
    """

    matrix: Float[Array, "k 45 lanes"]
    border: Float[Array, "10 lanes"]
    gradient: Float[Array, "k 10 lanes"]
    squares: Float[Array, "k lanes"]

    @classmethod
    def of(cls, sums: Sums, mean: Array, with_mean: Array) -> _System:
        """From what a pass left."""
        only = np.eye(len(sums.squares))[-1][:, None]
        along = row_of(sums.matrix[-1], V_Y)
        squares = mean * (2 * sums.gradient[-1, V_Y] + mean * along[V_Y])
        gradient = sums.gradient + only[:, None] * mean * along
        last = only * with_mean * gradient[:, V_Y]
        border = with_mean * jnp.concatenate([along, along[V_Y, None]])
        gradient = jnp.concatenate([gradient, last[:, None]], axis=1)
        return apart(cls(sums.matrix, border, gradient, sums.squares + only * squares))

    def solved(self, scale: Array, precision: Array, mean: Array) -> tuple[Array, ...]:
        """Inverse and step with given SDs and belief about b, and ln Z but for the SDs."""
        weight = 1 / scale**2
        last = (np.arange(10) == 9)[:, None]
        flat = jnp.sum(weight[:, None] * self.matrix, axis=0)
        border = weight[-1] * self.border + jnp.where(last, precision, 0.0)
        gradient = jnp.sum(weight[:, None] * self.gradient, axis=0)
        gradient = gradient + jnp.where(last, precision * mean, 0.0)
        flat, border, gradient = apart((flat, border, gradient))
        rows = [jnp.concatenate([row_of(flat, k), border[k, None]]) for k in range(UNKNOWNS)]
        inverse, log_determinant = dense.inverse_abreast(jnp.stack([*rows, border]))
        step = -dense.product_abreast(inverse, gradient)
        # At the minimum, which is a small step away.
        cost = jnp.sum(weight * self.squares, axis=0) + precision * mean**2
        cost = cost + jnp.sum(gradient * step, axis=0)
        return inverse, step, 0.5 * (jnp.log(precision) - cost - log_determinant)

    def traces(self, matrix: Float[Array, "10 10 lanes"]) -> Float[Array, "k lanes"]:
        """tr(A N_k) of every component, A symmetric."""
        twice = [(1 if i == j else 2) * matrix[i, j] for i, j in PAIRS]
        found = jnp.sum(apart(jnp.stack(twice)) * self.matrix, axis=1)
        crossed = 2 * matrix[9, :9] * self.border[:9]
        own = jnp.sum(crossed, axis=0) + matrix[9, 9] * self.border[9]
        return found + np.eye(len(found))[-1][:, None] * own


def row_of(flat: Float[Array, "45 lanes"], k: int) -> Float[Array, "9 lanes"]:
    """A row of a symmetric matrix from its upper triangle."""
    return jnp.stack([flat[PAIRS.index((min(k, j), max(k, j)))] for j in range(UNKNOWNS)])


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
    floor = least_sigma(scale)

    def one_round(_: Array, state: tuple) -> tuple:
        guess, mean, scale = state
        system = _System.of(apart(pass_over(guess)), mean, with_mean)

        def update(_: Array, state: tuple) -> tuple:
            scale, _ = state
            precision = mean_precision(scale[-1], with_mean)
            inverse, step, _ = apart(system.solved(scale, precision, mean))
            leverage = system.traces(inverse) / scale**2
            bent = system.traces(step[:, None] * step)
            left = system.squares + 2 * jnp.sum(system.gradient * step, axis=1) + bent
            freedom = jnp.maximum(count - leverage, 0.05 * count)
            return jnp.maximum(jnp.sqrt(jnp.maximum(left, 0.0) / freedom), floor), step

        none = jnp.zeros((UNKNOWNS + 1, mean.shape[0]), mean.dtype)
        scale, step = jax.lax.fori_loop(0, UPDATES, update, (scale, none))
        return apart((guess.moved(list(step[:UNKNOWNS])), mean + step[-1], scale))

    state = (guess, jnp.zeros_like(with_mean), scale)
    guess, mean, scale = jax.lax.fori_loop(0, rounds, one_round, state)
    return judged(pass_over, guess, scale, mean, with_mean, count)


def judged(
    pass_over: Pass,
    guess: Guess,
    scale: Float[Array, "k lanes"],
    mean: Float[Array, " lanes"],
    with_mean: Float[Array, " lanes"],
    count: Float[Array, "k lanes"],
) -> Belief:
    """A belief with its Laplace evidence, but for the covariances' determinants."""
    sums = apart(pass_over(guess))
    system = _System.of(sums, mean, with_mean)
    _, _, evidence = system.solved(scale, mean_precision(scale[-1], with_mean), mean)
    evidence = evidence - jnp.sum(count * jnp.log(scale), axis=0)
    return Belief(guess, mean, scale, sums, with_mean, evidence)
