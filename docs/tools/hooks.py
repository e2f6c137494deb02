"""What the site adds to the Markdown of its pages (hooks of mkdocs)."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)

_ROLE = re.compile(r":(?:func|class|mod|meth|data|attr):(?=<code>|<autoref)")
"""Marks of the docstrings that this site's tools do not know."""


def on_page_content(text: str, **_: object) -> str:
    """Equations become MathML, which browsers draw without a program."""

    def equation(match: re.Match[str]) -> str:
        display = "inline" if match[2] == "(" else "block"
        return convert(html.unescape(match[3]), display=display)

    return _ROLE.sub("", _EQUATION.sub(equation, text))
