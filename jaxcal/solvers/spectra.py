"""Inverses and extreme eigenpairs of many small symmetric matrices, lanes last.

What is wanted of an information matrix is its inverse and its two ends, not its whole spectrum.
The *inverse* comes from the sweep operator, which keeps the matrix symmetric, so that a column is a
row and lies in one piece. The *largest eigenvalue* of A comes from squaring: A^2 / tr A^2 has the
same vectors and squared ratios, so after k rounds the second eigenvalue has the weight
(l_2 / l_1)^(2^k) and a dozen rounds separate what differs by a per cent. A matrix is of rank one
(and its column the vector) when the trace of its square is that of itself, squared. The *smallest*
one is the largest of the inverse. Each round is 729 multiplications over the lanes; a whole
decomposition (:func:`jaxcal.solvers.dense.singular_values`, the reference) takes 40 times as long.

References: Goodnight 1979 (the sweep operator); Golub and Van Loan, 7.3 (power iteration).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal.solvers.lanes import apart

MOST_SQUARINGS = 44
"""Eigenvalues that differ by less than the rounding of A after so many are one and the same."""

RANK_ONE = 1e-8
"""Remaining weight at which one more squaring is the last."""


def inverses(matrix: Float[Array, "p p lanes"]) -> Float[Array, "p p lanes"]:
    """Inverses of symmetric positive definite matrices, brought to a diagonal of order one.

    NaN, in its own lane only, where one is not positive definite.
    """
    size = matrix.shape[0]
    rows = jnp.arange(size)

    def sweep(k: Array, work: Float[Array, "p p lanes"]) -> Float[Array, "p p lanes"]:
        row = jax.lax.dynamic_index_in_dim(work, k, 0, keepdims=False)
        pivot = jax.lax.dynamic_index_in_dim(row, k, 0, keepdims=False)
        inverse = 1 / jnp.where(pivot > 0, pivot, jnp.nan)
        row, scaled, inverse = apart((row, row * inverse, inverse))
        down, across = (rows == k)[:, None, None], (rows == k)[None, :, None]
        swept = jnp.where(across, scaled[:, None], work - row[:, None] * scaled[None])
        swept = jnp.where(down, scaled[None], swept)
        return jnp.where(down & across, -inverse, swept)

    return -jax.lax.fori_loop(0, size, sweep, matrix)


class Largest(eqx.Module):
    """The largest eigenvalue of every lane's matrix, and its unit vector."""

    value: Float[Array, " lanes"]
    vector: Float[Array, "p lanes"]


def largest(matrix: Float[Array, "p p lanes"]) -> Largest:
    """Of symmetric positive definite matrices; where several are equally large, one of them."""
    size, _, lanes = matrix.shape

    def trace(of: Float[Array, "p p lanes"]) -> Float[Array, " lanes"]:
        return sum((of[k, k] for k in range(1, size)), of[0, 0])

    def unfinished(state: tuple) -> Bool[Array, ""]:
        count, _, active = state
        return jnp.any(active) & (count < MOST_SQUARINGS)

    def square(state: tuple) -> tuple:
        count, power, active = state
        product = power[:, :1] * power[:1]
        for k in range(1, size):
            product = product + power[:, k, None] * power[None, k]
        product = apart(product)
        total = trace(product)
        scale = apart(1 / jnp.where(active, total, 1.0))
        # A lane that is done keeps its matrix: its neighbours are none of its business.
        power = jnp.where(active, product * scale, power)
        return count + 1, power, active & (total < 1 - RANK_ONE)

    start = matrix * apart(1 / trace(matrix))
    state = (jnp.zeros((), jnp.int32), start, jnp.ones(lanes, bool))
    _, power, _ = jax.lax.while_loop(unfinished, square, state)
    diagonal = jnp.stack([power[k, k] for k in range(size)])
    chosen = jnp.arange(size)[:, None] == jnp.argmax(diagonal, axis=0)
    vector = apart(jnp.sum(jnp.where(chosen[:, None], power, 0.0), axis=0))
    vector = apart(vector / jnp.sqrt(jnp.sum(vector**2, axis=0)))
    return Largest(jnp.sum(vector * jnp.sum(matrix * vector[None], axis=1), axis=0), vector)
