"""Suspending a process that a test has started."""

from __future__ import annotations

import os
import signal


def suspend(pid: int) -> None:
    """Stop a child, and wait until it has stopped.

    One of its threads takes the signal; on a busy machine the others go on until that one runs.
    """
    os.kill(pid, signal.SIGSTOP)
    os.waitid(os.P_PID, pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
