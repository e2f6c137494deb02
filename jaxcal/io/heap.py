"""A look at an HDF5 file's global heaps before HDF5 reads them.

Text attributes of variable length, which h5py writes, lie in "global heap collections": a 16-byte
header (``GCOL``, version 1, size) and objects, each a 16-byte header (index, references, size) and
its bytes padded to 8; index 0 is the free rest, whose size includes its header. HDF5 walks them
without checking that it moves on, so one flipped byte makes it loop for ever, in C code that no
signal or time-out of ours can end (HDFGroup/hdf5 issue 1707, h5py issue 2088).

What this does not see is a reference to a heap that lies about the length of its text: HDF5 then
allocates that much, at most 4 GiB, before it notices and reports an error.
"""

from __future__ import annotations

import os
import struct

from jaxcal.errors import FormatError

MAXIMUM_BYTES = 2**30
"""Files above this size (1 GiB) are not searched: they would have to be read from end to end."""

_MAXIMUM_OBJECTS = 10**6
_START = b"GCOL\x01"
_BLOCK = 2**24


def check_heaps(path: str | os.PathLike[str]) -> None:
    """Check that every global heap collection in a file can be walked to its end.

    Args:
        path: an HDF5 file with 8-byte lengths (all that current programs write).

    Raises:
        FormatError: one that cannot, or absurdly many of them.
    """
    size = os.path.getsize(path)
    if size > MAXIMUM_BYTES:
        return
    budget = _MAXIMUM_OBJECTS
    with open(path, "rb") as file:
        for block_start in range(0, size, _BLOCK):
            file.seek(block_start)
            block = file.read(_BLOCK + len(_START) - 1)
            place = block.find(_START)
            while place >= 0:
                file.seek(block_start + place + 8)
                length = int.from_bytes(file.read(8), "little")
                # These five bytes may be anything; HDF5 takes no heap beyond the file's end.
                if length <= size - block_start - place:
                    budget -= _walk(file.read(max(0, length - 16)), budget)
                place = block.find(_START, place + 1)


def _walk(objects: bytes, budget: int) -> int:
    """Walk the objects of one collection and count them, as HDF5 does but with its eyes open."""
    place, count = 0, 0
    while place + 16 <= len(objects):
        index, _, _, size = struct.unpack_from("<HHIQ", objects, place)
        step = size if index == 0 else 16 + (size + 7) // 8 * 8
        count += 1
        if step == 0 or place + step > len(objects) or count > budget:
            raise FormatError("is damaged: a heap of text cannot be followed to its end")
        place += step
    return count
