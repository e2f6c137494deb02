"""Transducers: where the elements are, in the image frame.

Image frame: x lateral along the elements, z axial away from the transducer, y = z cross x
elevational; millimetres; origin at the centre of the element line. Element k of E sits at
x = (k - (E - 1)/2) pitch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxcal.errors import InputError


@dataclass(frozen=True)
class LinearProbe:
    """A linear array.

    Attributes:
        elements: number of transducer elements, at least 2.
        pitch_mm: distance between neighbouring element centres, mm.
        sound_speed_m_s: sound speed assumed for ranges, m/s (1490: water at room temperature).
    """

    elements: int = 128
    pitch_mm: float = 58.5 / 128
    sound_speed_m_s: float = 1490.0
    kind = "linear"

    def __post_init__(self) -> None:
        if not 2 <= self.elements <= 65536:
            raise InputError(f"a probe needs 2 to 65536 elements, not {self.elements}")
        if not (np.isfinite(self.pitch_mm) and 0 < self.pitch_mm < 100):
            raise InputError(f"probe pitch must be in mm between 0 and 100, not {self.pitch_mm}")
        if not 100 < self.sound_speed_m_s < 10000:
            raise InputError(
                f"sound speed must be in m/s (water: about 1490), not {self.sound_speed_m_s}"
            )

    def element_lateral(self) -> Float[np.ndarray, " elements"]:
        """Lateral position of every element, mm (Eq. 5's e_x; e_y = e_z = 0)."""
        return (np.arange(self.elements) - (self.elements - 1) / 2) * self.pitch_mm

    @property
    def width_mm(self) -> float:
        """Aperture: elements times pitch, mm."""
        return self.elements * self.pitch_mm


L14_5 = LinearProbe(elements=128, pitch_mm=58.5 / 128)
"""The paper's 58.5 mm L14-5W linear array (section 3.2)."""
