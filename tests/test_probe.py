"""Arrays: geometry against its own definitions, ranges, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from jaxcal import InputError
from jaxcal.data.probe import C5_2, L14_5, CurvilinearProbe, LinearProbe
from jaxcal.data.sound import sound_speed_in_water

PROBES = (L14_5, C5_2, LinearProbe(2, 1.0), CurvilinearProbe(17, 1.5, 40.0, 1540.0, 1e-6))


@pytest.mark.parametrize("probe", PROBES)
def test_elements_are_where_the_conventions_put_them(probe):
    positions = probe.element_positions()
    assert positions.shape == (probe.elements, 3)
    np.testing.assert_allclose(positions[:, 1], 0)
    np.testing.assert_allclose(positions[:, 0], -positions[::-1, 0], atol=1e-12)
    np.testing.assert_array_equal(positions[:, 0], probe.element_lateral())
    if probe.kind == "linear":
        np.testing.assert_allclose(np.diff(positions[:, 0]), probe.pitch_mm)
        np.testing.assert_allclose(positions[:, 2], 0)
    else:
        # On the circle about (0, -R), neighbours a pitch of arc apart: a shorter chord.
        centre = np.array([0.0, 0.0, -probe.radius_mm])
        radius = np.linalg.norm(positions - centre, axis=1)
        np.testing.assert_allclose(radius, probe.radius_mm, rtol=1e-12)
        chord = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        arc = 2 * probe.radius_mm * np.arcsin(chord / (2 * probe.radius_mm))
        np.testing.assert_allclose(arc, probe.pitch_mm, rtol=1e-9)
        assert positions[:, 2].max() <= 0


def test_presets():
    assert L14_5.width_mm == pytest.approx(58.5)
    assert np.degrees(2 * C5_2.half_angle_rad) == pytest.approx(60.0)
    assert (C5_2.elements, C5_2.radius_mm) == (128, 60.0)


@pytest.mark.parametrize("probe", PROBES)
def test_image_and_cartesian_coordinates_are_inverses(probe):
    generator = np.random.default_rng(1)
    line = generator.uniform(0, probe.elements - 1, (4, 50))
    depth = generator.uniform(0.1, 120, (4, 50))
    points = probe.image_to_cartesian(line, depth)
    back = probe.cartesian_to_image(points)
    np.testing.assert_allclose(back[0], line, atol=1e-9)
    np.testing.assert_allclose(back[1], depth, atol=1e-9)
    assert probe.contains(points, 120.0).all()
    assert not probe.contains(points, 0.05).any()


@pytest.mark.parametrize("probe", PROBES)
def test_a_scan_line_starts_at_its_element_and_leaves_at_right_angles(probe):
    line = np.arange(probe.elements)
    positions = probe.element_positions()[:, [0, 2]]
    np.testing.assert_allclose(probe.image_to_cartesian(line, 0.0), positions, atol=1e-12)
    # The element is the nearest of all to every place on its line.
    points = probe.image_to_cartesian(line, 35.0)
    distance = np.linalg.norm(points[:, None] - positions, axis=-1)
    np.testing.assert_array_equal(distance.argmin(axis=1), line)
    np.testing.assert_allclose(distance.min(axis=1), 35.0)


def test_field_of_view():
    assert L14_5.contains(np.array([29.2, 10.0]), 90.0)
    assert not L14_5.contains(np.array([29.3, 10.0]), 90.0)
    assert not L14_5.contains(np.array([0.0, -1.0]), 90.0)
    # The sector widens with depth; beside the arc's end nothing is seen.
    assert C5_2.contains(np.array([60.0, 60.0]), 90.0)
    assert not C5_2.contains(np.array([36.0, 1.0]), 90.0)
    assert not C5_2.contains(np.array([0.0, 90.1]), 90.0)
    np.testing.assert_array_equal(
        C5_2.contains(np.array([[0.0, 5.0, 40.0], [0.0, 5.0, -1.0]]), 90.0), [True, False]
    )
    with pytest.raises(InputError, match="2 or 3 coordinates"):
        L14_5.contains(np.zeros((3, 4)), 90.0)


def test_one_way_range():
    probe = LinearProbe(sound_speed_m_s=1500.0, delay_s=2e-6)
    # 42 us less 2 us of delay at 1.5 mm/us.
    np.testing.assert_allclose(probe.one_way_range_mm(np.array([42e-6, np.nan])), [60.0, np.nan])
    np.testing.assert_allclose(probe.one_way_range_mm(np.array([42e-6]), delay_s=0.0), [63.0])
    np.testing.assert_allclose(probe.time_of_flight_s(np.array([60.0])), [42e-6])


def test_sound_speed_in_water_agrees_with_other_measurements():
    # Del Grosso and Mader, J. Acoust. Soc. Am. 52 (1972) 1442, Table III.
    other = [1402.38754, 5.03711129, -5.80852166e-2, 3.34198834e-4, -1.47800417e-6, 3.14643091e-9]
    celsius = np.linspace(0, 95, 96)
    expected = np.polynomial.polynomial.polyval(celsius, other)
    np.testing.assert_allclose(sound_speed_in_water(celsius), expected, rtol=0, atol=0.06)
    assert sound_speed_in_water(20.0) == pytest.approx(1482.36, abs=0.03)


def test_sound_speed_of_many_temperatures_and_of_kelvin():
    speeds = sound_speed_in_water(np.linspace(0, 70, 15))
    assert (np.diff(speeds) > 0).all()
    for wrong in (293.15, -1.0, np.nan):
        with pytest.raises(InputError, match="degrees Celsius"):
            sound_speed_in_water(wrong)


@pytest.mark.parametrize("kind", [LinearProbe, CurvilinearProbe])
@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"elements": 1}, "2 to 65536 elements"),
        ({"pitch_mm": 0.0}, "pitch_mm must be in mm"),
        ({"pitch_mm": float("nan")}, "pitch_mm must be in mm"),
        ({"sound_speed_m_s": 1.49}, "m/s .*1.49 looks like mm/us"),
        ({"sound_speed_m_s": 1.49e6}, "must be in m/s"),
        ({"sound_speed_m_s": float("nan")}, "must be in m/s"),
        ({"delay_s": 0.5}, "delay_s must be in s"),
        ({"delay_s": float("inf")}, "delay_s must be in s"),
    ],
)
def test_impossible_probes_are_refused(kind, values, said):
    with pytest.raises(InputError, match=said):
        kind(**values)


def test_impossible_arcs_are_refused():
    for radius in (0.0, -60.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="radius must be in mm"):
            CurvilinearProbe(radius_mm=radius)
    with pytest.raises(InputError, match="more than half way round"):
        CurvilinearProbe(128, 0.5, 20.0)
