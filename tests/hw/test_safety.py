"""The gate: whatever the plan, no motion leaves box, cone, caps, freshness or its confirmation."""

from __future__ import annotations

import math
import threading
import tomllib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from hw.robot.confirmation import Challenge, Confirmation, confirm, confirm_unattended
from hw.robot.gate import Command, Gate
from hw.robot.limits import Limits
from hw.robot.motion_plan import MotionPlan, array_of
from hw.robot.path_checks import check_plan
from hw.robot.rtde import PendantSettings
from hw.robot.stream import PoseSample
from hw.runtime.clock import Clock, asleep_s
from hw.runtime.errors import RefusedError, StaleError
from hw.runtime.rigid import pose_to_ur, ur_to_pose

SERIAL = "20195500042"
OFFSET = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
PENDANT = PendantSettings()
TIP = (0.0, 10.0, 60.0)
LIMITS = Limits(
    box_min_mm=(300.0, -200.0, 100.0),
    box_max_mm=(500.0, 0.0, 300.0),
    tip_mm=TIP,
    cone_axis=(0.0, 0.0, -1.0),
    cone_deg=35.0,
    max_step_mm=60.0,
    max_turn_deg=30.0,
    max_speed_mm_s=50.0,
    search_mm=5.0,
    search_deg=1.0,
)
CLOCK = Clock()


def pose(x: float, y: float, z: float, tilt: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """A TCP that looks down, tilted by a rotation vector (deg), at mm."""
    rotation = Rotation.from_rotvec(np.radians(tilt)) * Rotation.from_rotvec([math.pi, 0, 0])
    full = np.eye(4)
    full[:3, :3], full[:3, 3] = rotation.as_matrix(), (x, y, z)
    return full


HOME = pose(400.0, -100.0, 280.0)
PLAN = MotionPlan(
    np.stack([HOME, pose(410.0, -110.0, 280.0, (5.0, 0.0, 0.0)), pose(420.0, -90.0, 270.0)]),
    LIMITS, OFFSET, SERIAL,
)  # fmt: skip


def sample(
    where: np.ndarray, *, age: float = 0.0, safety: int = 1, mode: int = 7, lag: float = 0.0
):
    raw = tuple(float(v) for v in pose_to_ur(where))
    return PoseSample(CLOCK.now() - age, 0.0, raw, safety, mode, 2, lag)


def plan_of(poses: list[np.ndarray], limits: Limits = LIMITS) -> MotionPlan:
    return MotionPlan(np.array(poses), limits, OFFSET, SERIAL)


def gate(plan: MotionPlan = PLAN) -> Gate:
    now = CLOCK.now()
    return Gate(plan, Confirmation(plan.digest, plan.serial, now, now + 1000.0, asleep_s()), CLOCK)


def move(
    target: object,
    start: PoseSample,
    speed: object = None,
    plan: MotionPlan = PLAN,
    force: float = 0.0,
):
    return gate(plan).check_move(
        target, start, speed, serial=SERIAL, tcp_offset=OFFSET, pendant=PENDANT, force_n=force
    )


def assert_safe(command: Command, start: PoseSample, limits: Limits) -> None:
    """Independently of the gate: the path that the controller will take, finely."""
    goal = ur_to_pose(np.array(command.raw))
    part = np.linspace(0.0, 1.0, 1001)
    ends = Rotation.from_matrix(np.stack([start.pose[:3, :3], goal[:3, :3]]))
    turns = Slerp([0.0, 1.0], ends)(part)
    tcp = start.pose[:3, 3] + part[:, None] * (goal[:3, 3] - start.pose[:3, 3])
    tip = tcp + turns.apply(limits.tip_mm)
    assert (tip >= np.array(limits.box_min_mm) - 1e-4).all()
    assert (tip <= np.array(limits.box_max_mm) + 1e-4).all()
    cosine = turns.apply([0.0, 0.0, 1.0]) @ np.array(limits.cone_axis)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() <= limits.cone_deg + 0.01
    assert np.linalg.norm(tcp[-1] - tcp[0]) <= limits.max_step_mm + 1e-4
    assert np.linalg.norm(tip[-1] - tip[0]) <= limits.max_step_mm + 1e-4
    turn = np.degrees((ends[0].inv() * ends[1]).magnitude())
    assert turn <= limits.max_turn_deg + 0.01
    # The controller moves along the longer of metres and radians at the speed it was given.
    length = max(np.linalg.norm(tcp[-1] - tcp[0]) / 1000, math.radians(turn))
    if length > 1e-9:
        seconds = length / command.speed_m_s
        for path in (tcp, tip):
            fastest = np.linalg.norm(np.diff(path, axis=0), axis=1).max() * 1000 / seconds
            assert fastest <= limits.max_speed_mm_s * (1 + 1e-6)
    assert command.acceleration_m_s2 * 1000 <= limits.max_acceleration_mm_s2
    assert all(math.isfinite(v) for v in command.raw)
    assert len(command.raw) == 6


numbers = st.one_of(
    st.floats(-600.0, 600.0),
    st.sampled_from([0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 1e300, 1e-300]),
)
near = st.tuples(st.floats(280.0, 520.0), st.floats(-220.0, 20.0), st.floats(100.0, 400.0))
tilts = st.tuples(*[st.floats(-60.0, 60.0)] * 3)
good_poses = st.builds(lambda p, t: pose(*p, t), near, tilts)
malformed = st.one_of(
    st.lists(numbers, max_size=7),
    st.lists(st.lists(numbers, min_size=4, max_size=4), min_size=4, max_size=4),
    st.builds(lambda p, k, v: _spoilt(p, k, v), good_poses, st.integers(0, 15), numbers),
    st.builds(lambda p: p[:, [1, 0, 2, 3]], good_poses),
    st.builds(lambda p: p.T, good_poses),
    st.none(),
    st.text(max_size=3),
)
speeds = st.one_of(st.none(), st.floats(), st.floats(0.1, 80.0), st.text(max_size=2))
ages = st.one_of(st.floats(0.0, 0.09), st.floats(-1.0, 10.0), st.just(math.nan))


def _spoilt(pose: np.ndarray, k: int, value: float) -> np.ndarray:
    pose = pose.copy()
    pose.flat[k] = value
    return pose


def offer(targets: object, chosen: int, start: np.ndarray, speed: object, age: float) -> bool:
    """Whether a motion came through; if one did, it was safe."""
    try:
        plan = MotionPlan(array_of(targets, "the plan's poses"), LIMITS, OFFSET, SERIAL)
        check_plan(plan)
        now = sample(start, age=age)
        target = plan.targets[chosen % len(plan.targets)]
        command = move(target, now, speed, plan)
    except (RefusedError, StaleError):
        return False
    assert now.age_s(CLOCK.now()) <= 0.1 + 0.5
    assert age <= 0.1
    assert_safe(command, now, LIMITS)
    return True


@settings(max_examples=300)
@given(
    targets=st.one_of(
        malformed,
        st.lists(st.one_of(malformed, good_poses), min_size=1, max_size=4),
        st.lists(good_poses, min_size=1, max_size=4).map(np.array),
    ),
    chosen=st.integers(0, 3),
    start=good_poses,
    speed=speeds,
    age=ages,
)
@example(targets=PLAN.targets, chosen=1, start=HOME, speed=None, age=0.0)
@example(targets=[[0.4, 0.0, 0.3, 0.0, 3.0]], chosen=0, start=HOME, speed=None, age=0.0)
def test_no_plan_however_malformed_sends_an_unsafe_motion(targets, chosen, start, speed, age):
    offer(targets, chosen, start, speed, age)


steps = st.tuples(*[st.floats(-40.0, 40.0)] * 3)
small_tilts = st.tuples(*[st.floats(-25.0, 25.0)] * 3)


def _nearby(start: np.ndarray, step: tuple, tilt: tuple) -> np.ndarray:
    goal = start.copy()
    goal[:3, :3] = Rotation.from_rotvec(np.radians(tilt)).as_matrix() @ start[:3, :3]
    goal[:3, 3] += step
    return goal


def test_many_random_motions_are_safe_and_some_are_allowed():
    came_through = [0]

    @settings(max_examples=400)
    @given(
        corner=st.tuples(st.floats(300, 500), st.floats(-200, 0), st.floats(180, 360)),
        tilt=small_tilts, step=steps, turn=small_tilts, speed=st.floats(0.5, 60.0),
    )  # fmt: skip
    def check(corner, tilt, step, turn, speed):
        start = pose(*corner, tilt)
        came_through[0] += offer([_nearby(start, step, turn)], 0, start, speed, 0.0)

    check()
    assert came_through[0] >= 20


@settings(max_examples=200)
@given(step=st.tuples(*[st.floats(-8.0, 8.0)] * 3), turn=st.floats(-2.0, 2.0), speed=speeds)
def test_searches_stay_in_their_envelope_and_under_their_speed(step, turn, speed):
    goal = _nearby(HOME, step, (turn, 0.0, 0.0))
    start = sample(_nearby(HOME, (0.5, 0.0, 0.0), (0.0, 0.0, 0.0)))
    try:
        command = move(goal, start, speed)
    except (RefusedError, StaleError):
        return
    assert np.linalg.norm(step) <= LIMITS.search_mm + 1e-3
    assert abs(turn) <= LIMITS.search_deg + 1e-2
    assert command.speed_m_s * 1000 <= LIMITS.search_speed_mm_s
    assert_safe(command, start, LIMITS)


def test_a_search_step_and_a_move_between_poses_are_allowed():
    step = move(_nearby(HOME, (0.0, 0.2, 0.0), (0, 0, 0)), sample(HOME))
    assert step.speed_mm_s == LIMITS.search_speed_mm_s
    command = move(PLAN.targets[1], sample(HOME), 30.0)
    assert command.speed_m_s <= 0.030
    np.testing.assert_allclose(ur_to_pose(np.array(command.raw)), PLAN.targets[1], atol=1e-9)


def refused(match: str, *arguments, **named):
    with pytest.raises(RefusedError, match=match):
        move(*arguments, **named)


def test_every_reason_has_its_line():
    with pytest.raises(StaleError, match="ms old"):
        move(HOME, sample(HOME, age=0.101))
    with pytest.raises(StaleError, match="ms old"):
        move(HOME, sample(HOME, lag=0.12))
    refused("of another clock", HOME, sample(HOME, age=-5.0))
    refused("protective stop", HOME, sample(HOME, safety=0b101))
    refused("not running", HOME, sample(HOME, mode=5))
    refused("neither a planned pose nor", pose(430, -90, 270), sample(HOME))
    refused("is not within 0.01 and 10 mm/s", HOME, sample(HOME), 11.0)
    refused("is not within 0.01 and 50 mm/s", PLAN.targets[1], sample(HOME), 51.0)
    for speed in (True, False, 1e-300, 0.0, -1.0, math.nan, "10"):
        refused("is not within", PLAN.targets[1], sample(HOME), speed)
    for force in (20.1, math.inf, math.nan):
        refused("meets the tool", HOME, sample(HOME), force=force)
    refused("over the cap of 60 mm", HOME, sample(pose(400, -100, 345)))
    refused("over the cap of 30 deg", HOME, sample(pose(400, -100, 280, (31, 0, 0))))
    refused("NaN", np.full((4, 4), np.nan), sample(HOME))
    refused("shape", np.array([0.4, 0.0, 0.3, 0.0, 3.0]), sample(HOME))
    refused("not a rotation", HOME @ np.diag([-1.0, 1, 1, 1]), sample(HOME))
    with pytest.raises(RefusedError, match=r"probe's tip 6\.\d+ mm out of the box along y"):
        check_plan(plan_of([pose(400, -5, 280, (20.0, 0, 0))]))
    tilted = plan_of([pose(400, -100, 280, (34.9, 0, 0))])
    check_plan(tilted)
    with pytest.raises(RefusedError, match="pose 1 of the plan tilts the tool 36"):
        check_plan(plan_of([pose(400, -100, 280, (36.0, 0, 0))]))


def test_the_box_bounds_the_tip_and_not_the_tcp():
    # The TCP is above the box; the tip, 60 mm below it, is inside.
    assert HOME[2, 3] - TIP[2] < LIMITS.box_max_mm[2]
    above = pose(400.0, -100.0, 355.0)
    assert above[2, 3] > LIMITS.box_max_mm[2]
    check_plan(plan_of([above]))
    below = pose(400.0, -100.0, 155.0)
    assert below[2, 3] > LIMITS.box_min_mm[2]
    with pytest.raises(RefusedError, match="out of the box along z"):
        check_plan(plan_of([below]))


def test_the_tip_s_arc_is_checked_between_two_poses_inside():
    # Both ends just inside; in the middle of the turn the tip dips out through the bottom.
    limits = replace(LIMITS, box_min_mm=(300.0, -200.0, 219.3), search_mm=0.0, search_deg=0.0)
    ends = [pose(400.0, -100.0, 280.0, (tilt, 0.0, 0.0)) for tilt in (-14.0, 14.0)]
    for end in ends:
        check_plan(plan_of([end], limits))
    with pytest.raises(RefusedError, match="the way from pose 1 to pose 2 takes the probe's tip"):
        check_plan(plan_of(ends, limits))


def confirmed(plan: MotionPlan = PLAN) -> Confirmation:
    challenge = Challenge(plan)
    return confirm(challenge, f" {challenge.code.upper()}\n", clock=CLOCK)


def test_a_confirmation_moves_only_its_plan():
    others = [
        replace(PLAN, targets=PLAN.targets[:2]),
        replace(PLAN, targets=PLAN.targets + 1e-9 * np.eye(4)[:, [3, 0, 1, 2]]),
        replace(PLAN, limits=replace(LIMITS, max_speed_mm_s=51.0)),
        replace(PLAN, tcp_offset=(0.0, 0.0, 0.11, 0.0, 0.0, 0.0)),
        replace(PLAN, serial="20195500043"),
        replace(PLAN, pendant=PendantSettings(1.0)),
        replace(PLAN, pendant=PendantSettings(0.0, (0.0, 0.0, 0.01))),
        replace(PLAN, pendant=PendantSettings(None, None)),
        replace(PLAN, pendant=PendantSettings(speed_fraction=0.5)),
    ]
    mine = confirmed()
    for other in others:
        assert other.digest != PLAN.digest
        with pytest.raises(RefusedError, match="for another plan"):
            Gate(other, mine, CLOCK).check_authority(other.serial, other.tcp_offset, other.pendant)
        with pytest.raises(RefusedError, match="another plan was named"):
            confirm_unattended(other, PLAN.digest, clock=CLOCK)
    assert replace(PLAN, targets=PLAN.targets.copy()).digest == PLAN.digest


def test_a_code_is_of_one_run_only():
    first, second = Challenge(PLAN), Challenge(PLAN)
    assert first.code != second.code
    assert PLAN.digest[:8] not in (first.code, second.code)
    for answer in ("", "yes", PLAN.digest, PLAN.digest[:8], "0" * 8, first.code):
        with pytest.raises(RefusedError, match="not the one shown"):
            confirm(second, answer, clock=CLOCK)
    assert not confirm(second, second.code, clock=CLOCK).unattended
    with pytest.raises(RefusedError, match="was typed before"):
        confirm(second, second.code, clock=CLOCK)


def test_one_of_two_threads_that_answer_at_once_is_confirmed():
    """Both were: each looked whether the code had been typed before the other noted it."""
    both = threading.Barrier(2)

    class Typed(str):
        def strip(self, *_: object) -> str:
            both.wait(10.0)
            return str(self)

    def answer(typed: str) -> Confirmation | None:
        with suppress(RefusedError):
            return confirm(challenge, typed, clock=CLOCK)

    challenge = Challenge(PLAN)
    with ThreadPoolExecutor(2) as pool:
        given = list(pool.map(answer, [Typed(challenge.code)] * 2))
    assert given.count(None) == 1


def test_unattended_motion_names_its_plan():
    assert confirm_unattended(PLAN, f" {PLAN.digest[:16].upper()} ", clock=CLOCK).unattended
    for digest in ("", "yes", PLAN.digest[:15]):
        with pytest.raises(RefusedError, match="at least 16 digits"):
            confirm_unattended(PLAN, digest, clock=CLOCK)
    with pytest.raises(RefusedError, match="another plan was named"):
        confirm_unattended(PLAN, "0" * 64, clock=CLOCK)


def test_a_confirmation_is_bound_to_robot_and_what_is_set_at_the_pendant():
    mine = confirmed()
    good = Gate(PLAN, mine, CLOCK)
    good.check_start(SERIAL, OFFSET, PENDANT)
    heavy, slow = PendantSettings(0.5), PendantSettings(speed_fraction=0.9)
    for text, found, arguments in [
        ("connected is 1", good, ("1", OFFSET, PENDANT)),
        ("is not the plan's", good, (SERIAL, (0.0, 0.0, 0.1001, 0.0, 0.0, 0.0), PENDANT)),
        ("is not known", good, (SERIAL, None, PENDANT)),
        ("finite numbers", good, (SERIAL, (math.nan,) * 6, PENDANT)),
        ("finite numbers", good, (SERIAL, OFFSET[:5], PENDANT)),
        ("payload is 0.5 kg, not 0.0", good, (SERIAL, OFFSET, heavy)),
        ("speed slider is at 90 %, not 100", good, (SERIAL, OFFSET, slow)),
        ("not known", good, (SERIAL, OFFSET, None)),
        ("needs the operator", Gate(PLAN, None, CLOCK), (SERIAL, OFFSET, PENDANT)),
    ]:
        with pytest.raises(RefusedError, match=text):
            found.check_authority(*arguments)
        with pytest.raises(RefusedError, match=text):
            found.check_start(*arguments)
        serial, offset, pendant = arguments
        with pytest.raises(RefusedError, match=text):
            found.check_move(
                HOME, sample(HOME), None, serial=serial, tcp_offset=offset, pendant=pendant,
                force_n=0.0,
            )  # fmt: skip
    unsafe = plan_of([pose(400, -100, 700)])
    for ask in (Challenge, lambda plan: confirm_unattended(plan, plan.digest, clock=CLOCK)):
        with pytest.raises(RefusedError, match="out of the box"):
            ask(unsafe)


def test_a_slow_speed_slider_gives_a_motion_more_time():
    """The controller slows every motion down by it; a motion that is late is stopped for good."""
    slow = replace(PLAN, pendant=PendantSettings(speed_fraction=0.25))
    for target in PLAN.targets:
        fast, slowed = (
            gate(plan).check_geometry(target, sample(HOME), None) for plan in (PLAN, slow)
        )
        assert slowed.duration_s == pytest.approx(4 * fast.duration_s)
        assert (slowed.raw, slowed.speed_m_s) == (fast.raw, fast.speed_m_s)
    for fraction in (0.0, -1.0, math.nan):
        with pytest.raises(RefusedError, match="speed slider is at 0 %"):
            replace(PLAN, pendant=PendantSettings(speed_fraction=fraction))


def test_a_confirmation_that_expires_ends_no_plan_that_was_begun():
    mine = confirmed()
    for late in (
        replace(mine, expires_s=CLOCK.now()),
        replace(mine, issued_s=1e9),
        # The computer has slept since.
        replace(mine, asleep_s=mine.asleep_s - 700.0),
    ):
        gate_of_late = Gate(PLAN, late, CLOCK)
        with pytest.raises(RefusedError, match="expired"):
            gate_of_late.check_start(SERIAL, OFFSET, PENDANT)
        # Begun in time, it goes on.
        gate_of_late.check_authority(SERIAL, OFFSET, PENDANT)


def test_a_plan_cannot_be_changed_after_its_digest():
    mutable = PLAN.targets.copy()
    plan = MotionPlan(mutable, LIMITS, OFFSET, SERIAL)
    mutable[0, 0, 3] = 9999.0
    assert plan.digest == PLAN.digest
    with pytest.raises(ValueError, match="read-only"):
        plan.targets[0, 0, 3] = 9999.0


TOML = """
[limits]
box_min_mm = [300, -200, 100]
box_max_mm = [500.0, 0.0, 300.0]
tip_mm = [0.0, 10.0, 60.0]
cone_axis = [0.0, 0.0, -1.0]
cone_deg = 35.0
max_step_mm = 60.0
max_turn_deg = 30
max_speed_mm_s = 50.0
search_mm = 5.0
search_deg = 1.0
"""


def test_limits_from_a_file():
    assert Limits.from_mapping(tomllib.loads(TOML)["limits"]) == LIMITS


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("cone_deg = 35.0", "", "cone_deg is missing"),
        ("cone_deg", "cone_degrees", "unknown limit cone_degrees"),
        ("cone_deg = 35.0", "cone_deg = nan", "cone_deg must be a finite number"),
        ("cone_deg = 35.0", "cone_deg = true", "cone_deg must be a finite number"),
        ("cone_deg = 35.0", "cone_deg = 180.0", "at most 90"),
        ("max_step_mm = 60.0", "max_step_mm = inf", "finite"),
        ("max_speed_mm_s = 50.0", "max_speed_mm_s = 1000.0", "at most 250"),
        ("search_mm = 5.0", "search_mm = -0.5", "search_mm must be 0 to 50, not -0.5"),
        ("search_mm = 5.0", "search_mm = 5.0\nmin_singular_value_mm = 0.5", "must be 1 to 100,"),
        ("search_mm = 5.0", "search_mm = 5.0\nsearch_speed_mm_s = 20.0", "at most 10"),
        ("search_mm = 5.0", "search_mm = 5.0\nmax_pose_age_s = 0.2", r"0\.02 to 0\.1, not 0\.2$"),
        ("[500.0, 0.0, 300.0]", "[500.0, 0.0]", "3 finite numbers"),
        ("[500.0, 0.0, 300.0]", "'a lot'", "3 finite numbers"),
        ("[500.0, 0.0, 300.0]", "[500.0, 0.0, 100.0]", "below box_max_mm"),
        ("[0.0, 0.0, -1.0]", "[0.0, 0.0, -3.0]", "unit vector"),
    ],
)
def test_limits_that_do_not_limit_are_refused(old, new, text):
    values = tomllib.loads(TOML.replace(old, new))["limits"]
    with pytest.raises(RefusedError, match=text):
        Limits.from_mapping(values)
