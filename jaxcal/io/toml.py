"""TOML that somebody else wrote: bounded before it is parsed.

``tomllib`` has no bounds: one dotted key of 60,000 parts takes gigabytes and does not end, nested
arrays end in a RecursionError, and a number of 5000 digits in an error of Python's own. So the text
outside strings and comments is checked first, and refused with one line that says where.
"""

from __future__ import annotations

import os
import re
import tomllib
from typing import Any

from jaxcal import FormatError
from jaxcal.io.given_files import naming, one_line, read_bytes

MAXIMUM_BYTES = 2**20
"""Largest file that is read."""

MOST_PARTS = 8
"""Most parts of a dotted key, ``a.b.c``, and of a date or a number with dots."""

MOST_DEEP = 16
"""Most arrays and inline tables nested in one another."""

MOST_KEYS = 10_000
"""Most keys, tables and arrays."""

LONGEST_WORD = 100
"""Most characters of a bare key or a number."""

# Longest first: a multi-line string begins like an empty one, and may end in quotes of its own.
_TOKEN = re.compile(
    r'(?P<string>"""(?:[^\\]|\\.)*?"{3,5}|\'\'\'.*?\'{3,5}|"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\')'
    r"|(?P<open>[\"'])"
    r"|(?P<comment>\#[^\n]*)"
    r"|(?P<word>[^\s\[\]{}=,.\"'#]+)"
    r"|(?P<mark>[\[\]{}=.,])"
    r"|(?P<line>\n)",
    re.DOTALL,
)


def load_toml(
    path: str | os.PathLike[str], *, maximum_bytes: int = MAXIMUM_BYTES
) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        FormatError: no such file, too large, not UTF-8, not TOML, or beyond the bounds of this
            module; one line that starts with the path.
    """
    content = read_bytes(path, maximum_bytes)
    try:
        # With the byte order mark of Windows' editors, or without.
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError(f"{path}: is not UTF-8 text") from None
    with naming(path):
        return parse_toml(text)


def parse_toml(text: str) -> dict[str, Any]:
    """:func:`load_toml` from the file's text; errors do not name the file."""
    text = text.replace("\r\n", "\n")
    _check(text)
    try:
        return tomllib.loads(text)
    # TOMLDecodeError is a ValueError; numbers and dates raise others.
    except (ValueError, OverflowError, RecursionError) as error:
        raise FormatError(f"is not TOML: {one_line(error)}") from None


def _check(text: str) -> None:
    line, deep, parts, keys = 1, 0, 1, 0
    for token in _TOKEN.finditer(text):
        kind, found = token.lastgroup, token.group()
        if kind == "open":
            raise _refused(line, "a string that does not end")
        if kind == "word" and len(found) > LONGEST_WORD:
            what = "a number" if found.lstrip("+-")[:1].isdigit() else "a name"
            raise _refused(line, f"{what} of {len(found)} characters", LONGEST_WORD)
        if kind == "mark":
            # A dot continues a key (or a number); any other mark, a comma included, ends it.
            parts = parts + 1 if found == "." else 1
            keys += found == "=" or (found == "[" and deep == 0)
            deep = max(0, deep + (found in "[{") - (found in "]}"))
            if parts > MOST_PARTS:
                raise _refused(line, f"a key of more than {MOST_PARTS} parts")
            if keys > MOST_KEYS:
                raise _refused(line, f"more than {MOST_KEYS} keys")
            if deep > MOST_DEEP:
                raise _refused(line, f"arrays or tables nested more than {MOST_DEEP} deep")
        elif kind in ("line", "comment"):
            parts = 1
        line += found.count("\n")


def _refused(line: int, what: str, most: int | None = None) -> FormatError:
    bound = "" if most is None else f" (at most {most})"
    return FormatError(f"is not TOML that is read here: {what} in line {line}{bound}")
