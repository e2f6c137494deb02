"""What a person sees during pattern injection: B-mode frame, bar, and the bar's length by place.

Two operators for :func:`hw.midplane.pattern_injection.pattern_injection`: a terminal, and a window
(matplotlib with a display). Both say in words what to do next. Keys are the same in both:

    up / down, k / j     one step along the elevational axis
    page up / down, K/J  four steps
    + / -                larger or smaller steps
    m                    to the middle of the two flanks seen so far
    enter                accept
    s, q, escape         skip this pose
"""

from __future__ import annotations

from collections import deque

import numpy as np

from hw.midplane.pattern_injection import LONGEST, Decision, View, middle_of, sides_seen
from hw.midplane.terminal_image import Screen
from hw.runtime.interrupts import heed_interrupt
from hw.runtime.keys import Keyboard
from jaxcal import InputError

_LEAST_STEP_MM, _LARGEST_STEP_MM = 0.02, 1.0
_REFRESH_S = 0.25
_NEAR_MM = 0.3
_STEPS = {"up": 1, "k": 1, "pageup": 4, "K": 4, "down": -1, "j": -1, "pagedown": -4, "J": -4}
"""Steps that a key asks for."""
_PROFILE = " ▁▂▃▄▅▆▇█"
_PROFILE_COLUMNS = 60
_OTHER_ROWS = 9
KEYS = (
    "k/up j/down: step, K J: four steps, + -: step size, m: middle, Enter: accept, "
    "s: skip this pose, Ctrl-C: stop"
)


class Keys:
    """Turns key presses into decisions, and keeps the step that the person has set.

    Attributes:
        step_mm: step of the next move; None: the procedure's own.
    """

    def __init__(self) -> None:
        self.step_mm: float | None = None

    def step(self, view: View) -> float:
        """Step of the next move, mm."""
        return view.step_mm if self.step_mm is None else self.step_mm

    def decide(self, key: str, view: View) -> Decision | None:
        """What a key asks for; None if it decides nothing (an unknown key, a new step size)."""
        step = self.step(view)
        if key in _STEPS:
            return Decision("go", view.offset_mm + _STEPS[key] * step)
        if key in ("+", "-"):
            step = step * 2 if key == "+" else step / 2
            self.step_mm = min(max(step, _LEAST_STEP_MM), _LARGEST_STEP_MM)
        elif key == "m":
            return Decision("go", middle_of(view.seen))
        elif key == "enter":
            return Decision("accept")
        elif key in ("escape", "q", "s"):
            return Decision("give-up")
        return None


def describe(view: View, step_mm: float = 0.0) -> str:
    """The view as one line of text, with the step of the next move (mm) where there is one."""
    bar = "#" * view.length
    step = f", step {step_mm:.2f} mm" if step_mm else ""
    return (
        f"{view.offset_mm:+7.2f} mm |{bar:<{LONGEST}}| {view.length:2d} of {view.longest:2d} "
        f"seen{step}"
    )


def advice(view: View) -> str:
    """What to do next, in words: both flanks must be seen before the middle between them counts."""
    below, above = sides_seen(view.seen)
    gone = "" if view.length else "The pattern is gone here. "
    if not below:
        return f"{gone}Step down (j) until the bar is clearly shorter than the longest, twice."
    if not above:
        return (
            f"{gone}Step up (k) through the longest bar until it is clearly shorter again, twice."
        )
    if view.length > 0 and abs(view.offset_mm - middle_of(view.seen)) <= _NEAR_MM:
        return "This is the middle: Enter accepts it, s skips the pose."
    return "The bar has shrunk on both sides: m moves the robot to the middle."


def profile(view: View) -> tuple[str, str]:
    """The longest bar seen in each stretch of offsets, drawn as columns, and a pointer below it."""
    places = np.array([place for place, _ in view.seen])
    low, high = min(places.min(), -2.0), max(places.max(), 2.0)
    at = ((places - low) / (high - low) * (_PROFILE_COLUMNS - 1)).round().astype(int)
    heights = np.zeros(_PROFILE_COLUMNS, int)
    np.maximum.at(heights, at, np.array([length for _, length in view.seen]))
    steps = np.ceil(heights / LONGEST * (len(_PROFILE) - 1)).astype(int)
    drawn = "".join(_PROFILE[step] for step in steps)
    return f"{low:+6.1f} {drawn} {high:+.1f} mm", f"{'':7}{'':{at[-1]}}^"


class TerminalOperator:
    """A person at a terminal.

    Args:
        keys: what the person types; keys pressed while the robot moves do not count, because the
            person had not seen the result of the move.
        screen: where to show it.
    """

    def __init__(self, keys: Keyboard, screen: Screen) -> None:
        self._source, self._screen = keys, screen
        self._keys = Keys()

    def __call__(self, view: View) -> Decision:
        """Show, keep the frame up to date, and wait for a key that decides."""
        with self._source.asking():
            while True:
                self._show(view)
                key = self._source.read(_REFRESH_S)
                decision = None if key is None else self._keys.decide(key, view)
                if decision is not None:
                    if decision.what != "go":
                        self._screen.clear()
                    return decision

    def _show(self, view: View) -> None:
        frame = view.frame()
        rows = [view.title] if view.title else []
        if frame is not None:
            rows += self._screen.picture(frame, _OTHER_ROWS)
        rows.append(describe(view, self._keys.step(view)))
        rows += profile(view)
        if view.message:
            rows.append(view.message)
        rows += [advice(view), KEYS]
        self._screen.show(rows)


class WindowOperator:
    """A person before a window: frame with the injected bar, and the bar's length by place.

    Keys pressed while the robot moves do not count, as at a terminal.

    Args:
        figure: a matplotlib figure with a canvas that takes keys; by default a new window.

    Raises:
        InputError: matplotlib has no display.
    """

    def __init__(self, figure=None) -> None:
        if figure is None:
            import matplotlib.pyplot as plt

            if plt.get_backend().lower() in ("agg", "pdf", "svg", "ps", "template"):
                raise InputError("there is no display for a window; use the terminal view")
            figure = plt.figure(figsize=(10, 5), layout="constrained")
            figure.show()
        self._figure = figure
        self._image_axes, self._axes = figure.subplots(1, 2, width_ratios=(3, 2))
        self._image_axes.set(title="B-mode", xticks=[], yticks=[])
        self._axes.set(xlabel="probe's offset (mm)", ylabel="bar (lines)", ylim=(0, LONGEST + 1))
        self._picture = None
        (self._line,) = self._axes.plot([], [], "o", color="0.6")
        (self._here,) = self._axes.plot([], [], "o", color="tab:red", markersize=10)
        self._keys = Keys()
        self._pressed: deque[str] = deque(maxlen=64)
        figure.canvas.mpl_connect("key_press_event", lambda e: self._pressed.append(e.key or ""))
        self._closed = False
        figure.canvas.mpl_connect("close_event", self._close)

    def _close(self, _event: object) -> None:
        self._closed = True

    def __call__(self, view: View) -> Decision:
        """Show, keep the frame up to date, and wait for a key that decides.

        Raises:
            InputError: the window was closed.
        """
        self._show(view)
        # Showing has delivered the keys that were pressed before anything could be seen.
        self._pressed.clear()
        while True:
            heed_interrupt()
            decision = None
            if self._pressed:
                decision = self._keys.decide(self._pressed.popleft(), view)
            elif not self._closed:
                self._figure.canvas.start_event_loop(_REFRESH_S)
            if decision is not None:
                return decision
            self._show(view)

    def _show(self, view: View) -> None:
        if self._closed:
            raise InputError("the window was closed")
        frame = view.frame()
        if frame is not None:
            if self._picture is None:
                self._picture = self._image_axes.imshow(
                    frame, cmap="gray", vmin=0, vmax=255, aspect=1.0
                )
            else:
                self._picture.set_data(frame)
        places = [place for place, _ in view.seen]
        self._line.set_data(places, [length for _, length in view.seen])
        self._here.set_data(places[-1:], [view.length])
        margin = 0.5
        self._axes.set_xlim(min(places) - margin, max(places) + margin)
        self._axes.set_title(describe(view, self._keys.step(view)).split("|")[-1].strip())
        text = "\n".join(part for part in (view.title, view.message, advice(view)) if part)
        self._figure.suptitle(text, fontsize=9)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()
