"""The unknowns other than the offsets: their names, sizes and order. Needs no JAX.

A further unknown (latency) is one size here, and one field and one line in
:mod:`jaxcal.model.parameters`.
"""

from __future__ import annotations

Blocks = tuple[str, ...]

BLOCK_SIZE = {"translation": 3, "rotation": 3, "point": 3, "scale": 2, "sound-speed": 1, "delay": 1}

EXTRA = ("scale", "sound-speed", "delay")
"""Blocks that a caller may ask for beside X and the target."""

MEDIUM = ("sound-speed", "delay")
"""Blocks between a time of flight and a distance."""

RIGID: Blocks = ("translation", "rotation", "point")
"""The unknowns of Eq. 7: X and the target."""


def size(blocks: Blocks) -> int:
    """Number of scalar unknowns in the given blocks."""
    return sum(BLOCK_SIZE[name] for name in blocks)


def block_slice(blocks: Blocks, name: str) -> slice:
    """Where a block lies in the tangent vector of the given blocks."""
    start = 0
    for block in blocks:
        if block == name:
            return slice(start, start + BLOCK_SIZE[name])
        start += BLOCK_SIZE[block]
    raise KeyError(name)
