"""The noise model is doubted where it is wrong, and hardly ever where it is right."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import problem
from scipy import stats

import jaxcal
from jaxcal.diagnostics.image_errors import ImageErrors, Unknowns, quadratic
from jaxcal.diagnostics.misfits import MISFIT_SCORE, noise_model
from jaxcal.diagnostics.outliers import suspects
from jaxcal.diagnostics.residual_checks import check_noise_model, kurtosis_score, skewness_score
from jaxcal.diagnostics.sd_by_place import relative_sd
from jaxcal.diagnostics.uncertainty import inverses
from jaxcal.model.batch import ImagePlanes, Iterate
from jaxcal.model.observations import Points
from jaxcal.model.parameters import Parameters
from jaxcal.model.residuals import target_in_image
from jaxcal.model.unknowns import RIGID
from jaxcal.result.diagnostics import MISFITS
from jaxcal.solvers.levenberg_marquardt import minimise

SIGMA = np.array([0.4, 0.3, 1.0])


@pytest.mark.parametrize("count", [20.0, 60.0, 300.0])
def test_two_groups_have_light_tails_and_not_heavy_ones(count):
    """Beyond the range of the transformation its sign would turn."""
    scores = kurtosis_score(np.array([1.0, 1.2, 2.9, 6.0]), np.full(4, count))
    assert (scores[:2] < -4).all()
    assert scores[3] > 2 > scores[2]


@pytest.mark.parametrize("count", [20, 54, 300])
def test_scores_are_those_of_scipy(count):
    values = np.random.default_rng(count).standard_t(5, (4, count))
    kurtosis = stats.kurtosis(values, axis=1, fisher=False)
    many = np.full(4, float(count))
    np.testing.assert_allclose(
        kurtosis_score(kurtosis, many), stats.kurtosistest(values, axis=1).statistic, rtol=1e-9
    )
    np.testing.assert_allclose(
        skewness_score(stats.skew(values, axis=1), many),
        stats.skewtest(values, axis=1).statistic,
        rtol=1e-9,
    )


@pytest.fixture(scope="module")
def scores():
    """From (draws, n, 3) errors in SDs to the scores of a fit, on one geometry of 40 images."""
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=40), 0)
    assert recording.truth is not None
    base = replace(jaxcal.Problem.from_recording(recording), covariance=None)
    x, point = recording.truth.image_to_probe, recording.truth.point
    truth = Parameters.of(*map(jnp.asarray, (x[:3, :3], x[:3, 3], point)))
    q = np.asarray(jax.jit(target_in_image)(truth, base))
    elevational = np.asarray(base.poses)[:, :3, :3] @ x[:3, 1]

    def drawn(errors):
        errors = errors * SIGMA
        # Moving the probe along its own elevational axis offsets the target by as much.
        offset = errors[:, 2]
        poses = base.poses.at[:, :3, 3].add(-(offset - q[:, 1])[:, None] * elevational)
        points = jnp.stack([q[:, 0], jnp.hypot(offset, q[:, 2])], axis=1) + errors[:, :2]
        return truth, replace(base, poses=poses, measurements=points)

    @jax.jit
    def fit(errors):
        start, data = jax.vmap(drawn)(errors)
        images, sigma = ImagePlanes.of(data), jnp.tile(SIGMA[:, None], len(errors))
        return minimise(Iterate.of(start, RIGID), Points(sigma), images).iterate.parameters(), data

    def run(errors):
        parameters, data = jax.tree.map(np.asarray, fit(errors))
        unknowns = Unknowns(parameters.rotation, parameters.translation, parameters.point)
        seen = ImageErrors.of(unknowns, data, RIGID)
        rows = (seen.rows / SIGMA[:, None]).reshape(len(errors), -1, 9)
        inverse = inverses(np.swapaxes(rows, 1, 2) @ rows, np.finfo(float).eps)
        leverage = quadratic(rows, inverse).reshape(seen.errors.shape)
        standardised = seen.errors / SIGMA / np.sqrt(np.maximum(1 - leverage, 0.05))
        return check_noise_model(standardised, seen.distance, seen.mask)

    return run, np.asarray(q[:, 2])


def test_few_false_alarms_and_true_ones(scores):
    run, depth = scores
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(200, 40, 3))
    _, misfit = run(normal)
    limit = MISFIT_SCORE
    alarms = (np.abs(misfit) > limit).any(axis=(1, 2))
    # 1.2 % expected: more than 9 of 200 in one of a thousand such tests.
    assert alarms.sum() <= 9
    # Standard normal scores have a spread of one.
    assert (np.abs(np.asarray(misfit).std(axis=0) - 1) < 0.25).all()

    heavy = normal.copy()
    heavy[..., 2] = rng.standard_t(2.0, (200, 40))
    grown = normal * np.where(np.arange(3) == 0, (depth / 30)[:, None] ** 1.5, 1.0)
    drifting = normal.copy()
    for image in range(1, 40):
        drifting[:, image, 1] += 0.85 * drifting[:, image - 1, 1]
    for errors, name, column in ((heavy, "tails", 2), (grown, "depth", 0), (drifting, "drift", 1)):
        _, misfit = run(errors)
        found = np.asarray(misfit)[:, MISFITS.index(name), column] > limit
        assert found.mean() > 0.35, name


def test_range_errors_are_judged_by_those_at_their_place():
    """Three wrong images stand out in the middle, while the large errors of corners do not."""
    rng = np.random.default_rng(4)
    problems, count = 40, 200
    x, z = rng.uniform(-25, 25, (problems, count)), rng.uniform(15, 80, (problems, count))
    sd = np.exp(0.8 * (z / 50 - 1) + 0.8 * (x / 25) ** 2)
    errors = sd * rng.normal(size=(problems, count))
    wrong = slice(0, 3)
    x[:, wrong], z[:, wrong], errors[:, wrong] = 0.0, 40.0, 6.0
    places = np.stack([x, np.zeros_like(x), z], axis=-1)

    def in_robust_sds(errors):
        return errors / (1.4826 * np.median(np.abs(errors), axis=1, keepdims=True))

    before = in_robust_sds(errors)
    after = in_robust_sds(errors / relative_sd(places, before, np.ones_like(errors)))
    # The largest of 197 Gaussian errors exceeds 4.1 SDs in 0.8 % of the recordings.
    assert (np.abs(before[:, 3:]).max(axis=1) > 4.1).mean() > 0.4
    assert (np.abs(after[:, 3:]).max(axis=1) > 4.1).mean() < 0.1
    assert (after[:, wrong] > 4.1).mean() > 0.9


def test_an_image_whose_range_is_off_is_a_suspect():
    data = problem(3, images=50, elevation_mm=1.0, noise_mm=1.0)
    clean = jaxcal.calibrate(data, "conventional")
    assert suspects(clean) == []
    # In the middle of the image, where errors are small.
    place = np.asarray(data.measurements)
    middle = int(np.argmin(np.abs(place[:, 0]) + np.abs(place[:, 1] - 50.0)))
    sd = 1.4826 * np.median(np.abs(np.asarray(clean.residual)[:, 2]))
    off = replace(data, measurements=data.measurements.at[middle, 1].add(-6 * sd))
    result = jaxcal.calibrate(off, "conventional")
    found = suspects(result)
    assert [each["image"] for each in found] == [middle]
    assert found[0]["component"] == "range"
    # The figures mark whom the verdict names.
    ring = result.plot_residuals().axes[1].lines[-1]
    np.testing.assert_array_equal(ring.get_xdata(), [middle])
    assert "or suspicious" in str(ring.get_label())


def test_images_that_are_as_noisy_as_their_covariances_say_are_no_outliers():
    """Every third image is ten times as noisy; a wrong click is still named."""
    data = problem(5, images=50, elevation_mm=0.5, noise_mm=0.5)
    noisy = np.arange(50) % 3 == 0
    sd = np.where(noisy, 10.0, 1.0)[:, None] * np.array([0.2, 0.1])
    points = np.array(data.measurements) + sd * np.random.default_rng(5).normal(size=(50, 2))
    covariance = jnp.asarray(sd[:, :, None] ** 2 * np.eye(2))
    data = replace(data, measurements=jnp.asarray(points))
    # With common SDs nothing is known of them, and some stand out.
    common = jaxcal.calibrate(data)
    assert np.asarray(common.outlier)[noisy].sum() > 2
    # The same numbers as given SDs, in metres by mistake.
    for unit, told in ((1.0, ""), (1e-3, "times the given SDs, so that covariance and")):
        given = replace(common, sigma=unit * common.sigma, sigma_tuned=jnp.asarray(False))
        assert told in " ".join(given.warnings)
        assert ("are the SDs in mm?" in " ".join(given.warnings)) == bool(told)
    found = jaxcal.calibrate(replace(data, covariance=covariance))
    assert found.offset_law is not None
    assert float(found.offset_law.own_probability) > 0.9
    assert not np.asarray(found.outlier).any()
    points[7, 0] += 5.0
    wrong = replace(data, measurements=jnp.asarray(points), covariance=covariance)
    found = jaxcal.calibrate(wrong, prior="gaussian")
    assert np.flatnonzero(np.asarray(found.outlier)).tolist() == [7]


def test_given_sds_in_metres_are_told_even_of_few_images():
    data = problem(5, images=6, elevation_mm=0.5, noise_mm=0.5)
    result = jaxcal.calibrate(data, sigma=(0.2, 0.1, 0.5))
    for unit, told in ((1.0, False), (1e-3, True)):
        given = replace(result, sigma=unit * result.sigma)
        assert ("are the SDs in mm?" in " ".join(given.warnings)) == told
        # The tracker's SD explains errors as well.
        lines = replace(result.linearisation, tracker_sd=jnp.asarray(0.5))
        tracked = replace(given, linearisation=lines)
        assert "are the SDs in mm?" not in " ".join(tracked.warnings)


def test_complaints_are_warnings_in_words():
    data = problem(1, images=40, elevation_mm=1.0, noise_mm=0.5)
    result = jaxcal.calibrate(data, "conventional")
    assert not [text for text in result.warnings if "heavier tails" in text]
    wild = replace(data, measurements=data.measurements.at[5, 1].add(3.0))
    spoilt = jaxcal.calibrate(wild, "conventional")
    assert any(
        "noise model: the range errors have heavier tails" in text for text in spoilt.warnings
    )
    careless = "errors within the image of"
    assert not any(careless in text for text in result.warnings)
    noise = 3.0 * np.random.default_rng(1).normal(size=(40, 2))
    noisy = replace(data, measurements=data.measurements + noise)
    assert any(careless in text for text in jaxcal.calibrate(noisy, "conventional").warnings)
    few = jaxcal.calibrate(replace(data, mask=data.mask.at[12:].set(0.0)), "conventional")
    assert not few.inspection.misfit.any()
    assert not noise_model(few)["checked"]
