"""Planned poses on emulated benches: 36 of a plan against 60 and 36 of the Sobol plan.

The target is placed by amplitude scans, without sockets; the planner knows a drawing and guesses at
the SDs. Benches 0 to 63 (``--quick``: 0 to 3).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from common import arguments, machine, show, write_table
from pose_design import MOST

import jaxcal
from hw.bench.stage import WorldStage
from hw.bench.world import make_world
from hw.midplane.amplitude_scan import amplitude_scan
from hw.midplane.search import PlacementError
from hw.planning.pool import BENCH_RULES, BENCH_SDS_MM
from hw.planning.poses import Extent, constraints_of, plan_poses
from jaxcal import design
from jaxcal.runtime.jax_cache import enable_compilation_cache

HEADER = ["poses", "benches", "tre_mm", "tre_error_mm", "rp_mm", "rp_error_mm"]


def benches(count: int) -> list[list[object]]:
    """Emulated benches without sockets: 36 poses of a plan against 60 of the Sobol plan."""
    # All benches share one drawing, and so one plan.
    scene, extent = make_world(0).scene, Extent()
    drawn = design.Model(scene.image_to_probe, scene.point_mm, design.Noise.constant(BENCH_SDS_MM))
    bounds = constraints_of(scene, extent)
    candidates = design.make_candidates(count=2000, constraints=bounds, model=drawn)
    chosen = design.plan(candidates, 36, rules=BENCH_RULES).poses
    arms = {
        "sobol 60": lambda seed: plan_poses(60, scene, extent, seed).poses,
        "sobol 36": lambda seed: plan_poses(36, scene, extent, seed).poses,
        "optimal 36": lambda seed: chosen,
    }
    points = bounds.region.grid()
    rows: list[list[object]] = []
    for name, poses_of in arms.items():
        built, truths = [], []
        for seed in range(count):
            world = make_world(seed)
            rng = np.random.default_rng([seed, list(arms).index(name)])
            kept, times = [], []
            for pose in poses_of(seed):
                stage = WorldStage(world, pose, rng, position_sd_mm=0.1)
                try:
                    amplitude_scan(stage)
                except PlacementError:
                    continue
                kept.append(stage.reported_pose)
                times.append(stage.times_of_flight(9))
            mask = np.arange(MOST) < len(kept)
            kept += [kept[0]] * (MOST - len(kept))
            times += [times[0]] * (MOST - len(times))
            images = jaxcal.make_images(
                np.array(kept), np.array(times), "time_of_flight", mask=mask
            )
            one = jaxcal.Problem.from_recording(jaxcal.Recording(images, probe=world.probe))
            # On a linear probe the points with their covariances say all that the times do.
            built.append(replace(one, channels=None))
            truths.append(world)
        found = np.asarray(jaxcal.calibrate_batch(jaxcal.stack(built)).image_to_probe)
        squared, rp = [], []
        for x, world in zip(found, truths, strict=True):
            off = x - world.image_to_probe
            squared.append(((points @ off[:3, :3].T + off[:3, 3]) ** 2).sum(1).mean())
            rp.append(float(jaxcal.reconstruction_precision(x, *world.test_set())))
        tre, root = np.sqrt(squared), np.sqrt(count)
        rows.append([name, count, float(tre.mean()), float(tre.std() / root), float(np.mean(rp)),
                     float(np.std(rp) / root)])  # fmt: skip
        show(rows[-1])
    return rows


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    rows = benches(4 if quick else 64)
    write_table(folder / "pose_design_benches.csv", HEADER, rows)
    print(machine())


if __name__ == "__main__":
    main()
