"""The global minimum of Eq. 7, conventional calibration, without a start and with a proof.

Eq. 7 in the form f(x) = |C x + g|^2 + rest (:mod:`jaxcal.solvers.closed_form.reduced_objective`)
has quadratic constraints x' A_j x = e_j only, and a dual d(l) = min_x f(x) + sum_j l_j (x' A_j x -
e_j), concave in the multipliers l, one for each constraint. With M = C'C + sum_j l_j A_j positive
definite, x(l) = -M^-1 C'g attains it, and d's gradient is x(l)' A_j x(l) - e_j. Where the gradient
is zero, x(l) satisfies the constraints and is the unique global minimum.

- *Both scales unknown*: one multiplier. With W = C^-T (A / 2) C^-1 = V diag(w) V' and h = -V'g,

      phi(l) = sum_k w_k (h_k / (1 + l w_k))^2

  falls on (-1 / w_max, -1 / w_min), and its root is the answer. With one quadratic equality, strong
  duality always holds, so there is a root except for data in special position.
- *Known scales*: three multipliers; *one common scale*, or an unknown sound speed: two. Newton's
  method on the dual starts from the multiplier for |a1|^2 + |a3|^2 = 2 alone (known scales) or from
  zero. With few images and large errors the dual's maximum may lie where M is singular. Then the
  best of 60 descents on the rotations is taken, and
  :mod:`jaxcal.solvers.closed_form.rotation_relaxation` is tried for a proof.

The answer is polished by Newton's method on the rotation and certified, which does not depend on
how it was found.

References: Boyd and Vandenberghe, "Convex Optimization", appendix B.1 (strong duality for one
quadratic constraint); More, "Generalizations of the trust region problem", Optimization Methods and
Software 2, 1993 (the equality); Briales and Gonzalez-Jimenez, CVPR 2017.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from jaxcal.data.poses import rotations_from_quaternions
from jaxcal.data.problem import Problem
from jaxcal.model.unknowns import Blocks
from jaxcal.runtime.array_types import Bool, Float, HeldArray
from jaxcal.runtime.arrays import array_tree, assembled
from jaxcal.solvers.closed_form.reduced_objective import (
    Certificate,
    ImageData,
    QuadraticConstraints,
    ReducedObjective,
    certify_point,
    image_data,
    reduce,
    tolerance,
)
from jaxcal.solvers.closed_form.rotation_relaxation import lower_bound

Numbers = Any
"""A number, or for a batch an array of them."""

DUAL_STEPS = 60
"""Most steps of Newton's method on the dual."""

DESCENT_STEPS = 400
"""Most steps of the descents on rotation and free scales."""

ARMIJO = 1e-4
"""Least rise of the dual by a step, as a share of what its slope promises."""

CONSTRAINT_TOLERANCE = 1e-6
"""M is regular at the dual's maximum if constraints are off by less than this share of |x|^2."""

LEAST_RISE = 1e-13
"""Newton's method on the dual stops when a step raises it by less than this share."""

SCREENING_STEPS = 12
"""After so many steps only the lowest descents go on."""

KEPT_DESCENTS = 20
"""How many descents go on."""

LEAST_SCALE = 1e-9
"""Least free scale over the nominal one: at zero, a column of X would have no direction."""

STEP_TOLERANCE = 1e-12
"""A descent is finished when its step is below this, in radians and in shares of the scale."""


@array_tree
class ClosedForm:
    """The conventional calibration of one problem, or of a batch (arrays with its leading axes).

    Attributes:
        image_to_probe: (4, 4), X, mm.
        point: (3,), the target in the tracker's frame, mm.
        scale_mm_per_px: (2,), [lateral, axial]; None for points in mm.
        sound_speed_factor: the sound speed over the nominal one; 1 where it was not estimated.
        rms: root mean square of |c - B_i X p_i| over the used images, mm.
        objective_mm2: Eq. 7's sum of squares, mm^2.
        certified: no transform fits Eq. 7 better, up to one part in 1e9 and to rounding.
        gap_mm2: Eq. 7's minimum is at least ``objective_mm2 - gap_mm2``, mm^2.
        unique: it is proved that no other transform fits as well.
    """

    image_to_probe: Float[Any, "*batch 4 4"]
    point: Float[Any, "*batch 3"]
    scale_mm_per_px: Float[Any, "*batch 2"] | None
    sound_speed_factor: Numbers
    rms: Numbers
    objective_mm2: Numbers
    certified: Numbers
    gap_mm2: Numbers
    unique: Numbers


@array_tree
class Start:
    """The start of methods that begin at the conventional fit: Eq. 7's minimum of one problem.

    Attributes:
        rotation: of X, from the image's frame to the probe's.
        translation: of X, mm.
        point: the target in the tracker's frame, mm.
        scale: factors on the problem's [lateral, axial] spacing.
        searched: the minimum is not proved to be the only one; descents from many rotations found
            it.
    """

    rotation: Float[HeldArray, "*batch 3 3"]
    translation: Float[HeldArray, "*batch 3"]
    point: Float[HeldArray, "*batch 3"]
    scale: Float[HeldArray, "*batch 2"]
    searched: Bool[HeldArray, "*batch"]


def solve_problem(problem: Problem, estimate: tuple[str, ...] = ()) -> ClosedForm:
    """One problem by numpy alone; as :func:`jaxcal.calibrate_closed_form`."""
    data, constraints = image_data(problem, estimate)
    reduced = reduce(data, constraints)
    x, certificate = solve(reduced)
    return _assemble(x, certificate, reduced, data)


def in_closed_form(blocks: Blocks) -> tuple[str, ...]:
    """Which of the free unknowns a start estimates beside X and the target.

    Sound speed and delay begin at their nominal values: the closed form knows no prior.
    """
    return tuple(name for name in blocks if name == "scale")


def closed_form_start(problem: Problem, blocks: Blocks) -> Start:
    """The start of a method, from the closed form of Eq. 7.

    Args:
        problem: one problem with concrete, finite values and at least 4 used images.
        blocks: the free unknowns; those without a closed form begin at their nominal values.

    Returns:
        The start in the problem's own precision.
    """
    known = replace(problem, spacing_known=True, channels=None)
    found = solve_problem(known, in_closed_form(blocks))
    scale = np.ones(2)
    if found.scale_mm_per_px is not None:
        scale = np.asarray(found.scale_mm_per_px) / np.asarray(problem.spacing)
    parts = {
        "rotation": found.image_to_probe[:3, :3],
        "translation": found.image_to_probe[:3, 3],
        "point": found.point,
        "scale": scale,
    }
    dtype = np.asarray(problem.mask).dtype
    parts = {name: np.asarray(value, dtype) for name, value in parts.items()}
    parts["searched"] = np.asarray(not (found.certified and found.unique))
    return assembled(Start, parts)


def solve(reduced: ReducedObjective) -> tuple[Float[np.ndarray, " 6"], Certificate]:
    """The minimiser (a1, a3) of a reduced objective and its certificate."""
    constraints = reduced.constraints
    both = constraints.free == ("lateral", "axial")
    found = scalar_root(reduced) if both else _dual_maximum(reduced)
    first = np.zeros((0, 6))
    if found is not None:
        values, x = found
        nearest = feasible(x, constraints)
        off = np.abs((constraints.matrices @ x) @ x - constraints.values).max()
        if off <= CONSTRAINT_TOLERANCE * max(1.0, float(x @ x)):
            best = descend(reduced, nearest[None])
            certificate = certify_point(reduced, best, values=values)
            if certificate.certified:
                return best, certificate
        first = nearest[None]
    best = descend(reduced, np.append(first, _starts(reduced), axis=0))
    certificate = certify_point(reduced, best)
    if certificate.certified:
        return best, certificate
    enough = tolerance(reduced, certificate.objective_mm2)
    relaxed = lower_bound(reduced, best, 0.3 * enough)
    if relaxed is None:
        return best, certificate
    gap, ideal = relaxed
    # The relaxation's estimate of the minimiser is one more start.
    again = descend(reduced, feasible(ideal, constraints)[None])
    gained = float(reduced(best) - reduced(again))
    best, gap = (again, gap - gained) if gained > 0 else (best, gap)
    return best, certify_point(reduced, best, gap=max(gap, 0.0))


def scalar_root(
    reduced: ReducedObjective,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " 6"]] | None:
    """Both scales unknown: the root of phi, by Newton's method kept within its bracket."""
    values = np.linalg.svd(reduced.factor, compute_uv=False)
    if values[-1] <= 1e-9 * values[0]:
        return None
    inverse = np.linalg.inv(reduced.factor)
    w, v = np.linalg.eigh(0.5 * inverse.T @ reduced.constraints.matrices[0] @ inverse)
    h = -(v.T @ reduced.shift)
    # The l of phi belongs to A / 2, so M = C'C + (l / 2) A.
    low, high = -1 / w[-1], -1 / w[0]
    at = 0.0
    for _ in range(200):
        share = h / (1 + at * w)
        value = float(w @ share**2)
        low, high = (at, high) if value > 0 else (low, at)
        slope = -2 * float(w**2 @ (share**2 / (1 + at * w)))
        after = at - value / slope if slope < 0 else 0.5 * (low + high)
        if not low < after < high:
            after = 0.5 * (low + high)
        if abs(after - at) <= 4e-16 * (high - low) or after in (low, high):
            break
        at = after
    return np.array([0.5 * at]), inverse @ (v @ (h / (1 + at * w)))


def _dual_maximum(
    reduced: ReducedObjective,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " 6"]] | None:
    """Newton's method on the concave dual; None where C is singular and no scale is known."""
    constraints = reduced.constraints
    size = float(np.linalg.norm(reduced.factor, 2))
    if size == 0:
        return None
    squared = (reduced.factor.T @ reduced.factor) / size**2
    rhs = -(reduced.factor.T @ reduced.shift) / size**2

    def dual(values: Float[np.ndarray, " k"]) -> tuple | None:
        try:
            lower = np.linalg.cholesky(squared + np.tensordot(values, constraints.matrices, 1))
        except np.linalg.LinAlgError:
            return None
        inverse = np.linalg.inv(lower)
        half = inverse @ rhs
        value = -float(values @ constraints.values) - float(half @ half)
        return (value, inverse, inverse.T @ half) if np.isfinite(value) else None

    values = np.zeros(len(constraints.values))
    if not constraints.free:
        values[:2] = _sphere_multiplier(squared, rhs)
    state = dual(values)
    if state is None:
        return None
    for _ in range(DUAL_STEPS):
        value, inverse, x = state
        moved = constraints.matrices @ x
        # The dual's slope is by how much the constraints are violated.
        slope = moved @ x - constraints.values
        if np.abs(slope).max() <= 1e-14 * max(1.0, float(x @ x)):
            break
        turned = moved @ inverse.T
        # Minus the Hessian. It is singular where several multipliers give the same x.
        curvature = 2 * turned @ turned.T
        step = np.linalg.lstsq(curvature, slope, rcond=1e-15)[0]
        length, after = 1.0, None
        while length > 1e-8:
            after = dual(values + length * step)
            rise = ARMIJO * length * float(slope @ step) - 4e-16 * abs(value)
            if after is not None and after[0] >= value + rise:
                break
            length, after = length / 2, None
        if after is None:
            break
        values, state = values + length * step, after
        if after[0] - value <= LEAST_RISE * abs(value):
            break
    return values * size**2, state[2]


def _sphere_multiplier(squared: Float[np.ndarray, "6 6"], rhs: Float[np.ndarray, " 6"]) -> float:
    """The l with |(Q + l I)^-1 b|^2 = 2, or the least one with Q + l I positive definite."""
    w, v = np.linalg.eigh(squared)
    along = np.abs(v.T @ rhs)
    edge = -w[0] + 1e-9 * w[-1]
    # Newton on 1 / |x(l)|, which is nearly linear and convex: from the right it does not overshoot.
    at = max(edge, float(np.linalg.norm(along)) / np.sqrt(2))
    for _ in range(30):
        share = along / (w + at)
        length = float(np.linalg.norm(share))
        if length == 0:
            return edge
        slope = float(share @ (share / (w + at))) / length**3
        after = max(edge, at - (1 / length - 1 / np.sqrt(2)) / slope)
        if abs(after - at) <= 1e-6 * w[-1]:
            break
        at = after
    return max(edge, at)


def feasible(
    x: Float[np.ndarray, " 6"], constraints: QuadraticConstraints
) -> Float[np.ndarray, " 6"]:
    """A point near x that satisfies the constraints: the nearest orthonormal pair, scaled."""
    pair = x.reshape(2, 3).T
    lengths = np.linalg.norm(pair, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    left, _, right = np.linalg.svd(pair / lengths, full_matrices=False)
    return ((left @ right) * constraints.allowed(lengths)).T.ravel()


@cache
def _rotations() -> Float[np.ndarray, "60 3 3"]:
    """The icosahedron's 60 rotations: no rotation is over 45 degrees from the nearest of them."""
    golden = (1 + 5**0.5) / 2
    unit = [np.array(q) for q in itertools.product((0.5, -0.5), repeat=4)]
    unit += [np.roll([1.0, 0.0, 0.0, 0.0], k) for k in range(4)]
    even = [p for p in itertools.permutations(range(4)) if np.linalg.det(np.eye(4)[list(p)]) > 0]
    for signs in itertools.product((0.5, -0.5), repeat=3):
        base = np.array([signs[0] * golden, signs[1], signs[2] / golden, 0.0])
        unit += [base[list(p)] for p in even]
    found: list[np.ndarray] = []
    for q in unit:
        if not any(abs(abs(q @ other) - 1) < 1e-9 for other in found):
            found.append(q)
    return rotations_from_quaternions(np.array(found), "wxyz")


def _scale_columns(
    x: Float[np.ndarray, "s 6"], free: tuple[str, ...]
) -> Float[np.ndarray, "s 6 k"]:
    """Derivatives of x by factors on the free scales."""
    lateral, axial = x * np.repeat([1.0, 0.0], 3), x * np.repeat([0.0, 1.0], 3)
    columns = {
        (): [],
        ("common",): [x],
        ("axial",): [axial],
        ("lateral", "axial"): [lateral, axial],
    }[free]
    return np.stack(columns, axis=2) if columns else np.zeros((*x.shape, 0))


def _starts(reduced: ReducedObjective) -> Float[np.ndarray, "60 6"]:
    """60 rotations with the free scales that fit each best."""
    rotations = _rotations()
    x = np.concatenate([rotations[:, :, 0], rotations[:, :, 2]], axis=1)
    columns = _scale_columns(x, reduced.constraints.free)
    if columns.shape[2] == 0:
        return x
    fixed = x - columns.sum(axis=2)
    seen = reduced.factor @ columns
    rest = fixed @ reduced.factor.T + reduced.shift
    scales = -(np.linalg.pinv(seen) @ rest[:, :, None])
    # A column of length zero has no direction to improve.
    scales = np.where(np.abs(scales) < 1e-6, 1e-6, scales)
    return fixed + (columns @ scales)[:, :, 0]


# On a degenerate problem a step may overflow; its value is then NaN or Inf, and it is not taken.
@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def descend(reduced: ReducedObjective, x: Float[np.ndarray, "s 6"]) -> Float[np.ndarray, " 6"]:
    """The best of Newton's descents on rotation and free scales from several feasible points.

    The Hessian's eigenvalues are taken by magnitude and damped, so that saddles repel.
    """
    factor, free = reduced.factor, reduced.constraints.free
    value = reduced(x)
    damping = np.full(len(x), 1e-6)
    eye = np.eye(3)
    for index in range(DESCENT_STEPS):
        if index == SCREENING_STEPS and len(x) > KEPT_DESCENTS:
            lowest = np.argsort(value)[:KEPT_DESCENTS]
            x, value, damping = x[lowest], value[lowest], damping[lowest]
        pairs = x.reshape(-1, 2, 3)
        weights = ((x @ factor.T + reduced.shift) @ factor).reshape(-1, 2, 3)
        scales = _scale_columns(x, free)
        tangent = np.concatenate([_turns(pairs).reshape(-1, 6, 3), scales], axis=2)
        gradient = np.einsum("sk,skp->sp", weights.reshape(-1, 6), tangent)
        seen = factor @ tangent
        hessian = np.swapaxes(seen, 1, 2) @ seen
        outer = np.einsum("ski,skj->sij", weights, pairs)
        bent = 0.5 * (outer + np.swapaxes(outer, 1, 2))
        hessian[:, :3, :3] += bent - np.trace(outer, axis1=1, axis2=2)[:, None, None] * eye
        for k in range(scales.shape[2]):
            along = scales[:, :, k].reshape(-1, 2, 3)
            cross = (_turns(weights) @ along[..., None])[..., 0].sum(axis=1)
            hessian[:, :3, 3 + k] += cross
            hessian[:, 3 + k, :3] += cross
        w, v = np.linalg.eigh(hessian)
        largest = np.abs(w).max(axis=1, keepdims=True) + np.finfo(float).tiny
        strength = np.maximum(np.abs(w), 1e-14 * largest) + damping[:, None] * largest
        step = -np.einsum("spq,sq->sp", v, np.einsum("spq,sp->sq", v, gradient) / strength)
        trial = _moved(pairs, step, free)
        after = reduced(trial)
        better = after <= value
        x = np.where(better[:, None], trial, x)
        value = np.where(better, after, value)
        # After good steps the damping vanishes, and the steps become pure Newton steps.
        damping = np.where(better, np.where(damping < 1e-9, 0.0, 0.03 * damping), 10 * damping)
        damping = np.where(~better & (damping == 0), 1e-8, np.minimum(damping, 1e8))
        if np.all((np.abs(step).max(axis=1) < STEP_TOLERANCE) | (damping >= 1e8)):
            break
    return x[np.argmin(value)]


_LEVI_CIVITA = np.zeros((3, 3, 3))
_LEVI_CIVITA[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_LEVI_CIVITA[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0


def _turns(vectors: Float[np.ndarray, "*v 3"]) -> Float[np.ndarray, "*v 3 3"]:
    """The matrices that take omega to omega x v."""
    return (vectors @ _LEVI_CIVITA.transpose(2, 0, 1).reshape(3, 9)).reshape(*vectors.shape, 3)


def _moved(
    pairs: Float[np.ndarray, "s 2 3"], step: Float[np.ndarray, "s p"], free: tuple[str, ...]
) -> Float[np.ndarray, "s 6"]:
    """Turn by Cayley's rotation and multiply free scales by one plus the step.

    Degenerate images may be fitted best by a scale of zero. Factors reach it in few steps,
    exponentials in hundreds.
    """
    half = 0.5 * step[:, None, :3]
    once = _turns(pairs) @ half[..., None]
    twice = _turns(once[..., 0]) @ half[..., None]
    factor = 2 / (1 + np.sum(half**2, axis=2, keepdims=True))
    turned = pairs + factor * (once + twice)[..., 0]
    if free:
        lengths = np.linalg.norm(pairs, axis=2)[:, -step[:, 3:].shape[1] :]
        factors = np.maximum(1 + np.clip(step[:, 3:], -1.0, 2.0), LEAST_SCALE / lengths)
        if free == ("axial",):
            factors = np.concatenate([np.ones_like(factors), factors], axis=1)
        turned = turned * factors[:, :, None]
    return turned.reshape(-1, 6)


def _assemble(
    x: Float[np.ndarray, " 6"], certificate: Certificate, reduced: ReducedObjective, data: ImageData
) -> ClosedForm:
    """The calibration that a minimiser (a1, a3) stands for."""
    origin, point = reduced.origin_and_target(x)
    pair = x.reshape(2, 3)
    lengths = np.linalg.norm(pair, axis=1)
    r1, r3 = pair / lengths[:, None]
    scaled = reduced.constraints.scaled
    if scaled:
        # The offset of the face is part of t so far.
        origin = origin - data.face_offset * r3
    transform = np.eye(4)
    transform[:3, :3] = np.stack([r1, np.cross(r3, r1), r3], axis=1)
    transform[:3, 3] = origin
    scale = data.spacing * lengths if scaled else data.spacing
    speed = float(lengths[1]) if reduced.constraints.free == ("axial",) else 1.0
    return ClosedForm(
        image_to_probe=transform,
        point=point,
        scale_mm_per_px=scale if data.pixels else None,
        sound_speed_factor=speed,
        rms=float(np.sqrt(certificate.objective_mm2 / reduced.images)),
        objective_mm2=certificate.objective_mm2,
        certified=certificate.certified,
        gap_mm2=certificate.gap_mm2,
        unique=certificate.unique,
    )
