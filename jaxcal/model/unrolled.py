"""Small dense algebra written out scalar by scalar, for many problems side by side.

A matrix is a list of rows of arrays that all have the same shape, one entry for every problem.
Written out, a 9x9 Cholesky solve is one straight stretch of code that XLA turns into a few
vectorised loops over the problems. This form is the fastest to run and the slowest to compile.
Structural zeros are the number 0 and cost nothing.

The functions of single entries are called tens of thousands of times in one trace. Entries are of
any type, so the tests, which check annotations at every call, need not check theirs.

A matrix that is not positive definite gives NaN or Inf, for its own problem only.
"""

from __future__ import annotations

from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from jaxtyping import Array

Entry = Any
"""An array over the problems, or the number 0."""

Vector = list[Entry]
Matrix = list[list[Entry]]


@no_type_check
def is_zero(value: Entry) -> bool:
    """Whether an entry is a structural zero."""
    return isinstance(value, int) and value == 0


@no_type_check
def _alike(first: Entry, second: Entry) -> bool:
    """Whether two entries are arrays of one shape: JAX's own functions trace faster on these."""
    if not (isinstance(first, jax.Array) and isinstance(second, jax.Array)):
        return False
    return first.shape == second.shape and first.dtype == second.dtype


@no_type_check
def add(*terms: Entry) -> Entry:
    """Sum without the structural zeros."""
    total: Entry = 0
    for term in terms:
        if not is_zero(term):
            if is_zero(total):
                total = term
            else:
                total = jax.lax.add(total, term) if _alike(total, term) else total + term
    return total


@no_type_check
def times(first: Entry, second: Entry) -> Entry:
    """Product; 0 where either is a structural zero."""
    if is_zero(first) or is_zero(second):
        return 0
    # 1 and -1 need no multiplication either.
    if isinstance(first, int) and abs(first) == 1:
        return second if first == 1 else -second
    return jax.lax.mul(first, second) if _alike(first, second) else first * second


@no_type_check
def dot(first: Vector, second: Vector) -> Entry:
    """Scalar product."""
    return add(*(times(a, b) for a, b in zip(first, second, strict=True)))


def transpose(matrix: Matrix) -> Matrix:
    """Transpose."""
    return [list(row) for row in zip(*matrix, strict=True)]


def product(first: Matrix, second: Matrix) -> Matrix:
    """Matrix product."""
    columns = transpose(second)
    return [[dot(row, column) for column in columns] for row in first]


def apply(matrix: Matrix, vector: Vector) -> Vector:
    """Matrix times vector."""
    return [dot(row, vector) for row in matrix]


def cross(vector: Vector) -> Matrix:
    """The matrix of v x."""
    x, y, z = vector
    return [[0, times(-1, z), y], [z, 0, times(-1, x)], [times(-1, y), x, 0]]


@jax.custom_jvp
def inverse_root(value: Array) -> Array:
    """1 / sqrt(x).

    XLA turns both ``rsqrt`` and 1 / sqrt(x) into a call of a scalar function, so on a CPU it does
    not vectorise the loop around it: a sum over images with one such call takes three times as long
    (jaxlib 0.10).
    """
    return jnp.sqrt(1 / value)


@inverse_root.defjvp
def _inverse_root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    root = inverse_root(*primals)
    return root, -0.5 * root * (root * root) * tangents[0]


@jax.custom_jvp
def root(value: Array) -> Array:
    """Square root of a positive number; it and its derivatives vectorise (:func:`inverse_root`)."""
    return value * inverse_root(value)


@root.defjvp
def _root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return root(*primals), 0.5 * inverse_root(*primals) * tangents[0]


def cholesky(matrix: Matrix) -> tuple[Matrix, Vector]:
    """Lower factor (strictly below the diagonal) and the inverses of its diagonal."""
    size = len(matrix)
    factor: Matrix = [[0] * size for _ in range(size)]
    inverse: Vector = []
    for j in range(size):
        pivot = add(matrix[j][j], *(-factor[j][k] * factor[j][k] for k in range(j)))
        inverse.append(inverse_root(pivot))
        for i in range(j + 1, size):
            rest = add(matrix[i][j], *(-factor[i][k] * factor[j][k] for k in range(j)))
            factor[i][j] = times(rest, inverse[j])
    return factor, inverse


def forward(factor: Matrix, inverse: Vector, vector: Vector) -> Vector:
    """L^-1 v."""
    found: Vector = []
    for i, value in enumerate(vector):
        rest = add(value, *(times(-1, times(factor[i][k], found[k])) for k in range(i)))
        found.append(times(rest, inverse[i]))
    return found


def backward(factor: Matrix, inverse: Vector, vector: Vector) -> Vector:
    """L'^-1 v."""
    size = len(vector)
    found: Vector = [0] * size
    for i in reversed(range(size)):
        later = (times(-1, times(factor[k][i], found[k])) for k in range(i + 1, size))
        found[i] = times(add(vector[i], *later), inverse[i])
    return found


def solve(matrix: Matrix, vector: Vector) -> Vector:
    """Solve a symmetric positive definite system by Cholesky's factor."""
    factor, inverse = cholesky(matrix)
    return backward(factor, inverse, forward(factor, inverse, vector))


def rotation(vector: Vector) -> Matrix:
    """Cayley's rotation of a vector w (rad): Exp(w) to second order, and a rotation for any w.

    I + (2 / (1 + |h|^2)) ([h]x + [h]x^2), h = w / 2: the turn is by 2 atan(|w| / 2). It takes one
    division; sine and cosine would be scalar calls for every problem and entry.
    """
    half = [0.5 * value for value in vector]
    factor = 2 / (1 + dot(half, half))
    turn, square = cross(half), product(cross(half), cross(half))
    return [
        [add(int(i == j), factor * add(turn[i][j], square[i][j])) for j in range(3)]
        for i in range(3)
    ]


@jax.jit
def as_array(entries: Vector) -> Array:
    """The array whose first axis counts the entries; the inverse of :func:`rows_of`."""
    return jnp.stack(entries)


def rows_of(stacked: Array) -> Vector:
    """The entries of an array whose first axis counts them."""
    return [stacked[k] for k in range(stacked.shape[0])]
