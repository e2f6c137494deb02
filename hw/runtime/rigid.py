"""Rotations and rigid transforms in plain numpy: every conversion that ``hw`` needs, once.

Rotation vectors are axis times angle (rad); quaternions are (w, x, y, z) of unit length; transforms
are 4x4 with translations in mm. All functions take batches in the leading axes. Numpy only: the
small processes that talk to devices start without JAX and scipy.
"""

from __future__ import annotations

import numpy as np

from jaxcal.runtime.array_types import Float

_SMALL_ANGLE = 1e-6
"""Below this angle (rad) sines are taken from their series, which are exact to 1e-24 there."""


def rotation_matrix(vector: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Orthonormal matrices of rotation vectors (rad), by the formula of Rodrigues."""
    vector = np.asarray(vector, dtype=np.float64)
    square = np.sum(vector * vector, axis=-1)[..., None, None]
    angle = np.sqrt(square)
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - square / 6.0, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24.0, (1.0 - np.cos(safe)) / (safe * safe))
    skew = cross_matrix(vector)
    return np.eye(3) + first * skew + second * (skew @ skew)


def rotation_vector(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """Rotation vectors (rad, at most pi long) of orthonormal matrices."""
    return quaternion_to_vector(matrix_to_quaternion(rotation))


def cross_matrix(vector: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Matrices whose product with another vector is the cross product."""
    matrix = np.zeros((*vector.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -vector[..., 2], vector[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = vector[..., 2], -vector[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -vector[..., 1], vector[..., 0]
    return matrix


def quaternion_to_vector(quaternion: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 3"]:
    """Rotation vectors (rad, at most pi long) of unit quaternions."""
    quaternion = np.asarray(quaternion, dtype=np.float64)
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    vector = quaternion[..., 1:]
    sine = np.sqrt(np.sum(vector * vector, axis=-1, keepdims=True))
    angle = 2.0 * np.arctan2(sine, quaternion[..., :1])
    tiny = sine < 1e-9
    return vector * np.where(tiny, 2.0, angle / np.where(tiny, 1.0, sine))


def matrix_to_quaternion(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Unit quaternions, w >= 0, of orthonormal matrices.

    The largest component is taken from the diagonal (Shepperd 1978), which keeps its digits at half
    a turn, where the skew part vanishes.
    """
    r = np.asarray(rotation, dtype=np.float64)
    a, b, c = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    yz, zx, xy = (
        r[..., 2, 1] - r[..., 1, 2],
        r[..., 0, 2] - r[..., 2, 0],
        r[..., 1, 0] - r[..., 0, 1],
    )
    pxy, pzx, pyz = (
        r[..., 1, 0] + r[..., 0, 1],
        r[..., 0, 2] + r[..., 2, 0],
        r[..., 2, 1] + r[..., 1, 2],
    )
    # Rows: 4 q_k times the quaternion (w, x, y, z), for k = w, x, y, z.
    rows = np.stack(
        [
            np.stack([1 + a + b + c, yz, zx, xy], axis=-1),
            np.stack([yz, 1 + a - b - c, pxy, pzx], axis=-1),
            np.stack([zx, pxy, 1 - a + b - c, pyz], axis=-1),
            np.stack([xy, pzx, pyz, 1 - a - b + c], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def quaternion_to_matrix(quaternion: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 3 3"]:
    """Orthonormal matrices of unit quaternions."""
    quaternion = np.asarray(quaternion, dtype=np.float64)
    skew = cross_matrix(quaternion[..., 1:])
    return np.eye(3) + 2.0 * quaternion[..., :1, None] * skew + 2.0 * (skew @ skew)


def turn_deg(first: Float[np.ndarray, "4 4"], second: Float[np.ndarray, "4 4"]) -> float:
    """Angle (deg) between the rotations of two transforms."""
    relative = np.asarray(first)[:3, :3].T @ np.asarray(second)[:3, :3]
    sine = min(1.0, float(np.linalg.norm(relative - np.eye(3))) / np.sqrt(8.0))
    return float(np.degrees(2.0 * np.arcsin(sine)))


def looking_rotation(looking: Float[np.ndarray, 3]) -> Float[np.ndarray, "3 3"]:
    """Image axes [lateral, elevational, axial] in the base frame of a probe with this direction."""
    axial = np.asarray(looking, float) / np.linalg.norm(looking)
    guess = np.eye(3)[np.argmin(np.abs(axial))]
    lateral = guess - axial * (guess @ axial)
    lateral /= np.linalg.norm(lateral)
    return np.stack([lateral, np.cross(axial, lateral), axial], axis=1)


def rigid(
    turn: Float[np.ndarray, "*n 3"], translation: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 4 4"]:
    """Transforms of rotation vectors (rad) and translations (mm)."""
    turn, translation = np.asarray(turn, float), np.asarray(translation, float)
    matrix = np.zeros((*np.broadcast_shapes(turn.shape, translation.shape)[:-1], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3] = rotation_matrix(turn), translation
    matrix[..., 3, 3] = 1.0
    return matrix


def inverse(transform: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
    """Inverse transforms."""
    back = np.zeros_like(transform)
    turned = np.swapaxes(transform[..., :3, :3], -1, -2)
    back[..., :3, :3] = turned
    back[..., :3, 3] = -(turned @ transform[..., :3, 3:])[..., 0]
    back[..., 3, 3] = 1.0
    return back


def straight_way(
    start: Float[np.ndarray, "4 4"], goal: Float[np.ndarray, "4 4"], parts: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 4"]:
    """Poses along a straight motion: on a line, turning evenly about a fixed axis.

    Args:
        start: at part 0.
        goal: at part 1.
        parts: parts of the way, 0 to 1.
    """
    parts = np.asarray(parts, dtype=np.float64)[:, None]
    turn = rotation_vector(goal[:3, :3] @ start[:3, :3].T)
    way = rigid(parts * turn, start[:3, 3] + parts * (goal[:3, 3] - start[:3, 3]))
    way[:, :3, :3] = way[:, :3, :3] @ start[:3, :3]
    return way
