"""Do two calibrations of one probe agree? The same image points by both of them. Numpy only.

Each puts an image point somewhere on the probe. To first order in their errors d_1 and d_2, with
the derivatives D of a point by the unknowns, the two places are

    D_1 d_1 - D_2 d_2

apart if both estimate the same transform. The root mean square of this over the points is the
length of a vector, whose quantiles :mod:`jaxcal.diagnostics.intervals` computes: normal if all SDs
were given. SDs estimated from the images make d_1 and d_2 Student's, with n_1 and n_2 degrees of
freedom, and then the vector is taken for Student's, with the degrees of freedom

    n = (v_1 + v_2)^2 / (v_1^2 / n_1 + v_2^2 / n_2),

where v_1 and v_2 are the two mean squares (Welch 1947, Satterthwaite 1946). n is at least the
smaller of n_1 and n_2, and at most their sum. Where it is larger than n_i, Student's variance is
smaller for n than for n_i; if the mean square of d_i has this factor (``variance_factor``), the
covariance of D_i d_i is enlarged to make up for the difference. It is never made smaller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import rotation_angle
from jaxcal.diagnostics.intervals import LEVEL, check_level, length_quantile, student_variance
from jaxcal.result.calibration import Calibration
from jaxcal.result.transform import ImageTransform
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import outline
from jaxcal.runtime.given_values import check_made

_LEAST_SHARE = 1e-6
"""Least share of the mean square at which a direction of the errors counts."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two calibrations at the same image points.

    Attributes:
        points: (m, 2) image points, px, or [lateral, range] in mm where there are no pixels.
        apart_mm: (m,) how far apart the two calibrations put each point, mm.
        expected_mm: (m,) its root mean square by both covariances (and ``variance_factor``), mm;
            NaN where one is not known.
        rms_mm: root mean square of ``apart_mm``, mm.
        expected_rms_mm: the same of ``expected_mm``, mm.
        limit_mm: by both covariances, 95 % of such pairs (or the share that was asked for) have a
            smaller ``rms_mm``, mm.
        rotation_deg: angle between the two orientations of the image, degrees.
    """

    points: Float[np.ndarray, "m 2"]
    apart_mm: Float[np.ndarray, " m"]
    expected_mm: Float[np.ndarray, " m"]
    rms_mm: float
    expected_rms_mm: float
    limit_mm: float
    rotation_deg: float

    __repr__ = outline

    @property
    def agree(self) -> bool | None:
        """Whether they are less than ``limit_mm`` apart; None if a covariance is not known."""
        return None if np.isnan(self.limit_mm) else bool(self.rms_mm <= self.limit_mm)


def compare_calibrations(
    first: Calibration | ImageTransform,
    second: Calibration | ImageTransform,
    points: Float[np.ndarray, "m 2"] | Float[np.ndarray, " 2"],
    *,
    level: float = LEVEL,
) -> Comparison:
    """Map the same image points by two calibrations of one probe, and compare.

    The calibrations must come from different recordings: otherwise they share their errors, and are
    nearer to each other than is expected here. The marker on the probe must be the same.

    Args:
        first: a calibration, computed or from :func:`jaxcal.load_calibration`.
        second: another one; both take pixels, or both points in mm.
        points: [u, v] of image points, px, or [lateral, range] in mm; also a single one, (2,).
        level: share of such pairs that are nearer than ``limit_mm``. Of k pairs that are all right,
            none is farther apart than at 1 - 0.05 / k in 95 % of cases (Bonferroni).

    Returns:
        How far apart the points are, and what the covariances expect: a :class:`Comparison`.

    Raises:
        InputError: what is no calibration, a batch, one that must not be used, only one that takes
            pixels, a level that is not between 0 and 1, or points that
            :meth:`ImageTransform.apply` refuses.
        CalibrationError: under a JAX transformation.
    """
    check_level(level)
    first, second = _transform("first", first), _transform("second", second)
    if (first.scale_mm_per_px is None) != (second.scale_mm_per_px is None):
        without, other = first, second
        if second.scale_mm_per_px is None:
            without, other = second, first
        raise InputError(
            f"{without.source} takes points in mm, {other.source} pixels: the same image points "
            "cannot be given to both"
        )
    one, other = first.apply(points), second.apply(points)
    points = np.atleast_2d(np.asarray(points, float))
    apart = np.linalg.norm(one.points - other.points, axis=1)
    variances = np.trace(one.covariance + other.covariance, axis1=1, axis2=2)
    limit = np.nan
    if np.isfinite(variances).all():
        limit = _limit(first, second, points, level)
    return Comparison(
        points=points,
        apart_mm=apart,
        expected_mm=np.sqrt(variances),
        rms_mm=float(np.sqrt(np.mean(apart**2))),
        expected_rms_mm=float(np.sqrt(np.mean(variances))),
        limit_mm=float(limit),
        rotation_deg=float(
            np.degrees(rotation_angle(first.image_plane_to_probe, second.image_plane_to_probe))
        ),
    )


def _limit(
    first: ImageTransform, second: ImageTransform, points: Float[np.ndarray, "m 2"], level: float
) -> float:
    """The quantile ``level`` of the points' RMS distance, mm."""
    both = (first, second)
    factors = [each.error_factor(points).reshape(3 * len(points), -1) for each in both]
    squares = np.array(
        [
            each.variance_factor * np.sum(factor**2)
            for each, factor in zip(both, factors, strict=True)
        ]
    )
    left = _combined_freedom(squares, [each.degrees_of_freedom or inf for each in both])
    student = float(student_variance(np.array(left)))
    # The root mean square is the length of this matrix times Student's vector.
    factor = np.concatenate(
        [
            math.sqrt(max(1.0, each.variance_factor / student)) * factor
            for each, factor in zip(both, factors, strict=True)
        ],
        axis=1,
    )
    spread = np.linalg.eigvalsh(factor.T @ factor / len(points))
    # Both move the points alike, so that half of these directions do nothing.
    spread = spread[spread >= _LEAST_SHARE * spread.sum()]
    return float(length_quantile(spread[None], left, level)[0])


def _combined_freedom(squares: Float[np.ndarray, " 2"], freedom: list[float]) -> float:
    """Degrees of freedom of a difference, from both mean squares and theirs (Welch)."""
    uncertain = np.sum(squares**2 / freedom)
    return float(np.sum(squares) ** 2 / uncertain) if uncertain > 0 else inf


def _transform(name: str, given: object) -> ImageTransform:
    """The transform that a caller gave, or that of a result, if it can be used."""
    if isinstance(given, Calibration):
        given = replace(given.image_transform(), source=name)
    check_made(name, given, ImageTransform, "jaxcal.calibrate or load_calibration")
    assert isinstance(given, ImageTransform)
    given.check_usable()
    return given
