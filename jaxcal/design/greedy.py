"""Greedy choice, and exchange: each pose is the one that gains most in addition to those before it.

By default every fifth pose fills space instead: it is the one that gains most among those that
reduce the candidates' mean distance to the nearest chosen pose nearly as much as any could. The
optimum consists of a few poses, which would not show that the model is wrong elsewhere. The number
of replicates is limited, since errors that belong to a pose (the response of the target, the
tracker's field) do not average out over its replicates.

Cost: with m candidates and k sets of SDs, each pose takes k products of 3m x 9 with 9 x 9.

*Exchange* (Fedorov 1972). The greedy choice makes each pose the best in addition to those before
it, but not in addition to those after it. So each pose is taken out in turn and replaced by the
best candidate, which never makes the plan worse, until nothing improves. Only a shortlist of
candidates is tried: those that gain most at the end of the greedy plan, and an even selection of
the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxcal import InputError
from jaxcal.design.candidates import Candidates
from jaxcal.design.criteria import gains
from jaxcal.design.information import covariance_of
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.given_values import is_number, whole_number

MOST_POSES = 2000
"""Of one plan."""

COVERING = 0.8
"""A pose fills space if it reduces the distances by at least this share of what the best one does
(our choice)."""

_PASSES = 2
"""Largest number of passes of the exchange over all poses."""
_SHORTLIST = 600
LEAST_GAIN = 1e-6
"""In ln of the criterion; for less no pose is exchanged or moved."""
_TOGETHER = 256
"""Number of poses that are compared with the candidates at a time."""


@dataclass(frozen=True)
class Rules:
    """Rules that a plan keeps in addition to the constraints.

    Attributes:
        space_filling: share of the poses that fill space.
        replicates: largest number of poses that are alike.
        apart_deg: two poses are alike if their orientations are less than this apart and the target
            moves by less than ``apart_mm`` in the image.
        apart_mm: see ``apart_deg``.
    """

    space_filling: float = 0.2
    replicates: int = 2
    apart_deg: float = 5.0
    apart_mm: float = 8.0

    def __post_init__(self) -> None:
        if not (is_number(self.space_filling) and 0 <= self.space_filling <= 1):
            raise InputError(f"space_filling must be 0 to 1, not {self.space_filling!r}")
        whole_number("replicates", self.replicates, 1, MOST_POSES)
        for name in ("apart_deg", "apart_mm"):
            if not (is_number(value := getattr(self, name)) and value >= 0):
                raise InputError(f"{name} must be zero or a positive number, not {value!r}")


@dataclass
class Search:
    """Input that greedy, exchange and polish share: candidates, known information and rules.

    Attributes:
        rows: (k, m, 3, p) G of the candidates under every set of SDs.
        factors: (k, 3) factors on the SDs.
        known: (k, p, p) information before the plan.
        weight: W, or None for the D criterion.
        rules: space filling and replicates.
        rotations: (m, 9) orientations of the candidates, to find poses that are alike.
        places: (m, 3) places of the target in the image, for the same purpose.
        taken_rotations: (t, 9) orientations of the images taken already.
        taken_places: (t, 3) places of the target in these images.
    """

    rows: Float[np.ndarray, "k m 3 p"]
    factors: Float[np.ndarray, "k 3"]
    known: Float[np.ndarray, "k p p"]
    weight: Float[np.ndarray, "p p"] | None
    rules: Rules
    rotations: Float[np.ndarray, "m 9"]
    places: Float[np.ndarray, "m 3"]
    taken_rotations: Float[np.ndarray, "t 9"]
    taken_places: Float[np.ndarray, "t 3"]

    def information_of(self, index: int) -> Float[np.ndarray, "k p p"]:
        """G'G of a candidate under every set of SDs."""
        return np.einsum("kia,kib->kab", self.rows[:, index], self.rows[:, index])

    def scores(
        self, information: Float[np.ndarray, "k p p"], chosen: slice | np.ndarray = slice(None)
    ) -> Float[np.ndarray, " m"]:
        """The gain of each candidate, as the mean over the sets of SDs."""
        total = 0.0
        for rows, covariance in zip(self.rows, covariance_of(information), strict=True):
            total = total + gains(rows[chosen], covariance, self.weight)
        return np.asarray(total) / len(self.rows)

    def alike(self, row: int) -> Bool[np.ndarray, " m"]:
        """Which candidates are replicates of one of them."""
        turn, place = self.rotations[[row]], self.places[[row]]
        return are_alike(self.rotations, self.places, turn, place, self.rules)[:, 0]

    def counts(self, rows: Sequence[int]) -> Float[np.ndarray, " m"]:
        """For each candidate, how many poses are alike: images taken already and these rows."""
        found = np.zeros(len(self.rotations))
        rotations = np.concatenate([self.taken_rotations, self.rotations[rows]])
        places = np.concatenate([self.taken_places, self.places[rows]])
        # Poses that are alike have the target within a short stretch along the image.
        order, apart = np.argsort(places[:, 0]), self.rules.apart_mm
        for start in range(0, len(order), _TOGETHER):
            others = order[start : start + _TOGETHER]
            left, right = places[others[[0, -1]], 0] + [-apart, apart]
            near = np.flatnonzero((self.places[:, 0] >= left) & (self.places[:, 0] <= right))
            turns, seen = self.rotations[near], self.places[near]
            alike = are_alike(turns, seen, rotations[others], places[others], self.rules)
            found[near] += alike.sum(axis=1)
        return found


def are_alike(
    rotations: Float[np.ndarray, "m 9"],
    places: Float[np.ndarray, "m 3"],
    other_rotations: Float[np.ndarray, "t 9"],
    other_places: Float[np.ndarray, "t 3"],
    rules: Rules,
) -> Bool[np.ndarray, "m t"]:
    """Which poses are like which others."""
    apart = ((places.T[:, :, None] - other_places.T[:, None]) ** 2).sum(axis=0)
    found = apart < rules.apart_mm**2
    # Few have the target in the same place, and only of these are the angles needed.
    one, other = np.nonzero(found)
    cosine = 0.5 * (np.einsum("pk,pk->p", rotations[one], other_rotations[other]) - 1)
    found[one, other] = cosine > np.cos(np.radians(rules.apart_deg))
    return found


def space_features(candidates: Candidates) -> Float[np.ndarray, "m 5"]:
    """The five numbers as shares of what the constraints allow, to measure distances of poses."""
    return candidates.numbers / np.maximum(candidates.constraints.extent, 1e-3)


class Cover:
    """Distances from all parts of the candidates' space to the nearest pose.

    Args:
        features: (m, 5) of the candidates (:func:`space_features`).
        taken: (t, 5) of the images taken already, which are the first poses.
    """

    _REFERENCES = 400

    def __init__(self, features: Float[np.ndarray, "m 5"], taken: Float[np.ndarray, "t 5"]) -> None:
        references = features[:: max(len(features) // self._REFERENCES, 1)]
        self._apart = _apart(features, references)
        self._nearest = _apart(taken, references).min(axis=0, initial=np.inf)

    @property
    def begun(self) -> bool:
        """Whether there is a pose already."""
        return bool(np.isfinite(self._nearest[0]))

    def add(self, row: int) -> None:
        """Add a candidate to the poses."""
        self._nearest = np.minimum(self._nearest, self._apart[row])

    def filled_by(self, open_to: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
        """Which of the open candidates fill space, at least one."""
        gains = np.maximum(self._nearest - self._apart, 0.0).sum(axis=1)
        gains = np.where(open_to, gains, -np.inf)
        return open_to & (gains >= COVERING * gains.max())


def _apart(
    first: Float[np.ndarray, "m 5"], second: Float[np.ndarray, "r 5"]
) -> Float[np.ndarray, "m r"]:
    square = (first**2).sum(1)[:, None] + (second**2).sum(1) - 2 * first @ second.T
    return np.sqrt(np.maximum(square, 0.0))


@dataclass
class Chosen:
    """The chosen poses.

    Attributes:
        rows: indices of the chosen candidates, in order.
        filling: which of them fill space.
        information: (k, p, p) information with all of them.
    """

    rows: list[int]
    filling: list[bool]
    information: Float[np.ndarray, "k p p"]


def choose(
    search: Search,
    count: int,
    cover: Cover | None = None,
    cost_s: Float[np.ndarray, " m"] | None = None,
) -> Chosen:
    """Choose ``count`` candidates one after the other.

    Args:
        search: candidates and what is known.
        count: how many.
        cover: the candidates' space; None if no pose fills it.
        cost_s: seconds that each candidate takes; gains per second are then compared.
    """
    rows, fillings, information = [], [], search.known
    alike = search.counts([])
    free = np.ones(len(search.places), bool)
    share = search.rules.space_filling
    for k in range(count):
        open_to = free & (alike < search.rules.replicates)
        if not open_to.any():
            # With few candidates, poses that are alike are better than none.
            open_to = free if free.any() else np.ones_like(free)
        due = int((k + 1) * share + 1e-9) > int(k * share + 1e-9)
        filling = False
        if cover is not None and cover.begun and due:
            open_to, filling = cover.filled_by(open_to), True
        value = search.scores(information)
        value = value if cost_s is None else value / cost_s
        row = int(np.argmax(np.where(open_to, value, -np.inf)))
        information = information + search.information_of(row)
        alike += search.alike(row)
        if cover is not None:
            cover.add(row)
        free[row] = False
        rows.append(row)
        fillings.append(filling)
    return Chosen(rows, fillings, information)


def exchange(search: Search, chosen: Chosen) -> Chosen:
    """Improve what greedy chose; poses that fill space stay."""
    rows, information = list(chosen.rows), chosen.information.copy()
    scores = search.scores(information)
    order = np.argsort(-scores)
    spread = order[_SHORTLIST // 2 :: max(len(order) // (_SHORTLIST // 2), 1)]
    shortlist = np.unique(np.concatenate([order[: _SHORTLIST // 2], spread, rows]))
    place = {row: k for k, row in enumerate(shortlist.tolist())}
    counts = search.counts(rows)
    for _ in range(_PASSES):
        moved = False
        for k, row in enumerate(rows):
            if chosen.filling[k]:
                continue
            without = information - search.information_of(row)
            value = search.scores(without, shortlist)
            own = search.alike(row)
            open_to = (counts - own)[shortlist] < search.rules.replicates
            open_to[[place[other] for other in rows]] = False
            open_to[place[row]] = True
            best = int(shortlist[np.argmax(np.where(open_to, value, -np.inf))])
            if best == row or value[place[best]] - value[place[row]] < LEAST_GAIN:
                continue
            rows[k], moved = best, True
            information = without + search.information_of(best)
            counts += search.alike(best) - own.astype(float)
        if not moved:
            break
    return Chosen(rows, list(chosen.filling), information)
