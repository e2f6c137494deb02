"""No stop is lost: a sample of experiments/stop_study.py at the rates of both series."""

from __future__ import annotations

import importlib.util
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from robots import address

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this platform")

pytestmark = pytest.mark.real_time

_PATH = Path(__file__).parents[2] / "experiments" / "stop_study.py"
_SPEC = importlib.util.spec_from_file_location("stop_study", _PATH)
assert _SPEC is not None
assert _SPEC.loader is not None
study = sys.modules["stop_study"] = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(study)


def trials(series: str) -> list:
    """Around the request in each way, and, in those that test_motion_stops.py lacks, in motion."""
    rng = np.random.default_rng(3)
    edges = np.linspace(study.EARLIEST_S, study.LATEST_S, 3)
    tried = []
    with study.Bench(series, address()) as bench:
        for way in study.WAYS:
            moments = list(pairwise(edges))
            for early, late in moments if way in ("interrupt", "pipe") else moments[:1]:
                tried.append(bench.trial(way, float(rng.uniform(early, late))))
    return tried


def test_no_stop_around_a_request_to_move_is_lost():
    with ThreadPoolExecutor(len(study.SERIES)) as pool:
        tried = [trial for part in pool.map(trials, study.SERIES) for trial in part]
    for trial in tried:
        assert not trial.lost, trial
        if trial.way in ("guard", "stop"):
            assert trial.again == "RefusedError"
            assert ("danger" if trial.way == "guard" else "the operator") in trial.answer
    assert {(trial.series, trial.way) for trial in tried} == set(product(study.SERIES, study.WAYS))
    assert sum(trial.speed_mm_s > 10.0 for trial in tried) >= 2
