"""A second look at many solutions, lanes last: :mod:`jaxcal.inspection` for a batch.

That module, and :mod:`jaxcal.solvers.consensus` for the departures, are the reference and say what
everything means. Here everything that is summed over the images is summed in a few reductions, and
of the candidate images to add only what the weakest direction does there is computed.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.inspection import (
    FEWEST_TO_CHECK,
    SIDEWAYS_MM,
    TILT_RAD,
    kurtosis_score,
    skewness_score,
)
from jaxcal.solvers import unrolled
from jaxcal.solvers.consensus import HALVINGS, MAD, RELATIVE_FLOOR
from jaxcal.solvers.fused import UNKNOWNS, Guess, Images, total
from jaxcal.solvers.lanes import apart
from jaxcal.solvers.unrolled import Matrix, Vector
from jaxcal.solvers.views import View, variance


def medians(
    values: Float[Array, "k lanes n"], weight: Float[Array, "lanes n"]
) -> Float[Array, "k lanes"]:
    """Weighted medians, by the bisection of :func:`jaxcal.solvers.consensus.quantile`."""
    values = apart(jnp.where(jnp.isnan(values), jnp.inf, values))
    wanted = 0.5 * jnp.sum(weight, axis=1)
    finite = jnp.where((weight > 0) & jnp.isfinite(values), values, 0.0)
    high = apart(jnp.max(finite, axis=2))

    def reached(limit: Float[Array, "k lanes"]) -> Array:
        return jnp.sum(jnp.where(values <= limit[..., None], weight, 0.0), axis=2) >= wanted

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = apart(jnp.where(low > 1e-3 * high, 0.5 * (low + high), 0.03 * high))
        enough = apart(reached(middle))
        return jnp.where(enough, low, middle), jnp.where(enough, middle, high)

    found = jax.lax.fori_loop(0, HALVINGS, halve, (jnp.zeros_like(high), high))[1]
    return jnp.where(reached(high), found, jnp.inf)


class Steadied(eqx.Module):
    """Robust SDs of the errors, lateral ones divided by how much deeper than usual an image is.

    Attributes:
        by: what an image's lateral error is divided by. sigma: robust SDs, mm.
    """

    by: Float[Array, "lanes n"]
    sigma: Float[Array, "3 lanes"]

    @classmethod
    def of(cls, view: View, keep: Float[Array, "lanes n"]) -> Steadied:
        """From the errors of the kept images."""
        images = view.images
        usual = medians(images.distance[None], images.mask)[0]
        by = jnp.maximum(images.distance * (1 / usual)[:, None], 1.0)
        by = jnp.where(images.mask > 0, by, 1.0)
        lateral, distance, offset = view.errors
        sizes = jnp.abs(jnp.stack([lateral / by, distance, offset]))
        freedom = jnp.maximum(1 - UNKNOWNS / (3 * jnp.sum(keep, axis=1)), 0.1)
        sigma = MAD * medians(sizes, keep) / jnp.sqrt(freedom)
        least = jnp.maximum(RELATIVE_FLOOR * jnp.max(sigma, axis=0), 1e-6)
        return cls(*apart((by, jnp.maximum(sigma, least))))

    def weight(self, view: View, keep: Float[Array, "lanes n"]) -> Matrix:
        """K of the kept images' information."""
        inverse = (1 / self.sigma**2)[..., None]
        return view.curvature(keep * inverse[0] / self.by**2, keep * inverse[1], keep * inverse[2])

    def departures(
        self, view: View, keep: Float[Array, "lanes n"], inverse: Float[Array, "9 9 lanes"]
    ) -> Float[Array, "lanes n 3"]:
        """Errors in SDs, each image's leverage allowed for."""
        lateral, distance, offset = view.rows()
        lateral = [unrolled.times(1 / self.by, entry) for entry in lateral]
        errors = [view.errors[0] / self.by, *view.errors[1:]]
        found = []
        for error, row, sd in zip(errors, (lateral, distance, offset), self.sigma, strict=True):
            one = (1 / sd)[:, None]
            leverage = variance(inverse, row) * one * one
            left = jnp.where(keep > 0, jnp.maximum(1 - leverage, 0.05), 1 + leverage)
            found.append(error * one * jax.lax.rsqrt(left))
        return jnp.stack(apart(found), axis=-1)


def check_noise_model(
    residual: Vector, images: Images
) -> tuple[Float[Array, "lanes 3"], Float[Array, "lanes 4 3"]]:
    """Kurtosis and scores of standardised residuals (planes; 0 where an image is left out)."""
    mask, count = images.mask, images.used
    residual = [*apart(residual)]
    means = apart(jnp.stack(total([*residual, mask * images.distance])) / count)
    centred = [mask * (r - m[:, None]) for r, m in zip(residual, means[:3], strict=True)]
    distance = mask * (images.distance - means[3][:, None])
    *centred, distance = apart([*centred, distance])

    def before(plane: Float[Array, "lanes n"]) -> Float[Array, "lanes n"]:
        return jnp.pad(plane[:, :-1], ((0, 0), (1, 0)))

    size = [jnp.abs(c) for c in centred]
    previous = apart([before(plane) for plane in (*centred, mask)])
    planes: Vector = [distance * distance, distance, mask * previous[3]]
    for c, a, p in zip(centred, size, previous[:3], strict=True):
        square = c * c
        planes += [square, a, square * c, square * square, distance * a, c * p]
    sums = apart(jnp.stack(total(planes)))
    deep, tilt, both = sums[:3]
    squares, sizes, cubes, fourths, together, successive = jnp.moveaxis(
        sums[3:].reshape(3, 6, -1), 1, 0
    )
    second = squares / count
    inverse = jax.lax.rsqrt(jnp.where(second > 0, second, 1.0))
    kurtosis = fourths / count * inverse**4
    tails = jax.vmap(kurtosis_score, in_axes=-1, out_axes=-1)(kurtosis, count)
    skewed = jax.vmap(skewness_score, in_axes=-1, out_axes=-1)(cubes / count * inverse**3, count)
    spread = jnp.maximum(squares - sizes * sizes / count, 0.0)
    lengths = jnp.sqrt(deep * spread)
    joint = together - tilt * sizes / count
    deeper = joint / jnp.where(lengths > 0, lengths, 1.0) * jnp.sqrt(count - 1)
    drift = successive * inverse**2 / jnp.sqrt(jnp.maximum(both, 1.0))
    scores = jnp.stack([tails, skewed, deeper, drift])
    judged = (count >= FEWEST_TO_CHECK) & jnp.isfinite(scores) & (second > 0)
    return kurtosis.T, jnp.moveaxis(jnp.where(judged, scores, 0.0), -1, 0)


def usual_rotation(mean: Float[Array, "9 lanes"], images: Images) -> Matrix:
    """The rotation of the used image nearest to the mean of all."""
    planes = unrolled.rows_of(images.rotation)
    closeness = sum((p * m[:, None] for p, m in zip(planes[1:], mean[1:], strict=True)),
                    planes[0] * mean[0][:, None])  # fmt: skip
    closest = jnp.argmax(jnp.where(images.mask > 0, closeness, -jnp.inf), axis=1)
    here = (jnp.arange(images.mask.shape[1]) == apart(closest)[:, None]).astype(mean.dtype)
    flat = total([here * plane for plane in planes])
    return [flat[3 * i : 3 * i + 3] for i in range(3)]


def gains(
    guess: Guess,
    usual: Matrix,
    middle: Vector,
    sigma: Float[Array, "3 lanes"],
    tangent: Float[Array, "9 lanes"],
) -> Float[Array, "lanes 5"]:
    """SDs by which an image of each kind would notice a step along a direction.

    An image whose pose puts the target at p = (x, 0, z) sees q = p move by -v + p x w + M d, whose
    components are lateral error, offset and range error; a tilt T of the probe turns M into T' M.

    Args:
        guess: the solutions.
        usual: rotation of the pose to start from.
        middle: mean lateral position and range of the used images, mm.
        sigma: SDs of lateral position, range and offset, mm.
        tangent: the direction, mm and rad.
    """
    v, w, d = (unrolled.rows_of(tangent[3 * k : 3 * k + 3]) for k in range(3))
    own = [unrolled.rows_of(row) for row in guess.rotation]
    seen = unrolled.apply(unrolled.transpose(own), unrolled.apply(unrolled.transpose(usual), d))
    inverse = 1 / jnp.maximum(sigma, 1e-9)

    def noticed(place: Vector, shift: Vector) -> Array:
        x, z = place
        turned = unrolled.apply(unrolled.cross([x, 0, z]), w)
        moved = [unrolled.add(a, b, -c) for a, b, c in zip(turned, shift, v, strict=True)]
        lateral, offset, distance = moved
        errors = zip((lateral, distance, offset), inverse, strict=True)
        return jnp.sqrt(sum((e * one) ** 2 for e, one in errors))

    def tilted(axis: int, angle: float) -> Vector:
        sine, cosine = math.sin(angle), math.cos(angle)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        out = list(seen)
        # The transpose of the tilt: towards the probe's own axes.
        out[first] = cosine * seen[first] + sine * seen[second]
        out[second] = cosine * seen[second] - sine * seen[first]
        return out

    found = []
    for axis in range(3):
        both = [noticed(middle, tilted(axis, angle)) for angle in (TILT_RAD, -TILT_RAD)]
        found.append(jnp.maximum(*both))
    x, z = middle
    for pair in (
        ([x, 0.5 * z], [x, 1.5 * z]),
        ([x + SIDEWAYS_MM, z], [x - SIDEWAYS_MM, z]),
    ):
        found.append(jnp.maximum(*(noticed(place, seen) for place in pair)))
    return jnp.stack(found, axis=-1)
