"""Ctrl-C where Python would drop it."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_AGAIN_S = 0.01
"""Time after which a dropped interrupt is raised again, s."""


@contextmanager
def no_interrupt_lost() -> Iterator[None]:
    """Within it a KeyboardInterrupt that cannot be raised where it came is raised soon after.

    Out of a destructor or a callback of the garbage collection (JAX has one) Python cannot raise.
    It prints "Exception ignored in", and the program runs on as if nobody had pressed Ctrl-C.
    """
    previous, main = sys.unraisablehook, threading.main_thread().ident
    turn, over = threading.Lock(), False

    def again() -> None:
        time.sleep(_AGAIN_S)
        with turn:
            if over:
                return
            if hasattr(signal, "pthread_kill") and main is not None:
                # A signal ends the main thread's waiting as well.
                signal.pthread_kill(main, signal.SIGINT)
            else:
                _thread.interrupt_main()

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
