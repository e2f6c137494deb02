"""The session over its devices: the period of the frames, and which images count."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from motions import PLAN, moving
from robots import CB_SERIES, EmulatedRobot
from test_world import placed
from waiting import until

from hw.acquisition.stage import ProbeStage
from hw.active_echo.device import ActiveEcho
from hw.bench.active_echo import AuspisEmulator
from hw.bench.frames import Camera
from hw.bench.tank import Look
from hw.bench.ultrasound import ImageServer
from hw.bench.world import make_world
from hw.planning.scene import Scene
from hw.recording.layout import RecordingHeader
from hw.recording.recorder import Recorder
from hw.recording.session import DELAY_S, Session, SilenceLimits, frame_period
from hw.runtime.clock import Clock
from hw.runtime.errors import DeviceError, LostError, RefusedError, StaleError
from hw.setup.description import Setup
from jaxcal.data.probe import LinearProbe
from jaxcal.io.openigtlink import Message

pytest.importorskip("serial", reason="needs jaxcal[serial]")


SCENE = Scene(np.eye(4), np.array([400.0, -100.0, 0.0]), np.array([0.0, 0.0, -1.0]))


def silence(_t: float, _threshold: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(8, 50e-6), np.full(8, 900.0)


@contextmanager
def devices(
    folder: Path, rate_hz: float = 30.0, **of_robot
) -> Iterator[tuple[EmulatedRobot, AuspisEmulator, Recorder, Callable[..., Setup]]]:
    """A robot, an element of eight lines, a recording, and the setup of them, or of a machine, too.

    The setup takes the address of the machine, and the scene.
    """
    with (
        EmulatedRobot(**of_robot) as robot,
        AuspisEmulator(silence, clock=robot.clock, lines=8, rate_hz=rate_hz) as emulator,
        Recorder(folder / "r.h5", RecordingHeader("pixel", {}, 8, settings="{}")) as recorder,
    ):

        def setup(machine: tuple[str, int] | None = None, scene: Scene = SCENE) -> Setup:
            probe, clock = LinearProbe(elements=8), robot.clock
            return Setup(robot.host, emulator.path, scene, {}, machine, probe=probe, clock=clock)

        yield robot, emulator, recorder, setup


def constant(_t: float) -> np.ndarray:
    return np.zeros((40, 30), np.uint8)


def changing(t: float) -> np.ndarray:
    return np.full((40, 30), int(1000 * t) % 256, np.uint8)


@pytest.mark.parametrize("name", [item.name for item in fields(SilenceLimits)])
def test_a_limit_on_silence_that_limits_nothing_is_refused(name):
    """With NaN nothing was ever too old."""
    for value in (0, 1000) if name == "burst" else (np.nan, np.inf, 0.0, 1000.0):
        with pytest.raises(RefusedError, match=f"{name} must be above 0"):
            SilenceLimits(**{name: value})


@pytest.mark.parametrize(("rate_hz", "missed"), [(12.0, 0.0), (50.0, 0.3)])
def test_the_period_of_frames_is_the_devices(rate_hz, missed):
    clock = Clock(speed=10.0)
    with (
        AuspisEmulator(silence, clock=clock, rate_hz=rate_hz, lines=8) as emulator,
        ActiveEcho(emulator.path, clock=clock, lines=8) as device,
    ):
        emulator.fault(missed_triggers=missed)
        device.stream(True)
        frames = [device.read(1200.0) for _ in range(12)]
        hz = device.clock_hz()
    assert frame_period(frames, hz) == pytest.approx(1.0 / rate_hz, rel=0.01)
    assert frame_period(frames[:1], hz) is None
    assert frame_period(frames[::-1], hz) is None


class Link:
    """A network between client and server that holds back for ``delay_s`` what the server sends."""

    def __init__(self, server: ImageServer) -> None:
        self.delay_s = 0.0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._server = server.host, server.port
        self.address = self._listener.getsockname()
        threading.Thread(target=self._carry, daemon=True).start()

    def _carry(self) -> None:
        held: list[tuple[float, bytes]] = []
        with self._listener, socket.create_connection(self._server) as server:
            client, _ = self._listener.accept()
            server.settimeout(0.005)
            with client, suppress(BrokenPipeError, ConnectionResetError):
                while True:
                    with suppress(TimeoutError):
                        held.append((time.monotonic() + self.delay_s, server.recv(65536)))
                    while held and held[0][0] <= time.monotonic():
                        client.sendall(held.pop(0)[1])


def test_a_question_that_was_held_up_does_not_end_the_run(tmp_path):
    """The delay of the echo frames was bounded by it, and only after 10 s by another one."""
    with (
        devices(tmp_path) as (robot, emulator, recorder, setup),
        Session(setup(), recorder) as session,
    ):
        sent = robot.clock.now()
        time.sleep(0.6)
        _, count = session.echo.trigger_count()
        with session.echo._changed:  # as the first question of a session
            session.echo._asked, session.echo._anchor = (sent, count), None
        time.sleep(0.3)
        assert "late: check the link" in str(session.trouble())
        session.wait_until_clear()
        # Of a device that has restarted, no frame was late any more.
        emulator.restart_counter()
        time.sleep(0.2)
        assert "nothing tells how late echo frames are" in str(session.trouble())
        session.wait_until_clear()


def test_a_threshold_that_is_not_the_one_set_is_named(tmp_path):
    """By hand, or by a restart: its lines and amplitudes went into the placement as any others."""
    with devices(tmp_path) as (_, emulator, recorder, setup), Session(setup(), recorder) as session:
        session.echo.set_threshold(100)
        assert len(session.listen(3, session.clock.now())) == 3
        emulator.threshold = 700
        with pytest.raises(DeviceError, match="was set to 100, but is 700: was the device rest"):
            session.listen(3, session.clock.now())


def test_an_image_that_a_slow_link_holds_up_is_not_of_the_next_pose(tmp_path):
    """The robot arrived after it was made: a target's place was measured at the wrong pose."""
    with (
        devices(tmp_path) as (robot, _, recorder, setup),
        ImageServer(changing, clock=robot.clock) as machine,
    ):
        link = Link(machine)
        with Session(setup(link.address), recorder) as session:
            session.image_after(robot.clock.now())
            link.delay_s = 0.7
            time.sleep(1.0)
            arrived = robot.clock.now()
            image = session.image_after(arrived)
            until(lambda: session.latest_image().t_host != image.t_host)
            session.record_image(image)
    with h5py.File(tmp_path / "r.h5") as file:
        assert file["us/t_device"][()].tolist() == [image.t_device]
    assert image.t_device - 1_000_000.0 > arrived - 0.2
    assert image.late_s == pytest.approx(robot.clock.speed * 0.7, abs=0.2)


@pytest.mark.real_time
@pytest.mark.parametrize("moment", ["on the way", "never"])
def test_a_frame_of_before_the_probe_came_to_rest_is_not_measured(tmp_path, monkeypatch, moment):
    """A frozen machine whose screen is grabbed sends it again and again, with new time stamps."""
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")
    world = make_world(0, phantom="cross-wire", response_mm=0.0)
    camera = Camera(world, Look(speckle_db=90.0, ghost=0.0))
    view = camera.frame(placed(world, 3.0, 0.0, 45.0), np.random.default_rng(0))
    start, end = PLAN.targets[0][0, 3], PLAN.targets[2][0, 3]
    frozen_at = {"on the way": (start + end) / 2, "never": np.inf}[moment]
    if moment == "never":
        # As on a busy machine: poses of before and after the arrival are taken together.
        monkeypatch.setattr("hw.recording.session._PERIOD_WALL_S", 0.3)
    point = (PLAN.targets[2] @ [3.0, 0.0, 45.0, 1.0])[:3]
    scene = Scene(np.eye(4), point, np.array([0.0, 0.0, -1.0]))
    with devices(tmp_path, version=CB_SERIES, speed=3.0) as (robot, _, recorder, setup):

        def seen(t: float) -> np.ndarray:
            # A number in the corner: no two places of the arm look the same.
            x = min(1000.0 * robot.arm.raw(t)[0], frozen_at)
            frame = view.copy()
            frame[:8, :8] = np.frombuffer(np.float64(round(x, 3)).tobytes(), np.uint8)
            return frame

        with ImageServer(seen, clock=robot.clock, spacing_mm=camera.spacing_mm) as machine:
            seen_by = setup((machine.host, machine.port), scene)
            with (
                Session(seen_by, recorder, watch=SilenceLimits(echo_age_s=9.0)) as session,
                moving(robot, caller_s=2.0) as motion,
            ):
                session.image_after(robot.clock.now())
                stage = ProbeStage(session, motion, PLAN.targets, lambda kind, text: None)
                stage.go_to(2)
                bench = stage.image_bench(2)
                if moment == "never":
                    assert bench.read(1).heard
                    place, _, _ = stage.locate(2)
                    np.testing.assert_allclose(place, [3.0, 45.0], atol=0.3)
                    return
                for look in (stage.locate, bench.read):
                    with pytest.raises(StaleError, match="before the probe came to rest"):
                        look(2)


@pytest.mark.real_time
def test_the_recorded_frame_of_a_slow_machine_is_of_the_pose(tmp_path):
    """The newest one when a time of flight was measured could be from the end of the move."""
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")
    with devices(tmp_path, version=CB_SERIES, speed=3.0) as (robot, _, recorder, setup):

        def seen(t: float) -> np.ndarray:
            return np.full((40, 30), round(1000.0 * robot.arm.raw(t)[0]) - 300, np.uint8)

        with (
            ImageServer(seen, clock=robot.clock, rate_hz=1.2) as machine,
            Session(setup((machine.host, machine.port)), recorder) as session,
            moving(robot, caller_s=2.0) as motion,
        ):
            session.image_after(robot.clock.now())
            stage = ProbeStage(session, motion, PLAN.targets, lambda kind, text: None)
            for row in (2, 0, 2):
                stage.go_to(row)
                frame = stage.any_frame()
                assert frame is not None
                assert frame.array[0, 0] == round(PLAN.targets[row][0, 3]) - 300


class Odd(ImageServer):
    """Its stamps are in ms, and one image in four is lost."""

    def _message(self, *args) -> Message:
        message = super()._message(*args)
        return replace(message, t_device=1000.0 * message.t_device)

    def _broadcast(self, batch: list[bytes]) -> None:
        if self.sent % 4:
            super()._broadcast(batch)


def test_clocks_that_are_wrong_and_images_that_are_lost_are_recorded(tmp_path):
    """Ticks of another frequency than the device states are wrong times of flight."""
    patient = SilenceLimits(image_age_s=10.0)
    with (
        devices(tmp_path, version=CB_SERIES, speed=20.0) as (robot, emulator, recorder, setup),
        Odd(constant, clock=robot.clock, rate_hz=5.0) as machine,
    ):
        emulator.fault(clock=1.5)
        with Session(setup((machine.host, machine.port)), recorder, watch=patient) as session:
            robot.clock.sleep(DELAY_S + 2.0)
            stamps = session._stamps
            until(lambda: len(stamps) == 3 and min(map(len, stamps.values())) >= 25)
            with pytest.raises(
                DeviceError, match=r"counts 1\.\d+ s a second .*flight may be wrong"
            ):
                session.listen(1, robot.clock.now())
    with h5py.File(tmp_path / "r.h5") as file:
        assert set(file["clock/device"][()]) <= {b"robot"}
        assert file["us"].attrs["lost"] >= 5
        told = dict(zip(file["events/text"], file["events/kind"], strict=True))
    assert b"losses" in told.values()
    assert any(re.match(rb"active echo: its clock was set, or counts ", text) for text in told)
    assert any(re.match(rb"ultrasound: its clock was set, or counts ", text) for text in told)


class RfFirst(ImageServer):
    """Of the first images only the RF channel data come."""

    def _broadcast(self, batch: list[bytes]) -> None:
        super()._broadcast(batch if self.sent > 8 else batch[1:])


@pytest.mark.parametrize("server", [ImageServer, RfFirst])
def test_images_of_a_machine_that_also_sends_rf(tmp_path, server):
    """RF channel data have another size: in one recording with the images they ended the run."""
    with (
        devices(tmp_path) as (_, _, recorder, setup),
        server(changing, rf=lambda t: np.full((200, 8), int(1000 * t) % 1000, np.int16)) as machine,
    ):
        with Session(setup((machine.host, machine.port)), recorder, every_frame=True) as session:
            deadline = time.monotonic() + 60.0
            shown = {}
            while len(shown) < 10 and time.monotonic() < deadline:
                image = session.latest_image()
                if image is not None:
                    shown[image.t_device] = image.array.dtype
                time.sleep(0.005)
            # As by a queue that was full.
            session.images._counts.dropped += 3
        assert recorder.dropped["us"] >= 3
        recorder.sync()
    assert set(shown.values()) == {np.dtype(np.uint8)}
    with h5py.File(tmp_path / "r.h5") as file:
        assert file["us/frames"].shape[1:] == (40, 30)
        assert len(file["us/frames"]) >= 10


def test_a_pose_that_changes_at_rest_is_no_pose_of_an_image(tmp_path):
    """A CB controller does not tell its TCP offset, which is read only before the next move."""
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")
    with (
        devices(tmp_path, version=CB_SERIES) as (robot, _, recorder, setup),
        Session(setup(), recorder) as session,
        moving(robot, caller_s=2.0) as motion,
    ):
        stage = ProbeStage(session, motion, PLAN.targets, lambda kind, text: None)
        stage.go_to(1)
        np.testing.assert_allclose(stage.resting_pose(0.1), PLAN.targets[1], atol=0.2)
        robot.ask("tcp_offset", (0.0, 0.0, 0.102, 0.0, 0.0, 0.0))
        with pytest.raises(RefusedError, match="set the TCP offset as before"):
            stage.resting_pose(0.1)


def test_what_came_before_and_after_a_device_was_lost_is_recorded(tmp_path):
    """Frames that had just been taken from another device were lost, and all later poses."""
    drained, lost_s = [], []
    with (
        devices(tmp_path, rate_hz=100.0) as (robot, _, recorder, setup),
        ImageServer(constant, clock=robot.clock) as machine,
    ):
        with Session(setup((machine.host, machine.port)), recorder) as session:
            images, drain = session.images, session.echo.drain
            assert images is not None

            def lost() -> list:
                if drained and drained[-1]:
                    lost_s.append(robot.clock.now())
                    raise LostError("has closed the connection", device="ultrasound")
                return []

            session.echo.drain = lambda: drained.append(drain()) or drained[-1]
            images.drain = lost
            until(lambda: session._failure)
            time.sleep(0.1)
        recorder.sync()
    with h5py.File(tmp_path / "r.h5") as file:
        kept = set(file["ae/frame_id"][()])
        assert {frame.frame for frames in drained for frame in frames} <= kept
        assert file["tracker/t_host"][-1] > lost_s[0] + 0.05


def test_devices_are_closed_though_closing_was_interrupted(tmp_path, monkeypatch):
    with devices(tmp_path) as (_, _, recorder, setup):
        monkeypatch.setattr("hw.recording.session._PERIOD_WALL_S", 2.0)
        session = Session(setup(), recorder)
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            session.close()
        assert not session.echo._reader.is_alive()
        session.close()


@pytest.mark.real_time
def test_a_suspension_is_no_fault_of_a_device(tmp_path, monkeypatch):
    """A run that was suspended (Ctrl-Z) for seconds ended, and blamed the ultrasound machine."""
    script = f"sleep 0.05; kill -STOP {os.getpid()}; sleep 1.1; kill -CONT {os.getpid()}"
    with (
        devices(tmp_path) as (robot, _, recorder, setup),
        Session(setup(), recorder, watch=SilenceLimits(grace_s=0.5)) as session,
    ):
        with subprocess.Popen(["sh", "-c", script]):
            assert len(session.listen(5, robot.clock.now())) == 5
        session.check()
        monkeypatch.setattr("hw.recording.session._PERIOD_WALL_S", 1.0)
        time.sleep(0.4)
        assert "this program was suspended or held up for 0." in str(session.trouble())
