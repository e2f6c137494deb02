"""Do the offsets have a mean other than zero, and how far may the data be believed about it?

A mean b of the offsets and X's elevational translation move the images' planes alike. What tells
them apart are second-order effects in the measured ranges, which other errors of the model imitate.
So the belief about b is a mixture,

    b = 0 with probability 9/10,      b ~ N(0, (2 s_y)^2) with probability 1/10,

and not a choice between the two: every answer moves continuously with the data, and where the data
do not tell whether there is a mean, the covariance includes that doubt. With v = (2 s_y)^2 and the
data's likelihood of b, all other unknowns eliminated, proportional to exp(eta b - lambda b^2 / 2),

    ln BF = 1/2 v eta^2 / (1 + v lambda) - 1/2 ln(1 + v lambda),
    ln odds = ln(1/9) + ln BF,   p = odds / (1 + odds),
    m = v eta / (1 + v lambda),   w = v / (1 + v lambda),
    E b = p m,               var b = p w + p (1 - p) m^2.

*Trust.* lambda is right if the errors are as the model assumes: Gaussian, alike, independent. The
data show whether they are. Image i moves b by d_i = (row b of H^-1) times its gradient, and the sum
of d_i^2 estimates b's variance for any law of the errors (the sandwich). With the products of
neighbours in time added, it does so for correlated errors, too (Newey and West). An image with much
information about b pulls b towards itself and so hides its own error. Therefore d_i is divided by
the share of the information about b that is left without that image and its neighbours, as in a
jackknife of blocks. Where the sum exceeds the variance under the model by some factor, eta and
lambda are divided by that factor.

On the real cross-wire recording, 0.41 of the data's information about the mean is used
(``mean_trust`` in experiments/results/crosswire_real.csv). The price is less power to find a mean
where images are few.

References: Mitchell and Beauchamp 1988 (spike and slab); White 1980; Newey and West 1987;
Kuensch 1989 (jackknife of blocks).
"""

from __future__ import annotations

from math import log

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.model import unrolled
from jaxcal.model.batch import ImagePlanes, Iterate, targets
from jaxcal.model.observations import FurtherUnknowns, Observation
from jaxcal.model.unknowns import RIGID_UNKNOWNS
from jaxcal.model.unrolled import Vector
from jaxcal.solvers.normal_equations import over_elements, weight_of

MEAN_SD = 2.0
"""Prior SD of the offsets' mean if there is one, in SDs of the offsets."""

PROBABILITY = 0.1
"""Prior probability that there is a mean; low, as it is one more thing to be wrong about."""

LAGS = 5
"""Errors are taken to be correlated up to this many images apart, in their given order."""

BARTLETT = tuple(1 - lag / (LAGS + 1) for lag in range(LAGS + 1))
"""Bartlett's weights of these lags, from 0 on."""

LEAST_INFORMATION_LEFT = 0.05
"""Least share of the information about b assumed to be left without an image and its neighbours."""


class MeanBelief(eqx.Module):
    """What is believed of the offsets' mean b.

    Attributes:
        mean: expectation, mm.
        variance: mm^2.
        log_bayes_factor: ln of how much more probable the data are with a mean than without one.
    """

    mean: Float[Array, "*batch"]
    variance: Float[Array, "*batch"]
    log_bayes_factor: Float[Array, "*batch"]

    @property
    def probability(self) -> Float[Array, "*batch"]:
        """Probability that there is a mean other than zero."""
        return jax.nn.sigmoid(self.log_bayes_factor + log(PROBABILITY / (1 - PROBABILITY)))


def mean_belief(mean: Array, variance: Array, offset_sd: Array, trust: Array) -> MeanBelief:
    """The belief about b, from the Gaussian belief that assumes that there is a mean.

    Args:
        mean: expectation of b if there is a mean, mm.
        variance: of b if there is a mean, mm^2.
        offset_sd: SD of the offsets, mm.
        trust: share of the data's information about b that is used (:func:`trust_in`).
    """
    prior = (MEAN_SD * offset_sd) ** 2
    precision = trust * jnp.maximum(1 / variance - 1 / prior, 0.0)
    pull = trust * mean / variance
    known = 1 + prior * precision
    within = prior / known
    log_bayes_factor = 0.5 * (within * pull**2 - jnp.log(known))
    belief = MeanBelief(within * pull, within, log_bayes_factor)
    p = belief.probability
    spread = p * (within + (1 - p) * belief.mean**2)
    return MeanBelief(p * belief.mean, spread, log_bayes_factor)


def log_evidence_gain(belief: MeanBelief) -> Array:
    """Ln of the evidence over that under the assumption that there is a mean."""
    return jnp.logaddexp(log(PROBABILITY), log(1 - PROBABILITY) - belief.log_bayes_factor)


def influences(
    iterate: Iterate,
    observation: Observation,
    images: ImagePlanes,
    weight: Float[Array, "k batch"],
    mean: Float[Array, " batch"],
    *,
    along: Float[Array, "q batch"],
    step: Float[Array, "q batch"],
) -> tuple[Float[Array, "batch n"], Float[Array, "batch n"]]:
    """How far each image moves b, to first order, mm, and its share of the information about b.

    Args:
        iterate: X, c and the further unknowns.
        observation: whose residuals; the offsets are the last.
        images: the data.
        weight: 1/s_k^2.
        mean: of the offsets, mm.
        along: b's row of the inverse of the normal matrix, b last.
        step: to the minimum, b last.
    """
    q, tracker_to_image = targets(iterate, images)

    def moved(by: Float[Array, "q batch"]) -> Vector:
        rows = unrolled.rows_of(by[:, :, None])
        turn = unrolled.apply(unrolled.cross(q), rows[3:6])
        shift = unrolled.apply(tracker_to_image, rows[6:RIGID_UNKNOWNS])
        rigid = [unrolled.add(-v, w, d) for v, w, d in zip(rows[:3], turn, shift, strict=True)]
        return [*rigid, *rows[RIGID_UNKNOWNS:-1]]

    def residuals(*at: Array) -> list[Vector]:
        beside = FurtherUnknowns.of(iterate, list(at[len(q) :]))
        return [each.errors for each in observation.components(list(at[: len(q)]), beside, images)]

    # b's row a of the inverse turns an image's gradient J' W r at the minimum into the motion of b
    # by this image. The sum of a' J' W J a over the images is b's variance, the last entry of a.
    still = jnp.zeros_like(mean)[:, None]
    here = [*q, *([still] * (iterate.unknowns - RIGID_UNKNOWNS))]
    values, to_minimum = jax.jvp(residuals, tuple(here), tuple(moved(step)))
    _, slopes = jax.jvp(residuals, tuple(here), tuple(moved(along)))
    values[-1] = [values[-1][0] - mean[:, None]]
    to_minimum[-1] = [to_minimum[-1][0] - step[-1][:, None]]
    slopes[-1] = [slopes[-1][0] - along[-1][:, None]]
    parts = observation.components(q, FurtherUnknowns.of(iterate, here[len(q) :]), images)
    total = share = jnp.zeros_like(images.mask)

    for k, part in enumerate(parts):
        heavy, present = weight[k][:, None], weight_of(part, images)
        for value, change, slope in zip(values[k], to_minimum[k], slopes[k], strict=True):
            total = total + heavy * over_elements(present * (value + change) * slope)
            share = share + heavy * over_elements(present * slope * slope)
    return total, share / along[-1][:, None]


def trust_in(
    variance: Float[Array, " batch"], moved: Float[Array, "batch n"], share: Float[Array, "batch n"]
) -> Float[Array, " batch"]:
    """The variance of b under the model over the variance that the images show, at most one.

    Args:
        variance: under the model, mm^2.
        moved: how far each image moves b, mm, in the order in which the images were taken.
        share: of each image in the information about b.
    """
    size = share.shape[1]

    def around(plane: Array) -> Array:
        return jnp.pad(plane, [(0, 0), (LAGS, LAGS)])

    def shifted(plane: Array, by: Array) -> Array:
        return jax.lax.dynamic_slice_in_dim(plane, LAGS + by, size, axis=1)

    # Loops, since what goes into a loop is computed before it. Otherwise XLA would compute an
    # image's influence again for each of its neighbours.
    def add_neighbours(lag: Array, near: Array) -> Array:
        return near + weights[lag] * (shifted(shares, lag) + shifted(shares, -lag))

    def add_products(lag: Array, shown: Array) -> Array:
        return shown + 2 * weights[lag] * jnp.sum(moved * shifted(moves, lag), axis=1)

    weights, shares = jnp.asarray(BARTLETT, share.dtype), around(share)
    near = jax.lax.fori_loop(1, LAGS + 1, add_neighbours, share)
    moved = moved / jnp.maximum(1 - near, LEAST_INFORMATION_LEFT)
    moves = around(moved)
    shown = jax.lax.fori_loop(1, LAGS + 1, add_products, jnp.sum(moved**2, axis=1))
    return variance / jnp.maximum(variance, shown)
