"""``jaxcal-hw``: usage that is wrong, help without JAX, a look at an emulated bench."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from test_setup import GOOD

from hw.cli import main
from hw.recording_file import RecordingWriter
from hw.recording_layout import Header


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["acquire"], "either --bench or --setup"),
        (["acquire", "--bench", "--setup", "x.toml"], "either --bench or --setup"),
        (["acquire", "--bench", "--resume"], "needs the RECORDING"),
        (["acquire", "a.h5", "--bench", "--resume", "--images", "5"], "--images does not go"),
        (["acquire", "a.h5", "--bench", "--resume"], "no such file"),
        (["acquire", "--bench", "--images", "3"], "'--images'"),
        (["acquire", "--bench", "--placement", "guess"], "'--placement'"),
        (["acquire", "--setup", "x.toml", "--speed", "2"], "need --bench"),
        (["acquire", "--setup", "missing.toml"], "no such file"),
        (["acquire", "--bench", "--confirm", "12345678"], "--confirm needs --move"),
        (["check"], "either --bench or --setup"),
        (["bench", "--speed", "0"], "'--speed'"),
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
    limits = """
box_min_mm = [230, -370, 60]
box_max_mm = [470, -130, 220]
cone_axis = [0, 0, -1]
cone_deg = 60
max_step_mm = 250
max_turn_deg = 120
max_speed_mm_s = 50
search_mm = 25
search_deg = 0.5
"""
    good = GOOD.replace("cone_deg = 30", limits).replace(
        "box_mm = [[0, 0, 0], [100, 100, 100]]", ""
    )
    path.write_text(good)
    arguments = ["acquire", "out.h5", "--setup", str(path), "--images", "6"]
    assert main([*arguments, "--preview", "plan.png"]) == 0
    assert "dry run: 6 poses" in capsys.readouterr().out
    assert (tmp_path / "plan.png").stat().st_size > 1000
    assert not (tmp_path / "out.h5").exists()
    path.write_text(good.replace("max_step_mm = 250", "max_step_mm = 5"))
    assert main(arguments) == 4
    assert "over the cap" in capsys.readouterr().err


def test_a_recording_of_the_bench_is_resumed_on_the_bench(tmp_path, capsys):
    path = tmp_path / "rec.h5"
    probe = {"kind": "linear", "elements": 8, "pitch_mm": 1.0, "sound_speed_m_s": 1490.0}
    settings = json.dumps({"request": {"images": 5, "bench": 0}})
    RecordingWriter.create(path, Header("time_of_flight", probe, 8, None, settings)).close()
    assert main(["acquire", str(path), "--setup", "x.toml", "--resume", "--move"]) == 2
    assert "begun on the emulated bench" in capsys.readouterr().err
    RecordingWriter.resume(path).finish()
    assert main(["acquire", str(path), "--bench", "--resume"]) == 2
    assert "is complete" in capsys.readouterr().err


def test_help_needs_no_jax_and_no_drivers():
    code = (
        "import sys; from hw.cli import main; codes = [main(args) for args in "
        "(['--help'], ['--version'], ['acquire', '--help'], ['acquire', '--placement', 'x'])]; "
        "loaded = {'jax', 'serial', 'rtde_receive', 'h5py'} & set(sys.modules); "
        "sys.exit(f'{codes} {loaded}' if loaded or codes != [0, 0, 0, 2] else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_check_says_what_is_wrong_with_each_device(capsys):
    pytest.importorskip("serial", reason="needs jaxcal[serial]")
    assert main(["check", "--bench", "--speed", "4"]) == 0
    out = capsys.readouterr().out
    for device in ("robot: good", "active echo: good", "ultrasound: good"):
        assert device in out
