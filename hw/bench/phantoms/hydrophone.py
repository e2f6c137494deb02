"""The fibre-optic hydrophone: nearly a point, hears every line and never answers.

Receiving aperture 10 um and least pressure 0.01 MPa (section 3.2 of the paper). The pressure in the
mid-plane is taken to be 1 MPa (assumption: usual for diagnostic imaging at a few cm in water), so
that the sensor's noise is a hundredth of the peak. In the image its tip is a faint passive echo.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.bench.look import Look
from hw.bench.phantoms.phantom import Mark, Sensor, two_way
from hw.bench.tank import Pose, Tank

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
    """The paper's reference.

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
