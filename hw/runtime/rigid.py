"""Rotations and rigid transforms in plain numpy, beside those of :mod:`jaxcal.data.poses`.

Rotation vectors are axis times angle (rad); transforms are 4x4 with translations in mm. Numpy only:
the small processes that talk to devices start without JAX and scipy.
"""

from __future__ import annotations

import numpy as np

from jaxcal.data.poses import (
    matrices_from_rotations,
    nearest_rotations,
    rotation_angle,
    rotations_from_vectors,
    vectors_from_rotations,
)
from jaxcal.runtime.array_types import Float


def turn_deg(first: Float[np.ndarray, "4 4"], second: Float[np.ndarray, "4 4"]) -> float:
    """Angle (deg) between the rotations of two transforms."""
    return float(np.degrees(rotation_angle(first, second)))


def apart(first: Float[np.ndarray, "4 4"], second: Float[np.ndarray, "4 4"]) -> float:
    """Distance of two poses, mm; a degree counts as a mm."""
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3])) + turn_deg(first, second)


def looking_rotation(looking: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
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
    turn, translation = np.broadcast_arrays(np.asarray(turn, float), translation)
    return matrices_from_rotations(rotations_from_vectors(turn), translation)


def mean_pose(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "4 4"]:
    """Mean position (mm) of poses near each other, and the rotation nearest to the mean matrix."""
    rotations, _ = nearest_rotations(poses[:, :3, :3].mean(axis=0, keepdims=True))
    return matrices_from_rotations(rotations[0], poses[:, :3, 3].mean(axis=0))


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
    turn = vectors_from_rotations(goal[:3, :3] @ start[:3, :3].T)
    way = rigid(parts * turn, start[:3, 3] + parts * (goal[:3, 3] - start[:3, 3]))
    way[:, :3, :3] = way[:, :3, :3] @ start[:3, :3]
    return way


def ur_to_pose(raw: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Poses as a Universal Robots controller gives them -> 4x4 transforms.

    Args:
        raw: (..., 6) position (m) and rotation vector (rad) of a frame in the robot's base frame.

    Returns:
        (..., 4, 4), mm: the frame -> robot base.
    """
    raw = np.asarray(raw, dtype=np.float64)
    return rigid(raw[..., 3:], raw[..., :3] * 1000.0)


def pose_to_ur(pose: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """4x4 transforms (mm) -> poses as a Universal Robots controller takes them.

    Args:
        pose: (..., 4, 4), mm; rotation blocks must be orthonormal.

    Returns:
        (..., 6) metres and a rotation vector of at most pi rad.
    """
    pose = np.asarray(pose, dtype=np.float64)
    position = pose[..., :3, 3] / 1000.0
    return np.concatenate([position, vectors_from_rotations(pose[..., :3, :3])], axis=-1)
