"""The front door: one problem or a batch, by any method, to a :class:`Calibration`.

Every method takes the same road: the conventional fit from the closed-form start; the method itself
from there; derivatives by the implicit function theorem; uncertainty at the solution. The road is
one pure function of arrays, compiled once for each combination of shapes and options.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.calibration import Calibration, Status
from jaxcal.errors import InputError
from jaxcal.metrics import root_mean_square
from jaxcal.model.parameters import RIGID, Blocks, Parameters, block_slice, retract
from jaxcal.model.priors import AbstractPrior, Bounded, Gaussian, InPlane, covariance_shape
from jaxcal.model.residuals import circle_residual, measurement_residual
from jaxcal.problem import Problem, is_traced
from jaxcal.recording import MINIMUM_IMAGES, Recording
from jaxcal.solvers import implicit
from jaxcal.solvers.alternating import alternate
from jaxcal.solvers.conventional import from_scratch, pairwise_gradient
from jaxcal.solvers.joint import joint
from jaxcal.solvers.variance import MINIMUM_SELF_TUNING, self_tuned
from jaxcal.uncertainty import LARGEST_SD, Uncertainty, assess, lever_arm

Method = Literal["joint", "alternating", "conventional"]
PriorName = Literal["auto", "gaussian", "bounded"]

DEFAULT_MAX_ELEVATION_MM = 1.0
"""The bound on the offsets where none is given: the paper's."""

BATCH_CHUNK = 64
"""Problems solved side by side: enough to fill the vector units, few enough to stay in cache."""


@dataclass(frozen=True)
class Options:
    """How to solve; static, so each combination is compiled once.

    Attributes:
        solver: the conventional method's: ``lm``, ``gauss-newton`` or ``gradient``.
        gradient_tolerance: where ``gradient`` stops, relative.
        tolerance_rad: the alternation stops when a round turns X by less than this (rad) and
        tolerance_mm: moves its origin by less than this (mm). The defaults reproduce the paper.
        max_rounds: most rounds of the alternation.
        inner_steps: Gauss-Newton steps on X and c in each of its rounds.
        max_iterations: most linearisations of the other solvers.
        trace: how many values of the objective to keep in the result.
    """

    solver: Literal["lm", "gauss-newton", "gradient"] = "lm"
    gradient_tolerance: float = 1e-6
    tolerance_rad: float = 1e-3
    tolerance_mm: float = 0.1
    max_rounds: int = 1000
    inner_steps: int = 2
    max_iterations: int = 100
    trace: int = 0

    def __post_init__(self) -> None:
        if self.solver not in ("lm", "gauss-newton", "gradient"):
            raise InputError(f"solver must be lm, gauss-newton or gradient, not {self.solver!r}")
        for name in ("gradient_tolerance", "tolerance_rad", "tolerance_mm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} must be a positive number, not {value!r}")
        for name, least in (
            ("max_rounds", 1), ("inner_steps", 1), ("max_iterations", 1), ("trace", 0)
        ):  # fmt: skip
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least}, not {getattr(self, name)}")


@dataclass(frozen=True)
class _Plan:
    """Everything static about a solve."""

    method: Method
    prior: Literal["none", "gaussian", "bounded"]
    self_tuning: bool
    blocks: Blocks
    options: Options


class _Given(eqx.Module):
    """Numbers given by the caller beside the problem."""

    sigma: Float[Array, 3] | None
    tracker_sd: Float[Array, ""] | None
    max_elevation: Float[Array, "*images"] | None


def calibrate(
    problem: Problem | Recording,
    method: Method = "joint",
    prior: PriorName = "auto",
    *,
    max_elevation: float | np.ndarray | Array | None = None,
    sigma: tuple[float, float, float] | np.ndarray | Array | None = None,
    tracker_sd: float | Array | None = None,
    estimate: tuple[str, ...] = (),
    options: Options | None = None,
) -> Calibration:
    """Find X, the target and the elevational offsets; nobody supplies a starting guess.

    Args:
        problem: one problem (a batch is handed to :func:`calibrate_batch`), or a recording.
        method: ``joint`` (X, c and every offset together), ``alternating`` (the paper's Fig. 4) or
            ``conventional`` (Eq. 7, every target in the plane).
        prior: of the joint method. ``gaussian``: offsets and errors are Gaussian, with the SDs of
            ``sigma`` or, without it, self-tuned by REML. ``bounded``: |y_i| <= max_elevation with
            equal weights, the alternation's objective. ``auto``: self-tuned Gaussian.
        max_elevation: bound m on |y|, mm, one number or (n,); overrides the problem's own. The
            alternation and ``bounded`` take 1 mm where there is neither.
        sigma: given SDs of lateral position, range and elevational offset, mm.
        tracker_sd: isotropic SD of the tracked position, mm, beside given ``sigma``.
        estimate: further unknowns: ``("scale",)`` for the pixel scales.
        options: tolerances and limits.

    Returns:
        A :class:`Calibration`; ask its ``status`` and ``warnings`` before using it.

    Raises:
        InputError: options that contradict each other or the problem; with concrete arrays also
            NaN, Inf and fewer than 4 used images. Under jit, vmap or grad values cannot be looked
            at, and such problems come back with status ``failed``.
    """
    if isinstance(problem, Recording):
        problem = Problem.from_recording(problem)
    plan, given = _prepare(problem, method, prior, max_elevation, sigma, tracker_sd, estimate,
                           options)  # fmt: skip
    if problem.batch_shape:
        return calibrate_batch(
            problem, method, prior, max_elevation=max_elevation, sigma=sigma,
            tracker_sd=tracker_sd, estimate=estimate, options=options,
        )  # fmt: skip
    _check_values(problem)
    return _solve_jit(_with_bound(problem, given), given, plan)


def calibrate_batch(
    problems: Problem,
    method: Method = "joint",
    prior: PriorName = "auto",
    *,
    max_elevation: float | np.ndarray | Array | None = None,
    sigma: tuple[float, float, float] | np.ndarray | Array | None = None,
    tracker_sd: float | Array | None = None,
    estimate: tuple[str, ...] = (),
    options: Options | None = None,
    chunk: int = BATCH_CHUNK,
) -> Calibration:
    """:func:`calibrate` for a batch: compiled, vmapped, in chunks of lanes.

    A lane that is bad (NaN, degenerate) gets its own status and leaves its neighbours alone.

    Args:
        problems: leading axes of any shape; see :func:`jaxcal.stack`.
        method: as for :func:`calibrate`, and so are the following.
        prior: see there.
        max_elevation: see there.
        sigma: see there.
        tracker_sd: see there.
        estimate: see there.
        options: see there.
        chunk: lanes solved side by side.

    Returns:
        A :class:`Calibration` whose arrays have the problems' leading axes.

    Raises:
        InputError: contradicting options, or problems without a leading axis.
    """
    plan, given = _prepare(problems, method, prior, max_elevation, sigma, tracker_sd, estimate,
                           options)  # fmt: skip
    shape = problems.batch_shape
    if not shape:
        raise InputError("calibrate_batch needs problems with a leading axis; use calibrate")
    if chunk < 1:
        raise InputError(f"chunk must be at least 1, not {chunk}")
    problems = _with_bound(problems, given)
    flat = jax.tree.map(lambda leaf: leaf.reshape((-1, *leaf.shape[len(shape) :])), problems)
    result = _solve_chunks(flat, given, plan, min(chunk, flat.mask.shape[0]))
    return jax.tree.map(lambda leaf: leaf.reshape((*shape, *leaf.shape[1:])), result)


def _prepare(
    problem, method, prior, max_elevation, sigma, tracker_sd, estimate, options
) -> tuple[_Plan, _Given]:
    options = Options() if options is None else options
    if method not in ("joint", "alternating", "conventional"):
        raise InputError(f"method must be joint, alternating or conventional, not {method!r}")
    if prior not in ("auto", "gaussian", "bounded"):
        raise InputError(f"prior must be auto, gaussian or bounded, not {prior!r}")
    unknown = [name for name in estimate if name != "scale"]
    if unknown:
        raise InputError(f"cannot estimate {unknown[0]!r}; this version estimates: scale")
    if "scale" in estimate and not problem.pixels:
        raise InputError("the points are in mm already: there is no pixel scale to estimate")
    if problem.pixels and not problem.spacing_known and "scale" not in estimate:
        raise InputError(
            'the pixels have no spacing_mm: give it, or estimate the scale (estimate=("scale",), '
            "--estimate scale)"
        )
    kind: Literal["none", "gaussian", "bounded"] = "gaussian"
    if method == "conventional":
        kind = "none"
    elif method == "alternating" or prior == "bounded":
        kind = "bounded"
    if kind != "gaussian" and (sigma is not None or tracker_sd is not None):
        raise InputError("sigma and tracker_sd belong to the joint method's gaussian prior")
    if tracker_sd is not None and sigma is None:
        raise InputError("tracker_sd needs given sigma: self-tuned SDs contain the tracker's noise")
    if max_elevation is not None and kind != "bounded":
        raise InputError(
            "max_elevation belongs to the alternating method and to the joint one's bounded prior"
        )
    if "scale" in estimate and options.solver == "gradient" and method == "conventional":
        raise InputError("the gradient solver moves X only: it cannot estimate the scale")
    for name, value in (("sigma", sigma), ("tracker_sd", tracker_sd)):
        _check_positive(name, value, 0.0 if name == "tracker_sd" else np.finfo(float).tiny)
    _check_positive("max_elevation", max_elevation, 0.0)
    dtype = problem.mask.dtype

    def array(value: object) -> Array | None:
        return None if value is None else jnp.asarray(value, dtype)

    given = _Given(array(sigma), array(tracker_sd), array(max_elevation))
    if given.sigma is not None and given.sigma.shape != (3,):
        raise InputError("sigma must be three numbers: lateral, range, elevational, mm")
    blocks = (*RIGID, "scale") if "scale" in estimate else RIGID
    tuning = kind == "gaussian" and sigma is None
    return _Plan(method, kind, tuning, blocks, options), given


def _check_positive(name: str, value: object, least: float) -> None:
    if value is None or is_traced(value):
        return
    numbers = np.asarray(value, dtype=float)
    if not (np.isfinite(numbers).all() and (numbers >= least).all()):
        raise InputError(f"{name} must be finite and not negative, in mm, not {value!r}")


def _check_values(problem: Problem) -> None:
    leaves = jax.tree.leaves(problem)
    if any(is_traced(leaf) for leaf in leaves):
        return
    used = np.asarray(problem.mask) > 0
    if used.sum() < MINIMUM_IMAGES:
        raise InputError(
            f"{int(used.sum())} used images are too few: at least {MINIMUM_IMAGES} are needed"
        )
    for name in ("poses", "measurements"):
        values = np.asarray(getattr(problem, name))
        bad = ~np.isfinite(values).reshape(len(used), -1).all(axis=1) & used
        if bad.any():
            raise InputError(f"{name} of image {np.flatnonzero(bad)[0]} hold NaN or Inf")


def _with_bound(problem: Problem, given: _Given) -> Problem:
    if given.max_elevation is None:
        return problem
    bound = jnp.broadcast_to(given.max_elevation, problem.mask.shape)
    return replace(problem, max_elevation=bound)


@partial(jax.jit, static_argnums=2)
def _solve_jit(problem: Problem, given: _Given, plan: _Plan) -> Calibration:
    return _solve(problem, given, plan)


@partial(jax.jit, static_argnums=(2, 3))
def _solve_chunks(problems: Problem, given: _Given, plan: _Plan, chunk: int) -> Calibration:
    return jax.lax.map(lambda problem: _solve(problem, given, plan), problems, batch_size=chunk)


class _Solution(eqx.Module):
    """What the methods have in common when they are done."""

    parameters: Parameters
    offset: Float[Array, " k"]
    prior: AbstractPrior
    sigma: Float[Array, 3] | None
    sigma_floored: Bool[Array, 3]
    cost: Float[Array, ""]
    stationarity: Float[Array, ""]
    arrived: Bool[Array, ""]
    iterations: Array
    variance_rounds: Array
    rotation_change: Float[Array, ""]
    translation_change: Float[Array, ""]
    trace: Float[Array, " trace"] | None
    searched_start: Bool[Array, ""]


def _solve(problem: Problem, given: _Given, plan: _Plan) -> Calibration:
    frozen = jax.lax.stop_gradient((problem, given))
    solution = _run_method(*frozen, plan)
    # The solver saw constants; here its answer becomes a function of the data again.
    parameters, offset, prior, sigma = _attach(solution, problem, given, plan)
    uncertainty = assess(
        parameters, offset, prior, problem, plan.blocks,
        whitened=plan.prior == "gaussian", uses_prior=plan.prior != "none",
    )  # fmt: skip
    return _assemble(solution, parameters, offset, prior, sigma, uncertainty, problem, plan)


def _run_method(problem: Problem, given: _Given, plan: _Plan) -> _Solution:
    options, blocks = plan.options, plan.blocks
    dtype = problem.mask.dtype
    solver = "lm" if plan.method != "conventional" or options.solver == "gradient" else (
        options.solver
    )  # fmt: skip
    conventional = plan.method == "conventional"
    begun = from_scratch(
        problem, blocks, solver=solver, max_steps=options.max_iterations,
        trace=options.trace if conventional else 0,
    )  # fmt: skip
    start = begun.fit.parameters
    zero = jnp.zeros((), dtype)
    none = jnp.zeros((), jnp.int32)

    def solution(fit, prior: AbstractPrior, arrived, **others) -> _Solution:
        common = {
            "sigma": None, "sigma_floored": jnp.zeros(3, bool), "variance_rounds": none,
            "rotation_change": zero, "translation_change": zero,
        }  # fmt: skip
        return _Solution(
            parameters=fit.parameters, offset=fit.offset, prior=prior, cost=fit.cost,
            stationarity=fit.stationarity, arrived=arrived, iterations=fit.iterations,
            trace=fit.trace, searched_start=begun.searched, **(common | others),
        )  # fmt: skip

    if conventional:
        fit = begun.fit
        if options.solver == "gradient":
            fit = pairwise_gradient(
                begun.start, problem, blocks, tolerance=options.gradient_tolerance,
                max_steps=100 * options.max_iterations, trace=options.trace,
            )  # fmt: skip
        return solution(fit, InPlane(), fit.settled)

    if plan.prior == "bounded":
        prior = Bounded(_bound(problem))
        if plan.method == "alternating":
            done = alternate(
                start, prior, problem, blocks, tolerance_rad=options.tolerance_rad,
                tolerance_mm=options.tolerance_mm, max_rounds=options.max_rounds,
                inner_steps=options.inner_steps, trace=options.trace,
            )  # fmt: skip
            return solution(
                done, prior, done.tolerance_met, rotation_change=done.rotation_change,
                translation_change=done.translation_change,
            )  # fmt: skip
        fit = joint(
            start, prior, problem, blocks, max_steps=options.max_iterations, trace=options.trace
        )
        return solution(fit, prior, fit.settled)

    shape = covariance_shape(problem)
    if plan.self_tuning:
        tuned = self_tuned(start, problem, blocks, max_steps=options.max_iterations,
                           trace=options.trace)  # fmt: skip
        return solution(
            tuned.fit, Gaussian(tuned.sigma, shape), tuned.fit.settled & tuned.settled,
            sigma=tuned.sigma, sigma_floored=tuned.floored, variance_rounds=tuned.rounds,
        )  # fmt: skip
    prior = Gaussian(_given_sigma(given), shape, given.tracker_sd)
    fit = joint(
        start, prior, problem, blocks, max_steps=options.max_iterations, trace=options.trace
    )
    return solution(fit, prior, fit.settled, sigma=given.sigma)


def _given_sigma(given: _Given) -> Float[Array, 3]:
    if given.sigma is None:
        raise InputError("the gaussian prior without self-tuning needs sigma")
    return given.sigma


def _bound(problem: Problem) -> Float[Array, " n"]:
    if problem.max_elevation is None:
        return jnp.full_like(problem.mask, DEFAULT_MAX_ELEVATION_MM)
    return problem.max_elevation


def _attach(
    solution: _Solution, problem: Problem, given: _Given, plan: _Plan
) -> tuple[Parameters, Array, AbstractPrior, Array | None]:
    """The solution as a differentiable function of the problem (and of given numbers)."""
    reference, offset = solution.parameters, solution.offset
    shape = covariance_shape(problem)
    if plan.self_tuning and solution.sigma is not None:
        tangent, sigma = implicit.self_tuned_optimum(
            plan.blocks, reference, solution.sigma, problem
        )
        return retract(reference, tangent, plan.blocks), offset, Gaussian(sigma, shape), sigma
    prior: AbstractPrior = InPlane()
    if plan.prior == "bounded":
        prior = Bounded(_bound(problem))
    elif plan.prior == "gaussian":
        prior = Gaussian(_given_sigma(given), shape, given.tracker_sd)
    tangent, offset = implicit.optimum(plan.blocks, reference, offset, prior, problem)
    return retract(reference, tangent, plan.blocks), offset, prior, given.sigma


def _assemble(
    solution: _Solution,
    parameters: Parameters,
    offset: Float[Array, " k"],
    prior: AbstractPrior,
    sigma: Float[Array, 3] | None,
    uncertainty: Uncertainty,
    problem: Problem,
    plan: _Plan,
) -> Calibration:
    matrix = parameters.matrix()
    residual = circle_residual(parameters, jnp.zeros_like(problem.mask), problem)
    used = jnp.sum(problem.mask)
    elevation = prior.elevation(parameters, offset, problem)
    if sigma is None:
        errors = measurement_residual(parameters, problem).at[:, 2].set(elevation)
        # The unknowns' degrees of freedom are shared equally by the three components.
        freedom = jnp.maximum(used - uncertainty.weakest.shape[0] / 3, 1.0)
        mean_square = jnp.sum(errors**2, axis=0) / freedom
        if plan.prior == "bounded":
            # Offsets within a bound have a root mean square within it, too.
            mean_square = mean_square.at[2].set(jnp.sum(elevation**2) / used)
        sigma = jnp.sqrt(mean_square)
    status = _status(solution, matrix, uncertainty, parameters, problem, plan)
    pose = slice(0, 6)
    point = block_slice(plan.blocks, "point")
    usable = status != Status.UNOBSERVABLE
    return Calibration(
        image_to_probe=matrix,
        point=parameters.point,
        elevation=elevation,
        elevation_sd=uncertainty.elevation_sd,
        sigma=sigma,
        covariance=jnp.where(usable, uncertainty.covariance[pose, pose], jnp.nan),
        point_covariance=jnp.where(usable, uncertainty.covariance[point, point], jnp.nan),
        scale_mm_per_px=problem.spacing * parameters.scale if problem.pixels else None,
        residual=residual,
        rms=root_mean_square(residual, problem.mask),
        mask=problem.mask,
        at_bound=uncertainty.at_bound,
        status_code=status,
        iterations=solution.iterations,
        variance_rounds=solution.variance_rounds,
        cost=solution.cost,
        stationarity=solution.stationarity,
        condition=uncertainty.condition,
        weakest=uncertainty.weakest,
        weakest_sd=uncertainty.weakest_sd,
        prior_direction=uncertainty.prior_direction,
        searched_start=solution.searched_start,
        sigma_tuned=jnp.asarray(plan.self_tuning) & (used >= MINIMUM_SELF_TUNING),
        sigma_floored=solution.sigma_floored,
        tolerance_met=solution.arrived,
        differentiable=_differentiable(solution, uncertainty, prior, offset, problem, status),
        rotation_change=solution.rotation_change,
        translation_change=solution.translation_change,
        trace=solution.trace,
        method=plan.method,
        prior=plan.prior,
        blocks=plan.blocks,
    )


def _status(
    solution: _Solution,
    matrix: Float[Array, "4 4"],
    uncertainty: Uncertainty,
    parameters: Parameters,
    problem: Problem,
    plan: _Plan,
) -> Array:
    finite = jnp.all(jnp.isfinite(matrix)) & jnp.all(jnp.isfinite(parameters.point))
    finite = finite & jnp.isfinite(solution.cost) & jnp.all(jnp.isfinite(parameters.scale))
    failed = jnp.logical_not(finite) | (jnp.sum(problem.mask) < MINIMUM_IMAGES)
    unobservable = uncertainty.degenerate
    if plan.prior != "bounded":
        # Within bounds a direction that nothing determines is still confined to an interval: that
        # is a warning. Without bounds nothing confines it.
        lever = lever_arm(parameters, problem)
        unobservable = unobservable | (uncertainty.weakest_sd > LARGEST_SD * lever)
    status = jnp.where(solution.arrived, Status.CONVERGED, Status.MAX_ITERATIONS)
    status = jnp.where(unobservable, Status.UNOBSERVABLE, status)
    return jnp.where(failed, Status.FAILED, status).astype(jnp.int32)


def _differentiable(
    solution: _Solution,
    uncertainty: Uncertainty,
    prior: AbstractPrior,
    offset: Float[Array, " k"],
    problem: Problem,
    status: Array,
) -> Bool[Array, ""]:
    """Whether the implicit function theorem's conditions hold at the solution."""
    still = 1e-6 if float(jnp.finfo(problem.mask.dtype).eps) < 1e-10 else 1e-3
    good = (status == Status.CONVERGED) & (solution.stationarity <= still)
    good = good & jnp.logical_not(jnp.any(solution.sigma_floored))
    if isinstance(prior, Bounded):
        # An offset about to reach its bound, or to leave it, makes the answer's kink.
        gap = jnp.abs(prior.limit(solution.parameters, problem) - jnp.abs(offset))
        closest = jnp.where((uncertainty.at_bound > 0) | (problem.mask == 0), jnp.inf, gap)
        good = good & (jnp.min(closest) > 1e-6) & (uncertainty.weakest_hold > 1e-6)
        good = good & jnp.logical_not(uncertainty.singular)
    return good
