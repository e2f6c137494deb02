"""Where the target is in a B-mode frame: sub-pixel, with a covariance and a reason where it is not.

Pixels: a frame's axis 0 is v (axial, the row), axis 1 is u (lateral, the column); pixel centres lie
at integers, so the middle of the first pixel is (u, v) = (0, 0). Positions are [u, v], px.

The frame is first taken back to the echo's envelope. A log-compressed frame is a + k ln(envelope),
and fully developed speckle says what k is: the logarithm of a Rayleigh variable has quantiles
ln sigma + ln(-2 ln(1 - p)) / 2 [1, 2]. A scale k that is off raises the envelope to a power, which
makes the spot narrower or wider but does not move it.

To the envelope e a spot with the target's centre is fitted by least squares,

    m = sqrt(b^2 + sum_j A_j^2 exp(-|L_j d|^2)),    d = (u, v) - centre,

with one elliptical component for the active echo, whose point spread is wider laterally than
axially, and two that share their centre for a crossing of two wires seen with the beam's thickness.

Covariance: around a bright target the envelope is A g plus the in-phase part of the speckle, of
variance sigma^2 and correlated over the width of a speckle, which is about that of the spot itself.
Residuals of the fit cannot show such noise (it looks like a shift) and pixels are far from
independent. So sigma and the correlation are measured on the background, and propagated through
the fit: W C W', W the pseudo-inverse of the Jacobian. For point spreads of Gaussian shape the
correlation of the envelope of speckle is about the square of that of its in-phase part [3].

A target is credible where its envelope could not be the brightest of all the speckles of the
region (a false alarm in a thousand such frames by default), where nothing else is nearly as
bright, and where it has the extent of a spot. Everything else is reported as not found.

References:
    [1] R. F. Wagner et al., Statistics of speckle in ultrasound B-scans, 1983.
    [2] R. W. Prager et al., Decompression and speckle detection for ultrasound images, 2003.
    [3] J. W. Goodman, Speckle Phenomena in Optics, 2007, section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from jaxcal.errors import InputError, MissingExtraError
from jaxcal.recording import MINIMUM_IMAGES, Images, make_images

Target = Literal["echo", "cross"]
Compression = Literal["log", "none"]

MAXIMUM_PIXELS = 2**24
"""Largest frame, px."""
MAXIMUM_FRAMES = 100_000
"""Most frames in one call."""
SMALLEST_REGION = 16
"""Least rows and columns to search: with fewer there is no background to compare with."""
LARGEST_SPOT = 0.25
"""A spot whose SD is more than this fraction of the region is a structure, not a target."""
USUAL_DECIBELS = 60.0
"""Range of a log-compressed frame where its background is too black to measure it."""
FINEST_SD = 0.005
"""No position is claimed to be better than this, px: no point spread is that symmetric."""

_HALF_MAXIMUM = 2 * np.log(2.0)
"""Squared half width at half maximum of a Gaussian over its variance."""
_WINDOW = 2.5
"""Half width of the fitted window, in SDs of the spot."""
_LARGEST_WINDOW = 60
"""Most pixels on each side of the centre; larger spots are fitted on their middle."""
_HOLD = 0.01
"""Weight of the start of the shape in the fit; a pixel of the target has 1."""
_EXCESS = 2.0
"""Squared residuals up to this many times what speckle explains are left to chance."""
_SPECKLE_SAMPLE = 512
"""Rows and columns of background that suffice for its statistics."""


@dataclass(frozen=True)
class Localisation:
    """Where the target is in each of n frames.

    Attributes:
        position: (n, 2) [u lateral, v axial], px; NaN where not found.
        covariance: (n, 2, 2) px^2; NaN where not found.
        found: (n,) whether there is a credible target.
        contrast_db: (n,) the target's envelope over the background's root mean square, dB; NaN
            where nothing could be measured.
        margin_db: (n,) the brightest place over the next bright one, dB; NaN likewise.
        residual: (n,) root mean square residual of the fit over the target's envelope; NaN where
            not found.
        width: (n, 2) SD of the fitted spot along u and v, px; NaN where not found.
        reason: n texts, empty where found, else why not.
    """

    position: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "n 2 2"]
    found: Bool[np.ndarray, " n"]
    contrast_db: Float[np.ndarray, " n"]
    margin_db: Float[np.ndarray, " n"]
    residual: Float[np.ndarray, " n"]
    width: Float[np.ndarray, "n 2"]
    reason: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.found)


@dataclass(frozen=True)
class _Spot:
    position: np.ndarray
    covariance: np.ndarray
    contrast_db: float
    margin_db: float
    residual: float
    width: np.ndarray


@dataclass(frozen=True)
class _Speckle:
    """The background: SD of the in-phase part, and SDs (px) of a speckle along v and u."""

    sigma: float
    size: tuple[float, float]


class _NotFoundError(Exception):
    """Why a frame has no credible target, with what was measured of it."""

    def __init__(self, reason: str, contrast_db: float = np.nan, margin_db: float = np.nan):
        super().__init__(reason)
        self.contrast_db, self.margin_db = contrast_db, margin_db


def localise(
    frames: np.ndarray,
    target: Target = "echo",
    *,
    region: tuple[int, int, int, int] | None = None,
    near: np.ndarray | tuple[float, float] | None = None,
    within_px: float | None = None,
    compression: Compression = "log",
    decibels: float | None = None,
    false_alarm: float = 1e-3,
    minimum_margin_db: float = 3.0,
) -> Localisation:
    """Find the active echo spot or the cross-wire in every frame.

    Args:
        frames: (rows, columns) or (n, rows, columns), any real number type; axis -2 is v axial,
            axis -1 is u lateral.
        target: ``echo``, one bright spot; ``cross``, a bright crossing with tails along the wires.
        region: (first column, first row, columns, rows) to look in, px; the whole frame by default.
        near: [u, v] px where the target is expected, (2,) or (n, 2); with ``within_px``.
        within_px: look no farther than this from ``near``, px. The background is still the
            region's.
        compression: ``log`` for a displayed frame, ``none`` where pixels are the envelope.
        decibels: what the range of the display stands for, dB (integer frames: the number type's
            range; floating ones: from the frame's least to its largest value). None: measured on
            the speckle.
        false_alarm: accepted probability that mere speckle is taken for a target in a frame.
        minimum_margin_db: least distance to the next bright spot, dB.

    Returns:
        Positions with covariances; frames that are constant, hold NaN or Inf, or have no credible
        target come back with ``found`` False and the reason.

    Raises:
        InputError: arrays of other dimensions or types, frames or regions that are too small or too
            large, contradicting options.
        MissingExtraError: scikit-image is not installed (``pip install 'jaxcal[image]'``).
    """
    stack = _check_frames(frames)
    if target not in ("echo", "cross"):
        raise InputError(f"target must be echo or cross, not {target!r}")
    if compression not in ("log", "none"):
        raise InputError(f"compression must be log or none, not {compression!r}")
    if decibels is not None and not (np.isfinite(decibels) and 1 <= decibels <= 300):
        raise InputError(f"decibels must be between 1 and 300 dB, not {decibels!r}")
    if decibels is not None and compression == "none":
        raise InputError("decibels belongs to log-compressed frames")
    if not 0 < false_alarm < 1:
        raise InputError(f"false_alarm must be between 0 and 1, not {false_alarm!r}")
    if not (np.isfinite(minimum_margin_db) and minimum_margin_db >= 0):
        raise InputError(f"minimum_margin_db must be zero or positive, not {minimum_margin_db!r}")
    first_column, first_row, columns, rows = _check_region(region, stack.shape[1:])
    expected, radius = _check_near(near, within_px, len(stack))
    _libraries()

    corner = np.array([first_column, first_row], dtype=float)
    results: list[_Spot | _NotFoundError] = []
    for index, frame in enumerate(stack):
        part = frame[first_row : first_row + rows, first_column : first_column + columns]
        centre = None if expected is None else expected[index] - corner
        try:
            results.append(
                _localise_one(part, target, centre, radius, compression, decibels, false_alarm,
                              minimum_margin_db)
            )  # fmt: skip
        except _NotFoundError as reason:
            results.append(reason)
    return _collect(results, corner)


def images_from_frames(
    frames: np.ndarray,
    poses: np.ndarray,
    target: Target = "echo",
    *,
    spacing_mm: np.ndarray | tuple[float, float] | None = None,
    face_offset_mm: float = 0.0,
    time: np.ndarray | None = None,
    minimum: int = MINIMUM_IMAGES,
    **options,
) -> tuple[Images, Localisation]:
    """Localise the target in tracked frames and make them images to calibrate with.

    Args:
        frames: (n, rows, columns), see :func:`localise`.
        poses: (n, 4, 4) probe -> tracker, mm.
        target: ``echo`` or ``cross``.
        spacing_mm: [lateral, axial] mm per px; None where unknown.
        face_offset_mm: range of pixel row 0, mm.
        time: (n,) s.
        minimum: least number of frames with a target.
        **options: of :func:`localise`.

    Returns:
        Images of kind ``pixel`` with covariances, in which frames without a credible target are
        masked; and the localisation with its reasons.

    Raises:
        InputError: see :func:`localise` and :func:`jaxcal.make_images`; numbers of poses and
            frames that differ; too few frames with a target.
    """
    located = localise(frames, target, **options)
    if len(poses) != len(located):
        raise InputError(f"{len(poses)} poses but {len(located)} frames: they must match")
    used = int(located.found.sum())
    if used < minimum:
        reasons = [reason for reason in located.reason if reason]
        most = max(set(reasons), key=reasons.count) if reasons else "there are no frames"
        raise InputError(
            f"only {used} of {len(located)} frames show a credible target, at least {minimum} are "
            f"needed (most often: {most})"
        )
    images = make_images(
        poses, located.position, "pixel", mask=located.found, covariance=located.covariance,
        time=time, spacing_mm=spacing_mm, face_offset_mm=face_offset_mm, minimum=minimum,
    )  # fmt: skip
    return images, located


def _libraries() -> tuple[ModuleType, ModuleType, Callable]:
    """scikit-image's feature and measure, and scipy's least_squares, which comes with it."""
    try:
        import skimage.feature
        import skimage.measure
        from scipy.optimize import least_squares
    except ImportError as error:
        raise MissingExtraError(
            "segmentation of B-mode frames needs scikit-image: pip install 'jaxcal[image]'"
        ) from error
    return skimage.feature, skimage.measure, least_squares


def _check_frames(frames: np.ndarray) -> np.ndarray:
    stack = np.asarray(frames)
    if stack.dtype.kind not in "buif":
        raise InputError(f"frames must hold real numbers, not {stack.dtype}")
    if stack.ndim == 2:
        stack = stack[None]
    if stack.ndim != 3:
        raise InputError(
            f"frames must have shape (rows, columns) or (n, rows, columns), not {stack.shape}"
            + ("; convert colour to grey first" if stack.ndim == 4 else "")
        )
    count, rows, columns = stack.shape
    if count > MAXIMUM_FRAMES:
        raise InputError(f"{count} frames are too many: at most {MAXIMUM_FRAMES} at a time")
    if rows * columns > MAXIMUM_PIXELS:
        raise InputError(
            f"frames of {rows} x {columns} px are too large: at most {MAXIMUM_PIXELS} px"
        )
    if min(rows, columns) < SMALLEST_REGION:
        raise InputError(
            f"frames of {rows} x {columns} px are too small: at least {SMALLEST_REGION} rows and "
            "columns are needed"
        )
    return stack


def _check_region(
    region: tuple[int, int, int, int] | None, shape: tuple[int, ...]
) -> tuple[int, int, int, int]:
    rows, columns = shape
    if region is None:
        return 0, 0, columns, rows
    values = np.asarray(region)
    if values.shape != (4,) or values.dtype.kind not in "ui":
        raise InputError("region must be four whole numbers: first column, first row, columns, rows")
    left, top, wide, high = (int(value) for value in values)
    if left < 0 or top < 0 or left + wide > columns or top + high > rows:
        raise InputError(f"region {(left, top, wide, high)} leaves the {columns} x {rows} px frame")
    if min(wide, high) < SMALLEST_REGION:
        raise InputError(
            f"region {(left, top, wide, high)} is too small: at least {SMALLEST_REGION} columns "
            "and rows are needed"
        )
    return left, top, wide, high


def _check_near(
    near: np.ndarray | tuple[float, float] | None, within_px: float | None, count: int
) -> tuple[np.ndarray | None, float]:
    if (near is None) != (within_px is None):
        raise InputError("near and within_px belong together")
    if near is None or within_px is None:
        return None, np.inf
    if not (np.isfinite(within_px) and within_px >= 1):
        raise InputError(f"within_px must be at least 1 px, not {within_px!r}")
    values = np.asarray(near, dtype=float)
    if values.shape not in ((2,), (count, 2)):
        raise InputError(f"near must have shape (2,) or ({count}, 2), it has {values.shape}")
    if not np.isfinite(values).all():
        raise InputError("near holds NaN or Inf")
    return np.broadcast_to(values, (count, 2)), float(within_px)


def _collect(results: list[_Spot | _NotFoundError], corner: np.ndarray) -> Localisation:
    count = len(results)
    position, covariance = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
    width, residual = np.full((count, 2), np.nan), np.full(count, np.nan)
    found = np.zeros(count, bool)
    for index, result in enumerate(results):
        if isinstance(result, _Spot):
            found[index] = True
            position[index] = result.position + corner
            covariance[index] = result.covariance
            width[index], residual[index] = result.width, result.residual
    return Localisation(
        position=position,
        covariance=covariance,
        found=found,
        contrast_db=np.array([result.contrast_db for result in results], dtype=float),
        margin_db=np.array([result.margin_db for result in results], dtype=float),
        residual=residual,
        width=width,
        reason=tuple(str(r) if isinstance(r, _NotFoundError) else "" for r in results),
    )


def _localise_one(
    frame: np.ndarray,
    target: Target,
    expected: np.ndarray | None,
    radius: float,
    compression: Compression,
    decibels: float | None,
    false_alarm: float,
    minimum_margin_db: float,
) -> _Spot:
    """The target in one region; positions relative to the region's first pixel."""
    values = frame.astype(np.float64)
    if not np.isfinite(values).all():
        raise _NotFoundError("the frame holds NaN or Inf")
    if np.ptp(values) == 0:
        raise _NotFoundError("the frame is constant")
    envelope = _envelope(values, frame.dtype, compression, decibels)
    saturated = _saturated(values)
    peak, rival = _brightest(envelope, expected, radius)
    shape, extent = _half_maximum(envelope, peak)
    keep_out = [int(np.ceil(4 * sd)) + 1 for sd in extent]
    speckle = _background(envelope, peak, keep_out)
    rms = np.sqrt(2.0) * speckle.sigma
    contrast = _decibel(envelope[peak] / rms)
    margin = _decibel(envelope[peak] / max(rival(keep_out), rms))
    # Of N independent speckles the brightest exceeds t with probability N exp(-t^2 / 2 sigma^2).
    cell = np.prod([max(np.sqrt(2 * np.pi) * size, 1.0) for size in speckle.size])
    needed = _decibel(np.sqrt(np.log(max(envelope.size / cell, 1.0) / false_alarm)))
    if contrast < needed:
        raise _NotFoundError(
            f"nothing stands out: the brightest spot is {contrast:.1f} dB over the background, "
            f"speckle alone reaches {needed:.1f} dB", contrast, margin,
        )  # fmt: skip
    if margin < minimum_margin_db:
        raise _NotFoundError(
            f"ambiguous: the next bright spot is only {margin:.1f} dB below", contrast, margin
        )
    if shape.sum() < 3:
        raise _NotFoundError("a single bright pixel, not a spot", contrast, margin)
    rows, columns = np.nonzero(shape)
    high, wide = envelope.shape
    if rows.min() == 0 or columns.min() == 0 or rows.max() == high - 1 or columns.max() == wide - 1:
        raise _NotFoundError("the bright spot is cut off by the border", contrast, margin)
    if extent[0] > LARGEST_SPOT * high or extent[1] > LARGEST_SPOT * wide:
        raise _NotFoundError("the bright area is a structure, not a spot", contrast, margin)
    return _fit(envelope, saturated, shape, extent, speckle, target, contrast, margin)


def _envelope(
    values: np.ndarray, dtype: np.dtype, compression: Compression, decibels: float | None
) -> Float[np.ndarray, "rows columns"]:
    """The frame on a linear scale, largest value 1."""
    floor = float(values.min())
    if compression == "none":
        if floor < 0:
            raise _NotFoundError("the envelope has negative values")
        return values / values.max()
    span = float(np.ptp(values))
    full = float(np.iinfo(dtype).max) if dtype.kind in "ui" else span
    nepers = np.log(10.0) / 20.0
    if decibels is not None:
        per_level = nepers * decibels / full
    else:
        # Two quantiles that a black floor does not reach.
        per_level, speckle = 0.0, _without_brightest(values)
        for low, high in ((0.5, 0.9), (0.8, 0.96)):
            first, second = np.quantile(speckle, (low, high))
            if first > floor and second > first:
                expected = 0.5 * np.log(np.log1p(-high) / np.log1p(-low))
                per_level = expected / (second - first)
                break
        usual = nepers * USUAL_DECIBELS / full
        if per_level == 0.0:
            per_level = usual
        per_level = float(np.clip(per_level, nepers * 20.0 / full, nepers * 150.0 / full))
    return np.exp(per_level * (values - values.max()))


def _without_brightest(values: np.ndarray) -> Float[np.ndarray, " pixels"]:
    """All pixels but those near the brightest: a target would widen the background's quantiles."""
    peak = np.unravel_index(np.argmax(values), values.shape)
    near = [
        np.abs(np.arange(size) - k) <= size // 8 for k, size in zip(peak, values.shape, strict=True)
    ]
    return values[~(near[0][:, None] & near[1][None])]


def _saturated(values: np.ndarray) -> Bool[np.ndarray, "rows columns"]:
    """Pixels cut off at the top: they only say that the echo was stronger."""
    top = values == values.max()
    return top if top.sum() >= 4 else np.zeros_like(top)


def _brightest(
    envelope: np.ndarray, expected: np.ndarray | None, radius: float
) -> tuple[tuple[int, int], Callable[[list[int]], float]]:
    """Row and column of the brightest place, and how bright the next one is outside a distance."""
    feature, _, _ = _libraries()
    place = np.ones(envelope.shape, bool)
    if expected is not None:
        v, u = np.indices(envelope.shape)
        place = np.hypot(u - expected[0], v - expected[1]) <= radius
        if not place.any():
            raise _NotFoundError("the expected place lies outside the region")
    candidates = np.where(place, envelope, 0.0)
    peaks = feature.peak_local_max(candidates, min_distance=1, exclude_border=False, num_peaks=4096)
    if len(peaks) == 0:
        raise _NotFoundError("nothing stands out: the region is flat")
    heights = candidates[tuple(peaks.T)]
    order = np.argsort(-heights, kind="stable")
    peaks, heights = peaks[order], heights[order]

    def rival(keep_out: list[int]) -> float:
        away = (np.abs(peaks - peaks[0]) > keep_out).any(axis=1)
        return float(heights[away].max()) if away.any() else 0.0

    return (int(peaks[0, 0]), int(peaks[0, 1])), rival


def _half_maximum(
    envelope: np.ndarray, peak: tuple[int, int]
) -> tuple[Bool[np.ndarray, "rows columns"], tuple[float, float]]:
    """The area around the peak above half of it, and the SDs along v and u of a spot of that size.

    Of an ellipse filled evenly the variance is a quarter of its squared half axis.
    """
    _, measure, _ = _libraries()
    labels = measure.label(envelope >= 0.5 * envelope[peak], connectivity=2)
    shape = labels == labels[peak]
    rows, columns = np.nonzero(shape)
    v, u = (np.sqrt((4 * np.var(k) + 1 / 3) / _HALF_MAXIMUM) for k in (rows, columns))
    return shape, (float(v), float(u))


def _background(envelope: np.ndarray, peak: tuple[int, int], keep_out: list[int]) -> _Speckle:
    """Speckle away from the target: the SD of its in-phase part, and its size."""
    away = np.ones(envelope.shape, bool)
    rows, columns = (slice(max(k - m, 0), k + m + 1) for k, m in zip(peak, keep_out, strict=True))
    away[rows, columns] = False
    if away.sum() < SMALLEST_REGION**2 / 2:
        raise _NotFoundError("the bright area fills the region: there is no background")
    level = float(np.median(envelope[away]))
    # The median of a Rayleigh variable is sqrt(2 ln 2) sigma; black pixels have none, and the
    # least that can be told of them is a step of the display.
    sigma = level / np.sqrt(_HALF_MAXIMUM)
    if sigma <= 0:
        sigma = max(float(np.sqrt(0.5 * np.mean(envelope[away] ** 2))), 1e-3)
    # Bright structures are not speckle: their shape would pass for its size.
    centred = np.where(away, np.minimum(envelope, 4 * sigma), 0.0)
    centred = np.where(away, centred - centred[away].mean(), 0.0)
    centred = centred[:_SPECKLE_SAMPLE, :_SPECKLE_SAMPLE]
    weight = away[:_SPECKLE_SAMPLE, :_SPECKLE_SAMPLE].astype(float)
    return _Speckle(sigma, (_speckle_size(centred, weight), _speckle_size(centred.T, weight.T)))


def _speckle_size(centred: np.ndarray, weight: np.ndarray) -> float:
    """SD s of a speckle along axis 0, px: the envelope's correlation at lag k is exp(-k^2 / 2 s^2).

    The lag at which the correlation falls to a half is used, which neither white noise of the
    electronics nor slow shading moves by much; zero for uncorrelated pixels.
    """
    variance = float(np.sum(centred**2) / max(np.sum(weight), 1.0))
    if variance <= 0:
        return 0.0
    before = 1.0
    for lag in range(1, max(2, len(centred) // 4)):
        pairs = np.sum(weight[lag:] * weight[:-lag])
        now = float(np.sum(centred[lag:] * centred[:-lag]) / max(pairs, 1.0)) / variance
        if now < 0.5:
            # At such lags a Gaussian's logarithm is far better interpolated in the squared lag.
            if lag == 1:
                return 0.0 if now < 0.02 else float(np.sqrt(-0.5 / np.log(now)))
            a, b = np.log(before), np.log(max(now, 0.02))
            square = (lag - 1) ** 2 + (2 * lag - 1) * (a - np.log(0.5)) / (a - b)
            return float(np.sqrt(square / _HALF_MAXIMUM))
        before = now
    return len(centred) / 4


def _fit(
    envelope: np.ndarray,
    saturated: np.ndarray,
    shape: np.ndarray,
    extent: tuple[float, float],
    speckle: _Speckle,
    target: Target,
    contrast: float,
    margin: float,
) -> _Spot:
    """Least squares of the spot on a window, and its covariance from the background's speckle."""
    _, _, least_squares = _libraries()
    rows, columns = np.nonzero(shape)
    weights = envelope[rows, columns]
    start = np.array([np.average(columns, weights=weights), np.average(rows, weights=weights)])
    high, wide = envelope.shape
    half = [int(np.clip(np.ceil(_WINDOW * sd), 3, _LARGEST_WINDOW)) for sd in extent]
    middle_v, middle_u = round(start[1]), round(start[0])
    v = np.arange(max(middle_v - half[0], 0), min(middle_v + half[0] + 1, high))
    u = np.arange(max(middle_u - half[1], 0), min(middle_u + half[1] + 1, wide))
    window = envelope[v[0] : v[-1] + 1, u[0] : u[-1] + 1]
    use = ~saturated[v[0] : v[-1] + 1, u[0] : u[-1] + 1]
    grid_v, grid_u = np.meshgrid(v, u, indexing="ij")
    top = float(envelope[shape].max())

    # exp(-|L d|^2) of the square of the envelope: L is the inverse of the spot's SD.
    across, along = 1 / extent[1], 1 / extent[0]
    if target == "echo":
        first = [*start, np.log(speckle.sigma), np.log(top), np.log(across), np.log(along), 0.0]
    else:
        # Two wires, one leaning each way.
        lean = 0.5 * min(across, along)
        one = [np.log(top / np.sqrt(2)), np.log(across), np.log(along)]
        first = [*start, np.log(speckle.sigma), *one, lean, *one, -lean]
    first = np.array(first)

    def model(unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        du, dv = grid_u - unknowns[0], grid_v - unknowns[1]
        floor = np.exp(2 * unknowns[2])
        power = np.full(window.shape, floor)
        slopes = [np.zeros(window.shape), np.zeros(window.shape), np.full(window.shape, 2 * floor)]
        for log_height, log_a, log_b, c in unknowns[3:].reshape(-1, 4):
            a, b = np.exp(log_a), np.exp(log_b)
            p, q = a * du + c * dv, b * dv
            part = np.exp(2 * log_height - p**2 - q**2)
            power += part
            slopes[0] += part * 2 * a * p
            slopes[1] += part * (2 * c * p + 2 * b * q)
            slopes += [2 * part, -2 * part * p * a * du, -2 * part * q**2, -2 * part * p * dv]
        value = np.sqrt(power)
        return value, np.stack(slopes, axis=-1) / (2 * value[..., None])

    # Scaled so that the unknowns are of order 1; what shapes the spot is held near its start, too
    # weakly to matter unless two components make one spot and only their sum is seen.
    steps = _steps(first, extent)
    hold = np.diag(_HOLD / steps)[3:]

    def residual(unknowns: np.ndarray) -> np.ndarray:
        pixels = (model(unknowns)[0] - window)[use] / top
        return np.concatenate([pixels, hold @ (unknowns - first)])

    def slope(unknowns: np.ndarray) -> np.ndarray:
        return np.concatenate([model(unknowns)[1][use] / top, hold])

    with np.errstate(over="ignore", invalid="ignore"):
        try:
            fit = least_squares(
                residual, first, jac=slope, method="trf", x_scale=steps, ftol=1e-8, xtol=1e-6,
                gtol=1e-8, max_nfev=40,
            )  # fmt: skip
        except (ValueError, np.linalg.LinAlgError):
            raise _NotFoundError("no spot could be fitted", contrast, margin) from None
    unknowns = fit.x
    value, _ = model(unknowns)
    moved = np.abs(unknowns[:2] - start)
    width = _width(value, unknowns, grid_u, grid_v)
    if not np.isfinite(unknowns).all():
        raise _NotFoundError("no spot could be fitted", contrast, margin)
    if (moved > 1 + np.array([extent[1], extent[0]])).any():
        raise _NotFoundError("the fit left the bright spot", contrast, margin)

    misfit = np.mean((window - value)[use] ** 2)
    weights = np.zeros((2, *window.shape))
    inverse = np.linalg.pinv(slope(unknowns), rcond=1e-9)[:2]
    weights[:, use] = inverse[:, : use.sum()] / top
    covariance = _propagate(weights, value, misfit, speckle, (width[1], width[0]), v, u)
    if not np.isfinite(covariance).all():
        raise _NotFoundError("the position is not determined", contrast, margin)
    # The shape may still be on its way where the data hardly determine it; the centre may not.
    if (np.abs(inverse @ residual(unknowns)) > 0.1 * np.sqrt(np.diag(covariance))).any():
        raise _NotFoundError("no spot could be fitted", contrast, margin)
    height = float(np.sqrt(np.sum(np.exp(2 * unknowns[3::4]))))
    return _Spot(
        position=unknowns[:2],
        covariance=covariance,
        contrast_db=_decibel(max(height, top) / (np.sqrt(2.0) * speckle.sigma)),
        margin_db=margin,
        residual=float(np.sqrt(misfit) / height),
        width=width,
    )


def _steps(first: np.ndarray, extent: tuple[float, float]) -> np.ndarray:
    """How far each unknown may sensibly move."""
    lean = 0.5 * min(1 / extent[0], 1 / extent[1])
    components = (len(first) - 3) // 4
    return np.array([extent[1], extent[0], 1.0] + components * [0.5, 0.3, 0.3, lean])


def _width(
    value: np.ndarray, unknowns: np.ndarray, grid_u: np.ndarray, grid_v: np.ndarray
) -> Float[np.ndarray, 2]:
    """SDs along u and v of the brightest component of the fitted spot, px."""
    components = unknowns[3:].reshape(-1, 4)
    _, log_a, log_b, c = components[np.argmax(components[:, 0])]
    factor = np.array([[np.exp(log_a), c], [0.0, np.exp(log_b)]])
    inverse = np.linalg.pinv(factor)
    return np.sqrt(np.diag(inverse @ inverse.T))


def _propagate(
    weights: np.ndarray,
    value: np.ndarray,
    misfit: float,
    speckle: _Speckle,
    spot: tuple[float, float],
    v: np.ndarray,
    u: np.ndarray,
) -> Float[np.ndarray, "2 2"]:
    """Covariance of the centre, px^2, from correlated speckle under the fitted spot.

    Args:
        weights: (2, rows, columns) how the centre follows each pixel, zero for those not fitted.
        value: (rows, columns) the fitted envelope.
        misfit: mean squared residual.
        speckle: the background's.
        spot: SDs of the spot along v and u, px.
        v: (rows,) of the window, px.
        u: (columns,) of the window, px.
    """
    # Variance of a Rician envelope: that of a Rayleigh one without signal, sigma^2 under a strong
    # one; in between an interpolation.
    rayleigh = 2 - np.pi / 2
    signal = np.maximum(value**2 - value.min() ** 2, 0.0) / (2 * speckle.sigma**2)
    variance = speckle.sigma**2 * (1 - (1 - rayleigh) * np.exp(-signal))
    covariance = _spread(weights * np.sqrt(variance), speckle.size, v, u)
    # A spot that is not of the fitted shape fits worse than speckle explains, and differs from it
    # over lengths like its own.
    expected = float(np.mean(variance[weights.any(axis=0)]))
    if misfit > _EXCESS * expected:
        covariance += _spread(weights * np.sqrt(misfit - expected), spot, v, u)
    return covariance + FINEST_SD**2 * np.eye(2)


def _spread(
    weights: np.ndarray, size: tuple[float, float], v: np.ndarray, u: np.ndarray
) -> Float[np.ndarray, "2 2"]:
    """Covariance of weighted sums of the in-phase part, whose speckles have these SDs, px."""
    along, across = (_coherence(axis, sd) for axis, sd in zip((v, u), size, strict=True))
    return np.einsum("aij,bij->ab", weights, along @ weights @ across)


def _coherence(axis: np.ndarray, size: float) -> np.ndarray:
    """Correlation of the in-phase part between pixels along one axis."""
    lag = axis[:, None] - axis[None]
    if size <= 0:
        return (lag == 0).astype(float)
    return np.exp(-(lag**2) / (4 * size**2))


def _decibel(ratio: float) -> float:
    return float(20 * np.log10(max(ratio, 1e-12)))
