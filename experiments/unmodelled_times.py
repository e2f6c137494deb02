"""Errors that the model leaves out, where every element's time of flight is fitted.

As :mod:`unmodelled`, on times of flight (each distance with an SD of 0.5 mm, uniform offsets to
1 mm) of a curved array, and of a straight one whose sound speed is estimated. The faults:

- ``speed``: all distances 3 % too long (a sound speed of 1540 m/s in water of 1495 m/s), of the
  curved array, whose sound speed is not estimated;
- the others as there.

The columns are those of :mod:`unmodelled`, too. Of 100 trials a share is known to +- 2 to 5 %, of
500 clean ones to +- 1 %.

Seed 20261130; trial k of a condition is fold_in(root, condition * 10^6 + k).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, machine, write_table
from jaxtyping import Array
from unmodelled import BESIDE_MM, HEADER, Judged, judged, wrong_poses

import jaxcal
from jaxcal.data.probe import C5_2, L14_5, CurvilinearProbe, LinearProbe
from jaxcal.data.recording import Recording, make_images
from jaxcal.diagnostics.channel_points import excess_of_points
from jaxcal.runtime.jax_cache import enable_compilation_cache

SEED = 20261130
FAULTS = (
    "none", "speed", "beside", "slip", "step", "displaced", "distortion", "marker", "targets",
)  # fmt: skip
IMAGES = (12, 30, 60)
PROBES = {"curved": (C5_2, ()), "straight, sound speed estimated": (L14_5, ("sound-speed",))}
CONDITIONS = [
    each
    for each in product(PROBES, FAULTS, IMAGES)
    # An estimated sound speed is not wrong.
    if each[1] != "speed" or not PROBES[each[0]][1]
]
TOO_LONG, NOISE_MM = 1.03, 0.5


@partial(jax.jit, static_argnums=(0, 1, 2))
def draw(probe: CurvilinearProbe | LinearProbe, images: int, fault: str, indices: Array):
    """Problems of one condition, and their true X."""
    protocol = jaxcal.Protocol(
        images=images, test_images=2, elevation_mm=1.0, noise_mm=NOISE_MM, probe=probe, raw=True
    )
    root = jax.random.key(SEED)

    def one(k: Array):
        key = jax.random.fold_in(root, k)
        drawn = jaxcal.simulate(key, protocol)
        problem, x, y = drawn.problem(probe=probe), drawn.image_to_probe, drawn.elevation
        assert problem.channels is not None
        poses, distances = problem.poses, problem.channels.distances
        if fault == "speed":
            distances = TOO_LONG * distances
        if fault == "beside":
            poses = poses.at[:, :3, 3].add(-BESIDE_MM * (poses[:, :3, :3] @ x[:3, 1]))
            farther = (y + BESIDE_MM) ** 2 - y**2
            distances = jnp.sqrt(distances**2 + farther[:, None])
        order = jax.random.permutation(jax.random.fold_in(key, 7), images)
        poses = wrong_poses(fault, key, order, poses, x)
        channels = replace(problem.channels, distances=distances)
        return replace(problem, poses=poses, channels=channels), x

    return jax.vmap(one)(indices)


def recording_of(problem: jaxcal.Problem, probe: CurvilinearProbe | LinearProbe) -> Recording:
    """The recording of a problem, with its times and the points segmented from them."""
    assert problem.channels is not None
    heard = np.where(problem.channels.heard > 0, problem.channels.distances, np.nan)
    times = probe.time_of_flight_s(heard)
    poses, points = np.asarray(problem.poses), np.asarray(problem.measurements)
    images = make_images(poses, points, time_of_flight=times)
    return Recording(images, probe=probe)


def shortened(there: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Where points are, mm, of which all distances are too long."""
    true = there.copy()
    true[:, [0, 2]] -= (1 - 1 / TOO_LONG) * excess_of_points(there[:, [0, 2]], elements)
    return true


def row(condition: int, trials: int) -> list[object]:
    """One row of the table."""
    name, fault, images = CONDITIONS[condition]
    probe, estimate = PROBES[name]
    truly = partial(shortened, elements=probe.element_positions()) if fault == "speed" else np.copy
    problems, x = draw(probe, images, fault, condition * 1_000_000 + jnp.arange(trials))
    results = jaxcal.calibrate_batch(problems, estimate=estimate, data="channels").numpy()
    problems, x = jax.tree.map(np.asarray, problems), np.asarray(x)
    told: list[Judged] = []
    for k in range(trials):
        problem = jax.tree.map(lambda leaf, k=k: leaf[k], problems)
        told.append(judged(results[k], recording_of(problem, probe), x[k], fault, truly))
    return [name, fault, images, trials, *Judged.shares(told)]


def main() -> None:
    quick, folder = arguments(__doc__)
    enable_compilation_cache()
    rows: list[list[object]] = []
    for condition, (_, fault, _) in enumerate(CONDITIONS):
        rows.append(row(condition, 20 if quick else 500 if fault == "none" else 100))
        print(*rows[-1], sep=", ", flush=True)
    write_table(folder / "unmodelled_times.csv", ["array", *HEADER], rows)
    print(machine())


if __name__ == "__main__":
    main()
