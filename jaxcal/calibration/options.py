"""The options of a solve, and the checks that a request must pass.

Everything static about a solve is a :class:`SolvePlan`, so that each combination is compiled once.
The numbers in the request are a :class:`Given`, which is traced.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeGuard, get_args

import numpy as np

from jaxcal import InputError
from jaxcal.calibration.inputs import check_flag, whole_number
from jaxcal.calibration.names import Data, Method, PriorName, SolverName
from jaxcal.data.problem import Problem
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.io.readable import shown
from jaxcal.model.distributions import SHAPES, UNIFORM, Shape
from jaxcal.model.unknowns import EXTRA, MEDIUM, RIGID, Blocks
from jaxcal.runtime.array_types import AnyArray, Array, Float
from jaxcal.runtime.arrays import array_module, is_traced, real_array
from jaxcal.runtime.trees import array_tree

if TYPE_CHECKING:
    import optimistix as optx

Precision = Literal["float64", "float32"]

Prior = Literal["none", "gaussian", "bounded"]
"""What is assumed about the offsets: in the image plane, Gaussian (or weighed laws), bounded."""

PRIORS: dict[str, tuple[PriorName, ...]] = {
    "joint": get_args(PriorName),
    "alternating": ("bounded",),
    "conventional": (),
}
"""The priors that go with each method, beside ``auto``."""

LAWS: dict[str, tuple[Shape, ...]] = {"auto": SHAPES, "uniform": UNIFORM}
"""The priors of the joint method that weigh laws of the offsets, each with its laws."""

DEFAULT_MAX_ELEVATION_MM = 1.0
"""The bound on the offsets if none is given; it is that of the paper."""

SOUND_SPEED_SD_M_S = 20.0
"""Prior SD of the sound speed about its nominal value, m/s: some seven kelvin of water."""

DELAY_SD_S = 1e-6
"""Prior SD of the electronic delay about its nominal value, s."""

ALTERNATION = ("tolerance_rad", "tolerance_mm", "max_rounds", "inner_steps")
"""The options that the alternation alone has."""

MOST_STEPS = 10**7
"""Most rounds, steps and kept values that can be asked for."""

_UNITS = {
    "sound_speed_sd": "m/s",
    "delay_sd": "s",
    "tolerance_rad": "rad",
    "gradient_tolerance": "",
}
"""Units of numbers of a request that are not in mm."""


@dataclass(frozen=True)
class Options:
    """How to solve; static, so each combination is compiled once.

    Attributes:
        solver: ``lm`` is jaxcal's own. The conventional method also has ``gauss-newton`` and
            ``gradient``. An optimistix least-squares solver, e.g.
            ``optimistix.Dogleg(1e-10, 1e-10)``, replaces ``lm`` in the conventional method and in
            the joint one (except for its prior ``bounded``). It has the same start, stops by its
            own rule, and takes longer in a batch.
        gradient_tolerance: relative tolerance at which ``gradient`` stops.
        tolerance_rad: the alternation stops when a round turns X by less than this, rad, and also
            moves its origin by less than ``tolerance_mm``. The paper does not state these limits.
        tolerance_mm: see ``tolerance_rad``; mm.
        max_rounds: most rounds of the alternation.
        inner_steps: Gauss-Newton steps on X and c in each round of the alternation.
        max_iterations: most linearisations of the other solvers.
        trace: how many values of the objective to keep in the result.
        differentiate: False if the answer will not be differentiated. Inside a caller's grad it is
            then a constant, and derivatives are neither traced nor compiled.
        precision: ``float64``, whatever the dtype of the problem's arrays, or ``float32``, which is
            faster on some devices and loses six digits.
    """

    solver: SolverName | optx.AbstractLeastSquaresSolver = "lm"
    gradient_tolerance: float = 1e-6
    tolerance_rad: float = 1e-3
    tolerance_mm: float = 0.1
    max_rounds: int = 1000
    inner_steps: int = 2
    max_iterations: int = 100
    trace: int = 0
    differentiate: bool = True
    precision: Precision = "float64"

    def __post_init__(self) -> None:
        if _is_optimistix(self.solver):
            _check_static(self.solver)
        elif not _is_one_of(self.solver, SolverName):
            raise InputError(
                "solver must be lm, gauss-newton, gradient or an optimistix least-squares solver, "
                f"not {shown(self.solver)}"
            )
        if not _is_one_of(self.precision, Precision):
            raise InputError(f"precision must be float64 or float32, not {shown(self.precision)}")
        check_flag("differentiate", self.differentiate)
        for name in ("gradient_tolerance", "tolerance_rad", "tolerance_mm"):
            _check_size(name, getattr(self, name), np.finfo(float).tiny)
        for name in ("max_rounds", "inner_steps", "max_iterations", "trace"):
            whole_number(name, getattr(self, name), int(name != "trace"), MOST_STEPS)


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


def _is_one_of(value: object, names: Any) -> bool:
    """Whether a value is one of a Literal's names; comparing an array would give an array."""
    return isinstance(value, str) and value in get_args(names)


def _is_optimistix(solver: Any) -> TypeGuard[optx.AbstractLeastSquaresSolver]:
    """Whether this is a least-squares solver of optimistix, without the slow import of it."""
    found = sys.modules.get("optimistix")
    return found is not None and isinstance(solver, found.AbstractLeastSquaresSolver)


def _check_static(solver: optx.AbstractLeastSquaresSolver) -> None:
    """Check that a solver's settings are plain numbers, since a solver is part of the program."""
    try:
        hash(solver)
    except TypeError:
        raise InputError(
            f"the settings of {type(solver).__name__} must be plain numbers, not arrays"
        ) from None


@dataclass(frozen=True)
class SolvePlan:
    """Everything static about a solve: method, belief about the offsets, data, unknowns.

    ``laws`` are weighed after the self-tuned Gaussian solve; if there are none, the Gaussian solve
    is the answer. ``robust``: find the images that agree first, and leave the others out.
    """

    method: Method
    prior: Prior
    self_tuning: bool
    laws: tuple[Shape, ...]
    channels: bool
    blocks: Blocks
    options: Options
    robust: bool = False

    @property
    def other_solver(self) -> optx.AbstractLeastSquaresSolver | None:
        """The caller's own solver; None if there is none."""
        solver = self.options.solver
        return solver if _is_optimistix(solver) else None

    @property
    def one_by_one(self) -> bool:
        """Whether problems are solved one at a time, as a caller's solver and ``gradient`` do."""
        return self.other_solver is not None or self.options.solver == "gradient"

    @property
    def reported_prior(self) -> str:
        """The prior's name in the result: if laws were weighed, the name of their prior."""
        names = [name for name, laws in LAWS.items() if laws == self.laws]
        return names[0] if names else self.prior


@array_tree
class Given:
    """Numbers that the caller gave in addition to the problem.

    Attributes:
        sigma: SDs of (lateral, range, offset), or of (element distance, offset) on channels, mm.
        tracker_sd: SD of the tracked position, mm.
        max_elevation: bound on the offsets, mm.
        medium_sd: prior SDs of the sound speed (m/s) and the delay (s).
    """

    sigma: Float[AnyArray, " components"] | None
    tracker_sd: Float[AnyArray, ""] | None
    max_elevation: Float[AnyArray, "*images"] | None
    medium_sd: Float[AnyArray, 2] | None


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


def prepare(problem: Problem, request: Request) -> tuple[SolvePlan, Given]:
    """Check a request against its problem, and divide it into a static and a traced part.

    Raises:
        InputError: parts that contradict each other or the problem.
    """
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
    given = Given(
        array(request.sigma), array(request.tracker_sd), array(request.max_elevation), medium
    )
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
        options_of(request.options),
        bool(request.robust),
    )
    return plan, given


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
            _check_size(name, value, least, one=one)
    return prior


def _check_names(request: Request) -> None:
    for name, names in (("method", Method), ("prior", PriorName), ("data", Data)):
        value = getattr(request, name)
        if not _is_one_of(value, names):
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
    if _is_optimistix(solver) and kind == "bounded":
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


def _check_size(name: str, value: Any, least: float, *, one: bool = True) -> None:
    """Check one number, or several; of traced ones, that it is one."""
    numbers = np.array(np.nan)
    if not is_traced(value):
        with suppress(InputError):
            numbers = real_array(value, name)
        if not (np.isfinite(numbers).all() and (numbers >= least).all()):
            unit = _UNITS.get(name, "mm")
            unit = f", in {unit}" if unit else ""
            wanted = "positive" if least > 0 else "not negative"
            raise InputError(f"{name} must be finite and {wanted}{unit}, not {shown(value)}")
    if one and np.shape(value) != ():
        raise InputError(f"{name} must be one number, not {shown(value)}")


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
        if value is None or kind not in ("b", "i", "u", "f", "V"):
            raise InputError(f"{name} of the problem must be an array of real numbers")
        if np.shape(value) != wanted:
            raise InputError(
                f"{name} of the problem must have shape {wanted}, not {np.shape(value)}"
            )


def check_values(problem: Problem) -> None:
    """Refuse NaN, Inf and too few images, if the values are concrete.

    Raises:
        InputError: NaN or Inf, with the number of the image, too few images, or pixels without a
            size.
    """
    if is_traced(problem):
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
    spacing = np.asarray(problem.spacing)
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise InputError(f"spacing of the problem must be two positive numbers, not {spacing}")
    if not np.isfinite(np.asarray(problem.face_offset)):
        raise InputError("face_offset of the problem must be finite")


def with_bound(problem: Problem, given: Given) -> Problem:
    """The problem with the caller's bound on the offsets, where there is one."""
    if given.max_elevation is None:
        return problem
    bound, wanted = given.max_elevation, problem.mask.shape
    try:
        bound = array_module(bound).broadcast_to(bound, wanted)
    except ValueError:
        raise InputError(
            f"max_elevation must be one number, or one for each of {wanted[-1]} images, mm; its "
            f"shape is {bound.shape}"
        ) from None
    return replace(problem, max_elevation=bound)
