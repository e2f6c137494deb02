"""Stops that the caller asks for, or that follow from its end, by the real ur_rtde."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict, replace
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from motions import (
    HOME,
    LIMITS,
    OFFSET,
    PLAN,
    SERIAL,
    STOP_WITHIN_S,
    beside,
    confirmed,
    moving,
    sent,
)
from robots import CB_SERIES, START, EmulatedRobot
from suspending import suspend
from waiting import until

from hw.robot.identity import read_identity
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.robot.mover.messages import Setup
from hw.runtime.errors import LostError, RefusedError, StaleError, StoppedError
from hw.runtime.interrupts import as_interrupts
from jaxcal.runtime.isolated import import_path

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")

pytestmark = pytest.mark.real_time


def test_a_hesitation_at_full_speed_leaves_the_watchdog_at_rest():
    """From 250 mm/s the arm brakes for longer than the controller's watchdog waits."""
    limits = replace(LIMITS, max_speed_mm_s=250.0, max_acceleration_mm_s2=2000.0)
    plan = MotionPlan(np.array([HOME, beside(50.0, 0.0, 0.0)]), limits, OFFSET, SERIAL)
    with EmulatedRobot(version=CB_SERIES) as robot, moving(robot, plan=plan) as motion:

        def guard() -> StaleError | None:
            fast = robot.state()["velocity"][0] > 0.24
            return StaleError("no frame", device="active echo") if fast else None

        motion.guard = guard
        with pytest.raises(StaleError, match="no frame"):
            motion.move_to(plan.targets[1])
        assert not motion.ended
        assert robot.state()["velocity"] == [0.0] * 6
        motion.guard = None
        np.testing.assert_allclose(motion.move_to(HOME).pose, HOME, atol=1e-6)


def test_a_guard_that_fails_stops_the_robot():
    def guard() -> str | None:
        if robot.state()["velocity"][0] > 0.04:
            raise ZeroDivisionError("of the guard")
        return None

    log: list = []

    with (
        EmulatedRobot(version=CB_SERIES) as robot,
        moving(robot, log, guard=guard, caller_s=2.0) as motion,
    ):
        with pytest.raises(ZeroDivisionError):
            motion.move_to(PLAN.targets[2])
        state = robot.state()
        assert state["rest_since"] is not None
        assert state["raw"][0] < START[0] + 0.049
        motion.guard = None
        why = "the caller failed: ZeroDivisionError: of the guard"
        with pytest.raises(RefusedError, match=rf"{why}\); confirm the plan again"):
            motion.move_to(HOME)
    assert why in [numbers.get("why") for _, command, numbers in log if command == "stop"]


@pytest.mark.parametrize("times", [1, 2])
def test_interrupts_while_connecting_leave_no_program_on_the_robot(times):
    """It is ended in order, not by its watchdog 2 s later."""
    with EmulatedRobot(version=CB_SERIES) as robot:

        def interrupt() -> None:
            until(lambda: robot.state()["running"])
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.05)

        def start(motion: Motion) -> None:
            watcher = threading.Thread(target=interrupt)
            watcher.start()
            try:
                motion.start()
            finally:
                while watcher.is_alive():
                    # An interrupt while suppress() itself runs would end this loop.
                    try:  # noqa: SIM105
                        watcher.join()
                    except KeyboardInterrupt:
                        pass

        for _ in range(5):
            motion = confirmed(robot)
            with as_interrupts(), suppress(KeyboardInterrupt):
                start(motion)
            if motion.serial is None:
                break
            # A busy machine may be too late, and another try is needed.
            motion.close()
            until(lambda: not robot.state()["running"])
        else:
            pytest.fail("motion was started five times in spite of an interrupt")
        assert motion._process is not None
        motion._process.wait(5.0)
        assert not robot.state()["running"]
        motion.close()


def test_a_mover_killed_before_its_first_command_leaves_no_program_on_the_robot():
    """The program itself ends when it hears nothing: nobody is left who could set a watchdog."""
    with EmulatedRobot(version=CB_SERIES) as robot, ThreadPoolExecutor(1) as pool:
        for _ in range(5):
            before = robot.state()["log"]
            motion = confirmed(robot)
            starting = pool.submit(motion.start)
            while not robot.state()["loading"] and not starting.done():
                pass
            assert motion._process is not None
            os.kill(motion._process.pid, signal.SIGKILL)
            in_time = robot.state()["loading"]
            failure = starting.exception(10.0)
            motion.close()
            if in_time:
                break
            # A busy machine may be too late, and another try is needed.
        else:
            pytest.fail("motion was started five times before the kill")
        assert isinstance(failure, LostError)
        until(lambda: robot.state()["running"])
        until(lambda: not robot.state()["running"], 10.0)
        state = robot.state()
        assert state["log"] == before
        assert state["reason"].startswith("watchdog: nothing written for 2.0")


_CALLER = """
import json, os, sys, time
import numpy as np
from hw.runtime.clock import Clock
from hw.robot.identity import read_identity
from hw.robot.limits import Limits
from hw.robot.motion import Motion
from hw.robot.confirmation import confirm_unattended
from hw.robot.motion_plan import MotionPlan
host, origin, targets, limits, offset, serial = json.loads(sys.argv[1])
clock = Clock(1.0, origin)
plan = MotionPlan(np.array(targets), Limits.from_mapping(limits), tuple(offset), serial)
given = confirm_unattended(plan, plan.digest, clock=clock)
with Motion(host, plan, given, clock=clock, dry_run=False) as motion:
    caller = os.getpid()
    if sys.argv[2] == "with a child" and os.fork() == 0:
        while os.getppid() == caller:
            time.sleep(0.02)
        time.sleep(5.0)
        os._exit(0)
    print("ready", flush=True)
    motion.move_to(plan.targets[2])
"""


@pytest.mark.parametrize("caller_is", ["alone", "with a child"])
def test_killing_the_caller_stops_the_robot(caller_is):
    """Also where a child of the caller holds its end of the pipe, which then stays open."""
    with EmulatedRobot() as robot:
        values = [
            robot.host, robot.clock.origin_s, PLAN.targets.tolist(), asdict(LIMITS), OFFSET,
            read_identity(robot.host).name,
        ]  # fmt: skip
        caller = subprocess.Popen(
            [sys.executable, "-c", _CALLER, json.dumps(values), caller_is],
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(import_path())},
        )  # fmt: skip
        with caller:
            assert caller.stdout is not None
            assert caller.stdout.readline() == b"ready\n"
            while math.hypot(*robot.state()["velocity"]) < 0.04:
                assert caller.poll() is None
                time.sleep(0.002)
            before = robot.state()["t"]
            children = Path(f"/proc/{caller.pid}/task/{caller.pid}/children").read_text().split()
            caller.kill()
        until(lambda: robot.state()["rest_since"] is not None, 5.0)
        state = robot.state()
        assert state["rest_since"] - before <= STOP_WITHIN_S
        assert state["raw"][0] < START[0] + 0.049
        # Nobody is left to end the process that moves the robot: it ends by itself.
        assert len(children) >= 1
        # In 4 s: the child of the caller, which lives for 5, does not end it.
        until(lambda: not any(map(is_mover, children)), 4.0)


def is_mover(process: str) -> bool:
    try:
        return b"hw.robot.mover" in Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False


def test_a_stop_before_the_start_or_at_rest_is_kept():
    with EmulatedRobot(version=CB_SERIES) as robot:
        motion = confirmed(robot)
        motion.stop("not today")
        with pytest.raises(RefusedError, match="was stopped"):
            motion.start()
        with moving(robot) as motion:
            motion.stop("the operator pressed stop")
            assert motion.ended
            with pytest.raises(RefusedError, match=r"the operator pressed stop.*confirm the plan"):
                motion.move_to(HOME)
        assert sent(robot, 3) == []


def test_a_stop_right_before_the_process_is_started_is_kept(monkeypatch):
    """There was nobody to tell of it yet, and the process that was started next connected."""
    motion = Motion("127.0.0.2", PLAN, None)

    def message(setup: Setup) -> dict:
        motion.stop("not today")
        return {}

    monkeypatch.setattr(Setup, "message", message)
    with pytest.raises(RefusedError, match=r"was stopped \(not today\)"):
        motion.start()
    assert motion._process is None


@pytest.mark.parametrize("moving_when", ["at rest", "in motion"])
def test_a_caller_that_was_suspended_for_long_does_not_go_on_by_itself(monkeypatch, moving_when):
    """It is really suspended, as by Ctrl-Z: somebody may have come near the robot meanwhile."""
    monkeypatch.setattr("hw.robot.motion._SUSPENDED_WALL_S", 0.2)
    script = f"sleep 0.3; kill -STOP {os.getpid()}; sleep 1; kill -CONT {os.getpid()}"
    with EmulatedRobot() as robot, moving(robot) as motion:
        with subprocess.Popen(["sh", "-c", script]) as suspending:
            if moving_when == "at rest":
                suspending.wait()
            with pytest.raises(
                (StoppedError, RefusedError), match="moves the robot, was suspended for"
            ):
                motion.move_to(PLAN.targets[2])
        assert motion.ended
        assert len(sent(robot, 3)) == (moving_when == "in motion")
        assert robot.state()["velocity"] == [0.0] * 6
        with pytest.raises(RefusedError, match=r"suspended for .*confirm the plan"):
            motion.move_to(PLAN.targets[2])


def test_a_process_that_was_suspended_at_rest_is_named(monkeypatch):
    """The caller was blamed alone, which had asked for nothing meanwhile."""
    monkeypatch.setattr("hw.robot.motion._SUSPENDED_WALL_S", 0.2)
    with EmulatedRobot() as robot, moving(robot) as motion:
        assert motion._process is not None
        suspend(motion._process.pid)
        time.sleep(0.8)
        with pytest.raises(RefusedError, match="or the one that moves the robot, was suspended"):
            motion.check()
        os.kill(motion._process.pid, signal.SIGCONT)


def test_a_caller_that_was_suspended_while_it_connects_does_not_move(monkeypatch):
    monkeypatch.setattr("hw.robot.motion._SUSPENDED_WALL_S", 0.2)
    script = f"sleep 0.2; kill -STOP {os.getpid()}; sleep 1; kill -CONT {os.getpid()}"
    with EmulatedRobot() as robot:
        motion = confirmed(robot)
        with (
            subprocess.Popen(["sh", "-c", script]),
            pytest.raises((RefusedError, StoppedError), match="moves the robot, was suspended for"),
            motion,
        ):
            motion.move_to(PLAN.targets[2])
        assert motion.ended
        assert sent(robot, 3) == []


def test_a_stop_while_it_connects_is_heard():
    """At once after the setup, so that both may be read together; no program is sent any more."""
    with EmulatedRobot(version=CB_SERIES) as robot, ThreadPoolExecutor(1) as pool:
        motion = confirmed(robot)
        with closing(motion):
            started = pool.submit(motion.start)
            until(lambda: motion._process)
            motion.stop("the operator")
            with pytest.raises(StoppedError, match="the operator"):
                started.result()
            with pytest.raises(RefusedError, match="the operator"):
                motion.check()
        state = robot.state()
        assert not state["loading"]
        assert not state["running"]
        # Of the last program that ended.
        assert state["reason"] == ""


def test_a_danger_told_after_a_hesitation_ends_motion():
    """The robot still brakes for the hesitation when the guard tells of the danger."""
    told: list[str | StaleError] = []

    def guard() -> str | StaleError | None:
        if robot.state()["velocity"][0] < 0.04 and not told:
            return None
        told.append("danger" if told else StaleError("no frame", device="active echo"))
        return told[-1]

    with (
        EmulatedRobot(version=CB_SERIES) as robot,
        moving(robot, guard=guard, caller_s=2.0) as motion,
    ):
        with pytest.raises(StoppedError, match="danger"):
            motion.move_to(PLAN.targets[2])
        assert motion.ended


def test_an_interrupt_that_was_dropped_stops_the_robot():
    """As it would be in a callback of the garbage collector that runs meanwhile."""
    times: list[float] = []

    def guard() -> None:
        if not times and robot.state()["velocity"][0] > 0.04:
            times.append(robot.state()["t"])
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)

    with (
        EmulatedRobot(version=CB_SERIES) as robot,
        as_interrupts(),
        moving(robot, guard=guard, caller_s=2.0) as motion,
    ):
        with pytest.raises(KeyboardInterrupt):
            motion.move_to(PLAN.targets[2])
        assert motion.ended
        assert robot.state()["rest_since"] - times[0] <= STOP_WITHIN_S


def test_a_log_that_fails_stops_the_robot():
    times: list[float] = []

    def log(t: float, command: str, numbers: dict[str, object]) -> None:
        if command == "moveL":
            times.append(t)
            raise OSError("no space left on device")

    with EmulatedRobot(version=CB_SERIES) as robot:
        with confirmed(robot, log=log, caller_s=2.0) as motion:
            with pytest.raises(StoppedError, match="the log failed: OSError: no space left"):
                motion.move_to(PLAN.targets[2])
            assert motion.ended
        state = robot.state()
    assert state["rest_since"] - times[0] <= STOP_WITHIN_S
    assert state["reason"] == "the client stopped the script"


def test_a_log_that_hangs_does_not_hold_up_who_is_told_of_the_end(monkeypatch):
    """As where the disk hangs: the end of the motion was told only once the log went on."""
    for name in ("_LOG_BEHIND_WALL_S", "_ENDING_WALL_S"):
        monkeypatch.setattr(f"hw.robot.motion.{name}", 0.2)
    hanging = threading.Event()

    def log(t: float, command: str, numbers: dict[str, object]) -> None:
        if command == "moveL":
            hanging.wait(6.0)

    with (
        EmulatedRobot(version=CB_SERIES) as robot,
        confirmed(robot, log=log, caller_s=2.0) as motion,
    ):
        began = time.monotonic()
        with pytest.raises(StoppedError, match="cannot be logged: the disk is too slow, hangs or"):
            motion.move_to(PLAN.targets[2])
        assert time.monotonic() - began < 3.0
        # In order, and not by its watchdog.
        assert robot.state()["reason"] == "the client stopped the script"
        hanging.set()


@pytest.mark.parametrize("line_s", [30.0, 0.4], ids=["hangs", "slow"])
def test_a_log_that_falls_behind_over_short_moves_is_noticed(monkeypatch, line_s):
    """Each move, and each line, began to wait anew; most lines were lost at the end."""
    monkeypatch.setattr("hw.robot.motion._LOG_BEHIND_WALL_S", 1.5)
    monkeypatch.setattr("hw.robot.motion._ENDING_WALL_S", 0.2)
    hanging = threading.Event()

    def log(t: float, command: str, numbers: dict[str, object]) -> None:
        hanging.wait(line_s)

    def move_on(motion: Motion) -> None:
        for row in (1, 0) * 5:
            motion.move_to(PLAN.targets[row])

    with EmulatedRobot(speed=3.0) as robot, confirmed(robot, log=log, caller_s=6.0) as motion:
        with pytest.raises(StoppedError, match="commands cannot be logged"):
            move_on(motion)
        hanging.set()


def test_a_log_that_is_slow_at_rest_is_no_suspension(monkeypatch):
    """A disk that took nothing for ten seconds ended the run, with this reason."""
    monkeypatch.setattr("hw.robot.motion._SUSPENDED_WALL_S", 0.5)
    slow = threading.Event()

    def log(t: float, command: str, numbers: dict[str, object]) -> None:
        if command == "isSteady" and not slow.is_set():
            slow.set()
            time.sleep(1.5)

    with EmulatedRobot() as robot, confirmed(robot, log=log, caller_s=0.4) as motion:
        motion.move_to(PLAN.targets[1])
        time.sleep(1.2)
        motion.move_to(HOME)


def test_an_interrupt_within_what_an_interrupt_did_is_kept():
    """Ctrl-C twice: the second came before the first had latched its stop."""

    def interrupted() -> None:
        sys.settrace(interrupt_the_stop)
        raise KeyboardInterrupt

    def interrupt_the_stop(frame: FrameType, event: str, value: object) -> None:
        if frame.f_code is Motion._stop_and_wait.__code__:
            # Python stops tracing with it.
            raise KeyboardInterrupt

    motion = Motion("127.0.0.2", PLAN, None, guard=interrupted)
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        motion._process = process
        with pytest.raises(KeyboardInterrupt):
            motion.move_to(HOME)
        motion.guard = None
        with pytest.raises(RefusedError, match=r"motion has ended \(interrupted\)"):
            motion.move_to(HOME)
        assert motion.ended
        assert process.stdin is not None
        process.stdin.close()
        assert process.stdout is not None
        requests = [json.loads(line)["request"] for line in process.stdout]
        assert requests == ["stop"]
