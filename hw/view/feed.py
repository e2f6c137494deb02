"""The acquisition's end of the live view: its state goes into a pipe, ten times a second.

While the pipe has not taken a whole message, no other message is made, so a slow, stopped or dead
viewer costs the acquisition nothing and delays nothing. It does not get what it missed. State that
changes seldom is sent when it has changed; the pose, and a new frame, in every message.
"""

from __future__ import annotations

import json
import os
import pickle
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from hw.midplane.bracket import Placement
from hw.recording.session import Session
from hw.robot.motion_plan import MotionPlan
from hw.runtime.errors import DeviceError
from hw.runtime.extras import missing
from hw.runtime.processes import finish, first_line, spawn
from hw.setup.description import Setup
from jaxcal import InputError
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float

RATE_HZ = 10.0
_START_WALL_S = 30.0
_END_WALL_S = 2.0
_LINES = 5


class Audience:
    """Keeps what an acquisition tells of its progress; :class:`LiveView` shows it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._session: Session | None = None
        self._slow: dict[str, Any] = {"done": [], "given_up": [], "row": None, "said": []}
        self._said: deque[str] = deque(maxlen=_LINES)
        self._changed = True

    def plan(
        self,
        setup: Setup,
        plan: MotionPlan,
        targets: Float[np.ndarray, "n 4 4"],
        done: list[int],
        images: int | None = None,
    ) -> None:
        """What shall be acquired: all poses, the rows that a resumed recording has, most images."""
        scene, limits = setup.scene, plan.limits
        self._tell(
            plan=np.asarray(targets, float)[:, :3].reshape(-1, 12).tolist(),
            box=[list(limits.box_min_mm), list(limits.box_max_mm)],
            tcp_offset=list(plan.tcp_offset),
            arm=limits.arm_model,
            image_to_probe=np.asarray(scene.image_to_probe, float).ravel().tolist(),
            point=np.asarray(scene.point_mm, float).tolist(),
            done=list(done),
            images=len(targets) if images is None else images,
            given_up=[],
            row=None,
        )

    def watch(self, session: Session | None) -> None:
        """Show the poses and frames of this session; None: show them no longer."""
        with self._lock:
            self._session = session

    def going(self, row: int) -> None:
        """The robot travels to a pose of the plan."""
        self._tell(row=row, stop=None)

    def stop(self, offset_mm: float, amplitude: float, threshold: int) -> None:
        """The search listened somewhere."""
        self._tell(stop=[float(offset_mm), float(amplitude), int(threshold)])

    def taken(self, row: int, placement: Placement, answer: Calibration | None) -> None:
        """An image was taken, and this is the estimate now."""
        bracket = placement.bracket
        self._tell(
            done=[*self._slow["done"], row],
            bracket=[bracket.centre_mm, bracket.low_mm, bracket.high_mm],
            estimate=None if answer is None else _estimate(answer),
        )

    def given_up(self, row: int) -> None:
        """No mid-plane was found there, or the operator skipped it."""
        self._tell(given_up=[*self._slow["given_up"], row])

    def say(self, line: str) -> None:
        """A line for the page, as the person at the terminal reads it."""
        self._said.append(line)
        self._tell(said=list(self._said))

    def _tell(self, **changes: Any) -> None:
        with self._lock:
            self._slow.update(changes)
            self._changed = True


@contextmanager
def watched(view: Audience, session: Session) -> Iterator[None]:
    """Show a session's poses and frames as long as it is open."""
    view.watch(session)
    try:
        yield
    finally:
        view.watch(None)


class LiveView(Audience):
    """The live view of one acquisition; a context manager.

    Args:
        say: told the address, and once that the viewer is gone.
        port: of the page; another one is taken if it is not free.
        rate_hz: messages a second.

    Attributes:
        url: of the page.
        pid: of the viewer's process.
        sent: messages.
        left_out: messages not made because the pipe had not taken the one before.
        seconds: CPU time of the feeding thread.

    Raises:
        InputError: viser is not installed, or the viewer does not start; one line.
    """

    def __init__(
        self, say: Callable[[str], None], port: int = 8080, rate_hz: float = RATE_HZ
    ) -> None:
        cure = missing("viser", extra="view")
        if cure is not None:
            raise InputError(f"--view: {cure}")
        super().__init__()
        self._say, self._period_s = say, 1.0 / rate_hz
        self._process = spawn("hw.view.server", str(port), stdin=True)
        self.pid = self._process.pid
        self.url = self._greeting()
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)
        self.sent = self.left_out = 0
        self.seconds = 0.0
        self._pending = memoryview(b"")
        self._frame_id: int | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._feed, daemon=True, name="view")
        self._thread.start()
        say(f"view: {self.url} (this machine only; it shows and never moves anything)")

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the viewer's process; safe to repeat."""
        self._ending.set()
        self._thread.join()
        finish(self._process, _END_WALL_S)
        assert self._process.stdout is not None
        self._process.stdout.close()

    # The thread that feeds

    def _feed(self) -> None:
        before = time.thread_time()
        try:
            due = time.monotonic()
            while True:
                due = max(due, time.monotonic() - self._period_s) + self._period_s
                if self._ending.wait(max(due - time.monotonic(), 0.0)):
                    return
                if len(self._pending):
                    self.left_out += 1
                else:
                    self._pending = memoryview(self._message())
                    self.sent += 1
                self._write()
                self.seconds = time.thread_time() - before
        except OSError:
            self._say("view: the viewer ended; the acquisition goes on without it")
        except Exception as error:
            why = f"{type(error).__name__}: {error}"
            self._say(f"view: {why}; the acquisition goes on without it")

    def _write(self) -> None:
        """Hand over what the viewer takes within half a period.

        Raises:
            OSError: the viewer is gone.
        """
        deadline = time.monotonic() + 0.5 * self._period_s
        while len(self._pending):
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([], [self._pipe], [], left)[1]:
                return
            with suppress(BlockingIOError):
                written = os.write(self._pipe, self._pending)
                self._pending = self._pending[written:]

    def _message(self) -> bytes:
        with self._lock:
            session = self._session
            told = {**self._slow} if self._changed else {}
            self._changed = False
        frame: np.ndarray | None = None
        if session is not None:
            try:
                sample = session.poses.latest()
                told["pose"] = sample.pose[:3].ravel().tolist()
                told["joints"] = None if sample.joints is None else list(sample.joints)
            except DeviceError as error:
                told["trouble"] = str(error)
            image = session.latest_image()
            fresh = image is not None and image.frame_id != self._frame_id
            if image is not None and fresh and image.array.dtype == np.uint8:
                self._frame_id = image.frame_id
                small, spacing = halved(image.array), [2 * step for step in image.spacing_mm]
                if 1.5 * spacing[0] < spacing[1]:
                    # Columns much narrower than the rows would not be seen: join pairs of them.
                    pairs = small.shape[1] // 2 * 2
                    small = np.maximum(small[:, :pairs:2], small[:, 1:pairs:2])
                    spacing[0] *= 2
                frame, told["spacing"] = small, spacing
        return pickle.dumps((told, frame))

    def _greeting(self) -> str:
        """Wait for the viewer; returns the address that it prints once its page can be opened."""
        line = first_line(self._process, _START_WALL_S)
        told = json.loads(line) if line else {}
        if "url" in told:
            return told["url"]
        self._process.kill()
        self._process.communicate()
        why = told.get("error", "no reason given")
        raise InputError(f"view: the viewer did not start: {why}")


def _estimate(answer: Calibration) -> dict[str, Any]:
    """What the page shows of an estimate; unknown covariances are None."""
    found = answer.numpy()

    def known(matrix: Any) -> list[float] | None:
        values = np.asarray(matrix).ravel()
        return values.tolist() if np.isfinite(values).all() else None

    return {
        "image_to_probe": found.image_to_probe.ravel().tolist(),
        "covariance": known(found.covariance),
        "point": found.point.tolist(),
        "point_covariance": known(found.point_covariance),
        "rms": float(found.rms),
        "status": answer.status,
    }


def halved(frame: np.ndarray) -> np.ndarray:
    """A frame of half the size; each pixel is the brightest of four, so that thin bars stay."""
    rows, columns = (size // 2 * 2 for size in frame.shape)
    even = np.maximum(frame[:rows:2, :columns], frame[1:rows:2, :columns])
    return np.maximum(even[:, ::2], even[:, 1::2])
