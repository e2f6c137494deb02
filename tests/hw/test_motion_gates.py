"""What may move the robot: arrivals, refusals and confirmations, by the real ur_rtde."""

from __future__ import annotations

import math
import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motions import (
    HOME,
    LIMITS,
    OFFSET,
    PLAN,
    SERIAL,
    SERIES,
    beside,
    moving,
    only_asked,
    sent,
)
from robots import CB_SERIES, START, EmulatedRobot

import hw
from hw.cli.confirming import confirming_by
from hw.robot.confirmation import confirm_unattended
from hw.robot.identity import read_identity
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.robot.rtde import PacketReader, state_text
from hw.runtime.clock import REAL
from hw.runtime.errors import LostError, RefusedError, StaleError, StoppedError
from hw.runtime.rigid import ur_to_pose

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")

pytestmark = pytest.mark.real_time


# A CB controller answers at 125 Hz, an e-Series at 500 Hz.
@pytest.mark.parametrize("version", SERIES.values(), ids=SERIES)
def test_the_robot_moves_searches_and_is_left_in_order(version):
    log: list = []
    with EmulatedRobot(speed=3.0, version=version) as robot:
        with moving(robot, log, caller_s=2.0) as motion:
            assert motion.serial == motion.plan.serial
            assert motion.tcp_offset == OFFSET
            for target in (PLAN.targets[1], beside(10.0, 5.2, 0.0), HOME):
                sample = motion.move_to(target)
                np.testing.assert_allclose(sample.pose, target, atol=1e-6)
            with pytest.raises(RefusedError, match="neither a planned pose"):
                motion.move_to(beside(20.0, 0.0, 0.0))
            with pytest.raises(RefusedError, match="speed of 60"):
                motion.move_to(PLAN.targets[1], 60.0)
            with pytest.raises(RefusedError, match="shape"):
                motion.move_to(np.array(START[:5]))
            # A refusal changes nothing.
            motion.move_to(beside(0.0, 0.0, 1.0), 8.0)
        state = robot.state()
        moves = sent(robot, 3)
    assert state["raw"][:3] == pytest.approx([0.4, -0.1, 0.301])
    assert not state["running"]
    assert state["reason"] == "the client stopped the script"
    assert only_asked(state)
    assert len(moves) == 4
    assert [round(move[6] * 1000, 6) for move in moves] == [50.0, 10.0, 50.0, 8.0]
    names = [entry[1] for entry in log]
    assert names.count("moveL") == 4
    assert names.count("isPoseWithinSafetyLimits") == 4
    assert names.count("refused") == 3
    assert names[0] == "connect"
    assert names[-3:] == ["stopL", "kickWatchdog", "stopScript"]
    times = [entry[0] for entry in log]
    assert times == sorted(times)


def test_whatever_is_asked_for_only_allowed_motions_are_sent():
    rng = np.random.default_rng(5)
    home = PLAN.targets[0]
    asked = []
    for _ in range(30):
        kind = rng.integers(6)
        pose = beside(*rng.uniform(-6.0, 6.0, 3)) if kind else home + 0.0
        if kind == 1:
            pose[rng.integers(4), rng.integers(4)] = rng.choice([math.nan, math.inf, 0.0, 1e9])
        elif kind == 2:
            pose = beside(*rng.uniform(-200.0, 200.0, 3))
        elif kind == 3:
            pose = pose[:, [1, 0, 2, 3]]
        asked.append((pose, rng.choice([0.0, -1.0, 5.0, 10.0, 11.0, 1000.0, math.nan])))
    asked += [(beside(0.0, 2.0, 1.0), 10.0), (home, 5.0), (home, None)]
    plan = MotionPlan(home[None], LIMITS, OFFSET, SERIAL)
    arrived = []
    with EmulatedRobot(speed=3.0, version=CB_SERIES) as robot:
        with moving(robot, plan=plan, caller_s=2.0) as motion:
            for pose, speed in asked:
                with suppress(RefusedError):
                    arrived.append(motion.move_to(pose, speed).pose)
        moves = sent(robot, 3)
    assert 3 <= len(arrived) == len(moves) < len(asked)
    for values, pose in zip(moves, arrived, strict=True):
        target = ur_to_pose(np.array(values[:6]))
        np.testing.assert_allclose(target, pose, atol=1e-6)
        assert np.linalg.norm(target[:3, 3] - home[:3, 3]) <= LIMITS.search_mm + 1e-6
        assert 0.0 < values[6] <= LIMITS.search_speed_mm_s / 1000.0 + 1e-12
        assert values[7] <= LIMITS.max_acceleration_mm_s2 / 1000.0


def test_nothing_but_the_mover_commands_a_robot():
    package = Path(hw.__file__).parent
    for path in package.rglob("*.py"):
        text = path.read_text()
        if path.name not in {"connection.py", "program.py"}:
            assert "RTDEControlInterface" not in text, path
        if path.name != "controller.py":
            assert '"moveL"' not in text, path
        for forbidden in ("moveJ(", "speedL(", "servoL(", "setTcp", "unlockProtective"):
            assert forbidden not in text, path
        if "bench" not in path.parts:
            assert "unlock protective" not in text, path
    controller = package / "robot" / "mover" / "controller.py"
    assert controller.read_text().count('"moveL"') == 1


def test_a_dry_run_sends_nothing():
    log: list = []
    with EmulatedRobot(version=CB_SERIES) as robot:
        motion = Motion(robot.host, PLAN, None, clock=robot.clock, log=lambda *e: log.append(e))
        with motion:
            assert not motion.ended
            for target in (PLAN.targets[2], PLAN.targets[1], HOME):
                np.testing.assert_allclose(motion.move_to(target).pose, target, atol=1e-9)
            with pytest.raises(RefusedError, match="neither"):
                motion.move_to(beside(0.0, 50.0, 0.0))
        state = robot.state()
    assert state["log"] == []
    assert not state["running"]
    assert state["raw"] == pytest.approx(START)
    assert [entry[1] for entry in log] == ["dry run: moveL"] * 3 + ["refused"]


@pytest.mark.parametrize("emulated", [True, False])
def test_a_plan_that_was_not_named_is_not_confirmed_on_the_emulated_bench_either(emulated):
    with pytest.raises(RefusedError, match="another plan was named"):
        confirming_by(REAL, emulated, "0" * 16)(PLAN)
    assert confirming_by(REAL, emulated, PLAN.digest[:16])(PLAN).digest == PLAN.digest


def test_motion_needs_its_own_unused_confirmation():
    with EmulatedRobot() as robot:
        with pytest.raises(RefusedError, match="needs the operator"):
            Motion(robot.host, PLAN, None, clock=robot.clock, dry_run=False).start()
        other = MotionPlan(PLAN.targets[:2], LIMITS, OFFSET, SERIAL)
        wrong = confirm_unattended(other, other.digest, clock=robot.clock)
        for text, plan, given in [
            ("another plan", PLAN, wrong),
            ("used for an earlier connection", other, wrong),
        ]:
            with pytest.raises(RefusedError, match=text):
                Motion(robot.host, plan, given, clock=robot.clock, dry_run=False).start()
        another = MotionPlan(PLAN.targets, LIMITS, OFFSET, "20195500099")
        with (
            pytest.raises(RefusedError, match="connected is 20195500042, calibration"),
            moving(robot, plan=another),
        ):
            pass
        offset = MotionPlan(PLAN.targets, LIMITS, (0.0,) * 6, SERIAL)
        with pytest.raises(RefusedError, match="TCP offset"), moving(robot, plan=offset):
            pass
        assert robot.state()["log"] == []


STATES = [
    (2, 1, "booting: wait"),
    (3, 1, "powered off: switch the robot on"),
    (5, 1, "idle with its brakes on: release its brakes"),
    (6, 1, "in backdrive: leave backdrive"),
    (7, 3, "protective stop: find its cause"),
    (7, 4, "recovery mode: move the joints back"),
    (7, 5, "safeguard stop: close the gate"),
    (3, 6, "system emergency stop: release it where"),
    (3, 7, "robot emergency stop: release the button"),
    (3, 8, "safety violation: read the pendant's log"),
    (3, 9, "safety fault: read the pendant's log"),
]
"""robot_mode, safety_mode, and what the refusal must say."""


def test_a_robot_that_may_not_move_is_sent_nothing_and_its_state_is_named():
    with EmulatedRobot() as robot:
        with closing(PacketReader(robot.host)) as packets:
            for robot_mode, safety_mode, text in STATES:
                robot.ask("robot_state", robot_mode, safety_mode)
                deadline, told = time.monotonic() + 5.0, ""
                while not re.search(text, told) and time.monotonic() < deadline:
                    for packet in packets.read():
                        told = state_text(packet.robot_mode, packet.safety_bits)
                assert re.search(text, told)
        # By its mode, by its safety, and by both.
        for robot_mode, safety_mode, text in (STATES[2], STATES[6], STATES[8]):
            robot.ask("robot_state", robot_mode, safety_mode)
            with pytest.raises(RefusedError, match=text), moving(robot):
                pass
        robot.ask("robot_state", 7, 2)
        robot.ask("bits", 4, 0)
        with pytest.raises(RefusedError, match="freedrive button is pressed"), moving(robot):
            pass
        # The input of an enabling device is no reason.
        robot.ask("bits", 0, 1 << 11)
        robot.ask("remote", False)
        with pytest.raises(RefusedError, match="local control: switch it to remote"), moving(robot):
            pass
        state = robot.state()
        assert "stop" not in state["dashboard"]
        assert state["log"] == []
        assert only_asked(state)
        robot.ask("dashboard", "Command is not allowed")
        with pytest.raises(LostError, match="no version but 'Command is not allowed'"):
            read_identity(robot.host)


def test_what_is_set_at_the_pendant_is_compared_before_and_during_a_motion():
    """By a CB controller, which must be asked for its TCP offset before each motion."""
    with EmulatedRobot(version=CB_SERIES, speed=3.0) as robot:
        with moving(robot) as motion:
            motion.move_to(PLAN.targets[1])
            robot.ask("tcp_offset", (0.0, 0.0, 0.2, 0.0, 0.0, 0.0))
            time.sleep(0.1)
            with pytest.raises(RefusedError, match="TCP offset"):
                motion.move_to(HOME)
        robot.ask("tcp_offset", OFFSET)
        robot.ask("payload", 1.5)
        with pytest.raises(RefusedError, match=r"payload is 1\.5 kg, not 0\.0"), moving(robot):
            pass
        assert len(sent(robot, 3)) == 1


def test_who_is_not_let_in_waits_and_changes_nothing():
    """A second client, one beside another program, and one of a controller that is silent."""

    def started(host: str) -> object:
        plan = replace(PLAN, serial=serial)
        given = confirm_unattended(plan, plan.digest, clock=REAL)
        return Motion(host, plan, given, dry_run=False).start()

    with (
        EmulatedRobot(version=CB_SERIES) as robot, EmulatedRobot(version=CB_SERIES) as other,
        EmulatedRobot() as silent, moving(robot, caller_s=2.0) as motion,
        ThreadPoolExecutor(4) as pool,
    ):  # fmt: skip
        serial = motion.serial
        other.ask("play")
        silent.ask("mute")
        future = pool.submit(motion.move_to, PLAN.targets[2])
        while math.hypot(*robot.state()["velocity"]) < 0.02:
            assert not future.done()
            time.sleep(0.002)
        begun = time.monotonic()
        second, beside_it, of_silent = [
            pool.submit(started, each.host) for each in (robot, other, silent)
        ]
        for refused in (second, beside_it):
            with pytest.raises(RefusedError, match="a program runs on the robot, or is paused"):
                refused.result()
        with pytest.raises(LostError, match="does not answer"):
            of_silent.result()
        assert time.monotonic() - begun < 30.0
        assert future.result(timeout=20.0).pose[0, 3] == pytest.approx(450.0)
        assert robot.state()["running"]
        state = other.state()
        assert state["running"]
        assert state["log"] == []
        assert only_asked(state)
        assert "stop" not in state["dashboard"]


def test_a_plan_goes_on_after_its_confirmation_has_expired():
    with EmulatedRobot(speed=3.0, version=CB_SERIES) as robot:
        plan = replace(PLAN, serial=read_identity(robot.host).name)
        named = {"clock": robot.clock, "dry_run": False, "caller_s": 2.0}
        # A busy machine may take longer to connect.
        for valid_s in (2.0, 6.0, 60.0):
            given = confirm_unattended(plan, plan.digest, clock=robot.clock)
            given = replace(given, expires_s=given.issued_s + valid_s)
            motion = Motion(robot.host, plan, given, **named)
            with suppress(RefusedError):
                motion.start()
                break
        with closing(motion):
            motion.move_to(PLAN.targets[1])
            robot.clock.sleep(given.expires_s - robot.clock.now() + 0.1)
            assert motion.move_to(HOME).pose[0, 3] == pytest.approx(400.0)
        late = replace(given, use=threading.Semaphore())
        with pytest.raises(RefusedError, match="expired"):
            Motion(robot.host, plan, late, **named).start()


def test_danger_or_force_before_a_request_sends_no_motion():
    log: list = []
    with EmulatedRobot(version=CB_SERIES) as robot:
        with moving(robot, log) as motion:
            robot.ask("force", [0.0, 0.0, -180.0, 0.0, 0.0, 0.0])
            time.sleep(0.1)
            with pytest.raises(RefusedError, match=r"a force of 180.0 N meets the tool"):
                motion.move_to(PLAN.targets[2])
            robot.ask("force", [0.0] * 6)
            time.sleep(0.1)
            motion.guard = lambda: StaleError("no frame yet", device="active echo")
            with pytest.raises(StaleError, match="active echo: no frame yet"):
                motion.move_to(PLAN.targets[2])
            motion.guard = lambda: "danger"
            with pytest.raises(StoppedError, match="danger"):
                motion.move_to(PLAN.targets[2])
        assert sent(robot, 3) == []
        assert robot.state()["raw"] == pytest.approx(START)
    assert "moveL" not in [entry[1] for entry in log]


def test_closing_what_was_not_started_does_nothing():
    Motion("127.0.0.1", PLAN, None).close()


@pytest.mark.parametrize("caller_s", [math.nan, math.inf, 0.0, 60.0])
def test_a_silence_without_bound_is_refused(caller_s):
    """With NaN no silence of the caller ever stopped the robot."""
    with pytest.raises(RefusedError, match="caller_s must be above 0 and at most 10"):
        Motion("127.0.0.1", PLAN, None, caller_s=caller_s)
