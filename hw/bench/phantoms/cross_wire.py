"""The cross-wire: two fishing lines of 0.2 mm that cross; nothing is wired to the electronics.

Every piece of a wire that the beam's thickness touches shows in the image, at its own lateral
position and range. In the mid-plane both wires show at the crossing, twice as bright as one wire;
beside the mid-plane they part. The image shows two wires only where they are further apart than the
width of a spot. The response spreads over the thickness of the beam, and the image alone says where
the mid-plane is.

Where on a wire the echo comes from changes with the angle of incidence: spots of real wires scatter
by 0.6 to 0.8 px, about 0.1 mm (jaxcal.data.segmentation.image, measured on a real recording).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.bench.look import Look
from hw.bench.phantoms.phantom import Mark, Phantom, two_way
from hw.bench.tank import Pose, Tank
from jaxcal.runtime.array_types import Float

WIRE_MM = 0.2
"""Diameter of the fishing lines (section 3.2)."""
SCATTER_MM = 0.1
"""SD of the place that the echo comes from, over directions (real recording, see above)."""
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
    """Two wires that cross at the world's target.

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
        crossing = world.target_of(pose, world.point_mm + np.asarray(self.beside_mm))
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
