"""What processes of the bench read from each other's pipes."""

from __future__ import annotations

from io import RawIOBase


def exactly(source: RawIOBase, size: int) -> bytes:
    """``size`` bytes, or fewer where the pipe ends."""
    parts, missing = [], size
    while missing:
        part = source.read(min(missing, 2**20))
        if not part:
            break
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)
