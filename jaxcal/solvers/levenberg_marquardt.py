"""Levenberg-Marquardt on many problems side by side, one pass over the images an iteration.

Every problem has its own damping, curvature and stopping rule; one that has converged keeps its
answer while the others go on. An iteration evaluates every problem's candidate: the cost decides
whether the candidate is taken, and the same sums are the normal equations for the next one. The
first candidate is the start, so that only one loop body has to be compiled.

The acceptance rule is that of More (1978), with Marquardt's (1963) factors on the damping: a step
is taken where the cost falls by at least a ten-thousandth of the decrease that the quadratic model
predicts. The damping falls where the cost falls by at least a quarter of it, and grows tenfold
where a step is refused. Every loop of the package uses this rule, by :meth:`LoopState.judged`.
Steps are Gauss-Newton's where the gradient cosine is above :data:`EXACT_BELOW`, and exact Newton
steps below it; where the exact matrix is indefinite, the same iterate is evaluated again without
second derivatives.

A problem stops when the largest cosine between its residual and a column of its Jacobian is below
the tolerance, when its residuals are nothing but rounding, or when steps gain no more than
rounding. Newton's steps square the cosine. So where its square is well below the tolerance, one
last step is taken, and its result is not evaluated.

The loop needs normal equations and a retraction, not residuals; :mod:`jaxcal.solvers.general` puts
it behind optimistix's interface for residuals of any shape.

References: Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963;
More, "The Levenberg-Marquardt algorithm: implementation and theory", 1978.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal import InputError
from jaxcal.model.batch import ImagePlanes, Iterate, barrier, choose
from jaxcal.model.observations import LocalUnknown, MediumPrior, Observation
from jaxcal.runtime.arrays import is_traced
from jaxcal.runtime.given_values import whole_number
from jaxcal.runtime.jax_modes import inside_transformation, is_float64_on
from jaxcal.solvers import dense
from jaxcal.solvers.batch_loop import until_done
from jaxcal.solvers.normal_equations import NormalEquations, accumulate
from jaxcal.solvers.plan import MOST_STEPS, check_size

ACCEPT_RATIO = 1e-4
"""Least ratio of actual to predicted decrease with which a step is taken."""

GOOD_RATIO = 0.25
"""Least ratio of actual to predicted decrease with which the damping falls."""

DAMPING_DECREASE, DAMPING_DECREASE_EXACT, DAMPING_INCREASE = 0.1, 1e-4, 10.0
"""Factors on the damping after a good Gauss-Newton step, a good exact one, and a refused one."""

LEAST_DAMPING, LARGEST_DAMPING = 1e-8, 1e12
"""Least damping after a refused step, and the damping above which a problem is given up."""

EXACT_BELOW = 0.2
"""Gradient cosine below which exact second derivatives are used."""

QUADRATIC_FACTOR = 100.0
"""Assumed upper bound on the cosine after an exact Newton step over the square of the cosine before
it. From a cosine below 1e-6, the worst of 1,024 simulated problems came to 2.3e-12."""

FINAL_DECREASE = 1e-11
"""Largest predicted relative decrease of the cost by a last step that is not evaluated."""

LITTLE_DAMPING = 1e-6
"""Damping below which a step counts as Newton's own."""

CONVERGED_WITHIN = 10.0
"""A problem that is given up with a cosine within this many tolerances has converged: what is left
of its way is far below its SDs."""

MOST_STALLED = 4
"""Successive steps without a gain above rounding after which a problem has converged."""


Equations = Callable[[Any, Float[Array, " batch"]], NormalEquations]
"""From unknowns, and 1 where second derivatives are to be exact, to their normal equations."""


class Minimum(eqx.Module):
    """Where a method stopped, or how far its loop has come, for every problem; batch axis last.

    Attributes:
        iterate: the best unknowns that were found.
        cost: sum of squared (whitened) residuals; without a last step that was not evaluated.
        cosine: gradient cosine max_k |g_k| / (|J_k| |r|); after such a step, its bound.
        iterations: number of evaluations (of a solver of optimistix: its steps).
        converged: the gradient cosine met its tolerance (:data:`CONVERGED_WITHIN`), or steps gain
            nothing above rounding. Of other methods: their own rule is met.
        trace: best cost after each of the first evaluations; NaN beyond the last; None: not kept.
    """

    iterate: Any
    cost: Float[Array, " batch"]
    cosine: Float[Array, " batch"]
    iterations: Int[Array, " batch"]
    converged: Bool[Array, " batch"]
    trace: Float[Array, "trace batch"] | None


class LoopState(Minimum):
    """The state of a loop, for every problem.

    Attributes:
        candidate: the unknowns to evaluate next.
        retry: ``candidate`` is ``iterate`` again, with more damping or without second derivatives.
        exact_used: 1 where the step to the candidate came from an exact curvature.
        damping: Marquardt's lambda.
        predicted: predicted decrease of half the cost by the step to the candidate.
        stalled: number of successive steps without a gain above rounding.
        active: the problem is not finished.
    """

    candidate: Any
    retry: Bool[Array, " batch"]
    exact_used: Float[Array, " batch"]
    damping: Float[Array, " batch"]
    predicted: Float[Array, " batch"]
    stalled: Int[Array, " batch"]
    active: Bool[Array, " batch"]

    @classmethod
    def first(
        cls, start: Any, number: Float[Array, " batch"], damping: float, trace: int = 0, **own: Any
    ) -> Any:
        """The state before the first evaluation.

        Args:
            start: the first candidate.
            number: zeros, one for every problem.
            damping: first lambda, relative to the diagonal.
            trace: how many values of the cost to keep.
            own: the further fields of a loop.
        """
        no, count = jnp.zeros(number.shape, bool), jnp.zeros(number.shape, jnp.int32)
        return cls(
            iterate=start,
            cost=number + jnp.inf,
            cosine=number + jnp.inf,
            candidate=start,
            retry=~no,
            exact_used=number,
            damping=number + damping,
            predicted=number,
            stalled=count,
            iterations=count,
            converged=no,
            active=~no,
            trace=empty_trace(trace, number),
            **own,
        )

    def judged(
        self,
        half_cost: Float[Array, " batch"],
        after: Float[Array, " batch"],
        rounding: Float[Array, " batch"],
        *,
        decrease_exact: float = DAMPING_DECREASE_EXACT,
        allowance: Float[Array, " batch"] | float = 0.0,
    ) -> tuple[Bool[Array, " batch"], Float[Array, " batch"], Int[Array, " batch"]]:
        """The acceptance rule: whether the step to the candidate is taken, and what follows it.

        Args:
            half_cost: half the cost before the step.
            after: half the cost at the candidate.
            rounding: of one whitened residual.
            decrease_exact: factor on the damping after a good exact step.
            allowance: by how much half the cost may have grown for other reasons than the step.

        Returns:
            Whether it is taken, the damping of the next step, and ``stalled`` after it.
        """
        # Each residual is off by its rounding, so half their sum of squares is off by this much.
        noise = 8 * jnp.finfo(half_cost.dtype).eps * half_cost + 2 * rounding * jnp.sqrt(half_cost)
        least, decrease, stepped = -noise - allowance, half_cost - after, ~self.retry
        accept = (decrease >= ACCEPT_RATIO * self.predicted + least) | self.retry
        good = (decrease >= GOOD_RATIO * self.predicted + least) & stepped
        # The exact matrix needs no damping; Gauss-Newton's needs less and less.
        lower = jnp.where(self.exact_used > 0, decrease_exact, DAMPING_DECREASE)
        factor = jnp.where(good, lower, 1.0)
        raised = jnp.maximum(DAMPING_INCREASE * self.damping, LEAST_DAMPING)
        gained = jnp.where(decrease > noise, 0, self.stalled + 1)
        return (
            accept,
            jnp.where(accept, factor * self.damping, raised),
            jnp.where(accept & stepped, gained, self.stalled),
        )


class Descent(LoopState):
    """The state of :func:`minimise`.

    Attributes:
        exact_next: 1 where the candidate's curvature is to be exact.
    """

    exact_next: Float[Array, " batch"]


def empty_trace(length: int, number: Float[Array, " batch"]) -> Float[Array, "trace batch"] | None:
    """A trace without values, of the batch shape of ``number``; None for a length of 0."""
    return jnp.full((length, *number.shape), jnp.nan, number.dtype) if length else None


def recorded(
    trace: Float[Array, "trace batch"] | None,
    at: Int[Array, " batch"],
    cost: Float[Array, " batch"],
) -> Float[Array, "trace batch"] | None:
    """The trace with one more value of each problem; those beyond its end are not kept."""
    if trace is None:
        return None
    return jnp.where(jnp.arange(trace.shape[0])[:, None] == at, cost, trace)


class Rounding(eqx.Module):
    """Rounding errors of the residuals due to the size of the coordinates, for each problem.

    Attributes:
        residual: rounding error of one whitened residual.
        vanished: the cost below which residuals are nothing but rounding.
    """

    residual: Float[Array, " batch"]
    vanished: Float[Array, " batch"]

    @classmethod
    def of(cls, iterate: Iterate, observation: Observation, images: ImagePlanes) -> Rounding:
        """From the size of the coordinates."""
        return cls.at(largest_coordinate(iterate, images), observation.largest_weight(), images)

    @classmethod
    def at(cls, largest_coordinate: Array, weight: Array, images: ImagePlanes) -> Rounding:
        """From the size of the coordinates and the largest weight of a mm."""
        one = jnp.finfo(largest_coordinate.dtype).eps * largest_coordinate * weight
        return cls(one, 3 * images.mask.shape[1] * (2 * one) ** 2)


def largest_coordinate(iterate: Iterate, images: ImagePlanes) -> Float[Array, " batch"]:
    """The largest coordinate of a problem's poses and target, mm."""
    away = jnp.max(images.mask * jnp.max(jnp.abs(images.origin), axis=0), axis=1)
    return jnp.maximum(away, jnp.max(jnp.abs(iterate.point), axis=0))


def gradient_cosine(
    normal: NormalEquations, vanished: Float[Array, " batch"]
) -> Float[Array, " batch"]:
    """max_k |g_k| / (|J_k| |r|), 0 where the residuals vanish; NaN where the cost is not finite."""
    length = jnp.sqrt(jnp.abs(normal.diagonal()) * normal.cost)
    cosine = jnp.max(jnp.abs(normal.gradient) / jnp.where(length > 0, length, 1.0), axis=0)
    cosine = jnp.where(jnp.isfinite(normal.cost), cosine, jnp.nan)
    return jnp.where(normal.cost <= vanished, 0.0, cosine)


def damped_step(
    normal: NormalEquations, damping: Float[Array, " batch"]
) -> tuple[Float[Array, "p batch"], Float[Array, " batch"], Bool[Array, " batch"]]:
    """The damped step, the decrease of half the cost that it predicts, and where there is none.

    The step is zero where the matrix is not positive definite.
    """
    damping = damping + 16 * jnp.finfo(damping.dtype).eps
    diagonal = normal.diagonal()
    diagonal = jnp.where(diagonal > 0, diagonal, 1.0)
    eye = jnp.eye(len(diagonal), dtype=damping.dtype)[..., None]
    matrix, gradient = barrier((normal.stacked() + damping * diagonal * eye, normal.gradient))
    move = barrier(dense.solve_batch_last(matrix, -gradient))
    indefinite = jnp.logical_not(jnp.isfinite(jnp.sum(move, axis=0)))
    move = jnp.where(indefinite, 0.0, move)
    held = damping * diagonal * move - normal.gradient
    return barrier(move), 0.5 * jnp.sum(held * move, axis=0), indefinite


def iterate_once(
    state: Descent,
    equations: Equations,
    rounding: Rounding,
    tolerance: float,
    max_steps: int,
    *,
    undamped: bool = False,
    decrease_exact: float = DAMPING_DECREASE_EXACT,
    exact_below: float = EXACT_BELOW,
) -> Descent:
    """Evaluate every active problem's candidate, and choose the next one.

    Normal equations are used at once and not stored: to evaluate an iterate again, where a step
    from it has failed, is cheaper than to keep them for every problem.
    """
    normal = barrier(equations(state.candidate, state.exact_next))

    half = 0.5 * jnp.where(state.retry, normal.cost, state.cost)
    accept, damping, stalled = state.judged(
        half, 0.5 * normal.cost, rounding.residual, decrease_exact=decrease_exact
    )
    if undamped:
        accept, damping = jnp.isfinite(normal.cost), jnp.zeros_like(damping)
    iterate = choose(accept & state.active, state.candidate, state.iterate)
    cost = jnp.where(accept, normal.cost, state.cost)
    cosine = jnp.where(accept, gradient_cosine(normal, rounding.vanished), state.cosine)

    move, predicted, indefinite = damped_step(normal, damping)
    indefinite = indefinite & accept
    # Indefinite: the same iterate again without second derivatives, or with more damping.
    more = jnp.maximum(DAMPING_INCREASE * damping, LEAST_DAMPING)
    damping = jnp.where(indefinite & (state.exact_next == 0), more, damping)
    retry = indefinite | jnp.logical_not(accept)
    exact_next = (cosine < exact_below) & jnp.logical_not(indefinite | undamped)

    # What the step leads to; whether it is the last one is decided below.
    after = Descent(
        iterate=iterate,
        cost=cost,
        cosine=cosine,
        candidate=choose(retry, iterate, state.candidate.moved(move)),
        retry=retry,
        exact_used=jnp.where(accept, state.exact_next, state.exact_used),
        exact_next=jnp.where(exact_next, 1.0, 0.0).astype(half.dtype),
        damping=damping,
        predicted=predicted,
        stalled=stalled,
        iterations=state.iterations + 1,
        converged=state.converged,
        active=state.active,
        trace=recorded(state.trace, state.iterations, cost),
    )
    return _stopped(state, after, tolerance, max_steps)


def _stopped(before: Descent, after: Descent, tolerance: float, max_steps: int) -> Descent:
    """The state after a pass, with every problem ended that is done or given up.

    A last step that is not evaluated is taken here: its candidate becomes the iterate.

    Args:
        before: the state before the pass; problems that had ended keep all of it.
        after: the state that the pass and the next step lead to.
        tolerance: gradient cosine to stop at.
        max_steps: most passes.
    """
    cosine, stalled = after.cosine, after.stalled >= MOST_STALLED
    given_up = stalled | (after.damping > LARGEST_DAMPING) | (after.iterations >= max_steps)
    squared_cosine = QUADRATIC_FACTOR * cosine * cosine
    final_step = (
        (before.exact_next > 0)
        & (after.damping < LITTLE_DAMPING)
        & jnp.logical_not(after.retry)
        & (squared_cosine <= tolerance)
        & (after.predicted <= FINAL_DECREASE * after.cost)
        & (cosine > tolerance)
    )
    ended = replace(
        after,
        cosine=jnp.where(final_step, squared_cosine, cosine),
        converged=(cosine <= CONVERGED_WITHIN * tolerance) | final_step | stalled,
        active=(cosine > tolerance) & jnp.logical_not(given_up | final_step),
    )
    found = choose(before.active, ended, replace(before, iterate=after.iterate))
    last = choose(final_step & before.active, after.candidate, found.iterate)
    return replace(found, iterate=last)


def minimise(
    start: Iterate,
    observation: Observation,
    images: ImagePlanes,
    *,
    medium: MediumPrior | None = None,
    damping: float = 1e-3,
    tolerance: float | None = None,
    max_steps: int = 100,
    trace: int = 0,
    together: bool = False,
) -> Minimum:
    """Minimise every problem's objective.

    Args:
        start: unknowns to start from.
        observation: the objective.
        images: the data.
        medium: prior of further unknowns, or None.
        damping: first lambda, relative to the diagonal; 0 for Gauss-Newton, which takes every step.
        tolerance: gradient cosine to stop at; by default 1e-10 in float64, 1e-4 in float32.
        max_steps: most passes.
        trace: how many values of the cost to keep.
        together: the problems take much the same number of passes, so that none go on alone
            (:func:`jaxcal.solvers.batch_loop.until_done`).

    Returns:
        Where it stopped, for every problem.

    Raises:
        InputError: a start or SDs of another number of problems than the data, or a start of
            another dtype; arrays of 64 bits while these are switched off; a ``tolerance`` or
            ``damping`` below zero or no number; ``max_steps`` or ``trace`` that is no whole number.
    """
    check_size("damping", damping, 0.0, unit="")
    if tolerance is not None:
        check_size("tolerance", tolerance, 0.0, unit="")
    if not is_traced(max_steps):
        whole_number("max_steps", max_steps, 1, MOST_STEPS)
    whole_number("trace", trace, 0, MOST_STEPS)
    batch, dtype = images.batch_size, images.mask.dtype
    for name, array in (("start", start.point), ("sigma", observation.sigma)):
        if array.ndim != 2 or array.shape[1] != batch:
            raise InputError(
                f"{name} must be of {batch} problems (the last axis), as the images are; its shape "
                f"is {array.shape}"
            )
    if start.point.dtype != dtype or (dtype == jnp.float64 and not is_float64_on()):
        raise InputError(
            f"start is of {start.point.dtype}, the images are of {dtype}: make all arrays, and "
            "call this, with 64 bits switched on"
        )
    if tolerance is None:
        tolerance = default_tolerance(images.mask.dtype)
    data = (start, observation, images, medium)
    # Step by step, JAX would compile the loop in every call.
    run = _minimised if inside_transformation(data, max_steps) else _compiled
    return run(*data, damping, tolerance, max_steps, trace, together)


def _minimised(
    start: Iterate,
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None,
    damping: float,
    tolerance: float,
    max_steps: int,
    trace: int,
    together: bool,
) -> Minimum:
    """:func:`minimise` of checked arguments."""
    images = images.padded()
    images, observation = barrier((images, observation.padded(images)))
    rounding = barrier(Rounding.of(start, observation, images))
    undamped = damping == 0
    # The curvature jumps where offsets reach or leave their bounds, so a good exact step says
    # little about the next one.
    decrease_exact = (
        DAMPING_DECREASE if isinstance(observation, LocalUnknown) else DAMPING_DECREASE_EXACT
    )

    def one(state: Descent, data: tuple) -> Descent:
        observation, images, medium, rounding = data

        def equations(iterate: Iterate, exact: Array) -> NormalEquations:
            return accumulate(iterate, observation, images, None if undamped else exact, medium)

        return iterate_once(
            state,
            equations,
            rounding,
            tolerance,
            max_steps,
            undamped=undamped,
            decrease_exact=decrease_exact,
        )

    number = jnp.zeros_like(images.mask[:, 0])
    begun = Descent.first(start, number, damping, trace, exact_next=number)
    data = (observation, images, medium, rounding)
    ended = until_done(one, begun, data, lambda s: s.active, together=together)
    return Minimum(*(getattr(ended, field.name) for field in fields(Minimum)))


_compiled = eqx.filter_jit(_minimised)


def default_tolerance(dtype: jnp.dtype) -> float:
    """Gradient cosine that the arithmetic of ``dtype`` can reach."""
    return 1e-10 if float(jnp.finfo(dtype).eps) < 1e-10 else 1e-4
