"""The robot as a tracker: every pose with host and device time; an old pose never passes as new.

A separate process reads the controller. So the parent's interpreter lock does not delay reading, a
silent controller does not freeze the parent, and the parent can always kill that process.
:meth:`PoseStream.latest` raises an error rather than return a pose older than the limit. The age
counts from arrival, plus an upper bound of how long the pose was on its way (:class:`Lag`), so a
latency that was there from the start counts too.
"""

from __future__ import annotations

import math
import pickle
import subprocess
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import IO, Any

import numpy as np

from hw.robot.identity import Identity, read_identity
from hw.robot.rtde import Packet, PendantSettings, check_latency, listed
from hw.runtime.clock import REAL, Clock, Lag, Waiting
from hw.runtime.errors import DeviceError, LostError, StaleError, refused
from hw.runtime.interrupts import lock_and_condition
from hw.runtime.processes import spawn
from hw.runtime.rigid import mean_pose, pose_to_ur, ur_to_pose
from jaxcal.runtime.array_types import Float

_OFFSET_TOLERANCE = 1e-6
_TURN_WALL_S = 0.1
_MOST_POSES = 60_000
"""Most poses kept for :meth:`PoseStream.drain`; beyond it the oldest are dropped, and counted."""


@dataclass(frozen=True)
class PoseSample:
    """One pose of the tool centre point."""

    t_host: float
    """Bench time (s) at which it arrived."""
    t_device: float
    """The controller's own time (s)."""
    raw: tuple[float, ...]
    """[x, y, z, rx, ry, rz] in metres and a rotation vector (rad), as the controller sent it."""
    safety_bits: int
    robot_mode: int
    runtime_state: int
    lag_s: float = 0.0
    """Upper bound of how long it was on its way, bench s; infinite if not known (:class:`Lag`)."""
    joints: tuple[float, ...] | None = None
    """(6,) rad; None where they were not read from the controller."""

    @classmethod
    def of(cls, packet: Packet, clock: Clock, lag: Lag) -> PoseSample:
        """The pose in a packet."""
        t_host = clock.at(packet.monotonic_s)
        return cls(
            t_host,
            packet.timestamp_s,
            packet.tcp_pose,
            packet.safety_bits,
            packet.robot_mode,
            packet.runtime_state,
            lag.of(t_host, packet.timestamp_s),
            packet.joints,
        )

    @cached_property
    def pose(self) -> Float[np.ndarray, "4 4"]:
        """(4, 4) mm: tool centre point -> robot base."""
        return ur_to_pose(np.asarray(self.raw))

    @property
    def measured_s(self) -> float:
        """Bench time (s) before which the controller did not measure it."""
        return self.t_host - self.lag_s

    def age_s(self, now: float) -> float:
        """Bench seconds since the controller measured it, as far as that can be known."""
        return now - self.measured_s

    def age_text(self, now: float) -> str:
        """Its age in words, split into the time since arrival and the latency before."""
        if math.isinf(self.lag_s):
            return "of unknown age: the controller's clock was set forward, or runs too fast"
        return (
            f"{1000 * self.age_s(now):.0f} ms old: it came {1000 * (now - self.t_host):.0f} ms ago "
            f"and was on its way for up to {1000 * self.lag_s:.0f} ms"
        )


@dataclass(frozen=True)
class SteadyPose:
    """An average over poses at rest."""

    sample: PoseSample
    """The last pose, with ``raw`` the average (m and rad)."""
    count: int
    scatter_mm: float
    """Root mean square distance from the average position."""


class PoseStream:
    """Poses from a controller at ``host``, read by a separate process.

    Args:
        host: the controller's address.
        clock: bench time.
        frequency_hz: poses per second; by default all the controller makes.
        max_age_s: bench seconds after which :meth:`latest` refuses a pose.
        timeout_s: wall seconds for the connection, and of silence before it counts as lost.
    """

    def __init__(
        self,
        host: str,
        *,
        clock: Clock = REAL,
        frequency_hz: float | None = None,
        max_age_s: float = 0.1,
        timeout_s: float = 3.0,
    ) -> None:
        self.host, self.clock, self.max_age_s = host, clock, max_age_s
        self.received = 0
        """Poses since the start."""
        self.dropped = 0
        """Poses that nobody drained in time."""
        self.tcp_offset: tuple[float, ...] | None = None
        """[m, rad] of the tool centre point in the flange's frame; None where it is not sent."""
        self.pendant: PendantSettings | None = None
        """The newest settings; None until the controller has sent them."""
        self._frequency, self._timeout = frequency_hz, timeout_s
        self._samples: deque[PoseSample] = deque(maxlen=_MOST_POSES)
        self._latest: PoseSample | None = None
        self._listeners: list[list[PoseSample]] = []
        self._error: str | None = None
        self._changed: str | None = None
        self._lag = Lag()
        self._lock, self._condition = lock_and_condition()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> PoseStream:
        """Connect, and wait for the first pose.

        Raises:
            LostError: nothing came in time, or poses are on their way for too long; the text says
            what the controller did.
        """
        if self._process is not None:
            raise LostError("the stream was already started", device="robot")
        self._process = spawn(
            "hw.robot._reader",
            self.host,
            str(self._frequency or 0.0),
            str(self._timeout),
        )
        self._thread = threading.Thread(target=self._receive, name="robot poses", daemon=True)
        self._thread.start()
        # Starting an interpreter takes seconds on a busy machine; that is not the robot's fault.
        patience = self._timeout + 20.0
        try:
            with self._lock:
                come = self._condition.wait_for(lambda: self._latest or self._error, patience)
        except BaseException:
            self.close()
            raise
        if not come or self._error:
            self.close()
            error = self._error or f"no pose from {self.host} within {patience:g} s"
            raise LostError(error, device="robot")
        return self

    def close(self) -> None:
        """End the process; poses already read can still be drained."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._thread is not None:
            self._thread.join()

    def __enter__(self) -> PoseStream:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def latest(self) -> PoseSample:
        """The newest pose.

        Raises:
            LostError: the connection is gone.
            StaleError: it is older than ``max_age_s``.
            RefusedError: the controller's TCP offset changed since the start.
        """
        with self._lock:
            sample, error = self._latest, self._error
        self._check(error)
        if sample is None:
            raise StaleError("no pose yet", device="robot")
        age = sample.age_s(self.clock.now())
        if age > self.max_age_s:
            raise StaleError(
                f"the newest pose is {sample.age_text(self.clock.now())}; at most "
                f"{self.max_age_s * 1000:.0f} ms are allowed",
                device="robot",
            )
        return sample

    def awaited(self, patience_s: float = 3.0) -> PoseSample:
        """The newest pose of a robot at rest: one that is too old is no reason to give up yet.

        A busy machine holds a process up for a tenth of a second now and then. That stops a motion;
        where nothing moves, the next pose is waited for.

        Args:
            patience_s: longest wait.

        Raises:
            LostError: the connection is gone.
            StaleError: no fresh pose came in time.
            RefusedError: the controller's TCP offset changed since the start.
        """
        waiting = Waiting(self.clock)
        while True:
            try:
                return self.latest()
            except StaleError:
                if waiting.so_far() > self.clock.patience(patience_s):
                    raise
            with self._lock:
                self._condition.wait(_TURN_WALL_S)

    def drain(self) -> list[PoseSample]:
        """Every pose since the last drain, in order; also after the connection was lost."""
        with self._lock:
            samples = list(self._samples)
            self._samples.clear()
        return samples

    def steady(self, seconds: float = 0.2) -> SteadyPose:
        """Average the poses of the next bench seconds; does not touch :meth:`drain`.

        Poses that come late, and may be from before, do not count.

        Raises:
            LostError: the connection was lost.
            StaleError: too few poses came.
        """
        start = self.clock.now()
        come: list[PoseSample] = []
        longest = seconds + self.clock.speed * (1.0 + self.max_age_s)
        waiting = Waiting(self.clock)
        with self._lock:
            self._listeners.append(come)
            try:
                while not come or come[-1].measured_s < start + seconds:
                    if self._error or waiting.so_far() > longest:
                        break
                    self._condition.wait(_TURN_WALL_S)
            finally:
                # Also after Ctrl-C: the list would grow for ever.
                self._listeners = [other for other in self._listeners if other is not come]
            error = self._error
        self._check(error)
        seen = [sample for sample in come if sample.measured_s >= start]
        if not seen or seen[-1].measured_s < start + seconds:
            raise StaleError(f"no pose for {seconds:g} s while averaging", device="robot")
        return average(seen)

    def identity(self) -> Identity:
        """Who the robot is.

        Raises:
            LostError: it does not answer.
        """
        return read_identity(self.host, timeout_s=self._timeout)

    def _check(self, error: str | None) -> None:
        if error:
            raise LostError(error, device="robot")
        if self._changed:
            raise refused(self._changed)

    def _receive(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        error = "the process that reads poses ended"
        try:
            with self._process.stdout as told:
                bound, latency_s = self._next(told)
                self._lag = Lag(self.clock.at(bound[0]), bound[1])
                check_latency(latency_s * self.clock.speed, self.max_age_s)
                while True:
                    self._take(self._next(told))
        except DeviceError as problem:
            error = problem.args[0]
        except (EOFError, OSError, pickle.UnpicklingError):
            pass
        finally:
            with self._lock:
                self._error = error
                self._condition.notify_all()

    def _next(self, told: IO[bytes]) -> Any:
        """What the process writes next (:mod:`hw.robot._reader`); raises the error that ends it."""
        item = pickle.load(told)
        if isinstance(item, DeviceError):
            raise item
        return item

    def _take(self, packets: list[Packet]) -> None:
        new = [PoseSample.of(packet, self.clock, self._lag) for packet in packets]
        for packet in packets:
            self.pendant = packet.pendant
            if packet.tcp_offset is not None:
                self._compare(packet.tcp_offset)
        if not new:
            return
        with self._lock:
            room = (self._samples.maxlen or 0) - len(self._samples)
            self.dropped += max(0, len(new) - room)
            self._samples.extend(new)
            for listener in self._listeners:
                listener.extend(new)
            self.received += len(new)
            self._latest = new[-1]
            self._condition.notify_all()

    def _compare(self, offset: tuple[float, ...]) -> None:
        if self.tcp_offset is None:
            self.tcp_offset = offset
        elif self._changed is None and offset_changed(self.tcp_offset, offset):
            self._changed = (
                f"the controller's TCP offset changed from {listed(self.tcp_offset)} to "
                f"{listed(offset)}: every pose now means something else; start a new recording"
            )


def offset_changed(first: Sequence[float], second: Sequence[float]) -> bool:
    """Whether two TCP offsets (m, rad) differ by more than rounding."""
    return any(abs(a - b) > _OFFSET_TOLERANCE for a, b in zip(first, second, strict=True))


def average(samples: Sequence[PoseSample]) -> SteadyPose:
    """The mean (:func:`hw.runtime.rigid.mean_pose`) of poses that are near each other."""
    poses = ur_to_pose(np.array([sample.raw for sample in samples]))
    mean = mean_pose(poses)
    raw = tuple(float(v) for v in pose_to_ur(mean))
    distances = np.sum((poses[:, :3, 3] - mean[:3, 3]) ** 2, axis=1)
    sample = replace(samples[-1], raw=raw, joints=None)
    return SteadyPose(sample, len(samples), float(np.sqrt(distances.mean())))
