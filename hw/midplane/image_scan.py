"""Procedure 4: an amplitude scan by the image, for a phantom without electronics (a cross-wire).

Only in the mid-plane do the two wires show at one place, twice as bright as one wire; beside it
they part. So the intensity (squared envelope) of the brightest place near the expected one has its
maximum in the mid-plane, and beside it falls to a quarter, low enough for
:func:`hw.midplane.amplitude_scan.amplitude_scan` to end there.

:class:`ImageBench` takes the place of the electronics: the intensity stands for the amplitude of
every line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hw.midplane.amplitude_scan import amplitude_scan
from hw.midplane.bracket import Placement
from hw.midplane.search import Echoes, OnStop, Settings
from hw.runtime.errors import Device
from jaxcal.data.segmentation.image import localise
from jaxcal.data.segmentation.speckle import SMALLEST_REGION, NotFoundError, envelope_of
from jaxcal.data.segmentation.spot import brightest
from jaxcal.runtime.array_types import Float, UInt8

LINES = 16
"""Number of lines that are given this intensity; more than the procedures need to be answered."""
FULL_SCALE = 4000.0
"""Intensity of a white pixel: below the converter's full scale, as nothing saturates here."""
DISPLAY_DECIBELS = 60.0
"""Dynamic range of the display over its levels (assumption: usual, and only a scale)."""
COARSE_MM, FINE_MM = 1.0, 0.15
"""Largest steps; the scan finds the beam's middle roughly by half coarse steps."""
SEEN_DB = 14.0
"""A place this far above the background's root mean square is not speckle: within a frame's region
speckle alone reaches about 12 dB (jaxcal.data.segmentation.image)."""


class ImageBench:
    """A bench whose response is what B-mode frames show near an expected place.

    Args:
        move: moves the probe to an offset; returns the offset as tracked, mm.
        see: the next whole frame that began after the last move.
        expected_px: [u, v] where the target should be.
        within_px: look no farther from there.
        credible: answer only where :func:`jaxcal.data.segmentation.image.localise` finds the
            target; it takes longer than the brightest place.
        check: called when the last frame shows something; raises if that frame cannot be trusted.
    """

    device: Device = "ultrasound"
    target = "the target in the image"
    to_check = "the gain and the coupling"

    def __init__(
        self,
        move: Callable[[float], float],
        see: Callable[[], UInt8[np.ndarray, "rows columns"]],
        expected_px: tuple[float, float],
        within_px: float,
        *,
        credible: bool = False,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._move, self._see, self._check = move, see, check
        self._expected, self._within = expected_px, within_px
        self._credible = credible

    def move(self, offset_mm: float) -> float:
        """Go there, arrive, settle; returns the offset as tracked, mm."""
        return self._move(offset_mm)

    def set_threshold(self, threshold: int) -> None:
        """An image has no threshold."""

    def read(self, frames: int) -> Echoes:
        """Intensity of the brightest place in whole frames; one image for three echo frames."""
        told = [self._intensity(self._see()) for _ in range(-(-frames // 3))]
        amplitude = np.repeat(np.array(told)[:, None], LINES, axis=1)
        return Echoes(amplitude, amplitude > 0)

    def _intensity(self, frame: np.ndarray) -> float:
        if self._credible:
            found = localise(frame, "cross", near=self._expected, within_px=self._within)
            if not found.found[0]:
                return 0.0
        intensity = brightest_intensity(frame, self._expected, self._within)
        if intensity > 0:
            self._check()
        return intensity


def brightest_intensity(
    frame: UInt8[np.ndarray, "rows columns"], expected_px: tuple[float, float], within_px: float
) -> float:
    """Squared envelope of the brightest place near an expected one; 0 where nothing stands out."""
    # Only the neighbourhood: a whole frame takes ten times as long.
    reach = int(within_px) + SMALLEST_REGION
    first_column, first_row = (max(int(value) - reach, 0) for value in expected_px)
    last_column, last_row = (max(int(value) + reach, 0) for value in expected_px)
    values = frame[first_row:last_row, first_column:last_column].astype(float)
    if min(values.shape) < SMALLEST_REGION or np.ptp(values) == 0:
        return 0.0
    place = np.asarray(expected_px, float) - [first_column, first_row]
    try:
        envelope = envelope_of(values, frame.dtype, "log", DISPLAY_DECIBELS / 255.0)
        (row, column), _ = brightest(envelope, place, within_px)
    except NotFoundError:
        return 0.0
    # The median of Rayleigh speckle is sqrt(ln 2) of its root mean square.
    rms = float(np.median(envelope)) / np.sqrt(np.log(2.0))
    if 20 * np.log10(max(envelope[row, column], 1e-9) / max(rms, 1e-9)) < SEEN_DB:
        return 0.0
    white = 10 ** ((values[row, column] / 255.0 - 1.0) * DISPLAY_DECIBELS / 20.0)
    return FULL_SCALE * float(white) ** 2


def image_scan(
    bench: ImageBench,
    settings: Settings | None = None,
    start_mm: float = 0.0,
    watch: OnStop | None = None,
) -> Placement:
    """Scan with the robot, fit the maximum of the intensity, go there.

    As :func:`hw.midplane.amplitude_scan.amplitude_scan`; the response's stated accuracy, which is
    of the active echo element, is not used.
    """
    settings = Settings() if settings is None else settings
    # The wires part within half a millimetre: coarse steps of 2 mm would step over the crossing.
    settings = replace(
        settings,
        response_sd_mm=0.0,
        coarse_mm=min(settings.coarse_mm, COARSE_MM),
        fine_mm=min(settings.fine_mm, FINE_MM),
    )
    return amplitude_scan(bench, settings, start_mm, watch)


def pixel_of(
    place_mm: Float[np.ndarray, " 2"], spacing_mm: tuple[float, float], columns: int
) -> tuple[float, float]:
    """[u, v] of [lateral, range]: lateral counts from the middle column, range from row 0."""
    return (
        float(place_mm[0] / spacing_mm[0] + 0.5 * (columns - 1)),
        float(place_mm[1] / spacing_mm[1]),
    )


def place_of(
    pixel: Float[np.ndarray, " 2"], spacing_mm: tuple[float, float], columns: int
) -> Float[np.ndarray, " 2"]:
    """[lateral, range] of [u, v], mm; the inverse of :func:`pixel_of`."""
    return np.array([(pixel[0] - 0.5 * (columns - 1)) * spacing_mm[0], pixel[1] * spacing_mm[1]])
