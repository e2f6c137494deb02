"""The simulated world as a bench for the placement procedures: no sockets, no waiting.

The real clients and the emulators between a procedure and the world are left out, so that
procedures and experiments with thousands of placements run in seconds. Bench time is added up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.active_echo.device import median_of
from hw.bench.world import World
from hw.midplane.search import Echoes
from hw.runtime.errors import Device
from jaxcal.runtime.array_types import Float


@dataclass(frozen=True)
class Pace:
    """How long each action takes on a bench, to add up bench time.

    Attributes:
        search_mm_s: speed of elevational moves.
        travel_mm_s: speed of moves between poses.
        turn_deg_s: speed of turns between poses.
        settle_s: after every move.
        frame_s: of one active-echo frame.
        command_s: a command to the electronics and its answer.
    """

    search_mm_s: float = 10.0
    travel_mm_s: float = 50.0
    turn_deg_s: float = 30.0
    settle_s: float = 0.15
    frame_s: float = 1 / 30
    command_s: float = 0.02


class WorldStage:
    """A probe at one planned pose that can be moved along its nominal elevational axis.

    Args:
        world: what there is.
        pose: (4, 4) planned pose, tool -> base, mm.
        rng: of noise and repeatability.
        position_sd_mm: every stop misses by a normal error of this SD on each axis, which the robot
            does not see.
        backlash_mm: lost motion when the elevational motion changes its direction.
    """

    device: Device = "active echo"
    target = "the element"
    to_check = "the element, its threshold and the coupling"

    def __init__(
        self,
        world: World,
        pose: Float[np.ndarray, "4 4"],
        rng: np.random.Generator,
        *,
        position_sd_mm: float = 0.1,
        backlash_mm: float = 0.0,
    ) -> None:
        self.world, self.plan_pose, self._rng = world, np.array(pose, float), rng
        self._sd, self._backlash = position_sd_mm, backlash_mm
        self.pace = Pace()
        self.threshold = 0
        self.seconds = 0.0
        self.pattern: bytes | None = None
        self._asked, self._slack = 0.0, 0.0
        self.true_pose = self.plan_pose.copy()
        self.reported_pose = self.plan_pose.copy()
        self.move(0.0)

    def move(self, offset_mm: float) -> float:
        """Stop at an offset; the robot reports the place where it was sent."""
        step = offset_mm - self._asked
        # Lost motion: the tool follows only when the drive has run through its play.
        self._slack = float(np.clip(self._slack - step, -self._backlash / 2, self._backlash / 2))
        self._asked = offset_mm
        axis = self.plan_pose[:3, :3] @ self.world.scene.elevational
        self.reported_pose = self.plan_pose.copy()
        self.reported_pose[:3, 3] += offset_mm * axis
        self.true_pose = self.reported_pose.copy()
        self.true_pose[:3, 3] += self._slack * axis + self._sd * self._rng.normal(size=3)
        self.seconds += abs(step) / self.pace.search_mm_s + self.pace.settle_s
        return offset_mm

    def read(self, frames: int) -> Echoes:
        """Whole frames at the place where the probe stands."""
        times, amplitude = self._hear(frames)
        return Echoes(amplitude, np.isfinite(times))

    def set_threshold(self, threshold: int) -> None:
        """Counts."""
        self.threshold = threshold
        self.seconds += self.pace.command_s

    def load_pattern(self, pattern: bytes) -> None:
        """Keep it."""
        self.pattern = pattern
        self.seconds += self.pace.command_s

    def inject(self, on: bool, delay_s: float = 0.0) -> None:
        """Off forgets the pattern."""
        self.pattern = self.pattern if on else None
        self.seconds += self.pace.command_s

    @property
    def elevation_mm(self) -> float:
        """The target's true elevational offset where the probe stands."""
        return self.world.truth(self.true_pose).elevation_mm

    def times_of_flight(self, frames: int) -> Float[np.ndarray, " elements"]:
        """Median over some frames, s; NaN where fewer than half of them were answered."""
        return median_of(self._hear(frames)[0])

    def _hear(
        self, frames: int
    ) -> tuple[Float[np.ndarray, "frames elements"], Float[np.ndarray, "frames elements"]]:
        self.seconds += frames * self.pace.frame_s
        return self.world.echoes(self.true_pose, self.threshold, self._rng, frames)
