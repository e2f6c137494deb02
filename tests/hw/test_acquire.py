"""The experiment on the emulated bench: real clients, faults in the middle, kill -9, resumed."""

from __future__ import annotations

import errno
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any, Self
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

pytest.importorskip("rtde_control", reason="ur_rtde is not installed (jaxcal[robot])")
pytest.importorskip("serial", reason="pyserial is not installed (jaxcal[serial])")

from motions import LIMITS, OFFSET, SERIAL, beside
from test_recorder import wait_until_closed
from waiting import until

import jaxcal
from hw.acquisition.acquire import AcquisitionStopped, Outcome, _write_truth, acquire
from hw.acquisition.job import (
    motion_plan,
    open_recorder,
    plan_to_go,
    prepare,
    record_confirmed,
)
from hw.acquisition.outcome import lines_of, share_inside
from hw.acquisition.request import AcquisitionRequest, request_in
from hw.acquisition.stage import ProbeStage
from hw.bench.active_echo import AuspisEmulator
from hw.bench.run import Bench
from hw.midplane.search import PlacementError, Settings
from hw.planning.poses import Extent
from hw.recording.check import Progress
from hw.recording.recorder import Recorder
from hw.recording.resuming import check_same_robot
from hw.recording.session import Session, SilenceLimits
from hw.robot.confirmation import confirm_unattended
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.robot.path_checks import check_plan
from hw.runtime.errors import LostError, RefusedError, StoppedError
from hw.runtime.keys import Pause
from hw.setup.check import _active_echo, check
from hw.setup.description import Setup
from hw.setup.emulated import setup_of, start
from jaxcal import InputError, OutputError
from jaxcal.cli.main import main

IMAGES = 5
# What a busy machine does to the processes in between: stopped, and resumed as a person would.
ATTEMPTS = 12


def a_bench(speed: float = 5.0) -> Bench:
    return start(3, speed)


def run(
    bench: Bench,
    path: Path,
    request: AcquisitionRequest | None,
    say: Callable[[str], None] = lambda line: None,
    pause: Pause | None = None,
    setup: Setup | None = None,
    watch: SilenceLimits | None = None,
) -> Outcome:
    setup = setup_of(bench) if setup is None else setup

    def agree(plan: MotionPlan):
        return confirm_unattended(plan, plan.digest, clock=setup.clock)

    return acquire(setup, path, request, agree, say=say, emulated=bench, pause=pause, watch=watch)


def finish(
    bench: Bench,
    path: Path,
    setup: Setup | None = None,
    say: Callable[[str], None] = lambda line: None,
    pause: Pause | None = None,
) -> Outcome:
    """Resume until it is done; every resumption keeps what is there."""
    for _ in range(ATTEMPTS):
        before = taken(path)
        try:
            return run(bench, path, None, say, pause, setup)
        except AcquisitionStopped as error:
            print(error)
            np.testing.assert_array_equal(taken(path)[: len(before)], before)
    raise AssertionError("the bench cannot keep up with itself")


def by_busy_machine(stopped: AcquisitionStopped, what: str) -> bool:
    """Whether a delay of this machine stopped the run before the fault that ``what`` tells of."""
    return stopped.by_itself and not re.search(what, str(stopped))


def taken(path: Path) -> np.ndarray:
    with h5py.File(path) as file:
        return np.asarray(file["calibration/pose"])


@pytest.mark.slow
def test_an_optimal_run_plans_on_and_stops_by_itself(tmp_path):
    path, lines = tmp_path / "rec.h5", []
    wanted = 0.2
    request: AcquisitionRequest | None = AcquisitionRequest(
        30, "amplitude-scan", 2, bench=3, plan="optimal", until_tre_mm=wanted
    )
    with a_bench() as bench:
        outcome = None
        for _ in range(ATTEMPTS):
            try:
                outcome = run(bench, path, request, lines.append)
                break
            except AcquisitionStopped as error:
                print(error)
                request = None
        truth = bench.world_truth()["image_to_probe"]
    assert outcome is not None
    assert 8 <= outcome.images < 30
    told = [line for line in lines if line.startswith("planned: ")]
    assert "one more image would bring it to" in told[-1]
    assert float(re.search(r"image ([0-9.]+) mm", told[-1])[1]) <= wanted
    assert float(re.search(r"image ([0-9.]+) mm", told[0])[1]) > wanted
    recording = jaxcal.load(path)
    found = np.asarray(jaxcal.calibrate(recording).image_to_probe)
    points = np.array([[x, 0.0, z, 1.0] for x in (-24, 0, 24) for z in (15, 50, 82)])
    apart = np.linalg.norm(points @ (found - truth)[:3].T, axis=1)
    assert np.sqrt(np.mean(apart**2)) < 3 * wanted


@pytest.mark.slow
@pytest.mark.parametrize("placement", ["threshold-climb", "amplitude-scan", "pattern-injection"])
def test_every_placement_brackets_the_truth(tmp_path, placement):
    path = tmp_path / "rec.h5"
    with a_bench() as bench:
        try:
            run(bench, path, AcquisitionRequest(12, placement, 2, bench=3))
        except AcquisitionStopped as error:
            print(error)
            finish(bench, path)
    inside, images, spread = share_inside(str(path))
    assert images >= 11
    assert inside >= images - 1
    assert spread < 0.6


FAULTS = {
    "mute": ({}, "robot", None),
    "drop": ({}, "robot", None),
    "protective_stop": ({}, "protective stop", "unlock"),
    "crc_errors": ({"rate": 1.0}, "active echo", None),
    "miss_triggers": ({"rate": 1.0}, "active echo", None),
    "echo_stale": ({}, "active echo", None),
    "unplug": ({}, "active echo", "replug"),
    "image_stale": ({}, "ultrasound", None),
    "image_drop": ({}, "ultrasound", None),
}


class Striker:
    """Causes a fault as soon as the arm moves, once it has begun; ends with the run at the latest.

    Attributes:
        at: when the fault came into force, bench s; empty before it.
    """

    def __init__(self, bench: Bench, cause: Callable[[], float]) -> None:
        self.at: list[float] = []
        self._bench, self._cause = bench, cause
        self._over, self._thread = threading.Event(), threading.Thread(target=self._strike)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join()

    def begin(self) -> None:
        if self._thread.ident is None:
            self._thread.start()

    def _strike(self) -> None:
        while not self._over.wait(0.002):
            if self._bench.rest_since() is None:
                self.at.append(self._cause())
                return


def fault_in_the_middle(tmp_path, name: str, speed: float, rest_s: float | None) -> None:
    arguments, what, cure = FAULTS[name]
    path = tmp_path / "rec.h5"
    with a_bench(speed) as bench:
        request: AcquisitionRequest | None = AcquisitionRequest(IMAGES, "none", 1, bench=3)
        for _ in range(ATTEMPTS):
            with Striker(bench, lambda: bench.fault(name, **arguments)) as striker:

                def say(line: str, striker=striker) -> None:
                    # Within a run the arm moves every second.
                    if line.startswith(("image 1 (", "image 2 (", "image 3 (")):
                        striker.begin()

                with pytest.raises(AcquisitionStopped) as caught:
                    run(bench, path, request, say)
            request = None
            if striker.at and not by_busy_machine(caught.value, what):
                break
            bench.recover()
        line = str(caught.value)
        assert what in line
        assert "\n" not in line
        assert f"acquire {path} --resume" in line
        until(lambda: bench.rest_since() is not None, 30.0)
        if rest_s is not None:
            assert bench.rest_since() - striker.at[0] <= rest_s
        before = taken(path)
        assert len(before) >= 2
        with h5py.File(path) as file:
            assert not file.attrs["complete"]
            assert file["events/kind"][-1] == b"stopped"
        assert main(["calibrate", str(path)]) == 2
        bench.recover()
        if cure is not None:
            bench.fault(cure)
        finish(bench, path)
    assert len(jaxcal.load(path)) == IMAGES
    np.testing.assert_array_equal(taken(path)[: len(before)], before)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_stops_the_robot_and_the_run_is_resumed(tmp_path, name):
    """In real time; images may be silent for a second before that counts."""
    fault_in_the_middle(tmp_path, name, 1.0, None if name.startswith("image") else 0.2)


def begun(path: Path, *options: str, **named: Any) -> tuple[subprocess.Popen[str], IO[str]]:
    """An acquisition on an emulated bench as a job, and what it writes for its user."""
    start = [sys.executable, "-m", "hw", "acquire", str(path), "--bench", "--placement", "none",
             "--bench-seed", "3", *options]  # fmt: skip
    process = subprocess.Popen(start, stderr=subprocess.PIPE, text=True, **named)
    assert process.stderr is not None
    return process, process.stderr


def resumed(path: Path, *options: str) -> subprocess.CompletedProcess[str]:
    start = [sys.executable, "-m", "hw", "acquire", str(path), "--bench", "--resume", *options]
    return subprocess.run(start, capture_output=True, text=True, timeout=900)


@pytest.mark.parametrize(
    ("number", "times", "moment", "least"),
    [(signal.SIGINT, 12, "image 0 (", 1), (signal.SIGTERM, 1, "confirmed: ", 0)],
    ids=["INT", "TERM"],
)
def test_signals_end_a_background_job_in_order(tmp_path, number, times, moment, least):
    """Ctrl-C many times, and the end that a system asks for.

    A shell's background job is started with Ctrl-C ignored.
    """
    path = tmp_path / "rec.h5"
    deaf = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    process, told = begun(path, "--images", "4", preexec_fn=deaf)
    with told:
        for line in told:
            if line.startswith(moment):
                break
        for k in range(times):
            if k:
                time.sleep(0.02)
            process.send_signal(number)
        rest = told.read()
    assert process.wait() == 130, rest
    # More may have been taken before the signal came.
    last = rf"jaxcal-hw: error: interrupted; [{least}-4] of 4 images are in {path}; to go on: "
    last += rf"jaxcal-hw acquire {path} --resume --bench"
    assert re.fullmatch(last, rest.splitlines()[-1]), rest
    assert "Traceback" not in rest
    wait_until_closed(path)
    with h5py.File(path) as file:
        assert not file.attrs["complete"]
        assert len(file["calibration/target"]) >= least


KEYS = {"Step down": "j", "Step up": "k", "m moves the robot": "m", "Enter accepts": "\r"}
# The last row of the view: what stands before it is complete.
ASKED = re.compile(
    r"(?P<title>pose \d of 4)(?P<view>(?:(?!pose \d of 4).)*?)"
    r"(?P<advice>Step down|Step up|m moves the robot|Enter accepts)(?:(?!pose \d of 4).)*?: stop",
    re.DOTALL,
)


def do_as_told(person, until: str) -> str:
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


@pytest.mark.real_time
def test_a_person_takes_an_image_skips_a_pose_and_stops(tmp_path):
    """At a terminal of their own, by the injected pattern."""
    pytest.importorskip("pty", reason="there are no pseudo-terminals here")
    from terminal import Terminal

    path = tmp_path / "rec.h5"
    arguments = ["acquire", str(path), "--bench", "--bench-seed", "3", "--images", "4",
                 "--placement", "pattern-injection", "--operator", "person"]  # fmt: skip
    with Terminal(["-m", "hw", *arguments], tmp_path) as person:
        person.wait_for("p pauses, Ctrl-C stops")
        # Steps twice as large: as few as a bar that must be seen to shrink allows.
        person.wait_for("step 0.25 mm")
        person.type("+")
        person.wait_for("step 0.50 mm")
        shown = do_as_told(person, r"image 0 \(1 of 4\): offset|resume")
        assert "image 0 (1 of 4): offset" in shown
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


@pytest.fixture(scope="module")
def e_series() -> Iterator[Bench]:
    """An e-Series bench, whose controller knows local control."""
    with start(3, 5.0, 500) as bench:
        yield bench


def quick_setup_of(bench: Bench) -> Setup:
    """Poses close to one another, and the target soon heard: what is tested is something else."""
    near = Extent(cone_deg=5.0, turn_deg=5.0, lateral_mm=5.0, depth_mm=(60.0, 70.0))
    return replace(setup_of(bench), extent=near, search=Settings(span_mm=1.0))


def test_a_robot_that_may_not_move_is_named_and_the_run_is_resumed(e_series, tmp_path, capsys):
    """Before the connection, before and after the confirmation, and while it rests at a pose.

    In the end the recording is whole, and calibrate takes it.
    """
    bench, path, request = e_series, tmp_path / "rec.h5", AcquisitionRequest(4, "none", 1, bench=3)
    setup, asked = quick_setup_of(bench), []

    def confirm(plan: MotionPlan):
        asked.append(plan.digest)
        bench.fault("robot_state", robot_mode=5, safety_mode=1)
        return confirm_unattended(plan, plan.digest, clock=setup.clock)

    bench.fault("protective_stop")
    with pytest.raises(AcquisitionStopped, match="protective stop") as told:
        acquire(setup, path, request, confirm)
    assert not told.value.by_itself
    bench.fault("unlock")
    bench.fault("robot_state", robot_mode=3, safety_mode=7)
    assert any("robot emergency stop: release" in line for line in check(setup, 0.2)[0].wrong)
    with pytest.raises(AcquisitionStopped, match="robot emergency stop: release"):
        acquire(setup, path, None, confirm)
    bench.fault("robot_state", robot_mode=7, safety_mode=1)
    bench.fault("remote", on=False)
    assert any("switch it to remote" in line for line in check(setup, 0.2)[0].wrong)
    with pytest.raises(AcquisitionStopped, match="local control: switch it to remote"):
        acquire(setup, path, None, confirm)
    bench.fault("remote", on=True)
    assert not asked
    with pytest.raises(AcquisitionStopped, match="release its brakes"):
        acquire(setup, path, None, confirm)
    assert asked
    bench.fault("robot_state", robot_mode=7, safety_mode=1)

    for image, name, wrong, right, text in (
        ("image 0 (", "robot_state", {"robot_mode": 7, "safety_mode": 5},
         {"robot_mode": 7, "safety_mode": 1}, "safeguard stop: close the gate"),
        ("image 1 (", "remote", {"on": False}, {"on": True}, "local control: switch it to remote"),
    ):  # fmt: skip
        stopped = []

        def say(line: str, image=image, name=name, wrong=wrong, stopped=stopped) -> None:
            if line.startswith(image):
                stopped.append(bench.fault(name, **wrong))

        # What a busy machine stops is gone on with; nothing is wrong until the image is there.
        for _ in range(ATTEMPTS):
            with pytest.raises(AcquisitionStopped) as told:
                run(bench, path, None, say, setup=setup)
            if stopped and not by_busy_machine(told.value, text):
                break
        assert text in str(told.value)
        assert not told.value.by_itself
        bench.fault(name, **right)
    lines, pause = [], Pause()

    def hold(line: str) -> None:
        lines.append(line)
        if line.startswith("image 2 ("):
            pause.hold()
            threading.Timer(0.1, pause.go_on).start()

    assert finish(bench, path, setup, hold, pause).images == 4
    assert any(line.startswith("paused") for line in lines)
    check_recording(path, bench, 4)
    assert main(["calibrate", str(path), "--method", "conventional", "--json"]) in (0, 3, 5)
    assert '"truth_error"' in capsys.readouterr().out


def test_a_search_that_the_limits_do_not_allow_gives_the_pose_up(e_series, tmp_path):
    """The run ended at that pose, and again whenever it was resumed."""
    setup = setup_of(e_series)
    setup = replace(setup, limits={**setup.limits, "search_mm": 0.1})
    job = prepare(setup, tmp_path / "rec.h5", AcquisitionRequest(4, "amplitude-scan", 1, bench=3))
    with (
        open_recorder(tmp_path / "rec.h5", job) as recorder,
        Session(setup, recorder) as session,
    ):
        here = session.poses.latest().pose[None]
        plan = replace(motion_plan(job, session), targets=here)
        agreed = confirm_unattended(plan, plan.digest, clock=setup.clock)
        with Motion(
            setup.robot_host, plan, agreed, clock=setup.clock, dry_run=False, caller_s=2.0
        ) as motion:
            stage = ProbeStage(session, motion, here, lambda kind, text: None)
            stage.go_to(0)
            for offset in (0.5, 0.05, -0.5):
                if abs(offset) < 0.1:
                    assert stage.move(offset) == pytest.approx(offset, abs=0.2)
                    continue
                with pytest.raises(PlacementError, match=r"may not go .0\.5 mm .*within 0\.1 mm"):
                    stage.move(offset)
            assert not motion.ended


def check_recording(path: Path, bench: Bench, images: int) -> None:
    """A complete one, with the truth of its bench."""
    recording = jaxcal.load(path)
    assert len(recording) == images
    truth = bench.world_truth()["image_to_probe"]
    np.testing.assert_allclose(recording.truth.image_to_probe, truth)
    assert share_inside(str(path))[:2] == (images, images)
    with h5py.File(path) as file:
        assert file.attrs["complete"]
        assert sorted(file["calibration/target"]) == list(range(images))
        assert len(file["estimate/images"]) >= 1
        assert np.isfinite(file["estimate/covariance"][-1]).all()
        assert {b"robot", b"active echo", b"ultrasound"} <= set(file["clock/device"][()])
        assert len(file["us/frames"]) == images
        assert len(file["tracker/pose"]) > 500
        # Poses that waited in one socket arrive together; the controller's own time goes on.
        assert (np.diff(file["tracker/t_host"]) >= 0).all()
        assert (np.diff(file["tracker/t_device"]) > 0).all()
        kinds = set(file["events/kind"][()])
        assert {b"started", b"confirmed", b"command", b"finished"} <= kinds
    assert path.with_name(f"{path.name}.sha256").exists()


DEVICE_FAULTS = {
    "crc_errors": ({"rate": 1.0}, "active echo: .* arrived damaged"),
    "echo_stale": ({}, "active echo: no frame for"),
    "unplug": ({}, "active echo: .* is gone"),
    "image_stale": ({}, "ultrasound: no image for"),
    "removed": ({}, "was removed while it was being recorded"),
}


def test_a_fault_of_any_device_stops_the_robot_and_the_run_is_resumed(e_series, tmp_path):
    """One after the other in one recording, which still has no image; the disk's comes last."""
    bench, path = e_series, tmp_path / "rec.h5"
    # A busy machine holds a thread up for more than the 0.12 s that the echo may be silent.
    setup = quick_setup_of(bench)
    watch = SilenceLimits(echo_age_s=0.5, image_age_s=0.5, grace_s=0.5)
    request: AcquisitionRequest | None = AcquisitionRequest(4, "none", 1, bench=3)
    for name, (arguments, what) in DEVICE_FAULTS.items():

        def cause(name=name, arguments=arguments) -> float:
            if name == "removed":
                path.unlink()
                return bench.clock.now()
            return bench.fault(name, **arguments)

        for _ in range(ATTEMPTS):
            with Striker(bench, cause) as striker:

                def say(line: str, striker=striker) -> None:
                    if line.startswith("confirmed: "):
                        striker.begin()

                stopped = None
                try:
                    run(bench, path, request, say, setup=setup, watch=watch)
                except AcquisitionStopped as error:
                    stopped = error
            if striker.at and stopped is not None and not by_busy_machine(stopped, what):
                break
            request = None
            if stopped is None or not path.exists():
                # All images were taken before the fault could come, or the file is gone already.
                for left in tmp_path.glob("rec.h5*"):
                    left.unlink()
                request = AcquisitionRequest(4, "none", 1, bench=3)
            bench.recover()
        request = None
        assert re.search(what, str(stopped))
        assert "\n" not in str(stopped)
        assert "--resume --bench" in str(stopped)
        until(lambda: bench.rest_since() is not None, 30.0)
        bench.recover()
        if name != "removed":
            with h5py.File(path) as file:
                assert not file.attrs["complete"]
                assert file["events/kind"][-1] == b"stopped"
            assert main(["calibrate", str(path)]) == 2


def first_end(
    bench: Bench, path: Path, confirmed: Callable[[], None], kind: type[Exception]
) -> Exception:
    """How a run ended that a busy machine has not ended before it was confirmed."""

    def say(line: str) -> None:
        if line.startswith("confirmed: "):
            confirmed()

    request: AcquisitionRequest | None = AcquisitionRequest(4, "none", 1, bench=3)
    for _ in range(ATTEMPTS):
        with pytest.raises((AcquisitionStopped, kind)) as ended:
            run(bench, path, request, say, setup=quick_setup_of(bench))
        if not (isinstance(ended.value, AcquisitionStopped) and ended.value.by_itself):
            return ended.value
        request = None
    raise AssertionError("the bench cannot keep up with itself")


def test_what_ends_a_run_is_recorded_whatever_it_is(e_series, tmp_path):
    """As where the pipe that standard error leads to is closed: nobody else can tell later."""
    path = tmp_path / "rec.h5"
    broken = Mock(side_effect=BrokenPipeError(errno.EPIPE, "Broken pipe"))
    assert isinstance(first_end(e_series, path, broken, BrokenPipeError), BrokenPipeError)
    with h5py.File(path) as file:
        assert file["events/kind"][-1] == b"stopped"
        assert file["events/text"][-1] == b"BrokenPipeError: [Errno 32] Broken pipe"


def named(process: Path, argument: Path) -> bool:
    """Whether a process was started with an argument; one that has ended meanwhile was not."""
    try:
        return os.fsencode(argument) in (process / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return False


def test_a_disk_that_fails_as_well_does_not_hide_why_the_robot_was_stopped(e_series, tmp_path):
    path = tmp_path / "rec.h5"

    def fail() -> None:
        (writer,) = (
            int(process.name) for process in Path("/proc").glob("[0-9]*") if named(process, path)
        )
        resource.prlimit(writer, resource.RLIMIT_FSIZE, (1000, 1000))
        raise StoppedError("protective stop", device="robot")

    ended = first_end(e_series, path, fail, AcquisitionStopped)
    assert re.match(r"robot: protective stop; .*: cannot be written: .*; 0 of 4 images", str(ended))


def test_an_interrupt_while_the_end_is_noted_does_not_hide_it(e_series, tmp_path):
    """As when a system ends all processes: the mover's end is told, then comes the signal."""
    path = tmp_path / "rec.h5"

    class Lost(LostError):
        def __str__(self) -> str:
            signal.raise_signal(signal.SIGINT)
            return super().__str__()

    lost = Mock(side_effect=Lost("gone", device="robot"))
    ended = first_end(e_series, path, lost, AcquisitionStopped)
    assert "interrupted; 0 of 4" in str(ended)
    with h5py.File(path) as file:
        assert file["events/kind"][-1] == b"stopped"
        assert file["events/text"][-1] == b"interrupted"


@pytest.mark.slow
def test_killed_and_resumed(tmp_path, capfd):
    path = tmp_path / "rec.h5"
    process, told = begun(path, "--images", str(IMAGES), "--speed", "3", "--controller", "e")
    with told:
        for line in told:
            if line.startswith("image 1 ("):
                break
        process.kill()
        process.wait()
    wait_until_closed(path)
    before = taken(path)
    assert len(before) >= 2
    done = resumed(path, "--speed", "3")
    assert done.returncode in (0, 3, 5), done.stderr
    assert "reconstruction precision" in done.stdout
    assert len(jaxcal.load(path)) == IMAGES
    np.testing.assert_array_equal(taken(path)[: len(before)], before)


@pytest.mark.real_time
def test_a_check_that_was_suspended_tells_the_true_rate(e_series):
    """It counted what came in a longer time than it divided by."""
    script = f"sleep 0.05; kill -STOP {os.getpid()}; sleep 1.0; kill -CONT {os.getpid()}"
    with subprocess.Popen(["sh", "-c", script]):
        facts = _active_echo(setup_of(e_series), 0.4 * e_series.clock.speed).facts
    rate = re.search(r"(\d+) frames/s", facts)
    assert rate is not None
    assert float(rate[1]) == pytest.approx(30.0, rel=0.2)


def test_an_edited_plan_is_told_until_it_is_confirmed(e_series, tmp_path):
    path = tmp_path / "rec.h5"

    def refuse(plan: MotionPlan):
        raise RefusedError("not confirmed", device="robot")

    setup, request = setup_of(e_series), AcquisitionRequest(4, "none", 1, bench=3)
    for resumed in range(3):
        if resumed == 1:
            with h5py.File(path, "r+") as file:
                file["plan/targets"][-1, 2, 3] += 1.0
        told = []
        with pytest.raises(AcquisitionStopped, match="not confirmed"):
            acquire(setup, path, None if resumed else request, refuse, say=told.append)
        assert any("it was edited" in line for line in told) == bool(resumed)


def test_a_resumed_run_needs_the_same_robot():
    offset = [0.0, 0.0, 0.12, 0.0, 0.0, 0.0]
    before = {"serial_number": "a", "tcp_offset": offset}
    check_same_robot(before, "a", [*offset[:2], 0.1200000001, *offset[3:]])
    with pytest.raises(RefusedError, match="begun with robot a, this one is b"):
        check_same_robot(before, "b", offset)
    with pytest.raises(RefusedError, match="TCP offset"):
        check_same_robot(before, "a", [*offset[:2], 0.121, *offset[3:]])
    with pytest.raises(RefusedError, match="does not say"):
        check_same_robot({"serial_number": "a", "tcp_offset": [0.0]}, "a", offset)


def test_a_resumed_plan_holds_the_poses_that_the_way_leads_through():
    """Where the way to a pose without an image is too long, or turns too far, for one motion."""
    poses = [beside(x, 0.0, 0.0) for x in (0.0, 40.0, 80.0, 110.0)]
    whole = MotionPlan(np.array(poses), replace(LIMITS, box_max_mm=(600.0, -30.0, 320.0)),
                       OFFSET, SERIAL)  # fmt: skip
    check_plan(whole)
    for missing, here, rows in [
        ([0, 1, 2, 3], poses[0], [0, 1, 2, 3]),
        ([2, 3], poses[1], [2, 3]),
        ([2, 3], poses[0], [0, 1, 2, 3]),
        ([0, 3], poses[0], [0, 1, 2, 3]),
        ([], poses[0], [0, 1, 2, 3]),
    ]:
        plan = plan_to_go(whole, missing, here)
        np.testing.assert_array_equal(plan.targets, whole.targets[rows])


def test_a_recording_whose_writer_is_killed_at_once_is_resumed(e_series, tmp_path):
    """It was refused as not made by an acquisition, and a new one as one to resume."""
    path, setup = tmp_path / "rec.h5", setup_of(e_series)
    job = prepare(setup, path, AcquisitionRequest(4, "none", 1, bench=3))
    with suppress(OutputError), open_recorder(path, job) as recorder:
        recorder._process.kill()
        recorder._process.wait()
    assert prepare(setup, path, None).missing == [0, 1, 2, 3]


def test_a_resumed_run_compares_the_electronics(e_series, tmp_path):
    """With another clock, ticks would mean two things; another unit is told of."""
    path, setup = tmp_path / "rec.h5", setup_of(e_series)
    job = prepare(setup, path, AcquisitionRequest(4, "none", 1, bench=3))
    with open_recorder(path, job) as recorder, Session(setup, recorder) as session:
        record_confirmed(job, motion_plan(job, session), session, recorder)

    def silence(t: float, threshold: int) -> tuple[np.ndarray, np.ndarray]:
        return np.full(setup.probe.elements, np.nan), np.zeros(setup.probe.elements)

    def refuse(plan: MotionPlan):
        raise RefusedError("not confirmed", device="robot")

    for clock_hz, stopped in (
        (80e6, r"active echo: .* 100000000\.0 ticks .* 80000000\.0:"),
        (100e6, "not confirmed"),
    ):
        told = []
        with AuspisEmulator(
            silence, clock=setup.clock, lines=setup.probe.elements, clock_hz=clock_hz
        ) as other:
            other.identity = "another unit"
            bench = replace(setup, active_echo_url=other.path)
            with pytest.raises(AcquisitionStopped, match=stopped):
                acquire(bench, path, None, refuse, say=told.append)
    was = '"jaxcal,active-echo emulator,SN0001,1.0"'
    assert f'changed: the electronics were {was}, are "another unit" from here on' in told


@pytest.mark.parametrize(
    "asked",
    [
        None, {"unknown": 1}, {"images": "x"}, {"images": 10.5}, {"seed": -1}, {"bench": "x"},
        {"bench": 1.5}, {"phantom": ["x"]}, {"operator": 1}, {"until_tre_mm": "x"},
        {"controller": "x"},
    ],
)  # fmt: skip
def test_a_request_in_a_file_is_not_trusted(asked):
    with pytest.raises(InputError):
        request_in({"request": asked})


def test_the_rate_is_that_of_this_run(tmp_path):
    """Not that of all images of a resumed recording in the seconds of its last run."""
    path = tmp_path / "rec.h5"
    with h5py.File(path, "w") as file:
        for name in ("low", "high", "true_elevation"):
            file[f"placement/{name}"] = np.full(60, np.nan)
            # A single one has no SD: numpy's warnings were told.
            file[f"placement/{name}"][0] = 0.0
    outcome = Outcome(60, taken=10, given_up=(), sha256="", seconds=100.0)
    assert lines_of(str(path), outcome, 1.0) == [
        f"60 images in {path}, 6.0 per minute of bench time (100 s)"
    ]


def test_truth_is_recorded_only_where_it_is_known_of_all_images(tmp_path):
    """A finished recording with an unknown elevation was refused by calibrate."""
    recorder, bench = Mock(spec=Recorder), Mock(spec=Bench)
    bench.test_set.return_value = np.eye(4)[None], np.zeros((1, 2))
    bench.world_truth.return_value = {"image_to_probe": np.eye(4), "point_mm": np.zeros(3)}
    progress = Mock(spec=Progress)
    for elevation, groups in (([0.1, 0.2], {"test", "truth"}), ([0.1, np.nan], {"test"})):
        recorder.reset_mock()
        progress.true_elevation = np.array(elevation)
        _write_truth(recorder, bench, progress)
        assert {call.args[0] for call in recorder.put.call_args_list} == groups
        assert recorder.copy.called == ("truth" in groups)
    with h5py.File(tmp_path / "rec.h5", "w") as file:
        for name, values in {"low": -1.0, "high": 1.0}.items():
            file[f"placement/{name}"] = np.full(3, values)
        file["placement/true_elevation"] = np.array([0.5, np.nan, 1.5])
    assert share_inside(str(tmp_path / "rec.h5")) == (1, 2, pytest.approx(np.sqrt(0.5)))


def viewers(parent: int) -> list[int]:
    """Processes of the live view that a command started."""
    found = []
    for task in Path(f"/proc/{parent}/task").iterdir():
        for child in (task / "children").read_text().split():
            if b"hw.view.server" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(int(child))
    return found


@pytest.mark.slow
def test_a_killed_view_changes_nothing_in_an_acquisition(tmp_path):
    pytest.importorskip("viser", reason="viser is not installed (jaxcal[view])")
    path = tmp_path / "rec.h5"
    process, written = begun(path, "--images", str(IMAGES), "--speed", "3", "--view")
    lines = []
    with written:
        for line in written:
            lines.append(line)
            if line.startswith("image 1 ("):
                (viewer,) = viewers(process.pid)
                os.kill(viewer, signal.SIGKILL)
    code = process.wait()
    told = [line for line in lines if "goes on without it" in line]
    assert len(told) == 1, lines
    assert not any("Traceback" in line for line in lines)
    if code == 4:
        # Not by the view: a busy machine held a device up, and the last line says which.
        assert "view" not in lines[-1]
        code = resumed(path, "--speed", "3").returncode
    assert code in (0, 3, 5), lines
    assert len(jaxcal.load(path)) == IMAGES


@pytest.mark.slow
@pytest.mark.parametrize("what", ["limit", "removed"])
def test_a_failing_disk_is_one_line_and_status_4(tmp_path, what):
    path = tmp_path / "rec.h5"
    limit = 3 * 2**20 if what == "limit" else resource.RLIM_INFINITY
    limited = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit,) * 2)
    process, told = begun(path, "--images", "12", "--speed", "2", preexec_fn=limited)
    lines = []
    with told:
        for line in told:
            lines.append(line)
            if line.startswith("image 0 (") and what == "removed":
                path.unlink()
    assert process.wait() == 4, lines
    assert not any("Traceback" in line or "Exception" in line for line in lines)
    reason = (
        "the disk cannot be written any more: File too large" if what == "limit" else "was removed"
    )
    found = re.search(
        r"(\d+) of 12 images are in (\S+); correct this, then: .* --resume", lines[-1]
    )
    assert reason in lines[-1]
    assert found is not None
    assert found[2] == str(path)
    with h5py.File(path) as file:
        assert not file.attrs["complete"]
        assert len(file["calibration/target"]) >= int(found[1])
    done = resumed(path)
    assert done.returncode in (0, 3, 5), done.stderr
    assert len(jaxcal.load(path)) == 12
