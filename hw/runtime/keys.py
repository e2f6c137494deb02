"""Keys of the person at the terminal, one at a time, without Enter.

Nothing is read where standard input is no terminal, or where this process is in the background.
Ctrl-C stays a signal, and the terminal is restored afterwards.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType

_PERIOD_S = 0.05
_NAMES = {
    b"\r": "enter",
    b"\n": "enter",
    b"\x1b": "escape",
    b"\x1b[A": "up",
    b"\x1b[B": "down",
    b"\x1bOA": "up",
    b"\x1bOB": "down",
    b"\x1b[5~": "pageup",
    b"\x1b[6~": "pagedown",
}
_KEY = re.compile(rb"\x1b[\[O][^A-Za-z~]*[A-Za-z~]?|.", re.DOTALL)
"""A control sequence, which ends with its first letter or tilde, or a single byte."""


def names_of(typed: bytes) -> list[str]:
    """Names of the keys in what a terminal sent at once; unknown control sequences are left out."""
    names = []
    for key in _KEY.findall(typed):
        if key in _NAMES:
            names.append(_NAMES[key])
        elif key.isascii() and key.decode().isprintable():
            names.append(key.decode())
    return names


class Pause:
    """Lets a person hold the acquisition between two images."""

    def __init__(self) -> None:
        self._free = threading.Event()
        self._free.set()

    def hold(self) -> None:
        """Stop before the next image."""
        self._free.clear()

    def go_on(self) -> None:
        """Take the next image."""
        self._free.set()

    @property
    def held(self) -> bool:
        """Whether the acquisition is, or will be, held."""
        return not self._free.is_set()

    def wait(self) -> None:
        """Return when nobody holds the acquisition."""
        # Python handles a signal that comes right before an endless wait only after it.
        while not self._free.wait(_PERIOD_S):
            pass


class Keyboard:
    """Gives every key to :meth:`read` within :meth:`asking`; otherwise the pause keys hold the run.

    Args:
        pause: held and released by ``pause_keys`` outside of :meth:`asking`.
        pause_keys: names of keys.
        say: told what the pause keys did.
    """

    def __init__(
        self, pause: Pause, pause_keys: tuple[str, ...], say: Callable[[str], None]
    ) -> None:
        self._pause, self._pause_keys, self._say = pause, pause_keys, say
        self._keys: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._asking = threading.Event()
        self._by_lines = threading.Event()
        self._terminal = _Terminal() if _in_foreground() else None
        self._ending = False
        self._thread: threading.Thread | None = None

    @property
    def there(self) -> bool:
        """Whether there is a terminal to read from."""
        return self._terminal is not None

    def __enter__(self) -> Keyboard:
        if self._terminal is not None:
            self._terminal.keys()
            self._thread = threading.Thread(target=self._listen, daemon=True, name="keys")
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending = True
        if self._thread is not None and self._terminal is not None:
            try:
                self._thread.join()
            finally:
                # Also where Ctrl-C, held down, ends the wait.
                self._terminal.lines()
        self._pause.go_on()

    @contextmanager
    def asking(self) -> Iterator[None]:
        """Within it keys go to :meth:`read`; those pressed before are forgotten."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._keys.get_nowait()
        self._asking.set()
        try:
            yield
        finally:
            self._asking.clear()

    def read(self, timeout_s: float) -> str | None:
        """The next key's name within :meth:`asking`; None if none came in time."""
        try:
            return self._keys.get(timeout=timeout_s) if timeout_s > 0 else self._keys.get_nowait()
        except queue.Empty:
            return None

    @contextmanager
    def lines(self) -> Iterator[None]:
        """Within it the terminal reads whole lines, for a question that is answered with Enter."""
        if self._terminal is None:
            yield
            return
        self._by_lines.set()
        with self._terminal.lock:
            self._terminal.lines()
            try:
                yield
            finally:
                self._terminal.keys()
                self._by_lines.clear()

    def _listen(self) -> None:
        terminal = self._terminal
        assert terminal is not None
        while not self._ending:
            if self._by_lines.is_set():
                time.sleep(_PERIOD_S)
                continue
            with terminal.lock:
                typed = terminal.typed()
            if typed is None:
                return
            for name in names_of(typed):
                if self._asking.is_set():
                    self._keys.put(name)
                elif name in self._pause_keys:
                    self._toggle(name)

    def _toggle(self, name: str) -> None:
        if self._pause.held:
            self._pause.go_on()
        else:
            self._pause.hold()
            self._say(f"paused after this image; {_spoken(name)} goes on")


class _Terminal:
    """Standard input, a POSIX terminal: read by lines as before, or key by key."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._number = sys.stdin.fileno()
        self._before = _termios().tcgetattr(self._number)

    def keys(self) -> None:
        if self._ours():
            self._read_keys(_termios().TCSAFLUSH)

    def _read_keys(self, when: int) -> None:
        import tty

        tty.setcbreak(self._number, when)

    def lines(self) -> None:
        termios = _termios()
        if self._ours():
            termios.tcsetattr(self._number, termios.TCSADRAIN, self._before)

    def typed(self) -> bytes | None:
        """What was typed within a short time; None when the terminal is gone."""
        termios = _termios()
        try:
            if not _is_foreground(self._number):
                time.sleep(_PERIOD_S)
                return b""
            if termios.tcgetattr(self._number)[3] & termios.ICANON:
                # After Ctrl-Z and fg the terminal reads by lines, as the shell left it.
                self._read_keys(termios.TCSANOW)
            if not self._waiting():
                return b""
            typed = os.read(self._number, 256)
            # The rest of an arrow key's sequence may come a little later than its first byte.
            if typed.endswith(b"\x1b") and self._waiting():
                typed += os.read(self._number, 256)
            return typed or None
        except (OSError, termios.error):
            return None

    def _ours(self) -> bool:
        """Whether the terminal's modes may be set: a process in the background is suspended."""
        try:
            return _is_foreground(self._number)
        except OSError:  # it is gone
            return False

    def _waiting(self) -> bool:
        return bool(select.select([self._number], [], [], _PERIOD_S)[0])


@contextmanager
def watch_keys(
    pause: Pause, say: Callable[[str], None], pause_keys: tuple[str, ...] = ("enter", "p")
) -> Iterator[Keyboard]:
    """Let a key hold an acquisition before its next image; without a terminal nothing listens."""
    with Keyboard(pause, pause_keys, say) as keyboard:
        if keyboard.there:
            say(f"{_spoken(pause_keys[0])} pauses, Ctrl-C stops the robot and ends")
        yield keyboard


def _spoken(name: str) -> str:
    return "Enter" if name == "enter" else name


def _termios() -> ModuleType:
    import termios

    return termios


def _in_foreground() -> bool:
    """Whether standard input is a terminal that this process may read from."""
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    try:
        _termios()
        return _is_foreground(sys.stdin.fileno())
    except (ImportError, OSError, ValueError):
        return False


def _is_foreground(terminal: int) -> bool:
    return os.tcgetpgrp(terminal) == os.getpgrp()
