"""PlusServer's TRACKEDFRAME: an image, and the transforms that were tracked with it.

The body as PlusLib writes it (``igtlPlusTrackedFrameMessage``), big-endian except for the pixels
and the embedded matrix, which have the sender's byte order (PLUS itself does not change it):

    scalar type u16, components u16, image type u16 (1 B-mode, 5 colour), columns, rows, slices u16,
    size of the pixels u32, size of the XML u32, orientation u16, embedded transform 16 float32
    XML: <TrackedFrame Timestamp=...><FrameField Name="ProbeToTrackerTransform" Value="16 numbers"/>
         <FrameField Name="ProbeToTrackerTransformStatus" Value="OK"/>...</TrackedFrame>
    pixels

The embedded transform takes pixels to some frame by PLUS's present calibration. It is not used,
since the calibration is what is to be found.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

import numpy as np

from jaxcal import FormatError
from jaxcal.io.frame_names import split_name
from jaxcal.io.grey import grey_of, oriented
from jaxcal.io.message_content import ContentError, Picture, Tracked, TrackedFrame
from jaxcal.io.xml import parse_xml
from jaxcal.runtime.messages import quoted

_HEAD = struct.Struct(">HHH3HIIH64s")
_UINT8 = 3
_BRIGHTNESS, _COLOUR = 1, 5
_ORIENTATIONS = {0: "MF", 1: "UF", 2: "UF", 3: "UN", 4: "UN", 5: "MF", 6: "MF", 8: "MN", 9: "MN"}
"""PLUS's numbers for the orientations of B-mode images; 0 is unknown to PLUS, MF here."""
_MF = 5
_MOST_XML = 2**18
_MOST_TRANSFORMS = 256
_LONGEST_NAME = 100
_TRANSFORM, _STATUS = "Transform", "TransformStatus"


def decode_tracked_frame(content: memoryview) -> TrackedFrame:
    """The content of a body.

    Raises:
        ContentError: sizes that do not agree, RF data, volumes, or XML that cannot be read.
    """
    if len(content) < _HEAD.size:
        raise ContentError("a tracked frame that is cut off")
    scalar, components, kind, columns, rows, slices, size, xml_size, orientation, _ = (
        _HEAD.unpack_from(content)
    )
    if len(content) != _HEAD.size + size + xml_size or xml_size > _MOST_XML:
        raise ContentError("a tracked frame whose sizes do not agree")
    if scalar != _UINT8 or components not in (1, 3) or kind not in (0, _BRIGHTNESS, _COLOUR):
        raise ContentError(
            f"a tracked frame of {components} components of scalar type {scalar}, image type "
            f"{kind}; B-mode of uint8 is taken"
        )
    if slices > 1 or not (columns and rows) or size != columns * rows * components:
        raise ContentError(f"a tracked frame of {columns} x {rows} x {slices} voxels, {size} bytes")
    if orientation not in _ORIENTATIONS:
        raise ContentError(
            f"a tracked frame of orientation {orientation}, which no B-mode image has"
        )
    xml = bytes(content[_HEAD.size : _HEAD.size + xml_size])
    pixels = np.frombuffer(content, np.uint8, offset=_HEAD.size + xml_size)
    frame = grey_of(pixels.reshape(rows, columns, components))
    frame = np.ascontiguousarray(oriented(frame, _ORIENTATIONS[orientation]))
    frame.setflags(write=False)
    return TrackedFrame(Picture(frame, (1.0, 1.0)), _transforms(xml.rstrip(b"\0")))


def encode_tracked_frame(frame: TrackedFrame, t: float) -> bytes:
    """The content of a message, as PlusServer sends it; the pixels are written as they are."""
    rows, columns = frame.picture.array.shape
    fields = []
    for tracked in frame.transforms:
        values = " ".join(repr(float(value)) for value in tracked.matrix.ravel())
        fields += [
            (tracked.name + _STATUS, tracked.status or "OK"),
            (tracked.name + _TRANSFORM, values),
        ]
    lines = [
        f'<TrackedFrame Timestamp="{t!r}" ImageDataValid="true" NumberOfBits="8" '
        f'NumberOfScalarComponents="1" FrameSize="{columns} {rows} 1">',
        *(f"  <FrameField Name={quoteattr(n)} Value={quoteattr(v)} />" for n, v in fields),
        "</TrackedFrame>\n",
    ]
    xml = "\n".join(lines).encode()
    pixels = np.ascontiguousarray(frame.picture.array, np.uint8).tobytes()
    numbers = (_UINT8, 1, _BRIGHTNESS, columns, rows, 1, len(pixels), len(xml), _MF)
    head = _HEAD.pack(*numbers, np.eye(4, dtype="<f4").tobytes())
    return head + xml + pixels


def _transforms(xml: bytes) -> tuple[Tracked, ...]:
    try:
        root = parse_xml(xml)
    except FormatError as error:
        raise ContentError(f"a tracked frame whose XML cannot be read: {error}") from None
    fields = {
        field.attributes.get("Name", ""): field.attributes.get("Value", "")
        for field in root.all("FrameField")
    }
    found = []
    for field, text in fields.items():
        name = field.removesuffix(_TRANSFORM)
        if name == field or split_name(name) is None:
            continue
        if len(name) > _LONGEST_NAME or not name.isprintable():
            raise ContentError(f"a tracked frame with a transform named {quoted(name)}")
        found.append(Tracked(name, _matrix(text.split()), fields.get(name + _STATUS, "")))
        if len(found) > _MOST_TRANSFORMS:
            raise ContentError(f"a tracked frame with more than {_MOST_TRANSFORMS} transforms")
    return tuple(found)


def _matrix(words: Sequence[str]) -> np.ndarray:
    try:
        if len(words) != 16:
            raise ValueError
        return np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError:
        raise ContentError("a tracked frame with a transform that is not 16 numbers") from None
