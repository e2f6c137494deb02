"""Pixels of a file in order, without those not asked for; the file's sizes are not trusted."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Literal

from jaxcal import FormatError
from jaxcal.io.given_files import one_line

Packing = Literal["raw", "zlib", "gzip"]

_PORTION = 2**18
_MOST_INFLATION = 1032
"""Deflate cannot pack more than this many bytes into one."""


class PixelStream:
    """Read forwards from a place in a file, unpacking on the way; a context manager.

    Memory is needed for one request at a time, whatever the file claims.

    Args:
        path: the file.
        start: byte where the pixels begin.
        packing: ``raw``, ``zlib`` or ``gzip``.
        size: bytes of the unpacked pixels according to the file's header.

    Raises:
        FormatError: not as many bytes as the header says, or packed bytes that cannot hold as many.
    """

    def __init__(self, path: Path, start: int, packing: Packing, size: int) -> None:
        self._size = size
        try:
            self._file = path.open("rb")
            self._file.seek(0, 2)
            stored = self._file.tell() - start
            self._file.seek(start)
        except OSError as error:
            raise FormatError(f"the pixels cannot be read: {one_line(error)}") from None
        self._inflate, most, how = None, stored, ""
        if packing != "raw":
            self._inflate = zlib.decompressobj(zlib.MAX_WBITS + (16 if packing == "gzip" else 0))
            most, how = stored * _MOST_INFLATION, f", compressed ({packing})"
        elif size < stored:
            how = ": correct the header's size or type, or say there where the pixels begin"
        if size > most or (packing == "raw" and size < stored):
            self._file.close()
            raise FormatError(
                f"claims {size} bytes of pixels, the file holds {max(stored, 0)}{how}"
            )
        self._position = 0

    def __enter__(self) -> PixelStream:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read_at(self, offset: int, count: int) -> bytes:
        """``count`` bytes from ``offset`` on, which must not lie before what was read last.

        Raises:
            FormatError: damaged, or the file ends before.
        """
        self._skip(offset - self._position)
        content = self._next(count)
        if len(content) != count:
            raise FormatError(f"the pixels end at byte {offset + len(content)} of {self._size}")
        self._position = offset + count
        return content

    def check_end(self) -> None:
        """See that nothing follows the claimed size in a packed stream.

        Raises:
            FormatError: the stream inflates beyond its size.
        """
        if self._inflate is None or self._position != self._size:
            return
        if self._next(1):
            raise FormatError(f"the pixels inflate beyond their size, {self._size} bytes")
        if not self._inflate.eof:
            raise FormatError("the pixels are damaged: the end of the compressed data is missing")

    def _skip(self, count: int) -> None:
        if self._inflate is None:
            self._file.seek(count, 1)
            return
        while count > 0 and (skipped := len(self._next(min(count, _PORTION)))):
            count -= skipped

    def _next(self, count: int) -> bytes:
        """The next bytes, unpacked; fewer where the pixels end."""
        parts: list[bytes] = []
        try:
            if self._inflate is None:
                return self._file.read(count)
            while count > 0 and not self._inflate.eof:
                packed = self._inflate.unconsumed_tail or self._file.read(_PORTION)
                part = self._inflate.decompress(packed, count)
                if not packed and not part:
                    break
                parts.append(part)
                count -= len(part)
        except (OSError, zlib.error) as error:
            raise FormatError(f"the pixels are damaged: {one_line(error)}") from None
        return b"".join(parts)
