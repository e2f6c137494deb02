"""ur_rtde must not connect again: it would send its script again, and nobody would watch that.

ur_rtde opens a connection that was reset again, in a thread of its own, and starts its program on
the robot anew. That program has no watchdog yet, so it would stay on the robot when this process
has ended. A reset may be noticed too late to prevent this: a command that waits for the controller
holds the interpreter's lock. A connection needs a file descriptor, so this process is
denied new ones while ur_rtde is connected, and ur_rtde's thread ends with an error instead.
"""

from __future__ import annotations

import os
import resource
import socket
import threading


class NoReconnect:
    """Denies new file descriptors; made before ur_rtde opens its own.

    The limit is the lowest descriptor that was free then, so what ur_rtde closes lies above it and
    cannot be opened again. What is open already goes on working.

    Args:
        host: the controller's address; looked up now, because that takes descriptors. A name may
            stand for several addresses, of which not all answer (``localhost`` often is ::1, too).

    Raises:
        OSError: the address is not known.
    """

    def __init__(self, host: str) -> None:
        self._found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        self._lowest = os.dup(0)
        os.close(self._lowest)
        self._opening = threading.Lock()
        self._before = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._begun = False

    def begin(self) -> None:
        """Deny new descriptors from now on, but to :meth:`connect`."""
        with self._opening:
            self._begun = True
            self._deny()

    def connect(self, address: tuple[str, int], timeout_s: float) -> socket.socket:
        """A connection of our own to the controller, at the first of its addresses that answers.

        Descriptors are free for microseconds.

        Raises:
            OSError: nothing answers there.
        """
        problem: OSError | None = None
        for family, kind, protocol, _, found in self._found:
            try:
                opened = self._socket(family, kind, protocol)
            except OSError as error:
                problem = error
                continue
            try:
                opened.settimeout(timeout_s)
                opened.connect((found[0], address[1], *found[2:]))
                return opened
            except OSError as error:
                opened.close()
                problem = error
        assert problem is not None
        raise problem

    def _socket(self, family: int, kind: int, protocol: int) -> socket.socket:
        with self._opening:
            resource.setrlimit(resource.RLIMIT_NOFILE, self._before)
            try:
                return socket.socket(family, kind, protocol)
            finally:
                if self._begun:
                    self._deny()

    def _deny(self) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (self._lowest, self._before[1]))
