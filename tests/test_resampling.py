"""Cross-validation and bootstrap against doing it by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import experiment, problem, select
from oracle.model import Data, Unknowns, errors
from scipy.stats import multivariate_normal, norm

import jaxcal
from jaxcal.calibration import resampling
from jaxcal.calibration.resampling import (
    _compared,
    _from_full_image,
    _placed,
    _scatter,
    _used,
    _with_rows,
    bootstrap,
    cross_validate,
    relative_twist,
)
from jaxcal.cli.main import main
from jaxcal.data.sound import WATER_M_S
from jaxcal.diagnostics import metrics
from jaxcal.model.distributions import FAMILIES, OffsetLaw
from jaxcal.model.image_points import rms_distance, stretched
from jaxcal.result.calibration import Medium
from jaxcal.runtime.arrays import map_arrays

CONVENTIONAL: dict[str, Any] = {"method": "conventional"}
COUNT = 20
"""Of images in a problem and of calibrations in a batch: all tests share two programs."""


@pytest.fixture(scope="module")
def data() -> jaxcal.Problem:
    return problem(2, images=COUNT, elevation_mm=1.0, noise_mm=1.0)


@pytest.fixture(scope="module")
def whole(data) -> jaxcal.Calibration:
    return jaxcal.calibrate(data, **CONVENTIONAL)


@pytest.mark.slow
def test_holding_out_an_image_is_calibrating_without_it(data, whole):
    found = cross_validate(data, result=whole, **CONVENTIONAL)
    without = jaxcal.calibrate(replace(data, mask=data.mask.at[7].set(0.0)), **CONVENTIONAL)
    np.testing.assert_allclose(found.image_to_probe[7], without.image_to_probe, atol=1e-9)
    there = metrics.reconstruct(without.image_to_probe, data.poses[7:8], data.measurements[7:8])
    np.testing.assert_allclose(found.cloud[7], there[0] - without.point, atol=1e-9)
    twist = relative_twist(whole.image_to_probe, without.image_to_probe)
    np.testing.assert_allclose(found.moved[7], twist, atol=1e-9)
    squared = twist @ jnp.asarray(np.linalg.solve(whole.covariance, twist))
    assert float(found.influence[7]) == pytest.approx(float(np.sqrt(squared / 6)), rel=1e-6)
    # What was not seen fits worse than what was.
    assert float(found.rms) > float(whole.rms)
    assert np.asarray(found.converged).all()


@pytest.mark.slow
def test_a_problem_of_numpy_arrays_where_64_bits_are_off():
    with jax.enable_x64(False):
        there = problem(2, images=COUNT)
        assert isinstance(there.poses, np.ndarray)
        found = cross_validate(there, **CONVENTIONAL)
    assert found.converged.all()
    assert 0 < float(found.precision) < 10


def test_a_bad_image_has_the_most_influence(data):
    spoilt = replace(data, measurements=data.measurements.at[4].add(jnp.asarray([6.0, 4.0])))
    found = cross_validate(spoilt, **CONVENTIONAL)
    assert int(np.argmax(found.influence)) == 4
    assert float(found.influence[4]) > 3 * float(np.median(found.influence))


def test_many_images_are_held_out_several_at_a_time(data, whole, monkeypatch):
    monkeypatch.setattr(resampling, "MOST_FOLDS", COUNT - 1)
    found = cross_validate(data, result=whole, **CONVENTIONAL)
    assert found.converged.all()
    assert found.converged.dtype == bool
    assert found.converged.shape == (COUNT - 1,)
    np.testing.assert_array_equal(found.moved[0], found.moved[COUNT - 1])


def test_a_calibration_by_another_method_is_refused(data, whole):
    """Compared with the folds, it would be taken for the influence of the images.

    At once: 100,000 resamples would take long.
    """
    other = replace(whole, method="alternating", prior="bounded")
    with pytest.raises(jaxcal.InputError, match=r"has method 'alternating'.* for 'conventional'"):
        cross_validate(data, folds=4, result=other, **CONVENTIONAL)
    with pytest.raises(jaxcal.InputError, match=r"has method 'alternating'.* for 'conventional'"):
        bootstrap(data, 100_000, result=other, **CONVENTIONAL)


def test_images_in_use_are_dealt_to_the_folds(data):
    """Dealt by their places, every third image would all come into one fold."""
    third = replace(data, mask=(jnp.arange(COUNT) % 3 == 0).astype(float))
    used = np.flatnonzero(third.mask)
    found = cross_validate(third, folds=3, **CONVENTIONAL)
    assert np.asarray(found.converged).tolist() == [1, 1, 1]
    assert len(np.unique(np.round(found.image_to_probe, 9), axis=0)) == 3
    moved = np.asarray(found.image_moved)
    for fold in range(3):
        together = moved[used[fold::3]]
        np.testing.assert_array_equal(together, together[0])
    assert len(cross_validate(third, **CONVENTIONAL).converged) == len(used)
    with pytest.raises(jaxcal.InputError, match="folds must be between 2 and 7, not 8"):
        cross_validate(third, folds=8, **CONVENTIONAL)


@pytest.mark.slow
def test_folds_and_masked_images(data):
    masked = replace(data, mask=data.mask.at[3].set(0.0))
    found = cross_validate(masked, folds=5, **CONVENTIONAL)
    assert found.image_to_probe.shape == (5, 4, 4)
    for name in ("residual", "cloud", "log_density", "moved"):
        assert not np.asarray(getattr(found, name))[3].any()
    with pytest.raises(jaxcal.InputError, match="folds must be between 2 and"):
        cross_validate(data, folds=1)
    few = select(data, slice(0, 4))
    with pytest.raises(jaxcal.InputError, match="leaves 3 images"):
        cross_validate(few, **CONVENTIONAL)


def test_bootstrap_scatters_as_the_covariance_says(data, whole):
    # Ten times 20 draws scatter about as one time 200.
    many = [bootstrap(data, COUNT, key, result=whole, **CONVENTIONAL) for key in range(10)]
    predicted = np.sqrt(np.diagonal(whole.covariance))
    ratio = np.mean([found.spread for found in many], axis=0) / predicted
    assert ((ratio > 0.4) & (ratio < 2.0)).all()
    found, other = many[5], many[6]
    assert not np.array_equal(found.image_to_probe, other.image_to_probe)
    again = bootstrap(data, COUNT, 5, result=whole, **CONVENTIONAL)
    np.testing.assert_array_equal(found.image_to_probe, again.image_to_probe)
    assert found.reproducibility.shape == (5,)
    # The middle of the field is known better than its corners.
    assert float(found.reproducibility[4]) < float(np.max(found.reproducibility))


def test_an_images_bound_is_drawn_with_it(data, whole):
    """As the bounds in the problem are: that of a pose is the mean of its images' bounds."""
    poses, measurements = (
        values.at[11].set(values[12]) for values in (data.poses, data.measurements)
    )
    data = replace(data, poses=poses, measurements=measurements)
    bound = jnp.linspace(0.2, 4.0, COUNT).at[12].set(0.0)
    asked: dict[str, Any] = {"method": "alternating"}
    # Of the calibration of all images only the mask matters here.
    mask = np.where(np.arange(COUNT) == 11, 0.0, 1.0)
    result = replace(whole, method="alternating", prior="bounded", mask=mask)
    given = bootstrap(data, 2, **asked, result=result, max_elevation=bound)
    held = bootstrap(replace(data, max_elevation=bound), 2, **asked, result=result)
    np.testing.assert_array_equal(given.image_to_probe, held.image_to_probe)


def test_a_pixel_has_other_places_in_the_images_of_other_calibrations(data):
    """Pixel sizes stretch what lies above row 0 of the image, but not the range of row 0."""
    pixels = np.asarray(data.measurements - jnp.array([0.0, 4.0])) / [0.12, 0.1]
    images = jaxcal.make_images(
        np.asarray(data.poses), pixels, "pixel", spacing_mm=(0.12, 0.1), face_offset_mm=4.0
    )
    whole, other = (
        jaxcal.calibrate(
            jaxcal.Problem.from_recording(replace(images, mask=np.arange(COUNT) >= first)),
            method="conventional",
            estimate="scale",
        )
        for first in (0, 8)
    )
    assert whole.problem is not None
    # As if the sound speed and the delay had been estimated, too.
    medium = Medium(sound_speed_m_s=np.array(1.02 * WATER_M_S), delay_s=np.array(1e-6))
    unknown = np.full((11, 11), np.nan)
    slower = replace(other, medium=medium, unknowns_covariance=unknown)
    ends = pixels[[0, 5]]
    lateral, axial = (ends * np.asarray(whole.scale_mm_per_px) + [0.0, 4.0]).T
    places = np.stack([lateral, 0 * lateral, axial, 1 + 0 * axial])
    for fit in (other, slower):
        fits = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], replace(fit, problem=None))
        found = _from_full_image(fits, whole, whole.problem)
        expected = fit.apply(ends).points
        np.testing.assert_allclose((found[0] @ places).T[:, :3], expected, atol=1e-9)
    first, second = (np.asarray(fit.image_to_probe) for fit in (whole, other))
    stretch = np.asarray(other.scale_mm_per_px) / np.asarray(whole.scale_mm_per_px)
    away = other.apply(ends).points - whole.apply(ends).points
    apart = np.sqrt(np.mean(np.sum(away**2, axis=1)))
    second = stretched(second, *stretch, (1 - stretch[1]) * 4.0)
    assert rms_distance(second, first, places[[0, 2]].T) == pytest.approx(apart, rel=1e-9)


def test_log_density_has_the_trackers_errors_in_it(data, whole):
    sigma, tau, fold = np.array([0.3, 0.2, 1.0]), 0.5, np.arange(COUNT) % 2
    each = [
        jaxcal.calibrate(replace(data, mask=jnp.asarray(fold != k, float)), **CONVENTIONAL)
        for k in range(2)
    ]
    fits = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    tracked = replace(fits.linearisation, tracker_sd=jnp.full(2, tau))
    fits = replace(fits, sigma=jnp.tile(sigma, (2, 1)), linearisation=tracked)
    found = _compared(data, whole, fits, jnp.asarray(fold))
    poses, x = np.asarray(data.poses), np.asarray(fits.image_to_probe)
    for k in range(2):
        held = Data(
            poses[fold == k, :3, :3],
            poses[fold == k, :3, 3],
            np.asarray(data.measurements)[fold == k],
            np.ones(2),
        )
        there = Unknowns(x[k, :3, :3], x[k, :3, 3], np.asarray(fits.point)[k], np.ones(2))
        expected = norm.logpdf(errors(held, there), scale=np.hypot(sigma, tau)).sum(axis=1)
        np.testing.assert_allclose(found.log_density[fold == k], expected, rtol=1e-9)


def test_many_calibrations_are_solved_in_batches(data, whole, monkeypatch):
    """Draws are the same in batches of any size, and no batch has more images than is set."""
    asked, solve = [], resampling.calibrate_batch

    def noted(problems, **arguments):
        asked.append(problems.mask.shape)
        return solve(problems, **arguments)

    monkeypatch.setattr(resampling, "calibrate_batch", noted)
    once = bootstrap(data, COUNT, result=whole, **CONVENTIONAL)
    monkeypatch.setattr(resampling, "MOST_TOGETHER", COUNT * COUNT)
    twice = bootstrap(data, 2 * COUNT, result=whole, **CONVENTIONAL)
    assert asked == 3 * [(COUNT, COUNT)]
    np.testing.assert_array_equal(twice.image_to_probe[:COUNT], once.image_to_probe)
    assert len(np.unique(twice.image_to_probe, axis=0)) == 2 * COUNT


def test_held_out_images_take_memory_by_their_number(data, whole):
    """With two folds no array is as large as the square of the number of images."""
    images = 16 * COUNT

    def longer(leaf):
        axes = [axis for axis, size in enumerate(leaf.shape) if size == COUNT]
        return jnp.repeat(leaf, 16, axes[0]) if axes else leaf

    data, whole = (jax.tree.map(longer, each) for each in (data, whole))
    fits = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), whole)
    traced = jax.make_jaxpr(_compared)(data, whole, fits, jnp.arange(images) % 2)
    programs, found = [traced.jaxpr], []
    while programs:
        for equation in programs.pop().eqns:
            found += [np.prod(out.aval.shape) for out in equation.outvars]
            programs += [each.jaxpr for each in equation.params.values() if hasattr(each, "jaxpr")]
    assert images * 16 <= max(found) < images**2


def test_log_density_is_that_of_the_noise_model(data, whole):
    """With the images' own covariances and the mean of the offsets, where these were found."""
    sigma, tau, fold = np.array([0.3, 0.2, 1.0]), 0.5, np.arange(COUNT) % 2
    mean = np.array([0.4, -0.3])
    each = np.array([[4.0, 1.0], [1.0, 2.0]]) * np.geomspace(0.1, 10, COUNT)[:, None, None]
    data = replace(data, covariance=jnp.asarray(each))
    fits = jax.tree.map(
        lambda *leaves: jnp.stack(leaves),
        *(replace(whole, mask=np.asarray(fold != k, float)) for k in range(2)),
    )
    one = jnp.ones(2)
    law = OffsetLaw(
        jnp.ones((2, len(FAMILIES))), jnp.asarray(mean), one, one, one, 0.9 * one, one > 0
    )
    tracked = replace(fits.linearisation, tracker_sd=jnp.full(2, tau))
    sigmas = jnp.tile(sigma, (2, 1))
    fits = replace(fits, prior="auto", sigma=sigmas, offset_law=law, linearisation=tracked)
    found = _compared(data, whole, fits, jnp.asarray(fold))
    for image, error in enumerate(np.asarray(found.residual)):
        rest = each[fold != fold[image]].mean(axis=0)
        size = sigma[:2] / np.sqrt(np.diagonal(rest))
        seen = each[image] * np.outer(size, size) + tau**2 * np.eye(2)
        expected = multivariate_normal.logpdf(error[:2], cov=seen)
        expected += norm.logpdf(error[2], mean[fold[image]], np.hypot(sigma[2], tau))
        assert float(found.log_density[image]) == pytest.approx(expected, rel=1e-9)


def test_beside_the_calibrations_nothing_is_compiled(data, whole):
    """Of eight programs or more, each new number of images, folds or resamples needed all anew."""
    compiled = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        compiled.extend([event] * ("backend_compile" in event))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        used, _ = _used(data, whole)
        rows = np.arange(3 * COUNT).reshape(3, COUNT) % 7
        drawn = _placed(_with_rows(used, rows, np.ones((3, COUNT))), data)
        fits = map_arrays(lambda leaf: np.stack([leaf] * 3), replace(whole, problem=None))
        seen = _compared(used, whole, replace(fits, problem=None), np.arange(COUNT) % 3)
        scatter = _scatter(used, whole, fits, np.ones(3, bool))
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert compiled == []
    np.testing.assert_array_equal(drawn.poses[2], np.asarray(data.poses)[rows[2]])
    assert float(seen.rms) == pytest.approx(float(whole.rms), rel=1e-9)
    assert not np.any(seen.moved)
    assert not scatter.spread.any()


def test_bootstrap_draws_used_images_only(data):
    half = replace(data, mask=data.mask.at[10:].set(0.0))
    wild = replace(half, measurements=half.measurements.at[10:].set(1e4))
    one = bootstrap(half, COUNT, 1, **CONVENTIONAL)
    two = bootstrap(wild, COUNT, 1, **CONVENTIONAL)
    np.testing.assert_allclose(one.image_to_probe, two.image_to_probe, atol=1e-9)
    with pytest.raises(jaxcal.InputError, match="resamples must be between"):
        bootstrap(data, 1)


def test_bootstrap_counts_draws_that_determine_a_calibration(data, whole):
    """Three different images are fitted perfectly, hundreds of mm from the truth."""
    six = replace(data, mask=data.mask.at[6:].set(0.0))
    found = bootstrap(six, COUNT, result=replace(whole, mask=six.mask), **CONVENTIONAL)
    keys = jax.vmap(lambda k: jax.random.fold_in(jax.random.key(0), k))(np.arange(COUNT))
    chosen = (6 * jax.vmap(lambda key: jax.random.uniform(key, (COUNT,)))(keys)[:, :6]).astype(int)
    different = np.array([len(set(row)) for row in np.asarray(chosen).tolist()])
    used = np.asarray(found.converged) > 0
    assert 0 < np.sum(different < 4) < COUNT
    np.testing.assert_array_equal(used, different >= 4)
    expected = metrics.calibration_reproducibility(found.image_to_probe[used], found.image_points)
    np.testing.assert_allclose(found.reproducibility, expected, rtol=1e-9)
    points = np.insert(found.image_points, 1, 0.0, axis=1)
    transforms = np.asarray(found.image_to_probe)[used][:, None]
    placed = (transforms[..., :3, :3] @ points[..., None])[..., 0] + transforms[..., :3, 3]
    expected = np.sqrt(np.sum(np.var(placed, axis=0), axis=1))
    np.testing.assert_allclose(found.rms_scatter, expected, rtol=1e-9)
    assert (found.rms_scatter > found.reproducibility).all()
    four = replace(data, mask=data.mask.at[4:].set(0.0))
    with pytest.raises(jaxcal.InputError, match="a bootstrap needs more than 4 images"):
        bootstrap(four, COUNT, **CONVENTIONAL)


@pytest.mark.slow
def test_command_line_shows_both(tmp_path, capsys):
    path = tmp_path / "rec.h5"
    jaxcal.save(experiment(3, images=COUNT), path)
    arguments = ["calibrate", str(path), "--method", "conventional", "--cross-validate",
                 "--bootstrap", str(COUNT)]  # fmt: skip
    assert main([*arguments, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["cross_validation"]["folds"] == 20
    assert record["cross_validation"]["precision_mm"] > 0
    assert len(record["cross_validation"]["influence"]) == 20
    assert record["bootstrap"]["resamples"] == COUNT
    assert len(record["bootstrap"]["reproducibility_mm"]) == 5
    assert main(arguments) == 0
    # A line may end at a hyphen.
    page = " ".join(capsys.readouterr().out.split()).replace("- ", "-")
    assert "20-fold cross-validation" in page
    assert "In 20 bootstrap calibrations" in page
