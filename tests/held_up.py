"""Whether the machine, busy with other work, held this process up for a while."""

from __future__ import annotations

import threading
import time

_TICK_S = 0.005


class HeldUp:
    """Watches from entering to leaving; a context manager.

    Attributes:
        longest_s: the longest delay of a thread that only sleeps, wall s.
    """

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._leaving = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="held up", daemon=True)

    def __enter__(self) -> HeldUp:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._leaving.is_set():
            due = time.monotonic() + _TICK_S
            self._leaving.wait(_TICK_S)
            self.longest_s = max(self.longest_s, time.monotonic() - due)
