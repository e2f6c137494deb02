"""The echo's envelope from a displayed frame, and the noise estimated from its speckle.

A log-compressed frame is a + k ln(envelope), and fully developed speckle says what k is: the
logarithm of a Rayleigh variable has quantiles ln sigma + ln(-2 ln(1 - p)) / 2 [1, 2]. A wrong
scale k raises the envelope to a power, which makes a spot narrower or wider but does not move it.

For point spreads of Gaussian shape with SD s of the envelope, the in-phase part of the speckle has
correlation exp(-d^2 / 4 s^2) at lag d, and the envelope about the square of that [3].

References:
    [1] R. F. Wagner et al., Statistics of speckle in ultrasound B-scans, 1983.
    [2] R. W. Prager et al., Decompression and speckle detection for ultrasound images, 2003.
    [3] J. W. Goodman, Speckle Phenomena in Optics, 2007, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

Compression = Literal["log", "none"]

SMALLEST_REGION = 16
"""Least rows and columns to search: with fewer there is no background to compare with."""
USUAL_DECIBELS = 60.0
"""Range assumed for a log-compressed frame whose background is too black to measure it, dB."""
HALF_MAXIMUM = 2 * np.log(2.0)
"""Squared half width at half maximum of a Gaussian over its variance; also the squared median of a
Rayleigh variable over sigma^2."""

_SPECKLE_SAMPLE = 512
"""Rows and columns of background that suffice for its statistics."""
_SINGLE_LAGS = 10
"""So many lags cost about as much one by one as all lags by Fourier transforms; few speckles are
longer."""


class NotFoundError(Exception):
    """Why a frame has no credible target."""


@dataclass(frozen=True)
class Speckle:
    """The background: SD of the in-phase part, and SDs (px) of a speckle along v and u."""

    sigma: float
    size: tuple[float, float]


def envelope_of(
    values: np.ndarray, dtype: np.dtype, compression: Compression, decibels_per_level: float | None
) -> Float[np.ndarray, "rows columns"]:
    """The frame on a linear scale, largest value 1.

    Args:
        values: (rows, columns) of the region, finite and not constant.
        dtype: what the frame was stored as: 8 bits have a known range.
        compression: ``log`` or ``none``.
        decibels_per_level: dB for one unit, None to measure it.

    Raises:
        NotFoundError: an uncompressed frame with negative values is no envelope.
    """
    floor = float(values.min())
    if compression == "none":
        if floor < 0:
            raise NotFoundError("the envelope has negative values")
        return values / values.max()
    full = 255.0 if dtype == np.uint8 else float(np.ptp(values))
    nepers = np.log(10.0) / 20.0
    if decibels_per_level is not None:
        per_level = nepers * decibels_per_level
    else:
        # Two quantiles that a black floor does not reach.
        per_level, speckle = nepers * USUAL_DECIBELS / full, _without_brightest(values)
        for low, high in ((0.5, 0.9), (0.8, 0.96)):
            first, second = np.quantile(speckle, (low, high))
            if first > floor and second > first:
                expected = 0.5 * np.log(np.log1p(-high) / np.log1p(-low))
                per_level = expected / (second - first)
                break
        per_level = float(np.clip(per_level, nepers * 20.0 / full, nepers * 150.0 / full))
    return np.exp(per_level * (values - values.max()))


def _without_brightest(values: np.ndarray) -> Float[np.ndarray, " pixels"]:
    """All pixels but those near the brightest: a target would widen the background's quantiles."""
    peak = np.unravel_index(np.argmax(values), values.shape)
    near = [
        np.abs(np.arange(size) - k) <= size // 8 for k, size in zip(peak, values.shape, strict=True)
    ]
    return values[~(near[0][:, None] & near[1][None])]


def background(envelope: np.ndarray, peak: tuple[int, int], keep_out: list[int]) -> Speckle:
    """Speckle away from the target: the SD of its in-phase part, and its size."""
    away = np.ones(envelope.shape, bool)
    rows, columns = (slice(max(k - m, 0), k + m + 1) for k, m in zip(peak, keep_out, strict=True))
    away[rows, columns] = False
    if away.sum() < SMALLEST_REGION**2 / 2:
        raise NotFoundError("the bright area fills the region: there is no background")
    level = float(np.median(envelope[away]))
    # The median of a Rayleigh variable is sqrt(2 ln 2) sigma. It is zero where most pixels are
    # black: then the mean square gives sigma, which is taken to be at least 1e-3.
    sigma = level / np.sqrt(HALF_MAXIMUM)
    if sigma <= 0:
        sigma = max(float(np.sqrt(0.5 * np.mean(envelope[away] ** 2))), 1e-3)
    # Bright structures, such as clutter below the face, are not speckle, and their shape
    # would change its size. Speckle exceeds 4 sigma in 0.03 % of its pixels.
    away &= envelope <= 4 * sigma
    centred = np.where(away, envelope - envelope[away].mean(), 0.0)
    centred = centred[:_SPECKLE_SAMPLE, :_SPECKLE_SAMPLE]
    weight = away[:_SPECKLE_SAMPLE, :_SPECKLE_SAMPLE].astype(float)
    return Speckle(sigma, (_speckle_size(centred, weight), _speckle_size(centred.T, weight.T)))


def _speckle_size(centred: np.ndarray, weight: np.ndarray) -> float:
    """SD s of a speckle along axis 0, px: the envelope's correlation at lag k is exp(-k^2 / 2 s^2).

    It comes from the lag at which the correlation falls to a half; neither white noise of the
    electronics nor slow shading moves that lag by much. Zero for uncorrelated pixels.
    """
    variance = float(np.sum(centred**2) / max(np.sum(weight), 1.0))
    if variance <= 0:
        return 0.0
    before = 1.0
    most = max(2, len(centred) // 4)
    sums = pairs = np.empty(0)
    for lag in range(1, most):
        if lag > _SINGLE_LAGS and not len(sums):
            sums, pairs = _lagged_sums(centred, most), np.rint(_lagged_sums(weight, most))
        if len(sums):
            total, count = sums[lag], pairs[lag]
        else:
            total = np.sum(centred[lag:] * centred[:-lag])
            count = np.sum(weight[lag:] * weight[:-lag])
        now = float(total / max(count, 1.0)) / variance
        if now < 0.5:
            # A Gaussian's logarithm is linear in the squared lag, so it is interpolated in that.
            if lag == 1:
                return 0.0 if now < 0.02 else float(np.sqrt(-0.5 / np.log(now)))
            a, b = np.log(before), np.log(max(now, 0.02))
            square = (lag - 1) ** 2 + (2 * lag - 1) * (a - np.log(0.5)) / (a - b)
            return float(np.sqrt(square / HALF_MAXIMUM))
        before = now
    return len(centred) / 4


def _lagged_sums(values: np.ndarray, lags: int) -> Float[np.ndarray, " lags"]:
    """Sums of the products of all pairs of pixels that are 0, 1, 2, ... apart along axis 0."""
    # With as many zeros behind as there are lags, the end does not meet the beginning.
    size = len(values) + lags
    power = np.sum(np.abs(np.fft.rfft(values, size, axis=0)) ** 2, axis=1)
    return np.fft.irfft(power, size)[:lags]


def spread(
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


def decibel(ratio: float) -> float:
    """An amplitude ratio in dB."""
    return float(20 * np.log10(max(ratio, 1e-12)))
