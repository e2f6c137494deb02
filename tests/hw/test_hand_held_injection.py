"""Pattern injection by hand: emulated tracker, ultrasound machine and element, a scripted hand."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import pytest
from echo_bridge import Bridge

pytest.importorskip("serial", reason="pyserial is not installed (jaxcal[serial])")

import jaxcal
from hw.active_echo.device import EchoFrame
from hw.bench.active_echo import AuspisEmulator
from hw.bench.frames import Camera
from hw.bench.ultrasound import ImageServer
from hw.bench.world import make_world
from hw.cli.main import main
from hw.freehand.guide import Rules
from hw.freehand.injection import Sample, _Run, acquire_by_injection, hand_advice
from hw.freehand.posed import PosedImage, pose_at_arrival
from hw.freehand.request import FreeHand, FreeHandStopped
from hw.midplane.pattern_injection import View
from hw.planning.poses import Extent, plan_poses
from hw.recording.layout import RecordingHeader
from hw.recording.recorder import Recorder
from hw.runtime.clock import REAL
from hw.runtime.errors import RefusedError
from hw.setup.description import HandHeldSetup, load_hand_held
from hw.ultrasound import Image
from jaxcal import InputError

WORLD = make_world(3)
REACH_MM, RATE_MM_S, FROM_MM = 7.0, 5.0, -1.0
LONGEST_S = 0.05
"""The hand waits for a bench that is slower than real time: so long from one look to the next."""


class Hand:
    """Holds the probe over the target and slides it along its elevational axis.

    Attributes:
        time_s: the hand's own, s.
    """

    def __init__(self) -> None:
        self.poses = plan_poses(8, WORLD.scene, Extent(), 4).poses
        self.row, self.offset, self.aim = 0, FROM_MM, FROM_MM
        self._rng = np.random.default_rng(0)
        self._lock, self._at, self.time_s = threading.Lock(), time.monotonic(), 0.0

    def go(self, aim: float) -> None:
        with self._lock:
            self.aim = float(np.clip(aim, -REACH_MM, REACH_MM))

    def next_pose(self, step: int = 1) -> None:
        with self._lock:
            self.row, self.offset, self.aim = self.row + step, FROM_MM, FROM_MM

    def pose(self, _: float) -> np.ndarray:
        with self._lock:
            now = time.monotonic()
            passed = min(now - self._at, LONGEST_S)
            self._at = now
            self.time_s += passed
            step = RATE_MM_S * passed
            self.offset += float(np.clip(self.aim - self.offset, -step, step))
            pose = self.poses[self.row % len(self.poses)].copy()
            along = pose[:3, :3] @ WORLD.image_to_probe[:3, 1]
            pose[:3, 3] += self.offset * along + self._rng.normal(0, 0.02, 3)
            return pose


class Bench:
    """Element, machine and tracker, which see one hand."""

    def __init__(self, link: Literal["pty", "tcp"] = "pty") -> None:
        self.hand, self.unit_mm = Hand(), 1.0
        rng, camera = np.random.default_rng(1), Camera(WORLD, seed=0)

        def hear(t: float, threshold: int):
            times, amplitude = WORLD.echo(self.hand.pose(t), threshold, rng)
            return times + 0.25 / WORLD.clock_hz, amplitude

        self.echo = AuspisEmulator(
            hear, clock=REAL, rate_hz=30.0, lines=WORLD.probe.elements, clock_hz=WORLD.clock_hz,
            link=link,
        )  # fmt: skip

        def see(t: float) -> np.ndarray:
            injection = self.echo.injection
            pattern = injection.pattern if injection.on and injection.pattern else None
            return camera.frame(
                self.hand.pose(t), rng, threshold=self.echo.threshold, pattern=pattern,
                pattern_delay_s=injection.delay_ticks / WORLD.clock_hz,
            )  # fmt: skip

        self.images = ImageServer(
            see, clock=REAL, rate_hz=20.0, spacing_mm=camera.spacing_mm,
            transforms=self.transforms,
        )  # fmt: skip

    def transforms(self, t: float) -> dict[str, np.ndarray]:
        pose = self.hand.pose(t)
        pose[:3, 3] /= self.unit_mm
        return {"ProbeToTracker": pose}

    @property
    def setup(self) -> HandHeldSetup:
        return HandHeldSetup(
            active_echo_url=self.echo.path, probe=WORLD.probe,
            image_to_probe=np.asarray(WORLD.scene.image_to_probe, float),
        )  # fmt: skip

    @property
    def asked(self) -> FreeHand:
        return FreeHand(self.images.host, self.images.port, images=4, rules=Rules(hold_s=0.3))


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    with bench.echo, bench.images:
        yield bench


def follow(hand: Hand, advice: str) -> None:
    """Move the hand as the advice says, if it says where to."""
    if "nothing heard" in advice:
        # As a person would look for it: to and fro.
        if hand.offset == hand.aim:
            hand.go(REACH_MM if hand.aim <= 0 else -REACH_MM)
    elif "down (-) until" in advice:
        hand.go(-REACH_MM)
    elif "up (+) through" in advice:
        hand.go(REACH_MM)
    elif (found := re.match(r"go ([\d.]+) mm (up|down)", advice)) is not None:
        hand.go(hand.offset + (1 if found[2] == "up" else -1) * float(found[1]))


class Person:
    """Does what the advice says; a key is pressed when the advice asks for it."""

    def __init__(self, hand: Hand, **lines: str) -> None:
        self.hand, self.lines, self.advice = hand, [], set()
        self.words = ""
        self._keys, self._on, self._pressed = [], lines, 0.0
        self._there, self._deadline = hand.time_s, time.monotonic() + 400
        self._rests_until = 0.0

    def show(self, frame: np.ndarray, words: str, advice: str) -> None:
        assert frame.dtype == np.uint8
        self.words += f"{words}\n"
        self.advice.add(re.sub(r"[\d.]+", "#", advice))
        now = self.hand.time_s
        assert time.monotonic() < self._deadline, f"it takes for ever: {words}\n{advice}"
        if "Enter accepts" not in advice:
            self._there = now
        if now < self._rests_until:
            return
        if "s restarts the sweep" in advice or now - self._there > 4.0:
            # Where a sweep came to nothing a person begins another one.
            self._there = now
            self._keys.append("s")
        elif "Enter accepts" not in advice:
            follow(self.hand, advice)
        elif self.hand.offset != self.hand.aim:
            # On a busy computer what is shown is late: stop, and look again, as a person would.
            self.hand.go(self.hand.offset)
            self._rests_until = now + 0.4
        elif now - self._pressed > 0.4:
            self._pressed = now
            self._keys.append("enter")

    def say(self, line: str) -> None:
        self.lines.append(line)
        if line.startswith(("started", "image ")):
            # At a new pose the hand waits until what is shown is of that pose.
            self.hand.next_pose(int(line.startswith("image ")))
            self._rests_until = self.hand.time_s + 0.4
        for pattern in list(self._on):
            if line.startswith(pattern.replace("_", " ")):
                self._keys.append(self._on.pop(pattern))

    def key(self) -> str | None:
        key = self._keys.pop(0) if self._keys else None
        if key == "ctrl-c":
            raise KeyboardInterrupt
        return key


class Sweeping(Person):
    """Slides the probe to and fro, until something is told or the picture was seen often enough."""

    def __init__(self, hand: Hand, told: str, most: int) -> None:
        super().__init__(hand)
        self._told, self._left = told, most

    def show(self, frame: np.ndarray, words: str, advice: str) -> None:
        super().show(frame, words, "nothing heard: to and fro")
        self._left -= 1
        if self._left <= 0 or re.search(self._told, words):
            self._keys.append("q")


def test_a_person_follows_the_bar_by_hand(tmp_path, bench):
    path, person = tmp_path / "r.h5", Person(bench.hand)
    stopping = Person(bench.hand, image_1="u", taken_back="ctrl-c")
    with pytest.raises(FreeHandStopped, match="interrupted; 1 of 4 images") as stopped:
        acquire_by_injection(path, bench.asked, bench.setup, stopping)
    assert stopped.value.exit_code == 130
    assert str(stopped.value).endswith(
        f"{path} --placement pattern-injection --setup TOML --resume"
    )
    turned = bench.setup.image_to_probe.copy()
    turned[:3, 3] += 1.0
    for other, told in (
        ({"probe": replace(WORLD.probe, sound_speed_m_s=1540.0)}, "sound_speed_m_s = "),
        ({"image_to_probe": turned}, "image_to_probe = "),
    ):
        with pytest.raises(InputError, match=rf"r\.h5: was recorded with \[\w+\] {told}"):
            acquire_by_injection(
                path, bench.asked, replace(bench.setup, **other), person, resume=True
            )
    with AuspisEmulator(
        lambda t, threshold: (np.full(128, np.nan), np.zeros(128)), clock=REAL, clock_hz=80e6
    ) as other:
        electronics = replace(bench.setup, active_echo_url=other.path)
        with pytest.raises(RefusedError, match=r"100000000\.0 ticks .* 80000000\.0:"):
            acquire_by_injection(path, bench.asked, electronics, person, resume=True)
    # As after a run on another day, whose clock counted from another moment.
    with Recorder(path, time_offset_s=1000.0) as recorder:
        recorder.add_event("later", "", REAL.now())
    bench.echo.identity = "another\0unit"
    assert acquire_by_injection(path, bench.asked, bench.setup, person, resume=True) == 4
    assert any(re.search(r'are "another.+unit" from here on', line) for line in person.lines)
    assert "started: 3 images to take" in person.lines
    assert "taken back: the last image; 1 are left" in stopping.lines
    assert not bench.echo.injection.on
    assert "#" * 25 in person.words
    assert any("slide it slowly up" in advice for advice in person.advice)
    with h5py.File(path) as file:
        mask = np.asarray(file["calibration/mask"])
        poses = np.asarray(file["calibration/pose"])
        low, high, centre = (np.asarray(file[f"placement/{k}"]) for k in ("low", "high", "centre"))
        bound = np.asarray(file["calibration/max_elevation"])
        assert file["us/frames"].shape[0] == len(mask) == 5
        assert file.attrs["complete"]
        assert len(file["ae/tof_ticks"]) > 100
        for times in ("events/t_host", "ae/t_host", "us/t_host", "calibration/time"):
            assert (np.diff(file[times]) >= 0).all()
            assert file[times][-1] > 1000.0
    assert mask.tolist() == [True, False, True, True, True]
    # What the drawing of the probe does not know (it is off by degrees) moves all of them alike.
    true = np.array([WORLD.truth(pose).elevation_mm for pose in poses])
    assert ((low <= true) & (true <= high)).mean() >= 4 / 5
    assert (high - low < 4).all()
    assert (np.abs(centre) < 1).all()
    np.testing.assert_allclose(bound, np.maximum(np.abs(low), np.abs(high)))
    assert np.abs(true).max() < 1.5
    recording = jaxcal.load(path)
    assert (recording.calibration.kind, len(recording)) == ("time_of_flight", 5)
    assert recording.probe is not None
    times = recording.calibration.measurements[mask]
    shortest = np.nanmin(recording.probe.one_way_range_mm(times), axis=1)
    expected = [WORLD.truth(pose).range_mm for pose in poses[mask]]
    np.testing.assert_allclose(shortest, expected, atol=1.0)


def test_enter_is_refused_until_both_sides_were_seen(tmp_path, bench):
    class Hasty(Person):
        def show(self, frame: np.ndarray, words: str, advice: str) -> None:
            if "nothing heard" in advice:
                super().show(frame, words, advice)
            self.words += f"{words}\n"
            if "mm |" in words:
                self._keys.append("enter")
            if "visit both sides first" in self.words:
                self._keys.append("q")

    person = Hasty(bench.hand)
    with pytest.raises(FreeHandStopped, match="0 images are too few"):
        acquire_by_injection(tmp_path / "r.h5", bench.asked, bench.setup, person)
    Recorder(tmp_path / "o.h5", RecordingHeader("pixel", {}, 0, settings="{}")).close()
    with pytest.raises(InputError, match="has no settings of a pattern-injection run"):
        acquire_by_injection(tmp_path / "o.h5", bench.asked, bench.setup, person, resume=True)


def test_enter_is_refused_where_the_probe_is_no_longer(bench):
    """The place where it had been held was accepted, with a frame of where it was by then."""
    run = object.__new__(_Run)
    run.asked, run.setup, run._images = bench.asked, bench.setup, deque()
    run._new_sweep()
    offsets = np.concatenate([np.linspace(-4, 4, 60), np.zeros(30)])
    ticks = np.zeros(8, np.uint16)
    for number, offset in enumerate(offsets):
        frame = EchoFrame(number, 0, 0, ticks, ticks, t_host=number / 30, tof_s=np.zeros(8))
        peak = 3000 * np.exp(-0.5 * (offset / 1.5) ** 2)
        run._samples.append(Sample(frame, np.eye(4), offset, peak))
    last_s = run._samples[-1].frame.t_host

    def press(later_s: float, why: str = "") -> str:
        image = Image(last_s + later_s, 0.0, 0, np.zeros((2, 2), np.uint8), (1.0, 1.0), "")
        run._images.append(PosedImage(image, 0.0, None if why else np.eye(4), why))
        return run._accept()

    assert press(1.0, "Probe is not tracked") == "Probe is not tracked"
    run._hurried = True
    assert press(0.1) == "hold still for 0.3 s, then accept"


def test_poses_in_metres_are_told_of(tmp_path, bench):
    told = "look like metres: let the server send them in mm"
    person = Sweeping(bench.hand, told, 10_000)
    bench.unit_mm = 1000.0
    with pytest.raises(FreeHandStopped, match="0 images are too few"):
        acquire_by_injection(tmp_path / "r.h5", bench.asked, bench.setup, person)
    assert told in person.words


def test_an_element_that_falls_silent_ends_the_run(tmp_path, bench, monkeypatch):
    monkeypatch.setattr("hw.freehand.injection.SILENCE_S", 0.7)

    class Unplugging(Person):
        def say(self, line: str) -> None:
            super().say(line)
            if line.startswith("started"):
                bench.echo.fault(stale=True)

    person = Unplugging(bench.hand)
    with pytest.raises(FreeHandStopped, match="active echo: no frame for"):
        acquire_by_injection(tmp_path / "r.h5", bench.asked, bench.setup, person)


def test_frames_of_the_element_that_are_late_are_not_used_and_told_of(tmp_path):
    """The probe was elsewhere when they were heard: at 6 mm/s by 5 mm, with this link."""

    class Delaying(Sweeping):
        def show(self, frame: np.ndarray, words: str, advice: str) -> None:
            super().show(frame, words, advice)
            between.delay_s = 0.8

    told = r"the element's frames are 0\.[89] s late: check the link to it"
    bench = Bench("tcp")
    person = Delaying(bench.hand, told, 60)
    with bench.echo, bench.images:
        between = Bridge(bench.echo.path)
        setup = replace(bench.setup, active_echo_url=between.url)
        with pytest.raises(FreeHandStopped, match="0 images are too few"):
            acquire_by_injection(tmp_path / "r.h5", bench.asked, setup, person)
        between.close()
    assert re.search(told, person.words)


def test_frames_of_the_element_whose_delay_is_not_known_are_not_used_and_told_of(tmp_path):
    """It counts from another number than that of its frames: they may be from any time."""

    class Ahead(AuspisEmulator):
        def _answer(self, word: str, argument: str) -> str:
            answer = super()._answer(word, argument)
            return "1000000,1000000" if word == "TRIG:COUN?" else answer

    bench = Bench()
    person = Sweeping(bench.hand, "mm \\|", 20)
    bench.echo.__class__ = Ahead
    with bench.echo, bench.images:
        bench.hand.offset = bench.hand.aim = 0.0
        with pytest.raises(FreeHandStopped, match="0 images are too few"):
            acquire_by_injection(tmp_path / "r.h5", bench.asked, bench.setup, person)
    assert "mm |" not in person.words
    last = person.words.splitlines()[-1]
    assert "delay of the element's frames is not known: check the link" in last


def test_poses_that_a_slow_link_holds_up_are_not_those_of_the_frames_that_come_meanwhile():
    """The hand moves at 5 mm/s, and images and poses come half a second late: it was 2.5 mm on."""
    images = []
    for t in np.arange(0.0, 2.0, 0.05):
        pose = np.eye(4)
        pose[0, 3] = 5.0 * t
        image = Image(t + 0.5, t, 1, np.zeros((2, 2), np.uint8), (1.0, 1.0), "Image", 0.5)
        images.append(PosedImage(image, t, pose))
    pose = pose_at_arrival(images, 1.01)
    assert not isinstance(pose, bool)
    assert pose[0, 3] == pytest.approx(5.05)
    assert pose_at_arrival(images, 2.1) is True


SETUP = """
[active_echo]
url = "{url}"

[probe]
elements = 128
pitch_mm = 0.457
sound_speed_m_s = 1490.0

[scene]
image_to_probe = {x}
"""


def test_from_the_command_line(tmp_path, bench):
    """A person at a terminal: title, bar, advice; Ctrl-C ends and switches injection off."""
    pytest.importorskip("pty", reason="there are no pseudo-terminals here")
    from terminal import Terminal

    x = np.asarray(WORLD.scene.image_to_probe, float).tolist()
    setup = tmp_path / "hand.toml"
    setup.write_text(SETUP.format(url=bench.echo.path, x=x))
    server = f"{bench.images.host}:{bench.images.port}"
    options = ["--placement", "pattern-injection", "--setup", str(setup)]
    bench.hand.offset = bench.hand.aim = -3.0
    with Terminal(["-m", "hw", "free-hand", server, "r.h5", *options], tmp_path) as person:
        person.wait_for(r"image 0 \(1 of 30\): the element is not heard")
        bench.hand.go(REACH_MM)
        person.wait_for(r"image 0 \(1 of 30\): +[+-]\d+\.\d\d mm \|#")
        person.wait_for(r"next: (slide|here|go)")
        person.wait_for(r"image 0 \(1 of 30\): +\+\d+\.\d\d mm \| +\|")
        person.type("\r")
        person.wait_for("the element is not heard here")
        # The hand follows the advice to the end: on a busy computer it may be too late, or hurry.
        taken = r"image 0 \(1 of 30\): offset [+-]\d\.\d\d in \["
        pressed, deadline = 0.0, time.monotonic() + 300
        while (advice := person.wait_for(rf"{taken}|next: ([^\r\n]*)")[1]) is not None:
            assert time.monotonic() < deadline, advice
            if "s restarts the sweep" in advice:
                person.type("s")
            elif "Enter accepts" in advice and bench.hand.offset != bench.hand.aim:
                bench.hand.go(bench.hand.offset)
            elif "Enter accepts" in advice:
                if time.monotonic() - pressed > 0.5:
                    person.type("\r")
                    pressed = time.monotonic()
            elif bench.hand.offset == bench.hand.aim:
                follow(bench.hand, advice)
        person.type("\x03")
        assert person.finish() == 130
        assert "Traceback" not in person.shown
    assert not bench.echo.injection.on


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[probe]", "[robot]\nhost = 'x'\n[probe]", "is not known; there are active_echo"),
        ('url = "a"', "", r"\[active_echo\] needs url"),
        ("image_to_probe", "image_to_prob", "image_to_prob"),
        ("pitch_mm = 0.457", "pitch_mm = 0.000457", "the array"),
    ],
)
def test_setups_that_are_refused(tmp_path, old, new, message):
    text = SETUP.format(url="a", x=np.eye(4).tolist())
    (tmp_path / "s.toml").write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        load_hand_held(tmp_path / "s.toml")


def test_options_that_belong_together(tmp_path):
    assert main(["free-hand", "localhost", "--placement", "pattern-injection"]) == 2
    assert main(["free-hand", "localhost", "--setup", "x.toml"]) == 2


def test_advice():
    profile = [(x / 2, max(0, 31 - abs(x) * 4)) for x in range(-6, 7)]
    assert "down (-)" in hand_advice(View(tuple(profile[6:9])), 0.0)
    assert "up (+) through" in hand_advice(View(tuple(profile[:8])), 0.0)
    assert hand_advice(View(tuple(profile)), 0.0).startswith("go 3.0 mm down")
    there = View((*profile, (0.1, 31)))
    assert "Enter accepts" in hand_advice(there, 0.0)


def test_what_is_no_setup_is_named(tmp_path: Path):
    with pytest.raises(InputError, match="no such file"):
        load_hand_held(tmp_path / "none.toml")
