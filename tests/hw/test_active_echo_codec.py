"""The line protocol: round trips, and a fuzz in which nothing wrong may pass."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hw.active_echo.codec import (
    MAXIMUM_LINES,
    NO_RESPONSE,
    Decoder,
    EchoPacket,
    Mode,
    Reply,
    decode_line,
    encode_echo,
    encode_line,
    encode_reply,
)


def packet(frame: int, lines: int, rng: np.random.Generator) -> EchoPacket:
    tof, amplitude = rng.integers(0, 0x10000, (2, lines), dtype=np.uint16)
    return EchoPacket(frame, int(rng.integers(2**63)), int(rng.integers(4096)), tof, amplitude)


def content(item: EchoPacket | Reply) -> tuple:
    assert isinstance(item, EchoPacket)
    return (
        item.frame, item.ticks, item.threshold, item.tof_ticks.tobytes(), item.amplitude.tobytes(),
    )  # fmt: skip


@settings(max_examples=100)
@given(
    st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 300)), max_size=6),
    st.integers(1, 700),
    st.integers(0, 2**32),
)
def test_frames_come_back_however_they_are_split(frames, portion, seed) -> None:
    rng = np.random.default_rng(seed)
    sent = [packet(frame, lines, rng) for frame, lines in frames]
    stream = b"".join(map(encode_echo, sent))
    decoder = Decoder()
    found = []
    for start in range(0, len(stream), portion):
        found += decoder.feed(stream[start : start + portion])
    assert [content(item) for item in found] == [content(item) for item in sent]
    assert decoder.damaged == 0


def test_layout() -> None:
    """Field by field as documented, without the codec's own structs."""
    data = encode_echo(
        EchoPacket(
            0x01020304, 0x1122334455667788, 0x0ABC,
            np.array([5, NO_RESPONSE], np.uint16), np.array([0x0102, 7], np.uint16),
        )
    )  # fmt: skip
    assert data[0] == data[-1] == 0
    assert 0 not in data[1:-1]
    plain, rest = bytearray(), data[1:-1]
    while rest:
        run, rest = rest[1 : rest[0]], rest[rest[0] :]
        plain += run + b"\0"
    plain.pop()
    expected = (
        "01 01 04030201 8877665544332211 0200 bc0a 0500 0201 ffff 0700".replace(" ", "")
    )  # fmt: skip
    assert plain[:-4].hex() == expected
    assert int.from_bytes(plain[-4:], "little") == zlib.crc32(bytes.fromhex(expected))


def test_size_of_a_frame() -> None:
    """As documented: 539 bytes for 128 lines, which 115200 baud do not carry 30 times a second."""
    rng = np.random.default_rng(0)
    sizes = {len(encode_echo(packet(1, 128, rng))) for _ in range(20)}
    assert sizes <= {537, 538, 539}
    assert 115_200 < 30 * max(sizes) * 10 < 921_600


@settings(max_examples=100)
@given(st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=60))
def test_lines_carry_their_crc(text: str) -> None:
    line = encode_line(text)
    assert line.endswith(b"\n")
    assert decode_line(line[:-1]) == (text, True)
    assert decode_line(line[:-1] + b"\r") == (text, True)
    spoilt = bytes([line[0] ^ 1]) + line[1:-1]
    assert decode_line(spoilt)[1] is not True


def test_what_a_person_types_needs_no_crc() -> None:
    assert decode_line(b"*IDN?") == ("*IDN?", None)
    assert decode_line(b"THR 12\r") == ("THR 12", None)
    with pytest.raises(ValueError, match="printable"):
        encode_line("THR\n5")


def test_an_answer_does_not_command_the_terminal_that_shows_it() -> None:
    """``jaxcal-hw check`` cleared the screen, and set its title, where an identity said so."""
    text = "*IDN? A\x1b[2J\x07\nB"
    decoder = Decoder(Mode.BINARY)
    assert decoder.feed(encode_reply(text)) == [Reply("*IDN?", "A?[2J??B")]


def test_modes_follow_the_replies() -> None:
    """Lines, then frames from STRM ON to STRM OFF, then lines; in one portion or byte by byte."""
    rng = np.random.default_rng(1)
    echoes = [packet(k, 7, rng) for k in range(3)]
    stream = (
        encode_line("THR? 12") + encode_line("STRM ON") + encode_echo(echoes[0])
        + encode_echo(echoes[1]) + encode_reply("THR 8") + encode_echo(echoes[2])
        + encode_reply("STRM OFF") + encode_line("THR? 8")
    )  # fmt: skip
    for portion in (1, len(stream)):
        decoder = Decoder(Mode.TEXT)
        found = []
        for start in range(0, len(stream), portion):
            found += decoder.feed(stream[start : start + portion])
        replies = [item for item in found if isinstance(item, Reply)]
        assert replies == [
            Reply("THR?", "12"), Reply("STRM", "ON"), Reply("THR", "8"), Reply("STRM", "OFF"),
            Reply("THR?", "8"),
        ]  # fmt: skip
        frames = [content(item) for item in found if isinstance(item, EchoPacket)]
        assert frames == [content(item) for item in echoes]
        assert decoder.damaged == 0


@pytest.mark.parametrize("seed", range(10))
def test_whatever_the_device_was_doing(seed: int) -> None:
    """A device left streaming, or silent, or saying half a line: the first checked thing tells."""
    rng = np.random.default_rng(seed)
    streaming = b"".join(encode_echo(packet(k, 128, rng)) for k in range(3))
    decoder = Decoder(Mode.UNKNOWN)
    cut = int(rng.integers(1, 500))
    found = decoder.feed(streaming[cut:])
    assert [item.frame for item in found if isinstance(item, EchoPacket)] == [1, 2]
    assert decoder.mode is Mode.BINARY
    decoder.feed(encode_reply("STRM OFF"))
    assert decoder.mode is Mode.TEXT
    decoder.reset(Mode.UNKNOWN)
    assert decoder.feed(b"R? 17\n" + encode_line("STRM OFF")) == [Reply("STRM", "OFF")]
    assert decoder.mode is Mode.TEXT
    decoder.reset(Mode.UNKNOWN)
    decoder.feed(rng.bytes(20_000).replace(b"\0", b"\1"))
    assert decoder.feed(b"\n" + encode_line("STRM OFF")) == [Reply("STRM", "OFF")]


@pytest.mark.parametrize("mode", list(Mode))
def test_what_never_ends_is_not_kept(mode: Mode) -> None:
    decoder = Decoder(mode)
    for _ in range(2000):
        assert decoder.feed(b"\x55" * 5000) == []
    assert len(decoder._buffer) < 20_000
    end = encode_line("A 1") if mode is Mode.TEXT else encode_reply("A 1")
    decoder.feed(b"\n" if mode is Mode.TEXT else b"\0")
    assert decoder.feed(end) == [Reply("A", "1")]


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"\x01",
        b"\x01\x01" + bytes(10),
        b"\x01\x02" + bytes(16),
        b"\x01\x01" + bytes(12) + b"\x03\x00" + bytes(2) + bytes(8),
        b"\x03\x01" + bytes(16),
        b"\x02\x09THR 1",
        b"\x01\x01" + bytes(12) + (MAXIMUM_LINES + 1).to_bytes(2, "little") + bytes(2)
        + bytes(4 * MAXIMUM_LINES + 4),
    ],
)  # fmt: skip
def test_a_right_crc_is_not_enough(body: bytes) -> None:
    """Lengths, types and versions are checked too."""
    from cobs import cobs

    decoder = Decoder()
    data = cobs.encode(body + zlib.crc32(body).to_bytes(4, "little"))
    assert decoder.feed(b"\0" + data + b"\0") == []
    assert decoder.damaged == 1


def damage(data: bytes, kind: int, rng: np.random.Generator) -> bytes:
    """Bit flips, a cut at either end, a hole, bytes put in, junk in front; or two of them."""
    spoilt = bytearray(data)
    if kind == 0:
        for place in rng.integers(0, len(spoilt), rng.integers(1, 9)):
            spoilt[place] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        spoilt = spoilt[: rng.integers(len(spoilt))]
    elif kind == 2:
        spoilt = spoilt[rng.integers(1, len(spoilt)) :]
    elif kind == 3:
        start = int(rng.integers(len(spoilt)))
        del spoilt[start : start + int(rng.integers(1, 20))]
    elif kind == 4:
        place = int(rng.integers(len(spoilt)))
        spoilt[place:place] = rng.bytes(int(rng.integers(1, 30)))
    elif kind == 5:
        spoilt = bytearray(rng.bytes(int(rng.integers(1, 200)))) + spoilt
    else:
        return damage(damage(data, 0, rng), int(rng.integers(1, 6)), rng) or b"\x07"
    return bytes(spoilt)


def test_fuzz(unchecked: None) -> None:
    """10^5 frames, two of five damaged, in pieces of any size: nothing wrong is taken for right.

    Each accepted frame is one that was sent, to the bit, and none is accepted twice; of two intact
    frames in a row the second is always accepted, so that the decoder is back within two frames.
    """
    rng = np.random.default_rng(20261121)
    decoder = Decoder()
    pool = [packet(0, int(lines), rng) for lines in rng.integers(0, 60, 997)]
    count = 100_000
    bad = rng.random(count) < 0.4
    kinds = rng.integers(0, 7, count)
    accepted = np.zeros(count, bool)
    portions = iter(np.minimum(rng.geometric(1 / 300, 300_000), 5000).tolist())
    rest = b""
    for block in range(0, count, 1000):
        stream = [rest]
        for number in range(block, block + 1000):
            data = encode_echo(replaced(pool[number % 997], number))
            stream.append(damage(data, int(kinds[number]), rng) if bad[number] else data)
        joined = b"".join(stream)
        place = 0
        while True:
            portion = next(portions)
            if place + portion > len(joined) and block + 1000 < count:
                break
            for item in decoder.feed(joined[place : place + portion]):
                assert isinstance(item, EchoPacket)
                template = pool[item.frame % 997]
                assert (item.ticks, item.threshold) == (
                    template.ticks + item.frame, template.threshold,
                )  # fmt: skip
                assert item.tof_ticks.tobytes() == template.tof_ticks.tobytes()
                assert item.amplitude.tobytes() == template.amplitude.tobytes()
                assert not accepted[item.frame]
                accepted[item.frame] = True
            place += portion
            if place >= len(joined):
                break
        rest = joined[place:]
    intact = ~bad
    assert accepted[1:][intact[1:] & intact[:-1]].all()
    # Delimiters on both sides: damage reaches the next frame only where it takes the delimiters.
    assert accepted[intact].mean() > 0.97
    assert 10_000 < decoder.resynchronised <= bad.sum()
    assert decoder.damaged > 10_000


def replaced(template: EchoPacket, frame: int) -> EchoPacket:
    return EchoPacket(
        frame, template.ticks + frame, template.threshold, template.tof_ticks, template.amplitude
    )
