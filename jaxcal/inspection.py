"""A second look at a solution: which images stand out, does the noise model fit, what to add.

Everything here is a pure function of the arrays at the solution; :mod:`jaxcal.diagnosis` puts it in
words.

*Images.* Each image's departure from what the images in use say, in robust SDs
(:mod:`jaxcal.solvers.consensus`).

*Noise model.* If lateral, range and elevational errors are Gaussian, independent and of one size,
then statistics of the standardised residuals follow known laws, whatever the data. Four are taken
for each component and turned into standard normal scores: kurtosis (heavy tails), skewness (one
side), correlation of the magnitude with the range (errors that grow with depth), and
correlation of successive images (drift).

*Poses to add.* The weakest direction is a motion of X, the target and the rest that the images
hardly notice. For a few kinds of further images it is computed by how many SDs they would.

References: Anscombe and Glynn 1983 (kurtosis), D'Agostino 1970 (skewness): transformations to
normality; Gelman et al. 2013, chapter 6 (posterior predictive checks).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.geometry import rotation_from_vector
from jaxcal.model.parameters import Blocks, Parameters, retract
from jaxcal.model.priors import AbstractPrior, Gaussian
from jaxcal.model.residuals import measured_points, measurement_residual
from jaxcal.problem import Problem
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers.consensus import FEWEST_IMAGES, departures, rigid_model, stands_out
from jaxcal.solvers.least_squares import linearise
from jaxcal.uncertainty import unit_scale

MISFITS = ("tails", "skewness", "depth", "drift")
"""Rows of ``misfit``."""

FEWEST_TO_CHECK = 20
"""With fewer used images the noise model is not judged."""

ADDITIONS = ("tilt lateral", "tilt elevational", "tilt axial", "depth", "sideways")
"""Kinds of further images: the probe tilted about an image axis, or the target elsewhere in it."""

TILT_RAD = 0.4363
SIDEWAYS_MM = 25.0


class Inspection(eqx.Module):
    """What a second look found.

    Attributes:
        outlier: 1 where an image does not fit the rest.
        departure: (n, 3) errors of lateral position, range and elevational offset in robust SDs of
            the images in use; 0 where the caller masked the image.
        kurtosis: (3,) of the standardised residuals; 3 for Gaussian ones.
        misfit: (4, 3) standard normal scores of :data:`MISFITS` for each component; 0 with fewer
            than 20 images in use.
        gain: (5,) SDs by which one more image of each of :data:`ADDITIONS` would notice one unit
            (1 mm at the lever arm) along the weakest direction.
    """

    outlier: Float[Array, "*batch n"]
    departure: Float[Array, "*batch n 3"]
    kurtosis: Float[Array, "*batch 3"]
    misfit: Float[Array, "*batch 4 3"]
    gain: Float[Array, "*batch 5"]


def inspect(
    parameters: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    problem: Problem,
    everything: Problem,
    blocks: Blocks,
    *,
    sigma: Float[Array, 3],
    weakest: Float[Array, " p"],
    left_out: bool,
) -> Inspection:
    """Look at a solution.

    Args:
        parameters: the solution.
        offset: its offset unknowns.
        prior: the objective.
        problem: the images in use.
        everything: the images that the caller wanted to use.
        blocks: the free unknowns.
        sigma: SDs of lateral position, range and offset, mm.
        weakest: the least known direction, in scaled units.
        left_out: images that stand out have been left out.
    """
    parameters, offset, prior, problem, everything, sigma, weakest = jax.lax.stop_gradient(
        (parameters, offset, prior, problem, everything, sigma, weakest)
    )
    _, departure = departures(parameters, everything, problem.mask, rigid_model(blocks))
    used = everything.mask
    if left_out:
        outlier = used * (1 - problem.mask)
    else:
        judged = (jnp.sum(used) >= FEWEST_IMAGES) & jnp.all(jnp.isfinite(departure))
        outlier = used * judged * stands_out(departure, problem.mask)
    kurtosis, misfit = check_noise_model(parameters, offset, prior, problem, blocks)
    gain = gains(parameters, problem, blocks, sigma, weakest)
    return Inspection(outlier, departure, kurtosis, misfit, gain)


def check_noise_model(
    parameters: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    problem: Problem,
    blocks: Blocks,
) -> tuple[Float[Array, 3], Float[Array, "4 3"]]:
    """Kurtosis of the standardised residuals, and the scores of :data:`MISFITS`."""
    mask = problem.mask
    count = jnp.sum(mask)
    if isinstance(prior, Gaussian):
        arrow, jacobian, residual = linearise(parameters, offset, prior, problem, blocks)
        inverse = arrows.inverse_symmetric(arrow.shared, jnp.diagonal(arrow.shared))
        leverage = jnp.einsum("anm,ab,bnm->nm", jacobian, inverse, jacobian)[:, :3]
        residual = residual[:, :3] / jnp.sqrt(jnp.maximum(1 - leverage, 0.05))
    else:
        residual = measurement_residual(parameters, problem)

    def mean(values: Float[Array, "n 3"]) -> Float[Array, 3]:
        return jnp.sum(mask[:, None] * values, axis=0) / count

    centred = mask[:, None] * (residual - mean(residual))
    second = mean(centred**2)
    centred = centred / jnp.sqrt(jnp.where(second > 0, second, 1.0))
    kurtosis = mean(centred**4)
    tails = kurtosis_score(kurtosis, count)
    skewed = skewness_score(mean(centred**3), count)

    distance = measured_points(parameters, problem)[:, 1]
    distance = mask * (distance - jnp.sum(mask * distance) / count)
    magnitude = mask[:, None] * (jnp.abs(centred) - mean(jnp.abs(centred)))
    joint = jnp.sum(distance[:, None] * magnitude, axis=0)
    lengths = jnp.sqrt(jnp.sum(distance**2) * jnp.sum(magnitude**2, axis=0))
    deeper = joint / jnp.where(lengths > 0, lengths, 1.0) * jnp.sqrt(count - 1)

    both = mask[1:] * mask[:-1]
    successive = jnp.sum(both[:, None] * centred[1:] * centred[:-1], axis=0)
    drift = successive / jnp.sqrt(jnp.maximum(jnp.sum(both), 1.0))
    scores = jnp.stack([tails, skewed, deeper, drift])
    judged = (count >= FEWEST_TO_CHECK) & jnp.isfinite(scores) & (second > 0)
    return kurtosis, jnp.where(judged, scores, 0.0)


def kurtosis_score(kurtosis: Float[Array, "*b"], count: Float[Array, ""]) -> Float[Array, "*b"]:
    """Standard normal score of a sample kurtosis (Anscombe and Glynn 1983)."""
    n = count
    expected = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    x = (kurtosis - expected) / jnp.sqrt(variance)
    third = 6 * (n**2 - 5 * n + 2) / ((n + 7) * (n + 9))
    third = third * jnp.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    a = 6 + 8 / third * (2 / third + jnp.sqrt(1 + 4 / third**2))
    inner = (1 - 2 / a) / (1 + x * jnp.sqrt(2 / (a - 4)))
    return (1 - 2 / (9 * a) - jnp.cbrt(inner)) / jnp.sqrt(2 / (9 * a))


def skewness_score(skewness: Float[Array, "*b"], count: Float[Array, ""]) -> Float[Array, "*b"]:
    """Standard normal score of a sample skewness (D'Agostino 1970)."""
    n = count
    y = skewness * jnp.sqrt((n + 1) * (n + 3) / (6 * (n - 2)))
    fourth = 3 * (n**2 + 27 * n - 70) * (n + 1) * (n + 3)
    fourth = fourth / ((n - 2) * (n + 5) * (n + 7) * (n + 9))
    w2 = jnp.sqrt(2 * (fourth - 1)) - 1
    delta = 1 / jnp.sqrt(0.5 * jnp.log(w2))
    alpha = jnp.sqrt(2 / (w2 - 1))
    return delta * jnp.arcsinh(y / alpha)


def gains(
    parameters: Parameters,
    problem: Problem,
    blocks: Blocks,
    sigma: Float[Array, 3],
    weakest: Float[Array, " p"],
) -> Float[Array, 5]:
    """How much one more image of each of :data:`ADDITIONS` would notice of the weakest direction.

    Tilts are of 25 degrees either way about the image's axes, from the pose nearest to the mean of
    those in use and with the target at the middle of the used points; then the target half as deep
    or half as deep again, and 25 mm to either side.
    """
    mask = problem.mask
    total = jnp.sum(mask)
    points = measured_points(parameters, problem)
    middle = jnp.sum(mask[:, None] * points, axis=0) / total
    rotations = problem.poses[:, :3, :3]
    mean = jnp.sum(mask[:, None, None] * rotations, axis=0)
    closeness = jnp.where(mask > 0, jnp.einsum("nij,ij->n", rotations, mean), -jnp.inf)
    usual = rotations[jnp.argmax(closeness)]

    signs = jnp.asarray([1.0, -1.0], mask.dtype)
    axes = jnp.eye(3, dtype=mask.dtype)
    tilts = TILT_RAD * (axes[:, None] * signs[:, None]).reshape(6, 3)
    turns = jnp.concatenate([tilts, jnp.zeros((4, 3), mask.dtype)])
    elsewhere = jnp.stack(
        [middle * jnp.asarray([1.0, 0.5]), middle * jnp.asarray([1.0, 1.5]),
         middle + jnp.asarray([SIDEWAYS_MM, 0.0]), middle - jnp.asarray([SIDEWAYS_MM, 0.0])]
    )  # fmt: skip
    places = jnp.concatenate([jnp.broadcast_to(middle, (6, 2)), elsewhere])

    def pose(turn: Float[Array, 3], place: Float[Array, 2]) -> Float[Array, "4 4"]:
        own = parameters.rotation @ rotation_from_vector(turn) @ parameters.rotation.T
        rotation = usual @ own
        in_image = jnp.stack([place[0], jnp.zeros_like(place[0]), place[1]])
        in_probe = parameters.rotation @ in_image + parameters.translation
        top = jnp.concatenate([rotation, (parameters.point - rotation @ in_probe)[:, None]], axis=1)
        return jnp.concatenate([top, jnp.eye(4, dtype=top.dtype)[3:]])

    unit = problem.spacing * parameters.scale
    face = jnp.stack([jnp.zeros_like(problem.face_offset), problem.face_offset])
    candidates = Problem(
        poses=jax.vmap(pose)(turns, places),
        measurements=(places - face) / unit,
        mask=jnp.ones(10, mask.dtype),
        spacing=problem.spacing,
        face_offset=problem.face_offset,
    )
    tangent = weakest / unit_scale(parameters, problem, blocks)

    def errors(step: Float[Array, ""]) -> Float[Array, "n 3"]:
        return measurement_residual(retract(parameters, step * tangent, blocks), candidates)

    _, noticed = jax.jvp(errors, (jnp.zeros((), mask.dtype),), (jnp.ones((), mask.dtype),))
    size = jnp.sqrt(jnp.sum((noticed / jnp.maximum(sigma, 1e-9)) ** 2, axis=1))
    return jnp.max(size.reshape(5, 2), axis=1)
