"""The arms of same_objective_convergence.py as compiled programs, and where each of them stops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import same_objective as same
from jaxtyping import Array, Float

from jaxcal import Problem, reconstruction_precision
from jaxcal.backend import (
    RIGID,
    BoundedOffsets,
    Component,
    FurtherUnknowns,
    ImagePlanes,
    Iterate,
    NormalEquations,
    Observation,
    Parameters,
    accumulate,
    retract,
)
from jaxcal.model.observations import on_circle
from jaxcal.solvers.alternating import bounded
from jaxcal.solvers.levenberg_marquardt import (
    DAMPING_DECREASE,
    EXACT_BELOW,
    Descent,
    Minimum,
    Rounding,
    gradient_cosine,
    iterate_once,
)
from jaxcal.study.simulation import Protocol, simulate

SEED = 20261122
CHUNK = same.CHUNK
TEST_IMAGES = 50
TOLERANCES = tuple(10.0**-k for k in range(1, 11))
STEPS = 300
"""Most linearisations of the second-order arms, three times what jaxcal allows."""
ROUNDS = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 700, 1000, 1500, 2000,
          3000, 5000, 7000, 10_000)  # fmt: skip
ROUNDS_FROM_STARTS = 2000

ALTERNATION, THREE_STARTS = "alternation", "joint, three starts (jaxcal)"
COLORS = {
    ALTERNATION: "tab:blue", "joint": "tab:orange", "joint, Gauss-Newton only": "tab:red",
    "variable projection": "tab:green", "variable projection, exact": "tab:purple",
    THREE_STARTS: "black",
}  # fmt: skip


class Eliminated(Observation):
    """The bounded objective as a function of X and c alone: offsets in closed form.

    Its derivatives know how the closest point of the arc moves with X and c.

    Attributes:
        sigma: one.
        bounds: the same with offsets that are unknowns of their own.
    """

    sigma: Float[Array, "1 batch"]
    bounds: BoundedOffsets
    whitened: ClassVar[bool] = False

    def components(self, q: list, further: FurtherUnknowns, images: ImagePlanes) -> list[Component]:
        """q_i - p_i(y_i) at the closest point of the arc."""
        offset, _ = self.bounds.local(q, further, images)
        return [Component(on_circle(q, offset, further, images))]


def with_offsets(bound: Array, images: ImagePlanes) -> Observation:
    """Every offset an unknown of its own."""
    return BoundedOffsets.of(bound, images)


def without_offsets(bound: Array, images: ImagePlanes) -> Observation:
    """Variable projection."""
    bounds = BoundedOffsets.of(bound, images)
    return Eliminated(bounds.sigma, bounds)


ARMS: dict[str, tuple[Callable[[Array, ImagePlanes], Observation], bool]] = {
    "joint": (with_offsets, True),
    "joint, Gauss-Newton only": (with_offsets, False),
    "variable projection": (without_offsets, False),
    "variable projection, exact": (without_offsets, True),
}
"""Each second-order arm's objective, and whether it takes exact second derivatives."""


class Outcome(NamedTuple):
    """What is kept of a fit, with leading axes."""

    parameters: Parameters
    cost: Array
    stationarity: Array
    iterations: Array
    trace: Array | None = None

    @classmethod
    def of(cls, fit: Descent | Minimum) -> Outcome:
        """Of a batch of fits."""
        trace = None if fit.trace is None else fit.trace.T
        return cls(fit.iterate.parameters(), fit.cost, fit.cosine, fit.iterations, trace)


class Moved(NamedTuple):
    """What is kept of the alternation, with leading axes."""

    parameters: Parameters
    iterations: Array
    rotation_change: Array
    translation_change: Array


@dataclass(frozen=True)
class Stops:
    """Where an arm stopped on every problem, judged alike for all arms.

    Attributes:
        cost: objective with optimal offsets, mm^2. kkt: scaled KKT residual of the bounded problem.
        precision: RP on the test images, mm. matrix: X.
        iterations: linearisations or rounds. stopped: by its own tolerance.
    """

    cost: np.ndarray
    kkt: np.ndarray
    precision: np.ndarray
    matrix: np.ndarray
    iterations: np.ndarray
    stopped: np.ndarray


class Bench:
    """The problems, and every arm as a compiled program over all of them."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.problems, self.settings, self.bounds = same.draw(count)
        self.bound = jnp.asarray(self.bounds)[:, None] * jnp.ones(same.IMAGES)
        self.tests = tests_of(self.problems, self.settings)
        self.starts = same.conventional_starts(self.problems)
        begun = (self.problems, self.starts, self.bound)
        self._solve = {
            name: same.chunked(_arm(*arm), *begun, jnp.ones(count)) for name, arm in ARMS.items()
        }
        steps = jnp.ones(count, jnp.int32)
        self._alternate = same.chunked(
            _alternation, *begun, jnp.ones(count), jnp.ones(count), steps
        )
        self._three = same.chunked(_three_starts, *begun)
        self._judge = same.chunked(_judgement, *begun, *self.tests)

    def solve(self, name: str, starts: Parameters, tolerance: float) -> tuple[Any, float]:
        """A second-order arm's fits from the starts, and the seconds that they took."""
        tolerances = jnp.full(self.count, tolerance)
        return self._solve[name](self.problems, starts, self.bound, tolerances)

    def three_starts(self, starts: Parameters) -> tuple[Any, float]:
        """The fits of jaxcal's own ``joint``, and seconds."""
        return self._three(self.problems, starts, self.bound)

    def advance(self, here: Parameters, tolerance: float, rounds: np.ndarray) -> tuple[Any, float]:
        """The alternation from where it is, for at most so many rounds; and seconds."""
        millimetres = jnp.full(self.count, tolerance)
        most = jnp.asarray(rounds, jnp.int32)
        return self._alternate(
            self.problems, here, self.bound, millimetres / 100, millimetres, most
        )

    def judge(self, parameters: Parameters, iterations, stopped) -> Stops:
        """Measure a set of stops."""
        measured, _ = self._judge(self.problems, parameters, self.bound, *self.tests)
        cost, kkt, precision, matrix = map(np.asarray, measured)
        return Stops(cost, kkt, precision, matrix, np.asarray(iterations), np.asarray(stopped))

    def judge_fit(self, fit: Any, tolerance: float) -> Stops:
        """Measure the stops of a second-order arm."""
        return self.judge(fit.parameters, fit.iterations, fit.stationarity <= tolerance)

    def has_interval(self, parameters: Parameters) -> np.ndarray:
        """Whether the objective is flat along a direction there, to rounding."""

        def information(problems: Problem, parameters: Parameters, bound: Array) -> Array:
            return jnp.moveaxis(_normal(problems, parameters, bound)[0].stacked(), -1, 0)

        at = (self.problems, parameters, self.bound)
        found, _ = same.chunked(information, *at)(*at)
        return same.spectra(np.asarray(found), self.problems)[0]


class Walk:
    """The alternation continued from stop to stop, which its state, X and c alone, allows."""

    def __init__(self, bench: Bench, starts: Parameters) -> None:
        self.bench, self.here, self.seconds = bench, starts, 0.0
        self.rounds = np.zeros(bench.count, int)
        self.change = np.full((2, bench.count), np.inf)

    def stopped(self, tolerance: float) -> np.ndarray:
        """Whether the last round moved X by less than the tolerance (mm; rad: a hundredth)."""
        return (self.change[0] < tolerance / 100) & (self.change[1] < tolerance)

    def to(self, tolerance: float, most: int) -> Walk:
        """Go on to the tolerance, or to so many rounds in all."""
        left = np.where(self.stopped(tolerance), 0, np.maximum(most - self.rounds, 0))
        state, took = self.bench.advance(self.here, tolerance, left)
        change = np.stack([state.rotation_change, state.translation_change])
        self.change = np.where(left > 0, change, self.change)
        self.here, self.seconds = state.parameters, self.seconds + took
        self.rounds = self.rounds + np.asarray(state.iterations)
        return self

    def judged(self, tolerance: float) -> Stops:
        """Measure where it is."""
        return self.bench.judge(self.here, self.rounds, self.stopped(tolerance))


def _arm(make: Callable[[Array, ImagePlanes], Observation], exact: bool) -> Callable:
    def solve(problems: Problem, starts: Parameters, bound: Array, tolerance: Any) -> Outcome:
        """As :func:`jaxcal.backend.minimise`, which always is exact near the optimum."""
        images = ImagePlanes.of(problems)
        observation, place = make(bound, images), Iterate.of(starts, RIGID)
        images = images.padded()
        observation = observation.padded(images)
        rounding = Rounding.of(place, observation, images)

        def equations(iterate: Iterate, newton: Array) -> NormalEquations:
            return accumulate(iterate, observation, images, newton if exact else None)

        def one(state: Descent) -> Descent:
            return iterate_once(
                state,
                equations,
                rounding,
                tolerance,
                STEPS,
                decrease_exact=DAMPING_DECREASE,
                exact_below=EXACT_BELOW if exact else 0.0,
            )

        number = jnp.zeros_like(images.mask[:, 0])
        begun = Descent.first(place, number, 1e-3, STEPS, exact_next=number)
        return Outcome.of(jax.lax.while_loop(lambda state: jnp.any(state.active), one, begun))

    return solve


def _three_starts(problems: Problem, starts: Parameters, bound: Array) -> Outcome:
    images = ImagePlanes.of(problems)
    return Outcome.of(bounded(Iterate.of(starts, RIGID), BoundedOffsets.of(bound, images), images))


def _alternation(
    problems: Problem,
    starts: Parameters,
    bound: Array,
    radians: Array,
    millimetres: Array,
    rounds: Array,
) -> Moved:
    done = same.advance(problems, starts, bound, radians, millimetres, rounds)
    return Moved(
        done.iterate.parameters(), done.iterations, done.rotation_change, done.translation_change
    )


def _normal(
    problems: Problem, parameters: Parameters, bound: Array
) -> tuple[NormalEquations, Float[Array, " batch"]]:
    """Normal equations of the bounded problem, offsets eliminated; the cost that is rounding."""
    images = ImagePlanes.of(problems)
    place, observation = Iterate.of(parameters, RIGID), BoundedOffsets.of(bound, images)
    rounding = Rounding.of(place, observation, images)
    return accumulate(place, observation, images, None), rounding.vanished


def _judgement(
    problems: Problem, parameters: Parameters, bound: Array, poses: Array, points: Array
) -> tuple[Array, Array, Array, Array]:
    normal, vanished = _normal(problems, parameters, bound)
    matrix = jax.vmap(Parameters.matrix)(parameters)
    precision = jnp.asarray(jax.vmap(reconstruction_precision)(matrix, poses, points))
    return normal.cost, gradient_cosine(normal, vanished), precision, matrix


def tests_of(problems: Problem, settings: np.ndarray) -> tuple[Array, Array]:
    """Test poses and points of the same experiments (same.draw keeps only what is calibrated on).

    Raises:
        RuntimeError: if the experiments are not the same.
    """
    root = jax.random.key(same.SEED)
    protocol = Protocol(images=same.IMAGES, test_images=TEST_IMAGES)

    @jax.jit
    @jax.vmap
    def draw(index: Array, setting: Array):
        drawn = replace(protocol, elevation_mm=setting[0], noise_mm=setting[1])
        return simulate(jax.random.fold_in(root, index), drawn)

    made = draw(jnp.arange(len(settings)), jnp.asarray(settings))
    if not np.allclose(made.points, problems.measurements, rtol=0, atol=1e-9):
        raise RuntimeError("the test images are not of the problems' experiments")
    return made.test_poses, made.test_points


def turned_starts(bench: Bench, number: int) -> Parameters:
    """The conventional starts, each X turned and shifted at random; the target stays."""
    draw = np.random.default_rng([SEED, number])
    direction = draw.normal(size=(2, bench.count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    size = draw.uniform(size=(2, bench.count, 1)) * [[[5.0]], [[np.radians(2.0)]]]
    shift, turn = size * direction
    tangents = jnp.asarray(np.concatenate([shift, turn], axis=1))
    blocks = ("translation", "rotation")
    return jax.jit(jax.vmap(lambda start, tangent: retract(start, tangent, blocks)))(
        bench.starts, tangents
    )
