"""The loop that makes requests into motions, and stops the robot when a stop is latched.

The loop rests until a request to move is taken from the queue. What leads from one state to
another:

    rest -> sending      a request to move was taken from the queue
    sending -> rest      the gate or the controller refused it
    sending -> moving    moveL was taken by the controller
    moving -> rest       arrived: at the target, steady, and no stop latched
    any -> stopping      a stop is latched; stopL is sent again and again until the robot rests
    stopping -> rest     the stop was a hesitation (StaleError): the move may be asked for again
    stopping -> the end  any other stop: the process ends, and with it the confirmation

The last line of the table is what "latched until a new confirmation" means: after such a stop this
process never moves the robot again. A hesitation also cancels the moves that wait. While a motion
is being sent, the latch is checked after the controller's safety limits were asked, right before
moveL and right after it. A stop that comes while ur_rtde waits for the controller therefore acts at
the next of these checks.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from hw.robot.gate import Command, Gate
from hw.robot.limits import numbers
from hw.robot.mover.connection import Connection
from hw.robot.mover.controller import Controller
from hw.robot.mover.inputs import Ended, Inputs, Stop
from hw.robot.mover.messages import Caller, Setup, plain, told
from hw.robot.mover.monitor import Monitor
from hw.robot.stream import PoseSample
from hw.runtime.errors import DeviceError, RefusedError, StaleError, StoppedError, refused
from hw.runtime.rigid import turn_deg

_REPORT_S = 0.05
_STEADY_S, _STEADY_POLL_S = 0.5, 0.05
_ARRIVED_MM, _ARRIVED_DEG = 0.2, 0.1
_REST_MM_S = 0.2
_LEAST_PATIENCE_S = 3.0
_FROZEN_S, _FROZEN_MM = 0.3, 0.1
"""A robot on its way to a target reports another pose within this time and the time for this way:
it begins to move within milliseconds, and its encoders tell smaller steps (assumptions)."""


class _Interrupted(Exception):
    """A stop was latched, or the caller left, while a motion was being sent."""


class ControlLoop:
    """Serves the caller's requests.

    Args:
        setup: what the caller asks for.
        gate: allows or refuses each motion.
        inputs: requests, packets, and the latch.
        controller: is commanded.
        connection: to end the program after a stop.
        caller: is answered.
    """

    def __init__(
        self,
        setup: Setup,
        gate: Gate,
        inputs: Inputs,
        controller: Controller,
        connection: Connection,
        caller: Caller,
    ) -> None:
        self._dry_run, self._clock = setup.dry_run, setup.clock
        self._gate, self._inputs, self._latch = gate, inputs, inputs.latch
        self._controller, self._connection, self._caller = controller, connection, caller
        self._monitor = Monitor(setup, inputs, controller)
        self._count = 0
        """Number of the newest request to move that was taken."""
        self._moving: Command | None = None
        self._deadline = self._steady_due = 0.0
        self._last_raw: tuple[float, ...] = ()
        self._changed = 0.0
        """When the pose changed last."""
        self._reported = -math.inf
        self._virtual: PoseSample | None = None
        """In a dry run, where the robot would stand."""

    def run(self) -> None:
        """Serve until the input ends or asks to close, or the robot is lost or stopped.

        Raises:
            Ended: motion is over for good.
        """
        tick = min(0.01, max(0.001, self._clock.wall(0.01)))
        while True:
            self._inputs.read(tick)
            self._watch()
            self._controller.kick()
            if self._latch.stop is not None:
                self._halt()
            elif self._caller.left:
                return
            elif self._moving is not None:
                self._follow(self._moving)
            elif self._inputs.moves:
                self._take(self._inputs.moves.popleft())
            now = self._clock.now()
            if now - self._reported > _REPORT_S:
                self._reported = now
                self._caller.tell("alive")

    def let_go(self) -> None:
        """Stop a motion that may still run when this process ends, as where the poses are lost.

        The controller's watchdog would stop it, too, but later, and by means never tried on a real
        robot.
        """
        if self._moving is not None:
            self._controller.stop_unseen()

    def _watch(self) -> None:
        stop = self._monitor.trouble(self._moving)
        if stop is not None:
            self._latch.set(stop)

    def _heed(self) -> None:
        """Handle everything that came while a command was being sent.

        Raises:
            _Interrupted: a stop is latched, or the caller has left; the motion must not go on.
        """
        self._inputs.read(0.0)
        self._watch()
        if self._latch.stop is not None or self._caller.left:
            raise _Interrupted

    # Motion

    def _take(self, request: dict) -> None:
        self._count = request["move"]
        self._inputs.heard_s = self._clock.now()
        try:
            self._move(request["pose"], request["speed_mm_s"])
        except _Interrupted:
            # The loop stops the robot, and answers the request.
            return
        except (RefusedError, StaleError) as error:
            self._controller.log("refused", why=error.args[0])
            self._answer(error)

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
        controller = self._controller
        if self._inputs.packet.tcp_offset is None:
            # This controller's real-time data lacks the TCP offset, so ask for it.
            offset = numbers(controller.command("getTCPOffset"), 6, "TCP offset")
            self._inputs.tcp_offset = offset
        raw = list(self._allow(pose, speed_mm_s).raw)
        within = controller.command("isPoseWithinSafetyLimits", raw)
        # A paused program says no, too.
        self._heed()
        if not within:
            text = "the controller says that the pose is outside its safety limits"
            raise refused(text)
        controller.watch_motion()
        # The questions took time: check again for a stop, and check the move from the newest pose.
        self._heed()
        try:
            command = self._allow(pose, speed_mm_s)
        except DeviceError:
            # At rest a delay of 0.1 s must not end the program.
            controller.watch_rest()
            raise
        self._moving = command
        controller.move(list(command.raw), command.speed_m_s, command.acceleration_m_s2)
        now = self._clock.now()
        self._steady_due, self._changed = now + _STEADY_S, now
        self._deadline = now + 1.5 * command.duration_s + self._clock.patience(_LEAST_PATIENCE_S)
        # A stop that came while moveL was being sent acts at once, not a tick later.
        self._heed()

    def _allow(self, pose: object, speed_mm_s: object) -> Command:
        return self._gate.check_move(
            pose,
            self._inputs.sample,
            speed_mm_s,
            serial=self._controller.serial,
            tcp_offset=self._inputs.tcp_offset,
            pendant=self._inputs.pendant,
            force_n=self._inputs.packet.force_n,
        )

    def _pretend(self, pose: object, speed_mm_s: object) -> None:
        """Check a motion of a dry run, as if the robot stood at the target of the last one."""
        here = self._inputs.sample
        if self._virtual is not None:
            here = replace(here, raw=self._virtual.raw, joints=None)
        command = self._gate.check_geometry(pose, here, speed_mm_s)
        self._heed()
        self._controller.log("dry run: moveL", raw=command.raw, speed_m_s=command.speed_m_s)
        self._virtual = replace(here, raw=command.raw, joints=None)
        self._arrive(self._virtual)

    def _follow(self, command: Command) -> None:
        """Answer when the motion has arrived and rests.

        Latches a stop for good when it is late, or when the poses do not show any motion: boxes
        cannot be checked then.
        """
        now = self._clock.now()
        pose, raw = self._inputs.sample.pose, self._inputs.sample.raw
        off = float(np.linalg.norm(pose[:3, 3] - command.pose[:3, 3]))
        there = off < _ARRIVED_MM and turn_deg(pose, command.pose) < _ARRIVED_DEG
        if not (there and self._inputs.packet.speed_mm_s < _REST_MM_S):
            # The controller calls an arm steady once it has rested for half a second.
            self._steady_due = now + _STEADY_S
        elif now >= self._steady_due:
            self._steady_due = now + _STEADY_POLL_S
            if self._controller.command("isSteady"):
                self._controller.watch_rest()
                self._inputs.read(0.0)
                self._watch()
                # A motion that was asked to stop is never answered with "arrived".
                if self._latch.stop is None:
                    self._arrive(self._inputs.sample)
                return
        if there or raw != self._last_raw:
            self._last_raw, self._changed = raw, now
        text = ""
        slow = command.speed_mm_s * self._gate.plan.pendant.speed_fraction
        if now - self._changed > self._clock.patience(_FROZEN_S) + _FROZEN_MM / slow:
            text = f"the reported pose is frozen, {off:.2f} mm from the target of a motion"
        elif now > self._deadline:
            text = f"not arrived in time: {off:.2f} mm from the target"
        if text:
            self._latch.set(Stop(StoppedError(text, device="robot"), True))

    def _arrive(self, sample: PoseSample) -> None:
        self._moving = None
        self._inputs.answered = self._count
        self._caller.tell("arrived", move=self._count, sample=plain(sample))

    def _answer(self, error: DeviceError) -> None:
        self._inputs.answered = self._count
        self._caller.tell("error", move=self._count, ended=False, **told(error))

    def _halt(self) -> None:
        """Stop the robot as latched; returns only after a hesitation.

        Raises:
            Ended: after any other stop, or if the robot does not stop or is lost.
        """
        done: Stop | None = None
        while self._latch.stop is not None and self._latch.stop is not done:
            # Input is read while braking, so a stop for good may replace a hesitation.
            done = self._latch.stop
            self._caller.tell("stopping", **told(done.error))
            self._controller.brake()
        assert done is not None
        self._moving = None
        if done.for_good:
            if self._controller.usable():
                self._connection.end_script()
            raise Ended(done.error)
        if self._controller.usable():
            self._controller.watch_rest()
        self._latch.release()
        asked = self._inputs.moves[-1]["move"] if self._inputs.moves else self._count
        self._inputs.moves.clear()
        if asked > self._inputs.answered:
            self._count = asked
            self._answer(done.error)
