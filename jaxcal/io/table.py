"""Tables of numbers: separators, decimal commas and headers as they come, with their lines."""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal import FormatError
from jaxcal.io.columns import names_columns
from jaxcal.io.lines import cells_of, text_lines
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_NUMBER = re.compile(
    r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf(?:inity)?)", re.I
)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
ABSENT = -1e20
"""A number below this is missing: NDI writes -3.697314E28 in its place."""
MOST_ROWS = 1_000_000
"""Most rows of a table, a quarter of an hour at 1 kHz."""
_STATED_SEPARATOR = re.compile(r'"?sep=([;,\t])"?[;,\t]*', re.I)
_SEPARATED = {",": "commas", ";": "semicolons", "\t": "tabs", "": "white space"}


@dataclass(frozen=True)
class Table:
    """Cells of a table.

    Attributes:
        name: of the file.
        header: names of the columns, or None without a header.
        rows: cells, as they stand.
        lines: line number of each row.
        separator: between cells; "" for white space.
    """

    name: str
    header: list[str] | None
    rows: list[list[str]]
    lines: list[int]
    separator: str

    def row(self, row: int) -> str:
        """Where a row stands, for a message."""
        return f"{self.name}:{self.lines[row]}"

    def numbers(
        self, columns: tuple[int, ...], rows: list[int] | None = None, *, finite: bool = True
    ) -> Float[np.ndarray, "rows columns"]:
        """Numbers of some columns.

        Args:
            columns: which.
            rows: which; by default all.
            finite: refuse NaN and Inf.

        Raises:
            FormatError: not a number, or NaN or Inf; file, line and column are named.
        """
        chosen = range(len(self.rows)) if rows is None else rows
        values = np.empty((len(chosen), len(columns)))
        marks: set[str] = set()
        for place, row in enumerate(chosen):
            texts = [self.rows[row][column] for column in columns]
            found = parse_numbers(texts, decimal_comma=self.separator != ",")
            for column, text, value in zip(columns, texts, found, strict=True):
                if value is not None and (math.isfinite(value) or not finite):
                    continue
                why = f"is {text}" if value is not None else f"is not a number: {quoted(text)}"
                raise FormatError(f"{self.row(row)}: {self.column(column)} {why}")
            values[place] = found
            if self.separator != ",":
                marks.update(set("".join(texts)) & {",", "."})
                if len(marks) > 1:
                    raise FormatError(
                        f"{self.row(row)}: numbers have commas and points in these columns: which "
                        "is the decimal sign? Save them without marks between thousands"
                    )
        return values

    def column(self, column: int) -> str:
        """A column by its number and name, for a message."""
        name = "" if self.header is None else f" ({quoted(self.header[column])})"
        return f"column {column + 1}{name}"


def parse_number(text: str, *, decimal_comma: bool = False) -> float | None:
    """A number as programs write it, or None; never ``1_000``."""
    return parse_numbers([text], decimal_comma=decimal_comma)[0]


def parse_numbers(texts: list[str], *, decimal_comma: bool = False) -> list[float | None]:
    """Numbers as programs write them, each or None."""
    found: list[float | None] = []
    for text in map(str.strip, texts):
        if decimal_comma and _DECIMAL_COMMA.fullmatch(text):
            text = text.replace(",", ".")
        found.append(float(text) if _NUMBER.fullmatch(text) else None)
    return found


def finite_numbers(
    text: str, count: int, what: str, separator: str | None = None
) -> Float[np.ndarray, " count"]:
    """Numbers with blanks between them, or another separator.

    Raises:
        FormatError: others than ``count`` finite numbers; the message begins with ``what``.
    """
    try:
        numbers = np.array([float(part) for part in text.split(separator)])
    except ValueError:
        raise FormatError(f"{what} is not numbers: {quoted(text)}") from None
    if len(numbers) != count:
        raise FormatError(f"{what} must have {count} numbers, not {len(numbers)}")
    if not np.isfinite(numbers).all():
        raise FormatError(f"{what} holds NaN or Inf: {quoted(text)}")
    return numbers


def read_table(
    path: str | os.PathLike[str], *, header: bool = True, separator: str | None = None
) -> Table:
    """Read a table; comments (``#``) and blank lines are left out.

    Args:
        path: cells separated by semicolons, tabs, commas or white space: whichever of these the
            first line has, in this order. If it is not a comma, a comma may be the decimal sign.
        header: the first line names the columns if none of its cells is a number; so does a
            comment before it that holds as many names as there are columns.
        separator: the separator, if it is known; "" for white space.

    Raises:
        FormatError: cannot be read, no or too many rows, or rows of different lengths; file and
            line are named.
    """
    name = os.fspath(path)
    names: list[str] | None = None
    rows: list[list[str]] = []
    lines: list[int] = []
    blank: list[str] = []
    for line, content in text_lines(path):
        # What spreadsheets are told in the first line.
        stated = _STATED_SEPARATOR.fullmatch(content.strip("\r\n"))
        if stated and separator is None:
            separator = stated[1]
            continue
        if separator is None:
            separator = _separator_of(content)
        cells = _cells(f"{name}:{line}", content, separator)
        if header and not rows and names is None and _is_header(cells, separator):
            # Some programs end every line, the header's too, with a separator.
            names = _without_blank_end(cells, 0)
            continue
        width = len(names or rows[0]) if names or rows else len(cells)
        if any(cells):
            cells = _without_blank_end(cells, width)
        else:
            # All empty rows are one object: however wide the table, they take no memory.
            cells = blank = blank or [""] * width
        if len(cells) != width:
            before = "the header has" if names else "the rows before have"
            hint = ""
            if names and not rows and _is_header(cells, separator):
                hint = "; the header must be the first line, without a title above it"
            elif separator == "," and len(cells) > width + 1:
                hint = "; decimal commas need semicolons between the cells"
            raise FormatError(
                f"{name}:{line}: {len(cells)} columns, {before} {width} (separated by "
                f"{_SEPARATED[separator]}{hint})"
            )
        if len(rows) == MOST_ROWS:
            raise FormatError(f"{name}:{line}: more than {MOST_ROWS} rows")
        rows.append(cells)
        lines.append(line)
    # A spreadsheet writes empty rows where cells below the table once held something.
    while rows and not any(rows[-1]):
        rows.pop()
        lines.pop()
    if not rows:
        raise FormatError(f"{name}: holds no rows of numbers")
    if header and names is None:
        names = _commented_header(path, lines[0], rows[0], separator or "")
    return Table(name, names, rows, lines, separator or "")


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """A table with commas between its cells, for other programs."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def first_line(path: str | os.PathLike[str]) -> tuple[str, bool]:
    """Separator in the first line of a table, and whether a header names the columns."""
    for line, content in text_lines(path):
        if not _STATED_SEPARATOR.fullmatch(content.strip("\r\n")):
            separator = _separator_of(content)
            cells = _cells(f"{os.fspath(path)}:{line}", content, separator)
            named = _is_header(cells, separator) or _commented_header(path, line, cells, separator)
            return separator, bool(named)
    return "", False


def _commented_header(
    path: str | os.PathLike[str], line: int, row: list[str], separator: str
) -> list[str] | None:
    """Names in the comment just before the first row, where ``numpy.savetxt`` writes a header."""
    before = ""
    at = line
    for number, content in text_lines(path, comments=True):
        if number == line:
            break
        at, before = number, content.strip()
    if not before.startswith("#"):
        return None
    where = f"{os.fspath(path)}:{at}"
    cells = _cells(where, before.removeprefix("#").strip(), separator)
    header = len(cells) == len(row) and _is_header(cells, separator) and names_columns(cells)
    return cells if header else None


def _separator_of(content: str) -> str:
    return next((mark for mark in (";", "\t", ",") if mark in content.strip()), "")


def _cells(where: str, content: str, separator: str) -> list[str]:
    if not separator:
        return content.split()
    if '"' not in content:
        return [cell.strip() for cell in content.split(separator)]
    return [cell.strip() for cell in cells_of(where, content, separator)]


def _without_blank_end(cells: list[str], width: int) -> list[str]:
    """The cells without empty ones at the end, but at least ``width``."""
    end = len(cells)
    while end > width and not cells[end - 1]:
        end -= 1
    return cells[:end]


def _is_header(cells: list[str], separator: str) -> bool:
    comma = separator != ","
    named = [cell for cell in cells if cell]
    return bool(named) and all(parse_number(cell, decimal_comma=comma) is None for cell in named)
