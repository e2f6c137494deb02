"""The robot of the bench: how soon it rests after a fault, what is lost, how fast it may run.

Everything goes through real sockets to an emulated controller in a process of its own; motions go
through ur_rtde. Three tables:

- ``robot_faults.csv``: for every fault during a motion at 50 mm/s, how long (ms) until the arm
  rests and until the caller knows, by the emulator's own clock. The limit is 200 ms; for answers of
  the controller that are lost it is 500 ms more, since a lost packet is sent again. A stop that the
  controller takes but does not heed is waited for as long, and then the watchdog (100 ms) acts.
- ``robot_rates.csv``: poses lost at 125 and 500 Hz, both robots at once.
- ``robot_speeds.csv``: how much faster than real time the bench may run before the freshness limit
  (100 ms of bench time), the controller's watchdog (100 ms) or the caller's limit stop motions.

Run alone on the machine; ``setpriv --bounding-set=-sys_nice`` in front shows the figures of a user
without real-time scheduling (they go to ``robot_*_unprivileged.csv``).
"""

from __future__ import annotations

import math
import os
import signal
import statistics
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from common import arguments, machine, save_figure, write_table
from matplotlib.figure import Figure

from hw.bench.robot import START, EmulatedRobot
from hw.bench.rtde import CB_SERIES, E_SERIES
from hw.robot.confirmation import confirm_unattended
from hw.robot.identity import read_identity
from hw.robot.limits import Limits
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.robot.stream import PoseStream
from hw.runtime.errors import DeviceError
from hw.runtime.rigid import ur_to_pose

SEED = 7
HOME = ur_to_pose(np.array(START))
SERIAL, OFFSET = "of each robot", (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
LIMITS = Limits(
    box_min_mm=(330.0, -170.0, 180.0),
    box_max_mm=(470.0, -30.0, 320.0),
    tip_mm=(0.0, 0.0, 50.0),
    cone_axis=(float(HOME[0, 2]), float(HOME[1, 2]), float(HOME[2, 2])),
    cone_deg=20.0,
    max_step_mm=60.0,
    max_turn_deg=20.0,
    max_speed_mm_s=50.0,
    max_acceleration_mm_s2=500.0,
    search_mm=3.0,
    search_deg=0.5,
)
FAULTS = (
    "mute", "lost answers", "drop", "drop control", "protective_stop", "force", "tcp_offset",
    "guard", "stop", "end the mover", "kill the mover", "silent caller",
    "unheeded stop",
)  # fmt: skip
LIMIT_MS = dict.fromkeys(FAULTS, 200.0) | {"lost answers": 700.0, "unheeded stop": 800.0}


def beside(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """A pose beside the first one (mm)."""
    pose = HOME.copy()
    pose[:3, 3] += (x, y, z)
    return pose


PLAN = MotionPlan(np.array([HOME, beside(50.0)]), LIMITS, OFFSET, SERIAL)


def real_time() -> bool:
    """Whether this user gets real-time scheduling."""
    policy = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        return False
    os.sched_setscheduler(0, policy, os.sched_param(0))
    return True


def started(robot: EmulatedRobot, plan: MotionPlan, **named) -> Motion:
    """A confirmed motion, connected."""
    plan = replace(plan, serial=read_identity(robot.host).name)
    given = confirm_unattended(plan, plan.digest, clock=robot.clock)
    return Motion(
        robot.host, plan, given, clock=robot.clock, dry_run=False, **named
    ).start()  # fmt: skip


def fault(name: str) -> tuple[float, float, str]:
    """One fault in mid-motion: ms until rest, ms until the caller knows, and its line."""
    reasons: list[str | None] = [None]

    def guard() -> str | None:
        if reasons[0] == "silent":
            reasons[0] = None
            time.sleep(0.6)
        return reasons[0]

    with EmulatedRobot("127.0.9.1") as robot:
        motion = started(robot, PLAN, guard=guard)
        assert motion._process is not None
        mover = motion._process.pid
        acts: dict[str, Callable[[], object]] = {
            "guard": lambda: reasons.__setitem__(0, "the echo was lost"),
            "silent caller": lambda: reasons.__setitem__(0, "silent"),
            "stop": lambda: motion.stop("the operator pressed stop"),
            "unheeded stop": lambda: (robot.ask("heed stops", False), motion.stop("danger")),
            "lost answers": lambda: robot.ask("mute control", True),
            "end the mover": lambda: os.kill(mover, signal.SIGTERM),
            "kill the mover": lambda: os.kill(mover, signal.SIGKILL),
            "force": lambda: robot.ask("force", [0.0, 0.0, -40.0, 0.0, 0.0, 0.0]),
            "tcp_offset": lambda: robot.ask(name, [0.0, 0.0, 0.2, 0.0, 0.0, 0.0]),
        }
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(motion.move_to, PLAN.targets[1])
            while math.hypot(*robot.state()["velocity"]) < 0.04:
                time.sleep(0.002)
            before = robot.state()["t"]
            acts.get(name, lambda: robot.ask(name))()
            error = future.exception(timeout=20.0)
            told = robot.clock.now() - before
        while (rest := robot.state()["rest_since"]) is None:
            time.sleep(0.01)
        motion.close()
    if not isinstance(error, DeviceError):
        raise RuntimeError(f"{name}: the motion was not stopped ({error})")
    return 1000 * (rest - before), 1000 * told, str(error)


def faults(repeats: int) -> list[list[object]]:
    """A row for each fault."""
    rows: list[list[object]] = []
    for name in FAULTS:
        results = [fault(name) for _ in range(repeats)]
        rest, told, lines = zip(*results, strict=True)
        rows.append(
            [name, repeats, statistics.median(rest), max(rest), statistics.median(told), max(told),
             LIMIT_MS[name], max(rest) <= LIMIT_MS[name], lines[0]]
        )  # fmt: skip
        print(f"{name}: at rest after at most {max(rest):.0f} ms; {lines[0]}", flush=True)
    return rows


def rates(seconds: float) -> list[list[object]]:
    """A row for each robot, both at once."""
    with (
        EmulatedRobot("127.0.9.2", version=E_SERIES) as fast,
        EmulatedRobot("127.0.9.3", version=CB_SERIES) as slow,
    ):
        streams = [
            (robot, PoseStream(robot.host, clock=robot.clock).start(), hz)
            for robot, hz in ((fast, 500.0), (slow, 125.0))
        ]
        time.sleep(seconds)
        rows: list[list[object]] = []
        for robot, stream, hz in streams:
            samples = stream.drain()
            stream.close()
            span = samples[-1].t_device - samples[0].t_device
            expected = round(span * hz) + 1
            lag = max(sample.lag_s for sample in samples)
            unsent = robot.state()["late"] + robot.state()["skipped"]
            rows.append([hz, span, expected, len(samples), expected - len(samples),
                         stream.dropped, unsent, 1000 * lag])  # fmt: skip
            print(f"{hz:g} Hz: {expected - len(samples)} of {expected} lost", flush=True)
    return rows


def speeds(moves: int) -> list[list[object]]:
    """A row for each speed of the bench: fine steps and longer moves, what stopped them."""
    rows: list[list[object]] = []
    rng = np.random.default_rng(SEED)
    targets = [beside(*rng.uniform(-15.0, 15.0, 3)) for _ in range(moves // 4)]
    plan = MotionPlan(np.array(targets), LIMITS, OFFSET, SERIAL)
    for speed in (1.0, 2.0, 5.0, 10.0, 20.0, 40.0):
        stopped: Counter[str] = Counter()
        restarts = done = 0
        with EmulatedRobot("127.0.9.4", speed=speed) as robot:
            motion = started(robot, plan, caller_s=0.15)
            wall, bench = time.monotonic(), robot.clock.now()
            for k in range(moves):
                target = targets[k // 4].copy()
                target[1, 3] += 0.2 * (k % 4)
                try:
                    motion.move_to(target, None if k % 4 == 0 else 10.0)
                    done += 1
                except DeviceError as error:
                    stopped[type(error).__name__] += 1
                    if motion.ended:
                        restarts += 1
                        motion.close()
                        motion = started(robot, plan, caller_s=0.15)
            wall, bench = time.monotonic() - wall, robot.clock.now() - bench
            motion.close()
        rows.append([speed, moves, done, stopped["StaleError"], stopped["StoppedError"],
                     stopped["LostError"] + stopped["RefusedError"], restarts, wall, bench,
                     bench / wall])  # fmt: skip
        print(f"speed {speed:g}: {done} of {moves} moves, {dict(stopped)}, {wall:.1f} s",
              flush=True)  # fmt: skip
    return rows


def main() -> None:
    """Make the tables and the figure."""
    quick, folder = arguments(__doc__)
    privileged = real_time()
    end = "" if privileged else "_unprivileged"
    print(f"{machine()}; real-time scheduling: {privileged}; seed {SEED}; load {os.getloadavg()}")
    fault_rows = faults(2 if quick else 8)
    write_table(
        folder / f"robot_faults{end}.csv",
        ["fault", "repeats", "rest_median_ms", "rest_max_ms", "told_median_ms", "told_max_ms",
         "limit_ms", "within_limit", "line"],
        fault_rows,
    )  # fmt: skip
    write_table(
        folder / f"robot_rates{end}.csv",
        ["rate_hz", "seconds", "sent", "received", "lost", "dropped", "not_sent", "largest_lag_ms"],
        rates(3.0 if quick else 60.0),
    )  # fmt: skip
    speed_rows = speeds(12 if quick else 60)
    write_table(
        folder / f"robot_speeds{end}.csv",
        ["speed", "moves", "done", "stale", "stopped", "lost", "restarts", "wall_s", "bench_s",
         "bench_s_per_wall_s"],
        speed_rows,
    )  # fmt: skip
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    names = [str(row[0]) for row in fault_rows]
    left.barh(names, [float(str(row[3])) for row in fault_rows])
    limits = [float(str(row[6])) for row in fault_rows]
    left.plot(limits, names, "k|", markersize=14, label="limit")
    left.set(xlabel="longest time until the arm rests (ms)", title="faults in mid-motion")
    left.invert_yaxis()
    left.legend()
    right.semilogx(
        [row[0] for row in speed_rows],
        [100.0 * float(str(row[2])) / float(str(row[1])) for row in speed_rows], "o-",
    )  # fmt: skip
    right.set(xlabel="bench seconds per wall second", ylabel="motions that arrived (%)",
              title="speed of the bench", ylim=(0, 105))  # fmt: skip
    save_figure(figure, folder / f"robot_bench{end}.png", dpi=150)


if __name__ == "__main__":
    main()
