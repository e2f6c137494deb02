"""Procedure 3: coarse, fine, and then raise the response threshold until any small move loses it.

At a threshold T the element answers within w sqrt(2 ln(A / T)) of the mid-plane. Both edges of that
stretch are searched from below, the middle between them becomes the new place, and T rises until
the stretch is so short that a move of epsilon either way loses the response. Because the two edges
lie on equal flanks, the middle does not depend on the beam's thickness or on the amplitude's scale.
The middle must agree with the fine scan's maximum (procedure 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.midplane.amplitude_scan import Peak, scan_up
from hw.midplane.bracket import Placement
from hw.midplane.search import Bench, OnStop, PlacementError, Settings, Walker, coarse

_FIRST_FRACTION = 0.75
_MOST_ROUNDS = 8
_STEPS_PER_HALF = 4


@dataclass(frozen=True)
class Edges:
    """Where the response begins and ends at one threshold, mm.

    Attributes:
        middle_mm: half way between.
        half_mm: half of the stretch.
        sd_mm: standard deviation of the middle.
    """

    middle_mm: float
    half_mm: float
    sd_mm: float


def find_edges(walker: Walker, middle_mm: float, half_mm: float) -> Edges | None:
    """Both loss edges at the threshold in force, scanned upwards.

    Args:
        walker: with the threshold set.
        middle_mm: where the middle of the stretch is expected.
        half_mm: expected half length of the stretch.

    Returns:
        The edges, or None where nothing was heard: the threshold is too high.

    Raises:
        PlacementError: a cap was reached.
    """
    settings = walker.settings
    step = float(np.clip(half_mm / _STEPS_PER_HALF, settings.finest_mm, settings.fine_mm))
    # Stops miss by the repeatability: near an edge the answers come and go over this length.
    blur = 3 * settings.position_sd_mm
    offset = middle_mm - half_mm - blur
    where, echoes = walker.stop_at(offset)
    # Begin where nothing is heard: otherwise the lower edge would be missed.
    while echoes.heard:
        offset -= max(2 * step, blur)
        where, echoes = walker.stop_at(offset)
    heard: list[float] = []
    while True:
        offset += step
        where, echoes = walker.stop_at(offset)
        if echoes.heard:
            heard.append(where)
        elif heard and where - heard[-1] > max(1.5 * step, blur):
            break
        elif not heard and where > middle_mm + 2 * half_mm + blur:
            return None
    # From mean and number of the heard stops: random errors of the stops cancel in both.
    middle, half = float(np.mean(heard)), 0.5 * step * len(heard)
    spread = np.hypot(step / np.sqrt(24.0), settings.position_sd_mm / np.sqrt(2.0))
    return Edges(middle, half, float(spread))


def climb(walker: Walker, peak: Peak) -> Edges:
    """Raise the threshold until the stretch is within epsilon.

    Raises:
        PlacementError: a cap was reached, or the response is lost for good.
    """
    settings = walker.settings
    middle, top = peak.place_mm, peak.amplitude
    fraction, reached = _FIRST_FRACTION, 0.0
    best: Edges | None = None
    for _ in range(_MOST_ROUNDS):
        walker.set_threshold(fraction * top)
        half = peak.width_mm * float(np.sqrt(-2 * np.log(fraction)))
        edges = find_edges(walker, middle, half)
        if edges is None:
            # Too high: the middle was off, or the amplitude has fallen.
            walker.recover()
            walker.notes.append(f"not heard at {fraction:.0%} of the maximum; lowered")
            fraction = 0.5 * (reached + fraction)
            continue
        best, middle, reached = edges, edges.middle_mm, fraction
        if edges.half_mm + 2 * settings.position_sd_mm <= settings.epsilon_mm and _lost_beside(
            walker, edges
        ):
            return edges
        if fraction >= settings.top_fraction:
            break
        fraction = min(settings.top_fraction, 1 - 0.4 * (1 - fraction))
    if best is None:
        raise PlacementError("the response was lost at every threshold that was tried")
    walker.notes.append(
        f"the beam is too thick for +-{settings.epsilon_mm:g} mm: ended at +-{best.half_mm:.2f} mm"
    )
    return best


def threshold_climb(
    bench: Bench,
    settings: Settings | None = None,
    start_mm: float = 0.0,
    watch: OnStop | None = None,
) -> Placement:
    """Coarse raster, fine scan, threshold climb; the probe ends half way between the loss edges.

    Arguments as of :func:`hw.midplane.search.first_seen`.

    Returns:
        A placement whose bracket holds the last stretch, widened by the errors that no search sees.

    Raises:
        PlacementError: given up, or the climb and the fine scan contradict each other.
    """
    with Walker(bench, settings, watch) as walker:
        settings = walker.settings
        peak = scan_up(walker, coarse(walker, start_mm), 2 * settings.fine_mm)
        edges = climb(walker, peak)
        if _apart(edges, peak, settings):
            walker.notes.append("climb and loudest place disagreed; scanned and climbed once more")
            walker.set_threshold(settings.low_threshold)
            peak = scan_up(walker, peak.place_mm - settings.coarse_mm, settings.fine_mm)
            edges = climb(walker, peak)
        apart = _apart(edges, peak, settings)
        if apart:
            raise PlacementError(
                f"the threshold climb ends {apart:+.2f} mm from the place of the largest "
                "amplitude: the beam is asymmetric, or the target moved"
            )
        walker.set_threshold(settings.low_threshold)
        _, echoes = walker.stop_at(edges.middle_mm)
        if not echoes.heard:
            walker.recover()
            raise PlacementError("the response was lost at the place that the climb found")
        return walker.placement(edges.middle_mm, edges.half_mm, edges.sd_mm)


def _apart(edges: Edges, peak: Peak, settings: Settings) -> float:
    """Distance of the middle from the loudest place, mm; 0 where the two may be the same."""
    apart = edges.middle_mm - peak.place_mm
    allowed = edges.half_mm + settings.factor * float(np.hypot(peak.sd_mm, edges.sd_mm))
    return apart if abs(apart) > allowed else 0.0


def _lost_beside(walker: Walker, edges: Edges) -> bool:
    """Whether a move of epsilon either way loses the response, so that the climb may end."""
    epsilon = walker.settings.epsilon_mm
    sides = (edges.middle_mm - epsilon, edges.middle_mm + epsilon)
    return not any(walker.stop_at(side)[1].heard for side in sides)
