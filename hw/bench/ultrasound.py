"""An emulated ultrasound machine: an OpenIGTLink server that renders its own images.

The tests use ``pyigtl`` as an independent server; this one also sends what pyigtl cannot: message
ids, RF channel data, TDATA and STATUS, and on request the faults that streams have. A client that
is too slow loses whole images, never parts of them.
"""

from __future__ import annotations

import selectors
import socket
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from hw.runtime.clock import REAL, Clock
from jaxcal.io.message_content import Content, Picture, StatusMessage, Tracked
from jaxcal.io.openigtlink import HEADER_SIZE, RF_DEVICE, Message, encode

_MOST_CLIENTS = 8
_MOST_PENDING = 16 << 20
_SEND_BUFFER = 1 << 20
_LARGEST_SLIP_S = 0.25
_DEVICE = "Image"
"""Name under which the images are sent."""
_CLOCK_AHEAD_S = 1_000_000.0
"""Time of the machine's own clock less bench time."""


@dataclass(frozen=True)
class ImageFaults:
    """Faults that streams have.

    Attributes:
        stale: nothing is sent, connections open.
        frozen: the last image comes again and again, its time stamp too.
        corrupt: share of the images in which a bit is flipped anywhere, header included.
    """

    stale: bool = False
    frozen: bool = False
    corrupt: float = 0.0


@dataclass
class _Client:
    """A connection and what it has not taken yet."""

    connection: socket.socket
    pending: deque[memoryview] = field(default_factory=deque)
    size: int = 0


class ImageServer:
    """An emulated machine; :meth:`start` it, and connect the real receiver to ``host``, ``port``.

    Args:
        render: time s -> (height, width) uint8 image; called from the server's thread.
        clock: of the bench.
        rate_hz: images per second of the bench's time.
        spacing_mm: [lateral, axial] mm per pixel.
        rf: time s -> (samples, lines) int16, sent after each image as an image of device ``RF``.
        transforms: time s -> {name: (4, 4) mm}, sent before each image: one as TRANSFORM, more of
            them as one TDATA.
        seed: of the faults that come by chance.

    Attributes:
        host: loopback address to connect to.
        port: of it.
        sent: images made for the clients.
        refused: images dropped for clients that were too slow.
    """

    def __init__(
        self,
        render: Callable[[float], np.ndarray],
        *,
        clock: Clock = REAL,
        rate_hz: float = 30.0,
        spacing_mm: tuple[float, float] = (0.1, 0.1),
        rf: Callable[[float], np.ndarray] | None = None,
        transforms: Callable[[float], Mapping[str, np.ndarray]] | None = None,
        seed: int = 0,
    ) -> None:
        self._render, self._rf, self._transforms = render, rf, transforms
        self._clock, self._period_s, self._spacing = clock, 1.0 / rate_hz, spacing_mm
        self._random = np.random.default_rng(seed)
        self._faults = ImageFaults()
        self._stopping = self._dropping = False
        self._clients: dict[int, _Client] = {}
        self._selector = selectors.DefaultSelector()
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=_MOST_CLIENTS)
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="emulated ultrasound", daemon=True)
        self._image: Message | None = None
        self.host, self.port = self._listener.getsockname()
        self.sent = self.refused = 0
        self._numbers: dict[tuple[str, str], int] = {}

    def start(self) -> ImageServer:
        """Begin to listen and to send."""
        self._thread.start()
        return self

    def stop(self) -> None:
        """Close all connections and vanish; safe to repeat."""
        self._stopping = True
        if self._thread.is_alive():
            self._thread.join()
        for client in list(self._clients.values()):
            self._leave(client)
        self._listener.close()
        self._selector.close()

    def __enter__(self) -> ImageServer:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    # Faults

    def fault(self, **changes: float | bool) -> None:
        """Begin or end some faults: attributes of :class:`ImageFaults`, by name."""
        self._faults = replace(self._faults, **changes)

    def drop(self) -> None:
        """Close all connections once; new ones are taken."""
        self._dropping = True

    def recover(self) -> None:
        """No fault any more."""
        self._faults = ImageFaults()

    # The machine

    def _run(self) -> None:
        due = self._clock.now()
        while not self._stopping:
            wait = self._clock.wall(due - self._clock.now())
            # The thread wakes often enough to notice a request to stop.
            for key, _ in self._selector.select(min(max(wait, 0.0), 0.05)):
                if key.fileobj is self._listener:
                    self._welcome()
                else:
                    self._serve(self._clients[key.fd])
            if self._dropping:
                self._dropping = False
                for client in list(self._clients.values()):
                    self._leave(client)
            now = self._clock.now()
            if now < due:
                continue
            # A bench that is too slow for its clock sends fewer images, and none is missing.
            if now - due > _LARGEST_SLIP_S:
                due = now
            if self._clients and not self._faults.stale:
                self._send_all(due)
            due += self._period_s

    def _send_all(self, t: float) -> None:
        if self._transforms is not None and not self._faults.frozen:
            content = tuple(
                Tracked(name, np.asarray(matrix)) for name, matrix in self._transforms(t).items()
            )
            kind = "TRANSFORM" if len(content) == 1 else "TDATA"
            device = content[0].name if len(content) == 1 else "Tracker"
            self._broadcast([encode(self._message(kind, device, t, content))])
        if self._image is None or not self._faults.frozen:
            picture = Picture(np.ascontiguousarray(self._render(t)), self._spacing)
            self._image = self._message("IMAGE", _DEVICE, t, picture)
        data = encode(self._image)
        if self._random.random() < self._faults.corrupt:
            data = self._spoil(data)
        batch = [data]
        if self._rf is not None:
            picture = Picture(np.ascontiguousarray(self._rf(t)), self._spacing)
            batch.append(encode(self._message("IMAGE", RF_DEVICE, t, picture)))
        self.sent += 1
        self._broadcast(batch)

    def _message(self, kind: str, device: str, t: float, content: Content) -> Message:
        number = self._numbers.get((kind, device), 0) + 1
        self._numbers[kind, device] = number
        return Message(kind, device, _CLOCK_AHEAD_S + t, content, message_id=number)

    def _spoil(self, data: bytes) -> bytes:
        spoilt = bytearray(data)
        # Half of the errors go to the header, which chance would hit once in 5000 images.
        end = HEADER_SIZE if self._random.random() < 0.5 else len(data)
        spoilt[int(self._random.integers(end))] ^= 1 << int(self._random.integers(8))
        return bytes(spoilt)

    def _broadcast(self, batch: list[bytes]) -> None:
        size = sum(map(len, batch))
        for client in list(self._clients.values()):
            if client.size + size > _MOST_PENDING:
                self.refused += 1
                continue
            client.pending.extend(map(memoryview, batch))
            client.size += size
            self._serve(client)

    # Connections

    def _welcome(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        if len(self._clients) == _MOST_CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        client = _Client(connection)
        self._clients[connection.fileno()] = client
        self._selector.register(connection, selectors.EVENT_READ)
        hello = self._message(
            "STATUS", _DEVICE, self._clock.now(), StatusMessage(1, 0, "", "ready")
        )
        client.pending.append(memoryview(encode(hello)))
        client.size += len(client.pending[-1])
        self._serve(client)

    def _serve(self, client: _Client) -> None:
        """Send as much as the client takes; what the client sends is ignored."""
        try:
            with suppress(BlockingIOError):
                while client.pending:
                    sent = client.connection.send(client.pending[0])
                    client.size -= sent
                    if sent < len(client.pending[0]):
                        client.pending[0] = client.pending[0][sent:]
                    else:
                        client.pending.popleft()
            with suppress(BlockingIOError):
                if not client.connection.recv(4096):
                    raise ConnectionError
        except OSError:
            self._leave(client)
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.pending else 0)
        self._selector.modify(client.connection, events)

    def _leave(self, client: _Client) -> None:
        self._clients.pop(client.connection.fileno(), None)
        self._selector.unregister(client.connection)
        client.connection.close()
