"""Flags that XLA compiles our programs with, on a CPU; elsewhere its defaults stand.

Two wishes contradict each other. A batch is solved again and again, and its inner loops should run
as fast as the hardware allows: :func:`for_batches`. One problem is solved once, and what a person
waits for is the compiler, not the answer: :func:`for_one_problem`.

Flags belong to a whole program, so none are given inside somebody else's jit, vmap or grad:
:func:`is_whole_program`.
"""

from __future__ import annotations

import os
from typing import Any

import jax
import jax.core
import jax.numpy as jnp

SWITCH = "JAXCAL_FAST_MATH"
"""Environment variable; 0 leaves batches the compiler's default flags."""

Flags = dict[str, Any]


def for_batches(platform: str) -> Flags | None:
    """Flags for the fused programs, or None.

    Sums over images vectorise only where their order is free, and that is what fast math allows;
    NaN and Inf keep their meaning. Reruns are bitwise equal, and answers within 1e-12 mm of those
    with default flags.
    """
    if platform != "cpu" or os.environ.get(SWITCH, "1") == "0":
        return None
    return {
        "xla_cpu_enable_fast_math": True,
        "xla_cpu_fast_math_honor_nans": True,
        "xla_cpu_fast_math_honor_infs": True,
        "xla_cpu_prefer_vector_width": 512,
    }


def for_one_problem(platform: str) -> Flags | None:
    """Flags for a program that runs about as often as it is compiled, or None.

    Building every fusion with MLIR is half of the compiler's work (jax 0.10), and a problem of some
    dozens of images gains nothing by it.
    """
    return {"xla_cpu_use_fusion_emitters": False} if platform == "cpu" else None


def is_whole_program(*arguments: object) -> bool:
    """Whether arrays have values, so that what is called with them is a program of its own."""
    leaves = jax.tree.leaves((arguments, jnp.zeros(())))
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)
