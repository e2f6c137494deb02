"""Calibrate one problem or a batch, by any method; the result is a :class:`Calibration`.

:mod:`jaxcal.calibration.options` checks the request. Conventional calibration of one problem has a
closed form, which needs numpy only (:mod:`jaxcal.calibration.conventional`). Everything else, and
everything inside a caller's jit, vmap or grad, is solved by the engine:
:mod:`jaxcal.calibration.pipeline` solves every problem there, as one pure function of arrays, which
:mod:`jaxcal.calibration.programs` compiles.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jaxcal import InputError
from jaxcal.calibration.conventional import closed_form_answer
from jaxcal.calibration.dependence import independent
from jaxcal.calibration.options import (
    DELAY_SD_S,
    SOUND_SPEED_SD_M_S,
    Request,
    as_batch,
    check_values,
    converting,
    prepare,
    unknown_names,
)
from jaxcal.calibration.serial_correlation import widened
from jaxcal.data.problem import Problem
from jaxcal.data.recording import MINIMUM_IMAGES, Recording
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.arrays import is_traced
from jaxcal.runtime.given_values import whole_number
from jaxcal.runtime.precision import importing_jax, in_own_modes, inside_transformation
from jaxcal.solvers.names import Data, Method, PriorName
from jaxcal.solvers.plan import Given, Options, SolvePlan

if TYPE_CHECKING:
    from jax import Array

LARGEST_CHUNK = 2**31 - 1
"""Most lanes that can be asked for side by side."""


@converting
@in_own_modes
def calibrate(
    problem: Problem | Recording,
    method: Method = "joint",
    prior: PriorName = "auto",
    *,
    max_elevation: float | np.ndarray | Array | None = None,
    sigma: tuple[float, ...] | np.ndarray | Array | None = None,
    tracker_sd: float | Array | None = None,
    estimate: str | tuple[str, ...] = (),
    data: Data = "auto",
    sound_speed_sd: float | Array = SOUND_SPEED_SD_M_S,
    delay_sd: float | Array = DELAY_SD_S,
    options: Options | None = None,
    robust: bool = False,
) -> Calibration:
    """Find X, the target and the elevational offsets; no starting guess is needed.

    Args:
        problem: one problem (a batch is handed to :func:`calibrate_batch`), or a recording.
        method: ``joint`` (X, c and every offset together), ``alternating`` (the paper's Fig. 4) or
            ``conventional`` (Eq. 7, every target in the plane). All can be differentiated, but the
            alternation only with tolerances so small that it reaches the minimum.
        prior: distribution of the offsets in the joint method. ``auto``: SDs are estimated, and the
            answer is an average over several distributions of the offsets, with or without a mean,
            and over noise models, weighted by their probability (:mod:`jaxcal.solvers.auto`).
            ``uniform``: the same, but only with uniform distributions of the offsets.
            ``gaussian``: offsets and errors are Gaussian, with the SDs of ``sigma`` or, without it,
            estimated by REML. ``bounded``: |y_i| <= max_elevation with equal weights, the
            alternation's objective. With given ``sigma``, ``auto`` is ``gaussian``.
        max_elevation: bound m on |y|, mm, one number or (n,); overrides the problem's own. Without
            either bound, the alternation and ``bounded`` use 1 mm. ``auto`` and ``uniform``
            truncate the distribution of each image's offset at the bound.
        sigma: given SDs of lateral position, range and elevational offset, mm; on channels, of an
            element's distance and the elevational offset.
        tracker_sd: isotropic SD of the tracked position, mm; only with a given ``sigma``.
        estimate: further unknowns: ``scale`` (the pixels' size), ``sound-speed``, ``delay``; one
            name, or several.
        data: ``channels``: the joint method's residuals are those of every element's time of flight
            (the recording must hold them); ``points``: those of the segmented points; ``auto``:
            channels if they hold more information: on curvilinear probes and for sound speed or
            delay.
        sound_speed_sd: prior SD of the sound speed about its nominal value, m/s (joint method,
            except ``bounded``).
        delay_sd: prior SD of the delay about its nominal value, s (joint method, except
            ``bounded``).
        options: tolerances and limits.
        robust: first find the images that agree with each other, even if nearly half of all images
            are wrong (:mod:`jaxcal.solvers.consensus`), and leave the others out. Many images that
            are wrong in the same way, by a few mm (a mount that slipped), agree with each other and
            may stay. ``outlier`` and ``departure`` say which and why. If no image has a gross
            error, none is left out, and the answer is the same as without ``robust``.

    Returns:
        A :class:`Calibration`; read its ``status`` and ``warnings`` before using it. The frames of
        one pose count as one image, and frames of frozen tracking are left out
        (:mod:`jaxcal.calibration.dependence`); frames that do not count are masked out in the
        answer and in its ``problem``. Errors correlated in successive images widen its covariance
        (:mod:`jaxcal.calibration.serial_correlation`). All this is done for one problem with
        concrete arrays only; under jit, vmap or grad, and in batches, images are treated as
        independent.

    Raises:
        InputError: options that contradict each other or the problem; with concrete arrays also
            NaN, Inf and fewer than 4 different poses. Under jit, vmap or grad values cannot be
            checked, and such problems get the status ``failed``. Also where an alternation is
            differentiated that stops before the minimum.
    """
    assert isinstance(problem, Problem)  # converted
    request = Request(
        method,
        prior,
        max_elevation,
        sigma,
        tracker_sd,
        unknown_names(estimate),
        data,
        sound_speed_sd,
        delay_sd,
        options,
        robust,
    )
    problem, plan, given = prepare(problem, request)
    if problem.batch_shape:
        from jaxcal.calibration.engine import solve_batch

        return solve_batch(problem, given, plan, None)
    check_values(problem)
    if is_traced(problem, given):
        return replace(_solve_alone(problem, given, plan), problem=problem)
    joined, found = independent(problem, request.estimate)
    left = int(np.count_nonzero(np.asarray(joined.mask) > 0))
    if left < MINIMUM_IMAGES:
        raise InputError(
            f"{'; '.join(found.words) or 'too few images'}; at least {MINIMUM_IMAGES} that are "
            "independent are needed: hold the probe still at different poses"
        )
    solved = _solve_alone(joined, given, plan)
    return widened(replace(solved, problem=joined, notes=tuple(found.words)))


def _solve_alone(problem: Problem, given: Given, plan: SolvePlan) -> Calibration:
    """Solve one problem in closed form or by the engine (traceable); the result is without it."""
    found = None
    if plan.method == "conventional" and not inside_transformation(problem, given):
        found = closed_form_answer(problem, plan)
    if found is None:
        from jaxcal.calibration.engine import solve_problem

        return solve_problem(problem, given, plan)
    if "jax" in sys.modules:
        from jaxcal.calibration.engine import as_jax_holds

        return as_jax_holds(found, problem)
    return found


@importing_jax
@in_own_modes
def calibrate_batch(
    problems: Problem | Sequence[Problem | Recording],
    method: Method = "joint",
    prior: PriorName = "auto",
    *,
    max_elevation: float | np.ndarray | Array | None = None,
    sigma: tuple[float, ...] | np.ndarray | Array | None = None,
    tracker_sd: float | Array | None = None,
    estimate: str | tuple[str, ...] = (),
    data: Data = "auto",
    sound_speed_sd: float | Array = SOUND_SPEED_SD_M_S,
    delay_sd: float | Array = DELAY_SD_S,
    options: Options | None = None,
    robust: bool = False,
    chunk: int | None = None,
) -> Calibration:
    """:func:`calibrate` for a batch of problems, compiled once and solved in chunks.

    A problem that cannot be solved (NaN, degenerate) gets its own status and does not affect the
    others.

    Problems that are not committed to a device are divided among all of JAX's local devices. A
    processor is one device, unless ``jax.config.update("jax_num_cpu_devices", n)`` (or
    JAX_NUM_CPU_DEVICES=n) before JAX's first use makes it n devices, one for each core. Except for
    rounding, results do not depend on this.

    Args:
        problems: leading axes of any shape; see :func:`jaxcal.stack`. A list of problems or
            recordings is stacked; all must have the same number of images.
        method: as for :func:`calibrate`.
        prior: as for :func:`calibrate`.
        max_elevation: as for :func:`calibrate`.
        sigma: as for :func:`calibrate`.
        tracker_sd: as for :func:`calibrate`.
        estimate: as for :func:`calibrate`.
        data: as for :func:`calibrate`.
        sound_speed_sd: as for :func:`calibrate`.
        delay_sd: as for :func:`calibrate`.
        options: as for :func:`calibrate`.
        robust: as for :func:`calibrate`; it takes longer than the solve.
        chunk: number of problems solved together; by default 32 on a processor (64 with priors
            ``auto`` and ``uniform``, 8 on channels), and on a GPU as many as have a million images
            together.

    Returns:
        A :class:`Calibration` whose arrays have the problems' leading axes.

    Raises:
        InputError: contradicting options, or problems without a leading axis.
    """
    problems = as_batch(problems, "jaxcal.calibrate_batch")
    if not problems.batch_shape:
        raise InputError("calibrate_batch needs problems with a leading axis; use calibrate")
    if chunk is not None:
        chunk = whole_number("chunk", chunk, 1, LARGEST_CHUNK)
    request = Request(
        method,
        prior,
        max_elevation,
        sigma,
        tracker_sd,
        unknown_names(estimate),
        data,
        sound_speed_sd,
        delay_sd,
        options,
        robust,
    )
    problems, plan, given = prepare(problems, request, "jaxcal.calibrate_batch")
    from jaxcal.calibration.engine import solve_batch

    return solve_batch(problems, given, plan, chunk)
