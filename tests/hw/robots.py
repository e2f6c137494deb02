"""An emulated robot for tests, at an address of its own: tests run side by side."""

from __future__ import annotations

import itertools
import os

import hw.bench.robot
from hw.bench.robot import START
from hw.bench.rtde import CB_SERIES, E_SERIES

__all__ = ["CB_SERIES", "E_SERIES", "START", "EmulatedRobot", "address"]

_numbers = itertools.count(1)


def address() -> str:
    """A loopback address that no other test uses."""
    number = os.getpid() * 64 + next(_numbers)
    return f"127.{1 + number // 62500 % 250}.{1 + number // 250 % 250}.{1 + number % 250}"


class EmulatedRobot(hw.bench.robot.EmulatedRobot):
    def __init__(self, **named) -> None:
        super().__init__(address(), **named)
