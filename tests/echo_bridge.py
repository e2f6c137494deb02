"""A link to the active echo element that delays and repeats what it carries."""

from __future__ import annotations

import socket
import threading
import time


class Bridge:
    """A serial-to-network bridge: holds the device's bytes back, and sends packets again."""

    def __init__(self, url: str) -> None:
        host, port = url.removeprefix("socket://").split(":")
        self.delay_s, self.again = 0.0, 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = "socket://{}:{}".format(*self._listener.getsockname())
        self._device = socket.create_connection((host, int(port)))
        self._open = True
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._accept, self._deliver)
        ]
        self._held: list[tuple[float, bytes]] = []
        self._client: socket.socket | None = None
        for thread in self._threads:
            thread.start()

    def _accept(self) -> None:
        try:
            self._client, _ = self._listener.accept()
            while data := self._client.recv(4096):
                self._device.sendall(data)
        except OSError:
            pass

    def _deliver(self) -> None:
        rest = b""
        self._device.settimeout(0.005)
        while self._open:
            try:
                rest += self._device.recv(65536)
            except TimeoutError:
                pass
            except OSError:
                return
            # Frames, and replies while frames come, end in a zero; other replies are lines.
            whole, found, rest = rest.rpartition(b"\0" if b"\0" in rest else b"\n")
            for packet in (whole + found).split(b"\0")[:-1] if found == b"\0" else [whole + found]:
                end = b"\0" if found == b"\0" else b""
                copies = 1 + (self.again if len(packet) > 40 else 0)
                self._held += [(time.monotonic() + self.delay_s, packet + end)] * copies
            while self._held and self._client and self._held[0][0] <= time.monotonic():
                try:
                    self._client.sendall(self._held.pop(0)[1])
                except OSError:
                    return

    def close(self) -> None:
        self._open = False
        for one in (self._listener, self._device, self._client):
            if one is not None:
                one.close()
        for thread in self._threads:
            thread.join(5.0)
