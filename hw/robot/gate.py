"""The gate: no motion is sent that :meth:`Gate.check_move` did not allow.

What is sent is the :class:`Command` that it returned. This comes on top of the robot's own safety
configuration and emergency stop, and replaces neither.

A move goes to a pose of the plan, or to one within the declared search envelope of such a pose
(fine elevational steps are found by a search and cannot be planned).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hw.robot.confirmation import Confirmation
from hw.robot.feasibility import check_model, follow, follow_all
from hw.robot.limits import Limits, numbers
from hw.robot.motion_plan import MotionPlan
from hw.robot.path_checks import check_path, checked_pose, pace, within_search
from hw.robot.rtde import PendantSettings, state_text
from hw.robot.stream import PoseSample, offset_changed
from hw.runtime.clock import Clock, asleep_s
from hw.runtime.errors import StaleError, refused
from hw.runtime.rigid import pose_to_ur

_LEAST_SPEED_MM_S = 0.01
"""A slower move is a mistake of units; at 0.01 mm/s a search step of 0.05 mm takes 5 s."""


@dataclass(frozen=True)
class Command:
    """A motion that the gate allowed, in the controller's units."""

    raw: tuple[float, ...]
    """Target: m and rotation vector (rad)."""
    pose: np.ndarray
    """(4, 4) mm, the same target."""
    speed_mm_s: float
    """Bound of the speed of TCP and tip."""
    speed_m_s: float
    """As the controller takes it (:func:`hw.robot.path_checks.pace`)."""
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
        if given is not None:
            # A computer that slept counts no time meanwhile, but people come and go.
            now += (asleep_s() - given.asleep_s) * self.clock.speed
        if given is None or not given.issued_s <= now < given.expires_s:
            raise refused("the confirmation has expired; confirm the plan again")

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
            raise refused("motion needs the operator's confirmation of this plan")
        if given.digest != self._digest:
            raise refused("the confirmation is for another plan")
        if given.serial != self.plan.serial or serial != self.plan.serial:
            raise refused(
                f"the plan is for robot {self.plan.serial}, the confirmation for "
                f"{given.serial}, and connected is {serial}"
            )
        if tcp_offset is None:
            raise refused("the controller's TCP offset is not known")
        current = numbers(tcp_offset, 6, "TCP offset")
        if offset_changed(self.plan.tcp_offset, current):
            raise refused(
                f"the controller's TCP offset {list(current)} is not the plan's "
                f"{list(self.plan.tcp_offset)} (m, rad)"
            )
        if pendant is None:
            raise refused("the controller's payload and speed slider are not known")
        changed = self.plan.pendant.changed(pendant)
        if changed:
            raise refused(f"not as it was when the plan was made: {changed}")

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
            raise refused(f"a force of {force_n:.1f} N meets the tool, over the cap of {cap:g} N")
        return self.check_geometry(target, sample, speed_mm_s)

    def check_geometry(self, target: object, sample: PoseSample, speed_mm_s: object) -> Command:
        """As :meth:`check_move` without confirmation, robot and force: what a dry run can check."""
        limits = self.plan.limits
        check_sample(sample, limits, self.clock)
        goal = checked_pose(target, "the target")
        start = checked_pose(sample.pose, "the robot's pose")
        near = [k for k, pose in enumerate(self.plan.targets) if within_search(pose, goal, limits)]
        if not near:
            raise refused(
                f"the target is neither a planned pose nor within {limits.search_mm:g} mm and "
                f"{limits.search_deg:g} deg of one"
            )
        searching = any(within_search(self.plan.targets[k], start, limits) for k in near)
        cap = min(limits.max_speed_mm_s, limits.search_speed_mm_s if searching else math.inf)
        speed = cap if speed_mm_s is None else speed_mm_s
        if (
            not isinstance(speed, int | float)
            or isinstance(speed, bool)
            or not _LEAST_SPEED_MM_S <= speed <= cap
        ):
            raise refused(
                f"a speed of {speed!r} mm/s is not within {_LEAST_SPEED_MM_S:g} and {cap:g} mm/s"
            )
        check_path(self.plan, start, goal, "the motion")
        length, velocity = pace(start, goal, limits, speed)
        self._check_arm(start, goal, sample, length / velocity)
        acceleration = limits.max_acceleration_mm_s2 / 1000.0
        return Command(
            tuple(float(v) for v in pose_to_ur(goal)),
            goal,
            speed,
            velocity,
            acceleration,
            # The speed slider slows the whole motion down, as it was when the plan was made.
            (length / velocity + velocity / acceleration) / self.plan.pendant.speed_fraction,
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
        raise refused("the newest pose is of another clock: it lies in the future")
    problem = state_text(sample.robot_mode, sample.safety_bits)
    if problem:
        raise refused(problem)
