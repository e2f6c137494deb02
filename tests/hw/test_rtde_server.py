"""The emulated controller against the real ur_rtde: both interfaces, both series of robots."""

from __future__ import annotations

import socket
import struct
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from robots import CB_SERIES, E_SERIES, START, EmulatedRobot, address
from waiting import until

from hw.bench.arm import Arm
from hw.bench.controller import DONE, READY, Controller, before_loop
from hw.bench.robot import RobotProcess
from hw.bench.rtde import RtdeServer
from hw.bench.rtde_fields import output_type
from hw.runtime.clock import Clock
from hw.runtime.rigid import pose_to_ur, ur_to_pose

rtde_receive = pytest.importorskip("rtde_receive", reason="no wheel of ur_rtde here")
rtde_control = pytest.importorskip("rtde_control", reason="no wheel of ur_rtde here")


def beside(mm: float) -> list[float]:
    return [START[0] + mm / 1000.0, *START[1:]]


def disconnect(*clients) -> None:
    """Each of them takes half a second."""
    with ThreadPoolExecutor(len(clients)) as pool:
        list(pool.map(lambda client: client.disconnect(), clients))


def test_ur_rtde_receives_and_controls():
    """Both series at once: most of it is waiting."""
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(receive_and_control, [E_SERIES, CB_SERIES]))


def receive_and_control(version: tuple[int, ...]) -> None:
    with EmulatedRobot(version=version, speed=2.0) as robot:
        receive = rtde_receive.RTDEReceiveInterface(robot.host)
        control = rtde_control.RTDEControlInterface(robot.host)
        assert receive.getActualTCPPose() == pytest.approx(START)
        assert receive.getSafetyStatusBits() == 1
        assert receive.getRobotMode() == 7
        assert control.isProgramRunning()
        assert control.getTCPOffset() == pytest.approx((0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
        assert control.isPoseWithinSafetyLimits(beside(10.0))
        assert not control.isPoseWithinSafetyLimits([2.0, 0.0, 0.3, 0.0, 3.0, 0.2])

        # Synchronous: back when there.
        assert control.moveL(beside(10.0), 0.1, 1.0), robot.state()
        assert robot.state()["raw"] == pytest.approx(beside(10.0))
        until(control.isSteady)

        # Asynchronous, with progress, and stopped on the way.
        before = control.getAsyncOperationProgressEx().operationId()
        assert control.moveL(beside(60.0), 0.02, 1.0, True)
        until(lambda: control.getAsyncOperationProgressEx().isAsyncOperationRunning())
        assert control.getAsyncOperationProgressEx().operationId() == before + 1
        assert not control.isSteady()
        control.stopL(2.0)
        stopped = robot.state()
        assert stopped["velocity"] == [0.0] * 6
        assert START[0] + 0.010 < stopped["raw"][0] < START[0] + 0.060
        until(lambda: not control.getAsyncOperationProgressEx().isAsyncOperationRunning())

        # In real time, from where it stopped: no arm follows a jump.
        here = 1000.0 * (stopped["raw"][0] - START[0])
        for k in range(20):
            assert control.servoL(beside(here + 0.1 * k), 0.0, 0.0, 0.008, 0.1, 300.0)
            time.sleep(0.004)
        control.servoStop()
        until(lambda: abs(receive.getActualTCPPose()[0] - beside(here + 1.9)[0]) < 1e-4)

        # The script again, and its end.
        assert control.reuploadScript()
        until(control.isProgramRunning)
        assert control.moveL(START, 0.1, 1.0)
        assert control.setWatchdog(20.0)
        until(lambda: not control.isProgramRunning())
        assert "watchdog" in robot.state()["reason"]
        assert not control.moveL(beside(10.0), 0.1, 1.0)
        assert robot.state()["raw"] == pytest.approx(START)
        disconnect(control, receive)


def test_a_protective_stop_ends_the_program_until_a_person_releases_it():
    with EmulatedRobot() as robot:
        control = rtde_control.RTDEControlInterface(robot.host)
        assert control.moveL(beside(60.0), 0.05, 1.0, True)
        robot.ask("protective_stop")
        until(lambda: robot.state()["rest_since"] is not None)
        until(lambda: not control.isProgramRunning())
        assert not control.moveL(START, 0.1, 1.0)
        robot.ask("unlock")
        assert control.reuploadScript()
        until(control.isProgramRunning)
        assert control.moveL(START, 0.1, 1.0)
        assert "unlock protective stop" not in robot.state()["dashboard"]
        control.disconnect()


def test_the_program_s_handshake():
    arm = Arm(START)
    program = Controller(arm)
    program.upload(0.0)
    program.step(0.02)
    assert not program.running
    program.step(0.06)
    assert program.running
    assert program.int_out[0] == READY

    # A command is taken once, until the client writes 0.
    program.int_in[0], program.double_in[:8] = 47, [0.0] * 8
    program.step(0.1)
    assert (program.int_out[0], program.int_out[1]) == (DONE, 1)
    program.step(0.2)
    assert [code for _, code, _ in program.log] == [47]
    program.int_in[0] = 0
    program.step(0.3)
    assert program.int_out[0] == READY

    # While a synchronous motion runs, nothing is read: a stop has to wait.
    program.int_in[0], program.int_in[1] = 3, 0
    program.double_in[:8] = [*beside(50.0), 0.05, 1.0]
    program.step(1.0)
    assert program.int_out[0] == READY
    program.int_in[0] = 33
    program.step(1.5)
    assert [code for _, code, _ in program.log] == [47, 3]
    assert arm.velocity(1.5)[0] == pytest.approx(0.05)
    program.step(2.06)
    assert program.int_out[0] == DONE

    # What is not emulated ends the program, as an error in the script would.
    program.int_in[0] = 0
    program.step(2.1)
    program.int_in[0] = 45
    program.step(2.2)
    assert not program.running
    assert program.reason == "movePath (command 45) is not emulated"


SCRIPT = """def rtde_control():
    # rtde_set_watchdog("input_int_register_0", 1.0, "stop")
    def inside():
        rtde_set_watchdog("input_int_register_0", 9.0, "stop")
    end
    rtde_set_watchdog({})
    while True:
        rtde_set_watchdog("input_int_register_0", 9.0, "stop")
    end
end
"""


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ('"input_int_register_0", 0.5, "stop"', "watchdog: nothing written for"),
        ('"input_int_register_0", 0.5, "pause"', "is not emulated"),
        ('"no_register", 0.5, "stop"', "is not emulated"),
    ],
)
def test_a_script_that_watches_itself_ends_when_it_hears_nothing(arguments, reason):
    program = Controller(Arm(START))
    first = before_loop(SCRIPT.replace("{}", arguments))
    assert first == [f"rtde_set_watchdog({arguments})"]
    assert before_loop(SCRIPT.removesuffix("end\n")) is None
    program.upload(0.0, first)
    program.step(0.06)
    assert program.running == (reason != "is not emulated")
    program.step(2.0)
    program.kick(2.0)
    program.step(4.05)
    assert not program.running
    assert reason in program.reason


@pytest.mark.parametrize("where", ["waiting", "working"])
def test_what_came_while_the_controller_was_held_up_came_in_time(where):
    """Its process lost the processor for longer than the watchdog waits; the client did not."""
    seen: list[bool] = []
    server = RtdeServer(Arm(START), address())
    program = server.controller
    select, step = server._selector.select, program.step

    def hold_up() -> None:
        program._watchdog_s = 0.1
        program.kick(server.clock.now())
        client.sendall(struct.pack(">HBBi", 8, ord("U"), 1, 0))
        time.sleep(0.3)
        program.step = stepped

    def held_up(timeout: float | None = None) -> list:
        found = select(timeout)
        if not found and not seen and program.running and timeout:
            server._selector.select = select
            hold_up()
        return found

    def stepped(t: float) -> None:
        step(t)
        seen.append(program.running)
        program._watchdog_s, program.step = None, step

    with server, socket.create_connection((server.host, 30004)) as client:
        client.sendall(struct.pack(">HB", 24, ord("I")) + b"input_int_register_0,")
        assert client.recv(100)[3:] == b"\x01INT32"
        with socket.create_connection((server.host, 30003)) as script:
            script.sendall(b"def rtde_control():\nend\n")
            until(lambda: program.running)
        if where == "waiting":
            server._selector.select = held_up
        else:
            server._call(hold_up)
        until(lambda: seen)
    assert seen == [True], program.reason


def test_variables_depend_on_the_version():
    assert output_type("ft_raw_wrench", (5, 9)) == "VECTOR6D"
    assert output_type("ft_raw_wrench", (5, 8)) == "NOT_FOUND"
    assert output_type("payload_inertia", (3, 15)) == "VECTOR6D"
    assert output_type("payload_inertia", (3, 14)) == "NOT_FOUND"
    assert output_type("no_such_thing", (5, 11)) == "NOT_FOUND"


@pytest.mark.parametrize(
    ("port", "data"),
    [
        (30004, b"\x00\x00\x00"),
        (30004, struct.pack(">HB", 5, ord("V")) + b"\x00"),
        (30004, struct.pack(">HB", 4, ord("U")) + b"\x09"),
        (30004, struct.pack(">HB", 12, ord("O")) + b"\x00" * 8 + b"\xff"),
        (30004, b"\xff\xff" + b"x" * 70000),
        (30003, b"def something_else():\nend\n" * 50000),
        (29999, b"\xff" * 1_100_000),
    ],
)
def test_junk_ends_its_own_connection_only(port, data):
    with RtdeServer(Arm(START), address()) as server:
        with socket.create_connection((server.host, 29999), timeout=60.0) as good:
            good.recv(200)
            with socket.create_connection((server.host, port), timeout=60.0) as bad:
                try:
                    bad.sendall(data)
                    bad.settimeout(0.3)
                    bad.recv(65536)
                except OSError:
                    pass
            good.sendall(b"get serial number\n")
            assert good.recv(200) == b"20195500042\n"
        assert not server.controller.running


def test_an_address_is_used_once():
    with RtdeServer(Arm(START), address()) as server:
        with pytest.raises(OSError, match="in use"):
            RtdeServer(Arm(START), server.host).start()
        second = RtdeServer(Arm(START), address())
        with second:
            assert second.host != server.host
    server.stop()


def test_a_mirror_of_the_arm_follows_the_one_in_the_robot_s_process():
    clock = Clock(speed=2.0)
    arm = Arm(START, repeatability_mm=0.1, repeatability_deg=0.05, seed=4)
    first = arm.true_raw(0.0)
    with RobotProcess(arm, address(), clock=clock) as robot:
        assert (robot.serial, robot.frequency_hz) == ("20195500042", 500.0)
        with pytest.raises(OSError, match="in use"):
            RobotProcess(Arm(START), robot.host, clock=clock).start()
        control = rtde_control.RTDEControlInterface(robot.host)
        assert control.moveL(beside(30.0), 0.1, 1.0)
        state = robot.state()
        assert state["raw"] == pytest.approx(beside(30.0))
        assert arm.raw(clock.now()) == pytest.approx(state["raw"])
        assert arm.rest_since(clock.now()) == pytest.approx(state["rest_since"])
        # The hidden error is the child's own.
        error = [t - r for t, r in zip(arm.true_raw(state["t"]), state["raw"], strict=True)]
        assert 1e-6 < max(map(abs, error[:3])) < 1e-3
        assert arm.true_raw(0.0) == pytest.approx(first)
        assert control.moveL(beside(-60.0), 0.05, 1.0, True)
        robot.ask("protective_stop")
        until(lambda: arm.rest_since(clock.now()) is not None)
        assert arm.raw(clock.now()) == pytest.approx(robot.state()["raw"])
        state = robot.state()
        assert state["packets"] > 0
        assert state["skipped"] == 0
        with pytest.raises(RuntimeError, match="unknown request"):
            robot.ask("explode")
        control.disconnect()
    with pytest.raises(RuntimeError, match="ended"):
        robot.ask("state")


def message(connection: socket.socket) -> tuple[int, bytes]:
    data = b""
    while len(data) < 3 or len(data) < struct.unpack_from(">H", data)[0]:
        new = connection.recv(1)
        if not new:
            raise EOFError
        data += new
    return data[2], data[3:]


def ask(connection: socket.socket, kind: str, payload: bytes = b"") -> bytes:
    connection.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)
    return message(connection)[1]


def test_one_client_owns_the_registers_and_nothing_unknown_is_started_or_ignored():
    with EmulatedRobot() as robot:

        def connect() -> socket.socket:
            return socket.create_connection((robot.host, 30004), timeout=60.0)

        with connect() as first, connect() as second:
            assert ask(first, "I", b"input_int_register_0")[0] == 1
            told = ask(second, "I", b"input_int_register_0,input_double_register_0")
            assert told == b"\x00IN_USE,DOUBLE"
            # A recipe that was refused cannot be written through.
            second.sendall(struct.pack(">HBBi", 8, ord("U"), 0, 255))
            with pytest.raises((EOFError, ConnectionError)):
                message(second)
        with connect() as third:
            until(lambda: ask(third, "I", b"input_int_register_0")[0] == 1)
        with connect() as reader:
            recipe = struct.pack(">d", 125.0) + b"timestamp,colour"
            assert ask(reader, "O", recipe)[1:] == b"DOUBLE,NOT_FOUND"
            assert ask(reader, "S") == b"\x00"
            assert ask(reader, "O", struct.pack(">d", 125.0) + b"timestamp")[1:] == b"DOUBLE"
            assert ask(reader, "S") == b"\x01"
        with connect() as stranger, pytest.raises((EOFError, ConnectionError)):
            ask(stranger, "Q")


def test_setting_the_tcp_moves_the_pose_that_is_told_and_not_the_tool():
    with EmulatedRobot() as robot:
        control = rtde_control.RTDEControlInterface(robot.host)
        receive = rtde_receive.RTDEReceiveInterface(robot.host)
        before, true = ur_to_pose(np.array(robot.state()["raw"])), robot.arm.true_raw(0.0)
        # 50 mm further out along the tool, and turned by a quarter about its axis.
        assert control.setTcp([0.0, 0.0, 0.15, 0.0, 0.0, np.pi / 2])
        expected = before @ ur_to_pose(np.array([0.0, 0.0, 0.05, 0.0, 0.0, np.pi / 2]))
        until(lambda: abs(receive.getActualTCPPose()[2] - expected[2, 3] / 1000.0) < 1e-6)
        told = ur_to_pose(np.array(receive.getActualTCPPose()))
        np.testing.assert_allclose(told, expected, atol=1e-6)
        assert robot.arm.true_raw(robot.clock.now()) == pytest.approx(true)
        # What is commanded is the new point, and the tool follows it.
        target = told.copy()
        target[0, 3] += 10.0
        assert control.moveL(pose_to_ur(target).tolist(), 0.1, 1.0)
        moved = ur_to_pose(np.array(robot.arm.true_raw(robot.clock.now())))
        np.testing.assert_allclose(moved[:3, 3] - before[:3, 3], [10.0, 0.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(moved[:3, :3], before[:3, :3], atol=1e-6)
        disconnect(control, receive)


def test_a_command_that_is_not_emulated_ends_the_program_and_says_why():
    with EmulatedRobot() as robot:
        with socket.create_connection((robot.host, 30001), timeout=60.0) as primary:
            control = rtde_control.RTDEControlInterface(robot.host)
            assert control.setPayload(0.7, [0.0, 0.0, 0.03])
            control.speedL([0.01, 0.0, 0.0, 0.0, 0.0, 0.0], 0.5, 0.1)
            until(lambda: not control.isProgramRunning())
            reason = "speedL (command 10) is not emulated"
            assert robot.state()["reason"] == reason
            said = b""
            while reason.encode() not in said:
                new = primary.recv(4096)
                assert new, said
                said += new
        assert not control.moveL(beside(10.0), 0.1, 1.0)
        assert robot.state()["raw"] == pytest.approx(START)
        control.disconnect()
