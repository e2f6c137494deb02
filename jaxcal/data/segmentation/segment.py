"""Points from times of flight: checks, the fit, and what became of every frame.

A frame without enough answers is left out and counted; it is not an error. Numbers that cannot be
times of flight in seconds are refused, and their row is named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxcal import InputError
from jaxcal.data.names import NoiseScale, SegmentationMethod
from jaxcal.data.probe import MOST_ELEMENTS, CurvilinearProbe, Probe, check_probe
from jaxcal.data.recording import (
    LARGEST,
    MINIMUM_IMAGES,
    Images,
    Recording,
    check_recording,
    images_of,
    make_images,
)
from jaxcal.data.segmentation.time_of_flight import (
    DistanceFit,
    fit_in_plane,
    fit_out_of_plane,
    shortest,
)
from jaxcal.runtime import executables
from jaxcal.runtime.array_types import AnyArray
from jaxcal.runtime.arrays import outline
from jaxcal.runtime.compiler import ONE_PROBLEM, batch_flags, fast_to_run
from jaxcal.runtime.given_values import check_flag, is_number, whole_number
from jaxcal.runtime.jax_modes import in_own_modes
from jaxcal.runtime.messages import counted, runs_in_words, shown

MINIMUM_LINES = 8
"""With fewer answers a frame's noise cannot be estimated and an outlier cannot be seen."""

# Least squares have two or three unknowns and a noise.
_FEWEST_LINES: dict[SegmentationMethod, int] = {"least-squares": 4, "shortest": 1}
_LONGEST_S = 2e-3
# |elevation| is determined where its square lies this many SDs above zero.
_SIGNIFICANT = 3.0
# In a frame this many times as noisy as the median frame, the fit found something else.
_NOISIEST = 5.0
_MANY = 0.1
# An answer this many SDs from the fit is not the target's.
_FAR = 6.0
# Receivers and waves have less noise; elements in another order or of another pitch give more.
_NOISY_MM = 3.0
# Squares of offsets, mm^2, are not negative (with room for delays of the elements),
# nor larger than those of a beam 20 mm thick. With smaller offsets, noise takes half of the frames
# beyond a limit at most; more by so many SDs of that number are a warning.
_SQUARES, _SURE = (-25.0, 100.0), 4.0
# A clock's ties are at most about as many at the longest time as at the next shorter one.
_TIES = 4
# Up to this many frames, compiling takes longer than the fit.
_FEW_FRAMES = 4096


Fits = DistanceFit | tuple[DistanceFit, DistanceFit]
"""The fit of a linear array, or the in-plane and out-of-plane fits of a curved one."""


@dataclass(frozen=True, eq=False)
class OutOfPlane:
    """The elevation from a curved array's distances (Eq. 6), without its sign.

    Attributes:
        position: (n, 3) [lateral, axial, elevation squared], mm, mm, mm^2; the square may come out
            negative: then noise hides the elevation. NaN for frames left out.
        covariance: (n, 3, 3). It is that of the linearised problem: the well-determined
            combination is lateral^2 + axial^2 + elevation squared, so that large errors of axial
            and of the square lie on a parabola rather than on the covariance's long axis.
        elevation: (n,) |elevational|, mm, the root of the square, or 0 where that is negative.
        elevation_sd: (n,) by the delta method, sd(y^2) / (2 |y|), mm; NaN where not determined.
        determined: (n,) whether the square is significantly (3 SD) above zero.
    """

    position: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    elevation: Float[np.ndarray, " n"]
    elevation_sd: Float[np.ndarray, " n"]
    determined: Bool[np.ndarray, " n"]

    __repr__ = outline


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Segmented points, and the outcome for every frame.

    Attributes:
        images: of kind ``point``, with a covariance for each frame (none with ``shortest``, which
            does not estimate the noise), and with the raw times. Frames that could not be segmented
            are masked out.
        method: ``least-squares`` or ``shortest``.
        lines: (n,) elements that answered.
        missing: (n,) elements that did not.
        rejected: (n,) elements whose answer was given no weight.
        failed: (n,) frames that were used before and were masked out here.
        accepted: (n, elements) answers in frames not masked out; after a robust fit, those near it.
        noise_mm: (n,) SD of one distance from the residuals, mm; NaN where there is none.
        out_of_plane: curved arrays by least squares only.
        warnings: for a person.
    """

    images: Images
    method: SegmentationMethod
    lines: Int[np.ndarray, " n"]
    missing: Int[np.ndarray, " n"]
    rejected: Int[np.ndarray, " n"]
    failed: Bool[np.ndarray, " n"]
    accepted: Bool[np.ndarray, "n elements"]
    noise_mm: Float[np.ndarray, " n"]
    out_of_plane: OutOfPlane | None = None
    warnings: tuple[str, ...] = ()

    __repr__ = outline


@in_own_modes
def segment(
    data: Recording | Images,
    probe: Probe | None = None,
    *,
    method: SegmentationMethod = "least-squares",
    robust: bool = True,
    scale: NoiseScale = "frame",
    interpolate: bool = False,
    minimum_lines: int | None = None,
    minimum_amplitude: float | None = None,
) -> Segmentation:
    """Segment the target in every frame of times of flight.

    No answer is NaN, or 0. If more than 8 elements have exactly the longest time of their frame,
    and more than four times as many as have the next shorter one, it is taken for the end of the
    receiver's window, and they for elements without an answer.

    Points of a curved array come from the in-plane fit, which is what an image would show. The
    array's own estimate of the elevation is so uncertain (y^2 has an SD of hundreds of mm^2 for a
    mm of noise) that points corrected by it would be several times worse. That estimate is in
    ``out_of_plane``, without a sign.

    Args:
        data: times of flight, or points with their times of flight; of a recording, the
            calibration images are taken.
        probe: the transducer; by default the recording's.
        method: ``least-squares`` on every element (Eqs. 5 and 6) or ``shortest`` (Eqs. 2 and 3).
        robust: bisquare weights against lines that are not the target's echo (up to a fifth of a
            frame's lines are certainly detected). Frames that are 5 times as noisy as the median
            frame are left out: more of their lines are wrong, and the fit found something else.
        scale: noise of each ``frame`` by itself, or ``pooled``: the median over the frames, better
            where all are alike and few lines answer.
        interpolate: between elements, for ``shortest``.
        minimum_lines: frames with fewer answers are left out; by default 8, and 1 with
            ``shortest``. Least squares need at least 4.
        minimum_amplitude: frames with less are left out; data without amplitudes are refused then.

    Raises:
        InputError: no times of flight, no probe, times for another number of elements, negative
            times, another unit than seconds, options of another kind or of the other method; for a
            recording, fewer than 4 frames that can be segmented.
    """
    images = images_of(data, "jaxcal.segment")
    probe = data.probe if probe is None and isinstance(data, Recording) else probe
    floor = _fewest_lines(method, robust, scale, interpolate, minimum_lines)
    if minimum_amplitude is not None and not is_number(minimum_amplitude):
        raise InputError(f"minimum_amplitude must be one number, not {shown(minimum_amplitude)}")
    times = images.measurements if images.kind == "time_of_flight" else images.time_of_flight
    if times is None:
        raise InputError(f"there are no times of flight to segment, only {images.kind}s")
    if probe is None:
        raise InputError(
            "times of flight need a probe to be segmented: the recording has no /probe"
        )
    check_probe(probe)
    used = images.mask
    check_times_of_flight(times, probe, used)
    cut = used[:, None] & _end_of_window(times)
    answered = used[:, None] & ~cut & (times > 0)
    distances = np.where(answered, probe.one_way_range_mm(times), np.nan)
    accepted = np.isfinite(distances) & (distances > 0)
    lines = accepted.sum(axis=1)

    failed = used & (lines < floor)
    if minimum_amplitude is not None:
        if images.amplitude is None:
            raise InputError("minimum_amplitude was given, but these images have no amplitudes")
        failed |= used & (images.amplitude < minimum_amplitude)

    out_of_plane = None
    if method == "shortest":
        line, least = shortest(distances, pitch_mm=probe.pitch_mm if interpolate else None)
        points = probe.image_to_cartesian(np.asarray(line), np.asarray(least))
        covariance, noise = None, np.full(len(points), np.nan)
        rejected = np.zeros(len(points), int)
    else:
        points, covariance, noise, rejected, full = _fit(distances, probe, robust, scale, failed)
        failed |= used & (2 * rejected > lines)
        if robust:
            accepted &= _near(distances, probe, points if full is None else full[0], noise)
        with np.errstate(invalid="ignore"):
            good = (np.abs(covariance) <= LARGEST).all(axis=(1, 2))
        failed |= used & ~good
        if robust and (used & ~failed).any():
            typical = max(float(np.median(noise[used & ~failed])), 1e-3)
            failed |= used & (noise > _NOISIEST * typical)
        if full is not None:
            out_of_plane = _out_of_plane(*full, used & ~failed)
    with np.errstate(invalid="ignore"):
        failed |= used & ~(np.isfinite(points).all(axis=1) & (points[:, 1] > 0))
    mask = used & ~failed
    if isinstance(data, Recording) and mask.sum() < MINIMUM_IMAGES:
        raise InputError(
            f"only {int(mask.sum())} of {int(used.sum())} frames of times of flight could be "
            f"segmented: at least {MINIMUM_IMAGES} are needed; if they hold answers, check the "
            "probe's pitch, sound speed and delay"
        )
    segmented = make_images(
        images.poses,
        points,
        "point",
        mask=mask,
        covariance=covariance,
        max_elevation=images.max_elevation,
        amplitude=images.amplitude,
        time=images.time,
        velocity=images.velocity,
        time_of_flight=times,
        frame=images.frame,
        minimum=0,
    )
    missing = np.where(used, probe.elements - lines, 0)
    rejected = np.where(mask, rejected, 0)
    return Segmentation(
        images=segmented,
        method=method,
        lines=lines,
        missing=missing,
        rejected=rejected,
        failed=failed,
        accepted=accepted & mask[:, None],
        noise_mm=np.where(mask, noise, np.nan),
        out_of_plane=out_of_plane,
        warnings=(
            *_warnings(used, failed, missing, rejected, cut, noise[mask], probe.elements),
            *_impossible_offsets(out_of_plane),
        ),
    )


def _fewest_lines(
    method: SegmentationMethod,
    robust: bool,
    scale: NoiseScale,
    interpolate: bool,
    asked: int | None,
) -> int:
    """How many answers a frame needs; refuses options that contradict each other."""
    for name, value, names in (
        ("method", method, SegmentationMethod),
        ("scale", scale, NoiseScale),
    ):
        if not (isinstance(value, str) and value in get_args(names)):
            raise InputError(f"{name} must be {' or '.join(get_args(names))}, not {shown(value)}")
    check_flag("robust", robust)
    check_flag("interpolate", interpolate)
    if interpolate and method != "shortest":
        raise InputError("interpolate needs the method shortest")
    if scale != "frame" and method != "least-squares":
        raise InputError("scale needs the method least-squares")
    if asked is None:
        return MINIMUM_LINES if method == "least-squares" else _FEWEST_LINES[method]
    return max(_FEWEST_LINES[method], whole_number("minimum_lines", asked, 1, MOST_ELEMENTS))


def segment_recording(
    recording: Recording, probe: Probe | None = None, **options: Any
) -> tuple[Recording, Segmentation]:
    """Segment a recording's calibration images, and its test images where they are raw.

    Args:
        recording: with times of flight.
        probe: instead of the recording's.
        options: of :func:`segment`.

    Returns:
        The recording with points instead of times (the times are kept beside them; without test
        images if none of them could be segmented), and what became of the calibration frames, with
        warnings about the test images as well.

    Raises:
        InputError: as :func:`segment`.
    """
    check_recording(recording, "jaxcal.segment_recording")
    probe = recording.probe if probe is None else probe
    found = segment(recording, probe, **options)
    test = recording.test
    if test is not None and test.kind == "time_of_flight":
        try:
            tested = segment(test, probe, **options)
        except InputError as error:
            raise type(error)(f"test images: {error}") from None
        told = [f"test images: {text}" for text in tested.warnings]
        test = tested.images
        if not test.mask.any():
            told = [f"none of the {len(test)} test images could be segmented: there is no test set"]
            test = None
        found = replace(found, warnings=(*found.warnings, *told))
    return replace(recording, calibration=found.images, test=test, probe=probe), found


def check_times_of_flight(
    times: Float[np.ndarray, "n columns"], probe: Probe, used: Bool[np.ndarray, " n"] | None = None
) -> None:
    """Refuse what cannot be one-way times of flight in seconds; NaN is no answer, and allowed.

    Only rows that are ``used`` are looked at; by default all.

    Raises:
        InputError: another number of elements, a negative or infinite time, times so long that
            they must be micro- or milliseconds; the row is named.
    """
    if times.shape[1] != probe.elements:
        raise InputError(
            f"time_of_flight has {times.shape[1]} columns, the probe has {probe.elements} elements"
        )
    used = np.ones(len(times), bool) if used is None else used
    rows = np.where(used[:, None], times, np.nan)
    for wrong, what in ((np.isinf(rows), "an infinite"), (rows < 0, "a negative")):
        if wrong.any():
            row, element = np.argwhere(wrong)[0]
            raise InputError(
                f"time_of_flight row {row} has {what} time, {rows[row, element]:.6g} s at element "
                f"{element}"
            )
    # A single line may be wrong; a frame whose times mean metres of water is in another unit.
    answers = np.isfinite(rows).sum(axis=1)
    late = (rows > _LONGEST_S).sum(axis=1)
    wrong = (answers > 0) & (2 * late > answers)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        middle = float(np.nanmedian(rows[row]))
        unit = "milli" if middle < 1 else "micro" if middle < 1e3 else "nano"
        raise InputError(
            f"time_of_flight row {row} has times about {middle:.4g} s, a path of "
            f"{probe.sound_speed_m_s * middle:.3g} m: they look like {unit}seconds; give seconds"
        )


def _end_of_window(times: Float[np.ndarray, "n elements"]) -> Bool[np.ndarray, "n elements"]:
    """Times that a receiver wrote where it heard nothing until the end of its window.

    More than 8 elements of a frame have exactly its longest time, and more than :data:`_TIES` times
    as many as have the next shorter one. With a clock, the target's own times are equal in runs;
    they change fastest far from the target, where the longest ones are.
    """
    answers = np.where(np.isfinite(times), times, -np.inf)
    longest = answers.max(axis=1, keepdims=True)
    equal = np.isfinite(times) & (times == longest)
    shorter = np.where(equal, -np.inf, answers)
    next_longest = shorter.max(axis=1, keepdims=True)
    next_equal = np.isfinite(shorter) & (shorter == next_longest)
    count = equal.sum(axis=1)
    cut = (count > MINIMUM_LINES) & (count > _TIES * next_equal.sum(axis=1))
    return equal & cut[:, None]


def _fit(distances: np.ndarray, probe: Probe, robust: bool, scale: NoiseScale, failed: np.ndarray):
    """Points, covariances, noise, rejected lines; for curved arrays [x, z, y^2] with covariance."""
    curved = isinstance(probe, CurvilinearProbe)
    fits = _fitted(np.asarray(distances, float), probe.element_positions(), (curved, robust))
    # The out-of-plane fit gives the noise: far out of the plane the residuals of the in-plane fit
    # are more than noise.
    plane, whole = fits if isinstance(fits, tuple) else (fits, fits)
    noise, rejected = np.asarray(whole.noise), np.asarray(whole.rejected).astype(int)

    def scaled(fit) -> tuple[np.ndarray, np.ndarray]:
        own = np.asarray(fit.noise)
        alike = np.isfinite(own) & ~failed
        variance = np.median(own[alike]) ** 2 if scale == "pooled" and alike.any() else own**2
        covariance = np.asarray(fit.inverse_normal) * np.reshape(variance, (-1, 1, 1))
        return np.asarray(fit.position), covariance

    points, covariance = scaled(plane)
    # A frame without any residual, such as a noise-free simulation, still needs a variance.
    covariance = covariance + 1e-12 * np.eye(2)
    noise = np.maximum(noise, 1e-6)
    return points, covariance, noise, rejected, scaled(whole) if curved else None


def _near(
    distances: np.ndarray, probe: Probe, position: np.ndarray, noise: np.ndarray
) -> Bool[np.ndarray, "n elements"]:
    """Answers within 6 SDs of the fit; a wrong sound speed shifts all, but none by more."""
    apart = position[:, None, :2] - probe.element_positions()[:, [0, 2]]
    square = np.sum(apart**2, axis=-1)
    if position.shape[1] == 3:
        square = square + position[:, 2:]
    with np.errstate(invalid="ignore"):
        return np.abs(distances - np.sqrt(np.maximum(square, 0.0))) <= _FAR * noise[:, None]


def _out_of_plane(position: np.ndarray, covariance: np.ndarray, kept: np.ndarray) -> OutOfPlane:
    position = np.where(kept[:, None], position, np.nan)
    covariance = np.where(kept[:, None, None], covariance, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        square, sd = position[:, 2], np.sqrt(covariance[:, 2, 2])
        determined = square > _SIGNIFICANT * sd
        elevation = np.sqrt(np.maximum(square, 0.0))
        elevation_sd = np.where(determined, sd / (2 * elevation), np.nan)
    return OutOfPlane(position, covariance, elevation, elevation_sd, determined)


@lru_cache(maxsize=4)
def compiled_fit(curved: bool, robust: bool):
    """The fit as a compiled function of (distances, element positions); any leading axes.

    The compiler flags for batches let sums over the elements vectorise. NaN and Inf become weights
    of zero before any arithmetic.
    """
    fit = partial(fit_frames, how=(curved, robust))
    return jax.jit(fit, compiler_options=fast_to_run(jax.default_backend()))


def fit_frames(distances: AnyArray, positions: AnyArray, how: tuple[bool, bool]) -> Fits:
    """The fit of every frame (traceable).

    Args:
        distances: (..., n, elements), mm; NaN: no answer.
        positions: (elements, 3) of the elements, mm.
        how: whether the array is curved, and whether outliers are rejected.
    """
    curved, robust = how
    if curved:
        return fit_out_of_plane(distances, positions, robust=robust)
    # The compiler leaves out arithmetic with numbers that it knows to be zero.
    zero = jnp.zeros_like(positions[:, 0])
    line = jnp.stack([jnp.asarray(positions)[:, 0], zero, zero], axis=-1)
    return fit_in_plane(distances, line, robust=robust)


def _fitted(
    distances: Float[np.ndarray, "n elements"], positions: np.ndarray, how: tuple[bool, bool]
) -> Fits:
    """The fit; on a CPU by a kept program, which serves many numbers of frames."""
    if executables.processor() is None:
        return compiled_fit(*how)(distances, positions)
    count, elements = distances.shape
    padded = np.full((executables.padded_images(count), elements), np.nan)
    padded[:count] = distances
    found = executables.run(
        "jaxcal.data.segmentation.segment:fit_frames",
        (padded, np.asarray(positions, float)),
        how,
        flags=ONE_PROBLEM if count <= _FEW_FRAMES else batch_flags(),
        label={"method": "segmentation", "data": "channels", "images": len(padded)},
    )
    return jax.tree.map(lambda leaf: leaf[:count], found)


def _warnings(
    used, failed, missing, rejected, cut, noise_mm: np.ndarray, elements: int
) -> tuple[str, ...]:
    found = []
    known = noise_mm[np.isfinite(noise_mm)]
    if known.size and np.median(known) > _NOISY_MM:
        found.append(
            f"the distances to the elements differ by {np.median(known):.2g} mm (SD) from those of "
            "a target: check the order and the pitch of the elements, and that the times are "
            "one-way"
        )
    if cut.any():
        found.append(
            f"{int(cut.sum())} lines in {counted(int(cut.any(axis=1).sum()), 'frame')} have "
            "exactly the longest time of their frame, the end of the receiver's window: they did "
            "not answer"
        )
    if failed.any():
        rows = np.flatnonzero(failed)
        named, count = runs_in_words(rows.tolist(), 8), int(used.sum())
        found.append(f"{len(rows)} of {count} frames could not be segmented: {named}")
    kept = used & ~failed
    total = max(int(kept.sum()) * elements, 1)
    for name, count in (("did not answer", missing), ("were rejected as outliers", rejected)):
        lost = int(count[kept].sum())
        if lost > _MANY * total:
            found.append(f"{lost} of {total} lines ({100 * lost / total:.0f} %) {name}")
    return tuple(found)


def _impossible_offsets(found: OutOfPlane | None) -> list[str]:
    """A warning where the squares of the offsets show that the times are not those of this array.

    An array of another pitch, radius or sound speed has distances that are more, or less, curved
    along its elements, as offsets make them.
    """
    if found is None:
        return []
    square = found.position[np.isfinite(found.position[:, 2]), 2]
    below, above = (square < _SQUARES[0]).sum(), (square > _SQUARES[1]).sum()
    if max(below, above) <= 0.5 * (len(square) + _SURE * len(square) ** 0.5):
        return []
    what = (
        "the squares of the target's distances from the image plane are negative"
        if below > above
        else f"the target is more than {_SQUARES[1] ** 0.5:.0f} mm beside the image plane"
    )
    return [
        f"by the times of the elements, {what} in {max(below, above)} of {len(square)} frames: "
        "check the array's pitch and radius, the sound speed and the delay"
    ]
