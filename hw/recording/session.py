"""The open devices of an acquisition: their data go to the file, and are watched for trouble.

One thread empties every device's queue into the recorder and keeps the newest echo frames for
:meth:`Session.listen`. :meth:`Session.trouble` is called at every tick of a motion; the robot is
stopped if it returns anything but None. After a hesitation (StaleError: a device was silent, late
or sent damaged frames) the acquisition goes on once the device is well again
(:meth:`Session.wait_until_clear`). It ends if that takes too long, or on any other trouble.
"""

from __future__ import annotations

import math
import threading
import time
import zlib
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hw.active_echo.device import SILENT, ActiveEcho, EchoFrame, EchoStatistics, median_of
from hw.midplane.search import MOST_FRAMES
from hw.recording.recorder import Recorder
from hw.robot.limits import between
from hw.robot.stream import PoseSample, PoseStream
from hw.runtime.clock import Waiting
from hw.runtime.errors import DeviceError, StaleError
from hw.runtime.interrupts import lock_and_condition
from hw.runtime.rigid import apart
from hw.setup.description import Setup
from hw.ultrasound.receiver import Image, UltrasoundStatistics, UltrasoundStream
from jaxcal import CalibrationError
from jaxcal.data.timing import ClockFit, fit_clock

_PERIOD_WALL_S = 0.005
# Rows are written in batches: a write costs a millisecond, however many rows it has.
_BATCH_WALL_S = 0.25
_KEPT_FRAMES = 256
_MOVED_MM = 0.3
"""An arm whose pose changes by more is not at rest; a degree counts as a mm."""
DELAY_S = 10.0
"""After so many bench seconds the delay of the echo frames is measured again."""
_RF_ALONE_S = 0.6
"""RF that comes for so long without a B-mode frame is alone; less than
``SilenceLimits.image_age_s``."""
_LEAST_STAMPS, _MOST_STAMPS, _MOST_FITTED = 20, 20_000, 2_000
_MOST_DRIFT, _STEP_S = 1e-3, 0.1
"""Two quartz clocks differ by less than this drift; what a busy machine adds to it in all, s."""
_LOSSES = ("lost", "crc_errors", "short", "repeated", "restarts")
"""Of :class:`hw.active_echo.device.EchoStatistics` and
:class:`hw.ultrasound.receiver.UltrasoundStatistics`: attributes of /ae and /us."""
_BAD_FRAMES = {
    "crc_errors": "arrived damaged (CRC)",
    "lost": "were lost (missed triggers, or damaged on the way)",
    "short": "came with lines missing (missed line triggers)",
}
""":class:`hw.active_echo.device.EchoStatistics` that tell of damaged frames, in words."""
_MOST = {
    "echo_age_s": 10.0,
    "echo_late_s": 10.0,
    "image_age_s": 10.0,
    "pose_age_s": 0.1,
    "burst": 100.0,
    "burst_s": 10.0,
    "grace_s": 60.0,
    "clear_s": 10.0,
}
"""Bounds of :class:`SilenceLimits`."""


@dataclass(frozen=True)
class SilenceLimits:
    """When a device counts as in trouble; times in bench seconds.

    Attributes:
        echo_age_s: no active-echo frame for longer than this.
        echo_late_s: active-echo frames arrive later than this after their triggers.
        image_age_s: no ultrasound frame for longer than this.
        pose_age_s: poses older than this are not used.
        burst: more damaged or missing active-echo frames of one kind than this within ``burst_s``.
        burst_s: see ``burst``.
        grace_s: how long a hesitation may last before the acquisition gives up.
        clear_s: how long the trouble must have been gone before the robot moves again.

    Raises:
        RefusedError: a limit that does not limit anything.
    """

    echo_age_s: float = 0.12
    echo_late_s: float = 0.3
    image_age_s: float = 1.0
    pose_age_s: float = 0.1
    burst: int = 3
    burst_s: float = 0.5
    grace_s: float = 3.0
    clear_s: float = 0.3

    def __post_init__(self) -> None:
        for name, most in _MOST.items():
            between(name, float(getattr(self, name)), 0.0, most)


class Session:
    """Poses, active echo and images of one acquisition; a context manager.

    Args:
        setup: where the devices are.
        recorder: where everything goes.
        watch: what counts as trouble.
        every_frame: whether every ultrasound frame is recorded, or only those asked for.

    Raises:
        DeviceError: a device is not there; those already open are closed again.
    """

    def __init__(
        self,
        setup: Setup,
        recorder: Recorder,
        *,
        watch: SilenceLimits | None = None,
        every_frame: bool = False,
    ) -> None:
        self.setup, self.clock = setup, setup.clock
        self.watch = SilenceLimits() if watch is None else watch
        self._recorder, self._every_frame = recorder, every_frame
        self._lock, self._changed = lock_and_condition()
        self._echo_frames: deque[EchoFrame] = deque(maxlen=MOST_FRAMES)
        self._image: Image | None = None
        self._first_seen: dict[int, float] = {}
        """When each of the newest different images came first, by the CRC-32 of its pixels."""
        self._rest: PoseSample | None = None
        """The pose that the arm left last, or rests at."""
        self._moved_s = -math.inf
        self._shown: tuple[str, bool] | None = None
        """Device of the images, and whether they are RF channel data."""
        self._recorded: tuple[str, bool] | None = None
        """The same of the images in the recording."""
        self._rf_since = math.inf
        self._failure: Exception | None = None
        self._bad: deque[tuple[float, str]] = deque(maxlen=_KEPT_FRAMES)
        self._stamps: dict[str, list[tuple[float, float]]] = {}
        self._waiting_poses: list[PoseSample] = []
        self._waiting_echo: list[EchoFrame] = []
        self._handed_over = time.monotonic()
        self._stopping = self._closed = False
        self._began = self.clock.now()
        self._echo_seen = self._image_seen = self._began
        with ExitStack() as opened:
            self.poses = opened.enter_context(
                PoseStream(
                    setup.robot_host,
                    clock=self.clock,
                    frequency_hz=setup.frequency_hz,
                    max_age_s=self.clock.patience(self.watch.pose_age_s),
                )
            )
            self.echo = opened.enter_context(
                ActiveEcho(setup.active_echo_url, clock=self.clock, lines=setup.probe.elements)
            )
            self.images: UltrasoundStream | None = None
            if setup.ultrasound is not None:
                self.images = opened.enter_context(
                    UltrasoundStream(*setup.ultrasound, clock=self.clock)
                )
            self.echo.stream(True)
            self._clock_hz = self.echo.clock_hz()
            self._measure_echo_delay()
            self._devices = opened.pop_all()
        self._counts = self.echo.statistics()
        self._echo_seen = self._image_seen = self._emptied = self.clock.now()
        self._held_up_until = -math.inf
        self._thread = threading.Thread(target=self._pump, daemon=True, name="session")
        self._thread.start()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Record what still waits and close every device; safe to repeat."""
        if self._closed:
            return
        self._stopping = True
        try:
            self._thread.join()
            with suppress(CalibrationError):
                self._record_clocks()
                self._record_losses()
        finally:
            # Also where Ctrl-C ends the wait for the thread.
            self._devices.close()
        self._closed = True

    # Trouble

    def trouble(self) -> str | StaleError | None:
        """What is wrong with a device now (:data:`hw.robot.motion.Guard`); None if nothing is.

        Returns:
            A StaleError for a hesitation (a device is silent, late or sends damaged frames), or a
            line with the reason why motion must end.
        """
        error = self._trouble()
        if error is None or isinstance(error, StaleError):
            return error
        if isinstance(error, DeviceError) and error.device == "robot":
            return str(error.args[0])  # the error that stops the robot names it
        return f"stopped: {error}"

    def check(self) -> None:
        """Raise the error if something is wrong.

        Raises:
            DeviceError: trouble of a device.
            OutputError: an error of the recorder.
        """
        grace = self.clock.patience(self.watch.grace_s)
        waiting = Waiting(self.clock)
        while (error := self._trouble()) is not None:
            # What came while this process was suspended may still be unread.
            unread = self._held_up_s() or self.clock.now() < self._held_up_until + grace
            if not (unread and isinstance(error, StaleError)) or waiting.so_far() > grace:
                raise error
            time.sleep(_PERIOD_WALL_S)

    def wait_until_clear(self) -> None:
        """Wait for the end of a hesitation; returns at once where there is none.

        Raises:
            DeviceError: it lasts longer than ``watch.grace_s``, or the device is gone.
        """
        if self._trouble() is None:
            return
        deadline = self.clock.now() + self.clock.patience(self.watch.grace_s)
        clear_since: float | None = None
        while True:
            error, now = self._trouble(), self.clock.now()
            if error is None:
                clear_since = now if clear_since is None else clear_since
                if now - clear_since >= self.watch.clear_s:
                    return
            else:
                clear_since = None
                if now > deadline or not isinstance(error, StaleError):
                    raise error
                if self._is_late():
                    # A question that was held up says so of every frame after it: ask again.
                    with suppress(StaleError):
                        self._measure_echo_delay()
            time.sleep(_PERIOD_WALL_S)

    def _trouble(self) -> Exception | None:
        if self._recorder.error is not None:
            return self._recorder.error
        with self._lock:
            if self._failure is not None:
                return self._failure
            held_up = self._held_up_s()
            if held_up:
                text = f"this program was suspended or held up for {held_up:.2f} s"
                return StaleError(text, device="robot")
            now, watch = self.clock.now(), self.watch
            # Where no good frame has come since, what came instead is the reason, however long ago.
            window = now - min(now - watch.burst_s, self._echo_seen)
            recent = [what for t, what in self._bad if now - t <= window]
            for what in dict.fromkeys(recent):
                count = recent.count(what)
                if count > watch.burst:
                    return StaleError(
                        f"{count} frames {what} within {window:.2g} s: check its cable",
                        device="active echo",
                    )
            if now - self._echo_seen > self.clock.patience(watch.echo_age_s):
                return StaleError(
                    f"no frame for {now - self._echo_seen:.2f} s: {SILENT}",
                    device="active echo",
                )
            if self._is_late():
                late = self._echo_frames[-1].late_s
                text = f"echo frames are {late:.1f} s late: check the link to the device, e.g. a "
                text += "bridge from serial line to network"
                if math.isnan(late):
                    text = "nothing tells how late echo frames are: was the device restarted?"
                return StaleError(text, device="active echo")
            if self.images is not None and now - self._image_seen > self.clock.patience(
                watch.image_age_s
            ):
                return StaleError(
                    f"no image for {now - self._image_seen:.1f} s: is the machine frozen?",
                    device="ultrasound",
                )
        try:
            self.poses.latest()
        except DeviceError as error:
            return error
        return None

    def _held_up_s(self) -> float:
        """How long no queue of a device was emptied, bench s; 0 where that is as usual."""
        silent = self.clock.now() - self._emptied
        return silent if silent > self.clock.patience(self.watch.echo_age_s) else 0.0

    def _is_late(self) -> bool:
        """Whether the newest echo frame may have come too late."""
        late = self._echo_frames[-1].late_s if self._echo_frames else 0.0
        return not late <= self.clock.patience(self.watch.echo_late_s)

    # Data

    def listen(self, frames: int, since: float) -> list[EchoFrame]:
        """Whole echo frames that began after a moment.

        Args:
            frames: how many, at most :data:`~hw.midplane.search.MOST_FRAMES`.
            since: bench time, after the threshold was set. A frame is assumed to have begun before
                its arrival by its delay, or by the stream's period (:func:`frame_period`) if that
                is longer; a frame whose delay is not known is not taken.

        Raises:
            DeviceError: trouble while waiting, or another threshold.
        """
        began = self.clock.now()
        if began - self._delay_measured > DELAY_S:
            self._measure_echo_delay()
            problem = self._clock_of("active echo")
            if isinstance(problem, str):
                text = f"{problem}: times of flight may be wrong"
                raise DeviceError(text, device="active echo")
        found: list[EchoFrame] = []
        waiting = Waiting(self.clock)
        with self._lock:
            while True:
                period = frame_period(list(self._echo_frames), self._clock_hz)
                if period is not None:
                    found = [
                        f for f in self._echo_frames if f.t_host - max(f.late_s, period) > since
                    ]
                if len(found) >= frames:
                    self.echo.check_threshold(found[:frames])
                    return found[:frames]
                if self._failure is not None:
                    raise self._failure
                late = 2 * frames * (period or 0.0) + self.clock.patience(self.watch.grace_s)
                if waiting.so_far() > late:
                    break
                self._changed.wait(self.clock.wall(0.1))
        self.check()
        raise StaleError(f"only {len(found)} of {frames} frames came in time", device="active echo")

    def _measure_echo_delay(self) -> None:
        self._delay_measured = self.clock.now()
        self.echo.measure_delay()

    def latest_image(self) -> Image | None:
        """The newest ultrasound frame, or None before the first."""
        with self._lock:
            return self._image

    def image_after(self, since: float, *, rf: bool = False) -> Image:
        """The first B-mode frame that arrives after a moment, or would have if it were not late.

        Args:
            since: bench time.
            rf: whether RF will do.

        Raises:
            DeviceError: trouble while waiting.
        """
        grace = self.watch.grace_s
        longest = max(self.clock.patience(grace), since - self.clock.now() + grace)
        waiting = Waiting(self.clock)
        with self._lock:
            while True:
                image = self._image
                fits = image is not None and (rf or image.array.dtype == np.uint8)
                if image is not None and fits and image.prompt_s > since:
                    return image
                if self._failure is not None:
                    raise self._failure
                if waiting.so_far() > longest:
                    break
                self._changed.wait(self.clock.wall(0.1))
        self.check()
        late = image.late_s if image is not None else 0.0
        what = f"the images are {late:.1f} s late: check the link to the machine"
        what = what if late > self.watch.image_age_s else "no B-mode frame came in time"
        raise StaleError(what, device="ultrasound")

    def is_of_the_way(self, image: Image) -> bool:
        """Whether the same image, to the last pixel, came before the arm came to rest."""
        with self._lock:
            first = self._first_seen.get(zlib.crc32(image.array.tobytes()), image.t_host)
            return first <= self._moved_s

    def record_image(self, image: Image) -> None:
        """Put an ultrasound frame into the recording, unless every frame goes there."""
        if not self._every_frame:
            self._record_images([image])

    def _pump(self) -> None:
        try:
            while True:
                ending = self._stopping
                self._empty()
                if ending:
                    break
                time.sleep(_PERIOD_WALL_S)
        except Exception as error:
            with self._lock:
                self._failure = error
                self._changed.notify_all()
        # Data from before a device was lost belong into the file, and how the robot comes to rest.
        while True:
            ending = self._stopping
            self._waiting_poses += self.poses.drain()
            with suppress(CalibrationError):
                self._hand_over()
            if ending:
                return
            time.sleep(_BATCH_WALL_S)

    def _empty(self) -> None:
        # What was taken from one device waits for the file, even where another is found to be lost.
        frames = self.echo.drain()
        self._waiting_echo += frames
        images = [] if self.images is None else self._of_one_device(self.images.drain())
        poses = self.poses.drain()
        self._waiting_poses += poses
        now, counts = self.clock.now(), self.echo.statistics()
        with self._lock:
            for what, text in _BAD_FRAMES.items():
                more = getattr(counts, what) - getattr(self._counts, what)
                self._bad.extend((now, text) for _ in range(min(more, 16)))
            self._counts = counts
            if self._held_up_s():
                # Frames of that time are still on their way through this process.
                self._echo_seen = self._image_seen = now
                self._held_up_until = now
            self._emptied = now
            if frames:
                self._echo_frames.extend(frames)
                self._echo_seen = frames[-1].t_host
            for image in images:
                self._image, self._image_seen = image, image.t_host
                digest = zlib.crc32(image.array.tobytes())
                # Those that come again are kept longest.
                first = self._first_seen.pop(digest, image.t_host)
                self._first_seen[digest] = first
                if len(self._first_seen) > _KEPT_FRAMES:
                    del self._first_seen[next(iter(self._first_seen))]
            if poses and self._moved(poses[-1]):
                # Of those that came together, the newest may be from long after the arrival.
                for pose in filter(self._moved, poses):
                    self._moved_s = -math.inf if self._rest is None else pose.t_host
                    self._rest = pose
            self._changed.notify_all()
        hz = self._clock_hz
        self._stamp("robot", [(pose.t_device, pose.t_host) for pose in poses[-1:]])
        self._stamp("active echo", [(frame.ticks / hz, frame.t_host) for frame in frames[-1:]])
        self._stamp("ultrasound", [(image.t_device, image.t_host) for image in images[-1:]])
        if self._every_frame:
            self._record_images(images)
        if time.monotonic() - self._handed_over > _BATCH_WALL_S:
            self._hand_over()

    def _moved(self, pose: PoseSample) -> bool:
        return self._rest is None or apart(self._rest.pose, pose.pose) > _MOVED_MM

    def _record_images(self, images: list[Image]) -> None:
        """Record frames as the first one is: those of another device, or RF, may not fit to it."""
        for image in images:
            if self._recorded is None:
                self._recorded = image.device, image.is_rf
            if (image.device, image.is_rf) == self._recorded:
                self._recorder.add_images([image])

    def _of_one_device(self, images: list[Image]) -> list[Image]:
        """Those that are shown and recorded: of the first device, RF only where nothing else is.

        Frames of several devices do not fit into one recording. Where RF comes first, it waits for
        a moment whether B-mode frames follow.
        """
        for image in images:
            if self._shown is None and image.is_rf:
                self._rf_since = min(self._rf_since, image.t_host)
                if image.t_host - self._rf_since < self.clock.patience(_RF_ALONE_S):
                    continue
            if self._shown is None or (self._shown[1] and not image.is_rf):
                self._shown = image.device, image.is_rf
        return [image for image in images if (image.device, image.is_rf) == self._shown]

    def _hand_over(self) -> None:
        self._handed_over = time.monotonic()
        poses, self._waiting_poses = self._waiting_poses, []
        frames, self._waiting_echo = self._waiting_echo, []
        self._recorder.add_poses(poses)
        self._recorder.add_echo(frames)

    def _stamp(self, device: str, pairs: list[tuple[float, float]]) -> None:
        stamps = self._stamps.setdefault(device, [])
        stamps.extend(pairs)
        if len(stamps) > _MOST_STAMPS:
            del stamps[::2]

    def _record_clocks(self) -> None:
        """Fit every device's clock and put the fits, or why there is none, into the recording."""
        now = self.clock.now()
        for device in self._stamps:
            fit = self._clock_of(device)
            if isinstance(fit, ClockFit):
                self._recorder.add_clock(device, fit, now)
            elif fit is not None:
                self._recorder.add_event("clock", f"{device}: {fit}", now)

    def _clock_of(self, device: str) -> ClockFit | str | None:
        """The fit of a device's clock; what is wrong with its time stamps; or None: too few."""
        stamps = np.array(self._stamps.get(device, []), float).reshape(-1, 2)
        pairs = stamps[np.isfinite(stamps).all(axis=1)]
        if len(pairs) < _LEAST_STAMPS:
            return None
        if (np.diff(pairs[:, 0]) <= 0).any():
            return "its time stamps went back: its clock has no fit"
        fit = fit_clock(*pairs[:: 1 + len(pairs) // _MOST_FITTED].T)
        span = float(np.ptp(pairs[:, 1]))
        if abs(fit.drift) * span > _MOST_DRIFT * span + self.clock.patience(_STEP_S):
            rate = 1.0 / max(1.0 + fit.drift, 1e-12)
            return (
                f"its clock was set, or counts {rate:.4g} s a second by the clock of this "
                "computer, or its data come later and later"
            )
        return fit

    def _record_losses(self) -> None:
        """Put what did not come into the recording: nothing is filled in, so it does not show."""
        echo = self.echo.statistics()
        counts: dict[str, EchoStatistics | UltrasoundStatistics] = {"ae": echo}
        full = {"tracker": self.poses.dropped, "ae": echo.dropped}
        if self.images is not None:
            counts["us"] = images = self.images.statistics()
            if self._every_frame:
                full["us"] = images.dropped
        for group, found in counts.items():
            losses = {name: getattr(found, name) for name in _LOSSES if hasattr(found, name)}
            self._recorder.counts(group, losses)
            text = ", ".join(f"{count} {name}" for name, count in losses.items() if count)
            if text:
                self._recorder.add_event("losses", f"/{group}: {text}", self.clock.now())
        for group, count in full.items():
            if count:
                self._recorder.dropped[group] = self._recorder.dropped.get(group, 0) + count


def frame_period(frames: Sequence[EchoFrame], clock_hz: float) -> float | None:
    """Seconds from one frame trigger to the next, by the device's clock; None where unknown.

    Args:
        frames: in order; where some are missing, their numbers say how many.
        clock_hz: of the device's ticks.

    Returns:
        The median over pairs of frames that follow each other.
    """
    periods = [
        (second.ticks - first.ticks) / clock_hz / (second.frame - first.frame)
        for first, second in pairwise(frames)
        if second.frame > first.frame and second.ticks > first.ticks
    ]
    return float(np.median(periods)) if periods else None


def median_times(frames: list[EchoFrame]) -> tuple[np.ndarray, float]:
    """One frame from several frames at the same place.

    Returns:
        (lines,) median time of flight, s, NaN where fewer than half of the frames have one; and
        the median over the frames of the loudest amplitude, counts.
    """
    loudest = float(np.median([frame.amplitude.max() for frame in frames]))
    return median_of(np.array([frame.tof_s for frame in frames])), loudest
