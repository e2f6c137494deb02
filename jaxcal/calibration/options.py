"""What a caller gives: a problem in any form, a request, its checks, and the plan it becomes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, ParamSpec, TypeVar, get_args

import numpy as np

from jaxcal import InputError
from jaxcal.data.problem import Problem, stack
from jaxcal.data.recording import MINIMUM_IMAGES, Images, Recording
from jaxcal.model.distributions import Shape
from jaxcal.model.unknowns import EXTRA, MEDIUM, RIGID
from jaxcal.runtime.array_types import AnyArray, Array
from jaxcal.runtime.arrays import array_module, is_traced
from jaxcal.runtime.given_values import check_flag
from jaxcal.runtime.messages import shown
from jaxcal.runtime.precision import require_float64, with_dtype
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

P = ParamSpec("P")
T = TypeVar("T")

_HOW = (
    "jaxcal.Problem.from_arrays(poses, measurements) makes one of arrays, jaxcal.load(path) reads "
    "a recording"
)

PRIORS: dict[str, tuple[PriorName, ...]] = {
    "joint": get_args(PriorName),
    "alternating": ("bounded",),
    "conventional": (),
}
"""The priors that go with each method, beside ``auto``."""

SOUND_SPEED_SD_M_S = 20.0
"""Prior SD of the sound speed about its nominal value, m/s: some seven kelvin of water."""

DELAY_SD_S = 1e-6
"""Prior SD of the electronic delay about its nominal value, s."""

ALTERNATION = ("tolerance_rad", "tolerance_mm", "max_rounds", "inner_steps")
"""The options that the alternation alone has."""


def as_problem(value: Any, name: str) -> Problem:
    """The problem that a caller gave; recordings and images are converted.

    Args:
        value: a problem, a recording or one set of images.
        name: of the function that was called, for messages.

    Raises:
        InputError: anything else, with what to do.
    """
    if isinstance(value, Problem):
        return value
    if isinstance(value, Recording | Images):
        return Problem.from_recording(value)
    if isinstance(value, str | os.PathLike):
        raise InputError(
            f"{name} takes a problem, not a path: {name}(jaxcal.load({os.fspath(value)!r})), or "
            "import the file first (jaxcal import)"
        )
    if isinstance(value, list | tuple) and value and _are_problems(value):
        raise InputError(
            f"{name} takes one problem, not {len(value)}: jaxcal.calibrate_batch takes a list"
        )
    kind = "a dictionary" if isinstance(value, dict) else f"{type(value).__name__}"
    raise InputError(f"{name} takes a problem or a recording, not {kind}: {_HOW}")


def converting(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a public function whose first argument is a problem: it takes recordings as well.

    Placed outside :func:`jaxcal.runtime.precision.in_own_modes`: to segment times of flight imports
    JAX, and what imports JAX within would run in the caller's modes.
    """

    @wraps(function)
    def converted(*args: P.args, **kwargs: P.kwargs) -> T:
        name = f"jaxcal.{function.__name__}"
        if args:
            return function(*(as_problem(args[0], name), *args[1:]), **kwargs)  # pyright: ignore[reportCallIssue]
        if "problem" in kwargs:
            kwargs["problem"] = as_problem(kwargs["problem"], name)
        return function(*args, **kwargs)

    return converted


def as_batch(value: Any, name: str) -> Problem:
    """The batch of problems that a caller gave; a list of problems or recordings is stacked.

    Raises:
        InputError: anything else, or problems that differ in their number of images or in parts.
    """
    if isinstance(value, list | tuple):
        if not value:
            raise InputError(f"{name} takes at least one problem; the list is empty")
        return stack([as_problem(each, name) for each in value])
    return as_problem(value, name)


def unknown_names(estimate: Any) -> tuple[str, ...]:
    """Names of further unknowns as a tuple; a text may hold one name or several with commas."""
    if isinstance(estimate, str):
        return tuple(name.strip() for name in estimate.split(","))
    if estimate is None:
        return ()
    if not isinstance(estimate, Iterable):
        raise InputError(f"estimate must be names of unknowns, not {shown(estimate)}")
    return tuple(estimate)


def _are_problems(values: Any) -> bool:
    return all(isinstance(each, Problem | Recording | Images) for each in values)


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
    """Refuse options of the alternation (:data:`ALTERNATION`) that another method was given.

    Args:
        names: of the given ones, as the caller wrote them.
        method: the method's name.
    """
    if (given := " and ".join(names)) and method != "alternating":
        raise InputError(f"only the alternating method has {given}")


@dataclass(frozen=True)
class Request:
    """A caller's request before any check; :func:`jaxcal.calibrate` documents each part."""

    method: Method = "joint"
    prior: PriorName = "auto"
    max_elevation: float | np.ndarray | Array | None = None
    sigma: tuple[float, ...] | np.ndarray | Array | None = None
    tracker_sd: float | Array | None = None
    estimate: tuple[str, ...] = ()
    data: Data = "auto"
    sound_speed_sd: float | Array = SOUND_SPEED_SD_M_S
    delay_sd: float | Array = DELAY_SD_S
    options: Options | None = None
    robust: bool = False


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
    channels = _uses_channels(problem, request, kind)
    dtype = problem.mask.dtype

    def array(value: Any) -> AnyArray | None:
        # Plain numbers become numpy arrays, since JAX would compile their conversion.
        return None if value is None else array_module(value).asarray(value, dtype)

    blocks = RIGID + tuple(name for name in EXTRA if name in request.estimate)
    medium = None
    if kind == "gaussian" and any(name in blocks for name in MEDIUM):
        believed = (request.sound_speed_sd, request.delay_sd)
        medium = array_module(believed).stack([array(sd) for sd in believed])
    given = Given(array(request.sigma), array(request.tracker_sd), medium)
    components = 2 if channels else 3
    if given.sigma is not None and given.sigma.shape != (components,):
        names = "element distance, offset" if channels else "lateral, range, elevational"
        raise InputError(f"sigma must be {components} numbers: {names}, mm")
    tuning = kind == "gaussian" and request.sigma is None
    laws: tuple[Shape, ...] = ()
    if tuning and request.prior in LAWS:
        laws = LAWS[request.prior]
    plan = SolvePlan(
        request.method,
        kind,
        tuning,
        laws,
        channels,
        blocks,
        options,
        bool(request.robust),
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
    for name, least, one in (
        ("sound_speed_sd", tiny, True),
        ("delay_sd", tiny, True),
        ("tracker_sd", 0.0, True),
        ("sigma", tiny, False),
        ("max_elevation", 0.0, False),
    ):
        value = getattr(request, name)
        if value is not getattr(Request, name):  # the default
            check_size(name, value, least, one=one)
    return prior


def _check_names(request: Request) -> None:
    for name, names in (("method", Method), ("prior", PriorName), ("data", Data)):
        value = getattr(request, name)
        if not is_one_of(value, names):
            listed = ", ".join(get_args(names))
            raise InputError(f"{name} must be one of {listed}, not {shown(value)}")
    check_flag("robust", request.robust)
    for name in request.estimate:
        if name not in EXTRA:
            raise InputError(f"cannot estimate {shown(name)}; there are: {', '.join(EXTRA)}")


def _check_combination(request: Request, kind: Prior) -> None:
    if request.prior not in (*PRIORS[request.method], "auto"):
        raise InputError(f"the prior {request.prior} does not go with the method {request.method}")
    if kind != "gaussian" and (request.sigma is not None or request.tracker_sd is not None):
        raise InputError("sigma and tracker_sd belong to the joint method's gaussian prior")
    for name, unknown in zip(("sound_speed_sd", "delay_sd"), MEDIUM, strict=True):
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
            'the pixels have no spacing_mm: give it, or estimate the scale (estimate=("scale",), '
            "--estimate scale)"
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


def check_shapes(problem: Problem) -> None:
    """Refuse arrays that do not go together, as ``dataclasses.replace`` may leave a problem.

    Raises:
        InputError: what is no array of real numbers, or has another shape than the mask asks for.
    """
    shape = tuple(np.shape(problem.mask))
    batch = shape[:-1]
    if not shape:
        raise InputError("mask of the problem must have an axis for the images")
    for name, wanted, optional in (
        ("mask", shape, False),
        ("poses", (*shape, 4, 4), False),
        ("measurements", (*shape, 2), False),
        ("spacing", (*batch, 2), False),
        ("face_offset", batch, False),
        ("covariance", (*shape, 2, 2), True),
        ("max_elevation", shape, True),
    ):
        value = getattr(problem, name)
        if value is None and optional:
            continue
        kind = getattr(getattr(value, "dtype", None), "kind", "")
        # bfloat16 and its like are of numpy's kind V.
        if value is None or kind not in ("f", "V"):
            raise InputError(f"{name} of the problem must be an array of real numbers")
        if np.shape(value) != wanted:
            raise InputError(
                f"{name} of the problem must have shape {wanted}, not {np.shape(value)}"
            )


def check_values(problem: Problem) -> None:
    """Refuse NaN, Inf and too few images, if the values are concrete.

    Raises:
        InputError: a mask of other numbers than 0 and 1, NaN or Inf, with the number of the image,
            too few images, or pixels without a size.
    """
    if is_traced(problem):
        return
    mask = np.asarray(problem.mask)
    if not np.isin(mask, (0, 1)).all():
        raise InputError("mask of the problem must hold 1 (used) or 0 (left out) for every image")
    used = mask > 0
    if used.sum() < MINIMUM_IMAGES:
        raise InputError(
            f"{int(used.sum())} used images are too few: at least {MINIMUM_IMAGES} are needed"
        )
    for name in ("poses", "measurements"):
        values = np.asarray(getattr(problem, name))
        bad = ~np.isfinite(values).reshape(len(used), -1).all(axis=1) & used
        if bad.any():
            raise InputError(f"{name} of image {np.flatnonzero(bad)[0]} hold NaN or Inf")
    spacing = np.asarray(problem.spacing)
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise InputError(f"spacing of the problem must be two positive numbers, not {spacing}")
    if not np.isfinite(np.asarray(problem.face_offset)):
        raise InputError("face_offset of the problem must be finite")


def _with_bound(problem: Problem, bound: AnyArray | None) -> Problem:
    """The problem with the caller's bound on the offsets, where there is one."""
    if bound is None:
        return problem
    wanted = problem.mask.shape
    try:
        bound = array_module(bound).broadcast_to(bound, wanted)
    except ValueError:
        raise InputError(
            f"max_elevation must be one number, or one for each of {wanted[-1]} images, mm; its "
            f"shape is {bound.shape}"
        ) from None
    return replace(problem, max_elevation=bound)
