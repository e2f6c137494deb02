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

import numpy as np

from jaxcal.data.problem import Problem
from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.diagnostics.uncertainty import (
    LARGEST_SD,
    covariance_by_axis,
    inverses,
    mm_at_target,
    rounding,
    threshold,
    variances_by_axis,
)
from jaxcal.model.thresholds import STATIONARY
from jaxcal.model.unknowns import FURTHER, count_unknowns, split_further
from jaxcal.result.calibration import Calibration, Linearisation, Medium, Status
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
    blocks, eps = plan.blocks, float(np.finfo(float).eps)
    seen = ImageErrors.of_closed_form(found, problem, blocks)
    plane = np.zeros_like(seen.mask)
    residual, axial = seen.from_circle(plane)
    each = seen.circle_rows(axial)[0]
    rows, errors = each.reshape(-1, count_unknowns(blocks)), residual.ravel()
    design = rows.T @ rows
    used, lever = np.asarray(seen.mask.sum()), np.asarray(seen.lever(seen.mask)[0])
    objective = float(errors @ errors)
    variance = objective / max(3 * used - count_unknowns(blocks), 1.0)

    # As in jaxcal.calibration.answer: which directions are known, in mm at the target.
    scale = mm_at_target(lever, blocks)
    values = np.linalg.eigvalsh(design / np.outer(scale, scale))
    if values[0] <= threshold(eps) * values.sum():
        return None
    least = variance / (LARGEST_SD * lever) ** 2
    weak = values[0] <= least and eps * values.sum() < least
    status = Status.UNOBSERVABLE if weak else Status.CONVERGED
    covariance, information = np.full_like(design, np.nan), design
    if not weak:
        parts, squares = np.einsum("mkp,mkq->kpq", each, each), np.sum(residual[0] ** 2, axis=0)
        inverse = inverses(design[None], eps)[0]
        variances = variances_by_axis(parts, squares, used, inverse, lever)
        relative = covariance_by_axis(parts, variances, inverse)
        covariance, information = variance * relative, inverses(relative[None], eps)[0]

    values = [seen.unknowns.further[name] for name in FURTHER if name in blocks]
    further = np.array([component[0] for value in values for component in value])
    gradient = np.abs(errors @ rows)
    length = np.sqrt(np.diag(design) * objective)
    # With exact data the errors are only rounding, and their gradient means nothing.
    exact = objective <= rounding(used, lever)
    cosine = 0.0 if exact else float(np.max(gradient / np.maximum(length, 1e-300)))
    trace = None
    if plan.options.trace:
        trace = np.full(plan.options.trace, np.nan)
        trace[0] = objective
    none = np.zeros(())
    return Calibration(
        image_to_probe=found.image_to_probe,
        point=found.point_mm,
        elevation=np.where(seen.mask[0] > 0, seen.q[0, :, 1], 0.0),
        # Each with n less a third of the unknowns.
        sigma=np.sqrt(
            (seen.errors[0] ** 2).sum(axis=0) / max(used - count_unknowns(blocks) / 3, 1)
        ),
        offset_law=None,
        channel_sigma=None,
        unknowns_covariance=covariance,
        scale_mm_per_px=found.scale_mm_per_px,
        medium=Medium.of(split_further(further, blocks), covariance, blocks, problem),
        rms=np.asarray(np.sqrt(objective / used)),
        mask=np.asarray(problem.mask, float),
        status_code=np.asarray(status, np.int32),
        differentiable=np.asarray(plan.options.differentiate and not weak and cosine <= STATIONARY),
        sigma_tuned=np.asarray(False),
        convergence=Convergence(
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
        ),
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
