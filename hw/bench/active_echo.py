"""Emulated active-echo electronics: our line protocol on a pty (or a TCP port).

A function of time and threshold, called once a frame, says what the element hears. The rest is the
emulated device: command interpreter, counters, frames at the ultrasound machine's rate, and on
request the faults that benches have.
"""

from __future__ import annotations

import select
import tempfile
import threading
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from string import hexdigits
from typing import Literal

import numpy as np

from hw.active_echo.codec import (
    MAXIMUM_LINES,
    MAXIMUM_THRESHOLD,
    NO_RESPONSE,
    EchoPacket,
    decode_line,
    encode_echo,
    encode_line,
    encode_reply,
)
from hw.bench.link import Link, PtyLink, TcpLink
from hw.runtime.clock import REAL, Clock

Echo = Callable[[float, int], tuple[np.ndarray, np.ndarray]]
"""(time s, threshold) -> time of flight (lines,) s with NaN for no response, amplitude (lines,)."""

_LARGEST_SLIP_S = 0.25
_LONGEST_COMMAND = 2 * MAXIMUM_LINES + 64


@dataclass(frozen=True)
class Injection:
    """How the element answers a received pulse.

    Attributes:
        on: whether it answers.
        delay_ticks: between the pulse and the answer.
        pattern: a level (0 to 255) for each line.
    """

    on: bool = False
    delay_ticks: int = 0
    pattern: bytes = b""


@dataclass(frozen=True)
class EchoFaults:
    """Faults that benches have.

    Attributes:
        crc_errors: share of the frames in which a bit is flipped.
        missed_triggers: share of the frame triggers that are missed: the counter goes on, the frame
            does not come.
        missed_lines: share of the frames in which a line trigger is missed.
        stale: no frame triggers: commands are answered, frames do not come.
        mute: nothing is said at all, port open.
        clock: its counter runs so many times as fast as it says.
    """

    crc_errors: float = 0.0
    missed_triggers: float = 0.0
    missed_lines: float = 0.0
    stale: bool = False
    mute: bool = False
    clock: float = 1.0


class AuspisEmulator:
    """An emulated device; :meth:`start` it, and open its ``path`` with the real driver.

    Args:
        echo: what is heard; called from the emulator's thread.
        clock: of the bench.
        rate_hz: frames per second of the bench's time.
        lines: that the probe fires a frame; ``echo`` must return as many.
        clock_hz: of the device's counter.
        link: ``pty``, or ``tcp`` for ``socket://``.
        first_frame: frame counter at power-up.
        seed: of the faults that come by chance.

    Attributes:
        path: what to open, a path or ``socket://host:port``.
        threshold: in force, counts.
        injection: what the element answers with; replaced as a whole.
        sent: frames put on the line.
        refused: frames dropped because the line's buffer was full.
    """

    def __init__(
        self,
        echo: Echo,
        *,
        clock: Clock = REAL,
        rate_hz: float = 30.0,
        lines: int = 128,
        clock_hz: float = 100e6,
        link: Literal["pty", "tcp"] = "pty",
        first_frame: int = 0,
        seed: int = 0,
    ) -> None:
        self._echo, self._clock, self._lines = echo, clock, lines
        self._period_s, self._clock_hz = 1.0 / rate_hz, clock_hz
        self._random = np.random.default_rng(seed)
        self._folder = None
        if link == "pty":
            self._folder = tempfile.TemporaryDirectory(prefix="jaxcal-bench-")
            self._link: Link = PtyLink(Path(self._folder.name) / "active_echo")
        else:
            self._link = TcpLink()
        self._inbox = bytearray()
        self._errors: deque[str] = deque(maxlen=16)
        self._faults = EchoFaults()
        self.threshold = 0
        self._streaming = False
        self._first_frame = first_frame
        self._frames, self._line_triggers = first_frame, 0
        self._unplug = False
        self._plugged = True
        self._thread = self._new_thread()
        self.path = self._link.url
        self.identity = "jaxcal,active-echo emulator,SN0001,1.0"
        self.injection = Injection()
        self.sent = 0
        self.refused = 0

    def start(self) -> AuspisEmulator:
        """Begin to listen."""
        self._thread.start()
        return self

    def stop(self) -> None:
        """Vanish for good; safe to repeat."""
        self._unplug = True
        if self._thread.is_alive():
            self._thread.join()
        if self._plugged:
            self._link.close()
            self._plugged = False
        if self._folder is not None:
            self._folder.cleanup()

    def __enter__(self) -> AuspisEmulator:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    # Faults

    def fault(self, **changes: float | bool) -> None:
        """Begin or end some faults: attributes of :class:`EchoFaults`, by name."""
        self._faults = replace(self._faults, **changes)

    def restart_counter(self) -> None:
        """Count frame triggers from zero again."""
        self._frames = 0

    def unplug(self) -> None:
        """Vanish, in the middle of whatever it is."""
        self._unplug = True
        self._thread.join()

    def replug(self) -> None:
        """Come back at the same path, as after power-up: no faults, counters as at the start."""
        self.unplug()
        if self._folder is not None:
            self._link = PtyLink(Path(self.path))
        else:
            host, port = self.path.removeprefix("socket://").split(":")
            self._link = TcpLink(host, int(port))
        self._faults, self.injection = EchoFaults(), Injection()
        self.threshold, self._streaming = 0, False
        self._frames, self._line_triggers = self._first_frame, 0
        self._inbox.clear()
        self._unplug, self._plugged = False, True
        self._thread = self._new_thread()
        self._thread.start()

    def recover(self) -> None:
        """End all faults, except that an unplugged port stays unplugged."""
        self._faults = EchoFaults()

    # The device

    def _new_thread(self) -> threading.Thread:
        return threading.Thread(target=self._run, name="emulated active echo", daemon=True)

    def _run(self) -> None:
        due = self._clock.now()
        while not self._unplug:
            # The thread wakes often enough to notice a request to stop.
            wait = self._clock.wall(due - self._clock.now())
            # A client that is new on a full line must get the answer behind what waits there.
            waiting = [self._link] if self._link.waits else []
            ready, free, _ = select.select([self._link], waiting, [], min(max(wait, 0.0), 0.05))
            if free:
                self._link.flush()
            if ready:
                self._listen()
            now = self._clock.now()
            if now < due:
                continue
            # The ultrasound machine goes on to trigger, whether frames are sent or not. A bench
            # that is too slow for its clock is delayed; it does not count triggers as missed.
            if now - due > _LARGEST_SLIP_S:
                due = now
            self._trigger(due)
            due += self._period_s
        self._link.close()
        self._plugged = False

    def _trigger(self, t: float) -> None:
        faults = self._faults
        if faults.stale:
            return
        frame = self._frames
        self._frames += 1
        lines = self._lines - (self._random.random() < faults.missed_lines)
        self._line_triggers += lines
        if not self._streaming or faults.mute or self._random.random() < faults.missed_triggers:
            return
        seconds, amplitude = self._echo(t, self.threshold)
        clock_hz = self._clock_hz * faults.clock
        packet = EchoPacket(
            frame=frame % 2**32,
            ticks=int(t * clock_hz) % 2**64,
            threshold=self.threshold,
            tof_ticks=to_ticks(seconds, clock_hz)[:lines],
            amplitude=np.clip(np.nan_to_num(np.rint(amplitude)), 0, 0xFFFF).astype(np.uint16)[
                :lines
            ],
        )
        data = bytearray(encode_echo(packet))
        if self._random.random() < faults.crc_errors:
            place = int(self._random.integers(1, len(data) - 1))
            data[place] ^= 1 << int(self._random.integers(8))
        if self._link.write(bytes(data)):
            self.sent += 1
        else:
            self.refused += 1

    def _listen(self) -> None:
        self._inbox += self._link.read()
        while (end := self._inbox.find(b"\n")) >= 0:
            line = bytes(self._inbox[:end])
            del self._inbox[: end + 1]
            if line and not self._faults.mute:
                self._obey(line)
        if len(self._inbox) > _LONGEST_COMMAND:
            self._inbox.clear()
            self._errors.append("1,command too long")

    def _obey(self, line: bytes) -> None:
        text, checked = decode_line(line)
        word, _, argument = text.strip().partition(" ")
        word = word.upper()
        if checked is False:
            self._errors.append("2,CRC of a command")
            return
        if not (word.isascii() and word.isprintable()) or len(word) > 16:
            self._errors.append("3,unknown command")
            return
        streaming = self._streaming
        answer = self._answer(word, argument.strip())
        if answer.startswith("ERR "):
            self._errors.append(answer[4:])
        reply = f"{word} {answer}"
        self._link.write(encode_reply(reply) if streaming else encode_line(reply))

    def _answer(self, word: str, argument: str) -> str:
        match word:
            case "*IDN?":
                return self.identity
            case "SYST:ERR?":
                return self._errors.popleft() if self._errors else "0,none"
            case "CLK?":
                return f"{self._clock_hz:.0f}"
            case "THR?":
                return str(self.threshold)
            case "TRIG:COUN?":
                return f"{self._line_triggers},{self._frames}"
            case "THR" if _within(argument, MAXIMUM_THRESHOLD):
                self.threshold = int(argument)
                return argument
            case "INJ:DEL" if _within(argument, 0xFFFF):
                self.injection = replace(self.injection, delay_ticks=int(argument))
                return argument
            case "PATT:LOAD" if len(argument) == 2 * self._lines and set(argument) <= set(
                hexdigits
            ):
                pattern = bytes.fromhex(argument)
                self.injection = replace(self.injection, pattern=pattern)
                return f"{zlib.crc32(pattern):08x}"
            case "PATT:STAT" if argument in ("ON", "OFF"):
                self.injection = replace(self.injection, on=argument == "ON")
                return argument
            case "STRM" if argument in ("ON", "OFF"):
                self._streaming = argument == "ON"
                return argument
            case "THR" | "INJ:DEL" | "PATT:LOAD" | "PATT:STAT" | "STRM":
                return "ERR 4,value out of range"
        return "ERR 3,unknown command"


def to_ticks(seconds: np.ndarray, clock_hz: float) -> np.ndarray:
    """Times of flight (s, NaN for no response) as the counter shows them: whole ticks, uint16."""
    ticks = np.floor(np.asarray(seconds, float) * clock_hz)
    heard = np.isfinite(ticks) & (ticks >= 0) & (ticks < NO_RESPONSE)
    return np.where(heard, ticks, NO_RESPONSE).astype(np.uint16)


def _within(text: str, largest: int) -> bool:
    return text.isdecimal() and text.isascii() and len(text) < 6 and int(text) <= largest
