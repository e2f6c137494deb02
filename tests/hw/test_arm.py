"""The emulated arm's kinematics: profiles against their closed forms, stops, repeatability."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from test_feasibility import swung

from hw.bench.arm import Arm
from hw.bench.controller import NORMAL, Controller
from hw.bench.robot import START as START_DOWN
from hw.robot.kinematics import MODELS, forward, tool_of
from hw.runtime.rigid import pose_to_ur, ur_to_pose

START = (0.4, 0.0, 0.3, 0.0, 3.0, 0.0)


@settings(max_examples=30)
@given(
    target=st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6),
    speed=st.floats(0.001, 0.5),
    acceleration=st.floats(0.05, 5.0),
)
def test_a_linear_move_keeps_its_speed_acceleration_and_line(target, speed, acceleration):
    arm = Arm(START)
    arrival = arm.move_linear(2.0, target, speed, acceleration)
    times = np.linspace(2.0, arrival, 200)
    raw = np.array([arm.raw(t) for t in times])
    np.testing.assert_allclose(raw[0, :3], START[:3])
    np.testing.assert_allclose(raw[-1, :3], target[:3], atol=1e-12)
    last = Rotation.from_rotvec(raw[-1, 3:]).inv() * Rotation.from_rotvec(target[3:])
    assert last.magnitude() < 1e-7
    step = times[1] - times[0]
    if step > 1e-6:
        velocity = np.linalg.norm(np.diff(raw[:, :3], axis=0), axis=1) / step
        assert velocity.max() <= speed * (1 + 1e-6)
        assert np.abs(np.diff(velocity)).max() / step <= acceleration * (1 + 1e-3) + 1e-6
    travel = np.asarray(target[:3]) - START[:3]
    across = np.cross(raw[:, :3] - np.asarray(START[:3]), travel)
    assert np.abs(across).max() < 1e-12
    assert arm.rest_since(arrival - 1e-4) is None or arrival - 2.0 < 1e-4
    assert arm.rest_since(arrival + 0.2) == pytest.approx(arrival)


def test_a_turn_counts_in_radians():
    arm = Arm(START)
    turned = Rotation.from_rotvec([0.2, 0.0, 0.0]) * Rotation.from_rotvec(START[3:])
    arrival = arm.move_linear(0.0, (*START[:3], *turned.as_rotvec()), 0.1, 1.0)
    assert arrival == pytest.approx(0.2 / 0.1 + 0.1 / 1.0)
    assert arm.velocity(1.0)[3:] == pytest.approx((0.1, 0.0, 0.0))


def test_a_stop_brakes_at_its_deceleration():
    arm = Arm(START)
    arm.move_linear(0.0, (0.6, *START[1:]), 0.1, 1.0)
    rests = arm.stop(1.0, 2.0)
    assert rests == pytest.approx(1.0 + 0.1 / 2.0)
    before, after = arm.raw(1.0)[0], arm.raw(5.0)[0]
    assert after - before == pytest.approx(0.1**2 / (2 * 2.0))
    assert arm.velocity(rests + 1e-9) == (0.0,) * 6
    assert arm.stop(6.0) == 6.0


def test_a_move_may_replace_another():
    arm = Arm(START)
    arm.move_linear(0.0, (0.6, *START[1:]), 0.1, 1.0)
    here = arm.raw(1.0)
    arrival = arm.move_linear(1.0, START, 0.1, 1.0)
    assert arm.raw(1.0) == pytest.approx(here)
    assert arm.raw(arrival) == pytest.approx(START)


def test_servo_arrives_in_its_time():
    arm = Arm(START)
    arm.servo(0.0, (0.41, *START[1:]), 0.1)
    assert arm.raw(0.05)[0] == pytest.approx(0.405, abs=1e-5)
    assert arm.raw(0.101)[0] == pytest.approx(0.41)


def test_repeatability_is_redrawn_with_travel_and_is_seeded():
    def errors(travel: float) -> np.ndarray:
        arm = Arm(START, repeatability_mm=0.1, seed=3)
        t, found = 0.0, []
        for k in range(300):
            t = arm.move_linear(t, (0.4 + travel * (k % 2), *START[1:]), 0.5, 5.0) + 1.0
            found.append(np.subtract(arm.true_raw(t)[:3], arm.raw(t)[:3]) * 1000)
        return np.array(found)

    far, near = errors(0.2), errors(0.0001)
    assert far.std() == pytest.approx(0.1, rel=0.15)
    assert np.abs(np.diff(near, axis=0)).std() < 0.02
    np.testing.assert_array_equal(far, errors(0.2))
    assert Arm(START).true_raw(0.0) == Arm(START).raw(0.0)


@pytest.mark.parametrize("raw", [(0.1,) * 5, (0.1,) * 7, (float("nan"),) * 6])
def test_poses_of_another_shape_are_refused(raw):
    with pytest.raises(ValueError, match="six finite"):
        Arm(raw)


OFFSET = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)


def check_along(arm: Arm, model: str, times: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The joints' pose is the arm's, at every time; returns the last joints."""
    for now in times:
        assert not arm.at_its_end(now)
        joints = np.array(arm.joints(now))
        pose = forward(MODELS[model], joints) @ tool_of(OFFSET)
        wanted = ur_to_pose(np.array(arm.raw(now)))
        # Between its samples a path of joints is interpolated.
        assert np.abs(pose - wanted)[:3, 3].max() < 0.02
        assert np.abs(pose - wanted)[:3, :3].max() < 1e-4
        # In small steps: the branch is kept.
        assert np.abs(joints - before).max() < 0.05
        before = joints
    return before


@pytest.mark.parametrize("model", ["UR5", "UR5e"])
def test_joints_bring_the_tool_where_the_arm_says_that_it_is(model):
    """Through the forward kinematics, along moves that brake and replace one another."""
    arm = Arm(START_DOWN, tcp_offset=OFFSET, model=model)
    t, rng = 0.0, np.random.default_rng(0)
    before = np.array(arm.joints(0.0))
    for k in range(12):
        target = np.array(START_DOWN) + rng.uniform(-0.08, 0.08, 6)
        last = arm.move_linear(t, target.tolist(), 0.1, 1.0)
        if not k % 3:
            last = t + 0.4 * (last - t)
        times = np.linspace(t, last, 80)
        if not k % 3:
            before = check_along(arm, model, times[:-1], before)
            times = np.linspace(last, arm.stop(last, 2.0), 10)
            last = times[-1]
        before = check_along(arm, model, times, before)
        t = last
    velocity = (np.array(arm.joints(t - 0.1)) - np.array(arm.joints(t - 0.1001))) / 1e-4
    np.testing.assert_allclose(arm.joint_speeds(t - 0.1), velocity, atol=1e-3)


def test_the_arm_stops_protectively_before_a_wrist_singularity_and_its_reach():
    """A tool that points sideways is turned about the vertical, so that axis 6 meets axis 4."""
    ur5 = MODELS["UR5"]
    start, goal = map(pose_to_ur, swung()[1:])
    out = start.copy()
    out[:2] += 0.6 * start[:2] / np.linalg.norm(start[:2])
    for target, text in ((goal, "singularity"), (out, "reach")):
        arm = Arm(start.tolist(), model="UR5")
        program = Controller(arm)
        program.upload(0.0)
        program.step(0.1)
        arm.move_linear(0.1, target.tolist(), 0.1, 1.0)
        t = 0.1
        while program.safety_mode == NORMAL:
            t += 0.002
            program.step(t)
            assert t < 30.0, text
        assert "cannot follow" in program.reason
        rest = t + 1.0
        joints = np.array(arm.joints(rest))
        assert np.isfinite(joints).all()
        # It rests short of the place, and about where it says that it is: where the arm is nearly
        # stretched, joints that are interpolated over 4 mm are off by a tenth of a mm.
        pose = forward(ur5, joints)
        told = ur_to_pose(np.array(arm.raw(rest)))
        np.testing.assert_allclose(pose[:3, 3], told[:3, 3], atol=0.2)
        assert not arm.within_reach(out.tolist())
        # Once released, it may go back.
        program.safety_mode = NORMAL
        arrival = arm.move_linear(rest, start.tolist(), 0.05, 1.0)
        for now in np.linspace(rest, arrival, 200):
            program.step(now)
        assert program.safety_mode == NORMAL
        assert arm.raw(arrival) == pytest.approx(tuple(start), abs=1e-9)


def test_an_arm_that_does_not_reach_its_start_is_refused():
    with pytest.raises(ValueError, match="UR3 does not reach"):
        Arm((0.9, 0.0, 0.3, 0.0, 3.0, 0.0), model="UR3")
