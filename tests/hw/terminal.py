"""A scripted person at a terminal: a command on a pty of its own, what it shows, what is typed."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

OF_ITS_OWN = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""
"""Makes the terminal the one whose Ctrl-C reaches this process, which then becomes the command."""

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Terminal:
    """A command of this Python on a pty; a context manager that ends the command.

    Args:
        arguments: of ``python``.
        folder: where it runs.
        size: columns and lines.
    """

    def __init__(
        self, arguments: list[str], folder: Path, size: tuple[int, int] = (100, 40)
    ) -> None:
        self.shown = ""
        self._read = 0
        environment = {**os.environ, "TERM": "xterm-256color", "PYTHONUTF8": "1"}
        self._terminal, its_end = pty.openpty()
        columns, lines = size
        fcntl.ioctl(self._terminal, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        self.modes_before = self.modes()
        # pty.fork would run Python in a copy of this process, of whose locks some may be held.
        self._process = subprocess.Popen(
            [sys.executable, "-IS", "-c", OF_ITS_OWN, *arguments],
            cwd=folder, env=environment, start_new_session=True,
            stdin=its_end, stdout=its_end, stderr=its_end,
        )  # fmt: skip
        os.close(its_end)

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._terminal)

    def type(self, keys: str) -> None:
        """Press keys."""
        os.write(self._terminal, keys.encode())

    def wait_for(self, pattern: str, timeout_s: float = 300.0, flags: int = 0) -> re.Match[str]:
        """Read until the pattern is shown after what was found last; escapes are left out."""
        deadline = time.monotonic() + timeout_s
        while True:
            found = re.compile(pattern, flags).search(self.shown, self._read)
            if found is not None:
                self._read = found.end()
                return found
            assert self._more(deadline), f"{pattern!r} was not shown:\n{self.shown[-3000:]}"

    def finish(self, timeout_s: float = 300.0) -> int:
        """Read until the command ends; its exit status."""
        deadline = time.monotonic() + timeout_s
        while self._more(deadline):
            pass
        return self._process.wait(timeout_s)

    def hold_ctrl_c(self) -> None:
        """Press Ctrl-C again and again until the command ends."""
        while self._process.poll() is None:
            self.type("\x03")
            deadline = time.monotonic() + 0.2
            while self._more(deadline):
                pass

    def set_modes(self, modes: list) -> None:
        """Set the terminal as another program would."""
        termios.tcsetattr(self._terminal, termios.TCSANOW, modes)

    def modes(self) -> list:
        """Of the terminal, as ``termios`` has them."""
        return termios.tcgetattr(self._terminal)

    def _more(self, deadline: float) -> bool:
        """Read what comes next; False at the end or when it is too late."""
        if not select.select([self._terminal], [], [], max(deadline - time.monotonic(), 0.0))[0]:
            return False
        try:
            part = os.read(self._terminal, 1 << 16)
        except OSError:
            return False
        self.shown += ESCAPES.sub("", part.decode("utf-8", "replace"))
        return bool(part)
