"""Conventional calibration (Eq. 7): every target is taken to lie in the image plane.

Three ways to the same minimum of sum_i |c - B_i X p_i|^2, p_i = (x_i, 0, r_i):

- ``lm``: Levenberg-Marquardt, the default, with exact second derivatives near the minimum;
- ``gauss-newton``: without damping and without those;
- ``gradient``: the paper's first step, after Ackerman et al. 2014: gradient descent on the
  Euclidean group over all pairs, sum_{i<j} |B_i X p_i - B_j X p_j|^2, stopped on a tolerance. The
  target is no unknown there. Since sum_{i<j} |a_i - a_j|^2 = n sum_i |a_i - mean a|^2, the pairs
  cost no more than the points, and the minimiser is that of Eq. 7 with c the mean; the path to it
  is not.

Reference: Ackerman, Cheng, Boctor, Chirikjian, "Online ultrasound sensor calibration using gradient
descent on the Euclidean group", ICRA 2014.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxcal.model.parameters import Blocks, Parameters, retract, size
from jaxcal.model.priors import InPlane
from jaxcal.model.residuals import measured_points, point_on_circle
from jaxcal.problem import Problem
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers.initial import closed_form, cube_rotations, start_from_rotation
from jaxcal.solvers.least_squares import Fit, linearise, minimise


class FromScratch(eqx.Module):
    """A conventional fit, the closed-form start, and whether a better start was searched for."""

    fit: Fit
    start: Parameters
    searched: Bool[Array, ""]


def from_scratch(
    problem: Problem,
    blocks: Blocks,
    *,
    solver: str = "lm",
    exact: bool = False,
    max_steps: int = 100,
    trace: int = 0,
) -> FromScratch:
    """Minimise Eq. 7 from the closed-form start, or from the best of many where that is unsound.

    Args:
        problem: one problem.
        blocks: the free unknowns.
        solver: ``lm`` or ``gauss-newton``.
        exact: use second derivatives near the minimum. Eq. 7's residuals are offsets of
            millimetres, and along a direction that the images barely see Gauss-Newton then takes
            hundreds of steps; for a start that is no matter, and they need not be compiled.
        max_steps: most iterations.
        trace: how many values of the objective to keep.
    """
    start = closed_form(problem, blocks)
    candidates = jnp.asarray(cube_rotations(), problem.mask.dtype)
    damping = 0.0 if solver == "gauss-newton" else 1e-3

    def attempt(first: Parameters) -> Fit:
        return minimise(first, InPlane(), problem, blocks, damping=damping, max_steps=max_steps,
                        exact=exact, trace=trace)  # fmt: skip

    # One loop whose first round starts in closed form and which, batched or not, has further
    # rounds only where that start was unsound: the search costs nothing where it is not needed.
    def unfinished(state: tuple) -> Bool[Array, ""]:
        index = state[0]
        return (index == 0) | (jnp.logical_not(start.sound) & (index <= len(candidates)))

    def one_round(state: tuple) -> tuple:
        index, best = state
        rotation = candidates[jnp.maximum(index - 1, 0)]
        turned = start_from_rotation(rotation, problem, blocks)
        first = jax.tree.map(partial(jnp.where, index == 0), start.parameters, turned)
        fit = attempt(first)
        better = (index == 0) | (fit.cost < best.cost) | jnp.logical_not(jnp.isfinite(best.cost))
        return index + 1, jax.tree.map(partial(jnp.where, better), fit, best)

    shapes = jax.eval_shape(attempt, start.parameters)
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    _, fit = jax.lax.while_loop(unfinished, one_round, (jnp.zeros((), jnp.int32), empty))
    first = jax.tree.map(partial(jnp.where, start.sound), start.parameters, fit.parameters)
    return FromScratch(fit, first, jnp.logical_not(start.sound))


def pairwise_points(parameters: Parameters, problem: Problem) -> Float[Array, "n 3"]:
    """B_i X p_i, the target as reconstructed from every image, in the tracker's frame, mm."""
    points = point_on_circle(measured_points(parameters, problem), jnp.zeros_like(problem.mask))
    in_probe = points @ parameters.rotation.T + parameters.translation
    rotated = jnp.einsum("nij,nj->ni", problem.poses[:, :3, :3], in_probe)
    return rotated + problem.poses[:, :3, 3]


class SteepestDescent(optx.AbstractGradientDescent):
    """optimistix's gradient descent with an Armijo search in place of a fixed step."""

    rtol: float
    atol: float
    norm: Callable
    descent: optx.SteepestDescent  # pyright: ignore[reportIncompatibleVariableOverride]
    search: optx.BacktrackingArmijo  # pyright: ignore[reportIncompatibleVariableOverride]
    verbose: Callable[..., None] = eqx.field(static=True, default=lambda **_: None)


def pairwise_gradient(
    start: Parameters,
    problem: Problem,
    blocks: Blocks,
    *,
    tolerance: float = 1e-6,
    max_steps: int = 10_000,
    trace: int = 0,
) -> Fit:
    """The historical gradient descent over all pairs, from a start.

    Args:
        start: first value of the unknowns; pixel scales are held.
        problem: one problem.
        blocks: the free unknowns.
        tolerance: stop when a step lowers the objective by less than this fraction of it and moves
            X by less than this fraction of a radian, or of the lever arm.
        max_steps: most steps.
        trace: length of the (empty) trace.
    """
    movable = tuple(block for block in blocks if block in ("translation", "rotation"))
    count = jnp.sum(problem.mask)
    # In units of the lever arm a radian moves the target as far as a millimetre of translation
    # does; without it steepest descent zigzags for tens of thousands of steps.
    lever = jnp.sqrt(jnp.sum(problem.mask[:, None] * measured_points(start, problem) ** 2) / count)
    unit = jnp.concatenate(
        [jnp.full(3, lever) if name == "translation" else jnp.ones(3) for name in movable]
    ).astype(problem.mask.dtype)

    def cost(tangent: Float[Array, " p"], _: None) -> Float[Array, ""]:
        moved = retract(start, unit * tangent, movable)
        cloud = pairwise_points(moved, problem)
        mean = jnp.sum(problem.mask[:, None] * cloud, axis=0) / count
        spread = jnp.sum(problem.mask[:, None] * (cloud - mean) ** 2)
        # The mean over pairs in units of the lever arm: an objective of order one.
        return spread / (count * lever**2)

    solver = SteepestDescent(
        rtol=tolerance,
        atol=tolerance,
        norm=optx.max_norm,
        descent=optx.SteepestDescent(),
        search=optx.BacktrackingArmijo(step_init=1.0),
    )
    solution = optx.minimise(
        cost, solver, jnp.zeros(size(movable), problem.mask.dtype), max_steps=max_steps, throw=False
    )
    moved = retract(start, unit * solution.value, movable)
    cloud = pairwise_points(moved, problem)
    point = jnp.sum(problem.mask[:, None] * cloud, axis=0) / count
    parameters = replace(moved, point=point)
    none = jnp.zeros(0, problem.mask.dtype)
    arrow, _, _ = linearise(parameters, none, InPlane(), problem, blocks)
    return Fit(
        parameters=parameters,
        offset=none,
        cost=arrow.cost,
        stationarity=arrows.stationarity(arrow),
        settled=solution.result == optx.RESULTS.successful,
        iterations=solution.stats["num_steps"],
        trace=jnp.full(trace, jnp.nan, problem.mask.dtype) if trace else None,
    )
