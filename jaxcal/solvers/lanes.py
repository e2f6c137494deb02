"""Levenberg-Marquardt on many problems side by side, one pass over the images an iteration.

Every lane has its own damping, gate and stopping rule; a lane that has arrived waits for its
neighbours with its answer kept. The pass at the candidate gives its cost, and with it already the
normal equations for the next step. Steps are Gauss-Newton's until the gradient cosine falls below
0.03, then exact Newton steps (:mod:`jaxcal.solvers.fused`); where the exact matrix is indefinite
the same place is passed again without.

A lane stops when the largest cosine between its residual and a column of its Jacobian is below the
tolerance, when its residuals are nothing but rounding, or when steps no longer gain more than that.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.solvers import unrolled
from jaxcal.solvers.fused import Belief, Guess, Images, Normal, accumulate

GATE = 0.03
"""Gradient cosine below which second derivatives are exact."""

IDLE = 4
"""Steps in a row without a gain above rounding before a lane is called settled."""


class Descent(eqx.Module):
    """The state of every lane.

    Attributes:
        guess: the best place so far. normal: the normal equations there. gate: 1 where their
            curvature is exact. damping: Marquardt's lambda. idle: steps without a gain.
        iterations: passes. cosine: the gradient cosine. settled: arrived, as far as rounding
            allows. active: whether a lane goes on.
    """

    guess: Guess
    normal: Normal
    gate: Float[Array, " lanes"]
    damping: Float[Array, " lanes"]
    idle: Int[Array, " lanes"]
    iterations: Int[Array, " lanes"]
    cosine: Float[Array, " lanes"]
    settled: Bool[Array, " lanes"]
    active: Bool[Array, " lanes"]


class Rounding(eqx.Module):
    """What rounding of the coordinates leaves of residuals, in each lane.

    Attributes:
        residual: of one whitened residual. vanished: the cost below which it is all there is.
    """

    residual: Float[Array, " lanes"]
    vanished: Float[Array, " lanes"]

    @classmethod
    def of(cls, guess: Guess, belief: Belief, images: Images) -> Rounding:
        """From the size of the coordinates."""
        reach = jnp.max(jnp.abs(images.origin) * images.mask, axis=(0, 2))
        reach = jnp.maximum(reach, jnp.max(jnp.abs(guess.point), axis=0))
        one = jnp.finfo(reach.dtype).eps * reach * belief.largest_weight()
        return cls(one, 3 * images.mask.shape[1] * (2 * one) ** 2)


def gradient_cosine(normal: Normal, vanished: Float[Array, " lanes"]) -> Float[Array, " lanes"]:
    """max_k |g_k| / (|J_k| |r|), 0 where the residuals vanish; NaN in a lost lane."""
    length = jnp.sqrt(jnp.abs(normal.diagonal()) * normal.cost)
    cosine = jnp.max(jnp.abs(normal.gradient) / jnp.where(length > 0, length, 1.0), axis=0)
    cosine = jnp.where(jnp.isfinite(normal.cost), cosine, jnp.nan)
    return jnp.where(normal.cost <= vanished, 0.0, cosine)


def choose(which: Bool[Array, "*lanes"], first, second):
    """Lane by lane one of two pytrees whose last axis counts the lanes."""
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), first, second)


def apart(values):
    """Keep XLA from fusing across here: it would repeat what belongs to a lane for every image."""
    return jax.lax.optimization_barrier(values)


def begin(
    guess: Guess,
    belief: Belief,
    images: Images,
    rounding: Rounding,
    damping: float,
    tolerance: float,
) -> Descent:
    """The first pass."""
    zero = jnp.zeros_like(images.mask[:, 0])
    normal = accumulate(guess, belief, images, zero)
    cosine = gradient_cosine(normal, rounding.vanished)
    none = jnp.zeros(zero.shape, jnp.int32)
    return Descent(
        guess, normal, zero, zero + damping, none, none + 1, cosine, cosine <= tolerance,
        cosine > tolerance,
    )  # fmt: skip


def step(
    state: Descent,
    belief: Belief,
    images: Images,
    rounding: Rounding,
    tolerance: float,
    max_steps: int,
) -> Descent:
    """One iteration of every active lane."""
    eps = jnp.finfo(rounding.residual.dtype).eps
    matrix, gradient = state.normal.matrix(), unrolled.rows_of(state.normal.gradient)
    damping = state.damping + 16 * eps
    diagonal = [jnp.where(matrix[k][k] > 0, matrix[k][k], 1.0) for k in range(len(matrix))]
    for k, entry in enumerate(diagonal):
        matrix[k][k] = matrix[k][k] + damping * entry
    move = unrolled.solve(matrix, [-value for value in gradient])
    move = unrolled.rows_of(apart(jnp.stack(move)))
    lost = jnp.logical_not(jnp.isfinite(sum(move)))
    move = [jnp.where(lost, 0.0, value) for value in move]
    slope = -unrolled.dot(gradient, move)
    predicted = 0.5 * (
        slope + damping * sum(d * m * m for d, m in zip(diagonal, move, strict=True))
    )

    gate = (state.cosine <= GATE) & jnp.logical_not(lost)
    gate = jnp.where(gate, 1.0, 0.0).astype(state.gate.dtype)
    guess = state.guess.moved(unrolled.rows_of(apart(jnp.stack(move))))
    guess = apart(guess)
    normal = apart(accumulate(guess, belief, images, gate))
    half = 0.5 * state.normal.cost
    noise = 8 * eps * half + 2 * rounding.residual * jnp.sqrt(half)
    decrease = half - 0.5 * normal.cost
    accept = (decrease >= 1e-4 * predicted - noise) | lost
    good = (decrease >= 0.25 * predicted - noise) & jnp.logical_not(lost)
    # The exact matrix needs no damping; a Gauss-Newton one is wanted less and less.
    factor = jnp.where(good, jnp.where(state.gate > 0, 1e-4, 0.1), 1.0)
    raised = jnp.maximum(10 * state.damping, 1e-8)
    idle = jnp.where(decrease > noise, 0, state.idle + 1)

    before = (state.guess, state.normal, state.gate)
    guess, normal, gate = choose(accept, (guess, normal, gate), before)
    cosine = gradient_cosine(normal, rounding.vanished)
    iterations = state.iterations + 1
    damping = jnp.where(accept & ~(lost & (state.gate == 0)), factor * state.damping, raised)
    stuck = (idle >= IDLE) | (damping > 1e12) | (iterations >= max_steps)
    after = Descent(
        guess, normal, gate, damping, jnp.where(accept, idle, state.idle), iterations, cosine,
        (cosine <= 10 * tolerance) | (idle >= IDLE), (cosine > tolerance) & jnp.logical_not(stuck),
    )  # fmt: skip
    return choose(state.active, after, state)


def minimise(
    start: Guess,
    belief: Belief,
    images: Images,
    *,
    damping: float = 1e-3,
    tolerance: float | None = None,
    max_steps: int = 100,
) -> Descent:
    """Minimise every lane's objective.

    Args:
        start: X and c to start from.
        belief: the objective.
        images: the data.
        damping: first lambda, relative to the diagonal.
        tolerance: gradient cosine to stop at; by default 1e-10 in float64, 1e-4 in float32.
        max_steps: most passes.

    Returns:
        Where every lane stopped.
    """
    if tolerance is None:
        tolerance = default_tolerance(images.mask.dtype)

    def iterate(state: Descent) -> Descent:
        return step(state, belief, images, rounding, tolerance, max_steps)

    images, belief = apart((images.padded(), belief.padded()))
    rounding = apart(Rounding.of(start, belief, images))
    state = begin(start, belief, images, rounding, damping, tolerance)
    return jax.lax.while_loop(lambda state: jnp.any(state.active), iterate, state)


def default_tolerance(dtype: jnp.dtype) -> float:
    """Gradient cosine that a precision can reach."""
    return 1e-10 if float(jnp.finfo(dtype).eps) < 1e-10 else 1e-4
