"""The process that moves the robot, for :class:`hw.robot.motion.Motion`.

It holds the only control connection and the gate. One loop reads the poses, checks for trouble,
kicks the controller's watchdog and reads requests, one JSON object a line, from its standard input.
The loop never waits for a motion: motions are asynchronous, so that every pose is checked while
the robot moves. When the input ends (the caller is gone), the robot is stopped.

A stop cannot be lost. Each line of input is handled as soon as it is read, whatever the loop is
doing: a request to stop is latched at once (:attr:`Mover._stop`), a request to move waits in a
queue. Only a hesitation whose move was already answered is ignored; any other hesitation also
cancels the moves that wait. The states (:class:`State`) and what leads from one to another:

    REST -> SENDING      a request to move was taken from the queue
    SENDING -> REST      the gate or the controller refused it
    SENDING -> MOVING    moveL was taken by the controller
    MOVING -> REST       arrived: at the target, steady, and no stop latched
    any -> STOPPING      a stop is latched; stopL is sent again and again until the robot rests
    STOPPING -> REST     the stop was a hesitation (StaleError): the move may be asked for again
    STOPPING -> the end  any other stop: this process ends, and with it the confirmation

The last line of the table is what "latched until a new confirmation" means: after such a stop this
process never moves the robot again. While a motion is being sent, the latch is checked after the
controller's safety limits were asked, right before moveL and right after it. A stop that comes
while ur_rtde waits for the controller therefore acts at the next of these checks.

How ur_rtde behaves, and what is done about it (each measured):

- A getter of a lost connection returns the last values, so freshness comes from
  :class:`hw.robot.rtde.PacketReader`.
- Calls to a silent controller hang, so the caller kills this process after a while, and the
  controller's own watchdog stops the robot 0.1 s after the last sign of life.
- A connection that was reset is opened again, and the script sent again, without asking; so the
  text that ur_rtde prints is watched, and a reset ends the motion for good.
- A motion goes on after a disconnect, so the robot is stopped first.
"""

from __future__ import annotations

import enum
import json
import math
import os
import select
import signal
import sys
import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from hw.clock import Clock
from hw.errors import DeviceError, LostError, RefusedError, StaleError, StoppedError
from hw.extras import require
from hw.rigid import turn_deg
from hw.robot._process import ASKS, RECEIVES, be_prompt
from hw.robot.identity import LOCAL, read_identity, stop_program, until_local
from hw.robot.limits import Limits, numbers
from hw.robot.rtde import (
    PROGRAM_RUNS,
    Packet,
    PacketReader,
    PendantSettings,
    safety_text,
    state_text,
    too_late,
)
from hw.robot.safety import (
    Command,
    Confirmation,
    Gate,
    MotionPlan,
    check_plan,
    out_of_box_mm,
)
from hw.robot.stream import Lag, PoseSample, offset_changed

WATCHDOG_HZ, IDLE_WATCHDOG_HZ = 10.0, 0.5
"""The controller stops its program, and the robot, when it hears nothing for 0.1 s during a motion;
at rest it waits for 2 s."""
_KICK_S = 0.02
_REPORT_S = 0.05
_STEADY_S, _STEADY_POLL_S = 0.5, 0.05
_STOP_M_S2 = 2.0
_STOPPED_MM_S, _STOPPED_RAD_S = 1.0, 0.01
"""Below these speeds the TCP counts as at rest; a real arm's reading is never quite zero."""
_REST_SEEN_S = 0.03
"""A stop is done when the poses have shown rest for so long after stopL (4 poses at 125 Hz)."""
_STOP_AGAIN_S = 0.05
"""stopL is sent again to a robot that still moves after this time."""
_STOP_PATIENCE_S = 2.0
_END_S = 5.0
"""Longest time for the end of the script and of the connection."""
_DASHBOARD_S = 0.3
"""Longest wait (wall s) for the dashboard; the caller waits for the end of this process."""
_CONTROL_S = 0.2
"""The dashboard is asked so often (wall s) whether the robot is still in remote control."""
_CAUSE_S = 0.1
"""The poses tell of a safety stop by so much later than the controller's program ends."""
_ARRIVED_MM, _ARRIVED_DEG = 0.2, 0.1
_REST_MM_S = 0.2
_LEAST_PATIENCE_S = 3.0
_BOX_MARGIN_MM = 1.0
_RECONNECTS = ("econnect", "Lost connection", "Could not receive", "closed the connection")


class State(enum.Enum):
    """What the mover is doing; see the module."""

    REST = "rest"
    SENDING = "sending"
    MOVING = "moving"
    STOPPING = "stopping"


@dataclass(frozen=True)
class _Stop:
    """Why the robot must stop, and whether the stop ends motion for good."""

    error: DeviceError
    for_good: bool


class _Interrupted(Exception):
    """A stop was latched, or the caller left, while a motion was being sent."""


class _Ended(Exception):
    """The motion is over for good: the connection, the program or the robot's state is gone."""

    def __init__(self, cause: DeviceError) -> None:
        self.cause = cause


class Mover:
    """See the module; ``setup`` is the first line of input."""

    def __init__(self, setup: dict, output: int, library: int | None) -> None:
        self._output, self._library = output, library
        self._clock = Clock(*setup["clock"])
        plan = setup["plan"]
        limits = Limits.from_mapping(plan["limits"])
        pendant = plan["pendant"]
        cog = pendant["payload_cog_m"]
        self._plan = MotionPlan.from_poses(
            plan["targets"],
            limits,
            plan["tcp_offset"],
            plan["serial"],
            PendantSettings(
                pendant["payload_kg"],
                None if cog is None else tuple(cog),
                pendant["speed_fraction"],
            ),
        )
        given = setup["confirmation"]
        confirmation = None if given is None else Confirmation(**given)
        self._gate = Gate(self._plan, confirmation, self._clock)
        self._host: str = setup["host"]
        self._dry_run: bool = setup["dry_run"]
        self._caller_s: float = setup["caller_s"]
        self._lag = Lag()
        self._packet: Packet | None = None
        self._sample: PoseSample | None = None
        self._offset: tuple[float, ...] | None = None
        self._pendant: PendantSettings | None = None
        self._state = State.REST
        self._stop: _Stop | None = None
        self._closing = False
        self._requests: deque[dict] = deque()
        self._count = 0
        """Number of the newest request to move that was taken."""
        self._answered = 0
        """Number of the newest request to move that was answered."""
        self._moving: Command | None = None
        self._deadline = self._steady_due = 0.0
        self._heard = self._kicked = self._reported = -math.inf
        self._virtual: PoseSample | None = None
        self._kicks = 0
        self._input = b""
        self._control = None
        self._serial = ""
        self._runs = False
        """Whether our program has run; from then on a packet without a program means its end."""
        self._replaced = False
        """Whether our program has ended, whatever runs now."""
        self._local = False
        """Whether a person has switched the robot to local control."""

    # Start and end

    def start(self) -> None:
        """Connect; the caller waits for the line ``ready``."""
        check_plan(self._plan)
        identity = read_identity(self._host)
        self._serial = identity.name
        self._reader = PacketReader(self._host)
        asked_s, stamp_s = self._reader.bound
        if math.isfinite(asked_s):
            self._lag = Lag(self._clock.at(asked_s), stamp_s)
        oldest = self._clock.patience(self._plan.limits.max_pose_age_s)
        problem = too_late(self._reader.latency_s * self._clock.speed, oldest)
        if problem is not None:
            raise problem
        self._wait_for_packet()
        if self._dry_run:
            self._tell("ready", serial=self._serial, tcp_offset=self._offset)
            return
        self._gate.check_start(self._serial, self._offset or self._plan.tcp_offset, self._pendant)
        self._check_robot(identity.remote)
        module = require("rtde_control", extra="robot")
        self._log("connect", host=self._host, serial=self._serial)
        try:
            # The thread that ur_rtde starts inherits this priority.
            be_prompt(RECEIVES)
            self._control = module.RTDEControlInterface(self._host)
        except RuntimeError as error:
            raise LostError(_said(error), device="robot") from None
        finally:
            be_prompt(ASKS)
        self._command("setWatchdog", IDLE_WATCHDOG_HZ)
        self._kicked = self._clock.now()
        if self._offset is None:
            self._offset = numbers(self._command("getTCPOffset"), 6, "TCP offset")
        self._gate.check_authority(self._serial, self._offset, self._pendant)
        self._wait_for_packet(running=True)
        self._runs = True
        if identity.remote:
            threading.Thread(target=self._watch_control, name="control", daemon=True).start()
        self._tell("ready", serial=self._serial, tcp_offset=self._offset)

    def _watch_control(self) -> None:
        """In a thread of its own: no packet tells whether the robot is in remote control."""
        be_prompt(0)
        until_local(self._host, period_s=_CONTROL_S)
        self._local = True

    def _check_robot(self, remote: bool | None) -> None:
        """Whether the robot can take a program now: ur_rtde would stop whatever runs, unasked."""
        assert self._packet is not None
        problem = LOCAL if remote is False else ""
        problem = problem or state_text(self._packet.robot_mode, self._packet.safety_bits)
        # The program of a connection that was lost ends by its watchdog.
        give_up = self._clock.now() + self._clock.patience(1.1 / IDLE_WATCHDOG_HZ)
        while not problem and self._packet.program:
            if self._clock.now() > give_up:
                problem = "a program runs on the robot, or is paused: stop it at the pendant"
            self._read(self._clock.wall(0.01))
        if problem:
            raise RefusedError(problem, device="robot")

    def _wait_for_packet(self, *, running: bool = False) -> None:
        give_up = self._clock.now() + 2.0 + self._clock.speed
        while self._clock.now() < give_up:
            self._read(self._clock.wall(0.01))
            self._kick()
            packet = self._packet
            if packet is not None and (not running or packet.status_bits & PROGRAM_RUNS):
                return
        raise LostError("the controller sends no poses, or runs no program", device="robot")

    def close(self) -> None:
        """Stop, end the script in order (its watchdog must not trip), then disconnect."""
        _end_within(2 * _STOP_PATIENCE_S + _END_S)
        self._brake()
        if self._control is not None and self._usable():
            self._end_script()
            self._log("disconnect")
            self._control.disconnect()
        self._end_paused()

    def _end_script(self) -> None:
        self._log("kickWatchdog", times=self._kicks)
        # Calls to a controller that is gone may hang, and nobody kills this process if the caller
        # is gone, too. The robot rests by now.
        _end_within(_END_S)
        self._command("stopScript")

    def _end_paused(self) -> str:
        """End a program that a safety stop has paused: it might go on when the stop is released.

        A paused program reads no commands, so the dashboard is asked.

        Returns:
            What a person must do if it could not be ended.
        """
        packet = self._packet
        if self._control is None or packet is None or not packet.program or self._replaced:
            return ""
        if not safety_text(packet.safety_bits):
            return ""
        self._log("dashboard: stop")
        if stop_program(self._host, timeout_s=_DASHBOARD_S):
            return ""
        return "; the program may be paused: stop it at the pendant before you reset the robot"

    # The loop

    def run(self) -> None:
        """Serve until the input ends or asks to close, or the robot is lost or stopped.

        Raises:
            _Ended: motion is over for good.
        """
        tick = min(0.01, max(0.001, self._clock.wall(0.01)))
        while True:
            self._read(tick)
            self._watch()
            self._kick()
            if self._stop is not None:
                self._halt()
            elif self._closing:
                return
            elif self._moving is not None:
                self._follow(self._moving)
            elif self._requests:
                self._take(self._requests.popleft())
            now = self._clock.now()
            if now - self._reported > _REPORT_S:
                self._reported = now
                self._tell("alive")

    def _read(self, timeout_s: float) -> None:
        """Wait for input or a packet, and handle everything that has come."""
        sources = [self._reader, *([] if self._library is None else [self._library])]
        if not self._closing:
            sources.append(0)
        ready = select.select(sources, [], [], timeout_s)[0]
        if self._reader in ready:
            try:
                packets = self._reader.read()
            except LostError as error:
                raise _Ended(self._lost(error.args[0])) from None
            for packet in packets:
                self._packet = packet
                # In every packet: the newest one may already tell of another program.
                self._replaced |= self._runs and not packet.program
                t_host = self._clock.at(packet.monotonic_s)
                lag = self._lag.of(t_host, packet.timestamp_s)
                self._sample = PoseSample(
                    t_host,
                    packet.timestamp_s,
                    packet.tcp_pose,
                    packet.safety_bits,
                    packet.robot_mode,
                    packet.runtime_state,
                    lag,
                    packet.joints,
                )
                self._compare(packet.tcp_offset, packet.pendant)
        if self._library in ready and self._library is not None:
            text = os.read(self._library, 65536).decode("utf-8", "replace")
            if any(word in text for word in _RECONNECTS):
                raise _Ended(self._lost("the control connection was reset"))
        if 0 in ready:
            data = os.read(0, 65536)
            *lines, self._input = (self._input + data).split(b"\n")
            for line in lines:
                self._take_in(json.loads(line))
            # The input's end: the caller closed it, or was killed.
            self._closing = self._closing or not data

    def _take_in(self, request: dict) -> None:
        """One line of input, at the moment it is read: a stop acts now, a move must wait."""
        match request["request"]:
            case "move":
                self._requests.append(request)
            case "stop":
                kind = StaleError if request["kind"] == StaleError.__name__ else StoppedError
                hesitation = kind is StaleError
                # A hesitation is about one move: once that is answered, there is nothing to stop.
                if not hesitation or request["move"] > self._answered:
                    self._latch(kind(request["reason"], device="robot"), not hesitation)
            case "heard":
                self._heard = self._clock.now()
            case "close":
                self._closing = True

    def _latch(self, error: DeviceError, for_good: bool) -> None:
        """Keep a stop until the robot rests; a stop for good replaces a hesitation."""
        if self._stop is None or (for_good and not self._stop.for_good):
            self._stop = _Stop(error, for_good)

    def _watch(self) -> None:
        trouble = self._trouble()
        if trouble is not None:
            self._latch(*trouble)

    def _heed(self) -> None:
        """Handle everything that came while a command was being sent.

        Raises:
            _Interrupted: a stop is latched, or the caller has left; the motion must not go on.
        """
        self._read(0.0)
        self._watch()
        if self._stop is not None or self._closing:
            raise _Interrupted

    def _compare(self, offset: tuple[float, ...] | None, pendant: PendantSettings) -> None:
        changed = "" if self._pendant is None else self._pendant.changed(pendant)
        if changed:
            self._latch(RefusedError(f"changed at the pendant: {changed}", device="robot"), True)
        self._pendant = pendant
        if offset is None:
            return
        if self._offset is not None and offset_changed(self._offset, offset):
            error = RefusedError("the controller's TCP offset was changed", device="robot")
            self._latch(error, True)
        self._offset = offset

    def _take(self, request: dict) -> None:
        self._count = request["move"]
        self._heard = self._clock.now()
        self._state = State.SENDING
        try:
            self._move(request["pose"], request["speed_mm_s"])
        except _Interrupted:
            # The loop stops the robot, and answers the request.
            return
        except (RefusedError, StaleError) as error:
            self._state = State.REST
            self._log("refused", why=error.args[0])
            self._answer(error)

    def _kick(self) -> None:
        now = self._clock.now()
        if self._control is None or self._replaced:
            return
        if now - self._kicked > _KICK_S:
            self._kicked = now
            self._kicks += 1
            if not self._call("kickWatchdog"):
                raise _Ended(self._program_stopped())

    # Motion

    def _move(self, pose: object, speed_mm_s: object) -> None:
        """Ask the gate and the controller, and send the motion.

        Raises:
            RefusedError: the gate or the controller refuses the motion.
            StaleError: the newest pose is too old.
            _Interrupted: a stop came, or the caller left, before or while the motion was sent.
        """
        if self._dry_run:
            self._pretend(pose, speed_mm_s)
            return
        if self._packet is not None and self._packet.tcp_offset is None:
            # This controller's real-time data lacks the TCP offset, so ask for it.
            self._offset = numbers(self._command("getTCPOffset"), 6, "TCP offset")
        raw = list(self._allow(pose, speed_mm_s).raw)
        if not self._command("isPoseWithinSafetyLimits", raw):
            text = "the controller says that the pose is outside its safety limits"
            raise RefusedError(text, device="robot")
        self._heed()
        self._command("setWatchdog", WATCHDOG_HZ / self._clock.patience(1.0))
        # The questions took time: check again for a stop, and check the move from the newest pose.
        self._heed()
        command = self._allow(pose, speed_mm_s)
        sent = self._command(
            "moveL", list(command.raw), command.speed_m_s, command.acceleration_m_s2, True
        )
        if not sent:
            raise _Ended(self._lost("the controller did not take the motion"))
        now = self._clock.now()
        self._kicked, self._steady_due = now, now + _STEADY_S
        self._deadline = now + 1.5 * command.duration_s + self._clock.patience(_LEAST_PATIENCE_S)
        self._moving, self._state = command, State.MOVING
        # A stop that came while moveL was being sent acts at once, not a tick later.
        self._heed()

    def _allow(self, pose: object, speed_mm_s: object) -> Command:
        assert self._sample is not None
        assert self._packet is not None
        return self._gate.check_move(
            pose,
            self._sample,
            speed_mm_s,
            serial=self._serial,
            tcp_offset=self._offset,
            pendant=self._pendant,
            force_n=math.hypot(*self._packet.tcp_force[:3]),
        )

    def _pretend(self, pose: object, speed_mm_s: object) -> None:
        """Check a motion of a dry run, as if the robot stood at the target of the last one."""
        assert self._sample is not None
        here = self._sample
        if self._virtual is not None:
            here = replace(here, raw=self._virtual.raw, joints=None)
        command = self._gate.check_geometry(pose, here, speed_mm_s)
        self._heed()
        self._log("dry run: moveL", raw=command.raw, speed_m_s=command.speed_m_s)
        self._virtual = replace(here, raw=command.raw, joints=None)
        self._arrive(self._virtual)

    def _follow(self, command: Command) -> None:
        """Answer when the motion has arrived and rests; latch a stop for good when it is late."""
        assert self._sample is not None
        assert self._packet is not None
        assert self._control is not None
        now = self._clock.now()
        speed = math.hypot(*self._packet.tcp_speed[:3]) * 1000.0
        pose = self._sample.pose
        off = float(np.linalg.norm(pose[:3, 3] - command.pose[:3, 3]))
        there = off < _ARRIVED_MM and turn_deg(pose, command.pose) < _ARRIVED_DEG
        if not (there and speed < _REST_MM_S):
            # The controller calls an arm steady once it has rested for half a second.
            self._steady_due = now + _STEADY_S
        elif now >= self._steady_due:
            self._steady_due = now + _STEADY_POLL_S
            if self._command("isSteady"):
                self._command("setWatchdog", IDLE_WATCHDOG_HZ)
                self._read(0.0)
                self._watch()
                # A motion that was asked to stop is never answered with "arrived".
                if self._stop is None:
                    self._arrive(self._sample)
                return
        if now > self._deadline:
            text = f"not arrived in time: {off:.2f} mm from the target"
            self._latch(StoppedError(text, device="robot"), True)

    def _arrive(self, sample: PoseSample) -> None:
        self._moving, self._state = None, State.REST
        self._answered = self._count
        self._tell("arrived", move=self._count, sample=_plain(sample))

    def _trouble(self) -> tuple[DeviceError, bool] | None:
        """Why the robot must stop, and whether that ends motion for good; None: it may go on."""
        packet, sample = self._packet, self._sample
        if packet is None or sample is None or self._control is None:
            return None
        stopped = _unfit(packet)
        if stopped is not None:
            return stopped, True
        if self._local:
            return StoppedError(f"{LOCAL}; then confirm the plan again", device="robot"), True
        if self._replaced or not packet.status_bits & PROGRAM_RUNS:
            return self._program_stopped(), True
        if not self._control.isConnected():
            return self._lost("the control connection is gone"), True
        if self._moving is None:
            return None
        limits, now = self._plan.limits, self._clock.now()
        age = sample.age_s(now)
        if age > self._clock.patience(limits.max_pose_age_s):
            text = f"no fresh pose: the newest is {sample.age_text(now)}; the motion was stopped"
            return StaleError(text, device="robot"), False
        force = math.hypot(*packet.tcp_force[:3])
        if force > limits.max_force_n:
            text = f"a force of {force:.1f} N, over the cap of {limits.max_force_n:g} N"
            return StoppedError(text, device="robot"), True
        out = out_of_box_mm(sample.pose, limits)
        if out > _BOX_MARGIN_MM:
            text = f"the probe is {out:.1f} mm out of the box"
            return StoppedError(text, device="robot"), True
        if now - self._heard > self._clock.patience(self._caller_s):
            # A fault of this software, like a silent stream: nothing says that motion is dangerous.
            text = f"the caller was silent for {now - self._heard:.2f} s"
            return StaleError(text, device="robot"), False
        return None

    def _halt(self) -> None:
        """Stop the robot as latched; returns only after a hesitation.

        Raises:
            _Ended: after any other stop, or if the robot does not stop or is lost.
        """
        told: _Stop | None = None
        self._state = State.STOPPING
        while self._stop is not None and self._stop is not told:
            # Input is read while braking, so a stop for good may replace a hesitation.
            told = self._stop
            self._tell("stopping", kind=type(told.error).__name__, text=told.error.args[0])
            self._brake()
        assert told is not None
        if told.for_good:
            if self._usable():
                self._end_script()
            raise _Ended(told.error)
        if self._usable():
            self._command("setWatchdog", IDLE_WATCHDOG_HZ)
        self._stop, self._moving, self._state = None, None, State.REST
        asked = self._requests[-1]["move"] if self._requests else self._count
        self._requests.clear()
        if asked > self._answered:
            self._count = asked
            self._answer(told.error)

    def _brake(self) -> None:
        """Send stopL until the poses show rest, as long as the controller takes commands.

        Raises:
            _Ended: the robot does not stop, or is lost.
        """
        give_up = self._clock.now() + self._clock.patience(_STOP_PATIENCE_S)
        while self._usable():
            # Asynchronous: a call that waits for rest would hold the watchdog's kicks back, and
            # braking may take longer than the watchdog waits. The poses show what stopL did.
            self._command("stopL", _STOP_M_S2, True)
            if self._rests():
                return
            if self._clock.now() > give_up:
                text = "the robot was told to stop and still moves: press the emergency stop"
                raise _Ended(LostError(text, device="robot"))

    def _rests(self) -> bool:
        """Whether the poses show rest for :data:`_REST_SEEN_S`; False: send stopL again."""
        assert self._packet is not None
        sent = since = self._packet.timestamp_s
        give_up = self._clock.now() + self._clock.patience(10 * _REST_SEEN_S)
        while self._clock.now() < give_up:
            self._read(self._clock.wall(_REST_SEEN_S / 4))
            self._kick()
            packet = self._packet
            speed = math.hypot(*packet.tcp_speed[:3]) * 1000.0
            if packet.timestamp_s > since and (
                speed > _STOPPED_MM_S or math.hypot(*packet.tcp_speed[3:]) > _STOPPED_RAD_S
            ):
                since = packet.timestamp_s
                if since - sent > _STOP_AGAIN_S:
                    return False
            if packet.timestamp_s - since >= _REST_SEEN_S:
                return True
        return False

    def _usable(self) -> bool:
        """Whether the controller takes commands; if not, calls of ur_rtde hang or reconnect."""
        packet = self._packet
        return bool(
            self._control is not None
            and self._control.isConnected()
            and packet is not None
            and packet.status_bits & PROGRAM_RUNS
            and not self._replaced
            and not safety_text(packet.safety_bits)
        )

    def _program_stopped(self, what: str = "the controller's program stopped") -> DeviceError:
        """Why the controller takes no commands: a safety stop if one is told of, else ``what``."""
        give_up = self._clock.now() + self._clock.patience(_CAUSE_S)
        while self._clock.now() < give_up:
            self._read(self._clock.wall(_CAUSE_S / 10))
            stopped = None if self._packet is None else _unfit(self._packet)
            if stopped is not None:
                return stopped
        if self._replaced and self._packet is not None and self._packet.program:
            text = "another program was started on the robot: stop it at the pendant"
            return StoppedError(f"{text}, then confirm the plan again", device="robot")
        return self._lost(what)

    def _lost(self, what: str) -> LostError:
        reason = "; the robot's own watchdog stops it. Motion needs a new confirmation"
        return LostError(what + reason, device="robot")

    # Words

    def _command(self, name: str, *values: object) -> object:
        """One command to the controller; every one is logged before it is sent."""
        self._log(name, values=values)
        return self._call(name, *values)

    def _call(self, name: str, *values: object) -> object:
        assert self._sample is not None
        age = self._sample.age_s(self._clock.now())
        if age > self._plan.limits.max_pose_age_s:
            # The controller is silent: ur_rtde would spin for seconds at real-time priority.
            be_prompt(0)
        try:
            return getattr(self._control, name)(*values)
        except RuntimeError as error:
            raise _Ended(self._program_stopped(_said(error))) from None
        finally:
            be_prompt(ASKS)

    def _log(self, command: str, **numbers: object) -> None:
        self._tell("log", t=self._clock.now(), command=command, numbers=numbers)

    def _answer(self, error: DeviceError) -> None:
        self._answered = self._count
        kind = type(error).__name__
        self._tell("error", move=self._count, kind=kind, text=error.args[0], ended=False)

    def end(self, error: DeviceError) -> NoReturn:
        """Report why, and exit at once, so that ur_rtde can neither reconnect nor wait."""
        text, kind, stop = error.args[0], type(error), self._stop
        if stop is not None and stop.error is not error:
            text = f"{stop.error.args[0]}; {text}"
            # A stop for good stays one, whatever comes after it.
            if stop.for_good and kind is not StoppedError:
                kind = type(stop.error)
        self._tell("error", kind=kind.__name__, text=text + self._end_paused(), ended=True)
        os._exit(1)

    def _tell(self, what: str, **values: object) -> None:
        try:
            _write(self._output, {"what": what, **values})
        except BrokenPipeError:
            # Nobody listens any more; the robot must be stopped all the same.
            self._closing = True


def _said(error: RuntimeError) -> str:
    """An error of ur_rtde; some of its texts begin with its name."""
    return f"ur_rtde: {str(error).removeprefix('ur_rtde: ')}"


def _unfit(packet: Packet) -> StoppedError | None:
    """The stop if the robot is not fit to move: a safety stop, or a mode other than running."""
    problem = state_text(packet.robot_mode, packet.safety_bits)
    if not problem:
        return None
    return StoppedError(f"{problem}; then confirm the plan again", device="robot")


def _end_within(seconds: float) -> None:
    """Let the system end this process after so long, whatever it hangs in."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _plain(sample: PoseSample) -> list:
    return [
        sample.t_host,
        sample.t_device,
        sample.raw,
        sample.safety_bits,
        sample.robot_mode,
        sample.runtime_state,
        sample.lag_s,
    ]


def _write(output: int, message: dict) -> None:
    view = memoryview(json.dumps(message, default=str).encode() + b"\n")
    while view:
        view = view[os.write(output, view) :]


def main() -> NoReturn:
    """Move until the caller closes the input, or motion ends."""
    output = os.dup(1)
    library, end = os.pipe()
    os.dup2(end, 1)
    os.dup2(end, 2)
    setup = json.loads(sys.stdin.buffer.readline())
    be_prompt(ASKS)
    try:
        mover = Mover(setup, output, library)
        try:
            mover.start()
            mover.run()
            mover.close()
        except _Ended as error:
            mover.end(error.cause)
        except DeviceError as error:
            mover.end(error)
    except BrokenPipeError:
        os._exit(0)
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        _write(output, {"what": "error", "kind": "LostError", "text": text, "ended": True})
        os._exit(1)
    _write(output, {"what": "closed"})
    os._exit(0)


if __name__ == "__main__":
    main()
