from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_poses
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxcal import InputError
from jaxcal.data.geometry import rotation_from_vector
from jaxcal.data.poses import check_poses, nearest_rotations, rotation_angle


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_nearest_rotation_is_a_rotation_and_no_other_is_nearer(seed):
    rng = np.random.default_rng(seed)
    matrices = rng.normal(size=(4, 3, 3))
    rotations, distance = nearest_rotations(matrices)
    identity = np.tile(np.eye(3), (4, 1, 1))
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), identity, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    others = random_poses(4, seed)[:, :3, :3]
    assert (np.linalg.norm(others - matrices, axis=(1, 2)) >= distance - 1e-12).all()


def test_rounded_rotations_are_projected():
    poses = random_poses(5, 0)
    checked = check_poses(np.round(poses, 4))
    np.testing.assert_allclose(checked[:, :3, :3] @ checked[:, :3, :3].swapaxes(1, 2),
                               np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)  # fmt: skip
    assert max(rotation_angle(a, b) for a, b in zip(checked, poses, strict=True)) < 1e-3


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda p: p[2, :3, :3].__imul__(1.1), "pose 2 is not a rotation"),
        (lambda p: p[3, :3, 0].__imul__(-1), "pose 3 is a reflection"),
        (lambda p: p[1].__setitem__((0, 3), np.nan), "pose 1 holds NaN"),
        (lambda p: p[1].__setitem__((0, 3), np.inf), "pose 1 holds NaN or Inf"),
        (lambda p: p[4].__setitem__((3, 0), 7.0), "pose 4 is not a rigid transform"),
    ],
)
def test_bad_poses_are_refused_by_row(spoil, words):
    poses = random_poses(5, 1)
    spoil(poses)
    with pytest.raises(InputError, match=words):
        check_poses(poses)


def test_images_left_out_are_not_looked_at():
    poses = random_poses(5, 2)
    poses[3] = np.nan
    checked = check_poses(poses, np.array([1, 1, 1, 0, 1], bool))
    np.testing.assert_array_equal(checked[3], np.eye(4))


def test_transposed_poses_are_called_so():
    with pytest.raises(InputError, match="transposed"):
        check_poses(random_poses(5, 3).swapaxes(1, 2))


ANGLES = (0.0, 1e-200, 1e-9, 1e-4, 0.0999, 0.1, 0.1001, 1.0, np.pi, 6.0)
AXIS = np.array([2.0, -1.0, 2.0]) / 3


def test_rotations_of_vectors():
    vectors = np.concatenate(
        [np.outer(ANGLES, AXIS), 3 * np.random.default_rng(5).normal(size=(50, 3))]
    )
    rotations = jax.jit(jax.vmap(rotation_from_vector))
    found = rotations(jnp.asarray(vectors))
    expected = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
    single = rotations(jnp.asarray(vectors, jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, expected, rtol=0, atol=1e-6)


def test_derivatives_of_rotations_are_those_of_the_matrix_exponential():
    """First and second ones, at zero too, and on both sides of where the series ends."""

    def exponential(vector):
        x, y, z = vector
        return jax.scipy.linalg.expm(jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))

    @jax.jit
    @jax.vmap
    def both_orders(vector):
        def slopes(function, mode):
            return mode(function)(vector), jax.jacfwd(mode(function))(vector)

        forward, reverse = (slopes(rotation_from_vector, m) for m in (jax.jacfwd, jax.jacrev))
        return forward, reverse, slopes(exponential, jax.jacfwd)

    forward, reverse, expected = both_orders(jnp.asarray(np.outer(ANGLES, AXIS)))
    for order in (0, 1):
        for found in (forward, reverse):
            np.testing.assert_allclose(found[order], expected[order], atol=2e-12)
