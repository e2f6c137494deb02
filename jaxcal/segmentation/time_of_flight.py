"""Lateral position and range of the target from its distances to the elements of a linear probe.

Eq. 5 of the paper, d_k^2 = (e_k - x)^2 + r^2 with r^2 = y^2 + z^2, has two unknowns. Its square is
linear in (x, x^2 + r^2), which gives a start in closed form; Gauss-Newton on the distances
themselves, whose noise is the white one, gives the estimate.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.geometry import AnyArray


def fit_distances(
    distances: Float[AnyArray, "*batch elements"],
    element_lateral: Float[AnyArray, " elements"],
    *,
    steps: int = 5,
) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch 2 2"]]:
    """Least squares on Eq. 5 from every element's distance to the target.

    Args:
        distances: d_k, mm; any leading axes.
        element_lateral: e_k, mm.
        steps: Gauss-Newton steps from the closed form.

    Returns:
        points [lateral, range] mm, and the inverse normal matrices: times the variance of a
        distance they are the points' covariances.
    """
    e, distances = jnp.asarray(element_lateral), jnp.asarray(distances)
    centred = e - jnp.mean(e)
    # d^2 - e^2 = -2 x e + (x^2 + r^2): slope and mean of a straight line over the elements.
    square = distances**2 - e**2
    lateral = -0.5 * jnp.sum(square * centred, axis=-1) / jnp.sum(centred**2)
    range_square = jnp.mean(square, axis=-1) + 2 * lateral * jnp.mean(e) - lateral**2
    # Noise can make the square negative; the shortest distance is then as good a start as any.
    shortest = jnp.min(distances, axis=-1)
    distance = jnp.sqrt(jnp.where(range_square > 1e-6, range_square, shortest**2 + 1e-6))

    def normal(x: Array, r: Array) -> tuple[Array, Array, Array, Array]:
        along = x[..., None] - e
        model = jnp.sqrt(along**2 + r[..., None] ** 2)
        return along / model, r[..., None] / model, model, distances - model

    def step(_: Array, estimate: tuple[Array, Array]) -> tuple[Array, Array]:
        x, r = estimate
        jx, jr, _, residual = normal(x, r)
        a, b, c = (jx * jx).sum(-1), (jx * jr).sum(-1), (jr * jr).sum(-1)
        gx, gr = (jx * residual).sum(-1), (jr * residual).sum(-1)
        determinant = a * c - b * b
        dx, dr = (c * gx - b * gr) / determinant, (a * gr - b * gx) / determinant
        # A step of more than the range itself can only come from a start far off.
        return x + jnp.clip(dx, -r, r), jnp.maximum(r + jnp.clip(dr, -0.5 * r, r), 1e-3)

    lateral, distance = jax.lax.fori_loop(0, steps, step, (lateral, distance))
    jx, jr, _, _ = normal(lateral, distance)
    a, b, c = (jx * jx).sum(-1), (jx * jr).sum(-1), (jr * jr).sum(-1)
    determinant = a * c - b * b
    rows = [jnp.stack([c, -b], axis=-1), jnp.stack([-b, a], axis=-1)]
    covariance = jnp.stack(rows, axis=-2) / determinant[..., None, None]
    return jnp.stack([lateral, distance], axis=-1), covariance
