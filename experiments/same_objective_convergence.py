"""How three ways to one objective converge: joint, the alternation, and variable projection.

The objective is that of same_objective.py, sum |q_i - p_i(y_i)|^2 with |y_i| <= m, and so are the
problems (its first 200). Variable projection puts the offsets' closed form into the residual and
differentiates through it, so that X and c are the only unknowns left. (The joint solver, too, moves
the offsets to their optimum after every step, but its Gauss-Newton step leaves out how that optimum
bends: Kaufman's simplification, where ours here is Golub and Pereyra's full derivative.)

(a) From one conventional start: objective against iterations and against time, rate of convergence.
(b) Where each stops as its tolerance goes from 1e-1 to 1e-10. The tolerance of the alternation is X
    moving by less than t mm and t / 100 rad (t = 0.1: jaxcal's default), that of the others the
    scaled gradient; variable projection scales it by its own, shorter columns.
(c) Where each stops from ten starts around the conventional one: X turned by up to 2 degrees about
    a random axis and shifted by up to 5 mm.

Times are batched and compiled, medians of three interleaved repeats. Seeds 20261120 (problems) and
20261122 (starts).
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from common import arguments, machine, write_table
from convergence_arms import (
    ALTERNATION,
    ARMS,
    ROUNDS,
    ROUNDS_FROM_STARTS,
    STEPS,
    THREE_STARTS,
    TOLERANCES,
    Bench,
    Stops,
    Walk,
    turned_starts,
)
from convergence_tables import (
    SLACK,
    START_HEADER,
    TOLERANCE_HEADER,
    computed_iterations,
    curve_rows,
    excess_over,
    needed,
    plot,
    quantiles,
    rates,
    start_rows,
    tolerance_rows,
)


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
        out.setdefault((ALTERNATION, "0.1 mm"), []).append(stop)
        walk.to(tightest, ROUNDS_FROM_STARTS)
        label = f"{tightest:g} mm or {ROUNDS_FROM_STARTS} rounds"
        out.setdefault((ALTERNATION, label), []).append(walk.judged(tightest))
        print(f"starts: {number + 1} of {count}", flush=True)
    return out


def main() -> None:
    quick, folder = arguments(__doc__)
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
    every = np.arange(count)
    best = (costs[which, every], np.array([stop.matrix for stop in found])[which, every])

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
        per_iteration = took / computed_iterations(stop.iterations) if name in paths else np.nan
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


if __name__ == "__main__":
    main()
