"""A scripted person at a terminal follows the injected pattern on the emulated bench."""

from __future__ import annotations

import re
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

pytest.importorskip("pty", reason="there are no pseudo-terminals here")
pytest.importorskip("rtde_control", reason="ur_rtde is not installed (jaxcal[robot])")
pytest.importorskip("serial", reason="pyserial is not installed (jaxcal[serial])")

from terminal import Terminal

ACQUIRE = "import sys; from hw.cli import main; sys.exit(main(sys.argv[1:]))"
KEYS = {"Step down": "j", "Step up": "k", "m lets the robot": "m", "Enter accepts": "\r"}
# The last row of the view: what stands before it is complete.
ASKED = re.compile(
    r"(?P<title>pose \d of 4)(?P<view>(?:(?!pose \d of 4).)*?)"
    r"(?P<advice>Step down|Step up|m lets the robot|Enter accepts)(?:(?!pose \d of 4).)*?: stop",
    re.DOTALL,
)


def answer(person: Terminal, until: str) -> str:
    """Press what the screen says until a line is shown; what was shown meanwhile."""
    began, offset = len(person.shown), None
    deadline = time.monotonic() + 400
    while time.monotonic() < deadline:
        found = person.wait_for(rf"{ASKED.pattern}|{until}", flags=re.DOTALL)
        if found.group("advice") is None:
            return person.shown[began:]
        here = re.findall(r"[+-]\d+\.\d\d mm \|[# ]*\|.*?seen", found.group("view"))[-1]
        # The view is painted again and again while nothing is pressed.
        if here != offset:
            offset = here
            person.type(KEYS[found.group("advice")])
    raise AssertionError("the person was asked for ever")


def test_a_person_takes_an_image_skips_a_pose_and_stops(tmp_path: Path):
    path = tmp_path / "rec.h5"
    arguments = ["acquire", str(path), "--bench", "--bench-seed", "3", "--images", "4",
                 "--placement", "pattern-injection", "--operator", "person"]  # fmt: skip
    with Terminal(["-c", ACQUIRE, *arguments], tmp_path) as person:
        person.wait_for("p pauses, Ctrl-C stops", 240)
        # Steps twice as large: as few as a bar that must be seen to shrink allows.
        person.wait_for("step 0.25 mm", 240)
        person.type("+")
        person.wait_for("step 0.50 mm")
        shown = answer(person, "image 1/4: offset|resume")
        assert "image 1/4: offset" in shown
        # The frame as half blocks, the bar, and how it went by place.
        assert shown.count("▀") > 1000
        assert "#" * 25 in shown
        assert "▇" in shown
        person.wait_for(ASKED.pattern, flags=re.DOTALL)
        person.type("s")
        person.wait_for("skipped: pose 2: the operator gave up the pose")
        # On the way to the next pose.
        person.type("\x03")
        assert person.finish() == 130
        assert "1 of 4 images are in" in person.shown
        assert "Traceback" not in person.shown
    with h5py.File(path) as file:
        low, high, true = (
            np.asarray(file[f"placement/{name}"]) for name in ("low", "high", "true_elevation")
        )
        assert len(true) == 1
        assert low[0] < true[0] < high[0]
        # As wide as the rule's brackets are.
        assert 1.0 < high[0] - low[0] < 3.0
        assert '"operator": "person"' in bytes(file["plan/settings"][()]).decode()
