"""The session's own reckoning: the period of the frames is the stream's, not a guess."""

from __future__ import annotations

import numpy as np
import pytest

from hw.active_echo.device import ActiveEcho
from hw.bench.active_echo import AuspisEmulator
from hw.clock import Clock
from hw.session import frame_period

pytest.importorskip("serial", reason="needs jaxcal[serial]")


def silence(_t: float, _threshold: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(8, 50e-6), np.full(8, 900.0)


@pytest.mark.parametrize(("rate_hz", "missed"), [(12.0, 0.0), (50.0, 0.3)])
def test_the_period_of_frames_is_the_devices(rate_hz, missed):
    clock = Clock(speed=10.0)
    with (
        AuspisEmulator(silence, clock=clock, rate_hz=rate_hz, lines=8) as emulator,
        ActiveEcho(emulator.path, clock=clock, lines=8) as device,
    ):
        emulator.miss_triggers(missed)
        device.stream(True)
        frames = [device.read(1200.0) for _ in range(12)]
        hz = device.clock_hz()
    assert frame_period(frames, hz) == pytest.approx(1.0 / rate_hz, rel=0.01)
    assert frame_period(frames[:1], hz) is None
    assert frame_period(frames[::-1], hz) is None
