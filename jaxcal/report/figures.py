"""The report's figures, drawn without any display and without pyplot's global state."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxcal.calibration import Calibration
from jaxcal.diagnostics import messages
from jaxcal.recording import Recording
from jaxcal.report.convergence import Curve

# Okabe and Ito's palette, which the colour-blind can tell apart.
_BLUE, _ORANGE, _GREEN, _GREY = "#0072B2", "#D55E00", "#009E73", "#666666"
_ROUNDING = 3e-14
"""Relative excess of an objective below which there is only rounding."""


def residual_figure(result: Calibration) -> Figure:
    """Each image's residual from the plane (mm), in lateral, elevational and axial panels."""
    answer = result.numpy()
    used = np.flatnonzero(answer.mask > 0)
    named = np.intersect1d(messages.outliers(answer), used)
    figure = _figure(3.0 * 2.2)
    panels = figure.subplots(3, 1, sharex=True)
    for axis, (panel, name) in enumerate(
        zip(panels, ("lateral", "elevational", "axial"), strict=True)
    ):
        values = answer.residual[:, axis]
        panel.axhline(0.0, color=_GREY, linewidth=0.8)
        panel.vlines(used, 0.0, values[used], color=_BLUE, linewidth=0.8)
        panel.plot(used, values[used], "o", color=_BLUE, markersize=3.5)
        if len(named):
            panel.plot(named, values[named], "s", color=_ORANGE, markersize=6, fillstyle="none",
                       label="does not fit the rest")  # fmt: skip
            panel.legend(loc="upper right")
        panel.set_ylabel(f"{name} (mm)")
    panels[0].set_title(f"Residual from the image plane, {result.method}")
    panels[-1].set_xlabel("image")
    return figure


def offset_figure(result: Calibration, recording: Recording) -> Figure:
    """Estimated elevational offsets with one SD (mm), beside the true ones where known."""
    answer = result.numpy()
    used = np.flatnonzero(answer.mask > 0)
    figure = _figure(3.6)
    panel = figure.subplots()
    panel.axhline(0.0, color=_GREY, linewidth=0.8)
    spread = np.nan_to_num(answer.elevation_sd[used], nan=0.0)
    panel.errorbar(used, answer.elevation[used], yerr=spread, fmt="o", color=_BLUE, markersize=3.5,
                   linewidth=0.8, label="estimated, with one SD")  # fmt: skip
    resting = used[answer.at_bound[used] > 0]
    if len(resting):
        panel.plot(resting, answer.elevation[resting], "s", color=_GREEN, markersize=6,
                   fillstyle="none", label="at its bound")  # fmt: skip
    if recording.truth is not None:
        panel.plot(used, recording.truth.elevation[used], "x", color=_ORANGE, markersize=5,
                   label="true")  # fmt: skip
    panel.set_title(f"Distance of the target from the image plane, {result.method}")
    panel.set_xlabel("image")
    panel.set_ylabel("elevational offset (mm)")
    _legend(panel)
    return figure


def convergence_figure(curves: list[Curve]) -> Figure:
    """Objective above the best that any of the curves reached (mm^2), against the iteration.

    Args:
        curves: of one and the same objective.
    """
    figure = _figure(3.8)
    panel = figure.subplots()
    reached = [curve for curve in curves if np.isfinite(curve.objective).any()]
    if reached:
        best = min(float(np.nanmin(curve.objective)) for curve in reached)
        floor = max(_ROUNDING * best, np.finfo(float).tiny)
        styles = zip(reached, (_ORANGE, _BLUE, _GREEN), ("s", "o", "^"), strict=False)
        for curve, colour, marker in styles:
            excess = np.maximum(curve.objective - best, floor)
            # Down there the values only jitter.
            excess = excess[: int(np.nanargmin(excess)) + 1]
            panel.plot(np.arange(len(excess)), excess, marker=marker, color=colour, markersize=4,
                       linewidth=1.0, label=curve.label)  # fmt: skip
            if curve.stopped is not None and curve.stopped < len(excess):
                panel.plot(curve.stopped, excess[curve.stopped], "o", color=colour, markersize=11,
                           fillstyle="none", label=f"{curve.label}: stops here")  # fmt: skip
        panel.set_yscale("log")
        panel.axhline(floor, color=_GREY, linewidth=0.8, linestyle=":", label="rounding")
        _legend(panel)
    else:
        panel.text(0.5, 0.5, "no objective values were kept", ha="center",
                   transform=panel.transAxes)  # fmt: skip
    panel.set_title("Convergence on the same objective")
    panel.set_xlabel("iteration")
    panel.set_ylabel("objective above the best (mm²)")
    return figure


def _figure(height: float) -> Figure:
    figure = Figure(figsize=(7.5, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _legend(panel: Axes) -> None:
    panel.legend(loc="best", fontsize="small")
