"""Reading a controller's real-time data (RTDE) packet by packet.

ur_rtde keeps only the newest packet, and skips packets whenever its thread is late: on two busy
cores it skipped a tenth of 500 packets/s. A tracker must not lose poses, so they are read here
from the socket, where no packet is lost or mixed with another. Commands go through ur_rtde
(:mod:`hw.robot.mover.controller`).

Data from the socket are untrusted: a message is at most 64 KiB by its format, and anything that
does not fit the recipe ends the connection.

Source: Universal Robots' RTDE guide, protocol version 2.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Any

from hw.runtime.clock import monotonic_s
from hw.runtime.errors import LostError, refused

PORT, SCRIPT_PORT = 30004, 30003
"""Of a controller: real-time data, and programs that it runs at once."""

FIELDS: dict[str, tuple[str, str]] = {
    "timestamp": ("DOUBLE", "d"),
    "actual_TCP_pose": ("VECTOR6D", "6d"),
    "actual_TCP_speed": ("VECTOR6D", "6d"),
    "actual_TCP_force": ("VECTOR6D", "6d"),
    "robot_mode": ("INT32", "i"),
    "runtime_state": ("UINT32", "I"),
    "robot_status_bits": ("UINT32", "I"),
    "safety_status_bits": ("UINT32", "I"),
    "target_speed_fraction": ("DOUBLE", "d"),
    "tcp_offset": ("VECTOR6D", "6d"),
    "payload": ("DOUBLE", "d"),
    "payload_cog": ("VECTOR3D", "3d"),
    "actual_q": ("VECTOR6D", "6d"),
}
"""The variables that are asked for, with the type that the controller must answer."""

_OPTIONAL = ("tcp_offset", "payload", "payload_cog", "actual_q")
"""Older controllers may lack these, but all known controllers send the joints, actual_q."""

RUNNING_MODE = 7
PROGRAM_RUNS = 0b10
"""Bit of robot_status_bits."""
FREEDRIVE_PRESSED = 0b100
"""The same, of the button at the pendant by which a person takes the arm in hand."""
NORMAL_BITS = 0b11
"""safety_status_bits of a robot that may move: normal, or reduced mode."""
_INPUT_BITS = 1 << 11
"""Bits of an input, the enabling device's ("3PE", PolyScope 5.25 or newer): where it stops the arm,
the bits above normal and reduced tell so, too."""
_POWER = "switch the robot on and release its brakes at the pendant"
_SAFETY_STATES = (
    (2, "protective stop", "find its cause, then release it at the pendant"),
    (3, "recovery mode", "move the joints back into their limits at the pendant"),
    (4, "safeguard stop", "close the gate (or what else stops it), then reset it"),
    (5, "system emergency stop", f"release it where it was pressed, then {_POWER}"),
    (6, "robot emergency stop", f"release the button, then {_POWER}"),
    (7, "emergency stop", f"release it, then {_POWER}"),
    (8, "safety violation", "read the pendant's log, then restart the robot's safety there"),
    (9, "safety fault", "read the pendant's log, then restart the controller"),
    (10, "stopped by safety", "check the pendant"),
)
"""Bits of safety_status_bits above normal and reduced, and what a person must do."""
_SUMMARIES = (1 << 7) | (1 << 10)
"""Bits that are set besides the one that says more."""
_MODES = {
    -1: ("no controller", "check the pendant"),
    0: ("disconnected", "check the pendant"),
    1: ("waiting for its safety configuration", "confirm it at the pendant"),
    2: ("booting", "wait until it has started"),
    3: ("powered off", _POWER),
    4: ("powered on with its brakes on", "release its brakes at the pendant"),
    5: ("idle with its brakes on", "release its brakes at the pendant"),
    6: ("in backdrive", "leave backdrive at the pendant"),
    8: ("updating its firmware", "wait until it is done"),
}
"""Values of robot_mode other than running, and what a person must do."""
_PAUSED = frozenset({3, 4})
_PLAYS = _PAUSED | {2, 5}
"""Values of runtime_state while a program pauses or is paused; and plays or resumes."""


def safety_text(bits: int) -> str:
    """Which safety stop by safety_status_bits, and what a person must do; empty if none is."""
    wrong = bits & ~(NORMAL_BITS | _INPUT_BITS)
    shown = wrong & ~_SUMMARIES or wrong
    found = [state for state in _SAFETY_STATES if shown >> state[0] & 1]
    if not found:
        return f"safety bits {bits:#x}: check the pendant" if wrong else ""
    return f"{', '.join(name for _, name, _ in found)}: {found[-1][2]}"


def state_text(robot_mode: int, safety_bits: int) -> str:
    """Why the robot may not move, and what a person must do; an empty string when it may."""
    problem = safety_text(safety_bits)
    if not problem and robot_mode == RUNNING_MODE and not safety_bits & NORMAL_BITS:
        problem = "the robot reports no safety state: check the pendant"
    if problem or robot_mode == RUNNING_MODE:
        return problem
    name, cure = _MODES.get(robot_mode, (f"in mode {robot_mode}", "check the pendant"))
    return f"the robot is not running, it is {name}: {cure}"


_BOUND_TRIES, _LEAST_TRIES, _BOUND_S, _BOUND_WITHIN_S = 5, 3, 0.01, 0.25
"""Most tries to bound the latency; fewest tries, unless a bound is tight; a bound is tight below
this plus three periods (s); beyond the fewest, no try begins after this time (wall s)."""
_FURTHEST = 100.0
"""No TCP is further from its base (m), or turned by more (rad)."""
_PAYLOAD_TOLERANCE_KG, _COG_TOLERANCE_M, _SPEED_TOLERANCE = 1e-3, 1e-4, 1e-3


@dataclass(frozen=True, slots=True)
class PendantSettings:
    """Settings at the pendant, besides the TCP offset, on which motion depends.

    Attributes:
        payload_kg: mass that the arm carries; None where the controller does not send it.
        payload_cog_m: (3,) its centre of gravity in the flange's frame; None where not sent.
        speed_fraction: position of the speed slider, 0 to 1.
    """

    payload_kg: float | None = 0.0
    payload_cog_m: tuple[float, ...] | None = (0.0, 0.0, 0.0)
    speed_fraction: float = 1.0

    def changed(self, now: PendantSettings) -> str:
        """Which settings differ now by more than rounding, as one line; empty if none does."""
        found = []
        if _apart([self.payload_kg], [now.payload_kg], _PAYLOAD_TOLERANCE_KG):
            found.append(f"the payload is {now.payload_kg} kg, not {self.payload_kg}")
        if _apart(self.payload_cog_m, now.payload_cog_m, _COG_TOLERANCE_M):
            found.append(
                f"the payload's centre of gravity is {now.payload_cog_m} m, "
                f"not {self.payload_cog_m}"
            )
        if _apart([self.speed_fraction], [now.speed_fraction], _SPEED_TOLERANCE):
            found.append(
                f"the speed slider is at {100 * now.speed_fraction:.0f} %, "
                f"not {100 * self.speed_fraction:.0f}"
            )
        return "; ".join(found)

    def __str__(self) -> str:
        if self.payload_kg is None:
            payload = "payload not reported"
        else:
            cog = self.payload_cog_m
            at = "an unknown place" if cog is None else f"{listed(cog)} m"
            payload = f"payload {self.payload_kg:g} kg at {at}"
        return f"{payload}, speed slider at {100 * self.speed_fraction:.0f} %"


def _apart(
    first: Sequence[float | None] | None, second: Sequence[float | None] | None, tolerance: float
) -> bool:
    a, b = list(first or [None]), list(second or [None])
    if len(a) != len(b):
        return True
    return any(
        (x is None) != (y is None)
        or (x is not None and y is not None and not abs(x - y) <= tolerance)
        for x, y in zip(a, b, strict=True)
    )


def listed(values: Sequence[float]) -> str:
    """Numbers as a person reads them, e.g. ``[0, 0, 0.12]``."""
    return f"[{', '.join(f'{v:g}' for v in values)}]"


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet of the controller, as it came."""

    monotonic_s: float
    """Reading of :func:`hw.runtime.clock.monotonic_s` at its arrival."""
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
    pendant: PendantSettings
    joints: tuple[float, ...] | None = None
    """Angles of the joints, rad."""

    @property
    def speed_mm_s(self) -> float:
        """Of the TCP."""
        return 1000.0 * math.hypot(*self.tcp_speed[:3])

    @property
    def turning_rad_s(self) -> float:
        """Of the TCP."""
        return math.hypot(*self.tcp_speed[3:])

    @property
    def force_n(self) -> float:
        """At the TCP."""
        return math.hypot(*self.tcp_force[:3])

    @property
    def program(self) -> bool:
        """Whether a program plays or is paused."""
        return bool(self.status_bits & PROGRAM_RUNS) or self.runtime_state in _PLAYS

    @property
    def paused(self) -> bool:
        """Whether a program is paused: it takes no commands, and goes on when it is resumed."""
        return self.runtime_state in _PAUSED


def check_latency(latency_s: float, limit_s: float) -> None:
    """Refuse a latency that makes all poses look older than the limit.

    Args:
        latency_s: :attr:`PacketReader.latency_s`, bench s.
        limit_s: largest age of a pose, bench s.

    Raises:
        LostError: it does.
    """
    if not latency_s <= limit_s:
        raise LostError(
            f"the poses may be on their way for {latency_s * 1000:.0f} ms, over the limit of "
            f"{limit_s * 1000:.0f} ms: use a more direct connection (a cable, no tunnel), or "
            "reduce the load of this computer",
            device="robot",
        )


class PacketReader:
    """A connection to the controller's real-time data.

    Args:
        host: its address.
        frequency_hz: packets per second; by default the controller's own (500, or 125 on CB).
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
        self._kept: list[bytes] = []
        """The packet that came while connecting."""
        try:
            self._socket = socket.create_connection((host, PORT), timeout=timeout_s)
        except (OSError, UnicodeError) as error:
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
            LostError: the controller closed the connection, or sent something other than RTDE.
        """
        try:
            data = self._socket.recv(1 << 18)
        except (BlockingIOError, InterruptedError):
            data = None
        except OSError as error:
            raise LostError(f"the connection broke: {error}", device="robot") from error
        now = monotonic_s()
        if data:
            self._data += data
        payloads, self._kept = self._kept, []
        payloads += [payload for kind, payload in self._messages() if kind == b"U"]
        packets = [self._packet(now, payload) for payload in payloads]
        if data == b"" and not packets:
            raise LostError("the controller closed the connection", device="robot")
        return packets

    def _packet(self, now: float, payload: bytes) -> Packet:
        if len(payload) != 1 + self._struct.size:
            raise LostError(
                f"a packet of {len(payload)} bytes came instead of {1 + self._struct.size}",
                device="robot",
            )
        values = self._struct.unpack_from(payload, 1)
        if not all(map(math.isfinite, values)):
            raise LostError("a packet holds NaN or Inf", device="robot")
        told: dict[str, Any] = {name: values[place] for name, place in self._places.items()}
        if max(map(abs, told["actual_TCP_pose"])) > _FURTHEST:
            # It would overflow to NaN, which is in no box and out of none.
            raise LostError("a packet holds an impossible pose", device="robot")
        pendant = PendantSettings(
            told.get("payload"), told.get("payload_cog"), told["target_speed_fraction"]
        )
        return Packet(
            now,
            told["timestamp"],
            told["actual_TCP_pose"],
            told["actual_TCP_speed"],
            told["actual_TCP_force"],
            told["robot_mode"],
            told["runtime_state"],
            told["robot_status_bits"],
            told["safety_status_bits"],
            told.get("tcp_offset"),
            pendant,
            told.get("actual_q"),
        )

    def _messages(self) -> Generator[tuple[bytes, bytes]]:
        """Kind and payload of each complete message, which is then removed from the buffer."""
        data = self._data
        start = 0
        try:
            while len(data) - start >= 3:
                (size,) = struct.unpack_from(">H", data, start)
                if size < 3:
                    raise LostError("what was received is not RTDE data", device="robot")
                if len(data) - start < size:
                    break
                message = bytes(data[start + 2 : start + size])
                start += size
                yield message[:1], message[1:]
        finally:
            del data[:start]

    def _negotiate(self, frequency_hz: float | None, deadline: float) -> None:
        if self._ask(b"V", struct.pack(">H", 2), deadline)[:1] != b"\x01":
            raise refused("the controller does not speak RTDE version 2")
        answer = self._ask(b"v", b"", deadline)
        if len(answer) != 16:
            raise LostError("the controller did not report its version", device="robot")
        self.version: tuple[int, ...] = struct.unpack(">4I", answer)
        self.frequency_hz = frequency_hz or nominal_hz(self.version[0])
        names = list(FIELDS)
        types = self._recipe(names, deadline)
        lacking = [
            name
            for name, kind in zip(names, types, strict=False)
            if kind == "NOT_FOUND" and name in _OPTIONAL
        ]
        if lacking:
            names = [name for name in names if name not in lacking]
            types = self._recipe(names, deadline)
        wrong = [n for n, kind in zip(names, types, strict=False) if FIELDS[n][0] != kind]
        if wrong or len(types) != len(names):
            raise refused(f"the controller has no {', '.join(wrong) or 'such recipe'}")
        self._struct = struct.Struct(">" + "".join(FIELDS[name][1] for name in names))
        self._places: dict[str, int | slice] = {}
        start = 0
        for name in names:
            end = start + int(FIELDS[name][1][:-1] or 1)
            self._places[name] = start if end == start + 1 else slice(start, end)
            start = end
        self.bound, self.latency_s = self._begin(deadline)
        """``bound``: a reading of ``monotonic_s()`` and a time of the controller (s): the packet
        with this time stamp was not made before that moment. ``latency_s``: an upper bound of how
        long the fastest packet was on its way (wall s). See :meth:`_begin`."""

    def _begin(self, deadline: float) -> tuple[tuple[float, float], float]:
        """Start the stream several times, and bound how long a packet is on its way.

        The controller makes the first packet after the request to start was sent. As it stamps a
        packet at the start of its cycle, the stamp may be up to one period older than the request,
        but not more, whatever the latency. So each try bounds the offset of the two clocks, host
        minus controller: from below by the moment of the request minus one period, from above by
        the packet's arrival. A busy machine makes these bounds loose, so the tightest of several
        tries are taken: one slow try (the machine was held up while connecting) must not make
        every pose of this connection look old.

        Returns:
            The attributes ``bound`` and ``latency_s``.
        """
        period = 1.0 / self.frequency_hz
        bounds: list[tuple[float, float]] = []
        best, latency, above = (math.inf, 0.0), 0.0, math.inf
        give_up = time.monotonic() + _BOUND_WITHIN_S
        for attempt in range(_BOUND_TRIES):
            if attempt >= _LEAST_TRIES and time.monotonic() > give_up:
                break
            if attempt:
                # Packets sent before the answer to this request to pause are read and dropped.
                self._ask(b"P", b"", deadline)
                self._kept.clear()
            asked = monotonic_s()
            if self._ask(b"S", b"", deadline)[:1] != b"\x01":
                raise refused("the controller would not start sending")
            try:
                self._kept = [self._wait_for(b"U", deadline)]
            except TimeoutError:
                # The controller accepts but sends nothing: whoever reads will notice.
                break
            packet = self._packet(monotonic_s(), self._kept[0])
            stamp = packet.timestamp_s
            above = min(above, packet.monotonic_s - stamp)
            bounds.append((asked - period, stamp))
            best = max(bounds, key=lambda pair: pair[0] - pair[1])
            latency = max(above - (best[0] - best[1]), 0.0)
            if latency < _BOUND_S + 3 * period:
                break
        return best, latency

    def _recipe(self, names: list[str], deadline: float) -> list[str]:
        payload = struct.pack(">d", self.frequency_hz) + ",".join(names).encode()
        return self._ask(b"O", payload, deadline)[1:].decode("ascii", "replace").split(",")

    def _ask(self, kind: bytes, payload: bytes, deadline: float) -> bytes:
        try:
            self._socket.sendall(struct.pack(">H", 3 + len(payload)) + kind + payload)
            return self._wait_for(kind, deadline)
        except TimeoutError:
            raise LostError(f"{self.host} accepted but does not answer", device="robot") from None
        except OSError as error:
            raise LostError(f"the connection broke: {error}", device="robot") from error

    def _wait_for(self, kind: bytes, deadline: float) -> bytes:
        """Payload of the next message of a kind; those before it are dropped.

        Raises:
            TimeoutError: it did not come in time.
            LostError: the connection is gone.
        """
        while True:
            with contextlib.closing(self._messages()) as messages:
                for came, payload in messages:
                    if came == kind:
                        return payload
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self._socket.settimeout(left)
            try:
                data = self._socket.recv(65536)
            except TimeoutError:
                raise
            except OSError as error:
                raise LostError(f"the connection broke: {error}", device="robot") from error
            if not data:
                raise LostError("the controller closed the connection", device="robot")
            self._data += data


def nominal_hz(major: int) -> float:
    """Packets a second of a controller, by the first number of its version: e-Series has 5."""
    return 500.0 if major >= 5 else 125.0
