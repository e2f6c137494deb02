"""The page on which a person places points, for this machine and this person only.

It listens on 127.0.0.1. Every address begins with a token of 128 random bits, so that other users
of the machine cannot open it. Requests under another host's name (DNS rebinding) or from another
page (Origin) are refused, and the page may load nothing but itself (Content-Security-Policy).
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
import threading
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socketserver import TCPServer
from typing import Any

from jaxcal import CalibrationError, InputError
from jaxcal.io.given_files import one_line
from jaxcal.io.picker.frames import Frames
from jaxcal.io.picker.picks import Picks

HOST = "127.0.0.1"
_LARGEST_BODY = 4096
_SILENCE_S = 20.0
"""A connection that says nothing for so long is closed."""
_PAGE = {
    "": ("picker.html", "text/html"),
    "picker.css": ("picker.css", "text/css"),
    "picker.js": ("picker.js", "text/javascript"),
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Picker:
    """Serves the page until it is told that the person is done; a context manager.

    Args:
        picks: where points go.
        frames: what is shown.
        name: of the sequence.
        port: 0 takes a free one.

    Attributes:
        url: of the page, with its token.

    Raises:
        InputError: the port cannot be listened at.
    """

    def __init__(self, picks: Picks, frames: Frames, name: str, port: int = 0) -> None:
        self.picks, self.frames, self.name = picks, frames, name
        self.lock = threading.Lock()
        self._token = secrets.token_urlsafe(16)
        self._done = threading.Event()
        picker = self

        class Handler(_Handler):
            page = picker

        try:
            self._server = _Server((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"cannot listen at {HOST}:{port}: {one_line(error)}") from None
        self.port = int(self._server.server_address[1])
        self.url = f"http://{HOST}:{self.port}/{self._token}/"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)

    def __enter__(self) -> Picker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the person is done; returns whether they are."""
        return self._done.wait(timeout_s)

    def may(self, path: str) -> str | None:
        """The part of a path after the token; None without the right token."""
        token, _, rest = path.removeprefix("/").partition("/")
        known = hmac.compare_digest(token.encode(), self._token.encode())
        return rest if known and path == f"/{token}/{rest}" else None

    def state(self) -> dict[str, Any]:
        """What the page must know, as JSON."""
        picks = self.picks
        return {
            "name": self.name,
            "size": picks.size,
            "shown": picks.shown,
            "files": [picks.files[frame] for frame in picks.shown] if picks.files else [],
            "points": {str(frame): point for frame, point in picks.points.items()},
            "skipped": sorted(picks.skipped),
            "next": next(iter(picks.left), None),
        }

    def do(self, what: str, asked: dict[str, Any]) -> dict[str, Any]:
        """Carry out a click or a key.

        Raises:
            InputError: what cannot be done.
            OutputError: the table of points cannot be written.
        """
        with self.lock:
            undone = None
            match what:
                case "pick":
                    self.picks.pick(_frame(asked), _number(asked, "u"), _number(asked, "v"))
                case "skip":
                    self.picks.skip(_frame(asked))
                case "undo":
                    undone = self.picks.undo()
                case "finish":
                    self._done.set()
                case _:
                    raise InputError("no such request")
            return {**self.state(), "undone": undone}


class _Server(ThreadingHTTPServer):
    """One thread a connection; unlike the library, no look-up of the host's name, no tracebacks."""

    daemon_threads = True

    def server_bind(self) -> None:
        """Bind without asking a name server for this host's name."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, int(self.server_address[1])

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a connection that broke off."""


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    page: Picker
    protocol_version = "HTTP/1.1"
    timeout = _SILENCE_S
    server_version, sys_version = "jaxcal", ""

    def do_GET(self) -> None:
        """Send the page, its state, or a frame."""
        rest = self._allowed()
        if rest is None:
            return
        if rest in _PAGE:
            name, kind = _PAGE[rest]
            self._answer(files("jaxcal.io.picker").joinpath(name).read_bytes(), kind)
        elif rest == "state":
            with self.page.lock:
                self._json(self.page.state())
        else:
            self._send_frame(rest)

    def do_POST(self) -> None:
        """A click or a key."""
        rest = self._allowed()
        if rest is None:
            return
        try:
            length = int(self.headers.get("Content-Length", ""))
        except ValueError:
            length = -1
        if not 0 <= length <= _LARGEST_BODY:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            return
        body = self.rfile.read(length)
        try:
            asked = json.loads(body or b"{}")
            if not isinstance(asked, dict):
                raise ValueError
        except (ValueError, RecursionError):
            self._refuse(HTTPStatus.BAD_REQUEST)
            return
        try:
            self._json(self.page.do(rest, asked))
        except CalibrationError as error:
            self._json({"error": str(error)}, HTTPStatus.BAD_REQUEST)

    def _send_frame(self, rest: str) -> None:
        found = re.fullmatch(r"frame/([0-9]{1,9})\.png", rest)
        if found is None or int(found[1]) not in self.page.picks.shown:
            self._refuse(HTTPStatus.NOT_FOUND)
            return
        try:
            self._answer(self.page.frames.png(int(found[1])), "image/png")
        except CalibrationError as error:
            self._json({"error": str(error)}, HTTPStatus.INTERNAL_SERVER_ERROR)

    def _allowed(self) -> str | None:
        """The requested path, if token, host and origin are right; None if it was refused."""
        names = [f"{HOST}:{self.page.port}", f"localhost:{self.page.port}"]
        origin = self.headers.get("Origin")
        rest = self.page.may(self.path)
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1 or hosts[0] not in names or rest is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        elif origin is not None and origin not in [f"http://{name}" for name in names]:
            self.send_error(HTTPStatus.FORBIDDEN)
        else:
            return rest
        return None

    def _json(self, content: dict[str, Any], status: HTTPStatus = HTTPStatus.OK) -> None:
        self._answer(json.dumps(content, allow_nan=False).encode(), "application/json", status)

    def _refuse(self, status: HTTPStatus) -> None:
        self._answer(status.phrase.encode(), "text/plain", status)

    def _answer(self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        # A page that was closed meanwhile takes no answer.
        with suppress(OSError):
            self.send_response(status)
            charset = "; charset=utf-8" if kind.startswith("text/") else ""
            self.send_header("Content-Type", kind + charset)
            self.send_header("Content-Length", str(len(content)))
            for name, value in _HEADERS.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse a request without the library's own error page, and close the connection."""
        self.close_connection = True
        self._refuse(HTTPStatus(code))

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: the terminal belongs to the person."""


def _frame(asked: dict[str, Any]) -> int:
    frame = asked.get("frame")
    if not isinstance(frame, int) or isinstance(frame, bool):
        raise InputError("a frame is a whole number")
    return frame


def _number(asked: dict[str, Any], name: str) -> float:
    value = asked.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool) or abs(value) > 1e9:
        raise InputError(f"{name} is not a number")
    return float(value)
