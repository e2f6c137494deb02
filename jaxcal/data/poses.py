"""Poses at the boundary: 4x4 matrices in millimetres, checked and projected to SE(3). Numpy only.

Matrices and quaternions from elsewhere become poses whose rotations can be trusted. A rotation
block within 1e-2 (Frobenius) of SO(3) is projected to it by SVD, since text files and optical
trackers round their numbers. A block that is farther away is refused, and its row is named.

Nothing here imports JAX, so that files can be read and converted without its start-up time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.names import QuaternionOrder
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.given_values import real_array

ROTATION_TOLERANCE = 1e-2
"""Largest Frobenius distance from SO(3) that counts as rounding."""

QUATERNION_TOLERANCE = 1e-2
"""Largest distance of a quaternion's length from 1 that counts as rounding."""

LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
"""Of a 4x4 pose."""

LAST_ROW_TOLERANCE = 1e-6
"""Largest difference from it, of any number, that counts as rounding."""


def targets_in_images(
    poses: Float[Any, "*n 4 4"], image_to_probe: Float[Any, "4 4"], point: Float[Any, " 3"]
) -> Float[Any, "*n 3"]:
    """Where a target at rest is in the images' frames, mm.

    Args:
        poses: probe -> tracker, mm; numpy or JAX.
        image_to_probe: X.
        point: the target in the tracker's frame, mm.

    Returns:
        q = X^-1 B^-1 c: lateral, elevational, axial.
    """
    away = (point - poses[..., :3, 3])[..., None, :]
    in_probe = (away @ poses[..., :3, :3])[..., 0, :]
    return (in_probe - image_to_probe[:3, 3]) @ image_to_probe[:3, :3]


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
    poses: np.ndarray,
    used: np.ndarray | None = None,
    *,
    what: str = "pose",
    labels: Sequence[str] | None = None,
) -> Float[np.ndarray, "n 4 4"]:
    """Check 4x4 poses (mm) and project their rotations to SO(3).

    Args:
        poses: (n, 4, 4), or (n, 3, 4) without the last row; mm.
        used: (n,) bool; images left out are not checked and come back as the identity.
        what: how an error names the array.
        labels: how an error names each row, for instance "in line 7"; its number by default.

    Returns:
        (n, 4, 4) float64 poses whose rotation blocks are orthonormal.

    Raises:
        InputError: wrong shape, NaN or Inf, last row not 0 0 0 1, a reflection, or a block farther
            than 1e-2 from a rotation; the row (image) is named.
    """
    poses = real_array(poses, f"{what}s")
    if poses.ndim != 3 or poses.shape[1:] not in ((4, 4), (3, 4)):
        raise InputError(f"{what} must have shape (n, 4, 4), it has {poses.shape}")
    count = len(poses)
    full = np.tile(np.eye(4), (count, 1, 1))
    full[:, : poses.shape[1]] = poses
    used = np.ones(count, bool) if used is None else np.asarray(used, bool)
    full[~used] = np.eye(4)

    def name(row: int) -> str:
        return f"{what} {row if labels is None else labels[row]}"

    bad = ~np.isfinite(full).all(axis=(1, 2))
    if bad.any():
        raise InputError(f"{name(int(np.flatnonzero(bad)[0]))} holds NaN or Inf")
    bad = np.abs(full[:, 3] - LAST_ROW).max(axis=1) > LAST_ROW_TOLERANCE
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"{name(row)} is not a rigid transform: its last row is {full[row, 3].tolist()}, "
            "not [0, 0, 0, 1] (a transposed matrix?)"
        )
    rotations, distance = nearest_rotations(full[:, :3, :3])
    bad = distance > ROTATION_TOLERANCE
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        if np.linalg.det(full[row, :3, :3]) < 0:
            raise InputError(
                f"{name(row)} is a reflection (determinant "
                f"{np.linalg.det(full[row, :3, :3]):.3f}): convert it to a right-handed frame"
            )
        raise InputError(
            f"{name(row)} is not a rotation: its 3x3 block is {distance[row]:.3g} away from "
            f"the nearest one (at most {ROTATION_TOLERANCE:g} is taken for rounding; the numbers "
            "of a matrix are needed row by row)"
        )
    full[:, :3, :3] = rotations
    full[:, 3] = LAST_ROW
    return full


def check_affine(matrix: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Check a 4x4 matrix that may hold scales: finite, last row 0 0 0 1, no reflection.

    Raises:
        InputError: it is none; one line.
    """
    matrix = real_array(matrix, "the matrix")
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError("the matrix must be 4 x 4 and finite")
    if np.abs(matrix[3] - LAST_ROW).max() > LAST_ROW_TOLERANCE:
        raise InputError("the matrix's last row is not 0 0 0 1 (a transposed matrix?)")
    if np.linalg.det(matrix[:3, :3]) <= 0:
        raise InputError("the matrix is a reflection, or flat: its determinant is not positive")
    matrix[3] = LAST_ROW
    return matrix


def rotation_angle(first: np.ndarray, second: np.ndarray) -> float:
    """Angle (rad) between the rotations of two 4x4 transforms."""
    relative = np.asarray(first)[:3, :3].T @ np.asarray(second)[:3, :3]
    # 2 asin(|R - I| / sqrt 8) keeps its digits near zero, where acos of the trace loses half.
    return float(2 * np.arcsin(min(1.0, np.linalg.norm(relative - np.eye(3)) / np.sqrt(8))))


def rotations_from_quaternions(
    quaternions: Float[np.ndarray, "n 4"],
    order: QuaternionOrder,
    *,
    labels: Sequence[str] | None = None,
) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices of unit quaternions.

    Args:
        quaternions: one a row, of length 1 to within 1e-2; they are normalised.
        order: ``xyzw`` (scalar last) or ``wxyz`` (scalar first).
        labels: how an error names each row, for instance "in line 7"; its number by default.

    Raises:
        InputError: a quaternion whose length is not 1, or NaN or Inf; the row is named.
    """
    values = np.asarray(quaternions, dtype=np.float64)
    length = np.linalg.norm(values, axis=1)
    bad = np.flatnonzero(~(np.abs(length - 1) < QUATERNION_TOLERANCE))
    if len(bad):
        row = int(bad[0])
        name = row if labels is None else labels[row]
        raise InputError(f"quaternion {name} has length {length[row]:g}, not 1")
    values = values / length[:, None]
    scalar, vector = values[:, 3], values[:, :3]
    if order == "wxyz":
        scalar, vector = values[:, 0], values[:, 1:]
    cross = _cross(vector)
    return np.eye(3) + 2 * (scalar[:, None, None] * cross + cross @ cross)


def rotations_from_vectors(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Rotation matrices of axes times angles (rad), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = _cross(vectors)
    # sin(t) / t and (1 - cos(t)) / t^2 by numpy's sinc, which is right at zero.
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + first * cross + second * cross @ cross


def _cross(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The matrices [v]x of cross products with vectors."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    return cross.reshape(*vectors.shape, 3)


def quaternions_from_rotations(rotations: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Unit quaternions x y z w (scalar last, not negative) of rotation matrices.

    The largest component is taken from the diagonal (Shepperd 1978): accurate for every angle, also
    at half a turn, where the skew part vanishes.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(rotations, (-2, -1), (0, 1))
    # Rows: 4 q_k times the quaternion (x, y, z, w), for k = x, y, z, w.
    rows = np.array(
        [
            [1 + xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, 1 + yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, 1 + zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz],
        ]
    )
    rows = np.moveaxis(rows, (0, 1), (-2, -1))
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    found = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    found = found / np.linalg.norm(found, axis=-1, keepdims=True)
    return np.where(found[..., 3:] >= 0, found, -found)


def vectors_from_rotations(rotations: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """Rotation vectors, axis times angle (rad, at most pi), of rotation matrices."""
    quaternions = quaternions_from_rotations(rotations)
    vectors = quaternions[..., :3]
    sine = np.linalg.norm(vectors, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternions[..., 3:])
    # For no rotation, twice the quaternion's vector.
    tiny = sine < 1e-9
    return vectors * np.where(tiny, 2.0, angle / np.where(tiny, 1.0, sine))


def inverse_poses(poses: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """The inverses of rigid transforms."""
    rotation = np.swapaxes(poses[..., :3, :3], -1, -2)
    translation = -np.einsum("...ij,...j->...i", rotation, poses[..., :3, 3])
    return matrices_from_rotations(rotation, translation)


def matrices_from_rotations(
    rotations: Float[np.ndarray, "*batch 3 3"], translations: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """The 4x4 transforms with the given rotations and translations (mm)."""
    matrices = np.zeros((*rotations.shape[:-2], 4, 4), rotations.dtype)
    matrices[..., :3, :3], matrices[..., :3, 3] = rotations, translations
    matrices[..., 3, 3] = 1.0
    return matrices
