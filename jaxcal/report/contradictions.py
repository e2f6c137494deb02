"""What contradicts the stated error of a calibration, and how large it makes the error, in words.

The covariance assumes that the noise model holds. Each of :data:`_CHECKS` looks for one thing that
contradicts it, in the record of a calibration.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from jaxcal.diagnostics.misfits import DRIFT_SCORE, in_two_groups
from jaxcal.diagnostics.residual_checks import FEWEST_TO_CHECK
from jaxcal.diagnostics.unmodelled import SIDE_MM
from jaxcal.diagnostics.warnings import IMPLAUSIBLE_RMS_MM
from jaxcal.model.thresholds import MINIMUM_SELF_TUNING
from jaxcal.runtime.messages import runs_in_words
from jaxcal.solvers.plan import TUNED

Found = Iterator[tuple[float, str]]
"""How many times as large as stated a contradiction makes the error, and its words."""

CHANCE = 3.0
"""SDs of chance beyond which the residuals contradict the stated error."""
MOVED_SHARE, MOVED_TIMES = 0.5, 4.0
"""An image contradicts the stated error if leaving it out moves image points by more than this
share of the error, and by more than so many times the expected move."""
TEST_TIMES = 3.0
"""Test images contradict the stated error if they scatter by more than so many times what the
calibration's own errors and uncertainty explain."""
OUTLYING_TESTS = 0.25
"""Up to this share of the test images may not fit the others and is named instead."""
LIMITS_TIMES = 1.25
"""Bounded or uniform offsets contradict the stated error if the answer is farther from the fit with
Gaussian offsets than so many times the error of that fit."""
SCATTER_TIMES = 1.3
"""Resampled calibrations may scatter by up to so many times the stated error; with fewer than about
40 images by more (:func:`_scattered`)."""

SLOW = 0.5
"""Least slowness of a slow path (:func:`jaxcal.calibration.serial_correlation.slowness`)."""
ABSORBED_SHARE = 0.02
"""Along a slow path offsets with an SD below this share of the other errors' are not believed."""

SHIFTS = ("slip", "step", "displaced", "targets", "origins")
"""Errors that the model leaves out and that make errors within the image drift or lie in groups."""

MOST_IMAGES = 20
"""So many images of a second target or origin are named; the JSON has all."""

_WORTH_NAMING = 0.1
"""A length is not named if it is wrong by less than this share of what another one is wrong by."""
_WAYS = {"lateral": "sideways", "range": "in depth"}
"""Errors within the image, in the order of the residuals, and in words."""

_EXPLANATIONS = {
    "lateral": (
        "lateral positions that are {long}",
        "are the pixels as wide as stated? With a curved array, a wrong sound speed stretches the "
        "image sideways, too: estimate the scale, not the sound speed",
    ),
    "slip": (
        "an image that moves by {slip_mm:.1f} mm on the probe from the first image to the last",
        "a slipping mount, or a moving target?",
    ),
    "step": (
        "an image that moves by {slip_mm:.1f} mm on the probe near image {image} (counted from 0)",
        "has the mount slipped there, the target moved, or the image's depth changed? Calibrate "
        "from the images before it, or after it",
    ),
    "displaced": (
        "a target that moves by {length:.1f} mm near image {image} (counted from 0)",
        "was it touched there, or the tracker or its reference? Calibrate from the images before "
        "it, or after it",
    ),
    "skew": (
        "lateral positions that are {large} of the depth",
        "a steered beam, or clicks beside the target?",
    ),
    "curve": (
        f"ranges that are {{long_mm}} {SIDE_MM:.0f} mm to either side of the middle",
        "a curved array taken for a straight one, or the delays of another probe?",
    ),
    "speed": (
        "distances that are {long}",
        "is it the sound speed of this water? Estimate it (--estimate sound-speed)",
    ),
    "beside": (
        "a target {values[0]:.1f} mm beside the image plane in all images",
        "take images from both sides of it",
    ),
    "distortion": (
        "tracked positions that are off by {values[0]:.1f} mm (RMS), by nearly the same where the "
        "probe is nearly in the same place,",
        "metal near an electromagnetic tracker, the edge of its range, or, along a single path, "
        "errors that change slowly? Record again without it: more images hardly help",
    ),
    "marker": (
        "an image that moves by {values[0]:.1f} mm (RMS) on the probe with the probe's orientation",
        "are the probe's markers wrong, or partly hidden, from some sides, does the target look "
        "different from them, or, along a single path, do errors change slowly?",
    ),
    "targets": (
        "a second target, {values[0]:.1f} mm from the first one, in images {named}",
        "were two targets, or two echoes of one, marked in turn?",
    ),
    "origins": (
        "points that are off by {values[0]:.1f} mm sideways and {values[1]:.1f} mm in depth in "
        "images {named}",
        "were these images cropped or zoomed in another way, or another echo marked in them?",
    ),
}
"""What would explain the errors, and what to ask or to do about it, by the kind of an error that
the model leaves out. Those of ``scale`` and ``lag`` have functions of their own."""


def contradictions(record: dict[str, Any]) -> list[tuple[float, str]]:
    """How many times as large as stated each contradiction makes the error, and its words.

    The record is of a calibration that states an error, with cross-validation and bootstrap if they
    were requested. Groups and slow changes of the errors have no words of their own ("") where one
    of :data:`SHIFTS` explains them.
    """
    if not record["tre"]["stated_mm"]:
        return []
    shifted = (record["tre"]["unmodelled"] or {}).get("kind") in SHIFTS
    return [
        (times, "" if shifted and check in (_from_slow_changes, _from_groups) else words)
        for check in _CHECKS
        for times, words in check(record)
    ]


def _beside(size: float, record: dict[str, Any]) -> float:
    """How many times as large as stated the error is with a further one of this size, mm."""
    return math.hypot(1.0, size / record["tre"]["stated_mm"])


def _sd(record: dict[str, Any], kind: str) -> float | None:
    """SD of an image's errors of one kind, those of the tracker included, mm."""
    size = record[f"sigma_{kind}_mm"]
    return None if size is None else math.hypot(size, record["tracker_sd_mm"] or 0.0)


def _from_large_residuals(record: dict[str, Any]) -> Found:
    """Residuals that no beam explains, whatever the covariance takes them for.

    Out of the image plane they would pass for offsets, which may have any SD.
    """
    rms = record["rms_mm"]
    if rms and rms > IMPLAUSIBLE_RMS_MM:
        words = f"residuals of {rms:.1f} mm are larger than a beam is thick"
        yield rms / record["tre"]["stated_mm"], words


def _from_repeated_poses(record: dict[str, Any]) -> Found:
    """Frames of one pose that counted as independent images, as in a batch."""
    used, poses = record["images_used"], record["tre"]["different_poses"]
    if poses and poses != used:
        words = f"{used} images with {poses} different poses were counted as independent"
        yield math.sqrt(used / poses), words


def _from_residuals(record: dict[str, Any]) -> Found:
    """Residuals that are too large where they matter, one by one.

    They are compared with what their SDs make of the error, before errors that are alike in
    successive images and doubt about the offsets' distribution widen the covariance. The factor is
    applied to the wider error, since neither of the two is seen in single residuals.
    """
    ratio, chance = record["tre"]["residuals_over_stated"], record["tre"]["chance"]
    if ratio is not None and chance is not None and ratio**2 > 1 + CHANCE * chance:
        yield ratio, f"the residuals make the error {ratio:.1f} times as large as their SDs do"


def _from_images(record: dict[str, Any]) -> Found:
    """The image that moves the answer most, if too much; by cross-validation if there is one."""
    stated, influence = record["tre"]["stated_mm"], record["influence"]
    held = _comparable_folds(record)
    moved, how = influence["moved_mm"], "to first order"
    if held is not None and held["folds"] == len(_each_used(held)):
        moved, how = held["image_moved_mm"], "by a calibration without it"
    found = [
        (by, image)
        for image, (by, should) in enumerate(zip(moved, influence["expected_mm"], strict=True))
        if by is not None and should is not None
        if by > max(MOVED_SHARE * stated, MOVED_TIMES * should)
    ]
    if found:
        size, worst = max(found)
        words = f"image {worst} alone changes the calibration by {size:.2f} mm in the image ({how})"
        yield _beside(size, record), words


def _from_test_images(record: dict[str, Any]) -> Found:
    """Independent images among which the target scatters by far more than it may."""
    found = record["reconstruction_precision_mm"]
    if record["reconstruction_precision_set"] != "test" or found is None:
        return
    errors, expected = _of_test_images(record)
    if found > TEST_TIMES * expected and not outlying_test_images(record):
        words = (
            f"the test images scatter by {found:.2f} mm, where {expected:.2f} mm is expected (is "
            "it the same probe, depth and mount?)"
        )
        yield math.sqrt(found**2 - errors**2) / record["tre"]["stated_mm"], words


def _of_test_images(record: dict[str, Any]) -> tuple[float, float]:
    """Errors of single images, and the scatter of test images to expect with it, mm."""
    errors = math.hypot(*(_sd(record, kind) or 0.0 for kind in (*_WAYS, "elevation")))
    # Poses that turn the image see its error twice as large.
    return errors, math.hypot(errors, 2 * record["tre"]["stated_mm"])


def outlying_test_images(record: dict[str, Any]) -> list[int]:
    """Test images, counted from 0, without which the others scatter as they may; else none.

    They may be a quarter of all at most: wrong clicks, say.
    """
    rows, tre = record.get("test_residual_mm"), record["tre"]
    if not rows or tre is None or not tre["stated_mm"]:
        return []
    limit = TEST_TIMES * _of_test_images(record)[1]
    away = {k: math.hypot(*row) for k, row in enumerate(rows) if row is not None}
    outlying = [k for k, distance in away.items() if distance > limit]
    rest = [distance for distance in away.values() if distance <= limit]
    few = 0 < len(outlying) <= OUTLYING_TESTS * len(away)
    return outlying if few and math.hypot(*rest) <= limit * math.sqrt(len(rest) - 1) else []


def _from_slow_changes(record: dict[str, Any]) -> Found:
    """Points that move in the image in the course of the recording, as after a slip of the mount.

    Slow elevational errors do not count: they come from the placement, not from the image.
    """
    scores = record["noise_model"]["scores"]["drift"]
    for score, (kind, name) in zip(scores[:2], _WAYS.items(), strict=True):
        size = _sd(record, kind)
        if score is None or not size or score <= DRIFT_SCORE:
            continue
        slow = size * math.sqrt(min(score / math.sqrt(record["images_used"] - 1), 1.0))
        if slow > record["tre"]["stated_mm"]:
            words = (
                f"the points move {name} by {slow:.2f} mm (SD) in the course of the recording, so "
                "that the calibration at its end is not that at its start"
            )
            yield _beside(slow, record), words


def _from_unmodelled(record: dict[str, Any]) -> Found:
    """An error that the model leaves out (:mod:`jaxcal.diagnostics.unmodelled`)."""
    found = record["tre"]["unmodelled"]
    if found is None:
        return
    moved = found["moved_mm"]
    if found["kind"] in ("targets", "origins"):
        # To first order the answer moves by less than it is wrong by, which in simulation was
        # of the order of the distance.
        moved = max(moved, math.hypot(*found["values"]))
    pixels = record["scale_mm_per_px"] is not None
    what, advice = _explanation(found, pixels=pixels)
    words = f"{what} would explain the errors far better: {advice}"
    if found["also"] is not None:
        what, advice = _explanation(found["also"], pixels=pixels)
        words += f"; so would {what}: {advice}"
    yield _beside(moved, record), words


def _explanation(found: dict[str, Any], *, pixels: bool) -> tuple[str, str]:
    """What would explain the errors, and what to ask or to do about it.

    Args:
        found: the error that the model leaves out, as in the record.
        pixels: whether the calibration has pixels.
    """
    values = found["values"]
    if found["kind"] == "scale":
        return _wrong_lengths(values, found["tracker_share"], pixels=pixels)
    if found["kind"] == "lag":
        return _lagging(values[0])
    what, advice = _EXPLANATIONS[found["kind"]]
    told = what.format(
        **found,
        long=_too_long(values[0]),
        long_mm=_too("long", "short", values[0], "mm"),
        large=_too("large", "small", 100 * values[0], "%"),
        length=math.hypot(*values),
        named=images_named(found["images"] or ()),
    )
    return told, advice


def _wrong_lengths(
    shares: Sequence[float], tracker_share: float | None, *, pixels: bool
) -> tuple[str, str]:
    """Of ``scale``: lateral positions and ranges that are too long by these shares."""
    least = _WORTH_NAMING * max(map(abs, shares))
    lengths = zip(("lateral positions", "ranges"), shares, strict=True)
    told = [f"{what} that are {_too_long(by)}" for what, by in lengths if abs(by) >= least]
    advice = (
        "check pixel size and sound speed, or estimate the scale"
        if pixels
        else "check what gave the points their mm (pixel size, sound speed, pitch of the elements)"
    )
    if tracker_share is not None:
        advice += (
            f"; if they are right, tracked positions are {_too_long(-tracker_share)} (check the "
            "tracker with a known distance, and the size of its markers)"
        )
    return " and ".join(told), advice


def _lagging(seconds: float) -> tuple[str, str]:
    """Of ``lag``: images that lag behind their poses, or, if it is negative, poses that do."""
    late, early, larger = "images", "poses", "larger"
    if seconds <= 0:
        late, early, larger = "poses", "images", "smaller"
    lag = f"{abs(seconds):.3f} s"
    return (
        f"{late} that lag {lag} behind their {early}",
        f"import again with a --lag that is {lag} {larger}, or hold the probe still for each image",
    )


def _too_long(share: float) -> str:
    """By how much a length is wrong, as a share of it."""
    return _too("long", "short", 100 * share, "%")


def _too(positive: str, negative: str, size: float, unit: str) -> str:
    """By how much something is wrong, and in which direction."""
    return f"too {negative if size < 0 else positive} by {abs(size):.1f} {unit}"


def images_named(images: Sequence[int]) -> str:
    """Their numbers; of many runs of images those of the first ones."""
    return f"{runs_in_words(images, MOST_IMAGES)} (counted from 0)"


def _from_groups(record: dict[str, Any]) -> Found:
    """Errors within the image that come in two groups."""
    model = record["noise_model"]
    each = zip(_WAYS.items(), model["scores"]["tails"], model["kurtosis"], strict=False)
    for (kind, name), score, kurtosis in each:
        if (size := _sd(record, kind)) and in_two_groups(score, kurtosis):
            words = f"the points lie in two groups, about {2 * size:.1f} mm apart {name}"
            yield _beside(size, record), words


def _from_left_out(record: dict[str, Any]) -> Found:
    """Images left out as outliers that agree on another calibration.

    :mod:`jaxcal.diagnostics.outlier_agreement` finds them.
    """
    if (found := record["tre"]["left_out"]) is not None:
        words = (
            f"the {found['images']} images left out agree among themselves, but on a calibration "
            f"{found['apart_mm']:.1f} mm away: which of the two is right?"
        )
        yield _beside(found["apart_mm"], record), words


def _from_absorbed_offsets(record: dict[str, Any]) -> Found:
    """Offsets that are far smaller than all other errors, along a slow path.

    Those that changed as slowly as the pose have moved the answer instead.
    """
    offsets = record["sigma_elevation_mm"]
    others = [size for kind in _WAYS if (size := record[f"sigma_{kind}_mm"])]
    if record["tre"]["slow_path"] < SLOW or not (offsets and len(others) == 2):
        return
    if offsets < ABSORBED_SHARE * min(others):
        words = (
            f"offsets from the image plane with an SD of {offsets:.1g} mm, where other errors have "
            f"{min(others):.2f} mm, are too small to be true: the images lie along one slow path, "
            "and the calibration has taken up the offsets that changed as slowly (take images in "
            "other poses, in a random order)"
        )
        yield min(others) / offsets, words


def _from_clipped(record: dict[str, Any]) -> Found:
    """Points that were cut off at an edge (:mod:`jaxcal.diagnostics.clipped`)."""
    found, unit = record["tre"]["clipped"], record["tre"]["unit"]
    if found is None:
        return
    name = (("u", "v") if unit == "px" else ("lateral position", "range"))[found["axis"]]
    end, beyond = ("largest", "larger") if found["largest"] else ("smallest", "smaller")
    words = (
        f"{len(found['images'])} images share the {end} {name}, {found['value']:.6g} {unit}: were "
        f"{beyond} ones cut off (by a region of interest, or the edge of the image)? Calibrate "
        f"without images {images_named(found['images'])}"
    )
    yield _beside(found["apart_mm"] or 0.0, record), words


def _from_limits(record: dict[str, Any]) -> Found:
    """Sharp limits of the offsets that moved the answer.

    :mod:`jaxcal.diagnostics.gaussian_offsets` has the fit to compare with.
    """
    found = record["tre"]["gaussian_offsets"]
    if found is None or found["apart_mm"] <= LIMITS_TIMES * found["error_mm"]:
        return
    better = "use the prior auto, unless something limits the offsets on both sides"
    if record["prior"] == "bounded":
        better = (
            "use the prior auto, which needs no bound (one that is too small or too large moves "
            "the answer, and even the right one may leave it less accurate)"
        )
    words = (
        f"a calibration with Gaussian offsets differs by {found['apart_mm']:.2f} mm, where its own "
        f"error would be {found['error_mm']:.2f} mm: {better}"
    )
    yield _beside(found["apart_mm"], record), words


def _each_used(held: dict[str, Any]) -> list[float]:
    """By how much leaving out each image in use (its fold) changes the answer, mm."""
    return [by for by in held["image_moved_mm"] if by is not None]


def _comparable_folds(record: dict[str, Any]) -> dict[str, Any] | None:
    """The cross-validation, if there is one and its calibrations are like that of all images.

    If leaving out a fold leaves too few images to tune the SDs, its calibration has other SDs, and
    moves for this reason.
    """
    held, used = record.get("cross_validation"), record["images_used"]
    if held is None:
        return None
    left = used - math.ceil(used / held["folds"])
    other = record["prior"] in TUNED and left < MINIMUM_SELF_TUNING <= used
    return None if other else held


def _from_resampling(record: dict[str, Any]) -> Found:
    """Calibrations of a cross-validation or a bootstrap that scatter more than is stated."""
    held, drawn = _comparable_folds(record), record.get("bootstrap")
    if held is not None and held["folds"] == held["folds_converged"]:
        # The jackknife. All images of a fold are held out together; the first ones in use are of a
        # fold each.
        folds = held["folds"]
        moved = _each_used(held)[:folds]
        scatter = math.sqrt((folds - 1) / folds * sum(by**2 for by in moved))
        yield from _scattered("cross-validation", scatter, held["stated_mm"], folds)
    # A resample of n images has about 0.63 n different ones.
    if drawn is not None and record["images_used"] >= FEWEST_TO_CHECK:
        known = [value for value in drawn["rms_scatter_mm"] if value is not None]
        scatter = math.sqrt(sum(value**2 for value in known) / max(len(known), 1))
        yield from _scattered("bootstrap", scatter, drawn["stated_mm"], record["images_used"])


def _scattered(of: str, scatter: float, stated: float | None, count: int) -> Found:
    """A scatter that contradicts the error stated for the same points.

    The variance of a scatter that comes from so many images has a relative SD of about
    sqrt(2 / (count - 1)).

    Args:
        of: what the calibrations are of.
        scatter: at corners and middle of the part in which targets were seen, mm.
        stated: the error there, mm.
        count: of images, or folds, from which the scatter comes.
    """
    by_chance = math.sqrt(1 + CHANCE * math.sqrt(2 / (count - 1)))
    if stated and scatter > max(SCATTER_TIMES, by_chance) * stated:
        words = (
            f"the calibrations of the {of} scatter by {scatter:.2f} mm where targets were seen, "
            f"{scatter / stated:.1f} times as much as the covariance states ({stated:.2f} mm)"
        )
        yield scatter / stated, words


_CHECKS = (
    _from_large_residuals,
    _from_repeated_poses,
    _from_residuals,
    _from_images,
    _from_resampling,
    _from_test_images,
    _from_slow_changes,
    _from_unmodelled,
    _from_groups,
    _from_absorbed_offsets,
    _from_clipped,
    _from_left_out,
    _from_limits,
)
"""In the order in which their words are said."""
