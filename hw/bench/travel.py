"""One motion of the emulated tool: a path, and the profile of speed along it."""

from __future__ import annotations

import math
from dataclasses import dataclass

Vector = tuple[float, ...]


@dataclass(frozen=True)
class Motion:
    """A path and the profile over it; the arm's state at any time follows from it."""

    start: float
    """Bench time (s) at which the profile starts."""
    position: Vector
    quaternion: Vector
    travel: Vector
    """Displacement (m) from the path's start to its end."""
    turn: Vector
    """Rotation vector (rad), in the base frame, from the path's start to its end."""
    length: float
    """Path length: metres, or radians where that is more."""
    speed: float
    acceleration: float
    first: float = 0.0
    """Path parameter (m or rad) at which the profile starts."""
    brake: bool = False
    error: tuple[Vector, Vector] = ((0.0,) * 6, (0.0,) * 6)
    planned_tcp: Vector = (0.0,) * 6
    """TCP offset (m, rad) whose path it is."""
    tcp: Vector = (0.0,) * 6
    """TCP offset (m, rad) that is reported."""

    def duration(self) -> float:
        """Bench seconds from its start until the arm rests."""
        if self.brake:
            return self.speed / self.acceleration
        if self.length <= 0:
            return 0.0
        if self.speed**2 >= self.length * self.acceleration:
            return 2 * math.sqrt(self.length / self.acceleration)
        return self.length / self.speed + self.speed / self.acceleration

    def at(self, t: float) -> tuple[float, float]:
        """Path parameter and its rate at bench time t."""
        passed, total = t - self.start, self.duration()
        if passed <= 0:
            return self.first, 0.0
        if self.brake:
            passed = min(passed, total)
            rate = max(0.0, self.speed - self.acceleration * passed)
            return self.first + passed * (self.speed + rate) / 2, rate
        if passed >= total:
            return self.length, 0.0
        peak = min(self.speed, math.sqrt(self.length * self.acceleration))
        ramp = peak / self.acceleration
        if passed < ramp:
            return self.acceleration * passed**2 / 2, self.acceleration * passed
        if passed > total - ramp:
            left = total - passed
            return self.length - self.acceleration * left**2 / 2, self.acceleration * left
        return peak * (passed - ramp / 2), peak
