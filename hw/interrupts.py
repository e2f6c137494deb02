"""Ctrl-C and the signals that end a process: each of them stops the robot in an orderly way."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

ENDING = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
    if hasattr(signal, name)
)
"""The signals by which a person, a shell or a system asks a program to end; SIGBREAK on Windows."""
_AGAIN_S = 0.01


@contextmanager
def as_interrupts() -> Iterator[None]:
    """Within it each signal of ``ENDING`` raises KeyboardInterrupt in the main thread, like Ctrl-C.

    A shell starts background jobs with SIGINT ignored, so a stop by SIGINT would have no effect:
    here it has. SIGHUP stays ignored where it is ignored, since that is what ``nohup`` is for.

    Python only reports an exception that is raised in a finaliser or in a callback of the garbage
    collector (JAX has one), and goes on. A KeyboardInterrupt that is raised there is raised again.
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
    report = sys.unraisablehook

    def raise_again(problem: sys.UnraisableHookArgs) -> None:
        if issubclass(problem.exc_type, KeyboardInterrupt):
            # Later, and by another thread: raised within this function, it would be lost as well.
            _thread.start_new_thread(_interrupt_later, ())
        else:
            report(problem)

    for number in heard:
        signal.signal(number, signal.default_int_handler)
    sys.unraisablehook = raise_again
    try:
        yield
    finally:
        sys.unraisablehook = report
        for number in heard:
            signal.signal(number, before[number] or signal.SIG_DFL)


def _interrupt_later() -> None:
    time.sleep(_AGAIN_S)
    if hasattr(signal, "pthread_kill"):
        # A signal to the main thread itself also ends what that thread waits for.
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()
