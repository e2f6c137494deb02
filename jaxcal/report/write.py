"""The report folder: calibration.json, residuals.csv and figures, of one calibration or none."""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.recording import Recording
from jaxcal.io.atomic import STAGED, made_folder, replace_files, write_text
from jaxcal.io.given_files import path_name
from jaxcal.io.table import csv_text
from jaxcal.report.convergence import Curve
from jaxcal.report.verdict import verdict
from jaxcal.result.calibration import Calibration
from jaxcal.result.saved import is_calibration_record
from jaxcal.runtime.array_types import Int

TEST_COLUMNS = ("image", "used", "lateral_mm", "elevational_mm", "axial_mm", "distance_mm", "frame")
"""Columns of test_residuals.csv: from the point of each test image to the mean of all of them."""

COLUMNS = (
    "image",
    "used",
    "lateral_mm",
    "elevational_mm",
    "axial_mm",
    "elevation_mm",
    "elevation_sd_mm",
    "at_bound",
    "frame",
)
"""Columns of residuals.csv: the residual from the image plane, the estimated offset, and the number
of the frame in the file that was imported."""

FIGURES = ("residuals", "offsets", "accuracy", "influence", "limits", "convergence")
NAMES = (
    "calibration.json",
    "verdict.txt",
    "residuals.csv",
    "test_residuals.csv",
    "comparison.json",
    *(f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")),
)
"""Files that a report may have."""


@contextmanager
def prepare_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """As :func:`made_folder`, before other work begins, for a report.

    Raises:
        InputError: files of a report's names are there, but no report.
        OutputError: it cannot be made or written to.
    """
    with made_folder(path_name(path)) as folder:
        _check_report(folder)
        yield folder


def _check_report(folder: Path) -> None:
    """See that files of a report's names are those of a report, which may be replaced."""
    found = [name for name in NAMES if (folder / name).exists()]
    if not found or any(folder.glob(STAGED)):
        return
    with suppress(FormatError):
        if is_calibration_record(folder / NAMES[0]):
            return
    raise InputError(f"{folder}: holds {found[0]}, but no report of jaxcal: name another folder")


def write_report(
    folder: Path,
    record: dict[str, Any],
    result: Calibration,
    recording: Recording,
    curves: list[Curve],
    comparison: dict[str, Any] | None = None,
) -> list[Path]:
    """Write the report of one calibration; an earlier one in the folder is replaced as a whole.

    Curves of the method's objective make the figure convergence, and records of several methods
    comparison.json.

    Returns:
        The files: calibration.json, verdict.txt, residuals.csv, test_residuals.csv if there
        are test images, and each figure as .png and .svg: residuals and offsets; accuracy,
        influence and limits, if the answer may be used; and convergence.

    Raises:
        OutputError: the report could not be written; an earlier one is unchanged.
    """
    # Matplotlib takes half a second to import, so it is imported only here, to draw.
    from jaxcal.report import plots

    truth = None if recording.truth is None else recording.truth.elevation
    figures = {
        "residuals": plots.plot_residuals(result),
        "offsets": plots.plot_offsets(result, truth),
    }
    if record.get("tre") is not None:
        figures |= {
            "accuracy": plots.plot_tre(result, record["tre"].get("factor", 1.0)),
            "influence": plots.plot_influence(result),
            "limits": plots.plot_limits(result),
        }
    if curves:
        figures["convergence"] = plots.convergence_figure(curves)
    texts = {
        "calibration.json": _json(record),
        "verdict.txt": "\n".join(verdict(record)) + "\n",
        "residuals.csv": _residual_table(result, recording.calibration.frame),
    }
    if record["test_residual_mm"] is not None:
        texts["test_residuals.csv"] = _test_table(record)
    if comparison is not None:
        texts["comparison.json"] = _json(comparison)
    # File names that are not UTF-8 are lone surrogates in the texts.
    files = {name: text.encode("utf-8", "backslashreplace") for name, text in texts.items()}
    for name, figure in figures.items():
        for kind in ("png", "svg"):
            drawn = io.BytesIO()
            figure.savefig(drawn, format=kind)
            files[f"{name}.{kind}"] = drawn.getvalue()
    replace_files(folder, files, NAMES)
    return [folder / name for name in files]


def _json(record: dict[str, Any]) -> str:
    return json.dumps(record, indent=2, allow_nan=False) + "\n"


def write_json(path: str | os.PathLike[str], record: dict[str, Any]) -> None:
    """Write a record as a JSON file, complete or not at all.

    Raises:
        OutputError: it could not be written.
    """
    write_text(path, _json(record))


def _residual_table(result: Calibration, frame: Int[np.ndarray, " n"] | None) -> str:
    answer = result.numpy()
    rows: list[tuple[object, ...]] = [COLUMNS]
    for image in range(len(answer.mask)):
        used = bool(answer.mask[image] > 0)
        numbers = [*answer.residual[image], answer.elevation[image], answer.elevation_sd[image]]
        cells = [_cell(value) if used else "" for value in numbers]
        number = "" if frame is None else int(frame[image])
        rows.append((image, int(used), *cells, int(answer.at_bound[image] > 0), number))
    return csv_text(rows)


def _test_table(record: dict[str, Any]) -> str:
    frame = record["test_frame"]
    rows: list[tuple[object, ...]] = [TEST_COLUMNS]
    for image, residual in enumerate(record["test_residual_mm"]):
        cells = [""] * 4 if residual is None else [*residual, math.hypot(*residual)]
        number = "" if frame is None else frame[image]
        rows.append((image, int(residual is not None), *cells, number))
    return csv_text(rows)


def _cell(value: np.floating) -> str:
    """A number as text; empty if it is not known, since programs treat NaN differently."""
    return repr(float(value)) if np.isfinite(value) else ""
