"""From a bench to the engine in memory: re-solve after every image.

A :class:`LiveCalibration` holds room for a fixed number of images and masks those not yet taken, so
the solver is compiled once and every later solve costs milliseconds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxcal.calibration import Calibration
from jaxcal.errors import InputError
from jaxcal.geometry import check_poses
from jaxcal.problem import Problem
from jaxcal.recording import MINIMUM_IMAGES, Kind, make_images
from jaxcal.solve import calibrate


class LiveCalibration:
    """Images come in one by one; the calibration so far is there after each.

    Args:
        capacity: most images; twice as much room costs twice the time of a solve.
        kind: ``point`` (mm) or ``pixel`` measurements.
        spacing_mm: [lateral, axial] mm/px for pixels.
        arguments: passed on to :func:`jaxcal.calibrate`, e.g. ``method="joint"``.

    Raises:
        InputError: capacity below 4.
    """

    def __init__(
        self,
        capacity: int = 64,
        *,
        kind: Kind = "point",
        spacing_mm: tuple[float, float] | None = None,
        **arguments,
    ) -> None:
        if capacity < MINIMUM_IMAGES:
            raise InputError(f"capacity must be at least {MINIMUM_IMAGES}, not {capacity}")
        self._kind: Kind = kind
        self._spacing = spacing_mm
        self._arguments = arguments
        self._poses = np.tile(np.eye(4), (capacity, 1, 1))
        self._measurements = np.ones((capacity, 2))
        self._mask = np.zeros(capacity, bool)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def capacity(self) -> int:
        """Most images."""
        return len(self._mask)

    def add(self, pose: np.ndarray, measurement: np.ndarray) -> Calibration | None:
        """Take one image and solve again.

        Args:
            pose: (4, 4) probe -> tracker, mm.
            measurement: [lateral, range] mm, or [u, v] px.

        Returns:
            The calibration from all images so far; None with fewer than 4.

        Raises:
            InputError: a full buffer, or an image that cannot be used; it is then not kept.
        """
        if self._count == self.capacity:
            raise InputError(f"the buffer is full at {self.capacity} images")
        pose = check_poses(np.asarray(pose)[None], what="pose of the new image")[0]
        values = np.asarray(measurement, dtype=float)
        if values.shape != (2,) or not np.isfinite(values).all():
            raise InputError("a measurement must be two finite numbers")
        self._poses[self._count], self._measurements[self._count] = pose, values
        self._mask[self._count] = True
        self._count += 1
        if self._count < MINIMUM_IMAGES:
            return None
        try:
            return self.solve()
        except InputError:
            self._count -= 1
            self._mask[self._count] = False
            raise

    def leave_out(self, index: int) -> None:
        """Mask an image taken earlier.

        Raises:
            InputError: when there is no such image.
        """
        if not 0 <= index < self._count:
            raise InputError(f"there is no image {index}; {self._count} were taken")
        self._mask[index] = False

    def problem(self) -> Problem:
        """The images so far as a problem of the full capacity, checked.

        Raises:
            InputError: with fewer than 4 used images, or data in the wrong units.
        """
        return Problem.from_recording(
            make_images(
                self._poses, self._measurements, self._kind, mask=self._mask,
                spacing_mm=self._spacing,
            )
        )  # fmt: skip

    def solve(self) -> Calibration:
        """Calibrate from the images so far; per-image arrays hold those taken, in order.

        Raises:
            InputError: as :meth:`problem`.
        """
        result = calibrate(self.problem(), **self._arguments)
        taken = slice(0, self._count)
        names = ("elevation", "elevation_sd", "residual", "mask", "at_bound")
        cut = {name: getattr(result, name)[taken] for name in names}
        return replace(result, **cut)
