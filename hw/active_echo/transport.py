"""Bytes to and from the active-echo electronics: a serial port, a pty or a TCP bridge.

Every error of pyserial becomes a :class:`~hw.runtime.errors.DeviceError` or a subclass of it, with
one line for a person. A pty (the bench's emulator) takes any baud rate, also a wrong one.
"""

from __future__ import annotations

import contextlib
import errno
import threading
from typing import Any
from urllib.parse import urlsplit

from hw.runtime.errors import Device, DeviceError, LostError, StaleError
from hw.runtime.extras import require

BAUD = 921_600
"""Frames of 128 lines at 30/s are 162 kbaud: the usual 115200 is too slow."""

DEVICE: Device = "active echo"
_POLL_S = 0.02
_WRITE_TIMEOUT_S = 1.0


class Transport:
    """An open line to the device; one thread may read while another writes.

    Made by :func:`open_transport`.
    """

    def __init__(self, port: Any, url: str) -> None:
        self._port = port
        self._socket = "://" in url
        self._closed = False
        self._writing = threading.Lock()
        self.url = url

    def read(self) -> bytes:
        """Whatever has arrived, after waiting at most 20 ms for the first byte; may be empty.

        Raises:
            LostError: the port was unplugged, the peer has closed, or this transport was closed.
        """
        try:
            if self._socket:
                return self._read_socket()
            return self._port.read(max(1, self._port.in_waiting))
        # pyserial has TypeError and AttributeError for a port that another thread has closed.
        except (OSError, TypeError, AttributeError, ValueError) as error:
            raise self._lost() from error

    def _read_socket(self) -> bytes:
        # Over socket:// pyserial does not know how much has come, and waits for as many bytes as
        # were asked for: so wait for one byte, then take what there is.
        self._port.timeout = _POLL_S
        first = self._port.read(1)
        if not first:
            return b""
        self._port.timeout = 0
        return first + self._port.read(65_536)

    def write(self, data: bytes) -> None:
        """Send all of ``data``.

        Raises:
            LostError: as :meth:`read`.
            StaleError: the other end takes nothing for a second.
        """
        stuck = require("serial", extra="serial").SerialTimeoutException
        try:
            with self._writing:
                self._port.write(data)
        except stuck as error:
            raise StaleError(
                f"{self.url} takes no commands: is it switched on?", device=DEVICE
            ) from error
        except (OSError, TypeError, AttributeError, ValueError) as error:
            raise self._lost() from error

    def _lost(self) -> LostError:
        what = "is closed" if self._closed else "is gone: was it unplugged?"
        return LostError(f"{self.url} {what}", device=DEVICE)

    def close(self) -> None:
        """Close the port; safe to repeat, and on a port that is gone."""
        self._closed = True
        # If the peer closed first, pyserial's socket:// leaves its socket open.
        inner = getattr(self._port, "_socket", None)
        with contextlib.suppress(OSError, TypeError, AttributeError, ValueError):
            self._port.close()
        if inner is not None:
            inner.close()


def open_transport(url: str) -> Transport:
    """Open a serial port or a pty by its path, or ``socket://host:port`` (a serial-to-TCP bridge).

    A port is opened exclusively: a second program that opens it in the same way is refused.

    Raises:
        DeviceError: no such port, no permission, used by another program, or pyserial missing.
    """
    serial: Any = require("serial", extra="serial")
    options: dict[str, Any] = {"timeout": _POLL_S, "write_timeout": _WRITE_TIMEOUT_S}
    if "://" not in url:
        options |= {"baudrate": BAUD, "exclusive": True}
    if url.startswith("socket://") and not _has_port(url):
        raise DeviceError(f"cannot open {url}: write it as socket://host:port", device=DEVICE)
    try:
        port = serial.serial_for_url(url, **options)
    # pyserial has KeyError and others for URLs that it does not understand.
    except Exception as error:
        text = _first_line(error)
        if getattr(error, "errno", None) == errno.ENOENT:
            found = require("serial.tools.list_ports", extra="serial").comports()
            ports = ", ".join(sorted(port.device for port in found)) or "no serial ports"
            text = f"there is no such port, perhaps it has another number now: there are {ports}"
        elif "lock" in text:
            text = "another program uses it"
        raise DeviceError(f"cannot open {url}: {text}", device=DEVICE) from None
    return Transport(port, url)


def _has_port(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return bool(parts.hostname and parts.port)
    except ValueError:
        return False


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
