"""Limits of motion, from a TOML file.

A limit that does not limit anything is refused: every value has a bound of its own. A file with an
unknown or missing name is refused as a whole.

Two boxes bound what moves. The box (``box_min_mm``, ``box_max_mm``) holds the probe: its tip and
the convex hull of array face and housing (``hull_mm``). The arm's box (``arm_box_min_mm``,
``arm_box_max_mm``) holds the TCP, the flange and, where the arm's model is known, its elbow and
wrists with their housings; by default it is the half-space above the floor of the probe's box. The
arm's base is not checked against either box.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields

import numpy as np

from hw.robot.kinematics import model_named
from hw.runtime.errors import refused
from jaxcal.runtime.array_types import Float

_VECTORS = {
    "box_min_mm": 3,
    "box_max_mm": 3,
    "tip_mm": 3,
    "cone_axis": 3,
    "arm_box_min_mm": 3,
    "arm_box_max_mm": 3,
    "joint_min_deg": 6,
    "joint_max_deg": 6,
}
_TEXTS = ("arm_model", "force_reason")
_MOST_TEXT = 200

FURTHEST_MM = 2000.0
"""No corner of a box may lie further than this from the base along any axis: the largest known arm
(UR20) reaches 1.75 m."""
_LEAST_BOX_MM = 10.0
"""No probe fits into a box that is smaller along every axis."""
FURTHEST_TIP_MM = 500.0
"""No part of a probe may be further from the TCP than this."""
FORCE_WITHOUT_REASON_N = 140.0
"""For contact with a person's chest and abdomen the quasi-static limits of ISO/TS 15066 are no
higher than this; a higher cap needs ``force_reason``."""
CALLER_S = 0.12
"""How long the process that asks for motions may be silent in one (bench s): with the time to
notice it and to slow down the robot rests within 0.2 s."""
_MOST_CORNERS = 64
_LEAST_AGE_S = 0.02
"""A CB controller sends a pose every 8 ms, so the newest one may be this old when it is used."""
_LEAST_FORCE_N = 2.0
"""The precision of the finest force sensor of the maker's arms (data sheet of the UR3e)."""

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What bounds every motion. Frames: robot base, unless said otherwise.

    Raises:
        RefusedError: a limit is not a number, or does not bound anything.
    """

    box_min_mm: Vector3
    """Lowest corner of the box for the probe (tip and hull)."""
    box_max_mm: Vector3
    """Highest corner of that box."""
    tip_mm: Vector3
    """The probe's tip in the TCP's frame."""
    cone_axis: Vector3
    """Middle direction of the TCP's z axis."""
    cone_deg: float
    """Largest angle of the TCP's z axis from ``cone_axis``."""
    max_step_mm: float
    """Longest single motion, of the TCP and of the tip."""
    max_turn_deg: float
    """Largest turn in a single motion."""
    max_speed_mm_s: float
    """Largest speed of the TCP and of the tip."""
    max_acceleration_mm_s2: float = 100.0
    search_mm: float = 0.0
    """How far from a planned pose the search may go."""
    search_deg: float = 0.0
    search_speed_mm_s: float = 10.0
    """Speed cap of motions within the search envelope of one pose; at most 10 mm/s."""
    max_pose_age_s: float = 0.1
    """Largest age of the newest pose, before and during a motion; 0.02 to 0.1 s."""
    max_force_n: float = 20.0
    """Force at the TCP above which no motion starts, and a running one is stopped; 2 to 250 N."""
    force_reason: str = ""
    """Why a cap above 140 N is needed; without a reason such a cap is refused."""
    hull_mm: tuple[Vector3, ...] = ()
    """Corners of the probe's array face and housing in the TCP's frame (:func:`hull_of`)."""
    arm_model: str = ""
    """Of :data:`hw.robot.kinematics.MODELS`; empty: reach, joints and singularities are not
    checked."""
    arm_box_min_mm: Vector3 | None = None
    """Lowest corner of the arm's box; by default at the height of ``box_min_mm``, and 2 m away
    along x and y."""
    arm_box_max_mm: Vector3 | None = None
    """Highest corner of the arm's box; by default 2 m away along every axis."""
    joint_min_deg: Vector6 = (-360.0, -360.0, -180.0, -360.0, -360.0, -360.0)
    """Lowest angle of each joint. The elbow could turn further, but the forearm would meet the
    upper arm."""
    joint_max_deg: Vector6 = (360.0, 360.0, 180.0, 360.0, 360.0, 360.0)
    """Highest angle of each joint."""
    max_joint_speed_deg_s: float = 90.0
    """Largest speed of any joint."""
    min_singular_value_mm: float = 10.0
    """Smallest singular value allowed for the arm's Jacobian, mm per rad, where a rad of the flange
    counts as 100 mm; near a wrist singularity it is about the angle in degrees that joint 5 has
    left to the singularity."""

    def __post_init__(self) -> None:
        for item in fields(self):
            object.__setattr__(self, item.name, _checked(item.name, getattr(self, item.name)))
        # The half-space above the floor of the probe's box.
        if self.arm_box_min_mm is None:
            low = (-FURTHEST_MM, -FURTHEST_MM, self.box_min_mm[2])
            object.__setattr__(self, "arm_box_min_mm", low)
        if self.arm_box_max_mm is None:
            object.__setattr__(self, "arm_box_max_mm", (FURTHEST_MM,) * 3)
        for name in ("box", "arm_box"):
            low, high = getattr(self, f"{name}_min_mm"), getattr(self, f"{name}_max_mm")
            if max(map(abs, low + high)) > FURTHEST_MM:
                raise refused(
                    f"{name}_min_mm and {name}_max_mm must lie within {FURTHEST_MM:g} mm of the "
                    "base along every axis"
                )
            if any(a >= b for a, b in zip(low, high, strict=True)):
                raise refused(f"{name}_min_mm must lie below {name}_max_mm on every axis")
            if max(b - a for a, b in zip(low, high, strict=True)) < _LEAST_BOX_MM:
                raise refused(
                    f"{name}_min_mm and {name}_max_mm are less than {_LEAST_BOX_MM:g} mm apart "
                    "along every axis: are they in metres? They are in mm"
                )
        for point in (self.tip_mm, *self.hull_mm):
            if math.hypot(*point) > FURTHEST_TIP_MM:
                raise refused(
                    f"a point of the probe is {math.hypot(*point):g} mm from the TCP, over "
                    f"{FURTHEST_TIP_MM:g} mm: is its position in mm?"
                )
        if not 0.99 < math.hypot(*self.cone_axis) < 1.01:
            raise refused("cone_axis must be a unit vector")
        between("cone_deg", self.cone_deg, 0.0, 90.0)
        between("max_turn_deg", self.max_turn_deg, 0.0, 120.0)
        between("max_step_mm", self.max_step_mm, 0.0, 500.0)
        # A number in metres that means an allowed speed or acceleration is below these bounds.
        between("max_speed_mm_s", self.max_speed_mm_s, 0.25, 250.0)
        between("max_acceleration_mm_s2", self.max_acceleration_mm_s2, 2.0, 2000.0)
        between("search_mm", self.search_mm, 0.0, 50.0, closed=True)
        between("search_deg", self.search_deg, 0.0, 10.0, closed=True)
        between("search_speed_mm_s", self.search_speed_mm_s, 0.01, 10.0)
        # Below the lower bounds every move would be refused, and only at the robot.
        between(
            "max_pose_age_s",
            self.max_pose_age_s,
            _LEAST_AGE_S,
            0.1,
            closed=True,
            why="the newest pose of a controller may be that old",
        )
        between(
            "max_force_n",
            self.max_force_n,
            _LEAST_FORCE_N,
            250.0,
            closed=True,
            why="an arm that touches nothing measures as much",
        )
        between("max_joint_speed_deg_s", self.max_joint_speed_deg_s, 0.0, 180.0)
        between("min_singular_value_mm", self.min_singular_value_mm, 1.0, 100.0, closed=True)
        if self.max_force_n > FORCE_WITHOUT_REASON_N and len(self.force_reason.strip()) < 10:
            raise refused(
                f"max_force_n of {self.max_force_n:g} N, above {FORCE_WITHOUT_REASON_N:g} N, needs "
                "a sentence why: force_reason"
            )
        for low, high in zip(self.joint_min_deg, self.joint_max_deg, strict=True):
            if not -360.0 <= low < high <= 360.0:
                raise refused("joint_min_deg and joint_max_deg must be in order, within 360 deg")
        if self.arm_model:
            object.__setattr__(self, "arm_model", model_named(self.arm_model).name)

    @property
    def probe_points(self) -> Float[np.ndarray, "n 3"]:
        """The tip and the corners of the hull in the TCP's frame, mm."""
        return np.array([self.tip_mm, *self.hull_mm])

    @classmethod
    def from_mapping(cls, values: Mapping[str, object]) -> Limits:
        """Limits from names and values.

        Raises:
            RefusedError: unknown or missing names, or values out of bounds.
        """
        known = {item.name for item in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise refused(f"unknown limit {unknown[0]}")
        for item in fields(cls):
            if item.name not in values and item.default is MISSING:
                raise refused(f"the limit {item.name} is missing")
        checked = {name: _checked(name, value) for name, value in values.items()}
        return cls(**checked)  # pyright: ignore[reportArgumentType]


def _checked(name: str, value: object) -> float | str | tuple | None:
    if name in _TEXTS:
        if not isinstance(value, str) or len(value) > _MOST_TEXT:
            raise refused(f"{name} must be text of at most {_MOST_TEXT} letters")
        return value
    if name == "hull_mm":
        rows = value if isinstance(value, list | tuple) else [value]
        if len(rows) > _MOST_CORNERS:
            raise refused(f"hull_mm has more than {_MOST_CORNERS} corners")
        return tuple(numbers(row, 3, "every corner of hull_mm") for row in rows)
    if name in ("arm_box_min_mm", "arm_box_max_mm") and value is None:
        return None
    if name in _VECTORS:
        return numbers(value, _VECTORS[name], name)
    return numbers([value], 1, name)[0]


def numbers(value: object, size: int, name: str) -> tuple[float, ...]:
    """``size`` finite numbers.

    Raises:
        RefusedError: anything else.
    """
    items = value
    if not isinstance(items, Sequence) or isinstance(items, str):
        items = items.tolist() if isinstance(items, np.ndarray) and items.ndim == 1 else []
    good = [number for item in items if (number := _finite(item)) is not None]
    if len(good) != len(items) or len(good) != size:
        count = "a finite number" if size == 1 else f"{size} finite numbers"
        raise refused(f"{name} must be {count}")
    return tuple(good)


def _finite(value: object) -> float | None:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:  # a whole number beyond the largest float
        return None
    return number if math.isfinite(number) else None


def hull_of(
    image_to_probe: Float[np.ndarray, "4 4"], width_mm: float, thickness_mm: float, length_mm: float
) -> tuple[Vector3, ...]:
    """The eight corners of a probe's array face and housing in the TCP's frame, mm.

    Args:
        image_to_probe: image -> TCP, mm; the image's origin is the middle of the face.
        width_mm: of the face, lateral.
        thickness_mm: of the housing, elevational.
        length_mm: of the housing, from the face backwards.
    """
    corners = [
        (side * width_mm / 2, across * thickness_mm / 2, back, 1.0)
        for side in (-1.0, 1.0)
        for across in (-1.0, 1.0)
        for back in (0.0, -length_mm)
    ]
    placed = np.asarray(corners) @ np.asarray(image_to_probe, dtype=np.float64).T
    return tuple((float(x), float(y), float(z)) for x, y, z, _ in placed)


def between(
    name: str, value: float, low: float, high: float, *, closed: bool = False, why: str = ""
) -> None:
    """Refuse a value that is not above ``low`` (``closed``: nor equal to it) or above ``high``.

    ``why`` tells, of a value below ``low``, what is wrong with it.
    """
    if closed and not low <= value <= high:
        reason = f": {why}" if why and value < low else ""
        raise refused(f"{name} must be {low:g} to {high:g}, not {value:g}{reason}")
    if not closed and not low < value <= high:
        raise refused(f"{name} must be above {low:g} and at most {high:g}, not {value:g}")
