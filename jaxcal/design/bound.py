"""How good the best set of poses can be: a bound that no choice among the candidates beats.

A set of n poses has the information B + sum_i k_i I_i, with whole numbers k_i that sum to n. Allow
any shares n w_i instead of k_i, and let M = B + n sum w_i I_i. Then tr(W M^-1) is convex in w, and
with d_i = n tr(M^-1 W M^-1 I_i) its gradient is -d. So for any w

    tr(W M^-1) - (max_i d_i - sum_i w_i d_i)

is a lower bound on tr(W S) for every set of n poses (the equivalence theorem used as a bound). The
step w_i <- w_i sqrt(d_i), normalised, brings tr(W M^-1) and the bound together.

References: Kiefer and Wolfowitz 1960; Silvey, Titterington and Torsney 1978; Yu 2010.
"""

from __future__ import annotations

import math

import numpy as np

from jaxcal import InputError
from jaxcal.design.candidates import Candidates
from jaxcal.design.criteria import check_criterion, tuned_factor, weight_of
from jaxcal.design.greedy import MOST_POSES
from jaxcal.design.information import Known, covariance_of
from jaxcal.design.names import Criterion
from jaxcal.design.planning import Plan, check_candidates, known_before, with_effective_noise
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.given_values import whole_number

NEAR = 1e-3
"""The steps end when the bound is nearer than this share of the squared error."""

MOST_STEPS = 4000
"""The bound holds after any number of steps; more steps only make it tighter."""


def least_error(
    candidates: Candidates,
    n: int,
    criterion: Criterion = "tre",
    prior: Known | Plan | Calibration | np.ndarray | None = None,
) -> float:
    """A lower bound on the predicted error of any n of the candidates, mm.

    Compare it with ``tre_mm[-1]`` or ``rp_mm[-1]`` of a plan without polish (which would move poses
    off the candidates). The bound allows the same pose several times and ignores space filling and
    the limit on replicates (:class:`jaxcal.design.Rules`), so a plan that keeps these is above it.

    Args:
        candidates: to choose from.
        n: how many.
        criterion: ``tre`` or ``rp``.
        prior: what is known already, as for :func:`jaxcal.design.plan`.

    Raises:
        InputError: criterion ``d``, fewer than one pose, or candidates that do not determine the
            unknowns.
    """
    check_criterion(criterion)
    if criterion == "d":
        raise InputError("the bound is on an error in mm: choose the criterion tre or rp")
    whole_number("the number of poses", n, 1, MOST_POSES)
    known = known_before(prior, candidates)
    check_candidates(candidates)
    candidates = with_effective_noise(prior, candidates)
    weight = weight_of(criterion, candidates)
    assert weight is not None
    rows = candidates.model.jacobian(candidates.poses)
    count, _, size = rows.shape
    flat = rows.reshape(-1, size)
    share = np.full(count, 1.0 / count)
    best = 0.0
    for _ in range(MOST_STEPS):
        heavy = np.repeat(share, rows.shape[1])[:, None] * flat
        covariance = covariance_of(known.information + n * flat.T @ heavy)
        turned = covariance @ weight @ covariance
        gains = n * np.einsum("ni,ni->n", flat @ turned, flat).reshape(count, -1).sum(axis=1)
        mean = float(share @ gains)
        left = float(np.sum(weight * covariance))
        best = max(best, left - (float(gains.max()) - mean))
        if gains.max() - mean <= NEAR * left:
            break
        share = share * np.sqrt(gains)
        share = share / share.sum()
    return math.sqrt(float(tuned_factor(known, np.array(n), size)) * best)
