"""Conventional calibration in closed form, of one problem or of a batch."""

from __future__ import annotations

from collections.abc import Sequence

from jaxcal.data.problem import Problem, as_batch, check_shapes, check_values
from jaxcal.data.recording import Images, Recording
from jaxcal.model.unknowns import unknown_names
from jaxcal.runtime.arrays import is_traced
from jaxcal.solvers.closed_form.single import ClosedForm, solve_problem


def calibrate_closed_form(
    problem: Problem | Recording | Images | Sequence[Problem | Recording | Images],
    *,
    estimate: str | Sequence[str] = (),
) -> ClosedForm:
    """Conventional calibration (Eq. 7) in closed form, with a certificate.

    One problem is solved by numpy alone (:mod:`jaxcal.solvers.closed_form.single`), and so is each
    of up to 1024 problems of a batch. A larger batch, and a problem that ``jax.jit``, ``jax.vmap``
    or ``jax.grad`` looks at, is solved by :mod:`jaxcal.solvers.closed_form.batch`.

    Args:
        problem: a problem or a batch of them, a recording, or one set of images; a list of them is
            stacked. Covariances and bounds are not used, since Eq. 7 weighs all images equally.
        estimate: what is unknown beside X and the target: ``()``, ``("scale",)`` (both pixel
            scales), ``("common-scale",)`` (square pixels of unknown size) or
            ``("sound-speed",)``; one name may stand without its tuple.

    Returns:
        The best answer found. Where ``certified`` is False it may not be the best there is; where
        ``unique`` is False others may fit as well, and this is one of them.

    Raises:
        InputError: other names in ``estimate``, data that cannot be used, fewer than 4 images.
    """
    names = unknown_names(estimate)
    problems = as_batch(problem, "jaxcal.calibrate_closed_form", channels=False)
    check_shapes(problems)
    if problems.batch_shape or is_traced(problems):
        from jaxcal.solvers.closed_form.batch import solve_batch

        return solve_batch(problems, names)
    check_values(problems)
    return solve_problem(problems, names)
