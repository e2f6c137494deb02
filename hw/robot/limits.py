"""Limits of motion, from a TOML file.

A limit that does not limit anything is refused: every value has a bound of its own, and a file with
an unknown or missing name is not read at all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path

import numpy as np

from hw.errors import RefusedError
from jaxcal.errors import FormatError
from jaxcal.io.toml import load_toml

_LARGEST = 1e300
_VECTORS = ("box_min_mm", "box_max_mm", "tip_mm", "cone_axis")

Vector3 = tuple[float, float, float]


def _refuse(text: str) -> RefusedError:
    return RefusedError(text, device="robot")


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What bounds every motion. Frames: robot base, unless said otherwise.

    Raises:
        RefusedError: a limit is not a number, or does not bound anything.
    """

    box_min_mm: Vector3
    """Lowest corner of the box for the probe's tip."""
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
    """Of the TCP and of the tip."""
    max_acceleration_mm_s2: float = 100.0
    search_mm: float = 0.0
    """How far from a planned pose the search may go."""
    search_deg: float = 0.0
    search_speed_mm_s: float = 10.0
    """Speed cap of motions within the search envelope of one pose; at most 10 mm/s."""
    max_pose_age_s: float = 0.1
    """Oldest pose on which to move; at most 0.1 s."""
    max_force_n: float = 20.0
    """Force at the TCP at which a motion is stopped."""

    def __post_init__(self) -> None:
        for item in fields(self):
            object.__setattr__(self, item.name, _checked(item.name, getattr(self, item.name)))
        if any(low >= high for low, high in zip(self.box_min_mm, self.box_max_mm, strict=True)):
            raise _refuse("box_min_mm must lie below box_max_mm on every axis")
        if not 0.99 < math.hypot(*self.cone_axis) < 1.01:
            raise _refuse("cone_axis must be a unit vector")
        between("cone_deg", self.cone_deg, 0.0, 90.0)
        between("max_turn_deg", self.max_turn_deg, 0.0, 120.0)
        between("max_step_mm", self.max_step_mm, 0.0, 1000.0)
        between("max_speed_mm_s", self.max_speed_mm_s, 0.0, 250.0)
        between("max_acceleration_mm_s2", self.max_acceleration_mm_s2, 0.0, 2000.0)
        between("search_mm", self.search_mm, -1.0, 100.0)
        between("search_deg", self.search_deg, -1.0, 30.0)
        between("search_speed_mm_s", self.search_speed_mm_s, 0.0, 10.0)
        between("max_pose_age_s", self.max_pose_age_s, 0.0, 0.1)
        between("max_force_n", self.max_force_n, 0.0, 250.0)
        if self.search_mm < 0 or self.search_deg < 0:
            raise _refuse("search_mm and search_deg cannot be negative")

    @classmethod
    def from_toml(cls, path: Path | str) -> Limits:
        """Read the table ``[limits]``.

        Raises:
            RefusedError: no such file or table, unknown or missing keys, or values out of bounds.
        """
        try:
            table = load_toml(path).get("limits")
        except FormatError as error:
            raise _refuse(str(error)) from None
        if not isinstance(table, dict):
            raise _refuse(f"{path}: there is no table [limits]")
        try:
            return cls.from_mapping(table)
        except RefusedError as error:
            raise _refuse(f"{path}: {error.args[0]}") from None

    @classmethod
    def from_mapping(cls, values: Mapping[str, object]) -> Limits:
        """Limits from names and values.

        Raises:
            RefusedError: unknown or missing names, or values out of bounds.
        """
        known = {item.name for item in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise _refuse(f"unknown limit {unknown[0]}")
        for item in fields(cls):
            if item.name not in values and item.default is MISSING:
                raise _refuse(f"the limit {item.name} is missing")
        checked = {name: _checked(name, value) for name, value in values.items()}
        return cls(**checked)  # pyright: ignore[reportArgumentType]


def _checked(name: str, value: object) -> float | tuple[float, ...]:
    if name in _VECTORS:
        return numbers(value, 3, name)
    return numbers([value], 1, name)[0]


def numbers(value: object, size: int, name: str) -> tuple[float, ...]:
    """``size`` finite numbers.

    Raises:
        RefusedError: anything else.
    """
    items = value
    if not isinstance(items, Sequence) or isinstance(items, str):
        items = items.tolist() if isinstance(items, np.ndarray) and items.ndim == 1 else []
    good = [
        float(item) for item in items
        if isinstance(item, int | float) and not isinstance(item, bool) and abs(item) <= _LARGEST
    ]  # fmt: skip
    if len(good) != len(items) or len(good) != size:
        count = "a finite number" if size == 1 else f"{size} finite numbers"
        raise _refuse(f"{name} must be {count}")
    return tuple(good)


def between(name: str, value: float, low: float, high: float) -> None:
    """Refuse a value that is not above ``low`` and at most ``high``."""
    if not low < value <= high:
        raise _refuse(f"{name} must be above {low:g} and at most {high:g}, not {value:g}")
