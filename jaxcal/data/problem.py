"""The arrays that a solver takes. From here on everything is pure, batched and differentiable.

Every array of a :class:`Problem` is floating, the mask included, so that ``jax.grad`` takes a whole
problem as its argument. Fields that are not arrays, such as ``pixels``, are static. A batch is the
same class with leading axes on every array.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import DTypeLike

from jaxcal import InputError
from jaxcal.data.poses import check_poses
from jaxcal.data.probe import CurvilinearProbe
from jaxcal.data.recording import (
    MINIMUM_IMAGES,
    Images,
    Kind,
    Recording,
    checked_bound,
    checked_covariance,
    images_of,
    make_images,
)
from jaxcal.data.sound import SCANNER_M_S, WATER_M_S, check_sound_speed
from jaxcal.runtime.array_types import AnyArray, Float, HeldArray
from jaxcal.runtime.arrays import (
    array_module,
    array_tree,
    each_image,
    has_values,
    is_traced,
    jax_in_use,
    map_arrays,
    outline,
    static,
)
from jaxcal.runtime.given_values import check_enough, refuse_masked
from jaxcal.runtime.jax_modes import importing_jax, in_own_modes
from jaxcal.runtime.messages import shown
from jaxcal.runtime.one_or_batch import OneOrBatch

_ROUNDING = 1e-4
"""Rotations in 32 bits are orthogonal to this."""


def _make_floating(tree: Channels | Problem) -> None:
    """Booleans and whole numbers become floats: a mask given to dataclasses.replace, say."""
    for name, value in vars(tree).items():
        refuse_masked(value, name)
        if getattr(getattr(value, "dtype", None), "kind", "") in ("b", "i", "u"):
            object.__setattr__(tree, name, value.astype(float))


@array_tree
class Channels:
    """The distances that every element measured, for solvers that use times of flight directly.

    Attributes:
        distances: one-way distances at the nominal sound speed and delay, mm; any value where an
            element did not hear.
        heard: 1 where an element's time of flight is used, 0 where it is missing or rejected.
        elements: positions in the image frame [lateral, elevational, axial], mm.
    """

    distances: Float[HeldArray, "*batch n elements"]
    heard: Float[HeldArray, "*batch n elements"]
    elements: Float[HeldArray, "*batch elements 3"]

    def __post_init__(self) -> None:
        _make_floating(self)


@array_tree
class Problem(OneOrBatch):
    """Tracked measurements of one target in n images; ``*batch`` may be empty.

    A batch has a length, and parts: ``problems[0]`` is its first problem, ``problems[:10]`` a
    smaller batch.

    Arrays are JAX's where JAX is imported, and otherwise numpy's, which JAX takes as well.

    Attributes:
        poses: probe -> tracker, mm.
        measurements: [lateral, range] in mm, or [u, v] in px when ``pixels``.
        mask: 1 where the image is used, 0 where it is left out (its values are then ignored). No
            derivative is taken by the mask: it is zero.
        spacing: [lateral, axial] mm per px (1 for points in mm); where pixels come without a known
            spacing it only sets the unit of the estimated scale.
        face_offset: range of pixel row 0, mm.
        covariance: of the measurements, in their unit squared, or None. The joint solver uses its
            *shape* across images and axes, and scales it by its sigmas.
        max_elevation: bound on |elevational offset| of each image, mm, or None.
        sound_speed: nominal, with which times of flight were converted to distances, m/s.
        delay: nominal delay of the electronics, already subtracted from the times of flight, s.
        channels: the distances of every element, or None.
        pixels: whether the measurements are pixels (static).
        spacing_known: whether ``spacing`` was given (static); if not, the scale must be estimated.
        curved: whether the elements lie on an arc (static). If so, only the channels tell lateral
            position, range and elevational offset apart without bias.
    """

    poses: Float[HeldArray, "*batch n 4 4"]
    measurements: Float[HeldArray, "*batch n 2"]
    mask: Float[HeldArray, "*batch n"]
    spacing: Float[HeldArray, "*batch 2"]
    face_offset: Float[HeldArray, "*batch"]
    covariance: Float[HeldArray, "*batch n 2 2"] | None = None
    max_elevation: Float[HeldArray, "*batch n"] | None = None
    sound_speed: Float[HeldArray, "*batch"] | None = None
    delay: Float[HeldArray, "*batch"] | None = None
    channels: Channels | None = None
    pixels: bool = static(default=False)
    spacing_known: bool = static(default=True)
    curved: bool = static(default=False)

    _one: ClassVar[str] = "one problem"

    def __post_init__(self) -> None:
        _make_floating(self)

    def __repr__(self) -> str:
        """Number and unit of the images, and what is known of them; not the arrays."""
        if not has_values(self.mask, self.spacing):
            return outline(self)
        count = f"{np.count_nonzero(np.asarray(self.mask) > 0)} used of {self.images} images"
        unit = "pixels" if self.pixels else "points in mm"
        if self.batch_shape:
            count = f"batch of {' x '.join(map(str, self.batch_shape))}, {self.images} images each"
        elif self.pixels and self.spacing_known:
            unit = "pixels of {:.4g} x {:.4g} mm".format(*self.spacing.tolist())
        optional = ("covariance", "max_elevation", "sound_speed", "delay", "channels")
        known = ", ".join(name for name in optional if getattr(self, name) is not None)
        return f"Problem({count}, {unit}{known and f', with {known}'})"

    @property
    def images(self) -> int:
        """Number of images, those left out included."""
        return self.mask.shape[-1]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes; () for one problem."""
        return self.mask.shape[:-1]

    @property
    def nominal_sound_speed(self) -> Float[HeldArray, "*batch"]:
        """The speed by which times became ranges, m/s; a scanner's or water's where unknown."""
        if self.sound_speed is None:
            xp, assumed = array_module(self.mask), SCANNER_M_S if self.pixels else WATER_M_S
            return xp.full(self.batch_shape, assumed, self.mask.dtype)
        return self.sound_speed

    def cleared(self, used: Float[AnyArray, "*batch n"]) -> Problem:
        """The problem with harmless values in images that are not used: NaN times 0 is NaN, not 0.

        So are the distances of elements that received nothing. The mask and all shapes stay as they
        are.

        Args:
            used: 0 for images whose values are not to be read.
        """
        xp = array_module(self, used)

        def keep(values: Any, instead: np.ndarray | float) -> Any:
            shape = used.shape + (1,) * (values.ndim - used.ndim)
            return xp.where(used.reshape(shape) > 0, values, xp.asarray(instead, values.dtype))

        channels = self.channels
        if channels is not None:
            heard = keep(channels.heard, 0.0)
            distances = xp.where(heard > 0, channels.distances, xp.zeros_like(channels.distances))
            channels = Channels(distances, heard, channels.elements)
        return replace(
            self,
            poses=keep(self.poses, np.eye(4)),
            measurements=keep(self.measurements, 1.0),
            covariance=None if self.covariance is None else keep(self.covariance, np.eye(2)),
            max_elevation=None if self.max_elevation is None else keep(self.max_elevation, 1.0),
            channels=channels,
        )

    def points_only(self) -> Problem:
        """The problem without channels, covariances, bounds, sound speed and delay."""
        left_out = ("channels", "covariance", "max_elevation", "sound_speed", "delay")
        return replace(self, **dict.fromkeys(left_out))

    @classmethod
    def from_recording(
        cls, recording: Recording | Images, dtype: DTypeLike | None = None
    ) -> Problem:
        """The calibration images of a recording as arrays; times of flight are segmented first.

        Args:
            recording: a :class:`Recording`, or one set of :class:`Images`.
            dtype: float64 by default.

        Raises:
            InputError: for times of flight that cannot be segmented, or come without a probe, and
                for a dtype that is not floating.
        """
        return cls.segmented(recording, dtype)[0]

    @classmethod
    @in_own_modes
    def segmented(
        cls, recording: Recording | Images, dtype: DTypeLike | None = None
    ) -> tuple[Problem, tuple[str, ...]]:
        """As :meth:`from_recording`, with what a person should know of the segmentation.

        Returns:
            The problem, and warnings; none if the recording holds points.
        """
        probe = recording.probe if isinstance(recording, Recording) else None
        images = images_of(recording, "jaxcal.Problem.from_recording")
        dtype = _floating(dtype)

        # device_put, since JAX would compile jax.numpy.asarray of a number.
        jax = jax_in_use()
        put: Any = jax.device_put if jax is not None else lambda array: array

        def array(values: np.ndarray | float | None) -> Any:
            # A copy: JAX's array would otherwise share the memory of the recording's.
            return None if values is None else put(np.array(values, dtype=dtype))

        channels, warnings = None, ()
        raw = images.measurements if images.kind == "time_of_flight" else images.time_of_flight
        if raw is not None and (probe is not None or images.kind == "time_of_flight"):
            from jaxcal.data.segmentation.segment import segment

            found = segment(recording)
            if images.kind == "time_of_flight":
                images, warnings = found.images, found.warnings
            assert probe is not None
            accepted = found.accepted & images.mask[:, None]
            distances = np.where(accepted, probe.one_way_range_mm(raw), 0.0)
            channels = Channels(
                array(distances), array(accepted.astype(float)), array(probe.element_positions())
            )
        pixels, spacing = images.kind == "pixel", images.spacing_mm
        problem = cls(
            poses=array(images.poses),
            measurements=array(images.measurements),
            mask=array(images.mask.astype(float)),
            spacing=array(np.ones(2) if spacing is None else spacing),
            face_offset=array(images.face_offset_mm),
            covariance=array(images.covariance),
            max_elevation=array(images.max_elevation),
            sound_speed=None if probe is None else array(probe.sound_speed_m_s),
            delay=None if probe is None else array(probe.delay_s),
            channels=channels,
            pixels=pixels,
            spacing_known=not pixels or spacing is not None,
            curved=isinstance(probe, CurvilinearProbe),
        )
        return problem, warnings

    @classmethod
    def from_arrays(
        cls,
        poses: np.ndarray,
        measurements: np.ndarray,
        *,
        kind: Kind = "point",
        mask: np.ndarray | None = None,
        covariance: np.ndarray | None = None,
        max_elevation: np.ndarray | float | None = None,
        spacing_mm: np.ndarray | tuple[float, float] | None = None,
        face_offset_mm: float = 0.0,
        dtype: DTypeLike | None = None,
    ) -> Problem:
        """One checked problem from numpy arrays in memory; units as in :class:`Images`.

        Args:
            poses: (n, 4, 4) probe -> tracker, mm.
            measurements: (n, 2) [lateral, range] mm, or [u, v] px with ``kind="pixel"``.
            kind: ``point`` or ``pixel``.
            mask: (n,) bool, True = used.
            covariance: (n, 2, 2).
            max_elevation: (n,) or one number, mm.
            spacing_mm: [lateral, axial] mm/px; without it a pixel problem estimates its scale.
            face_offset_mm: range of pixel row 0, or of a measured range of 0, mm.
            dtype: float64 by default.

        Raises:
            InputError: arrays that cannot be a calibration problem; the row is named.
        """
        if kind == "time_of_flight":
            raise InputError(
                "from_arrays takes points and pixels; times of flight need a recording with its "
                "probe: jaxcal.Recording(jaxcal.make_images(...), probe=...)"
            )
        images = make_images(
            poses,
            measurements,
            kind,
            mask=mask,
            covariance=covariance,
            max_elevation=max_elevation,
            spacing_mm=spacing_mm,
            face_offset_mm=face_offset_mm,
        )
        return cls.from_recording(images, dtype=dtype)


def _floating(dtype: DTypeLike | None) -> np.dtype:
    try:
        found = np.dtype(np.float64 if dtype is None else dtype)
    except TypeError:
        found = np.dtype(object)
    # bfloat16 and its like are of numpy's kind V; JAX has nothing longer than 64 bits.
    if found.kind not in "fV" or found.itemsize > 8:
        raise InputError(f"dtype must be a floating one, e.g. numpy.float32, not {shown(dtype)}")
    return found.newbyteorder("=")


def taken(problem: Problem, rows: list[int]) -> Problem:
    """Some images of one problem, in numpy arrays; an image may be taken several times."""
    return each_image(problem, lambda values, axis: np.take(np.asarray(values), rows, axis))


@importing_jax
@in_own_modes
def stack(problems: list[Problem]) -> Problem:
    """Stack problems of the same structure into a batch with one leading axis.

    Args:
        problems: at least one; none of them is a batch.

    Returns:
        One problem, whose arrays have the problems as their first axis. All have as many images as
        the longest; images added to a shorter one come last and are masked out.

    Raises:
        InputError: none at all, something else than single problems, arrays that do not go
            together, or where the problems differ in what they hold.
    """
    import jax
    import jax.numpy as jnp

    if not isinstance(problems, list | tuple) or not problems:
        raise InputError("stack takes a list of at least one problem")
    for index, problem in enumerate(problems):
        if not isinstance(problem, Problem):
            raise InputError(f"stack takes problems, {index} is {type(problem).__name__}")
        check_shapes(problem)
        if problem.batch_shape:
            raise InputError(f"stack takes single problems, {index} is a batch")
    first = problems[0]
    for index, problem in enumerate(problems):
        if jax.tree.structure(problem) != jax.tree.structure(first):
            unlike = [
                name
                for name, value in vars(problem).items()
                if jax.tree.structure(value) != jax.tree.structure(getattr(first, name))
                or (isinstance(value, bool) and value != getattr(first, name))
            ]
            raise InputError(
                f"problem {index} and problem 0 do not hold the same: {', '.join(unlike)}; give "
                "these to both, or to neither"
            )

    most = max(problem.images for problem in problems)

    def stacked(*leaves: Any) -> Any:
        if is_traced(*leaves):
            return jnp.stack(leaves)
        # By numpy: jax.numpy.stack of thousands of arrays takes minutes to compile.
        # A batch committed to one device would not be divided among all of them.
        kept = [leaf.sharding for leaf in leaves if isinstance(leaf, jax.Array) and leaf.committed]
        return jax.device_put(np.stack(leaves), *kept[:1])

    return jax.tree.map(stacked, *(lengthened(problem, most) for problem in problems))


def lengthened(problem: Problem, images: int) -> Problem:
    """A problem or batch with so many images; those added repeat the last one and are masked out.

    Concrete ones that are lengthened come back in numpy arrays.
    """
    count = problem.images
    if count in (0, images):
        return problem
    if not is_traced(problem):
        problem = map_arrays(np.asarray, problem)  # JAX would compile a program for every size
    rows = np.minimum(np.arange(images), count - 1)
    longer = each_image(problem, lambda values, axis: values.take(rows, axis))
    added = np.arange(images) >= count
    return replace(longer, mask=longer.mask * (~added).astype(longer.mask.dtype))


def as_problem(value: Any, name: str, *, channels: bool = True) -> Problem:
    """The problem that a caller gave; recordings and images are converted.

    Args:
        value: a problem, a recording or one set of images.
        name: of the function that was called, for messages.
        channels: False if points are enough: times of flight beside points are not read.

    Raises:
        InputError: anything else, with what to do.
    """
    if isinstance(value, Problem):
        return value
    if not channels and isinstance(value, Recording):
        value = value if value.calibration.kind == "time_of_flight" else value.calibration
    if isinstance(value, Recording | Images):
        return Problem.from_recording(value)
    if isinstance(value, str | os.PathLike):
        raise InputError(
            f"{name} takes a problem, not a path: {name}(jaxcal.load({os.fspath(value)!r})), or "
            "import the file first (jaxcal import)"
        )
    problems = (Problem, Recording, Images)
    if isinstance(value, list | tuple) and value and all(isinstance(v, problems) for v in value):
        raise InputError(
            f"{name} takes one problem, not {len(value)}: jaxcal.calibrate_batch takes a list"
        )
    kind = "a dictionary" if isinstance(value, dict) else type(value).__name__
    raise InputError(
        f"{name} takes a problem or a recording, not {kind}: jaxcal.Problem.from_arrays(poses, "
        "measurements) makes one of arrays, jaxcal.load(path) reads a recording"
    )


def as_batch(value: Any, name: str, *, channels: bool = True) -> Problem:
    """The batch of problems that a caller gave; a list of problems or recordings is stacked.

    Arguments are those of :func:`as_problem`.

    Raises:
        InputError: anything else, or problems that differ in what they hold.
    """
    if isinstance(value, list | tuple):
        if not value:
            raise InputError(f"{name} takes at least one problem; the list is empty")
        return stack([as_problem(each, name, channels=channels) for each in value])
    return as_problem(value, name, channels=channels)


def check_shapes(problem: Problem) -> None:
    """Refuse arrays that do not go together, as ``dataclasses.replace`` may leave a problem.

    Raises:
        InputError: what is no array of real numbers, or has another shape than the mask asks for;
            no images.
    """
    shape = tuple(np.shape(problem.mask))
    batch = shape[:-1]
    if not shape:
        raise InputError("mask of the problem must have an axis for the images")
    if not shape[-1]:
        raise InputError(f"the problem holds no images: at least {MINIMUM_IMAGES} are needed")
    channels = problem.channels
    if not isinstance(channels, Channels | None):
        raise InputError(f"channels of the problem must be Channels, not {shown(channels)}")
    elements = () if channels is None else np.shape(channels.distances)[-1:]
    for holder, name, wanted, optional in (
        (problem, "mask", shape, False),
        (problem, "poses", (*shape, 4, 4), False),
        (problem, "measurements", (*shape, 2), False),
        (problem, "spacing", (*batch, 2), False),
        (problem, "face_offset", batch, False),
        (problem, "covariance", (*shape, 2, 2), True),
        (problem, "max_elevation", shape, True),
        (problem, "sound_speed", batch, True),
        (problem, "delay", batch, True),
        (channels, "distances", (*shape, *elements), False),
        (channels, "heard", (*shape, *elements), False),
        (channels, "elements", (*batch, *elements, 3), False),
    ):
        value = getattr(holder, name, None)
        if holder is None or (value is None and optional):
            continue
        kind = getattr(getattr(value, "dtype", None), "kind", "")
        # bfloat16 and its like are of numpy's kind V.
        if value is None or kind not in ("f", "V"):
            raise InputError(f"{name} of the problem must be an array of real numbers")
        if np.shape(value) != wanted:
            raise InputError(
                f"{name} of the problem must have shape {wanted}, not {np.shape(value)}"
            )


def _are_rigid(poses: Float[np.ndarray, "n 4 4"]) -> bool:
    """Whether poses are rigid but for rounding, as all are that were not put in by ``replace``."""
    turns = poses[:, :3, :3]
    away = np.abs(turns @ np.swapaxes(turns, 1, 2) - np.eye(3))
    last = (poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all() and np.isfinite(poses).all()
    return bool(last and (away < _ROUNDING).all() and (np.linalg.det(turns) > 0).all())


def check_values(problem: Problem) -> None:
    """Refuse NaN, Inf and too few images, if the values are concrete.

    Raises:
        InputError: a mask of other numbers than 0 and 1, NaN or Inf, or what is no pose, no
            covariance or no bound, with the number of the image; too few images; no size of pixels,
            no sound speed.
    """
    if is_traced(problem):
        return
    mask = np.asarray(problem.mask)
    if not np.isin(mask, (0, 1)).all():
        raise InputError("mask of the problem must hold 1 (used) or 0 (left out) for every image")
    used = mask > 0
    check_enough(used, MINIMUM_IMAGES)
    poses = np.asarray(problem.poses)
    if not _are_rigid(poses[used]):
        check_poses(poses, used)  # says which is not, and why
    bad = ~np.isfinite(np.asarray(problem.measurements)).all(axis=1) & used
    if bad.any():
        raise InputError(f"measurements of image {np.flatnonzero(bad)[0]} hold NaN or Inf")
    spacing = np.asarray(problem.spacing)
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise InputError(f"spacing of the problem must be two positive numbers, not {spacing}")
    for name in ("face_offset", "delay"):
        value = getattr(problem, name)
        if value is not None and not np.isfinite(np.asarray(value)):
            raise InputError(f"{name} of the problem must be finite")
    if problem.sound_speed is not None and np.asarray(problem.sound_speed) != WATER_M_S:
        check_sound_speed(float(np.asarray(problem.sound_speed)))
    if problem.covariance is not None:
        checked_covariance(problem.covariance, len(used), used)
    if problem.max_elevation is not None:
        checked_bound(problem.max_elevation, len(used), used)
    channels = problem.channels
    if channels is not None:
        if np.asarray(problem.face_offset) != 0:
            raise InputError(
                "face_offset_mm does not go with times of flight, which count from the elements: "
                "correct their delay_s, or leave the times out"
            )
        heard = used[:, None] & (np.asarray(channels.heard) > 0)
        bad = (heard & ~np.isfinite(np.asarray(channels.distances))).any(axis=1)
        if bad.any():
            raise InputError(f"distances of image {np.flatnonzero(bad)[0]} hold NaN or Inf")
