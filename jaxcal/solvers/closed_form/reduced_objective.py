"""Eq. 7 with the target and the image's origin eliminated, and how much lower it could be.

With r1 and r3 the lateral and axial columns of X's rotation, s1 and s3 the pixel scales and
a1 = s1 r1, a3 = s3 r3, the residual of image i in Eq. 7 is linear in (a1, a3, t, c):

    e_i = R_i (u_i a1 + v_i a3 + t) + b_i - c.

Linear least squares gives c and t for any a1, a3, and what remains of Eq. 7 has six unknowns:

    f(x) = |C x + g|^2 + rest,    x = (a1, a3), C upper triangular, 6 x 6.

Only the constraints on x depend on which scales are known (:data:`CONSTRAINTS`). The second column
r2 = r3 x r1 does not occur, so no reflection can arise. A known offset f of the transducer's face
turns v_i a3 into v_i a3 + f r3. The added term is absorbed by t, so the form stays exact.

*The bound.* The constraints are x' A_j x = e_j. Any multipliers l with M = C'C + sum_j l_j A_j
positive definite bound f from below by the minimum over *all* x of f(x) + sum_j l_j (x' A_j x -
e_j). For an x that satisfies the constraints

    f(x) - bound = r' M^-1 r,    r = M x + C'g,

a sum of squares without cancellation. It is zero where x is stationary and l are its multipliers.

This module needs numpy only. It holds no solver: :mod:`jaxcal.solvers.closed_form.single` minimises
f, and the bound does not depend on how x was found.

Sources: Boyd and Vandenberghe, "Convex Optimization", section 5.2 (weak duality); for certificates
of calibration and registration Briales and Gonzalez-Jimenez, CVPR 2017, and Holmes, Duembgen and
Barfoot, arXiv:2308.07275.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.problem import Problem
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.runtime.arrays import array_module

RANK_TOLERANCE = 1e-11
"""Singular values below this share of the largest possible one count as zero."""

ROUNDING = 64
"""Objectives are known up to this many roundings of the sum of squares of the data."""

TOLERANCE = 1e-9
"""A gap below this share of the objective counts as zero."""

SHIFTS = (0.0, 1e-15, 1e-14, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2)
"""Shares by which multipliers are moved into the region where M is positive definite."""

NEARBY = 0.01
"""Answers that differ by less than this share of x are the same one."""

SINGULAR_SYSTEM = 1e-11
"""M is called singular where its least eigenvalue is below this share of C'C's largest."""


@dataclass(frozen=True)
class QuadraticConstraints:
    """What is known of the scales: x' A_j x = e_j for every j.

    Attributes:
        matrices: (k, 6, 6), A_j.
        values: (k,), e_j.
        free: which scales are unknown: ``()``, ``("common",)``, ``("axial",)`` or
            ``("lateral", "axial")``.
    """

    matrices: Float[np.ndarray, "k 6 6"]
    values: Float[np.ndarray, " k"]
    free: tuple[str, ...]

    @property
    def scaled(self) -> bool:
        """Whether pixel sizes are unknown; they do not stretch the range of row 0."""
        return bool({"lateral", "common"} & set(self.free))

    def allowed(self, lengths: Float[AnyArray, "2 ..."]) -> Float[AnyArray, "2 ..."]:
        """The lengths of a1 and a3 that the constraints allow, nearest to the given ones."""
        xp = array_module(lengths)
        one, mean = xp.ones_like(lengths[0]), 0.5 * (lengths[0] + lengths[1])
        return {
            (): xp.stack([one, one]),
            ("common",): xp.stack([mean, mean]),
            ("axial",): xp.stack([one, lengths[1]]),
        }.get(self.free, lengths)


def _constraints() -> dict[tuple[str, ...], QuadraticConstraints]:
    one, two = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])
    both = np.array([[0.0, 1.0], [1.0, 0.0]])
    table = {
        (): ([one, two, both], [1.0, 1.0, 0.0], ()),
        ("scale",): ([both], [0.0], ("lateral", "axial")),
        ("common-scale",): ([one - two, both], [0.0, 0.0], ("common",)),
        ("sound-speed",): ([one, both], [1.0, 0.0], ("axial",)),
    }
    return {
        estimate: QuadraticConstraints(
            np.stack([np.kron(each, np.eye(3)) for each in small]), np.array(values), free
        )
        for estimate, (small, values, free) in table.items()
    }


CONSTRAINTS = _constraints()
"""The constraints, by what is estimated beside X and the target."""


@dataclass(frozen=True)
class ImageData:
    """The images in use as plain arrays.

    Attributes:
        rotations: (n, 3, 3), of the poses.
        translations: (n, 3), of the poses, mm.
        points: (n, 2), what the scales multiply: [lateral, range] at the nominal spacing, mm.
        face_offset: added to the range after scaling, mm.
        spacing: (2,) nominal mm per px; ones for points in mm.
        pixels: whether the measurements are pixels.
    """

    rotations: Float[np.ndarray, "n 3 3"]
    translations: Float[np.ndarray, "n 3"]
    points: Float[np.ndarray, "n 2"]
    face_offset: float
    spacing: Float[np.ndarray, " 2"]
    pixels: bool

    def factors_of(self, constraints: QuadraticConstraints) -> Float[np.ndarray, "n 2"]:
        """What a1 and a3 multiply, mm.

        A sound speed multiplies the whole range, a pixel scale only what was measured in pixels.
        """
        return self.points + np.array([0.0, 0.0 if constraints.scaled else self.face_offset])


@dataclass(frozen=True)
class ReducedObjective:
    """f(x) = |factor x + shift|^2 + rest, and how t and c follow from x.

    Attributes:
        factor: (6, 6), C, upper triangular; its rank may be less than 6.
        shift: (6,), g, mm.
        rest: what no x reduces, mm^2.
        resolution: f is known up to this much, mm^2 (rounding).
        images: number of images in use.
        origin_determined: whether the poses determine t and c (not if all rotations share an axis).
        origin_map: (3, 7), t of the mean point as a linear function of (x, 1).
        target_map: (3, 10), c as a linear function of (t of the mean point, x, 1), mm.
        mean: (2,), mean of the points, mm.
        constraints: on x.
    """

    factor: Float[np.ndarray, "6 6"]
    shift: Float[np.ndarray, " 6"]
    rest: float
    resolution: float
    images: int
    origin_determined: bool
    origin_map: Float[np.ndarray, "3 7"]
    target_map: Float[np.ndarray, "3 10"]
    mean: Float[np.ndarray, " 2"]
    constraints: QuadraticConstraints

    def __call__(self, x: Float[np.ndarray, "*starts 6"]) -> Any:
        """f(x), mm^2: a number, or one for every start."""
        return np.sum((x @ self.factor.T + self.shift) ** 2, axis=-1) + self.rest

    def origin_and_target(
        self, x: Float[np.ndarray, " 6"]
    ) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """The t and c that minimise Eq. 7 for x, mm.

        Where several do, these put the mean of the points nearest to the probe's origin.
        """
        of_mean = self.origin_map @ np.append(x, 1.0)
        target = self.target_map @ np.concatenate([of_mean, x, [1.0]])
        return of_mean - self.mean[0] * x[:3] - self.mean[1] * x[3:], target


def image_data(
    problem: Problem, estimate: tuple[str, ...]
) -> tuple[ImageData, QuadraticConstraints]:
    """The images in use and the constraints.

    Raises:
        InputError: unknown names, a scale where there is none; NaN, Inf, or fewer than 4 used
            images.
    """
    check_estimate(estimate, problem)
    mask = np.asarray(problem.mask) > 0
    if mask.ndim != 1:
        raise InputError(f"one problem is wanted, not a batch with axes {mask.shape[:-1]}")
    count = np.count_nonzero(mask)
    if count < MINIMUM_IMAGES:
        raise InputError(f"{count} used images are too few: at least {MINIMUM_IMAGES} are needed")
    poses = np.asarray(problem.poses, dtype=float)
    measurements = np.asarray(problem.measurements, dtype=float)
    for name, values in (("poses", poses), ("measurements", measurements)):
        bad = mask & ~np.isfinite(values).reshape(len(mask), -1).all(axis=1)
        if bad.any():
            raise InputError(f"{name} of image {np.flatnonzero(bad)[0]} hold NaN or Inf")
    spacing = np.asarray(problem.spacing, dtype=float)
    data = ImageData(
        rotations=poses[mask, :3, :3],
        translations=poses[mask, :3, 3],
        points=measurements[mask] * spacing,
        face_offset=float(problem.face_offset),
        spacing=spacing,
        pixels=problem.pixels,
    )
    return data, CONSTRAINTS[estimate]


def check_estimate(estimate: tuple[str, ...], problem: Problem) -> None:
    """Refuse an ``estimate`` without a closed form, and scales that do not exist or are not known.

    Raises:
        InputError: says which.
    """
    if estimate not in CONSTRAINTS:
        named = " or ".join(repr(key) for key in CONSTRAINTS)
        raise InputError(f"no closed form for estimate={estimate!r}; there is one for {named}")
    scaled = bool({"scale", "common-scale"} & set(estimate))
    if scaled and not problem.pixels:
        raise InputError("the points are in mm already: there is no pixel scale to estimate")
    if not scaled and not problem.spacing_known:
        raise InputError('the pixels have no spacing_mm: give it, or estimate=("scale",)')


def reduce(data: ImageData, constraints: QuadraticConstraints) -> ReducedObjective:
    """Eliminate c, then t, by orthogonal transformations.

    Squares of the factor are never formed, so that f and the distance of f(x) from its minimum keep
    their digits where the data are exact or the poses nearly degenerate.
    """
    count = len(data.points)
    points = data.factors_of(constraints)
    mean, centre = points.mean(axis=0), data.translations.mean(axis=0)
    points -= mean
    away = data.translations - centre
    columns = np.concatenate(
        [
            data.rotations,
            data.rotations * points[:, :1, None],
            data.rotations * points[:, 1:, None],
            away[:, :, None],
        ],
        axis=2,
    )
    # c is the mean of the images' points; only deviations from it remain.
    target = columns.mean(axis=0)
    columns = (columns - target).reshape(3 * count, 10)
    target[:, 9] += centre
    left, values, right = np.linalg.svd(columns[:, :3], full_matrices=False)
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * np.sqrt(count)))
    left, right = left[:, :rank], right[:rank]
    others = columns[:, 3:]
    along = left.T @ others
    others = others - left @ along
    # Once more, against rounding where the rotations hardly differ.
    others = others - left @ (left.T @ others)
    triangle = np.asarray(np.linalg.qr(others, mode="r"))
    size = float(np.sum(away**2) + np.sum(points**2))
    return ReducedObjective(
        factor=triangle[:6, :6],
        shift=triangle[:6, 6],
        rest=float(triangle[6, 6] ** 2),
        resolution=ROUNDING * float(np.finfo(float).eps) * size,
        images=count,
        origin_determined=rank == 3,
        origin_map=-right.T @ (along / values[:rank, None]),
        target_map=target,
        mean=mean,
        constraints=constraints,
    )


@dataclass(frozen=True)
class Certificate:
    """What is proved about a solution of Eq. 7.

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


def multipliers(reduced: ReducedObjective, x: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " k"]:
    """The multipliers that make x most nearly stationary."""
    gradient = reduced.factor.T @ (reduced.factor @ x + reduced.shift)
    columns = (reduced.constraints.matrices @ x).T
    return -np.linalg.lstsq(columns, gradient, rcond=None)[0]


def duality_gap(
    reduced: ReducedObjective, x: Float[np.ndarray, " 6"], values: Float[np.ndarray, " k"]
) -> float:
    """f(x) of a feasible x less the bound that multipliers prove; inf where M is indefinite."""
    added = np.tensordot(values, reduced.constraints.matrices, 1)
    squared = reduced.factor.T @ reduced.factor
    try:
        lower = np.linalg.cholesky(squared + added)
    except np.linalg.LinAlgError:
        return np.inf
    # C'(Cx + g) + Lx keeps the digits that (C'C + L) x + C'g would lose.
    stationary = reduced.factor.T @ (reduced.factor @ x + reduced.shift) + added @ x
    return float(np.sum(np.linalg.solve(lower, stationary) ** 2))


def unconstrained_gap(reduced: ReducedObjective, x: Float[np.ndarray, " 6"]) -> float:
    """f(x) less its minimum without any constraint; this bound holds for a singular C as well."""
    left, values, _ = np.linalg.svd(reduced.factor)
    within = left[:, values > SINGULAR_SYSTEM * max(values[0], np.finfo(float).tiny)]
    return float(np.sum((within.T @ (reduced.factor @ x + reduced.shift)) ** 2))


def gap_of_multipliers(
    reduced: ReducedObjective, x: Float[np.ndarray, " 6"], values: Float[np.ndarray, " k"]
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
    x: Float[np.ndarray, " 6"],
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
    unique = of_multipliers + excess <= enough and _is_unique(reduced, x, candidates[0], excess)
    gap = min(gap, of_multipliers)
    if gap + excess > enough:
        gap = min(gap, unconstrained_gap(reduced, x))
    return Certificate(
        certified=bool(gap + excess <= enough),
        gap_mm2=float(gap + excess),
        objective_mm2=objective,
        unique=bool(unique and reduced.origin_determined),
    )


def _is_unique(
    reduced: ReducedObjective,
    x: Float[np.ndarray, " 6"],
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
    if not least > SINGULAR_SYSTEM * np.linalg.norm(squared, 2):
        return False
    above = duality_gap(reduced, x, values) + excess + reduced.resolution
    return bool(4 * above <= (NEARBY * np.linalg.norm(x)) ** 2 * least)
