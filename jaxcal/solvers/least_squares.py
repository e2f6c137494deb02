"""Gauss-Newton and Levenberg-Marquardt on an arrow-shaped problem, through optimistix.

The loop, acceptance and bookkeeping are optimistix's ``AbstractGaussNewton``. Ours are the three
pieces that it asks for: a *descent* that reads the Jacobian by p unit tangents and one all-ones
offset tangent (rows see only their own offset, so one tangent colours them all) and solves the
damped arrow system of :mod:`jaxcal.solvers.arrow`; a *search* that turns the gain ratio into the
next damping and keeps the trace of the objective; and a *termination* on the scaled KKT residual,
since optimistix's default, on the change of the iterate, takes twice the steps that are needed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jaxcal.geometry import AnyArray
from jaxcal.model.parameters import Blocks, Parameters, retract, size
from jaxcal.model.priors import AbstractPrior
from jaxcal.problem import Problem
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers.arrow import Arrow


class Unknowns(eqx.Module):
    """Tangent of the shared unknowns about their reference, and the offset unknowns."""

    tangent: Float[Array, " p"]
    offset: Float[Array, " k"]


class Fit(eqx.Module):
    """Where a solver stopped.

    Attributes:
        parameters: the shared unknowns.
        offset: the prior's offset unknowns.
        cost: sum of squared (whitened) residuals.
        stationarity: scaled KKT residual there.
        settled: whether it stopped because it had arrived, as far as rounding allows.
        iterations: linearisations taken.
        trace: (trace,) cost after each of the first iterations; NaN beyond the last; None if none
            was asked for (lax.map cannot chunk arrays without elements).
    """

    parameters: Parameters
    offset: Float[Array, " k"]
    cost: Float[Array, ""]
    stationarity: Float[Array, ""]
    settled: Bool[Array, ""]
    iterations: Int[Array, ""]
    trace: Float[Array, " trace"] | None


def linearise(
    parameters: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    problem: Problem,
    blocks: Blocks,
) -> tuple[Arrow, Float[Array, "p n m"], Float[Array, "n m"]]:
    """The arrow, the Jacobian (along each shared unknown) and the residuals at a point."""

    def residual(unknowns: Unknowns) -> Float[Array, "n m"]:
        return prior.residual(
            retract(parameters, unknowns.tangent, blocks), unknowns.offset, problem
        )

    here = Unknowns(jnp.zeros(size(blocks), offset.dtype), offset)
    value, push = jax.linearize(residual, here)
    jacobian, offset_jacobian = _read_jacobian(push, here)
    limit = prior.limit(parameters, problem)
    return arrows.build(value, jacobian, offset_jacobian, offset, limit), jacobian, value


def exact_arrow(
    residual: Callable[[Unknowns, None], Array], here: Unknowns, limit: Float[Array, " k"]
) -> Arrow:
    """The arrow of the exact Hessian of 1/2 |r|^2, read from its gradient by p + 1 tangents."""

    def cost(unknowns: Unknowns) -> Float[Array, ""]:
        return 0.5 * jnp.sum(residual(unknowns, None) ** 2)

    gradient, push = jax.linearize(jax.grad(cost), here)
    still = jnp.zeros_like(here.offset)
    unit = jnp.eye(here.tangent.shape[0], dtype=here.tangent.dtype)
    columns = jax.vmap(lambda direction: push(Unknowns(direction, still)))(unit)
    along = push(Unknowns(jnp.zeros_like(here.tangent), jnp.ones_like(here.offset)))
    return Arrow(
        shared=columns.tangent,
        coupling=columns.offset.T,
        diagonal=along.offset,
        gradient=gradient.tangent,
        offset_gradient=gradient.offset,
        free=arrows.free_offsets(gradient.offset, here.offset, limit),
        cost=2 * cost(here),
    )


def _read_jacobian(
    push: Callable[[Unknowns], Array], here: Unknowns
) -> tuple[Float[Array, "p n m"], Float[Array, "k m"]]:
    count = here.tangent.shape[0]
    still = jnp.zeros_like(here.offset)
    unit = jnp.eye(count, dtype=here.tangent.dtype)
    jacobian = jax.vmap(lambda direction: push(Unknowns(direction, still)))(unit)
    if here.offset.shape[0] == 0:
        return jacobian, jnp.zeros((0, jacobian.shape[2]), jacobian.dtype)
    ones = jnp.ones_like(here.offset)
    return jacobian, push(Unknowns(jnp.zeros_like(here.tangent), ones))


class _DescentState(eqx.Module):
    arrow: Arrow
    exact: Arrow | None
    here: Unknowns


class ArrowDescent(optx.AbstractDescent):
    """Damped Newton step of the arrow system; offsets stay within their limits.

    Far from the optimum the step is Gauss-Newton's. Near it (gradient cosine below ``gate``) the
    exact second derivatives take over where they are given and positive definite: along a direction
    that the data barely see, what Gauss-Newton leaves out outweighs what it keeps, and it crawls.

    Attributes:
        limit: bound on the offset unknowns.
        damping: lambda at step size 1; 0 makes it Gauss-Newton.
        best_offset: from a tangent to the offsets that are optimal there, where the prior knows
            them in closed form; else None, and the linear back-substitution is clipped.
        exact: from unknowns to the arrow of exact second derivatives, or None.
        gate: gradient cosine below which the exact arrow is used.
    """

    limit: Float[Array, " k"]
    damping: float
    best_offset: Callable[[Array], Array] | None = None
    exact: Callable[[Unknowns], Arrow] | None = None
    gate: float = 0.03

    def init(self, y: Unknowns, f_info_struct: Any) -> _DescentState:
        p, k, dtype = y.tangent.shape[0], y.offset.shape[0], y.tangent.dtype
        empty = Arrow(
            jnp.eye(p, dtype=dtype), jnp.zeros((k, p), dtype), jnp.ones(k, dtype),
            jnp.full(p, jnp.inf, dtype), jnp.zeros(k, dtype), jnp.ones(k, dtype),
            jnp.ones((), dtype),
        )  # fmt: skip
        return _DescentState(empty, None if self.exact is None else empty, y)

    def query(self, y: Unknowns, f_info: Any, state: _DescentState) -> _DescentState:
        jacobian, offset_jacobian = _read_jacobian(f_info.jac.mv, y)
        arrow = arrows.build(f_info.residual, jacobian, offset_jacobian, y.offset, self.limit)
        return _DescentState(arrow, None if self.exact is None else self.exact(y), y)

    def step(self, step_size: Array, state: _DescentState) -> tuple[Unknowns, optx.RESULTS]:
        damping = jnp.asarray(self.damping, state.arrow.cost.dtype) / step_size
        tangent, offset = arrows.solve(state.arrow, damping)
        if state.exact is not None:
            newton, newton_offset = arrows.solve(state.exact, damping)
            near = arrows.stationarity(state.arrow) <= self.gate
            # The Cholesky factor of an indefinite matrix is NaN.
            use = near & jnp.all(jnp.isfinite(newton)) & jnp.all(state.exact.diagonal > 0)
            tangent = jnp.where(use, newton, tangent)
            offset = jnp.where(use, newton_offset, offset)
        if self.best_offset is None:
            moved = jnp.clip(state.here.offset + offset, -self.limit, self.limit)
        else:
            moved = self.best_offset(state.here.tangent + tangent)
        return Unknowns(tangent, moved - state.here.offset), optx.RESULTS.successful


class _SearchState(eqx.Module):
    step_size: Float[Array, ""]
    count: Int[Array, ""]
    idle: Int[Array, ""]
    trace: Float[Array, " trace"]


class GainRatio(optx.AbstractSearch):
    """Accept a step by the ratio of actual to predicted decrease; adapt the damping.

    Near the optimum the decrease sinks below the rounding of the objective while the gradient is
    still worth reducing; a step that raises the objective by no more than that rounding is taken,
    but only a few such in a row.

    Attributes:
        rounding: of one residual.
        trace: how many values of the objective to keep.
        always: take every step (Gauss-Newton).
    """

    rounding: Float[Array, ""]
    trace: int = eqx.field(static=True)
    always: bool = eqx.field(static=True)

    def init(self, y: Unknowns, f_info_struct: Any) -> _SearchState:
        dtype = y.tangent.dtype
        zero = jnp.zeros((), jnp.int32)
        return _SearchState(jnp.ones((), dtype), zero, zero, jnp.full(self.trace, jnp.nan, dtype))

    def step(
        self,
        first_step: Bool[Array, ""],
        y: Unknowns,
        y_eval: Unknowns,
        f_info: Any,
        f_eval_info: Any,
        state: _SearchState,
    ) -> tuple[Array, Bool[Array, ""], optx.RESULTS, _SearchState]:
        difference = jax.tree.map(jnp.subtract, y_eval, y)
        before, after = f_info.as_min(), f_eval_info.as_min()
        linear = f_info.jac.mv(difference) + f_info.residual
        predicted = before - 0.5 * jnp.sum(linear**2)
        # Each residual is off by its rounding, so half their sum of squares by this much.
        rounding = 8 * jnp.finfo(before.dtype).eps * before
        rounding = rounding + 2 * self.rounding * jnp.sqrt(before)
        decrease = before - after
        accept = first_step | (decrease >= 1e-4 * predicted - rounding)
        if self.always:
            accept = jnp.isfinite(after)
        good = (decrease >= 0.25 * predicted - rounding) & jnp.logical_not(first_step)
        factor = jnp.where(good, 10.0, 1.0)
        factor = jnp.where(accept, factor, 0.2).astype(before.dtype)
        idle = jnp.where(first_step | (decrease > rounding), 0, state.idle + 1)
        # A rejected step is followed by a shorter one, which may well gain.
        idle = jnp.where(accept, idle, state.idle)
        trace = state.trace
        if self.trace:
            cost = 2 * jnp.where(accept, after, before)
            trace = jnp.where(jnp.arange(self.trace) == state.count, cost, trace)
        step_size = state.step_size * factor
        new_state = _SearchState(step_size, state.count + 1, idle, trace)
        return step_size, accept, optx.RESULTS.successful, new_state


class ArrowLeastSquares(optx.AbstractGaussNewton):
    """optimistix's Gauss-Newton loop with our descent, search and termination.

    Attributes:
        atol: the scaled KKT residual to stop at.
        rounding: what rounding of the coordinates leaves of a residual that is zero.
        residuals: how many there are.
    """

    rtol: float
    atol: Array | float  # pyright: ignore[reportIncompatibleVariableOverride]
    rounding: Float[Array, ""]
    residuals: int = eqx.field(static=True)
    descent: ArrowDescent  # pyright: ignore[reportIncompatibleVariableOverride]
    search: GainRatio  # pyright: ignore[reportIncompatibleVariableOverride]
    norm: Callable = optx.max_norm
    verbose: Callable[..., None] = eqx.field(static=True, default=lambda **_: None)

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        arrow = state.descent_state.arrow
        done = (arrows.stationarity(arrow) <= self.atol) | self.vanished(arrow)
        # Rounding is all that is left: no gain in a row of steps, or no step short enough to gain.
        stuck = (state.search_state.idle >= 4) | (state.search_state.step_size < 1e-12)
        return jnp.logical_not(state.first_step) & (done | stuck), optx.RESULTS.successful

    def vanished(self, arrow: Arrow) -> Bool[Array, ""]:
        """Whether the residuals (n images, three each) are no more than rounding."""
        return arrow.cost <= self.residuals * (2 * self.rounding) ** 2


def minimise(
    start: Parameters,
    prior: AbstractPrior,
    problem: Problem,
    blocks: Blocks,
    *,
    offset: Float[Array, " k"] | None = None,
    damping: float = 1e-3,
    tolerance: float | Array | None = None,
    max_steps: int = 100,
    exact: bool = False,
    trace: int = 0,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> Fit:
    """Minimise the prior's sum of squares over the shared unknowns and every offset, jointly.

    Args:
        start: the unknowns to start from (and the reference of the tangent space).
        prior: residuals and offset unknowns.
        problem: one problem (no batch axes; vmap over it).
        blocks: which shared unknowns are free.
        offset: offset unknowns to start from; by default the prior's own.
        damping: first Levenberg-Marquardt lambda relative to the diagonal; 0 for Gauss-Newton.
        tolerance: scaled KKT residual to stop at; by default 1e-10 in float64, 1e-4 in float32.
        max_steps: most linearisations.
        exact: use exact second derivatives near the optimum.
        trace: how many values of the objective to keep.
        solver: another optimistix solver, which stops by a rule of its own; damping, tolerance,
            exact and trace are then of no effect.

    Returns:
        A :class:`Fit`; it never raises, the caller judges by its stationarity.
    """
    dtype = problem.mask.dtype
    eps = float(jnp.finfo(dtype).eps)
    if tolerance is None:
        tolerance = 1e-10 if eps < 1e-10 else 1e-4
    if offset is None:
        offset = prior.start(start, problem)
    limit = prior.limit(start, problem)

    def residual(unknowns: Unknowns, _: None) -> Float[Array, "n m"]:
        return prior.residual(retract(start, unknowns.tangent, blocks), unknowns.offset, problem)

    def best_offset(tangent: Float[Array, " p"]) -> Float[Array, " k"]:
        return prior.start(retract(start, tangent, blocks), problem)

    def curvature(unknowns: Unknowns) -> Arrow:
        return exact_arrow(residual, unknowns, limit)

    first = Unknowns(jnp.zeros(size(blocks), dtype), offset)
    if solver is not None:
        found = optx.least_squares(residual, solver, first, max_steps=max_steps, throw=False)
        parameters = retract(start, found.value.tangent, blocks)
        arrow, _, _ = linearise(parameters, found.value.offset, prior, problem, blocks)
        return Fit(
            parameters=parameters,
            offset=found.value.offset,
            cost=arrow.cost,
            stationarity=arrows.stationarity(arrow),
            settled=found.result == optx.RESULTS.successful,
            iterations=jnp.asarray(found.stats["num_steps"]),
            trace=jnp.full(trace, jnp.nan, dtype) if trace else None,
        )
    reach = jnp.max(jnp.abs(problem.poses[:, :3, 3]) * problem.mask[:, None])
    reach = jnp.maximum(reach, jnp.max(jnp.abs(start.point)))
    rounding = eps * reach * prior.largest_weight()
    ours = ArrowLeastSquares(
        rtol=0.0,
        atol=tolerance,
        rounding=rounding,
        residuals=3 * problem.images,
        descent=ArrowDescent(
            limit,
            damping,
            best_offset if prior.closed_form_offset else None,
            curvature if exact else None,
        ),
        search=GainRatio(rounding, trace, damping == 0),
    )
    solution = optx.least_squares(residual, ours, first, max_steps=max_steps, throw=False)
    # The descent was last queried at the accepted iterate, which is the one returned.
    arrow = solution.state.descent_state.arrow
    stationarity = jnp.where(ours.vanished(arrow), 0.0, arrows.stationarity(arrow))
    return Fit(
        parameters=retract(start, solution.value.tangent, blocks),
        offset=solution.value.offset,
        cost=arrow.cost,
        stationarity=stationarity,
        settled=(stationarity <= 10 * tolerance) | (solution.state.search_state.idle >= 4),
        iterations=solution.stats["num_steps"],
        trace=solution.state.search_state.trace if trace else None,
    )


def arrow_least_squares(
    residual: Callable[[Any, Float[Array, " n"], Any], Float[Array, "n columns"]],
    shared: Any,
    local: Float[AnyArray, " n"],
    args: Any = None,
    *,
    limit: Float[AnyArray, " n"] | float = jnp.inf,
    damping: float = 1e-3,
    tolerance: float | None = None,
    max_steps: int = 100,
    throw: bool = True,
) -> optx.Solution:
    """Minimise any sum of squares with shared unknowns and one local unknown a row.

    Each step eliminates the local unknowns by scalar divisions, so that it costs O(n p^2) for p
    shared unknowns where a dense solver takes O(n (n + p)^2).

    Args:
        residual: from (shared, local, args) to (n, columns); row i depends on local[i] only.
        shared: first value of the shared unknowns, any pytree of floating arrays.
        local: first value of the local unknowns, one a row.
        args: what the residuals are differentiable in: derivatives of the solution with respect to
            it are optimistix's implicit ones.
        limit: bound on the magnitude of the local unknowns; inf where there is none.
        damping: first Levenberg-Marquardt lambda relative to the diagonal.
        tolerance: scaled KKT residual to stop at; by default 1e-10 in float64, 1e-4 in float32.
        max_steps: most linearisations.
        throw: raise where ``max_steps`` do not suffice; else the solution's ``result`` says so.

    Returns:
        optimistix's solution; its ``value`` is (shared, local).
    """
    flat, unravel = ravel_pytree(shared)
    eps = float(jnp.finfo(flat.dtype).eps)
    first = Unknowns(flat, jnp.asarray(local, flat.dtype))

    def function(unknowns: Unknowns, args: Any) -> Float[Array, "n columns"]:
        return residual(unravel(unknowns.tangent), unknowns.offset, args)

    value = function(first, args)
    rounding = jax.lax.stop_gradient(eps * jnp.max(jnp.abs(value)))
    solver = ArrowLeastSquares(
        rtol=0.0,
        atol=(1e-10 if eps < 1e-10 else 1e-4) if tolerance is None else tolerance,
        rounding=rounding,
        residuals=value.size,
        descent=ArrowDescent(jnp.broadcast_to(jnp.asarray(limit), first.offset.shape), damping),
        search=GainRatio(rounding, 0, False),
    )
    solution = optx.least_squares(function, solver, first, args, max_steps=max_steps, throw=throw)
    found = solution.value
    return eqx.tree_at(lambda s: s.value, solution, (unravel(found.tangent), found.offset))
