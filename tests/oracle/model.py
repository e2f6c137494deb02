"""What an image measures, and the unknowns; derivatives by complex steps.

With q_i = X^-1 B_i^-1 c the target in image i, x_i and r_i the measured lateral position and range:
lateral error q_x - x, range error hypot(q_y, q_z) - r, offset q_y; or q - (x, y, sqrt(r^2 - y^2))
for a point at offset y; or |q - e_k| / s + d less the distance that element k heard.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

SIZE = {"translation": 3, "rotation": 3, "point": 3, "scale": 2, "sound-speed": 1, "delay": 1}
RIGID = ("translation", "rotation", "point")
NOTHING = np.zeros(3)
TINY = 1e-30
"""The complex step: its square is nothing beside one, so derivatives are exact to rounding."""


@dataclass(frozen=True)
class Data:
    """The used images of one problem; mm unless ``spacing`` says what a pixel is.

    Attributes:
        rotation: (n, 3, 3) of B_i.
        origin: (n, 3) of B_i, mm.
        measured: (n, 2) lateral position and range.
        spacing: (2,) mm a pixel.
        covariance: (n, 2, 2) of ``measured``, or None.
        bound: (n,) on |offset|, mm, or None.
        distances: (n, elements) one-way distances at nominal sound speed, mm, or None.
        heard: (n, elements) which of them count.
        elements: (elements, 3) mm.
    """

    rotation: np.ndarray
    origin: np.ndarray
    measured: np.ndarray
    spacing: np.ndarray
    covariance: np.ndarray | None = None
    bound: np.ndarray | None = None
    distances: np.ndarray | None = None
    heard: np.ndarray | None = None
    elements: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.measured)

    def shape(self) -> np.ndarray:
        """The covariances with mean variances of one, in each direction apart."""
        assert self.covariance is not None
        mean = np.einsum("nkk->nk", self.covariance).mean(axis=0)
        return self.covariance / np.sqrt(np.outer(mean, mean))


@dataclass(frozen=True)
class Unknowns:
    """X (rotation, translation), target, pixel scales, factor on the sound speed, delay in mm."""

    rotation: np.ndarray
    translation: np.ndarray
    point: np.ndarray
    scale: np.ndarray
    speed: complex = 1.0
    delay: complex = 0.0

    def moved(self, step: np.ndarray, blocks: tuple[str, ...]) -> Unknowns:
        """X Exp([v, w]) with v in X's axes; point and delay added; scale and speed by exp."""
        part, at = {}, 0
        for name in blocks:
            part[name] = step[at : at + SIZE[name]]
            at += SIZE[name]

        # A block that is not among them stays.
        return Unknowns(
            self.rotation @ turn(part["rotation"]) if "rotation" in part else self.rotation,
            self.translation + self.rotation @ part.get("translation", NOTHING),
            self.point + part.get("point", NOTHING),
            self.scale * np.exp(part["scale"]) if "scale" in part else self.scale,
            self.speed * np.exp(part["sound-speed"][0]) if "sound-speed" in part else self.speed,
            self.delay + part["delay"][0] if "delay" in part else self.delay,
        )


def turn(w: np.ndarray) -> np.ndarray:
    """exp of the cross product matrix K, by its series (complex w allowed).

    K^3 = -(w . w) K, so the odd and the even terms sum to numbers times K and K^2.
    """
    x, y, z = w.tolist()
    if not (x or y or z):
        return np.eye(3)
    square = x * x + y * y + z * z
    odd = even = 0.0
    first, k = 1.0, 1
    while abs(first) > 1e-18:
        odd, even = odd + first, even + first / (k + 1)
        first, k = -first * square / ((k + 1) * (k + 2)), k + 2
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + odd * cross + even * (cross @ cross)


def size(blocks: tuple[str, ...]) -> int:
    """Number of scalar unknowns."""
    return sum(SIZE[name] for name in blocks)


def place(blocks: tuple[str, ...], name: str) -> slice:
    """Where a block stands."""
    at = size(blocks[: blocks.index(name)])
    return slice(at, at + SIZE[name])


def target(data: Data, u: Unknowns) -> np.ndarray:
    """q_i, (n, 3), mm."""
    in_probe = np.einsum("nji,nj->ni", data.rotation, u.point - data.origin)
    return (in_probe - u.translation) @ u.rotation


def points(data: Data, u: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Lateral position and range in mm."""
    lateral, distance = (data.measured * data.spacing * u.scale).T
    return lateral, (distance - u.delay) * u.speed


def errors(data: Data, u: Unknowns) -> np.ndarray:
    """(n, 3): lateral error, range error, offset."""
    q = target(data, u)
    lateral, distance = points(data, u)
    return np.array([q[:, 0] - lateral, np.sqrt(q[:, 1] ** 2 + q[:, 2] ** 2) - distance, q[:, 1]]).T


def circle(data: Data, u: Unknowns, y: np.ndarray) -> np.ndarray:
    """(n, 3): q - p(y)."""
    lateral, distance = points(data, u)
    return target(data, u) - np.array([lateral, y + 0 * distance, np.sqrt(distance**2 - y**2)]).T


def channels(data: Data, u: Unknowns) -> np.ndarray:
    """(n, elements) distance errors."""
    assert data.distances is not None
    away = target(data, u)[:, None] - data.elements
    return data.heard * (np.sqrt((away**2).sum(axis=2)) / u.speed + u.delay - data.distances)


def jacobian(residual: Callable[[np.ndarray], np.ndarray], count: int) -> np.ndarray:
    """(rows, count) derivatives of a residual at zero, by complex steps."""
    columns = []
    for k in range(count):
        step = np.zeros(count, complex)
        step[k] = 1j * TINY
        columns.append(residual(step).imag.ravel() / TINY)
    return np.stack(columns, axis=1)


def linear_start(data: Data, blocks: tuple[str, ...]) -> Unknowns:
    """A conventional fit with a free 3 x 2 matrix for X's columns, then made a rotation."""
    count = len(data)
    lateral, distance = (data.measured * data.spacing).T
    rows = np.zeros((count, 3, 12))
    rows[:, :, 0:3] = data.rotation * lateral[:, None, None]
    rows[:, :, 3:6] = data.rotation * distance[:, None, None]
    rows[:, :, 6:9] = data.rotation
    rows[:, :, 9:12] = -np.eye(3)
    found = np.linalg.lstsq(rows.reshape(-1, 12), -data.origin.ravel(), rcond=None)[0]
    first, third = found[:3], found[3:6]
    scale = np.ones(2)
    if "scale" in blocks:
        scale = np.array([np.linalg.norm(first), np.linalg.norm(third)])
    first, third = first / np.linalg.norm(first), third / np.linalg.norm(third)
    left, _, right = np.linalg.svd(np.stack([first, third], axis=1), full_matrices=False)
    first, third = (left @ right).T
    rotation = np.stack([first, np.cross(third, first), third], axis=1)
    u = Unknowns(rotation, found[6:9], found[9:12], scale)
    # The rest of the linear unknowns, with the rotation held.
    q_part = np.einsum(
        "nij,nj->ni",
        data.rotation,
        np.stack([lateral * scale[0], 0 * lateral, distance * scale[1]], 1) @ rotation.T,
    )
    known = np.concatenate([data.rotation, np.tile(-np.eye(3), (count, 1, 1))], axis=2)
    rest = np.linalg.lstsq(known.reshape(-1, 6), -(q_part + data.origin).ravel(), rcond=None)[0]
    return replace(u, translation=rest[:3], point=rest[3:])
