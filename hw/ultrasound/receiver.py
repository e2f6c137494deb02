"""The ultrasound machine's stream: images and transforms from an OpenIGTLink server.

A thread receives, checks and decodes. Good images and transforms wait in bounded queues, whose
oldest are dropped for lack of room; images dropped are counted. An image that comes again with the
same time stamp is not a new image (the machine is frozen): it is counted and not handed on.
"""

from __future__ import annotations

import math
import socket
import threading
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from hw.runtime.clock import REAL, Clock, Lag
from hw.runtime.errors import Device, DeviceError, LostError, StaleError
from hw.runtime.hosts import address
from hw.runtime.interrupts import lock_and_condition
from hw.ultrasound.framing import MessageDecoder
from jaxcal.data.poses import ROTATION_TOLERANCE, nearest_rotations
from jaxcal.io.given_files import one_line
from jaxcal.io.message_content import ImageArray, Picture, StatusMessage, Tracked, TrackedFrame
from jaxcal.io.openigtlink import PORT, RF_DEVICE, Message
from jaxcal.runtime.array_types import Float

DEVICE: Device = "ultrasound"

_CONNECT_TIMEOUT_S = 5.0
_POLL_S = 0.05
_CHUNK = 1 << 18
_QUEUE_BYTES = 256 << 20


@dataclass(frozen=True)
class Image:
    """One image of the ultrasound machine.

    Attributes:
        t_host: arrival of its first bytes, s of the bench's clock.
        t_device: the machine's time stamp, s of its own clock; NaN where it sends none.
        frame_id: the message's id, or a count of images where the sender gives no ids.
        array: (height, width) uint8 B-mode, or int16; rows downwards; not writable.
        spacing_mm: [lateral, axial] mm per pixel.
        device: name of the sender's device.
        late_s: how much longer it was on its way than the quickest image, s of the bench's clock,
            by the time stamps; 0 where the machine sends none.
    """

    t_host: float
    t_device: float
    frame_id: int
    array: ImageArray
    spacing_mm: tuple[float, float]
    device: str
    late_s: float = 0.0

    @property
    def prompt_s(self) -> float:
        """When it would have come by a link as quick as for the quickest image, bench s."""
        return self.t_host - self.late_s

    @property
    def is_rf(self) -> bool:
        """Whether this is assumed to be RF channel data: int16 from the device ``RF``."""
        return self.device == RF_DEVICE and self.array.dtype == np.int16


@dataclass(frozen=True)
class Transform:
    """One pose from the stream.

    Attributes:
        t_host: arrival, s of the bench's clock.
        t_device: the sender's time stamp, s; NaN where it sends none.
        name: ``<From>To<To>``, e.g. ``ProbeToTracker``.
        matrix: (4, 4), mm, From -> To, as sent.
        valid: whether it is finite, within 1e-2 of a rigid transform (trackers round), and has the
            status OK where one is sent.
    """

    t_host: float
    t_device: float
    name: str
    matrix: Float[np.ndarray, "4 4"]
    valid: bool


@dataclass
class UltrasoundStatistics:
    """Counts since the connection was made.

    Attributes:
        received: images accepted into the queue.
        lost: images missing in the message ids, where the sender numbers each device's images.
        crc_errors: messages whose CRC was wrong; not handed on.
        resynchronised: how often a message was accepted after something broken.
        dropped: images that a full queue had no room for.
        repeated: images that came again with the same time stamp; not handed on.
        unsupported: intact messages with content that is not taken (``reason`` for the last one).
        other: messages of other types or devices; skipped.
        other_devices: names of devices whose images were skipped, at most 64.
        transforms: accepted.
        reason: why the last unsupported message was not taken.
    """

    received: int = 0
    lost: int = 0
    crc_errors: int = 0
    resynchronised: int = 0
    dropped: int = 0
    repeated: int = 0
    unsupported: int = 0
    other: int = 0
    transforms: int = 0
    reason: str = ""
    other_devices: tuple[str, ...] = ()


class UltrasoundStream:
    """A client of an OpenIGTLink server, from :meth:`start` to :meth:`close`; a context manager.

    Args:
        host: of the server.
        port: 18944 by convention.
        clock: of the bench; time-outs and time stamps are in its seconds.
        queue: most images that wait to be read (and at most 256 MB of them).
        device: only images of this device; None: of all, RF channel data among them.
    """

    def __init__(
        self,
        host: str,
        port: int = PORT,
        *,
        clock: Clock = REAL,
        queue: int = 64,
        device: str | None = None,
    ) -> None:
        if queue < 1:
            raise DeviceError(f"the queue must hold an image at least, not {queue}", device=DEVICE)
        self.host, self.port = host, port
        self._clock, self._capacity, self._device = clock, queue, device
        self._decoder = MessageDecoder()
        self._lock, self._changed = lock_and_condition()
        self._images: deque[Image] = deque()
        self._transforms: deque[Transform] = deque(maxlen=4096)
        self._counts = UltrasoundStatistics()
        self._last: dict[str, tuple[int, float, Lag]] = {}
        self._other_devices: set[str] = set()
        self._failure: LostError | None = None
        self._stopping = False
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """``host:port``."""
        return address(self.host, self.port)

    def start(self) -> UltrasoundStream:
        """Connect and begin to receive.

        Raises:
            DeviceError: no server there.
        """
        if self._thread is not None:
            raise DeviceError(f"{self.address} was started before", device=DEVICE)
        try:
            self._socket = socket.create_connection((self.host, self.port), _CONNECT_TIMEOUT_S)
        except (OSError, UnicodeError) as error:
            raise DeviceError(
                f"no OpenIGTLink server at {self.address} ({one_line(error)})",
                device=DEVICE,
            ) from None
        self._socket.settimeout(_POLL_S)
        self._thread = threading.Thread(target=self._receive, name="ultrasound", daemon=True)
        self._thread.start()
        return self

    def close(self) -> None:
        """Leave the server; safe to repeat."""
        self._stopping = True
        if self._thread is not None:
            self._thread.join()
        if self._socket is not None:
            self._socket.close()

    def __enter__(self) -> UltrasoundStream:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, timeout_s: float) -> Image:
        """The oldest image that waits, or the next that comes.

        Args:
            timeout_s: longest wait, s of the bench's clock.

        Raises:
            StaleError: no new image in time.
            LostError: the connection is gone; images that came before are handed out first.
        """
        with self._lock:
            self._changed.wait_for(
                lambda: self._images or self._failure, self._clock.wall(timeout_s)
            )
            if self._images:
                return self._images.popleft()
            if self._failure is not None:
                raise self._failure
        raise StaleError(
            f"no new image from {self.address} for {timeout_s:g} s: is the machine frozen?",
            device=DEVICE,
        )

    def drain(self) -> list[Image]:
        """All images that wait, oldest first; may be none.

        Raises:
            LostError: the connection is gone and no image waits.
        """
        with self._lock:
            images = list(self._images)
            self._images.clear()
            if not images and self._failure is not None:
                raise self._failure
        return images

    def transforms(self) -> list[Transform]:
        """All transforms since the last call, oldest first; may be none."""
        with self._lock:
            transforms = list(self._transforms)
            self._transforms.clear()
        return transforms

    def statistics(self) -> UltrasoundStatistics:
        """Counts since the connection was made."""
        with self._lock:
            decoder = self._decoder
            return replace(
                self._counts,
                crc_errors=decoder.crc_errors,
                resynchronised=decoder.resynchronised,
                unsupported=decoder.unsupported,
                reason=decoder.reason,
                other_devices=tuple(sorted(self._other_devices)),
            )

    def _receive(self) -> None:
        """The receiver's thread; an unexpected error ends the stream, too, and is told."""
        try:
            self._receive_all()
        except Exception as error:
            self._fail(f"{type(error).__name__}: {error}")

    def _fail(self, reason: str) -> None:
        with self._lock:
            self._failure = LostError(reason, device=DEVICE)
            self._changed.notify_all()

    def _receive_all(self) -> None:
        """Bytes to images, until closed or left by the server."""
        connection = self._socket
        assert connection is not None
        chunk = memoryview(bytearray(_CHUNK))
        while not self._stopping:
            try:
                count = connection.recv_into(chunk)
            except TimeoutError:
                continue
            except OSError:
                count = 0
            if not count:
                self._fail(f"{self.address} has closed the connection")
                return
            now = self._clock.now()
            messages = self._decoder.feed(chunk[:count], now)
            if not messages:
                continue
            with self._lock:
                for message in messages:
                    self._take(message)
                self._changed.notify_all()

    def _take(self, message: Message) -> None:
        match message.content:
            case Picture() if self._device in (None, message.device):
                self._take_image(message, message.content)
            case tuple():
                for tracked in message.content:
                    self._take_transform(message, tracked)
            case TrackedFrame() if self._device in (None, message.device):
                # Transforms before the image, so that they are there when the image is read.
                for tracked in message.content.transforms:
                    self._take_transform(message, tracked)
                self._take_image(message, message.content.picture)
            case StatusMessage():
                pass
            case content:
                self._counts.other += 1
                # A peer may invent devices without end.
                if isinstance(content, Picture | TrackedFrame) and len(self._other_devices) < 64:
                    self._other_devices.add(message.device)

    def _take_image(self, message: Message, picture: Picture) -> None:
        counts = self._counts
        number, stamp, lag = self._last.get(message.device, (0, math.nan, Lag()))
        if message.t_device == stamp:
            counts.repeated += 1
            return
        if message.message_id and 0 < number < message.message_id:
            counts.lost += message.message_id - number - 1
        if message.t_device < stamp:
            lag.set_back(message.t_host, message.t_device)
        self._remember(message, lag)
        counts.received += 1
        late_s = lag.of(message.t_host, message.t_device)
        image = Image(
            t_host=message.t_host,
            t_device=message.t_device,
            frame_id=message.message_id or counts.received,
            array=picture.array,
            spacing_mm=picture.spacing_mm,
            device=message.device,
            late_s=late_s if math.isfinite(late_s) else 0.0,
        )
        self._images.append(image)
        while len(self._images) > self._capacity or (
            len(self._images) > 1 and sum(i.array.nbytes for i in self._images) > _QUEUE_BYTES
        ):
            self._images.popleft()
            counts.dropped += 1

    def _remember(self, message: Message, lag: Lag) -> None:
        """Keep number, time stamp and lag of a device's last image, for at most 64 devices.

        A peer may invent devices without end.
        """
        self._last.pop(message.device, None)
        self._last[message.device] = (message.message_id, message.t_device, lag)
        if len(self._last) > 64:
            del self._last[next(iter(self._last))]

    def _take_transform(self, message: Message, tracked: Tracked) -> None:
        self._counts.transforms += 1
        self._transforms.append(
            Transform(
                message.t_host,
                message.t_device,
                tracked.name,
                tracked.matrix,
                _is_rigid(tracked.matrix) and tracked.status in ("", "OK"),
            )
        )


def _is_rigid(matrix: Float[np.ndarray, "4 4"]) -> bool:
    rotation = matrix[:3, :3]
    if not np.isfinite(matrix).all() or np.abs(rotation).max() > 2:
        return False
    return bool(nearest_rotations(rotation[None])[1][0] <= ROTATION_TOLERANCE)
