"""Messages from one process of the bench to another: JSON, and arrays behind it.

A message is the length of a JSON header (4 bytes, big-endian), the header, and the arrays' bytes;
name, type and shape of each array stand in the header.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from io import RawIOBase
from typing import Any

import numpy as np

from jaxcal import CalibrationError

_LARGEST = 2**28
"""Bytes of an array."""


def encode(message: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> tuple[bytes, ...]:
    """A message in parts: header and arrays."""
    whole = {key: np.ascontiguousarray(values) for key, values in arrays.items()}
    described = [[key, values.dtype.str, list(values.shape)] for key, values in whole.items()]
    header = json.dumps({**message, "arrays": described}).encode()
    body = (values.tobytes() for values in whole.values())
    return (len(header).to_bytes(4, "big") + header, *body)


def read_message(source: RawIOBase) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """The next message; None at the end of the pipe, also if a message is cut off there.

    Raises:
        CalibrationError: an array is too large.
    """
    start = _exactly(source, 4)
    if len(start) < 4:
        return None
    text = _exactly(source, int.from_bytes(start, "big"))
    try:
        message = json.loads(text)
    except ValueError:
        return None
    arrays = {}
    for name, dtype, shape in message.pop("arrays"):
        kind = np.dtype(dtype)
        size = int(np.prod(shape, dtype=object)) * kind.itemsize
        if size > _LARGEST:
            raise CalibrationError(f"{name}: {size} bytes in one message")
        body = _exactly(source, size)
        if len(body) < size:
            return None
        arrays[name] = np.frombuffer(body, kind).reshape(shape)
    return message, arrays


def _exactly(source: RawIOBase, size: int) -> bytes:
    """``size`` bytes, or fewer where the pipe ends."""
    parts, missing = [], size
    while missing:
        part = source.read(min(missing, 2**20))
        if not part:
            break
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)
