"""Tables for a terminal, from the records of :mod:`jaxcal.report.record`."""

from __future__ import annotations

import math
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table

from jaxcal.report.certified import certificate_words
from jaxcal.report.paragraphs import simple_table
from jaxcal.report.verdict import fine_form, length_form, spread_of_transform, title_of_transform
from jaxcal.result.saved import ASKED_FOR
from jaxcal.runtime.messages import counted

_UNKNOWN = "-"
_IN_OWN_UNITS = ("scale", "sound-speed", "delay")
"""The further unknowns that have lines of their own."""


def calibration_table(record: dict[str, Any]) -> RenderableType:
    """One calibration: transform, target, errors and quality."""
    transform = Table(title=title_of_transform(record), box=box.SIMPLE, show_header=False)
    for _ in range(4):
        transform.add_column(justify="right")
    for row in record["image_plane_to_probe"]:
        transform.add_row(*(_number(value, ".6f") for value in row))

    facts = Table(box=box.SIMPLE, show_header=False)
    facts.add_column(style="bold")
    facts.add_column()
    for name, value in _facts(record):
        facts.add_row(name, value)
    return Group(transform, facts)


def comparison_table(records: dict[str, dict[str, Any]], milliseconds: dict[str, float]) -> Table:
    """Several calibrations of one recording by name, a row each, with the times of their solves."""
    numbers = (
        "reconstruction\nprecision (mm)",
        "error of X\n(mm)",
        "error of X\n(deg)",
        "RMS\n(mm)",
        "iterations",
        "solve\n(ms)",
    )
    table = simple_table(("method", *numbers, "status"), ("method", "status"))
    for name, record in records.items():
        error = record.get("truth_error", {})
        cells = [
            _number(record["reconstruction_precision_mm"], ".3f"),
            _number(error.get("translation_mm"), ".3f"),
            _number(error.get("rotation_deg"), ".3f"),
            _number(record["rms_mm"], ".3f"),
            str(record["iterations"]),
            _number(milliseconds.get(name), ".1f"),
        ]
        table.add_row(name, *cells, record["status"])
    return table


def _facts(record: dict[str, Any]) -> list[tuple[str, str]]:
    prior = "" if record["prior"] == "none" else f", {record['prior']} prior"
    kinds = ("lateral", "range", "elevation")
    lateral, along, elevational = (_size(record[f"sigma_{kind}_mm"]) for kind in kinds)
    facts = [
        *_accuracy(record),
        ("method", f"{record['method']}{prior}"),
        ("status", f"{record['status']} after {counted(record['iterations'], 'iteration')}"),
        ("images", f"{record['images_used']} used of {record['images']}"),
        *frames_and_target(record),
        ("error SD (mm)", f"lateral {lateral}, range {along}, elevational {elevational}"),
        ("residual RMS (mm)", _residuals(record)),
        (
            f"reconstruction precision, {record['reconstruction_precision_set']} images (mm)",
            _size(record["reconstruction_precision_mm"]),
        ),
    ]
    if (proved := certificate_words(record)) is not None:
        facts.append(("global minimum", proved))
    if (spread := spread_of_transform(record)) is not None:
        facts.append(
            ("RMS error of image_plane_to_probe", f"{_size(spread[0])} mm, {_size(spread[1])} deg")
        )
    facts += further_facts(record)
    sight = record["observability"]
    # If the direction is not determined at all, the SD only shows where rounding begins.
    sd = sight["weakest_sd_mm"] if record["status"] != "unobservable" else None
    told = "" if sd is None else f" (SD {sd:{length_form(sd)}} mm)"
    facts.append(("least well determined", sight["weakest_direction"] + told))
    if "truth_error" in record:
        names = ("translation_mm", "rotation_deg", "point_mm")
        moved, turned, target = (_size(record["truth_error"][name]) for name in names)
        facts.append(("error against truth", f"{moved} mm, {turned} deg; target {target} mm"))
    return facts


def further_facts(record: dict[str, Any]) -> list[tuple[str, str]]:
    """The unknowns that were estimated beside the transform and the target, with their SDs."""
    facts = []
    if record["scale_mm_per_px"] is not None:
        facts.append(("pixel scale (mm/px)", _numbers(record["scale_mm_per_px"], ".6f")))
    for name, key, unit, factor, form in (
        ("sound speed (m/s)", "sound_speed", "_m_s", 1.0, ".1f"),
        ("delay (us)", "delay", "_s", 1e6, ".3f"),
    ):
        value, sd = record[f"{key}{unit}"], record[f"{key}_sd{unit}"]
        if value is not None:
            spread = _number(None if sd is None else factor * sd, form)
            facts.append((name, f"{factor * value:{form}} +- {spread}"))
    for name, found in record["further_unknowns"].items():
        if name not in _IN_OWN_UNITS:
            words = [
                f"{tangent} {_number(value, '.5g')} +- {_number(sd, '.2g')}"
                for tangent, value, sd in zip(
                    found["tangents"], found["values"], found["sd"], strict=True
                )
            ]
            facts.append((name, ", ".join(words)))
    return facts


def frames_and_target(record: dict[str, Any]) -> list[tuple[str, str]]:
    """The frames of the poses, where they have names, and the target in the second one."""
    frames, covariance = record["pose_frames"], record["point_covariance_mm2"]
    facts = [] if frames is None else [("poses", f"from {frames['from']} to {frames['to']}")]
    where = "tracker" if frames is None else frames["to"]
    facts.append((f"target in {where} frame (mm)", _numbers(record["point_mm"], ".3f")))
    if covariance is not None:
        # A variance that is not known is null, one that is zero may be rounded to below.
        variances = [covariance[axis][axis] for axis in range(3)]
        sd = [None if each is None else math.sqrt(max(each, 0.0)) for each in variances]
        facts.append(("SD of the target (mm)", ", ".join(map(_size, sd))))
    return facts


def _accuracy(record: dict[str, Any]) -> list[tuple[str, str]]:
    """The error to expect, over the image and at points."""
    tre = record.get("tre")
    if tre is None or tre.get("rms_mm") is None:
        return []

    def shown(error: float | None, interval: list[float | None]) -> str:
        low, high = map(_size, interval)
        return f"{_size(error)}, 95 % interval {low} to {high}"

    facts = [("error to expect at the image (mm)", shown(tre["rms_mm"], tre["interval_95_mm"]))]
    for point in tre["points"]:
        u, v = point["image"]
        place = f"{point['name']} ({u:z.0f}, {v:z.0f})"
        if point["name"] == ASKED_FOR:
            place = f"({u:g}, {v:g})"
        error = shown(point["tre_mm"], point["interval_95_mm"])
        facts.append((f"  at {place} {tre['unit']}", error))
    return facts


def _residuals(record: dict[str, Any]) -> str:
    found = record.get("limits")
    whole = _size(record["rms_mm"])
    if found is None:
        return whole
    return (
        f"{whole}: {_size(found['rms_in_plane_mm'])} in the image plane, "
        f"{_size(found['rms_elevational_mm'])} out of it"
    )


def _size(value: float | None) -> str:
    """A length (mm) or an angle (degrees) that is not negative."""
    return _UNKNOWN if value is None else format(value, fine_form(value))


def _number(value: float | None, form: str) -> str:
    return _UNKNOWN if value is None else format(value, form)


def _numbers(values: list[float | None], form: str) -> str:
    return ", ".join(_number(value, form) for value in values)
