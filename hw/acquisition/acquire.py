"""The experiment: for each pose of the plan move, place, record, and say what is known so far.

Every image is on the disk before the next move, so it is kept whatever happens. When a device
fails, the robot is stopped and the run ends with one line. The recording can be resumed, after a
new confirmation, to take the images that are still missing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from hw.acquisition.job import (
    Job,
    motion_plan,
    open_recorder,
    prepare,
    record_confirmed,
    resume_command,
)
from hw.acquisition.live_estimate import Estimator
from hw.acquisition.planner import Planner
from hw.acquisition.request import AcquisitionRequest
from hw.acquisition.stage import ProbeStage
from hw.midplane.amplitude_scan import amplitude_scan
from hw.midplane.bracket import Placement
from hw.midplane.image_scan import image_scan
from hw.midplane.pattern_injection import (
    Operator,
    SkippedError,
    SteadyOperator,
    pattern_injection,
)
from hw.midplane.search import PlacementError, first_seen
from hw.midplane.threshold_climb import threshold_climb
from hw.recording.check import Progress
from hw.recording.recorder import Recorder, no_digest
from hw.recording.resuming import compare_electronics, described_electronics
from hw.recording.session import Session, SilenceLimits, median_times
from hw.robot.confirmation import Confirmation
from hw.robot.gate import check_sample
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.robot.path_checks import check_plan
from hw.runtime.clock import Clock
from hw.runtime.errors import DeviceError, LostError, StaleError
from hw.runtime.keys import Pause
from hw.setup.description import Setup
from hw.view.feed import Audience, watched
from jaxcal import CalibrationError
from jaxcal.cli.common import ExitCode

if TYPE_CHECKING:
    from hw.bench.run import Bench

_MOST_GIVEN_UP = 3
_FURTHEST_START_MM = 3.0
_IMAGES_FOR_PREDICTION = 8
NOT_CHECKED = (
    "reach, joints and singularities are NOT checked: neither the setup ([robot] model) nor the "
    "controller names a known arm"
)


class AcquisitionStopped(CalibrationError):
    """A run that ended early; one line with what happened and what to do next.

    Attributes:
        reason: what happened.
        exit_code: of the command line.
        by_itself: whether it may be resumed without a person's help.
    """

    def __init__(
        self, reason: str, then: str, *, interrupted: bool = False, by_itself: bool = False
    ) -> None:
        super().__init__(f"{reason}; {then}")
        self.reason = reason
        self.by_itself = by_itself
        self.exit_code = ExitCode.INTERRUPTED if interrupted else ExitCode.STOPPED


@dataclass(frozen=True)
class Outcome:
    """Result of a completed run.

    Attributes:
        images: selected, in the whole recording.
        taken: of them in this run.
        given_up: rows of the plan for which no mid-plane was found, or that were skipped.
        sha256: of the finished file.
        seconds: bench seconds that this run took.
        resume: what to type to be asked for the poses in ``given_up`` again; None if there are none
            or other poses took their place.
    """

    images: int
    taken: int
    given_up: tuple[int, ...]
    sha256: str
    seconds: float
    resume: str | None = None


Confirm = Callable[[MotionPlan], Confirmation]


def acquire(
    setup: Setup,
    path: str | os.PathLike[str],
    request: AcquisitionRequest | None,
    confirm: Confirm,
    *,
    say: Callable[[str], None] = lambda line: None,
    emulated: Bench | None = None,
    operator: Callable[[], Operator] = SteadyOperator,
    pause: Pause | None = None,
    watch: SilenceLimits | None = None,
    view: Audience | None = None,
) -> Outcome:
    """Run the experiment to its end, or go on with one that ended early.

    Args:
        setup: the bench.
        path: the recording: to make, or with ``request`` None to resume.
        request: what to acquire; None resumes the recording at ``path``.
        confirm: asked once before anything moves, with the plan of motion; resuming asks again.
        say: told one line after every image, and of everything that a person should know.
        emulated: the bench, if it is emulated; its truth goes into the recording.
        operator: called for every pose; makes the operator that follows the injected pattern.
        pause: to hold the run between images.
        watch: limits of the devices' silence.
        view: told of the progress; it gives nothing back.

    Returns:
        The outcome; the file is complete then.

    Raises:
        AcquisitionStopped: a device failed, the person interrupted or refused: one line, the file
            closed and resumable.
        InputError: a plan or a recording that cannot be used; nothing moved.
        OutputError: the recording cannot be made; nothing moved.
    """
    job = prepare(setup, path, request)
    estimator = Estimator(job.images, setup, job.progress, job.request.kind)
    pool = "" if job.images == len(job.targets) else f" from a pool of {len(job.targets)}"
    say(f"plan: {job.images} poses{pool}, {job.to_take} to go; compiling the estimate")
    estimator.warm_up(job.targets[: job.images])
    recorder = open_recorder(path, job)
    reason, interrupted, by_itself, by_device = "interrupted", False, False, False
    failure: Exception | None = None

    def note_end() -> None:
        # Motion has ended by now: no process of ours moves the robot any more.
        with suppress(CalibrationError):
            recorder.add_event("stopped", reason, setup.clock.now())
            if job.progress is not None and job.progress.ended:
                # It was complete before this run, and stays so.
                if emulated is not None:
                    _write_truth(recorder, emulated, job.progress)
                _finish(recorder, job.images - estimator.count)

    try:
        # If it cannot be closed, its ``error`` says why.
        with suppress(CalibrationError), recorder:
            try:
                try:
                    run = _Run(
                        job, recorder, estimator, say, emulated, operator, pause, view or Audience()
                    )
                    return run.outcome(confirm, watch)
                except (DeviceError, CalibrationError) as error:
                    reason = str(error)
                    # A stream that hesitated or a watchdog that tripped: a person would only try
                    # again.
                    by_itself = isinstance(error, StaleError | LostError)
                    by_device = isinstance(error, DeviceError)
                except Exception as error:
                    # Standard error is gone, or a fault of this program: for the caller to report.
                    reason, failure = f"{type(error).__name__}: {error}", error
                note_end()
            except KeyboardInterrupt:
                # Also while the end for another reason was noted.
                interrupted, by_itself = True, False
                note_end()
    except KeyboardInterrupt:
        # Ctrl-C once more, while everything was being closed: the pipe's end stops the robot. What
        # waits for the disk is still written; a further Ctrl-C ends the wait.
        interrupted, by_itself = True, False
        with suppress(CalibrationError, KeyboardInterrupt):
            recorder.close()
    if failure is not None:
        raise failure
    if recorder.error is not None and not interrupted:
        # Its failure is the cause of what went wrong, or hid from the file what else did.
        told = str(recorder.error)
        reason = f"{reason}; {told}" if by_device and told not in reason else told
    then = "to go on" if interrupted else "correct this, then"
    raise AcquisitionStopped(
        reason,
        f"{estimator.count} of {job.images} images are in {recorder.kept}; {then}: "
        f"{resume_command(recorder.kept, job)}",
        interrupted=interrupted,
        by_itself=by_itself and recorder.error is None,
    )


@dataclass
class _Run:
    """One way through a job; arguments as of :func:`acquire`."""

    job: Job
    recorder: Recorder
    estimator: Estimator
    say: Callable[[str], None]
    emulated: Bench | None
    operator: Callable[[], Operator]
    pause: Pause | None
    view: Audience
    without: list[int] = field(default_factory=list)
    """Rows of the plan for which there is no image: given up, or skipped by the operator."""

    @property
    def clock(self) -> Clock:
        """Bench time."""
        return self.job.setup.clock

    def outcome(self, confirm: Confirm, watch: SilenceLimits | None) -> Outcome:
        """Open the devices, have the plan confirmed, take the images, and finish the file."""
        job, recorder, estimator = self.job, self.recorder, self.estimator
        started, before = self.clock.now(), estimator.count
        self._note("resumed" if job.progress else "started", f"{job.to_take} images to take")
        for change in job.changes:
            self._note("changed", change)
        session = Session(job.setup, recorder, watch=watch, every_frame=job.request.every_frame)
        with session, watched(self.view, session):
            motion = self._confirmed(session, confirm)
            with motion:
                self._take_images(session, ProbeStage(session, motion, job.targets, self._note))
        if self.emulated is not None:
            _write_truth(recorder, self.emulated, job.progress)
        self._note("finished", f"{estimator.count} images")
        without = tuple(sorted(self.without))
        # A pool has other poses for those without an image.
        again = without if job.request.plan == "sobol" else ()
        digest = _finish(recorder, len(again))
        if recorder.digest_error is not None:
            self.say(no_digest(recorder.digest_error))
        return Outcome(
            estimator.count,
            estimator.count - before,
            without,
            digest,
            self.clock.now() - started,
            resume_command(recorder.kept, job) if again else None,
        )

    def _note(self, kind: str, text: str) -> None:
        self.recorder.add_event(kind, text, self.clock.now())
        self.say(f"{kind}: {text}")

    def _log(self, t: float, command: str, numbers: dict[str, object]) -> None:
        # Runs in a thread of its own; the recorder keeps its own error.
        with suppress(CalibrationError):
            self.recorder.add_event("command", f"{command} {json.dumps(numbers)}", t)

    def _confirmed(self, session: Session, confirm: Confirm) -> Motion:
        """The motion of the plan, once that was checked and confirmed; not started yet."""
        job, setup = self.job, self.job.setup
        plan = motion_plan(job, session)
        if job.progress is not None:
            now = described_electronics(session.echo)
            for change in compare_electronics(job.progress.electronics, now):
                self._note("changed", change)
        check_sample(session.poses.awaited(), plan.limits, self.clock)
        course = check_plan(plan)
        reach = NOT_CHECKED if course is None else f"{plan.limits.arm_model}: {course.text}"
        self._note("arm", reach)
        done = [row for row in range(len(job.targets)) if row not in job.missing]
        self.view.plan(setup, plan, job.targets, done, job.images)
        confirmation = confirm(plan)
        record_confirmed(job, plan, session, self.recorder)
        by = "unattended: nobody was asked" if confirmation.unattended else "by the operator"
        text = f"{by}; plan {plan.digest[:16]} for robot {plan.serial}, {plan.pendant}"
        self._note("confirmed", text)
        return Motion(
            setup.robot_host,
            plan,
            confirmation,
            clock=self.clock,
            dry_run=False,
            log=self._log,
            guard=session.trouble,
            caller_s=setup.caller_s,
        )

    def _take_images(self, session: Session, stage: ProbeStage) -> None:
        """Visit the poses one after the other; those without a mid-plane are left out."""
        view, failures = self.view, 0
        for row in self._rows(session):
            if self.pause is not None and self.pause.held:
                self._note("paused", "before the next image")
                self.pause.wait()
                self._note("continued", "by the operator")
            began = self.clock.now()
            view.going(row)
            try:
                placement = self._place(row, stage)
                shot = self._shoot(row, stage, session)
            except PlacementError as error:
                self.without.append(row)
                view.given_up(row)
                if isinstance(error, SkippedError):
                    self._note("skipped", f"pose {row + 1}: {error.args[0]}")
                    continue
                self._note("given up", f"pose {row + 1}: {error}")
                session.check()
                failures += 1
                if failures == _MOST_GIVEN_UP:
                    raise
                continue
            failures = 0
            self._select(row, placement, shot, began)
            view.taken(row, placement, self.estimator.answer)
            self.say(self.estimator.line(self.job.images, placement))

    def _rows(self, session: Session) -> Iterator[int]:
        """The poses to visit in turn; a pose given up does not come again in this run."""
        job, estimator = self.job, self.estimator
        if job.request.plan == "sobol":
            yield from job.missing
            return
        planner = Planner(job.targets, job.setup, job.request.until_tre_mm)
        left = job.missing
        while left and estimator.count < job.images:
            here = session.poses.awaited().pose
            choice = planner.choose(left, estimator.poses, here, estimator.answer)
            if choice.text:
                self._note("planned", choice.text)
            if choice.row is None:
                return
            left.remove(choice.row)
            yield choice.row

    def _place(self, row: int, stage: ProbeStage) -> Placement:
        """Go to a pose, and bring the target into the mid-plane as the request says."""
        job, estimator, watch = self.job, self.estimator, self.view.stop
        pose, settings, placement = job.targets[row], job.setup.search, job.request.placement
        start = 0.0
        if estimator.count >= _IMAGES_FOR_PREDICTION:
            expected = estimator.expected_offset_mm(pose)
            start = float(np.clip(expected, -_FURTHEST_START_MM, _FURTHEST_START_MM))
        stage.go_to(row)
        if job.request.by_image:
            bench = stage.image_bench(row, credible=placement == "none")
            if placement == "image-scan":
                return image_scan(bench, settings, start, watch=watch)
            return first_seen(bench, settings, start, watch=watch)
        match placement:
            case "threshold-climb":
                return threshold_climb(stage, settings, start, watch=watch)
            case "amplitude-scan":
                return amplitude_scan(stage, settings, start, watch=watch)
            case "pattern-injection":
                return pattern_injection(
                    stage,
                    stage,
                    self.operator(),
                    settings,
                    start,
                    frame=stage.frame,
                    title=f"pose {row + 1} of {len(job.targets)}",
                    watch=watch,
                )
        return first_seen(stage, settings, 0.0, watch=watch)

    def _shoot(
        self, row: int, stage: ProbeStage, session: Session
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Average the pose, and listen or look; the pose, the measurement and its amplitude.

        Raises:
            PlacementError: no frame shows a credible target.
            DeviceError: a device is in lasting trouble, or the pose changed at rest.
        """
        setup = self.job.setup
        pose = stage.resting_pose(setup.settle_s)
        if self.job.request.by_image:
            # The frame that is measured is the one that is recorded.
            measurement, amplitude, image = stage.locate(row)
        else:
            heard = session.listen(setup.frames, stage.arrived_s)
            measurement, amplitude = median_times(heard)
            # The newest one of a slow machine may be from before the probe came to rest.
            image = stage.any_frame()
        stage.check()
        if image is not None:
            session.record_image(image)
        return pose, measurement, amplitude

    def _select(
        self,
        row: int,
        placement: Placement,
        shot: tuple[np.ndarray, np.ndarray, float],
        began: float,
    ) -> None:
        """Put the image among those of the calibration, and solve again."""
        clock, bracket, emulated = self.clock, placement.bracket, self.emulated
        pose, measurement, amplitude = shot
        self.recorder.add_selected(
            pose,
            measurement,
            kind=self.job.request.kind,
            amplitude=amplitude,
            t_host=clock.now(),
            target=row,
            bracket=bracket,
            offset=placement.offset_mm,
            true_elevation=float("nan") if emulated is None else emulated.elevation_mm(),
            seconds=clock.now() - began,
        )
        estimate = self.estimator.add(pose, measurement, bracket.max_elevation_mm)
        if estimate is not None:
            self.recorder.add_estimate(t_host=clock.now(), **estimate)


def _finish(recorder: Recorder, without_image: int) -> str:
    """Mark the recording complete; poses without an image may still be asked for again."""
    recorder.attributes("plan", {"without_image": without_image})
    return recorder.finish()


def _write_truth(recorder: Recorder, emulated: Bench, progress: Progress | None) -> None:
    recorder.sync()
    poses, points = emulated.test_set()
    recorder.put("test", "pose", poses, "mm")
    recorder.put("test", "point", points, "mm")
    if progress is not None and not np.isfinite(progress.true_elevation).all():
        # The placement of an image was lost; /truth holds all images or is not there.
        return
    world = emulated.world_truth()
    recorder.put("truth", "image_to_probe", world["image_to_probe"], "mm")
    recorder.put("truth", "point", world["point_mm"], "mm")
    recorder.copy("placement", "true_elevation", "truth", "elevation")
