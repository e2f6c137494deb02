"""An emulated robot in a process of its own, so that nothing else delays its controller.

A controller works in real time; if it shared an interpreter with, say, the rendering of images, it
would answer only when it gets the lock. So the server runs alone, and sends each new motion of its
arm to the process that started it. There a mirror of the arm takes over the motion: the state at
any bench time follows from the last motion alone. :class:`RobotProcess` is the caller's side of an
:class:`hw.bench.rtde.RtdeServer` in such a process.

``python -m hw.bench.robot '{"host": "127.0.0.2"}'`` serves until its input ends.
"""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import sys
import threading
from dataclasses import asdict
from typing import Any

from hw.bench.arm import Arm
from hw.bench.joints import Motion
from hw.bench.rtde import E_SERIES, RtdeServer
from hw.runtime.clock import REAL, Clock
from hw.runtime.processes import ANSWERS, be_prompt, finish, spawn

START = (0.4, -0.1, 0.3, 0.0, 3.0, 0.2)
"""Where the arm starts by default: m and rotation vector (rad)."""

_PATIENCE_S = 30.0


def model_of(version: tuple[int, ...]) -> str:
    """The emulated arm that goes with a controller: the paper's UR5, or its successor."""
    return "UR5e" if version[0] >= 5 else "UR5"


class RobotProcess:
    """An arm and its controller in a child process.

    Args:
        arm: a mirror of the child's arm; it must not be commanded.
        host: loopback address.
        version: of the controller.
        clock: bench time, shared with the child.
        settings: further arguments of :class:`hw.bench.rtde.RtdeServer`.
    """

    def __init__(
        self,
        arm: Arm,
        host: str = "127.0.0.2",
        *,
        version: tuple[int, ...] = E_SERIES,
        clock: Clock = REAL,
        **settings: object,
    ) -> None:
        self.arm, self.host, self.clock = arm, host, clock
        self.serial = ""
        self.frequency_hz = 0.0
        self._setup = {
            "host": host,
            "version": version,
            "arm": arm.settings,
            "clock": [clock.speed, clock.origin_s],
            "server": settings,
        }
        self._asking = threading.Lock()
        self._answers: queue.SimpleQueue[dict] = queue.SimpleQueue()
        self.process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> RobotProcess:
        """Start the child and wait until it serves.

        Raises:
            OSError: its address is taken.
        """
        self.process = spawn("hw.bench.robot", json.dumps(self._setup), stdin=True, stderr=None)
        self._thread = threading.Thread(target=self._receive, name="robot's process", daemon=True)
        self._thread.start()
        told = self._answer()
        if "trouble" in told:
            self.stop()
            raise OSError(told["trouble"])
        self.serial, self.frequency_hz = str(told["serial"]), float(told["frequency_hz"])
        return self

    def stop(self) -> None:
        """End the child; safe to repeat."""
        if self.process is None:
            return
        self.process.kill()
        finish(self.process, _PATIENCE_S)
        if self._thread is not None:
            self._thread.join()

    def __enter__(self) -> RobotProcess:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def state(self) -> dict:
        """Where the arm is, what the program does, every command and the packets so far."""
        return self.ask("state")

    def ask(self, name: str, *values: object) -> Any:
        """``state``, or what the controller shall do (:meth:`hw.bench.rtde.RtdeServer.act`).

        Raises:
            RuntimeError: the child is gone, or does not know the request.
        """
        with self._asking:
            assert self.process is not None
            assert self.process.stdin is not None
            with contextlib.suppress(OSError, ValueError):
                self.process.stdin.write(json.dumps([name, *values]).encode() + b"\n")
                self.process.stdin.flush()
            told = self._answer()
        if "trouble" in told:
            raise RuntimeError(told["trouble"])
        return told["answer"]

    def _answer(self) -> dict:
        try:
            return self._answers.get(timeout=_PATIENCE_S)
        except queue.Empty:
            return {"trouble": "the emulated robot does not answer"}

    def _receive(self) -> None:
        assert self.process is not None
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                told = json.loads(line)
                if "motion" in told:
                    self.arm.follow(_motion(told["motion"]))
                else:
                    self._answers.put(told)
        self._answers.put({"trouble": "the emulated robot's process ended"})


class EmulatedRobot(RobotProcess):
    """A robot with a clock of its own that serves at once: for tests of the clients.

    Args:
        host: its loopback address.
        speed: of bench time.
        version: of its controller.
    """

    def __init__(
        self, host: str, *, speed: float = 1.0, version: tuple[int, ...] = E_SERIES
    ) -> None:
        tcp_offset = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
        arm = Arm(START, tcp_offset=tcp_offset, model=model_of(version))
        super().__init__(arm, host, version=version, clock=Clock(speed))
        self.start()

    def __enter__(self) -> EmulatedRobot:
        return self


def _motion(told: dict) -> Motion:
    plain = {name: tuple(v) if isinstance(v, list) else v for name, v in told.items()}
    first, last = told["error"]
    return Motion(**{**plain, "error": (tuple(first), tuple(last))})


def _state(robot: RtdeServer) -> dict:
    arm, program, t = robot.arm, robot.controller, robot.clock.now()
    return {
        "t": t,
        "raw": arm.raw(t),
        "joints": arm.joints(t),
        "velocity": arm.velocity(t),
        "rest_since": arm.rest_since(t),
        "loading": program.loading,
        "running": program.running,
        "reason": program.reason,
        "log": program.log,
        "packets": robot.packets,
        "late": robot.late,
        "skipped": robot.skipped,
        "dashboard": robot.asked,
    }


def _do(robot: RtdeServer, name: str, values: list) -> dict:
    if name == "state":
        return {"answer": _state(robot)}
    try:
        return {"answer": robot.act(name, *values)}
    except (ValueError, TypeError, TimeoutError) as error:
        return {"trouble": str(error)}


def main() -> None:
    """Serve until the input ends."""
    setup = json.loads(sys.argv[1])
    lines: queue.SimpleQueue[dict | None] = queue.SimpleQueue()
    # For every thread: a thread that holds the interpreter's lock must not wait for other programs
    # while the controller's own thread waits for that lock.
    be_prompt(ANSWERS)

    def write() -> None:
        # A parent that does not read must not delay the controller.
        with contextlib.suppress(BrokenPipeError):
            while (message := lines.get()) is not None:
                print(json.dumps(message), flush=True)

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    arm = Arm(**setup.get("arm", {"raw": START}))
    arm.watcher = lambda motion: lines.put({"motion": asdict(motion)})
    clock = Clock(*setup.get("clock", []))
    version = tuple(setup.get("version", E_SERIES))
    try:
        robot = RtdeServer(
            arm, setup["host"], version=version, clock=clock, **setup.get("server", {})
        ).start()
    except OSError as error:
        lines.put({"trouble": str(error)})
        lines.put(None)
        writer.join()
        return
    lines.put({"serial": robot.serial, "frequency_hz": robot.frequency_hz})
    for line in sys.stdin:
        name, *values = json.loads(line)
        lines.put(_do(robot, name, values))
    robot.stop()


if __name__ == "__main__":
    main()
