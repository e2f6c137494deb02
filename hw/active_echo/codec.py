"""The line protocol of the active-echo electronics: bytes to frames and replies, and back.

**The protocol is ours.** No host interface of active-echo electronics (AUSPIS) is published, so
this one was made up for the driver and the bench's emulator. A lab with another interface writes
another codec; transport and driver know nothing of what is described here but :class:`Decoder`
and the ``encode`` functions.

Commands, host to device: one line of printable ASCII, ``<command>*<crc>`` and a line feed, where
crc is the CRC-32 (zlib) of the command in eight hexadecimal digits. A person who types commands may
leave out ``*<crc>``; the device then takes the line unchecked.

==================  ===============================================================================
``*IDN?``           maker, model, serial number, firmware, separated by commas
``SYST:ERR?``       oldest error not yet asked for, ``0,none`` when there is none
``CLK?``            frequency of the counter, Hz
``THR <n>``         detection threshold, 0 to 4095, in counts of the amplitude's converter
``THR?``            threshold in force
``PATT:LOAD <hex>`` pattern: a byte a line, level of the element's answer on that line, 0 for none;
                    answered by the pattern's CRC-32
``PATT:STAT ON``    answer each received pulse with the pattern (``OFF``, as at power-up: listen)
``INJ:DEL <n>``     ticks between a received pulse and the answer, 0 to 65535
``TRIG:COUN?``      line triggers and frame triggers since power-up, ``<lines>,<frames>``
``STRM ON``         send a frame after each frame trigger (``OFF``, as at power-up: be silent)
==================  ===============================================================================

A reply begins with the word of its command, so that a late reply is not taken for that of another
command: ``THR? 512``. A command that sets a value is answered by the value now in force
(``THR 512``), a refused command by ``ERR <code>,<text>`` after its word. While the device does not
stream, replies are lines like commands, always with their CRC. After the line ``STRM ON`` they are
sent as binary frames, up to and including the reply ``STRM OFF``.

Binary frames, device to host: a zero byte, the payload in COBS (Cheshire and Baker 1999: no zero
byte within), a zero byte. Bytes that are lost, added or changed damage only the frames that they
touch, and none after the next zero byte. All numbers are little-endian; the last four bytes are the
CRC-32 of all bytes before.

=======  =======================================================================================
echo     type u8 = 1, version u8 = 1, frame u32, clock u64 [ticks], lines u16, threshold u16,
         lines x (time of flight u16 [ticks], amplitude u16), crc u32; time of flight 0xFFFF: no
         response above the threshold on that line
reply    type u8 = 2, version u8 = 1, text (ASCII), crc u32
=======  =======================================================================================

``frame`` counts the frame triggers of the ultrasound machine, ``clock`` is the counter at that
trigger, ``lines`` the line triggers that followed it. A gap in ``frame`` is a frame that was
lost; fewer lines than the probe fires are line triggers that were missed. 128 lines take 539
bytes at most: 30 frames/s are 162 kbaud, more than 115200 and less than 921600.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from hw.runtime.extras import require
from jaxcal.runtime.array_types import UInt16
from jaxcal.runtime.messages import printable

NO_RESPONSE = 0xFFFF
"""Time of flight (ticks) of a line without a response."""

MAXIMUM_THRESHOLD = 4095
MAXIMUM_LINES = 1024
"""More lines than any probe fires: a longer frame is malformed."""

_HEADER = struct.Struct("<BBIQHH")
_VERSION = 1
_ECHO, _REPLY = 1, 2
_LONGEST = _HEADER.size + 4 * MAXIMUM_LINES + 4
_LONGEST_ENCODED = _LONGEST + _LONGEST // 254 + 1
_LONGEST_LINE = 2 * MAXIMUM_LINES + 64


@dataclass(frozen=True)
class EchoPacket:
    """What the device says of one frame of the ultrasound machine.

    Attributes:
        frame: the device's count of frame triggers.
        ticks: its clock at that trigger.
        threshold: in force during the frame, counts.
        tof_ticks: (lines,) time of flight, 0xFFFF where nothing was heard.
        amplitude: (lines,) peak amplitude, counts.
    """

    frame: int
    ticks: int
    threshold: int
    tof_ticks: UInt16[np.ndarray, " lines"]
    amplitude: UInt16[np.ndarray, " lines"]


@dataclass(frozen=True)
class Reply:
    """An answer to a command: the command's word, and what it says.

    Attributes:
        word: ``THR?``.
        value: ``512``.
    """

    word: str
    value: str


class Mode(Enum):
    """How the bytes to come are read."""

    TEXT = "text"
    BINARY = "binary"
    UNKNOWN = "unknown"
    """Whether the device streams is not known; the first line or frame with a right CRC tells."""


def encode_line(text: str) -> bytes:
    """A command or a reply as a line with its CRC.

    Raises:
        ValueError: characters that are not printable ASCII.
    """
    if not (text.isascii() and text.isprintable()):
        raise ValueError(f"a line holds printable ASCII only, not {text!r}")
    body = text.encode("ascii")
    return body + b"*%08x\n" % zlib.crc32(body)


def decode_line(line: bytes) -> tuple[str, bool | None]:
    """Text of a line without its line feed, and whether its CRC is right; None without one."""
    text = line.rstrip(b"\r")
    body, star, digits = text.rpartition(b"*")
    checked: bool | None = None
    if star and len(digits) == 8:
        text = body
        checked = digits == b"%08x" % zlib.crc32(body)
    return text.decode("ascii", "replace"), checked


def encode_echo(packet: EchoPacket) -> bytes:
    """An echo frame with both its delimiters."""
    lines = len(packet.tof_ticks)
    values = np.empty((lines, 2), "<u2")
    values[:, 0], values[:, 1] = packet.tof_ticks, packet.amplitude
    header = _HEADER.pack(_ECHO, _VERSION, packet.frame, packet.ticks, lines, packet.threshold)
    return _frame(header + values.tobytes())


def encode_reply(text: str) -> bytes:
    """A reply frame with both its delimiters."""
    return _frame(bytes((_REPLY, _VERSION)) + text.encode("ascii"))


def _frame(body: bytes) -> bytes:
    checked = body + zlib.crc32(body).to_bytes(4, "little")
    return b"\0" + require("cobs.cobs", extra="serial").encode(checked) + b"\0"


class Decoder:
    """Bytes in any portions to frames and replies; whatever is damaged is counted and left out.

    It never waits, never raises on what it is fed, and keeps at most one chunk of bounded length.

    Args:
        mode: how the first bytes are read.

    Attributes:
        damaged: chunks with a wrong CRC, that were not COBS, of impossible length, or of an unknown
            kind.
        resynchronised: how often something was accepted after something damaged.
    """

    def __init__(self, mode: Mode = Mode.BINARY) -> None:
        cobs: Any = require("cobs.cobs", extra="serial")
        self._unstuff, self._error = cobs.decode, cobs.DecodeError
        self._buffer = bytearray()
        self._scanned = 0
        self._skipping = False
        self._after_damage = False
        self.damaged = self.resynchronised = 0
        self.mode = mode

    def reset(self, mode: Mode) -> None:
        """Forget what is half read and read what comes in ``mode``; the counts go on."""
        self._buffer.clear()
        self._scanned = 0
        self._skipping = self._after_damage = False
        self.mode = mode

    def feed(self, data: bytes) -> list[EchoPacket | Reply]:
        """What ``data`` completes, in order."""
        self._buffer += data
        found: list[EchoPacket | Reply] = []
        while True:
            item, more = self._next()
            if item is not None:
                found.append(item)
            if not more:
                return found

    def _next(self) -> tuple[EchoPacket | Reply | None, bool]:
        """The next item if there is one, and whether there may be more in the buffer."""
        if self.mode is Mode.BINARY:
            return self._next_chunk(b"\0", _LONGEST_ENCODED, self._frame)
        if self.mode is Mode.TEXT:
            return self._next_chunk(b"\n", _LONGEST_LINE, self._line)
        return self._next_unknown()

    def _next_chunk(
        self, delimiter: bytes, longest: int, take: Any
    ) -> tuple[EchoPacket | Reply | None, bool]:
        end = self._buffer.find(delimiter, self._scanned)
        if end < 0:
            self._scanned = len(self._buffer)
            if self._skipping or self._scanned > longest:
                self._skip()
            return None, False
        chunk = bytes(self._buffer[:end])
        del self._buffer[: end + 1]
        self._scanned = 0
        if self._skipping:
            self._skipping = False
            return None, True
        if not chunk:
            return None, True
        return (self._bad() if len(chunk) > longest else take(chunk)), True

    def _skip(self) -> None:
        """Drop a chunk that is too long, up to the next delimiter."""
        if not self._skipping:
            self._bad()
        self._buffer.clear()
        self._scanned = 0
        self._skipping = True

    def _next_unknown(self) -> tuple[EchoPacket | Reply | None, bool]:
        zero, feed = (self._buffer.find(mark, self._scanned) for mark in (b"\0", b"\n"))
        if zero < 0 and feed < 0:
            self._scanned = len(self._buffer)
            if self._scanned > _LONGEST_ENCODED:
                self._buffer.clear()
                self._scanned = 0
            return None, False
        if feed >= 0 and (zero < 0 or feed < zero):
            # A binary frame may hold a line feed, so a chunk that is no valid line stays.
            start = self._buffer.rfind(b"\n", 0, feed) + 1
            text, checked = decode_line(bytes(self._buffer[start:feed]))
            self._scanned = feed + 1
            if not checked:
                if checked is False:
                    self._bad()
                return None, True
            del self._buffer[: feed + 1]
            self._scanned = 0
            self.mode = Mode.TEXT
            return self._accept_reply(text), True
        chunk = bytes(self._buffer[:zero])
        del self._buffer[: zero + 1]
        self._scanned = 0
        item = self._frame(chunk) if chunk else None
        if item is not None and self.mode is Mode.UNKNOWN:
            self.mode = Mode.BINARY
        return item, True

    def _line(self, line: bytes) -> Reply | None:
        text, checked = decode_line(line)
        return self._accept_reply(text) if checked else self._bad()

    def _frame(self, chunk: bytes) -> EchoPacket | Reply | None:
        try:
            payload = self._unstuff(chunk)
        except self._error:
            payload = b""
        body = payload[:-4]
        if not 6 <= len(payload) <= _LONGEST or (
            zlib.crc32(body) != int.from_bytes(payload[-4:], "little")
        ):
            return self._bad()
        item = self._echo(body) if body[0] == _ECHO else None
        if item is not None:
            self._good()
            return item
        if body[0] == _REPLY and body[1] == _VERSION:
            return self._accept_reply(body[2:].decode("ascii", "replace"))
        return self._bad()

    def _echo(self, body: bytes) -> EchoPacket | None:
        if len(body) < _HEADER.size:
            return None
        _, version, frame, ticks, lines, threshold = _HEADER.unpack_from(body)
        if version != _VERSION or len(body) != _HEADER.size + 4 * lines:
            return None
        values = np.frombuffer(body, "<u2", offset=_HEADER.size).reshape(lines, 2).T
        tof, amplitude = np.ascontiguousarray(values).astype(np.uint16, copy=False)
        return EchoPacket(frame, ticks, threshold, tof, amplitude)

    def _accept_reply(self, text: str) -> Reply:
        self._good()
        text = printable(text)
        word, _, value = text.partition(" ")
        if word == "STRM":
            self.mode = {"ON": Mode.BINARY, "OFF": Mode.TEXT}.get(value, self.mode)
        return Reply(word, value)

    def _bad(self) -> None:
        self.damaged += 1
        self._after_damage = True

    def _good(self) -> None:
        if self._after_damage:
            self.resynchronised += 1
            self._after_damage = False
