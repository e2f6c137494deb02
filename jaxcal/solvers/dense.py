"""Small dense linear algebra in plain array operations, for matrices of a dozen rows in a batch.

XLA hands ``jnp.linalg`` to LAPACK on the CPU, one small call a matrix. Up to jaxlib 0.11.0 it
spreads these calls over its thread pool while a thread of that same pool waits for them. Two
batches of calls that do not depend on each other can then wait for each other for ever, which
stopped whole studies on two cores (docs/developers/upstream/xla-cpu-lapack-deadlock.md). The loops
of array operations here cannot deadlock; they also vectorise over the batch and run unchanged on a
GPU, which has no LAPACK.

Reference: Golub and Van Loan, Matrix Computations, 4th ed., 3.4.
"""

from __future__ import annotations

from functools import reduce
from operator import add, mul

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.model import unrolled

BLOCK = 3
"""Most rows that are swept at once."""


def solve_positive(matrix: Float[Array, "p p"], rhs: Float[Array, "p k"]) -> Float[Array, "p k"]:
    """Solve a symmetric positive definite system by Gauss-Jordan elimination.

    Args:
        matrix: scaled to a diagonal of order one.
        rhs: right-hand sides, one a column.

    Returns:
        The solutions; NaN where the matrix is not positive definite.
    """
    size = matrix.shape[0]
    rows = jnp.arange(size)

    def eliminate(k: Array, work: Float[Array, "p q"]) -> Float[Array, "p q"]:
        here = (rows == k).astype(work.dtype)
        column, row = _column(work, k), here @ work
        pivot = column @ here
        # No pivoting is needed; a pivot <= 0 shows that the matrix is not positive definite.
        row = row / jnp.where(pivot > 0, pivot, jnp.nan)
        return work - (column - here)[:, None] * row

    work = jnp.concatenate([matrix, rhs], axis=1)
    return jax.lax.fori_loop(0, size, eliminate, work)[:, size:]


def solve_symmetric(
    matrix: Float[Array, "p p"], vector: Float[Array, " p"], diagonal: Float[Array, " p"]
) -> Float[Array, " p"]:
    """Solve a positive semidefinite system, scaled by the given diagonal of its unreduced matrix.

    A ridge at the rounding level of the scaled system allows for singular matrices: the step along
    an unobservable direction stays finite and small, and the other directions are exact.
    """
    scale, scaled = _ridged(matrix, diagonal)
    return scale * solve_positive(scaled, (scale * vector)[:, None])[:, 0]


def inverse_symmetric(
    matrix: Float[Array, "p p"], diagonal: Float[Array, " p"]
) -> Float[Array, "p p"]:
    """The inverse, by the same scaling and ridge as :func:`solve_symmetric`."""
    scale, scaled = _ridged(matrix, diagonal)
    return scale[:, None] * solve_positive(scaled, jnp.diag(scale))


def _ridged(
    matrix: Float[Array, "p p"], diagonal: Float[Array, " p"]
) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
    eps = jnp.finfo(matrix.dtype).eps
    scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    scaled = matrix * scale[:, None] * scale[None, :]
    return scale, scaled + 16 * eps * jnp.eye(len(scale), dtype=matrix.dtype)


def inverse(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """Inverse of a square matrix by Gauss-Jordan elimination with partial pivoting.

    It returns the inverse and not a solution, so that a product with it stays linear in the
    right-hand side for reverse-mode differentiation.

    Args:
        matrix: scaled to rows of order one.

    Returns:
        The inverse; Inf or NaN where the matrix is singular.
    """
    size = matrix.shape[0]
    rows = jnp.arange(size)

    def eliminate(k: Array, state: tuple) -> tuple:
        work, unused, order = state
        column = _column(work, k)
        chosen = rows == jnp.argmax(jnp.where(unused, jnp.abs(column), -1.0))
        here = chosen.astype(work.dtype)
        row = (here @ work) / (column @ here)
        order = jnp.where(rows[:, None] == k, here, order)
        return work - (column - here)[:, None] * row, unused & ~chosen, order

    eye = jnp.eye(size, dtype=matrix.dtype)
    start = (jnp.concatenate([matrix, eye], axis=1), rows >= 0, jnp.zeros_like(matrix))
    work, _, order = jax.lax.fori_loop(0, size, eliminate, start)
    return order @ work[:, size:]


def _column(matrix: Float[Array, "m q"], k: Array) -> Float[Array, " m"]:
    # A masked sum: a gather of one column of every matrix is many times slower.
    return jnp.sum(jnp.where(jnp.arange(matrix.shape[1]) == k, matrix, 0.0), axis=1)


@jax.jit
def inverse_batch_last(
    matrix: Float[Array, "p p batch"],
) -> tuple[Float[Array, "p p batch"], Float[Array, " batch"]]:
    """Inverses and log determinants of symmetric positive definite matrices; batch axis last.

    With the leading block A = L L', W = L^-1 and the rows B beside it, one sweep makes

        [A  B ]        [C - G'G   H ]
        [B' C ]   ->   [H'       -Q ],    G = W B, H = G'W, Q = W'W.

    The swept rows go to the end, so that the next block is in the same place again. After a sweep
    of all blocks, every row is back in its place, and the matrix is minus the inverse. W and G
    stand in one array F = [G W], and all four blocks come from F'F. An elimination row by row
    would pass over the matrix as many times as it has rows.

    Where a matrix is not positive definite, its log determinant and its inverse are not finite.

    Reference: Goodnight 1979 (the sweep operator).
    """
    size = matrix.shape[0]
    block = min((BLOCK - 1, BLOCK), key=lambda rows: (-size % rows, -rows))
    whole = size + -size % block
    if whole > size:
        ends = (np.arange(whole) >= size).astype(matrix.dtype)
        matrix = jnp.pad(matrix, [(0, whole - size), (0, whole - size), (0, 0)])
        matrix = matrix + np.diag(ends)[..., None]
    now = np.arange(whole) >= whole - block
    sign = np.where(now[:, None] == now, -1.0, 1.0).astype(matrix.dtype)[..., None]

    def sweep(_: Array, state: tuple) -> tuple:
        work, log_determinant = state
        own = jax.lax.optimization_barrier(_inverse_of_cholesky(work[:block, :block]))
        factor = jnp.concatenate([_outer_products(own, work[:block, block:]), own], axis=1)
        factor = jax.lax.optimization_barrier(factor)
        rest = jnp.pad(work[block:, block:], [(0, block), (0, block), (0, 0)])
        work = rest + sign * _outer_products(jnp.swapaxes(factor, 0, 1), factor)
        # NaN or infinite where a pivot is not positive.
        pivots = reduce(mul, [own[k, k] for k in range(block)])
        return jax.lax.optimization_barrier((work, log_determinant - 2 * jnp.log(pivots)))

    state = (matrix, jnp.zeros_like(matrix[0, 0]))
    work, log_determinant = jax.lax.fori_loop(0, whole // block, sweep, state)
    return -work[:size, :size], log_determinant


def solve_batch_last(
    matrix: Float[Array, "p p batch"], vector: Float[Array, "p batch"]
) -> Float[Array, "p batch"]:
    """Solve positive definite systems; batch axis last. NaN or Inf where one is not.

    Cholesky written out scalar by scalar (:mod:`jaxcal.model.unrolled`) is faster to run, but much
    slower to compile.
    """
    inverse, _ = inverse_batch_last(matrix)
    return product_batch_last(inverse, vector)


@jax.jit
def _inverse_of_cholesky(matrix: Float[Array, "b b batch"]) -> Float[Array, "b b batch"]:
    """L^-1 of A = L L', for a few rows."""
    size = matrix.shape[0]
    factor, pivots = unrolled.cholesky([[matrix[i, j] for j in range(size)] for i in range(size)])
    zero = jnp.zeros_like(matrix[0, 0])
    columns = []
    for k in range(size):
        unit: unrolled.Vector = [int(i == k) for i in range(size)]
        column = unrolled.forward(factor, pivots, unit)
        columns.append(jnp.stack([zero if unrolled.is_zero(entry) else entry for entry in column]))
    return jnp.stack(columns, axis=1)


def product_batch_last(
    first: Float[Array, "p q *batch"], second: Float[Array, "q *#r"]
) -> Float[Array, "p *#r"]:
    """Products of many matrices (or of matrices and vectors); batch axis last."""
    if first.ndim > second.ndim:
        return jnp.sum(first * second, axis=1)
    if len(second) > BLOCK:
        return _outer_products(first, second)
    return jnp.sum(first[:, :, None] * second, axis=1)


def _outer_products(
    first: Float[Array, "p q *#batch"], second: Float[Array, "q r *#batch"]
) -> Float[Array, "p r *#batch"]:
    """The product of matrices as a sum of outer products.

    XLA's reduction over an axis between others is much slower for large ones; it compiles sooner.
    """
    return reduce(add, [first[:, k : k + 1] * second[k : k + 1] for k in range(len(second))])
