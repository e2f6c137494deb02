"""A file as HDF5 reads it, with a look at every global heap before HDF5 walks through it.

Text attributes of variable length, which h5py writes, lie in "global heap collections": a 16-byte
header (``GCOL``, version 1, size) and objects, each a 16-byte header (index, references, size) and
its bytes padded to 8; index 0 is the free rest, whose size includes its header. HDF5 walks them
without checking that it moves on, so one flipped byte makes it loop for ever, in C code that no
signal or time-out of ours can end (HDFGroup/hdf5 issue 1707, h5py issue 2088).

So HDF5 reads an untrusted file through :class:`CheckedFile`. All bytes that it asks for are
searched for the beginning of a heap, and a heap that begins there is walked in Python before HDF5
gets the bytes. Nothing else of the file is read, so that the cost does not depend on its size.

One kind of damage is not detected: a reference to a heap that states a wrong length for its text.
HDF5 then allocates that much, at most 4 GiB, before it notices and reports an error.
"""

from __future__ import annotations

import io
import os
import struct
from typing import Any

from jaxcal import FormatError
from jaxcal.io.atomic import lock

_LARGEST_HEAP = 2**26
_MOST_BYTES = 2**28
"""Most bytes of all heaps together; every heap is walked once."""

_MOST_OBJECTS = 10**6
_LOOKALIKE = 10
"""Number of objects that a place counts for if only its first bytes are those of a heap."""

_START = b"GCOL\x01"
_BEFORE = len(_START) - 1


class CheckedFile(io.RawIOBase):
    """A file to read from, whose heaps are checked as they are met.

    Args:
        source: a path or a binary file object that can seek.
        length: bytes that the file is to have, with zeros beyond its end; None: its own length.

    Attributes:
        damage: what was found. HDF5 gets zeros in place of a damaged heap, and an exception. Its
            own error hides this one, so the reader must look at this attribute.

    Raises:
        BlockingIOError: another program has the file open for writing.
    """

    def __init__(self, source: str | os.PathLike[str] | Any, length: int | None = None) -> None:
        self.damage: FormatError | None = None
        self._ours = isinstance(source, str | os.PathLike)
        self._file: Any = io.FileIO(source) if self._ours else source  # pyright: ignore
        # HDF5 takes the same lock itself when it reads a file by its path.
        wanted = os.environ.get("HDF5_USE_FILE_LOCKING", "").upper() not in ("FALSE", "0")
        if self._ours and wanted and lock(self._file.fileno(), shared=True) is False:
            self._file.close()
            raise BlockingIOError
        found = self._file.seek(0, os.SEEK_END)
        self._length = found if length is None else max(found, length)
        self._place = 0
        self._seen: set[int] = set()
        self._bytes_left, self._objects_left = _MOST_BYTES, _MOST_OBJECTS

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """As of any file."""
        origin = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._length}[whence]
        self._place = origin + offset
        return self._place

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the current place, after a look at the heaps that begin in it.

        Raises:
            FormatError: a heap that cannot be walked to its end.
        """
        view = memoryview(buffer).cast("B")
        start = self._place
        # A heap's first bytes may come in two reads.
        before = min(_BEFORE, start)
        data = self._read(start - before, before + len(view) + _BEFORE)
        try:
            self._check(start - before, data)
        except FormatError as error:
            self.damage = error
            view[:] = bytes(len(view))
            raise
        data = data[before : before + len(view)]
        view[: len(data)] = data
        view[len(data) :] = bytes(len(view) - len(data))
        count = max(0, min(len(view), self._length - start))
        self._place += count
        return count

    def close(self) -> None:
        """Close the file where it was opened here."""
        if self._ours:
            self._file.close()
        super().close()

    def _read(self, start: int, size: int) -> bytes:
        self._file.seek(start)
        parts = []
        while size > 0:
            part = self._file.read(size)
            if not part:
                break
            parts.append(part)
            size -= len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def _check(self, start: int, data: bytes) -> None:
        place = data.find(_START)
        while place >= 0:
            if start + place not in self._seen:
                self._seen.add(start + place)
                self._walk(start + place)
            place = data.find(_START, place + 1)

    def _walk(self, heap: int) -> None:
        """Walk the objects of one collection as HDF5 does, but with checks."""
        header = self._read(heap + 8, 8)
        length = int.from_bytes(header, "little")
        # The five bytes may be other data: HDF5 accepts no heap beyond the file's end.
        if len(header) < 8 or length > self._length - heap:
            self._spend(0, _LOOKALIKE)
            return
        if length > _LARGEST_HEAP:
            raise FormatError(f"is damaged: a heap of text claims {length} bytes")
        self._spend(length, 1)
        objects = self._read(heap + 16, max(0, length - 16))
        place = 0
        while place + 16 <= len(objects):
            index, _, _, size = struct.unpack_from("<HHIQ", objects, place)
            step = size if index == 0 else 16 + (size + 7) // 8 * 8
            if step == 0 or place + step > len(objects):
                raise FormatError("is damaged: a heap of text cannot be followed to its end")
            self._spend(0, 1)
            place += step

    def _spend(self, size: int, objects: int) -> None:
        self._bytes_left -= size
        self._objects_left -= objects
        if self._bytes_left < 0 or self._objects_left < 0:
            raise FormatError("is damaged: too many heaps of text")
