"""How bright, how large and how good what the frames of the simulated tank show is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Look:
    """How bright things are, as envelopes of at most 1, how large, and how good the images are.

    All numbers are assumptions: the paper shows no frame. They are usual for 60 dB of a linear
    array at 5 to 10 MHz.

    Attributes:
        echo: the active echo of a line at full amplitude.
        wire: a wire in the mid-plane; 0: there are no cross-wires beside the element.
        ghost: strength of the active echo's reflection relative to the echo; 0: none.
        ghost_mm: by how much deeper than the echo the reflection shows.
        ghost_share: share of the frames that show it.
        axial_mm: SD of a spot along the axial direction.
        lateral_mm: SD of a point's two-way spot along the lateral direction, in focus.
        focus_mm: depth of the transmit focus; None: set to the target's depth in every image.
        defocus: growth of the transmit beam's lateral SD per mm off its focus.
        speckle_db: level of the background, dB below white.
        face: envelope of the ringing at the probe's face; 0: none.
        beside_mm: place where the wires cross, relative to the element, in the base frame.
    """

    echo: float = 0.9
    wire: float = 0.25
    ghost: float = 0.08
    ghost_mm: float = 7.0
    ghost_share: float = 0.5
    axial_mm: float = 0.35
    lateral_mm: float = 0.6
    focus_mm: float | None = None
    defocus: float = 0.05
    speckle_db: float = 34.0
    face: float = 0.0
    beside_mm: tuple[float, float, float] = (12.0, 9.0, 0.0)

    def two_way_mm(self, range_mm: float, target_mm: float) -> float:
        """Lateral SD of a passive point's spot: the transmit beam times the receive beam, mm.

        The receive aperture is focused at every depth; the transmit beam only at its focus.

        Args:
            range_mm: of the point.
            target_mm: range at which the operator puts the focus, where it is not fixed.
        """
        focus = target_mm if self.focus_mm is None else self.focus_mm
        receive = np.sqrt(2.0) * self.lateral_mm
        transmit = np.hypot(receive, self.defocus * (range_mm - focus))
        return float(1.0 / np.hypot(1.0 / receive, 1.0 / transmit))
