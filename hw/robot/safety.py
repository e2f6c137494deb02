"""What the robot may be asked to do: limits, a plan, the operator's confirmation, and the gate.

No motion is sent unless :meth:`Gate.check_move` allowed it, and what is sent is the
:class:`Command` that it returned. This comes on top of the robot's own safety configuration and
emergency stop, and replaces neither.

The box bounds the probe: its tip and the hull of its array face and housing. Between start and
target the tool centre point (TCP) runs along a line while it turns about a fixed axis; every other
point runs along an arc, so the whole path is checked, not only its ends. Where the arm's model is
known, its joints, singularities and links are checked along the same path
(:mod:`hw.robot.feasibility`).

A move goes to a pose of the plan, or to one within the declared search envelope of such a pose
(fine elevational steps are found by a search and cannot be planned).
"""

from __future__ import annotations

import hashlib
import json
import math
import secrets
import threading
from dataclasses import asdict, dataclass, field
from functools import cached_property

import numpy as np

from hw.clock import Clock
from hw.errors import RefusedError, StaleError
from hw.rigid import inverse, straight_way, turn_deg
from hw.robot.feasibility import Arm, Course, check_model, follow, follow_all
from hw.robot.kinematics import model_named, tool_of
from hw.robot.limits import Limits, between, numbers
from hw.robot.pose import pose_to_ur
from hw.robot.rtde import PendantSettings, state_text
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
    """Which robot: :attr:`hw.robot.identity.Identity.name`."""
    joints: tuple[float, ...] | None = None
    """(6,) the arm's joints, rad, when the plan was made. They decide in which branch of the
    kinematics the plan is checked; None: any branch. Not in the digest: they permit nothing."""
    pendant: PendantSettings = field(default_factory=PendantSettings)
    """Payload and speed slider when the plan was made."""

    def __post_init__(self) -> None:
        targets = _array(self.targets, "the plan's poses")
        if targets.ndim != 3 or targets.shape[1:] != (4, 4):
            raise _refuse(f"the plan's poses must have shape (n, 4, 4), not {targets.shape}")
        if not 1 <= len(targets) <= _MOST_TARGETS:
            raise _refuse(f"a plan has 1 to {_MOST_TARGETS} poses, not {len(targets)}")
        targets.setflags(write=False)
        object.__setattr__(self, "targets", targets)
        object.__setattr__(self, "tcp_offset", numbers(self.tcp_offset, 6, "tcp_offset"))
        if self.joints is not None:
            object.__setattr__(self, "joints", numbers(self.joints, 6, "joints"))
        if not 1 <= len(self.serial) <= 100:
            raise _refuse("the plan does not say which robot it is for")

    @classmethod
    def from_poses(
        cls,
        poses: object,
        limits: Limits,
        tcp_offset: object,
        serial: object,
        pendant: PendantSettings | None = None,
    ) -> MotionPlan:
        """A plan from another program's data; anything that is not a plan is refused.

        Raises:
            RefusedError: not poses, not an offset, or no robot.
        """
        if not isinstance(serial, str):
            raise _refuse("the plan does not say which robot it is for")
        targets = _array(poses, "the plan's poses")
        offset = numbers(tcp_offset, 6, "tcp_offset")
        return cls(targets, limits, offset, serial, pendant=pendant or PendantSettings())

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


@dataclass(frozen=True)
class Confirmation:
    """Permission for one plan on one robot over one connection, which must be made in time.

    Attributes:
        digest: of the plan.
        serial: of the robot.
        issued_s: bench time.
        expires_s: bench time by which the connection must be made; later motions are not limited.
        unattended: whether it was given without asking a person.
        used: set when motion is started with it; every start needs a new confirmation.
    """

    digest: str
    serial: str
    issued_s: float
    expires_s: float
    unattended: bool = False
    used: threading.Event = field(default_factory=threading.Event, compare=False, repr=False)


@dataclass(frozen=True)
class Challenge:
    """A code for a person to type. It confirms one plan, once; the next challenge has another code.

    Attributes:
        plan: the plan to confirm; it is checked first.
        nonce: random.
        used: set once it was answered correctly.

    Raises:
        RefusedError: the plan is not allowed.
    """

    plan: MotionPlan
    nonce: bytes = field(default_factory=lambda: secrets.token_bytes(16))
    used: threading.Event = field(default_factory=threading.Event, compare=False, repr=False)

    def __post_init__(self) -> None:
        check_plan(self.plan)

    @cached_property
    def code(self) -> str:
        """What must be typed: eight hexadecimal digits."""
        return hashlib.sha256(self.nonce + self.plan.digest.encode()).hexdigest()[:8]


_VALID_S = 600.0


def confirm(
    challenge: Challenge, answer: str, *, clock: Clock, valid_s: float = _VALID_S
) -> Confirmation:
    """Take the operator's confirmation of a plan.

    Args:
        challenge: the one that the operator was shown.
        answer: what the operator typed; must be ``challenge.code``.
        clock: bench time.
        valid_s: bench seconds within which motion must be started.

    Raises:
        RefusedError: another answer, or a challenge that was answered before.
    """
    if challenge.used.is_set():
        raise _refuse("this code was typed before; each run has a code of its own")
    if answer.strip().lower() != challenge.code:
        raise _refuse("not confirmed: the code typed is not the one shown")
    challenge.used.set()
    return _confirmation(challenge.plan, clock, valid_s, unattended=False)


LEAST_DIGEST_DIGITS = 16


def confirm_unattended(
    plan: MotionPlan, digest: str, *, clock: Clock, valid_s: float = _VALID_S
) -> Confirmation:
    """Confirm a plan that somebody has named beforehand; nobody is asked, now or later.

    What is lost: no person who sees the robot says, just before it moves, that nobody and nothing
    is in its way. What is kept: only the plan that was named can move the robot.

    Args:
        plan: the plan to confirm; it is checked first.
        digest: the plan's, at least its first :data:`LEAST_DIGEST_DIGITS` digits.
        clock: bench time.
        valid_s: bench seconds within which motion must be started.

    Raises:
        RefusedError: the plan is not allowed, or is not the one named.
    """
    check_plan(plan)
    given = digest.strip().lower()
    if len(given) < LEAST_DIGEST_DIGITS:
        raise _refuse(f"name the plan by at least {LEAST_DIGEST_DIGITS} digits of its digest")
    if not plan.digest.startswith(given):
        raise _refuse(
            f"another plan was named: this one's digest begins with "
            f"{plan.digest[:LEAST_DIGEST_DIGITS]} (poses, limits, robot, TCP offset, payload and "
            "speed slider are part of it)"
        )
    return _confirmation(plan, clock, valid_s, unattended=True)


def _confirmation(
    plan: MotionPlan, clock: Clock, valid_s: float, *, unattended: bool
) -> Confirmation:
    between("valid_s", valid_s, 0.0, 24 * 3600.0)
    now = clock.now()
    return Confirmation(plan.digest, plan.serial, now, now + valid_s, unattended)


@dataclass(frozen=True)
class Command:
    """A motion that the gate allowed, in the controller's units."""

    index: int
    """Of the planned pose that it belongs to."""
    raw: tuple[float, ...]
    """Target: m and rotation vector (rad)."""
    pose: np.ndarray
    """(4, 4) mm, the same target."""
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

    def check_start(self, serial: str, tcp_offset: object, pendant: PendantSettings | None) -> None:
        """Whether motion may begin: as :meth:`check_authority`, and the confirmation is valid now.

        Raises:
            RefusedError: as there, or a confirmation that is not yet, or no longer, valid.
        """
        self.check_authority(serial, tcp_offset, pendant)
        given, now = self.confirmation, self.clock.now()
        if given is None or not given.issued_s <= now < given.expires_s:
            raise _refuse("the confirmation has expired; confirm the plan again")

    def check_authority(
        self, serial: str, tcp_offset: object, pendant: PendantSettings | None
    ) -> None:
        """Whether this plan may move this robot.

        Args:
            serial: of the robot that is connected.
            tcp_offset: of the controller now (m, rad).
            pendant: of the controller now.

        Raises:
            RefusedError: no confirmation, one of another plan or robot, or another TCP offset,
                payload or speed slider than the plan was made with.
        """
        given = self.confirmation
        if given is None:
            raise _refuse("motion needs the operator's confirmation of this plan")
        if given.digest != self._digest:
            raise _refuse("the confirmation is for another plan")
        if given.serial != self.plan.serial or serial != self.plan.serial:
            raise _refuse(
                f"the plan is for robot {self.plan.serial}, the confirmation for "
                f"{given.serial}, and connected is {serial}"
            )
        if tcp_offset is None:
            raise _refuse("the controller's TCP offset is not known")
        current = numbers(tcp_offset, 6, "TCP offset")
        if offset_changed(self.plan.tcp_offset, current):
            raise _refuse(
                f"the controller's TCP offset {list(current)} is not the plan's "
                f"{list(self.plan.tcp_offset)} (m, rad)"
            )
        if pendant is None:
            raise _refuse("the controller's payload and speed slider are not known")
        changed = self.plan.pendant.changed(pendant)
        if changed:
            raise _refuse(f"not as it was when the plan was made: {changed}")

    def check_move(
        self,
        target: object,
        sample: PoseSample,
        speed_mm_s: object,
        *,
        serial: str,
        tcp_offset: object,
        pendant: PendantSettings | None,
        force_n: float,
    ) -> Command:
        """Allow one motion, from where the robot is now.

        Args:
            target: (4, 4) mm, TCP -> robot base; anything else is refused.
            sample: the newest pose.
            speed_mm_s: wanted speed of TCP and tip; None for the cap.
            serial: of the robot that is connected.
            tcp_offset: (6,) of the controller now (m, rad).
            pendant: of the controller now.
            force_n: at the TCP now.

        Raises:
            RefusedError: the motion is not allowed; the text says why. Nothing was sent.
            StaleError: the newest pose is too old.
        """
        self.check_authority(serial, tcp_offset, pendant)
        cap = self.plan.limits.max_force_n
        if not force_n <= cap:
            raise _refuse(f"a force of {force_n:.1f} N meets the tool, over the cap of {cap:g} N")
        return self.check_geometry(target, sample, speed_mm_s)

    def check_geometry(self, target: object, sample: PoseSample, speed_mm_s: object) -> Command:
        """As :meth:`check_move` without confirmation, robot and force: what a dry run can check."""
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
        if (
            not isinstance(speed, int | float)
            or isinstance(speed, bool)
            or not min(_LEAST_SPEED_MM_S, cap) <= speed <= cap
        ):
            raise _refuse(
                f"a speed of {speed!r} mm/s is not within {_LEAST_SPEED_MM_S:g} and {cap:g} mm/s"
            )
        _check_path(self.plan, start, goal, "the motion")
        length, velocity = _pace(start, goal, limits, speed)
        self._check_arm(start, goal, sample, length / velocity)
        acceleration = limits.max_acceleration_mm_s2 / 1000.0
        return Command(
            near[0],
            tuple(float(v) for v in pose_to_ur(goal)),
            goal,
            velocity,
            acceleration,
            length / velocity + velocity / acceleration,
        )

    def _check_arm(
        self, start: np.ndarray, goal: np.ndarray, sample: PoseSample, duration_s: float
    ) -> None:
        """Whether the arm can follow the motion from its present joints."""
        arm = self.plan.arm
        if arm is None:
            return
        if sample.joints is None:
            # The joints are not known: one branch that can follow is enough.
            follow_all(arm, np.stack([start, goal]), np.array([duration_s]))
            return
        joints = np.asarray(sample.joints)
        check_model(arm, start, joints)
        follow(arm, start, goal, joints, "the motion", duration_s)


def check_plan(plan: MotionPlan) -> Course | None:
    """Whether every pose of a plan, and the way from each to the next, is within its limits.

    Returns:
        How the arm follows the plan; None where its model is not known, so that reach, joints and
        singularities were not checked.

    Raises:
        RefusedError: the first pose that is not, and why.
    """
    previous, durations = None, []
    _check_box_in_reach(plan)
    for k, target in enumerate(plan.targets):
        pose = _pose(target, f"pose {k} of the plan")
        _check_path(plan, pose, pose, f"pose {k} of the plan")
        if previous is not None:
            what = f"the way from pose {k - 1} to pose {k}"
            _check_path(plan, previous, pose, what, reserve=True)
            length, velocity = _pace(previous, pose, plan.limits, plan.limits.max_speed_mm_s)
            durations.append(length / velocity)
        previous = pose
    if plan.arm is None:
        return None
    joints = None if plan.joints is None else np.asarray(plan.joints)
    return follow_all(plan.arm, plan.targets, np.array(durations), joints)


def plan_lines(plan: MotionPlan, *, tcp_offset_known: bool = True) -> list[str]:
    """The plan's limits as a person must see them before it is confirmed; one fact a line."""
    limits = plan.limits
    hull = np.ptp(np.array([limits.tip_mm, *limits.hull_mm]), axis=0)
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


def out_of_box_mm(pose: np.ndarray, limits: Limits) -> float:
    """By how much the probe at a pose is out of the box, mm; negative inside."""
    points = _probe_points(limits) @ pose[:3, :3].T + pose[:3, 3]
    low, high = np.asarray(limits.box_min_mm), np.asarray(limits.box_max_mm)
    return float(np.maximum(low - points, points - high).max())


def _probe_points(limits: Limits) -> np.ndarray:
    """(n, 3) the tip and the corners of the hull in the TCP's frame, mm."""
    return np.array([limits.tip_mm, *limits.hull_mm])


def _pace(
    start: np.ndarray, goal: np.ndarray, limits: Limits, speed_mm_s: float
) -> tuple[float, float]:
    """Length of a motion as the controller counts it, and its speed (m and m/s, or rad and rad/s).

    Where a motion is mostly a turn, the controller takes the speed as rad/s instead of m/s. The cap
    holds for the tip as well as for the TCP.
    """
    distance = float(np.linalg.norm(goal[:3, 3] - start[:3, 3])) / 1000.0
    turn = math.radians(turn_deg(start, goal))
    length = max(distance, turn, 1e-9)
    lever = math.hypot(*limits.tip_mm) / 1000.0
    ratio = max(1.0, (distance + turn * lever) / length)
    return length, speed_mm_s / 1000.0 / ratio


def _check_box_in_reach(plan: MotionPlan) -> None:
    """Refuse a box that the arm can never leave: it bounds nothing."""
    if plan.arm is None:
        return
    model, limits = plan.arm.model, plan.limits
    tool = 1000.0 * math.hypot(*plan.tcp_offset[:3])
    tip = float(np.linalg.norm(_probe_points(limits), axis=1).max())
    reach = model.reach_mm + model.d1 + tool + tip
    furthest = max(map(abs, limits.box_min_mm + limits.box_max_mm))
    if furthest > reach:
        raise _refuse(
            f"the box goes to {furthest:g} mm from the base, but a {model.name} with this tool "
            f"reaches {reach:.0f} mm at most: bound the box by what the probe may touch"
        )


def check_sample(sample: PoseSample, limits: Limits, clock: Clock) -> None:
    """Check that a pose is fresh and that the robot is fit to move.

    Raises:
        StaleError: the pose is too old; a new one may come.
        RefusedError: the pose is from the future, the robot reports a safety stop, or it is not
            running.
    """
    age, oldest = sample.age_s(clock.now()), clock.patience(limits.max_pose_age_s)
    if not age <= oldest:
        raise StaleError(f"the newest pose is {sample.age_text(clock.now())}", device="robot")
    if age < -oldest:
        raise _refuse("the newest pose is of another clock: it lies in the future")
    problem = state_text(sample.robot_mode, sample.safety_bits)
    if not problem and sample.safety_bits == 0:
        problem = "the robot tells no safety state: look at the pendant"
    if problem:
        raise _refuse(problem)


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
    plan: MotionPlan, start: np.ndarray, goal: np.ndarray, what: str, *, reserve: bool = False
) -> None:
    """Check step, turn, boxes and cone along a motion.

    ``reserve`` leaves room, in step and turn, for a motion that starts anywhere in the start's
    search envelope.
    """
    limits = plan.limits
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
    way = straight_way(start, goal, np.linspace(0.0, 1.0, count))
    spread = math.radians(turn) / (count - 1)
    probe = _probe_points(limits)
    names = ["the probe's tip"] + ["a corner of the probe"] * len(limits.hull_mm)
    _check_box(way, spread, probe, names, limits.box_min_mm, limits.box_max_mm, f"{what} takes", "")
    flange = inverse(tool_of(plan.tcp_offset))[:3, 3]
    _check_box(
        way,
        spread,
        np.array([np.zeros(3), flange]),
        ["the TCP", "the flange"],
        limits.arm_box_min_mm,
        limits.arm_box_max_mm,
        f"{what} takes",
        "arm's ",
    )
    cosine = way[:, :3, 2] @ np.asarray(limits.cone_axis) / math.hypot(*limits.cone_axis)
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)).max()))
    if not angle <= limits.cone_deg + _TURN_TOLERANCE_DEG:
        raise _refuse(f"{what} tilts the tool {angle:.2f} deg, over {limits.cone_deg:g} deg")


def _check_box(
    way: np.ndarray,
    spread: float,
    points: np.ndarray,
    names: list[str],
    low: object,
    high: object,
    what: str,
    whose: str,
) -> None:
    """Check that points of the tool stay in a box along a way with samples ``spread`` rad apart.

    A point at a distance a (mm) from the TCP runs along a line plus an arc about the TCP. Linear
    interpolation of the arc is off by at most a spread^2 / 8 (the second derivative is a spread^2).
    A box is convex, so points that are inside by this margin at the samples are inside in between.
    """
    places = np.einsum("nij,pj->npi", way[:, :3, :3], points) + way[:, None, :3, 3]
    sag = np.linalg.norm(points, axis=1) * spread**2 / 8.0
    room = np.minimum(places - np.asarray(low), np.asarray(high) - places)
    room = (room - sag[:, None]).min(axis=0)
    if not room.min() >= -_POSITION_TOLERANCE_MM:
        point, axis = np.unravel_index(int(room.argmin()), room.shape)
        raise _refuse(
            f"{what} {names[point]} {-room.min():.3f} mm out of the {whose}box along {'xyz'[axis]}"
        )
