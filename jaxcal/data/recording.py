"""What was measured: poses, image measurements and their circumstances, in numpy and with units.

A :class:`Recording` holds the data of one file as measured; a :class:`jaxcal.Problem` holds the
arrays that a solver takes. Recordings are checked when they are made, so that all later code may
rely on shapes, units and finite values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import check_poses
from jaxcal.data.probe import Probe, check_probe
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.arrays import is_traced
from jaxcal.runtime.given_values import (
    check_enough,
    is_number,
    real_array,
    refuse_masked,
    shaped_array,
    truth_array,
    whole_number,
)
from jaxcal.runtime.messages import shown

MINIMUM_IMAGES = 4
"""With fewer used images nothing can be solved: 3 residuals an image against 9 unknowns."""

MOST_IMAGES = 100_000
"""Most images of a recording, in whatever file, and of a simulation."""

LARGEST = 1e7
"""Largest coordinate accepted, in mm or px, and largest variance of one: ten kilometres."""
_BEYOND = f"holds a number beyond {LARGEST:g}: that cannot be a measure"

LEAST_SD = 1e-9
"""Least SD accepted in a covariance, in mm or px: no point is known within a picometre."""

LARGEST_FRAME = 2**53
"""Largest number of a frame; larger ones are not exact in float64."""

LEAST_REACH_MM = 5.0
"""No tracker sees a tool nearer to its origin than this in all poses."""

LARGEST_PIXEL_MM = 10.0
"""Largest pixel accepted; a size in micrometres is larger."""

Kind = Literal["point", "pixel", "time_of_flight"]
_EXTENT_MM = 50.0
"""Of a target's path through the image where nothing better is known."""
_AT_REST_MM = 1e-6
_MOST_BACK = 0.25
"""Largest share of steps back in time of images in order. A random order has half."""

OF_SOME = {
    "covariance": "covariances of the points",
    "max_elevation": "bounds on the offsets",
    "time_of_flight": "times of flight",
    "amplitude": "amplitudes",
    "time": "time stamps",
}
"""What :func:`joined` keeps only if both recordings have it, in words."""
UNIT_OF: dict[Kind, str] = {"point": "mm", "pixel": "px", "time_of_flight": "s"}
"""Unit in which measurements of a kind are given."""


class MetresError(InputError):
    """Translations of poses look like metres, not millimetres."""


@dataclass(frozen=True, eq=False)
class Images:
    """One set of tracked images of the target.

    Attributes:
        poses: (n, 4, 4) probe -> tracker, mm; rotations projected to SO(3).
        measurements: (n, 2) [lateral, range] in mm for ``point``; (n, 2) [u lateral, v axial] in px
            for ``pixel``; (n, elements) one-way times in s for ``time_of_flight`` (NaN: no echo).
        kind: which of the three.
        mask: (n,) True where the image is used.
        covariance: (n, 2, 2) mm^2 (px^2 for pixels), or None.
        max_elevation: (n,) bound on |elevational offset|, mm, or None.
        amplitude: (n,) received amplitude, arbitrary unit, or None.
        time: (n,) s, or None.
        velocity: (n, 6) of the probe at that time, in its own frame: translation, mm/s, and
            rotation, rad/s; NaN where it is not known; or None.
        spacing_mm: (2,) mm per px [lateral, axial] for pixels; None when unknown.
        face_offset_mm: range of pixel row 0, or of a measured range of 0, mm.
        time_of_flight: (n, elements) the times, s, that points were segmented from, or None.
        frame: (n,) number of each image's frame in the file that it came from, or None.
        frame_size: (columns, rows) of the frames, px, for pixels; None when unknown.
    """

    poses: Float[np.ndarray, "n 4 4"]
    measurements: Float[np.ndarray, "n columns"]
    kind: Kind
    mask: Bool[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n 2 2"] | None = None
    max_elevation: Float[np.ndarray, " n"] | None = None
    amplitude: Float[np.ndarray, " n"] | None = None
    time: Float[np.ndarray, " n"] | None = None
    velocity: Float[np.ndarray, "n 6"] | None = None
    spacing_mm: Float[np.ndarray, " 2"] | None = None
    face_offset_mm: float = 0.0
    time_of_flight: Float[np.ndarray, "n elements"] | None = None
    frame: Int[np.ndarray, " n"] | None = None
    frame_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        # make_images has checked everything; dataclasses.replace checks nothing.
        check_kind(self.kind)
        for name, value in vars(self).items():
            refuse_masked(value, name)
            if isinstance(value, list):
                raise InputError(f"{name} must be a numpy array, not a list")

    def __len__(self) -> int:
        return len(self.poses)

    def without(self, images: Sequence[int] | np.ndarray) -> Images:
        """The set without some images, which stay in the arrays and are not used.

        Args:
            images: their numbers, from 0, images that are not used included.

        Raises:
            InputError: no list, and numbers of no image.
        """
        if np.ndim(images) != 1:
            raise InputError(f"images to leave out are a list of numbers, not {shown(images)}")
        most = len(self) - 1
        left_out = [whole_number("the number of an image", image, 0, most) for image in images]
        mask = self.mask.copy()
        mask[left_out] = False
        return replace(self, mask=mask)

    def out_of_order(self) -> str | None:
        """In words, that many used images are older than the one before; None where few are.

        A few are where recordings were resumed or joined.
        """
        if self.time is None:
            return None
        steps = np.diff(self.time[self.mask])
        back = int(np.count_nonzero(steps < 0))
        if back <= _MOST_BACK * len(steps):
            return None
        return (
            f"the images are not in the order of their time stamps ({back} of {len(steps)} steps "
            "go back): errors that are alike in successive images are not found; sort them by time"
        )

    def __repr__(self) -> str:
        """Number and kind of the images, and what is known of each; not the arrays."""
        optional = ("covariance", "max_elevation", "amplitude", "time", "time_of_flight", "frame")
        known = [name for name in optional if getattr(self, name) is not None]
        sized = "" if self.spacing_mm is None else f", spacing_mm={self.spacing_mm.tolist()}"
        more = f", with {', '.join(known)}" if known else ""
        return f"Images({int(self.mask.sum())} used of {len(self)}, {self.kind}s{sized}{more})"


@dataclass(frozen=True, eq=False)
class Truth:
    """The true values, which only a simulation knows.

    Attributes:
        image_to_probe: (4, 4) X, mm.
        point: (3,) target in the tracker's frame, mm.
        elevation: (n,) elevational offsets, mm.
    """

    image_to_probe: Float[np.ndarray, "4 4"]
    point: Float[np.ndarray, " 3"]
    elevation: Float[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording: images to calibrate with and, optionally, test images, truth and the probe.

    Attributes:
        calibration: the images to calibrate with.
        test: the images of an independent test set, or None.
        truth: the true values of a simulation, or None.
        probe: the transducer, or None.
        pose_frames: names of the poses' two frames, that of the probe and that of the tracker, if
            the file that the images came from states them.
        source: the file that it came from, for messages.
    """

    calibration: Images
    test: Images | None = None
    truth: Truth | None = None
    probe: Probe | None = None
    source: str = field(default="memory", compare=False)
    pose_frames: tuple[str, str] | None = None

    def __post_init__(self) -> None:
        for name, images in (("calibration", self.calibration), ("test", self.test)):
            if not isinstance(images, Images) and (name == "calibration" or images is not None):
                raise InputError(
                    f"{name} takes images (jaxcal.make_images makes them), not "
                    f"{type(images).__name__}"
                )
        if not (self.truth is None or isinstance(self.truth, Truth)):
            raise InputError(f"truth must be that of a simulation, not {shown(self.truth)}")
        if self.probe is not None:
            check_probe(self.probe)
        if self.pose_frames is not None:
            object.__setattr__(self, "pose_frames", _checked_names(self.pose_frames))

    def __len__(self) -> int:
        return len(self.calibration)

    def __repr__(self) -> str:
        """What it holds, without the arrays."""
        test = "" if self.test is None else f", test={self.test}"
        truth = "" if self.truth is None else ", with truth"
        probe = "" if self.probe is None else f", probe={self.probe}"
        return f"Recording({self.source!r}, {self.calibration}{test}{truth}{probe})"


def _checked_names(frames: Any) -> tuple[str, str]:
    """The names of two frames, which may be those of a file that is not trusted."""
    if isinstance(frames, (tuple, list)) and len(frames) == 2:
        source, target = frames
        if all(isinstance(name, str) and name.strip() and name.isprintable() for name in frames):
            return source, target
    raise InputError(f"pose_frames must be the names of two frames, not {shown(frames)}")


def joined(first: Recording, second: Recording) -> Recording:
    """The calibration images of two recordings of one target, in this order, as one recording.

    What only one of them states of every image (covariances, times, ...) is left out, and so are
    the truth of a simulation and the numbers of frames, which would be those of two files. Test
    images are those of the first.

    Raises:
        InputError: the images differ in kind, size of a pixel, probe or frames of the poses.
    """
    a, b = first.calibration, second.calibration
    where = f"{second.source} cannot be added to {first.source}"
    if a.kind != b.kind:
        raise InputError(f"{where}: it holds {b.kind}s, not {a.kind}s")
    sizes = [None if each.spacing_mm is None else each.spacing_mm.tolist() for each in (a, b)]
    if sizes[0] != sizes[1] or a.face_offset_mm != b.face_offset_mm:
        raise InputError(
            f"{where}: their pixels must be of one size, known in both recordings or in neither "
            "(--spacing states it)"
        )
    if a.frame_size and b.frame_size and a.frame_size != b.frame_size:
        # Of another depth or cut: a pixel's size or origin is another one, too.
        told = ", not ".join("{} x {}".format(*size) for size in (b.frame_size, a.frame_size))
        raise InputError(f"{where}: its frames have {told} px")
    for each, other in ((first, b), (second, a)):
        if other.frame_size and each.calibration.frame_size is None:
            try:
                held = each.calibration
                _check_inside(held.measurements, other.frame_size, held.mask)
            except InputError as error:
                raise InputError(f"{where}: {each.source}: {error}") from None
    if None not in (first.probe, second.probe) and first.probe != second.probe:
        raise InputError(f"{where}: their probes differ")
    frames = [each.pose_frames for each in (first, second)]
    if None not in frames and frames[0] != frames[1]:
        told = ", not ".join("from {} to {}".format(*pair) for pair in reversed(frames))  # pyright: ignore[reportOptionalIterable]
        raise InputError(f"{where}: its poses lead {told} (import with --from and --to)")

    def both(name: str) -> Any:
        values = getattr(a, name), getattr(b, name)
        return None if any(value is None for value in values) else np.concatenate(values)

    velocity = None
    if a.velocity is not None or b.velocity is not None:
        velocity = np.full((len(a) + len(b), 6), np.nan)
        for each, rows in ((a, slice(len(a))), (b, slice(len(a), None))):
            if each.velocity is not None:
                velocity[rows] = each.velocity
    return replace(
        first,
        calibration=replace(
            a,
            **{name: both(name) for name in ("poses", "measurements", "mask", *OF_SOME)},
            velocity=velocity,
            frame=None,
            frame_size=a.frame_size or b.frame_size,
        ),
        truth=None,
        probe=first.probe or second.probe,
        source=f"{first.source} with {second.source}",
        pose_frames=first.pose_frames or second.pose_frames,
    )


def shared_images(a: Images, b: Images) -> int:
    """How many used images of one set are in the other, too: of one pose and one measurement."""

    def told(images: Images) -> set[tuple[str, bytes]]:
        # Rotations that are read from a file are projected once more: their last digits differ.
        poses = images.poses.reshape(len(images), -1).round(6) + 0.0
        rows = np.column_stack([poses, images.measurements])
        return {(images.kind, row.tobytes()) for row in rows[images.mask]}

    return len(told(a) & told(b))


def check_recording(value: object, name: str) -> None:
    """Raise InputError, which names the function, if what a caller gave is no recording."""
    if not isinstance(value, Recording):
        raise InputError(
            f"{name} takes a recording (jaxcal.load reads one), not {type(value).__name__}"
        )


def images_of(value: object, name: str) -> Images:
    """Images that a caller gave, or the calibration images of a recording.

    Raises:
        InputError: something else; ``name`` is the function's.
    """
    if isinstance(value, Images):
        return value
    check_recording(value, name)
    assert isinstance(value, Recording)
    return value.calibration


def make_images(
    poses: np.ndarray,
    measurements: np.ndarray,
    kind: Kind = "point",
    *,
    mask: np.ndarray | None = None,
    covariance: np.ndarray | None = None,
    max_elevation: np.ndarray | float | None = None,
    amplitude: np.ndarray | None = None,
    time: np.ndarray | None = None,
    velocity: np.ndarray | None = None,
    spacing_mm: np.ndarray | tuple[float, float] | None = None,
    face_offset_mm: float = 0.0,
    time_of_flight: np.ndarray | None = None,
    frame: np.ndarray | None = None,
    frame_size: Sequence[int] | np.ndarray | None = None,
    minimum: int = MINIMUM_IMAGES,
    where: str = "",
) -> Images:
    """Check arrays and make one set of images of them.

    Args:
        poses: (n, 4, 4) probe -> tracker, mm.
        measurements: see :class:`Images`.
        kind: ``point``, ``pixel`` or ``time_of_flight``.
        mask: (n,) bool, True = used; images left out may hold anything.
        covariance: (n, 2, 2), symmetric positive definite.
        max_elevation: (n,) or one number, mm, not negative.
        amplitude: (n,).
        time: (n,) s.
        velocity: (n, 6) mm/s and rad/s, see :class:`Images`.
        spacing_mm: [lateral, axial] mm per px, pixels only.
        face_offset_mm: range of pixel row 0, or of a measured range of 0, mm; not with times.
        time_of_flight: (n, elements) s, points only: the times that they were segmented from.
        frame: (n,) numbers of the images' frames in the file that they came from.
        frame_size: (columns, rows) of the frames, px, pixels only.
        minimum: least number of used images (0 for a test set).
        where: prefix of error messages, e.g. a file's name.

    Returns:
        The checked set; values of images left out are replaced by harmless ones.

    Raises:
        InputError: with the array and row named.
    """
    prefix = f"{where}: " if where else ""
    if is_traced(poses, measurements, mask, covariance, max_elevation):
        raise InputError(
            f"{prefix}arrays are checked by their values, and these are traced by a jit, vmap or "
            "grad: make the problem outside, and change its arrays inside "
            "(dataclasses.replace(problem, measurements=...))"
        )
    try:
        check_kind(kind)
        poses, values = real_array(poses, "poses"), real_array(measurements, "measurements")
        count = len(poses) if poses.ndim else 0
        _check_shape(values, kind, count)
        used = _mask(mask, count)
        if not (is_number(minimum) and minimum >= 0):
            raise InputError(f"minimum must be a number of images, not {shown(minimum)}")
        check_enough(used, minimum)
        _check_magnitude("pose", poses, used)
        checked = check_poses(poses, used)
        values = used_values(kind, values, used)
        spacing, face_mm = check_spacing(spacing_mm, kind), _face_offset(face_offset_mm)
        if kind == "time_of_flight" and face_mm != 0:
            raise InputError("face_offset_mm belongs to points and pixels; times have the delay_s")
        size = _frame_size(frame_size, kind)
        if kind == "pixel":
            _check_below_face(values, spacing, face_mm, used)
        if size is not None:
            _check_inside(values, size, used)

        images = Images(
            poses=checked,
            measurements=values,
            kind=kind,
            mask=used,
            covariance=checked_covariance(covariance, count, used),
            max_elevation=checked_bound(max_elevation, count, used),
            amplitude=_per_image("amplitude", amplitude, count, used, fill=0.0),
            time=_per_image("time", time, count, used, fill=0.0),
            velocity=_velocity(velocity, count),
            spacing_mm=spacing,
            face_offset_mm=face_mm,
            time_of_flight=_raw_times(time_of_flight, kind, count, used),
            frame=_frame(frame, count),
            frame_size=size,
        )
        _check_units(images)
        return images
    except InputError as error:
        raise type(error)(f"{prefix}{error}") from None


def _check_shape(values: np.ndarray, kind: Kind, count: int) -> None:
    if values.ndim != 2:
        several = " (one problem at a time: jaxcal.stack makes a batch)" if values.ndim == 3 else ""
        raise InputError(f"{kind} must have two axes, it has shape {values.shape}{several}")
    if kind != "time_of_flight" and values.shape[1] != 2:
        raise InputError(f"{kind} must have shape (n, 2), it has {values.shape}")
    if len(values) != count:
        raise InputError(f"{count} poses but {len(values)} rows of {kind}: they must match")


def _refuse(name: str, bad: Any, what: str) -> None:
    """Refuse an array of which a row is bad, by (n,) bool; the first one is named."""
    rows = np.flatnonzero(bad)
    if len(rows):
        several = f" (the first of {len(rows)}, counted from 0)" if len(rows) > 1 else ""
        raise InputError(f"{name} {rows[0]}{several} {what}")


def used_values(
    kind: Kind, values: np.ndarray, used: np.ndarray
) -> Float[np.ndarray, "n components"]:
    """The measurements, checked in used images and replaced in the others.

    Args:
        kind: of the measurements.
        values: (n, 2) or (n, elements); changed in place.
        used: (n,) bool.

    Raises:
        InputError: NaN or Inf, numbers that no image has, or a place above the probe's face; the
            row is named.
    """
    if kind == "time_of_flight":
        values[~used] = np.nan
        # NaN is an element that saw nothing.
        _refuse(kind, np.isinf(values).any(axis=1), "holds NaN or Inf")
        return values
    values[~used] = 1.0
    lost = ~np.isfinite(values).all(axis=1)
    _refuse(kind, lost, "holds NaN or Inf: mask out images without the target")
    _check_magnitude(kind, values, used)
    if kind == "point":
        why = "has a range that is not positive: are lateral position and range exchanged?"
        _refuse(kind, values[:, 1] <= 0, why)
        return values
    above = np.flatnonzero(values[:, 1] < 0)
    if len(above):
        raise InputError(
            f"pixel {above[0]} has row v = {values[above[0], 1]:g}: rows count from the top of the "
            "image, where v = 0; are u and v exchanged, or counted from the image's middle, or "
            "does it mark an image without the target (leave that one out)?"
        )
    if used.sum() >= MINIMUM_IMAGES and np.abs(values[used]).max() < 1:
        raise InputError(
            "all u and v are below 1: if they are shares of the image's width and height, multiply "
            "them by its columns and rows"
        )
    return values


def check_kind(kind: object) -> None:
    """Refuse another kind of measurements than there are."""
    if kind not in get_args(Kind):
        known = ", ".join(f"{name} ({UNIT_OF[name]})" for name in get_args(Kind))
        raise InputError(f"kind must be one of {known}, not {shown(kind)}")


def check_spacing(spacing_mm: Any, kind: Kind) -> Float[np.ndarray, " 2"] | None:
    """[lateral, axial] mm/px as an array; only pixels have it."""
    if spacing_mm is None:
        return None
    spacing = real_array(spacing_mm, "spacing_mm")
    if spacing.shape != (2,) or not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise InputError("spacing_mm must be two positive numbers [lateral, axial] in mm/px")
    if kind != "pixel":
        raise InputError(f"spacing_mm belongs to pixels, not to {kind} data")
    return spacing


def _face_offset(face_offset_mm: Any) -> float:
    face = real_array(face_offset_mm, "face_offset_mm")
    if face.ndim or not np.isfinite(face):
        raise InputError("face_offset_mm must be finite, and one number")
    return float(face)


def _check_below_face(
    pixels: np.ndarray, spacing: np.ndarray | None, face_offset_mm: float, used: np.ndarray
) -> None:
    """Every used pixel lies below the transducer's face."""
    if spacing is None and face_offset_mm != 0:
        return
    # Without a spacing, any positive one will do: rows are not negative.
    along = 1.0 if spacing is None else spacing[1]
    _refuse(
        "pixel",
        (along * pixels[:, 1] + face_offset_mm <= 0) & used,
        "has a range that is not positive: its row lies at or above the transducer's face "
        "(face_offset_mm is the range of row 0); if it marks an image without the target, leave "
        "that one out",
    )


def _frame_size(
    frame_size: Sequence[int] | np.ndarray | None, kind: Kind
) -> tuple[int, int] | None:
    if frame_size is None:
        return None
    size = real_array(frame_size, "frame_size")
    if size.shape != (2,) or not ((size >= 1) & (size <= LARGEST) & (size % 1 == 0)).all():
        raise InputError("frame_size must be two whole numbers of px [columns, rows]")
    if kind != "pixel":
        raise InputError(f"frame_size belongs to pixels, not to {kind} data")
    return int(size[0]), int(size[1])


def _check_inside(pixels: np.ndarray, size: tuple[int, int], used: np.ndarray) -> None:
    """Every used pixel lies in the frame, or beside it by a pixel if they are counted from 1."""
    inside = ((pixels >= -1) & (pixels <= size)).all(axis=1)
    first = np.flatnonzero(used & ~inside)
    if len(first):
        u, v = pixels[first[0]]
        raise InputError(
            f"pixel {first[0]}, u = {u:g}, v = {v:g}, lies outside its frame of {size[0]} x "
            f"{size[1]} px: are u and v exchanged, or of an enlarged or a cut image?"
        )


def checked_bound(
    max_elevation: Any, count: int, used: np.ndarray
) -> Float[np.ndarray, " n"] | None:
    """Every image's bound on its offset, from one or from as many as there are images.

    Raises:
        InputError: what is no bound of a used image; the row is named.
    """
    if max_elevation is not None:
        max_elevation = real_array(max_elevation, "max_elevation")
        if max_elevation.ndim == 0:
            max_elevation = np.full(count, max_elevation)
    bound = _per_image("max_elevation", max_elevation, count, used, fill=1.0)
    if bound is not None:
        _refuse("max_elevation", bound < 0, "is negative")
    return bound


def _raw_times(
    times: np.ndarray | None, kind: Kind, count: int, used: np.ndarray
) -> Float[np.ndarray, "n elements"] | None:
    """Rows of images left out are kept, because another segmentation may use them."""
    if times is None:
        return None
    if kind != "point":
        raise InputError(f"time_of_flight beside the measurements belongs to points, not to {kind}")
    times = real_array(times, "time_of_flight")
    if times.ndim != 2 or len(times) != count:
        raise InputError(
            f"time_of_flight must have shape ({count}, elements), it has {times.shape}"
        )
    infinite = np.isinf(times)
    _refuse("time_of_flight", infinite.any(axis=1) & used, "holds Inf")
    times[infinite] = np.nan
    return times


def _check_magnitude(name: str, values: np.ndarray, used: np.ndarray) -> None:
    """Refuse numbers too large in any unit, before they overflow; NaN and Inf are checked later."""
    rows = np.abs(values.reshape(len(used), -1)) if len(used) else np.zeros((0, 1))
    _refuse(name, (np.isfinite(rows) & (rows > LARGEST)).any(axis=1) & used, _BEYOND)


def _mask(mask: np.ndarray | None, count: int) -> Bool[np.ndarray, " n"]:
    if mask is None:
        return np.ones(count, bool)
    mask = truth_array(mask, "mask")
    if mask.shape != (count,):
        raise InputError(f"mask must have shape ({count},), it has {mask.shape}")
    return mask


def _per_image(
    name: str, values: np.ndarray | None, count: int, used: np.ndarray, fill: float
) -> Float[np.ndarray, " n"] | None:
    if values is None:
        return None
    values = shaped_array(values, name, (count,))
    values[~used] = fill
    _refuse(name, ~np.isfinite(values), "is NaN or Inf")
    return values


def _velocity(values: np.ndarray | None, count: int) -> Float[np.ndarray, "n 6"] | None:
    if values is None:
        return None
    values = shaped_array(values, "velocity", (count, 6))
    _refuse("velocity", (np.abs(values) > LARGEST).any(axis=1), _BEYOND)
    return values


def _frame(values: np.ndarray | None, count: int) -> Int[np.ndarray, " n"] | None:
    if values is None:
        return None
    numbers = shaped_array(values, "frame", (count,))
    _refuse("frame", ~((numbers >= 0) & (numbers <= LARGEST_FRAME)), "is no number of a frame")
    _refuse("frame", numbers != np.round(numbers), "is no whole number")
    return numbers.astype(np.int64)


def checked_covariance(
    covariance: Any, count: int, used: np.ndarray
) -> Float[np.ndarray, "n 2 2"] | None:
    """The covariances, made exactly symmetric, and the identity for images left out.

    Raises:
        InputError: what is no covariance of a used image; the row is named.
    """
    if covariance is None:
        return None
    values = shaped_array(covariance, "covariance", (count, 2, 2))
    values[~used] = np.eye(2)
    _check_magnitude("covariance", values, used)
    _refuse("covariance", ~np.isfinite(values).all(axis=(1, 2)), "holds NaN or Inf")
    scale = np.abs(values).max(axis=(1, 2))
    bad = np.abs(values[:, 0, 1] - values[:, 1, 0]) > 1e-6 * scale
    symmetric = (values + values.swapaxes(1, 2)) / 2
    least = np.linalg.eigvalsh(symmetric)[:, 0]
    _refuse("covariance", bad | (least <= 1e-12 * scale), "is not symmetric and positive definite")
    _refuse("covariance", least < LEAST_SD**2, f"has an SD below {LEAST_SD:g}: is its unit right?")
    return symmetric


def _check_units(images: Images) -> None:
    """Refuse metres in place of millimetres, but only numbers that no real set-up gives."""
    used = images.mask
    if not used.any():
        return
    translations = images.poses[used, :3, 3]
    spread = _spread(translations)
    if images.kind == "point":
        extent = float(np.abs(images.measurements[used]).max())
        if extent < 0.5 and spread > 1.0:
            raise InputError(
                f"points reach only {extent:.3g} mm while the poses move by {spread:.3g} mm: "
                "the points look like metres; give them in mm"
            )
        if extent < 0.5:
            raise InputError(
                f"points reach only {extent:.3g} mm from the image's origin: points and poses look "
                "like metres; give both in mm"
            )
    elif images.kind == "pixel":
        if images.spacing_mm is not None:
            check_spacing_unit(images.spacing_mm)
        spacing = 0.1 if images.spacing_mm is None else float(images.spacing_mm.max())
        extent = float(np.ptp(images.measurements[used], axis=0).max()) * spacing
    else:
        extent = _EXTENT_MM
    check_pose_units(translations, extent)


def check_spacing_unit(spacing_mm: Float[np.ndarray, " 2"]) -> None:
    """Refuse a pixel's size [lateral, axial] that cannot be in millimetres.

    Raises:
        InputError: it is far too large, or looks like metres.
    """
    if not spacing_mm.max() <= LARGEST_PIXEL_MM:
        raise InputError(
            f"the spacing is {spacing_mm.max():.3g} mm per pixel, and no ultrasound image's is "
            f"over {LARGEST_PIXEL_MM:g} mm: give it in mm"
        )
    if spacing_mm.min() < 1e-3:
        raise InputError(
            f"the spacing is only {spacing_mm.min():.3g} mm per pixel: it looks like metres; give "
            "it, and the poses, in mm"
        )


def check_pose_units(translations: Float[np.ndarray, "n 3"], extent_mm: float = _EXTENT_MM) -> None:
    """Refuse poses of different images whose translations are in metres in place of millimetres.

    A probe whose every position lies within 5 mm of the tracker's origin, and whose moves are
    hundreds of times smaller than the target's path through the image (roughly ``extent_mm``), was
    recorded in metres.

    Raises:
        MetresError: they look like metres.
    """
    spread = _spread(translations)
    reach = float(np.linalg.norm(translations, axis=1).max())
    # A probe that does not move has no unit; what is left of its moves is rounding.
    if _AT_REST_MM < spread < 0.02 * extent_mm and reach < LEAST_REACH_MM:
        raise MetresError(
            f"pose translations reach only {reach:.3g} mm while the target moves over about "
            f"{extent_mm:.0f} mm of the image: the poses look like metres; give them in mm"
        )


def _spread(translations: Float[np.ndarray, "n 3"]) -> float:
    """Largest distance from the mean."""
    return float(np.linalg.norm(translations - translations.mean(axis=0), axis=1).max())
