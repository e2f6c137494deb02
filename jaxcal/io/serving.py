"""A calibration served over OpenIGTLink, for Slicer: TRANSFORM messages to every client."""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections.abc import Callable

import numpy as np

from jaxcal import InputError
from jaxcal.io.given_files import one_line
from jaxcal.io.message_content import Tracked
from jaxcal.io.openigtlink import Message, encode
from jaxcal.runtime.array_types import Float

MOST_CLIENTS = 32
_LONGEST_NAME = 20
_LONGEST_WAIT_S = 60.0
"""Longer periods are waited for in parts; the system refuses to wait for years."""


class TransformServer:
    """Sends a transform to whoever connects, at once and then again and again; a context manager.

    A client is disconnected if it reads nothing for so long that the system's buffer is full. What
    clients send is discarded.

    Args:
        name: device name, for instance ``ImageToProbe``; at most 20 bytes.
        matrix: (4, 4), mm; sent as it is, row by row becoming column by column, in float32.
        host: address to listen at; other machines can connect only to one in their network.
        port: 0 takes a free one.

    Raises:
        InputError: a name that is too long, a matrix that is not finite, or an address or port that
            cannot be listened at.
    """

    def __init__(
        self, name: str, matrix: Float[np.ndarray, "4 4"], host: str = "127.0.0.1", port: int = 0
    ) -> None:
        if not 0 < len(name.encode(errors="replace")) <= _LONGEST_NAME or not name.isprintable():
            raise InputError(
                f"{name!r}: a device's name has 1 to {_LONGEST_NAME} bytes of text (--name)"
            )
        if not np.isfinite(matrix).all():
            raise InputError("the matrix holds NaN or Inf")
        if not host:
            # The system would take it for every address that this machine has.
            raise InputError("an address to listen at is needed, not an empty one")
        self._name, self._matrix = name, np.asarray(matrix, dtype=np.float64)
        self._clients: set[socket.socket] = set()
        self._listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind((host, port))
            self._listener.listen()
        # A TypeError: a name that no network has, not in Unicode or with too long a part.
        except (OSError, OverflowError, TypeError) as error:
            self._listener.close()
            raise InputError(f"cannot listen at {host}:{port}: {one_line(error)}") from None
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)

    def __enter__(self) -> TransformServer:
        return self

    def __exit__(self, *_: object) -> None:
        for client in list(self._clients):
            self._drop(client)
        self._selector.close()
        self._listener.close()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._listener.getsockname()[1])

    def serve(self, period_s: float, stopped: Callable[[], bool] = lambda: False) -> None:
        """Send every ``period_s`` until ``stopped``, which is asked once a period and a minute."""
        due = time.monotonic()
        while not stopped():
            left = min(max(0.0, due - time.monotonic()), _LONGEST_WAIT_S)
            for key, _ in self._selector.select(left):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._listen_to(key.fileobj)  # pyright: ignore[reportArgumentType]
            if time.monotonic() >= due:
                for client in list(self._clients):
                    self._send(client)
                due = time.monotonic() + period_s

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:
            return
        if len(self._clients) >= MOST_CLIENTS:
            client.close()
            return
        client.setblocking(False)
        self._clients.add(client)
        self._selector.register(client, selectors.EVENT_READ)
        self._send(client)

    def _listen_to(self, client: socket.socket) -> None:
        try:
            if client.recv(65536):
                return
        except BlockingIOError:
            return
        except OSError:
            pass
        self._drop(client)

    def _send(self, client: socket.socket) -> None:
        content = (Tracked(self._name, self._matrix),)
        message = encode(Message("TRANSFORM", self._name, time.time(), content))
        try:
            sent = client.send(message)
        except OSError:
            sent = -1
        # After a part of a message a client could not find the beginning of the next one.
        if sent != len(message):
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        self._clients.discard(client)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(client)
        client.close()
