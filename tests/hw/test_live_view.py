"""The person's views of pattern injection, driven by keys."""

from __future__ import annotations

import io
import itertools
import signal
from collections.abc import Iterable
from contextlib import nullcontext, suppress

import numpy as np
import pytest
from matplotlib.backend_bases import CloseEvent, KeyEvent
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hw.bench.frames import Camera
from hw.bench.stage import WorldStage
from hw.bench.world import make_world
from hw.midplane.live_view import Keys, TerminalOperator, WindowOperator, advice
from hw.midplane.pattern_injection import (
    LONGEST,
    Decision,
    SkippedError,
    SteadyOperator,
    View,
    pattern_injection,
    sides_seen,
)
from hw.midplane.terminal_image import Screen, picture
from hw.planning.poses import plan_poses
from hw.runtime.interrupts import as_interrupts
from hw.runtime.keys import Keyboard
from jaxcal import InputError


def stage() -> WorldStage:
    world = make_world(0)
    return WorldStage(world, plan_poses(1, world.scene).poses[0], np.random.default_rng(0))


def sweep_then_middle():
    """Down past the bar, up past it again, to the middle, accept."""
    yield from ["pagedown"] * 2
    yield from ["up"] * 30
    yield from ["m", "enter"]


class Typed(Keyboard):
    """Keys typed beforehand; None first, so that the view is painted again without one."""

    def __init__(self, keys: Iterable[str]) -> None:
        self._keys = itertools.chain([None], keys)

    def asking(self):
        return nullcontext()

    def read(self, timeout_s: float) -> str | None:
        return next(self._keys)


def test_a_person_at_a_terminal_finds_the_mid_plane():
    bench, out = stage(), io.StringIO()
    operator = TerminalOperator(Typed(sweep_then_middle()), Screen(out))
    placement = pattern_injection(bench, bench, operator, title="pose 1 of 1")
    assert placement.bracket.contains(bench.elevation_mm)
    text = out.getvalue()
    assert "#" * (LONGEST - 4) in text
    assert text.count("mm |") > 20
    assert "\x1b" not in text
    assert "pose 1 of 1" in text


def test_the_advice_leads_to_the_mid_plane():
    """A person who knows nothing but what the screen says ends where the rule does."""
    bench, said = stage(), []

    def obedient(view: View) -> Decision:
        said.append(advice(view))
        key = next(key for words, key in ADVICE.items() if words in said[-1])
        decision = Keys().decide(key, view)
        assert decision is not None
        return decision

    placement = pattern_injection(bench, bench, obedient)
    assert placement.bracket.contains(bench.elevation_mm)
    rule = pattern_injection(stage(), stage(), SteadyOperator())
    assert placement.bracket.width_mm == pytest.approx(rule.bracket.width_mm, rel=0.5)
    assert said[-1].startswith("This is the middle")


ADVICE = {
    "Step down": "j", "Step up": "k",
    "m moves the robot": "m", "Enter accepts": "enter",
}  # fmt: skip


def test_the_advice_brings_back_who_lost_the_pattern():
    """Above it, so the way is down; and whoever only saw one side is not told to accept."""
    view = View(((0.0, 20), (1.0, 12), (3.0, 0)), 0.25)
    assert advice(view).startswith("The pattern is gone here. Step down")


def test_a_place_looked_at_twice_is_not_two_looks_on_that_side():
    once = [(0.0, 31), (-1.0, 12), (-2.0, 5), (1.0, 9), (1.0, 9)]
    assert sides_seen(once) == (True, False)
    assert sides_seen([*once, (1.25, 4)]) == (True, True)


def test_a_terminal_that_tells_no_size_counts_as_80_by_24(tmp_path):
    pytest.importorskip("pty", reason="there are no pseudo-terminals here")
    from terminal import Terminal

    code = "import sys; from hw.midplane.terminal_image import Screen; "
    code += "Screen(sys.stdout).show(['word ' * 8])"
    with Terminal(["-c", code], tmp_path, size=(0, 0)) as person:
        assert person.finish() == 0
        assert "word word word" in person.shown


@pytest.mark.parametrize("size", [(64, 20), (30, 6)])
def test_the_picture_keeps_a_thin_bar(size):
    frame = np.zeros((480, 640), np.uint8)
    frame[240:243, 300:340] = 255
    columns, rows = size
    lines = picture(frame, columns, rows)
    assert len(lines) == rows
    assert all(line.count("▀") == columns for line in lines)
    assert sum("5;255" in line for line in lines) == 1


def test_a_block_is_painted_over_itself_and_lines_stay(monkeypatch):
    out = io.StringIO()
    screen = Screen(out, terminal=True)
    screen.show(["one", "two"])
    screen.show(["three", "four"])
    screen.say("a line that stays")
    assert out.getvalue().endswith("\x1b[2F\x1b[Ja line that stays\n")
    assert out.getvalue().count("\x1b[2F") == 2
    screen.show(["x" * 200])
    assert max(len(row) for row in out.getvalue().split("\n")) < 100


def test_a_person_before_a_window_finds_the_mid_plane():
    bench = stage()
    camera, rng = Camera(bench.world), np.random.default_rng(1)
    figure = Figure(dpi=30)
    canvas = FigureCanvasAgg(figure)
    window = WindowOperator(figure)
    # The same sweep by steps twice as large: each draws the window anew.
    keys = iter(["pagedown", "pagedown", "+", *["up"] * 15, "m", "enter"])

    def press(key: str) -> None:
        canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, key))

    canvas.start_event_loop = lambda timeout: press(next(keys))
    go = bench.move

    def move(offset_mm: float) -> float:
        # Too early: the result of the move is not seen yet.
        for key in ("pageup", "enter", "escape"):
            press(key)
        return go(offset_mm)

    bench.move = move

    def frame() -> np.ndarray:
        return camera.frame(bench.true_pose, rng, pattern=bench.pattern, pattern_delay_s=4e-6)

    placement = pattern_injection(bench, bench, window, frame=frame)
    assert placement.bracket.contains(bench.elevation_mm)
    assert figure.axes[0].images
    assert "of" in figure.axes[1].get_title()


def test_a_closed_window_ends_the_run():
    """The robot must not go on to the next pose where nobody sees the bar."""
    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    window = WindowOperator(figure)
    view = View(((1.0, 5),), 0.25, frame=lambda: None)
    closed = CloseEvent("close_event", canvas)
    canvas.start_event_loop = lambda timeout: canvas.callbacks.process("close_event", closed)
    for _ in range(2):
        with pytest.raises(InputError, match="the window was closed"):
            window(view)


def test_an_interrupt_that_the_window_drops_ends_the_wait():
    """Tk prints exceptions of its callbacks, e.g. of one that draws, and goes on."""

    def frame() -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    figure = Figure()
    FigureCanvasAgg(figure)
    view = View(((1.0, 5),), 0.25, frame=frame)
    with as_interrupts(), pytest.raises(KeyboardInterrupt):
        WindowOperator(figure)(view)


def test_s_skips_the_pose():
    bench = stage()
    with pytest.raises(SkippedError, match="operator gave up"):
        pattern_injection(bench, bench, TerminalOperator(Typed("s"), Screen(io.StringIO())))


def test_steps_change_and_unknown_keys_do_nothing():
    keys = Keys()
    view = View(((1.0, 5),), 0.25)
    assert keys.decide("x", view) is None
    assert keys.decide("-", view) is None
    decision = keys.decide("up", view)
    assert decision is not None
    assert decision.offset_mm == pytest.approx(1.125)
    for _ in range(20):
        keys.decide("+", view)
    assert keys.step_mm == 1.0


def test_no_display_is_told(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    import matplotlib

    matplotlib.use("agg")
    with pytest.raises(InputError, match="no display"):
        WindowOperator()
