"""Plans of poses: coverage, limits, order."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.image import imread

from hw.acquisition.live_estimate import Estimator
from hw.acquisition.planner import Planner
from hw.bench.stage import WorldStage
from hw.bench.world import make_world
from hw.midplane.search import Settings
from hw.midplane.threshold_climb import threshold_climb
from hw.planning.pool import allowed_by, plan_pool
from hw.planning.poses import Extent, plan_poses, preview
from hw.planning.scene import Scene
from hw.robot.kinematics import flange_of, inverse, model_named
from hw.robot.path_checks import out_of_box_mm
from hw.runtime.rigid import turn_deg
from hw.setup.description import Setup
from jaxcal import InputError

SCENE = make_world(0).scene


@settings(max_examples=20)
@given(
    count=st.integers(1, 60), cone=st.floats(0, 60), turn=st.floats(0, 180),
    seed=st.integers(0, 2**31),
)  # fmt: skip
def test_every_pose_has_the_nominal_target_where_it_says(count, cone, turn, seed):
    extent = Extent(cone_deg=cone, turn_deg=turn)
    plan = plan_poses(count, SCENE, extent, seed)
    assert len(plan) == count
    to_image = np.linalg.inv(plan.poses @ SCENE.image_to_probe)
    target = (to_image @ np.append(SCENE.point_mm, 1.0))[:, :3]
    np.testing.assert_allclose(target[:, [0, 2]], plan.expected, atol=1e-8)
    np.testing.assert_allclose(target[:, 1], 0.0, atol=1e-8)
    np.testing.assert_allclose(SCENE.expected(plan.poses[0]), target[0], atol=1e-8)
    assert (np.abs(plan.expected[:, 0]) <= extent.lateral_mm).all()
    assert (plan.expected[:, 1] >= extent.depth_mm[0]).all()
    assert (plan.expected[:, 1] <= extent.depth_mm[1]).all()
    axial = plan.poses[:, :3, :3] @ SCENE.image_to_probe[:3, 2]
    tilt = np.degrees(np.arccos(np.clip(axial @ SCENE.looking, -1, 1)))
    assert tilt.max() <= cone + 1e-4


def test_cone_and_image_are_covered():
    plan = plan_poses(60, SCENE)
    axial = plan.poses[:, :3, :3] @ SCENE.image_to_probe[:3, 2]
    tilt = np.arccos(np.clip(axial @ SCENE.looking, -1, 1))
    # Uniform over the cap: half of the poses lie beyond the angle that halves its area.
    half = np.arccos(0.5 * (1 + np.cos(np.radians(40.0))))
    assert 0.35 < (tilt > half).mean() < 0.65
    for axis, low, high in ((0, -24.0, 24.0), (1, 15.0, 82.0)):
        bins, _ = np.histogram(plan.expected[:, axis], bins=6, range=(low, high))
        assert bins.min() >= 5


def test_box_and_reach_are_kept_and_impossible_ones_refused():
    point = SCENE.point_mm
    box = (tuple(point - np.array([30, 30, 0])), tuple(point + np.array([30, 30, 60])))
    extent = Extent(box_mm=box, reach_mm=(300.0, 480.0))
    plan = plan_poses(40, SCENE, extent)
    assert (plan.tips_mm >= np.array(box[0])).all()
    assert (plan.tips_mm <= np.array(box[1])).all()
    distance = np.linalg.norm(plan.poses[:, :3, 3], axis=1)
    assert ((distance >= 300.0) & (distance <= 480.0)).all()
    assert plan.passed_over > 0
    far = (tuple(point + 500.0), tuple(point + 600.0))
    with pytest.raises(InputError, match="0 of 10 poses"):
        plan_poses(10, SCENE, Extent(box_mm=far))


def test_order_is_shorter_than_chance():
    plan = plan_poses(60, SCENE)
    rng = np.random.default_rng(0)
    tips = plan.tips_mm
    chance = [
        np.linalg.norm(np.diff(tips[rng.permutation(60)], axis=0), axis=1).sum() for _ in range(50)
    ]
    assert plan.travel_mm < 0.75 * min(chance)


@pytest.mark.parametrize(
    ("changes", "match"),
    [({"cone_deg": 120.0}, "cone_deg"), ({"depth_mm": (50.0, 20.0)}, "depth_mm"),
     ({"box_mm": ((0.0, 0.0, 0.0), (1.0, -1.0, 1.0))}, "box_mm"),
     ({"turn_deg": float("nan")}, "turn_deg")],
)  # fmt: skip
def test_bad_extents_are_refused(changes, match):
    with pytest.raises(InputError, match=match):
        Extent(**changes)


def test_bad_scenes_are_refused():
    with pytest.raises(InputError, match="1 to"):
        plan_poses(0, SCENE)
    with pytest.raises(InputError, match="looking"):
        plan_poses(5, Scene(SCENE.image_to_probe, SCENE.point_mm, np.zeros(3)))
    with pytest.raises(InputError, match="finite"):
        plan_poses(5, Scene(SCENE.image_to_probe, np.full(3, np.nan), SCENE.looking))
    with pytest.raises(InputError, match="image_to_probe"):
        plan_poses(5, Scene(np.zeros((4, 4)), SCENE.point_mm, SCENE.looking))


def test_preview_is_a_figure(tmp_path):
    path = tmp_path / "plan.png"
    preview(plan_poses(6, SCENE), path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert (imread(path)[[0, -1]] == 1).all()  # no title is cut off
    box = np.array([[180.0, -420.0, 40.0], [520.0, -80.0, 270.0]])
    # SVG keeps what is written as comments: poses from 1, as the run counts them, and no half ones.
    preview(plan_poses(4, SCENE), tmp_path / "plan.svg", box)
    shown = re.findall("<!-- (.*?) -->", (tmp_path / "plan.svg").read_text())
    bar = shown.index("pose, in the order of the plan")
    assert shown[bar - 4 : bar] == ["1", "2", "3", "4"]
    assert "depth (mm)" in shown
    assert "box for the probe" in shown


def test_what_the_placement_noted_is_told_with_the_image():
    world = make_world(0)
    stage = WorldStage(world, plan_poses(1, SCENE).poses[0], np.random.default_rng(0))
    placement = threshold_climb(stage, Settings(epsilon_mm=0.3))
    line = Estimator(4, a_setup(), None).line(4, placement)
    assert "the beam is too thick for +-0.3 mm" in line


def a_setup(**changes) -> Setup:
    x, y, z = (float(value) for value in SCENE.point_mm)
    limits = {
        "box_min_mm": [x - 140.0, y - 140.0, z - 20.0],
        "box_max_mm": [x + 140.0, y + 140.0, z + 170.0],
        "cone_axis": [0.0, 0.0, -1.0], "cone_deg": 38.0, "max_step_mm": 250.0,
        "max_turn_deg": 120.0, "max_speed_mm_s": 100.0, "arm_model": "UR5", "search_mm": 5.0,
    }  # fmt: skip
    return Setup("nowhere", "nowhere", SCENE, {**limits, **changes}, tcp_offset=(0.0,) * 6)


@pytest.fixture(scope="module")
def pool():
    setup = a_setup()
    limits = setup.motion_limits()
    return setup, limits, plan_pool(8, SCENE, Extent(), 1, allowed_by(limits, setup.tcp_offset))


def test_a_pool_keeps_box_cone_and_the_arms_reach(pool):
    setup, limits, plan = pool
    assert 16 <= len(plan) <= 24
    assert setup.tcp_offset is not None
    for pose in plan.poses:
        assert out_of_box_mm(pose, limits) <= -5.0
        tilt = np.degrees(np.arccos(np.clip(pose[:3, 2] @ limits.cone_axis, -1, 1)))
        assert tilt <= 38.0
        assert inverse(model_named("UR5"), flange_of(pose, setup.tcp_offset)).reached.any()
    # The Sobol plan of the same extent does not keep them by itself.
    every = plan_poses(60, SCENE, Extent(), 1).poses
    assert not allowed_by(limits, setup.tcp_offset)(every).all()
    far = a_setup(box_min_mm=[900.0, 0.0, 0.0], box_max_mm=[1000.0, 100.0, 100.0])
    with pytest.raises(InputError, match="widen"):
        plan_pool(8, SCENE, Extent(), 1, allowed_by(far.motion_limits(), setup.tcp_offset))


def test_optimal_poses_of_a_pool_are_turned_apart():
    poses = plan_pool(6, SCENE, Extent(), 2).poses
    apart = [turn_deg(a, b) for k, a in enumerate(poses) for b in poses[:k]]
    assert np.quantile(apart, 0.1) > 15
    assert np.sum(np.array(apart) < 4.0) <= 6


def test_a_planner_visits_each_pose_once_and_prefers_what_is_near(pool):
    setup, _, plan = pool
    planner = Planner(plan.poses, setup)
    left, taken = list(range(len(plan))), np.zeros((0, 4, 4))
    here = plan.poses[0]
    for _ in range(10):
        choice = planner.choose(left, taken, here, None)
        assert choice.text == ""
        left.remove(choice.row)
        here = plan.poses[choice.row]
        taken = np.concatenate([taken, here[None]])
    chosen = sorted(set(range(len(plan))) - set(left))
    assert len(chosen) == 10
    # What ten chosen poses tell, against the first ten of the tour.
    nominal = planner._nominal.model
    told = [
        np.linalg.slogdet(nominal.beliefs() + nominal.information(plan.poses[rows]))[1]
        for rows in (chosen, list(range(10)))
    ]
    assert told[0] > told[1]
