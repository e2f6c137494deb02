"""The process that moves the robot, for :class:`hw.robot.motion.Motion`.

It holds the only control connection and the gate; one loop reads poses, looks for trouble, keeps
the controller's watchdog quiet and takes requests, line by line as JSON, from its standard input.
Nothing in it waits for a motion: motions are asynchronous, so that every pose is looked at while
the robot moves. When the input ends (the caller is gone), the robot is stopped.

What ur_rtde does and this must live with (each measured): a getter of a lost connection goes on
with the last values, so freshness comes from :class:`hw.robot.rtde.PacketReader`; calls to a mute
controller hang, so the caller kills this process after a while, and the controller's own watchdog
stops the robot 0.1 s after the last sign of life; a reset connection is made again behind our back,
script and all, so what ur_rtde prints is watched and ends the motion for good; motion goes on after
a disconnect, so the robot is stopped first.
"""

from __future__ import annotations

import json
import math
import os
import select
import sys
from dataclasses import replace
from typing import NoReturn

import numpy as np

from hw.clock import Clock
from hw.errors import DeviceError, LostError, RefusedError, StaleError, StoppedError
from hw.extras import require
from hw.robot._process import ASKS, RECEIVES, be_prompt
from hw.robot.limits import Limits, numbers
from hw.robot.pose import turn_deg
from hw.robot.rtde import Packet, PacketReader, read_identity, safety_text
from hw.robot.safety import Command, Confirmation, Gate, MotionPlan, check_plan
from hw.robot.stream import Lag, PoseSample, offset_changed

WATCHDOG_HZ, IDLE_WATCHDOG_HZ = 10.0, 0.5
"""The controller stops its program, and the robot, when it hears nothing for 0.1 s during a motion;
at rest it waits for 2 s."""
_KICK_S = 0.02
_REPORT_S = 0.05
_STEADY_S, _STEADY_POLL_S = 0.5, 0.05
_STOP_M_S2 = 2.0
_ARRIVED_MM, _ARRIVED_DEG = 0.2, 0.1
_REST_MM_S = 0.2
_LEAST_PATIENCE_S = 3.0
_PROGRAM_RUNS = 0b10
_BOX_MARGIN_MM = 1.0
_RECONNECTS = ("econnect", "Lost connection", "Could not receive", "closed the connection")


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
        self._plan = MotionPlan.from_poses(
            plan["targets"], limits, plan["tcp_offset"], plan["serial"]
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
        self._moving: Command | None = None
        self._deadline = self._steady_due = 0.0
        self._heard = self._kicked = self._reported = -math.inf
        self._virtual: PoseSample | None = None
        self._kicks = 0
        self._input = b""
        self._control = None
        self._serial = ""

    # Start and end

    def start(self) -> None:
        """Connect; the caller waits for the line ``ready``."""
        check_plan(self._plan)
        self._serial = read_identity(self._host).serial
        self._reader = PacketReader(self._host)
        self._wait_for_packet()
        if self._dry_run:
            self._tell("ready", serial=self._serial, tcp_offset=self._offset)
            return
        self._gate.check_authority(self._serial, self._offset or self._plan.tcp_offset)
        module = require("rtde_control", extra="robot")
        self._log("connect", host=self._host, serial=self._serial)
        try:
            # The thread that it starts inherits this.
            be_prompt(RECEIVES)
            self._control = module.RTDEControlInterface(self._host)
        except RuntimeError as error:
            raise LostError(f"ur_rtde: {error}", device="robot") from None
        finally:
            be_prompt(ASKS)
        self._command("setWatchdog", IDLE_WATCHDOG_HZ)
        self._kicked = self._clock.now()
        if self._offset is None:
            self._offset = numbers(self._command("getTCPOffset"), 6, "TCP offset")
        self._gate.check_authority(self._serial, self._offset)
        self._wait_for_packet(running=True)
        self._tell("ready", serial=self._serial, tcp_offset=self._offset)

    def _wait_for_packet(self, *, running: bool = False) -> None:
        give_up = self._clock.now() + 2.0 + self._clock.speed
        while self._clock.now() < give_up:
            self._read(self._clock.wall(0.01))
            self._kick()
            packet = self._packet
            if packet is not None and (not running or packet.status_bits & _PROGRAM_RUNS):
                return
        raise LostError("the controller sends no poses, or runs no program", device="robot")

    def close(self) -> None:
        """Stop, end the script in order (its watchdog must not trip), then disconnect."""
        if self._control is not None and self._usable():
            self._command("stopL", _STOP_M_S2, False)
            self._log("kickWatchdog", times=self._kicks)
            self._command("stopScript")
            self._log("disconnect")
            self._control.disconnect()

    # The loop

    def run(self) -> None:
        """Serve until the input ends or asks to close, or the robot is lost.

        Raises:
            _Ended: motion is over for good.
        """
        tick = min(0.01, max(0.001, self._clock.wall(0.01)))
        while True:
            lines = self._read(tick)
            trouble = self._trouble()
            if trouble is not None:
                self._halt(*trouble)
            self._kick()
            for line in lines:
                if not self._take(json.loads(line)):
                    return
            if self._moving is not None:
                self._follow(self._moving)
            now = self._clock.now()
            if now - self._reported > _REPORT_S:
                self._reported = now
                self._tell("alive")

    def _read(self, timeout_s: float) -> list[bytes]:
        """Wait for input or a packet; returns whole lines of input."""
        sources = [0, self._reader, *([] if self._library is None else [self._library])]
        ready = select.select(sources, [], [], timeout_s)[0]
        if self._reader in ready:
            try:
                packets = self._reader.read()
            except LostError as error:
                raise _Ended(self._lost(error.args[0])) from None
            for packet in packets:
                self._packet = packet
                t_host = self._clock.at(packet.monotonic_s)
                lag = self._lag.of(t_host, packet.timestamp_s)
                self._sample = PoseSample(
                    t_host, packet.timestamp_s, packet.tcp_pose, packet.safety_bits,
                    packet.robot_mode, packet.runtime_state, lag,
                )  # fmt: skip
                self._compare(packet.tcp_offset)
        if self._library in ready and self._library is not None:
            text = os.read(self._library, 65536).decode("utf-8", "replace")
            if any(word in text for word in _RECONNECTS):
                raise _Ended(self._lost("the control connection was reset"))
        if 0 not in ready:
            return []
        data = os.read(0, 65536)
        if not data:
            return [b'{"request": "close"}']
        *lines, self._input = (self._input + data).split(b"\n")
        return lines

    def _compare(self, offset: tuple[float, ...] | None) -> None:
        if offset is None:
            return
        if self._offset is not None and offset_changed(self._offset, offset):
            error = RefusedError("the controller's TCP offset was changed", device="robot")
            self._halt(error, True)
        self._offset = offset

    def _take(self, request: dict) -> bool:
        match request["request"]:
            case "move":
                self._heard = self._clock.now()
                try:
                    self._move(request["pose"], request["speed_mm_s"])
                except RefusedError as error:
                    self._log("refused", why=error.args[0])
                    self._answer(error)
            case "stop":
                self._halt(StoppedError(request["reason"], device="robot"), False)
            case "heard":
                self._heard = self._clock.now()
            case "close":
                return False
        return True

    def _kick(self) -> None:
        now = self._clock.now()
        if self._control is not None and now - self._kicked > _KICK_S:
            self._kicked = now
            self._kicks += 1
            if not self._call("kickWatchdog"):
                raise _Ended(self._lost("the controller's program stopped"))

    # Motion

    def _move(self, pose: object, speed_mm_s: object) -> None:
        if self._moving is not None:
            raise RefusedError("the robot is moving already", device="robot")
        if self._dry_run:
            self._pretend(pose, speed_mm_s)
            return
        raw = list(self._allow(pose, speed_mm_s).raw)
        if not self._command("isPoseWithinSafetyLimits", raw):
            text = "the controller says that the pose is outside its safety limits"
            raise RefusedError(text, device="robot")
        self._command("setWatchdog", WATCHDOG_HZ / self._clock.patience(1.0))
        # What was asked took time: look again, at the newest pose.
        self._read(0.0)
        command = self._allow(pose, speed_mm_s)
        sent = self._command(
            "moveL", list(command.raw), command.speed_m_s, command.acceleration_m_s2, True
        )
        if not sent:
            raise _Ended(self._lost("the controller did not take the motion"))
        now = self._clock.now()
        self._kicked, self._steady_due = now, now + _STEADY_S
        self._deadline = now + 1.5 * command.duration_s + _LEAST_PATIENCE_S
        self._moving = command

    def _allow(self, pose: object, speed_mm_s: object) -> Command:
        assert self._sample is not None
        return self._gate.check_move(
            pose, self._sample, speed_mm_s, serial=self._serial, tcp_offset=self._offset
        )

    def _pretend(self, pose: object, speed_mm_s: object) -> None:
        """A dry run: as if the robot stood where the last motion would have taken it."""
        assert self._sample is not None
        here = self._sample
        if self._virtual is not None:
            here = replace(here, raw=self._virtual.raw)
        command = self._gate.check_geometry(pose, here, speed_mm_s)
        self._log("dry run: moveL", raw=command.raw, speed_m_s=command.speed_m_s)
        self._virtual = replace(here, raw=command.raw)
        self._tell("arrived", sample=_plain(self._virtual))

    def _follow(self, command: Command) -> None:
        """Whether the motion has arrived, and rests."""
        assert self._sample is not None
        assert self._packet is not None
        assert self._control is not None
        now = self._clock.now()
        speed = math.hypot(*self._packet.tcp_speed[:3]) * 1000.0
        pose = self._sample.pose
        off = float(np.linalg.norm(pose[:3, 3] - command.pose[:3, 3]))
        there = off < _ARRIVED_MM and turn_deg(pose, command.pose) < _ARRIVED_DEG
        if not (there and speed < _REST_MM_S):
            # The controller calls an arm steady that has rested for half a second.
            self._steady_due = now + _STEADY_S
        elif now >= self._steady_due:
            self._steady_due = now + _STEADY_POLL_S
            if self._command("isSteady"):
                self._moving = None
                self._command("setWatchdog", IDLE_WATCHDOG_HZ)
                self._read(0.0)
                self._tell("arrived", sample=_plain(self._sample))
                return
        if now > self._deadline:
            text = f"not arrived in time: {off:.2f} mm from the target"
            self._halt(StoppedError(text, device="robot"), False)

    def _trouble(self) -> tuple[DeviceError, bool] | None:
        """What speaks against going on, and whether it ends motion for good."""
        packet, sample = self._packet, self._sample
        if packet is None or sample is None or self._control is None:
            return None
        problem = safety_text(packet.safety_bits)
        if problem:
            text = f"{problem}: release it at the robot, then confirm the plan again"
            return StoppedError(text, device="robot"), True
        if not packet.status_bits & _PROGRAM_RUNS:
            return self._lost("the controller's program stopped"), True
        if not self._control.isConnected():
            return self._lost("the control connection is gone"), True
        if self._moving is None:
            return None
        limits, now = self._plan.limits, self._clock.now()
        age = sample.age_s(now)
        if age > self._clock.patience(limits.max_pose_age_s):
            text = f"no fresh pose for {age * 1000:.0f} ms: the motion was stopped"
            return StaleError(text, device="robot"), False
        force = math.hypot(*packet.tcp_force[:3])
        if force > limits.max_force_n:
            text = f"a force of {force:.1f} N, over the cap of {limits.max_force_n:g} N"
            return StoppedError(text, device="robot"), True
        tip = sample.pose[:3, :3] @ limits.tip_mm + sample.pose[:3, 3]
        out = float(np.maximum(limits.box_min_mm - tip, tip - limits.box_max_mm).max())
        if out > _BOX_MARGIN_MM:
            text = f"the probe's tip is {out:.1f} mm out of the box"
            return StoppedError(text, device="robot"), True
        if now - self._heard > self._clock.patience(self._caller_s):
            text = f"the caller was silent for {now - self._heard:.2f} s"
            return StoppedError(text, device="robot"), False
        return None

    def _halt(self, error: DeviceError, for_good: bool) -> None:
        """Stop the robot, as far as that can be done from here, then say so."""
        moving, self._moving = self._moving, None
        self._tell("stopping", kind=type(error).__name__, text=error.args[0])
        if self._control is not None and self._usable():
            self._command("stopL", _STOP_M_S2, False)
            self._command("setWatchdog", IDLE_WATCHDOG_HZ)
        if for_good:
            raise _Ended(error)
        if moving is not None:
            self._answer(error)

    def _usable(self) -> bool:
        """Whether the controller takes commands; else ur_rtde would hang or reconnect."""
        packet = self._packet
        return bool(
            self._control is not None
            and self._control.isConnected()
            and packet is not None
            and packet.status_bits & _PROGRAM_RUNS
            and not safety_text(packet.safety_bits)
        )

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
            # A mute controller: ur_rtde would spin for seconds, and keep a core from everybody.
            be_prompt(0)
        try:
            return getattr(self._control, name)(*values)
        finally:
            be_prompt(ASKS)

    def _log(self, command: str, **numbers: object) -> None:
        self._tell("log", t=self._clock.now(), command=command, numbers=numbers)

    def _answer(self, error: DeviceError) -> None:
        self._tell("error", kind=type(error).__name__, text=error.args[0], ended=False)

    def end(self, error: DeviceError) -> NoReturn:
        """Say why, and leave at once: ur_rtde must not reconnect, or wait, behind our back."""
        self._tell("error", kind=type(error).__name__, text=error.args[0], ended=True)
        os._exit(1)

    def _tell(self, what: str, **values: object) -> None:
        _write(self._output, {"what": what, **values})


def _plain(sample: PoseSample) -> list:
    return [
        sample.t_host, sample.t_device, sample.raw, sample.safety_bits, sample.robot_mode,
        sample.runtime_state, sample.lag_s,
    ]  # fmt: skip


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
