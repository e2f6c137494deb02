"""Time alignment: poses between samples, a device's clock against the host's, a stream's latency.

A pose and an image that belong together have time stamps of different clocks. Three steps match
them: :func:`fit_clock` converts device stamps to the host's clock; :func:`fitted_lag` finds
the remaining time by which images lag behind poses, from a target at rest;
:func:`interpolate_poses` gives the pose at an image's time, and refuses where it would have to
guess.

Numpy and scipy throughout: this runs once a recording, on hundreds of samples a second at most.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import (
    check_poses,
    matrices_from_rotations,
    rotations_from_vectors,
    vectors_from_rotations,
)
from jaxcal.runtime.array_types import Bool, Float, Int
from jaxcal.runtime.given_values import real_array
from jaxcal.runtime.messages import seconds

LEVER_MM = 100.0
"""The lever, from the tracked origin: about the distance of a target from the probe's marker."""

LARGEST_LAG_S = 0.5
"""Largest lag looked for, in both directions."""

LARGEST_LAG_SD_S = 0.02
"""Largest SD of a lag that is used: a probe moves by about a millimetre in this time."""

VELOCITY_S = 0.05
"""A velocity is that of the motion from so long before to so long after: hands shake slower, and
the tracker's noise of 0.1 mm becomes 1.4 mm/s."""

LAG_EVIDENCE = 25.0
"""A lag is reported if its evidence is larger: a normal variable's square at 5 SD."""

_COARSEST_S = 1e-3
"""A clock's times, as seconds, have digits for at least a millisecond."""
_FIT_STEP_S, _FINE_STEPS = 0.025, 11
"""Between lags that are tried; and how many more are tried about the best one."""
_FIT_IMAGES = 12, 200
"""Least and most images that are fitted at every lag."""


def _increasing(t: np.ndarray, what: str) -> Float[np.ndarray, " n"]:
    times = real_array(t, what)
    if times.ndim != 1 or len(times) < 2:
        raise InputError(f"{what} must be a row of 2 times or more, not {times.shape}")
    if not np.isfinite(times).all():
        raise InputError(f"{what} {np.flatnonzero(~np.isfinite(times))[0]} is not a number")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise InputError(f"{what} {back[0] + 1} is not later than the one before")
    return times


def can_interpolate(
    t: np.ndarray, query: np.ndarray, *, max_gap_s: float, valid: np.ndarray | None = None
) -> Bool[np.ndarray, " m"]:
    """Which query times lie between two valid poses that are near enough to one another.

    Args:
        t: (n,) times of the poses, s, increasing.
        query: (m,) times asked for, s.
        max_gap_s: longest time between neighbouring poses that is bridged.
        valid: (n,) bool; False where a pose cannot be used. None: all can.

    Raises:
        InputError: times out of order or not numbers.
    """
    times = _increasing(t, "time of pose")
    asked = _queries(query)
    usable = np.ones(len(times), bool) if valid is None else np.asarray(valid, bool)
    if usable.shape != times.shape:
        raise InputError(f"valid must have one value for each of {len(times)} poses")
    inside = (asked >= times[0]) & (asked <= times[-1])
    before = _interval(times, np.where(inside, asked, times[0]))
    on_sample = asked == times[before]
    on_next = asked == times[before + 1]
    near = times[before + 1] - times[before] <= max_gap_s
    between = usable[before] & usable[before + 1] & near
    return inside & (between | (on_sample & usable[before]) | (on_next & usable[before + 1]))


def _queries(query: np.ndarray) -> Float[np.ndarray, " m"]:
    asked = real_array(query, "the times asked for")
    if asked.ndim != 1:
        raise InputError(f"the times asked for must be a row of numbers, not {asked.shape}")
    return asked


def _interval(times: np.ndarray, asked: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(times, asked, side="right") - 1, 0, len(times) - 2)


def interpolate_poses(
    t: np.ndarray,
    poses: np.ndarray,
    query: np.ndarray,
    *,
    max_gap_s: float,
    valid: np.ndarray | None = None,
) -> Float[np.ndarray, "m 4 4"]:
    """Poses at other times: translation linearly, rotation along the shortest arc (slerp).

    The arguments are those of :func:`can_interpolate`, and ``poses`` (n, 4, 4), mm.

    Returns:
        (m, 4, 4) poses, mm.

    Raises:
        InputError: a time before the first pose or after the last, in a gap, or next to a pose
            that cannot be used; the time is named. :func:`can_interpolate` checks it beforehand.
    """
    times = _increasing(t, "time of pose")
    asked = _queries(query)
    if np.shape(poses)[:1] != times.shape:
        raise InputError(f"there are {np.shape(poses)[0]} poses and {len(times)} times")
    refused = np.flatnonzero(~can_interpolate(times, asked, max_gap_s=max_gap_s, valid=valid))
    if len(refused):
        row = int(refused[0])
        raise InputError(
            f"no pose for time {row} ({seconds(asked[row])}): it is outside "
            f"{seconds(times[0])} to {seconds(times[-1])}, in a gap longer than {max_gap_s:g} s, "
            "or next to a pose that cannot be used"
        )
    sound = check_poses(np.asarray(poses), None if valid is None else np.asarray(valid, bool))
    before = _interval(times, asked)
    first, second = sound[before], sound[before + 1]
    share = ((asked - times[before]) / (times[before + 1] - times[before]))[:, None]
    turn = vectors_from_rotations(np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3])
    turned = first[:, :3, :3] @ rotations_from_vectors(share * turn)
    moved = first[:, :3, 3] + share * (second[:, :3, 3] - first[:, :3, 3])
    return matrices_from_rotations(turned, moved)


def interpolation_error(
    t: np.ndarray, poses: np.ndarray, query: np.ndarray, *, max_gap_s: float
) -> float:
    """About how wrong :func:`interpolate_poses` is, from poses that are left out and interpolated.

    Between poses h apart, the path's acceleration a gives an error of a s (1 - s) h^2 / 2 at the
    share s of the way. A pose that is interpolated from its two neighbours shows a; the tracker's
    noise counts as well. Of faster motions than the poses can show it is an underestimate.

    Args:
        t: (n,) times of the poses, s, increasing.
        poses: (n, 4, 4), mm.
        query: (m,) times between them, s.
        max_gap_s: poses whose neighbours are farther apart than twice this are not left out.

    Returns:
        Root mean square over the queries and over points up to ``LEVER_MM`` from the tracked
        origin, mm; 0 where nothing can be left out.
    """
    times = _increasing(t, "time of pose")
    # Of a long tracking only the poses about the queries are looked at.
    near = np.unique(_interval(times, query)[:, None] + np.arange(-1, 3))
    near = near[(near >= 0) & (near < len(times))]
    times, poses, squares = times[near], poses[near], np.full(len(near), np.nan)
    if len(times) < 4:
        return 0.0
    for first in (0, 1):
        kept = slice(first, None, 2)
        left_out = np.arange(1 + first, len(times) - 1, 2)
        found = interpolate_poses(times[kept], poses[kept], times[left_out], max_gap_s=np.inf)
        apart = (found - poses[left_out])[:, :3]
        # Of the tracked origin, and of a point on each of its axes.
        apart = apart[..., 3:] + LEVER_MM * np.pad(apart[..., :3], [(0, 0), (0, 0), (1, 0)])
        squares[left_out] = np.mean(np.sum(apart**2, axis=1), axis=1)
    before, after = np.diff(times[:-1]), np.diff(times[1:])
    squares[1:-1][before + after > 2 * max_gap_s] = np.nan
    # (a / 2)^2
    squares[1:-1] /= (before * after) ** 2
    interval = _interval(times, query)
    ends = np.stack([squares[interval], squares[interval + 1]])
    known = np.isfinite(ends).any(axis=0)
    if not known.any():
        return 0.0
    since, left = query - times[interval], times[interval + 1] - query
    return float(np.sqrt(np.mean(np.nanmean(ends[:, known], axis=0) * (since * left)[known] ** 2)))


def pose_velocities(
    t: np.ndarray,
    poses: np.ndarray,
    query: np.ndarray,
    *,
    max_gap_s: float,
    valid: np.ndarray | None = None,
) -> Float[np.ndarray, "m 6"]:
    """How the tracked probe moves, from poses ``VELOCITY_S`` before and after each time.

    The arguments are those of :func:`can_interpolate`, and ``poses`` (n, 4, 4), mm.

    Returns:
        Velocities [v, omega] in the probe's own frame, so that the pose s later is the pose times
        Exp(s [v, omega]): mm/s and rad/s. NaN where a pose before or after cannot be interpolated.

    Raises:
        InputError: times out of order or not numbers, or poses that are not rigid.
    """
    ends = np.stack([_queries(query) - VELOCITY_S, _queries(query) + VELOCITY_S])
    between = can_interpolate(t, ends.ravel(), max_gap_s=max_gap_s, valid=valid)
    known = between.reshape(ends.shape).all(axis=0)
    found = interpolate_poses(t, poses, ends[:, known].ravel(), max_gap_s=max_gap_s, valid=valid)
    before, after = found.reshape(2, -1, 4, 4)
    turn = vectors_from_rotations(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    halfway = before[:, :3, :3] @ rotations_from_vectors(turn / 2)
    moved = np.einsum("mji,mj->mi", halfway, after[:, :3, 3] - before[:, :3, 3])
    velocity = np.full((ends.shape[1], 6), np.nan)
    velocity[known] = np.hstack([moved, turn]) / (2 * VELOCITY_S)
    return velocity


@dataclass(frozen=True)
class ClockFit:
    """A device's clock in terms of the host's: host = device + offset + drift (device - reference).

    Attributes:
        offset_s: host minus device at the reference. It includes the shortest delay, since stamps
            alone cannot tell a late clock from a late message.
        drift: seconds per second by which the host's clock gains.
        reference_s: device time at which the offset holds.
        delay_s: (n,) s, residuals: by how much each sample was later than the line.
    """

    offset_s: float
    drift: float
    reference_s: float
    delay_s: Float[np.ndarray, " n"]


def fit_clock(t_device: np.ndarray, t_host: np.ndarray) -> ClockFit:
    """Offset and drift between a device's clock and the host's, from stamps of the same samples.

    Messages come late, never early. The line lies below all samples (device, host - device) and
    has the least sum of distances to them. It is the edge of their lower convex hull at the mean
    device time (Moon, Skelly and Towsley 1999, "Estimation and removal of clock skew from network
    delay measurements", INFOCOM, who solve a linear programme). Load on the host, which delays many
    samples by much, does not move the line; a single stamp that is wrongly early does.

    Args:
        t_device: (n,) device times, s, increasing.
        t_host: (n,) host times of arrival, s.

    Raises:
        InputError: fewer than two samples, device times out of order, host times that do not
            increase with them, values that are not finite or too large for seconds.
    """
    device = _increasing(t_device, "device time")
    host = real_array(t_host, "host times")
    if host.shape != device.shape or not np.isfinite(host).all():
        raise InputError(f"host times must be {len(device)} numbers, one for each device time")
    for what, values in (("device", device), ("host", host)):
        if np.spacing(np.abs(values).max()) > _COARSEST_S:
            raise InputError(f"{what} times of {np.abs(values).max():.3g} are no seconds")
    # Seconds since 1970 have few digits left for microseconds: count from the first sample.
    reference = float(device[0])
    x, y = device - reference, host - device
    base = float(y[0])
    drift, level = _lower_envelope(x, y - base)
    if drift <= -1:
        raise InputError("host times must increase with the device times")
    return ClockFit(base + level, drift, reference, y - base - level - drift * x)


def _lower_envelope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and level of the edge that the lower convex hull has at the mean of x."""
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            # A corner lies below the line from the one before it to the new point.
            if (y[b] - y[a]) * (x[i] - x[a]) < (y[i] - y[a]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(i)
    edge = int(np.clip(np.searchsorted(x[hull], x.mean(), side="right") - 1, 0, len(hull) - 2))
    a, b = hull[edge], hull[edge + 1]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return slope, float(y[a] - slope * x[a])


@dataclass(frozen=True)
class FittedLag:
    """The lag at which images of a target at rest fit the poses best.

    Attributes:
        lag_s: an image stamped t fits the pose at t - lag best.
        sd_s: standard deviation of the lag, s, if the errors lie along the motion; else it is
            smaller. Infinite at the edge of the search.
        misfit_mm: root mean square distance of the images' targets from one place, at this lag.
        given_mm: the same without a lag.
        evidence: how much larger the sum of squares is without a lag, in variances of one image;
            the square of a standard normal if there is none.
        contrast: the same of the lag that fits worst; small if the probe hardly moved.
        rival_s: another lag that fits about as well, as in a periodic motion; None if none does.
    """

    lag_s: float
    sd_s: float
    misfit_mm: float
    given_mm: float
    evidence: float
    contrast: float
    rival_s: float | None


def fitted_lag(
    t_image: np.ndarray,
    points: np.ndarray,
    t: np.ndarray,
    poses: np.ndarray,
    *,
    max_gap_s: float,
    valid: np.ndarray | None = None,
) -> FittedLag | None:
    """Lag of the images behind the poses from a target at rest, whatever the probe's motion.

    At every lag up to ``LARGEST_LAG_S``, in both directions, the target's place and an affine map
    from image to probe are fitted to the images by linear least squares. Parabolas refine the lags
    at which the sum of squares is lowest. A probe that is held still for each image tells nothing:
    the evidence is then small.

    PLUS correlates one coordinate of the images and of the probe instead (Lasso et al. 2014, IEEE
    Trans. Biomed. Eng. 61, 2527), which takes a motion along one line.

    Args:
        t_image: (n,) stamps of the images, s, on the tracker's clock.
        points: (n, 2) the target in them, px or mm.
        t: (m,) times of the poses, s, increasing.
        poses: (m, 4, 4), probe -> tracker, mm.
        max_gap_s: longest time between neighbouring poses that is bridged.
        valid: (m,) bool; False where a pose cannot be used. None: all can.

    Returns:
        None if there are too few images with poses at all lags, or if nothing can be fitted.

    Raises:
        InputError: times out of order or not numbers, or poses that are not rigid.
    """
    steps = round(LARGEST_LAG_S / _FIT_STEP_S)
    lags = np.arange(-steps, steps + 1) * _FIT_STEP_S
    stamps = np.asarray(t_image)
    asked = stamps[:, None] - lags
    # The same images at every lag: a lag with fewer images could win by chance.
    between = can_interpolate(t, asked.ravel(), max_gap_s=max_gap_s, valid=valid)
    rows = np.flatnonzero(between.reshape(asked.shape).all(axis=1))
    least, most = _FIT_IMAGES
    if len(rows) < least:
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(int))]
    centred = np.asarray(points)[rows] - np.mean(np.asarray(points)[rows], axis=0)
    size = np.sqrt(np.mean(centred**2))
    lasting = float(np.ptp(stamps[rows]))
    if not size > 0 or not lasting > 0:
        return None
    plane = np.column_stack([centred / size, np.ones(len(rows))])

    def fitted_at(lags: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k n 3"]:
        asked = (stamps[rows, None] - lags).ravel()
        found = interpolate_poses(t, poses, asked, max_gap_s=max_gap_s, valid=valid)
        found = found.reshape(len(rows), len(lags), 4, 4)
        return np.stack([_affine_residuals(found[:, k], plane) for k in range(len(lags))])

    def squares_at(lags: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        return np.sum(fitted_at(lags) ** 2, axis=(1, 2))

    coarse = squares_at(lags)
    at_zero = coarse[steps]
    lags, squares, bottoms = _refined(lags, coarse, squares_at)
    best = int(np.argmin(squares))
    # Most of the misfit is the target's distance from the image plane: one number an image. The
    # affine map, the target's place and the lag have 13 unknowns, for three coordinates an image.
    variance = squares[best] / (len(rows) - 13 / 3)
    # Errors of images taken at short intervals are alike, and count as fewer.
    variance *= max((len(rows) - 1) * LARGEST_LAG_S / lasting, 1.0)
    if not variance > 0:
        return None
    sd = np.inf
    if best in bottoms:
        # As wide as a hand's motion allows: the tracker's noise would pass for motion.
        largest = LARGEST_LAG_S - _FIT_STEP_S
        middle = np.clip(lags[best], -largest, largest)
        behind, ahead = fitted_at(middle + _FIT_STEP_S * np.array([-1, 1]))
        motion = np.sum((ahead - behind) ** 2)
        sd = float(2 * _FIT_STEP_S * np.sqrt(variance / motion)) if motion > 0 else np.inf
    misfit, given = np.sqrt([squares[best] / len(rows), at_zero / len(rows)])
    evidence = (squares - squares[best]) / variance
    return FittedLag(
        float(lags[best]),
        sd,
        float(misfit),
        float(given),
        float((at_zero - squares[best]) / variance),
        float(evidence.max()),
        _rival(lags, evidence),
    )


def _refined(
    lags: Float[np.ndarray, " k"],
    squares: Float[np.ndarray, " k"],
    squares_at: Callable[[Float[np.ndarray, " j"]], Float[np.ndarray, " j"]],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Int[np.ndarray, " b"]]:
    """Lags and sums of squares with every local minimum at its place, and which these are.

    Between two lags that are tried a fast motion may fit far better than at either.
    """
    lags, squares = lags.copy(), squares.copy()
    bottoms = 1 + np.flatnonzero((squares[1:-1] <= squares[:-2]) & (squares[1:-1] < squares[2:]))
    for bottom in bottoms:
        near = _FIT_STEP_S * np.linspace(-1, 1, _FINE_STEPS)
        closely = squares_at(lags[bottom] + near)
        lowest = min(max(int(np.argmin(closely)), 2), _FINE_STEPS - 3)
        part = slice(lowest - 2, lowest + 3)
        bend, slope, level = np.polyfit(near[part] - near[lowest], closely[part], 2)
        lags[bottom] += near[lowest]
        squares[bottom] = closely[lowest]
        if bend > 0 and abs(slope) < 2 * bend * 3 * (near[1] - near[0]):
            lags[bottom] -= slope / (2 * bend)
            squares[bottom] = level - slope**2 / (4 * bend)
    return lags, squares, bottoms


def _rival(lags: Float[np.ndarray, " k"], above: Float[np.ndarray, " k"]) -> float | None:
    """Another lag that fits about as well as the best one, behind lags that fit far worse."""
    best = int(np.argmin(above))
    for other in np.flatnonzero(above < LAG_EVIDENCE):
        if above[min(best, other) : max(best, other) + 1].max() > 2 * LAG_EVIDENCE:
            return float(lags[other])
    return None


def _affine_residuals(
    poses: Float[np.ndarray, "n 4 4"], plane: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """R M q + t - c of every image, mm; the matrix M and the place c are fitted."""
    turn, count = poses[:, :3, :3], len(poses)
    of_map = np.einsum("nij,nl->nijl", turn, plane).reshape(count, 3, 9)
    design = np.concatenate([of_map, np.tile(-np.eye(3), (count, 1, 1))], axis=2).reshape(-1, 12)
    # About the mean, whose distance from the tracker would cost digits.
    wanted = -(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)).ravel()
    solution = np.linalg.lstsq(design, wanted, rcond=None)[0]
    return (design @ solution - wanted).reshape(count, 3)
