"""Driver of the active-echo electronics: commands, and a stream of checked frames.

A thread reads the line and decodes; frames wait in a bounded queue. Nothing is made up: a gap in
the device's frame counter is counted as lost, a damaged frame is dropped and counted, a frame
with another number of lines than the probe fires (after a missed line trigger it is not known which
line is missing) is counted and not handed on, a frame that comes again is counted and dropped, and
when the queue is full the oldest frame is dropped and counted.

How late frames are (:attr:`EchoFrame.late_s`): the device is asked for its count of frame triggers.
The frame with that number was triggered after the question, so its way here took at most the time
since the question. For the other frames the device's ticks tell how much later, or earlier, they
came.
"""

from __future__ import annotations

import contextlib
import threading
import time
import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hw.active_echo.codec import (
    MAXIMUM_LINES,
    MAXIMUM_THRESHOLD,
    NO_RESPONSE,
    Decoder,
    EchoPacket,
    Mode,
    Reply,
    encode_line,
)
from hw.active_echo.transport import BAUD, DEVICE, open_transport
from hw.runtime.clock import REAL, Clock
from hw.runtime.errors import DeviceError, LostError, RefusedError, StaleError
from hw.runtime.interrupts import lock_and_condition
from jaxcal.runtime.array_types import Float

COMMAND_TIMEOUT_S = 1.0
"""A command that is not answered within this bench time has failed."""

SILENT = "is the ultrasound machine frozen, its frame trigger unplugged, or the electronics off?"
"""Why no frames may come."""

# Where a bench runs faster than real time, the operating system does not become faster.
_SHORTEST_WAIT_S = 0.25

_LARGEST_GAP = 2**31
_REMEMBERED = 256
_DRIFT = 1e-4
"""Two quartz clocks drift apart by less than this."""

_MAXIMUM_DELAY_TICKS = 0xFFFF


@dataclass(frozen=True, kw_only=True)
class EchoFrame(EchoPacket):
    """What the element heard of one frame of the ultrasound machine.

    Attributes:
        t_host: arrival of the frame's last byte, s of the bench's clock.
        tof_s: (lines,) one-way time of flight, s; NaN where nothing was heard.
        late_s: upper bound of the time from its trigger to its arrival, s; NaN where not known.
    """

    t_host: float
    tof_s: Float[np.ndarray, " lines"]
    late_s: float = float("nan")


@dataclass
class EchoStatistics:
    """Counts since the port was opened.

    Attributes:
        received: frames accepted into the queue.
        lost: frames missing in the device's counter (missed frame triggers, or damaged on the way).
        crc_errors: frames or replies that arrived damaged.
        resynchronised: how often something was accepted after something damaged.
        dropped: frames that the full queue had no room for.
        short: frames with fewer or more lines than the probe fires; not handed on.
        restarts: how often the counter went back (the device was restarted).
        repeated: frames that came again; not handed on.
    """

    received: int = 0
    lost: int = 0
    crc_errors: int = 0
    resynchronised: int = 0
    dropped: int = 0
    short: int = 0
    restarts: int = 0
    repeated: int = 0


class ActiveEcho:
    """The electronics behind a port, from opening to :meth:`close`; a context manager.

    Args:
        url: serial port, pty or ``socket://host:port``.
        clock: of the bench; time-outs and time stamps are in its seconds.
        lines: lines per frame that the probe fires.
        queue: most frames that wait to be read.

    Raises:
        DeviceError: the port cannot be opened, or nothing behind it answers as this device would.
    """

    def __init__(
        self, url: str, *, clock: Clock = REAL, lines: int = 128, queue: int = 512
    ) -> None:
        if not 1 <= lines <= MAXIMUM_LINES:
            raise DeviceError(f"lines must be 1 to {MAXIMUM_LINES}, not {lines}", device=DEVICE)
        if queue < 1:
            raise DeviceError(f"the queue must hold a frame at least, not {queue}", device=DEVICE)
        self.url, self.lines, self._clock = url, lines, clock
        self._decoder = Decoder(Mode.UNKNOWN)
        self._lock, self._changed = lock_and_condition()
        self._asking = threading.Lock()
        self._frames: deque[EchoFrame] = deque(maxlen=queue)
        self._replies: deque[Reply] = deque(maxlen=64)
        self._counts = EchoStatistics()
        self._last_frame: int | None = None
        self._recent: deque[tuple[int, int]] = deque(maxlen=_REMEMBERED)
        # _asked: time of the question, and the number of the next frame then. _anchor: a frame's
        # arrival, its ticks, and the bound of its delay.
        self._asked: tuple[float, int] | None = None
        self._anchor: tuple[float, int, float] | None = None
        self._tick_s = 0.0
        self._failure: LostError | None = None
        self._threshold: int | None = None
        self._stopping = False
        self._transport = open_transport(url)
        self._reader = threading.Thread(target=self._read_on, name="active echo", daemon=True)
        self._reader.start()
        try:
            self._greet()
        except BaseException:
            # It was only asked to be silent.
            self._release()
            raise

    def _greet(self) -> None:
        """Silence the device, whatever state it was left in, and ask for its clock frequency."""
        self._ask("STRM", "OFF", expected="OFF")
        # A program that was killed may have left it answering: every image would show that.
        self.inject(False)
        self._tick_s = 1.0 / self.clock_hz()
        with self._lock:
            self._frames.clear()
            self._decoder.damaged = self._decoder.resynchronised = 0
            self._counts = EchoStatistics()
            self._last_frame = None
            self._recent.clear()

    # Commands

    def identify(self) -> str:
        """Maker, model, serial number and firmware, as the device puts them."""
        return self._ask("*IDN?")

    def clock_hz(self) -> float:
        """Frequency of the device's counter, Hz.

        Raises:
            DeviceError: an answer that cannot be a frequency.
        """
        text = self._ask("CLK?")
        value = float(text) if text.replace(".", "", 1).isdigit() else 0.0
        if not 1e3 <= value <= 1e12:
            raise DeviceError(f"{self.url} has a clock of {text!r} Hz", device=DEVICE)
        return value

    def set_threshold(self, threshold: int) -> None:
        """Set the threshold of detection, counts.

        Raises:
            DeviceError: not 0 to 4095, or not taken by the device.
        """
        if not 0 <= threshold <= MAXIMUM_THRESHOLD:
            raise DeviceError(
                f"threshold must be 0 to {MAXIMUM_THRESHOLD}, not {threshold}", device=DEVICE
            )
        self._ask("THR", str(threshold), expected=str(threshold))
        self._threshold = threshold

    def check_threshold(self, frames: Sequence[EchoFrame]) -> None:
        """Check that frames, which began after the threshold was set, were taken at it.

        Raises:
            DeviceError: they were not: amplitudes and lines that answered mean something else.
        """
        for frame in frames:
            if self._threshold not in (None, frame.threshold):
                raise DeviceError(
                    f"the threshold was set to {self._threshold}, but is {frame.threshold}: was "
                    "the device restarted, or the threshold set by hand?",
                    device=DEVICE,
                )

    def threshold(self) -> int:
        """Threshold in force, counts."""
        return self._integer("THR?", self._ask("THR?"))

    def load_pattern(self, pattern: bytes) -> None:
        """Load the pattern to answer with: a level (0 to 255) for each line.

        Raises:
            DeviceError: not one level a line.
        """
        if len(pattern) != self.lines:
            raise DeviceError(
                f"a pattern has a level for each of {self.lines} lines, not {len(pattern)}",
                device=DEVICE,
            )
        self._ask("PATT:LOAD", pattern.hex(), expected=f"{zlib.crc32(pattern):08x}")

    def inject(self, on: bool, delay_s: float = 0.0) -> None:
        """Answer each received pulse with the pattern, or only listen (as at power-up).

        Args:
            on: answer or not.
            delay_s: between the received pulse and the answer, at most 65535 ticks of the device's
                clock.

        Raises:
            DeviceError: another delay, or not taken by the device.
        """
        if on:
            longest_s = _MAXIMUM_DELAY_TICKS * self._tick_s
            if not 0 <= delay_s <= longest_s:
                raise DeviceError(
                    f"delay must be 0 to {longest_s:.4g} s with this clock, not {delay_s:g}",
                    device=DEVICE,
                )
            ticks = str(round(delay_s / self._tick_s))
            self._ask("INJ:DEL", ticks, expected=ticks)
        state = "ON" if on else "OFF"
        self._ask("PATT:STAT", state, expected=state)

    def trigger_count(self) -> tuple[int, int]:
        """Line triggers and frame triggers that the device has counted since power-up."""
        text = self._ask("TRIG:COUN?")
        lines, comma, frames = text.partition(",")
        if not comma:
            raise DeviceError(f"{self.url} answered TRIG:COUN? by {text!r}", device=DEVICE)
        return self._integer("TRIG:COUN?", lines), self._integer("TRIG:COUN?", frames)

    def measure_delay(self) -> None:
        """Ask for the device's frame count, so that the delay of the next frames is known."""
        sent = self._clock.now()
        _, frames = self.trigger_count()
        with self._lock:
            self._asked = sent, frames

    def device_error(self) -> str | None:
        """The oldest error of the device that was not asked for yet; None without one."""
        text = self._ask("SYST:ERR?", attempts=1)
        return None if text.startswith("0,") else text

    def stream(self, on: bool) -> None:
        """Have the device send frames, or not."""
        state = "ON" if on else "OFF"
        with self._lock:
            self._last_frame = None
        self._ask("STRM", state, expected=state)

    # Frames

    def read(self, timeout_s: float) -> EchoFrame:
        """The oldest frame that waits, or the next that comes.

        Args:
            timeout_s: longest wait, s of the bench's clock.

        Raises:
            StaleError: no frame in time.
            LostError: the device is gone; frames that came before are handed out first.
        """
        with self._lock:
            self._changed.wait_for(
                lambda: self._frames or self._failure, self._clock.wall(timeout_s)
            )
            if self._frames:
                return self._frames.popleft()
            if self._failure is not None:
                raise self._failure
        raise StaleError(f"no frame from {self.url} for {timeout_s:g} s: {SILENT}", device=DEVICE)

    def drain(self) -> list[EchoFrame]:
        """All frames that wait, oldest first; may be none.

        Raises:
            LostError: the device is gone and no frame waits.
        """
        with self._lock:
            frames = list(self._frames)
            self._frames.clear()
            if not frames and self._failure is not None:
                raise self._failure
        return frames

    def statistics(self) -> EchoStatistics:
        """Counts since the port was opened."""
        with self._lock:
            decoder = self._decoder
            return replace(
                self._counts,
                crc_errors=decoder.damaged,
                resynchronised=decoder.resynchronised,
            )

    def close(self) -> None:
        """Silence the device if it still listens, and close the port; safe to repeat.

        It is waited for until it says that it is silent: what was written but not read yet may be
        lost when a connection over a network is closed.
        """
        try:
            if not self._stopping and self._failure is None:
                with contextlib.suppress(DeviceError):
                    self.inject(False)
                    self.stream(False)
        finally:
            self._release()

    def _release(self) -> None:
        """End the reader and close the port."""
        self._stopping = True
        self._reader.join()
        self._transport.close()

    def __enter__(self) -> ActiveEcho:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Asking

    def _integer(self, word: str, text: str) -> int:
        if not (text.isdigit() and len(text) < 20):
            raise DeviceError(f"{self.url} answered {word} by {text!r}", device=DEVICE)
        return int(text)

    def _ask(
        self, word: str, argument: str = "", *, expected: str | None = None, attempts: int = 3
    ) -> str:
        """Send a command and wait for its own reply.

        Settings are absolute, so repeating one changes nothing. A command that changes something
        when repeated (reading an error takes it from the device's list) needs ``attempts=1``.
        """
        with self._asking:
            for attempt in range(attempts):
                with self._lock:
                    self._replies.clear()
                    if attempt:
                        # The reply that was missed may have been one that changes the mode.
                        self._decoder.reset(Mode.UNKNOWN)
                self._transport.write(encode_line(f"{word} {argument}" if argument else word))
                answer = self._await_reply(word, expected)
                if answer is not None:
                    break
            else:
                raise StaleError(
                    f"{self.url} did not answer {word} within {COMMAND_TIMEOUT_S:g} s: is it "
                    f"switched on, at {BAUD} baud, and the right port?",
                    device=DEVICE,
                )
        if answer.startswith("ERR "):
            raise RefusedError(f"{self.url} refused {word}: {answer[4:]}", device=DEVICE)
        if expected is not None and answer != expected:
            raise DeviceError(
                f"{self.url} was set to {word} {argument}, but reports {answer}", device=DEVICE
            )
        return answer

    def _await_reply(self, word: str, expected: str | None) -> str | None:
        """The reply's value; one other than ``expected`` only if that does not come in time."""
        other: str | None = None
        wait = max(self._clock.wall(COMMAND_TIMEOUT_S), _SHORTEST_WAIT_S)
        deadline = time.monotonic() + wait
        with self._lock:
            while True:
                while self._replies:
                    reply = self._replies.popleft()
                    if reply.word != word:
                        continue
                    if expected in (None, reply.value) or reply.value.startswith("ERR "):
                        return reply.value
                    other = reply.value
                if self._failure is not None:
                    raise self._failure
                left = deadline - time.monotonic()
                if left <= 0:
                    return other
                self._changed.wait(left)

    # Reading

    def _read_on(self) -> None:
        """The reader's thread; an unexpected error ends the stream, too, and is told."""
        try:
            self._read_all()
        except Exception as error:
            self._fail(LostError(f"{type(error).__name__}: {error}", device=DEVICE))

    def _read_all(self) -> None:
        """Bytes to frames and replies, until closed or unplugged."""
        while not self._stopping:
            try:
                data = self._transport.read()
            except LostError as error:
                self._fail(error)
                return
            if not data:
                continue
            now = self._clock.now()
            with self._lock:
                for item in self._decoder.feed(data):
                    if isinstance(item, Reply):
                        self._replies.append(item)
                    else:
                        self._take(item, now)
                self._changed.notify_all()

    def _fail(self, error: LostError) -> None:
        with self._lock:
            self._failure = error
            self._changed.notify_all()

    def _take(self, packet: EchoPacket, now: float) -> None:
        if (packet.frame, packet.ticks) in self._recent:
            self._counts.repeated += 1
            return
        self._recent.append((packet.frame, packet.ticks))
        if self._last_frame is not None:
            gap = (packet.frame - self._last_frame - 1) % 2**32
            if gap < _LARGEST_GAP:
                self._counts.lost += gap
            else:
                self._counts.restarts += 1
                self._asked = self._anchor = None
        self._last_frame = packet.frame
        if len(packet.tof_ticks) != self.lines:
            self._counts.short += 1
            return
        if len(self._frames) == self._frames.maxlen:
            self._counts.dropped += 1
        self._counts.received += 1
        silent = packet.tof_ticks == NO_RESPONSE
        seconds = np.where(silent, np.nan, packet.tof_ticks * self._tick_s)
        self._frames.append(
            EchoFrame(**vars(packet), t_host=now, tof_s=seconds, late_s=self._late(packet, now))
        )

    def _late(self, packet: EchoPacket, now: float) -> float:
        """Upper bound of a frame's delay, s; NaN where none was measured."""
        late = float("nan")
        if self._anchor is not None:
            arrived, ticks, before = self._anchor
            late = before + (1 + _DRIFT) * (now - arrived) - (packet.ticks - ticks) * self._tick_s
        if self._asked is not None:
            sent, frame = self._asked
            if (packet.frame - frame) % 2**32 < _LARGEST_GAP:
                self._asked = None
                # Both are upper bounds: take the smaller one.
                if not late <= now - sent:
                    late = now - sent
                self._anchor = now, packet.ticks, late
        return late


def median_of(tof_s: Float[np.ndarray, "frames lines"]) -> Float[np.ndarray, " lines"]:
    """Median time of flight, s; NaN where fewer than half of the frames have one."""
    answered = 2 * np.isfinite(tof_s).sum(axis=0) >= len(tof_s)
    middle = np.full(tof_s.shape[1], np.nan)
    middle[answered] = np.nanmedian(tof_s[:, answered], axis=0)
    return middle
