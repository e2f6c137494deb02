"""Which arm answers at an address.

Two things tell arms apart. The dashboard gives the serial number (PolyScope 3.12 or newer on CB
series, 5.6 or newer on e-Series). The primary interface gives, on every connection, the factory's
calibration of the arm's kinematics with its checksum (3.6 or newer): it belongs to the arm, not to
the controller's box, and stays the same wherever box and arm are on the network. Where a controller
tells neither, the arm is not identified: :attr:`Identity.name` is then ``<model>@<address>``, and a
program that shows it must say that nothing identifies the arm.

Sources: Universal Robots' articles on the dashboard server and the client interfaces, and their
ur_client_library (``dashboard_client_implementation_g5.cpp`` for the versions, ``kinematics_info``
for the calibration's layout).
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import re
import socket
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from hw.runtime.errors import LostError
from jaxcal.runtime.messages import quoted

DASHBOARD_PORT, PRIMARY_PORT = 29999, 30001
_PATIENCE_S = 3.0
STOP_PATIENCE_S = 0.3
"""Longest wait (wall s) for the dashboard to stop a program: somebody waits to be told of it."""

ROBOT_STATE, KINEMATICS_INFO = 16, 5
"""Types of the primary interface's message and of its part that holds the kinematics."""
KINEMATICS = struct.Struct(">6I24dI")
"""Checksums of the joints; DH theta, a, d, alpha (rad, m), six each; state of the calibration."""
_MOST_BYTES = 1 << 18
"""After so many without a calibration there is none."""
_REMOTE = "is in remote control"
LOCAL = "the robot is in local control: switch it to remote control at the pendant"

Connect = Callable[[tuple[str, int], float], socket.socket]
"""Takes an address and a timeout (s), like :func:`socket.create_connection`."""


@dataclass(frozen=True)
class Identity:
    """Which robot it is.

    Attributes:
        address: at which it answers.
        serial: serial number, or None where the dashboard tells none.
        calibration: 12 hexadecimal digits of SHA-256 over the kinematic calibration and its
            checksums, or None where the controller tells none.
        version: of PolyScope.
        model: as the dashboard says.
        remote: whether it is in remote control; None where the dashboard knows no such thing (CB).
    """

    address: str
    serial: str | None
    calibration: str | None
    version: str
    model: str
    remote: bool | None = None

    @property
    def identified(self) -> bool:
        """Whether anything but the address tells this arm from another."""
        return self.serial is not None or self.calibration is not None

    @property
    def name(self) -> str:
        """Serial number and calibration as far as they are known, or ``<model>@<address>``."""
        if not self.identified:
            return f"{self.model}@{self.address}"
        calibration = self.calibration and f"calibration {self.calibration}"
        return ", ".join(part for part in (self.serial, calibration) if part)


def read_identity(host: str, *, timeout_s: float = _PATIENCE_S) -> Identity:
    """Ask the dashboard and the primary interface who the robot is.

    Raises:
        LostError: no connection, or no answer within ``timeout_s`` wall seconds.
    """
    deadline = time.monotonic() + timeout_s
    try:
        with socket.create_connection((host, DASHBOARD_PORT), timeout=timeout_s) as connection:
            stream = _Lines(connection, deadline)
            stream.line()
            version = stream.ask("PolyscopeVersion")
            serial = stream.ask("get serial number")
            model = stream.ask("get robot model")
            remote = stream.ask(_REMOTE)
    except TimeoutError:
        raise LostError(f"the dashboard of {host} does not answer", device="robot") from None
    except (OSError, UnicodeError) as error:
        text = f"no connection to the dashboard of {host}: {error}"
        raise LostError(text, device="robot") from error
    number = re.search(r"\d+\.\d+\.\d+(\.\d+)?", version)
    if number is None:
        raise LostError(
            f"the dashboard of {host} reports no version but {quoted(version)}: check the "
            "pendant, or restart the controller",
            device="robot",
        )
    return Identity(
        address=host,
        serial=serial if re.fullmatch(r"\d{4,20}", serial) else None,
        calibration=_read_calibration(host, timeout_s),
        version=number.group(),
        model=model if re.fullmatch(r"[\w-]{1,40}", model) else "unknown",
        remote={"true": True, "false": False}.get(remote.lower()),
    )


def until_local(host: str, *, period_s: float, connect: Connect) -> None:
    """Ask the dashboard again and again; returns once it says that the robot is in local control.

    A dashboard that is silent or gone says nothing about that, and is connected to again.
    """
    while True:
        with (
            contextlib.suppress(OSError),
            connect((host, DASHBOARD_PORT), _PATIENCE_S) as connection,
        ):
            stream = _Lines(connection, time.monotonic() + _PATIENCE_S)
            stream.line()
            while stream.ask(_REMOTE).lower() != "false":
                time.sleep(period_s)
                stream.deadline = time.monotonic() + _PATIENCE_S
            return
        time.sleep(period_s)


def stop_program(
    host: str,
    *,
    timeout_s: float = STOP_PATIENCE_S,
    connect: Connect = socket.create_connection,
) -> bool:
    """Ask the dashboard to stop the program; returns whether it says that it did."""
    deadline = time.monotonic() + timeout_s
    try:
        with connect((host, DASHBOARD_PORT), timeout_s) as connection:
            stream = _Lines(connection, deadline)
            stream.line()
            return stream.ask("stop").startswith("Stopped")
    except OSError:
        return False


def _read_calibration(host: str, timeout_s: float) -> str | None:
    """The calibration from the primary interface's first messages; None where there is none."""
    deadline = time.monotonic() + timeout_s
    data = b""
    with (
        contextlib.suppress(OSError),
        socket.create_connection((host, PRIMARY_PORT), timeout=timeout_s) as connection,
    ):
        while (left := deadline - time.monotonic()) > 0 and len(data) < _MOST_BYTES:
            connection.settimeout(left)
            new = connection.recv(1 << 16)
            if not new:
                break
            data += new
            states = [content for kind, content in _parts(data) if kind == ROBOT_STATE]
            for kind, content in itertools.chain.from_iterable(map(_parts, states)):
                if kind == KINEMATICS_INFO and len(content) >= KINEMATICS.size:
                    # All but the last word, which is a state, not a property of the arm.
                    return hashlib.sha256(content[: KINEMATICS.size - 4]).hexdigest()[:12]
    return None


def _parts(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Type and content of each message, or part of one, up to the first that is not whole."""
    while len(data) >= 5:
        size, kind = struct.unpack_from(">IB", data)
        if not 5 <= size <= len(data):
            return
        yield kind, data[5:size]
        data = data[size:]


class _Lines:
    def __init__(self, connection: socket.socket, deadline: float) -> None:
        self._socket, self.deadline, self._data = connection, deadline, b""

    def ask(self, text: str) -> str:
        self._socket.sendall(text.encode() + b"\n")
        return self.line()

    def line(self) -> str:
        while b"\n" not in self._data:
            left = self.deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self._socket.settimeout(left)
            data = self._socket.recv(1024)
            if not data or len(self._data) > 1 << 14:
                raise ConnectionError("it closed the connection" if not data else "endless line")
            self._data += data
        line, _, self._data = self._data.partition(b"\n")
        return line.decode("utf-8", "replace").strip()
