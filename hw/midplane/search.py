"""What the placement procedures share: the bench they need, guards, coarse search.

Offsets are mm along the probe's elevational axis from the plan's pose; moving the probe by +1 mm
moves the target by -1 mm in the image.

Guards: every stop is approached from the same side, so that lost motion of the arm has no effect.
Moves, travel and reach are capped. Amplitudes at the converter's full scale are not used. When the
response is lost, the probe goes back to the last good place; if nothing is heard there either, the
placement is given up.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from hw.midplane.bracket import Bracket, Placement
from hw.runtime.errors import Device, DeviceError
from jaxcal import InputError
from jaxcal.runtime.array_types import Bool, Float

_TOP_LINES = 8
_ANSWERING_LINES = 4
_LISTEN_AGAIN = 3
_DEVICE: Device = "active echo"

MOST_FRAMES = 256
"""Most active-echo frames that are listened to at once."""
_LONGEST_MM = 50.0
"""Of every length in :class:`Settings`; [limits] allow no wider search."""
_MOST = {
    "low_threshold": 4095,
    "frames": MOST_FRAMES,
    "top_fraction": 0.99,
    "most_moves": 10_000,
    "most_travel_mm": 10_000.0,
    "full_scale": 65_535.0,
    "factor": 10.0,
}
"""Of the others."""
_LEAST: dict[str, float] = {
    "coarse_mm": 0.01,
    "fine_mm": 0.01,
    "finest_mm": 0.01,
    "epsilon_mm": 0.01,
}
"""Of the steps: no robot makes shorter ones, and a raster of 1e-12 mm is more than any memory."""
_POSITIVE = ("frames", "top_fraction", "most_moves", "full_scale", "factor")

OnStop = Callable[[float, float, int], None]
"""Told of a stop: offset (mm), amplitude (counts), threshold."""


class PlacementError(DeviceError):
    """A placement was given up; one line says why. The probe is at the last good place, if any."""

    def __init__(self, message: str, *, device: Device = _DEVICE) -> None:
        super().__init__(message, device=device)


@dataclass(frozen=True)
class Echoes:
    """Some frames of the active echo.

    Attributes:
        amplitude: (frames, lines) counts, 0 where a line was not answered.
        answered: (frames, lines) whether the line was answered.
    """

    amplitude: Float[np.ndarray, "frames lines"]
    answered: Bool[np.ndarray, "frames lines"]

    @property
    def heard(self) -> bool:
        """Whether at least four lines were answered in more than half of the frames."""
        if not len(self.answered):
            return False
        return bool(np.median(self.answered.sum(axis=1)) >= _ANSWERING_LINES)

    @property
    def peak(self) -> float:
        """Median over the frames of the mean of the eight loudest lines, counts; 0 if not heard."""
        if not self.heard:
            return 0.0
        loudest = np.sort(self.amplitude, axis=1)[:, -_TOP_LINES:]
        return float(np.median(loudest.mean(axis=1)))

    @property
    def loudest_line(self) -> int:
        """The line that was heard best."""
        return int(np.argmax(self.amplitude.sum(axis=0))) if len(self.amplitude) else 0

    def saturated(self, full_scale: float) -> bool:
        """Whether any line reached the converter's full scale in more than half of the frames."""
        return bool(len(self.amplitude) and np.median(self.amplitude.max(axis=1)) >= full_scale)


@runtime_checkable
class Bench(Protocol):
    """What a procedure needs; :class:`hw.acquisition.stage.ProbeStage` has it of real devices."""

    device: Device
    """By which the target is heard or seen."""
    target: str
    """What is looked for, in words."""
    to_check: str
    """What to check where it does not respond, in words."""

    def move(self, offset_mm: float) -> float:
        """Go there, arrive, settle; returns the offset as tracked, mm."""
        ...

    def read(self, frames: int) -> Echoes:
        """Listen to whole frames that began after the last move."""
        ...

    def set_threshold(self, threshold: int) -> None:
        """Set the amplitude (counts) from which the element answers."""
        ...


@dataclass(frozen=True)
class Settings:
    """How to search, and what accuracies to state.

    Attributes:
        low_threshold: counts; the element then answers far from the mid-plane.
        span_mm: the coarse raster reaches this far to either side of its start.
        coarse_mm: its step.
        fine_mm: largest step of the fine scan.
        finest_mm: least step of the fine scan and of the threshold climb.
        frames: active-echo frames to listen to at every stop.
        backlash_mm: every stop is approached from this far below.
        hysteresis_mm: coming back to the maximum must find it within this.
        epsilon_mm: the climb is done when a move this far either way loses the response.
        top_fraction: the climb's highest threshold, as a part of the amplitude at the maximum.
        most_moves: cap on single moves.
        most_travel_mm: cap on the way.
        reach_mm: cap on the offset either way.
        full_scale: amplitude at which the converter saturates, counts.
        response_sd_mm: stated accuracy of the response's mid-plane; no search sees this error.
        position_sd_mm: stated repeatability of a stop.
        beam_half_mm: how far off the mid-plane the target may be and still be heard at all.
        factor: half width of a bracket in SDs: 2.58 holds 99 of 100.
    """

    low_threshold: int = 100
    span_mm: float = 9.0
    coarse_mm: float = 2.0
    fine_mm: float = 0.25
    finest_mm: float = 0.05
    frames: int = 3
    backlash_mm: float = 0.5
    hysteresis_mm: float = 0.6
    epsilon_mm: float = 0.7
    top_fraction: float = 0.96
    most_moves: int = 200
    most_travel_mm: float = 150.0
    reach_mm: float = 20.0
    full_scale: float = 4095.0
    response_sd_mm: float = 0.3
    position_sd_mm: float = 0.1
    beam_half_mm: float = 5.0
    factor: float = 2.58

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value, most = getattr(self, name), _MOST.get(name, _LONGEST_MM)
            least, positive = _LEAST.get(name, 0.0), name in _POSITIVE
            if not (least <= value <= most and (value > 0 or not positive)):
                bounds = f"above 0 and at most {most:g}" if positive else f"{least:g} to {most:g}"
                raise InputError(f"{name} must be {bounds}, not {value}")

    def bracket(self, centre_mm: float, half_mm: float, sd_mm: float) -> Bracket:
        """A bracket from what a search found and the independent errors that it cannot see.

        Args:
            centre_mm: best guess of the target's offset.
            half_mm: from there to either edge as seen.
            sd_mm: SD of the guess itself.

        Returns:
            Its ends: their distance from the centre is the root of the summed squares of
            ``half_mm`` and of ``factor`` times the SD of the hidden errors.
        """
        # The response's shift, and the last stop's repeatability.
        hidden = np.hypot(self.response_sd_mm, self.position_sd_mm)
        half, sd = float(np.hypot(half_mm, self.factor * hidden)), float(np.hypot(sd_mm, hidden))
        return Bracket(centre_mm, centre_mm - half, centre_mm + half, sd)


class Walker:
    """Moves and listens on behalf of one placement, and keeps its guards; a context manager.

    When a search within it gives up (:class:`PlacementError`), the probe is left at the last good
    place. After any other error nothing is moved here.

    Args:
        bench: what to move and listen to.
        settings: caps and steps; None: the default ones.
        watch: told of every stop.
    """

    def __init__(
        self, bench: Bench, settings: Settings | None = None, watch: OnStop | None = None
    ) -> None:
        self._bench, self._watch = bench, watch
        self.target, self.cure = bench.target, f"check {bench.to_check}"
        self.settings = Settings() if settings is None else settings
        self._at: float | None = None
        self.where = 0.0
        self.good: float | None = None
        self._good_amplitude = 0.0
        self.threshold = -1
        self.moves, self.travel_mm = 0, 0.0
        self.samples: list[tuple[float, float, int]] = []
        self.notes: list[str] = []

    def __enter__(self) -> Walker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, *_: object
    ) -> None:
        if isinstance(error, PlacementError):
            if error.device == _DEVICE:
                # The search itself gave up.
                error.device = self._bench.device
            self._leave()

    def _move(self, offset: float) -> None:
        settings = self.settings
        if abs(offset) > settings.reach_mm:
            raise PlacementError(
                f"the search would have to go {offset:.1f} mm from the planned pose, but may go "
                f"only {settings.reach_mm:g} mm"
            )
        if self.moves >= settings.most_moves:
            raise PlacementError(f"the mid-plane was not found within {self.moves} moves")
        step = abs(offset - (self._at if self._at is not None else 0.0))
        if self.travel_mm + step > settings.most_travel_mm:
            raise PlacementError(
                f"the mid-plane was not found within {settings.most_travel_mm:g} mm of travel"
            )
        self.where = self._bench.move(offset)
        self._at = offset
        self.moves += 1
        self.travel_mm += step

    def go(self, offset: float) -> float:
        """Go to an offset (mm) from below; returns where the probe is as tracked."""
        if self._at is None or offset <= self._at:
            self._move(offset - self.settings.backlash_mm)
        self._move(offset)
        return self.where

    def set_threshold(self, threshold: int | float) -> None:
        """Set the response threshold, counts."""
        threshold = int(np.clip(round(threshold), 0, self.settings.full_scale))
        if threshold != self.threshold:
            self._bench.set_threshold(threshold)
            self.threshold = threshold

    def listen(self) -> Echoes:
        """Listen where the probe stands; remembers the place if it is heard."""
        echoes = self._bench.read(self.settings.frames)
        # A place where the response is much weaker is not kept as a good place.
        if echoes.heard and (self.good is None or echoes.peak >= 0.5 * self._good_amplitude):
            self.good, self._good_amplitude = self._at, echoes.peak
        self.samples.append((self.where, echoes.peak, self.threshold))
        if self._watch is not None:
            self._watch(*self.samples[-1])
        return echoes

    def stop_at(self, offset: float) -> tuple[float, Echoes]:
        """Go there and listen: offset as tracked (mm), and what was heard."""
        where = self.go(offset)
        return where, self.listen()

    def recover(self) -> None:
        """Go back to the last good place after the response was lost.

        Raises:
            PlacementError: the target does not respond there either, or never did.
        """
        self.set_threshold(self.settings.low_threshold)
        if self.good is None:
            raise PlacementError(f"no response of {self.target} anywhere: {self.cure}")
        place = self.good
        for _ in range(_LISTEN_AGAIN):
            self.go(place)
            if self.listen().heard:
                return
        raise PlacementError(
            f"the response of {self.target} was lost, and is not at {place:+.2f} mm any more, "
            f"where it was: {self.cure}"
        )

    def _leave(self) -> None:
        """Put the low threshold back and, if there is one, go to the last good place."""
        self.set_threshold(self.settings.low_threshold)
        if self.good is not None and self._at is not None and self._at != self.good:
            self.moves, self.travel_mm = 0, 0.0
            # The probe was there before; only the approach from below may exceed the reach.
            with contextlib.suppress(PlacementError):
                self.go(self.good)

    def placement(self, middle_mm: float, half_mm: float, sd_mm: float) -> Placement:
        """The result where the probe stands.

        Args:
            middle_mm: offset of the mid-plane.
            half_mm: from there to either edge as seen.
            sd_mm: SD of the middle itself.
        """
        # The target's offset in the image is the mid-plane's place minus the probe's.
        bracket = self.settings.bracket(middle_mm - self.where, half_mm, sd_mm)
        samples = np.array(self.samples, float).reshape(-1, 3)
        return Placement(bracket, self.where, self.moves, samples, tuple(self.notes))


def coarse(walker: Walker, start_mm: float = 0.0) -> float:
    """Step 1: an elevational raster at the low threshold until the target responds.

    A narrow raster about ``start_mm`` comes first: most plans are nearly right.

    Returns:
        An offset at which the target responds, mm.

    Raises:
        PlacementError: it is heard nowhere, or a cap was reached.
    """
    settings = walker.settings
    walker.set_threshold(settings.low_threshold)
    tried = 0.0
    for half in (2 * settings.coarse_mm, settings.span_mm):
        half = min(half, settings.span_mm)
        for offset in np.arange(-half, half + 1e-9, settings.coarse_mm):
            if tried and abs(offset) < tried:
                continue
            _, echoes = walker.stop_at(start_mm + float(offset))
            if echoes.heard:
                return start_mm + float(offset)
        tried = half
    raise PlacementError(
        f"no response of {walker.target} within {settings.span_mm:g} mm to either side: "
        f"{walker.cure}, and the plan's pose"
    )


def first_seen(
    bench: Bench,
    settings: Settings | None = None,
    start_mm: float = 0.0,
    watch: OnStop | None = None,
) -> Placement:
    """No placement: stop as soon as the element is heard, as conventional practice would.

    Args:
        bench: what to move and listen to.
        settings: how to search; None: the default ones.
        start_mm: where the mid-plane is expected, as an offset from the plan's pose.
        watch: told of every stop.

    Returns:
        A placement whose bracket reaches as far as the element may be heard.

    Raises:
        PlacementError: it is heard nowhere.
    """
    with Walker(bench, settings, watch) as walker:
        coarse(walker, start_mm)
        half = walker.settings.beam_half_mm
        return walker.placement(walker.where, half, half / np.sqrt(3.0))
