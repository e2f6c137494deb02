"""What many solutions say of every image, in planes (lanes, images): errors, their rows, leverage.

The rows are those of the Jacobian of one image's lateral error, range error and offset with
respect to the nine unknowns (v, w, d), as in :mod:`jaxcal.solvers.fused`; a quadratic form of a row
with the inverse of an information matrix is a leverage, or the variance of what the row tells.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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

    def rows(self) -> tuple[Vector, Vector, Vector]:
        """Derivatives of lateral position, range and offset."""
        lever = unrolled.cross(self.q)
        axes = [
            [*(-1 if i == j else 0 for j in range(3)), *lever[i], *self.turned[i]] for i in range(3)
        ]
        distance = [
            unrolled.add(unrolled.times(self.along[0], y), unrolled.times(self.along[1], z))
            for y, z in zip(axes[1], axes[2], strict=True)
        ]
        return axes[0], distance, axes[1]

    def axial_row(self) -> Vector:
        """Derivatives of q_z."""
        lever = unrolled.cross(self.q)
        return [0, 0, -1, *lever[2], *self.turned[2]]

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


def variance(matrix: Float[Array, "9 9 lanes"], row: Vector) -> Float[Array, "lanes n"]:
    """Quadratic form r' C r of every image's row r."""
    wide = [[matrix[i, j][:, None] for j in range(UNKNOWNS)] for i in range(UNKNOWNS)]
    # Each pair of different unknowns counts twice.
    terms = []
    for i in range(UNKNOWNS):
        later = unrolled.dot(wide[i][i + 1 :], row[i + 1 :])
        own = unrolled.times(wide[i][i], row[i])
        inner = unrolled.add(own, unrolled.times(2, later))
        terms.append(unrolled.times(inner, row[i]))
    return unrolled.add(*terms)
