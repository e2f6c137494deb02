"""Points that were cut off at one edge of a region of the image.

Where a segmentation is confined to a region, or its numbers are clamped, a target beyond the edge
is recorded at the edge: many images share the largest or the smallest coordinate, to the last
digit. Their true points lie farther out. Measured coordinates hardly ever do this, not even whole
pixels: few images lie at the end of a range, and fewer in one pixel there than in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxcal import InputError
from jaxcal.diagnostics.outlier_agreement import apart_in_image
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float
from jaxcal.solvers.closed_form.single import in_closed_form, solve_problem

FEWEST = 4
"""Points are cut off if at least so many images share the outermost coordinate,"""
LEAST_SHARE = 0.05
"""at least this share of the images in use,"""
TIMES = 3.0
"""and more than so many times the images that share any other one."""
FEWEST_OTHERS = 10
"""With fewer other coordinates nothing is said: whole pixels of few images coincide by chance."""


@dataclass(frozen=True)
class Clipped:
    """Points that share the largest or the smallest coordinate.

    Attributes:
        axis: 0 lateral, 1 axial.
        largest: whether it is the largest coordinate; else the smallest.
        value: that coordinate, in the unit of the measurements (px or mm).
        images: that have it, counted from 0.
        apart_mm: how far apart the conventional fits of all images and of the others put the image,
            root mean square over the grid; None where one of them cannot be computed.
    """

    axis: int
    largest: bool
    value: float
    images: tuple[int, ...]
    apart_mm: float | None


def clipped(answer: Calibration, grid: Float[np.ndarray, "m 2"]) -> Clipped | None:
    """The edge at which most points were cut off; None if there is none.

    Args:
        answer: of one problem, on numpy arrays.
        grid: points of the image, [lateral, axial], mm, over which the distance is taken.
    """
    problem = answer.problem
    if problem is None or answer.data != "points":
        return None
    used = np.flatnonzero(np.asarray(answer.mask) > 0)
    points = np.asarray(problem.measurements, float)[used]
    edges = [
        (axis, largest, images)
        for axis in (0, 1)
        for largest in (True, False)
        if (images := _at_edge(points[:, axis], largest)).size
    ]
    if not edges:
        return None
    axis, largest, images = max(edges, key=lambda edge: edge[2].size)
    value = float(points[images[0], axis])
    images = used[images]
    return Clipped(axis, largest, value, tuple(images.tolist()), _apart(answer, images, grid))


def _at_edge(values: Float[np.ndarray, " n"], largest: bool) -> np.ndarray:
    """Images whose points were cut off at the end of these coordinates; empty if none were."""
    found, counts = np.unique(values, return_counts=True)
    end = -1 if largest else 0
    count = counts[end]
    others = np.delete(counts, end)
    few = count < max(FEWEST, LEAST_SHARE * len(values)) or len(others) < FEWEST_OTHERS
    if few or count <= TIMES * others.max():
        return np.array([], int)
    return np.flatnonzero(values == found[end])


def _apart(answer: Calibration, images: np.ndarray, grid: Float[np.ndarray, "m 2"]) -> float | None:
    """How far the conventional fit moves in the image if these images are left out, mm."""
    problem, mask = answer.problem, np.array(answer.mask, float)
    assert problem is not None
    others = mask.copy()
    others[images] = 0.0
    estimate = in_closed_form(answer.blocks)
    try:
        whole, rest = (
            solve_problem(replace(problem, mask=used), estimate) for used in (mask, others)
        )
    except InputError:
        return None
    return apart_in_image(whole, rest, problem, grid)
