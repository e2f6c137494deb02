"""Waiting for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NoReturn, Protocol, TypeVar

_Found = TypeVar("_Found")


def until(
    condition: Callable[[], _Found], seconds: float = 180.0, every_s: float = 0.002
) -> _Found:
    """Ask again and again until the answer is true; returns it."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(every_s)
    return found


class Readable(Protocol):
    def read(self, timeout_s: float) -> object: ...


def exhaust(device: Readable, timeout_s: float) -> NoReturn:
    """Read until there is nothing more to read, which is always an error."""
    while True:
        device.read(timeout_s)
