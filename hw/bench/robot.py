"""An emulated robot alone, in a process of its own: for tests, and for a look at the real clients.

``python -m hw.bench.robot '{"host": "127.0.0.2"}'`` serves until its input ends. It prints one line
with the origin of its clock, then takes requests as JSON lines ``[name, values...]``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from types import TracebackType

from hw.bench.arm import Arm
from hw.bench.rtde import RtdeServer
from hw.clock import Clock
from hw.robot._process import import_path

START = (0.4, -0.1, 0.3, 0.0, 3.0, 0.2)
"""Where the arm starts by default: m and rotation vector (rad)."""

E_SERIES, CB_SERIES = (5, 11, 0, 108249), (3, 15, 8, 106339)
"""Controller versions of the two series of robots."""


class EmulatedRobot:
    """A robot in a child process; :meth:`ask` and :meth:`state` tell and change its truth.

    Args:
        host: its loopback address.
        speed: of bench time.
        version: of its controller.
        raw: where the arm starts, m and rotation vector (rad).
        tcp_offset: (6,) m and rotation vector (rad).
    """

    def __init__(
        self,
        host: str = "127.0.0.2",
        *,
        speed: float = 1.0,
        version: tuple[int, ...] = E_SERIES,
        raw: Sequence[float] = START,
        tcp_offset: Sequence[float] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0),
    ) -> None:
        self.host = host
        setup = {
            "host": host, "speed": speed, "version": version, "raw": tuple(raw),
            "tcp_offset": tuple(tcp_offset),
        }  # fmt: skip
        self.process = subprocess.Popen(
            [sys.executable, "-m", "hw.bench.robot", json.dumps(setup)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=import_path(),
        )  # fmt: skip
        assert self.process.stdout is not None
        self.clock = Clock(speed, json.loads(self.process.stdout.readline()))

    def ask(self, name: str, *values: object) -> object:
        """Call a method of the server (a fault), or set ``force``; returns its answer."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps([name, *values]) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def state(self) -> dict:
        """Where the arm is, what the program does, and every command so far."""
        state = self.ask("state")
        assert isinstance(state, dict)
        return state

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()

    def __enter__(self) -> EmulatedRobot:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _state(robot: RtdeServer) -> dict:
    arm, program, t = robot.arm, robot.controller, robot.clock.now()
    return {
        "t": t, "raw": arm.raw(t), "velocity": arm.velocity(t), "rest_since": arm.rest_since(t),
        "running": program.running, "reason": program.reason, "log": program.log,
        "packets": robot.packets, "late": robot.late, "skipped": robot.skipped,
        "unlocks": robot.unlock_requests,
    }  # fmt: skip


def main() -> None:
    """Serve until the input ends."""
    setup = json.loads(sys.argv[1])
    arm = Arm(setup.get("raw", START), tcp_offset=setup.get("tcp_offset", (0.0,) * 6))
    version, clock = tuple(setup.get("version", E_SERIES)), Clock(setup.get("speed", 1.0))
    with RtdeServer(arm, setup["host"], version=version, clock=clock) as robot:
        print(json.dumps(clock.origin_s), flush=True)
        for line in sys.stdin:
            name, *values = json.loads(line)
            answer: object = None
            match name:
                case "state":
                    answer = _state(robot)
                case "force":
                    arm.force = tuple(values[0])
                case "drop control":
                    robot.drop(control_only=True)
                case "mute" | "drop" | "protective_stop" | "unlock" | "set_tcp_offset":
                    getattr(robot, name)(*values)
                case _:
                    answer = f"unknown request {name}"
            print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
