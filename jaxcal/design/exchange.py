"""Exchange (Fedorov 1972): every chosen pose against the others, until nothing gains.

Greedy poses are the best after those before them, not beside those after them. Each pose is taken
out in turn and the best candidate put in its place, which never makes the plan worse. The first
pass looks at a shortlist only: the candidates that gain most at the greedy plan's end, and every
few of the rest.
"""

from __future__ import annotations

import numpy as np

from jaxcal.design.greedy import Chosen, Search

PASSES = 2
_SHORTLIST = 600
_LEAST_GAIN = 1e-6


def exchange(search: Search, chosen: Chosen, passes: int = PASSES) -> Chosen:
    """Improve what greedy chose; poses that fill space stay.

    Args:
        search: candidates and what is known.
        chosen: by :func:`jaxcal.design.greedy.choose`.
        passes: over all poses.
    """
    rows, information = list(chosen.rows), chosen.information.copy()
    scores = search.scores(information)
    order = np.argsort(-scores)
    spread = order[_SHORTLIST // 2 :: max(len(order) // (_SHORTLIST // 2), 1)]
    shortlist = np.unique(np.concatenate([order[: _SHORTLIST // 2], spread, rows]))
    place = {row: k for k, row in enumerate(shortlist.tolist())}
    counts = search.counts(rows)
    for _ in range(passes):
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
