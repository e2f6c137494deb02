"""The arrow: normal equations in which every image's offset meets only the p shared unknowns.

Per image i let J_i (m x p) be the Jacobian of its m residuals r_i with respect to the shared
unknowns (pose, target, scales) and k_i (m) that with respect to its own offset. The normal
matrix is

    [ A   E_1 ... E_n ]      A   = sum_i J_i' J_i      g   = sum_i J_i' r_i
    [ E_1'  D_1       ]      E_i = J_i' k_i            D_i = k_i' k_i        d_i = k_i' r_i
    [ E_n'        D_n ]

and eliminating each offset by a scalar division leaves p equations (Schur complement):

    S = A - sum_i E_i E_i' / D_i,      S dx = -(g - sum_i E_i d_i / D_i),
    dy_i = -(d_i + E_i' dx) / D_i.

The cost is O(n p^2), against O((n + p)^3) for the dense system. Levenberg-Marquardt damps the
diagonals of A and D by (1 + lambda), Marquardt's scaling, which makes mm, rad and log units
comparable. Offsets resting on a bound, their gradient pushing outwards, are held: they leave the
elimination and keep their value, so S is the reduced matrix of the active-set step.

At the optimum S is, in whitened residuals, the marginal information of the shared unknowns.

References: Triggs et al. 2000, Bundle adjustment: a modern synthesis, section 6; Marquardt 1963;
Bertsekas 1982 (projected Newton) for the held offsets.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.solvers import dense


class Arrow(eqx.Module):
    """The blocks of one linearisation; offset arrays have length 0 where there are none.

    Attributes:
        shared: A.
        coupling: rows E_i.
        diagonal: D_i; 1 for an offset that no residual sees.
        gradient: g.
        offset_gradient: d_i.
        free: 1 where the offset may move, 0 where it is held on its bound.
        cost: sum of squared residuals, |r|^2.
    """

    shared: Float[Array, "p p"]
    coupling: Float[Array, "k p"]
    diagonal: Float[Array, " k"]
    gradient: Float[Array, " p"]
    offset_gradient: Float[Array, " k"]
    free: Float[Array, " k"]
    cost: Float[Array, ""]


def build(
    residual: Float[Array, "n m"],
    jacobian: Float[Array, "p n m"],
    offset_jacobian: Float[Array, "k m"],
    offset: Float[Array, " k"],
    limit: Float[Array, " k"],
) -> Arrow:
    """Sum the blocks over the images and decide which offsets rest on their bound.

    Args:
        residual: r, one row an image.
        jacobian: derivative of the residuals along each shared unknown.
        offset_jacobian: derivative of row i along offset i (no rows where there are no offsets).
        offset: current offset unknowns.
        limit: bound on their magnitude.
    """
    shared = jnp.einsum("anm,bnm->ab", jacobian, jacobian)
    gradient = jnp.einsum("anm,nm->a", jacobian, residual)
    cost = jnp.sum(residual**2)
    if offset.shape[0] == 0:
        none = jnp.zeros(0, residual.dtype)
        return Arrow(shared, jnp.zeros((0, shared.shape[0]), residual.dtype), none, gradient,
                     none, none, cost)  # fmt: skip
    coupling = jnp.einsum("anm,nm->na", jacobian, offset_jacobian)
    diagonal = jnp.sum(offset_jacobian**2, axis=1)
    offset_gradient = jnp.sum(offset_jacobian * residual, axis=1)
    diagonal = jnp.where(diagonal > 0, diagonal, 1.0)
    free = free_offsets(offset_gradient, offset, limit)
    return Arrow(shared, coupling, diagonal, gradient, offset_gradient, free, cost)


def free_offsets(
    offset_gradient: Float[Array, " k"], offset: Float[Array, " k"], limit: Float[Array, " k"]
) -> Float[Array, " k"]:
    """1 where an offset may move, 0 where it rests on its bound and descent pushes it outwards."""
    at_upper = (offset >= limit) & (offset_gradient <= 0)
    at_lower = (offset <= -limit) & (offset_gradient >= 0)
    return jnp.where(at_upper | at_lower, 0.0, 1.0).astype(offset.dtype)


def schur(
    arrow: Arrow, damping: Float[Array, ""] | float = 0.0
) -> tuple[Float[Array, "p p"], Float[Array, " p"]]:
    """The reduced matrix S and gradient of the shared unknowns, with Marquardt's damping."""
    weight = arrow.free / (arrow.diagonal * (1 + damping))
    weighted = arrow.coupling * weight[:, None]
    matrix = arrow.shared - weighted.T @ arrow.coupling
    matrix = matrix + jnp.diag(damping * jnp.diagonal(arrow.shared))
    return matrix, arrow.gradient - weighted.T @ arrow.offset_gradient


def solve(arrow: Arrow, damping: Float[Array, ""]) -> tuple[Float[Array, " p"], Float[Array, " k"]]:
    """The damped step (dx, dy) of all unknowns."""
    matrix, gradient = schur(arrow, damping)
    step = -solve_symmetric(matrix, gradient, jnp.diagonal(arrow.shared))
    diagonal = arrow.diagonal * (1 + damping)
    offset_step = -(arrow.offset_gradient + arrow.coupling @ step) / diagonal
    return step, arrow.free * offset_step


def solve_symmetric(
    matrix: Float[Array, "p p"], vector: Float[Array, " p"], diagonal: Float[Array, " p"]
) -> Float[Array, " p"]:
    """Solve a positive semidefinite system, scaled by the given diagonal of its unreduced matrix.

    A singular matrix (an unobservable direction) is met by a ridge at the rounding level of the
    scaled system, so the step there stays finite and small, and the other directions are exact.
    """
    scale, scaled = _ridged(matrix, diagonal)
    return scale * dense.solve_positive(scaled, (scale * vector)[:, None])[:, 0]


def inverse_symmetric(
    matrix: Float[Array, "p p"], diagonal: Float[Array, " p"]
) -> Float[Array, "p p"]:
    """The inverse, by the same scaling and ridge as :func:`solve_symmetric`."""
    scale, scaled = _ridged(matrix, diagonal)
    return scale[:, None] * dense.solve_positive(scaled, jnp.diag(scale))


def _ridged(
    matrix: Float[Array, "p p"], diagonal: Float[Array, " p"]
) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
    eps = jnp.finfo(matrix.dtype).eps
    scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    scaled = matrix * scale[:, None] * scale[None, :]
    return scale, scaled + 16 * eps * jnp.eye(len(scale), dtype=matrix.dtype)


def stationarity(arrow: Arrow) -> Float[Array, ""]:
    """Scaled KKT residual: the largest cosine between the residual and a column of the Jacobian.

    max_k |g_k| / (|J_k| |r|) over the shared unknowns and the free offsets; an offset held on its
    bound, whose gradient points outwards, satisfies its condition. It is 0 for a zero residual.
    """
    norm = jnp.sqrt(arrow.cost)
    length = jnp.sqrt(jnp.diagonal(arrow.shared)) * norm
    cosine = jnp.abs(arrow.gradient) / jnp.where(length > 0, length, 1.0)
    offset_length = jnp.sqrt(arrow.diagonal) * norm
    offset_cosine = arrow.free * jnp.abs(arrow.offset_gradient)
    offset_cosine = offset_cosine / jnp.where(offset_length > 0, offset_length, 1.0)
    return jnp.maximum(jnp.max(cosine), jnp.max(offset_cosine, initial=0.0))
