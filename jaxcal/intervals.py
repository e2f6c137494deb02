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

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from jaxcal.calibration import Calibration
from jaxcal.diagnosis import TUNED
from jaxcal.errors import InputError
from jaxcal.geometry import AnyArray
from jaxcal.model.parameters import size
from jaxcal.precision import in_own_modes


@in_own_modes
def degrees_of_freedom(calibration: Calibration) -> Float[Array, "*batch"]:
    """What the used images leave for the noise's SDs (traceable); inf where SDs were given."""
    left = calibration.images_used - size(calibration.blocks) / 3
    tunable = calibration.prior in TUNED
    told = jnp.asarray(tunable) & jnp.logical_not(calibration.sigma_tuned)
    return jnp.where(told, jnp.inf, jnp.maximum(left, 1.0))


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
    result = calibration.numpy()
    factor = stats.t.ppf(0.5 + 0.5 * level, np.asarray(degrees_of_freedom(result)))
    variance = np.diagonal(result.covariance, axis1=-2, axis2=-1)
    return factor[..., None] * np.sqrt(variance)


@in_own_modes
def predicted_tre(
    calibration: Calibration, points: Float[AnyArray, "*points 2"]
) -> Float[Array, "*shape"]:
    """Root mean square target registration error that the covariance predicts, mm (traceable).

    Args:
        calibration: one or a batch.
        points: [lateral, axial] in the image plane, mm; any shape, a grid for a map.

    Returns:
        (*batch, *points) mm; NaN where X is not observable.
    """
    points = jnp.asarray(points)
    lateral, axial = points[..., 0].ravel(), points[..., 1].ravel()
    zero, one = jnp.zeros_like(lateral), jnp.ones_like(lateral)
    # omega x p with p = (lateral, 0, axial).
    jacobian = jnp.stack([
        jnp.stack([one, zero, zero, zero, axial, zero], axis=-1),
        jnp.stack([zero, one, zero, -axial, zero, lateral], axis=-1),
        jnp.stack([zero, zero, one, zero, -lateral, zero], axis=-1),
    ])  # fmt: skip
    covariance = jnp.asarray(calibration.covariance)
    left = degrees_of_freedom(calibration)
    # Student's variance exceeds the normal one's by this factor.
    factor = jnp.where(jnp.isfinite(left), left / jnp.maximum(left - 2, 1.0), 1.0)
    square = jnp.einsum("kma,...ab,kmb->...m", jacobian, covariance, jacobian)
    found = jnp.sqrt(factor[..., None] * square)
    return found.reshape(*found.shape[:-1], *points.shape[:-1])
