"""Files that a caller named: checks before they are opened, and their names in messages."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager

from jaxcal import FormatError, InputError, MissingFileError
from jaxcal.runtime.messages import shown


def path_name(path: object) -> str:
    """A path as text.

    Raises:
        InputError: it is neither text nor a ``pathlib.Path``, or it is empty, which Python takes
            for the current folder.
    """
    name = os.fspath(path) if isinstance(path, str | os.PathLike) else None
    if not isinstance(name, str):
        raise InputError(f"the name of a file must be text or a pathlib.Path, not {shown(path)}")
    if not name:
        raise InputError("the name of a file or folder is empty")
    return name


def check_readable(path: str | os.PathLike[str], *, maximum_bytes: int | None = None) -> None:
    """Check that a path names an ordinary, readable, non-empty file of at most ``maximum_bytes``.

    Raises:
        MissingFileError: there is none of this name.
        FormatError: a directory, a device or pipe (opening one may hang), not permitted, empty or
            too large. The message of either error is one line that starts with the path.
        InputError: no path.
    """
    path = path_name(path)
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise MissingFileError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise FormatError(f"{path}: cannot be opened: {one_line(error)}") from None
    if stat.S_ISDIR(status.st_mode):
        raise FormatError(f"{path}: is a directory, not a file")
    if not stat.S_ISREG(status.st_mode):
        raise FormatError(f"{path}: is not an ordinary file")
    try:
        with open(path, "rb"):
            pass
    except OSError as error:
        raise FormatError(f"{path}: cannot be opened: {one_line(error)}") from None
    if status.st_size == 0:
        raise FormatError(f"{path}: is empty")
    if maximum_bytes is not None and status.st_size > maximum_bytes:
        raise FormatError(
            f"{path}: is too large ({status.st_size} bytes; at most {maximum_bytes} are read)"
        )


def read_bytes(path: str | os.PathLike[str], maximum_bytes: int) -> bytes:
    """The content of a file that :func:`check_readable` accepts.

    Raises:
        FormatError: as there, or it cannot be read; one line that starts with the path.
    """
    check_readable(path, maximum_bytes=maximum_bytes)
    try:
        with open(path, "rb") as file:
            content = file.read(maximum_bytes + 1)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {one_line(error)}") from None
    # It may have grown since it was looked at.
    if len(content) > maximum_bytes:
        raise FormatError(f"{path}: is too large (at most {maximum_bytes} bytes are read)")
    return content


def one_line(error: Exception) -> str:
    """An exception's own words on one line."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror
        if "errno = " in text and error.errno:
            # HDF5 repeats the system's words among many of its own.
            text = os.strerror(error.errno)
    elif isinstance(error, KeyError) and error.args:
        text = str(error.args[0])  # a KeyError's str is quoted
    return " ".join(text.split()) or type(error).__name__


@contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Put a file's name in front of the messages of errors that do not begin with it.

    A line at their beginning goes to the name: ``line 6: ...`` becomes ``FILE:6: ...``.
    """
    name = path_name(path)
    try:
        yield
    except InputError as error:
        text = str(error)
        named = text.startswith((f"{name}:", f"{name} with "))
        if not named:
            line = re.match(r"line (\d+): ", text)
            text = f"{name}: {text}" if line is None else f"{name}:{line[1]}: {text[line.end() :]}"
        raise type(error)(text) from None
