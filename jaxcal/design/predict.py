"""Predicted errors of poses.

The prediction is the Cramer-Rao bound under the model's SDs. After a calibration, whose SDs were
tuned to its images, it is multiplied by Student's factor, as the errors that the calibration itself
states are (:mod:`jaxcal.diagnostics.intervals`).
"""

from __future__ import annotations

import numpy as np

from jaxcal.design.candidates import Candidates
from jaxcal.design.criteria import rp_weight, tre_weight
from jaxcal.design.information import Known, covariance_of
from jaxcal.diagnostics.intervals import student_variance
from jaxcal.runtime.array_types import Float, Int


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
