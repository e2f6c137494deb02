"""SDs of lateral position, range and elevational offset as functions of where the target is.

Beams are worst in the corners of an image, but a plan for equal SDs puts most of its poses there.
So the logarithm of each SD is a polynomial of the target's place
(:mod:`jaxcal.diagnostics.sd_by_place`), learned from a calibration's residuals if there are enough
images, and before that taken from the geometry of the probe. The elevational SD is that of the
target's distance from the mid-plane.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.probe import Probe, check_probe
from jaxcal.diagnostics.image_errors import error_sd
from jaxcal.diagnostics.sd_by_place import basis_at, log_sd_slopes
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.arrays import array_tree, is_traced
from jaxcal.runtime.given_values import check_made, is_number, real_array

FEWEST_TO_LEARN = 20
"""Fewest images from which SDs are learned as functions of the place."""

SD_RANGE_MM = (1e-6, 1e6)
"""SDs beyond these are a mistake, and their squares may leave no digits."""
_LEAST_SD_MM = 1e-3
UNKNOWN_BY = 3.0
"""A factor by which SDs that are not tuned to data may be wrong."""


def check_result(result: object) -> None:
    """Raise InputError if what a caller gave is not the calibration of one problem."""
    check_made("result", result, Calibration, "jaxcal.calibrate")
    assert isinstance(result, Calibration)
    if np.ndim(result.image_to_probe) != 2:
        raise InputError("poses are planned for one problem; the result is of a batch")


@array_tree
class Noise:
    """SDs of lateral position, range and elevational offset by the target's place in the image.

    ln SD_k = a_k0 + a_k1 d + a_k2 d^2 + a_k3 x^2 (SD in mm), where d = depth / 50 mm - 1 and
    x = lateral position / 25 mm.

    Attributes:
        coefficients: (3, 4), a_k0 to a_k3 for the rows k = lateral, range, elevational.
        doubt: factor by which the ratios of the three SDs may be wrong; 1: they are known.
    """

    coefficients: Float[Any, "3 4"]
    doubt: float = UNKNOWN_BY

    def __post_init__(self) -> None:
        if np.shape(self.coefficients) != (3, 4):
            raise InputError("the noise model's coefficients must have shape (3, 4)")
        if not is_traced(self.coefficients):
            coefficients = real_array(self.coefficients, "the noise model's coefficients")
            if not np.isfinite(coefficients).all():
                raise InputError("the noise model's coefficients must be finite")
            object.__setattr__(self, "coefficients", coefficients)
        if not (is_number(self.doubt) and 1 <= self.doubt <= 100):
            raise InputError(f"doubt is a factor between 1 and 100, not {self.doubt!r}")

    @classmethod
    def constant(
        cls, sigma_mm: tuple[float, float, float] | np.ndarray, doubt: float = UNKNOWN_BY
    ) -> Noise:
        """The same SDs everywhere: lateral, range, elevational, mm."""
        sigma = real_array(sigma_mm, "SDs")
        low, high = SD_RANGE_MM
        if sigma.shape != (3,) or not ((low <= sigma) & (sigma <= high)).all():
            raise InputError(
                f"SDs must be three positive mm between {low:g} and {high:g}, not {sigma_mm}"
            )
        coefficients = np.zeros((3, 4))
        coefficients[:, 0] = np.log(sigma)
        return cls(coefficients, doubt)

    @classmethod
    def of_probe(
        cls,
        probe: Probe,
        channel_mm: float = 0.5,
        elevational_mm: float = 0.5,
        focus_mm: float = 40.0,
        doubt: float = UNKNOWN_BY,
    ) -> Noise:
        """The noise expected from a probe's geometry before there are images.

        Lateral position and range are least-squares fits to the distances of all elements (Eq. 5),
        which have equal SDs. The elevational SD grows away from the focus like the beam's width.

        Args:
            probe: the transducer.
            channel_mm: SD of an element's distance.
            elevational_mm: SD of the elevational offset at the focus.
            focus_mm: range at which the beam is thinnest.
            doubt: see the class.
        """
        check_probe(probe)
        low, high = SD_RANGE_MM
        for name, value in (("channel_mm", channel_mm), ("elevational_mm", elevational_mm)):
            if not (is_number(value) and low <= value <= high):
                raise InputError(f"{name} must be an SD of {low:g} to {high:g} mm, not {value!r}")
        if not is_number(focus_mm):
            raise InputError(f"focus_mm must be a number of mm, not {focus_mm!r}")
        lateral, depth = np.meshgrid(
            np.linspace(-0.4, 0.4, 9) * probe.width_mm, np.linspace(15.0, 90.0, 12)
        )
        place = np.stack([lateral.ravel(), np.zeros(lateral.size), depth.ravel()], axis=1)
        apart = place[:, None, ::2] - probe.element_positions()[None, :, ::2]
        slope = apart / np.linalg.norm(apart, axis=-1, keepdims=True)
        inverse = np.linalg.inv(np.einsum("nka,nkb->nab", slope, slope))
        # A beam of 0.8 mm at its focus that spreads by 0.03 mm for each mm of range.
        width = np.hypot(1.0, 0.03 / 0.8 * (place[:, 2] - focus_mm))
        sigma = np.stack(
            [
                channel_mm * np.sqrt(inverse[:, 0, 0]),
                channel_mm * np.sqrt(inverse[:, 1, 1]),
                elevational_mm * width,
            ],
            axis=1,
        )
        basis = basis_at(place)
        found, *_ = np.linalg.lstsq(basis, np.log(sigma))
        return cls(found.T, doubt)

    @classmethod
    def learned(cls, result: Calibration, targets: Float[np.ndarray, "n 3"]) -> Noise:
        """The noise model from a calibration's SDs and residuals.

        The slopes are those of the squared residuals; at the images' mean place the variance is the
        calibration's own. With fewer than :data:`FEWEST_TO_LEARN` images, each SD
        is the same everywhere. For methods other than joint, which weigh all errors alike, it is so
        with any number of images, and the three SDs are equal.

        Args:
            result: of one problem.
            targets: (n, 3) where the target was in every image, mm.

        Raises:
            InputError: no calibration, one without SDs, or targets of another number of images.
        """
        check_result(result)
        targets = real_array(targets, "targets")
        if targets.ndim != 2 or targets.shape[1] != 3:
            raise InputError(f"targets must have shape (n, 3), not {targets.shape}")
        answer = result.numpy()
        sigma = np.maximum(np.asarray(error_sd(answer), float), _LEAST_SD_MM)
        if not np.isfinite(sigma).all():
            raise InputError("this calibration has no SDs: plan with a noise model of your own")
        used = used_images(result, len(targets))
        count = int(used.sum())
        if result.method != "joint":
            # These methods weigh all errors alike, so the prediction must do the same.
            return cls.constant(np.full(3, np.sqrt(np.mean(sigma**2))), 1.0)
        # The relative error of a tuned SD is about 1 / sqrt(2 n).
        left = max(count - 3, 1)
        tuned = bool(answer.sigma_tuned)
        doubt = float(np.exp(1.0 / np.sqrt(2.0 * left))) if tuned else UNKNOWN_BY
        model = cls.constant(sigma, doubt)
        if count < FEWEST_TO_LEARN:
            return model
        basis = basis_at(targets[used])
        basis[:, 1:] -= (mean := basis[:, 1:].mean(axis=0))
        squared = np.asarray(answer.residual, float)[used][:, [0, 2, 1]].T ** 2
        slopes = log_sd_slopes(basis, squared, np.ones_like(squared))
        first = model.coefficients[:, 0] - slopes @ mean
        return replace(model, coefficients=np.column_stack([first, slopes]))

    def sigma(self, target: Float[Any, "*n 3"]) -> Float[Any, "*n 3"]:
        """SDs (lateral, range, elevational; mm) of targets in the image frame (traceable)."""
        xp = target.__array_namespace__()
        return xp.exp(self.log_sigma(target))

    def log_sigma(self, target: Float[Any, "*n 3"]) -> Float[Any, "*n 3"]:
        """The natural logarithms of :meth:`sigma` (traceable)."""
        return basis_at(target) @ self.coefficients.T


def used_images(result: Calibration, count: int) -> Bool[np.ndarray, " n"]:
    """Which images a calibration used.

    Raises:
        InputError: the calibration is not of ``count`` images.
    """
    used = np.asarray(result.numpy().mask) > 0
    if len(used) != count:
        raise InputError(f"the calibration is of {len(used)} images, {count} poses were given")
    return used
