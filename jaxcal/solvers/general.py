"""The package's Levenberg-Marquardt for any least-squares problem, behind optimistix's interface.

The loop is that of :mod:`jaxcal.solvers.levenberg_marquardt`, which needs normal equations and a
step; here the normal equations come from residuals of any shape by one forward tangent for each
unknown. :class:`LevenbergMarquardt` is passed to ``optimistix.least_squares`` like any solver of
optimistix, which then also provides the derivatives of the solution. :func:`arrow_least_squares` is
for problems with shared unknowns and one local unknown a row. Row i depends on its own local
unknown only, so one tangent of ones gives the derivatives by all of them, and they are eliminated
by scalar divisions,

    S = A - sum_i E_i E_i' / D_i,     S dx = -(g - sum_i E_i d_i / D_i),
    dy_i = -(d_i + E_i' dx) / D_i,

with A, g of the shared unknowns, D_i, d_i of the local ones and E_i between them: O(n p^2) a step
where a dense solver takes O(n (n + p)^2). D_i is damped like the diagonal of A, with the lambda of
the step before.

Reference: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment: a modern synthesis", 2000,
section 6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from jaxcal import InputError
from jaxcal.runtime.array_types import AnyArray
from jaxcal.runtime.arrays import is_traced
from jaxcal.runtime.given_values import real_array, whole_number
from jaxcal.solvers.levenberg_marquardt import (
    CONVERGED_WITHIN,
    LARGEST_DAMPING,
    MOST_STALLED,
    Descent,
    Rounding,
    default_tolerance,
    iterate_once,
)
from jaxcal.solvers.normal_equations import NormalEquations
from jaxcal.solvers.plan import MOST_STEPS, check_size


class Local(eqx.Module):
    """One local unknown a row, and how they follow a step dx of the shared ones.

    Attributes:
        value: the unknowns y.
        slope: they move by dy = -(rest + slope dx).
        rest: the part of -dy that does not depend on dx.
        limit: largest magnitude of y.
        cosine: their gradient cosine, the largest of all rows, where the derivatives were last
            taken.
    """

    value: Float[Array, "n 1"]
    slope: Float[Array, "n p 1"]
    rest: Float[Array, "n 1"]
    limit: Float[Array, "n 1"]
    cosine: Float[Array, " 1"]

    def moved(self, step: Float[Array, "p 1"]) -> Local:
        """After a step of the shared unknowns."""
        along = self.value - self.rest - jnp.sum(self.slope * step, axis=1)
        return replace(self, value=jnp.clip(along, -self.limit, self.limit))


class Flat(eqx.Module):
    """Unknowns of one problem: the shared ones as a vector, and the local ones if there are any."""

    shared: Float[Array, "p 1"]
    local: Local | None = None

    def moved(self, step: Float[Array, "p 1"]) -> Flat:
        """After a step of the shared unknowns."""
        return Flat(self.shared + step, None if self.local is None else self.local.moved(step))


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """The package's Levenberg-Marquardt as a solver of optimistix, for dense residuals.

    The first attributes are those of optimistix's own solvers, in their order.

    Attributes:
        rtol: without effect; optimistix asks every solver for it.
        atol: ``optimistix.root_find`` takes an answer for a root if the norm of its residuals is
            below this; without effect in ``optimistix.least_squares``.
        norm: see ``atol``; by default the largest magnitude.
        tolerance: gradient cosine to stop at: the largest between the residuals and a column of
            their Jacobian; by default 1e-10 in float64, 1e-4 in float32.
        damping: first lambda, relative to the diagonal.

    Raises:
        InputError: a tolerance or damping below zero, or one that is no number.
    """

    rtol: float = 0.0
    atol: float = 1e-6
    norm: Callable[[PyTree], Array] = optx.max_norm
    tolerance: float | None = None
    damping: float = 1e-3

    def __check_init__(self) -> None:
        given = {"damping": self.damping, "rtol": self.rtol, "atol": self.atol}
        if self.tolerance is not None:
            given["tolerance"] = self.tolerance
        for name, value in given.items():
            check_size(name, value, 0.0, unit="")

    def _least_cosine(self, dtype: jnp.dtype) -> float:
        return default_tolerance(dtype) if self.tolerance is None else self.tolerance

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> tuple[Descent, Rounding, Any]:
        return self._before(Flat(ravel_pytree(y)[0][:, None]), *fn(y, args))

    def _before(self, start: Flat, value: Any, aux: Any) -> tuple[Descent, Rounding, Any]:
        dtype = start.shared.dtype
        number = jnp.zeros(1, dtype)
        state = Descent.first(start, number, self.damping, exact_next=number)
        rounding = jnp.finfo(dtype).eps * jnp.max(jnp.abs(ravel_pytree(value)[0]))[None]
        return state, Rounding(rounding, 0.0 * rounding), aux

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> tuple:
        descent, rounding, aux = state
        _, unravel = ravel_pytree(y)

        def residual(shared: Array) -> tuple[Array, Any]:
            value, beside = fn(unravel(shared), args)
            return ravel_pytree(value)[0], beside

        here = descent.candidate.shared
        normal, beside = _normal(residual, here[:, 0])
        tolerance = self._least_cosine(here.dtype)
        # optimistix counts the steps.
        after = iterate_once(
            descent, lambda iterate, exact: normal, rounding, tolerance, 2**30, exact_below=0.0
        )
        found = after.iterate.shared
        # That of the answer, as optimistix wants it: by it root_find judges whether this is a root.
        taken = jnp.array_equal(found, here)
        aux = jax.tree.map(lambda new, old: jnp.where(taken, new, old), beside, aux)
        return unravel(found[:, 0]), (after, rounding, aux), aux

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        descent, _, _ = state
        done = jnp.logical_not(descent.active[0])
        failed = done & jnp.logical_not(descent.converged[0])
        result = optx.RESULTS.where(
            failed, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return done, result

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
    ) -> tuple[Any, Any, dict[str, Any]]:
        return y, aux, {}


def _normal(
    residual: Callable[[Array], tuple[Array, Any]], here: Float[Array, " p"]
) -> tuple[NormalEquations, Any]:
    """Gauss-Newton's normal equations of dense residuals, as those of a batch of one; and aux."""
    value, push, aux = jax.linearize(residual, here, has_aux=True)
    jacobian = jax.vmap(push)(jnp.eye(here.shape[0], dtype=here.dtype))
    return _packed(jacobian @ jacobian.T, jacobian @ value, jnp.sum(value**2), None), aux


def _packed(matrix: Array, gradient: Array, cost: Array, squares: Array | None) -> NormalEquations:
    upper = matrix[np.triu_indices(len(matrix))]
    wide = None if squares is None else squares[:, None]
    return NormalEquations(upper[:, None], gradient[:, None], cost[None], wide)


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

    Args:
        residual: from (shared, local, args) to (n, columns); row i depends on local[i] only.
        shared: first value of the shared unknowns, any pytree of floating arrays.
        local: first value of the local unknowns, one a row; taken to the bound where it is beyond.
        args: passed to the residuals; the solution is differentiable with respect to it, by
            optimistix's implicit derivatives.
        limit: bound on the magnitude of the local unknowns; inf where there is none.
        damping: first Levenberg-Marquardt lambda relative to the diagonal.
        tolerance: gradient cosine to stop at; by default 1e-10 in float64, 1e-4 in float32.
        max_steps: most linearisations.
        throw: raise where ``max_steps`` do not suffice; else the solution's ``result`` says so.

    Returns:
        optimistix's solution; its ``value`` is (shared, local).

    Raises:
        InputError: shared unknowns that are integers, local ones that are not one a row, residuals
            of another shape, or (outside transformations) rows that depend on the local unknowns of
            other rows; a ``limit``, ``tolerance`` or ``damping`` below zero; ``max_steps``
            that is no whole number.
    """
    whole_number("max_steps", max_steps, 1, MOST_STEPS)
    flat, unravel = ravel_pytree(shared)
    if not jnp.issubdtype(flat.dtype, jnp.floating):
        raise InputError("shared must hold floating arrays, e.g. 0.0 instead of 0")
    if jnp.ndim(local) != 1:
        raise InputError(f"local must be one number a row, not of shape {jnp.shape(local)}")
    first = (flat, jnp.asarray(local, flat.dtype))
    made = jax.eval_shape(lambda s, y: residual(s, y, args), unravel(flat), first[1])
    shape, rows = getattr(made, "shape", None), len(first[1])
    if shape is None or len(shape) != 2 or shape[0] != rows or not rows or not shape[1]:
        got = f"an array of shape {shape}" if shape is not None else f"a {type(made).__name__}"
        raise InputError(f"residual must return a ({rows or 'n'}, columns) array, not {got}")
    bound = _bound(limit, rows).astype(flat.dtype)
    # A step clips what it moves, and one beyond its bound would be held there.
    first = (flat, jnp.clip(first[1], -bound, bound))
    function = _FlatResidual(residual, unravel)
    if not is_traced((shared, local, args)):
        _check_locality(function, first, args)

    solver = _ArrowSolver(tolerance=tolerance, damping=damping, limit=bound)
    solution = optx.least_squares(function, solver, first, args, max_steps=max_steps, throw=throw)
    found = solution.value
    return eqx.tree_at(lambda s: s.value, solution, (unravel(found[0]), found[1]))


class _FlatResidual(eqx.Module):
    """Residuals of flat shared unknowns: equal for equal ``residual``, so compiled once."""

    residual: Callable[[Any, Array, Any], Array]
    unravel: Callable[[Array], Any] = eqx.field(static=True)

    def __call__(self, unknowns: tuple[Array, Array], args: Any) -> Float[Array, "n columns"]:
        return self.residual(self.unravel(unknowns[0]), unknowns[1], args)


def _check_locality(function: _FlatResidual, first: tuple[Array, Array], args: Any) -> None:
    """Refuse residuals whose rows depend on other rows' local unknowns.

    The derivatives are along a direction of random signs, and along its positive part. In rows with
    a positive sign both are the same, unless such a row depends on a row with a negative one.
    """
    signs = np.where(np.random.default_rng(0).random(len(first[1])) < 0.5, -1.0, 1.0)
    along = jnp.asarray([signs, np.maximum(signs, 0.0)], first[1].dtype)
    whole, part = np.asarray(_derivatives(function, first, args, along))[:, signs > 0]
    largest = np.max(np.abs(whole), initial=0.0)
    # What is not finite is for the solver to tell of.
    if np.max(np.abs(whole - part), initial=0.0) > _SAME * largest:
        raise InputError(
            "a row of the residuals depends on the local unknown of another row: the rows must "
            "depend on their own one only (and on the shared ones)"
        )


@eqx.filter_jit
def _derivatives(
    function: _FlatResidual, at: tuple[Array, Array], args: Any, along: Float[Array, "k n"]
) -> Float[Array, "k n columns"]:
    """Derivatives of residuals by the local unknowns along some directions."""

    def rows(local: Array) -> Array:
        return function((at[0], local), args)

    return jax.vmap(lambda way: jax.jvp(rows, (at[1],), (way,))[1])(along)


_SAME = 1e-3
"""Two derivatives are the same if they differ by less than this share of the largest."""


def _bound(limit: Any, rows: int) -> Float[Array, " n"]:
    """The bound on every row's local unknown, checked as far as it has values."""
    if not is_traced(limit):
        limit = real_array(limit, "limit")
        if not (limit >= 0).all():
            raise InputError("limit must be a number of at least 0, or one for each row")
    if jnp.shape(limit) not in ((), (rows,)):
        raise InputError(f"limit must be one number or {rows}, not of shape {jnp.shape(limit)}")
    return jnp.broadcast_to(jnp.asarray(limit), (rows,))


class _ArrowSolver(LevenbergMarquardt):
    """The same for unknowns (shared, local)."""

    limit: Float[Array, " n"] = eqx.field(default=None)  # pyright: ignore[reportAssignmentType]

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> tuple[Descent, Rounding, Any]:
        return self._before(self._at(fn, y, args, self.damping)[0], *fn(y, args))

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> tuple:
        descent, rounding, aux = state
        here = descent.candidate
        at = here.shared[:, 0], here.local.value[:, 0]
        candidate, normal = self._at(fn, at, args, descent.damping)
        # The candidate's own derivatives say how its local unknowns follow the next step.
        descent = eqx.tree_at(lambda state: state.candidate, descent, candidate)
        tolerance = self._least_cosine(here.shared.dtype)
        # optimistix counts the steps.
        after = iterate_once(
            descent, lambda iterate, exact: normal, rounding, tolerance, 2**30, exact_below=0.0
        )
        iterate = after.iterate
        # A step knows of the shared unknowns' gradient alone. Where that is zero, the local ones
        # may be far from their minimum still.
        still = iterate.local.cosine
        stalled = after.stalled >= MOST_STALLED
        stopped = stalled | (after.damping > LARGEST_DAMPING)
        after = eqx.tree_at(
            lambda state: (state.active, state.converged),
            after,
            (
                after.active | (still > tolerance) & jnp.logical_not(stopped),
                after.converged & ((still <= CONVERGED_WITHIN * tolerance) | stalled),
            ),
        )
        return (iterate.shared[:, 0], iterate.local.value[:, 0]), (after, rounding, aux), aux

    def _at(
        self, fn: Any, y: tuple[Array, Array], args: Any, damping: Array | float
    ) -> tuple[Flat, NormalEquations]:
        """The unknowns with their derivatives, and the normal equations without local unknowns."""

        def residual(shared: Array, local: Array) -> Array:
            return fn((shared, local), args)[0]

        value, push = jax.linearize(residual, *y)
        ones, still = jnp.ones_like(y[1]), jnp.zeros_like(y[0])
        jacobian = jax.vmap(lambda unit: push(unit, 0 * ones))(
            jnp.eye(len(still), dtype=still.dtype)
        )
        own = push(still, ones)
        diagonal, pull = jnp.sum(own**2, axis=1), jnp.sum(own * value, axis=1)
        coupling = jnp.einsum("anm,nm->na", jacobian, own)
        # A local unknown at its bound stays there if a step down would lead beyond it.
        held = (y[1] >= self.limit) & (pull <= 0) | (y[1] <= -self.limit) & (pull >= 0)
        damped = jnp.where(diagonal > 0, diagonal * (1 + damping), 1.0)
        give = jnp.where(held | (diagonal <= 0), 0.0, 1 / damped)
        shared = jnp.einsum("anm,bnm->ab", jacobian, jacobian)
        gradient = jnp.einsum("anm,nm->a", jacobian, value)
        cost = jnp.sum(value**2)
        length = jnp.sqrt(diagonal * cost)
        cosine = jnp.abs(jnp.where(held, 0.0, pull)) / jnp.where(length > 0, length, 1.0)
        # The Schur complement: local unknowns that are not held follow the shared ones.
        normal = _packed(
            shared - (coupling * give[:, None]).T @ coupling,
            gradient - (give * pull) @ coupling,
            cost,
            jnp.diagonal(shared),
        )
        local = Local(
            value=y[1][:, None],
            slope=(give[:, None] * coupling)[..., None],
            rest=(give * pull)[:, None],
            limit=self.limit[:, None],
            cosine=jnp.max(cosine, initial=0.0)[None],
        )
        return Flat(y[0][:, None], local), normal
