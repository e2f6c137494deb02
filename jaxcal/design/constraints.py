"""Where a pose may be, and the five numbers that describe a pose of the plan.

A planned pose puts the target into the image plane. This leaves five of its six degrees of freedom:

    s1, s2   where in the image region the target is, each from -1 to 1
    w1, w2   the tilt, a rotation vector (rad) in the plane across the reference's axial direction
    turn     about the axial direction, rad

With the reference orientation L (image axes in the tracker's frame), the image's orientation is
L Exp([w1, w2, 0]) Exp([0, 0, turn]): every rotation whose axial direction is less than half a turn
from the reference's has exactly one tilt and one turn. In these numbers region and turn are
intervals and the cone is a disc. Box, reach and further conditions are checked on the pose itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import rotations_from_vectors, targets_in_images
from jaxcal.data.probe import CurvilinearProbe, Probe, check_probe
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.arrays import outline
from jaxcal.runtime.given_values import check_made, is_number, real_array
from jaxcal.runtime.messages import shown

_INSIDE = 1e-9
"""Numbers outside by less than this, due to rounding, count as inside."""
_LARGEST_MM = 5000
"""Nothing is seen so far away."""
_LEAST_MM = 1
"""Nothing is seen so near: depths of metres end before it."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
Allowed = Callable[[Float[np.ndarray, "n 4 4"]], Bool[np.ndarray, " n"]]


def _are_in_order(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a caller's value holds two numbers or points, the first nowhere the larger one."""
    try:
        numbers = real_array(value, "it")
    except InputError:
        return False
    return numbers.shape == shape and bool((numbers[0] <= numbers[1]).all())


def _said(answer: Any, count: int) -> Bool[np.ndarray, " n"]:
    """What a caller's ``allowed`` says of as many poses."""
    said = np.asarray(answer)
    if said.dtype != bool or said.shape != (count,):
        raise InputError(
            f"allowed must return {count} truth values for {count} poses, not {shown(answer)}"
        )
    return said


@dataclass(frozen=True)
class Region:
    """Where in the image the target may be; errors are averaged over the same region.

    Attributes:
        lateral_mm: least and largest position along the array, mm.
        depth_mm: least and largest range from the array, mm.
        radius_mm: of the arc of a curvilinear array; None for a linear one.
    """

    lateral_mm: tuple[float, float] = (-24.0, 24.0)
    depth_mm: tuple[float, float] = (15.0, 82.0)
    radius_mm: float | None = None

    def __post_init__(self) -> None:
        for name in ("lateral_mm", "depth_mm"):
            value = getattr(self, name)
            if not (_are_in_order(value, (2,)) and np.isfinite(value).all()):
                raise InputError(f"{name} of the region must be two mm in order, not {value!r}")
        if not (self.depth_mm[0] > 0 and _LEAST_MM <= self.depth_mm[1] <= _LARGEST_MM):
            raise InputError(
                f"depths must be positive mm, the far one {_LEAST_MM} to {_LARGEST_MM}, not "
                f"{self.depth_mm}"
            )
        if max(map(abs, self.lateral_mm)) > _LARGEST_MM:
            raise InputError(
                f"lateral positions must be up to {_LARGEST_MM} mm, not {self.lateral_mm}"
            )
        radius = self.radius_mm
        if radius is not None and not (is_number(radius) and 0 < radius < 1e4):
            raise InputError(f"the array's radius must be in mm, not {radius!r}")

    @classmethod
    def of_probe(
        cls,
        probe: Probe,
        depth_mm: tuple[float, float] = (15.0, 82.0),
        lateral_mm: tuple[float, float] | None = None,
    ) -> Region:
        """The region in front of a probe; by default 0.82 of its aperture."""
        check_probe(probe)
        half = 0.41 * probe.width_mm
        radius = probe.radius_mm if isinstance(probe, CurvilinearProbe) else None
        return cls((-half, half) if lateral_mm is None else lateral_mm, depth_mm, radius)

    def place(self, unit: Float[Any, "*n 2"]) -> Float[Any, "*n 3"]:
        """[lateral, 0, axial] (mm) of numbers between -1 and 1; numpy or JAX (traceable)."""
        xp = unit.__array_namespace__()
        (left, right), (near, far) = self.lateral_mm, self.depth_mm
        along = 0.5 * (left + right) + 0.5 * (right - left) * unit[..., 0]
        depth = 0.5 * (near + far) + 0.5 * (far - near) * unit[..., 1]
        if self.radius_mm is not None:
            angle, radius = along / self.radius_mm, self.radius_mm
            along, depth = (
                (radius + depth) * xp.sin(angle),
                (radius + depth) * xp.cos(angle) - radius,
            )
        return xp.stack([along, xp.zeros_like(along), depth], axis=-1)

    def unit(self, target: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """The two numbers of targets in the image frame; beyond -1 to 1 outside the region."""
        along, depth = target[..., 0], target[..., 2]
        if self.radius_mm is not None:
            angle = np.arctan2(along, depth + self.radius_mm)
            depth = np.hypot(along, depth + self.radius_mm) - self.radius_mm
            along = angle * self.radius_mm
        parts = []
        for value, (low, high) in ((along, self.lateral_mm), (depth, self.depth_mm)):
            half = max(0.5 * (high - low), _INSIDE)
            parts.append((value - 0.5 * (low + high)) / half)
        return np.stack(parts, axis=-1)

    def grid(self, across: int = 5, down: int = 5) -> Float[np.ndarray, "points 3"]:
        """Points evenly over the region, [lateral, 0, axial] mm."""
        first, second = np.meshgrid(np.linspace(-1, 1, across), np.linspace(-1, 1, down))
        return self.place(np.stack([first.ravel(), second.ravel()], axis=-1))


@dataclass(frozen=True, eq=False)
class Constraints:
    """Constraints on a pose.

    Attributes:
        region: of the image, for the target.
        reference: (3, 3) middle orientation, image -> tracker.
        cone_deg: half angle of the cone of axial directions about the reference's.
        turn_deg: largest turn about the axial direction, either way.
        box_mm: least and largest corner of a box for the image's origin (the tip), in the tracker's
            frame.
        reach_mm: least and largest distance of the probe's frame from the tracker's origin.
        allowed: a function of (n, 4, 4) poses probe -> tracker that says which may be visited, as a
            further condition, e.g. an arm's kinematics.
    """

    region: Region = field(default_factory=Region)
    reference: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    cone_deg: float = 40.0
    turn_deg: float = 90.0
    box_mm: Box | None = None
    reach_mm: tuple[float, float] | None = None
    allowed: Allowed | None = None

    __repr__ = outline

    def __post_init__(self) -> None:
        for name, largest in (("cone_deg", 85.0), ("turn_deg", 180.0)):
            value = getattr(self, name)
            if not (is_number(value) and 0 <= value <= largest):
                raise InputError(f"{name} must be 0 to {largest:g} degrees, not {value!r}")
        reference = real_array(self.reference, "reference")
        if not (
            reference.shape == (3, 3)
            and np.allclose(reference @ reference.T, np.eye(3), atol=1e-6)
            and np.linalg.det(reference) > 0
        ):
            raise InputError("the reference orientation must be a 3x3 rotation")
        check_made("region", self.region, Region, "jaxcal.design.Region")
        if self.box_mm is not None and not _are_in_order(self.box_mm, (2, 3)):
            raise InputError(
                f"box_mm must be the least and the largest corner, three mm each, not {self.box_mm}"
            )
        if self.reach_mm is not None and not _are_in_order(self.reach_mm, (2,)):
            raise InputError(f"reach_mm must be two mm in order, not {self.reach_mm}")
        if self.allowed is not None and not callable(self.allowed):
            raise InputError(f"allowed must be a function of poses, not {self.allowed!r}")

    @property
    def extent(self) -> Float[np.ndarray, " 5"]:
        """Largest magnitude of each of the five numbers."""
        cone, turn = np.radians([self.cone_deg, self.turn_deg])
        return np.array([1.0, 1.0, cone, cone, turn])

    def keeps(
        self,
        poses: Float[np.ndarray, "n 4 4"],
        image_to_probe: Float[np.ndarray, "4 4"],
        point: Float[np.ndarray, " 3"],
    ) -> Bool[np.ndarray, " n"]:
        """Which poses satisfy all constraints.

        Args:
            poses: probe -> tracker, mm.
            image_to_probe: X, mm.
            point: the target in the tracker's frame, mm.
        """
        numbers = self.coordinates(poses, image_to_probe, point)
        good = (np.abs(numbers[:, :2]) <= 1 + _INSIDE).all(axis=1)
        good &= np.hypot(numbers[:, 2], numbers[:, 3]) <= np.radians(self.cone_deg) + _INSIDE
        good &= np.abs(numbers[:, 4]) <= np.radians(self.turn_deg) + _INSIDE
        if self.box_mm is not None:
            tips = poses[:, :3, :3] @ image_to_probe[:3, 3] + poses[:, :3, 3]
            low, high = np.asarray(self.box_mm, float)
            good &= ((tips >= low) & (tips <= high)).all(axis=1)
        if self.reach_mm is not None:
            distance = np.linalg.norm(poses[:, :3, 3], axis=1)
            good &= (self.reach_mm[0] <= distance) & (distance <= self.reach_mm[1])
        if self.allowed is not None and good.any():
            good[good] = _said(self.allowed(poses[good]), int(good.sum()))
        return good

    def poses(
        self,
        numbers: Float[np.ndarray, "n 5"],
        image_to_probe: Float[np.ndarray, "4 4"],
        point: Float[np.ndarray, " 3"],
    ) -> Float[np.ndarray, "n 4 4"]:
        """Poses probe -> tracker (mm) from their five numbers."""
        tilt, turn = np.zeros((len(numbers), 3)), np.zeros((len(numbers), 3))
        tilt[:, :2], turn[:, 2] = numbers[:, 2:4], numbers[:, 4]
        image = self.reference @ rotations_from_vectors(tilt) @ rotations_from_vectors(turn)
        found = np.tile(np.eye(4), (len(numbers), 1, 1))
        found[:, :3, :3] = image @ image_to_probe[:3, :3].T
        place = self.region.place(numbers[:, :2]) @ image_to_probe[:3, :3].T + image_to_probe[:3, 3]
        found[:, :3, 3] = point - np.einsum("nij,nj->ni", found[:, :3, :3], place)
        return found

    def coordinates(
        self,
        poses: Float[np.ndarray, "n 4 4"],
        image_to_probe: Float[np.ndarray, "4 4"],
        point: Float[np.ndarray, " 3"],
    ) -> Float[np.ndarray, "n 5"]:
        """The five numbers of poses; the elevational offset is not among them and is ignored."""
        image = poses[:, :3, :3] @ image_to_probe[:3, :3]
        target = targets_in_images(poses, image_to_probe, point)
        relative = self.reference.T @ image
        axial = relative[:, :, 2]
        sine = np.hypot(axial[:, 0], axial[:, 1])
        angle = np.arctan2(sine, axial[:, 2])
        ratio = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 1.0)
        tilt = np.zeros((len(poses), 3))
        tilt[:, 0], tilt[:, 1] = -ratio * axial[:, 1], ratio * axial[:, 0]
        rest = rotations_from_vectors(-tilt) @ relative
        turn = np.arctan2(rest[:, 1, 0], rest[:, 0, 0])
        return np.column_stack([self.region.unit(target), tilt[:, :2], turn])
