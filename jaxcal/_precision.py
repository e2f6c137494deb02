"""The package's only configuration of JAX: float64, the reference precision.

A calibration loses six digits in float32, so importing jaxcal switches JAX to 64 bits. Set the
environment variable ``JAX_ENABLE_X64=0`` before the import to keep JAX in 32 bits; the README says
what then still holds.
"""

from __future__ import annotations

import os
import sys


def enable_float64() -> None:
    """Switch JAX to float64 unless the environment has decided; does not import JAX itself."""
    if "JAX_ENABLE_X64" in os.environ:
        return
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)
    else:
        # JAX reads this when it is imported, which may be much later (``jaxcal --help``: never).
        os.environ["JAX_ENABLE_X64"] = "1"
