"""What is asked of the solvers, and how.

Everything static about a solve is a :class:`SolvePlan`, so that each combination is compiled once.
The numbers in the request are a :class:`Given`, which is traced.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeGuard, get_args

import numpy as np

from jaxcal import InputError
from jaxcal.model.distributions import SHAPES, UNIFORM, Shape
from jaxcal.model.unknowns import Blocks
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.runtime.arrays import array_tree, imported, is_traced
from jaxcal.runtime.given_values import check_flag, real_array, whole_number
from jaxcal.runtime.messages import shown
from jaxcal.solvers.names import Method, SolverName

if TYPE_CHECKING:
    import optimistix as optx

Precision = Literal["float64", "float32"]

Prior = Literal["none", "gaussian", "bounded"]
"""What is assumed about the offsets: in the image plane, Gaussian (or weighed laws), bounded."""

LAWS: dict[str, tuple[Shape, ...]] = {"auto": SHAPES, "uniform": UNIFORM}
"""The priors of the joint method that weigh laws of the offsets, each with its laws."""

TUNED = ("gaussian", *LAWS)
"""Priors with SDs of lateral position, range and offset."""

DEFAULT_MAX_ELEVATION_MM = 1.0
"""The bound on the offsets if none is given; it is that of the paper."""

MOST_STEPS = 10**7
"""Most rounds, steps and kept values that can be asked for."""


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
        max_iterations: most linearisations of the other solvers; ``gradient`` takes at most a
            hundred steps for each of them.
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
        if is_optimistix(self.solver):
            object.__setattr__(self, "solver", _static(self.solver))
        elif not is_one_of(self.solver, SolverName):
            raise InputError(
                "solver must be lm, gauss-newton, gradient or an optimistix least-squares solver, "
                f"not {shown(self.solver)}"
            )
        if not is_one_of(self.precision, Precision):
            raise InputError(f"precision must be float64 or float32, not {shown(self.precision)}")
        check_flag("differentiate", self.differentiate)
        tiny = np.finfo(float).tiny
        for name, unit in _TOLERANCES.items():
            value = getattr(self, name)
            if is_traced(value):
                raise InputError(f"{name} is part of the compiled program: it cannot be traced")
            check_size(name, value, tiny, unit=unit)
            object.__setattr__(self, name, float(value))
        for name in ("max_rounds", "inner_steps", "max_iterations", "trace"):
            value = whole_number(name, getattr(self, name), int(name != "trace"), MOST_STEPS)
            object.__setattr__(self, name, value)


_TOLERANCES = {"gradient_tolerance": "", "tolerance_rad": "rad", "tolerance_mm": "mm"}
"""Tolerances of :class:`Options` and their units."""


@dataclass(frozen=True)
class SolvePlan:
    """Everything static about a solve: method, belief about the offsets, data, unknowns.

    Attributes:
        method: as requested.
        prior: what the solve assumes about the offsets; with ``laws`` it is ``gaussian``.
        self_tuning: whether SDs are estimated.
        laws: weighed after the self-tuned Gaussian solve, which is the answer if there are none.
        channels: whether residuals are those of every element's time of flight, not of points.
        blocks: of unknowns (:mod:`jaxcal.model.unknowns`).
        options: as requested.
        robust: whether the images that agree are found first, and the others left out.
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
        return solver if is_optimistix(solver) else None

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
        prior_sd: prior SDs of the free unknowns that have one, in the units of the request
            (:func:`jaxcal.model.unknowns.with_prior`); None without a prior.
    """

    sigma: Float[AnyArray, " components"] | None
    tracker_sd: Float[AnyArray, ""] | None
    prior_sd: Float[AnyArray, " k"] | None


def is_one_of(value: object, names: Any) -> bool:
    """Whether a value is one of a Literal's names; comparing an array would give an array."""
    return isinstance(value, str) and value in get_args(names)


def is_optimistix(solver: Any) -> TypeGuard[optx.AbstractLeastSquaresSolver]:
    """Whether this is a least-squares solver of optimistix, without the slow import of it."""
    found = imported("optimistix")
    return found is not None and isinstance(solver, found.AbstractLeastSquaresSolver)


def _static(solver: optx.AbstractLeastSquaresSolver) -> optx.AbstractLeastSquaresSolver:
    """The solver with plain numbers as its settings, since a solver is part of the program.

    optimistix makes an array of some, such as the learning rate of its Gauss-Newton solver.
    """
    import jax

    def plain(leaf: Any) -> Any:
        scalar = isinstance(leaf, jax.Array | np.ndarray) and leaf.ndim == 0
        return leaf.item() if scalar and not is_traced(leaf) else leaf

    solver = jax.tree.map(plain, solver)
    try:
        hash(solver)
    except TypeError:
        raise InputError(
            f"the settings of {type(solver).__name__} must be plain numbers, not arrays"
        ) from None
    return solver


def check_size(name: str, value: Any, least: float, *, one: bool = True, unit: str = "mm") -> None:
    """Check one number, or several; of traced ones, that it is one."""
    numbers = np.array(np.nan)
    if not is_traced(value):
        with suppress(InputError):
            numbers = real_array(value, name)
        if not (np.isfinite(numbers).all() and (numbers >= least).all()):
            wanted = "positive" if least > 0 else "not negative"
            unit = f", in {unit}" if unit else ""
            raise InputError(f"{name} must be finite and {wanted}{unit}, not {shown(value)}")
    if one and np.shape(value) != ():
        raise InputError(f"{name} must be one number, not {shown(value)}")
