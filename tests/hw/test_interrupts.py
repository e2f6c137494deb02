"""A signal that asks the program to end counts, also where its exception is dropped."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading

import pytest

from hw.runtime.interrupts import as_interrupts, heed_interrupt

pytestmark = pytest.mark.skipif(
    threading.current_thread() is not threading.main_thread() or sys.platform == "win32",
    reason="signals come to the main thread; on Windows os.kill ends the process",
)


class Dying:
    """Interrupted in its finaliser."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)


def collecting(phase: str, info: dict) -> None:
    """A callback of the garbage collector that is interrupted."""
    gc.callbacks.remove(collecting)
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("where", ["finaliser", "collector"])
def test_an_interrupt_that_python_drops_is_raised_again(monkeypatch, where):
    dropped: list[type] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda problem: dropped.append(problem.exc_type))
    before = signal.getsignal(signal.SIGTERM)
    with as_interrupts():
        heed_interrupt()
        if where == "finaliser":
            dying = Dying()
            del dying
        else:
            gc.callbacks.append(collecting)
            gc.collect()
        assert dropped == [KeyboardInterrupt]
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                heed_interrupt()
    heed_interrupt()
    assert signal.getsignal(signal.SIGTERM) is before
