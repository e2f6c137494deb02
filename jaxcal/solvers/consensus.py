"""Which images agree with each other: gross outliers found before the solve, and left out of it.

A wrong echo, a wrong click or a slipped mount moves an image by tens of millimetres, and this may
happen to a third of the images. Least squares on all of them is then far from the truth and its
residuals do not tell good images from bad ones, so the good ones are found by consensus:

1. *Proposals.* Hundreds of small subsets of the images, the same ones every time, are solved in
   closed form (a linear system of 12 unknowns each, from per-image moments that are formed once),
   and each is scored on all images by sum_k ln s_k, with s_k the median magnitude of error
   component k. Up to half of the images may be arbitrary without spoiling a median.
2. *Concentration.* The best of them take Gauss-Newton steps on their own subset, then on the 60 %
   of the images that fit them best, chosen anew each time.
3. *Rejection with re-inclusion.* SDs from the median of the images in use, a step on them, and a
   test of *every* image, so that one left out too early returns.
4. *Evidence.* The finalists' results compete with each other and with the fit to all images. An
   image in use has Gaussian errors with the SDs of the images in use. An image is wrong with
   probability ``WRONG_PROBABILITY``; each of its errors is then as predicted or anywhere in a range
   of ``WRONG_RANGE_MM``. Medians alone would not do: six of a dozen images can be fitted with
   almost no error in one component, which looks like agreement. If no image is an outlier, none is
   left out, and the result equals that of ``robust=False``.

The errors are those of the joint method (lateral position, range, elevational offset), each
with its own SD. An image stands out where a component, corrected for the image's leverage, is more
than ``CUT`` SDs off. The whole search is a fixed number of array operations.

References: Rousseeuw and Van Driessen 2006 (FAST-LTS: proposals and concentration); Fischler and
Bolles 1981 (RANSAC); Huber and Ronchetti 2009 (hard rejection as reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.data.problem import Problem
from jaxcal.model.outlying import robust_sd, stands_out, studentise, with_gross_floor
from jaxcal.model.parameters import Parameters, retract
from jaxcal.model.residuals import measured_points, measurement_residual
from jaxcal.model.thresholds import FEWEST_TO_LEAVE_OUT
from jaxcal.model.unknowns import Blocks, count_unknowns
from jaxcal.runtime.jax_modes import in_standard_promotion
from jaxcal.solvers import dense
from jaxcal.solvers.proposals import SUBSET, linear_proposals, nominal, subset_weights

SUBSET_STEPS = 2
"""Gauss-Newton steps on a proposal's own subset."""
CONCENTRATION = 0.6
"""Share of the images that a step of concentration uses."""
CONCENTRATION_STEPS = 5
"""Steps of concentration, which follow."""
REJECTION_STEPS = 6
"""Steps of rejection with re-inclusion, which come last."""
WRONG_PROBABILITY = 0.01
"""Prior probability that an image is wrong."""
WRONG_RANGE_MM = 60.0
"""Width of the range in which a wrong image's errors may lie. Larger errors are found as well; with
a wider range, a third of the images that slipped together would pass for noise."""
HALVINGS = 24
"""How often the bracket about a median is halved: to a ten-millionth of the largest value."""


@dataclass(frozen=True)
class ConsensusModel:
    """What it means that images agree; static.

    Attributes:
        blocks: the free unknowns.
        errors: each image's three errors, mm, at given unknowns; zeros for images masked out.
        propose: from (k, n) subset weights to k proposals (leading axis).
        isotropic: the three components share one SD.
        subset: images in a proposal's subset.
    """

    blocks: Blocks
    errors: Callable[[Parameters, Problem], Float[Array, "n 3"]]
    propose: Callable[[Problem, Float[Array, "k n"]], Parameters]
    isotropic: bool = False
    subset: int = SUBSET


def rigid_model(blocks: Blocks) -> ConsensusModel:
    """The calibration's own model; a delay only shifts X."""
    kept = tuple(name for name in blocks if name != "delay")
    return ConsensusModel(kept, depth_scaled_errors, partial(linear_proposals, blocks=kept))


def depth_scaled_errors(parameters: Parameters, problem: Problem) -> Float[Array, "n 3"]:
    """Lateral, range and elevational errors, mm, with the lateral ones of deep images scaled down.

    An array's lateral error grows with the range. Beyond the median range it is divided by the
    range over the median; otherwise images would stand out only because they are deep.
    """
    errors = measurement_residual(parameters, problem)
    # The range at nominal unknowns is close enough for this, and must not be differentiated.
    distance = measured_points(nominal(problem), problem)[:, 1]
    beyond = jnp.maximum(distance / quantile(distance, problem.mask, 0.5), 1.0)
    return errors.at[:, 0].divide(jnp.where(problem.mask > 0, beyond, 1.0))


def find_consensus(problem: Problem, model: ConsensusModel) -> Float[Array, " n"]:
    """Find the images that agree: 1 for them, 0 for the others and for images masked out."""
    used = problem.mask
    subsets = subset_weights(used, model.subset)
    subsets = jnp.concatenate([used[None], subsets])
    proposed = model.propose(problem, subsets)

    def score(parameters: Parameters) -> Float[Array, ""]:
        scale = _medians(model.errors(parameters, problem), used, model)
        total = jnp.sum(jnp.log(jnp.maximum(scale, 1e-9)))
        return jnp.where(jnp.isfinite(total), total, jnp.inf)

    # With few images, a clean subset need not score best.
    count = int(np.clip(400 // used.shape[0], 6, 24))
    _, best = jax.lax.top_k(-jax.vmap(score)(proposed)[1:], count)
    # The first candidate takes all images as good; it competes with those that leave some out.
    chosen = jnp.concatenate([jnp.zeros(1, best.dtype), best + 1])
    everything = jnp.arange(count + 1) == 0
    keep, cost = jax.vmap(partial(_finish, problem=problem, model=model))(
        jax.tree.map(lambda leaf: leaf[chosen], proposed), subsets[chosen], everything
    )
    winner = jnp.argmin(cost)
    enough = (jnp.sum(used) >= FEWEST_TO_LEAVE_OUT) & jnp.isfinite(cost[winner])
    return jnp.where(enough, keep[winner], used)


def _finish(
    parameters: Parameters,
    subset: Float[Array, " n"],
    all_good: Bool[Array, ""],
    problem: Problem,
    model: ConsensusModel,
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Fit the subset, concentrate and reject; the images to keep, and the cost of keeping them."""
    used = problem.mask
    # Less than half of the images are no consensus.
    fewest = jnp.maximum(0.5 * jnp.sum(used), FEWEST_TO_LEAVE_OUT)

    def one_round(index: Array, state: tuple[Parameters, Array]) -> tuple[Parameters, Array]:
        parameters, weight = state
        errors, jacobian = linearise(parameters, problem, model)
        concentrating = index < SUBSET_STEPS + CONCENTRATION_STEPS
        basis = jnp.where(index <= SUBSET_STEPS + CONCENTRATION_STEPS, used, weight)
        sigma = _robust(errors, basis, model)
        leverage = _leverage(jacobian, sigma, basis)
        squared = jnp.sum((errors / sigma) ** 2, axis=1)
        nearest = used * (squared <= quantile(squared, used, CONCENTRATION))
        studentised = studentise(errors, leverage, sigma, basis)
        fits = used * ~stands_out(studentised, basis)
        # If fewer than ``fewest`` fit, go on with the images that stand out least.
        largest = jnp.max(jnp.abs(studentised), axis=1)
        least = used * (largest <= quantile(largest, used, fewest / jnp.sum(used)))
        fits = jnp.where(jnp.sum(fits) >= fewest, fits, least)
        weight = jnp.where(concentrating, nearest, fits)
        weight = jnp.where(index < SUBSET_STEPS, subset, weight)
        weight = jnp.where(all_good, used, weight)
        sigma = jnp.where(all_good, _efficient(errors, leverage, used, model)[0], sigma)
        return _step(parameters, errors, jacobian, sigma, weight, model), weight

    rounds = SUBSET_STEPS + CONCENTRATION_STEPS + REJECTION_STEPS
    parameters, keep = jax.lax.fori_loop(0, rounds, one_round, (parameters, used))
    errors, jacobian = linearise(parameters, problem, model)
    leverage = _leverage(jacobian, _robust(errors, keep, model), keep)
    sigma, freedom = _efficient(errors, leverage, keep, model)
    studentised = studentise(errors, leverage, sigma, keep)
    # For images in use: the cost of three Gaussian errors each, less the freedom of the fitted
    # unknowns. For an image left out: each of its errors is as predicted or may be anything.
    cost = jnp.sum(freedom * jnp.log(jnp.sqrt(2 * jnp.pi * jnp.e) * sigma))
    predicted = 0.5 * studentised**2 + jnp.log(jnp.sqrt(2 * jnp.pi * (1 + leverage)) * sigma)
    wrong = jnp.sum(jnp.minimum(predicted, jnp.log(WRONG_RANGE_MM)), axis=1)
    wrong = wrong - jnp.log(WRONG_PROBABILITY)
    cost = cost + jnp.sum(jnp.where((used > 0) & (keep == 0), wrong, 0.0))
    sound = (jnp.sum(keep) >= fewest) & jnp.all(jnp.isfinite(studentised))
    return keep, jnp.where(sound & jnp.isfinite(cost), cost, jnp.inf)


def studentised_errors(
    parameters: Parameters, problem: Problem, keep: Float[Array, " n"], model: ConsensusModel
) -> Float[Array, "n 3"]:
    """Every image's errors under the fit to the kept ones, in SDs; 0 for images masked out.

    The SDs are robust ones of the kept images, and the errors are corrected for leverage.

    Args:
        parameters: fitted to the kept images.
        problem: the data.
        keep: (n,) 1 for the images that were used for the fit.
        model: what the errors are.
    """
    errors, jacobian = linearise(parameters, problem, model)
    sigma = _robust(errors, keep, model)
    return studentise(errors, _leverage(jacobian, sigma, keep), sigma, keep)


def _robust(
    errors: Float[Array, "n 3"], weight: Float[Array, " n"], model: ConsensusModel
) -> Float[Array, " 3"]:
    """SDs of the components from the median magnitudes of the weighted images, mm."""
    medians = _medians(errors, weight, model)
    return robust_sd(medians, jnp.sum(weight), count_unknowns(model.blocks))


def _efficient(
    errors: Float[Array, "n 3"],
    leverage: Float[Array, "n 3"],
    weight: Float[Array, " n"],
    model: ConsensusModel,
) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
    """SDs of the components from mean squares of the weighted images, mm; degrees of freedom.

    A median of few images is itself uncertain; without gross errors these SDs are twice as certain.
    """
    squares = jnp.sum(jnp.where(weight[:, None] > 0, errors**2, 0.0), axis=0)
    freedom = jnp.sum(weight[:, None] * (1 - leverage), axis=0)
    if model.isotropic:
        squares, freedom = jnp.full(3, jnp.mean(squares)), jnp.full(3, jnp.mean(freedom))
    freedom = jnp.maximum(freedom, 0.1 * jnp.sum(weight))
    return with_gross_floor(jnp.sqrt(squares / freedom)), freedom


def linearise(
    parameters: Parameters, problem: Problem, model: ConsensusModel
) -> tuple[Float[Array, "n 3"], Float[Array, "p n 3"]]:
    """Every image's errors, and their derivatives by the unknowns."""

    def errors(tangent: Float[Array, " p"]) -> Float[Array, "n 3"]:
        return model.errors(retract(parameters, tangent, model.blocks), problem)

    zero = jnp.zeros(count_unknowns(model.blocks), problem.mask.dtype)
    value, push = jax.linearize(errors, zero)
    return value, jax.vmap(push)(jnp.eye(len(zero), dtype=zero.dtype))


def _information(
    jacobian: Float[Array, "p n 3"], sigma: Float[Array, " 3"], weight: Float[Array, " n"]
) -> Float[Array, "p p"]:
    weighted = jnp.where(weight[:, None] > 0, jacobian / sigma**2, 0.0)
    return jnp.einsum("anm,bnm->ab", jnp.where(weight[:, None] > 0, jacobian, 0.0), weighted)


def _step(
    parameters: Parameters,
    errors: Float[Array, "n 3"],
    jacobian: Float[Array, "p n 3"],
    sigma: Float[Array, " 3"],
    weight: Float[Array, " n"],
    model: ConsensusModel,
) -> Parameters:
    """A lightly damped Gauss-Newton step on the weighted images."""
    matrix = _information(jacobian, sigma, weight)
    gradient = jnp.einsum(
        "anm,nm->a", jacobian, jnp.where(weight[:, None] > 0, errors / sigma**2, 0.0)
    )
    diagonal = jnp.diagonal(matrix)
    step = dense.solve_symmetric(matrix + jnp.diag(1e-4 * diagonal), gradient, diagonal)
    return retract(parameters, -step, model.blocks)


def _leverage(
    jacobian: Float[Array, "p n 3"], sigma: Float[Array, " 3"], weight: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    matrix = _information(jacobian, sigma, weight)
    inverse = dense.inverse_symmetric(matrix, jnp.diagonal(matrix))
    whitened = jacobian / sigma
    return jnp.einsum("anm,ab,bnm->nm", whitened, inverse, whitened)


def _medians(
    errors: Float[Array, "n 3"], weight: Float[Array, " n"], model: ConsensusModel
) -> Float[Array, " 3"]:
    """Median magnitude of each component over the weighted images, mm."""
    if model.isotropic:
        three = jnp.repeat(weight, 3)
        return jnp.full(3, quantile(jnp.abs(errors).ravel(), three, 0.5))
    return jax.vmap(quantile, (1, None, None))(jnp.abs(errors), weight, 0.5)


@jax.custom_jvp
def quantile(
    values: Float[Array, " n"], weight: Float[Array, " n"], share: float | Float[Array, ""]
) -> Float[Array, ""]:
    """The least value that at least ``share`` of the weight does not exceed, by bisection.

    Sorting many short rows is slow on every backend; counting is not. NaN counts as infinite. The
    derivative is that of this value; bisection alone would have the derivative of the largest one.
    """
    values = jnp.where(jnp.isnan(values), jnp.inf, values)
    wanted = share * jnp.sum(weight)
    finite = jnp.where((weight > 0) & jnp.isfinite(values), values, 0.0)
    # Geometric steps first: the answer may be orders of magnitude below the largest value.
    high = jnp.max(finite)

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = jnp.where(low > 1e-3 * high, 0.5 * (low + high), 0.03 * high)
        enough = jnp.sum(weight * (values <= middle)) >= wanted
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    found = jax.lax.fori_loop(0, HALVINGS, halve, (jnp.zeros_like(high), high))[1]
    return jnp.where(jnp.sum(weight * (values <= high)) >= wanted, found, jnp.inf)


@quantile.defjvp
@in_standard_promotion
def _quantile_jvp(primals: tuple, tangents: tuple) -> tuple:
    values, weight, _ = primals
    found = quantile(*primals)
    counted = (weight > 0) & jnp.isfinite(values)
    away = jnp.where(counted, jnp.abs(values - found), jnp.inf)
    return found, tangents[0][jnp.argmin(away)]
