"""Any frame of a sequence, in whatever order it is asked for."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from jaxcal.io.png import encode_png
from jaxcal.io.sequence import TrackedSequence

_KEPT = 48


class Frames:
    """Frames as PNG. Sequences are read forwards; for an earlier frame the reading begins again.

    Args:
        sequence: with pixels.
        orientation: of the stored pixels, where the file does not say.
    """

    def __init__(self, sequence: TrackedSequence, orientation: str | None = None) -> None:
        self._sequence, self._orientation = sequence, orientation
        self._kept = lru_cache(_KEPT)(self._read)
        self._next = 0
        self._stream: Iterator[np.ndarray] | None = None
        # A page asks for the frame that it shows and for the one after it, in two threads.
        self._lock = threading.Lock()

    def png(self, number: int) -> bytes:
        """A frame in the orientation MF.

        Raises:
            FormatError: the file is damaged, or does not say how its pixels are oriented.
        """
        with self._lock:
            return self._kept(number)

    def _read(self, number: int) -> bytes:
        if self._stream is None or number < self._next:
            # Frames before this one are skipped; only a packed file must be read through them.
            self._next = number
            wanted = range(number, len(self._sequence))
            self._stream = self._sequence.images(wanted, orientation=self._orientation)
        try:
            for frame in self._stream:
                self._next += 1
                if self._next > number:
                    return encode_png(frame)
        except BaseException:
            self._stream = None
            raise
        raise IndexError(number)
