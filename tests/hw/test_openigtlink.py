"""OpenIGTLink messages: against pyigtl's, and a fuzz that nothing wrong may pass or stop."""

from __future__ import annotations

import math
import struct
import time

import numpy as np
import pytest
from fastcrc.crc64 import ecma_182 as crc64
from hypothesis import given, settings
from hypothesis import strategies as st

from hw.ultrasound.framing import MessageDecoder
from jaxcal.io.message_content import Picture, StatusMessage, Tracked
from jaxcal.io.openigtlink import HEADER_SIZE, MAXIMUM_BODY, Message, encode, parse_header

pyigtl = pytest.importorskip("pyigtl", reason="pyigtl, the independent implementation")


def image(number: int, rng: np.random.Generator, version: int = 2) -> Message:
    kind = np.uint8 if number % 2 else np.int16
    shape = (int(rng.integers(1, 40)), int(rng.integers(1, 40)))
    pixels = rng.integers(0, 250, shape).astype(kind)
    identity = number if version == 2 else 0
    return Message("IMAGE", "Image", 1000.5 + number, Picture(pixels, (0.25, 0.125)), identity)


def matrix(rng: np.random.Generator) -> np.ndarray:
    found = np.eye(4)
    found[:3] = rng.normal(size=(3, 4)).astype(np.float32)
    return found


def decode(data: bytes) -> list[Message]:
    return MessageDecoder().feed(data, 0.0)


@settings(max_examples=60)
@given(st.binary(max_size=3000))
def test_crc(data: bytes) -> None:
    """The library's, bit by bit as the protocol's polynomial says."""
    expected = 0
    for byte in data:
        expected ^= byte << 56
        for _ in range(8):
            expected = (expected << 1) ^ (0x142F0E1EBA9EA3693 if expected >> 63 else 0)
    assert crc64(data) == expected


def test_crc_of_the_catalogue() -> None:
    """CRC-64/ECMA-182; pyigtl's own for an image's size."""
    assert crc64(b"123456789") == 0x6C40DF5F0B497347
    assert crc64(b"") == 0
    data = np.random.default_rng(0).bytes(640 * 480 + 72)
    assert crc64(data) == pyigtl.messages.CRC64(data)


def test_images_that_pyigtl_sends() -> None:
    rng = np.random.default_rng(1)
    for kind in (np.uint8, np.int16):
        pixels = rng.integers(0, 200, (1, 24, 32)).astype(kind)
        sent = pyigtl.ImageMessage(
            pixels, ijk_to_world_matrix=np.diag([0.1, 0.2, 1, 1]), timestamp=12.25,
            device_name="Image",
        )  # fmt: skip
        (message,) = decode(sent.pack())
        assert (message.kind, message.device, message.t_device) == ("IMAGE", "Image", 12.25)
        assert isinstance(message.content, Picture)
        np.testing.assert_array_equal(message.content.array, pixels[0])
        assert message.content.array.dtype.isnative
        assert message.content.spacing_mm == (0.1, 0.2)


def test_pixels_of_either_byte_order() -> None:
    """pyigtl sends little-endian ones only."""
    pixels = np.arange(-3, 17, dtype=np.int16).reshape(4, 5)
    data = encode(Message("IMAGE", "RF", 1.0, Picture(pixels, (1.0, 1.0))))
    content = bytearray(data[HEADER_SIZE:])
    content[4] = 1
    content[72:] = pixels.astype(">i2").tobytes()
    header = data[: HEADER_SIZE - 8] + crc64(content).to_bytes(8, "big")
    (message,) = decode(header + bytes(content))
    assert isinstance(message.content, Picture)
    np.testing.assert_array_equal(message.content.array, pixels)
    assert message.content.array.dtype == np.dtype(np.int16)


def test_transforms_that_pyigtl_sends() -> None:
    pose = matrix(np.random.default_rng(2))
    sent = pyigtl.TransformMessage(pose, timestamp=3.5, device_name="ProbeToTracker")
    (message,) = decode(sent.pack())
    assert isinstance(message.content, tuple)
    assert message.content[0].name == "ProbeToTracker"
    np.testing.assert_array_equal(message.content[0].matrix, pose)


def test_header_version_two_with_metadata() -> None:
    """Metadata after the image, id before it, as pyigtl packs them."""
    sent = pyigtl.ImageMessage(np.zeros((1, 4, 5), np.uint8), device_name="Image", timestamp=1)
    sent.header_version, sent.message_id = 2, 77
    sent.metadata = {"FrameNumber": "12", "Gain": "30"}
    (message,) = decode(sent.pack())
    assert message.message_id == 77
    assert isinstance(message.content, Picture)
    assert message.content.array.shape == (4, 5)


def test_pyigtl_reads_what_our_server_sends() -> None:
    rng = np.random.default_rng(3)
    sent = image(5, rng)
    assert isinstance(sent.content, Picture)
    data = encode(sent)
    fields = pyigtl.messages.MessageBase.parse_header(data[:HEADER_SIZE])
    read = pyigtl.ImageMessage()
    read.unpack(fields, data[HEADER_SIZE:])
    np.testing.assert_array_equal(read.image[0], sent.content.array)
    np.testing.assert_allclose(
        read.ijk_to_world_matrix, np.diag([0.25, 0.125, 1, 1]), atol=1e-6
    )  # fmt: skip
    assert (read.message_id, read.timestamp, read.device_name) == (5, 1005.5, "Image")
    pose = matrix(rng)
    data = encode(Message("TRANSFORM", "AToB", 2.5, (Tracked("AToB", pose),)))
    fields = pyigtl.messages.MessageBase.parse_header(data[:HEADER_SIZE])
    other = pyigtl.TransformMessage()
    other.unpack(fields, data[HEADER_SIZE:])
    np.testing.assert_array_equal(other.matrix, pose)


def test_what_pyigtl_does_not_know() -> None:
    """TDATA and STATUS, laid out by hand as the protocol has them."""
    pose = matrix(np.random.default_rng(4))
    numbers = pose[:3].T.ravel()
    body = struct.pack(">20sBB12f", b"ProbeToTracker", 2, 0, *numbers)
    body += struct.pack(">20sBB12f", b"NeedleToTracker", 2, 0, *numbers)
    header = struct.pack(
        ">H12s20sIIQQ", 1, b"TDATA", b"Tracker", 7, 1 << 31, len(body), crc64(body)
    )  # fmt: skip
    (message,) = decode(header + body)
    assert message.t_device == 7.5
    assert isinstance(message.content, tuple)
    assert [each.name for each in message.content] == ["ProbeToTracker", "NeedleToTracker"]
    np.testing.assert_array_equal(message.content[1].matrix, pose)
    assert decode(encode(message))[0].content[0].name == "ProbeToTracker"  # type: ignore[index]
    body = struct.pack(">Hq20s", 13, -4, b"NotReady") + b"probe unplugged\0"
    header = struct.pack(">H12s20sIIQQ", 1, b"STATUS", b"US", 0, 0, len(body), crc64(body))
    (message,) = decode(header + body)
    assert message.content == StatusMessage(13, -4, "NotReady", "probe unplugged")
    assert math.isnan(message.t_device)
    assert decode(encode(message))[0].content == message.content


def test_names_do_not_command_the_terminal_that_shows_them() -> None:
    """Half of what a control sequence needs passed as UTF-8."""
    (message,) = decode(encode(Message("TRANSFORM", "A\x9b2JToB", 1.0, (Tracked("", np.eye(4)),))))
    assert message.device == "A?2JToB"
    assert message.content[0].name == "A?2JToB"  # type: ignore[index]


def test_pixels_cannot_be_written() -> None:
    (message,) = decode(encode(image(1, np.random.default_rng(0))))
    assert isinstance(message.content, Picture)
    with pytest.raises(ValueError, match="read-only"):
        message.content.array[0, 0] = 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"image": np.zeros((1, 4, 5, 2), np.uint8)}, "2 components"),
        ({"image": np.zeros((1, 4, 5), np.float32)}, "scalar type 10"),
        ({"image": np.zeros((3, 4, 5), np.uint8)}, "volume of 5 x 4 x 3"),
        ({"ijk_to_world_matrix": np.zeros((4, 4))}, "spacing"),
        ({"ijk_to_world_matrix": np.full((4, 4), np.nan)}, "spacing"),
    ],
)
def test_images_that_are_not_taken_say_why(change: dict, reason: str) -> None:
    arguments = {"image": np.zeros((1, 4, 5), np.uint8), "device_name": "X"} | change
    decoder = MessageDecoder()
    data = pyigtl.ImageMessage(**arguments).pack() + encode(image(1, np.random.default_rng(0)))
    found = decoder.feed(data, 0.0)
    assert [message.device for message in found] == ["Image"]
    assert decoder.unsupported == 1
    assert reason in decoder.reason
    assert decoder.broken_headers == 0


@pytest.mark.parametrize("size", [1, 71, 72, 91, 93, 1000])
def test_sizes_that_disagree_with_the_image(size: int) -> None:
    body = bytearray(
        encode(Message("IMAGE", "I", 1.0, Picture(np.zeros((4, 5), np.uint8), (1.0, 1.0))))
    )
    content = (bytes(body[HEADER_SIZE:]) + bytes(1000))[:size]
    header = struct.pack(">H12s20sIIQQ", 1, b"IMAGE", b"I", 0, 0, size, crc64(content))
    good = encode(image(1, np.random.default_rng(0)))
    found = decode(header + content + good)
    assert [message.message_id for message in found] == [1]


@pytest.mark.parametrize("size", [MAXIMUM_BODY + 1, 2**32, 2**63, 2**64 - 1])
@pytest.mark.parametrize("kind", [b"IMAGE", b"STRING", b"TRANSFORM"])
def test_absurd_sizes_are_no_headers(size: int, kind: bytes) -> None:
    """Nothing is waited for or allocated, and the next message is found."""
    header = struct.pack(">H12s20sIIQQ", 1, kind, b"I", 0, 0, size, 0)
    assert parse_header(header) is None
    decoder = MessageDecoder()
    good = encode(image(1, np.random.default_rng(0)))
    assert len(decoder.feed(header + good, 0.0)) == 1
    assert decoder.held == 0
    assert decoder.broken_headers == decoder.resynchronised == 1


def test_a_large_size_that_might_be() -> None:
    """A wrong bit in an image's size is seen from the image, not after 16 MB have come."""
    rng = np.random.default_rng(5)
    messages = [encode(image(k, rng)) for k in range(1, 5)]
    spoilt = bytearray(messages[0])
    spoilt[HEADER_SIZE - 13] ^= 1  # 16 MB more
    decoder = MessageDecoder()
    found = decoder.feed(bytes(spoilt) + b"".join(messages[1:]), 0.0)
    assert [message.message_id for message in found] == [2, 3, 4]
    assert decoder.held == 0


def test_only_what_has_come_is_held() -> None:
    """A string of 32 MB is announced and comes in drops: memory is what came, not what was said."""
    decoder = MessageDecoder()
    decoder.feed(struct.pack(">H12s20sIIQQ", 1, b"STRING", b"S", 0, 0, MAXIMUM_BODY, 1), 0.0)
    for _ in range(100):
        decoder.feed(b"x" * 10, 0.0)
    assert decoder.held == HEADER_SIZE + 1000


def test_headers_within_headers_cost_no_more_than_they_bring() -> None:
    """False headers, each of a body to check: the work stays in proportion to the bytes."""
    header = struct.pack(">H12s20sIIQQ", 1, b"STRING", b"S", 0, 0, 400_000, 1)
    decoder = MessageDecoder()
    flood = header * 9000
    start = time.thread_time()
    for at in range(0, len(flood), 100_000):
        decoder.feed(flood[at : at + 100_000], 0.0)
    decoder.feed(b"\0" * 500_000, 0.0)
    assert time.thread_time() - start < 10
    assert decoder.held < 1_000_000


def test_rubbish_costs_time_in_proportion() -> None:
    """Bytes that look like a version at every other place are passed over in one go."""
    decoder = MessageDecoder()
    rubbish = b"\0\1" * 1_000_000 + b"\0\1A" * 100_000
    start = time.thread_time()
    assert decoder.feed(rubbish, 0.0) == []
    assert time.thread_time() - start < 5
    assert decoder.held < HEADER_SIZE
    assert len(decoder.feed(encode(image(1, np.random.default_rng(0))), 0.0)) == 1


def test_times_of_arrival() -> None:
    """Of a message's first byte, however many come at once or in pieces."""
    rng = np.random.default_rng(6)
    data = b"".join(encode(image(k, rng)) for k in range(1, 6))
    decoder = MessageDecoder()
    found = []
    for start in range(0, len(data), 37):
        found += decoder.feed(data[start : start + 37], start / 37)
    begins, at = [], 0
    for message in found:
        begins.append(at // 37)
        at += len(encode(message))
    assert at == len(data)
    assert [message.t_host for message in found] == begins


def stream(count: int, rng: np.random.Generator) -> tuple[list[bytes], list[Message]]:
    """Messages of all kinds, with a number within what their CRC covers."""
    messages = []
    for number in range(1, count + 1):
        choice = rng.integers(5)
        if choice < 2:
            message = image(number, rng, version=1 + number % 2)
        elif choice == 2:
            message = Message("TRANSFORM", "AToB", 1.0, (Tracked("AToB", matrix(rng)),))
        elif choice == 3:
            content = tuple(Tracked(f"T{k}", matrix(rng)) for k in range(int(rng.integers(1, 5))))
            message = Message("TDATA", "Tracker", 1.0, content, number)
        else:
            message = Message(
                "STATUS", "US", 1.0, StatusMessage(1, number, "", "x" * int(rng.integers(40)))
            )
        messages.append(message)
    return [encode(message) for message in messages], messages


def damage(data: bytes, kind: int, rng: np.random.Generator) -> bytes:
    """Flips in the header or anywhere, cuts, junk, a hole, an absurd size."""
    spoilt = bytearray(data)
    if kind == 0:
        for place in rng.integers(0, len(spoilt), rng.integers(1, 5)):
            spoilt[place] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        spoilt[int(rng.integers(HEADER_SIZE))] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        spoilt = spoilt[: rng.integers(len(spoilt))]
    elif kind == 3:
        spoilt = bytearray(rng.bytes(int(rng.integers(1, 300)))) + spoilt
    elif kind == 4:
        start = int(rng.integers(len(spoilt)))
        del spoilt[start : start + int(rng.integers(1, 60))]
    else:
        spoilt[42:50] = rng.bytes(8)
    return bytes(spoilt)


def body(message: Message) -> bytes:
    """What the CRC covers, whatever became of the header."""
    return encode(message)[HEADER_SIZE:]


@pytest.mark.parametrize("count", [4000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_fuzz(unchecked: None, count: int) -> None:
    """One message of five damaged, in pieces of any size: what is accepted was sent so.

    The header is under no CRC, so a wrong bit in a name or a time stamp passes; a content never.
    Nearly every intact message comes through. What is held stays under the documented bound: two
    wrong bits, one in the type and one in the size, make an unknown message of some megabytes,
    which nothing but its CRC can deny; what it swallowed is found again.
    """
    rng = np.random.default_rng(20261122)
    decoder = MessageDecoder()
    encoded, messages = stream(count, rng)
    bad = rng.random(count) < 0.2
    kinds = rng.integers(0, 6, count)
    sent = {body(message): k for k, message in enumerate(messages)}
    parts = [
        damage(data, int(kind), rng) if spoil else data
        for data, kind, spoil in zip(encoded, kinds, bad, strict=True)
    ]
    data = b"".join(parts)
    accepted = np.zeros(count, bool)
    place, held = 0, 0
    while place < len(data):
        portion = int(rng.integers(1, 3000))
        for message in decoder.feed(data[place : place + portion], 0.0):
            if message.content is None:
                continue  # A type that a wrong bit made unknown: nobody is handed anything.
            number = sent[body(message)]
            assert not accepted[number]
            accepted[number] = True
        held = max(held, decoder.held)
        place += portion
    assert accepted[~bad].mean() > 0.995
    assert held <= MAXIMUM_BODY + HEADER_SIZE + 3000
    counts = decoder
    assert counts.crc_errors > count / 40
    assert counts.broken_headers > count / 40
    assert counts.resynchronised > count / 20
