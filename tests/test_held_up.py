"""Tests that run again if the machine held them up: which do, how often, and what is told."""

from __future__ import annotations

import math

import held_up
import pytest

pytest_plugins = ("pytester",)

TESTS = """
import sys, time
import pytest

runs = []

def hold_up():
    before = sys.getswitchinterval()
    sys.setswitchinterval(1.0)
    try:
        end = time.monotonic() + 0.05
        while time.monotonic() < end:
            pass
    finally:
        sys.setswitchinterval(before)

@pytest.mark.real_time
def test_once():
    runs.append("once")
    hold_up()
    assert runs.count("once") == 2

@pytest.mark.real_time
def test_always():
    runs.append("always")
    hold_up()
    assert False

def test_of_other_things():
    runs.append("other")
    hold_up()
    assert False

def test_runs():
    assert [runs.count(name) for name in ("once", "always", "other")] == %s
"""


@pytest.fixture
def outer(pytester: pytest.Pytester) -> pytest.Pytester:
    pytester.makeconftest(
        "from held_up import pytest_runtest_protocol, pytest_terminal_summary\n"
        "def pytest_configure(config):\n"
        "    config.addinivalue_line('markers', 'real_time: fine deadlines')\n"
    )
    return pytester


def test_a_failure_counts_unless_the_machine_held_the_test_up(outer, monkeypatch):
    monkeypatch.setattr(held_up, "ATTEMPTS", 3)
    outer.makepyfile(TESTS % [2, 3, 1])
    done = outer.runpytest_inprocess("-p", "no:cacheprovider")
    done.assert_outcomes(passed=2, failed=2)
    done.stdout.fnmatch_lines(["*run again, since the machine held them up*", "*::test_once"])
    assert "test_always (" not in done.stdout.str()


def test_a_failure_on_a_quiet_machine_counts_at_once(outer, monkeypatch):
    monkeypatch.setattr(held_up, "EXCUSED_REAL_TIME_S", math.inf)
    outer.makepyfile(TESTS % [1, 1, 1])
    done = outer.runpytest_inprocess("-p", "no:cacheprovider")
    done.assert_outcomes(passed=1, failed=3)
    assert "run again" not in done.stdout.str()
