"""A scripted person at a terminal: a command on a pty of its own, what it shows, what is typed."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import sys
import termios
import time
from pathlib import Path

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
        self.code: int | None = None
        environment = {**os.environ, "TERM": "xterm-256color", "PYTHONUTF8": "1"}
        self.pid, self._terminal = pty.fork()
        if self.pid == 0:
            os.chdir(folder)
            os.execve(sys.executable, [sys.executable, *arguments], environment)
        columns, lines = size
        fcntl.ioctl(self._terminal, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        if self.code is None:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
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
        _, status = os.waitpid(self.pid, 0)
        self.code = os.waitstatus_to_exitcode(status)
        return self.code

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
