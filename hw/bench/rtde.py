"""A Universal Robots controller on loopback that the real ur_rtde accepts.

Ports are fixed: 29999 dashboard, 30001 primary interface, 30003 scripts, 30004 real-time data
(RTDE); several robots need several loopback addresses. Run it in another process than its client,
because ur_rtde's constructors hold the interpreter's lock. ur_rtde is known to accept two versions:
5.11.0 (500 Hz) and 3.15.8 (125 Hz).

It reports what it does not emulate: a command of ur_rtde's script that is not emulated ends the
program, as an unknown function ends a script. The reason goes to the primary interface as a text
message, to the process's standard error, and into the ``state`` of :mod:`hw.bench.robot`
(``robot`` of a bench's control socket). The primary interface sends the arm's kinematic calibration
when a client connects (3.6 or newer), and these texts, but not the ten states a second of a real
controller. Only one client may write an input register (IN_USE); a recipe with an unknown variable
cannot be started; a packet of an unknown type ends the connection.

Source: the RTDE guide of Universal Robots, its articles on the client interfaces and the dashboard,
ur_client_library, and what ur_rtde 1.6.5 sends and expects.
"""

from __future__ import annotations

import contextlib
import math
import queue
import random
import selectors
import socket
import struct
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from hw.bench.arm import Arm
from hw.bench.controller import NORMAL, Controller, before_loop
from hw.bench.rtde_fields import INPUTS, OUTPUTS, STRUCT, output_type
from hw.robot.identity import (
    DASHBOARD_PORT,
    KINEMATICS,
    KINEMATICS_INFO,
    PRIMARY_PORT,
    ROBOT_STATE,
)
from hw.robot.kinematics import MODELS
from hw.robot.rtde import PORT, SCRIPT_PORT, nominal_hz
from hw.runtime.clock import REAL, Clock
from hw.runtime.processes import ANSWERS, be_prompt

E_SERIES, CB_SERIES = (5, 11, 0, 108249), (3, 15, 8, 106339)
"""Controller versions of the two series of robots."""
_MAX_WAITING = 1 << 16
"""Bytes that may wait for a client that does not read; further packets for it are dropped."""
_ROBOT_MESSAGE = 20
_CLOCK_AHEAD_S = 1000.0
"""The controller's time less bench time."""
_MEASURED = frozenset({"actual_TCP_pose", "actual_TCP_speed", "actual_q", "actual_qd"})
_LATE_S = 1.0
_HELD_S = 0.01
"""Bench time after which this process counts as held up by the machine."""
_MAX_INPUT = 1 << 20
"""Bytes that a client may send without completing a message or script."""


class _Connection:
    def __init__(self, sock: socket.socket, port: int) -> None:
        self.socket, self.port = sock, port
        self.received = bytearray()
        self.waiting = bytearray()
        self.outputs: list[tuple[str, int, str]] = []
        self.packet = bytearray()
        self.inputs: list[list[str]] = []
        self.complete = True
        """Whether every variable of the output recipe exists."""
        self.started = False
        self.asked_s = 0.0
        """When it was asked to start."""


class RtdeServer:
    """Serves one arm at one loopback address.

    Args:
        arm: what moves.
        host: 127.0.0.x.
        version: (major, minor, bugfix, build) of the controller.
        clock: bench time; the controller's own time is a thousand seconds ahead.
        max_rate_hz: packets per wall second, whatever the clock's speed asks for.
        serial: what the dashboard says; the arm's kinematic calibration is drawn from it.
    """

    def __init__(
        self,
        arm: Arm,
        host: str = "127.0.0.2",
        *,
        version: tuple[int, int, int, int] = E_SERIES,
        clock: Clock = REAL,
        max_rate_hz: float = 1000.0,
        serial: str = "20195500042",
    ) -> None:
        self.arm, self.host, self.version, self.clock = arm, host, version, clock
        self.serial = serial
        self.frequency_hz = min(nominal_hz(version[0]), max_rate_hz / clock.speed)
        self.controller = Controller(arm, told=self._say_why)
        self.asked: list[str] = []
        """Every line that the dashboard was sent."""
        self._dashboard_says: str | None = None
        self.packets = 0
        self.skipped = 0
        self.late = 0
        """Packets never made because this process was held up for more than a second."""
        self._selector = selectors.SelectSelector()
        self._connections: set[_Connection] = set()
        self._listeners: list[socket.socket] = []
        self._calls: queue.SimpleQueue[tuple[Callable[[], None], Future[None]]] = (
            queue.SimpleQueue()
        )
        self._wake, self._woken = socket.socketpair()
        self._muted = self._answers_lost = False
        self._frozen: dict[str, tuple[float, ...] | float | int] = {}
        self._stamps = _CLOCK_AHEAD_S, 1.0
        self._running = False
        self._thread: threading.Thread | None = None

    # Life

    def start(self) -> RtdeServer:
        """Listen and serve in a thread.

        Raises:
            OSError: an address is taken.
        """
        try:
            for port in (DASHBOARD_PORT, PRIMARY_PORT, SCRIPT_PORT, PORT):
                listener = socket.create_server((self.host, port))
                listener.setblocking(False)
                self._listeners.append(listener)
                self._selector.register(listener, selectors.EVENT_READ, port)
        except OSError:
            self._close()
            raise
        self._woken.setblocking(False)
        self._selector.register(self._woken, selectors.EVENT_READ, None)
        self._running = True
        self._thread = threading.Thread(target=self._serve, name=f"rtde {self.host}", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Close every connection and end the thread."""
        if self._thread is None:
            return
        self._running = False
        # The thread may have ended already.
        with contextlib.suppress(OSError):
            self._wake.send(b"x")
        self._thread.join()
        self._thread = None

    def __enter__(self) -> RtdeServer:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    # Faults

    def act(self, name: str, *values: Any) -> float:
        """Do something to the robot or its controller, as a person at the pendant or a fault does.

        - ``mute``: neither read nor write; connections stay, and new ones are accepted but not
          answered; ``unmute``;
        - ``mute control`` (on): no packets any more to those that command; they are read as before;
        - ``drop``: reset all clients' connections; ``drop control``: only those that command;
        - ``protective_stop``: as if the arm had met an obstacle; ``unlock``;
        - ``robot_state`` (robot_mode, safety_mode): :meth:`hw.bench.controller.Controller.enter`;
        - ``bits`` (robot, safety): further robot_status_bits (4: the freedrive button is pressed)
          and safety_status_bits (2048: the input of an enabling device is active);
        - ``force`` (N and N m): on the tool;
        - ``remote`` (on): remote or local control of an e-Series;
        - ``play``: our program ends, and soon another one runs;
        - ``pause`` (on): our program is paused, or goes on; ``pause before`` (code): it is paused
          when it would take this command next;
        - ``tcp_offset`` (m, rad), ``payload`` (kg and, or not, its centre of gravity, m),
          ``speed_slider`` (0 to 1): other settings at the pendant;
        - ``overspeed`` (factor): motions from now on are so many times as fast as commanded;
        - ``heed stops`` (on): whether a command to stop the arm has any effect;
        - ``freeze`` (on): pose, speed and joints stay what they were, in packets with new stamps;
        - ``stamps`` (s, rate): its time stamps are ahead of bench time by so much, and go so fast;
        - ``dashboard`` (text): it answers with this text, with "" not at all, with None as usual.

        Returns:
            Bench time (s) at which it was done.

        Raises:
            ValueError: nothing that can be done.
        """
        self._call(lambda: self._act(name, *values))
        return self.clock.now()

    def _act(self, *wanted: Any) -> None:
        program, t = self.controller, self.clock.now()
        match wanted:
            case ["mute" | "unmute" as name]:
                self._mute(name == "mute")
            case ["mute control", on]:
                self._answers_lost = bool(on)
            case ["drop"]:
                self._drop(self._connections)
            case ["drop control"]:
                self._drop({connection for connection in self._connections if connection.inputs})
            case ["protective_stop"]:
                program.protect(t)
            case ["unlock"]:
                program.safety_mode = NORMAL
            case ["robot_state", robot_mode, safety_mode]:
                program.enter(t, robot_mode, safety_mode)
            case ["bits", robot, safety]:
                program.further_bits = int(robot), int(safety)
            case ["force", force]:
                self.arm.force = tuple(force)
            case ["remote", on]:
                program.remote = bool(on)
            case ["play"]:
                program.play(t)
            case ["pause", on]:
                program.pause(t, bool(on))
            case ["pause before", code]:
                program.pauses_before = code
            case ["tcp_offset", offset]:
                self.arm.set_tcp_offset(offset)
            case ["payload", mass_kg, *cog_m]:
                program.payload_kg = float(mass_kg)
                program.payload_cog_m = tuple(cog_m[0]) if cog_m else (0.0, 0.0, 0.0)
            case ["speed_slider", fraction]:
                program.speed_fraction = float(fraction)
            case ["overspeed", factor]:
                program.overspeed = float(factor)
            case ["heed stops", on]:
                program.heeds_stops = bool(on)
            case ["freeze", on]:
                now = self._values(t)
                self._frozen = {name: now[name] for name in _MEASURED & now.keys()} if on else {}
            case ["stamps", ahead_s, rate]:
                self._stamps = float(ahead_s), float(rate)
            case ["dashboard", answer]:
                self._dashboard_says = answer
            case _:
                raise ValueError(f"unknown request {wanted}")

    def _mute(self, on: bool) -> None:
        self._muted = on
        for connection in self._connections:
            known = connection.socket in self._selector.get_map()
            if on and known:
                # Unread data would wake the loop again and again.
                self._selector.unregister(connection.socket)
            elif not on and not known:
                self._selector.register(connection.socket, selectors.EVENT_READ, connection)

    def _drop(self, connections: set[_Connection]) -> None:
        for connection in list(connections):
            linger = struct.pack("ii", 1, 0)
            connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            self._forget(connection)

    def _call(self, act: Callable[[], None]) -> None:
        """Have the serving thread do something; returns when it is done."""
        if self._thread is None or threading.current_thread() is self._thread:
            act()
            return
        done: Future[None] = Future()
        self._calls.put((act, done))
        self._wake.send(b"x")
        done.result(5.0)

    # The loop

    def _serve(self) -> None:
        # A controller is never late, so other threads here must release the lock soon.
        be_prompt(ANSWERS)
        sys.setswitchinterval(min(sys.getswitchinterval(), 0.0005))
        period = 1.0 / self.frequency_hz
        due = self.clock.now()
        try:
            while self._running:
                wait = self.clock.wall(max(0.0, due - self.clock.now()))
                ready = self._selector.select(wait)
                woken = self.clock.now()
                for key, _ in ready:
                    self._ready(key.fileobj, key.data)
                while not self._calls.empty():
                    act, done = self._calls.get()
                    try:
                        done.set_result(act())
                    except Exception as error:
                        done.set_exception(error)
                now = self.clock.now()
                if now - min(woken, due) > _HELD_S:
                    # A real controller is never held up, neither as it wakes nor as it works: what
                    # came meanwhile came in time.
                    for key, _ in self._selector.select(0.0):
                        self._ready(key.fileobj, key.data)
                # Muted or not, the program goes on.
                self.controller.step(now)
                if not self._muted:
                    self._flush()
                while now >= due:
                    if not self._muted:
                        self._publish(due)
                    due += period
                    if now - due > _LATE_S:
                        self.late += math.ceil((now - due) / period)
                        due = now
        finally:
            self._close()

    def _ready(self, source: object, data: int | _Connection | None) -> None:
        if data is None:
            self._woken.recv(4096)
        elif isinstance(data, int):
            assert isinstance(source, socket.socket)
            try:
                sock, _ = source.accept()
            except OSError:
                return
            sock.setblocking(False)
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection = _Connection(sock, data)
            self._connections.add(connection)
            if not self._muted:
                self._selector.register(sock, selectors.EVENT_READ, connection)
            if data == DASHBOARD_PORT:
                connection.waiting += b"Connected: Universal Robots Dashboard Server\n"
            elif data == PRIMARY_PORT and self.version[:2] >= (3, 6):
                connection.waiting += self._kinematics()
        else:
            self._read(data)

    def _read(self, connection: _Connection) -> None:
        try:
            data = connection.socket.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._forget(connection)
            return
        connection.received += data
        if len(connection.received) > _MAX_INPUT:
            self._forget(connection)
            return
        if connection.port == PORT:
            self._messages(connection)
        elif connection.port == SCRIPT_PORT:
            self._script(connection)
        elif connection.port == PRIMARY_PORT:
            # A real controller would run scripts sent here; this one closes the connection.
            self._forget(connection)
        else:
            self._dashboard(connection)

    def _flush(self) -> None:
        for connection in list(self._connections):
            if connection.waiting:
                self._send(connection, b"")

    def _send(self, connection: _Connection, data: bytes | bytearray) -> None:
        connection.waiting += data
        try:
            sent = connection.socket.send(connection.waiting)
            del connection.waiting[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._forget(connection)

    def _forget(self, connection: _Connection) -> None:
        if connection in self._connections:
            self._connections.discard(connection)
            if connection.socket in self._selector.get_map():
                self._selector.unregister(connection.socket)
            connection.socket.close()

    def _close(self) -> None:
        for connection in list(self._connections):
            self._forget(connection)
        for listener in self._listeners:
            listener.close()
        self._selector.close()
        self._wake.close()
        self._woken.close()

    # RTDE

    def _publish(self, t: float) -> None:
        self.packets += 1
        listeners = [
            c for c in self._connections if c.started and not (self._answers_lost and c.inputs)
        ]
        if not listeners:
            return
        values = self._values(t)
        for connection in listeners:
            if len(connection.waiting) > _MAX_WAITING:
                self.skipped += 1
                continue
            if t < connection.asked_s - 1.0 / self.frequency_hz:
                # Only this process, held up, makes packets of the past.
                continue
            for name, offset, code in connection.outputs:
                value = values[name]
                if isinstance(value, tuple):
                    struct.pack_into(code, connection.packet, offset, *value)
                else:
                    struct.pack_into(code, connection.packet, offset, value)
            self._send(connection, connection.packet)

    def _values(self, t: float) -> dict[str, tuple[float, ...] | float | int]:
        """The variables that change; all others stay zero."""
        program, arm = self.controller, self.arm
        raw, velocity = arm.raw(t), arm.velocity(t)
        ahead_s, rate = self._stamps
        values: dict[str, tuple[float, ...] | float | int] = {
            "timestamp": ahead_s + rate * t,
            "actual_TCP_pose": raw,
            "target_TCP_pose": raw,
            "actual_TCP_speed": velocity,
            "target_TCP_speed": velocity,
            "actual_TCP_force": arm.force,
            "tcp_offset": arm.tcp_offset,
            "robot_mode": program.robot_mode,
            "safety_mode": program.safety_mode,
            "runtime_state": program.runtime_state,
            "robot_status_bits": program.robot_status_bits,
            "safety_status_bits": program.safety_status_bits,
            "speed_scaling": program.speed_fraction,
            "target_speed_fraction": program.speed_fraction,
            "payload": program.payload_kg,
            "payload_cog": program.payload_cog_m,
        }
        joints, speeds = arm.joints(t), arm.joint_speeds(t)
        if joints is not None and speeds is not None:
            values |= {"actual_q": joints, "target_q": joints}
            values |= {"actual_qd": speeds, "target_qd": speeds}
        for k in range(3):
            values[f"output_int_register_{k}"] = program.int_out[k]
        for k in range(6):
            values[f"output_double_register_{k}"] = program.double_out[k]
        return values | self._frozen

    def _messages(self, connection: _Connection) -> None:
        data = connection.received
        while len(data) >= 3 and connection in self._connections:
            size, kind = struct.unpack_from(">HB", data)
            if size < 3:
                self._forget(connection)
                return
            if len(data) < size:
                return
            payload = bytes(data[3:size])
            del data[:size]
            try:
                answer = self._answer(connection, kind, payload)
            except (struct.error, IndexError, UnicodeDecodeError):
                self._forget(connection)
                return
            if answer is not None:
                self._send(connection, struct.pack(">HB", 3 + len(answer), kind) + answer)

    def _answer(self, connection: _Connection, kind: int, payload: bytes) -> bytes | None:
        match chr(kind):
            case "V":
                return b"\x01" if struct.unpack(">H", payload)[0] == 2 else b"\x00"
            case "v":
                return struct.pack(">4I", *self.version)
            case "O":
                return self._set_outputs(connection, payload)
            case "I":
                return self._set_inputs(connection, payload)
            case "S" | "P":
                connection.started = chr(kind) == "S" and connection.complete
                connection.asked_s = self.clock.now()
                return bytes([connection.complete or chr(kind) == "P"])
            case "U":
                self._take(connection, payload)
                return None
            case _:
                self._forget(connection)
                return None

    def _set_inputs(self, connection: _Connection, payload: bytes) -> bytes:
        names = _names(payload)
        taken = {
            name
            for other in self._connections
            if other is not connection
            for recipe in other.inputs
            for name in recipe
        }
        types = ["IN_USE" if name in taken else INPUTS.get(name, "NOT_FOUND") for name in names]
        if "IN_USE" in types or "NOT_FOUND" in types:
            return b"\x00" + ",".join(types).encode()
        connection.inputs.append(names)
        return bytes([len(connection.inputs)]) + ",".join(types).encode()

    def _set_outputs(self, connection: _Connection, payload: bytes) -> bytes:
        names = _names(payload[8:])
        types = [output_type(name, self.version) for name in names]
        connection.complete = "NOT_FOUND" not in types
        connection.started = connection.started and connection.complete
        if connection.complete:
            codes = [">" + STRUCT[kind] for kind in types]
            offsets = [4]
            for code in codes:
                offsets.append(offsets[-1] + struct.calcsize(code))
            connection.packet = bytearray(offsets[-1])
            struct.pack_into(">HBB", connection.packet, 0, offsets[-1], ord("U"), 1)
            changing = self._values(self.clock.now())
            connection.outputs = [
                (name, offset, code)
                for name, offset, code in zip(names, offsets, codes, strict=False)
                if name in changing and name in OUTPUTS
            ]
        return b"\x01" + ",".join(types).encode()

    def _take(self, connection: _Connection, payload: bytes) -> None:
        if not 1 <= payload[0] <= len(connection.inputs):
            # A recipe that was refused, or never set.
            self._forget(connection)
            return
        names = connection.inputs[payload[0] - 1]
        offset = 1
        program = self.controller
        now = self.clock.now()
        for name in names:
            code = ">" + STRUCT[INPUTS[name]]
            value = struct.unpack_from(code, payload, offset)
            offset += struct.calcsize(code)
            kind, _, number = name.rpartition("_")
            if kind == "input_int_register":
                program.int_in[int(number)] = value[0]
            elif kind == "input_double_register":
                program.double_in[int(number)] = value[0]
        if "input_int_register_0" in names:
            program.kick(now)
        program.step(now)

    # Primary interface

    def _kinematics(self) -> bytes:
        """A state message with the arm's kinematic calibration: nominal numbers, a little off."""
        model = MODELS["UR5e" if self.version[0] >= 5 else "UR5"]
        rng = random.Random(self.serial)
        checksums = [rng.getrandbits(32) for _ in range(6)]
        # The factory finds some tenths of a mm and of a mrad.
        theta, alpha = ([rng.gauss(0.0, 3e-4) for _ in range(6)] for _ in range(2))
        alpha = [a + b for a, b in zip(alpha, (1.5708, 0, 0, 1.5708, -1.5708, 0), strict=True)]
        a = [value / 1000.0 + rng.gauss(0.0, 3e-4) for value in model.a]
        d = [value / 1000.0 + rng.gauss(0.0, 3e-4) for value in model.d]
        body = KINEMATICS.pack(*checksums, *theta, *a, *d, *alpha, 0)
        part = struct.pack(">IB", 5 + len(body), KINEMATICS_INFO) + body
        return struct.pack(">IB", 5 + len(part), ROBOT_STATE) + part

    def _say_why(self, reason: str, fault: bool) -> None:
        """A text message to the primary interface's clients, and a line for who runs this."""
        if fault:
            print(f"emulated controller {self.host}: program stopped: {reason}", file=sys.stderr)
        # Robot message: time, source (-2: the controller), type 0 (text).
        stamp = int(1e6 * self.clock.now())
        body = struct.pack(">QbB", max(stamp, 0), -2, 0) + f"program stopped: {reason}".encode()
        message = struct.pack(">IB", 5 + len(body), _ROBOT_MESSAGE) + body
        for connection in list(self._connections):
            if connection.port == PRIMARY_PORT and len(connection.waiting) < _MAX_WAITING:
                connection.waiting += message

    # Scripts and dashboard

    def _script(self, connection: _Connection) -> None:
        text = connection.received.decode("utf-8", "replace")
        if text.lstrip().startswith("def rtde_control") and text.rstrip().endswith("end"):
            first = before_loop(text)
            if first is not None:
                self.controller.upload(self.clock.now(), first)
                connection.received.clear()

    def _dashboard(self, connection: _Connection) -> None:
        data = connection.received
        while (end := data.find(b"\n")) >= 0 and connection in self._connections:
            line = bytes(data[:end]).decode("ascii", "replace").strip()
            del data[: end + 1]
            self.asked.append(line)
            if self._dashboard_says is not None:
                if self._dashboard_says:
                    self._send(connection, (self._dashboard_says + "\n").encode())
                continue
            if line.lower() == "quit":
                self._send(connection, b"Disconnected\n")
                self._forget(connection)
                return
            self._send(connection, (self._say(line) + "\n").encode())

    def _say(self, line: str) -> str:
        program = self.controller
        match line.lower():
            case "polyscopeversion":
                return f"URSoftware {'.'.join(map(str, self.version))} (Jan 01 2022)"
            case "get serial number" if self._since((3, 12), (5, 6)):
                return self.serial
            case "get robot model" if self._since((3, 12), (5, 6)):
                # The dashboard's names have no "e": the software's version tells the series.
                model = self.arm.model
                return "UR5" if model is None else model.name.removesuffix("e")
            case "is in remote control" if self._since(None, (5, 6)):
                return "true" if program.remote else "false"
            case "stop":
                program.halt(self.clock.now(), "the dashboard stopped it")
                return "Stopped"
            case _:
                return f"could not understand: '{line}'"

    def _since(self, cb: tuple[int, int] | None, e: tuple[int, int]) -> bool:
        """Whether this version is at least ``e`` on e-Series, else ``cb`` (None: never)."""
        least = e if self.version[0] >= 5 else cb
        return least is not None and self.version[:2] >= least


def _names(text: bytes) -> list[str]:
    """A recipe's names; ur_rtde ends its lists with a comma."""
    return text.decode("ascii").rstrip(",").split(",")
