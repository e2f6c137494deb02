"""The recorder: what it writes is what calibrate takes, and what a kill leaves can be resumed."""

from __future__ import annotations

import errno
import hashlib
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from suspending import suspend

import jaxcal
from hw.midplane.bracket import Bracket
from hw.recording.check import check_resumable, last_host_time, settings_of
from hw.recording.file import RecordingWriter
from hw.recording.layout import LAYOUT, SELECTED, RecordingHeader
from hw.recording.recorder import Recorder
from jaxcal.cli.main import main
from jaxcal.data.timing import ClockFit

PROBE = {"kind": "linear", "elements": 128, "pitch_mm": 58.5 / 128, "sound_speed_m_s": 1490.0}
HEADER = RecordingHeader(kind="time_of_flight", probe=PROBE, settings='{"placement": "none"}')


def simulated(images: int = 12) -> SimpleNamespace:
    """Poses and times of flight of one target, slightly out of the plane (no JAX: children too)."""
    rng = np.random.default_rng(3)
    image_to_probe = np.eye(4)
    image_to_probe[:3, :3] = Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix()
    image_to_probe[:3, 3] = 5.0, -8.0, 40.0
    place = np.stack([
        rng.uniform(-20, 20, images), rng.uniform(-0.3, 0.3, images), rng.uniform(30, 80, images),
    ], axis=-1)  # fmt: skip
    poses = np.tile(np.eye(4), (images, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, (images, 3))).as_matrix()
    seen = place @ image_to_probe[:3, :3].T + image_to_probe[:3, 3]
    poses[:, :3, 3] = [400.0, 100.0, 50.0] - np.einsum("nij,nj->ni", poses[:, :3, :3], seen)
    element = (np.arange(128) - 63.5) * PROBE["pitch_mm"]
    distance = np.linalg.norm(
        place[:, None] - element[:, None] * np.array([1.0, 0.0, 0.0]), axis=-1
    ) + rng.normal(0, 0.05, (images, 128))
    return SimpleNamespace(poses=poses, times=distance / 1490e3)


def poses(start: int, count: int) -> list[SimpleNamespace]:
    return [
        SimpleNamespace(
            t_host=k * 0.008, t_device=5 + k * 0.008, pose=np.eye(4) * k, raw=np.full(6, k),
            safety_bits=1, robot_mode=7, runtime_state=2,
        )
        for k in range(start, start + count)
    ]  # fmt: skip


def frames(start: int, count: int) -> list[SimpleNamespace]:
    return [
        SimpleNamespace(
            t_host=k / 30, t_device=k / 30, frame_id=k, array=np.full((48, 64), k % 256, np.uint8)
        )
        for k in range(start, start + count)
    ]


def echo(start: int, count: int) -> list[SimpleNamespace]:
    return [
        SimpleNamespace(
            t_host=k / 30, frame=k, ticks=2**40 + k, threshold=100,
            tof_ticks=np.full(128, 65535), amplitude=np.arange(128),
        )
        for k in range(start, start + count)
    ]  # fmt: skip


def take(recorder: Recorder, images: SimpleNamespace, index: int) -> None:
    recorder.add_selected(
        images.poses[index], images.times[index], kind="time_of_flight",
        amplitude=900.0, t_host=float(index), target=index, bracket=Bracket(0.0, -0.5, 0.5, 0.2),
        seconds=4.0,
    )  # fmt: skip


def wait_until_closed(path) -> None:
    """The writer of a killed acquisition closes the file by itself; then it can be opened."""
    deadline = time.monotonic() + 180
    while True:
        try:
            with h5py.File(path, "r+"):
                return
        except BlockingIOError:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def test_an_event_may_name_a_path_that_is_not_utf_8(tmp_path):
    """As the last words of a run, where its disk is full, do."""
    path = tmp_path / os.fsdecode(b"r\xff.h5")
    recorder = Recorder(path, HEADER)
    recorder.add_event("stopped", f"{path.name}: the disk is nearly full", 1.0)
    recorder.finish()
    with h5py.File(os.fsencode(path)) as file:
        assert file["events/text"][0] == rb"r\udcff.h5: the disk is nearly full"


def test_counts_of_the_runs_of_a_recording_add_up(tmp_path):
    path = tmp_path / "r.h5"
    for header, lost, dropped in ((HEADER, 3, 2), (None, 4, 5)):
        with Recorder(path, header) as recorder:
            recorder.counts("us", {"lost": 1})
            recorder.counts("us", {"lost": lost})
            recorder.dropped["us"] = dropped
            recorder.sync()
    with h5py.File(path) as file:
        assert {name: file["us"].attrs[name] for name in ("lost", "dropped")} == {
            "lost": 7, "dropped": 7,
        }  # fmt: skip


def test_the_clocks_of_a_resumed_recording_lead_to_its_shifted_times(tmp_path):
    path = tmp_path / "r.h5"
    Recorder(path, HEADER).close()
    with Recorder(path, time_offset_s=100.0) as recorder:
        recorder.add_poses(poses(0, 1))
        recorder.add_clock("robot", ClockFit(-5.0, 0.0, 5.0, np.array([1e-4])), 1.0)
    with h5py.File(path) as file:
        t_host = file["tracker/t_device"][0] + file["clock/offset"][0]
        assert t_host == pytest.approx(file["tracker/t_host"][0])


def test_an_answer_that_is_none_ends_the_recording(tmp_path):
    """It ended the thread alone, and the next image waited for half a minute."""
    recorder = Recorder(tmp_path / "r.h5", HEADER)
    (tmp_path / "answers").write_bytes(b"printed by a library\n")
    with open(tmp_path / "answers", "rb") as answers:
        recorder._listen(answers)
    with pytest.raises(jaxcal.OutputError, match="JSONDecodeError"):
        recorder.sync()
    with pytest.raises(jaxcal.OutputError, match="JSONDecodeError"):
        recorder.close()


def test_a_digest_that_cannot_be_written_leaves_the_recording_complete(tmp_path):
    """The run failed and advised to resume, which answers that the recording is complete."""
    path = tmp_path / "r.h5"
    recorder = Recorder(path, HEADER)
    (tmp_path / "r.h5.sha256").mkdir()
    assert recorder.finish() == hashlib.sha256(path.read_bytes()).hexdigest()
    assert recorder.digest_error is not None
    assert "r.h5.sha256" in recorder.digest_error
    recorder.close()
    with h5py.File(path) as file:
        assert file.attrs["complete"]


def test_signals_that_end_all_processes_leave_the_writer_to_the_acquisition(tmp_path):
    """At a system's shutdown: why the run has ended must still be written."""
    path = tmp_path / "rec.h5"
    with Recorder(path, HEADER) as recorder:
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            os.kill(recorder._process.pid, number)
        recorder.add_event("stopped", "interrupted", 1.0)
    with h5py.File(path) as file:
        assert file["events/text"][0] == b"interrupted"


def test_what_waits_is_written_though_closing_was_interrupted(tmp_path):
    """Ctrl-C twice: the first has put the run's end into the queue, the second comes meanwhile."""
    path = tmp_path / "rec.h5"
    recorder = Recorder(path, HEADER)
    suspend(recorder._process.pid)
    recorder.add_event("stopped", "interrupted", 1.0)
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        recorder.close()
    os.kill(recorder._process.pid, signal.SIGCONT)
    recorder.close()
    with h5py.File(path) as file:
        assert file["events/text"][0] == b"interrupted"


@pytest.mark.parametrize("waiting", [1, 400])
def test_a_writer_that_dies_while_closing_is_told(tmp_path, waiting):
    """What waits in the queue, or in the pipe, is lost, and nothing was said."""
    recorder = Recorder(tmp_path / "rec.h5", HEADER)
    suspend(recorder._process.pid)
    recorder.add_images(frames(0, waiting))
    threading.Timer(0.2, recorder._process.kill).start()
    with pytest.raises(jaxcal.OutputError, match="ended early; resume"):
        recorder.close()


def test_a_finished_recording_is_what_calibrate_takes(tmp_path, capsys):
    path, recording = tmp_path / "rec.h5", simulated()
    with Recorder(path, HEADER) as recorder:
        recorder.add_event("started", "by a test", 0.0)
        for k in range(12):
            recorder.add_poses(poses(10 * k, 10))
            recorder.add_images(frames(k, 1))
            recorder.add_echo(echo(k, 1))
            take(recorder, recording, k)
        recorder.add_clock("robot", ClockFit(0.1, 1e-5, 0.5, np.array([1e-4])), 1.0)
        recorder.put("truth", "point", np.zeros(3), "mm")
        recorder.put("truth", "elevation", np.zeros(12), "mm")
        recorder.put("truth", "image_to_probe", np.eye(4), "mm")
        recorder.attributes("tracker", {"serial_number": "1", "tcp_offset": [0.0] * 6})
        digest = recorder.finish()
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (tmp_path / "rec.h5.sha256").read_text() == f"{digest}  rec.h5\n"

    loaded = jaxcal.load(path)
    np.testing.assert_array_equal(loaded.calibration.measurements, recording.times)
    np.testing.assert_allclose(loaded.calibration.poses, recording.poses, atol=1e-12)
    np.testing.assert_array_equal(loaded.calibration.max_elevation, np.full(12, 0.5))
    assert main(["calibrate", str(path), "--method", "conventional", "--json"]) == 0
    assert '"images_used": 12' in capsys.readouterr().out
    with h5py.File(path) as file:
        assert file.attrs["complete"]
        assert file["tracker/pose"].shape == (120, 4, 4)
        assert file["tracker/raw_pose"][119, 0] == 119
        assert file["us/frames"][11, 0, 0] == 11
        assert file["ae/clock_ticks"][5] == 2**40 + 5
        assert file["ae/tof_ticks"].attrs["units"] == "1"
        assert file["events/text"][0] == b"by a test"
        assert all(
            "units" in dataset.attrs
            for name in ("tracker", "us", "ae", "events", "clock", "calibration", "estimate")
            for dataset in file[name].values()
        )


ENDLESS = """
import itertools, sys, time
sys.path[:0] = {paths!r}
import test_recorder as t
recording = t.simulated()
with t.Recorder({path!r}, t.HEADER) as recorder:
    print("ready", recorder._process.pid, flush=True)
    for k in itertools.count():
        recorder.add_poses(t.poses(100 * k, 100))
        recorder.add_images(t.frames(k, 1))
        recorder.add_event("again", str(k), float(k))
        if k < 8:
            t.take(recorder, recording, k)
            print(k, flush=True)
        # Busy, but not more than the writer's own work needs.
        time.sleep(0.005)
"""


def acquisition(path) -> tuple[subprocess.Popen, int]:
    here = os.path.dirname(os.path.abspath(__file__))
    paths = [here, os.path.dirname(here), os.path.dirname(os.path.dirname(here))]
    process = subprocess.Popen(
        [sys.executable, "-c", ENDLESS.format(paths=paths, path=str(path))],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    writer = int(process.stdout.readline().split()[1])
    while process.stdout.readline() != "7\n":
        assert process.poll() is None
    return process, writer


@pytest.mark.parametrize("victim", ["acquisition", "writer"])
def test_killed_opened_resumed_finished_calibrated(tmp_path, capsys, victim):
    path = tmp_path / "rec.h5"
    process, writer = acquisition(path)
    time.sleep(1.3)
    os.kill(process.pid if victim == "acquisition" else writer, signal.SIGKILL)
    if victim == "writer":
        assert process.wait(180) == 1  # the acquisition notices
    process.kill()
    process.wait()
    process.stdout.close()
    wait_until_closed(path)

    with h5py.File(path) as file:
        assert not file.attrs["complete"]
        assert len(file["calibration/pose"]) == 8
        assert len(file["tracker/pose"]) >= 800
    assert main(["calibrate", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "incomplete" in error
    assert "--resume" in error
    assert settings_of(path) == {"placement": "none"}

    recording = simulated()
    with Recorder(path) as recorder:
        assert recorder.rows["calibration"] == 8
        start = recorder.rows["tracker"]
        recorder.add_poses(poses(start, 10))
        for k in range(8, 12):
            take(recorder, recording, k)
        recorder.finish()
    loaded = jaxcal.load(path)
    np.testing.assert_array_equal(loaded.calibration.measurements, recording.times)
    with h5py.File(path) as file:
        k = np.arange(start + 10)
        np.testing.assert_array_equal(file["tracker/raw_pose"][:, 0], k)
        assert len(file["us/t_host"]) == len(file["us/frames"])
    assert main(["calibrate", str(path), "--method", "conventional"]) == 0


@pytest.mark.slow
def test_kills_of_the_writer_at_any_moment(tmp_path):
    """Not only between flushes: the writer has no moment at which a kill loses an image."""
    rng = np.random.default_rng(0)
    for k in range(30):
        path = tmp_path / f"{k}.h5"
        process, writer = acquisition(path)
        time.sleep(rng.uniform(0.0, 2.2))
        os.kill(writer, signal.SIGKILL)
        process.wait(180)
        process.stdout.close()
        with Recorder(path) as recorder:
            assert recorder.rows["calibration"] == 8
            assert recorder.rows["tracker"] >= 100
            recorder.finish()
        assert len(jaxcal.load(path)) == 8
        path.unlink()


def test_what_finds_no_room_is_dropped_and_counted_but_no_image_is(tmp_path):
    path, recording = tmp_path / "rec.h5", simulated()
    with Recorder(path, HEADER, queue_bytes=2**20) as recorder:
        suspend(recorder._process.pid)
        for k in range(1000):
            recorder.add_images(frames(k, 1))
        dropped = recorder.dropped["us"]
        assert 500 < dropped < 1000
        os.kill(recorder._process.pid, signal.SIGCONT)
        take(recorder, recording, 0)
        recorder.sync()
    with h5py.File(path) as file:
        assert len(file["us/frames"]) == 1000 - dropped
        assert file["us"].attrs["dropped"] == dropped
        assert len(file["calibration/pose"]) == 1


def test_drops_are_counted_while_more_come(tmp_path):
    """A group that was first dropped meanwhile ended the run with a RuntimeError."""
    path = tmp_path / "rec.h5"
    # No room for anything while something waits.
    with Recorder(path, HEADER, queue_bytes=1) as recorder, ThreadPoolExecutor(1) as pool:
        suspend(recorder._process.pid)
        while not recorder.dropped:
            recorder.add_images(frames(0, 100))
        syncing = pool.submit(recorder.sync)
        time.sleep(0.2)
        while "ae" not in recorder.dropped:
            recorder.add_echo(echo(0, 100))
        os.kill(recorder._process.pid, signal.SIGCONT)
        syncing.result()
    with h5py.File(path) as file:
        assert file["ae"].attrs["dropped"] == recorder.dropped["ae"]


def test_a_disk_that_does_not_answer_or_is_full_is_one_line(tmp_path):
    recorder = Recorder(tmp_path / "slow.h5", HEADER, patience_s=0.3)
    suspend(recorder._process.pid)
    with pytest.raises(jaxcal.OutputError, match=r"took no data for 0\.3 s: check it"):
        recorder.sync()
    os.kill(recorder._process.pid, signal.SIGCONT)
    with pytest.raises(jaxcal.OutputError, match=r"took no data for 0\.3 s: check it"):
        recorder.close()
    RecordingWriter.resume(tmp_path / "slow.h5").close()

    path, recording = tmp_path / "full.h5", simulated()
    recorder = Recorder(path, HEADER)
    take(recorder, recording, 0)
    limit = path.stat().st_size + 100_000
    resource.prlimit(recorder._process.pid, resource.RLIMIT_FSIZE, (limit, limit))

    large = np.zeros((512, 512), np.uint8)

    def fill() -> None:
        for k in range(400):
            recorder.add_images([SimpleNamespace(**{**vars(frames(k, 1)[0]), "array": large})])
            recorder.sync()

    with pytest.raises(jaxcal.OutputError, match="the disk cannot be written any more"):
        fill()
    with pytest.raises(jaxcal.OutputError):
        recorder.close()
    with Recorder(path) as recorder:
        assert recorder.rows["calibration"] == 1

    writer = RecordingWriter.create(tmp_path / "nearly.h5", HEADER)
    writer.flush()
    writer.reserve_bytes = 2**62
    with pytest.raises(jaxcal.OutputError, match="nearly full"):
        writer.flush()
    RecordingWriter.resume(tmp_path / "nearly.h5").close()


def test_a_disk_that_takes_nothing_any_more_is_one_line(tmp_path, capfd):
    """Also not in place of what is there, as where files are copied on write."""
    recorder, recording = Recorder(tmp_path / "full.h5", HEADER), simulated()
    take(recorder, recording, 0)
    resource.prlimit(recorder._process.pid, resource.RLIMIT_FSIZE, (1000, 1000))
    with pytest.raises(jaxcal.OutputError, match="cannot be written"):
        take(recorder, recording, 1)
    with pytest.raises(jaxcal.OutputError):
        recorder.close()
    assert capfd.readouterr().err == ""


def test_a_writer_that_takes_no_data_does_not_hold_the_end_up(tmp_path, monkeypatch):
    """As where a disk hangs: closing waited without end, deaf to Ctrl-C, and said nothing."""
    path, recording = tmp_path / "rec.h5", simulated()
    recorder = Recorder(path, HEADER, queue_bytes=2**20)
    take(recorder, recording, 0)
    recorder._patience = 0.2
    monkeypatch.setattr("hw.recording.recorder._ENDING_S", 0.2)
    suspend(recorder._process.pid)
    for k in range(400):
        recorder.add_images(frames(k, 1))
    assert recorder.dropped["us"]

    def close() -> None:
        with suppress(jaxcal.OutputError):
            recorder.close()

    closing = threading.Thread(target=close)
    closing.start()
    closing.join(20.0)
    held_up = closing.is_alive()
    recorder._process.kill()
    assert not held_up
    assert "did not end" in str(recorder.error)
    monkeypatch.undo()
    with Recorder(path) as again:
        assert again.rows["calibration"] == 1


@contextmanager
def slowed(recorder: Recorder) -> Iterator[None]:
    """Stop the writer for a while whenever it has taken or told something."""
    done, writer = threading.Event(), recorder._process.pid

    def slow() -> None:
        # Once the recording is finished, the writer ends.
        with suppress(ProcessLookupError, ChildProcessError):
            while not done.is_set():
                suspend(writer)
                done.wait(0.15)
                before = recorder._taken
                os.kill(writer, signal.SIGCONT)
                while recorder._taken == before and not done.wait(0.001):
                    pass

    slowing = threading.Thread(target=slow)
    slowing.start()
    try:
        yield
    finally:
        done.set()
        slowing.join()


@pytest.mark.real_time
def test_a_slow_disk_is_waited_for_while_it_takes_data(tmp_path):
    """It was told to have taken nothing, and the end of a long file was as late."""
    path, recording = tmp_path / "rec.h5", simulated()
    image = SimpleNamespace(**{**vars(frames(0, 1)[0]), "array": np.zeros((2048, 2048), np.uint8)})
    with Recorder(path, HEADER) as recorder:
        suspend(recorder._process.pid)
        recorder.add_images([image] * 4)
        recorder._patience = 0.5
        for wait in (partial(take, recorder, recording, 0), recorder.finish):
            began = time.monotonic()
            with slowed(recorder):
                wait()
            assert time.monotonic() - began > 0.5
    with h5py.File(path) as file:
        assert (len(file["us/frames"]), len(file["calibration/pose"])) == (4, 1)
    digest, _ = (path.parent / "rec.h5.sha256").read_text().split()
    with path.open("rb") as file:
        assert hashlib.file_digest(file, "sha256").hexdigest() == digest


def test_a_disk_that_hangs_is_given_up_once(tmp_path, monkeypatch):
    """Each event waited anew, the end as well; then the writer was blamed, and not the disk."""
    recorder = Recorder(tmp_path / "rec.h5", HEADER, queue_bytes=2**16, patience_s=0.3)
    for name in ("_ENDING_S", "_HUNG_ENDING_S"):
        monkeypatch.setattr(f"hw.recording.recorder.{name}", 0.1)
    suspend(recorder._process.pid)
    large = [SimpleNamespace(**{**vars(frames(0, 1)[0]), "array": np.zeros((512, 512), np.uint8)})]
    recorder.add_images(large * 8)
    began = time.monotonic()
    for _ in range(20):
        with pytest.raises(jaxcal.OutputError, match="the disk took no data"):
            recorder.add_event("command", "moveL", 1.0)
    with pytest.raises(jaxcal.OutputError, match="the disk took no data"):
        recorder.close()
    assert time.monotonic() - began < 3.0


def test_files_that_are_not_resumed(tmp_path):
    path = tmp_path / "rec.h5"
    with pytest.raises(jaxcal.FormatError, match="no such file"):
        Recorder(path)
    RecordingWriter.create(path, HEADER).finish()
    with pytest.raises(jaxcal.FormatError, match="is complete"):
        Recorder(path)
    for name, told in (
        ("rec.h5", "exists already: give another name"),
        ("begun.h5", "exists already: resume it, or give another name"),
        (".", "is a directory, not a file"),
        ("no/rec.h5", f"there is no folder {tmp_path / 'no'}"),
        ("n" * 300 + ".h5", "cannot be written: File name too long"),
    ):
        if name == "begun.h5":
            RecordingWriter.create(tmp_path / name, HEADER).close()
        with pytest.raises(jaxcal.OutputError) as caught:
            Recorder(tmp_path / name, HEADER)
        assert str(caught.value) == f"{tmp_path / name}: {told}"

    def spoil(change) -> None:
        path.unlink()
        RecordingWriter.create(path, HEADER).close()
        with h5py.File(path, "r+") as file:
            change(file)
        before = path.read_bytes()
        with pytest.raises(jaxcal.FormatError, match=r"rec\.h5"):
            check_resumable(path)
        with pytest.raises(jaxcal.FormatError, match=r"rec\.h5"):
            Recorder(path)
        assert path.read_bytes() == before

    def elsewhere(file) -> None:
        del file["calibration/pose"]
        file["calibration/pose"] = h5py.ExternalLink("other.h5", "/pose")

    def fixed(file) -> None:
        del file["tracker/pose"]
        file["tracker/pose"] = np.zeros((3, 4, 4))

    def virtual(file) -> None:
        del file["events/t_host"]
        layout = h5py.VirtualLayout((4,), "f8")
        layout[:] = h5py.VirtualSource("other.h5", "x", (4,))
        file["events"].create_virtual_dataset("t_host", layout)

    def type_changed(file) -> None:
        del file["calibration/time"]
        file["calibration"].create_dataset("time", (0,), "S8", maxshape=(None,))

    for change in (
        elsewhere,
        fixed,
        virtual,
        type_changed,
        lambda file: file.__delitem__("ae"),
        lambda file: file.attrs.__setitem__("format", "other"),
    ):
        spoil(change)


def test_a_recording_of_large_images_is_resumed(tmp_path):
    """Images of more than 16 MiB were recorded, and the file was then refused."""
    path, one = tmp_path / "rec.h5", np.ones(1)
    writer = RecordingWriter.create(path, HEADER)
    frames = np.zeros((1, 4200, 4200), np.uint8)
    writer.append("us", {"t_host": one, "t_device": one, "frame_id": one, "frames": frames})
    writer.close()
    assert frames.nbytes > 2**24
    assert RecordingWriter.resume(path).rows["us"] == 1


def test_a_host_time_that_cannot_be_is_not_gone_on_from(tmp_path):
    """All times of the resumed run were infinite."""
    path = tmp_path / "rec.h5"
    texts = {name: np.array([b"x"]) for name in ("utc", "kind", "text")}
    RecordingWriter.create(path, HEADER).close()
    for last_s in (3.0, np.inf):
        assert last_host_time(path) == (0.0 if last_s == 3.0 else 3.0)
        writer = RecordingWriter.resume(path)
        writer.append("events", {"t_host": np.array([last_s]), **texts})
        writer.close()
    with pytest.raises(jaxcal.FormatError, match="a host time of inf s"):
        last_host_time(path)


def test_a_recording_that_a_reader_holds_open_is_not_said_to_be_written(tmp_path):
    path = tmp_path / "rec.h5"
    RecordingWriter.create(path, HEADER).close()
    with (
        h5py.File(path, "r"),
        pytest.raises(jaxcal.OutputError, match="is open in another program: close it there"),
    ):
        Recorder(path)


@pytest.mark.parametrize("seed", [2, 4])
def test_what_a_power_cut_leaves_is_resumed(tmp_path, seed):
    """Some pages written since the last image are on the disk: HDF5's structures are torn.

    Such a file was refused, with all images in it.
    """
    path, recording = tmp_path / "rec.h5", simulated(4)
    writer = RecordingWriter.create(path, HEADER)

    def note(start: int, stop: int) -> None:
        count = stop - start
        text = dict.fromkeys(("utc", "kind", "text"), np.full(count, b"moveL"))
        writer.append("events", {"t_host": np.arange(start, stop, dtype=float), **text})

    note(0, 200)
    ones = dict.fromkeys(("max_elevation", "amplitude", "mask", "time", "target"), np.ones(4))
    images = {"pose": recording.poses, "time_of_flight": recording.times}
    writer.append("calibration", {**images, **ones})
    writer.flush(durable=True)
    before = path.read_bytes()
    note(200, 400)
    writer.flush()
    after = path.read_bytes()
    writer.close()
    old = np.frombuffer(before.ljust(len(after), b"\0")[: len(after)], np.uint8)
    written = np.repeat(np.random.default_rng(seed).random(len(after) // 4096 + 1) < 0.5, 4096)
    path.write_bytes(np.where(written[: len(after)], np.frombuffer(after, np.uint8), old).tobytes())

    RecordingWriter.resume(path).close()
    with h5py.File(path) as file:
        for name, values in images.items():
            np.testing.assert_array_equal(file["calibration"][name], values)
        np.testing.assert_array_equal(file["events/t_host"][:200], np.arange(200.0))
        assert b"salvaged" in file["events/kind"][:]
    assert {each.name for each in tmp_path.iterdir()} == {"rec.h5", "rec.h5.damaged"}
    RecordingWriter.resume(path).finish()


@pytest.mark.parametrize("more", ["calibration", "placement"])
def test_each_image_of_a_resumed_recording_has_its_own_placement(tmp_path, more):
    """A disk that is full between the two rows, or a torn one, shifted all placements to come."""
    path, header = tmp_path / "rec.h5", RecordingHeader("point", PROBE, settings="{}")
    tails = {"pose": (4, 4), "point": (2,)}

    def add(writer: RecordingWriter, name: str, value: float) -> None:
        keys = SELECTED["point"] if name == "calibration" else LAYOUT[name]
        writer.append(name, {key: np.full((1, *tails.get(key, ())), value) for key in keys})

    writer = RecordingWriter.create(path, header)
    for name in ("calibration", "placement", more):
        add(writer, name, 1.0)
    writer.close()
    writer = RecordingWriter.resume(path)
    for name in ("calibration", "placement"):
        add(writer, name, 2.0)
    assert writer.rows["calibration"] == writer.rows["placement"]
    writer.close()
    with h5py.File(path) as file:
        offset, target = file["placement/offset"][()], file["calibration/target"][()]
    between = {"calibration": [1.0, np.nan, 2.0], "placement": [1.0, 2.0]}[more]
    np.testing.assert_array_equal(offset, between)
    np.testing.assert_array_equal(target, [1, 1, 2] if more == "calibration" else [1, 2])


def test_a_folder_without_hard_links_takes_recordings(tmp_path, monkeypatch):
    """As on a USB stick with exFAT: no recording could be made there."""

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "rec.h5"
    RecordingWriter.create(path, HEADER).close()
    with pytest.raises(jaxcal.OutputError, match="exists already: resume it"):
        RecordingWriter.create(path, HEADER)
    assert list(tmp_path.iterdir()) == [path]
    writer = RecordingWriter.resume(path)
    path.unlink()
    assert writer.rescue() == path
    assert check_resumable(path) is False


def test_rows_fit_the_layout_or_are_refused_whole(tmp_path):
    writer = RecordingWriter.create(tmp_path / "rec.h5", HEADER)
    with pytest.raises(jaxcal.FormatError, match="one row in each"):
        writer.append("clock", {"t_host": np.zeros(1)})
    with pytest.raises(jaxcal.FormatError, match="cannot be appended"):
        writer.append("plan", {"t_host": np.zeros(1)})
    good = {"t_host": np.zeros(1), "t_device": np.zeros(1), "frame_id": np.zeros(1)}
    writer.append("us", {**good, "frames": np.zeros((1, 4, 5), np.int16)})
    with pytest.raises(jaxcal.FormatError, match="frame of 5 x 5 px of int16 does not fit this re"):
        writer.append("us", {**good, "frames": np.zeros((1, 5, 5), np.int16)})
    with pytest.raises(jaxcal.FormatError, match="whose frames have 5 x 4 px of int16: set the"):
        writer.append("us", {**good, "frames": np.zeros((1, 4, 5), np.uint8)})
    assert writer.rows["us"] == 1
    writer.close()
