"""Figures of a calibration in memory, for publications: one style, with units and safe colours.

Each function returns a matplotlib Figure without a window: save it with
``figure.savefig("a.pdf")``, or show it in a notebook. Sizes are those of a journal's column (88 mm)
or page (180 mm).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import offset_copy

from jaxcal import InputError
from jaxcal.data.poses import targets_in_images
from jaxcal.data.recording import Recording
from jaxcal.diagnostics.influence import in_image, influence_of
from jaxcal.diagnostics.intervals import image_jacobian, tre_at
from jaxcal.diagnostics.outliers import outliers, suspects
from jaxcal.model.image_points import mean_of_squares
from jaxcal.report.accuracy import error_shares, region_of, scatter_shares
from jaxcal.report.convergence import Curve
from jaxcal.report.in_memory import recording_of
from jaxcal.report.svg import DIRECTIONS, bar_length, drawn, ink, spread_out
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.colours import BLUE, GREEN, GREY, ORANGE
from jaxcal.runtime.given_values import real_array

COLUMN_MM, PAGE_MM = 88.0, 180.0
_MOST_BINS = 60
"""Most bars of a histogram."""
_ROUNDING = 3e-14
"""An excess of the objective below this relative size is only rounding."""
_ALONG_A_SIDE = 61
"""Points along each side of the map of the error."""


def canvas(width_mm: float, height_mm: float) -> Figure:
    """A figure of the given size on paper, made without pyplot."""
    figure = Figure(figsize=(width_mm / 25.4, height_mm / 25.4), dpi=200, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def styled(axes: Axes) -> Axes:
    """Small type, thin lines, no box."""
    axes.tick_params(labelsize=7, width=0.6, length=2.5)
    for side, spine in axes.spines.items():
        spine.set_linewidth(0.6)
        spine.set_visible(side in ("left", "bottom"))
    for words in (axes.xaxis.label, axes.yaxis.label, axes.title):
        words.set_fontsize(8)
    return axes


def plot_tre(calibration: Calibration, factor: float = 1.0) -> Figure:
    """Map over the image of the target registration error to expect, mm.

    Args:
        calibration: of one problem, with concrete values.
        factor: how many times the error that the covariance states is to be expected
            (``tre.factor`` of the calibration's record).

    Raises:
        InputError: X is not observable.
    """
    answer, recording = _determined(calibration, "there is no error to map")
    region = region_of(answer, recording)
    cells = region.grid(_ALONG_A_SIDE, _ALONG_A_SIDE)[:, [0, 2]]
    cells = cells.reshape(_ALONG_A_SIDE, _ALONG_A_SIDE, 2)
    lateral, depth = cells[..., 0], cells[..., 1]
    error = factor * tre_at(answer, cells).rms
    figure = canvas(COLUMN_MM, COLUMN_MM)
    # Axes of equal scale shrink after they are laid out, and only this layout sees it.
    figure.set_layout_engine("compressed")
    axes = styled(figure.subplots())
    mesh = axes.pcolormesh(
        lateral, depth, error, cmap="viridis", shading="gouraud", rasterized=True
    )
    lines = axes.contour(lateral, depth, error, colors="white", linewidths=0.5, levels=5)
    axes.clabel(lines, fontsize=6, fmt="%.3g")
    poses = recording.calibration.poses[np.asarray(answer.mask) > 0]
    seen = spread_out(targets_in_images(poses, answer.image_to_probe, answer.point))
    # A target at the border of the region is drawn whole.
    axes.plot(seen[:, 0], seen[:, 2], "o", ms=1.8, mfc="white", mec="k", mew=0.4, clip_on=False)
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set(xlabel="lateral (mm)", ylabel="depth (mm)")
    bar = figure.colorbar(mesh, ax=axes, shrink=0.8)
    bar.set_label("target registration error (mm)", size=8)
    bar.ax.tick_params(labelsize=7, width=0.6)
    bar.outline.set_linewidth(0.6)  # pyright: ignore[reportCallIssue]
    _scale_bar(axes, bar_length(float(np.ptp(lateral))))
    return figure


def plot_residuals(calibration: Calibration) -> Figure:
    """Residual of every image from the plane, mm: lateral, axial, elevational, on one scale."""
    answer, _ = _one(calibration)
    residual = np.asarray(answer.residual)
    # A solve that failed has no residuals to draw.
    used = np.flatnonzero((np.asarray(answer.mask) > 0) & np.isfinite(residual).all(axis=1))
    suspected = [each["image"] for each in suspects(answer)]
    named = np.intersect1d([*outliers(answer), *suspected], used)
    figure = canvas(PAGE_MM, 110.0)
    panels = figure.subplots(3, 1, sharex=True, sharey=True)
    for panel, (name, axis, colour) in zip(panels, DIRECTIONS, strict=True):
        styled(panel)
        panel.axhline(0.0, color=GREY, linewidth=0.5)
        values = residual[:, axis]
        shown = used[drawn(values[used], np.searchsorted(used, named))]
        panel.vlines(shown, 0.0, values[shown], color=colour, linewidth=0.7)
        panel.plot(shown, values[shown], "o", color=colour, ms=2.2)
        if len(named):
            ringed = np.intersect1d(named, shown)
            label = "does not fit the rest, or suspicious"
            panel.plot(
                ringed, values[ringed], "o", ms=6, mfc="none", mec="black", mew=0.7, label=label
            )
        panel.set_ylabel(f"{name} (mm)")
    if len(named):
        _legend(panels[0])
    panels[-1].set_xlabel("image")
    return figure


def plot_offsets(calibration: Calibration, truth: Float[np.ndarray, " n"] | None = None) -> Figure:
    """Estimated distance of the target from the image plane with one SD, mm.

    Args:
        calibration: of one problem.
        truth: true offsets, mm, where they are known.

    Raises:
        InputError: not one true offset for each image.
    """
    answer, _ = _one(calibration)
    if truth is not None:
        truth = real_array(truth, "truth")
        if truth.shape != answer.mask.shape:
            raise InputError(f"truth must have shape {answer.mask.shape}, not {truth.shape}")
    known = np.isfinite(np.asarray(answer.elevation))
    used = np.flatnonzero((np.asarray(answer.mask) > 0) & known)
    figure = canvas(PAGE_MM, 60.0)
    panel, side = figure.subplots(1, 2, sharey=True, width_ratios=(5, 1))
    styled(panel).axhline(0.0, color=GREY, linewidth=0.5)
    spread = np.nan_to_num(np.asarray(answer.elevation_sd)[used], nan=0.0)
    offset = np.asarray(answer.elevation)[used]
    resting = np.flatnonzero(np.asarray(answer.at_bound)[used] > 0)
    shown = drawn(offset, resting)
    panel.errorbar(
        used[shown],
        offset[shown],
        yerr=spread[shown],
        fmt="o",
        color=ORANGE,
        ecolor=GREY,
        ms=2.2,
        linewidth=0.7,
        label="estimated, with one SD",
    )
    resting = np.intersect1d(resting, shown)
    if len(resting):
        at_bound = used[resting], offset[resting]
        panel.plot(*at_bound, "s", ms=5, mfc="none", mec=GREEN, mew=0.8, label="at its bound")
    if truth is not None:
        panel.plot(used[shown], truth[used[shown]], "x", color="black", ms=3, mew=0.7, label="true")
    # Above the panel: in it, the legend would hide offsets.
    _legend(panel, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    panel.set(xlabel="image", ylabel="elevational offset (mm)")
    # Bins whose width the middle half decides could be millions with one offset far away.
    bins = max(5, min(_MOST_BINS, round(math.sqrt(len(offset)))))
    styled(side).hist(offset, bins=bins, orientation="horizontal", color=ORANGE, alpha=0.8)
    side.set_xlabel("images")
    return figure


def plot_influence(calibration: Calibration) -> Figure:
    """How far leaving out each image moves image points, mm, and how far is expected."""
    answer, weight = _weighed(calibration, "nothing can be left out")
    moved, expected = in_image(influence_of(answer), weight)
    used = np.flatnonzero(np.asarray(answer.mask) > 0)
    figure = canvas(PAGE_MM, 60.0)
    panel = styled(figure.subplots())
    most = used[np.argsort(-moved[used])[:3]]
    shown = used[drawn(moved[used], np.searchsorted(used, most))]
    panel.vlines(shown, 0.0, moved[shown], color=BLUE, linewidth=0.8)
    panel.plot(shown, moved[shown], "o", color=BLUE, ms=2.4, label="by leaving it out")
    label = "if the noise model holds (SD)"
    panel.plot(shown, expected[shown], "_", color="black", ms=4, mew=0.8, label=label)
    for image in most:
        panel.annotate(
            str(image),
            (image, moved[image]),
            (0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=7,
        )
    panel.set(xlabel="image", ylabel="change in the image (mm)", ylim=(0.0, None))
    panel.margins(y=0.12)
    _legend(panel)
    return figure


def plot_limits(calibration: Calibration) -> Figure:
    """Where the errors come from: shares of mean squares, of the calibration and of the scatter.

    Raises:
        InputError: X is not observable.
    """
    answer, weight = _weighed(calibration, "its error has no shares")
    shares = error_shares(answer, influence_of(answer), weight)
    figure = canvas(PAGE_MM, 38.0)
    panel = styled(figure.subplots())
    rows = ("residual of\nthe target", "error of the calibration\nin the image")
    for row, values in enumerate((scatter_shares(answer), shares)):
        left = 0.0
        for (name, _, colour), share in zip(DIRECTIONS, values, strict=True):
            label = name if row else None
            bar = panel.barh(row, share, left=left, color=colour, height=0.6, label=label)
            told = f"{100 * share:.0f} %" if share > 0.05 else ""
            panel.bar_label(bar, [told], label_type="center", color=ink(colour), fontsize=7)
            left += share
    panel.set_yticks([0, 1], rows)
    panel.set(xlim=(0, 1), xlabel="share of the mean square")
    _legend(panel, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def convergence_figure(curves: list[Curve]) -> Figure:
    """Objective less the lowest value of all curves (mm^2), against the iteration.

    The curves must be of the same objective.
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


def _weighed(
    calibration: Calibration, otherwise: str
) -> tuple[Calibration, Float[np.ndarray, "p p"]]:
    """A calibration that is determined, and W of the mean square error over its region."""
    answer, recording = _determined(calibration, otherwise)
    grid = region_of(answer, recording).grid()[:, [0, 2]]
    return answer, mean_of_squares(image_jacobian(answer, grid))


def _one(calibration: Calibration) -> tuple[Calibration, Recording]:
    return calibration.numpy(), recording_of(calibration)


def _determined(calibration: Calibration, otherwise: str) -> tuple[Calibration, Recording]:
    """A calibration and its data; refused where the images do not determine it."""
    answer, recording = _one(calibration)
    if not np.isfinite(answer.unknowns_covariance).all():
        raise InputError(f"these images do not determine the calibration: {otherwise}")
    return answer, recording


def _legend(panel: Axes, loc: Any = "best", **place: Any) -> None:
    panel.legend(loc=loc, fontsize=7, frameon=False, **place)


def _scale_bar(axes: Axes, length: float) -> None:
    """A bar of a length (mm) below the lateral axis, at its right end: it hides nothing there."""
    right = axes.get_xlim()[1]
    # In points: the numbers of the axis, above it, are as far down below a shallow image.
    below = offset_copy(axes.get_xaxis_transform(), axes.get_figure(True), 0, -17, "points")
    place = {"transform": below, "clip_on": False}
    axes.plot([right - length, right], [0, 0], "k", lw=1.5, solid_capstyle="butt", **place)
    label = f"{length:g} mm"
    axes.text(right - length / 2, -0.01, label, ha="center", va="top", fontsize=7, **place)
