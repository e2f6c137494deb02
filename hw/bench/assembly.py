"""World, arm, electronics and ultrasound machine of one emulated bench, put together."""

from __future__ import annotations

import math
import os
import queue
import random
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np

from hw.bench.active_echo import AuspisEmulator
from hw.bench.arm import Arm
from hw.bench.control import ControlServer
from hw.bench.frames import Camera
from hw.bench.robot import RobotProcess, model_of
from hw.bench.rtde import CB_SERIES, E_SERIES
from hw.bench.ultrasound import ImageServer
from hw.bench.world import make_world
from hw.planning.scene import Scene
from hw.robot.rtde import nominal_hz
from hw.runtime.clock import Clock
from hw.runtime.rigid import looking_rotation, pose_to_ur, ur_to_pose
from jaxcal import InputError
from jaxcal.runtime.array_types import Float

VERSIONS = {int(nominal_hz(version[0])): version for version in (CB_SERIES, E_SERIES)}
"""Controllers that the real client accepts, by their rate: a CB-series and an e-Series."""

_OF_THE_ROBOT: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("mute", "drop", "protective_stop", "unlock"), ()),
    "robot_state": ("robot_mode", "safety_mode"),
    "remote": ("on",),
    "tcp_offset": ("offset",),
    "payload": ("mass_kg",),
    "speed_slider": ("fraction",),
}
"""Faults of the robot (:meth:`hw.bench.rtde.RtdeServer.act`), and the names of their values."""

_IMAGE_HZ = 30.0
"""Ultrasound frames per bench second."""
_ADDRESS_TRIES = 8
_HOVER_MM = 70.0


@dataclass(frozen=True)
class BenchOptions:
    """How to run a bench.

    Attributes:
        speed: bench seconds per wall second.
        seed: of the world, and of all chance.
        pose_hz: of the robot's stream in bench time, 125 or 500: which controller it is.
        most_images_wall_hz: cap on ultrasound frames per wall second.
        most_poses_wall_hz: cap on poses of the robot's stream per wall second.
        repeatability_mm: SD of the arm's hidden error on each axis.
        phantom: in the tank, by name (:mod:`hw.bench.phantoms`).
        world: further changes of the world, by name (see :func:`hw.bench.world.make_world`).
    """

    speed: float = 1.0
    seed: int = 0
    pose_hz: int = 125
    most_images_wall_hz: float = 60.0
    most_poses_wall_hz: float = 1000.0
    repeatability_mm: float = 0.1
    phantom: str = "active-echo"
    world: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, least, largest in (
            ("speed", 0.01, 100.0),
            ("most_images_wall_hz", 0.1, 1000.0),
            ("most_poses_wall_hz", 50.0, 1000.0),
            ("repeatability_mm", 0.0, 10.0),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and least <= value <= largest):
                raise InputError(f"bench: {name} must be {least:g} to {largest:g}, not {value}")
        if self.pose_hz not in VERSIONS:
            raise InputError(f"bench: pose_hz must be 125 or 500, not {self.pose_hz}")


class Assembly:
    """World and devices of one bench, in this process; :meth:`start` them.

    Args:
        options: how to run the bench.

    Attributes:
        world: the simulated world.
        clock: bench time.
        arm: a mirror of the arm in the robot's own process.
    """

    def __init__(self, options: BenchOptions) -> None:
        self.options = options
        self.world = make_world(options.seed, phantom=options.phantom, **options.world)
        self.clock = Clock(options.speed)
        start = pose_to_ur(hovering(self.world.scene))
        self.arm = Arm(
            start.tolist(),
            tcp_offset=(0.0, 0.0, 0.12, 0.0, 0.0, 0.0),
            repeatability_mm=options.repeatability_mm,
            seed=options.seed,
            model=model_of(VERSIONS[options.pose_hz]),
        )
        self.camera = Camera(self.world, seed=options.seed)
        self._echo_rng = np.random.default_rng([options.seed, 1])
        self._frame_rng = np.random.default_rng([options.seed, 2])
        self.echo = AuspisEmulator(
            self._hear,
            clock=self.clock,
            lines=self.world.probe.elements,
            clock_hz=self.world.clock_hz,
            seed=options.seed,
        )
        self.images = ImageServer(
            self._see,
            clock=self.clock,
            rate_hz=min(_IMAGE_HZ, options.most_images_wall_hz / options.speed),
            spacing_mm=self.camera.spacing_mm,
            seed=options.seed,
        )
        self.robot: RobotProcess | None = None
        echo, images = self.echo, self.images
        self._faults: dict[str, Callable[..., object]] = {
            "crc_errors": lambda rate: echo.fault(crc_errors=float(rate)),
            "miss_triggers": lambda rate: echo.fault(missed_triggers=float(rate)),
            "miss_lines": lambda rate: echo.fault(missed_lines=float(rate)),
            "echo_stale": lambda: echo.fault(stale=True),
            "echo_mute": lambda: echo.fault(mute=True),
            "unplug": echo.unplug,
            "replug": echo.replug,
            "image_stale": lambda: images.fault(stale=True),
            "image_freeze": lambda: images.fault(frozen=True),
            "image_drop": images.drop,
            "image_corrupt": lambda rate: images.fault(corrupt=float(rate)),
        }
        self._unplugged = False
        self._done: queue.SimpleQueue[None] = queue.SimpleQueue()
        self.control = ControlServer(
            {
                "fault": self._fault,
                "recover": self._recover,
                "truth": self._truth,
                "true_pose": lambda: self.true_pose(self.clock.now()).tolist(),
                "rest_since": self._rest_since,
                "world": self._world,
                "test_set": lambda **of: [part.tolist() for part in self.world.test_set(**of)],
                "robot": self._robot,
                "close": self.end,
            }
        )

    # What the devices notice

    def true_pose(self, t: float) -> Float[np.ndarray, "4 4"]:
        """Where the tool centre point truly is at bench time t, mm."""
        return ur_to_pose(np.array(self.arm.true_raw(t)))

    def _hear(self, t: float, threshold: int) -> tuple[np.ndarray, np.ndarray]:
        times, amplitude = self.world.echo(self.true_pose(t), threshold, self._echo_rng)
        # The world's times are whole ticks; the counter rounds down and must not lose one.
        return times + 0.25 / self.world.clock_hz, amplitude

    def _see(self, t: float) -> np.ndarray:
        then = t - self.world.noise.latency_s
        injection = self.echo.injection
        return self.camera.frame(
            self.true_pose(then),
            self._frame_rng,
            threshold=self.echo.threshold,
            pattern=injection.pattern if injection.on and injection.pattern else None,
            pattern_delay_s=injection.delay_ticks / self.world.clock_hz,
        )

    # Life

    def start(self) -> dict:
        """Start every device; returns what a client must know, to be sent as JSON."""
        self.robot = self._start_robot()
        self.echo.start()
        self.images.start()
        self.control.start()
        world = self.world
        return {
            "speed": self.clock.speed,
            "origin_s": self.clock.origin_s,
            "robot_host": self.robot.host,
            "robot_serial": self.robot.serial,
            "pose_hz": self.robot.frequency_hz,
            "tcp_offset": list(self.arm.tcp_offset),
            "active_echo_url": self.echo.path,
            "ultrasound": [self.images.host, self.images.port],
            "control": self.control.port,
            "spacing_mm": list(self.camera.spacing_mm),
            "clock_hz": world.clock_hz,
            "scene": {name: np.asarray(part).tolist() for name, part in vars(world.scene).items()},
            "probe": asdict(world.probe),
            "seed": self.options.seed,
        }

    def _start_robot(self) -> RobotProcess:
        chance = random.Random(os.getpid())
        hosts = [
            f"127.0.{chance.randrange(256)}.{chance.randrange(2, 255)}"
            for _ in range(_ADDRESS_TRIES)
        ]
        trouble: OSError | None = None
        for host in [*hosts, "127.0.0.1"]:
            server = RobotProcess(
                self.arm,
                host,
                version=VERSIONS[self.options.pose_hz],
                clock=self.clock,
                max_rate_hz=self.options.most_poses_wall_hz,
            )
            try:
                return server.start()
            except OSError as error:
                trouble = error
        raise InputError(f"bench: the robot's ports are taken at 127.0.0.1: {trouble}")

    def stop(self) -> None:
        """Stop every device; safe to repeat."""
        self.control.stop()
        self.images.stop()
        self.echo.stop()
        if self.robot is not None:
            self.robot.stop()

    def wait(self) -> None:
        """Wait until somebody asks for the end."""
        self._done.get()

    def end(self) -> None:
        """Ask for the end."""
        self._done.put(None)

    # Requests

    def _fault(self, name: str = "", **request: object) -> float:
        """Bench time at which the fault was in force."""
        if name in _OF_THE_ROBOT:
            assert self.robot is not None
            wanted = _OF_THE_ROBOT[name]
            if set(request) != set(wanted):
                raise TypeError(f"{name} takes {', '.join(wanted) or 'no values'}")
            return self.robot.ask(name, *(request[key] for key in wanted))
        if name not in self._faults:
            known = ", ".join([*_OF_THE_ROBOT, *self._faults])
            raise InputError(f"no fault {name!r}; there are: {known}")
        self._faults[name](**request)
        if name == "unplug":
            self._unplugged = True
        return self.clock.now()

    def _recover(self) -> None:
        """End the devices' faults. A protective stop and changes at the pendant stay."""
        if self.robot is not None:
            self.robot.ask("unmute")
        if self._unplugged:
            self.echo.replug()
            self._unplugged = False
        self.echo.recover()
        self.images.recover()

    def _truth(self, pose: list) -> list:
        poses = np.asarray(pose, float).reshape(-1, 4, 4)
        places = [self.world.truth(each) for each in poses]
        return [[place.lateral_mm, place.range_mm, place.elevation_mm] for place in places]

    def _rest_since(self) -> float | None:
        since = self.arm.rest_since(self.clock.now())
        return None if since is None else max(since, 0.0)

    def _world(self) -> dict:
        return {
            "image_to_probe": self.world.image_to_probe.tolist(),
            "point_mm": self.world.point_mm.tolist(),
            "sound_speed_m_s": self.world.sound_speed_m_s,
            "latency_s": self.world.noise.latency_s,
        }

    def _robot(self) -> dict:
        """Whether the controller's program runs, and why it last stopped."""
        assert self.robot is not None
        state = self.robot.state()
        return {name: state[name] for name in ("running", "reason")}


def hovering(scene: Scene) -> Float[np.ndarray, "4 4"]:
    """Where the arm waits: looking at the nominal target from 70 mm, tool -> base, mm."""
    pose = np.eye(4)
    pose[:3, :3] = looking_rotation(scene.looking) @ scene.image_to_probe[:3, :3].T
    looking = np.asarray(scene.looking, float)
    tip = scene.point_mm - _HOVER_MM * looking / np.linalg.norm(looking)
    pose[:3, 3] = tip - pose[:3, :3] @ scene.tip_mm
    return pose
