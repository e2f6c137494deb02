"""PlusServer's TRACKEDFRAME, statuses of TRANSFORM, and colour, byte for byte."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pyigtl", reason="pyigtl is not installed (jaxcal[test])")

import pyigtl

from hw.ultrasound.framing import MessageDecoder
from jaxcal.io.message_content import Picture, Tracked, TrackedFrame
from jaxcal.io.openigtlink import Message, encode

RNG = np.random.default_rng(0)
IMAGE = RNG.integers(0, 256, (5, 7), np.uint8)
PIXELS = IMAGE.tobytes()
POSE = np.array([[0.0, -1, 0, 12.5], [1, 0, 0, -3], [0, 0, 1, 1e3], [0, 0, 0, 1]])
XML = (
    '<TrackedFrame Timestamp="1.5" ImageDataValid="true" NumberOfBits="8" '
    'NumberOfScalarComponents="1" FrameSize="7 5 1" >\n'
    '  <FrameField Name="FrameNumber" Value="3" />\n'
    '  <FrameField Name="ProbeToTrackerTransform" Value="0 -1 0 12.5 1 0 0 -3 0 0 1 1000 0 0 0 1 " />\n'  # noqa: E501
    '  <FrameField Name="ProbeToTrackerTransformStatus" Value="OK" />\n'
    '  <FrameField Name="StylusToTrackerTransform" Value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1" />\n'
    '  <FrameField Name="StylusToTrackerTransformStatus" Value="OUT_OF_VIEW" />\n'
    "</TrackedFrame>\n"
)


def body(xml=XML, pixels=PIXELS, **changes) -> bytes:
    """As PlusLib's igtlPlusTrackedFrameMessage packs it, field by field."""
    fields = {
        "scalar": 3, "components": 1, "kind": 1, "columns": 7, "rows": 5, "slices": 1,
        "size": len(pixels), "xml_size": len(xml), "orientation": 5,
    } | changes  # fmt: skip
    head = b"".join(
        int(value).to_bytes(4 if "size" in name else 2, "big") for name, value in fields.items()
    )
    return head + struct.pack("<16f", *np.eye(4).ravel()) + xml.encode() + pixels


def message(content: bytes) -> bytes:
    """With PLUS's header version 2 and no metadata."""
    from fastcrc import crc64

    whole = struct.pack(">HHII", 12, 0, 0, 7) + content
    head = struct.pack(
        ">H12s20sIIQQ", 2, b"TRACKEDFRAME", b"TrackedFrame", 100, 1 << 31, len(whole),
        crc64.ecma_182(whole),
    )  # fmt: skip
    return head + whole


def decoded(data: bytes) -> tuple[list[Message], MessageDecoder]:
    decoder = MessageDecoder()
    return decoder.feed(data, 0.0), decoder


def test_a_frame_as_plus_writes_it():
    (found,), _ = decoded(message(body()))
    assert isinstance(found.content, TrackedFrame)
    assert found.t_device == 100.5
    np.testing.assert_array_equal(found.content.picture.array, IMAGE)
    probe, stylus = found.content.transforms
    np.testing.assert_array_equal(probe.matrix, POSE)
    assert (probe.name, probe.status) == ("ProbeToTracker", "OK")
    assert (stylus.name, stylus.status) == ("StylusToTracker", "OUT_OF_VIEW")


def test_our_own_sender_writes_the_same():
    (found,), _ = decoded(message(body()))
    again = encode(replace(found, device="TrackedFrame"))
    (other,), _ = decoded(again)
    assert isinstance(other.content, TrackedFrame)
    np.testing.assert_array_equal(other.content.picture.array, IMAGE)
    for one, two in zip(found.content.transforms, other.content.transforms, strict=True):
        np.testing.assert_array_equal(one.matrix, two.matrix)
        assert (one.name, one.status) == (two.name, two.status)


@pytest.mark.parametrize(("code", "flip"), [
    (1, np.s_[:, ::-1]), (3, np.s_[::-1, ::-1]), (5, np.s_[:, :]), (8, np.s_[::-1]), (0, np.s_[:]),
])  # fmt: skip
def test_orientations_become_mf(code, flip):
    (found,), _ = decoded(message(body(orientation=code)))
    np.testing.assert_array_equal(found.content.picture.array, IMAGE[flip])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (body(scalar=4), "scalar type 4"),
        (body(kind=2), "image type 2"),
        (body(slices=3), "7 x 5 x 3 voxels"),
        (body(columns=65535), "65535 x 5"),
        (body(size=2**32 - 1), "sizes do not agree"),
        (body(xml_size=2**31), "sizes do not agree"),
        (body(orientation=12), "orientation 12"),
        (body(xml=XML[:-20]), "is not XML"),
        (body(xml=XML.replace("0 -1 0", "0 -1")), "not 16 numbers"),
        (body(xml=XML.replace("0 -1 0", "0 x 0")), "not 16 numbers"),
        (body(xml=XML.replace("Stylus", "Sty&#x9b;2J")), r"transform named 'Sty\x9b2JToTracker'"),
        (body(xml=XML.replace("Stylus", 100 * "S")), "transform named 'SSSS"),
        (body(xml='<!DOCTYPE a [<!ENTITY b "c">]>' + XML), "document types"),
        (b"", "cut off"),
    ],
)
def test_frames_that_are_not_taken(content, reason):
    found, decoder = decoded(message(content) + message(body()))
    assert len(found) == 1
    assert decoder.unsupported == 1
    assert reason in decoder.reason


def test_status_of_a_transform():
    """PlusServer sends it as metadata, which pyigtl knows too."""
    for status in ("", "OK", "OUT_OF_VIEW"):
        data = encode(Message("TRANSFORM", "AToB", 1.0, (Tracked("AToB", POSE, status),)))
        (found,), _ = decoded(data)
        assert found.content[0].status == status
    theirs = pyigtl.TransformMessage(POSE, device_name="AToB")
    theirs.header_version = 2
    theirs.metadata["TransformStatus"] = "MISSING"
    (found,), _ = decoded(theirs.pack())
    np.testing.assert_array_equal(found.content[0].matrix, POSE)
    assert found.content[0].status == "MISSING"


def test_metadata_that_lies():
    data = bytearray(encode(Message("TRANSFORM", "AToB", 1.0, (Tracked("AToB", POSE, "OK"),))))
    place = data.index(b"TransformStatus") - 10
    assert data[place : place + 2] == b"\0\1"
    data[place : place + 2] = b"\xff\xff"
    from fastcrc import crc64

    data[50:58] = crc64.ecma_182(bytes(data[58:])).to_bytes(8, "big")
    found, decoder = decoded(bytes(data))
    assert not found
    assert "metadata" in decoder.reason


def test_colour_becomes_grey():
    colours = RNG.integers(0, 256, (1, 4, 6, 3), np.uint8)
    (found,), _ = decoded(pyigtl.ImageMessage(colours, device_name="Image").pack())
    assert isinstance(found.content, Picture)
    expected = colours[0] @ [0.299, 0.587, 0.114]
    assert np.abs(found.content.array - expected).max() <= 0.5 + 1e-9
