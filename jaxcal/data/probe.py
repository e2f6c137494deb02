"""Transducers: where the elements are, in the image frame.

Image frame: x lateral along the elements, z axial away from the transducer, y = z cross x
elevational; millimetres. The origin is the centre of the element line of a linear array, the apex
of the arc of a curvilinear one. Elements are counted k = 0 to E - 1 along x; a *scan line* belongs
to an element and leaves the array at right angles. So a point in the image plane is given by a scan
line (an element number, which need not be whole) and a range from the array.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from jaxcal import InputError
from jaxcal.data.names import ProbeKind
from jaxcal.data.sound import check_sound_speed
from jaxcal.runtime.array_types import Bool, Float, Num
from jaxcal.runtime.given_values import is_number, real_array

MOST_ELEMENTS = 65536
_LONGEST_DELAY_S = 1e-3


class _Array:
    """A straight array; the attributes are documented in the public classes.

    A curved one overrides how places along it and ranges become places in the image plane.
    """

    elements: int
    pitch_mm: float
    sound_speed_m_s: float
    delay_s: float

    def __post_init__(self) -> None:
        for name, value in dict(vars(self)).items():
            if value is None or real_array(value, name).ndim:
                raise InputError(f"{name} must be one number, not {value}")
            # Python's own number, whose value is part of what a program is compiled for.
            object.__setattr__(self, name, real_array(value, name).item())
        if not 2 <= self.elements <= MOST_ELEMENTS or self.elements != int(self.elements):
            raise InputError(f"a probe needs 2 to {MOST_ELEMENTS} elements, not {self.elements}")
        object.__setattr__(self, "elements", int(self.elements))
        if not (np.isfinite(self.pitch_mm) and 0 < self.pitch_mm < 100):
            raise InputError(f"pitch_mm must be in mm between 0 and 100, not {self.pitch_mm}")
        check_sound_speed(self.sound_speed_m_s)
        if not abs(self.delay_s) < _LONGEST_DELAY_S:
            raise InputError(f"delay_s must be in s, less than 1 ms, not {self.delay_s}")

    @property
    def width_mm(self) -> float:
        """Aperture along the array: elements times pitch, mm."""
        return self.elements * self.pitch_mm

    def one_way_range_mm(
        self, times_s: Float[np.ndarray, "*shape"], delay_s: float | None = None
    ) -> Float[np.ndarray, "*shape"]:
        """Distance from one-way time of flight (Eq. 2): (time - delay) * sound speed, mm.

        Args:
            times_s: s; NaN stays NaN.
            delay_s: s, used instead of the probe's own delay.
        """
        delay = self.delay_s if delay_s is None else delay_s
        return (real_array(times_s, "times") - delay) * (1e3 * self.sound_speed_m_s)

    def time_of_flight_s(
        self, distances_mm: Float[np.ndarray, "*shape"]
    ) -> Float[np.ndarray, "*shape"]:
        """One-way times of flight (s) over distances (mm), the electronics' delay included."""
        return real_array(distances_mm, "distances") / (1e3 * self.sound_speed_m_s) + self.delay_s

    def element_positions(self) -> Float[np.ndarray, "elements 3"]:
        """Every element's [lateral, elevational, axial], mm (e of Eqs. 5 and 6)."""
        return np.insert(self.image_to_cartesian(np.arange(self.elements), 0.0), 1, 0.0, axis=1)

    def element_lateral(self) -> Float[np.ndarray, " elements"]:
        """Lateral position of every element, mm."""
        return self.element_positions()[:, 0]

    def contains(
        self, points: Num[np.ndarray, "*batch d"], depth_mm: float
    ) -> Bool[np.ndarray, "*batch"]:
        """Whether points lie in front of the aperture, no deeper than ``depth_mm``.

        Args:
            points: [lateral, axial] or [lateral, elevational, axial], mm; elevation is ignored.
            depth_mm: deepest range from the array, mm.
        """
        along, depth = self._along_and_range(points)
        inside = (np.abs(along) <= self.width_mm / 2) & (depth > 0) & (depth <= depth_mm)
        return np.asarray(inside)

    def image_to_cartesian(
        self, line: Num[np.ndarray, "*#batch"] | float, range_mm: Num[np.ndarray, "*#batch"] | float
    ) -> Float[np.ndarray, "*batch 2"]:
        """[lateral, axial] (mm) on scan line ``line`` (element number) at ``range_mm`` (Eq. 3)."""
        along = (real_array(line, "line") - (self.elements - 1) / 2) * self.pitch_mm
        return self._place(along, real_array(range_mm, "range_mm"))

    def cartesian_to_image(
        self, points: Num[np.ndarray, "*batch d"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """Scan line (element number) and range from the array (mm) of places in the image plane."""
        along, depth = self._along_and_range(points)
        return along / self.pitch_mm + (self.elements - 1) / 2, depth

    def _place(
        self, along: Float[np.ndarray, "*#batch"], range_mm: Float[np.ndarray, "*#batch"]
    ) -> Float[np.ndarray, "*batch 2"]:
        """[lateral, axial], mm, of places along the array (mm from its middle) at a range."""
        return np.stack(np.broadcast_arrays(along, range_mm), axis=-1)

    def _along_and_range(
        self, points: Num[np.ndarray, "*batch d"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """The inverse of :meth:`_place`."""
        return _in_plane(points)


def _in_plane(points) -> tuple[np.ndarray, np.ndarray]:
    """Lateral and axial of points with two or three coordinates."""
    points = real_array(points, "points")
    if points.ndim == 0 or points.shape[-1] not in (2, 3):
        raise InputError(f"points need 2 or 3 coordinates, their shape is {points.shape}")
    return np.asarray(points[..., 0]), np.asarray(points[..., -1])


@dataclass(frozen=True)
class LinearProbe(_Array):
    """A linear array: element k at lateral (k - (E - 1)/2) pitch, axial 0.

    Attributes:
        elements: number of transducer elements, at least 2.
        pitch_mm: distance between neighbouring element centres, mm.
        sound_speed_m_s: sound speed assumed for ranges, m/s (1490: water at room temperature;
            :func:`jaxcal.sound_speed_in_water` gives it for others).
        delay_s: fixed delay of the electronics, s: time of flight = distance / sound speed + delay.
    """

    elements: int = 128
    pitch_mm: float = 58.5 / 128
    sound_speed_m_s: float = 1490.0
    delay_s: float = 0.0
    kind: ClassVar[Literal["linear"]] = "linear"


@dataclass(frozen=True)
class CurvilinearProbe(_Array):
    """A convex array on an arc about (0, -radius); the origin is the apex of the arc.

    Element k stands at the angle theta = (k - (E - 1)/2) pitch / radius, that is at lateral
    R sin(theta), axial R cos(theta) - R: the apex is the foremost point of the arc.

    Attributes:
        elements: number of transducer elements, at least 2.
        pitch_mm: distance between neighbouring element centres along the arc, mm.
        radius_mm: of the arc of element centres, mm.
        sound_speed_m_s: sound speed assumed for ranges, m/s.
        delay_s: fixed delay of the electronics, s: time of flight = distance / sound speed + delay.
    """

    elements: int = 128
    pitch_mm: float = float(np.radians(60.0)) * 60.0 / 128
    radius_mm: float = 60.0
    sound_speed_m_s: float = 1490.0
    delay_s: float = 0.0
    kind: ClassVar[Literal["curvilinear"]] = "curvilinear"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (is_number(self.radius_mm) and 0 < self.radius_mm < 1e4):
            raise InputError(f"probe radius must be in mm, up to 10000, not {self.radius_mm}")
        if self.half_angle_rad > np.pi / 2:
            raise InputError(
                f"{self.elements} elements at {self.pitch_mm:g} mm go more than half way round an "
                f"arc of {self.radius_mm:g} mm"
            )

    @property
    def half_angle_rad(self) -> float:
        """Half the angle that the aperture covers, rad."""
        return 0.5 * self.width_mm / self.radius_mm

    def polar(
        self, points: Num[np.ndarray, "*batch d"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """Angle (rad from the axis) and range from the arc (mm) of places in the image plane."""
        lateral, axial = _in_plane(points)
        behind = axial + self.radius_mm
        depth = np.hypot(lateral, behind) - self.radius_mm
        return np.asarray(np.arctan2(lateral, behind)), np.asarray(depth)

    def polar_to_cartesian(
        self,
        angle_rad: Num[np.ndarray, "*#batch"] | float,
        range_mm: Num[np.ndarray, "*#batch"] | float,
    ) -> Float[np.ndarray, "*batch 2"]:
        """[lateral, axial] (mm) in the direction ``angle_rad`` at ``range_mm`` from the arc."""
        angle, depth = real_array(angle_rad, "angle_rad"), real_array(range_mm, "range_mm")
        lateral = (self.radius_mm + depth) * np.sin(angle)
        # (R + d) cos(angle) - R without the cancellation.
        axial = depth * np.cos(angle) - 2.0 * self.radius_mm * np.sin(angle / 2) ** 2
        return np.stack(np.broadcast_arrays(lateral, axial), axis=-1)

    def _place(
        self, along: Float[np.ndarray, "*#batch"], range_mm: Float[np.ndarray, "*#batch"]
    ) -> Float[np.ndarray, "*batch 2"]:
        return self.polar_to_cartesian(along / self.radius_mm, range_mm)

    def _along_and_range(
        self, points: Num[np.ndarray, "*batch d"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        angle, depth = self.polar(points)
        return np.asarray(angle * self.radius_mm), depth


Probe = LinearProbe | CurvilinearProbe


def check_probe(probe: object) -> None:
    """Raise InputError if what a caller gave as a transducer is none."""
    if not isinstance(probe, Probe):
        raise InputError(
            "probe must be a jaxcal.LinearProbe or a jaxcal.CurvilinearProbe, not "
            f"{type(probe).__name__}"
        )


L14_5 = LinearProbe()
"""The paper's 58.5 mm L14-5W linear array (section 3.2)."""

C5_2 = CurvilinearProbe()
"""An abdominal convex array of the C5-2 kind: 128 elements over 60 degrees at 60 mm."""

PRESETS: dict[ProbeKind, Probe] = {"linear": L14_5, "curvilinear": C5_2}
