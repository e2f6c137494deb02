"""Recordings from frames: segmented sequences, folders of PNG, poses of another file, DICOM."""

from __future__ import annotations

import json
import os
import re
import shlex
import warnings
import zlib
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import png
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation, Slerp

import jaxcal
from jaxcal import FormatError, InputError, MissingExtraError
from jaxcal.cli.main import main
from jaxcal.cli.segment import _default_out
from jaxcal.data.poses import matrices_from_rotations
from jaxcal.io.dicom import read_pixel_size
from jaxcal.io.folder import read_folder
from jaxcal.io.importing.files import import_files
from jaxcal.io.importing.frame_poses import open_sequence
from jaxcal.io.importing.poses_by_time import PoseTrack, with_poses_by_time
from jaxcal.io.importing.sources import ImportOptions
from jaxcal.io.picker.picks import Picks
from jaxcal.io.png import encode_png, png_size, read_png
from jaxcal.io.sequence import TrackedSequence
from jaxcal.io.sequence_files import read_sequence, write_sequence

ROWS, COLUMNS, COUNT = 110, 150, 9
PAIR = ("Probe", "Tracker")
RNG = np.random.default_rng(4)
POINTS = RNG.uniform([25, 25], [COLUMNS - 25, ROWS - 25], (COUNT, 2))
POSES = matrices_from_rotations(
    Rotation.random(COUNT, random_state=3).as_matrix(), RNG.uniform(-150, 150, (COUNT, 3))
)
NOT_TRACKED, HIDDEN, BLANK = 2, 5, 7
MATRIX = ",".join(f"m{i}{j}" for i in range(1, 4) for j in range(1, 5))


def speckle(rng, u=None, v=None) -> np.ndarray:
    """Log-compressed speckle with one bright echo."""
    noise = [gaussian_filter(rng.normal(size=(ROWS, COLUMNS)), (1.2, 2.0)) for _ in range(2)]
    field = (noise[0] + 1j * noise[1]) / np.hypot(np.std(noise[0]), np.std(noise[1]))
    if u is not None:
        rows, columns = np.indices(field.shape)
        field += 30 * np.exp(-0.5 * (((rows - v) / 1.2) ** 2 + ((columns - u) / 2.0) ** 2))
    decibels = 20 * np.log10(np.abs(field) + 1e-6)
    return np.clip(255 * (decibels + 20) / 60, 0, 255).astype(np.uint8)


FRAMES = [speckle(RNG, *(POINTS[k] if k != HIDDEN else ())) for k in range(COUNT)]
FOUND = [k for k in range(COUNT) if k not in (NOT_TRACKED, HIDDEN, BLANK)]


@pytest.fixture(params=["f.igs.mha", "f.igs.mhd", "f.igs.nrrd", "f.seq.nrrd"])
def sequence(request, tmp_path):
    """Nine frames: one not tracked, one without a target, one whose image was not OK."""
    path = tmp_path / request.param
    valid = {PAIR: np.arange(COUNT) != NOT_TRACKED}
    write_sequence(path, {PAIR: POSES}, np.arange(COUNT) / 20, valid=valid, images=FRAMES)
    text = path.read_bytes()
    name = b"Status" if request.param.endswith("nrrd") else b"ImageStatus"
    separator = b":=" if request.param.endswith("nrrd") else b" = "
    old = b"Seq_Frame%04d_%s%sOK" % (BLANK, name, separator)
    assert text.count(old) == 1
    path.write_bytes(text.replace(old, old[:-2] + b"INVALID"))
    return path


def test_names_with_dots_have_outputs_of_their_own(tmp_path):
    """Recordings of depths 4.5 and 4.0 cm went into one file; a folder's name has no extension."""
    (tmp_path / "PNG of 2024.05").mkdir()
    for name, stem in (
        ("f 4.5 cm.igs.mha", "f 4.5 cm"),
        ("f 4.0 cm.seq.NRRD", "f 4.0 cm"),
        ("a.b.mhd", "a.b"),
        ("PNG of 2024.05", "PNG of 2024.05"),
    ):
        assert _default_out(str(tmp_path / name)) == str(tmp_path / f"{stem}-segmented.h5")


def test_where_few_targets_are_found_the_next_command_can_be_copied(tmp_path, capsys):
    """One line, and with the options that chose the poses."""
    frames = [FRAMES[k] for k in FOUND[:4]] + [FRAMES[HIDDEN]] * 5
    path = tmp_path / "a sweep that was recorded in the tank with the long name.igs.mha"
    write_sequence(path, {PAIR: POSES}, np.arange(COUNT) / 20, images=frames)
    text = path.read_bytes()
    path.write_bytes(text.replace(b"UltrasoundImageOrientation = MFA\n", b""))
    given = ["--poses", str(path), "--from", "Probe", "--to", "Tracker", "--orientation", "MF"]
    given += ["--pose-units", "mm"]
    assert main(["segment", str(path), *given]) == 3
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2].endswith("hand:")
    assert shlex.split(lines[-1]) == ["jaxcal", "pick", str(path), *given]


def test_points_placed_by_hand_keep_the_lag_that_was_to_be_estimated(tmp_path, lagging, capsys):
    """The command that jaxcal pick prints at its end has no lag: images would count as prompt."""
    times, points = lagging[0][::2], lagging[1][::2]
    frames = [speckle(RNG, *(point if k % 5 < 2 else ())) for k, point in enumerate(points)]
    path = tmp_path / "f.igs.mha"
    write_sequence(path, {}, times, images=frames)
    given = ["--poses", str(tmp_path / "t.igs.mha")]
    assert main(["segment", str(path), *given, "--lag", "auto"]) == 3
    lines = capsys.readouterr().out.splitlines()
    said = " ".join(" ".join(lines[:-1]).split())
    assert said.endswith("hand, and import them with --lag auto:")
    assert shlex.split(lines[-1]) == ["jaxcal", "pick", str(path), *given]


def test_segment_a_sequence(tmp_path, sequence, capsys):
    """From frames to a recording with points: what became of every frame is counted and said."""
    assert main(["segment", str(sequence), "--spacing", "0.2", "0.15"]) == 0
    said = capsys.readouterr().out
    assert "f-segmented.h5: 6 of 9 frames segmented (echo)" in " ".join(said.split())
    said = said.splitlines()
    assert "- 1 of 9 frames left out: their tracking was not OK" in said
    assert "- 1 of 9 frames left out: their image was not OK" in said
    assert "- 1 of 9 frames left out: no credible target in them (nothing stands out: 1)" in said
    images = jaxcal.load(tmp_path / "f-segmented.h5").calibration
    np.testing.assert_allclose(images.poses, POSES[FOUND], atol=1e-9)
    np.testing.assert_allclose(images.time, np.array(FOUND) / 20)
    np.testing.assert_array_equal(images.frame, FOUND)
    np.testing.assert_array_equal(images.spacing_mm, [0.2, 0.15])
    error = images.measurements - POINTS[FOUND]
    assert np.abs(error).max() < 0.5
    scaled = np.einsum("ni,nij,nj->n", error, np.linalg.inv(images.covariance), error)
    assert scaled.mean() < 6
    with h5py.File(tmp_path / "f-segmented.h5") as file:
        np.testing.assert_array_equal(file["segmentation/row"], FOUND)
        fates = file["segmentation"].attrs["fates"].split(", ")
        told = [fates[fate] for fate in file["segmentation/fate"]]
    assert [told[k] for k in (NOT_TRACKED, HIDDEN, BLANK)] == [
        "not tracked", "not credible", "image not OK"]  # fmt: skip
    out = tmp_path / "other.h5"
    assert main(["segment", str(sequence), "--json", "--out", str(out)]) == 0
    record = json.loads(capsys.readouterr().out)
    counts = [record[key] for key in ("frames", "found", "not_credible", "not_tracked")]
    assert counts == [9, 6, 1, 1]
    assert [each["frame"] for each in record["per_frame"] if each["fate"] == "found"] == FOUND
    assert "dB over the background" in record["per_frame"][HIDDEN]["reason"]


def test_only_some_frames_of_a_sequence(tmp_path, sequence, capsys):
    """They keep their numbers; the others are neither searched nor counted."""
    out = tmp_path / "o.h5"
    assert main(["import", str(sequence), str(out), "--frames", "1-4,6,8-20"]) == 0
    said = capsys.readouterr().out.splitlines()
    told = f"- only frames 1 to 4, 6, 8 to 20 of {sequence} are used (12 of these 18 "
    assert told + "numbers name no frame)" in said
    assert "- 1 of 6 frames left out: their tracking was not OK" in said
    assert not any("credible" in line or "image was" in line for line in said)
    np.testing.assert_array_equal(jaxcal.load(out).calibration.frame, [1, 3, 4, 6, 8])
    assert main(["segment", str(sequence), "--frames", "1-4,6,8", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["found"], record["not_tracked"], record["not_selected"]) == (5, 1, 3)
    points = [f"{k},{u},{v}" for k, (u, v) in enumerate(POINTS)]
    (tmp_path / "p.csv").write_text("\n".join(["frame,u,v", *points]))
    placed = [str(sequence), str(tmp_path / "p.csv"), str(out)]
    assert main(["import", *placed, "--frames", "0-4,7"]) == 0
    images = jaxcal.load(out).calibration
    np.testing.assert_array_equal(images.frame, [0, 1, 3, 4])
    np.testing.assert_allclose(images.measurements, POINTS[[0, 1, 3, 4]])
    capsys.readouterr()
    for frames, message in (
        ("9,12", "has frames 0 to 8, none of --frames 9, 12"),
        ("2", "no frame that is used has tracking from Probe to Tracker"),
        ("5-3", "'5-3' is no list of images"),
    ):
        assert main(["import", *placed, "--frames", frames]) == 2
        assert message in capsys.readouterr().err


def test_the_lag_is_estimated_from_the_frames_that_are_used(tmp_path, lagging):
    """A target that is moved later spoils the estimate, unless these frames are left out."""
    times, points = lagging
    points[50:] += 200
    rows = [f"{t!r},{u!r},{v!r}" for t, (u, v) in zip(times.tolist(), points.tolist(), strict=True)]
    (tmp_path / "p.csv").write_text("\n".join(["time,u,v", *rows]))
    options = ImportOptions(poses=tmp_path / "t.igs.mha", lag_s="auto", frames=tuple(range(50)))
    found = import_files([tmp_path / "i.igs.mha", tmp_path / "p.csv"], options)
    assert "estimated from 50 points" in " ".join(found.notes)
    assert "images lag by 0.08" in " ".join(found.notes)
    assert len(found.recording) == 50


def test_an_import_of_few_frames_says_why_and_how_to_go_on(tmp_path, capsys):
    path = tmp_path / "n.igs.mha"
    frames = [FRAMES[k] if k < 4 else FRAMES[HIDDEN] for k in range(COUNT)]
    write_sequence(path, {PAIR: POSES}, np.arange(COUNT) / 20, images=frames)
    assert main(["import", str(path), str(tmp_path / "n.h5")]) == 3
    assert len(jaxcal.load(tmp_path / "n.h5")) == 4
    lines = capsys.readouterr().out.splitlines()
    lost = "- 5 of 9 frames left out: no credible target in them (nothing stands out: 5)"
    assert lost in lines
    assert shlex.split(lines[-1]) == ["jaxcal", "pick", str(path)]


def test_frames_without_tracking_are_not_said_to_show_no_target(tmp_path, capsys):
    path = tmp_path / "n.igs.mha"
    write_sequence(path, {PAIR: POSES[:3]}, np.arange(3.0), images=FRAMES[:3])
    assert main(["import", str(path), str(tmp_path / "n.h5")]) == 2
    assert capsys.readouterr().err.endswith(
        "n.igs.mha: only 3 of 3 frames have an image and tracking that are OK, at least 4 are "
        "needed\n"
    )


def test_where_nothing_is_credible_the_way_on_is_named(tmp_path, capsys):
    path = tmp_path / "n.igs.mha"
    frames = [speckle(RNG) for _ in range(4)]
    write_sequence(path, {PAIR: POSES[:4]}, np.arange(4.0), images=frames)
    assert main(["segment", str(path)]) == 2
    assert "only 0 of 4 frames show a credible target" in (error := capsys.readouterr().err)
    assert "check --region and --target, or place the points by hand: jaxcal pick" in error
    assert [entry.name for entry in tmp_path.iterdir()] == ["n.igs.mha"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "shortest"], "--method is an option for times of flight"),
        (["--no-robust"], "is an option for times of flight"),
        (["--region", "140", "0", "40", "40"], "leaves the 150 x 110 px frame"),
        (["--out", "f.igs.mha"], "is an input of this command"),
        (["--from", "Stylus"], "no transforms lead from 'Stylus'"),
    ],
)
def test_segment_refuses(tmp_path, monkeypatch, arguments, message, capsys):
    monkeypatch.chdir(tmp_path)
    write_sequence("f.igs.mha", {PAIR: POSES}, np.arange(COUNT) / 20, images=FRAMES)
    assert main(["segment", "f.igs.mha", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert [entry.name for entry in tmp_path.iterdir()] == ["f.igs.mha"]


def test_a_mark_of_the_machine_is_told_from_a_target(tmp_path, capsys):
    """A logo that outshines the echo is found at the same place in every frame."""
    path = tmp_path / "f.igs.mha"
    frames = [FRAMES[0] if k < 6 else FRAMES[1] for k in range(COUNT)]
    for poses, told in ((POSES, True), (np.tile(POSES[:1], (COUNT, 1, 1)), False)):
        write_sequence(path, {PAIR: poses}, np.arange(COUNT) / 20, images=frames)
        main(["import", str(path), str(tmp_path / "f.h5")])
        said = " ".join(capsys.readouterr().out.split())
        assert ("in 6 of 9 frames the target is at the same place" in said) == told


def test_a_tail_of_echoes_behind_the_target_is_told(tmp_path, capsys):
    """The points were 1.8 mm too deep, and nothing said so."""
    path = tmp_path / "f.igs.mha"
    for echoes, told in ((1, False), (5, True)):
        frames = [np.max([np.roll(each, 2 * k, 0) for k in range(echoes)], 0) for each in FRAMES]
        write_sequence(path, {PAIR: POSES}, np.arange(COUNT) / 20, images=frames)
        main(["segment", str(path)])
        said = " ".join(capsys.readouterr().out.split())
        assert ("in 8 of 8 frames the target is longer in depth than across" in said) == told


def test_segment_of_a_folder_that_does_not_exist_blames_no_option(tmp_path, capsys):
    assert main(["segment", str(tmp_path / "images"), "--poses", str(tmp_path / "p.csv")]) == 2
    assert "images: no such file" in capsys.readouterr().err


# Folders.


@pytest.fixture
def folder(tmp_path):
    """Nine images; b2 comes before b10."""
    path = tmp_path / "images"
    path.mkdir()
    for number, frame in enumerate(FRAMES):
        (path / f"b{number + 2}.png").write_bytes(encode_png(frame))
    (path / "notes.txt").write_text("not an image")
    # What a Mac leaves beside a file that it copies.
    (path / "._b2.png").write_bytes(b"\0\5\x16\7Mac OS X")
    return path


def pose_table(path: Path, first: str, cells, rows=range(COUNT)) -> Path:
    """A table with one column more, or none."""
    quaternions = Rotation.from_matrix(POSES[:, :3, :3]).as_quat()
    head = f"{first}x,y,z,qx,qy,qz,qw"
    lines = [
        cells(k) + ",".join(repr(float(x)) for x in [*POSES[k, :3, 3], *quaternions[k]])
        for k in rows
    ]
    path.write_text("\n".join([head, *lines]))
    return path


def test_segment_and_pick_read_tables_of_poses_as_import_does(tmp_path, folder, capsys):
    """Their errors named --skip-invalid and --quaternion, which only jaxcal import took."""
    rows = [f"b{k + 2}.png;{'' if k == 0 else 0.1 * k};0.05;0;1;0;0;0" for k in range(COUNT)]
    table = tmp_path / "poses.csv"
    table.write_text("\n".join(["file;x;y;z;qw;qx;qy;qz", *rows]))
    poses = ["--poses", str(table)]
    for command in (
        ["segment", str(folder)],
        ["pick", str(folder), str(tmp_path / "no" / "p.csv")],
    ):
        assert main([*command, *poses]) == 2
        assert "leave such rows out with --skip-invalid" in capsys.readouterr().err
    given = ["--pose-units", "m", "--quaternion", "wxyz", "--skip-invalid", "--invert-poses"]
    assert main(["segment", str(folder), *poses, *given]) == 0
    images = jaxcal.load(tmp_path / "images-segmented.h5").calibration
    assert images.poses[0, :3, 3] == pytest.approx([-100, -50, 0])
    assert main(["pick", str(folder), str(tmp_path / "no" / "p.csv"), *poses, *given]) == 2
    assert "its folder does not exist" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("first", "cells"),
    [
        ("file,", lambda k: f"b{k + 2}.png,"),
        ("file,", lambda k: f"C:\\data\\b{k + 2}.png,"),
        ("filename,", lambda k: f"b{k + 2},"),
        ("frame,", lambda k: f"{k + 2},"),
        ("", lambda k: ""),
        ("time,frame,", lambda k: f"{k / 20},{k + 2},"),
    ],
)
def test_a_folder_with_poses(tmp_path, folder, first, cells, capsys):
    rows = range(COUNT) if not first else [*range(COUNT)][::-1] if "time" not in first else range(9)
    table = pose_table(tmp_path / "poses.csv", first, cells, rows)
    out = str(tmp_path / "out.h5")
    assert main(["import", str(folder), out, "--poses", str(table)]) == 0
    assert "no credible target" in capsys.readouterr().out
    images = jaxcal.load(out).calibration
    found = [k for k in range(COUNT) if k != HIDDEN]
    np.testing.assert_allclose(images.poses, POSES[found], atol=1e-9)
    assert np.abs(images.measurements - POINTS[found]).max() < 0.5
    if "time" in first:
        np.testing.assert_allclose(images.time, np.array(found) / 20)


def test_the_images_of_a_folder_are_told_by_name(tmp_path, folder, capsys):
    """Numbers that count from 0 would be taken for those in the names."""
    table = str(pose_table(tmp_path / "poses.csv", "", lambda k: ""))
    assert main(["segment", str(folder), "--poses", table, "--json"]) == 0
    frames = json.loads(capsys.readouterr().out)["per_frame"]
    assert [each["file"] for each in frames] == [f"b{k + 2}.png" for k in range(COUNT)]
    assert not any("frame" in each for each in frames)
    assert [k for k, each in enumerate(frames) if each["fate"] != "found"] == [HIDDEN]


def test_images_without_a_pose_are_counted(tmp_path, folder):
    table = pose_table(tmp_path / "p.csv", "frame,", lambda k: f"{k + 2},", rows=[0, 1, 3, 4, 6])
    recording, notes, frames, _ = import_files([folder], ImportOptions(poses=table))
    assert len(recording) == 5
    assert f"4 of 9 images have no pose in {table}" in notes
    assert frames.counts["not tracked"] == 4


@pytest.mark.parametrize(
    ("first", "cells", "rows", "message"),
    [
        ("file,", lambda k: "c1.png,", range(4), "p.csv:2: there is no image 'c1.png'"),
        ("file,", lambda k: "b3.png,", range(4), "two poses for 'b3.png'"),
        (
            "frame,",
            lambda k: f"{k},",
            range(4),
            "p.csv:2: frame 0 is not in the sequence, which has frames 2 to 10",
        ),
        ("", lambda k: "", range(4), "4 poses, but"),
        ("u,v,", lambda k: "1,1,", range(COUNT), "holds points as well as poses"),
    ],
)
def test_poses_that_do_not_belong(tmp_path, folder, first, cells, rows, message, capsys):
    table = pose_table(tmp_path / "p.csv", first, cells, rows)
    assert main(["import", str(folder), str(tmp_path / "o.h5"), "--poses", str(table)]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "o.h5").exists()


def test_a_folder_alone_asks_for_its_poses(tmp_path, folder, capsys):
    assert main(["import", str(folder), str(tmp_path / "o.h5")]) == 2
    assert "name the file with its poses (--poses)" in capsys.readouterr().err


@pytest.mark.parametrize("column", ["frame", "file"])
def test_a_folder_and_points(tmp_path, folder, column):
    """Both tables call an image by the number that ends its name, or by the name."""
    table = pose_table(tmp_path / "p.csv", "frame,", lambda k: f"{k + 2},")
    names = [str(k + 2) if column == "frame" else f"b{k + 2}.png" for k in range(COUNT)]
    lines = [f"{name},{u!r},{v!r}" for name, (u, v) in zip(names, POINTS.tolist(), strict=True)]
    (tmp_path / "uv.csv").write_text("\n".join([f"{column},u,v", *lines[5:], *lines[1:4]]))
    recording, _, frames, _ = import_files(
        [folder, tmp_path / "uv.csv"], ImportOptions(poses=table)
    )
    used = [1, 2, 3, 5, 6, 7, 8]
    np.testing.assert_allclose(recording.calibration.measurements, POINTS[used])
    np.testing.assert_allclose(recording.calibration.poses, POSES[used], atol=1e-9)
    assert frames is None


def test_points_with_poses_of_their_own_are_refused(tmp_path):
    """Those poses were passed over."""
    write_sequence(tmp_path / "f.mha", {PAIR: POSES}, np.arange(COUNT) / 20, images=FRAMES)
    table = pose_table(tmp_path / "p.csv", "u,v,", lambda k: "1,1,")
    with pytest.raises(InputError, match="holds poses as well as points"):
        import_files([tmp_path / "f.mha", table])


def test_times_that_pair_nothing_may_be_ignored(tmp_path, folder):
    """The error advised to leave the row out."""
    table = pose_table(
        tmp_path / "p.csv", "frame,time,", lambda k: f"{k + 2},{'' if k == 3 else k},"
    )
    lines = [
        f"{k + 2},{'' if k == 3 else k},{u!r},{v!r}" for k, (u, v) in enumerate(POINTS.tolist())
    ]
    (tmp_path / "uv.csv").write_text("\n".join(["frame,time,u,v", *lines]))
    sources = [folder, tmp_path / "uv.csv"]
    with pytest.raises(FormatError, match=r"\('time'\) is empty"):
        import_files(sources, ImportOptions(poses=table))
    recording, *_ = import_files(sources, ImportOptions(poses=table, ignore_time=True))
    assert len(recording) == COUNT
    assert recording.calibration.time is None


def test_picks_in_a_folder_name_the_images(tmp_path, folder):
    """They are read again with the poses that a table gives to the numbers in the names."""
    out = tmp_path / "picks.csv"
    images = read_folder(folder)
    for k in (0, 3, 4, 6):
        # Opened anew each time: the points of before are kept.
        picks = Picks(out, "images", (COLUMNS, ROWS), COUNT, range(COUNT), images.files)
        picks.pick(k, *POINTS[k].tolist())
    table = pose_table(tmp_path / "p.csv", "frame,", lambda k: f"{k + 2},")
    recording, *_ = import_files([folder, out], ImportOptions(poses=table))
    np.testing.assert_allclose(recording.calibration.measurements, POINTS[[0, 3, 4, 6]])
    np.testing.assert_allclose(recording.calibration.poses, POSES[[0, 3, 4, 6]], atol=1e-9)


def test_images_that_are_not_read_are_named(tmp_path):
    for name in ("a.TIF", "b.tif", "c.jpg", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    told = r"holds no PNG images \(\.jpg and \.tif must be converted to PNG first\)$"
    with pytest.raises(FormatError, match=told):
        read_folder(tmp_path)


@pytest.mark.parametrize("command", [["segment"], ["import"]])
def test_tracking_alone_needs_a_file_of_points(tmp_path, command, capsys):
    write_sequence(tmp_path / "t.igs.mha", {PAIR: POSES}, np.arange(COUNT) / 20)
    out = [str(tmp_path / "o.h5")] if command == ["import"] else []
    assert main([*command, str(tmp_path / "t.igs.mha"), *out]) == 2
    advice = capsys.readouterr().err.split("(")[1].split(")")[0].split()
    assert advice[:2] == ["jaxcal", "import"]
    points = tmp_path / "p.csv"
    lines = [f"{k},{u!r},{v!r}" for k, (u, v) in enumerate(POINTS.tolist())]
    points.write_text("\n".join(["frame,u,v", *lines]))
    took = [str(points), str(tmp_path / "o.h5")]
    assert main(advice[1:-2] + took) == 0


def test_names_without_numbers_are_not_counted(tmp_path, folder):
    table = pose_table(tmp_path / "p.csv", "", lambda k: "")
    for name in folder.glob("*.png"):
        name.rename(folder / f"{name.stem}x.png")
    (tmp_path / "uv.csv").write_text("frame,u,v\n0,1,1\n")
    with pytest.raises(InputError, match=r"uv\.csv:2: frames of .* have no numbers"):
        import_files([folder, tmp_path / "uv.csv"], ImportOptions(poses=table))


def dated(path: Path, first: datetime, seconds, rest: str = "", rows=None) -> Path:
    """A table whose first column is a date."""
    stamps = [(first + timedelta(seconds=float(t))).isoformat() for t in seconds]
    cells = [f"{stamp},{row}" for stamp, row in zip(stamps, rows or [], strict=True)]
    path.write_text("\n".join([f"time,{rest}", *cells]))
    return path


def test_dates_are_matched_with_dates(tmp_path, folder):
    """Tables that begin at different moments; a zone of their own changes nothing."""
    first = datetime(2026, 11, 21, 21, 0, tzinfo=UTC)
    quaternions = Rotation.from_matrix(POSES[:, :3, :3]).as_quat()
    rows = [
        ",".join(repr(float(x)) for x in [*POSES[k, :3, 3], *quaternions[k]]) for k in range(COUNT)
    ]
    poses = dated(tmp_path / "p.csv", first, np.arange(COUNT) / 10, "x,y,z,qx,qy,qz,qw", rows)
    used = range(3, COUNT)
    points = [f"{u!r},{v!r}" for u, v in POINTS[3:].tolist()]
    elsewhere = first.astimezone(timezone(timedelta(hours=2)))
    uv = dated(tmp_path / "uv.csv", elsewhere, np.array(used) / 10 + 0.01, "u,v", points)
    images = import_files([folder, uv], ImportOptions(poses=poses))[0].calibration
    np.testing.assert_allclose(images.poses, POSES[used], atol=1e-9)
    uv = dated(tmp_path / "uv.csv", first.replace(tzinfo=None), np.array(used) / 10, "u,v", points)
    with pytest.raises(InputError, match="give its dates a time zone"):
        import_files([folder, uv], ImportOptions(poses=poses))


# PNG files, which are not trusted.


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "RGB", "RGBA", "I;16"])
def test_png_of_every_kind(tmp_path, mode):
    grey = RNG.integers(0, 256, (12, 17), dtype=np.uint8)
    if mode == "I;16":
        expected = RNG.integers(0, 65536, (12, 17), dtype=np.uint16)
        Image.fromarray(expected).save(tmp_path / "a.png")
    elif mode.startswith("RGB"):
        colours = RNG.integers(0, 256, (12, 17, len(mode)), dtype=np.uint8)
        Image.fromarray(colours).save(tmp_path / "a.png")
        expected = np.rint(colours[:, :, :3] @ [0.299, 0.587, 0.114])
    else:
        expected = 255 * (grey > 127) if mode == "1" else grey
        Image.fromarray(expected.astype(np.uint8)).convert(mode).save(tmp_path / "a.png")
    assert png_size(tmp_path / "a.png") == (17, 12)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), expected)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (png(60_000, 60_000, zlib.compress(bytes(10**6))), "claims"),
        (png(2**31 - 1, 2**31 - 1, b""), "claims|not a PNG"),
        (png(100, 100, zlib.compress(bytes(500))), "is damaged"),
        (png(100, 100, b"x"), "is damaged"),
        (png(9, 9, zlib.compress(bytes(90)))[:44], "damaged"),
        (b"GIF89a" + bytes(100), "is not a PNG file"),
        (b"root:x:0:0", "is not a PNG file"),
    ],
)
def test_png_that_lies(tmp_path, content, message):
    (tmp_path / "a.png").write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(FormatError, match=message):
            read_png(tmp_path / "a.png")


def test_folders_that_lie(tmp_path, folder, capsys):
    table = pose_table(tmp_path / "p.csv", "", lambda k: "")
    arguments = ["import", str(folder), str(tmp_path / "o.h5"), "--poses", str(table)]
    outside = tmp_path / "outside.png"
    outside.write_bytes(encode_png(FRAMES[0]))
    (folder / "b99.png").symlink_to(outside)
    assert main(arguments) == 2
    assert "b99.png: is a link to another folder" in capsys.readouterr().err
    (folder / "b99.png").unlink()
    os.mkfifo(folder / "b99.png")
    assert main(arguments) == 2
    assert "is not an ordinary file" in capsys.readouterr().err
    (folder / "b99.png").unlink()
    (folder / "b99.png").write_bytes(encode_png(FRAMES[0][:50]))
    assert main(arguments) == 2
    assert "b99.png: has 150 x 50 px, b2.png has 150 x 110" in capsys.readouterr().err
    assert not (tmp_path / "o.h5").exists()


# Poses from another file, by time.

MOMENTS = np.arange(200) / 50 + 100.0


def moving(t: np.ndarray) -> np.ndarray:
    """A smooth motion."""
    turns = np.stack([0.5 * np.sin(t), 0.3 * np.cos(1.3 * t), 0.2 * t], axis=1)
    moved = np.stack([50 * np.sin(t), 20 * np.cos(t), 5 * t], axis=1)
    return matrices_from_rotations(Rotation.from_rotvec(turns).as_matrix(), moved)


@pytest.mark.parametrize("kind", ["sequence", "table"])
@pytest.mark.parametrize("lag", [0.0, 0.125])
def test_poses_by_time(tmp_path, kind, lag, capsys):
    times = 100.3 + np.arange(COUNT) * 0.37
    write_sequence(tmp_path / "i.igs.mha", {}, times, images=FRAMES)
    if kind == "sequence":
        poses = tmp_path / "t.igs.mha"
        lost = np.abs(MOMENTS - (times[3] - lag)) > 0.03
        write_sequence(poses, {PAIR: moving(MOMENTS)}, MOMENTS, valid={PAIR: lost})
    else:
        poses = tmp_path / "t.csv"
        rows = [
            ",".join(repr(float(x)) for x in [t, *pose[:3].ravel()])
            for t, pose in zip(MOMENTS, moving(MOMENTS), strict=True)
        ]
        poses.write_text("\n".join([f"time,{MATRIX}", *rows]))
    out = str(tmp_path / "o.h5")
    arguments = ["import", str(tmp_path / "i.igs.mha"), out, "--poses-from", str(poses)]
    assert main([*arguments, "--lag", str(lag)]) == 0
    said = capsys.readouterr().out
    used = [k for k in range(COUNT) if k != HIDDEN and (k != 3 or kind == "table")]
    reason = "no pose at their time: 1 beside a pose whose tracking was not OK"
    assert (f"1 of 9 images have {reason}" in " ".join(said.split())) == (kind == "sequence")
    images = jaxcal.load(out).calibration
    np.testing.assert_allclose(images.time, times[used])
    there = times[used] - lag
    whole = moving(MOMENTS)
    turns = Slerp(MOMENTS, Rotation.from_matrix(whole[:, :3, :3]))(there).as_matrix()
    np.testing.assert_allclose(images.poses[:, :3, :3], turns, atol=1e-9)
    for axis in range(3):
        places = np.interp(there, MOMENTS, whole[:, axis, 3])
        np.testing.assert_allclose(images.poses[:, axis, 3], places, atol=1e-9)


@pytest.mark.parametrize("what", ["poses", "points"])
def test_dates_are_not_matched_with_seconds(tmp_path, what, capsys):
    """The table's first row is not the sequence's first frame."""
    times = 10.0 + np.arange(COUNT) / 10
    write_sequence(tmp_path / "i.igs.mha", {PAIR: POSES}, times)
    first = datetime(2026, 11, 21, 21, 0)
    points = [f"{u!r},{v!r}" for u, v in POINTS.tolist()]
    if what == "points":
        uv = dated(tmp_path / "t.csv", first, np.arange(3, COUNT) / 10, "u,v", points[3:])
        arguments = []
    else:
        uv = tmp_path / "uv.csv"
        uv.write_text("\n".join(["u,v", *points]))
        rows = [",".join(repr(float(x)) for x in pose[:3].ravel()) for pose in moving(MOMENTS)]
        log = dated(tmp_path / "t.csv", first, MOMENTS - 100.1, MATRIX, rows)
        arguments = ["--poses", str(log)]
    out = tmp_path / "o.h5"
    assert main(["import", str(tmp_path / "i.igs.mha"), str(uv), str(out), *arguments]) == 2
    error = capsys.readouterr().err
    assert "t.csv: its times are dates, those of" in error
    assert error.count("\n") == 1
    assert not out.exists()


def tracked(times, poses) -> TrackedSequence:
    good = np.ones(len(times), bool)
    return TrackedSequence({PAIR: poses}, {PAIR: good}, times, ~good, source="t.mha")


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (
            MOMENTS + 1778070000,
            r"poses from 1778070100.000 s to 1778070103.980 s: .* the same clock,",
        ),
        # The images' times would be in ms.
        (100.199 + MOMENTS / 1000, r"1 of \d+ images between poses .*'time \(ms\)'"),
        (MOMENTS[::-1], "is before the one before it"),
        (np.full(200, np.nan), "states no times"),
        (np.full(200, 101.0), "one time stamp"),
        # Every image had a pose that was up to 0.1 s off, without a word.
        (np.round(MOMENTS, 1), "159 of 200 poses have the time stamp of the pose before"),
    ],
)
def test_poses_of_other_times(tmp_path, times, message):
    write_sequence(tmp_path / "i.mha", {}, 100.3 + np.arange(COUNT) * 0.37, images=FRAMES)
    images = read_sequence(tmp_path / "i.mha")
    tracking = tracked(times, moving(MOMENTS))
    with pytest.raises(InputError, match=message):
        with_poses_by_time(images, tracking)


def test_tracking_that_was_never_ok_is_not_blamed_on_the_clocks():
    tracking = tracked(MOMENTS, moving(MOMENTS))
    lost = replace(tracking, valid={PAIR: np.zeros(len(MOMENTS), bool)})
    with pytest.raises(InputError, match="none of its 200 poses has the status OK"):
        with_poses_by_time(tracked(MOMENTS[3:9], POSES[:6]), lost)


def test_of_poses_with_one_time_stamp_the_first_good_one_counts():
    times = np.sort(np.r_[MOMENTS, MOMENTS[50]])
    valid = np.ones(len(times), bool)
    valid[50] = False
    tracking = replace(tracked(times, moving(times)), valid={PAIR: valid})
    track = PoseTrack.of(tracking)
    assert track.valid.all()
    np.testing.assert_array_equal(track.time, MOMENTS)


def test_images_without_a_time_stamp_are_counted():
    times = 100.3 + np.arange(COUNT) * 0.37
    times[2] = np.nan
    tracking = tracked(MOMENTS, moving(MOMENTS))
    with pytest.raises(InputError, match=f"1 of {COUNT} images have no time stamp"):
        with_poses_by_time(tracked(times, POSES), tracking)


@pytest.mark.parametrize(
    ("named", "unit", "every", "length", "refused"),
    [
        ("time", 1e3, 0.02, 7.5, True),
        ("time", 1e3, 0.005, 7.5, True),
        ("time [ms]", 1e3, 0.02, 7.5, False),
        ("time", 1.0, 0.02, 7.5, False),
        # One recording of the tracker, of which the images are a short part.
        ("time", 1.0, 0.04, 800.0, False),
        # As slow as this it might be in ms: the header says that it is not.
        ("time", 1.0, 0.1, 800.0, True),
        ("time [s]", 1.0, 0.1, 800.0, False),
    ],
)
def test_times_of_poses_that_may_be_in_ms(tmp_path, named, unit, every, length, refused):
    """Every image got a pose of the first milliseconds, without a word."""
    images = [np.zeros((4, 4), np.uint8)] * 151
    write_sequence(tmp_path / "i.mha", {}, np.arange(151) / 20, images=images)
    times = np.arange(-0.02, length + 0.02, every)
    rows = [f"{t * unit!r},{t!r},0,0,0,0,0,1" for t in times.tolist()]
    (tmp_path / "t.csv").write_text("\n".join([f"{named},x,y,z,qx,qy,qz,qw", *rows]))
    options = ImportOptions(poses=tmp_path / "t.csv")
    if refused:
        with pytest.raises(
            InputError, match=r"t\.csv: its poses last .* is its time in ms, us or ns\?"
        ):
            open_sequence(tmp_path / "i.mha", options)
        return
    found, _ = open_sequence(tmp_path / "i.mha", options)
    there = found.valid[PAIR]
    assert there.sum() >= 150
    np.testing.assert_allclose(found.transforms[PAIR][there, 0, 3], found.time[there], atol=1e-9)


def test_times_that_only_rounding_puts_beyond_the_poses_have_one(tmp_path):
    times = 100.3 + np.arange(COUNT) * 0.37
    write_sequence(tmp_path / "i.mha", {}, times, images=FRAMES)
    moments = np.linspace(times[0] + 1e-9, times[-1] - 1e-9, 200)
    tracking = tracked(moments, moving(moments))
    found, notes = with_poses_by_time(read_sequence(tmp_path / "i.mha"), tracking)
    assert found.valid[PAIR].all()
    assert len(notes) == 1
    np.testing.assert_allclose(found.transforms[PAIR], moving(times), atol=5e-3)


@pytest.mark.parametrize(("moments", "told"), [(MOMENTS[::40], True), (MOMENTS, False)])
def test_poses_too_rare_for_the_motion_are_told(moments, told):
    """Poses at 1.25 Hz were wrong by millimetres, without a word."""
    times = np.linspace(moments[0], moments[-1], COUNT)
    images, tracking = tracked(times, POSES), tracked(moments, swept(3 * moments))
    _, notes = with_poses_by_time(images, tracking)
    assert len(notes) == 1 + told
    if told:
        assert re.search(r"poses are 0\.8 s apart.* wrong by about \d+\.\d mm", notes[1])


def to_and_fro(t: np.ndarray) -> np.ndarray:
    """An irregular motion, -1 to 1."""
    return (15 * np.sin(1.95 * t) + 7 * np.sin(5.2 * t + 1) + 3 * np.sin(10.7 * t)) / 25


def swept(t: np.ndarray) -> np.ndarray:
    """Poses of a probe that goes to and fro by 40 mm and turns a little."""
    turns = 0.02 * np.stack([np.sin(t), np.cos(1.3 * t), np.sin(0.7 * t)], axis=1)
    moved = [100, 50, 20] + 20 * to_and_fro(t)[:, None] * [0.6, -0.48, 0.64]
    return matrices_from_rotations(Rotation.from_rotvec(turns).as_matrix(), moved)


@pytest.mark.parametrize(
    ("after", "pace", "told"), [(0.0, 1.0, True), (0.3, 1.0, False), (0.0, 0.001, False)]
)
def test_stamps_of_whole_seconds_are_told_where_the_probe_moves(after, pace, told):
    """As files' dates state them. A lag alone was named, which corrects only their mean."""
    log, times = np.arange(0.01, 9.0, 0.02), after + np.arange(1.0, 8.0)
    images = tracked(times, swept(times))
    _, notes = with_poses_by_time(images, tracked(log, swept(pace * log)))
    assert ["are whole seconds" in note for note in notes] == [False] + [True] * told


@pytest.fixture
def lagging(tmp_path):
    """Images that show where the probe was 80 ms before their stamps, and the tracker's log."""
    log = np.arange(0, 7, 0.01)
    write_sequence(tmp_path / "t.igs.mha", {PAIR: swept(log)}, log)
    times = np.arange(0.3, 6.7, 0.1)
    points = [75, 55] + to_and_fro(times - 0.08)[:, None] * [15.0, -35.0]
    points += np.random.default_rng(5).normal(0, 0.5, points.shape)
    write_sequence(tmp_path / "i.igs.mha", {}, times)
    lines = [
        f"{t!r},{u!r},{v!r}" for t, (u, v) in zip(times.tolist(), points.tolist(), strict=True)
    ]
    (tmp_path / "p.csv").write_text("\n".join(["time,u,v", *lines[::-1]]))
    return times, points


@pytest.mark.parametrize("late", [0.0, 0.12, 0.9])
def test_a_lag_that_fits_the_points_better_is_told(tmp_path, late, capsys):
    """Poses that were 0.1 s off were used without a word, and the calibration was called fair."""
    log, times = np.arange(0, 41, 0.1), 2 + 0.9 * np.arange(40)
    poses, target = turning(log), np.array([300.0, -40.0, 80.0])
    seen = np.linalg.inv(turning(times - late)) @ [*target, 1]
    rows = [[t, *pose[:3].ravel()] for t, pose in zip(log, poses, strict=True)]
    lines = [",".join(map(repr, map(float, row))) for row in rows]
    (tmp_path / "t.csv").write_text("\n".join([f"time,{MATRIX}", *lines]))
    points = 500 + 4 * seen[:, :2] + np.random.default_rng(2).normal(0, 1, (40, 2))
    lines = [f"{t},{u},{v}" for t, (u, v) in zip(times, points, strict=True)]
    (tmp_path / "p.csv").write_text("\n".join(["time,u,v", *lines]))
    write_sequence(tmp_path / "i.igs.mha", {}, times)
    images, given, log_table, out = (
        str(tmp_path / name) for name in ("i.igs.mha", "p.csv", "t.csv", "o.h5")
    )
    said = {}
    for name, arguments in {
        "as it is": [images, given, out, "--poses", log_table],
        "stated": [images, given, out, "--poses", log_table, "--lag", str(late)],
        "tables": [log_table, given, out],
        "stated of tables": [log_table, given, out, "--lag", str(late)],
    }.items():
        assert main(["import", *arguments]) == 0
        said[name] = capsys.readouterr().out
    found = {
        name: re.search(r"better at a lag of (\S+) s(.*)", text) for name, text in said.items()
    }
    assert found["stated"] is found["stated of tables"] is None
    if late == 0:
        assert not any(found.values())
    elif late > 0.5:
        assert "where the search ends, than at 0 s" in said["as it is"]
        assert "do images and poses use the same clock?" in said["tables"]
    else:
        assert abs(float(found["as it is"][1]) - late) < 0.01
        for name in ("as it is", "tables"):
            assert f"state it (--lag {found[name][1]})" in said[name]


def turning(t: np.ndarray) -> np.ndarray:
    """Poses that keep a target in front of the probe, which turns and moves in all directions."""
    frequency, phase = np.array([0.9, 1.3, 0.7, 1.1, 1.7, 0.6]), np.arange(6)
    wave = np.sin(t[:, None] * frequency + phase)
    turns = Rotation.from_rotvec(0.5 * wave[:, :3])
    in_probe = [30, 20, 60] + wave[:, 3:] * [20, 15, 0.5]
    return matrices_from_rotations(turns.as_matrix(), [300, -40, 80] - turns.apply(in_probe))


def test_a_lag_is_estimated_from_points(tmp_path, lagging, capsys):
    times, points = lagging
    sources = [str(tmp_path / name) for name in ("i.igs.mha", "p.csv", "o.h5")]
    tracking = ["--poses", str(tmp_path / "t.igs.mha"), "--lag"]
    assert main(["import", *sources, *tracking, "auto"]) == 0
    said = capsys.readouterr().out
    found = re.search(r"images lag by (\S+) s behind poses \(SD (\S+) s\), estimated from 64", said)
    lag, sd = float(found[1]), float(found[2])
    assert abs(lag - 0.08) < 4 * sd < 0.02
    images = jaxcal.load(sources[2]).calibration
    np.testing.assert_allclose(images.poses, swept(times - 0.08), atol=0.15)
    np.testing.assert_allclose(images.measurements, points)
    assert main(["import", *sources, *tracking, "nan"]) == 2
    assert "neither a number of seconds nor auto" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["sequence", "table"])
def test_a_lag_of_images_that_have_poses_of_their_own(tmp_path, kind, capsys):
    """Poses in the same file were taken as they stood, and no lag could be stated."""
    times = 2 + 0.1 * np.arange(60)
    seen = np.linalg.inv(turning(times - 0.12)) @ [300.0, -40.0, 80.0, 1]
    points = 500 + 4 * seen[:, :2] + np.random.default_rng(2).normal(0, 1, (60, 2))
    path = tmp_path / "o.h5"
    if kind == "table":
        rows = [times, *turning(times)[:, :3].reshape(60, 12).T, *points.T]
        lines = [",".join(map(repr, map(float, row))) for row in np.column_stack(rows)]
        (tmp_path / "t.csv").write_text("\n".join([f"time,{MATRIX},u,v", *lines]))
        assert main(["import", str(tmp_path / "t.csv"), str(path)]) == 0
        lag = 0.0
    else:
        write_sequence(tmp_path / "i.igs.mha", {PAIR: turning(times)}, times)
        lines = [f"{k},{u},{v}" for k, (u, v) in enumerate(points)]
        (tmp_path / "p.csv").write_text("\n".join(["frame,u,v", *lines]))
        sources = [str(tmp_path / name) for name in ("i.igs.mha", "p.csv")]
        assert main(["import", *sources, str(path)]) == 0
        lag = float(re.search(r"better at a lag of (\S+) s", capsys.readouterr().out)[1])
        assert lag == pytest.approx(0.12, abs=0.01)
        path.unlink()
        assert main(["import", *sources, str(path), "--lag", "auto"]) == 0
        lag = float(re.search(r"images lag by (\S+) s", capsys.readouterr().out)[1])
        assert lag == pytest.approx(0.12, abs=0.01)
    images = jaxcal.load(path).calibration
    at = images.time - lag
    # Interpolated between poses 0.1 s apart.
    assert np.abs(images.poses[:, :3, 3] - turning(at)[:, :3, 3]).max() < 0.5
    step = 1e-4
    change = np.linalg.inv(turning(at - step)) @ turning(at + step) / (2 * step)
    v, omega = change[:, :3, 3], change[:, [2, 0, 1], [1, 2, 0]]
    known = np.isfinite(images.velocity).all(axis=1)
    assert known.sum() >= len(at) - 4
    scale = np.abs(v).max(), np.abs(omega).max()
    assert np.abs(images.velocity[known, :3] - v[known]).max() < 0.1 * scale[0]
    assert np.abs(images.velocity[known, 3:] - omega[known]).max() < 0.1 * scale[1]


def test_times_that_go_back_are_told_to_be_those_of_the_poses(tmp_path, lagging):
    """--ignore-time was said to import without times, but poses had been looked up by them."""
    times, points = lagging
    write_sequence(tmp_path / "i.igs.mha", {}, np.where(times > 3, times - 2.05, times))
    lines = [f"{k},{u!r},{v!r}" for k, (u, v) in enumerate(points.tolist())]
    (tmp_path / "p.csv").write_text("\n".join(["frame,u,v", *lines]))
    sources = [tmp_path / "i.igs.mha", tmp_path / "p.csv"]
    options = ImportOptions(poses=tmp_path / "t.igs.mha")
    with pytest.raises(InputError, match="--ignore-time imports images with poses at such times"):
        import_files(sources, options)
    _, notes, *_ = import_files(sources, replace(options, ignore_time=True))
    assert "if times are wrong, poses are, too" in notes[-1]


def test_a_lag_is_estimated_from_frames(tmp_path, lagging):
    times, points = lagging[0][::2], lagging[1][::2]
    frames = [speckle(RNG, *point) for point in points]
    write_sequence(tmp_path / "f.igs.mha", {}, times, images=frames)
    options = ImportOptions(poses=tmp_path / "t.igs.mha", lag_s="auto")
    recording, notes, results, _ = import_files([tmp_path / "f.igs.mha"], options)
    assert float(re.search(r"images lag by (\S+) s", "".join(notes))[1]) == pytest.approx(
        0.08, abs=0.004
    )
    found = results.found
    assert len(found) > 28
    np.testing.assert_allclose(recording.calibration.poses, swept(times[found] - 0.08), atol=0.3)


def test_lags_that_cannot_be_estimated(tmp_path, lagging, folder, capsys):
    tracking = str(tmp_path / "t.igs.mha")
    images, points, out = (str(tmp_path / name) for name in ("i.igs.mha", "p.csv", "o.h5"))
    table = str(pose_table(tmp_path / "poses.csv", "", lambda k: ""))
    still = str(tmp_path / "still.igs.mha")
    log = np.arange(0, 7, 0.01)
    write_sequence(still, {PAIR: np.tile(POSES[0], (len(log), 1, 1))}, log)
    for arguments, message in (
        (
            [images, points, out, "--poses", still],
            "--lag auto: the images do not tell the lag: it is",
        ),
        ([images, points, out], "holds no transforms: name the file with its poses (--poses)"),
        ([points, out], "--lag is for poses that are matched to images by their times"),
        ([str(folder), out], "--lag needs --poses: a folder of images has no poses"),
        ([str(folder), out, "--poses", table], "--lag is for poses that are matched by time"),
    ):
        assert main(["import", *arguments, "--lag", "auto"]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert main(["pick", images, "--skip-invalid"]) == 2
    assert "--skip-invalid is for tables, but no table is read" in capsys.readouterr().err
    assert main(["pick", images, "--poses", tracking, "--lag", "auto"]) == 2
    assert "it is an option of jaxcal import" in capsys.readouterr().err
    assert not (tmp_path / "o.h5").exists()


def test_real_images_and_tracking_in_two_files(tmp_path, real_data):
    """PLUS's temporal calibration: poses of the one file at the times of the other."""
    video = real_data / "plus" / "WaterTankBottomTranslationVideoBuffer.igs.mha"
    tracker = real_data / "plus" / "WaterTankBottomTranslationTrackerBuffer.igs.mha"
    frames, tracked = read_sequence(video), read_sequence(tracker)
    pair = next(iter(tracked.transforms))
    (tmp_path / "p.csv").write_text(
        "\n".join(["frame,u,v", *(f"{k},{k}.5,{k}.25" for k in range(0, len(frames), 7))])
    )
    options = ImportOptions(poses=tracker, source=pair[0], target=pair[1], ignore_time=True)
    recording, notes, *_ = import_files([video, tmp_path / "p.csv"], options)
    poses, valid = tracked.poses(*pair)
    times = recording.calibration.time
    assert times is not None
    assert len(times) > 10
    assert valid.sum() > 100
    places = np.interp(times, tracked.time[valid], poses[valid, 0, 3])
    np.testing.assert_allclose(recording.calibration.poses[:, 0, 3], places, atol=0.05)
    assert any("at the images' times" in note for note in notes)


def test_the_lag_of_real_images_is_that_of_plus(tmp_path, real_data):
    """Of a probe that is moved up and down over a tank's bottom, by PLUS's own estimate."""
    folder = real_data / "plus"
    video = folder / "WaterTankBottomTranslationVideoBuffer.igs.mha"
    text = (folder / "TemporalCalibrationResultsBaseline.xml").read_text()
    (of_tracker,) = re.findall(r'TrackerLagSec="(\S+)"', text)
    rows = []
    frames = range(0, 201, 2)
    for image in read_sequence(video).images(frames):
        profile = image[:, 370:450].mean(axis=1)
        top = 60 + int(np.argmax(profile[60:]))
        near = np.arange(top - 6, top + 7)
        rows.append(near @ profile[near] / profile[near].sum())
    lines = [f"{frame},410,{row!r}" for frame, row in zip(frames, map(float, rows), strict=True)]
    (tmp_path / "p.csv").write_text("\n".join(["frame,u,v", *lines]))
    options = ImportOptions(
        poses=folder / "WaterTankBottomTranslationTrackerBuffer.igs.mha",
        source="Probe", target="Reference", lag_s="auto",
    )  # fmt: skip
    _, notes, *_ = import_files([video, tmp_path / "p.csv"], options)
    found = re.search(r"images lag by (\S+) s behind poses \(SD (\S+) s\)", "".join(notes))
    assert abs(float(found[1]) + float(of_tracker)) < 0.005
    assert float(found[2]) < 0.015


# DICOM.


def dicom_clip(path: Path, regions, size=(COLUMNS, ROWS), change=None) -> Path:
    """A clip as an ultrasound machine writes it, small."""
    pydicom = pytest.importorskip("pydicom", reason="pydicom is not installed (jaxcal[dicom])")
    from pydicom.dataset import Dataset, FileMetaDataset

    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    data.file_meta.MediaStorageSOPClassUID = pydicom.uid.UltrasoundMultiFrameImageStorage
    data.file_meta.MediaStorageSOPInstanceUID = "1.2.3"
    data.SOPClassUID, data.SOPInstanceUID = data.file_meta.MediaStorageSOPClassUID, "1.2.3"
    data.Columns, data.Rows = size
    data.SequenceOfUltrasoundRegions = []
    for given in regions:
        item = Dataset()
        values = {
            "RegionSpatialFormat": 1, "RegionDataType": 1, "RegionFlags": 0,
            "RegionLocationMinX0": 10, "RegionLocationMinY0": 5,
            "RegionLocationMaxX1": 99, "RegionLocationMaxY1": 80,
            "PhysicalUnitsXDirection": 3, "PhysicalUnitsYDirection": 3,
            "PhysicalDeltaX": 0.02, "PhysicalDeltaY": 0.015,
        } | given  # fmt: skip
        for name, value in values.items():
            setattr(item, name, value)
        data.SequenceOfUltrasoundRegions.append(item)
    if change is not None:
        change(data)
    data.save_as(path, enforce_file_format=True)
    return path


def test_pixel_size_from_dicom(tmp_path, capsys):
    clip = dicom_clip(tmp_path / "c.dcm", [{}, {"RegionSpatialFormat": 3, "PhysicalDeltaX": 9.0}])
    found = read_pixel_size(clip)
    assert found.spacing_mm == (0.2, 0.15)
    assert (found.columns, found.rows, found.region) == (COLUMNS, ROWS, (10, 5, 90, 76))
    path = tmp_path / "f.igs.mha"
    write_sequence(path, {PAIR: POSES}, np.arange(COUNT) / 20, images=FRAMES)
    assert main(["segment", str(path), "--spacing-from", str(clip)]) == 0
    assert "calibrate with --estimate" not in capsys.readouterr().out
    images = jaxcal.load(tmp_path / "f-segmented.h5").calibration
    np.testing.assert_array_equal(images.spacing_mm, [0.2, 0.15])
    other = dicom_clip(tmp_path / "d.dcm", [{}], size=(640, 480))
    assert main(["segment", str(path), "--spacing-from", str(other)]) == 2
    assert "its images are 640 x 480 px, the frames 150 x 110" in capsys.readouterr().err
    arguments = ["--spacing-from", str(clip), "--spacing", "1", "1"]
    assert main(["segment", str(path), *arguments]) == 2
    assert "either --spacing or --spacing-from" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("regions", "message"),
    [
        ([], "states no pixel size"),
        ([{"RegionSpatialFormat": 2}], "states no pixel size"),
        ([{"PhysicalUnitsXDirection": 4}], r"codes \[4, 3\], not cm"),
        ([{"PhysicalDeltaX": 0.0}], "0 mm is not plausible"),
        ([{"PhysicalDeltaX": 2.0}], "20 mm is not plausible"),
        ([{}, {"PhysicalDeltaY": 0.03}], "regions with different pixel sizes"),
    ],
)
def test_dicom_without_a_pixel_size(tmp_path, regions, message):
    with pytest.raises(FormatError, match=message):
        read_pixel_size(dicom_clip(tmp_path / "c.dcm", regions))


def test_dicom_that_lies(tmp_path):
    clip = dicom_clip(tmp_path / "c.dcm", [{}])
    good = clip.read_bytes()
    rng = np.random.default_rng(0)
    for trial in range(60):
        content = bytearray(good)
        for place in rng.integers(132, len(good), 3):
            content[place] = rng.integers(256)
        clip.write_bytes(bytes(content) if trial % 3 else bytes(content[: rng.integers(len(good))]))
        told = ""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = read_pixel_size(clip)
                assert min(found.spacing_mm) > 0
                assert None not in (found.columns, found.rows)
            except FormatError as error:
                told = str(error)
        assert not told or told.startswith(str(clip))
    clip.write_bytes(good.replace(b"1.2.840.10008.1.2.1\0", b"1.2.840.10008.1.2.1.99\0"))
    with pytest.raises(FormatError):
        read_pixel_size(clip)
    without = dicom_clip(tmp_path / "d.dcm", [{}], change=lambda data: data.pop("Rows"))
    with pytest.raises(FormatError, match="does not say how large its images are"):
        read_pixel_size(without)
    clip.write_bytes(b"root:x:0:0")
    with pytest.raises(FormatError, match="is not a DICOM file"):
        read_pixel_size(clip)


def test_the_extra_is_named(tmp_path, monkeypatch):
    import sys

    (tmp_path / "c.dcm").write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "pydicom", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'jaxcal\[dicom\]'"):
        read_pixel_size(tmp_path / "c.dcm")
