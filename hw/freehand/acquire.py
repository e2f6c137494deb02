"""A free-hand run: from the connection to a recording that is complete.

Every image that is taken is on the disk, with its frame, before the next one is looked for. A run
that ends early, however it ends, leaves a recording that can be resumed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hw.freehand.guide import Guide, Taken
from hw.freehand.posed import PosedImages
from hw.freehand.request import FreeHand, Person, recorded_request
from hw.freehand.run import SILENCE_S, KeptImages, Run, read_images, resumed_recorder
from hw.recording.layout import RecordingHeader
from hw.recording.recorder import Recorder
from hw.runtime.errors import DeviceError
from hw.ultrasound.receiver import UltrasoundStream
from jaxcal import CalibrationError
from jaxcal.data.recording import Recording, make_images
from jaxcal.data.segmentation.image import check_region
from jaxcal.runtime.messages import first_ones

_KIND = "free-hand"
_LEAST_FOR_ESTIMATE = 6
_STANDS_OUT = 4.0
"""An image whose residual is more than so many times the median residual is named."""
_LEAST_MM = 1.0
_SAME_SPACING = 1e-5
"""Relative difference of single-precision numbers that mean the same."""


def acquire_free_hand(
    path: str | os.PathLike[str], asked: FreeHand, person: Person, *, resume: bool = False
) -> int:
    """Run until enough images are taken or the person ends it.

    Args:
        path: the recording: to make, or with ``resume`` to go on with.
        asked: what to acquire.
        person: shown what goes on; ``u`` takes the last image back, ``q`` or ``enter`` ends.
        resume: go on with ``path``; images, frames and rules are those of the recording.

    Returns:
        Number of images; the file is complete then.

    Raises:
        FreeHandStopped: interrupted, the stream was lost, or too few images; it can be resumed.
        DeviceError: nothing to connect to, or nothing that can be used in the stream.
        InputError: a recording that cannot be resumed, or a region that leaves the images.
        OutputError: the recording cannot be made.
    """
    guide, kept = Guide(asked.rules), KeptImages()
    spacing = None
    if resume:
        asked, told = recorded_request(path, _KIND, asked)
        guide, kept = _resumed(path, asked)
        spacing = _pair(told.get("image_spacing_mm"))
    with UltrasoundStream(asked.host, asked.port, device=asked.device) as stream:
        posed = PosedImages(stream, asked.source, asked.target_frame, asked.lag_s)
        check_region(asked.rules.region, posed.shape)
        for line in _found(posed):
            person.say(line)
        if resume:
            recorder = resumed_recorder(path)
        else:
            known = {**asked.settings(posed.pair), "image_spacing_mm": posed.spacing_mm}
            header = RecordingHeader("pixel", {}, 0, settings=json.dumps({_KIND: known}))
            recorder = Recorder(path, header)
        # Recordings of older versions do not tell it.
        run = _Run(asked, person, posed, recorder, kept, guide, spacing or posed.spacing_mm)
        return run.completed()


@dataclass
class _Run(Run):
    """Images are taken when the probe is held still; the guide judges them."""

    guide: Guide
    spacing_mm: tuple[float, float]
    """Of the images before."""

    ends = ("q", "enter")

    def begin(self) -> None:
        """Record the frames of the poses, and the sizes of images and pixels."""
        source, target = self.posed.pair
        rows, columns = self.posed.shape
        known = {"pose_from": source, "pose_to": target, "frame_size": [columns, rows]}
        self.recorder.attributes("calibration", known)
        if self.asked.spacing_mm is not None:
            self.recorder.attributes("calibration", {"spacing_mm": list(self.asked.spacing_mm)})

    def look(self, key: str | None) -> None:
        """Read an image, and keep it if the guide takes it."""
        posed = self.posed.read(SILENCE_S)
        frame = posed.image.array
        look = self.guide.look(posed)
        if look.taken is not None:
            self._keep(look.taken)
        advice = self.guide.advice((frame.shape[1], frame.shape[0]))
        self.person.show(frame, look.words, advice)

    def _keep(self, taken: Taken) -> None:
        assert taken.posed is not None
        self._check_spacing(taken.posed.image.spacing_mm)
        self.kept.check_unit(taken.pose, self.recorder)
        self.recorder.add_images([taken.posed.image])
        self.recorder.add_pixel(
            taken.pose,
            taken.pixel,
            taken.covariance,
            taken.time,
            by_host=self.posed.by_arrival,
        )
        self.kept.add(taken.pose)
        # The frame is on the disk; keeping all of them would fill the memory.
        self.guide.keep(replace(taken, posed=None, row=self.kept.rows[-1]))
        agrees = agreement(self.guide.taken, self.asked.spacing_mm)
        at = f"{taken.pixel[0]:.1f}, {taken.pixel[1]:.1f}"
        self.person.say(f"{self.last_image()}: target at {at} px{agrees}")

    def _check_spacing(self, now: tuple[float, float]) -> None:
        """Refuse an image of another depth: its pixels do not fit together with those before.

        Raises:
            DeviceError: the sender says that they have another size.
        """
        before = self.spacing_mm
        if not np.allclose(now, before, rtol=_SAME_SPACING, atol=0.0):
            raise DeviceError(
                f"an image with pixels of {now[0]:g} x {now[1]:g} mm does not fit this recording, "
                f"whose images have {before[0]:g} x {before[1]:g} mm: set the machine as before",
                device="ultrasound",
            )

    def take_back(self) -> None:
        """Forget it in the guide, too."""
        super().take_back()
        self.guide.taken.pop()
        self.guide.forget()


def agreement(taken: Sequence[Taken], spacing_mm: tuple[float, float] | None) -> str:
    """How well the images so far agree by the conventional fit, and which one does not.

    Args:
        taken: the images, the last one last.
        spacing_mm: sizes of a pixel; None: they are estimated as well.

    Returns:
        Words that go on with a line; empty for fewer than six images.
    """
    if len(taken) < _LEAST_FOR_ESTIMATE:
        return ""
    from jaxcal.calibration.calibrate import calibrate

    poses, pixels = (np.array([getattr(each, of) for each in taken]) for of in ("pose", "pixel"))
    images = make_images(poses, pixels, "pixel", spacing_mm=spacing_mm)
    scale = () if spacing_mm is not None else ("scale",)
    try:
        answer = calibrate(Recording(images), "conventional", estimate=scale)
    except CalibrationError as error:
        return f"; no estimate yet ({error})"
    residual = np.linalg.norm(np.asarray(answer.residual), axis=-1)
    text = f"; the images agree to {float(answer.rms):.2f} mm"
    worst = int(np.argmax(residual))
    if residual[worst] > max(_STANDS_OUT * float(np.median(residual)), _LEAST_MM):
        text += f"; image {taken[worst].row} stands out by {residual[worst]:.1f} mm"
        if worst == len(taken) - 1:
            text += " (u removes it)"
    return text


def _found(posed: PosedImages) -> list[str]:
    lines = [
        f"images of {posed.device!r}; poses from {posed.pair[0]} to {posed.pair[1]} (--from and "
        f"--to choose others; the stream has {first_ones(posed.names)})"
    ]
    if posed.by_arrival:
        lines.append(
            "images and transforms have no common time stamps: poses are those at the time of "
            "arrival; --lag states how late images arrive"
        )
    return lines


def _pair(value: object) -> tuple[float, float] | None:
    """Two numbers of a file that is not trusted."""
    if not isinstance(value, list) or len(value) != 2:
        return None
    numbers = [float(each) for each in value if isinstance(each, int | float)]
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None


def _resumed(path: str | os.PathLike[str], asked: FreeHand) -> tuple[Guide, KeptImages]:
    """What a recording that ended early holds."""
    columns = read_images(path, {"pixel": (2,), "covariance": (2, 2), "time": ()})
    kept = KeptImages(columns)
    taken = [
        Taken(
            columns["pose"][row],
            columns["pixel"][row],
            columns["covariance"][row],
            float(columns["time"][row]),
            row=row,
        )
        for row in kept.rows
    ]
    return Guide(asked.rules, taken), kept
