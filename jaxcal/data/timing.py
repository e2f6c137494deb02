"""Time alignment: poses between samples, a device's clock against the host's, a stream's latency.

A pose and an image that belong together have time stamps of different clocks. Three steps match
them: :func:`fit_clock` converts device stamps to the host's clock; :func:`estimate_latency` finds
the remaining time by which images lag behind poses, from a motion that both show;
:func:`interpolate_poses` gives the pose at an image's time, and refuses where it would have to
guess.

Numpy and scipy throughout: this runs once a recording, on hundreds of samples a second at most.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxcal import InputError
from jaxcal.data.poses import check_poses
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.given_values import real_array
from jaxcal.runtime.messages import seconds

MINIMUM_MOTION_MM = 8.0
"""Least motion from which a latency is estimated."""

LEVER_MM = 100.0
"""The lever, from the tracked origin: about the distance of a target from the probe's marker."""

LARGEST_LAG_S = 0.5
"""Largest lag looked for, in both directions."""

LARGEST_LAG_SD_S = 0.02
"""Largest SD of a lag that is used: a probe moves by about a millimetre in this time."""

_TILT = np.tan(np.radians(30.0))

_LAG_STEP_S = 1e-3
_SHORTEST_OVERLAP_S = 1.0
_RIVAL = 0.98
_MINIMUM_CORRELATION = 0.8
_COARSEST_S = 1e-3
"""A clock's times, as seconds, have digits for at least a millisecond."""
_PARABOLA_STEPS, _TOP = 5, 0.99
_FIT_STEP_S = 0.025
_FIT_IMAGES = 12, 200
"""Least and most images that are fitted at every lag."""


def _increasing(t: np.ndarray, what: str, minimum: int = 2) -> Float[np.ndarray, " n"]:
    times = real_array(t, what)
    if times.ndim != 1 or len(times) < minimum:
        raise InputError(f"{what} must be a row of {minimum} times or more, not {times.shape}")
    if not np.isfinite(times).all():
        raise InputError(f"{what} {np.flatnonzero(~np.isfinite(times))[0]} is not a number")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise InputError(f"{what} {back[0] + 1} is not later than the one before")
    return times


def can_interpolate(
    t: np.ndarray,
    query: np.ndarray,
    *,
    max_gap_s: float,
    valid: np.ndarray | None = None,
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
    # It takes longer to import than all else that imports a table.
    from scipy.spatial.transform import Rotation, Slerp

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
    share = (asked - times[before]) / (times[before + 1] - times[before])
    turning = Slerp(times, Rotation.from_matrix(sound[:, :3, :3]))
    result = np.tile(np.eye(4), (len(asked), 1, 1))
    result[:, :3, :3] = turning(asked).as_matrix()
    result[:, :3, 3] = first[:, :3, 3] + share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    return result


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
            if (y[b] - y[a]) * (x[i] - x[a]) < (y[i] - y[a]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(i)
    edge = int(np.clip(np.searchsorted(x[hull], x.mean(), side="right") - 1, 0, len(hull) - 2))
    a, b = hull[edge], hull[edge + 1]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return slope, float(y[a] - slope * x[a])


@dataclass(frozen=True)
class Latency:
    """By how much images lag behind poses.

    Attributes:
        lag_s: an image stamped t shows what was at t - lag: its pose is the one at t - lag.
        correlation: of the two motions at that lag, -1 to 1.
        sd_s: standard deviation of the lag from the misfit of the two motions, s.
    """

    lag_s: float
    correlation: float
    sd_s: float


def estimate_latency(
    t_video: np.ndarray, video: np.ndarray, t_tracker: np.ndarray, tracker_mm: np.ndarray
) -> Latency:
    """Lag of the images behind the poses, from one motion that both show.

    As in PLUS's temporal calibration (Lasso et al. 2014, IEEE Trans. Biomed. Eng. 61, 2527): the
    probe is moved to and fro; the video's signal stays fixed, the tracker's is moved along the time
    axis in steps of a millisecond, and the normalised correlation over the same samples tells how
    well they agree. A parabola about the best lag refines it to a fraction of a step. The signals
    may have any scale and sign.

    Args:
        t_video: (n,) stamps of the images, s, on the tracker's clock.
        video: (n,) position of something at rest as the images show it, in any unit.
        t_tracker: (m,) stamps of the poses, s.
        tracker_mm: (m,) position of the probe, mm.

    Raises:
        InputError: too little motion or overlap, signals that do not agree, a best lag at the edge
            of the search, or several that fit alike (a periodic motion).
    """
    t_video = _increasing(t_video, "time of image", 8)
    t_tracker = _increasing(t_tracker, "time of pose", 8)
    video = real_array(video, "the images' motion")
    tracker = real_array(tracker_mm, "the probe's motion")
    if video.shape != t_video.shape or tracker.shape != t_tracker.shape:
        raise InputError("each motion must have one value for each of its times")
    if not (np.isfinite(video).all() and np.isfinite(tracker).all()):
        raise InputError("a motion holds NaN or Inf: leave those samples out")
    # The same images are used at every lag: a lag with fewer images could win by chance.
    used = (t_video - LARGEST_LAG_S >= t_tracker[0]) & (t_video + LARGEST_LAG_S <= t_tracker[-1])
    t, signal = t_video[used], video[used]
    if len(t) < 8 or t[-1] - t[0] < _SHORTEST_OVERLAP_S:
        needed = _SHORTEST_OVERLAP_S + 2 * LARGEST_LAG_S
        raise InputError(
            f"images and poses overlap by too little: {needed:g} s or more of both are needed"
        )
    during = tracker[(t_tracker >= t[0] - LARGEST_LAG_S) & (t_tracker <= t[-1] + LARGEST_LAG_S)]
    span = float(np.ptp(during))
    if span < MINIMUM_MOTION_MM:
        raise InputError(f"the probe moved by {span:.3g} mm; {MINIMUM_MOTION_MM:g} are needed")
    if np.ptp(signal) == 0:
        raise InputError("the images show no motion")
    steps = round(LARGEST_LAG_S / _LAG_STEP_S)
    lags = np.arange(-steps, steps + 1) * _LAG_STEP_S
    centred = signal - signal.mean()
    centred = centred / np.linalg.norm(centred)
    correlation = np.zeros(len(lags))
    for i, lag in enumerate(lags):
        moved = np.interp(t - lag, t_tracker, tracker)
        moved -= moved.mean()
        size = np.linalg.norm(moved)
        correlation[i] = centred @ moved / size if size > 0 else 0.0
    return _peak(lags, correlation, len(t))


def latency_of_positions(
    t_video: Float[np.ndarray, " n"],
    points: Float[np.ndarray, "n 2"],
    t_tracker: Float[np.ndarray, " m"],
    positions: Float[np.ndarray, "m 3"],
) -> Latency:
    """Lag of the images behind the poses, from a motion to and fro along one line.

    The images' signal is :func:`estimate_latency`'s along the direction in which their points
    differ most, and the tracker's along that of the probe. These may be different directions of
    the motion: pixels are not square, and the image shows nothing of a motion across its plane. So
    both are tilted by 30 degrees towards each of the other directions, and what that changes is
    part of the SD. It is nothing where the motion is along one line.

    Args:
        t_video: stamps of the images, s, on the tracker's clock.
        points: a target at rest in the images, px or mm.
        t_tracker: stamps of the poses, s.
        positions: of the probe, mm.

    Raises:
        InputError: as of :func:`estimate_latency`, or a motion that is not along one line.
    """
    video, tracker = _along_principal_axes(points), _along_principal_axes(positions)

    def lag(one: np.ndarray, other: np.ndarray) -> Latency:
        return estimate_latency(t_video, video @ one, t_tracker, tracker @ other)

    along = np.eye(2)[0], np.eye(3)[0]
    found = lag(*along)
    variance = found.sd_s**2
    for towards in np.eye(5)[[1, 3, 4]]:
        tilt = _TILT * towards[:2], _TILT * towards[2:]
        try:
            ahead = lag(along[0] + tilt[0], along[1] + tilt[1]).lag_s
            behind = lag(along[0] - tilt[0], along[1] - tilt[1]).lag_s
        except InputError:
            variance = np.inf
            break
        variance += ((ahead - behind) / 2) ** 2
    if variance > LARGEST_LAG_SD_S**2:
        raise InputError(
            "the probe was not moved along one line, so the lag cannot be told: move it to and fro "
            "along one line of the image"
        )
    return replace(found, sd_s=float(np.sqrt(variance)))


@dataclass(frozen=True)
class FittedLag:
    """The lag at which images of a target at rest fit the poses best.

    Attributes:
        lag_s: an image stamped t fits the pose at t - lag best.
        sd_s: standard deviation of the lag, s; infinite at the edge of the search.
        misfit_mm: root mean square distance of the images' targets from one place, at this lag.
        given_mm: the same without a lag.
        evidence: how much larger the sum of squares is without a lag, in variances of one image;
            the square of a standard normal if there is none.
    """

    lag_s: float
    sd_s: float
    misfit_mm: float
    given_mm: float
    evidence: float


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
    from image to probe are fitted to the images by linear least squares. A parabola through the
    least sum of squares and its neighbours refines the lag. A probe that is held still for each
    image tells nothing: the evidence is then small.

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
    asked = np.asarray(t_image)[:, None] - lags
    # The same images at every lag: a lag with fewer images could win by chance.
    between = can_interpolate(t, asked.ravel(), max_gap_s=max_gap_s, valid=valid)
    rows = np.flatnonzero(between.reshape(asked.shape).all(axis=1))
    least, most = _FIT_IMAGES
    if len(rows) < least:
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(int))]
    found = interpolate_poses(t, poses, asked[rows].ravel(), max_gap_s=max_gap_s, valid=valid)
    found = found.reshape(len(rows), len(lags), 4, 4)
    centred = np.asarray(points)[rows] - np.mean(np.asarray(points)[rows], axis=0)
    size = np.sqrt(np.mean(centred**2))
    if not size > 0 or not np.ptp(np.asarray(t_image)[rows]) > 0:
        return None
    plane = np.column_stack([centred / size, np.ones(len(rows))])
    squares = np.array([_affine_misfit(found[:, k], plane) for k in range(len(lags))])
    best = int(np.argmin(squares))
    # Most of the misfit is the target's distance from the image plane: one number an image. The
    # affine map, the target's place and the lag have 13 unknowns, for three coordinates an image.
    variance = squares[best] / (len(rows) - 13 / 3)
    # Errors of images taken at short intervals are alike, and count as fewer.
    lasting = float(np.ptp(np.asarray(t_image)[rows]))
    variance *= max((len(rows) - 1) * LARGEST_LAG_S / lasting, 1.0)
    lag, sd = float(lags[best]), np.inf
    if 0 < best < len(lags) - 1:
        bend, slope, _ = np.polyfit(
            lags[best - 1 : best + 2] - lag, squares[best - 1 : best + 2], 2
        )
        if bend > 0:
            lag, sd = lag - slope / (2 * bend), float(np.sqrt(variance / bend))
    if not variance > 0:
        return None
    misfit, given = np.sqrt(squares[[best, steps]] / len(rows))
    evidence = (squares[steps] - squares[best]) / variance
    return FittedLag(float(lag), sd, float(misfit), float(given), float(evidence))


def _affine_misfit(poses: Float[np.ndarray, "n 4 4"], plane: Float[np.ndarray, "n 3"]) -> float:
    """Sum of squares of R M q + t - c over images; the matrix M and the place c are fitted."""
    turn, count = poses[:, :3, :3], len(poses)
    of_map = np.einsum("nij,nl->nijl", turn, plane).reshape(count, 3, 9)
    design = np.concatenate([of_map, np.tile(-np.eye(3), (count, 1, 1))], axis=2).reshape(-1, 12)
    # About the mean, whose distance from the tracker would cost digits.
    wanted = -(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)).ravel()
    solution = np.linalg.lstsq(design, wanted, rcond=None)[0]
    return float(np.sum((design @ solution - wanted) ** 2))


def _along_principal_axes(positions: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Positions along the directions in which they differ most, then next, ...; signs are free."""
    centred = positions - positions.mean(axis=0)
    return centred @ np.linalg.eigh(centred.T @ centred)[1][:, ::-1]


def _peak(lags: np.ndarray, correlation: np.ndarray, samples: int) -> Latency:
    strength = np.abs(correlation)
    best = int(np.argmax(strength))
    if strength[best] < _MINIMUM_CORRELATION:
        raise InputError(
            f"images and poses do not show the same motion (correlation {strength[best]:.2f})"
        )
    if best in (0, len(lags) - 1):
        raise InputError(
            f"the lag is {lags[best]:.3g} s or beyond, where the search ends: subtract about that "
            "from the images' times, and estimate the rest"
        )
    middle = strength[1:-1]
    tops = 1 + np.flatnonzero((middle >= strength[:-2]) & (middle > strength[2:]))
    least = _RIVAL * strength[best]
    for other in tops:
        # The tracker's noise makes ripples on a broad peak: a rival has a valley in between.
        valley = strength[min(best, other) : max(best, other) + 1].min()
        if strength[other] > least > valley:
            raise InputError(
                f"lags of {lags[best]:.3f} and {lags[other]:.3f} s fit equally well: move the "
                "probe less regularly"
            )
    # Interpolation between samples, and the tracker's noise, make kinks: the parabola is wider. By
    # 0.99 of the peak, terms of higher order do not matter yet.
    broad = np.flatnonzero(strength < _TOP * strength[best])
    half = int(np.min(np.abs(broad - best), initial=len(lags))) - 1
    half = min(max(half, _PARABOLA_STEPS), best, len(lags) - 1 - best)
    near = slice(best - half, best + half + 1)
    bend, slope, top = np.polyfit(lags[near] - lags[best], strength[near], 2)
    if bend >= 0:
        raise InputError("the correlation has no clear peak: move the probe farther or faster")
    shift = float(np.clip(-slope / (2 * bend), -half * _LAG_STEP_S, half * _LAG_STEP_S))
    # With unit signals, the lag's variance is that of the misfit, (1 - r^2) / n, divided by the
    # power of the slope, (-r'' / r) r^2.
    top = min(float(top), 1.0)
    sd = float(np.sqrt((1 - top**2) / (samples * top * -2 * bend)))
    return Latency(float(lags[best]) + shift, float(correlation[best]), sd)
