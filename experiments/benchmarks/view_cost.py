"""What the live view costs: CPU time of the thread that feeds it and of the process that serves it.

The emulated bench runs in real time with its real clients (poses 125/s, echo and images 30/s), as
in an acquisition; a plan of 60 poses, and every second what an image changes. ``pages`` readers
take what the server sends, as a browser would (without drawing it: that is the browser's own cost).
CPU seconds are those of /proc, over the wall seconds of the measurement; start-up is left out.
Seed 3.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import arguments, machine, write_table

from hw.midplane.bracket import Bracket, Placement
from hw.planning.poses import plan_poses
from hw.recording.layout import RecordingHeader
from hw.recording.recorder import Recorder
from hw.recording.session import Session
from hw.robot.confirmation import confirm_unattended
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.runtime.errors import RefusedError, StaleError, StoppedError
from hw.setup.emulated import setup_of, start
from hw.view.feed import LiveView, watched

SEED = 3
SECONDS, QUICK_SECONDS = 30.0, 5.0
BAR = 0.1
HEADER = ["pages", "rate_hz", "seconds", "messages", "left_out", "feeder_cores", "server_cores",
          "both_cores"]  # fmt: skip
PLACEMENT = Placement(Bracket(0.1, -0.7, 0.9, 0.3), 0.1, 3, np.zeros((0, 3)))


def cpu_s(pid: int) -> float:
    """CPU seconds of a process so far, its threads included."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def read(url: str, done: threading.Event) -> None:
    """Take what the server sends."""
    protocol = [f"viser-v{viser.__version__}"]
    with (
        suppress(ConnectionClosed),
        connect(url.replace("http", "ws"), subprotocols=protocol, max_size=None) as socket,  # type: ignore
    ):
        while not done.is_set():
            with suppress(TimeoutError):
                socket.recv(timeout=0.5)


def measure(pages: int, seconds: float) -> list[object]:
    """One row."""
    with ExitStack() as stack:
        setup = setup_of(stack.enter_context(start(SEED, 1.0)))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        probe = {"kind": "linear", "elements": 128, "pitch_mm": 0.457, "sound_speed_m_s": 1490.0}
        recorder = Recorder(
            folder / "rec.h5", RecordingHeader("time_of_flight", probe, 128, settings="{}")
        )
        stack.enter_context(recorder)
        view = stack.enter_context(LiveView(print, port=8300))
        session = stack.enter_context(Session(setup, recorder))
        stack.enter_context(watched(view, session))
        poses = plan_poses(60, setup.scene, setup.extent, SEED).poses
        offset = (0.0, 0.0, 0.12, 0.0, 0.0, 0.0)
        serial = session.poses.identity().name
        plan = MotionPlan(poses, setup.motion_limits(), offset, serial)
        motion = stack.enter_context(
            Motion(
                setup.robot_host,
                plan,
                confirm_unattended(plan, plan.digest, clock=setup.clock),
                clock=setup.clock,
                dry_run=False,
                guard=session.trouble,
            )
        )
        view.plan(setup, plan, plan.targets, [])
        done = threading.Event()
        for _ in range(pages):
            threading.Thread(target=read, args=(view.url, done), daemon=True).start()
        time.sleep(3.0)
        began = time.monotonic()
        before = view.seconds, cpu_s(view.pid), view.sent, view.left_out
        row = 0
        while time.monotonic() - began < seconds:
            view.going(row)
            with suppress(StaleError, StoppedError, RefusedError):  # a hiccup of a busy machine
                session.wait_until_clear()
                motion.move_to(poses[row])
            view.taken(row, PLACEMENT, None)
            row = (row + 1) % len(poses)
        wall = time.monotonic() - began
        feeder, server = view.seconds - before[0], cpu_s(view.pid) - before[1]
        sent, left_out = view.sent - before[2], view.left_out - before[3]
        done.set()
        return [pages, round(sent / wall, 2), round(wall, 1), sent, left_out,
                round(feeder / wall, 4), round(server / wall, 4),
                round((feeder + server) / wall, 4)]  # fmt: skip


def main() -> None:
    quick, folder = arguments(__doc__)
    seconds = QUICK_SECONDS if quick else SECONDS
    rows = [measure(pages, seconds) for pages in (0, 1, 2)]
    write_table(folder / "view_cost.csv", HEADER, rows)
    print(machine())
    for row in rows:
        print(dict(zip(HEADER, row, strict=True)))
    worst = max(float(str(row[-1])) for row in rows[:2])
    print(f"with one page at most {worst:.3f} of a core; the bar is {BAR}")


if __name__ == "__main__":
    main()
