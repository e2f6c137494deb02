"""Joint `bounded` and the alternation on one objective: sum |q_i - p_i(y_i)|^2, |y_i| <= m.

1,000 simulated problems (n = 50; offsets, noise and bound drawn at random) are solved from the same
conventional start by ``calibrate_batch`` (prior ``bounded``) and by the alternation run until X
moves by less than 1e-10; 50 of them by scipy's bounded trust region as well. Reported: the
objectives reached, the scaled KKT residual, iterations and rounds, and the time that both take to
the same objective: of ``calibrate_batch`` all, the conventional fit and the covariance included; of
the alternation its rounds alone. Seed 20261120.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, machine, save_figure, write_table
from jaxtyping import Array

from jaxcal import Calibration, Problem, calibrate_batch
from jaxcal.backend import (
    RIGID,
    BoundedOffsets,
    ImagePlanes,
    Iterate,
    Parameters,
    circle_residual,
    retract,
)
from jaxcal.data.poses import rotation_angle
from jaxcal.diagnostics.uncertainty import mm_at_target, spectrum, threshold
from jaxcal.model.observations import local_unknowns
from jaxcal.runtime.compiler import fast_to_run
from jaxcal.solvers.alternating import Alternation, alternate
from jaxcal.study.simulation import Protocol, simulate

SEED = 20261120
IMAGES = 50
ELEVATIONS = (0.5, 1.0, 2.0, 3.0, 5.0)
NOISES = (0.05, 0.5, 2.0, 4.0, 10.0)
BOUNDS = (0.25, 0.5, 1.0, 2.0, 4.0)
ROUNDS = (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000)
TOLERANCE = 1e-10
CHUNK = 50
"""Problems side by side; their number is a multiple of it."""
OBSERVABLE = 1e6
"""Condition number (scaled units) up to which X is compared with scipy's: beyond it the objective
is flat to rounding along one direction, and where in the valley a solver stops means nothing."""


class Segment(NamedTuple):
    """Where the alternation is, with leading axes."""

    parameters: Parameters
    cost: Array
    tolerance_met: Array


def draw(count: int) -> tuple[Problem, np.ndarray, np.ndarray]:
    """``count`` problems, and for each its (elevation, noise) mm and its bound, mm."""
    choice = np.random.default_rng(SEED).integers(0, 5, size=(count, 3))
    root = jax.random.key(SEED)
    problems, settings = [], []
    makers: dict = {}
    for i, j, _ in choice:
        if (i, j) not in makers:
            protocol = Protocol(
                images=IMAGES, elevation_mm=ELEVATIONS[i], noise_mm=NOISES[j], test_images=2
            )
            makers[i, j] = protocol
        settings.append((ELEVATIONS[i], NOISES[j]))
    for (i, j), protocol in makers.items():
        rows = np.flatnonzero((choice[:, 0] == i) & (choice[:, 1] == j))
        keys = jax.vmap(lambda k: jax.random.fold_in(root, k))(jnp.asarray(rows))
        made = jax.jit(jax.vmap(lambda k, p=protocol: simulate(k, p).problem()))(keys)
        problems.append((rows, made))
    order = np.argsort(np.concatenate([rows for rows, _ in problems]))
    together = jax.tree.map(
        lambda *leaves: jnp.concatenate(leaves)[order], *[made for _, made in problems]
    )
    return together, np.array(settings), np.array([BOUNDS[k] for k in choice[:, 2]])


def parameters_of(answer: Calibration) -> Parameters:
    """X and the targets of calibrations."""
    x = jnp.asarray(answer.image_to_probe)
    return jax.vmap(Parameters.of)(x[:, :3, :3], x[:, :3, 3], jnp.asarray(answer.point))


def conventional_starts(problems: Problem) -> Parameters:
    """The conventional fits, where every method begins."""
    return parameters_of(calibrate_batch(problems, "conventional"))


def spectra(information: np.ndarray, problems: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Whether each information matrix is singular, and its condition, all unknowns in mm."""
    lever = np.sqrt(np.mean(np.sum(np.asarray(problems.measurements) ** 2, axis=2), axis=1))
    scale, eps = mm_at_target(lever, RIGID), float(np.finfo(float).eps)
    values, _ = spectrum(information / (scale[:, :, None] * scale[:, None]))
    smallest, largest = values[:, 0], values[:, -1]
    singular = smallest < threshold(eps) * values.sum(axis=1)
    return singular, largest / np.maximum(smallest, eps * largest)


def closest_offsets(parameters: Parameters, problems: Problem, bound: Array) -> Array:
    """The best offsets within their bounds for given X and targets, mm (problems first)."""
    images = ImagePlanes.of(problems)
    place = Iterate.of(parameters, RIGID)
    return local_unknowns(place, BoundedOffsets.of(bound, images), images)


def advance(
    problems: Problem,
    starts: Parameters,
    bound: Array,
    tolerance_rad: Any,
    tolerance_mm: Any,
    rounds: Array,
) -> Alternation:
    """The alternation from where X and the targets are, for at most so many rounds each."""
    images = ImagePlanes.of(problems)
    return alternate(
        Iterate.of(starts, RIGID),
        BoundedOffsets.of(bound, images),
        images,
        tolerance_rad=tolerance_rad,
        tolerance_mm=tolerance_mm,
        max_rounds=rounds,
        inner_steps=2,
    )


def chunked(function, *arguments):
    """A function of batches compiled for chunks of them: all leading axes count problems."""

    def pieces(tree):
        return jax.tree.map(lambda leaf: leaf.reshape(-1, CHUNK, *leaf.shape[1:]), tree)

    @jax.jit
    def run(*arguments):
        found = jax.lax.map(lambda chunk: function(*chunk), pieces(arguments))
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)

    compiled = run.lower(*arguments).compile(compiler_options=fast_to_run(jax.default_backend()))

    def timed(*arguments):
        began = time.perf_counter()
        result = jax.block_until_ready(compiled(*arguments))
        return result, time.perf_counter() - began

    return timed


def scipy_solution(problem: Problem, start: Parameters, offset: np.ndarray, bound: float):
    """scipy.optimize.least_squares (trf, bounds) on X's tangent, c and every y."""
    from scipy.optimize import least_squares

    @jax.jit
    def residual(unknowns: Array) -> Array:
        parameters = retract(start, unknowns[:9], RIGID)
        return circle_residual(parameters, unknowns[9:], problem).ravel()

    jacobian = jax.jit(jax.jacfwd(residual))

    def jac(unknowns: np.ndarray) -> np.ndarray:
        return np.asarray(jacobian(jnp.asarray(unknowns)))

    first = np.concatenate([np.zeros(9), 0.999 * offset])
    limit = np.concatenate([np.full(9, np.inf), np.full(IMAGES, bound)])
    fit = least_squares(
        lambda u: np.asarray(residual(jnp.asarray(u))), first,
        jac=jac,  # pyright: ignore[reportArgumentType]
        bounds=(-limit, limit), method="trf", x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15,
        max_nfev=3000,
    )  # fmt: skip
    return 2 * fit.cost, retract(start, jnp.asarray(fit.x[:9]), RIGID).matrix()


def main() -> None:
    quick, folder = arguments(__doc__)
    count, compared = (100, 10) if quick else (1000, 50)
    problems, settings, bounds = draw(count)
    per_image = jnp.asarray(bounds)[:, None] * jnp.ones(IMAGES)

    starts = conventional_starts(problems)

    def solve() -> tuple[Calibration, float]:
        began = time.perf_counter()
        found = calibrate_batch(problems, prior="bounded", max_elevation=per_image)
        return jax.block_until_ready(found), time.perf_counter() - began

    fit, _ = solve()
    joint_times = [solve()[1] for _ in range(3)]
    singular, condition = spectra(np.asarray(fit.linearisation.information), problems)

    def segment(problems: Problem, starts: Parameters, bound: Array, rounds: Array) -> Segment:
        done = advance(problems, starts, bound, TOLERANCE, TOLERANCE, rounds)
        return Segment(done.iterate.parameters(), done.cost, done.converged)

    taken = jnp.zeros(count, jnp.int32)
    go_on = chunked(segment, problems, starts, per_image, taken)
    here, done, seconds = starts, 0, 0.0
    costs, elapsed, finished = [], [], np.zeros(count, bool)
    for rounds in ROUNDS:
        # The state of the alternation is X and c alone, so it can be continued segment by segment.
        steps = np.where(finished, 0, rounds - done)
        state, took = go_on(problems, here, per_image, jnp.asarray(steps, jnp.int32))
        here, done, seconds = state.parameters, rounds, seconds + took
        finished |= np.asarray(state.tolerance_met)
        costs.append(np.asarray(state.cost))
        elapsed.append(seconds)
        print(f"alternation: {rounds} rounds, {finished.sum()} of {count} stopped, {seconds:.1f} s")
    costs = np.array(costs)

    ended = fit.convergence
    joint_cost = np.asarray(ended.cost)
    squares = np.asarray(jnp.sum(problems.measurements**2, axis=(1, 2)))
    allowed = costs[-1] * (1 + 1e-8) + 1e-12 * squares
    worse = joint_cost > allowed
    better = joint_cost < costs[-1] * (1 - 1e-8) - 1e-12 * squares
    reached = costs <= joint_cost * (1 + 1e-8) + 1e-12 * squares
    rounds_needed = np.array([ROUNDS[np.argmax(r)] if r.any() else -1 for r in reached.T])

    offsets = np.asarray(closest_offsets(starts, problems, per_image))
    peers = []
    for index in np.linspace(0, count - 1, compared).astype(int):
        pick = jax.tree.map(lambda leaf, i=index: leaf[i], (problems, starts))
        cost, matrix = scipy_solution(pick[0], pick[1], offsets[index], float(bounds[index]))
        slack = 1e-8 * cost + 1e-12 * squares[index]
        lower = bool(joint_cost[index] > cost + slack)
        higher = bool(joint_cost[index] < cost - slack)
        observable = bool(not singular[index] and condition[index] < OBSERVABLE)
        angle = float(rotation_angle(np.asarray(matrix), np.asarray(fit.image_to_probe[index])))
        peers.append([int(index), float(joint_cost[index]), cost, lower, higher,
                      float(condition[index]), observable, angle])  # fmt: skip
    # Where scipy ends in another, higher minimum there is no X to compare.
    angles = [peer[-1] for peer in peers if peer[6] and not peer[4]]

    write_table(
        folder / "same_objective.csv",
        ["problem", "elevation_mm", "noise_mm", "bound_mm", "joint_cost_mm2", "joint_iterations",
         "joint_kkt", "alternation_cost_mm2", "alternation_stopped", "rounds_to_joint_cost",
         "interval_of_minimisers"],
        (
            [k, *settings[k].tolist(), float(bounds[k]), float(joint_cost[k]),
             int(ended.iterations[k]), float(ended.stationarity[k]), float(costs[-1, k]),
             bool(finished[k]), int(rounds_needed[k]), bool(singular[k])]
            for k in range(count)
        ),
    )  # fmt: skip
    write_table(
        folder / "same_objective_scipy.csv",
        ["problem", "joint_cost_mm2", "scipy_cost_mm2", "scipy_lower", "scipy_higher", "condition",
         "observable", "angle_between_rad"],
        peers,
    )  # fmt: skip
    iterations = np.asarray(ended.iterations)
    summary = [
        ("problems", count),
        ("joint objective above alternation's x (1 + 1e-8) + 1e-12 sum r^2", int(worse.sum())),
        ("joint objective lower by more than that", int(better.sum())),
        ("joint scaled KKT residual, largest", float(ended.stationarity.max())),
        ("joint iterations, median", float(np.median(iterations))),
        ("joint iterations, largest", int(iterations.max())),
        ("joint time per problem (us), median of 3", 1e6 * float(np.median(joint_times)) / count),
        ("alternation rounds to the joint's objective, median where reached",
         float(np.median(rounds_needed[rounds_needed > 0]))),
        ("alternation: problems that reach it within 20,000 rounds", int((rounds_needed >
        0).sum())), ("alternation: problems stopped by X moving < 1e-10", int(finished.sum())),
        ("alternation time per problem (us), until stopped or 20,000 rounds",
         1e6 * elapsed[-1] / count),
        ("problems whose minimiser is an interval (no bound active in some direction)",
         int(singular.sum())),
        ("scipy trf: problems compared", compared),
        ("scipy trf: problems where it found a lower objective", sum(p[3] for p in peers)),
        ("scipy trf: problems where it stopped higher", sum(p[4] for p in peers)),
        ("scipy trf: X compared (same objective, condition below 1e6)", len(angles)),
        ("scipy trf: largest angle between X and ours (rad)", float(max(angles))),
        ("machine", machine()),
    ]  # fmt: skip
    write_table(folder / "same_objective_summary.csv", ["quantity", "value"], summary)
    for name, value in summary:
        print(f"{name}: {value}")
    plot(folder / "same_objective.png", costs, joint_cost, iterations)


def plot(path, costs: np.ndarray, joint_cost: np.ndarray, iterations: np.ndarray) -> None:
    """Excess of the alternation's objective over the joint one against rounds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    excess = np.maximum(costs / joint_cost - 1, 1e-15)
    for quantile, style in ((50, "-"), (90, "--"), (99, ":")):
        axes.loglog(ROUNDS, np.percentile(excess, quantile, axis=1), style, color="tab:blue",
                    label=f"alternation, {quantile}th percentile")  # fmt: skip
    axes.axvline(np.median(iterations), color="tab:orange",
                 label="joint: median iterations to its optimum")  # fmt: skip
    axes.axvline(iterations.max(), color="tab:orange", linestyle=":",
                 label="joint: most iterations")  # fmt: skip
    axes.set(xlabel="rounds (alternation), iterations (joint)",
             ylabel="objective above the joint optimum (relative)",
             title="Same objective, same start, n = 50")  # fmt: skip
    # Beside the axes: the curves go from corner to corner.
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    axes.grid(alpha=0.3)
    save_figure(figure, path, dpi=150)


if __name__ == "__main__":
    main()
