"""Is any stop lost? Stops at random moments around a request to move, and how soon the arm rests.

Each trial is a process of its own that confirms a plan, connects by the real ur_rtde to an emulated
controller at real time, and asks for a move of 40 to 80 mm at 100 mm/s. The stop comes at a random
moment from 50 ms before to 200 ms after that request, in one of seven ways:

- ``guard``: from that moment on the guard reports danger;
- ``stop``: another thread calls ``Motion.stop``;
- ``interrupt``: the process gets SIGINT (Ctrl-C);
- ``pipe``: the pipe to the mover closes;
- ``kill``: the process gets SIGKILL, so that the operating system closes that pipe, when it gets to
  it: on a busy machine the end of a process takes long;
- ``pause``: the controller's program is paused, and resumed 0.3 s later, when it must be over;
- ``unreadable``: the controller's packets hold NaN from that moment on.

Times and places are the emulated controller's. A stop counts as lost if the arm comes to rest later
than 200 ms after it, or travels more than 15 mm after it, or if the answer was "arrived", or if the
same connection moves again afterwards. Both series of controllers: CB (3.15.8, 125 Hz) and e-Series
(5.11, 500 Hz). ``stops.csv`` has a row for each series and way, ``stops_each.csv`` every trial.

``--trials N`` for each series and way (default 60), ``--robots N`` at once (default 2: more of
them share the cores, and what is measured is then the machine), ``--ways`` for some ways only; the
others' trials are then taken from the table that is there.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import queue
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace

import numpy as np

from hw.bench.joints import Motion as ArmMotion
from hw.bench.robot import START, EmulatedRobot
from hw.bench.rtde import CB_SERIES, E_SERIES
from hw.robot.confirmation import confirm_unattended
from hw.robot.identity import read_identity
from hw.robot.limits import Limits
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.runtime.clock import Clock
from hw.runtime.errors import DeviceError
from hw.runtime.rigid import ur_to_pose
from jaxcal.runtime.isolated import import_path

SEED = 16
SERIES = {"CB": CB_SERIES, "e": E_SERIES}
WAYS = ("guard", "stop", "interrupt", "pipe", "kill", "pause", "unreadable")
_RESUMED_S = 0.3
EARLIEST_S, LATEST_S = -0.05, 0.2
"""When a stop may come, counted from the request to move."""
REST_WITHIN_S, TRAVEL_WITHIN_MM = 0.2, 15.0
_HEAD_START_S = 0.15
"""From the caller's being ready to its request: room for a stop before it."""
_PATIENCE_S = 60.0
_BEGINNINGS = 3
"""Most attempts to bring a caller to its request to move."""

HOME = ur_to_pose(np.array(START))
FAR = HOME.copy()
FAR[0, 3] += 80.0
LIMITS = Limits(
    box_min_mm=(330.0, -170.0, 180.0),
    box_max_mm=(550.0, -30.0, 320.0),
    tip_mm=(0.0, 0.0, 50.0),
    cone_axis=(float(HOME[0, 2]), float(HOME[1, 2]), float(HOME[2, 2])),
    cone_deg=20.0,
    max_step_mm=100.0,
    max_turn_deg=20.0,
    max_speed_mm_s=100.0,
    max_acceleration_mm_s2=1000.0,
)
OFFSET = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)


class NotBegunError(RuntimeError):
    """A caller ended before it asked for a motion."""


@dataclass(frozen=True)
class Trial:
    """One stop and what came of it; times in bench seconds, lengths in mm.

    Attributes:
        series: of the controller, a key of :data:`SERIES`.
        way: one of :data:`WAYS`.
        delay_s: from the request to move to the stop.
        rest_s: from the stop to the arm's rest; 0 if it did not move any more.
        travel_mm: of the tool centre point after the stop.
        speed_mm_s: of the tool centre point at the stop.
        answer: what the caller was told: "arrived", or the error and its text.
        told_s: from the stop to the answer; nan where nobody was left to be told.
        again: what came of asking the same connection to move once more.
    """

    series: str
    way: str
    delay_s: float
    rest_s: float
    travel_mm: float
    speed_mm_s: float
    answer: str
    told_s: float
    again: str

    @property
    def lost(self) -> bool:
        """Whether the stop did not do what a stop must do."""
        return (
            self.answer == "arrived"
            or not self.rest_s <= REST_WITHIN_S
            or not self.travel_mm <= TRAVEL_WITHIN_MM
            or self.again not in ("", "RefusedError")
        )


class Bench:
    """One emulated robot, and every motion of its arm since the start."""

    def __init__(self, series: str, host: str) -> None:
        self.series = series
        self.robot = EmulatedRobot(host, version=SERIES[series])
        self._motions: list[ArmMotion] = []
        self.robot.arm.watcher = self._motions.append
        self.plan = MotionPlan(np.array([HOME, FAR]), LIMITS, OFFSET, read_identity(host).name)

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.robot.stop()

    def trial(self, way: str, delay_s: float) -> Trial:
        """Ask for a move to the farther of two poses, and stop it.

        A busy machine may cost the caller its connection before it asks for anything, and then
        there was nothing to stop: it begins again.

        Raises:
            RuntimeError: the caller could not even begin.
        """
        for left in reversed(range(_BEGINNINGS)):
            try:
                return self._trial(way, delay_s)
            except NotBegunError as error:
                if not left:
                    raise
                print(f"{self.series}, {way}: begins again: {error}", flush=True)
                self._state_at_rest(self.robot.clock.now())
        raise AssertionError("no beginning is left")

    def _trial(self, way: str, delay_s: float) -> Trial:
        robot, clock = self.robot, self.robot.clock
        x_mm = robot.state()["raw"][0] * 1000.0
        target = int(np.argmax([abs(x_mm - pose[0, 3]) for pose in self.plan.targets]))
        task = {
            "host": robot.host, "origin_s": clock.origin_s, "targets": self.plan.targets.tolist(),
            "limits": asdict(LIMITS), "tcp_offset": OFFSET, "serial": self.plan.serial,
            "target": target, "way": way, "delay_s": delay_s,
        }  # fmt: skip
        caller = subprocess.Popen(
            [sys.executable, __file__, "--caller", json.dumps(task)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(import_path())},
        )  # fmt: skip
        told: queue.SimpleQueue[str] = queue.SimpleQueue()
        reader = threading.Thread(target=_lines_into, args=(told, caller.stdout), daemon=True)
        reader.start()
        try:
            first = json.loads(told.get(timeout=_PATIENCE_S) or "{}")
            if "request_s" not in first:
                assert caller.stderr is not None
                raise NotBegunError(f"the caller ended: {caller.stderr.read()[-1000:]}")
            stop_s = first["request_s"] + delay_s
            if way in ("interrupt", "kill", "pause", "unreadable"):
                time.sleep(max(0.0, clock.wall(stop_s - clock.now())))
                stop_s = clock.now()
            match way:
                case "interrupt":
                    caller.send_signal(signal.SIGINT)
                case "kill":
                    caller.send_signal(signal.SIGKILL)
                case "pause":
                    robot.ask("pause", True)
                    clock.sleep(_RESUMED_S)
                    robot.ask("pause", False)
                case "unreadable":
                    robot.ask("force", [math.nan] * 6)
            line = "" if way == "kill" else told.get(timeout=_PATIENCE_S)
            answer = json.loads(line or "{}")
        finally:
            caller.kill()
            caller.wait()
            robot.ask("force", [0.0] * 6)
            reader.join()
            for stream in (caller.stdout, caller.stderr):
                assert stream is not None
                stream.close()
        stop_s = answer.get("stop_s", stop_s)
        if not math.isfinite(stop_s):
            raise RuntimeError(f"{way}: the stop was never asked for: {answer}")
        state = self._state_at_rest(stop_s)
        there, speed = self._at(stop_s)
        rest = state["rest_since"]
        return Trial(
            series=self.series, way=way, delay_s=stop_s - first["request_s"],
            rest_s=max(0.0, rest - stop_s),
            travel_mm=1000.0 * math.dist(there[:3], state["raw"][:3]),
            speed_mm_s=1000.0 * speed,
            answer=answer.get("answer", ""),
            told_s=answer.get("told_s", math.nan) - stop_s,
            again=answer.get("again", ""),
        )  # fmt: skip

    def _state_at_rest(self, stop_s: float) -> dict:
        """The robot's state once it has rested for a while, and is not about to move."""
        give_up = time.monotonic() + _PATIENCE_S
        while time.monotonic() < give_up:
            state = self.robot.state()
            rest = state["rest_since"]
            if rest is not None and state["t"] - max(rest, stop_s) > 0.3 and not state["running"]:
                return state
            time.sleep(0.01)
        raise RuntimeError("the arm does not come to rest, or its program does not end")

    def _at(self, t: float) -> tuple[tuple[float, ...], float]:
        """Where the arm was, and its speed (m/s), by the motions that it was told."""
        told = [motion for motion in self._motions if motion.start <= t]
        if not told:
            return START, 0.0
        self.robot.arm.follow(told[-1])
        self._motions.pop()  # our own
        return self.robot.arm.raw(t), math.hypot(*self.robot.arm.velocity(t)[:3])


def _lines_into(told: queue.SimpleQueue[str], stream: Iterable[str] | None) -> None:
    assert stream is not None
    for line in stream:
        told.put(line)
    told.put("")


def caller(task: dict) -> None:
    """What one trial's process does; two lines of JSON on standard output."""
    clock = Clock(1.0, task["origin_s"])
    limits, offset = Limits.from_mapping(task["limits"]), tuple(task["tcp_offset"])
    plan = MotionPlan(np.array(task["targets"]), limits, offset, task["serial"])
    request_s, stop_s = math.inf, math.inf

    def guard() -> str | None:
        return "danger" if task["way"] == "guard" and clock.now() >= stop_s else None

    # A shell's background job ignores Ctrl-C, and hands that on.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # A process that is killed says nothing any more; whichever is noticed first counts, as it would
    # in use. The others must be stopped by what is tried, not by a busy machine's silence.
    patience = 0.15 if task["way"] == "kill" else 2.0
    given = confirm_unattended(plan, plan.digest, clock=clock)
    answer: dict[str, object] = {}
    with Motion(
        task["host"], plan, given, clock=clock, dry_run=False, guard=guard, caller_s=patience
    ) as motion:
        # ur_rtde is still busy for a moment after it has connected.
        clock.sleep(0.1)
        request_s = clock.now() + _HEAD_START_S
        print(json.dumps({"request_s": request_s}), flush=True)
        try:
            if task["way"] == "guard":
                stop_s = request_s + task["delay_s"]
            elif task["way"] in ("stop", "pipe"):

                def stop() -> None:
                    nonlocal stop_s
                    clock.sleep(request_s + task["delay_s"] - clock.now())
                    stop_s = clock.now()
                    if task["way"] == "stop":
                        motion.stop("the operator pressed stop")
                    else:
                        assert motion._process is not None
                        assert motion._process.stdin is not None
                        motion._process.stdin.close()

                threading.Thread(target=stop).start()
            clock.sleep(request_s - clock.now())
            motion.move_to(plan.targets[task["target"]])
            answer["answer"] = "arrived"
        except (DeviceError, KeyboardInterrupt) as error:
            answer["answer"] = f"{type(error).__name__}: {error}"
        answer["told_s"] = clock.now()
        if math.isfinite(stop_s):
            answer["stop_s"] = stop_s
        if task["way"] == "interrupt" and "arrived" not in answer.values():
            # Before the request nothing was asked of the motion: the interrupt ended the caller.
            answer["again"] = "" if not motion.ended else _again(motion, plan)
        else:
            answer["again"] = _again(motion, plan)
    print(json.dumps(answer), flush=True)


def _again(motion: Motion, plan: MotionPlan) -> str:
    try:
        motion.move_to(plan.targets[0])
    except DeviceError as error:
        return type(error).__name__
    return "moved"


def run(series: str, ways: list[str], count: int, robots: int, seed: int) -> list[Trial]:
    """Random stops on controllers of one series, several at once; ``count`` for each way."""
    rng = np.random.default_rng([seed, list(SERIES).index(series)])
    tasks: queue.SimpleQueue[tuple[str, float]] = queue.SimpleQueue()
    for _ in range(count):
        for way in ways:
            tasks.put((way, float(rng.uniform(EARLIEST_S, LATEST_S))))

    def work(number: int) -> list[Trial]:
        done = []
        host = f"127.0.{40 + list(SERIES).index(series)}.{1 + number}"
        with Bench(series, host) as bench:
            while True:
                try:
                    way, delay_s = tasks.get_nowait()
                except queue.Empty:
                    return done
                done.append(bench.trial(way, delay_s))
                if len(done) % 25 == 0:
                    print(f"{series}, robot {number}: {len(done)} trials", flush=True)

    with ThreadPoolExecutor(robots) as pool:
        return [trial for part in pool.map(work, range(robots)) for trial in part]


def summary(trials: list[Trial]) -> list[list[object]]:
    """A row for each series and way."""
    rows: list[list[object]] = []
    for series in SERIES:
        for way in WAYS:
            mine = [t for t in trials if (t.series, t.way) == (series, way)]
            if not mine:
                continue
            moved = [t for t in mine if t.rest_s > 0] or [replace(mine[0], rest_s=0.0)]
            told = [1000 * t.told_s for t in mine if math.isfinite(t.told_s)]
            rows.append([
                series, way, len(mine), sum(t.lost for t in mine),
                sum(t.answer == "arrived" for t in mine), len([t for t in mine if t.rest_s > 0]),
                1000 * statistics.median(t.rest_s for t in moved),
                1000 * max(t.rest_s for t in moved),
                statistics.median(t.travel_mm for t in moved), max(t.travel_mm for t in moved),
                max(told, default=math.nan),
            ])  # fmt: skip
    return rows


def figure(trials: list[Trial]):
    """Time to rest and travel after a stop, against the moment of the stop."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(10, 7), layout="constrained")
    axes = drawing.subplots(2, 2, sharex=True)
    for column, series in enumerate(SERIES):
        for way in WAYS:
            mine = [t for t in trials if (t.series, t.way) == (series, way)]
            when = [1000 * t.delay_s for t in mine]
            axes[0, column].plot(when, [1000 * t.rest_s for t in mine], ".", label=way)
            axes[1, column].plot(when, [t.travel_mm for t in mine], ".", label=way)
        axes[0, column].axhline(1000 * REST_WITHIN_S, color="k", linestyle="--")
        axes[1, column].axhline(TRAVEL_WITHIN_MM, color="k", linestyle="--", label="limit")
        hz = 500 if SERIES[series][0] >= 5 else 125
        axes[0, column].set(title=f"{series}-Series controller, {hz} Hz")
        axes[1, column].set(xlabel="stop, ms after the request to move")
    axes[0, 0].set(ylabel="time to rest (ms)")
    axes[1, 0].set(ylabel="travel after the stop (mm)")
    axes[1, 1].legend()
    return drawing


def main() -> int:
    """Make the tables and the figure; 1 if any stop was lost."""
    import csv

    from common import machine, results_folder, save_figure, show, write_table

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="5 trials for each way")
    parser.add_argument("--trials", type=int, default=60, help="for each series and way")
    parser.add_argument("--ways", default=",".join(WAYS), help="some of them, with commas between")
    parser.add_argument("--robots", type=int, default=2, help="at once")
    given = parser.parse_args()
    folder = results_folder(given.quick)
    ways = given.ways.split(",")
    each = folder / "stops_each.csv"
    print(f"{machine()}; seed {SEED}, {given.robots} robots at once; {', '.join(ways)}")
    trials = []
    if each.exists() and set(ways) != set(WAYS):
        with each.open(newline="") as file:
            trials = [
                Trial(
                    row["series"], row["way"], float(row["delay_s"]), float(row["rest_s"]),
                    float(row["travel_mm"]), float(row["speed_mm_s"]), row["answer"],
                    float(row["told_s"]), row["again"],
                )
                for row in csv.DictReader(file)
                if row["way"] not in ways
            ]  # fmt: skip
    for series in SERIES:
        trials += run(series, ways, 5 if given.quick else given.trials, given.robots, SEED)
    rows = summary(trials)
    for row in rows:
        show(row)
    write_table(
        folder / "stops.csv",
        ["series", "way", "trials", "lost", "arrived", "moving", "rest_median_ms", "rest_max_ms",
         "travel_median_mm", "travel_max_mm", "told_max_ms"],
        rows,
    )  # fmt: skip
    write_table(
        each,
        [*asdict(trials[0]), "lost"],
        [[*asdict(trial).values(), trial.lost] for trial in trials],
    )
    save_figure(figure(trials), folder / "stops.png", dpi=150)
    lost = [trial for trial in trials if trial.lost]
    for trial in lost:
        print("lost:", trial)
    return 1 if lost else 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--caller"]:
        caller(json.loads(sys.argv[2]))
        # ur_rtde is in another process; nothing here needs an orderly end.
        sys.stdout.flush()
        os._exit(0)
    sys.exit(main())
