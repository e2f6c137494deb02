"""Closed-form conventional calibration of many problems at once, and its derivatives.

The mathematics is that of :mod:`jaxcal.solvers.closed_form.single`, written for arrays whose last
axis counts problems. After :mod:`jaxcal.solvers.closed_form.reduced_batch` a problem is a 6x6
matrix Q = C'C, a vector b = -C'g and the multipliers of its constraints:

    (Q + sum_j l_j A_j) x = b,    x' A_j x = e_j.

Newton's method on the dual starts at the multipliers of the orthonormal pair nearest to Q^-1 b. A
step is taken if M stays positive definite and the constraints are better met; otherwise it is cut.
The gap of the bound (:mod:`jaxcal.solvers.closed_form.reduced_objective`) is computed for every
problem, and only that decides whether an answer is called certified.

Derivatives follow from the implicit function theorem: with M = Q + sum_j l_j A_j and G = [A_j x],

    M dx + G dl = db - dQ x,    G' dx = 0.

They cost two solves with a known factor, in forward and reverse mode, and may be nested.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal import InputError
from jaxcal.data.geometry import orthonormal_pair
from jaxcal.data.problem import Problem
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.model import unrolled
from jaxcal.model.batch import ImagePlanes
from jaxcal.model.unrolled import Matrix, Vector
from jaxcal.runtime.arrays import is_traced, map_arrays
from jaxcal.runtime.jax_modes import in_standard_promotion, own_modes, require_float64, with_dtype
from jaxcal.solvers.closed_form.reduced_batch import ReducedBatch
from jaxcal.solvers.closed_form.reduced_objective import (
    CONSTRAINTS,
    NEARBY,
    ROUNDING,
    SINGULAR_SYSTEM,
    TOLERANCE,
    QuadraticConstraints,
    check_estimate,
)
from jaxcal.solvers.closed_form.single import ClosedForm, solve_problem

CHUNK = 256
"""Problems in one call of the compiled program."""

MOST_ONE_BY_ONE = 1024
"""Up to so many problems are solved one by one, in about a second; compiling takes six."""

NEWTON_STEPS = 30
"""Most steps of Newton's method on the dual."""
MET = 500
"""Constraints are met when they are off by less than this many roundings of |x|^2."""
SHORTER = 0.25
"""Factor on a step that was no better."""


def solve_batch(
    problems: Problem, estimate: tuple[str, ...], *, few: int = MOST_ONE_BY_ONE
) -> ClosedForm:
    """Conventional calibrations of problems with any leading axes, concrete or traced.

    Args:
        problems: the batch.
        estimate: as for :func:`jaxcal.calibrate_closed_form`.
        few: so many concrete problems are solved without a compiled program.

    Returns:
        Arrays with the problems' leading axes. Concrete problems give numpy arrays in float64. Few
        of them, and those that this module does not certify, are solved one by one, by
        :func:`jaxcal.solvers.closed_form.single.solve_problem`. One with NaN or fewer than 4 images
        gives NaN; traced, such a problem is not certified, and its numbers mean nothing.

    Raises:
        InputError: unknown names, a scale where there is none, or a transformation that began
            without JAX's 64 bits.
    """
    check_estimate(estimate, problems)
    problems = replace(
        problems, covariance=None, max_elevation=None, channels=None, sound_speed=None, delay=None
    )
    shape = problems.batch_shape
    flat = map_arrays(lambda leaf: leaf.reshape((-1, *leaf.shape[len(shape) :])), problems)
    if is_traced(problems):
        with own_modes(bits_too=False):
            require_float64("jaxcal.calibrate_closed_form")
            answer = solve_traceable(with_dtype(flat, np.float64), estimate)
    else:
        flat = map_arrays(lambda leaf: np.asarray(leaf, np.float64), flat)
        answer = _concrete(flat, estimate, few)
    return map_arrays(lambda leaf: leaf.reshape((*shape, *leaf.shape[1:])), answer)


def _concrete(problems: Problem, estimate: tuple[str, ...], few: int) -> ClosedForm:
    count = len(problems.mask)
    answer = _unsolved(problems) if count <= few else _by_chunks(problems, estimate)
    nothing = map_arrays(lambda leaf: leaf[0], _unsolved(problems)) if count else answer
    for k in np.flatnonzero(~answer.certified):
        try:
            alone = solve_problem(map_arrays(lambda leaf, k=k: leaf[k], problems), estimate)
        except InputError:
            alone = nothing
        for field in fields(ClosedForm):
            if getattr(answer, field.name) is not None:
                getattr(answer, field.name)[k] = getattr(alone, field.name)
    return answer


def _unsolved(problems: Problem) -> ClosedForm:
    """NaN and no proof for every problem (one leading axis)."""
    count = len(problems.mask)

    def nothing(*shape: int) -> np.ndarray:
        return np.full((count, *shape), np.nan)

    return ClosedForm(
        image_to_probe=nothing(4, 4),
        point=nothing(3),
        scale_mm_per_px=nothing(2) if problems.pixels else None,
        sound_speed_factor=nothing(),
        rms=nothing(),
        objective_mm2=nothing(),
        certified=np.zeros(count, bool),
        gap_mm2=nothing() + np.inf,
        unique=np.zeros(count, bool),
    )


def _by_chunks(problems: Problem, estimate: tuple[str, ...]) -> ClosedForm:
    """By the compiled program; the last chunk is filled up, or it would be another program."""
    count = len(problems.mask)
    filled = np.arange(-(-count // CHUNK) * CHUNK) % count
    parts = []
    with own_modes():
        for rows in filled.reshape(-1, CHUNK):
            part = map_arrays(lambda leaf, rows=rows: leaf[rows], problems)
            parts.append(_compiled(part, estimate))
    return jax.tree.map(
        lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves])[:count], *parts
    )


def solve_traceable(problems: Problem, estimate: tuple[str, ...]) -> ClosedForm:
    """Solve problems with one leading axis by array operations alone.

    Traceable and differentiable. Where the dual is not tight ``certified`` is False, and nothing
    shows that the answer is the minimum.
    """
    constraints = CONSTRAINTS[estimate]
    mask = (problems.mask > 0).astype(problems.poses.dtype)
    images = ImagePlanes.of(replace(problems.cleared(mask), mask=mask))
    reduced = ReducedBatch.of(images)
    matrix, vector, mean, count = reduced.matrix, reduced.rhs, reduced.mean, reduced.count
    x, values = _optimum(estimate, matrix, vector)
    x = _feasible(x, constraints)
    gap, least, definite = _gap(constraints, matrix, vector, x, values)
    # Sums from singular normal equations of t prove nothing.
    definite = definite & (reduced.smallest_pivot > SINGULAR_SYSTEM)

    of_mean, target = reduced.origin_and_target(x)
    scaled = constraints.scaled
    lengths = jnp.sqrt(jnp.sum(x.reshape(2, 3, -1) ** 2, axis=1))
    r1, r3 = x[:3] / lengths[0], x[3:] / lengths[1]
    shift = of_mean - mean[0] * x[:3] - mean[1] * x[3:]
    if scaled:
        # Pixel sizes do not stretch the range of row 0.
        shift = shift + reduced.face * (x[3:] - r3)
    lateral, axial = images.lateral - mean[0][:, None], images.distance - mean[1][:, None]
    points = x[:3, :, None] * lateral + x[3:, :, None] * axial + of_mean[..., None]
    turn = images.rotation.reshape(3, 3, *mask.shape)
    away = images.origin - reduced.centre[..., None]
    # Component by component: batched products of 3x3 matrices are slow.
    residuals = sum((turn[:, j] * points[j] for j in range(3)), away - target[..., None])
    objective = jnp.sum(mask * residuals**2, axis=(0, 2))
    size = jnp.sum(mask * away**2, axis=(0, 2)) + jnp.sum(reduced.squares, axis=0)
    rotation = jnp.stack([r1, jnp.cross(r3, r1, axis=0), r3], axis=1)
    corner = jnp.zeros((len(mask), 4, 4), x.dtype).at[:, 3, 3].set(1.0)
    transform = corner.at[:, :3, :3].set(jnp.moveaxis(rotation, -1, 0)).at[:, :3, 3].set(shift.T)
    rounding = ROUNDING * jnp.finfo(x.dtype).eps
    certified = definite & (count >= MINIMUM_IMAGES)
    certified = certified & (gap <= TOLERANCE * objective + rounding * size)
    # All that fits as well lies in a ball about the dual's minimiser (as in ``certify_point``).
    ball = 4 * (gap + rounding * size)
    alone = ball <= NEARBY**2 * least * jnp.sum(x * x, axis=0)
    scale = problems.spacing * lengths.T if scaled else problems.spacing
    return ClosedForm(
        image_to_probe=transform,
        point=(reduced.centre + target).T,
        scale_mm_per_px=scale if problems.pixels else None,
        sound_speed_factor=lengths[1] if constraints.free == ("axial",) else jnp.ones_like(count),
        rms=jnp.sqrt(objective / count),
        objective_mm2=objective,
        certified=certified,
        gap_mm2=jnp.where(definite, gap, jnp.inf),
        # M is positive definite, and so are the normal equations of t and c.
        unique=certified & alone,
    )


_compiled = jax.jit(solve_traceable, static_argnums=1)


def _rows(stacked: Array) -> Matrix:
    return [[stacked[i, j] for j in range(6)] for i in range(6)]


def _with_multipliers(constraints: QuadraticConstraints, matrix: Array, values: Array) -> Matrix:
    """M as rows; batch axis last."""
    rows = _rows(matrix)
    for each, value in zip(constraints.matrices, values, strict=True):
        for i, j in zip(*np.nonzero(each), strict=True):
            rows[i][j] = rows[i][j] + each[i, j] * value
    return rows


def _products(constraints: QuadraticConstraints, x: Vector) -> list[Vector]:
    """A_j x."""
    return [
        [unrolled.add(*(each[i, j] * x[j] for j in np.flatnonzero(each[i]))) for i in range(6)]
        for each in constraints.matrices
    ]


def _off(constraints: QuadraticConstraints, x: Vector) -> Vector:
    """How far x is from the constraints, x' A_j x - e_j."""
    return [
        unrolled.dot(x, product) - value
        for product, value in zip(_products(constraints, x), constraints.values, strict=True)
    ]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _optimum(
    estimate: tuple[str, ...], matrix: Float[Array, "6 6 batch"], vector: Float[Array, "6 batch"]
) -> tuple[Float[Array, "6 batch"], Float[Array, "k batch"]]:
    """The x and the multipliers at the dual's maximum, by Newton's method.

    Where that does not converge, they are those of its best step; without any, x is NaN.
    """
    constraints = CONSTRAINTS[estimate]
    first = jnp.stack(unrolled.solve(_rows(matrix), list(vector)))
    start = _multipliers(constraints, matrix, vector, _feasible(first, constraints))
    inside = jnp.zeros_like(start)
    if not constraints.free:
        # With these multipliers |x| is at most 1, so they lie far inside.
        inside = inside.at[:2].set(jnp.sqrt(jnp.sum(vector**2, axis=0)))
    count, met = vector.shape[1], MET * jnp.finfo(vector.dtype).eps

    def evaluate(values: Array) -> tuple[Array, Array, Array]:
        factor, pivots = unrolled.cholesky(_with_multipliers(constraints, matrix, values))
        x = unrolled.backward(factor, pivots, unrolled.forward(factor, pivots, list(vector)))
        slope = _off(constraints, x)
        halves = [unrolled.forward(factor, pivots, p) for p in _products(constraints, x)]
        curvature = [[2 * unrolled.dot(a, b) for b in halves] for a in halves]
        step = unrolled.solve(curvature, slope)
        length = unrolled.dot(x, x)
        off = sum(jnp.abs(value) for value in slope) / (length + 1)
        return jnp.stack(x), jnp.stack(step), off

    def body(state: tuple) -> tuple:
        index, values, step, x, off = state
        trial = values + step
        new_x, new_step, new_off = evaluate(trial)
        # A problem that is solved stays as it is, however long the others take.
        better = (new_off < off) & (off > met)
        # Comparisons with NaN are false, so a trial outside is not better.
        outside_at_first = (index == 0) & ~better
        step = jnp.where(better, new_step, SHORTER * step)
        step = jnp.where(outside_at_first, inside - start, step)
        values = jnp.where(better, trial, values)
        values = jnp.where(outside_at_first, start, values)
        return (
            index + 1,
            values,
            step,
            jnp.where(better, new_x, x),
            jnp.where(better, new_off, off),
        )

    def unfinished(state: tuple) -> Bool[Array, ""]:
        index, _, _, _, off = state
        return (index < NEWTON_STEPS) & jnp.any(off > met)

    state = (
        jnp.zeros((), jnp.int32),
        start,
        jnp.zeros_like(start),
        jnp.full((6, count), jnp.nan, vector.dtype),
        jnp.full(count, jnp.inf, vector.dtype),
    )
    _, values, _, x, _ = jax.lax.while_loop(unfinished, body, state)
    return x, values


@_optimum.defjvp
@in_standard_promotion
def _optimum_jvp(estimate: tuple[str, ...], primals: tuple, tangents: tuple) -> tuple:
    constraints = CONSTRAINTS[estimate]
    matrix, vector = primals
    x, values = _optimum(estimate, matrix, vector)
    factor, pivots = unrolled.cholesky(_with_multipliers(constraints, matrix, values))
    moved = tangents[1] - jnp.einsum("ijl,jl->il", tangents[0], x)
    half = unrolled.forward(factor, pivots, list(moved))
    halves = [unrolled.forward(factor, pivots, p) for p in _products(constraints, list(x))]
    curvature = [[unrolled.dot(a, b) for b in halves] for a in halves]
    change = unrolled.solve(curvature, [unrolled.dot(each, half) for each in halves])
    left = [half[i] - unrolled.dot([each[i] for each in halves], change) for i in range(6)]
    slope = jnp.stack(unrolled.backward(factor, pivots, left))
    return (x, values), (slope, jnp.stack(change))


def _multipliers(
    constraints: QuadraticConstraints, matrix: Array, vector: Array, x: Array
) -> Array:
    """The multipliers that make x most nearly stationary, by least squares."""
    products = _products(constraints, list(x))
    rest = vector - jnp.einsum("ijl,jl->il", matrix, x)
    gram = [[unrolled.dot(a, b) for b in products] for a in products]
    return jnp.stack(unrolled.solve(gram, [unrolled.dot(p, list(rest)) for p in products]))


def _feasible(
    x: Float[Array, "6 batch"], constraints: QuadraticConstraints
) -> Float[Array, "6 batch"]:
    """The nearest orthonormal pair, with the scales that are free."""
    pair = x.reshape(2, 3, -1)
    lengths = jnp.sqrt(jnp.sum(pair**2, axis=1))
    lateral, axial = orthonormal_pair(pair[0] / lengths[0], pair[1] / lengths[1])
    first, second = constraints.allowed(lengths)
    return jnp.concatenate([first * lateral, second * axial])


def _gap(
    constraints: QuadraticConstraints, matrix: Array, vector: Array, x: Array, values: Array
) -> tuple[Float[Array, " batch"], Float[Array, " batch"], Bool[Array, " batch"]]:
    """f(x) less the bound that the multipliers prove, M's least pivot, whether it is definite."""
    rows = _with_multipliers(constraints, matrix, values)
    factor, pivots = unrolled.cholesky(rows)
    rest = [a - b for a, b in zip(unrolled.apply(rows, list(x)), vector, strict=True)]
    half = unrolled.forward(factor, pivots, rest)
    largest = sum(matrix[i, i] for i in range(6))
    least = 1 / jnp.max(jnp.stack(pivots), axis=0) ** 2
    return unrolled.dot(half, half), least, least > SINGULAR_SYSTEM * largest
