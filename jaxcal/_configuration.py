"""The package's only configuration of JAX: float64.

A calibration loses six digits in float32, so importing jaxcal switches JAX to 64 bits, unless the
environment says ``JAX_ENABLE_X64=0`` (the README says what then still holds).
"""

from __future__ import annotations

import os
import sys

_VARIABLE = "JAX_ENABLE_X64"


def configure_jax() -> None:
    """Switch to 64 bits where the environment leaves it open; does not import JAX itself."""
    if _VARIABLE in os.environ:
        return
    if "jax" in sys.modules:
        sys.modules["jax"].config.update(_VARIABLE.lower(), True)
    else:
        # JAX reads this when it is imported, which may be much later (jaxcal --help: never).
        os.environ[_VARIABLE] = "1"
