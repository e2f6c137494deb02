"""Pattern injection with a hand-held probe: the paper's free-hand procedure (section 2.1).

The active echo element draws what it hears into the ultrasound image, as a bar that is longest in
the mid-plane of the beam (:mod:`hw.midplane.pattern_injection`). A person moves the probe across
the plane by hand, then back to where the bar is longest, holds it still and accepts. The tracker
tells where the probe was at every frame of the element, so the sweep itself is the scan: the
maximum (:func:`hw.midplane.amplitude_scan.fit_peak`) says how far beside the mid-plane the image
was taken.

Places of the probe are measured along the image's elevational axis *at the target*, by the drawing
of probe and image, because a hand that tilts the probe also moves the plane at the target.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections import deque
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hw.active_echo.device import SILENT, ActiveEcho, EchoFrame
from hw.freehand.guide import spread_of
from hw.freehand.posed import PosedImage, PosedImages, pose_at_arrival
from hw.freehand.request import FreeHand, Person, recorded_request
from hw.freehand.run import SILENCE_S, KeptImages, Run, read_images, resumed_recorder
from hw.midplane.amplitude_scan import fit_peak
from hw.midplane.bracket import Bracket
from hw.midplane.live_view import describe, profile
from hw.midplane.pattern_injection import BAR_DELAY_S, View, bar, bar_length, sides_seen
from hw.midplane.search import Echoes, PlacementError
from hw.recording.check import devices_of
from hw.recording.layout import RecordingHeader
from hw.recording.recorder import Recorder
from hw.recording.resuming import (
    check_same,
    compare_electronics,
    described_electronics,
)
from hw.recording.session import DELAY_S, SilenceLimits, median_times
from hw.runtime.errors import StaleError
from hw.runtime.rigid import mean_pose, turn_deg
from hw.setup.description import HandHeldSetup
from hw.ultrasound.receiver import UltrasoundStream
from jaxcal.data.poses import targets_in_images
from jaxcal.data.recording import MetresError, check_pose_units
from jaxcal.io.given_files import naming
from jaxcal.runtime.array_types import Float

_KIND = "pattern-injection"
_PATTERN_PERIOD_S = 0.1
_ANOTHER_DEG = 5.0
"""When the hand has turned the probe by more than this, a new sweep begins."""
_FASTEST_MM_S = 6.0
"""Fastest motion of a hand whose frames are used: image, pose and echo are known to belong together
to some 50 ms, which at this speed is 0.3 mm, as much as the element's own accuracy."""
_LATEST_S = SilenceLimits.echo_late_s
"""Frames of the element that are later are not used: the probe was elsewhere then."""
_AGAIN_S = 1.0
"""After so many seconds the delay of the element's frames is measured again where it is unknown."""
_RECENT = 32
_SHOW_PERIOD_S = 0.1
_KEPT_S = 60.0
"""Older samples of a sweep are dropped, because the hand's drift would blur the maximum."""
_GONE_S = 0.3
"""A probe that is not tracked, or moved too fast, has no samples: after so long it is elsewhere."""
_BESIDE_MM = 1.0
"""A place farther from the maximum than this is not accepted."""


@dataclass(frozen=True)
class Sample:
    """One frame of the element and where the probe was.

    Attributes:
        frame: as it came.
        pose: of the probe, mm.
        offset_mm: the probe's offset along the elevational axis at the target.
        peak: amplitude, counts; 0 where the element was not heard.
    """

    frame: EchoFrame
    pose: Float[np.ndarray, "4 4"]
    offset_mm: float
    peak: float


def acquire_by_injection(
    path: str | os.PathLike[str],
    asked: FreeHand,
    setup: HandHeldSetup,
    person: Person,
    *,
    resume: bool = False,
) -> int:
    """Run until enough images are accepted or the person ends it.

    Args:
        path: the recording: to make, or with ``resume`` to go on with.
        asked: server, frames and number of images.
        setup: element, probe, and X as drawn.
        person: shown what goes on; ``enter`` accepts, ``s`` begins the sweep anew, ``u`` takes the
            last image back, ``q`` ends.
        resume: go on with ``path``; images and frames are those of the recording.

    Returns:
        Number of images; the file is complete then.

    Raises:
        FreeHandStopped: interrupted, a device was lost, or too few images; it can be resumed.
        DeviceError: a device that is not there, or a stream that cannot be used.
        InputError: a recording that cannot be resumed, or was begun with another probe or drawing.
        OutputError: the recording cannot be made.
    """
    kept, probe, before = KeptImages(), setup.probe, {}
    if resume:
        asked, told = recorded_request(path, _KIND, asked)
        known, before = devices_of(path)
        with naming(path):
            check_same("probe", known, asdict(probe))
            check_same("scene", told.get("scene"), _scene(setup))
        kept = KeptImages(read_images(path))
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(UltrasoundStream(asked.host, asked.port, device=asked.device))
        posed = PosedImages(stream, asked.source, asked.target_frame, asked.lag_s)
        person.say(f"images of {posed.device!r}; poses from {posed.pair[0]} to {posed.pair[1]}")
        echo = stack.enter_context(ActiveEcho(setup.active_echo_url, lines=probe.elements))
        echo.set_threshold(setup.search.low_threshold)
        echo.stream(True)
        unit = described_electronics(echo)
        changes = compare_electronics(before, unit)
        recorder = resumed_recorder(path) if resume else _recorder(path, asked, setup, posed)
        run = _Run(asked, person, posed, recorder, kept, setup, echo, unit, changes)
        return run.completed()


def _scene(setup: HandHeldSetup) -> dict[str, Any]:
    return {"image_to_probe": setup.image_to_probe.tolist()}


def _recorder(
    path: str | os.PathLike[str],
    asked: FreeHand,
    setup: HandHeldSetup,
    posed: PosedImages,
) -> Recorder:
    probe = setup.probe
    known = {**asked.settings(posed.pair), "scene": _scene(setup), "search": asdict(setup.search)}
    header = RecordingHeader(
        kind="time_of_flight",
        probe={"kind": probe.kind, **asdict(probe)},
        lines=probe.elements,
        settings=json.dumps({_KIND: known}),
    )
    return Recorder(path, header)


@dataclass
class _Run(Run):
    """Images are taken when the person accepts a place in the middle of a sweep."""

    setup: HandHeldSetup
    echo: ActiveEcho
    unit: dict[str, float | str]
    """What the recording keeps of the electronics."""
    changes: list[str]
    """Lines about what has changed since the recording was begun."""

    def __post_init__(self) -> None:
        self.options = ("--placement", _KIND, "--setup", self.setup.source)
        self._images: deque[PosedImage] = deque(maxlen=_RECENT)
        self._waiting: list[EchoFrame] = []
        self._pattern: tuple[int, int] | None = None
        self._patterned = 0.0
        self._heard, self._shown = time.monotonic(), 0.0
        self._delay_measured = -np.inf
        self._late_s = 0.0
        self._new_sweep()

    def begin(self) -> None:
        """Record the electronics, and what has changed since the recording was begun."""
        self.recorder.attributes("ae", self.unit)
        for change in self.changes:
            self.note("changed", change)

    def look(self, key: str | None) -> None:
        """Add what has come to the sweep; begin it anew, or accept the place, by a key."""
        if key == "s":
            self._new_sweep()
        self._listen()
        if key == "enter":
            self._message = self._accept()
        self._show()

    # The sweep

    def _new_sweep(self) -> None:
        """Begin a new sweep; places count from where the element is heard first."""
        self._samples: deque[Sample] = deque()
        self._origin: tuple[np.ndarray, np.ndarray] | None = None
        """Pose where the element was heard first, and the target in the tracker's frame, mm."""
        self._message, self._hurried = "", False

    def _listen(self) -> None:
        # Read all images that wait: the bar must show where the probe is now, however busy the PC.
        self._images.append(self.posed.read(SILENCE_S))
        for _ in range(self.posed.behind - 1):
            self._images.append(self.posed.read(SILENCE_S))
        now = time.monotonic()
        unknown = not np.isfinite(self._late_s)
        if now - self._delay_measured > (_AGAIN_S if unknown else DELAY_S):
            self._delay_measured = now
            self.echo.measure_delay()
        frames = self.echo.drain()
        if frames:
            self._heard = now
        elif now - self._heard > SILENCE_S:
            raise StaleError(f"no frame for {SILENCE_S:g} s: {SILENT}", device="active echo")
        self.recorder.add_echo(frames)
        self.echo.check_threshold(frames)
        if frames:
            self._late_s = frames[-1].late_s
        # Not those whose delay is not known (NaN).
        self._waiting += [frame for frame in frames if frame.late_s <= _LATEST_S]
        later = []
        for frame in self._waiting:
            pose = pose_at_arrival(self._images, frame.t_host)
            if isinstance(pose, bool):
                later += [frame] if pose else []
            elif not self._too_fast():
                self._sample(frame, pose)
        self._waiting = later[-256:]
        self._inject(now)

    def _too_fast(self) -> bool:
        """Whether the hand is so fast that the times do not say well enough where it was."""
        first, last = self._images[max(len(self._images) - 4, 0)], self._images[-1]
        passed = last.image.prompt_s - first.image.prompt_s
        if self._origin is None or first.pose is None or last.pose is None or passed <= 0:
            return False
        moved = abs(self._offset(last.pose) - self._offset(first.pose))
        self._hurried = moved / passed > _FASTEST_MM_S
        return self._hurried

    def _sample(self, frame: EchoFrame, pose: Float[np.ndarray, "4 4"]) -> None:
        answered = np.isfinite(frame.tof_s)
        amplitude = np.where(answered, frame.amplitude, 0.0)
        echoes = Echoes(amplitude[None].astype(float), answered[None])
        self._loudest_line = echoes.loudest_line
        if self._origin is not None and turn_deg(self._origin[0], pose) > _ANOTHER_DEG:
            self._new_sweep()
        if self._origin is None and echoes.heard:
            seen = self._target_of(frame, echoes.loudest_line)
            self._origin = pose, (pose @ self.setup.image_to_probe @ seen)[:3]
        if self._origin is None:
            return
        self._samples.append(Sample(frame, pose, self._offset(pose), echoes.peak))
        while frame.t_host - self._samples[0].frame.t_host > _KEPT_S:
            self._samples.popleft()

    def _target_of(self, frame: EchoFrame, line: int) -> Float[np.ndarray, " 4"]:
        """The target in the image frame, roughly: below the loudest line, at the shortest range."""
        probe = self.setup.probe
        lateral = probe.element_positions()[line, 0]
        distance = float(np.nanmin(probe.one_way_range_mm(frame.tof_s)))
        return np.array([lateral, 0.0, distance, 1.0])

    def _offset(self, pose: Float[np.ndarray, "4 4"]) -> float:
        """The probe's offset along the elevational axis at the target, mm."""
        assert self._origin is not None
        return -float(targets_in_images(pose, self.setup.image_to_probe, self._origin[1])[1])

    def _inject(self, now: float) -> None:
        """Draw the bar again if it has changed, but not more often than the eye can follow."""
        if not self._samples or now - self._patterned < _PATTERN_PERIOD_S:
            return
        length = bar_length(self._samples[-1].peak, self._loudest)
        if self._pattern == (length, self._loudest_line):
            return
        self._pattern, self._patterned = (length, self._loudest_line), now
        self.echo.load_pattern(bar(length, self._loudest_line, self.setup.probe.elements))
        self.echo.inject(True, BAR_DELAY_S)

    @property
    def _loudest(self) -> float:
        return max((sample.peak for sample in self._samples), default=0.0)

    # What the person sees and decides

    def _view(self) -> View | None:
        if not self._samples:
            return None
        loudest = self._loudest
        return View(tuple((s.offset_mm, bar_length(s.peak, loudest)) for s in self._samples))

    def _show(self) -> None:
        now = time.monotonic()
        if now - self._shown < _SHOW_PERIOD_S:
            return
        self._shown = now
        frame = self._images[-1].image.array
        kept = self.kept
        title = f"image {kept.next_row} ({len(kept) + 1} of {self.asked.images})"
        view = self._view()
        late = ""
        late_s = self._images[-1].image.late_s
        if not np.isfinite(self._late_s):
            late = "the delay of the element's frames is not known: check the link to it"
        elif self._late_s > _LATEST_S:
            late = f"the element's frames are {self._late_s:.1f} s late: check the link to it"
        elif late_s > _LATEST_S:
            late = f"the images are {late_s:.1f} s late: check the link to the server"
        if view is None:
            reason = self._images[-1].why or "the element is not heard"
            words = f"{title}: {late or f'{reason}: bring the probe over it'}"
            self.person.show(frame, words, "nothing heard yet")
            return
        rows = [f"{title}: {describe(view)}", *profile(view)]
        if late:
            rows.append(late)
        elif self._hurried:
            rows.append(f"too fast: at most {_FASTEST_MM_S:g} mm a second")
        elif self._in_metres(view):
            rows.append("the poses look like metres: let the server send them in mm")
        elif self._message:
            rows.append(self._message)
        self.person.show(frame, "\n".join(rows), hand_advice(view, self._peak()))

    def _in_metres(self, view: View) -> bool:
        """Whether the bar shrinks while the probe, by its poses, stays where it is."""
        if min(length for _, length in view.seen) > view.longest // 2:
            return False
        try:
            check_pose_units(np.array([sample.pose[:3, 3] for sample in self._samples]))
        except MetresError:
            return True
        return False

    def _accept(self) -> str:
        """Take the image if possible; returns what is missing otherwise, else an empty string."""
        view = self._view()
        if view is None or not view.length:
            return "the element is not heard here"
        if not all(sides_seen(view.seen)):
            return "visit both sides first: the bar must shrink on each"
        rules, last_s = self.asked.rules, self._samples[-1].frame.t_host
        held = [s for s in self._samples if last_s - s.frame.t_host <= rules.hold_s]
        newest = self._images[-1]
        gone = self._hurried or newest.image.prompt_s - last_s > _GONE_S
        if gone or last_s - held[0].frame.t_host < 0.8 * rules.hold_s:
            return newest.why or f"hold still for {rules.hold_s:g} s, then accept"
        shift, turn = spread_of(np.array([sample.pose for sample in held]))
        if shift > rules.still_mm or turn > rules.still_deg:
            return f"the probe moved ({shift:.1f} mm, {turn:.1f} degrees): hold still, then accept"
        try:
            peak = fit_peak(*self._sweep(), self.setup.search.full_scale)
        except PlacementError as error:
            return str(error.args[0])
        where = float(np.mean([sample.offset_mm for sample in held]))
        bracket = peak.bracket(where, self.setup.search)
        if abs(bracket.centre_mm) > _BESIDE_MM:
            way = "up" if bracket.centre_mm > 0 else "down"
            return f"the bar is longest {abs(bracket.centre_mm):.1f} mm further {way}"
        self._keep(held, bracket, where)
        return ""

    def _peak(self) -> float:
        """Where the bar is longest, mm: the fitted maximum, or the loudest place without one."""
        offsets, peaks = self._sweep()
        try:
            return fit_peak(offsets, peaks, self.setup.search.full_scale).place_mm
        except PlacementError:
            return float(offsets[int(np.argmax(peaks))])

    def _sweep(self) -> tuple[np.ndarray, np.ndarray]:
        offsets = np.array([sample.offset_mm for sample in self._samples])
        return offsets, np.array([sample.peak for sample in self._samples])

    def _keep(self, held: list[Sample], bracket: Bracket, where: float) -> None:
        times, amplitude = median_times([sample.frame for sample in held])
        pose = mean_pose(np.array([sample.pose for sample in held]))
        self.kept.check_unit(pose, self.recorder)
        self.recorder.add_images([self._images[-1].image])
        self.recorder.add_selected(
            pose,
            times,
            kind="time_of_flight",
            amplitude=amplitude,
            t_host=held[-1].frame.t_host,
            target=self.kept.next_row,
            bracket=bracket,
            offset=where,
        )
        self.kept.add(pose)
        self.person.say(
            f"{self.last_image()}: offset {bracket.centre_mm:+.2f} in "
            f"[{bracket.low_mm:+.2f}, {bracket.high_mm:+.2f}] mm"
        )
        self._new_sweep()


def hand_advice(view: View, peak_mm: float) -> str:
    """What to do next, in words: both flanks must be seen before the maximum counts.

    Args:
        view: of the sweep so far.
        peak_mm: where the bar is longest.
    """
    below, above = sides_seen(view.seen)
    if not below:
        return "slide the probe slowly down (-) until the bar is clearly shorter"
    if not above:
        return "slide it slowly up (+) through the longest bar until it is clearly shorter again"
    away = peak_mm - view.offset_mm
    if view.length >= view.longest // 2 and abs(away) <= 0.5 * _BESIDE_MM:
        return "here it is longest: hold still, Enter accepts"
    if abs(away) <= 0.5 * _BESIDE_MM:
        return "it was longest here but is not now: s restarts the sweep"
    return f"go {abs(away):.1f} mm {'up (+)' if away > 0 else 'down (-)'}, where the bar is longest"
