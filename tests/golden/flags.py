"""The compiler's flags while the corpus is computed; to be imported before JAX.

Those of the tests, with which compiling takes half of the time. XLA ends the process at a flag that
it does not know, and jaxlib 0.11 has dropped one of the two.
"""

from __future__ import annotations

import os
from importlib.metadata import version


def set_flags() -> None:
    """Set them, unless the caller has set some; and let JAX compute on the processor."""
    quick = "--xla_backend_optimization_level=0"
    if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):
        quick += " --xla_cpu_use_fusion_emitters=false"
    os.environ.setdefault("XLA_FLAGS", quick)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
