"""Figure of how the objective fell, drawn without a display and without pyplot's global state."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxcal.report.convergence import Curve
from jaxcal.report.plots import BLUE, GREEN, GREY, ORANGE, PAGE_MM, canvas, styled

_ROUNDING = 3e-14
"""An excess of the objective below this relative size is only rounding."""


def convergence_figure(curves: list[Curve]) -> Figure:
    """Objective less the lowest value of all curves (mm^2), against the iteration.

    Args:
        curves: of the same objective.
    """
    figure = canvas(PAGE_MM, 80.0)
    panel = styled(figure.subplots())
    reached = [curve for curve in curves if np.isfinite(curve.objective).any()]
    if reached:
        best = min(float(np.nanmin(curve.objective)) for curve in reached)
        floor = max(_ROUNDING * best, np.finfo(float).tiny)
        styles = zip(reached, (ORANGE, BLUE, GREEN), ("s", "o", "^"), strict=False)
        for curve, colour, marker in styles:
            excess = np.maximum(curve.objective - best, floor)
            # After the minimum the values vary only by rounding.
            excess = excess[: int(np.nanargmin(excess)) + 1]
            panel.plot(
                np.arange(len(excess)),
                excess,
                marker=marker,
                color=colour,
                markersize=4,
                linewidth=1.0,
                label=curve.label,
            )
            if curve.stopped is not None and curve.stopped < len(excess):
                panel.plot(
                    curve.stopped,
                    excess[curve.stopped],
                    "o",
                    color=colour,
                    markersize=11,
                    fillstyle="none",
                    label=f"{curve.label}: stops here",
                )
        panel.set_yscale("log")
        panel.axhline(floor, color=GREY, linewidth=0.8, linestyle=":", label="rounding")
        _legend(panel)
    else:
        panel.text(
            0.5, 0.5, "no objective values were kept", ha="center", transform=panel.transAxes
        )
    panel.set_title("Convergence on the same objective")
    panel.set_xlabel("iteration")
    panel.set_ylabel("objective above the best (mm²)")
    return figure


def _legend(panel: Axes) -> None:
    panel.legend(loc="best", fontsize=7, frameon=False)
