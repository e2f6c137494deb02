"""The recorder: rows go into a bounded queue, and a separate process writes them to the file.

The acquisition hands over its data and goes on; a slow disk, an interpreter lock held by a client
library or a solve only fill the queue. Continuous data (poses, frames, echo) are dropped and
counted when the queue is full. Selected images, events and estimates are never dropped: they wait
for room, and an image counts as taken only once the writer says that it is on the disk. When the
acquisition dies, in whatever way, its writer notices the closed pipe, closes the file in order, and
leaves it incomplete, to be resumed.
"""

from __future__ import annotations

import json
import os
import pickle
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

import numpy as np

from hw.recording.file import utc_now
from hw.recording.layout import TEXT_BYTES, RecordingHeader
from hw.runtime.clock import REAL, Waiting
from hw.runtime.interrupts import lock_and_condition
from hw.runtime.processes import finish, spawn
from hw.runtime.rigid import ur_to_pose
from jaxcal import CalibrationError, FormatError, OutputError

if TYPE_CHECKING:
    from hw.active_echo.device import EchoFrame
    from hw.midplane.bracket import Bracket
    from hw.robot.stream import PoseSample
    from hw.ultrasound.receiver import Image
    from jaxcal.data.timing import ClockFit

QUEUE_BYTES = 2**26
"""What may wait to be written: 64 MiB, seven seconds of frames of 640 x 480 at 30 a second."""

_PATIENCE_S = 30.0
_ENDING_S = 30.0
_HUNG_ENDING_S = 3.0
"""The same after the disk has taken nothing for so long that it was given up."""
_TURN_S = 0.1


class Recorder:
    """Writes one recording through a process of its own; a context manager.

    Args:
        path: the file to make, or with ``header`` None the incomplete one to go on with.
        header: of a new file (see :class:`hw.recording.layout.RecordingHeader`).
        time_offset_s: added to host times, so that they go on where a resumed recording ended.
        queue_bytes: most bytes that may wait; continuous data beyond are dropped and counted.
        patience_s: for how long the disk may take nothing, in wall-clock seconds, before it is
            given up.

    Raises:
        OutputError: the file is there already or cannot be written.
        FormatError: a file that cannot be resumed.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        header: RecordingHeader | None = None,
        *,
        time_offset_s: float = 0.0,
        queue_bytes: int = QUEUE_BYTES,
        patience_s: float = _PATIENCE_S,
    ) -> None:
        self.path = os.fspath(path)
        self.dropped: dict[str, int] = {}
        """Rows of continuous data that found the queue full, by group."""
        self._capacity, self._patience = queue_bytes, patience_s
        self._time_offset = time_offset_s
        self._queue: deque[bytes] = deque()
        self._waiting = 0
        self._taken = 0
        """How often the writer has taken or told something."""
        self._lock, self._changed = lock_and_condition()
        self._answers: dict[str, Any] = {}
        self.error: CalibrationError | None = None
        """The first error of the writer; None as long as it writes."""
        self.kept = self.path
        """Where the rows are: maybe another path, if the file was moved, removed or replaced."""
        self.digest_error: str | None = None
        """Why a finished recording has no SHA-256 digest beside it; None if it has one."""
        self._ending = self._ended = self._closed = self._hung = False
        self._unsent = False
        """Whether something handed over did not reach the writer."""
        self._marks = 0
        # In a session of its own: Ctrl-C, or a signal to the whole group, must not stop the writer.
        self._process = spawn("hw.recording.writer_process", self.path, stdin=True, stderr=None)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._listener = threading.Thread(
            target=self._listen, args=(self._process.stdout,), daemon=True, name="recorder answers"
        )
        self._feeder = threading.Thread(
            target=self._feed, args=(self._process.stdin,), daemon=True, name="recorder queue"
        )
        self._listener.start()
        self._feeder.start()
        self._put("open", header)
        try:
            self.rows: dict[str, int] = self._answer("open", _ENDING_S)["rows"]
            """Rows of every group when the file was opened; a resumed file holds some already."""
        except BaseException:
            self._stop()
            raise

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except CalibrationError:
            if kind is None:
                raise

    def add_poses(self, samples: Sequence[PoseSample]) -> None:
        """Append tracked poses."""
        if not samples:
            return
        raw = _column(samples, "raw")
        self._stream(
            "tracker",
            {
                "t_host": _column(samples, "t_host"),
                "t_device": _column(samples, "t_device"),
                "pose": ur_to_pose(raw),
                "raw_pose": raw,
                "safety_bits": _column(samples, "safety_bits", int),
                "status": _column(samples, "robot_mode", int),
                "runtime_state": _column(samples, "runtime_state", int),
            },
        )

    def add_images(self, images: Sequence[Image]) -> None:
        """Append ultrasound frames; all frames of a recording have one size and type."""
        for image in images:
            self._stream(
                "us",
                {
                    "t_host": _column([image], "t_host"),
                    "t_device": _column([image], "t_device"),
                    "frame_id": _column([image], "frame_id", int),
                    "frames": np.asarray(image.array)[None],
                },
            )

    def add_echo(self, frames: Sequence[EchoFrame]) -> None:
        """Append frames of the active echo element: ticks as they came, 65535 = no response."""
        if not frames:
            return
        self._stream(
            "ae",
            {
                "t_host": _column(frames, "t_host"),
                "frame_id": _column(frames, "frame", int),
                "clock_ticks": np.array([frame.ticks for frame in frames], np.uint64),
                "tof_ticks": np.array([frame.tof_ticks for frame in frames], np.uint16),
                "amplitude": np.array([frame.amplitude for frame in frames], np.uint16),
                "threshold": _column(frames, "threshold", int),
            },
        )

    def add_event(self, kind: str, text: str, t_host: float) -> None:
        """Append a line of the acquisition's diary; text beyond :data:`TEXT_BYTES` is cut.

        What UTF-8 cannot encode (a path that is not UTF-8) becomes an escape sequence.
        """
        whole = text.encode(errors="backslashreplace")
        self._row(
            "events",
            t_host=t_host,
            utc=utc_now().encode(),
            kind=kind.encode()[:32],
            text=whole[:TEXT_BYTES].decode(errors="ignore").encode(),
        )

    def add_clock(self, device: str, fit: ClockFit, t_host: float) -> None:
        """Append the fit of a device's clock, with its median delay as the residual."""
        self._row(
            "clock",
            t_host=t_host,
            device=device.encode()[:32],
            # Host times in the file are shifted, so the fit must lead to those.
            offset=fit.offset_s + self._time_offset,
            drift=fit.drift,
            reference=fit.reference_s,
            residual=float(np.median(fit.delay_s)),
        )

    def add_selected(
        self,
        pose: np.ndarray,
        measurement: np.ndarray,
        *,
        kind: str,
        amplitude: float,
        t_host: float,
        target: int,
        bracket: Bracket,
        offset: float = 0.0,
        true_elevation: float = float("nan"),
        seconds: float = 0.0,
    ) -> None:
        """Take an image: when this returns it is on the disk.

        Args:
            pose: (4, 4) probe -> tracker, mm.
            measurement: (elements,) times of flight, s, or (2,) point, mm.
            kind: ``time_of_flight`` or ``point``, the recording's.
            amplitude: received.
            t_host: s.
            target: row of the plan.
            bracket: of the target's elevational offset.
            offset: of the probe from the plan's pose along its elevational axis, mm.
            true_elevation: the emulated bench's truth, mm.
            seconds: how long the image took, in the bench's time.

        Raises:
            OutputError: the writer failed, or did not answer in time.
        """
        self._row(
            "calibration",
            pose=pose,
            max_elevation=bracket.max_elevation_mm,
            amplitude=amplitude,
            mask=True,
            time=t_host + self._time_offset,
            target=target,
            **{kind: measurement},
        )
        self._row(
            "placement",
            centre=bracket.centre_mm,
            low=bracket.low_mm,
            high=bracket.high_mm,
            sd=bracket.sd_mm,
            offset=offset,
            true_elevation=true_elevation,
            seconds=seconds,
        )
        self.sync()

    def add_pixel(
        self,
        pose: np.ndarray,
        pixel: np.ndarray,
        covariance: np.ndarray,
        time_s: float,
        *,
        by_host: bool = False,
    ) -> None:
        """Take an image of a free-hand acquisition: when this returns it is on the disk.

        Args:
            pose: (4, 4) probe -> tracker, mm.
            pixel: (2,) [u, v], px.
            covariance: (2, 2), px^2.
            time_s: of the image.
            by_host: whether that is a host time, and not one of the sender's clock.

        Raises:
            OutputError: the writer failed, or did not answer in time.
        """
        self._row(
            "calibration",
            pose=pose,
            pixel=pixel,
            covariance=covariance,
            mask=True,
            time=time_s + (self._time_offset if by_host else 0.0),
        )
        self.sync()

    def leave_out(self, row: int) -> None:
        """Mask a selected image that was taken back.

        Raises:
            OutputError: the writer failed, or did not answer in time.
        """
        self._put("leave_out", row)
        self.sync()

    def add_estimate(self, **values: object) -> None:
        """Append a row to /estimate (see the layout): the calibration so far."""
        self._row("estimate", **values)

    def put(self, group: str, name: str, values: np.ndarray, unit: str) -> None:
        """Write one array of /plan, /test or /truth."""
        self._put("put", group, name, values, unit)

    def copy(self, group: str, name: str, to_group: str, to_name: str) -> None:
        """Copy a whole column into an array of /plan, /test or /truth."""
        self._put("copy", group, name, to_group, to_name)

    def attributes(self, group: str, values: Mapping[str, Any]) -> None:
        """Set attributes of a group."""
        self._put("attributes", group, dict(values))

    def counts(self, group: str, values: Mapping[str, int]) -> None:
        """Set attributes of a group that count something in this run; runs add up."""
        self._put("counts", group, dict(values))

    def sync(self) -> None:
        """Wait until everything handed over so far is on the disk.

        Raises:
            OutputError: the writer failed, or did not answer in time.
        """
        self._note_drops()
        self._marks += 1
        mark = f"sync {self._marks}"
        self._put("sync", mark)
        self._answer(mark)

    def finish(self) -> str:
        """Mark the recording complete and end; returns the SHA-256 digest of the file.

        If the digest cannot be written beside the file, ``digest_error`` says why.

        Raises:
            OutputError: the writer failed; the file is incomplete then.
        """
        self._note_drops()
        self._put("finish")
        answer = self._answer("finish")
        self.digest_error = answer["digest_error"]
        self._stop()
        return answer["sha256"]

    def close(self) -> None:
        """Write what waits and close the file; it stays incomplete unless it was finished.

        Idempotent, also after an interrupt of an earlier call.

        Raises:
            OutputError: the writer failed.
        """
        if self._closed:
            return
        if self.error is None and not self._ended:
            # A full queue has no room for it; the writer must end all the same.
            with suppress(OutputError):
                self._note_drops()
        self._stop()
        if self.error is not None:
            raise self.error

    def _note_drops(self) -> None:
        # While a full queue is waited for, another thread may drop rows of a further group.
        for group, count in dict(self.dropped).items():
            self.counts(group, {"dropped": count})

    def _stream(self, group: str, columns: Mapping[str, np.ndarray]) -> None:
        """Continuous rows: dropped and counted where there is no room."""
        if not self._rows(group, columns, wait=False):
            count = len(next(iter(columns.values())))
            self.dropped[group] = self.dropped.get(group, 0) + count

    def _row(self, group: str, **values: object) -> None:
        columns = {name: np.asarray(value)[None] for name, value in values.items()}
        self._rows(group, columns, wait=True)

    def _rows(self, group: str, columns: Mapping[str, np.ndarray], *, wait: bool) -> bool:
        columns = dict(columns)
        if "t_host" in columns:
            columns["t_host"] = columns["t_host"] + self._time_offset
        return self._put("append", group, columns, wait=wait)

    def _put(self, do: str, *arguments: Any, wait: bool = True) -> bool:
        """Queue a request (:mod:`hw.recording.writer_process`); False: there was no room."""
        data = pickle.dumps((do, arguments))
        size = len(data)

        def room() -> bool:
            return not self._waiting or self._waiting + size <= self._capacity

        with self._lock:
            if not wait and not room():
                self._raise_error()
                return False
            self._wait_for(room, self._patience)
            self._raise_error()
            self._queue.append(data)
            self._waiting += size
            self._changed.notify_all()
        return True

    def _answer(self, mark: str, patience_s: float | None = None) -> Any:
        patience = self._patience if patience_s is None else patience_s
        with self._lock:
            self._wait_for(lambda: mark in self._answers, patience)
            return self._answers.pop(mark)

    def _wait_for(self, done: Callable[[], bool], patience_s: float) -> None:
        """Wait while the writer takes data, however much waits before.

        A process that is suspended or held up does not wait meanwhile.

        Raises:
            OutputError: the writer failed, or has taken nothing for so long.
        """
        waiting, taken = Waiting(REAL), self._taken
        while not done():
            self._raise_error()
            if self._taken != taken:
                waiting, taken = Waiting(REAL), self._taken
            left = patience_s - waiting.so_far()
            if left <= 0:
                self._give_up(patience_s)
            self._changed.wait(min(left, _TURN_S))

    def _give_up(self, waited_s: float) -> NoReturn:
        """Fail for good: whatever is handed over next would wait as long."""
        self._hung = True
        self._fail(
            OutputError(
                f"{self.path}: the disk took no data for {waited_s:g} s: check it, and the network "
                "if it is reached through one"
            )
        )
        assert self.error is not None
        raise self.error

    def _raise_error(self) -> None:
        if self.error is not None:
            raise self.error
        if self._ended:
            raise OutputError(f"{self.path}: the recording is closed")

    def _stop(self) -> None:
        """Let the queue run empty, close the pipe, and wait for the writer's end."""
        with self._lock:
            self._ending = self._ended = True
            self._changed.notify_all()
        ending_s = _HUNG_ENDING_S if self._hung else _ENDING_S
        waiting, taken = Waiting(REAL), self._taken
        while self._feeder.is_alive() and waiting.so_far() < ending_s:
            self._feeder.join(min(ending_s, _TURN_S))
            # A disk that was given up gets no more time, however it goes on.
            if self._taken != taken and not self._hung:
                waiting, taken = Waiting(REAL), self._taken
        stuck = self._feeder.is_alive()
        if stuck:
            # It takes no data. To close its pipe here would wait for the feeder, without end, or be
            # done by both at once. The feeder closes it when the writer's end has broken it.
            self._process.kill()
            self._feeder.join(ending_s)
        ended = not self._feeder.is_alive() and finish(self._process, ending_s)
        if stuck or not ended:
            self._fail(OutputError(f"{self.path}: the writer did not end and was stopped"))
        self._listener.join(ending_s)
        if self.error is None and (self._unsent or self._process.returncode):
            self._fail(OutputError(f"{self.path}: the writer ended early; resume the recording"))
        # A writer that hangs in the disk outlives its kill, and the listener then waits for it.
        if self._process.stdout is not None and not self._listener.is_alive():
            self._process.stdout.close()
        self._closed = True

    def _feed(self, pipe: BinaryIO) -> None:
        try:
            while True:
                with self._lock:
                    while not self._queue:
                        if self._ending:
                            return
                        self._changed.wait()
                    data = self._queue.popleft()
                pipe.write(data)
                pipe.flush()
                with self._lock:
                    self._waiting -= len(data)
                    self._taken += 1
                    self._changed.notify_all()
        except OSError:
            # The writer is gone; the listener knows why.
            with self._lock:
                self._unsent = True
                self._queue.clear()
        finally:
            with suppress(OSError):
                pipe.close()

    def _listen(self, pipe: BinaryIO) -> None:
        try:
            self._hear(pipe)
        except Exception as error:
            # Here nobody would see it, and who waits for an answer would wait for long.
            self._fail(OutputError(f"{self.path}: {type(error).__name__}: {error}"))
            return
        if not self._ending:
            self._fail(OutputError(f"{self.path}: the writer ended; resume the recording"))

    def _hear(self, pipe: BinaryIO) -> None:
        for line in pipe:
            answer = json.loads(line)
            if "kept" in answer:
                self.kept = answer["kept"]
                continue
            if "error" in answer:
                kind = FormatError if answer["format"] else OutputError
                self._fail(kind(answer["error"]))
                continue
            with self._lock:
                self._taken += 1
                if "mark" in answer:
                    self._answers[answer["mark"]] = answer
                self._changed.notify_all()

    def _fail(self, error: CalibrationError) -> None:
        with self._lock:
            # Keep the first error: the later ones follow from it.
            self.error = self.error or error
            self._changed.notify_all()


def _column(items: Sequence[Any], name: str, kind: type = float) -> np.ndarray:
    return np.array([getattr(item, name) for item in items], kind)


def no_digest(reason: str) -> str:
    """A line for a person where :attr:`Recorder.digest_error` is set."""
    return f"the recording is complete, but has no SHA-256 digest beside it: {reason}"
