"""The phantoms of the paper's section 3.2 for the simulated tank, and what they have in common.

At a true pose of the probe, a phantom says two things: how loud each transmitted line is at its
sensor (the electronics), and which marks it leaves in a B-mode frame (the image).

The probe's field across the image plane is Gaussian. :class:`hw.bench.tank.Beam` states the
profile that the electronics of the paper's element report; that element averages over its own
diameter, so the field itself is thinner:

    field(r)^2 = width(r)^2 - D^2 / 12,    D = 2.08 mm

and a sensor of another size hears width^2 = field^2 + size^2 / 12 (variance of a uniform strip).
A passive target is crossed by the field twice: its echo falls as the square of the field.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hw.bench.tank import ELEMENT_MM, Look, Pose, Tank
from jaxcal import InputError
from jaxcal.data.poses import targets_in_images
from jaxcal.runtime.array_types import Float

_RANGE_OF_PEAK_MM = 20.0
"""Range at which the beam's peak amplitude is stated, mm."""


@dataclass(frozen=True)
class Mark:
    """One Gaussian spot of the envelope in a B-mode frame.

    Spots of one source are pieces of one target: where they overlap, the strongest counts. Spots of
    different sources add up.

    Attributes:
        lateral_mm: lateral position of its middle.
        range_mm: range of its middle from the element line.
        strength: envelope at its middle; 1 is white.
        lateral_sd_mm: SD of the envelope along the lateral direction.
        axial_sd_mm: SD of the envelope along the axial direction.
        source: number of the target that it is a piece of.
    """

    lateral_mm: float
    range_mm: float
    strength: float
    lateral_sd_mm: float
    axial_sd_mm: float
    source: int = 0


@dataclass(frozen=True)
class Phantom(ABC):
    """One target in the tank.

    Attributes:
        name: on the command line.
        answers: whether it transmits into the image, so that a pattern can be injected.
    """

    name: ClassVar[str]
    answers: ClassVar[bool]

    @property
    def response_scale(self) -> float:
        """SD of the mid-plane shift of its response, relative to that of the paper's element."""
        return 0.0

    def noise_counts(self, world: Tank) -> float:
        """SD of the electronics' own noise with this sensor, counts."""
        return world.noise.amplitude_counts

    @abstractmethod
    def loudness(self, world: Tank, pose: Pose) -> Float[np.ndarray, " e"]:
        """Amplitude of every line at its sensor, without noise or saturation, counts."""

    @abstractmethod
    def marks(
        self, world: Tank, pose: Pose, look: Look, rng: np.random.Generator, threshold: int = 0
    ) -> list[Mark]:
        """What one frame shows of it.

        Args:
            world: where it is.
            pose: true pose of the tool centre point, tool -> base, mm.
            look: brightness, sizes and quality of the images.
            rng: of this frame.
            threshold: amplitude from which it answers, counts.
        """


@dataclass(frozen=True)
class Sensor(Phantom):
    """A phantom that hears the transmitted lines.

    Attributes:
        size_mm: of its sensitive part across the image plane.
    """

    size_mm: float = ELEMENT_MM

    @property
    def response_scale(self) -> float:
        """In proportion to its size (assumption): a point hears the most in the mid-plane."""
        return self.size_mm / ELEMENT_MM

    def width_mm(self, world: Tank, range_mm: np.ndarray | float) -> np.ndarray | float:
        """Elevational SD of the amplitude that it reports, mm."""
        return np.hypot(world.beam.field_mm(range_mm), self.size_mm / np.sqrt(12.0))

    def loudness(self, world: Tank, pose: Pose) -> Float[np.ndarray, " e"]:
        """Amplitude of every line at it, counts; 0 behind the probe."""
        lateral, elevation, axial = world.target(pose)
        elements = world.elements
        if axial <= 0:
            return np.zeros(len(elements))
        across = lateral - elements
        distance = np.hypot(across, axial)
        off = (elevation - world.response_shift_mm(pose, self.response_scale)) / self.width_mm(
            world, distance
        )
        gain = world.beam.peak * np.sqrt(_RANGE_OF_PEAK_MM / distance)
        return gain * np.exp(-0.5 * off**2) * (axial / distance) ** world.beam.directivity


def two_way(
    world: Tank, elevation_mm: np.ndarray | float, range_mm: np.ndarray | float
) -> np.ndarray | float:
    """Echo of a passive point relative to the mid-plane: the square of the one-way field."""
    off = np.asarray(elevation_mm, float) / world.beam.field_mm(range_mm)
    return np.exp(-(off**2))


@dataclass(frozen=True)
class ActiveEcho(Sensor):
    """The paper's active echo element: a PZT tube that hears every line and answers with a pulse.

    Outer diameter 2.08 mm, length 2 mm (section 3.2).

    Its answer crosses the beam once, so across the plane its mark in the image is as thick as what
    the electronics hear. It is loud: its reflections show in the image, and a person may take a
    reflection for the element. It is 2 mm wide: the place on it that hears the most moves with the
    direction of the sound (:meth:`hw.bench.tank.Tank.response_shift_mm`), and its mark is wider
    than a point's.
    """

    name = "active-echo"
    answers = True

    def marks(
        self, world: Tank, pose: Pose, look: Look, rng: np.random.Generator, threshold: int = 0
    ) -> list[Mark]:
        """The answer and, in a share of the frames, its reflection; nothing below the threshold."""
        loud = self.loudness(world, pose)
        best = float(loud.max())
        if best < max(threshold, 1):
            return []
        lateral, elevation, axial = world.target(pose)
        distance = float(np.hypot(elevation, axial))
        strength = look.echo * min(best / world.beam.peak, 1.0)
        # Received once, through the receive aperture alone, from a source of its own width.
        wide = float(np.hypot(np.sqrt(2.0) * look.lateral_mm, self.size_mm / np.sqrt(12.0)))
        found = [Mark(lateral, distance, strength, wide, look.axial_mm)]
        if look.ghost > 0 and rng.random() < look.ghost_share:
            ghost = strength * look.ghost
            found.append(Mark(lateral, distance + look.ghost_mm, ghost, wide, look.axial_mm))
        return found


WIRE_MM = 0.2
"""Diameter of the fishing lines (section 3.2)."""
SCATTER_MM = 0.1
"""SD of the place that the echo comes from, over directions (see :class:`CrossWire`)."""
DIRECTIONS = ((0.8, 0.6, 0.0), (-0.6, 0.8, 0.0))
"""Of the wires in the base frame: level, at right angles (assumption: the paper does not tell)."""
_HALF_MM = 30.0
_MOST_MARKS = 49
_FIRST_SOURCE = 10
"""First source number of the wires; the other targets in the tank have smaller numbers."""
_REACH = 3.0
"""Pieces of a wire are drawn this many SDs of the two-way field to either side of the plane."""


@dataclass(frozen=True)
class CrossWire(Phantom):
    """Two fishing lines that cross at the world's target; nothing is wired to the electronics.

    Every piece of a wire that the beam's thickness touches shows in the image, at its own lateral
    position and range. In the mid-plane both wires show at the crossing, twice as bright as one
    wire; beside the mid-plane they part. The image shows two wires only where they are further
    apart than the width of a spot. The response spreads over the thickness of the beam, and the
    image alone says where the mid-plane is.

    Where on a wire the echo comes from changes with the angle of incidence: spots of real wires
    scatter by 0.6 to 0.8 px, about 0.1 mm (jaxcal.data.segmentation.image, measured on a real
    recording).

    Attributes:
        wire_mm: diameter.
        beside_mm: where they cross, from the world's target, in the base frame.
        directions: of the two wires, unit vectors in the base frame.
    """

    wire_mm: float = WIRE_MM
    beside_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    directions: tuple[tuple[float, float, float], tuple[float, float, float]] = DIRECTIONS

    name = "cross-wire"
    answers = False

    def loudness(self, world: Tank, pose: Pose) -> Float[np.ndarray, " e"]:
        """Silence: there is no sensor."""
        return np.zeros(world.probe.elements)

    def marks(
        self, world: Tank, pose: Pose, look: Look, rng: np.random.Generator, threshold: int = 0
    ) -> list[Mark]:
        """The pieces of both wires within the thickness of the beam."""
        x = world.image_to_probe
        crossing = targets_in_images(pose, x, world.point_mm + np.asarray(self.beside_mm))
        if crossing[2] <= 0:
            return []
        scatter = SCATTER_MM * np.array([world.field(pose, 1), world.field(pose, 2)])
        # Sound returns from the surface that faces the probe.
        front = 0.5 * self.wire_mm
        found = []
        for wire, direction in enumerate(self.directions):
            along = np.asarray(direction) @ pose[:3, :3] @ x[:3, :3]
            width = float(world.beam.field_mm(crossing[2])) / np.sqrt(2.0)
            steep = max(abs(along[1]), _REACH * width / _HALF_MM)
            reach = _REACH * width / steep
            middle = float(np.clip(-crossing[1] / (np.sign(along[1]) * steep), -_HALF_MM, _HALF_MM))
            # An odd number: one piece lies in the plane.
            count = min(2 * int(reach / look.lateral_mm) + 3, _MOST_MARKS)
            for way in middle + reach * np.linspace(-1.0, 1.0, count):
                at = crossing + way * along
                if at[2] <= 0 or abs(way) > _HALF_MM:
                    continue
                distance = float(np.hypot(at[1], at[2]))
                strength = look.wire * float(two_way(world, at[1], distance))
                wide = look.two_way_mm(distance, float(crossing[2]))
                found.append(
                    Mark(
                        float(at[0] + scatter[0]),
                        distance - front + float(scatter[1]),
                        strength,
                        wide,
                        look.axial_mm,
                        _FIRST_SOURCE + wire,
                    )
                )
        return found


APERTURE_MM = 0.01
"""Receiving aperture (section 3.2)."""
LEAST_PRESSURE_MPA = 0.01
"""Lower end of its dynamic range (section 3.2), used as the SD of its noise (assumption)."""
PRESSURE_MPA = 1.0
"""In the mid-plane at the range where the beam's peak is stated (assumption)."""
TIP = 0.25
"""Echo of the fibre's tip relative to that of a wire (assumption)."""


@dataclass(frozen=True)
class Hydrophone(Sensor):
    """The paper's reference: a fibre-optic hydrophone, which hears every line and never answers.

    Receiving aperture 10 um and least pressure 0.01 MPa (section 3.2 of the paper). The pressure in
    the mid-plane is taken to be 1 MPa (assumption: usual for diagnostic imaging at a few cm in
    water), so that the sensor's noise is a hundredth of the peak. In the image its tip is a faint
    passive echo.

    Attributes:
        size_mm: receiving aperture.
    """

    size_mm: float = APERTURE_MM

    name = "hydrophone"
    answers = False

    def noise_counts(self, world: Tank) -> float:
        """The amplitude in the mid-plane times least pressure over the pressure there, counts."""
        return world.beam.peak * LEAST_PRESSURE_MPA / PRESSURE_MPA

    def marks(
        self, world: Tank, pose: Pose, look: Look, rng: np.random.Generator, threshold: int = 0
    ) -> list[Mark]:
        """A faint spot where the beam crosses the tip."""
        lateral, elevation, axial = world.target(pose)
        if axial <= 0:
            return []
        distance = float(np.hypot(elevation, axial))
        strength = TIP * look.wire * float(two_way(world, elevation, distance))
        wide = look.two_way_mm(distance, distance)
        return [Mark(lateral, distance, strength, wide, look.axial_mm)]


_KINDS = (ActiveEcho, CrossWire, Hydrophone)


def phantom_named(name: str) -> Phantom:
    """A phantom by its name on the command line, with the paper's sizes.

    Raises:
        InputError: no such phantom.
    """
    for kind in _KINDS:
        if kind.name == name:
            return kind()
    raise InputError(f"no phantom {name!r}; there are: {', '.join(k.name for k in _KINDS)}")
