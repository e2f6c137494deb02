"""The package's only configuration of JAX: float64, and one program at a time on the CPU.

A calibration loses six digits in float32, so importing jaxcal switches JAX to 64 bits. And XLA's
thread pool on the CPU deadlocked on two cores (jaxlib 0.10.2) when programs were dispatched
asynchronously whose small matrix factorisations are themselves spread over that pool; dispatched
synchronously they run on the caller's thread and leave the pool to the factorisations.

The environment decides where it says so: ``JAX_ENABLE_X64=0`` keeps JAX in 32 bits (the README says
what then still holds), ``JAX_CPU_ENABLE_ASYNC_DISPATCH=1`` keeps asynchronous dispatch.
"""

from __future__ import annotations

import os
import sys

_SETTINGS = {"jax_enable_x64": True, "jax_cpu_enable_async_dispatch": False}


def configure_jax() -> None:
    """Apply the settings that the environment leaves open; does not import JAX itself."""
    for name, value in _SETTINGS.items():
        variable = name.upper()
        if variable in os.environ:
            continue
        if "jax" in sys.modules:
            sys.modules["jax"].config.update(name, value)
        else:
            # JAX reads these when it is imported, which may be much later (jaxcal --help: never).
            os.environ[variable] = "1" if value else "0"
