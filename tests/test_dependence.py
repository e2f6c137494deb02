"""Frames of a held or slowly moving probe count for what they are worth."""

from __future__ import annotations

import re
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
import scipy.signal
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.calibration.dependence import (
    autocorrelation,
    correlation_time,
    displacement,
    independent,
    same_pose,
)
from jaxcal.calibration.resampling import relative_twist
from jaxcal.calibration.serial_correlation import _cosine_transform, _covariances, widened
from jaxcal.data.problem import Channels
from jaxcal.data.recording import make_images
from jaxcal.diagnostics import frame_checks
from jaxcal.diagnostics.influence import WhitenedErrors, influence_of, whitened_errors
from jaxcal.model.image_points import rms_distance
from jaxcal.report.accuracy import GOOD_MM
from jaxcal.report.record import calibration_record, further_unknowns
from jaxcal.runtime.arrays import batch_of_one


@pytest.fixture(scope="module")
def frames():
    """The experiment, whose recordings these are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[1] / "experiments")
        yield import_module("dependent_frames")


@pytest.mark.parametrize(("holds", "each"), [(4, 15), (6, 10), (10, 6), (25, 2)])
def test_a_hold_is_one_image_with_its_mean(frames, holds, each):
    made = frames.held(holds, each, np.random.default_rng(holds))
    joined, found = independent(jaxcal.Problem.from_arrays(made.poses, made.points))
    np.testing.assert_array_equal(found.group, np.repeat(np.arange(holds), each))
    assert (found.frames, found.poses, found.images) == (holds * each, holds, holds)
    assert f"{holds * each} frames, {holds} different poses" in found.words[0]
    middle = np.median if each >= 5 else np.mean
    expected = middle(made.points.reshape(holds, each, 2), axis=1)
    kept = np.asarray(joined.mask) > 0
    np.testing.assert_allclose(joined.measurements[kept], expected)
    shift = made.poses[:, :3, 3].reshape(holds, each, 3).mean(axis=1)
    np.testing.assert_allclose(joined.poses[kept, :3, 3], shift)
    # A second time there is nothing left to do.
    assert independent(joined)[0] is joined


def test_frames_of_frozen_tracking_are_left_out(frames):
    made = frames.held(30, 1, np.random.default_rng(4))
    poses, points = made.poses.copy(), made.points.copy()
    # Frozen for three images, the last one as a filter leaves it; a robot's hold, a wrong click.
    poses[8:10] = poses[7]
    poses[9, :3, 3] += 0.02
    poses[20:25], points[20:25] = poses[20], points[20]
    points[22] += 20.0
    problem = jaxcal.Problem.from_arrays(poses, points)
    joined, found = independent(problem)
    assert found.frozen == (7, 8, 9)
    np.testing.assert_array_equal(np.flatnonzero(joined.mask == 0), [7, 8, 9, 20, 21, 23, 24])
    np.testing.assert_allclose(joined.measurements[22], points[20])
    assert "left out 3 images, counted from 0" in found.words[0]
    assert found.words[0].endswith(": 7 to 9")
    result = jaxcal.calibrate(problem, "conventional")
    assert found.words[0] in result.warnings


def test_order_and_unused_images_do_not_matter(frames):
    made = frames.held(8, 6, np.random.default_rng(1))
    order = np.random.default_rng(2).permutation(48)
    mask = np.random.default_rng(3).random(48) < 0.7
    group = same_pose(made.poses[order], mask)
    assert (group[~mask] == -1).all()
    truth = np.repeat(np.arange(8), 6)[order]
    same = truth[:, None] == truth
    np.testing.assert_array_equal(
        (group[:, None] == group)[np.ix_(mask, mask)], same[mask][:, mask]
    )


def test_different_poses_are_left_alone(frames):
    for count in (54, 3000):
        made = frames.held(count, 1, np.random.default_rng(count))
        problem = jaxcal.Problem.from_arrays(made.poses, made.points)
        assert independent(problem)[0] is problem


def test_a_chain_of_near_poses_is_no_hold():
    """A sweep in steps of 0.4 mm over 40 mm: pieces of a millimetre, not one pose."""
    poses = np.tile(np.eye(4), (101, 1, 1))
    poses[:, 0, 3] = 0.4 * np.arange(101)
    group = same_pose(poses, np.ones(101, bool))
    for number in range(group.max() + 1):
        members = poses[group == number]
        assert displacement(members, members[:1]).max() <= 2.0
    assert 20 <= group.max() + 1 <= 41


def test_a_sweep_between_other_poses_takes_none_of_them():
    poses, swept = np.tile(np.eye(4), (36, 1, 1)), np.arange(36) % 3 == 0
    poses[swept, 0, 3] = 0.8 * np.arange(12)
    poses[~swept, 1, 3] = 50.0 * np.arange(1, 25)
    group = same_pose(poses, np.ones(36, bool))
    assert len(set(group[~swept])) == 24
    assert not set(group[~swept]) & set(group[swept])
    # A piece begins with a pose farther than 1 mm from the beginnings before it.
    np.testing.assert_array_equal(group[swept], np.repeat(group[swept][::2], 2))


def test_the_memory_for_a_long_hold_is_that_of_its_frames(frames):
    made = frames.held(4, 800, np.random.default_rng(7))
    tracemalloc.start()
    try:
        group = same_pose(made.poses, np.ones(3200, bool))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(group, np.repeat(np.arange(4), 800))
    # All pairs of a hold would take 800 times as much.
    assert peak < 50 * made.poses.nbytes


def test_few_poses_are_refused_with_their_count(frames, tmp_path):
    made = frames.held(3, 20, np.random.default_rng(5))
    message = "60 images, but only 3 different poses: at least 4 are needed"
    data = jaxcal.Problem.from_arrays(made.poses, made.points)
    for method in ("joint", "conventional"):
        with pytest.raises(jaxcal.InputError, match=message):
            jaxcal.calibrate(data, method)
    with pytest.raises(jaxcal.InputError, match=message):
        jaxcal.cross_validate(data)
    path = tmp_path / "held.h5"
    jaxcal.save(jaxcal.Recording(make_images(made.poses, made.points)), path)
    command = [sys.executable, "-m", "jaxcal", "calibrate", str(path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""


def test_channels_and_covariances_are_joined(frames):
    rng = np.random.default_rng(6)
    made = frames.held(5, 6, rng)
    one = rng.uniform(0.1, 0.2, 30)[:, None, None] * np.eye(2)
    plain = jaxcal.Problem.from_arrays(made.poses, made.points, covariance=one)
    heard = (rng.random((30, 8)) < 0.8).astype(float)
    distances = heard * rng.uniform(20, 30, (30, 8))
    data = replace(
        plain,
        channels=Channels(*map(jnp.asarray, (distances, heard, rng.random((8, 3))))),
    )
    joined, found = independent(data)
    assert joined.channels is not None
    for number, kept in enumerate(np.flatnonzero(found.keep)):
        rows = slice(6 * number, 6 * number + 6)
        share = heard[rows].mean(axis=0)
        np.testing.assert_array_equal(joined.channels.heard[kept], share >= 0.5)
        total = distances[rows].sum(axis=0) / np.maximum(heard[rows].sum(axis=0), 1)
        np.testing.assert_allclose(joined.channels.distances[kept], total)
        np.testing.assert_allclose(joined.covariance[kept], one[rows].mean(axis=0))


@pytest.mark.parametrize("alike", [10, 40])
def test_correlation_time(frames, alike):
    """Exponential correlation over ``alike`` images: their integrated time is twice that."""
    rng = np.random.default_rng(alike)
    times = [
        correlation_time(autocorrelation(frames.slow(3000, np.exp(-1 / alike), rng)))
        for _ in range(40)
    ]
    assert np.median(times) == pytest.approx(2 * alike, rel=0.25)


def whitened(errors: np.ndarray, rows: np.ndarray) -> WhitenedErrors:
    """Lateral, range and elevational errors in their own SDs."""
    every = np.ones(len(rows))
    return WhitenedErrors(errors, rows, np.arange(3), 0 * every, every > 0, np.ones(3))


def _linear_answers(order, correlation: float, share: float = 1.0):
    """Errors of answers from 40 images on a slow path, in their SDs, and how these were widened.

    A share of the variance of every kind of error has this correlation in successive images.
    """
    rng, count = np.random.default_rng(7), 40
    errors, widening = [], []
    for _ in range(60):
        phase, period = rng.uniform(0, 2 * np.pi, (3, 6)), rng.uniform(20, 60, (3, 6))
        rows = np.sin(2 * np.pi * np.arange(count)[:, None, None] / period + phase)[order(rng)]
        steps = rng.normal(size=(count, 3)) * np.sqrt(1 - correlation**2)
        steps[0] /= np.sqrt(1 - correlation**2)
        drift = scipy.signal.lfilter([1.0], [1.0, -correlation], steps, axis=0)
        own = rng.normal(size=(count, 3))
        drawn = np.sqrt(share) * drift + np.sqrt(1 - share) * own
        inverse = np.linalg.inv(np.einsum("mkp,mkq->pq", rows, rows))
        moved = inverse @ np.einsum("mkp,mk->p", rows, drawn)
        before, after = _covariances(whitened(drawn - rows @ moved, rows), np.zeros(6))
        np.testing.assert_allclose(before, inverse, rtol=1e-9)
        errors.append(moved / np.sqrt(np.diag(after)))
        widening.append(np.sqrt(np.diag(after) / np.diag(before)))
    return np.array(errors), np.array(widening)


def test_the_covariance_holds_along_a_slow_path_whatever_the_correlation():
    for correlation, share in [(0.0, 1.0), (0.3, 1.0), (0.6, 1.0), (0.8, 0.5)]:
        errors, widening = _linear_answers(lambda rng: slice(None), correlation, share)
        assert (widening >= 1 - 1e-9).all()
        assert 0.9 < np.mean(np.abs(errors) < 1.96) < 0.99, (correlation, share)
        assert 0.75 < np.sqrt(np.mean(errors**2)) < 1.25, (correlation, share)


def test_errors_hardly_widen_a_covariance_where_poses_change_at_random():
    _, independent_errors = _linear_answers(lambda rng: rng.permutation(40), 0.0)
    _, correlated_errors = _linear_answers(lambda rng: rng.permutation(40), 0.6)
    assert independent_errors.mean() < 1.04
    assert correlated_errors.mean() < 1.3


def _good_and_wrong(made) -> tuple[bool, bool]:
    """Whether the verdict is good or fair, and whether the error is then above its interval."""
    result = jaxcal.calibrate(jaxcal.Problem.from_arrays(made.poses, made.points))
    record = result.record()
    if record["verdict"] not in ("good", "fair"):
        return False, False
    error = rms_distance(np.asarray(result.image_to_probe), made.image_to_probe, made.points)
    return True, bool(error > record["tre"]["interval_95_mm"][1])


@pytest.mark.parametrize(("count", "step_s", "most"), [(15, 0.5, 1), (30, 0.5, 1), (100, 0.05, 1)])
def test_a_smooth_sweep_is_seldom_good_and_wrong(frames, count, step_s, most):
    """Its offsets change as slowly as its poses. Without such models 9, 5 and 6 were."""
    made = [frames.smooth(count, step_s, np.random.default_rng([3, k])) for k in range(20)]
    assert sum(_good_and_wrong(one)[1] for one in made) <= most


def test_unknowns_that_a_short_path_hardly_tells_apart_are_no_error(frames):
    """The Cholesky factor of their covariance did not exist."""
    for seed in (13, 16, 26):
        made = frames.smooth(20, 0.1, np.random.default_rng([5, seed]))
        result = jaxcal.calibrate(jaxcal.Problem.from_arrays(made.poses, made.points))
        assert not _good_and_wrong(made)[1]
        assert result.verdict()


def test_a_slow_path_is_believed_where_offsets_were_drawn_anew(frames):
    made = [frames.smooth(30, 0.5, np.random.default_rng([4, k]), anew=True) for k in range(8)]
    good, wrong = np.sum([_good_and_wrong(one) for one in made], axis=0)
    assert good >= 7
    assert wrong == 0


def test_a_longer_smooth_sweep_is_believed(frames):
    """With powers of the frequency as the only spectra, two of these were, and 5 mm expected.

    With the size of the errors taken as known, nine were. It is known from six values here.
    """
    made = [frames.smooth(60, 0.5, np.random.default_rng([6, k])) for k in range(12)]
    good, wrong = np.sum([_good_and_wrong(one) for one in made], axis=0)
    assert good >= 7
    assert wrong <= 1


def test_cosine_transform_is_scipys():
    values = np.random.default_rng(1).normal(size=(9, 3, 4))
    expected = scipy.fft.dct(values, axis=0, norm="ortho")
    np.testing.assert_allclose(_cosine_transform(values), expected, atol=1e-14)


def test_held_probes_are_covered_and_never_good(frames):
    """Joint calibrations of 60 frames, default prior: the truth is where they say it is."""
    inside, images = [], 0
    for trial in range(10):
        for holds in (4, 6, 10):
            made = frames.held(holds, 60 // holds, np.random.default_rng([holds, trial]))
            result = jaxcal.calibrate(jaxcal.Problem.from_arrays(made.poses, made.points))
            images += int(result.images_used) - holds
            assert result.notes[0] in result.warnings
            if result.status != "converged":
                continue
            error = frames.right_errors(
                np.asarray(result.image_to_probe)[None], made.image_to_probe[None]
            )[0]
            inside.append(np.abs(error) <= jaxcal.transform_intervals(result, 0.95))
            outside = (np.abs(error) > jaxcal.transform_intervals(result, 0.99)).any()
            assert float(frames.stated_tre(result)) > GOOD_MM or not outside
    assert images == 0
    assert len(inside) > 20
    assert np.mean(inside) > 0.93


def test_a_record_is_of_the_images_of_the_solve(frames):
    """Not of all frames: what the command line says is what is said in Python."""
    made = frames.held(25, 4, np.random.default_rng(5))
    probe = jaxcal.LinearProbe()
    recording = jaxcal.Recording(make_images(made.poses, made.points), probe=probe)
    result = jaxcal.calibrate(recording, "conventional")
    told, own = calibration_record(result, recording), result.record()
    for name in ("reconstruction_precision_mm", "tre", "influence"):
        assert told[name] == own[name]


def test_correlated_errors_widen_the_covariance(frames):
    """Images a second and a half apart, still with like errors, which a batch ignores."""
    made = [frames.swept(120, 2.0, np.random.default_rng([11, trial])) for trial in range(40)]
    problems = [jaxcal.Problem.from_arrays(one.poses[::30], one.points[::30]) for one in made]

    def calibrated(one):
        try:
            return jaxcal.calibrate(one, "conventional")
        except jaxcal.InputError as refusal:
            # Of a stream too few images are left.
            if "that are independent" not in str(refusal):
                raise
            return None

    wide = [calibrated(one) for one in problems]
    plain = jaxcal.calibrate_batch(jaxcal.stack(problems), method="conventional")
    # Where a recording is taken for a stream, fewer images are left to be correlated.
    used = [k for k, one in enumerate(wide) if one is not None and not one.notes]
    assert len(used) > 30

    def spreads(results):
        return np.array([np.sqrt(np.diag(np.asarray(results[k].covariance))) for k in used])

    found = np.array([np.asarray(wide[k].image_to_probe) for k in used])
    expected = [np.asarray(plain[k].image_to_probe) for k in used]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    error = frames.right_errors(found, np.array([made[k].image_to_probe for k in used]))
    before, after = spreads(plain), spreads(wide)
    assert (after >= before * (1 - 1e-9)).all()
    assert np.mean(after / before) > 1.08
    assert (np.abs(error) <= 2 * after).mean() > (np.abs(error) <= 2 * before).mean() + 0.01
    for k, wider in zip(used, after, strict=True):
        lines = wide[k].linearisation
        inverse = np.linalg.inv(np.asarray(lines.information))
        np.testing.assert_allclose(np.sqrt(np.diag(inverse)[:6] * lines.variance), wider, rtol=1e-6)


@pytest.fixture(scope="module")
def correlated(frames):
    """A calibration whose errors are alike in successive images, and the one without that."""
    made = frames.swept(120, 2.0, np.random.default_rng([11, 3]))
    problem = jaxcal.Problem.from_arrays(made.poses[::30], made.points[::30])
    wide = jaxcal.calibrate(problem, "conventional", estimate="sound-speed")
    assert not wide.notes
    errors = whitened_errors(batch_of_one(wide))
    plain = errors.covariances(np.zeros(10))[1]
    assert np.trace(wide.covariance) > 1.2 * np.trace(plain[:6, :6])
    return wide, plain


def test_leaving_an_image_out_is_foretold_where_errors_are_alike(correlated):
    wide, plain = correlated
    found = influence_of(wide)
    np.testing.assert_allclose(found.model_covariance, plain, rtol=1e-6)
    sd = np.sqrt(np.diagonal(plain))
    for image in (3, 17):
        mask = np.array(wide.problem.mask)
        mask[image] = 0.0
        without = jaxcal.calibrate(
            replace(wide.problem, mask=mask), "conventional", estimate="sound-speed"
        )
        twist = relative_twist(*(jnp.asarray(one.image_to_probe) for one in (wide, without)))
        np.testing.assert_allclose(found.moved[image, :6] / sd[:6], twist / sd[:6], atol=0.03)


def test_the_sound_speed_is_as_uncertain_as_its_covariance_says(correlated):
    found = correlated[0].medium
    speed, sd = found.sound_speed_m_s, found.sound_speed_sd_m_s
    whole = np.asarray(correlated[0].unknowns_covariance)
    assert float(sd) == pytest.approx(float(speed) * whole[9, 9] ** 0.5, rel=1e-9)
    told = further_unknowns(correlated[0].numpy())["sound-speed"]
    nominal = float(np.asarray(correlated[0].problem.nominal_sound_speed))
    assert told["tangents"] == ("log_sound_speed",)
    assert told["values"] * nominal == pytest.approx([float(speed)], rel=1e-9)
    assert told["sd"] * speed == pytest.approx([float(sd)], rel=1e-9)
    assert told["prior_sd"] is None


def test_alike_errors_count_the_same_whether_they_are_the_trackers_or_not(correlated):
    """A tracker's error moves the target along all axes, as errors of the measurements do."""
    tau, sigma = 0.8, np.array([0.1, 0.2, 0.6])
    whole = np.hypot(sigma, tau)
    joint = replace(correlated[0], prior="gaussian", sigma=whole)
    within = np.asarray(joint.elevation) * (sigma[2] / whole[2]) ** 2
    lines = replace(joint.linearisation, tracker_sd=np.asarray(tau))
    tracked = replace(joint, sigma=sigma, elevation=within, linearisation=lines)
    expected, found = (
        np.diagonal(widened(one).unknowns_covariance) / np.diagonal(one.unknowns_covariance)
        for one in (joint, tracked)
    )
    assert expected.max() > 1.2
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_alike_errors_leave_a_prior_as_it_is():
    rng = np.random.default_rng(2)
    rows = np.concatenate([rng.normal(size=(40, 3, 4)), np.zeros((40, 3, 1))], axis=2)
    # The last two unknowns are told by their sum alone, and one of them by its prior.
    rows[..., 4] = rows[..., 3]
    rows[1:] = 0.9 * rows[:-1].cumsum(axis=0) / np.arange(1, 40)[:, None, None] + 0.1 * rows[1:]
    slow = np.cumsum(rng.normal(size=(40, 3)), axis=0)
    before, after = _covariances(whitened(slow, rows), np.array([0.0, 0.0, 0.0, 0.0, 1e-4]))
    assert before[4, 4] == pytest.approx(1e4)
    assert after[4, 4] == pytest.approx(1e4)
    assert after[0, 0] > 1.5 * before[0, 0]


def test_another_sound_speed_costs_no_images_where_it_is_estimated(frames):
    made = frames.swept(120, 0.05, np.random.default_rng([5, 0]))
    poses, points = made.poses[::10], made.points[::10] * [1.0, 0.97]
    for face in (0.0, 5.0):
        images = make_images(poses, points - [0.0, face], face_offset_mm=face)
        problem = jaxcal.Problem.from_recording(images)
        assert independent(problem)[1].stride > 1
        assert independent(problem, ("sound-speed",))[1].stride == 1


@pytest.mark.parametrize(("by", "words"), [(1, "one row out of step"), (20, "about 20 rows after")])
def test_poses_of_other_times_are_told_and_cost_no_images(frames, by, words):
    """Their errors are alike for as long as the motion lasts, and a few images would fit them."""
    made = frames.swept(120, 0.05, np.random.default_rng([5, 1]))
    poses, points = made.poses[::10], made.points[::10]
    joined, found = independent(jaxcal.Problem.from_arrays(poses[:-by], points[by:]))
    assert found.images == len(points) - by > 1.4 * frame_checks.MOST_IMAGES
    assert words in (frame_checks.wrong_frames(joined) or "")


def test_a_long_stream_keeps_sixty_images_where_errors_widen_the_covariance(frames):
    """Only as many were kept as are independent: about fifteen."""
    made = frames.swept(30, 1.0, np.random.default_rng(5))
    _, found = independent(jaxcal.Problem.from_arrays(made.poses, made.points), widened=True)
    assert 60 <= found.images < 2 * 60
    assert 20 < found.alike < found.poses / 4
    (told,) = found.words
    alike = int(re.search(r"stay alike for about (\d+) frames", told)[1])
    assert alike == round(found.alike * found.frames / found.poses)
    assert f"{found.images} of them are used" in told


def test_errors_alike_in_a_few_images_cost_none_where_they_widen_the_covariance(frames):
    """One image in five or ten was kept, with up to three times the error, or too few were left."""
    made = frames.along(100, 0.7, np.random.default_rng([77, 2]))
    data = jaxcal.Problem.from_arrays(made.poses, made.points)
    assert independent(data, widened=True)[0] is data
    result = jaxcal.calibrate(data, "conventional")
    assert result.images_used == 100
    assert not result.notes
    # A bound on the offsets leaves no covariance to be widened.
    bounded = jaxcal.calibrate(data, "alternating", max_elevation=3.0)
    assert 4 <= bounded.images_used < 30
    assert "stay alike" in bounded.notes[0]


def test_negligible_errors_cost_no_images_however_slowly_they_change():
    """A planned target in the plane leaves offsets of hundredths of a mm: the fit's own error."""
    rng = np.random.default_rng(3)
    count = 60
    t = np.linspace(0, 6, count)
    turns = 0.4 * np.column_stack([np.sin(t), np.cos(1.3 * t), np.sin(0.7 * t)])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    q = np.column_stack([15 * np.sin(2 * t), np.zeros(count), 50 + 25 * np.cos(t)])
    poses[:, :3, 3] = [10.0, 20.0, 30.0] - np.einsum("nij,nj->ni", poses[:, :3, :3], q)
    points = q[:, [0, 2]] + rng.normal(0, 0.2, (count, 2))
    assert independent(jaxcal.Problem.from_arrays(poses, points))[1].images == count
