"""What a person knows of a bench before it is calibrated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxcal.data.poses import targets_in_images
from jaxcal.runtime.array_types import Float


@dataclass(frozen=True)
class Scene:
    """What is known before the calibration.

    Attributes:
        image_to_probe: (4, 4) X as drawn, mm; off by some mm and degrees.
        point_mm: (3,) the target in the robot's base frame; off by some mm.
        looking: (3,) mean direction of the image's axial axis in the base frame.
    """

    image_to_probe: Float[np.ndarray, "4 4"]
    point_mm: Float[np.ndarray, " 3"]
    looking: Float[np.ndarray, " 3"]

    @property
    def tip_mm(self) -> Float[np.ndarray, " 3"]:
        """The middle of the probe's face in the tool centre point's frame, mm."""
        return self.image_to_probe[:3, 3]

    @property
    def elevational(self) -> Float[np.ndarray, " 3"]:
        """Unit vector of the image's elevational axis in the tool centre point's frame."""
        return self.image_to_probe[:3, 1]

    def expected(self, pose: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 3"]:
        """Where the target should be in the image of a probe at ``pose``, by this scene, mm.

        The negative of the elevational coordinate is the probe's place along a free-hand sweep.
        """
        return targets_in_images(pose, self.image_to_probe, self.point_mm)
