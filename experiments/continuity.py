"""Does the answer of prior ``auto`` move continuously with the data?

Paths between two data sets of the same poses, on which something that the estimator weighs goes
from hardly believed to believed:

- ``mean``: offsets of mean zero become one-sided ones;
- ``own covariances``: the images' own covariances go from another image's to their own;
- ``outlier``: one image's point moves away by 3 mm, beyond the edges of every distribution that has
  some.

Each path is looked at in 41 places; where X moves fastest, in SDs, 41 places a thousandth of the
path apart follow. The table has the largest step between such neighbours, in SDs of the answer, of
any of X's six parameters: a switch would step by about one SD, whatever the distance.

Seed 20261204; path k of a condition is fold_in(root, condition * 10^6 + k).
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, machine, write_rows
from scipy.spatial.transform import Rotation

from jaxcal import Problem, Protocol, calibrate_batch, simulate

SEED = 20261204
PATHS, PLACES, STEP = 2000, 41, 1e-3
LARGEST_STEP = 0.1
"""In SDs: what the answer may move by between neighbours."""
CONDITIONS = tuple(
    (kind, images) for kind in ("mean", "own covariances", "outlier") for images in (12, 30)
)


def ends(kind: str, images: int, keys: jax.Array) -> tuple[Problem, Problem]:
    """Both ends of every path."""
    protocol = Protocol(images=images, elevation_mm=4.0, noise_mm=0.5)
    other = protocol
    if kind == "mean":
        other = replace(protocol, elevation_distribution="one-sided")

    def both(key: jax.Array) -> tuple[Problem, Problem]:
        drawn = simulate(key, protocol)
        first = drawn.problem()
        second = simulate(key, other).problem()
        if kind == "own covariances":
            second = replace(first, covariance=drawn.covariance)
            first = replace(first, covariance=jnp.roll(drawn.covariance, 5, axis=0))
        if kind == "outlier":
            away = jnp.zeros_like(first.measurements).at[0].set(3.0)
            second = replace(first, measurements=first.measurements + away)
        return first, second

    return jax.jit(jax.vmap(both))(keys)


def on_the_way(first: Problem, second: Problem, places: np.ndarray) -> Problem:
    """The data at (paths, places) along the paths, one after the other."""
    share = jnp.asarray(places)

    def between(a: jax.Array, b: jax.Array) -> jax.Array:
        if not jnp.issubdtype(a.dtype, jnp.floating):
            return jnp.repeat(a, share.shape[1], axis=0)
        weight = share.reshape(*share.shape, *(1,) * (a.ndim - 1))
        found = a[:, None] + weight * (b - a)[:, None]
        return found.reshape(-1, *a.shape[1:])

    return jax.tree.map(between, first, second)


def steps(problems: Problem, paths: int) -> tuple[np.ndarray, np.ndarray]:
    """Largest step from place to place, in SDs, (paths, places - 1); and where all converged."""
    result = calibrate_batch(problems)
    sd = np.sqrt(np.diagonal(np.asarray(result.covariance), axis1=1, axis2=2))
    fine = np.asarray(result.status_code).reshape(paths, -1) == 0
    return largest_steps(np.asarray(result.image_to_probe), sd, paths), fine.all(axis=1)


def largest_steps(image_to_probe: np.ndarray, sd: np.ndarray, paths: int) -> np.ndarray:
    """Largest step of X's six parameters from place to place, in SDs, (paths, places - 1)."""
    x, sd = image_to_probe.reshape(paths, -1, 4, 4), sd.reshape(paths, -1, 6)
    relative = np.linalg.inv(x[:, :-1]) @ x[:, 1:]
    turn = Rotation.from_matrix(relative[..., :3, :3].reshape(-1, 3, 3)).as_rotvec()
    moved = np.concatenate([relative[..., :3, 3], turn.reshape(*relative.shape[:2], 3)], axis=-1)
    return np.abs(moved / sd[:, 1:]).max(axis=-1)


def fine_places(first: Problem, second: Problem) -> np.ndarray:
    """Places a thousandth of the path apart where X moves fastest, (paths, places)."""
    paths = len(first.mask)
    coarse = np.tile(np.linspace(0, 1, PLACES), (paths, 1))
    found, _ = steps(on_the_way(first, second, coarse), paths)
    begin = coarse[np.arange(paths), np.nanargmax(found, axis=1)]
    return begin[:, None] + STEP * np.arange(PLACES)


def keys_of(number: int, count: int) -> jax.Array:
    """The keys of a condition's paths."""
    root = jax.random.key(SEED)
    return jax.vmap(lambda k: jax.random.fold_in(root, k))(number * 10**6 + jnp.arange(count))


def run(kind: str, images: int, keys: jax.Array) -> dict[str, object]:
    """One row of the table."""
    first, second = ends(kind, images, keys)
    paths = len(keys)
    found, sound = steps(on_the_way(first, second, fine_places(first, second)), paths)
    largest = found.max(axis=1)[sound]
    return {
        "path": kind,
        "images": images,
        "paths": paths,
        "paths_converged": int(sound.sum()),
        "median_largest_step_sds": float(np.median(largest)),
        "largest_step_sds": float(largest.max()),
        "paths_above_a_tenth": int((largest > LARGEST_STEP).sum()),
    }


def main() -> None:
    quick, folder = arguments(__doc__)
    count = 40 if quick else PATHS
    rows: list[dict[str, object]] = []
    for number, (kind, images) in enumerate(CONDITIONS):
        rows.append(run(kind, images, keys_of(number, count)))
        print(rows[-1], flush=True)
        write_rows(folder / "continuity.csv", rows)
    print(machine())


if __name__ == "__main__":
    main()
