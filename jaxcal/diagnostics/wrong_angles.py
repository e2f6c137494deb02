"""Rotations as they would be if their angles had been read in another way.

Trackers and robots state Euler angles (roll, pitch and yaw) or rotation vectors. Whoever makes
matrices of them may multiply the three rotations in another order, or take radians for degrees. The
result is a proper rotation, but another one.

For three rotations about different axes i, j, k, with e the sign of this order, the product
R = R_i(a) R_j(b) R_k(c) gives the angles back (Tait-Bryan angles):

    b = arcsin(e R_ik),  a = atan2(-e R_jk, R_kk),  c = atan2(-e R_ij, R_ii)

scipy's ``Rotation`` does the same (the tests compare), but its import takes a quarter of a second,
and these checks are part of every calibration.

Reference: Diebel 2006, "Representing attitude: Euler angles, unit quaternions, and rotation
vectors".
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations

import numpy as np

from jaxcal.data.poses import rotations_from_vectors, vectors_from_rotations
from jaxcal.runtime.array_types import Float

Order = tuple[int, int, int]

ORDERS: tuple[Order, ...] = tuple((i, j, k) for i, j, k in permutations(range(3)))
"""Orders of the three axes, x = 0."""

DEGREES = 180 / np.pi

FEW_DEGREES = 3.2
"""Angles up to 180 degrees, in radians, are at most so large when they are read as degrees."""


def with_other_angles(
    rotations: Float[np.ndarray, "n 3 3"],
) -> Iterator[tuple[str, Float[np.ndarray, "n 3 3"]]]:
    """The common mistakes with angles: words for each, and the corrected rotations.

    Args:
        rotations: of the poses, probe -> tracker.
    """
    for used in ORDERS:
        angles = angles_about_axes(rotations, used)
        for right in ORDERS:
            if right != used:
                yield (
                    f"the poses' rotations were built from Euler angles as {_product(used)}, in "
                    f"place of {_product(right)}",
                    composed(angles, right),
                )
    vectors = vectors_from_rotations(rotations)
    if np.degrees(np.linalg.norm(vectors, axis=1).max()) < FEW_DEGREES:
        words = "angles in radians were read as degrees: the poses hardly turn; convert them once"
        yield words, rotations_from_vectors(DEGREES * vectors)
        for order in ORDERS:
            angles = DEGREES * angles_about_axes(rotations, order)
            yield f"{words} (Euler angles, {_product(order)})", composed(angles, order)


def angles_about_axes(
    rotations: Float[np.ndarray, "n 3 3"], order: Order
) -> Float[np.ndarray, "n 3"]:
    """Angles about x, y and z whose rotations make these ones, multiplied in an order, rad."""
    i, j, k = order
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    angles = np.empty((len(rotations), 3))
    angles[:, i] = np.arctan2(-sign * rotations[:, j, k], rotations[:, k, k])
    angles[:, j] = np.arcsin(np.clip(sign * rotations[:, i, k], -1.0, 1.0))
    angles[:, k] = np.arctan2(-sign * rotations[:, i, j], rotations[:, i, i])
    return angles


def composed(angles: Float[np.ndarray, "n 3"], order: Order) -> Float[np.ndarray, "n 3 3"]:
    """The product of rotations about x, y and z (rad) in an order."""
    each = [rotations_from_vectors(angles[:, axis, None] * np.eye(3)[axis]) for axis in range(3)]
    return each[order[0]] @ each[order[1]] @ each[order[2]]


def _product(order: Order) -> str:
    """The product, and as scipy names it: about rotated axes, or about fixed ones."""
    names = ["xyz"[axis] for axis in order]
    about = "".join(names).upper(), "".join(reversed(names))
    return f"{' '.join(f'R{name}' for name in names)} (scipy's {about[0]} or {about[1]})"
