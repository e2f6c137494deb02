"""Tracked poses that are off by what depends on the place or on the orientation of the probe.

Metal near an electromagnetic tracker, or the edge of its range, moves the positions that it reports
by nearly the same in neighbouring places. So errors of images are alike where their poses are, and
do not average out as the covariance assumes. The position t of an image is taken to be off by

    f(t) = sum_j phi_j(t) theta_j,    theta_j ~ N(0, s^2 I),

with phi_j the linear and quadratic polynomials of the position (the tracker's frame, mm, divided by
the SD of all of them), and coefficients theta_j in R^3 of one common variance. (A constant moves
the target only.) Orientations that are off in the same way move the target by smooth vectors as
well, and are found with it.

Markers that are wrong, or partly hidden, from some sides give poses that are off by what
depends on the orientation of the probe. Then the image moves on the probe, within its plane, by

    g(a) = sum_k a_k theta_k,    theta_k ~ N(0, s^2 I),

with a the rotation vector from the mean orientation, in the probe's frame, divided by the SD of all
of them, and theta_k the motion along and about the image's axes (a rotation in mm at the points'
root mean square distance from the image's origin).

With e the whitened errors, J their derivatives by the unknowns and K those by theta, e + J d + K
theta has the SDs of the three kinds of errors and s as parameters. The restricted likelihood is
maximised by expectation maximisation, and compared with that of s = 0. The answer's unknowns follow
the errors by -(J' J)^-1 J', so a distortion moves them by R theta with R = -(J' J)^-1 J' K.

References: Harville 1977 (restricted likelihood); Laird and Ware 1982 (expectation maximisation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxcal.data.poses import nearest_rotations, vectors_from_rotations
from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.model.unknowns import block_slice
from jaxcal.runtime.array_types import Bool, Float

Array = np.ndarray

_QUADRATIC = 0.5
"""Size of the quadratic polynomials relative to the linear ones, since the field is smooth."""
WITHIN = (0, 2, 4)
"""Parameters of X that move the image within its plane: laterally, axially, and about y."""
_NEIGHBOURHOODS, _SHARE = 8, 0.1
"""Number of neighbourhoods, and the share of the positions in each."""
_ROUNDS = 40
"""Rounds of expectation maximisation; further ones raise the likelihood hardly."""
_ALIKE = 0.5
"""Shares of two lengths are alike if the smaller is at least so much of the larger: few images
determine them no better."""
_UNDETERMINED = 1e-6
"""Information on unknowns of unit columns, for those that some kinds of errors do not determine:
errors within the image plane say nothing of a motion of the image along its normal."""


def polynomials(positions: Float[Array, "n 3"], used: Bool[Array, " n"]) -> Float[Array, "n 9"]:
    """The linear and quadratic polynomials phi of the positions; constants if all are the same."""
    apart = positions - positions[used].mean(axis=0)
    spread = np.sqrt(np.mean(apart[used] ** 2))
    x, y, z = (apart / max(spread, 1e-300)).T
    squares = [(each**2 - 1) / np.sqrt(2) for each in (x, y, z)]
    quadratic = np.stack([*squares, x * y, x * z, y * z], axis=1)
    return np.concatenate([np.stack([x, y, z], axis=1), _QUADRATIC * quadratic], axis=1)


def by_target(seen: ImageErrors) -> Float[Array, "n 3 3"]:
    """Derivatives of one recording's errors by the target, 0 for elevational errors.

    Those do not count: the placement of the target may change with the pose as well.
    """
    return seen.in_plane(block_slice(seen.blocks, "point"))


def orientations(poses: Float[Array, "n 4 4"], used: Bool[Array, " n"]) -> Float[Array, "n 3"]:
    """Rotation vectors a from the mean orientation; zeros if all orientations are the same."""
    turns = np.where(used[:, None, None], poses[:, :3, :3], np.eye(3))
    mean, _ = nearest_rotations(turns[used].mean(axis=0)[None])
    vectors = vectors_from_rotations(np.swapaxes(mean, 1, 2) @ turns)
    vectors = vectors - vectors[used].mean(axis=0)
    return vectors / max(np.sqrt(np.mean(vectors[used] ** 2)), 1e-300)


class RandomField(NamedTuple):
    """What the poses of one recording may be off by, as basis functions of the place.

    Every basis function has three coefficients, of one common variance.

    Attributes:
        places: of the images: positions in mm, or rotation vectors.
        basis: the basis functions at the images' places.
        along: derivatives of the images' errors (mm) by the field's three components there (mm).
    """

    places: Float[Array, "n 3"]
    basis: Float[Array, "n b"]
    along: Float[Array, "n 3 3"]

    @classmethod
    def of_positions(cls, seen: ImageErrors, used: Bool[Array, " n"]) -> RandomField:
        """The field f, by which positions are off."""
        positions = np.asarray(seen.problem.poses)[0, :, :3, 3]
        # A position that is off moves the errors as a target does that is off the other way.
        return cls(positions, polynomials(positions, used), -by_target(seen))

    @classmethod
    def of_orientations(cls, seen: ImageErrors, used: Bool[Array, " n"]) -> RandomField:
        """The field g, by which the image moves on the probe."""
        vectors = orientations(np.asarray(seen.problem.poses)[0], used)
        lever = float(seen.lever(seen.mask)[0])
        within = seen.in_plane(WITHIN) / [1.0, 1.0, lever]
        return cls(vectors, vectors, within)

    def columns(self) -> Float[Array, "n 3 k"]:
        """Derivatives K of the images' errors (mm) by the k = 3 b coefficients (mm)."""
        by = self.basis[:, None, :, None] * self.along[:, :, None, :]
        return by.reshape(*by.shape[:2], -1)

    def size(self, used: Bool[Array, " n"], variance: float) -> float:
        """Root mean square of the field at the places of the images in use, mm.

        Args:
            used: those images.
            variance: s^2, mm^2.
        """
        squares = np.sum(self.basis[used] ** 2, axis=1)
        return float(np.sqrt(3 * variance * np.mean(squares)))


def neighbourhoods(positions: Float[Array, "n 3"]) -> list[Bool[Array, " n"]]:
    """Which positions are the nearest ones to each of some that are far apart."""
    found: list[Array] = []
    squares = np.sum((positions - positions.mean(axis=0)) ** 2, axis=1)
    for _ in range(_NEIGHBOURHOODS):
        # The farthest of the middle, then of all centres before.
        away = np.sum((positions - positions[np.argmax(squares)]) ** 2, axis=1)
        squares = np.minimum(squares, away) if found else away
        near = np.zeros(len(positions), bool)
        near[np.argsort(away)[: max(2, round(_SHARE * len(positions)))]] = True
        found.append(near)
    return found


def too_short(shares: Float[Array, " 2"]) -> float | None:
    """By which share tracked positions may be too short if the image is too large by these shares.

    Only the lengths' ratio shows in the images. So a marker that is printed too small, say, is not
    told from pixels that are stated too large, if the image is too large along both axes.

    Returns:
        None if the two shares are not alike.
    """
    small, large = np.sort(np.abs(shares))
    alike = shares.prod() > 0 and small >= _ALIKE * large
    return float(shares.mean()) if alike else None


@dataclass(frozen=True)
class Distortion:
    """The random field that explains errors best.

    Attributes:
        statistic: twice the logarithm of the likelihood ratio.
        variance: s^2, mm^2.
        response: R, by which the answer's unknowns follow the coefficients, per mm.
        kinds: variances of the kinds of errors beside it.
    """

    statistic: float
    variance: float
    response: Float[Array, "p k"]
    kinds: Float[Array, " kinds"]


def fit(
    errors: Float[Array, "n 3"],
    rows: Float[Array, "n 3 q"],
    start: float,
    coefficients: int,
) -> Distortion | None:
    """The random field that explains the errors best.

    Args:
        errors: e, of the images that count.
        rows: J and, as the last columns, K.
        start: a first s^2, mm^2.
        coefficients: the number of columns of K.

    Returns:
        None if the errors do not determine the unknowns.
    """
    unknowns = rows.shape[-1] - coefficients
    squares, scale = _squares(errors, rows, unknowns)
    try:
        statistic, variance, kinds = _compared(squares, unknowns, len(errors), start)
        fixed = squares.sum(axis=0)[:unknowns]
        response = -np.linalg.solve(fixed[:, :unknowns], fixed[:, unknowns + 1 :])
    except np.linalg.LinAlgError:
        return None
    return Distortion(statistic, variance, scale[:, None] * response, kinds)


def statistic(
    errors: Float[Array, "n kinds"],
    rows: Float[Array, "n kinds q"],
    start: float,
    coefficients: int,
) -> float:
    """Twice the logarithm of the likelihood ratio alone, also of some kinds of errors only.

    Args:
        errors: e, of the images that count.
        rows: J and, as the last columns, K.
        start: a first s^2, mm^2.
        coefficients: the number of columns of K.

    Returns:
        -inf where the likelihood has no maximum.
    """
    unknowns = rows.shape[-1] - coefficients
    squares, _ = _squares(errors, rows, unknowns)
    try:
        return _compared(squares, unknowns, len(errors), start)[0]
    except np.linalg.LinAlgError:
        return -np.inf


def _squares(
    errors: Float[Array, "n kinds"], rows: Float[Array, "n kinds q"], unknowns: int
) -> tuple[Float[Array, "kinds c c"], Float[Array, " p"]]:
    """Of each kind, the products of the columns: unknowns, errors, coefficients.

    The unknowns' columns have unit length; with the factors by which they are multiplied.
    """
    scale = 1 / np.sqrt(np.maximum(np.sum(rows[..., :unknowns] ** 2, axis=(0, 1)), 1e-300))
    parts = [rows[..., :unknowns] * scale, errors[..., None], rows[..., unknowns:]]
    whole = np.swapaxes(np.concatenate(parts, axis=-1), 0, 1)
    return np.swapaxes(whole, 1, 2) @ whole, scale


def _compared(
    squares: Float[Array, "kinds c c"], unknowns: int, images: int, start: float
) -> tuple[float, float, Float[Array, " kinds"]]:
    """Twice the logarithm of the likelihood ratio, s^2, and the variances of the kinds."""
    alone = unknowns + 1
    plain, *_ = _maximised(squares[:, :alone, :alone], unknowns, images, start)
    distorted, variance, kinds = _maximised(squares, unknowns, images, start)
    return plain - distorted, variance, kinds


def _maximised(
    squares: Float[Array, "kinds c c"], unknowns: int, images: int, variance: float
) -> tuple[float, float, Float[Array, " kinds"]]:
    """-2 ln of the restricted likelihood at its maximum, s^2, and the variances of the kinds.

    ``squares`` are those of :func:`_squares`.
    """
    free = np.delete(np.arange(squares.shape[-1]), unknowns)
    rows, along = squares[:, free][..., free], squares[:, free, unknowns]
    own = squares[:, unknowns, unknowns]
    random = len(free) - unknowns
    kinds, cost = np.ones(len(squares)), np.inf
    for _ in range(_ROUNDS):
        precision = np.repeat([_UNDETERMINED, 1 / variance], [unknowns, random])
        matrix = np.tensordot(1 / kinds, rows, axes=1) + np.diag(precision)
        factor = np.linalg.inv(np.linalg.cholesky(matrix))
        inverse = factor.T @ factor
        best = -inverse @ (1 / kinds @ along)
        left = best @ rows @ best + 2 * along @ best + own
        cost = images * np.log(kinds).sum() + np.sum(left / kinds) + precision @ best**2
        cost += random * np.log(variance) - 2 * np.log(np.diag(factor)).sum()
        # The squares to expect of errors and coefficients, given the data.
        kinds = (left + np.sum(inverse * rows, axis=(1, 2))) / images
        if random:
            spread = best[unknowns:] @ best[unknowns:] + np.trace(inverse[unknowns:, unknowns:])
            variance = float(spread) / random
    return float(cost), variance, kinds
