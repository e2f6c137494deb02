"""Any solver of optimistix in place of the package's own, on the same residuals.

Such a solver takes one problem at a time, here a batch of one, and stops by its own rule; a larger
batch is mapped over it. SDs are tuned by the historical method: one complete weighted solve before
each of Helmert's updates.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaxcal import InputError
from jaxcal.model.batch import ImagePlanes, Iterate, choose, targets
from jaxcal.model.observations import FurtherUnknowns, MediumPrior, Observation
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING
from jaxcal.runtime.compiler import traced_once
from jaxcal.solvers.levenberg_marquardt import Minimum, Rounding, empty_trace, gradient_cosine
from jaxcal.solvers.normal_equations import accumulate, component_sums, weight_of
from jaxcal.solvers.plan import Options
from jaxcal.solvers.reml import sigma_tolerance, update_at, with_least_sigma

MOST_UPDATES = 60
"""Most updates of the SDs."""


class Fit(Minimum):
    """Where the solver stopped; its trace is NaN, since the solver does not tell its values.

    Attributes:
        updated: SDs after the last update, mm; those given where none are tuned.
        rounds: number of solves with other SDs; 0 where none are tuned.
    """

    updated: Float[Array, "k batch"]
    rounds: Int[Array, " batch"]

    @classmethod
    def of(
        cls,
        found: optx.Solution,
        iterate: Iterate,
        start: Iterate,
        observation: Observation,
        images: ImagePlanes,
        medium: MediumPrior | None,
        trace: int,
    ) -> Fit:
        """From a solver's result for one problem, the iterate that it stands for, and the start."""
        normal = accumulate(iterate, observation, images, None, medium)
        rounding = Rounding.of(start, observation, images)
        return cls(
            iterate=iterate,
            cost=normal.cost,
            cosine=gradient_cosine(normal, rounding.vanished),
            iterations=jnp.asarray(found.stats["num_steps"], jnp.int32)[None],
            converged=(found.result == optx.RESULTS.successful)[None],
            trace=empty_trace(trace, normal.cost),
            updated=observation.sigma,
            rounds=jnp.zeros((1,), jnp.int32),
        )


def whitened_residuals(
    iterate: Iterate, observation: Observation, images: ImagePlanes, medium: MediumPrior | None
) -> Float[Array, "residuals batch"]:
    """All residuals of every problem in SDs, zeros where an image is left out; batch axis last."""
    q, tracker_to_image = targets(iterate, images)
    parts = []
    found = observation.components(q, FurtherUnknowns.at(iterate, tracker_to_image), images)
    for component, sd in zip(found, observation.sigma, strict=True):
        for error in component.errors:
            white = weight_of(component, images) * error / sd.reshape(-1, *(1,) * (error.ndim - 1))
            parts.append(white.reshape(images.batch_size, -1).T)
    if medium is not None:
        parts += [
            (away * jnp.sqrt(precision))[None] for _, away, precision in medium.deviations(iterate)
        ]
    return jnp.concatenate(parts)


def minimise_with(
    solver: optx.AbstractLeastSquaresSolver,
    start: Iterate,
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None,
    options: Options,
) -> Fit:
    """Minimise the objective of one problem, a batch of one.

    Raises:
        InputError: float32 and a solver that does not run in it.
    """

    def residual(step: Array, _: None) -> Array:
        moved = start.moved(step[:, None])
        return whitened_residuals(moved, observation, images, medium)[:, 0]

    still = jnp.zeros(start.unknowns, images.mask.dtype)
    try:
        found = optx.least_squares(
            residual, solver, still, max_steps=options.max_iterations, throw=False
        )
    except (TypeError, ValueError) as error:
        if still.dtype != jnp.float32:
            raise
        raise InputError(
            f"optimistix's {type(solver).__name__} does not run in float32 while JAX has 64 bits: "
            "use precision float64, or jaxcal.backend.LevenbergMarquardt()"
        ) from error
    iterate = start.moved(found.value[:, None])
    return Fit.of(found, iterate, start, observation, images, medium, options.trace)


def self_tuned_with(
    solver: optx.AbstractLeastSquaresSolver,
    start: Iterate,
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None,
    options: Options,
) -> Fit:
    """Weighted solves of one problem, with Helmert's updates between them until the SDs stay."""
    enough, tolerance = images.used >= MINIMUM_SELF_TUNING, sigma_tolerance(images.mask.dtype)
    squares = component_sums(start, observation, images, None, medium).squares
    crude = with_least_sigma(jnp.sqrt(squares / observation.count(images)))
    first = jnp.where(enough, crude, observation.sigma)

    def solve(iterate: Iterate, sigma: Array) -> Fit:
        observed = observation.with_sigma(sigma)
        fit = minimise_with(solver, iterate, observed, images, medium, options)
        updated = update_at(fit.iterate, sigma, observation, images, medium)[1]
        return eqx.tree_at(lambda f: f.updated, fit, updated)

    solve, empty = traced_once(solve, start, first)

    def unfinished(state: tuple) -> Array:
        _, _, rounds, change, _ = state
        return jnp.any(change > tolerance) & (rounds < MOST_UPDATES)

    def one_round(state: tuple) -> tuple:
        fit, sigma, rounds, change, taken = state
        after = solve(fit.iterate, sigma)
        moving = change > tolerance
        moved = jnp.max(jnp.abs(jnp.log(after.updated / sigma)), axis=0)
        # A problem that is lost (NaN) must stop, not hold up the others.
        moved = jnp.where(jnp.isfinite(moved), moved, 0.0)
        after, sigma, change, taken = choose(
            moving,
            (after, after.updated, moved, taken + after.iterations),
            (fit, sigma, change, taken),
        )
        return after, sigma, rounds + 1, change, taken

    empty = eqx.tree_at(lambda fit: fit.iterate, empty, start)
    one = jnp.ones_like(first[0])
    state = (empty, first, jnp.zeros((), jnp.int32), one, jnp.zeros(one.shape, jnp.int32))
    fit, _, rounds, change, taken = jax.lax.while_loop(unfinished, one_round, state)
    done = fit.converged & (change <= tolerance)
    return eqx.tree_at(
        lambda f: (f.converged, f.iterations, f.rounds), fit, (done, taken, rounds[None])
    )
