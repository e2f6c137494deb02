"""Were two targets marked in turn, or have some images another origin than the others?

Then the target of image i is c + s_i t / 2 with s_i = 1 or -1, or its point is off by s_i t / 2
within the image. With e the errors, J their derivatives by the unknowns and K_i those of image i by
the target or by the point, s and t are alternately fitted to e + J d + s K t / 2, from several
directions of t. Elevational errors do not tell the two groups apart, as offsets may come in two
groups as well.

The best of the 2^n ways to divide n images fits better by chance, too: 2 ln LR grows with n.
``experiments/unmodelled`` counts clean recordings that exceed the limit, and recordings of two
targets that do not.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from jaxcal.diagnostics.gaussian_offsets import leverage, shortened, tuned
from jaxcal.runtime.array_types import Bool, Float

Array = np.ndarray

FEWEST = 20
"""With fewer images in use a second target is not looked for: chance would imitate it."""
BY_CHANCE = 3.0
"""What 2 ln LR must exceed, for each image."""
_LEAST_SHARE = 0.15
"""Least share of the images in the smaller group: fewer may be as many outliers."""
_ROUNDS = 20
"""Most rounds of dividing and fitting."""
_MOST_SEARCHED = 150
"""Of more images, so many, evenly spread, are divided first."""
_DIRECTIONS = {
    size: np.array([d for d in product((-1, 0, 1), repeat=size) if d > (0,) * size], float)
    for size in (2, 3)
}
"""Directions from which t is looked for: axes, and diagonals of faces and of the cube."""


class TwoGroups(NamedTuple):
    """Two groups of images that explain the errors.

    Attributes:
        statistic: 2 ln LR.
        apart: from the target or the origin of most images to that of the others: in the tracker's
            frame, or laterally and axially, mm.
        other: which images are of the smaller group.
        step: of the unknowns.
    """

    statistic: float
    apart: Float[Array, " k"]
    other: Bool[Array, " n"]
    step: Float[Array, " p"]


def two_groups(
    errors: Float[Array, "n 3"], rows: Float[Array, "n 3 q"], size: int, before: Float[Array, " 3"]
) -> TwoGroups | None:
    """Two groups, if the errors of n images show them.

    Args:
        errors: in any unit of each kind.
        rows: J and, as the last columns, K; zero for elevational errors.
        size: number of components of t: 3 for two targets, 2 for two origins.
        before: mean squared errors of each kind without groups.
    """
    count, unknowns = len(errors), rows.shape[-1] - size
    known, along = rows[..., :unknowns], 0.5 * rows[..., unknowns:]

    def fitted(side: Array, some: Array) -> tuple[Array, Array, float]:
        # Mean squared errors that a division leaves, the step, and 2 ln LR.
        both = np.concatenate([known[some], side[:, None, None] * along[some]], axis=-1)
        fewer, of_fewer = shortened(errors[some], both)
        after, step = tuned(fewer, of_fewer, len(some))
        freedom = len(some) - leverage(of_fewer, after)
        return after, step, float(np.sum(freedom * np.log(before / after)))

    every = np.arange(count)
    some = np.unique(np.linspace(0, count - 1, _MOST_SEARCHED).astype(int))
    side = _divided(errors[some], known[some], along[some], 1 / np.sqrt(before))
    after, step, _ = fitted(side, some)
    statistic, side = 0.0, np.zeros(count)
    for _ in range(_ROUNDS):
        base, half = errors + known @ step[:unknowns], along @ step[unknowns:]
        last, side = side, _nearer(base, half, 1 / np.sqrt(after))
        if (side == last).all():
            break
        after, step, statistic = fitted(side, every)
        if count > _MOST_SEARCHED and statistic < BY_CHANCE * count / 2:
            # Further rounds gain little, and take long.
            return None
    most = np.sign(side.sum() or 1)
    other = side != most
    if statistic <= BY_CHANCE * count or other.sum() < _LEAST_SHARE * count:
        return None
    return TwoGroups(statistic, -most * step[unknowns:], other, step[:unknowns])


def _nearer(
    base: Float[Array, "n 3"], half: Float[Array, "n 3"], weight: Float[Array, " 3"]
) -> Float[Array, " n"]:
    """1 where an error is smaller with half of t added, -1 where it is with that subtracted."""
    return np.where(np.sum(base * half * weight**2, axis=1) <= 0, 1.0, -1.0)


def _divided(
    errors: Float[Array, "n 3"],
    known: Float[Array, "n 3 p"],
    along: Float[Array, "n 3 k"],
    weight: Float[Array, " 3"],
) -> Float[Array, " n"]:
    """How images are best divided, of the divisions from all first directions; the SDs stay."""
    basis = np.linalg.qr((known * weight[:, None]).reshape(-1, known.shape[-1]))[0]
    alone = (errors * weight).ravel()
    alone -= basis @ (basis.T @ alone)
    found = []
    for direction in _DIRECTIONS[along.shape[-1]]:
        base, half = alone.reshape(-1, 3) / weight, along @ direction
        side, squares = np.zeros(len(errors)), np.inf
        for _ in range(_ROUNDS):
            last, side = side, _nearer(base, half, weight)
            if (side == last).all():
                break
            moved = (side[:, None, None] * along * weight[:, None]).reshape(-1, along.shape[-1])
            moved -= basis @ (basis.T @ moved)
            t = -np.linalg.lstsq(moved, alone, rcond=None)[0]
            rest, half = alone + moved @ t, along @ t
            squares = float(rest @ rest)
            # Without the second target, but with the unknowns that fit best beside it.
            base = rest.reshape(-1, 3) / weight - side[:, None] * half
        found.append((squares, side))
    return min(found, key=lambda each: each[0])[1]
