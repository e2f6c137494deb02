"""Calibrate one problem or a batch, by any method; the result is a :class:`Calibration`.

What a caller asks for is a :class:`Request`, which :func:`prepare` checks against the problem.
Conventional calibration of one problem has a closed form, which needs numpy only
(:mod:`jaxcal.calibration.conventional`). Everything else, and everything inside a caller's jit,
vmap or grad, is solved by the engine (:mod:`jaxcal.calibration.engine`), by compiled programs of
one pure function of arrays (:mod:`jaxcal.calibration.pipeline`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from jaxcal import InputError
from jaxcal.calibration.conventional import closed_form_answer
from jaxcal.calibration.dependence import independent
from jaxcal.calibration.serial_correlation import widened, widens
from jaxcal.data.problem import Problem, as_batch, as_problem, check_shapes, check_values
from jaxcal.data.recording import MINIMUM_IMAGES, Images, Recording
from jaxcal.model.unknowns import (
    DELAY_SD_S,
    FURTHER,
    MEDIUM,
    RIGID,
    SOUND_SPEED_SD_M_S,
    TABLE,
    unknown_names,
    with_prior,
)
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import AnyArray, Array
from jaxcal.runtime.arrays import (
    array_module,
    array_tree,
    is_traced,
    jax_in_use,
    read_only,
    static,
)
from jaxcal.runtime.given_values import check_flag, whole_number
from jaxcal.runtime.jax_modes import (
    importing_jax,
    in_own_modes,
    inside_transformation,
    require_float64,
    with_dtype,
)
from jaxcal.runtime.messages import shown
from jaxcal.solvers.names import Data, Method, PriorName
from jaxcal.solvers.plan import (
    LAWS,
    Given,
    Options,
    Prior,
    SolvePlan,
    check_size,
    is_one_of,
    is_optimistix,
)

PRIORS: dict[str, tuple[PriorName, ...]] = {
    "joint": get_args(PriorName),
    "alternating": ("bounded",),
    "conventional": (),
}
"""The priors that go with each method, beside ``auto``."""

ALTERNATION = ("tolerance_rad", "tolerance_mm", "max_rounds", "inner_steps")
"""The options that the alternation alone has."""

LARGEST_CHUNK = 2**31 - 1
"""Largest ``chunk``: problems solved side by side."""


@array_tree
class Request:
    """A caller's request before any check; :func:`jaxcal.calibrate` documents each part.

    It is a tree so that JAX finds the numbers that are traced.
    """

    method: Method = static(default="joint")
    prior: PriorName = static(default="auto")
    max_elevation: float | np.ndarray | Array | None = None
    sigma: Sequence[float] | np.ndarray | Array | None = None
    tracker_sd: float | Array | None = None
    estimate: tuple[str, ...] = static(default=())
    data: Data = static(default="auto")
    sound_speed_sd: float | Array = SOUND_SPEED_SD_M_S
    delay_sd: float | Array = DELAY_SD_S
    options: Options | None = static(default=None)
    robust: bool = static(default=False)


def calibrate(
    problem: Problem | Recording | Images,
    method: Method = "joint",
    prior: PriorName = "auto",
    *,
    max_elevation: float | np.ndarray | Array | None = None,
    sigma: Sequence[float] | np.ndarray | Array | None = None,
    tracker_sd: float | Array | None = None,
    estimate: str | Sequence[str] = (),
    data: Data = "auto",
    sound_speed_sd: float | Array = SOUND_SPEED_SD_M_S,
    delay_sd: float | Array = DELAY_SD_S,
    options: Options | None = None,
    robust: bool = False,
) -> Calibration:
    """Find X, the target and the elevational offsets; no starting guess is needed.

    Args:
        problem: one problem (a batch is handed to :func:`calibrate_batch`), a recording, or
            one set of images.
        method: ``joint`` (X, c and every offset together), ``alternating`` (the paper's Fig. 4) or
            ``conventional`` (Eq. 7, every target in the plane). All can be differentiated, but the
            alternation only with tolerances so small that it reaches the minimum.
        prior: distribution of the offsets in the joint method. ``auto``: SDs are estimated, and the
            answer is an average over several distributions of the offsets, with or without a mean,
            and over noise models, weighted by their probability (:mod:`jaxcal.solvers.auto`).
            ``uniform``: the same, but only with uniform distributions of the offsets; where offsets
            have no sharp limits, the stated error is then too small.
            ``gaussian``: offsets and errors are Gaussian, with the SDs of ``sigma`` or, without it,
            estimated by REML. ``bounded``: |y_i| <= max_elevation with equal weights, the
            alternation's objective. With given ``sigma``, ``auto`` is ``gaussian``.
        max_elevation: bound m on |y|, mm, one number or (n,), for a batch (*batch, n); overrides
            the problem's own. Without either bound, the alternation and ``bounded`` use 1 mm.
            ``auto`` and ``uniform`` truncate the distribution of each image's offset at the bound.
        sigma: given SDs of lateral position, range and elevational offset, mm; on channels, of an
            element's distance and the elevational offset.
        tracker_sd: isotropic SD of the tracked position, mm; only with a given ``sigma``.
        estimate: further unknowns: ``scale`` (the pixels' size), ``sound-speed``, ``delay``; one
            name, or several.
        data: ``channels``: the joint method's residuals are those of every element's time of flight
            (the recording must hold them); ``points``: those of the segmented points; ``auto``:
            channels if they hold more information: on curvilinear probes and for sound speed or
            delay. An image that no element heard is left out of ``channels``.
        sound_speed_sd: prior SD of the sound speed about its nominal value, m/s (joint method,
            except ``bounded``).
        delay_sd: prior SD of the delay about its nominal value, s (joint method, except
            ``bounded``).
        options: tolerances and limits.
        robust: first find the images that agree with each other, even if nearly half of all images
            are wrong (:mod:`jaxcal.solvers.consensus`), and leave the others out. Many images that
            are wrong in the same way, by a few mm (a mount that slipped), agree with each other and
            may stay. ``outlier`` and ``studentised_errors`` say which and why. If no image has a
            gross error, none is left out, and the answer is the same as without ``robust``.

    Returns:
        A :class:`Calibration`; read its ``status`` and ``warnings`` before using it. The frames of
        one pose count as one image, and frames of frozen tracking are left out
        (:mod:`jaxcal.calibration.dependence`); frames that do not count are masked out in the
        answer and in its ``problem``. Errors correlated in successive images widen its covariance
        (:mod:`jaxcal.calibration.serial_correlation`). All this is done for one problem with
        concrete arrays only; under jit, vmap or grad, and in batches, images are treated as
        independent.

    Raises:
        InputError: options that contradict each other or the problem; with concrete arrays also
            NaN, Inf and fewer than 4 different poses. Under jit, vmap or grad values cannot be
            checked, and such problems get the status ``failed``. Also where an alternation is
            differentiated that stops before the minimum.
    """
    request = Request(
        method=method,
        prior=prior,
        max_elevation=max_elevation,
        sigma=sigma,
        tracker_sd=tracker_sd,
        estimate=unknown_names(estimate),
        data=data,
        sound_speed_sd=sound_speed_sd,
        delay_sd=delay_sd,
        options=options,
        robust=robust,
    )
    # Not in own modes: segmenting times of flight imports JAX, whose modes are entered after that.
    recording = problem if isinstance(problem, Recording) else None
    warned: tuple[str, ...] = ()
    if recording is not None:
        problem, warned = Problem.segmented(recording)
    found = _calibrated(as_problem(problem, "jaxcal.calibrate"), request)
    if recording is not None:
        found = replace(found, probe=recording.probe, pose_frames=recording.pose_frames)
    images = problem if recording is None else recording.calibration
    if not isinstance(images, Images):
        return found
    order = images.out_of_order()
    notes = (*warned, *found.notes, *(() if order is None else (order,)))
    return replace(found, frame_size=images.frame_size, notes=notes)


@in_own_modes
def _calibrated(problem: Problem, request: Request) -> Calibration:
    """:func:`calibrate` in the modes of JAX that jaxcal computes in."""
    problem, plan, given = prepare(problem, request)
    if problem.batch_shape:
        from jaxcal.calibration.engine import solve_batch

        return solve_batch(problem, given, plan, None)
    check_values(problem)
    # Under jit the answer is traced even if the problem is not.
    if inside_transformation(problem, given):
        return replace(_solve_alone(problem, given, plan), problem=problem)
    # Diagnostics read the data later, when the caller may have written to their arrays.
    problem = read_only(problem)
    widening = widens(plan.channels, plan.prior)
    joined, found = independent(problem, request.estimate, widened=widening)
    if found.images < MINIMUM_IMAGES:
        raise InputError(
            f"{'; '.join(found.words) or 'too few images'}; at least {MINIMUM_IMAGES} that are "
            "independent are needed: hold the probe still at different poses"
        )
    solved = _solve_alone(joined, given, plan)
    return widened(replace(solved, problem=joined, notes=tuple(found.words)))


def _solve_alone(problem: Problem, given: Given, plan: SolvePlan) -> Calibration:
    """Solve one problem in closed form or by the engine (traceable); the result is without it."""
    found = None
    if plan.method == "conventional" and not inside_transformation(problem, given):
        found = closed_form_answer(problem, plan)
    if found is None:
        from jaxcal.calibration.engine import solve_problem

        return solve_problem(problem, given, plan)
    if jax_in_use() is not None:
        from jaxcal.calibration.engine import as_jax_holds

        return as_jax_holds(found, problem)
    return read_only(found)


@importing_jax
@in_own_modes
def calibrate_batch(
    problems: Problem | Sequence[Problem | Recording | Images],
    method: Method = "joint",
    prior: PriorName = "auto",
    *,
    max_elevation: float | np.ndarray | Array | None = None,
    sigma: Sequence[float] | np.ndarray | Array | None = None,
    tracker_sd: float | Array | None = None,
    estimate: str | Sequence[str] = (),
    data: Data = "auto",
    sound_speed_sd: float | Array = SOUND_SPEED_SD_M_S,
    delay_sd: float | Array = DELAY_SD_S,
    options: Options | None = None,
    robust: bool = False,
    chunk: int | None = None,
) -> Calibration:
    """:func:`calibrate` for a batch of problems, compiled once and solved in chunks.

    A problem that cannot be solved (NaN, degenerate) gets its own status and does not affect the
    others.

    Problems that are not committed to a device are divided among all of JAX's local devices. A
    processor is one device, unless ``jax.config.update("jax_num_cpu_devices", n)`` (or
    JAX_NUM_CPU_DEVICES=n) before JAX's first use makes it n devices, one for each core. Except for
    rounding, results do not depend on this.

    Args:
        problems: leading axes of any shape; see :func:`jaxcal.stack`. A list of problems,
            recordings or sets of images is stacked, those with fewer images after masked ones were
            added to them.
        method: as for :func:`calibrate`.
        prior: as for :func:`calibrate`.
        max_elevation: as for :func:`calibrate`; (*batch, 1) gives each problem one bound.
        sigma: as for :func:`calibrate`.
        tracker_sd: as for :func:`calibrate`.
        estimate: as for :func:`calibrate`.
        data: as for :func:`calibrate`.
        sound_speed_sd: as for :func:`calibrate`.
        delay_sd: as for :func:`calibrate`.
        options: as for :func:`calibrate`.
        robust: as for :func:`calibrate`; it takes longer than the solve.
        chunk: number of problems solved together; by default 32 on a processor (64 with priors
            ``auto`` and ``uniform``, 8 on channels), and on a GPU as many as have a million images
            (on channels, distances of elements) together.

    Returns:
        A :class:`Calibration` whose arrays have the problems' leading axes.

    Raises:
        InputError: contradicting options, or problems without a leading axis.
    """
    problems = as_batch(problems, "jaxcal.calibrate_batch")
    if chunk is not None:
        chunk = whole_number("chunk", chunk, 1, LARGEST_CHUNK)
    request = Request(
        method=method,
        prior=prior,
        max_elevation=max_elevation,
        sigma=sigma,
        tracker_sd=tracker_sd,
        estimate=unknown_names(estimate),
        data=data,
        sound_speed_sd=sound_speed_sd,
        delay_sd=delay_sd,
        options=options,
        robust=robust,
    )
    problems, plan, given = prepare(problems, request, "jaxcal.calibrate_batch")
    if not problems.batch_shape:
        raise InputError("calibrate_batch needs problems with a leading axis; use calibrate")
    from jaxcal.calibration.engine import solve_batch

    return solve_batch(problems, given, plan, chunk)


def options_of(options: Options | None) -> Options:
    """The options that a caller gave, or the default ones.

    Raises:
        InputError: something else, a dictionary for example.
    """
    if options is None:
        return Options()
    if not isinstance(options, Options):
        raise InputError(
            "options must be made by jaxcal.Options, e.g. jaxcal.Options(max_rounds=100), not "
            f"{shown(options)}"
        )
    return options


def check_alternation(names: Iterable[str], method: str) -> None:
    """Refuse options of the alternation (:data:`ALTERNATION`) that another method was given."""
    if (given := " and ".join(names)) and method != "alternating":
        raise InputError(f"only the alternating method has {given}")


def prepare(
    problem: Problem, request: Request, name: str = "jaxcal.calibrate"
) -> tuple[Problem, SolvePlan, Given]:
    """Check a request against its problem.

    Args:
        problem: one or a batch.
        request: of the caller.
        name: of the function that was called, for messages.

    Returns:
        The problem in the precision and with the bound that the request asks for, and the static
        and the traced part of the request.

    Raises:
        InputError: parts that contradict each other or the problem.
    """
    check_shapes(problem)
    options = options_of(request.options)
    if options.precision == "float64":
        require_float64(name)
    problem = with_dtype(problem, np.dtype(options.precision))
    kind = check_request(request)
    _check_unknowns(problem, request)
    dtype = problem.mask.dtype
    channels = _uses_channels(problem, request, kind)
    if channels and problem.channels is not None:
        # Of an image that no element heard only the belief about its offset would be left.
        heard = problem.channels.heard
        silent = ~(array_module(heard).asarray(heard) > 0).any(axis=-1)
        if is_traced(silent) or silent.any():
            problem = replace(problem, mask=problem.mask * (1 - silent.astype(dtype)))

    def array(value: Any) -> AnyArray | None:
        # Plain numbers become numpy arrays, since JAX would compile their conversion.
        return None if value is None else array_module(value).asarray(value, dtype)

    blocks = RIGID + tuple(name for name in FURTHER if name in request.estimate)
    prior_sd = None
    if kind == "gaussian" and with_prior(blocks):
        rows = [TABLE[name] for name in with_prior(blocks)]
        believed = [array(getattr(request, row.prior_name, row.prior_sd)) for row in rows]
        prior_sd = array_module(believed).stack(believed)
    given = Given(array(request.sigma), array(request.tracker_sd), prior_sd)
    components = 2 if channels else 3
    if given.sigma is not None and given.sigma.shape != (components,):
        names = "element distance, offset" if channels else "lateral, range, elevational"
        raise InputError(f"sigma must be {components} numbers: {names}, mm")
    tuning = kind == "gaussian" and request.sigma is None
    laws = LAWS.get(request.prior, ()) if tuning else ()
    plan = SolvePlan(
        method=request.method,
        prior=kind,
        self_tuning=tuning,
        laws=laws,
        channels=channels,
        blocks=blocks,
        options=options,
        robust=bool(request.robust),
    )
    return _with_bound(problem, array(request.max_elevation)), plan, given


def check_request(request: Request) -> Prior:
    """Check a request as far as that is possible without its problem.

    Returns:
        What is assumed about the offsets.

    Raises:
        InputError: unknown names, or parts that contradict each other or would have no effect.
    """
    _check_names(request)
    prior: Prior = "gaussian"
    if request.method == "conventional":
        prior = "none"
    elif request.method == "alternating" or request.prior == "bounded":
        prior = "bounded"
    _check_combination(request, prior)
    tiny = np.finfo(float).tiny
    priors = [(TABLE[name].prior_name, tiny, True, TABLE[name].prior_unit) for name in MEDIUM]
    for name, least, one, unit in (
        *priors,
        ("tracker_sd", 0.0, True, "mm"),
        ("sigma", tiny, False, "mm"),
        ("max_elevation", 0.0, False, "mm"),
    ):
        value = getattr(request, name)
        if value is not getattr(Request, name):  # the default
            check_size(name, value, least, one=one, unit=unit)
    return prior


def _check_names(request: Request) -> None:
    for name, names in (("method", Method), ("prior", PriorName), ("data", Data)):
        value = getattr(request, name)
        if not is_one_of(value, names):
            listed = ", ".join(get_args(names))
            raise InputError(f"{name} must be one of {listed}, not {shown(value)}")
    check_flag("robust", request.robust)
    for name in request.estimate:
        if name not in FURTHER:
            raise InputError(f"cannot estimate {shown(name)}; there are: {', '.join(FURTHER)}")


def _check_combination(request: Request, kind: Prior) -> None:
    if request.prior not in (*PRIORS[request.method], "auto"):
        raise InputError(f"the prior {request.prior} does not go with the method {request.method}")
    if kind != "gaussian" and (request.sigma is not None or request.tracker_sd is not None):
        raise InputError("sigma and tracker_sd belong to the joint method's gaussian prior")
    for unknown in MEDIUM:
        name = TABLE[unknown].prior_name
        if getattr(request, name) is getattr(Request, name):  # the default
            continue
        if kind != "gaussian" or unknown not in request.estimate:
            raise InputError(
                f"{name} is the prior SD of an estimated {unknown}: it needs "
                f"estimate=({unknown!r},) and the joint method's prior auto, uniform or gaussian"
            )
    if request.tracker_sd is not None and request.sigma is None:
        raise InputError("tracker_sd needs given sigma: self-tuned SDs contain the tracker's noise")
    if request.sigma is not None and request.prior == "uniform":
        raise InputError("the uniform prior tunes its SDs: sigma belongs to the gaussian one")
    weighing = kind == "gaussian" and request.prior in LAWS and request.sigma is None
    if request.data == "channels" and kind != "gaussian":
        raise InputError("channels are solved by the joint method with the gaussian prior only")
    if request.data == "channels" and request.tracker_sd is not None:
        raise InputError("tracker_sd is for points; on channels there is no such unknown")
    if request.max_elevation is not None and kind != "bounded" and not weighing:
        raise InputError(
            "max_elevation belongs to the alternating method and to the joint one's priors auto, "
            "uniform (without given sigma) and bounded"
        )
    solver = options_of(request.options).solver
    if is_optimistix(solver) and kind == "bounded":
        raise InputError(
            "another solver would not keep the offsets within their bounds: it goes with the "
            "conventional method and the joint one's priors auto, uniform and gaussian"
        )
    if solver in ("gauss-newton", "gradient") and request.method != "conventional":
        raise InputError(f"the solver {solver} belongs to the conventional method")
    if request.estimate and solver == "gradient":
        raise InputError(
            f"the gradient solver moves X only: it cannot estimate the {request.estimate[0]}"
        )


def _check_unknowns(problem: Problem, request: Request) -> None:
    if "scale" in request.estimate and not problem.pixels:
        raise InputError("the points are in mm already: there is no pixel scale to estimate")
    if "scale" in request.estimate and "sound-speed" in request.estimate:
        raise InputError(
            "sound speed and axial pixel scale are one and the same factor on the range: estimate "
            "one of them"
        )
    if problem.pixels and not problem.spacing_known and "scale" not in request.estimate:
        raise InputError(
            "the pixels have no spacing_mm: give it (jaxcal import --spacing), or estimate the "
            'scale (estimate=("scale",), --estimate scale)'
        )


def _uses_channels(problem: Problem, request: Request, kind: str) -> bool:
    if request.data == "channels":
        if problem.channels is None:
            raise InputError("data='channels' needs times of flight; this problem has points only")
        return True
    if request.data == "points" or problem.channels is None or kind != "gaussian":
        return False
    # A straight array's points with their covariances tell as much as its channels, unless sound
    # speed or delay are unknown, which bend the wavefront. A curved array's points tell less.
    wanted = problem.curved or any(name in request.estimate for name in MEDIUM)
    three = request.sigma is not None and np.size(request.sigma) == 3
    return wanted and request.tracker_sd is None and not three


def _with_bound(problem: Problem, bound: AnyArray | None) -> Problem:
    """The problem with the caller's bound on the offsets, where there is one."""
    if bound is None:
        return problem
    wanted = problem.mask.shape
    # Fewer axes than the problems would leave open whether they are problems or images.
    fits = all(have in (1, want) for have, want in zip(bound.shape, wanted, strict=False))
    if bound.ndim not in (0, len(wanted)) or not fits:
        each = f"one for each of {wanted[-1]} images"
        if problem.batch_shape:
            each = f"an array of shape {wanted} or {(*problem.batch_shape, 1)}"
        raise InputError(
            f"max_elevation must be one number, or {each}, mm; its shape is {bound.shape}"
        )
    return replace(problem, max_elevation=array_module(bound).broadcast_to(bound, wanted))
