"""How accurate: TRE with its interval, what each image and error does to it, and the verdict."""

from __future__ import annotations

import copy
import itertools
import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import experiment
from rich.console import Console

import jaxcal
from jaxcal import design
from jaxcal.calibration.resampling import relative_twist
from jaxcal.cli import plan
from jaxcal.cli.main import main
from jaxcal.data.poses import targets_in_images
from jaxcal.data.recording import Recording, make_images
from jaxcal.diagnostics import influence as influences
from jaxcal.diagnostics.influence import excess, in_image, influence_of
from jaxcal.diagnostics.intervals import (
    error_covariance,
    image_jacobian,
    length_quantile,
    tre_at,
    tre_over,
)
from jaxcal.model.image_points import point_jacobian
from jaxcal.model.unknowns import (
    FURTHER,
    TABLE,
    count_unknowns,
    further_derivatives,
    measured,
    stepped,
)
from jaxcal.report.accuracy import FAIR_MM, GOOD_MM, region_of, settle
from jaxcal.report.contradictions import _explanation
from jaxcal.report.in_memory import record_of, recording_of
from jaxcal.report.next_poses import next_poses_record, next_poses_sentences, pose_records
from jaxcal.report.record import _precision, calibration_record
from jaxcal.report.resampled import resampled_sentences
from jaxcal.report.tables import calibration_table
from jaxcal.report.verdict import certainty, headline, limits, verdict
from jaxcal.result.calibration import Status
from jaxcal.result.saved import load_calibration
from jaxcal.result.transform import ImageTransform
from jaxcal.runtime.arrays import batch_of_one
from jaxcal.solvers.closed_form.calibrate import calibrate_closed_form

POINTS = np.array([[5.0, 30.0], [55.0, 80.0], [30.0, 50.0]])


def in_pixels(recording: Recording) -> Recording:
    """The same with pixels of unknown size, the corner of the image at (0, 0)."""
    images = recording.calibration
    pixels = (images.measurements + np.array([32.0, 0.0])) / [0.15, 0.12]
    found = make_images(images.poses, pixels, "pixel", mask=images.mask)
    return replace(recording, calibration=found, test=None, truth=None)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return in_pixels(experiment(3, images=24, elevation_mm=1.0))


@pytest.fixture(scope="module")
def result(recording) -> jaxcal.Calibration:
    return jaxcal.calibrate(recording, "conventional", estimate=("scale",))


@pytest.fixture(scope="module")
def record(result, recording):
    return calibration_record(result, recording)


def test_a_saved_calibration_knows_how_certain_its_sds_are(result, tmp_path):
    """Also where SDs that were tuned are the weights: ``apply`` agrees with the predicted TRE."""
    pixels = POINTS / np.asarray(result.scale_mm_per_px)
    tuned = replace(result, prior="gaussian", sigma_tuned=np.asarray(True))
    given = replace(tuned, sigma_tuned=np.asarray(False))
    left = float(result.images_used) - 11 / 3
    for answer, freedom, factor in (
        (result, left, 1.0), (tuned, left, left / (left - 2)), (given, None, 1.0)
    ):  # fmt: skip
        answer.image_transform().save(tmp_path / "cal.json")
        stored = load_calibration(tmp_path / "cal.json")
        assert stored.degrees_of_freedom == freedom
        assert stored.variance_factor == pytest.approx(factor, rel=1e-15)
        sd = np.sqrt(np.trace(stored.apply(pixels).covariance, axis1=1, axis2=2))
        np.testing.assert_allclose(sd, jaxcal.predicted_tre(answer, POINTS), rtol=1e-9)
        record = json.loads((tmp_path / "cal.json").read_text())
        del record["degrees_of_freedom"], record["variance_factor"]
        (tmp_path / "cal.json").write_text(json.dumps(record))
        older = load_calibration(tmp_path / "cal.json")
        assert (older.degrees_of_freedom, older.variance_factor) == (None, 1.0)


@pytest.mark.parametrize(
    ("variances", "freedom"),
    [([1.0, 1.0, 1.0], np.inf), ([1.0, 0.2, 0.01], 9.0), ([4.0, 1.0, 0.3, 0.1, 0.05, 0.01], 20.0)],
)
def test_quantiles_of_an_error_against_draws(variances, freedom):
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(400_000, len(variances))) * np.sqrt(variances)
    length = np.linalg.norm(draws, axis=1)
    if np.isfinite(freedom):
        length = length / np.sqrt(rng.chisquare(freedom, len(length)) / freedom)
    for chance in (0.025, 0.5, 0.975):
        found = length_quantile(np.array([variances]), freedom, chance)[0]
        assert np.mean(length < found) == pytest.approx(chance, abs=0.002)


def test_places_stay_in_the_frame(recording, result):
    """Corners, the map and the places of further images; the answer in memory says the same."""
    recording = replace(recording, probe=None)
    images = recording.calibration
    size = tuple(int(last) + 2 for last in images.measurements.max(axis=0))

    def places(record):
        return np.array([point["image"] for point in record["tre"]["points"]])

    assert (places(calibration_record(result, recording)).max(axis=0) > size).all()
    framed = replace(recording, calibration=replace(images, frame_size=size))
    answer = jaxcal.calibrate(framed, "conventional", estimate=("scale",))
    found = calibration_record(answer, framed)
    last = np.array(size) - 1.0
    np.testing.assert_allclose(places(found).max(axis=0), last)
    assert record_of(answer)["tre"] == found["tre"]
    assert region_of(answer.numpy(), recording_of(answer)) == region_of(answer.numpy(), framed)
    region = design.candidates_around(framed, answer, count=16).constraints.region
    ends = np.array([region.lateral_mm[1], region.depth_mm[1]])
    np.testing.assert_allclose(ends / answer.scale_mm_per_px, last)


@pytest.mark.parametrize("pixels", [True, False])
def test_derivatives_of_an_image_point(pixels):
    """Against differences of where the calibration puts a pixel."""
    blocks = ("translation", "rotation", "point", "scale", "sound-speed", "delay")
    scale, face, k, delay = np.array([0.2, 0.15]), 3.0, 1.02, 0.4
    measured = np.array([[30.0, 200.0], [150.0, 400.0]])
    if not pixels:
        scale, measured = np.ones(2), measured * 0.2

    def placed(step: np.ndarray) -> np.ndarray:
        x = scale[0] * np.exp(step[9]) * measured[:, 0]
        axial = scale[1] * np.exp(step[10]) * measured[:, 1] + face - delay - step[12]
        plane = np.stack([x, 0 * x, k * np.exp(step[11]) * axial], axis=1)
        w = step[3:6]
        turn = np.eye(3) + np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return plane @ turn.T + step[:3]

    points = placed(np.zeros(13))[:, [0, 2]]
    found = point_jacobian(points, blocks, k * (face - delay), k)
    for index, column in enumerate(np.eye(13)):
        difference = (placed(1e-6 * column) - placed(-1e-6 * column)) / 2e-6
        np.testing.assert_allclose(found[..., index], difference, atol=1e-7)


def test_tre_knows_the_pixel_size(result):
    """Draws of all unknowns, put through the pixels: X's covariance alone says something else."""
    rng = np.random.default_rng(1)
    covariance = np.asarray(result.unknowns_covariance) * 1e-4
    steps = rng.multivariate_normal(np.zeros(11), covariance, 20_000)
    stretched = POINTS * np.exp(steps[:, None, 9:])
    plane = np.stack([stretched[..., 0], 0 * stretched[..., 0], stretched[..., 1]], axis=-1)
    there = plane + np.cross(steps[:, None, 3:6], plane) + steps[:, None, :3]
    apart = np.linalg.norm(there - plane[:1] * 0 - np.insert(POINTS, 1, 0.0, axis=1), axis=-1)
    actual = 1e2 * np.sqrt(np.mean(apart**2, axis=0))
    np.testing.assert_allclose(jaxcal.predicted_tre(result, POINTS), actual, rtol=0.02)
    np.testing.assert_allclose(tre_at(result, POINTS).rms, actual, rtol=0.02)
    over = tre_over(result, POINTS)
    assert float(over.rms) == pytest.approx(np.sqrt(np.mean(actual**2)), rel=0.02)
    assert over.lower < over.rms < over.upper


def test_apply_knows_the_pixel_size(result, tmp_path):
    pixels = POINTS / np.asarray(result.scale_mm_per_px)
    applied = result.apply(pixels)
    rotation = np.asarray(result.image_to_probe)[:3, :3]
    expected = rotation @ error_covariance(result.numpy(), POINTS) @ rotation.T
    np.testing.assert_allclose(applied.covariance, expected, rtol=1e-9)
    result.image_transform().save(tmp_path / "cal.json")
    again = load_calibration(tmp_path / "cal.json").apply(pixels)
    np.testing.assert_array_equal(again.covariance, applied.covariance)
    np.testing.assert_array_equal(again.points, applied.points)
    np.testing.assert_allclose(
        (np.column_stack([pixels, 0 * pixels[:, 0], np.ones(3)]) @ result.plus_matrix().T)[:, :3],
        applied.points,
        atol=1e-10,
    )


def test_a_sound_speed_that_was_found_is_applied(tmp_path):
    """Pixels as the machine scales them lie deeper in faster water."""
    found = ImageTransform(
        np.eye(4), np.array([0.2, 0.1]), 3.0, range_factor=1.02,
        unknowns=("translation", "rotation", "sound-speed"), image_covariance=1e-4 * np.eye(7),
    )  # fmt: skip
    assert found.apply(np.array([[10.0, 100.0]])).points[0] == pytest.approx([2.0, 0.0, 13.2])
    assert found.plus_matrix()[2] == pytest.approx([0.0, 0.102, 0.0, 3.0])
    assert found.apply(np.array([[10.0, 100.0]])).covariance[0, 2, 2] == pytest.approx(
        1e-4 * (1 + 2.0**2 + 13.2**2)
    )
    found.save(tmp_path / "cal.json")
    loaded = load_calibration(tmp_path / "cal.json")
    np.testing.assert_array_equal(loaded.plus_matrix(), found.plus_matrix())
    record = json.loads((tmp_path / "cal.json").read_text())
    record["image_unknowns"] = ["nonsense"]
    (tmp_path / "cal.json").write_text(json.dumps(record))
    with pytest.raises(jaxcal.FormatError, match="image_unknowns"):
        load_calibration(tmp_path / "cal.json")


def test_leaving_an_image_out_is_foretold(result):
    # So few that their errors are not examined for a correlation, which would widen the covariance.
    problem = replace(result.problem, mask=(np.arange(result.problem.images) < 19).astype(float))
    result = jaxcal.calibrate(problem, "conventional", estimate=("scale",))
    found = influence_of(result)
    # SDs of errors that are alike along all axes.
    lines = result.linearisation
    sd = np.sqrt(lines.variance * np.diagonal(np.linalg.inv(lines.design)))
    for image in (2, 11):
        mask = np.array(problem.mask)
        mask[image] = 0.0
        without = jaxcal.calibrate(replace(problem, mask=mask), "conventional", estimate=("scale",))
        twist = relative_twist(
            jnp.asarray(result.image_to_probe), jnp.asarray(without.image_to_probe)
        )
        np.testing.assert_allclose(found.moved[image, :6] / sd[:6], twist / sd[:6], atol=0.03)
        grown = np.log(np.asarray(without.scale_mm_per_px) / np.asarray(result.scale_mm_per_px))
        np.testing.assert_allclose(found.moved[image, 9:] / sd[9:], grown / sd[9:], atol=0.03)
    np.testing.assert_allclose(found.model_covariance, result.unknowns_covariance, rtol=1e-6)
    np.testing.assert_allclose(found.shares.sum(axis=0), found.model_covariance, rtol=1e-6)


def test_leaving_out_is_foretold_where_axes_have_errors_of_their_own_size():
    rng = np.random.default_rng(6)
    rows, sizes = rng.normal(size=(9, 3, 4)), np.array([0.2, 1.5, 0.5])
    whole = np.einsum("mkp,mkq->pq", rows, rows)
    squares, chances, answers = [], [], []
    for _ in range(400):
        errors = sizes * rng.normal(size=(9, 3))
        step = -np.linalg.solve(whole, np.einsum("mkp,mk->p", rows, errors))
        seen = influences.WhitenedErrors(errors + rows @ step, rows, np.arange(3), np.zeros(9),
                                         np.ones(9, bool), sizes**2)  # fmt: skip
        found = influences._influence(seen, np.zeros(4), np.zeros(4))
        squares.append(np.sum(found.moved**2, axis=1))
        chances.append(found.log_density.sum())
        answers.append(step)
    expected = np.sum(found.expected**2, axis=(1, 2))
    np.testing.assert_allclose(np.mean(squares, axis=0), expected, rtol=0.25)
    spread = np.diagonal(found.model_covariance)
    np.testing.assert_allclose(np.mean(np.square(answers), axis=0), spread, rtol=0.25)
    # Errors of one size would make these images less probable.
    even = influences._influence(replace(seen, variances=np.ones(3)), np.zeros(4), np.zeros(4))
    assert found.log_density.sum() > even.log_density.sum() + 3


def test_an_image_that_alone_determines_a_direction_does_not_multiply_the_error():
    """Only image 0 rests on its bound. Its leverage is 1, and the alternation stops early."""
    simulated = jaxcal.simulate_recording(jaxcal.Protocol(images=20), 3).calibration
    problem = jaxcal.Problem.from_arrays(simulated.poses, simulated.measurements)
    result = jaxcal.calibrate(problem, "alternating")
    assert np.flatnonzero(result.at_bound).tolist() == [0]
    found = influence_of(result)
    assert np.isnan(found.moved[0]).all()
    assert np.isfinite(found.moved[1:]).all()
    record = result.record()
    assert record["influence"]["moved_mm"][0] is None
    assert 0 not in record["influence"]["most"]
    assert record["tre"]["rms_mm"] == pytest.approx(record["tre"]["stated_mm"])
    # Its offsets fit themselves, so it predicts no image more closely than the conventional fit.
    assert record["comparison"]["log_density_gain"] is None
    assert not any("log density" in line for line in result.verdict())
    assert "<svg" in result._repr_html_()


def sum_of_squares(result, sigma, tracker_sd):
    """Of an answer's errors in SDs; the tracker's variance is the same in all images."""
    data, tau = jax.tree.map(np.asarray, result.problem), tracker_sd or 0.0
    to_image = np.linalg.inv(data.poses @ np.asarray(result.image_to_probe))
    q = (to_image @ np.append(result.point, 1.0))[:, :3]
    y = np.asarray(result.elevation)
    seen = np.stack([q[:, 0], np.hypot(y, q[:, 2])], axis=1) - data.measurements
    size = sigma[:2] / np.sqrt(np.diagonal(data.covariance.mean(axis=0)))
    whole = data.covariance * np.outer(size, size) + tau**2 * np.eye(2)
    tracked = 0.0 if tracker_sd is None else np.sum((y - q[:, 1]) ** 2) / tau**2
    within = np.einsum("ni,nij,nj", seen, np.linalg.inv(whole), seen)
    return within + np.sum(y**2) / sigma[2] ** 2 + tracked


@pytest.mark.parametrize("tracker_sd", [None, 1.0])
def test_whitened_errors_are_those_of_the_solve(tracker_sd):
    """Their normal matrix is the solve's information, and their gradient vanishes there."""
    given = {"sigma": (0.2, 0.1, 0.6), "tracker_sd": tracker_sd}
    # With a covariance for each image, and too few to be examined for correlated errors.
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=12), 3)
    result = jaxcal.calibrate(recording, "joint", "gaussian", **given)
    assert float(result.convergence.cost) == pytest.approx(
        sum_of_squares(result, **given), rel=1e-9
    )
    alone = batch_of_one(result.numpy())
    whitened = influences.whitened_errors(alone)
    information = np.einsum("mkp,mkq->pq", whitened.rows, whitened.rows)
    size = np.sqrt(np.diagonal(information))
    stated = np.asarray(result.linearisation.information)
    np.testing.assert_allclose(information / np.outer(size, size), stated / np.outer(size, size),
                               atol=1e-12)  # fmt: skip
    gradient = np.einsum("mkp,mk->p", whitened.rows, whitened.errors)
    np.testing.assert_allclose(gradient / size, 0.0, atol=1e-6)
    # Of all weights these leave the least error, by the same SDs.
    beside = result.record()["comparison"]
    assert beside["conventional_tre_mm"] > beside["tre_mm"]


def test_the_conventional_fits_error_has_the_images_own_covariances_in_it():
    """Against the closed form of changed data: one error after the other, times its SD."""
    count = 12
    recording = experiment(3, images=count, elevation_mm=0.0, noise_mm=0.0)
    images, x, sigma = recording.calibration, recording.truth.image_to_probe, [0.03, 0.02, 0.01]
    # Deep images are ten times as noisy as the others.
    deep = images.measurements[:, 1] > np.median(images.measurements[:, 1])
    sd = np.where(deep, 10.0, 1.0)[:, None] * sigma[:2]
    images = replace(images, covariance=sd[..., None] ** 2 * np.eye(2))
    recording = replace(recording, calibration=images)
    typical = (*np.sqrt(np.mean(sd**2, axis=0)), sigma[2])
    result = jaxcal.calibrate(recording, "joint", "gaussian", sigma=typical)
    grid = region_of(result.numpy(), recording).grid()
    there = np.concatenate([grid, np.ones((len(grid), 1))], axis=1).T
    squares, step = 0.0, 1e-3
    for image, kind in itertools.product(range(count), range(3)):
        poses, seen = images.poses.copy(), images.measurements.copy()
        if kind < 2:
            seen[image, kind] += step
        else:
            poses[image, :3, 3] += step * poses[image, :3, :3] @ x[:3, 1]
        moved = calibrate_closed_form(make_images(poses, seen)).image_to_probe - x
        size = (*sd[image], sigma[2])[kind] / step
        squares += size**2 * np.mean(np.sum((moved @ there)[:3] ** 2, axis=0))
    stated = result.record()["comparison"]["conventional_tre_mm"]
    assert stated == pytest.approx(np.sqrt(squares), rel=0.01)


def test_predicting_an_image_from_the_others_is_what_bayes_says():
    """Log density of an image's errors: of all images less that of the others."""
    rng = np.random.default_rng(0)
    rows, errors = rng.normal(size=(9, 3, 4)), rng.normal(size=(9, 3))

    def evidence(rows, errors):
        # Of errors r = e + R d with a flat belief in d, up to what images share.
        flat, observed = rows.reshape(-1, 4), errors.reshape(-1)
        whole = flat.T @ flat
        step = np.linalg.solve(whole, flat.T @ observed)
        rest = observed @ observed - step @ whole @ step
        size = len(observed) * np.log(2 * np.pi)
        return -0.5 * rest - 0.5 * np.linalg.slogdet(whole)[1] - 0.5 * size

    step = np.linalg.lstsq(rows.reshape(-1, 4), -errors.reshape(-1), rcond=None)[0]
    seen = influences.WhitenedErrors(errors + rows @ step, rows, np.arange(3), np.zeros(9),
                                     np.ones(9, bool), np.ones(3))  # fmt: skip
    found = influences._influence(seen, np.zeros(4), np.zeros(4))
    for image in range(9):
        others = np.arange(9) != image
        expected = evidence(rows, errors) - evidence(rows[others], errors[others])
        assert found.log_density[image] == pytest.approx(expected, rel=1e-9)
    assert (np.sum(found.expected**2, axis=(1, 2)) > 0).all()


def test_the_part_of_the_image_is_named_where_the_rest_is_hardly_known():
    images = experiment(3, images=100).calibration
    depth = images.measurements[:, 1]
    strip = np.abs(depth - np.median(depth)) < 3
    for mask, told in ((strip, True), (strip | True, False)):
        data = jaxcal.Problem.from_arrays(images.poses, images.measurements, mask=mask)
        said = "\n".join(jaxcal.calibrate(data, "conventional").verdict())
        assert ("elsewhere the error may be larger" in said) == told
        if told:
            least, most = said.split(" mm); elsewhere")[0].split("depth ")[-1].split(" to ")
            assert depth[strip].min() - 5 < int(least) < int(most) < depth[strip].max() + 5


def test_the_part_of_the_image_is_named_where_it_is_small(recording, result):
    images = recording.calibration
    high = images.measurements.max(axis=0)
    assert result.record()["tre"]["image_share"] > 0.6
    for enlarged, told in ((1.1, False), (2.0, True)):
        size = tuple(map(int, enlarged * high))
        framed = replace(recording, calibration=replace(images, frame_size=size))
        found = jaxcal.calibrate(framed, "conventional", estimate=("scale",))
        tre = found.record()["tre"]
        low, end = tre["points"][1]["image"], tre["points"][4]["image"]
        assert tre["image_share"] == pytest.approx(np.prod((np.array(end) - low) / size))
        assert ("elsewhere the error may be larger" in "\n".join(found.verdict())) == told


def test_where_points_may_be_wrong_the_robust_solve_is_named():
    images = experiment(3, images=24, elevation_mm=1.0).calibration
    spread = np.random.default_rng(1).normal(size=(24, 2)) * [0.0, 3.0]
    data = jaxcal.Problem.from_arrays(images.poses, images.measurements + spread)
    for robust in (False, True):
        found = jaxcal.calibrate(data, "conventional", robust=robust)
        told = [line for line in found.warnings if "errors within the image" in line]
        assert len(told) == 1
        assert ("--robust" in told[0]) == (not robust)


def test_residuals_that_keep_to_the_model_do_not_contradict_it():
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(40, 3, 5))
    weight = np.diag([1.0, 2.0, 0.5, 0.0, 1.0])
    ratios, chances, wild = [], [], []
    for _ in range(200):
        errors = rng.normal(size=(40, 3))
        for factor, out in ((1.0, ratios), (3.0, wild)):
            # Larger errors where they matter, and as much smaller elsewhere.
            size = np.where(np.arange(40)[:, None] < 8, factor, 1.0)
            loud = rows * np.where(np.arange(40) < 8, factor, 1.0)[:, None, None]
            whole = np.einsum("mkp,mkq->pq", loud, loud)
            step = np.linalg.solve(whole, np.einsum("mkp,mk->p", loud, size * errors))
            ones = np.ones(40)
            seen = influences.WhitenedErrors(size * errors - loud @ step, loud, np.arange(3),
                                             0 * ones, ones > 0, np.ones(3))  # fmt: skip
            ratio, chance = excess(influences._influence(seen, np.zeros(5), np.zeros(5)), weight)
            out.append(ratio)
            if factor == 1.0:
                chances.append(chance)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)
    assert np.std(ratios) == pytest.approx(np.mean(chances), rel=0.25)
    assert np.mean(np.array(ratios) > 1 + 3 * np.array(chances)) < 0.03
    assert np.mean(wild) > 2


def test_a_prior_holds_an_answer_as_images_do():
    """At the minimum with the prior nothing is left to move, and residuals agree with the model."""
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(40, 3, 5)) * [1.0, 1.0, 1.0, 1.0, 0.1]
    precision, weight = np.array([0.0, 0.0, 0.0, 0.0, 2.0]), np.diag([1.0, 1.0, 1.0, 1.0, 0.5])
    whole = np.einsum("mkp,mkq->pq", rows, rows) + np.diag(precision)
    ratios = []
    for _ in range(200):
        believed = rng.normal(size=5) * [0.0, 0.0, 0.0, 0.0, 2.0**-0.5]
        errors = rng.normal(size=(40, 3)) - rows @ believed
        away = -np.linalg.solve(whole, np.einsum("mkp,mk->p", rows, errors))
        seen = influences.WhitenedErrors(errors + rows @ away, rows, np.arange(3), np.zeros(40),
                                         np.ones(40, bool), np.ones(3))  # fmt: skip
        found = influences._influence(seen, precision, away)
        ratios.append(excess(found, weight)[0])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)
    again = influences._influence(seen, precision, away, at_minimum=False)
    np.testing.assert_allclose(again.moved, found.moved, atol=1e-12)


def test_images_in_the_image(result):
    found = influence_of(result)
    jacobian = image_jacobian(result.numpy(), POINTS)
    weight = np.einsum("mia,mib->ab", jacobian, jacobian) / len(POINTS)
    moved, should = in_image(found, weight)
    expected = np.sqrt(np.mean(np.sum((jacobian @ found.moved[5]) ** 2, axis=1)))
    assert moved[5] == pytest.approx(expected, rel=1e-9)
    # Of 24 images, as a whole, they move it as much as they should.
    assert 0.5 < np.sqrt(np.mean(moved**2) / np.mean(should**2)) < 2


def test_record_and_table_begin_with_the_error_at_the_image(record, result):
    tre = record["tre"]
    low, high = tre["interval_95_mm"]
    assert low < tre["rms_mm"] < high
    assert tre["unit"] == "px"
    assert tre["factor"] == 1.0
    middle = tre["points"][0]
    at = tre_at(result, np.array(middle["position_mm"]))
    assert middle["tre_mm"] == pytest.approx(float(at.rms), rel=1e-12)
    assert middle["interval_95_mm"] == pytest.approx([float(at.lower), float(at.upper)])
    np.testing.assert_allclose(
        np.array(middle["image"]) * record["scale_mm_per_px"], middle["position_mm"]
    )
    table = Console(width=120)
    with table.capture() as captured:
        table.print(calibration_table(record))
    text = captured.get()
    assert f"{tre['rms_mm']:.3f}, 95 % interval {low:.3f} to {high:.3f}" in text
    assert text.index("error to expect at the image") < text.index("method")
    assert f"{tre['rms_mm']:.2f} mm" in headline(record)
    assert sum(record["limits"]["error_share"].values()) == pytest.approx(1)


def test_shares_of_a_conventional_fit_are_those_of_its_own_response():
    """Each error of each image is made in turn, in exact data, and the fit is repeated."""
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=24), 3)
    result = jaxcal.calibrate(recording, "conventional")
    told = record_of(result)["limits"]["error_share"]
    x, target = (np.asarray(each) for each in (result.image_to_probe, result.point))
    images = recording.calibration
    axes = images.poses[:, :3, :3] @ x[:3, 1]
    q = targets_in_images(images.poses, x, target)
    corners = np.array([[-20.0, 0, 10, 1], [20, 0, 10, 1], [-20, 0, 80, 1], [20, 0, 80, 1]])

    def fitted(image: int | None = None, kind: int = 0) -> np.ndarray:
        off = np.zeros((len(q), 3))
        if image is not None:
            off[image, kind] = 1e-3
        poses = images.poses.copy()
        poses[:, :3, 3] += axes * (q[:, 1] - off[:, 2])[:, None]
        exact = make_images(poses, q[:, [0, 2]] + off[:, :2], "point")
        return corners @ calibrate_closed_form(exact).image_to_probe[:3].T

    whole = fitted()
    moved = np.array([[fitted(i, k) - whole for i in range(len(q))] for k in range(3)])
    shares = np.asarray(result.sigma) ** 2 * np.sum(moved**2, axis=(1, 2, 3))
    np.testing.assert_allclose(list(told.values()), shares / shares.sum(), atol=0.05)
    assert told["lateral"] > 0.1


def test_rms_in_the_plane_is_in_the_plane(record, result):
    residual = np.asarray(result.residual)
    found = record["limits"]
    expected = np.sqrt(np.mean(residual[:, 0] ** 2 + residual[:, 2] ** 2))
    assert found["rms_in_plane_mm"] == pytest.approx(expected)
    assert np.hypot(expected, found["rms_elevational_mm"]) == pytest.approx(record["rms_mm"])
    assert sum(found["scatter_share"].values()) == pytest.approx(1)


def test_points_that_are_asked_for(result, recording):
    found = calibration_record(result, recording, tre_points=((10.0, 600.0),))
    asked = found["tre"]["points"][-1]
    assert (asked["name"], asked["image"]) == ("asked for", [10.0, 600.0])
    there = np.array([10.0, 600.0]) * found["scale_mm_per_px"]
    assert asked["tre_mm"] == pytest.approx(float(tre_at(result, there).rms))
    assert any("At (10, 600) px" in line for line in verdict(found))


def stating(record, error):
    """A record whose covariance states another error."""
    changed = copy.deepcopy(record)
    factor = error / changed["tre"]["stated_mm"]
    changed["tre"]["stated_mm"] = error
    changed["tre"]["stated_interval_mm"] = [
        factor * end for end in changed["tre"]["stated_interval_mm"]
    ]
    for name in ("moved_mm", "expected_mm"):
        changed["influence"][name] = [factor * value for value in changed["influence"][name]]
    return changed


def test_word_and_number_are_of_one_quantity(record):
    for error, word in ((0.9 * GOOD_MM, "good"), (0.9 * FAIR_MM, "fair"), (2.0, "uncertain")):
        changed = stating(record, error)
        # However well or badly the target stays in its place: a beam may be 10 mm thick.
        for precision in (0.001, 9.0):
            changed["reconstruction_precision_mm"] = changed["rms_mm"] = precision
            settle(changed)
            assert changed["verdict"] == word
            assert verdict(changed)[0].startswith(f"{word.capitalize()}: expect")
            assert f"{error:.2f} mm" in verdict(changed)[0]


def test_a_small_error_with_a_wide_interval_is_not_good(record):
    """As of four images with the conventional method: one degree of freedom."""
    for upper, word in ((1.4, "good"), (1.6, "fair"), (4.4, "fair"), (4.6, "uncertain")):
        changed = stating(record, 0.4)
        changed["tre"]["stated_interval_mm"] = [0.1, upper]
        settle(changed)
        assert changed["verdict"] == word
        assert any("20 to 30 degrees" in line for line in verdict(changed)) == (word == "uncertain")


def contradicted(kind, record):
    changed = stating(record, 0.4)
    count = changed["images"]
    quiet = [0.05] * count
    if kind == "residuals":
        changed["tre"] |= {"residuals_over_stated": 3.0, "chance": 0.3}
    elif kind == "image":
        changed["influence"]["moved_mm"][7] = 3.7
    elif kind == "left out":
        moved = [*quiet[:-1], 3.7]
        changed["cross_validation"] = {
            "folds": count, "folds_converged": count, "image_moved_mm": moved, "stated_mm": 0.4,
            "precision_mm": 1.3,
        }  # fmt: skip
    else:
        changed["bootstrap"] = {
            "reproducibility_mm": [0.5] * 5, "rms_scatter_mm": [2.3] * 5, "stated_mm": 0.4,
            "resamples": 200, "resamples_converged": 190,
            "rotation_sd_deg": [0.1] * 3,
        }  # fmt: skip
    return changed


@pytest.mark.parametrize("kind", ["residuals", "image", "left out", "bootstrap"])
def test_verdict_falls_when_the_covariance_is_contradicted(record, kind):
    changed = contradicted(kind, record)
    settle(changed)
    assert changed["verdict"] in ("fair", "uncertain")
    tre = changed["tre"]
    assert tre["rms_mm"] == pytest.approx(tre["factor"] * 0.4)
    assert tre["interval_95_mm"][1] == pytest.approx(tre["factor"] * tre["stated_interval_mm"][1])
    assert tre["points"][0]["tre_mm"] == pytest.approx(
        tre["factor"] * tre["points"][0]["stated_mm"]
    )
    lines = verdict(changed)
    assert f"{tre['rms_mm']:.2f} mm" in lines[0]
    assert "By the noise model alone the error would be 0.40 mm, but " in lines[1]
    # Neither poses nor a number of images are promised to remove what contradicts the model.
    changed["rms_mm"] = 0.45
    said = " ".join(verdict(changed))
    assert "First see to what contradicts the noise model" in said
    assert "vary all tilts" not in said
    assert "add other poses" not in said
    assert said.index("Most of all, what contradicts") < said.index("mean square error comes")
    changed["next_poses"] = {
        "tre_now_mm": 0.4, "tre_then_mm": 0.3, "poses": [{"words": "tilt"}], "images_to_half": 5,
    }  # fmt: skip
    assert "may remain" in next_poses_sentences(changed)[-1]
    # Said once, whatever is found out later.
    again = copy.deepcopy(changed)
    settle(again)
    assert again == changed


def test_test_images_that_scatter_contradict_the_error(record):
    changed = stating(record, 0.4)
    changed |= {"reconstruction_precision_set": "test", "reconstruction_precision_mm": 0.9}
    settle(changed)
    assert changed["tre"]["factor"] == 1.0
    changed["reconstruction_precision_mm"] = 55.7
    settle(changed)
    assert changed["verdict"] == "uncertain"
    assert changed["tre"]["rms_mm"] == pytest.approx(55.7, rel=0.01)
    assert "the test images scatter by 55.70 mm, where" in " ".join(verdict(changed))
    # Of which a tracker with errors of 20 mm explains the most.
    changed["tracker_sd_mm"] = 20.0
    settle(changed)
    assert changed["tre"]["factor"] == 1.0


def test_precision_is_that_at_the_estimated_sound_speed_and_delay():
    recording = experiment(3, images=24, elevation_mm=1.0)
    result = jaxcal.calibrate(recording, "conventional").numpy()
    assert result.problem is not None
    assert recording.test is not None
    factor, delay_mm = 1.03, 0.8

    def earlier(images):
        return replace(images, measurements=images.measurements / [1.0, factor] + [0.0, delay_mm])

    estimated = replace(
        result,
        problem=earlier(result.problem),
        blocks=(*result.blocks, "sound-speed", "delay"),
        linearisation=replace(result.linearisation, further=np.array([factor, delay_mm])),
    )
    for images in (recording.test, recording.calibration):
        expected = _precision(result, images)
        assert _precision(estimated, earlier(images)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", [name for name in FURTHER if TABLE[name].in_image])
def test_a_transform_has_every_unknown_that_moves_an_image_point(name):
    """Its points, and their derivatives, are those of the model, whatever row the table has."""
    images = experiment(3, images=24, elevation_mm=1.0).calibration
    spacing, face = np.array([0.2, 0.1]), 1.5
    pixels = (images.measurements - [0.0, face]) / spacing
    made = jaxcal.make_images(
        images.poses, pixels, kind="pixel", spacing_mm=spacing, face_offset_mm=face
    )
    result = jaxcal.calibrate(jaxcal.Recording(made), "conventional").numpy()
    blocks = (*result.blocks, name)
    values = [
        np.array(stepped(name, TABLE[name].nominal, 0.02 + 0.01 * k, np.exp))
        for k in range(TABLE[name].size)
    ]
    moved = replace(
        result,
        blocks=blocks,
        linearisation=replace(result.linearisation, further=np.array(values)),
        scale_mm_per_px=spacing * values if name == "scale" else spacing,
        unknowns_covariance=np.full((count_unknowns(blocks),) * 2, np.nan),
    )

    def seen(values):
        return measured(*(pixels * spacing).T, face, values)

    x, (lateral, distance) = np.asarray(moved.image_to_probe), seen({name: values})
    plane = np.stack([lateral, np.zeros_like(lateral), distance], axis=1)
    expected = plane @ x[:3, :3].T + x[:3, 3]
    np.testing.assert_allclose(moved.apply(pixels).points, expected, atol=1e-9)
    jacobian = image_jacobian(moved, plane[:, [0, 2]])
    for column, (sideways, deep) in further_derivatives(seen, {name: values}, blocks):
        expected = np.stack([sideways, np.zeros_like(deep), deep], axis=1)
        np.testing.assert_allclose(jacobian[..., column], expected, atol=1e-9)


@pytest.mark.parametrize("shift_mm", [0.0, 6.0])
def test_a_slip_of_the_mount_is_no_stream_and_lowers_the_verdict(shift_mm):
    recording = experiment(3, images=24)
    images = recording.calibration
    points = np.array(images.measurements)
    points[12:, 0] += shift_mm
    slipped = jaxcal.make_images(images.poses, points)
    result = jaxcal.calibrate(jaxcal.Recording(slipped), prior="gaussian")
    assert int(result.images_used) == 24
    tre = result.record()["tre"]
    moved = [words for words in tre["contradictions"] if "moves by 6.0 mm" in words]
    assert len(tre["contradictions"]) == len(moved) == (shift_mm > 0)
    assert (result.record()["verdict"] == "uncertain") == (shift_mm > 0)
    # The map has the verdict's error, not the smaller one that the covariance states.
    drawn = result.plot_tre().axes[0].collections[0].get_array()
    assert np.max(drawn) == pytest.approx(max(point["tre_mm"] for point in tre["points"]))


def test_pixels_of_an_unusual_size_are_named():
    recording = experiment(3, images=24)
    images = recording.calibration
    pixels = images.measurements / [0.12, 0.1] + [260.0, 0.0]
    for factor in (1.0, 0.1):
        poses = np.array(images.poses)
        poses[:, :3, 3] *= factor
        found = jaxcal.calibrate(
            jaxcal.Recording(jaxcal.make_images(poses, pixels, "pixel")),
            "conventional",
            estimate="scale",
        )
        unusual = [text for text in found.warnings if "may be in cm or inches" in text]
        assert len(unusual) == (factor < 1)


def test_oblong_pixels_are_named():
    images = experiment(3, images=24).calibration
    for factor in (1.0, 4.0):
        pixels = images.measurements / [0.12, 0.1 / factor] + [260.0, 0.0]
        found = jaxcal.calibrate(
            jaxcal.make_images(images.poses, pixels, "pixel"), "conventional", estimate="scale"
        )
        oblong = [text for text in found.warnings if "before scan conversion" in text]
        assert len(oblong) == (factor > 1)


@pytest.mark.parametrize("left_out", [0, 10, 20])
def test_resampling_that_agrees_changes_nothing(record, left_out):
    changed = stating(record, 0.4)
    count = changed["images"]
    used = count - left_out
    quiet = [None] * left_out + [0.4 / np.sqrt(used)] * used
    changed["cross_validation"] = {
        "folds": count, "folds_converged": count, "image_moved_mm": quiet, "stated_mm": 0.4,
    }  # fmt: skip
    changed["bootstrap"] = {"rms_scatter_mm": [0.42] * 5, "stated_mm": 0.4}
    settle(changed)
    assert (changed["verdict"], changed["tre"]["factor"]) == ("good", 1.0)


@pytest.mark.parametrize("used", [8, 12, 20, 24])
def test_resamples_of_few_images_contradict_nothing(record, used):
    """The variance of a scatter from 20 images has a relative SD of a third."""
    changed = stating(record, 0.4) | {"images_used": used, "prior": "auto"}
    each = 1.7 * 0.4 / np.sqrt(used - 1)
    moved = [each] * used + [None] * (changed["images"] - used)
    changed["cross_validation"] = {
        "folds": used, "folds_converged": used, "image_moved_mm": moved, "stated_mm": 0.4,
    }  # fmt: skip
    settle(changed)
    # Without one of 8 images the SDs are not tuned: these calibrations are other estimates.
    told = " ".join(changed["tre"]["contradictions"])
    assert ("cross-validation scatter by" in told) == (used > 8)
    changed["cross_validation"]["image_moved_mm"] = [by and 1.35 / 1.7 * by for by in moved]
    changed["bootstrap"] = {"rms_scatter_mm": [1.7 * 0.4] * 5, "stated_mm": 0.4}
    settle(changed)
    told = " ".join(changed["tre"]["contradictions"])
    assert "cross-validation" not in told
    assert ("bootstrap scatter by" in told) == (used >= 20)


def test_an_image_is_not_blamed_for_sds_that_are_no_longer_tuned(record):
    changed = stating(record, 0.4) | {"images_used": 8, "prior": "auto"}
    rest = [None] * (changed["images"] - 8)
    changed["cross_validation"] = {
        "folds": 8, "folds_converged": 8, "image_moved_mm": [3.7] * 8 + rest, "stated_mm": 0.4,
    }  # fmt: skip
    settle(changed)
    assert "alone changes" not in " ".join(changed["tre"]["contradictions"])
    settle(changed := changed | {"prior": "none"})
    assert "image 7 alone changes" in " ".join(changed["tre"]["contradictions"])


def test_bootstrap_of_few_images_is_said_to_scatter_more(record):
    changed = contradicted("bootstrap", record)
    assert len(resampled_sentences(changed)) == 1
    assert "Of 12 images a resample" in resampled_sentences(changed | {"images_used": 12})[1]


def test_position_and_orientation_have_the_error_of_all_axes(record):
    covariance = np.diag([0.1, 0.2, 0.2, 0.01, 0.02, 0.02]) ** 2
    changed = record | {"covariance": covariance.tolist()}
    said = certainty(changed)[0]
    assert "root mean square error of the image's position on the probe is 0.30 mm" in said
    assert "That of its orientation is 1.72 degrees" in said


def test_errors_of_either_sign_are_too_large_or_too_small():
    for kind, value, words in (
        ("skew", 0.012, "too large by 1.2 % of the depth"),
        ("skew", -0.012, "too small by 1.2 % of the depth"),
        ("curve", 0.5, "too long by 0.5 mm 20 mm to either side"),
        ("curve", -0.5, "too short by 0.5 mm 20 mm to either side"),
        ("speed", -0.02, "too short by 2.0 %"),
    ):
        told, _ = _explanation({"kind": kind, "values": [value], "images": None}, pixels=True)
        assert words in told


def test_limits_in_words(record):
    changed = stating(record, 0.4)
    changed["limits"]["error_share"] = {"lateral": 0.05, "range": 0.25, "elevational": 0.7}
    changed["next_poses"] = {"tre_now_mm": 0.4, "tre_then_mm": 0.3, "poses": [{}, {}, {}]}
    settle(changed)
    said = " ".join(limits(changed))
    assert "targets out of the image plane (70 %), then range errors of the points (25 %)" in said
    assert "3 well-chosen images would help as much as 19 more" in said
    held = changed | {"prior": "gaussian", "degrees_of_freedom": None}
    assert limits(held)[0].startswith("By the SDs that were held fixed, the mean square error")


def test_why_larger_residuals_are_believed(record):
    beside = {
        "rms_mm": 1.01, "conventional_rms_mm": 0.98, "conventional_tre_mm": 0.44, "tre_mm": 0.41,
        "log_density_gain": 20.6, "log_density_gain_sd": 5.5, "apart_mm": 0.43,
    }  # fmt: skip
    said = " ".join(verdict({**record, "prior": "auto", "comparison": beside}))
    assert "larger than that of the conventional fit (1.010 against 0.980 mm)" in said
    assert "an expected error of 0.44 mm, one with weights from these sizes 0.41 mm" in said
    assert "predicts held-out images better than the conventional fit (log density +20.6" in said
    assert "one with weights from these sizes 0.41 mm. " in said
    # Without the two errors, each fact is still a sentence of its own.
    said = " ".join(verdict({**record, "comparison": beside | {"tre_mm": None}}))
    assert "minimises exactly this. This calibration predicts held-out images" in said
    assert "+- 5.5). In the image, the two calibrations differ by 0.43 mm." in said
    # A gain that may be chance is none.
    for gain, than in (
        (10.9, "about as well as"),
        (-10.9, "about as well as"),
        (-12, "worse than"),
    ):
        said = " ".join(verdict({**record, "comparison": beside | {"log_density_gain": gain}}))
        assert f"predicts held-out images {than} the conventional fit" in said


def test_a_bound_is_not_said_to_weigh_by_the_sizes_of_errors(record):
    """Whose fit would be at least as good as one with equal weights."""
    beside = {
        "rms_mm": 1.01, "conventional_rms_mm": 0.98, "conventional_tre_mm": 0.53, "tre_mm": 1.26,
        "log_density_gain": None, "log_density_gain_sd": None, "apart_mm": 0.07,
    }  # fmt: skip
    said = " ".join(verdict({**record, "prior": "bounded", "comparison": beside}))
    assert "with weights from" not in said
    assert "anything within the bound, this one has 1.26 mm." in said


def test_the_conventional_fit_predicts_images_with_the_variances_that_it_states():
    recording = experiment(3, images=24, elevation_mm=1.0)
    answer = jaxcal.calibrate(recording)
    beside = record_of(answer)["comparison"]
    alone = jaxcal.calibrate(recording, "conventional")
    gain = influence_of(answer).log_density.sum() - influence_of(alone).log_density.sum()
    assert beside["log_density_gain"] == pytest.approx(gain, rel=1e-6)
    # Errors that are only rounding have no density.
    recording = experiment(3, images=12, elevation_mm=0.0, noise_mm=0.0)
    exact = jaxcal.calibrate(recording)
    assert record_of(exact)["comparison"]["log_density_gain"] is None
    assert "the lateral, range and elevational errors are too small" in " ".join(exact.warnings)
    # Nor do they tell a distribution, or which poses would help.
    assert "too small to tell their distribution" in " ".join(exact.verdict())
    assert next_poses_record(exact, recording) is None


def test_exit_status_says_less_than_required(tmp_path, capfd):
    path = tmp_path / "rec.h5"
    jaxcal.save(jaxcal.simulate_recording(jaxcal.Protocol(images=24, elevation_mm=2.0), 3), path)
    ask = ["calibrate", str(path), "--method", "conventional", "--json", "--tre", "3", "40"]
    assert main(ask) == 0
    record = json.loads(capfd.readouterr().out)
    assert record["verdict"] in ("good", "fair")
    assert record["tre"]["points"][-1]["image"] == [3.0, 40.0]
    assert record["tre"]["unit"] == "mm"
    assert main([*ask[:-2], "1e308", "40"]) == 2
    assert "tre_points (--tre) must be numbers up to 1e+07" in capfd.readouterr().err
    noisy = tmp_path / "noisy.h5"
    protocol = jaxcal.Protocol(images=24, elevation_mm=15.0)
    jaxcal.save(jaxcal.simulate_recording(protocol, 3), noisy)
    codes = {
        require: main(["calibrate", str(noisy), "--method", "conventional", "--json",
                       "--require", require])
        for require in ("good", "fair", "uncertain")
    }  # fmt: skip
    found = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert found[0]["verdict"] == "uncertain"
    assert codes == {"good": 5, "fair": 5, "uncertain": 0}


def test_a_plan_says_where_in_the_frame_the_target_is_to_be(recording, result, capsys):
    """In pixels: a machine shows no millimetres from the image's corner."""
    candidates = design.candidates_around(recording, result, count=200)
    found = design.next_poses(result, candidates, 2)
    record = plan._record(found, "r.h5", candidates.constraints.region, result)
    for pose in record["poses"]:
        given = np.array([pose["target_px"]]), np.array([pose["pose"]])
        placed = result.image_transform().apply(*given)
        np.testing.assert_allclose(placed.points[0], result.point, atol=1e-6)
    plan._print(found, record, None, None)
    said = capsys.readouterr().out
    assert "{:.0f}, {:.0f} ".format(*record["poses"][0]["target_px"]) in said
    assert "(px)" in said
    assert "target_px" not in pose_records(found)[0]
    unobservable = np.array(Status.UNOBSERVABLE.value)
    unknown = replace(result, status_code=unobservable, scale_mm_per_px=np.array([0.0, 0.1]))
    assert "target_px" not in pose_records(found, unknown)[0]
