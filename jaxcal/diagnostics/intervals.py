"""Intervals of a calibration, and how far from the truth it puts what is seen in an image.

A calibration's covariance takes the tuned SDs for known. They are estimates from the same images,
so intervals use Student's t instead of the normal law. Its degrees of freedom are those left to one
kind of residual: of the n used images' three kinds (lateral, range, offset) the unknowns take a
third each. It is the usual small-sample approximation, and nothing more.

The target registration error (TRE) at an image point p is the distance between where the estimated
and the true transform put it. To first order X_true p = X Exp(d) p with d ~ N(0, covariance), so
the error is J d with J = [I, -[p]x], and the root mean square error is sqrt(trace(J C J')).

References: Fitzpatrick, West and Maurer 1998 (TRE as a root mean square); Student 1908.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy import stats

from jaxcal.diagnostics.arrays import array_module, traceable
from jaxcal.diagnostics.uncertainty import TUNED
from jaxcal.errors import InputError
from jaxcal.geometry import AnyArray
from jaxcal.model.parameters import size

if TYPE_CHECKING:
    from jaxcal.calibration import Calibration


@traceable
def degrees_of_freedom(calibration: Calibration) -> Float[AnyArray, "*batch"]:
    """What the used images leave for the noise's SDs (traceable); inf where SDs were given."""
    xp = array_module(calibration)
    left = xp.sum(xp.asarray(calibration.mask) > 0, axis=-1) - size(calibration.blocks) / 3
    if calibration.prior not in TUNED:
        return xp.asarray(xp.maximum(left, 1.0))
    return xp.where(calibration.sigma_tuned, xp.maximum(left, 1.0), np.inf)


def transform_intervals(
    calibration: Calibration, level: float = 0.95
) -> Float[np.ndarray, "*batch 6"]:
    """Half-widths of the intervals of X's six parameters, the right perturbation X Exp([v, omega]).

    Args:
        calibration: one or a batch, with concrete values.
        level: probability that an interval covers the true value.

    Returns:
        mm along, then rad about the image's lateral, elevational and axial axes; NaN where X is not
        observable.

    Raises:
        InputError: a level that is no probability between 0 and 1.
    """
    if not 0 < level < 1:
        raise InputError(f"level must be between 0 and 1, not {level}")
    factor = stats.t.ppf(0.5 + 0.5 * level, np.asarray(degrees_of_freedom(calibration)))
    variance = np.diagonal(calibration.numpy().covariance, axis1=-2, axis2=-1)
    return factor[..., None] * np.sqrt(variance)


@traceable
def predicted_tre(
    calibration: Calibration, points: Float[AnyArray, "*points 2"]
) -> Float[AnyArray, "*shape"]:
    """Root mean square target registration error that the covariance predicts, mm (traceable).

    Args:
        calibration: one or a batch.
        points: [lateral, axial] in the image plane, mm; any shape, a grid for a map.

    Returns:
        (*batch, *points) mm; NaN where X is not observable.
    """
    xp = array_module(calibration, points)
    points = xp.asarray(points)
    lateral, axial = points[..., 0].ravel(), points[..., 1].ravel()
    zero, one = xp.zeros_like(lateral), xp.ones_like(lateral)
    # I and omega x p with p = (lateral, 0, axial).
    rows = (
        (one, zero, zero, zero, axial, zero),
        (zero, one, zero, -axial, zero, lateral),
        (zero, zero, one, zero, -lateral, zero),
    )
    jacobian = xp.stack([xp.stack(row, axis=-1) for row in rows])
    left = degrees_of_freedom(calibration)
    # Student's variance exceeds the normal one's by this factor.
    factor = xp.where(xp.isfinite(left), left / xp.maximum(left - 2, 1.0), 1.0)
    covariance = xp.asarray(calibration.covariance)
    square = xp.einsum("kma,...ab,kmb->...m", jacobian, covariance, jacobian)
    found = xp.sqrt(factor[..., None] * square)
    return found.reshape(*found.shape[:-1], *points.shape[:-1])
