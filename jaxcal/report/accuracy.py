"""How accurate a calibration is and what limits it, as plain values.

The main number is the target registration error (TRE) to expect at the image: its root mean square
over the region that the target filled, with a 95 % interval (:mod:`jaxcal.diagnostics.intervals`).
It comes from the covariance, which assumes that the noise model holds. If the data contradict it
(:mod:`jaxcal.report.contradictions`), the expected error is larger, and the larger number is
reported.

The word of the verdict (good, fair or uncertain) depends on this number and on the upper end of its
interval (:mod:`jaxcal.report.thresholds`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.calibration.serial_correlation import slowness
from jaxcal.data.poses import targets_in_images
from jaxcal.data.recording import LARGEST, Recording
from jaxcal.design.candidates import seen_region
from jaxcal.design.constraints import Region
from jaxcal.diagnostics.clipped import clipped
from jaxcal.diagnostics.gaussian_offsets import away_from_gaussian
from jaxcal.diagnostics.image_errors import KINDS, ImageErrors, noise_covariance
from jaxcal.diagnostics.influence import Influence, conventional_fit, excess, in_image, influence_of
from jaxcal.diagnostics.intervals import image_jacobian, predicted_tre, tre_at, tre_over
from jaxcal.diagnostics.outlier_agreement import agreeing_outliers, apart_in_image
from jaxcal.diagnostics.unmodelled import MOTIONS, Unmodelled, unmodelled
from jaxcal.diagnostics.warnings import different_poses
from jaxcal.model.image_points import mean_of_squares
from jaxcal.report.contradictions import contradictions
from jaxcal.report.thresholds import FAIR_MM, GOOD_MM, WIDEST
from jaxcal.result.calibration import Calibration
from jaxcal.result.saved import ASKED_FOR
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.runtime.given_values import real_array
from jaxcal.solvers.closed_form.single import in_closed_form, solve_problem

_ACROSS = 15
"""Number of points along each side of the map."""
_MOST_NAMED = 5
NEARLY = 6.0
"""Errors are nearly as likely as the clearest one if their 2 ln LR is smaller by less than this."""


def accuracy_record(
    result: Calibration, recording: Recording, wanted: tuple[tuple[float, float], ...] = ()
) -> dict[str, Any]:
    """``tre``, ``limits``, ``influence`` and ``comparison`` of a calibration's record.

    Args:
        result: of one problem.
        recording: with the images of the solve (:func:`as_solved`).
        wanted: further image points for the error, in the images' own unit (px or mm).

    Returns:
        Arrays and plain values; all of them None where the calibration must not be used, or where
        its lengths may not be in mm.
    """
    nothing = {"tre": None, "limits": None, "influence": None, "comparison": None}
    answer = result.numpy()
    determined = np.isfinite(answer.unknowns_covariance).all() and bool(result.converged)
    if not determined or result.wrong_frames is not None or result.doubtful_unit is not None:
        return nothing
    region = region_of(answer, recording)
    grid = region.grid()[:, [0, 2]]
    weight = mean_of_squares(image_jacobian(answer, grid))
    found = influence_of(answer)
    tre = _tre(answer, region, wanted)
    influence = _influence(found, weight, np.asarray(answer.mask) > 0)
    ratio, chance = excess(found, weight)
    tre["residuals_over_stated"] = math.sqrt(ratio) if ratio > 0 else None
    tre["chance"] = chance
    tre["unmodelled"] = _unmodelled(answer, grid, recording.calibration.velocity)
    away = away_from_gaussian(answer, grid)
    tre["gaussian_offsets"] = away and dict(zip(("apart_mm", "error_mm"), away, strict=True))
    tre["different_poses"] = different_poses(answer)
    tre["slow_path"] = slowness(recording.calibration.poses[np.asarray(answer.mask) > 0])
    agreeing = agreeing_outliers(answer, float(tre["stated_mm"]), grid)
    edge = clipped(answer, grid)
    tre["clipped"] = edge and vars(edge)
    tre["left_out"] = agreeing and dict(zip(("images", "apart_mm"), agreeing, strict=True))
    return {
        "tre": tre,
        "limits": _limits(answer, found, weight),
        "influence": influence,
        "comparison": _comparison(answer, found, weight, grid),
    }


def as_solved(recording: Recording, answer: Calibration) -> Recording:
    """The recording with the images of the solve, in which every pose counts once."""
    problem = answer.problem
    assert problem is not None
    images = replace(
        recording.calibration,
        poses=np.asarray(problem.poses, float),
        measurements=np.asarray(problem.measurements, float),
        mask=np.asarray(problem.mask) > 0,
    )
    return replace(recording, calibration=images)


def region_of(answer: Calibration, recording: Recording) -> Region:
    """The part of the image that the target filled, and the face of the probe if it is known."""
    used = np.asarray(answer.mask) > 0
    targets = targets_in_images(recording.calibration.poses, answer.image_to_probe, answer.point)
    return seen_region(recording, targets[used], answer.image_transform())


def _tre(
    answer: Calibration, region: Region, wanted: tuple[tuple[float, float], ...]
) -> dict[str, Any]:
    over = tre_over(answer, region.grid()[:, [0, 2]])
    names = ("middle", "near left", "near right", "far left", "far right")
    unit = np.array([[0.0, 0.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    places = region.place(unit)[:, [0, 2]]
    transform = answer.image_transform()
    pixels = transform.scale_mm_per_px is not None
    image = transform.image_points(places)
    given = real_array(wanted, "tre_points")
    if given.size:
        if given.ndim != 2 or given.shape[1] != 2:
            raise InputError(f"tre_points must be pairs of numbers, not of shape {given.shape}")
        if not (np.abs(given) <= LARGEST).all():
            raise InputError(f"tre_points (--tre) must be numbers up to {LARGEST:g}")
        names += (ASKED_FOR,) * len(given)
        image = np.concatenate([image, given])
        places = np.concatenate([places, transform.in_plane(given)[:, [0, 2]]])
    at = tre_at(answer, places)
    cells = region.grid(_ACROSS, _ACROSS).reshape(_ACROSS, _ACROSS, 3)[..., [0, 2]]
    mapped = tre_at(answer, cells)
    return {
        "region": vars(region),
        "image_share": _image_share(image, answer.frame_size) if pixels else None,
        "unit": "px" if pixels else "mm",
        "stated_mm": over.rms,
        "stated_interval_mm": [over.lower, over.upper],
        "points": [
            {
                "name": name,
                "image": image[k],
                "position_mm": places[k],
                "stated_mm": at.rms[k],
                "stated_interval_mm": [at.lower[k], at.upper[k]],
            }
            for k, name in enumerate(names)
        ],
        "map": {
            "lateral_mm": cells[..., 0],
            "axial_mm": cells[..., 1],
            "stated_mm": mapped.rms,
            "stated_lower_mm": mapped.lower,
            "stated_upper_mm": mapped.upper,
        },
    }


def _image_share(image: Float[np.ndarray, "k 2"], frame_size: tuple[int, int] | None) -> float:
    """The region's share of the frame; of the least frame that holds it where none is known.

    Args:
        image: [u, v] of the region's middle and corners, px.
        frame_size: (columns, rows), px.
    """
    low, high = image[:5].min(axis=0), image[:5].max(axis=0)
    size = high - np.minimum(low, 0.0) if frame_size is None else frame_size
    return float(np.prod((high - low) / size))


def _influence(
    found: Influence, weight: Float[np.ndarray, "p p"], used: np.ndarray
) -> dict[str, Any]:
    moved, expected = in_image(found, weight)
    known = used & np.isfinite(moved)
    strongest = [int(k) for k in np.argsort(-moved)[:_MOST_NAMED] if known[k]]
    return {
        "moved_mm": np.where(used, moved, np.nan),
        "expected_mm": np.where(used, expected, np.nan),
        "most": strongest,
    }


def _limits(
    answer: Calibration, found: Influence, weight: Float[np.ndarray, "p p"]
) -> dict[str, Any]:
    """Shares of the mean square error at the image, and of the scatter of the target."""
    lateral, axial, elevational = _mean_squares(answer)
    return {
        "error_share": dict(zip(KINDS, error_shares(answer, found, weight), strict=True)),
        "scatter_share": dict(zip(KINDS, scatter_shares(answer), strict=True)),
        "rms_lateral_mm": math.sqrt(lateral),
        "rms_axial_mm": math.sqrt(axial),
        "rms_elevational_mm": math.sqrt(elevational),
        "rms_in_plane_mm": math.sqrt(lateral + axial),
    }


def error_shares(
    answer: Calibration, found: Influence, weight: Float[np.ndarray, "p p"]
) -> Float[np.ndarray, " kinds"]:
    """Shares of :data:`KINDS` in the mean square error at the image; NaN if not known."""
    part = np.einsum("pq,kpq->k", weight, found.shares)
    if not np.isfinite(part).all() or not part.sum() > 0:
        return np.full(len(KINDS), np.nan)
    if answer.prior == "bounded":
        # All kinds have one variance there: scale the shares by the kinds' own variances.
        part = part * np.asarray(answer.sigma, float) ** 2
    return part / part.sum()


def _mean_squares(answer: Calibration) -> Float[np.ndarray, " kinds"]:
    """Mean square residual of each of :data:`KINDS`, mm^2."""
    residual = np.asarray(answer.residual)[np.asarray(answer.mask) > 0]
    return np.mean(residual**2, axis=0)[[0, 2, 1]]


def scatter_shares(answer: Calibration) -> Float[np.ndarray, " kinds"]:
    """Shares of :data:`KINDS` in the mean square residual; NaN if there is none."""
    squares = _mean_squares(answer)
    whole = float(squares.sum())
    return squares / whole if whole > 0 else np.full(len(KINDS), np.nan)


def _unmodelled(
    answer: Calibration, grid: Float[np.ndarray, "m 2"], velocity: Float[np.ndarray, "n 6"] | None
) -> dict[str, Any] | None:
    """The clearest error that the model leaves out, and how far it moves the image.

    Such errors can look alike, so ``also`` is the next one if it is nearly as likely.
    """
    found = unmodelled(answer, velocity)
    if not found:
        return None
    jacobian = np.asarray(image_jacobian(answer, grid))

    def told(one: Unmodelled) -> dict[str, Any]:
        moved, slip = one.moved(grid, jacobian, answer)
        return {
            "kind": one.kind,
            "values": one.values,
            "tracker_share": one.tracker_share,
            "statistic": one.statistic,
            "moved_mm": moved,
            "slip_mm": slip if one.kind in ("slip", "step") else None,
            "image": one.image,
            "images": list(one.images) or None,
        }

    first = found[0]
    near = (each for each in found[1:] if first.statistic - each.statistic < NEARLY)
    # The advice about one motion covers the others.
    also = next((each for each in near if {first.kind, each.kind} - MOTIONS), None)
    return {**told(first), "also": also and told(also)}


def _comparison(
    answer: Calibration,
    found: Influence,
    weight: Float[np.ndarray, "p p"],
    grid: Float[np.ndarray, "m 2"],
) -> dict[str, Any] | None:
    """Compares an answer of another method with the conventional fit of the same images."""
    estimate = in_closed_form(answer.blocks)
    further = {"sound-speed", "delay"} & set(answer.blocks)
    problem = answer.problem
    if answer.method == "conventional" or answer.data == "channels" or further or problem is None:
        return None
    used = np.asarray(answer.mask) > 0
    try:
        other = solve_problem(replace(problem, mask=answer.mask), estimate)
    except InputError:
        return None
    noise = np.asarray(noise_covariance(answer, problem), float)
    if not np.isfinite(noise[used]).all():
        return None
    seen = ImageErrors.of_closed_form(other, problem, answer.blocks)
    covariance, log_density = conventional_fit(seen, used, noise)
    error = float(np.sum(weight * covariance))
    gaussian = float(np.sum(weight * found.model_covariance))
    density = found.log_density - log_density
    gain = spread = None
    # Within a bound, offsets fit themselves: their errors are zero, and have no density. SDs at
    # their lower limit are not those of the errors.
    if answer.prior != "bounded" and not np.any(answer.convergence.sigma_floored):
        gain = float(density.sum())
        spread = float(np.std(density[used], ddof=1) * math.sqrt(used.sum()))
    return {
        "conventional_rms_mm": float(other.rms),
        "rms_mm": float(answer.rms),
        "apart_mm": apart_in_image(answer, other, problem, grid),
        "conventional_tre_mm": math.sqrt(error) if error > 0 else None,
        "tre_mm": math.sqrt(gaussian) if gaussian > 0 else None,
        "log_density_gain": gain,
        "log_density_gain_sd": spread,
        "conventional_image_plane_to_probe": np.asarray(other.image_to_probe),
    }


def settle(record: dict[str, Any]) -> None:
    """Set the expected error and the verdict, from all that was found about the calibration.

    It adds ``rms_mm``, ``interval_95_mm``, ``factor`` and ``contradictions`` to ``record["tre"]``,
    and ``tre_mm`` and ``interval_95_mm`` to the points of ``record["tre"]``. It sets
    ``record["verdict"]`` to good, fair, uncertain, or None if the calibration must not be used.

    Args:
        record: of :func:`jaxcal.report.record.calibration_record`, with cross-validation and
            bootstrap if they were requested.
    """
    tre = record.get("tre")
    usable = record["converged"] and not record.get("wrong_frames")
    record["verdict"] = "uncertain" if usable else None
    if tre is None or tre["stated_mm"] is None:
        return
    told = contradictions(record)
    factor = max([1.0, *(times for times, _ in told)])
    tre["factor"] = factor
    tre["contradictions"] = [words for _, words in told if words]
    tre["rms_mm"] = factor * tre["stated_mm"]
    tre["interval_95_mm"] = [factor * end for end in tre["stated_interval_mm"]]
    for point in tre["points"]:
        point["tre_mm"] = factor * point["stated_mm"]
        point["interval_95_mm"] = [factor * end for end in point["stated_interval_mm"]]
    if usable:
        # With few images the error itself is uncertain, so the upper end of its interval counts.
        error = max(tre["rms_mm"], tre["interval_95_mm"][1] / WIDEST)
        record["verdict"] = (
            "good" if error <= GOOD_MM else "fair" if error <= FAIR_MM else "uncertain"
        )


def stated_at(result: Calibration, points: Float[AnyArray, "m 2"]) -> float | None:
    """The error that the covariance states, as root mean square over some image points, mm."""
    found = np.asarray(predicted_tre(result.numpy(), np.asarray(points, float)))
    value = float(np.sqrt(np.mean(found**2)))
    return value if math.isfinite(value) else None
