"""Tracked positions that are distorted, smoothly over the places of the probe.

Metal near an electromagnetic tracker, or the edge of its range, moves the positions that it reports
by nearly the same in neighbouring places. So errors of images are alike where their poses are, and
do not average out as the covariance assumes. The position t of an image is taken to be off by

    f(t) = sum_j phi_j(t) theta_j,    theta_j ~ N(0, s^2 I),

with phi_j the linear and quadratic polynomials of the position (the tracker's frame, mm, divided by
the SD of all of them), and coefficients theta_j in R^3 of one common variance. (A constant moves
the target only.) Orientations that are off in the same way move the target by smooth vectors as
well, and are found with it.

With e the whitened errors, J their derivatives by the unknowns and K those by theta, e + J d + K
theta has the SDs of the three kinds of errors and s as parameters. The restricted likelihood is
maximised by expectation maximisation, and compared with that of s = 0. The answer's unknowns follow
the errors by -(J' J)^-1 J', so a distortion moves them by R theta with R = -(J' J)^-1 J' K.

References: Harville 1977 (restricted likelihood); Laird and Ware 1982 (expectation maximisation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.model.unknowns import block_slice
from jaxcal.runtime.array_types import Bool, Float

Array = np.ndarray

_QUADRATIC = 0.5
"""Size of the quadratic polynomials relative to the linear ones, since the field is smooth."""
COEFFICIENTS = 27
"""Number of components of all theta_j: of three linear and six quadratic polynomials."""
_NEIGHBOURHOODS, _SHARE = 8, 0.1
"""Number of neighbourhoods, and the share of the positions in each."""
_ROUNDS = 40
"""Rounds of expectation maximisation; further ones raise the likelihood hardly."""


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
    return seen.rows[0][..., block_slice(seen.blocks, "point")] * [[1.0], [1.0], [0.0]]


def columns(seen: ImageErrors, used: Bool[Array, " n"]) -> Float[Array, "n 3 k"]:
    """Derivatives K of one recording's errors (mm) by the coefficients (mm)."""
    positions = np.asarray(seen.problem.poses)[0, :, :3, 3]
    # A position that is off moves the errors as a target does that is off the other way.
    along = -polynomials(positions, used)[:, None, :, None] * by_target(seen)[:, :, None, :]
    return along.reshape(*along.shape[:2], COEFFICIENTS)


def size(positions: Float[Array, "n 3"], used: Bool[Array, " n"], variance: float) -> float:
    """Root mean square distortion at the positions, mm, for a variance s^2, mm^2."""
    squares = np.sum(polynomials(positions, used)[used] ** 2, axis=1)
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


@dataclass(frozen=True)
class Distortion:
    """A random distortion that explains errors best.

    Attributes:
        statistic: twice the logarithm of the likelihood ratio.
        variance: s^2, mm^2.
        response: R, by which the answer's unknowns follow the coefficients, per mm.
    """

    statistic: float
    variance: float
    response: Float[Array, "p k"]


def fit(
    errors: Float[Array, "n 3"], rows: Float[Array, "n 3 q"], start: float
) -> Distortion | None:
    """The distortion that explains the errors best.

    Args:
        errors: e, of the images that count.
        rows: J and, as the last columns, K.
        start: a first s^2, mm^2.

    Returns:
        None if the errors do not determine the unknowns.
    """
    unknowns = rows.shape[-1] - COEFFICIENTS
    scale = 1 / np.sqrt(np.maximum(np.sum(rows[..., :unknowns] ** 2, axis=(0, 1)), 1e-300))
    parts = [rows[..., :unknowns] * scale, errors[..., None], rows[..., unknowns:]]
    whole = np.swapaxes(np.concatenate(parts, axis=-1), 0, 1)
    squares = np.swapaxes(whole, 1, 2) @ whole
    alone = unknowns + 1
    try:
        plain, _ = _maximised(squares[:, :alone, :alone], unknowns, len(errors), start)
        distorted, variance = _maximised(squares, unknowns, len(errors), start)
        fixed = squares.sum(axis=0)[:unknowns]
        response = -np.linalg.solve(fixed[:, :unknowns], fixed[:, alone:])
    except np.linalg.LinAlgError:
        return None
    return Distortion(plain - distorted, variance, scale[:, None] * response)


def _maximised(
    squares: Float[Array, "3 c c"], unknowns: int, images: int, variance: float
) -> tuple[float, float]:
    """-2 ln of the restricted likelihood at its maximum, and s^2.

    ``squares`` are, of each kind, the products of the columns: unknowns, errors, coefficients.
    """
    free = np.delete(np.arange(squares.shape[-1]), unknowns)
    rows, along = squares[:, free][..., free], squares[:, free, unknowns]
    own = squares[:, unknowns, unknowns]
    random = len(free) - unknowns
    kinds, cost = np.ones(3), np.inf
    for _ in range(_ROUNDS):
        precision = np.repeat([0.0, 1 / variance], [unknowns, random])
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
    return float(cost), variance
