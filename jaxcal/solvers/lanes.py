"""Levenberg-Marquardt on many problems side by side, one pass over the images an iteration.

Every lane has its own damping, gate and stopping rule; a lane that has arrived waits for its
neighbours with its answer kept. An iteration looks at the lanes' candidates: the cost decides
whether a candidate is taken, and the same sums are already the normal equations for the next. The
first candidate is the start, so that one loop body is all there is to compile.

From a start that may be far away the loop runs twice. First on the moments of the images
(:mod:`jaxcal.solvers.moments`), where an iteration costs a third of a pass and reads no image, to
within a few tenths of a mm; then on the images, from where nearly all lanes need the same three
passes and hardly any waits. Steps on the moments are Gauss-Newton's. Those on the images are so
where the gradient cosine is above :data:`GATE`, and exact Newton steps below it
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

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.compiler import computed_once
from jaxcal.solvers import unrolled
from jaxcal.solvers.fused import Belief, Guess, Images, Normal, accumulate
from jaxcal.solvers.moments import Moments
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

NEAR = 0.03
"""Gradient cosine on the moments from where one step more ends their use."""

NEAR_DAMPING = 1e-6
"""Marquardt's lambda from where that step ends."""

Equations = Callable[[Guess, Float[Array, " lanes"]], Normal]
"""Normal equations at a guess, with exact second derivatives where a gate is 1."""


class Descent(eqx.Module):
    """The state of every lane.

    Attributes:
        guess: the best place so far. cost: there; sum of squared (whitened) residuals. cosine: the
            gradient cosine there; after a last step that was not looked at, what is taken to bound
            it. candidate: the place to look at next. again: whether that is the guess once more,
            with more damping or without second derivatives. gate: 1 where the step to the
            candidate came from an exact curvature. ahead: the gate at the candidate. damping:
            Marquardt's lambda. predicted: decrease of half the cost by the step. idle: steps
            without a gain. iterations: places looked at. settled: arrived, as far as rounding
            allows. active: whether a lane goes on.
    """

    guess: Guess
    cost: Float[Array, " lanes"]
    cosine: Float[Array, " lanes"]
    candidate: Guess
    again: Bool[Array, " lanes"]
    gate: Float[Array, " lanes"]
    ahead: Float[Array, " lanes"]
    damping: Float[Array, " lanes"]
    predicted: Float[Array, " lanes"]
    idle: Int[Array, " lanes"]
    iterations: Int[Array, " lanes"]
    settled: Bool[Array, " lanes"]
    active: Bool[Array, " lanes"]

    @classmethod
    def before(cls, start: Guess, damping: float, *, exact: bool = False) -> Descent:
        """Nothing looked at yet."""
        number = jnp.zeros_like(start.point[0])
        no, count = jnp.zeros(number.shape, bool), jnp.zeros(number.shape, jnp.int32)
        return cls(
            guess=start, cost=number + jnp.inf, cosine=number + jnp.inf, candidate=start,
            again=~no, gate=number, ahead=number + exact, damping=number + damping,
            predicted=number, idle=count, iterations=count, settled=no, active=~no,
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
    equations: Equations,
    rounding: Rounding,
    tolerance: float,
    max_steps: int,
) -> Descent:
    """Every active lane's candidate looked at, and the next one chosen.

    Normal equations are used where they are made and then forgotten: it is cheaper to look at a
    place again, where a step from there has failed, than to keep 54 numbers of every lane.
    """
    normal = apart(equations(state.candidate, state.ahead))

    half = 0.5 * jnp.where(state.again, normal.cost, state.cost)
    noise = 8 * jnp.finfo(half.dtype).eps * half + 2 * rounding.residual * jnp.sqrt(half)
    decrease = half - 0.5 * normal.cost
    accept = (decrease >= 1e-4 * state.predicted - noise) | state.again
    good = (decrease >= 0.25 * state.predicted - noise) & jnp.logical_not(state.again)
    # The exact matrix needs no damping; a Gauss-Newton one is wanted less and less.
    factor = jnp.where(good, jnp.where(state.gate > 0, 1e-4, 0.1), 1.0)
    raised = jnp.maximum(10 * state.damping, 1e-8)
    damping = jnp.where(accept, factor * state.damping, raised)
    gained = jnp.where(decrease > noise, 0, state.idle + 1)
    idle = jnp.where(accept & jnp.logical_not(state.again), gained, state.idle)

    guess = choose(accept & state.active, state.candidate, state.guess)
    cost = jnp.where(accept, normal.cost, state.cost)
    cosine = jnp.where(accept, gradient_cosine(normal, rounding.vanished), state.cosine)
    move, predicted, lost = propose(normal, damping)
    lost = lost & accept
    # Indefinite: the same place again without second derivatives, or with more damping.
    damping = jnp.where(lost & (state.ahead == 0), jnp.maximum(10 * damping, 1e-8), damping)
    again = lost | jnp.logical_not(accept)
    candidate = choose(again, guess, state.candidate.moved(move))

    iterations = state.iterations + 1
    stuck = (idle >= IDLE) | (damping > 1e12) | (iterations >= max_steps)
    left = SQUARED * cosine * cosine
    last = (
        (state.ahead > 0) & (damping < 1e-6) & jnp.logical_not(again)
        & (left <= tolerance) & (predicted <= SMALL * cost) & (cosine > tolerance)
    )  # fmt: skip
    ahead = (cosine <= GATE) & jnp.logical_not(lost)
    after = Descent(
        guess=guess,
        cost=cost,
        cosine=jnp.where(last, left, cosine),
        candidate=candidate,
        again=again,
        gate=jnp.where(accept, state.ahead, state.gate),
        ahead=jnp.where(ahead, 1.0, 0.0).astype(half.dtype),
        damping=damping,
        predicted=predicted,
        idle=idle,
        iterations=iterations,
        settled=(cosine <= 10 * tolerance) | last | (idle >= IDLE),
        active=(cosine > tolerance) & jnp.logical_not(stuck | last),
    )
    after = choose(state.active, after, eqx.tree_at(lambda old: old.guess, state, guess))
    return eqx.tree_at(
        lambda new: new.guess, after, choose(last & state.active, candidate, after.guess)
    )


def minimise(
    start: Guess,
    belief: Belief,
    images: Images,
    *,
    damping: float = 1e-3,
    tolerance: float | None = None,
    max_steps: int = 100,
    head_start: bool = True,
) -> Descent:
    """Minimise every lane's objective.

    Args:
        start: X and c to start from.
        belief: the objective.
        images: the data.
        damping: first lambda, relative to the diagonal.
        tolerance: gradient cosine to stop at; by default 1e-10 in float64, 1e-4 in float32.
        max_steps: most passes, and most steps before them.
        head_start: begin on the moments, where the belief has something to do with them. From a
            start that is another method's answer this gains nothing.

    Returns:
        Where every lane stopped.
    """
    if tolerance is None:
        tolerance = default_tolerance(images.mask.dtype)

    def at_images(guess: Guess, gate: Array) -> Normal:
        return accumulate(guess, belief, images, gate)

    images, belief = apart((images.padded(), belief.padded()))
    rounding = apart(Rounding.of(start, belief, images))
    begun, weight = Descent.before(start, damping), belief.planar_weight()
    if head_start and weight is not None:
        moments = apart(Moments.of(images, start.point))

        def at_moments(guess: Guess, gate: Array) -> Normal:
            # Many read the result, and each would compute all of it.
            return computed_once(lambda: moments.normal(guess, weight), gate[0])

        near = descend(begun, at_moments, rounding, NEAR, max_steps)
        begun = Descent.before(near.candidate, NEAR_DAMPING, exact=True)
    return descend(begun, at_images, rounding, tolerance, max_steps)


def descend(
    begun: Descent,
    equations: Equations,
    rounding: Rounding,
    tolerance: float,
    max_steps: int,
) -> Descent:
    """Steps until no lane is active."""

    def one(state: Descent) -> Descent:
        return iterate(state, equations, rounding, tolerance, max_steps)

    return jax.lax.while_loop(lambda state: jnp.any(state.active), one, begun)


def default_tolerance(dtype: jnp.dtype) -> float:
    """Gradient cosine that a precision can reach."""
    return 1e-10 if float(jnp.finfo(dtype).eps) < 1e-10 else 1e-4
