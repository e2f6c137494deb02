"""Ctrl-C and the signals that end a process: each of them stops the robot in an orderly way."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType
from typing import NoReturn

ENDING = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
    if hasattr(signal, name)
)
"""The signals by which a person, a shell or a system asks a program to end; SIGBREAK on Windows."""

_asked: list[int] = []
"""Signals that have come within :func:`as_interrupts`. No lock: a handler may run at any place."""


@contextmanager
def as_interrupts() -> Iterator[None]:
    """Within it each signal of ``ENDING`` raises KeyboardInterrupt in the main thread, like Ctrl-C.

    A shell starts background jobs with SIGINT ignored, so a stop by SIGINT would have no effect:
    here it has. SIGHUP stays ignored where it is ignored, since that is what ``nohup`` is for.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    before = {number: signal.getsignal(number) for number in ENDING}
    heard = [
        number
        for number, handler in before.items()
        if not (number == getattr(signal, "SIGHUP", None) and handler is signal.SIG_IGN)
    ]
    _asked.clear()
    for number in heard:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number] or signal.SIG_DFL)
        _asked.clear()


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    _asked.append(number)
    raise KeyboardInterrupt


def heed_interrupt() -> None:
    """Raise the KeyboardInterrupt of a signal that came within :func:`as_interrupts` once more.

    The first one may have been dropped: Python only reports exceptions of finalisers and of
    callbacks of the garbage collector (JAX has one), Tk those of its callbacks, and both go on.
    Whatever moves the robot, or waits for a person in a window, calls this: a stop must not depend
    on the remedy of the command line (:mod:`jaxcal.runtime.interrupts`).
    """
    if _asked:
        raise KeyboardInterrupt


def lock_and_condition() -> tuple[AbstractContextManager[bool], threading.Condition]:
    """A lock of data that threads share, and a condition on it by which they wait for changes.

    The lock is what to enter: ``with lock``. A condition is entered by a function in Python, and a
    KeyboardInterrupt that comes there just after the lock was taken leaves it taken for ever. The
    other thread then waits for it, and whoever waits for the end of that thread does not end.
    """
    lock = threading.RLock()
    return lock, threading.Condition(lock)
