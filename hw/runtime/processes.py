"""Starting and ending the processes that talk to a device, write a file or show a page."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
from typing import IO

from jaxcal.runtime.isolated import python_command

_KILLED_WALL_S = 5.0


def spawn(
    module: str,
    *arguments: str,
    stdin: bool = False,
    stderr: IO[bytes] | int | None = subprocess.DEVNULL,
) -> subprocess.Popen[bytes]:
    """Start a module in an isolated interpreter (:mod:`jaxcal.runtime.isolated`), output piped.

    A fresh interpreter rather than a fork: a fork of a process with threads (JAX has many) may
    deadlock. It leads its own process group, so that Ctrl-C reaches only the parent, which then
    stops it in order.
    """
    return subprocess.Popen(
        python_command(module, *arguments),
        stdin=subprocess.PIPE if stdin else subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=stderr,
        start_new_session=True,
    )


def first_line(process: subprocess.Popen[bytes], patience_s: float) -> bytes:
    """The first line of a process's output; empty where none comes within so many wall s.

    An interrupt ends the process: nobody else would, as long as this one goes on.
    """
    assert process.stdout is not None
    try:
        ready = select.select([process.stdout], [], [], patience_s)[0]
        return process.stdout.readline() if ready else b""
    except BaseException:
        process.kill()
        process.communicate()
        raise


def finish(process: subprocess.Popen[bytes], patience_s: float) -> bool:
    """Close a process's input, wait for its end, and kill it if that takes longer.

    Args:
        process: with or without an input.
        patience_s: wall s.

    Returns:
        Whether it ended by itself.
    """
    if process.stdin is not None:
        with contextlib.suppress(OSError):
            process.stdin.close()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        # One that hangs in a disk that does not answer ends only when that answers.
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_KILLED_WALL_S)
        return False
    return True


def be_prompt(priority: int) -> None:
    """Ask for real-time scheduling of the calling thread and those that it starts; 0 gives it up.

    On a busy machine a process waits for milliseconds before it may run. The processes that talk to
    the robot need little time, but at once. Only a privileged user gets it (on Linux: CAP_SYS_NICE,
    or an rtprio limit); for others nothing changes. ur_rtde's commands spin while they wait for an
    answer, so a thread that delivers the answer needs a higher priority than the one that asks.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
            os.sched_setscheduler(0, policy, os.sched_param(priority))


ASKS, RECEIVES, ANSWERS = 1, 2, 3
"""Priorities: of commanding, of reading the controller, and of the controller's emulator."""
