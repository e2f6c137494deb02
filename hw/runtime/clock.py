"""Bench time: monotonic seconds that may run faster than those on the wall.

Every freshness limit and time-out of ``hw`` counts in the seconds of one :class:`Clock`. On a real
bench that is :data:`REAL`. An emulated bench may run ``speed`` times faster: then 100 ms of bench
time are 100 / speed ms on the wall, and all parties must share the clock's origin.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Clock:
    """A monotonic clock that starts at zero.

    ``time.monotonic`` is one clock for all processes of a machine, so a child process that is
    handed ``speed`` and ``origin_s`` reads the same bench time.
    """

    speed: float = 1.0
    """Bench seconds per second on the wall."""
    origin_s: float = field(default_factory=time.monotonic)
    """``time.monotonic()`` at bench time zero."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.speed) and self.speed > 0):
            raise ValueError(f"a clock's speed must be a positive number, not {self.speed}")
        if not math.isfinite(self.origin_s):
            raise ValueError(f"a clock's origin must be finite, not {self.origin_s}")

    def now(self) -> float:
        """Bench time (s)."""
        return (time.monotonic() - self.origin_s) * self.speed

    def at(self, monotonic_s: float) -> float:
        """Bench time (s) of a reading of ``time.monotonic()``."""
        return (monotonic_s - self.origin_s) * self.speed

    def wall(self, seconds: float) -> float:
        """Wall seconds that a number of bench seconds takes."""
        return seconds / self.speed

    def patience(self, seconds: float) -> float:
        """A limit on silence in bench seconds, at least as long on the wall as in real time.

        A busy machine delays a process by the same wall time however fast the bench runs. At ten
        times real time 100 ms would be 10 ms on the wall, and every short delay would be a fault.
        """
        return seconds * max(self.speed, 1.0)

    def sleep(self, seconds: float) -> None:
        """Sleep for bench seconds; not at all for zero or less."""
        if seconds > 0:
            time.sleep(seconds / self.speed)


REAL = Clock()
"""The clock of a real bench; its zero is the import of this module."""
