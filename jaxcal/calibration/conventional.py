"""Conventional calibration of one problem in numpy: the closed form, with its uncertainty.

Eq. 7 has a closed-form global minimum with a proof (:mod:`jaxcal.solvers.closed_form.single`). It
is found in less than a millisecond, while the engine's programs take seconds to import and to load.
So if the closed form is proved to be the only best answer, it is returned. Only
:func:`closed_form_answer` decides this, and the engine solves everything else.

Covariance, status and SDs are defined as in :mod:`jaxcal.calibration.answer`, which computes them
for every method under jit, vmap and grad. Here they are computed from the images' errors and
derivatives, as the diagnostics are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from jaxcal.data.problem import Problem
from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.diagnostics.uncertainty import (
    LARGEST_SD,
    component_freedom,
    covariance_by_axis,
    inverses,
    mm_at_target,
    rounding,
    threshold,
    variances_by_axis,
)
from jaxcal.model.thresholds import STATIONARY
from jaxcal.model.unknowns import FURTHER, Blocks, count_unknowns, split_further
from jaxcal.result.calibration import Calibration, Linearisation, Medium, Status
from jaxcal.runtime.array_types import Float, Num
from jaxcal.runtime.arrays import map_arrays
from jaxcal.solvers.closed_form.reduced_objective import CONSTRAINTS
from jaxcal.solvers.closed_form.single import ClosedForm, solve_problem
from jaxcal.solvers.convergence import Convergence
from jaxcal.solvers.plan import SolvePlan


def closed_form_answer(problem: Problem, plan: SolvePlan) -> Calibration | None:
    """The conventional calibration where the closed form is proved to be the answer, else None.

    It is None for other solvers, a robust search, float32, further unknowns that have no closed
    form (a delay), images that do not determine all unknowns, and minima without a proof.

    Args:
        problem: one problem with concrete, finite values and at least 4 used images.
        plan: the request, for the conventional method.
    """
    options = plan.options
    asked = options.solver == "lm" and not plan.robust
    estimate = tuple(name for name in FURTHER if name in plan.blocks)
    if not asked or options.precision != "float64" or estimate not in CONSTRAINTS:
        return None
    problem = map_arrays(np.asarray, replace(problem, channels=None))
    found = solve_problem(problem, estimate)
    if not (found.certified and found.unique):
        return None
    return _with_uncertainty(found, problem, plan)


def _with_uncertainty(found: ClosedForm, problem: Problem, plan: SolvePlan) -> Calibration | None:
    """The closed form as a calibration without its problem; None where poses are degenerate."""
    blocks = plan.blocks
    seen = ImageErrors.of_closed_form(found, problem, blocks)
    plane = np.zeros_like(seen.mask)
    residual, axial = seen.from_circle(plane)
    each = seen.circle_rows(axial)[0]
    rows, errors = each.reshape(-1, count_unknowns(blocks)), residual.ravel()
    design = rows.T @ rows
    used, lever = np.asarray(seen.mask.sum()), np.asarray(seen.lever(seen.mask)[0])
    objective = float(errors @ errors)
    variance = float(objective / max(3 * used - count_unknowns(blocks), 1.0))
    observability = _observability(design, variance, lever, blocks)
    if observability == "degenerate":
        return None
    weak = observability == "weak"
    status = Status.UNOBSERVABLE if weak else Status.CONVERGED
    covariance, information = np.full_like(design, np.nan), design
    if not weak:
        relative, information = _relative_covariance(each, residual[0], design, used, lever)
        covariance = variance * relative

    values = [seen.unknowns.further[name] for name in FURTHER if name in blocks]
    further = np.array([component[0] for value in values for component in value])
    exact = bool(objective <= rounding(used, lever))
    convergence = _convergence(rows, errors, design, exact=exact, plan=plan)
    still = float(convergence.stationarity) <= STATIONARY
    return Calibration(
        image_to_probe=found.image_to_probe,
        point=found.point,
        elevation=np.where(seen.mask[0] > 0, seen.q[0, :, 1], 0.0),
        sigma=np.sqrt((seen.errors[0] ** 2).sum(axis=0) / component_freedom(used, blocks)),
        offset_law=None,
        channel_sigma=None,
        unknowns_covariance=covariance,
        scale_mm_per_px=found.scale_mm_per_px,
        medium=Medium.of(split_further(further, blocks), covariance, blocks, problem),
        rms=np.asarray(np.sqrt(objective / used)),
        mask=np.asarray(problem.mask, float),
        status_code=np.asarray(status, np.int32),
        differentiable=np.asarray(plan.options.differentiate and not weak and still),
        sigma_tuned=np.asarray(False),
        convergence=convergence,
        linearisation=Linearisation(
            information=information,
            design=design,
            variance=np.asarray(variance),
            tracker_sd=None,
            average_elevation_sd=None,
            further=further if len(further) else None,
        ),
        problem=None,
        method=plan.method,
        prior=plan.reported_prior,
        data="points",
        blocks=blocks,
        robust=False,
    )


def _convergence(
    rows: Float[np.ndarray, "m p"],
    errors: Float[np.ndarray, " m"],
    design: Float[np.ndarray, "p p"],
    *,
    exact: bool,
    plan: SolvePlan,
) -> Convergence:
    """That the closed form took no iteration, and how stationary the answer is.

    ``rows`` are the derivatives of the ``errors`` (mm; 0 where not used) by the unknowns, and
    ``design`` is their normal matrix. If the errors are ``exact``, only rounding, their gradient
    means nothing.
    """
    objective = float(errors @ errors)
    gradient = np.abs(errors @ rows)
    length = np.sqrt(np.diag(design) * objective)
    cosine = 0.0 if exact else float(np.max(gradient / np.maximum(length, 1e-300)))
    trace = None
    if plan.options.trace:
        trace = np.full(plan.options.trace, np.nan)
        trace[0] = objective
    none = np.zeros(())
    return Convergence(
        cost=np.asarray(objective),
        stationarity=np.asarray(cosine),
        tolerance_met=np.asarray(True),
        iterations=np.asarray(0, np.int32),
        variance_rounds=np.asarray(0, np.int32),
        searched_start=np.asarray(False),
        sigma_floored=np.zeros(3, bool),
        rotation_change=none,
        translation_change=none,
        trace=trace,
    )


def _observability(
    design: Float[np.ndarray, "p p"], variance: float, lever: Float[np.ndarray, ""], blocks: Blocks
) -> Literal["degenerate", "weak", "known"]:
    """Which directions are known, in mm at the target, as in :mod:`jaxcal.calibration.answer`."""
    eps = float(np.finfo(float).eps)
    scale = mm_at_target(lever, blocks)
    values = np.linalg.eigvalsh(design / np.outer(scale, scale))
    if values[0] <= threshold(eps) * values.sum():
        return "degenerate"
    least = variance / (LARGEST_SD * lever) ** 2
    return "weak" if values[0] <= least and eps * values.sum() < least else "known"


def _relative_covariance(
    rows: Float[np.ndarray, "n 3 p"],
    residual: Float[np.ndarray, "n 3"],
    design: Float[np.ndarray, "p p"],
    used: Num[np.ndarray, ""],
    lever: Float[np.ndarray, ""],
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p p"]]:
    """Covariance for residuals of variance 1, with a variance for each axis, and its inverse."""
    eps = float(np.finfo(float).eps)
    parts, squares = np.einsum("mkp,mkq->kpq", rows, rows), np.sum(residual**2, axis=0)
    inverse = inverses(design[None], eps)[0]
    variances = variances_by_axis(parts, squares, used, inverse, lever)
    relative = covariance_by_axis(parts, variances, inverse)
    return relative, inverses(relative[None], eps)[0]
