"""The command line: exit codes, one line of error, pure JSON, whole files or none.

One calibration runs in a process of its own, as a user's; the others share its kept programs in
this one.
"""

import gc
import io
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace

import click
import h5py
import jax
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxcal
from hw.cli.main import commands as bench_commands
from hw.cli.main import main as bench_main
from hw.runtime.errors import DeviceError
from jaxcal import design
from jaxcal.cli import common, demo, plan
from jaxcal.cli.main import commands, main
from jaxcal.cli.run import run
from jaxcal.data.probe import PRESETS
from jaxcal.data.recording import Recording, make_images
from jaxcal.design.constraints import Region
from jaxcal.io.atomic import save_figure
from jaxcal.io.outputs import begins_with, check_output
from jaxcal.report.paragraphs import Verbatim
from jaxcal.result.transform import ImageTransform
from jaxcal.runtime import jax_cache, program_cache
from jaxcal.runtime.messages import command_line
from jaxcal.study.simulation import Protocol

FIGURES = ("residuals", "offsets", "accuracy", "influence", "limits")
REPORT = {
    "calibration.json", "verdict.txt", "residuals.csv", "test_residuals.csv",
    *(f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")),
}  # fmt: skip
DETERMINED = {name for name in REPORT if name.split(".")[0] in ("accuracy", "influence", "limits")}
"""Not of an answer that the images do not determine."""
CONVERGENCE = {"convergence.png", "convergence.svg"}
SCHEMA = {
    "format": str,
    "version": int,
    "face_offset_mm": float,
    "method": str,
    "prior": str,
    "converged": bool,
    "status": str,
    "iterations": int,
    "variance_rounds": int,
    "images": int,
    "images_used": int,
    "image_plane_to_probe": list,
    "point_mm": list,
    "elevation_mm": list,
    "elevation_sd_mm": list,
    "sigma_lateral_mm": float,
    "sigma_range_mm": float,
    "sigma_elevation_mm": float,
    "observability": dict,
    "rms_mm": float,
    "certified": bool,
    "gap_mm2": float,
    "reconstruction_precision_mm": float,
    "reconstruction_precision_set": str,
    "objective": float,
    "scaled_kkt_residual": float,
    "outliers": list,
    "warnings": list,
    "source": str,
    "convention": dict,
    "test_residual_mm": list,
    "date": str,
    "jaxcal_version": str,
}


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    return tmp_path_factory.mktemp("cli")


@pytest.fixture(scope="module")
def jaxcal_process():
    """Run the command line in its own process: ``jaxcal_process("demo", "--json")``."""
    environment = {
        **os.environ,
        "COLUMNS": "100",
        "PYTHONWARNINGS": "error::DeprecationWarning",  # they are not shown otherwise
    }
    environment.pop("JAX_COMPILATION_CACHE_DIR")

    def run(*arguments, **others):
        options = {"capture_output": True, "text": True, "check": False, "timeout": 300, **others}
        command = [sys.executable, "-m", "jaxcal", *map(str, arguments)]
        return subprocess.run(command, env=environment, **options)

    return run


@pytest.fixture(scope="module")
def simulated(shared):
    path = shared / "simulated.h5"
    assert main(["simulate", str(path), "--elevation", "2", "--seed", "1"]) == 0
    return path


@pytest.fixture(scope="module")
def calibrated(shared, simulated, jaxcal_process):
    done = jaxcal_process("calibrate", simulated, "--json", "--out", shared / "deep" / "report")
    assert done.stderr == ""
    return done, shared / "deep" / "report"


@pytest.fixture
def recording(tmp_path):
    """A recording that is well-formed; nothing here solves it."""
    generator = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = generator.uniform(-50, 50, (6, 3))
    path = tmp_path / "rec.h5"
    jaxcal.save(Recording(make_images(poses, generator.uniform(10, 50, (6, 2)))), path)
    return path


def told(capfd, *arguments, code=0):
    """Run what prints an answer and no word besides; the answer."""
    capfd.readouterr()
    assert main([str(argument) for argument in arguments]) == code
    out, err = capfd.readouterr()
    assert err == ""
    return out


def refused(capfd, *arguments):
    """Run what must be refused; the one line that says why."""
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("jaxcal: error: ")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    return err


def numbers_in(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for item in value for number in numbers_in(item)]
    return [value] if isinstance(value, float) else []


def test_help_and_version_import_nothing_heavy():
    code = (
        "import sys; from jaxcal.cli.main import main; codes = [main(args) for args in "
        "(['--help'], ['-h'], ['--version'], ['calibrate', '--help'], ['demo', '--help'])]; "
        "heavy = {'jax', 'numpy', 'matplotlib', 'rich', 'h5py'} & set(sys.modules); "
        "sys.exit(f'{codes} {heavy}' if any(codes) or heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"jaxcal, version {jaxcal.__version__}" in done.stdout
    assert all(name in done.stdout for name in commands.commands)


@pytest.mark.parametrize(
    ("group", "run", "arguments"),
    [
        (commands, main, []),
        (commands.commands["study"], main, ["study"]),
        (bench_commands, bench_main, []),
    ],
)
def test_every_command_is_listed_in_a_whole_line_in_the_order_of_the_work(
    group, run, arguments, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "80")
    assert run([*arguments, "--help"]) == 0
    text = capsys.readouterr().out
    lines = [line.split(maxsplit=1) for line in text.partition("Commands:\n")[2].splitlines()]
    listed = [line for line in lines if line and line[0] in group.commands]
    assert [name for name, _ in listed] == list(group.commands)
    assert all(words.endswith(".") and "..." not in words for _, words in listed)


@pytest.mark.parametrize("group", [commands, bench_commands])
def test_every_option_says_what_it_is(group):
    """A default alone says nothing."""
    silent, pending = [], [group]
    for command in pending:
        pending += getattr(command, "commands", {}).values()
        options = [each for each in command.params if isinstance(each, click.Option)]
        said = {option: (option.help or "").partition("[default")[0] for option in options}
        silent += [(command.name, option.opts) for option in options if not said[option]]
    assert not silent


@pytest.mark.parametrize(("module", "name"), [("jaxcal", "jaxcal"), ("hw", "jaxcal-hw")])
def test_runs_as_a_module_and_completes_in_a_shell(module, name):
    def run(*arguments, **variables):
        return subprocess.run(
            [sys.executable, "-m", module, *arguments], env=os.environ | variables,
            capture_output=True, text=True, check=False,
        )  # fmt: skip

    wrong = run("no-such-command")
    assert (wrong.returncode, wrong.stdout, wrong.stderr.count("\n")) == (2, "", 1)
    assert wrong.stderr.startswith(f"{name}: error: ")
    variable = f"_{name}_COMPLETE".replace("-", "_").upper()
    for shell in ("bash", "zsh", "fish"):
        script = run(**{variable: f"{shell}_source"})
        assert (script.returncode, script.stderr) == (0, "")
        assert f"{variable}={shell}_complete" in script.stdout
    asked = {"COMP_WORDS": f"{name} calibrate --bootst" if module == "jaxcal" else f"{name} ch"}
    word = {"COMP_CWORD": "2" if module == "jaxcal" else "1"}
    done = run(**{variable: "bash_complete"}, **asked, **word)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == (["plain,--bootstrap"] if module == "jaxcal" else ["plain,check"])


def test_simulate_writes_what_load_reads(simulated):
    recording = jaxcal.load(simulated)
    assert len(recording) == 50
    assert recording.truth is not None
    assert recording.test is not None
    assert 1 < np.abs(recording.truth.elevation).max() <= 2


def test_curvilinear_times_of_flight_become_points(capfd, tmp_path):
    raw, points = tmp_path / "raw.h5", tmp_path / "points.h5"
    options = ["--probe", "curvilinear", "--clock-mhz", "20", "--noise", "0.2"]
    assert "50 images of times of flight" in told(capfd, "simulate", raw, *options)
    ticks = jaxcal.load(raw).calibration.measurements * 20e6
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-6)
    found = json.loads(told(capfd, "segment", raw, "--out", points, "--json"))
    assert found["images_used"] == 50
    with h5py.File(points) as file:
        assert file["segmentation/out_of_plane"].shape == (50, 3)
    assert jaxcal.load(points).probe.kind == "curvilinear"


def test_simulate_defaults_are_the_protocols():
    defaults = {option.name: option.default for option in commands.commands["simulate"].params}
    protocol = Protocol()
    assert defaults["images"] == protocol.images
    assert defaults["elevation"] == protocol.elevation_mm
    assert defaults["elevation_distribution"] == protocol.elevation_distribution
    assert defaults["noise"] == protocol.noise_mm


def test_calibrate_json_keeps_the_contract(calibrated, simulated):
    done, _ = calibrated
    assert done.returncode == 0
    assert done.stdout.count("\n") == 1
    record = json.loads(done.stdout, parse_constant=lambda name: pytest.fail(f"holds {name}"))
    for name, kind in SCHEMA.items():
        assert isinstance(record[name], kind), name
    assert np.isfinite(numbers_in(record)).all()
    assert (record["status"], record["converged"]) == ("converged", True)
    assert record["certified"] is True
    assert 0 <= record["gap_mm2"] < 1e-9 * 50 * record["rms_mm"] ** 2
    assert np.shape(record["image_plane_to_probe"]) == (4, 4)
    assert np.shape(record["covariance"]) == (6, 6)
    assert len(record["elevation_mm"]) == len(record["elevation_sd_mm"]) == record["images"] == 50
    assert record["scale_mm_per_px"] is None
    assert record["reconstruction_precision_set"] == "test"
    truth = jaxcal.load(simulated).truth
    assert record["truth_error"]["translation_mm"] < 1
    assert np.linalg.norm(np.array(record["point_mm"]) - truth.point) < 1
    assert np.std(np.array(record["elevation_mm"]) - truth.elevation) < 0.5


def test_images_are_left_out_by_their_numbers(simulated, capfd):
    recording = jaxcal.load(simulated)
    asked = ("--method", "conventional", "--leave-out", "7-9, 3,8")
    record = json.loads(told(capfd, "calibrate", simulated, "--json", *asked))
    assert record["warnings"][-1] == "left out as requested: images 3, 7 to 9"
    assert (record["images"], record["images_used"]) == (50, 46)
    mask = np.ones(50, bool)
    mask[[3, 7, 8, 9]] = False
    images = replace(recording.calibration, mask=mask)
    expected = jaxcal.calibrate(replace(recording, calibration=images), "conventional")
    np.testing.assert_array_equal(record["image_plane_to_probe"], expected.image_to_probe)


def test_calibrate_writes_the_whole_report(calibrated):
    done, folder = calibrated
    assert {path.name for path in folder.iterdir()} == REPORT
    assert json.loads((folder / "calibration.json").read_text()) == json.loads(done.stdout)
    assert len((folder / "residuals.csv").read_text().splitlines()) == 51
    for path in folder.glob("*.png"):
        assert path.read_bytes().endswith(b"IEND\xaeB`\x82")


@pytest.mark.usefixtures("calibrated")
def test_calibrate_speaks_to_a_person(simulated, capfd, monkeypatch, tmp_path):
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)
    out = told(capfd, "calibrate", simulated, "--report", "cal.html")
    assert out.endswith("\n\nreport: cal.html\n")
    assert (tmp_path / "cal.html").read_text().startswith("<!DOCTYPE html>")
    assert "image_plane_to_probe (mm)" in out
    assert "the images put the target" in out
    assert max(map(len, out.splitlines())) <= 100


@pytest.mark.slow
def test_demo_compares_and_reports(simulated, jaxcal_process, tmp_path):
    done = jaxcal_process("demo", "--json", "--seed", 1, "--out", tmp_path / "new")
    assert (done.returncode, done.stderr) == (0, "")
    answer = json.loads(done.stdout)
    records = answer["calibrations"]
    precision = {name: record["reconstruction_precision_mm"] for name, record in records.items()}
    assert precision["joint"] < min(precision["alternating"], precision["conventional"])
    assert set(answer["solve_ms"]) == set(precision)
    # The same experiment as that of the simulate command, so the same calibration.
    known = json.loads(jaxcal_process("calibrate", simulated, "--json").stdout)
    for name in ("image_plane_to_probe", "point_mm", "covariance"):
        np.testing.assert_allclose(records["joint"][name], known[name], rtol=0, atol=1e-9)

    names = {path.name for path in (tmp_path / "new").iterdir()}
    assert names == REPORT | CONVERGENCE | {"comparison.json", "recording.h5"}
    assert json.loads((tmp_path / "new" / "comparison.json").read_text()) == records
    assert json.loads((tmp_path / "new" / "calibration.json").read_text()) == records["joint"]


def test_demo_prints_a_row_for_each_method(calibrated, capfd):
    record = json.loads(calibrated[0].stdout)
    methods = ("conventional", "alternating", "joint")
    demo._print(dict.fromkeys(methods, record), dict.fromkeys(methods, 1.5), 0, "folder")
    lines = capfd.readouterr().out.splitlines()
    for method in methods:
        (row,) = (line for line in lines if line.startswith(f"  {method} "))
        assert f" {record['reconstruction_precision_mm']:.3f} " in row
    assert lines[-1] == "report: folder"
    assert max(map(len, lines)) <= 100


@pytest.fixture(scope="module")
def degenerate(shared, simulated):
    """Poses without any rotation, and one image fifty times."""
    recording = jaxcal.load(simulated)
    images = recording.calibration
    parallel = images.poses.copy()
    parallel[:, :3, :3] = np.eye(3)
    first = [0] * len(images)
    sets = {
        "parallel": (parallel, images.measurements),
        "duplicates": (images.poses[first], images.measurements[first]),
    }
    for name, (poses, points) in sets.items():
        made = replace(images, poses=poses, measurements=points)
        # All but the numbers is as it was, so that the program is that of the other tests.
        jaxcal.save(replace(recording, calibration=made, truth=None), shared / f"{name}.h5")
    return shared


def test_equal_poses_are_counted_and_refused(degenerate, capfd, tmp_path):
    line = refused(capfd, "calibrate", degenerate / "duplicates.h5", "--out", tmp_path)
    assert "count once" in line
    assert not [*tmp_path.iterdir()]


@pytest.mark.usefixtures("calibrated")
def test_a_degenerate_set_is_solved_but_not_observable(degenerate, capfd, tmp_path):
    files = REPORT - DETERMINED
    parallel = degenerate / "parallel.h5"
    record = json.loads(told(capfd, "calibrate", parallel, "--json", "--out", tmp_path, code=3))
    assert (record["status"], record["converged"]) == ("unobservable", False)
    assert record["covariance"] is None
    assert record["warnings"]
    assert np.isfinite(numbers_in(record)).all()
    assert {path.name for path in tmp_path.iterdir()} == files


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "Missing command"),
        (["study"], "Missing command. (see 'jaxcal study --help')"),
        (["cache"], "Missing command. (see 'jaxcal cache --help')"),
        (["nonsense"], "No such command 'nonsense'"),
        (["--nonsense"], "--nonsense"),
        (["calibrate"], "Missing argument 'REC'"),
        (["demo", "--seed", "-1"], "--seed"),
        (["demo", "--seed", "x"], "'x' is not a valid integer"),
        (["demo", "too", "many"], "unexpected extra argument"),
        (["demo", "--out", "/proc/nope"], "/proc/nope: cannot be made or written to"),
        (["simulate"], "Missing argument 'OUT.h5'"),
        (["simulate", "x.h5", "--clock-mhz", "20"], "it needs --raw"),
        (["simulate", "x.h5", "--raw", "--clock-mhz", "0"], "'0' is not a positive number"),
        (["simulate", "x.h5", "--raw", "--clock-mhz", "0.001"], "1000 Hz is too slow"),
        (["simulate", "x.h5", "--probe", "square"], "'square' is not one of"),
        (["simulate", "x.h5", "--images", "3"], "between 4 and"),
        (["simulate", "x.h5", "--images", "10000000000000000000000"], "between 4 and"),
        (["simulate", "x.h5", "--noise", "-1"], "'-1' is not zero or a positive number"),
        (["simulate", "x.h5", "--noise", "inf"], "'inf' is not zero or a positive number"),
        (["simulate", "x.h5", "--elevation", "nan"], "'nan' is not zero or a positive number"),
        (["simulate", "x.h5", "--elevation", "1e9"], "between 0 and 1000 mm"),
        (["import", "x.h5"], "x.h5: name what to import, and then the recording"),
        (["import", "a", "b", "c", "x.h5"], "3 sources"),
        (["import", "a.igs.mha", "x.h5"], "a.igs.mha: no such file"),
        (["import", "a.csv", "x.h5"], "a.csv: no such file"),
        (["import", "a.txt", "b.txt", "x.h5", "--units", "mm"], "a.txt: no such file"),
        (["import", "a.csv", "x.h5", "--units", "mm", "--spacing", "1", "1"], "no pixel size"),
        (["import", "a.csv", "x.h5", "--spacing", "1", "0"], "'0' is not a positive number"),
        (["calibrate", "nope.h5"], "nope.h5: no such file"),
        (["calibrate", "/proc"], "/proc: is a directory"),
        (["calibrate", "poses.txt", "points.txt"], "jaxcal import makes one, also from a file of"),
    ],
)
def test_refused_without_a_recording(arguments, said, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said in refused(capfd, *arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--method", "magic"], "'magic' is not one of"),
        (["--prior", "uniform", "--sigma", "1", "1", "1"], "tunes its SDs"),
        (["--prior", "gaussian", "--max-elevation", "1"], "max_elevation belongs"),
        (["--prior", "gaussian", "--method", "alternating"], "does not go with"),
        (["--prior", "bounded", "--method", "conventional"], "does not go with"),
        (["--max-elevation", "1", "--method", "conventional"], "max_elevation belongs"),
        (["--max-elevation", "0", "--prior", "bounded"], "'0' is not a positive number"),
        (["--max-elevation", "-1", "--prior", "bounded"], "'-1' is not a positive number"),
        (["--max-elevation", "nan", "--prior", "bounded"], "'nan' is not a positive number"),
        (["--max-elevation", "1mm", "--prior", "bounded"], "'1mm' is not a positive number"),
        (["--cone", "nan"], "'nan' is not zero or a positive number up to 85"),
        (["--sigma", "1", "1"], "--sigma"),
        (["--sigma", "1", "1", "inf"], "'inf' is not a positive number"),
        (["--sigma", "1", "1", "1", "--prior", "bounded"], "sigma and tracker_sd belong"),
        (["--solver", "gauss-newton"], "belongs to the conventional method"),
        (["--solver", "magic", "--method", "conventional"], "'magic' is not one of"),
        (["--tolerance-mm", "1"], "only the alternating method has --tolerance-mm"),
        (
            ["--max-rounds", "9", "--method", "joint"],
            "only the alternating method has --max-rounds",
        ),
        (["--max-rounds", "0", "--method", "alternating"], "0 is not in the range"),
        (["--tolerance-rad", "0", "--method", "alternating"], "'0' is not a positive number"),
        (["--estimate", "latency"], "cannot estimate 'latency'"),
        (["--estimate", "scale,sound-speed"], "no pixel scale to estimate"),
        (["--data", "channels"], "needs times of flight"),
        (["--estimate", "everything"], "cannot estimate 'everything'"),
        (["--estimate", ""], "cannot estimate ''"),
        (["--estimate", "scale"], "no pixel scale to estimate"),
        (["--estimate", "scale", "--out", "report/deep"], "no pixel scale to estimate"),
        (["--leave-out", "2,x"], "'2,x' is no list of images, such as 11,12,20-25"),
        (["--leave-out", "5-3"], "'5-3' is no list of images"),
        (["--leave-out", "1,6"], "rec.h5: the number of an image must be between 0 and 5, not 6"),
        (["--leave-out", "1-3"], "rec.h5: 3 used images are too few"),
        (["--test", "nope.h5"], "nope.h5: no such file"),
        (["--out", "/proc/nope"], "/proc/nope: cannot be made or written to"),
        (["--out", "rec.h5"], "rec.h5: is a file, not a folder"),
    ],
)
def test_refused_with_a_recording(options, said, capfd, recording, monkeypatch):
    monkeypatch.chdir(recording.parent)
    assert said in refused(capfd, "calibrate", "rec.h5", "--json", *options)
    assert [path.name for path in recording.parent.iterdir()] == ["rec.h5"]


def test_bad_recordings_are_refused(capfd, recording, tmp_path):
    with h5py.File(recording, "r+") as file:
        file["calibration/pose"][2, 0, 0] = np.nan
    assert "pose 2 holds NaN" in refused(capfd, "calibrate", recording)
    (tmp_path / "text.h5").write_text("not a recording")
    said = refused(capfd, "calibrate", tmp_path / "text.h5")
    assert "is not an HDF5 file (jaxcal import makes one" in said


def test_pixels_without_a_spacing_are_refused(capfd, recording, tmp_path):
    images = jaxcal.load(recording).calibration
    made = make_images(images.poses, images.measurements * 10, "pixel")
    jaxcal.save(Recording(made), tmp_path / "pixels.h5")
    line = refused(capfd, "calibrate", tmp_path / "pixels.h5", "--out", tmp_path / "report")
    assert "pixels.h5: the pixels have no spacing_mm" in line
    assert "--estimate scale" in line
    assert "jaxcal import --spacing" in line
    assert not (tmp_path / "report").exists()


def test_a_name_cannot_break_the_one_line(capfd):
    line = refused(capfd, "calibrate", "a\nb\x1b[31m\udc80.h5")
    assert r"a b\x1b[31m\udc80.h5: no such file" in line


def test_simulate_into_no_folder(capfd, tmp_path):
    assert "its folder does not exist" in refused(capfd, "simulate", tmp_path / "no" / "x.h5")


def table(count, columns):
    generator = np.random.default_rng(3)
    pose = np.eye(4)[:3]
    rows = []
    for image in range(count):
        pose[:, 3] = generator.uniform(-100, 100, 3)
        rows.append([image, *pose.ravel(), *generator.uniform(100, 400, 2)][:columns])
    return rows


def test_import_csv(tmp_path, capfd):
    lines = [",".join(map(str, row)) for row in table(5, 15)]
    (tmp_path / "t.csv").write_text("\n".join(lines))
    assert main(["import", str(tmp_path / "t.csv"), str(tmp_path / "t.h5")]) == 0
    assert "--estimate scale" in capfd.readouterr().out
    assert jaxcal.load(tmp_path / "t.h5").calibration.kind == "pixel"
    arguments = ["import", str(tmp_path / "t.csv"), str(tmp_path / "t.h5")]
    assert main([*arguments, "--spacing", "0.1", "0.2"]) == 0
    np.testing.assert_array_equal(jaxcal.load(tmp_path / "t.h5").calibration.spacing_mm, [0.1, 0.2])
    assert main([*arguments, "--units", "mm"]) == 0
    assert jaxcal.load(tmp_path / "t.h5").calibration.kind == "point"


def test_import_pair(tmp_path, capfd):
    rows = table(5, 15)
    poses = "\n".join(" ".join(map(str, row[1:13][i : i + 4])) for row in rows for i in (0, 4, 8))
    (tmp_path / "poses.txt").write_text(poses)
    (tmp_path / "points.txt").write_text("\n".join(f"{row[13]} {row[14]}" for row in rows))
    sources = [tmp_path / "poses.txt", tmp_path / "points.txt"]
    assert main(["import", *map(str, sources), str(tmp_path / "p.h5")]) == 0
    capfd.readouterr()
    assert len(jaxcal.load(tmp_path / "p.h5")) == 5
    # Without OUT.h5 the last source would be overwritten.
    before = sources[1].read_bytes()
    assert "name the output file last" in refused(capfd, "import", *sources)
    assert sources[1].read_bytes() == before


def ended(command):
    """The exit status of a program that has this command only."""
    return run(click.Group(commands=[click.command("do")(command)]), "jaxcal", ["do"])


def test_ctrl_c_is_one_line(capfd):
    def interrupt():
        raise KeyboardInterrupt

    assert ended(interrupt) == 130
    assert capfd.readouterr() == ("", "jaxcal: interrupted\n")


def test_a_further_ctrl_c_does_not_hide_what_was_to_be_told(capfd):
    def fail():
        try:
            raise DeviceError("interrupted; resume it", device="robot")
        finally:
            raise KeyboardInterrupt

    assert ended(fail) == 130
    assert capfd.readouterr() == ("", "jaxcal: error: robot: interrupted; resume it\n")


def test_ctrl_c_while_importing_leaves_at_once():
    code = (
        "import os, signal; from jaxcal.cli import common; "
        "common.importlib.import_module = lambda _: os.kill(os.getpid(), signal.SIGINT); "
        "common.import_engine()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "jaxcal: interrupted\n")


def test_ctrl_c_where_python_cannot_raise_it_is_not_lost(capfd):
    """In a destructor or a callback of the garbage collection, whose exceptions Python drops."""
    times = []

    def callback(phase, _):
        if len(times) < 3:
            times.append(phase)
            signal.raise_signal(signal.SIGINT)

    def command():
        gc.callbacks.append(callback)
        gc.collect()
        # Waiting is ended as well.
        time.sleep(60)

    before = sys.unraisablehook
    try:
        assert ended(command) == 130
    finally:
        gc.callbacks.remove(callback)
    assert capfd.readouterr() == ("", "jaxcal: interrupted\n")
    assert sys.unraisablehook is before


def test_a_home_that_cannot_be_written_is_not_talked_about():
    """Matplotlib would, in two lines, though the figure is made."""
    code = (
        "import click; from jaxcal.cli.run import run; "
        "draw = click.Command('draw', callback=lambda: __import__('matplotlib').get_configdir()); "
        "run(click.Group(commands=[draw]), 'jaxcal', ['draw'])"
    )
    names = ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in names}
    environment["HOME"] = "/proc/nowhere"
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_bug_is_one_line_too(capfd, monkeypatch):
    def fail():
        raise ZeroDivisionError("a\nb")

    assert ended(fail) == 1
    err = capfd.readouterr().err
    assert err.startswith("jaxcal: internal error: ZeroDivisionError: a b (please report")
    assert err.count("\n") == 1
    monkeypatch.setenv("JAXCAL_TRACEBACK", "1")
    with pytest.raises(ZeroDivisionError):
        ended(fail)


@pytest.mark.parametrize(
    ("encoding", "errors"),
    [("cp1252", "strict"), ("utf-8", "strict"), ("cp1252", "surrogateescape")],
)
def test_a_name_that_the_terminal_cannot_show_loses_no_answer(monkeypatch, encoding, errors):
    @click.group()
    def told():
        pass

    @told.command()
    @click.argument("name")
    def say(name):
        click.echo(f"{name}: 0.2 mm")

    shown = io.BytesIO()
    stdout = io.TextIOWrapper(shown, encoding=encoding, errors=errors, newline="\n")
    monkeypatch.setattr(sys, "stdout", stdout)
    monkeypatch.setattr(sys, "argv", ["told", "say", "\N{GREEK SMALL LETTER SIGMA}\udcff.h5"])
    assert run(told, "told") == 0
    expected = "\N{GREEK SMALL LETTER SIGMA}".encode() if encoding == "utf-8" else b"\\u03c3"
    assert shown.getvalue() == expected + b"\\udcff.h5: 0.2 mm\n"


@pytest.mark.parametrize(
    "name",
    ["r.h5", r"C:\data\r.h5", "my data.h5", "it's.h5", r"C:\my data" + "\\", "a&b.h5", 'a"b', ""],
)
def test_a_command_to_type_is_quoted_for_the_shell(name):
    words = ["jaxcal", name, "--json"]
    assert shlex.split(command_line(words, windows=False)) == words
    # Python's own rule for Windows adds quotes for spaces alone; cmd needs them for others, too.
    quoted = subprocess.list2cmdline([name])
    if not quoted.startswith('"') and name not in ("r.h5", r"C:\data\r.h5"):
        quoted = f'"{quoted}"'
    assert command_line(words, windows=True) == f"jaxcal {quoted} --json"


def test_a_pipe_closed_early_is_no_error(jaxcal_process):
    read, write = os.pipe()
    os.close(read)
    done = jaxcal_process("--help", capture_output=False, stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_is_one_line(jaxcal_process):
    """What was asked for may have been written by then, so it is said what is full."""
    with open("/dev/full", "w") as full:
        done = jaxcal_process("--help", capture_output=False, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert done.stderr == (
        "jaxcal: error: standard output: No space left on device (not all was printed; files that "
        "were asked for may have been written)\n"
    )


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps a folder that is in use")
@pytest.mark.parametrize("command", [["pick", "f.igs.mha"], ["segment", "."]])
def test_a_current_folder_that_was_removed_is_said(command, tmp_path, monkeypatch, capsys):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main(command) == 2
    said = "jaxcal: error: the current folder is no longer there: change to another one\n"
    assert capsys.readouterr().err == said


@pytest.mark.skipif(os.name == "nt", reason="descriptors are closed by a shell")
def test_a_closed_standard_output_is_one_line():
    """Said before any work: an answer that nobody can see is not a success."""
    command = ["/bin/sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-m", "jaxcal", "--help"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False, timeout=60)
    said = "jaxcal: error: standard output is closed; > /dev/null discards what is printed\n"
    assert (done.returncode, done.stderr) == (2, said)


def test_messages_are_not_markup(capfd):
    common.print_page("[bold]a[/bold] :smile:", "- " + "word " * 30)
    lines = capfd.readouterr().out.splitlines()
    assert lines[0] == "[bold]a[/bold] :smile:"
    assert lines[2].startswith("  word")


def test_commands_and_paths_are_not_broken(capfd):
    path = "/home/lab" + "/2026-11-24" * 12 + "/rec.h5"
    command = f"jaxcal calibrate {path} --report report.html"
    common.print_page(f"the images are in {path} as before", Verbatim(command), "end")
    lines = capfd.readouterr().out.splitlines()
    assert lines == ["the images are in", path, "as before", command, "end"]


@pytest.mark.parametrize("spoil", ["open", "open_parent", "link", "file", "unwritable", "off"])
def test_cache_that_cannot_be_trusted_is_not_used(spoil, tmp_path, monkeypatch, capfd):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = program_cache.private_folder("xla")
    if spoil == "open":
        folder.chmod(0o770)
    elif spoil == "open_parent":
        folder.parent.chmod(0o777)
    elif spoil in ("link", "file"):
        folder.rmdir()
        if spoil == "link":
            (tmp_path / "elsewhere").mkdir(mode=0o700)
            folder.symlink_to(tmp_path / "elsewhere")
        else:
            folder.write_text("")
    elif spoil == "unwritable":
        monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nope")
    else:
        monkeypatch.setenv("JAXCAL_NO_CACHE", "1")
    before = jax.config.jax_compilation_cache_dir
    jax_cache.enable_compilation_cache()
    assert jax.config.jax_compilation_cache_dir == before
    assert capfd.readouterr() == ("", "")


def test_cache_keeps_the_newest(tmp_path):
    for age, name in enumerate("abcd"):
        (tmp_path / name).write_text("")
        os.utime(tmp_path / name, (0, -age))
    (tmp_path / "e").symlink_to("nowhere")
    os.utime(tmp_path / "e", (0, -9), follow_symlinks=False)
    jax_cache.prune(tmp_path, 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


DAMAGED_ENTRIES = """
import jax, resource
from jaxcal.runtime.jax_cache import enable_compilation_cache, folder
enable_compilation_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

def compiled(*names):
    for name in names:
        def function(x):
            return x + 1
        function.__name__ = name
        jax.jit(function)(1.0)
    jax.clear_caches()
    found = {path.name.split("-")[0]: path for path in folder().iterdir()}
    return {name: found.get(f"jit_{name}") for name in names}

for path in compiled("f", "g").values():
    path.write_bytes(path.read_bytes()[:100])
for path in compiled("f", "g").values():
    assert path.stat().st_size > 100
soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
assert compiled("h") == {"h": None}
"""


@pytest.mark.skipif(os.name == "nt", reason="limits of files are POSIX's")
def test_a_damaged_entry_of_jaxs_cache_is_replaced_without_a_word(tmp_path):
    """A full disk leaves half an entry, which JAX neither uses nor replaces."""
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    del environment["JAX_COMPILATION_CACHE_DIR"]
    run = [sys.executable, "-c", DAMAGED_ENTRIES]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_cache_clear_removes_what_jax_keeps_there(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = program_cache.private_folder("xla")
    (folder / "jit_f-cache").write_text("")
    assert main(["cache", "clear"]) == 0
    assert os.listdir(folder) == []


def test_servers_have_a_host_and_a_port():
    for text, found in (
        ("localhost", ("localhost", 18944)),
        ("10.0.0.2:18945", ("10.0.0.2", 18945)),
        ("::1", ("::1", 18944)),
        ("[::1]:80", ("::1", 80)),
    ):
        assert common.Server().convert(text, None, None) == found
    for text in ("", ":80", "a:", "a:0", "a:65536", "a:b", "[::1", "[::1]x"):
        with pytest.raises(click.BadParameter, match="is not HOST or HOST:PORT"):
            common.Server().convert(text, None, None)


def test_numbers_are_positive_and_finite():
    assert common.POSITIVE.convert("1e-3", None, None) == 1e-3
    assert common.NOT_NEGATIVE.convert("0", None, None) == 0
    for text in ("0", "-1", "nan", "inf", "1_000x", ""):
        with pytest.raises(click.BadParameter):
            common.POSITIVE.convert(text, None, None)


def test_calibrate_ends_with_the_images_that_would_help_most(calibrated, simulated):
    done, _ = calibrated
    found = json.loads(done.stdout)["next_poses"]
    assert len(found["poses"]) == 3
    assert 0 < found["tre_then_mm"] < found["tre_now_mm"] < 1
    assert 10 < found["images_to_half"] < 300
    recording = jaxcal.load(simulated)
    for pose in found["poses"]:
        matrix = np.array(pose["pose"])
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
        assert "target" in pose["words"]
        # Seen through the true X, the target lies where the plan says.
        place = np.linalg.inv(matrix @ recording.truth.image_to_probe)
        seen = (place @ np.append(recording.truth.point, 1.0))[:3]
        assert np.linalg.norm(seen[[0, 2]] - pose["target_mm"]) < 2


@pytest.mark.usefixtures("calibrated")
def test_plan_from_a_recording_says_what_to_add(simulated, capfd, tmp_path):
    figure = tmp_path / "plan.png"
    found = json.loads(told(capfd, "plan", simulated, "--images", 4, "--json", "--figure", figure))
    assert (found["images_before"], len(found["poses"]), len(found["tre_mm"])) == (50, 4, 5)
    assert found["tre_mm"] == sorted(found["tre_mm"], reverse=True)
    assert figure.read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("calibrated")
def test_plan_from_a_recording_keeps_the_region_that_no_option_changes(simulated, capfd):
    def region(*options):
        return json.loads(told(capfd, "plan", simulated, "--images", 1, "--json", *options))[
            "region"
        ]

    seen = region()
    assert seen["depth_mm"][1] > 90
    assert region("--lateral", 3) == seen | {"lateral_mm": [-3.0, 3.0]}
    said = told(capfd, "plan", simulated, "--until-tre", 5, "--depth", 30, 40)
    left, right = (f"{round(side)}" for side in seen["lateral_mm"])
    assert f"Target 30 to 40 mm deep, laterally from {left} to {right} mm" in said
    assert "The existing images reach 5 mm already (0." in said


def test_the_region_of_pixels_is_about_the_middle_of_the_image(tmp_path, capfd):
    """Lateral positions of pixels count from the left edge: there is nothing at -3 mm."""
    seen, pixels = Region((0.0, 60.0), (5.0, 99.0)), ImageTransform(np.eye(4), np.full(2, 0.1))
    images = make_images(np.tile(np.eye(4), (8, 1, 1)), np.ones((8, 2)), "pixel")

    def lateral(half, size, transform=pixels):
        columns = plan._columns(replace(images, frame_size=size), seen, transform)
        return plan._region(seen, None, half, *columns).lateral_mm

    assert lateral(3.0, None) == (27.0, 33.0)
    assert lateral(40.0, None) == (0.0, 70.0)
    assert lateral(40.0, (601, 1000)) == (0.0, 60.0)
    assert lateral(None, (601, 1000)) == seen.lateral_mm
    assert lateral(3.0, None, ImageTransform(np.eye(4))) == (-3.0, 3.0)
    jaxcal.save(Recording(replace(images, spacing_mm=np.full(2, 0.1))), tmp_path / "pixels.h5")
    said = refused(capfd, "plan", tmp_path / "pixels.h5", "--probe", "linear")
    assert "where the transducer is in the image is not known" in said


@pytest.mark.usefixtures("calibrated")
def test_a_plan_refuses_another_probe_than_the_recordings(simulated, tmp_path, capfd):
    jaxcal.save(replace(jaxcal.load(simulated), probe=PRESETS["linear"]), tmp_path / "linear.h5")
    said = refused(capfd, "plan", tmp_path / "linear.h5", "--probe", "curvilinear")
    assert "holds images of another probe" in said


@pytest.mark.usefixtures("calibrated")
def test_nothing_is_planned_from_wrong_frames_or_with_a_delay(simulated, tmp_path, capfd):
    recording = jaxcal.load(simulated)
    mirrored = recording.calibration.poses.copy()
    mirrored[:, 0, 3] *= -1.0
    images = replace(recording.calibration, poses=mirrored)
    jaxcal.save(replace(recording, calibration=images), tmp_path / "mirrored.h5")
    for arguments, said in (
        ([], "translations have the wrong sign"),
        (["--estimate", "sound-speed,delay"], "no plan is made with it"),
    ):
        assert said in refused(capfd, "plan", tmp_path / "mirrored.h5", *arguments)


@pytest.mark.parametrize(
    "ending", ["png", "jpg", "gif", "tif", "webp", "pdf", "ps", "pgf", "svg", "svgz"]
)
def test_a_figure_of_a_plan_is_known_as_a_picture_and_may_be_replaced(tmp_path, ending):
    path = tmp_path / f"plan.{ending}"
    save_figure(Figure(figsize=(1, 1)), path)
    check_output(path, "a picture", begins_with(*plan._PICTURES))


def test_a_plan_tells_that_the_images_there_are_need_attention_first(tmp_path, simulated, capfd):
    recording = jaxcal.load(simulated)
    points = recording.calibration.measurements.copy()
    points[3] += [8.0, 5.0]
    images = replace(recording.calibration, measurements=points, covariance=None)
    jaxcal.save(replace(recording, calibration=images), tmp_path / "wrong.h5")
    said = " ".join(told(capfd, "plan", tmp_path / "wrong.h5", "--images", 1).split())
    assert "These errors are by the noise model alone. First see to the images" in said
    found = json.loads(told(capfd, "plan", tmp_path / "wrong.h5", "--images", 1, "--json"))
    assert found["outliers"] == [3]
    assert "First see" not in told(capfd, "plan", simulated, "--images", 1)


def test_plan_from_nothing_is_words_and_counts(capfd):
    out = told(capfd, "plan", "--images", 6, "--cone", 20, "--seed", 1, "--sigma", 0.1, 0.1, 0.2)
    assert "tilt 20 degrees" in out
    # Fewer are not enough to estimate the SDs, and --until-tre plans no fewer.
    assert "Images needed for an error of 0.5 mm: 8; 0.3 mm: 8;" in out
    assert "(never fewer than 8, which estimating the errors' SDs takes)" in " ".join(out.split())
    assert out.count("target") >= 6


def test_the_sector_of_a_curvilinear_probe_is_not_told_as_a_rectangle(capfd):
    probe = jaxcal.CurvilinearProbe()
    region = design.Region.of_probe(probe, lateral_mm=(-20.0, 20.0))
    model = design.Model(noise=design.Noise.constant((0.02, 0.02, 0.02)))
    candidates = design.make_candidates(probe, region, count=100, model=model)
    found = design.plan(candidates, 6, polish=False)
    record = plan._record(found, None, region, None)
    plan._print(found, record, None, None)
    out = capfd.readouterr().out
    assert "Target 15 to 82 mm from the array, in front of its arc from -20 to 20 mm." in out
    assert record["region"]["radius_mm"] == probe.radius_mm
    # The table's lateral positions are straight, and so beyond these limits.
    assert max(abs(pose["target_mm"][0]) for pose in record["poses"]) > 30


def test_a_plan_is_tried_in_simulated_recordings(capfd):
    arguments = ["plan", "--images", 24, "--sigma", 0.1, 0.1, 1]
    arguments += ["--simulate", "normal", "--simulate", "uniform"]
    normal, uniform = json.loads(told(capfd, *arguments, "--json"))["simulated"]
    assert (normal["images"], normal["trials"], normal["lost"]) == (24, 1000, 0)
    # Offsets with edges tell the default method more than their SD says.
    assert uniform["tre_mm"] < 0.9 * normal["tre_mm"]
    words = plan._simulated_in_words(normal)
    assert words.startswith("In 1000 simulated recordings with normal offsets: error over the ")
    assert f"image {normal['tre_mm']:.2g} mm" in words


@pytest.mark.parametrize("criterion", ["tre", "d"])
def test_a_plan_has_as_many_poses_as_its_error_takes_and_no_more(capfd, criterion):
    arguments = ["plan", "--until-tre", "0.3", "--criterion", criterion, "--json"]
    errors = json.loads(told(capfd, *arguments))["tre_mm"]
    assert errors[-1] <= 0.3 < errors[-2]


def test_plans_that_cannot_be(capfd, tmp_path):
    for arguments, match in (
        (["--images", 10, "--until-tre", 0.2], "either --images or"),
        (["--images", 10, "--cone", 0, "--turn", 0], "would not determine"),
        (["--estimate", "scale"], "needs a recording"),
        (["--depth", 80, 20], "in order"),
        (["--lateral", 30], "the image of this probe reaches 29.2 mm to either side"),
        (["--probe", "curvilinear", "--lateral", 40], "the arc of this probe reaches 3"),
        (["--images", 2], "between 4 and"),
        (["--depth", 0.02, 0.05], "the far one 1 to 5000, not (0.02, 0.05)"),
        (["--lateral", 0.02], "--lateral is in mm, and 0.02 is too small: was it in metres?"),
        (["--sigma", 2e-4, 3e-4, 1e-3], "--sigma is in mm, and 0.001 is too small"),
        (["--cone", 86], "'86' is not zero or a positive number up to 85"),
        (["--turn", "nan"], "'nan' is not zero or a positive number up to 180"),
        ([tmp_path / "absent.h5"], "absent"),
        (["--images", 5, "--figure", tmp_path / "no" / "p.png"], "folder does not exist"),
        (["--images", 5, "--figure", tmp_path / "p.xyz"], "these endings work: "),
    ):
        assert match in refused(capfd, "plan", *arguments)
    assert list(tmp_path.iterdir()) == []


SLOW_COMPILE = """
import sys, jax
from jaxcal.runtime.jax_cache import enable_compilation_cache
if sys.argv[1] == "quiet":
    enable_compilation_cache()
jax.devices()
print("compiling", flush=True)
jax.jit(lambda: jax.lax.reduce_window(
    jax.lax.iota("float32", 400_000), 0.0, jax.lax.add, (2_000,), (1,), "VALID"
).sum())()
"""


def test_alarms_of_the_compiler_do_not_reach_the_terminal():
    """One that comes after a second; "Very slow compile?" takes two minutes, by the same way."""
    started = []
    try:
        for how in ("quiet", "loud"):  # quiet first, so that its alarm would come first
            process = subprocess.Popen(
                [sys.executable, "-c", SLOW_COMPILE, how],
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
            started.append(process)
            assert process.stdout.readline() == "compiling\n"
        quiet, loud = started
        for line in loud.stderr:
            if "Constant folding" in line:
                break
        else:
            pytest.fail("the alarm never came: this test tests nothing")
        assert quiet.poll() is None
        quiet.kill()
        assert quiet.stderr.read() == ""
    finally:
        for process in started:
            process.kill()
            process.communicate()
