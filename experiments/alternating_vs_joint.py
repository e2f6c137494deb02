"""Comparison (ii): the same data, best practice. Seven ways to calibrate, five distributions.

Each method solves the same simulated experiments; differences from the conventional one are paired,
with Student's 95 % intervals. The study is alternating_vs_joint.toml; nothing in it is fitted.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from common import arguments, machine, open_study, save_figure, write_table

from jaxcal.study.show import mean_interval

CELL = ("elevation_distribution", "elevation_mm", "noise_mm")
HEADER = [
    "elevation_distribution", "elevation_mm", "noise_mm", "method", "bound_mm", "trials",
    "mean_mm", "sd_mm", "over_conventional", "difference_mm", "difference_low_mm",
    "difference_high_mm", "loses_to_conventional", "not_converged",
]  # fmt: skip


def table(data) -> list[list[object]]:
    """A row for each condition and method."""
    rows = []
    for values in itertools.product(*(data[name].values for name in CELL)):
        cell = data.sel(dict(zip(CELL, values, strict=True)))
        flat = cell.rp.sel({"method": "conventional"}).values
        for method in data.method.values:
            one = cell.sel({"method": method})
            rp = one.rp.values
            difference = mean_interval(rp - flat) or (np.nan, np.nan, np.nan)
            rows.append([
                str(values[0]), float(values[1]), float(values[2]), str(method),
                float(one.bound), rp.size, float(rp.mean()), float(rp.std(ddof=1)),
                float(rp.mean() / flat.mean()), *difference, float(np.mean(rp > flat)),
                int((one.status.values != 0).sum()),
            ])  # fmt: skip
    return rows


def summary(rows: list[list[object]]) -> list[list[object]]:
    """For each distribution and method: how the cells' mean RP compares with conventional's."""
    out: list[list[object]] = []
    keys = dict.fromkeys((row[0], row[3]) for row in rows)
    for law, method in keys:
        chosen = [row for row in rows if (row[0], row[3]) == (law, method)]
        ratio = np.array([row[8] for row in chosen], dtype=float)
        low = np.array([row[10] for row in chosen], dtype=float)
        high = np.array([row[11] for row in chosen], dtype=float)
        worst = chosen[int(np.argmax(ratio))]
        out.append([
            law, method, len(chosen), int((high < 0).sum()), int((low > 0).sum()),
            float(np.exp(np.mean(np.log(ratio)))), float(ratio.max()),
            f"{worst[1]:g} mm, noise {worst[2]:g} mm", sum(int(str(row[-1])) for row in chosen),
        ])  # fmt: skip
    return out


def main() -> None:
    quick, folder = arguments(__doc__)
    data = open_study("alternating_vs_joint", trials=64 if quick else None, quick=quick)
    rows = table(data)
    write_table(folder / "alternating_vs_joint.csv", HEADER, rows)
    told = summary(rows)
    header = ["elevation_distribution", "method", "cells", "cells_better", "cells_worse",
              "mean_ratio", "worst_ratio", "worst_cell", "not_converged"]  # fmt: skip
    write_table(folder / "alternating_vs_joint_summary.csv", header, told)
    for law, method, cells, better, worse, ratio, worst, where, failed in told:
        if method != "conventional":
            print(f"{law}: {method}: {better} of {cells} cells better than conventional, {worse} "
                  f"worse; mean ratio {ratio:.3f}, worst {worst:.3f} ({where}); {failed} trials "
                  "not converged")  # fmt: skip
    print(machine())
    plot(folder / "alternating_vs_joint.png", data, rows)


def plot(path: Path, data, rows: list[list[object]]) -> None:
    """Mean RP over conventional's, with the interval of the paired difference, by distribution."""
    from matplotlib.figure import Figure

    laws = [str(law) for law in data.elevation_distribution.values]
    methods = [str(name) for name in data.method.values if name != "conventional"]
    cells = list(itertools.product(data.elevation_mm.values, data.noise_mm.values))
    figure = Figure(figsize=(12, 3.1 * len(laws)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(len(laws), 1, sharex=True))
    for panel, law in zip(panels, laws, strict=True):
        for k, method in enumerate(methods):
            chosen = [row for row in rows if row[0] == law and row[3] == method]
            ratio = np.array([row[8] for row in chosen], dtype=float)
            # The interval of the difference, in units of conventional's mean.
            flat = np.array([row[6] for row in chosen], dtype=float) / ratio
            half = np.array([row[11] for row in chosen], dtype=float)
            half = (half - np.array([row[9] for row in chosen], dtype=float)) / flat
            place = np.arange(len(cells)) + 0.11 * (k - (len(methods) - 1) / 2)
            panel.errorbar(place, ratio, half, fmt="o", markersize=4, capsize=2, label=method)
        panel.axhline(1, color="black", linewidth=0.8)
        panel.set(title=law, ylabel="RP over conventional", yscale="log")
        panel.set_yticks([0.3, 0.5, 0.7, 1, 1.5, 2, 3], ["0.3", "0.5", "0.7", "1", "1.5", "2", "3"])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    panels[0].legend(ncols=3, fontsize="small")
    panels[-1].set_xticks(range(len(cells)), [f"{e:g} mm\n{s:g} mm" for e, s in cells])
    panels[-1].set_xlabel("size of the offsets (above) and noise on each distance (below)")
    save_figure(figure, path, dpi=110)


if __name__ == "__main__":
    main()
