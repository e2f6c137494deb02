"""The joint solve: X, c and every offset together, on the offsets' prior of your choice.

Without bounds this is one Levenberg-Marquardt minimisation (:mod:`jaxcal.solvers.least_squares`).

With bounds the objective can have more than one local minimum along the direction that lateral
position and range do not see, rotation about the lateral axis: the offsets slide along their arcs
together until one set of bounds or another stops them. So it is solved from three starts, the
conventional one and that turned either way by what the bounds allow, each after a few
rounds of the alternation, which descend gently; the lowest of the three is the answer.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from jaxcal.model.parameters import Blocks, Parameters, retract
from jaxcal.model.priors import AbstractPrior, Bounded
from jaxcal.model.residuals import measured_points
from jaxcal.problem import Problem
from jaxcal.solvers.alternating import alternate
from jaxcal.solvers.least_squares import Fit, minimise

WARM_UP_ROUNDS = 10
TURNS = (0.0, 1.0, -1.0)
"""Starts, in units of the rotation that moves a target at mean range by the mean bound."""


def joint(
    start: Parameters,
    prior: AbstractPrior,
    problem: Problem,
    blocks: Blocks,
    *,
    max_steps: int = 100,
    trace: int = 0,
    solver: optx.AbstractLeastSquaresSolver | None = None,
) -> Fit:
    """Minimise a prior's objective over the shared unknowns and all offsets, to full precision.

    Args:
        start: a conventional fit.
        prior: the objective.
        problem: one problem.
        blocks: the free unknowns.
        max_steps: most linearisations from each start.
        trace: how many values of the objective to keep (of the joint steps from the best start).
        solver: another optimistix solver; not with bounds, which it would not keep.

    Returns:
        The fit; with bounds, its iterations are those from all starts and their warm-up.
    """
    if not isinstance(prior, Bounded) or "rotation" not in blocks:
        return minimise(
            start,
            prior,
            problem,
            blocks,
            max_steps=max_steps,
            exact=True,
            trace=trace,
            solver=solver,
        )
    count = jnp.sum(problem.mask)
    bound = jnp.sum(problem.mask * prior.limit(start, problem)) / count
    distance = jnp.sum(problem.mask * measured_points(start, problem)[:, 1]) / count
    turns = jnp.asarray(TURNS, problem.mask.dtype) * bound / distance

    def solve(turn: Float[Array, ""]) -> Fit:
        about_lateral = jnp.zeros(3, problem.mask.dtype).at[0].set(turn)
        turned = retract(start, about_lateral, ("rotation",))
        warm = alternate(
            turned, prior, problem, blocks, tolerance_rad=0.0, tolerance_mm=0.0,
            max_rounds=WARM_UP_ROUNDS,
        )  # fmt: skip
        return minimise(warm.parameters, prior, problem, blocks, max_steps=max_steps, exact=True,
                        trace=trace)  # fmt: skip

    fits = jax.vmap(solve)(turns)
    cost = jnp.where(jnp.isfinite(fits.cost), fits.cost, jnp.inf)
    # Where minimisers form an interval all starts reach the same cost, and the conventional one's
    # is the answer to keep: another must be lower by more than rounding.
    eps = jnp.finfo(cost.dtype).eps
    floor = count * (100 * eps * jnp.max(jnp.abs(problem.poses[:, :3, 3]))) ** 2
    best = jnp.where(cost[0] <= jnp.min(cost) * (1 + 1e-9) + floor, 0, jnp.argmin(cost))
    fit = jax.tree.map(lambda leaf: leaf[best], fits)
    total = jnp.sum(fits.iterations) + WARM_UP_ROUNDS * len(TURNS)
    return Fit(**(vars(fit) | {"iterations": total.astype(fit.iterations.dtype)}))
