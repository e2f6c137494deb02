"""The certificate of the conventional fit, for the record of a calibration and in words."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from jaxcal import InputError
from jaxcal.data.problem import Problem
from jaxcal.data.recording import Images
from jaxcal.model.unknowns import FURTHER
from jaxcal.result.calibration import Calibration
from jaxcal.solvers.closed_form.calibrate import calibrate_closed_form
from jaxcal.solvers.closed_form.certificate import certify
from jaxcal.solvers.closed_form.reduced_objective import Certificate
from jaxcal.solvers.closed_form.single import solve_problem


def certificate_record(result: Calibration) -> dict[str, Any]:
    """``certified`` and ``gap_mm2`` of Eq. 7's minimum on the images in use.

    For the conventional method they are those of the answer. The other methods minimise a different
    objective; for them they are those of the closed form on the same images. Both are None if there
    is no closed form (e.g. an estimated delay) or no answer.

    Args:
        result: of one problem, with this problem.
    """
    assert result.problem is not None
    problem = replace(result.problem, mask=result.mask)
    estimate = tuple(name for name in FURTHER if name in result.blocks)
    found = None
    with suppress(InputError):
        if result.method == "conventional":
            found = _of_answer(result, problem, estimate)
        elif estimate in ((), ("scale",)):
            found = solve_problem(problem, estimate)
    return {name: getattr(found, name, None) for name in ("certified", "gap_mm2")}


def _of_answer(result: Calibration, problem: Problem, estimate: tuple[str, ...]) -> Certificate:
    scale, speed = result.scale_mm_per_px, result.medium.sound_speed_m_s
    return certify(
        problem,
        np.asarray(result.image_to_probe, dtype=float),
        np.asarray(result.point, dtype=float),
        scale_mm_per_px=None if scale is None else np.asarray(scale, dtype=float),
        sound_speed_factor=1.0 if speed is None else float(speed / problem.nominal_sound_speed),
        estimate=estimate,
    )


def first_answer_words(images: Images, estimate: tuple[str, ...]) -> str | None:
    """The conventional fit in one sentence, to be shown meanwhile; None without a closed form."""
    if images.kind == "time_of_flight":
        return None
    try:
        found = calibrate_closed_form(images, estimate=estimate)
    except InputError:
        return None
    x, y, z = found.image_to_probe[:3, 3]
    name = "Conventional fit, certified:" if found.certified else "Conventional fit:"
    scale = ""
    if "scale" in estimate and found.scale_mm_per_px is not None:
        lateral, axial = found.scale_mm_per_px
        scale = f", pixels of {lateral:.4f} x {axial:.4f} mm"
    return (
        f"{name} image origin at {x:.2f}, {y:.2f}, {z:.2f} mm on the probe{scale}, "
        f"RMS {found.rms:.3f} mm."
    )


def certificate_words(record: dict[str, Any]) -> str | None:
    """One line about the certificate in a record; None where it has none."""
    certified, gap = record.get("certified"), record.get("gap_mm2")
    if certified is None:
        return None
    if certified:
        return "conventional fit certified: no transform fits Eq. 7 better"
    if gap is None:
        return "conventional fit not certified: no bound on Eq. 7 is known for these images"
    return f"conventional fit not certified: Eq. 7 may have a minimum {gap:.2g} mm^2 lower"
