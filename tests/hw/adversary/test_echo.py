"""A link to the active echo element that delays and repeats what it carries."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from echo_bridge import Bridge

pytest.importorskip("serial", reason="pyserial is not installed")

from hw.active_echo import ActiveEcho, EchoFrame
from hw.bench.active_echo import AuspisEmulator

LINES = 16


def echo(t: float, threshold: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(LINES, 20e-6), np.full(LINES, 500.0)


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
        # What was on its way before came once; on a busy machine that may be many.
        while device.statistics().repeated < 16:
            frames += next_frames(device, 1)
            assert len(frames) < 500
        numbers = [frame.frame for frame in frames]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        counts = device.statistics()
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
