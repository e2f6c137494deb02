"""What is believed of the elevational offsets, each belief a piece of the joint least squares.

A prior turns (unknowns, offset unknowns) into residuals and says how its offset unknown relates to
the elevational offset y_i; the joint solver needs no more than :class:`AbstractPrior`.

Bounded is the paper's belief, |y_i| <= m_i with everything else weighted alike. Gaussian is
y_i ~ N(0, sigma_elevation^2) beside N(0, sigma^2) errors of the lateral position and range.
"""

from __future__ import annotations

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.model.parameters import Parameters
from jaxcal.model.residuals import (
    LARGEST_ELEVATION,
    circle_residual,
    closest_elevation,
    measured_points,
    measurement_residual,
    target_in_image,
)
from jaxcal.problem import Problem


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


class Gaussian(AbstractPrior):
    """Independent Gaussian errors of lateral position, range and elevational offset.

    Without tracker noise y_i is q_iy itself, so the offsets are eliminated exactly and no offset
    unknown is left. With tracker noise of SD tau on each axis the offset unknown u_i is the
    tracker's elevational error in units of tau, y_i = q_iy + tau u_i: unlike y_i itself it stays
    well scaled as tau goes to 0.

    Attributes:
        sigma: (3,) SDs of lateral position, range and elevational offset, mm.
        covariance: (n, 2, 2) shape of the measurement covariance, mean diagonal (1, 1), or None.
        tracker_sd: tau, mm, or None.
    """

    sigma: Float[Array, 3]
    covariance: Float[Array, "n 2 2"] | None = None
    tracker_sd: Float[Array, ""] | None = None

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
        whitened = whiten(values / sigma, self.covariance)
        if tau is None:
            return whitened
        return jnp.concatenate([whitened, (problem.mask * offset)[:, None]], axis=1)

    def start(self, parameters: Parameters, problem: Problem) -> Float[Array, " k"]:
        count = 0 if self.tracker_sd is None else problem.images
        return jnp.zeros(count, problem.mask.dtype)

    def largest_weight(self) -> Float[Array, ""]:
        return 1 / jnp.min(self.sigma)

    def elevation(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, " n"]:
        q = target_in_image(parameters, problem)[:, 1]
        if self.tracker_sd is None:
            return problem.mask * q
        return problem.mask * (q + self.tracker_sd * offset)


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
    scale = 1 / jnp.sqrt(mean)
    return problem.covariance * scale[:, None] * scale[None, :]
