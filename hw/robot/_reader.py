"""The process that reads poses for :class:`hw.robot.stream.PoseStream`, and writes them out.

Started as ``python -m hw.robot._reader HOST CLIENT FREQUENCY TIMEOUT``. It writes one record per
pose, and a last one that says why no more come. It ends when nobody reads its output.
"""

from __future__ import annotations

import math
import os
import select
import struct
import sys
import time

from hw.robot._process import RECEIVES, be_prompt
from hw.robot.rtde import Packet, PacketReader
from hw.runtime.errors import DeviceError, LostError
from hw.runtime.extras import require

RECORD = struct.Struct("<8dIiI6d5d6d")
"""Host and device time (s), pose (6), safety bits, mode, runtime state, TCP offset (6), payload and
its centre of gravity (3), speed slider, joints (6); NaN where the controller sends no value."""
POSE, ERROR, BOUND = b"P", b"E", b"B"
"""Kinds of records; ``BOUND`` comes first: :attr:`PacketReader.bound` and ``latency_s``."""
_NOT_TOLD = (math.nan,)


def _packets(output: int, host: str, frequency_hz: float | None, timeout_s: float) -> None:
    reader = PacketReader(host, frequency_hz=frequency_hz, timeout_s=timeout_s)
    if math.isfinite(reader.bound[0]):
        _write(output, BOUND + struct.pack("<3d", *reader.bound, reader.latency_s))
    while True:
        if not select.select([reader], [], [], timeout_s)[0]:
            raise LostError(f"the controller was silent for {timeout_s:g} s", device="robot")
        records = [POSE + _pack(packet) for packet in reader.read()]
        _write(output, b"".join(records))


def _pack(packet: Packet) -> bytes:
    pendant = packet.pendant
    return RECORD.pack(
        packet.monotonic_s,
        packet.timestamp_s,
        *packet.tcp_pose,
        packet.safety_bits,
        packet.robot_mode,
        packet.runtime_state,
        *(packet.tcp_offset or _NOT_TOLD * 6),
        math.nan if pendant.payload_kg is None else pendant.payload_kg,
        *(pendant.payload_cog_m or _NOT_TOLD * 3),
        pendant.speed_fraction,
        *(packet.joints or _NOT_TOLD * 6),
    )


def _ur_rtde(output: int, host: str, frequency_hz: float | None) -> None:
    """As :func:`_packets`, through ur_rtde, which keeps only the newest pose.

    Its getters may return values of two packets; such a mixture is dropped.
    """
    names = ["timestamp", "actual_TCP_pose", "safety_status_bits", "robot_mode", "runtime_state"]
    module = require("rtde_receive", extra="robot")
    robot = module.RTDEReceiveInterface(host, frequency_hz or -1.0, names)
    last = float("nan")
    while robot.isConnected():
        before = robot.getTimestamp()
        if before == last:
            time.sleep(0.0002)
            continue
        record = (
            *robot.getActualTCPPose(),
            robot.getSafetyStatusBits(),
            robot.getRobotMode(),
            robot.getRuntimeState(),
            *_NOT_TOLD * 17,
        )
        if robot.getTimestamp() != before:
            continue
        last = before
        _write(output, POSE + RECORD.pack(time.monotonic(), before, *record))
    raise LostError("ur_rtde lost the connection", device="robot")


def _write(output: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(output, view) :]


def main(arguments: list[str]) -> int:
    """Read until the connection or the reader of the records is gone."""
    host, client, frequency, timeout = arguments
    # Text that a library prints must not get between the records.
    output = os.dup(1)
    os.dup2(2, 1)
    be_prompt(RECEIVES)
    frequency_hz = float(frequency) or None
    try:
        if client == "ur_rtde":
            _ur_rtde(output, host, frequency_hz)
        else:
            _packets(output, host, frequency_hz, float(timeout))
    except BrokenPipeError:
        return 0
    except (DeviceError, RuntimeError) as error:
        text = error.args[0].encode()[:1000]
        _write(output, ERROR + struct.pack("<H", len(text)) + text)
        return 1
    return 0


if __name__ == "__main__":
    # ur_rtde's destructor takes half a second, and nothing is left to be done.
    os._exit(main(sys.argv[1:]))
