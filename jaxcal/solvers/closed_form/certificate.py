"""A certificate for any answer to Eq. 7, wherever it came from.

The bound of :func:`jaxcal.solvers.closed_form.reduced_objective.certify_point` is tried first, and
where that proves nothing, the one of :mod:`jaxcal.solvers.closed_form.rotation_relaxation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.problem import Problem, as_problem, check_shapes, check_values
from jaxcal.data.recording import Images, Recording
from jaxcal.model.unknowns import unknown_names
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.runtime.arrays import is_traced
from jaxcal.runtime.given_values import real_array
from jaxcal.runtime.messages import shown
from jaxcal.solvers.closed_form.reduced_objective import (
    Certificate,
    QuadraticConstraints,
    certify_point,
    image_data,
    reduce,
    tolerance,
)
from jaxcal.solvers.closed_form.rotation_relaxation import lower_bound
from jaxcal.solvers.plan import check_size

ORTHONORMAL = 1e-6
"""A rotation or a scale that stretches by more is refused; less is rounding, and is removed."""


def certify(
    problem: Problem | Recording | Images,
    image_to_probe: Float[AnyArray, "4 4"],
    point: Float[AnyArray, " 3"] | None = None,
    *,
    scale_mm_per_px: Float[AnyArray, " 2"] | None = None,
    sound_speed_factor: float = 1.0,
    estimate: str | Sequence[str] = (),
) -> Certificate:
    """Prove that a solution is the global minimum of Eq. 7, or bound how far it is above it.

    Args:
        problem: one problem, a recording, or one set of images.
        image_to_probe: (4, 4), X, mm.
        point: (3,), the target in the tracker's frame, mm; without it the best one for X.
        scale_mm_per_px: [lateral, axial], the estimated scales, if ``estimate`` names one.
        sound_speed_factor: the estimated sound speed over the nominal one.
        estimate: what was unknown beside X and the target: ``()``, ``("scale",)``,
            ``("common-scale",)`` or ``("sound-speed",)``; one name may stand without its tuple.

    Returns:
        A :class:`Certificate`. It is about the objective of Eq. 7, which the conventional method
        minimises; joint methods minimise another one.

    Raises:
        InputError: data that cannot be used, no rotation, a wanted scale that is missing, a scale
            or sound speed other than the nominal one that ``estimate`` does not name, or traced
            arrays.
    """
    if is_traced(problem, image_to_probe, point, scale_mm_per_px, sound_speed_factor):
        raise InputError("certify is computed by numpy: call it outside of jit, vmap and grad")
    problem = as_problem(problem, "jaxcal.certify", channels=False)
    check_shapes(problem)
    if not problem.batch_shape:
        check_values(problem)
    data, constraints = image_data(problem, unknown_names(estimate))
    reduced = reduce(data, constraints)
    transform = real_array(image_to_probe, "image_to_probe")
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise InputError("image_to_probe must be a finite 4x4 matrix, in mm")
    factors = _factors(constraints, data.spacing, scale_mm_per_px, sound_speed_factor)
    if point is not None:
        point = real_array(point, "point")
        if point.shape != (3,) or not np.isfinite(point).all():
            raise InputError("point must be 3 finite numbers, in mm")
    left, stretch, right = np.linalg.svd(transform[:3, :3])
    if np.abs(stretch - 1).max() > ORTHONORMAL or np.linalg.det(left @ right) < 0:
        raise InputError("image_to_probe holds no rotation: its columns are not orthonormal")
    rotation, origin = left @ right, transform[:3, 3]
    x = np.concatenate([factors[0] * rotation[:, 0], factors[1] * rotation[:, 2]])
    if constraints.scaled:
        origin = origin + data.face_offset * rotation[:, 2]
    seen = data.factors_of(constraints)
    in_probe = seen[:, :1] * x[:3] + seen[:, 1:] * x[3:] + origin
    cloud = np.einsum("nij,nj->ni", data.rotations, in_probe) + data.translations
    target = cloud.mean(axis=0) if point is None else point
    value = float(np.sum((cloud - target) ** 2))
    excess = max(value - float(reduced(x)), 0.0)
    found = certify_point(reduced, x, excess=excess)
    if found.certified:
        return found
    relaxed = lower_bound(reduced, x, 0.3 * tolerance(reduced, found.objective_mm2))
    gap = np.inf if relaxed is None else relaxed[0]
    return certify_point(reduced, x, excess=excess, gap=gap)


def _factors(
    constraints: QuadraticConstraints,
    spacing: Float[np.ndarray, " 2"],
    scale_mm_per_px: Any,
    sound_speed_factor: Any,
) -> Float[np.ndarray, " 2"]:
    """The answer's factors on lateral position and range; the bound needs those that are allowed.

    Raises:
        InputError: they are not, or are no such numbers.
    """
    tiny = np.finfo(float).tiny
    check_size("sound_speed_factor", sound_speed_factor, tiny, unit="")
    factors = np.array([1.0, sound_speed_factor], float)
    if constraints.free != ("axial",) and abs(factors[1] - 1) > ORTHONORMAL:
        raise InputError('a sound_speed_factor other than 1 needs estimate=("sound-speed",)')
    if scale_mm_per_px is not None:
        check_size("scale_mm_per_px", scale_mm_per_px, tiny, one=False, unit="mm")
        if np.shape(scale_mm_per_px) != (2,):
            raise InputError(f"scale_mm_per_px must be 2 numbers, not {shown(scale_mm_per_px)}")
        sizes = real_array(scale_mm_per_px, "scale_mm_per_px") / spacing
        if constraints.scaled:
            factors = sizes
        elif np.abs(sizes - 1).max() > ORTHONORMAL:
            raise InputError(
                'a scale_mm_per_px other than the nominal one needs estimate=("scale",)'
            )
    elif constraints.scaled:
        raise InputError("an estimated scale belongs to the answer: give scale_mm_per_px")
    if constraints.free == ("common",) and abs(factors[1] / factors[0] - 1) > ORTHONORMAL:
        raise InputError(
            "a common scale is one factor on lateral and axial spacing, and these are two: "
            'estimate=("scale",) has two'
        )
    return np.asarray(constraints.allowed(factors))
