"""Hostile and mistaken setups: each is refused with one line, and nothing moves.

The setups are those of the attack: units mixed up, a second tip beside the scene's, limits that
bound nothing, numbers that overflow. Each goes through the command line's own entry.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from hw.cli.main import main
from hw.robot.limits import numbers
from hw.runtime.errors import RefusedError

GOOD = """
[robot]
host = "127.0.0.1"
model = "UR5"
tcp_offset = [0, 0, 0.12, 0, 0, 0]
[active_echo]
url = "/dev/null"
[scene]
image_to_probe = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 60], [0, 0, 0, 1]]
point_mm = [350, -250, 80]
looking = [0, 0, -1]
[limits]
box_min_mm = [180, -420, 40]
box_max_mm = [520, -80, 270]
cone_axis = [0, 0, -1]
cone_deg = 60
max_step_mm = 250
max_turn_deg = 120
max_speed_mm_s = 50
search_mm = 25
search_deg = 0.5
[plan]
cone_deg = 30
"""

TIP_M = "[0, 0, 1, 0.06], [0"


def dry_run(folder: Path, text: str, capsys: pytest.CaptureFixture) -> tuple[int, str, str]:
    path = folder / "bench.toml"
    path.write_text(text)
    status = main(["acquire", str(folder / "out.h5"), "--setup", str(path), "--images", "8"])
    told = capsys.readouterr()
    assert not (folder / "out.h5").exists()
    return status, told.out, told.err


def test_the_good_setup_passes(tmp_path, capsys):
    status, out, _ = dry_run(tmp_path, GOOD, capsys)
    assert status == 0
    assert "a UR5 can reach every pose along every path" in out


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        # Units.
        ("[0, 0, 1, 60], [0", TIP_M, "0.06 mm from the TCP: are its lengths in metres?"),
        ("[0, 0, 1, 60], [0", "[0, 0, 1, 0], [0", "add tip_at_tcp = true"),
        ("[0, 0, 1, 60], [0", "[0, 0, 1, 60000], [0", "60000 mm from the TCP, over 500 mm"),
        ("[0, 0, 1, 60], [0", "[0, 0, 1, 1e9], [0", "1e+09 mm from the TCP, over 500 mm"),
        ("[350, -250, 80]", "[0.35, -0.25, 0.08]", "mm from the robot's base: it is in mm"),
        ("0.12, 0, 0, 0]", "120, 0, 0, 0]", "120 m long: is it in mm?"),
        ("[limits]", "[probe]\npitch_mm = 0.000457\n[limits]", "pitch_mm is in mm"),
        ("max_speed_mm_s = 50", "max_speed_mm_s = 0.05", "max_speed_mm_s must be above 0.25"),
        ("[plan]", "max_acceleration_mm_s2 = 0.1\n[plan]", "mm_s2 must be above 2"),
        # A second tip.
        ("[limits]", "[limits]\ntip_mm = [0, 0, 0]", "contradicts [scene] image_to_probe"),
        ("[limits]", "[limits]\ntip_mm = [0, 0, 0.06]", "contradicts [scene] image_to_probe"),
        # Boxes and caps that bound nothing.
        ("[180, -420, 40]", "[-1e12, -1e12, -1e12]", "within 2000 mm of the base"),
        ("[520, -80, 270]", "[1e308, 1e308, 1e308]", "within 2000 mm of the base"),
        ("[520, -80, 270]", "[520, -80, 1990]", "a UR5 with this tool reaches"),
        ("max_step_mm = 250", "max_step_mm = 1000", "max_step_mm must be above 0 and at most 500"),
        ("search_mm = 25", "search_mm = 100", "search_mm must be"),
        ("search_deg = 0.5", "search_deg = 30", "search_deg must be"),
        ("[plan]", "max_force_n = 250\n[plan]", "needs a sentence why: force_reason"),
        # Caps by which every move would be refused, but only at the robot.
        (
            "[plan]",
            "max_force_n = 1e-3\n[plan]",
            "2 to 250, not 0.001: an arm that touches nothing",
        ),
        ("[plan]", "max_pose_age_s = 1e-3\n[plan]", "0.02 to 0.1, not 0.001: the newest pose"),
        ("[plan]", "min_singular_value_mm = 0\n[plan]", "min_singular_value_mm must be"),
        ("[plan]", "arm_box_min_mm = [-1e9, -1e9, -1e9]\n[plan]", "arm_box_min_mm and"),
        ("[plan]", "joint_max_deg = [720, 720, 720, 720, 720, 720]\n[plan]", "within 360 deg"),
        # Numbers that overflow.
        ("max_speed_mm_s = 50", f"max_speed_mm_s = {10**400}", "a number of 401 characters"),
        ("max_speed_mm_s = 50", f"max_speed_mm_s = 1{'0' * 5000}", "a number of 5001 characters"),
        ("max_speed_mm_s = 50", f"max_speed_mm_s = {10**99}", "max_speed_mm_s must be"),
        ("[plan]\ncone_deg = 30", f"[plan]\ncone_deg = {10**99}", "cone_deg must be"),
        ("[350, -250, 80]", f"[350, -250, {10**99}]", "it is in mm"),
        ("tcp_offset = [0, 0, 0.12, 0", "tcp_offset = [0, 0, 0.12, 180", "is it in degrees?"),
        ("tcp_offset = [0, 0", f"tcp_offset = [0, {10**99}", "is it in mm?"),
        ("max_speed_mm_s = 50", "max_speed_mm_s = 1e400", "must be a finite number"),
        # Arms that are none, that do not reach, that bump into the table.
        ('"UR5"', '"KUKA"', "no arm 'KUKA' is known"),
        ('"UR5"', '"UR3"', "of the plan"),
        ("[350, -250, 80]", "[750, -550, 80]", "0 of 8 poses stay"),
        ("[plan]", "joint_min_deg = [0, 0, 0, 0, 0, 0]\n[plan]", "over its limits"),
        ("[plan]", "arm_box_max_mm = [2000, 2000, 300]\n[plan]", "out of the arm's box"),
        ("max_speed_mm_s = 50", "max_speed_mm_s = 50\nmax_joint_speed_deg_s = 2", "lower the"),
    ],
)
def test_a_setup_that_would_unbind_the_box_is_refused(tmp_path, capsys, old, new, what):
    assert old in GOOD
    status, out, error = dry_run(tmp_path, GOOD.replace(old, new, 1), capsys)
    assert status in (2, 4)
    assert out == ""
    assert what in error
    assert error.count("\n") == 1


def test_numbers_beyond_the_largest_float_are_no_numbers():
    for value in (10**400, -(10**5000), [10**400]):
        with pytest.raises(RefusedError, match="must be a finite number"):
            numbers([value], 1, "max_speed_mm_s")


def test_what_is_stated_is_accepted(tmp_path, capsys):
    """The keys that the refusals name do what they say."""
    tip = GOOD.replace("[0, 0, 1, 60], [0", "[0, 0, 1, 0], [0")
    tip = tip.replace("looking", "tip_at_tcp = true\nlooking")
    tip = tip.replace("0.12, 0, 0, 0]", "0.18, 0, 0, 0]")
    assert dry_run(tmp_path, tip, capsys)[0] == 0
    force = GOOD.replace("[plan]", "max_force_n = 150\nforce_reason = 'a stiff phantom'\n[plan]")
    status, out, _ = dry_run(tmp_path, force, capsys)
    assert status == 0
    assert "force 150 N (a stiff phantom)" in out
    same = GOOD.replace("[limits]", "[limits]\ntip_mm = [0, 0, 60]")
    assert dry_run(tmp_path, same, capsys)[0] == 0


def test_the_array_s_corners_count_where_the_tip_would_pass(tmp_path, capsys):
    """All tips of this plan stay 7 mm above the floor; the ends of the array do not."""
    floor = GOOD.replace("[180, -420, 40]", "[180, -420, 94]").replace("[plan]", "[probe]\n[plan]")
    narrow = floor.replace("[probe]", "[probe]\nhousing_mm = [1, 1, 1]")
    assert dry_run(tmp_path, narrow, capsys)[0] == 0
    status, _, error = dry_run(tmp_path, floor, capsys)
    assert status == 4
    assert "a corner of the probe" in error
    assert "out of the box along z" in error
