"""Procedure 1: scan across the beam and go where the response is loudest.

Across the beam the amplitude is nearly Gaussian, so its logarithm is a parabola near the maximum.
A weighted linear fit gives the maximum between the steps, and its residuals give the SD. The
residuals also hold the errors of the stops (the robot's repeatability).

The same fit serves a free-hand sweep, whose places come from the tracker.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.midplane.bracket import Bracket, Placement
from hw.midplane.search import Bench, OnStop, PlacementError, Settings, Walker, coarse
from jaxcal.runtime.array_types import Float

LEAST_FRACTION = 0.4
"""Samples below this part of the loudest are not used: they show the beam's skirts."""
_LEAST_SAMPLES = 5


@dataclass(frozen=True)
class Peak:
    """A maximum between the samples.

    Attributes:
        place_mm: where it is.
        sd_mm: its standard deviation.
        amplitude: fitted, counts.
        width_mm: SD of the Gaussian across the beam.
    """

    place_mm: float
    sd_mm: float
    amplitude: float
    width_mm: float

    def bracket(self, where_mm: float, settings: Settings) -> Bracket:
        """Where the target's offset lies in an image that was taken at ``where_mm``."""
        half = settings.factor * self.sd_mm
        return settings.bracket(self.place_mm - where_mm, half, self.sd_mm)


def fit_peak(
    offsets_mm: Float[np.ndarray, " n"],
    amplitudes: Float[np.ndarray, " n"],
    full_scale: float = Settings.full_scale,
) -> Peak:
    """The maximum of a Gaussian profile, by a parabola through the logarithm.

    Args:
        offsets_mm: where the samples were taken, in any order.
        amplitudes: counts; 0: not heard. Those near ``full_scale`` are clipped and not used.
        full_scale: of the converter, counts.

    Raises:
        PlacementError: too few samples, or no maximum among them.
    """
    where, loud = np.asarray(offsets_mm, float), np.asarray(amplitudes, float)
    clipped = loud >= 0.98 * full_scale
    usable = (loud > LEAST_FRACTION * loud.max(initial=0.0)) & ~clipped & (loud > 0)
    where, loud = where[usable], loud[usable]
    if len(where) < _LEAST_SAMPLES:
        why = "the amplitude saturates: turn the gain down" if clipped.any() else "scan finer"
        raise PlacementError(f"only {len(where)} usable samples near the maximum: {why}")
    middle = float(np.average(where, weights=loud))
    x, y = where - middle, np.log(loud)
    # The amplitude's errors are nearly equal in counts, so those of its logarithm go as 1/A.
    design = np.stack([np.ones_like(x), x, x**2], axis=1) * loud[:, None]
    coefficients, *_ = np.linalg.lstsq(design, y * loud, rcond=None)
    top, slope, curvature = coefficients
    if not curvature < 0:
        raise PlacementError("the response has no maximum inside the scan")
    x_peak = -slope / (2 * curvature)
    if not x.min() <= x_peak <= x.max():
        raise PlacementError(
            f"the maximum lies outside the scan, near {middle + x_peak:+.2f} mm: widen it"
        )
    residual = design @ coefficients - y * loud
    variance = residual @ residual / max(len(x) - 3, 1)
    covariance = variance * np.linalg.inv(design.T @ design)
    gradient = np.array([0.0, -1 / (2 * curvature), slope / (2 * curvature**2)])
    return Peak(
        place_mm=middle + float(x_peak),
        sd_mm=float(np.sqrt(gradient @ covariance @ gradient)),
        amplitude=float(np.exp(top - slope**2 / (4 * curvature))),
        width_mm=float(np.sqrt(-0.5 / curvature)),
    )


def scan_up(walker: Walker, start_mm: float, step_mm: float) -> Peak:
    """Cross the beam upwards, from skirt to skirt, and fit the maximum.

    First coarse steps find where the beam is and how thick, so that the fine steps cover only its
    middle; a thin beam is scanned in finer steps.

    Args:
        walker: at the low threshold.
        start_mm: where the element is heard first, coming from below.
        step_mm: largest step of the scan.

    Raises:
        PlacementError: a cap was reached, the amplitude saturates, or there is no maximum.
    """
    settings = walker.settings
    middle, width = _overview(walker, start_mm)
    step = float(np.clip(0.35 * width, settings.finest_mm, step_mm))
    offset = middle - 1.4 * width
    where, echoes = walker.stop_at(offset)
    # The coarse steps may be wrong: go down until the scan begins on the lower skirt.
    loudest = max(amplitude for _, amplitude, _ in walker.samples)
    while echoes.peak > LEAST_FRACTION * loudest:
        offset -= width
        where, echoes = walker.stop_at(offset)
        loudest = max(loudest, echoes.peak)
    offsets: list[float] = []
    loud: list[float] = []
    while True:
        clipped = echoes.saturated(settings.full_scale)
        offsets.append(where)
        # Of a clipped sample only the place is known; the fit leaves it out.
        loud.append(settings.full_scale if clipped else echoes.peak)
        best = max(loud)
        if loud[-1] < LEAST_FRACTION * best and best >= 0.7 * loudest:
            break
        if not echoes.heard and offset > middle + settings.span_mm:
            walker.recover()
            break
        offset += step
        where, echoes = walker.stop_at(offset)
    return fit_peak(np.array(offsets), np.array(loud), settings.full_scale)


def _overview(walker: Walker, start_mm: float) -> tuple[float, float]:
    """Middle and SD (mm) of the beam, roughly, from half coarse steps up until it fades."""
    settings, first = walker.settings, len(walker.samples)
    loudest, offset = 0.0, start_mm
    while True:
        _, echoes = walker.stop_at(offset)
        loudest = max(loudest, echoes.peak)
        if echoes.peak < LEAST_FRACTION * loudest or offset > start_mm + settings.span_mm:
            break
        offset += 0.5 * settings.coarse_mm
    x, level, _ = np.array(walker.samples[first:]).T
    best = int(np.argmax(level))
    if level[best] == 0:
        walker.recover()
        return start_mm, 0.5 * settings.coarse_mm
    heard = (level > 0) & (np.abs(np.arange(len(level)) - best) <= 2)
    if heard.sum() >= 3:
        curvature, slope, _ = np.polyfit(x[heard] - x[best], np.log(level[heard]), 2)
        if curvature < 0:
            width = float(np.sqrt(-0.5 / curvature))
            middle = float(np.clip(-slope / (2 * curvature), -settings.coarse_mm, width))
            return x[best] + middle, min(width, settings.coarse_mm)
    return float(x[best]), 0.5 * settings.coarse_mm


def go_to_peak(walker: Walker, peak: Peak) -> None:
    """Go to a fitted maximum from below, and check by the amplitude that it is there.

    Raises:
        PlacementError: the amplitude says that the maximum is elsewhere: the motion has hysteresis,
            or the target moved.
    """
    _, echoes = walker.stop_at(peak.place_mm)
    if not echoes.heard:
        walker.recover()
        _, echoes = walker.stop_at(peak.place_mm)
    if not echoes.saturated(walker.settings.full_scale):
        ratio = max(peak.amplitude / max(echoes.peak, 1e-9), 1.0)
        off = peak.width_mm * float(np.sqrt(2 * np.log(ratio)))
        if off > walker.settings.hysteresis_mm:
            raise PlacementError(
                f"back at the maximum the amplitude is that of {off:.2f} mm beside it: the motion "
                "has hysteresis, or the target moved"
            )


def amplitude_scan(
    bench: Bench,
    settings: Settings | None = None,
    start_mm: float = 0.0,
    watch: OnStop | None = None,
) -> Placement:
    """Scan with the robot, fit the maximum, go there.

    Arguments as of :func:`hw.midplane.search.first_seen`.
    """
    with Walker(bench, settings, watch) as walker:
        settings = walker.settings
        peak = scan_up(walker, coarse(walker, start_mm), settings.fine_mm)
        try:
            go_to_peak(walker, peak)
        except PlacementError:
            walker.notes.append("the maximum was not found again; scanned once more")
            peak = scan_up(walker, peak.place_mm - settings.coarse_mm, settings.fine_mm)
            go_to_peak(walker, peak)
        return walker.placement(peak.place_mm, settings.factor * peak.sd_mm, peak.sd_mm)
