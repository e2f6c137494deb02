"""Plan of poses: where the probe looks at the target from (section 3.3 of the paper).

Orientations cover a cone about the direction in which the probe looks, with turns about it; the
target is spread over the image. All five numbers of a pose come from one Sobol sequence, shifted
modulo 1 by the seed (:mod:`jaxcal.design.candidates`). A pose whose tip leaves the box, or whose
tool centre point is out of the arm's reach, is passed over for the next one of the sequence.

A plan may also be a pool to choose from while the experiment runs (:mod:`hw.planning.pool`). The
whole pool is checked and confirmed before anything moves; which of its poses are visited, and in
which order, follows from the images (:mod:`hw.acquisition.planner`).

The planner knows a drawing of the probe's mount and roughly where the target is, not the truth. So
the target will be off the mid-plane by some millimetres; the search of :mod:`hw.midplane` corrects
this.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hw.planning.scene import Scene
from hw.runtime.rigid import looking_rotation
from jaxcal import InputError
from jaxcal.data.poses import check_poses
from jaxcal.io.atomic import save_figure
from jaxcal.runtime.array_types import Float

if TYPE_CHECKING:
    from jaxcal.design.constraints import Allowed, Constraints

MOST_POSES = 10_000
# A turn of one degree takes the arm about as long as this many mm.
_MM_PER_DEGREE = 1.0
_LEAST_DEPTH_MM = 1.0
_MOST_ROUNDS = 20


@dataclass(frozen=True)
class Extent:
    """What the plan covers, and the bounds that it keeps.

    Attributes:
        cone_deg: half angle of the cone of axial directions.
        turn_deg: turns about the axial direction, up to this either way.
        lateral_mm: the target's lateral position, up to this either way.
        depth_mm: least and largest range of the target.
        box_mm: ((3,), (3,)) least and largest corner, in the base frame, that the tip must stay
            within; None: anywhere.
        reach_mm: least and largest distance of the tool centre point from the base's origin.
    """

    cone_deg: float = 40.0
    turn_deg: float = 90.0
    lateral_mm: float = 24.0
    depth_mm: tuple[float, float] = (15.0, 82.0)
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    reach_mm: tuple[float, float] = (150.0, 850.0)

    def __post_init__(self) -> None:
        for name, least, largest, unit in (
            ("cone_deg", 0, 85, "degrees"),
            ("turn_deg", 0, 180, "degrees"),
            ("lateral_mm", 0, 500, "mm"),
        ):
            value = getattr(self, name)
            if not (np.isfinite(value) and least <= value <= largest):
                raise InputError(f"{name} must be {least} to {largest} {unit}, not {value}")
        for name in ("depth_mm", "reach_mm"):
            low, high = getattr(self, name)
            if not (np.isfinite([low, high]).all() and 0 < low <= high <= 5000):
                raise InputError(f"{name} must be two positive mm in order, not {(low, high)}")
        if self.depth_mm[1] < _LEAST_DEPTH_MM:
            raise InputError(f"depth_mm {self.depth_mm} lies within the probe's face: is it in m?")
        if self.box_mm is not None:
            box = np.asarray(self.box_mm, float)
            if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] >= box[1]).any():
                raise InputError("box_mm must be two corners in mm, the lower one first")


@dataclass(frozen=True)
class PosePlan:
    """A plan in the order of travel.

    Attributes:
        poses: (n, 4, 4) tool centre point -> base, mm.
        expected: (n, 2) where the target should then be in the image: [lateral, depth], mm.
        scene: the scene that it was made for.
        passed_over: poses of the sequence that left the box or the reach.
    """

    poses: Float[np.ndarray, "n 4 4"]
    expected: Float[np.ndarray, "n 2"]
    scene: Scene
    passed_over: int = 0

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def tips_mm(self) -> Float[np.ndarray, "n 3"]:
        """The probe's tip in the base frame, mm."""
        return self.poses[:, :3, :3] @ self.scene.tip_mm + self.poses[:, :3, 3]

    @property
    def travel_mm(self) -> float:
        """Length of the tip's way from the first pose to the last, mm."""
        return float(np.linalg.norm(np.diff(self.tips_mm, axis=0), axis=1).sum())


def plan_poses(count: int, scene: Scene, extent: Extent | None = None, seed: int = 0) -> PosePlan:
    """A plan of ``count`` poses.

    Args:
        count: 1 to 10000.
        scene: what is known of probe and target.
        extent: what to cover; the default covers 40 degrees and +-90 degrees of turn.
        seed: another one gives another plan of the same quality.

    Raises:
        InputError: an invalid scene, or a box or reach that leaves too few poses.
    """
    extent = Extent() if extent is None else extent
    if not 1 <= count <= MOST_POSES:
        raise InputError(f"a plan has 1 to {MOST_POSES} poses, not {count}")
    nominal = check_poses(np.asarray(scene.image_to_probe)[None], what="nominal image_to_probe")[0]
    point = np.asarray(scene.point_mm, float)
    looking = np.asarray(scene.looking, float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError("the target's nominal position must be three finite mm")
    if looking.shape != (3,) or not np.linalg.norm(looking) > 0:
        raise InputError("the looking direction must be three numbers, not all zero")

    from jaxcal.design.candidates import sobol_poses
    from jaxcal.design.information import Model

    bounds = constraints_of(scene, extent)
    poses, passed = sobol_poses(count, Model(nominal, point), bounds, seed)
    if len(poses) < count:
        raise InputError(
            f"only {len(poses)} of {count} poses stay inside the box and the reach: widen them, or "
            "narrow the cone"
        )
    return in_order(poses, scene, passed)


def constraints_of(scene: Scene, extent: Extent, allowed: Allowed | None = None) -> Constraints:
    """An extent about the direction in which a scene's probe looks."""
    from jaxcal.design.constraints import Constraints, Region

    return Constraints(
        region=Region((-extent.lateral_mm, extent.lateral_mm), extent.depth_mm),
        reference=looking_rotation(scene.looking),
        cone_deg=extent.cone_deg,
        turn_deg=extent.turn_deg,
        box_mm=extent.box_mm,
        reach_mm=extent.reach_mm,
        allowed=allowed,
    )


def in_order(poses: np.ndarray, scene: Scene, passed: int) -> PosePlan:
    """A plan of poses in an order of short travel."""
    tour = _short_tour(poses, scene.tip_mm)
    expected = scene.expected(poses)[:, [0, 2]]
    return PosePlan(poses[tour], expected[tour], scene, passed)


def _short_tour(poses: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """Order of short travel: nearest neighbour, then 2-opt; moves and turns both count."""
    tips = poses[:, :3, :3] @ tip + poses[:, :3, 3]
    apart = np.linalg.norm(tips[:, None] - tips[None], axis=-1)
    trace = np.einsum("aij,bij->ab", poses[:, :3, :3], poses[:, :3, :3])
    turn = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    cost = apart + _MM_PER_DEGREE * turn
    left = np.ones(len(poses), bool)
    tour = [0]
    left[0] = False
    for _ in range(len(poses) - 1):
        following = int(np.argmin(np.where(left, cost[tour[-1]], np.inf)))
        tour.append(following)
        left[following] = False
    return _two_opt(np.array(tour), cost)


def _two_opt(tour: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Reverse pieces of an open tour as long as that shortens it."""
    if len(tour) > 500:
        return tour
    for _ in range(_MOST_ROUNDS):
        better = False
        for first in range(1, len(tour) - 2):
            ends = tour[first + 1 :]
            after = np.append(tour[first + 2 :], -1)
            before, here = tour[first - 1], tour[first]
            now = cost[before, here] + np.where(after >= 0, cost[ends, after], 0.0)
            then = cost[before, ends] + np.where(after >= 0, cost[here, after], 0.0)
            gain = now - then
            best = int(np.argmax(gain))
            if gain[best] > 1e-9:
                last = first + 1 + best
                tour[first : last + 1] = tour[first : last + 1][::-1].copy()
                better = True
        if not better:
            break
    return tour


def box_edges(box: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "12 2 3"]:
    """The ends of a box's edges.

    Args:
        box: its lowest and highest corner.
    """
    corners = list(np.ndindex(2, 2, 2))
    edges = [pair for pair in combinations(corners, 2) if np.not_equal(*pair).sum() == 1]
    return box[np.array(edges), range(3)]


def preview(plan: PosePlan, path: Path, box_mm: Float[np.ndarray, "2 3"] | None = None) -> None:
    """Write a figure of the plan: tips and axes in the base frame, cone, target over the image.

    Args:
        plan: the poses in their order.
        path: the figure's file.
        box_mm: lowest and highest corner of the box for the probe, base frame; drawn if given.

    Raises:
        InputError: ``path`` ends in the name of no format of figures.
        OutputError: it cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(12, 4), layout="constrained")
    room = figure.add_subplot(1, 3, 1, projection="3d")
    tips = plan.tips_mm
    axial = plan.poses[:, :3, :3] @ plan.scene.image_to_probe[:3, 2]
    room.plot(*tips.T, "-", color="0.7", linewidth=0.8, label="path of the tip")
    room.quiver(
        *tips.T, *(12.0 * axial.T), color="tab:blue", linewidth=0.8, label="axial direction"
    )
    target = np.asarray(plan.scene.point_mm)[:, None]
    room.scatter(*target, color="red", marker="*", s=100, label="target")
    if box_mm is not None:
        for edge in box_edges(box_mm):
            room.plot(*edge.T, color="tab:orange", linewidth=1.0)
        room.plot([], [], [], color="tab:orange", label="box for the probe")
        room.set_aspect("equal")
    room.legend(loc="upper left", fontsize=7, frameon=False)
    room.set(
        xlabel="x (mm)",
        ylabel="y (mm)",
        zlabel="z (mm)",
        title=f"{len(plan)} poses, tip travels {plan.travel_mm:.0f} mm",
    )

    cone = figure.add_subplot(1, 3, 2, projection="polar")
    first, second, along = (axial @ looking_rotation(plan.scene.looking)).T
    tilt = np.degrees(np.arccos(np.clip(along, -1, 1)))
    number = np.arange(1, len(plan) + 1)
    cone.scatter(np.arctan2(second, first), tilt, c=number, s=16)
    cone.set_title("axial direction: tilt (degrees)", pad=18)

    image = figure.add_subplot(1, 3, 3)
    dots = image.scatter(*plan.expected.T, c=number, s=16)
    whole = MaxNLocator(integer=True)
    figure.colorbar(dots, ax=image, label="pose, in the order of the plan", ticks=whole)
    image.set(
        xlabel="lateral (mm)", ylabel="depth (mm)", title="target in the image", aspect="equal"
    )
    image.invert_yaxis()
    save_figure(figure, path, dpi=130.0)
