"""Confidence intervals of a calibration, and its target registration error.

A calibration's covariance treats the tuned SDs as known. They are estimates from the same images,
so intervals use Student's t instead of the normal law. Its degrees of freedom are those of one of
the three kinds of residual (lateral, range, offset): the number n of used images less a third of
the unknowns. It is the usual small-sample approximation, and nothing more.

The target registration error (TRE) at an image point is the distance between the places where the
estimated and the true calibration put it. To first order it is |J d| with d ~ N(0, C), C the
covariance of all unknowns that move the point and J the point's derivatives by them
(:mod:`jaxcal.model.image_points`); its root mean square is sqrt(trace(J C J')).

Its distribution: with J C J' = L L', the error is L u rho for a uniformly distributed direction u
in k dimensions. rho^2 is chi squared, or k F(k, nu) if the SDs were tuned. So

    P(TRE <= r) = mean over directions of P(rho^2 <= r^2 / |L u|^2),

a mean over a few hundred directions that fill the sphere evenly.

References: Fitzpatrick, West and Maurer 1998 (TRE as a root mean square); Student 1908; Genz and
Bretz 2009, section 4.1.2 (radial and spherical integration); Roberts 2018 (the sequence);
Kackar and Harville 1984 (estimated weights).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from scipy import special

from jaxcal import InputError
from jaxcal.diagnostics.uncertainty import component_freedom
from jaxcal.model.image_points import mean_of_squares, point_jacobian
from jaxcal.model.unknowns import TINY, Values, in_image, measured, split_further
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.runtime.arrays import array_module, is_traced
from jaxcal.runtime.given_values import is_number, traceable_array
from jaxcal.runtime.jax_modes import traceable
from jaxcal.solvers.plan import TUNED

DIRECTIONS = 1024
"""Directions over which the distribution of an error is averaged. At a point of the
image, medians and upper ends of intervals are right to 0.2 %, lower ends to 1 % (along a single
axis 6 %). Over the image, in up to 11 dimensions, they are right to 1.3 and 9 %, which only errors
along one or two axes reach."""

LEVEL = 0.95
"""Probability that an interval of the target registration error holds the actual error; its tails
are equal."""

_RADII = 4000
"""Number of values of rho^2 between which its distribution is interpolated."""
_FIRST, _LAST = np.log(1e-9), np.log(1e9)
"""Logarithms of the least and the largest of these values, which are evenly spaced."""
_SPACING = (_LAST - _FIRST) / (_RADII - 1)
_AT_ONCE = 32
"""Vectors whose quantiles are computed together."""
_SPARSE = 16
"""The first rough solution uses one direction in so many."""
_MOST_STEPS = 60
"""Most steps of Newton's method."""
_LAST_STEP = 3e-6
"""A step of ln r^2 shorter than this is the last."""


def check_level(level: float) -> None:
    """Raise InputError for a probability that is not a number between 0 and 1."""
    if not (is_number(level) and 0 < level < 1):
        raise InputError(f"level must be between 0 and 1, not {level!r}")


def _check(calibration: object) -> None:
    if not hasattr(calibration, "linearisation"):
        raise InputError(
            f"{type(calibration).__name__} is not a result of jaxcal.calibrate, which alone knows "
            "its errors' degrees of freedom; a loaded calibration's apply() gives covariances"
        )


@traceable
def degrees_of_freedom(calibration: Calibration) -> Float[AnyArray, "*batch"]:
    """Degrees of freedom of the noise's SDs (traceable); inf where SDs were held fixed."""
    _check(calibration)
    xp = array_module(calibration)
    used = xp.sum(xp.asarray(calibration.mask) > 0, axis=-1)
    left = xp.asarray(component_freedom(used, calibration.blocks))
    if calibration.prior not in TUNED:
        return left
    return xp.where(calibration.sigma_tuned, left, np.inf)


def student_variance(left: Float[AnyArray, "*#b"]) -> Float[AnyArray, "*b"]:
    """Variance of Student's distribution by its degrees of freedom; 3 for fewer than 3 of them."""
    xp = array_module(left)
    # Given SDs have infinitely many: inf / inf would be NaN.
    finite = xp.maximum(xp.where(xp.isfinite(left), left, 4.0), 3.0)
    return xp.where(xp.isfinite(left), finite / (finite - 2), 1.0)


@traceable
def variance_factor(calibration: Calibration) -> Float[AnyArray, "*batch"]:
    """The factor by which mean square errors exceed what the covariance says (traceable).

    It is 1 for a fit with equal weights, whose variances are estimated nearly without bias. SDs
    that are tuned to the same images are also the weights of the fit. This makes the answer's error
    larger than with known weights, and larger than the covariance says (Kackar and Harville 1984).
    Student's variance corrects for both: see ``experiments/tre_calibration.py``.
    """
    xp = array_module(calibration)
    left = degrees_of_freedom(calibration)
    if calibration.prior not in TUNED:
        return xp.ones_like(left)
    return student_variance(left)


def transform_intervals(
    calibration: Calibration, level: float = LEVEL
) -> Float[np.ndarray, "*batch 6"]:
    """Half-widths of the intervals of X's six parameters, the right perturbation X Exp([v, omega]).

    Args:
        calibration: one or a batch, with concrete values.
        level: probability that an interval covers the true value.

    Returns:
        Along the image's lateral, elevational and axial axes in mm, then about them in rad; NaN
        where X is not observable.

    Raises:
        InputError: a level that is not between 0 and 1, or what is no result of a calibration.
        CalibrationError: under a JAX transformation.
    """
    check_level(level)
    _check(calibration)
    answer = calibration.numpy()
    left = np.asarray(degrees_of_freedom(answer), float)
    factor = np.where(
        np.isfinite(left),
        special.stdtrit(np.where(np.isfinite(left), left, 1.0), 0.5 + 0.5 * level),
        special.ndtri(0.5 + 0.5 * level),
    )
    variance = np.diagonal(answer.covariance, axis1=-2, axis2=-1)
    return factor[..., None] * np.sqrt(variance)


@traceable
def image_jacobian(
    calibration: Calibration, points: Float[AnyArray, "m 2"]
) -> Float[AnyArray, "*batch m 3 p"]:
    """Derivatives of image points by all unknowns of a calibration, image frame (traceable).

    Args:
        calibration: one or a batch.
        points: [lateral, axial], mm.
    """
    xp = array_module(calibration, points)
    origin, speed = range_of_row_zero(calibration)
    shape = (*np.shape(calibration.mask)[:-1], *points.shape)
    points = xp.broadcast_to(xp.asarray(points), shape)
    return point_jacobian(points, calibration.blocks, origin, speed, xp)


@traceable
def range_of_row_zero(
    calibration: Calibration,
) -> tuple[Float[AnyArray, "*batch"], Float[AnyArray, "*batch"]]:
    """The range of a measurement of 0, mm, and the factor on the nominal sound speed.

    A calibration without its problem is assumed to have no face offset.
    """
    _check(calibration)
    xp = array_module(calibration)
    face = 0.0 if calibration.problem is None else calibration.problem.face_offset
    one = xp.ones(np.shape(calibration.mask)[:-1])
    # A complex step, since a difference of ranges would have their rounding error.
    at = measured(0.0, one * (1j * TINY), xp.asarray(face), beside_scale(calibration))[1]
    return xp.asarray(xp.real(at)), xp.asarray(xp.imag(at) / TINY)


def beside_scale(calibration: Calibration) -> Values:
    """The estimated further unknowns but for the scale, which is in ``scale_mm_per_px``."""
    found = split_further(calibration.linearisation.further, calibration.blocks)
    return {name: value for name, value in found.items() if name != "scale"}


@traceable
def predicted_tre(
    calibration: Calibration, points: Float[AnyArray, "*points 2"]
) -> Float[AnyArray, "*shape"]:
    """Root mean square target registration error that the covariance predicts, mm (traceable).

    Estimated pixel sizes, sound speed and delay are included, with their correlation with X. Where
    SDs were tuned to the images (priors auto, uniform and gaussian), the mean square is larger than
    the covariance's trace, by the variance of Student's t: with 12 images by a factor of 9/7.

    Args:
        calibration: one or a batch.
        points: [lateral, axial] in the image plane, mm; any shape, a grid for a map.

    Returns:
        (*batch, *points) mm; NaN where X is not observable or the solve failed.

    Raises:
        InputError: points of another shape, or (if they are not traced) NaN or Inf.
    """
    xp = array_module(calibration, points)
    points = _image_points(points)
    covariance = error_covariance(calibration, points.reshape(-1, 2))
    found = xp.sqrt(
        variance_factor(calibration)[..., None] * xp.trace(covariance, axis1=-2, axis2=-1)
    )
    return found.reshape((*found.shape[:-1], *points.shape[:-1]))


def _image_points(points: Any) -> Any:
    """Points [lateral, axial], checked as far as they have values."""
    points = traceable_array(points, "points")
    if not is_traced(points) and not np.isfinite(points).all():
        raise InputError("points must be finite")
    if points.ndim == 0 or points.shape[-1] != 2:
        raise InputError(f"points must have shape (..., 2), not {points.shape}")
    return points


@traceable
def error_covariance(
    calibration: Calibration, points: Float[AnyArray, "m 2"]
) -> Float[AnyArray, "*batch m 3 3"]:
    """J C J' of image points [lateral, axial] (mm), in the image frame, mm^2 (traceable)."""
    xp = array_module(calibration, points)
    jacobian = image_jacobian(calibration, points)
    covariance = xp.asarray(calibration.unknowns_covariance)
    return xp.einsum("...mia,...ab,...mjb->...mij", jacobian, covariance, jacobian)


@dataclass(frozen=True)
class TargetError:
    """Target registration error, mm.

    Attributes:
        rms: root mean square.
        lower: lower end of the interval.
        upper: upper end.
    """

    rms: Float[np.ndarray, "*shape"]
    lower: Float[np.ndarray, "*shape"]
    upper: Float[np.ndarray, "*shape"]


def tre_at(calibration: Calibration, points: Float[np.ndarray, "*points 2"]) -> TargetError:
    """Target registration error to expect at image points, with intervals of :data:`LEVEL`.

    Args:
        calibration: one or a batch, with concrete values.
        points: [lateral, axial] in the image plane, mm.

    Returns:
        Arrays of shape (*batch, *points); NaN where X is not observable or the solve failed.

    Raises:
        InputError: points of another shape, NaN or Inf.
    """
    points = _image_points(points)
    covariance = np.asarray(error_covariance(calibration.numpy(), points.reshape(-1, 2)))
    batch = covariance.shape[:-3]
    return _errors(calibration, covariance.reshape(*batch, *points.shape[:-1], 3, 3))


def tre_over(calibration: Calibration, points: Float[np.ndarray, "m 2"]) -> TargetError:
    """Root mean square over image points of a calibration's error, with its interval.

    It is sqrt(mean of |J_p d|^2 over the points p), the single number with which two calibrations
    are compared over the image. Its interval is that of this number.

    Args:
        calibration: one or a batch, with concrete values.
        points: [lateral, axial] of points that fill the region, mm.
    """
    answer = calibration.numpy()
    rows = in_image(answer.blocks)
    jacobian = image_jacobian(answer, np.asarray(points, float))[..., rows]
    weight = mean_of_squares(jacobian)
    covariance = np.asarray(answer.unknowns_covariance, float)[..., rows[:, None], rows]
    values, vectors = np.linalg.eigh(weight)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    spread = np.swapaxes(root, -1, -2) @ covariance @ root
    return _errors(calibration, spread)


def _errors(calibration: Calibration, covariance: Float[np.ndarray, "*shape k k"]) -> TargetError:
    """Of vectors with Student's distribution and these covariances; a batch's axes come first."""
    finite = np.asarray(np.isfinite(covariance).all(axis=(-1, -2)))
    spread = np.where(finite[..., None, None], covariance, np.eye(covariance.shape[-1]))
    values = np.maximum(np.linalg.eigvalsh(spread), 0.0)
    batch = np.shape(calibration.status_code)
    alike = (*batch, *[1] * (finite.ndim - len(batch)))
    factor = np.asarray(variance_factor(calibration)).reshape(alike)
    left = np.asarray(degrees_of_freedom(calibration), float).reshape(alike)
    left = np.broadcast_to(left, finite.shape)
    lower, upper = np.full(finite.shape, np.nan), np.full(finite.shape, np.nan)
    for each in np.unique(left[finite]):
        rows = finite & (left == each)
        for chance, out in ((0.5 - 0.5 * LEVEL, lower), (0.5 + 0.5 * LEVEL, upper)):
            out[rows] = length_quantile(values[rows], float(each), chance)
    rms = np.where(finite, np.sqrt(factor * values.sum(axis=-1)), np.nan)
    return TargetError(rms, lower, upper)


def length_quantile(
    variances: Float[np.ndarray, "m k"], freedom: float, chance: float
) -> Float[np.ndarray, " m"]:
    """Quantile of the length of vectors with these variances along their axes.

    Args:
        variances: of each vector, along its principal axes.
        freedom: degrees of freedom of Student's distribution; inf: the vectors are normal.
        chance: the probability that a length is below the quantile.
    """
    dimensions = variances.shape[1]
    total = variances.sum(axis=1)
    shares = np.where(total[:, None] > 0, variances, 1.0)
    shares = shares / shares.sum(axis=1, keepdims=True)
    squares = (_directions(dimensions) ** 2).T
    radial = _radial(dimensions, freedom)
    found = np.empty(len(variances))
    # The arrays of a few vectors fit in the processor's cache.
    for first in range(0, len(variances), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        # |L u|^2 of every direction, as a share of the trace.
        along = np.log(np.maximum(shares[rows] @ squares, 1e-300))
        start = np.full(len(along), radial.quantile(chance) - np.log(dimensions))
        near = _solve(along[:, ::_SPARSE], radial, chance, start, 1e-2)
        found[rows] = _solve(along, radial, chance, near, _LAST_STEP)
    return np.exp(0.5 * found) * np.sqrt(total)


def _solve(
    along: Float[np.ndarray, "m d"],
    radial: _Radial,
    chance: float,
    start: Float[np.ndarray, " m"],
    near: float,
) -> Float[np.ndarray, " m"]:
    """The logarithm of r^2 at which the mean over the directions reaches a probability.

    It is found by Newton's method on the probability's logarithm, within a bracket.

    Args:
        along: logarithms of |L u|^2.
        radial: the distribution of rho^2.
        chance: the probability.
        start: where to begin.
        near: a step shorter than this is the last; the error is of the order of its square.
    """
    at = start
    low, high = np.full(len(at), _FIRST), np.full(len(at), _LAST)
    for _ in range(_MOST_STEPS):
        below, slope = radial.mean(at[:, None] - along)
        low, high = np.where(below < chance, at, low), np.where(below < chance, high, at)
        with np.errstate(divide="ignore", invalid="ignore"):
            after = at - np.log(below / chance) * below / slope
        after = np.where((after >= low) & (after <= high), after, 0.5 * (low + high))
        step = np.abs(after - at).max()
        at = after
        if step < near:
            break
    return at


@cache
def _directions(dimensions: int) -> Float[np.ndarray, "d k"]:
    """Unit vectors that fill the sphere evenly: normal scores of Roberts's sequence."""
    # The generalised golden ratio: the positive root of g^(k+1) = g + 1.
    golden = 1.5
    for _ in range(60):
        golden = (1 + golden) ** (1 / (dimensions + 1))
    steps = golden ** -np.arange(1, dimensions + 1)
    uniform = (0.5 + np.arange(1, DIRECTIONS + 1)[:, None] * steps) % 1.0
    normal = special.ndtri(np.clip(uniform, 1e-9, 1 - 1e-9))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@dataclass(frozen=True)
class _Radial:
    """The distribution of rho^2.

    Attributes:
        below: probabilities that it is below :data:`_RADII` values.
        rise: from each probability to the next.
    """

    below: Float[np.ndarray, " r"]
    rise: Float[np.ndarray, " r"]

    def quantile(self, chance: float) -> float:
        """The first of the logarithms at which a probability is reached."""
        return float(_FIRST + _SPACING * int(np.searchsorted(self.below, chance)))

    def mean(
        self, values: Float[np.ndarray, "m d"]
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Mean probability, by linear interpolation, and its slope; ``values`` are overwritten."""
        values -= _FIRST
        values *= 1 / _SPACING
        np.clip(values, 0.0, len(self.below) - 1, out=values)
        left = values.astype(np.intp)
        values -= left
        rise = self.rise.take(left)
        values *= rise
        values += self.below.take(left)
        return values.mean(axis=1), rise.mean(axis=1) / _SPACING


@lru_cache(maxsize=64)
def _radial(dimensions: int, freedom: float) -> _Radial:
    """The distribution of rho^2."""
    square = np.exp(np.linspace(_FIRST, _LAST, _RADII))
    if np.isfinite(freedom):
        below = special.fdtr(dimensions, freedom, square / dimensions)
    else:
        below = special.chdtr(dimensions, square)
    return _Radial(below, np.diff(below, append=below[-1]))
