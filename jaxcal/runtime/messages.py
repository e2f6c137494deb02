"""Values and texts that a caller or a file gave, short, for messages."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence


def quoted(text: str, limit: int = 40) -> str:
    """Text of an untrusted file, short and with control characters escaped, for a message."""
    return ascii(text if len(text) <= limit else f"{text[:limit]}...")


def printable(text: str) -> str:
    """Text of a device with ``?`` for control characters, which a terminal would obey."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def shown(value: object) -> str:
    """What a caller gave, short, for a message."""
    return quoted(value) if isinstance(value, str) else quoted(repr(value))[1:-1]


def runs_in_words(numbers: Sequence[int], most: int | None = None) -> str:
    """Ascending whole numbers, runs of them as their ends: ``3, 7 to 9``; at most so many runs."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    told = [str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
    return first_ones(told, len(told) if most is None else most)


def counted(count: int, noun: str, one: str = "", several: str = "") -> str:
    """A number with its noun and verb, ``1 image is`` or ``2 images are``."""
    return f"{count} {noun} {one}".rstrip() if count == 1 else f"{count} {noun}s {several}".rstrip()


def enumerated(words: Sequence[str]) -> str:
    """Words one after the other: ``a``, ``a and b`` or ``a, b and c``."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)


def first_ones(items: Sequence[object], most: int = 10) -> str:
    """The first items, with commas between them, and dots if there are more."""
    return ", ".join([*map(str, items[:most]), *["..."] * (len(items) > most)])


def seconds(moment: float) -> str:
    """A time stamp, to the millisecond also where it counts from 1970, for a message."""
    return f"{moment:.3f} s"


def command_line(words: Sequence[str], windows: bool = os.name == "nt") -> str:
    """A command to type, quoted as this system's shell needs it.

    Windows' ``cmd`` takes single quotes for parts of a name; its PowerShell knows double ones, too.
    """
    if not windows:
        import shlex

        return shlex.join(words)
    return " ".join(map(_quoted_for_windows, words))


def _quoted_for_windows(word: str) -> str:
    if re.fullmatch(r"[\w.:\\/+-]+", word):
        return word
    # Programs count a backslash before a quote as an escape of it, and two as one backslash.
    text = re.sub(r'(\\*)"', r"\1\1\"", word)
    return '"' + re.sub(r"(\\+)$", r"\1\1", text) + '"'
