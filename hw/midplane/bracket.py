"""Result of a placement: where the target's elevational offset lies, and how it was found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxcal import InputError
from jaxcal.runtime.array_types import Float


@dataclass(frozen=True)
class Bracket:
    """An interval for the target's elevational offset in one image, mm.

    The offset counts along the image's elevational axis, with the probe standing where it was left:
    0 is the mid-plane.

    Attributes:
        centre_mm: the best guess.
        low_mm: lower end.
        high_mm: upper end; the offset lies between the ends in 99 of 100 images, if the stated
            accuracies hold.
        sd_mm: standard deviation of the guess.
    """

    centre_mm: float
    low_mm: float
    high_mm: float
    sd_mm: float

    def __post_init__(self) -> None:
        values = (self.low_mm, self.centre_mm, self.high_mm, self.sd_mm)
        if not (np.isfinite(values).all() and self.sd_mm >= 0):
            raise InputError(f"a bracket needs finite mm and an SD that is not negative: {values}")
        if not self.low_mm <= self.centre_mm <= self.high_mm:
            raise InputError(f"a bracket's centre must lie between its ends: {values[:3]}")

    @property
    def width_mm(self) -> float:
        """From end to end, mm."""
        return self.high_mm - self.low_mm

    @property
    def max_elevation_mm(self) -> float:
        """Bound m on |y|: what the engine takes as this image's ``max_elevation``."""
        return max(abs(self.low_mm), abs(self.high_mm))

    def contains(self, elevation_mm: float) -> bool:
        """Whether an elevational offset lies inside."""
        return bool(self.low_mm <= elevation_mm <= self.high_mm)


@dataclass(frozen=True)
class Placement:
    """One finished placement; the probe stands at ``offset_mm``.

    Attributes:
        bracket: where the target's offset lies.
        offset_mm: how far the probe was moved along its elevational axis from the plan's pose.
        moves: single moves made.
        samples: (k, 3) offset (mm), amplitude (counts; 0: not heard) and threshold of every stop,
            the one where it stands last.
        notes: what a person should know.
    """

    bracket: Bracket
    offset_mm: float
    moves: int
    samples: Float[np.ndarray, "k 3"]
    notes: tuple[str, ...] = ()
