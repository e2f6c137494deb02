"""The emulated bench: one world behind three devices and a control socket, in a process of its own.

It prints one JSON line with the addresses and serves until its standard input ends, so that a bench
never outlives the process that started it. Programs call :func:`start_bench`, a person
``jaxcal-hw bench``.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from dataclasses import asdict
from typing import Any

import numpy as np

from hw.bench.assembly import Assembly, BenchOptions
from hw.bench.control import ControlClient
from hw.planning.scene import Scene
from hw.runtime.clock import Clock
from hw.runtime.processes import finish, first_line, spawn
from jaxcal import InputError
from jaxcal.data.probe import LinearProbe
from jaxcal.runtime.array_types import Float

__all__ = ["Bench", "BenchOptions", "main", "serve", "start_bench"]

_START_WALL_S = 60.0


class Bench:
    """A running bench in a process of its own; a context manager.

    Args:
        process: the bench's; it ends when its standard input ends.
        told: the JSON line that it printed.

    Attributes:
        clock: shared with the emulators.
        robot_host: loopback address of the controller.
        tcp_offset: (6,) m and rad, of the controller at the start.
        active_echo_url: what to open.
        ultrasound: (host, port).
        scene: what a person knows.
        probe: the transducer.
        spacing_mm: [lateral, axial] of the images.
    """

    def __init__(self, process: subprocess.Popen, told: dict) -> None:
        self._process = process
        self.clock = Clock(told["speed"], told["origin_s"])
        self.robot_host = told["robot_host"]
        self.tcp_offset: tuple[float, ...] = tuple(told["tcp_offset"])
        self.active_echo_url = told["active_echo_url"]
        self.ultrasound: tuple[str, int] = (told["ultrasound"][0], told["ultrasound"][1])
        self.spacing_mm = tuple(told["spacing_mm"])
        self.scene = Scene(**{name: np.array(value) for name, value in told["scene"].items()})
        self.probe = LinearProbe(**told["probe"])
        self._control = ControlClient(told["control"])

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Id of the bench's process."""
        return self._process.pid

    def fault(self, name: str, **arguments: object) -> float:
        """Cause a fault; returns the bench time at which it was in force.

        Args:
            name: mute, drop, protective_stop, unlock, robot_state (robot_mode, safety_mode),
                remote (on), tcp_offset (offset), payload
                (mass_kg), speed_slider (fraction), crc_errors (rate),
                miss_triggers (rate), miss_lines (rate), echo_stale, echo_mute, unplug, replug,
                image_stale, image_freeze, image_drop or image_corrupt (rate).
            arguments: of the fault.

        Raises:
            RuntimeError: no such fault, or the bench is gone.
        """
        return self._control.ask("fault", name=name, **arguments)

    def recover(self) -> None:
        """End the devices' faults; changes at the pendant stay.

        A protective stop needs ``fault("unlock")``.
        """
        self._control.ask("recover")

    def true_pose(self) -> Float[np.ndarray, "4 4"]:
        """Where the tool centre point truly is now, mm."""
        return np.array(self._control.ask("true_pose"))

    def rest_since(self) -> float | None:
        """Bench time since which the arm rests; None while it moves."""
        return self._control.ask("rest_since")

    def truth(self, pose: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 3"]:
        """(lateral, range, elevation) mm of the target for true poses."""
        pose = np.asarray(pose, float)
        found = np.array(self._control.ask("truth", pose=pose.tolist()))
        return found.reshape(*pose.shape[:-2], 3)

    def elevation_mm(self) -> float:
        """The target's true elevational offset now, mm."""
        return float(self.truth(self.true_pose())[2])

    def world_truth(self) -> dict[str, np.ndarray]:
        """``image_to_probe`` (4, 4), ``point_mm`` (3,), ``sound_speed_m_s``, ``latency_s``."""
        told = self._control.ask("world")
        return {name: np.array(value) for name, value in told.items()}

    def test_set(
        self, count: int = 50, seed: int = 1
    ) -> tuple[Float[np.ndarray, "count 4 4"], Float[np.ndarray, "count 2"]]:
        """Noise-free in-plane test images: true poses and [lateral, range], mm."""
        poses, points = self._control.ask("test_set", count=count, seed=seed)
        return np.array(poses), np.array(points)

    def robot(self) -> dict[str, object]:
        """``running`` and ``reason``: the controller's program, and why it last stopped."""
        return self._control.ask("robot")

    def close(self) -> None:
        """End the bench's process; safe to repeat."""
        self._control.close()
        finish(self._process, 10.0)
        if self._process.stdout is not None:
            self._process.stdout.close()


def start_bench(**options: Any) -> Bench:
    """Start a bench in a process of its own.

    Args:
        options: fields of :class:`BenchOptions`.

    Raises:
        InputError: invalid options, or a bench that does not start; one line.
    """
    chosen = BenchOptions(**options)
    with tempfile.TemporaryFile() as complaints:
        options_text = json.dumps(asdict(chosen))
        process = spawn("hw.bench.run", options_text, stdin=True, stderr=complaints)
        line = first_line(process, _START_WALL_S)
        if not line:
            process.kill()
            process.communicate()
            complaints.seek(0)
            said = complaints.read(1 << 16).decode(errors="replace").strip().splitlines()
            raise InputError(f"the bench did not start: {said[-1] if said else 'no reason given'}")
    return Bench(process, json.loads(line))


def serve(options: BenchOptions, *, of_parent: bool = False) -> None:
    """Run a bench here: print its addresses, serve until Ctrl-C or a client asks for the end.

    Args:
        options: of the bench.
        of_parent: end with standard input, too, which ends with the parent.
    """
    assembly = Assembly(options)
    try:
        print(json.dumps(assembly.start()), flush=True)
        if of_parent:
            threading.Thread(target=_until_parent_ends, args=(assembly,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            assembly.wait()
    finally:
        assembly.stop()


def _until_parent_ends(assembly: Assembly) -> None:
    # Not by sys.stdin, whose lock a thread must not hold when Python ends.
    while os.read(0, 1024):
        pass
    assembly.end()


def main(options: str) -> int:
    """Run a bench with :class:`BenchOptions` as one JSON object, until standard input ends."""
    try:
        serve(BenchOptions(**json.loads(options)), of_parent=True)
    except (InputError, TypeError, json.JSONDecodeError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
