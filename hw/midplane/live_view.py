"""What a person looks at during pattern injection: B-mode frame, bar, and how the bar went.

Two operators for :func:`hw.midplane.pattern_injection.pattern_injection`: a window (matplotlib with
a display) and a terminal. Keys are the same in both:

    up / down, k / j     one step along the elevational axis
    page up / down, K/J  four steps
    + / -                larger or smaller steps
    m                    to the middle of the two flanks seen so far
    enter                accept
    escape, q            give up
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable

from hw.midplane.pattern_injection import LONGEST, Decision, View, middle_of
from jaxcal.errors import InputError

_LEAST_STEP_MM, _LARGEST_STEP_MM = 0.02, 1.0
_INSTRUCTION = (
    "Move up through the longest bar until it shrinks on both sides, go to the middle (m), accept "
    "(enter)."
)


class Keys:
    """Turns key presses into decisions; the step is the person's.

    Attributes:
        step_mm: of the next move.
    """

    def __init__(self) -> None:
        self.step_mm: float | None = None

    def decide(self, key: str, view: View) -> Decision | None:
        """What a key asks for; None where it asks for no move (an unknown key, another step)."""
        step = view.step_mm if self.step_mm is None else self.step_mm
        way = {"up": 1, "k": 1, "pageup": 4, "K": 4,
               "down": -1, "j": -1, "pagedown": -4, "J": -4}.get(key)  # fmt: skip
        if way is not None:
            return Decision("go", view.offset_mm + way * step)
        if key in ("+", "-"):
            step = step * 2 if key == "+" else step / 2
            self.step_mm = min(max(step, _LEAST_STEP_MM), _LARGEST_STEP_MM)
        elif key == "m":
            return Decision("go", middle_of(view.seen))
        elif key == "enter":
            return Decision("accept")
        elif key in ("escape", "q"):
            return Decision("give-up")
        return None


def describe(view: View, step_mm: float) -> str:
    """The view as one line of text."""
    bar = "#" * view.length
    return (
        f"{view.offset_mm:+7.2f} mm |{bar:<{LONGEST}}| {view.length:2d} of {view.longest:2d} "
        f"seen, step {step_mm:.2f} mm"
    )


class TerminalOperator:
    """A person at a terminal.

    Args:
        read_key: gives the next key's name; by default from standard input, which must be a
            terminal.
        write: takes the text to show; by default standard output.
    """

    def __init__(
        self,
        read_key: Callable[[], str] | None = None,
        write: Callable[[str], object] | None = None,
    ) -> None:
        if read_key is None and not sys.stdin.isatty():
            raise InputError("pattern injection by hand needs a terminal to read keys from")
        self._read = _read_key if read_key is None else read_key
        self._write = sys.stdout.write if write is None else write
        self._keys = Keys()
        self._write(_INSTRUCTION + "\n")

    def __call__(self, view: View) -> Decision:
        """Show and ask."""
        if view.message:
            self._write(view.message + "\n")
        while True:
            step = self._keys.step_mm
            self._write(describe(view, view.step_mm if step is None else step) + "\n")
            sys.stdout.flush()
            decision = self._keys.decide(self._read(), view)
            if decision is not None:
                return decision


def _read_key() -> str:
    """One key of a POSIX terminal, by the names of :class:`Keys`."""
    import termios
    import tty

    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        first = sys.stdin.read(1)
        if first == "\x1b":
            import select

            if not select.select([sys.stdin], [], [], 0.05)[0]:
                return "escape"
            rest = sys.stdin.read(2)
            if rest in ("[5", "[6"):
                sys.stdin.read(1)
            return {"[A": "up", "[B": "down", "[5": "pageup", "[6": "pagedown"}.get(rest, "")
        return {"\n": "enter", "\r": "enter", "": "escape"}.get(first, first)
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


class WindowOperator:
    """A person before a window: frame with the injected bar, and the bar's length by place.

    Args:
        figure: a matplotlib figure with a canvas that takes keys; by default a new window.
        spacing_mm: [lateral, axial] of the frames, mm per px.

    Raises:
        InputError: matplotlib has no display.
    """

    def __init__(self, figure=None, spacing_mm: tuple[float, float] | None = None) -> None:
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
        self._aspect = 1.0 if spacing_mm is None else spacing_mm[1] / spacing_mm[0]
        self._picture = None
        (self._line,) = self._axes.plot([], [], "o", color="0.6")
        (self._here,) = self._axes.plot([], [], "o", color="tab:red", markersize=10)
        self._keys = Keys()
        self._pressed: deque[str] = deque(maxlen=64)
        figure.canvas.mpl_connect("key_press_event", lambda e: self._pressed.append(e.key or ""))
        figure.canvas.mpl_connect("close_event", lambda _: self._pressed.append("escape"))

    def __call__(self, view: View) -> Decision:
        """Show and wait for a key."""
        while True:
            self._show(view)
            while not self._pressed:
                self._figure.canvas.start_event_loop(0.05)
            decision = self._keys.decide(self._pressed.popleft(), view)
            if decision is not None:
                return decision

    def _show(self, view: View) -> None:
        if view.frame is not None:
            if self._picture is None:
                self._picture = self._image_axes.imshow(
                    view.frame, cmap="gray", vmin=0, vmax=255, aspect=self._aspect
                )
            else:
                self._picture.set_data(view.frame)
        places = [place for place, _ in view.seen]
        self._line.set_data(places, [length for _, length in view.seen])
        self._here.set_data(places[-1:], [view.length])
        margin = 0.5
        self._axes.set_xlim(min(places) - margin, max(places) + margin)
        step = view.step_mm if self._keys.step_mm is None else self._keys.step_mm
        self._axes.set_title(describe(view, step).split("|")[-1].strip())
        self._figure.suptitle(view.message or _INSTRUCTION, fontsize=9)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()
