"""Poses through real sockets: nothing lost, nothing old handed out as new, no hang."""

from __future__ import annotations

import contextlib
import math
import os
import queue
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
from motions import put_in_order
from robots import CB_SERIES, E_SERIES, START, EmulatedRobot, address
from waiting import until

from hw.bench.arm import Arm
from hw.bench.rtde import RtdeServer
from hw.robot.identity import read_identity
from hw.robot.rtde import Packet, PacketReader, PendantSettings, safety_text, state_text
from hw.robot.stream import PoseSample, PoseStream, average
from hw.runtime.clock import Clock, Lag, monotonic_s
from hw.runtime.errors import LostError, RefusedError, StaleError
from hw.runtime.rigid import ur_to_pose


@pytest.fixture(scope="module")
def robots() -> Iterator[dict[str, EmulatedRobot]]:
    """One of each series, for tests that put it in order first; nothing moves it."""
    with EmulatedRobot(version=CB_SERIES) as old, EmulatedRobot(version=E_SERIES) as new:
        yield {"CB": old, "e": new}


@pytest.mark.real_time
@pytest.mark.parametrize("seconds", [1.5, pytest.param(60.0, marks=pytest.mark.slow)])
def test_no_pose_is_lost_at_500_and_125_hz_at_once(seconds):
    with (
        EmulatedRobot(version=E_SERIES) as fast,
        EmulatedRobot(version=CB_SERIES) as slow,
        PoseStream(fast.host, clock=fast.clock) as fast_poses,
        PoseStream(slow.host, clock=slow.clock) as slow_poses,
    ):
        time.sleep(seconds)
        for robot, poses, frequency in [(fast, fast_poses, 500.0), (slow, slow_poses, 125.0)]:
            samples = poses.drain()
            state = robot.state()
            assert state["late"] == state["skipped"] == poses.dropped == 0
            steps = np.diff([sample.t_device for sample in samples])
            np.testing.assert_allclose(steps, 1 / frequency, atol=1e-6)
            assert len(samples) >= 0.8 * seconds * frequency
            assert samples[0].raw == pytest.approx(START)
            np.testing.assert_allclose(samples[0].pose, ur_to_pose(np.array(START)))
            assert samples[0].robot_mode == 7
            assert samples[0].safety_bits == 1


def again_and_again(
    call: Callable[[], object], seconds: float = 120.0, *, after: type[Exception] | tuple = ()
) -> None:
    """Call until it raises an error, another one than may come before that."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with contextlib.suppress(after):
            call()
        time.sleep(0.002)


@pytest.mark.real_time
def test_identity_and_tcp_offset(robots):
    robot = put_in_order(robots["e"])
    with PoseStream(robot.host, clock=robot.clock) as poses:
        identity = poses.identity()
        assert (identity.serial, identity.model) == ("20195500042", "UR5")
        assert identity.version == "5.11.0.108249"
        assert poses.tcp_offset == (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
        robot.ask("tcp_offset", [0.0, 0.0, 0.101, 0.0, 0.0, 0.0])
        with pytest.raises(RefusedError, match="TCP offset changed"):
            again_and_again(poses.latest)
    robot = put_in_order(robots["CB"])
    with PoseStream(robot.host, clock=robot.clock) as poses:
        identity = poses.identity()
        assert (identity.serial, identity.version) == ("20195500042", "3.15.8.106339")
        assert identity.identified
        assert poses.tcp_offset is None


@pytest.mark.parametrize(
    ("version", "serial", "calibrated"),
    [((3, 15, 8, 0), True, True), ((3, 6, 0, 0), False, True), ((3, 4, 0, 0), False, False),
     ((5, 4, 0, 0), False, True), ((5, 11, 0, 0), True, True)],
)  # fmt: skip
def test_an_arm_is_known_by_its_serial_number_and_calibration(version, serial, calibrated):
    with contextlib.ExitStack() as stack:
        hosts = [
            stack.enter_context(RtdeServer(Arm(START), address(), version=version, serial=n)).host
            for n in ("2017350001", "2017350002", "2017350001")
        ]
        # What a controller does not tell is waited for as long as allowed.
        ask = partial(read_identity, timeout_s=60.0 if calibrated else 1.0)
        first, other, moved = stack.enter_context(ThreadPoolExecutor(3)).map(ask, hosts)
    assert (first.serial is not None, first.calibration is not None) == (serial, calibrated)
    assert first.identified == (serial or calibrated)
    # Another arm is another one, and the same arm elsewhere is the same, unless nothing is told.
    assert first.name != other.name
    assert (first.name == moved.name) == first.identified
    assert ("@" in first.name) != first.identified


def test_payload_and_speed_slider_are_told(robots):
    robot = put_in_order(robots["e"])
    with PoseStream(robot.host, clock=robot.clock) as poses:
        assert poses.pendant == PendantSettings(0.0, (0.0, 0.0, 0.0), 1.0)
        robot.ask("payload", 0.8, (0.0, 0.0, 0.05))
        robot.ask("speed_slider", 0.5)
        expected = PendantSettings(0.8, (0.0, 0.0, 0.05), 0.5)
        until(lambda: poses.pendant == expected)
    # Too old to tell the payload: then that is what is known, and 0 kg is something else.
    with (
        EmulatedRobot(version=(3, 10, 0, 0)) as robot,
        PoseStream(robot.host, clock=robot.clock) as poses,
    ):
        assert poses.pendant == PendantSettings(None, None, 1.0)
        assert "payload" in poses.pendant.changed(PendantSettings())
        assert poses.pendant.changed(poses.pendant) == ""


@pytest.mark.real_time
def test_a_mute_controller_makes_poses_stale_and_then_lost(robots):
    robot = put_in_order(robots["e"])
    with PoseStream(robot.host, clock=robot.clock, timeout_s=2.0) as poses:
        poses.latest()
        robot.ask("mute")
        time.sleep(0.15)
        with pytest.raises(StaleError, match=r"ms old: it came \d{3,} ms ago .* at most 100 ms"):
            poses.latest()
        with pytest.raises((StaleError, LostError)):
            poses.steady(0.1)
        with pytest.raises(LostError, match=r"silent for 2 s"):
            again_and_again(poses.latest, after=StaleError)
        assert poses.drain()[-1].raw == pytest.approx(START)
        with pytest.raises(LostError):
            poses.awaited()
    start = time.monotonic()
    with pytest.raises(LostError, match="does not answer"):
        PoseStream(robot.host, clock=robot.clock, timeout_s=0.5).start()
    with pytest.raises(LostError, match="dashboard"):
        read_identity(robot.host, timeout_s=0.5)
    # A second, and what it takes to start an interpreter.
    assert time.monotonic() - start < 120.0


@pytest.mark.real_time
def test_a_robot_at_rest_may_be_silent_for_a_moment(robots):
    """A machine busy for a tenth of a second ended an acquisition in which nothing moved."""
    robot = put_in_order(robots["e"])
    with PoseStream(robot.host, clock=robot.clock, timeout_s=60.0) as poses:
        robot.ask("mute")
        time.sleep(0.3)
        with pytest.raises(StaleError):
            poses.latest()
        with pytest.raises(StaleError):
            poses.awaited(0.1)
        muted = robot.clock.now()
        threading.Timer(0.2, robot.ask, ["unmute"]).start()
        assert poses.awaited(60.0).t_host > muted


@pytest.mark.real_time
def test_a_dropped_connection_is_lost_at_once(robots):
    robot = put_in_order(robots["e"])
    with PoseStream(robot.host, clock=robot.clock) as poses:
        robot.ask("drop")
        with pytest.raises(LostError, match="connection"):
            again_and_again(poses.latest)


def test_nobody_there():
    with pytest.raises(LostError, match="no connection"):
        PoseStream("127.250.250.1", timeout_s=0.5).start()


def test_an_average_that_is_interrupted_keeps_no_poses(robots):
    robot = put_in_order(robots["e"])
    with PoseStream(robot.host, clock=robot.clock) as poses:
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            poses.steady(1e3)
        assert not poses._listeners


@pytest.mark.real_time
def test_averages_of_steady_poses(robots):
    robot = put_in_order(robots["e"])
    with PoseStream(robot.host, clock=robot.clock) as poses:
        poses.drain()
        steady = poses.steady(0.1)
        assert steady.count >= 5
        assert steady.scatter_mm == pytest.approx(0.0, abs=1e-6)
        assert steady.sample.raw == pytest.approx(START)
        assert len(poses.drain()) >= steady.count
    rng = np.random.default_rng(0)
    raws = np.array(START) + rng.normal(scale=[1e-4] * 3 + [1e-3] * 3, size=(2000, 6))
    mean = average([PoseSample(0.0, 0.0, tuple(raw), 1, 7, 2) for raw in raws])
    assert mean.scatter_mm == pytest.approx(0.1 * np.sqrt(3), rel=0.05)
    np.testing.assert_allclose(mean.sample.raw, START, atol=1e-4)


def test_an_average_is_of_poses_from_within_its_time():
    """A reader that was held up hands over, all at once, poses from the way to the pose."""
    stream, began = PoseStream("nowhere"), monotonic_s()
    stream._lag = Lag(stream.clock.at(began), 0.0)

    def come(x: float, late_s: float) -> None:
        now = monotonic_s()
        still = (0.0,) * 6
        pose = (x, *START[1:])
        stream._take(
            [Packet(now, now - began - late_s, pose, still, still, 7, 2, 3, 1, None,
                    PendantSettings())]
        )  # fmt: skip

    def feed() -> None:
        # Once the average has begun.
        until(lambda: stream._listeners)
        come(START[0] + 0.01, late_s=1.0)
        while stream._listeners:
            come(START[0], late_s=0.0)
            time.sleep(0.002)

    feeder = threading.Thread(target=feed)
    feeder.start()
    steady = stream.steady(0.05)
    feeder.join()
    assert steady.count > 1
    assert steady.sample.raw == pytest.approx(START)


def test_lag_finds_late_poses_in_spite_of_drift():
    rng = np.random.default_rng(2)
    lag = Lag()
    late = []
    for t in np.arange(0.0, 600.0, 0.05):
        jitter = rng.exponential(0.0005)
        held = 0.2 if 300.0 < t < 300.5 else 0.0
        late.append((lag.of(t + jitter + held, (t + 12.0) * (1 + 50e-6)), held))
    values, truth = np.array(late).T
    assert values[truth > 0].min() > 0.19
    assert values[truth == 0].max() < 0.02
    sample = PoseSample(5.0, 0.0, START, 1, 7, 2, lag_s=0.2)
    assert sample.age_s(5.01) == pytest.approx(0.21)


def test_a_lag_that_was_there_from_the_start_or_creeps_is_seen():
    offset = 990.0
    constant = Lag(10.0, 10.0 + offset)
    assert [round(constant.of(t + 0.3, t + offset), 3) for t in (10.0, 20.0)] == [0.3, 0.298]
    creeping = Lag(10.0, 10.0 + offset)
    seen = [creeping.of(t + 0.0015 * t, t + offset) for t in np.arange(10.0, 110.0, 0.1)]
    assert seen[-1] > 0.13
    # Without a first pair only what is more than the least can be seen.
    assert Lag().of(10.3, 10.0 + offset) == 0.0


def look_on(poses: PoseStream) -> None:
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        poses.latest()
        time.sleep(0.01)


def test_time_stamps_that_step_or_run_fast_make_no_pose_fresh(robots):
    """A clock that gains on the host's hides any lag, so that a late pose passed as new."""
    late, unknown = "on its way for up to", "of unknown age: the controller's clock"
    ahead = Lag(10.0, 1000.0)
    assert [ahead.of(t, 990.0 + t * (1 + 150e-6)) for t in (10.0, 1000.0)] == [0.0, 0.0]
    assert ahead.of(1000.1, 2000.0) == ahead.of(1001.0, 1991.0) == math.inf
    robot = put_in_order(robots["CB"])
    for stamps, text in (
        ((1005.0, 1.0), unknown),
        ((1000.0, 1000.0), unknown),
        ((995.0, 1.0), late),
        ((0.0, 1.0), late),
    ):
        robot.ask("stamps", 1000.0, 1.0)
        with PoseStream(robot.host, clock=robot.clock, max_age_s=3.0) as poses:
            poses.latest()
            robot.ask("stamps", *stamps)
            with pytest.raises(StaleError, match=text):
                look_on(poses)


@contextmanager
def delaying(host: str, port: int, seconds: Callable[[bytes], float]) -> Iterator[str]:
    """A proxy that delays what passes, either way, by what a function says; its address."""
    here = address()
    listener = socket.create_server((here, port))

    def carry(source: socket.socket, sink: socket.socket) -> None:
        waiting: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()

        def deliver() -> None:
            with sink, contextlib.suppress(OSError):
                while (come := waiting.get())[1]:
                    time.sleep(max(0.0, come[0] - time.monotonic()))
                    sink.sendall(come[1])
                sink.shutdown(socket.SHUT_RDWR)

        threading.Thread(target=deliver, daemon=True).start()
        data = b"more"
        while data:
            data = b""
            with contextlib.suppress(OSError):
                data = source.recv(65536)
            waiting.put((time.monotonic() + seconds(data), data))

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                server = socket.create_connection((host, port))
                for pair in ((client, server), (server, client)):
                    threading.Thread(target=carry, args=pair, daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    with listener:
        yield here
        listener.shutdown(socket.SHUT_RDWR)


@pytest.mark.real_time
def test_poses_that_come_late_are_not_new(robots):
    delay = [0.15]

    def hold(data: bytes) -> float:
        """Requests to start, their answers, and packets; nothing else is measured."""
        return delay[0] if data[2:3] in (b"S", b"U") else 0.0

    robot = put_in_order(robots["CB"])
    with PoseStream(robot.host, clock=robot.clock) as prompt:
        prompt.latest()
    with delaying(robot.host, 30004, hold) as host:
        # Twice the delay, and what a busy machine adds.
        too_late = r"on their way for ([2-9]\d\d|\d{4,}) ms, over the limit of 100"
        with pytest.raises(LostError, match=too_late):
            PoseStream(host, clock=robot.clock, timeout_s=60.0).start()
        delay[0] = 0.0
        with PoseStream(host, clock=robot.clock) as late:
            delay[0] = 0.15
            time.sleep(0.3)
            with pytest.raises(StaleError, match=r"was on its way for up to \d{3,} ms"):
                late.latest()
        # Below the limit, a latency that was there from the start counts in every pose's age.
        delay[0] = 0.05
        with PoseStream(host, clock=robot.clock, max_age_s=60.0) as slow:
            assert min(sample.lag_s for sample in slow.drain()) > 0.04


@pytest.mark.real_time
def test_one_slow_start_does_not_make_every_later_pose_look_old(robots):
    starts = []

    def hold(data: bytes) -> float:
        """A request to start, three bytes, on its way to the controller."""
        starts.append(data == rtde(b"S", b""))
        return 0.6 if starts[-1] and sum(starts) == 1 else 0.0

    robot = put_in_order(robots["CB"])
    with delaying(robot.host, 30004, hold) as host:
        with contextlib.closing(PacketReader(host)) as reader:
            assert sum(starts) >= 2
            assert reader.latency_s < 0.3
        starts.clear()
        with PoseStream(host, clock=robot.clock, max_age_s=0.3) as poses:
            assert min(sample.lag_s for sample in poses.drain()) < 0.3


def test_safety_bits_are_named():
    assert safety_text(0b01) == safety_text(0b11) == ""
    assert safety_text(0b101).startswith("protective stop: find its cause")
    assert "emergency" in safety_text(1 << 6)
    # The input of an enabling device is no stop, and no sign that the robot may move.
    assert state_text(7, 0b01 | 1 << 11) == state_text(7, 0b10 | 1 << 11) == ""
    assert safety_text(0b100 | 1 << 11).startswith("protective stop")
    assert "no safety state" in state_text(7, 0) == state_text(7, 1 << 11)
    # One that boots has none yet: its mode says more.
    assert "it is booting" in state_text(2, 0)
    assert "0x80000000" in safety_text(1 << 31)


def answers(*messages: bytes) -> str:
    """A server that answers each request with the next message; its address."""
    host = address()
    listener = socket.create_server((host, 30004))

    def serve() -> None:
        with listener, listener.accept()[0] as client:
            client.settimeout(60.0)
            for message in messages:
                client.recv(65536)
                client.sendall(message)
            client.recv(65536)

    threading.Thread(target=serve, daemon=True).start()
    return host


def rtde(kind: bytes, payload: bytes) -> bytes:
    return struct.pack(">H", 3 + len(payload)) + kind + payload


VERSION = rtde(b"v", struct.pack(">4I", 5, 11, 0, 0))
TYPES = b"\x01" + b",".join(
    b"DOUBLE VECTOR6D VECTOR6D VECTOR6D INT32 UINT32 UINT32 UINT32 DOUBLE VECTOR6D DOUBLE "
    b"VECTOR3D VECTOR6D".split()
)


@pytest.mark.parametrize(
    ("messages", "text"),
    [
        ([b"\x00\x00V"], "not RTDE data"),
        ([rtde(b"V", b"\x00")], "version 2"),
        ([rtde(b"V", b"\x01"), rtde(b"v", b"123")], "did not report its version"),
        ([rtde(b"V", b"\x01"), VERSION, rtde(b"O", b"\x01NOT_FOUND,DOUBLE")], "has no"),
        ([rtde(b"V", b"\x01"), VERSION, rtde(b"O", b"")], "has no"),
        ([rtde(b"V", b"\x01"), VERSION, rtde(b"O", TYPES), rtde(b"S", b"\x00")], "start sending"),
        # The start of a long message of another kind.
        ([b"GET / HTTP/1.1\r\n\r\n" * 4000], "accepted but does not answer"),
    ],
)
def test_what_is_no_controller_is_refused(messages, text):
    host = answers(*messages)
    with pytest.raises((LostError, RefusedError), match=text):
        PacketReader(host, timeout_s=0.5 if "does not answer" in text else 30.0)


def packet(pose: tuple[float, ...]) -> bytes:
    """Zeros but for the pose."""
    return b"\x01" + struct.pack(">7d", 0.0, *pose) + bytes(8 * 12 + 4 * 4 + 8 * 17)


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"\x01" + b"\0" * 8, "a packet of 9 bytes came instead of 305"),
        (b"\x01" + b"\xff" * 304, "holds NaN or Inf"),
        (packet((0.0, math.inf, 0.0, 0.0, 0.0, 0.0)), "holds NaN or Inf"),
        (packet((0.0, 0.0, 0.0, 1e200, 0.0, 0.0)), "holds an impossible pose"),
        (packet((1e4, 0.0, 0.0, 0.0, 0.0, 0.0)), "holds an impossible pose"),
    ],
)
def test_packets_that_do_not_fit_the_recipe_end_the_connection(payload, text):
    opening = [rtde(b"V", b"\x01"), VERSION, rtde(b"O", TYPES), rtde(b"S", b"\x01")]
    host = answers(*opening[:-1], opening[-1] + rtde(b"M", b"text") + rtde(b"U", payload))
    with pytest.raises(LostError, match=text):
        PacketReader(host, timeout_s=30.0)


def test_a_faster_bench_counts_age_in_its_own_time():
    clock = Clock(speed=4.0)
    # A minute on the wall: this process may be held up for a while.
    stream = PoseStream("127.0.0.1", clock=clock, max_age_s=240.0)
    stream._latest = PoseSample(clock.now(), 0.0, START, 1, 7, 2)
    stream.latest()
    stream._latest = PoseSample(clock.now() - 240.1, 0.0, START, 1, 7, 2)
    with pytest.raises(StaleError, match="ms old"):
        stream.latest()
