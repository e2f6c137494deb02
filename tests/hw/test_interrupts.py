"""A signal that asks the program to end counts, also where its exception is dropped."""

from __future__ import annotations

import gc
import os
import re
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from hw.cli.confirming import typed_code
from hw.robot.rtde import PORT
from hw.robot.stream import PoseStream
from hw.runtime import interrupts
from hw.runtime.interrupts import as_interrupts, heed_interrupt
from hw.runtime.keys import Pause
from hw.runtime.processes import first_line, spawn
from hw.ultrasound.receiver import UltrasoundStream

pytestmark = pytest.mark.skipif(
    threading.current_thread() is not threading.main_thread() or sys.platform == "win32",
    reason="signals come to the main thread; on Windows os.kill ends the process",
)


class Dying:
    """Interrupted in its finaliser."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)


def collecting(phase: str, info: dict) -> None:
    """A callback of the garbage collector that is interrupted."""
    gc.callbacks.remove(collecting)
    os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupted_start_leaves_no_process():
    """An emulated bench, or a live view, ran on until the program ended."""
    process = spawn("hw.bench.run", "{}", stdin=True)
    threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        first_line(process, 60.0)
    assert process.returncode == -signal.SIGKILL
    # The poses of a controller that answers nothing.
    with socket.create_server(("127.250.250.2", PORT)):
        poses = PoseStream("127.250.250.2")
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            poses.start()
    assert poses._process is not None
    assert poses._process.returncode == -signal.SIGKILL


@pytest.mark.parametrize("where", ["finaliser", "collector"])
def test_an_interrupt_that_python_drops_is_raised_again(monkeypatch, where):
    dropped: list[type] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda problem: dropped.append(problem.exc_type))
    before = signal.getsignal(signal.SIGTERM)
    with as_interrupts():
        heed_interrupt()
        if where == "finaliser":
            dying = Dying()
            del dying
        else:
            gc.callbacks.append(collecting)
            gc.collect()
        assert dropped == [KeyboardInterrupt]
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                heed_interrupt()
    heed_interrupt()
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("where", ["code", "pause"])
def test_an_interrupt_right_before_an_endless_wait_ends_it(monkeypatch, where):
    """As Ctrl-C in the moment in which the prompt appears: nothing interrupts the wait itself."""
    pty = pytest.importorskip("pty", reason="there are no pseudo-terminals here")
    keyboard, terminal = pty.openpty()
    pause = Pause()
    pause.hold()
    late = threading.Event()

    def give_up() -> None:
        late.set()
        pause.go_on()
        os.write(keyboard, b"code\n")

    # A signal that another thread takes does not end a read or a wait of the main thread.
    timers = [
        threading.Timer(0.2, signal.raise_signal, [signal.SIGINT]),
        threading.Timer(5.0, give_up),
    ]
    wait = {"code": typed_code, "pause": pause.wait}[where]
    with open(terminal, encoding="utf-8") as stdin, as_interrupts():
        monkeypatch.setattr(sys, "stdin", stdin)
        for timer in timers:
            timer.start()
        with pytest.raises(KeyboardInterrupt):
            wait()
        timers[1].cancel()
    os.close(keyboard)
    assert not late.is_set()


def test_an_interrupt_leaves_no_lock_taken():
    """The thread that receives then waited for ever, and the end of the program for that thread."""
    stream, over = UltrasoundStream("127.0.0.1", 1), threading.Event()
    rng = np.random.default_rng(0)

    def receive() -> None:
        while not over.is_set():
            with stream._changed:
                sum(range(2000))
            sum(range(200))

    def interrupt(after_s: float) -> None:
        time.sleep(after_s)
        os.kill(os.getpid(), signal.SIGINT)

    def take_it() -> None:
        if stream._changed.acquire(timeout=1.0):
            stream._changed.release()
            free.append(True)

    receiving = threading.Thread(target=receive, daemon=True)
    receiving.start()
    for after_s in rng.uniform(0.0005, 0.01, 50):
        interrupting = threading.Thread(target=interrupt, args=(after_s,))
        with as_interrupts():
            with suppress(KeyboardInterrupt):
                interrupting.start()
                while True:
                    stream.transforms()
                    heed_interrupt()
            interrupting.join()
        free: list[bool] = []
        taking = threading.Thread(target=take_it)
        taking.start()
        taking.join()
        assert free
    over.set()
    receiving.join()


def test_only_locks_are_entered():
    """See :func:`hw.runtime.interrupts.lock_and_condition`."""
    folder = Path(interrupts.__file__).parents[1]
    made = [path for path in folder.rglob("*.py") if "threading.Condition(" in path.read_text()]
    assert made == [Path(interrupts.__file__)]
    entered = re.compile(r"with [\w.]*(condition|changed)\b")
    assert not [path for path in folder.rglob("*.py") if entered.search(path.read_text())]
