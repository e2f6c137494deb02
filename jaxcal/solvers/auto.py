"""The estimator behind ``--method joint``: nothing to choose, and it says what it chose.

What the plain self-tuned fit (:mod:`jaxcal.solvers.variance`) takes for granted is asked of the
data here: that the offsets are Gaussian, that their mean is zero, and that errors are alike in all
images. All of it matters because lateral position and range leave rotation about the lateral axis
open, and only the offsets' law closes it: the edges of bounded offsets tell X twice as well as
their SD does, heavy tails must not pull it, and a mean that is denied bends it.

1. *REML* tunes the SDs of lateral position, range and offset, with Gaussian offsets of mean zero.
2. *Evidence* (:mod:`jaxcal.solvers.evidence`). The same with a mean b ~ N(0, (2 sigma_y)^2) and,
   where the images came with covariances of their own, with those, up to one factor. A mean is
   believed where it makes the data nine times as probable, with Gaussian offsets and, as their
   beliefs about b tell, under the laws of step 3 together; of own covariances and common SDs, the
   more probable are.
3. *Laws* (:mod:`jaxcal.model.shapes`). Linearised there, everything is Gaussian but the offsets'
   law. Expectation propagation gives X under each law of :data:`SHAPES` and how probable the data
   are under it: uniform, a bell with edges, Gaussian, Student's t4; the uniform one with five SDs
   about REML's, which knows the edges to a few per cent only, and it is they that matter. Where an
   image came with a bound on its offset, its law is cut there.
4. *Median*. X, target and mean are the geometric median of the laws' answers, weighted by their
   probability; the covariance is the laws' average, with their spread about that answer added.
   A law under which the propagation does not settle (its edges exclude some image) has weight zero.

This is the readable form, and the one whose derivatives are taken; batches of plain problems take
the same steps side by side (:mod:`jaxcal.solvers.fused_auto`), several times faster. Each is a
fixed number of array operations, so gradients go through (REML's by the implicit function
theorem). With fewer than eight used images, with given SDs, or where no law settles, the plain
Gaussian answer stands, and the result says so.

What to expect. The answer is nearly the posterior median over these laws, so it is better than
conventional calibration on average, whatever the offsets' law; in a single trial it can be worse.
Small samples do not tell the laws apart: there the answer stays near the Gaussian one.
The cut at an image's bound is taken at the mean that step 2 found, and intervals take the tuned
SDs for known, but for Student's factor (:mod:`jaxcal.diagnostics.intervals`).
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
from jaxcal.model.shapes import FAMILIES, Shape
from jaxcal.problem import Problem
from jaxcal.solvers.evidence import MEAN_SD, Tuned, tune
from jaxcal.solvers.expectation_propagation import Linear, propagate
from jaxcal.solvers.variance import MINIMUM_SELF_TUNING

UNIFORM: tuple[Shape, ...] = tuple(
    Shape("uniform", float(np.exp(0.14 - 0.055 * k)), 0.08) for k in range(5)
)
"""Flat between edges that are a little uncertain, in even steps of ln SD, widest first."""

SHAPES: tuple[Shape, ...] = (
    *UNIFORM,
    Shape("bell", 1.05, 1 / 5),
    Shape("gaussian", 1.0, 1 / 5),
    Shape("student", 1.10, 1 / 5),
)
"""The laws that are weighed: a fifth for each family, two for the uniform one.

With equal shares the answer is farthest from the Bayes limit where offsets are uniform; a larger
one of the uniform laws is paid for where they are triangular, and by few images.
"""

LOG_ODDS_OF_MEAN = float(np.log(9.0))
"""How much more probable the data must be with a mean: it is one more thing to be wrong about."""

LARGEST_CHANGE = 0.4
"""A law counts where the last sweep moved no unknown by more than this many SDs.

Its evidence is stationary in the sites, and so nearly right before its mean is; the laws that do
not settle at all are the ones to leave out."""

MEDIAN_STEPS = 12
"""Weiszfeld's steps to the laws' median."""


class OffsetLaw(eqx.Module):
    """What was found out about the offsets and the noise.

    Attributes:
        probability: of each family of :data:`jaxcal.model.shapes.FAMILIES`.
        mean: of the offsets, mm; 0 where none is believed.
        mean_sd: its standard deviation, mm; 0 likewise.
        has_mean: the data ask for a mean.
        own_covariances: the images' own covariances describe the errors better than common SDs.
        log_odds_mean: ln of how much more probable the data are with a mean than without: with
            Gaussian offsets, or where those ask for one and the laws together less, under these.
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
    asked = chosen % 2 == 1
    weighed = weigh(best.linear, best.sigma[-1], shapes, best.mean, asked)
    mean, covariance = weighed.mean, weighed.covariance
    gaussian = pairs[chosen // 2, 1] - pairs[chosen // 2, 0]

    enough = (used >= MINIMUM_SELF_TUNING) & weighed.settled
    enough = enough & jnp.all(jnp.isfinite(mean))
    shared = covariance[:-1, :-1]
    along = best.linear.direction[:, :-1]
    variance = jnp.einsum("np,pq,nq->n", along, shared, along)
    moved = retract(best.parameters, mean[:-1], blocks)
    member = jnp.asarray([[shape.family == name for shape in shapes] for name in FAMILIES])
    has_mean = enough & asked & jnp.logical_not(weighed.denied)
    own = jnp.asarray(False)
    log_odds_own = jnp.zeros((), problem.mask.dtype)
    if pairs.shape[0] > 1:
        own = enough & (chosen >= 2)
        log_odds_own = jnp.max(pairs[1]) - jnp.max(pairs[0])
    law = OffsetLaw(
        probability=member @ weighed.weight,
        mean=jnp.where(has_mean, best.mean + mean[-1], 0.0),
        mean_sd=jnp.where(has_mean, jnp.sqrt(jnp.maximum(covariance[-1, -1], 0.0)), 0.0),
        has_mean=has_mean,
        own_covariances=own,
        # fmin: where no law settles, the Gaussian's odds stand.
        log_odds_mean=jnp.where(asked, jnp.fmin(gaussian, weighed.log_odds), gaussian),
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


class Weighed(eqx.Module):
    """What the laws say together, linearised.

    Attributes:
        mean: of the unknowns: the laws' median.
        covariance: about it.
        weight: the laws' probabilities.
        settled: at least one of them counts.
        log_odds: ln of how much more probable they make the data with a mean of the offsets.
        denied: a mean was asked for, and all laws together do not believe in it.
    """

    mean: Float[Array, " p"]
    covariance: Float[Array, "p p"]
    weight: Float[Array, " k"]
    settled: Bool[Array, ""]
    log_odds: Float[Array, ""]
    denied: Bool[Array, ""]


def weigh(
    linear: Linear,
    sd: Float[Array, ""],
    shapes: Sequence[Shape],
    mean: Float[Array, ""],
    asked: Bool[Array, ""],
) -> Weighed:
    """Weigh the laws on a linearised problem.

    A law with edges says of the mean b what a Gaussian does not see, so where the Gaussian asks for
    one, all laws together have to agree. That needs no second propagation: the evidence with b over
    that without is the density of b at zero before the data over that after (Savage and Dickey),
    and where the laws deny the mean, their beliefs are conditioned on b = 0.

    Args:
        linear: the problem; b is the last unknown.
        sd: the offsets' SD that REML found, mm.
        shapes: the laws.
        mean: b where the problem is linearised, mm.
        asked: the Gaussian believes in a mean.

    Reference: Dickey 1971.
    """
    stretch = jnp.asarray([shape.stretch for shape in shapes], sd.dtype)
    prior = jnp.asarray([shape.prior for shape in shapes], sd.dtype)
    found = propagate(linear, tuple(shape.family for shape in shapes), stretch * sd)
    weight, good = weights(found.log_evidence, found.change, prior)
    means = jnp.where(good[:, None], found.mean, 0.0)
    within = jnp.where(good[:, None, None], found.covariance, jnp.eye(found.mean.shape[1]))

    gain, pull = without_mean(means[:, -1] + mean, within[:, -1, -1], sd)
    log_odds = odds_of_mean(found.log_evidence, gain, good, prior)
    denied = asked & jnp.logical_not(log_odds > LOG_ODDS_OF_MEAN)
    fewer, _ = weights(found.log_evidence - gain, found.change, prior)
    along = within[:, -1]
    conditioned = within - along[:, :, None] * along[:, None] / within[:, -1, -1, None, None]
    means = jnp.where(denied, means - along * pull[:, None], means)
    within = jnp.where(denied, conditioned, within)
    weight = jnp.where(denied, fewer, weight)

    squares = linear.direction.T @ (linear.used[:, None] * linear.direction)
    spread = jnp.einsum("pq,kpq->k", squares, within)
    answer = means.T @ median(means.T, spread, weight, squares)
    off = means - answer
    covariance = jnp.einsum("k,kpq->pq", weight, within)
    covariance = covariance + jnp.einsum("k,kp,kq->pq", weight, off, off)
    return Weighed(answer, covariance, weight, jnp.any(good), log_odds, denied)


def without_mean(off: Array, variance: Array, sd: Array) -> tuple[Array, Array]:
    """What a belief about the offsets' mean b says of b = 0.

    Args:
        off: expectation of b, mm.
        variance: of b, mm^2.
        sd: the offsets' SD, mm.

    Returns:
        Log of the evidence with b over that without, and by how many covariances with b (1/mm) the
        other unknowns give way where b is held at zero.
    """
    pull = off / variance
    return 0.5 * (jnp.log(variance) - 2 * jnp.log(MEAN_SD * sd) + off * pull), pull


def median(
    means: Float[Array, "p k ..."],
    spread: Float[Array, "k ..."],
    weight: Float[Array, "k ..."],
    squares: Float[Array, "p p ..."],
) -> Float[Array, "k ..."]:
    """Shares of the laws' answers in their geometric median.

    Mean RP is the average of a distance, not of its square, and so the answer is where the expected
    distance is least: between laws that disagree that is nearer to the more probable one than their
    mean is. Distance is that between the images' offsets, all together; that of x from an answer
    N(m, C), averaged over the answer, is near (|x - m|^2 + 2/pi tr(C H))^1/2, which is exact at
    x = m for one unknown, and far away.

    Args:
        means: the laws' answers m.
        spread: tr(C H) of each.
        weight: the laws' probabilities.
        squares: H = sum of h_i h_i', the metric.

    Reference: Weiszfeld 1937.
    """
    within = (2 / np.pi) * spread
    tiny = jnp.finfo(weight.dtype).tiny

    def once(_: Array, share: Array) -> Array:
        off = means - jnp.sum(share * means, axis=1, keepdims=True)
        # H (p, p) times off (p, k), summed against off.
        length = jnp.sum(off * jnp.sum(squares[:, :, None] * off, axis=1), axis=0)
        pull = weight / jnp.sqrt(jnp.maximum(jnp.maximum(length, 0.0) + within, tiny))
        whole = jnp.sum(pull, axis=0)
        return pull / jnp.where(whole > 0, whole, 1.0)

    return jax.lax.fori_loop(0, MEDIAN_STEPS, once, weight)


def odds_of_mean(
    log_evidence: Float[Array, "k ..."],
    gain: Float[Array, "k ..."],
    good: Bool[Array, "k ..."],
    prior: Float[Array, " k"],
) -> Array:
    """Log of how much more probable all laws together make the data with a mean than without.

    Args:
        log_evidence: with one.
        gain: how much less each law's is without.
        good: laws that count; NaN where none does.
        prior: their probabilities.
    """
    prior = prior.reshape(-1, *(1,) * (log_evidence.ndim - 1))

    def together(score: Array) -> Array:
        score = jnp.where(good, jax.lax.stop_gradient(score), -jnp.inf)
        return jax.nn.logsumexp(score, axis=0, b=prior)

    return together(log_evidence) - together(log_evidence - gain)


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
