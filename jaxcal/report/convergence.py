"""How fast the methods converge on the same objective: the bounded problem of the paper.

The alternation continues past its own stopping rule, so that its rate can be seen; the iteration at
which the rule would have stopped it is marked. The joint solver begins with a few rounds of the
same alternation from each of its starts, and its curve begins after these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxcal.calibration.calibrate import calibrate
from jaxcal.data.problem import Problem
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.solvers.plan import Options

KEPT = 200
"""Number of iterations that are drawn."""


@dataclass(frozen=True)
class Curve:
    """How an objective fell.

    Attributes:
        label: for the legend.
        objective: (k,) after iteration 0 (the start), 1, 2 and so on; NaN where it was not kept.
        stopped: iteration at which the method's own rule stopped it, or None.
    """

    label: str
    objective: Float[np.ndarray, " k"]
    stopped: int | None = None


def own_curve(result: Calibration) -> Curve:
    """The objective of one conventional solve, from the values kept in its trace."""
    return Curve(result.method, _trace(result))


def bounded_curves(
    problem: Problem,
    *,
    max_elevation: float | AnyArray | None = None,
    estimate: tuple[str, ...] = (),
    alternating: Calibration | None = None,
) -> list[Curve]:
    """Joint solver and alternation on the bounded objective, from the same start.

    The bound is ``max_elevation`` mm, or the problem's own, or 1 mm. ``alternating`` is an
    alternation that stopped by its own rule, to mark where it stopped.

    Returns:
        Curves of the sum of squares, mm^2.
    """
    from jaxcal.solvers.alternating import WARM_UP_ROUNDS

    joint = calibrate(
        problem,
        "joint",
        "bounded",
        max_elevation=max_elevation,
        estimate=estimate,
        options=Options(trace=KEPT),
    )
    # With practically no tolerance, every round is taken.
    patient = Options(trace=KEPT, max_rounds=KEPT, tolerance_mm=1e-300, tolerance_rad=1e-300)
    slow = calibrate(
        problem, "alternating", max_elevation=max_elevation, estimate=estimate, options=patient
    )
    # The alternation keeps no value before its first round.
    rounds = np.concatenate([[np.nan], _trace(slow)])
    # The joint solver's first value is that of its best start after the warm-up rounds, whose
    # values are not kept.
    steps = np.concatenate([np.full(WARM_UP_ROUNDS, np.nan), _trace(joint)])
    stopped = None if alternating is None else int(alternating.convergence.iterations)
    return [
        Curve(
            f"joint (best of three starts, after {WARM_UP_ROUNDS} alternating rounds each)", steps
        ),
        Curve("alternating", rounds, stopped),
    ]


def _trace(result: Calibration) -> Float[np.ndarray, " k"]:
    trace = result.convergence.trace
    return np.empty(0) if trace is None else np.asarray(trace, dtype=float)
