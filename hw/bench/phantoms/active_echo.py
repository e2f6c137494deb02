"""The active echo element: a PZT tube that hears every line and answers with a pulse.

Its answer crosses the beam once, so across the plane its mark in the image is as thick as what the
electronics hear. It is loud: its reflections show in the image, and a person may take a reflection
for the element. It is 2 mm wide: the place on it that hears the most moves with the direction of
the sound (:meth:`hw.bench.world.World.shift_mm`), and its mark is wider than a point's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.bench.look import Look
from hw.bench.phantoms.phantom import Mark, Sensor
from hw.bench.tank import ELEMENT_MM, Pose, Tank


@dataclass(frozen=True)
class ActiveEcho(Sensor):
    """The paper's element: outer diameter 2.08 mm, length 2 mm (section 3.2).

    Attributes:
        size_mm: outer diameter.
    """

    size_mm: float = ELEMENT_MM

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
