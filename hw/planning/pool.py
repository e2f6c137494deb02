"""Poses to choose from while an experiment runs: the pool of ``--plan optimal``.

The pool holds poses that are optimal for the SDs of a typical bench, and Sobol poses between them,
all inside the plan's extent and the limits of motion.
"""

from __future__ import annotations

import numpy as np

from hw.planning.poses import Extent, PosePlan, constraints_of, in_order, plan_poses
from hw.planning.scene import Scene
from hw.robot.kinematics import dexterity_mm, flange_of, inverse, model_named
from hw.robot.limits import Limits
from jaxcal.data.poses import check_poses
from jaxcal.design import Model, Noise, Rules, make_candidates, plan
from jaxcal.design.constraints import Allowed
from jaxcal.runtime.array_types import Bool, Float

BENCH_SDS_MM = (0.15, 0.12, 0.35)
"""Lateral, range and elevational SDs assumed before there are images: for an arm that is good to
0.1 mm and an element that is heard 0.3 mm off the plane. They may be wrong by a factor of three."""
BENCH_RULES = Rules(replicates=1, apart_deg=4.0, apart_mm=1e6)
"""One image for each orientation: two images of one orientation would share the shift of the
element's response."""
_CANDIDATES = 1000
_SEARCH_ROOM_MM = 5.0


def plan_pool(
    count: int,
    scene: Scene,
    extent: Extent | None = None,
    seed: int = 0,
    allowed: Allowed | None = None,
) -> PosePlan:
    """Poses to choose ``count`` images from: up to 2 ``count`` optimal and ``count`` Sobol poses.

    Args:
        count: 4 to 1000.
        scene: what is known of probe and target.
        extent: what to cover.
        seed: of candidates and Sobol poses.
        allowed: which poses may be visited beyond the extent's limits (:func:`allowed_by`).

    Raises:
        InputError: as :func:`plan_poses`, or poses from which nothing can be calibrated.
    """
    extent = Extent() if extent is None else extent
    spread = plan_poses(count, scene, extent, seed)
    nominal = check_poses(np.asarray(scene.image_to_probe)[None], what="nominal image_to_probe")[0]
    bounds = constraints_of(scene, extent, allowed)
    model = Model(nominal, np.asarray(scene.point_mm, float), Noise.constant(BENCH_SDS_MM))
    candidates = make_candidates(count=_CANDIDATES, constraints=bounds, model=model, seed=seed + 1)
    best = plan(candidates, 2 * count, rules=BENCH_RULES).poses
    between = spread.poses[bounds.keeps(spread.poses, nominal, model.point)]
    return in_order(np.concatenate([best, between]), scene, spread.passed_over)


def allowed_by(limits: Limits, tcp_offset: tuple[float, ...] | None) -> Allowed:
    """Which poses the limits of motion allow: box, cone, and where the arm is known its joints.

    A pose that is allowed may still not be reached from another one; the way is checked by
    :mod:`hw.robot.path_checks`.

    Args:
        limits: of motion.
        tcp_offset: m and rad; None: the arm's joints are not checked.
    """
    axis = np.asarray(limits.cone_axis) / np.linalg.norm(limits.cone_axis)
    corners = limits.probe_points
    # Room for the search along the elevational axis; mostly a few mm are enough.
    margin = min(limits.search_mm, _SEARCH_ROOM_MM)
    low, high = np.radians(limits.joint_min_deg), np.radians(limits.joint_max_deg)

    def allowed(poses: Float[np.ndarray, "n 4 4"]) -> Bool[np.ndarray, " n"]:
        tilt = np.degrees(np.arccos(np.clip(poses[:, :3, 2] @ axis, -1, 1)))
        good = tilt <= limits.cone_deg - limits.search_deg
        places = np.einsum("nij,pj->npi", poses[:, :3, :3], corners) + poses[:, None, :3, 3]
        room = np.minimum(places - limits.box_min_mm, np.asarray(limits.box_max_mm) - places)
        good &= room.min(axis=(1, 2)) >= margin
        if not limits.arm_model or tcp_offset is None or not good.any():
            return good
        model = model_named(limits.arm_model)
        rows = np.flatnonzero(good)
        found = inverse(model, flange_of(poses[rows], tcp_offset))
        joints = np.where(found.reached[..., None], found.joints, 0.0)
        fine = found.reached & ((joints >= low) & (joints <= high)).all(axis=-1)
        fine &= dexterity_mm(model, joints) >= limits.min_singular_value_mm
        good[rows] = fine.any(axis=1)
        return good

    return allowed
