"""Bench time: monotonic seconds that may run faster than those on the wall.

Every freshness limit and time-out of ``hw`` counts in the seconds of one :class:`Clock`. On a real
bench that is :data:`REAL`. An emulated bench may run ``speed`` times faster: then 100 ms of bench
time are 100 / speed ms on the wall, and all parties must share the clock's origin.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

_MOST_DRIFT = 200e-6
_MOST_AHEAD_S = 0.1
HELD_UP_WALL_S = 0.5
"""A thread that comes back so much later than it asked for was held up, or its process was."""


def monotonic_s() -> float:
    """Seconds of the clock that all readings of :class:`Clock` come from.

    It is monotonic, and one clock for all processes of a machine. On Linux NTP changes the rate of
    ``time.monotonic``, by 500 ppm or more while it corrects the time: more than :class:`Lag` takes
    for the drift of two clocks. The rate of CLOCK_MONOTONIC_RAW is never changed. Windows lacks it,
    but does not change the rate of ``time.monotonic`` either.
    """
    return time.monotonic() if _RAW is None else time.clock_gettime(_RAW)


_RAW = getattr(time, "CLOCK_MONOTONIC_RAW", None)


def asleep_s() -> float:
    """For how long this computer has slept since it was started, s; 0 where it does not tell.

    While it sleeps, :func:`monotonic_s` stands still.
    """
    if _BOOT is None:
        return 0.0
    return time.clock_gettime(_BOOT) - time.clock_gettime(time.CLOCK_MONOTONIC)


_BOOT = getattr(time, "CLOCK_BOOTTIME", None)


@dataclass(frozen=True)
class Clock:
    """A monotonic clock that starts at zero.

    A child process that is handed ``speed`` and ``origin_s`` reads the same bench time.
    """

    speed: float = 1.0
    """Bench seconds per second on the wall."""
    origin_s: float = field(default_factory=monotonic_s)
    """Reading of :func:`monotonic_s` at bench time zero."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.speed) and self.speed > 0):
            raise ValueError(f"a clock's speed must be a positive number, not {self.speed}")
        if not math.isfinite(self.origin_s):
            raise ValueError(f"a clock's origin must be finite, not {self.origin_s}")

    def now(self) -> float:
        """Bench time (s)."""
        return (monotonic_s() - self.origin_s) * self.speed

    def at(self, reading_s: float) -> float:
        """Bench time (s) of a reading of :func:`monotonic_s`."""
        return (reading_s - self.origin_s) * self.speed

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


class Waiting:
    """How long this process has waited, in turns that are shorter than half a second on the wall.

    A longer turn counts as half a second: a process that was suspended (Ctrl-Z) or held up has not
    waited meanwhile, and what came during that time is still unread.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock, self._waited, self._last = clock, 0.0, time.monotonic()

    def so_far(self) -> float:
        """Bench seconds since the beginning; to be asked at every turn."""
        now = time.monotonic()
        self._waited += min(now - self._last, HELD_UP_WALL_S)
        self._last = now
        return self._waited * self._clock.speed


class Lag:
    """An upper bound of how long something was on its way (bench s).

    Its host time minus its device time is its lag plus the offset of the two clocks. A lower
    bound of the offset comes from one pair of times: what has this device time was not made
    before this host time (:attr:`hw.robot.rtde.PacketReader.bound`). A smaller difference seen
    later replaces it. As clocks drift, the bound is raised by 200 ppm of the time that passes, more
    than quartz clocks differ by; a lag that grows faster than that is still seen.

    A difference below the pair's, by more than this drift and 0.1 s, is impossible: the device's
    clock was set forward, runs fast, or counts in another unit. Such a clock would hide a lag: from
    then on the lag is infinite.

    Args:
        t_host: of the pair, bench s; without a pair, lags count from the smallest one seen.
        t_device: of the pair, s.
    """

    def __init__(self, t_host: float = math.inf, t_device: float = 0.0) -> None:
        self._floor = t_host - t_device
        self._lowest = self._floor - _MOST_AHEAD_S if math.isfinite(t_host) else -math.inf
        self._last = t_host
        self._lag = 0.0

    def set_back(self, t_host: float, t_device: float) -> None:
        """The device's clock was set back: this is taken to be as late as what came before it."""
        self._floor = t_host - t_device - self._lag

    def of(self, t_host: float, t_device: float) -> float:
        """Take the times of a pose or an image; returns its lag."""
        difference = t_host - t_device
        if math.isfinite(self._last):
            drift = _MOST_DRIFT * max(t_host - self._last, 0.0)
            self._floor += drift
            self._lowest -= drift
        self._last = t_host
        self._floor = min(self._floor, difference)
        if self._floor < self._lowest:
            self._floor = -math.inf
        self._lag = difference - self._floor
        return self._lag
