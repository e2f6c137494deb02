"""Lines of text files that somebody else wrote."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterator

from jaxcal import FormatError
from jaxcal.io.given_files import check_readable, one_line, read_bytes

# Spreadsheets' errors, in English and German, are #N/A, #NV and words like #NAME? and #DIV/0!.
_COMMENT = re.compile(r"\s*#(?!(?:N/A|NV|[A-Z/0]+[!?])[,;\t])")

HDF5_BEGINNING = b"\x89HDF\r\n\x1a\n"
"""How a file of HDF5 begins."""
MAXIMUM_BYTES = 64 * 2**20
"""Largest text file that is read."""
LONGEST_LINE = 2**20
"""Most characters of a line; no table has so many columns."""


def text_lines(
    path: str | os.PathLike[str], *, comments: bool = False
) -> Iterator[tuple[int, str]]:
    """Numbered lines of a UTF-8 (or ASCII) file, without blank ones.

    Args:
        path: the file.
        comments: yield lines that begin with ``#``, too. What spreadsheets write in a cell whose
            formula failed (``#N/A``) begins no comment.

    Raises:
        FormatError: cannot be read, too large, not text, a line of over :data:`LONGEST_LINE`
            characters; one line with path and line.
    """
    name = os.fspath(path)
    check_readable(path, maximum_bytes=MAXIMUM_BYTES)
    try:
        # Line by line: often only the first one is looked at.
        with open(path, encoding="utf-8-sig") as file:
            lines = iter(lambda: file.readline(LONGEST_LINE + 1), "")
            for number, line in enumerate(lines, start=1):
                if "\0" in line:
                    raise FormatError(
                        f"{name}:{number}: is not text in UTF-8: it holds a zero byte"
                    )
                if len(line) > LONGEST_LINE:
                    raise FormatError(f"{name}:{number}: is longer than {LONGEST_LINE} characters")
                if line.strip() and (comments or not _COMMENT.match(line)):
                    yield number, line.rstrip("\n")
    except UnicodeDecodeError:
        raise _not_text(path) from None
    except OSError as error:
        raise FormatError(f"{name}: cannot be read: {one_line(error)}") from None


def _not_text(path: str | os.PathLike[str]) -> FormatError:
    """What to say of a file that is not text in UTF-8."""
    name, content = os.fspath(path), read_bytes(path, MAXIMUM_BYTES)
    if content.startswith(HDF5_BEGINNING):
        return FormatError(f"{name}: is HDF5, not text (a recording's name ends in .h5)")
    line = 1
    try:
        content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line += content.count(b"\n", 0, error.start)
    return FormatError(f"{name}:{line}: is not text in UTF-8: save it as UTF-8")


def cells_of(where: str, content: str, separator: str = ",") -> list[str]:
    """Cells of one line of a table, some of which may be in quotes.

    Args:
        where: the line's number, for a message.
        content: the line.
        separator: one character between cells.

    Raises:
        FormatError: a cell is longer than the module csv takes; the message begins with ``where``.
    """
    try:
        return next(csv.reader([content], delimiter=separator))
    except csv.Error as error:
        raise FormatError(f"{where}: {error}") from None
