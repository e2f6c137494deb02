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
import socketserver
import threading
from collections.abc import Callable, Mapping
from typing import Any

LONGEST_LINE = 1 << 20
_POLL_S = 0.05
_TIMEOUT_S = 30.0
"""Wall seconds for connecting and for an answer."""

Handler = Callable[..., object]
"""Takes what stands beside ``do`` in the request, by its names."""


class _Connection(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        assert isinstance(self.server, ControlServer)
        with contextlib.suppress(OSError):
            while (line := self.rfile.readline(LONGEST_LINE)).endswith(b"\n"):
                self.wfile.write(json.dumps(self.server.answer(line)).encode() + b"\n")


class ControlServer(socketserver.ThreadingTCPServer):
    """Answers requests; each connection has a thread.

    Args:
        handlers: by the name under ``do``. A handler's result must fit into JSON; an exception of
            it becomes the error.
    """

    daemon_threads = True

    def __init__(self, handlers: Mapping[str, Handler]) -> None:
        super().__init__(("127.0.0.1", 0), _Connection)
        self._handlers = dict(handlers)
        self.port = int(self.server_address[1])
        self._thread = threading.Thread(
            target=self.serve_forever, args=(_POLL_S,), name="bench control", daemon=True
        )

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def stop(self) -> None:
        """Take no more connections; safe to repeat."""
        if self._thread.is_alive():
            self.shutdown()
        self.server_close()

    def answer(self, line: bytes) -> dict:
        """What a line is answered by."""
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
