"""The arms of same_objective_convergence.py as compiled programs, and where each of them stops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import same_objective as same
from jaxtyping import Array, Float

from jaxcal.diagnostics.metrics import reconstruction_precision
from jaxcal.model.parameters import RIGID, Parameters, retract
from jaxcal.model.priors import AbstractPrior, Bounded
from jaxcal.model.residuals import circle_residual
from jaxcal.problem import Problem
from jaxcal.simulation import Protocol, simulate
from jaxcal.solvers import arrow as arrows
from jaxcal.solvers.alternating import alternate
from jaxcal.solvers.conventional import from_scratch
from jaxcal.solvers.joint import joint
from jaxcal.solvers.least_squares import linearise, minimise

SEED = 20261122
CHUNK = 50
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


class Eliminated(AbstractPrior):
    """The bounded objective as a function of X and c alone: offsets in closed form.

    Attributes:
        bound: (n,) m_i, mm.
    """

    bound: Float[Array, " n"]

    def residual(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, "n 3"]:
        """q_i - p_i(y_i) at the closest point of the arc, which moves with the parameters."""
        return circle_residual(parameters, self.elevation(parameters, offset, problem), problem)

    def elevation(
        self, parameters: Parameters, offset: Float[Array, " k"], problem: Problem
    ) -> Float[Array, " n"]:
        """The optimal offsets, mm."""
        return Bounded(self.bound).start(parameters, problem)


ARMS: dict[str, tuple[Callable[[Array], AbstractPrior], bool]] = {
    "joint": (Bounded, True),
    "joint, Gauss-Newton only": (Bounded, False),
    "variable projection": (Eliminated, False),
    "variable projection, exact": (Eliminated, True),
}
"""Each second-order arm's objective, and whether it takes exact second derivatives."""


class Outcome(NamedTuple):
    """What is kept of a fit (lax.map cannot chunk the empty offsets of variable projection)."""

    parameters: Parameters
    cost: Array
    stationarity: Array
    iterations: Array
    trace: Array | None


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
        begin = same.chunked(
            lambda problem: from_scratch(problem, RIGID).fit.parameters, self.problems, chunk=CHUNK
        )
        self.starts, _ = begin(self.problems)
        lane = (self.problems, self.starts, self.bound)
        self._solve = {
            name: same.chunked(_arm(*arm), *lane, jnp.ones(count), chunk=CHUNK)
            for name, arm in ARMS.items()
        }
        steps = jnp.ones(count, jnp.int32)
        self._alternate = same.chunked(
            _alternation, *lane, jnp.ones(count), jnp.ones(count), steps, chunk=CHUNK
        )
        self._three = same.chunked(
            lambda p, start, bound: joint(start, Bounded(bound), p, RIGID), *lane, chunk=CHUNK
        )
        self._judge = same.chunked(_judgement, *lane, *self.tests, chunk=CHUNK)

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

        def one(problem: Problem, parameters: Parameters, bound: Array) -> Array:
            prior = Bounded(bound)
            offset = prior.start(parameters, problem)
            return same.information_of(problem, parameters, offset, bound)

        lane = (self.problems, parameters, self.bound)
        information, _ = same.chunked(one, *lane, chunk=CHUNK)(*lane)
        return same.spectra(np.asarray(information), self.problems)[0]


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


def _arm(make: Callable[[Array], AbstractPrior], exact: bool) -> Callable:
    def solve(problem: Problem, start: Parameters, bound: Array, tolerance: Array) -> Outcome:
        fit = minimise(
            start, make(bound), problem, RIGID, tolerance=tolerance, max_steps=STEPS, exact=exact,
            trace=STEPS,
        )  # fmt: skip
        return Outcome(fit.parameters, fit.cost, fit.stationarity, fit.iterations, fit.trace)

    return solve


def _alternation(
    problem: Problem, start: Parameters, bound: Array, radians: Array, millimetres: Array,
    rounds: Array,
):  # fmt: skip
    return alternate(
        start, Bounded(bound), problem, RIGID, tolerance_rad=radians,  # pyright: ignore[reportArgumentType]
        tolerance_mm=millimetres, max_rounds=rounds,  # pyright: ignore[reportArgumentType]
    )  # fmt: skip


def _judgement(problem: Problem, parameters: Parameters, bound: Array, poses: Array, points: Array):
    prior = Bounded(bound)
    offset = prior.start(parameters, problem)
    arrow, _, _ = linearise(parameters, offset, prior, problem, RIGID)
    matrix = parameters.matrix()
    precision = reconstruction_precision(matrix, poses, points)
    return arrow.cost, arrows.stationarity(arrow), precision, matrix


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
