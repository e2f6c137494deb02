"""Which pose of a confirmed pool comes next, and whether another image is worth it.

With fewer than eight images, or while the running calibration has not converged, poses are chosen
with the drawing and the SDs of a new bench; after that with the calibration so far and the SDs
tuned from its images. Gains are compared per second of bench time, for the way to a pose and the
placement there. Every fifth image instead fills a gap between the poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hw.planning.pool import BENCH_RULES, BENCH_SDS_MM
from hw.planning.poses import constraints_of
from hw.runtime.rigid import turn_deg
from hw.setup.description import Setup
from jaxcal import InputError
from jaxcal.design import Candidates, Model, Noise, images_to, next_poses
from jaxcal.design.information import Known
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float

FEWEST_TO_TRUST = 8
"""With at least so many images a calibration's own covariance is used."""
_PLACEMENT_S = 8.0
"""Bench seconds that an image takes, without the way to its pose."""
_TURN_DEG_S = 30.0
_FILL = 5


@dataclass(frozen=True)
class Choice:
    """The next pose.

    Attributes:
        row: of the pool; None: the wanted error is reached.
        tre_now_mm: TRE predicted with the images so far; None where nothing is known yet.
        tre_then_mm: TRE predicted with one more image, at this pose.
        more: images still needed for the wanted error; None: not asked for, not known, or more
            than 1000.
    """

    row: int | None
    tre_now_mm: float | None = None
    tre_then_mm: float | None = None
    more: int | None = None

    @property
    def text(self) -> str:
        """One line for a person; empty where nothing is known yet."""
        if self.tre_now_mm is None or self.tre_then_mm is None:
            return ""
        line = (
            f"predicted error over the image {self.tre_now_mm:.3f} mm; one more image would bring "
            f"it to {self.tre_then_mm:.3f} mm"
        )
        return line if self.more is None else f"{line}; about {self.more} more images are needed"


class Planner:
    """Chooses poses from a pool.

    Args:
        targets: (n, 4, 4) the pool, mm.
        setup: the bench, for scene and extent.
        until_tre_mm: wanted predicted TRE; None: go on.
    """

    def __init__(
        self, targets: Float[np.ndarray, "n 4 4"], setup: Setup, until_tre_mm: float | None = None
    ) -> None:
        scene = setup.scene
        self._targets, self._wanted = targets, until_tre_mm
        self._speed = float(setup.limits["max_speed_mm_s"])
        self._tip = scene.tip_mm
        model = Model(scene.image_to_probe, scene.point_mm, Noise.constant(BENCH_SDS_MM))
        self._nominal = Candidates(targets, model, constraints_of(scene, setup.extent))

    def choose(
        self,
        open_rows: list[int],
        taken: Float[np.ndarray, "k 4 4"],
        here: Float[np.ndarray, "4 4"],
        answer: Calibration | None,
    ) -> Choice:
        """The next pose of the pool, or none where the wanted error is reached.

        Args:
            open_rows: poses that were neither taken nor given up; at least one.
            taken: (k, 4, 4) tracked poses of the images that the calibration takes.
            here: where the tool centre point is.
            answer: the calibration from these images.
        """
        left = replace(self._nominal, poses=self._targets[open_rows], taken=taken)
        known, left = self._known(answer, left)
        cost = self._seconds(here, left.poses)
        fills = (len(taken) + 1) % _FILL == 0
        rules = replace(BENCH_RULES, space_filling=float(fills))
        found = next_poses(known, left, 1, cost_s=cost, rules=rules)
        row = open_rows[int(found.rows[0])]
        if not isinstance(known, Calibration):
            return Choice(row)
        now, then = (float(value) for value in found.tre_mm)
        if self._wanted is None:
            return Choice(row, now, then)
        if now <= self._wanted:
            return Choice(None, now, then, 0)
        try:
            more = images_to(known, self._wanted, left)
        except InputError:
            more = None
        return Choice(row, now, then, more)

    def _known(
        self, answer: Calibration | None, left: Candidates
    ) -> tuple[Calibration | Known, Candidates]:
        """What is known, and the candidates with the X, target and SDs that go with it."""
        taken = left.taken
        assert taken is not None
        enough = len(taken) >= FEWEST_TO_TRUST
        if answer is not None and enough and answer.status == "converged":
            found = answer.numpy()
            model = Model(np.asarray(found.image_to_probe), np.asarray(found.point))
            noise = Noise.learned(answer, model.targets(taken))
            return answer, replace(left, model=replace(model, noise=noise))
        model = left.model
        return Known(model.beliefs() + model.information(taken), max(len(taken), 1)), left

    def _seconds(
        self, here: Float[np.ndarray, "4 4"], poses: Float[np.ndarray, "n 4 4"]
    ) -> Float[np.ndarray, " n"]:
        """Bench seconds for the way from here to each pose and the placement there."""
        tip = here[:3, :3] @ self._tip + here[:3, 3]
        tips = poses[:, :3, :3] @ self._tip + poses[:, :3, 3]
        way = np.linalg.norm(tips - tip, axis=1) / self._speed
        turn = np.array([turn_deg(here, pose) for pose in poses]) / _TURN_DEG_S
        return _PLACEMENT_S + np.maximum(way, turn)
