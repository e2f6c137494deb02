"""The emulated device's end of a line: the master of a pty, or a TCP port for ``socket://``.

Both read and write without ever waiting. Data that the other end does not take are kept up to a
bound, as in the buffer of a bridge, and refused beyond it.
"""

from __future__ import annotations

import os
import socket
from abc import ABC, abstractmethod
from pathlib import Path

_MOST_PENDING = 1 << 16


class Link(ABC):
    """One end of a line.

    Attributes:
        url: what the other end opens.
    """

    url: str

    def __init__(self) -> None:
        self._pending = bytearray()

    @abstractmethod
    def fileno(self) -> int:
        """File descriptor to wait on for reading."""

    @abstractmethod
    def read(self) -> bytes:
        """Whatever has come; may be empty."""

    @abstractmethod
    def close(self) -> None:
        """Vanish from the other end, as an unplugged cable does."""

    @abstractmethod
    def _send(self, data: bytearray) -> int:
        """Hand over what the other end has room for; the number of bytes."""

    def write(self, data: bytes) -> bool:
        """Send; False when there is no room: then none of the data are sent."""
        if len(self._pending) + len(data) > _MOST_PENDING:
            self.flush()
            if len(self._pending) + len(data) > _MOST_PENDING:
                return False
        self._pending += data
        self.flush()
        return True

    @property
    def waits(self) -> bool:
        """Whether data that were sent are still kept here."""
        return bool(self._pending)

    def flush(self) -> None:
        """Hand over what the other end has room for."""
        del self._pending[: self._send(self._pending)]


class PtyLink(Link):
    """The master of a pty; a symbolic link with a fixed path leads to its slave.

    Args:
        path: of the link, like one made by a udev rule.
    """

    def __init__(self, path: Path) -> None:
        import tty

        super().__init__()
        self._path = path
        # The slave stays open here too: reading the master fails while nobody has the slave open.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._path.unlink(missing_ok=True)
        self._path.symlink_to(os.ttyname(self._slave))
        self.url = str(path)

    def fileno(self) -> int:
        """The master."""
        return self._master

    def read(self) -> bytes:
        """See :class:`Link`."""
        # The other end may have just emptied its buffer: what waits comes before any answer.
        self.flush()
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            return b""

    def _send(self, data: bytearray) -> int:
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """See :class:`Link`."""
        self._path.unlink(missing_ok=True)
        os.close(self._master)
        os.close(self._slave)


class TcpLink(Link):
    """A TCP port that takes one peer at a time, like a serial-to-TCP bridge."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__()
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self._peer: socket.socket | None = None
        self.url = f"socket://{host}:{self._listener.getsockname()[1]}"

    def fileno(self) -> int:
        """The peer, or the listener while there is none."""
        return (self._peer or self._listener).fileno()

    def read(self) -> bytes:
        """See :class:`Link`."""
        if self._peer is None:
            try:
                self._peer, _ = self._listener.accept()
            except BlockingIOError:
                return b""
            self._peer.setblocking(False)
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._pending.clear()
        try:
            data = self._peer.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def write(self, data: bytes) -> bool:
        """As :meth:`Link.write`; lost where there is no peer."""
        return self._peer is None or super().write(data)

    def _send(self, data: bytearray) -> int:
        if self._peer is None:
            return 0
        try:
            return self._peer.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return 0

    def _hang_up(self) -> None:
        if self._peer is not None:
            self._peer.close()
            self._peer = None
        self._pending.clear()

    def close(self) -> None:
        """See :class:`Link`."""
        self._hang_up()
        self._listener.close()
