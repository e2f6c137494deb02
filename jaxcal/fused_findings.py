"""What is to be said of the solutions of a batch: :mod:`jaxcal.findings` in a few passes.

That module is the reference, in words that can be read; here is the order in which the same comes
cheap: a sixth of the time, for 50 images (``experiments/benchmarks/self_tuned_cost.py``). Planes
are (lanes, images), small matrices have the lanes last, and no pass stores what belongs to one
image, unless it is asked for:

1. medians of the errors, for the robust SDs (:mod:`jaxcal.fused_inspection`);
2. one reduction: the information of the solution, that of the unweighted design, that with robust
   SDs, and all other sums;
3. their inverses and the ends of their spectra (:mod:`jaxcal.fused_uncertainty`);
4. leverages, with them departures, elevations' SDs and the check of the noise model.

Nobody differentiates here: derivatives are the reference's (:mod:`jaxcal.abreast`).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.findings import Findings, Solution, differentiable, judge, of_the_laws
from jaxcal.fused_inspection import Steadied, check_noise_model, gains, usual_rotation
from jaxcal.fused_uncertainty import (
    Ends,
    Resting,
    elevation_variance,
    ends,
    unit_inverse,
    whitened,
)
from jaxcal.inspection import Inspection
from jaxcal.model.parameters import Parameters
from jaxcal.model.priors import AbstractPrior, Bounded, Gaussian
from jaxcal.options import Plan
from jaxcal.problem import Problem
from jaxcal.solvers.auto import Averaged
from jaxcal.solvers.consensus import FEWEST_IMAGES, stands_out
from jaxcal.solvers.fused import UNKNOWNS, Guess, Images, total
from jaxcal.solvers.lanes import apart
from jaxcal.solvers.unrolled import Vector
from jaxcal.solvers.views import View, variance
from jaxcal.uncertainty import Uncertainty


class _Sums(eqx.Module):
    """What the one reduction leaves of the images, lanes last.

    Attributes:
        design, information, robust: 9x9. cost: |r|^2, mm^2. in_plane: with all y = 0. squares: of
            lateral error, range error and offset. reach: of the points. points: their sums.
            rotation: sum of R_i. used: number of images. free: of offsets that are unknown.
    """

    design: Float[Array, "9 9 lanes"]
    information: Float[Array, "9 9 lanes"]
    robust: Float[Array, "9 9 lanes"]
    cost: Float[Array, " lanes"]
    in_plane: Float[Array, " lanes"]
    squares: Float[Array, "3 lanes"]
    reach: Float[Array, " lanes"]
    points: Float[Array, "2 lanes"]
    rotation: Float[Array, "9 lanes"]
    used: Float[Array, " lanes"]
    free: Float[Array, " lanes"]


def find(
    solution: Solution,
    parameters: Parameters,
    offset: Float[Array, "lanes k"],
    prior: AbstractPrior,
    averaged: Averaged | None,
    problems: Problem,
    everything: Problem,
    plan: Plan,
) -> Findings:
    """Look at the solutions of a batch of plain problems; arguments as of the reference."""
    guess, images = Guess.of(parameters), Images.of(problems)
    view = View.of(guess, images)
    # All the images, those included that a robust solve left out.
    whole = view if not plan.robust else View.of(guess, Images.of(everything))
    keep = images.mask
    steadied = Steadied.of(whole, keep)
    resting = Resting.of(view, prior.bound, offset) if isinstance(prior, Bounded) else None
    elevation = view.errors[2] if resting is None else keep * offset
    sums = _gather(view, whole, prior, resting, elevation, steadied)

    lever = apart(jnp.sqrt(sums.reach / sums.used))
    one = jnp.ones_like(lever)
    scale = jnp.stack([one] * 3 + [lever] * 3 + [one] * 3)
    # With equal weights and no offset to eliminate the information is the design's.
    weighed = isinstance(prior, Gaussian) or resting is not None
    matrices = [sums.information, sums.robust, *([sums.design] if weighed else [])]
    diagonals = [_diagonal(matrix) for matrix in matrices]
    if resting is not None:
        diagonals[0] = diagonals[2]
    inverse, robust, *rest = apart(unit_inverse(matrices, diagonals))
    design = rest[0] if weighed else inverse
    end = ends(sums.information, inverse, sums.design, design, scale)

    size = one
    if not isinstance(prior, Gaussian):
        size = sums.cost / jnp.maximum(3 * sums.used - UNKNOWNS - sums.free, 1.0)
    uncertainty = _uncertainty(view, prior, resting, inverse, end, size, sums, plan)
    if averaged is not None:
        uncertainty = jax.vmap(of_the_laws)(uncertainty, averaged)
    sigma = _three_sigmas(prior, sums)
    departure = steadied.departures(whole, keep, robust)
    used = whole.images.mask
    if plan.robust:
        outlier = used * (1 - keep)
    else:
        judged = (sums.used >= FEWEST_IMAGES) & jnp.all(jnp.isfinite(departure), axis=(1, 2))
        outlier = used * judged[:, None] * jax.vmap(stands_out)(departure, keep)
    kurtosis, misfit = check_noise_model(_standardised(view, prior, inverse), images)
    gain = gains(
        guess, usual_rotation(sums.rotation, images), list(sums.points / sums.used), sigma,
        end.weakest / scale,
    )  # fmt: skip
    status = jax.vmap(lambda s, p, u, lever, used: judge(s, p, u, lever, used, plan))(
        solution, parameters, uncertainty, lever, sums.used
    )
    gap = None
    if resting is not None:
        away = jnp.where((uncertainty.at_bound > 0) | (keep == 0), jnp.inf, resting.gap)
        gap = jnp.min(away, axis=1)
    residual = [view.errors[0], view.errors[2], keep * (view.q[2] - images.distance)]
    return Findings(
        elevation=elevation,
        sigma=sigma.T,
        residual=jnp.stack(apart(residual), axis=-1),
        rms=jnp.sqrt(sums.in_plane / sums.used),
        uncertainty=uncertainty,
        inspection=Inspection(outlier, departure, kurtosis, misfit, gain),
        status=status,
        differentiable=jax.vmap(differentiable)(solution, uncertainty, gap, status),
    )


def _gather(
    view: View,
    whole: View,
    prior: AbstractPrior,
    resting: Resting | None,
    elevation: Float[Array, "lanes n"],
    steadied: Steadied,
) -> _Sums:
    images = view.images
    mask = images.mask
    lateral, distance, offset = view.errors
    across = mask * (view.q[2] - images.distance)
    in_plane = lateral * lateral + offset * offset + across * across
    free, cost = jnp.zeros_like(mask), in_plane
    weights = [[[mask if i == j else 0 for j in range(3)] for i in range(3)]]
    if isinstance(prior, Gaussian):
        weights.append(whitened(view, prior)[2])
    elif resting is not None:
        weights.append(resting.weight(mask))
        free = mask * resting.free
        cost = sum((e * e for e in resting.errors[1:]), resting.errors[0] ** 2)
    robust = steadied.weight(whole, mask)
    if whole is view:
        *matrices, robust = view.information([*weights, robust])
    else:
        matrices, [robust] = view.information(weights), whole.information([robust])
    points = [mask * images.lateral, mask * images.distance]
    planes = [
        cost, in_plane, lateral * lateral, distance * distance, elevation * elevation,
        points[0] * images.lateral + points[1] * images.distance, *points,
        *(mask * plane for plane in images.rotation), mask, free,
    ]  # fmt: skip
    sums = apart(jnp.stack(total(planes)))
    return _Sums(
        design=matrices[0], information=matrices[-1], robust=robust,
        cost=sums[0], in_plane=sums[1], squares=sums[2:5], reach=sums[5], points=sums[6:8],
        rotation=sums[8:17], used=sums[17], free=sums[18],
    )  # fmt: skip


def _diagonal(matrix: Float[Array, "9 9 lanes"]) -> Float[Array, "9 lanes"]:
    return jnp.stack([matrix[k, k] for k in range(UNKNOWNS)])


def _uncertainty(
    view: View,
    prior: AbstractPrior,
    resting: Resting | None,
    inverse: Float[Array, "9 9 lanes"],
    end: Ends,
    size: Float[Array, " lanes"],
    sums: _Sums,
    plan: Plan,
) -> Uncertainty:
    mask = view.images.mask
    at_bound, known, hold = jnp.zeros_like(mask), mask > 0, jnp.full_like(size, jnp.inf)
    if resting is not None:
        at_bound = mask * (1 - resting.free)
        known = known & (resting.free > 0)
        force = jnp.abs(resting.force) * jax.lax.rsqrt(resting.diagonal)
        typical = jnp.sqrt(sums.cost / (3 * sums.used)) + jnp.finfo(force.dtype).tiny
        hold = jnp.min(jnp.where(at_bound > 0, force / typical[:, None], jnp.inf), axis=1)
    unknown = end.degenerate | (end.singular & jnp.asarray(not isinstance(prior, Gaussian)))
    lost = jnp.where(unknown, jnp.nan, size)
    square = elevation_variance(view, prior, resting, inverse) * lost[:, None]
    # Without a prior on the offsets a turn about the element line, the lateral axis, moves no
    # measurement of any image.
    turns = jnp.isfinite(end.biggest) & jnp.asarray(plan.prior != "none")
    axis = jnp.zeros_like(end.weakest).at[3].set(turns.astype(mask.dtype))
    return Uncertainty(
        covariance=jnp.moveaxis(lost * inverse, -1, 0),
        elevation_sd=jnp.where(known, jnp.sqrt(jnp.where(known, square, 1.0)), jnp.nan),
        condition=end.biggest / end.smallest,
        weakest=end.weakest.T,
        weakest_sd=jnp.where(unknown, jnp.nan, jnp.sqrt(size / end.smallest)),
        prior_direction=axis.T,
        degenerate=end.degenerate,
        singular=end.singular,
        at_bound=at_bound,
        weakest_hold=hold,
    )


def _three_sigmas(prior: AbstractPrior, sums: _Sums) -> Float[Array, "3 lanes"]:
    if isinstance(prior, Gaussian):
        return prior.sigma.T
    freedom = jnp.maximum(sums.used - UNKNOWNS / 3, 1.0)
    freedom = jnp.stack([freedom, freedom, sums.used if isinstance(prior, Bounded) else freedom])
    return jnp.sqrt(sums.squares / freedom)


def _standardised(view: View, prior: AbstractPrior, inverse: Float[Array, "9 9 lanes"]) -> Vector:
    """The residuals whose law is checked, each in SDs of its own where a leverage belongs to it."""
    if not isinstance(prior, Gaussian):
        return view.errors
    errors, rows, _ = whitened(view, prior)
    return [
        error * jax.lax.rsqrt(jnp.maximum(1 - variance(inverse, row), 0.05))
        for error, row in zip(errors, rows, strict=True)
    ]
