"""Whether poses, and the ways between them, are within the limits.

The box bounds the probe: its tip and the hull of its array face and housing. Between start and
target the tool centre point (TCP) runs along a line while it turns about a fixed axis; every other
point runs along an arc, so the whole path is checked, not only its ends. Where the arm's model is
known, its joints, singularities and links are checked along the same path
(:mod:`hw.robot.feasibility`).
"""

from __future__ import annotations

import math

import numpy as np

from hw.robot.feasibility import Course, follow_all
from hw.robot.kinematics import tool_of
from hw.robot.limits import Limits
from hw.robot.motion_plan import MotionPlan, array_of
from hw.runtime.errors import refused
from hw.runtime.rigid import straight_way, turn_deg
from jaxcal.data.poses import inverse_poses

_ROTATION_TOLERANCE = 1e-6
_POSITION_TOLERANCE_MM = 1e-6
_TURN_TOLERANCE_DEG = 1e-3
_PATH_STEP_DEG = 0.25


def check_plan(plan: MotionPlan) -> Course | None:
    """Whether every pose of a plan, and the way from each to the next, is within its limits.

    Returns:
        How the arm follows the plan; None where its model is not known, so that reach, joints and
        singularities were not checked.

    Raises:
        RefusedError: the first pose that is not, and why.
    """
    previous, durations = None, []
    _check_box_in_reach(plan)
    for k, target in enumerate(plan.targets, start=1):
        pose = checked_pose(target, f"pose {k} of the plan")
        check_path(plan, pose, pose, f"pose {k} of the plan")
        if previous is not None:
            what = f"the way from pose {k - 1} to pose {k}"
            check_path(plan, previous, pose, what, reserve=True)
            length, velocity = pace(previous, pose, plan.limits, plan.limits.max_speed_mm_s)
            durations.append(length / velocity)
        previous = pose
    if plan.arm is None:
        return None
    joints = None if plan.joints is None else np.asarray(plan.joints)
    return follow_all(plan.arm, plan.targets, np.array(durations), joints)


def _check_box_in_reach(plan: MotionPlan) -> None:
    """Refuse a box that the arm can never leave: it bounds nothing."""
    if plan.arm is None:
        return
    model, limits = plan.arm.model, plan.limits
    tool = 1000.0 * math.hypot(*plan.tcp_offset[:3])
    tip = float(np.linalg.norm(limits.probe_points, axis=1).max())
    reach = model.reach_mm + model.d1 + tool + tip
    furthest = max(map(abs, limits.box_min_mm + limits.box_max_mm))
    if furthest > reach:
        raise refused(
            f"the box goes to {furthest:g} mm from the base, but a {model.name} with this tool "
            f"reaches {reach:.0f} mm at most: bound the box by what the probe may touch"
        )


def check_path(
    plan: MotionPlan, start: np.ndarray, goal: np.ndarray, what: str, *, reserve: bool = False
) -> None:
    """Check step, turn, boxes and cone along a motion.

    ``reserve`` leaves room, in step and turn, for a motion that starts anywhere in the start's
    search envelope.
    """
    limits = plan.limits
    tip = np.asarray(limits.tip_mm)
    travel = goal[:3, 3] - start[:3, 3]
    tip_travel = travel + (goal[:3, :3] - start[:3, :3]) @ tip
    step = max(float(np.linalg.norm(travel)), float(np.linalg.norm(tip_travel)))
    turn = turn_deg(start, goal)
    if not step + reserve * limits.search_mm <= limits.max_step_mm + _POSITION_TOLERANCE_MM:
        raise refused(f"{what} is {step:.3f} mm long, over the cap of {limits.max_step_mm:g} mm")
    if not turn + reserve * limits.search_deg <= limits.max_turn_deg + _TURN_TOLERANCE_DEG:
        raise refused(f"{what} turns {turn:.3f} deg, over the cap of {limits.max_turn_deg:g} deg")

    count = 2 + math.ceil(turn / _PATH_STEP_DEG)
    way = straight_way(start, goal, np.linspace(0.0, 1.0, count))
    spread = math.radians(turn) / (count - 1)
    probe = limits.probe_points
    names = ["the probe's tip"] + ["a corner of the probe"] * len(limits.hull_mm)
    _check_box(way, spread, probe, names, limits.box_min_mm, limits.box_max_mm, f"{what} takes", "")
    flange = inverse_poses(tool_of(plan.tcp_offset))[:3, 3]
    _check_box(
        way,
        spread,
        np.array([np.zeros(3), flange]),
        ["the TCP", "the flange"],
        limits.arm_box_min_mm,
        limits.arm_box_max_mm,
        f"{what} takes",
        "arm's ",
    )
    cosine = way[:, :3, 2] @ np.asarray(limits.cone_axis) / math.hypot(*limits.cone_axis)
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)).max()))
    if not angle <= limits.cone_deg + _TURN_TOLERANCE_DEG:
        raise refused(f"{what} tilts the tool {angle:.2f} deg, over {limits.cone_deg:g} deg")


def _check_box(
    way: np.ndarray,
    spread: float,
    points: np.ndarray,
    names: list[str],
    low: object,
    high: object,
    what: str,
    whose: str,
) -> None:
    """Check that points of the tool stay in a box along a way with samples ``spread`` rad apart.

    A point at a distance a (mm) from the TCP runs along a line plus an arc about the TCP. Linear
    interpolation of the arc is off by at most a spread^2 / 8 (the second derivative is a spread^2).
    A box is convex, so points that are inside by this margin at the samples are inside in between.
    """
    places = np.einsum("nij,pj->npi", way[:, :3, :3], points) + way[:, None, :3, 3]
    sag = np.linalg.norm(points, axis=1) * spread**2 / 8.0
    room = np.minimum(places - np.asarray(low), np.asarray(high) - places)
    room = (room - sag[:, None]).min(axis=0)
    if not room.min() >= -_POSITION_TOLERANCE_MM:
        point, axis = np.unravel_index(int(room.argmin()), room.shape)
        raise refused(
            f"{what} {names[point]} {-room.min():.3f} mm out of the {whose}box along {'xyz'[axis]}"
        )


def out_of_box_mm(pose: np.ndarray, limits: Limits) -> float:
    """By how much the probe at a pose is out of the box, mm; negative inside."""
    points = limits.probe_points @ pose[:3, :3].T + pose[:3, 3]
    low, high = np.asarray(limits.box_min_mm), np.asarray(limits.box_max_mm)
    return float(np.maximum(low - points, points - high).max())


def pace(
    start: np.ndarray, goal: np.ndarray, limits: Limits, speed_mm_s: float
) -> tuple[float, float]:
    """Length of a motion as the controller counts it, and its speed (m and m/s, or rad and rad/s).

    Where a motion is mostly a turn, the controller takes the speed as rad/s instead of m/s. The cap
    holds for the tip as well as for the TCP.
    """
    distance = float(np.linalg.norm(goal[:3, 3] - start[:3, 3])) / 1000.0
    turn = math.radians(turn_deg(start, goal))
    length = max(distance, turn, 1e-9)
    lever = math.hypot(*limits.tip_mm) / 1000.0
    ratio = max(1.0, (distance + turn * lever) / length)
    return length, speed_mm_s / 1000.0 / ratio


def within_search(planned: np.ndarray, pose: np.ndarray, limits: Limits) -> bool:
    """Whether a pose lies in the search envelope of a planned one."""
    offset = np.linalg.norm(pose[:3, 3] - planned[:3, 3])
    return bool(
        offset <= limits.search_mm + _POSITION_TOLERANCE_MM
        and turn_deg(planned, pose) <= limits.search_deg + _TURN_TOLERANCE_DEG
    )


def checked_pose(value: object, what: str) -> np.ndarray:
    """A pose (4, 4) of whatever was given.

    Raises:
        RefusedError: no rigid transform.
    """
    pose = array_of(value, what)
    if pose.shape != (4, 4):
        raise refused(f"{what} must have shape (4, 4), not {pose.shape}")
    if not np.isfinite(pose).all():
        raise refused(f"{what} holds NaN or Inf")
    rotation = pose[:3, :3]
    if (
        np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > _ROTATION_TOLERANCE
        or np.abs(rotation).max() > 2.0
        or np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE
        or np.linalg.det(rotation) < 0
    ):
        raise refused(f"{what} is no rigid transform: its 3x3 block is not a rotation")
    return pose
