"""Images of an OpenIGTLink stream with the poses that belong to them.

Transforms come under their names (``ProbeToTracker``), with the image (PlusServer's TRACKEDFRAME)
or by themselves (TRANSFORM, TDATA), before the image or after it. The pose of an image is the one
with the same time stamp, or is interpolated between the two around it. Time stamps are the
sender's; PlusServer gives them to images and transforms alike. Where stamps are missing, or those
of images and transforms are of clocks that differ by over 1 s, times of arrival are used, and the
person is told.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hw.runtime.errors import DeviceError, StaleError
from hw.ultrasound.receiver import Image, Transform, UltrasoundStream
from jaxcal.data.poses import inverse_poses
from jaxcal.data.timing import interpolate_poses
from jaxcal.io.frame_names import FramePair, capitalised, path_between, split_name
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import first_ones

LISTEN_S = 5.0
"""How long to wait for the first image and the first transform."""
_MORE_S = 0.5
"""How long to listen after both have come, so that all names are known."""
_SILENT_S = 0.2
"""A longer silence does not count as listening."""
_TICK_S = 0.01
"""Between two looks at the stream."""
_LONGEST_GAP_S = 0.2
"""Longest time between two transforms over which they are interpolated."""
_LONGEST_IMAGE_GAP_S = 0.3
"""The same between two images with poses."""
_LATEST_S = 0.4
"""How long an image waits for the pose after it, beyond a negative lag."""
_SAME_S = 1e-6
_KEPT = 1024
_ONE_CLOCK_S = 1.0
"""Images come later than the poses of their time, but not by so much (assumption)."""
_SET_S = 0.3
"""Delays do not change the time between two clocks by so much; a drift of 100 ppm does in 50
minutes, and then the poses are late by as much."""
_SECONDS = 20.0
"""Time stamps that run so many times too fast or too slow are not in seconds."""


@dataclass(frozen=True)
class PosedImage:
    """An image and where the probe was.

    Attributes:
        image: as it came.
        time: s, of the clock that images and poses share.
        pose: (4, 4) probe -> tracker or reference, mm; None where the image has no pose.
        why: why it has no pose, in words.
    """

    image: Image
    time: float
    pose: Float[np.ndarray, "4 4"] | None
    why: str = ""


class PosedImages:
    """Reads a stream that was started.

    Args:
        stream: of images and transforms.
        source: tracked frame on the probe; None: ``Probe``, or the only one there is.
        target: frame that the target rests in; None: ``Reference`` where it is tracked, else
            ``Tracker``.
        lag_s: an image stamped t shows what was at t - lag.

    Attributes:
        pair: the frames of the poses.
        names: of all transforms that came.
        device: of the images; those of other devices are not read.
        shape: (rows, columns) of the first image.
        spacing_mm: [lateral, axial] mm per pixel of the first image, as the sender says.
        by_arrival: whether times of arrival are used.

    Raises:
        DeviceError: no images, or of several devices; no transforms, or none that lead from
            ``source`` to ``target``.
    """

    def __init__(
        self,
        stream: UltrasoundStream,
        source: str | None = None,
        target: str | None = None,
        lag_s: float = 0.0,
    ) -> None:
        self._stream, self._lag = stream, lag_s
        self._samples: dict[str, deque[Transform]] = {}
        self._waiting: deque[tuple[Image, float]] = deque()
        self.device: str | None = None
        self._listen()
        self.names = sorted(self._samples)
        devices = sorted({image.device for image, _ in self._waiting})
        if len(devices) > 1:
            raise DeviceError(
                f"name the device of the images (--device); there are "
                f"{', '.join(map(repr, devices))}",
                device="ultrasound",
            )
        self.device = devices[0]
        self.shape = self._waiting[0][0].array.shape
        self.spacing_mm = self._waiting[0][0].spacing_mm
        pairs = {name: pair for name in self.names if (pair := split_name(name)) is not None}
        self.pair = _chosen(pairs, source, target)
        self._steps = path_between(list(pairs.values()), *self.pair) or []
        if not self._steps:
            known = first_ones(self.names)
            raise DeviceError(
                f"no transforms lead from {self.pair[0]} to {self.pair[1]}; the stream has {known}",
                device="tracker",
            )
        self._needed = [list(pairs)[index] for index, _ in self._steps]
        self._ahead = {name: self._ahead_of(name) for name in self._needed}
        """By how much the images' clock was ahead of that of a transform."""
        one_clock = bool(np.abs(list(self._ahead.values())).max() <= _ONE_CLOCK_S)
        came = np.ptp([(image.t_device, image.t_host) for image, _ in self._waiting], axis=0)
        in_seconds = came[1] < _MORE_S / 2 or 1 / _SECONDS < came[0] / came[1] < _SECONDS
        self.by_arrival = not (one_clock and in_seconds)

    @property
    def behind(self) -> int:
        """Number of images that have come and were not read yet."""
        self._take()
        return len(self._waiting)

    def read(self, timeout_s: float) -> PosedImage:
        """The next image; it may wait a moment for the pose after it.

        Raises:
            StaleError: no image in time.
            LostError: the connection is gone.
        """
        left = timeout_s
        while True:
            self._take()
            if self._waiting:
                image, arrived = self._waiting[0]
                waited = time.monotonic() - arrived
                posed = self._posed(image, waited > _LATEST_S + max(-self._lag, 0.0))
                if posed is not None:
                    self._waiting.popleft()
                    return posed
            elif left <= 0.0:
                raise StaleError(
                    f"no new image for {timeout_s:g} s: is the machine frozen?", device="ultrasound"
                )
            # Counted by its sleeps: see _listen.
            time.sleep(_TICK_S / 2)
            left -= _TICK_S / 2

    def _listen(self) -> None:
        """Listen until images and transforms have come, and a moment longer.

        Only what flows is listened to: a stream, or a process, that is held up right after the
        first messages has not named all transforms and devices yet.
        """
        waited = heard = silent = 0.0
        came, both, counts = 0, False, self._stream.statistics()
        while heard < _MORE_S and waited < LISTEN_S:
            # Counted by its sleeps: a process that was suspended has not waited meanwhile.
            time.sleep(_TICK_S)
            self._take()
            counts = self._stream.statistics()
            now = counts.received + counts.transforms
            silent = silent + _TICK_S if now == came else 0.0
            came, waited = now, waited + _TICK_S
            if self._waiting and self._samples:
                both, waited = True, waited if both else 0.0
                heard += _TICK_S if silent < _SILENT_S else 0.0
        if both:
            return
        missing = "images" if not self._waiting else "transforms"
        only_rf = not self._waiting and counts.received > 0
        reason = "RF channel data are not" if only_rf else counts.reason
        if not self._waiting and counts.other_devices:
            raise DeviceError(
                f"{self._stream.address} sends no images of the device that was named, "
                f"but of {', '.join(map(repr, counts.other_devices))}: name one of these "
                "(--device), or none",
                device="ultrasound",
            )
        raise DeviceError(
            f"{self._stream.address} sent no {missing} within {LISTEN_S:g} s"
            + (f" that can be used ({reason})" if reason else "")
            + ": does its configuration send IMAGE and TRANSFORM, or TRACKEDFRAME?",
            device="ultrasound" if not self._waiting else "tracker",
        )

    def _take(self) -> None:
        for transform in self._stream.transforms():
            # A peer may invent names without end.
            if transform.name in self._samples or len(self._samples) < 256:
                kept = self._samples.setdefault(transform.name, deque(maxlen=_KEPT))
                kept.append(transform)
        now = time.monotonic()
        # Leave the images in the stream's own queue while too many wait here.
        if self._waiting and len(self._waiting) > 64:
            return
        self._waiting.extend(
            (image, now)
            for image in self._stream.drain()
            if not image.is_rf and self.device in (None, image.device)
        )

    def _posed(self, image: Image, late: bool) -> PosedImage | None:
        """The image with its pose or the reason why it has none; None where it must wait."""
        moment = image.t_host if self.by_arrival else image.t_device
        pose = np.eye(4)
        for name, (_, inverted) in zip(self._needed, self._steps, strict=True):
            found = self._at(name, image, moment - self._lag, late)
            if found is None:
                return None
            if isinstance(found, str):
                return PosedImage(image, moment, None, found)
            pose = (inverse_poses(found[None])[0] if inverted else found) @ pose
        return PosedImage(image, moment, pose)

    def _at(self, name: str, image: Image, moment: float, late: bool) -> np.ndarray | str | None:
        samples = self._samples[name]
        before: Transform | None = None
        for sample in reversed(samples):
            stamp = sample.t_host if self.by_arrival else sample.t_device
            if stamp <= moment + _SAME_S and self._was_set(name, image, sample):
                return (
                    f"the clocks of the images and of {name} no longer agree: one was set, or they "
                    "drift; end the run and resume it"
                )
            if abs(stamp - moment) <= _SAME_S:
                return sample.matrix if sample.valid else f"{name} is not tracked"
            if stamp < moment:
                if before is None:
                    return f"{name} has stopped coming" if late else None
                times = [stamp, before.t_host if self.by_arrival else before.t_device]
                if not (sample.valid and before.valid):
                    return f"{name} is not tracked"
                if times[1] - times[0] > _LONGEST_GAP_S:
                    return f"{name} comes too seldom ({times[1] - times[0]:.2f} s apart)"
                both = np.stack([sample.matrix, before.matrix])
                return interpolate_poses(
                    np.array(times), both, np.array([moment]), max_gap_s=_LONGEST_GAP_S
                )[0]
            before = sample
        return f"{name} began after this image"

    def _ahead_of(self, name: str) -> float:
        """By how much the images' clock is ahead of the transform's, by the quickest of each, s.

        Only of what came at the same time: a queue may have dropped the first images.
        """
        images = [image for image, _ in self._waiting]
        samples = self._samples[name]
        meanwhile = [s for s in samples if images[0].t_host <= s.t_host <= images[-1].t_host]
        image, sample = (
            np.max([each.t_device - each.t_host for each in came])
            for came in (images, meanwhile or samples)
        )
        return float(image - sample)

    def _was_set(self, name: str, image: Image, sample: Transform) -> bool:
        """Whether the clocks of image and transform differ by another time than at the start."""
        if self.by_arrival:
            return False
        most = _SET_S + abs(self._lag)
        return all(
            abs(_ahead(image, t, sample) - self._ahead[name]) > most
            for t in (image.t_host, image.prompt_s)
        )


def _ahead(image: Image, came: float, sample: Transform) -> float:
    """By how much the image's clock is ahead of the transform's, where the image came then, s."""
    return (image.t_device - came) - (sample.t_device - sample.t_host)


def pose_at_arrival(images: Iterable[PosedImage], t: float) -> Float[np.ndarray, "4 4"] | bool:
    """Where the probe was when something else arrived.

    Args:
        images: one after the other. Those that a slow link holds up count as of when they would
            have come otherwise.
        t: time of arrival, bench s.

    Returns:
        The pose; True if it may still come, False if there is none.
    """
    known = list(images)
    if not known or t > known[-1].image.prompt_s:
        return True
    for before, after in pairwise(known):
        times = np.array([before.image.prompt_s, after.image.prompt_s])
        if not times[0] <= t <= times[1]:
            continue
        gap = _LONGEST_IMAGE_GAP_S
        if before.pose is None or after.pose is None or np.diff(times)[0] > gap:
            return False
        if times[1] <= times[0]:
            return after.pose
        both = np.stack([before.pose, after.pose])
        return interpolate_poses(times, both, np.array([t]), max_gap_s=gap)[0]
    return False


def _chosen(pairs: dict[str, FramePair], source: str | None, target: str | None) -> FramePair:
    """The frames from which and to which the poses lead."""
    frames = {frame for pair in pairs.values() for frame in pair}
    tools = list(dict.fromkeys(start for start, _ in pairs.values() if start != "Reference"))
    start = None if source is None else capitalised(source)
    if start is None:
        start = "Probe" if "Probe" in tools else tools[0] if len(tools) == 1 else None
    if start is None:
        known = first_ones(tools) or "none"
        raise DeviceError(
            f"name the tracked frame on the probe (--from); there are {known}", device="tracker"
        )
    if target is not None:
        return start, capitalised(target)
    if "Reference" in frames and start != "Reference":
        return start, "Reference"
    return start, next((end for begin, end in pairs.values() if begin == start), "Tracker")
