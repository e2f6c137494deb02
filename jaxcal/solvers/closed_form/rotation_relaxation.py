"""A lower bound on Eq. 7 from a small semidefinite program, where three multipliers are too few.

The dual of :mod:`jaxcal.solvers.closed_form.single` uses only that a1 and a3 are orthogonal and of
known length. A rotation satisfies more: its rows are orthonormal as well, and every column is the
cross product of the two others. Each of these is a quadratic equation v' B_j v = 0 in v = (1,
a1, a2, a3), or in v = (1, s, a1, a2, a3) with one common unknown scale s. With f = v' F v, any
multipliers for which

    Z = F - bound e0 e0' + sum_j lambda_j B_j

is positive definite prove f >= bound: for a v that satisfies the equations, 0 <= v'Z v = f - bound.
The largest such bound is found by a barrier method on the 21 or 22 multipliers: bound + weight ln
det Z is maximised for falling weights, each time by Newton's method. The iterates are strictly
feasible, so the bound holds wherever the iteration stops; the solver's accuracy decides only how
tight it is.

References: Briales and Gonzalez-Jimenez, "Convex global 3D registration with Lagrangian duality",
CVPR 2017 (the redundant rotation constraints); Boyd and Vandenberghe, "Convex Optimization",
section 11.6 (the barrier method).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np

from jaxcal.runtime.array_types import Float, Int
from jaxcal.solvers.closed_form.reduced_objective import ReducedObjective

BARRIER_DECREASE = 0.15
"""Factor on the barrier's weight once the problem with the present weight is solved."""
CENTRED_BELOW = 0.3
"""Newton decrement below which the weight falls."""
MOST_STEPS = 300
"""Most steps of the interior-point method."""


@cache
def _equations(scaled: bool) -> Float[np.ndarray, "m v v"]:
    """Orthonormal basis of the matrices B_j; with a common scale, s takes the place of 1."""
    size, unit = (11, 1) if scaled else (10, 0)
    first = size - 9

    def column(k: int) -> list[int]:
        return [first + 3 * k + i for i in range(3)]

    found = []

    def equation(*terms: tuple[int, int, float]) -> None:
        matrix = np.zeros((size, size))
        for i, j, value in terms:
            matrix[i, j] += value / 2
            matrix[j, i] += value / 2
        found.append(matrix.ravel())

    for i, j in itertools.combinations_with_replacement(range(3), 2):
        right = (unit, unit, -1.0 if i == j else 0.0)
        equation(*((a, b, 1.0) for a, b in zip(column(i), column(j), strict=True)), right)
        equation(*((column(k)[i], column(k)[j], 1.0) for k in range(3)), right)
    for i in range(3):
        a, b, c = column(i), column((i + 1) % 3), column((i + 2) % 3)
        for k in range(3):
            p, q = (k + 1) % 3, (k + 2) % 3
            equation((a[p], b[q], 1.0), (a[q], b[p], -1.0), (unit, c[k], -1.0))
    # The sum of the rows' squared lengths equals that of the columns, so one equation is redundant.
    _, values, right = np.linalg.svd(np.array(found), full_matrices=False)
    return right[values > 1e-9].reshape(-1, size, size)


@dataclass(frozen=True)
class _Program:
    """Maximise ``multipliers[0]`` with cost + sum_j multipliers_j directions_j positive definite.

    Everything is divided by ``unit``, and f is 0 at the point near which the bound is wanted.

    Attributes:
        cost: F.
        directions: -e0 e0' of the bound, then the matrices B_j.
        start: strictly feasible multipliers.
        unit: mm^2.
        where: places of (a1, a3) in v.
    """

    cost: Float[np.ndarray, "v v"]
    directions: Float[np.ndarray, "m v v"]
    start: Float[np.ndarray, " m"]
    unit: float
    where: Int[np.ndarray, " 6"]

    @classmethod
    def of(cls, reduced: ReducedObjective, x: Float[np.ndarray, " 6"]) -> _Program | None:
        """The program of :func:`lower_bound`, or None where there is no such relaxation."""
        free = reduced.constraints.free
        if free not in ((), ("common",)):
            return None
        scaled = bool(free)
        equations = _equations(scaled)
        size = equations.shape[1]
        first = size - 9
        where = np.r_[first : first + 3, first + 6 : first + 9]
        unit = float(np.linalg.norm(reduced.factor, 2)) ** 2
        if unit == 0:
            return None
        squared = reduced.factor.T @ reduced.factor / unit
        slope = reduced.factor.T @ reduced.shift / unit
        cost = np.zeros((size, size))
        cost[np.ix_(where, where)] = squared
        cost[0, where] = cost[where, 0] = slope
        # With this constant f(x), and so the bound sought, is 0; f(x) = |Cx + g|^2 + rest.
        cost[0, 0] = -(x @ squared @ x + 2 * slope @ x)
        shape = np.zeros(size)
        if scaled:
            least = float(np.linalg.eigvalsh(squared)[0])
            if least < 1e-12:
                return None
            # s^2 - |a1|^2 + |a2|^2 - |a3|^2 = 0; F has at least ``least`` along a1 and a3.
            shape[1:] = least * np.array([0.5, *[-0.5] * 3, *[0.5] * 3, *[-0.5] * 3])
        else:
            # |a1|^2 + |a2|^2 + |a3|^2 - 3 = 0.
            shape[1:] = 1.0
            shape[0] = -3.0
        start = np.diag(shape)
        matrix = cost + start
        # The Schur complement of the first row, less a margin.
        rest = np.linalg.solve(matrix[1:, 1:], matrix[1:, 0])
        bound = float(matrix[0, 0] - matrix[0, 1:] @ rest) - 1.0
        corner = np.zeros((1, size, size))
        corner[0, 0, 0] = -1.0
        directions = np.concatenate([corner, equations])
        multipliers = np.append(bound, np.einsum("jkl,kl->j", equations, start))
        return cls(cost, directions, multipliers, unit, where)

    def root(self, multipliers: Float[np.ndarray, " m"]) -> Float[np.ndarray, "v v"]:
        """Cholesky factor of Z; LinAlgError where Z is not positive definite."""
        return np.linalg.cholesky(self.cost + np.tensordot(multipliers, self.directions, 1))


def lower_bound(
    reduced: ReducedObjective, x: Float[np.ndarray, " 6"], enough: float
) -> tuple[float, Float[np.ndarray, " 6"]] | None:
    """Bound f from below.

    Args:
        reduced: with known scales or one common one.
        x: a feasible point, near whose value of f the bound is wanted.
        enough: stop when the gap is below this, mm^2.

    Returns:
        f(x) less the proved bound, mm^2, never negative; and an estimate of the minimiser, which
        need not be of a rotation. None where there is no such relaxation: a lateral or axial scale
        of its own, a common scale with a singular factor, or a factor of zero.
    """
    program = _Program.of(reduced, x)
    if program is None:
        return None
    gap, lower = _least_gap(program, enough / program.unit)
    inverse = np.linalg.inv(lower)
    moments = inverse.T @ inverse
    ideal = moments[program.where, 0] / moments[0, 0]
    return max(gap, 0.0) * program.unit, ideal


def _least_gap(program: _Program, enough: float) -> tuple[float, Float[np.ndarray, "v v"]]:
    """The barrier method: the least gap that was proved, and Z's factor at the end.

    Args:
        program: the bound's semidefinite program.
        enough: stop when the gap is below this, in the program's unit.
    """
    directions, size = program.directions, len(program.cost)
    count = len(directions)
    multipliers = program.start
    goal = np.zeros(count)
    goal[0] = 1.0
    best = -float(multipliers[0])
    weight = max(best, 1e-3) / size
    lower = program.root(multipliers)
    for _ in range(MOST_STEPS):
        inverse = np.linalg.inv(lower)
        turned = (inverse @ directions @ inverse.T).reshape(count, -1)
        slope = turned @ np.eye(size).ravel()
        curvature = turned @ turned.T
        step = np.linalg.solve(
            curvature + 1e-14 * np.diag(np.diag(curvature)), goal / weight + slope
        )
        decrement = float(np.sqrt(max(step @ curvature @ step, 0.0)))
        length = 1.0 if decrement < 0.25 else 1 / (1 + decrement)
        for _ in range(30):
            trial = multipliers + length * step
            try:
                lower = program.root(trial)
            except np.linalg.LinAlgError:
                length /= 2
                continue
            multipliers = trial
            break
        else:
            break
        best = min(best, -float(multipliers[0]))
        if decrement < CENTRED_BELOW:
            # On the central path the bound is within size * weight of the largest one.
            if best <= enough or weight * size < 0.02 * best or weight < 1e-15:
                break
            weight *= BARRIER_DECREASE
    return best, lower
