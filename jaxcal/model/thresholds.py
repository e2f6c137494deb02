"""Numbers on which solvers, answers and diagnostics have to agree. Needs no JAX."""

from __future__ import annotations

LARGEST_ELEVATION = 0.95
"""Offsets are kept below this fraction of the range: at 1 the circle's tangent turns axial."""

MINIMUM_SELF_TUNING = 8
"""With fewer used images the residuals cannot determine three SDs besides nine unknowns."""

FALLBACK_SIGMA = (0.5, 0.5, 1.0)
"""SDs of lateral position, range and offset (mm), used where too few images determine them."""

FEWEST_TO_LEAVE_OUT = 8
"""With fewer used images nothing is left out: they cannot outvote one another."""

MAD = 1.4826
"""SD of a normal law over the median of its magnitude."""

STATIONARY = 1e-6
"""Largest gradient cosine of an answer through which derivatives are valid; 1e-3 in float32."""
