"""Kinematics of Universal Robots' six-joint arms: forward, inverse, Jacobian, singularities.

Frames follow the Denavit-Hartenberg (DH) convention with Universal Robots' published numbers:

    A_i = Rot_z(q_i) Trans_z(d_i) Trans_x(a_i) Rot_x(alpha_i),  alpha = (90, 0, 0, 90, -90, 0) deg

Frame 0 is the controller's base frame and frame 6 the flange, so that A_1 ... A_6 times the TCP
offset is the pose that the controller reports. The numbers are nominal: a real arm differs from
them by its factory calibration, by some tenths of a mm to a few mm at the flange.

The inverse is in closed form, with eight branches: the wrist centre (origin of frame 5) left or
right of the plane of axis 1, joint 5 positive or negative, joint 3 positive or negative. A
continuous motion that meets no singularity keeps its branch, so the joints along a path are one
column of :func:`inverse`, unwrapped. The singularities are where two branches meet:

    shoulder: the wrist centre lies d4 from axis 1;  wrist: sin q5 = 0;  elbow: sin q3 = 0

Lengths are mm, angles rad. Arrays may be batched in their leading axes. Numpy only: the processes
that hold the safety gate start without JAX and scipy.

Sources: Universal Robots, "DH Parameters for calculations of kinematics and dynamics" (support
article 45257); for UR16e, UR20 and UR30 also ur_description (ros-industrial/universal_robot). The
inverse is that of Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms"
(Georgia Tech, 2013), with arc tangents instead of arc cosines, which lose half of the digits near a
singularity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hw.runtime.errors import refused
from hw.runtime.rigid import rigid
from jaxcal.data.poses import inverse_poses
from jaxcal.runtime.array_types import Bool, Float, Int

ANGLE_MM = 100.0
"""A turn of one rad counts as this many mm in the Jacobian's singular values: about the distance
from the flange to the tip of a probe."""

BRANCHES = 8
_COS_ALPHA = np.array([0.0, 1.0, 1.0, 0.0, 0.0, 1.0])
_SIN_ALPHA = np.array([1.0, 0.0, 0.0, 1.0, -1.0, 0.0])
# Tolerance of the reach, relative to the links' lengths: far below a nanometre.
_REACH_TOLERANCE = 1e-12
# Below this sine of joint 5, joints 4 and 6 count as turning about the same axis.
_WRIST_TOLERANCE = 1e-12


@dataclass(frozen=True)
class ArmModel:
    """Dimensions of an arm, mm.

    Attributes:
        name: as Universal Robots calls it.
        d1: height of the shoulder above the base.
        a2: upper arm, negative by convention.
        a3: forearm, negative by convention.
        d4: offset of the wrist from the plane of axis 1.
        d5: from joint 4 to joint 5 along axis 5.
        d6: from joint 5 to the flange.
        elbow_mm: how far the elbow sticks out of the plane of axis 1, along axis 3.
        radius_mm: radius of the largest joint's housing, about.
        joint_speed_deg_s: largest speed of the slowest joint.
    """

    name: str
    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float
    elbow_mm: float
    radius_mm: float
    joint_speed_deg_s: float = 180.0

    @cached_property
    def a(self) -> Float[np.ndarray, " 6"]:
        """DH lengths a_1 ... a_6."""
        return np.array([0.0, self.a2, self.a3, 0.0, 0.0, 0.0])

    @cached_property
    def d(self) -> Float[np.ndarray, " 6"]:
        """DH offsets d_1 ... d_6."""
        return np.array([self.d1, 0.0, 0.0, self.d4, self.d5, self.d6])

    @cached_property
    def reach_mm(self) -> float:
        """No pose of the flange is further than this from the shoulder."""
        planar = abs(self.a2) + abs(self.a3) + self.d5
        return math.hypot(planar, self.d4) + self.d6

    @cached_property
    def levers_mm(self) -> Float[np.ndarray, " 6"]:
        """Bound of the flange's distance from a point on each joint's axis, in every pose."""
        wrist_2 = math.hypot(self.d5, self.d6)
        wrist_1 = self.d4 + wrist_2
        elbow = abs(self.a3) + wrist_1
        shoulder = abs(self.a2) + elbow
        return np.array([shoulder, shoulder, elbow, wrist_1, wrist_2, self.d6])

    @cached_property
    def jacobian_lipschitz_mm(self) -> float:
        """By how much the scaled Jacobian changes at most (spectral norm) per rad of joint motion.

        The derivative of column i by joint j is z_j x column i for j < i, else z_i x (z_j x r_j):
        at most the lever of the later of both joints, and ANGLE_MM for the angular part of j < i.
        The Frobenius norm of all of them bounds the spectral norm.
        """
        later = np.maximum.outer(np.arange(6), np.arange(6))
        linear = np.square(self.levers_mm[later]).sum()
        return math.sqrt(linear + 15 * ANGLE_MM**2)


MODELS = {
    model.name: model
    for model in (
        ArmModel("UR3", 151.9, -243.65, -213.25, 112.35, 85.35, 81.9, 119.8, 55.0),
        ArmModel("UR5", 89.159, -425.0, -392.25, 109.15, 94.65, 82.3, 135.85, 65.0),
        ArmModel("UR10", 127.3, -612.0, -572.3, 163.941, 115.7, 92.2, 220.941, 85.0, 120.0),
        ArmModel("UR3e", 151.85, -243.55, -213.2, 131.05, 85.35, 92.1, 120.0, 55.0),
        ArmModel("UR5e", 162.5, -425.0, -392.2, 133.3, 99.7, 99.6, 138.0, 65.0),
        ArmModel("UR10e", 180.7, -612.7, -571.55, 174.15, 119.85, 116.55, 176.2, 85.0, 120.0),
        ArmModel("UR16e", 180.7, -478.4, -360.0, 174.15, 119.85, 116.55, 176.2, 85.0, 120.0),
        ArmModel("UR20", 236.3, -862.0, -728.7, 201.0, 159.3, 154.3, 260.0, 110.0, 120.0),
        ArmModel("UR30", 236.3, -637.0, -503.7, 201.0, 159.3, 154.3, 260.0, 110.0, 120.0),
    )
}
"""The arms that are known. DH numbers are the maker's; the elbow's offset is ur_description's, and
the radii are ours, on the large side."""

JOINT_NAMES = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")


def model_named(name: str) -> ArmModel:
    """An arm by its name, in any case and with any spaces or dashes.

    Raises:
        RefusedError: no such arm.
    """
    wanted = "".join(letter for letter in name.lower() if letter.isalnum())
    for known, model in MODELS.items():
        if known.lower() == wanted:
            return model
    raise refused(f"no arm {name[:40]!r} is known; there are {', '.join(MODELS)}")


# Forward


def link_frames(
    model: ArmModel, joints: Float[np.ndarray, "*n 6"]
) -> Float[np.ndarray, "*n 7 4 4"]:
    """Frames 0 (base) to 6 (flange) in the base frame.

    Origins: 0 the base; 1 the shoulder, where the upper arm starts; 2 the elbow; 3 wrist 1; 4
    wrist 2; 5 wrist 3; 6 the flange.

    Args:
        model: whose dimensions.
        joints: rad.
    """
    joints = np.asarray(joints, dtype=np.float64)
    cosine, sine = np.cos(joints), np.sin(joints)
    step = np.zeros((*joints.shape, 4, 4))
    step[..., 0, 0], step[..., 1, 0] = cosine, sine
    step[..., 0, 1], step[..., 1, 1] = -sine * _COS_ALPHA, cosine * _COS_ALPHA
    step[..., 0, 2], step[..., 1, 2] = sine * _SIN_ALPHA, -cosine * _SIN_ALPHA
    step[..., 0, 3], step[..., 1, 3] = model.a * cosine, model.a * sine
    step[..., 2, 1], step[..., 2, 2], step[..., 2, 3] = _SIN_ALPHA, _COS_ALPHA, model.d
    step[..., 3, 3] = 1.0
    frames = np.zeros((*joints.shape[:-1], 7, 4, 4))
    frames[..., 0, :, :] = np.eye(4)
    for k in range(6):
        frames[..., k + 1, :, :] = frames[..., k, :, :] @ step[..., k, :, :]
    return frames


def forward(model: ArmModel, joints: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 4 4"]:
    """The flange in the base frame."""
    return link_frames(model, joints)[..., 6, :, :]


def joint_points(model: ArmModel, joints: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 6 3"]:
    """Centres of the moving joints: elbow (inner and outer side), wrists 1 to 3, flange; mm.

    Every link from the shoulder to the flange runs between two of these points, or from the
    shoulder to one. So a convex region that holds them and the shoulder holds all the links, but
    for the housings' radius.
    """
    frames = link_frames(model, joints)
    elbow, axis = frames[..., 2, :3, 3], frames[..., 2, :3, 2]
    sides = np.stack([elbow, elbow + model.elbow_mm * axis], axis=-2)
    return np.concatenate([sides, frames[..., 3:, :3, 3]], axis=-2)


POINT_NAMES = ("elbow", "elbow", "wrist 1", "wrist 2", "wrist 3", "flange")
"""Names of the points of :func:`joint_points`."""


def jacobian(model: ArmModel, joints: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 6 6"]:
    """Geometric Jacobian of the flange in the base frame.

    Returns:
        (..., 6, 6): rows 0-2 mm/rad of the flange's origin, rows 3-5 rad/rad.
    """
    frames = link_frames(model, joints)
    axes, origins = frames[..., :6, :3, 2], frames[..., :6, :3, 3]
    arms = frames[..., 6:, :3, 3] - origins
    return np.concatenate([np.cross(axes, arms), axes], axis=-1).swapaxes(-1, -2)


def scaled_jacobian(
    model: ArmModel, joints: Float[np.ndarray, "*n 6"]
) -> Float[np.ndarray, "*n 6 6"]:
    """:func:`jacobian` with its angular rows times :data:`ANGLE_MM`, so that all of it is mm."""
    matrix = jacobian(model, joints)
    matrix[..., 3:, :] *= ANGLE_MM
    return matrix


def dexterity_mm(model: ArmModel, joints: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n"]:
    """Smallest singular value of the scaled Jacobian, mm per rad; 0 in a singular pose.

    Its reciprocal is how far the joints must turn, at worst, to move the flange by a mm (Klein and
    Blaho 1987).
    """
    return np.asarray(np.linalg.svd(scaled_jacobian(model, joints), compute_uv=False)[..., -1])


def nearest_singularity(model: ArmModel, joints: Float[np.ndarray, " 6"]) -> str:
    """Which singularity is nearest, as words for a person."""
    frames = link_frames(model, joints)
    wrist = frames[5, :3, 3]
    away = math.hypot(wrist[0], wrist[1])
    # Each is the sine of the angle left to the singular pose.
    shoulder = math.sqrt(max(away**2 - model.d4**2, 0.0)) / abs(model.a2 + model.a3)
    elbow, turn = abs(math.sin(joints[2])), abs(math.sin(joints[4]))
    if shoulder <= min(elbow, turn):
        return f"shoulder: the wrist is {away:.0f} mm from axis 1, at least {model.d4:.0f} needed"
    if turn <= elbow:
        return f"wrist: joint 5 at {math.degrees(joints[4]):.1f} deg"
    return f"elbow: joint 3 at {math.degrees(joints[2]):.1f} deg"


# Inverse


@dataclass(frozen=True)
class Solutions:
    """All branches of the inverse.

    Attributes:
        joints: (..., 8, 6) rad in (-pi, pi]; NaN where the branch does not reach the pose.
        reached: (..., 8) whether it does.
    """

    joints: Float[np.ndarray, "*n 8 6"]
    reached: Bool[np.ndarray, "*n 8"]


_SHOULDER, _WRIST, _ELBOW = (
    np.array([1.0 if branch >> shift & 1 == 0 else -1.0 for branch in range(BRANCHES)])
    for shift in (2, 1, 0)
)
"""Signs of each branch; its number is 4 (shoulder < 0) + 2 (wrist < 0) + (elbow < 0)."""


def branch_name(branch: int) -> str:
    """A branch in words."""
    signs = ("+" if sign[branch] > 0 else "-" for sign in (_SHOULDER, _ELBOW, _WRIST))
    return "shoulder {}, elbow {}, wrist {}".format(*signs)


def inverse(
    model: ArmModel, flange: Float[np.ndarray, "*n 4 4"], joint_6: float = 0.0
) -> Solutions:
    """Joints that bring the flange to a pose.

    Args:
        model: whose dimensions.
        flange: in the base frame, mm.
        joint_6: angle to take for joint 6 in a wrist singularity, where joints 4 and 6 turn about
            the same axis and any angle will do.
    """
    flange = np.asarray(flange, dtype=np.float64)[..., None, :, :]
    rotation, position = flange[..., :3, :3], flange[..., :3, 3]

    # Joint 1: the wrist centre is d4 away from the plane through axis 1 in which the arm bends.
    centre = position - model.d6 * rotation[..., 2]
    away = np.hypot(centre[..., 0], centre[..., 1])
    inside = away**2 - model.d4**2
    reached = inside >= -_REACH_TOLERANCE * model.d4**2
    along = np.sqrt(np.maximum(inside, 0.0))
    q1 = (
        np.arctan2(centre[..., 1], centre[..., 0])
        + _SHOULDER * np.arctan2(along, model.d4)
        + math.pi / 2
    )
    sine, cosine = np.sin(q1), np.cos(q1)

    # Joint 5 is the angle between axis 2 (the plane's normal) and axis 6; joint 6 is the direction
    # of axis 2 in the flange's frame.
    across = rotation[..., 0, :] * sine[..., None] - rotation[..., 1, :] * cosine[..., None]
    sine5 = np.hypot(across[..., 0], across[..., 1])
    q5 = _WRIST * np.arctan2(sine5, across[..., 2])
    turning = sine5 > _WRIST_TOLERANCE
    free = np.arctan2(-_WRIST * across[..., 1], _WRIST * across[..., 0])
    q6 = np.where(turning, free, joint_6)

    # Frame 4 in frame 1: the two links in their plane, and the sum of joints 2 to 4.
    c5, s5, c6, s6 = np.cos(q5), np.sin(q5), np.cos(q6), np.sin(q6)
    x6, y6, z6 = (np.broadcast_to(rotation[..., k], (*q1.shape, 3)) for k in range(3))
    # Axis 5 (z of frame 4) is minus the y axis of frame 5.
    y5 = x6 * s6[..., None] + y6 * c6[..., None]
    x5 = x6 * c6[..., None] - y6 * s6[..., None]
    x4 = x5 * c5[..., None] - z6 * s5[..., None]
    origin4 = centre + model.d5 * y5
    total = np.arctan2(x4[..., 2], x4[..., 0] * cosine + x4[..., 1] * sine)
    px = origin4[..., 0] * cosine + origin4[..., 1] * sine
    py = origin4[..., 2] - model.d1

    # Joints 2 and 3: two links in a plane.
    upper, fore = model.a2, model.a3
    bend = (px**2 + py**2 - upper**2 - fore**2) / (2 * upper * fore)
    reached = reached & (np.abs(bend) <= 1 + _REACH_TOLERANCE)
    bend = np.clip(bend, -1.0, 1.0)
    s3 = _ELBOW * np.sqrt((1 - bend) * (1 + bend))
    q3 = np.arctan2(s3, bend)
    q2 = np.arctan2(py, px) - np.arctan2(fore * s3, upper + fore * bend)
    joints = np.stack(np.broadcast_arrays(q1, q2, q3, total - q2 - q3, q5, q6), axis=-1)
    joints = wrapped(joints)
    return Solutions(np.where(reached[..., None], joints, np.nan), reached)


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Angles in (-pi, pi]."""
    return math.pi - np.mod(math.pi - angles, 2 * math.pi)


def nearest_turn(joints: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The same pose with every joint within half a turn of a reference."""
    return reference + wrapped(joints - reference)


def branch_of(model: ArmModel, joints: Float[np.ndarray, "*n 6"]) -> Int[np.ndarray, "*n"]:
    """Which branch of :func:`inverse` the joints belong to."""
    joints = np.asarray(joints, dtype=np.float64)
    centre = link_frames(model, joints)[..., 5, :3, 3]
    # Position of the wrist centre along the arm's plane, which joint 1 turns.
    along = centre[..., 0] * np.cos(joints[..., 0]) + centre[..., 1] * np.sin(joints[..., 0])
    negative = [along > 0, np.sin(joints[..., 4]) < 0, np.sin(joints[..., 2]) < 0]
    return np.asarray(np.array([4, 2, 1]) @ np.array(negative, dtype=int).reshape(3, -1)).reshape(
        along.shape
    )


def nearest(
    model: ArmModel, flange: Float[np.ndarray, "4 4"], reference: Float[np.ndarray, " 6"]
) -> Float[np.ndarray, " 6"] | None:
    """The joints nearest to a reference that bring the flange to a pose; None where none do.

    In a wrist singularity joint 6 keeps its reference.
    """
    reference = np.asarray(reference, dtype=np.float64)
    found = inverse(model, flange, joint_6=float(reference[5]))
    if not found.reached.any():
        return None
    joints = nearest_turn(found.joints[found.reached], reference)
    return joints[np.argmin(np.abs(joints - reference).max(axis=1))]


def flange_of(
    pose: Float[np.ndarray, "*n 4 4"], tcp_offset: tuple[float, ...]
) -> Float[np.ndarray, "*n 4 4"]:
    """Pose of the flange from that of the TCP (mm); ``tcp_offset`` is the controller's (m, rad)."""
    return pose @ inverse_poses(tool_of(tcp_offset))


def tool_of(tcp_offset: tuple[float, ...]) -> Float[np.ndarray, "4 4"]:
    """A TCP offset (m, rad) as a transform TCP -> flange, mm."""
    offset = np.asarray(tcp_offset, dtype=np.float64)
    return rigid(offset[3:], 1000.0 * offset[:3])
