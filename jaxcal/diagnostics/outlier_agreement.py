"""Do the images that were left out as outliers agree among themselves on another calibration?

If they do (a probe that was mounted anew, a second echo), the data do not say which of the two
groups is right. Each is fitted conventionally, and the two fits are compared by where they put the
image.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from jaxcal import InputError
from jaxcal.data.problem import Problem
from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.model.image_points import rms_distance, stretched
from jaxcal.model.unknowns import RIGID
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float
from jaxcal.solvers.closed_form.single import ClosedForm, in_closed_form, solve_problem

FEWEST_LEFT_OUT = 8
"""With fewer images left out there is no second group."""

LEAST_SHARE = 0.2
"""Nor is there one if they are less than this share of the images in use."""

LARGEST_SD_RATIO = 2.0
"""The images left out agree if the SD of their errors within the image, under a fit of their own,
is at most so many times that of the images in use."""

LEAST_APART = 3.0
"""The two fits differ if they are farther apart than so many times the error stated of both."""


def agreeing_outliers(
    answer: Calibration, stated: float, grid: Float[np.ndarray, "m 2"]
) -> tuple[int, float] | None:
    """Number of images left out that agree among themselves, and how far apart the fits are, mm.

    Args:
        answer: of one problem, on numpy arrays.
        stated: the error that the answer states, mm.
        grid: points of the image, [lateral, axial], mm, over which the distance is taken.

    Returns:
        None where no images were left out, where they are few, or where they do not agree.
    """
    problem, kept = answer.problem, np.asarray(answer.mask) > 0
    if not answer.robust or problem is None or answer.data != "points":
        return None
    # Frames of a pose that is held are masked in the answer's problem already.
    left = (np.asarray(problem.mask) > 0) & ~kept
    if left.sum() < max(FEWEST_LEFT_OUT, LEAST_SHARE * kept.sum()):
        return None
    estimate = in_closed_form(answer.blocks)
    try:
        own, other = (
            solve_problem(replace(problem, mask=mask.astype(float)), estimate)
            for mask in (kept, left)
        )
    except InputError:
        return None
    if not _sd_in_image(other, problem, left) <= LARGEST_SD_RATIO * _sd_in_image(
        own, problem, kept
    ):
        return None
    apart = apart_in_image(own, other, problem, grid)
    if apart <= LEAST_APART * stated * math.sqrt(1 + kept.sum() / left.sum()):
        return None
    return int(left.sum()), apart


def _sd_in_image(found: ClosedForm, problem: Problem, used: np.ndarray) -> float:
    """SD of the errors within the image of a conventional fit, mm."""
    off = ImageErrors.of_closed_form(found, problem, RIGID).errors[0, used, :2]
    freedom = max(2 * len(off) - 6, 1)
    return math.sqrt(float(np.sum(off**2)) / freedom)


def apart_in_image(
    first: ClosedForm | Calibration,
    second: ClosedForm | Calibration,
    problem: Problem,
    grid: Float[np.ndarray, "m 2"],
) -> float:
    """How far apart two calibrations put the same pixels on the probe, root mean square, mm.

    Args:
        first: of one problem, with concrete values.
        second: of the same problem.
        problem: for the given size of a pixel, and the range of pixel row 0.
        grid: points of the image by the first one, [lateral, axial], mm.
    """
    lateral, axial = _pixel_size(second, problem) / _pixel_size(first, problem)
    x, other = np.asarray(first.image_to_probe), np.asarray(second.image_to_probe)
    # Pixel sizes do not stretch the range of row 0.
    shift = (1 - axial) * np.asarray(problem.face_offset, float)
    return float(rms_distance(stretched(other, lateral, axial, shift), x, grid))


def _pixel_size(found: ClosedForm | Calibration, problem: Problem) -> Float[np.ndarray, " 2"]:
    """Lateral and axial size of a pixel, mm; ones for points in mm."""
    spacing = np.asarray(problem.spacing, float)
    return spacing if found.scale_mm_per_px is None else np.asarray(found.scale_mm_per_px)
