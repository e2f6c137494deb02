"""What the robot may be asked to do: limits, a plan, the operator's confirmation, and the gate.

Nothing is commanded that :meth:`Gate.check_move` did not allow, and what is sent is the
:class:`Command` that it returned. This comes on top of the robot's own safety configuration and
emergency stop, and replaces neither.

The box bounds the probe's tip, not the flange or the tool centre point (TCP). Between start and
target the TCP runs along a line while it turns about a fixed axis; the tip then runs along an arc,
so the whole path is checked, not only its ends.

A move goes to a pose of the plan, or to one within the declared search envelope of such a pose
(fine elevational steps are searched for, they cannot be planned).
"""

from __future__ import annotations

import hashlib
import json
import math
import threading
from dataclasses import asdict, dataclass, field
from functools import cached_property

import numpy as np

from hw.clock import Clock
from hw.errors import RefusedError, StaleError
from hw.rigid import rotation_matrix, rotation_vector, turn_deg
from hw.robot.limits import Limits, between, numbers
from hw.robot.pose import pose_to_ur
from hw.robot.rtde import RUNNING_MODE, safety_text
from hw.robot.stream import PoseSample, offset_changed

_ROTATION_TOLERANCE = 1e-6
_POSITION_TOLERANCE_MM = 1e-6
_TURN_TOLERANCE_DEG = 1e-3
_PATH_STEP_DEG = 0.25
_MOST_TARGETS = 10_000
_LEAST_SPEED_MM_S = 0.01
"""A slower move is a mistake of units; at 0.01 mm/s a search step of 0.05 mm takes 5 s."""


def _refuse(text: str) -> RefusedError:
    return RefusedError(text, device="robot")


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
    """Of the robot."""

    def __post_init__(self) -> None:
        targets = _array(self.targets, "the plan's poses")
        if targets.ndim != 3 or targets.shape[1:] != (4, 4):
            raise _refuse(f"the plan's poses must have shape (n, 4, 4), not {targets.shape}")
        if not 1 <= len(targets) <= _MOST_TARGETS:
            raise _refuse(f"a plan has 1 to {_MOST_TARGETS} poses, not {len(targets)}")
        targets.setflags(write=False)
        object.__setattr__(self, "targets", targets)
        object.__setattr__(self, "tcp_offset", numbers(self.tcp_offset, 6, "tcp_offset"))
        if not 1 <= len(self.serial) <= 100:
            raise _refuse("the plan does not say which robot it is for")

    @classmethod
    def from_poses(
        cls, poses: object, limits: Limits, tcp_offset: object, serial: object
    ) -> MotionPlan:
        """A plan from what somebody else made; anything that is no plan is refused.

        Raises:
            RefusedError: not poses, not an offset, or no robot.
        """
        if not isinstance(serial, str):
            raise _refuse("the plan does not say which robot it is for")
        targets = _array(poses, "the plan's poses")
        return cls(targets, limits, numbers(tcp_offset, 6, "tcp_offset"), serial)

    @property
    def digest(self) -> str:
        """SHA-256 over poses, limits, TCP offset and robot; 64 hexadecimal digits."""
        head = {
            "limits": asdict(self.limits),
            "tcp_offset": self.tcp_offset,
            "serial": self.serial,
            "targets": len(self.targets),
        }
        state = hashlib.sha256(b"jaxcal motion plan 1\n")
        state.update(json.dumps(head, sort_keys=True).encode())
        state.update(self.targets.astype("<f8").tobytes())
        return state.hexdigest()

    @property
    def code(self) -> str:
        """What the operator types to confirm: the digest's first eight digits."""
        return self.digest[:8]


@dataclass(frozen=True)
class Confirmation:
    """The operator's word for one plan, one robot and one connection, for a while."""

    digest: str
    serial: str
    issued_s: float
    """Bench time."""
    expires_s: float
    """Bench time."""
    used: threading.Event = field(default_factory=threading.Event, compare=False, repr=False)
    """Set by the motion process that was started with it; a second one needs another."""


def confirm(
    plan: MotionPlan, answer: str, *, clock: Clock, valid_s: float = 3600.0
) -> Confirmation:
    """Take the operator's confirmation of a plan.

    Args:
        plan: it is checked first.
        answer: what the operator typed; must be ``plan.code``.
        clock: bench time.
        valid_s: bench seconds until it expires.

    Raises:
        RefusedError: the plan is not allowed, or another answer.
    """
    check_plan(plan)
    if answer.strip().lower() != plan.code:
        raise _refuse("not confirmed: the code typed is not that of this plan")
    between("valid_s", valid_s, 0.0, 24 * 3600.0)
    now = clock.now()
    return Confirmation(plan.digest, plan.serial, now, now + valid_s)


@dataclass(frozen=True)
class Command:
    """A motion that the gate allowed, in the controller's units."""

    index: int
    """Of the planned pose that it belongs to."""
    raw: tuple[float, ...]
    """Target: m and rotation vector (rad)."""
    pose: np.ndarray
    """(4, 4) mm, the same."""
    speed_m_s: float
    acceleration_m_s2: float
    duration_s: float
    """Bench seconds that it should take."""


@dataclass(frozen=True)
class Gate:
    """Allows or refuses motions of one plan on one robot.

    Args:
        plan: what may be done.
        confirmation: None for a dry run, for which :meth:`check_authority` always refuses.
        clock: bench time.
    """

    plan: MotionPlan
    confirmation: Confirmation | None
    clock: Clock

    @cached_property
    def _digest(self) -> str:
        # The plan's arrays are read-only copies, so its digest cannot change.
        return self.plan.digest

    def check_authority(self, serial: str, tcp_offset: object) -> None:
        """Whether this plan may move this robot now.

        Args:
            serial: of the robot that is connected.
            tcp_offset: of the controller now (m, rad).

        Raises:
            RefusedError: no confirmation, one of another plan or robot, not yet or no longer
                valid, or another TCP offset than the plan was made with.
        """
        given, now = self.confirmation, self.clock.now()
        if given is None:
            raise _refuse("motion needs the operator's confirmation of this plan")
        if given.digest != self._digest:
            raise _refuse("the confirmation is for another plan")
        if given.serial != self.plan.serial or serial != self.plan.serial:
            raise _refuse(
                f"the plan is for robot {self.plan.serial}, the confirmation for "
                f"{given.serial}, and connected is {serial}"
            )
        if not given.issued_s <= now < given.expires_s:
            raise _refuse("the confirmation has expired; confirm the plan again")
        if tcp_offset is None:
            raise _refuse("the controller's TCP offset is not known")
        current = numbers(tcp_offset, 6, "TCP offset")
        if offset_changed(self.plan.tcp_offset, current):
            raise _refuse(
                f"the controller's TCP offset {list(current)} is not the plan's "
                f"{list(self.plan.tcp_offset)} (m, rad)"
            )

    def check_move(
        self,
        target: object,
        sample: PoseSample,
        speed_mm_s: object,
        *,
        serial: str,
        tcp_offset: object,
        force_n: float,
    ) -> Command:
        """Allow one motion, from where the robot is now.

        Args:
            target: (4, 4) mm, TCP -> robot base; anything else is refused.
            sample: the newest pose.
            speed_mm_s: wanted speed of TCP and tip; None for the cap.
            serial: of the robot that is connected.
            tcp_offset: (6,) of the controller now (m, rad).
            force_n: at the TCP now.

        Raises:
            RefusedError: it may not be done; the text says why. Nothing was sent.
            StaleError: the newest pose is too old.
        """
        self.check_authority(serial, tcp_offset)
        cap = self.plan.limits.max_force_n
        if not force_n <= cap:
            raise _refuse(f"a force of {force_n:.1f} N meets the tool, over the cap of {cap:g} N")
        return self.check_geometry(target, sample, speed_mm_s)

    def check_geometry(self, target: object, sample: PoseSample, speed_mm_s: object) -> Command:
        """As :meth:`check_move` but for the confirmation: all that a dry run can check."""
        limits = self.plan.limits
        check_sample(sample, limits, self.clock)
        goal = _pose(target, "the target")
        start = _pose(sample.pose, "the robot's pose")
        near = [k for k, pose in enumerate(self.plan.targets) if _within(pose, goal, limits)]
        if not near:
            raise _refuse(
                f"the target is neither a planned pose nor within {limits.search_mm:g} mm and "
                f"{limits.search_deg:g} deg of one"
            )
        searching = any(_within(self.plan.targets[k], start, limits) for k in near)
        cap = min(limits.max_speed_mm_s, limits.search_speed_mm_s if searching else math.inf)
        speed = cap if speed_mm_s is None else speed_mm_s
        number = isinstance(speed, int | float) and not isinstance(speed, bool)
        if not number or not min(_LEAST_SPEED_MM_S, cap) <= speed <= cap:
            raise _refuse(
                f"a speed of {speed!r} mm/s is not within {_LEAST_SPEED_MM_S:g} and {cap:g} mm/s"
            )
        _check_path(start, goal, limits, "the motion")

        distance = float(np.linalg.norm(goal[:3, 3] - start[:3, 3])) / 1000.0
        turn = math.radians(turn_deg(start, goal))
        length = max(distance, turn, 1e-9)
        lever = math.hypot(*limits.tip_mm) / 1000.0
        # The controller reads a speed in m/s as rad/s where a motion is mostly a turn; the tip
        # must keep the cap as well as the TCP.
        ratio = max(1.0, (distance + turn * lever) / length)
        velocity = speed / 1000.0 / ratio
        acceleration = limits.max_acceleration_mm_s2 / 1000.0
        return Command(
            near[0], tuple(float(v) for v in pose_to_ur(goal)), goal, velocity, acceleration,
            length / velocity + velocity / acceleration,
        )  # fmt: skip


def check_plan(plan: MotionPlan) -> None:
    """Whether every pose of a plan, and the way from each to the next, is within its limits.

    Raises:
        RefusedError: the first pose that is not, and why.
    """
    limits = plan.limits
    previous = None
    for k, target in enumerate(plan.targets):
        pose = _pose(target, f"pose {k} of the plan")
        _check_path(pose, pose, limits, f"pose {k} of the plan")
        if previous is not None:
            what = f"the way from pose {k - 1} to pose {k}"
            _check_path(previous, pose, limits, what, reserve=True)
        previous = pose


def check_sample(sample: PoseSample, limits: Limits, clock: Clock) -> None:
    """Whether a pose is new, and the robot fit to move.

    Raises:
        StaleError: too old; a new pose may come.
        RefusedError: from the future, or a robot in another mode than running.
    """
    age, oldest = sample.age_s(clock.now()), clock.patience(limits.max_pose_age_s)
    if not age <= oldest:
        raise StaleError(f"the newest pose is {age * 1000:.0f} ms old", device="robot")
    if age < -oldest:
        raise _refuse("the newest pose is of another clock: it lies in the future")
    problem = safety_text(sample.safety_bits)
    if problem:
        raise _refuse(f"the robot reports: {problem}")
    if sample.safety_bits == 0 or sample.robot_mode != RUNNING_MODE:
        raise _refuse(f"the robot is not running (mode {sample.robot_mode})")


def _array(value: object, what: str) -> np.ndarray:
    """A new float64 array of whatever was given."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise _refuse(f"{what}: not an array of numbers") from None


def _pose(value: object, what: str) -> np.ndarray:
    pose = _array(value, what)
    if pose.shape != (4, 4):
        raise _refuse(f"{what} must have shape (4, 4), not {pose.shape}")
    if not np.isfinite(pose).all():
        raise _refuse(f"{what} holds NaN or Inf")
    rotation = pose[:3, :3]
    if (
        np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > _ROTATION_TOLERANCE
        or np.abs(rotation).max() > 2.0
        or np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE
        or np.linalg.det(rotation) < 0
    ):
        raise _refuse(f"{what} is no rigid transform: its 3x3 block is not a rotation")
    return pose


def _within(planned: np.ndarray, pose: np.ndarray, limits: Limits) -> bool:
    """Whether a pose lies in the search envelope of a planned one."""
    offset = np.linalg.norm(pose[:3, 3] - planned[:3, 3])
    return bool(
        offset <= limits.search_mm + _POSITION_TOLERANCE_MM
        and turn_deg(planned, pose) <= limits.search_deg + _TURN_TOLERANCE_DEG
    )


def _check_path(
    start: np.ndarray, goal: np.ndarray, limits: Limits, what: str, *, reserve: bool = False
) -> None:
    """Step, turn, box and cone along a motion.

    ``reserve`` keeps room for a motion that starts anywhere in the start's search envelope.
    """
    tip = np.asarray(limits.tip_mm)
    travel = goal[:3, 3] - start[:3, 3]
    tip_travel = travel + (goal[:3, :3] - start[:3, :3]) @ tip
    step = max(float(np.linalg.norm(travel)), float(np.linalg.norm(tip_travel)))
    turn = turn_deg(start, goal)
    if not step + reserve * limits.search_mm <= limits.max_step_mm + _POSITION_TOLERANCE_MM:
        raise _refuse(f"{what} is {step:.3f} mm long, over the cap of {limits.max_step_mm:g} mm")
    if not turn + reserve * limits.search_deg <= limits.max_turn_deg + _TURN_TOLERANCE_DEG:
        raise _refuse(f"{what} turns {turn:.3f} deg, over the cap of {limits.max_turn_deg:g} deg")

    count = 2 + math.ceil(turn / _PATH_STEP_DEG)
    part = np.linspace(0.0, 1.0, count)
    axis = rotation_vector(goal[:3, :3] @ start[:3, :3].T)
    rotations = rotation_matrix(part[:, None] * axis) @ start[:3, :3]
    tips = start[:3, 3] + part[:, None] * travel + rotations @ tip
    # Between two samples the tip leaves its chord by at most this.
    sag = float(np.linalg.norm(tip)) * (1 - math.cos(math.radians(turn) / (2 * (count - 1))))
    room = np.minimum(tips - limits.box_min_mm, limits.box_max_mm - tips).min(axis=0)
    if not room.min() >= sag - _POSITION_TOLERANCE_MM:
        axis_name = "xyz"[int(room.argmin())]
        raise _refuse(
            f"{what} takes the probe's tip {sag - room.min():.3f} mm out of the box along "
            f"{axis_name}"
        )
    cosine = rotations[:, :, 2] @ np.asarray(limits.cone_axis) / math.hypot(*limits.cone_axis)
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)).max()))
    if not angle <= limits.cone_deg + _TURN_TOLERANCE_DEG:
        raise _refuse(f"{what} tilts the tool {angle:.2f} deg, over {limits.cone_deg:g} deg")
