"""Information matrices of many solutions, from planes (lanes, images)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.model.priors import AbstractPrior, Bounded, Gaussian
from jaxcal.model.residuals import LARGEST_ELEVATION
from jaxcal.solvers import unrolled
from jaxcal.solvers.fused import (
    PAIRS,
    UNKNOWNS,
    Guess,
    Images,
    Term,
    contributions,
    targets,
    total,
)
from jaxcal.solvers.lanes import apart
from jaxcal.solvers.unrolled import Entry, Matrix, Vector

PLACE = np.array(
    [[PAIRS.index((min(i, j), max(i, j))) for j in range(UNKNOWNS)] for i in range(UNKNOWNS)]
)
"""Where the entries of a full matrix are in its upper triangle."""


class View(eqx.Module):
    """The images as seen from the solutions.

    Attributes:
        images: the data.
        q: the target in every image. turned: M_i.
        along: of q_y and q_z, the derivative of the range.
        errors: lateral, range and elevational, mm; 0 for images that are left out.
    """

    images: Images
    q: Vector
    turned: Matrix
    along: Vector
    errors: Vector

    @classmethod
    def of(cls, guess: Guess, images: Images) -> View:
        """From the solutions X and c."""
        q, turned = targets(guess, images)
        square = q[1] * q[1] + q[2] * q[2]
        inverse = jax.lax.rsqrt(square)
        errors = [q[0] - images.lateral, square * inverse - images.distance, q[1]]
        errors = [images.mask * error for error in errors]
        return cls(images, q, turned, [q[1] * inverse, q[2] * inverse], errors)

    def information(self, weights: list[Matrix]) -> list[Float[Array, "9 9 lanes"]]:
        """J' K J, summed over the images, for several K, of :meth:`curvature` or likewise.

        They share one program, on planes (kinds, lanes, images): half as much to compile.
        """
        zero = jnp.zeros_like(self.images.mask)

        def kinds(i: int, j: int) -> Entry:
            entries = [weight[i][j] for weight in weights]
            if all(unrolled.is_zero(entry) for entry in entries):
                return 0
            full = [zero if unrolled.is_zero(entry) else entry for entry in entries]
            return apart(jnp.stack(full))

        upper = [[kinds(min(i, j), max(i, j)) for j in range(3)] for i in range(3)]
        stacked = Term(self.images.mask, [0, 0, 0], upper)
        flat = contributions(self.q, self.turned, stacked, 0)[0]
        sums = apart(jnp.stack(total(flat)))[PLACE]
        return [sums[:, :, k] for k in range(len(weights))]

    def curvature(self, lateral: Array, distance: Array, offset: Array, mixed: Entry = 0) -> Matrix:
        """K of weights on lateral position, range (with that between both) and offset."""
        a, b = self.along
        return [
            [lateral, unrolled.times(mixed, a), unrolled.times(mixed, b)],
            [unrolled.times(mixed, a), distance * a * a + offset, distance * a * b],
            [unrolled.times(mixed, b), distance * a * b, distance * b * b],
        ]


def matrices(
    guess: Guess, images: Images, prior: AbstractPrior, y: Float[Array, "lanes k"]
) -> tuple[Float[Array, "lanes 9 9"], Float[Array, "lanes 9 9"]]:
    """The information with the offsets eliminated, and the unweighted design.

    Args:
        guess: the solutions.
        images: the data.
        prior: the objective.
        y: bounded offsets, mm; of no use otherwise.
    """
    view, mask = View.of(guess, images), images.mask
    weights: list[Matrix] = [[[mask if i == j else 0 for j in range(3)] for i in range(3)]]
    if isinstance(prior, Gaussian):
        weights.append(_gaussian_weight(view, prior))
    elif isinstance(prior, Bounded):
        weights.append(Resting.of(view, prior.bound, y).weight(mask))
    found = [jnp.moveaxis(matrix, -1, 0) for matrix in view.information(weights)]
    return found[-1], found[0]


class Resting(eqx.Module):
    """The bounded offsets' part, in planes; see :class:`jaxcal.solvers.arrow.Arrow`.

    Attributes:
        free: 0 where an offset rests on its bound.
        slope: y / z of the measured point.
        diagonal: D_i.
    """

    free: Float[Array, "lanes n"]
    slope: Float[Array, "lanes n"]
    diagonal: Float[Array, "lanes n"]

    @classmethod
    def of(cls, view: View, bound: Float[Array, "lanes n"], y: Float[Array, "lanes n"]) -> Resting:
        """At offsets y, mm."""
        distance, mask = view.images.distance, view.images.mask
        axial = jnp.sqrt(jnp.maximum(distance**2 - y**2, (1e-6 * distance) ** 2))
        slope = y / axial
        errors = [view.q[0] - view.images.lateral, view.q[1] - y, view.q[2] - axial]
        errors = [mask * error for error in errors]
        force = slope * errors[2] - errors[1]
        limit = jnp.minimum(bound, LARGEST_ELEVATION * jnp.abs(distance))
        held = ((y >= limit) & (force <= 0)) | ((y <= -limit) & (force >= 0))
        free = jnp.where(held, 0.0, 1.0).astype(mask.dtype)
        return cls(free, slope, 1 + slope * slope)

    def weight(self, mask: Float[Array, "lanes n"]) -> Matrix:
        """K of the information that is left of an image when its offset is eliminated."""
        out = mask * self.free / self.diagonal
        return [
            [mask, 0, 0],
            [0, mask - out, out * self.slope],
            [0, out * self.slope, mask - out * self.slope * self.slope],
        ]


def _gaussian_weight(view: View, prior: Gaussian) -> Matrix:
    """K of a Gaussian belief, in planes."""
    mask = view.images.mask
    inverse = [(1 / sd)[:, None] for sd in prior.sigma.T]
    if prior.covariance is None:
        first, second, mixed = jnp.ones_like(mask), jnp.ones_like(mask), jnp.zeros_like(mask)
        cross = 0
    else:
        used = mask > 0
        c = prior.covariance
        first = 1 / jnp.sqrt(jnp.where(used, c[..., 0, 0], 1.0))
        mixed = jnp.where(used, c[..., 1, 0], 0.0) * first
        second = 1 / jnp.sqrt(jnp.where(used, c[..., 1, 1], 1.0) - mixed * mixed)
        cross = -mask * mixed * first * second * second * inverse[0] * inverse[1]
    a, b = first * inverse[0], second * inverse[1]
    mixed = mixed * second
    return view.curvature(
        mask * (a * a + (mixed * a) ** 2), mask * b * b, mask * inverse[2] ** 2, cross
    )
