"""What an answer's properties are computed from when first read, of one problem or a batch."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.diagnostics.residual_checks import inspect
from jaxcal.diagnostics.uncertainty import assess
from jaxcal.result.calibration import Calibration, data_of
from jaxcal.result.diagnostics import Diagnostics
from jaxcal.runtime.arrays import map_arrays

Array = np.ndarray

CHUNK = 128
"""Problems computed at a time, so that their derivatives fit in the processor's caches."""


def diagnose(calibration: Calibration) -> Diagnostics:
    """Compute the diagnostics.

    Args:
        calibration: one or a batch, with concrete values and its problem.

    Raises:
        CalibrationError: a calibration without its problem.
    """
    data_of(calibration)
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
    return _joined(pieces, batch)


def _piece(answer: Calibration, eps: float) -> Diagnostics:
    """Diagnostics of calibrations with one leading axis."""
    seen = ImageErrors.of_answer(answer)
    shifted = seen.shifted(answer)
    uncertainty = assess(answer, shifted, eps)
    residual, _ = seen.from_circle(np.zeros_like(seen.mask))
    return Diagnostics(
        elevation_sd=uncertainty.elevation_sd,
        at_bound=uncertainty.at_bound,
        residual=np.where(answer.mask[..., None] > 0, residual, 0.0),
        condition=uncertainty.spectra.condition,
        weakest=uncertainty.spectra.weakest,
        weakest_sd=uncertainty.spectra.weakest_sd,
        prior_direction=uncertainty.prior_direction,
        inspection=inspect(answer, seen, shifted, uncertainty, eps),
    )


def _joined(pieces: list[Any], batch: tuple[int, ...]) -> Any:
    """One object of all pieces, with a batch's axes in front of every array."""
    if isinstance(pieces[0], np.ndarray):
        return np.concatenate(pieces).reshape(batch + pieces[0].shape[1:])
    names = [field.name for field in fields(pieces[0])]
    parts = {name: [getattr(piece, name) for piece in pieces] for name in names}
    return type(pieces[0])(**{name: _joined(each, batch) for name, each in parts.items()})
