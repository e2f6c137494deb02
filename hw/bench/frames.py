"""B-mode frames of the simulated world: speckle, what the phantom shows, its injected pattern.

Speckle is drawn once, as a field larger than a frame; each frame is cut out of it at a new place.
A spot is added to the envelope in its own small patch, before log compression. So a 640 x 480 frame
costs a fraction of a millisecond, whatever is in it.

The phantom of the world says which marks it leaves (:mod:`hw.bench.phantoms`); an injected pattern
is a bar of lines beneath the mark. Beside the active echo element, at the same height (section 3.2
of the paper), the tank holds cross-wires; they are passive and show where the beam crosses them.

Of the paper's image quality (section 4.2) three things are modelled: the transmit focus, at the
target's depth or fixed; multiple reflections, as ghosts of loud echoes; and too short a delay
between lines, which raises the background by late echoes of the line before.
"""

from __future__ import annotations

import numpy as np

from hw.bench.phantoms import ActiveEcho, CrossWire, Mark
from hw.bench.tank import Look
from hw.bench.world import World
from jaxcal import InputError
from jaxcal.runtime.array_types import Float, UInt8

ROWS, COLUMNS = 480, 640
DEPTH_MM = 90.0
DECIBELS = 60.0

_MARGIN = 160
_CUT = 3.5


class Camera:
    """Draws frames of one world.

    Args:
        world: what there is.
        look: brightness and sizes.
        seed: of the speckle.
    """

    def __init__(self, world: World, look: Look | None = None, seed: int = 0) -> None:
        self.world, self.look = world, Look() if look is None else look
        self.spacing_mm = (world.probe.width_mm / COLUMNS, DEPTH_MM / ROWS)
        rng = np.random.default_rng([seed, 0x5BEC])
        level = 10 ** (-self.look.speckle_db / 20)
        self._envelope = level * _speckle(rng, self._sizes_px())
        self._levels = _compress(self._envelope)
        self._face = self.look.face * _ringing(np.arange(ROWS) * self.spacing_mm[1])
        self._wires = CrossWire(beside_mm=self.look.beside_mm)

    def _sizes_px(self) -> tuple[float, float]:
        """SDs of a spot, px: (axial, lateral)."""
        look, (across, down) = self.look, self.spacing_mm
        return look.axial_mm / down, look.lateral_mm / across

    def pixel(self, lateral_mm: float, range_mm: float) -> tuple[float, float]:
        """[u, v] of a place in the image plane, px; pixel centres are at whole numbers."""
        across, down = self.spacing_mm
        return lateral_mm / across + (COLUMNS - 1) / 2, range_mm / down

    def frame(
        self,
        pose: Float[np.ndarray, "4 4"],
        rng: np.random.Generator,
        *,
        threshold: int = 0,
        pattern: bytes | None = None,
        pattern_delay_s: float = 0.0,
    ) -> UInt8[np.ndarray, "rows columns"]:
        """One frame.

        Args:
            pose: true pose of the tool centre point, tool -> base, mm.
            rng: of this frame's speckle and ghosts.
            threshold: of the response, counts.
            pattern: brightness (0 to 255) of each line; None: no injection.
            pattern_delay_s: how long after the line's pulse was heard the pattern is sent.

        Returns:
            (480, 640) uint8, 60 dB over 255 levels; row 0 is at the element line.

        Raises:
            InputError: a pattern for another number of lines.
        """
        down, right = rng.integers(0, _MARGIN, size=2)
        place = (slice(down, down + ROWS), slice(right, right + COLUMNS))
        levels = self._levels[place].copy()
        envelope = self._envelope[place]
        look, world = self.look, self.world
        marks = world.phantom.marks(world, pose, look, rng, threshold)
        if look.wire > 0 and isinstance(world.phantom, ActiveEcho):
            marks = marks + self._wires.marks(world, pose, look, rng)
        self._draw(levels, envelope, marks)
        if self.look.face > 0:
            rows = int(np.sum(self._face > 1e-3))
            np.maximum(levels[:rows], _compress(self._face[:rows, None]), out=levels[:rows])
        if pattern and world.phantom.answers and world.loudness(pose).max() >= max(threshold, 1):
            _, elevation, axial = world.target(pose)
            below = 0.5e3 * world.sound_speed_m_s * pattern_delay_s
            self._inject(levels, pattern, float(np.hypot(elevation, axial)) + below)
        return levels

    def _draw(self, levels: np.ndarray, envelope: np.ndarray, marks: list[Mark]) -> None:
        """Add spots to the envelope where they are, and compress again there."""
        across, down = self.spacing_mm
        patches = []
        for mark in marks:
            tall, wide = mark.axial_sd_mm / down, mark.lateral_sd_mm / across
            reach_v, reach_u = int(_CUT * tall) + 1, int(_CUT * wide) + 1
            u, v = self.pixel(mark.lateral_mm, mark.range_mm)
            top, bottom = max(int(v) - reach_v, 0), min(int(v) + reach_v + 2, ROWS)
            left, right = max(int(u) - reach_u, 0), min(int(u) + reach_u + 2, COLUMNS)
            if top >= bottom or left >= right:
                continue
            column = np.exp(-0.5 * ((np.arange(top, bottom) - v) / tall) ** 2)
            row = np.exp(-0.5 * ((np.arange(left, right) - u) / wide) ** 2)
            spot = mark.strength * column[:, None] * row
            patches.append((mark.source, slice(top, bottom), slice(left, right), spot))
        if not patches:
            return
        top, left = (min(patch[k].start for patch in patches) for k in (1, 2))
        bottom, right = (max(patch[k].stop for patch in patches) for k in (1, 2))
        total = envelope[top:bottom, left:right].copy()
        for source in {patch[0] for patch in patches}:
            alone = np.zeros_like(total)
            for of, rows, columns, spot in patches:
                if of == source:
                    part = alone[
                        rows.start - top : rows.stop - top,
                        columns.start - left : columns.stop - left,
                    ]
                    np.maximum(part, spot, out=part)
            total += alone
        levels[top:bottom, left:right] = _compress(total)

    def _inject(self, levels: np.ndarray, pattern: bytes, distance: float) -> None:
        """Draw the bar: one column of lines each byte, as thick as two pulses."""
        lines = np.frombuffer(pattern, np.uint8)
        if len(lines) != self.world.probe.elements:
            raise InputError(f"a pattern has a level for each of {self.world.probe.elements} lines")
        v = self.pixel(0.0, distance)[1]
        tall = self._sizes_px()[0]
        top, bottom = max(int(v - tall), 0), min(int(v + tall) + 1, ROWS)
        if top < bottom:
            bar = lines[np.arange(COLUMNS) * len(lines) // COLUMNS]
            np.maximum(levels[top:bottom], bar, out=levels[top:bottom])


def _speckle(rng: np.random.Generator, size_px: tuple[float, float]) -> Float[np.ndarray, "r c"]:
    """Rayleigh envelope of fully developed speckle with a spot's own correlation; RMS 1."""
    shape = (ROWS + _MARGIN, COLUMNS + _MARGIN)
    field = rng.normal(size=(2, *shape))
    waves = np.fft.rfft2(field)
    down, across = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    # A point spread of SD s is a Gaussian of SD 1 / (2 pi s) in frequency.
    tall, wide = size_px
    waves *= np.exp(-2 * np.pi**2 * ((tall * down) ** 2 + (wide * across) ** 2))
    smooth = np.fft.irfft2(waves, shape)
    smooth /= np.sqrt(2) * smooth.std()
    return np.hypot(smooth[0], smooth[1])


def _ringing(range_mm: np.ndarray) -> Float[np.ndarray, " rows"]:
    """Bands under the probe's face, a millimetre apart: the pulse goes to and fro in the lens.

    Assumption: their distance and decay (1.5 mm) are those of common linear probes.
    """
    return np.exp(-range_mm / 1.5) * (0.6 + 0.4 * np.cos(2 * np.pi * range_mm))


def _compress(envelope: np.ndarray) -> UInt8[np.ndarray, "rows columns"]:
    """Envelope (1 is white) to 60 dB in 255 levels."""
    decibel = 20 * np.log10(np.maximum(envelope, 1e-6))
    return np.clip(255.0 * (1 + decibel / DECIBELS), 0, 255).astype(np.uint8)
