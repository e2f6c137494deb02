"""The distance fit of simulations: least squares on Eq. 5, written in deviations from the truth.

A simulation knows the target's lateral position x0 and range r0; its distances are h_k + n_k, with
h_k = hypot(x0 - e_k, r0). The fit to these distances is solved for its deviation (u, v) from
(x0, r0). The result is that of the plain fit: it starts from the closed form of the distances, not
from the truth, and minimises the same sum of squares. The gain is that float32 suffices: all
rounded numbers are of the size of the noise, and only 1e-7 of that is lost. With

    t = u (2 (x0 - e_k) + u) + v (2 r0 + v),     hypot(x0 + u - e_k, r0 + v) - h_k = t / (h + h_k)

no two large numbers are subtracted. The start comes from the straight line that d_k^2 - e_k^2 forms
over the elements. The steps are Newton's with exact second derivatives, so that each one squares
the error. (They are Gauss-Newton's where the matrix is indefinite or nearly singular.)

:func:`jaxcal.data.segmentation.time_of_flight.fit_in_plane` is the plain form; the tests compare
this fit with it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex64, Float

from jaxcal.data.segmentation.time_of_flight import element_sums

ENOUGH_MM = 2e-3
"""A Newton step shorter than this is the last: the error left is below 1e-6 mm."""

MOST_STEPS = 12

LEAST_RANGE_MM = 1e-3


def fit_deviations(
    noise: Complex64[Array, "*batch n half"],
    size: Float[Array, ""],
    lateral: Float[Array, "*batch n"],
    distance: Float[Array, "*batch n"],
    element_lateral: Float[np.ndarray, " elements"],
) -> tuple[Float[Array, "*batch n"], Float[Array, "*batch n"]]:
    """Lateral position and range that fit noisy distances best, mm.

    Args:
        noise: standard normals. Real parts are for the first half of the elements, imaginary parts
            for the others (the last is not used if the number of elements is odd).
        size: SD of a distance, mm.
        lateral: true lateral position, mm.
        distance: true range, mm.
        element_lateral: e_k, mm.
    """
    single = jnp.float32
    size, r0 = size.astype(single), distance.astype(single)
    x0, far0 = lateral.astype(single)[..., None], r0[..., None]
    elements = np.asarray(element_lateral, np.float32)
    middle, count = float(np.mean(elements)), len(elements)
    spread = float(np.sum((elements - middle) ** 2))

    def each() -> list[tuple[Array, np.ndarray]]:
        return list(zip(halves(noise, count), split(elements), strict=True))

    def start(u: Array, v: Array) -> tuple[Array, Array]:
        """The closed form, as a step from any (u, v)."""
        sums = _sums(_line(x0, far0, size * normal, e, middle) for normal, e in each())
        square, slope, far = sums
        across = -0.5 * slope / spread
        change = square / count + 2 * across * middle - across * (2 * x0[..., 0] + across)
        r2 = r0 * r0 + change
        near = jnp.sqrt(jnp.where(r2 > 1e-2, r2, 1.0))
        # Noise can make the square negative; half the mean distance is then as good a start.
        deep = jnp.where(r2 > 1e-2, change / (near + r0), 0.5 * jnp.abs(far) / count - r0)
        return across - u, deep - v

    def newton(u: Array, v: Array) -> tuple[Array, Array]:
        wide, deep = u[..., None], v[..., None]
        sums = _sums(_newton(x0, far0, size * normal, e, wide, deep) for normal, e in each())
        xx, xr, rr, gx, gr, bxx, bxr, brr = sums
        exact = (xx - bxx) * (rr - brr) - (xr + bxr) ** 2
        trusted = (exact > 0.1 * (xx * rr - xr * xr)) & (xx > bxx)
        a, b, c = (
            jnp.where(trusted, new, old)
            for new, old in ((xx - bxx, xx), (xr + bxr, xr), (rr - brr, rr))
        )
        determinant = a * c - b * b
        du, dv = (c * gx - b * gr) / determinant, (a * gr - b * gx) / determinant
        # A step longer than the range itself can only come from a start that is far off.
        r = r0 + v
        du, dv = jnp.clip(du, -r, r), jnp.clip(dv, -0.5 * r, r)
        return du, jnp.maximum(dv, LEAST_RANGE_MM - r)

    def iterate(state: tuple) -> tuple:
        u, v, going, taken = state
        # The start is a pass of this loop, too. The loop only reads the noise, which another loop
        # draws; so it is drawn once, not once for the start and once for the steps.
        du, dv = jax.lax.cond(taken == 0, start, newton, u, v)
        du, dv = (jnp.where(going[..., None], move, 0.0) for move in (du, dv))
        moved = jnp.max(jnp.maximum(jnp.abs(du), jnp.abs(dv)), axis=-1)
        return u + du, v + dv, going & ((moved > ENOUGH_MM) | (taken == 0)), taken + 1

    def unfinished(state: tuple) -> Array:
        return jnp.any(state[2]) & (state[3] <= MOST_STEPS)

    zero = jnp.zeros_like(r0)
    going = jnp.ones(r0.shape[:-1], bool)
    state = (zero, zero, going, jnp.zeros((), jnp.int32))
    u, v, *_ = jax.lax.while_loop(unfinished, iterate, state)
    return lateral + u, distance + v


def halves(
    noise: Complex64[Array, "*batch half"], elements: int
) -> list[Float[Array, "*batch some"]]:
    """The noise of the first half of the elements, and of the rest."""
    first = noise.shape[-1]
    return [jnp.real(noise), jnp.imag(noise)[..., : elements - first]]


def split(elements: np.ndarray) -> list[np.ndarray]:
    """The elements that belong to the halves."""
    first = -(-len(elements) // 2)
    return [elements[:first], elements[first:]]


def _line(x0: Array, r0: Array, n: Array, e: np.ndarray, middle: float) -> list[Array]:
    """Terms of the closed form's sums: d^2 - h^2, that times (e - middle), and d."""
    along = x0 - e
    h = jnp.sqrt(along * along + r0 * r0)
    square = n * (2 * h + n)
    return [square, square * (e - middle), h + n]


def _newton(x0: Array, r0: Array, n: Array, e: np.ndarray, u: Array, v: Array) -> list[Array]:
    """Terms of a step's sums: J'J, J' times the residual, the residual times second derivatives."""
    before = x0 - e
    along, r = before + u, r0 + v
    h0 = jnp.sqrt(before * before + r0 * r0)
    square = along * along + r * r
    # With fast math, rsqrt differs between full vectors and the remainder of a row.
    h = jnp.sqrt(square)
    inverse = 1 / h
    residual = n - (u * (before + along) + v * (r0 + r)) / (h0 + h)
    jx, jr = along * inverse, r * inverse
    bend = residual * inverse
    xx, xr, rr = jx * jx, jx * jr, jr * jr
    return [xx, xr, rr, jx * residual, jr * residual, bend * rr, bend * xr, bend * xx]


def _sums(parts) -> list[Array]:
    """Sums of the halves' terms over the elements, by reductions; equal halves are added first."""
    parts = list(parts)
    if parts[0][0].shape == parts[1][0].shape:
        parts = [[a + b for a, b in zip(*parts, strict=True)]]
    totals = [element_sums(*terms) for terms in parts]
    return list(totals[0]) if len(totals) == 1 else [a + b for a, b in zip(*totals, strict=True)]
