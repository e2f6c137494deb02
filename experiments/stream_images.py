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
intervals of X's six parameters, and the share of trials that would be called good, by the stated
target registration error, although the truth is outside the 99 % interval of some parameter. Of 200
trials a share is known to +- 2 to 3 %.

Seed 20261129; trial t of condition k has the generator (seed, k, t).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from common import arguments, machine, save_figure, write_table
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
HEADER = [
    "condition", "kept", "trials", "refused", "not_converged", "images_mean", "cover_95_mean",
    "cover_95_lowest", "error_mm", "stated_mm", "error_deg", "stated_deg", "good",
    "good_outside_99",
]  # fmt: skip


def figure(rows: list[list[object]], path: Path) -> None:
    """Errors and coverage of every rule, a line for each condition."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(10, 4.2), layout="constrained")
    panels = drawn.subplots(1, 2)
    labels = list(RULES)
    for name in CONDITIONS:
        ours = {row[1]: dict(zip(HEADER, row, strict=True)) for row in rows if row[0] == name}
        for panel, column in zip(panels, ("error_mm", "cover_95_mean"), strict=True):
            values = [ours[label][column] or np.nan for label in labels]
            panel.plot(labels, values, "o-", label=name)
    panels[0].set_ylabel("RMS error of X's translation [mm]")
    panels[0].set_yscale("log")
    panels[1].set_ylabel("coverage of 95 % intervals")
    panels[1].axhline(0.95, color="0.6", linewidth=1)
    for panel in panels:
        panel.tick_params(axis="x", rotation=35)
    panels[0].legend(fontsize=7)
    save_figure(drawn, path, dpi=150)


def main() -> None:
    quick, folder = arguments(__doc__)
    trials = 10 if quick else 200
    enable_compilation_cache()
    rows: list[list[object]] = []
    for condition, (name, make) in enumerate(CONDITIONS.items()):
        sets = [make(np.random.default_rng([SEED, condition, t])) for t in range(trials)]
        for kept, rule in RULES.items():
            dependence.KEPT_OF_TIME, dependence.KEPT_OF_STREAM = rule
            answers, truth = [], []
            for one in sets:
                problem = jaxcal.Problem.from_arrays(one.poses, one.points)
                try:
                    answers.append(Answers.of(jaxcal.calibrate(problem)))
                except jaxcal.InputError:
                    continue
                truth.append(one.image_to_probe)
            rest: list[object] = [""] * (len(HEADER) - 4)
            if answers:
                found = row_of(answers, np.array(truth))
                # Neither the highest coverage nor what is fair and wrong.
                rest = [*found[:4], *found[5:11]]
            rows.append([name, kept, trials, trials - len(truth), *rest])
            print(*rows[-1], flush=True)
    write_table(folder / "stream_images.csv", HEADER, rows)
    figure(rows, folder / "stream_images.png")
    print(machine())


if __name__ == "__main__":
    main()
