"""Reading a controller's real-time data (RTDE) packet by packet.

ur_rtde keeps only the newest packet, and skips what came in between whenever its thread was late;
measured on two busy cores, a tenth of 500 packets/s. A tracker must not lose poses, so they are
read here from the socket, where nothing is lost and a packet cannot tear. Commands go through
ur_rtde (:mod:`hw.robot.motion`).

What comes from the socket is untrusted: a message is at most 64 KiB by its format, and anything
that does not fit the recipe ends the connection.

Source: Universal Robots' RTDE guide, protocol version 2.
"""

from __future__ import annotations

import contextlib
import math
import re
import socket
import struct
import time
from collections.abc import Generator
from dataclasses import dataclass

from hw.errors import LostError, RefusedError

PORT, DASHBOARD_PORT = 30004, 29999

FIELDS: dict[str, tuple[str, str]] = {
    "timestamp": ("DOUBLE", "d"),
    "actual_TCP_pose": ("VECTOR6D", "6d"),
    "actual_TCP_speed": ("VECTOR6D", "6d"),
    "actual_TCP_force": ("VECTOR6D", "6d"),
    "robot_mode": ("INT32", "i"),
    "runtime_state": ("UINT32", "I"),
    "robot_status_bits": ("UINT32", "I"),
    "safety_status_bits": ("UINT32", "I"),
    "tcp_offset": ("VECTOR6D", "6d"),
}
"""What is asked for, with the type that must come back; older controllers lack tcp_offset."""

RUNNING_MODE = 7
NORMAL_BITS = 0b11
"""safety_status_bits of a robot that may move: normal, or reduced mode."""
_SAFETY_NAMES = (
    "normal", "reduced mode", "protective stop", "recovery mode", "safeguard stop",
    "system emergency stop", "robot emergency stop", "emergency stop", "safety violation",
    "safety fault", "stopped by safety",
)  # fmt: skip


def safety_text(bits: int) -> str:
    """What is wrong by safety_status_bits; an empty string when the robot may move."""
    wrong = bits & ~NORMAL_BITS
    names = [name for k, name in enumerate(_SAFETY_NAMES) if wrong >> k & 1]
    return ", ".join(names) or (f"safety bits {bits:#x}" if wrong else "")


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet of the controller, as it came."""

    monotonic_s: float
    """``time.monotonic()`` at its arrival."""
    timestamp_s: float
    tcp_pose: tuple[float, ...]
    """Tool centre point in the base frame: m and rotation vector (rad)."""
    tcp_speed: tuple[float, ...]
    """m/s and rad/s."""
    tcp_force: tuple[float, ...]
    """N and N m."""
    robot_mode: int
    runtime_state: int
    status_bits: int
    safety_bits: int
    tcp_offset: tuple[float, ...] | None
    """Tool centre point in the flange's frame (m, rad); None where the controller tells none."""


class PacketReader:
    """A connection to the controller's real-time data.

    Args:
        host: its address.
        frequency_hz: packets per second; by default what the controller can (500, or 125 on CB).
        timeout_s: wall seconds for the connection and each of its answers.

    Raises:
        LostError: no connection, or no answer in time.
        RefusedError: the controller does not have what is asked for.
    """

    def __init__(
        self, host: str, *, frequency_hz: float | None = None, timeout_s: float = 3.0
    ) -> None:
        self.host = host
        self._data = bytearray()
        try:
            self._socket = socket.create_connection((host, PORT), timeout=timeout_s)
        except OSError as error:
            raise LostError(f"no connection to {host}:{PORT}: {error}", device="robot") from error
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._negotiate(frequency_hz, time.monotonic() + timeout_s)
            self._socket.setblocking(False)
        except BaseException:
            self._socket.close()
            raise

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def read(self) -> list[Packet]:
        """Every packet that has come since the last call; does not wait.

        Raises:
            LostError: the controller closed the connection, or sent what is no RTDE data.
        """
        try:
            data = self._socket.recv(1 << 18)
        except (BlockingIOError, InterruptedError):
            data = None
        except OSError as error:
            raise LostError(f"the connection broke: {error}", device="robot") from error
        now = time.monotonic()
        if data:
            self._data += data
        packets = [self._packet(now, payload) for kind, payload in self._messages() if kind == b"U"]
        if data == b"" and not packets:
            raise LostError("the controller closed the connection", device="robot")
        return packets

    def _packet(self, now: float, payload: bytes) -> Packet:
        if len(payload) != 1 + self._struct.size:
            raise LostError(
                f"a packet of {len(payload)} bytes came instead of {1 + self._struct.size}",
                device="robot",
            )
        v = self._struct.unpack_from(payload, 1)
        if not all(map(math.isfinite, v)):
            raise LostError("a packet holds NaN or Inf", device="robot")
        return Packet(
            now, v[0], v[1:7], v[7:13], v[13:19], v[19], v[20], v[21], v[22], v[23:29] or None
        )

    def _messages(self) -> Generator[tuple[bytes, bytes]]:
        """Kind and payload of each complete message, which is then forgotten."""
        data = self._data
        start = 0
        try:
            while len(data) - start >= 3:
                (size,) = struct.unpack_from(">H", data, start)
                if size < 3:
                    raise LostError("what came is no RTDE data", device="robot")
                if len(data) - start < size:
                    break
                message = bytes(data[start + 2 : start + size])
                start += size
                yield message[:1], message[1:]
        finally:
            del data[:start]

    def _negotiate(self, frequency_hz: float | None, deadline: float) -> None:
        if self._ask(b"V", struct.pack(">H", 2), deadline)[:1] != b"\x01":
            raise RefusedError("the controller does not speak RTDE version 2", device="robot")
        answer = self._ask(b"v", b"", deadline)
        if len(answer) != 16:
            raise LostError("the controller did not tell its version", device="robot")
        self.version: tuple[int, ...] = struct.unpack(">4I", answer)
        self.frequency_hz = frequency_hz or (500.0 if self.version[0] >= 5 else 125.0)
        names = list(FIELDS)
        types = self._recipe(names, deadline)
        if types[-1] == "NOT_FOUND":
            names.remove("tcp_offset")
            types = self._recipe(names, deadline)
        wrong = [n for n, kind in zip(names, types, strict=False) if FIELDS[n][0] != kind]
        if wrong or len(types) != len(names):
            raise RefusedError(
                f"the controller has no {', '.join(wrong) or 'such recipe'}", device="robot"
            )
        self._struct = struct.Struct(">" + "".join(FIELDS[name][1] for name in names))
        if self._ask(b"S", b"", deadline)[:1] != b"\x01":
            raise RefusedError("the controller would not start sending", device="robot")

    def _recipe(self, names: list[str], deadline: float) -> list[str]:
        payload = struct.pack(">d", self.frequency_hz) + ",".join(names).encode()
        return self._ask(b"O", payload, deadline)[1:].decode("ascii", "replace").split(",")

    def _ask(self, kind: bytes, payload: bytes, deadline: float) -> bytes:
        try:
            self._socket.sendall(struct.pack(">H", 3 + len(payload)) + kind + payload)
            while True:
                with contextlib.closing(self._messages()) as messages:
                    for answer_kind, answer in messages:
                        if answer_kind == kind:
                            return answer
                left = deadline - time.monotonic()
                if left <= 0:
                    raise TimeoutError
                self._socket.settimeout(left)
                data = self._socket.recv(65536)
                if not data:
                    raise LostError("the controller closed the connection", device="robot")
                self._data += data
        except TimeoutError:
            raise LostError(f"{self.host} accepted but does not answer", device="robot") from None
        except OSError as error:
            raise LostError(f"the connection broke: {error}", device="robot") from error


@dataclass(frozen=True)
class Identity:
    """Which robot it is, by its dashboard."""

    serial: str
    """Serial number; a CB-series dashboard tells none, then ``<model>@<host>``."""
    version: str
    """Of PolyScope."""
    model: str


def read_identity(host: str, *, timeout_s: float = 3.0) -> Identity:
    """Ask the dashboard who the robot is.

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
    except TimeoutError:
        raise LostError(f"the dashboard of {host} does not answer", device="robot") from None
    except OSError as error:
        text = f"no connection to the dashboard of {host}: {error}"
        raise LostError(text, device="robot") from error
    number = re.search(r"\d+\.\d+\.\d+(\.\d+)?", version)
    if not re.fullmatch(r"[\w-]{1,40}", model):
        model = "unknown"
    if not re.fullmatch(r"\d{4,20}", serial):
        serial = f"{model}@{host}"
    return Identity(serial, number.group() if number else "unknown", model)


class _Lines:
    def __init__(self, connection: socket.socket, deadline: float) -> None:
        self._socket, self._deadline, self._data = connection, deadline, b""

    def ask(self, text: str) -> str:
        self._socket.sendall(text.encode() + b"\n")
        return self.line()

    def line(self) -> str:
        while b"\n" not in self._data:
            left = self._deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self._socket.settimeout(left)
            data = self._socket.recv(1024)
            if not data or len(self._data) > 1 << 14:
                raise ConnectionError("it closed the connection" if not data else "endless line")
            self._data += data
        line, _, self._data = self._data.partition(b"\n")
        return line.decode("utf-8", "replace").strip()
