"""Errors that are alike in successive images, and how much they widen the covariance.

A least-squares answer moves by dx = S^-1 sum_i J_i' e_i, with J_i the rows of image i and e_i its
errors, both in SDs, and S = sum_i J_i' J_i. If errors of one kind k (lateral, range, elevational)
have correlation rho_k^|i - j| between images i and j, its covariance is

    S^-1 (sum_k sum_ij rho_k^|i - j| J_ik' J_jk) S^-1

instead of S^-1. How much larger this is depends on the order of the poses: where the poses change
at random, a drift hardly matters; where they change as slowly as the errors, it dominates.

Each rho_k is the correlation of successive residuals, corrected for leverage. With z its value in
SDs, it is multiplied by 1 - (``CHANCE`` / z)^2, and is zero where z is below ``CHANCE``; for
independent errors z exceeds ``CHANCE`` in 2 % of recordings, for each kind of error. So independent
data keep their covariance, and the correction grows continuously. It never makes an answer more
certain. The information P of priors on sound speed and delay is added to both sums.

References: White 1980; Newey and West 1987 (covariances under dependent errors). Here one
parameter for each kind of error describes the correlation at all lags.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jaxcal.diagnostics.image_errors import medium_prior
from jaxcal.diagnostics.influence import whitened_errors
from jaxcal.model.unknowns import block_slice
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import like, map_arrays

if TYPE_CHECKING:
    from jaxcal.result.calibration import Calibration, Medium

CHANCE = 2.1
"""SDs that the correlation of successive residuals must exceed to be believed."""

FEWEST_SUCCESSIVE = 20
"""With fewer used images the correlation is not estimated."""

LARGEST_CORRELATION = 0.98
"""Largest correlation of successive errors that is assumed."""


def widened(result: Calibration) -> Calibration:
    """The calibration with its covariance widened for errors that are alike in successive images.

    Args:
        result: of one problem, with concrete values.

    Returns:
        The same object where there is no sign that the errors are correlated. Calibrations from
        channels or with bounded offsets are returned unchanged.
    """
    if result.data != "points" or result.prior == "bounded" or result.problem is None:
        return result
    covariance = np.asarray(result.unknowns_covariance)
    # Counted by numpy, since JAX would compile the count anew for every number of images.
    used = int(np.sum(np.asarray(result.mask) > 0))
    if not np.isfinite(covariance).all() or used < FEWEST_SUCCESSIVE:
        return result
    answer = map_arrays(lambda leaf: np.asarray(leaf)[None], result)
    whitened = whitened_errors(answer)
    found = _covariances(whitened.errors, whitened.rows, medium_prior(answer)[0])
    if found is None:
        return result
    before, after = found
    linearisation = result.linearisation
    # The information about all unknowns changes in the same proportion.
    whole = _stretched(np.linalg.inv(np.asarray(linearisation.information, float)), before, after)
    information = np.linalg.inv(whole)
    wider = _stretched(covariance, before, after)
    return replace(
        result,
        unknowns_covariance=like(result.unknowns_covariance, wider),
        medium=_wider_medium(result, covariance, wider),
        linearisation=replace(
            linearisation, information=like(linearisation.information, information)
        ),
    )


def _wider_medium(
    result: Calibration, covariance: Float[np.ndarray, "p p"], wider: Float[np.ndarray, "p p"]
) -> Medium | None:
    """Sound speed and delay with the SDs of the wider covariance."""
    medium, changed = result.medium, {}
    for name, field in (("sound-speed", "sound_speed_sd_m_s"), ("delay", "delay_sd_s")):
        if name in result.blocks:
            at = block_slice(result.blocks, name).start
            sd = getattr(medium, field)
            by = np.sqrt(wider[at, at] / covariance[at, at])
            changed[field] = like(sd, np.asarray(sd * by))
    return medium if medium is None else replace(medium, **changed)


def _covariances(
    errors: Float[np.ndarray, "m 3"],
    rows: Float[np.ndarray, "m 3 p"],
    precision: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p p"]] | None:
    """Covariances of the unknowns without and with the correlation; None where there is none."""
    count = len(errors)
    each = np.einsum("mkp,mkq->kpq", rows, rows)
    prior = np.diag(precision)
    before = np.linalg.inv(each.sum(axis=0) + prior)
    leverage = np.einsum("mkp,pq,mkq->mk", rows, before, rows)
    rho = believed_correlation(errors / np.sqrt(np.maximum(1 - leverage, 0.05)))
    if not rho.any():
        return None
    middle = prior
    for k in range(3):
        filtered = rows[:, k].copy()
        for index in range(1, count):
            filtered[index] += rho[k] * filtered[index - 1]
        half = filtered.T @ rows[:, k]
        both = half + half.T - each[k]
        # The fit absorbs slow errors more than quick ones, so the SD is too small: enlarge it.
        left = count - np.sum(before * each[k])
        middle = middle + both * left / max(count - np.sum(before * both), 0.2 * count)
    lower = np.linalg.cholesky(before)
    inner = np.linalg.solve(lower, before @ middle @ before)
    values, vectors = np.linalg.eigh(np.linalg.solve(lower, inner.T))
    turned = lower @ vectors
    return before, (turned * np.maximum(values, 1.0)) @ turned.T


def believed_correlation(errors: Float[np.ndarray, "m k"]) -> Float[np.ndarray, " k"]:
    """Correlation of successive images for every kind of error, shrunk to allow for chance."""
    centred = errors - errors.mean(axis=0)
    square = np.sum(centred**2, axis=0)
    successive = np.sum(centred[1:] * centred[:-1], axis=0)
    rho = successive / np.where(square > 0, square, 1.0)
    score = np.maximum(rho * np.sqrt(len(errors) - 1), 1e-9)
    return np.clip(rho * np.maximum(1 - (CHANCE / score) ** 2, 0.0), 0.0, LARGEST_CORRELATION)


def _stretched(
    covariance: Float[np.ndarray, "p p"],
    before: Float[np.ndarray, "p p"],
    after: Float[np.ndarray, "p p"],
) -> Float[np.ndarray, "p p"]:
    """A covariance changed in the same proportion as another one, from before to after."""
    stretch = np.linalg.cholesky(after) @ np.linalg.inv(np.linalg.cholesky(before))
    found = stretch @ covariance @ stretch.T
    return 0.5 * (found + found.T)
