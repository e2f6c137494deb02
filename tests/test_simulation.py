from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import compiled_programs, experiment

import jaxcal
from jaxcal import InputError, Protocol, simulate
from jaxcal.diagnostics.metrics import reconstruct
from jaxcal.study.simulation import draw

ROOT, SMALL = jax.random.key(7), Protocol(images=6, test_images=2)


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
    keys = jax.vmap(lambda index: jax.random.fold_in(ROOT, index))(jnp.arange(5))
    batch = jax.jit(jax.vmap(lambda key: (draw(key, SMALL), simulate(key, SMALL))))
    (many, whole), part = batch(keys), simulate(keys[3], SMALL)
    one = jax.jit(lambda key: draw(key, SMALL))(keys[3])
    for name in ("turn", "position", "offset"):
        np.testing.assert_array_equal(getattr(many, name)[3], getattr(one, name))
    # A program for another number of problems may round what follows differently.
    np.testing.assert_allclose(whole.poses[3], part.poses, rtol=0, atol=1e-12 * 300)
    np.testing.assert_allclose(whole.points[3], part.points, rtol=0, atol=1e-6)


def test_experiments_with_a_leading_axis_become_a_batch_of_problems():
    protocol = replace(SMALL, raw=True)
    drawn = jax.jit(jax.vmap(lambda key: simulate(key, protocol)))(jax.random.split(ROOT, 3))
    batch = drawn.problem(max_elevation=2.0, probe=protocol.probe)
    each = jax.vmap(lambda one: one.problem(max_elevation=2.0, probe=protocol.probe))(drawn)
    jax.tree.map(np.testing.assert_array_equal, batch, each)


def test_a_call_with_values_is_one_program_for_all_keys_and_sizes():
    """It ran step by step: 279 programs for the first call, and one more for each other call."""
    first, second = jax.random.split(ROOT)
    drawn = simulate(first, SMALL)
    with compiled_programs() as compiled:
        other = simulate(second, replace(SMALL, noise_mm=0.0, depth_mm=(20.0, 60.0)))
    assert compiled == []
    np.testing.assert_array_equal(simulate(first, SMALL).points, drawn.points)
    assert isinstance(drawn.points, jax.Array)
    depth = np.linalg.norm(other.test_points, axis=1)
    assert not other.covariance.any()
    assert (depth > 20).all()
    assert (other.test_points[:, 1] < 60).all()


@pytest.mark.parametrize("count", [0, 1])
def test_few_test_images_or_none(count, tmp_path):
    recording = experiment(1, images=8, test_images=count)
    jaxcal.save(recording, tmp_path / "rec.h5")
    for one in (recording, jaxcal.load(tmp_path / "rec.h5")):
        assert (0 if one.test is None else len(one.test.poses)) == count


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


def test_a_traced_size_that_makes_no_sense_is_not_passed_over_in_silence():
    @jax.jit
    def poses(noise):
        return simulate(jax.random.key(0), replace(Protocol(images=8), noise_mm=noise)).poses

    for noise, lost in ((0.0, False), (-1.0, True), (np.nan, True)):
        assert np.isnan(np.asarray(poses(noise))[:, :3]).all() == lost
        assert np.isnan(np.asarray(poses(noise))).any() == lost
    with pytest.raises(InputError, match=r"jaxcal\.simulate is for jit"):
        jax.jit(lambda noise: jaxcal.simulate_recording(replace(SMALL, noise_mm=noise)))(0.5)
