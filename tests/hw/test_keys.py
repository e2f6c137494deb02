"""Keys of the person at the terminal, on a pty."""

from __future__ import annotations

import time

import pytest

pytest.importorskip("pty", reason="there are no pseudo-terminals here")

from terminal import Terminal
from waiting import until

from hw.runtime.keys import names_of

PROGRAM = """
import sys, time
from types import SimpleNamespace
from hw.runtime.keys import watch_keys
from hw.midplane.terminal_image import Screen
state = SimpleNamespace(held=False)
pause = SimpleNamespace(held=False)
pause.hold = lambda: setattr(pause, "held", True)
pause.go_on = lambda: setattr(pause, "held", False)
# Two threads speak here, each line in one piece, as in the programs.
say = Screen(sys.stdout).say
with watch_keys(pause, say, ("p",)) as keyboard:
    with keyboard.lines():
        say("question")
        say(f"answer {sys.stdin.readline().strip()}")
    with keyboard.asking():
        say("asking")
        while (key := keyboard.read(600.0)) != "enter":
            say(f"key {key}")
    say("not asking")
    while not pause.held:
        time.sleep(0.01)
    say("held")
    while pause.held:
        time.sleep(0.01)
    # The thread that reads never ends now, and its end is waited for.
    keyboard._terminal.lock.acquire()
    say("gone on")
    time.sleep(600)
"""


def test_keys_are_names():
    assert names_of(b"k\x1b[A\x1bOB\x1b[5~\x1b[6~\r") == [
        "k", "up", "down", "pageup", "pagedown", "enter",
    ]  # fmt: skip
    assert names_of(b"\x1b") == ["escape"]
    # A function key is no escape: that would skip the pose.
    assert names_of(b"\x1b[15~\x1b[1;5Cq") == ["q"]
    assert names_of("é\x00".encode()) == []


def test_a_terminal_by_keys_and_by_lines(tmp_path):
    with Terminal(["-c", PROGRAM], tmp_path) as person:
        person.wait_for("p pauses, Ctrl-C stops")
        person.wait_for("question")
        person.type("a word\n")
        person.wait_for("answer a word")
        person.wait_for("asking")
        person.type("k\x1b[B")
        person.wait_for("key k\\s+key down")
        # As a shell leaves the terminal after Ctrl-Z and fg.
        person.set_modes(person.modes_before)
        until(lambda: person.modes() != person.modes_before)
        person.type("K")
        person.wait_for("key K")
        person.type("\r")
        person.wait_for("not asking")
        person.type("kp")
        # Two threads speak: either may be the first.
        paused = "paused after this image; p goes on"
        person.wait_for(f"{paused}\r\nheld\r\n|held\r\n{paused}\r\n")
        person.type("p")
        person.wait_for("gone on")
        person.hold_ctrl_c()
        assert person.finish() != 0
        assert "KeyboardInterrupt" in person.shown
        assert person.modes() == person.modes_before


SHELL = """
import os, signal, subprocess, sys
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
job = subprocess.Popen([sys.executable, "-c", sys.argv[1]], process_group=0,
                       stdout=subprocess.PIPE, text=True,
                       preexec_fn=lambda: signal.signal(signal.SIGTTOU, signal.SIG_DFL))
os.tcsetpgrp(0, job.pid)
print(job.stdout.readline(), end="", flush=True)
os.kill(job.pid, signal.SIGSTOP)
os.waitpid(job.pid, os.WUNTRACED)
os.tcsetpgrp(0, os.getpgrp())
os.kill(job.pid, signal.SIGCONT)
print("in the background", flush=True)
print(f"typed {sys.stdin.readline()}", end="", flush=True)
_, status = os.waitpid(job.pid, os.WUNTRACED)
print("suspended" if os.WIFSTOPPED(status) else job.stdout.read(), flush=True)
"""
"""What a shell does: a job in the foreground, Ctrl-Z, ``bg``, and the next command is typed."""

JOB = """
import time
from hw.runtime.keys import Pause, watch_keys
pause = Pause()
with watch_keys(pause, lambda line: None):
    print("ready", flush=True)
    time.sleep(1.5)
    assert not pause.held
print("ended in order", flush=True)
"""


def test_a_job_in_the_background_leaves_the_terminal_alone(tmp_path):
    """The system suspends who reads from it, or sets it: a robot would stop for no reason."""
    with Terminal(["-c", SHELL, JOB], tmp_path) as person:
        person.wait_for("ready")
        person.wait_for("in the background")
        time.sleep(0.2)
        person.type("ls\r")
        assert person.finish() == 0
        assert "ended in order" in person.shown


def test_without_a_terminal_nothing_is_read(tmp_path, capsys):
    """Pytest's standard input is none; a person cannot be asked there, and that is said."""
    from hw.cli.main import main

    pytest.importorskip("rtde_control", reason="without ur_rtde this is said first")
    arguments = ["acquire", str(tmp_path / "a.h5"), "--bench", "--placement", "pattern-injection"]
    assert main([*arguments, "--operator", "person"]) == 2
    assert "needs a terminal" in capsys.readouterr().err
    assert not (tmp_path / "a.h5").exists()
