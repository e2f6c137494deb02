"""A signal that asks the program to end is never lost."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from contextlib import suppress

import pytest

from hw.interrupts import as_interrupts

pytestmark = pytest.mark.skipif(
    threading.current_thread() is not threading.main_thread(),
    reason="signals come to the main thread",
)


class Dying:
    """Interrupted in its finaliser."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.001)


def collecting(phase: str, info: dict) -> None:
    """A callback of the garbage collector that is interrupted."""
    if phase == "start":
        gc.callbacks.remove(collecting)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.001)


def work(where: str) -> None:
    """Interrupted at once, and then busy for long."""
    if where == "finaliser":
        dying = Dying()
        del dying
    else:
        gc.callbacks.append(collecting)
        gc.collect()
    time.sleep(5.0)


@pytest.mark.parametrize("where", ["finaliser", "collector"])
def test_an_interrupt_where_python_drops_exceptions_comes_again(where):
    before = signal.getsignal(signal.SIGTERM)
    try:
        with as_interrupts(), pytest.raises(KeyboardInterrupt):
            work(where)
    finally:
        with suppress(ValueError):
            gc.callbacks.remove(collecting)
    assert signal.getsignal(signal.SIGTERM) is before
