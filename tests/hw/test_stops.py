"""No stop is lost: a sample of experiments/stop_study.py at the rates of both series."""

from __future__ import annotations

import importlib.util
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from robots import address

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")

_PATH = Path(__file__).parents[2] / "experiments" / "stop_study.py"
_SPEC = importlib.util.spec_from_file_location("stop_study", _PATH)
assert _SPEC is not None
assert _SPEC.loader is not None
study = sys.modules["stop_study"] = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(study)


@pytest.mark.parametrize("series", list(study.SERIES))
def test_no_stop_around_a_request_to_move_is_lost(series):
    rng = np.random.default_rng(3)
    edges = np.linspace(study.EARLIEST_S, study.LATEST_S, 3)
    moving = 0
    with study.Bench(series, address()) as bench:
        for way in study.WAYS:
            # One around the request, one when the arm moves.
            for early, late in pairwise(edges):
                trial = bench.trial(way, float(rng.uniform(early, late)))
                assert not trial.lost, trial
                if way in ("guard", "stop"):
                    assert trial.again == "RefusedError"
                    assert ("danger" if way == "guard" else "the operator") in trial.answer
                moving += trial.speed_mm_s > 10.0
    assert moving >= 3
