"""The process that moves the robot, in pieces: its messages, what it reads, and its latch."""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from types import FrameType
from unittest.mock import Mock

import numpy as np
import pytest
from robots import address

from hw.robot.confirmation import Confirmation
from hw.robot.gate import Command, Gate
from hw.robot.limits import Limits
from hw.robot.motion_plan import MotionPlan
from hw.robot.mover.__main__ import combined
from hw.robot.mover.connection import Connection
from hw.robot.mover.control_loop import ControlLoop
from hw.robot.mover.controller import Controller
from hw.robot.mover.inputs import Inputs, Stop, StopLatch
from hw.robot.mover.messages import (
    Caller,
    Setup,
    error_of,
    line_of,
    plain,
    sample_of,
    told,
)
from hw.robot.mover.monitor import Monitor
from hw.robot.mover.no_reconnect import NoReconnect
from hw.robot.rtde import PendantSettings
from hw.robot.stream import PoseSample
from hw.runtime.clock import Clock
from hw.runtime.errors import LostError, RefusedError, StaleError, StoppedError
from hw.runtime.processes import be_prompt

CLOCK = Clock()
PLAN = MotionPlan(
    np.eye(4)[None],
    Limits(
        box_min_mm=(-50.0, -50.0, -150.0),
        box_max_mm=(50.0, 50.0, 150.0),
        tip_mm=(0.0, 0.0, 50.0),
        cone_axis=(0.0, 0.0, 1.0),
        cone_deg=20.0,
        max_step_mm=60.0,
        max_turn_deg=20.0,
        max_speed_mm_s=50.0,
    ),
    (0.0, 0.0, 0.1, 0.0, 0.0, 0.0),
    "20195500042",
    pendant=PendantSettings(1.5, (0.0, 0.01, 0.02), 0.5),
)
DANGER = Stop(StoppedError("danger", device="robot"), True)
SILENCE = Stop(StaleError("no frame", device="robot"), False)


@pytest.fixture
def pipe() -> Iterator[tuple[Caller, int]]:
    """The process's view of its caller, and the caller's end of the requests."""
    requests, write = os.pipe()
    answers, output = os.pipe()
    try:
        yield Caller(requests, output), write
    finally:
        for number in (requests, write, answers, output):
            with suppress(OSError):
                os.close(number)


def stop_of(kind: type, move: int) -> dict:
    return {"request": "stop", "move": move, **told(kind("enough", device="robot"))}


def test_the_latch_keeps_the_first_stop_and_one_for_good():
    latch = StopLatch()
    for stop, kept in [(SILENCE, SILENCE), (DANGER, DANGER), (SILENCE, DANGER)]:
        latch.set(stop)
        assert latch.stop is kept
    latch.release()
    assert latch.stop is DANGER


@pytest.mark.parametrize("step", ["set", "release"])
def test_a_stop_by_a_signal_is_kept_at_whatever_moment_it_comes(step):
    """A handler of SIGTERM runs between two instructions of Python."""
    for moment in itertools.count():
        latch, left = StopLatch(), moment
        if step == "release":
            latch.set(SILENCE)

        def trace(
            frame: FrameType, event: str, value: object, latch: StopLatch = latch
        ) -> Callable:
            nonlocal left
            frame.f_trace_opcodes = True
            if event == "opcode":
                if left == 0:
                    latch.set(DANGER)
                left -= 1
            return trace

        sys.settrace(trace)
        try:
            latch.set(SILENCE) if step == "set" else latch.release()
        finally:
            sys.settrace(None)
        if left >= 0:
            # The step was over before.
            assert moment > 4
            return
        assert latch.stop is DANGER


def test_a_setup_and_a_pose_arrive_as_they_were_sent():
    given = Confirmation(PLAN.digest, PLAN.serial, 1.0, 2.0, 3.0)
    sent = Setup("127.0.0.1", PLAN, given, CLOCK, False, 0.15)
    came = Setup.of(json.loads(line_of(sent.message())))
    assert came.plan.digest == PLAN.digest
    assert came.plan.limits == PLAN.limits
    assert (came.host, came.confirmation, came.clock) == (sent.host, given, CLOCK)
    assert (came.dry_run, came.caller_s) == (False, 0.15)
    sample = PoseSample(1.0, 2.0, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), 1, 7, 2, 0.003)
    assert sample_of(json.loads(json.dumps(plain(sample)))) == sample
    error = RefusedError("not allowed", device="robot")
    assert str(error_of(told(error))) == str(error)


ANOTHER_VERSION = """
import sys
from hw.robot.mover.program import guarded_program
from hw.runtime.errors import LostError
try:
    guarded_program(object(), "127.0.0.1", 2.0)
except LostError as error:
    print(error)
finally:
    print("end", flush=True)
"""


def test_the_child_that_asks_for_the_program_ends_whatever_it_meets():
    """It went on as a second caller of the robot, where ur_rtde is another than expected."""
    run = [sys.executable, "-c", ANOTHER_VERSION]
    told = subprocess.run(run, capture_output=True, text=True, check=False)
    lines = told.stdout.splitlines()
    assert lines[1:] == ["end"]
    assert "no program to send to the controller: AttributeError: " in lines[0]


def test_a_stop_that_is_read_with_the_setup_is_latched(pipe):
    caller, write = pipe
    later = line_of(stop_of(StoppedError, 0)) + line_of({"request": "heard"})
    os.write(write, line_of({"setup": True}) + later[:-5])
    assert caller.first() == {"setup": True}
    inputs = Inputs(caller, CLOCK)
    assert inputs.latch.stop is not None
    assert inputs.latch.stop.for_good
    os.write(write, later[-5:])
    assert caller.read() == [{"request": "heard"}]
    assert not caller.left
    os.close(write)
    assert caller.read() == []
    assert caller.left


def test_an_input_that_ends_before_the_setup_is_no_request(pipe):
    caller, write = pipe
    os.write(write, b'{"half')
    os.close(write)
    assert caller.first() is None


@pytest.mark.parametrize(
    ("kind", "move", "latched"),
    [(StaleError, 0, False), (StaleError, 1, True), (StoppedError, 0, True)],
)
def test_only_a_hesitation_about_an_answered_move_is_ignored(pipe, kind, move, latched):
    """Before the first move, number 0 stands for one that was answered."""
    caller, write = pipe
    os.write(write, line_of({"setup": True}) + line_of(stop_of(kind, move)))
    caller.first()
    stop = Inputs(caller, CLOCK).latch.stop
    assert (stop is not None) == latched
    assert stop is None or type(stop.error) is kind


def test_a_caller_that_listens_no_more_has_left():
    answers, output = os.pipe()
    caller = Caller(0, output)
    caller.tell("alive")
    os.close(answers)
    assert not caller.left
    caller.tell("alive")
    assert caller.left
    os.close(output)


def test_what_follows_a_stop_for_good_does_not_replace_it():
    lost = LostError("the program stopped", device="robot")
    assert combined(None, lost) is lost
    assert combined(Stop(lost, True), lost) is lost
    both = combined(DANGER, lost)
    assert type(both) is StoppedError
    assert both.args[0] == "danger; the program stopped"
    assert type(combined(SILENCE, lost)) is LostError


def test_a_move_that_is_refused_at_the_last_moment_leaves_the_watchdog_at_rest(monkeypatch):
    """A delay of 0.1 s at rest would then have ended the program, and motion with it."""
    setup = Setup("127.0.0.1", PLAN, None, CLOCK, False, 0.15)
    gate, inputs, controller, caller, connection = (
        Mock(spec=kind) for kind in (Gate, Inputs, Controller, Caller, Connection)
    )
    allowed = Command((0.0,) * 6, np.eye(4), 1.0, 1e-3, 0.1, 1.0)
    gate.check_move.side_effect = [allowed, StaleError("too old", device="robot")]
    controller.serial, caller.left = PLAN.serial, False
    inputs.latch, inputs.tcp_offset, inputs.pendant = StopLatch(), None, None
    monkeypatch.setattr(Monitor, "trouble", lambda self, moving: None)
    loop = ControlLoop(setup, gate, inputs, controller, connection, caller)
    loop._take({"move": 1, "pose": [], "speed_mm_s": None})
    sent = [name for name, *_ in controller.method_calls if name.startswith(("watch", "move"))]
    assert sent == ["watch_motion", "watch_rest"]
    assert caller.tell.call_args.kwargs["kind"] == "StaleError"


def test_a_kick_that_hangs_ends_the_process_as_any_command_does(monkeypatch):
    """It held the process for two seconds where a paused program did not take it."""
    inputs = Mock(spec=Inputs, program_ended=False)
    inputs.sample.age_s.return_value = 0.0
    controller = Controller(
        Setup("127.0.0.1", PLAN, None, CLOCK, False, 0.15), inputs, Mock(spec=Caller)
    )
    monkeypatch.setattr(controller, "_connection", lambda: (1, 100))
    left: list[float] = []

    def kick() -> bool:
        left.append(signal.getitimer(signal.ITIMER_REAL)[0])
        return True

    controller.rtde_control = Mock(kickWatchdog=kick)
    try:
        controller.kick()
    finally:
        # This process is not the mover's.
        be_prompt(0)
    assert 0.0 < left[0] <= 0.4
    assert signal.getitimer(signal.ITIMER_REAL)[0] == 0.0


def test_the_alarm_rings_though_a_caller_has_it_ignored_and_blocked():
    """What it starts inherits both: a command that hangs was ended two seconds later, or never."""
    deaf = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGALRM, signal.SIG_IGN)\n"
        "signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM, signal.SIGTERM})\n"
        "print('deaf', flush=True)\n"
        "os.execv(sys.executable, [sys.executable, '-m', 'hw.robot.mover'])"
    )
    with subprocess.Popen(
        [sys.executable, "-c", deaf], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as mover:
        assert mover.stdout is not None
        assert mover.stdout.readline() == b"deaf\n"
        deadline = time.monotonic() + 60.0
        # It waits for its setup; until it listens, nothing rings.
        while mover.poll() is None and time.monotonic() < deadline:
            mover.send_signal(signal.SIGALRM)
            time.sleep(0.02)
        mover.kill()
    assert mover.returncode == -signal.SIGALRM


def test_a_name_with_several_addresses_is_reached_at_the_one_that_answers(monkeypatch):
    """As ``localhost``, which often is ::1 first: else local control would never be noticed."""
    with socket.create_server((address(), 0)) as server:
        host, port = server.getsockname()
        stream = (socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP, "")
        found = [(*stream, (silent, 0)) for silent in (address(), host)]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *args, **named: found)
        no_reconnect = NoReconnect("robot")
        with no_reconnect.connect(("robot", port), 2.0) as connection:
            assert connection.getpeername() == (host, port)
        del found[1]
        with pytest.raises(ConnectionRefusedError):
            NoReconnect("robot").connect(("robot", port), 2.0)
