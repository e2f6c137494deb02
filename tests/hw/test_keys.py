"""Keys of the person at the terminal, on a pty."""

from __future__ import annotations

import pytest

pytest.importorskip("pty", reason="there are no pseudo-terminals here")

from terminal import Terminal

from hw.keys import names_of

PROGRAM = """
import sys, time
from types import SimpleNamespace
from hw.keys import watch_keys
state = SimpleNamespace(held=False)
pause = SimpleNamespace(held=False)
pause.hold = lambda: setattr(pause, "held", True)
pause.go_on = lambda: setattr(pause, "held", False)
say = lambda line: print(line, flush=True)
with watch_keys(pause, say, ("p",)) as keyboard:
    with keyboard.lines():
        print("question", flush=True)
        print("answer", sys.stdin.readline().strip(), flush=True)
    with keyboard.asking():
        print("asking", flush=True)
        while (key := keyboard.read(20.0)) != "enter":
            print("key", key, flush=True)
    print("not asking", flush=True)
    while not pause.held:
        time.sleep(0.01)
    print("held", flush=True)
    while pause.held:
        time.sleep(0.01)
    print("gone on", flush=True)
    time.sleep(60)
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
        before = person.modes()
        person.wait_for("p pauses, Ctrl-C stops")
        person.wait_for("question")
        person.type("a word\n")
        person.wait_for("answer a word")
        person.wait_for("asking")
        person.type("k\x1b[B")
        person.wait_for("key k\\s+key down")
        person.type("\r")
        person.wait_for("not asking")
        person.type("kp")
        # Two threads print here: either line may begin before the other's newline is written.
        person.wait_for("p goes on\\s*held|held\\s*paused after this image; p goes on")
        person.type("p")
        person.wait_for("gone on")
        person.type("\x03")
        assert person.finish() != 0
        assert "KeyboardInterrupt" in person.shown
        assert person.modes() == before


def test_without_a_terminal_nothing_is_read(tmp_path, capsys):
    """Pytest's standard input is none; a person cannot be asked there, and that is said."""
    from hw.cli.main import main

    pytest.importorskip("rtde_control", reason="without ur_rtde this is said first")
    arguments = ["acquire", str(tmp_path / "a.h5"), "--bench", "--placement", "pattern-injection"]
    assert main([*arguments, "--operator", "person"]) == 2
    assert "needs a terminal" in capsys.readouterr().err
    assert not (tmp_path / "a.h5").exists()
