"""The experiment: for each pose of the plan move, place, record, and say what is known so far.

Every image is on the disk before the next move, so it is kept whatever happens. When a device
fails, the robot is stopped and the run ends with one line. The recording can be resumed, after a
new confirmation, to take the images that are still missing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from hw.acquire_live import Estimator
from hw.errors import DeviceError, LostError, StaleError
from hw.job import Job, motion_plan, open_recorder, prepare, record_confirmed, resume_command
from hw.keys import Pause
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
from hw.planner import Planner
from hw.recorder import Recorder
from hw.request import AcquisitionRequest
from hw.robot.motion import Motion
from hw.robot.safety import Confirmation, MotionPlan, check_plan, check_sample
from hw.session import Session, Watch, median_times
from hw.setup import Setup
from hw.stage import ProbeStage
from hw.view.feed import Audience, Nobody, watched
from jaxcal import CalibrationError
from jaxcal.cli.common import ExitCode

_MOST_GIVEN_UP = 3
_FURTHEST_START_MM = 3.0
_IMAGES_FOR_PREDICTION = 8
NOT_CHECKED = (
    "reach, joints and singularities are NOT checked: neither the setup ([robot] model) nor the "
    "controller names an arm that is known"
)


class AcquisitionStopped(CalibrationError):
    """A run that ended early; one line with what happened and what to do next.

    Attributes:
        exit_code: of the command line.
        by_itself: whether it may be resumed without a person's help.
    """

    def __init__(self, message: str, *, interrupted: bool = False, by_itself: bool = False) -> None:
        super().__init__(message)
        self.by_itself = by_itself
        self.exit_code = ExitCode.INTERRUPTED if interrupted else ExitCode.STOPPED


@runtime_checkable
class Oracle(Protocol):
    """What an emulated bench knows of the truth."""

    def elevation_mm(self) -> float:
        """The target's true elevational offset, now."""
        ...

    def truth(self) -> tuple[np.ndarray, np.ndarray]:
        """The true X (4, 4) and target (3,), mm."""
        ...

    def test_set(self) -> tuple[np.ndarray, np.ndarray]:
        """Noise-free test images: poses (n, 4, 4) and [lateral, range] (n, 2), mm."""
        ...


@dataclass(frozen=True)
class Outcome:
    """Result of a completed run.

    Attributes:
        images: selected.
        given_up: rows of the plan for which no mid-plane was found, or that were skipped.
        sha256: of the finished file.
        seconds: bench seconds that this run took.
        resume: what to type to be asked for the poses in ``given_up`` again; None if there are none
            or other poses took their place.
    """

    images: int
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
    oracle: Oracle | None = None,
    operator: Callable[[], Operator] = SteadyOperator,
    pause: Pause | None = None,
    watch: Watch | None = None,
    view: Audience | None = None,
) -> Outcome:
    """Run the experiment to its end, or go on with one that ended early.

    Args:
        setup: the bench.
        path: the recording: to make, or with ``request`` None to resume.
        request: what to acquire; None resumes the recording at ``path``.
        confirm: asked once before anything moves, with the plan of motion; resuming asks again.
        say: told one line after every image, and of everything that a person should know.
        oracle: of an emulated bench; its truth goes into the recording.
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
    reason, interrupted, by_itself = "interrupted", False, False
    try:
        with _closing(recorder):
            try:
                return _run(
                    job,
                    recorder,
                    estimator,
                    confirm,
                    say,
                    oracle,
                    operator,
                    pause,
                    watch,
                    Nobody() if view is None else view,
                )
            except KeyboardInterrupt:
                interrupted = True
            except (DeviceError, CalibrationError) as error:
                reason = str(error)
                # A stream that hesitated or a watchdog that tripped: a person would only try again.
                by_itself = isinstance(error, StaleError | LostError)
            # Motion has ended by now: no process of ours moves the robot any more.
            with suppress(CalibrationError):
                recorder.add_event("stopped", reason, setup.clock.now())
                if job.progress is not None and job.progress.ended:
                    # It was complete before this run, and stays so.
                    if oracle is not None:
                        _write_truth(recorder, oracle)
                    _finish(recorder, job.images - estimator.count)
    except KeyboardInterrupt:
        # Ctrl-C once more, while everything was being closed: the pipe's end stops the robot.
        interrupted, by_itself = True, False
    if recorder.error is not None and not interrupted:
        # The recorder's failure is the cause of what went wrong.
        reason = str(recorder.error)
    raise AcquisitionStopped(
        f"{reason}; {estimator.count} of {job.images} images are in {recorder.kept}; put it "
        f"right, then: {resume_command(recorder.kept, job.request)}",
        interrupted=interrupted,
        by_itself=by_itself and recorder.error is None,
    )


@contextmanager
def _closing(recorder: Recorder) -> Iterator[None]:
    """Close a recorder at the end; its failure, if any, is in its ``error``."""
    try:
        yield
    finally:
        with suppress(CalibrationError):
            recorder.close()


def _run(
    job: Job,
    recorder: Recorder,
    estimator: Estimator,
    confirm: Confirm,
    say: Callable[[str], None],
    oracle: Oracle | None,
    operator: Callable[[], Operator],
    pause: Pause | None,
    watch: Watch | None,
    view: Audience,
) -> Outcome:
    setup, clock = job.setup, job.setup.clock
    started = clock.now()

    def note(kind: str, text: str) -> None:
        recorder.add_event(kind, text, clock.now())
        say(f"{kind}: {text}")

    note("resumed" if job.progress else "started", f"{job.to_take} images to take")
    for change in job.changes:
        note("changed", change)
    session = Session(setup, recorder, watch=watch, every_frame=job.request.every_frame)
    given_up: list[int] = []
    skipped: list[int] = []
    with session, watched(view, session):
        plan = motion_plan(job, session)
        check_sample(session.poses.latest(), plan.limits, clock)
        course = check_plan(plan)
        note("arm", NOT_CHECKED if course is None else f"{plan.limits.arm_model}: {course.text}")
        done = [row for row in range(len(job.targets)) if row not in job.missing]
        view.plan(setup, plan, job.targets, done)
        confirmation = confirm(plan)
        record_confirmed(job, plan, session, recorder)
        by = "unattended: nobody was asked" if confirmation.unattended else "by the operator"
        note("confirmed", f"{by}; plan {plan.digest[:16]} for robot {plan.serial}, {plan.pendant}")

        def log(t: float, command: str, numbers: dict[str, object]) -> None:
            # Runs in the thread that hears the motion process; the recorder keeps its own error.
            with suppress(CalibrationError):
                recorder.add_event("command", f"{command} {json.dumps(numbers)}", t)

        motion = Motion(
            setup.robot_host,
            plan,
            confirmation,
            clock=clock,
            dry_run=False,
            log=log,
            guard=session.trouble,
            caller_s=setup.caller_s,
        )
        with motion:
            stage = ProbeStage(session, motion, job.targets, note)
            failures = 0
            for row in _rows(job, estimator, session, note):
                if pause is not None and pause.held:
                    note("paused", "before the next image")
                    pause.wait()
                    note("continued", "by the operator")
                began = clock.now()
                view.going(row)
                try:
                    placement = _place(job, row, stage, estimator, operator, view)
                    shot = _shoot(job, row, stage, session)
                except SkippedError as error:
                    skipped.append(row)
                    view.given_up(row)
                    note("skipped", f"pose {row + 1}: {error.args[0]}")
                    continue
                except PlacementError as error:
                    given_up.append(row)
                    view.given_up(row)
                    note("given up", f"pose {row + 1}: {error}")
                    session.check()
                    failures += 1
                    if failures == _MOST_GIVEN_UP:
                        raise
                    continue
                failures = 0
                _take(job, row, session, recorder, estimator, placement, shot, oracle, began)
                view.taken(row, placement, estimator.answer)
                say(estimator.line(job.images, placement))
    if oracle is not None:
        _write_truth(recorder, oracle)
    note("finished", f"{estimator.count} images")
    without = tuple(sorted(given_up + skipped))
    # A pool has other poses for those without an image.
    again = without if job.request.plan == "sobol" else ()
    digest = _finish(recorder, len(again))
    return Outcome(
        estimator.count,
        without,
        digest,
        clock.now() - started,
        resume_command(recorder.kept, job.request) if again else None,
    )


def _finish(recorder: Recorder, without_image: int) -> str:
    """Mark the recording complete; poses without an image may still be asked for again."""
    recorder.attributes("plan", {"without_image": without_image})
    return recorder.finish()


def _rows(
    job: Job, estimator: Estimator, session: Session, note: Callable[[str, str], None]
) -> Iterator[int]:
    """The poses to visit, one after the other; a pose given up does not come again in this run."""
    if job.request.plan == "sobol":
        yield from job.missing
        return
    planner = Planner(job.targets, job.setup, job.request.until_tre_mm)
    left = job.missing
    while left and estimator.count < job.images:
        here = session.poses.latest().pose
        choice = planner.choose(left, estimator.poses, here, estimator.answer)
        if choice.text:
            note("planned", choice.text)
        if choice.row is None:
            return
        left.remove(choice.row)
        yield choice.row


def _place(
    job: Job,
    row: int,
    stage: ProbeStage,
    estimator: Estimator,
    operator: Callable[[], Operator],
    view: Audience,
) -> Placement:
    pose, settings = job.targets[row], job.setup.search
    start = estimator.expected_offset_mm(pose) if estimator.count >= _IMAGES_FOR_PREDICTION else 0.0
    start = float(np.clip(start, -_FURTHEST_START_MM, _FURTHEST_START_MM))
    stage.go_to(row)
    if job.request.by_image:
        bench = stage.image_bench(row, credible=job.request.placement == "none")
        if job.request.placement == "image-scan":
            return image_scan(bench, settings, start, watch=view.stop)
        return first_seen(bench, settings, start, watch=view.stop)
    match job.request.placement:
        case "threshold-climb":
            return threshold_climb(stage, settings, start, watch=view.stop)
        case "amplitude-scan":
            return amplitude_scan(stage, settings, start, watch=view.stop)
        case "pattern-injection":
            title = f"pose {row + 1} of {len(job.targets)}"
            return pattern_injection(
                stage,
                stage,
                operator(),
                settings,
                start,
                frame=stage.frame,
                title=title,
                watch=view.stop,
            )
    return first_seen(stage, settings, 0.0, watch=view.stop)


@dataclass(frozen=True)
class _Shot:
    """What was measured at the place where the probe stands."""

    pose: np.ndarray
    measurement: np.ndarray
    amplitude: float


def _shoot(job: Job, row: int, stage: ProbeStage, session: Session) -> _Shot:
    """Average the pose, and listen or look.

    Raises:
        PlacementError: no frame shows a credible target.
        DeviceError: a device is in lasting trouble.
    """
    steady = session.poses.steady(job.setup.settle_s)
    if job.request.by_image:
        measurement, amplitude = stage.locate(row)
    else:
        heard = session.listen(job.setup.frames, stage.arrived_s)
        measurement, amplitude = median_times(heard)
    stage.check()
    session.record_image()
    return _Shot(steady.sample.pose, measurement, amplitude)


def _take(
    job: Job,
    row: int,
    session: Session,
    recorder: Recorder,
    estimator: Estimator,
    placement: Placement,
    shot: _Shot,
    oracle: Oracle | None,
    began: float,
) -> None:
    """Select the image, and solve again."""
    clock, bracket = job.setup.clock, placement.bracket
    recorder.add_selected(
        shot.pose,
        shot.measurement,
        kind=job.request.kind,
        max_elevation=bracket.max_elevation_mm,
        amplitude=shot.amplitude,
        t_host=clock.now(),
        target=row,
        bracket=(bracket.centre_mm, bracket.low_mm, bracket.high_mm, bracket.sd_mm),
        offset=placement.offset_mm,
        true_elevation=float("nan") if oracle is None else oracle.elevation_mm(),
        seconds=clock.now() - began,
    )
    estimate = estimator.add(shot.pose, shot.measurement, bracket.max_elevation_mm)
    if estimate is not None:
        recorder.add_estimate({"t_host": np.array([clock.now()]), **estimate})


def _write_truth(recorder: Recorder, oracle: Oracle) -> None:
    recorder.sync()
    transform, point = oracle.truth()
    poses, points = oracle.test_set()
    recorder.put("truth", "image_to_probe", transform, "mm")
    recorder.put("truth", "point", point, "mm")
    recorder.put("test", "pose", poses, "mm")
    recorder.put("test", "point", points, "mm")
    recorder.copy("placement", "true_elevation", "truth", "elevation")
