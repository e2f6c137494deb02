"""A calibration in a few plain sentences: how good, how certain, what looks wrong, what to do.

The first sentence has one word and one number; both express the target registration error to expect
at the image (:mod:`jaxcal.report.accuracy`).
"""

from __future__ import annotations

import math
from typing import Any

from jaxcal.diagnostics.misfits import WITHIN_THE_IMAGE
from jaxcal.diagnostics.warnings import MISFIT, WEAK_MM, rests_on
from jaxcal.report.contradictions import (
    MOST_IMAGES,
    SHIFTS,
    SLOW,
    images_named,
    outlying_test_images,
)
from jaxcal.report.paragraphs import listed
from jaxcal.report.resampled import resampled_sentences
from jaxcal.result.saved import ASKED_FOR
from jaxcal.runtime.messages import first_ones, runs_in_words
from jaxcal.solvers.plan import TUNED

ENOUGH_IMAGES = 20
"""With fewer images in use, more are advised even if the error to expect is small."""
_SMALL_SHARE = 1 / 3
"""If the targets were seen in less than this share of the image, the verdict says in which part."""
_MOST_MOVED_SHARE = 0.3
"""An image is named if leaving it out moves image points by more than this share of the stated
error."""

CLEAR_SDS = 2.0
"""A gain in log density counts from so many of its standard errors on."""

_AXES = ("lateral (sideways)", "elevational (out-of-plane)", "axial (depth)")
_MORE_VARIED = (
    "Add images with the probe tilted by 20 to 30 degrees about each of its three axes, and with "
    "the target in all parts of the image, near and far, left and right."
)
_BEYOND = (
    "Beyond these, vary all tilts and where the target is in the image: near and far, left and "
    "right."
)
_STEPS = {
    "failed": "Check that poses and images belong together, that poses are probe -> tracker, and "
    "that lengths are in mm.",
    "max_iterations": "Leave out images in which the target was picked wrongly (they have the "
    "largest residuals), or add images; then calibrate again.",
    "targets": "Import the points of one of the two targets alone, or calibrate with --robust, "
    "which leaves the images of the other one out if they are few.",
    "origins": "Look at the images that are named, and correct their points or leave them out; "
    "--robust leaves them out if they are few.",
}
"""What to do, by the status, or by the kind of an error that the model leaves out."""
_KINDS = {
    "lateral": "lateral errors of the points",
    "range": "range errors of the points",
    "elevational": "targets out of the image plane",
}


def verdict(record: dict[str, Any]) -> list[str]:
    """Sentences for a person, most important first, as :mod:`jaxcal.report.paragraphs` has them."""
    lines = [headline(record)]
    if usable(record):
        lines += [*why_larger(record), *where(record)]
    lines += [*listed("Look at this", findings(record)), *listed("What to do", advice(record))]
    if usable(record):
        lines += listed("What limits it", limits(record))
        lines += listed("How certain it is", [*certainty(record), *resampled_sentences(record)])
        lines += listed("How the images agree with it", [*scatter(record), *believe(record)])
        lines += listed("Which images", frames_of_images(record))
    return lines


def findings(record: dict[str, Any]) -> list[str]:
    """What looks wrong, but for what the first sentence says or a named error explains."""
    effects = ()
    if usable(record) and _unmodelled(record).get("kind") in SHIFTS:
        effects = tuple(f"{MISFIT}: the {name}" for name in WITHIN_THE_IMAGE)
    first = headline(record)
    return [text for text in record["warnings"] if not (text in first or text.startswith(effects))]


def usable(record: dict[str, Any]) -> bool:
    """Whether there is an answer, from data in the right frames."""
    return record["status"] in ("converged", "max_iterations") and not record.get("wrong_frames")


def frames_of_images(record: dict[str, Any]) -> list[str]:
    """Which frames the images that are named are, if the two are counted differently."""
    frame = record.get("frame")
    influence = record.get("influence") or {"most": []}
    suspected = (each["image"] for each in record["suspects"])
    second = _unmodelled(record).get("images") or []
    clipped = ((record.get("tre") or {}).get("clipped") or {}).get("images", [])
    named = {*record["outliers"], *suspected, *influence["most"][:3]}
    named |= {*second[:MOST_IMAGES], *clipped[:MOST_IMAGES]}
    if frame is None:
        return []
    told = [f"image {k} is frame {frame[k]}" for k in sorted(named) if frame[k] != k]
    if not told:
        return []
    return [
        "Images are counted from 0 in the recording; in the file that it came from, "
        f"{first_ones(told)}."
    ]


def _unmodelled(record: dict[str, Any]) -> dict[str, Any]:
    """What the model leaves out and the residuals show; empty if nothing is."""
    return (record.get("tre") or {}).get("unmodelled") or {}


def headline(record: dict[str, Any]) -> str:
    """The first sentence, with the word and the number of the verdict."""
    status, tre = record["status"], record.get("tre")
    if status == "failed":
        return "Failed: there is no calibration."
    if told := record.get("wrong_frames"):
        return f"Do not use: {_ended(told)}"
    if status == "unobservable":
        return "Do not use: these images do not determine the calibration."
    if status == "max_iterations":
        return "Do not trust: the solver stopped before it converged."
    if told := record.get("doubtful_unit"):
        return f"Uncertain: {_ended(told)}"
    if tre is None or tre.get("rms_mm") is None:
        return (
            f"Uncertain: solved from {record['images_used']} images, which do not show how large "
            "the error is."
        )
    low, high = tre["interval_95_mm"]
    return (
        f"{record['verdict'].capitalize()}: expect points of the image to be {_mm(tre['rms_mm'])} "
        f"off, between {_mm(low)} and {_mm(high)} with 95 % probability (target registration "
        "error, root mean square over the image)."
    )


def verdict_word(record: dict[str, Any]) -> str:
    """Good, fair or uncertain, or that the calibration must not be used, in small letters."""
    return record["verdict"] or headline(record).split(":")[0].lower()


def title_of_transform(record: dict[str, Any]) -> str:
    """What stands over X wherever it is printed; that it must not be used, if so."""
    return "image_plane_to_probe (mm)" + ("" if record["verdict"] else f": {verdict_word(record)}")


def length_form(value: float) -> str:
    """The format of a length in mm: hundredths; tenths from 10 mm on; more digits near zero."""
    if value >= 10:
        return ".1f"
    if value >= 0.0095 or value == 0:
        return ".2f"
    return ".4f" if value >= 5e-5 else ".1g"


def fine_form(value: float) -> str:
    """The same for a table: thousandths; more digits near zero, so that none is shown as zero."""
    if value >= 0.0095 or value == 0:
        return ".3f"
    return ".5f" if value >= 5e-6 else ".1g"


def _fine(value: float) -> str:
    return f"{value:{fine_form(value)}}"


def _mm(value: float | None) -> str:
    """A length in words."""
    return "an unknown distance" if value is None else f"{value:{length_form(value)}} mm"


def _ended(sentence: str) -> str:
    """With a full stop, unless it is a question."""
    return sentence + "." * (not sentence.endswith("?"))


def why_larger(record: dict[str, Any]) -> list[str]:
    """Why the error is larger than the covariance states."""
    tre = record.get("tre")
    if tre is None or not tre.get("contradictions"):
        return []
    contradicted = _ended("; ".join(tre["contradictions"]))
    return [
        f"By the noise model alone the error would be {_mm(tre['stated_mm'])}, but {contradicted} "
        "The error above includes this."
    ]


def where(record: dict[str, Any]) -> list[str]:
    """The error in the middle, where it is largest, and at requested points."""
    tre = record.get("tre")
    if tre is None or tre.get("rms_mm") is None:
        return []
    named = {point["name"]: point for point in tre["points"] if point["name"] != ASKED_FOR}
    # The mean square error is convex in the place, so it is largest in a corner. Where it is
    # smallest is not said: that may be anywhere.
    worst = max(named.values(), key=lambda point: point["tre_mm"])
    lines = [
        f"In {_place(named['middle'])} it is {_mm(named['middle']['tre_mm'])}; at worst, in "
        f"{_place(worst)}, {_mm(worst['tre_mm'])}."
    ]
    flat = tre["region"]["radius_mm"] is None
    weak = (record["observability"]["weakest_sd_mm"] or 0.0) > WEAK_MM
    if flat and (weak or (tre["image_share"] or 1.0) < _SMALL_SHARE):
        left, right, near, far = map(round, tre["region"]["lateral_mm"] + tre["region"]["depth_mm"])
        lines.append(
            f"This is for the part in which targets were seen (lateral {left} to {right}, "
            f"depth {near} to {far} mm); elsewhere the error may be larger."
        )
    for point in tre["points"]:
        if point["name"] == ASKED_FOR:
            low, high = point["interval_95_mm"]
            u, v = point["image"]
            lines.append(
                f"At ({u:g}, {v:g}) {tre['unit']}: {_mm(point['tre_mm'])}, between {_mm(low)} and "
                f"{_mm(high)} with 95 % probability."
            )
    return lines


def _place(point: dict[str, Any]) -> str:
    lateral, axial = map(round, point["position_mm"])
    corner = "" if point["name"] == "middle" else " corner"
    return f"the {point['name']}{corner} (lateral {lateral}, depth {axial} mm)"


def limits(record: dict[str, Any]) -> list[str]:
    """What limits the accuracy: noise, offsets, poses, single images."""
    found, tre = record.get("limits"), record.get("tre")
    if found is None or tre is None:
        return []
    lines = []
    if tre.get("contradictions"):
        lines.append(
            "Most of all, what contradicts the noise model (see above). The rest of this list is "
            "about the error by the noise model alone."
        )
    shares = {kind: share for kind, share in found["error_share"].items() if share is not None}
    if shares:
        ranked = sorted(shares.items(), key=lambda item: -item[1])
        named = [f"{_KINDS[kind]} ({100 * share:.0f} %)" for kind, share in ranked if share >= 0.1]
        the = "By the SDs that were held fixed, the" if _sds_held(record) else "The"
        lines.append(f"{the} mean square error comes mainly from {', then '.join(named)}.")
    poses = _poses(record)
    if poses:
        lines.append(poses)
    if tre["slow_path"] >= SLOW:
        lines.append(
            "The images lie along one slow path. Errors that change as slowly look like a movement "
            "of the calibration, and the stated error allows for it; images in a random order of "
            "poses would make it smaller."
        )
    influence = record.get("influence")
    if influence is not None:
        strong = [
            (image, influence["moved_mm"][image])
            for image in influence["most"]
            if (influence["moved_mm"][image] or 0.0) > _MOST_MOVED_SHARE * (tre["stated_mm"] or 0.0)
        ]
        if strong:
            told = ", ".join(f"{image} ({_mm(moved)})" for image, moved in strong[:3])
            lines.append(
                f"Leaving out one of these images would change the calibration most: {told}."
            )
    return lines


def _sds_held(record: dict[str, Any]) -> bool:
    """Whether the errors' SDs were given or assumed, and not estimated."""
    return record["prior"] in TUNED and record["degrees_of_freedom"] is None


def scatter(record: dict[str, Any]) -> list[str]:
    """Why the target scatters, which is not the error of the calibration."""
    found = record.get("limits")
    if found is None or record.get("tre") is None:
        return []
    precision = record["reconstruction_precision_mm"]
    left_out = record["robust"] and record["outliers"]
    of_calibration = record["reconstruction_precision_set"] == "calibration"
    tested = "" if of_calibration else f"{record['reconstruction_precision_images']} "
    counted = " (those left out included)" if left_out and of_calibration else ""
    shown = ""
    if precision is not None:
        shown = (
            f"; reconstruction precision (Eq. 8) over the {tested}"
            f"{record['reconstruction_precision_set']} images{counted}: {_mm(precision)}"
        )
    ranked = sorted(found["scatter_share"].items(), key=lambda item: -(item[1] or 0.0))
    told = [f"{100 * share:.0f} % {_KINDS[kind]}" for kind, share in ranked if share is not None]
    tre, within = record["tre"], record["rms_mm"] or 0.0
    if (tre["rms_mm"] or 0.0) < within:
        means = (
            "This scatter comes from how the images were taken and read, and no calibration "
            "removes it; the calibration's own error is the smaller number above."
        )
    elif (tre["stated_mm"] or 0.0) < within:
        means = "The error to expect is larger because of what contradicts the noise model."
    else:
        means = (
            "The images agree with each other better than they determine the calibration: add "
            "other poses."
        )
    lines = [
        f"With this calibration, the images put the target {_mm(record['rms_mm'])} from its "
        f"estimated place (RMS{shown}). Shares of the mean square: {', '.join(told)}. {means}"
    ]
    outlying = outlying_test_images(record)
    if outlying:
        lines.append(
            f"Test images {images_named(outlying)} do not fit the others, which scatter as "
            "expected: check their points. They are not held against this calibration."
        )
    return lines


def _poses(record: dict[str, Any]) -> str | None:
    """Whether other poses would help more than further ones of the same kind."""
    more = record.get("next_poses")
    if not more or not more["tre_then_mm"] or not more["tre_now_mm"]:
        return None
    gain = (more["tre_now_mm"] / more["tre_then_mm"]) ** 2 - 1
    alike, count = gain * record["images_used"], len(more["poses"])
    if alike < 2 * count:
        return (
            "The poses are well chosen: others would hardly help more than further ones like these."
        )
    return (
        f"The poses: {count} well-chosen images would help as much as {alike:.0f} more of the same "
        "kind."
    )


def believe(record: dict[str, Any]) -> list[str]:
    """Why to prefer this answer to the conventional one, from the comparison of both."""
    beside = record.get("comparison")
    if beside is None:
        return []
    rms, conventional = beside["rms_mm"], beside["conventional_rms_mm"]
    shown, other = _fine(rms), _fine(conventional)
    first = (
        f"Its RMS residual is larger than that of the conventional fit ({shown} against {other} "
        "mm), as it must be: the conventional fit minimises exactly this."
        if (rms or 0.0) > conventional and shown != other
        else f"Its RMS residual is that of the conventional fit ({shown} against {other} mm)."
    )
    lines = [first]
    if beside["conventional_tre_mm"] is not None and beside["tre_mm"] is not None:
        equal, own = _mm(beside["conventional_tre_mm"]), _mm(beside["tre_mm"])
        sizes = "sizes that were held fixed" if _sds_held(record) else "estimated sizes"
        lines.append(
            f"With independent Gaussian errors of the {sizes} (assumed for this comparison "
            f"only), a fit with equal weights has an expected error of {equal}"
            + (
                f", one with weights from these sizes {own}."
                if record["prior"] in TUNED
                else f". With offsets that may be anything within the bound, this one has {own}."
            )
        )
    gain, sd = beside["log_density_gain"], beside["log_density_gain_sd"]
    if gain is not None and sd is not None:
        than = "better than" if gain > 0 else "worse than"
        if abs(gain) <= CLEAR_SDS * sd:
            than = "about as well as"
        lines.append(
            f"This calibration predicts held-out images {than} the conventional fit (log "
            f"density {gain:+.1f} +- {sd:.1f})."
        )
    lines.append(f"In the image, the two calibrations differ by {_mm(beside['apart_mm'])}.")
    return [" ".join(lines)]


def spread_of_transform(record: dict[str, Any]) -> tuple[float, float] | None:
    """Root mean square error of X by its covariance, or None.

    It is that of the translation (mm) and of the rotation (degrees), each of all three axes
    together: the root of the sum of their variances.
    """
    covariance = record["covariance"]
    if covariance is None:
        return None
    variances = [covariance[axis][axis] for axis in range(6)]
    if min(variances) < 0:
        return None
    return math.sqrt(sum(variances[:3])), math.degrees(math.sqrt(sum(variances[3:])))


def certainty(record: dict[str, Any]) -> list[str]:
    """How certain the transform is, and on which assumptions this rests."""
    spread = spread_of_transform(record)
    if spread is None:
        return ["These images do not show how certain the transform is."]
    along = max(range(3), key=lambda axis: record["covariance"][axis][axis])
    about = max(range(3), key=lambda axis: record["covariance"][3 + axis][3 + axis])
    lines = [
        f"The root mean square error of the image's position on the probe is {_mm(spread[0])} "
        f"(all three axes), largest along its {_AXES[along]} axis. That of its orientation is "
        f"{spread[1]:{length_form(spread[1])}} degrees, largest about its {_AXES[about]} axis."
    ]
    if record["method"] == "conventional":
        lines.append(
            "The method takes every target to lie in the image plane. If they lie to one side of "
            "it on average, the image is off by as much, and the residuals of few images hardly "
            "show it."
        )
    unseen = record["observability"]["known_only_from_prior"]
    if unseen and record["prior"] in TUNED:
        law = record.get("offset_law")
        on = rests_on(law and law["mean_probability"])
        lines.append(f"The images do not determine {unseen}: it rests on {on}.")
    if record.get("offset_law"):
        lines.append(record["offset_law"]["words"])
    return lines


def _addition(record: dict[str, Any]) -> str:
    """First the poses that tell most about the weakest direction, then those that always help."""
    first = record["observability"].get("advice")
    if not first:
        return _MORE_VARIED
    told = f"{first[0].upper()}{first[1:]}."
    return f"{told} {_BEYOND}" if first.startswith("add ") else told


def _out_of_plane(record: dict[str, Any]) -> bool:
    elevational = record["sigma_elevation_mm"] or 0.0
    in_plane = max(record["sigma_lateral_mm"] or 0.0, record["sigma_range_mm"] or 0.0)
    return elevational > 1.5 * in_plane


def advice(record: dict[str, Any]) -> list[str]:
    """What to do, as sentences."""
    if record.get("wrong_frames"):
        return []
    # First what may be wrong with the images that there are.
    found = [_check_outliers(record), _next_step(record)]
    converged = record["status"] == "converged"
    if converged and record["method"] == "conventional" and _out_of_plane(record):
        found.append(
            "Most of the error is out of the image plane, where the conventional method assumes "
            "none: try --method joint."
        )
    return [text for text in found if text is not None]


def _check_outliers(record: dict[str, Any]) -> str | None:
    """What to do about images that do not fit the rest."""
    outliers = record["outliers"]
    if not outliers:
        return None
    plural, was, them = ("", "was", "it") if len(outliers) == 1 else ("s", "were", "them")
    images = f"image{plural} {runs_in_words(outliers, 10)} (counted from 0)"
    if record.get("robust"):
        return f"Check {images}, which {was} left out, and pick the target in {them} again."
    return (
        f"Check {images} and pick the target in {them} again, or calibrate with --robust, which "
        f"leaves {them} out."
    )


def _next_step(record: dict[str, Any]) -> str | None:
    """What to do before anything else, by how the solve ended and what looks wrong."""
    status, kind = record["status"], _unmodelled(record).get("kind")
    if status == "unobservable":
        return _addition(record)
    if (step := _STEPS.get(status) or _STEPS.get(kind or "")) is not None:
        return step
    if (record.get("tre") or {}).get("contradictions"):
        return (
            "First see to what contradicts the noise model, which is said above; add images after "
            "that."
        )
    few = record["images_used"] < ENOUGH_IMAGES
    if not record.get("doubtful_unit") and (few or record["verdict"] == "uncertain"):
        return _addition(record)
    return None
