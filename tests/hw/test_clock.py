"""Bench time, errors that survive a process boundary, and extras that say how to get them."""

from __future__ import annotations

import pickle
import platform
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from hw.runtime import extras
from hw.runtime.clock import REAL, Clock, monotonic_s
from hw.runtime.errors import DeviceError, LostError, RefusedError, StaleError, StoppedError
from hw.runtime.extras import missing, require


def test_bench_time_runs_at_its_speed():
    clock = Clock(speed=50.0)
    start_wall, start = monotonic_s(), clock.now()
    clock.sleep(2.0)
    passed = clock.now() - start
    wall = monotonic_s() - start_wall
    assert wall >= 2.0 / 50.0
    assert 2.0 <= passed <= 50.0 * wall
    assert clock.wall(5.0) == pytest.approx(0.1)
    clock.sleep(-1.0)


def test_a_clock_starts_at_zero_and_is_shared_by_its_origin():
    clock = Clock(speed=3.0)
    twin = Clock(speed=clock.speed, origin_s=clock.origin_s)
    reading = monotonic_s()
    assert clock.at(reading) == twin.at(reading) == pytest.approx((reading - clock.origin_s) * 3)
    assert clock.at(clock.origin_s) == 0.0
    assert REAL.speed == 1.0


@pytest.mark.skipif(not hasattr(time, "CLOCK_MONOTONIC_RAW"), reason="there is no such clock here")
def test_ntp_does_not_change_the_rate_of_a_clock():
    """A slew of 500 ppm (adjtimex) would make every pose look 0.1 s old after six minutes."""
    before = time.clock_gettime(time.CLOCK_MONOTONIC_RAW)
    now, arrival = Clock(origin_s=0.0).now(), monotonic_s()
    assert before <= now <= arrival <= time.clock_gettime(time.CLOCK_MONOTONIC_RAW)


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


def test_a_missing_extra_is_named(monkeypatch):
    assert require("struct", extra="serial").calcsize("<H") == 2
    assert missing("struct", extra="serial") is None
    monkeypatch.setattr(extras, "robot_wheels", lambda: True)
    with pytest.raises(DeviceError, match=r'pip install "jaxcal\[robot\]"') as caught:
        require("rtde_receive_of_nowhere", extra="robot")
    assert caught.value.device == "robot"
    monkeypatch.setattr(extras, "robot_wheels", lambda: False)
    with pytest.raises(DeviceError, match=r"nothing for Python .* Use CPython 3\.11 or 3\.12"):
        require("rtde_receive_of_nowhere", extra="robot")
    assert "installs nothing for" in str(missing("rtde_of_nowhere", extra="robot"))


@pytest.mark.parametrize("version", [(3, 11, 7), (3, 12, 1), (3, 13, 0), (3, 14, 0)])
@pytest.mark.parametrize("system", ["linux", "win32", "darwin"])
@pytest.mark.parametrize("machine", ["x86_64", "aarch64", "arm64"])
def test_where_the_robot_extra_installs_something(version, system, machine, monkeypatch):
    """The program's condition is the installer's."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))
    (text,) = project["project"]["optional-dependencies"]["robot"]
    robot = Requirement(text)
    assert robot.marker is not None
    installs = robot.marker.evaluate(
        {"python_version": f"{version[0]}.{version[1]}", "sys_platform": system,
         "platform_machine": machine}
    )  # fmt: skip
    monkeypatch.setattr(sys, "version_info", version)
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert extras.robot_wheels() == installs


def test_device_processes_do_not_load_the_engine():
    program = (
        "import sys, hw.robot.mover.__main__, hw.robot._reader, hw.bench.robot; "
        "import hw.recording.writer_process; "
        "print({'jax', 'jaxtyping', 'scipy', 'asyncio'} & set(sys.modules))"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "set()"
