"""A hand-held probe: sockets, an emulated PlusServer in a process of its own, a scripted person."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from plus_server import (
    COLUMNS,
    ROWS,
    SPACING_MM,
    TARGET_MM,
    frame,
    holds,
    image_to_probe,
    messages,
)
from scipy.spatial.transform import Rotation
from test_ultrasound import peer
from waiting import until

import jaxcal
from hw.acquisition.outcome import calibrate_and_print
from hw.cli.main import main
from hw.freehand.acquire import acquire_free_hand, agreement
from hw.freehand.guide import Guide, Rules, Taken, orientation_sds
from hw.freehand.posed import PosedImage, PosedImages
from hw.freehand.request import FreeHand, FreeHandStopped
from hw.recording.layout import RecordingHeader
from hw.recording.recorder import Recorder
from hw.robot.identity import read_identity
from hw.robot.rtde import PacketReader
from hw.runtime.clock import REAL
from hw.runtime.errors import DeviceError
from hw.runtime.interrupts import as_interrupts
from hw.ultrasound.receiver import Image, UltrasoundStream
from jaxcal import FormatError, InputError
from jaxcal.io.message_content import Picture, Tracked
from jaxcal.io.openigtlink import Message, encode

SERVER = Path(__file__).with_name("plus_server.py")


class PlusServer:
    """Serves what is asked for; its hand holds still for a moment, so it has its own process."""

    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process

    def __call__(self, **asked) -> int:
        """The port at which it is served."""
        self._tell(asked=asked)
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())["port"]

    def seen(self, port: int, count: int) -> None:
        """The frames of one more pose were seen."""
        self._tell(port=port, seen=count)

    def _tell(self, **told: object) -> None:
        print(json.dumps(told), file=self._process.stdin, flush=True)


@pytest.fixture(scope="module")
def plus_server() -> Iterator[PlusServer]:
    with subprocess.Popen(
        [sys.executable, str(SERVER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield PlusServer(process)
        process.kill()


@pytest.fixture(scope="module")
def separate(plus_server) -> int:
    """Port of a server of separate messages, which begins anew for every client."""
    return plus_server(mode="separate")


@pytest.fixture(scope="module")
def tracked(plus_server) -> int:
    """The same of tracked frames: five images of it give a calibration that is uncertain."""
    return plus_server(mode="tracked", order=[0, 1, 2, 3, 4])


class Scripted:
    """Presses a key after a line that matches; keeps what was shown."""

    def __init__(self, **presses: str) -> None:
        self.lines: list[str] = []
        self._patience = time.monotonic() + 240.0
        self.words: set[str] = set()
        self.advice: set[str] = set()
        self._presses, self._pending = presses, []

    def show(self, frame: np.ndarray, words: str, advice: str) -> None:
        assert frame.shape in ((ROWS, COLUMNS), (100, 140))
        assert time.monotonic() < self._patience, words
        self.words.add(re.sub(r"[\d.]+", "#", words))
        self.advice.add(advice)

    def say(self, line: str) -> None:
        self.lines.append(line)
        for pattern in list(self._presses):
            if re.search(pattern.replace("_", " "), line):
                self._pending.append(self._presses.pop(pattern))

    def key(self) -> str | None:
        key = self._pending.pop(0) if self._pending else None
        if key == "ctrl-c":
            raise KeyboardInterrupt
        return key


class Leading(Scripted):
    """Leads the hand to its next pose once something was said of the images of this one."""

    def __init__(self, server: PlusServer, port: int, **presses: str) -> None:
        super().__init__(**presses)
        self._server, self._port, self._seen = server, port, 0

    def show(self, frame: np.ndarray, words: str, advice: str) -> None:
        super().show(frame, words, advice)
        if not words.startswith(("moving", "hold still")) and frame[0, 0] != self._seen:
            self._seen = int(frame[0, 0])
            self._server.seen(self._port, self._seen)


def check(path: Path, wanted: int, *, among: Collection[int] = range(9), count: int = 9) -> None:
    """The recording's images are those of poses that were held, each of another pose.

    The hand does not wait: a machine that is busy with other work may miss a pose that was held,
    and takes the image of a later one.
    """
    poses, pixels = holds(count, 1)
    images = jaxcal.load(path).calibration
    used = images.mask
    assert used.sum() == wanted
    assert images.frame_size == (COLUMNS, ROWS)
    away = images.poses[used][:, None, :3, 3] - poses[:, :3, 3]
    order = np.linalg.norm(away, axis=2).argmin(axis=1)
    assert len(set(order)) == wanted
    assert set(order) <= set(among)
    assert np.abs(away[np.arange(wanted), order]).max() < 0.1
    turn = images.poses[used][:, :3, :3].swapaxes(1, 2) @ poses[order][:, :3, :3]
    assert Rotation.from_matrix(turn).magnitude().max() < 1e-3
    error = images.measurements[used] - pixels[order]
    assert np.abs(error).max() < 0.6
    found = np.einsum("ni,nij,nj->n", error, np.linalg.inv(images.covariance[used]), error)
    assert found.mean() < 8


def test_a_run_from_the_command_line(tmp_path, capsys, tracked):
    """Five images give a calibration that is uncertain, which the exit status says."""
    path = tmp_path / "rec.h5"
    assert main(["free-hand", f"127.0.0.1:{tracked}", str(path), "--images", "5"]) == 5
    told = capsys.readouterr()
    assert "poses from Probe to Reference" in told.err
    assert "image 4 (5 of 5)" in told.err
    assert "Uncertain: expect points of the image to be " in told.out
    # On one line, to be copied, however long the path is.
    assert f"  jaxcal calibrate {path} --estimate scale --report report.html\n" in told.out
    check(path, 5)


@pytest.mark.slow
def test_a_run_from_the_command_line_to_a_calibration(tmp_path, capsys, plus_server):
    path = tmp_path / "rec.h5"
    port = plus_server(mode="tracked", poses=14)
    arguments = [f"127.0.0.1:{port}", str(path), "--images", "12"]
    assert main(["free-hand", *arguments]) == 0
    told = capsys.readouterr()
    assert "poses from Probe to Reference" in told.err
    assert "image 11 (12 of 12)" in told.err
    assert "the images agree to" in told.err
    check(path, 12, among=range(14), count=14)
    with h5py.File(path) as file:
        assert file.attrs["complete"]
        assert file["us/frames"].shape == (12, ROWS, COLUMNS)
        assert {b"started", b"finished"} <= set(file["events/kind"][()])
    found = jaxcal.calibrate(jaxcal.load(path), "conventional", estimate="scale").numpy()
    truth = image_to_probe()
    turn = Rotation.from_matrix(found.image_to_probe[:3, :3].T @ truth[:3, :3]).magnitude()
    assert np.degrees(turn) < 2
    assert np.linalg.norm(found.image_to_probe[:3, 3] - truth[:3, 3]) < 1.5
    np.testing.assert_allclose(found.point, TARGET_MM, atol=1.0)
    assert SPACING_MM[0] > SPACING_MM[1]


def test_images_and_transforms_apart(tmp_path, separate):
    asked = FreeHand("127.0.0.1", separate, images=4, spacing_mm=SPACING_MM)
    assert acquire_free_hand(tmp_path / "r.h5", asked, Scripted()) == 4
    check(tmp_path / "r.h5", 4)
    images = jaxcal.load(tmp_path / "r.h5").calibration
    np.testing.assert_array_equal(images.spacing_mm, SPACING_MM)
    assert jaxcal.load(tmp_path / "r.h5").pose_frames == ("Probe", "Reference")


def test_what_is_not_taken_is_said(tmp_path, plus_server):
    """Out of view, nothing credible, and a pose that was there before; u takes an image back."""
    order = [0, 1, 2, 1, 3, 4, 5, 6]
    port = plus_server(mode="separate", led=True, order=order, lost=[3], hidden=[4])
    person = Leading(plus_server, port, image_2="u")
    asked = FreeHand("127.0.0.1", port, images=5)
    assert acquire_free_hand(tmp_path / "r.h5", asked, person) == 5
    assert "not tracked: ProbeToTracker is not tracked" in person.words
    assert any(words.startswith("no credible target: nothing stands out") for words in person.words)
    assert any(words.startswith("as in image #") for words in person.words)
    assert {"moving: bring the target into the image and hold still", "hold still"} <= person.words
    assert any(line.startswith("taken back: the last image; 2 are left") for line in person.lines)
    # Numbers are those of the recording, also after one was taken back: --leave-out takes them.
    told = [re.match(r"image (\d) \((\d) of 5\): target at", line) for line in person.lines]
    assert [each.groups() for each in told if each] == [
        ("0", "1"), ("1", "2"), ("2", "3"), ("3", "3"), ("4", "4"), ("5", "5")
    ]  # fmt: skip
    mask = jaxcal.load(tmp_path / "r.h5").calibration.mask
    assert mask.tolist() == [True, True, False, True, True, True]
    assert any("bring the target to the" in advice for advice in person.advice)
    # The third was taken back while its pose was still held, and so taken again; or not.
    images = jaxcal.load(tmp_path / "r.h5").calibration
    assert (len(images), int(images.mask.sum())) == (6, 5)
    assert not images.mask[2]


def test_the_image_that_does_not_agree_is_named():
    poses, pixels = holds(12, 1)
    rows = [0, 1, *range(3, 13)]
    taken = [
        Taken(pose, pixel, np.eye(2), 0.0, row=row)
        for pose, pixel, row in zip(poses, pixels, rows, strict=True)
    ]
    astray = [replace(each, pixel=each.pixel + np.array([20.0, 0.0])) for each in taken]
    assert agreement(taken[:5], SPACING_MM) == ""
    assert re.fullmatch(r"; the images agree to \d\.\d\d mm", agreement(taken, SPACING_MM))
    # By its number in the recording, in which one was taken back.
    told = r"; the images agree to \d+\.\d\d mm; image {} stands out by \d+\.\d mm"
    earlier = [*taken[:3], astray[3], *taken[4:]]
    assert re.fullmatch(told.format(4), agreement(earlier, SPACING_MM))
    last = [*taken[:11], astray[11]]
    assert re.fullmatch(told.format(12) + r" \(u removes it\)", agreement(last, SPACING_MM))


def test_a_lost_stream_is_gone_on_with(tmp_path, plus_server):
    path, person = tmp_path / "r.h5", Scripted()
    asked = {"mode": "tracked", "poses": 9}
    port = plus_server(**asked, dies_after=110)
    wanted = FreeHand("127.0.0.1", port, images=7)
    with pytest.raises(FreeHandStopped, match="has closed the connection") as stopped:
        acquire_free_hand(path, wanted, person)
    assert stopped.value.exit_code == 4
    assert re.search(r"[1-6] of 7 images are in .*r\.h5; go on with: jaxcal-hw free-hand",
                     str(stopped.value))  # fmt: skip
    with pytest.raises(FormatError, match="incomplete"):
        jaxcal.load(path)
    with h5py.File(path) as file:
        before = len(file["calibration/pose"])
    # As after a run on another day, whose clock counted from another moment.
    with Recorder(path, time_offset_s=1000.0) as recorder:
        recorder.add_event("later", "", REAL.now())
    port = plus_server(**asked, first=before)
    again = FreeHand("127.0.0.1", port)
    interrupting = Scripted(image_5="ctrl-c")
    with pytest.raises(FreeHandStopped, match="interrupted; 6 of 7") as stopped:
        acquire_free_hand(path, again, interrupting, resume=True)
    assert stopped.value.exit_code == 130
    assert acquire_free_hand(path, again, Scripted(), resume=True) == 7
    poses, _ = holds(9, 1)
    images = jaxcal.load(path).calibration
    away = np.linalg.norm(images.poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    assert len(images) == 7
    assert away.min(axis=1).max() < 0.1
    assert len(set(away.argmin(axis=1))) == 7
    with h5py.File(path) as file:
        assert (np.diff(file["events/t_host"]) >= 0).all()
        assert file["us/t_host"][-1] > 1000.0
        # These are the sender's.
        assert np.abs(np.diff(file["calibration/time"])).max() < 500.0


def test_too_few_images_stay_resumable(tmp_path, tracked):
    asked = FreeHand("127.0.0.1", tracked, images=9)
    with pytest.raises(FreeHandStopped, match="1 images are too few: 4 are needed"):
        acquire_free_hand(tmp_path / "r.h5", asked, Scripted(image_0="q"))


def test_poses_in_metres_are_noticed_at_the_second_image(tmp_path, tracked, plus_server):
    path = tmp_path / "r.h5"
    port = plus_server(mode="tracked", metres=True)
    asked = FreeHand("127.0.0.1", port, images=4)
    with pytest.raises(FreeHandStopped, match="look like metres; give them in mm; 0 of 4 im"):
        acquire_free_hand(path, asked, Scripted())
    with h5py.File(path) as file:
        assert not file.attrs["complete"]
        assert file["calibration/mask"][()].tolist() == [False]
    # Once the server sends mm, it goes on.
    assert acquire_free_hand(path, FreeHand("127.0.0.1", tracked), Scripted(), resume=True) == 4
    check(path, 4)
    with pytest.raises(InputError, match=r"only 0\.0002 mm per pixel: it looks like m"):
        FreeHand("127.0.0.1", spacing_mm=(0.0002, 0.0002))


def test_an_image_that_was_not_written_is_not_counted(tmp_path, plus_server):
    path = tmp_path / "my rec.h5"
    port = plus_server(mode="tracked", cut_after=70)
    asked = FreeHand("127.0.0.1", port, images=7)
    with pytest.raises(FreeHandStopped) as stopped:
        acquire_free_hand(path, asked, Scripted())
    with h5py.File(path) as file:
        count = len(file["calibration/mask"])
        assert file["us/frames"].shape == (count, ROWS, COLUMNS)
    assert count in (2, 3)
    assert str(stopped.value) == (
        "an ultrasound frame of 140 x 100 px of uint8 does not fit this recording, whose frames "
        f"have 160 x 120 px of uint8: set the machine as before; {count} of 7 images are in {path}"
        f"; go on with: jaxcal-hw free-hand 127.0.0.1:{port} '{path}' --resume"
    )


def test_an_image_with_pixels_of_another_size_ends_the_run(tmp_path, plus_server):
    """The machine's depth was changed: the frames have as many pixels as before."""
    path = tmp_path / "r.h5"
    port = plus_server(mode="separate", deeper_after=70)
    asked = FreeHand("127.0.0.1", port, images=7)
    with pytest.raises(FreeHandStopped, match="of 2 x 2 mm does not") as told:
        acquire_free_hand(path, asked, Scripted())
    with h5py.File(path) as file:
        count = len(file["calibration/mask"])
    assert count in (2, 3)
    assert f"; {count} of 7 images are in " in str(told.value)
    port = plus_server(mode="separate", deeper_after=0)
    asked = FreeHand("127.0.0.1", port)
    with pytest.raises(FreeHandStopped, match=f"1 x 1 mm: set .*; {count} of 7 images"):
        acquire_free_hand(path, asked, Scripted(), resume=True)
    port = plus_server(mode="separate", first=count)
    asked = FreeHand("127.0.0.1", port)
    assert acquire_free_hand(path, asked, Scripted(), resume=True) == 7


def test_images_are_of_one_device(tmp_path, plus_server):
    port = plus_server(mode="separate", second="Overview")
    asked = FreeHand("127.0.0.1", port, images=4)
    message = r"name the device of the images \(--device\); .*'Image_Reference', 'Overview'"
    with pytest.raises(DeviceError, match=message):
        acquire_free_hand(tmp_path / "r.h5", asked, Scripted())
    assert not list(tmp_path.iterdir())
    named = FreeHand("127.0.0.1", port, images=4, device="Image_Reference")
    assert acquire_free_hand(tmp_path / "r.h5", named, Scripted()) == 4
    check(tmp_path / "r.h5", 4)


def test_a_servers_clock_that_is_set_back_is_no_end(tmp_path, plus_server):
    """For an hour no image was taken after one that was judged and not taken."""
    port = plus_server(mode="tracked", hidden=[3], back_after=86, rate_hz=40.0)
    asked = FreeHand("127.0.0.1", port, images=4)
    assert acquire_free_hand(tmp_path / "r.h5", asked, Scripted()) == 4
    check(tmp_path / "r.h5", 4, among={0, 1, 2, 4, 5, 6, 7, 8})


def test_a_machine_that_is_frozen_has_no_image_taken(tmp_path, plus_server):
    """Its screen is grabbed with new time stamps: one target's pixel was taken at every pose."""
    person = Scripted()
    port = plus_server(mode="tracked", frozen=[30, 230])
    assert acquire_free_hand(tmp_path / "r.h5", FreeHand("127.0.0.1", port, images=5), person) == 5
    assert "the image stays the same while the probe moves: is the machine frozen?" in person.words
    check(tmp_path / "r.h5", 5)


@pytest.mark.parametrize(
    "option",
    [
        ("--images", "30"),
        ("--lag", "0.5"),
        ("--target", "cross"),
        ("--from", "Stylus"),
        ("--to", "Tracker"),
        ("--device", "Image"),
        ("--region", "0", "0", "9", "9"),
        ("--spacing", "0.2", "0.2"),
    ],
)
def test_options_that_the_recording_knows(capsys, option):
    assert main(["free-hand", "localhost", "r.h5", "--resume", *option]) == 2
    error = capsys.readouterr().err
    assert f"{option[0]} cannot be used with --resume: the recording holds this setting" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("host", ["a..b", "a" * 300, "a b"])
def test_hosts_that_cannot_be(capsys, host):
    assert main(["free-hand", host]) == 2
    error = capsys.readouterr().err
    assert "is not the name or address of a computer" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("host", ["a..b", "a" * 300])
def test_clients_refuse_such_a_host_too(host):
    with pytest.raises(DeviceError, match="no OpenIGTLink server at "):
        UltrasoundStream(host).start()
    with pytest.raises(DeviceError, match="no connection to "):
        PacketReader(host)
    with pytest.raises(DeviceError, match="no connection to the dashboard"):
        read_identity(host)


def test_ctrl_c_at_a_terminal(tmp_path, tracked):
    pytest.importorskip("pty", reason="there are no pseudo-terminals here")
    from terminal import Terminal

    arguments = ["-m", "hw", "free-hand", f"127.0.0.1:{tracked}", "r.h5"]
    with Terminal(arguments, tmp_path) as person:
        person.wait_for(r"image 0 \(1 of 30\): target at")
        person.wait_for("next: bring the target to the")
        person.type("u")
        person.wait_for("taken back: the last image; ")
        person.wait_for(r"image \d \(\d of 30\): target at")
        person.type("\x03")
        assert person.finish() == 130
        assert person.shown.count("▀") > 1000
        assert "go on with: jaxcal-hw free-hand" in person.shown.replace("\r\n", " ")
        assert "Traceback" not in person.shown


def test_ctrl_c_while_a_complete_recording_is_calibrated(tmp_path, monkeypatch):
    """It said "interrupted" and nothing else, as if the images were lost."""
    path = tmp_path / "rec.h5"
    poses, pixels = holds(6, 1)
    with Recorder(path, RecordingHeader("pixel", {}, 0)) as recorder:
        for pose, pixel in zip(poses, pixels, strict=True):
            recorder.add_pixel(pose, pixel, np.eye(2), 1.0)
        recorder.finish()

    class Interrupting(io.StringIO):
        def write(self, text: str) -> int:
            os.kill(os.getpid(), signal.SIGINT)
            return super().write(text)

    monkeypatch.setattr("sys.stdout", Interrupting())
    words = rf"the recording is complete, calibrate it with: jaxcal calibrate {path} --estimate"
    with as_interrupts(), pytest.raises(KeyboardInterrupt, match=words):
        calibrate_and_print(str(path))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"source": "Needle"}, "no transforms lead from Needle to Reference; the stream has Probe"),
        ({"target_frame": "Table"}, "no transforms lead from Probe to Table"),
        ({"device": "Other"}, "but of 'Image_Reference': name one of these"),
    ],
)
def test_streams_that_cannot_be_used(tmp_path, monkeypatch, separate, options, message):
    monkeypatch.setattr("hw.freehand.posed.LISTEN_S", 1.0)
    with pytest.raises(DeviceError, match=message):
        acquire_free_hand(tmp_path / "r.h5", FreeHand("127.0.0.1", separate, **options), Scripted())
    assert not list(tmp_path.iterdir())


def test_rf_alone_is_told(monkeypatch):
    monkeypatch.setattr("hw.freehand.posed.LISTEN_S", 0.3)
    picture = Picture(np.zeros((8, 4), np.int16), SPACING_MM)
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        UltrasoundStream(*listener.getsockname()) as stream,
        listener.accept()[0] as connection,
    ):
        connection.sendall(encode(Message("IMAGE", "RF", 1.0, picture)))
        with pytest.raises(DeviceError, match=r"that can be used \(RF channel data are not\)"):
            PosedImages(stream)


def test_no_server(tmp_path, capsys):
    assert main(["free-hand", "127.0.0.1:1", str(tmp_path / "r.h5")]) == 4
    error = capsys.readouterr().err
    assert "no OpenIGTLink server at 127.0.0.1:1" in error
    assert error.count("\n") == 1
    for wrong in ("host:0", "host:99999", ":1", "host:x"):
        assert main(["free-hand", wrong]) == 2


def test_poses_between_stamps(separate):
    """A tracker faster than the images, with stamps of its own: poses are interpolated."""
    with UltrasoundStream("127.0.0.1", separate) as stream:
        posed = PosedImages(stream, None, None, lag_s=0.025)
        assert posed.pair == ("Probe", "Reference")
        images = [posed.read(180.0) for _ in range(12)]
        samples = {name: list(posed._samples[name]) for name in posed._needed}
    held = [each for each in images if each.pose is not None]
    assert len(held) > 8
    for each in held:
        moment = each.time - 0.025
        poses = []
        for name in ("ProbeToTracker", "ReferenceToTracker"):
            before = max(
                (s for s in samples[name] if s.t_device <= moment), key=lambda s: s.t_device
            )
            after = min(
                (s for s in samples[name] if s.t_device >= moment), key=lambda s: s.t_device
            )
            # Half way between two.
            poses.append(0.5 * (before.matrix + after.matrix))
        expected = np.linalg.inv(poses[1]) @ poses[0]
        np.testing.assert_allclose(each.pose, expected, atol=2e-3)


def test_an_image_waits_for_the_pose_of_a_negative_lag(separate):
    """With -0.5 s no image had one: its transforms were said to have stopped coming."""
    with UltrasoundStream("127.0.0.1", separate) as stream:
        # The stream's stamps run six times as fast as the clock on the wall.
        images = PosedImages(stream, lag_s=-4.0)
        assert images.read(3.0).pose is not None


def test_images_that_were_dropped_before_the_start_do_not_matter(separate):
    """Of a machine that was busy, the first image and the first transform were compared.

    All images were then said to be of a clock that was set.
    """
    with UltrasoundStream("127.0.0.1", separate, queue=8) as stream:
        until(lambda: stream.statistics().dropped >= 20)
        images = PosedImages(stream)
        assert not images.by_arrival
        assert [each.why for _ in range(9) if (each := images.read(60.0)).pose is None] == []


def test_frames_that_are_held_up_at_the_start_are_known_all_the_same():
    """The poses of the whole run were those in the tracker's frame, without the reference."""
    first = messages({"mode": "separate"})
    cut = next(first)
    # The image and ProbeToTracker.
    size = cut.index(b"ReferenceToTracker") - 14

    def talk(connection: socket.socket) -> None:
        connection.sendall(cut[:size])
        time.sleep(0.8)
        connection.sendall(cut[size:])
        for more in first:
            connection.sendall(more)
            time.sleep(0.01)

    with peer(talk) as stream:
        assert PosedImages(stream).pair == ("Probe", "Reference")


@contextmanager
def sending(stamp: Callable[[str, float], float]) -> Iterator[PosedImages]:
    """Images of a stream of 1.6 s whose poses have x = the time in mm.

    Args:
        stamp: kind of message and its time (s) -> its time stamp (s).
    """
    picture = Picture(np.zeros((4, 4), np.uint8), SPACING_MM)

    def talk(connection: socket.socket) -> None:
        began = time.monotonic()
        for t in np.arange(0.0, 1.6, 0.02):
            time.sleep(max(0.0, began + t - time.monotonic()))
            pose = np.eye(4)
            pose[0, 3] = t
            tracked = (Tracked("ProbeToTracker", pose),)
            moved = Message("TRANSFORM", "ProbeToTracker", stamp("TRANSFORM", t), tracked)
            shown = Message("IMAGE", "Image", stamp("IMAGE", t + 0.01), picture)
            connection.sendall(encode(moved) + encode(shown))
        connection.recv(1)

    with peer(talk) as stream:
        yield PosedImages(stream)


def test_no_image_has_the_pose_of_an_earlier_place_after_its_clock_was_set_back():
    """Where images and poses have clocks of their own, it was taken without a word."""

    def stamp(kind: str, t: float) -> float:
        return 100.0 + t - (0.5 if kind == "IMAGE" and t > 0.895 else 0.0)

    with sending(stamp) as images:
        assert not images.by_arrival
        posed = [images.read(60.0) for _ in range(79)]
    off = [
        0.0 if each.pose is None else abs(each.pose[0, 3] - (0.02 * number + 0.01))
        for number, each in enumerate(posed)
    ]
    assert max(off) < 0.005
    assert all(each.pose is not None for each in posed[:40])


def test_images_and_poses_of_clocks_that_differ_are_put_together_as_they_arrive():
    """Below 60 s, each image had the pose of an earlier place, without a word."""
    with sending(lambda kind, t: 100.0 + t - (1.2 if kind == "IMAGE" else 0.0)) as images:
        assert images.by_arrival
        posed = [images.read(60.0) for _ in range(30)]
    off = [abs(each.pose[0, 3] - 0.02 * k) for k, each in enumerate(posed) if each.pose is not None]
    assert len(off) > 25
    assert np.median(off) < 0.1


def test_time_stamps_in_another_unit_are_not_used():
    """They let an image be taken of a probe that was held still for a thousandth of the time."""
    with sending(lambda kind, t: 1000.0 * (100.0 + t)) as images:
        assert images.by_arrival


def still(pose: np.ndarray, t: float, frame: np.ndarray) -> PosedImage:
    return PosedImage(Image(t, t, 1, frame, (1.0, 1.0), "Image"), t, pose)


@pytest.mark.parametrize("period_s", [0.05, 0.4, 0.5, 1.0])
def test_an_image_is_taken_however_seldom_images_come(period_s):
    rng = np.random.default_rng(0)
    (pose, *_), (pixel, *_) = holds(3, 1)
    guide = Guide()
    seen = []
    for number in range(14):
        shaken = pose.copy()
        shaken[:3, 3] += rng.normal(0, 0.03, 3)
        seen.append(guide.look(still(shaken, period_s * number, frame(rng, pixel))))
    taken = [look.taken.time for look in seen if look.taken is not None]
    assert taken
    assert taken[0] <= 1.0


def test_a_tracker_that_is_frozen_has_no_image_taken():
    """Its software repeats the last pose with new time stamps, while the image goes on."""
    rng = np.random.default_rng(0)
    poses, pixels = holds(3, 1)
    guide = Guide()
    words = []
    for number in range(60):
        # It freezes at the first pose, and works again at the last.
        pose = poses[0 if number < 40 else 2]
        look = guide.look(still(pose, 0.1 * number, frame(rng, pixels[number // 20])))
        words.append(look.words)
        if look.taken is not None:
            guide.keep(replace(look.taken, row=len(guide.taken)))
    assert [each.time // 2.0 for each in guide.taken] == [0, 2]
    frozen = "the pose is that of image 0, but the target is elsewhere in the image: is the tracker"
    assert any(each.startswith(frozen) for each in words)


@pytest.mark.parametrize("since", [0.0, 0.6])
def test_a_tracker_that_freezes_on_the_way_has_no_image_taken(since):
    """It repeats a pose of which there is no image yet; the hand goes on and then rests."""
    rng = np.random.default_rng(0)
    (pose, *_), (start, end, _) = holds(3, 1)
    guide = Guide()
    words = []
    for number in range(40):
        part = min(since + 0.05 * number, 1.0)
        pixel = np.asarray(start) + part * (np.asarray(end) - start)
        words.append(guide.look(still(pose, 0.05 * number, frame(rng, tuple(pixel)))).words)
    assert words[-1].startswith("the target moves in the image while the pose is still")


def test_advice_names_what_is_missing():
    rng = np.random.default_rng(0)

    def guide(turns, places) -> Guide:
        taken = []
        for turn, place in zip(turns, places, strict=True):
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
            taken.append(Taken(pose, np.array(place, float), np.eye(2), 0.0))
        return Guide(Rules(), taken)

    everywhere = [(50 + 100 * (k % 3), 50 + 100 * (k // 3)) for k in range(9)]
    few = guide([[0.0, 0, 0]] * 3, [(50, 50), (60, 40), (55, 55)])
    assert "bring the target to the lower right" in few.advice((300, 300))
    assert "turn the probe more (its orientations differ by 0 degrees)" in few.advice((300, 300))
    one_axis = guide([[0.1 * k - 0.4, 0, 0] for k in range(9)], everywhere)
    assert one_axis.advice((300, 300)).startswith("turn the probe about another axis")
    good = guide(rng.normal(0, 0.5, (9, 3)), everywhere)
    assert good.advice((300, 300)) == "well covered: any other pose helps"
    sds = orientation_sds(np.array([each.pose for each in one_axis.taken]))
    np.testing.assert_allclose(sds, [np.degrees(np.std(0.1 * np.arange(9))), 0, 0], atol=1e-5)


def test_rules_that_cannot_be():
    with pytest.raises(InputError, match="hold_s must be positive"):
        Rules(hold_s=0.0)
    with pytest.raises(InputError, match="images must be 4 to 1000"):
        FreeHand("localhost", images=3)
    for lag in (float("nan"), 5.1):
        with pytest.raises(InputError, match="the lag must be -5 to 5 s"):
            FreeHand("localhost", lag_s=lag)


def test_a_region_that_leaves_the_images_makes_no_file(tmp_path, separate):
    rules = Rules(region=(0, 0, 5000, 5000))
    asked = FreeHand("127.0.0.1", separate, rules=rules)
    with pytest.raises(InputError, match="leaves the 160 x 120 px frame"):
        acquire_free_hand(tmp_path / "r.h5", asked, Scripted())
    assert not list(tmp_path.iterdir())


def test_options_that_nothing_would_use(tmp_path, capsys):
    injection = ["--placement", "pattern-injection", "--setup", "hand.toml"]
    for option in (
        ["--target", "cross"],
        ["--region", "0", "0", "9", "9"],
        ["--spacing", "1", "1"],
    ):
        assert main(["free-hand", "localhost", *injection, *option]) == 2
        assert f"{option[0]} is for segmented images" in capsys.readouterr().err
    assert main(["acquire", "--setup", "bench.toml", "--view"]) == 2
    assert "--view needs --move" in capsys.readouterr().err
