"""The process that reads poses for :class:`hw.robot.stream.PoseStream`, and writes them out.

Started as ``python -m hw.robot._reader HOST FREQUENCY TIMEOUT``. It writes pickled objects: first
:attr:`PacketReader.bound` and ``latency_s``, then lists of packets, and last the error that says
why no more come. It ends when nobody reads its output.
"""

from __future__ import annotations

import pickle
import select
import sys

from hw.robot.rtde import PacketReader
from hw.runtime.errors import DeviceError, LostError
from hw.runtime.processes import RECEIVES, be_prompt


def main(host: str, frequency: str, timeout: str) -> None:
    """Read until the connection or the reader of the packets is gone."""
    be_prompt(RECEIVES)
    timeout_s = float(timeout)
    try:
        reader = PacketReader(host, frequency_hz=float(frequency) or None, timeout_s=timeout_s)
        _write((reader.bound, reader.latency_s))
        while select.select([reader], [], [], timeout_s)[0]:
            _write(reader.read())
        raise LostError(f"the controller was silent for {timeout_s:g} s", device="robot")
    except BrokenPipeError:
        return
    except DeviceError as error:
        _write(error)


def _write(item: object) -> None:
    pickle.dump(item, sys.stdout.buffer)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
