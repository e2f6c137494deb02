"""The poses that a run may visit, and everything that the operator's confirmation is bound to."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field
from functools import cached_property

import numpy as np

from hw.robot.feasibility import Arm
from hw.robot.kinematics import model_named
from hw.robot.limits import Limits, numbers
from hw.robot.rtde import PendantSettings
from hw.runtime.errors import refused

_MOST_TARGETS = 10_000


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """The poses that a run may visit, and everything that the operator's confirmation is bound to.

    Raises:
        RefusedError: not an array of 4x4 numbers.
    """

    targets: np.ndarray
    """(n, 4, 4) mm, TCP -> robot base; kept as a read-only copy."""
    limits: Limits
    tcp_offset: tuple[float, ...]
    """(6,) of the controller when the plan was made: m and rotation vector (rad)."""
    serial: str
    """Which robot: :attr:`hw.robot.identity.Identity.name`."""
    joints: tuple[float, ...] | None = None
    """(6,) the arm's joints, rad, when the plan was made. They decide in which branch of the
    kinematics the plan is checked; None: any branch. Not in the digest: they permit nothing."""
    pendant: PendantSettings = field(default_factory=PendantSettings)
    """Payload and speed slider when the plan was made."""

    def __post_init__(self) -> None:
        targets = array_of(self.targets, "the plan's poses")
        if targets.ndim != 3 or targets.shape[1:] != (4, 4):
            raise refused(f"the plan's poses must have shape (n, 4, 4), not {targets.shape}")
        if not 1 <= len(targets) <= _MOST_TARGETS:
            raise refused(f"a plan has 1 to {_MOST_TARGETS} poses, not {len(targets)}")
        targets.setflags(write=False)
        object.__setattr__(self, "targets", targets)
        object.__setattr__(self, "tcp_offset", numbers(self.tcp_offset, 6, "tcp_offset"))
        if self.joints is not None:
            object.__setattr__(self, "joints", numbers(self.joints, 6, "joints"))
        if not isinstance(self.serial, str) or not 1 <= len(self.serial) <= 100:
            raise refused("the plan does not say which robot it is for")
        if not self.pendant.speed_fraction > 0:
            raise refused(
                "the speed slider is at 0 %, so the robot would not move: raise it at the pendant"
            )

    @property
    def identified(self) -> bool:
        """Whether the robot is known by more than its address."""
        return "@" not in self.serial

    @property
    def digest(self) -> str:
        """SHA-256 over poses, limits, TCP offset, payload, speed slider and robot, 64 digits."""
        head = {
            "limits": asdict(self.limits),
            "tcp_offset": self.tcp_offset,
            "serial": self.serial,
            "pendant": asdict(self.pendant),
            "targets": len(self.targets),
        }
        state = hashlib.sha256(b"jaxcal motion plan 2\n")
        state.update(json.dumps(head, sort_keys=True).encode())
        state.update(self.targets.astype("<f8").tobytes())
        return state.hexdigest()

    @cached_property
    def arm(self) -> Arm | None:
        """The arm that the plan is checked for; None where its model is not known."""
        limits = self.limits
        if not limits.arm_model:
            return None
        return Arm(
            model_named(limits.arm_model),
            self.tcp_offset,
            np.radians(limits.joint_min_deg),
            np.radians(limits.joint_max_deg),
            limits.min_singular_value_mm,
            math.radians(limits.max_joint_speed_deg_s),
            np.asarray(limits.arm_box_min_mm),
            np.asarray(limits.arm_box_max_mm),
        )


def plan_lines(plan: MotionPlan, *, tcp_offset_known: bool = True) -> list[str]:
    """The plan's limits as a person must see them before it is confirmed; one fact a line."""
    limits = plan.limits
    hull = np.ptp(limits.probe_points, axis=0)
    x, y, z, *turn = plan.tcp_offset
    offset = (
        f"TCP offset: {_vector(1000 * np.array([x, y, z]))} mm, turned by "
        f"{_vector(np.degrees(turn))} deg"
    )
    return [
        f"probe's tip at {_vector(limits.tip_mm)} mm of the TCP; probe with housing "
        f"{_vector(hull, ' x ')} mm along the TCP's axes",
        f"box for the probe: {_vector(limits.box_min_mm)} to {_vector(limits.box_max_mm)} mm",
        f"box for the arm: {_vector(limits.arm_box_min_mm or ())} to "
        f"{_vector(limits.arm_box_max_mm or ())} mm",
        offset if tcp_offset_known else "TCP offset: not known before the controller is asked",
        f"arm: {limits.arm_model or 'reach, joints, singularities and links NOT checked'}",
        f"caps: step {limits.max_step_mm:g} mm, turn {limits.max_turn_deg:g} deg, tilt "
        f"{limits.cone_deg:g} deg, speed {limits.max_speed_mm_s:g} mm/s "
        f"({limits.search_speed_mm_s:g} mm/s within {limits.search_mm:g} mm and "
        f"{limits.search_deg:g} deg of a pose), force {limits.max_force_n:g} N"
        + (f" ({limits.force_reason})" if limits.force_reason else ""),
    ]


def _vector(values: object, between: str = ", ") -> str:
    return between.join(f"{value:.4g}" for value in np.asarray(values, dtype=np.float64))


def array_of(value: object, what: str) -> np.ndarray:
    """A new float64 array of whatever was given."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise refused(f"{what}: not an array of numbers") from None
