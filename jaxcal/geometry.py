"""Rigid transforms at the boundary: 4x4 matrices in millimetres, checked and projected to SE(3).

Inside the engine a pose is a 4x4 array whose rotation can be trusted; this module is where somebody
else's matrices become such poses. A rotation block within 1e-2 (Frobenius) of SO(3) is projected to
it by SVD (text files and optical trackers round); anything farther is refused with its row named.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.errors import InputError

AnyArray = Array | np.ndarray
"""Public functions of arrays take numpy's as well as JAX's."""

ROTATION_TOLERANCE = 1e-2
"""Largest Frobenius distance from SO(3) that is taken for rounding."""

_SMALL_ANGLE_SQUARED = 1e-2
"""rad^2; below it a series replaces quotients, whose derivatives divide by powers of the angle."""
_TERMS = 7
"""The first term left out is below 1e-26, its second derivative below 1e-20."""


def nearest_rotations(
    matrices: Float[np.ndarray, "n 3 3"],
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, " n"]]:
    """The proper rotations nearest to 3x3 matrices, and how far away they were.

    Args:
        matrices: any 3x3 matrices, finite.

    Returns:
        rotations (n, 3, 3) in SO(3) and Frobenius distances (n,).

    Source: Schoenemann 1966 (orthogonal Procrustes), restricted to det = +1.
    """
    u, _, vt = np.linalg.svd(matrices)
    sign = np.linalg.det(u @ vt)
    u = u.copy()
    u[..., :, 2] *= sign[..., None]
    rotations = u @ vt
    return rotations, np.linalg.norm(rotations - matrices, axis=(-2, -1))


def check_poses(
    poses: np.ndarray, used: np.ndarray | None = None, *, what: str = "pose"
) -> Float[np.ndarray, "n 4 4"]:
    """Check 4x4 poses (mm) and project their rotations to SO(3).

    Args:
        poses: (n, 4, 4), or (n, 3, 4) without the last row; mm.
        used: (n,) bool; images left out are not checked and come back as the identity.
        what: how an error names the array.

    Returns:
        (n, 4, 4) float64 poses whose rotation blocks are orthonormal.

    Raises:
        InputError: wrong shape, NaN or Inf, last row not 0 0 0 1, a reflection, or a block farther
            than 1e-2 from a rotation; the row (image) is named.
    """
    poses = np.array(poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] not in ((4, 4), (3, 4)):
        raise InputError(f"{what} must have shape (n, 4, 4), it has {poses.shape}")
    count = len(poses)
    full = np.tile(np.eye(4), (count, 1, 1))
    full[:, : poses.shape[1]] = poses
    used = np.ones(count, bool) if used is None else np.asarray(used, bool)
    full[~used] = np.eye(4)

    bad = ~np.isfinite(full).all(axis=(1, 2))
    if bad.any():
        raise InputError(f"{what} {np.flatnonzero(bad)[0]} holds NaN or Inf")
    bad = np.abs(full[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) > 1e-6
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"{what} {row} is not a rigid transform: its last row is {full[row, 3].tolist()}, "
            "not [0, 0, 0, 1] (a transposed matrix?)"
        )
    rotations, distance = nearest_rotations(full[:, :3, :3])
    bad = distance > ROTATION_TOLERANCE
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        if np.linalg.det(full[row, :3, :3]) < 0:
            raise InputError(
                f"{what} {row} is a reflection (determinant "
                f"{np.linalg.det(full[row, :3, :3]):.3f}): convert it to a right-handed frame"
            )
        raise InputError(
            f"{what} {row} is not a rotation: its 3x3 block is {distance[row]:.3g} away from "
            f"the nearest one (at most {ROTATION_TOLERANCE:g} is taken for rounding)"
        )
    full[:, :3, :3] = rotations
    full[:, 3] = [0.0, 0.0, 0.0, 1.0]
    return full


def transform_points(
    transform: Float[AnyArray, "*#batch 4 4"], points: Float[AnyArray, "*#batch 3"]
) -> Float[Array, "*batch 3"]:
    """Apply 4x4 rigid transforms to points (mm); leading axes broadcast."""
    rotated = jnp.einsum("...ij,...j->...i", transform[..., :3, :3], points)
    return rotated + transform[..., :3, 3]


def matrix_from_rotation(
    rotation: Float[Array, "3 3"], translation: Float[Array, 3]
) -> Float[Array, "4 4"]:
    """The 4x4 transform with the given rotation and translation (mm)."""
    top = jnp.concatenate([rotation, translation[:, None]], axis=1)
    bottom = jnp.asarray([[0.0, 0.0, 0.0, 1.0]], dtype=top.dtype)
    return jnp.concatenate([top, bottom], axis=0)


def rotation_from_vector(vector: Float[Array, 3]) -> Float[Array, "3 3"]:
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


def chord_angle(difference: Float[Array, "3 3 *lanes"]) -> Float[Array, "*lanes"]:
    """Angle (rad) between two rotations, from their difference; lanes last.

    2 asin(|R1 - R2| / sqrt 8) keeps its digits near zero, where acos of the trace loses half.
    """
    chord = jnp.sqrt(jnp.sum(difference**2, axis=(0, 1)))
    return 2 * jnp.arcsin(jnp.minimum(chord / math.sqrt(8.0), 1.0))


def rotation_angle(first: np.ndarray, second: np.ndarray) -> float:
    """Angle (rad) between the rotations of two 4x4 transforms."""
    relative = np.asarray(first)[:3, :3].T @ np.asarray(second)[:3, :3]
    # 2 asin(|R - I| / sqrt 8) keeps its digits near zero, where acos of the trace loses half.
    return float(2 * np.arcsin(min(1.0, np.linalg.norm(relative - np.eye(3)) / np.sqrt(8))))
