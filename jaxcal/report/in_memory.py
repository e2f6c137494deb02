"""Text, notebook view and record of a calibration in Python.

They are the same as what the command line gives for a recording, but for a calibration in memory,
from the problem that it holds. A problem has no velocities of the probe, so images that lag behind
their poses are not looked for.
"""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from jaxcal.data.recording import Images, Recording
from jaxcal.report.record import calibration_record
from jaxcal.result.calibration import Calibration, batch_in_words, check_one, data_of


def recording_of(calibration: Calibration) -> Recording:
    """The data of a calibration, as a recording; without velocities, which a problem does not have.

    Raises:
        CalibrationError: a calibration without its problem.
        InputError: a batch.
    """
    answer = calibration.numpy()
    problem = data_of(answer)
    check_one(answer.status_code)
    mask = np.asarray(problem.mask) > 0
    used = mask[:, None]
    spacing = None
    if problem.pixels:
        spacing = np.asarray(problem.spacing, float) if problem.spacing_known else None
    images = Images(
        poses=np.where(used[..., None], np.asarray(problem.poses, float), np.eye(4)),
        measurements=np.where(used, np.asarray(problem.measurements, float), 1.0),
        kind="pixel" if problem.pixels else "point",
        mask=mask,
        spacing_mm=spacing,
        face_offset_mm=float(np.asarray(problem.face_offset)),
        frame_size=calibration.frame_size,
    )
    return Recording(
        images, probe=calibration.probe, source="memory", pose_frames=calibration.pose_frames
    )


def record_of(
    calibration: Calibration, tre_points: tuple[tuple[float, float], ...] = ()
) -> dict[str, Any]:
    """What ``jaxcal calibrate --json`` prints, for a calibration in memory."""
    return calibration_record(calibration, recording_of(calibration), tre_points=tre_points)


def text_of(calibration: Calibration, width: int = 100) -> str:
    """Table and verdict, as a terminal shows them."""
    from jaxcal.report.paragraphs import page_text
    from jaxcal.report.tables import calibration_table
    from jaxcal.report.verdict import verdict

    record = record_of(calibration)
    text = page_text([calibration_table(record), *verdict(record)], width)
    return "\n".join(line.rstrip() for line in text.splitlines())


def batch_text(calibration: Calibration) -> str:
    """How many calibrations of a batch ended with each status, and how to see one of them.

    Wrong frames are not counted: looking for them takes milliseconds for each calibration.
    """
    return (
        f"Calibration of a {batch_in_words(calibration)}. Frames and units are not checked here, "
        "but in each calibration: batch[0] is the first"
    )


def html_of(calibration: Calibration) -> str:
    """Verdict, error map and numbers for a notebook, without script and with their own styles."""
    from jaxcal.report.page import map_of_error
    from jaxcal.report.paragraphs import as_html
    from jaxcal.report.verdict import title_of_transform, verdict

    record = record_of(calibration)
    lines = verdict(record)
    drawn, tre = "", record["tre"]
    if tre is not None and tre.get("factor") is not None:
        drawn = map_of_error(record, calibration.numpy(), recording_of(calibration))
    matrix = "".join(
        "<tr>" + "".join(f"<td style='text-align:right'>{_cell(v)}</td>" for v in row) + "</tr>"
        for row in record["image_plane_to_probe"]
    )
    return (
        "<style>.jaxcal{--text:currentColor;--line:#888;--grid:#8884;max-width:46em}"
        ".jaxcal svg{max-width:26em;width:100%}.jaxcal svg text{fill:currentColor;font-size:10px}"
        f"</style><div class='jaxcal'>{drawn}{as_html(lines)}<table><caption>"
        f"{escape(title_of_transform(record))}</caption>{matrix}</table></div>"
    )


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.6f}"
