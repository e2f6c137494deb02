"""The estimator behind ``--method joint``: nothing to choose, and it says what it chose.

What the plain self-tuned fit (:mod:`jaxcal.solvers.variance`) takes for granted is asked of the
data here: that the offsets are Gaussian, that their mean is zero, and that errors are alike in all
images. All of it matters because lateral position and range leave rotation about the lateral axis
open, and only the offsets' law closes it: the edges of bounded offsets tell X twice as well as
their SD does, heavy tails must not pull it, and a mean that is denied bends it.

1. *REML* tunes the SDs of lateral position, range and offset, with Gaussian offsets of mean zero.
2. *Evidence* (:mod:`jaxcal.solvers.evidence`). The same with a mean b ~ N(0, (2 sigma_y)^2) and,
   where the images came with covariances of their own, with those, up to one factor. A mean is
   believed where it makes the data nine times as probable; of own covariances and common SDs, the
   more probable are.
3. *Laws* (:mod:`jaxcal.model.shapes`). Linearised there, everything is Gaussian but the offsets'
   law. Expectation propagation gives X under each law of :data:`SHAPES` and how probable the data
   are under it: uniform, a bell with edges, Gaussian, Student's t4; the uniform one with three SDs
   about REML's, which knows the edges to a few per cent only, and it is they that matter. Where an
   image came with a bound on its offset, its law is cut there.
4. *Average*. X, target and mean are the laws' averages, weighted by their probability; so is the
   covariance, with the spread between the laws added. A law under which the propagation does not
   settle (its edges exclude some image) has weight zero.

This is the readable form, and the one whose derivatives are taken; batches of plain problems take
the same steps side by side (:mod:`jaxcal.solvers.fused_auto`), several times faster. Each is a
fixed number of array operations, so gradients go through (REML's by the implicit function
theorem). With fewer than eight used images, with given SDs, or where no law settles, the plain
Gaussian answer stands, and the result says so.

What to expect. The answer is nearly the posterior mean over these laws, so it is better than
conventional calibration on average, whatever the offsets' law; in a single trial it can be worse.
Small samples do not tell the laws apart: there the average stays near the Gaussian answer.
The cut at an image's bound is taken at the mean that step 2 found, and intervals take the tuned
SDs for known, but for Student's factor (:mod:`jaxcal.intervals`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.model.parameters import Blocks, Parameters, retract
from jaxcal.model.priors import AbstractSelfTuned, Gaussian, covariance_shape
from jaxcal.model.shapes import FAMILIES, Family, Shape
from jaxcal.problem import Problem
from jaxcal.solvers.evidence import Tuned, tune
from jaxcal.solvers.expectation_propagation import propagate
from jaxcal.solvers.variance import MINIMUM_SELF_TUNING

UNIFORM: tuple[Shape, ...] = tuple(
    Shape("uniform", stretch, 1 / 12) for stretch in (0.96, 1.03, 1.12)
)
"""Flat between edges that are a little uncertain."""

SHAPES: tuple[Shape, ...] = (
    *UNIFORM,
    Shape("bell", 1.05, 1 / 4),
    Shape("gaussian", 1.0, 1 / 4),
    Shape("student", 1.10, 1 / 4),
)
"""The laws that are weighed, a quarter for each family. More of them gain nothing."""

LOG_ODDS_OF_MEAN = float(np.log(9.0))
"""How much more probable the data must be with a mean: it is one more thing to be wrong about."""

LARGEST_CHANGE = 0.05
"""A law counts where the last sweep moved no unknown by more than this many SDs."""


class OffsetLaw(eqx.Module):
    """What was found out about the offsets and the noise.

    Attributes:
        probability: of each family of :data:`jaxcal.model.shapes.FAMILIES`.
        mean: of the offsets, mm; 0 where none is believed.
        mean_sd: its standard deviation, mm; 0 likewise.
        has_mean: the data ask for a mean.
        own_covariances: the images' own covariances describe the errors better than common SDs.
        log_odds_mean: ln of how much more probable the data are with a mean than without.
        log_odds_own: ln of how much more probable they are with own covariances; 0 where there are
            none.
        weighed: the laws were weighed; otherwise the plain Gaussian answer stands.
    """

    probability: Float[Array, "*batch families"]
    mean: Float[Array, "*batch"]
    mean_sd: Float[Array, "*batch"]
    has_mean: Bool[Array, "*batch"]
    own_covariances: Bool[Array, "*batch"]
    log_odds_mean: Float[Array, "*batch"]
    log_odds_own: Float[Array, "*batch"]
    weighed: Bool[Array, "*batch"]


class Averaged(eqx.Module):
    """The estimate over all laws.

    Attributes:
        parameters: the unknowns.
        belief: the noise model in use, with its tuned SDs.
        covariance: of the unknowns' tangent.
        elevation_sd: of every image's offset, mm.
        law: what was found out.
    """

    parameters: Parameters
    belief: AbstractSelfTuned
    covariance: Float[Array, "p p"]
    elevation_sd: Float[Array, " n"]
    law: OffsetLaw


def average_over_laws(
    parameters: Parameters,
    belief: AbstractSelfTuned,
    problem: Problem,
    blocks: Blocks,
    shapes: Sequence[Shape] = SHAPES,
) -> Averaged:
    """Weigh offset means, noise models and laws of the offsets, and average the answers.

    Args:
        parameters: the self-tuned Gaussian solution.
        belief: its belief, with the tuned SDs.
        problem: one problem; ``max_elevation`` cuts the laws.
        blocks: the free unknowns.
        shapes: the laws to weigh.
    """
    models = candidates(belief, problem)
    tuned = jax.vmap(lambda b, mean, tied: tune(parameters, b, problem, blocks, mean, tied))(
        models.belief, models.with_mean, models.tied
    )
    evidence = jnp.where(jnp.isfinite(tuned.log_evidence), tuned.log_evidence, -jnp.inf)
    # One more SD that is tuned costs half the log of the number of images.
    used = jnp.sum(problem.mask)
    pairs = (evidence + 0.5 * models.tied * jnp.log(used)).reshape(-1, 2)
    chosen = jnp.argmax(pairs - jnp.asarray([0.0, LOG_ODDS_OF_MEAN]))
    best: Tuned = jax.tree.map(lambda leaf: leaf[chosen], tuned)
    used_belief = jax.tree.map(lambda leaf: leaf[chosen], models.belief).with_sigma(best.sigma)

    stretch = jnp.asarray([shape.stretch for shape in shapes], problem.mask.dtype)
    prior = jnp.asarray([shape.prior for shape in shapes], problem.mask.dtype)
    families: tuple[Family, ...] = tuple(shape.family for shape in shapes)
    found = propagate(best.linear, families, stretch * best.sigma[-1])
    weight, good = weights(found.log_evidence, found.change, prior)
    means = jnp.where(good[:, None], found.mean, 0.0)
    mean = weight @ means
    apart = jnp.where(good[:, None], means - mean, 0.0)
    within = jnp.where(good[:, None, None], found.covariance, 0.0)
    covariance = jnp.einsum("k,kpq->pq", weight, within)
    covariance = covariance + jnp.einsum("k,kp,kq->pq", weight, apart, apart)

    enough = (used >= MINIMUM_SELF_TUNING) & jnp.any(good)
    enough = enough & jnp.all(jnp.isfinite(mean))
    shared = covariance[:-1, :-1]
    along = best.linear.direction[:, :-1]
    variance = jnp.einsum("np,pq,nq->n", along, shared, along)
    moved = retract(best.parameters, mean[:-1], blocks)
    member = jnp.asarray([[family == name for family in families] for name in FAMILIES])
    has_mean = enough & (chosen % 2 == 1)
    own = jnp.asarray(False)
    log_odds_own = jnp.zeros((), problem.mask.dtype)
    if pairs.shape[0] > 1:
        own = enough & (chosen >= 2)
        log_odds_own = jnp.max(pairs[1]) - jnp.max(pairs[0])
    law = OffsetLaw(
        probability=member @ weight,
        mean=jnp.where(has_mean, best.mean + mean[-1], 0.0),
        mean_sd=jnp.where(has_mean, jnp.sqrt(jnp.maximum(covariance[-1, -1], 0.0)), 0.0),
        has_mean=has_mean,
        own_covariances=own,
        log_odds_mean=pairs[chosen // 2, 1] - pairs[chosen // 2, 0],
        log_odds_own=log_odds_own,
        weighed=enough,
    )

    def either(new: Array, old: Array) -> Array:
        return jnp.where(enough, new, old)

    return Averaged(
        parameters=jax.tree.map(either, moved, parameters),
        belief=used_belief.with_sigma(either(best.sigma, belief.sigma)),
        covariance=shared,
        elevation_sd=jnp.sqrt(jnp.where(problem.mask > 0, variance, jnp.nan)),
        law=law,
    )


def weights(
    log_evidence: Float[Array, "k ..."],
    change: Float[Array, "k ..."],
    prior: Float[Array, " k"],
) -> tuple[Array, Array]:
    """The laws' probabilities, and which of them count at all."""
    good = jnp.isfinite(log_evidence) & (change < LARGEST_CHANGE)
    prior = prior.reshape(-1, *(1,) * (log_evidence.ndim - 1))
    score = jnp.where(good, jnp.where(good, log_evidence, 0.0) + jnp.log(prior), -jnp.inf)
    # Where no law is good the weights must still be numbers: a lane's NaN poisons its gradient.
    score = jnp.where(jnp.any(good, axis=0), score, 0.0)
    return jax.nn.softmax(score, axis=0) * good, good


class Candidates(eqx.Module):
    """The noise models to compare, along a leading axis.

    Attributes:
        belief: each model, with SDs to start from.
        with_mean: 1 where the offsets may have a mean.
        tied: 1 where the images' own covariances fix the ratios of the measurements' SDs.
    """

    belief: AbstractSelfTuned
    with_mean: Float[Array, " m"]
    tied: Float[Array, " m"]


def candidates(belief: AbstractSelfTuned, problem: Problem) -> Candidates:
    """Common SDs and, where the images have them, own covariances; each without and with a mean."""
    dtype = problem.mask.dtype
    shape = covariance_shape(problem) if isinstance(belief, Gaussian) else None
    if shape is None or problem.covariance is None:
        twice = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), belief)
        return Candidates(twice, jnp.asarray([0.0, 1.0], dtype), jnp.zeros(2, dtype))
    same = jnp.broadcast_to(jnp.eye(2, dtype=dtype), shape.shape)
    variances = jnp.diagonal(problem.covariance, axis1=1, axis2=2)
    mean = problem.mask @ variances / jnp.sum(problem.mask)
    mean = jnp.where(jnp.all(mean > 0), mean, 1.0)
    # Own covariances count up to one factor, for a start that which explains both SDs on average.
    factor = jnp.mean(belief.sigma[:2] ** 2 / mean)
    sigma = jnp.sqrt(jnp.append(factor * mean, belief.sigma[2] ** 2))
    assert isinstance(belief, Gaussian)
    both = [
        replace(belief, covariance=same),
        replace(belief, covariance=shape, sigma=sigma),
    ]
    stacked = jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves), 2, axis=0), *both)
    return Candidates(
        stacked, jnp.asarray([0.0, 1.0, 0.0, 1.0], dtype), jnp.asarray([0.0, 0.0, 1.0, 1.0], dtype)
    )
