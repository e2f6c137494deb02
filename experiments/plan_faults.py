"""Do planned poses show an error that the model leaves out, and how many of them must fill space?

Planned poses of the wide cone (:mod:`pose_design`) of which none, a tenth, a fifth (the default) or
two fifths fill space, and random poses. Uniform offsets of SD 1 mm, prior ``auto``. Ranges are
right, or too long by 1 mm 20 mm to the side, by the square of the lateral position. The table has
the root mean square TRE of X, the share of the recordings in which something is reported, and the
share in which the verdict is good or fair although the error at the image exceeds the end of its
95 % interval. Of 400 trials a share is known to +- 2.5 % or better.

Seed 20261123.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from common import arguments, machine, write_table
from pose_design import MOUNT, POOL, errors, pool, taken
from unmodelled import CURVE_MM, Judged, judged, true_points

import jaxcal
from jaxcal import design
from jaxcal.data.recording import Recording, make_images
from jaxcal.design.greedy import Rules
from jaxcal.diagnostics.unmodelled import SIDE_MM
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261123
IMAGES, SHARES, TRIALS = (12, 30, 60), (0.0, 0.1, 0.2, 0.4), 400
HEADER = [
    "images", "poses", "space_filling", "trials", "curve_mm", "tre_mm", "told_of",
    "good_and_wrong",
]  # fmt: skip


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    trials = 20 if quick else TRIALS
    candidates = pool("wide")
    points = candidates.constraints.region.grid()
    rows: list[list[object]] = []
    for images in IMAGES[1:2] if quick else IMAGES:
        for share in (*SHARES, None):
            plan = None
            if share is not None:
                plan = design.plan(candidates, images, rules=Rules(space_filling=share)).poses
            for curve_mm in (0.0, CURVE_MM):
                # The same errors for all plans.
                rng = np.random.default_rng([SEED, images])
                recordings = []
                for _ in range(trials):
                    poses = plan
                    if poses is None:
                        poses = candidates.poses[rng.choice(POOL, images, replace=False)]
                    moved, measured = taken(poses, "uniform", rng)
                    measured[:, 1] += curve_mm * (measured[:, 0] / SIDE_MM) ** 2
                    recordings.append(Recording(make_images(moved, measured)))
                results = jaxcal.calibrate_batch(recordings).numpy()
                fault = "curve" if curve_mm else "none"
                truly = partial(true_points, size=np.ones(2), fault=fault)
                told = Judged.shares([
                    judged(results[k], recordings[k], MOUNT, fault, truly)
                    for k in range(trials)
                ])  # fmt: skip
                squared, _ = errors(
                    np.asarray(results.image_to_probe), candidates.poses[:2], points
                )
                name = "random" if share is None else "planned"
                rows.append([
                    images, name, "" if share is None else share, trials, curve_mm,
                    float(np.sqrt(squared.mean())), told.told_of, told.good_and_wrong,
                ])  # fmt: skip
                print(*rows[-1], sep=", ", flush=True)
    write_table(folder / "plan_faults.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
