"""Bytes in any portions to OpenIGTLink messages; broken ones are counted, and the next is found.

The protocol has no mark between messages: after a broken header, decoding goes on at the next bytes
that can be a header. A body whose CRC is wrong is dropped as a whole if a header follows it. If
none follows, or if an image's own size contradicts its header, a header is searched within the
body. A budget in proportion to the bytes received limits how often bytes are checked again.
"""

from __future__ import annotations

import math
import re

from fastcrc import crc64

from jaxcal.io.message_content import ContentError
from jaxcal.io.openigtlink import (
    BEGINNING,
    HEADER_SIZE,
    MAXIMUM_BODY,
    Header,
    Message,
    decode_body,
    parse_header,
    size_agrees,
)

# Version 1 or 2, and the first letter of a type.
_BEGIN = re.compile(rb"\x00[\x01\x02][A-Z0-9_]")
_CHECKS_PER_BYTE = 4


class MessageDecoder:
    """Incremental decoder; never waits, and never raises on what it is fed.

    It holds at most one message and what came with it: bodies are bounded by
    :data:`~jaxcal.io.openigtlink.MAXIMUM_BODY`, and nothing is allocated before it arrives.

    Attributes:
        crc_errors: bodies whose CRC was wrong.
        broken_headers: how often there was no header where one had to be.
        unsupported: intact messages with content that is not read here.
        reason: why the last of these was not read.
        resynchronised: how often a message was accepted after something broken.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        # Arrival of the buffer's first byte, and where in it the bytes of the latest portion begin.
        self._began, self._now, self._fresh = math.nan, math.nan, 0
        self._header: Header | None = None
        self._wrong_crc = self._size_checked = False
        self._hunting = False
        self._damaged = False
        self._budget = 0
        self.crc_errors = self.broken_headers = self.unsupported = self.resynchronised = 0
        self.reason = ""

    @property
    def held(self) -> int:
        """Bytes that wait for the rest of their message."""
        return len(self._buffer)

    def feed(self, data: bytes | bytearray | memoryview, now: float) -> list[Message]:
        """The messages that ``data`` completes, in order.

        Args:
            data: any portion of the stream.
            now: its time of arrival, and that of the messages that begin in it.
        """
        if not self._buffer:
            self._began = now
        self._now, self._fresh = now, len(self._buffer)
        self._buffer += data
        self._budget = min(
            self._budget + _CHECKS_PER_BYTE * len(data), _CHECKS_PER_BYTE * MAXIMUM_BODY
        )
        found: list[Message] = []
        while self._step(found):
            pass
        return found

    def _step(self, found: list[Message]) -> bool:
        """Remove one message or one broken piece from the buffer; False when more must come."""
        if self._header is None:
            if len(self._buffer) < HEADER_SIZE:
                return False
            self._header = parse_header(memoryview(self._buffer)[:HEADER_SIZE])
            if self._header is None:
                return self._hunt()
            self._hunting = False
        end = HEADER_SIZE + self._header.size
        if len(self._buffer) < end:
            return self._size_is_wrong() and self._hunt_within()
        if not self._wrong_crc:
            body = bytes(memoryview(self._buffer)[HEADER_SIZE:end])
            self._budget -= len(body)
            if crc64.ecma_182(body) == self._header.crc:
                self._accept(self._header, body, found)
                self._drop(end)
                return True
            self.crc_errors += 1
            self._wrong_crc = self._damaged = True
        # The bytes that follow show whether the size can be trusted.
        if len(self._buffer) < end + HEADER_SIZE:
            return False
        follows = parse_header(memoryview(self._buffer)[end : end + HEADER_SIZE])
        if follows is not None or self._budget < 0:
            self._drop(end)
            return True
        return self._hunt_within()

    def _size_is_wrong(self) -> bool:
        if self._size_checked or self._header is None:
            return False
        if len(self._buffer) < HEADER_SIZE + min(BEGINNING, self._header.size):
            return False
        self._size_checked = True
        body = memoryview(self._buffer)[HEADER_SIZE : HEADER_SIZE + BEGINNING]
        return not size_agrees(self._header, body)

    def _hunt_within(self) -> bool:
        """Look for a header in what was taken for a message."""
        # The arrival of a message found there is not known: rather too late than too early.
        self._fresh = 0
        self._began = self._now
        return self._hunt()

    def _accept(self, header: Header, body: bytes, found: list[Message]) -> None:
        if self._damaged:
            self.resynchronised += 1
            self._damaged = False
        try:
            found.append(decode_body(header, body, self._began))
        except ContentError as error:
            self.unsupported += 1
            self.reason = f"{header.device}: {error}"

    def _hunt(self) -> bool:
        """Drop bytes up to the next place where a header may begin."""
        if not self._hunting:
            self._hunting = self._damaged = True
            self.broken_headers += 1
        # If fewer bytes than a header are left, they may be the beginning of one.
        last = len(self._buffer) - HEADER_SIZE
        place = 1
        while (match := _BEGIN.search(self._buffer, place)) is not None:
            place = match.start()
            # A match that is kept would keep the buffer from being cut.
            del match
            if place > last:
                self._drop(place)
                return False
            if parse_header(memoryview(self._buffer)[place : place + HEADER_SIZE]):
                self._drop(place)
                return True
            place += 1
        # The last two bytes may be the beginning of a header that the next portion completes.
        self._drop(max(1, len(self._buffer) - 2))
        return False

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._header = None
        self._wrong_crc = self._size_checked = False
        self._fresh -= count
        if self._fresh <= 0:
            self._began = self._now
