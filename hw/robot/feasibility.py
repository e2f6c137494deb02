"""Whether an arm can follow a plan: reach, joint limits and speeds, singularities, the links' box.

A way between two poses is sampled, and what holds at the samples is shown to hold between them. Let
sigma be the smallest singular value of the scaled Jacobian J at a sample and u = |J^-1 V| the
joints' speed there, V the flange's twist along the way. J changes by at most K per rad
(:attr:`hw.robot.kinematics.ArmModel.jacobian_lipschitz_mm`), so within a distance r of the sample,
in joint space, sigma is at least sigma - K r and the joints' speed at most u / (1 - K r / sigma).
Integrated over h, half the distance between two samples, this gives

    sigma between the samples >= sigma sqrt(1 - 2 K u h / sigma).

Samples are added until the right side is at least half of the least value that is allowed. Then no
singularity lies between the samples, the branch stays the same, and the joints run continuously.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hw.robot.kinematics import (
    ANGLE_MM,
    BRANCHES,
    JOINT_NAMES,
    POINT_NAMES,
    ArmModel,
    branch_name,
    branch_of,
    dexterity_mm,
    flange_of,
    inverse,
    joint_points,
    nearest_singularity,
    nearest_turn,
    scaled_jacobian,
    tool_of,
)
from hw.runtime.errors import RefusedError, refused
from hw.runtime.rigid import straight_way
from jaxcal.data.poses import vectors_from_rotations
from jaxcal.runtime.array_types import Float

_COARSE_MM = 20.0
"""First distance between samples, of the flange and ANGLE_MM per rad."""
_MOST_SAMPLES = 20_000
_PROVEN = 0.5
"""Between the samples, sigma is shown to be at least this share of what is required at them."""
_MODEL_DEG = 3.0
"""If the controller's joints differ by more than this from those that the model gives for its pose,
the arm is another one. The factory calibration accounts for tenths of a degree."""


@dataclass(frozen=True)
class Arm:
    """An arm with its tool, and the bounds of its joints and links.

    Attributes:
        model: its dimensions.
        tcp_offset: (6,) of the controller, m and rotation vector (rad).
        joint_min: (6,) rad.
        joint_max: (6,) rad.
        least_dexterity_mm: smallest singular value of the scaled Jacobian, mm per rad.
        joint_speed: largest speed of any joint, rad/s.
        box_min_mm: (3,) lowest corner of the box for elbow, wrists and flange.
        box_max_mm: (3,) highest corner of that box.
    """

    model: ArmModel
    tcp_offset: tuple[float, ...]
    joint_min: Float[np.ndarray, " 6"]
    joint_max: Float[np.ndarray, " 6"]
    least_dexterity_mm: float
    joint_speed: float
    box_min_mm: Float[np.ndarray, " 3"]
    box_max_mm: Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class Course:
    """How an arm follows a plan.

    Attributes:
        branch: of the inverse kinematics, the same all along.
        joints: (n, 6) at each pose, rad.
        dexterity_mm: least along the plan, at the samples.
        joint_speed: largest of any joint on any way, rad/s; 0 where no duration was given.
    """

    branch: int
    joints: Float[np.ndarray, "n 6"]
    dexterity_mm: float
    joint_speed: float

    @property
    def text(self) -> str:
        """One line for a person."""
        low, high = np.degrees(self.joints.min(axis=0)), np.degrees(self.joints.max(axis=0))
        ranges = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in zip(low, high, strict=True))
        return (
            f"branch {branch_name(self.branch)}; joints {ranges} deg; smallest singular value "
            f"{self.dexterity_mm:.0f} mm/rad, fastest joint "
            f"{math.degrees(self.joint_speed):.0f} deg/s"
        )


def check_model(arm: Arm, pose: Float[np.ndarray, "4 4"], joints: Float[np.ndarray, " 6"]) -> None:
    """Whether the controller's joints and TCP pose fit the arm's model and TCP offset.

    Raises:
        RefusedError: they do not: another model, or another offset.
    """
    branch = int(branch_of(arm.model, joints))
    found = inverse(arm.model, flange_of(pose, arm.tcp_offset))
    wanted = nearest_turn(found.joints[branch], joints)
    off = np.degrees(np.abs(wanted - joints).max()) if found.reached[branch] else math.inf
    if not off <= _MODEL_DEG:
        text = f"by {off:.1f} deg" if math.isfinite(off) else "at all"
        raise refused(
            f"the controller's joints and pose do not fit a {arm.model.name} ({text}): is the "
            "arm's model, or the TCP offset, another?"
        )


def follow(
    arm: Arm,
    start: Float[np.ndarray, "4 4"],
    goal: Float[np.ndarray, "4 4"],
    joints: Float[np.ndarray, " 6"],
    what: str,
    duration_s: float | None = None,
) -> Course:
    """The arm along a straight motion of its TCP, from given joints.

    Args:
        arm: the arm and its bounds.
        start: pose of the TCP at the start, mm.
        goal: pose of the TCP at the end, mm.
        joints: at the start, rad; they decide the branch.
        what: the motion, for the error.
        duration_s: seconds at full speed, for the joints' speed; None: not checked.

    Raises:
        RefusedError: a pose out of reach, a joint limit, a singularity, a joint too fast, or a link
            out of its box; the text says where on the way.
    """
    branch = int(branch_of(arm.model, joints))
    turn = vectors_from_rotations(goal[:3, :3] @ start[:3, :3].T)
    travel = goal[:3, 3] - start[:3, 3]
    angle = float(np.linalg.norm(turn))
    lever_mm = float(np.linalg.norm(tool_of(arm.tcp_offset)[:3, 3]))
    # A bound of the flange's path: the TCP's line plus the arc about the TCP.
    length = math.hypot(float(np.linalg.norm(travel)) + angle * lever_mm, angle * ANGLE_MM)
    moving = length > 1e-9
    count = 1 + math.ceil(length / _COARSE_MM) if moving else 1
    while True:
        parts = np.linspace(0.0, 1.0, count)
        way = straight_way(start, goal, parts)
        path = _joints_along(arm, way, branch, joints, what, parts)
        matrix = scaled_jacobian(arm.model, path)
        dexterity = np.linalg.svd(matrix, compute_uv=False)[:, -1]
        _check_dexterity(arm, path, dexterity, what, parts)
        rates = np.zeros_like(path)
        if not moving:
            break
        twist = _twists(arm, way, travel, turn)
        rates = np.linalg.solve(matrix, twist[..., None])[..., 0]
        half = 0.5 / (count - 1)
        # The twist changes as the lever turns: between the samples by at most this much.
        bend = angle**2 * lever_mm * half
        enough = _half_distance(arm, dexterity, np.linalg.norm(rates, axis=1) + bend / dexterity)
        if half <= enough.min():
            break
        # The bend shrinks with the distance, and new samples may be nearer to a singularity.
        count = max(count + 1, min(2 + math.ceil(0.55 / float(enough.min())), 8 * count))
        if count > _MOST_SAMPLES:
            where = int(np.argmin(enough))
            raise refused(
                f"{what} passes too near a singularity of the arm ({_share(parts[where])}; "
                f"{nearest_singularity(arm.model, path[where])})"
            )
    fastest = _check_speed(arm, rates, duration_s, what, parts)
    _check_links(arm, path, what, parts)
    return Course(branch, path[[0, -1]], float(dexterity.min()), fastest)


def _twists(
    arm: Arm,
    way: Float[np.ndarray, "n 4 4"],
    travel: Float[np.ndarray, " 3"],
    turn: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "n 6"]:
    """V of the module's head: the flange's velocity, mm, and ANGLE_MM times its turn, per way."""
    tool = tool_of(arm.tcp_offset)
    to_flange = way[:, :3, :3] @ -(tool[:3, :3].T @ tool[:3, 3])
    velocity = travel + np.cross(turn, to_flange)
    return np.concatenate([velocity, np.tile(turn * ANGLE_MM, (len(way), 1))], axis=1)


def _half_distance(
    arm: Arm, dexterity: Float[np.ndarray, " n"], speed: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """The largest h of the module's head for which sigma is shown to be large enough."""
    proven = 1 - (_PROVEN * arm.least_dexterity_mm / dexterity) ** 2
    return proven * dexterity / (2 * arm.model.jacobian_lipschitz_mm * speed)


def follow_all(
    arm: Arm,
    poses: Float[np.ndarray, "n 4 4"],
    durations_s: Float[np.ndarray, " m"],
    joints: Float[np.ndarray, " 6"] | None = None,
) -> Course:
    """The arm along a plan, from pose to pose.

    Args:
        arm: the arm and its bounds.
        poses: of the TCP, mm.
        durations_s: (n - 1,) seconds of each way at full speed.
        joints: the arm's, rad, which decide the branch; None: of the branches that can follow the
            whole plan, the one whose poses keep furthest from singularities.

    Raises:
        RefusedError: the first pose or way that the arm cannot take, and why; without ``joints``,
            for the branch that gets furthest.
    """
    if joints is not None:
        check = [int(branch_of(arm.model, joints))]
        reference = np.asarray(joints, dtype=np.float64)
    else:
        check = list(range(BRANCHES))
        reference = np.clip(np.zeros(6), arm.joint_min, arm.joint_max)
    found = inverse(arm.model, flange_of(poses, arm.tcp_offset))
    worst = np.zeros(BRANCHES)
    for branch in check:
        if found.reached[:, branch].all():
            worst[branch] = dexterity_mm(arm.model, found.joints[:, branch]).min()
    furthest, failure = -1, None
    for branch in sorted(check, key=lambda branch: -worst[branch]):
        stage, outcome = _follow_branch(arm, poses, durations_s, found.joints[0, branch], reference)
        if isinstance(outcome, Course):
            return outcome
        if stage > furthest:
            furthest, failure = stage, outcome
    assert failure is not None
    if joints is not None:
        stands = ", ".join(f"{angle:.0f}" for angle in np.degrees(reference))
        raise refused(
            f"{failure.args[0]}; that is from where the arm stands now (joints at {stands} deg): "
            "turn a joint that is wound up back by hand, or take other poses (--seed)"
        )
    raise refused(f"{failure.args[0]}; no other branch of the arm's joints gets further")


def _follow_branch(
    arm: Arm,
    poses: Float[np.ndarray, "n 4 4"],
    durations_s: Float[np.ndarray, " m"],
    first: Float[np.ndarray, " 6"],
    reference: Float[np.ndarray, " 6"],
) -> tuple[int, Course | RefusedError]:
    """Index of the last pose tried in a branch, and the course or why it ends there."""
    stage = 0
    try:
        if np.isnan(first).any():
            raise refused(f"pose 1 of the plan is out of the reach of a {arm.model.name}")
        here = follow(arm, poses[0], poses[0], nearest_turn(first, reference), "pose 1 of the plan")
        path, dexterity, speed = [here.joints[-1]], here.dexterity_mm, 0.0
        for stage in range(1, len(poses)):
            at = f"pose {stage + 1} of the plan"
            flange = flange_of(poses[stage], arm.tcp_offset)
            if not inverse(arm.model, flange).reached[here.branch]:
                raise refused(f"{at} is out of the reach of a {arm.model.name}")
            what = f"the way from pose {stage} to pose {stage + 1}"
            duration = float(durations_s[stage - 1])
            course = follow(arm, poses[stage - 1], poses[stage], path[-1], what, duration)
            path.append(course.joints[-1])
            dexterity = min(dexterity, course.dexterity_mm)
            speed = max(speed, course.joint_speed)
    except RefusedError as error:
        return stage, error
    return stage, Course(here.branch, np.array(path), dexterity, speed)


def _share(part: float) -> str:
    return f"at {100 * part:.0f} % of the way" if part > 0 else "at its start"


def _joints_along(
    arm: Arm,
    way: Float[np.ndarray, "n 4 4"],
    branch: int,
    joints: Float[np.ndarray, " 6"],
    what: str,
    parts: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 6"]:
    """Joints along a way, unwrapped and within their limits."""
    found = inverse(arm.model, flange_of(way, arm.tcp_offset))
    path, reached = found.joints[:, branch], found.reached[:, branch]
    if not reached.all():
        where = parts[int(np.argmin(reached))]
        raise refused(f"{what} is out of the reach of a {arm.model.name} ({_share(where)})")
    path = np.unwrap(path, axis=0)
    path += nearest_turn(path[0], joints) - path[0]
    room = np.minimum(path - arm.joint_min, arm.joint_max - path)
    if not room.min() >= 0.0:
        where, joint = np.unravel_index(int(np.argmin(room)), room.shape)
        raise refused(
            f"{what} turns joint {joint + 1} ({JOINT_NAMES[joint]}) to "
            f"{math.degrees(path[where, joint]):.1f} deg, over its limits of "
            f"{math.degrees(arm.joint_min[joint]):g} to {math.degrees(arm.joint_max[joint]):g} deg "
            f"({_share(parts[where])})"
        )
    return path


def _check_dexterity(
    arm: Arm,
    path: Float[np.ndarray, "n 6"],
    dexterity: Float[np.ndarray, " n"],
    what: str,
    parts: Float[np.ndarray, " n"],
) -> None:
    where = int(np.argmin(dexterity))
    if not dexterity[where] >= arm.least_dexterity_mm:
        raise refused(
            f"{what} comes too near a singularity of the arm ({_share(parts[where])}; "
            f"{nearest_singularity(arm.model, path[where])}): smallest singular value "
            f"{dexterity[where]:.1f} mm/rad, at least {arm.least_dexterity_mm:g}"
        )


def _check_speed(
    arm: Arm,
    rates: Float[np.ndarray, "n 6"],
    duration_s: float | None,
    what: str,
    parts: Float[np.ndarray, " n"],
) -> float:
    """Largest speed of any joint, rad/s."""
    if duration_s is None or not duration_s > 0:
        return 0.0
    speeds = np.abs(rates) / duration_s
    fastest = float(np.max(speeds))
    if not fastest <= arm.joint_speed:
        # Base and wrist 3 often turn alike: not rounding, but the order decides which is named.
        first = int(np.argmax(~(speeds < (1 - 1e-6) * fastest)))
        where, joint = np.unravel_index(first, speeds.shape)
        raise refused(
            f"{what} turns joint {joint + 1} ({JOINT_NAMES[joint]}) at "
            f"{math.degrees(fastest):.0f} deg/s, over the cap of "
            f"{math.degrees(arm.joint_speed):g} deg/s ({_share(parts[where])}): lower the speed"
        )
    return fastest


def _check_links(
    arm: Arm, path: Float[np.ndarray, "n 6"], what: str, parts: Float[np.ndarray, " n"]
) -> None:
    """Whether elbow, wrists and flange with their housings stay in the arm's box.

    Links run straight between these points, so the box, which is convex, holds those links too (the
    upper arm only where it holds the shoulder, which is not checked). Between two samples a point
    may be off by its largest motion from one sample to the next.
    """
    points = joint_points(arm.model, path)
    margin = np.full(points.shape[:2], arm.model.radius_mm)
    if len(path) > 1:
        margin = margin + np.linalg.norm(np.diff(points, axis=0), axis=-1).max(axis=0)
    room = np.minimum(points - arm.box_min_mm, arm.box_max_mm - points) - margin[..., None]
    if not room.min() >= 0.0:
        where, point, axis = np.unravel_index(int(np.argmin(room)), room.shape)
        raise refused(
            f"{what} takes the arm's {POINT_NAMES[point]} {-room.min():.0f} mm out of the arm's "
            f"box along {'xyz'[axis]} ({_share(parts[where])})"
        )
