"""The person's views of pattern injection, driven by keys."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.backend_bases import KeyEvent
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hw.bench.frames import Camera
from hw.bench.stage import WorldStage
from hw.bench.world import make_world
from hw.midplane.live_view import Keys, TerminalOperator, WindowOperator
from hw.midplane.pattern_injection import LONGEST, View, pattern_injection
from hw.midplane.search import PlacementError
from hw.poses import plan_poses
from jaxcal.errors import InputError


def stage() -> WorldStage:
    world = make_world(0)
    return WorldStage(world, plan_poses(1, world.scene).poses[0], np.random.default_rng(0))


def sweep_then_middle():
    """Down past the bar, up past it again, to the middle, accept."""
    yield from ["pagedown"] * 2
    yield from ["up"] * 30
    yield from ["m", "enter"]


def test_a_person_at_a_terminal_finds_the_mid_plane():
    bench, out, keys = stage(), io.StringIO(), sweep_then_middle()
    placement = pattern_injection(bench, bench, TerminalOperator(lambda: next(keys), out.write))
    assert placement.bracket.contains(bench.elevation_mm)
    text = out.getvalue()
    assert "#" * (LONGEST - 4) in text
    assert text.count("mm |") > 20


def test_a_person_before_a_window_finds_the_mid_plane():
    bench = stage()
    camera, rng = Camera(bench.world), np.random.default_rng(1)
    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    window = WindowOperator(figure, camera.spacing_mm)
    for key in sweep_then_middle():
        canvas.callbacks.process("key_press_event", KeyEvent("key_press_event", canvas, key))

    def frame():
        return camera.frame(bench.true_pose, rng, pattern=bench.pattern, pattern_delay_s=4e-6)

    placement = pattern_injection(bench, bench, window, frame=frame)
    assert placement.bracket.contains(bench.elevation_mm)
    assert figure.axes[0].images
    assert "of" in figure.axes[1].get_title()


def test_escape_gives_up():
    bench = stage()
    with pytest.raises(PlacementError, match="gave up"):
        pattern_injection(bench, bench, TerminalOperator(lambda: "q", io.StringIO().write))


def test_steps_change_and_unknown_keys_do_nothing():
    keys = Keys()
    view = View(5, 10, 1.0, 0.25, 900.0, ((1.0, 5),))
    assert keys.decide("x", view) is None
    assert keys.decide("-", view) is None
    decision = keys.decide("up", view)
    assert decision is not None
    assert decision.offset_mm == pytest.approx(1.125)
    for _ in range(20):
        keys.decide("+", view)
    assert keys.step_mm == 1.0


def test_no_terminal_and_no_display_are_told(monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(InputError, match="terminal"):
        TerminalOperator()
    monkeypatch.setenv("MPLBACKEND", "agg")
    import matplotlib

    matplotlib.use("agg")
    with pytest.raises(InputError, match="no display"):
        WindowOperator()
