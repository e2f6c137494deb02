"""The assembled bench: one process, every device from one world, faults and truth on request."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from waiting import until

pytest.importorskip("serial", reason="pyserial is not installed")
pytest.importorskip("cobs", reason="cobs is not installed")

from hw.active_echo.device import ActiveEcho
from hw.bench.run import Bench, BenchOptions, start_bench
from hw.bench.world import make_world
from hw.midplane.pattern_injection import BAR_DELAY_S, bar
from hw.ultrasound.receiver import UltrasoundStream
from jaxcal import InputError

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def bench():
    with start_bench(speed=5.0, seed=0, repeatability_mm=0.0) as running:
        yield running


def listen(bench: Bench, threshold: int, frames: int):
    """Frames after a threshold was set."""
    with ActiveEcho(bench.active_echo_url, clock=bench.clock, lines=128) as echo:
        echo.set_threshold(threshold)
        echo.stream(True)
        return [echo.read(600.0) for _ in range(frames)]


def test_truth_is_the_worlds(bench):
    world = make_world(0)
    told = bench.world_truth()
    np.testing.assert_allclose(told["image_to_probe"], world.image_to_probe)
    np.testing.assert_allclose(told["point_mm"], world.point_mm)
    pose = bench.true_pose()
    place = world.truth(pose)
    expected = [place.lateral_mm, place.range_mm, place.elevation_mm]
    np.testing.assert_allclose(bench.truth(pose), expected)
    np.testing.assert_allclose(bench.truth(np.stack([pose, pose])), [expected, expected])
    poses, points = bench.test_set(7, seed=3)
    for told, drawn in zip((poses, points), world.test_set(7, 3), strict=True):
        np.testing.assert_allclose(told, drawn)
    np.testing.assert_allclose(bench.scene.image_to_probe, world.scene.image_to_probe)
    assert bench.probe == world.probe
    assert bench.rest_since() == 0.0


def test_echo_of_the_true_pose_comes_through_the_port(bench):
    frames = listen(bench, 50, 5)
    lateral, _, elevation = bench.truth(bench.true_pose())
    axial = np.sqrt(bench.truth(bench.true_pose())[1] ** 2 - elevation**2)
    way = np.linalg.norm(bench.probe.element_positions() - [lateral, elevation, axial], axis=1)
    exact = way / (1e3 * bench.probe.sound_speed_m_s)
    middle = np.nanmedian([frame.tof_s for frame in frames], axis=0)
    heard = np.isfinite(middle)
    assert heard.sum() > 40
    # A line may be a reflection's; the rest is noise of 20 ns and ticks of 10 ns.
    assert np.median(np.abs(middle - exact)[heard]) < 3e-8


def test_images_show_the_injected_bar_below_the_echo(bench):
    _, depth, _ = bench.truth(bench.true_pose())
    below = depth + 0.5e3 * bench.probe.sound_speed_m_s * BAR_DELAY_S
    row = round(below / bench.spacing_mm[1])
    with (
        UltrasoundStream(*bench.ultrasound, clock=bench.clock) as stream,
        ActiveEcho(bench.active_echo_url, clock=bench.clock, lines=128) as echo,
    ):
        echo.set_threshold(10)

        def brightness(count: int) -> float:
            array = [stream.read(600.0).array for _ in range(count)][-1]
            assert array.shape == (480, 640)
            return float(array[row, 300:340].mean())

        before = brightness(3)
        echo.load_pattern(bar(31, 64, 128))
        echo.inject(True, BAR_DELAY_S)
        until(lambda: brightness(1) > 250)
        assert brightness(1) == 255
        assert before < 200
        echo.inject(False)
        until(lambda: brightness(1) < 250)
        assert brightness(1) < 200


def test_faults_come_and_go(bench):
    with ActiveEcho(bench.active_echo_url, clock=bench.clock, lines=128) as echo:
        echo.stream(True)
        echo.read(600.0)
        at = bench.fault("crc_errors", rate=1.0)
        assert at <= bench.clock.now()
        until(lambda: echo.statistics().crc_errors >= 5)
        bench.recover()
        echo.drain()
        assert echo.read(600.0).frame > 0
    with pytest.raises(RuntimeError, match="no fault 'gremlins'"):
        bench.fault("gremlins")
    with pytest.raises(RuntimeError, match="TypeError"):
        bench.fault("mute", loudly=True)


def test_two_benches_side_by_side(bench):
    with start_bench(speed=5.0, seed=9) as other:
        assert other.robot_host != bench.robot_host
        assert not np.allclose(other.true_pose(), bench.true_pose(), atol=1e-6)


def test_options_that_cannot_be_are_one_line():
    with pytest.raises(InputError, match="speed"):
        BenchOptions(speed=0.0)
    with pytest.raises(InputError, match="125 or 500"):
        BenchOptions(pose_hz=60)
    with pytest.raises(InputError, match="did not start: the simulated world has no 'colour'"):
        start_bench(world={"colour": 1.0})


def test_a_bench_ends_with_whoever_started_it():
    code = (
        "import os\nfrom hw.bench.run import start_bench\n"
        "print(start_bench(speed=5.0).pid, flush=True)\nos._exit(1)\n"
    )
    started = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False,
    )  # fmt: skip
    until(lambda: not Path(f"/proc/{int(started.stdout)}").exists())
