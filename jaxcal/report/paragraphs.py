"""Sentences, headings and lists as text of a given width, alone or with tables, and as HTML.

A paragraph is a string without line breaks. One that starts with ``BULLET`` is a point of a list;
one that ends with a colon, with points after it, is their heading.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

BULLET = "- "

_UNITS = re.compile(r"(\d) (%|mm\b|SDs?\b|degrees?\b)")
"""A number and its unit, which a line break must not separate."""


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
        filled = textwrap.fill(
            _UNITS.sub(r"\1\0\2", here),
            width,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
        told.append(filled.replace("\0", " "))
    return "\n".join(told)


def simple_table(headings: Iterable[str], words: Iterable[str]) -> Table:
    """A table without lines, in which the columns of ``words`` begin at the left, others do not."""
    from rich import box
    from rich.table import Table

    table, left = Table(box=box.SIMPLE), set(words)
    for heading in headings:
        # Folded: a narrow terminal would cut off the ends of words, and paths would look alike.
        table.add_column(heading, justify="left" if heading in left else "right", overflow="fold")
    return table


class Verbatim(str):
    """A line that is not wrapped, so that it can be copied: a command."""


def page_text(parts: Iterable[RenderableType], width: int | None, *, styled: bool = False) -> str:
    """Tables, paragraphs and verbatim lines, one below the other, as a terminal shows them.

    Args:
        parts: tables of rich, paragraphs (str) and :class:`Verbatim` lines.
        width: of the page; None: that of the terminal.
        styled: whether bold type and colours may be in the text, where the terminal has them.
    """
    from rich.console import Console

    # Nothing in a message or a file's name is to be taken for markup.
    page = Console(
        markup=False,
        highlight=False,
        emoji=False,
        width=width,
        color_system="auto" if styled else None,
    )
    with page.capture() as captured:
        for kind, group in groupby(parts, key=type):
            if kind is Verbatim:
                for line in group:
                    page.print(line, soft_wrap=True)
            elif kind is str:
                page.print(laid_out([str(part) for part in group], page.width), soft_wrap=True)
            else:
                page.print(*group)
    return captured.get()


def as_html(lines: Sequence[str]) -> str:
    """Paragraphs and lists of HTML; the text is escaped."""
    parts, items = [], []
    for text in [*lines, ""]:
        shown = _UNITS.sub(r"\1&nbsp;\2", escape(text.removeprefix(BULLET)))
        shown = shown.replace(" +- ", " ± ")
        if text.startswith(BULLET):
            items.append(f"<li>{shown}</li>")
            continue
        if items:
            parts.append(f"<ul>{''.join(items)}</ul>")
            items = []
        if text:
            parts.append(f"<p>{shown}</p>")
    return "".join(parts)
