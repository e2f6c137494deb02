"""Asking the robot to move: one motion at a time, in a process that can always be killed.

By default :class:`Motion` makes a dry run: it checks and logs every motion and sends none. To move
the robot it needs the operator's confirmation of the plan, which is good for one connection. After
anything that ends motion (a stop, a protective stop, a reset connection, a stopped program) a new
confirmation is needed. A protective stop is reported; this software never releases it.

A stop is latched on both sides of the pipe: here in :attr:`Motion._stop`, in the other process as
described in :mod:`hw.robot.mover.control_loop`. There are two kinds of stops.

- A *stop* (:meth:`Motion.stop`, a guard that reports danger or fails, a log that fails or hangs, an
  interrupt such as Ctrl-C, a suspension of this process for more than 10 s, force, speed, the box,
  a protective stop, a motion that does not arrive) ends motion: :attr:`Motion.ended` is true, every
  later move is refused, and only a new confirmation lets the robot move again.
- A *hesitation* (StaleError: poses, echo frames, images or this process were silent for a moment)
  stops the robot in the same way, but the same move may be asked for again. Nothing said that
  moving was dangerous; for a moment the software could not know that it was safe.

Requests to move are counted, and stops and answers carry the count of their move, so that they are
never applied to another move.
"""

from __future__ import annotations

import contextlib
import json
import math
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import numpy as np

from hw.robot.confirmation import Confirmation
from hw.robot.identity import stop_program
from hw.robot.limits import CALLER_S, between
from hw.robot.motion_plan import MotionPlan
from hw.robot.mover.messages import (
    DASHBOARD_STOP,
    MAY_BE_PAUSED,
    WATCHDOG,
    Setup,
    error_of,
    line_of,
    sample_of,
    told,
)
from hw.robot.path_checks import check_plan
from hw.robot.stream import PoseSample
from hw.runtime.clock import HELD_UP_WALL_S, REAL, Clock, Waiting
from hw.runtime.errors import DeviceError, LostError, StaleError, StoppedError, refused
from hw.runtime.interrupts import heed_interrupt
from hw.runtime.processes import finish, spawn

Log = Callable[[float, str, dict[str, object]], None]
"""Takes bench time (s), the command, and its numbers."""
Guard = Callable[[], str | StaleError | None]
"""Called before a motion is requested and at every tick of it. A returned reason (str) stops the
robot and ends motion; a returned StaleError stops the robot as a hesitation."""

_TICK_S = 0.02
_START_PATIENCE_S, _START_TICK_S = 30.0, 0.1
# The controller's watchdog has stopped the robot long before; a busy machine gets time to answer.
_HANGS_WALL_S = 2.0
_ENDING_WALL_S = 3.0
_LOG_BEHIND_WALL_S = 2.0
"""A log that takes a line so much too late, or not at all, during motions stops the robot."""
_NO_ANSWER = "the controller's answers are lost"
_SUSPENDED_WALL_S = 10.0
"""After a longer suspension somebody may stand at the robot: it must not go on by itself."""


class Motion:
    """Moves the robot at ``host`` along one confirmed plan.

    Args:
        host: the controller's address.
        plan: what may be done.
        confirmation: of that plan; used up by :meth:`start`. None only for a dry run.
        clock: bench time.
        dry_run: check and log, but send nothing to the robot.
        log: called with every command (of the watchdog's kicks only with their number), every
            refusal and every stop, in a thread of its own. If it fails, or takes too long during a
            motion, the robot is stopped.
        guard: see :data:`Guard`; may be set at any time.
        caller_s: bench seconds that this process may be silent during a motion, e.g. held up by
            another thread, before the motion is stopped: while it is silent, no guard is called. At
            most 10 s.

    Raises:
        RefusedError: ``caller_s`` is no such time.
    """

    def __init__(
        self,
        host: str,
        plan: MotionPlan,
        confirmation: Confirmation | None,
        *,
        clock: Clock = REAL,
        dry_run: bool = True,
        log: Log | None = None,
        guard: Guard | None = None,
        caller_s: float = CALLER_S,
    ) -> None:
        self.host, self.plan, self.clock, self.dry_run = host, plan, clock, dry_run
        self.guard = guard
        self.tcp_offset: tuple[float, ...] | None = None
        """TCP offset of the controller (m, rad), once started; None where a dry run lacks it."""
        self.serial: str | None = None
        self._confirmation = confirmation
        self._log = log or (lambda t, command, numbers: None)
        self._to_log: queue.SimpleQueue[tuple[float, str, dict] | None] = queue.SimpleQueue()
        self._noted = self._logged = 0
        """Lines for the log so far, and those that it took."""
        self._log_waited, self._log_due = Waiting(REAL), 0
        """For how long, over all motions, it has not taken all lines up to this number."""
        between("caller_s", caller_s, 0.0, _SUSPENDED_WALL_S)
        self._caller_s = caller_s
        self._process: subprocess.Popen[bytes] | None = None
        self._threads: list[threading.Thread] = []
        self._answers: queue.SimpleQueue[dict] = queue.SimpleQueue()
        self._sending = threading.Lock()
        self._one_at_a_time = threading.Lock()
        self._ended: DeviceError | None = None
        self._stop: StoppedError | None = None
        """The stop asked for, never cleared: no move is sent or reported as arrived after it."""
        self._count = 0
        self._heard = 0.0
        self._told = math.inf
        """When the other process told something last; it does so all the time, also at rest."""
        self._in_motion = False
        self._last_word = False
        """Whether the other process has said that it ends."""
        self._may_be_paused = ""
        """What a person must do where that process could not end its program."""

    def start(self) -> Motion:
        """Connect; takes a second or two.

        Raises:
            RefusedError: no valid, unused confirmation for this plan and robot, or a plan outside
                its limits, or another TCP offset, payload or speed slider than the plan's.
            LostError: the controller does not answer.
        """
        if sys.platform == "win32":
            raise refused("the robot can be moved from Linux only")
        check_plan(self.plan)
        given = self._confirmation
        if not self.dry_run:
            if given is None:
                raise refused("motion needs the operator's confirmation")
            if not given.use.acquire(blocking=False):
                raise refused(
                    "this confirmation was used for an earlier connection; confirm the plan again"
                )
        setup = Setup(
            self.host, self.plan, given, self.clock, self.dry_run, self._caller_s
        ).message()
        try:
            with self._sending:
                # Here, since a stop that came before had nobody to be sent to. The setup must come
                # first: a stop that is asked for now waits until it is sent.
                if self._stop is not None:
                    self._ended = self._stop
                    raise refused(f"motion was stopped ({self._stop.args[0]})")
                self._process = spawn("hw.robot.mover", stdin=True)
                # A long setup fills the pipe: if the process does not read it, the write would
                # wait without end. Before it has read all of it, it has not connected.
                unread = threading.Timer(_START_PATIENCE_S, self._process.kill)
                unread.daemon = True
                unread.start()
                try:
                    self._write(setup)
                finally:
                    unread.cancel()
            for work in (self._receive, self._keep_log):
                self._threads.append(threading.Thread(target=work, name="motion", daemon=True))
                self._threads[-1].start()
            deadline = time.monotonic() + _START_PATIENCE_S
            answer: dict = {}
            self._told = time.monotonic()
            while not answer and time.monotonic() < deadline:
                with contextlib.suppress(queue.Empty):
                    answer = self._answers.get(timeout=_START_TICK_S)
                # It may be silent while it connects; this process waits in short steps.
                self._told = self._check_suspended()
        except BaseException:
            # In order: a program that it has sent already would run on until its watchdog ends it.
            # After a second interrupt the process ends by itself.
            self.close()
            raise
        if answer.get("what") != "ready":
            error = error_of(answer) or LostError(
                f"the controller at {self.host} did not accept the connection within "
                f"{_START_PATIENCE_S:g} s",
                device="robot",
            )
            self._kill(error)
            raise error
        self.serial = str(answer["serial"])
        offset = answer["tcp_offset"]
        self.tcp_offset = None if offset is None else tuple(offset)
        return self

    def __enter__(self) -> Motion:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def move_to(self, pose: np.ndarray, speed_mm_s: float | None = None) -> PoseSample:
        """Move in a straight line, and wait until the robot has arrived and is steady.

        Args:
            pose: (4, 4) mm, TCP -> robot base: a pose of the plan, or one in its search envelope.
            speed_mm_s: of TCP and tip; the cap by default.

        Returns:
            The pose at which the robot rests; in a dry run, the pose at which it would.

        Raises:
            RefusedError: the gate or the controller does not allow it; nothing moved. Or the TCP
                offset, payload or speed slider was changed: then the robot was stopped, and motion
                needs a new confirmation (:attr:`ended` tells).
            StaleError: a hesitation; the robot rests, and the move may be asked for again.
            StoppedError: stopped before arrival: by :meth:`stop`, the guard, force, speed, the box,
                a protective stop, or because it took too long. Motion needs a new confirmation.
            LostError: the connection is gone; motion needs a new confirmation.
        """
        with self._one_at_a_time:
            if self._in_motion:
                # An interrupt ended the last motion, and another one what was done about that.
                self.stop("interrupted")
            self.check()
            asked = np.asarray(pose).tolist()
            self._count += 1
            self._in_motion = True
            try:
                hesitation = self._ask_guard()
                if hesitation is not None:
                    self._in_motion = False
                    raise hesitation
                if self._stop is None:
                    self._send(
                        {
                            "request": "move",
                            "move": self._count,
                            "pose": asked,
                            "speed_mm_s": speed_mm_s,
                        }
                    )
                return self._wait(self._count)
            finally:
                if self._in_motion:
                    self._stop_and_wait()

    def _stop_and_wait(self) -> None:
        """Stop after an interrupt or a failed guard, before its exception goes on."""
        try:
            self.stop(_failure(sys.exc_info()[1]))
            self._in_motion = False
        finally:
            self._wait_for_end()

    def _wait_for_end(self) -> None:
        """Give the other process a moment to brake and to report its end; then kill it."""
        deadline = time.monotonic() + 0.5 + self.clock.wall(0.5)
        answer: dict = {}
        with contextlib.suppress(queue.Empty):
            while not answer.get("ended", False):
                answer = self._answers.get(timeout=max(0.0, deadline - time.monotonic()))
        self._kill(
            error_of(answer) or LostError("the motion process does not respond", device="robot")
        )

    def _wait(self, count: int) -> PoseSample:
        """Wait for a move's answer; a stop is sent again until the other process confirms it."""
        tick = max(0.001, self.clock.wall(_TICK_S))
        hesitation: StaleError | None = None
        stopping: DeviceError | None = None
        silence: LostError | None = None
        while True:
            asked_s = time.monotonic()
            try:
                answer = self._answers.get(timeout=tick)
            except queue.Empty:
                answer = {}
            if time.monotonic() - asked_s > tick + HELD_UP_WALL_S:
                # This process was held up, not the other one: what that told is still unread.
                self._heard = time.monotonic()
            error = error_of(answer)
            match answer.get("what"):
                case "arrived" if answer["move"] == count and self._stop is None:
                    # The robot arrived. Once a stop was asked for, this answer does not count.
                    self._in_motion = False
                    if hesitation is not None:
                        raise hesitation
                    return sample_of(answer["sample"])
                case "error" if error is not None and answer["ended"]:
                    self._in_motion = False
                    self._kill(error)
                    raise error
                case "error" if error is not None and answer["move"] == count:
                    # If a stop was asked for, its own answer follows and ends motion.
                    if self._stop is None:
                        self._in_motion = False
                        raise error if hesitation is None else hesitation
                case "stopping":
                    stopping = error
                case "hung":
                    silence = LostError(_NO_ANSWER, device="robot")
            if self._logged >= self._log_due:
                self._log_waited, self._log_due = Waiting(REAL), self._noted
            elif self._log_waited.so_far() > _LOG_BEHIND_WALL_S:
                self.stop("commands cannot be logged: the disk is too slow, hangs or is full")
            # Asked also while the robot brakes for a hesitation: it may tell of a danger now.
            told_now = self._ask_guard()
            hesitation = hesitation or told_now
            if self._stop is not None and type(stopping) is not StoppedError:
                self._send_stop(self._stop)
            elif hesitation is not None and stopping is None:
                self._send_stop(hesitation)
            self._send({"request": "heard"})
            silent = time.monotonic() - self._heard
            if silent > _HANGS_WALL_S + self.clock.wall(0.5):
                silence = LostError("the motion process does not respond", device="robot")
            if silence is not None:
                error = self._stop or stopping or silence
                self._in_motion = False
                self._kill(error)
                text = "; ".join(dict.fromkeys([error.args[0], silence.args[0]]))
                text = text if WATCHDOG in text else f"{text}; {WATCHDOG}"
                raise type(error)(f"{text}{self._may_be_paused}", device="robot")

    def _ask_guard(self) -> StaleError | None:
        """Ask the guard; a danger is latched and sent, a hesitation is returned."""
        heed_interrupt()
        if self.guard is None or self._stop is not None:
            return None
        reason = self.guard()
        if isinstance(reason, StaleError):
            return StaleError(str(reason.args[0]), device=reason.device)
        if reason is not None:
            self.stop(reason)
        return None

    def _send_stop(self, error: DeviceError) -> None:
        self._send({"request": "stop", "move": self._count, **told(error)})

    @property
    def ended(self) -> bool:
        """Whether motion is over for good, so that the plan must be confirmed again."""
        return self._ended is not None or self._stop is not None

    def stop(self, reason: str) -> None:
        """Stop the robot, for good: :attr:`ended` is true from now on.

        A :meth:`move_to` that waits in another thread raises StoppedError; a later one is refused.
        """
        self._stop = self._stop or StoppedError(reason, device="robot")
        self._send_stop(self._stop)

    def close(self) -> None:
        """Stop the robot, end its program, disconnect. Idempotent."""
        if self._process is None:
            return
        if self._process.poll() is None:
            self._send({"request": "close"})
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=8.0)
        self._kill(refused("motion was closed"))

    def check(self) -> None:
        """Raise the error if motion has ended, also where nothing was asked to move meanwhile.

        Raises:
            DeviceError: why it has ended.
        """
        if self._process is None:
            raise refused("motion was not started")
        if self._process.poll() is None:
            self._check_suspended()
        over = self._ended or self._stop
        if over is not None:
            raise refused(
                f"motion has ended ({over.args[0]}); confirm the plan again and start anew"
            )
        while not self._answers.empty():
            answer = self._answers.get()
            error = error_of(answer)
            if error is not None and answer.get("ended"):
                self._kill(error)
                raise error

    def _check_suspended(self) -> float:
        """Stop for good after a long suspension (Ctrl-Z); the time to which that was checked."""
        now = time.monotonic()
        silent = now - self._told
        if silent > _SUSPENDED_WALL_S + self.clock.wall(0.5):
            self.stop(
                f"this program, or the one that moves the robot, was suspended for {silent:.0f} s"
            )
        return now

    def _kill(self, error: DeviceError) -> None:
        self._ended = self._ended or error
        assert self._process is not None
        self._process.kill()
        finish(self._process, _ENDING_WALL_S)
        for thread in self._threads:
            # One may wait for a log that hangs, as where the disk does.
            if thread is not threading.current_thread():
                thread.join(_ENDING_WALL_S)

    def _send(self, message: dict) -> None:
        with self._sending:
            self._write(message)

    def _write(self, message: dict) -> None:
        process = self._process
        if process is None or process.stdin is None:
            return
        with contextlib.suppress(OSError, ValueError):
            process.stdin.write(line_of(message))
            process.stdin.flush()

    def _receive(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        try:
            with self._process.stdout as lines:
                for line in lines:
                    self._heard = self._told = self._check_suspended()
                    self._hear(json.loads(line))
        finally:
            what, text = "error", "the motion process ended; the robot's own watchdog stops it"
            if self._process.wait() == -signal.SIGALRM:
                what, text = "hung", f"{_NO_ANSWER}; {WATCHDOG}"
            self._end_program()
            text += self._may_be_paused
            self._answers.put({"what": what, "kind": "LostError", "text": text, "ended": True})
            self._to_log.put(None)

    def _end_program(self) -> None:
        """End the program of a process that ended without a word, as within a command (SIGALRM).

        A person or a safety stop may have paused it meanwhile: then it would go on with the motion
        when it is resumed, until its watchdog ends it.
        """
        if self._last_word or self.dry_run or self.serial is None:
            return
        self._note(self.clock.now(), DASHBOARD_STOP, {})
        if not stop_program(self.host):
            self._may_be_paused = f"; {MAY_BE_PAUSED}"

    def _note(self, t: float, command: str, values: dict[str, object]) -> None:
        self._noted += 1
        self._to_log.put((t, command, values))

    def _keep_log(self) -> None:
        """In a thread of its own: a log that waits for a disk holds up nothing else."""
        for line in iter(self._to_log.get, None):
            try:
                self._log(*line)
            except Exception as error:
                # Here nobody would see the exception.
                self.stop(f"the log failed: {type(error).__name__}: {error}")
            self._logged += 1

    def _hear(self, message: dict) -> None:
        self._last_word |= message["what"] == "closed" or bool(message.get("ended"))
        match message["what"]:
            case "log":
                self._note(message["t"], message["command"], message["numbers"])
            case "stopping":
                self._note(self.clock.now(), "stop", {"why": message["text"]})
                self._answers.put(message)
            case "alive" | "closed":
                pass
            case _:
                self._answers.put(message)


def _failure(error: BaseException | None) -> str:
    """Why a motion is stopped whose caller is left by an exception; it must not fail itself."""
    if error is None or isinstance(error, KeyboardInterrupt):
        return "interrupted"
    reason = f"the caller failed: {type(error).__name__}"
    with contextlib.suppress(Exception):
        reason += f": {error}"
    return reason
