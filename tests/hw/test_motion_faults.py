"""Every fault of the robot, of its controller and of its pendant, by the real ur_rtde."""

from __future__ import annotations

import math
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from motions import (
    HOME,
    PLAN,
    SERIES,
    STOP_WITHIN_S,
    farther,
    moving,
    only_asked,
    put_in_order,
    sent,
)
from robots import CB_SERIES, E_SERIES, EmulatedRobot
from suspending import suspend
from waiting import until

from hw.robot.identity import stop_program
from hw.robot.limits import CALLER_S
from hw.robot.motion import Motion
from hw.runtime.errors import DeviceError, LostError, RefusedError, StaleError, StoppedError
from hw.runtime.processes import ANSWERS
from jaxcal.runtime.isolated import import_path

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")

pytestmark = pytest.mark.real_time

BOTH = list(SERIES)


@pytest.fixture(scope="module")
def robots() -> Iterator[dict[str, EmulatedRobot]]:
    """One of each series, for tests that leave it in order and take the arm as it stands."""
    with ExitStack() as stack:
        yield {
            series: stack.enter_context(EmulatedRobot(version=version))
            for series, version in SERIES.items()
        }


def fault_in_motion(
    robot: EmulatedRobot, motion: Motion, fault: Callable[[], object]
) -> tuple[DeviceError, float, float]:
    """What the caller was told, and how long robot and caller took (bench s)."""
    target = farther(robot)
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(motion.move_to, target)
        hesitations = 0
        while math.hypot(*robot.state()["velocity"]) < 0.04:
            if future.done():
                error = future.exception()
                assert type(error) is StaleError, f"over before the fault: {error}"
                assert not motion.ended
                # A busy machine held one of the processes up: asked for again, as the stage does.
                hesitations += 1
                assert hesitations < 5, f"over before the fault: {error}"
                future = pool.submit(motion.move_to, target)
            time.sleep(0.002)
        before = robot.state()["t"]
        fault()
        error = future.exception(timeout=20.0)
        told = robot.clock.now() - before
    assert isinstance(error, DeviceError)
    until(lambda: robot.state()["rest_since"] is not None, 5.0)
    state = robot.state()
    assert only_asked(state)
    assert "\n" not in str(error)
    # It stopped on the way, and did not merely arrive.
    assert abs(1000.0 * state["raw"][0] - target[0, 3]) > 1.0
    return error, state["rest_since"] - before, told


def signal_mover(motion: Motion, number: signal.Signals) -> None:
    assert motion._process is not None
    os.kill(motion._process.pid, number)


FAULTS = [
    # How soon the robot rests depends on the rate of packets and commands: at both.
    ("mute", BOTH, StaleError, "no fresh pose", True),
    ("drop", BOTH, LostError, "new confirmation", True),
    ("guard", BOTH, StoppedError, "30 echo frames were lost", True),
    ("stop", BOTH, StoppedError, "the operator", True),
    ("kill", BOTH, LostError, "motion process ended", True),
    ("unreadable", BOTH, LostError, "a packet holds NaN or Inf", True),
    ("silent", BOTH, StaleError, "the caller was silent", False),
    # The same stop for another reason.
    ("end", ["CB"], StoppedError, r"process was asked to end \(SIGTERM\)", True),
    ("hesitation", ["CB"], StaleError, "no frame for 0.2 s", False),
    ("protective_stop", ["CB"], StoppedError, "protective stop: find its cause", True),
    ("off", ["CB"], StoppedError, "powered off: switch the robot on and release", True),
    ("backdrive", ["e"], StoppedError, "in backdrive: leave backdrive at the pendant", True),
    ("emergency", ["e"], StoppedError, "robot emergency stop: release the button, then", True),
    ("freedrive", ["CB"], StoppedError, "the freedrive button was pressed", True),
    ("unknown bit", ["e"], StoppedError, "safety bits 0x1001: check the pendant", True),
    ("force", ["CB"], StoppedError, r"a force of 40.0 N", True),
    ("payload", ["CB"], RefusedError, "payload is 2.0 kg", True),
    ("speed_slider", ["e"], RefusedError, "speed slider is at 50 %, not 100", True),
    # A CB controller does not tell its TCP offset among its real-time data.
    ("tcp_offset", ["e"], RefusedError, "TCP offset was changed", True),
]


@pytest.mark.parametrize("fault", FAULTS, ids=[fault[0] for fault in FAULTS])
def test_the_robot_rests_within_200_ms_of_a_fault(robots, fault):
    name, at, *expected = fault
    with ThreadPoolExecutor(len(at)) as pool:
        for done in [pool.submit(check_fault, robots[series], name, *expected) for series in at]:
            done.result()


def check_fault(robot: EmulatedRobot, name: str, kind: type, text: str, ends: bool) -> None:
    reasons: list[str | StaleError | None] = [None]

    def guard() -> str | StaleError | None:
        if reasons[0] == "silent":
            reasons[0] = None
            time.sleep(0.6)
        return reasons[0]

    # On a machine with other work any caller is silent for a while; only one case is about that.
    patience = CALLER_S if name == "silent" else 2.0
    put_in_order(robot)
    with moving(robot, guard=guard, caller_s=patience) as motion:
        faults = {
            "guard": lambda: reasons.__setitem__(0, "30 echo frames were lost"),
            "hesitation": lambda: reasons.__setitem__(
                0, StaleError("no frame for 0.2 s", device="active echo")
            ),
            "silent": lambda: reasons.__setitem__(0, "silent"),
            "stop": lambda: motion.stop("the operator pressed stop"),
            "kill": lambda: signal_mover(motion, signal.SIGKILL),
            "end": lambda: signal_mover(motion, signal.SIGTERM),
            "force": lambda: robot.ask("force", [0.0, 0.0, -40.0, 0.0, 0.0, 0.0]),
            "unreadable": lambda: robot.ask("force", [math.nan] * 6),
            "tcp_offset": lambda: robot.ask(name, [0.0, 0.0, 0.2, 0.0, 0.0, 0.0]),
            "off": lambda: robot.ask("robot_state", 3, 1),
            "backdrive": lambda: robot.ask("robot_state", 6, 1),
            "freedrive": lambda: robot.ask("bits", 4, 0),
            "unknown bit": lambda: robot.ask("bits", 0, 1 << 12),
            "emergency": lambda: robot.ask("robot_state", 3, 7),
            "payload": lambda: robot.ask("payload", 2.0),
            "speed_slider": lambda: robot.ask("speed_slider", 0.5),
        }
        fault = faults.get(name, lambda: robot.ask(name))
        error, rest_s, told_s = fault_in_motion(robot, motion, fault)
        assert type(error) is kind
        with pytest.raises(kind, match=text):
            raise error
        assert rest_s <= STOP_WITHIN_S
        assert told_s < 5.0
        if name == "end":
            # In order, not by the controller's watchdog.
            assert robot.state()["reason"] == "the client stopped the script"
        if name == "unreadable":
            # The poses are lost, but not the robot: the watchdog alone would take 100 ms.
            assert robot.state()["log"][-1][1] == 33
        reasons[0] = None
        moves = len(sent(robot, 3))
        if ends:
            with pytest.raises(RefusedError, match="confirm the plan again"):
                motion.move_to(HOME)
        else:
            target = farther(robot)
            assert motion.move_to(target).pose[0, 3] == pytest.approx(target[0, 3])
            moves += 1
        assert len(sent(robot, 3)) == moves


def test_a_robot_that_is_faster_than_commanded_is_stopped(robots):
    robot = put_in_order(robots["CB"])
    robot.ask("overspeed", 2.0)
    with moving(robot, caller_s=2.0) as motion:
        target = farther(robot)
        with pytest.raises(StoppedError, match=r"moves at \d+ mm/s: 50 mm/s was commanded"):
            motion.move_to(target)
        assert motion.ended
    assert abs(1000.0 * robot.state()["raw"][0] - target[0, 3]) > 1.0


@pytest.mark.parametrize("speed_mm_s", [15.0, 0.5])
def test_a_robot_that_does_not_heed_a_stop_is_stopped_by_its_watchdog(robots, speed_mm_s):
    """It was kept alive for two seconds by the process that told it to stop again and again.

    Below 1 mm/s it counted as at rest.
    """
    robot = put_in_order(robots["CB"])
    robot.ask("heed stops", False)
    slow = replace(PLAN, limits=replace(PLAN.limits, max_speed_mm_s=speed_mm_s))
    with moving(robot, plan=slow, caller_s=2.0) as motion, ThreadPoolExecutor(1) as pool:
        stopping = pool.submit(motion.move_to, farther(robot))
        until(lambda: any(robot.state()["velocity"]) or stopping.done())
        before = robot.state()["t"]
        motion.stop("danger")
        with pytest.raises(StoppedError, match=r"danger; .*still moves: press the emergency stop"):
            stopping.result(20.0)
        until(lambda: robot.state()["rest_since"] is not None)
        state = robot.state()
    assert state["reason"].startswith("watchdog")
    assert state["rest_since"] - before < 1.5


def test_poses_that_are_frozen_with_new_stamps_end_motion(robots):
    """Box and arrival are checked by the poses: the arm would move unseen up to its target."""
    robot = put_in_order(robots["CB"])
    with moving(robot, caller_s=2.0) as motion:
        target = farther(robot)
        robot.ask("freeze", True)
        with pytest.raises(StoppedError, match=r"pose is frozen, [1-9].* mm from the target"):
            motion.move_to(target)
        assert motion.ended
        assert robot.state()["rest_since"] is not None
        assert abs(1000.0 * robot.state()["raw"][0] - target[0, 3]) > 1.0
    put_in_order(robot)


def test_nobody_is_told_that_an_arm_moves_whose_poses_are_frozen(robots):
    """Those of a moving arm, so speed included: it had come to rest long before."""
    robot = put_in_order(robots["CB"])
    with moving(robot, caller_s=2.0) as motion:
        error, *_ = fault_in_motion(robot, motion, partial(robot.ask, "freeze", True))
        with pytest.raises(StoppedError, match="frozen: press the emergency stop if it moves"):
            raise error
        assert "still moves" not in str(error)
    put_in_order(robot)


def test_lost_answers_end_motion_though_poses_come(robots):
    """ur_rtde would tell 2.5 s later, and a command would wait until then."""
    robot = put_in_order(robots["CB"])
    with moving(robot, caller_s=2.0) as motion:
        # Wherever the arm stands: the whole way takes twice as long as the loss is seen.
        motion.move_to(PLAN.targets[0])
        fault = partial(robot.ask, "mute control", True)
        error, rest_s, told_s = fault_in_motion(robot, motion, fault)
        with pytest.raises(LostError, match="the controller's answers are lost"):
            raise error
        assert rest_s <= 0.5 + STOP_WITHIN_S
        assert told_s < 1.5


def test_answers_lost_while_a_command_waits_are_told_as_soon(robots):
    """The command holds the interpreter's lock of the process that sent it for seconds."""
    robot = put_in_order(robots["e"])
    with moving(robot, caller_s=2.0) as motion:
        target = farther(robot)
        robot.ask("mute control", True)
        moves, before = len(sent(robot, 3)), robot.clock.now()
        with pytest.raises(LostError, match=r"answers are lost; .* needs a new confirmation"):
            motion.move_to(target)
        assert robot.clock.now() - before < 1.5
        with pytest.raises(RefusedError, match="confirm the plan again"):
            motion.move_to(target)
        assert len(sent(robot, 3)) == moves


@pytest.mark.parametrize("dashboard", [None, ""], ids=["answers", "mute"])
def test_a_motion_does_not_go_on_when_a_safeguard_stop_is_released(robots, dashboard):
    """Such a stop only pauses the program, and may be released by closing a gate."""
    robot = put_in_order(robots["e"])
    with moving(robot, caller_s=2.0) as motion:

        def fault() -> None:
            robot.ask("dashboard", dashboard)
            robot.ask("robot_state", 7, 5)

        error, *_ = fault_in_motion(robot, motion, fault)
        assert type(error) is StoppedError
        assert "safeguard stop: close the gate" in str(error)
        assert ("stop it at the pendant before" in str(error)) == (dashboard is not None)
        if dashboard is None:
            stood = robot.state()["raw"]
            robot.ask("robot_state", 7, 1)
            time.sleep(0.2)
            assert robot.state()["raw"] == stood
        with pytest.raises(RefusedError, match="confirm the plan again"):
            motion.move_to(HOME)


def test_a_motion_that_goes_on_before_the_dashboard_answers_is_stopped(robots):
    """No packets were read meanwhile, and the arm moved until its watchdog stopped it."""
    robot = put_in_order(robots["e"])
    with moving(robot, caller_s=2.0) as motion:

        def fault() -> None:
            robot.ask("dashboard", "")
            robot.ask("robot_state", 7, 5)
            time.sleep(0.05)
            robot.ask("robot_state", 7, 1)

        error, rest_s, _ = fault_in_motion(robot, motion, fault)
        assert "safeguard stop: close the gate" in str(error)
        assert rest_s <= 0.05 + STOP_WITHIN_S
        assert robot.state()["log"][-1][1] == 33


def test_a_program_that_a_person_pauses_is_ended(robots):
    """It was called a frozen pose, and the motion went on when the program was resumed."""
    robot = put_in_order(robots["CB"])
    with moving(robot, caller_s=2.0) as motion:
        error, *_ = fault_in_motion(robot, motion, partial(robot.ask, "pause", True))
        assert type(error) is StoppedError
        assert "the program was paused on the robot" in str(error)
        state = robot.state()
        assert state["reason"] == "the dashboard stopped it"
        robot.ask("pause", False)
        time.sleep(0.1)
        assert robot.state()["raw"] == state["raw"]


@pytest.mark.parametrize("dashboard", [None, ""], ids=["answers", "mute"])
def test_a_program_that_is_paused_within_a_command_is_ended(robots, dashboard):
    """Nobody told the dashboard: the process had died waiting, and the arm moved when resumed."""
    robot = put_in_order(robots["CB"])
    with moving(robot, caller_s=2.0) as motion:
        robot.ask("pause before", 36)
        robot.ask("mute control", True)
        robot.ask("dashboard", dashboard)
        with pytest.raises(LostError, match="answers are lost; the robot's own watchdog") as told:
            motion.move_to(farther(robot))
        assert ("stop it at the pendant before" in str(told.value)) == (dashboard is not None)
        assert only_asked(robot.state())
        if dashboard is None:
            assert robot.state()["reason"] == "the dashboard stopped it"
        with pytest.raises(RefusedError, match="confirm the plan again"):
            motion.move_to(HOME)


@pytest.mark.parametrize("command", [36, 3], ids=["isPoseWithinSafetyLimits", "moveL"])
def test_a_command_that_a_paused_program_did_not_take_ends_motion(robots, command):
    """The packet that tells of the pause was unread when the process ended."""
    robot = put_in_order(robots["CB"])
    with moving(robot, caller_s=2.0) as motion:
        robot.ask("pause before", command)
        with pytest.raises((StoppedError, RefusedError)) as told:
            motion.move_to(farther(robot))
        if command == 3:
            assert "the program was paused on the robot" in str(told.value)
        with pytest.raises((StoppedError, RefusedError), match=r"was paused.*confirm the plan"):
            until_ended(motion)
        assert robot.state()["reason"] == "the dashboard stopped it"
        assert only_asked(robot.state())


def test_of_two_that_connect_at_once_one_moves_the_robot(robots):
    robot = put_in_order(robots["e"])
    moves = len(sent(robot, 3))
    target = farther(robot)

    def move() -> str:
        try:
            with moving(robot, caller_s=2.0) as motion:
                motion.move_to(target)
                return "arrived"
        except DeviceError as error:
            return str(error)

    with ThreadPoolExecutor(2) as pool:
        told = sorted(pool.map(lambda _: move(), range(2)))
    assert told[0] == "arrived"
    assert re.search("another program commands this robot|a program runs on the robot", told[1])
    assert len(sent(robot, 3)) == moves + 1


def test_a_program_that_is_started_while_motion_connects_is_not_replaced(robots):
    robot = put_in_order(robots["e"])
    asked = robot.state()["dashboard"].count("PolyscopeVersion")
    with ThreadPoolExecutor(1) as pool, ExitStack() as after:
        connecting = pool.submit(lambda: moving(robot).__enter__())
        # Once for the plan, and once more by the process that connects.
        until(lambda: robot.state()["dashboard"].count("PolyscopeVersion") >= asked + 2)
        time.sleep(0.3)
        robot.ask("play")
        after.callback(stop_program, robot.host, timeout_s=2.0)
        error = connecting.exception(30.0)
        state = robot.state()
    assert type(error) is RefusedError
    assert "a program runs on the robot" in str(error)
    assert state["running"]


TAKEN_OVER = {
    "local": ("remote", [False], "local control: switch it to remote"),
    "play": ("play", [], "another program was started on the robot: stop it at the pendant"),
}
"""What a person does at the pendant in the middle of a run, and what must be said."""


@pytest.mark.parametrize("name", TAKEN_OVER)
def test_a_person_who_takes_the_robot_over_ends_motion(robots, name):
    """While it moves, and while it rests: nothing need be asked to move for that."""
    request, values, text = TAKEN_OVER[name]
    # The dashboard is asked five times a second; a program's end is in the next packet.
    within_s = STOP_WITHIN_S + (0.25 if name == "local" else 0.0)
    robot = robots["e"]
    for at_rest in (False, True):
        put_in_order(robot)
        with ExitStack() as after, moving(robot, caller_s=2.0) as motion:
            if name == "play":
                # The other program would run on.
                after.callback(stop_program, robot.host, timeout_s=2.0)
            if at_rest:
                moves = len(sent(robot, 3))
                motion.check()
                robot.ask(request, *values)
                with pytest.raises(StoppedError, match=text):
                    until_ended(motion)
                assert len(sent(robot, 3)) == moves
            else:
                fault = partial(robot.ask, request, *values)
                error, rest_s, told_s = fault_in_motion(robot, motion, fault)
                with pytest.raises(StoppedError, match=text):
                    raise error
                assert rest_s <= within_s
                assert told_s < 1.5
            with pytest.raises(RefusedError, match="confirm the plan again"):
                motion.move_to(HOME)
            assert robot.state()["running"] == (name == "play")


def until_ended(motion: Motion) -> None:
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        motion.check()
        time.sleep(0.01)


def test_a_stop_is_told_though_the_program_ended_at_the_same_moment(robots):
    robot = put_in_order(robots["CB"])
    with moving(robot) as motion:
        assert motion._process is not None
        # What comes while it is held up, it sees at once.
        suspend(motion._process.pid)
        robot.ask("payload", 2.0)
        assert stop_program(robot.host, timeout_s=2.0)
        os.kill(motion._process.pid, signal.SIGCONT)
        time.sleep(0.3)
        with pytest.raises(RefusedError, match=r"payload is 2\.0 kg"):
            motion.move_to(HOME)


def test_a_reset_control_connection_is_not_used_again():
    with EmulatedRobot(speed=3.0, version=CB_SERIES) as robot:
        with moving(robot) as motion:
            motion.move_to(PLAN.targets[1])
            robot.ask("drop")
            time.sleep(0.3)
            with pytest.raises((LostError, RefusedError)):
                motion.move_to(HOME)
            moves = len(sent(robot, 3))
        with moving(robot) as motion:
            motion.move_to(HOME)
        assert len(sent(robot, 3)) == moves + 1


_CONNECTS_AGAIN = """
import sys, time
import rtde_control
from hw.robot.mover.no_reconnect import NoReconnect
host, denied = sys.argv[1], sys.argv[2] == "denied"
no_reconnect = NoReconnect(host)
control = rtde_control.RTDEControlInterface(host)
if denied:
    no_reconnect.begin()
print("connected", flush=True)
sys.stdin.readline()
if denied:
    assert not control.isConnected()
    no_reconnect.connect((host, 29999), 2.0).close()
    try:
        open("/dev/null").close()
    except OSError:
        print("denied still", flush=True)
sys.stdin.readline()
"""


@pytest.mark.parametrize("case", ["denied", "free"])
def test_ur_rtde_sends_no_program_after_a_reset(case):
    """However late the text that it prints is read; left to itself, it sends one."""
    with (
        EmulatedRobot(version=E_SERIES) as robot,
        subprocess.Popen(
            [sys.executable, "-c", _CONNECTS_AGAIN, robot.host, case], text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(import_path())},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        ) as process,
    ):  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "connected\n"
        assert robot.state()["running"]
        robot.ask("drop")
        assert stop_program(robot.host, timeout_s=2.0)
        deadline = time.monotonic() + (10.0 if case == "free" else 1.5)
        while not (runs := robot.state()["running"]) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert runs == (case == "free")
        if case == "denied":
            # ur_rtde has given up, and the process can still ask the dashboard.
            process.stdin.write("\n")
            process.stdin.flush()
            assert "denied still\n" in process.stdout
        process.kill()


def may_be_prompt() -> bool:
    """Whether a process that is started here gets real-time scheduling where it asks for it."""
    ask = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({ANSWERS}))"
    command = [sys.executable, "-I", "-c", ask]
    return not subprocess.run(command, stderr=subprocess.DEVNULL).returncode


def test_no_thread_of_the_emulated_controller_waits_behind_other_programs(robots):
    """One that does may hold the interpreter's lock, and the controller then stands still."""
    robot = robots["e"]
    robot.state()
    assert robot.process is not None
    of_threads = [
        (os.sched_getscheduler(int(name)), os.sched_getparam(int(name)).sched_priority)
        for name in os.listdir(f"/proc/{robot.process.pid}/task")
    ]
    best = (os.SCHED_FIFO, ANSWERS) if may_be_prompt() else max(of_threads)
    # The main thread, the controller's, and the one that writes; numpy's run no Python.
    assert of_threads.count(best) >= 3


def test_a_safety_stop_that_is_over_when_the_mover_looks_ends_motion(robots):
    """A gate that was open for a moment; the robot would go on by itself."""
    robot = put_in_order(robots["e"])
    with moving(robot, caller_s=2.0) as motion:
        assert motion._process is not None
        suspend(motion._process.pid)
        robot.ask("robot_state", 7, 5)
        time.sleep(0.05)
        robot.ask("robot_state", 7, 1)
        time.sleep(0.05)
        os.kill(motion._process.pid, signal.SIGCONT)
        with pytest.raises(StoppedError, match="safeguard stop: close the gate"):
            until_ended(motion)
        with pytest.raises(RefusedError, match="confirm the plan again"):
            motion.move_to(HOME)


def test_a_caller_that_was_stopped_itself_blames_nobody(monkeypatch):
    """Ctrl-Z, or a suspended machine: what the motion process told meanwhile is still unread."""
    monkeypatch.setattr("hw.robot.motion._HANGS_WALL_S", 0.0)
    motion = Motion("127.0.0.2", PLAN, None)
    told = {"what": "error", "kind": "StaleError", "text": "silent", "ended": False, "move": 1}

    class Stopped(queue.SimpleQueue):
        def get(self, block: bool = True, timeout: float | None = None) -> dict:
            if not self.qsize():
                time.sleep(0.7)
                self.put(told)
                raise queue.Empty
            return super().get(block, timeout)

    motion._answers, motion._heard = Stopped(), time.monotonic()
    with pytest.raises(StaleError, match="silent"):
        motion._wait(1)


def test_a_process_that_does_not_read_a_long_setup_does_not_hold_up_the_start(monkeypatch) -> None:
    monkeypatch.setattr("hw.robot.motion._START_PATIENCE_S", 1.0)
    plan = replace(PLAN, targets=np.repeat(HOME[None], 400, axis=0))
    motion = Motion("127.0.0.1", plan, None)
    errors: list[BaseException] = []

    def start() -> None:
        try:
            motion.start()
        except DeviceError as error:
            errors.append(error)

    thread = threading.Thread(target=start, daemon=True)
    thread.start()
    process = until(lambda: motion._process)
    suspend(process.pid)
    try:
        thread.join(5.0)
        assert not thread.is_alive()
        assert [type(error) for error in errors] == [LostError]
    finally:
        process.kill()
        thread.join()
