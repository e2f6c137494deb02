"""What a lab needs to know: how many images a wanted error takes, and how long planning takes.

Predicted TRE and RP against the number of images, for planned and random poses (the candidates of
pose_design.py) and three sizes of offsets. Seed 20261129.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from common import arguments, machine, save_figure, write_table
from matplotlib.figure import Figure
from pose_design import CONES, POOL, SEED, pool

import jaxcal
from jaxcal import design
from jaxcal.design.criteria import curve
from jaxcal.runtime.jax_cache import enable_compilation_cache

HEADER = [
    "cone", "offset_sd_mm", "images", "planned_tre_mm", "planned_rp_mm", "random_tre_mm",
]  # fmt: skip


def planning_curves(folder: Path) -> None:
    """Images against predicted TRE and RP: planned poses, and any (random) ones."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    rows: list[list[object]] = []
    for panel, cone in zip(figure.subplots(1, 2, sharey=True), CONES, strict=True):
        for elevational, colour in ((0.3, "tab:green"), (1.0, "tab:blue"), (3.0, "tab:red")):
            candidates = pool(cone, elevational)
            plan = design.plan(candidates, 100, polish=False)
            rng = np.random.default_rng(SEED)
            known = design.plan(candidates, 4, polish=False).known
            drawn = (candidates.poses[rng.choice(POOL, 100, replace=False)] for _ in range(10))
            squares = [curve(candidates, known, poses)[0] ** 2 for poses in drawn]
            random = np.mean(squares, axis=0) ** 0.5
            panel.loglog(range(8, 101), plan.tre_mm[8:], color=colour,
                         label=f"planned, offsets {elevational:g} mm (SD)")  # fmt: skip
            panel.loglog(range(8, 101), random[8:], "--", color=colour, label="random")
            for count in (8, 12, 20, 30, 45, 60, 100):
                rows.append([cone, elevational, count, float(plan.tre_mm[count]),
                             float(plan.rp_mm[count]), float(random[count])])  # fmt: skip
        tilt, turn = CONES[cone]
        panel.set(xlabel="images", title=f"tilts to {tilt:g}, turns to {turn:g} degrees")
        panel.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel("predicted TRE over the image (mm)")
    figure.axes[0].legend(fontsize="x-small", ncols=2)
    save_figure(figure, folder / "pose_design_planning.png", dpi=130)
    write_table(folder / "pose_design_planning.csv", HEADER, rows)


def timings() -> list[str]:
    """A plan of 60 from 5,000, the next pose, warm."""
    candidates = design.make_candidates(jaxcal.LinearProbe(), count=5000)
    plan = design.plan(candidates, 60)
    told = []
    for name, call in (("plan of 60 from 5,000", lambda: design.plan(candidates, 60)),
                       ("next pose", lambda: design.next_poses(plan, candidates, 1))):  # fmt: skip
        seconds, work = [], []
        for _ in range(5):
            began, before = time.perf_counter(), time.process_time()
            call()
            seconds.append(time.perf_counter() - began)
            work.append(time.process_time() - before)
        told.append(
            f"{name}: {1e3 * min(seconds):.0f} ms, {1e3 * min(work):.0f} ms of CPU (best of 5)"
        )
    return told


def main() -> None:
    _, folder = arguments(__doc__)
    enable_compilation_cache()
    print("\n".join(timings()))
    planning_curves(folder)
    print(machine())


if __name__ == "__main__":
    main()
