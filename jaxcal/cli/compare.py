"""``jaxcal compare``: do calibrations of one probe agree?"""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Any

import click

from jaxcal.cli.common import ExitCode, json_option, print_json, print_page
from jaxcal.report.paragraphs import Verbatim, simple_table
from jaxcal.runtime.messages import counted

if TYPE_CHECKING:
    from rich.table import Table

    from jaxcal.diagnostics.comparison import Comparison
    from jaxcal.result.transform import ImageTransform

MOST_FILES = 100
"""Most calibrations that are compared at once, each with each."""

_SAME = 1e-3
"""Share of the expected distance (of 1 mm, if that is not known) below which two are the same."""


@click.command(short_help="Say whether calibrations of one probe agree.")
@click.argument("calibrations", type=click.Path(), metavar="CAL CAL ...", nargs=-1, required=True)
@click.option(
    "--pixel",
    type=float,
    nargs=2,
    multiple=True,
    metavar="U V",
    help="An image point, px (mm without pixels); may be repeated. By default the middle and the "
    "corners of the image, as far as it was used for the first CAL that knows them.",
)
@json_option
def compare(
    calibrations: tuple[str, ...], pixel: tuple[tuple[float, float], ...], as_json: bool
) -> int:
    """How far apart calibrations put the same image points, and how far their errors would.

    Each CAL is a calibration.json of "jaxcal calibrate --out", or any other file that "jaxcal
    export" writes. They must be of the same probe and marker, from different recordings. The status
    is 5 if two of them are farther apart than 95 % of such pairs would be by their covariances; of
    more calibrations, if two are farther apart than the farthest two would be in 95 % of cases. Few
    images, which leave the size of the errors uncertain, are allowed for. If the verdict of one
    expects larger errors than its covariance says, the factor is printed.
    """
    import numpy as np

    from jaxcal import InputError
    from jaxcal.diagnostics.comparison import compare_calibrations
    from jaxcal.diagnostics.intervals import LEVEL
    from jaxcal.result.saved import load_calibration, stated_points

    if not 2 <= len(calibrations) <= MOST_FILES:
        raise click.UsageError(f"name 2 to {MOST_FILES} calibrations, not {len(calibrations)}")
    transforms = [load_calibration(name) for name in calibrations]
    points = np.array(pixel) if pixel else None
    for name in calibrations:
        points = stated_points(name) if points is None else points
    if points is None:
        raise InputError(
            "none of these files says which part of the image was used: name points of the image "
            "by --pixel U V"
        )
    each = list(combinations(zip(calibrations, transforms, strict=True), 2))
    # Of many pairs some are beyond 95 % by chance.
    level = 1 - (1 - LEVEL) / len(each)
    pairs, clear = [], 0
    for (first, one), (second, other) in each:
        pairs.append((first, second, compare_calibrations(one, other, points)))
        clear += compare_calibrations(one, other, points, level=level).agree is False
    notes = _notes(calibrations, transforms)
    if as_json:
        found = [_record(*pair) for pair in pairs]
        named = zip(calibrations, transforms, strict=True)
        factors = {name: made.tre_factor for name, made in named}
        print_json({"pairs": found, "tre_factor": factors, "notes": notes})
    elif len(pairs) == 1:
        unit = "mm" if transforms[0].scale_mm_per_px is None else "px"
        print_page(_table_of_points(pairs[0][2], unit), _sentence(pairs[0][2]), *notes)
    else:
        numbered = [Verbatim(f"{k}: {name}") for k, name in enumerate(calibrations, start=1)]
        found = [pair[2] for pair in pairs]
        table = _table_of_pairs(found, len(calibrations))
        print_page(*numbered, table, _summary(found, clear), *notes)
    return ExitCode.UNCERTAIN if clear else ExitCode.CONVERGED


def _notes(calibrations: tuple[str, ...], transforms: list[ImageTransform]) -> list[str]:
    """What the calibrations should have in common and do not, and what their files say of them."""
    from jaxcal.report.differences import what_differs
    from jaxcal.result.saved import stated_source
    from jaxcal.runtime.messages import quoted

    whose = ["the first", "the second"] if len(calibrations) == 2 else list(calibrations)
    notes = [
        differing
        for made, name in zip(transforms[1:], whose[1:], strict=True)
        for differing in what_differs(
            (transforms[0].probe_frame, made.probe_frame),
            (transforms[0].scale_mm_per_px, made.scale_mm_per_px),
            (whose[0], name),
        )
    ]
    for name, made in dict(zip(calibrations, transforms, strict=True)).items():
        if made.tre_factor > 1:
            notes.append(
                f"The verdict of {name} expects errors {made.tre_factor:.1f} times as large as its "
                "covariance says. The expected distances do not include this."
            )
        if made.doubtful_unit is not None:
            notes.append(f"{name}: {made.doubtful_unit}.")
    sources = [name for each in calibrations if (name := stated_source(each))]
    notes += [
        f"Several calibrations state that they were made from {quoted(name)}. If that is one "
        "recording, they share its errors, and their distance says nothing about their accuracy."
        for name in sorted({name for name in sources if sources.count(name) > 1})
    ]
    return notes


def _record(first: str, second: str, found: Comparison) -> dict[str, Any]:
    return {
        "first": first,
        "second": second,
        "points": found.points,
        "apart_mm": found.apart_mm,
        "expected_mm": found.expected_mm,
        "rms_mm": found.rms_mm,
        "expected_rms_mm": found.expected_rms_mm,
        "limit_95_mm": found.limit_mm,
        "rotation_deg": found.rotation_deg,
        "agree": found.agree,
        "same": _are_same(found),
    }


def _are_same(found: Comparison) -> bool:
    """Whether two files hold one calibration."""
    expected = 1.0 if found.agree is None else found.expected_rms_mm
    return found.rms_mm < _SAME * expected


def _millimetres(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def _table_of_points(found: Comparison, unit: str) -> Table:
    table = simple_table((f"image point ({unit})", "apart (mm)", "expected, RMS (mm)"), ())
    for (u, v), apart, expected in zip(
        found.points, found.apart_mm, found.expected_mm, strict=True
    ):
        table.add_row(f"{u:.0f}, {v:.0f}", _millimetres(apart), _millimetres(expected))
    table.add_row("RMS of all", _millimetres(found.rms_mm), _millimetres(found.expected_rms_mm))
    return table


def _table_of_pairs(pairs: list[Comparison], count: int) -> Table:
    """Each pair of ``count`` calibrations in a row, by their numbers: paths are too long for it."""
    sizes = ("apart, RMS (mm)", "expected (mm)", "95 % below (mm)")
    table = simple_table(("first", "second", *sizes, "agree"), ("agree",))
    words = {True: "yes", False: "no", None: "-"}
    for places, found in zip(combinations(range(1, count + 1), 2), pairs, strict=True):
        numbers = (found.rms_mm, found.expected_rms_mm, found.limit_mm)
        agree = "the same" if _are_same(found) else words[found.agree]
        table.add_row(*map(str, places), *map(_millimetres, numbers), agree)
    return table


def _sentence(found: Comparison) -> str:
    apart = (
        f"image points are {found.rms_mm:.2f} mm apart (RMS), and the two images are turned by "
        f"{found.rotation_deg:.2f} degrees against each other"
    )
    if _are_same(found):
        return (
            "The two are one and the same calibration, which says nothing about its accuracy: "
            "compare calibrations from different recordings."
        )
    if found.agree is None:
        return (
            f"{apart[0].upper()}{apart[1:]}. How far apart they should be is not known: a file "
            "holds no covariance."
        )
    limit = f"By both covariances 95 % of such pairs are less than {found.limit_mm:.2f} mm apart."
    if found.agree:
        return f"The calibrations agree: {apart}. {limit}"
    return (
        f"The calibrations do not agree: {apart}. {limit} At least one is less accurate than its "
        "covariance says, or the probe's marker or the geometry of its image changed in between."
    )


def _summary(found: list[Comparison], clear: int) -> str:
    """Words for several pairs, ``clear`` of which are apart beyond what chance makes of all."""
    known = [each for each in found if each.agree is not None]
    worst = max(each.rms_mm for each in found)
    largest = f"The two that differ most put the image {worst:.2f} mm apart (RMS)"
    if not known:
        return f"{largest}. How far apart they should be is not known: no covariances."
    from jaxcal.diagnostics.intervals import LEVEL

    apart = sum(not each.agree for each in known)
    return (
        f"{largest}. {apart} of {len(known)} pairs are farther apart than 95 % of such pairs would "
        f"be by their covariances; about {(1 - LEVEL) * len(known):.1f} are expected by chance. "
        + (
            f"{counted(clear, 'pair', 'is', 'are')} farther apart than any of so many is by chance."
            if clear
            else "None is farther apart than one of so many may be by chance."
        )
    )
