"""From a bench to the engine in memory: re-solve after every image.

A :class:`LiveCalibration` holds room for a fixed number of images and masks those not yet taken, so
the solver is compiled once and every later solve costs milliseconds.
"""

from __future__ import annotations

import numpy as np

from jaxcal import InputError
from jaxcal.calibration.calibrate import calibrate
from jaxcal.data.poses import check_poses
from jaxcal.data.probe import Probe, check_probe
from jaxcal.data.problem import Problem
from jaxcal.data.recording import (
    MINIMUM_IMAGES,
    Kind,
    Recording,
    check_kind,
    check_spacing,
    make_images,
    used_values,
)
from jaxcal.data.segmentation.segment import MINIMUM_LINES, check_times_of_flight
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.arrays import first_images
from jaxcal.runtime.given_values import real_array, whole_number
from jaxcal.runtime.messages import shown

MOST_IMAGES = 100_000
"""Largest capacity: every solve takes time and memory for all of it."""


class LiveCalibration:
    """Calibrate while images arrive: after each, the calibration from all images so far.

    Args:
        capacity: most images; twice the capacity takes twice the time of a solve.
        kind: ``point`` (mm), ``pixel`` or ``time_of_flight`` (s) measurements.
        spacing_mm: [lateral, axial] mm/px for pixels.
        probe: the transducer, for times of flight.
        arguments: passed on to :func:`jaxcal.calibrate`, e.g. ``method="joint"``.

    Raises:
        InputError: capacity that is no whole number from 4 to 100,000; another kind; a spacing that
            is not plausible; times of flight without a probe, or something else in its place.
    """

    def __init__(
        self,
        capacity: int = 64,
        *,
        kind: Kind = "point",
        spacing_mm: tuple[float, float] | None = None,
        probe: Probe | None = None,
        **arguments,
    ) -> None:
        capacity = whole_number("capacity", capacity, MINIMUM_IMAGES, MOST_IMAGES)
        if probe is not None:
            check_probe(probe)
        if kind == "time_of_flight" and probe is None:
            raise InputError("times of flight need a probe")
        check_kind(kind)
        self._probe = probe
        self._kind: Kind = kind
        self._spacing = check_spacing(spacing_mm, kind)
        self._arguments = arguments
        self._poses = np.tile(np.eye(4), (capacity, 1, 1))
        columns = probe.elements if probe is not None and kind == "time_of_flight" else 2
        self._measurements = np.ones((capacity, columns))
        self._bound = np.full(capacity, np.inf)
        self._mask = np.zeros(capacity, bool)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def poses(self) -> np.ndarray:
        """(n, 4, 4) of the images taken, mm."""
        return self._poses[: self._count].copy()

    @property
    def capacity(self) -> int:
        """Most images."""
        return len(self._mask)

    def add(
        self, pose: np.ndarray, measurement: np.ndarray, max_elevation: float = np.inf
    ) -> Calibration | None:
        """Take one image and solve again.

        Args:
            pose: (4, 4) probe -> tracker, mm.
            measurement: [lateral, range] mm, [u, v] px, or (elements,) times of flight, s, with NaN
                where there was no answer.
            max_elevation: bound on the image's |elevational offset|, mm, where a placement gave
                one; the bounded methods use it.

        Returns:
            The calibration from all images so far; None with fewer than 4.

        Raises:
            InputError: a full buffer, or an image that cannot be used; it is then not kept.
        """
        self.put(pose, measurement, max_elevation)
        if self._count < MINIMUM_IMAGES:
            return None
        try:
            return self.solve()
        except InputError:
            self._count -= 1
            self._mask[self._count] = False
            raise

    def put(self, pose: np.ndarray, measurement: np.ndarray, max_elevation: float = np.inf) -> None:
        """Take one image without solving; arguments and errors as for :meth:`add`."""
        if self._count == self.capacity:
            raise InputError(f"the buffer is full at {self.capacity} images")
        pose = check_poses(real_array(pose, "pose")[None], what="pose of the new image")[0]
        values = real_array(measurement, "measurement")
        if self._kind == "time_of_flight":
            self._check_times(values)
        elif values.shape != (2,) or not np.isfinite(values).all():
            raise InputError("a measurement must be two finite numbers")
        else:
            # Kept, it would be refused with every image to come.
            used_values(self._kind, values[None].copy(), np.ones(1, bool))
        bound = real_array(max_elevation, "max_elevation")
        if bound.shape != () or not bound >= 0:
            raise InputError(f"max_elevation must not be negative or NaN, it is {max_elevation}")
        self._poses[self._count], self._measurements[self._count] = pose, values
        self._bound[self._count] = bound
        self._mask[self._count] = True
        self._count += 1

    def _check_times(self, times: np.ndarray) -> None:
        assert self._probe is not None
        if times.shape != (self._probe.elements,):
            raise InputError(
                f"{self._probe.elements} times of flight are needed, not shape {times.shape}"
            )
        answers = int(np.isfinite(times).sum())
        if answers < MINIMUM_LINES:
            raise InputError(
                f"only {answers} lines were answered: at least {MINIMUM_LINES} are needed"
            )
        check_times_of_flight(times[None], self._probe)

    def leave_out(self, index: int) -> None:
        """Mask an image taken earlier.

        Raises:
            InputError: when there is no such image.
        """
        if not self._count:
            raise InputError(f"there is no image {shown(index)}: none were taken")
        index = whole_number("index", index, 0, self._count - 1)
        self._mask[index] = False

    def problem(self) -> Problem:
        """The images so far as a problem of the full capacity, checked.

        Raises:
            InputError: with fewer than 4 used images, or data in the wrong units.
        """
        bound = self._bound if np.isfinite(self._bound[self._mask]).all() else None
        images = make_images(
            self._poses,
            self._measurements,
            self._kind,
            mask=self._mask,
            max_elevation=bound,
            spacing_mm=self._spacing,
        )
        return Problem.from_recording(Recording(images, probe=self._probe))

    def solve(self) -> Calibration:
        """Calibrate from the images so far; per-image arrays hold those taken, in order.

        Raises:
            InputError: as :meth:`problem`.
        """
        result = calibrate(self.problem(), **self._arguments)
        return first_images(result.numpy(), self._count)
