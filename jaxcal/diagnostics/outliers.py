"""Images that do not fit the rest (outliers), and those that hardly do (suspects), in words."""

from __future__ import annotations

from statistics import NormalDist
from typing import Protocol, TypedDict, runtime_checkable

import numpy as np

from jaxcal.diagnostics.image_errors import KINDS
from jaxcal.diagnostics.residual_checks import FEWEST_TO_CHECK
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import AnyArray
from jaxcal.runtime.arrays import plain
from jaxcal.runtime.messages import first_ones

SUSPECTED = 0.01
"""Share of recordings with Gaussian errors in which chance alone makes an image suspect."""


class OutlierReason(TypedDict):
    """Why an image is an outlier: its most deviant component, and by how many SDs (signed)."""

    image: int
    component: str
    sds: float | None
    left_out: bool


@runtime_checkable
class HasOutliers(Protocol):
    """A result whose images may be outliers."""

    @property
    def outlier(self) -> AnyArray:
        """(n,) 1 where an image is an outlier."""
        ...

    @property
    def studentised_errors(self) -> AnyArray:
        """(n, 3) errors of each image in SDs, corrected for leverage."""
        ...

    @property
    def mask(self) -> AnyArray:
        """(n,) 1 for used images."""
        ...


def outliers(result: HasOutliers) -> list[int]:
    """Indices of the images that do not fit the rest (see :mod:`jaxcal.solvers.consensus`)."""
    return [int(image) for image in np.flatnonzero(np.asarray(result.outlier) > 0)]


def outlier_reasons(
    result: HasOutliers, components: tuple[str, ...] = KINDS
) -> list[OutlierReason]:
    """For every outlier: its most deviant component, by how many SDs, and whether it was left out.

    The keys are ``image``, ``component`` (a name from ``components``), ``sds`` (signed) and
    ``left_out``.
    """
    studentised = np.asarray(result.studentised_errors, dtype=float)
    found: list[OutlierReason] = []
    for image in outliers(result):
        worst = int(np.argmax(np.abs(studentised[image])))
        reason: OutlierReason = {
            "image": image,
            "component": components[worst],
            "sds": plain(studentised[image, worst]),
            "left_out": bool(np.asarray(result.mask)[image] == 0),
        }
        found.append(reason)
    return found


def listed_outliers(result: HasOutliers, components: tuple[str, ...] = KINDS) -> str:
    """The first ten outliers with component and SDs, in words."""
    reasons = outlier_reasons(result, components)
    told = [
        f"{reason['image']} ({reason['component']}, {abs(reason['sds'] or 0):.0f} SDs)"
        for reason in reasons
    ]
    return first_ones(told)


def suspects(result: Calibration) -> list[OutlierReason]:
    """Images in use that deviate by less than outliers do, but by more than chance explains.

    With Gaussian errors, the largest range error of all images (in SDs taken from medians, at the
    target's place in the image) exceeds the limit in one recording of a hundred
    (:data:`SUSPECTED`). Only range errors count: offsets may have any law, so large ones are no
    sign of a wrong image.
    """
    count = int(result.images_used)
    if count < FEWEST_TO_CHECK:
        return []
    # The second factor corrects medians of few images; it is from simulated Gaussian errors.
    limit = NormalDist().inv_cdf(1 - SUSPECTED / (2 * count)) * (1 + 8 / count)
    error = np.array(result.inspection.range_at_place, dtype=float)
    error[outliers(result)] = 0.0
    return [
        {
            "image": int(image),
            "component": KINDS[1],
            "sds": plain(error[image]),
            "left_out": False,
        }
        for image in np.flatnonzero(np.abs(error) > limit)
    ]


def suspects_in_words(result: Calibration) -> list[str]:
    """The suspects in words; successive ones with errors of one sign are joined."""
    runs: list[list[OutlierReason]] = []
    for each in suspects(result):
        last = runs[-1][-1] if runs else None
        one_side = last is not None and (each["sds"] or 0) * (last["sds"] or 0) > 0
        if last is not None and one_side and each["image"] == last["image"] + 1:
            runs[-1].append(each)
        else:
            runs.append([each])
    told = []
    for run in runs:
        sizes = sorted(abs(each["sds"] or 0) for each in run)
        first, last = run[0]["image"], run[-1]["image"]
        if first == last:
            told.append(f"{first} ({run[0]['component']} error, {sizes[0]:.1f} SDs)")
        else:
            told.append(
                f"{first} to {last} in a row ({run[0]['component']} errors to one side, "
                f"{sizes[0]:.1f} to {sizes[-1]:.1f} SDs)"
            )
    if not told:
        return []
    listed = first_ones(told)
    return [
        f"suspicious images: {listed}; their errors are too large for chance, but not large "
        "enough to leave them out: check them"
    ]
