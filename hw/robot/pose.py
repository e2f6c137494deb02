"""Universal Robots' poses [x, y, z, rx, ry, rz] (m, axis-angle rad) and 4x4 transforms in mm.

Numpy only: the processes that talk to the robot start without JAX.
"""

from __future__ import annotations

import numpy as np

from hw.runtime.rigid import rigid, rotation_vector
from jaxcal.runtime.array_types import Float

MM_PER_M = 1000.0


def ur_to_pose(raw: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Poses as the controller gives them -> 4x4 transforms.

    Args:
        raw: (..., 6) position (m) and rotation vector (rad) of a frame in the robot's base frame.

    Returns:
        (..., 4, 4), mm: the frame -> robot base.
    """
    raw = np.asarray(raw, dtype=np.float64)
    return rigid(raw[..., 3:], raw[..., :3] * MM_PER_M)


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
