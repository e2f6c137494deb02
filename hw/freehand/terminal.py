"""The person at a terminal: the newest frame in half blocks, words about it, and keys."""

from __future__ import annotations

import time

import numpy as np

from hw.midplane.terminal_image import Screen
from hw.runtime.keys import Keyboard

KEYS = "u: remove the last image, q or Enter: finish, Ctrl-C: stop (it can be resumed)"
INJECTION_KEYS = (
    "Enter: accept, s: restart the sweep, u: remove the last image, q: finish, Ctrl-C: stop"
)
_PERIOD_S = 0.15
_OTHER_ROWS = 8


class TerminalPerson:
    """See :class:`hw.freehand.request.Person`.

    Args:
        screen: where to show it.
        keyboard: what the person types; asked within its ``asking``.
        keys: what the keys do, in words.
    """

    def __init__(self, screen: Screen, keyboard: Keyboard, keys: str = KEYS) -> None:
        self._screen, self._keyboard, self._keys = screen, keyboard, keys
        self._shown = 0.0

    def show(self, frame: np.ndarray, words: str, advice: str) -> None:
        """Paint frame and words, a few times a second."""
        now = time.monotonic()
        if now - self._shown < _PERIOD_S:
            return
        self._shown = now
        rows = self._screen.picture(frame, _OTHER_ROWS) if frame.dtype == np.uint8 else []
        self._screen.show([*rows, *words.split("\n"), f"next: {advice}", self._keys])

    def say(self, line: str) -> None:
        """A line that stays."""
        self._screen.say(line)

    def key(self) -> str | None:
        """The next key; None where there was none, or no terminal."""
        return self._keyboard.read(0.0)
