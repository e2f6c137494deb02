"""An emulated robot in a process of its own, for tests of the real clients."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from types import TracebackType

from hw.clock import Clock

START = (0.4, -0.1, 0.3, 0.0, 3.0, 0.2)
"""Where the arm starts: m and rotation vector (rad)."""

_PROGRAM = """
import json, sys
from hw.bench.rtde import Arm, RtdeServer
from hw.clock import Clock
start = json.loads(sys.argv[1])
clock = Clock(start["speed"])
arm = Arm(start["raw"], tcp_offset=start["tcp_offset"])
robot = RtdeServer(arm, start["host"], version=tuple(start["version"]), clock=clock).start()
print(json.dumps(clock.origin_s), flush=True)
for line in sys.stdin:
    name, *values = json.loads(line)
    answer = None
    if name == "state":
        t, c = clock.now(), robot.controller
        answer = {
            "t": t, "raw": arm.raw(t), "velocity": arm.velocity(t), "rest_since": arm.rest_since(t),
            "running": c.running, "reason": c.reason, "log": c.log, "packets": robot.packets,
            "late": robot.late, "skipped": robot.skipped, "unlocks": robot.unlock_requests,
        }
    elif name == "drop control":
        robot.drop(control_only=True)
    elif name == "force":
        arm.force = tuple(values[0])
    else:
        answer = clock.now()
        getattr(robot, name)(*values)
    print(json.dumps(answer), flush=True)
robot.stop()
"""
_numbers = itertools.count(1)


def address() -> str:
    """A loopback address that no other test uses; tests run side by side."""
    number = os.getpid() * 64 + next(_numbers)
    return f"127.{1 + number // 62500 % 250}.{1 + number // 250 % 250}.{1 + number % 250}"


class EmulatedRobot:
    """``ask(name, *values)`` calls a method of the server; ``state()`` tells its truth."""

    def __init__(
        self,
        *,
        speed: float = 1.0,
        version: tuple[int, ...] = (5, 11, 0, 108249),
        raw: tuple[float, ...] = START,
        tcp_offset: tuple[float, ...] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0),
    ) -> None:
        self.host = address()
        start = {
            "host": self.host, "speed": speed, "version": version, "raw": raw,
            "tcp_offset": tcp_offset,
        }  # fmt: skip
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        self.process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, json.dumps(start)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.clock = Clock(speed, json.loads(self.process.stdout.readline()))

    def ask(self, name: str, *values: object) -> dict:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps([name, *values]) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def state(self) -> dict:
        return self.ask("state")

    def close(self) -> None:
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
