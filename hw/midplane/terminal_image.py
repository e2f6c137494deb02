"""A B-mode frame in a terminal, and a block of lines that is painted over itself."""

from __future__ import annotations

import os
import shutil
import textwrap
import threading
from collections.abc import Sequence
from io import TextIOBase
from typing import TextIO

import numpy as np

from jaxcal.runtime.array_types import UInt8

COLUMNS, ROWS = 64, 20
_GREYS = 24
_FIRST_GREY = 232
"""Of the 256 colours that terminals agree on, 232 to 255 go from black to white."""


def picture(
    frame: UInt8[np.ndarray, "rows columns"], columns: int = COLUMNS, rows: int = ROWS
) -> list[str]:
    """A frame as lines of half blocks in 24 greys.

    Each cell is the brightest pixel of its part of the frame, so that a thin bar is not lost.

    Args:
        frame: brightness, row 0 at the probe.
        columns: characters across.
        rows: lines; each shows two rows of cells.
    """
    cells = _brightest(frame, 2 * rows, columns).astype(int)
    greys = _FIRST_GREY + cells * _GREYS // 256
    lines = []
    for upper, lower in zip(greys[::2], greys[1::2], strict=True):
        parts = [
            f"\x1b[38;5;{above};48;5;{below}m▀" for above, below in zip(upper, lower, strict=True)
        ]
        lines.append("".join(parts) + "\x1b[0m")
    return lines


def _brightest(frame: np.ndarray, rows: int, columns: int) -> np.ndarray:
    down = np.linspace(0, frame.shape[0], rows, endpoint=False).astype(int)
    across = np.linspace(0, frame.shape[1], columns, endpoint=False).astype(int)
    return np.maximum.reduceat(np.maximum.reduceat(frame, down, axis=0), across, axis=1)


def _fitting(row: str, columns: int) -> list[str]:
    """A row in pieces that fit; one of a picture is left as it is."""
    if len(row) < columns or "\x1b" in row:
        return [row]
    return textwrap.wrap(row, max(columns - 1, 1))


class Screen:
    """Lines of text on a terminal, below which a block is painted over itself.

    Args:
        stream: where to write.
        terminal: whether it understands cursor movements; by default whether it is a terminal.
    """

    def __init__(self, stream: TextIO | TextIOBase, terminal: bool | None = None) -> None:
        self._stream = stream
        if terminal is None:
            terminal = stream.isatty() and os.environ.get("TERM", "dumb") != "dumb"
        encoding = getattr(stream, "encoding", None) or ""
        self.pictures = terminal and "utf" in encoding.lower()
        self._terminal = terminal
        self._block: list[str] = []
        self._lock = threading.Lock()

    @property
    def size(self) -> tuple[int, int]:
        """Columns and lines; 80 and 24 for a terminal that does not tell."""
        try:
            number = self._stream.fileno()
            columns, lines = os.get_terminal_size(number)
        except (AttributeError, OSError, ValueError):
            columns, lines = shutil.get_terminal_size()
        return columns or 80, lines or 24

    def picture(self, frame: np.ndarray, other_rows: int) -> list[str]:
        """A frame as large as fits beside other rows; nothing where it cannot be shown."""
        columns, lines = self.size
        height = min(ROWS, lines - other_rows)
        if not self.pictures or height <= 0:
            return []
        return picture(frame, min(COLUMNS, columns - 1), height)

    def say(self, line: str) -> None:
        """One line that stays."""
        with self._lock:
            self._erase()
            self._stream.write(line + "\n")
            self._stream.flush()

    def show(self, rows: Sequence[str]) -> None:
        """Paint the block; where there is no terminal only rows that changed are written."""
        columns, _ = self.size
        rows = [part for row in rows for part in _fitting(row, columns)]
        with self._lock:
            if self._terminal:
                up = f"\x1b[{len(self._block)}F" if self._block else ""
                text = up + "".join(f"\x1b[2K{row}\n" for row in rows) + "\x1b[J"
            else:
                text = "".join(f"{row}\n" for row in rows if row not in self._block)
            self._block = list(rows)
            self._stream.write(text)
            self._stream.flush()

    def clear(self) -> None:
        """Forget the block, and take it off a terminal."""
        with self._lock:
            self._erase()
            self._stream.flush()

    def _erase(self) -> None:
        if self._terminal and self._block:
            self._stream.write(f"\x1b[{len(self._block)}F\x1b[J")
        self._block = []
