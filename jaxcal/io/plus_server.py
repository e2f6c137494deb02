"""A transform set in a running PlusServer, by its command UpdateTransform over OpenIGTLink.

The command travels as a STRING message of the device ``CMD_<number>``, the reply comes as one of
``ACK_<number>`` among the images and transforms that the server streams. Nothing but the reply is
kept.

Source: PlusLib, vtkPlusOpenIGTLinkServer and vtkPlusUpdateTransformCommand.
"""

from __future__ import annotations

import secrets
import socket
import struct
import time

from fastcrc import crc64
from numpy import ndarray

from jaxcal import FormatError, InputError
from jaxcal.io.frame_names import FramePair
from jaxcal.io.given_files import one_line
from jaxcal.io.message_content import ContentError
from jaxcal.io.openigtlink import (
    HEADER_SIZE,
    PORT,
    US_ASCII,
    Message,
    content_bytes,
    encode_header,
    parse_header,
)
from jaxcal.io.plus import update_transform_command
from jaxcal.io.xml import parse_xml
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_STRING = struct.Struct(">HH")
_LONGEST_REPLY = 1 << 16
_TIMEOUT_S = 10.0
"""Within this time the server must accept the connection and reply."""


def update_transform(
    frames: FramePair,
    matrix: Float[ndarray, "4 4"],
    host: str,
    port: int = PORT,
    *,
    error_mm: float | None = None,
) -> str:
    """Set a transform in a running PlusServer.

    Args:
        frames: of the transform, from and to.
        matrix: takes the first frame to the second, mm.
        host: of the server.
        port: of the server.
        error_mm: of the calibration, which the server keeps with it.

    Returns:
        What the server says. It keeps the transform until it ends, and only the command SaveConfig
        makes it write the transform to its file.

    Raises:
        InputError: no connection, no reply in time, or the server refuses.
    """
    where = f"{host}:{port}"
    number = 1 + secrets.randbelow(2**31 - 2)
    text = update_transform_command(frames, matrix, error_mm=error_mm).encode("ascii")
    body = _STRING.pack(US_ASCII, len(text)) + text
    message = Message("STRING", f"CMD_{number}", time.time(), None)
    due = time.monotonic() + _TIMEOUT_S
    try:
        with socket.create_connection((host, port), _TIMEOUT_S) as link:
            link.sendall(encode_header(1, message, body) + body)
            return _understood(_reply(link, f"ACK_{number}", due))
    except TimeoutError:
        raise InputError(f"{where}: no reply within {_TIMEOUT_S:g} s") from None
    except (OSError, UnicodeError) as error:
        raise InputError(f"{where}: {one_line(error)}") from None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _reply(link: socket.socket, device: str, due: float) -> bytes:
    """The content of the message from a device; other messages are discarded."""
    while True:
        header = parse_header(_take(link, HEADER_SIZE, due))
        if header is None:
            raise InputError("the program there does not speak OpenIGTLink")
        wanted = header.kind == "STRING" and header.device == device
        if wanted and header.size <= _LONGEST_REPLY:
            body = _take(link, header.size, due)
            if crc64.ecma_182(body) != header.crc:
                raise InputError("the reply was damaged in transmission")
            try:
                return bytes(content_bytes(header, body)[0])
            except ContentError as error:
                raise InputError(f"the reply is {error}") from None
        left = header.size
        while left:
            left -= len(_take(link, min(left, 1 << 16), due))


def _take(link: socket.socket, count: int, due: float) -> bytes:
    parts: list[bytes] = []
    while count:
        left = due - time.monotonic()
        if left <= 0:
            raise TimeoutError
        link.settimeout(left)
        part = link.recv(count)
        if not part:
            raise ConnectionError("the connection was closed before the reply")
        parts.append(part)
        count -= len(part)
    return b"".join(parts)


def _understood(body: bytes) -> str:
    try:
        _, length = _STRING.unpack_from(body)
        root = parse_xml(body[_STRING.size : _STRING.size + length].rstrip(b"\0"))
    except (struct.error, FormatError):
        raise InputError("its reply is not understood") from None
    said = root.attributes.get("Message", "")
    if root.attributes.get("Status", "").upper() != "SUCCESS":
        raise InputError(f"refuses the transform: {quoted(said, 200)}")
    return said
