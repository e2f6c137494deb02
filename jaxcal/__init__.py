"""jaxcal: differentiable calibration of tracked and robotic ultrasound.

    recording = jaxcal.load("rec.h5")
    problem = jaxcal.Problem.from_recording(recording)
    result = jaxcal.calibrate(problem, method="joint")

Names are imported on first use, so that ``import jaxcal`` costs nothing until JAX is needed.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOME = {
    "Calibration": "jaxcal.calibration",
    "CalibrationError": "jaxcal.errors",
    "Certificate": "jaxcal.certificate",
    "ClosedForm": "jaxcal.closed_form",
    "CurvilinearProbe": "jaxcal.probe",
    "FormatError": "jaxcal.errors",
    "ImageTransform": "jaxcal.transform",
    "Images": "jaxcal.recording",
    "InputError": "jaxcal.errors",
    "LinearProbe": "jaxcal.probe",
    "MissingExtraError": "jaxcal.errors",
    "OutputError": "jaxcal.errors",
    "Problem": "jaxcal.problem",
    "Protocol": "jaxcal.simulation",
    "Recording": "jaxcal.recording",
    "Segmentation": "jaxcal.segmentation.segment",
    "Status": "jaxcal.calibration",
    "Options": "jaxcal.options",
    "Pivot": "jaxcal.pivot",
    "bootstrap": "jaxcal.resampling",
    "calibrate": "jaxcal.solve",
    "calibrate_batch": "jaxcal.solve",
    "calibrate_closed_form": "jaxcal.closed_form",
    "calibrate_pivot": "jaxcal.pivot",
    "calibration_reproducibility": "jaxcal.diagnostics.metrics",
    "certify": "jaxcal.certificate",
    "cross_validate": "jaxcal.resampling",
    "load": "jaxcal.io.hdf5",
    "load_calibration": "jaxcal.transform",
    "make_images": "jaxcal.recording",
    "predicted_tre": "jaxcal.diagnostics.intervals",
    "reconstruction_precision": "jaxcal.diagnostics.metrics",
    "save": "jaxcal.io.hdf5",
    "segment": "jaxcal.segmentation.segment",
    "segment_recording": "jaxcal.segmentation.segment",
    "simulate": "jaxcal.simulation",
    "simulate_recording": "jaxcal.simulation",
    "sound_speed_in_water": "jaxcal.sound",
    "stack": "jaxcal.problem",
    "transform_intervals": "jaxcal.diagnostics.intervals",
}


if TYPE_CHECKING:
    from jaxcal.calibration import Calibration as Calibration
    from jaxcal.calibration import Status as Status
    from jaxcal.certificate import Certificate as Certificate
    from jaxcal.certificate import certify as certify
    from jaxcal.closed_form import ClosedForm as ClosedForm
    from jaxcal.closed_form import calibrate_closed_form as calibrate_closed_form
    from jaxcal.diagnostics.intervals import predicted_tre as predicted_tre
    from jaxcal.diagnostics.intervals import transform_intervals as transform_intervals
    from jaxcal.diagnostics.metrics import (
        calibration_reproducibility as calibration_reproducibility,
    )
    from jaxcal.diagnostics.metrics import reconstruction_precision as reconstruction_precision
    from jaxcal.errors import CalibrationError as CalibrationError
    from jaxcal.errors import FormatError as FormatError
    from jaxcal.errors import InputError as InputError
    from jaxcal.errors import MissingExtraError as MissingExtraError
    from jaxcal.errors import OutputError as OutputError
    from jaxcal.io.hdf5 import load as load
    from jaxcal.io.hdf5 import save as save
    from jaxcal.options import Options as Options
    from jaxcal.pivot import Pivot as Pivot
    from jaxcal.pivot import calibrate_pivot as calibrate_pivot
    from jaxcal.probe import CurvilinearProbe as CurvilinearProbe
    from jaxcal.probe import LinearProbe as LinearProbe
    from jaxcal.problem import Problem as Problem
    from jaxcal.problem import stack as stack
    from jaxcal.recording import Images as Images
    from jaxcal.recording import Recording as Recording
    from jaxcal.recording import make_images as make_images
    from jaxcal.resampling import bootstrap as bootstrap
    from jaxcal.resampling import cross_validate as cross_validate
    from jaxcal.segmentation.segment import Segmentation as Segmentation
    from jaxcal.segmentation.segment import segment as segment
    from jaxcal.segmentation.segment import segment_recording as segment_recording
    from jaxcal.simulation import Protocol as Protocol
    from jaxcal.simulation import simulate as simulate
    from jaxcal.simulation import simulate_recording as simulate_recording
    from jaxcal.solve import calibrate as calibrate
    from jaxcal.solve import calibrate_batch as calibrate_batch
    from jaxcal.sound import sound_speed_in_water as sound_speed_in_water
    from jaxcal.transform import ImageTransform as ImageTransform
    from jaxcal.transform import load_calibration as load_calibration


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*_HOME, "__version__"]
