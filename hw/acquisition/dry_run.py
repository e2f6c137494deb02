"""An acquisition without motion: its plan against the limits, in words and as a figure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hw.acquisition.request import AcquisitionRequest, planned
from hw.planning.poses import preview
from hw.robot.limits import Limits
from hw.robot.motion_plan import MotionPlan, plan_lines
from hw.robot.path_checks import check_plan
from hw.setup.description import Setup
from jaxcal import InputError


def dry_run(
    setup: Setup, path: str, request: AcquisitionRequest | None, figure: str | None
) -> list[str]:
    """What an acquisition would do, checked against the limits; nothing is opened.

    Raises:
        InputError: a plan that cannot be made.
        RefusedError: a plan that the limits do not allow; it names the first pose or way.
    """
    if request is None:
        raise InputError("--resume needs --move: a dry run has nothing to resume")
    plan = planned(setup, request)
    motion = MotionPlan(plan.poses, _dry_limits(setup), setup.tcp_offset or (0.0,) * 6, "dry run")
    course = check_plan(motion)
    if figure is not None:
        box = np.array([motion.limits.box_min_mm, motion.limits.box_max_mm], float)
        preview(plan, Path(figure), box)
    if course is None:
        known = "model" if setup.tcp_offset is not None else "model and tcp_offset"
        arm = (
            "kinematics NOT checked here: reach, joints, singularities and links of the arm are "
            f"checked before the confirmation, or now with [robot] {known} in the setup"
        )
    else:
        arm = f"a {motion.limits.arm_model} can reach every pose along every path: {course.text}"
    return [
        f"dry run: {_poses(request, len(plan))}, {request.placement}, the tip travels "
        f"{plan.travel_mm:.0f} mm ({plan.passed_over} poses passed over)",
        *plan_lines(motion, tcp_offset_known=setup.tcp_offset is not None),
        "every pose, and every path between successive poses, is within the limits",
        arm,
        "not checked: which arm it is, its TCP offset, payload and speed slider; they are read, "
        "shown and confirmed with --move (jaxcal-hw check shows them now)",
        f"nothing moved and {path} was not written; add --move to acquire",
    ]


def _poses(request: AcquisitionRequest, count: int) -> str:
    if request.plan == "sobol":
        return f"{count} poses"
    return f"at most {request.images} images; all {count} poses of the pool were checked"


def _dry_limits(setup: Setup) -> Limits:
    """The limits, without the arm's model where the setup lacks the controller's TCP offset."""
    limits = setup.motion_limits()
    return limits if setup.tcp_offset is not None else replace(limits, arm_model="")
