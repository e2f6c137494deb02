"""Tests against emulators run again if they failed while the machine held this process up."""

from __future__ import annotations

import gc
import sys
import threading
import time
import warnings
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

_TICK_S = 0.005
_HARDWARE = Path(__file__).parent / "hw"

ATTEMPTS = 10
"""Most runs of a test against emulators that was held up."""

EXCUSED_S, EXCUSED_REAL_TIME_S = 0.1, 0.015
"""Delays of this process that excuse a failed test of ``tests/hw``, and a ``real_time`` one."""

RUN_AGAIN = "run again"


class HeldUp:
    """Watches from entering to leaving; a context manager.

    Attributes:
        longest_s: the longest delay of a thread that only sleeps, wall s.
    """

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._leaving = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="held up", daemon=True)

    def __enter__(self) -> HeldUp:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._leaving.is_set():
            due = time.monotonic() + _TICK_S
            self._leaving.wait(_TICK_S)
            self.longest_s = max(self.longest_s, time.monotonic() - due)


def _excused_s(item: pytest.Item) -> float | None:
    if item.get_closest_marker("real_time") is not None:
        return EXCUSED_REAL_TIME_S
    return EXCUSED_S if _HARDWARE in item.path.parents else None


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a test against emulators again if it failed while the machine held this process up.

    Such a failure says nothing about deadlines of a tenth of a second. On a machine that holds
    nothing up the first failure counts. The summary names the tests that were run again.
    """
    excused_s = _excused_s(item)
    if excused_s is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for attempt in range(ATTEMPTS):
        with HeldUp() as held_up:
            reports = runtestprotocol(item, log=False, nextitem=nextitem)
        failed = any(report.failed for report in reports)
        if not failed or held_up.longest_s < excused_s:
            break
        item.user_properties = [(RUN_AGAIN, attempt + 1)]
        # What the failed run left open is not the next one's fault.
        for name in ("last_type", "last_value", "last_traceback", "last_exc"):
            vars(sys).pop(name, None)
        with warnings.catch_warnings(action="ignore"):
            gc.collect()
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """The tests that were run again: one that is named on a quiet machine may have a fault."""
    again = {
        report.nodeid: dict(report.user_properties)[RUN_AGAIN]
        for report in terminalreporter.stats.get("passed", [])
        if RUN_AGAIN in dict(report.user_properties)
    }
    if again:
        terminalreporter.section("run again, since the machine held them up")
        for name, times in again.items():
            terminalreporter.line(f"{name} ({times} times)" if times > 1 else name)
