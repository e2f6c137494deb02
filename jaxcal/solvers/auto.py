"""The estimator of the joint method with the priors ``auto`` and ``uniform``.

The plain self-tuned fit (:mod:`jaxcal.solvers.reml`) assumes that the offsets are Gaussian, that
their mean is zero, and that errors are alike in all images. Here the data are asked whether that is
so. It matters because lateral position and range do not determine rotation about the lateral axis;
only the offsets' law does. The edges of bounded offsets determine X twice as well as their SD does,
heavy tails must not pull it, and a mean that is ignored biases it. Nothing is switched on or off:
every alternative has a weight that moves continuously with the data, and the covariance includes
their disagreement.

1. *REML* tunes the SDs of lateral position, range and offset, with Gaussian offsets of mean zero.
2. *Noise models* (:mod:`jaxcal.solvers.evidence`). The same model with a belief about the offsets'
   mean (:mod:`jaxcal.solvers.offset_mean`). Where the images have covariances of their own, a
   second model uses these, up to one common factor.
3. *Laws* (:mod:`jaxcal.model.shapes`). Linearised at a noise model's answer, everything is Gaussian
   except the offsets' law. Expectation propagation gives X under each law of ``SHAPES``, and how
   probable the data are under it. The laws are uniform, a bell with edges, Gaussian, and Student's
   t4. The uniform law has five SDs about REML's, because its edges are what matters, and REML's SD
   gives them only to a few per cent. Where an image has a bound on its offset, the law is cut at
   the bound. The belief about the mean is formed anew under each law, since edges give information
   about the mean that a Gaussian does not.
4. *Median*. X, target and mean are the geometric median of the answers under all laws and noise
   models, weighted by their probability. The covariance is the average of theirs, plus the spread
   of the answers about the median. A law under which the propagation does not settle (its edges
   exclude some image) loses its weight.

Steps 2 to 4 are a fixed number of array operations, so gradients go through them; REML's gradients
come from the implicit function theorem. With fewer than eight used images, with given SDs, or where
no law settles, the plain Gaussian answer stands, and the result says so.

What to expect. The answer is nearly the posterior median over these laws, so it is better than
conventional calibration on average, whatever the offsets' law; in a single trial it can be worse.
Small samples do not tell the laws apart: there the answer stays near the Gaussian one.
The cut at an image's bound uses the mean that step 2 found. Intervals treat the tuned SDs as known,
except for Student's factor (:mod:`jaxcal.diagnostics.intervals`).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.model.batch import ImagePlanes, Iterate, barrier, choose, targets
from jaxcal.model.distributions import FAMILIES, Family, OffsetLaw, Shape
from jaxcal.model.observations import (
    MediumPrior,
    Observation,
    OwnCovariances,
    Points,
    rescaled,
    unit_shape,
)
from jaxcal.model.parameters import retract
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING
from jaxcal.solvers import dense
from jaxcal.solvers.evidence import NoiseModel, tune
from jaxcal.solvers.expectation_propagation import (
    SITE_UNKNOWNS,
    Sites,
    marginal,
    propagate,
    site_part,
)
from jaxcal.solvers.normal_equations import V_Y, row_of, stacked
from jaxcal.solvers.offset_mean import MEAN_SD, log_evidence_gain, mean_belief

LARGEST_CHANGE = 0.4
"""A law counts as long as the last sweep moved no unknown by more than about this many SDs.

The evidence is stationary in the sites, so it is nearly right before the mean is. Only laws that do
not settle at all need to be left out."""

LARGEST_GAIN = 10.0
"""A law counts only if the last sweep but one changed the log evidence by less than about this.

Where edges exclude an image, rounding decides whether the evidence rises or falls, by thousands
from one sweep to the next. Where it settles, it changes by tenths, which must not matter."""

MEDIAN_STEPS = 12
"""Weiszfeld's steps to the median."""


class Averaged(eqx.Module):
    """The estimate over all laws; the batch axis is last, except in the law.

    Attributes:
        iterate: the unknowns.
        sigma: tuned SDs of the more probable noise model, mm.
        covariance: of the unknowns' tangent.
        elevation_sd: of every image's offset, mm; NaN for images left out.
        law: what was found out about the offsets, with a leading axis.
        own_covariances: where the images' own covariances are the more probable ones.
    """

    iterate: Iterate
    sigma: Float[Array, "components batch"]
    covariance: Float[Array, "p p batch"]
    elevation_sd: Float[Array, "batch n"]
    law: OffsetLaw
    own_covariances: Bool[Array, " batch"]


def average_over_laws(
    iterate: Iterate,
    observation: Observation,
    images: ImagePlanes,
    shapes: tuple[Shape, ...],
    *,
    variances: Float[Array, "3 batch n"] | None,
    bound: Float[Array, "batch n"] | None,
    medium: MediumPrior | None,
) -> Averaged:
    """Weigh noise models, offset means and laws of the offsets, and average the answers.

    Args:
        iterate: the self-tuned Gaussian solutions.
        observation: with common SDs, tuned.
        images: the data.
        shapes: the laws to weigh.
        variances: the images' own: lateral variance, covariance, range variance, mm^2; or None.
        bound: on the offsets, mm, which cuts the laws; or None.
        medium: prior of further unknowns, or None.
    """
    used, unknowns = images.used, iterate.unknowns
    common = tune(iterate, observation, images, medium)
    model = Linearised.of(common, common.sigma)
    sites = sites_at(model, images, bound)
    answers = answers_under(model, sites, shapes)
    own, sigma = jnp.zeros_like(used), model.sigma
    if variances is not None and isinstance(observation, Points):
        other, more_probable = with_own_covariances(common, observation, images, variances, medium)
        own = jax.nn.sigmoid(more_probable)
        beside = answers_under(other, sites_at(other, images, bound), shapes)
        beside = beside.seen_from(model.iterate.step_to(other.iterate), other.mean - model.mean)
        answers = Answers.joined(answers.shared(1 - own), beside.shared(own))
        sigma = choose(own > 0.5, other.sigma, sigma)
    step, covariance = barrier(median(answers, model.offsets_metric()))

    at = np.array(SITE_UNKNOWNS)
    variance = sites.variance(covariance[at[:, None], at])

    enough = (used >= MINIMUM_SELF_TUNING) & answers.settled & jnp.all(jnp.isfinite(step), axis=0)
    # The answer may be a hundredth of a radian from the linearisation: turn by Exp, since the
    # solvers' rotation (Cayley's) then differs from it in the eighth digit.
    moved = jax.vmap(lambda here, by: retract(here, by, iterate.blocks))(
        model.iterate.parameters(), step[:unknowns].T
    )
    member = jnp.asarray([[shape.family == name for shape in shapes] for name in FAMILIES])
    weight = answers.weight.reshape(-1, len(shapes), len(used)).sum(axis=0)

    def where_weighed(value: Array) -> Array:
        return jnp.where(enough, value, 0.0)

    law = OffsetLaw(
        probability=where_weighed(member @ weight).T,
        mean=where_weighed(model.mean + step[-1]),
        mean_sd=where_weighed(jnp.sqrt(jnp.maximum(covariance[-1, -1], 0.0))),
        mean_probability=where_weighed(jnp.sum(answers.weight * answers.mean_probability, axis=0)),
        trust=where_weighed(model.trust),
        own_probability=where_weighed(own),
        weighed=enough,
    )
    iterate, sigma = choose(
        enough, (Iterate.of(moved, iterate.blocks), sigma), (iterate, observation.sigma)
    )
    return Averaged(
        iterate,
        sigma,
        covariance[:unknowns, :unknowns],
        jnp.sqrt(jnp.where(images.mask > 0, variance, jnp.nan)),
        law,
        enough & (own > 0.5),
    )


class Linearised(eqx.Module):
    """A noise model, linearised where it was tuned; batch axis last.

    Attributes:
        iterate: X, c and the further unknowns.
        mean: b, mm.
        trust: share of the data's information about b that is used.
        sigma: SDs of the components of the common noise model, mm.
        information: of the unknowns in the measurements, upper triangle.
        gradient: of half the measurements' cost.
        squares: sum of h_i h_i', upper triangle.
        pull: sum of h_i (q_iy - b).
    """

    iterate: Iterate
    mean: Float[Array, " batch"]
    trust: Float[Array, " batch"]
    sigma: Float[Array, "components batch"]
    information: Float[Array, "triangle batch"]
    gradient: Float[Array, "p batch"]
    squares: Float[Array, "triangle batch"]
    pull: Float[Array, "p batch"]

    @classmethod
    def of(cls, tuned: NoiseModel, sigma: Array) -> Linearised:
        """From a tuned noise model."""
        sums = tuned.sums
        # The offsets get no weight here; their law follows later.
        weight = jnp.concatenate([1 / tuned.sigma[:-1] ** 2, jnp.zeros_like(tuned.sigma[:1])])
        measured = sums.weighted(weight)
        # h_i is -1 at v_y, so v_y's row of the sum of h_i h_i' is minus the sum of h_i.
        along = row_of(sums.matrix[-1], V_Y)
        return cls(
            tuned.iterate,
            tuned.mean,
            tuned.trust,
            sigma,
            measured.curvature,
            measured.gradient,
            sums.matrix[-1],
            sums.gradient[-1] + tuned.mean * along,
        )

    def offsets_metric(self) -> Float[Array, "q q batch"]:
        """Sum of h_i h_i' with b as the last unknown; b moves the offsets as v_y does."""
        matrix = stacked(self.squares)
        matrix = jnp.concatenate([matrix, matrix[V_Y][None]])
        return jnp.concatenate([matrix, matrix[:, V_Y][:, None]], axis=1)


class Answers(eqx.Module):
    """The belief about the unknowns and b under every law, relative to an iterate; batch axis last.

    Attributes:
        mean: of all unknowns and b.
        covariance: of these.
        weight: probability.
        mean_probability: probability under each law that there is a mean.
        settled: the propagation settles under at least one law; under a Gaussian law that is not
            cut it always does.
    """

    mean: Float[Array, "q k batch"]
    covariance: Float[Array, "q q k batch"]
    weight: Float[Array, "k batch"]
    mean_probability: Float[Array, "k batch"]
    settled: Bool[Array, " batch"]

    def shared(self, share: Float[Array, " batch"]) -> Answers:
        """The answers with a share of their weight."""
        return eqx.tree_at(lambda each: each.weight, self, share * self.weight)

    def seen_from(self, step: Float[Array, "p batch"], mean: Float[Array, " batch"]) -> Answers:
        """The answers relative to another iterate; ``step`` leads from that one to this one."""
        step = jnp.concatenate([step, mean[None]])
        return eqx.tree_at(lambda each: each.mean, self, self.mean + step[:, None])

    @classmethod
    def joined(cls, first: Answers, second: Answers) -> Answers:
        """The answers of two noise models together."""

        def both(name: str) -> Array:
            return jnp.concatenate([getattr(first, name), getattr(second, name)], axis=-2)

        return cls(
            both("mean"),
            both("covariance"),
            both("weight"),
            both("mean_probability"),
            first.settled & second.settled,
        )


def sites_at(
    model: Linearised, images: ImagePlanes, bound: Float[Array, "batch n"] | None
) -> Sites:
    """The offsets of a linearised problem, as the laws see them."""
    q, tracker_to_image = targets(model.iterate, images)
    return barrier(Sites.of(q, tracker_to_image, images.mask, model.mean, bound))


def answers_under(model: Linearised, sites: Sites, shapes: tuple[Shape, ...]) -> Answers:
    """The answers under the laws on a linearised problem."""
    sd = model.sigma[-1]
    known = marginal(model.information, model.gradient, (MEAN_SD * sd) ** -2.0, model.mean)
    stretch = jnp.asarray([shape.stretch for shape in shapes], sd.dtype)
    prior = jnp.asarray([shape.prior for shape in shapes], sd.dtype)
    families: list[Family] = [shape.family for shape in shapes]
    squares, pull = barrier(site_part(model.squares, model.pull))
    found = propagate(known, sites, squares, pull, families, stretch[:, None] * sd)

    mean, covariance = barrier(known.lifted(found.mean, found.covariance))
    variance = covariance[-1, -1]
    belief = mean_belief(model.mean + mean[-1], variance, sd, model.trust)
    evidence = found.log_evidence + log_evidence_gain(belief)
    weight, good = weights(evidence, found.log_evidence_change, found.change, prior)
    # The other unknowns follow b.
    along = covariance[:, -1] / variance
    # Values of a law are computed once, and not again for every entry of its covariance.
    belief, weight, good, along = barrier((belief, weight, good, along))
    mean = mean + along * (belief.mean - model.mean - mean[-1])
    covariance = covariance + along[:, None] * along * (belief.variance - variance)
    still = (found.change < LARGEST_CHANGE) & (jnp.abs(found.log_evidence_change) < LARGEST_GAIN)
    size = len(mean)
    return Answers(
        jnp.where(good, mean, 0.0),
        jnp.where(good, covariance, jnp.eye(size, dtype=mean.dtype)[:, :, None, None]),
        weight,
        jnp.where(good, belief.probability, 0.0),
        jnp.any(good & still, axis=0),
    )


def with_own_covariances(
    common: NoiseModel,
    observation: Points,
    images: ImagePlanes,
    variances: Float[Array, "3 batch n"],
    medium: MediumPrior | None,
) -> tuple[Linearised, Float[Array, " batch"]]:
    """The noise model of the images' own covariances, and ln of how much more probable it is."""
    used, sigma = images.used, common.sigma
    shape, mean = unit_shape(variances, images)
    ratio = jnp.sqrt(mean / jnp.mean(mean, axis=0))
    shape = rescaled(shape, ratio, images.mask > 0)
    scale = jnp.sqrt(0.5 * jnp.sum((sigma[:2] / ratio) ** 2, axis=0))
    tied = OwnCovariances(jnp.stack([scale, sigma[2]]), shape, jnp.ones_like(scale), tied=True)
    tuned = tune(common.iterate, tied, images, medium)
    determinant = shape[0] * shape[2] - shape[1] ** 2
    # The common model tunes one SD more; that costs half the log of the number of images.
    penalty = 0.5 * jnp.sum(images.mask * jnp.log(determinant), axis=1) - 0.5 * jnp.log(used)
    more = tuned.log_evidence(tied.count(images)) - penalty
    more = more - common.log_evidence(observation.count(images))
    more = jnp.where(jnp.isfinite(more), more, -jnp.inf)
    return Linearised.of(tuned, jnp.concatenate([ratio * tuned.sigma[0], tuned.sigma[1:]])), more


def median(
    answers: Answers, metric: Float[Array, "q q batch"]
) -> tuple[Float[Array, "q batch"], Float[Array, "q q batch"]]:
    """The answers' geometric median, and the covariance about it.

    Mean RP is the average of a distance, not of its square, so the answer is where the expected
    distance is least. Where laws disagree, that is nearer to the more probable one than their mean
    is. The distance is that of the images' offsets, all together. The expected distance of x from
    an answer N(m, C) is near (|x - m|^2 + 2/pi tr(C H))^1/2; for one unknown this is exact at x = m
    and far from it.

    Args:
        answers: whose.
        metric: H = sum of h_i h_i'.

    Reference: Weiszfeld 1937.
    """
    weight, metric = answers.weight, metric[:, :, None]
    within = (2 / np.pi) * jnp.sum(metric * answers.covariance, axis=(0, 1))
    centre = jnp.sum(weight * answers.mean, axis=1)
    means = answers.mean - centre[:, None]
    # Of the answers, only their scalar products matter.
    forward = jnp.swapaxes(means, 0, 1)[:, :, None]
    products = jnp.sum(forward * dense.product_batch_last(metric, means), axis=1)
    within, means, products = barrier((within, means, products))
    tiny = jnp.finfo(weight.dtype).tiny

    def once(_: Array, share: Array) -> Array:
        toward = jnp.sum(products * share, axis=1)
        length = jnp.diagonal(products).T - 2 * toward + jnp.sum(share * toward, axis=0)
        pull = weight / jnp.sqrt(jnp.maximum(jnp.maximum(length, 0.0) + within, tiny))
        whole = jnp.sum(pull, axis=0)
        return pull / jnp.where(whole > 0, whole, 1.0)

    share = barrier(jax.lax.fori_loop(0, MEDIAN_STEPS, once, weight))
    found = jnp.sum(share * means, axis=1)
    off = means - found[:, None]
    return centre + found, jnp.sum(weight * (answers.covariance + off[:, None] * off), axis=2)


def weights(
    log_evidence: Float[Array, "k ..."],
    gain: Float[Array, "k ..."],
    change: Float[Array, "k ..."],
    prior: Float[Array, " k"],
) -> tuple[Array, Array]:
    """The laws' probabilities, and which laws have finite results.

    A law whose belief or evidence still moves loses weight: the more it moves, the more weight.
    """
    good = jnp.isfinite(log_evidence) & jnp.isfinite(gain) & jnp.isfinite(change)
    prior = prior.reshape(-1, *(1,) * (log_evidence.ndim - 1))
    moving = (jnp.where(good, change, 0.0) / LARGEST_CHANGE) ** 4
    # No more than what takes all weight: the derivative must not overflow.
    rising = jnp.minimum(jnp.abs(jnp.where(good, gain, 0.0)) / LARGEST_GAIN, 100.0)
    moving = moving + rising**8
    score = jnp.where(good, log_evidence, 0.0) + jnp.log(prior) - moving
    score = jnp.where(good, score, -jnp.inf)
    # Where no law is good the weights must still be numbers: a problem's NaN poisons its gradient.
    score = jnp.where(jnp.any(good, axis=0), score, 0.0)
    return jax.nn.softmax(score, axis=0) * good, good
