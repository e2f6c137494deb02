"""A free-hand run: from the connection to a recording that is complete.

Every image that is taken is on the disk, with its frame, before the next one is looked for. A run
that ends early, however it ends, leaves a recording that can be resumed.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np

from hw.errors import DeviceError
from hw.freehand.guide import Guide, Rules, Taken
from hw.freehand.posed import PosedImages
from hw.recorder import Recorder
from hw.recording_check import check_resumable, settings_of, stored_length
from hw.recording_layout import RecordingHeader
from hw.ultrasound.receiver import UltrasoundStream
from jaxcal import CalibrationError, FormatError, InputError
from jaxcal.cli.common import ExitCode
from jaxcal.data.recording import MINIMUM_IMAGES, Recording, make_images

_SILENCE_S = 3.0
_LEAST_FOR_ESTIMATE = 6
_STANDS_OUT = 4.0
"""An image whose residual is more than so many times the median residual is named."""
_LEAST_MM = 1.0
_ENOUGH = 30
"""Default number of images to take."""


@dataclass(frozen=True)
class FreeHand:
    """What to acquire, and from where.

    Attributes:
        host: of the OpenIGTLink server.
        port: of it.
        images: to take.
        source: tracked frame on the probe; None: found from the stream.
        target_frame: frame that the target rests in; None: found from the stream.
        device: that sends the images; None: any.
        lag_s: an image stamped t shows what was at t - lag.
        spacing_mm: [lateral, axial] mm per px, when known.
        rules: when an image is taken.
    """

    host: str
    port: int = 18944
    images: int = _ENOUGH
    source: str | None = None
    target_frame: str | None = None
    device: str | None = None
    lag_s: float = 0.0
    spacing_mm: tuple[float, float] | None = None
    rules: Rules = field(default_factory=Rules)

    def __post_init__(self) -> None:
        if not MINIMUM_IMAGES <= self.images <= 1000:
            raise InputError(f"images must be {MINIMUM_IMAGES} to 1000, not {self.images}")


class FreeHandStopped(CalibrationError):
    """A run that ended early; one line with what happened and what to do next."""

    def __init__(self, message: str, *, interrupted: bool = False) -> None:
        super().__init__(message)
        self.exit_code = ExitCode.INTERRUPTED if interrupted else ExitCode.STOPPED


@runtime_checkable
class Person(Protocol):
    """The person who holds the probe: what they are shown, and the keys that they press."""

    def show(self, frame: np.ndarray, words: str, advice: str) -> None:
        """The newest frame, what is said of it, and what is missing."""
        ...

    def say(self, line: str) -> None:
        """A line that stays."""
        ...

    def key(self) -> str | None:
        """The next key that was pressed; None where there was none."""
        ...


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
        InputError: a recording that cannot be resumed.
        OutputError: the recording cannot be made.
    """
    guide, used, rows = Guide(asked.rules), [], 0
    if resume:
        guide, asked, used, rows = _resumed(path, asked)
    with UltrasoundStream(asked.host, asked.port, device=asked.device) as stream:
        posed = PosedImages(stream, asked.source, asked.target_frame, asked.lag_s)
        for line in _found(posed, stream):
            person.say(line)
        if resume:
            recorder = Recorder(path)
        else:
            known = {**asdict(asked), "source": posed.pair[0], "target_frame": posed.pair[1]}
            recorder = Recorder(
                path, RecordingHeader("pixel", {}, 0, None, json.dumps({"free-hand": known}))
            )
        try:
            with recorder:
                run = _Run(asked, guide, person, posed, recorder, used, rows)
                return run.go()
        except KeyboardInterrupt:
            reason, interrupted = "interrupted", True
        except (DeviceError, CalibrationError) as error:
            reason, interrupted = str(error), False
    count = len(guide.taken)
    raise FreeHandStopped(
        f"{reason}; {count} of {asked.images} images are in {recorder.kept}; go on with: jaxcal-hw "
        f"free-hand {asked.host}:{asked.port} {recorder.kept} --resume",
        interrupted=interrupted,
    )


class _Run:
    """One run over an open stream and an open recording."""

    def __init__(
        self,
        asked: FreeHand,
        guide: Guide,
        person: Person,
        posed: PosedImages,
        recorder: Recorder,
        used: list[int],
        rows: int,
    ) -> None:
        self._asked, self._guide, self._person = asked, guide, person
        self._posed, self._recorder = posed, recorder
        # Row of /calibration of each image that counts; an image taken back keeps its row, masked.
        self._rows, self._next_row = used, rows
        self._size = (0, 0)

    def go(self) -> int:
        """Run until enough images are taken, or the person ends it."""
        asked, guide = self._asked, self._guide
        self._note("started", f"{asked.images - len(guide.taken)} images to take")
        if asked.spacing_mm is not None:
            self._recorder.attributes("calibration", {"spacing_mm": list(asked.spacing_mm)})
        while len(guide.taken) < asked.images:
            key = self._person.key()
            if key in ("q", "enter"):
                break
            if key == "u":
                self._take_back()
            posed = self._posed.read(_SILENCE_S)
            frame = posed.image.array
            self._size = (frame.shape[1], frame.shape[0])
            look = guide.look(posed)
            if look.taken is not None:
                self._keep(look.taken)
            self._person.show(frame, look.words, guide.advice(self._size))
        if len(guide.taken) < MINIMUM_IMAGES:
            raise InputError(f"{len(guide.taken)} images are too few: {MINIMUM_IMAGES} are needed")
        self._note("finished", f"{len(guide.taken)} images")
        self._recorder.finish()
        return len(guide.taken)

    def _keep(self, taken: Taken) -> None:
        assert taken.posed is not None
        self._recorder.add_images([taken.posed.image])
        self._recorder.add_pixel(taken.pose, taken.pixel, taken.covariance, taken.time)
        self._rows.append(self._next_row)
        self._next_row += 1
        # The frame is on the disk; keeping all of them would fill the memory.
        self._guide.taken[-1] = replace(taken, posed=None)
        count = len(self._guide.taken)
        at = f"{taken.pixel[0]:.1f}, {taken.pixel[1]:.1f}"
        self._person.say(f"image {count}/{self._asked.images}: target at {at} px{self._estimate()}")

    def _take_back(self) -> None:
        if not self._guide.taken:
            return
        self._guide.taken.pop()
        self._guide.forget()
        self._recorder.leave_out(self._rows.pop())
        self._note("taken back", f"the last image; {len(self._guide.taken)} are left")

    def _estimate(self) -> str:
        """How well the images so far agree, and which one does not."""
        taken = self._guide.taken
        if len(taken) < _LEAST_FOR_ESTIMATE:
            return ""
        from jaxcal.calibration.calibrate import calibrate

        images = make_images(
            np.array([each.pose for each in taken]),
            np.array([each.pixel for each in taken]),
            "pixel",
            spacing_mm=self._asked.spacing_mm,
        )
        scale = () if self._asked.spacing_mm is not None else ("scale",)
        try:
            answer = calibrate(Recording(images), "conventional", estimate=scale)
        except CalibrationError as error:
            return f"; no estimate yet ({error})"
        residual = np.linalg.norm(np.asarray(answer.residual), axis=-1)
        text = f"; the images agree to {float(answer.rms):.2f} mm"
        worst = int(np.argmax(residual))
        if residual[worst] > max(_STANDS_OUT * float(np.median(residual)), _LEAST_MM):
            text += f"; image {worst + 1} stands out by {residual[worst]:.1f} mm"
            if worst == len(taken) - 1:
                text += " (u takes it back)"
        return text

    def _note(self, kind: str, text: str) -> None:
        self._recorder.add_event(kind, text, time.monotonic())
        self._person.say(f"{kind}: {text}")


def _found(posed: PosedImages, stream: UltrasoundStream) -> list[str]:
    lines = [
        f"images of {posed.device!r}; poses from {posed.pair[0]} to {posed.pair[1]} (--from and "
        f"--to choose others; the stream has {', '.join(posed.names)})"
    ]
    if posed.by_arrival:
        lines.append(
            "images and transforms have no common time stamps: poses are those at the time of "
            "arrival; --lag states how late images arrive"
        )
    return lines


def _resumed(
    path: str | os.PathLike[str], asked: FreeHand
) -> tuple[Guide, FreeHand, list[int], int]:
    """Images of a recording that ended early, what was asked for, their rows and all rows."""
    from jaxcal.io.untrusted import UpTo, array, child, group, open_root

    check_resumable(path)
    told = settings_of(path).get("free-hand")
    try:
        if not isinstance(told, dict):
            raise TypeError
        rules = Rules(**{**told["rules"], "region": _four(told["rules"]["region"])})
        spacing = told["spacing_mm"]
        asked = FreeHand(
            asked.host,
            asked.port,
            int(told["images"]),
            told["source"],
            told["target_frame"],
            told["device"],
            float(told["lag_s"]),
            None if spacing is None else (float(spacing[0]), float(spacing[1])),
            rules,
        )
    except (TypeError, KeyError, ValueError, IndexError):
        raise InputError(f"{path}: has no settings of a free-hand acquisition to resume") from None
    count = UpTo(100_000, "images")
    try:
        with open_root(path, length=stored_length(path)) as root:
            node = group(root, "calibration")
            columns = {}
            for name, shape, kinds in (
                ("pose", (count, 4, 4), "f"),
                ("pixel", (count, 2), "f"),
                ("covariance", (count, 2, 2), "f"),
                ("mask", (count,), "b"),
                ("time", (count,), "f"),
            ):
                dataset = None if node is None else child(node, name)
                if dataset is None:
                    raise FormatError(f"has no /calibration/{name}")
                columns[name] = array(dataset, shape, kinds)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from None
    rows = min(len(values) for values in columns.values())
    used = [row for row in range(rows) if columns["mask"][row]]
    taken = [
        Taken(
            columns["pose"][row],
            columns["pixel"][row],
            columns["covariance"][row],
            float(columns["time"][row]),
        )
        for row in used
    ]
    return Guide(rules, taken), asked, used, rows


def _four(region: object) -> tuple[int, int, int, int] | None:
    if region is None:
        return None
    if not isinstance(region, list) or len(region) != 4:
        raise ValueError
    left, top, wide, high = (int(value) for value in region)
    return left, top, wide, high
