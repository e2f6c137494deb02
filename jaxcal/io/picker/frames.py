"""Any frame of a sequence, in whatever order it is asked for."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator

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
        self._kept: OrderedDict[int, bytes] = OrderedDict()
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
            if number in self._kept:
                self._kept.move_to_end(number)
                return self._kept[number]
            if self._stream is None or number < self._next:
                self._begin(number)
            assert self._stream is not None
            try:
                for frame in self._stream:
                    self._next += 1
                    if self._next > number:
                        return self._keep(number, encode_png(frame))
            except BaseException:
                self._stream = None
                raise
            raise IndexError(number)

    def _begin(self, number: int) -> None:
        # Frames before this one are skipped; only a packed file must be read through them.
        self._next = number
        wanted = range(number, len(self._sequence))
        self._stream = self._sequence.images(wanted, orientation=self._orientation)

    def _keep(self, number: int, content: bytes) -> bytes:
        self._kept[number] = content
        if len(self._kept) > _KEPT:
            self._kept.popitem(last=False)
        return content
