"""The latch of a stop: once set, it stays until the robot rests, or for good."""

from __future__ import annotations

from dataclasses import dataclass

from hw.runtime.errors import DeviceError


@dataclass(frozen=True)
class Stop:
    """Why the robot must stop, and whether the stop ends motion for good."""

    error: DeviceError
    for_good: bool


class Ended(Exception):
    """The motion is over for good: the connection, the program or the robot's state is gone."""

    def __init__(self, cause: DeviceError) -> None:
        self.cause = cause


class StopLatch:
    """Keeps the first stop; a stop for good replaces a hesitation."""

    def __init__(self) -> None:
        self.stop: Stop | None = None

    def set(self, stop: Stop) -> None:
        """Latch a stop."""
        if self.stop is None or (stop.for_good and not self.stop.for_good):
            self.stop = stop

    def release(self) -> None:
        """Forget a hesitation, once the robot rests; a stop for good is never released."""
        assert self.stop is None or not self.stop.for_good
        self.stop = None
