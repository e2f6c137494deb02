"""Names of hosts."""

from __future__ import annotations

from jaxcal import InputError
from jaxcal.runtime.messages import quoted


def address(host: str, port: int) -> str:
    """``host:port`` as the command line takes it: IPv6 in brackets, ``[::1]:18944``."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def check_host(host: str, what: str = "host") -> None:
    """Refuse text that cannot be the name or address of a computer, before anything connects.

    Args:
        host: the name or address.
        what: how an error names it.

    Raises:
        InputError: empty, with an empty or too long part, or with spaces or control characters.
    """
    try:
        good = bool(host.encode("idna")) and host.isprintable() and " " not in host
    except UnicodeError:
        good = False
    if not good:
        raise InputError(f"{what} {quoted(host)} is not the name or address of a computer")
