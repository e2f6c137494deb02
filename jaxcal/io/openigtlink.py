"""OpenIGTLink messages: header, CRC-64, and the contents IMAGE, TRANSFORM, TDATA and STATUS.

PlusServer's own TRACKEDFRAME is in :mod:`jaxcal.io.tracked_frame`.

Written from the public protocol (versions 1 to 3, header versions 1 and 2): a header of 58 bytes,
big-endian ``version u16, type char[12], device char[20], time stamp u32 s + u32 of 2^-32 s, body
size u64, CRC-64 of the body u64``; in header version 2 the body begins with an extended header
that holds a message id, and ends with metadata. What is read here comes from a socket and is not
trusted: sizes are bounded, counts must agree with sizes, and nothing is allocated for what has
not arrived. The protocol's CRC covers the body only: a wrong bit in a header's name or time
stamp is not detected. The CRC-64 is ECMA-182, not reflected, zero at the start.

Units: translations are mm; an image's spacing is mm per pixel. Only plane images are accepted: with
one component, uint8 (B-mode) or int16, or in colour with three of uint8, which become grey. No wire
format for RF channel data is public. It is **an assumption** that such data come as an int16 IMAGE
of the device ``RF``, with samples down and lines across.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from fastcrc import crc64

from jaxcal.io.grey import grey_of
from jaxcal.io.message_content import (
    Content,
    ContentError,
    Picture,
    StatusMessage,
    Tracked,
    TrackedFrame,
)
from jaxcal.io.tracked_frame import decode_tracked_frame, encode_tracked_frame
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import printable

PORT = 18944
"""OpenIGTLink's registered port, and PlusServer's first."""
HEADER_SIZE = 58
RF_DEVICE = "RF"
"""Device name under which RF channel data are assumed to come."""

MAXIMUM_BODY = 32 << 20
"""Largest body accepted, bytes; a larger size means a broken header."""

_HEADER = struct.Struct(">H12s20sIIQQ")
_EXTENDED = struct.Struct(">HHII")
_IMAGE = struct.Struct(">HBBBB3H12f6H")
_TRANSFORM = struct.Struct(">12f")
_TRACKED = struct.Struct(">20sBB12f")
_STATUS = struct.Struct(">Hq20s")
_METADATA = struct.Struct(">HHI")
_MOST_METADATA = 64
US_ASCII = 3
_TRANSFORM_STATUS = "TransformStatus"
"""Name under which PlusServer sends a status with a TRANSFORM."""
_SMALL = 1 << 16
_MOST_TRACKED = 256
_LARGEST = {
    "TRANSFORM": _TRANSFORM.size + _SMALL,
    "TDATA": _MOST_TRACKED * _TRACKED.size + _SMALL,
    "STATUS": _SMALL,
}
_UINT8, _INT16 = 3, 4
_SCALARS = {_UINT8: np.dtype(np.uint8), _INT16: np.dtype(np.int16)}
_BIG_ENDIAN, _LITTLE_ENDIAN = 1, 2
_LPS = 2
_BYTES = {2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 4, 10: 4, 11: 8}
_TYPE_LETTERS = frozenset(b"ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_")


@dataclass(frozen=True)
class Header:
    """What stands in front of a message.

    Attributes:
        version: 1 or 2.
        kind: message type, e.g. ``IMAGE``.
        device: name of the sender's device.
        t_device: time stamp, s of the sender's clock; NaN where it is not set.
        size: of the body, bytes.
        crc: CRC-64 of the body.
    """

    version: int
    kind: str
    device: str
    t_device: float
    size: int
    crc: int


@dataclass(frozen=True)
class Message:
    """One message, its CRC checked.

    Attributes:
        kind: message type.
        device: name of the sender's device.
        t_device: s of the sender's clock, NaN where it is not set.
        message_id: of header version 2; 0 where there is none.
        content: None for types that are not read here.
        t_host: arrival of the message's first bytes, as stated by the receiver.
    """

    kind: str
    device: str
    t_device: float
    content: Content
    message_id: int = 0
    t_host: float = math.nan


def parse_header(data: bytes | bytearray | memoryview) -> Header | None:
    """A header, or None where these 58 bytes cannot be one."""
    version, kind, device, seconds, fraction, size, crc = _HEADER.unpack(data)
    kind = kind.rstrip(b"\0")
    device = device.partition(b"\0")[0]
    if version not in (1, 2) or not kind or not _TYPE_LETTERS.issuperset(kind):
        return None
    if not all(32 <= letter != 127 for letter in device):
        return None
    text = kind.decode("ascii")
    if size > _LARGEST.get(text, MAXIMUM_BODY):
        return None
    stamp = seconds + fraction * 2.0**-32
    return Header(version, text, _text(device), stamp or math.nan, size, crc)


BEGINNING = _EXTENDED.size + _IMAGE.size
"""Bytes at the beginning of a body that :func:`size_agrees` needs."""


def size_agrees(header: Header, beginning: bytes | bytearray | memoryview) -> bool:
    """Whether the size in a header agrees with the beginning of the body.

    With a wrong bit in the size, we would wait for megabytes; an image itself states its size. The
    beginning is the first :data:`BEGINNING` bytes, or the whole body if it is shorter.
    """
    around = 0
    if header.version == 2:
        if len(beginning) < _EXTENDED.size:
            return False
        size, names, metadata, _ = _EXTENDED.unpack_from(beginning)
        around = size + names + metadata
        if size != _EXTENDED.size:
            # Larger headers are allowed; then the content may begin after ``beginning``.
            return size > _EXTENDED.size and header.size >= around
    if header.kind == "TRANSFORM":
        return header.size == around + _TRANSFORM.size
    if header.kind != "IMAGE":
        return header.size >= around
    start = _EXTENDED.size if header.version == 2 else 0
    if len(beginning) < start + _IMAGE.size:
        return False
    _, components, scalar, _, _, *numbers = _IMAGE.unpack_from(beginning, start)
    size = numbers[:3]
    whole = around + _IMAGE.size + components * math.prod(size) * _BYTES.get(scalar, 0)
    # If only a part of an image is sent, there are fewer voxels than its size says.
    part = numbers[15:18] != [0, 0, 0] or numbers[18:21] != size
    return header.size == whole or (part and header.size < whole)


def decode_body(header: Header, body: bytes, t_host: float = math.nan) -> Message:
    """The message of a body whose CRC has been checked.

    Raises:
        ContentError: sizes that do not agree, or an image of a kind that is not accepted.
    """
    content, metadata, message_id = content_bytes(header, body)
    found: Content = None
    match header.kind:
        case "IMAGE":
            found = _image(content)
        case "TRANSFORM":
            found = _transform(content, header.device, metadata.get(_TRANSFORM_STATUS, ""))
        case "TDATA":
            found = _tdata(content)
        case "STATUS":
            found = _status(content)
        case "TRACKEDFRAME":
            found = decode_tracked_frame(content)
    return Message(header.kind, header.device, header.t_device, found, message_id, t_host)


def content_bytes(header: Header, body: bytes) -> tuple[memoryview, dict[str, str], int]:
    """Content, metadata and message id of a body.

    Raises:
        ContentError: sizes that do not agree.
    """
    view = memoryview(body)
    if header.version == 1:
        return view, {}, 0
    if len(view) < _EXTENDED.size:
        raise ContentError("an extended header that is cut off")
    size, names, metadata, message_id = _EXTENDED.unpack_from(view)
    end = len(view) - names - metadata
    if not _EXTENDED.size <= size <= end:
        raise ContentError("an extended header whose sizes do not agree")
    return view[size:end], _metadata(view[end:], names), message_id


def _metadata(view: memoryview, size: int) -> dict[str, str]:
    """Names and values: a table of their sizes, then their texts one after the other."""
    if size < 2:
        return {}
    count = int.from_bytes(view[:2], "big")
    if count > _MOST_METADATA or size != 2 + count * _METADATA.size:
        raise ContentError("metadata whose sizes do not agree")
    found, place = {}, size
    for index in range(count):
        name_size, _, value_size = _METADATA.unpack_from(view, 2 + index * _METADATA.size)
        middle, end = place + name_size, place + name_size + value_size
        if end > len(view):
            raise ContentError("metadata that is cut off")
        found[_text(bytes(view[place:middle]))] = _text(bytes(view[middle:end]))
        place = end
    return found


def _image(content: memoryview) -> Picture:
    if len(content) < _IMAGE.size:
        raise ContentError("an image that is cut off")
    version, components, scalar, endian, _axes, *numbers = _IMAGE.unpack_from(content)
    width, height, depth = numbers[:3]
    if version != 1 or endian not in (_BIG_ENDIAN, _LITTLE_ENDIAN):
        raise ContentError("an image header of unknown form")
    if (components, scalar) != (3, _UINT8) and (components != 1 or scalar not in _SCALARS):
        raise ContentError(
            f"an image of {components} components of scalar type {scalar}; one of uint8 or int16, "
            "or three of uint8, are taken"
        )
    if depth != 1 or not (width and height):
        raise ContentError(f"a volume of {width} x {height} x {depth} voxels is no plane image")
    if numbers[15:18] != [0, 0, 0] or numbers[18:21] != [width, height, depth]:
        raise ContentError("a part of an image; only whole ones are taken")
    kind = _SCALARS[scalar].newbyteorder(">" if endian == _BIG_ENDIAN else "<")
    if len(content) != _IMAGE.size + width * height * components * kind.itemsize:
        raise ContentError(f"{len(content)} bytes are not an image of {width} x {height} pixels")
    across, down = np.array(numbers[3:9], float).reshape(2, 3)
    # Numbers are sent as float32: this gives 0.1 mm, not 0.10000000149.
    spacing = (float(f"{np.linalg.norm(across):.7g}"), float(f"{np.linalg.norm(down):.7g}"))
    if not all(math.isfinite(step) and step > 0 for step in spacing):
        raise ContentError(f"an image spacing of {spacing} mm")
    pixels = np.frombuffer(content, kind, offset=_IMAGE.size).reshape(height, width, components)
    pixels = grey_of(pixels).astype(_SCALARS[scalar], copy=False)
    pixels.setflags(write=False)
    return Picture(pixels, spacing)


def _matrix(numbers: tuple[float, ...]) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3] = np.reshape(numbers, (4, 3)).T
    return matrix


def _transform(content: memoryview, device: str, status: str) -> tuple[Tracked, ...]:
    if len(content) != _TRANSFORM.size:
        raise ContentError(f"{len(content)} bytes are not a transform")
    return (Tracked(device, _matrix(_TRANSFORM.unpack(content)), status),)


def _tdata(content: memoryview) -> tuple[Tracked, ...]:
    if len(content) % _TRACKED.size or len(content) > _MOST_TRACKED * _TRACKED.size:
        raise ContentError(f"{len(content)} bytes are not tracking data")
    return tuple(
        Tracked(_text(name), _matrix(tuple(numbers)))
        for name, _type, _reserved, *numbers in _TRACKED.iter_unpack(content)
    )


def _status(content: memoryview) -> StatusMessage:
    if len(content) < _STATUS.size:
        raise ContentError("a status that is cut off")
    code, subcode, name = _STATUS.unpack_from(content)
    return StatusMessage(code, subcode, _text(name), _text(bytes(content[_STATUS.size :])))


def _text(data: bytes) -> str:
    return printable(data.partition(b"\0")[0].decode("utf-8", "replace"))


def encode(message: Message) -> bytes:
    """A whole message; of header version 2 where it has an id, of version 1 otherwise.

    Raises:
        ValueError: a content that does not go with the kind, or a name that is too long.
    """
    status = ""
    match message.content:
        case Picture() if message.kind == "IMAGE":
            content = _encode_image(message.content)
        case (Tracked(),) if message.kind == "TRANSFORM":
            content = _encode_matrix(message.content[0].matrix)
            status = message.content[0].status
        case tuple() if message.kind == "TDATA":
            content = b"".join(_encode_tracked(each) for each in message.content)
        case StatusMessage(code, subcode, name, text) if message.kind == "STATUS":
            content = _STATUS.pack(code, subcode, name.encode()) + text.encode() + b"\0"
        case None:
            content = b""
        case TrackedFrame() if message.kind == "TRACKEDFRAME":
            content = encode_tracked_frame(message.content, message.t_device)
        case _:
            raise ValueError(f"{message.kind} cannot hold {type(message.content).__name__}")
    version = 1
    if message.message_id or status:
        version = 2
        names, values = _encode_status(status)
        head = _EXTENDED.pack(_EXTENDED.size, len(names), len(values), message.message_id)
        content = head + content + names + values
    return encode_header(version, message, content) + content


def _encode_status(status: str) -> tuple[bytes, bytes]:
    """Metadata with the status of a transform: the table of sizes, and the texts."""
    if not status:
        return b"", b""
    name, value = _TRANSFORM_STATUS.encode(), status.encode()
    sizes = _METADATA.pack(len(name), US_ASCII, len(value))
    return (1).to_bytes(2, "big") + sizes, name + value


def encode_header(version: int, message: Message, body: bytes) -> bytes:
    """The header of a message with this body."""
    kind, device = message.kind.encode("ascii"), message.device.encode("utf-8")
    if len(kind) > 12 or len(device) > 20:
        raise ValueError(f"{message.kind} {message.device!r}: a type has 12 bytes, a device 20")
    stamp = 0.0 if math.isnan(message.t_device) else message.t_device
    seconds = int(stamp)
    fraction = min(int((stamp - seconds) * 2.0**32), 0xFFFFFFFF)
    return _HEADER.pack(version, kind, device, seconds, fraction, len(body), crc64.ecma_182(body))


def _encode_image(picture: Picture) -> bytes:
    height, width = picture.array.shape
    scalar = {kind: code for code, kind in _SCALARS.items()}[picture.array.dtype]
    lateral, axial = picture.spacing_mm
    # Position is that of the image's centre; the first pixel is put at the origin.
    centre = ((width - 1) / 2 * lateral, (height - 1) / 2 * axial, 0.0)
    axes = (lateral, 0.0, 0.0, 0.0, axial, 0.0, 0.0, 0.0, 1.0)
    size = (width, height, 1)
    head = _IMAGE.pack(1, 1, scalar, _LITTLE_ENDIAN, _LPS, *size, *axes, *centre, 0, 0, 0, *size)
    return head + picture.array.astype(picture.array.dtype.newbyteorder("<"), copy=False).tobytes()


def _encode_matrix(matrix: Float[np.ndarray, "4 4"]) -> bytes:
    return _TRANSFORM.pack(*np.asarray(matrix, float)[:3].T.ravel())


def _encode_tracked(tracked: Tracked) -> bytes:
    name = tracked.name.encode("utf-8")
    if len(name) > 20:
        raise ValueError(f"{tracked.name!r} is longer than 20 bytes")
    return struct.pack(">20sBB", name, 2, 0) + _encode_matrix(tracked.matrix)
