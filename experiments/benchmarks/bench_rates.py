"""All three devices at once for a minute: what arrives, what is missing, and how late it is.

One process is the bench (an RTDE controller at 125 or 500 Hz, 640 x 480 images and active-echo
frames at 30/s each), this one has the real clients and reads them every 20 ms, as a recorder
would. Missing is counted from the devices' own counters and time stamps between the first and the
last that came. Late is the time of arrival above the devices' clocks
(jaxcal.data.timing.fit_clock), so above the promptest message. Seed 20261121.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from common import arguments, machine, write_table

from hw.active_echo import ActiveEcho
from hw.robot.stream import PoseStream
from hw.runtime.clock import Clock
from hw.ultrasound import UltrasoundStream
from jaxcal.data.timing import fit_clock

SEED = 20261121
CONTROLLERS = {125: (3, 15, 8, 106339), 500: (5, 11, 0, 108249)}
HOST = "127.0.0.77"


def serve(controller: int) -> None:
    """The bench's process: says where everything is, and at the end what it could not send."""
    from hw.bench.active_echo import AuspisEmulator
    from hw.bench.arm import Arm
    from hw.bench.rtde import RtdeServer
    from hw.bench.ultrasound import ImageServer

    rng = np.random.default_rng(SEED)
    pictures = [rng.integers(0, 256, (480, 640), dtype=np.uint8) for _ in range(8)]
    tof, amplitude = rng.uniform(1e-6, 6e-5, 128), rng.uniform(0, 4000, 128)
    clock = Clock()
    arm = Arm((0.4, -0.1, 0.3, 0.0, 3.0, 0.2))
    with (
        RtdeServer(arm, HOST, version=CONTROLLERS[controller], clock=clock) as robot,
        ImageServer(lambda t: pictures[int(t * 1000) % 8], clock=clock) as images,
        AuspisEmulator(lambda t, threshold: (tof, amplitude), clock=clock) as echo,
    ):
        addresses = {"port": images.port, "path": echo.path, "origin_s": clock.origin_s}
        print(json.dumps(addresses), flush=True)
        sys.stdin.read()
        refused = {"images": images.refused, "echo": echo.refused, "robot": robot.skipped}
        print(json.dumps(refused | {"slipped": robot.late}), flush=True)


def measure(controller: int, seconds: float) -> list[list[object]]:
    """One run; a row for each stream."""
    bench = subprocess.Popen(
        [sys.executable, __file__, "--serve", str(controller)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert bench.stdin is not None
    assert bench.stdout is not None
    addresses = json.loads(bench.stdout.readline())
    clock = Clock(origin_s=addresses["origin_s"])
    seen: dict[str, list[tuple[float, float, int]]] = {"poses": [], "images": [], "echo": []}
    try:
        with (
            PoseStream(HOST, clock=clock) as poses,
            UltrasoundStream("127.0.0.1", addresses["port"], clock=clock) as stream,
            ActiveEcho(addresses["path"], clock=clock) as echo,
        ):
            echo.stream(True)
            poses.drain()
            stream.drain()
            started, used = time.monotonic(), cpu_s()
            while time.monotonic() - started < seconds:
                seen["poses"] += [(s.t_device, s.t_host, 0) for s in poses.drain()]
                seen["images"] += [(i.t_device, i.t_host, i.frame_id) for i in stream.drain()]
                seen["echo"] += [(f.ticks / 1e8, f.t_host, f.frame) for f in echo.drain()]
                time.sleep(0.02)
            used = (cpu_s() - used) / seconds
            damaged = {
                "poses": (poses.dropped, 0),
                "images": (stream.statistics().dropped, stream.statistics().crc_errors),
                "echo": (echo.statistics().dropped, echo.statistics().crc_errors),
            }
        out, _ = bench.communicate("", timeout=20)
    finally:
        bench.kill()
        bench.wait()
    refused = json.loads(out)
    print(f"{controller} Hz: the bench refused {refused}; readers used {used:.2f} of a core")
    rows = []
    for name, samples in seen.items():
        device, host, number = np.array(samples).T
        counted = np.diff(number) if name != "poses" else np.diff(device) * controller
        late = fit_clock(device, host).delay_s * 1000
        rows.append(
            [
                controller, name, seconds, len(samples), len(samples) / seconds,
                int(np.rint(counted - 1).sum()), *damaged[name],
                float(np.median(late)), float(np.percentile(late, 99.9)), float(late.max()),
            ]
        )  # fmt: skip
    return rows


def cpu_s() -> float:
    """Processor time of this process so far, s (the reader of poses has one of its own)."""
    spent = os.times()
    return spent.user + spent.system


def main() -> None:
    if sys.argv[1:2] == ["--serve"]:
        serve(int(sys.argv[2]))
        return
    quick, folder = arguments(__doc__)
    rows = []
    for controller in CONTROLLERS:
        rows += measure(controller, 5.0 if quick else 60.0)
    write_table(
        folder / "bench_rates.csv",
        (
            "controller_hz", "stream", "seconds", "received", "per_second", "missing", "dropped",
            "crc_errors", "late_median_ms", "late_999_ms", "late_max_ms",
        ),
        [*rows, [machine()]],
    )  # fmt: skip
    for row in rows:
        print(*[f"{value:.4g}" if isinstance(value, float) else value for value in row], sep="\t")


if __name__ == "__main__":
    main()
