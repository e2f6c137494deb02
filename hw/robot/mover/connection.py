"""Opening the connection that commands the robot, and ending it in order."""

from __future__ import annotations

import os
import signal
import socket
import threading
from contextlib import suppress

from hw.robot.gate import Gate
from hw.robot.identity import LOCAL, read_identity, stop_program, until_local
from hw.robot.limits import numbers
from hw.robot.mover.controller import IDLE_WATCHDOG_HZ, STOP_PATIENCE_S, Controller, said
from hw.robot.mover.inputs import Ended, Inputs
from hw.robot.mover.messages import DASHBOARD_STOP, MAY_BE_PAUSED, Setup
from hw.robot.mover.no_reconnect import NoReconnect
from hw.robot.mover.program import guarded_program, send_program
from hw.robot.path_checks import check_plan
from hw.robot.rtde import (
    FREEDRIVE_PRESSED,
    PORT,
    PROGRAM_RUNS,
    PacketReader,
    check_latency,
    safety_text,
    state_text,
)
from hw.runtime.clock import Lag
from hw.runtime.errors import LostError, refused
from hw.runtime.extras import require
from hw.runtime.processes import ASKS, RECEIVES, be_prompt

_START_S = 30.0
"""Longest time for ur_rtde to connect."""
_END_S = 5.0
"""Longest time for the end of the script and of the connection."""
_CONTROL_S = 0.2
"""The dashboard is asked so often (wall s) whether the robot is still in remote control."""


class Connection:
    """The life of the connection to one controller.

    Args:
        setup: what the caller asks for.
        gate: asked before the controller is commanded.
        inputs: takes the controller's packets.
        controller: given the control connection, except in a dry run.
    """

    def __init__(self, setup: Setup, gate: Gate, inputs: Inputs, controller: Controller) -> None:
        self._setup, self._gate = setup, gate
        self._clock, self._inputs, self._controller = setup.clock, inputs, controller
        self._max_age_s = setup.plan.limits.max_pose_age_s
        self._no_reconnect: NoReconnect | None = None

    def open(self) -> None:
        """Connect: to the poses alone in a dry run.

        Raises:
            DeviceError: the robot is another, cannot take a program now, or does not answer.
            Ended: a connection was lost, a stop is latched, or the caller has left.
        """
        setup, inputs, controller = self._setup, self._inputs, self._controller
        check_plan(setup.plan)
        identity = read_identity(setup.host)
        controller.serial = identity.name
        self._read_packets()
        if setup.dry_run:
            return
        offset = inputs.tcp_offset or setup.plan.tcp_offset
        self._gate.check_start(identity.name, offset, inputs.pendant)
        self._check_state(identity.remote)
        module = require("rtde_control", extra="robot")
        controller.log("connect", host=setup.host, serial=identity.name)
        try:
            # A silent controller would hold this for ever, and the caller may be gone.
            _end_within(_START_S)
            program = guarded_program(module, setup.host, IDLE_WATCHDOG_HZ)
            self._no_reconnect = NoReconnect(setup.host)
            before = set(os.listdir("/proc/self/fd"))
            # The thread that ur_rtde starts inherits this priority.
            be_prompt(RECEIVES)
            flags = module.RTDEControlInterface.FLAG_CUSTOM_SCRIPT
            flags |= module.RTDEControlInterface.FLAG_NO_WAIT
            rtde_control = module.RTDEControlInterface(setup.host, -1.0, flags)
        except RuntimeError as error:
            raise LostError(said(error), device="robot") from None
        finally:
            be_prompt(ASKS)
        controller.answers = _connection_among(set(os.listdir("/proc/self/fd")) - before)
        self._no_reconnect.begin()
        # To connect took a second or more, in which a person may have started a program.
        self._check_state(identity.remote)
        with send_program(self._no_reconnect.connect, setup.host, program):
            self._wait_for_packet(running=True)
        _end_within(0.0)
        controller.rtde_control = rtde_control
        controller.watch_rest()
        if inputs.tcp_offset is None:
            inputs.tcp_offset = numbers(controller.command("getTCPOffset"), 6, "TCP offset")
        self._gate.check_authority(identity.name, inputs.tcp_offset, inputs.pendant)
        inputs.program_started = True
        # What they tell of was before our program.
        inputs.unseen()
        if identity.remote:
            threading.Thread(target=self._watch_control, name="control", daemon=True).start()

    def _read_packets(self) -> None:
        reader = PacketReader(self._setup.host)
        asked_s, stamp_s = reader.bound
        lag = Lag(self._clock.at(asked_s), stamp_s)
        oldest = self._clock.patience(self._max_age_s)
        check_latency(reader.latency_s * self._clock.speed, oldest)
        self._inputs.attach(reader, lag)
        self._wait_for_packet()

    def _wait_for_packet(self, *, running: bool = False) -> None:
        """Read until the newest packet is fresh: many may have come while nobody read them.

        Args:
            running: wait until a program runs, too.

        Raises:
            LostError: it takes too long.
        """
        inputs, oldest = self._inputs, self._clock.patience(self._max_age_s)
        give_up = self._clock.now() + 2.0 + self._clock.speed
        while self._clock.now() < give_up:
            inputs.read(self._clock.wall(0.01))
            if (
                inputs.connected
                and inputs.sample.age_s(self._clock.now()) <= oldest
                and (not running or inputs.packet.status_bits & PROGRAM_RUNS)
            ):
                return
        raise LostError("the controller sends no fresh poses, or runs no program", device="robot")

    def _check_state(self, remote: bool | None) -> None:
        """Whether the robot can take a program now: ours would end whatever runs, unasked.

        Raises:
            RefusedError: it cannot.
            Ended: a stop is latched, or the caller has left: no program is needed any more.
        """
        self._wait_for_packet()
        packet = self._inputs.packet
        problem = LOCAL if remote is False else ""
        problem = problem or state_text(packet.robot_mode, packet.safety_bits)
        if not problem and packet.status_bits & FREEDRIVE_PRESSED:
            problem = "the freedrive button is pressed: somebody guides the arm"
        # The program of a connection that was lost ends by its watchdog.
        give_up = self._clock.now() + self._clock.patience(1.1 / IDLE_WATCHDOG_HZ)
        while not problem and self._inputs.packet.program:
            if self._clock.now() > give_up:
                problem = "a program runs on the robot, or is paused: stop it at the pendant"
            self._inputs.read(self._clock.wall(0.01))
        if problem:
            raise refused(problem)
        stop = self._inputs.latch.stop
        if stop is not None:
            raise Ended(stop.error)
        if self._inputs.left:
            raise Ended(refused("motion was closed"))

    def _watch_control(self) -> None:
        """In a thread of its own: no packet tells whether the robot is in remote control."""
        be_prompt(0)
        assert self._no_reconnect is not None
        until_local(self._setup.host, period_s=_CONTROL_S, connect=self._no_reconnect.connect)
        self._controller.local = True

    def close(self) -> None:
        """Stop, and end the script in order: its watchdog must not trip.

        The connection ends with this process: ur_rtde would take half a second to disconnect.

        Raises:
            Ended: the robot does not stop, or is lost.
        """
        _end_within(2 * STOP_PATIENCE_S + _END_S)
        self._controller.brake()
        if self._controller.usable():
            self.end_script()
        self.end_paused()

    def end_script(self) -> None:
        """End our program; the robot must rest."""
        self._controller.log("kickWatchdog", times=self._controller.kicks)
        self._controller.command("stopScript", within_s=_END_S)

    def end_paused(self) -> str:
        """End a program that a safety stop or a person has paused: it might be let go on.

        A paused program reads no commands, so the dashboard is asked. If the program is let go on
        before the dashboard has ended it, the robot is stopped.

        Returns:
            What a person must do if it could not be ended.
        """
        if self._controller.rtde_control is None or self._inputs.program_ended:
            return ""
        packet = self._inputs.packet
        if not packet.program or not (packet.paused or safety_text(packet.safety_bits)):
            return ""
        self._controller.log(DASHBOARD_STOP)
        assert self._no_reconnect is not None
        connect, stopped = self._no_reconnect.connect, threading.Event()

        def ask() -> None:
            if stop_program(self._setup.host, connect=connect):
                stopped.set()

        asking = threading.Thread(target=ask, name="dashboard", daemon=True)
        asking.start()
        with suppress(Ended):
            while asking.is_alive() and not self._controller.usable():
                self._inputs.read(self._clock.wall(0.01))
        self._controller.stop_unseen()
        asking.join()
        return "" if stopped.is_set() else f"; {MAY_BE_PAUSED}"


def _connection_among(descriptors: set[str]) -> socket.socket:
    """The one to the controller's real-time data.

    Raises:
        LostError: it is not among them, or is gone.
    """
    for number in descriptors:
        # Another file, or a connection that has just ended.
        with suppress(OSError):
            found = socket.socket(fileno=os.dup(int(number)))
            if found.getpeername()[1] == PORT:
                return found
            found.close()
    raise LostError("the control connection was reset", device="robot")


def _end_within(seconds: float) -> None:
    """Let the system end this process after so long, whatever it hangs in; 0: not any more."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, seconds)
