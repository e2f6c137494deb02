"""No command replaces what it reads, or a file of another kind than it writes; its own it does."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
from test_transform import random_transform

import jaxcal
from jaxcal import InputError
from jaxcal.cli.main import main
from jaxcal.data.recording import Recording, Truth, make_images
from jaxcal.io.atomic import write_text
from jaxcal.io.outputs import begins_with, check_output

TABLE = "u,v\n300,12.5\n"
CONFIGURATION = (
    '<PlusConfiguration version="2.9"><CoordinateDefinitions><Transform From="Image" To="Probe" '
    'Matrix="0.1 0 0 0 0 0.1 0 0 0 0 0.1 0 0 0 0 1" /></CoordinateDefinitions>'
    "</PlusConfiguration>"
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with what a user has: a recording, a calibration, tables, a sequence, notes."""
    monkeypatch.chdir(tmp_path)
    generator = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = generator.uniform(-50, 50, (6, 3))
    images = make_images(poses, generator.uniform(10, 500, (6, 2)), "pixel", spacing_mm=(0.1, 0.1))
    mask = np.array([True, True, False, True, True, True])
    jaxcal.save(Recording(replace(images, mask=mask)), "rec.h5")
    random_transform().save("cal.json")
    for name in ("rec.csv", "points.txt"):
        (tmp_path / name).write_text(TABLE)
    (tmp_path / "sweep.igs.mha").write_bytes(b"ObjectType = Image\n")
    (tmp_path / "notes.json").write_text('{"mine": 1}')
    (tmp_path / "config.xml").write_text(CONFIGURATION)
    np.save("points.npy", np.ones((4, 4)))
    shutil.copy("cal.json", "copy.json")
    return tmp_path


@pytest.mark.parametrize(
    "arguments",
    [
        "calibrate rec.h5 --report rec.h5",
        "calibrate rec.h5 --test cal.json --report cal.json",
        "calibrate rec.h5 --report sweep.igs.mha",
        "calibrate rec.h5 --report ./config.xml",
        "calibrate rec.h5 --export itk:rec.h5",
        "calibrate rec.h5 --export numpy:rec.h5",
        "calibrate rec.h5 --export numpy:points.txt",
        "calibrate rec.h5 --export numpy:points.npy",
        "calibrate rec.h5 --export slicer:points.txt",
        "calibrate rec.h5 --export tusrec:rec.csv",
        "calibrate rec.h5 --export plus:rec.csv",
        "apply cal.json rec.csv --out rec.csv",
        "apply cal.json points.txt --out rec.csv",
        "apply cal.json rec.csv --out rec.h5",
        "apply cal.json rec.csv --out cal.json",
        "export cal.json cal.json --plus",
        "export cal.json ./copy.json --plus",
        "export cal.json rec.h5 --itk",
        "export cal.json config.xml --plus",
        "export cal.json sweep.igs.mha --ros",
        "export cal.json rec.csv --plus-config config.xml",
        "export config.xml --plus-config config.xml",
        "simulate rec.h5",
        "simulate rec.csv",
        "segment rec.h5 --out rec.csv",
        "plan rec.h5 --figure rec.h5",
        "plan --figure rec.csv",
    ],
)
def test_nothing_of_another_kind_is_replaced(folder, arguments, capsys):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main(arguments.split()) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    "arguments",
    [
        "apply cal.json rec.csv --out out.csv",
        "apply cal.json rec.h5 --out out.csv",
        "export cal.json a.xml --plus",
        "export cal.json a.h5 --itk",
        "export cal.json a.txt --slicer",
        "export cal.json a.yaml --ros",
        "export cal.json a.csv --tusrec",
        "export cal.json a.npz --numpy",
        "export cal.json a.npy --numpy",
        "export cal.json b.xml --plus-config config.xml",
        "export cal.json --plus-config config.xml",
    ],
)
def test_the_same_command_may_be_run_again(folder, arguments, capsys):
    assert main(arguments.split()) == main(arguments.split()) == 0


@pytest.mark.parametrize(
    "arguments",
    [
        "calibrate missing.h5 --export itk:none/out.h5",
        "import missing.csv none/out.h5",
        "segment rec.h5 --out none/out.h5",
        "segment sweep.igs.mha --out none/out.h5",
    ],
)
def test_where_nothing_can_be_written_no_work_begins(folder, arguments, capsys):
    """What is wrong with the sources, which cannot be used either, is not found out."""
    assert main(arguments.split()) == 2
    assert "none/out.h5: cannot be written: its folder does not exist" in capsys.readouterr().err


def test_an_export_goes_into_the_folder_that_the_report_makes(folder, capsys):
    arguments = "calibrate missing.h5 --out report --export itk:./report/out.tfm"
    assert main(arguments.split()) == 2
    assert "missing.h5: no such file" in capsys.readouterr().err


def test_the_page_goes_into_the_folder_that_the_report_makes(folder):
    assert main(["simulate", "sim.h5", "--images", "12"]) == 0
    arguments = "calibrate sim.h5 --method conventional --out new/report --report new/report/p.html"
    assert main(arguments.split()) in (0, 5)
    assert (folder / "new/report/p.html").is_file()


@pytest.mark.parametrize(
    "named",
    [
        "--export tusrec:new/residuals.csv",
        "--export slicer:new/verdict.txt",
        "--report new/../new/limits.svg",
        "--export slicer:a.tfm --export itk:./a.tfm",
        "--report p.csv --export tusrec:p.csv",
    ],
)
def test_two_files_of_one_name_are_refused_before_the_solve(folder, named, capsys):
    before = sorted(folder.rglob("*"))
    assert main(["calibrate", "rec.h5", "--out", "new", *named.split()]) == 2
    assert "the same command writes another file of this name" in capsys.readouterr().err
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("target", ["numpy:x.npy", "itk:x.tfm", "tusrec:x.csv", "plus:config.xml"])
def test_pixels_are_missed_before_the_solve(folder, target, capsys):
    """A recording of points in mm, unusable beyond that: no work begins."""
    recording = jaxcal.load("rec.h5")
    points = make_images(recording.calibration.poses, np.ones((6, 2)), "point")
    jaxcal.save(Recording(points), "points.h5")
    assert main(["calibrate", "points.h5", "--export", target]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "holds no pixels" in error
    assert "jaxcal export with --pixel-size" in error


def test_a_simulation_replaces_a_simulation(folder, monkeypatch, capsys):
    known = jaxcal.load("rec.h5")
    truth = Truth(np.eye(4), np.zeros(3), np.zeros(6))
    jaxcal.save(replace(known, truth=truth), "simulated.h5")
    assert main(["simulate", "simulated.h5", "--images", "8"]) == 0
    assert len(jaxcal.load("simulated.h5").calibration) == 8


@pytest.mark.parametrize(
    "arguments",
    [
        "import points.txt bench.h5",
        "segment rec.h5 --out bench.h5",
        "segment sweep.igs.mha --out bench.h5",
        "simulate bench.h5",
    ],
)
def test_an_acquisition_is_not_replaced(folder, arguments, capsys):
    """A recording, with truth as of an emulated bench, that is not complete or holds raw data."""
    known = replace(jaxcal.load("rec.h5"), truth=Truth(np.eye(4), np.zeros(3), np.zeros(6)))
    for found in ("/tracker, /us", "not complete"):
        jaxcal.save(known, "bench.h5")
        with h5py.File("bench.h5", "r+") as file:
            if found == "not complete":
                file.attrs["complete"] = False
            else:
                file["us/frames"] = file["tracker/pose"] = np.zeros(3)
        before = (folder / "bench.h5").read_bytes()
        assert main(arguments.split()) == 2
        assert (
            f"bench.h5: is an acquisition with its raw data ({found}): choose another name"
            in capsys.readouterr().err
        )
        assert (folder / "bench.h5").read_bytes() == before


def test_a_recording_that_is_open_elsewhere(folder, capsys):
    fcntl = pytest.importorskip("fcntl")
    with open("rec.h5", "rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert main(["import", "points.txt", "rec.h5"]) == 2
    assert (
        "rec.h5: is being written: close it in the program that writes it (not replaced: "
        "name another file)" in capsys.readouterr().err
    )


def test_saved_from_python(folder):
    transform = random_transform()
    for name in ("rec.csv", "rec.h5", "notes.json", "points.npy", "points.txt", "config.xml"):
        before = (folder / name).read_bytes()
        with pytest.raises(InputError, match="exists and is not a calibration"):
            transform.save(name)
        assert (folder / name).read_bytes() == before
    transform.save("copy.json")


def test_links_and_what_is_no_file(folder, tmp_path):
    (tmp_path / "link").hardlink_to(tmp_path / "points.txt")
    with pytest.raises(InputError, match="is an input of this command"):
        check_output("link", "a table", begins_with(b"u,v"), ["points.txt"])
    check_output("link", "a table", begins_with(b"u,v"), ["rec.h5", "nowhere"])
    write_text("empty", "")
    for name in ("empty", "/dev/null", "nowhere/at/all", "nul\0byte"):
        check_output(name, "a table", begins_with(b"u,v"))


@pytest.mark.parametrize(
    ("format", "name"),
    [("--ros", "a.tfm"), ("--plus", "b.foo"), ("--numpy", "c.csv"), ("--tusrec", "d")],
)
def test_a_name_says_the_format(folder, format, name, capsys):
    assert main(["export", "cal.json", name, format]) == 2
    assert "is named ." in capsys.readouterr().err
    assert not (folder / name).exists()


@pytest.mark.parametrize(
    "arguments",
    [
        "simulate a.csv",
        "import rec.csv a.h5x",
        "segment rec.h5 --out a",
        "segment f.mha --out a.txt",
    ],
)
def test_a_recording_is_named_so(folder, arguments, capsys):
    assert main(arguments.split()) == 2
    name = arguments.split()[-1]
    assert f"{name}: a recording is named .h5 or .hdf5" in capsys.readouterr().err.replace(
        "a simulated", "a"
    )
    assert not (folder / name).exists()


@pytest.mark.parametrize("name", ["scene.mrml", "config.xml.orig", "cal"])
def test_an_extension_without_a_format(folder, name, capsys):
    (folder / name).write_text("<x/>")
    assert main(["export", name, "--plus"]) == 2
    assert f"{name}: its extension names no format (there are .json," in capsys.readouterr().err
    shutil.copy("cal.json", name)  # the JSON is understood without one
    assert main(["export", name, "--plus"]) == 0


def test_applied_to_a_recording_of_another_depth_or_body_is_told(folder, capsys):
    images = jaxcal.load("rec.h5").calibration
    size = np.array(random_transform().scale_mm_per_px)
    for name, pixel, body in (("same.h5", size, "Probe"), ("other.h5", 2 * size, "Wand")):
        changed = replace(images, spacing_mm=pixel, face_offset_mm=1.5)
        jaxcal.save(Recording(changed, pose_frames=(body, "Tracker")), name)
    record = json.loads((folder / "cal.json").read_text())
    named = record | {"pose_frames": {"from": "Port 1", "to": "Tracker"}}
    (folder / "named.json").write_text(json.dumps(named))
    assert main(["apply", "cal.json", "same.h5"]) == 0
    assert capsys.readouterr().err == ""
    assert main(["apply", "named.json", "other.h5"]) == 0
    said = capsys.readouterr().err
    assert (
        "- The frames of the probe have different names: 'Port 1' in named.json, 'Wand' in" in said
    )
    assert re.search(
        r"- A pixel is \S+ x \S+ mm in named\.json and \S+ x \S+ mm in other\.h5", said
    )


def test_images_and_lines_keep_their_numbers(folder, capsys):
    assert main(["apply", "cal.json", "rec.h5"]) == 0
    rows = [line.split(",")[-1] for line in capsys.readouterr().out.splitlines()]
    assert rows == ["image", "0", "1", "3", "4", "5"]
    (folder / "gaps.csv").write_text("u,v,status\n1,2,OK\n3,4,MISSING\n5,6,OK\n")
    assert main(["apply", "cal.json", "gaps.csv"]) == 2
    assert "--skip-invalid" in capsys.readouterr().err
    assert main(["apply", "cal.json", "gaps.csv", "--skip-invalid"]) == 0
    rows = [line.split(",")[-1] for line in capsys.readouterr().out.splitlines()]
    assert rows == ["line", "2", "4"]


@pytest.mark.parametrize("pixel", ["nan", "inf", "1e300"])
def test_points_that_are_none(folder, pixel, capfd):
    assert main(["apply", "cal.json", "--pixel", pixel, "3"]) == 2
    err = capfd.readouterr().err
    assert "pixels must be numbers up to 1e+09" in err
    assert err.count("\n") == 1
    assert main(["apply", "cal.json", "--pixel", "1", "3", "--pixel-sd", "1e300"]) == 2
    assert "pixel_sd_px must be from 0" in capfd.readouterr().err
