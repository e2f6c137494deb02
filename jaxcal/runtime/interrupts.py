"""Ctrl-C where Python would drop it, or where it would do harm."""

from __future__ import annotations

import _thread
import gc
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_AGAIN_S = 0.01
"""Time after which a dropped interrupt is raised again, s."""


@contextmanager
def no_interrupt_lost() -> Iterator[None]:
    """Within it a KeyboardInterrupt that cannot be raised where it came is raised soon after.

    Out of a destructor or a callback of the garbage collection (JAX has one) Python cannot raise.
    It prints "Exception ignored in", and the program runs on as if nobody had pressed Ctrl-C.
    Other threads than the main one get no interrupts, so nothing is done there, nor within another
    of its kind.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or getattr(sys.unraisablehook, "__module__", None) == __name__:
        yield
        return
    previous = sys.unraisablehook
    turn, over = threading.Lock(), False

    def again() -> None:
        time.sleep(_AGAIN_S)
        with turn:
            if not over:
                _interrupt_main_thread()

    def hook(dropped: Any) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            # Not threading.Thread: the main thread may hold its lock at this moment.
            _thread.start_new_thread(again, ())
        else:
            previous(dropped)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = previous
        with turn:
            over = True


@contextmanager
def interrupt_held_back(until: Callable[[], object]) -> Iterator[None]:
    """Within it a Ctrl-C waits: it is raised after the end, as soon as ``until`` has returned.

    Args:
        until: called in a thread of its own, so it may wait for what encloses this.
    """
    main = threading.current_thread() is threading.main_thread()
    previous = signal.getsignal(signal.SIGINT)
    # Only the main thread gets interrupts, and a handler that is not Python's cannot be set back.
    if not main or previous is None:
        yield
        return
    came: list[int] = []

    def later() -> None:
        until()
        _interrupt_main_thread()

    def deliver(number: int, frame: FrameType | None) -> None:
        if _in_collection(frame):
            _thread.start_new_thread(again, ())
            return
        signal.signal(signal.SIGINT, previous)
        if callable(previous):
            previous(number, frame)
        else:
            signal.raise_signal(signal.SIGINT)

    def again() -> None:
        time.sleep(_AGAIN_S)
        _interrupt_main_thread()

    signal.signal(signal.SIGINT, lambda number, _frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, deliver if came else previous)
        if came:
            _thread.start_new_thread(later, ())


def _in_collection(frame: FrameType | None) -> bool:
    """Whether a callback of the garbage collection runs here, out of which nothing is raised."""
    callbacks = [getattr(callback, "__code__", None) for callback in gc.callbacks]
    while frame is not None:
        if frame.f_code in callbacks:
            return True
        frame = frame.f_back
    return False


def _interrupt_main_thread() -> None:
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        # A signal ends the main thread's waiting as well.
        signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()
