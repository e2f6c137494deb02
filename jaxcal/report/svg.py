"""Small vector figures as text: axes with units, stems, bars and maps, without other libraries.

Coordinates are those of a figure 380 units wide, which a page can show at any width. Colours are
CSS variables of the page, so a figure follows the page's light or dark scheme.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from jaxcal.runtime.array_types import Float, Int
from jaxcal.runtime.colours import BLUE, GREEN, ORANGE

Number = float | int | np.floating

DIRECTIONS = (("lateral", 0, BLUE), ("axial", 2, GREEN), ("elevational", 1, ORANGE))
"""Directions in the image: name, axis of the image frame, and colour. Range errors are axial."""
WIDTH = 380.0
MOST_DRAWN = 2000
"""Most images of one curve: more than three for each unit of a figure's width."""
MOST_PLACES = 400
"""Most places of the target in a map."""
_SPREAD = "#8a8a8a"
"""Colour of intervals, to be seen on white and on black."""

_VIRIDIS = (
    (68, 1, 84),
    (71, 44, 122),
    (59, 81, 139),
    (44, 113, 142),
    (33, 144, 141),
    (39, 173, 129),
    (92, 200, 99),
    (170, 220, 50),
    (253, 231, 37),
)
"""Nine colours of matplotlib's viridis (public domain, CC0), with even steps of lightness."""


def drawn(values: Float[np.ndarray, " n"], marked: Int[np.ndarray, " m"]) -> Int[np.ndarray, " k"]:
    """Places of the images to draw: all, or of many the extremes, which look the same.

    Args:
        values: of the images, in their order.
        marked: places of images that are to be seen; of many of these, too, only the extremes.
    """

    def extremes(among: Int[np.ndarray, " m"]) -> Any:
        if len(among) <= MOST_DRAWN:
            return among
        parts = [(part, values[part]) for part in np.array_split(among, MOST_DRAWN // 2)]
        return [part[end(each)] for part, each in parts for end in (np.argmin, np.argmax)]

    return np.union1d(extremes(np.arange(len(values))), extremes(marked)).astype(int)


def spread_out(places: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "m k"]:
    """At most :data:`MOST_PLACES` of the places, evenly from the whole recording."""
    return places[:: -(-len(places) // MOST_PLACES) or 1]


def viridis(share: Number) -> str:
    """Colour of a number between 0 and 1."""
    place = min(max(share, 0.0), 1.0) * (len(_VIRIDIS) - 1)
    low = min(int(place), len(_VIRIDIS) - 2)
    mixed = (
        round(a + (place - low) * (b - a))
        for a, b in zip(_VIRIDIS[low], _VIRIDIS[low + 1], strict=True)
    )
    return "#" + "".join(f"{value:02x}" for value in mixed)


def ticks(low: Number, high: Number, most: int = 6) -> list[Any]:
    """Round numbers between two others, at most ``most`` of them.

    If that leaves a single one, which shows no scale, more are allowed.
    """
    if not high > low:
        return [low]
    rough = (high - low) / max(most - 1, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * k for k in (1, 2, 5, 10) if power * k >= rough * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    found = [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]
    return found if len(found) > 1 or most > 9 else ticks(low, high, most + 2)


def bar_length(size: float) -> float:
    """A round length for a scale bar, about a quarter of a size (both in mm)."""
    power = 10.0 ** math.floor(math.log10(max(size / 4, 1e-9)))
    length = max(power * k for k in (1, 2, 5) if power * k <= size / 4 * (1 + 1e-9))
    return float(f"{length:.3g}")


def ink(colour: str) -> str:
    """Black or white, whichever is easier to read on a colour like ``#0072B2``."""
    parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
    luminance = sum(w * v for w, v in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
    # The contrasts of WCAG 2: (luminance + 0.05) / 0.05 with black, 1.05 / (...) with white.
    return "#000" if (luminance + 0.05) ** 2 > 0.05 * 1.05 else "#fff"


def number(value: Number) -> str:
    """A tick's label: no more digits than it needs, a true minus sign."""
    return f"{value:.6g}".replace("-", "−")


def _at(value: Number) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")


def text(
    x: Number, y: Number, words: str, anchor: str = "middle", kind: str = "", turn: Number = 0.0
) -> str:
    """Words at a place; they are escaped."""
    turned = f' transform="rotate({_at(turn)} {_at(x)} {_at(y)})"' if turn else ""
    named = f' class="{kind}"' if kind else ""
    return (
        f'<text x="{_at(x)}" y="{_at(y)}" text-anchor="{anchor}"{named}{turned}>'
        f"{escape(words)}</text>"
    )


def line(
    x1: Number, y1: Number, x2: Number, y2: Number, colour: str = "var(--line)", width: Number = 1.0
) -> str:
    """A straight line."""
    return (
        f'<line x1="{_at(x1)}" y1="{_at(y1)}" x2="{_at(x2)}" y2="{_at(y2)}" stroke="{colour}" '
        f'stroke-width="{_at(width)}"/>'
    )


def circle(x: Number, y: Number, radius: Number, style: str, title: str = "") -> str:
    """A circle; ``style`` has its attributes, and a title is shown where the pointer rests."""
    return _shape(f'circle cx="{_at(x)}" cy="{_at(y)}" r="{_at(radius)}"', style, title)


def rect(x: Number, y: Number, wide: Number, high: Number, style: str, title: str = "") -> str:
    """A rectangle, as :func:`circle`."""
    size = f'width="{_at(wide)}" height="{_at(high)}"'
    return _shape(f'rect x="{_at(x)}" y="{_at(y)}" {size}', style, title)


def _shape(element: str, style: str, title: str) -> str:
    if not title:
        return f"<{element} {style}/>"
    return f"<{element} {style}><title>{escape(title)}</title></{element.split()[0]}>"


def figure(height: Number, parts: Iterable[str], label: str) -> str:
    """An SVG element with a label for screen readers."""
    return (
        f'<svg viewBox="0 0 {_at(WIDTH)} {_at(height)}" role="img" aria-label="{escape(label)}">'
        f"{''.join(parts)}</svg>"
    )


def width_of_ticks(values: Iterable[Number]) -> float:
    """Distance of a y label from its axis, so that the numbers between them have room."""
    longest = max((len(number(value)) for value in values), default=0)
    return max(34.0, 11.0 + 5.8 * longest)


@dataclass(frozen=True)
class Panel:
    """A rectangle with two linear axes.

    Attributes:
        box: left, top, right and bottom, in the figure's units.
        x: least and greatest value.
        y: the same; the greatest is on top unless ``down``.
        down: y grows downwards, as depth does.
    """

    box: tuple[Number, Number, Number, Number]
    x: tuple[Number, Number]
    y: tuple[Number, Number]
    down: bool = False

    def place(self, x: Number, y: Number) -> tuple[Any, Any]:
        """The position of a point in the figure."""
        left, top, right, bottom = self.box
        across = left + (right - left) * (x - self.x[0]) / (self.x[1] - self.x[0])
        share = (y - self.y[0]) / (self.y[1] - self.y[0])
        return across, top + (bottom - top) * (share if self.down else 1 - share)

    def ticks_down(self) -> list[Any]:
        """Round numbers along y."""
        most = max(int((self.box[3] - self.box[1]) / 19), 3)
        return ticks(*self.y, most)

    def axes(
        self, x_label: str = "", y_label: str = "", *, x_ticks: tuple[Number, Number] | None = None
    ) -> list[str]:
        """Grid, ticks and labels; without an x label the numbers of x are left out, too.

        Ticks along x are between ``x_ticks``, by default the edges.
        """
        left, top, right, bottom = self.box
        parts = []
        for value in ticks(*(x_ticks or self.x)):
            across = self.place(value, self.y[0])[0]
            parts.append(line(across, top, across, bottom, "var(--grid)", 0.6))
            if x_label:
                parts.append(text(across, bottom + 12, number(value), kind="tick"))
        down_ticks = self.ticks_down()
        for value in down_ticks:
            down = self.place(self.x[0], value)[1]
            parts.append(line(left, down, right, down, "var(--grid)", 0.6))
            parts.append(text(left - 5, down + 3.2, number(value), "end", "tick"))
        if x_label:
            parts.append(text(0.5 * (left + right), bottom + 27, x_label, kind="label"))
        if y_label:
            middle = 0.5 * (top + bottom)
            beside = left - width_of_ticks(down_ticks)
            parts.append(text(beside, middle, y_label, kind="label", turn=-90))
        outline = 'fill="none" stroke="var(--line)" stroke-width="0.8"'
        parts.append(rect(left, top, right - left, bottom - top, outline))
        return parts

    def stems(
        self, x: Iterable[Any], y: Iterable[Any], colour: str, titles: Sequence[str]
    ) -> list[str]:
        """Points with a line to zero; all lines are one path, and a dot has a title."""
        zero = min(max(0.0, self.y[0]), self.y[1])
        moves, dots = [], []
        for a, b, title in zip(x, y, titles, strict=True):
            across, down = self.place(a, b)
            moves.append(f"M{_at(across)} {_at(self.place(a, zero)[1])}V{_at(down)}")
            dots.append(circle(across, down, 1.9, f'fill="{colour}"', title))
        return [f'<path d="{"".join(moves)}" stroke="{colour}" stroke-width="0.7"/>', *dots]

    def bars(self, x: Iterable[Any], low: Iterable[Any], high: Iterable[Any]) -> str:
        """Vertical intervals, as one path."""
        moves = []
        for a, b, c in zip(x, low, high, strict=True):
            across, first = self.place(a, b)
            moves.append(f"M{_at(across)} {_at(first)}V{_at(self.place(a, c)[1])}")
        return f'<path d="{"".join(moves)}" stroke="{_SPREAD}" stroke-width="0.8"/>'


def series(
    panels: Sequence[tuple[str, Any, Any, str]],
    marked: Iterable[int],
    label: str,
    *,
    spread: Any = None,
    height: Number = 96.0,
) -> str:
    """Panels one above the other, with one scale for all; each shows a value of every image.

    Args:
        panels: name with unit, image numbers, values, colour; of many images the extremes are
            drawn (:func:`drawn`).
        marked: images to mark.
        label: of the figure.
        spread: half-lengths of vertical bars in every panel.
        height: of one panel.
    """
    values = np.concatenate([np.asarray(column, float) for _, _, column, _ in panels])
    values = values[np.isfinite(values)]
    half = None if spread is None else np.nan_to_num(np.asarray(spread, float))
    if half is not None and len(values):
        wide = float(np.abs(half).max())
        values = np.append(values, [values.max() + wide, values.min() - wide])
    low = min(0.0, float(values.min()) if len(values) else -1.0)
    high = max(0.0, float(values.max()) if len(values) else 1.0)
    margin = 0.08 * (high - low) or 1.0
    scale = (low - margin if low < 0 else 0.0, high + margin)
    images = np.concatenate([np.asarray(x, float) for _, x, _, _ in panels])
    first, last = (float(images.min()), float(images.max())) if len(images) else (0.0, 1.0)
    parts, rings = [], list(marked)
    left = 14.0 + width_of_ticks(Panel((48.0, 0.0, 374.0, height), (0, 1), scale).ticks_down())
    for k, (name, x, y, colour) in enumerate(panels):
        top = 8.0 + k * (height + 12.0)
        panel = Panel((left, top, 374.0, top + height), (first - 1, last + 1), scale)
        below = "image" if k == len(panels) - 1 else ""
        parts += panel.axes(below, name, x_ticks=(first, last))
        zero = panel.place(first, 0.0)[1]
        parts.append(line(left, zero, 374.0, zero, "var(--text)", 0.6))
        ringed = np.isin(np.asarray(x, int), rings)
        shown = drawn(np.asarray(y, float), np.flatnonzero(ringed))
        ringed = ringed[shown]
        x, y = np.asarray(x, float)[shown], np.asarray(y, float)[shown]
        if half is not None:
            parts.append(panel.bars(x, y - half[shown], y + half[shown]))
        pairs = list(zip(x, y, strict=True))
        titles = [f"image {int(a)}: {b:.4g}" if len(x) <= 300 else "" for a, b in pairs]
        parts += panel.stems(x, y, colour, titles)
        ring = f'fill="none" stroke="{ORANGE}" stroke-width="1.4"'
        parts += [circle(*panel.place(x[k], y[k]), 5, ring) for k in np.flatnonzero(ringed)]
    whole = 8.0 + len(panels) * (height + 12.0) + 26.0
    return figure(whole, parts, label)


def error_map(
    lateral: Float[np.ndarray, "m m"],
    axial: Float[np.ndarray, "m m"],
    error: Float[np.ndarray, "m m"],
    seen: Float[np.ndarray, "n 2"],
    label: str,
) -> str:
    """A map over the image: cells coloured by error, the target's places, a scale bar.

    Args:
        lateral: mm, of the cells' corners.
        axial: depth, mm.
        error: mm there.
        seen: [lateral, axial] where the target was, mm.
        label: of the figure.
    """
    x = (float(lateral.min()), float(lateral.max()))
    y = (float(axial.min()), float(axial.max()))
    pad = 0.03 * max(x[1] - x[0], y[1] - y[0])
    x, y = (x[0] - pad, x[1] + pad), (y[0] - pad, y[1] + pad)
    # Both axes have the same scale, which determines the height of the figure.
    across = min(250.0, 300.0 * (x[1] - x[0]) / (y[1] - y[0]))
    down = across * (y[1] - y[0]) / (x[1] - x[0])
    panel = Panel((48.0, 10.0, 48.0 + across, 10.0 + down), x, y, down=True)
    low, high = float(error.min()), float(error.max())
    span = high - low or 1.0
    cells = []
    for i in range(error.shape[0] - 1):
        for j in range(error.shape[1] - 1):
            mean = float(error[i : i + 2, j : j + 2].mean())
            corners = ((i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j))
            places = [panel.place(float(lateral[c]), float(axial[c])) for c in corners]
            outline = " ".join(f"{_at(a)},{_at(b)}" for a, b in places)
            colour = viridis((mean - low) / span)
            # A stroke of the same colour closes the gaps between cells.
            cells.append(
                f'<polygon points="{outline}" fill="{colour}" stroke="{colour}" '
                f'stroke-width="0.6"><title>{mean:.3g} mm</title></polygon>'
            )
    parts = [*panel.axes("lateral (mm)", "depth (mm)"), *cells]
    for a, b in spread_out(seen):
        if x[0] <= a <= x[1] and y[0] <= b <= y[1]:
            dot = 'fill="#fff" stroke="#000" stroke-width="0.6"'
            parts.append(circle(*panel.place(float(a), float(b)), 1.7, dot))
    # Of a shallow image, too, the bar has room for its numbers.
    tall = min(max(down - 24.0, 46.0), 150.0)
    parts += _colour_bar(48.0 + across + 22.0, 22.0, tall, low, high)
    length = bar_length(float(np.ptp(lateral)))
    bar = length * across / (x[1] - x[0])
    left, under = 48.0 + across + 22.0, 10.0 + down - 4.0
    if down > 210:
        parts.append(line(left, under, left + bar, under, "var(--text)", 2.0))
        parts.append(text(left, under - 6, f"{length:g} mm", "start", "tick"))
        dot = 'fill="#fff" stroke="var(--text)" stroke-width="0.6"'
        parts.append(circle(left + 2, under - 30, 1.7, dot))
        parts.append(text(left + 8, under - 27, "target", "start", "tick"))
    return figure(max(10.0 + down + 34.0, 22.0 + tall + 8.0), parts, label)


def _colour_bar(left: Number, top: Number, height: Number, low: Number, high: Number) -> list[str]:
    parts = [text(left, top - 8, "mm", "start", "tick")]
    steps = 40
    for k in range(steps):
        y = top + height * (1 - (k + 1) / steps)
        colour = viridis((k + 0.5) / steps)
        parts.append(rect(left, y, 12, height / steps + 0.4, f'fill="{colour}"'))
    for value in ticks(low, high, 5 if height >= 90 else 3):
        y = top + height * (1 - (value - low) / ((high - low) or 1.0))
        parts.append(line(left + 12, y, left + 15, y, "var(--text)", 0.8))
        parts.append(text(left + 18, y + 3.2, number(value), "start", "tick"))
    return parts


def stacked(rows: Sequence[tuple[str, Sequence[tuple[str, Any, str]]]], label: str) -> str:
    """Horizontal bars of shares that add up to one, with a legend.

    Each bar has a title, and name, share and colour of its parts.
    """
    parts: list[str] = []
    for k, (title, shares) in enumerate(rows):
        top = 6.0 + 46.0 * k
        parts.append(text(4.0, top + 9.0, title, "start", "label"))
        left = 4.0
        for name, share, colour in shares:
            wide = 372.0 * share
            told = f"{name}: {100 * share:.0f} %"
            parts.append(rect(left, top + 14, wide, 16, f'fill="{colour}"', told))
            if share > 0.09:
                parts.append(
                    f'<text x="{_at(left + wide / 2)}" y="{_at(top + 26)}" text-anchor="middle" '
                    f'class="tick" style="fill:{ink(colour)}">{100 * share:.0f} %</text>'
                )
            left += wide
    under = 6.0 + 46.0 * len(rows)
    left = 4.0
    for name, _, colour in rows[0][1] if rows else ():
        parts.append(rect(left, under, 9, 9, f'fill="{colour}"'))
        parts.append(text(left + 13, under + 8, name, "start", "tick"))
        left += 30.0 + 5.4 * len(name)
    return figure(under + 16.0, parts, label)


def matrix_map(names: Sequence[str], values: Float[np.ndarray, "k k"], label: str) -> str:
    """A correlation matrix: blue below zero, orange above, numbers as titles of the cells."""
    count, left, top = len(names), 96.0, 6.0
    size = (WIDTH - left - 8.0) / max(count, 1)
    parts: list[str] = []
    for i, name in enumerate(names):
        parts.append(text(left - 6, top + (i + 0.5) * size + 3, name, "end", "tick"))
        parts.append(
            text(left + (i + 0.5) * size, top + count * size + 12, str(i + 1), kind="tick")
        )
        for j in range(count):
            value = float(values[i, j])
            style = (
                f'fill="{ORANGE if value > 0 else BLUE}" fill-opacity="{abs(value):.2f}" '
                'stroke="var(--grid)" stroke-width="0.5"'
            )
            told = f"{name}, {names[j]}: {value:.2f}"
            place = left + j * size, top + i * size
            parts.append(rect(*place, size - 1, size - 1, style, told))
    return figure(top + count * size + 18.0, parts, label)
