"""Images of the real cross-wire recording, chosen by the criterion: do they predict the others?

Of its 54 images 27 are chosen as candidates of a plan, from their poses and from X, target and SDs
of a calibration of all 54; they predict the other 27. The same for 200 random halves (``--quick``:
40). The recording is not part of this repository: the folder ``shared/data/crosswire`` beside it.
Seed 20261129.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from common import arguments, machine, show, write_table
from crosswire_real import DATA

import jaxcal
from jaxcal import design
from jaxcal.design.greedy import Rules
from jaxcal.io.text import read_crosswire
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261129
HEADER = [
    "method", "criterion", "chosen_rp_mm", "random_median_mm", "random_5_mm", "random_95_mm",
    "share_better", "random_halves",
]  # fmt: skip


def crosswire(folder: Path, halves: int) -> list[list[object]]:
    """Chosen halves against random ones: RP on the images left out (joint, scales estimated)."""
    recording = read_crosswire(
        folder / "crossWirePhantomTransformations.txt", folder / "crossWirePhantom2DPoints.txt"
    )
    data = jaxcal.Problem.from_recording(recording)
    count = data.images
    whole = jaxcal.calibrate(data, prior="gaussian", estimate=("scale",))
    around = design.candidates_around(recording, whole, count=8)
    poses = recording.calibration.poses
    candidates = design.Candidates(poses, around.model, around.constraints)
    rules = Rules(space_filling=0.2, replicates=count)
    sets = {}
    for criterion in ("tre", "rp", "d"):
        chosen = design.plan(candidates, count // 2, criterion, polish=False, rules=rules).rows
        sets[criterion] = np.isin(np.arange(count), chosen)
    rng = np.random.default_rng(SEED)
    drawn = [np.isin(np.arange(count), rng.permutation(count)[: count // 2]) for _ in range(halves)]
    masks = np.array([*sets.values(), *drawn], float)
    batch = jaxcal.stack([replace(data, mask=jnp.asarray(mask)) for mask in masks])
    rows: list[list[object]] = []
    for method in ("joint", "conventional"):
        arguments: dict[str, Any] = {"prior": "gaussian"} if method == "joint" else {}
        result = jaxcal.calibrate_batch(batch, method, estimate=("scale",), **arguments)
        scored = []
        for k, mask in enumerate(masks):
            scale = np.asarray(result.scale_mm_per_px)[k]
            points = np.asarray(data.measurements) * scale
            left = mask == 0
            scored.append(float(jaxcal.reconstruction_precision(
                np.asarray(result.image_to_probe)[k], poses[left], points[left])))  # fmt: skip
        random = np.array(scored[len(sets) :])
        for k, name in enumerate(sets):
            rows.append([
                method, name, scored[k], float(np.median(random)),
                float(np.quantile(random, 0.05)), float(np.quantile(random, 0.95)),
                float((random < scored[k]).mean()), len(random),
            ])  # fmt: skip
            show(rows[-1])
    return rows


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    if not DATA.is_dir():
        print(f"{DATA}: the recording is not here; nothing was done")
        return
    rows = crosswire(DATA, 40 if quick else 200)
    write_table(folder / "pose_design_crosswire.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
