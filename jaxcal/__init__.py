"""jaxcal: differentiable calibration of tracked and robotic ultrasound.

    recording = jaxcal.load("rec.h5")
    problem = jaxcal.Problem.from_recording(recording)
    result = jaxcal.calibrate(problem, method="joint")

Names are imported on first use, so that ``import jaxcal`` costs nothing until JAX is needed.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from jaxcal._precision import enable_float64

enable_float64()

__version__ = "0.1.0"

_HOME = {
    "Calibration": "jaxcal.calibration",
    "CalibrationError": "jaxcal.errors",
    "FormatError": "jaxcal.errors",
    "Images": "jaxcal.recording",
    "InputError": "jaxcal.errors",
    "LinearProbe": "jaxcal.probe",
    "MissingExtraError": "jaxcal.errors",
    "OutputError": "jaxcal.errors",
    "Problem": "jaxcal.problem",
    "Protocol": "jaxcal.simulation",
    "Recording": "jaxcal.recording",
    "Status": "jaxcal.calibration",
    "Options": "jaxcal.solve",
    "calibrate": "jaxcal.solve",
    "calibrate_batch": "jaxcal.solve",
    "calibration_reproducibility": "jaxcal.metrics",
    "load": "jaxcal.io.hdf5",
    "make_images": "jaxcal.recording",
    "reconstruction_precision": "jaxcal.metrics",
    "save": "jaxcal.io.hdf5",
    "simulate": "jaxcal.simulation",
    "simulate_recording": "jaxcal.simulation",
    "stack": "jaxcal.problem",
}

__all__ = [*sorted(_HOME), "__version__"]

if TYPE_CHECKING:
    from jaxcal.calibration import Calibration, Status
    from jaxcal.errors import (
        CalibrationError,
        FormatError,
        InputError,
        MissingExtraError,
        OutputError,
    )
    from jaxcal.io.hdf5 import load, save
    from jaxcal.metrics import calibration_reproducibility, reconstruction_precision
    from jaxcal.probe import LinearProbe
    from jaxcal.problem import Problem, stack
    from jaxcal.recording import Images, Recording, make_images
    from jaxcal.simulation import Protocol, simulate, simulate_recording
    from jaxcal.solve import Options, calibrate, calibrate_batch


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'jaxcal' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
