"""Sentences, headings and lists as plain text of a given width.

A paragraph is a string without line breaks. One that starts with ``BULLET`` is a point of a list;
one that ends with a colon, with points after it, is their heading.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

BULLET = "- "


def listed(heading: str, points: Sequence[str]) -> list[str]:
    """A heading and its points; nothing without points."""
    return [f"{heading}:", *(BULLET + text for text in points)] if points else []


def laid_out(lines: Sequence[str], width: int) -> str:
    """Paragraphs wrapped to a width, with a blank line before every heading."""
    told = []
    for here, after in zip(lines, [*lines[1:], ""], strict=True):
        if told and here.endswith(":") and after.startswith(BULLET):
            told.append("")
        indent = " " * len(BULLET) if here.startswith(BULLET) else ""
        # Paths and options stay whole, so that they can be copied.
        told.append(
            textwrap.fill(
                here,
                width,
                subsequent_indent=indent,
                break_long_words=False,
                break_on_hyphens=False,
            )
        )
    return "\n".join(told)
