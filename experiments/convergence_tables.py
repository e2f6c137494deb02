"""The tables and the figure of same_objective_convergence.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import save_figure
from convergence_arms import CHUNK, COLORS, THREE_STARTS, Stops
from scipy.spatial.transform import Rotation

FLOOR = 1e-14
"""Relative excess of the objective below which there is only rounding."""
SLACK = 1e-8
"""Relative excess at which an objective counts as reached."""


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


def computed_iterations(iterations: np.ndarray) -> int:
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
    save_figure(figure, path, dpi=110)
