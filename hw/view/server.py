"""The viewer's process: messages on standard input, one page on 127.0.0.1.

Started by :class:`hw.view.feed.LiveView`. It prints one JSON line with its address, or with the
reason why there is none, and ends when its standard input ends. It has no connection to any device,
and drops every message from a browser: cameras and panels work in the browser alone. It answers
only requests for this machine's own names, and only its own page: a page of another site, open in
the same browser, could otherwise read the stream.
"""

from __future__ import annotations

import functools
import http.client
import json
import os
import pickle
import sys
from collections.abc import Callable
from contextlib import closing, redirect_stdout, suppress
from typing import Any
from urllib.parse import urlsplit

HOST = "127.0.0.1"
_CURE = "install viser 1.1"
"""The oldest version that pyproject.toml allows, and known to work."""
_OWN_NAMES = (HOST, "localhost")
"""As a browser names this machine, also at the end of an ssh tunnel."""


def main(port: int) -> int:
    """Serve until standard input ends."""
    answers = os.fdopen(os.dup(1), "w")

    def answer(**content: Any) -> None:
        print(json.dumps(content), file=answers, flush=True)

    try:
        import viser
    except ImportError as error:
        answer(error=f"viser cannot be imported ({error})")
        return 2
    # viser looks for OpenCV at every picture, which takes longer than the picture itself.
    sys.modules.setdefault("cv2", None)  # type: ignore[arg-type]
    with redirect_stdout(sys.stderr):
        refuse_strangers()
        try:
            server = viser.ViserServer(host=HOST, port=port, verbose=False)
        except OSError as error:
            answer(error=f"no page on port {port}: {error.strerror or error}")
            return 2
        try:
            ignore_browsers(server)
            check_refusal(server.get_port())
        except NotImplementedError as error:
            answer(error=str(error))
            return 2
        from hw.view.page import Page

        page = Page(server)
        answer(url=f"http://{HOST}:{server.get_port()}")
        answers.close()
        # The end of the pipe, also in the middle of a message.
        with suppress(EOFError, pickle.UnpicklingError):
            while True:
                page.show(*pickle.load(sys.stdin.buffer))
        server.stop()
    return 0


def refuse_strangers() -> None:
    """Have every request checked before viser sees it.

    viser has no option for this; it listens through ``websockets``. :func:`check_refusal` finds a
    version that does not.
    """
    import websockets.asyncio.server as listening

    serve = listening.serve

    @functools.wraps(serve)
    def checked(*arguments: Any, process_request: Callable | None = None, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if not _is_own(request.headers):
                return connection.respond(403, "this page is for its own machine only\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*arguments, process_request=process, **options)

    listening.serve = checked  # type: ignore[misc]


def _is_own(headers: Any) -> bool:
    """Whether a request names this machine, and no page of another site has made it."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    try:
        own = all(urlsplit(f"//{host}").hostname in _OWN_NAMES for host in hosts)
        # Another port of this machine may belong to another program's page.
        return own and all(urlsplit(origin).netloc in hosts for origin in origins)
    except ValueError:
        return False


def check_refusal(port: int) -> None:
    """Check that the page at this port refuses another machine's name.

    Raises:
        NotImplementedError: it does not; do not serve it.
    """
    with closing(http.client.HTTPConnection(HOST, port, timeout=10.0)) as connection:
        connection.request("GET", "/", headers={"Host": "elsewhere"})
        if connection.getresponse().status != 403:
            raise NotImplementedError(f"this version of viser listens in an unknown way: {_CURE}")


def ignore_browsers(server: Any) -> None:
    """Drop what browsers send.

    viser acts on some messages by itself: it would open a tunnel through a public server when a
    page asks for a link to share, and copy a change in one page's panel to all pages.

    Raises:
        NotImplementedError: a version of viser whose messages cannot be dropped; do not serve it.
    """
    # viser has no public way to do this. A version without this method must not be served.
    listener = getattr(server, "_websock_server", None)
    if not callable(getattr(listener, "_handle_incoming_message", None)):
        raise NotImplementedError(
            f"this version of viser handles messages of browsers in an unknown way: {_CURE}"
        )

    async def dropped(client_id: int, message: object) -> None:
        return None

    listener._handle_incoming_message = dropped  # pyright: ignore[reportOptionalMemberAccess]


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
