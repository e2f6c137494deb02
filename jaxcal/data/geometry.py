"""Rigid transforms in JAX: 4x4 matrices in millimetres whose rotations can be trusted.

Matrices from elsewhere are checked and converted by :mod:`jaxcal.data.poses`, in numpy.
"""

from __future__ import annotations

import math

from jax import numpy as jnp
from jaxtyping import Array, Float

_SMALL_ANGLE_SQUARED = 1e-2
"""rad^2. Below it a series is used: derivatives of quotients divide by powers of the angle."""
_TERMS = 7
"""Terms of the series. The first one left out is below 1e-26, its second derivative below 1e-20."""


def matrix_from_rotation(
    rotation: Float[Array, "*batch 3 3"], translation: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 4 4"]:
    """The 4x4 transforms with the given rotations and translations (mm)."""
    top = jnp.concatenate([rotation, translation[..., None]], axis=-1)
    row = jnp.asarray([[0.0, 0.0, 0.0, 1.0]], dtype=top.dtype)
    return jnp.concatenate([top, jnp.broadcast_to(row, (*top.shape[:-2], 1, 4))], axis=-2)


def rotation_from_vector(vector: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of an axis times an angle (rad), by Rodrigues' formula.

    Derivatives of every order that the solvers take are accurate everywhere, zero included.
    """
    squared = vector @ vector
    small = squared < _SMALL_ANGLE_SQUARED
    # The unused branch must stay finite, or its derivative would be NaN times zero.
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    first = jnp.where(small, _series(squared, 1), jnp.sin(angle) / angle)
    second = jnp.where(small, _series(squared, 2), 2 * (jnp.sin(angle / 2) / angle) ** 2)
    x, y, z = vector
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    identity = jnp.eye(3, dtype=vector.dtype)
    return (1 - second * squared) * identity + first * cross + second * jnp.outer(vector, vector)


def _series(squared: Float[Array, ""], order: int) -> Float[Array, ""]:
    """sin(t) / t (order 1) or (1 - cos(t)) / t^2 (order 2) of t^2, for small t."""
    total = jnp.zeros_like(squared)
    for power in reversed(range(_TERMS)):
        total = total * squared + (-1) ** power / math.factorial(2 * power + order)
    return total


def orthonormal_pair(
    a: Float[Array, "3 ..."], b: Float[Array, "3 ..."]
) -> tuple[Float[Array, "3 ..."], Float[Array, "3 ..."]]:
    """The orthonormal pair nearest to two unit vectors."""
    # Its diagonals lie along a + b and a - b, which are orthogonal.
    plus, minus = a + b, a - b
    plus = plus / jnp.sqrt(jnp.sum(plus**2, axis=0))
    minus = minus / jnp.sqrt(jnp.sum(minus**2, axis=0))
    half = math.sqrt(0.5)
    return half * (plus + minus), half * (plus - minus)


def origin_from_mean(
    of_mean: Float[Array, "3 ..."],
    mean: Float[Array, "2 ..."],
    lateral: Float[Array, "3 ..."],
    axial: Float[Array, "3 ..."],
    scale: Float[Array, "2 ..."],
    face: Float[Array, " ..."],
    moved_face: Float[Array, " ..."],
) -> Float[Array, "3 ..."]:
    """X's origin from where X puts the mean image point, in the probe's frame, mm.

    Pixel row 0 need not be at the transducer's face: a pixel's size does not scale the range of row
    0, the sound speed does.

    Args:
        of_mean: where X puts the mean image point.
        mean: of the [lateral, axial] image points at nominal pixel sizes and sound speed.
        lateral: first column of X's rotation.
        axial: its last column.
        scale: factors on [lateral, axial] lengths of the image.
        face: range of row 0 at the nominal sound speed.
        moved_face: the same at the sound speed that was found.
    """
    depth = scale[1] * (mean[1] - face) + moved_face
    return of_mean - scale[0] * mean[0] * lateral - depth * axial


def chord_angle(difference: Float[Array, "3 3 *batch"]) -> Float[Array, "*batch"]:
    """Angle (rad) between two rotations, from their difference; batch axes last.

    2 asin(|R1 - R2| / sqrt 8) keeps its digits near zero, where acos of the trace loses half
    of them.
    """
    chord = jnp.sqrt(jnp.sum(difference**2, axis=(0, 1)))
    return 2 * jnp.arcsin(jnp.minimum(chord / math.sqrt(8.0), 1.0))
