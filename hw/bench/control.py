"""The control socket of an emulated bench: faults on request, and the truth for tests.

One JSON object a line, in both directions, on a loopback TCP port:

    {"do": "fault", "name": "protective_stop"}        -> {"ok": null}
    {"do": "true_pose"}                                -> {"ok": [[...], ...]}
    {"do": "nonsense"}                                 -> {"error": "..."}
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Callable, Mapping
from typing import Any

LONGEST_LINE = 1 << 20
_MOST_CONNECTIONS = 8
_TIMEOUT_S = 30.0
"""Wall seconds for connecting and for an answer."""

Handler = Callable[..., object]
"""Takes what stands beside ``do`` in the request, by its names."""


class ControlServer:
    """Answers requests; each connection has a thread.

    Args:
        handlers: by the name under ``do``. A handler's result must fit into JSON; an exception of
            it becomes the error.
    """

    def __init__(self, handlers: Mapping[str, Handler]) -> None:
        self._handlers = dict(handlers)
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=_MOST_CONNECTIONS)
        self.port = int(self._listener.getsockname()[1])
        self._slots = threading.BoundedSemaphore(_MOST_CONNECTIONS)
        self._thread = threading.Thread(target=self._accept, name="bench control", daemon=True)

    def start(self) -> ControlServer:
        """Begin to listen."""
        self._thread.start()
        return self

    def stop(self) -> None:
        """Take no more connections."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            if not self._slots.acquire(blocking=False):
                connection.close()
                continue
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("rwb") as stream:
                while True:
                    line = stream.readline(LONGEST_LINE)
                    if not line.endswith(b"\n"):
                        return
                    stream.write(json.dumps(self._answer(line)).encode() + b"\n")
                    stream.flush()
        except OSError:
            pass
        finally:
            self._slots.release()

    def _answer(self, line: bytes) -> dict:
        try:
            request = json.loads(line)
            if not isinstance(request, dict) or request.get("do") not in self._handlers:
                return {"error": f"unknown request; there are: {', '.join(self._handlers)}"}
            return {"ok": self._handlers[request.pop("do")](**request)}
        except Exception as error:
            return {"error": " ".join(f"{type(error).__name__}: {error}".split())}


class ControlClient:
    """Sends requests to a bench.

    Args:
        port: of its control socket on loopback.

    Raises:
        OSError: no bench listens there.
    """

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=_TIMEOUT_S)
        self._stream = self._socket.makefile("rwb")
        self._lock = threading.Lock()

    def ask(self, do: str, **arguments: object) -> Any:
        """One request and its answer.

        Raises:
            RuntimeError: the bench refused, or is gone.
        """
        with self._lock:
            try:
                self._stream.write(json.dumps({"do": do, **arguments}).encode() + b"\n")
                self._stream.flush()
                line = self._stream.readline(LONGEST_LINE * 8)
            except OSError as error:
                raise RuntimeError(f"the bench does not answer: {error}") from None
        if not line.endswith(b"\n"):
            raise RuntimeError("the emulated bench has ended")
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(f"the bench refused: {answer['error']}")
        return answer["ok"]

    def close(self) -> None:
        """Hang up."""
        with contextlib.suppress(OSError):
            self._stream.close()
        self._socket.close()
