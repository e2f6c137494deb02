"""The probe at one pose of the plan: the procedures' view of the real clients.

Moves go through the motion process and its gate. A hesitation (StaleError) stops the robot, and the
move is asked for again when the device is back, at most ten times. Every other stop of a motion
ends the acquisition (:mod:`hw.robot.motion` says which is which).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hw.midplane.image_scan import ImageBench, pixel_of, place_of
from hw.midplane.search import Echoes, PlacementError
from hw.recording.session import Session
from hw.robot.motion import Motion
from hw.robot.stream import PoseSample
from hw.runtime.errors import Device, RefusedError, StaleError, refused
from hw.runtime.rigid import apart
from hw.ultrasound.receiver import Image
from jaxcal.data.segmentation.image import localise
from jaxcal.runtime.array_types import Float

_MOST_HESITATIONS = 10
IMAGE_AGE_S = 0.2
"""Largest age of an image at its arrival: a frame's time, plus the machine's and the network's
(assumption; the emulated machine takes 0.05 s)."""
_NEAR_MM = 12.0
"""The drawing gives the target's place in the image to better than this: mount and target are off
by some millimetres and degrees."""
_DRIFT_MM = 0.5
"""A resting arm's pose changes by less; a degree counts as a mm."""
_LOOKS = 5
"""Frames to look at before a place without a credible target is given up."""


class ProbeStage:
    """A probe that can be moved along its nominal elevational axis and listened to.

    Args:
        session: devices.
        motion: of the robot.
        targets: (n, 4, 4) poses of the plan, mm.
        note: called with events for the recording: kind, text.
    """

    device: Device = "active echo"
    target = "the element"
    to_check = "the element, its threshold and the coupling"

    def __init__(
        self,
        session: Session,
        motion: Motion,
        targets: Float[np.ndarray, "n 4 4"],
        note: Callable[[str, str], None],
    ) -> None:
        self._targets = targets
        self._session, self._motion, self._note = session, motion, note
        self._axis = np.asarray(session.setup.scene.elevational, float)
        self.plan_pose = np.eye(4)
        self.arrived_s = session.clock.now()
        """Bench time since which neither the probe nor the threshold has changed."""
        self._rests_at: np.ndarray | None = None
        """Pose in which the last move ended."""

    def go_to(self, row: int) -> None:
        """Travel to a pose of the plan; offsets count from there.

        The plan was checked from each pose to the next. If the robot starts elsewhere (in a resumed
        run, or after poses that were given up) and the straight way is refused, it goes to the
        nearest pose of the plan and from there through the poses in between.

        Raises:
            DeviceError: stopped, refused, lost, or a device in lasting trouble.
        """
        self.plan_pose = self._targets[row].copy()
        try:
            self._move(self.plan_pose)
            return
        except RefusedError as error:
            if self._motion.ended:  # refused while it moved, for good: no other way helps
                raise
            here = self._session.poses.awaited().pose
            near = int(np.argmin([apart(here, pose) for pose in self._targets]))
            if near == row:
                raise
            self._note("detour", f"{error}; through poses {near + 1} to {row + 1} of the plan")
        step = 1 if row > near else -1
        for passing in range(near, row + step, step):
            self._move(self._targets[passing])

    def move(self, offset_mm: float) -> float:
        """Go to an offset (mm) along the elevational axis; the offset as tracked.

        Raises:
            PlacementError: the limits, or the controller, do not allow it; nothing moved.
            DeviceError: stopped, lost, or a device in lasting trouble.
        """
        pose = self.plan_pose.copy()
        direction = pose[:3, :3] @ self._axis
        pose[:3, 3] += offset_mm * direction
        try:
            tracked = self._move(pose).pose
        except RefusedError as error:
            if self._motion.ended:  # refused while it moved, for good
                raise
            raise PlacementError(
                f"the search may not go {offset_mm:+.1f} mm from the planned pose: {error.args[0]}",
                device="robot",
            ) from None
        return float((tracked[:3, 3] - self.plan_pose[:3, 3]) @ direction)

    def read(self, frames: int) -> Echoes:
        """Whole frames that began after the last move.

        Raises:
            DeviceError: motion has ended, or a device is in lasting trouble.
        """
        self._motion.check()
        heard = self._session.listen(frames, self.arrived_s)
        answered = np.array([np.isfinite(frame.tof_s) for frame in heard])
        amplitude = np.array([frame.amplitude for frame in heard], float)
        return Echoes(np.where(answered, amplitude, 0.0), answered)

    def set_threshold(self, threshold: int) -> None:
        """Set the threshold, counts; frames that began under another one are not read any more."""
        self._session.echo.set_threshold(threshold)
        self.arrived_s = self._session.clock.now()

    def load_pattern(self, pattern: bytes) -> None:
        """Load a pattern: a level (0 to 255) for each line."""
        self._session.echo.load_pattern(pattern)

    def inject(self, on: bool, delay_s: float = 0.0) -> None:
        """Switch injection on or off."""
        self._session.echo.inject(on, delay_s)

    def frame(self) -> np.ndarray | None:
        """The newest B-mode frame for the operator; None where no images come.

        Raises:
            DeviceError: motion has ended, or a device is lost or in lasting trouble.
        """
        self._motion.check()
        self._session.wait_until_clear()
        image = self._session.latest_image()
        return image.array if image is not None and image.array.dtype == np.uint8 else None

    def whole_frame(self) -> Image:
        """The next B-mode frame that began after the last move.

        Raises:
            DeviceError: motion has ended, or no images come.
        """
        self._motion.check()
        return self._session.image_after(self.arrived_s + IMAGE_AGE_S)

    def any_frame(self) -> Image | None:
        """As :meth:`whole_frame`, but RF will do; None where the setup has no machine."""
        if self._session.images is None:
            return None
        return self._session.image_after(self.arrived_s + IMAGE_AGE_S, rf=True)

    def image_bench(self, row: int, *, credible: bool = False) -> ImageBench:
        """The bench of the procedures for a phantom that only shows in the image.

        Args:
            row: of the plan; it says where the target should be.
            credible: respond only where the segmentation finds the target.

        Its ``read`` raises a StaleError as :meth:`locate` does: by a frozen image the search would
        go on to the end of its reach.
        """
        image = self.whole_frame()
        place, within = self._expected_px(row, image)

        def see() -> np.ndarray:
            nonlocal image
            image = self.whole_frame()
            return image.array

        return ImageBench(
            self.move,
            see,
            place,
            within,
            credible=credible,
            check=lambda: self._check_new(image),
        )

    def _check_new(self, image: Image) -> None:
        """Check an image that shows something: an empty one may be the same in every pose."""
        if self._session.is_of_the_way(image):
            raise StaleError(
                "the image is still that from before the probe came to rest: is the machine "
                "frozen?",
                device="ultrasound",
            )

    def _expected_px(self, row: int, image: Image) -> tuple[tuple[float, float], float]:
        """Where the target should be in an image, and how far from there to look, px."""
        expected = self._session.setup.scene.expected(self._targets[row])[[0, 2]]
        place = pixel_of(expected, image.spacing_mm, image.array.shape[1])
        return place, _NEAR_MM / max(image.spacing_mm)

    def locate(self, row: int) -> tuple[Float[np.ndarray, " 2"], float, Image]:
        """[lateral, range] (mm) of the target in a frame where the probe stands, contrast, frame.

        Size and pixels are those of the same frame: the machine's depth may be changed any time.

        Raises:
            PlacementError: no credible target in several frames.
            StaleError: the frame is one of another pose: a frozen screen that is grabbed has new
                time stamps.
        """
        reason = ""
        for _ in range(_LOOKS):
            image = self.whole_frame()
            place, within = self._expected_px(row, image)
            found = localise(image.array, "cross", near=place, within_px=within)
            if found.found[0]:
                self._check_new(image)
                contrast = float(found.contrast_db[0])
                columns = image.array.shape[1]
                return place_of(found.position[0], image.spacing_mm, columns), contrast, image
            reason = found.reason[0]
        raise PlacementError(
            f"no credible target in {_LOOKS} frames: {reason}", device="ultrasound"
        )

    def check(self) -> None:
        """Raise the error if a device is in trouble, or motion has ended.

        Raises:
            DeviceError: what is wrong.
        """
        self._session.check()
        self._motion.check()

    def resting_pose(self, seconds: float) -> Float[np.ndarray, "4 4"]:
        """The mean pose of the next bench seconds, (4, 4) mm.

        Raises:
            RefusedError: it is not the pose in which the last move ended. Controllers of the CB
                series do not tell their TCP offset among the poses, and it is read only before a
                move: an image after the last one would have a wrong pose.
            DeviceError: the connection was lost, or too few poses came.
        """
        pose = self._session.poses.steady(seconds).sample.pose
        drift = 0.0 if self._rests_at is None else apart(self._rests_at, pose)
        if drift > _DRIFT_MM:
            raise refused(
                f"the pose changed by {drift:.1f} mm or degrees while the robot was at rest: set "
                "the TCP offset as before, and do not move the arm by hand"
            )
        return pose

    def _move(self, pose: np.ndarray) -> PoseSample:
        for hesitation in range(_MOST_HESITATIONS + 1):
            self._session.wait_until_clear()
            try:
                sample = self._motion.move_to(pose)
            except StaleError as error:
                if self._motion.ended or hesitation == _MOST_HESITATIONS:
                    raise
                self._note("hesitation", str(error))
                continue
            self.arrived_s, self._rests_at = self._session.clock.now(), sample.pose
            return sample
        raise AssertionError
