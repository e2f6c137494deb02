"""Eq. 7 with the target and the image's origin eliminated, for many problems at once.

With r1 and r3 the lateral and axial columns of X's rotation, B_i X p_i = c of Eq. 7 is linear in
(a1, a3, t, c) with a1 = s1 r1 and a3 = s3 r3:

    R_i (u_i a1 + v_i a3 + t) + b_i - c = 0,         3 n equations, 12 unknowns,

whether the pixel scales s are known or not: unknown scales are |a1| and |a3|. The images enter by
sums only: the normal matrix of the 12 unknowns consists of sums of u, v, their products and the
rotations. For one problem :mod:`jaxcal.solvers.closed_form.reduced_objective` does the same by
orthogonal transformations, which keep twice as many digits and need no JAX.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.model import unrolled
from jaxcal.model.batch import ImagePlanes, barrier, total
from jaxcal.solvers import dense


class ReducedBatch(eqx.Module):
    """Normal equations of (a1, a3), and how t and c follow from them; batch axis last.

    Half of Eq. 7 is a'Qa / 2 - b'a and a constant, a = (a1, a3) in the probe's frame; points and
    pose origins are relative to their means.

    Attributes:
        count: used images.
        mean: of lateral position and range, mm.
        face: range of pixel row 0, mm; the mean range includes it.
        centre: of the poses' origins, mm.
        matrix: Q.
        rhs: b.
        squares: sums of squares of lateral position and range, mm^2.
        moments: sums of lateral times R_i and of range times R_i, side by side, mm.
        rotation: sum of R_i.
        centre_in_probes: sum of R_i'(centre - b_i), the centre in the probes' frames, mm.
        origin_covariance: covariance of t for errors of variance 1, c eliminated.
        smallest_pivot: smallest share of t's diagonal entries that is left when c and the rest of
            t are eliminated.
    """

    count: Float[Array, " batch"]
    mean: Float[Array, "2 batch"]
    face: Float[Array, " batch"]
    centre: Float[Array, "3 batch"]
    matrix: Float[Array, "6 6 batch"]
    rhs: Float[Array, "6 batch"]
    squares: Float[Array, "2 batch"]
    moments: Float[Array, "3 6 batch"]
    rotation: Float[Array, "3 3 batch"]
    centre_in_probes: Float[Array, "3 batch"]
    origin_covariance: Float[Array, "3 3 batch"]
    smallest_pivot: Float[Array, " batch"]

    @classmethod
    def of(cls, images: ImagePlanes, ridge: float = 0.0) -> ReducedBatch:
        """Two passes over the images: the means, and the rest.

        Args:
            images: the data.
            ridge: share by which the diagonal of t's normal matrix is enlarged, so that it is not
                singular where all rotations share an axis.
        """
        count = images.used
        points = [images.lateral, images.distance]
        mean = [jnp.sum(images.mask * plane, axis=1) / count for plane in points]
        centre = [jnp.sum(images.mask * plane, axis=1) / count for plane in images.origin]
        x, z = (images.mask * (p - m[:, None]) for p, m in zip(points, mean, strict=True))
        away = [c[:, None] - plane for plane, c in zip(images.origin, centre, strict=True)]
        turn = [[images.rotation[3 * i + j] for j in range(3)] for i in range(3)]
        back = unrolled.apply(unrolled.transpose(turn), away)
        planes = [x * x, x * z, z * z]
        for weight in (x, z, images.mask):
            planes += [weight * entry for row in turn for entry in row]
            planes += [weight * entry for entry in back]
        sums = barrier(unrolled.as_array(total(planes)))
        parts = sums[3:].reshape(3, 12, -1)
        lateral, axial, rotation = parts[:, :9].reshape(3, 3, 3, -1)
        moments = jnp.concatenate([lateral, axial], axis=1)

        # c is the mean of B_i X p_i; then t.
        def squared(first: Array, second: Array) -> Array:
            return dense.product_batch_last(jnp.swapaxes(first, 0, 1), second) / count

        eye = jnp.eye(3, dtype=x.dtype)[..., None]
        own = barrier(count * (1 + ridge) * eye - squared(rotation, rotation))
        origin_covariance, _ = dense.inverse_batch_last(own)
        mixed = squared(rotation, moments)
        follows = barrier(dense.product_batch_last(origin_covariance, mixed))
        back_from_t = jnp.swapaxes(mixed, 0, 1)
        # S (x) I: sums of squares and products of the points' coordinates.
        square = jnp.stack([jnp.stack(sums[:2]), jnp.stack(sums[1:3])])
        whole = square[:, None, :, None] * eye[None, :, None]
        matrix = whole.reshape(6, 6, -1) - squared(moments, moments)
        matrix = barrier(matrix - dense.product_batch_last(back_from_t, follows))
        centre_in_probes = parts[2, 9:]
        rhs = parts[:2, 9:].reshape(6, -1)
        rhs = rhs + dense.product_batch_last(jnp.swapaxes(follows, 0, 1), centre_in_probes)
        squares = jnp.stack([sums[0], sums[2]])
        left = jnp.stack([count * origin_covariance[k, k] for k in range(3)])
        return cls(
            count,
            jnp.stack(mean),
            images.face,
            jnp.stack(centre),
            matrix,
            rhs,
            squares,
            moments,
            rotation,
            centre_in_probes,
            origin_covariance,
            1 / jnp.max(left, axis=0),
        )

    def origin_and_target(
        self, columns: Float[Array, "6 batch"]
    ) -> tuple[Float[Array, "3 batch"], Float[Array, "3 batch"]]:
        """What follows from (a1, a3).

        Args:
            columns: a1 above a3.

        Returns:
            The mean point in the probe's frame and the target less ``centre`` in the tracker's, mm.
        """
        seen = dense.product_batch_last(self.moments, columns)
        pull = dense.product_batch_last(jnp.swapaxes(self.rotation, 0, 1), seen) / self.count
        of_mean = barrier(
            dense.product_batch_last(self.origin_covariance, self.centre_in_probes + pull)
        )
        return of_mean, (seen + dense.product_batch_last(self.rotation, of_mean)) / self.count
