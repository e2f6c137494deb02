"""An arm that moves its tool along straight lines, in bench time.

A motion is a path (position along a line, orientation along a great circle, both with the same
parameter) and a profile over it (trapezoid of speed, or a brake). The state at any bench time
follows from the last motion alone, so reading it has no side effects and any thread may do so.

Another TCP offset (:meth:`Arm.set_tcp_offset`) changes what is reported and commanded, not where
the tool is: the path of a motion is that of the TCP at its start.

The tool reaches a commanded pose only to within the arm's repeatability: :meth:`Arm.raw` is the
pose by the joint encoders, :meth:`Arm.true_raw` is where the tool is. The difference is redrawn
with travel (its correlation falls as exp(-travel / 20 mm)), because a fine step hardly
changes the gears' error while a long move changes all of it.

With a model the arm has joints (:mod:`hw.bench.joints`), and places where it cannot follow.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hw.bench.joints import LEAST_DEXTERITY_MM, JointTrack, Motion, Vector, first_joints, track
from hw.robot.kinematics import branch_of, dexterity_mm, flange_of, inverse, model_named
from hw.runtime.rigid import ur_to_pose

_CORRELATION_M = 0.02
"""Travel over which the error of the tool is forgotten."""
_HALT_M_S2 = 2.0
"""Of a protective stop, and of a program that is stopped."""
_REACH_M = (0.15, 0.85)
"""Distance of the tool from the base that counts as safe, where the arm has no model."""
_AHEAD_S = 0.01
"""Longest time between two checks of the arm by a controller; a CB-series one checks every 8 ms."""


class Arm:
    """The emulated arm.

    Args:
        raw: where the tool starts, [x, y, z] m and rotation vector rad, in the base frame.
        tcp_offset: the real tool's centre point in the flange's frame, m and rotation vector rad.
        repeatability_mm: SD of the tool's position error per axis.
        repeatability_deg: SD of its orientation error per axis.
        seed: of the errors.
        model: name of the arm whose joints these are (:data:`hw.robot.kinematics.MODELS`); None: a
            tool that moves without an arm, without joints and singularities.
    """

    def __init__(
        self,
        raw: Sequence[float],
        *,
        tcp_offset: Sequence[float] = (0.0,) * 6,
        repeatability_mm: float = 0.0,
        repeatability_deg: float = 0.0,
        seed: int = 0,
        model: str | None = None,
    ) -> None:
        self.settings = {
            "raw": _six(raw),
            "tcp_offset": _six(tcp_offset),
            "repeatability_mm": repeatability_mm,
            "repeatability_deg": repeatability_deg,
            "seed": seed,
            "model": model,
        }
        """The arguments, so that another process can make the same arm."""
        self.watcher: Callable[[Motion], None] | None = None
        """Told of every new motion, in the thread that commands it."""
        self._tool: Vector = _six(tcp_offset)
        self.force: Vector = (0.0,) * 6
        """Force and torque on the tool: N and N m."""
        self._sd = (repeatability_mm / 1000.0,) * 3 + (math.radians(repeatability_deg),) * 3
        self._random = random.Random(seed)
        first = tuple(self._random.gauss(0.0, sd) for sd in self._sd)
        start = _six(raw)
        self._motion = Motion(
            -math.inf,
            start[:3],
            _quaternion(start[3:]),
            (0.0,) * 3,
            (0.0,) * 3,
            0.0,
            1.0,
            1.0,
            error=(first, first),
            planned_tcp=self._tool,
            tcp=self._tool,
        )
        self.model = None if model is None else model_named(model)
        self._track: JointTrack | None = None
        if self.model is not None:
            joints = first_joints(self.model, start, self.tcp_offset)
            self._track = track(self.model, self._motion, self.tcp_offset, joints)

    @property
    def tcp_offset(self) -> Vector:
        """The tool centre point in the flange's frame (m, rad), as set at the controller."""
        return self._motion.tcp

    def set_tcp_offset(self, offset: Sequence[float]) -> None:
        """Report and command another point of the tool; nothing moves."""
        self.follow(replace(self._motion, tcp=_six(offset)))

    def move_linear(
        self, t: float, target: Sequence[float], speed: float, acceleration: float
    ) -> float:
        """Move to a pose in a straight line; returns the bench time (s) of arrival.

        Args:
            t: bench time now, s.
            target: [x, y, z] m and rotation vector rad.
            speed: m/s of the tool; where the turn in rad is more than the travel in m, rad/s.
            acceleration: m/s^2, or rad/s^2 in the same case.
        """
        motion = self._plan(t, target, speed, acceleration)
        self.follow(motion)
        return t + motion.duration()

    def follow(self, motion: Motion) -> None:
        """Take over a motion from now on; so an arm can mirror one in another process."""
        self._motion = motion
        if self.watcher is not None:
            self.watcher(motion)

    def _plan(self, t: float, target: Sequence[float], speed: float, acceleration: float) -> Motion:
        motion = self._motion
        position, quaternion, error = _where(motion, t)
        goal = _six(target)
        travel = tuple(b - a for a, b in zip(position, goal[:3], strict=True))
        turn = _rotation_vector(_multiply(_quaternion(goal[3:]), _conjugate(quaternion)))
        distance = math.hypot(*travel)
        length = max(distance, math.hypot(*turn))
        keep = math.exp(-distance / _CORRELATION_M)
        fresh = math.sqrt(1 - keep**2)
        drawn = tuple(
            keep * e + fresh * self._random.gauss(0.0, sd)
            for e, sd in zip(error, self._sd, strict=True)
        )
        return Motion(
            t,
            position,
            quaternion,
            travel,
            turn,
            length,
            speed,
            acceleration,
            error=(error, drawn),
            planned_tcp=motion.tcp,
            tcp=motion.tcp,
        )

    def servo(self, t: float, target: Sequence[float], duration: float) -> None:
        """Be at a pose after ``duration`` s, at a constant speed."""
        motion = self._plan(t, target, 1.0, 1e9)
        speed = max(motion.length / max(duration, 1e-3), 1e-9)
        self.follow(replace(motion, speed=speed))

    def stop(self, t: float, acceleration: float | None = None) -> float:
        """Brake on the path (m/s^2); returns the bench time (s) at which the arm rests."""
        moving = self._motion
        first, rate = moving.at(t)
        if rate == 0.0 and t >= moving.start + moving.duration():
            return t
        brake = replace(
            moving,
            start=t,
            first=first,
            speed=rate,
            brake=True,
            acceleration=acceleration or _HALT_M_S2,
        )
        self.follow(brake)
        return t + brake.duration()

    def raw(self, t: float) -> Vector:
        """Pose by the encoders at bench time t: m and rotation vector (rad)."""
        position, quaternion, _ = _where(self._motion, t)
        return position + _rotation_vector(quaternion)

    def true_raw(self, t: float) -> Vector:
        """Where the tool really is at bench time t: m and rotation vector (rad)."""
        # Once: where this arm mirrors one in another process, a thread takes over its motions.
        motion = self._motion
        position, quaternion, error = _where(motion, t)
        position, quaternion = _retooled(position, quaternion, motion.tcp, self._tool)
        moved = tuple(p + e for p, e in zip(position, error, strict=False))
        return moved + _rotation_vector(_multiply(_quaternion(error[3:]), quaternion))

    def velocity(self, t: float) -> Vector:
        """Speed of the tool at bench time t: m/s and rad/s."""
        moving = self._motion
        _, rate = moving.at(t)
        if rate == 0.0 or moving.length == 0.0:
            return (0.0,) * 6
        return tuple(v * rate / moving.length for v in moving.travel + moving.turn)

    def rest_since(self, t: float) -> float | None:
        """Bench time (s) since which the arm rests; None while it moves."""
        end = self._motion.start + self._motion.duration()
        return None if t < end else end

    def joints(self, t: float) -> Vector | None:
        """Angles of the joints by the encoders at bench time t, rad; None without a model."""
        found = self._tracked()
        if found is None:
            return None
        return tuple(found.at(self._motion.at(t)[0]).tolist())

    def joint_speeds(self, t: float) -> Vector | None:
        """Speeds of the joints at bench time t, rad/s; None without a model."""
        found = self._tracked()
        if found is None:
            return None
        place, rate = self._motion.at(t)
        return tuple((rate * found.slope(place)).tolist())

    def at_its_end(self, t: float) -> bool:
        """Whether the arm must brake now to rest before a place where it cannot follow the path."""
        found, moving = self._tracked(), self._motion
        if found is None or math.isinf(found.end) or moving.brake:
            return False
        place, rate = moving.at(t)
        if t >= moving.start + moving.duration():
            return False
        ahead = rate * _AHEAD_S + rate**2 / (2 * _HALT_M_S2)
        return place + ahead >= found.end - 1e-6

    def _tracked(self) -> JointTrack | None:
        """The joints along the present motion, computed when they are first needed."""
        before, moving = self._track, self._motion
        if before is None or self.model is None or before.motion is moving:
            return before
        if before.same_path(moving):
            found = replace(before, motion=moving)
        else:
            start = before.at(before.motion.at(moving.start)[0])
            found = track(self.model, moving, moving.planned_tcp, start)
        self._track = found
        return found

    def within_reach(self, raw: Sequence[float]) -> bool:
        """Whether a pose (m, rad) counts as within the arm's safety limits."""
        found = self._tracked()
        if found is not None and self.model is not None:
            if not all(math.isfinite(v) for v in raw):
                return False
            flange = flange_of(ur_to_pose(np.array(raw, dtype=np.float64)), self.tcp_offset)
            here = inverse(self.model, flange)
            branch = int(branch_of(self.model, found.joints[-1]))
            return bool(
                here.reached[branch]
                and dexterity_mm(self.model, here.joints[branch]) >= LEAST_DEXTERITY_MM
            )
        low, high = _REACH_M
        return all(math.isfinite(v) for v in raw) and low <= math.hypot(*raw[:3]) <= high


def _where(motion: Motion, t: float) -> tuple[Vector, Vector, Vector]:
    """Position and orientation of the TCP that is reported, and the arm's error."""
    part = 0.0 if motion.length == 0.0 else motion.at(t)[0] / motion.length
    position = tuple(p + part * d for p, d in zip(motion.position, motion.travel, strict=True))
    step = _quaternion(tuple(part * w for w in motion.turn))
    first, last = motion.error
    error = tuple(a + part * (b - a) for a, b in zip(first, last, strict=True))
    quaternion = _multiply(step, motion.quaternion)
    return *_retooled(position, quaternion, motion.planned_tcp, motion.tcp), error


def _retooled(
    position: Vector, quaternion: Vector, before: Vector, after: Vector
) -> tuple[Vector, Vector]:
    """Pose of another point of the same tool: both points as TCP offsets (m, rad)."""
    if before == after:
        return position, quaternion
    flange = _multiply(quaternion, _conjugate(_quaternion(before[3:])))
    arm = tuple(b - a for a, b in zip(before[:3], after[:3], strict=True))
    shift = _multiply(_multiply(flange, (0.0, *arm)), _conjugate(flange))[1:]
    moved = tuple(p + s for p, s in zip(position, shift, strict=True))
    return moved, _multiply(flange, _quaternion(after[3:]))


def _six(values: Sequence[float]) -> Vector:
    result = tuple(float(v) for v in values)
    if len(result) != 6 or not all(math.isfinite(v) for v in result):
        raise ValueError(f"a pose is six finite numbers (m, rad), not {result}")
    return result


# As in hw.runtime.rigid, but in plain Python: the controller calls these a thousand times a second,
# and what takes 6 us here takes 76 us with numpy on arrays of four numbers.


def _quaternion(vector: Sequence[float]) -> Vector:
    angle = math.hypot(*vector)
    scale = 0.5 - angle**2 / 48 if angle < 1e-6 else math.sin(angle / 2) / angle
    return (math.cos(angle / 2), *(scale * v for v in vector))


def _rotation_vector(quaternion: Sequence[float]) -> Vector:
    w, *vector = quaternion if quaternion[0] >= 0 else [-v for v in quaternion]
    sine = math.hypot(*vector)
    scale = 2.0 if sine < 1e-12 else 2 * math.atan2(sine, w) / sine
    return tuple(scale * v for v in vector)


def _conjugate(q: Sequence[float]) -> Vector:
    return (q[0], -q[1], -q[2], -q[3])


def _multiply(p: Sequence[float], q: Sequence[float]) -> Vector:
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )
