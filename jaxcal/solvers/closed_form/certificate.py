"""A certificate for any answer to Eq. 7: how much lower the objective could at most be.

Let f(x) = |C x + g|^2 + rest under the constraints x' A_j x = e_j, as in
:mod:`jaxcal.solvers.closed_form.reduced_objective`. Any multipliers l with M = C'C + sum_j l_j A_j
positive definite bound f from below by the minimum over *all* x of f(x) + sum_j l_j (x' A_j x -
e_j). For an x that satisfies the constraints

    f(x) - bound = r' M^-1 r,    r = M x + C'g,

a sum of squares without cancellation. It is zero where x is stationary and l are its multipliers.
Where that proves nothing, :func:`certify` tries the bound of
:mod:`jaxcal.solvers.closed_form.rotation_relaxation`. Nothing here depends on where the answer came
from.

Sources: Boyd and Vandenberghe, "Convex Optimization", section 5.2 (weak duality); for certificates
of calibration and registration Briales and Gonzalez-Jimenez, CVPR 2017, and Holmes, Duembgen and
Barfoot, arXiv:2308.07275.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jaxcal import InputError
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.given_values import real_array
from jaxcal.solvers.closed_form.reduced_objective import ReducedObjective, image_data, reduce
from jaxcal.solvers.closed_form.rotation_relaxation import lower_bound

if TYPE_CHECKING:
    from jaxcal.data.problem import Problem
    from jaxcal.data.recording import Images, Recording

TOLERANCE = 1e-9
"""A gap below this share of the objective counts as zero."""

SHIFTS = (0.0, 1e-15, 1e-14, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2)
"""Shares by which multipliers are moved into the region where M is positive definite."""

ORTHONORMAL = 1e-6
"""A transform whose rotation stretches by more is refused; less is rounding, and is removed."""

NEARBY = 0.01
"""Answers that differ by less than this share of x are the same one."""

SINGULAR = 1e-11
"""M is called singular where its least eigenvalue is below this share of C'C's largest."""


@dataclass(frozen=True)
class Certificate:
    """What is proved of an answer to Eq. 7.

    Attributes:
        certified: no transform, target and free scales fit Eq. 7 better, up to one part in 1e9 and
            to rounding.
        gap_mm2: Eq. 7's minimum is at least ``objective_mm2 - gap_mm2``, mm^2; inf if no bound is
            known.
        objective_mm2: Eq. 7 at the answer, mm^2.
        unique: it is proved that no other answer fits as well. False where other answers fit as
            well, and where that is not known.
    """

    certified: bool
    gap_mm2: float
    objective_mm2: float
    unique: bool


def tolerance(reduced: ReducedObjective, objective: float) -> float:
    """The gap below which an answer is called the minimum, mm^2."""
    return TOLERANCE * objective + reduced.resolution


def multipliers(reduced: ReducedObjective, x: Float[np.ndarray, 6]) -> Float[np.ndarray, " k"]:
    """The multipliers that make x most nearly stationary."""
    gradient = reduced.factor.T @ (reduced.factor @ x + reduced.shift)
    columns = (reduced.constraints.matrices @ x).T
    return -np.linalg.lstsq(columns, gradient, rcond=None)[0]


def duality_gap(
    reduced: ReducedObjective, x: Float[np.ndarray, 6], values: Float[np.ndarray, " k"]
) -> float:
    """f(x) less the bound that multipliers prove; inf where M is not positive definite.

    Args:
        reduced: f and its constraints.
        x: satisfies the constraints.
        values: multipliers.
    """
    added = np.tensordot(values, reduced.constraints.matrices, 1)
    squared = reduced.factor.T @ reduced.factor
    try:
        lower = np.linalg.cholesky(squared + added)
    except np.linalg.LinAlgError:
        return np.inf
    # C'(Cx + g) + Lx keeps the digits that (C'C + L) x + C'g would lose.
    stationary = reduced.factor.T @ (reduced.factor @ x + reduced.shift) + added @ x
    return float(np.sum(np.linalg.solve(lower, stationary) ** 2))


def unconstrained_gap(reduced: ReducedObjective, x: Float[np.ndarray, 6]) -> float:
    """f(x) less its minimum without any constraint; this bound holds for a singular C as well."""
    left, values, _ = np.linalg.svd(reduced.factor)
    within = left[:, values > SINGULAR * max(values[0], np.finfo(float).tiny)]
    return float(np.sum((within.T @ (reduced.factor @ x + reduced.shift)) ** 2))


def gap_of_multipliers(
    reduced: ReducedObjective, x: Float[np.ndarray, 6], values: Float[np.ndarray, " k"]
) -> float:
    """The smallest gap proved by multipliers near the given ones, mm^2.

    Where M is singular or a little indefinite, multipliers a little farther inside give a bound
    that is a little lower, and still a proof.
    """
    constraints = reduced.constraints
    size = float(np.linalg.norm(reduced.factor, 2)) ** 2
    best = np.inf
    for share in SHIFTS:
        if constraints.free:
            # M at l = 0 is C'C; on the way there, M is definite wherever both ends are.
            moved = (1 - share) * values
        else:
            # |a1| and |a3| are known: if their two multipliers grow together, M grows, too.
            moved = values + share * size * constraints.values
        gap = duality_gap(reduced, x, moved)
        if gap > best:
            break
        best = gap
    return best


def certify_point(
    reduced: ReducedObjective,
    x: Float[np.ndarray, 6],
    *,
    excess: float = 0.0,
    values: Float[np.ndarray, " k"] | None = None,
    gap: float = np.inf,
) -> Certificate:
    """The certificate of x, which satisfies the constraints, from multipliers.

    Args:
        reduced: f and its constraints.
        x: (a1, a3).
        excess: mm^2 by which the answer's t and c make Eq. 7 larger than f(x).
        values: a solver's multipliers, which may be better than those that follow from x.
        gap: f(x) less a bound that is known already, mm^2.
    """
    objective = float(reduced(x)) + excess
    enough = tolerance(reduced, objective)
    candidates = [multipliers(reduced, x)] + ([] if values is None else [values])
    of_multipliers = np.inf
    for each in candidates:
        of_multipliers = min(of_multipliers, gap_of_multipliers(reduced, x, each))
        if of_multipliers + excess <= enough:
            break
    unique = of_multipliers + excess <= enough and _alone(reduced, x, candidates[0], excess)
    gap = min(gap, of_multipliers)
    if gap + excess > enough:
        gap = min(gap, unconstrained_gap(reduced, x))
    return Certificate(
        certified=bool(gap + excess <= enough),
        gap_mm2=float(gap + excess),
        objective_mm2=objective,
        unique=bool(unique and reduced.origin_determined),
    )


def _alone(
    reduced: ReducedObjective,
    x: Float[np.ndarray, 6],
    values: Float[np.ndarray, " k"],
    excess: float,
) -> bool:
    """Whether everything that fits as well as x lies close to x.

    Let M be positive definite, and x* the dual's minimiser. For every y that satisfies the
    constraints, f(y) exceeds the bound by at least |y - x*|^2 times M's least eigenvalue. So x, and
    everything that fits as well, lies in a ball about x*.
    """
    added = np.tensordot(values, reduced.constraints.matrices, 1)
    squared = reduced.factor.T @ reduced.factor
    least = np.linalg.eigvalsh(squared + added)[0]
    if not least > SINGULAR * np.linalg.norm(squared, 2):
        return False
    above = duality_gap(reduced, x, values) + excess + reduced.resolution
    return bool(4 * above <= (NEARBY * np.linalg.norm(x)) ** 2 * least)


def certify(
    problem: Problem | Recording | Images,
    image_to_probe: Float[np.ndarray, "4 4"],
    point: Float[np.ndarray, 3] | None = None,
    *,
    scale_mm_per_px: Float[np.ndarray, 2] | None = None,
    sound_speed_factor: float = 1.0,
    estimate: tuple[str, ...] = (),
) -> Certificate:
    """Prove that an answer is the global minimum of Eq. 7, or say how far it may be from it.

    Args:
        problem: one problem, a recording, or one set of images.
        image_to_probe: (4, 4), X, mm.
        point: (3,), the target in the tracker's frame, mm; without it the best one for X.
        scale_mm_per_px: [lateral, axial], the estimated scales, if ``estimate`` names one.
        sound_speed_factor: the estimated sound speed over the nominal one.
        estimate: what was unknown beside X and the target: ``()``, ``("scale",)``,
            ``("common-scale",)`` or ``("sound-speed",)``.

    Returns:
        A :class:`Certificate`. It is about the objective of Eq. 7, which the conventional method
        minimises; joint methods minimise another one.

    Raises:
        InputError: data that cannot be used, no rotation, or a wanted scale that is missing.
    """
    data, constraints = image_data(problem, estimate)
    reduced = reduce(data, constraints)
    transform = real_array(image_to_probe, "image_to_probe")
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise InputError("image_to_probe must be a finite 4x4 matrix, in mm")
    factors = np.array([1.0, sound_speed_factor])
    if {"lateral", "common"} & set(constraints.free):
        if scale_mm_per_px is None:
            raise InputError("an estimated scale belongs to the answer: give scale_mm_per_px")
        factors = real_array(scale_mm_per_px, "scale_mm_per_px") / data.spacing
    if point is not None and np.shape(point) != (3,):
        raise InputError(f"point must have shape (3,), not {np.shape(point)}")
    left, stretch, right = np.linalg.svd(transform[:3, :3])
    if np.abs(stretch - 1).max() > ORTHONORMAL or np.linalg.det(left @ right) < 0:
        raise InputError("image_to_probe holds no rotation: its columns are not orthonormal")
    rotation, origin = left @ right, transform[:3, 3]
    x = np.concatenate([factors[0] * rotation[:, 0], factors[1] * rotation[:, 2]])
    if {"lateral", "common"} & set(constraints.free):
        origin = origin + data.face_offset * rotation[:, 2]
    seen = data.points.copy()
    if not constraints.free or constraints.free == ("axial",):
        seen[:, 1] += data.face_offset
    in_probe = seen[:, :1] * x[:3] + seen[:, 1:] * x[3:] + origin
    cloud = np.einsum("nij,nj->ni", data.rotations, in_probe) + data.translations
    target = cloud.mean(axis=0) if point is None else real_array(point, "point")
    value = float(np.sum((cloud - target) ** 2))
    excess = max(value - float(reduced(x)), 0.0)
    found = certify_point(reduced, x, excess=excess)
    if found.certified:
        return found
    relaxed = lower_bound(reduced, x, 0.3 * tolerance(reduced, found.objective_mm2))
    gap = np.inf if relaxed is None else relaxed.gap
    return certify_point(reduced, x, excess=excess, gap=gap)
