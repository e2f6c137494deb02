"""Random degenerate and weak pose sets, and what is true of them, computed without jaxcal.

The truth is the information about (X, c) at the *true* geometry: the singular values of the
whitened Jacobian, written out by hand, of lateral position, range and elevational offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

IMAGES = 40
"""Every set is padded to this many images, the rest masked out: one program serves all."""

DEGENERATE = ("parallel", "one-axis", "one-pose", "two-poses", "line-in-plane")
WEAK = ("few", "cone", "one-depth", "corner")


@dataclass(frozen=True)
class PoseSet:
    """Arrays of a set and its truth."""

    kind: str
    poses: np.ndarray
    points: np.ndarray
    mask: np.ndarray
    image_to_probe: np.ndarray
    point: np.ndarray
    sigma: np.ndarray
    deficient: bool
    weakest: np.ndarray
    relative_sd: float


def _turned(rng, count: int, largest: float, axis: np.ndarray | None = None) -> np.ndarray:
    axes = rng.normal(size=(count, 3)) if axis is None else np.tile(axis, (count, 1))
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Rotation.from_rotvec(axes * rng.uniform(-largest, largest, (count, 1))).as_matrix()


def make(kind: str, seed: int, elevation: float, noise: float) -> PoseSet:
    """One random set of a kind.

    Args:
        kind: of :data:`DEGENERATE` or :data:`WEAK`.
        seed: of its draws.
        elevation: SD of the elevational offsets, mm (line-in-plane has none).
        noise: SD of lateral position; a fifth of it on the range, mm.
    """
    rng = np.random.default_rng([seed, sum(map(ord, kind))])
    count = {"few": int(rng.integers(4, 7)), "cone": 40}.get(kind, int(rng.integers(12, 41)))
    largest = np.radians(rng.uniform(15, 30))
    lateral, depth = rng.uniform(-25, 25, count), rng.uniform(15, 85, count)
    offset = elevation * rng.normal(size=count)
    rotations = _turned(rng, count, largest)
    if kind == "parallel":
        rotations = np.tile(Rotation.from_quat(rng.normal(size=4)).as_matrix(), (count, 1, 1))
    elif kind == "one-axis":
        rotations = _turned(rng, count, largest, rng.normal(size=3))
    elif kind in ("one-pose", "two-poses"):
        several = 1 if kind == "one-pose" else 2
        which = np.arange(count) % several
        rotations, lateral = rotations[which], lateral[which]
        depth, offset = depth[which], offset[which]
    elif kind == "line-in-plane":
        depth, offset = np.full(count, rng.uniform(25, 75)), np.zeros(count)
    elif kind == "cone":
        rotations = _turned(rng, count, np.radians(3.0))
    elif kind == "one-depth":
        depth = rng.uniform(25, 75) + rng.uniform(0.5, 3.0) * rng.normal(size=count)
    elif kind == "corner":
        sides = np.array([rng.choice([-25.0, 20.0]), rng.choice([15.0, 75.0])])
        lateral, depth = sides[:, None] + rng.uniform(0, 8, (2, count))
    x = np.eye(4)
    x[:3, :3], x[:3, 3] = (
        Rotation.from_quat(rng.normal(size=4)).as_matrix(),
        50 * rng.normal(size=3),
    )
    target = 100 * rng.normal(size=3)
    q = np.stack([lateral, offset, depth], axis=1)
    poses = np.tile(np.eye(4), (IMAGES, 1, 1))
    poses[:count, :3, :3] = rotations
    in_probe = q @ x[:3, :3].T + x[:3, 3]
    poses[:count, :3, 3] = target - np.einsum("nij,nj->ni", rotations, in_probe)
    sigma = np.maximum([noise, 0.2 * noise, elevation], 1e-3)
    points = np.tile([0.0, 50.0], (IMAGES, 1))
    exact = np.stack([lateral, np.hypot(offset, depth)], axis=1)
    points[:count] = exact + noise * np.array([1.0, 0.2]) * rng.normal(size=(count, 2))
    mask = np.arange(IMAGES) < count
    if kind == "few":
        # With fewer than 8 images the solver holds its SDs: these are what it can know.
        sigma = np.array([0.5, 0.5, 1.0])
    values, right, lever = _spectrum(q, rotations, x, sigma)
    unweighted, _, _ = _spectrum(q, rotations, x, np.ones(3))
    return PoseSet(
        kind, poses, points, mask, x, target, sigma,
        deficient=bool(unweighted[-1] < 1e-9 * unweighted[0]),
        weakest=right[-1],
        relative_sd=float(1 / (max(values[-1], 1e-300) * lever)),
    )  # fmt: skip


def _spectrum(q, rotations, x, sigma) -> tuple[np.ndarray, np.ndarray, float]:
    """Singular values and right vectors of the whitened Jacobian, rotations in mm at the lever."""
    lever = float(np.sqrt((q**2).sum() / len(q)))
    a, b, c = q.T
    # X Exp([v, w]) moves q by -v - w x q; c moves it by (R X_R)'.
    cross = np.zeros((len(q), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -c, b, -a
    cross -= cross.swapaxes(1, 2)
    by_target = (rotations @ x[:3, :3]).swapaxes(1, 2)
    by_shift = np.broadcast_to(-np.eye(3), cross.shape)
    moved = np.concatenate([by_shift, cross / lever, by_target], axis=2)
    along = (b[:, None] * moved[:, 1] + c[:, None] * moved[:, 2]) / np.hypot(b, c)[:, None]
    rows = np.concatenate([moved[:, 0] / sigma[0], along / sigma[1], moved[:, 1] / sigma[2]])
    _, values, right = np.linalg.svd(rows, full_matrices=False)
    return values, right, lever
