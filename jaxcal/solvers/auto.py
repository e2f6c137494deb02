"""The estimator behind ``--method joint``: nothing to choose, and it says what it chose.

What the plain self-tuned fit (:mod:`jaxcal.solvers.reml`) takes for granted is asked of the
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

Each step is a fixed number of array operations, so gradients go through (REML's by the implicit
function theorem). With fewer than eight used images, with given SDs, or where no law settles, the
plain Gaussian answer stands, and the result says so.

What to expect. The answer is nearly the posterior median over these laws, so it is better than
conventional calibration on average, whatever the offsets' law; in a single trial it can be worse.
Small samples do not tell the laws apart: there the answer stays near the Gaussian one.
The cut at an image's bound is taken at the mean that step 2 found, and intervals take the tuned
SDs for known, but for Student's factor (:mod:`jaxcal.diagnostics.intervals`).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.model import unrolled
from jaxcal.model.batch import Images, Iterate, barrier, choose, targets
from jaxcal.model.observations import Medium, Observation, OwnCovariances, Points, unit_shape
from jaxcal.model.parameters import retract
from jaxcal.model.shapes import FAMILIES, Family, Shape
from jaxcal.solvers.evidence import (
    MEAN_SD,
    V_Y,
    Evidence,
    judged,
    mean_precision,
    pass_over,
    row_of,
    tune,
)
from jaxcal.solvers.expectation_propagation import SEEN, Sites, marginal, propagate, seen
from jaxcal.solvers.reml import MINIMUM_SELF_TUNING

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
    """The estimate over all laws, lanes last but for the law.

    Attributes:
        place: the unknowns.
        sigma: tuned SDs of the noise model in use, mm.
        covariance: of the unknowns' tangent.
        elevation_sd: of every image's offset, mm; NaN for images left out.
        law: what was found out, with a leading axis.
        own_covariances: where the images' own covariances are in use.
    """

    place: Iterate
    sigma: Float[Array, "components lanes"]
    covariance: Float[Array, "p p lanes"]
    elevation_sd: Float[Array, "lanes n"]
    law: OffsetLaw
    own_covariances: Bool[Array, " lanes"]


def average_over_laws(
    place: Iterate,
    observation: Observation,
    images: Images,
    shapes: tuple[Shape, ...],
    *,
    variances: Float[Array, "3 lanes n"] | None,
    bound: Float[Array, "lanes n"] | None,
    medium: Medium | None,
) -> Averaged:
    """Weigh offset means, noise models and laws of the offsets, and average the answers.

    Args:
        place: the self-tuned Gaussian solutions.
        observation: with common SDs, tuned.
        images: the data.
        shapes: the laws to weigh.
        variances: the images' own: lateral variance, covariance, range variance, mm^2; or None.
        bound: on the offsets, mm, which cuts the laws; or None.
        medium: what is known of sound speed and delay besides.
    """
    used = images.used
    models = candidates(place, observation, images, variances, medium)
    pairs = jnp.stack([model.log_evidence for model in models])
    pairs = jnp.where(jnp.isfinite(pairs), pairs, -jnp.inf).reshape(-1, 2, len(used))
    wanted = pairs - jnp.asarray([0.0, LOG_ODDS_OF_MEAN])[:, None]
    chosen = jnp.argmax(wanted.reshape(len(models), -1), axis=0)
    model = models[0]
    for k, other in enumerate(models[1:], start=1):
        model = choose(chosen == k, other, model)
    asked, which = chosen % 2 == 1, chosen // 2
    best = barrier(answered(barrier(model), asked, images, bound, shapes))
    pair = jnp.where(which > 0, pairs[-1], pairs[0])
    gaussian = pair[1] - pair[0]
    # fmin: where no law settles, the Gaussian's odds stand.
    log_odds = jnp.where(asked, jnp.fmin(gaussian, best.log_odds), gaussian)
    step, unknowns = best.step, place.unknowns

    enough = (used >= MINIMUM_SELF_TUNING) & best.settled
    enough = enough & jnp.all(jnp.isfinite(step), axis=0)
    # From the linearisation the answer may be a hundredth of a radian away: turn by Exp, and not
    # by the solvers' rotation, which is another one in the eighth digit.
    moved = jax.vmap(lambda here, by: retract(here, by, place.blocks))(
        model.place.parameters(), step[:unknowns].T
    )
    member = jnp.asarray([[shape.family == name for shape in shapes] for name in FAMILIES])
    has_mean = enough & asked & jnp.logical_not(best.denied)
    own, log_odds_own = jnp.zeros_like(enough), jnp.zeros_like(log_odds)
    if variances is not None:
        own = enough & (which > 0)
        log_odds_own = jnp.max(pairs[1], axis=0) - jnp.max(pairs[0], axis=0)
    mean_sd = jnp.sqrt(jnp.maximum(best.covariance[-1, -1], 0.0))
    law = OffsetLaw(
        probability=(member @ best.weight).T,
        mean=jnp.where(has_mean, model.mean + step[-1], 0.0),
        mean_sd=jnp.where(has_mean, mean_sd, 0.0),
        has_mean=has_mean,
        own_covariances=own,
        log_odds_mean=log_odds,
        log_odds_own=log_odds_own,
        weighed=enough,
    )
    place, sigma = choose(
        enough, (Iterate.of(moved, place.blocks), model.sigma), (place, observation.sigma)
    )
    return Averaged(
        place,
        sigma,
        best.covariance[:unknowns, :unknowns],
        jnp.sqrt(jnp.where(images.mask > 0, best.variance.T, jnp.nan)),
        law,
        which > 0,
    )


class Candidate(eqx.Module):
    """A noise model, with or without a mean, tuned and linearised; lanes last.

    Attributes:
        place: X, c and the further unknowns.
        mean: b, mm.
        with_mean: 1 where there may be one.
        sigma: SDs of the components of the common noise model, mm.
        log_evidence: ln Z, up to a constant that all share.
        information: of the unknowns in the measurements, upper triangle.
        gradient: of half the measurements' cost.
        squares: sum of h_i h_i', upper triangle.
        pull: sum of h_i (q_iy - b).
    """

    place: Iterate
    mean: Float[Array, " lanes"]
    with_mean: Float[Array, " lanes"]
    sigma: Float[Array, "components lanes"]
    log_evidence: Float[Array, " lanes"]
    information: Float[Array, "triangle lanes"]
    gradient: Float[Array, "p lanes"]
    squares: Float[Array, "triangle lanes"]
    pull: Float[Array, "p lanes"]

    @classmethod
    def of(cls, tuned: Evidence, sigma: Array, log_evidence: Array) -> Candidate:
        """From a tuned noise model."""
        sums = tuned.sums
        # The offsets are left to their law.
        weight = jnp.concatenate([1 / tuned.sigma[:-1] ** 2, jnp.zeros_like(tuned.sigma[:1])])
        measured = sums.weighed(weight)
        # h_i has -1 at v_y, so the sum of h_i is what v_y has in common with the others.
        along = row_of(sums.matrix[-1], V_Y)
        return cls(
            tuned.place,
            tuned.mean,
            tuned.with_mean,
            sigma,
            log_evidence,
            measured.curvature,
            measured.gradient,
            sums.matrix[-1],
            sums.gradient[-1] + tuned.mean * along,
        )


class Answer(eqx.Module):
    """What the laws say together about a noise model's unknowns; lanes last.

    Attributes:
        step: of all unknowns and b, to the laws' median.
        covariance: about it.
        weight: the laws' probabilities.
        settled: at least one of them counts.
        variance: of the images' offsets, mm^2.
        log_odds: ln of how much more probable they make the data with a mean.
        denied: a mean was asked for, and all laws together do not believe in it.
    """

    step: Float[Array, "q lanes"]
    covariance: Float[Array, "q q lanes"]
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
    """Weigh the laws on a linearised problem.

    A law with edges says of the mean b what a Gaussian does not see, so where the Gaussian asks for
    one, all laws together have to agree. That needs no second propagation: the evidence with b over
    that without is the density of b at zero before the data over that after (Savage and Dickey),
    and where the laws deny the mean, their beliefs are conditioned on b = 0.

    Reference: Dickey 1971.
    """
    q, turned = targets(model.place, images)
    sites = barrier(Sites.of(q, turned, images.mask, model.mean, bound))
    precision = mean_precision(model.sigma[-1], model.with_mean)
    known = marginal(model.information, model.gradient, precision, model.mean, model.with_mean)
    stretch = jnp.asarray([shape.stretch for shape in shapes], images.mask.dtype)
    prior = jnp.asarray([shape.prior for shape in shapes], images.mask.dtype)
    families: list[Family] = [shape.family for shape in shapes]
    sd = model.sigma[-1]
    squares, pull = barrier(seen(model.squares, model.pull))
    found = propagate(known, sites, squares, pull, families, stretch[:, None] * sd)
    weight, good = weights(found.log_evidence, found.change, prior)
    means = jnp.where(good, found.mean, 0.0)
    within = jnp.where(good, found.covariance, jnp.eye(len(SEEN))[:, :, None, None])
    means, within, weight = barrier((means, within, weight))

    expected, variance, along = barrier(known.of_mean(means, within))
    gain, away = without_mean(expected + model.mean, variance, sd)
    log_odds = barrier(odds_of_mean(found.log_evidence, gain, good, prior))
    denied = asked & jnp.logical_not(log_odds > LOG_ODDS_OF_MEAN)
    fewer, _ = weights(found.log_evidence - gain, found.change, prior)
    conditioned = within - along[:, None] * along[None] / variance
    means, within, weight = barrier(
        choose(denied, (means - along * away, conditioned, fewer), (means, within, weight))
    )
    known = choose(denied, known.held(-model.mean), known)

    spread = jnp.sum(squares[:, :, None] * within, axis=(0, 1))
    share = median(means, barrier(spread), weight, squares)
    mean = jnp.sum(barrier(share) * means, axis=1)
    off = means - mean[:, None]
    covariance = jnp.sum(weight * (within + off[:, None] * off[None]), axis=2)
    step, covariance = barrier(known.lifted(*barrier((mean, covariance))))
    across = [[covariance[i, j][:, None] for j in SEEN] for i in SEEN]
    offset = unrolled.dot(sites.direction, unrolled.apply(across, sites.direction))
    return Answer(step, covariance, weight, jnp.any(good, axis=0), offset.T, log_odds, denied)


def candidates(
    place: Iterate,
    observation: Observation,
    images: Images,
    variances: Float[Array, "3 lanes n"] | None,
    medium: Medium | None,
) -> list[Candidate]:
    """Common SDs and, where there are some, own covariances; each without and with a mean."""
    used, sigma, count = images.used, observation.sigma, observation.count(images)
    zero, one = jnp.zeros_like(used), jnp.ones_like(used)
    sums_at = pass_over(observation, images, medium)
    # Common SDs without a mean are REML's own model, which has been tuned already.
    plain = judged(sums_at, place, sigma, zero, zero, count)
    shifted = tune(sums_at, place, sigma, one, count)
    found = [Candidate.of(each, each.sigma, each.log_evidence) for each in (plain, shifted)]
    if variances is None or not isinstance(observation, Points):
        return found
    shape, mean = unit_shape(variances, images)
    ratio = jnp.sqrt(mean / jnp.mean(mean, axis=0))
    by = jnp.stack([ratio[0] * ratio[0], ratio[0] * ratio[1], ratio[1] * ratio[1]])
    shape = jnp.where(
        images.mask > 0, shape * by[..., None], jnp.asarray([1.0, 0, 1])[:, None, None]
    )
    start = jnp.sqrt(0.5 * jnp.sum((sigma[:2] / ratio) ** 2, axis=0))
    # Both at once, as so many lanes more.
    twice = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf], axis=-1), place)
    wide = images.repeated(2)
    scale = jnp.stack([jnp.tile(start, 2), jnp.tile(sigma[2], 2)])
    tied = OwnCovariances(scale, jnp.tile(shape, (1, 2, 1)), jnp.ones_like(scale[0]), tied=True)
    medium = None if medium is None else medium.repeated(2)
    tuned = tune(
        pass_over(tied, wide, medium),
        twice,
        scale,
        jnp.concatenate([zero, one]),
        tied.count(wide),
    )
    determinant = shape[0] * shape[2] - shape[1] ** 2
    # One more SD that is tuned costs half the log of the number of images.
    penalty = 0.5 * jnp.sum(images.mask * jnp.log(determinant), axis=1) - 0.5 * jnp.log(used)
    for half in (slice(None, len(used)), slice(len(used), None)):
        each = jax.tree.map(lambda leaf, half=half: leaf[..., half], tuned)
        three = jnp.concatenate([ratio * each.sigma[0], each.sigma[1:]])
        found.append(Candidate.of(each, three, each.log_evidence - penalty))
    return found


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
