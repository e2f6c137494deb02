"""The figure of a plan: places of the target, tilts of the probe, and the number of images."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal import InputError
from jaxcal.design.planning import Plan
from jaxcal.runtime.colours import BLUE, GREY, ORANGE
from jaxcal.runtime.given_values import check_made, is_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plan_figure(plan: Plan, wanted_mm: float | None = None) -> Figure:
    """Places in the image, tilts, and predicted errors against the number of images.

    Args:
        plan: what to draw.
        wanted_mm: a wanted TRE to mark in the figure.
    """
    check_made("plan", plan, Plan, "jaxcal.design.plan or next_poses")
    if wanted_mm is not None and not (is_number(wanted_mm) and wanted_mm > 0):
        raise InputError(f"the wanted error must be a positive number of mm, not {wanted_mm!r}")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.5, 4.2), dpi=130, layout="constrained")
    _places(plan, figure.add_subplot(1, 3, 1))
    _tilts(plan, figure.add_subplot(1, 3, 2, projection="polar"))
    _errors(plan, wanted_mm, figure.add_subplot(1, 3, 3))
    return figure


def _kinds(plan: Plan) -> tuple[tuple[np.ndarray, str, str, str], ...]:
    """The poses that were chosen and those that fill space, with colour, shape and name."""
    return (~plan.filling, BLUE, "o", "chosen"), (plan.filling, ORANGE, "^", "fills space")


def _places(plan: Plan, panel: Any) -> None:
    """Where the target is in the image, and the outline of the region."""
    edge = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float)
    steps = np.linspace(0, 1, 20)[:, None]
    outline = np.concatenate([a + steps * (b - a) for a, b in pairwise(edge)])
    outline = plan.candidates.constraints.region.place(outline)
    panel.plot(outline[:, 0], outline[:, 2], color=GREY, linewidth=0.8)
    for which, colour, shape, label in _kinds(plan):
        places = plan.targets[which]
        panel.plot(places[:, 0], places[:, 2], shape, color=colour, markersize=4, label=label)
    panel.set(
        xlabel="lateral (mm)", ylabel="depth (mm)", title="target in the image", aspect="equal"
    )
    panel.invert_yaxis()
    # Below the image: in it, the legend would hide targets.
    panel.legend(
        fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False
    )


def _tilts(plan: Plan, panel: Any) -> None:
    """Where the handle goes, as in words.py: the marker is to the right, the person below."""
    model = plan.candidates.model
    numbers = plan.candidates.constraints.coordinates(plan.poses, model.image_to_probe, model.point)
    for which, colour, shape, _ in _kinds(plan):
        w1, w2 = numbers[which, 2], numbers[which, 3]
        tilt = np.degrees(np.hypot(w1, w2))
        panel.plot(np.arctan2(-w1, -w2), tilt, shape, color=colour, markersize=4, clip_on=False)
    panel.set_title("tilt of the handle (degrees)", pad=18)
    sides = ("towards\nthe marker", "away from you", "away from\nthe marker", "towards you")
    panel.set_xticks(np.radians([0, 90, 180, 270]), sides, fontsize="small")
    panel.tick_params(axis="x", pad=14)
    rings = np.arange(10, panel.get_ylim()[1] + 1, 10)
    if len(rings):
        panel.set_yticks(rings)
    panel.tick_params(axis="y", labelsize="small")


def _errors(plan: Plan, wanted_mm: float | None, panel: Any) -> None:
    """Predicted errors against the number of images."""
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    count = plan.known.images + np.arange(len(plan.tre_mm))
    # Errors of the first few images are so large that they would hide the others.
    seen = count >= min(6, count[-1])
    for values, colour, style, label in (
        (plan.tre_mm, BLUE, "o-", "target registration error"),
        (plan.rp_mm, ORANGE, "^-", "reconstruction precision"),
    ):
        panel.plot(count[seen], values[seen], style, color=colour, markersize=3, label=label)
    panel.set_xlim(count[seen][0] - 0.5, count[-1] + 0.5)
    if wanted_mm is not None:
        panel.axhline(wanted_mm, color=GREY, linewidth=0.8, linestyle="--", label="wanted")
    panel.set(
        xlabel="images", ylabel="predicted error (mm)", yscale="log", title="how many images?"
    )
    panel.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    for formatted in (panel.yaxis.set_major_formatter, panel.yaxis.set_minor_formatter):
        formatted(StrMethodFormatter("{x:g}"))
    panel.grid(alpha=0.3, which="both")
    panel.legend(fontsize="small")
