"""The robot's controller: the only commands that are sent to it, its watchdog, and braking.

How ur_rtde behaves, and what is done about it (each measured):

- A getter of a lost connection returns the last values, so freshness comes from
  :class:`hw.robot.rtde.PacketReader`.
- Calls to a silent controller hang and hold the interpreter's lock, so the system ends this
  process (SIGALRM), and the controller's own watchdog stops the robot 0.1 s after the last sign of
  life.
- A connection that was reset is opened again, and the script sent again, without asking; so it is
  kept from that (:mod:`hw.robot.mover.no_reconnect`), and the system is asked about its connection:
  a reset ends the motion for good, and so do lost answers.
- A motion goes on after a disconnect, so the robot is stopped first.
"""

from __future__ import annotations

import math
import signal
import socket
import struct
from contextlib import suppress
from typing import Any

from hw.robot.mover.inputs import Ended, Inputs, lost
from hw.robot.mover.messages import Caller, Setup
from hw.robot.rtde import PROGRAM_RUNS, Packet, safety_text, state_text
from hw.runtime.errors import DeviceError, LostError, StoppedError
from hw.runtime.processes import ASKS, be_prompt
from hw.runtime.rigid import apart

_WATCHDOG_HZ, IDLE_WATCHDOG_HZ = 10.0, 0.5
"""The controller stops its program, and the robot, when it hears nothing for 0.1 s during a motion;
at rest it waits for 2 s."""
_KICK_S = 0.02
_STOP_M_S2 = 2.0
_STOPPED_MM_S, _STOPPED_RAD_S = 1.0, 0.01
"""Below these speeds the TCP counts as at rest; a real arm's reading is never quite zero."""
_REST_SEEN_S, _STILL_MM = 0.1, 0.03
"""A stop is done when the poses have shown rest for so long after stopL, and differ by no more than
this (a degree counts as a mm; an assumption: more than a real arm's readings differ by): a motion
may be slower than the speeds above."""
_STOP_AGAIN_S = 0.05
"""stopL is sent again to a robot that still moves after this time."""
_BRAKES_S = 0.5
"""A robot that still moves so long after stopL does not heed it: four times as long as braking from
250 mm/s takes."""
STOP_PATIENCE_S = 2.0
"""Longest wait for poses that show rest."""
_TCP_INFO, _ESTABLISHED = struct.Struct("=B51xI"), 1
"""State of a connection and milliseconds since its last data, in Linux's ``struct tcp_info``."""
_UNHEARD_S = 0.5
"""The controller's answers are lost if none came for so long (wall s), while poses come in time:
sending a lost packet again takes 0.2 s."""
_LEAST_WAIT_S = 0.1
"""A command may wait for its answer at least so long (wall s)."""
PAUSED = "the program was paused on the robot; then confirm the plan again"
_CAUSE_S = 0.1
"""The poses tell of a safety stop by so much later than the controller's program ends."""


class Controller:
    """Sends commands, and knows whether the controller takes them.

    Args:
        setup: clock and limits.
        inputs: the controller's packets; read while it brakes.
        caller: told of every command before it is sent.
    """

    def __init__(self, setup: Setup, inputs: Inputs, caller: Caller) -> None:
        self.serial = ""
        """Which robot is connected: :attr:`hw.robot.identity.Identity.name`."""
        self.rtde_control: Any = None
        """ur_rtde's interface; None before motion may begin, and in a dry run."""
        self.answers: socket.socket | None = None
        """The connection over which ur_rtde hears the controller."""
        self.local = False
        """Whether a person has switched the robot to local control."""
        self.kicks = 0
        self._kicked = -math.inf
        self._clock, self._inputs, self._caller = setup.clock, inputs, caller
        self._max_age_s = setup.plan.limits.max_pose_age_s

    # Commands

    def command(self, name: str, *values: object, within_s: float = _UNHEARD_S) -> object:
        """One command to the controller; the caller is told of every one before it is sent.

        Args:
            name: of ur_rtde's function.
            values: its arguments.
            within_s: see :meth:`_call`.

        Raises:
            Ended: the controller's program has stopped, or its answers are lost.
        """
        self.check_answers()
        self.log(name, values=values)
        return self._call(name, *values, within_s=within_s)

    def check_answers(self) -> None:
        """Check that ur_rtde hears the controller: its commands wait for answers for seconds.

        Raises:
            Ended: nothing came for :data:`_UNHEARD_S`.
        """
        if self._connection()[1] > 1000 * _UNHEARD_S:
            raise Ended(lost("the controller's answers are lost"))

    def _connection(self) -> tuple[int, int]:
        """State of ur_rtde's connection, and for how long (ms) nothing came, read or not."""
        assert self.answers is not None
        info = self.answers.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size)
        return _TCP_INFO.unpack(info)

    @property
    def connected(self) -> bool:
        """Whether the control connection stands; ur_rtde may notice later that it does not."""
        return self.rtde_control.isConnected() and self._connection()[0] == _ESTABLISHED

    def _call(self, name: str, *values: object, within_s: float = _UNHEARD_S) -> object:
        """Call a function of ur_rtde.

        The process ends if no answer comes for ``within_s`` (wall s), counted from what came last;
        the caller is told why by the signal that ended it.

        Raises:
            Ended: the controller's program has stopped.
        """
        if self._inputs.sample.age_s(self._clock.now()) > self._max_age_s:
            # The controller is silent: ur_rtde would spin for seconds at real-time priority.
            be_prompt(0)
        outer_s, _ = signal.getitimer(signal.ITIMER_REAL)
        wait_s = max(_LEAST_WAIT_S, within_s - self._connection()[1] / 1000)
        signal.setitimer(signal.ITIMER_REAL, min(wait_s, outer_s or wait_s))
        try:
            return getattr(self.rtde_control, name)(*values)
        except RuntimeError as error:
            failure = said(error)
        finally:
            signal.setitimer(signal.ITIMER_REAL, outer_s)
            be_prompt(ASKS)
        raise Ended(self.program_stopped(failure))

    def log(self, command: str, **numbers: object) -> None:
        """Tell the caller of a command, or of what stands for one."""
        self._caller.tell("log", t=self._clock.now(), command=command, numbers=numbers)

    def move(self, raw: list[float], speed_m_s: float, acceleration_m_s2: float) -> None:
        """Begin a motion, and return at once.

        Raises:
            Ended: the controller did not take it.
        """
        if not self.command("moveL", raw, speed_m_s, acceleration_m_s2, True):
            raise Ended(self.program_stopped("the controller did not take the motion"))
        self._kicked = self._clock.now()

    # The watchdog

    def watch_motion(self) -> None:
        """Let the controller's watchdog wait for as long as it may during a motion."""
        self.command("setWatchdog", _WATCHDOG_HZ / self._clock.patience(1.0))

    def watch_rest(self) -> None:
        """Let the controller's watchdog wait for as long as it may at rest."""
        self.command("setWatchdog", IDLE_WATCHDOG_HZ)

    def kick(self) -> None:
        """Give the watchdog a sign of life, if it is due.

        Raises:
            Ended: the controller's program has stopped.
        """
        now = self._clock.now()
        if self.rtde_control is None or self._inputs.program_ended:
            return
        if now - self._kicked > _KICK_S:
            self._kicked = now
            self.kicks += 1
            if not self._call("kickWatchdog"):
                raise Ended(self.program_stopped())

    # Stopping

    def brake(self) -> None:
        """Send stopL until the poses show rest, as long as the controller takes commands.

        Raises:
            Ended: the robot does not stop, or is lost. With the process's end the watchdog hears no
                more, and stops the controller's program.
        """
        give_up = self._clock.now() + self._clock.patience(STOP_PATIENCE_S)
        before, taken_s = self._inputs.packet.tcp_pose, math.inf
        while self.usable():
            # Asynchronous: a call that waits for rest would hold the watchdog's kicks back, and
            # braking may take longer than the watchdog waits. The poses show what stopL did.
            self.command("stopL", _STOP_M_S2, True)
            taken_s = min(taken_s, self._clock.now())
            if self._rests():
                return
            late_s = self._inputs.sample.measured_s - taken_s
            if late_s > self._clock.patience(_BRAKES_S) or self._clock.now() > give_up:
                text = "the robot was told to stop and still moves: press the emergency stop"
                if self._inputs.packet.tcp_pose == before:
                    text = (
                        "the robot was told to stop, but nothing shows that it rests, since the "
                        "reported pose is frozen: press the emergency stop if it moves"
                    )
                raise Ended(LostError(text, device="robot"))

    def stop_unseen(self) -> None:
        """Send stopL once, where nobody will see whether the robot rests then."""
        with suppress(Ended):
            if self.usable():
                self.command("stopL", _STOP_M_S2, True)

    def _rests(self) -> bool:
        """Whether the poses show rest for :data:`_REST_SEEN_S`; False: send stopL again."""
        sent = since = self._inputs.packet.timestamp_s
        place = self._inputs.sample.pose
        give_up = self._clock.now() + self._clock.patience(3 * _REST_SEEN_S)
        while self._clock.now() < give_up:
            # A stop for good that comes now replaces a hesitation.
            self._inputs.read(self._clock.wall(_REST_SEEN_S / 12))
            self.kick()
            packet = self._inputs.packet
            pose = self._inputs.sample.pose
            if packet.timestamp_s > since and (_moves(packet) or apart(pose, place) > _STILL_MM):
                since, place = packet.timestamp_s, pose
                if since - sent > _STOP_AGAIN_S:
                    return False
            if packet.timestamp_s - since >= _REST_SEEN_S:
                return True
        return False

    # State

    def usable(self) -> bool:
        """Whether the controller takes commands; if not, calls of ur_rtde hang or reconnect."""
        return bool(
            self.rtde_control is not None
            and self.connected
            and self._inputs.packet.status_bits & PROGRAM_RUNS
            and not self._inputs.program_ended
            and not self._inputs.packet.paused
            and not safety_text(self._inputs.packet.safety_bits)
        )

    def program_stopped(self, what: str = "the controller's program stopped") -> DeviceError:
        """Why the controller takes no commands: a stop or pause if one is told, else ``what``.

        Raises:
            Ended: the connection is lost.
        """
        inputs = self._inputs
        give_up = self._clock.now() + self._clock.patience(_CAUSE_S)
        while self._clock.now() < give_up:
            inputs.read(self._clock.wall(_CAUSE_S / 10))
            for packet in inputs.unseen():
                stopped = unfit(packet)
                if stopped is not None:
                    return stopped
        if inputs.packet.paused:
            return StoppedError(PAUSED, device="robot")
        if inputs.program_ended and inputs.packet.program:
            text = "another program was started on the robot: stop it at the pendant"
            return StoppedError(f"{text}, then confirm the plan again", device="robot")
        return lost(what)


def _moves(packet: Packet) -> bool:
    return packet.speed_mm_s > _STOPPED_MM_S or packet.turning_rad_s > _STOPPED_RAD_S


def unfit(packet: Packet) -> StoppedError | None:
    """The stop if the robot is not fit to move: a safety stop, or a mode other than running."""
    problem = state_text(packet.robot_mode, packet.safety_bits)
    if not problem:
        return None
    return StoppedError(f"{problem}; then confirm the plan again", device="robot")


def said(error: RuntimeError) -> str:
    """An error of ur_rtde; some of its texts begin with its name."""
    if "registers are already in use" in str(error):
        # Its own text speaks of fieldbuses alone.
        return "another program commands this robot, or a fieldbus uses its RTDE input registers"
    return f"ur_rtde: {str(error).removeprefix('ur_rtde: ')}"
