"""What is believed of the elevational offsets, each belief a piece of the joint least squares.

A prior turns (unknowns, offset unknowns) into residuals and says how its offset unknown relates to
the elevational offset y_i; the joint solver needs no more than :class:`AbstractPrior`.

Bounded is the paper's belief, |y_i| <= m_i with everything else weighted alike. Gaussian is
y_i ~ N(0, sigma_elevation^2) beside N(0, sigma^2) errors of the lateral position and range, or of
every element's distance.
"""

from __future__ import annotations

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.errors import InputError
from jaxcal.model.parameters import Parameters
from jaxcal.model.residuals import (
    LARGEST_ELEVATION,
    channel_residual,
    circle_residual,
    closest_elevation,
    measured_points,
    measurement_residual,
    target_in_image,
)
from jaxcal.problem import Channels, Problem


class AbstractPrior(eqx.Module):
    """The interface; a prior without offset unknowns need not say more than its residual.

    ``closed_form_offset``: whether :meth:`start` gives the *optimal* offsets for the parameters.
    """

    closed_form_offset: ClassVar[bool] = False

    @abc.abstractmethod
    def residual(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, "n columns"]:
        """Whitened residuals of every image; row i depends on offset i only."""

    @abc.abstractmethod
    def elevation(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, " n"]:
        """The estimated elevational offsets, mm."""

    def start(self, parameters: Parameters, problem: Problem) -> Float[Array, " k"]:
        """First offset unknowns: one an image, or none."""
        return jnp.zeros(0, problem.mask.dtype)

    def limit(self, parameters: Parameters, problem: Problem) -> Float[Array, " k"]:
        """Bound on the magnitude of the offset unknowns, inf where there is none."""
        return jnp.full_like(self.start(parameters, problem), jnp.inf)

    def largest_weight(self) -> Float[Array, ""] | float:
        """How much a mm of error can be in a whitened residual."""
        return 1.0


class InPlane(AbstractPrior):
    """Every target is taken to lie in the image plane: the conventional Eq. 7, y = 0, mm."""

    def residual(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, "n 3"]:
        return circle_residual(parameters, jnp.zeros_like(problem.mask), problem)

    def elevation(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, " n"]:
        return problem.mask * target_in_image(parameters, problem)[:, 1]


class Fixed(AbstractPrior):
    """Offsets held at given values (n,), mm: one half-round of the alternation."""

    value: Float[Array, " n"]

    def residual(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, "n 3"]:
        return circle_residual(parameters, self.value, problem)

    def elevation(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, " n"]:
        return problem.mask * self.value


class Bounded(AbstractPrior):
    """|y_i| <= bound_i and equal weights: the objective that the paper's alternation descends.

    Attributes:
        bound: (n,) m_i, mm; above 0.95 of an image's range it is taken as that.
    """

    bound: Float[Array, " n"]
    closed_form_offset: ClassVar[bool] = True

    def residual(
        self, parameters: Parameters, offset: Float[Array, " n"], problem: Problem
    ) -> Float[Array, "n 3"]:
        return circle_residual(parameters, offset, problem)

    def start(self, parameters: Parameters, problem: Problem) -> Float[Array, " n"]:
        return closest_elevation(parameters, self.limit(parameters, problem), problem)

    def limit(self, parameters: Parameters, problem: Problem) -> Float[Array, " n"]:
        distance = jnp.abs(measured_points(parameters, problem)[:, 1])
        return jnp.minimum(self.bound, LARGEST_ELEVATION * distance)

    def elevation(
        self, parameters: Parameters, offset: Float[Array, " n"], problem: Problem
    ) -> Float[Array, " n"]:
        return problem.mask * offset


class Explicit(AbstractPrior):
    """q_i - p_i(y_i) with given SDs and Gaussian offsets y_i that stay unknowns of their own.

    The 9 + n unknowns of the arrow as it is written down; no method of the package takes it, the
    fused kernel and the benchmarks are held to it.

    Attributes:
        sigma: (3,) SDs of the lateral, elevational and axial components, mm.
        offset_sd: SD of y_i, mm.
    """

    sigma: Float[Array, 3]
    offset_sd: Float[Array, ""]

    def residual(
        self, parameters: Parameters, offset: Float[Array, " n"], problem: Problem
    ) -> Float[Array, "n 4"]:
        apart = circle_residual(parameters, offset, problem) / self.sigma
        own = (problem.mask * offset / self.offset_sd)[:, None]
        return jnp.concatenate([apart, own], axis=1)

    def start(self, parameters: Parameters, problem: Problem) -> Float[Array, " n"]:
        return jnp.zeros_like(problem.mask)

    def limit(self, parameters: Parameters, problem: Problem) -> Float[Array, " n"]:
        return LARGEST_ELEVATION * jnp.abs(measured_points(parameters, problem)[:, 1])

    def elevation(
        self, parameters: Parameters, offset: Float[Array, " n"], problem: Problem
    ) -> Float[Array, " n"]:
        return problem.mask * offset

    def largest_weight(self) -> Float[Array, ""]:
        return 1 / jnp.minimum(jnp.min(self.sigma), self.offset_sd)


class AbstractSelfTuned(AbstractPrior):
    """A Gaussian belief whose SDs can be estimated from the residuals (REML).

    Attributes:
        sigma: SD of each component, mm.
    """

    sigma: eqx.AbstractVar[Float[Array, " components"]]

    @abc.abstractmethod
    def columns(self, problem: Problem) -> tuple[slice, ...]:
        """Which columns of the residual each component of ``sigma`` whitens."""

    @abc.abstractmethod
    def count(self, problem: Problem) -> Float[Array, " components"]:
        """How many residuals of each component there are."""

    def with_sigma(self, sigma: Float[Array, " components"]) -> AbstractSelfTuned:
        """The same belief with other SDs."""
        return eqx.tree_at(lambda prior: prior.sigma, self, sigma)

    def largest_weight(self) -> Float[Array, ""]:
        return 1 / jnp.min(self.sigma)


class Gaussian(AbstractSelfTuned):
    """Independent Gaussian errors of lateral position, range and elevational offset.

    Without tracker noise y_i is q_iy itself, so the offsets are eliminated exactly and no offset
    unknown is left. With tracker noise of SD tau on each axis the offset unknown u_i is the
    tracker's elevational error in units of tau, y_i = q_iy + tau u_i: unlike y_i itself it stays
    well scaled as tau goes to 0.

    Attributes:
        sigma: (3,) SDs of lateral position, range and elevational offset, mm.
        covariance: (n, 2, 2) shape of the measurement covariance, mean diagonal (1, 1), or None.
        tracker_sd: tau, mm, or None.
        medium_sd: SDs of sound speed (relative) and delay (mm) about their nominal values, or None.
    """

    sigma: Float[Array, 3]
    covariance: Float[Array, "n 2 2"] | None = None
    tracker_sd: Float[Array, ""] | None = None
    medium_sd: Float[Array, 2] | None = None

    def residual(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, "n columns"]:
        tau = self.tracker_sd
        shift = None if tau is None else tau * offset
        values = measurement_residual(parameters, problem, shift)
        sigma = self.sigma
        if tau is not None:
            extra = jnp.stack([tau, tau, jnp.zeros_like(tau)])
            sigma = jnp.hypot(self.sigma, extra)
        parts = [whiten(values / sigma, self.covariance)]
        if tau is not None:
            parts.append((problem.mask * offset)[:, None])
        if self.medium_sd is not None:
            parts.append(medium_residual(parameters, self.medium_sd, problem))
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=1)

    def columns(self, problem: Problem) -> tuple[slice, ...]:
        return (slice(0, 1), slice(1, 2), slice(2, 3))

    def count(self, problem: Problem) -> Float[Array, 3]:
        return jnp.full(3, jnp.sum(problem.mask))

    def start(self, parameters: Parameters, problem: Problem) -> Float[Array, " k"]:
        count = 0 if self.tracker_sd is None else problem.images
        return jnp.zeros(count, problem.mask.dtype)

    def elevation(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, " n"]:
        q = target_in_image(parameters, problem)[:, 1]
        if self.tracker_sd is None:
            return problem.mask * q
        return problem.mask * (q + self.tracker_sd * offset)


class ChannelGaussian(AbstractSelfTuned):
    """Independent Gaussian errors of every element's distance, and Gaussian offsets.

    On a curvilinear probe each image's distances say something of |y_i|, through Eq. 6, and nothing
    of its sign; poses that share one X and one target settle the signs.

    Attributes:
        sigma: (2,) SDs of an element's distance and of the elevational offset, mm.
        medium_sd: SDs of sound speed (relative) and delay (mm) about their nominal values, or None.
    """

    sigma: Float[Array, 2]
    medium_sd: Float[Array, 2] | None = None

    def residual(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, "n columns"]:
        distances = channel_residual(parameters, channels_of(problem), problem) / self.sigma[0]
        elevation = self.elevation(parameters, offset, problem)[:, None] / self.sigma[1]
        parts = [distances, elevation]
        if self.medium_sd is not None:
            parts.append(medium_residual(parameters, self.medium_sd, problem))
        return jnp.concatenate(parts, axis=1)

    def columns(self, problem: Problem) -> tuple[slice, ...]:
        elements = channels_of(problem).distances.shape[-1]
        return (slice(0, elements), slice(elements, elements + 1))

    def count(self, problem: Problem) -> Float[Array, 2]:
        heard = jnp.sum(problem.mask[:, None] * channels_of(problem).heard)
        return jnp.stack([heard, jnp.sum(problem.mask)])

    def elevation(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, " n"]:
        return problem.mask * target_in_image(parameters, problem)[:, 1]


def medium_residual(
    parameters: Parameters, medium_sd: Float[Array, 2], problem: Problem
) -> Float[Array, "n 2"]:
    """How far sound speed and delay are from nominal, in SDs; the images share it equally."""
    off = jnp.stack([jnp.log(parameters.sound_speed), parameters.delay]) / medium_sd
    # Rows are images, and each sees the shared unknowns: n n-th parts make the whole belief.
    return (problem.mask / jnp.sqrt(jnp.sum(problem.mask)))[:, None] * off


def channels_of(problem: Problem) -> Channels:
    """The problem's channels.

    Raises:
        InputError: where it has none.
    """
    if problem.channels is None:
        raise InputError("this problem has no times of flight: there are no channels to solve on")
    return problem.channels


def whiten(
    standardised: Float[Array, "n 3"], covariance: Float[Array, "n 2 2"] | None
) -> Float[Array, "n 3"]:
    """Decorrelate the lateral and range residuals of every image by its covariance's shape."""
    if covariance is None:
        return standardised
    # The 2x2 Cholesky written out: per-image LAPACK calls would dominate a batch.
    first = jnp.sqrt(covariance[:, 0, 0])
    mixed = covariance[:, 1, 0] / first
    second = jnp.sqrt(covariance[:, 1, 1] - mixed**2)
    lateral = standardised[:, 0] / first
    distance = (standardised[:, 1] - mixed * lateral) / second
    return jnp.stack([lateral, distance, standardised[:, 2]], axis=1)


def covariance_shape(problem: Problem) -> Float[Array, "n 2 2"] | None:
    """The problem's covariances scaled so that the used images' mean variances are 1, or None."""
    if problem.covariance is None:
        return None
    variances = jnp.diagonal(problem.covariance, axis1=-2, axis2=-1)
    weight = problem.mask[:, None]
    mean = jnp.sum(weight * variances, axis=0) / jnp.sum(weight)
    # Covariances of zero (exact data) have no shape.
    scale = 1 / jnp.sqrt(jnp.where(mean > 0, mean, 1.0))
    shape = problem.covariance * scale[:, None] * scale[None, :]
    return jnp.where(jnp.all(mean > 0), shape, jnp.eye(2, dtype=shape.dtype))
