"""Universal Robots' poses [x, y, z, rx, ry, rz] (m, axis-angle rad) and 4x4 transforms in mm.

Numpy only: the processes that talk to the robot start without JAX.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

MM_PER_M = 1000.0


def ur_to_pose(raw: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Poses as the controller gives them -> 4x4 transforms.

    Args:
        raw: (..., 6) position (m) and rotation vector (rad) of a frame in the robot's base frame.

    Returns:
        (..., 4, 4), mm: the frame -> robot base.
    """
    raw = np.asarray(raw, dtype=np.float64)
    pose = np.zeros((*raw.shape[:-1], 4, 4))
    pose[..., :3, :3] = rotation_matrix(raw[..., 3:])
    pose[..., :3, 3] = raw[..., :3] * MM_PER_M
    pose[..., 3, 3] = 1.0
    return pose


def pose_to_ur(pose: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """4x4 transforms (mm) -> poses as the controller takes them.

    Args:
        pose: (..., 4, 4), mm; rotation blocks must be orthonormal.

    Returns:
        (..., 6) metres and a rotation vector of at most pi rad.
    """
    pose = np.asarray(pose, dtype=np.float64)
    position = pose[..., :3, 3] / MM_PER_M
    return np.concatenate([position, rotation_vector(pose[..., :3, :3])], axis=-1)


def rotation_matrix(vector: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Orthonormal matrices of rotation vectors (rad), by the formula of Rodrigues."""
    square = np.sum(vector * vector, axis=-1)[..., None, None]
    angle = np.sqrt(square)
    small = square < 1e-12
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - square / 6.0, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24.0, (1.0 - np.cos(safe)) / (safe * safe))
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    skew = np.stack(
        [
            np.stack([zero, -z, y], axis=-1),
            np.stack([z, zero, -x], axis=-1),
            np.stack([-y, x, zero], axis=-1),
        ],
        axis=-2,
    )
    return np.eye(3) + first * skew + second * (skew @ skew)


def rotation_vector(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Rotation vectors (rad, at most pi long) of orthonormal matrices.

    Through the unit quaternion with its largest component taken from the diagonal (Shepperd 1978),
    which keeps its digits at half a turn, where the skew part vanishes.
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
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., :1])
    scale = np.where(sine < 1e-9, 2.0, angle / np.where(sine < 1e-9, 1.0, sine))
    return quaternion[..., 1:] * scale


def turn_deg(first: Float[np.ndarray, "4 4"], second: Float[np.ndarray, "4 4"]) -> float:
    """Angle (deg) between the rotations of two transforms."""
    relative = np.asarray(first)[:3, :3].T @ np.asarray(second)[:3, :3]
    sine = min(1.0, float(np.linalg.norm(relative - np.eye(3))) / np.sqrt(8.0))
    return float(np.degrees(2.0 * np.arcsin(sine)))
