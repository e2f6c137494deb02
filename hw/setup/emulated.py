"""The emulated bench as a setup, in place of a lab's TOML file."""

from __future__ import annotations

from hw.bench.run import Bench, BenchOptions, start_bench
from hw.setup.description import Setup

SPEED = 5.0
"""Bench seconds per second on the wall, unless asked otherwise."""

_IMAGES_WALL_HZ = 10.0


def start(
    seed: int,
    speed: float,
    pose_hz: int = BenchOptions.pose_hz,
    phantom: str = BenchOptions.phantom,
) -> Bench:
    """Start a bench for an acquisition.

    Args:
        seed: of the world.
        speed: bench seconds per second on the wall.
        pose_hz: of the robot; it decides the series (:class:`hw.bench.run.BenchOptions`).
        phantom: in the tank (:mod:`hw.bench.phantoms`).

    Raises:
        InputError: an impossible speed.
    """
    return start_bench(
        seed=seed,
        speed=speed,
        pose_hz=pose_hz,
        most_images_wall_hz=_IMAGES_WALL_HZ,
        most_poses_wall_hz=min(max(62.5 * speed, 125.0), 1000.0),
        phantom=phantom,
    )


def setup_of(bench: Bench) -> Setup:
    """Addresses, scene and limits of a running bench."""
    x, y, z = (float(value) for value in bench.scene.point_mm)
    return Setup(
        robot_host=bench.robot_host,
        active_echo_url=bench.active_echo_url,
        ultrasound=bench.ultrasound,
        scene=bench.scene,
        probe=bench.probe,
        clock=bench.clock,
        tcp_offset=bench.tcp_offset,
        limits={
            "box_min_mm": [x - 200.0, y - 200.0, z - 45.0],
            "box_max_mm": [x + 200.0, y + 200.0, z + 200.0],
            "cone_axis": [0.0, 0.0, -1.0],
            "cone_deg": 60.0,
            "max_step_mm": 250.0,
            "max_turn_deg": 120.0,
            "max_speed_mm_s": 100.0,
            "max_acceleration_mm_s2": 1000.0,
            "search_mm": 25.0,
            "search_deg": 0.5,
        },
    )
