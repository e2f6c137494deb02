"""Checks of the residuals: outliers, the fit of the noise model, and which poses to add.

*Images.* Each image's errors under the fit to the images in use, in robust SDs. Lateral errors of
deep images count less, since an array's lateral errors grow with the range
(:mod:`jaxcal.solvers.consensus`), and so do errors of images that are less accurate than most by
their own covariances, if the fit weighs by these. (Which images ``robust`` leaves out is decided
before the fit, without covariances.)

*Noise model.* If lateral, range and elevational errors are Gaussian, independent and of one size,
then statistics of the standardised residuals follow known laws, whatever the data. Five statistics
of each component are turned into standard normal scores: kurtosis (heavy tails), skewness (errors
to one side), correlation of the magnitude with the range (errors that grow with depth), correlation
of successive images in use (drift), and correlation with the image's number (trend).

*Poses to add.* The weakest direction is a motion of X, the target and the other unknowns that
hardly changes the images. For a few kinds of further images it is computed by how many SDs this
motion would change them.

References: Anscombe and Glynn 1983 (kurtosis), D'Agostino 1970 (skewness): transformations to
normality; Gelman et al. 2013, chapter 6 (posterior predictive checks).
"""

from __future__ import annotations

import numpy as np

from jaxcal.data.poses import rotations_from_vectors
from jaxcal.diagnostics.image_errors import (
    ImageErrors,
    Whitened,
    error_sd,
    flattened,
    further_prior,
    motion,
    own_covariance,
    quadratic,
)
from jaxcal.diagnostics.sd_by_place import relative_sd
from jaxcal.diagnostics.uncertainty import Uncertainty, inverses
from jaxcal.model.outlying import LEAST_ERROR_LEFT, robust_sd, stands_out, studentise
from jaxcal.model.thresholds import FEWEST_TO_LEAVE_OUT
from jaxcal.model.unknowns import block_slice, further_derivatives, measured
from jaxcal.result.calibration import Calibration
from jaxcal.result.diagnostics import ADDITIONS, Inspection
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.solvers.plan import TUNED

Array = np.ndarray

FEWEST_TO_CHECK = 20
"""With fewer used images the noise model is not checked."""

TILT_RAD = 0.4363
"""Tilt of a further image about an image axis: 25 degrees."""

SIDEWAYS_MM = 25.0
"""Lateral distance of the target from the middle in a further image to the side."""


def inspect(
    answer: Calibration,
    seen: ImageErrors,
    shifted: ImageErrors,
    uncertainty: Uncertainty,
    eps: float,
) -> Inspection:
    """Look at the residuals of calibrations with one leading axis.

    Args:
        answer: the calibrations.
        seen: all images that the caller wanted to use, those left out as outliers included.
        shifted: the same images, shifted by the estimated error of the tracker.
        uncertainty: of the calibrations.
        eps: relative rounding of the arithmetic that solved them.
    """
    kept = np.asarray(answer.mask, float)
    tuned = answer.prior in TUNED and answer.data == "points"
    own = own_covariance(answer, seen.problem) if tuned and not answer.robust else None
    studentised = studentised_errors(seen, kept, eps, own)
    if answer.robust:
        outlier = seen.mask * (1 - kept)
    else:
        judged = (seen.mask.sum(axis=1) >= FEWEST_TO_LEAVE_OUT) & np.isfinite(studentised).all(
            axis=(1, 2)
        )
        outlier = seen.mask * judged[:, None] * stands_out(studentised, kept)
    residual = seen.errors
    if tuned:
        whitened = Whitened.of(answer, shifted)
        # The fit absorbs what it would of independent errors, however far it may be off by others.
        inverse = inverses(whitened.information(kept, further_prior(answer)[0]), eps)
        left = np.maximum(1 - whitened.leverage(inverse), LEAST_ERROR_LEFT)
        residual = whitened.errors / np.sqrt(left)
    kurtosis, misfit = check_noise_model(residual, seen.distance, kept)
    gain = gains(answer, seen, uncertainty)
    at_place = range_at_place(studentised[..., 1], seen, kept)
    return Inspection(outlier, studentised, at_place, kurtosis, misfit, gain)


def studentised_errors(
    seen: ImageErrors,
    kept: Float[Array, "k n"],
    eps: float,
    own: Float[AnyArray, "k n 2 2"] | None = None,
) -> Float[Array, "k n 3"]:
    """Every image's errors under the fit to the kept ones, in robust SDs, leverage corrected.

    Args:
        seen: the images.
        kept: 1 for images in use.
        eps: relative rounding.
        own: covariances of lateral position and range in any units, or None: all are alike.
    """
    blocks, problem = seen.blocks, seen.problem
    rigid = [name for name in blocks if name in ("translation", "rotation", "point", "scale")]
    columns = np.concatenate([np.r_[block_slice(blocks, name)] for name in rigid])
    # This range only scales errors, so nominal values of the further unknowns are good enough.
    axial = np.where(seen.mask > 0, np.asarray(problem.measurements)[..., 1], 1.0)
    distance = axial * np.asarray(problem.spacing)[:, 1:] + np.asarray(problem.face_offset)[:, None]
    beyond = np.maximum(distance / medians(distance[..., None], seen.mask), 1.0)
    by = np.stack([beyond, *[np.ones_like(beyond)] * 2], axis=-1)
    if own is not None:
        sd = np.sqrt(np.diagonal(np.asarray(own), axis1=-2, axis2=-1))
        by[..., :2] = np.maximum(by[..., :2], sd / medians(sd, kept)[:, None])
    by = np.where(seen.mask[..., None] > 0, by, 1.0)
    errors, rows = seen.errors / by, seen.rows[..., columns] / by[..., None]

    sigma = robust_sd(medians(np.abs(errors), kept), kept.sum(axis=1), len(columns))
    rows = flattened(rows / sigma[:, None, :, None])
    used = rows * np.repeat(kept, 3, axis=1)[..., None]
    inverse = inverses(np.swapaxes(used, 1, 2) @ used, eps)
    leverage = quadratic(rows, inverse).reshape(errors.shape)
    return np.asarray(studentise(errors, leverage, sigma, kept))


def range_at_place(
    studentised: Float[Array, "k n"], seen: ImageErrors, kept: Float[Array, "k n"]
) -> Float[Array, "k n"]:
    """Range errors in robust SDs of errors at the target's place in the image.

    Args:
        studentised: the same in robust SDs of all images.
        seen: the images.
        kept: 1 for images in use.
    """
    found = np.zeros_like(studentised)
    judged = (kept.sum(axis=1) >= FEWEST_TO_CHECK) & np.isfinite(studentised).all(axis=1)
    errors, mask = studentised[judged], kept[judged]
    found[judged] = mask * errors / relative_sd(seen.q[judged], errors, mask)

    def typical(values: Float[Array, "k n"]) -> Float[Array, " k"]:
        return medians(np.abs(values)[..., None], kept)[:, 0]

    now = typical(found)
    by = np.where(judged & (now > 0), typical(studentised) / np.where(now > 0, now, 1.0), 1.0)
    return found * by[:, None]


def medians(values: Float[Array, "k n c"], weight: Float[Array, "k n"]) -> Float[Array, "k c"]:
    """The lower median of the used values; NaN counts as infinite."""
    used = weight > 0
    values = np.where(used[..., None] & ~np.isnan(values), values, np.inf)
    middle = np.maximum((used.sum(axis=1) + 1) // 2 - 1, 0)
    return np.take_along_axis(np.sort(values, axis=1), middle[:, None, None], axis=1)[:, 0]


def check_noise_model(
    residual: Float[Array, "k n 3"], distance: Float[Array, "k n"], mask: Float[Array, "k n"]
) -> tuple[Float[Array, "k 3"], Float[Array, "k 5 3"]]:
    """Kurtosis of standardised residuals, and the scores of :attr:`Inspection.misfit`.

    Args:
        residual: of lateral position, range and offset, each in SDs of its own or of one SD.
        distance: the range, mm.
        mask: 1 for images in use.
    """
    used = mask[..., None]
    count = used.sum(axis=1)

    def mean(values: Float[Array, "k n c"]) -> Float[Array, "k c"]:
        return np.sum(used * values, axis=1) / count

    centred = used * (residual - mean(residual)[:, None])
    second = mean(centred**2)
    centred = centred / np.sqrt(np.where(second > 0, second, 1.0))[:, None]
    square = centred * centred
    kurtosis = mean(square * square)
    tails = kurtosis_score(kurtosis, count)
    skewed = skewness_score(mean(square * centred), count)

    away = distance[..., None]
    away = used * (away - mean(away)[:, None])
    magnitude = used * (np.abs(centred) - mean(np.abs(centred))[:, None])
    lengths = np.sqrt(np.sum(away**2, axis=1) * np.sum(magnitude**2, axis=1))
    joint = np.sum(away * magnitude, axis=1)
    deeper = joint / np.where(lengths > 0, lengths, 1.0) * np.sqrt(count - 1)

    # Images in use count as successive even if others between them were left out.
    order = np.argsort(mask <= 0, axis=1, kind="stable")[..., None]
    row, kept = np.take_along_axis(centred, order, axis=1), np.take_along_axis(used, order, axis=1)
    successive = np.sum(row[:, 1:] * row[:, :-1], axis=1)
    drift = successive / np.sqrt(np.maximum(count - 1, 1.0))
    number = kept * (np.cumsum(kept, axis=1) - 0.5 * (count[:, None] + 1))
    lengths = np.sqrt(np.sum(number**2, axis=1) * np.sum(row**2, axis=1))
    correlation = np.sum(number * row, axis=1) / np.where(lengths > 0, lengths, 1.0)
    trend = np.arctanh(np.clip(correlation, -0.999999, 0.999999)) * np.sqrt(count - 3)
    scores = np.stack([tails, skewed, deeper, drift, trend], axis=1)
    judged = (count >= FEWEST_TO_CHECK)[:, None] & np.isfinite(scores) & (second > 0)[:, None]
    return kurtosis, np.where(judged, scores, 0.0)


def kurtosis_score(kurtosis: Float[Array, "*#b"], count: Float[Array, "*#b"]) -> Float[Array, "*b"]:
    """Standard normal score of a sample kurtosis (Anscombe and Glynn 1983)."""
    n = count
    expected = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    x = (kurtosis - expected) / np.sqrt(variance)
    third = 6 * (n**2 - 5 * n + 2) / ((n + 7) * (n + 9))
    third = third * np.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    a = 6 + 8 / third * (2 / third + np.sqrt(1 + 4 / third**2))
    # Very light tails (two groups of errors) are beyond the range of the transformation.
    inner = (1 - 2 / a) / np.maximum(1 + x * np.sqrt(2 / (a - 4)), 1e-3)
    return (1 - 2 / (9 * a) - np.cbrt(inner)) / np.sqrt(2 / (9 * a))


def skewness_score(skewness: Float[Array, "*#b"], count: Float[Array, "*#b"]) -> Float[Array, "*b"]:
    """Standard normal score of a sample skewness (D'Agostino 1970)."""
    n = count
    y = skewness * np.sqrt((n + 1) * (n + 3) / (6 * (n - 2)))
    fourth = 3 * (n**2 + 27 * n - 70) * (n + 1) * (n + 3)
    fourth = fourth / ((n - 2) * (n + 5) * (n + 7) * (n + 9))
    w2 = np.sqrt(2 * (fourth - 1)) - 1
    delta = 1 / np.sqrt(0.5 * np.log(w2))
    alpha = np.sqrt(2 / (w2 - 1))
    return delta * np.arcsinh(y / alpha)


def gains(answer: Calibration, seen: ImageErrors, uncertainty: Uncertainty) -> Float[Array, "k 5"]:
    """By how many SDs the weakest direction would change one more image: :attr:`Inspection.gain`.

    The kinds are in the order of :data:`ADDITIONS`. The first three are tilts of 25 degrees either
    way about the image's axes, from the pose nearest to the mean of those in use, with the target
    at the middle of the used points. The other two have the target at 0.5 or 1.5 times that depth,
    and 25 mm to either side. In an image whose pose puts the target at q = (x, 0, z), the target
    moves by -v + [q]x w + M d.
    """
    blocks, kept = answer.blocks, np.asarray(answer.mask, float)
    count = kept.sum(axis=1)
    middle = np.stack(
        [
            np.sum(np.where(kept > 0, plane, 0.0), axis=1) / count
            for plane in (seen.lateral, seen.distance)
        ],
        axis=1,
    )
    # M of the pose whose rotation is nearest to the mean of those in use.
    mean = np.einsum("kn,knij->kij", kept, seen.tracker_to_image)
    closeness = np.where(kept > 0, np.einsum("knij,kij->kn", seen.tracker_to_image, mean), -np.inf)
    usual = seen.tracker_to_image[np.arange(len(kept)), np.argmax(closeness, axis=1)]

    half, aside = np.array([1.0, 0.5]), np.array([SIDEWAYS_MM, 0.0])
    elsewhere = [middle * half, middle * (2 - half), middle + aside, middle - aside]
    places = np.stack([*[middle] * 6, *elsewhere], axis=1)
    tracker_to_image = np.concatenate(
        [_TILTS @ usual[:, None], np.broadcast_to(usual[:, None], (len(kept), 4, 3, 3))], axis=1
    )
    q = np.stack([places[..., 0], np.zeros_like(places[..., 0]), places[..., 1]], axis=-1)

    step = uncertainty.spectra.weakest / uncertainty.scale
    errors = np.einsum("kmip,kp->kmi", motion(q, tracker_to_image, blocks), step)
    errors = errors[..., [0, 2, 1]]
    # The positions in mm are linear functions of the measurements, so the measurements at these
    # places follow from the positions of two others.
    face, further = np.asarray(seen.problem.face_offset)[:, None], seen.unknowns.along(1)
    one = np.ones_like(places[..., 0])
    offset, end = (np.stack(measured(k * one, k * one, face, further), -1) for k in (0, 1))
    across, deep = np.moveaxis((places - offset) / (end - offset), -1, 0)
    for column, (lateral, distance) in further_derivatives(
        lambda values: measured(across, deep, face, values), further, blocks
    ):
        errors[..., 0] -= lateral * step[:, column, None]
        errors[..., 1] -= distance * step[:, column, None]
    sigma = np.maximum(np.asarray(error_sd(answer)), 1e-9)[:, None]
    noticed = np.sqrt(np.sum((errors / sigma) ** 2, axis=2))
    return noticed.reshape(-1, len(ADDITIONS), 2).max(axis=2)


_TILTS = rotations_from_vectors(np.kron(np.eye(3), [[-TILT_RAD], [TILT_RAD]]))
"""Transposes of the rotations by the tilt, either way about each image axis."""
