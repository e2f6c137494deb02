"""The file of points placed by hand: a table of frame, u and v, complete after every click.

    # jaxcal pick of sweep.igs.mha: 420 x 300 px, 16 frames
    # skipped: 3 9
    frame,u,v
    0,123.25,45.5

For a folder of images the first column is ``file``, and images are named, in quotes, wherever a
frame of a sequence has its number.

``jaxcal import`` reads it as any other table of points. The two comments make it possible to
continue later: the first says which sequence the points belong to, the second which frames have no
point.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from jaxcal import FormatError, InputError, OutputError
from jaxcal.io.atomic import write_text
from jaxcal.io.given_files import read_bytes
from jaxcal.io.text import read_pose_table
from jaxcal.runtime.messages import quoted

HEAD = "# jaxcal pick of "
"""How the first line of such a file begins."""
_SKIPPED = "# skipped:"
_MOST_BYTES = 2**24
_UNTOLD = r'^[\s"]|[\\\r\n\ud800-\udfff]'
"""What in an image's name would not be read back from a table as it is."""
Point = tuple[float, float]


class Picks:
    """Points placed in the frames of one sequence; every change is on the disk when it returns.

    Args:
        path: of the table; an existing one is continued.
        name: of the sequence.
        size: columns and rows of its frames, px.
        count: of its frames.
        shown: numbers of the frames to place points in, from 0.
        files: names of the images of a folder; empty for a sequence.
        orientation: of the stored pixels where it was stated, since the points depend on it.

    Attributes:
        points: [u, v] by the number of the frame, px.
        skipped: numbers of the frames without a target.
        files: names of the images of a folder; empty for a sequence.

    Raises:
        InputError: an image's name that would not be read back from the table.
        FormatError: a file that was not written here, or one of another sequence.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        name: str,
        size: tuple[int, int],
        count: int,
        shown: Sequence[int],
        files: Sequence[str] = (),
        orientation: str | None = None,
    ) -> None:
        self.files = tuple(files)
        self._column = "file" if files else "frame"
        self.path, self.shown, self.size = os.fspath(path), list(shown), size
        for each in files:
            if re.search(_UNTOLD, each):
                raise InputError(
                    f"{quoted(each)}: a table of points cannot name this image: rename it (no "
                    "line break, backslash, or blank or quotation mark at the beginning; UTF-8)"
                )
        # As the file will have it, also where the name is not UTF-8 or has several lines.
        named = " ".join(name.encode("utf-8", errors="backslashreplace").decode().splitlines())
        stated = f", orientation {orientation}" if orientation else ""
        self._head = f"{HEAD}{named}: {size[0]} x {size[1]} px, {count} frames{stated}"
        self.points: dict[int, Point] = {}
        self.skipped: set[int] = set()
        self._before: list[tuple[int, Point | None, bool]] = []
        self._known = self._content()
        if self._known is not None:
            self._load(self._known.decode(errors="replace"), count)

    @property
    def left(self) -> list[int]:
        """Frames to place points in that were neither picked nor skipped."""
        return [k for k in self.shown if k not in self.points and k not in self.skipped]

    def pick(self, frame: int, u: float, v: float) -> None:
        """Set the point of a frame.

        Raises:
            InputError: no such frame, or a position outside it.
            OutputError: the table cannot be written, or another program has changed it; nothing has
                changed.
        """
        # Pixel centres lie at integers, so that a frame begins at -1/2.
        if not all(-0.5 <= x <= size - 0.5 for x, size in zip((u, v), self.size, strict=True)):
            raise InputError(f"({u}, {v}) is not in the frame")
        self._change(frame, (float(u), float(v)), False)

    def skip(self, frame: int) -> None:
        """Say that a frame has no point.

        Raises:
            InputError: no such frame.
            OutputError: the table cannot be written; nothing has changed.
        """
        self._change(frame, None, True)

    def undo(self) -> int | None:
        """Undo the last change; returns the frame that it was in, or None if there was none.

        Raises:
            OutputError: the table cannot be written; nothing has changed.
        """
        if not self._before:
            return None
        frame, point, skipped = self._before[-1]
        self._put(frame, point, skipped)
        self._before.pop()
        return frame

    def _change(self, frame: int, point: Point | None, skipped: bool) -> None:
        if frame not in self.shown:
            raise InputError(f"frame {frame} is not shown")
        before = (frame, self.points.get(frame), frame in self.skipped)
        self._put(frame, point, skipped)
        self._before.append(before)

    def _put(self, frame: int, point: Point | None, skipped: bool) -> None:
        points = {k: place for k, place in self.points.items() if k != frame}
        if point is not None:
            points[frame] = point
        others = {k for k in self.skipped if k != frame} | ({frame} if skipped else set())
        rows = [f"{self._named(k)},{points[k][0]!r},{points[k][1]!r}" for k in sorted(points)]
        told = " ".join(map(self._named, sorted(others)))
        head = [self._head, f"{_SKIPPED} {told}".rstrip(), f"{self._column},u,v"]
        # Points that a second page or an editor has put there must not be lost.
        if self._content() not in (self._known, None):
            raise OutputError(
                f"{self.path}: was changed by another program: press Ctrl-C and run the same "
                "command again"
            )
        write_text(self.path, "\n".join([*head, *rows, ""]))
        self._known = self._content()
        self.points, self.skipped = points, others

    def _content(self) -> bytes | None:
        """The table as it is on the disk; None where there is none."""
        if not Path(self.path).exists():
            return None
        return read_bytes(self.path, _MOST_BYTES)

    def _named(self, frame: int) -> str:
        if not self.files:
            return str(frame)
        doubled = self.files[frame].replace('"', '""')
        return f'"{doubled}"'

    def _load(self, content: str, count: int) -> None:
        # Not splitlines: an image's name may hold what that takes for the end of a line.
        lines = re.split(r"\r?\n", content.rstrip("\r\n"))
        if not lines[0].startswith(HEAD):
            raise FormatError(f"{self.path}: exists and was not made by jaxcal pick: name another")
        if lines[0] != self._head:
            raise FormatError(
                f"{self.path}: has points of {lines[0].removeprefix(HEAD)!r}, not of "
                f"{self._head.removeprefix(HEAD)!r}: name another file"
            )
        told = lines[1].removeprefix(_SKIPPED) if len(lines) > 1 else ""
        one = r'"(?:[^"]|"")*"' if self.files else r"\d{1,9}"
        if not re.fullmatch(rf" *({one}( +{one})*)? *", told):
            raise FormatError(f"{self.path}: line 2 does not list skipped frames")
        numbers = {self._named(k): k for k in range(count)}
        self.skipped = {numbers.get(named, count) for named in re.findall(one, told)}
        if len(lines) > 3:
            table = read_pose_table(self.path)
            frames = table.file if self.files else table.frame
            if frames is None or table.points is None:
                raise FormatError(f"{self.path}: has no columns {self._column}, u and v")
            if self.files:
                places = {name: k for k, name in enumerate(self.files)}
                frames = [places.get(str(name), count) for name in frames]
            self.points = {
                int(frame): (float(u), float(v))
                for frame, (u, v) in zip(frames, table.points, strict=True)
            }
        if any(frame >= count for frame in [*self.points, *self.skipped]):
            raise FormatError(f"{self.path}: names a frame that the sequence has not")
