"""Covariance and observability of many solutions: :mod:`jaxcal.uncertainty` for a batch.

That module is the reference and says what everything means. Here one reduction over the images
gives the information matrices, and of their spectra only the two ends are computed
(:mod:`jaxcal.solvers.spectra`). Whether a matrix is singular is first asked of a bound that costs
nothing, l_min / l_max >= 1 / (tr A tr A^-1); only where it does not tell, the spectrum is taken,
and a study normally has no such lane.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxcal.model.priors import AbstractPrior, Bounded, Gaussian
from jaxcal.model.residuals import LARGEST_ELEVATION
from jaxcal.solvers import dense, spectra, unrolled
from jaxcal.solvers.fused import UNKNOWNS
from jaxcal.solvers.lanes import apart
from jaxcal.solvers.unrolled import Matrix, Vector
from jaxcal.solvers.views import View, variance
from jaxcal.uncertainty import SINGULAR, one_of_many

SURE = 2.0
"""How far above the threshold a bound has to be to count."""


class Resting(eqx.Module):
    """The bounded offsets' part, in planes; see :class:`jaxcal.solvers.arrow.Arrow`.

    Attributes:
        free: 0 where an offset rests on its bound. slope: y / z of the measured point.
        diagonal: D_i. force: d_i. errors: q - p. gap: distance to the bound, mm.
    """

    free: Float[Array, "lanes n"]
    slope: Float[Array, "lanes n"]
    diagonal: Float[Array, "lanes n"]
    force: Float[Array, "lanes n"]
    errors: Vector
    gap: Float[Array, "lanes n"]

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
        return cls(free, slope, 1 + slope * slope, force, errors, jnp.abs(limit - jnp.abs(y)))

    def weight(self, mask: Float[Array, "lanes n"]) -> Matrix:
        """K of the information that is left of an image when its offset is eliminated."""
        out = mask * self.free / self.diagonal
        return [
            [mask, 0, 0],
            [0, mask - out, out * self.slope],
            [0, out * self.slope, mask - out * self.slope * self.slope],
        ]

    def row(self, view: View) -> Vector:
        """How an image's residual along its own offset moves with the unknowns."""
        elevation = view.rows()[2]
        return [
            unrolled.add(unrolled.times(-1, y), unrolled.times(self.slope, z))
            for y, z in zip(elevation, view.axial_row(), strict=True)
        ]


def whitened(view: View, prior: Gaussian) -> tuple[Vector, list[Vector], Matrix]:
    """A Gaussian belief's whitened errors, their rows, and K, all in planes."""
    mask = view.images.mask
    inverse = [(1 / sd)[:, None] for sd in prior.sigma.T]
    lateral, distance, offset = view.rows()
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
    weight = view.curvature(
        mask * (a * a + (mixed * a) ** 2), mask * b * b, mask * inverse[2] ** 2, cross
    )
    errors = [view.errors[0] * a, view.errors[1] * b, view.errors[2] * inverse[2]]
    rows = [_scaled(lateral, a), _scaled(distance, b), _scaled(offset, inverse[2])]
    if prior.covariance is not None:
        errors[1] = errors[1] - mixed * errors[0]
        rows[1] = [
            unrolled.add(r, unrolled.times(-mixed, x))
            for r, x in zip(rows[1], rows[0], strict=True)
        ]
    return errors, rows, weight


def _scaled(row: Vector, by: Array) -> Vector:
    return [unrolled.times(by, entry) for entry in row]


class Ends(eqx.Module):
    """The ends of the spectrum of the information, in scaled units, and what follows."""

    smallest: Float[Array, " lanes"]
    biggest: Float[Array, " lanes"]
    weakest: Float[Array, "9 lanes"]
    singular: Bool[Array, " lanes"]
    degenerate: Bool[Array, " lanes"]


def unit_inverse(
    matrices: list[Float[Array, "9 9 lanes"]], diagonals: list[Float[Array, "9 lanes"]]
) -> list[Float[Array, "9 9 lanes"]]:
    """The matrices' inverses, side by side; as :func:`jaxcal.solvers.arrow.inverse_symmetric`."""
    count = len(matrices)
    diagonal = jnp.concatenate(diagonals, axis=-1)
    scale = apart(jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1.0)))
    ridge = 16 * jnp.finfo(scale.dtype).eps * jnp.eye(UNKNOWNS, dtype=scale.dtype)
    both = scale[:, None] * scale[None]
    scaled = jnp.concatenate(matrices, axis=-1) * both + ridge[..., None]
    return jnp.split(spectra.inverses(apart(scaled)) * both, count, axis=-1)


def ends(
    information: Float[Array, "9 9 lanes"],
    inverse: Float[Array, "9 9 lanes"],
    design: Float[Array, "9 9 lanes"],
    design_inverse: Float[Array, "9 9 lanes"],
    scale: Float[Array, "9 lanes"],
) -> Ends:
    """The two ends of the information, and whether it or the design is singular.

    Args:
        information: with the offsets eliminated.
        inverse: its inverse.
        design: the unweighted information, offsets known.
        design_inverse: its inverse.
        scale: what makes every unknown's tangent mm at the target.
    """
    eps = jnp.finfo(scale.dtype).eps
    threshold = max(SINGULAR, 100 * float(eps))
    both = scale[:, None] * scale[None]
    information, inverse, design, design_inverse = apart(
        (information / both, inverse * both, design / both, design_inverse * both)
    )
    pairs = ((information, inverse), (design, design_inverse))
    bounds = [1 / (_trace(matrix) * _trace(back)) for matrix, back in pairs]
    # NaN is not sure of anything.
    sure = (bounds[0] > SURE * threshold) & (bounds[1] > SURE * threshold)
    found = spectra.largest(jnp.concatenate([information, inverse], axis=-1))
    biggest, top = jnp.split(found.value, 2)
    _, vector = jnp.split(found.vector, 2, axis=-1)
    no = jnp.zeros_like(sure)
    quick = Ends(jnp.maximum(1 / top, eps * biggest), biggest, vector, no, no)

    def exact() -> Ends:
        together = jnp.concatenate([information, design], axis=-1)
        both = jax.vmap(dense.singular_values, in_axes=-1, out_axes=-1)(together)
        spectrum, plain = (
            jax.tree.map(lambda leaf, k=k: jnp.split(leaf, 2, axis=-1)[k], both) for k in range(2)
        )
        null = plain.values < threshold * plain.values[-1]
        unseen = jax.vmap(one_of_many, in_axes=-1, out_axes=-1)(plain.right, null)
        degenerate = null[0]
        smallest, biggest = spectrum.values[0], spectrum.values[-1]
        thorough = Ends(
            smallest=jnp.maximum(smallest, eps * biggest),
            biggest=biggest,
            weakest=jnp.where(degenerate, unseen, spectrum.right[:, 0]),
            singular=smallest < threshold * biggest,
            degenerate=degenerate,
        )
        return jax.tree.map(lambda a, b: jnp.where(sure, a, b), quick, thorough)

    return jax.lax.cond(jnp.all(sure), lambda: quick, exact)


def _trace(matrix: Float[Array, "9 9 lanes"]) -> Float[Array, " lanes"]:
    return sum((matrix[k, k] for k in range(1, UNKNOWNS)), matrix[0, 0])


def elevation_variance(
    view: View,
    prior: AbstractPrior,
    resting: Resting | None,
    inverse: Float[Array, "9 9 lanes"],
) -> Float[Array, "lanes n"]:
    """Variance of every y_i at unit variance of the residuals."""
    if resting is None:
        return variance(inverse, view.rows()[2])
    assert isinstance(prior, Bounded)
    through = variance(inverse, resting.row(view))
    return (through / resting.diagonal + 1) / resting.diagonal
