"""Today's answers are those that were recorded: a sample of the golden corpus, by public calls.

The whole of it is compared by ``python tests/golden/check.py``; see ``tests/golden/README.md``.
"""

from __future__ import annotations

import numpy as np
import pytest
from golden import corpus, draws

SAMPLE = (
    ("points12", "conventional", "batch"),
    ("points12", "auto", "one"),
    ("points12", "auto", "batch"),
    ("points24", "conventional", "one"),
)
"""The default path of one problem and of a batch with what both begin with; and covariances that
are widened for errors in successive images, for which the others have too few of them."""

DEFAULT_OF_ALL = [
    pytest.param(name, call.name, road, marks=pytest.mark.slow)
    for name, calls in corpus.CALLS.items()
    for call in calls
    for road in call.roads
    if call.name.startswith("auto") and (name, call.name, road) not in SAMPLE
    if road == "batch" or not name.endswith("12")
]
"""The default of every family: what its own images do to the answer shows in it alone. One problem
differs from a batch where there are enough images to see whether successive errors are alike."""


@pytest.mark.parametrize(("name", "call", "road"), [*SAMPLE, *DEFAULT_OF_ALL])
def test_answers_are_those_recorded(name, call, road):
    family, answers = corpus.load(name)
    recorded = answers[call, road]
    found = corpus.compute(family, family.call(call), road)
    early = corpus.stopped_early(family, call, road)
    for decision, rows in corpus.flips(recorded, found).items():
        assert early[rows].all(), f"{decision} of problems {rows[~early[rows]]}"
        assert decision != "status_code"
    for number, values in corpus.differences(recorded, found).items():
        values = np.where(early, np.nan, values)
        if number == "cost":
            # Of exact data residuals and floored SDs are rounding, and so is their quotient.
            values = np.where([kind == "exact" for kind in family.kinds], np.nan, values)
        worst = int(np.nanargmax(values))
        limit = corpus.tolerance(name, call, number)
        assert values[worst] <= limit, f"{number} of problem {worst} ({family.kinds[worst]})"


@pytest.mark.parametrize("name", corpus.CALLS)
def test_files_hold_what_the_table_says(name):
    """Complete, in float64, by a named commit, and able to tell answers apart."""
    family, answers = corpus.load(name)
    assert set(answers) == {(call.name, road) for call in corpus.CALLS[name] for road in call.roads}
    assert len(family.written["commit"]) >= 40
    for (call, road), recorded in answers.items():
        statuses = recorded["status_code"]
        assert len(statuses) == len(family)
        assert (statuses == 0).sum() >= len(family) / 2, (call, road)
        assert recorded["image_to_probe"].dtype == np.float64
        unsound = np.array([kind == "NaN" for kind in family.kinds])
        assert set(statuses[unsound]) <= ({3} if road == "batch" else {-1})


def test_the_corpus_has_300_problems():
    assert sum(len(corpus.load(name)[0]) for name in corpus.CALLS) == 300
    assert [family.name for family in draws.families()] == list(corpus.CALLS)


def test_differences_are_in_standard_deviations():
    """Move an answer by a known part of its SD: that is what is found, and nothing else is."""
    _, answers = corpus.load("points12")
    recorded = answers["auto", "one"]
    moved = {name: values.copy() for name, values in recorded.items()}
    row = 0
    first = np.sqrt(recorded["covariance"][row, 0])
    # Along the image's lateral axis.
    moved["image_to_probe"][row, :, 3] += 1e-5 * first * recorded["image_to_probe"][row, :, 0]
    found = corpus.differences(recorded, moved)
    assert found["X"][row] == pytest.approx(1e-5, rel=1e-6)
    assert np.nanmax(np.delete(found["X"], row)) == 0
    assert np.nanmax(found["point"]) == 0
    moved["weighed"][row] ^= True
    moved["status_code"][3] = 1
    assert {name: rows.tolist() for name, rows in corpus.flips(recorded, moved).items()} == {
        "weighed": [row],
        "status_code": [3],
    }
    assert corpus.tolerance("points12", "auto", "X") < 1e-5
