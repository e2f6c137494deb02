"""Solves on the elements' distances: curved arrays, sound speed, delay, agreement with points."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from conftest import angle

import jaxcal
from jaxcal import InputError, Protocol
from jaxcal.cli.main import main
from jaxcal.data.probe import CurvilinearProbe, LinearProbe
from jaxcal.diagnostics.channel_points import as_points
from jaxcal.diagnostics.image_errors import ImageErrors, Unknowns
from jaxcal.diagnostics.unmodelled import unmodelled
from jaxcal.io.hdf5 import save
from jaxcal.runtime.arrays import batch_of_one

CURVED = CurvilinearProbe(elements=32, pitch_mm=2.0, radius_mm=60.0)
STRAIGHT = LinearProbe(elements=32, pitch_mm=1.8)


def recording(probe, seed: int = 1, noise: float = 0.1, **protocol) -> jaxcal.Recording:
    return jaxcal.simulate_recording(
        Protocol(images=20, test_images=20, elevation_mm=2.0, noise_mm=noise, probe=probe, raw=True,
                 **protocol),
        seed,
    )  # fmt: skip


def precision(result: jaxcal.Calibration, data: jaxcal.Recording) -> float:
    assert data.test is not None
    return float(
        jaxcal.reconstruction_precision(
            result.image_to_probe, data.test.poses, data.test.measurements
        )
    )


@pytest.mark.slow
def test_a_curved_array_gives_the_offsets_with_their_signs():
    data = recording(CURVED, noise=0.05)
    assert data.truth is not None
    joint, conventional = (
        jaxcal.calibrate(data, prior="gaussian"),
        jaxcal.calibrate(data, "conventional"),
    )
    assert joint.status == "converged"
    assert joint.data == "channels"
    assert precision(joint, data) < 0.5 * precision(conventional, data)
    error = np.asarray(joint.elevation) - data.truth.elevation
    assert np.sqrt(np.mean((error / np.asarray(joint.elevation_sd)) ** 2)) < 2
    visible = np.abs(data.truth.elevation) > 0.3
    assert (np.sign(joint.elevation) == np.sign(data.truth.elevation))[visible].all()
    assert joint.channel_sigma == pytest.approx(0.05, rel=0.1)


@pytest.mark.slow
def test_on_a_straight_array_points_with_covariances_say_the_same():
    noise, offset = 0.05, 1.2
    data = recording(STRAIGHT, noise=noise)
    segmented, _ = jaxcal.segment_recording(data, scale="pooled", robust=False)
    problem = jaxcal.Problem.from_recording(data)
    covariance = jnp.asarray(segmented.calibration.covariance)
    problem = replace(
        problem, measurements=jnp.asarray(segmented.calibration.measurements), covariance=covariance
    )
    found = jnp.median(jnp.asarray(jaxcal.segment(data, robust=False).noise_mm))
    spread = jnp.sqrt(jnp.mean(jnp.diagonal(covariance, axis1=1, axis2=2), axis=0))
    # In a batch images are independent, as they are for channels; one problem is examined for
    # errors that are alike in successive images.
    alone = jaxcal.stack([problem])
    points = jaxcal.calibrate_batch(alone, sigma=jnp.append(spread, offset), data="points")[0]
    channels = jaxcal.calibrate(problem, sigma=jnp.stack([found, offset]), data="channels")
    between = np.linalg.inv(points.image_to_probe) @ np.asarray(channels.image_to_probe)
    sd = np.sqrt(np.diag(channels.covariance))
    assert np.abs(between[:3, 3] / sd[:3]).max() < 0.01
    turned = np.array([between[2, 1], between[0, 2], between[1, 0]])
    assert np.abs(turned / sd[3:]).max() < 0.01
    difference = np.asarray(points.covariance) - np.asarray(channels.covariance)
    assert np.abs(difference / np.outer(sd, sd)).max() < 0.005


def wrong_medium(data: jaxcal.Recording, speed: float, delay_s: float) -> jaxcal.Recording:
    """The same times, read with a probe that knows neither its sound speed nor its delay."""
    assert data.probe is not None
    times = data.calibration.measurements * data.probe.sound_speed_m_s / speed + delay_s
    return replace(data, calibration=replace(data.calibration, measurements=times))


@pytest.mark.slow
@pytest.mark.parametrize("probe", [STRAIGHT, CURVED], ids=["straight", "curved"])
def test_sound_speed_and_delay_are_estimated_along(probe):
    data = recording(probe, seed=3)
    off = wrong_medium(data, 1520.0, 0.5e-6)
    result = jaxcal.calibrate(off, estimate=("sound-speed", "delay"), prior="gaussian")
    assert result.status == "converged"
    assert result.data == "channels"
    medium = result.medium
    assert medium.sound_speed_m_s is not None
    assert medium.sound_speed_sd_m_s is not None
    assert medium.delay_s is not None
    assert medium.delay_sd_s is not None
    assert abs(medium.sound_speed_m_s - 1520.0) < 3 * medium.sound_speed_sd_m_s < 3.0
    assert abs(medium.delay_s - 0.5e-6) < 3 * medium.delay_sd_s < 0.15e-6
    # In a single experiment either may be better by chance.
    several = [data, *(recording(probe, seed=seed) for seed in (4, 5, 6, 7, 8))]
    estimated, known, wrong = [], [], []
    for each in several:
        off = wrong_medium(each, 1520.0, 0.5e-6)
        found = jaxcal.calibrate(off, estimate=("sound-speed", "delay"), prior="gaussian")
        estimated.append(precision(found, each))
        known.append(precision(jaxcal.calibrate(each, data="channels", prior="gaussian"), each))
        wrong.append(precision(jaxcal.calibrate(off, prior="gaussian"), each))
    assert np.mean(estimated) < 1.1 * np.mean(known)
    assert np.mean(wrong) > 1.5 * np.mean(estimated)


@pytest.mark.slow
def test_what_points_cannot_tell_is_said_or_refused():
    data = recording(STRAIGHT, noise=0.2)
    points = replace(jaxcal.Problem.from_recording(data), channels=None)
    for alone in (points, replace(points, covariance=None)):
        delay = jaxcal.calibrate(alone, estimate=("delay",), prior="gaussian")
        assert delay.status == "unobservable"
        assert "delay" in delay.observability["weakest_direction"]
    speed = jaxcal.calibrate(points, estimate=("sound-speed",), prior="gaussian")
    assert speed.status == "converged"
    assert speed.medium.sound_speed_sd_m_s is not None
    assert float(speed.medium.sound_speed_sd_m_s) < 20.0
    pixels = replace(points, pixels=True)
    with pytest.raises(InputError, match="one and the same factor"):
        jaxcal.calibrate(pixels, estimate=("scale", "sound-speed"))
    with pytest.raises(InputError, match="needs times of flight"):
        jaxcal.calibrate(points, data="channels")
    with pytest.raises(InputError, match="gaussian prior only"):
        jaxcal.calibrate(jaxcal.Problem.from_recording(data), "conventional", data="channels")


def test_a_face_offset_beside_times_is_refused():
    """The channels ignored it, and the transform added it to ranges: points were 3 mm too deep."""
    problem = jaxcal.Problem.from_recording(recording(STRAIGHT))
    problem = replace(problem, face_offset=np.asarray(3.0))
    with pytest.raises(InputError, match="face_offset_mm does not go with times of flight"):
        jaxcal.calibrate(problem, data="channels")


@pytest.mark.parametrize(
    ("method", "request_parts"),
    [
        ("joint", {"sound_speed_sd": 5.0}),
        ("joint", {"delay_sd": 1e-7, "estimate": ("sound-speed",)}),
        ("joint", {"sound_speed_sd": 5.0, "estimate": ("sound-speed",), "prior": "bounded"}),
        ("conventional", {"sound_speed_sd": 5.0, "estimate": ("sound-speed",)}),
    ],
)
def test_a_prior_sd_without_effect_is_refused(method, request_parts):
    points = replace(jaxcal.Problem.from_recording(recording(STRAIGHT)), channels=None)
    with pytest.raises(InputError, match=r"_sd is the prior SD of an estimated .*: it needs"):
        jaxcal.calibrate(points, method, **request_parts)


@pytest.mark.parametrize("probe", [STRAIGHT, CURVED], ids=["straight", "curved"])
def test_elements_say_what_a_point_fitted_to_them_says(probe):
    """Of the errors, of their derivatives, and of distances that are all too long."""
    problem = jaxcal.Problem.from_recording(recording(probe))
    channels, elements = problem.channels, probe.element_positions()
    assert channels is not None
    answer = batch_of_one(jaxcal.calibrate(problem, prior="gaussian", data="channels").numpy())
    assert answer.problem is not None
    problem = answer.problem
    _, seen, speed = as_points(answer)

    def fitted(distances: np.ndarray, offset: float) -> np.ndarray:
        """Lateral position and range of the point with that offset."""

        def left(point: np.ndarray) -> np.ndarray:
            x, axial = point[0], np.sqrt(point[1] ** 2 - offset**2)
            return np.linalg.norm([x, offset, axial] - elements, axis=1) - distances

        return scipy.optimize.least_squares(left, [0.0, 60.0], xtol=1e-14, ftol=1e-14).x

    for row in (0, 7, 19):
        q = seen.q[0, row]
        predicted = np.array([q[0], np.hypot(q[1], q[2])])
        measured = np.asarray(channels.distances)[row]
        truly = np.linalg.norm(q - elements, axis=1)
        expected = predicted - fitted(measured, q[1])
        # The fit is not linear; errors are 0.1 mm.
        np.testing.assert_allclose(seen.errors[0, row, :2], expected, atol=2e-4)
        longer = (fitted(truly * (1 + 1e-6), q[1]) - predicted) / 1e-6
        np.testing.assert_allclose(speed[row], longer, rtol=1e-4, atol=1e-3)
        for unknown in range(9):
            there = Unknowns.of(answer).moved(1e-5 * np.eye(9)[[unknown]], answer.blocks)
            other = ImageErrors.of(there, problem, answer.blocks).q[0, row]
            off = np.linalg.norm(other - elements, axis=1)
            by = fitted(off, q[1]) - predicted
            np.testing.assert_allclose(
                seen.rows[0, row, :2, unknown], by / 1e-5, rtol=1e-3, atol=1e-3
            )


def test_errors_that_the_model_leaves_out_are_named_from_times_of_flight():
    data = recording(CURVED, noise=0.3)
    assert data.truth is not None
    images, x = data.calibration, data.truth.image_to_probe
    too_long = replace(images, measurements=1.03 * images.measurements)
    poses = images.poses.copy()
    poses[13:, :3, 3] -= 3.0 * (poses[13:] @ x)[:, :3, 0]
    slipped = replace(images, poses=poses)
    for changed, told in (
        (images, None),
        (
            too_long,
            r"distances that are too long by 3\.\d % would .*: is it the sound speed of this",
        ),
        (slipped, r"an image that moves by [23]\.\d mm on the probe near image 1[234] "),
    ):
        there = replace(data, calibration=changed)
        verdict = "\n".join(jaxcal.calibrate(there, prior="gaussian").verdict())
        assert ("would explain" in verdict) == (told is not None)
        assert told is None or re.search(told, verdict), verdict


@pytest.mark.parametrize("kind", ["points", "channels"])
def test_an_image_that_the_answer_left_out_explains_nothing(kind):
    data = recording(CURVED, noise=0.3)
    problem = jaxcal.Problem.from_recording(data)
    poses = np.array(problem.poses)
    poses[13:, 0, 3] += 3.0
    answer = jaxcal.calibrate(replace(problem, poses=poses), prior="gaussian", data=kind).numpy()
    assert answer.problem is not None
    wild = np.array(answer.problem.poses)
    wild[4, :3, 3] += 50.0
    mask = np.arange(20) != 4
    left_out = replace(answer, mask=mask * answer.mask, problem=replace(answer.problem, poses=wild))
    assert left_out.problem is not None
    missing = replace(left_out, problem=replace(left_out.problem, mask=mask * answer.mask))
    found, expected = unmodelled(left_out), unmodelled(missing)
    assert found[0].kind == expected[0].kind == "displaced"
    assert found[0].statistic == pytest.approx(expected[0].statistic, rel=1e-9)


def test_missing_and_late_lines_do_no_harm():
    data = recording(CURVED, noise=0.05)
    times = np.array(data.calibration.measurements)
    rng = np.random.default_rng(0)
    times[rng.random(times.shape) < 0.1] = np.nan
    late = rng.random(times.shape) < 0.05
    times[late] += rng.uniform(2e-6, 2e-5, late.sum())
    times[4] = np.nan  # a whole frame without an answer
    worse = replace(data, calibration=replace(data.calibration, measurements=times))
    result = jaxcal.calibrate(worse, prior="gaussian")
    assert result.status == "converged"
    assert int(result.images_used) == 19
    assert precision(result, data) < 1.5 * precision(jaxcal.calibrate(data, prior="gaussian"), data)


def test_distances_that_no_element_heard_are_never_read():
    problem = jaxcal.Problem.from_recording(recording(CURVED))
    channels = problem.channels
    assert channels is not None
    # One image twice, with other noise: such frames count as one, the mean of their distances.
    poses, measured = np.array(problem.poses), np.array(problem.measurements)
    twice = np.array(channels.distances)
    poses[1], measured[1], twice[1] = poses[0], measured[0] + 0.1, twice[0] + 0.1
    problem = replace(problem, poses=jnp.asarray(poses), measurements=jnp.asarray(measured))
    lost = np.random.default_rng(1).random(twice.shape) < 0.2
    lost[7] = True  # an image that no element heard

    def solved(instead: float) -> jaxcal.Calibration:
        distances = np.where(lost, instead, twice)
        heard = np.where(lost, 0.0, channels.heard)
        changed = replace(channels, distances=jnp.asarray(distances), heard=jnp.asarray(heard))
        return jaxcal.calibrate(replace(problem, channels=changed), prior="gaussian")

    plain, rubbish = solved(0.0), solved(np.nan)
    assert plain.status == rubbish.status == "converged"
    assert int(plain.images_used) == 18
    np.testing.assert_array_equal(rubbish.image_to_probe, plain.image_to_probe)
    assert rubbish.verdict() == plain.verdict()


@pytest.mark.slow
def test_derivative_matches_finite_differences():
    problem = jaxcal.Problem.from_recording(recording(CURVED, noise=0.2))
    assert problem.channels is not None
    rng = np.random.default_rng(2)
    direction = jnp.asarray(rng.normal(size=problem.channels.distances.shape))

    def value(step):
        channels = problem.channels
        moved = replace(channels, distances=channels.distances + step * direction)
        result = jaxcal.calibrate(replace(problem, channels=moved), prior="gaussian")
        return jnp.sum(result.image_to_probe[:3, 3]) + result.sigma[2]

    step = 1e-3
    compiled = jax.jit(jax.value_and_grad(value))
    numeric = (compiled(step)[0] - compiled(-step)[0]) / (2 * step)
    assert float(compiled(0.0)[1]) == pytest.approx(float(numeric), rel=1e-5)


@pytest.mark.slow
def test_a_batch_is_its_problems():
    problems = [jaxcal.Problem.from_recording(recording(CURVED, seed=k)) for k in (1, 2, 3)]
    batch = jaxcal.calibrate_batch(jaxcal.stack(problems), prior="gaussian")
    for k, problem in enumerate(problems):
        alone = jaxcal.calibrate(problem, prior="gaussian")
        assert angle(batch.image_to_probe[k], alone.image_to_probe) < 1e-8
        np.testing.assert_allclose(batch.elevation[k], alone.elevation, atol=1e-6)


@pytest.mark.slow
def test_the_command_line_calibrates_raw_times(tmp_path, capsys):
    path = tmp_path / "raw.h5"
    save(wrong_medium(recording(STRAIGHT), 1500.0, 0.0), path)
    assert main(["calibrate", str(path), "--prior", "gaussian", "--json"]) == 0
    points = json.loads(capsys.readouterr().out)
    assert points["data"] == "points"
    assert points["sound_speed_m_s"] is None
    estimate = ["--estimate", "sound-speed", "--prior", "gaussian", "--json"]
    assert main(["calibrate", str(path), *estimate]) == 0
    channels = json.loads(capsys.readouterr().out)
    assert channels["data"] == "channels"
    assert channels["sound_speed_m_s"] == pytest.approx(1500.0, abs=5.0)
    assert channels["reconstruction_precision_mm"] < points["reconstruction_precision_mm"]
    assert main(["calibrate", str(path), "--data", "channels", "--method", "alternating"]) == 2
    assert "channels are solved by the joint method" in capsys.readouterr().err
