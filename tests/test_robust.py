"""Gross outliers are found, named and left out; clean images stay."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import problem

import jaxcal
from jaxcal.calibration.engine import _to_search
from jaxcal.cli.main import main
from jaxcal.diagnostics.outliers import outlier_reasons, outliers
from jaxcal.model.unknowns import RIGID
from jaxcal.solvers.consensus import find_consensus, quantile, rigid_model

with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(Path(__file__).parents[1] / "experiments")
    from contamination import OUTLIER_KINDS, contaminate


@pytest.fixture(scope="module")
def consensus():
    return jax.jit(jax.vmap(lambda p: find_consensus(p, rigid_model(RIGID))))


def batch(fraction: float, kind, count: int = 12, **protocol):
    clean = jaxcal.stack([problem(seed, images=50, **protocol) for seed in range(count)])
    keys = jax.random.split(jax.random.key(1), count)
    return clean, *jax.vmap(lambda k, p: contaminate(k, p, fraction, kind))(keys, clean)


@pytest.mark.parametrize("kind", OUTLIER_KINDS)
def test_contamination_spoils_what_it_says(kind):
    clean, spoilt, outlier = batch(0.3, kind)
    assert np.asarray(outlier).sum(axis=1).tolist() == [15] * 12
    moved = np.linalg.norm(spoilt.measurements - clean.measurements, axis=-1)
    shifted = np.linalg.norm(spoilt.poses[..., :3, 3] - clean.poses[..., :3, 3], axis=-1)
    off = np.asarray(outlier) > 0
    assert not moved[~off].any()
    assert not shifted[~off].any()
    assert ((moved + shifted)[off] >= 20 - 1e-9).all()
    assert ((moved + shifted)[off] <= 100 + 1e-9).all()
    assert (np.asarray(spoilt.measurements)[..., 1] > 0).all()
    assert (shifted[off] > 0).any() == (kind in ("pose", "slip", "mixed"))


def test_nearly_all_outliers_and_hardly_anything_else(consensus):
    for kind, fraction in (("mixed", 0.3), ("slip", 0.3), ("click", 0.1), ("mixed", 0.0)):
        _, spoilt, outlier = batch(fraction, kind, elevation_mm=2.0, noise_mm=2.0)
        found = consensus(spoilt)
        kept, outlier = np.asarray(found), np.asarray(outlier)
        assert (outlier * kept).sum() <= 0.02 * outlier.sum(), (kind, fraction)
        assert ((1 - outlier) * (1 - kept)).sum() <= 0.01 * (1 - outlier).sum(), (kind, fraction)


def test_images_masked_by_the_caller_stay_out(consensus):
    _, spoilt, outlier = batch(0.2, "mixed")
    mask = np.ones(spoilt.mask.shape)
    mask[:, 20:30] = 0.0
    found = consensus(replace(spoilt, mask=jnp.asarray(mask)))
    assert not np.asarray(found)[:, 20:30].any()
    np.testing.assert_array_equal(found, mask * (1 - np.asarray(outlier)))


def test_a_median_moves_with_the_value_that_it_is():
    """The SDs behind a pivot calibration's studentised errors moved with the largest error."""
    values = jnp.array([3.0, jnp.nan, 0.5, 9.0, 1.5, 2.0, 1e3])
    weight = jnp.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    found, slope = jax.jit(jax.value_and_grad(quantile))(values, weight, 0.5)
    assert float(found) == pytest.approx(2.0, rel=1e-6)
    np.testing.assert_array_equal(slope, [0, 0, 0, 0, 0, 1, 0])


def test_exact_images_agree_at_another_sound_speed():
    exact = problem(3, images=12, noise_mm=0.0, elevation_mm=0.0)
    # The range of a point is 5 mm more than is measured.
    points = exact.measurements * jnp.array([1.0, 0.92]) - jnp.array([0.0, 5.0])
    slow = replace(exact, measurements=points, face_offset=jnp.array(5.0))
    model = rigid_model((*RIGID, "sound-speed"))

    @jax.jit
    def proposed(data):
        every = model.propose(data, jnp.ones((1, 12)))
        first = jax.tree.map(lambda leaf: leaf[0], every)
        return first.sound_speed, model.errors(first, data)

    speed, errors = proposed(slow)
    assert float(speed) == pytest.approx(1 / 0.92, rel=1e-6)
    np.testing.assert_allclose(errors, 0.0, atol=1e-5)


@pytest.mark.slow
def test_an_unknown_sound_speed_does_not_hide_outliers():
    clean = problem(3, images=40)
    wrong = np.arange(40) % 8 == 3
    points = clean.measurements * jnp.array([1.0, 0.92]) - jnp.array([0.0, 5.0])
    points = points.at[wrong, 1].add(12.0)
    spoilt = replace(clean, measurements=points, face_offset=jnp.array(5.0))
    model = rigid_model((*RIGID, "sound-speed"))
    found = jax.jit(lambda data: find_consensus(data, model))(spoilt)
    np.testing.assert_array_equal(found, ~wrong)


@pytest.mark.slow
def test_few_or_hopeless_images_are_all_kept(consensus):
    _, spoilt, _ = batch(0.2, "mixed", 2)
    few = jnp.zeros_like(spoilt.mask).at[:, :7].set(1.0)
    np.testing.assert_array_equal(consensus(replace(spoilt, mask=few)), few)
    nan = replace(spoilt, poses=spoilt.poses.at[0].set(jnp.nan))
    found = consensus(nan)
    np.testing.assert_array_equal(found[0], spoilt.mask[0])
    np.testing.assert_array_equal(found[1], consensus(spoilt)[1])


@pytest.mark.slow
def test_robust_solve_is_that_of_the_good_images():
    _, spoilt, outlier = batch(0.3, "mixed", 2, elevation_mm=1.0, noise_mm=0.5)
    robust = jaxcal.calibrate_batch(spoilt, "conventional", robust=True)
    oracle = jaxcal.calibrate_batch(replace(spoilt, mask=1 - outlier), "conventional")
    np.testing.assert_array_equal(robust.outlier, outlier)
    np.testing.assert_allclose(robust.image_to_probe, oracle.image_to_probe, atol=1e-9)
    np.testing.assert_array_equal(robust.mask, 1 - outlier)
    first = jax.tree.map(lambda leaf: leaf[0], robust)
    named = np.flatnonzero(outlier[0]).tolist()
    assert outliers(first) == named
    reasons = outlier_reasons(first)
    assert [reason["image"] for reason in reasons] == named
    assert all(abs(reason["sds"] or 0) > 6 and reason["left_out"] for reason in reasons)
    assert any("left out 15 of 50 images" in text for text in first.warnings)


@pytest.mark.slow
def test_a_wrong_echo_is_told_by_its_range():
    data = problem(0, images=50, elevation_mm=0.5, noise_mm=0.5)
    spoilt = replace(data, measurements=data.measurements.at[7, 1].add(40.0))
    plain = jaxcal.calibrate(spoilt, "conventional", robust=False)
    robust = jaxcal.calibrate(spoilt, "conventional", robust=True)
    reason = outlier_reasons(robust)
    assert [(r["image"], r["component"], r["left_out"]) for r in reason] == [(7, "range", True)]
    assert (reason[0]["sds"] or 0) < -100
    assert robust.status == "converged"
    assert float(robust.rms) < 0.2 * float(plain.rms)
    assert 7 in outliers(plain)
    assert any("--robust" in text for text in plain.warnings)


@pytest.mark.slow
def test_command_line(tmp_path, capsys):
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=50), 3)
    points = recording.calibration.measurements.copy()
    points[4] += [30.0, 25.0]
    images = replace(recording.calibration, measurements=points)
    path = tmp_path / "spoilt.h5"
    jaxcal.save(replace(recording, calibration=images), path)
    arguments = ["calibrate", str(path), "--method", "conventional", "--robust", "--json"]
    assert main(arguments) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["robust"]
    assert record["outliers"] == [4]
    assert record["images"] == 50
    assert record["images_used"] == 49
    assert record["outlier_reasons"][0]["image"] == 4


@pytest.mark.slow
def test_of_clean_images_hardly_any_is_left_out(consensus):
    """Then the robust answer is the plain one; medians alone would leave out one in 200 of few."""
    left_out = images = 0
    for law in ("uniform", "normal"):
        clean = jaxcal.stack([
            problem(seed, images=12, elevation_mm=2.0, noise_mm=2.0, elevation_distribution=law)
            for seed in range(64)
        ])  # fmt: skip
        left_out += np.sum(np.asarray(consensus(clean)) == 0)
        images += clean.mask.size
    assert left_out <= images / 1500


@pytest.mark.slow
def test_a_third_of_a_dozen_images(consensus):
    clean = jaxcal.stack([problem(seed, images=12, noise_mm=1.0) for seed in range(64)])
    keys = jax.random.split(jax.random.key(5), 64)
    spoilt, outlier = jax.vmap(lambda k, p: contaminate(k, p, 0.3, "mixed"))(keys, clean)
    found = consensus(spoilt)
    wrong = np.any(np.asarray(found) != 1 - np.asarray(outlier), axis=1)
    assert wrong.sum() <= 1


@pytest.mark.slow
def test_one_problem_leaves_out_what_a_batch_does():
    clean, spoilt, outlier = batch(0.2, "slip", 1, elevation_mm=1.0, noise_mm=0.5)
    clean, spoilt = (jax.tree.map(lambda leaf: leaf[0], tree) for tree in (clean, spoilt))
    good = outlier[0] == 0
    found = jaxcal.calibrate(spoilt, "conventional", robust=True)
    np.testing.assert_array_equal(found.mask, good)
    assert np.all(jaxcal.calibrate(spoilt, "conventional").mask == 1)
    traced = jax.jit(lambda p: jaxcal.calibrate(p, "conventional", robust=True))(spoilt)
    np.testing.assert_array_equal(traced.mask, good)
    np.testing.assert_allclose(traced.image_to_probe, found.image_to_probe, atol=1e-9)
    robust, plain = (jaxcal.calibrate(clean, "conventional", robust=r) for r in (True, False))
    np.testing.assert_allclose(robust.image_to_probe, plain.image_to_probe, atol=1e-9)


def test_consensus_calls_no_lapack(consensus):
    _, spoilt, _ = batch(0.1, "mixed")
    assert "lapack" not in consensus.lower(spoilt).as_text()


def test_nan_in_an_image_left_out_hides_no_outlier():
    """Then no outlier was found at all. Other images left out hold harmless values."""
    data = problem(3, images=12, noise_mm=0.1)
    points, poses = np.array(data.measurements), np.array(data.poses)
    points[3] += 25.0
    mask = (np.arange(12) != 11).astype(float)
    found = []
    for instead in (1.0, np.nan):
        points[11], poses[11, :3] = instead, instead * poses[0, :3]
        spoilt = replace(data, measurements=points, poses=poses.copy(), mask=mask)
        found.append(jaxcal.calibrate(spoilt, "conventional", robust=True))
        np.testing.assert_array_equal(np.flatnonzero(found[-1].outlier), [3])
        points = points.copy()
    np.testing.assert_array_equal(found[0].image_to_probe, found[1].image_to_probe)


def test_masked_images_of_a_long_recording_are_not_searched():
    clean = problem(3, images=400)
    mask = np.zeros(400)
    mask[::10] = 1.0
    used, searched = _to_search(replace(clean, mask=mask).points_only())
    assert used.tolist() == list(range(0, 400, 10))
    assert searched.images == 64
    assert (searched.measurements[:40] == np.asarray(clean.measurements)[::10]).all()
    assert np.asarray(searched.mask).tolist() == [1.0] * 40 + [0.0] * 24
