"""The road of batches of plain problems: many abreast, on the fused pass over their images.

Plain is what most problems are: points whose common SDs are given or self-tuned, a rigid X, no
further unknowns. They are solved lane by lane by :mod:`jaxcal.solvers.lanes` and what builds on it,
some fifty times faster than by :mod:`jaxcal.pipeline`, which takes everything else and is the
reference for these. Either way :func:`jaxcal.pipeline.finish` makes a calibration of the solution.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from jaxcal import answer
from jaxcal.calibration import Calibration
from jaxcal.model.parameters import RIGID
from jaxcal.model.priors import Bounded, Gaussian
from jaxcal.options import Given, Plan
from jaxcal.pipeline import Solution, agreeing, belief, finish, solved_by
from jaxcal.precision import in_standard_promotion
from jaxcal.problem import Problem
from jaxcal.solvers.fused import Guess, Images, Measured
from jaxcal.solvers.fused_auto import average_abreast
from jaxcal.solvers.fused_methods import Begun, alternate, from_scratch
from jaxcal.solvers.fused_variance import self_tuned
from jaxcal.solvers.lanes import minimise
from jaxcal.solvers.variance import RELATIVE_FLOOR
from jaxcal.solvers.views import matrices


def plain(problem: Problem, given: Given, plan: Plan) -> bool:
    """Whether a problem (or a batch) may take this road."""
    options = plan.options
    if plan.blocks != RIGID or plan.channels or options.trace or options.solver != "lm":
        return False
    if plan.prior == "bounded":
        # The joint bounded objective has several minima: its three starts are the pipeline's.
        return plan.method == "alternating"
    if plan.prior == "gaussian":
        # Where laws are weighed, so are the covariances, and the first fit does without.
        return given.tracker_sd is None and (problem.covariance is None or bool(plan.laws))
    return True


def solve_problems(problems: Problem, given: Given, plan: Plan) -> Calibration:
    """Solve a batch (one leading axis) of plain problems."""
    if not plan.options.differentiate:
        problems, given = jax.lax.stop_gradient((problems, given))
    everything, problems = problems, jax.vmap(lambda problem: agreeing(problem, plan))(problems)
    frozen, numbers = jax.lax.stop_gradient((problems, given))
    images = Images.of(frozen)
    begun = from_scratch(images, max_steps=plan.options.max_iterations)
    solution = run_method(begun, images, frozen, numbers, plan)
    return finish_batch(plan, solution, problems, everything, given)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def finish_batch(
    plan: Plan, solution: Solution, problems: Problem, everything: Problem, given: Given
) -> Calibration:
    """:func:`jaxcal.pipeline.finish` for a batch; where it is differentiated, that function itself.

    Args:
        plan: what is static about the request.
        solution: where the method stopped, with a leading axis, and so are the following.
        problems: the images in use.
        everything: with those that were left out because they do not agree.
        given: numbers that came with the request (without that axis).
    """
    parameters, prior, averaged = solution.parameters, solution.prior, None
    if plan.laws and isinstance(prior, Gaussian):
        averaged = average_abreast(parameters, prior, problems, plan.laws)
        parameters, prior = averaged.parameters, averaged.belief
    information, design = matrices(
        Guess.of(parameters), Images.of(problems), prior, solution.offset
    )
    solved = solved_by(solution, parameters, solution.offset, prior, information, design, plan)
    return answer.assemble(solved, averaged, problems, given, plan)


@finish_batch.defjvp
@in_standard_promotion
def _finish_batch_jvp(plan: Plan, primals: tuple, tangents: tuple) -> tuple:
    def reference(solution, problems, everything, given) -> Calibration:
        return jax.vmap(lambda s, p, e: finish(s, p, e, given, plan))(
            solution, problems, everything
        )

    return jax.jvp(reference, primals, tangents)


def run_method(
    begun: Begun, images: Images, problems: Problem, given: Given, plan: Plan
) -> Solution:
    """The plan's method from conventional fits."""
    options, dtype = plan.options, images.mask.dtype
    lanes = images.mask.shape[0]
    zero, none = jnp.zeros(lanes, dtype), jnp.zeros((lanes, 0), dtype)
    prior = jax.vmap(lambda problem: belief(problem, given, plan))(problems)

    def solution(found, arrived, *, prior=prior, offset=none, **others) -> Solution:
        common = {
            "sigma_floored": jnp.zeros((lanes, 3), bool),
            "variance_rounds": jnp.zeros(lanes, jnp.int32),
            "rotation_change": zero, "translation_change": zero,
        }  # fmt: skip
        parts = {
            "parameters": found.guess.parameters(), "offset": offset, "prior": prior,
            "arrived": arrived, "stationarity": found.cosine, "searched_start": begun.searched,
        } | common | others  # fmt: skip
        return jax.vmap(lambda one: Solution(**one, trace=None))(parts)

    start = begun.fit.guess
    if plan.method == "conventional":
        fit = begun.fit
        return solution(fit, fit.settled, cost=fit.cost, iterations=fit.iterations)
    if isinstance(prior, Bounded):
        done = alternate(
            start, prior.bound, images, tolerance_rad=options.tolerance_rad,
            tolerance_mm=options.tolerance_mm, max_rounds=options.max_rounds,
            inner_steps=options.inner_steps,
        )  # fmt: skip
        return solution(
            done, done.tolerance_met, offset=done.offset, cost=done.normal.cost,
            iterations=done.rounds, rotation_change=done.rotation_change,
            translation_change=done.translation_change,
        )  # fmt: skip
    assert isinstance(prior, Gaussian)
    if not plan.self_tuning:
        fit = minimise(
            start, Measured(prior.sigma.T), images, damping=1e-6, max_steps=options.max_iterations,
            head_start=False,
        )  # fmt: skip
        return solution(fit, fit.settled, cost=fit.cost, iterations=fit.iterations)
    tuned = self_tuned(start, prior.sigma.T, images, max_rounds=options.max_iterations)
    floored = tuned.updated <= 1.001 * RELATIVE_FLOOR * jnp.max(tuned.updated, axis=0)
    return solution(
        tuned, tuned.settled, prior=jax.vmap(Gaussian)(tuned.updated.T), cost=tuned.cost,
        iterations=tuned.rounds, sigma_floored=floored.T, variance_rounds=tuned.rounds,
    )  # fmt: skip
