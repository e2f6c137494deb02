"""Procedure 2: the element draws what it hears into the image, and a person follows it.

The injected pattern is a bar beside the echo. Its length and brightness follow the received
amplitude, so the image itself shows the operator how near the mid-plane is: the bar is longest
there. The operator moves the probe in steps, looks at both sides, goes back to the middle and
accepts. An operator who accepts before the bar was seen to shrink on *both* sides is asked to look
again, because a bracket needs both sides.

The operator is a callable: a person before a live view (:mod:`hw.midplane.live_view`) or
:class:`SteadyOperator`, which follows by rule the instructions given to a person.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from hw.midplane.bracket import Placement
from hw.midplane.search import Bench, OnStop, PlacementError, Settings, Walker, coarse
from hw.runtime.errors import DeviceError
from jaxcal import InputError
from jaxcal.runtime.array_types import UInt8

LONGEST = 31
"""Lines that the longest bar covers; also the number of lengths an operator can tell apart."""
_DARKEST = 64
_MOST_LOOKS = 150
_VISIBLE_DROP = 4
_LEAST_SHORT = 2
_SAME_PLACE_MM = 0.05
_SWEEP_MM = 0.25
"""Step of the operator who follows the instructions by rule."""
BAR_DELAY_S = 4e-6
"""How long after the echo the bar is sent: it appears 3 mm below the echo."""
# The bar's scale begins at this part of the maximum, so that a few per cent near it can be seen.
_SCALE_FROM = 0.4


@runtime_checkable
class Injector(Protocol):
    """The part of the electronics that answers with a pattern (see the active echo's driver)."""

    def load_pattern(self, pattern: bytes) -> object:
        """A level (0 to 255) for each line."""
        ...

    def inject(self, on: bool, delay_s: float = 0.0) -> object:
        """Switch injection on or off; the delay puts the pattern below the echo."""
        ...


def bar_length(amplitude: float, loudest: float) -> int:
    """How many lines the bar covers, 0 to 31; ``loudest`` is the amplitude of the longest bar."""
    if loudest <= 0 or amplitude <= 0:
        return 0
    level = (amplitude / loudest - _SCALE_FROM) / (1 - _SCALE_FROM)
    return int(np.clip(round(level * LONGEST), 1, LONGEST))


def bar(length: int, line: int, lines: int) -> bytes:
    """The pattern of a bar: a level for each line, brighter the longer it is.

    Args:
        length: lines that are bright, 0 to 31.
        line: middle of the bar; what reaches beyond the first or last line is cut off.
        lines: of the probe.

    Raises:
        InputError: an impossible length or line.
    """
    if not (0 <= length <= LONGEST and 0 <= line < lines):
        raise InputError(f"a bar has 0 to {LONGEST} lines about one of {lines}: {length}, {line}")
    pattern = np.zeros(lines, np.uint8)
    first = line - length // 2
    level = _DARKEST + (255 - _DARKEST) * length // LONGEST
    pattern[max(first, 0) : max(first + length, 0)] = level
    return pattern.tobytes()


class SkippedError(PlacementError):
    """The operator skipped the pose; the probe is at the last good place."""


Frame = UInt8[np.ndarray, "rows columns"]


def _no_frame() -> None:
    return None


@dataclass(frozen=True)
class View:
    """What the operator sees.

    Attributes:
        seen: (offset in mm, length of the bar in lines) of every look so far, this one last.
        step_mm: of the next move; 0 where a hand moves the probe.
        frame: gives the newest B-mode frame, or None where there is none; raises the error of a
            device that is lost while the operator looks.
        message: what the procedure has to say.
        title: which pose this is.
    """

    seen: tuple[tuple[float, int], ...]
    step_mm: float = 0.0
    frame: Callable[[], Frame | None] = _no_frame
    message: str = ""
    title: str = ""

    @property
    def offset_mm(self) -> float:
        """Where the probe is."""
        return self.seen[-1][0]

    @property
    def length(self) -> int:
        """Of the bar, lines."""
        return self.seen[-1][1]

    @property
    def longest(self) -> int:
        """Length of the longest bar seen so far, lines."""
        return max(length for _, length in self.seen)


@dataclass(frozen=True)
class Decision:
    """What the operator wants: go to an offset, accept the place, or skip the pose."""

    what: Literal["go", "accept", "give-up"]
    offset_mm: float = 0.0


Operator = Callable[[View], Decision]


class SteadyOperator:
    """Does what the instructions say: sweep up through the longest bar, then back to the middle."""

    def __init__(self) -> None:
        self._stage: Literal["down", "up", "check"] = "down"
        self._from = 0

    def __call__(self, view: View) -> Decision:
        """Decide."""
        if self._stage == "down":
            if view.length > max(view.longest - 2 * _VISIBLE_DROP, 0):
                return Decision("go", view.offset_mm - 4 * _SWEEP_MM)
            self._stage, self._from = "up", len(view.seen) - 1
        if self._stage == "check" and view.message:
            self._stage, self._from = "up", len(view.seen) - 1
        if self._stage == "up":
            sweep = view.seen[self._from :]
            longest = max(length for _, length in sweep)
            # One short bar on the way up may be a stop that fell short; two are the other side.
            passed = len(sweep) > 2 and all(
                length <= longest - 2 * _VISIBLE_DROP for _, length in sweep[-2:]
            )
            if not (passed and longest >= view.longest - _VISIBLE_DROP):
                return Decision("go", view.offset_mm + _SWEEP_MM)
            self._stage = "check"
            return Decision("go", middle_of(sweep))
        return Decision("accept")


def middle_of(seen: tuple[tuple[float, int], ...]) -> float:
    """Half way between the places on both flanks where the bar becomes visibly shorter, mm.

    Args:
        seen: (offset, length) of every look, in any order.
    """
    ordered = sorted(seen)
    places = np.array([place for place, _ in ordered])
    lengths = np.array([length for _, length in ordered], float)
    level = lengths.max() - _VISIBLE_DROP

    def crossing(short: int, long: int) -> float:
        part = (level - lengths[short]) / (lengths[long] - lengths[short])
        return float(places[short] + part * (places[long] - places[short]))

    above = np.flatnonzero(lengths > level)
    first, last = int(above[0]), int(above[-1])
    rising = crossing(first - 1, first) if first > 0 else places[first]
    falling = crossing(last + 1, last) if last + 1 < len(lengths) else places[last]
    return 0.5 * float(rising + falling)


def sides_seen(seen: Sequence[tuple[float, int]]) -> tuple[bool, bool]:
    """Whether the bar was seen to shrink below, and above, the place where it was longest.

    It must be clearly shorter at two places on a side: a single one may be a stop that fell short.
    """
    longest = max(length for _, length in seen)
    place = next(at for at, length in seen if length == longest)
    short = {
        round(at / _SAME_PLACE_MM) for at, length in seen if length <= longest - 2 * _VISIBLE_DROP
    }
    middle = round(place / _SAME_PLACE_MM)
    below, above = sum(at < middle for at in short), sum(at > middle for at in short)
    return below >= _LEAST_SHORT, above >= _LEAST_SHORT


def flanks(
    seen: Sequence[tuple[float, int]], place: float
) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
    """On each side of a place: the last stop with a long bar and the first with a shorter one."""
    longest = max(length for _, length in seen)
    short = sorted(at for at, length in seen if length <= longest - _VISIBLE_DROP)
    long = sorted(at for at, length in seen if length > longest - _VISIBLE_DROP)
    below = [at for at in short if at < place]
    above = [at for at in short if at > place]
    low = high = None
    if below:
        inner = [at for at in long if at > below[-1]]
        low = (below[-1], inner[0] if inner else place)
    if above:
        inner = [at for at in long if at < above[0]]
        high = (inner[-1] if inner else place, above[0])
    return low, high


def pattern_injection(
    bench: Bench,
    injector: Injector,
    operator: Operator,
    settings: Settings | None = None,
    start_mm: float = 0.0,
    *,
    frame: Callable[[], Frame | None] = _no_frame,
    title: str = "",
    watch: OnStop | None = None,
) -> Placement:
    """Let an operator find the mid-plane by the injected bar.

    Args:
        bench: what to move and listen to.
        injector: what draws the bar.
        operator: looks and decides.
        settings: how to search; every move, also the operator's, keeps its caps and approaches
            from below.
        start_mm: where the mid-plane is expected, as an offset from the plan's pose.
        frame: gives the newest B-mode frame for the view.
        title: which pose this is, for the view.
        watch: told of every stop.

    Returns:
        A placement whose bracket lies between the places on both sides where the bar was visibly
        shorter, widened by the errors that nobody can see. Injection is off again.

    Raises:
        SkippedError: by the operator.
        PlacementError: given up by a guard; the probe is at the last good place.
    """
    try:
        with Walker(bench, settings, watch) as walker:
            coarse(walker, start_mm)
            placement = _followed(walker, injector, operator, frame, title)
    except BaseException:
        # A person must read the first error, not one of switching off.
        with contextlib.suppress(DeviceError):
            injector.inject(False)
        raise
    injector.inject(False)
    return placement


def _followed(
    walker: Walker,
    injector: Injector,
    operator: Operator,
    frame: Callable[[], Frame | None],
    title: str,
) -> Placement:
    """The placement when the operator accepts one; arguments as of :func:`pattern_injection`."""
    settings = walker.settings
    first, message = len(walker.samples), ""
    echoes = walker.listen()
    for _ in range(_MOST_LOOKS):
        if echoes.saturated(settings.full_scale):
            raise PlacementError("the amplitude saturates: turn the gain down")
        looks = walker.samples[first:]
        loudest = max(peak for _, peak, _ in looks)
        seen = tuple((at, bar_length(peak, loudest)) for at, peak, _ in looks)
        view = View(seen, settings.fine_mm, frame, message, title)
        lines = echoes.amplitude.shape[1]
        injector.load_pattern(bar(view.length, echoes.loudest_line, lines))
        injector.inject(True, BAR_DELAY_S)
        decision = operator(view)
        message = ""
        if decision.what == "give-up":
            raise SkippedError("the operator gave up the pose")
        if decision.what == "accept":
            low, high = flanks(seen, walker.where)
            enough = all(sides_seen(seen)) and echoes.heard
            if enough and low is not None and high is not None:
                lower, upper = 0.5 * sum(low), 0.5 * sum(high)
                spread = np.hypot(low[1] - low[0], high[1] - high[0]) / np.sqrt(48.0)
                spread = float(np.hypot(spread, settings.position_sd_mm / np.sqrt(2.0)))
                return walker.placement(0.5 * (lower + upper), 0.5 * (upper - lower), spread)
            message = "visit both sides first: the bar must shrink on each"
            continue
        _, echoes = walker.stop_at(decision.offset_mm)
    raise PlacementError(f"not accepted after {_MOST_LOOKS} looks")
