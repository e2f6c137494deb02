"""A link to the active echo element that delays and repeats what it carries."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("serial", reason="pyserial is not installed")

from hw.active_echo import ActiveEcho, EchoFrame
from hw.bench.active_echo import AuspisEmulator

LINES = 16


def echo(t: float, threshold: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(LINES, 20e-6), np.full(LINES, 500.0)


class Bridge:
    """A serial-to-network bridge: holds the device's bytes back, and sends packets again."""

    def __init__(self, url: str) -> None:
        host, port = url.removeprefix("socket://").split(":")
        self.delay_s, self.again = 0.0, 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = "socket://{}:{}".format(*self._listener.getsockname())
        self._device = socket.create_connection((host, int(port)))
        self._open = True
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._accept, self._deliver)
        ]
        self._held: list[tuple[float, bytes]] = []
        self._client: socket.socket | None = None
        for thread in self._threads:
            thread.start()

    def _accept(self) -> None:
        try:
            self._client, _ = self._listener.accept()
            while data := self._client.recv(4096):
                self._device.sendall(data)
        except OSError:
            pass

    def _deliver(self) -> None:
        rest = b""
        self._device.settimeout(0.005)
        while self._open:
            try:
                rest += self._device.recv(65536)
            except TimeoutError:
                pass
            except OSError:
                return
            # Frames, and replies while frames come, end in a zero; other replies are lines.
            whole, found, rest = rest.rpartition(b"\0" if b"\0" in rest else b"\n")
            for packet in (whole + found).split(b"\0")[:-1] if found == b"\0" else [whole + found]:
                end = b"\0" if found == b"\0" else b""
                copies = 1 + (self.again if len(packet) > 40 else 0)
                self._held += [(time.monotonic() + self.delay_s, packet + end)] * copies
            while self._held and self._client and self._held[0][0] <= time.monotonic():
                try:
                    self._client.sendall(self._held.pop(0)[1])
                except OSError:
                    return

    def close(self) -> None:
        self._open = False
        for one in (self._listener, self._device, self._client):
            if one is not None:
                one.close()
        for thread in self._threads:
            thread.join(5.0)


@pytest.fixture
def bridge() -> Iterator[Bridge]:
    with AuspisEmulator(echo, lines=LINES, link="tcp", rate_hz=100.0) as device:
        between = Bridge(device.path)
        yield between
        between.close()


def next_frames(device: ActiveEcho, count: int) -> list[EchoFrame]:
    return [device.read(180.0) for _ in range(count)]


def test_frames_that_come_twice_are_used_once_and_counted(bridge):
    with ActiveEcho(bridge.url, lines=LINES) as device:
        device.stream(True)
        next_frames(device, 3)
        bridge.again = 2
        frames = next_frames(device, 12)
        numbers = [frame.frame for frame in frames]
        assert numbers == list(range(numbers[0], numbers[0] + 12))
        counts = device.statistics()
    assert counts.repeated >= 16
    assert (counts.restarts, counts.lost) == (0, 0)


@pytest.mark.parametrize("constant", [True, False])
def test_a_delay_is_seen_by_the_devices_ticks(bridge, constant):
    with ActiveEcho(bridge.url, lines=LINES) as device:
        device.stream(True)
        next_frames(device, 2)
        if constant:
            bridge.delay_s = 0.6
        device.measure_delay()
        prompt = next_frames(device, 40)[-1]
        assert not np.isnan(prompt.late_s)
        if not constant:
            assert prompt.late_s < 0.3
            bridge.delay_s = 0.6
            deadline = time.monotonic() + 180.0
            # Nobody asks again: the ticks tell.
            while (prompt := next_frames(device, 1)[0]).late_s < 0.6:
                assert time.monotonic() < deadline
        assert 0.6 <= prompt.late_s < 1.2
