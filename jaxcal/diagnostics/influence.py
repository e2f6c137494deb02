"""The effect of each image and each kind of error on an answer, from its normal equations.

Let R_i be the whitened derivatives of image i's errors e_i by the unknowns, S_i = R_i'R_i and
S = sum S_i (plus the information of priors). Then, to first order:

*Leaving an image out* moves the unknowns by (S - S_i)^-1 R_i'e_i = S^-1 R_i'(I - H_i)^-1 e_i with
the leverages H_i = R_i S^-1 R_i'. If the model holds, this move has the covariance
(S - S_i)^-1 - S^-1 = S^-1 R_i'(I - H_i)^-1 R_i S^-1. So no further solve is needed to see how much
an image moves the answer, and whether that is more than expected.

*Kinds of errors.* S is the sum of the information from lateral position, range and offset:
S = sum S_k. The covariance S^-1 = sum S^-1 S_k S^-1 then shows how much comes from each kind.

*Fits with equal weights* (conventional, bounded) are whitened by their pooled SD. Conventional
errors have a variance v_k for each axis, in units of the pooled one
(:func:`jaxcal.diagnostics.uncertainty.variances_by_axis`), so the covariance is the sum of
v_k S^-1 S_k S^-1. With V = diag(v_k), the errors that are left in image i have the covariance
V - H_i V - V H_i + R_i C R_i' with the unknowns' covariance C (I - H_i where all v_k are 1).
Within bounds, the part of an error that depends on a free offset is projected out.

*What the residuals say.* S^-1 (sum R_i'(I - H_i)^-1/2 e_i e_i'(I - H_i)^-1/2 R_i + P) S^-1 with
the priors' information P has the covariance of the model as its expectation if the model holds.
This is S^-1; for conventional fits it is S^-1 (sum v_k S_k + P) S^-1, and the expectation is
nearly that. The estimate is a valid covariance even if the model does not hold: it is larger where
a few images pull, or where errors are large in images that matter.

All this is of the errors one by one: S is the information before errors that are alike in
successive images reduced it (:mod:`jaxcal.calibration.serial_correlation`).

References: Cook 1977 (leaving out); MacKinnon and White 1985 (the residuals' covariance, HC2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jaxcal.diagnostics.image_errors import KINDS, ImageErrors, Whitened, further_prior, quadratic
from jaxcal.diagnostics.uncertainty import inverses, variances_by_axis
from jaxcal.result.calibration import Calibration, check_one, data_of
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.arrays import batch_of_one
from jaxcal.solvers.plan import TUNED

Array = np.ndarray

_LEAST_LEFT = 1e-6
"""Least share of an error's variance after the fit, for images that the unknowns depend on."""


@dataclass(frozen=True)
class Influence:
    """The effect of images and kinds of errors on the unknowns of one calibration.

    Attributes:
        moved: by how much the unknowns move if the image is left out; 0 where it is not in use, NaN
            where the other images do not determine all unknowns.
        expected: E, with the covariance E'E of ``moved`` if the model holds; NaN where ``moved``
            is.
        shares: the part of the covariance that comes from each of :data:`KINDS`.
        residual_covariance: covariance of the unknowns, estimated from the residuals.
        residual_rows: V^1/2 R_i S^-1: how far each error moves the unknowns per SD.
        model_covariance: of the unknowns, if the model holds.
        log_density: of each image's three errors as predicted from the others (mm); 0 where not in
            use.
    """

    moved: Float[Array, "n p"]
    expected: Float[Array, "n k p"]
    shares: Float[Array, "3 p p"]
    residual_covariance: Float[Array, "p p"]
    residual_rows: Float[Array, "n k p"]
    model_covariance: Float[Array, "p p"]
    log_density: Float[Array, " n"]


@dataclass(frozen=True)
class WhitenedErrors:
    """Whitened errors of the images in use.

    Attributes:
        errors: in SDs.
        rows: their derivatives.
        kind: index into :data:`KINDS` of each error.
        log_sd: sum of the logarithms of an image's SDs, mm.
        used: which images are in use.
        variances: v_k of the errors; ones where each is in its own SD.
    """

    errors: Float[Array, "m k"]
    rows: Float[Array, "m k p"]
    kind: Int[Array, " k"]
    log_sd: Float[Array, " m"]
    used: Bool[Array, " n"]
    variances: Float[Array, " k"]

    def covariances(
        self, precision: Float[Array, " p"], invert: Callable[[Array], Array] = np.linalg.inv
    ) -> tuple[Float[Array, "p p"], Float[Array, "p p"]]:
        """S^-1 and the covariance of the unknowns, with the precision of their priors."""
        by_error, prior = np.einsum("mkp,mkq->kpq", self.rows, self.rows), np.diag(precision)
        inverse = invert(by_error.sum(axis=0) + prior)
        if (self.variances == 1).all():
            return inverse, inverse
        middle = np.einsum("k,kpq->pq", self.variances, by_error) + prior
        return inverse, inverse @ middle @ inverse


def _inverse(matrix: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """NaN where the images do not determine all unknowns."""
    return inverses(matrix[None], np.finfo(float).eps)[0]


def influence_of(calibration: Calibration) -> Influence:
    """Influence of the images of one calibration, with concrete values.

    Raises:
        CalibrationError: a calibration without its problem.
        InputError: a batch.
    """
    data_of(calibration)
    check_one(calibration.status_code)
    alone = batch_of_one(calibration.numpy())
    with np.errstate(all="ignore"):
        found = whitened_errors(alone)
        averaged = calibration.offset_law is not None and bool(calibration.offset_law.weighed)
        at_minimum = not averaged and calibration.method != "alternating"
        precision, away = (each[0] for each in further_prior(alone))
        return _influence(found, precision, away, at_minimum=at_minimum)


def _influence(
    found: WhitenedErrors,
    precision: Float[Array, " p"],
    away: Float[Array, " p"],
    *,
    at_minimum: bool = True,
) -> Influence:
    """Influence of whitened errors and a prior of this precision, from which the answer is away."""
    rows, errors = found.rows, found.errors
    components = rows.shape[1]
    inverse, covariance = found.covariances(precision, _inverse)
    if not at_minimum:
        # An answer averaged over laws, or an alternation that stopped early, does not minimise
        # these errors: take them at the minimum.
        gradient = np.einsum("mkp,mk->p", rows, errors) + precision * away
        errors = errors - np.einsum("mkp,p->mk", rows, inverse @ gradient)
    own = np.sqrt(found.variances)[:, None] * rows
    by_error = np.einsum("mkp,mkq->kpq", own, own)
    by_kind = np.stack([by_error[found.kind == kind].sum(axis=0) for kind in range(len(KINDS))])

    steps = rows @ inverse
    leverage = steps @ np.swapaxes(rows, 1, 2)
    values, vectors = np.linalg.eigh(np.eye(components) - 0.5 * (leverage + leverage.mT))
    # Without an image that alone determines a direction there is no answer to move to.
    alone = (values <= _LEAST_LEFT).any(axis=1)
    values = np.maximum(values, _LEAST_LEFT)
    turned = np.einsum("mkl,mk->ml", vectors, errors)
    # (I - H)^-1/2 R S^-1, in the directions of the eigenvectors.
    halfway = (vectors / np.sqrt(values)[:, None]).mT @ steps
    residual = np.einsum("mk,mkp->mp", turned, halfway)
    moved = np.einsum("mk,mkp->mp", turned / np.sqrt(values), halfway)
    # The covariance of the errors that are left.
    spreads, axes = values, vectors
    if covariance is not inverse:
        own_sizes = np.diag(found.variances)
        crossed = leverage @ own_sizes + own_sizes @ leverage.mT
        spreads, axes = np.linalg.eigh(own_sizes - crossed + rows @ covariance @ rows.mT)
        spreads = np.maximum(spreads, _LEAST_LEFT)
    across = np.sqrt(spreads)[..., None] * (axes.mT @ (vectors / np.sqrt(values)[:, None]))
    expected = across @ halfway
    moved[alone], expected[alone] = np.nan, np.nan
    # Predicted from the others, an error is (I - H)^-1 times what is left of it.
    along = np.einsum("mkl,mk->ml", axes, errors)
    density = -0.5 * np.sum(along**2 / spreads + np.log(spreads), axis=1)
    density = density + np.sum(np.log(values), axis=1)
    density = density - 0.5 * components * np.log(2 * np.pi) - found.log_sd

    def everywhere(values: Array) -> Array:
        whole = np.zeros((len(found.used), *values.shape[1:]))
        whole[found.used] = values
        return whole

    return Influence(
        moved=everywhere(moved),
        expected=everywhere(expected),
        shares=inverse @ by_kind @ inverse,
        residual_covariance=residual.T @ residual + inverse * precision @ inverse,
        residual_rows=everywhere(own @ inverse),
        model_covariance=covariance,
        log_density=everywhere(density),
    )


def whitened_errors(answer: Calibration) -> WhitenedErrors:
    """Errors of a calibration with one leading axis of length 1, in SDs and uncorrelated."""
    seen = ImageErrors.of_answer(answer)
    used = np.asarray(answer.mask)[0] > 0
    if answer.data == "channels":
        return _from_channels(answer, seen, used)
    if answer.prior in TUNED:
        return _from_points(answer, seen, used)
    sd = float(np.sqrt(answer.linearisation.variance[0]))
    if answer.prior == "bounded":
        free = used & (answer.at_bound[0] == 0)
        return _equal_weights(seen, np.asarray(answer.elevation), sd, used, free)
    lever = float(seen.lever(np.asarray(answer.mask))[0])
    return _by_axis(_equal_weights(seen, np.zeros_like(seen.mask), sd, used), lever / sd)


def _by_axis(found: WhitenedErrors, lever: float) -> WhitenedErrors:
    """Errors of a fit with equal weights, with a variance of each axis; the lever arm in SDs."""
    parts = np.einsum("mkp,mkq->kpq", found.rows, found.rows)
    inverse = _inverse(parts.sum(axis=0))
    squares, count = np.sum(found.errors**2, axis=0), np.asarray(float(len(found.rows)))
    variances = variances_by_axis(parts, squares, count, inverse, np.asarray(lever))
    return replace(found, variances=variances)


def _from_points(answer: Calibration, seen: ImageErrors, used: Array) -> WhitenedErrors:
    whitened = Whitened.of(answer, seen.shifted(answer).centred(answer))
    errors, rows, log_sd = (
        each[0][used] for each in (whitened.errors, whitened.rows, whitened.log_sd)
    )
    if whitened.offset_rows is not None:
        # The image's own unknown has the prior variance 1, so errors have the covariance I + o o'.
        own = whitened.offset_rows[0][used]
        size = np.sum(own**2, axis=1, keepdims=True)
        log_sd = log_sd + 0.5 * np.log1p(size[:, 0])
        unit = own / np.sqrt(np.where(size > 0, size, 1.0))
        shrink = 1 / np.sqrt(1 + size) - 1
        rows = rows + (shrink * unit)[..., None] * np.einsum("mk,mkp->mp", unit, rows)[:, None]
        # The estimate of that unknown has multiplied the errors by (I + o o')^-1.
        errors = errors + (1 / (1 + shrink) - 1) * unit * np.sum(unit * errors, axis=1)[:, None]
    return WhitenedErrors(errors, rows, np.arange(3), log_sd, used, np.ones(3))


def _from_channels(answer: Calibration, seen: ImageErrors, used: Array) -> WhitenedErrors:
    channels, sigma = seen.problem.channels, np.asarray(answer.sigma)[0]
    assert channels is not None
    assert answer.channel_sigma is not None
    element_sd = float(np.asarray(answer.channel_sigma)[0])
    rows = seen.channel_rows()[0]
    elements = np.asarray(channels.elements)[0]
    rows = rows.reshape(len(used), len(elements), -1)[used] / element_sd
    listened = np.nan_to_num(np.asarray(channels.heard))[0][used]
    errors = seen.channel_errors()[0][used] / element_sd
    offset = seen.errors[0][used, 2:] / sigma[2]
    errors = np.concatenate([errors, offset], axis=1)
    rows = np.concatenate([rows, seen.rows[0][used, 2:] / sigma[2]], axis=1)
    # Lateral position and range come from the same elements, whose errors count as range errors.
    kind = np.array([1] * len(elements) + [2])
    log_sd = listened.sum(axis=1) * np.log(element_sd) + np.log(sigma[2])
    return WhitenedErrors(errors, rows, kind, log_sd, used, np.ones(len(kind)))


def _equal_weights(
    seen: ImageErrors,
    y: Float[Array, "1 n"],
    sd: float,
    used: Bool[Array, " n"],
    free: Bool[Array, " n"] | None = None,
) -> WhitenedErrors:
    """Errors with one SD; the part along a ``free`` offset's circle is projected out."""
    residual, axial = seen.from_circle(y)
    rows = seen.circle_rows(axial)[0][used]
    errors = residual[0][used]
    if free is not None:
        slope = (y / axial)[0][used]
        along = np.stack([0 * slope, -np.ones_like(slope), slope], axis=1)
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        along = np.where(free[used, None], along, 0.0)
        rows = rows - along[..., None] * np.einsum("mk,mkp->mp", along, rows)[:, None]
        errors = errors - along * np.sum(along * errors, axis=1, keepdims=True)
    log_sd = np.full(int(used.sum()), 3 * np.log(sd))
    kind, ones = np.array([0, 2, 1]), np.ones(3)
    return WhitenedErrors(errors / sd, rows / sd, kind, log_sd, used, ones)


def conventional_fit(
    seen: ImageErrors, used: Bool[Array, " n"], noise: Float[Array, "n 3 3"]
) -> tuple[Float[Array, "p p"], Float[Array, " n"]]:
    """How good the fit with equal weights is, if errors have other covariances N_i.

    Its covariance is A^-1 (sum of R_i' N_i R_i) A^-1 with A = sum of R_i' R_i.

    Args:
        seen: the images under the conventional fit (one leading axis of length 1).
        used: images in use.
        noise: covariance of every image's lateral, range and elevational errors, mm^2.

    Returns:
        The covariance of the fit's unknowns, and the log density of every image's three errors as
        predicted from the others by the fit with a variance of each axis; 0 where not used.
    """
    zero = np.zeros_like(seen.mask)
    plain = _equal_weights(seen, zero, 1.0, used)
    left = max(plain.errors.size - plain.rows.shape[2], 1)
    sd = float(np.sqrt(np.sum(plain.errors**2) / left))
    scaled = _equal_weights(seen, zero, sd, used)
    none = np.zeros(scaled.rows.shape[2])
    inverse, _ = scaled.covariances(none, _inverse)
    kind = scaled.kind
    steps, noise = scaled.rows @ inverse / sd, noise[used][:, kind[:, None], kind]
    covariance = np.einsum("nkp,nkl,nlq->pq", steps, noise, steps)
    by_axis = _by_axis(scaled, float(seen.lever(used[None].astype(float))[0]) / sd)
    return covariance, _influence(by_axis, none, none).log_density


def excess(found: Influence, weight: Float[Array, "p p"]) -> tuple[float, float]:
    """The mean square error estimated from the residuals, over the stated one.

    Args:
        found: of a calibration.
        weight: W, by which the mean square error is tr(W C).

    Returns:
        tr(W C_residuals) / tr(W C) with the covariance C of the model, and its SD if the model
        holds with Gaussian errors.
    """
    stated = float(np.sum(weight * found.model_covariance))
    if not (np.isfinite(stated) and stated > 0):
        return 1.0, np.inf
    rows = found.residual_rows
    within = rows @ weight @ np.swapaxes(rows, 1, 2)
    spread = np.sqrt(2 * np.sum(within * within)) / stated
    return float(np.sum(weight * found.residual_covariance)) / stated, float(spread)


def in_image(
    found: Influence, weight: Float[Array, "p p"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """How far leaving each image out moves image points (root mean square over W's points, mm).

    Returns:
        The move, and the move expected if the model holds; both 0 where an image is not in use, and
        NaN where the other images do not determine all unknowns.
    """
    moved = quadratic(found.moved[None], weight[None])[0]
    expected = np.sum(found.expected @ weight * found.expected, axis=(1, 2))
    return np.sqrt(np.maximum(moved, 0.0)), np.sqrt(np.maximum(expected, 0.0))
