"""The simulated world: geometry against the engine, the beam, the noise as documented."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import jaxcal
from hw.bench.frames import COLUMNS, ROWS, Camera
from hw.bench.tank import Look
from hw.bench.world import FULL_SCALE, make_world
from hw.midplane.pattern_injection import bar
from hw.planning.poses import plan_poses
from hw.runtime.rigid import rigid
from jaxcal import InputError
from jaxcal.data.poses import rotation_angle, rotations_from_vectors
from jaxcal.data.segmentation.image import localise


def placed(world, lateral: float, elevation: float, axial: float, turn=(0.0, 0.0, 0.0)):
    """A true pose that has the target at a place of the image."""
    pose = np.eye(4)
    pose[:3, :3] = rotations_from_vectors(np.asarray(turn)) @ np.diag([1.0, -1.0, -1.0])
    x = world.image_to_probe
    place = x[:3, :3] @ [lateral, elevation, axial] + x[:3, 3]
    pose[:3, 3] = world.point_mm - pose[:3, :3] @ place
    return pose


def test_truth_is_the_engines_geometry():
    world = make_world(3)
    pose = placed(world, 5.0, 1.5, 40.0, (0.2, -0.1, 0.4))
    truth = world.truth(pose)
    assert truth.lateral_mm == pytest.approx(5.0)
    assert truth.elevation_mm == pytest.approx(1.5)
    assert truth.range_mm == pytest.approx(np.hypot(1.5, 40.0))
    q = np.linalg.inv(pose @ world.image_to_probe) @ np.append(world.point_mm, 1.0)
    np.testing.assert_allclose(world.target(pose), q[:3], atol=1e-9)


def test_times_of_flight_are_whole_ticks_of_the_straight_way():
    world = make_world(0, time_s=0.0, reflection=0.0, amplitude=0.0, delay_s=1e-7)
    pose = placed(world, -4.0, 0.3, 35.0)
    times, _ = world.echo(pose, 1, np.random.default_rng(0))
    elements = world.probe.element_positions()
    way = np.linalg.norm(elements - [-4.0, 0.3, 35.0], axis=1)
    exact = way / (1e3 * world.sound_speed_m_s) + 1e-7
    assert np.abs(times - exact).max() <= 0.5 / world.clock_hz + 1e-15
    np.testing.assert_allclose(times * world.clock_hz, np.rint(times * world.clock_hz), atol=1e-6)


def test_reflections_are_late_and_rare():
    world = make_world(0, reflection=0.05, time_s=0.0)
    pose = placed(world, 0.0, 0.0, 30.0)
    rng = np.random.default_rng(1)
    way = np.linalg.norm(world.probe.element_positions() - [0.0, 0.0, 30.0], axis=1)
    exact = way / (1e3 * world.sound_speed_m_s)
    late = np.array([world.echo(pose, 1, rng)[0] - exact > 1e-6 for _ in range(100)])
    assert late.mean() == pytest.approx(0.05, abs=0.01)
    assert not any((world.echo(pose, 1, rng)[0] - exact < -1e-8).any() for _ in range(10))


def test_amplitude_is_gaussian_across_the_beam_and_thicker_away_from_the_focus():
    world = make_world(0, response_mm=0.0)
    for depth in (20.0, 40.0, 80.0):
        width = float(world.beam.width_mm(depth))
        middle = world.loudness(placed(world, 0.0, 0.0, depth)).max()
        beside = world.loudness(placed(world, 0.0, width, depth)).max()
        assert beside / middle == pytest.approx(np.exp(-0.5), rel=0.03)
    assert world.beam.width_mm(40.0) < world.beam.width_mm(20.0) < world.beam.width_mm(80.0)


def test_responses_shift_is_fixed_for_a_pose_and_has_its_sd_over_poses():
    world = make_world(1)
    shift_mm = partial(world.response_shift_mm, scale=world.phantom.response_scale)
    poses = plan_poses(400, world.scene).poses
    shifts = np.array([shift_mm(pose) for pose in poses])
    assert shifts.std() == pytest.approx(0.3, rel=0.15)
    assert abs(shifts.mean()) < 0.06
    moved = poses[0].copy()
    moved[:3, 3] += 5.0
    assert shift_mm(moved) == shifts[0]
    # A tremor of a hundredth of a degree is no other pose.
    shaken = poses[0] @ rigid(np.full(3, 1e-4), np.zeros(3))
    assert shift_mm(shaken) == pytest.approx(shifts[0], abs=0.01)


def test_threshold_silences_and_converter_saturates():
    world = make_world(0)
    pose = placed(world, 0.0, 0.0, 30.0)
    rng = np.random.default_rng(0)
    times, amplitude = world.echo(pose, FULL_SCALE, rng)
    assert np.isnan(times).all()
    assert not amplitude.any()
    loud = make_world(0, peak=20000.0)
    _, amplitude = loud.echo(pose, 1, rng)
    assert amplitude.max() == FULL_SCALE
    behind = placed(world, 0.0, 0.0, -30.0)
    assert np.isnan(world.echo(behind, 100, rng)[0]).all()


def test_worlds_differ_by_seed_and_their_drawing_is_off():
    first, second = make_world(0), make_world(1)
    assert not np.allclose(first.image_to_probe, second.image_to_probe)
    np.testing.assert_array_equal(first.image_to_probe, make_world(0).image_to_probe)
    off = np.linalg.inv(first.scene.image_to_probe) @ first.image_to_probe
    assert 0 < np.abs(off[:3, 3]).max() <= 2.0
    assert rotation_angle(np.eye(4), off) <= np.radians(1.5) * np.sqrt(3)
    with pytest.raises(InputError, match="no 'colour'"):
        make_world(0, colour=3)
    with pytest.raises(InputError, match="m/s"):
        make_world(0, sound_speed_m_s=1.49)


def test_test_set_reconstructs_to_the_point_exactly():
    world = make_world(2)
    poses, points = world.test_set(20)
    rp = jaxcal.reconstruction_precision(world.image_to_probe, poses, points)
    assert float(rp) < 1e-9


def test_frames_show_the_element_where_it_is():
    world = make_world(0)
    camera = Camera(world)
    rng = np.random.default_rng(0)
    found = []
    for depth, lateral in ((25.0, -12.0), (45.0, 6.0), (70.0, 15.0)):
        frame = camera.frame(placed(world, lateral, 0.0, depth), rng)
        assert frame.shape == (ROWS, COLUMNS)
        assert frame.dtype == np.uint8
        result = localise(frame)
        assert result.found[0], result.reason
        found.append(result.position[0] - camera.pixel(lateral, depth))
    assert np.abs(found).max() < 2.5


def test_frame_without_response_has_no_echo_and_the_bar_follows_the_pattern():
    world = make_world(0)
    camera = Camera(world)
    pose = placed(world, 0.0, 0.0, 40.0)

    def draw(**arguments):
        return camera.frame(pose, np.random.default_rng(5), **arguments).astype(int)

    silent, echo = draw(threshold=FULL_SCALE), draw()
    column, row = (round(x) for x in camera.pixel(0.0, 40.0))
    assert echo[row, column] > silent[row, column] + 20
    delay = 6e-6
    below = camera.pixel(0.0, 40.0 + 0.5e3 * world.sound_speed_m_s * delay)[1]
    lengths = []
    for length in (9, 31):
        bright = (
            draw(pattern=bar(length, 64, 128), pattern_delay_s=delay)[round(below)]
            - echo[round(below)]
        )
        lengths.append(int((bright > 0).sum()))
    assert lengths[1] > 2.5 * lengths[0] > 0
    assert (draw(pattern=bar(31, 64, 128), threshold=FULL_SCALE) == silent).all()
    with pytest.raises(InputError, match="lines"):
        draw(pattern=bytes(200))


def test_wires_cross_in_the_plane_and_part_beside_it():
    world = make_world(0)
    look = Look()
    camera, rng = Camera(world, look), np.random.default_rng(0)
    beside = np.asarray(look.beside_mm)
    turned = np.diag([1.0, -1.0, -1.0]) @ rotations_from_vectors(np.array([0.0, 0.0, 0.3]))
    x = world.image_to_probe

    def draw(elevation: float):
        pose = np.eye(4)
        pose[:3, :3] = turned @ x[:3, :3].T
        place = x[:3, :3] @ [5.0, elevation, 45.0] + x[:3, 3]
        pose[:3, 3] = world.point_mm + beside - pose[:3, :3] @ place
        return camera.frame(pose, rng)

    together = localise(draw(0.0), target="cross")
    assert together.found[0]
    assert np.abs(together.position[0] - camera.pixel(5.0, 45.0)).max() < 2.5
    apart = localise(draw(4.0), target="cross")
    assert not apart.found[0]
    assert "ambiguous" in apart.reason[0]
