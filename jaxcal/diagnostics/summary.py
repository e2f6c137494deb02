"""All diagnostics of an answer, computed when first read, for one problem or a whole batch."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal import CalibrationError
from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.diagnostics.residual_checks import inspect
from jaxcal.diagnostics.uncertainty import assess
from jaxcal.result.findings import Inspection, Summary
from jaxcal.runtime.arrays import map_arrays

if TYPE_CHECKING:
    from jaxcal.result.calibration import Calibration

Array = np.ndarray

CHUNK = 128
"""Problems computed at a time, so that their derivatives fit in the processor's caches."""


def summarise(calibration: Calibration) -> Summary:
    """Compute the diagnostics.

    Args:
        calibration: one or a batch, with concrete values and its problem.

    Raises:
        CalibrationError: a calibration without its problem.
    """
    if calibration.problem is None:
        raise CalibrationError(
            "this calibration does not hold its problem, without which there are no diagnostics: "
            "add it with calibration.with_problem(problem)"
        )
    batch = np.shape(calibration.mask)[:-1]
    axes = len(batch)
    eps = float(np.finfo(np.asarray(calibration.covariance).dtype).eps)

    def flat(leaf: Any) -> Array:
        values = np.asarray(leaf)
        values = values.astype(float) if values.dtype.kind == "f" else values
        return values.reshape(-1, *values.shape[axes:])

    whole = map_arrays(flat, calibration)
    pieces = []
    with np.errstate(all="ignore"):
        for start in range(0, max(len(whole.mask), 1), CHUNK):
            rows = slice(start, start + CHUNK)
            pieces.append(_piece(map_arrays(lambda leaf, rows=rows: leaf[rows], whole), eps))
    found = {
        name: np.concatenate([piece[name] for piece in pieces]).reshape(batch + each.shape[1:])
        for name, each in pieces[0].items()
    }
    inspection = {field.name: found.pop(field.name) for field in fields(Inspection)}
    return Summary(**found, inspection=Inspection(**inspection))


def _piece(answer: Calibration, eps: float) -> dict[str, Array]:
    """Diagnostics by name, for calibrations with one leading axis."""
    seen = ImageErrors.of_answer(answer)
    shifted = seen.shifted(answer)
    uncertainty = assess(answer, shifted, eps)
    spectra = uncertainty.spectra
    inspection = inspect(answer, seen, shifted, uncertainty, eps)
    residual, _ = seen.from_circle(np.zeros_like(seen.mask))
    return {
        "elevation_sd": uncertainty.elevation_sd,
        "at_bound": uncertainty.at_bound,
        "residual": np.where(answer.mask[..., None] > 0, residual, 0.0),
        "condition": spectra.condition,
        "weakest": spectra.weakest,
        "weakest_sd": spectra.weakest_sd,
        "prior_direction": uncertainty.prior_direction,
        **{field.name: getattr(inspection, field.name) for field in fields(Inspection)},
    }
