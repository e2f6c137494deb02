"""What both ways to acquire free-hand share: the run, and the images that count, also resumed."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from hw.freehand.posed import PosedImages
from hw.freehand.request import FreeHand, FreeHandStopped, Person
from hw.recording.check import last_host_time, opened, read_column, resumed_offset_s
from hw.recording.file import RecordingWriter
from hw.recording.recorder import Recorder, no_digest
from hw.runtime.clock import REAL
from hw.runtime.errors import DeviceError
from hw.runtime.hosts import address
from jaxcal import CalibrationError, InputError
from jaxcal.data.recording import MINIMUM_IMAGES, MetresError, check_pose_units
from jaxcal.io.hdf5 import IMAGES
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import command_line

SILENCE_S = 3.0
"""A device that is silent for longer ends the run."""


class KeptImages:
    """Rows and poses of the images that count; an image taken back keeps its row, masked.

    Args:
        columns: of /calibration, ``pose`` and ``mask`` among them; None: there are no images yet.
    """

    def __init__(self, columns: Mapping[str, np.ndarray] | None = None) -> None:
        mask = np.empty(0, bool) if columns is None else columns["mask"]
        self.rows: list[int] = np.flatnonzero(mask).tolist()
        """Of the images that count, in the order in which they were taken."""
        self._poses = [] if columns is None else list(columns["pose"][self.rows])
        self.next_row = len(mask)
        """Of the next image."""

    def __len__(self) -> int:
        return len(self.rows)

    def check_unit(self, pose: Float[np.ndarray, "4 4"], recorder: Recorder) -> None:
        """Refuse the pose of a further image if with it the poses look like metres.

        The images before have such poses, too: they are masked.

        Raises:
            MetresError: they look like metres.
        """
        try:
            check_pose_units(np.array([*self._poses, pose])[:, :3, 3])
        except MetresError:
            while self.rows:
                self.take_back(recorder)
            raise

    def add(self, pose: Float[np.ndarray, "4 4"]) -> None:
        """Count an image that is on the disk."""
        self.rows.append(self.next_row)
        self._poses.append(pose)
        self.next_row += 1

    def take_back(self, recorder: Recorder) -> None:
        """Mask the last image that counts."""
        recorder.leave_out(self.rows[-1])
        self.rows.pop()
        self._poses.pop()


@dataclass
class Run(ABC):
    """One run over open devices and an open recording."""

    asked: FreeHand
    person: Person
    posed: PosedImages
    recorder: Recorder
    kept: KeptImages
    options: tuple[str, ...] = field(default=(), init=False)
    """With which the run goes on, on the command line."""

    ends: ClassVar[tuple[str, ...]] = ("q",)
    """Keys that end the run."""

    def completed(self) -> int:
        """Run until enough images are taken, or the person ends it; their number.

        Raises:
            FreeHandStopped: interrupted, a device was lost, or too few images.
        """
        try:
            with self.recorder:
                return self._go()
        except KeyboardInterrupt:
            reason, interrupted = "interrupted", True
        except (DeviceError, CalibrationError) as error:
            reason, interrupted = str(error), False
        asked, path = self.asked, self.recorder.kept
        server = address(asked.host, asked.port)
        again = command_line(["jaxcal-hw", "free-hand", server, path, *self.options, "--resume"])
        state = f"{reason}; {len(self.kept)} of {asked.images} images are in {path}"
        raise FreeHandStopped(f"{state}; go on with: {again}", interrupted=interrupted)

    def last_image(self) -> str:
        """The last image that counts: its number in the recording, and how many there are."""
        return f"image {self.kept.rows[-1]} ({len(self.kept)} of {self.asked.images})"

    def _go(self) -> int:
        self.begin()
        self.note("started", f"{self.asked.images - len(self.kept)} images to take")
        while len(self.kept) < self.asked.images:
            key = self.person.key()
            if key in self.ends:
                break
            if key == "u" and self.kept:
                self.take_back()
                self.note("taken back", f"the last image; {len(self.kept)} are left")
            self.look(key)
        count = len(self.kept)
        if count < MINIMUM_IMAGES:
            raise InputError(f"{count} images are too few: {MINIMUM_IMAGES} are needed")
        self.note("finished", f"{count} images")
        self.recorder.finish()
        if self.recorder.digest_error is not None:
            self.person.say(no_digest(self.recorder.digest_error))
        return count

    @abstractmethod
    def begin(self) -> None:
        """Record what is known before the first image."""

    @abstractmethod
    def look(self, key: str | None) -> None:
        """Look at what has come, with the key that was pressed; take an image where it is one."""

    def take_back(self) -> None:
        """Mask the last image that counts; there is one."""
        self.kept.take_back(self.recorder)

    def note(self, kind: str, text: str) -> None:
        """Say a line, and put it among the recording's events."""
        self.recorder.add_event(kind, text, REAL.now())
        self.person.say(f"{kind}: {text}")


def resumed_recorder(path: str | os.PathLike[str]) -> Recorder:
    """A writer that goes on with a recording: its host times go on after the last one.

    Raises:
        FormatError: not a recording that can be resumed.
        OutputError: it cannot be opened for writing.
    """
    return Recorder(path, time_offset_s=resumed_offset_s(last_host_time(path), REAL.now()))


def read_images(
    path: str | os.PathLike[str], shapes: Mapping[str, tuple[int, ...]] | None = None
) -> dict[str, np.ndarray]:
    """Columns of /calibration of a recording that ended early; the file is not trusted.

    The file is cut back to its last whole rows first, as by resuming it.

    Args:
        path: of the recording.
        shapes: of further columns of numbers, without their rows.

    Returns:
        ``pose`` (n, 4, 4), mm, ``mask`` (n,), and the further columns.

    Raises:
        FormatError: not a recording that can be resumed.
        OutputError: it cannot be opened for writing.
    """
    RecordingWriter.resume(path).close()
    wanted = {"pose": (4, 4), **(shapes or {})}
    with opened(path) as root:
        mask = read_column(root, "calibration", "mask", (IMAGES,), "b")
        columns = {
            name: read_column(root, "calibration", name, (IMAGES, *shape), "f")
            for name, shape in wanted.items()
        }
    rows = min(map(len, [mask, *columns.values()]))
    return {name: values[:rows] for name, values in {"mask": mask, **columns}.items()}
