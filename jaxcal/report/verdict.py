"""A calibration in a few plain sentences: how good, how certain, what looks wrong, what to do."""

from __future__ import annotations

import math
from typing import Any

from jaxcal.diagnostics import messages
from jaxcal.report.certified import certificate_words
from jaxcal.report.resampled import resampled_sentences

GOOD = 0.5
"""Largest SD of X, in mm and in degrees, that is called good,"""
FAIR = 1.5
"""and fair."""
FEW_IMAGES = 20

_AXES = ("lateral (sideways)", "elevational (out-of-plane)", "axial (depth)")
_MORE_VARIED = (
    "Add images with the probe tilted by 20 to 30 degrees about each of its three axes, and with "
    "the target in all parts of the image, near and far, left and right."
)


def verdict(record: dict[str, Any]) -> list[str]:
    """Sentences for a person, most important first.

    Args:
        record: of :func:`jaxcal.report.record.calibration_record`.

    Returns:
        Paragraphs without line breaks; bullet points start with "- ".
    """
    lines = [_headline(record)]
    if record["status"] in ("converged", "max_iterations"):
        lines += [*_certainty(record), _errors(record), *resampled_sentences(record)]
        proved = certificate_words(record)
        if proved is not None:
            lines.append(f"{proved[0].upper()}{proved[1:]}.")
    if record["warnings"]:
        lines += ["Look at this:", *(f"- {text}" for text in record["warnings"])]
    todo = _advice(record)
    if todo:
        lines += ["What to do:", *(f"- {text}" for text in todo)]
    return lines


def spread_of_transform(record: dict[str, Any]) -> tuple[float, float] | None:
    """SD of X: translation (mm) and rotation (degrees), each over its three axes; or None."""
    covariance = record["covariance"]
    if covariance is None:
        return None
    variances = [covariance[axis][axis] for axis in range(6)]
    if min(variances) < 0:
        return None
    return math.sqrt(sum(variances[:3])), math.degrees(math.sqrt(sum(variances[3:])))


def _headline(record: dict[str, Any]) -> str:
    status = record["status"]
    if status == "failed":
        return "Failed: there is no calibration."
    if status == "unobservable":
        return "Do not use: these images do not determine the calibration."
    if status == "max_iterations":
        return "Do not trust: the solver stopped before it had arrived."
    spread = spread_of_transform(record)
    worst = math.inf if spread is None else max(spread)
    word = "Good" if worst <= GOOD else "Fair" if worst <= FAIR else "Uncertain"
    precision = record["reconstruction_precision_mm"]
    if precision is None:
        return f"{word}: solved from {record['images_used']} images."
    where = "independent test" if record["reconstruction_precision_set"] == "test" else "same"
    return (
        f"{word}: seen through this calibration, the target stays within {precision:.2f} mm "
        f"(one standard deviation) over the {where} images."
    )


def _certainty(record: dict[str, Any]) -> list[str]:
    spread = spread_of_transform(record)
    if spread is None:
        return ["How certain the transform is cannot be said from these images."]
    along = max(range(3), key=lambda axis: record["covariance"][axis][axis])
    about = max(range(3), key=lambda axis: record["covariance"][3 + axis][3 + axis])
    lines = [
        f"The image's position on the probe is known to {spread[0]:.2f} mm, worst along its "
        f"{_AXES[along]} axis; its orientation to {spread[1]:.2f} degrees, worst about its "
        f"{_AXES[about]} axis (one standard deviation)."
    ]
    unseen = record["observability"]["known_only_from_prior"]
    if unseen and record["prior"] in messages.TUNED:
        lines.append(
            f"The images do not show {unseen}: it rests on the assumption that the target lay "
            "evenly on both sides of the image plane."
        )
    if record.get("offset_law"):
        lines.append(record["offset_law"]["words"])
    return lines


def _errors(record: dict[str, Any]) -> str:
    lateral, depth, elevational = (
        record[f"sigma_{name}_mm"] for name in ("lateral", "range", "elevation")
    )
    if None in (lateral, depth, elevational):
        return "The size of the errors is not known."
    return (
        f"Typical errors: {lateral:.2f} mm sideways and {depth:.2f} mm in depth; the target was "
        f"typically {elevational:.2f} mm out of the image plane."
    )


def _addition(record: dict[str, Any]) -> str:
    """What tells most about the weakest direction first, then what is good for all of them."""
    first = record["observability"].get("advice")
    if not first:
        return _MORE_VARIED
    return f"{first[0].upper()}{first[1:]}. {_MORE_VARIED}"


def _out_of_plane(record: dict[str, Any]) -> bool:
    elevational = record["sigma_elevation_mm"] or 0.0
    in_plane = max(record["sigma_lateral_mm"] or 0.0, record["sigma_range_mm"] or 0.0)
    return elevational > 1.5 * in_plane


def _advice(record: dict[str, Any]) -> list[str]:
    status, few = record["status"], record["images_used"] < FEW_IMAGES
    advice = []
    if status == "failed":
        advice.append(
            "Check that poses and images belong together, that poses are probe -> tracker, and "
            "that lengths are in mm."
        )
    elif status == "unobservable":
        advice.append(_addition(record))
    elif status == "max_iterations":
        advice.append(
            "Leave out images whose target was mispicked (they have the largest residuals), or add "
            "images; then calibrate again."
        )
    else:
        spread = spread_of_transform(record)
        if few or spread is None or max(spread) > FAIR:
            advice.append(_addition(record))
    if status == "converged" and record["method"] == "conventional" and _out_of_plane(record):
        advice.append(
            "Most of the error is out of the image plane, which the conventional method takes for "
            "zero: try --method joint."
        )
    if record["outliers"]:
        listed = ", ".join(map(str, record["outliers"][:10]))
        more = ", ..." if len(record["outliers"]) > 10 else ""
        then = (
            "they were left out."
            if record.get("robust")
            else "or calibrate again with --robust, which leaves them out."
        )
        advice.append(
            f"Check images {listed}{more} (counted from 0) and pick the target again; {then}"
        )
    return advice
