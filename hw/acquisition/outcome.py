"""The result of a finished acquisition: calibrated from its file, and printed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from jaxcal.runtime.messages import command_line

if TYPE_CHECKING:
    from hw.acquisition.acquire import Outcome


def calibrate_and_print(path: str, *lines: str) -> dict[str, Any]:
    """Calibrate from a finished file as ``jaxcal calibrate`` would, and print the result.

    Args:
        path: of the recording.
        lines: to print below the verdict.

    Returns:
        The calibration's record (:func:`jaxcal.report.record.calibration_record`).

    Raises:
        KeyboardInterrupt: interrupted; its text says that the recording is complete.
    """
    again = ["jaxcal", "calibrate", path]
    try:
        from jaxcal.calibration.calibrate import calibrate
        from jaxcal.cli.common import print_page, segmented
        from jaxcal.io.given_files import naming
        from jaxcal.io.hdf5 import load
        from jaxcal.report.paragraphs import Verbatim
        from jaxcal.report.record import calibration_record
        from jaxcal.report.tables import calibration_table
        from jaxcal.report.verdict import verdict

        recording, notes = segmented(load(path))
        images = recording.calibration
        scale = ("scale",) if images.kind == "pixel" and images.spacing_mm is None else ()
        again += ["--estimate", "scale"] if scale else []
        with naming(path):
            result = calibrate(recording, estimate=scale)
        record = calibration_record(result, recording)
        record["warnings"] += notes
        shown = Verbatim(f"  {command_line([*again, '--report', 'report.html'])}")
        page = (*verdict(record), "", *lines, f"{path}: again, with a report:", shown)
        print_page(calibration_table(record), *page)
    except KeyboardInterrupt:
        text = "interrupted; the recording is complete, calibrate it with: "
        raise KeyboardInterrupt(text + command_line(again)) from None
    return record


def lines_of(path: str, outcome: Outcome, speed: float) -> list[str]:
    """How a robot's acquisition went, for a person."""
    lines = [
        f"{outcome.images} images in {path}, {outcome.taken / outcome.seconds * 60:.1f} per "
        f"minute of bench time ({outcome.seconds:.0f} s"
        + (f", {outcome.seconds / speed:.0f} s of real time)" if speed != 1.0 else ")")
    ]
    if outcome.given_up:
        rows = ", ".join(str(row + 1) for row in outcome.given_up)
        again = "" if outcome.resume is None else f"; again: {outcome.resume}"
        lines.append(f"without an image: poses {rows} (no mid-plane found, or skipped){again}")
    share = share_inside(path)
    if share is not None:
        lines.append(f"true offsets inside their brackets: {share[0]} of {share[1]}")
        lines.append(f"SD of the true offsets: {share[2]:.2f} mm")
    return lines


def share_inside(path: str) -> tuple[int, int, float] | None:
    """Images whose true offset lies in its bracket, those where it is known, their SD (mm).

    None for recordings of a real bench, and for a single image, which has no SD.
    """
    with h5py.File(path) as file:
        low, high, true = (
            np.asarray(file[f"placement/{name}"]) for name in ("low", "high", "true_elevation")
        )
    known = np.isfinite(true)
    if known.sum() < 2:
        return None
    inside = (low <= true) & (true <= high)
    return int(inside.sum()), int(known.sum()), float(true[known].std(ddof=1))
