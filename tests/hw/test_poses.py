"""Plans of poses: coverage, limits, order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hw.bench.world import make_world
from hw.poses import Extent, plan_poses, preview
from hw.scene import Scene
from jaxcal.errors import InputError

SCENE = make_world(0).scene


@settings(max_examples=20, deadline=None)
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
    preview(plan_poses(12, SCENE), path)
    assert path.read_bytes().startswith(b"\x89PNG")
