"""What the site adds to the Markdown of its pages (hooks of mkdocs)."""

from __future__ import annotations

import html
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)

_ROLE = re.compile(r":(?:func|class|mod|meth|data|attr):(?=<code>|<autoref)")
"""Marks of the docstrings that this site's tools do not know."""

_RESULTS = "experiments/results"
"""Folder of the figures that experiments write; pages show them from there."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The site gets the figures of the experiments that pages show."""
    pages = "".join(page.content_string for page in files.documentation_pages())
    for figure in sorted((Path(__file__).parents[2] / _RESULTS).glob("*.png")):
        if f"../{_RESULTS}/{figure.name})" in pages:
            place = f"{_RESULTS}/{figure.name}"
            files.append(File.generated(config, place, abs_src_path=str(figure)))
    return files


def on_page_markdown(text: str, **_: object) -> str:
    """On the site these figures are inside the folder of the pages, one level lower."""
    return text.replace(f"../{_RESULTS}/", f"{_RESULTS}/")


def on_page_content(text: str, **_: object) -> str:
    """Equations become MathML, which browsers draw without a program."""

    def equation(match: re.Match[str]) -> str:
        display = "inline" if match[2] == "(" else "block"
        return convert(html.unescape(match[3]), display=display)

    return _ROLE.sub("", _EQUATION.sub(equation, text))
