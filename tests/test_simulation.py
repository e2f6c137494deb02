from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import experiment

from jaxcal import InputError, Protocol, simulate
from jaxcal.metrics import reconstruct


def test_truth_reconstructs_the_target():
    recording = experiment(0, images=30, elevation_mm=2.0, noise_mm=0.0)
    images, truth = recording.calibration, recording.truth
    axial = np.sqrt(images.measurements[:, 1] ** 2 - truth.elevation**2)
    points = np.stack([images.measurements[:, 0], truth.elevation, axial], axis=1)
    cloud = reconstruct(truth.image_to_probe, images.poses, points)
    np.testing.assert_allclose(cloud, np.tile(truth.point, (30, 1)), atol=1e-9)
    test = reconstruct(truth.image_to_probe, recording.test.poses, recording.test.measurements)
    np.testing.assert_allclose(test, np.tile(truth.point, (50, 1)), atol=1e-9)
    assert np.abs(truth.elevation).max() <= 2.0


def test_draws_do_not_depend_on_the_batch():
    root, protocol = jax.random.key(7), Protocol(images=6, test_images=2)
    draw = jax.jit(jax.vmap(lambda k: simulate(jax.random.fold_in(root, k), protocol)))
    whole, part = draw(jnp.arange(5)), draw(jnp.array([3]))
    np.testing.assert_array_equal(whole.poses[3], part.poses[0])
    np.testing.assert_array_equal(whole.elevation[3], part.elevation[0])


def test_normal_offsets_have_the_given_sd():
    recording = experiment(1, images=4000, elevation_mm=1.5, elevation_distribution="normal")
    assert np.std(recording.truth.elevation) == pytest.approx(1.5, rel=0.05)


@pytest.mark.parametrize(
    "bad",
    [{"images": 3}, {"noise_mm": -1.0}, {"elevation_mm": float("nan")},
     {"noise_mm": float("inf")}],
)  # fmt: skip
def test_bad_protocols_are_refused(bad):
    with pytest.raises(InputError):
        Protocol(**bad)
