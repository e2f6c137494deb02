"""A bench's description: what is read, and what is refused with one line."""

from __future__ import annotations

import re
import shlex
import socket
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import jaxcal
from hw.acquisition.job import Job, resume_command
from hw.acquisition.request import AcquisitionRequest
from hw.cli.main import main
from hw.runtime.errors import LostError
from hw.setup.check import _ultrasound as look_at_ultrasound
from hw.setup.description import _TABLES, load_setup

GOOD = """
[robot]
host = "192.168.1.10"
settle_s = 1
[active_echo]
url = "/dev/ttyUSB0"
[ultrasound]
host = "192.168.1.20"
[probe]
elements = 64
pitch_mm = 0.4
sound_speed_m_s = 1480
[scene]
image_to_probe = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 60], [0, 0, 0, 1]]
point_mm = [350, -250, 80]
looking = [0, 0, -1]
[limits]
box_min_mm = [200, -400, 40]
box_max_mm = [500, -100, 260]
cone_axis = [0, 0, -1]
cone_deg = 60
max_step_mm = 250
max_turn_deg = 120
max_speed_mm_s = 50
search_mm = 25
search_deg = 0.5
[plan]
cone_deg = 20
depth_mm = [20, 60]
box_mm = [[0, 0, 0], [100, 100, 100]]
[search]
fine_mm = 0.2
frames = 5
"""

LIMITS = GOOD[GOOD.index("[limits]") : GOOD.index("[plan]")]


def test_a_description_is_read(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(GOOD)
    setup = load_setup(path)
    assert setup.robot_host == "192.168.1.10"
    assert setup.settle_s == 1.0
    assert setup.ultrasound == ("192.168.1.20", 18944)
    assert setup.probe == jaxcal.LinearProbe(64, 0.4, 1480.0)
    assert setup.extent.depth_mm == (20, 60)
    assert setup.extent.box_mm == ((0, 0, 0), (100, 100, 100))
    assert (setup.search.fine_mm, setup.search.frames) == (0.2, 5)
    assert setup.limits["cone_deg"] == 60
    np.testing.assert_array_equal(setup.scene.tip_mm, [0, 0, 60])
    job = Job(setup, AcquisitionRequest(), np.zeros((0, 4, 4)), None)
    assert resume_command("r.h5", job) == (
        f"jaxcal-hw acquire r.h5 --resume --setup {shlex.quote(str(path))} --move"
    )
    path.write_text(GOOD.replace("search_mm = 25", "search_mm = 8"))
    assert load_setup(path).search == replace(setup.search, reach_mm=8.0)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ('host = "192.168.1.10"', "", r"\[robot\] needs host"),
        ('url = "/dev/ttyUSB0"', "", r"\[active_echo\] needs url"),
        ('url = "/dev/ttyUSB0"', "url = 3", "must be text"),
        ("settle_s = 1", "settle_s = -1", "positive"),
        ("settle_s = 1", "settle_s = 300", r"\[robot\] settle_s must be positive and at most 30"),
        ("settle_s = 1", "settle = 1", "has no 'settle'"),
        ("settle_s = 1", "frequency_hz = 1e-30", r"\[robot\] frequency_hz must be 20 to 1000"),
        ("settle_s = 1", "frequency_hz = 1e30", r"\[robot\] frequency_hz must be 20 to 1000"),
        ("elements = 64", "elements = 64.5", "whole number"),
        ("elements = 64", "elements = 1", "elements"),
        ("point_mm = [350, -250, 80]", "point_mm = [350, nan, 80]", "point_mm must be 3 numbers"),
        ("looking = [0, 0, -1]", "", "needs looking"),
        (LIMITS, "", "nothing may move"),
        ("cone_deg = 60", "cone_degrees = 60", r"\[limits\] unknown limit cone_degrees"),
        ("box_min_mm = [200, -400, 40]", "", r"\[limits\] the limit box_min_mm is missing"),
        ("looking = [0, 0, -1]", "looking = [0, 0, 0]", r"\[scene\] looking is a direction"),
        (
            "box_min_mm = [200, -400, 40]\nbox_max_mm = [500, -100, 260]",
            "box_min_mm = [0.2, -0.4, 0.04]\nbox_max_mm = [0.5, -0.1, 0.26]",
            r"\[limits\] box_min_mm and box_max_mm .* are they in metres\?",
        ),
        ("depth_mm = [20, 60]", "depth_mm = [0.02, 0.06]", r"depth_mm .* is it in m\?"),
        ("max_step_mm = 250", "max_step_mm = 1000", r"\[limits\] max_step_mm must be above 0"),
        ("[[1, 0, 0, 0]", "[[-1, 0, 0, 0]", r"\[scene\] image_to_probe is a reflection"),
        ("[[1, 0, 0, 0]", "[[2, 0, 0, 0]", r"\[scene\] image_to_probe is not a rotation"),
        ("[350, -250, 80]", '["350", -250, 80]', "point_mm must be 3 numbers"),
        ("depth_mm = [20, 60]", "depth_mm = [[1, 2, 3], [1, 2, 3]]", "depth_mm must be 2 numbers"),
        ("depth_mm = [20, 60]", "depth_mm = [true, 60]", "depth_mm must be 2 numbers"),
        ("[100, 100, 100]]", "4]", r"\[plan\] box_mm must be 2 x 3 numbers"),
        ('"192.168.1.20"', '"a..b"', r"\[ultrasound\] host 'a\.\.b' is not the name or address"),
        ('"192.168.1.20"', f'"{"a" * 300}"', r"\[ultrasound\] host 'a+\.\.\.' is not the name"),
        ('"192.168.1.20"', '"machine"\nport = 70000', r"\[ultrasound\] port must be 1 to 65535"),
        ('"192.168.1.10"', '"a..b"', r"\[robot\] host 'a\.\.b' is not the name or address"),
        ("[search]", "[serach]", "is not known"),
        ("[search]", "[search]\nreach_mm = 30", r"\[search\] reach_mm is 30, but .* only 25"),
        ("search_mm = 25", "search_mm = 25\nhull_mm = []", r"\[limits\] hull_mm must have corners"),
        ("search_mm = 25", "", r"\[limits\] search_mm of 0 leaves no room for the search"),
        ("fine_mm = 0.2", "fine_mm = -0.2", r"\[search\] fine_mm must be 0.01 to 50"),
        ("fine_mm = 0.2", "coarse_mm = 1e-12", r"\[search\] coarse_mm must be 0.01 to 50"),
        ("fine_mm = 0.2", "top_fraction = 0", r"\[search\] top_fraction must be above 0 and"),
        (
            "frames = 5",
            f"frames = 1{'0' * 90}",
            r"\[search\] frames must be above 0 and at most 256",
        ),
        ("frames = 5", "low_threshold = 5000", r"\[search\] low_threshold must be 0 to 4095"),
        ("frames = 5", "backlash_mm = 30", r"from \[search\] backlash_mm = 30 below"),
        ('USB0"', 'USB0"\nframes = 257', r"\[active_echo\] frames must be 1 to 256"),
        ("elements = 64", "elements = 1025", r"\[probe\] elements must be at most 1024"),
        ("pitch_mm = 0.4", "pitch_mm = 0", r"\[probe\] pitch_mm must be in mm"),
        ("[limits]", "[limits]\narm_model = 5", r"\[limits\] arm_model must be text"),
        ("[limits]", "[limits]\narm_model = 0", r"\[limits\] arm_model must be text"),
        ("cone_deg = 20", "cone_deg = 200", r"\[plan\] cone_deg must be 0 to 85 degrees"),
        ("[robot]", "[robot", "is not TOML"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, old, new, what):
    assert old in GOOD
    path = tmp_path / "bench.toml"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(jaxcal.InputError, match=what) as caught:
        load_setup(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_the_example_is_a_setup(tmp_path, capsys):
    path = tmp_path / "bench.toml"
    assert main(["setup", str(path)]) == 0
    setup = load_setup(path)
    assert setup.ultrasound is None
    setup.motion_limits()
    # The optional lines as well: with all of them switched on it is a setup that has every key.
    text = re.sub(r"(?m)^# (?=\[|\w+ = )", "", path.read_text())
    (tmp_path / "full.toml").write_text(text)
    full = load_setup(tmp_path / "full.toml")
    assert full.ultrasound == ("192.168.1.20", 18944)
    full.motion_limits()
    written = tomllib.loads(text)
    for table in ("robot", "active_echo", "ultrasound", "probe", "scene"):
        assert set(written[table]) == set(_TABLES[table]), table
    capsys.readouterr()
    assert main(["setup", str(path)]) == 2
    assert "exists; name another file" in capsys.readouterr().err
    assert main(["setup"]) == 0
    assert capsys.readouterr().out == path.read_text()


def test_a_server_that_hangs_up_is_not_taken_for_a_frozen_machine(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(GOOD)
    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as pool:
        pool.submit(lambda: server.accept()[0].close())
        setup = replace(load_setup(path), ultrasound=server.getsockname())
        with pytest.raises(LostError, match="has closed the connection"):
            look_at_ultrasound(setup, 0.5)
