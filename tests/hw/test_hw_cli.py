"""``jaxcal-hw``: usage that is wrong, help without JAX, a look at an emulated bench."""

from __future__ import annotations

import importlib.util
import io
import json
import re
import signal
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from test_setup import GOOD

import jaxcal
from hw.cli.confirming import confirming_by, plan_page
from hw.cli.main import main
from hw.recording.check import read_progress
from hw.recording.file import RecordingWriter
from hw.recording.layout import RecordingHeader
from hw.robot.limits import Limits
from hw.robot.motion_plan import MotionPlan
from hw.runtime.clock import REAL
from hw.runtime.errors import RefusedError


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["acquire"], "either --bench or --setup"),
        (["acquire", "--bench", "--setup", "x.toml"], "either --bench or --setup"),
        (["acquire", "--bench", "--resume"], "needs the RECORDING"),
        (["acquire", "points.csv", "--bench"], "points.csv: a recording is named .h5 or .hdf5"),
        (["free-hand", "localhost", "sweep"], "sweep: a recording is named .h5 or .hdf5"),
        (
            ["acquire", "a.h5", "--bench", "--resume", "--images", "5"],
            "--images cannot be used with --resume",
        ),
        (["acquire", "a.h5", "--bench", "--resume"], "no such file"),
        (["acquire", "--bench", "--images", "3"], "'--images'"),
        (["acquire", "--bench", "--placement", "guess"], "'--placement'"),
        (["acquire", "--setup", "x.toml", "--speed", "2"], "need --bench"),
        (["acquire", "--setup", "missing.toml"], "no such file"),
        (["acquire", "--bench", "--operator", "person"], "--operator needs --placement"),
        (["acquire", "--bench", "--operator", "nobody"], "'--operator'"),
        (["acquire", "--bench", "--unattended", "0" * 16], "--unattended needs --move"),
        (["acquire", "--bench", "--move", "--confirm", "12345678"], "No such option"),
        (["acquire", "--setup", "x.toml", "--controller", "cb"], "need --bench"),
        (["bench", "--controller", "ur5"], "'--controller'"),
        (["check"], "either --bench or --setup"),
        (["bench", "--speed", "0"], "'--speed'"),
        (["acquire", "r.h5", "--bench", "--resume", "--preview", "p.png"], "draws a new plan"),
        (["fly"], "No such command"),
    ],
)
def test_wrong_usage_is_one_line(tmp_path, monkeypatch, capsys, arguments, what):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxcal-hw: error: ")
    assert error.count("\n") == 1
    assert what in error
    assert not list(tmp_path.iterdir())


def test_a_dry_run_shows_the_plan_and_makes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "bench.toml"
    good = GOOD.replace("box_mm = [[0, 0, 0], [100, 100, 100]]", "")
    path.write_text(good)
    arguments = ["acquire", "out.h5", "--setup", str(path), "--images", "6"]
    assert main([*arguments, "--preview", "plan.png"]) == 0
    out = capsys.readouterr().out
    assert "dry run: 6 poses" in out
    assert "kinematics NOT checked here" in out
    assert "TCP offset: not known before the controller is asked" in out
    assert (tmp_path / "plan.png").stat().st_size > 1000
    assert not (tmp_path / "out.h5").exists()
    assert main([*arguments, "--preview", str(path)]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "no figure can be written as .toml; these endings work: " in told.err
    assert path.read_text() == good
    # What --move would refuse.
    path.write_text(re.sub(r"\[ultrasound\][^\[]*", "", good))
    assert main([*arguments, "--phantom", "cross-wire"]) == 2
    assert "needs the images: add [ultrasound]" in capsys.readouterr().err
    path.write_text(good)
    (tmp_path / "old.h5").touch()
    for name, said in (("old.h5", "exists already"), ("no/out.h5", "there is no folder")):
        for command in (arguments, ["acquire", "out.h5", "--bench"], ["free-hand", "a", "out.h5"]):
            assert main([name if given == "out.h5" else given for given in command]) == 2
            # Before a bench is started, anything is connected or compiled.
            assert capsys.readouterr().err.startswith(f"jaxcal-hw: error: {name}: {said}")
    armed = good.replace("settle_s = 1", 'model = "ur5"\ntcp_offset = [0, 0, 0.12, 0, 0, 0]')
    path.write_text(armed)
    assert main(arguments) == 0
    out = capsys.readouterr().out
    for line in (
        "probe's tip at 0, 0, 60 mm of the TCP; probe with housing 25.6 x 25 x 60 mm",
        "box for the probe: 200, -400, 40 to 500, -100, 260 mm",
        "box for the arm: -2000, -2000, 40 to 2000, 2000, 2000 mm",
        "TCP offset: 0, 0, 120 mm, turned by 0, 0, 0 deg",
        "arm: UR5",
        "caps: step 250 mm, turn 120 deg, tilt 60 deg, speed 50 mm/s (10 mm/s within 25 mm and 0.5 "
        "deg of a pose), force 20 N",
        "a UR5 can reach every pose along every path: branch ",
    ):
        assert line in out
    path.write_text(armed.replace("search_deg = 0.5", "min_singular_value_mm = 95"))
    assert main(arguments) == 4
    assert "comes too near a singularity of the arm" in capsys.readouterr().err
    path.write_text(good.replace("max_step_mm = 250", "max_step_mm = 5"))
    assert main(arguments) == 4
    assert "over the cap" in capsys.readouterr().err


def begun(path: Path, settings: dict[str, object], lacking: int | None = None) -> RecordingWriter:
    """A recording of eight elements, or one of a plan of five poses of which some lack images."""
    probe = {"kind": "linear", "elements": 8, "pitch_mm": 1.0, "sound_speed_m_s": 1490.0}
    header = RecordingHeader("time_of_flight", probe, 8, settings=json.dumps(settings))
    writer = RecordingWriter.create(path, header)
    if lacking is not None:
        writer.put("plan", "targets", np.tile(np.eye(4), (5, 1, 1)), "mm")
        writer.attributes("plan", {"without_image": lacking})
    return writer


def test_a_recording_of_the_bench_is_resumed_on_the_bench(tmp_path, capsys):
    path = tmp_path / "rec.h5"
    begun(path, {"request": {"images": 5, "bench": 0}}).close()
    assert main(["acquire", str(path), "--setup", "x.toml", "--resume", "--move"]) == 2
    assert "begun on the emulated bench" in capsys.readouterr().err
    RecordingWriter.resume(path).finish()
    assert main(["acquire", str(path), "--bench", "--resume"]) == 2
    assert "is complete" in capsys.readouterr().err


def test_a_recording_that_lacks_images_can_be_resumed_after_its_end(tmp_path):
    path, digest = tmp_path / "rec.h5", tmp_path / "rec.h5.sha256"
    begun(path, {}, lacking=2).finish()
    assert digest.exists()
    assert read_progress(path).ended
    again = RecordingWriter.resume(path)
    assert not digest.exists()
    again.attributes("plan", {"without_image": 0})
    again.finish()
    assert digest.exists()
    with pytest.raises(jaxcal.FormatError, match="nothing to resume"):
        RecordingWriter.resume(path)


def test_a_refused_resume_leaves_a_complete_recording_as_it_is(tmp_path, capsys):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (jaxcal[robot])")
    path = tmp_path / "rec.h5"
    begun(path, {"request": {"bench": 0, "of another version": 1}}, lacking=2).finish()
    before = path.read_bytes()
    assert main(["acquire", str(path), "--bench", "--resume"]) == 2
    assert "has no settings of an acquisition" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert (tmp_path / "rec.h5.sha256").exists()


@pytest.mark.parametrize("given", [subprocess.PIPE, subprocess.DEVNULL])
def test_a_bench_serves_until_ctrl_c_whatever_its_standard_input_is(given):
    process = subprocess.Popen(
        [sys.executable, "-m", "hw", "bench"],
        stdin=given, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert "robot_host" in process.stdout.readline()
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.3)
    process.send_signal(signal.SIGINT)
    _, complaints = process.communicate(timeout=300)
    assert (process.returncode, complaints) == (0, "")


@pytest.mark.parametrize("driver", ["rtde_control", "serial"])
@pytest.mark.parametrize("where", ["--bench --phantom cross-wire", "--setup x.toml --move"])
def test_without_a_driver_no_file_is_made_and_nobody_is_asked(
    tmp_path, monkeypatch, capsys, driver, where
):
    monkeypatch.chdir(tmp_path)
    for module in ("rtde_control", "cobs", "serial"):
        there = None if module == driver else ModuleType(module)
        if there is not None:
            there.__spec__ = ModuleSpec(module, None)
        monkeypatch.setitem(sys.modules, module, there)
    assert main(["acquire", "rec.h5", *where.split()]) == 2
    assert capsys.readouterr().err.startswith(f"jaxcal-hw: error: {driver} is not installed: ")
    assert list(tmp_path.iterdir()) == []


def test_help_needs_no_jax_and_no_drivers():
    code = (
        "import sys; from hw.cli.main import main; codes = [main(args) for args in "
        "(['--help'], ['--version'], ['acquire', '--help'], ['acquire', '--placement', 'x'])]; "
        "loaded = {'jax', 'serial', 'rtde_receive', 'h5py'} & set(sys.modules); "
        "sys.exit(f'{codes} {loaded}' if loaded or codes != [0, 0, 0, 2] else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.real_time
def test_check_says_what_is_wrong_with_each_device(capsys):
    pytest.importorskip("serial", reason="needs jaxcal[serial]")
    status = main(["check", "--bench", "--speed", "4"])
    out = capsys.readouterr().out
    for device in ("active echo: good", "ultrasound: good"):
        assert device in out
    if importlib.util.find_spec("rtde_control") is not None:
        assert (status, "robot: good" in out) == (0, True)
    else:
        assert (status, "robot: wrong" in out) == (4, True)
        assert "nothing can be moved: rtde_control is not installed: " in out
    assert "20195500042, calibration " in out
    assert "payload 0 kg at [0, 0, 0] m, speed slider at 100 %" in out


LIMITS = Limits.from_mapping({
    "box_min_mm": [0, 0, 0], "box_max_mm": [99, 99, 99], "tip_mm": [0, 0, 50],
    "cone_axis": [0, 0, 1], "cone_deg": 30, "max_step_mm": 10, "max_turn_deg": 10,
    "max_speed_mm_s": 10,
})  # fmt: skip


@pytest.mark.parametrize("given", [None, "", "\n\n", "yes\n"])
def test_nothing_is_confirmed_where_nobody_types_the_code(monkeypatch, given):
    """Standard input closed, at its end, empty lines, or another answer."""
    monkeypatch.setattr(sys, "stdin", None if given is None else io.StringIO(given))
    plan = MotionPlan(np.eye(4)[None], LIMITS, (0.0,) * 6, "20195500042")
    said = "the code typed is not" if given == "yes\n" else "run it at a terminal, or name the plan"
    with pytest.raises(RefusedError, match=f"not confirmed: .*{said}"):
        confirming_by(REAL, False, None)(plan)


def test_who_confirms_is_told_of_an_arm_that_nothing_identifies():
    poses = np.eye(4)[None]
    known = MotionPlan(poses, LIMITS, (0.0,) * 6, "20195500042, calibration 0123456789ab")
    page = "\n".join(plan_page(known))
    assert known.serial in page
    assert known.digest[:16] in page
    assert "speed slider at 100 %" in page
    assert "NOTHING IDENTIFIES" not in page
    unknown = MotionPlan(poses, LIMITS, (0.0,) * 6, "UR5@192.168.1.10")
    assert "NOTHING IDENTIFIES THIS ARM" in "\n".join(plan_page(unknown))


def test_a_closed_standard_error_is_no_failure(tmp_path):
    """As in some jobs without a terminal; what runs then has no other complaint either."""
    for arguments, status in ((["free-hand", "127.0.0.1:1"], 4), (["setup", "b.toml"], 0)):
        done = subprocess.run(
            ["sh", "-c", 'exec "$@" 2>&-', "sh", sys.executable, "-m", "hw", *arguments],
            cwd=tmp_path, capture_output=True, timeout=120, check=False,
        )  # fmt: skip
        assert done.returncode == status
