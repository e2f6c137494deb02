"""Time alignment against known motions, clocks and lags, and against scipy's linear programme."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from jaxcal import InputError
from jaxcal.data.poses import matrices_from_rotations
from jaxcal.data.timing import (
    can_interpolate,
    fit_clock,
    fitted_lag,
    interpolate_poses,
    interpolation_error,
    pose_velocities,
)


def screw(t: np.ndarray, turn: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Poses that turn at a constant rate about a fixed axis and move at a constant speed."""
    turned = Rotation.from_rotvec([0.3, -0.2, 2.9]) * Rotation.from_rotvec(t[:, None] * turn)
    moved = [100, -50, 400] + t[:, None] * speed
    return matrices_from_rotations(turned.as_matrix(), moved)


@settings(max_examples=40)
@given(
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-80, 80)] * 3),
    st.lists(st.floats(0, 1.99), min_size=1, max_size=20),
)
def test_constant_motion_is_interpolated_exactly(turn, speed, query) -> None:
    t = np.linspace(0, 2, 23)
    found = interpolate_poses(
        t, screw(t, np.array(turn), np.array(speed)), np.array(query), max_gap_s=1.0
    )
    expected = screw(np.array(query), np.array(turn), np.array(speed))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_smooth_motion_at_125_hz() -> None:
    """A to and fro at up to 50 mm/s: microns off, where the nearest sample is 0.2 mm off."""

    def path(t: np.ndarray) -> np.ndarray:
        turned = Rotation.from_rotvec(np.sin(t)[:, None] * [0.1, 0.2, -0.1])
        moved = np.sin(2.5 * t)[:, None] * [20, 0, 0]
        return matrices_from_rotations(turned.as_matrix(), moved)

    t = np.arange(0, 4, 0.008)
    query = np.random.default_rng(3).uniform(0, 3.99, 200)
    found = interpolate_poses(t, path(t), query, max_gap_s=0.02)
    error = np.linalg.norm((found - path(query))[:, :3, 3], axis=1)
    assert error.max() < 2e-3
    nearest = path(t)[np.abs(t[:, None] - query).argmin(axis=0)]
    assert np.linalg.norm((nearest - path(query))[:, :3, 3], axis=1).max() > 0.15


def wandering(t: np.ndarray) -> np.ndarray:
    """Poses of a probe that moves and turns irregularly, with periods of 5 to 12 s."""
    waves = np.sin(t[:, None] * [0.53, 0.71, 1.23, 0.6, 0.9, 1.1] + np.arange(6))
    turned = Rotation.from_rotvec(0.2 * waves[:, :3])
    return matrices_from_rotations(turned.as_matrix(), 30 * waves[:, 3:])


@pytest.mark.parametrize("interval", [0.1, 0.5, 1.0])
def test_the_error_of_interpolation_is_told_from_the_poses(interval: float) -> None:
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.8, 1.2, round(60 / interval))) * interval
    query = rng.uniform(t[0], t[-1], 400)
    apart = interpolate_poses(t, wandering(t), query, max_gap_s=9.0) - wandering(query)
    # On the axes of the probe, up to 100 mm from the tracked origin.
    places = np.concatenate([np.vstack([np.zeros(3), 100 * np.eye(3)]), np.ones((4, 1))], axis=1)
    true = np.sqrt(np.mean(np.sum((apart[:, :3] @ places.T) ** 2, axis=1)))
    assert interpolation_error(t, wandering(t), query, max_gap_s=9.0) == pytest.approx(
        true, rel=0.25
    )
    # Exactly at a pose nothing is interpolated.
    assert interpolation_error(t, wandering(t), t[5:9], max_gap_s=9.0) == 0


def test_no_pose_is_guessed() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.9, 1.0, 1.1])
    poses = screw(t, np.ones(3), np.ones(3))
    poses[4] = np.nan
    valid = np.array([1, 1, 1, 1, 0, 1], bool)
    query = np.array([-0.01, 0.0, 0.15, 0.2, 0.5, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, np.nan])
    can = can_interpolate(t, query, max_gap_s=0.3, valid=valid)
    assert (
        can.tolist() == [False, True, True, True, False, True] + [False] * 3 + [True] + [False] * 2
    )
    found = interpolate_poses(t, poses, query[can], max_gap_s=0.3, valid=valid)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[[0, -1]], poses[[0, -1]], atol=1e-12)
    for time in query[~can]:
        with pytest.raises(InputError, match="no pose for time 1"):
            interpolate_poses(t, poses, np.array([0.05, time]), max_gap_s=0.3, valid=valid)
    with pytest.raises(InputError, match="NaN"):
        interpolate_poses(t, poses, np.array([0.05]), max_gap_s=0.3)


def test_times_out_of_order_are_named() -> None:
    poses = screw(np.arange(4.0), np.ones(3), np.ones(3))
    with pytest.raises(InputError, match="time of pose 2 is not later"):
        interpolate_poses(np.array([0.0, 2.0, 1.0, 3.0]), poses, np.array([0.5]), max_gap_s=9.0)
    with pytest.raises(InputError, match="4 poses and 3 times"):
        interpolate_poses(np.arange(3.0), poses, np.array([0.5]), max_gap_s=9.0)


@pytest.mark.parametrize("origin", [0.0, 1.7e9])
@pytest.mark.parametrize("drift", [0.0, 4e-5, -2e-4])
def test_clock_under_delays_that_only_add(origin: float, drift: float) -> None:
    """Delays of 2 ms on average, one in ten of up to 300 ms (a busy host): microseconds remain."""
    rng = np.random.default_rng(5)
    device = origin + np.arange(0, 60, 0.008)
    late = rng.exponential(2e-3, len(device))
    late += np.where(rng.random(len(device)) < 0.1, rng.uniform(0, 0.3, len(device)), 0)
    true = 12.5 + (1 + drift) * (device - origin)
    fit = fit_clock(device, true + late)
    # The stamps themselves have 0.24 us at 1.7e9 s.
    assert abs(fit.drift - drift) < 1e-6
    host = device + fit.offset_s + fit.drift * (device - fit.reference_s)
    assert np.abs(host - true).max() < 5e-5
    assert fit.delay_s.min() > -1e-6
    np.testing.assert_allclose(host + fit.delay_s, true + late, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_envelope_is_the_linear_programme(seed: int) -> None:
    rng = np.random.default_rng(seed)
    device = np.cumsum(rng.uniform(0.01, 1.0, 60))
    host = device * (1 + rng.normal(0, 0.01)) + rng.gamma(0.7, 0.1, 60)
    fit = fit_clock(device, host)
    x, y = device - device[0], host - device
    # Least sum of y - s x - l with none below zero, in (s, l).
    answer = linprog(
        [-x.sum(), -len(x)], A_ub=np.stack([x, np.ones_like(x)], 1), b_ub=y,
        bounds=[(None, None)] * 2,
    )  # fmt: skip
    slope, level = answer.x
    assert fit.drift == pytest.approx(slope, abs=1e-9)
    assert fit.offset_s == pytest.approx(level, abs=1e-9)


def test_clock_refuses_what_is_no_clock() -> None:
    with pytest.raises(InputError, match="device time 2 is not later"):
        fit_clock(np.array([0.0, 1.0, 1.0]), np.arange(3.0))
    with pytest.raises(InputError, match="2 times or more"):
        fit_clock(np.zeros(1), np.zeros(1))
    with pytest.raises(InputError, match="3 numbers"):
        fit_clock(np.arange(3.0), np.array([0.0, np.nan, 1.0]))
    for host in (-np.arange(3.0), np.zeros(3)):
        with pytest.raises(InputError, match="must increase with the device times"):
            fit_clock(np.arange(3.0), host)
    nanoseconds = 1.7e18 + 1e9 * np.arange(3.0)
    for times in ((np.arange(3.0), nanoseconds), (nanoseconds, np.arange(3.0))):
        with pytest.raises(InputError, match=r"times of 1\.7e\+18 are no seconds"):
            fit_clock(*times)


def motion(t: np.ndarray) -> np.ndarray:
    """Irregular to and fro over 40 mm."""
    return 15 * np.sin(1.95 * t) + 7 * np.sin(5.2 * t + 1) + 3 * np.sin(10.7 * t)


def positions(t: np.ndarray, across: float, seed: int) -> np.ndarray:
    """(n, 2) of a motion along a line, and across it, a quarter of a period ahead."""
    angle = np.random.default_rng(seed).uniform(0, np.pi)
    along, beside = motion(t), across * 15 * np.cos(1.95 * t)
    line, normal = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return along[:, None] * line + beside[:, None] * normal


@pytest.mark.parametrize("across", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_a_lag_is_told_of_a_motion_along_a_line_or_in_a_plane(across: float, speed: float) -> None:
    """Motions whose images show another direction best, as pixels are not square."""
    rng = np.random.default_rng(5)
    t, t_image = np.arange(0, 12, 0.02), np.arange(0.6, 11.4, 1 / 20)
    errors, sds = [], []
    for seed in range(8):
        poses = np.tile(np.eye(4), (len(t), 1, 1))
        moved = np.pad(positions(speed * t, across, seed), ((0, 0), (0, 1)))
        poses[:, :3, 3] = moved @ Rotation.random(random_state=seed).as_matrix()
        poses[:, :3, 3] += rng.normal(0, 0.1, (len(t), 3))
        lag = rng.uniform(-0.3, 0.3)
        points = positions(speed * (t_image - lag), across, seed) / [0.25, 0.12]
        points += rng.normal(0, 1, points.shape)
        found = fitted_lag(t_image, points, t, poses, max_gap_s=0.1)
        assert found is not None
        assert found.rival_s is None
        errors.append(found.lag_s - lag)
        sds.append(found.sd_s)
    assert np.all(np.abs(errors) < 2 * np.array(sds))
    assert np.max(sds) < 0.004 / speed


@pytest.mark.parametrize("frequency", [1.0, 1.5, 3.2])
@pytest.mark.parametrize("every", [0.05, 0.9])
def test_a_periodic_motion_fits_several_lags(frequency: float, every: float) -> None:
    """Also half a period away, mirrored; and between two lags that are tried."""
    t_image, t = 2 + every * np.arange(40), np.arange(0, 40, 0.01)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, 0, 3] = 20 * np.sin(2 * np.pi * frequency * t)
    along = -100 * np.sin(2 * np.pi * frequency * (t_image - 0.05))
    points = np.column_stack([along, 0 * along]) + np.random.default_rng(1).normal(0, 1, (40, 2))
    found = fitted_lag(t_image, points, t, poses, max_gap_s=0.1)
    assert found is not None
    assert found.rival_s is not None
    for lag in (found.lag_s, found.rival_s):
        halves = (lag - 0.05) * 2 * frequency
        assert abs(halves - round(halves)) < 0.05


def test_velocities_are_those_of_a_screw() -> None:
    """Exact for a constant screw: the pose a little later is the pose times Exp."""
    t, turn = np.arange(0, 2, 0.05), np.array([0.3, -0.5, 0.2])
    moved = np.cumsum(np.ones((len(t), 1)) * [0.5, 0.0, 0.0], axis=0)
    poses = matrices_from_rotations(Rotation.from_rotvec(t[:, None] * turn).as_matrix(), moved)
    query = np.array([0.02, 0.5, 1.0, 1.93])
    found = pose_velocities(t, poses, query, max_gap_s=0.1)
    assert np.isnan(found[[0, 3]]).all()
    np.testing.assert_allclose(found[1:3, 3:], np.tile(turn, (2, 1)), atol=1e-12)
    back = Rotation.from_rotvec(query[1:3, None] * turn).inv().apply([10.0, 0.0, 0.0])
    np.testing.assert_allclose(found[1:3, :3], back, atol=1e-9)
    known = np.ones(len(t), bool)
    known[9] = False
    assert np.isnan(pose_velocities(t, poses, query, max_gap_s=0.1, valid=known)[1]).all()


def test_queries_and_poses_that_are_none_are_said() -> None:
    t = np.linspace(0, 2, 23)
    poses = screw(t, np.ones(3), np.ones(3))
    for query in (["soon"], [1j], 0.5, [[0.5]]):
        with pytest.raises(InputError, match="the times asked for must be"):
            interpolate_poses(t, poses, np.array(query), max_gap_s=1.0)


def freehand(t: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a probe that moves in all directions, and where it sees a target at rest, px."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.1, 0.4, (6, 2)), rng.uniform(0, 6, (6, 2))
    wave = np.sin(t[:, None, None] * frequency * 6 + phase).mean(axis=2)
    pixels = [160, 120] + wave[:, 3:5] * [110, 80]
    seen = np.column_stack([pixels * [0.2, 0.15], 0.8 * wave[:, 5]])
    in_probe = seen @ Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix().T + [20, -35, 50]
    turns = Rotation.from_rotvec(0.5 * wave[:, :3] + [1.0, 0.3, -2.0])
    poses = matrices_from_rotations(turns.as_matrix(), [100, -50, -900] - turns.apply(in_probe))
    return poses, pixels + rng.normal(0, 1, pixels.shape)


@pytest.mark.parametrize("lag", [-0.21, 0.0, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_a_lag_is_told_of_any_motion(seed: int, lag: float) -> None:
    t_image, t = 2 + 0.9 * np.arange(40), np.arange(0, 40, 0.03)
    points = freehand(t_image - lag, seed)[1]
    found = fitted_lag(t_image, points, t, freehand(t, seed)[0], max_gap_s=0.1)
    assert found is not None
    assert abs(found.lag_s - lag) < 4 * found.sd_s < 0.06
    assert (found.evidence > 25) == (lag != 0)
    assert found.misfit_mm < 0.8
    assert lag == 0 or found.given_mm > 1.5 * found.misfit_mm


def test_a_lag_is_not_told_of_a_probe_at_rest_or_of_few_images() -> None:
    """A probe that is held still for each image: no lag fits better than another."""
    t_image, t = 2 + 2.0 * np.arange(30), np.arange(0, 62, 0.03)
    of_image = np.clip(np.round((t - 2) / 2), 0, 29).astype(int)
    still, points = freehand(t_image, 1)
    found = fitted_lag(t_image, points, t, still[of_image], max_gap_s=0.1)
    assert found is not None
    assert found.evidence <= found.contrast < 9
    assert fitted_lag(t_image[:11], points[:11], t, still[of_image], max_gap_s=0.1) is None
    one = np.full((30, 2), 7.0)
    assert fitted_lag(t_image, one, t, still[of_image], max_gap_s=0.1) is None


@pytest.mark.parametrize("lag", [-0.485, 0.48])
def test_a_lag_near_the_end_of_the_search(lag: float) -> None:
    """Every pose that is looked up for it is within the recording, to the last sample."""
    t_image, t = 0.5 + 0.9 * np.arange(40), np.arange(0, 36.1 + 1e-9, 0.02)
    found = fitted_lag(t_image, freehand(t_image - lag, 3)[1], t, freehand(t, 3)[0], max_gap_s=0.1)
    assert found is not None
    assert abs(found.lag_s - lag) < 4 * found.sd_s < 0.06


def test_clocks_that_are_apart_by_more_than_is_searched() -> None:
    t_image, t = 2 + 0.9 * np.arange(40), np.arange(0, 40, 0.03)
    found = fitted_lag(t_image, freehand(t_image - 0.9, 2)[1], t, freehand(t, 2)[0], max_gap_s=0.1)
    assert found is not None
    assert (found.lag_s, found.sd_s) == (0.5, np.inf)
    assert found.contrast >= found.evidence > 25
