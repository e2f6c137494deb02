"""When an image is taken, and what the person who holds the probe is told.

An image is taken automatically once the probe has been held still for a moment, if it shows a
credible target and differs from the images before: another orientation, or the target elsewhere in
the image (and then the pose, too, must differ: the target rests). Its pose is the mean over that
moment. The person is told what is still missing: parts of the image where the target has not been,
and turns of the probe, also about a second axis.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from hw.freehand.posed import PosedImage
from hw.runtime.rigid import mean_pose, turn_deg
from jaxcal import InputError
from jaxcal.data.names import Target
from jaxcal.data.poses import vectors_from_rotations
from jaxcal.data.segmentation.image import localise
from jaxcal.runtime.array_types import Float

_COLUMN_NAMES, _ROW_NAMES = ("left", "middle", "right"), ("upper", "central", "lower")
_AT_REST = 0.25
"""While the pose is still, the target may move in the image by so much of what makes an image
differ: 3 % of the frame by default, 2 mm of 70."""
_WIDE_DEG = 12.0
"""SD of the orientations about an axis that is enough to determine the transform well."""


@dataclass(frozen=True)
class Rules:
    """When an image is taken.

    Attributes:
        hold_s: the probe must be still for so long, s.
        still_mm: largest motion of a probe that is still.
        still_deg: largest turn of a probe that is still.
        different_deg: an image differs from another if the probe has turned by this,
        different_part: or if the target has moved by this part of the frame.
        target: what to look for.
        region: (first column, first row, columns, rows) to look in, px.
    """

    hold_s: float = 0.6
    still_mm: float = 0.7
    still_deg: float = 0.5
    different_deg: float = 5.0
    different_part: float = 0.12
    target: Target = "echo"
    region: tuple[int, int, int, int] | None = None

    def __post_init__(self) -> None:
        for name in ("hold_s", "still_mm", "still_deg", "different_deg", "different_part"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True)
class Taken:
    """An image that was taken.

    Attributes:
        pose: (4, 4) mean over the moment, mm.
        pixel: [u, v] of the target, px.
        covariance: (2, 2), px^2.
        time: s.
        posed: the frame in the middle of that moment.
        row: its number in the recording, once it is there.
    """

    pose: Float[np.ndarray, "4 4"]
    pixel: Float[np.ndarray, " 2"]
    covariance: Float[np.ndarray, "2 2"]
    time: float
    posed: PosedImage | None = None
    row: int | None = None


@dataclass(frozen=True)
class Look:
    """Result of looking at one image.

    Attributes:
        words: what the person is told.
        taken: the image, if it is to be taken.
    """

    words: str
    taken: Taken | None = None


@dataclass
class Guide:
    """Looks at one image after the other.

    Attributes:
        rules: when an image is taken.
        taken: images that count, those of a resumed recording first.
    """

    rules: Rules = field(default_factory=Rules)
    taken: list[Taken] = field(default_factory=list)
    _moment: deque[PosedImage] = field(default_factory=deque)
    _unchanged: PosedImage | None = None
    """The first of the images, up to the newest, that are the same to the last pixel."""
    _stuck: float = -np.inf
    """Time of the newest image that is the same as one of another place."""
    _contradicted: Float[np.ndarray, "4 4"] | None = None
    """A still pose during which the target moved in the image: wrong until the pose changes."""
    _tried: float = -np.inf
    _words: str = ""

    def look(self, posed: PosedImage) -> Look:
        """Judge an image; one that keeps all rules is to be kept (:meth:`keep`)."""
        rules, moment = self.rules, self._moment
        if posed.pose is None:
            moment.clear()
            return Look(f"not tracked: {posed.why}")
        if moment and posed.time <= moment[-1].time:
            # The sender's clock was set back.
            self.forget()
        before = self._unchanged
        if before is None or not np.array_equal(before.image.array, posed.image.array):
            self._unchanged = posed
        elif not self._still(np.array([before.pose, posed.pose])):
            self._stuck = posed.time
        moment.append(posed)
        # At least two images, however seldom they come.
        while len(moment) > 2 and moment[-1].time - moment[1].time >= rules.hold_s:
            moment.popleft()
        poses = np.array([each.pose for each in moment])
        if not self._still(poses):
            self._contradicted = None
            # Keep only the newest poses: the probe may be still from now on.
            while len(moment) > 1 and moment[-1].time - moment[0].time > 0.3 * rules.hold_s:
                moment.popleft()
            return Look("moving: bring the target into the image and hold still")
        if moment[-1].time - moment[0].time < 0.9 * rules.hold_s:
            return Look("hold still")
        if posed.time - self._tried < 0.5 * rules.hold_s:
            return Look(self._words)
        self._tried = posed.time
        look = self._judge(mean_pose(poses))
        self._words = look.words
        return look

    def keep(self, taken: Taken) -> None:
        """Count an image that is on the disk, and begin a new moment."""
        self.taken.append(taken)
        self.forget()

    def forget(self) -> None:
        """Begin a new moment: after an image was taken or taken back."""
        self._moment.clear()
        self._tried, self._words, self._stuck = -np.inf, "", -np.inf

    def _judge(self, pose: Float[np.ndarray, "4 4"]) -> Look:
        """Judge the moment by its middle image; the poses, of this mean, are still."""
        rules, middle = self.rules, self._moment[len(self._moment) // 2]
        frame = middle.image.array
        located = localise(frame, rules.target, region=rules.region)
        if not located.found[0]:
            return Look(f"no credible target: {located.reason[0]}")
        pixel = located.position[0]
        if middle.time <= self._stuck:
            return Look("the image stays the same while the probe moves: is the machine frozen?")
        same = self._like(pose, pixel, frame.shape)
        if same is not None:
            return Look(
                f"as in image {same.row}: turn the probe, or bring the target elsewhere in the "
                "image"
            )
        for other in self.taken:
            if self._still(np.array([other.pose, pose])):
                return Look(
                    f"the pose is that of image {other.row}, but the target is elsewhere in the "
                    "image: is the tracker frozen, or was the target moved?"
                )
        if self._moves(pixel, frame.shape):
            self._contradicted = pose
        if self._contradicted is not None and self._still(np.array([self._contradicted, pose])):
            return Look(
                "the target moves in the image while the pose is still: is the tracker frozen?"
            )
        taken = Taken(pose, pixel, located.covariance[0], middle.time, middle)
        return Look(f"taken: {len(self.taken) + 1}", taken)

    def _moves(self, pixel: np.ndarray, shape: tuple[int, ...]) -> bool:
        """Whether the target is elsewhere at the moment's beginning or end than in its middle."""
        for end in (self._moment[0], self._moment[-1]):
            located = localise(end.image.array, self.rules.target, region=self.rules.region)
            moved = np.abs(located.position[0] - pixel) / [shape[1], shape[0]]
            # A frame without a target tells nothing: the comparison with NaN is false.
            if np.max(moved) > _AT_REST * self.rules.different_part:
                return True
        return False

    def _still(self, poses: Float[np.ndarray, "n 4 4"]) -> bool:
        shift, turn = spread_of(poses)
        return shift <= self.rules.still_mm and turn <= self.rules.still_deg

    def _like(self, pose: np.ndarray, pixel: np.ndarray, shape: tuple[int, ...]) -> Taken | None:
        """The image that this one does not differ from."""
        for other in self.taken:
            moved = np.abs(pixel - other.pixel) / [shape[1], shape[0]]
            near = np.max(moved) < self.rules.different_part
            if near and turn_deg(other.pose, pose) < self.rules.different_deg:
                return other
        return None

    def advice(self, size: tuple[int, int]) -> str:
        """What is still missing, in words.

        Args:
            size: columns and rows of the part of the frame that is looked at, px.
        """
        if not self.taken:
            return "bring the target into the image and hold the probe still"
        missing = []
        cell = self._empty_cell(size)
        if cell is not None:
            missing.append(f"bring the target to the {cell} of the image")
        if len(self.taken) >= 3:
            spread = orientation_sds(np.array([each.pose for each in self.taken]))
            if spread[0] < _WIDE_DEG:
                missing.append(
                    f"turn the probe more (its orientations differ by {spread[0]:.0f} degrees)"
                )
            elif spread[1] < _WIDE_DEG:
                missing.append(
                    "turn the probe about another axis as well (tilt, rock and twist it)"
                )
        return "; ".join(missing) or "well covered: any other pose helps"

    def _empty_cell(self, size: tuple[int, int]) -> str | None:
        left, top, wide, high = self.rules.region or (0, 0, *size)
        visited = np.zeros((3, 3), bool)
        for each in self.taken:
            column = int(np.clip((each.pixel[0] - left) / wide * 3, 0, 2))
            row = int(np.clip((each.pixel[1] - top) / high * 3, 0, 2))
            visited[row, column] = True
        if visited.all():
            return None
        # The empty cell farthest from the cells where the target has been.
        empty, seen = np.argwhere(~visited), np.argwhere(visited)
        away = np.linalg.norm(empty[:, None] - seen[None], axis=2).min(axis=1)
        row, column = empty[int(np.argmax(away))]
        return f"{_ROW_NAMES[row]} {_COLUMN_NAMES[column]}"


def orientation_sds(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " 3"]:
    """SDs of orientations about their principal axes, degrees, the largest first."""
    turns = np.degrees(vectors_from_rotations(mean_pose(poses)[:3, :3].T @ poses[:, :3, :3]))
    return np.sqrt(np.maximum(np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1], 0.0))


def spread_of(poses: Float[np.ndarray, "n 4 4"]) -> tuple[float, float]:
    """Largest distance (mm) and turn (degrees) from the newest pose."""
    shift = np.linalg.norm(poses[:, :3, 3] - poses[-1, :3, 3], axis=1).max()
    return float(shift), max(turn_deg(pose, poses[-1]) for pose in poses)
