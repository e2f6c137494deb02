"""The criteria of a plan: the weight matrices W, the gain of a further pose, predicted errors.

TRE. At an image point p the error of X Exp(d) p is J_p d with J_p = [I, -[p]x] (mm); unknown pixel
scales add two columns (:mod:`jaxcal.model.image_points`). So the mean square over an image
region is tr(W S), W = mean of J_p'J_p.

RP (Eq. 8). The reconstructed points B_i X p_i scatter by J_i d about their mean, J_i = R_i R_X J_p;
the expected square is tr(W S), W = sum_i (J_i - mean J)'(J_i - mean J) / (n - 1) over the test set.

D. ln det S: the volume of the confidence ellipsoid of all unknowns.

Gain. With G of one more pose, A = G S G' and Woodbury's identity, tr(W S) falls by

    tr((I + A)^-1 G S W S G'),

and ln det S by ln det(I + A): matrices of 3x3.

Predicted errors (:func:`curve`) are the Cramer-Rao bound under the model's SDs. After a
calibration, whose SDs were tuned to its images, it is multiplied by Student's factor, as the errors
that the calibration itself states are (:mod:`jaxcal.diagnostics.intervals`).

SDs that are not tuned to data may be wrong. The criterion is then the mean of ln tr(W S) over a few
sets of SDs (:func:`hypotheses`); only the ratios of the SDs matter.
"""

from __future__ import annotations

from typing import get_args

import numpy as np

from jaxcal import InputError
from jaxcal.design.candidates import Candidates
from jaxcal.design.information import Known, Model, covariance_of
from jaxcal.design.names import Criterion
from jaxcal.diagnostics.intervals import student_variance
from jaxcal.model.image_points import mean_of_squares, point_jacobian
from jaxcal.runtime.array_types import AnyArray, Array, Float, Int
from jaxcal.runtime.given_values import check_made, real_array

_PIECE = 800
"""Poses whose products are computed at once."""

CRITERIA: tuple[Criterion, ...] = get_args(Criterion)


def check_criterion(criterion: str) -> None:
    """Raise InputError if the name is not that of a criterion."""
    if criterion not in CRITERIA:
        raise InputError(
            f"criterion must be {', '.join(CRITERIA[:-1])} or {CRITERIA[-1]}, not {criterion!r}"
        )


def tre_weight(points: Float[np.ndarray, "m 3"], model: Model) -> Float[np.ndarray, "p p"]:
    """W of the mean squared TRE over image points.

    Args:
        points: [lateral, 0, axial] mm, e.g. :meth:`jaxcal.design.constraints.Region.grid`.
        model: X, target and SDs; p is the number of its unknowns.

    Raises:
        InputError: points of another shape, or something else than a model.
    """
    check_made("model", model, Model, "jaxcal.design.Model")
    points = real_array(points, "points")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points must have shape (m, 3), not {points.shape}")
    moved = point_jacobian(points[:, [0, 2]], model.blocks, model.face_offset_mm)
    return mean_of_squares(moved)


def rp_weight(poses: Float[np.ndarray, "m 4 4"], model: Model) -> Float[np.ndarray, "p p"]:
    """W of the expected square of Eq. 8 over test images at these poses (probe -> tracker)."""
    points = model.targets(poses)[:, [0, 2]]
    moved = point_jacobian(points, model.blocks, model.face_offset_mm)
    moved = poses[:, :3, :3] @ model.image_to_probe[:3, :3] @ moved
    moved = moved - moved.mean(axis=0)
    return np.einsum("mia,mib->ab", moved, moved) / max(len(poses) - 1, 1)


def weight_of(criterion: Criterion, candidates: Candidates) -> Float[np.ndarray, "p p"] | None:
    """W of a criterion over the candidates' region; None for D."""
    if criterion == "d":
        return None
    if criterion == "tre":
        return tre_weight(candidates.constraints.region.grid(), candidates.model)
    return rp_weight(candidates.poses, candidates.model)


def hypotheses(doubt: float) -> Float[np.ndarray, "k 3"]:
    """Factors on the SDs (lateral, range, elevational) over which a plan averages its criterion.

    The first set is the SDs as they are. For a doubt of 1.5 or more there are four other sets, with
    either the range SD or the elevational SD multiplied or divided by the doubt.
    """
    if doubt < 1.5:
        return np.ones((1, 3))
    factors = np.ones((5, 3))
    factors[1:3, 1] = factors[3:5, 2] = doubt, 1 / doubt
    return factors


def gain(
    pose: Float[AnyArray, "4 4"],
    covariance: Float[AnyArray, "p p"],
    weight: Float[AnyArray, "p p"],
    model: Model,
) -> Float[Array, ""]:
    """How much one more image at a pose reduces tr(W S), mm^2 (JAX; differentiable in the pose).

    Args:
        pose: probe -> tracker, mm.
        covariance: S, of all unknowns before this image (mm, rad, and log units of pixel scales).
        weight: W, by which the criterion is the trace tr(W S), e.g. of :func:`tre_weight`.
        model: X, target and SDs.
    """
    from jax import numpy as jnp

    check_made("model", model, Model, "jaxcal.design.Model")
    square = (model.size, model.size)
    for name, value, shape in (
        ("pose", pose, (4, 4)),
        ("covariance", covariance, square),
        ("weight", weight, square),
    ):
        if np.shape(value) != shape:
            raise InputError(f"{name} must have shape {shape}, not {np.shape(value)}")
    rows = model.jacobian(jnp.asarray(pose))
    spread = rows @ jnp.asarray(covariance)
    around = jnp.eye(3) + spread @ rows.T
    return jnp.trace(jnp.linalg.solve(around, spread @ jnp.asarray(weight) @ spread.T))


def gains(
    rows: Float[np.ndarray, "m 3 p"],
    covariance: Float[np.ndarray, "p p"],
    weight: Float[np.ndarray, "p p"] | None,
) -> Float[np.ndarray, " m"]:
    """The gains of many poses (numpy), in ln tr(W S), or in ln det S without W; see :func:`gain`.

    Returns:
        -ln(1 - gain / tr(W S)), or ln det(I + A) / p: the decrease of either logarithm.
    """
    size = rows.shape[2]
    spread = _times(rows, covariance)
    a = _symmetric(spread, rows)
    a[:3] += 1.0
    determinant, adjugate = _adjugate(a)
    if weight is None:
        return np.log(determinant) / size
    b = _symmetric(_times(spread, weight), spread)
    gained = (adjugate[:3] * b[:3]).sum(axis=0) + 2 * (adjugate[3:] * b[3:]).sum(axis=0)
    share = gained / (determinant * np.sum(weight * covariance))
    return -np.log1p(-np.clip(share, 0.0, 1.0 - 1e-12))


def _times(
    rows: Float[np.ndarray, "m 3 p"], matrix: Float[np.ndarray, "p p"]
) -> Float[np.ndarray, "m 3 p"]:
    """Product with a matrix, in pieces: for larger ones BLAS starts threads, which is slower."""
    pieces = range(0, len(rows), _PIECE)
    flat = [rows[k : k + _PIECE].reshape(-1, len(matrix)) @ matrix for k in pieces]
    return np.concatenate(flat).reshape(rows.shape)


def _symmetric(first: np.ndarray, second: np.ndarray) -> Float[np.ndarray, "6 m"]:
    """Entries 11, 22, 33, 23, 13, 12 of first @ second', which must be symmetric."""
    pairs = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
    return np.stack([np.einsum("mp,mp->m", first[:, i], second[:, j]) for i, j in pairs])


def _adjugate(
    a: Float[np.ndarray, "6 m"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "6 m"]]:
    """Determinant and adjugate of symmetric 3x3 matrices, entries as in :func:`_symmetric`."""
    a11, a22, a33, a23, a13, a12 = a
    adjugate = np.stack(
        [
            a22 * a33 - a23**2,
            a11 * a33 - a13**2,
            a11 * a22 - a12**2,
            a12 * a13 - a11 * a23,
            a12 * a23 - a13 * a22,
            a13 * a23 - a12 * a33,
        ]
    )
    return a11 * adjugate[0] + a12 * adjugate[5] + a13 * adjugate[4], adjugate


def tuned_factor(known: Known, more: Int[np.ndarray, "*n"], size: int) -> Float[np.ndarray, "*n"]:
    """By how much squared errors with so many more images exceed the bound: 1 for given SDs."""
    left = known.images + more - size / 3
    return np.asarray(student_variance(left if known.tuned else np.full_like(left, np.inf)))


def curve(
    candidates: Candidates, known: Known, poses: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, " n1"], Float[np.ndarray, " n1"]]:
    """Predicted TRE and RP with the first 0, 1, ... n of the poses, mm."""
    model = candidates.model
    rows = model.jacobian(poses)
    steps = np.einsum("nia,nib->nab", rows, rows)
    total = known.information + np.concatenate([np.zeros((1, *steps.shape[1:])), steps.cumsum(0)])
    covariance = covariance_of(total)
    weights = (
        tre_weight(candidates.constraints.region.grid(), model),
        rp_weight(candidates.poses, model),
    )
    factor = tuned_factor(known, np.arange(len(total)), model.size)
    tre, rp = (np.sqrt(factor * np.einsum("ab,nab->n", weight, covariance)) for weight in weights)
    return tre, rp
