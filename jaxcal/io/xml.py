"""XML that somebody else wrote: bounded, without DTD and entities, every element with its place.

Elements know their line and the bytes that they take in the file, so that one of them can be
replaced and every other byte stays as it was. (XML libraries that write a tree change line ends,
tabs and the layout of attributes: the real configurations of PLUS come back different in more than
a hundred lines.)
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from jaxcal import FormatError
from jaxcal.io.given_files import naming, one_line, read_bytes
from jaxcal.runtime.messages import quoted

MAXIMUM_BYTES = 8 * 2**20
"""Largest file that is read; a configuration of PLUS has some 10 kB, a result of fCal 1 MB."""

_TAG = re.compile(rb"""(?:[^>"']|"[^"]*"|'[^']*')*+>""")
"""A tag to its end; ``>`` may stand in quotes."""
_MOST_ELEMENTS = 200_000
_MOST_DEEP = 64


@dataclass(eq=False)
class Element:
    """One element.

    Attributes:
        tag: its name.
        attributes: their values, with entities of XML itself resolved.
        line: where it begins.
        start: its first byte in the file.
        end: the byte after its last.
        content_end: the first byte of its end tag; ``end`` where it has none (``<a/>``).
        children: elements directly in it.
    """

    tag: str
    attributes: dict[str, str]
    line: int
    start: int
    end: int = 0
    content_end: int = 0
    children: list[Element] = field(default_factory=list)

    def all(self, path: str) -> Iterator[Element]:
        """Elements at a path of tags below this one, for instance ``Geometry/Pattern``."""
        tag, _, rest = path.partition("/")
        for child in self.children:
            if child.tag == tag:
                yield from child.all(rest) if rest else (child,)


def read_xml(path: str | os.PathLike[str]) -> tuple[Element, bytes]:
    """The root element of a file, and the file's bytes.

    Raises:
        FormatError: no such file, too large, not XML, a DTD or an entity, nested too deep, or not
            in UTF-8 or another encoding that has ASCII in it; one line that starts with the path.
    """
    content = read_bytes(path, MAXIMUM_BYTES)
    with naming(path):
        return parse_xml(content), content


def parse_xml(content: bytes) -> Element:
    """:func:`read_xml` from bytes; errors do not name the file."""
    if len(content) > MAXIMUM_BYTES:
        raise FormatError(f"is too large (at most {MAXIMUM_BYTES} bytes are read)")
    # In UTF-16, parts could not be replaced by their byte offsets.
    if content[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in content[:4]:
        raise FormatError("is UTF-16 or UTF-32; save it as UTF-8")
    parser = expat.ParserCreate()
    builder = _Builder(parser, content)
    parser.StartElementHandler = builder.begin
    parser.EndElementHandler = builder.finish
    parser.StartDoctypeDeclHandler = builder.refuse
    parser.EntityDeclHandler = builder.refuse
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise FormatError(f"line {error.lineno}: is not XML: {one_line(error)}") from None
    except UnicodeError as error:
        raise FormatError(f"is not XML: {one_line(error)}") from None
    assert builder.root is not None
    return builder.root


class _Builder:
    def __init__(self, parser: expat.XMLParserType, content: bytes) -> None:
        self.root: Element | None = None
        self._parser, self._content = parser, content
        self._open: list[Element] = []
        self._count = 0

    def begin(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if self._count > _MOST_ELEMENTS or len(self._open) >= _MOST_DEEP:
            raise FormatError(
                f"line {self._parser.CurrentLineNumber}: more than {_MOST_ELEMENTS} elements, or "
                f"nested more than {_MOST_DEEP} deep"
            )
        index = self._parser.CurrentByteIndex
        element = Element(tag, attributes, self._parser.CurrentLineNumber, index)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def finish(self, tag: str) -> None:
        element = self._open.pop()
        after = self._after_tag(element.start)
        if self._content[after - 2 : after] == b"/>":
            element.end = element.content_end = after
            return
        element.content_end = self._parser.CurrentByteIndex
        element.end = self._after_tag(element.content_end)

    def _after_tag(self, start: int) -> int:
        """The byte after the tag that begins at ``start``."""
        found = _TAG.match(self._content, start)
        return len(self._content) if found is None else found.end()

    def refuse(self, name: str, *_: object) -> None:
        raise FormatError(
            f"line {self._parser.CurrentLineNumber}: declares {quoted(str(name))}: document types "
            "and entities are not read"
        )
