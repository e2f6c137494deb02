"""Hostile files and folders, and disks that fail: attacks through the file system."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

EVIL = "open({mark!r}, 'a').write(__name__ + chr(10))\nraise SystemExit('a stranger ran')\n"
SHADOWED = (
    "h5py", "queue", "select", "json", "runpy", "numpy", "subprocess", "hw/__init__",
    "hw/robot/__init__", "hw/robot/_mover", "hw/recorder_process", "jaxcal/__init__",
)  # fmt: skip


@pytest.fixture
def hostile(tmp_path: Path) -> tuple[Path, Path]:
    """A folder of data with modules of our names in it, and the file that they write to if run."""
    folder, mark = tmp_path / "data", tmp_path / "ran"
    for name in SHADOWED:
        path = folder / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(EVIL.format(mark=str(mark)))
    return folder, mark


HELPERS = """
import sys
from hw.bench.arm import Arm
from hw.bench.robot import START, RobotProcess
from hw.bench.run import start_bench
from hw.recorder import Recorder
from hw.recording_layout import Header
from hw.robot._process import spawn

probe = {"kind": "linear", "elements": 8, "pitch_mm": 0.5, "sound_speed_m_s": 1490.0}
with Recorder("rec.h5", Header(kind="time_of_flight", probe=probe)) as recorder:
    recorder.finish()
mover = spawn("hw.robot._mover", stdin=True)
mover.communicate()
reader = spawn("hw.robot._reader")
reader.communicate()
with RobotProcess(Arm(START), sys.argv[1]) as robot:
    assert robot.serial
start_bench(pose_hz=125).close()
"""


def test_no_helper_process_runs_a_file_of_the_current_folder(hostile):
    pytest.importorskip("serial", reason="pyserial is not installed")
    folder, mark = hostile
    address = f"127.77.{os.getpid() // 250 % 250}.{1 + os.getpid() % 250}"
    done = subprocess.run(
        [sys.executable, "-P", "-c", HELPERS, address],
        cwd=folder, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert not mark.exists(), mark.read_text()
    assert done.returncode == 0, done.stderr
    assert (folder / "rec.h5.sha256").exists()


@pytest.mark.parametrize("program", ["jaxcal", "jaxcal-hw"])
def test_no_console_script_runs_a_file_of_the_current_folder(hostile, program):
    folder, mark = hostile
    script = Path(sys.executable).with_name(program)
    if not script.exists():
        pytest.skip("the console scripts are not installed")
    done = subprocess.run([script, "--help"], cwd=folder, capture_output=True, check=False)
    assert not mark.exists(), mark.read_text()
    assert done.returncode == 0, done.stderr
