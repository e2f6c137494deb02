"""The running estimate of an acquisition: solved after every image, in words and for the file."""

from __future__ import annotations

from typing import Any

import numpy as np

from hw.acquisition.live_calibration import LiveCalibration
from hw.midplane.bracket import Placement
from hw.recording.check import Progress
from hw.setup.description import Setup
from jaxcal import InputError
from jaxcal.data.poses import targets_in_images
from jaxcal.data.recording import Kind
from jaxcal.result.calibration import Calibration


class Estimator:
    """Images so far and the calibration from them.

    Args:
        capacity: images of the plan.
        setup: probe and scene.
        progress: of a recording that is resumed; its images are used.
        kind: what an image holds, ``time_of_flight`` or ``point``.

    Raises:
        InputError: images of the recording that cannot be used.
    """

    def __init__(
        self,
        capacity: int,
        setup: Setup,
        progress: Progress | None,
        kind: str = "time_of_flight",
    ) -> None:
        self._setup, self._capacity = setup, capacity
        self._kind: Kind = "point" if kind == "point" else "time_of_flight"
        self._live = self._empty()
        self.answer: Calibration | None = None
        """The calibration from the images so far; None with too few."""
        self._left_out = 0
        if progress is not None:
            rows = zip(progress.poses, progress.measurements, progress.max_elevation, strict=True)
            for pose, measurement, bound in rows:
                self._put(pose, measurement, bound)
            self.answer = self._solve()

    def _empty(self) -> LiveCalibration:
        return LiveCalibration(
            self._capacity, kind=self._kind, probe=self._setup.probe, method="joint"
        )

    @property
    def count(self) -> int:
        """Images taken."""
        return len(self._live) + self._left_out

    @property
    def poses(self) -> np.ndarray:
        """(n, 4, 4) of the images that the calibration takes, mm, in the order of its arrays."""
        return self._live.poses

    def warm_up(self, targets: np.ndarray) -> None:
        """Compile before anything moves, on measurements simulated from drawing and plan."""
        live, probe, scene = self._empty(), self._setup.probe, self._setup.scene
        # Slightly off the plane, like real images: an exact fit would be a degenerate problem.
        rng = np.random.default_rng(0)
        seen = scene.expected(targets) + rng.normal(0, 0.2, (len(targets), 3))
        if self._kind == "point":
            measured = np.column_stack([seen[:, 0], np.hypot(seen[:, 1], seen[:, 2])])
            measured += rng.normal(0, 0.1, measured.shape)
        else:
            distance = np.linalg.norm(seen[:, None] - probe.element_positions(), axis=-1)
            measured = probe.time_of_flight_s(distance + rng.normal(0, 0.05, distance.shape))
        for pose, row in zip(targets, measured, strict=True):
            live.put(pose, row, 1.0)
        live.solve()

    def add(self, pose: np.ndarray, measurement: np.ndarray, bound: float) -> dict[str, Any] | None:
        """Take an image and solve; a row of /estimate, or None with too few images."""
        if self._put(pose, measurement, bound):
            self.answer = self._solve()
        if self.answer is None:
            return None
        answer = self.answer.numpy()
        return {
            "images": answer.mask.sum(),
            "image_to_probe": answer.image_to_probe,
            "covariance": answer.covariance,
            "point": answer.point,
            "sigma": answer.sigma,
            "rms": answer.rms,
            "status": answer.status_code,
        }

    def expected_offset_mm(self, pose: np.ndarray) -> float:
        """How far along its elevational axis the probe must go from a pose to meet the target.

        0 where nothing is known yet.
        """
        if self.answer is None or self.answer.status != "converged":
            return 0.0
        answer = self.answer.numpy()
        return float(targets_in_images(pose, answer.image_to_probe, answer.point)[1])

    def line(self, total: int, placement: Placement) -> str:
        """The state of the acquisition after an image, for a person."""
        bracket = placement.bracket
        placed = (
            f"image {self.count - 1} ({self.count} of {total}): "
            f"offset {bracket.centre_mm:+.2f} mm in "
            f"[{bracket.low_mm:+.2f}, {bracket.high_mm:+.2f}], {placement.moves} moves"
        )
        head = "; ".join([placed, *placement.notes])
        if self.answer is None:
            return f"{head}; no estimate yet"
        answer = self.answer.numpy()
        x, y, z = answer.image_to_probe[:3, 3]
        head += f"; X at ({x:.2f}, {y:.2f}, {z:.2f}) mm"
        if np.isfinite(answer.covariance).all():
            mm = float(np.sqrt(np.trace(answer.covariance[:3, :3])))
            degrees = float(np.degrees(np.sqrt(np.trace(answer.covariance[3:, 3:]))))
            head += f" +- {mm:.2f} mm, {degrees:.2f} deg (SD)"
        return f"{head}; RMS {float(answer.rms):.2f} mm; {self.answer.status}"

    def _put(self, pose: np.ndarray, measurement: np.ndarray, bound: float) -> bool:
        """Whether the calibration takes the image."""
        try:
            self._live.put(pose, measurement, bound)
        except InputError:
            # The file keeps the image; calibrate will say what is wrong with it.
            self._left_out += 1
            return False
        return True

    def _solve(self) -> Calibration | None:
        try:
            return self._live.solve()
        except InputError:
            return None
