"""The paper's alternation (Fig. 4), and the joint solve of the objective that it descends.

From the conventional X and c, each round of the alternation (1) moves every p_i to the point of its
arc |y| <= m_i that is closest to where X and c put the target, and (2) improves X and c with those
points held, by a few Gauss-Newton steps of Eq. 7. It stops when a round moves X by less than a
tolerance. Like every ICP it converges linearly. Its rate is near 1 where the arcs can slide along
themselves (rotation about the lateral axis).

The joint solve minimises the same objective to full precision, with every offset eliminated in its
image. The objective can have several local minima along the direction that lateral position and
range do not determine, rotation about the lateral axis: the offsets slide along their arcs together
until one set of bounds or another stops them. So the joint solve has three starts: the conventional
fit, and that fit turned either way by as much as the bounds allow. Each start first takes a few
rounds of the alternation, which descend gently; the lowest of the three minima is the answer.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxcal.data.geometry import chord_angle
from jaxcal.model.batch import ImagePlanes, Iterate, barrier, choose
from jaxcal.model.observations import BoundedOffsets, FurtherUnknowns, HeldOffsets, local_unknowns
from jaxcal.solvers import dense
from jaxcal.solvers.batch_loop import until_done
from jaxcal.solvers.levenberg_marquardt import (
    Minimum,
    Rounding,
    empty_trace,
    gradient_cosine,
    minimise,
    recorded,
)
from jaxcal.solvers.normal_equations import accumulate

WARM_UP_ROUNDS = 10
TURNS = (0.0, 1.0, -1.0)
"""Starts, in units of the rotation that moves a target at mean range by the mean bound."""


class Alternation(Minimum):
    """Where the alternation stopped, or its state; the cosine is that of the bounded joint problem.

    Attributes:
        rotation_change: X's rotation in the last round, rad.
        translation_change: X's translation in the last round, mm.
    """

    rotation_change: Float[Array, " batch"]
    translation_change: Float[Array, " batch"]


def alternate(
    start: Iterate,
    observation: BoundedOffsets,
    images: ImagePlanes,
    *,
    tolerance_rad: float,
    tolerance_mm: float,
    max_rounds: int | Int[Array, ""],
    inner_steps: int,
    trace: int = 0,
) -> Alternation:
    """Alternate from (conventional) starts.

    Args:
        start: the unknowns to start from.
        observation: the bounds.
        images: the data.
        tolerance_rad: stop when a round turns X by less than this, and
        tolerance_mm: moves X's origin by less than this.
        max_rounds: most rounds.
        inner_steps: Gauss-Newton steps on X and c in every round.
        trace: how many values of the objective to keep.
    """
    none = jnp.zeros_like(images.mask[:, 0])
    eps = jnp.finfo(none.dtype).eps

    def one_round(state: Alternation, data: tuple) -> Alternation:
        observation, images = data
        held = HeldOffsets.of(barrier(local_unknowns(state.iterate, observation, images)), images)

        def gauss_newton(_: Array, iterate: Iterate) -> Iterate:
            normal = barrier(accumulate(iterate, held, images, None))
            eye = jnp.eye(len(normal.gradient), dtype=normal.gradient.dtype)[..., None]
            matrix, gradient = barrier((normal.stacked() * (1 + 16 * eps * eye), normal.gradient))
            step = barrier(dense.solve_batch_last(matrix, -gradient))
            # Along a direction that the images do not determine, a step is rounding and can
            # overflow: then X and c stay, and their information says what is not determined.
            finite = jnp.all(jnp.isfinite(step), axis=0)
            return barrier(iterate.moved(jnp.where(finite, step, 0)))

        after = jax.lax.fori_loop(0, inner_steps, gauss_newton, state.iterate)
        kept = state.trace
        if kept is not None:
            kept = recorded(kept, state.iterations, accumulate(after, held, images, None).cost)
        moved = replace(
            state,
            iterate=after,
            iterations=state.iterations + 1,
            rotation_change=chord_angle(state.iterate.rotation - after.rotation),
            translation_change=jnp.sqrt(
                jnp.sum((state.iterate.translation - after.translation) ** 2, axis=0)
            ),
            trace=kept,
        )
        return choose(active(state), moved, state)

    def active(state: Alternation) -> Bool[Array, " batch"]:
        moving = state.rotation_change >= tolerance_rad
        moving = moving | (state.translation_change >= tolerance_mm)
        return moving & (state.iterations < max_rounds)

    state = Alternation(
        iterate=start,
        cost=none,
        cosine=none,
        iterations=jnp.zeros(none.shape, jnp.int32),
        converged=jnp.zeros(none.shape, bool),
        trace=empty_trace(trace, none),
        rotation_change=none + jnp.inf,
        translation_change=none + jnp.inf,
    )
    state = until_done(one_round, state, (observation, images), active)
    normal = barrier(accumulate(state.iterate, observation, images, None))
    rounding = Rounding.of(start, observation, images)
    still = (state.rotation_change < tolerance_rad) & (state.translation_change < tolerance_mm)
    cosine = gradient_cosine(normal, rounding.vanished)
    return replace(state, cost=normal.cost, cosine=cosine, converged=still)


def bounded(
    start: Iterate,
    observation: BoundedOffsets,
    images: ImagePlanes,
    *,
    max_steps: int = 100,
    trace: int = 0,
) -> Minimum:
    """The joint solve with bounded offsets, from conventional fits; its trace is of the best start.

    Returns:
        The fits; their iterations count those from all starts, and the warm-up.
    """
    further = FurtherUnknowns.at(start)
    bound = jnp.sum(images.mask * observation.limit(further, images), axis=1)
    turn = bound / jnp.sum(images.mask * further.points(images)[1], axis=1)
    zero = jnp.zeros_like(turn)

    def turned(by: float) -> Iterate:
        step = [zero] * start.unknowns
        step[3] = by * turn
        return start.moved(step)

    # All three starts at once, in a batch three times as large.
    starts = jax.tree.map(
        lambda *leaves: jnp.concatenate(leaves, axis=-1), *(turned(by) for by in TURNS)
    )
    wide, limits = images.repeated(len(TURNS)), jnp.tile(observation.bound, (len(TURNS), 1))
    everywhere = BoundedOffsets.of(limits, wide)
    warm = alternate(
        starts,
        everywhere,
        wide,
        tolerance_rad=0.0,
        tolerance_mm=0.0,
        max_rounds=WARM_UP_ROUNDS,
        inner_steps=2,
    )
    fits = minimise(warm.iterate, everywhere, wide, max_steps=max_steps, trace=trace)
    count = images.batch_size
    parts = [
        jax.tree.map(lambda leaf, k=k: leaf[..., k * count : (k + 1) * count], fits)
        for k in range(len(TURNS))
    ]
    costs = jnp.stack([jnp.where(jnp.isfinite(fit.cost), fit.cost, jnp.inf) for fit in parts])
    # Where minimisers form an interval, all starts reach the same cost. The conventional start's
    # answer is kept then: another one must be lower by more than rounding.
    eps = jnp.finfo(costs.dtype).eps
    size = jnp.max(jnp.abs(images.origin), axis=(0, 2))
    floor = images.used * (100 * eps * size) ** 2
    first = costs[0] <= jnp.min(costs, axis=0) * (1 + 1e-9) + floor
    best = jnp.where(first, 0, jnp.argmin(costs, axis=0))
    fit = parts[0]
    for k, other in enumerate(parts[1:], start=1):
        fit = choose(best == k, other, fit)
    taken = jnp.sum(jnp.stack([part.iterations for part in parts]), axis=0)
    taken = taken + WARM_UP_ROUNDS * len(TURNS)
    return eqx.tree_at(lambda found: found.iterations, fit, taken.astype(jnp.int32))
