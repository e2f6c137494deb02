"""Levenberg-Marquardt on many problems side by side, one pass over the images an iteration.

Every lane has its own damping, gate and stopping rule; a lane that has arrived waits for its
neighbours with its answer kept. An iteration passes over the images at the lanes' candidates: the
cost decides whether a candidate is taken, and the same sums are already the normal equations for
the next. The first candidate is the start, so that one loop body is all there is to compile. Steps
are Gauss-Newton's until the gradient cosine falls below :data:`GATE`, then exact Newton steps
(:mod:`jaxcal.solvers.fused`); where the exact matrix is indefinite the same place is passed again
without.

A lane stops when the largest cosine between its residual and a column of its Jacobian is below the
tolerance, when its residuals are nothing but rounding, or when steps no longer gain more than that.
Newton's steps square what is left: from a cosine whose square is well below the tolerance, the
last step is taken and not looked at again.

Why this is no solver class of optimistix: there one solve has one verdict and one count of steps,
where here every lane has its own, and it wants an objective that this loop never calls. Time was
not in the way: behind its interface the same loop took 1.01 times as long as one solve for 64
lanes, and 1.10 times as one solve a problem, vmapped.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.solvers import unrolled
from jaxcal.solvers.fused import PAIRS, UNKNOWNS, Belief, Guess, Images, Normal, accumulate
from jaxcal.solvers.unrolled import Vector

GATE = 0.2
"""Gradient cosine below which second derivatives are exact."""

SQUARED = 100.0
"""The cosine after an exact Newton step, over the square of that before it, is taken to be below
this. From below 1e-6, the worst of 1,024 simulated problems came to 2.3e-12."""

SMALL = 1e-11
"""Predicted relative decrease of the cost above which no step is the last unseen one."""

IDLE = 4
"""Steps in a row without a gain above rounding before a lane is called settled."""


class Descent(eqx.Module):
    """The state of every lane.

    Attributes:
        guess: the best place so far. candidate: the next. normal: the normal equations at the last
            place that was passed and taken. gate: 1 where their curvature is exact. ahead: the
            gate of the next pass. damping: Marquardt's lambda. predicted: decrease of half the
            cost by the next step. lost: whether there is none, the matrix being indefinite. idle:
            steps without a gain. iterations: passes. cosine: the gradient cosine; after a last
            step that was not passed again, what is taken to bound it. settled: arrived, as far as
            rounding allows. active: whether a lane goes on.
    """

    guess: Guess
    candidate: Guess
    normal: Normal
    gate: Float[Array, " lanes"]
    ahead: Float[Array, " lanes"]
    damping: Float[Array, " lanes"]
    predicted: Float[Array, " lanes"]
    lost: Bool[Array, " lanes"]
    idle: Int[Array, " lanes"]
    iterations: Int[Array, " lanes"]
    cosine: Float[Array, " lanes"]
    settled: Bool[Array, " lanes"]
    active: Bool[Array, " lanes"]

    @classmethod
    def before(cls, start: Guess, damping: float) -> Descent:
        """Nothing passed yet."""
        number = jnp.zeros_like(start.point[0])
        no, count = jnp.zeros(number.shape, bool), jnp.zeros(number.shape, jnp.int32)
        normal = Normal(
            jnp.zeros((len(PAIRS), *number.shape), number.dtype),
            jnp.zeros((UNKNOWNS, *number.shape), number.dtype),
            number + jnp.inf,
        )
        return cls(
            guess=start, candidate=start, normal=normal, gate=number, ahead=number,
            damping=number + damping, predicted=number, lost=no, idle=count, iterations=count,
            cosine=number + jnp.inf, settled=no, active=~no,
        )  # fmt: skip


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
        away = [images.mask * jnp.abs(plane) for plane in images.origin]
        away = jnp.maximum(jnp.maximum(away[0], away[1]), away[2])
        reach = jnp.maximum(jnp.max(away, axis=1), jnp.max(jnp.abs(guess.point), axis=0))
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


def propose(
    normal: Normal, damping: Float[Array, " lanes"]
) -> tuple[Vector, Float[Array, " lanes"], Bool[Array, " lanes"]]:
    """The damped step, the decrease of half the cost that it predicts, and whether it is lost."""
    matrix, gradient = normal.matrix(), unrolled.rows_of(normal.gradient)
    damping = damping + 16 * jnp.finfo(damping.dtype).eps
    diagonal = [jnp.where(matrix[k][k] > 0, matrix[k][k], 1.0) for k in range(len(matrix))]
    for k, entry in enumerate(diagonal):
        matrix[k][k] = matrix[k][k] + damping * entry
    move = unrolled.solve(matrix, [-value for value in gradient])
    move = unrolled.rows_of(apart(jnp.stack(move)))
    lost = jnp.logical_not(jnp.isfinite(sum(move)))
    move = [jnp.where(lost, 0.0, value) for value in move]
    heavy = sum(d * m * m for d, m in zip(diagonal, move, strict=True))
    predicted = 0.5 * (damping * heavy - unrolled.dot(gradient, move))
    return unrolled.rows_of(apart(jnp.stack(move))), predicted, lost


def iterate(
    state: Descent,
    belief: Belief,
    images: Images,
    rounding: Rounding,
    tolerance: float,
    max_steps: int,
) -> Descent:
    """One pass for every active lane."""
    eps, first = jnp.finfo(rounding.residual.dtype).eps, state.iterations == 0
    normal = apart(accumulate(state.candidate, belief, images, state.ahead))

    half = 0.5 * jnp.where(first, normal.cost, state.normal.cost)
    noise = 8 * eps * half + 2 * rounding.residual * jnp.sqrt(half)
    decrease, lost = half - 0.5 * normal.cost, state.lost
    accept = (decrease >= 1e-4 * state.predicted - noise) | lost | first
    good = (decrease >= 0.25 * state.predicted - noise) & jnp.logical_not(lost)
    # The exact matrix needs no damping; a Gauss-Newton one is wanted less and less.
    factor = jnp.where(good, jnp.where(state.gate > 0, 1e-4, 0.1), 1.0)
    factor = jnp.where(first, 1.0, factor)
    raised = jnp.maximum(10 * state.damping, 1e-8)
    damping = jnp.where(accept & ~(lost & (state.gate == 0)), factor * state.damping, raised)
    idle = jnp.where((decrease > noise) | first, 0, state.idle + 1)
    iterations = state.iterations + 1
    stuck = (idle >= IDLE) | (damping > 1e12) | (iterations >= max_steps)

    guess, normal, gate = apart(
        choose(
            accept & state.active,
            (state.candidate, normal, state.ahead),
            (state.guess, state.normal, state.gate),
        )
    )
    cosine = gradient_cosine(normal, rounding.vanished)
    move, predicted, lost = propose(normal, damping)
    candidate = guess.moved(move)
    left = SQUARED * cosine * cosine
    last = (
        (gate > 0) & (damping < 1e-6) & jnp.logical_not(lost)
        & (left <= tolerance) & (predicted <= SMALL * normal.cost) & (cosine > tolerance)
    )  # fmt: skip
    ahead = (cosine <= GATE) & jnp.logical_not(lost)
    after = Descent(
        guess=choose(last, candidate, guess),
        candidate=candidate,
        normal=normal,
        gate=gate,
        ahead=jnp.where(ahead, 1.0, 0.0).astype(gate.dtype),
        damping=damping,
        predicted=predicted,
        lost=lost,
        idle=jnp.where(accept, idle, state.idle),
        iterations=iterations,
        cosine=jnp.where(last, left, cosine),
        settled=(cosine <= 10 * tolerance) | last | (idle >= IDLE),
        active=(cosine > tolerance) & jnp.logical_not(stuck | last),
    )
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

    def one(state: Descent) -> Descent:
        return iterate(state, belief, images, rounding, tolerance, max_steps)

    images, belief = apart((images.padded(), belief.padded()))
    rounding = apart(Rounding.of(start, belief, images))
    begun = Descent.before(start, damping)
    return jax.lax.while_loop(lambda state: jnp.any(state.active), one, begun)


def default_tolerance(dtype: jnp.dtype) -> float:
    """Gradient cosine that a precision can reach."""
    return 1e-10 if float(jnp.finfo(dtype).eps) < 1e-10 else 1e-4
