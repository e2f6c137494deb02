"""What a caller and the process that moves the robot tell each other, one JSON object a line.

The caller sends the setup first, then requests:

- ``move``: a pose and a speed. Moves are counted.
- ``stop``: an error and the count of the move that it is about.
- ``heard``: the caller is alive.
- ``close``: the caller is done.

The process answers ``ready``, ``arrived`` or ``error``, and in between tells ``log``, ``stopping``
and ``alive``; ``closed`` is its last word if nothing went wrong.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, replace

import numpy as np

from hw.robot.confirmation import Confirmation
from hw.robot.limits import Limits
from hw.robot.motion_plan import MotionPlan
from hw.robot.rtde import PendantSettings
from hw.robot.stream import PoseSample
from hw.runtime.clock import Clock
from hw.runtime.errors import DeviceError, LostError, RefusedError, StaleError, StoppedError

_KINDS = {kind.__name__: kind for kind in (LostError, RefusedError, StaleError, StoppedError)}

WATCHDOG = "the robot's own watchdog stops it. Motion needs a new confirmation"
"""What follows where nobody can command the robot any more."""
DASHBOARD_STOP = "dashboard: stop"
"""What is logged before the dashboard is asked to stop the program."""
MAY_BE_PAUSED = "the program may be paused: stop it at the pendant before you go on there"
"""What follows where the dashboard did not say that it stopped the program."""


@dataclass(frozen=True)
class Setup:
    """What the process must know to connect.

    Attributes:
        host: the controller's address.
        plan: what may be done.
        confirmation: of that plan; None only for a dry run.
        clock: bench time.
        dry_run: check and log, but send nothing to the robot.
        caller_s: bench seconds that the caller may be silent during a motion.
    """

    host: str
    plan: MotionPlan
    confirmation: Confirmation | None
    clock: Clock
    dry_run: bool
    caller_s: float

    def message(self) -> dict:
        """The setup as the first line of the process's input."""
        given = self.confirmation
        plan = asdict(self.plan) | {"targets": self.plan.targets.tolist()}
        told = None if given is None else {k: v for k, v in vars(given).items() if k != "use"}
        clock = asdict(self.clock)
        return {**vars(self), "plan": plan, "confirmation": told, "clock": clock}

    @classmethod
    def of(cls, message: dict) -> Setup:
        """The setup of a line of input.

        Raises:
            RefusedError: it holds no plan.
        """
        plan, given = message["plan"], message["confirmation"]
        cog = plan["pendant"]["payload_cog_m"]
        cog = None if cog is None else tuple(cog)
        pendant = PendantSettings(**{**plan["pendant"], "payload_cog_m": cog})
        limits, offset = Limits.from_mapping(plan["limits"]), tuple(plan["tcp_offset"])
        made = {
            # Without joints: they permit nothing, and may be others by now.
            "plan": MotionPlan(
                np.array(plan["targets"]), limits, offset, plan["serial"], pendant=pendant
            ),
            "confirmation": None if given is None else Confirmation(**given),
            "clock": Clock(**message["clock"]),
        }
        return cls(**{**message, **made})


def plain(sample: PoseSample) -> dict:
    """A pose as it is sent; the joints are not."""
    return asdict(replace(sample, joints=None))


def sample_of(values: dict) -> PoseSample:
    """The pose that was sent as :func:`plain`."""
    return PoseSample(**{**values, "raw": tuple(values["raw"])})


def told(error: DeviceError) -> dict[str, str]:
    """An error as it is sent."""
    return {"kind": type(error).__name__, "text": error.args[0]}


def error_of(message: dict) -> DeviceError | None:
    """The error that was sent as :func:`told`; None if none was."""
    if "kind" not in message:
        return None
    return _KINDS.get(str(message["kind"]), LostError)(str(message["text"]), device="robot")


def line_of(message: dict) -> bytes:
    """A message as it goes through the pipe."""
    return json.dumps(message, default=str).encode() + b"\n"


class Caller:
    """The caller, at the other end of two pipes.

    Args:
        requests: descriptor from which its lines are read.
        answers: descriptor to which it is told.
    """

    def __init__(self, requests: int, answers: int) -> None:
        self._requests, self._answers = requests, answers
        self._data = b""
        self._parent = os.getppid()
        self.closed = False
        """Whether it has asked to close, or has closed its end."""

    @property
    def left(self) -> bool:
        """Whether it is gone or going, so that the robot must be stopped.

        When it is killed, the system closes its end, unless a child of it holds the same pipe.
        """
        return self.closed or os.getppid() != self._parent

    def fileno(self) -> int:
        """For select."""
        return self._requests

    def first(self) -> dict | None:
        """Wait for the first line; None if the input ends before.

        Lines that were read with it stay for :meth:`read_so_far`: a stop may be among them.
        """
        while b"\n" not in self._data:
            if not self._receive():
                return None
        line, _, self._data = self._data.partition(b"\n")
        return json.loads(line)

    def read(self) -> list[dict]:
        """Wait for input; the requests that have come."""
        self.closed = not self._receive() or self.closed
        return self.read_so_far()

    def read_so_far(self) -> list[dict]:
        """The requests that have been read but not returned."""
        *lines, self._data = self._data.split(b"\n")
        return [json.loads(line) for line in lines]

    def _receive(self) -> bool:
        """Read once; whether anything came before the input's end."""
        data = os.read(self._requests, 65536)
        self._data += data
        return bool(data)

    def tell(self, what: str, **values: object) -> None:
        """Send it a message; that nobody listens any more is noted, and is no error."""
        view = memoryview(line_of({"what": what, **values}))
        try:
            while view:
                view = view[os.write(self._answers, view) :]
        except BrokenPipeError:
            self.closed = True
