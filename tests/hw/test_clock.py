"""Bench time, errors that survive a process boundary, and extras that say how to get them."""

from __future__ import annotations

import pickle
import subprocess
import sys
import time

import pytest

from hw.clock import REAL, Clock
from hw.errors import DeviceError, LostError, RefusedError, StaleError, StoppedError
from hw.extras import require


def test_bench_time_runs_at_its_speed():
    clock = Clock(speed=50.0)
    start_wall, start = time.monotonic(), clock.now()
    clock.sleep(2.0)
    passed = clock.now() - start
    wall = time.monotonic() - start_wall
    assert wall >= 2.0 / 50.0
    assert 2.0 <= passed <= 50.0 * wall
    assert clock.wall(5.0) == pytest.approx(0.1)
    clock.sleep(-1.0)


def test_a_clock_starts_at_zero_and_is_shared_by_its_origin():
    clock = Clock(speed=3.0)
    twin = Clock(speed=clock.speed, origin_s=clock.origin_s)
    reading = time.monotonic()
    assert clock.at(reading) == twin.at(reading) == pytest.approx((reading - clock.origin_s) * 3)
    assert clock.at(clock.origin_s) == 0.0
    assert REAL.speed == 1.0


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_clock_that_cannot_run_is_refused(speed):
    with pytest.raises(ValueError, match="speed"):
        Clock(speed=speed)


@pytest.mark.parametrize("kind", [DeviceError, StaleError, LostError, RefusedError, StoppedError])
def test_errors_are_one_line_and_know_their_device(kind):
    error = kind("no pose\n  for 0.3 s", device="robot")
    again = pickle.loads(pickle.dumps(error))
    assert str(error) == str(again) == "robot: no pose for 0.3 s"
    assert type(again) is kind
    assert again.device == "robot"
    assert isinstance(error, DeviceError)


def test_a_missing_extra_is_named():
    assert require("struct", extra="serial").calcsize("<H") == 2
    with pytest.raises(DeviceError, match=r'pip install "jaxcal\[robot\]"') as caught:
        require("rtde_receive_of_nowhere", extra="robot")
    assert caught.value.device == "robot"


def test_device_processes_do_not_load_the_engine():
    program = "import sys, hw.clock, hw.errors, hw.extras; print('jax' in sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "False"
