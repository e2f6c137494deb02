"""The process that writes a recording: messages on standard input, answers on standard output.

Started by :class:`hw.recording.recorder.Recorder` only. A message is the name of a method of
:class:`hw.recording.file.RecordingWriter` (or ``open``, ``sync``, ``finish``) and its arguments.
New data are flushed to the file within about a second. When its standard input ends, the
acquisition is gone, and it closes the file in order. While it reads a large file for its
digest, it says that it is busy.
"""

from __future__ import annotations

import json
import os
import pickle
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from hw.recording.file import RecordingWriter
from hw.runtime.interrupts import ENDING
from jaxcal import CalibrationError, FormatError
from jaxcal.io.given_files import one_line

FLUSH_S = 1.0
_MOST_WAITING = 4
"""Messages that wait here, and not in the queue of the acquisition, which is bounded in bytes."""


def main(path: str) -> int:
    """Write until standard input ends; 0 if all went well."""
    # A system that is shut down sends them to all processes; the acquisition ends this one.
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    # h5py or a library may print; only answers may go to the pipe that the acquisition reads.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)

    def answer(**content: Any) -> None:
        # If nobody listens any more, the file must still be closed in order.
        with suppress(OSError):
            answers.write(json.dumps(content).encode() + b"\n")
            answers.flush()

    # Objects of a file that cannot be written would print errors on the screen when they end.
    sys.unraisablehook = sys.excepthook = lambda *_: None
    writer = None
    try:
        messages: queue.Queue[tuple[str, tuple] | None] = queue.Queue(_MOST_WAITING)
        threading.Thread(target=_receive, args=(messages,), daemon=True).start()
        first = messages.get()
        if first is None:
            return 0
        _, (header,) = first
        if header is None:
            writer = RecordingWriter.resume(path)
        else:
            writer = RecordingWriter.create(path, header)
        answer(mark="open", rows=writer.rows)
        _serve(writer, messages, answer)
        writer.close()
    except Exception as error:
        known = isinstance(error, CalibrationError)
        # A vanished disk: h5py has many exceptions for it.
        line = str(error) if known else f"{path}: cannot be written: {one_line(error)}"
        # Tell it first, so that the robot is stopped; the file is rescued after that.
        answer(error=line, format=isinstance(error, FormatError))
        if writer is not None:
            with suppress(CalibrationError, OSError):
                answer(kept=os.fspath(writer.rescue()))
        # Exit without clean-up, in which HDF5 would try to write again.
        os._exit(1)
    return 0


def _receive(messages: queue.Queue) -> None:
    """In a thread of its own: messages from standard input; None at its end, also within one."""
    # Not sys.stdin, whose lock a thread must not hold when Python ends.
    source = os.fdopen(os.dup(0), "rb")
    with suppress(EOFError, pickle.UnpicklingError):
        while True:
            messages.put(pickle.load(source))
    messages.put(None)


def _serve(writer: RecordingWriter, messages: queue.Queue, answer: Callable[..., None]) -> None:
    """Handle messages until the pipe ends or the recording is finished."""
    # Time by which the file on the disk must be flushed; None while it is up to date.
    due: float | None = None
    while True:
        left = None if due is None else max(due - time.monotonic(), 0.0)
        try:
            received = messages.get(timeout=left)
        except queue.Empty:
            received = ()
        if due is not None and time.monotonic() >= due:
            writer.flush()
            due = None
        if received is None:
            return
        if not received:
            continue
        do, arguments = received
        due = time.monotonic() + FLUSH_S if due is None else due
        if do == "sync":
            writer.flush(durable=True)
            due = None
            answer(mark=arguments[0])
        elif do == "finish":
            digest = writer.finish(lambda: answer(busy=True))
            answer(mark="finish", sha256=digest, digest_error=writer.digest_error)
            return
        else:
            getattr(writer, do)(*arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
