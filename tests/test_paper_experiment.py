"""The paper's experiment: its model of the tank against closed forms, its study, its table."""

from __future__ import annotations

import csv
import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxcal import InputError, calibrate_batch, reconstruction_precision

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
PAPER = Path(__file__).parents[2] / "shared" / "paper" / "table4.csv"


@pytest.fixture(scope="module")
def tank():
    """The script's module, as the scripts beside it import it."""
    sys.path.insert(0, str(EXPERIMENTS))
    yield importlib.import_module("tank")
    sys.path.remove(str(EXPERIMENTS))


@pytest.fixture(scope="module")
def drawn(tank):
    return tank.draw(tank.Tank(), (5,), range(4))


def test_images_without_errors_are_the_engines_geometry(drawn):
    for k, x in enumerate(drawn.image_to_probe):
        rp = float(reconstruction_precision(x, drawn.exact.poses[k], drawn.exact.points[k]))
        assert rp < 1e-9


def test_phantoms_share_orientations_and_differ_by_one_translation(drawn, tank):
    first, wires, hydrophone = (drawn.sets[name][0].poses for name in ("AE", "CW", "OH"))
    np.testing.assert_array_equal(first[..., :3, :3], wires[..., :3, :3])
    np.testing.assert_array_equal(first[..., :3, :3], hydrophone[..., :3, :3])
    apart = (hydrophone - first)[..., :3, 3]
    # The rest is where in the image each one stands: a similar region, placed by itself.
    np.testing.assert_allclose(apart.mean(axis=(0, 1)), [50.0, 0.0, 0.0], atol=0.5)
    assert np.std(apart - [50.0, 0.0, 0.0]) < 2.0


def test_the_test_sets_own_scatter_is_its_errors_added_up(tank):
    still = tank.Tank(accuracy_mm=0.0, speed_m_s=0.0, quality="Exp. 4")
    found = tank.draw(still, (6,), range(8))
    own = {
        name: float(
            np.mean(
                [
                    float(reconstruction_precision(x, one.poses[k], one.points[k]))
                    for k, x in enumerate(found.image_to_probe)
                ]
            )
        )
        for name in ("OH", "Auto-AE")
        for one in found.sets[name][:1]
    }
    stop = still.repeatability_mm
    # Segmentation by times errs by micrometres: what is left is stops in the plane, and the search
    # for it. The last stop's error across the plane is in the image, not in the plane's place.
    hydrophone = np.sqrt(2 * stop**2 + tank.SEARCH_MM**2)
    element = np.sqrt(hydrophone**2 + tank.element_sd_mm(still) ** 2)
    assert own["OH"] == pytest.approx(hydrophone, rel=0.06)
    assert own["Auto-AE"] == pytest.approx(element, rel=0.06)


def test_the_robots_pose_error_is_in_all_three_axes_of_the_scatter(tank):
    """A search finds the true plane, so that the reported one is off by what the robot errs."""
    wrong = tank.Tank(accuracy_mm=0.8, speed_m_s=0.0, repeatability_mm=0.0)
    found = tank.draw(wrong, (9,), range(6))
    one = found.sets["OH"][0]
    for trial in range(6):
        rng = np.random.default_rng([9, trial])
        rng.uniform(-1, 1, size=(2, 3))  # the mount
        plan = tank.orientations(wrong.images, wrong.cone_deg, wrong.turn_deg, trial)
        errors = tank.pose_errors(wrong, plan.rotations, rng)
        x = found.image_to_probe[trial]
        rp = float(reconstruction_precision(x, one.poses[trial], one.points[trial]))
        assert rp == pytest.approx(float(np.linalg.norm(errors.std(axis=0, ddof=1))), rel=0.02)


def test_the_wires_part_by_the_width_of_their_marks(tank):
    condition = tank.Tank(quality="Exp. 3")
    wires = np.array([[1.0, -1.0], [2.0, -0.5]])
    depth = np.array([40.0, 40.0])
    reach = tank.parted_mm(condition, depth, wires)
    thickness = np.sqrt(0.8**2 - 2.08**2 / 12)  # the field's own, at the focus
    spot = condition.look.lateral_mm
    marks = np.hypot(spot, thickness / np.sqrt(2) * np.abs(wires))
    expected = tank.PARTED * 2.3548 * marks.mean(axis=1) / np.array([2.0, 2.5])
    np.testing.assert_allclose(reach, expected, rtol=1e-3)
    thick = tank.parted_mm(replace(condition, thickness_mm=2.0), depth, wires)
    assert (thick > 1.3 * reach).all()


def test_a_trial_depends_on_nothing_but_its_number(tank, drawn):
    again = tank.draw(tank.Tank(), (5,), range(2, 3))
    np.testing.assert_array_equal(again.sets["CW"][1].points[0], drawn.sets["CW"][1].points[2])
    np.testing.assert_array_equal(again.sets["OH"][0].points[0], drawn.sets["OH"][0].points[2])


def test_a_persons_picks_of_the_echo_fall_on_its_reflection_as_often_as_said(tank):
    found = tank.draw(tank.Tank(quality="Exp. 1", images=120), (7,), range(6))
    person, exact = found.sets["AE"][0].points, found.sets["Auto-AE"][0].points
    late = (person - exact)[..., 1] > 0.5 * tank.GHOST_MM
    assert late.mean() == pytest.approx(tank.QUALITIES["Exp. 1"].ghost, abs=0.03)
    wires = found.sets["CW"][0].points
    assert np.abs(wires[..., 1] - np.median(wires[..., 1])).max() < 60


def test_the_study_travels_as_text(tank):
    study = importlib.import_module("tank_study").TankStudy(1, 10, 4, (tank.Tank(),))
    assert type(study).from_canonical(study.canonical()) == study
    assert study.chunk_count == 3
    assert study.chunk(2).stop == 10
    with pytest.raises(InputError, match="not a study of this kind"):
        type(study).from_canonical('{"kind": "Session"}')


def test_bounds_from_amplitudes_hold_and_shrink_towards_the_plane(tank):
    placements = importlib.import_module("tank_placements")
    bounds = importlib.import_module("tank_sds")
    rng = np.random.default_rng(0)
    offset, depth = rng.normal(0, 1.0, 4000), np.full(4000, 45.0)
    shifted = offset - rng.normal(0, 0.3, 4000)
    width = float(np.hypot(0.8, 0.03 * 5.0))
    rows = np.zeros((4000, len(placements.COLUMNS)))
    rows[:, placements.COLUMNS.index("range_mm")] = depth
    rows[:, placements.COLUMNS.index("amplitude_in_plane")] = 2000.0
    heard = 2000.0 * np.exp(-0.5 * (shifted / width) ** 2)
    rows[:, placements.COLUMNS.index("amplitude")] = heard
    bound, sd = bounds.from_amplitude(rows, gain=1.0)
    assert np.mean(np.abs(offset) <= bound) > 0.985
    near = np.abs(shifted) < 0.2
    assert bound[near].mean() < 0.6 * bound[np.abs(shifted) > 1.5].mean()
    assert (sd < bound).all()


@pytest.mark.slow
def test_given_sds_of_one_size_are_the_gaussian_prior(tank):
    bounds, grid = (importlib.import_module(name) for name in ("tank_sds", "tank_grid"))
    one = tank.draw(tank.Tank(images=60), (8,), range(2)).sets["Auto-AE"][0]
    problem = grid.padded_problems(one.poses[:, :14], one.points[:, :14])
    sd = np.full((2, 60), 0.4)
    sigma = np.full((2, 2), [0.2, 0.3])
    found = bounds.own_sds(problem, sd, sigma)
    expected = calibrate_batch(problem, prior="gaussian", sigma=(0.2, 0.3, 0.4))
    np.testing.assert_allclose(found, np.asarray(expected.image_to_probe), atol=1e-5)
    # An image that is said to be far off tells less.
    sd[0, :3] = 40.0
    other = bounds.own_sds(problem, sd, sigma)
    assert np.abs(other[0] - found[0]).max() > 1e-3
    np.testing.assert_allclose(other[1], found[1], atol=1e-6)


def test_the_page_has_the_tables_of_the_results(tank):
    page = importlib.import_module("tank_page")
    text = page.PAGE.read_text(encoding="utf-8")
    assert text.count("<!-- table: ") == len(page.TABLES)
    assert page.renewed(text) == text
    assert page.renewed(text.replace("0.8", "0.9")) == text.replace("beam 0.8", "beam 0.9")


@pytest.mark.skipif(not PAPER.exists(), reason="the paper's table is not at hand")
def test_table_4_is_the_papers():
    def cells(path: Path) -> list[dict[str, str]]:
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        return list(csv.DictReader(lines))

    assert cells(EXPERIMENTS / "paper" / "table4.csv") == cells(PAPER)
