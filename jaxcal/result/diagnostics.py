"""Results of :mod:`jaxcal.diagnostics`, which are computed when one of them is first read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxcal.runtime.array_types import Float
from jaxcal.runtime.arrays import outline

Array = np.ndarray

MISFITS = ("tails", "skewness", "depth", "drift", "trend")
"""Rows of ``misfit``."""

ADDITIONS: tuple[str, ...] = ("tilt lateral", "tilt elevational", "tilt axial", "depth", "sideways")
"""Kinds of further images: tilted about an image axis, or with the target elsewhere in them."""


@dataclass(frozen=True)
class Inspection:
    """What the residuals show.

    Attributes:
        outlier: 1 where an image does not fit the rest.
        studentised_errors: errors of lateral position, range and elevational offset in robust SDs
            of the images in use, corrected for leverage; 0 where the caller masked the image.
        range_at_place: range errors of the images in use, in robust SDs of errors at the target's
            place in the image; 0 with fewer than 20 images in use.
        kurtosis: of the standardised residuals; 3 for Gaussian ones.
        misfit: standard normal scores of :data:`MISFITS` for each component; 0 with fewer than 20
            images in use.
        gain: SDs by which one more image of each of :data:`ADDITIONS` would notice one unit (1 mm
            at the lever arm) along the weakest direction.
    """

    outlier: Float[Array, "*batch n"]
    studentised_errors: Float[Array, "*batch n 3"]
    range_at_place: Float[Array, "*batch n"]
    kurtosis: Float[Array, "*batch 3"]
    misfit: Float[Array, "*batch 5 3"]
    gain: Float[Array, "*batch 5"]

    __repr__ = outline


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of a calibration, or of a batch with leading axes.

    :class:`jaxcal.Calibration` has them as properties of the same names, which say what they are.
    """

    elevation_sd: Float[Array, "*batch n"]
    at_bound: Float[Array, "*batch n"]
    residual: Float[Array, "*batch n 3"]
    condition: Float[Array, "*batch"]
    weakest: Float[Array, "*batch p"]
    weakest_sd: Float[Array, "*batch"]
    prior_direction: Float[Array, "*batch p"]
    inspection: Inspection

    __repr__ = outline
