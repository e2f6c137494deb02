"""What must stop the robot: state of robot, program and connection; force, speed, box, silence."""

from __future__ import annotations

import math

from hw.robot.gate import Command
from hw.robot.identity import LOCAL
from hw.robot.mover.controller import PAUSED, Controller, unfit
from hw.robot.mover.inputs import Inputs, Stop, lost
from hw.robot.mover.messages import Setup
from hw.robot.path_checks import out_of_box_mm
from hw.robot.rtde import FREEDRIVE_PRESSED, PROGRAM_RUNS
from hw.runtime.errors import StaleError, StoppedError

_BOX_MARGIN_MM = 1.0
_FASTER, _FASTER_MM_S = 1.2, 10.0
"""The speed that the controller reports may be this many times the one commanded, and this more:
room for its noise and for the overshoot of a real arm (assumptions)."""


class Monitor:
    """Looks for trouble in what has come.

    Args:
        setup: limits, clock, and how long the caller may be silent.
        inputs: packets and the caller's signs of life.
        controller: its connection, and whether the robot is in local control.
    """

    def __init__(self, setup: Setup, inputs: Inputs, controller: Controller) -> None:
        self._limits, self._clock, self._caller_s = setup.plan.limits, setup.clock, setup.caller_s
        self._inputs, self._controller = inputs, controller
        self._lever_mm = math.hypot(*self._limits.tip_mm)

    def trouble(self, moving: Command | None) -> Stop | None:
        """Why the robot must stop, and whether that ends motion for good; None: it may go on.

        Every packet since the last call counts: a gate may have been open only for a moment.

        Args:
            moving: the motion that runs; None at rest.

        Raises:
            Ended: the connection, or the answers that come over it, are lost.
        """
        inputs = self._inputs
        packets = inputs.unseen()
        if self._controller.rtde_control is None:
            return None
        for packet in packets:
            stopped = unfit(packet)
            if stopped is not None:
                return Stop(stopped, True)
        if any(packet.status_bits & FREEDRIVE_PRESSED for packet in packets):
            return _for_good("the freedrive button was pressed: somebody wants to guide the arm")
        if any(packet.paused for packet in packets):
            return _for_good(PAUSED)
        if self._controller.local:
            return _for_good(f"{LOCAL}; then confirm the plan again")
        if inputs.program_ended or not inputs.packet.status_bits & PROGRAM_RUNS:
            return Stop(self._controller.program_stopped(), True)
        if not self._controller.connected:
            return Stop(lost("the control connection was reset"), True)
        if moving is None:
            return None
        sample, limits, now = inputs.sample, self._limits, self._clock.now()
        if sample.age_s(now) > self._clock.patience(limits.max_pose_age_s):
            return _hesitation(
                f"no fresh pose: the newest is {sample.age_text(now)}; the motion was stopped"
            )
        self._controller.check_answers()
        force = max(packet.force_n for packet in packets)
        if force > limits.max_force_n:
            return _for_good(f"a force of {force:.1f} N, over the cap of {limits.max_force_n:g} N")
        speed = max(packet.speed_mm_s + packet.turning_rad_s * self._lever_mm for packet in packets)
        if speed > _FASTER * moving.speed_mm_s + _FASTER_MM_S:
            return _for_good(
                f"the robot moves at {speed:.0f} mm/s: {moving.speed_mm_s:g} mm/s was commanded"
            )
        out = out_of_box_mm(sample.pose, limits)
        if out > _BOX_MARGIN_MM:
            return _for_good(f"the probe is {out:.1f} mm out of the box")
        silent = now - inputs.heard_s
        if silent > self._clock.patience(self._caller_s):
            # A fault of this software, like a silent stream: nothing says that motion is dangerous.
            return _hesitation(f"the caller was silent for {silent:.2f} s")
        return None


def _for_good(text: str) -> Stop:
    return Stop(StoppedError(text, device="robot"), True)


def _hesitation(text: str) -> Stop:
    return Stop(StaleError(text, device="robot"), False)
