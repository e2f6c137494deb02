"""How three ways to one objective converge: joint, the alternation, and variable projection.

The objective is that of same_objective.py, sum |q_i - p_i(y_i)|^2 with |y_i| <= m, and so are the
problems (its first 200). Variable projection puts the offsets' closed form into the residual and
differentiates through it, so that X and c are the only unknowns left. (The joint solver, too, moves
the offsets to their optimum after every step, but its Gauss-Newton step leaves out how that optimum
bends: Kaufman's simplification, where ours here is Golub and Pereyra's full derivative.)

(a) From one conventional start: objective against iterations and against time, rate of convergence.
(b) Where each stops as its tolerance goes from 1e-1 to 1e-10. The tolerance of the alternation is X
    moving by less than t mm and t / 100 rad (t = 0.1: the paper's), that of the others the scaled
    gradient; variable projection scales it by its own, shorter columns.
(c) Where each stops from ten starts around the conventional one: X turned by up to 2 degrees about
    a random axis and shifted by up to 5 mm.

Times are batched and compiled, medians of three interleaved repeats. Seeds 20261120 (problems) and
20261122 (starts).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import same_objective as same
from common import arguments, machine, results_folder, write_table
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxcal.io.atomic import atomic_path
from jaxcal.metrics import reconstruction_precision
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
from jaxcal.uncertainty import assess

SEED = 20261122
CHUNK = 50
TEST_IMAGES = 50
TOLERANCES = tuple(10.0**-k for k in range(1, 11))
STEPS = 300
"""Most linearisations of the second-order arms, three times what jaxcal allows."""
ROUNDS = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 700, 1000, 1500, 2000,
          3000, 5000, 7000, 10_000)  # fmt: skip
ROUNDS_FROM_STARTS = 2000
FLOOR = 1e-14
"""Relative excess of the objective below which there is only rounding."""
SLACK = 1e-8
"""Relative excess at which an objective counts as reached."""

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
            return assess(
                parameters, offset, prior, problem, RIGID, whitened=False, uses_prior=True
            ).singular

        lane = (self.problems, parameters, self.bound)
        return np.asarray(same.chunked(one, *lane, chunk=CHUNK)(*lane)[0])


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


def apart(matrix: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """(..., 3) rotation vector (rad, about the image's axes) from the reference to X."""
    relative = np.swapaxes(reference[..., :3, :3], -1, -2) @ matrix[..., :3, :3]
    flat = Rotation.from_matrix(relative.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(*relative.shape[:-2], 3)


def excess_over(cost: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Relative excess of an objective, not below rounding."""
    return np.maximum(cost / best - 1, FLOOR)


def rates(steps: np.ndarray, costs: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Mean ratio of successive excess while it falls from 1e-4 to 1e-10 of the arm's own limit.

    Args:
        steps: (s,) iterations at which there are costs.
        costs: (s, problems) objectives.
        limit: (problems,) where each is going.

    Returns:
        (problems,) geometric means; NaN where the start is below 1e-10 already.
    """
    out = np.full(len(limit), np.nan)
    for k, excess in enumerate(excess_over(costs, limit).T):
        above, arrived = np.flatnonzero(excess > 1e-4), np.flatnonzero(excess <= 1e-10)
        first = above[-1] if above.size else 0
        last = arrived[0] if arrived.size else len(steps) - 1
        if last > first:
            out[k] = (excess[last] / excess[first]) ** (1 / (steps[last] - steps[first]))
    return out


def needed(steps: np.ndarray, costs: np.ndarray, best: np.ndarray) -> np.ndarray:
    """(problems,) first of the steps at which the best known objective is reached; inf: never."""
    reached = excess_over(costs, best) <= SLACK
    return np.where(reached.any(axis=0), steps[np.argmax(reached, axis=0)], np.inf)


def lane_iterations(iterations: np.ndarray) -> int:
    """Iterations computed: a chunk goes on until its slowest problem is done."""
    return int(CHUNK * iterations.reshape(-1, CHUNK).max(axis=1).sum())


def curve_rows(paths: dict, limits: dict, best: np.ndarray) -> list[list[object]]:
    """Table of part (a)'s curves: quantiles of the excess, median ratio of successive excess.

    The ratio is over the arm's own limit, of the problems still 1e-9 above theirs.
    """
    rows = []
    for name, (steps, costs) in paths.items():
        excess, own = excess_over(costs, best), excess_over(costs, limits[name])
        for k, step in enumerate(steps):
            last = max(k - 1, 0)
            alive = own[last] > 1e-9
            ratio = np.nan
            if k and alive.mean() >= 0.1:
                each = (own[k] / own[last]) ** (1 / (step - steps[last]))
                ratio = float(np.median(each[alive]))
            rows.append([name, int(step), *quantiles(excess[k]), ratio])
            if not (own[k] > 1e-9).any():
                break
    return rows


def sweep(bench: Bench, repeats: int) -> tuple[dict, dict, dict]:
    """Part (b): stops and seconds of every arm at every tolerance, and the tight fits."""
    stops: dict[tuple[str, float], Stops] = {}
    seconds: dict[tuple[str, float], list[float]] = {}
    tight: dict[str, Any] = {}
    for repeat in range(repeats):
        walk = Walk(bench, bench.starts)
        for tolerance in TOLERANCES:
            for name in ARMS:
                fit, took = bench.solve(name, bench.starts, tolerance)
                seconds.setdefault((name, tolerance), []).append(took)
                if repeat == 0:
                    stops[name, tolerance] = bench.judge_fit(fit, tolerance)
                    tight[name] = fit
            walk.to(tolerance, ROUNDS[-1])
            seconds.setdefault((ALTERNATION, tolerance), []).append(walk.seconds)
            if repeat == 0:
                stops[ALTERNATION, tolerance] = walk.judged(tolerance)
        fit, took = bench.three_starts(bench.starts)
        seconds.setdefault((THREE_STARTS, TOLERANCES[-1]), []).append(took)
        if repeat == 0:
            stops[THREE_STARTS, TOLERANCES[-1]] = bench.judge_fit(fit, TOLERANCES[-1])
            tight[THREE_STARTS], tight[ALTERNATION] = fit, walk
        print(f"tolerances: repeat {repeat + 1} of {repeats}", flush=True)
    return stops, {key: float(np.median(times)) for key, times in seconds.items()}, tight


def curves(bench: Bench, tight: dict) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Part (a): iterations (s,) and objectives (s, problems) of every arm from one start."""
    out = {}
    for name in ARMS:
        trace = np.array(tight[name].trace).T
        # The first entry is the start; after the last the arm stays where it stopped.
        final = np.broadcast_to(np.asarray(tight[name].cost), trace.shape)
        out[name] = (np.arange(STEPS), np.where(np.isfinite(trace), trace, final))
    begin = bench.judge(bench.starts, np.zeros(bench.count), np.zeros(bench.count, bool))
    walk, costs = Walk(bench, bench.starts), [begin.cost]
    for rounds in ROUNDS:
        costs.append(walk.to(TOLERANCES[-1], rounds).judged(TOLERANCES[-1]).cost)
    out[ALTERNATION] = (np.array([0, *ROUNDS]), np.array(costs))
    return out


def from_starts(bench: Bench, count: int) -> dict[tuple[str, str], list[Stops]]:
    """Part (c): stops of every arm, at its usual tolerance, from each of the starts."""
    out: dict[tuple[str, str], list[Stops]] = {}
    tightest = TOLERANCES[-1]
    for number in range(count):
        starts = turned_starts(bench, number)
        for name in ARMS:
            fit, _ = bench.solve(name, starts, tightest)
            stop = bench.judge_fit(fit, tightest)
            out.setdefault((name, f"{tightest:g}"), []).append(stop)
        fit, _ = bench.three_starts(starts)
        stop = bench.judge_fit(fit, tightest)
        out.setdefault((THREE_STARTS, f"{tightest:g}"), []).append(stop)
        walk = Walk(bench, starts).to(0.1, 1000)
        stop = walk.judged(0.1)
        out.setdefault((ALTERNATION, "the paper's"), []).append(stop)
        walk.to(tightest, ROUNDS_FROM_STARTS)
        label = f"{tightest:g} mm or {ROUNDS_FROM_STARTS} rounds"
        out.setdefault((ALTERNATION, label), []).append(walk.judged(tightest))
        print(f"starts: {number + 1} of {count}", flush=True)
    return out


def quantiles(values: np.ndarray) -> list[float]:
    """Median and 90th percentile over what is finite in ``values`` (NaN where nothing is)."""
    values = values[~np.isnan(values)]
    if not values.size:
        return [float("nan"), float("nan")]
    return [float(np.quantile(values, q, method="higher")) for q in (0.5, 0.9)]


def tolerance_rows(
    stops: dict, seconds: dict, best: tuple[np.ndarray, np.ndarray], groups: dict, flat: Stops
) -> list[list[object]]:
    """Table of part (b)."""
    rows = []
    for (name, tolerance), stop in stops.items():
        excess = excess_over(stop.cost, best[0])
        turn = 1e3 * apart(stop.matrix, best[1])[groups["isolated"]]
        ratio = stop.precision / flat.precision
        rows.append([
            name, tolerance, *quantiles(stop.iterations), int(stop.stopped.sum()),
            1e6 * seconds[name, tolerance] / len(excess), *quantiles(excess), float(excess.max()),
            int((excess <= SLACK).sum()), *quantiles(stop.kkt),
            *quantiles(np.linalg.norm(turn, axis=1)), *quantiles(np.abs(turn[:, 0])),
            float(stop.precision.mean()), float(np.exp(np.log(ratio).mean())),
            *(float(np.exp(np.log(ratio[groups[g]]).mean())) for g in ("tight", "loose")),
        ])  # fmt: skip
    return rows


TOLERANCE_HEADER = [
    "arm", "tolerance", "iterations_median", "iterations_p90", "stopped", "time_us_per_problem",
    "excess_median", "excess_p90", "excess_max", "reached_best", "kkt_median", "kkt_p90",
    "angle_median_mrad", "angle_p90_mrad", "about_lateral_median_mrad", "about_lateral_p90_mrad",
    "rp_mean_mm", "rp_over_conventional", "rp_over_conventional_bound_below_offsets",
    "rp_over_conventional_bound_above_offsets",
]  # fmt: skip


def start_rows(
    stops: dict, best: tuple[np.ndarray, np.ndarray], groups: dict
) -> list[list[object]]:
    """Table of part (c): spread over the starts, then quantiles over the problems."""
    rows = []
    for (name, tolerance), runs in stops.items():
        cost = np.array([run.cost for run in runs])
        matrix = np.array([run.matrix for run in runs])
        turn = 1e3 * apart(matrix, best[1])
        spread = turn.std(axis=0, ddof=1)
        shift = np.linalg.norm(matrix[..., :3, 3].std(axis=0, ddof=1), axis=-1)
        precision = np.array([run.precision for run in runs]).std(axis=0, ddof=1)
        excess = excess_over(cost, best[0])
        width = np.maximum(np.ptp(cost, axis=0) / best[0], FLOOR)
        for group in ("isolated", "interval"):
            chosen = groups[group]
            if not chosen.any():
                continue
            rows.append([
                name, tolerance, group, int(chosen.sum()), len(runs),
                *(value for axis in range(3) for value in quantiles(spread[chosen, axis])),
                *quantiles(shift[chosen]), *quantiles(width[chosen]), float(width[chosen].max()),
                int((excess[:, chosen] <= SLACK).all(axis=0).sum()),
                float((excess[:, chosen] > SLACK).mean()), *quantiles(precision[chosen]),
            ])  # fmt: skip
    return rows


START_HEADER = [
    "arm", "tolerance", "minimiser", "problems", "starts",
    *(f"sd_about_{axis}_{q}_mrad" for axis in ("lateral", "elevational", "axial")
      for q in ("median", "p90")),
    "sd_translation_median_mm", "sd_translation_p90_mm", "objective_range_median",
    "objective_range_p90", "objective_range_max", "best_from_every_start", "solves_above_best",
    "sd_rp_median_mm", "sd_rp_p90_mm",
]  # fmt: skip


def main() -> None:
    quick = arguments(__doc__ or "").quick
    count, starts, repeats = (50, 3, 1) if quick else (200, 10, 3)
    bench = Bench(count)
    print("compiled", flush=True)
    stops, seconds, tight = sweep(bench, repeats)
    paths = curves(bench, tight)
    around = from_starts(bench, starts)

    ends = {name: fit.here if name == ALTERNATION else fit.parameters
            for name, fit in tight.items()}  # fmt: skip
    limits, found = {}, []
    for name, parameters in ends.items():
        fit, _ = bench.solve("joint", parameters, TOLERANCES[-1])
        polished = bench.judge_fit(fit, TOLERANCES[-1])
        limits[name] = np.minimum(polished.cost, stops[name, TOLERANCES[-1]].cost)
        found += [polished, stops[name, TOLERANCES[-1]]]
    found += [run for runs in around.values() for run in runs]
    costs = np.array([stop.cost for stop in found])
    which = np.nanargmin(costs, axis=0)
    lanes = np.arange(count)
    best = (costs[which, lanes], np.array([stop.matrix for stop in found])[which, lanes])

    interval = bench.has_interval(tight[THREE_STARTS].parameters)
    loose = bench.bounds >= bench.settings[:, 0]
    groups = {"isolated": ~interval, "interval": interval, "tight": ~loose, "loose": loose}
    flat = bench.judge(bench.starts, np.zeros(count), np.zeros(count, bool))

    rows: list[list[object]] = []
    for name in (ALTERNATION, *ARMS, THREE_STARTS):
        stop = stops[name, TOLERANCES[-1]]
        excess = excess_over(stop.cost, best[0])
        rate, reach = np.full(count, np.nan), np.full(count, np.nan)
        if name in paths:
            rate, reach = rates(*paths[name], limits[name]), needed(*paths[name], best[0])
        took = seconds[name, TOLERANCES[-1]]
        # The iterations of three starts are those of all of them together.
        per_iteration = took / lane_iterations(stop.iterations) if name in paths else np.nan
        rows.append([
            name, *quantiles(stop.iterations), int(stop.iterations.max()),
            int(stop.stopped.sum()), 1e6 * took / count, 1e6 * per_iteration,
            int((excess <= SLACK).sum()), float(excess.max()),
            *quantiles(reach), *quantiles(rate), int((rate > 0.9).sum()),
        ])  # fmt: skip
    header = [
        "arm", "iterations_median", "iterations_p90", "iterations_max", "stopped",
        "time_us_per_problem", "time_us_per_iteration", "reached_best", "excess_max",
        "iterations_to_best_median", "iterations_to_best_p90", "rate_median", "rate_p90",
        "rate_above_0.9",
    ]  # fmt: skip
    folder = results_folder(quick)
    foot: list[list[object]] = [
        [
            f"{count} problems, {interval.sum()} with an interval of minimisers; {machine()}; "
            f"load average {os.getloadavg()[2]:.1f} over the last 15 minutes"
        ]
    ]
    write_table(folder / "same_objective_convergence.csv", header, rows + foot)
    by_iteration = curve_rows(paths, limits, best[0])
    write_table(
        folder / "same_objective_convergence_curves.csv",
        ["arm", "iteration", "excess_median", "excess_p90", "ratio_median"],
        by_iteration,
    )
    by_tolerance = tolerance_rows(stops, seconds, best, groups, flat)
    write_table(folder / "same_objective_convergence_tolerance.csv", TOLERANCE_HEADER, by_tolerance)
    by_start = start_rows(around, best, groups)
    write_table(folder / "same_objective_convergence_starts.csv", START_HEADER, by_start)
    for names, lines in (
        (header, rows), (TOLERANCE_HEADER, by_tolerance), (START_HEADER, by_start)
    ):  # fmt: skip
        for line in lines:
            print(", ".join(f"{n} {v:.3g}" if isinstance(v, float) else f"{n} {v}"
                            for n, v in zip(names, line, strict=True)))  # fmt: skip
    print(foot[0][0])
    plot(folder / "same_objective_convergence.png", by_iteration, by_tolerance, by_start)


def plot(path: Path, by_iteration: list, by_tolerance: list, by_start: list) -> None:
    """Excess against iterations and time, rates; stops against tolerance; spread over starts."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 8.5), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    for name in dict.fromkeys(row[0] for row in by_iteration):
        lines = np.array([row[1:] for row in by_iteration if row[0] == name], dtype=float)
        step, middle, high, ratio = lines.T
        panels[0].plot(step + 1, middle, color=COLORS[name], label=name)
        panels[0].plot(step + 1, high, "--", color=COLORS[name])
        panels[2].plot(step, ratio, ".-", color=COLORS[name], label=name)

    def column(name: str, header: str) -> np.ndarray:
        place = TOLERANCE_HEADER.index(header)
        return np.array([row[place] for row in by_tolerance if row[0] == name], dtype=float)

    for name, color in COLORS.items():
        style = "*" if name == THREE_STARTS else ".-"
        size = 12 if name == THREE_STARTS else 6
        seconds = 1e-6 * column(name, "time_us_per_problem")
        draw = {"color": color, "markersize": size, "label": name}
        panels[1].plot(seconds, column(name, "excess_median"), style, **draw)
        panels[1].plot(seconds, column(name, "excess_p90"), style + "-", color=color, alpha=0.4)
        tolerance = column(name, "tolerance")
        panels[3].plot(tolerance, column(name, "about_lateral_median_mrad"), style, **draw)
        panels[3].plot(tolerance, column(name, "about_lateral_p90_mrad"), style + "-", color=color,
                       alpha=0.4)  # fmt: skip
        panels[4].plot(tolerance, column(name, "rp_over_conventional"), style, **draw)
    chosen = [row for row in by_start if row[2] == "isolated"]
    place = START_HEADER.index("sd_about_lateral_median_mrad")
    labels = [f"{row[0]}\n{row[1]}" for row in chosen]
    panels[5].barh(labels, [max(row[place + 1], 1e-7) for row in chosen], color="0.8",
                   label="90th percentile")  # fmt: skip
    panels[5].barh(labels, [max(row[place], 1e-7) for row in chosen], height=0.4,
                   label="median over problems")  # fmt: skip
    panels[5].set(xscale="log", xlabel="SD of X's rotation about the lateral axis (mrad)",
                  title="(c) spread over the starts")  # fmt: skip
    panels[5].tick_params(axis="y", labelsize=7)
    panels[5].legend(fontsize="small")
    panels[0].set(xscale="log", yscale="log", xlabel="1 + iterations, or rounds",
                  ylabel="objective above the best known (relative)",
                  title="(a) median (full), 90th percentile (dashed)")  # fmt: skip
    panels[1].set(xscale="log", yscale="log", xlabel="time a problem, batched (s)",
                  ylabel="objective above the best known (relative)",
                  title="(a) at the tolerances 1e-1 to 1e-10; pale: 90th percentile")  # fmt: skip
    panels[2].set(xscale="log", xlabel="iteration, or round", ylim=(0, 1.05),
                  ylabel="ratio of successive excess, median",
                  title="(a) rate, over each arm's own limit")  # fmt: skip
    panels[3].set(xscale="log", yscale="log", xlabel="tolerance (mm; or scaled gradient)",
                  ylabel="rotation about the lateral axis off the optimum (mrad)",
                  title="(b) isolated minimisers; pale: 90th percentile")  # fmt: skip
    panels[4].set(xscale="log", xlabel="tolerance (mm; or scaled gradient)",
                  ylabel="RP over conventional's, geometric mean",
                  title="(b) precision")  # fmt: skip
    for panel in panels[3:5]:
        panel.invert_xaxis()
    for panel in panels[:5]:
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize="small")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


if __name__ == "__main__":
    main()
