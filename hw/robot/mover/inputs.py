"""Everything that comes in (requests and packets), and the latch of a stop.

A stop cannot be lost: each line of input is handled as soon as it is read, whatever the process
waits for. A request to stop is latched at once; a request to move waits in a queue. Only a
hesitation whose move was already answered is ignored.
"""

from __future__ import annotations

import math
import select
from collections import deque
from dataclasses import dataclass

from hw.robot.mover.messages import WATCHDOG, Caller
from hw.robot.rtde import Packet, PacketReader, PendantSettings
from hw.robot.stream import PoseSample, offset_changed
from hw.runtime.clock import Clock, Lag
from hw.runtime.errors import DeviceError, LostError, StaleError, StoppedError, refused


@dataclass(frozen=True)
class Stop:
    """Why the robot must stop, and whether the stop ends motion for good."""

    error: DeviceError
    for_good: bool


class Ended(Exception):
    """The motion is over for good: the connection, the program or the robot's state is gone."""

    def __init__(self, cause: DeviceError) -> None:
        self.cause = cause


class StopLatch:
    """Keeps the first stop; a stop for good replaces a hesitation.

    The handler of a signal may set one for good between any two instructions of another call, so
    nothing that is done about a hesitation touches what such a stop sets.
    """

    def __init__(self) -> None:
        self._hesitation: Stop | None = None
        self._for_good: Stop | None = None

    @property
    def stop(self) -> Stop | None:
        """The stop that is latched."""
        return self._for_good or self._hesitation

    def set(self, stop: Stop) -> None:
        """Latch a stop."""
        if stop.for_good:
            self._for_good = self._for_good or stop
        else:
            self._hesitation = self._hesitation or stop

    def release(self) -> None:
        """Forget a hesitation, once the robot rests; a stop for good is never released."""
        self._hesitation = None


class Inputs:
    """What has come, and the latch that a stop among it sets.

    Args:
        caller: sends requests.
        clock: bench time.
    """

    def __init__(self, caller: Caller, clock: Clock) -> None:
        self._caller, self._clock = caller, clock
        self._reader: PacketReader | None = None
        self._lag = Lag()
        self._packet: Packet | None = None
        self._sample: PoseSample | None = None
        self._unseen: list[Packet] = []
        self.pendant: PendantSettings | None = None
        """The newest settings at the pendant."""
        self.latch = StopLatch()
        self.moves: deque[dict] = deque()
        """Requests to move that wait."""
        self.answered = 0
        """Number of the newest request to move that was answered."""
        self.heard_s = -math.inf
        """Bench time of the caller's last sign of life."""
        self.tcp_offset: tuple[float, ...] | None = None
        """Of the controller (m, rad); None where it was not told."""
        self.program_started = False
        """Whether our program has run; from then on a packet without a program means its end."""
        self.program_ended = False
        """Whether our program has ended, whatever runs now."""
        for request in caller.read_so_far():
            self._take_request(request)

    def attach(self, reader: PacketReader, lag: Lag) -> None:
        """Take the controller's packets from now on."""
        self._reader, self._lag = reader, lag

    @property
    def left(self) -> bool:
        """Whether the caller is gone or going."""
        return self._caller.left

    @property
    def connected(self) -> bool:
        """Whether a packet has come."""
        return self._packet is not None

    @property
    def packet(self) -> Packet:
        """The newest packet."""
        assert self._packet is not None
        return self._packet

    @property
    def sample(self) -> PoseSample:
        """The newest pose."""
        assert self._sample is not None
        return self._sample

    def unseen(self) -> list[Packet]:
        """Packets since the last call, in order; the newest one if none has come."""
        packets, self._unseen = self._unseen, []
        return packets or [self.packet]

    def read(self, timeout_s: float) -> None:
        """Wait for any input, and handle everything that has come.

        Raises:
            Ended: the connection to the controller is lost.
        """
        assert self._reader is not None
        sources: list[PacketReader | Caller] = [self._reader]
        if not self._caller.left:
            sources.append(self._caller)
        ready = select.select(sources, [], [], timeout_s)[0]
        if self._reader in ready:
            try:
                packets = self._reader.read()
            except LostError as error:
                raise Ended(lost(error.args[0])) from None
            for packet in packets:
                self._take_packet(packet)
        if self._caller in ready:
            for request in self._caller.read():
                self._take_request(request)

    def _take_packet(self, packet: Packet) -> None:
        self._packet = packet
        self._unseen.append(packet)
        # In every packet: the newest one may already tell of another program.
        self.program_ended |= self.program_started and not packet.program
        self._sample = PoseSample.of(packet, self._clock, self._lag)
        changed = "" if self.pendant is None else self.pendant.changed(packet.pendant)
        if changed:
            self._refuse(f"changed at the pendant: {changed}")
        self.pendant = packet.pendant
        if packet.tcp_offset is not None:
            if self.tcp_offset is not None and offset_changed(self.tcp_offset, packet.tcp_offset):
                self._refuse("the controller's TCP offset was changed")
            self.tcp_offset = packet.tcp_offset

    def _refuse(self, text: str) -> None:
        self.latch.set(Stop(refused(text), True))

    def _take_request(self, request: dict) -> None:
        match request["request"]:
            case "move":
                self.moves.append(request)
            case "stop":
                kind = StaleError if request["kind"] == StaleError.__name__ else StoppedError
                hesitation = kind is StaleError
                # A hesitation is about one move: once that is answered, there is nothing to stop.
                if not hesitation or request["move"] > self.answered:
                    self.latch.set(Stop(kind(request["text"], device="robot"), not hesitation))
            case "heard":
                self.heard_s = self._clock.now()
            case "close":
                self._caller.closed = True


def lost(what: str) -> LostError:
    """The error of a connection or a program that is gone."""
    return LostError(f"{what}; {WATCHDOG}", device="robot")
