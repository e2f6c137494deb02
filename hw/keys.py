"""Keys of the person at the terminal: Enter holds the acquisition, and lets it go on."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from hw.acquire import Pause


@contextmanager
def watch_keys(pause: Pause) -> Iterator[None]:
    """Let Enter hold an acquisition before its next image; without a terminal nothing listens."""
    if sys.stdin is None or not sys.stdin.isatty():
        yield
        return
    done = threading.Event()

    def listen() -> None:
        for _ in sys.stdin:
            if done.is_set():
                return
            if pause.held:
                pause.go_on()
            else:
                pause.hold()
                click.echo("paused after this image; Enter goes on", err=True)

    threading.Thread(target=listen, daemon=True, name="keys").start()
    click.echo("Enter pauses, Ctrl-C stops the robot and ends", err=True)
    try:
        yield
    finally:
        done.set()
        pause.go_on()
