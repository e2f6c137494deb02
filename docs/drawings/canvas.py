"""The one style of the drawings: SVG with a card of its own, readable on light and dark pages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

Point = tuple[float, float]

STYLE = """
svg { font-family: "Segoe UI", Roboto, Helvetica, Arial, sans-serif; font-size: 17px; }
.line { fill: none; stroke-width: 2; stroke-linecap: round; stroke-linejoin: round; }
.thin { fill: none; stroke-width: 1.3; stroke-linecap: round; }
.dash { stroke-dasharray: 5 5; }
.card { fill: #ffffff; stroke: #d5dae1; }
.text { fill: #1f2733; } .soft { fill: #4f5a69; font-size: 16px; }
.head { fill: #1f2733; font-weight: 600; font-size: 18px; }
.math { font-family: Cambria, "Times New Roman", serif; font-style: italic; font-size: 20px; }
.ink { stroke: #1f2733; } .grey { stroke: #8a94a3; } .fill-ink { fill: #1f2733; }
.fill-grey { fill: #8a94a3; }
.blue { stroke: #1f5fa8; } .fill-blue { fill: #1f5fa8; } .wash-blue { fill: #dce9f8; }
.orange { stroke: #c2501a; } .fill-orange { fill: #c2501a; } .wash-orange { fill: #fbe4d7; }
.green { stroke: #23774a; } .fill-green { fill: #23774a; }
.wash-grey { fill: #eef1f5; } .paper { fill: #ffffff; }
@media (prefers-color-scheme: dark) {
  .card { fill: #171c24; stroke: #333c49; }
  .text, .head { fill: #e8edf4; } .soft { fill: #b4bdca; }
  .ink { stroke: #e8edf4; } .grey { stroke: #7d8898; } .fill-ink { fill: #e8edf4; }
  .fill-grey { fill: #7d8898; }
  .blue { stroke: #7db6f7; } .fill-blue { fill: #7db6f7; } .wash-blue { fill: #1d3450; }
  .orange { stroke: #ff9c66; } .fill-orange { fill: #ff9c66; } .wash-orange { fill: #4b2a18; }
  .green { stroke: #6fd49a; } .fill-green { fill: #6fd49a; }
  .wash-grey { fill: #2b333f; } .paper { fill: #171c24; }
}
"""


class Canvas:
    """A drawing, in px from the upper left corner."""

    def __init__(self, width: float, height: float, title: str) -> None:
        self.width, self.height, self.title = width, height, title
        self.parts: list[str] = []

    def line(self, points: Sequence[Point], style: str = "line ink") -> None:
        """A polygonal line."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self.parts.append(f'<polyline class="{style}" points="{path}"/>')

    def polygon(self, points: Sequence[Point], style: str) -> None:
        """A filled polygon."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self.parts.append(f'<polygon class="{style}" points="{path}"/>')

    def path(self, commands: str, style: str) -> None:
        """A path in SVG's own words."""
        self.parts.append(f'<path class="{style}" d="{commands}"/>')

    def circle(self, at: Point, radius: float, style: str) -> None:
        """A circle."""
        self.parts.append(
            f'<circle class="{style}" cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius}"/>'
        )

    def box(self, at: Point, size: Point, style: str, radius: float = 6) -> None:
        """A rectangle from its upper left corner."""
        self.parts.append(
            f'<rect class="{style}" x="{at[0]:.1f}" y="{at[1]:.1f}" width="{size[0]:.1f}" '
            f'height="{size[1]:.1f}" rx="{radius}"/>'
        )

    def text(self, at: Point, words: str, style: str = "text", anchor: str = "start") -> None:
        """Words on a base line that begins (or has its middle or end) at a place."""
        self.parts.append(
            f'<text class="{style}" x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}">'
            f"{escape(words)}</text>"
        )

    def lines(
        self, at: Point, words: str, style: str = "soft", anchor: str = "start", step: float = 19
    ) -> None:
        """Several lines of words."""
        for k, line in enumerate(words.split("\n")):
            self.text((at[0], at[1] + k * step), line, style, anchor)

    def arrow(
        self, start: Point, end: Point, colour: str = "ink", thin: bool = False, both: bool = False
    ) -> None:
        """A straight arrow."""
        reach = math.hypot(end[0] - start[0], end[1] - start[1])
        along = ((end[0] - start[0]) / reach, (end[1] - start[1]) / reach)
        size = 8.0 if thin else 10.0
        inner = (end[0] - 0.8 * size * along[0], end[1] - 0.8 * size * along[1])
        outer = start
        if both:
            outer = (start[0] + 0.8 * size * along[0], start[1] + 0.8 * size * along[1])
        self.line([outer, inner], f"{'thin' if thin else 'line'} {colour}")
        self._head(end, along, size, colour)
        if both:
            self._head(start, (-along[0], -along[1]), size, colour)

    def _head(self, tip: Point, along: Point, size: float, colour: str) -> None:
        across = (-along[1], along[0])
        back = (tip[0] - size * along[0], tip[1] - size * along[1])
        half = 0.42 * size
        self.polygon(
            [
                tip,
                (back[0] + half * across[0], back[1] + half * across[1]),
                (back[0] - half * across[0], back[1] - half * across[1]),
            ],
            f"fill-{colour}",
        )

    def curved_arrow(self, start: Point, bend: Point, end: Point, colour: str = "ink") -> None:
        """An arrow along a quadratic curve."""
        reach = math.hypot(end[0] - bend[0], end[1] - bend[1])
        along = ((end[0] - bend[0]) / reach, (end[1] - bend[1]) / reach)
        inner = (end[0] - 8 * along[0], end[1] - 8 * along[1])
        self.path(
            f"M{start[0]:.1f},{start[1]:.1f} Q{bend[0]:.1f},{bend[1]:.1f} "
            f"{inner[0]:.1f},{inner[1]:.1f}",
            f"line {colour}",
        )
        self._head(end, along, 10, colour)

    def axes(self, at: Point, ends: dict[str, tuple[Point, Point]], colour: str) -> None:
        """Axes from an origin: name -> (end, place of the name), both from the origin."""
        for name, (end, label) in ends.items():
            self.arrow(at, (at[0] + end[0], at[1] + end[1]), colour)
            self.text((at[0] + label[0], at[1] + label[1]), name, f"math fill-{colour}", "middle")
        self.circle(at, 3.5, f"fill-{colour}")

    def write(self, path: Path) -> None:
        """Write the file."""
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            f'width="{self.width:g}" height="{self.height:g}" role="img">'
        )
        card = (
            f'<rect class="card" x="0.5" y="0.5" width="{self.width - 1:g}" '
            f'height="{self.height - 1:g}" rx="8"/>'
        )
        opening = [head, f"<title>{escape(self.title)}</title>", f"<style>{STYLE}</style>", card]
        content = "\n".join([*opening, *self.parts, "</svg>", ""])
        path.write_text(content, encoding="utf-8")
