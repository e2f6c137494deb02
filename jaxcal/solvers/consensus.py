"""Which images agree with each other: gross outliers found before the solve, and left out of it.

A wrong echo, a wrong click or a slipped mount moves an image by tens of millimetres, and a third of
the images may be such. Least squares on all of them is then far from the truth and its residuals do
not tell the good from the bad, so the good ones are found by consensus:

1. *Proposals.* Many small subsets of the images, the same ones every time, are solved in closed
   form (a linear system of 12 unknowns each, from per-image moments that are formed once), and each
   is scored on all images by sum_k ln s_k, with s_k the median magnitude of error component k. Up
   to half of the images may be anything without spoiling a median.
2. *Concentration.* The best few take weighted Gauss-Newton steps on the 60 % of the images
   that fit them best, chosen anew each time.
3. *Rejection with re-inclusion.* From the best of those: SDs from the median of the images in use,
   a step on them, and a test of *every* image, so that one left out too early returns.

The errors are those of the joint method (lateral position, range, elevational offset), each
with its own SD. An image stands out where a component is more than ``CUT`` SDs off, its own
leverage allowed for. All of it is a fixed number of array operations.

References: Rousseeuw and Van Driessen 2006 (FAST-LTS: proposals and concentration); Fischler and
Bolles 1981 (RANSAC); Huber and Ronchetti 2009 (hard rejection as reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.model.parameters import Blocks, Parameters, retract, size
from jaxcal.model.residuals import measured_points, measurement_residual
from jaxcal.problem import Problem
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers import dense

PROPOSALS = 128
SUBSET = 6
"""Images in a proposal's subset: four determine the linear system, two more steady it."""
FINALISTS = 4
CONCENTRATION = 0.6
CONCENTRATION_STEPS = 6
REJECTION_STEPS = 10
CUT = 6.0
"""SDs beyond which an image stands out. Heavy tails (Student's t4) put 0.3 % of images there."""
FEW_IMAGES = 30
"""With fewer images in use, n, the limit is wider by sqrt(30 / n): 9.5 SDs for a dozen."""
SEED = 20261121
FEWEST_IMAGES = 8
"""With fewer used images nothing is left out: they cannot outvote one another."""
MAD = 1.4826
"""SD of a normal law over the median of its magnitude."""
RELATIVE_FLOOR = 0.02
HALVINGS = 24
"""Of the bracket about a median: a ten-millionth of the largest value."""

Errors = Callable[[Parameters, Problem], Float[Array, "n 3"]]
Propose = Callable[[Problem, Float[Array, "k n"]], Parameters]


@dataclass(frozen=True)
class Model:
    """What agreeing means; static.

    Attributes:
        blocks: the free unknowns.
        errors: each image's three errors, mm, at given unknowns; the mask is ignored.
        propose: from (k, n) subset weights to k proposals (leading axis).
        isotropic: the three components share one SD.
        subset: images in a proposal's subset.
    """

    blocks: Blocks
    errors: Errors
    propose: Propose
    isotropic: bool = False
    subset: int = SUBSET


class Consensus(eqx.Module):
    """Which images agree.

    Attributes:
        keep: (n,) 1 for used images that agree, 0 otherwise.
        parameters: the unknowns that they agree on, to a few Gauss-Newton steps.
        sigma: (3,) robust SDs of the components, mm.
        departure: (n, 3) errors in SDs, leverage allowed for; 0 where not used at all.
    """

    keep: Float[Array, " n"]
    parameters: Parameters
    sigma: Float[Array, 3]
    departure: Float[Array, "n 3"]


def rigid_model(blocks: Blocks) -> Model:
    """The calibration's own: X and the target (and pixel scales where they are free)."""
    kept = tuple(name for name in blocks if name in ("translation", "rotation", "point", "scale"))
    return Model(kept, steadied_errors, partial(linear_proposals, scaled="scale" in kept))


def steadied_errors(parameters: Parameters, problem: Problem) -> Float[Array, "n 3"]:
    """Lateral, range and elevational errors, the lateral ones less weighty where it is deep, mm.

    An array's lateral error grows with the range: below the median range it is divided by what the
    range exceeds that by, or deep images would stand out for no other reason.
    """
    errors = measurement_residual(parameters, problem)
    # The unknowns' own effect on the range is beside the point, and it must not be differentiated.
    distance = measured_points(_nominal(problem), problem)[:, 1]
    beyond = jnp.maximum(distance / quantile(distance, problem.mask, 0.5), 1.0)
    return errors.at[:, 0].divide(jnp.where(problem.mask > 0, beyond, 1.0))


def find_consensus(problem: Problem, model: Model) -> Consensus:
    """Find the images that agree, and how far every image departs from them.

    Args:
        problem: one problem; images masked out stay out.
        model: what agreeing means.
    """
    used = problem.mask
    subsets = subset_weights(used, model.subset)
    proposed = model.propose(problem, subsets)

    def score(parameters: Parameters) -> Float[Array, ""]:
        scale = _medians(model.errors(parameters, problem), used, model)
        total = jnp.sum(jnp.log(jnp.maximum(scale, 1e-9)))
        return jnp.where(jnp.isfinite(total), total, jnp.inf)

    scores = jax.vmap(score)(proposed)
    _, best = jax.lax.top_k(-scores, FINALISTS)
    finalists = jax.tree.map(lambda leaf: leaf[best], proposed)

    def concentrate(_: Array, parameters: Parameters) -> Parameters:
        errors, jacobian = _linearise(parameters, problem, model)
        sigma = _with_floor(MAD * _medians(errors, used, model))
        squared = jnp.sum((errors / sigma) ** 2, axis=1)
        nearest = quantile(squared, used, CONCENTRATION)
        weight = used * (squared <= nearest)
        return _step(parameters, errors, jacobian, sigma, weight, model)

    def finish(parameters: Parameters) -> tuple[Parameters, Array]:
        done = jax.lax.fori_loop(0, CONCENTRATION_STEPS, concentrate, parameters)
        return done, score(done)

    finished, scores = jax.vmap(finish)(finalists)
    winner = jnp.argmin(scores)
    parameters = jax.tree.map(lambda leaf: leaf[winner], finished)
    return _reject(parameters, problem, model)


def _reject(parameters: Parameters, problem: Problem, model: Model) -> Consensus:
    """Alternate between steps on the images in use and testing all of them."""
    used = problem.mask
    fewest = jnp.maximum(0.5 * jnp.sum(used), FEWEST_IMAGES)

    def one_round(_: Array, state: tuple[Parameters, Array]) -> tuple[Parameters, Array]:
        parameters, weight = state
        errors, jacobian = _linearise(parameters, problem, model)
        sigma, departure = _depart(errors, jacobian, weight, model)
        fits = used * (1 - stands_out(departure, weight))
        # A consensus of less than half is none.
        fits = jnp.where(jnp.sum(fits) >= fewest, fits, weight)
        return _step(parameters, errors, jacobian, sigma, fits, model), fits

    parameters, keep = jax.lax.fori_loop(0, REJECTION_STEPS, one_round, (parameters, used))
    sigma, departure = departures(parameters, problem, keep, model)
    enough = (jnp.sum(used) >= FEWEST_IMAGES) & jnp.all(jnp.isfinite(departure))
    return Consensus(jnp.where(enough, keep, used), parameters, sigma, departure)


def departures(
    parameters: Parameters, problem: Problem, keep: Float[Array, " n"], model: Model
) -> tuple[Float[Array, 3], Float[Array, "n 3"]]:
    """How far every image is from what the kept ones say.

    Args:
        parameters: fitted to the kept images.
        problem: the data.
        keep: (n,) 1 for the images that were used for the fit.
        model: what the errors are.

    Returns:
        sigma: (3,) robust SDs of the kept images' errors, mm.
        departure: (n, 3) errors in SDs, leverage allowed for; 0 for images masked out.
    """
    errors, jacobian = _linearise(parameters, problem, model)
    return _depart(errors, jacobian, keep, model)


def stands_out(departure: Float[Array, "n 3"], keep: Float[Array, " n"]) -> Float[Array, " n"]:
    """1 where an image departs by more than the images in use can explain.

    A median of a dozen images is itself uncertain: with few of them the limit is wider.
    """
    limit = CUT * jnp.sqrt(jnp.maximum(FEW_IMAGES / jnp.maximum(jnp.sum(keep), 1.0), 1.0))
    return jnp.any(jnp.abs(departure) > limit, axis=1).astype(keep.dtype)


def _depart(
    errors: Float[Array, "n 3"],
    jacobian: Float[Array, "p n 3"],
    weight: Float[Array, " n"],
    model: Model,
) -> tuple[Float[Array, 3], Float[Array, "n 3"]]:
    # The unknowns' degrees of freedom are shared equally by the three components.
    freedom = jnp.maximum(1 - size(model.blocks) / (3 * jnp.sum(weight)), 0.1)
    sigma = _with_floor(MAD * _medians(errors, weight, model) / jnp.sqrt(freedom))
    leverage = _leverage(jacobian, sigma, weight)
    # An image in use pulls the fit towards itself; one that is not, is predicted by the fit.
    inside = errors / jnp.sqrt(jnp.maximum(1 - leverage, 0.05))
    outside = errors / jnp.sqrt(1 + leverage)
    return sigma, jnp.where(weight[:, None] > 0, inside, outside) / sigma


def subset_weights(used: Float[Array, " n"], count: int) -> Float[Array, "k n"]:
    """Weights (0 or 1) of the proposals' subsets, each of ``count`` used images.

    The draws are constants of the program: the same problem gives the same answer everywhere.
    """
    draws = np.random.default_rng(SEED).random((PROPOSALS, used.shape[0]))
    order = jnp.where(used > 0, jnp.asarray(draws, used.dtype), 2.0)

    def pick(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        order, chosen = state
        here = order == jnp.min(order, axis=1, keepdims=True)
        return jnp.where(here, 3.0, order), jnp.where(here, 1.0, chosen)

    chosen = jax.lax.fori_loop(0, count, pick, (order, jnp.zeros_like(order)))[1]
    return chosen * used


def linear_proposals(problem: Problem, subsets: Float[Array, "k n"], *, scaled: bool) -> Parameters:
    """Solve the start's linear system (see :mod:`jaxcal.solvers.initial`) for every subset at once.

    Args:
        problem: one problem.
        subsets: (k, n) weights.
        scaled: the pixel scales are unknown and found as well.

    Returns:
        Parameters with a leading axis k.
    """
    rotations, translations = problem.poses[:, :3, :3], problem.poses[:, :3, 3]
    used = problem.mask
    total = jnp.sum(used)
    nominal = _nominal(problem)
    points = jnp.where(used[:, None] > 0, measured_points(nominal, problem), 0.0)
    mean = jnp.sum(used[:, None] * points, axis=0) / total
    length = jnp.sqrt(jnp.sum(used[:, None] * (points - mean) ** 2) / total)
    length = jnp.where(length > 0, length, 1.0)
    deviation = (points - mean) / length
    centre = jnp.sum(used[:, None] * translations, axis=0) / total
    eye = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype), rotations.shape)
    rhs = (centre - translations) / length
    rows = jnp.concatenate(
        [deviation[:, :1, None] * rotations, deviation[:, 1:, None] * rotations, rotations, -eye,
         rhs[..., None]], axis=2,
    )  # fmt: skip
    rows = jnp.where(used[:, None, None] > 0, rows, 0.0)
    # In units of the points' spread all 12 unknowns and all moments are of order one.
    moments = jnp.einsum("nia,nib->nab", rows, rows).reshape(len(used), -1)
    systems = (subsets @ moments).reshape(-1, 13, 13)

    def solve(system: Float[Array, "13 13"]) -> Parameters:
        ridge = 1e3 * jnp.finfo(system.dtype).eps * jnp.trace(system) / 13
        matrix = system[:12, :12] + ridge * jnp.eye(12, dtype=system.dtype)
        columns = dense.solve_positive(matrix, system[:12, 12:])[:6, 0]
        first, third = columns[:3], columns[3:]
        sizes = jnp.stack([jnp.sqrt(jnp.sum(first**2)), jnp.sqrt(jnp.sum(third**2))])
        a, b = first / sizes[0], third / sizes[1]
        plus, minus = a + b, a - b
        plus = plus / jnp.sqrt(jnp.sum(plus**2))
        minus = minus / jnp.sqrt(jnp.sum(minus**2))
        lateral, axial = (plus + minus) / jnp.sqrt(2.0), (plus - minus) / jnp.sqrt(2.0)
        if scaled:
            lateral, axial = sizes[0] * lateral, sizes[1] * axial
        known = jnp.concatenate([lateral, axial])
        rest = dense.solve_positive(
            matrix[6:, 6:], (system[6:12, 12] - system[6:12, :6] @ known)[:, None]
        )[:, 0]
        rotation = jnp.stack(
            [lateral / jnp.sqrt(jnp.sum(lateral**2)),
             jnp.cross(axial, lateral) / jnp.sqrt(jnp.sum(axial**2) * jnp.sum(lateral**2)),
             axial / jnp.sqrt(jnp.sum(axial**2))], axis=1,
        )  # fmt: skip
        translation = length * rest[:3] - mean[0] * lateral - mean[1] * axial
        scale = sizes if scaled else jnp.ones_like(sizes)
        # A pixel's row 0 need not be the face: the face's range is not scaled.
        translation = (
            translation
            + jnp.where(jnp.asarray(scaled), (scale[1] - 1) * problem.face_offset, 0.0)
            * rotation[:, 2]
        )
        return Parameters.of(rotation, translation, length * rest[3:] + centre, scale)

    return jax.vmap(solve)(systems)


def _nominal(problem: Problem) -> Parameters:
    zero = jnp.zeros(3, problem.mask.dtype)
    return Parameters.of(jnp.eye(3, dtype=zero.dtype), zero, zero)


def _linearise(
    parameters: Parameters, problem: Problem, model: Model
) -> tuple[Float[Array, "n 3"], Float[Array, "p n 3"]]:
    def errors(tangent: Float[Array, " p"]) -> Float[Array, "n 3"]:
        return model.errors(retract(parameters, tangent, model.blocks), problem)

    zero = jnp.zeros(size(model.blocks), problem.mask.dtype)
    value, push = jax.linearize(errors, zero)
    return value, jax.vmap(push)(jnp.eye(len(zero), dtype=zero.dtype))


def _information(
    jacobian: Float[Array, "p n 3"], sigma: Float[Array, 3], weight: Float[Array, " n"]
) -> Float[Array, "p p"]:
    weighted = jnp.where(weight[:, None] > 0, jacobian / sigma**2, 0.0)
    return jnp.einsum("anm,bnm->ab", jnp.where(weight[:, None] > 0, jacobian, 0.0), weighted)


def _step(
    parameters: Parameters,
    errors: Float[Array, "n 3"],
    jacobian: Float[Array, "p n 3"],
    sigma: Float[Array, 3],
    weight: Float[Array, " n"],
    model: Model,
) -> Parameters:
    """A lightly damped Gauss-Newton step on the weighted images."""
    matrix = _information(jacobian, sigma, weight)
    gradient = jnp.einsum(
        "anm,nm->a", jacobian, jnp.where(weight[:, None] > 0, errors / sigma**2, 0.0)
    )
    diagonal = jnp.diagonal(matrix)
    step = arrows.solve_symmetric(matrix + jnp.diag(1e-4 * diagonal), gradient, diagonal)
    return retract(parameters, -step, model.blocks)


def _leverage(
    jacobian: Float[Array, "p n 3"], sigma: Float[Array, 3], weight: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    matrix = _information(jacobian, sigma, weight)
    inverse = arrows.inverse_symmetric(matrix, jnp.diagonal(matrix))
    whitened = jacobian / sigma
    return jnp.einsum("anm,ab,bnm->nm", whitened, inverse, whitened)


def _medians(
    errors: Float[Array, "n 3"], weight: Float[Array, " n"], model: Model
) -> Float[Array, 3]:
    """Median magnitude of each component over the weighted images, mm."""
    if model.isotropic:
        three = jnp.repeat(weight, 3)
        return jnp.full(3, quantile(jnp.abs(errors).ravel(), three, 0.5))
    return jax.vmap(quantile, (1, None, None))(jnp.abs(errors), weight, 0.5)


def quantile(
    values: Float[Array, " n"], weight: Float[Array, " n"], share: float
) -> Float[Array, ""]:
    """The least value that at least ``share`` of the weight does not exceed, by bisection.

    Sorting many short rows is slow on every backend; counting is not. NaN counts as infinite.
    """
    values = jnp.where(jnp.isnan(values), jnp.inf, values)
    wanted = share * jnp.sum(weight)
    finite = jnp.where((weight > 0) & jnp.isfinite(values), values, 0.0)
    # Geometric steps first: the answer may be many orders below the largest.
    high = jnp.max(finite)

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = jnp.where(low > 1e-3 * high, 0.5 * (low + high), 0.03 * high)
        enough = jnp.sum(weight * (values <= middle)) >= wanted
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    found = jax.lax.fori_loop(0, HALVINGS, halve, (jnp.zeros_like(high), high))[1]
    return jnp.where(jnp.sum(weight * (values <= high)) >= wanted, found, jnp.inf)


def _with_floor(sigma: Float[Array, 3]) -> Float[Array, 3]:
    """No SD below a fiftieth of the largest: what departs by less is no gross error."""
    return jnp.maximum(sigma, jnp.maximum(RELATIVE_FLOOR * jnp.max(sigma), 1e-6))
