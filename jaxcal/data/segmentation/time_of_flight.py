"""The target's position from its distances to the elements: pure JAX, any leading axes.

The distances obey Eq. 6 of the paper, d_k^2 = (e_kx - x)^2 + (e_kz - z)^2 + y^2. Eq. 5 is the case
of a linear array: every e_kz is zero, so that y^2 + z^2 = r^2 is one unknown, and "z" below stands
for the range r. Three estimators:

* :func:`shortest`: Eqs. 2 and 3, the one element with the shortest distance;
* :func:`fit_in_plane`: least squares on every distance for (x, z) with y = 0, which for a linear
  array is the whole of Eq. 5;
* :func:`fit_out_of_plane`: for (x, z, y^2), curved arrays only. The unknown is y^2, because the
  problem is well-behaved in it; noise may make the estimate negative, which is not hidden.

Both fits take a fixed number of Gauss-Newton steps. A step passes once over the elements and
accumulates all its sums in one reduction, so that XLA keeps residuals and derivatives in registers.
The robust fits are MM-estimators (Yohai 1987; Maronna, Martin and Yohai 2006, section 5.4). They
start from plain least squares. First come steps by absolute deviations, then steps with Tukey's
bisquare weights and the S-scale of half breakdown, and last such steps with the efficient scale of
the weighted residuals.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.runtime.array_types import AnyArray

# Tukey's bisquare: 95 % efficiency for the position, half breakdown for the S-scale.
_CUT, _CUT_SCALE = 4.685, 1.547645
# Residuals below this many S-scales have about equal weight in the steps by absolute deviations.
_KNEE = 0.5
# For a unit normal distribution: E w, E w u^2 and the variance of the estimated position.
_MEAN_WEIGHT, _MEAN_SQUARE, _VARIANCE = 0.9151076239875573, 0.757775918619908, 1.0526345151671421
# Least scale, mm: clocks are coarser, and a residual from rounding is no outlier.
_FINEST_MM = 1e-6

ABSOLUTE_STEPS, SCALE_STEPS, LAST_STEPS = 5, 3, 3
"""Steps of the robust fit: by absolute deviations, with the S-scale, with the efficient scale."""

_Stage = Literal["absolute", "scale", "efficient"]


class DistanceFit(eqx.Module):
    """A least-squares fit of one position to each frame's distances.

    Attributes:
        position: [lateral, axial] mm (linear array: [lateral, range]), or
            [lateral, axial, elevation squared] in mm, mm and mm^2.
        inverse_normal: the position's covariance for a distance of unit variance.
        noise: SD of one distance, mm, from the residuals.
        lines: elements that answered.
        rejected: of these, how many were given no weight.
    """

    position: Float[Array, "*batch p"]
    inverse_normal: Float[Array, "*batch p p"]
    noise: Float[Array, "*batch"]
    lines: Float[Array, "*batch"]
    rejected: Float[Array, "*batch"]


def shortest(
    distances: Float[AnyArray, "*batch elements"], *, pitch_mm: float | None = None
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """The element that answered first, and its distance (Eqs. 2 and 3).

    Args:
        distances: mm; NaN where an element did not answer.
        pitch_mm: where given, the minimum is placed between elements, by the parabola through the
            squared distances of the first element and its neighbours (for a linear array the
            squares *are* a parabola, Eq. 5), kept within half an element. Noise of more than about
            pitch^2 / range spoils it. It is not done where a neighbour's distance is larger by more
            than the pitch, which is impossible for echoes of the same target.

    Returns:
        the element's number (whole unless interpolated) and the distance, mm; NaN for a frame
        without any answer.
    """
    distances = jnp.asarray(distances)
    filled = jnp.where(jnp.isfinite(distances), distances, jnp.inf)
    first = jnp.argmin(filled, axis=-1)
    least = jnp.min(filled, axis=-1)
    answered = jnp.isfinite(least)
    line = jnp.where(answered, first.astype(distances.dtype), jnp.nan)
    least = jnp.where(answered, least, jnp.nan)
    if pitch_mm is None:
        return line, least
    inner = jnp.clip(first, 1, distances.shape[-1] - 2)
    near = inner[..., None] + jnp.arange(-1, 2)
    three = jnp.take_along_axis(distances, near, -1)
    before, middle, after = jnp.moveaxis(three**2, -1, 0)
    slope, curvature = 0.5 * (after - before), after - 2 * middle + before
    usable = (first == inner) & (curvature > 0) & (jnp.max(three, -1) - least <= pitch_mm)
    shift = jnp.clip(jnp.where(usable, -slope / curvature, 0.0), -0.5, 0.5)
    square = middle + shift * (slope + 0.5 * shift * curvature)
    return line + shift, jnp.where(usable, jnp.sqrt(jnp.maximum(square, 0.0)), least)


def fit_in_plane(
    distances: Float[AnyArray, "*batch elements"],
    element_positions: Float[AnyArray, "elements 3"],
    *,
    robust: bool = False,
    steps: int = 4,
) -> DistanceFit:
    """Least squares for [lateral, axial], as if all targets were in-plane (Eq. 5, or 6 with y = 0).

    For a linear array "axial" is the range, and nothing is neglected.

    Args:
        distances: mm; NaN or not positive where an element did not answer.
        element_positions: [lateral, elevational, axial], mm.
        robust: bisquare weights against lines that are not the target's echo.
        steps: Gauss-Newton steps of the fit that is not robust.

    Returns:
        The fits; NaN where a frame has fewer than 3 answers.
    """
    d, m, ex, ez = _cleaned(distances, element_positions)
    lines, x, z = _closed_form(d, m, ex, ez)
    start = _Values(x, z, jnp.zeros_like(x), jnp.zeros_like(x))
    return _iterate(start, d, m, ex, ez, lines, robust=robust, steps=steps, out_of_plane=False)


def fit_out_of_plane(
    distances: Float[AnyArray, "*batch elements"],
    element_positions: Float[AnyArray, "elements 3"],
    *,
    robust: bool = False,
    steps: int = 4,
) -> tuple[DistanceFit, DistanceFit]:
    """Least squares on Eq. 6 for [lateral, axial, elevation squared]; curved arrays only.

    The sign of the elevation cannot be known: the array is symmetric about the image plane.

    Args:
        distances: mm; NaN or not positive where an element did not answer.
        element_positions: [lateral, elevational, axial], mm; not all at one axial position.
        robust: as in :func:`fit_in_plane`.
        steps: Gauss-Newton steps of the fit that is not robust.

    Returns:
        The in-plane fits (from which these start) and the fits with the elevation squared.
    """
    plane = fit_in_plane(distances, element_positions, robust=robust, steps=steps)
    x, z = plane.position[..., 0], plane.position[..., 1]
    start = _Values(x, z, jnp.zeros_like(x), plane.noise)
    cleaned = _cleaned(distances, element_positions)
    full = _iterate(start, *cleaned, plane.lines, robust=robust, steps=steps, out_of_plane=True)
    return plane, full


class _Values(eqx.Module):
    """The current values of a fit: x, z, y^2, and the scale of the residuals (mm)."""

    x: Float[Array, "*batch"]
    z: Float[Array, "*batch"]
    square: Float[Array, "*batch"]
    scale: Float[Array, "*batch"]


def _cleaned(distances, element_positions) -> tuple[Array, Array, Array, Array]:
    d = jnp.asarray(distances)
    e = jnp.asarray(element_positions, d.dtype)
    answered = jnp.isfinite(d) & (d > 0)
    return jnp.where(answered, d, 0.0), answered.astype(d.dtype), e[:, 0], e[:, 2]


def element_sums(*terms: Float[Array, "*batch elements"]) -> tuple[Float[Array, "*batch"], ...]:
    """Sums over the last axis, all in one reduction: one pass, no arrays in between."""
    zeros = tuple(jnp.zeros((), term.dtype) for term in terms)

    def add(one: tuple[Array, ...], other: tuple[Array, ...]) -> tuple[Array, ...]:
        return tuple(a + b for a, b in zip(one, other, strict=True))

    return tuple(jax.lax.reduce(terms, zeros, add, (terms[0].ndim - 1,)))


def _closed_form(d: Array, m: Array, ex: Array, ez: Array) -> tuple[Array, Array, Array]:
    """Number of lines, x and z from d^2 - |e|^2 = (x^2 + z^2) - 2 x e_x - 2 z e_z.

    Over the elements this is nearly a straight line in e_x: its slope gives x, then its mean z.
    """
    ex, ez = jnp.broadcast_to(ex, d.shape), jnp.broadcast_to(ez, d.shape)
    square = m * (d * d - ex * ex - ez * ez)
    lines, sx, sz, sxx, sxz, sq, sxq, largest = element_sums(
        m, m * ex, m * ez, m * ex * ex, m * ex * ez, square, square * ex, m * d
    )
    mx, mz, mq = sx / lines, sz / lines, sq / lines
    spread, along, slope = sxx - sx * mx, sxz - sx * mz, sxq - sx * mq
    x, z = jnp.zeros_like(mx), jnp.zeros_like(mx)
    for _ in range(2):
        x = -0.5 * (slope + 2 * z * along) / spread
        under = mq + mz * mz + 2 * x * mx - x * x
        # Noise can make the square negative; then half the mean distance is a good start.
        z = mz + jnp.sqrt(jnp.where(under > 1e-6, under, 0.25 * (largest / lines) ** 2))
    return lines, x, z


def _iterate(
    state: _Values,
    d: Array,
    m: Array,
    ex: Array,
    ez: Array,
    lines: Array,
    *,
    robust: bool,
    steps: int,
    out_of_plane: bool,
) -> DistanceFit:
    """Gauss-Newton from a start; the last pass also gives the inverse normal matrix."""
    unknowns = 3 if out_of_plane else 2

    def derivatives(at: _Values) -> tuple[tuple[Array, ...], Array]:
        across, deep = at.x[..., None] - ex, at.z[..., None] - ez
        square = across * across + deep * deep
        if out_of_plane:
            square = jnp.maximum(square + at.square[..., None], 1e-6)
        inverse = jax.lax.rsqrt(square)
        columns = (across * inverse, deep * inverse)
        return (*columns, 0.5 * inverse) if out_of_plane else columns, d - square * inverse

    def moved(at: _Values, step: tuple[Array, ...], scale: Array) -> _Values:
        # A step of more than the depth itself can only come from a start far off.
        reach = jnp.maximum(jnp.abs(at.z), 1.0)
        x = at.x + jnp.clip(step[0], -reach, reach)
        z = at.z + jnp.clip(step[1], -0.5 * reach, reach)
        return _Values(x, z, at.square + step[2] if out_of_plane else at.square, scale)

    def equal(at: _Values) -> tuple[_Values, list[Array], Array]:
        columns, residual = derivatives(at)
        weighted = [m * column for column in columns]
        *products, rss = element_sums(
            *_products(weighted, columns, residual), m * residual * residual
        )
        step, inverse = _solve(products, unknowns)
        # Residuals after the step, to first order: the square falls by g . step.
        gradient = products[-unknowns:]
        rss = jnp.maximum(rss - sum(g * s for g, s in zip(gradient, step, strict=True)), 0.0)
        noise = jnp.sqrt(rss / (lines - unknowns))
        return moved(at, step, noise), inverse, noise

    def weighed(at: _Values, stage: _Stage) -> tuple[_Values, list[Array], Array]:
        columns, residual = derivatives(at)
        scale = jnp.maximum(at.scale, _FINEST_MM)
        square = (residual / scale[..., None]) ** 2
        root = jnp.maximum(1 - square / _CUT**2, 0.0)
        # Absolute deviations: about 1/|residual| if that is large, a convex loss, no false minima.
        weight = m * (jax.lax.rsqrt(1 + square / _KNEE**2) if stage == "absolute" else root * root)
        efficient = stage == "efficient"
        extra = weight if efficient else m * jnp.maximum(1 - square / _CUT_SCALE**2, 0.0) ** 3
        weighted = [weight * column for column in columns]
        *products, total, spread, lost = element_sums(
            *_products(weighted, columns, residual), extra, weight * square, m * (root <= 0.0)
        )
        step, inverse = _solve(products, unknowns)
        if efficient:
            kept = total / _MEAN_WEIGHT
            ratio = spread / (_MEAN_SQUARE * jnp.maximum(kept - unknowns, 1.0))
        else:
            # S-scale: mean rho = 1/2. The usual fixed-point step is squared, to be twice as quick.
            ratio = (2 * (lines - total) / (lines - unknowns)) ** 2
        scale = jnp.maximum(scale * jnp.sqrt(ratio), _FINEST_MM)
        return moved(at, step, scale), inverse, lost

    def repeat(count: int, step: Callable, at: _Values) -> _Values:
        return jax.lax.fori_loop(0, count, lambda _, state: step(state)[0], at)

    if robust:
        if not out_of_plane:
            state, *_ = equal(state)
        state = repeat(ABSOLUTE_STEPS, lambda at: weighed(at, "absolute"), state)
        state = repeat(SCALE_STEPS, lambda at: weighed(at, "scale"), state)
        state = repeat(LAST_STEPS - 1, lambda at: weighed(at, "efficient"), state)
        state, inverse, rejected = weighed(state, "efficient")
        inverse, noise = [entry * (_VARIANCE * _MEAN_WEIGHT) for entry in inverse], state.scale
    else:
        state = repeat(steps - 1, equal, state)
        state, inverse, noise = equal(state)
        rejected = jnp.zeros_like(lines)
    entries = [state.x, state.z, state.square][:unknowns]
    few = lines <= unknowns
    position = jnp.where(few[..., None], jnp.nan, jnp.stack(entries, axis=-1))
    matrix = jnp.stack(
        [jnp.stack([inverse[k] for k in row], axis=-1) for row in _ROWS[unknowns]], -2
    )
    return DistanceFit(
        position=position, inverse_normal=matrix, noise=noise, lines=lines, rejected=rejected
    )


# Indices of a symmetric matrix's entries in its upper triangle, which is stored row by row.
_ROWS = {2: ((0, 1), (1, 2)), 3: ((0, 1, 2), (1, 3, 4), (2, 4, 5))}


def _products(weighted: list[Array], columns: tuple[Array, ...], residual: Array) -> list[Array]:
    """Terms of the normal matrix's upper triangle, then of the gradient."""
    count = len(columns)
    upper = [weighted[i] * columns[j] for i in range(count) for j in range(i, count)]
    return upper + [column * residual for column in weighted]


def _solve(sums: list[Array], unknowns: int) -> tuple[tuple[Array, ...], list[Array]]:
    """The Gauss-Newton step, and the upper triangle of the inverse normal matrix."""
    if unknowns == 2:
        a, b, c, *gradient = sums
        determinant = a * c - b * b
        inverse = [c / determinant, -b / determinant, a / determinant]
    else:
        # Scaled to a unit diagonal: y^2 is hundreds of times the other unknowns.
        sa, sd, sf = (jax.lax.rsqrt(sums[k]) for k in (0, 3, 5))
        b, c, e = sums[1] * sa * sd, sums[2] * sa * sf, sums[4] * sd * sf
        *_, gx, gz, gs = sums
        gradient = [gx, gz, gs]
        upper = [1 - e * e, c * e - b, b * e - c, 1 - c * c, b * c - e, 1 - b * b]
        determinant = upper[0] + b * upper[1] + c * upper[2]
        scales = [sa * sa, sa * sd, sa * sf, sd * sd, sd * sf, sf * sf]
        inverse = [u * s / determinant for u, s in zip(upper, scales, strict=True)]
    step = tuple(
        sum((inverse[k] * g for k, g in zip(row, gradient, strict=True)), jnp.zeros_like(sums[0]))
        for row in _ROWS[unknowns]
    )
    return step, inverse
