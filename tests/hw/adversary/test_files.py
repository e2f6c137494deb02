"""Hostile files and folders, and disks that fail: attacks through the file system."""

from __future__ import annotations

import json
import os
import resource
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_setups import GOOD

import jaxcal
from hw.acquisition.acquire import acquire as run_acquisition
from hw.cli.main import main as acquire
from hw.recording.check import check_resumable, read_progress
from hw.recording.file import RecordingWriter
from hw.recording.layout import LAYOUT, RecordingHeader
from hw.recording.recorder import Recorder
from hw.recording.resuming import compare, described
from hw.robot.limits import Limits
from hw.runtime.errors import RefusedError
from hw.setup.description import Setup, load_setup
from jaxcal.cli.main import main as study
from jaxcal.io.toml import parse_toml

PROBE = {"kind": "linear", "elements": 8, "pitch_mm": 0.5, "sound_speed_m_s": 1490.0}
HEADER = RecordingHeader(kind="time_of_flight", probe=PROBE)

EVIL = "open({mark!r}, 'a').write(__name__ + chr(10))\nraise SystemExit('a stranger ran')\n"
SHADOWED = (
    "h5py", "queue", "select", "json", "runpy", "numpy", "subprocess", "hw/__init__",
    "hw/robot/__init__", "hw/robot/mover/__init__", "hw/recording/__init__",
    "hw/recording/writer_process", "jaxcal/__init__",
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
from hw.recording.recorder import Recorder
from hw.recording.layout import RecordingHeader
from hw.runtime.processes import spawn

probe = {"kind": "linear", "elements": 8, "pitch_mm": 0.5, "sound_speed_m_s": 1490.0}
with Recorder("rec.h5", RecordingHeader(kind="time_of_flight", probe=probe)) as recorder:
    recorder.finish()
mover = spawn("hw.robot.mover", stdin=True)
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
        cwd=folder, capture_output=True, text=True, check=False, timeout=300,
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


# -- HDF5


@pytest.fixture(scope="module")
def complete(tmp_path_factory) -> bytes:
    """A small recording that loads."""
    path = tmp_path_factory.mktemp("files") / "rec.h5"
    writer = RecordingWriter.create(path, HEADER)
    for k in range(6):
        select(writer, k)
    writer.finish()
    return path.read_bytes()


def select(writer: RecordingWriter, k: int, elements: int = 8) -> None:
    """A selected image: any times of flight."""
    pose, bracket = np.eye(4), dict.fromkeys(LAYOUT["placement"], np.ones(1))
    pose[0, 3] = k
    writer.append("calibration", {
        "pose": pose[None], "time_of_flight": np.full((1, elements), 4e-5),
        "max_elevation": np.ones(1),
        "amplitude": np.ones(1), "mask": np.ones(1, bool), "time": np.array([float(k)]),
        "target": np.array([k]),
    })  # fmt: skip
    writer.append("placement", bracket)


LOAD = """
import sys, time, jaxcal
from jaxcal.io.hdf5 import load
began = time.process_time()
try:
    load(sys.argv[1])
except jaxcal.FormatError as error:
    print(time.process_time() - began, error)
"""


def endless(content: bytes) -> bytes:
    """The first object of the first heap of text gets the size 0: HDF5 never gets past it."""
    changed = bytearray(content)
    heap = changed.index(b"GCOL")
    changed[heap + 16 : heap + 32] = struct.pack("<HHIQ", 0, 1, 0, 0)
    return bytes(changed)


def test_a_looping_heap_is_refused_in_a_file_of_more_than_a_gibibyte(tmp_path, complete):
    path = tmp_path / "rec.h5"
    path.write_bytes(endless(complete))
    os.truncate(path, 2**30 + 2**12)
    # In a process that can be killed: HDF5 loops in C, where no signal and no time-out ends it.
    done = subprocess.run(
        [sys.executable, "-c", LOAD, path], capture_output=True, text=True, timeout=300, check=False
    )
    seconds, _, line = done.stdout.partition(" ")
    assert f"{path}: is damaged: a heap of text cannot be followed to its end\n" == line
    assert float(seconds) < 2.0
    # The same bytes without the loop: a large file loads, and what is after the end costs nothing.
    path.write_bytes(complete)
    os.truncate(path, 2**40)
    began = time.process_time()
    assert len(jaxcal.load(path)) == 6
    assert time.process_time() - began < 2.0


def test_heaps_without_number_or_end_take_no_time(tmp_path, complete):
    def refused_soon(content: bytes, match: str, size: int = 0) -> None:
        path = tmp_path / "rec.h5"
        path.write_bytes(content)
        os.truncate(path, max(size, len(content)))
        began = time.process_time()
        with pytest.raises(jaxcal.FormatError, match=match):
            jaxcal.load(path)
        assert time.process_time() - began < 3.0

    huge = bytearray(complete)
    heap = huge.index(b"GCOL")
    huge[heap + 8 : heap + 16] = (2**33).to_bytes(8, "little")
    refused_soon(bytes(huge), "a heap of text claims 8589934592 bytes", 2**34)

    path = tmp_path / "many.h5"
    path.write_bytes(complete)
    with h5py.File(path, "r+") as file:
        del file["calibration/pose"]
        like = np.frombuffer(b"GCOL\1\0\0\0" + (2**20).to_bytes(8, "little"), float)
        file["calibration/pose"] = np.tile(like, 2**20 * 3).reshape(-1, 4, 4)[:100_000]
        file["calibration/pose"].attrs["units"] = "mm"
    refused_soon(path.read_bytes(), "heap")


# -- TOML

SETUP = GOOD.replace("[scene]", "[probe]\nelements = 64\n[scene]")
BOMBS = {
    "dotted key": (f"a{'.b' * 60_000} = 1\n", "a key of more than 8 parts in line 1"),
    "dotted key with spaces": (f'"a" {". b" * 60_000} = 1\n', "a key of more than 8 parts"),
    "dotted table": (f"[a{'.b' * 60_000}]\n", "a key of more than 8 parts"),
    "many keys": ("\n".join(f"a{k}=1" for k in range(20_000)), "more than 10000 keys in line 10"),
    "many tables": ("[[a]]\n" * 20_000, "more than 10000 keys"),
    "digits": (f"a = {'1' * 5001}\n", "a number of 5001 characters in line 1"),
    "10^400": (f"\na = -1{'0' * 400}\n", "a number of 402 characters in line 2"),
    "arrays": (f"a = {'[' * 50_000}\n", "nested more than 16 deep"),
    "inline tables": (f"a = {'{a=' * 5000}\n", "nested more than 16 deep"),
    "quotes": ('a = """' + '\\"""' * 50_000, "a string that does not end"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_toml_bomb_is_one_line_at_once(tmp_path, capsys, name):
    content, what = BOMBS[name]
    path = tmp_path / "bomb.toml"
    began = time.process_time()
    for table, read in (
        (SETUP, lambda: acquire(["acquire", "--setup", str(path), "--images", "4"])),
        ("", lambda: study(["study", "run", str(path), "--out", str(tmp_path / "out")])),
    ):
        path.write_text(content + table)
        assert read() == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1
        assert f"{path}: is not TOML" in line
        assert what in line
    assert time.process_time() - began < 10.0


@pytest.mark.parametrize("value", ["1e400", "-inf", "nan", "9" * 99, "1979-05-27", "{}"])
def test_numbers_that_are_none_or_too_large_are_one_line(tmp_path, capsys, value):
    path = tmp_path / "bench.toml"
    for old in ("max_speed_mm_s = 50", "elements = 64"):
        name = old.split()[0]
        path.write_text(SETUP.replace(old, f"{name} = {value}"))
        assert acquire(["acquire", "--setup", str(path), "--images", "4"]) == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1
        assert "internal error" not in line
    with pytest.raises(RefusedError):
        Limits.from_mapping({"max_speed_mm_s": 10**400})


def test_toml_with_all_that_toml_has_is_read():
    text = (
        'a = """x [[[ "" """""\nb.c."d.e.f.g.h.i.j" = 1.5 # """ [[[\r\n'
        "c = '''[\n{'''\nd = [[[1]]]\n"
        "e = [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5]"
    )
    assert parse_toml(text) == {
        "a": 'x [[[ "" ""', "b": {"c": {"d.e.f.g.h.i.j": 1.5}}, "c": "[\n{", "d": [[[1]]],
        "e": [k + 0.5 for k in range(9)],
    }  # fmt: skip


# -- disks that fail, files that go

WRITE = """
import sys
from types import SimpleNamespace
import numpy as np
from hw.midplane.bracket import Bracket
from hw.recording.recorder import Recorder
from hw.recording.layout import RecordingHeader
from jaxcal import CalibrationError
probe = {"kind": "linear", "elements": 8, "pitch_mm": 0.5, "sound_speed_m_s": 1490.0}
recorder = Recorder(sys.argv[1], RecordingHeader(kind="time_of_flight", probe=probe))
frame = np.full((128, 128), 7, np.uint8)
try:
    for k in range(4000):
        recorder.add_images([SimpleNamespace(t_host=k, t_device=k, frame_id=k, array=frame)])
        if k % 20 == 0:
            recorder.add_selected(
                np.eye(4), np.full(8, 4e-5), kind="time_of_flight", amplitude=1.0,
                t_host=k, target=k // 20, bracket=Bracket(0.0, -1.0, 1.0, 0.5),
            )
            print(k // 20 + 1, flush=True)
            input()
except CalibrationError as error:
    try:
        recorder.close()
    except CalibrationError:
        pass
    print("kept", recorder.kept)
    print("error", error)
"""


class Writing:
    """An acquisition's recorder in a process of its own, which takes an image when asked."""

    def __init__(self, path: Path, file_bytes: int = resource.RLIM_INFINITY) -> None:
        self.path, self.images = path, 0
        self._process = subprocess.Popen(
            [sys.executable, "-B", "-c", WRITE, path], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes,) * 2),
        )  # fmt: skip

    def take(self) -> bool:
        """Have an image taken; False when the recorder has failed."""
        if self.images:
            self._process.stdin.write("\n")
            self._process.stdin.flush()
        line = self._process.stdout.readline().split()
        if line[0] == "kept":
            self.kept = Path(line[1])
            self._error = self._process.stdout.readline().strip()
            return False
        self.images = int(line[0])
        return True

    def error(self) -> str:
        """What the recorder failed of; nothing else was said."""
        assert self._process.stderr.read() == ""
        return self._error

    def __enter__(self) -> Writing:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()


def whole(path: Path, images: int) -> None:
    """Without resuming it opens in h5py and has these images; then it can be resumed."""
    with h5py.File(path) as file:
        assert not file.attrs["complete"]
        assert list(file["calibration/target"]) == list(range(images))
        times = np.full((images, 8), 4e-5)
        np.testing.assert_array_equal(file["calibration/time_of_flight"], times)
        rows = len(file["us/frames"])
        assert rows > 20 * (images - 1)
        np.testing.assert_array_equal(file["us/frames"][()], np.full((rows, 128, 128), 7))
    with Recorder(path) as recorder:
        assert recorder.rows["calibration"] == images
        recorder.finish()
    assert len(jaxcal.load(path)) == images


def test_a_limit_of_a_files_size_ends_in_a_file_that_opens(tmp_path):
    limit = 5_123_456
    with Writing(tmp_path / "rec.h5", limit) as writing:
        while writing.take():
            pass
        what = "the disk cannot be written any more: File too large: free some space"
        assert writing.error() == f"error {writing.path}: {what}"
    assert writing.kept == writing.path
    assert writing.images >= 2
    assert writing.path.stat().st_size <= limit
    whole(writing.path, writing.images)


@pytest.mark.parametrize("what", ["removed", "moved", "replaced"])
def test_a_file_that_goes_while_it_is_written_is_noticed_and_nothing_is_lost(tmp_path, what):
    path, away = tmp_path / "rec.h5", tmp_path / "away.h5"
    with Writing(path) as writing:
        assert all(writing.take() for _ in range(3))
        if what == "removed":
            path.unlink()
        else:
            path.rename(away)
        if what == "replaced":
            path.write_bytes(b"other")
        while writing.take():
            assert writing.images < 5
        noticed = "replaced by another file" if what == "replaced" else "removed"
        line = f"error {path}: was {noticed} while it was being recorded"
        assert writing.error() == line
    assert writing.kept == (path if what == "removed" else away)
    assert not path.with_name("rec.h5.sha256").exists()
    if what == "replaced":
        assert path.read_bytes() == b"other"
    # The image that noticed it was written, too.
    whole(writing.kept, 4)


def test_the_digest_is_of_what_was_written(tmp_path):
    """Replaced at the last moment, after the last flush, by a file of the same length."""
    path = tmp_path / "rec.h5"
    recorder = Recorder(path, HEADER)
    recorder.sync()
    os.replace(shutil.copy(path, tmp_path / "copy.h5"), path)
    with pytest.raises(jaxcal.OutputError, match="was replaced by another file"):
        recorder.finish()
    assert not path.with_name("rec.h5.sha256").exists()


# -- resuming on another bench


def interrupted(path: Path, setup: Setup, *, old: bool = False) -> None:
    """A recording with one image of a plan of two, as an acquisition leaves it."""
    targets = np.tile(np.eye(4), (2, 1, 1))
    probe = setup.probe
    attributes = {
        "kind": "linear", "elements": probe.elements, "pitch_mm": probe.pitch_mm,
        "sound_speed_m_s": probe.sound_speed_m_s, "delay_s": probe.delay_s,
    }  # fmt: skip
    settings = {"request": {"images": 4}}
    if not old:
        settings["bench"] = described(setup, targets)
    header = RecordingHeader(kind="time_of_flight", probe=attributes, settings=json.dumps(settings))
    writer = RecordingWriter.create(path, header)
    writer.put("plan", "targets", targets, "mm")
    select(writer, 0, probe.elements)
    writer.close()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("elements = 64", "elements = 64\npitch_mm = 0.6", "[probe] pitch_mm = "),
        ("elements = 64", "elements = 64\nsound_speed_m_s = 1540", "[probe] sound_speed_m_s = "),
        ("elements = 64", "elements = 65", "[probe] elements = "),
        ("[0, 0, 1, 60]", "[0, 0, 1, 61]", "[scene] image_to_probe = "),
        ("[350, -250, 80]", "[350, -250, 81]", "[scene] point_mm = "),
    ],
)
def test_another_probe_or_scene_is_refused_by_name(tmp_path, old, new, said):
    bench, path = tmp_path / "bench.toml", tmp_path / "rec.h5"
    bench.write_text(SETUP)
    interrupted(path, load_setup(bench), old=said == "[probe] pitch_mm = ")
    bench.write_text(SETUP.replace(old, new))

    def never(_):
        raise AssertionError("asked to confirm")

    with pytest.raises(jaxcal.InputError) as caught:
        run_acquisition(load_setup(bench), path, None, never)
    assert f"{path}: was recorded with {said}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_other_limits_and_an_edited_plan_are_said(tmp_path):
    bench, path = tmp_path / "bench.toml", tmp_path / "rec.h5"
    bench.write_text(SETUP)
    setup = load_setup(bench)
    interrupted(path, setup)
    assert compare(read_progress(path), setup) == []
    with h5py.File(path, "r+") as file:
        file["plan/targets"][1, 0, 3] += 5.0
    bench.write_text(SETUP.replace("max_speed_mm_s = 50", "max_speed_mm_s = 250"))
    changes = compare(read_progress(path), load_setup(bench))
    assert "'max_speed_mm_s' was 50, is 250" in changes[0]
    assert "the plan in the file is not the one" in changes[1]
    assert len(changes) == 2


@pytest.mark.parametrize("ours", [False, True])
def test_a_file_cut_short_is_lengthened_only_where_it_is_ours(tmp_path, ours):
    bench, path = tmp_path / "bench.toml", tmp_path / "rec.h5"
    bench.write_text(SETUP)
    if ours:
        interrupted(path, load_setup(bench))
    else:
        with h5py.File(path, "w") as file:
            file["something"] = np.zeros(100_000)
    os.truncate(path, path.stat().st_size - 64)
    before = path.read_bytes()
    if not ours:
        with pytest.raises(jaxcal.FormatError):
            Recorder(path)
        assert path.read_bytes() == before
        return
    check_resumable(path)
    assert path.read_bytes() == before
    with Recorder(path) as recorder:
        assert recorder.rows["events"] == 0
