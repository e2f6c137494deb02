"""How accurate a calibration is, what limits it and what contradicts it, as plain values.

The main number is the target registration error (TRE) to expect at the image: its root mean square
over the region that the target filled, with a 95 % interval (:mod:`jaxcal.diagnostics.intervals`).
It comes from the covariance, which assumes that the noise model holds. If the data contradict it in
one of the following ways, the expected error is larger, and the larger number is reported:

- the residuals make the error larger than stated by more than three SDs of chance;
- leaving one image out moves image points by more than half the stated error and by more than four
  times the expected move (by one step from the normal equations, or by cross-validation if this was
  requested);
- the scatter in cross-validation or bootstrap is more than 1.3 times the stated error.

The word of the verdict depends on this number: good up to 0.5 mm, fair up to 1.5 mm, otherwise
uncertain.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.calibration.result import Calibration
from jaxcal.data.poses import targets_in_images
from jaxcal.data.problem import Problem
from jaxcal.data.recording import Recording
from jaxcal.design.candidates import seen_region
from jaxcal.design.constraints import Region
from jaxcal.diagnostics.image_errors import Unknowns
from jaxcal.diagnostics.image_points import mean_of_squares
from jaxcal.diagnostics.influence import (
    KINDS,
    Influence,
    conventional_fit,
    excess,
    in_image,
    influence_of,
)
from jaxcal.diagnostics.intervals import (
    image_jacobian,
    predicted_tre,
    tre_at,
    tre_over,
)
from jaxcal.diagnostics.messages import DRIFT_SCORE, in_two_groups
from jaxcal.diagnostics.unmodelled import unmodelled
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.trees import map_arrays
from jaxcal.solvers.closed_form.single import ClosedForm, calibrate_closed_form

GOOD_MM = 0.5
"""Largest error to expect at the image (root mean square) that is called good."""
FAIR_MM = 1.5
"""Largest error that is called fair; larger ones are called uncertain."""

CHANCE = 3.0
"""SDs of chance beyond which the residuals contradict the stated error."""
MOVED_SHARE, MOVED_TIMES = 0.5, 4.0
"""An image contradicts the stated error if leaving it out moves image points by more than this
share of the error, and by more than so many times the expected move."""
TEST_TIMES = 3.0
"""Test images contradict the stated error if they scatter by more than so many times what the
calibration's own errors and uncertainty explain."""
FEWEST_LEFT_OUT, LEAST_SHARE_LEFT_OUT, AGREEING_TIMES, APART_TIMES = 8, 0.2, 2.0, 3.0
"""So many images that were left out, and at least this share of those in use, agree among
themselves if their errors within the image are at most so many times as large as those of the
others, and the two fits are farther apart than so many times what is stated of both."""
SCATTER_TIMES = 1.3
"""Resampled calibrations may scatter by up to so many times the stated error."""

_WAYS = {"lateral": "sideways", "range": "in depth"}
"""Errors within the image, in the order of the residuals, and in words."""
_ACROSS = 15
"""Number of points along each side of the map."""
_MOST_NAMED = 5


def accuracy_record(
    result: Calibration, recording: Recording, wanted: tuple[tuple[float, float], ...] = ()
) -> dict[str, Any]:
    """``tre``, ``limits``, ``influence`` and ``comparison`` of a calibration's record.

    Args:
        result: of one problem, with concrete values.
        recording: what was calibrated.
        wanted: further image points for the error, in the images' own unit (px or mm).

    Returns:
        Arrays and plain values; all of them None where X is not observable.
    """
    nothing = {"tre": None, "limits": None, "influence": None, "comparison": None}
    answer = result.numpy()
    if not np.isfinite(answer.unknowns_covariance).all() or not bool(result.converged):
        return nothing
    problem = answer.problem
    if problem is None:
        answer = answer.with_problem(Problem.from_recording(recording)).numpy()
    region = region_of(answer, recording)
    grid = region.grid()[:, [0, 2]]
    weight = mean_of_squares(image_jacobian(answer, grid))
    found = influence_of(answer)
    tre = _tre(answer, region, wanted)
    influence = _influence(found, weight, np.asarray(answer.mask) > 0)
    ratio, chance = excess(found, weight)
    tre["residuals_over_stated"] = math.sqrt(ratio) if ratio > 0 else None
    tre["chance"] = chance
    tre["unmodelled"] = _unmodelled(answer, grid)
    tre["left_out"] = _left_out(answer, float(tre["stated_mm"]), grid)
    return {
        "tre": tre,
        "limits": _limits(answer, found, weight),
        "influence": influence,
        "comparison": _comparison(answer, recording, found, grid),
    }


def region_of(answer: Calibration, recording: Recording) -> Region:
    """The part of the image that the target filled, and the face of the probe if it is known."""
    used = np.asarray(answer.mask) > 0
    targets = targets_in_images(recording.calibration.poses, answer.image_to_probe, answer.point)
    return seen_region(recording, targets[used])


def _tre(
    answer: Calibration, region: Region, wanted: tuple[tuple[float, float], ...]
) -> dict[str, Any]:
    over = tre_over(answer, region.grid()[:, [0, 2]])
    names = ("middle", "near left", "near right", "far left", "far right")
    unit = np.array([[0.0, 0.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    places = region.place(unit)[:, [0, 2]]
    image = _to_image(answer, places)
    if wanted:
        given = np.array(wanted, float)
        if not np.isfinite(given).all():
            raise InputError("points of --tre must be finite numbers")
        names += ("asked for",) * len(given)
        image = np.concatenate([image, given])
        places = np.concatenate([places, _from_image(answer, given)])
    at = tre_at(answer, places)
    side = np.linspace(-1.0, 1.0, _ACROSS)
    cells = region.place(np.stack(np.meshgrid(side, side), axis=-1))[..., [0, 2]]
    mapped = tre_at(answer, cells)
    return {
        "region": {
            "lateral_mm": region.lateral_mm,
            "depth_mm": region.depth_mm,
            "radius_mm": region.radius_mm,
        },
        "unit": _unit(answer),
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


def _unit(answer: Calibration) -> str:
    return "mm" if answer.scale_mm_per_px is None else "px"


def _affine(answer: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Size of the image's unit, and position of the image's origin; both mm, [lateral, axial]."""
    transform = answer.image_transform()
    scale = np.ones(2) if transform.scale_mm_per_px is None else transform.scale_mm_per_px
    return scale * [1.0, transform.range_factor], np.array([0.0, transform.face_offset_mm])


def _to_image(answer: Calibration, places: Float[np.ndarray, "*m 2"]) -> Float[np.ndarray, "*m 2"]:
    scale, origin = _affine(answer)
    return (places - origin) / scale


def _from_image(answer: Calibration, image: Float[np.ndarray, "*m 2"]) -> Float[np.ndarray, "*m 2"]:
    scale, origin = _affine(answer)
    return image * scale + origin


def _influence(
    found: Influence, weight: Float[np.ndarray, "p p"], used: np.ndarray
) -> dict[str, Any]:
    moved, expected = in_image(found, weight)
    strongest = [int(k) for k in np.argsort(-moved)[:_MOST_NAMED] if used[k]]
    return {
        "moved_mm": np.where(used, moved, np.nan),
        "expected_mm": np.where(used, expected, np.nan),
        "most": strongest,
    }


def _limits(
    answer: Calibration, found: Influence, weight: Float[np.ndarray, "p p"]
) -> dict[str, Any]:
    """Shares of the mean square error at the image, and of the scatter of the target."""
    sigma = np.asarray(answer.sigma, float)
    residual = np.asarray(answer.residual)[np.asarray(answer.mask) > 0]
    part = np.einsum("pq,kpq->k", weight, found.shares)
    if not np.isfinite(part).all() or not part.sum() > 0:
        part = np.full(len(KINDS), np.nan)
    elif answer.prior in ("none", "bounded"):
        # These weigh all kinds alike: scale the shares by the kinds' own variances.
        part = part * sigma**2
    squares = np.mean(residual**2, axis=0)
    whole = float(squares.sum())
    scatter = squares[[0, 2, 1]] / whole if whole > 0 else np.full(3, np.nan)
    return {
        "error_share": dict(zip(KINDS, part / part.sum(), strict=True)),
        "scatter_share": dict(zip(KINDS, scatter, strict=True)),
        "rms_lateral_mm": math.sqrt(squares[0]),
        "rms_axial_mm": math.sqrt(squares[2]),
        "rms_elevational_mm": math.sqrt(squares[1]),
        "rms_in_plane_mm": math.sqrt(squares[0] + squares[2]),
    }


def _unmodelled(answer: Calibration, grid: Float[np.ndarray, "m 2"]) -> dict[str, Any] | None:
    """The clearest error that the model leaves out, and how far it moves the image."""
    found = unmodelled(answer)
    if not found:
        return None
    # One imitates another: only the clearest is told.
    first, problem = found[0], answer.problem
    assert problem is not None
    jacobian = np.asarray(image_jacobian(answer, grid))
    moved, slip = first.moved(grid, jacobian, float(np.asarray(problem.face_offset)))
    return {
        "kind": first.kind,
        "values": first.values,
        "statistic": first.statistic,
        "moved_mm": moved,
        "slip_mm": slip if first.kind == "slip" else None,
    }


def _left_out(
    answer: Calibration, stated: float, grid: Float[np.ndarray, "m 2"]
) -> dict[str, Any] | None:
    """Images that were left out as outliers and agree among themselves on another calibration."""
    problem, kept = answer.problem, np.asarray(answer.mask) > 0
    if not answer.robust or problem is None or answer.data != "points":
        return None
    # Frames of a pose that is held are masked in the answer's problem already.
    left = (np.asarray(problem.mask) > 0) & ~kept
    if left.sum() < max(FEWEST_LEFT_OUT, LEAST_SHARE_LEFT_OUT * kept.sum()):
        return None
    estimate = ("scale",) if "scale" in answer.blocks else ()
    try:
        own, other = (
            calibrate_closed_form(replace(problem, mask=mask.astype(float)), estimate=estimate)
            for mask in (kept, left)
        )
    except InputError:
        return None
    if not _within(other, problem, left) <= AGREEING_TIMES * _within(own, problem, kept):
        return None
    apart = _apart(own, other, problem, grid)
    if apart <= APART_TIMES * stated * math.sqrt(1 + kept.sum() / left.sum()):
        return None
    return {"images": int(left.sum()), "apart_mm": apart}


def _within(found: ClosedForm, problem: Problem, used: np.ndarray) -> float:
    """SD of the errors within the image of a conventional fit, mm."""
    size = _pixel_size(found, problem)
    measured = np.asarray(problem.measurements, float)[used] * size
    measured[:, 1] += float(np.asarray(problem.face_offset))
    poses = np.asarray(problem.poses, float)[used]
    q = targets_in_images(poses, found.image_to_probe, found.point_mm)
    off = np.stack([q[:, 0], np.hypot(q[:, 1], q[:, 2])], axis=1) - measured
    freedom = max(2 * len(off) - 6, 1)
    return math.sqrt(float(np.sum(off**2)) / freedom)


def _pixel_size(found: ClosedForm, problem: Problem) -> Float[np.ndarray, " 2"]:
    spacing = np.asarray(problem.spacing, float)
    return spacing if found.scale_mm_per_px is None else np.asarray(found.scale_mm_per_px)


def _apart(
    first: ClosedForm, second: ClosedForm, problem: Problem, grid: Float[np.ndarray, "m 2"]
) -> float:
    """How far apart two fits put the image's pixels on the probe, root mean square, mm."""
    stretch = _pixel_size(second, problem) / _pixel_size(first, problem)
    return _distance(
        np.asarray(first.image_to_probe), np.asarray(second.image_to_probe), stretch, grid
    )


def _distance(
    first: Float[np.ndarray, "4 4"],
    second: Float[np.ndarray, "4 4"],
    stretch: Float[np.ndarray, " 2"],
    grid: Float[np.ndarray, "m 2"],
) -> float:
    """Of image points under two X, the second with pixels so many times as large, mm."""
    there = np.stack([grid[:, 0], 0 * grid[:, 0], grid[:, 1], np.ones(len(grid))])
    larger = np.array([stretch[0], 1.0, stretch[1], 1.0])[:, None]
    moved = (second @ (larger * there) - first @ there)[:3]
    return math.sqrt(float(np.mean(np.sum(moved**2, axis=0))))


def _comparison(
    answer: Calibration, recording: Recording, found: Influence, grid: Float[np.ndarray, "m 2"]
) -> dict[str, Any] | None:
    """Compares an answer of another method with the conventional fit of the same images."""
    estimate = tuple(name for name in ("scale",) if name in answer.blocks)
    further = {"sound-speed", "delay"} & set(answer.blocks)
    images, problem = recording.calibration, answer.problem
    if answer.method == "conventional" or further or problem is None:
        return None
    if images.kind == "time_of_flight" or answer.data == "channels":
        return None
    used = np.asarray(answer.mask) > 0
    try:
        other = calibrate_closed_form(replace(images, mask=used), estimate=estimate)
    except InputError:
        return None
    x, point = np.asarray(other.image_to_probe), np.asarray(other.point_mm)
    spacing = np.asarray(problem.spacing, float)
    scale, further = np.ones(2), {}
    if other.scale_mm_per_px is not None:
        scale = np.asarray(other.scale_mm_per_px) / spacing
        further["scale"] = list(scale[:, None])
    alone = _batch_of_one(problem)
    unknowns = Unknowns(x[None, :3, :3], x[None, :3, 3], point[None], further)
    sigma = np.asarray(answer.sigma, float)
    if not np.isfinite(sigma).all():
        return None
    fit = conventional_fit(unknowns, alone, answer.blocks, used, sigma)
    jacobian = image_jacobian(answer, grid)
    error = np.einsum("mia,ab,mib->", jacobian, fit.covariance, jacobian) / len(grid)
    gaussian = np.einsum("mia,ab,mib->", jacobian, found.model_covariance, jacobian) / len(grid)
    # Compare where both calibrations put the image's pixels on the probe.
    mine = np.ones(2)
    if answer.scale_mm_per_px is not None:
        mine = np.asarray(answer.scale_mm_per_px) / spacing
    apart = _distance(np.asarray(answer.image_to_probe), x, scale / mine, grid)
    density = found.log_density - fit.log_density
    count = int(used.sum())
    return {
        "conventional_rms_mm": float(other.rms_mm),
        "rms_mm": float(answer.rms),
        "apart_mm": apart,
        "conventional_tre_mm": math.sqrt(error) if error > 0 else None,
        "tre_mm": math.sqrt(gaussian) if gaussian > 0 else None,
        "log_density_gain": float(density.sum()),
        "log_density_gain_sd": float(np.std(density[used], ddof=1) * math.sqrt(count)),
        "conventional_image_plane_to_probe": x,
    }


def _batch_of_one(problem: Problem) -> Problem:
    return map_arrays(lambda leaf: np.asarray(leaf, float)[None], problem)


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
    told = [*_from_residuals(record), *_from_images(record), *_from_resampling(record)]
    told += [*_from_test_images(record), *_from_slow_changes(record), *_from_unmodelled(record)]
    told += [*_from_groups(record), *_from_left_out(record)]
    factor = max([1.0, *(times for times, _ in told)])
    tre["factor"] = factor
    tre["contradictions"] = [words for _, words in told]
    tre["rms_mm"] = factor * tre["stated_mm"]
    tre["interval_95_mm"] = [factor * end for end in tre["stated_interval_mm"]]
    for point in tre["points"]:
        point["tre_mm"] = factor * point["stated_mm"]
        point["interval_95_mm"] = [factor * end for end in point["stated_interval_mm"]]
    error = tre["rms_mm"]
    word = "good" if error <= GOOD_MM else "fair" if error <= FAIR_MM else "uncertain"
    record["verdict"] = None if record.get("wrong_frames") else word


def _from_residuals(record: dict[str, Any]) -> list[tuple[float, str]]:
    tre = record["tre"]
    ratio, chance = tre["residuals_over_stated"], tre["chance"]
    if ratio is None or chance is None or ratio**2 <= 1 + CHANCE * chance:
        return []
    return [(ratio, f"the residuals make the error {ratio:.1f} times as large as the covariance")]


def _from_images(record: dict[str, Any]) -> list[tuple[float, str]]:
    """The image that moves the answer most, if too much; by cross-validation if there is one."""
    stated, influence = record["tre"]["stated_mm"], record["influence"]
    held = record.get("cross_validation")
    moved, how = influence["moved_mm"], "to first order"
    if held is not None and held["folds"] == len(moved):
        moved, how = held["image_moved_mm"], "calibrated anew without it"
    worst, size = None, 0.0
    for image, (by, should) in enumerate(zip(moved, influence["expected_mm"], strict=True)):
        if by is None or should is None or by <= max(MOVED_SHARE * stated, MOVED_TIMES * should):
            continue
        if by > size:
            worst, size = image, by
    if worst is None:
        return []
    words = f"image {worst} alone moves the image by {size:.2f} mm ({how})"
    return [(math.hypot(1.0, size / stated), words)]


def _from_test_images(record: dict[str, Any]) -> list[tuple[float, str]]:
    """Independent images among which the target scatters by far more than it may."""
    found, stated = record["reconstruction_precision_mm"], record["tre"]["stated_mm"]
    if record["reconstruction_precision_set"] != "test" or found is None or not stated:
        return []
    names = ("sigma_lateral_mm", "sigma_range_mm", "sigma_elevation_mm")
    errors = [record[name] or 0.0 for name in names]
    # Poses that turn the image see its error twice as large.
    expected = math.hypot(*errors, 2 * stated)
    if found <= TEST_TIMES * expected:
        return []
    words = (
        f"the test images scatter by {found:.2f} mm, where {expected:.2f} mm is expected (is it "
        "the same probe, depth and mount?)"
    )
    return [(math.sqrt(found**2 - math.hypot(*errors) ** 2) / stated, words)]


def _from_slow_changes(record: dict[str, Any]) -> list[tuple[float, str]]:
    """Points that move in the image in the course of the recording, as after a slip of the mount.

    Slow elevational errors do not count: they come from the placement, not from the image.
    """
    stated, scores = record["tre"]["stated_mm"], record["noise_model"]["scores"]["drift"]
    found: list[tuple[float, str]] = []
    for score, (kind, name) in zip(scores[:2], _WAYS.items(), strict=True):
        size = record[f"sigma_{kind}_mm"]
        if score is None or not size or not stated or score <= DRIFT_SCORE:
            continue
        slow = size * math.sqrt(min(score / math.sqrt(record["images_used"] - 1), 1.0))
        words = (
            f"the points move {name} by {slow:.2f} mm (SD) in the course of the recording, so that "
            "the image is elsewhere at its end than at its start"
        )
        if slow > stated:
            found.append((math.hypot(1.0, slow / stated), words))
    return found


def _from_unmodelled(record: dict[str, Any]) -> list[tuple[float, str]]:
    """An error that the model leaves out, and that the residuals show."""
    found, stated = record["tre"]["unmodelled"], record["tre"]["stated_mm"]
    if found is None or not stated:
        return []
    values, moved = found["values"], found["moved_mm"]
    words = {
        "scale": lambda: (
            f"lateral positions that are too long by {100 * values[0]:.1f} % and ranges by "
            f"{100 * values[1]:.1f} % would explain the errors far better: check pixel size, "
            "sound speed and the tracker's unit, or estimate the scale"
        ),
        "slip": lambda: (
            f"an image that moves by {found['slip_mm']:.1f} mm on the probe from the first image "
            "to the last would explain the errors far better: a slipping mount, or a moving target?"
        ),
        "skew": lambda: (
            f"lateral positions that are too large by {100 * values[0]:.1f} % of the depth would "
            "explain the errors far better: a steered beam, or clicks beside the target?"
        ),
        "beside": lambda: (
            f"a target {values[0]:.1f} mm beside the image plane in all images would explain the "
            "errors far better: take images from both sides of it"
        ),
    }
    return [(math.hypot(1.0, moved / stated), words[found["kind"]]())]


def _from_groups(record: dict[str, Any]) -> list[tuple[float, str]]:
    """Errors within the image that come in two groups."""
    stated, model = record["tre"]["stated_mm"], record["noise_model"]
    scores, kurtosis = model["scores"]["tails"], model["kurtosis"]
    found: list[tuple[float, str]] = []
    for k, (kind, name) in enumerate(_WAYS.items()):
        size = record[f"sigma_{kind}_mm"]
        if stated and size and in_two_groups(scores[k], kurtosis[k]):
            words = f"the points lie in two groups, about {2 * size:.1f} mm apart {name}"
            found.append((math.hypot(1.0, size / stated), words))
    return found


def _from_left_out(record: dict[str, Any]) -> list[tuple[float, str]]:
    """Images left out that agree among themselves as well as those in use do."""
    found, stated = record["tre"]["left_out"], record["tre"]["stated_mm"]
    if found is None or not stated:
        return []
    words = (
        f"the {found['images']} images left out agree among themselves as well, on a calibration "
        f"{found['apart_mm']:.1f} mm away: which of the two is right?"
    )
    return [(math.hypot(1.0, found["apart_mm"] / stated), words)]


def _from_resampling(record: dict[str, Any]) -> list[tuple[float, str]]:
    found: list[tuple[float, str]] = []
    held, drawn = record.get("cross_validation"), record.get("bootstrap")
    if held is not None and held["folds"] == held["folds_converged"]:
        moved = [by for by in held["image_moved_mm"] if by is not None]
        folds, stated = held["folds"], held["stated_mm"]
        # The jackknife: every image was held out once, together with its fold.
        each = len(moved) / folds
        scatter = math.sqrt((folds - 1) / folds * sum(by**2 for by in moved) / each)
        if stated and scatter > SCATTER_TIMES * stated:
            found.append(
                (
                    scatter / stated,
                    f"calibrations without some of the images scatter by {scatter:.2f} mm, "
                    f"{scatter / stated:.1f} times what is stated",
                )
            )
    if drawn is not None and drawn["stated_mm"]:
        known = [value for value in drawn["reproducibility_mm"] if value is not None]
        scatter = math.sqrt(sum(value**2 for value in known) / max(len(known), 1))
        if scatter > SCATTER_TIMES * drawn["stated_mm"]:
            times = scatter / drawn["stated_mm"]
            found.append(
                (
                    times,
                    f"calibrations from images drawn anew scatter by {scatter:.2f} mm, {times:.1f} "
                    "times what is stated",
                )
            )
    return found


def stated_at(result: Calibration, points: Float[np.ndarray, "m 2"]) -> float | None:
    """The error that the covariance states, as root mean square over some image points, mm."""
    found = np.asarray(predicted_tre(result.numpy(), np.asarray(points, float)))
    value = float(np.sqrt(np.mean(found**2)))
    return value if math.isfinite(value) else None
