"""The paper's alternation (Fig. 4): closest points on the arcs, then a new X and c, and again.

From the conventional X and c, each round (1) moves every p_i to the point of its arc |y| <= m_i
that is closest to where X and c put the target, and (2) improves X and c with those points held, by
a few Gauss-Newton steps of Eq. 7. It stops when a round moves X by less than a tolerance. Both
half-rounds lower the same sum of squares as the joint ``bounded`` problem; like every ICP it
converges linearly, and where the arcs can slide along themselves (rotation about the lateral axis)
at a rate near 1.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.model.parameters import Blocks, Parameters, retract
from jaxcal.model.priors import Bounded, Fixed
from jaxcal.problem import Problem
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers.least_squares import linearise


class Alternation(eqx.Module):
    """Where the alternation stopped.

    Attributes:
        parameters: the shared unknowns.
        offset: (n,) y_i, mm.
        cost: sum of squared distances, mm^2.
        stationarity: scaled KKT residual of the bounded joint problem there.
        iterations: rounds.
        tolerance_met: True when it stopped because X had stopped moving, False at the round limit.
        rotation_change: X's rotation in the last round, rad.
        translation_change: X's translation in the last round, mm.
        trace: (trace,) cost after each of the first rounds, NaN beyond the last; None if none was
            asked for.
    """

    parameters: Parameters
    offset: Float[Array, " n"]
    cost: Float[Array, ""]
    stationarity: Float[Array, ""]
    iterations: Int[Array, ""]
    tolerance_met: Bool[Array, ""]
    rotation_change: Float[Array, ""]
    translation_change: Float[Array, ""]
    trace: Float[Array, " trace"] | None


class _State(eqx.Module):
    parameters: Parameters
    offset: Float[Array, " n"]
    rounds: Int[Array, ""]
    rotation_change: Float[Array, ""]
    translation_change: Float[Array, ""]
    trace: Float[Array, " trace"]


def alternate(
    start: Parameters,
    prior: Bounded,
    problem: Problem,
    blocks: Blocks,
    *,
    tolerance_rad: float = 1e-3,
    tolerance_mm: float = 0.1,
    max_rounds: int | Int[Array, ""] = 1000,
    inner_steps: int = 2,
    trace: int = 0,
) -> Alternation:
    """Alternate from a (conventional) start.

    Args:
        start: the unknowns to start from.
        prior: the bounds m_i.
        problem: one problem.
        blocks: the free unknowns.
        tolerance_rad: stop when a round turns X by less than this and
        tolerance_mm: moves its origin by less than this.
        max_rounds: most rounds.
        inner_steps: Gauss-Newton steps on X and c in every round.
        trace: how many values of the objective to keep.
    """
    dtype = problem.mask.dtype
    none = jnp.zeros(0, dtype)

    def unfinished(state: _State) -> Bool[Array, ""]:
        moving = (state.rotation_change >= tolerance_rad) | (
            state.translation_change >= tolerance_mm
        )
        return moving & (state.rounds < max_rounds)

    def one_round(state: _State) -> _State:
        offset = prior.start(state.parameters, problem)
        held = Fixed(offset)

        def step(parameters: Parameters, _: object) -> tuple[Parameters, Float[Array, ""]]:
            arrow, _, _ = linearise(parameters, none, held, problem, blocks)
            move, _ = arrows.solve(arrow, jnp.zeros((), dtype))
            return retract(parameters, move, blocks), arrow.cost

        parameters, _ = jax.lax.scan(step, state.parameters, length=inner_steps)
        turned = state.parameters.rotation - parameters.rotation
        moved = state.parameters.translation - parameters.translation
        recorded = state.trace
        if trace:
            cost = jnp.sum(held.residual(parameters, none, problem) ** 2)
            recorded = jnp.where(jnp.arange(trace) == state.rounds, cost, recorded)
        return _State(
            parameters,
            offset,
            state.rounds + 1,
            # 2 asin(|R1 - R2| / sqrt 8), the angle, keeps its digits where acos would lose them.
            2 * jnp.arcsin(jnp.minimum(jnp.linalg.norm(turned) / jnp.sqrt(8.0).astype(dtype), 1)),
            jnp.linalg.norm(moved),
            recorded,
        )

    infinite = jnp.asarray(jnp.inf, dtype)
    state = _State(
        start, jnp.zeros(problem.images, dtype), jnp.zeros((), jnp.int32), infinite, infinite,
        jnp.full(trace, jnp.nan, dtype),
    )  # fmt: skip
    state = jax.lax.while_loop(unfinished, one_round, state)
    offset = prior.start(state.parameters, problem)
    arrow, _, _ = linearise(state.parameters, offset, prior, problem, blocks)
    # A residual that is nothing but rounding points nowhere.
    reach = jnp.max(jnp.abs(problem.poses[:, :3, 3]) * problem.mask[:, None])
    rounding = 2 * jnp.finfo(dtype).eps * jnp.maximum(reach, jnp.max(jnp.abs(start.point)))
    vanished = arrow.cost <= 3 * problem.images * rounding**2
    return Alternation(
        parameters=state.parameters,
        offset=offset,
        cost=arrow.cost,
        stationarity=jnp.where(vanished, 0.0, arrows.stationarity(arrow)),
        iterations=state.rounds,
        tolerance_met=(state.rotation_change < tolerance_rad)
        & (state.translation_change < tolerance_mm),
        rotation_change=state.rotation_change,
        translation_change=state.translation_change,
        trace=state.trace if trace else None,
    )
