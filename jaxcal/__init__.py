"""jaxcal: differentiable calibration of tracked and robotic ultrasound.

    recording = jaxcal.load("rec.h5")
    problem = jaxcal.Problem.from_recording(recording)
    result = jaxcal.calibrate(problem, method="joint")

Names are imported on first use, so ``import jaxcal`` is fast and does not import JAX.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

# Imported first, since they watch for forks and for the import of JAX.
from jaxcal.runtime import forks as _forks  # noqa: F401
from jaxcal.runtime import when_jax as _when_jax  # noqa: F401

__version__ = "0.1.0"


class CalibrationError(Exception):
    """Base of every error that jaxcal raises on purpose; its text is meant for a person."""


class InputError(CalibrationError, ValueError):
    """The data handed in cannot be used: shapes, units, non-rotations, too few images."""


class FormatError(InputError):
    """A file cannot be read: it has another format or a newer version, is truncated or unsafe."""


class MissingFileError(FormatError, FileNotFoundError):
    """There is no file or folder of this name."""


class OutputError(CalibrationError, OSError):
    """A result could not be written; nothing was left half-written."""


class MissingExtraError(CalibrationError, ImportError):
    """An optional dependency is absent; the message names the extra that installs it."""


_ERRORS = (
    "CalibrationError",
    "FormatError",
    "InputError",
    "MissingExtraError",
    "MissingFileError",
    "OutputError",
)
_HOME = {
    "Calibration": "jaxcal.result.calibration",
    "Certificate": "jaxcal.solvers.closed_form.reduced_objective",
    "ClosedForm": "jaxcal.solvers.closed_form.single",
    "CurvilinearProbe": "jaxcal.data.probe",
    "ImageTransform": "jaxcal.result.transform",
    "Images": "jaxcal.data.recording",
    "LinearProbe": "jaxcal.data.probe",
    "Problem": "jaxcal.data.problem",
    "Protocol": "jaxcal.study.simulation",
    "Recording": "jaxcal.data.recording",
    "Segmentation": "jaxcal.data.segmentation.segment",
    "Status": "jaxcal.result.calibration",
    "Options": "jaxcal.solvers.plan",
    "Pivot": "jaxcal.calibration.pivot",
    "bootstrap": "jaxcal.calibration.resampling",
    "calibrate": "jaxcal.calibration.calibrate",
    "calibrate_batch": "jaxcal.calibration.calibrate",
    "calibrate_closed_form": "jaxcal.solvers.closed_form.calibrate",
    "calibrate_pivot": "jaxcal.calibration.pivot",
    "calibration_reproducibility": "jaxcal.diagnostics.metrics",
    "certify": "jaxcal.solvers.closed_form.certificate",
    "compare_calibrations": "jaxcal.diagnostics.comparison",
    "cross_validate": "jaxcal.calibration.resampling",
    "load": "jaxcal.io.hdf5",
    "load_calibration": "jaxcal.result.saved",
    "make_images": "jaxcal.data.recording",
    "predicted_tre": "jaxcal.diagnostics.intervals",
    "reconstruction_precision": "jaxcal.diagnostics.metrics",
    "save": "jaxcal.io.hdf5",
    "segment": "jaxcal.data.segmentation.segment",
    "segment_recording": "jaxcal.data.segmentation.segment",
    "simulate": "jaxcal.study.simulation",
    "simulate_recording": "jaxcal.study.simulation",
    "sound_speed_in_water": "jaxcal.data.sound",
    "stack": "jaxcal.data.problem",
    "transform_intervals": "jaxcal.diagnostics.intervals",
}


if TYPE_CHECKING:
    from jaxcal.calibration.calibrate import calibrate as calibrate
    from jaxcal.calibration.calibrate import calibrate_batch as calibrate_batch
    from jaxcal.calibration.pivot import Pivot as Pivot
    from jaxcal.calibration.pivot import calibrate_pivot as calibrate_pivot
    from jaxcal.calibration.resampling import bootstrap as bootstrap
    from jaxcal.calibration.resampling import cross_validate as cross_validate
    from jaxcal.data.probe import CurvilinearProbe as CurvilinearProbe
    from jaxcal.data.probe import LinearProbe as LinearProbe
    from jaxcal.data.problem import Problem as Problem
    from jaxcal.data.problem import stack as stack
    from jaxcal.data.recording import Images as Images
    from jaxcal.data.recording import Recording as Recording
    from jaxcal.data.recording import make_images as make_images
    from jaxcal.data.segmentation.segment import Segmentation as Segmentation
    from jaxcal.data.segmentation.segment import segment as segment
    from jaxcal.data.segmentation.segment import segment_recording as segment_recording
    from jaxcal.data.sound import sound_speed_in_water as sound_speed_in_water
    from jaxcal.diagnostics.comparison import compare_calibrations as compare_calibrations
    from jaxcal.diagnostics.intervals import predicted_tre as predicted_tre
    from jaxcal.diagnostics.intervals import transform_intervals as transform_intervals
    from jaxcal.diagnostics.metrics import (
        calibration_reproducibility as calibration_reproducibility,
    )
    from jaxcal.diagnostics.metrics import reconstruction_precision as reconstruction_precision
    from jaxcal.io.hdf5 import load as load
    from jaxcal.io.hdf5 import save as save
    from jaxcal.result.calibration import Calibration as Calibration
    from jaxcal.result.calibration import Status as Status
    from jaxcal.result.saved import load_calibration as load_calibration
    from jaxcal.result.transform import ImageTransform as ImageTransform
    from jaxcal.solvers.closed_form.calibrate import calibrate_closed_form as calibrate_closed_form
    from jaxcal.solvers.closed_form.certificate import certify as certify
    from jaxcal.solvers.closed_form.reduced_objective import Certificate as Certificate
    from jaxcal.solvers.closed_form.single import ClosedForm as ClosedForm
    from jaxcal.solvers.plan import Options as Options
    from jaxcal.study.simulation import Protocol as Protocol
    from jaxcal.study.simulation import simulate as simulate
    from jaxcal.study.simulation import simulate_recording as simulate_recording

__all__ = [*_ERRORS, *_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*_ERRORS, *_HOME, "__version__"]
