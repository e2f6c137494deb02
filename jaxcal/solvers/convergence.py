"""How a method ended, for every method alike. Needs no JAX."""

from __future__ import annotations

from jaxcal.runtime.array_types import AnyArray, Bool, Float, Int
from jaxcal.runtime.arrays import array_tree


@array_tree
class Convergence:
    """How the method ended. Of these numbers the cost alone has a derivative.

    If distributions of the offsets were compared (priors ``auto`` and ``uniform``), all of them are
    about the Gaussian solution at which the comparison began; the average has no objective.

    Attributes:
        cost: the minimised sum of squares, mm^2 (equal weights) or whitened.
        stationarity: scaled KKT residual of that objective.
        tolerance_met: the method's own stopping rule was met.
        iterations: linearisations (joint, conventional) or rounds (alternating).
        variance_rounds: passes of the self-tuning that updated the SDs; 0 without it.
        searched_start: the start is not certain: its closed form was not proved to be the only
            minimum (one problem), or is unsound (linear, in batches and under transformations), and
            descents from many rotations were compared.
        sigma_floored: which SDs are at their floor.
        rotation_change: X's last move in rad (alternating), else 0.
        translation_change: X's last move in mm (alternating), else 0.
        trace: objective after each of the first iterations, NaN beyond the last; None if no trace
            was requested.
    """

    cost: Float[AnyArray, "*batch"]
    stationarity: Float[AnyArray, "*batch"]
    tolerance_met: Bool[AnyArray, "*batch"]
    iterations: Int[AnyArray, "*batch"]
    variance_rounds: Int[AnyArray, "*batch"]
    searched_start: Bool[AnyArray, "*batch"]
    sigma_floored: Bool[AnyArray, "*batch 3"]
    rotation_change: Float[AnyArray, "*batch"]
    translation_change: Float[AnyArray, "*batch"]
    trace: Float[AnyArray, "*batch trace"] | None
