"""The target's position in a B-mode frame: sub-pixel with a covariance, or why it was not found.

Pixels: a frame's axis 0 is v (axial, the row), axis 1 is u (lateral, the column); pixel centres lie
at integers, so the middle of the first pixel is (u, v) = (0, 0). Positions are [u, v], px.

:mod:`~jaxcal.data.segmentation.speckle` computes the envelope of the frame and measures the
background; :mod:`~jaxcal.data.segmentation.spot` fits the target. A target is credible if its
envelope is too high for the brightest speckle of the region (by default with one false alarm in a
thousand frames of mere speckle), if nothing else is nearly as bright, and if it has the extent of a
spot. Everything else is reported as not found.

The covariance is that of the *echo's* position. The echo comes from a place on the target that
changes with the angle of incidence, and a frame does not show this place: the spots of real wires
in water scatter by 0.6 to 0.8 px from frame to frame, but the frames themselves account for only
0.15 px. If this scatter is known, state it as ``target_sd_px``; the joint calibration rescales the
covariances in any case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from jaxtyping import Bool, Float

from jaxcal import InputError
from jaxcal.data.names import Target
from jaxcal.data.recording import MOST_IMAGES
from jaxcal.data.segmentation.speckle import (
    SMALLEST_REGION,
    Compression,
    NotFoundError,
    background,
    decibel,
    envelope_of,
)
from jaxcal.data.segmentation.spot import Spot, brightest, fit_spot, half_maximum, saturated_pixels

MAXIMUM_PIXELS = 2**24
"""Largest frame, px."""
LARGEST_SPOT = 0.25
"""A spot whose SD is more than this fraction of the region is a structure, not a target."""
_LEAST_MARGIN_DB = 3.0
"""If the next bright spot is nearer in brightness, it is not certain which one is the target."""
_CUT = 10 ** (-36 / 20)
"""A spot that falls below this share of its peak, beside a pixel above half of it, is cut off."""


@dataclass(frozen=True)
class Localisation:
    """Where the target is in each of n frames.

    Attributes:
        position: (n, 2) [u lateral, v axial], px; NaN where not found.
        covariance: (n, 2, 2) px^2; NaN where not found.
        found: (n,) whether there is a credible target.
        contrast_db: (n,) the target's envelope over the background's root mean square, dB; NaN
            where nothing could be measured.
        margin_db: (n,) the brightest spot over the next brightest, dB; NaN likewise.
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


def localise(
    frames: np.ndarray,
    target: Target = "echo",
    *,
    region: Sequence[int] | np.ndarray | None = None,
    near: np.ndarray | tuple[float, float] | None = None,
    within_px: float | None = None,
    compression: Compression = "log",
    decibels_per_level: float | None = None,
    false_alarm: float = 1e-3,
    target_sd_px: float | tuple[float, float] = 0.0,
) -> Localisation:
    """Find the active echo spot or the cross-wire in every frame.

    Args:
        frames: (rows, columns) or (n, rows, columns), any real number type; axis -2 is v axial,
            axis -1 is u lateral.
        target: ``echo``, one bright spot; ``cross``, a bright crossing with tails along the wires.
        region: (first column, first row, columns, rows) to look in, px; the whole frame by default.
        near: [u, v] px where the target is expected, (2,) or (n, 2); with ``within_px``.
        within_px: look no farther than this from ``near``, px. The background is still that of
            the whole region.
        compression: ``log`` for a displayed frame, ``none`` where pixels are the envelope.
        decibels_per_level: what one unit of a log-compressed pixel stands for, dB (60 dB in 8 bits:
            60 / 255). None: measured on the speckle or, where the background is black, 60 dB over
            the display's range.
        false_alarm: accepted probability that mere speckle is taken for a target in a frame.
        target_sd_px: SD of the place that the echo comes from about the target's position, px, one
            number or [u, v]. Its square is added to the covariance. No single frame shows it.

    Returns:
        Positions with covariances; frames that are constant, hold NaN or Inf, or have no credible
        target come back with ``found`` False and the reason.

    Raises:
        InputError: arrays of other dimensions or types, frames or regions that are too small or too
            large, options that contradict each other.
    """
    stack = _check_frames(frames)
    if target not in get_args(Target):
        raise InputError(f"target must be echo or cross, not {target!r}")
    if compression not in ("log", "none"):
        raise InputError(f"compression must be log or none, not {compression!r}")
    if decibels_per_level is not None:
        if not (np.isfinite(decibels_per_level) and decibels_per_level > 0):
            raise InputError(f"decibels_per_level must be positive, not {decibels_per_level!r}")
        if compression == "none":
            raise InputError("decibels_per_level belongs to log-compressed frames")
    if not 0 < false_alarm < 1:
        raise InputError(f"false_alarm must be between 0 and 1, not {false_alarm!r}")
    first_column, first_row, columns, rows = check_region(region, stack.shape[1:])
    expected, radius = _check_near(near, within_px, len(stack))
    scatter = np.asarray(target_sd_px, dtype=float)
    if scatter.shape not in ((), (2,)) or not (np.isfinite(scatter) & (scatter >= 0)).all():
        raise InputError(f"target_sd_px must be one or two numbers >= 0, not {target_sd_px!r}")
    corner = np.array([first_column, first_row], dtype=float)
    how = (compression, decibels_per_level, false_alarm)
    spots = []
    for index, frame in enumerate(stack):
        part = frame[first_row : first_row + rows, first_column : first_column + columns]
        centre = None if expected is None else expected[index] - corner
        spots.append(_localise_one(part, target, centre, radius, *how))

    def stacked(name: str, *shape: int) -> np.ndarray:
        values = np.array([getattr(spot, name) for spot in spots], dtype=float)
        return values.reshape(-1, *shape)

    return Localisation(
        position=stacked("position", 2) + corner,
        covariance=stacked("covariance", 2, 2) + np.diag(np.broadcast_to(scatter**2, (2,))),
        found=np.array([not spot.reason for spot in spots], dtype=bool),
        contrast_db=stacked("contrast_db"),
        margin_db=stacked("margin_db"),
        residual=stacked("residual"),
        width=stacked("width", 2),
        reason=tuple(spot.reason for spot in spots),
    )


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
    if count > MOST_IMAGES:
        raise InputError(f"{count} frames are too many: at most {MOST_IMAGES} at a time")
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


def check_region(
    region: Sequence[int] | np.ndarray | None, shape: tuple[int, ...]
) -> tuple[int, int, int, int]:
    """The region to look in: (first column, first row, columns, rows), px; the whole frame if None.

    Raises:
        InputError: not four whole numbers, outside the frame, or too small.
    """
    rows, columns = shape
    if region is None:
        return 0, 0, columns, rows
    values = np.asarray(region)
    if values.shape != (4,) or values.dtype.kind not in "ui":
        raise InputError(
            "region must be four whole numbers: first column, first row, columns, rows"
        )
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


def _localise_one(
    frame: np.ndarray,
    target: Target,
    expected: np.ndarray | None,
    radius: float,
    compression: Compression,
    decibels_per_level: float | None,
    false_alarm: float,
) -> Spot:
    """The target in one region, or why there is none; positions count from its first pixel."""
    contrast = margin = np.nan
    values = frame.astype(np.float64)
    try:
        if not np.isfinite(values).all():
            raise NotFoundError("the frame holds NaN or Inf")
        if np.ptp(values) == 0:
            raise NotFoundError("the frame is constant")
        envelope = envelope_of(values, frame.dtype, compression, decibels_per_level)
        peak, rival = brightest(envelope, expected, radius)
        shape, extent = half_maximum(envelope, peak)
        keep_out = [int(np.ceil(4 * sd)) + 1 for sd in extent]
        speckle = background(envelope, peak, keep_out)
        rms = np.sqrt(2.0) * speckle.sigma
        contrast = decibel(envelope[peak] / rms)
        margin = decibel(envelope[peak] / max(rival(keep_out), rms))
        # The brightest of N speckles exceeds t with probability of about N exp(-t^2 / 2 sigma^2).
        cell = np.prod([max(np.sqrt(2 * np.pi) * size, 1.0) for size in speckle.size])
        needed = decibel(np.sqrt(np.log(max(envelope.size / cell, 1.0) / false_alarm)))
        if contrast < needed:
            raise NotFoundError(
                f"nothing stands out: the brightest spot is {contrast:.1f} dB over the background, "
                f"speckle alone reaches {needed:.1f} dB"
            )
        if margin < _LEAST_MARGIN_DB:
            raise NotFoundError(
                f"ambiguous, several bright spots: the next is only {margin:.1f} dB below"
            )
        _check_shape(shape, extent)
        spot = fit_spot(envelope, saturated_pixels(values), shape, extent, speckle, target, margin)
        if _cut_off(shape, values, envelope / envelope[peak]):
            raise NotFoundError("the bright spot is cut off by the edge of the image")
        if expected is not None and np.linalg.norm(spot.position - expected) > radius:
            raise NotFoundError("the spot lies farther from the expected place")
    except NotFoundError as reason:
        return Spot(contrast_db=contrast, margin_db=margin, reason=str(reason))
    return spot


def _check_shape(shape: np.ndarray, extent: tuple[float, float]) -> None:
    """Refuse what is no spot, by its pixels above half the maximum and its SDs along v and u."""
    if shape.sum() < 3:
        raise NotFoundError("a single bright pixel, not a spot")
    border = np.ones_like(shape)
    border[1:-1, 1:-1] = False
    if (shape & border).any():
        raise NotFoundError("the bright spot is cut off by the border")
    if (np.array(extent) > LARGEST_SPOT * np.array(shape.shape)).any():
        raise NotFoundError("the bright area is a structure, not a spot")


def _cut_off(shape: np.ndarray, values: np.ndarray, share: np.ndarray) -> bool:
    """Whether a spot ends at once, as at the edge of a sector: no point spread falls so steeply.

    The pixels must fall by half of the display's range as well, since the range in dB is estimated.
    """
    steps = 0
    for axis in (0, 1):
        for a, b in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            inside = (slice(None),) * axis + (a,)
            beside = (slice(None),) * axis + (b,)
            steep = values[inside] - values[beside] >= 0.5 * np.ptp(values)
            steps += np.sum(shape[inside] & steep & (share[beside] < _CUT))
    return bool(steps >= 2)
