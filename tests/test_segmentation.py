"""From times of flight to points: unbiased, with covariances that hold, and hard to spoil."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import jaxcal
from jaxcal import InputError
from jaxcal.cli.main import main
from jaxcal.data.probe import C5_2, L14_5, LinearProbe
from jaxcal.data.recording import Recording, make_images
from jaxcal.data.segmentation.segment import OutOfPlane, compiled_fit, segment, segment_recording
from jaxcal.data.segmentation.time_of_flight import fit_in_plane, fit_out_of_plane, shortest
from jaxcal.diagnostics.metrics import reconstruct
from jaxcal.study.simulation import Protocol, simulate_recording, times_of_flight

FRAMES = 2000
SEED = 20261121
SIGMAS = (0.05, 0.5, 2.0)


def draw(probe, frames, noise, *, elevation=0.0, seed=SEED):
    """Truth [lateral, elevation, axial] (mm) in the field, and noisy distances."""
    generator = np.random.default_rng(seed)
    depth, y = generator.uniform(10, 90, frames), elevation * generator.uniform(-1, 1, frames)
    if probe.kind == "linear":
        plane = np.stack([generator.uniform(-29.25, 29.25, frames), depth], axis=1)
    else:
        angle = 0.9 * probe.half_angle_rad * generator.uniform(-1, 1, frames)
        plane = probe.polar_to_cartesian(angle, depth)
    truth = np.stack([plane[:, 0], y, plane[:, 1]], axis=1)
    exact = np.linalg.norm(truth[:, None] - probe.element_positions(), axis=-1)
    return truth, exact + noise * generator.normal(size=exact.shape)


def lose(distances, fraction, seed=7):
    return np.where(
        np.random.default_rng(seed).random(distances.shape) < fraction, np.nan, distances
    )


def disturb(distances, fraction, seed=8):
    """Reflections, 3 to 40 mm late, and the echoes of lines up to 20 elements away, in halves."""
    generator = np.random.default_rng(seed)
    shape = distances.shape
    late = distances + generator.uniform(3, 40, shape)
    neighbour = np.arange(shape[1]) + generator.integers(-20, 21, shape)
    other = np.take_along_axis(distances, np.clip(neighbour, 0, shape[1] - 1), axis=1)
    wrong = np.where(generator.random(shape) < 0.5, late, other)
    return np.where(generator.random(shape) < fraction, wrong, distances)


def squared_error(error, covariance):
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)


def poses(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(5).uniform(-50, 50, (count, 3))
    return poses


def raw(distances, probe, **others):
    times = probe.time_of_flight_s(distances)
    return make_images(poses(len(times)), times, "time_of_flight", **others)


def test_distance_fit_agrees_with_scipy_and_its_covariance_holds():
    rng = np.random.default_rng(0)
    elements = L14_5.element_lateral()
    truth = np.stack([rng.uniform(-29, 29, 400), rng.uniform(10, 90, 400)], axis=1)
    exact = np.hypot(truth[:, :1] - elements, truth[:, 1:])
    distances = exact + 0.5 * rng.normal(size=exact.shape)
    fit = compiled_fit(False, False)(distances, L14_5.element_positions())
    points, inverse = np.asarray(fit.position), np.asarray(fit.inverse_normal)
    for k in range(0, 400, 40):

        def residual(p, k=k):
            return np.hypot(p[0] - elements, p[1]) - distances[k]

        np.testing.assert_allclose(points[k], least_squares(residual, truth[k]).x, atol=1e-5)
    squared = squared_error(points - truth, 0.25 * inverse)
    # Mean of 400 chi-squares with 2 degrees of freedom: 2 with an SD of 0.1.
    assert 1.7 < squared.mean() < 2.3


def test_exact_distances_give_the_point_from_anywhere_in_the_field():
    elements = L14_5.element_positions()
    x, r = np.meshgrid(np.linspace(-40, 40, 9), np.linspace(5, 120, 9))
    exact = np.hypot(x[..., None] - elements[:, 0], r[..., None])
    for points in (
        compiled_fit(False, False)(exact, elements).position,
        compiled_fit(False, True)(exact, elements).position,
    ):
        np.testing.assert_allclose(points[..., 0], x, atol=1e-9)
        np.testing.assert_allclose(points[..., 1], r, atol=1e-9)


# -- least squares on Eq. 5, linear arrays


@pytest.mark.parametrize("robust", [False, True])
def test_fused_fit_is_the_least_squares_solution(robust):
    _, distances = draw(L14_5, 60, 0.5)
    distances = lose(distances, 0.3)
    positions = L14_5.element_positions()
    fit = compiled_fit(False, robust)(distances, positions)
    for k in range(0, 60, 15):
        there = np.isfinite(distances[k])
        scale = float(fit.noise[k])

        def residual(p, k=k, there=there, scale=scale):
            e = np.hypot(p[0] - positions[there, 0], p[1]) - distances[k, there]
            if not robust:
                return e
            # The root of Tukey's loss: the fit minimises it at its own scale.
            return np.sqrt(1 - np.maximum(1 - (e / (4.685 * scale)) ** 2, 0) ** 3)

        start = np.asarray(fit.position[k])
        found = least_squares(residual, start, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        np.testing.assert_allclose(start, found, atol=2e-3 if robust else 1e-6)


def check_linear(frames, tolerance):
    """Done-when 1: bias below 0.1 SD, mean squared normalised error 2, and what outliers cost."""
    for noise in SIGMAS:
        truth, clean = draw(L14_5, frames, noise)
        truth = truth[:, [0, 2]]
        error = {}
        for robust in (False, True):
            for name, distances in (("complete", clean), ("missing", lose(clean, 0.2))):
                found = segment(raw(distances, L14_5), L14_5, robust=robust)
                assert found.images.mask.all()
                error[name, robust] = found.images.measurements - truth
                bias = error[name, robust].mean(axis=0) / error[name, robust].std(axis=0)
                assert np.abs(bias).max() < 0.1
                squared = squared_error(error[name, robust], found.images.covariance)
                assert abs(squared.mean() - 2.0) < tolerance
                assert np.median(found.noise_mm) == pytest.approx(noise, rel=0.03)
        spoiled = segment(raw(disturb(clean, 0.1), L14_5), L14_5)
        growth = np.sqrt(
            ((spoiled.images.measurements - truth) ** 2).mean(axis=0)
            / (error["complete", True] ** 2).mean(axis=0)
        )
        assert growth.max() < 1.3
        plain = segment(raw(disturb(clean, 0.1), L14_5), L14_5, robust=False).images.measurements
        assert np.sqrt(((plain - truth) ** 2).mean(axis=0)).min() > 1.2


def test_linear_points_are_unbiased_and_their_covariance_holds():
    # A mean of 2,000 chi-squares of 2 degrees of freedom has an SD of 0.045.
    check_linear(FRAMES, tolerance=0.2)


@pytest.mark.slow
def test_linear_points_over_five_thousand_frames():
    # An SD of 0.028.
    check_linear(5000, tolerance=0.1)


def test_outliers_are_counted():
    _, clean = draw(L14_5, 200, 0.05)
    late = clean.copy()
    late[:, ::16] += 10.0
    found = segment(raw(lose(late, 0.1), L14_5), L14_5)
    there = np.isfinite(lose(late, 0.1))
    np.testing.assert_array_equal(found.missing, (~there).sum(axis=1))
    np.testing.assert_array_equal(found.lines, there.sum(axis=1))
    extra = found.rejected - there[:, ::16].sum(axis=1)
    # All late lines, and a good one hardly ever: beyond 4.7 SD.
    assert extra.min() >= 0
    assert extra.mean() < 0.05
    assert any("did not answer" in text for text in found.warnings) == ((~there).mean() > 0.1)


def test_frames_full_of_reflections_do_no_harm():
    truth, clean = draw(L14_5, 400, 0.1)
    generator = np.random.default_rng(2)
    share = np.where(np.arange(400) % 20 == 0, 0.6, 0.2)[:, None]
    late = clean + generator.uniform(3, 40, clean.shape)
    found = segment(raw(np.where(generator.random(clean.shape) < share, late, clean), L14_5), L14_5)
    error = np.abs(found.images.measurements - truth[:, [0, 2]]).max(axis=1)
    assert error[found.images.mask].max() < 0.5
    assert not found.failed[share[:, 0] < 0.5].any()
    assert found.failed[share[:, 0] > 0.5].any()


def test_pooled_noise_serves_frames_with_few_lines():
    truth, clean = draw(L14_5, FRAMES, 0.5)
    sparse = clean.copy()
    sparse[:, np.arange(128) % 12 != 5] = np.nan
    own = segment(raw(sparse, L14_5), L14_5, robust=False)
    pooled = segment(raw(sparse, L14_5), L14_5, robust=False, scale="pooled")
    assert (own.lines == 11).all()

    def mean_square(found):
        error = found.images.measurements - truth[:, [0, 2]]
        return squared_error(error, found.images.covariance).mean()

    # 9 degrees of freedom: twice an F(2, 9), whose mean is 9/7.
    assert mean_square(own) == pytest.approx(2 * 9 / 7, rel=0.12)
    assert mean_square(pooled) == pytest.approx(2.0, rel=0.12)


def test_bad_frames_do_not_touch_their_neighbours():
    _, clean = draw(L14_5, 64, 0.5)
    spoiled = clean.copy()
    spoiled[3], spoiled[10, 2:], spoiled[20] = np.nan, np.nan, -1.0
    for robust in (False, True):
        fit, other = (compiled_fit(False, robust)(d, L14_5.element_positions())
                      for d in (clean, spoiled))  # fmt: skip
        good = ~np.isin(np.arange(64), [3, 10, 20])
        np.testing.assert_array_equal(fit.position[good], other.position[good])
        assert np.isnan(np.asarray(other.position)[[3, 10, 20]]).all()


def test_any_leading_axes_and_transformations():
    _, distances = draw(L14_5, 12, 0.5)
    positions = L14_5.element_positions()
    fit = jax.jit(fit_in_plane, static_argnames="robust")
    flat = fit(distances, positions, robust=True)
    nested = fit(distances.reshape(3, 4, -1), positions, robust=True)
    mapped = jax.jit(jax.vmap(lambda d: fit_in_plane(d, positions, robust=True)))(
        jnp.asarray(distances)
    )
    assert nested.inverse_normal.shape == (3, 4, 2, 2)
    np.testing.assert_allclose(nested.position.reshape(12, 2), flat.position, atol=1e-11)
    np.testing.assert_allclose(mapped.position, flat.position, atol=1e-11)
    lone = fit(distances[0], positions, robust=True)
    np.testing.assert_allclose(lone.position, flat.position[0], atol=1e-11)


# -- Eq. 6, curvilinear arrays


def curvilinear(noise, elevation, fraction=0.0, robust=True, frames=FRAMES):
    truth, distances = draw(C5_2, frames, noise, elevation=elevation)
    found = segment(raw(lose(distances, fraction), C5_2), C5_2, robust=robust)
    assert isinstance(found.out_of_plane, OutOfPlane)
    exact = np.stack([truth[:, 0], truth[:, 2], truth[:, 1] ** 2], axis=1)
    return exact, found, found.out_of_plane


@pytest.mark.parametrize("robust", [False, True])
def test_curvilinear_covariance_holds(robust):
    for noise, fraction in zip(SIGMAS, (0.2, 0.0, 0.2), strict=True):
        exact, _, full = curvilinear(noise, 5.0, fraction, robust, frames=4000)
        error = full.position - exact
        assert np.abs(error.mean(axis=0) / error.std(axis=0)).max() < 0.1
        own = error[:, 2] ** 2 / full.covariance[:, 2, 2]
        assert own.mean() == pytest.approx(1.0, abs=0.1)
        # In lateral, axial and lateral^2 + axial^2 + y^2 the problem is all but linear.
        x, z, _ = full.position.T
        jacobian = np.tile(np.eye(3), (len(x), 1, 1))
        jacobian[:, 2, 0], jacobian[:, 2, 1] = 2 * x, 2 * z
        error[:, 2] = (full.position[:, :2] ** 2 - exact[:, :2] ** 2).sum(axis=1) + error[:, 2]
        linear = jacobian @ full.covariance @ jacobian.swapaxes(1, 2)
        assert squared_error(error, linear).mean() == pytest.approx(3.0, abs=0.15)


def test_elevation_squared_may_be_negative_and_is_then_not_determined():
    _, _, full = curvilinear(0.5, 3.0)
    share = (full.position[:, 2] <= 0).mean()
    assert 0.3 < share < 0.55
    assert (full.elevation >= 0).all()
    assert not full.determined[full.position[:, 2] <= 0].any()
    assert full.determined.mean() < 0.02
    assert np.isnan(full.elevation_sd[~full.determined]).all()


def test_elevation_and_its_sd_where_it_is_determined():
    truth, distances = draw(C5_2, FRAMES, 0.02, elevation=0.0)
    truth[:, 1] = np.random.default_rng(4).uniform(11, 15, FRAMES)
    exact = np.linalg.norm(truth[:, None] - C5_2.element_positions(), axis=-1)
    distances = exact + 0.02 * np.random.default_rng(6).normal(size=exact.shape)
    full = segment(raw(distances, C5_2), C5_2).out_of_plane
    assert isinstance(full, OutOfPlane)
    assert full.determined.mean() > 0.95
    kept = full.determined
    error = full.elevation[kept] - truth[kept, 1]
    assert abs(error.mean() / error.std()) < 0.1
    assert (error**2 / full.elevation_sd[kept] ** 2).mean() == pytest.approx(1.0, abs=0.12)


def test_in_plane_points_of_a_curvilinear_array_hold():
    truth, distances = draw(C5_2, FRAMES, 0.5)
    found = segment(raw(disturb(distances, 0.1), C5_2), C5_2).images
    error = found.measurements - truth[:, [0, 2]]
    assert squared_error(error, found.covariance).mean() == pytest.approx(2.0, abs=0.25)


def test_elevation_agrees_with_scipy():
    truth, distances = draw(C5_2, 6, 0.2, elevation=5.0)
    positions = C5_2.element_positions()
    plane, full = jax.tree.map(
        np.asarray, jax.jit(partial(fit_out_of_plane, steps=8))(distances, positions)
    )
    for k in range(6):

        def model(p):
            return np.sqrt((p[0] - positions[:, 0]) ** 2 + (p[1] - positions[:, 2]) ** 2 + p[2])

        def jacobian(p):
            columns = [p[0] - positions[:, 0], p[1] - positions[:, 2], np.full(128, 0.5)]
            return np.stack(columns, axis=1) / model(p)[:, None]

        start = [truth[k, 0], truth[k, 2], 25.0]
        best = least_squares(
            lambda p, k=k: model(p) - distances[k], start, jac=jacobian,
            x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15,
        )  # fmt: skip
        np.testing.assert_allclose(full.position[k], best.x, rtol=1e-5, atol=1e-3)
        normal = best.jac.T @ best.jac
        np.testing.assert_allclose(full.inverse_normal[k], np.linalg.inv(normal), rtol=1e-3)
        flat = least_squares(lambda p, k=k: model([*p, 0.0]) - distances[k], start[:2])
        np.testing.assert_allclose(plane.position[k], flat.x, atol=1e-5)


# -- the shortest time of flight, Eqs. 2 and 3


@pytest.mark.parametrize("probe", [L14_5, C5_2])
def test_shortest_time_gives_the_nearest_element(probe):
    truth, exact = draw(probe, 400, 0.0)
    line, depth = probe.cartesian_to_image(truth)
    found = segment(raw(exact, probe), probe, method="shortest")
    assert found.images.covariance is None
    got_line, got_depth = probe.cartesian_to_image(found.images.measurements)
    np.testing.assert_allclose(got_line, np.clip(np.round(line), 0, 127), atol=1e-6)
    assert (got_depth - depth >= -1e-9).all()
    # Half a pitch beside the nearest element, at the least depth.
    assert (got_depth - depth).max() < 0.5 * (probe.pitch_mm) ** 2 / 10
    inside = (line > 0.5) & (line < 126.5)
    between = segment(raw(exact, probe), probe, method="shortest", interpolate=True)
    fine_line, fine_depth = probe.cartesian_to_image(between.images.measurements)
    np.testing.assert_allclose(fine_line[inside], line[inside], atol=1e-3)
    np.testing.assert_allclose(fine_depth[inside], depth[inside], atol=1e-5)


def test_shortest_time_with_gaps():
    distances = np.array([
        [5.0, np.nan, 4.0, 4.5, 6.0],
        [np.nan] * 5,
        [np.nan, np.nan, np.nan, np.nan, 7.0],
        [3.0, 4.0, 5.0, 6.0, 7.0],
    ])  # fmt: skip
    for pitch in (None, 1.0):
        line, least = jax.jit(partial(shortest, pitch_mm=pitch))(distances)
        np.testing.assert_array_equal(line, [2, np.nan, 4, 0])
        np.testing.assert_array_equal(least, [4.0, np.nan, 7.0, 3.0])


def test_least_squares_beats_the_shortest_time():
    truth, distances = draw(L14_5, 500, 0.5)
    rms = {}
    for method in ("least-squares", "shortest"):
        points = segment(raw(distances, L14_5), L14_5, method=method).images.measurements
        rms[method] = np.sqrt(((points - truth[:, [0, 2]]) ** 2).mean(axis=0))
    assert (rms["least-squares"] < 0.2 * rms["shortest"]).all()


# -- what comes in


def test_frames_without_answers_are_masked_and_counted():
    _, distances = draw(L14_5, 12, 0.5)
    distances[4], distances[9, 5:] = np.nan, np.nan
    mask = np.ones(12, bool)
    mask[1] = False
    images = raw(distances, L14_5, mask=mask, frame=np.arange(30, 42))
    found = segment(images, L14_5)
    np.testing.assert_array_equal(found.images.frame, images.frame)
    np.testing.assert_array_equal(np.flatnonzero(found.failed), [4, 9])
    np.testing.assert_array_equal(np.flatnonzero(~found.images.mask), [1, 4, 9])
    assert found.missing[4] == 128
    assert found.missing[1] == 0
    assert found.warnings[0] == "2 of 11 frames could not be segmented: 4, 9"
    assert "accepted=bool[12,128]" in repr(found)
    weak = segment(replace(images, amplitude=np.arange(12.0)), L14_5, minimum_amplitude=3.0)
    np.testing.assert_array_equal(np.flatnonzero(weak.failed), [0, 2, 4, 9])


@pytest.mark.parametrize(
    ("method", "least", "failed"),
    [("least-squares", None, [4, 9]), ("shortest", None, [4]), ("shortest", 6, [4, 9])],
)
def test_the_fewest_lines_of_a_frame_hold_for_both_methods(method, least, failed):
    _, distances = draw(L14_5, 12, 0.5)
    distances[4], distances[9, 5:] = np.nan, np.nan
    found = segment(raw(distances, L14_5), L14_5, method=method, minimum_lines=least)
    np.testing.assert_array_equal(np.flatnonzero(found.failed), failed)


@pytest.mark.parametrize("probe", [L14_5, C5_2], ids=["linear", "curvilinear"])
def test_times_at_the_end_of_the_receivers_window_are_no_answers(probe):
    """At 35 us half of the frames had nothing else, and ranges were 5 mm short without a word."""
    _, distances = draw(probe, 24, 0.2)
    times = probe.time_of_flight_s(distances)
    window = float(np.median(times))
    late = times > window
    assert late.all(axis=1).sum() > 4
    found = segment(make_images(poses(24), np.minimum(times, window), "time_of_flight"), probe)
    best = segment(make_images(poses(24), np.where(late, np.nan, times), "time_of_flight"), probe)
    few = late.sum(axis=1) <= 8  # cannot be told from ties of a clock; robust weights reject them
    kept = best.images.mask & ~few
    assert found.failed[late.all(axis=1)].all()
    np.testing.assert_array_equal(found.images.mask, best.images.mask)
    np.testing.assert_allclose(
        found.images.measurements[kept], best.images.measurements[kept], rtol=1e-12
    )
    assert any("the end of the receiver's window" in text for text in found.warnings)


def test_a_time_of_zero_is_no_answer_whatever_the_delay():
    """With a delay of -1 us they counted as echoes 1.5 mm away: ranges were 19 mm short."""
    probe = replace(L14_5, delay_s=-1e-6)
    _, distances = draw(probe, 12, 0.2)
    dead = np.random.default_rng(3).random(128) < 0.4
    silent = raw(np.where(dead, np.nan, distances), probe)
    zero = replace(silent, measurements=np.nan_to_num(silent.measurements))
    found, best = segment(zero, probe), segment(silent, probe)
    np.testing.assert_array_equal(found.missing, best.missing)
    np.testing.assert_array_equal(found.images.measurements, best.images.measurements)


def test_ties_of_a_slow_clock_are_answers():
    exact = np.hypot(L14_5.element_lateral(), np.linspace(60, 120, 24)[:, None])
    distances = 1.5 * np.round(exact / 1.5)
    assert ((distances == distances.max(axis=1, keepdims=True)).sum(axis=1) > 8).any()
    assert segment(raw(distances, L14_5), L14_5).missing.sum() == 0


def test_elements_in_another_order_are_named():
    """The points were up to 20 mm off, and nothing was said."""
    _, distances = draw(L14_5, 12, 0.2)
    images = raw(np.roll(distances, 64, axis=1), L14_5)
    assert any("order and the pitch" in text for text in segment(images, L14_5).warnings)
    noisy = segment(raw(draw(L14_5, 12, 2.0)[1], L14_5), L14_5)
    assert not noisy.warnings


@pytest.mark.parametrize(("factor", "told"), [(0.95, "negative"), (1.0, None), (1.05, "10 mm")])
def test_a_curved_array_of_another_pitch_is_named(factor, told):
    """Its offsets imitate the pitch; calibrations were 27 mm off, and said to be fair."""
    _, distances = draw(C5_2, 30, 0.3)
    probe = replace(C5_2, pitch_mm=factor * C5_2.pitch_mm)
    words = [each for each in segment(raw(distances, C5_2), probe).warnings if "pitch" in each]
    assert len(words) == (told is not None)
    assert all(told in each for each in words)


def test_a_pitch_in_another_unit_is_named():
    """It was "covariance 0 holds a number beyond 1e+07"."""
    _, distances = draw(L14_5, 12, 0.2)
    recording = Recording(raw(distances, L14_5), probe=replace(L14_5, pitch_mm=0.0457))
    with pytest.raises(InputError, match=r"of 12 frames .* probe's pitch"):
        segment(recording)


def test_too_few_frames_are_an_error_of_the_recording():
    _, distances = draw(L14_5, 6, 0.5)
    distances[3:] = np.nan
    with pytest.raises(InputError, match="only 3 of 6 frames"):
        segment(Recording(raw(distances, L14_5), probe=L14_5))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda t: t[:, :127], "has 127 columns, the probe has 128 elements"),
        (lambda t: np.where(np.arange(6)[:, None] == 2, t * 1e6, t), "row 2 .*microseconds"),
        (lambda t: t * 1e3, "row 0 .*look like milliseconds; give seconds"),
        (lambda t: t * 1e9, "row 0 .*look like nanoseconds; give seconds"),
        (lambda t: np.where(np.arange(6)[:, None] == 5, -t, t), "row 5 has a negative time"),
    ],
)
def test_what_are_not_times_in_seconds_is_refused(spoil, said):
    _, distances = draw(L14_5, 6, 0.5)
    times = spoil(L14_5.time_of_flight_s(distances))
    with pytest.raises(InputError, match=said):
        segment(make_images(poses(6), times, "time_of_flight"), L14_5)


def test_what_cannot_be_segmented_is_refused():
    _, distances = draw(L14_5, 6, 0.5)
    images = raw(distances, L14_5)
    with pytest.raises(InputError, match="no /probe"):
        segment(Recording(images))
    points = make_images(poses(6), np.full((6, 2), 30.0))
    with pytest.raises(InputError, match="no times of flight to segment, only points"):
        segment(Recording(points, probe=L14_5))
    with pytest.raises(InputError, match="no amplitudes"):
        segment(images, L14_5, minimum_amplitude=1.0)
    with pytest.raises(InputError, match="in m/s"):
        LinearProbe(sound_speed_m_s=1.49)


def test_sound_speed_and_delay_are_the_probes():
    probe = LinearProbe(sound_speed_m_s=1540.0, delay_s=3e-7)
    truth, exact = draw(probe, 8, 0.0)
    np.testing.assert_allclose(
        segment(raw(exact, probe), probe).images.measurements, truth[:, [0, 2]], atol=1e-8
    )


# -- recordings, files and the clock


@pytest.mark.parametrize("probe", [L14_5, C5_2])
def test_a_simulated_recording_through_a_file(probe, tmp_path):
    protocol = Protocol(images=20, elevation_mm=1.0, noise_mm=0.2, probe=probe, raw=True)
    recording = simulate_recording(protocol, 3)
    assert recording.calibration.kind == "time_of_flight"
    jaxcal.save(recording, tmp_path / "raw.h5")
    read = jaxcal.load(tmp_path / "raw.h5")
    assert read.probe == probe
    segmented, found = segment_recording(read, robust=False)
    jaxcal.save(segmented, tmp_path / "points.h5", found)
    back = jaxcal.load(tmp_path / "points.h5").calibration
    assert back.kind == "point"
    np.testing.assert_array_equal(back.measurements, found.images.measurements)
    np.testing.assert_array_equal(back.covariance, found.images.covariance)
    np.testing.assert_array_equal(back.time_of_flight, recording.calibration.measurements)
    again = segment(jaxcal.load(tmp_path / "points.h5"), robust=False)
    np.testing.assert_array_equal(again.images.measurements, back.measurements)
    if probe.kind == "linear":
        plain = simulate_recording(replace(protocol, raw=False), 3)
        np.testing.assert_allclose(back.measurements, plain.calibration.measurements, atol=1e-8)


def test_curvilinear_targets_lie_in_the_sector():
    protocol = Protocol(images=200, probe=C5_2, elevation_mm=0.0, noise_mm=0.0)
    recording = simulate_recording(protocol, 1)
    assert recording.calibration.kind == "time_of_flight"
    points = segment(recording, robust=False).images.measurements
    angle, depth = C5_2.polar(points)
    assert 0.85 * C5_2.half_angle_rad < np.abs(angle).max() <= 0.9 * C5_2.half_angle_rad + 1e-9
    assert depth.min() >= 10 - 1e-6
    assert depth.max() <= 90 + 1e-6
    assert recording.test is not None
    assert C5_2.contains(recording.test.measurements, 90.0).all()
    # In-plane and free of noise: reconstruction with the truth puts every point on the target.
    cloud = reconstruct(recording.truth.image_to_probe, recording.calibration.poses, points)
    np.testing.assert_allclose(cloud, np.tile(recording.truth.point, (200, 1)), atol=1e-7)


def test_clock():
    distances = np.array([[14.9, 14.93, -0.1]])
    times = times_of_flight(distances, L14_5, 20e6)
    np.testing.assert_allclose(times, [[10e-6, 10e-6, np.nan]], rtol=1e-12)
    with pytest.raises(InputError, match="positive frequency"):
        times_of_flight(distances, L14_5, 0.0)
    with pytest.raises(InputError, match="needs a raw simulation"):
        simulate_recording(Protocol(images=4, test_images=2), clock_hz=1e6)
    _, exact = draw(L14_5, 50, 0.0)
    times = times_of_flight(exact, L14_5, 20e6)
    found = segment(make_images(poses(50), times, "time_of_flight"), L14_5)
    # A step of 0.0745 mm: as much as noise of 0.0745 / sqrt(12).
    assert np.median(found.noise_mm) == pytest.approx(0.0745 / np.sqrt(12), rel=0.15)


# -- the command line


@pytest.fixture
def raw_file(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXCAL_NO_CACHE", "1")
    _, distances = draw(L14_5, 12, 0.5)
    distances[4] = np.nan
    path = tmp_path / "raw.h5"
    jaxcal.save(Recording(raw(distances, L14_5), probe=L14_5), path)
    return path


def test_segment_command(raw_file, capfd):
    assert main(["segment", str(raw_file), "--json"]) == 0
    record = json.loads(capfd.readouterr().out)
    target = raw_file.with_name("raw-segmented.h5")
    assert record["out"] == str(target)
    assert (record["images"], record["images_used"], record["images_failed"]) == (12, 11, [4])
    assert record["missing_lines"] == 128
    assert record["noise_mm"] == pytest.approx(0.5, rel=0.1)
    images = jaxcal.load(target).calibration
    assert images.kind == "point"
    assert images.covariance is not None
    before = jaxcal.load(raw_file).calibration
    np.testing.assert_array_equal(images.time_of_flight, before.measurements)
    with h5py.File(target) as file:
        np.testing.assert_array_equal(np.flatnonzero(file["segmentation/failed"]), [4])
    # Not onto itself, since the poses of what is masked out would be lost.
    assert main(["segment", str(target), "--out", str(target)]) == 2
    assert "is an input of this command" in capfd.readouterr().err
    # Once more, with the shortest times instead; 2 % more sound speed is 2 % more range.
    speed, other = str(1490.0 * 1.02), str(target.with_name("again.h5"))
    shortest = ["--method", "shortest", "--sound-speed", speed, "--out", other]
    assert main(["segment", str(target), *shortest]) == 0
    assert "11 of 12 images segmented" in " ".join(capfd.readouterr().out.split())
    again = jaxcal.load(other)
    assert again.calibration.covariance is None
    assert again.probe.sound_speed_m_s == pytest.approx(1490 * 1.02)
    slower = segment(jaxcal.load(raw_file), method="shortest").images
    ratio = again.calibration.measurements[:, 1] / slower.measurements[:, 1]
    np.testing.assert_allclose(ratio[images.mask], 1.02, rtol=1e-9)


def test_frames_that_cannot_be_segmented_are_not_passed_over(raw_file, capfd):
    """Most of those to calibrate with, and all of the test images."""
    recording = jaxcal.load(raw_file)
    times = recording.calibration.measurements.copy()
    times[:8] = np.nan
    none = replace(recording.calibration, measurements=np.full_like(times, np.nan))
    calibration = replace(recording.calibration, measurements=times)
    jaxcal.save(replace(recording, calibration=calibration, test=none), raw_file)
    assert main(["segment", str(raw_file)]) == 3
    said = " ".join(capfd.readouterr().out.split())
    assert "none of the 12 test images could be segmented: there is no test set" in said
    assert jaxcal.load(raw_file.with_name("raw-segmented.h5")).test is None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--interpolate"], "interpolate needs the method shortest"),
        (["--method", "shortest", "--scale", "pooled"], "scale needs the method least-squares"),
        (["--temperature", "20", "--sound-speed", "1500"], "exclude each other"),
        (["--temperature", "293"], "degrees Celsius"),
        (["--sound-speed", "1.49"], "looks like mm/us"),
    ],
)
def test_segment_command_refuses(arguments, said, raw_file, capfd):
    assert main(["segment", str(raw_file), *arguments]) == 2
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert said in err
    assert [path.name for path in raw_file.parent.iterdir()] == ["raw.h5"]


def test_calibrate_tells_what_a_person_should_know_of_the_segmentation():
    recording = simulate_recording(Protocol(images=20, noise_mm=0.2, probe=L14_5, raw=True), 3)

    def told(share):
        images = recording.calibration
        lossy = replace(images, measurements=lose(images.measurements, share))
        warned = jaxcal.calibrate(replace(recording, calibration=lossy), "conventional").warnings
        expected = segment(lossy, recording.probe).warnings
        assert len(expected) == (share > 0)
        return [text for text in warned if "did not answer" in text] == list(expected)

    assert told(0.0)
    assert told(0.2)


def test_segment_command_names_the_file_and_row(raw_file, capfd):
    with h5py.File(raw_file, "r+") as file:
        file["calibration/time_of_flight"][7] *= 1e6
    assert main(["segment", str(raw_file)]) == 2
    assert "raw.h5: time_of_flight row 7 has times about" in capfd.readouterr().err
    assert [path.name for path in raw_file.parent.iterdir()] == ["raw.h5"]
