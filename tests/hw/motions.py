"""A plan for an emulated robot, and what was sent to it: for tests of motion."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from robots import CB_SERIES, E_SERIES, START, EmulatedRobot

from hw.robot.confirmation import confirm_unattended
from hw.robot.identity import read_identity
from hw.robot.limits import Limits
from hw.robot.motion import Motion
from hw.robot.motion_plan import MotionPlan
from hw.runtime.rigid import ur_to_pose

HOME = ur_to_pose(np.array(START))
SERIAL = "of the robot at hand"
OFFSET = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
STOP_WITHIN_S = 0.2
SERIES = {"CB": CB_SERIES, "e": E_SERIES}


def beside(*mm: float) -> np.ndarray:
    pose = HOME.copy()
    pose[:3, 3] += mm
    return pose


LIMITS = Limits(
    box_min_mm=(330.0, -170.0, 180.0),
    box_max_mm=(470.0, -30.0, 320.0),
    tip_mm=(0.0, 0.0, 50.0),
    cone_axis=tuple(float(v) for v in HOME[:3, 2]),
    cone_deg=20.0,
    max_step_mm=60.0,
    max_turn_deg=20.0,
    max_speed_mm_s=50.0,
    max_acceleration_mm_s2=500.0,
    search_mm=3.0,
    search_deg=0.5,
)
PLAN = MotionPlan(np.array([HOME, beside(10.0, 5.0, 0.0), beside(50.0, 0.0, 0.0)]), LIMITS,
                  OFFSET, SERIAL)  # fmt: skip


def confirmed(robot: EmulatedRobot, plan: MotionPlan = PLAN, **named) -> Motion:
    """A motion that is not started yet."""
    if plan.serial == SERIAL:
        plan = replace(plan, serial=read_identity(robot.host).name)
    given = confirm_unattended(plan, plan.digest, clock=robot.clock)
    return Motion(robot.host, plan, given, clock=robot.clock, dry_run=False, **named)


@contextmanager
def moving(
    robot: EmulatedRobot, log: list | None = None, plan: MotionPlan = PLAN, **named
) -> Iterator[Motion]:
    keep = None if log is None else lambda *entry: log.append(entry)
    with confirmed(robot, plan, log=keep, **named) as motion:
        yield motion


def put_in_order(robot: EmulatedRobot) -> EmulatedRobot:
    """End every fault, and set at the pendant what the plan says; a program is left to itself.

    A test calls it itself, since one in real time may run again with the same robot.
    """
    robot.ask("unmute")
    robot.ask("mute control", False)
    robot.ask("freeze", False)
    robot.ask("heed stops", True)
    robot.ask("pause", False)
    robot.ask("pause before", None)
    robot.ask("stamps", 1000.0, 1.0)
    robot.ask("overspeed", 1.0)
    robot.ask("dashboard", None)
    robot.ask("remote", True)
    robot.ask("robot_state", 7, 1)
    robot.ask("bits", 0, 0)
    robot.ask("payload", 0.0)
    robot.ask("speed_slider", 1.0)
    robot.ask("tcp_offset", OFFSET)
    robot.ask("force", [0.0] * 6)
    return robot


def farther(robot: EmulatedRobot) -> np.ndarray:
    """The one of two poses of the plan, 50 mm apart, that the arm is farther from."""
    x = robot.state()["raw"][0] * 1000.0
    return max(PLAN.targets[0], PLAN.targets[2], key=lambda pose: abs(x - pose[0, 3]))


def only_asked(state: dict) -> bool:
    """Whether the dashboard was only asked, or told to stop the program: no power, no unlocking."""
    asked = {"PolyscopeVersion", "get serial number", "get robot model", "is in remote control"}
    return set(state["dashboard"]) <= asked | {"stop"}


def sent(robot: EmulatedRobot, code: int) -> list[tuple[float, ...]]:
    return [tuple(values) for _, command, values in robot.state()["log"] if command == code]
