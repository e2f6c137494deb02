"""Files of compiled programs in the user's own cache folder.

An entry is machine code: whoever can write one runs code as its user. So the folder and every entry
must belong to this user alone (our uid, nothing for group and others, no symbolic links), and what
does not is not read. The SHA-256 in an entry finds damage, such as a truncated file. It is no
defence against somebody who can write to the folder: that person is the user or root, could also
read any key kept there, and has shorter ways to run code. Nothing is unpickled.

Entries are complete or absent: a temporary file is renamed when it is written. The least recently
used are removed if all together exceed :data:`LIMIT_BYTES`. If nothing can be written (read-only
home, full disk), nothing is kept, and callers notice only the time that compiling takes.
``JAXCAL_NO_CACHE=1`` turns reading and writing off.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import secrets
import stat
import struct
import sys
import time
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SWITCH = "JAXCAL_NO_CACHE"
"""Environment variable; any value but 0 or an empty one turns the cache off."""

LIMIT_BYTES = 512 * 2**20
"""Largest size of all entries together; beyond it the least recently used are removed."""

MAGIC = b"jaxcal\x00\x01"
"""First bytes of an entry; the last of them is the version of the layout."""

SUFFIX = ".program"
PARTIAL = ".partial-"
STALE_S = 3600.0
"""Age at which a temporary file's writer is taken for dead, s."""

_DIGEST_BYTES = 32
_LENGTH = struct.Struct(">I")
_log = logging.getLogger(__name__)


class UntrustedProgramError(Exception):
    """An entry that must not be used; the message says why."""


@dataclass(frozen=True)
class Entry:
    """One file of the cache.

    Attributes:
        path: where it lies.
        size: on the disk, bytes.
        used: when it was last used, s since the epoch.
        header: what the program is; empty if the entry would be refused.
    """

    path: Path
    size: int
    used: float
    header: dict[str, Any]


def is_on() -> bool:
    """Whether the environment allows the cache."""
    return os.environ.get(SWITCH, "0") in ("", "0")


def private_folder(name: str = "programs") -> Path:
    """A folder of this user's cache, made where it is missing.

    It lies in the folder ``jaxcal`` of ``$XDG_CACHE_HOME``, else of ``~/Library/Caches`` on a Mac,
    ``%LOCALAPPDATA%`` on Windows and ``~/.cache`` elsewhere.

    Args:
        name: of the folder within it.

    Raises:
        OSError: it cannot be made, or is not this user's alone.
        RuntimeError: this user has no home.
    """
    base = _base()
    base.mkdir(parents=True, exist_ok=True)
    folder = base / "jaxcal" / name
    for place in (folder.parent, folder):
        with suppress(FileExistsError):
            place.mkdir(mode=0o700)
        found = place.lstat()
        if not stat.S_ISDIR(found.st_mode):
            raise NotADirectoryError(place)
        if not _is_private(found):
            raise PermissionError(f"{place} is not private to this user")
    return folder


def _base() -> Path:
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if given.is_absolute():  # the XDG specification: relative paths are to be ignored
        return given
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    if os.name == "nt" and "LOCALAPPDATA" in os.environ:
        return Path(os.environ["LOCALAPPDATA"])
    return Path.home() / ".cache"


def read(key: str) -> tuple[dict[str, Any], bytes] | None:
    """The entry of a key: its header and its program; None if there is none that can be trusted."""
    if not is_on():
        return None
    try:
        path = private_folder() / _name(key)
        content = _content(path)
        header, body = _parsed(content)
        if header.get("key") != key:
            raise UntrustedProgramError("it is the program of another key")
        program = zlib.decompress(body)
    except FileNotFoundError:
        return None
    except (UntrustedProgramError, OSError, RuntimeError, zlib.error) as error:
        _log.debug("a compiled program in the cache is not used: %s", error)
        return None
    with suppress(OSError):  # the least recently used are removed first
        os.utime(path)
    return header, program


def write(key: str, header: dict[str, Any], program: bytes) -> bool:
    """Keep a program under a key.

    Args:
        key: as for :func:`read`.
        header: what JSON can hold; what the program is, for people and for the caller.
        program: the executable.

    Returns:
        Whether it is on the disk now.
    """
    if not is_on():
        return False
    described = json.dumps(header | {"key": key}).encode()
    rest = _LENGTH.pack(len(described)) + described + zlib.compress(program, 1)
    temporary = None
    try:
        folder = private_folder()
        temporary = folder / f"{PARTIAL}{secrets.token_hex(8)}"
        with open(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as file:
            file.write(MAGIC + hashlib.sha256(rest).digest() + rest)
        # No flush to the disk: what a power cut leaves half written fails its digest.
        os.replace(temporary, folder / _name(key))
        _shrink(folder)
    except (OSError, RuntimeError) as error:
        _log.debug("a compiled program is not kept: %s", error)
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()
        return False
    return True


def entries() -> list[Entry]:
    """All entries, the most recently used first.

    Raises:
        OSError: the folder is not to be trusted or cannot be read.
    """
    found = []
    for path in private_folder().glob(f"*{SUFFIX}"):
        with suppress(FileNotFoundError):
            status = path.lstat()
            try:
                header = _parsed(_content(path))[0]
            except (UntrustedProgramError, OSError):
                header = {}
            found.append(Entry(path, status.st_size, status.st_mtime, header))
    return sorted(found, key=lambda entry: -entry.used)


def clear() -> int:
    """Remove every entry, and what dead processes left.

    Returns:
        How many entries there were.

    Raises:
        OSError: the folder is not to be trusted or cannot be written.
    """
    removed = 0
    for path in private_folder().iterdir():
        if path.name.endswith(SUFFIX) or path.name.startswith(PARTIAL):
            path.unlink(missing_ok=True)
            removed += path.name.endswith(SUFFIX)
    return removed


def _is_private(found: os.stat_result) -> bool:
    """Whether a folder or file belongs to this user alone."""
    # Windows keeps its profile folders private by other means.
    return os.name != "posix" or (found.st_uid == os.geteuid() and not found.st_mode & 0o077)


def _name(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()[:40] + SUFFIX


def _content(path: Path) -> bytes:
    """The bytes of a file that belongs to this user alone.

    Raises:
        UntrustedProgramError: it does not.
        OSError: it cannot be read.
    """
    # A link is not followed, and the checks are of the file that was opened.
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    with open(os.open(path, flags | getattr(os, "O_NONBLOCK", 0)), "rb") as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise UntrustedProgramError(f"{path} is not a regular file")
        if not _is_private(found):
            raise UntrustedProgramError(f"{path} is not private to this user")
        return file.read()


def _parsed(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and packed program of a complete entry.

    Raises:
        UntrustedProgramError: it is damaged.
    """
    start = len(MAGIC) + _DIGEST_BYTES
    digest, rest = content[len(MAGIC) : start], content[start:]
    if not content.startswith(MAGIC) or hashlib.sha256(rest).digest() != digest:
        raise UntrustedProgramError("an entry is damaged")
    try:
        (length,) = _LENGTH.unpack(rest[: _LENGTH.size])
        header = json.loads(rest[_LENGTH.size : _LENGTH.size + length])
    except (ValueError, struct.error) as error:
        raise UntrustedProgramError("an entry has no header") from error
    if not isinstance(header, dict):
        raise UntrustedProgramError("an entry has no header")
    return header, rest[_LENGTH.size + length :]


def _shrink(folder: Path) -> None:
    """Remove the least recently used entries beyond the limit, and what dead processes left."""
    found = []
    for place in os.scandir(folder):
        with suppress(FileNotFoundError):
            status = place.stat(follow_symlinks=False)
            if not place.name.startswith(PARTIAL):
                found.append((status.st_mtime, status.st_size, place.path))
            elif status.st_mtime < time.time() - STALE_S:
                os.unlink(place.path)
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found)[:-1]:
        if total <= LIMIT_BYTES:
            break
        with suppress(FileNotFoundError):
            os.unlink(path)
        total -= size
