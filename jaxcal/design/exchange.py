"""Exchange (Fedorov 1972): replace chosen poses by better candidates until nothing improves.

The greedy choice makes each pose the best in addition to those before it, but not in addition to
those after it. Each pose is taken out in turn and replaced by the best candidate, which never makes
the plan worse. Only a shortlist of candidates is tried: those that gain most at the end of the
greedy plan, and an even selection of the rest.
"""

from __future__ import annotations

import numpy as np

from jaxcal.design.greedy import Chosen, Search

_PASSES = 2
"""Largest number of passes over all poses."""
_SHORTLIST = 600
_LEAST_GAIN = 1e-6


def exchange(search: Search, chosen: Chosen) -> Chosen:
    """Improve what greedy chose; poses that fill space stay.

    Args:
        search: candidates and what is known.
        chosen: by :func:`jaxcal.design.greedy.choose`.
    """
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
            own = search.alike(search.rotations[row], search.places[row])
            open_to = (counts - own)[shortlist] < search.rules.replicates
            open_to[[place[other] for other in rows]] = False
            open_to[place[row]] = True
            best = int(shortlist[np.argmax(np.where(open_to, value, -np.inf))])
            if best == row or value[place[best]] - value[place[row]] < _LEAST_GAIN:
                continue
            rows[k], moved = best, True
            information = without + search.information_of(best)
            counts += search.alike(search.rotations[best], search.places[best]) - own.astype(float)
        if not moved:
            break
    return Chosen(rows, list(chosen.filling), information)
