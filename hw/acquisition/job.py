"""What is still to be acquired, of a new recording or of one that is resumed."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, replace

import numpy as np

from hw.acquisition.request import AcquisitionRequest, planned, request_in
from hw.recording.check import Progress, check_resumable, read_progress, resumed_offset_s
from hw.recording.file import RecordingWriter
from hw.recording.layout import RecordingHeader
from hw.recording.recorder import Recorder
from hw.recording.resuming import (
    check_same_robot,
    compare,
    described,
    described_electronics,
)
from hw.recording.session import Session
from hw.robot.identity import LOCAL
from hw.robot.motion_plan import MotionPlan
from hw.robot.path_checks import check_path, check_plan
from hw.runtime.errors import RefusedError, refused
from hw.setup.description import Setup, controller_arm
from jaxcal.io.given_files import naming
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import command_line


@dataclass(frozen=True)
class Job:
    """What to acquire.

    Attributes:
        setup: the bench.
        request: as it was asked for, now or when the recording was begun.
        targets: (n, 4, 4) poses, mm: the plan in the order of travel, or the pool to choose from.
        progress: of the recording that is resumed; None for a new one.
        changes: lines that a person has to confirm with the plan
            (:func:`hw.recording.resuming.compare`).
    """

    setup: Setup
    request: AcquisitionRequest
    targets: np.ndarray
    progress: Progress | None
    changes: tuple[str, ...] = ()

    @property
    def missing(self) -> list[int]:
        """Rows of the poses without an image."""
        taken = set() if self.progress is None else set(self.progress.taken.tolist())
        return [row for row in range(len(self.targets)) if row not in taken]

    @property
    def images(self) -> int:
        """Most images of the whole recording."""
        return min(self.request.images, len(self.targets))

    @property
    def to_take(self) -> int:
        """Images that are still to be taken, at most."""
        return self.images - (len(self.targets) - len(self.missing))


def prepare(setup: Setup, path: str | os.PathLike[str], request: AcquisitionRequest | None) -> Job:
    """What is to be done; ``request`` None resumes the recording at ``path``.

    Raises:
        InputError: a plan that cannot be made, or a recording that does not fit this bench.
    """
    if request is not None:
        return Job(setup, request, planned(setup, request).poses, None)
    if not check_resumable(path):
        # Cut the file back to whole rows first, so that only these are read.
        RecordingWriter.resume(path).close()
    progress = read_progress(path)
    with naming(path):
        request = request_in(progress.settings)
        changes = compare(progress, setup)
    return Job(setup, request, progress.targets, progress, tuple(changes))


def open_recorder(path: str | os.PathLike[str], job: Job) -> Recorder:
    """A writer that makes the recording of a new job, or goes on with that of a resumed one."""
    if job.progress is not None:
        gap = resumed_offset_s(job.progress.last_s, job.setup.clock.now())
        return Recorder(path, time_offset_s=gap)
    probe = job.setup.probe
    header = RecordingHeader(
        kind=job.request.kind,
        probe={"kind": probe.kind, **asdict(probe)},
        lines=probe.elements,
        settings=json.dumps(
            {"request": asdict(job.request), "bench": described(job.setup, job.targets)}
        ),
    )
    recorder = Recorder(path, header)
    recorder.put("plan", "targets", job.targets, "mm")
    # A recording that is there can be resumed, whatever happens next.
    recorder.sync()
    return recorder


def motion_plan(job: Job, session: Session) -> MotionPlan:
    """The plan that the confirmation is bound to; on resume the robot must be the same one.

    Raises:
        RefusedError: another robot, or a controller that does not report what must be confirmed.
    """
    identity = session.poses.identity()
    if identity.remote is False:
        raise refused(LOCAL)
    offset = session.poses.tcp_offset or job.setup.tcp_offset
    if offset is None:
        raise refused(
            "this controller does not report its TCP offset: put it into the setup as "
            "[robot] tcp_offset = [x, y, z, rx, ry, rz] (m, rad); it is compared before moving"
        )
    if job.progress is not None:
        check_same_robot(job.progress.settings.get("robot"), identity.name, offset)
    pendant = session.poses.pendant
    if pendant is None:
        raise refused("the controller does not report its speed slider")
    limits = job.setup.motion_limits(controller_arm(identity.model, identity.version))
    here = session.poses.awaited()
    whole = MotionPlan(job.targets, limits, offset, identity.name, here.joints, pendant)
    # The order in which poses of a pool are visited is not known yet.
    return plan_to_go(whole, job.missing, here.pose) if job.request.plan == "sobol" else whole


def plan_to_go(whole: MotionPlan, missing: list[int], here: Float[np.ndarray, "4 4"]) -> MotionPlan:
    """Only the poses without an image, if each can be reached directly from the one before.

    Otherwise all poses: the way leads through those that have an image
    (:meth:`hw.acquisition.stage.ProbeStage.go_to`).

    Args:
        whole: plan of all poses.
        missing: rows without an image, in order; where there are none, only the end of the file is
            missing, and any plan will do.
        here: (4, 4) mm, where the robot is.
    """
    if not missing:
        return whole
    direct = replace(whole, targets=whole.targets[missing])
    try:
        check_path(direct, here, direct.targets[0], "the way to the first pose")
        check_plan(direct)
    except RefusedError:
        return whole
    return direct


def record_confirmed(job: Job, plan: MotionPlan, session: Session, recorder: Recorder) -> None:
    """Keep with which robot and bench the images to come are taken.

    Only once the plan is confirmed: what was refused must be told again when the run is resumed.
    """
    known = {"serial_number": plan.serial, "tcp_offset": list(plan.tcp_offset)}
    bench = described(job.setup, job.targets)
    settings = {"request": asdict(job.request), "robot": known, "bench": bench}
    recorder.put("plan", "settings", np.frombuffer(json.dumps(settings).encode(), np.uint8), "1")
    recorder.attributes("tracker", known)
    recorder.attributes("ae", {**described_electronics(session.echo), "trigger_delay_s": 0.0})
    recorder.sync()


def resume_command(path: str | os.PathLike[str], job: Job) -> str:
    """What to type to go on with a recording."""
    emulated = job.request.bench is not None
    where = ["--bench"] if emulated else ["--setup", job.setup.source, "--move"]
    return command_line(["jaxcal-hw", "acquire", os.fspath(path), "--resume", *where])
