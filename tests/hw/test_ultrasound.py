"""The receiver against pyigtl's server, our own, and servers that do everything wrong."""

from __future__ import annotations

import contextlib
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from waiting import exhaust, until

from hw.active_echo import ActiveEcho
from hw.bench.active_echo import AuspisEmulator
from hw.bench.ultrasound import ImageServer
from hw.runtime.clock import Clock
from hw.runtime.errors import DeviceError, LostError, StaleError
from hw.ultrasound import Image, UltrasoundStream
from jaxcal.cli.common import Server
from jaxcal.io.message_content import Picture
from jaxcal.io.openigtlink import HEADER_SIZE, Message, encode

RNG = np.random.default_rng(11)
PATIENCE_S = 600.0
"""Bench time for what must come: minutes on the wall, as the machine may have other work."""
PICTURES = [RNG.integers(0, 256, (48, 64), dtype=np.uint8) for _ in range(16)]


def render(t: float) -> np.ndarray:
    return PICTURES[int(t * 1000) % 16]


def images_of(stream: UltrasoundStream, count: int) -> list[Image]:
    return [stream.read(PATIENCE_S) for _ in range(count)]


@pytest.fixture
def server() -> Iterator[ImageServer]:
    """At five times the real time, 150 images/s on the wall."""
    with ImageServer(render, clock=Clock(speed=5.0), spacing_mm=(0.1, 0.2)) as running:
        yield running


def connected(server: ImageServer, **options) -> UltrasoundStream:
    return UltrasoundStream(server.host, server.port, clock=server._clock, **options)


def test_images_of_our_server(server: ImageServer) -> None:
    with connected(server) as stream:
        images = images_of(stream, 40)
    assert [image.frame_id for image in images] == list(range(1, 41))
    for image in images:
        np.testing.assert_array_equal(image.array, render(image.t_device - 1_000_000.0))
        assert (image.spacing_mm, image.device, image.is_rf) == ((0.1, 0.2), "Image", False)
        # The machine's clock is a million seconds ahead; nothing comes before it is sent.
        assert image.t_host >= image.t_device - 1_000_000.0 - 1e-6


@contextlib.contextmanager
def pyigtl_server() -> Iterator:
    """The independent server; it takes the process's signals, which are given back."""
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl, the independent server")
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    server = pyigtl.OpenIGTLinkServer(port=0, local_server=True)
    try:
        yield server
    finally:
        server.stop()
        for number, handler in before.items():
            signal.signal(number, handler)


def test_images_and_transforms_of_pyigtl() -> None:
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl, the independent server")
    pose = np.eye(4)
    pose[:3, 3] = [1.5, -2.5, 300.25]
    with (
        pyigtl_server() as server,
        UltrasoundStream("127.0.0.1", server.server_address[1]) as stream,
    ):
        for number, picture in enumerate(PICTURES):
            pose[0, 3] = number
            server.send_message(
                pyigtl.TransformMessage(pose, device_name="ProbeToTracker", timestamp=5 + number)
            )
            server.send_message(
                pyigtl.ImageMessage(picture[None], device_name="Image", timestamp=5 + number)
            )
        server.send_message(pyigtl.StringMessage("nothing to us", device_name="Note"))
        server.send_message(
            pyigtl.ImageMessage(np.ones((1, 4, 5), np.float32), device_name="Image")
        )
        server.send_message(pyigtl.ImageMessage(np.full((1, 4, 5), -7, np.int16), device_name="RF"))
        images = images_of(stream, 17)
        transforms = stream.transforms()
        seen = stream.statistics()
    for number, (image, picture) in enumerate(zip(images, PICTURES, strict=False)):
        np.testing.assert_array_equal(image.array, picture)
        assert (image.t_device, image.frame_id) == (5 + number, 1 + number)
    assert images[16].is_rf
    np.testing.assert_array_equal(images[16].array, np.full((4, 5), -7, np.int16))
    assert [transform.matrix[0, 3] for transform in transforms] == list(range(16))
    assert all(transform.valid for transform in transforms)
    assert {transform.name for transform in transforms} == {"ProbeToTracker"}
    assert (seen.received, seen.transforms, seen.other) == (17, 16, 1)
    assert seen.unsupported == 1
    assert "scalar type 10" in seen.reason


def test_tracking_data_and_rf() -> None:
    """From our own server, since pyigtl has no TDATA."""
    bad = np.eye(4)
    bad[0, 0] = 1.5
    poses = {"ProbeToTracker": np.eye(4), "NeedleToTracker": bad}
    with (
        ImageServer(
            render, clock=Clock(speed=5.0), transforms=lambda t: poses,
            rf=lambda t: np.full((300, 128), int(t), np.int16),
        ) as server,
        connected(server) as stream,
    ):  # fmt: skip
        images = images_of(stream, 20)
        transforms = stream.transforms()
    assert [image.is_rf for image in images] == [False, True] * 10
    assert images[1].array.shape == (300, 128)
    assert images[1].array[0, 0] == int(images[1].t_device - 1_000_000.0)
    assert [transform.name for transform in transforms[:2]] == list(poses)
    assert [transform.valid for transform in transforms[:2]] == [True, False]


def test_one_device_only() -> None:
    with (
        ImageServer(
            render, clock=Clock(speed=5.0), rf=lambda t: np.ones((9, 8), np.int16)
        ) as server,
        connected(server, device="RF") as stream,
    ):
        assert all(image.is_rf for image in images_of(stream, 10))
        assert stream.statistics().other > 5


def test_stale_frozen_and_back(server: ImageServer) -> None:
    with connected(server) as stream:
        images_of(stream, 3)
        server.fault(stale=True)
        with pytest.raises(StaleError, match="no new image from"):
            exhaust(stream, 1.0)
        server.recover()
        last = images_of(stream, 3)[-1]
        server.fault(frozen=True)
        until(lambda: stream.statistics().repeated > 3)
        with pytest.raises(StaleError, match="is the machine frozen"):
            exhaust(stream, 1.0)
        server.recover()
        assert stream.read(PATIENCE_S).t_device > last.t_device
        assert stream.statistics().lost == 0


def test_late_images_stay_late_when_the_machines_clock_is_set_back() -> None:
    """They counted as prompt: an image of before the probe came to rest was measured."""
    stream = UltrasoundStream("127.0.0.1", 1)
    picture = Picture(np.zeros((4, 4), np.uint8), (1.0, 1.0))
    late = []
    for t_host, t_device in (
        (1.0, 100.0), (1.8, 100.1), (1.9, 100.2), (2.0, 99.3), (2.1, 99.4), (2.2, 100.2),
    ):  # fmt: skip
        stream._take(Message("IMAGE", "Image", t_device, picture, t_host=t_host))
        late.append(stream._images[-1].late_s)
    np.testing.assert_allclose(late, [0.0, 0.7, 0.7, 0.7, 0.7, 0.0], atol=1e-3)


def test_dropped_connection(server: ImageServer) -> None:
    with connected(server) as stream:
        images_of(stream, 3)
        server.drop()
        with pytest.raises(LostError, match=r"ultrasound: .* has closed the connection"):
            exhaust(stream, PATIENCE_S)
        with pytest.raises(LostError):
            stream.drain()
        with pytest.raises(DeviceError, match="started before"):
            stream.start()
    with connected(server) as stream:
        images_of(stream, 3)
    server.stop()
    with pytest.raises(DeviceError, match=r"no OpenIGTLink server at 127.0.0.1:\d+ \(.*refused"):
        connected(server).start()


def test_an_error_that_nobody_expected_ends_the_stream(server: ImageServer, monkeypatch) -> None:
    """It ended the receiver's thread alone: the machine seemed to be frozen."""
    with connected(server) as stream:
        monkeypatch.setattr(stream, "_last", None)
        with pytest.raises(LostError, match="AttributeError"):
            exhaust(stream, PATIENCE_S)


def test_corrupted_images_are_counted(server: ImageServer) -> None:
    """Every image handed on is one that was made; those missing are counted."""
    with connected(server, queue=1000) as stream:
        first = stream.read(PATIENCE_S).frame_id
        server.fault(corrupt=0.4)
        until(lambda: server.sent > 120)
        server.recover()
        images = images_of(stream, 60)
        server.fault(stale=True)
        with contextlib.suppress(StaleError):
            while True:
                images.append(stream.read(1.0))
        seen = stream.statistics()
    known = {picture.tobytes() for picture in PICTURES}
    assert all(image.array.tobytes() in known for image in images)
    assert seen.crc_errors > 5
    assert seen.resynchronised > 5
    # A wrong bit in the device's name makes another device of it.
    own = [image.frame_id for image in images if image.device == "Image"]
    assert 10 < own[-1] - first - len(own) <= seen.lost + seen.other
    assert seen.dropped == 0


def test_full_queue(server: ImageServer) -> None:
    with connected(server, queue=3) as stream:
        until(lambda: stream.statistics().received > 20)
        server.stop()
        until(lambda: stream._failure is not None)
        images = stream.drain()
        seen = stream.statistics()
    assert len(images) == 3
    assert seen.received == seen.dropped + 3
    assert seen.lost == 0


def test_a_client_that_takes_nothing_harms_nobody(server: ImageServer) -> None:
    """It loses whole images at the server; the other client loses none."""
    with socket.create_connection((server.host, server.port)) as sleeper, connected(
        server, queue=10_000
    ) as stream:  # fmt: skip
        server._render = lambda t: np.zeros((1000, 1000), np.uint8)
        until(lambda: server.refused > 5)
        seen = stream.statistics()
        assert sum(client.size for client in server._clients.values()) < 40 << 20
        sleeper.close()
    assert seen.lost == seen.crc_errors == 0


@contextlib.contextmanager
def peer(talk: Callable[[socket.socket], None]) -> Iterator[UltrasoundStream]:
    """A stream from a server that does as told, once."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def run() -> None:
            connection, _ = listener.accept()
            with connection, contextlib.suppress(OSError):
                talk(connection)

        thread = threading.Thread(target=run)
        thread.start()
        with UltrasoundStream("127.0.0.1", listener.getsockname()[1]) as stream:
            yield stream
        thread.join()


def one(number: int) -> bytes:
    return encode(
        Message("IMAGE", "Image", float(number), Picture(PICTURES[0], (1.0, 1.0)), number)
    )


def test_headers_and_bodies_in_drops() -> None:
    """Split anywhere, with pauses: what desynchronises pyigtl."""
    begun = threading.Event()

    def talk(connection: socket.socket) -> None:
        data = one(1) + one(2) + one(3)
        for start in (*range(0, 120, 7), *range(120, len(data), 700)):
            end = start + 7 if start < 120 else start + 700
            end = min(end, 120) if start < 120 else end
            connection.sendall(data[start:end])
            if start == 0:
                begun.wait()
            time.sleep(0.06 if start < 21 else 0.001)
        connection.recv(1)

    with peer(talk) as stream:
        until(lambda: stream._decoder.held == 7)
        begun.set()
        images = images_of(stream, 3)
        assert [image.frame_id for image in images] == [1, 2, 3]
        assert images[0].t_host < images[1].t_host - 0.1
        assert stream.statistics().crc_errors == 0


def test_a_body_that_never_ends() -> None:
    """32 MB announced and 1 kB sent: the reader is told in time, and nothing was allocated."""

    def talk(connection: socket.socket) -> None:
        header = struct.pack(">H12s20sIIQQ", 1, b"STRING", b"S", 0, 0, 32 << 20, 1)
        connection.sendall(one(1) + header + b"x" * 1000)
        connection.recv(1)

    with peer(talk) as stream:
        assert stream.read(PATIENCE_S).frame_id == 1
        until(lambda: stream._decoder.held == HEADER_SIZE + 1000)
        with pytest.raises(StaleError):
            stream.read(0.3)
        assert stream._decoder.held == HEADER_SIZE + 1000


def test_rubbish_of_any_size() -> None:
    """Megabytes of noise before, between and after: the images are found, memory stays."""
    rng = np.random.default_rng(2)
    held = []

    def talk(connection: socket.socket) -> None:
        for number in range(1, 6):
            connection.sendall(rng.bytes(1_000_000) + one(number))
        connection.recv(1)

    with peer(talk) as stream:
        for number in range(1, 6):
            assert stream.read(PATIENCE_S).frame_id == number
            held.append(stream._decoder.held)
        assert stream.statistics().resynchronised == 5
    assert max(held) < 2 << 20


def test_a_peer_that_invents_devices() -> None:
    def talk(connection: socket.socket) -> None:
        picture = Picture(np.zeros((2, 2), np.uint8), (1.0, 1.0))
        connection.sendall(
            b"".join(encode(Message("IMAGE", f"D{k}", 1.0 + k, picture, k)) for k in range(1, 500))
        )
        connection.recv(1)

    with peer(talk) as stream:
        until(lambda: stream.statistics().received == 499)
        assert len(stream._last) <= 64
        assert stream.statistics().dropped == 499 - 64


def test_a_queue_holds_no_end_of_large_images(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hw.ultrasound.receiver._QUEUE_BYTES", 5 * PICTURES[0].nbytes)

    def talk(connection: socket.socket) -> None:
        connection.sendall(b"".join(one(k) for k in range(1, 31)))
        connection.recv(1)

    with peer(talk) as stream:
        until(lambda: stream.statistics().received == 30)
        assert [image.frame_id for image in stream.drain()] == [26, 27, 28, 29, 30]
        assert stream.statistics().dropped == 25


@pytest.mark.parametrize("seconds", [1.5, pytest.param(60.0, marks=pytest.mark.slow)])
def test_nothing_is_lost_at_thirty_frames_a_second(seconds: float) -> None:
    """Images of 640 x 480 and active-echo frames at once, in real time, read as they come."""
    rng = np.random.default_rng(3)
    pictures = [rng.integers(0, 256, (480, 640), dtype=np.uint8) for _ in range(8)]
    tof, amplitude = rng.uniform(1e-6, 6e-5, 128), rng.uniform(0, 4000, 128)
    with (
        ImageServer(lambda t: pictures[int(t * 1000) % 8]) as server,
        AuspisEmulator(lambda t, threshold: (tof, amplitude)) as emulator,
        UltrasoundStream(server.host, server.port) as stream,
        ActiveEcho(emulator.path) as device,
    ):
        device.stream(True)
        images, frames = [], []
        end = time.monotonic() + seconds
        # A machine that is loaded makes the bench slip; it loses nothing by that.
        while time.monotonic() < end or min(len(images), len(frames)) <= 15 * seconds:
            assert time.monotonic() < end + 180.0
            images += [(image.frame_id, image.t_device) for image in stream.drain()]
            frames += [frame.frame for frame in device.drain()]
            time.sleep(0.02)
        seen, heard = stream.statistics(), device.statistics()
    assert np.diff([number for number, _ in images]).tolist() == [1] * (len(images) - 1)
    assert np.diff(frames).tolist() == [1] * (len(frames) - 1)
    assert seen.lost == seen.dropped == seen.crc_errors == server.refused == 0
    assert heard.lost == heard.dropped == heard.crc_errors == emulator.refused == 0


@pytest.mark.parametrize("host", ["::1", "127.0.0.1", "plus"])
def test_the_command_line_takes_an_address_as_it_is_told(host):
    """As where a run ended, with the command that goes on."""
    told = UltrasoundStream(host, 80).address
    assert Server().convert(told, None, None) == (host, 80)
