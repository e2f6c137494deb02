"""The golden corpus's problems, drawn with numpy; once written, the files are what counts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from golden.corpus import Arrays, Family

SEED = 20261121

ORDINARY = ("uniform", "normal", "heavy-tailed", "one-sided", "masked", "small errors")
HARD = (
    "few",
    "exact",
    "in the plane",
    "parallel",
    "one axis",
    "one pose",
    "line in the plane",
    "narrow cone",
    "outliers",
    "NaN",
)
"""What is special about a problem; ``few`` uses 4 to 7 images, ``NaN`` is to fail."""


def offsets(rng: np.random.Generator, law: str, size: float, count: int) -> np.ndarray:
    """Elevational offsets of an SD or bound of ``size`` mm."""
    if law == "normal":
        return size * rng.normal(size=count)
    if law == "heavy-tailed":
        return size * rng.standard_t(4, count) / np.sqrt(2.0)
    if law == "one-sided":
        return size * rng.uniform(0, 1, count)
    return size * rng.uniform(-1, 1, count)


class Experiment:
    """One drawn experiment: true places in the image (q), poses and errors."""

    def __init__(self, rng: np.random.Generator, kind: str, count: int, *, sector: float = 0.0):
        self.count = count
        law = kind if kind in ("normal", "heavy-tailed", "one-sided") else "uniform"
        size = (
            0.0
            if kind in ("exact", "in the plane", "line in the plane")
            else rng.choice([0.3, 1.0, 2.0, 4.0])
        )
        self.noise = 0.0 if kind == "exact" else float(rng.choice([0.02, 0.1, 0.4]))
        if kind == "small errors":
            size, self.noise = 0.02, 0.005
        self.size = float(size)
        if sector:
            angle = sector * rng.uniform(-1, 1, count)
            depth = 60 + rng.uniform(15, 85, count)
            lateral, axial = depth * np.sin(angle), depth * np.cos(angle) - 60
            # The image's origin is the apex of the arc.
            axial = axial + 60
        else:
            lateral, axial = rng.uniform(-27, 27, count), rng.uniform(12, 88, count)
        axes = rng.normal(size=(count, 3))
        if kind == "one axis":
            axes = np.tile(rng.normal(size=3), (count, 1))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        largest = np.radians(3.0 if kind == "narrow cone" else 30.0)
        turns = Rotation.from_rotvec(axes * rng.uniform(-largest, largest, (count, 1))).as_matrix()
        elevation = offsets(rng, law, self.size, count)
        if kind == "parallel":
            turns = np.tile(turns[:1], (count, 1, 1))
        if kind == "one pose":
            turns, lateral, axial, elevation = (
                np.repeat(a[:1], count, axis=0) for a in (turns, lateral, axial, elevation)
            )
        if kind == "line in the plane":
            axial = np.full(count, 50.0)
        self.q = np.stack([lateral, elevation, axial], axis=1)
        x = Rotation.random(random_state=np.random.RandomState(int(rng.integers(2**31))))
        self.rotation, self.origin = x.as_matrix(), 50 * rng.normal(size=3)
        target = 100 * rng.normal(size=3)
        in_probe = self.q @ self.rotation.T + self.origin
        self.poses = np.zeros((count, 3, 4))
        self.poses[:, :, :3] = turns
        self.poses[:, :, 3] = target - np.einsum("nij,nj->ni", turns, in_probe)

    def points(self, rng: np.random.Generator) -> np.ndarray:
        """Lateral position and range with errors, the lateral ones three times as large, mm."""
        exact = np.stack([self.q[:, 0], np.hypot(self.q[:, 1], self.q[:, 2])], axis=1)
        return exact + self.noise * np.array([3.0, 1.0]) * rng.normal(size=exact.shape)


def point_family(
    name: str,
    images: int,
    kinds: list[str],
    *,
    covariances: bool = False,
    bounds: bool = False,
    pixels: bool = False,
) -> Family:
    """A family of points (or pixels)."""
    columns: dict[str, list[np.ndarray]] = {}
    for index, kind in enumerate(kinds):
        rng = np.random.default_rng([SEED, sum(map(ord, name)), index])
        drawn = Experiment(rng, kind, images)
        points, poses = drawn.points(rng), drawn.poses
        mask = np.ones(images)
        if kind == "few":
            mask[rng.permutation(images)[: images - int(rng.integers(4, 8))]] = 0
        if kind == "masked":
            mask[rng.permutation(images)[: images // 4]] = 0
        if kind == "outliers":
            bad = rng.permutation(images)[: images // 6]
            points[bad] += rng.choice([-1, 1], (len(bad), 2)) * rng.uniform(8, 30, (len(bad), 2))
            points[:, 1] = np.maximum(points[:, 1], 5.0)
        arrays = {"poses": poses, "measurements": points, "mask": mask}
        spacing, face = np.ones(2), 0.0
        if pixels:
            spacing = rng.uniform(0.1, 0.2, 2)
            arrays["measurements"] = (points - [0.0, face]) / spacing + [0.0, 0.0]
        if covariances:
            stretch = rng.uniform(0.3, 3.0, (images, 2))
            mixed = rng.uniform(-0.6, 0.6, images)
            sd = np.maximum(drawn.noise, 0.01) * np.array([3.0, 1.0]) * stretch
            if kind in ("normal", "one-sided", "masked"):
                # Half of them are true.
                error = rng.normal(size=(images, 2)) * (sd - np.array([3.0, 1.0]) * drawn.noise)
                arrays["measurements"] = arrays["measurements"] + error / spacing
            sd = sd / spacing
            arrays["covariance"] = np.stack(
                [sd[:, 0] ** 2, mixed * sd[:, 0] * sd[:, 1], sd[:, 1] ** 2], axis=1
            )
        if bounds:
            slack = rng.uniform(0.8, 2.5, images)
            arrays["max_elevation"] = np.maximum(np.abs(drawn.q[:, 1]) * slack, 0.2 * slack)
        # What images left out hold must not matter.
        rubbish = rng.permutation(np.flatnonzero(mask == 0))
        arrays["measurements"][rubbish[::2]] = 1e4
        arrays["measurements"][rubbish[1::2]] = np.nan
        if kind == "NaN":
            arrays["poses" if index % 2 else "measurements"][3].flat[0] = np.nan
        for key, value in arrays.items():
            columns.setdefault(key, []).append(value)
    stacked: Arrays = {key: np.stack(values) for key, values in columns.items()}
    stacked["mask"] = stacked["mask"].astype(np.uint8)
    return Family(name, kinds, stacked, pixels)


def times_family(name: str, images: int, kinds: list[str], probe: dict) -> Family:
    """A family of times of flight, a few missing, sound speed and delay off by a little."""
    curved = probe["kind"] == "curvilinear"
    along = (np.arange(probe["elements"]) - (probe["elements"] - 1) / 2) * probe["pitch_mm"]
    elements = np.stack([along, 0 * along, 0 * along], axis=1)
    if curved:
        angle = along / probe["radius_mm"]
        elements = probe["radius_mm"] * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    half_angle = 0.9 * np.abs(along).max() / probe["radius_mm"] if curved else 0.0
    poses, times, masks = [], [], []
    for index, kind in enumerate(kinds):
        rng = np.random.default_rng([SEED, sum(map(ord, name)), index])
        drawn = Experiment(rng, kind, images, sector=half_angle)
        distance = np.linalg.norm(drawn.q[:, None] - elements, axis=2)
        distance = distance + max(drawn.noise, 0.02) * rng.normal(size=distance.shape)
        speed = 1490.0 * (1 + 0.01 * rng.normal())
        heard = distance / (1e3 * speed) + 3e-7 * rng.normal()
        heard[rng.uniform(size=heard.shape) < 0.03] = np.nan
        mask = np.ones(images)
        if kind == "masked":
            mask[rng.permutation(images)[: images // 4]] = 0
        poses.append(drawn.poses)
        times.append(heard)
        masks.append(mask)
    arrays = {
        "poses": np.stack(poses),
        "times": np.stack(times),
        "mask": np.stack(masks).astype(np.uint8),
    }
    return Family(name, kinds, arrays, probe=probe)


def cycled(kinds: tuple[str, ...], count: int) -> list[str]:
    """So many kinds, in turn."""
    return [kinds[k % len(kinds)] for k in range(count)]


LINEAR = {"kind": "linear", "elements": 16, "pitch_mm": 3.6}
CURVED = {"kind": "curvilinear", "elements": 16, "pitch_mm": 4.0, "radius_mm": 60.0}
MILD = (*ORDINARY, "few", "in the plane", "one axis", "outliers")


def families() -> list[Family]:
    """All of the corpus: 300 problems."""
    plain = [*cycled(ORDINARY, 34), *cycled(HARD, 30)]
    return [
        point_family("points12", 12, plain),
        point_family("points24", 24, plain),
        point_family("points200", 200, cycled(ORDINARY, 8)),
        point_family("covariances24", 24, cycled(MILD, 40), covariances=True),
        point_family("bounds24", 24, cycled((*ORDINARY, *HARD), 40), bounds=True),
        point_family("covariances-bounds12", 12, cycled(MILD, 20), covariances=True, bounds=True),
        point_family("pixels24", 24, cycled((*MILD, "parallel", "NaN"), 24), pixels=True),
        point_family(
            "pixels-covariances12", 12, cycled(ORDINARY, 8), covariances=True, pixels=True
        ),
        times_family("linear12", 12, cycled((*ORDINARY, "parallel", "one axis"), 16), LINEAR),
        times_family("curved12", 12, cycled((*ORDINARY, "parallel", "one axis"), 16), CURVED),
    ]
