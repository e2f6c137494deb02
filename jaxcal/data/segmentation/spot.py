"""A bright spot in an envelope: its position to a fraction of a pixel, and its covariance.

A spot centred on the target is fitted to the envelope by least squares,

    m = sqrt(b^2 + sum_j A_j^2 exp(-|L_j d|^2)),    d = (u, v) - centre,

with one elliptical component for the active echo, whose point spread is wider laterally than
axially, and two that share their centre for a crossing of two wires seen with the beam's thickness.

Around a bright target the envelope is that of the spot plus the in-phase part of the speckle. This
noise has variance sigma^2 and is correlated over the width of a speckle, which is about that of the
spot itself. So it looks like a shift, residuals of the fit cannot show it, and pixels are far from
independent. Therefore sigma and the correlation are measured on the background and propagated
through the fit: W C W', where C is the noise's covariance and W the pseudo-inverse of the Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxcal.data.names import Target
from jaxcal.data.segmentation.speckle import HALF_MAXIMUM, NotFoundError, Speckle, decibel, spread

FINEST_SD = 0.005
"""Least SD stated for a position, px: no point spread is symmetric enough for a smaller one."""

_WINDOW = 2.5
"""Half width of the fitted window, in SDs of the spot."""
_LARGEST_WINDOW = 60
"""Most pixels on each side of the centre; larger spots are fitted on their middle."""
_HOLD = 0.01
"""Weight that holds the shape near its start in the fit; a pixel of the target has weight 1."""
_EXCESS = 2.0
"""Squared residuals up to this many times those expected of speckle count as chance."""


@dataclass(frozen=True)
class Spot:
    """A fitted target, or what was measured of a frame without one; NaN where nothing was.

    Attributes:
        position: [u, v], px.
        covariance: px^2.
        contrast_db: envelope over the background's root mean square, dB.
        margin_db: envelope over the next brightest place, dB.
        residual: root mean square of the fit's residual over the target's envelope.
        width: SDs along u and v, px.
        reason: why there is no target; empty where there is one.
    """

    position: Float[np.ndarray, " 2"] = field(default_factory=lambda: np.full(2, np.nan))
    covariance: Float[np.ndarray, "2 2"] = field(default_factory=lambda: np.full((2, 2), np.nan))
    contrast_db: float = np.nan
    margin_db: float = np.nan
    residual: float = np.nan
    width: Float[np.ndarray, " 2"] = field(default_factory=lambda: np.full(2, np.nan))
    reason: str = ""


def saturated_pixels(values: np.ndarray) -> Bool[np.ndarray, "rows columns"]:
    """Pixels cut off at the largest value: the echo there was stronger than stored."""
    top = values == values.max()
    return top if top.sum() >= 4 else np.zeros_like(top)


def brightest(
    envelope: np.ndarray, expected: np.ndarray | None, radius: float
) -> tuple[tuple[int, int], Callable[[list[int]], float]]:
    """The brightest place (row, column); a function for the brightness of the next, farther off."""
    place = np.ones(envelope.shape, bool)
    if expected is not None:
        v, u = np.indices(envelope.shape)
        place = np.hypot(u - expected[0], v - expected[1]) <= radius
        if not place.any():
            raise NotFoundError("the expected place lies outside the region")
    candidates = np.where(place, envelope, 0.0)
    peaks = local_maxima(candidates)
    if len(peaks) == 0:
        raise NotFoundError("nothing stands out: the region is flat")
    heights = candidates[tuple(peaks.T)]

    def rival(keep_out: list[int]) -> float:
        away = (np.abs(peaks - peaks[0]) > keep_out).any(axis=1)
        return float(heights[away].max()) if away.any() else 0.0

    return (int(peaks[0, 0]), int(peaks[0, 1])), rival


def local_maxima(values: Float[np.ndarray, "rows columns"]) -> Int[np.ndarray, "peaks 2"]:
    """Pixels that none of their eight neighbours exceeds, highest first.

    Every pixel of a plateau counts. Pixels of the least value do not count, and constant values
    have no maximum.

    Returns:
        Rows and columns; equal heights are in the order of the rows.
    """
    from scipy import ndimage

    top = values == ndimage.maximum_filter(values, size=3, mode="nearest")
    if top.all():
        return np.empty((0, 2), int)
    peaks = np.argwhere(top & (values > values.min()))
    return peaks[np.argsort(-values[tuple(peaks.T)], kind="stable")]


def half_maximum(
    envelope: np.ndarray, peak: tuple[int, int]
) -> tuple[Bool[np.ndarray, "rows columns"], tuple[float, float]]:
    """The area around the peak above half of it, and the SDs along v and u of a spot of that size.

    The variance of an evenly filled ellipse is a quarter of its squared half axis.
    """
    from scipy import ndimage

    areas: Any = ndimage.label(envelope >= 0.5 * envelope[peak], structure=np.ones((3, 3)))
    labels = areas[0]
    shape = labels == labels[peak]
    rows, columns = np.nonzero(shape)
    v, u = (np.sqrt((4 * np.var(k) + 1 / 3) / HALF_MAXIMUM) for k in (rows, columns))
    return shape, (float(v), float(u))


def fit_spot(
    envelope: np.ndarray,
    saturated: np.ndarray,
    shape: np.ndarray,
    extent: tuple[float, float],
    speckle: Speckle,
    target: Target,
    margin: float,
) -> Spot:
    """Least squares of the spot on a window, and its covariance from the background's speckle."""
    rows, columns = np.nonzero(shape)
    weights = envelope[rows, columns]
    start = np.array([np.average(columns, weights=weights), np.average(rows, weights=weights)])
    top = float(envelope[shape].max())
    window = _Window.around(start, extent, envelope, ~saturated)
    first = _first_guess(start, extent, speckle, target, top)
    if np.sum(window.pixels[window.use] > 0.1 * top) < len(first):
        raise NotFoundError("the display is saturated: only the spot's outline is left")

    fit = _Fit(window, first, _steps(first, extent), top)
    unknowns = fit.solve()
    if unknowns is None:
        raise NotFoundError("no spot could be fitted")
    if (np.abs(unknowns[:2] - start) > 1 + np.array([extent[1], extent[0]])).any():
        raise NotFoundError("the fit left the bright spot")

    value, _ = fit.model(unknowns)
    if not np.isfinite(value).all():
        raise NotFoundError("no spot could be fitted")
    width = _width(unknowns)
    misfit = float(np.mean((window.pixels - value)[window.use] ** 2))
    jacobian = fit.slope(unknowns)
    inverse = np.linalg.pinv(jacobian, rcond=1e-9)[:2]
    if np.abs(inverse @ jacobian - np.eye(2, len(first))).max() > 1e-3:
        raise NotFoundError("the position is not determined")
    by_pixel = np.zeros((2, *value.shape))
    by_pixel[:, window.use] = inverse[:, : window.use.sum()] / top
    across = (width[1], width[0])
    covariance = _propagate(by_pixel, value, misfit, speckle, across, window.v, window.u)
    if not np.isfinite(covariance).all():
        raise NotFoundError("the position is not determined")
    # The centre must have converged. The shape need not, where the data hardly determine it.
    left = np.abs(inverse @ fit.residual(unknowns))
    if (left > 0.1 * np.sqrt(np.diag(covariance))).any():
        raise NotFoundError("no spot could be fitted")
    height = float(np.sqrt(np.sum(np.exp(2 * unknowns[3::4]))))
    return Spot(
        position=unknowns[:2],
        covariance=covariance,
        contrast_db=decibel(max(height, top) / (np.sqrt(2.0) * speckle.sigma)),
        margin_db=margin,
        residual=float(np.sqrt(misfit) / height),
        width=width,
    )


@dataclass(frozen=True)
class _Window:
    """The part of the image to which the spot is fitted.

    Attributes:
        v: rows, px.
        u: columns, px.
        pixels: the envelope there.
        use: False where the display is saturated.
    """

    v: Int[np.ndarray, " rows"]
    u: Int[np.ndarray, " columns"]
    pixels: Float[np.ndarray, "rows columns"]
    use: Bool[np.ndarray, "rows columns"]

    @classmethod
    def around(
        cls, centre: np.ndarray, extent: tuple[float, float], envelope: np.ndarray, use: np.ndarray
    ) -> _Window:
        """As many times the spot's SDs (along v and u) to each side as :data:`_WINDOW` says."""
        high, wide = envelope.shape
        half = [int(np.clip(np.ceil(_WINDOW * sd), 3, _LARGEST_WINDOW)) for sd in extent]
        middle_v, middle_u = round(centre[1]), round(centre[0])
        v = np.arange(max(middle_v - half[0], 0), min(middle_v + half[0] + 1, high))
        u = np.arange(max(middle_u - half[1], 0), min(middle_u + half[1] + 1, wide))
        part = slice(v[0], v[-1] + 1), slice(u[0], u[-1] + 1)
        return cls(v, u, envelope[part], use[part])

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def model(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The envelope of speckle and spot, and its derivatives, last axis."""
        grid_v, grid_u = np.meshgrid(self.v, self.u, indexing="ij")
        du, dv = grid_u - unknowns[0], grid_v - unknowns[1]
        floor = np.exp(2 * unknowns[2])
        power, none = np.full(du.shape, floor), np.zeros(du.shape)
        slopes = [none.copy(), none.copy(), np.full(du.shape, 2 * floor)]
        for log_height, log_a, log_b, c in unknowns[3:].reshape(-1, 4):
            a, b = np.exp(log_a), np.exp(log_b)
            # As a triangular factor with a and b positive, the form stays positive definite.
            p, q = a * du + c * dv, b * dv
            part = np.exp(2 * log_height - p**2 - q**2)
            power += part
            slopes[0] += part * 2 * a * p
            slopes[1] += part * (2 * c * p + 2 * b * q)
            slopes += [2 * part, -2 * part * p * a * du, -2 * part * q**2, -2 * part * p * dv]
        value = np.sqrt(power)
        return value, np.stack(slopes, axis=-1) / (2 * value[..., None])


def _first_guess(
    start: np.ndarray, extent: tuple[float, float], speckle: Speckle, target: Target, top: float
) -> Float[np.ndarray, " unknowns"]:
    """Centre, log of the speckle's level, and log height, two log widths and lean of each part."""
    # The envelope's square falls as exp(-|L d|^2), so L is the inverse of the envelope's SD.
    across, along = 1 / extent[1], 1 / extent[0]
    if target == "echo":
        parts = [np.log(top), np.log(across), np.log(along), 0.0]
    else:
        # Two wires, one leaning each way.
        lean = 0.5 * min(across, along)
        one = [np.log(top / np.sqrt(2)), np.log(across), np.log(along)]
        parts = [*one, lean, *one, -lean]
    return np.array([*start, np.log(speckle.sigma), *parts])


class _Fit:
    """The least squares problem; the unknowns are scaled to order 1.

    The shape is held near its start, but so weakly that this only matters where two components make
    one spot and only their sum is seen.
    """

    def __init__(self, window: _Window, first: np.ndarray, steps: np.ndarray, top: float) -> None:
        self._window, self._first, self._steps, self._top = window, first, steps, top
        self._hold = np.diag(_HOLD / steps)[3:]
        self._last: tuple[np.ndarray, tuple[np.ndarray, np.ndarray]] | None = None

    def model(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As the window's; once where residual and slope are asked for at the same unknowns."""
        if self._last is None or not np.array_equal(self._last[0], unknowns):
            self._last = unknowns.copy(), self._window.model(unknowns)
        return self._last[1]

    def residual(self, unknowns: np.ndarray) -> np.ndarray:
        """Pixels, as shares of the brightest, and what holds the shape."""
        window = self._window
        pixels = (self.model(unknowns)[0] - window.pixels)[window.use] / self._top
        return np.concatenate([pixels, self._hold @ (unknowns - self._first)])

    def slope(self, unknowns: np.ndarray) -> np.ndarray:
        """Derivatives of :meth:`residual`."""
        slope = self.model(unknowns)[1][self._window.use]
        return np.concatenate([slope / self._top, self._hold])

    def solve(self) -> Float[np.ndarray, " unknowns"] | None:
        """The unknowns, or None where there is no solution."""
        from scipy.optimize import least_squares

        derivative: Any = self.slope  # scipy's types know only the names of difference schemes
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                found = least_squares(
                    self.residual,
                    self._first,
                    jac=derivative,
                    method="trf",
                    x_scale=self._steps,
                    ftol=1e-8,
                    xtol=1e-6,
                    gtol=1e-8,
                    max_nfev=40,
                ).x
            except (ValueError, np.linalg.LinAlgError):
                return None
        return found if np.isfinite(found).all() else None


def _steps(first: np.ndarray, extent: tuple[float, float]) -> np.ndarray:
    """How far each unknown may sensibly move."""
    lean = 0.5 * min(1 / extent[0], 1 / extent[1])
    components = (len(first) - 3) // 4
    return np.array([extent[1], extent[0], 1.0] + components * [0.5, 0.3, 0.3, lean])


def _width(unknowns: np.ndarray) -> Float[np.ndarray, " 2"]:
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
    speckle: Speckle,
    spot: tuple[float, float],
    v: np.ndarray,
    u: np.ndarray,
) -> Float[np.ndarray, "2 2"]:
    """Covariance of the centre, px^2, from correlated speckle under the fitted spot.

    Args:
        weights: (2, rows, columns) derivatives of the centre by each pixel; zero if not fitted.
        value: (rows, columns) the fitted envelope.
        misfit: mean squared residual.
        speckle: the background's.
        spot: SDs of the spot along v and u, px.
        v: (rows,) of the window, px.
        u: (columns,) of the window, px.
    """
    # Variance of a Rician envelope, interpolated between that of a Rayleigh envelope (no signal)
    # and sigma^2 (strong signal).
    rayleigh = 2 - np.pi / 2
    signal = np.maximum(value**2 - value.min() ** 2, 0.0) / (2 * speckle.sigma**2)
    variance = speckle.sigma**2 * (1 - (1 - rayleigh) * np.exp(-signal))
    covariance = spread(weights * np.sqrt(variance), speckle.size, v, u)
    # A spot of another shape fits worse than speckle explains. The misfit is correlated over
    # lengths like those of the spot itself.
    expected = float(np.mean(variance[weights.any(axis=0)]))
    if misfit > _EXCESS * expected:
        covariance += spread(weights * np.sqrt(misfit - expected), spot, v, u)
    return covariance + FINEST_SD**2 * np.eye(2)
