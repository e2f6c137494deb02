"""What every phantom of the simulated tank has in common.

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

from hw.bench.look import Look
from hw.bench.tank import ELEMENT_MM, Pose, Tank
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
