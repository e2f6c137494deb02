"""Whether an arm can follow a plan: the checks against ways sampled much more finely."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_safety import pose as down

from hw.bench.joints import first_joints
from hw.robot.feasibility import Arm, check_model, follow, follow_all
from hw.robot.gate import Gate
from hw.robot.kinematics import (
    MODELS,
    branch_of,
    dexterity_mm,
    flange_of,
    forward,
    inverse,
    joint_points,
    link_frames,
    tool_of,
    wrapped,
)
from hw.robot.limits import Limits
from hw.robot.motion_plan import MotionPlan, plan_lines
from hw.robot.path_checks import check_plan
from hw.robot.stream import PoseSample
from hw.runtime.clock import Clock
from hw.runtime.errors import RefusedError
from hw.runtime.rigid import pose_to_ur, straight_way

UR5 = MODELS["UR5"]
OFFSET = (0.0, 0.0, 0.12, 0.0, 0.0, 0.0)
ARM = Arm(
    UR5,
    OFFSET,
    np.radians([-360.0, -360.0, -180.0, -360.0, -360.0, -360.0]),
    np.radians([360.0, 360.0, 180.0, 360.0, 360.0, 360.0]),
    10.0,
    math.radians(90.0),
    np.array([-2000.0, -2000.0, 0.0]),
    np.array([2000.0, 2000.0, 2000.0]),
)
WAYS = 100


def joints_at(pose: np.ndarray, model=UR5) -> np.ndarray:
    return first_joints(model, tuple(pose_to_ur(pose).tolist()), OFFSET)


HOME = down(400.0, -200.0, 250.0)


def swung() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sideways tool turned about the vertical through joint 5 = 0: both ends are regular."""
    joints = np.array([0.3, -1.3, 1.6, -0.3, 0.475, 0.2])
    frames = link_frames(UR5, joints)
    (x, y), (u, v) = frames[6, :2, 2], frames[1, :2, 2]
    turn = Rotation.from_rotvec([0.0, 0.0, 2 * np.arctan2(x * v - y * u, x * u + y * v)])
    goal = frames[6].copy()
    goal[:3, :3] = turn.as_matrix() @ goal[:3, :3]
    return joints, frames[6], goal


def test_a_way_through_a_wrist_singularity_is_refused_though_its_ends_are_good():
    bare = replace(ARM, tcp_offset=(0.0,) * 6)
    joints, start, goal = swung()
    for pose in (start, goal):
        follow(bare, pose, pose, joints, "an end")
    with pytest.raises(RefusedError, match=r"singularity of the arm \(at \d+ % of the way; wrist"):
        follow(bare, start, goal, joints, "the way")
    with pytest.raises(RefusedError, match="singularity"):
        follow_all(bare, np.stack([start, goal]), np.array([1.0]))
    # However briefly: the singular place lies between any two of the first samples.
    narrow = replace(bare, least_dexterity_mm=1.0)
    with pytest.raises(RefusedError, match="singularity"):
        follow(narrow, start, goal, joints, "the way")


def test_what_passes_holds_between_the_samples_too():
    """Random ways, against 800 places of each, by other means than the check's own samples."""
    rng = np.random.default_rng(0)
    passed = refused = 0
    for _ in range(WAYS):
        model = MODELS[("UR3e", "UR5", "UR10e")[int(rng.integers(3))]]
        arm = replace(ARM, model=model, box_min_mm=np.array([-2000.0, -2000.0, -100.0]))
        joints = rng.uniform(-math.pi, math.pi, 6)
        start = forward(model, joints) @ tool_of(OFFSET)
        goal = start.copy()
        goal[:3, 3] += rng.normal(size=3) * 80.0
        goal[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.4).as_matrix() @ goal[:3, :3]
        try:
            course = follow(arm, start, goal, joints, "the way", 1.0)
        except RefusedError:
            refused += 1
            continue
        passed += 1
        way = straight_way(start, goal, np.linspace(0.0, 1.0, 800))
        found = inverse(model, flange_of(way, OFFSET))
        assert found.reached[:, course.branch].all()
        path = np.unwrap(found.joints[:, course.branch], axis=0)
        path += joints - path[0]
        assert np.abs(wrapped(path[0] - found.joints[0, course.branch])).max() < 1e-9
        assert dexterity_mm(model, path).min() >= 0.5 * arm.least_dexterity_mm
        assert dexterity_mm(model, path).min() >= 0.9 * course.dexterity_mm
        assert (np.abs(path) <= 2 * math.pi + 1e-3).all()
        assert np.abs(np.diff(path, axis=0)).max() * 799 <= arm.joint_speed * 1.05
        np.testing.assert_allclose(path[-1], course.joints[-1], atol=1e-9)
        assert joint_points(model, path)[..., 2].min() - model.radius_mm >= -100.0
    assert passed >= 10
    assert refused >= 10


def test_every_reason_has_its_line():
    joints = joints_at(HOME)
    for what, arm, goal in [
        (r"out of the reach of a UR5 \(at \d+ % of the way\)", ARM, down(900.0, -400.0, 250.0)),
        (
            r"turns joint 6 \(wrist 3\) to -?\d+\.\d deg, over its limits of -360 to",
            replace(ARM, joint_max=np.array([*ARM.joint_max[:5], joints[5] + 0.1])),
            down(400.0, -200.0, 250.0, (0.0, 0.0, -30.0)),
        ),
        (r"turns joint 1 \(base\) at \d+ deg/s, over", replace(ARM, joint_speed=0.01),
         down(400.0, -100.0, 250.0)),
        (r"takes the arm's elbow \d+ mm out of the arm's box along z",
         replace(ARM, box_max_mm=np.array([2000.0, 2000.0, 450.0])), HOME),
    ]:  # fmt: skip
        follow(ARM, HOME, HOME, joints, "it", 1.0)
        with pytest.raises(RefusedError, match=what):
            follow(arm, HOME, goal, joints, "it", 1.0)


def test_the_arm_s_joints_decide_the_branch():
    """With the elbow down the same plan would take it through the table."""
    poses = np.stack([HOME, down(420.0, -220.0, 240.0)])
    up = joints_at(HOME)
    course = follow_all(ARM, poses, np.array([1.0]), up)
    assert course.branch == branch_of(UR5, up)
    assert "smallest singular value" in course.text
    found = inverse(UR5, flange_of(HOME, OFFSET)).joints
    low = found[np.argmin(joint_points(UR5, found)[:, 0, 2])]
    table = replace(ARM, box_min_mm=np.array([-2000.0, -2000.0, 100.0]))
    with pytest.raises(RefusedError, match="pose 1 of the plan takes the arm's elbow"):
        follow_all(table, poses, np.array([1.0]), low)
    # Without joints some branch is found.
    assert follow_all(table, poses, np.array([1.0])).branch != branch_of(UR5, low)
    # The winding is the arm's, too.
    wound = up - np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.copysign(2 * math.pi, up[5])])
    assert follow_all(ARM, poses, np.array([1.0]), wound).joints[0, 5] == pytest.approx(wound[5])


def test_joints_of_another_arm_are_noticed():
    check_model(ARM, HOME, joints_at(HOME))
    with pytest.raises(RefusedError, match=r"do not fit a UR5 \(by \d+"):
        check_model(ARM, HOME, joints_at(HOME, MODELS["UR5e"]))
    with pytest.raises(RefusedError, match="do not fit a UR5"):
        check_model(replace(ARM, tcp_offset=(0.0,) * 6), HOME, joints_at(HOME))


LIMITS = Limits(
    box_min_mm=(250.0, -350.0, 60.0),
    box_max_mm=(550.0, -50.0, 400.0),
    tip_mm=(0.0, 0.0, 60.0),
    cone_axis=(0.0, 0.0, -1.0),
    cone_deg=60.0,
    max_step_mm=200.0,
    max_turn_deg=120.0,
    max_speed_mm_s=50.0,
    arm_model="ur5",
)


def test_plan_and_gate_check_the_arm():
    plan = MotionPlan(np.stack([HOME, down(420.0, -220.0, 240.0)]), LIMITS, OFFSET, "1")
    course = check_plan(plan)
    assert course is not None
    assert any("arm: UR5" in line for line in plan_lines(plan))
    assert check_plan(replace(plan, limits=replace(LIMITS, arm_model=""))) is None
    far = MotionPlan(np.stack([HOME, HOME]), replace(LIMITS, arm_model="UR3"), OFFSET, "1")
    with pytest.raises(RefusedError, match="pose 1 of the plan"):
        check_plan(far)
    clock = Clock()

    def sample(joints: np.ndarray | None) -> PoseSample:
        known = None if joints is None else tuple(joints.tolist())
        raw = tuple(pose_to_ur(HOME).tolist())
        return PoseSample(clock.now(), 0.0, raw, 1, 7, 2, 0.0, known)

    gate = Gate(plan, None, clock)
    gate.check_geometry(plan.targets[1], sample(joints_at(HOME)), None)
    gate.check_geometry(plan.targets[1], sample(None), None)
    with pytest.raises(RefusedError, match="do not fit a UR5"):
        gate.check_geometry(plan.targets[1], sample(joints_at(HOME, MODELS["UR5e"])), None)
    found = inverse(UR5, flange_of(HOME, OFFSET)).joints
    low = found[np.argmin(joint_points(UR5, found)[:, 0, 2])]
    with pytest.raises(RefusedError, match="the motion takes the arm's elbow"):
        gate.check_geometry(plan.targets[1], sample(low), None)


def test_the_whole_probe_is_held_along_an_arc():
    """A corner of the housing dips out of the box half-way along a turn; its ends are inside."""
    corner = (29.0, 0.0, 60.0)
    ends = [down(400.0, -200.0, 300.0, (0.0, tilt, 0.0)) for tilt in (10.0, 42.0)]
    if ends[1] @ [*corner, 1.0] @ [0, 0, 1, 0] > ends[1][2, 3] - 60.0:
        ends = [down(400.0, -200.0, 300.0, (0.0, -tilt, 0.0)) for tilt in (10.0, 42.0)]
    floor = min(float((end @ [*corner, 1.0])[2]) for end in ends) - 0.01
    limits = replace(LIMITS, arm_model="", box_min_mm=(250.0, -350.0, floor))
    check_plan(MotionPlan(np.array(ends), limits, OFFSET, "1"))
    limits = replace(limits, hull_mm=(corner,))
    for end in ends:
        check_plan(MotionPlan(end[None], limits, OFFSET, "1"))
    with pytest.raises(RefusedError, match="the way from pose 1 to pose 2 takes a corner of"):
        check_plan(MotionPlan(np.array(ends), limits, OFFSET, "1"))
    low = replace(LIMITS, arm_model="", arm_box_max_mm=(2000.0, 2000.0, 299.0))
    with pytest.raises(RefusedError, match=r"takes the flange .* out of the arm's box"):
        check_plan(MotionPlan(np.array(ends), low, OFFSET, "1"))
