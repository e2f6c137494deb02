"""B-mode frames of the simulated world: speckle, the active echo, its pattern, the cross-wires.

Speckle is drawn once, as a field larger than a frame, and cut out at a new place for every frame; a
spot is added to the envelope in its own small patch before log compression. So a 640 x 480 frame
costs a fraction of a millisecond, whatever is in it.

The element answers with one pulse a line: in the image a spot at its range, as long as it answers;
an injected pattern is a bar of lines beneath it. Wires are passive: they show where the beam's
thickness crosses them, a crossing with tails, beside the element at the same height (section 3.2 of
the paper).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.bench.world import World
from hw.shapes import Float, UInt8
from jaxcal import InputError

ROWS, COLUMNS = 480, 640
DEPTH_MM = 90.0
DECIBELS = 60.0

_MARGIN = 160
_SPECKLE = 10 ** (-34.0 / 20)
_WIRE_HALF_MM = 30.0
_MOST_SPOTS = 48
_CUT = 3.5


@dataclass(frozen=True)
class Look:
    """How bright things are, as envelopes of at most 1, and how large.

    Attributes:
        echo: the active echo of a line at full amplitude.
        wire: a wire in the mid-plane; 0: there are no cross-wires.
        ghost: the echo's reflection, later by ``ghost_mm``; 0: none.
        ghost_mm: its detour.
        axial_mm: SD of a spot along the axial direction.
        lateral_mm: likewise lateral.
        beside_mm: where the wires cross, from the element, in the base frame.
    """

    echo: float = 0.9
    wire: float = 0.25
    ghost: float = 0.08
    ghost_mm: float = 7.0
    axial_mm: float = 0.35
    lateral_mm: float = 0.6
    beside_mm: tuple[float, float, float] = (12.0, 9.0, 0.0)


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
        self._envelope = _speckle(rng, self._sizes_px())
        self._levels = _compress(self._envelope)

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
        patches: list[tuple[float, float, float]] = []
        look, world = self.look, self.world
        loud = world.loudness(pose)
        lateral, elevation, axial = world.target(pose)
        distance = float(np.hypot(elevation, axial))
        best = int(np.argmax(loud))
        if loud[best] >= max(threshold, 1):
            strength = look.echo * min(float(loud[best]) / world.beam.peak, 1.0)
            patches.append((lateral, distance, strength))
            if look.ghost > 0 and rng.random() < 0.5:
                patches.append((lateral, distance + look.ghost_mm, strength * look.ghost))
        if look.wire > 0:
            patches += self._wires(pose)
        self._draw(levels, envelope, patches)
        if pattern and loud[best] >= max(threshold, 1):
            below = 0.5e3 * world.sound_speed_m_s * pattern_delay_s
            self._inject(levels, pattern, distance + below)
        return levels

    def _wires(self, pose: np.ndarray) -> list[tuple[float, float, float]]:
        """Places of the wires that the beam's thickness shows: lateral, range, strength."""
        world, look = self.world, self.look
        x = world.image_to_probe
        crossing = world.target_of(pose, world.point_mm + np.asarray(look.beside_mm))
        shown = []
        for direction in ((0.8, 0.6, 0.0), (-0.6, 0.8, 0.0)):
            along = np.asarray(direction) @ pose[:3, :3] @ x[:3, :3]
            width = float(world.beam.width_mm(crossing[2]))
            steep = max(abs(along[1]), 2 * width / _WIRE_HALF_MM)
            reach = 2 * width / steep
            middle = float(np.clip(-crossing[1] / along[1], -_WIRE_HALF_MM, _WIRE_HALF_MM))
            count = min(int(2 * reach / look.lateral_mm) + 2, _MOST_SPOTS)
            for way in middle + reach * np.linspace(-1.0, 1.0, count):
                at = crossing + way * along
                if at[2] > 0 and abs(way) <= _WIRE_HALF_MM:
                    strength = look.wire * float(np.exp(-0.5 * (at[1] / width) ** 2))
                    shown.append((at[0], float(np.hypot(at[1], at[2])), strength))
        return shown

    def _draw(
        self,
        levels: np.ndarray,
        envelope: np.ndarray,
        patches: list[tuple[float, float, float]],
    ) -> None:
        """Add Gaussian spots to the envelope, each in its own patch, and compress again."""
        tall, wide = self._sizes_px()
        reach_v, reach_u = int(_CUT * tall) + 1, int(_CUT * wide) + 1
        for lateral, distance, strength in patches:
            u, v = self.pixel(lateral, distance)
            top, bottom = max(int(v) - reach_v, 0), min(int(v) + reach_v + 2, ROWS)
            left, right = max(int(u) - reach_u, 0), min(int(u) + reach_u + 2, COLUMNS)
            if top >= bottom or left >= right:
                continue
            column = np.exp(-0.5 * ((np.arange(top, bottom) - v) / tall) ** 2)
            row = np.exp(-0.5 * ((np.arange(left, right) - u) / wide) ** 2)
            spot = strength * column[:, None] * row + envelope[top:bottom, left:right]
            part = levels[top:bottom, left:right]
            np.maximum(part, _compress(spot), out=part)

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
    """Rayleigh envelope of fully developed speckle with the spot's own correlation."""
    shape = (ROWS + _MARGIN, COLUMNS + _MARGIN)
    field = rng.normal(size=(2, *shape))
    waves = np.fft.rfft2(field)
    down, across = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    # A point spread of SD s is a Gaussian of SD 1 / (2 pi s) in frequency.
    tall, wide = size_px
    waves *= np.exp(-2 * np.pi**2 * ((tall * down) ** 2 + (wide * across) ** 2))
    smooth = np.fft.irfft2(waves, shape)
    smooth *= _SPECKLE / np.sqrt(2) / smooth.std()
    return np.hypot(smooth[0], smooth[1])


def _compress(envelope: np.ndarray) -> UInt8[np.ndarray, "rows columns"]:
    """Envelope (1 is white) to 60 dB in 255 levels."""
    decibel = 20 * np.log10(np.maximum(envelope, 1e-6))
    return np.clip(255.0 * (1 + decibel / DECIBELS), 0, 255).astype(np.uint8)
