"""Motions of the emulated arm: path, speed, joints, and where a real controller would stop them.

The inverse kinematics of a motion's path is computed once, when the motion begins, in the branch of
its first joints; between the samples the joints are interpolated. A controller makes a protective
stop where a joint would turn faster than it can, where its range ends, and near a singularity; the
emulated controller does so early enough to rest before that place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hw.robot.kinematics import (
    ANGLE_MM,
    ArmModel,
    branch_of,
    dexterity_mm,
    flange_of,
    inverse,
    joint_points,
    nearest_turn,
)
from hw.runtime.rigid import rigid, ur_to_pose
from jaxcal.data.poses import rotations_from_quaternions
from jaxcal.runtime.array_types import Float

LEAST_DEXTERITY_MM = 1.0
"""Smallest singular value (mm per rad, :func:`hw.robot.kinematics.dexterity_mm`) at which the
emulated controller moves the tool along a line: about a degree from a wrist singularity."""
_RANGE = 2 * math.pi
_SPACING_MM = 4.0
_MOST_SAMPLES = 500


Vector = tuple[float, ...]


@dataclass(frozen=True)
class Motion:
    """A path and the profile over it; the arm's state at any time follows from it."""

    start: float
    """Bench time (s) at which the profile starts."""
    position: Vector
    quaternion: Vector
    travel: Vector
    """Displacement (m) from the path's start to its end."""
    turn: Vector
    """Rotation vector (rad), in the base frame, from the path's start to its end."""
    length: float
    """Path length: metres, or radians where that is more."""
    speed: float
    acceleration: float
    first: float = 0.0
    """Path parameter (m or rad) at which the profile starts."""
    brake: bool = False
    error: tuple[Vector, Vector] = ((0.0,) * 6, (0.0,) * 6)
    planned_tcp: Vector = (0.0,) * 6
    """TCP offset (m, rad) whose path it is."""
    tcp: Vector = (0.0,) * 6
    """TCP offset (m, rad) that is reported."""

    def duration(self) -> float:
        """Bench seconds from its start until the arm rests."""
        if self.brake:
            return self.speed / self.acceleration
        if self.length <= 0:
            return 0.0
        if self.speed**2 >= self.length * self.acceleration:
            return 2 * math.sqrt(self.length / self.acceleration)
        return self.length / self.speed + self.speed / self.acceleration

    def at(self, t: float) -> tuple[float, float]:
        """Path parameter and its rate at bench time t."""
        passed, total = t - self.start, self.duration()
        if passed <= 0:
            return self.first, 0.0
        if self.brake:
            passed = min(passed, total)
            rate = max(0.0, self.speed - self.acceleration * passed)
            return self.first + passed * (self.speed + rate) / 2, rate
        if passed >= total:
            return self.length, 0.0
        peak = min(self.speed, math.sqrt(self.length * self.acceleration))
        ramp = peak / self.acceleration
        if passed < ramp:
            return self.acceleration * passed**2 / 2, self.acceleration * passed
        if passed > total - ramp:
            left = total - passed
            return self.length - self.acceleration * left**2 / 2, self.acceleration * left
        return peak * (passed - ramp / 2), peak


def first_joints(
    model: ArmModel, raw: tuple[float, ...], tcp_offset: tuple[float, ...]
) -> Float[np.ndarray, " 6"]:
    """Joints of an arm at its first pose: elbow up where possible, far from singularities.

    Raises:
        ValueError: out of reach.
    """
    found = inverse(model, flange_of(ur_to_pose(np.array(raw)), tcp_offset))
    if not found.reached.any():
        raise ValueError(f"a {model.name} does not reach the pose {raw} (m, rad)")
    joints = found.joints[found.reached]
    height = joint_points(model, joints)[:, :, 2]
    score = dexterity_mm(model, joints) + np.where(height[:, 0] > height[:, 2], 1000.0, 0.0)
    return joints[int(np.argmax(score))]


@dataclass(frozen=True, eq=False)
class JointTrack:
    """Joints along the path of one motion.

    Attributes:
        motion: whose path it is.
        places: (n,) path parameter of each sample, m or rad as the motion counts.
        joints: (n, 6) at each sample, rad.
        end: path parameter beyond which the arm cannot follow; infinite where it can to the end.
    """

    motion: Motion
    places: Float[np.ndarray, " n"]
    joints: Float[np.ndarray, "n 6"]
    end: float

    def at(self, place: float) -> Float[np.ndarray, " 6"]:
        """Joints at a path parameter, rad."""
        k = int(np.searchsorted(self.places, place))
        if k == 0:
            return self.joints[0]
        if k == len(self.places):
            return self.joints[-1]
        low, high = self.places[k - 1], self.places[k]
        part = (place - low) / (high - low)
        return (1 - part) * self.joints[k - 1] + part * self.joints[k]

    def slope(self, place: float) -> Float[np.ndarray, " 6"]:
        """Derivative of the joints by the path parameter at a place."""
        if len(self.places) < 2:
            return np.zeros(6)
        k = min(max(int(np.searchsorted(self.places, place)), 1), len(self.places) - 1)
        step = self.places[k] - self.places[k - 1]
        return (self.joints[k] - self.joints[k - 1]) / step

    def same_path(self, motion: Motion) -> bool:
        """Whether another motion (a brake) runs along the same path."""
        mine = self.motion
        return (mine.position, mine.quaternion, mine.travel, mine.turn) == (
            motion.position,
            motion.quaternion,
            motion.travel,
            motion.turn,
        )


def track(
    model: ArmModel, motion: Motion, tcp_offset: tuple[float, ...], start: Float[np.ndarray, " 6"]
) -> JointTrack:
    """Joints along a motion that begins at given joints."""
    travel, turn = np.array(motion.travel), np.array(motion.turn)
    length = math.hypot(
        1000 * float(np.linalg.norm(travel)), ANGLE_MM * float(np.linalg.norm(turn))
    )
    if length == 0.0 or motion.length == 0.0:
        return JointTrack(motion, np.zeros(1), start[None], math.inf)
    parts = np.linspace(0.0, 1.0, min(2 + math.ceil(length / _SPACING_MM), _MOST_SAMPLES))
    way = rigid(parts[:, None] * turn, 1000 * (np.array(motion.position) + parts[:, None] * travel))
    way[:, :3, :3] @= rotations_from_quaternions(np.array([motion.quaternion]), "wxyz")[0]
    found = inverse(model, flange_of(way, tcp_offset), joint_6=float(start[5]))
    branch = int(branch_of(model, start))
    good, joints = found.reached[:, branch], found.joints[:, branch]
    # Samples from the first one out of reach on are left out.
    count = len(parts) if good.all() else int(np.argmin(good))
    joints = joints[: max(count, 1)]
    if count == 0:
        return JointTrack(motion, np.zeros(1), start[None], 0.0)
    joints = np.unwrap(joints, axis=0)
    joints += nearest_turn(joints[0], start) - joints[0]
    places = parts[:count] * motion.length
    # A real arm stops near a singularity, at a joint's limit, and where a joint would be too fast.
    dexterity = dexterity_mm(model, joints)
    wrong = (np.abs(joints) > _RANGE).any(axis=1)
    # It may move away from a singularity.
    wrong |= (dexterity < LEAST_DEXTERITY_MM) & (np.gradient(dexterity) <= 0 if count > 1 else True)
    steps = np.abs(np.diff(joints, axis=0)).max(axis=1) / np.diff(places)
    peak = min(motion.speed, math.sqrt(motion.length * motion.acceleration))
    wrong[1:] |= steps * peak > math.radians(model.joint_speed_deg_s)
    if wrong.any():
        end = float(places[max(int(np.argmax(wrong)) - 1, 0)])
    else:
        end = math.inf if count == len(parts) else float(places[-1])
    return JointTrack(motion, places, joints, end)
