"""Controller poses and 4x4 transforms, against scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hw.runtime.rigid import pose_to_ur, turn_deg, ur_to_pose
from jaxcal.data.poses import vectors_from_rotations

number = st.floats(-4.0, 4.0)


@settings(max_examples=200)
@given(raw=st.lists(number, min_size=6, max_size=6))
def test_poses_are_scipy_s_in_millimetres(raw):
    pose = ur_to_pose(np.array(raw))
    expected = Rotation.from_rotvec(raw[3:]).as_matrix()
    np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], 1000 * np.array(raw[:3]))
    np.testing.assert_array_equal(pose[3], [0, 0, 0, 1])
    back = pose_to_ur(pose)
    assert np.linalg.norm(back[3:]) <= np.pi + 1e-9
    np.testing.assert_allclose(ur_to_pose(back), pose, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, np.pi - 1e-9, np.pi])
def test_rotation_vectors_keep_their_digits(angle):
    axes = np.random.default_rng(0).normal(size=(50, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    rotations = Rotation.from_rotvec(angle * axes).as_matrix()
    vectors = vectors_from_rotations(rotations)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), angle, rtol=1e-7, atol=1e-15)
    again = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(again, rotations, atol=1e-12)


def test_batches_and_turns():
    raw = np.random.default_rng(1).normal(size=(3, 4, 6))
    poses = ur_to_pose(raw)
    assert poses.shape == (3, 4, 4, 4)
    np.testing.assert_allclose(poses[2, 1], ur_to_pose(raw[2, 1]))
    np.testing.assert_allclose(pose_to_ur(poses)[2, 1], pose_to_ur(poses[2, 1]))
    first, second = poses[0, 0], poses[0, 0].copy()
    second[:3, :3] = first[:3, :3] @ Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix()
    assert turn_deg(first, second) == pytest.approx(np.degrees(0.3))
