"""How many images of a stream should be kept, if its errors stay alike for a time?

Sweeps at 20 frames a second, and paths of 100 frames, of ``dependent_frames``, with errors that are
alike for a time. ``jaxcal.calibrate`` finds the correlation time from the errors of the
conventional fit and leaves out images at equal intervals (:mod:`jaxcal.calibration.dependence`).
How many of a correlation time it keeps, and at least how many of the stream, are ``KEPT_OF_TIME``
and ``KEPT_OF_STREAM``. Other values are tried here on the same recordings: from one image of a
correlation time, as if the images that remain had to be independent, to all of them. In each case
errors that remain alike widen the covariance (:mod:`jaxcal.calibration.serial_correlation`).

For each, the table has how many recordings were refused for having fewer than four poses, how many
images were used, the root mean square errors of X and what was stated, the coverage of the 95 %
intervals of X's six parameters, and the share of trials that the stated target registration error
alone would make good although the truth is outside the 99 % interval of some parameter. The
recordings that a rule refuses are harder than others. So ``error_of_all_mm`` is the error of X's
translation in those recordings alone that all rules accept and solve, ``accepted_by_all`` in
number. Of 200 trials a share is known to +- 7 % at worst (95 %), one near 95 % to +- 3 %.

Seed 20261129; trial t of condition k has the generator (seed, k, t).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, machine, plain_ticks, right_errors, rms, save_figure, show, write_rows
from dependent_frames import Answers, Frames, along, row_of, swept

import jaxcal
from jaxcal.calibration import dependence
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261129
CONDITIONS: dict[str, Callable[[np.random.Generator], Frames]] = {
    "sweep 15 s, alike for 1 s": lambda rng: swept(15, 1.0, rng),
    "sweep 30 s, alike for 0.5 s": lambda rng: swept(30, 0.5, rng),
    "sweep 30 s, alike for 1 s": lambda rng: swept(30, 1.0, rng),
    "sweep 60 s, alike for 2 s": lambda rng: swept(60, 2.0, rng),
    "path of 100, correlation 0.8": lambda rng: along(100, 0.8, rng),
    "path of 100, correlation 0.9": lambda rng: along(100, 0.9, rng),
}
RULES: dict[str, tuple[float, int]] = {
    "1 of a time": (1.0, 1),
    "2.5 of a time": (2.5, 1),
    "2.5, at least 30": (2.5, 30),
    "2.5, at least 60": (2.5, 60),
    "2.5, at least 120": (2.5, 120),
    "5, at least 60": (5.0, 60),
    "all": (np.inf, 1),
}
"""Values of ``KEPT_OF_TIME`` and ``KEPT_OF_STREAM``."""


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Errors and coverage of every rule, a line for each condition."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(10, 4.6), layout="constrained")
    panels = drawn.subplots(1, 2)
    labels = list(RULES)
    for name in CONDITIONS:
        ours = {row["kept"]: row for row in rows if row["condition"] == name}
        for panel, column in zip(panels, ("error_of_all_mm", "cover_95_mean"), strict=True):
            values = [ours[label][column] or np.nan for label in labels]
            panel.plot(labels, values, "o-", label=name)
    panels[0].set(ylabel="RMS error of X's translation (mm),\nrecordings that all rules accept",
                  yscale="log")  # fmt: skip
    plain_ticks(panels[0].yaxis, (0.5, 0.7, 1.0, 1.5, 2.0, 3.0))
    panels[1].set_ylabel("coverage of 95 % intervals")
    panels[1].axhline(0.95, color="0.6", linewidth=1)
    for panel in panels:
        panel.set_xticks(range(len(labels)), labels, rotation=35, ha="right")
    drawn.supxlabel("images kept of a correlation time, and at least how many", fontsize="medium")
    panels[0].legend(fontsize=7)
    save_figure(drawn, path, dpi=150)


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 10 if quick else 200
    enable_compilation_cache()
    rows: list[dict[str, Any]] = []
    for condition, (name, make) in enumerate(CONDITIONS.items()):
        sets = [make(np.random.default_rng([SEED, condition, t])) for t in range(trials)]
        errors = np.full((len(RULES), trials), np.nan)
        for at, (kept, rule) in enumerate(RULES.items()):
            dependence.KEPT_OF_TIME, dependence.KEPT_OF_STREAM = rule
            answers, truth = [], []
            for trial, one in enumerate(sets):
                problem = jaxcal.Problem.from_arrays(one.poses, one.points)
                try:
                    answers.append(Answers.of(jaxcal.calibrate(problem)))
                except jaxcal.InputError:
                    continue
                truth.append(one.image_to_probe)
                if answers[-1].converged[0]:
                    off = right_errors(answers[-1].transform, one.image_to_probe[None])
                    errors[at, trial] = np.linalg.norm(off[0, :3])
            row: dict[str, Any] = {"condition": name, "kept": kept, "trials": trials}
            row["refused"] = trials - len(truth)
            row |= {key: value for key, value in row_of(answers, np.array(truth), []).items()
                    if not key.startswith("verdict")}  # fmt: skip
            rows.append(row)
            show(row.values())
        common = np.isfinite(errors).all(axis=0)
        for row, each in zip(rows[-len(RULES) :], errors, strict=True):
            row["accepted_by_all"] = int(common.sum())
            row["error_of_all_mm"] = float(rms(each[common])) if common.any() else ""
    write_rows(folder / "stream_images.csv", rows)
    figure(rows, folder / "stream_images.png")
    print(machine())


if __name__ == "__main__":
    main()
