"""Self-tuning: SDs of the measurements and of the elevational offset, estimated from the data.

Restricted maximum likelihood (REML) by Helmert's iteration for variance components,

    s_k^2 = |residual_k|^2 / (n_k - leverage_k),      leverage_k = tr(S^-1 N_k) / s_k^2,

where N_k is component k's normal matrix, S the weighted sum of them all, and leverage_k the number
of degrees of freedom that the unknowns take from component k. So no noise level and no maximum
elevational distance is chosen by hand. The components are those of the observation in use: lateral
position, range and offset, or the elements' distances and the offset.

The pass sums every component separately (:func:`jaxcal.solvers.normal_equations.component_sums`).
To first order in the step d these sums give the following for any SDs, with C what exact second
derivatives add to the curvature:

    H(s) = sum N_k / s_k^2,      d(s) = -(H(s) + C)^-1 sum g_k / s_k^2,
    rss_k(d) = rss_k + 2 g_k' d + d' N_k d,
    s_k^2 <- rss_k(d) / (n_k - tr(H(s)^-1 N_k) / s_k^2),

so the SDs are updated a few times from these sums alone, the step for the new SDs is taken, and the
next pass computes the exact sums there. Steps are accepted by the decrease of the weighted cost
with the new SDs, and damped as in :mod:`jaxcal.solvers.levenberg_marquardt`. A problem has
converged when, at the same iterate, the update no longer changes the SDs and the gradient no longer
moves the unknowns: the fixed point of Helmert's iteration.

A component whose error truly vanishes (no noise, or every target in the plane) would drive its SD
to zero and the weights to infinity. The SD is held at a thousandth of the largest one, which is as
good as exact for X. With too few images the SDs stay at their given values.

References: Helmert 1924; Patterson and Thompson 1971 (REML); Foerstner 1979.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal.model.batch import ImagePlanes, Iterate, barrier, choose
from jaxcal.model.observations import MediumPrior, Observation
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING
from jaxcal.solvers import dense
from jaxcal.solvers.batch_loop import until_done
from jaxcal.solvers.levenberg_marquardt import (
    DAMPING_INCREASE,
    LARGEST_DAMPING,
    LEAST_DAMPING,
    MOST_STALLED,
    LoopState,
    Rounding,
    damped_step,
    default_tolerance,
    gradient_cosine,
    largest_coordinate,
    recorded,
)
from jaxcal.solvers.normal_equations import (
    ComponentSums,
    NormalEquations,
    component_sums,
    stacked,
    traces,
)

RELATIVE_FLOOR = 1e-3
ABSOLUTE_FLOOR_MM = 1e-6

LEAST_FREEDOM = 0.05
"""Least degrees of freedom of a component, as a share of its residuals."""

EXACT_TUNING_BELOW = 0.03
"""Gradient cosine below which exact second derivatives are used."""

UPDATES = 3
"""Updates of the SDs from the sums of one pass."""


def least_sigma(sigma: Float[Array, " components ..."]) -> Float[Array, " ..."]:
    """The floor of SDs, mm: a thousandth of the largest."""
    return jnp.maximum(RELATIVE_FLOOR * jnp.max(sigma, axis=0), ABSOLUTE_FLOOR_MM)


def with_least_sigma(sigma: Float[Array, " components ..."]) -> Float[Array, " components ..."]:
    """The SDs, none below a thousandth of the largest."""
    return jnp.maximum(sigma, least_sigma(sigma))


def on_floor(sigma: Float[Array, " components ..."]) -> Bool[Array, " components ..."]:
    """Which SDs rest on their floor."""
    return sigma <= 1.001 * least_sigma(sigma)


def helmert(
    squares: Array, leverage: Array, count: Array, sigma: Float[Array, "k batch"]
) -> Float[Array, "k batch"]:
    """One update of the SDs, mm, without floor.

    Args:
        squares: sums of squared residuals, mm^2.
        leverage: tr(S^-1 N_k), mm^2.
        count: numbers of residuals.
        sigma: the SDs with which S was formed, mm.
    """
    freedom = jnp.maximum(count - leverage / sigma**2, LEAST_FREEDOM * count)
    return jnp.sqrt(jnp.maximum(squares, 0.0) / freedom)


class SelfTuned(LoopState):
    """The state of every problem; at the end, its answer.

    A problem has converged if the SDs met their tolerance, and the gradient cosine met its own or
    steps gain nothing above rounding.

    Attributes:
        sigma: the SDs, mm.
        updated: the SDs after one more update at ``iterate``, mm.
        change: largest relative change of the SDs by that update (its logarithm).
        proposed: the SDs at ``candidate``, mm.
        units: the SDs with which the residuals were formed in the last pass, mm.
        step_sigma: the SDs for which the step to the candidate was computed, mm.
        half_cost: half the cost before that step, with ``step_sigma``.
    """

    sigma: Float[Array, "k batch"]
    updated: Float[Array, "k batch"]
    change: Float[Array, " batch"]
    proposed: Float[Array, "k batch"]
    units: Float[Array, "k batch"]
    step_sigma: Float[Array, "k batch"]
    half_cost: Float[Array, " batch"]


class Proposal(eqx.Module):
    """The next candidate, from the sums at the iterate.

    Attributes:
        move: the step.
        sigma: the SDs after it, mm.
        step_sigma: the SDs for which the step was computed, mm.
        updated: the SDs after one update at the iterate, mm.
        exact: 1 where exact second derivatives were used.
        indefinite: the matrix was indefinite, and the step is zero.
        predicted: predicted decrease of half the cost with ``step_sigma``.
    """

    move: Float[Array, "p batch"]
    sigma: Float[Array, "k batch"]
    step_sigma: Float[Array, "k batch"]
    updated: Float[Array, "k batch"]
    exact: Float[Array, " batch"]
    indefinite: Bool[Array, " batch"]
    predicted: Float[Array, " batch"]


def updated(
    sums: ComponentSums,
    normal: NormalEquations,
    sigma: Float[Array, "k batch"],
    move: Float[Array, "p batch"],
    count: Float[Array, "k batch"],
) -> Float[Array, "k batch"]:
    """Helmert's update after a step."""
    diagonal = normal.diagonal()
    ridge = 16 * jnp.finfo(count.dtype).eps * jnp.where(diagonal > 0, diagonal, 1.0)
    eye = jnp.eye(len(diagonal), dtype=diagonal.dtype)[..., None]
    inverse, _ = dense.inverse_batch_last(stacked(normal.curvature) + eye * ridge)
    leverage = traces(inverse, sums.matrix)
    bent = traces(move[:, None] * move, sums.matrix)
    left = sums.squares + 2 * jnp.sum(sums.gradient * move, axis=1) + bent
    return with_least_sigma(helmert(left, leverage, count, sigma))


class Tuning(eqx.Module):
    """What all passes over a batch have in common.

    Attributes:
        observation: the objective.
        images: the data.
        medium: prior of further unknowns, or None.
        fallback: the SDs of problems with too few images to estimate them, mm.
        count: numbers of residuals.
        enough: problems with enough images to estimate SDs.
        coordinates: size of the coordinates that rounding acts on, mm.
        cosine_tolerance: gradient cosine below which the unknowns have converged.
        sigma_tolerance: relative change of an update below which the SDs have converged.
        max_steps: most passes.
    """

    observation: Observation
    images: ImagePlanes
    medium: MediumPrior | None
    fallback: Float[Array, "k batch"]
    count: Float[Array, "k batch"]
    enough: Bool[Array, " batch"]
    coordinates: Float[Array, " batch"]
    cosine_tolerance: float = eqx.field(static=True)
    sigma_tolerance: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)

    def propose(self, sums: ComponentSums, sigma: Array, damping: Array, exact: Array) -> Proposal:
        """From the sums at an iterate, a few updates of the SDs and the step for the new SDs."""

        def again(carry: tuple) -> tuple:
            count, before = carry
            sigma, exact = before.sigma, before.exact
            normal = sums.weighted(1 / sigma**2)
            curved = NormalEquations(
                normal.curvature + exact * sums.rest,
                normal.gradient,
                normal.cost,
                normal.diagonal(),
            )
            move, predicted, indefinite = damped_step(curved, damping)
            after = barrier(updated(sums, normal, sigma, move, self.count))
            tuned = jnp.where(jnp.isfinite(after), after, sigma)
            after = jnp.where(self.enough, tuned, self.fallback)
            found = Proposal(
                move=move,
                sigma=after,
                step_sigma=sigma,
                updated=jnp.where(count == 0, after, before.updated),
                exact=jnp.where(indefinite, 0.0, exact),
                indefinite=indefinite,
                predicted=predicted,
            )
            return count + 1, found

        none = jnp.zeros_like(sums.gradient[0])
        begun = Proposal(none, sigma, sigma, sigma, exact, exact > 1, none[0])
        carry = (jnp.zeros((), jnp.int32), begun)
        return jax.lax.while_loop(lambda carry: carry[0] < UPDATES, again, carry)[1]

    def iterate_once(self, state: SelfTuned) -> SelfTuned:
        """One pass over the images at the candidate, and the next candidate."""
        observed = self.observation.in_units(state.proposed)
        sums = barrier(
            component_sums(state.candidate, observed, self.images, state.proposed, self.medium)
        )
        accept, here = self.judged(state, sums)
        # Where the candidate is refused, the proposal from its sums is not used.
        exact = here.cosine <= EXACT_TUNING_BELOW
        exact = jnp.where(exact, 1.0, 0.0).astype(self.coordinates.dtype)
        found = self.propose(sums, here.sigma, here.damping, exact)
        change = jnp.max(jnp.abs(jnp.log(found.updated / here.sigma)), axis=0)
        more = jnp.maximum(DAMPING_INCREASE * here.damping, LEAST_DAMPING)
        retry = found.indefinite | jnp.logical_not(accept)
        after = replace(
            here,
            updated=jnp.where(accept, found.updated, state.updated),
            change=jnp.where(accept, change, state.change),
            candidate=choose(retry, here.iterate, here.iterate.moved(barrier(found.move))),
            proposed=jnp.where(retry, here.sigma, found.sigma),
            units=state.proposed,
            retry=retry,
            step_sigma=found.step_sigma,
            half_cost=0.5 * sums.weighted(1 / found.step_sigma**2).cost,
            predicted=found.predicted,
            exact_used=found.exact,
            damping=jnp.where(found.indefinite & accept, more, here.damping),
            iterations=state.iterations + 1,
            trace=recorded(state.trace, state.iterations, here.cost),
        )
        return choose(state.active, self.stopped(after, accept), state)

    def judged(
        self, state: SelfTuned, sums: ComponentSums
    ) -> tuple[Bool[Array, " batch"], SelfTuned]:
        """Whether the candidate is taken, and the state at the iterate that is kept.

        Of that state, the candidate and all that belongs to the next step are still the old ones.
        """
        crude = with_least_sigma(jnp.sqrt(sums.squares / self.count))
        crude = jnp.where(self.enough, crude, self.fallback)
        proposed = jnp.where(state.iterations == 0, crude, state.proposed)
        normal = sums.weighted(1 / proposed**2)
        rounding = Rounding.at(self.coordinates, 1 / jnp.min(proposed, axis=0), self.images)
        cosine = gradient_cosine(normal, rounding.vanished)
        # New SDs may change the units of the residuals, and so the cost, without any step.
        whitened = sums.squares / state.step_sigma**2
        accept, damping, stalled = state.judged(
            state.half_cost,
            0.5 * sums.weighted(1 / state.step_sigma**2).cost,
            rounding.residual,
            allowance=self.observation.growth(state.units, state.proposed, whitened),
        )
        iterate, sigma, cost, cosine = barrier(
            choose(
                accept & state.active,
                (state.candidate, proposed, normal.cost, cosine),
                (state.iterate, state.sigma, state.cost, state.cosine),
            )
        )
        kept = {"iterate": iterate, "sigma": sigma, "cost": cost, "cosine": cosine}
        return accept, replace(state, **kept, damping=damping, stalled=stalled)

    def stopped(self, after: SelfTuned, accept: Bool[Array, " batch"]) -> SelfTuned:
        """The state after a pass, with every problem ended that is done or given up."""
        there = (after.cosine <= self.cosine_tolerance) | (after.stalled >= MOST_STALLED)
        done = there & (after.change <= self.sigma_tolerance) & accept
        given_up = (after.damping > LARGEST_DAMPING) | (after.iterations >= self.max_steps)
        given_up = given_up | jnp.logical_not(jnp.isfinite(after.cost))
        return replace(after, converged=done, active=jnp.logical_not(done | given_up))


def self_tuned(
    start: Iterate,
    observation: Observation,
    images: ImagePlanes,
    *,
    medium: MediumPrior | None = None,
    max_steps: int = 100,
    trace: int = 0,
) -> SelfTuned:
    """Solve every problem from a conventional fit, its SDs estimated by REML.

    Problems with fewer than 8 used images keep the observation's SDs.

    It stops at a gradient cosine of 1e-10 and a relative change of the SDs of 1e-9 in float64, and
    at 1e-4 for both in float32.
    """
    fallback, count = observation.sigma, observation.count(images)
    enough = images.used >= MINIMUM_SELF_TUNING
    cosine_tolerance = default_tolerance(images.mask.dtype)
    images = images.padded()
    images, observation = barrier((images, observation.padded(images)))
    # Values of a problem are computed once, and not again for every image.
    coordinates, fallback, count, enough = barrier(
        (largest_coordinate(start, images), fallback, count, enough)
    )
    tuning = Tuning(
        observation=observation,
        images=images,
        medium=medium,
        fallback=fallback,
        count=count,
        enough=enough,
        coordinates=coordinates,
        cosine_tolerance=cosine_tolerance,
        sigma_tolerance=sigma_tolerance(images.mask.dtype),
        max_steps=max_steps,
    )
    # Infinite SDs leave out exact second derivatives.
    unknown, number = jnp.full_like(fallback, jnp.inf), jnp.zeros_like(start.point[0])
    begun = SelfTuned.first(
        barrier(start),
        number,
        1e-6,
        trace,
        sigma=unknown,
        updated=unknown,
        change=number,
        proposed=unknown,
        units=unknown,
        step_sigma=unknown,
        half_cost=number,
    )

    return until_done(
        lambda state, tuning: tuning.iterate_once(state), begun, tuning, lambda s: s.active
    )


def sigma_tolerance(dtype: jnp.dtype) -> float:
    """Relative change of the SDs at which they are tuned, in the arithmetic of ``dtype``."""
    return 1e-9 if float(jnp.finfo(dtype).eps) < 1e-10 else 1e-4


def update_at(
    iterate: Iterate,
    sigma: Float[Array, "k batch"],
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None,
) -> tuple[NormalEquations, Float[Array, "k batch"]]:
    """The normal equations with SDs, and the SDs after one update, at an iterate.

    Where :func:`self_tuned` stops, the gradient is zero and the update leaves the SDs as they are;
    :mod:`jaxcal.solvers.implicit` differentiates these two conditions.
    """
    observed = observation.with_sigma(sigma)
    sums = component_sums(iterate, observed, images, None, medium)
    normal = sums.weighted(1 / sigma**2)
    still = jnp.zeros_like(normal.gradient)
    after = updated(sums, normal, sigma, still, observation.count(images))
    enough = images.used >= MINIMUM_SELF_TUNING
    return normal, jnp.where(enough, after, observation.sigma)
