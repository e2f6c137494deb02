"""Rigid transforms of a bench in plain numpy: rotations from vectors and from directions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def rotation(vector: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of an axis-angle vector, rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = np.asarray(vector, float) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def looking_rotation(looking: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """Image axes [lateral, elevational, axial] in the base frame when the probe looks that way."""
    axial = np.asarray(looking, float) / np.linalg.norm(looking)
    guess = np.eye(3)[np.argmin(np.abs(axial))]
    lateral = guess - axial * (guess @ axial)
    lateral /= np.linalg.norm(lateral)
    return np.stack([lateral, np.cross(axial, lateral), axial], axis=1)


def rigid(turn: np.ndarray, translation: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """4x4 transform of an axis-angle vector (rad) and a translation (mm)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(np.asarray(turn)), translation
    return matrix
