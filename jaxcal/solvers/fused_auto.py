"""The answer over noise models and laws of the offsets, many problems side by side.

It is :func:`jaxcal.solvers.auto.average_over_laws`, which is the reference and explains it, for
plain problems: a rigid X and common SDs or own covariances. Evidence and laws have their own
modules, :mod:`jaxcal.solvers.fused_evidence` and :mod:`jaxcal.solvers.fused_laws`. Nobody takes its
derivatives: those of an answer are the reference's (:mod:`jaxcal.abreast`).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal.model.parameters import RIGID, Parameters, retract
from jaxcal.model.priors import Gaussian, covariance_shape
from jaxcal.model.shapes import FAMILIES, Family, Shape
from jaxcal.problem import Problem
from jaxcal.solvers import unrolled
from jaxcal.solvers.auto import (
    LOG_ODDS_OF_MEAN,
    Averaged,
    OffsetLaw,
    median,
    odds_of_mean,
    weights,
    without_mean,
)
from jaxcal.solvers.fused import UNKNOWNS, Guess, Images, targets
from jaxcal.solvers.fused_evidence import (
    V_Y,
    Belief,
    common,
    judged,
    mean_precision,
    own,
    row_of,
    tune,
)
from jaxcal.solvers.fused_laws import SEEN, Sites, marginal, propagate, seen
from jaxcal.solvers.lanes import apart, choose
from jaxcal.solvers.variance import MINIMUM_SELF_TUNING


def average_abreast(
    parameters: Parameters, belief: Gaussian, problems: Problem, shapes: tuple[Shape, ...]
) -> Averaged:
    """:func:`jaxcal.solvers.auto.average_over_laws` for a batch (one leading axis).

    Args:
        parameters: the self-tuned Gaussian solutions.
        belief: their beliefs with common SDs.
        problems: plain ones.
        shapes: the laws to weigh.
    """
    images, guess, used = Images.of(problems), Guess.of(parameters), jnp.sum(problems.mask, axis=1)
    models, shape = candidates(guess, belief.sigma.T, images, problems)
    pairs = jnp.stack([model.log_evidence for model in models])
    pairs = jnp.where(jnp.isfinite(pairs), pairs, -jnp.inf).reshape(-1, 2, len(used))
    wanted = pairs - jnp.asarray([0.0, LOG_ODDS_OF_MEAN])[:, None]
    chosen = jnp.argmax(wanted.reshape(len(models), -1), axis=0)
    model = models[0]
    for k, other in enumerate(models[1:], start=1):
        model = choose(chosen == k, other, model)
    asked, which = chosen % 2 == 1, chosen // 2
    best = apart(answered(apart(model), asked, images, problems.max_elevation, shapes))
    pair = jnp.where(which > 0, pairs[-1], pairs[0])
    log_odds = jnp.where(asked, jnp.fmin(pair[1] - pair[0], best.log_odds), pair[1] - pair[0])
    step, shared = best.step, best.covariance[:UNKNOWNS, :UNKNOWNS]

    enough = (used >= MINIMUM_SELF_TUNING) & best.settled
    enough = enough & jnp.all(jnp.isfinite(step), axis=0)
    # As the reference does: from the linearisation it may be a hundredth of a radian, where the
    # kernel's own rotation is another one in the eighth digit.
    moved = Guess.of(
        jax.vmap(lambda here, by: retract(here, by, RIGID))(
            model.guess.parameters(), step[:UNKNOWNS].T
        )
    )
    member = jnp.asarray([[shape.family == name for shape in shapes] for name in FAMILIES])
    has_mean = enough & asked & jnp.logical_not(best.denied)
    own_covariances = jnp.zeros_like(enough)
    log_odds_own = jnp.zeros_like(log_odds)
    covariances = None
    if shape is not None:
        own_covariances = enough & (which > 0)
        log_odds_own = jnp.max(pairs[1], axis=0) - jnp.max(pairs[0], axis=0)
        covariances = jnp.where(
            (which > 0)[:, None, None, None], shape, jnp.eye(2, dtype=shape.dtype)
        )
    mean_sd = jnp.sqrt(jnp.maximum(best.covariance[-1, -1], 0.0))
    law = OffsetLaw(
        probability=(member @ best.weight).T,
        mean=jnp.where(has_mean, model.mean + step[-1], 0.0),
        mean_sd=jnp.where(has_mean, mean_sd, 0.0),
        has_mean=has_mean,
        own_covariances=own_covariances,
        log_odds_mean=log_odds,
        log_odds_own=log_odds_own,
        weighed=enough,
    )
    moved, sigma = choose(enough, (moved, model.sigma), (guess, belief.sigma.T))
    elevation_sd = jnp.sqrt(jnp.where(problems.mask > 0, best.variance.T, jnp.nan))
    return jax.vmap(Averaged)(
        moved.parameters(), jax.vmap(Gaussian)(sigma.T, covariances),
        jnp.moveaxis(shared, -1, 0), elevation_sd, law,
    )  # fmt: skip


class Candidate(eqx.Module):
    """A noise model, with or without a mean, tuned and linearised; lanes last.

    Attributes:
        guess: X and c. mean: b, mm. with_mean: 1 where there may be one. sigma: SDs of lateral
            position, range and offset, mm. log_evidence: ln Z, up to a constant that all share.
            information, gradient: of X and c in the measurements. squares, pull: sums of h_i h_i'
            and of h_i (q_iy - b).
    """

    guess: Guess
    mean: Float[Array, " lanes"]
    with_mean: Float[Array, " lanes"]
    sigma: Float[Array, "3 lanes"]
    log_evidence: Float[Array, " lanes"]
    information: Float[Array, "45 lanes"]
    gradient: Float[Array, "9 lanes"]
    squares: Float[Array, "45 lanes"]
    pull: Float[Array, "9 lanes"]

    @classmethod
    def of(cls, tuned: Belief, sigma: Array, log_evidence: Array) -> Candidate:
        """From a tuned belief."""
        sums, weight = tuned.sums, 1 / tuned.scale[:-1, None] ** 2
        # h_i has -1 at v_y, so the sum of h_i is what v_y has in common with the others.
        along = row_of(sums.matrix[-1], V_Y)
        return cls(
            tuned.guess, tuned.mean, tuned.with_mean, sigma, log_evidence,
            jnp.sum(weight * sums.matrix[:-1], axis=0),
            jnp.sum(weight * sums.gradient[:-1], axis=0),
            sums.matrix[-1],
            sums.gradient[-1] + tuned.mean * along,
        )  # fmt: skip


class Answer(eqx.Module):
    """What the laws say together about a noise model's unknowns; lanes last.

    Attributes:
        step, covariance: of X, the target and b: the laws' median, and about it. weight: the laws'
            probabilities. settled: at least one of them counts. variance: of the images' offsets,
            mm^2. log_odds: ln of how much more probable they make the data with a mean. denied: a
            mean was asked for, and all laws together do not believe in it.
    """

    step: Float[Array, "10 lanes"]
    covariance: Float[Array, "10 10 lanes"]
    weight: Float[Array, "k lanes"]
    settled: Bool[Array, " lanes"]
    variance: Float[Array, "n lanes"]
    log_odds: Float[Array, " lanes"]
    denied: Bool[Array, " lanes"]


def answered(
    model: Candidate,
    asked: Bool[Array, " lanes"],
    images: Images,
    bound: Float[Array, "lanes n"] | None,
    shapes: tuple[Shape, ...],
) -> Answer:
    """Weigh the laws: :func:`jaxcal.solvers.auto.weigh`."""
    q, turned = targets(model.guess, images)
    sites = apart(Sites.of(q, turned, images.mask, model.mean, bound))
    precision = mean_precision(model.sigma[2], model.with_mean)
    known = marginal(model.information, model.gradient, precision, model.mean, model.with_mean)
    stretch = jnp.asarray([shape.stretch for shape in shapes], images.mask.dtype)
    prior = jnp.asarray([shape.prior for shape in shapes], images.mask.dtype)
    families: list[Family] = [shape.family for shape in shapes]
    sd = model.sigma[2]
    squares, pull = apart(seen(model.squares, model.pull))
    found = propagate(known, sites, squares, pull, families, stretch[:, None] * sd)
    weight, good = weights(found.log_evidence, found.change, prior)
    means = jnp.where(good, found.mean, 0.0)
    within = jnp.where(good, found.covariance, jnp.eye(len(SEEN))[:, :, None, None])
    means, within, weight = apart((means, within, weight))

    expected, variance, along = apart(known.of_mean(means, within))
    gain, away = without_mean(expected + model.mean, variance, sd)
    log_odds = apart(odds_of_mean(found.log_evidence, gain, good, prior))
    denied = asked & jnp.logical_not(log_odds > LOG_ODDS_OF_MEAN)
    fewer, _ = weights(found.log_evidence - gain, found.change, prior)
    conditioned = within - along[:, None] * along[None] / variance
    means, within, weight = apart(
        choose(denied, (means - along * away, conditioned, fewer), (means, within, weight))
    )
    known = choose(denied, known.held(-model.mean), known)

    spread = jnp.sum(squares[:, :, None] * within, axis=(0, 1))
    share = median(means, apart(spread), weight, squares)
    mean = jnp.sum(apart(share) * means, axis=1)
    off = means - mean[:, None]
    covariance = jnp.sum(weight * (within + off[:, None] * off[None]), axis=2)
    step, covariance = apart(known.lifted(*apart((mean, covariance))))
    across = [[covariance[i, j][:, None] for j in SEEN] for i in SEEN]
    offset = unrolled.dot(sites.direction, unrolled.apply(across, sites.direction))
    return Answer(
        step, covariance, weight, jnp.any(good, axis=0), offset.T, log_odds, denied
    )  # fmt: skip


def candidates(
    guess: Guess, sigma: Float[Array, "3 lanes"], images: Images, problems: Problem
) -> tuple[list[Candidate], Float[Array, "lanes n 2 2"] | None]:
    """Common SDs and, where there are some, own covariances; each without and with a mean.

    Also the shape of the own covariances, mean diagonal (1, 1), or None.
    """
    used = images.used
    zero, one = jnp.zeros_like(used), jnp.ones_like(used)
    pass_over, count = common(images), jnp.stack([used] * 3)
    plain = judged(pass_over, guess, sigma, zero, zero, count)
    shifted = tune(pass_over, guess, sigma, one, count)
    found = [Candidate.of(each, each.scale, each.log_evidence) for each in (plain, shifted)]
    if problems.covariance is None:
        return found, None
    shape = jax.vmap(covariance_shape)(problems)
    assert shape is not None
    variances = jnp.diagonal(problems.covariance, axis1=-2, axis2=-1)
    mean = jnp.einsum("ln,lnk->kl", images.mask, variances) / used
    mean = jnp.where(jnp.all(mean > 0, axis=0), mean, 1.0)
    middle = jnp.mean(mean, axis=0)
    ratio = jnp.sqrt(mean / middle)
    a, b, c = (
        jnp.where(images.mask > 0, shape[..., i, j] * (ratio[i] * ratio[j])[:, None], float(i == j))
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    determinant = a * c - b * b
    weight = jnp.stack([c, -b, a]) / determinant
    start = jnp.sqrt(0.5 * jnp.sum((sigma[:2] / ratio) ** 2, axis=0))
    # Both at once, as so many lanes more.
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf], axis=-1), (guess, used))
    wide = jax.tree.map(lambda plane: jnp.concatenate([plane, plane], axis=-2), (images, weight))
    scale = jnp.stack([jnp.tile(start, 2), jnp.tile(sigma[2], 2)])
    tied = tune(
        own(*wide), twice[0], scale, jnp.concatenate([zero, one]),
        jnp.stack([2 * twice[1], twice[1]]),
    )  # fmt: skip
    # One more SD that is tuned costs half the log of the number of images.
    shapes = 0.5 * jnp.sum(images.mask * jnp.log(determinant), axis=1) - 0.5 * jnp.log(used)
    for half in (slice(None, len(used)), slice(len(used), None)):
        each = jax.tree.map(lambda leaf, half=half: leaf[..., half], tied)
        three = jnp.concatenate([ratio * each.scale[0], each.scale[1:]])
        found.append(Candidate.of(each, three, each.log_evidence - shapes))
    return found, shape
