"""Kinematics of UR arms against independent oracles: screws, published poses, differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from hw.robot.kinematics import (
    ANGLE_MM,
    BRANCHES,
    MODELS,
    branch_of,
    dexterity_mm,
    flange_of,
    forward,
    inverse,
    jacobian,
    joint_points,
    link_frames,
    model_named,
    nearest,
    nearest_singularity,
    scaled_jacobian,
    tool_of,
    wrapped,
)
from hw.runtime.errors import RefusedError

ALL = pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))


def joints_of(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-math.pi, math.pi, (count, 6))


def twist(axis: np.ndarray, point: np.ndarray) -> np.ndarray:
    """4x4 generator of a turn about an axis through a point."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = skew, -skew @ point
    return matrix


def product_of_exponentials(model, joints: np.ndarray) -> np.ndarray:
    """The flange by screws read from the drawing of the arm at q = 0: stretched out along -x.

    The shoulder is at (0, 0, d1), axes 2 to 4 point along -y, axis 5 down, axis 6 along -y.
    """
    reach = model.a2 + model.a3
    down, side = np.array([0.0, 0.0, -1.0]), np.array([0.0, -1.0, 0.0])
    shoulder = np.array([0.0, 0.0, model.d1])
    elbow, wrist = np.array([model.a2, 0.0, model.d1]), np.array([reach, -model.d4, model.d1])
    screws = [
        (-down, np.zeros(3)),
        (side, shoulder),
        (side, elbow),
        (side, wrist),
        (down, wrist),
        (side, wrist + model.d5 * down),
    ]
    home = np.eye(4)
    home[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    home[:3, 3] = wrist + model.d5 * down + model.d6 * side
    pose = np.eye(4)
    for (axis, point), angle in zip(screws, joints, strict=True):
        pose = pose @ expm(angle * twist(axis, point))
    return pose @ home


@ALL
def test_forward_is_the_product_of_exponentials(model):
    for joints in joints_of(20):
        expected = product_of_exponentials(model, joints)
        np.testing.assert_allclose(forward(model, joints), expected, atol=1e-9)


def test_published_poses():
    # UR5: the pendant's TCP pose of the stretched arm, and of the arm upright (q2 = q4 = -90 deg).
    ur5 = MODELS["UR5"]
    np.testing.assert_allclose(
        forward(ur5, np.zeros(6))[:3, 3], [-817.25, -191.45, -5.491], atol=1e-9
    )
    upright = forward(ur5, np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0]))
    np.testing.assert_allclose(upright[:3, 3], [0.0, -191.45, 1001.059], atol=1e-9)
    # Modern Robotics (Lynch and Park 2017), example 4.5: the UR5 with W1 = 109, W2 = 82, L1 = 425,
    # L2 = 392, H1 = 89, H2 = 95 mm, q2 = -90 deg and q5 = 90 deg. Their base's x and y axes point
    # the other way, and their flange is another.
    rounded = type(ur5)("", 89.0, -425.0, -392.0, 109.0, 95.0, 82.0, 0.0, 0.0)
    pose = forward(rounded, np.array([0.0, -np.pi / 2, 0.0, 0.0, np.pi / 2, 0.0]))
    np.testing.assert_allclose(pose[:3, 3] * [-1, -1, 1], [95.0, 109.0, 988.0], atol=1e-9)


@ALL
def test_inverse_finds_every_branch_and_the_forward_undoes_it(model):
    joints = joints_of(500)
    flange = forward(model, joints)
    found = inverse(model, flange)
    wanted = np.broadcast_to(flange[:, None], (*found.reached.shape, 4, 4))[found.reached]
    back = forward(model, found.joints[found.reached])
    assert np.abs(back - wanted).max() < 1e-10
    assert np.isnan(found.joints[~found.reached]).all()
    # The branch of the joints that made the pose gives them back.
    own = found.joints[np.arange(len(joints)), branch_of(model, joints)]
    assert np.abs(wrapped(own - joints)).max() < 1e-9
    # All eight at once, and each knows its number.
    full = found.reached.all(axis=1)
    assert full.sum() > 100
    branches = branch_of(model, found.joints[full])
    np.testing.assert_array_equal(branches, np.tile(np.arange(BRANCHES), (full.sum(), 1)))
    apart = np.abs(wrapped(found.joints[full][:, :, None] - found.joints[full][:, None]))
    assert (apart.max(axis=-1)[:, ~np.eye(BRANCHES, dtype=bool)] > 1e-6).all()


@ALL
def test_singular_poses_are_reached_to_the_last_digit(model):
    base = np.array([0.4, -1.1, 1.3, -0.7, 0.9, 0.3])
    stretched, folded = base.copy(), base.copy()
    stretched[2], folded[4] = 0.0, 0.0
    straight = base.copy()
    straight[4] = math.pi
    for joints in (stretched, folded, straight, _over_axis_1(model, base)):
        for away in (0.0, 1e-13, 1e-11, 1e-9, 1e-7, 1e-5):
            flange = forward(model, joints + away)
            found = inverse(model, flange)
            assert found.reached.any()
            back = forward(model, found.joints[found.reached])
            assert np.abs(back - flange).max() < 1e-6
            near = nearest(model, flange, joints)
            assert near is not None
            assert np.abs(forward(model, near) - flange).max() < 1e-6
    assert dexterity_mm(model, folded) < 1e-6
    assert nearest_singularity(model, folded).startswith("wrist")
    assert nearest_singularity(model, stretched).startswith("elbow")
    np.testing.assert_allclose(nearest(model, forward(model, folded), folded), folded, atol=1e-6)
    np.testing.assert_allclose(
        nearest(model, forward(model, straight), straight), straight, atol=1e-6
    )


def _over_axis_1(model, joints: np.ndarray) -> np.ndarray:
    """The wrist centre d4 from axis 1: joint 2 turned until it is there, by bisection."""

    def along(q2: float) -> float:
        q = joints.copy()
        q[1] = q2
        centre = link_frames(model, q)[5, :3, 3]
        return float(centre[0] * math.cos(q[0]) + centre[1] * math.sin(q[0]))

    grid = np.linspace(-math.pi, math.pi, 200)
    values = [along(q2) for q2 in grid]
    k = next(k for k in range(199) if values[k] * values[k + 1] < 0)
    low, high = grid[k], grid[k + 1]
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if along(low) * along(middle) > 0 else (low, middle)
    over = joints.copy()
    over[1] = low
    assert nearest_singularity(model, over).startswith("shoulder")
    return over


@ALL
def test_jacobian_is_that_of_finite_differences(model):
    step = 1e-6
    for joints in joints_of(10, 1):
        found = jacobian(model, joints)
        here = forward(model, joints)
        for k in range(6):
            low, high = joints.copy(), joints.copy()
            low[k], high[k] = joints[k] - step, joints[k] + step
            first, last = forward(model, low), forward(model, high)
            velocity = (last[:3, 3] - first[:3, 3]) / (2 * step)
            spin = (last - first)[:3, :3] @ here[:3, :3].T / (2 * step)
            np.testing.assert_allclose(found[:3, k], velocity, atol=1e-4)
            np.testing.assert_allclose(
                found[3:, k], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-8
            )
        # Its determinant is the product of the three singularities (their closed forms).
        q = joints
        along = model.a2 * math.cos(q[1]) + model.a3 * math.cos(q[1] + q[2])
        along += model.d5 * math.sin(q[1] + q[2] + q[3])
        product = model.a2 * model.a3 * math.sin(q[2]) * math.sin(q[4]) * along
        assert abs(np.linalg.det(found)) == pytest.approx(abs(product), rel=1e-6)


@ALL
def test_the_bound_of_the_jacobian_s_change_holds(model):
    rng = np.random.default_rng(2)
    joints = joints_of(2000, 2)
    change = rng.normal(size=joints.shape)
    change *= 1e-4 / np.linalg.norm(change, axis=1, keepdims=True)
    difference = scaled_jacobian(model, joints + change) - scaled_jacobian(model, joints)
    norm = np.linalg.norm(difference, ord=2, axis=(1, 2)) / 1e-4
    assert norm.max() < model.jacobian_lipschitz_mm
    # Nor is it so wide that ways would be sampled for nothing.
    assert norm.max() > 0.3 * model.jacobian_lipschitz_mm
    arms = np.linalg.norm(
        forward(model, joints)[:, None, :3, 3] - link_frames(model, joints)[:, :6, :3, 3], axis=-1
    )
    # The lever of joint 1 counts from the shoulder's height; any point of an axis will do.
    assert (arms[:, 1:] <= model.levers_mm[1:] + 1e-9).all()
    assert dexterity_mm(model, joints).max() < model.levers_mm[0] + ANGLE_MM


def test_tool_flange_and_points():
    ur5 = MODELS["UR5"]
    offset = (0.01, -0.02, 0.12, 0.1, 0.2, -0.3)
    joints = joints_of(5, 3)
    pose = forward(ur5, joints) @ tool_of(offset)
    np.testing.assert_allclose(flange_of(pose, offset), forward(ur5, joints), atol=1e-9)
    points = joint_points(ur5, joints)
    np.testing.assert_allclose(points[:, -1], forward(ur5, joints)[:, :3, 3])
    frames = link_frames(ur5, joints)
    np.testing.assert_array_equal(frames[:, 0], np.tile(np.eye(4), (5, 1, 1)))
    elbow = np.linalg.norm(points[:, 0] - frames[:, 1, :3, 3], axis=1)
    np.testing.assert_allclose(elbow, 425.0)
    assert np.linalg.norm(points[:, -1] - [0, 0, ur5.d1], axis=1).max() <= ur5.reach_mm
    far = np.eye(4)
    far[0, 3] = 2000.0
    assert nearest(ur5, far, np.zeros(6)) is None
    assert model_named("ur5 E").name == "UR5e"
    with pytest.raises(RefusedError, match="no arm 'KUKA' is known; there are UR3, UR5"):
        model_named("KUKA")
