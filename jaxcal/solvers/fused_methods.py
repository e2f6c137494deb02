"""The conventional fit and the paper's alternation on the fused pass, many problems side by side.

They are :func:`jaxcal.solvers.conventional.from_scratch` and
:func:`jaxcal.solvers.alternating.alternate` for points with known scales; those are the reference.

The closed-form start needs the images once: the normal matrix of its 12 unknowns (a1, a3, t, c)
consists of sums of x, z, their products and the rotations. Columns of length near 1 and a pivot
well above rounding make it sound; where it is not, t and c for each rotation of the cube follow
from the same sums, and the best of the fits from there is the answer.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.model.residuals import LARGEST_ELEVATION
from jaxcal.solvers import unrolled
from jaxcal.solvers.fused import Guess, Held, Images, Normal, accumulate, targets, total
from jaxcal.solvers.initial import cube_rotations
from jaxcal.solvers.lanes import (
    Descent,
    Rounding,
    apart,
    choose,
    gradient_cosine,
    minimise,
)
from jaxcal.solvers.unrolled import Matrix, Vector

LEAST_PIVOT = 1e-10
"""Of the start's normal matrix with a unit diagonal; below it the start is called unsound."""


class Begun(eqx.Module):
    """Conventional fits, and where a start had to be searched for."""

    fit: Descent
    searched: Bool[Array, " lanes"]


class _Moments(eqx.Module):
    """Sums over the images, points and origins taken from their means."""

    count: Array
    mean: Vector
    centre: Vector
    xx: Array
    xz: Array
    zz: Array
    lateral: Matrix
    axial: Matrix
    rotation: Matrix
    pulled: list[Vector]


def _moments(images: Images) -> _Moments:
    count = images.used
    points = [images.lateral, images.distance]
    mean = [jnp.sum(images.mask * plane, axis=1) / count for plane in points]
    centre = [jnp.sum(images.mask * plane, axis=1) / count for plane in images.origin]
    x, z = (images.mask * (p - m[:, None]) for p, m in zip(points, mean, strict=True))
    away = [c[:, None] - plane for plane, c in zip(images.origin, centre, strict=True)]
    turn = [[images.rotation[3 * i + j] for j in range(3)] for i in range(3)]
    back = unrolled.apply(unrolled.transpose(turn), away)
    flat = [entry for row in turn for entry in row]
    planes = [x * x, x * z, z * z]
    for weight in (x, z, images.mask):
        planes += [weight * entry for entry in flat] + [weight * entry for entry in back]
    sums = unrolled.rows_of(apart(jnp.stack(total(planes))))
    parts = [sums[3 + 12 * k : 15 + 12 * k] for k in range(3)]
    matrices = [[part[3 * i : 3 * i + 3] for i in range(3)] for part in parts]
    lateral, axial, rotation = matrices
    pulled = [part[9:] for part in parts]
    return _Moments(
        count, mean, centre, sums[0], sums[1], sums[2], lateral, axial, rotation, pulled
    )


def _rest(rotation: Matrix, moments: _Moments) -> Guess:
    """X's origin and the target by linear least squares with X's rotation held."""
    zero, count = jnp.zeros_like(moments.count), moments.count
    lateral, axial = ([row[k] for row in rotation] for k in (0, 2))
    (x, z), centre = moments.mean, moments.centre
    # R_i (x a1 + z a3 + t) - c' = centre - b_i; x and z are deviations, so t is that of the mean.
    known = [
        -a - b
        for a, b in zip(
            unrolled.apply(moments.lateral, lateral), unrolled.apply(moments.axial, axial),
            strict=True,
        )
    ]  # fmt: skip
    matrix: Matrix = [[zero] * 6 for _ in range(6)]
    for i in range(3):
        matrix[i][i] = matrix[3 + i][3 + i] = count * (1 + 1e-12)
        for j in range(3):
            matrix[3 + i][j] = matrix[j][3 + i] = -moments.rotation[i][j]
    # Deviations of x and z, and of the origins, sum to nothing.
    rhs = [*moments.pulled[2], *(-value for value in known)]
    found = unrolled.rows_of(apart(jnp.stack(unrolled.solve(matrix, rhs))))
    shift = [t - x * a - z * b for t, a, b in zip(found[:3], lateral, axial, strict=True)]
    return Guess(
        jnp.stack([jnp.stack(row) for row in rotation]),
        jnp.stack(shift),
        jnp.stack([c + d for c, d in zip(centre, found[3:], strict=True)]),
    )


def closed_form(images: Images) -> tuple[Guess, Bool[Array, " lanes"], _Moments]:
    """The start of :mod:`jaxcal.solvers.initial`, whether it is sound, and its sums."""
    m = _moments(images)
    size = 12
    full: Matrix = [[0] * size for _ in range(size)]
    products = [[m.xx, m.xz], [m.xz, m.zz]]
    for a in range(2):
        for b in range(2):
            for i in range(3):
                full[3 * a + i][3 * b + i] = products[a][b]
    for i in range(3):
        full[6 + i][6 + i] = full[9 + i][9 + i] = m.count
        for j in range(3):
            for k, matrix in enumerate((m.lateral, m.axial, m.rotation)):
                full[9 + j][3 * k + i] = full[3 * k + i][9 + j] = -matrix[j][i]
    length = [jnp.sqrt(jnp.where(full[k][k] > 0, full[k][k], 1.0)) for k in range(size)]
    inverse = [1 / value for value in length]
    unit = [
        [unrolled.times(full[i][j], inverse[i] * inverse[j]) for j in range(size)]
        for i in range(size)
    ]
    rhs = [*m.pulled[0], *m.pulled[1], *m.pulled[2], *[jnp.zeros_like(m.count)] * 3]
    rhs = [a * b for a, b in zip(rhs, inverse, strict=True)]
    factor, pivots = unrolled.cholesky(unit)
    least = 1 / jnp.max(jnp.stack(pivots), axis=0) ** 2
    solved = unrolled.backward(factor, pivots, unrolled.forward(factor, pivots, rhs))
    flat = [a * b for a, b in zip(solved[:6], inverse[:6], strict=True)]
    columns = apart(jnp.stack([*flat, least]))
    a, b, least = columns[:3], columns[3:6], columns[6]
    long, deep = jnp.sqrt(jnp.sum(a * a, axis=0)), jnp.sqrt(jnp.sum(b * b, axis=0))
    cosine = jnp.abs(jnp.sum(a * b, axis=0)) / (long * deep)
    # Comparisons with NaN are false: whatever went wrong is not sound.
    sound = (least > LEAST_PIVOT) & (cosine < 0.5)
    for size_of in (long, deep):
        sound = sound & (size_of > 0.5) & (size_of < 2.0)
    eye = jnp.eye(3, dtype=a.dtype)
    a = jnp.where(sound, a / long, eye[:, :1])
    b = jnp.where(sound, b / deep, eye[:, 1:2])
    plus, minus = a + b, a - b
    plus = plus / jnp.sqrt(jnp.sum(plus**2, axis=0))
    minus = minus / jnp.sqrt(jnp.sum(minus**2, axis=0))
    lateral, axial = (plus + minus) / jnp.sqrt(2.0), (plus - minus) / jnp.sqrt(2.0)
    middle = jnp.cross(axial, lateral, axis=0)
    rotation = [[lateral[i], middle[i], axial[i]] for i in range(3)]
    return _rest(rotation, m), sound, m


def from_scratch(images: Images, *, max_steps: int = 100) -> Begun:
    """Conventional fits from the closed-form start, or the best of many where it is unsound."""
    start, sound, moments = closed_form(images)
    belief = Held(jnp.zeros_like(images.mask))
    cubes = jnp.asarray(cube_rotations(), images.mask.dtype)
    lanes = images.mask.shape[0]

    def one_round(state: tuple) -> tuple:
        index, best = state
        cube = cubes[jnp.maximum(index - 1, 0)]
        rotation = [[jnp.broadcast_to(cube[i, j], (lanes,)) for j in range(3)] for i in range(3)]
        turned = _rest(rotation, moments)
        first = choose(index == 0, start, turned)
        fit = minimise(apart(first), belief, images, max_steps=max_steps)
        lower = (fit.cost < best.cost) | ~jnp.isfinite(best.cost)
        better = (index == 0) | (lower & ~sound)
        return index + 1, choose(better, fit, best)

    def unfinished(state: tuple) -> Bool[Array, ""]:
        return (state[0] == 0) | (jnp.any(~sound) & (state[0] <= len(cubes)))

    shapes = jax.eval_shape(partial(minimise, max_steps=max_steps), start, belief, images)
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    _, fit = jax.lax.while_loop(unfinished, one_round, (jnp.zeros((), jnp.int32), empty))
    return Begun(fit, jnp.logical_not(sound))


class Alternated(eqx.Module):
    """Where the alternation stopped; as :class:`jaxcal.solvers.alternating.Alternation`."""

    guess: Guess
    offset: Float[Array, "lanes n"]
    normal: Normal
    cosine: Float[Array, " lanes"]
    rounds: Int[Array, " lanes"]
    tolerance_met: Bool[Array, " lanes"]
    rotation_change: Float[Array, " lanes"]
    translation_change: Float[Array, " lanes"]


def closest_offsets(
    guess: Guess, bound: Float[Array, "lanes n"], images: Images
) -> Float[Array, "lanes n"]:
    """y_i of the point of every arc that is closest to q_i, mm."""
    q, _ = targets(guess, images)
    limit = jnp.minimum(bound, LARGEST_ELEVATION * jnp.abs(images.distance))
    on_circle = images.distance * q[1] * jax.lax.rsqrt(q[1] * q[1] + q[2] * q[2])
    behind = jnp.where(q[1] < 0, -limit, limit)
    free = jnp.where(q[2] > 0, on_circle, behind)
    return images.mask * jnp.clip(free, -limit, limit)


def alternate(
    start: Guess,
    bound: Float[Array, "lanes n"],
    images: Images,
    *,
    tolerance_rad: float,
    tolerance_mm: float,
    max_rounds: int | Int[Array, ""],
    inner_steps: int,
) -> Alternated:
    """Alternate from (conventional) starts; see :func:`jaxcal.solvers.alternating.alternate`."""
    none = jnp.zeros_like(images.mask[:, 0])
    eps = jnp.finfo(none.dtype).eps

    def gauss_newton(_: Array, carry: tuple) -> tuple:
        guess, held = carry
        normal = apart(accumulate(guess, held, images, none))
        matrix = normal.matrix()
        for k in range(len(matrix)):
            matrix[k][k] = matrix[k][k] * (1 + 16 * eps)
        move = unrolled.solve(matrix, [-value for value in unrolled.rows_of(normal.gradient)])
        return apart(guess.moved(unrolled.rows_of(apart(jnp.stack(move))))), held

    def one_round(state: tuple) -> tuple:
        guess, rounds, _, _ = state
        held = Held(apart(closest_offsets(guess, bound, images)))
        after, _ = jax.lax.fori_loop(0, inner_steps, gauss_newton, (guess, held))
        chord = jnp.sqrt(jnp.sum((guess.rotation - after.rotation) ** 2, axis=(0, 1)))
        angle = 2 * jnp.arcsin(jnp.minimum(chord / jnp.sqrt(8.0).astype(none.dtype), 1))
        shift = jnp.sqrt(jnp.sum((guess.translation - after.translation) ** 2, axis=0))
        return choose(active(state), (after, rounds + 1, angle, shift), state)

    def active(state: tuple) -> Bool[Array, " lanes"]:
        _, rounds, turned, moved = state
        return ((turned >= tolerance_rad) | (moved >= tolerance_mm)) & (rounds < max_rounds)

    state = (start, jnp.zeros(none.shape, jnp.int32), none + jnp.inf, none + jnp.inf)
    guess, rounds, turned, moved = jax.lax.while_loop(
        lambda state: jnp.any(active(state)), one_round, state
    )
    held = Held(apart(closest_offsets(guess, bound, images)))
    normal = apart(accumulate(guess, held, images, none))
    rounding = Rounding.of(start, held, images)
    return Alternated(
        guess=guess, offset=held.elevation, normal=normal,
        cosine=gradient_cosine(normal, rounding.vanished), rounds=rounds,
        tolerance_met=(turned < tolerance_rad) & (moved < tolerance_mm),
        rotation_change=turned, translation_change=moved,
    )  # fmt: skip
