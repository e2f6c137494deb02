"""From other programs' files to a recording, and the whole way to a configuration of PLUS."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import REAL_DATA, random_poses
from scipy import stats
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import FormatError, InputError
from jaxcal.cli.main import main
from jaxcal.data.recording import Recording, joined
from jaxcal.io import slicer
from jaxcal.io.columns import columns_of_header
from jaxcal.io.importing.files import import_files
from jaxcal.io.importing.sources import ImportOptions
from jaxcal.io.sequence_files import read_sequence, write_sequence
from jaxcal.io.slicer import read_markups
from jaxcal.io.trackers import read_tracker

PROBE, REFERENCE = ("Probe", "Tracker"), ("Reference", "Tracker")


POSES = random_poses(6)
PIXELS = np.random.default_rng(1).uniform(50, 500, (6, 2))
QUATERNIONS = Rotation.from_matrix(POSES[:, :3, :3]).as_quat()
TRANSLATIONS = POSES[:, :3, 3]


def table(names, columns, separator=",", comma=False):
    lines = [] if names is None else [separator.join(names)]
    for row in np.column_stack(columns).tolist():
        cells = [repr(value) for value in row]
        lines.append(separator.join(cell.replace(".", ",") if comma else cell for cell in cells))
    return lines


def imported(tmp_path, lines, **options):
    """What comes of a table with these lines."""
    (tmp_path / "t.csv").write_text("\n".join(lines))
    return import_files([tmp_path / "t.csv"], ImportOptions(**options))


NAMES = ["u", "v", "x", "y", "z", "qx", "qy", "qz", "qw"]
COLUMNS = [PIXELS, TRANSLATIONS, QUATERNIONS]
SCALAR_FIRST = [PIXELS, TRANSLATIONS, QUATERNIONS[:, [3, 0, 1, 2]]]
MATRIX = [f"m{i}{j}" for i in range(1, 4) for j in range(1, 5)]


@pytest.mark.parametrize(
    "lines",
    [
        table(NAMES, COLUMNS),
        table(["v", "u", *NAMES[2:]], [PIXELS[:, ::-1], TRANSLATIONS, QUATERNIONS]),
        table(["", *NAMES], [np.arange(6), *COLUMNS]),
        table(NAMES, COLUMNS, ";", comma=True),
        table(NAMES, COLUMNS, "\t"),
        ["sep=;", *table(NAMES, COLUMNS, ";", comma=True)],
        ['"sep=;"', *table(NAMES, COLUMNS, ";")],
        [f"{line};;" for line in table(NAMES, COLUMNS, ";")],
        [line + "," * (k > 0) for k, line in enumerate(table(NAMES, COLUMNS))],
        table(NAMES, COLUMNS, " "),
        table(["U [px]", "V [px]", "Tx (mm)", "Ty (mm)", "Tz (mm)", *NAMES[5:]], COLUMNS),
        table(["u_px", "v_px", "tx_m", "ty_m", "tz_m", *NAMES[5:]],
              [PIXELS, TRANSLATIONS / 1e3, QUATERNIONS]),
        table([*NAMES[:2], "x [in]", "y (inches)", "z_in", *NAMES[5:]],
              [PIXELS, TRANSLATIONS / 25.4, QUATERNIONS]),
        table([*NAMES[:5], "q0", "qx", "qy", "qz"], SCALAR_FIRST),
        table([*NAMES[:2], "position.x", "position.y", "position.z", "orientation.x",
               "orientation.y", "orientation.z", "orientation.w"], COLUMNS),
        table([*NAMES[:5], "w", "qx", "qy", "qz"], SCALAR_FIRST),
        table([*MATRIX, "u", "v"], [POSES[:, :3].reshape(6, 12), PIXELS]),
        table(["u", "v", *(f"p{k}" for k in range(16))], [PIXELS, POSES.reshape(6, 16)]),
        table(["u", "v", *(f"r{i}{j}" for i in range(1, 4) for j in range(1, 4)), "x", "y", "z"],
              [PIXELS, POSES[:, :3, :3].reshape(6, 9), TRANSLATIONS]),
        ["# a comment", "", *table([*NAMES, "name"], COLUMNS)[:1],
         *(f"{line},image.png" for line in table(None, COLUMNS))],
        table(['"u"', *NAMES[1:]], COLUMNS),
    ],
)  # fmt: skip
def test_headers_are_read(tmp_path, lines):
    recording, notes, *_ = imported(tmp_path, lines)
    images = recording.calibration
    np.testing.assert_allclose(images.poses, POSES, atol=1e-11)
    np.testing.assert_allclose(images.measurements, PIXELS, rtol=1e-14)
    assert (images.kind, notes) == ("pixel", [])


def test_times_of_every_kind(tmp_path):
    for name, stamps, expected in (
        ("time [ms]", [0.5, 1, 2, 4, 8, 9], np.array([0.5, 1, 2, 4, 8, 9]) / 1e3),
        ("seconds", [0.5, 1, 2, 4, 8, 9], np.array([0.5, 1, 2, 4, 8, 9])),
        ("stamp_ns", [10**18 + 10**9 * k for k in range(6)], 1e9 + np.arange(6)),
        ("Timestamp", [f"2026-11-21T21:00:0{k}.5" for k in range(6)], np.arange(6.0)),
    ):
        rows = zip([name, *stamps], table(NAMES, COLUMNS), strict=True)
        found = imported(tmp_path, [f"{first},{row}" for first, row in rows])[0].calibration.time
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("letter", ["u", "\u00b5", "\u03bc"])
def test_microseconds_as_they_are_written(letter):
    """Of the two letters that look alike, the Greek one was refused."""
    assert columns_of_header([f"time [{letter}s]", "u", "v"], None).time_s == 1e-6


def test_quaternion_order_is_asked_for(tmp_path):
    numbered = table([*NAMES[:5], "q1", "q2", "q3", "q4"], COLUMNS)
    bare = table(None, [np.arange(6), TRANSLATIONS, QUATERNIONS, PIXELS])
    for lines in (numbered, bare):
        with pytest.raises(FormatError, match="--quaternion wxyz or xyzw"):
            imported(tmp_path, lines)
        found = imported(tmp_path, lines, quaternion="xyzw")[0].calibration
        np.testing.assert_allclose(found.poses, POSES, atol=1e-11)
        other = imported(tmp_path, lines, quaternion="wxyz")[0].calibration
        expected = Rotation.from_quat(QUATERNIONS[:, [1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(other.poses[:, :3, :3], expected, atol=1e-12)


def test_the_numbers_of_quaternions_columns_count_and_not_their_order(tmp_path):
    mixed = table([*NAMES[:5], "q1", "q2", "q3", "q0"], COLUMNS)
    found = imported(tmp_path, mixed, quaternion="wxyz")[0].calibration
    np.testing.assert_allclose(found.poses, POSES, atol=1e-11)
    for numbers in ("1111", "0114", "0124"):
        named = table([*NAMES[:5], *(f"q{number}" for number in numbers)], COLUMNS)
        with pytest.raises(FormatError, match="must be numbered q0 to q3, or q1 to q4"):
            imported(tmp_path, named, quaternion="wxyz")


def test_an_order_that_contradicts_the_header_is_refused(tmp_path):
    last = table(NAMES, COLUMNS)
    named = imported(tmp_path, last, quaternion="xyzw")[0].calibration
    np.testing.assert_allclose(named.poses, POSES, atol=1e-11)
    with pytest.raises(FormatError, match="numbers are x y z w, and --quaternion says wxyz"):
        imported(tmp_path, last, quaternion="wxyz")
    first = table([*NAMES[:5], "qw", "qx", "qy", "qz"], SCALAR_FIRST)
    named = imported(tmp_path, first, quaternion="wxyz")[0].calibration
    np.testing.assert_allclose(named.poses, POSES, atol=1e-11)


def test_the_poses_of_a_pair_may_be_in_metres(tmp_path):
    def pair(factor):
        poses = POSES[:, :3].copy()
        poses[:, :, 3] *= factor
        rows = [" ".join(map(repr, row)) for row in poses.reshape(-1, 4).tolist()]
        (tmp_path / "poses.txt").write_text("\n".join(rows) + "\n")
        return [tmp_path / "poses.txt", tmp_path / "points.txt"]

    (tmp_path / "points.txt").write_text("".join(f"{u} {v}\n" for u, v in PIXELS.tolist()))
    with pytest.raises(InputError, match=r"look like metres.*--pose-units m"):
        import_files(pair(1e-3))
    images = import_files(pair(1e-3), ImportOptions(pose_units="m"))[0].calibration
    np.testing.assert_allclose(images.poses, POSES, atol=1e-11)
    images = import_files(pair(1 / 25.4), ImportOptions(pose_units="in"))[0].calibration
    np.testing.assert_allclose(images.poses, POSES, atol=1e-11)
    with pytest.raises(InputError, match="--quaternion does not go with a pair"):
        import_files(pair(1.0), ImportOptions(quaternion="wxyz"))


def test_invalid_rows_are_counted(tmp_path):
    lines = table([*NAMES, "status"], [*COLUMNS, np.ones(6)])
    more = [lines[1].replace(",1.0", ",OUT_OF_VIEW"), "# a comment, not a row"]
    # The last two are what spreadsheets leave of a formula that failed.
    more += [cell + lines[2][lines[2].index(",") :] for cell in ("nan", "#N/A", "#NAME?")]
    with pytest.raises(FormatError, match=r"t\.csv:8: the row is marked as invalid"):
        imported(tmp_path, [*lines, *more])
    recording, notes, *_ = imported(tmp_path, [*lines, *more], skip_invalid=True)
    assert len(recording) == 6
    left_out = "4 invalid rows left out (6 to 9, counted from 0)"
    assert notes == [f"{tmp_path / 't.csv'}: {left_out}"]
    assert recording.calibration.frame is None
    # Images are told by their rows where rows are missing among them.
    recording, *_ = imported(tmp_path, [lines[0], more[0], *lines[1:]], skip_invalid=True)
    np.testing.assert_array_equal(recording.calibration.frame, np.arange(1, 7))


@pytest.mark.parametrize("number", ["0", "-3.697314E28"])
def test_a_pose_of_zeros_or_of_ndi_s_mark_is_that_of_a_tool_not_seen(tmp_path, number):
    lines = table(NAMES, COLUMNS)
    cells = lines[3].split(",")
    lost = ",".join([*cells[:2], *[number] * (len(cells) - 2)])
    with pytest.raises(FormatError, match=r"t\.csv:8: the rotation is all zeros.*--skip-invalid"):
        imported(tmp_path, [*lines, lost])
    assert len(imported(tmp_path, [*lines, lost], skip_invalid=True).recording) == 6


def test_empty_rows_at_the_end_do_not_count(tmp_path):
    lines = table(NAMES, COLUMNS)
    recording, notes, *_ = imported(tmp_path, [*lines, ",,,,,,,,", ",,,", ""])
    assert (len(recording), notes) == (6, [])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["u", "v", "foo", *NAMES[3:]], "column 3, 'foo', is not known"),
        (
            ["u", "v", "err [deg]", "marker1", *NAMES[3:], "gain"],
            "columns 3 ('err [deg]'), 4 ('marker1') and 11 ('gain') are not known",
        ),
        (["u", "v", *MATRIX, "marker1"], "column 15, 'marker1', is not known"),
        (["u", "v", "x", "y", "z", "rx", "ry", "rz"], "column 6, 'rx': rotation vectors"),
        (["u", "v", "x", "y", "z", "roll [deg]"], "column 6, 'roll [deg]': rotation vectors"),
        (["actual_TCP_pose_0", "u", "v"], "convert them to quaternions (docs/how-to/robot.md"),
        (["u", "u", *NAMES[2:]], "columns 1 and 2 are both u"),
        (["u", "row", "x", "y", "tz", "qx", "qy", "qz", "qz"], "columns 8 and 9 are both qz"),
        (["u", "time", *NAMES[2:]], "has u but not all of u and v"),
        (
            ["u", "v", "x [mm]", "y [m]", "z [mm]", *NAMES[5:]],
            "translations are in different units",
        ),
        (["u [px]", "v [mm]", *NAMES[2:]], "different units"),
        ([*MATRIX, "x", "y", "z"], "both a whole matrix and x, y, z"),
        ([*MATRIX, "qx", "qy", "qz", "qw"], "both a matrix and a quaternion"),
        (["u", "v", "x [ft]", *NAMES[3:]], "unit of 'x [ft]' is not known"),
        (["u", "v", "x", "y", "z", "qx", "qy", "qz", "frame"], "not all of qx, qy, qz and qw"),
    ],
)
def test_headers_that_are_refused(names, message):
    with pytest.raises(FormatError, match=re.escape(message)):
        columns_of_header(names, None)


def test_times_of_a_moving_probe_that_may_be_ms_are_named(tmp_path):
    poses = np.tile(np.eye(4), (30, 1, 1))
    for name, step_s, moving, doubt in [
        ("time", 40.0, True, True),
        ("time", 0.04, True, False),
        ("time [ms]", 40.0, True, False),
        ("time", 40.0, False, False),
    ]:
        way = np.arange(30.0) if moving else np.random.default_rng(1).permutation(30) * 1.0
        poses[:, 0, 3] = 100.0 + way
        columns = [step_s * np.arange(30), poses[:, :3].reshape(-1, 12), np.full((30, 2), 50.0)]
        notes = imported(tmp_path, table([name, *MATRIX, "u", "v"], columns))[1]
        assert ["in ms, us or ns?" in note for note in notes] == [True] * doubt


@pytest.mark.parametrize("prefix", ["r", "rot_"])
def test_four_numbers_of_a_rotation_are_a_quaternion(prefix):
    names = [*NAMES[:5], *(prefix + axis for axis in "wxyz")]
    assert columns_of_header(names, None).quaternion == (6, 7, 8, 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row.replace(",", ",nan,", 1).rsplit(",", 1)[0],
         ":4: column 2 ('v') is nan: leave such rows out with --skip-invalid"),
        (lambda row: row[row.index(",") :], ":4: column 1 ('u') is empty: leave such rows out"),
        (lambda row: row + ",1", ":4: 10 columns, the header has 9"),
        (lambda row: row.replace(".", ","), "by commas; decimal commas need semicolons between"),
        (lambda row: row.rsplit(",", 1)[0] + ",0.5e9", ": quaternion in line 4 has length"),
        (lambda row: row.replace(",", ",x", 1), ":4: column 2 ('v') is not a number"),
    ],
)  # fmt: skip
def test_rows_that_are_refused(tmp_path, change, message):
    rows = table(NAMES, COLUMNS)
    with pytest.raises(InputError, match=re.escape(message)):
        imported(tmp_path, [*rows[:3], change(rows[3])])


def test_a_title_above_the_header_is_named(tmp_path):
    with pytest.raises(InputError, match=r":2: .* must be the first line, without a title"):
        imported(tmp_path, ["Recording of Monday", *table(NAMES, COLUMNS)])


def test_times_that_go_back(tmp_path):
    lines = table(["time", *NAMES], [[0.0, 1, 2, 2, 3, 1], *COLUMNS])
    with pytest.raises(InputError, match=r"t\.csv:5: the time stamp is not later than the one be"):
        imported(tmp_path, lines)
    recording, notes, *_ = imported(tmp_path, lines, ignore_time=True)
    assert recording.calibration.time is None
    assert "not kept" in notes[0]
    lines[3] = lines[3][lines[3].index(",") :]
    recording, notes, *_ = imported(tmp_path, lines, ignore_time=True)
    assert (len(recording), recording.calibration.time) == (6, None)
    assert notes == ["time stamps are missing or cannot be read: not kept"]


def test_ignoring_bad_times_keeps_good_ones(tmp_path):
    """Those of a table like those of a sequence."""
    lines = table(["time", *NAMES], [np.arange(6.0), *COLUMNS])
    recording, notes, *_ = imported(tmp_path, lines, ignore_time=True)
    np.testing.assert_array_equal(recording.calibration.time, np.arange(6.0))
    assert notes == []


def test_times_in_another_unit_than_seconds(tmp_path):
    lines = table(["time", *NAMES], [1.7e18 + 1e9 * np.arange(6), *COLUMNS])
    with pytest.raises(FormatError, match=r"t\.csv:2: column 1 \('time'\) is 1\.7e\+18 s.*\[ns\]"):
        imported(tmp_path, lines)


# Trackers' exports. The lines are those of real files, shortened.

NDI = """\
Tools,Port 0x01: JJH Probe  s/n:3E4C880C,Frame,Time [sec],Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,Markers,State,Tx,Ty,Tz,Port 0x02: Ref,Frame,Time [sec],Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,Markers,State,Tx,Ty,Tz
3,Port 0x01: JJH Probe  s/n:3E4C880C,650512279,1778067471.318767388,1,OK,0.5973400,0.4357213,0.5083389,0.4415014,-42.126,-236.320,-1655.290,0.2372032,3,OK,-54.047,1,2,Port 0x02: Ref,1,1778067471.3,1,OK,1,0,0,0,1,2,3,0.1,3,OK,4,5,6
3,Port 0x01: JJH Probe  s/n:3E4C880C,650537443,1778067890.718813102,1,Too Few Markers,-3.697314E28,-3.697314E28,-3.697314E28,-3.697314E28,-3.697314E28,-3.697314E28,-3.697314E28,-3.697314E28,0,Missing,,,,Port 0x02: Ref,1,1778067890.7,1,Missing,,,,,,,,,0,Missing,,,
"""  # noqa: E501
OLD_NDI = """\
Tools,Port 1,Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error
1,Port 1,7,0,OK,0.5973400,0.4357213,0.5083389,0.4415014,-42.126,-236.320,-1655.290,0.2
"""
MOTIVE = """\
Format Version,1.23,Take Name,t,Export Frame Rate,120.000000,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body Marker
,Name,Probe,Probe,Probe,Probe,Probe,Probe,Probe,Probe,Probe:M1
,ID,1,1,1,1,1,1,1,1,2
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X
0,0.000000,0.4357213,0.5083389,0.4415014,0.5973400,-0.042126,-0.236320,-1.655290,0.0002,1
1,0.008333,,,,,,,,,
"""  # noqa: E501


def test_trackers_exports(tmp_path):
    expected = Rotation.from_quat([0.4357213, 0.5083389, 0.4415014, 0.5973400]).as_matrix()
    for text, tool, time in (
        (NDI, "JJH Probe", 1778067471.318767388),
        (OLD_NDI, "Port 1", np.nan),
        (MOTIVE, "Probe", 0.0),
    ):
        (tmp_path / "t.csv").write_text(text)
        found = read_tracker(tmp_path / "t.csv")
        pose = found.transforms[tool, "Tracker"][0]
        np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-6)
        np.testing.assert_allclose(pose[:3, 3], [-42.126, -236.32, -1655.29], atol=1e-9)
        np.testing.assert_equal(found.time[0], time)
        np.testing.assert_array_equal(found.valid[tool, "Tracker"], [True, False][: len(found)])
    (tmp_path / "t.csv").write_text(MOTIVE.replace("Quaternion", "XYZ"))
    with pytest.raises(FormatError, match="export quaternions from Motive"):
        read_tracker(tmp_path / "t.csv")
    (tmp_path / "t.csv").write_text(MOTIVE.replace("Meters", "Furlongs"))
    with pytest.raises(FormatError, match="Length Units 'furlongs' are not known"):
        read_tracker(tmp_path / "t.csv")
    (tmp_path / "t.csv").write_text(MOTIVE.replace("Name,t,", "Name,left, slowly,", 1))
    assert len(read_tracker(tmp_path / "t.csv")) == 2
    for text in (MOTIVE, OLD_NDI):
        (tmp_path / "t.csv").write_text(text.replace(",", ";"))
        with pytest.raises(FormatError, match="import the original file of the tracker's program"):
            import_files([tmp_path / "t.csv"])
    (tmp_path / "t.csv").write_text(NDI.replace("0.5973400", "0.59x"))
    with pytest.raises(FormatError, match=r":2: column 7 is not a number: '0\.59x'"):
        read_tracker(tmp_path / "t.csv")


POSE_NAMES, POSE_COLUMNS = NAMES[2:], [TRANSLATIONS, QUATERNIONS]
TWO_TABLES = {
    "frames": (["frame"], [10 * np.arange(6.0)], [10 * np.arange(6.0)]),
    "times": (["time [s]"], [np.arange(6.0)], [np.arange(6.0)]),
    "order": ([], [], []),
}


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("key", TWO_TABLES)
def test_poses_and_points_in_two_tables(tmp_path, key, reverse):
    """The rows of the points are exchanged, except where only their order tells which is which."""
    names, of_poses, of_points = TWO_TABLES[key]
    order = np.arange(6) if key == "order" else np.array([4, 0, 1, 5, 3, 2])
    order = np.sort(order) if key == "times" else order
    (tmp_path / "poses.csv").write_text(
        "\n".join(table([*names, *POSE_NAMES], [*of_poses, *POSE_COLUMNS]))
    )
    points = [*(column[order] for column in of_points), PIXELS[order]]
    (tmp_path / "points.csv").write_text("\n".join(table([*names, "u", "v"], points)))
    files = [tmp_path / "poses.csv", tmp_path / "points.csv"]
    images = import_files(files[::-1] if reverse else files).recording.calibration
    np.testing.assert_allclose(images.poses, POSES[order], atol=1e-12)
    np.testing.assert_array_equal(images.measurements, PIXELS[order])
    if key == "frames":
        np.testing.assert_array_equal(images.frame, 10 * order)
    # Without numbers of frames, rows of the table of points count.
    numbers = (0, 20, 30, 40, 50) if key == "frames" else (0, 2, 3, 4, 5)
    found = import_files(files, ImportOptions(frames=numbers))
    used = order != 1 if key == "frames" else np.arange(6) != 1
    np.testing.assert_allclose(found.recording.calibration.poses, POSES[order[used]], atol=1e-12)
    np.testing.assert_array_equal(found.recording.calibration.measurements, PIXELS[order[used]])
    kept = 10 * order[used] if key == "frames" else np.flatnonzero(used)
    np.testing.assert_array_equal(found.recording.calibration.frame, kept)
    assert found.notes[-1].endswith("are used")
    assert found.most_lost is False


def test_only_some_rows_of_a_table(tmp_path):
    """The first of two recordings in one file, whose times begin again in the second."""
    path = tmp_path / "t.csv"
    path.write_text("\n".join(table(["time", *NAMES], [[0, 1, 2, 3, 0, 1], *COLUMNS])))
    recording, notes, *_ = import_files([path], ImportOptions(frames=(0, 1, 2, 3)))
    np.testing.assert_allclose(recording.calibration.poses, POSES[:4], atol=1e-12)
    np.testing.assert_array_equal(recording.calibration.time, [0, 1, 2, 3])
    assert notes == [f"only frames 0 to 3 of {path} are used"]
    with pytest.raises(InputError, match=r"t\.csv: has frames 0 to 5, none of --frames 7 to 9"):
        import_files([path], ImportOptions(frames=(7, 8, 9)))
    pair = tmp_path / "poses.txt", tmp_path / "points.txt"
    np.savetxt(pair[0], POSES.reshape(-1, 16))
    np.savetxt(pair[1], PIXELS)
    images = import_files(pair, ImportOptions(frames=(1, 2, 3, 5))).recording.calibration
    np.testing.assert_array_equal(images.measurements, np.array(PIXELS)[[1, 2, 3, 5]])
    np.testing.assert_allclose(images.poses, POSES[[1, 2, 3, 5]], atol=1e-12)
    np.testing.assert_array_equal(images.frame, [1, 2, 3, 5])


def _named(names, columns):
    return "\n".join(",".join(map(str, row)) for row in [names, *zip(*columns, strict=True)])


def test_two_tables_of_images_by_name(tmp_path):
    """Folders do not count, and a point without a pose is left out."""
    files = [f"a/{k}.png" for k in range(6)]
    poses = [files, *np.column_stack(POSE_COLUMNS).T]
    (tmp_path / "poses.csv").write_text(_named(["file", *POSE_NAMES], poses))
    names = [f"b\\{k}.png" for k in (5, 0, 2, 3, 1, 9)]
    (tmp_path / "p.csv").write_text(_named(["file", "u", "v"], [names, *PIXELS.T]))
    imported = import_files([tmp_path / "poses.csv", tmp_path / "p.csv"])
    images = imported.recording.calibration
    np.testing.assert_allclose(images.poses, POSES[[5, 0, 2, 3, 1]], atol=1e-12)
    np.testing.assert_array_equal(images.measurements, PIXELS[:5])
    assert imported.notes == [f"1 point left out: {tmp_path}/poses.csv has no pose of that image"]
    assert not imported.most_lost


@pytest.mark.parametrize(("of_poses", "of_points", "lost"), [(0, 1, 5), (1, 0, 0), (0, 0, None)])
def test_images_counted_from_1_in_one_of_two_tables_are_told(tmp_path, of_poses, of_points, lost):
    """All points but one had the pose of another image, and only the one left out was told."""
    numbers = np.arange(6)
    poses = [numbers + of_poses, *np.column_stack(POSE_COLUMNS).T]
    (tmp_path / "poses.csv").write_text(_named(["frame", *POSE_NAMES], poses))
    points = [numbers + of_points, *PIXELS.T]
    (tmp_path / "p.csv").write_text(_named(["frame", "u", "v"], points))
    notes = import_files([tmp_path / "poses.csv", tmp_path / "p.csv"]).notes
    assert len(notes) == (lost is not None)
    for note in notes:
        assert note.startswith("1 point left out: ")
        assert f"numbers begin with {of_points} in {tmp_path}/p.csv, with {of_poses} in" in note
    # The pose of image 0 alone is missing: shifted numbers would leave a point out as well.
    (tmp_path / "poses.csv").write_text(_named(["frame", *POSE_NAMES], [c[1:] for c in poses]))
    (tmp_path / "p.csv").write_text(_named(["frame", "u", "v"], [numbers, *PIXELS.T]))
    notes = import_files([tmp_path / "poses.csv", tmp_path / "p.csv"]).notes
    assert not [note for note in notes if "begin with" in note]


@pytest.mark.parametrize(
    ("unit", "interval", "told"),
    [
        ("", 20.0, "are they in ms"),
        ("", 0.02 / 86400, "are they in days"),
        (" [ms]", 20.0, ""),
        ("", 0.02, ""),
    ],
)
def test_times_that_are_hardly_in_s_in_both_of_two_tables_are_told(tmp_path, unit, interval, told):
    """A lag in s was a thousand times too short, and another lag was not noticed."""
    times = interval * np.arange(6)
    poses = [times, *np.column_stack(POSE_COLUMNS).T]
    (tmp_path / "poses.csv").write_text(_named([f"time{unit}", *POSE_NAMES], poses))
    (tmp_path / "p.csv").write_text(_named([f"time{unit}", "u", "v"], [times, *PIXELS.T]))
    files = [tmp_path / "poses.csv", tmp_path / "p.csv"]
    notes = import_files(files).notes
    apart = f"are {interval:.3g} s apart if times are in s"
    assert [told in note for note in notes if apart in note] == ([True] if told else [])
    with pytest.raises(InputError, match=told or "too few images"):
        import_files(files, ImportOptions(lag_s="auto"))


@pytest.mark.parametrize(("rate", "told"), [(1.0, False), (0.1, True)])
def test_numbers_of_another_device_are_told_from_their_times(tmp_path, rate, told):
    """Rows were matched by the frame numbers of a tracker and of a scanner, without a word."""
    numbers = np.arange(6)
    poses = [numbers, rate * numbers, *np.column_stack(POSE_COLUMNS).T]
    (tmp_path / "poses.csv").write_text(_named(["frame", "time", *POSE_NAMES], poses))
    # Another clock alone is no contradiction.
    points = [numbers, 100 + numbers, *PIXELS.T]
    (tmp_path / "p.csv").write_text(_named(["frame", "time", "u", "v"], points))
    notes = import_files([tmp_path / "poses.csv", tmp_path / "p.csv"]).notes
    assert ["do both count the same images" in note for note in notes] == [True] * told


def test_rows_left_out_of_two_tables_in_order_shift_no_others(tmp_path):
    """An invalid row in each of the two gave the rows between them the pose of another image."""
    poses = np.column_stack(POSE_COLUMNS).astype(object)
    poses[1], points = "", PIXELS.astype(object)
    (tmp_path / "poses.csv").write_text(_named(POSE_NAMES, poses.T))
    for gap, kept in ((4, [0, 2, 3, 5]), (None, [0, 2, 3, 4, 5])):
        if gap is not None:
            points[gap] = "nan"
        (tmp_path / "p.csv").write_text(_named(["u", "v"], points.T))
        files = [tmp_path / "poses.csv", tmp_path / "p.csv"]
        imported = import_files(files, ImportOptions(skip_invalid=True))
        images = imported.recording.calibration
        np.testing.assert_allclose(images.poses, POSES[kept], atol=1e-12)
        np.testing.assert_array_equal(images.measurements, PIXELS[kept])
        assert imported.notes[-1].startswith("1 point left out: ")
        points = PIXELS


def test_a_table_with_both_is_no_one_of_two_tables(tmp_path):
    """It ended in an error of numpy."""
    poses = [np.arange(6), *np.column_stack(POSE_COLUMNS).T]
    whole = _named(["frame", *POSE_NAMES, "u", "v"], [*poses, *PIXELS.T])
    (tmp_path / "both.csv").write_text(whole)
    (tmp_path / "p.csv").write_text(_named(["frame", "u", "v"], [np.arange(6), *PIXELS.T]))
    (tmp_path / "poses.csv").write_text(_named(["frame", *POSE_NAMES], poses))
    for other in ("p.csv", "poses.csv", "both.csv"):
        for pair in (("both.csv", other), (other, "both.csv")):
            with pytest.raises(InputError, match="a table with both is imported by itself"):
                import_files([tmp_path / name for name in pair])


@pytest.mark.parametrize(
    ("names", "numbers", "message"),
    [
        (["frame", "u", "v"], [0, 1, 2, 3, 4, 4], r"p.csv:7: image 4 is there twice"),
        (
            ["frame", "u", "v"],
            [7, 8, 9, 10, 11, 12],
            "poses.csv has the pose of none of its points",
        ),
        (["time", "u", "v"], range(6), "which pose of .*poses.csv belongs to which point"),
        (["frame", *POSE_NAMES[:2]], range(6), "not all of x, y and z"),
    ],
)
def test_two_tables_that_do_not_belong_together(tmp_path, names, numbers, message):
    poses = [np.arange(6), *np.column_stack(POSE_COLUMNS).T]
    (tmp_path / "poses.csv").write_text(_named(["frame", *POSE_NAMES], poses))
    (tmp_path / "p.csv").write_text(_named(names, [numbers, *PIXELS.T]))
    with pytest.raises(InputError, match=message):
        import_files([tmp_path / "poses.csv", tmp_path / "p.csv"])
    if names[0] == "frame" and names[1] == "u":
        with pytest.raises(InputError, match="one table must hold the poses"):
            import_files([tmp_path / "p.csv", tmp_path / "p.csv"])


def test_a_trackers_own_numbers_of_frames(tmp_path):
    """Points name the numbers in the column Frame; where tools disagree there is none."""
    head = "Tools,Port 1: Probe,Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error"
    rows = [
        f"1,Port 1: Probe,{10 + k},0,OK,"
        + ",".join(f"{x:.12f}" for x in [*QUATERNIONS[k, [3, 0, 1, 2]], *TRANSLATIONS[k]])
        + ",0.1"
        for k in range(6)
    ]
    (tmp_path / "t.csv").write_text("\n".join([head, *rows]))
    lines = table(["frame", "u", "v"], [[14, 11, 12, 13], PIXELS[[4, 1, 2, 3]]])
    (tmp_path / "p.csv").write_text("\n".join(lines).replace(".0,", ",", 4))
    images = import_files([tmp_path / "t.csv", tmp_path / "p.csv"])[0].calibration
    np.testing.assert_allclose(images.poses, POSES[1:5], atol=1e-9)
    np.testing.assert_allclose(images.measurements, PIXELS[1:5])
    (tmp_path / "p.csv").write_text("frame,u,v\n1,2,3\n")
    with pytest.raises(InputError, match=r"p\.csv:2: frame 1 is not .* has frames 10 to 15"):
        import_files([tmp_path / "t.csv", tmp_path / "p.csv"])
    (tmp_path / "t.csv").write_text("\n".join([head, *rows, rows[0]]))
    (tmp_path / "p.csv").write_text("frame,u,v\n10,2,3\n")
    with pytest.raises(InputError, match=r"p\.csv:2: several frames of .* have the number 10"):
        import_files([tmp_path / "t.csv", tmp_path / "p.csv"])
    for text, numbers in ((NDI, [-1, -1]), (OLD_NDI, [7]), (MOTIVE, [0, 1])):
        (tmp_path / "t.csv").write_text(text)
        np.testing.assert_array_equal(read_tracker(tmp_path / "t.csv").numbers, numbers)


# Sequences with points from another file.


@pytest.fixture
def sequence(tmp_path):
    """Six frames of tracking, of which number 2 is lost; Reference moves as well."""
    references = random_poses(6, 9)
    transforms = {PROBE: references @ POSES, REFERENCE: references}
    valid = {PROBE: np.arange(6) != 2}
    write_sequence(tmp_path / "s.igs.mha", transforms, 10 + np.arange(6) / 10, valid=valid)
    return tmp_path / "s.igs.mha"


KEPT = [0, 1, 3, 4, 5]


def markups(system, sign, labels):
    points = [
        {"label": label, "position": [sign * u, sign * v, 0.0], "positionStatus": "defined"}
        for label, (u, v) in zip(labels, PIXELS, strict=True)
    ]
    points.append({"label": "x", "position": [0, 0, 0], "positionStatus": "undefined"})
    document = {"markups": [{"coordinateSystem": system, "controlPoints": points}]}
    return json.dumps(document)


def fcsv(sign):
    rows = [
        f"id{k},{sign * u!r},{sign * v!r},0,0,0,0,1,1,1,0,F-{k},,"
        for k, (u, v) in enumerate(PIXELS.tolist())
    ]
    head = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    return head + "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc\n" + "\n".join(rows)


@pytest.mark.parametrize(
    ("name", "text", "points"),
    [
        ("p.mrk.json", markups("LPS", 1, [f"F-{k}" for k in range(6)]), "labels"),
        ("p.mrk.json", markups("RAS", 1, [f"frame {k}" for k in range(6)]), "labels"),
        ("p.mrk.json", markups("LPS", -1, ["?"] * 6), "order"),
        ("p.fcsv", fcsv(1), "labels"),
        ("p.fcsv", fcsv(-1), "order"),
        ("p.fcsv", fcsv(1).replace("F-", '"wire, ').replace(",,", '",,'), "labels"),
        ("p.json", markups("LPS", 1, [f"F-{k}" for k in range(6)]), "labels"),
        ("p.csv", "\n".join(table(["frame", "v", "u"], [np.arange(6), PIXELS[:, ::-1]])), None),
        ("p.csv", "\n".join(table(["time", "u", "v"], [10.01 + np.arange(6) / 10, PIXELS])), None),
        ("p.csv", "\n".join(table(["u", "v"], [PIXELS])), None),
    ],
)
def test_points_of_a_sequence(tmp_path, sequence, name, text, points):
    (tmp_path / name).write_text(text)
    recording, notes, *_ = import_files([sequence, tmp_path / name], ImportOptions(points=points))
    images = recording.calibration
    np.testing.assert_allclose(images.poses, POSES[KEPT], atol=1e-11)
    np.testing.assert_allclose(images.measurements, PIXELS[KEPT], rtol=1e-14)
    np.testing.assert_allclose(images.time, 10 + np.array(KEPT) / 10)
    assert "poses from Probe to Reference" in notes[0]
    assert "1 of 6 frames left out: their tracking was not OK" in notes
    tracker = ImportOptions(points=points, target="Tracker")
    found = import_files([sequence, tmp_path / name], tracker)[0]
    np.testing.assert_allclose(
        found.calibration.poses, (random_poses(6, 9) @ POSES)[KEPT], atol=1e-11
    )
    assert recording.pose_frames == ("Probe", "Reference")
    jaxcal.save(found, tmp_path / "r.h5")
    kept = jaxcal.load(tmp_path / "r.h5")
    assert kept.pose_frames == ("Probe", "Tracker")
    assert joined(kept, kept).pose_frames == kept.pose_frames
    with pytest.raises(InputError, match="from Probe to Reference, not from Probe to Tracker"):
        joined(kept, recording)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("p.mrk.json", markups("LPS", 1, ["F-0"] * 6), "how points belong to frames"),
        ("p.mrk.json", "[" * 10**5, "is not JSON"),
        ("p.mrk.json", "{}", "holds no markups"),
        ("p.mrk.json", markups("XYZ", 1, ["F"] * 6), "neither LPS nor RAS"),
        (
            "p.mrk.json",
            '{"markups": [{"controlPoints": [{"position": [%s, 1, 0]}]}]}' % ("9" * 400),
            "point 1: a position is three finite numbers",
        ),
        ("p.csv", "frame,u,v\n9,1,1\n", "frame 9 is not in the sequence"),
        ("p.csv", "frame,u,v\n1,1,1\n1,2,2\n", "frame 1 has more than one point"),
        ("p.csv", "frame,u,v\n1.5,1,1\n", "p.csv:2: column 1 is not the number of an image"),
        (
            "p.csv",
            "time,u,v\n11.5,1,1\n",
            "taken at 11.500 s (the sequence lasts from 10.000 s to 10.500 s)",
        ),
        ("p.csv", "u,v\n1,1\n", "has neither a column frame nor a column time"),
        ("p.csv", "frame,x,y,z,qx,qy,qz,qw\n1,1,1,1,0,0,0,1\n", "holds no points"),
        ("p.csv", "frame,u,v\n0,1,1\n1,1,1\n2,3,4\n", "2 used images are too few"),
    ],
)
def test_points_that_do_not_belong(tmp_path, sequence, name, text, message, capsys):
    (tmp_path / name).write_text(text)
    out = tmp_path / "out.h5"
    assert main(["import", str(sequence), str(tmp_path / name), str(out)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_times_of_points_count_though_a_frame_has_none(tmp_path, sequence):
    """They were paired in order, without a word, if there were as many points as frames."""
    content, stamp = sequence.read_text("latin-1"), r"Seq_Frame000{}_Timestamp = .*\n"
    assert re.search(stamp.format(4), content)
    moments = 10 + np.arange(6) / 10
    swapped = [0, 1, 3, 2, 5]
    sequence.write_bytes(re.sub(stamp.format(4), "", content).encode("latin-1"))
    rows = table(["time", "u", "v"], [moments[swapped], PIXELS[swapped]])
    (tmp_path / "p.csv").write_text("\n".join(rows))
    images = import_files([sequence, tmp_path / "p.csv"])[0].calibration
    np.testing.assert_allclose(images.measurements, PIXELS[[0, 1, 3, 5]])
    np.testing.assert_allclose(images.poses, POSES[[0, 1, 3, 5]], atol=1e-11)
    (tmp_path / "p.csv").write_text("\n".join(table(["time", "u", "v"], [moments, PIXELS])))
    with pytest.raises(InputError, match=r"\.csv:6: .*1 of 6 frames of .* have no time stamp"):
        import_files([sequence, tmp_path / "p.csv"])
    sequence.write_bytes(re.sub(stamp.format("[135]"), "", content).encode("latin-1"))
    with pytest.raises(InputError, match=r"\.csv:3: .*3 of 6 frames of .* have no time stamp"):
        import_files([sequence, tmp_path / "p.csv"])
    sequence.write_bytes(re.sub(stamp.format("[0-4]"), "", content).encode("latin-1"))
    with pytest.raises(
        InputError, match=r"by time: 5 of 6 frames .* have no time stamp .*--points"
    ):
        import_files([sequence, tmp_path / "p.csv"])
    ordered = import_files([sequence, tmp_path / "p.csv"], ImportOptions(points="order"))
    np.testing.assert_allclose(ordered[0].calibration.measurements, PIXELS[KEPT])


@pytest.mark.parametrize("apart", [False, True])
def test_transforms_without_a_status_are_told_once(tmp_path, sequence, apart):
    """PLUS refuses them; old files have none."""
    content = sequence.read_bytes()
    (tmp_path / "p.csv").write_text("\n".join(table(["u", "v"], [PIXELS])))
    options = ImportOptions(poses=sequence if apart else None)
    told = "s.igs.mha: ProbeToTracker without a status is taken as OK"
    for pattern, times in ((rb"Stylus", 0), (rb"(Seq_Frame000[13]_ProbeTo\w+Status) = OK\n", 1)):
        sequence.write_bytes(re.sub(pattern, b"", content))
        recording, notes, *_ = import_files([sequence, tmp_path / "p.csv"], options)
        assert "\n".join(notes).count("without a status") == times
        assert "\n".join(notes).count(told) == times
        assert len(recording.calibration) == len(KEPT)


@pytest.mark.parametrize("kind", ["sequence", "poses", "ndi"])
def test_poses_of_a_sequence_in_metres(tmp_path, kind):
    """What the refusal advises works."""
    poses = POSES.copy()
    poses[:, :3, 3] /= 1e3
    (tmp_path / "p.csv").write_text("\n".join(table(["u", "v"], [PIXELS])))
    sources, asked = [tmp_path / "s.igs.mha", tmp_path / "p.csv"], {}
    if kind == "ndi":
        sources[0] = tmp_path / "t.csv"
        cells = np.column_stack([QUATERNIONS[:, [3, 0, 1, 2]], poses[:, :3, 3]]).tolist()
        rows = [f"1,Port 1,{k},0,OK,{','.join(map(repr, row))},0" for k, row in enumerate(cells)]
        sources[0].write_text("\n".join([OLD_NDI.splitlines()[0], *rows]))
    else:
        write_sequence(sources[0], {PROBE: poses}, np.arange(6.0))
    if kind == "poses":
        asked = {"poses": tmp_path / "s.igs.mha"}
        sources[0] = tmp_path / "i.igs.mha"
        write_sequence(sources[0], {PROBE: POSES}, np.arange(6.0))
    with pytest.raises(InputError, match=r"look like metres.*--pose-units m\)"):
        import_files(sources, ImportOptions(**asked))
    images = import_files(sources, ImportOptions(**asked, pose_units="m"))[0].calibration
    np.testing.assert_allclose(images.poses, POSES, atol=1e-9)


@pytest.mark.parametrize("kind", ["pair", "table", "sequence", "by time", "table by time"])
def test_poses_from_the_tracker_to_the_probe_can_be_inverted(tmp_path, kind):
    """What the verdict advises; it named no way to do it."""
    back = np.linalg.inv(POSES)
    quaternions = Rotation.from_matrix(back[:, :3, :3]).as_quat()
    rows, asked = [PIXELS, back[:, :3, 3], quaternions], {}
    sources = [tmp_path / "t.csv"]
    sources[0].write_text("\n".join(table(NAMES, rows)))
    if kind == "pair":
        np.savetxt(tmp_path / "poses.txt", back[:, :3].reshape(-1, 4))
        np.savetxt(tmp_path / "points.txt", PIXELS)
        sources = [tmp_path / "poses.txt", tmp_path / "points.txt"]
    elif kind != "table":
        own = {PROBE: back if kind == "sequence" else POSES}
        write_sequence(tmp_path / "s.igs.mha", own, np.arange(6.0))
        write_sequence(tmp_path / "p.igs.mha", {PROBE: back}, np.arange(6.0))
        timed = table(["time", *NAMES[2:]], [np.arange(6.0), *rows[1:]])
        (tmp_path / "p.csv").write_text("\n".join(timed))
        sources = [tmp_path / "s.igs.mha", tmp_path / "t.csv"]
        sources[1].write_text("\n".join(table(["u", "v"], [PIXELS])))
        apart = {"by time": "p.igs.mha", "table by time": "p.csv"}
        asked = {"poses": tmp_path / apart[kind]} if kind in apart else {}
    images = import_files(sources, ImportOptions(**asked))[0].calibration
    np.testing.assert_allclose(images.poses, back, atol=1e-9)
    images = import_files(sources, ImportOptions(**asked, invert_poses=True))[0].calibration
    np.testing.assert_allclose(images.poses, POSES, atol=1e-9)


def test_a_pose_that_cannot_be_inverted_is_named(tmp_path):
    np.savetxt(tmp_path / "poses.txt", (POSES * [[-1], [1], [1], [1]])[:, :3].reshape(-1, 4))
    np.savetxt(tmp_path / "points.txt", PIXELS)
    pair = [tmp_path / "poses.txt", tmp_path / "points.txt"]
    with pytest.raises(InputError, match=r"poses\.txt.*: pose 0 is a reflection"):
        import_files(pair, ImportOptions(invert_poses=True))


def test_a_probe_at_rest_is_not_taken_for_metres(tmp_path):
    """Poses between two frames on one body differ by rounding."""
    lines = table(NAMES, [PIXELS, 1e-15 * TRANSLATIONS, QUATERNIONS])
    assert len(imported(tmp_path, lines)[0].calibration) == 6


def test_a_stated_unit_is_not_advised_against(tmp_path):
    lines = table([*NAMES[:2], "x [mm]", "y [mm]", "z [mm]", *NAMES[5:]], COLUMNS)
    scaled = table(NAMES, [PIXELS, TRANSLATIONS / 1e3, QUATERNIONS])
    with pytest.raises(InputError, match=r"look like metres; give them in mm$"):
        imported(tmp_path, [lines[0], *scaled[1:]])
    (tmp_path / "m.csv").write_text(MOTIVE)
    (tmp_path / "p.csv").write_text("u,v\n1,1\n1,1\n")
    with pytest.raises(FormatError, match="its Length Units are meters, not mm"):
        import_files([tmp_path / "m.csv", tmp_path / "p.csv"], ImportOptions(pose_units="mm"))


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("x.mat", "save its numbers as a table"),
        ("x.XLSX", "save its numbers as a table"),
        ("x.npy", "save its numbers as a table"),
        ("results.xml", "jaxcal export, apply and compare read"),
        ("ImageToProbe.tfm", "jaxcal export, apply and compare take it as CAL"),
        ("tool.yaml", "jaxcal export, apply and compare take it as CAL"),
        ("frame.png", "name the folder"),
        ("clip.mp4", "save its frames as PNG"),
        ("sweep.mkv", "record as .igs.mha, or try PLUS's EditSequenceFile"),
        ("scene.mrml", "save its sequence from Slicer as"),
        ("a.bag", "save its poses as a table"),
    ],
)
def test_what_to_do_with_other_files_is_told(tmp_path, name, told):
    """MATLAB's and Excel's files were to be saved as UTF-8."""
    (tmp_path / name).write_bytes(b"MATLAB 5.0 MAT-file\xff\0")
    with pytest.raises(FormatError, match=rf"{name}: is not a recording .* \({told}"):
        import_files([tmp_path / name])


@pytest.mark.parametrize("clock", ["26-Nov-2026 08:15:00.250", "26.11.2026 08:15:00"])
def test_which_dates_are_read_is_told(tmp_path, clock):
    """MATLAB and Excel write others."""
    lines = [f"{clock},{line}" for line in table(NAMES, COLUMNS)]
    lines[0] = lines[0].replace(clock, "time")
    with pytest.raises(FormatError, match=r"t\.csv:2: column 1 \('time'\) is neither .* ISO 8601"):
        imported(tmp_path, lines)
    assert "not kept" in imported(tmp_path, lines, ignore_time=True).notes[0]


POINTS_OF_SIX = "\n".join(table(["u", "v"], [PIXELS]))


@pytest.mark.parametrize(
    ("sources", "options", "message"),
    [
        ("s.mha p.csv", "--quaternion wxyz", "--quaternion is for tables with poses"),
        ("s.mha p.csv", "--points labels", "--points labels is for points of Slicer"),
        ("s.mha n.csv", "--points order", "leave --points order out"),
        ("s.mha p.csv", "--target cross", "--target is for the search in frames"),
        ("s.mha p.csv", "--region 1 2 3 4", "--region is for the search in frames"),
        ("s.mha p.csv", "--orientation UF", "--orientation is for the search in frames"),
        ("s.mha p.csv", "--poses t.csv --from Tool", "--from does not go with a table of poses"),
        ("s.mha p.mrk.json", "--points order --units mm", "--units is for tables of points"),
        ("s.mha", "--units px", "--units is for tables of points"),
        ("s.mha", "--skip-invalid", "--skip-invalid is for tables"),
        ("s.mha", "--quaternion wxyz", "--quaternion is for tables"),
        ("s.mha", "--points order", "--points is for points of another file"),
        ("s.mha", "--orientation UN", "are stored as MF, not UN: leave --orientation out"),
        ("t.csv", "--from Foo", "--from does not go with a table of poses and points"),
        ("t.csv", "--to Bar", "--to does not go with"),
        ("t.csv", "--target echo", "--target does not go with"),
        ("t.csv", "--region 1 2 3 4", "--region does not go with"),
        ("t.csv", "--lag 0.1", "--lag is for poses that are matched"),
        ("t.csv", "--points order", "--points does not go with"),
        ("t.csv", "--orientation MF", "--orientation does not go with"),
        ("m.csv", "--quaternion xyzw", "m.csv: its poses are matrices: leave --quaternion out"),
        ("a.txt b.txt", "--skip-invalid", "--skip-invalid does not go with a pair"),
    ],
)
def test_options_that_would_not_be_used(tmp_path, monkeypatch, sources, options, message, capsys):
    monkeypatch.chdir(tmp_path)
    frames = np.random.default_rng(0).integers(0, 90, (6, 60, 80)).astype(np.uint8)
    write_sequence("s.mha", {PROBE: POSES}, np.arange(6.0), images=frames)
    for name, text in (
        ("p.csv", POINTS_OF_SIX),
        ("n.csv", "\n".join(table(["frame", "u", "v"], [np.arange(6), PIXELS]))),
        ("t.csv", "\n".join(table(["time", *NAMES], [np.arange(6.0), *COLUMNS]))),
        ("m.csv", "\n".join(table([*MATRIX, "u", "v"], [POSES[:, :3].reshape(6, 12), PIXELS]))),
        ("p.mrk.json", markups("LPS", 1, ["F"] * 6)),
        ("a.txt", "\n".join(table(None, [POSES[:, :3].reshape(-1, 4)], " "))),
        ("b.txt", "\n".join(table(None, [PIXELS], " "))),
    ):
        (tmp_path / name).write_text(text)
    assert main(["import", *sources.split(), "o.h5", *options.split()]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "o.h5").exists()


def test_points_of_images_that_were_not_ok(tmp_path):
    frames = np.zeros((6, 500, 520), np.uint8)
    path = tmp_path / "s.igs.mha"
    write_sequence(path, {PROBE: POSES}, np.arange(6.0), images=frames)
    old = b"Seq_Frame0003_ImageStatus = "
    path.write_bytes(path.read_bytes().replace(old + b"OK", old + b"INVALID"))
    (tmp_path / "p.csv").write_text(POINTS_OF_SIX)
    recording, notes, *_ = import_files([path, tmp_path / "p.csv"])
    np.testing.assert_allclose(recording.calibration.poses, POSES[[0, 1, 2, 4, 5]], atol=1e-11)
    assert "1 point left out, in frames whose image was not OK" in notes


@pytest.mark.parametrize("lost", [4, 6])
def test_points_of_which_most_have_no_pose_end_with_status_3(tmp_path, capsys, lost):
    path, out = tmp_path / "s.igs.mha", tmp_path / "o.h5"
    write_sequence(path, {PROBE: random_poses(10)}, np.arange(10.0))
    header = re.sub(
        rb"(Frame000[0-%d]_ProbeTo\w+Status = )OK" % (lost - 1), rb"\1INVALID", path.read_bytes()
    )
    path.write_bytes(header)
    (tmp_path / "p.csv").write_text("frame,u,v\n" + "".join(f"{k},{k}.5,9\n" for k in range(10)))
    status = main(["import", str(path), str(tmp_path / "p.csv"), str(out)])
    told = capsys.readouterr().out.splitlines()[1]
    assert (status, told == "- only 4 of 10 points can be used: see below") == (
        (3, True) if lost == 6 else (0, False)
    )
    assert len(jaxcal.load(out)) == 10 - lost


@pytest.mark.parametrize(
    ("orientation", "told"),
    [("MF", None), ("UF", "(u = 519 - u)"), ("UN", "(u = 519 - u and v = 499 - v)")],
)
def test_points_beside_pixels_of_another_orientation(tmp_path, orientation, told):
    frames = np.zeros((6, 500, 520), np.uint8)
    path = tmp_path / "s.igs.mha"
    write_sequence(path, {PROBE: POSES}, np.arange(6.0), images=frames, orientation=orientation)
    (tmp_path / "p.csv").write_text(POINTS_OF_SIX)
    notes = [note for note in import_files([path, tmp_path / "p.csv"])[1] if "mirrored" in note]
    assert len(notes) == (told is not None)
    assert all(f"is stored as {orientation}" in note and told in note for note in notes)
    (tmp_path / "p.csv").write_text(f"# jaxcal pick of s.igs.mha\n{POINTS_OF_SIX}")
    notes = import_files([path, tmp_path / "p.csv"])[1]
    assert not [note for note in notes if "mirrored" in note]


@pytest.mark.parametrize(
    ("name", "unset", "stated"),
    [
        ("s.igs.mha", b"ElementSpacing = 1 1 1", b"ElementSpacing = 0.2 0.15 1"),
        ("s.igs.nrrd", b"(1,0) (0,1) none", b"(0,-0.2,0) (0.15,0,0) none"),
        ("s.igs.nrrd", b"space directions: (1,0) (0,1) none", b"spacings: 0.2 0.15 NaN"),
    ],
)
def test_a_pixel_size_in_the_header_is_told(tmp_path, name, unset, stated):
    path = tmp_path / name
    write_sequence(path, {PROBE: POSES}, np.arange(6.0), images=np.zeros((6, 500, 520), np.uint8))
    (tmp_path / "p.csv").write_text(POINTS_OF_SIX)
    files = [path, tmp_path / "p.csv"]

    def told(**options) -> list[str]:
        notes = import_files(files, ImportOptions(**options)).notes
        return [note for note in notes if "its header states pixels of" in note]

    assert told() == []
    content = path.read_bytes()
    assert content.count(unset) == 1
    path.write_bytes(content.replace(unset, stated))
    assert "0.2 x 0.15 mm, which is not used" in told()[0]
    assert "--spacing 0.2 0.15" in told(spacing_mm=(0.1, 0.1))[0]
    assert told(spacing_mm=(0.2, 0.15)) == []
    # Slicer's points are then in mm, not in px.
    (tmp_path / "p.fcsv").write_text(fcsv(1))
    with pytest.raises(InputError, match=r"p\.fcsv: .*with spacing 1, .* states 0\.2 x 0\.15 mm"):
        import_files([path, tmp_path / "p.fcsv"])


def test_points_that_cannot_be_used_name_their_file(tmp_path, sequence):
    lines = table(["frame", "u", "v"], [np.arange(6), PIXELS * [1, -1]])
    (tmp_path / "p.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"s\.igs\.mha with .*p\.csv: pixel 0 has row"):
        import_files([sequence, tmp_path / "p.csv"])


def test_points_of_slicer_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(slicer, "MOST_POINTS", 3)
    (tmp_path / "p.fcsv").write_text("a,1,2,0\n" * 3)
    assert len(read_markups(tmp_path / "p.fcsv").positions) == 3
    (tmp_path / "p.fcsv").write_text("a,1,2,0\n" * 4)
    with pytest.raises(FormatError, match=r"p\.fcsv:4: more than 3 points"):
        read_markups(tmp_path / "p.fcsv")


def test_points_outside_the_frames(tmp_path, capsys):
    path, points, out = (str(tmp_path / name) for name in ("s.mha", "p.csv", "rec.h5"))
    frames = np.zeros((6, 480, 640), np.uint8)
    write_sequence(path, {PROBE: POSES}, np.arange(6.0), images=frames)

    def imported(pixels):
        rows = np.column_stack([np.arange(6), pixels])
        np.savetxt(points, rows, delimiter=",", header="frame,u,v", comments="", fmt="%.6f")
        return main(["import", path, points, out])

    for pixels in (2 * PIXELS, PIXELS * [1.0, 3.0], PIXELS * [-1.0, 1.0]):
        assert imported(pixels) == 2
        assert "lies outside its frame of 640 x 480 px" in capsys.readouterr().err
    # From 1 to the number of columns and rows, as MATLAB counts.
    counted = np.minimum(PIXELS, 470.0)
    counted[0] = 640.0, 480.0
    assert imported(counted) == 0
    images = jaxcal.load(out).calibration
    assert images.frame_size == (640, 480)
    # Pixels of other frames are not of the same image.
    other = replace(images, frame_size=(640, 400))
    with pytest.raises(InputError, match="its frames have 640 x 400, not 640 x 480 px"):
        joined(jaxcal.Recording(images), jaxcal.Recording(other))
    bare = jaxcal.Recording(replace(images, frame_size=None))
    assert joined(bare, jaxcal.Recording(images)).calibration.frame_size == (640, 480)
    # Also where only one of the two states its frames; the command named its output as the culprit.
    narrow = jaxcal.Recording(replace(images, frame_size=(60, 480)), source="narrow.h5")
    bare = replace(bare, source="bare.h5")
    for pair in ((bare, narrow), (narrow, bare)):
        told = rf"{pair[1].source} cannot be added to {pair[0].source}: bare\.h5: pixel 0, u = "
        with pytest.raises(InputError, match=told):
            joined(*pair)


def test_points_off_the_plane(tmp_path, sequence):
    (tmp_path / "p.fcsv").write_text(fcsv(1).replace(",0,0,0,0,1,", ",3,0,0,0,1,", 2))
    with pytest.raises(FormatError, match=r"p\.fcsv: point 'F-0' lies 3 mm off the image's plane"):
        import_files([sequence, tmp_path / "p.fcsv"], ImportOptions(points="labels"))


def test_label_without_a_number(tmp_path, sequence):
    (tmp_path / "p.fcsv").write_text(fcsv(1).replace("F-3", "tip"))
    with pytest.raises(
        InputError, match="point 4: its label 'tip' does not end in a frame's number"
    ):
        import_files([sequence, tmp_path / "p.fcsv"], ImportOptions(points="labels"))


@pytest.mark.parametrize(("first", "told"), [(1, True), (0, False)])
def test_labels_as_slicer_numbers_them_are_asked_about(tmp_path, sequence, first, told):
    """F-1, F-2, ... count the points, unless somebody has renamed them."""
    document = json.loads(markups("LPS", 1, [f"F-{first + k}" for k in range(6)]))
    del document["markups"][0]["controlPoints"][5]
    (tmp_path / "p.json").write_text(json.dumps(document))
    notes = import_files([sequence, tmp_path / "p.json"], ImportOptions(points="labels")).notes
    assert ["as Slicer numbers points by itself" in n for n in notes].count(True) == told


def test_markups_are_ras(tmp_path):
    (tmp_path / "p.mrk.json").write_text(markups("LPS", 1, "012345"))
    found = read_markups(tmp_path / "p.mrk.json")
    np.testing.assert_allclose(found.positions[:, :2], -PIXELS)
    assert (found.labels, found.unplaced) == (tuple("012345"), 1)


@pytest.mark.parametrize(
    ("stored", "told"),
    [
        ({("Tracker", "Probe"): POSES}, "Probe to Tracker, inverted from Tracker to Probe"),
        ({("Tracker", "Wand"): POSES}, "Wand to Tracker, inverted from Tracker to Wand"),
        ({("Reference", "Probe"): POSES}, "Probe to Reference, inverted from Reference to Probe"),
        (
            {("Tracker", "Probe"): POSES, ("Tracker", "Reference"): np.tile(np.eye(4), (6, 1, 1))},
            "Probe to Reference (",
        ),
        (
            {("Image", "Probe"): np.tile(np.eye(4), (6, 1, 1)), ("Tracker", "Probe"): POSES},
            "Probe to Tracker, inverted",
        ),
    ],
)
def test_poses_that_are_stored_from_the_tracker(tmp_path, stored, told):
    write_sequence(tmp_path / "s.igs.mha", stored, np.arange(6.0))
    (tmp_path / "p.csv").write_text(POINTS_OF_SIX)
    recording, notes, *_ = import_files([tmp_path / "s.igs.mha", tmp_path / "p.csv"])
    np.testing.assert_allclose(recording.calibration.poses, np.linalg.inv(POSES), atol=1e-10)
    assert f"poses from {told}" in notes[0]


def test_a_reference_that_was_never_seen_is_told(tmp_path):
    """PLUS writes a Reference of its configuration whether it is there or not."""
    stored = {PROBE: POSES, ("Reference", "Tracker"): np.tile(np.eye(4), (6, 1, 1))}
    never = {("Reference", "Tracker"): np.zeros(6, bool)}
    write_sequence(tmp_path / "s.igs.mha", stored, np.arange(6.0), valid=never)
    (tmp_path / "p.csv").write_text(POINTS_OF_SIX)
    recording, notes, *_ = import_files([tmp_path / "s.igs.mha", tmp_path / "p.csv"])
    np.testing.assert_allclose(recording.calibration.poses, POSES, atol=1e-10)
    assert notes[0].startswith("poses from Probe to Tracker (")
    assert notes[0].endswith("; the tracking of Reference was OK in no frame")


def test_stylus_tip_as_target(tmp_path, capsys):
    """Pose = probe to stylus; the target is the tip, which rests in the stylus' frame."""
    references = random_poses(6, 9)
    transforms = {PROBE: references @ POSES, ("Stylus", "Tracker"): references}
    write_sequence(tmp_path / "s.igs.mha", transforms, np.arange(6.0))
    (tmp_path / "p.csv").write_text("\n".join(table(["u", "v"], [PIXELS])))
    sources = [str(tmp_path / "s.igs.mha"), str(tmp_path / "p.csv"), str(tmp_path / "r.h5")]
    assert main(["import", *sources, "--to", "Stylus"]) == 0
    np.testing.assert_allclose(jaxcal.load(sources[2]).calibration.poses, POSES, atol=1e-11)
    capsys.readouterr()
    assert main(["import", *sources]) == 0
    assert "choose others; --to Stylus if its tip is the target)" in capsys.readouterr().out
    assert main(["import", *sources, "--from", "Needle"]) == 2
    assert "no transforms lead from 'Needle'" in capsys.readouterr().err
    write_sequence(tmp_path / "s.igs.mha", {REFERENCE: POSES}, np.arange(6.0))
    assert main(["import", *sources]) == 2
    assert "(--from); there are 'Reference', 'Tracker'" in capsys.readouterr().err


def test_sources_are_not_overwritten(tmp_path, sequence, capsys):
    before = sequence.read_bytes()
    assert main(["import", str(sequence), str(sequence)]) == 2
    assert "name the output file last" in capsys.readouterr().err
    assert sequence.read_bytes() == before


# The whole way.

COLUMN, ROW, WIDE, HIGH = 164, 480, 492, 130


def burnt_sequence(path, count=28):
    """A sequence whose frames show a simulated point target, and the true matrix of PLUS.

    Where the real N-wire sequence is there, frames and the reference's poses are its own; the
    probe's poses are simulated, as in the real one it turned by 5 degrees only.
    """
    rng = np.random.default_rng(7)
    real = REAL_DATA / "plus" / "NwirePhantomFreehand.igs.mha"
    if real.exists():
        source = read_sequence(real)
        frames = [frame.copy() for frame in source.images(np.arange(count) * 3)]
        references = source.poses("Reference", "Tracker")[0][::3][:count]
    else:
        frames = list(rng.integers(0, 20, (count, ROW + HIGH, COLUMN + WIDE), dtype=np.uint8))
        references = random_poses(count, 3)
    truth = jaxcal.ImageTransform(random_poses(1, 5)[0], np.array([0.21, 0.19]))
    x, target = truth.image_plane_to_probe, rng.uniform(-80, 80, 3)
    poses = np.tile(np.eye(4), (count, 1, 1))
    v, u = np.mgrid[: frames[0].shape[0], : frames[0].shape[1]]
    for index, frame in enumerate(frames):
        pixel = np.array([COLUMN, ROW]) + 30 + rng.uniform(size=2) * [WIDE - 60, HIGH - 60]
        plane = [0.21 * pixel[0], rng.normal(0, 0.3), 0.19 * pixel[1]]
        turn = Rotation.from_rotvec(rng.normal(0, 0.6, 3)).as_matrix()
        poses[index, :3, :3] = turn
        poses[index, :3, 3] = target - turn @ (x[:3, :3] @ plane + x[:3, 3])
        # A Gaussian echo in a display of 60 dB over 255 levels.
        radius = ((u - pixel[0]) / 5) ** 2 + ((v - pixel[1]) / 3) ** 2
        level = 250 - 8.686 * radius / 2 * 255 / 60
        np.maximum(frame, np.clip(level, 0, 250).astype(np.uint8), out=frame)
    transforms = {PROBE: references @ poses, REFERENCE: references}
    valid = {PROBE: np.arange(count) != 4}
    write_sequence(path, transforms, np.arange(count) / 10, valid=valid, images=frames)
    return truth


def test_import_calibrate_export(tmp_path, capsys):
    """The documented path, and its answer against the truth."""
    truth = burnt_sequence(tmp_path / "x.igs.mha")
    config = tmp_path / "config.xml"
    old = ' <Transform From="Image" To="US_Probe" Matrix="1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1" />'
    lines = ["<PlusConfiguration>", "<CoordinateDefinitions>", old, "</CoordinateDefinitions>"]
    config.write_bytes("\r\n".join([*lines, "</PlusConfiguration>", ""]).encode())
    recording = str(tmp_path / "out.h5")
    region = [str(value) for value in (COLUMN, ROW, WIDE, HIGH)]
    assert main(["import", str(tmp_path / "x.igs.mha"), recording, "--region", *region]) == 0
    said = capsys.readouterr().out
    # Frames in which a real reflection is as bright as the target are left out and counted.
    assert 24 <= int(re.search(r"out\.h5: (\d+) images, pixels", said)[1]) <= 27
    assert "1 of 28 frames left out: their tracking was not OK" in said
    # The probe's marker has another name in this laboratory, in the recording as in PLUS.
    named = replace(jaxcal.load(recording), pose_frames=("US_Probe", "Tracker"))
    jaxcal.save(named, recording)
    arguments = ["--method", "conventional", "--estimate", "scale", "--json"]
    exported = ["--export", f"plus:{config}", "--export", f"slicer:{tmp_path / 'x.tfm'}"]
    assert main(["calibrate", recording, *arguments, *exported]) == 0
    (tmp_path / "cal.json").write_text(capsys.readouterr().out)
    found = jaxcal.load_calibration(tmp_path / "cal.json")
    slicer = jaxcal.load_calibration(tmp_path / "x.tfm").plus_matrix()
    assert jaxcal.load_calibration(config).probe_frame == "US_Probe"
    assert main(["export", str(tmp_path / "cal.json"), str(tmp_path / "t.xml"), "--plus"]) == 0
    assert main(["export", str(config), str(tmp_path / "t.xml"), "--plus"]) == 0
    alone = jaxcal.load_calibration(tmp_path / "t.xml").plus_matrix()
    for matrix in (jaxcal.load_calibration(config).plus_matrix(), alone, slicer):
        np.testing.assert_allclose(matrix, found.plus_matrix(), rtol=0, atol=1e-11)
    assert config.read_text().count("<Transform ") == 1
    for arguments, frame in (([], "US_Probe"), (["--probe-frame", "Wand"], "Wand")):
        assert main(["export", str(tmp_path / "cal.json"), "--plus", *arguments]) == 0
        assert f'From="Image" To="{frame}"' in capsys.readouterr().out
    found.save(tmp_path / "again.json")
    assert jaxcal.load_calibration(tmp_path / "again.json").probe_frame == "US_Probe"
    record = json.loads((tmp_path / "cal.json").read_text())
    assert record["exported"][0] == f"{config}: Image to US_Probe written"
    assert "- left out: SDs (.json and .npz hold them)" in record["exported"]
    assert record["exported"][-2:] == [
        f"{tmp_path / 'x.tfm'}: written",
        "- left out: SDs (.json and .npz hold them) and the name of the probe's frame, 'US_Probe'",
    ]
    for name, notes in (("all.npz", 0), ("t.npy", 1), ("t.json", 0)):
        assert main(["export", str(tmp_path / "cal.json"), str(tmp_path / name)]) == 0
        assert capsys.readouterr().out.count("- left out: SDs") == notes
    np.testing.assert_allclose(record["plus_image_to_probe"], found.plus_matrix(), atol=1e-12)
    # The error of X in its own frame, X Exp(d), against the stated covariance.
    error = np.linalg.inv(found.image_plane_to_probe) @ truth.image_plane_to_probe
    turned = Rotation.from_matrix(error[:3, :3]).as_rotvec()
    deviation = np.concatenate([error[:3, 3], turned])
    squared = deviation @ np.linalg.solve(found.covariance, deviation)
    assert squared < stats.chi2.ppf(0.999, 6)
    assert np.abs(turned).max() < np.radians(3)
    np.testing.assert_allclose(found.scale_mm_per_px, truth.scale_mm_per_px, rtol=0.02)
    # Whoever trusts PLUS's matrix finds the target's pixels where they are.
    pixels = np.array([[COLUMN + WIDE / 2, ROW + HIGH / 2]])
    applied = found.apply(pixels)
    sd = np.sqrt(np.trace(applied.covariance[0]))
    assert np.linalg.norm(applied.points - truth.apply(pixels).points) < 4 * sd < 4


def test_only_recordings_are_replaced(tmp_path, capsys):
    """Another program's HDF5 file is not, and nor is a file that is read beside the sources."""
    import h5py

    table = tmp_path / "table.csv"
    pose = "1,0,0,0,0,1,0,0,0,0,1,0"
    head = ",".join(f"m{i}{j}" for i in range(3) for j in range(4))
    table.write_text(f"{head},u,v\n" + "".join(f"{pose},{k},{k + 1}\n" for k in range(4)))
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["TransformGroup"] = [1.0]
    before = other.read_bytes()
    assert main(["import", str(table), str(other)]) == 2
    assert "is not a recording" in capsys.readouterr().err
    assert other.read_bytes() == before
    # A scan of TUS-REC is HDF5, too: what makes a recording of it is said.
    assert main(["calibrate", str(other)]) == 2
    assert "no attribute format, 'jaxcal-recording' is needed (jaxcal import makes" in (
        capsys.readouterr().err
    )
    assert main(["import", str(table), str(tmp_path / "own.h5")]) == 0
    assert main(["import", str(table), str(tmp_path / "own.h5")]) == 0


def test_images_are_added_to_a_recording(tmp_path, capsys):
    """Also fewer than a recording of its own needs: what is added most often is one to three."""
    lines = table(NAMES, COLUMNS)
    (tmp_path / "all.csv").write_text("\n".join(lines))
    (tmp_path / "more.csv").write_text("\n".join([lines[0], *lines[5:]]))
    later = table(NAMES, [PIXELS + 1, *COLUMNS[1:]])
    for name, rows in (("all", lines), ("first", lines[:5]), ("second", [lines[0], *later[3:]])):
        (tmp_path / f"{name}.csv").write_text("\n".join(rows))
        assert main(["import", *(str(tmp_path / name) + end for end in (".csv", ".h5"))]) == 0
    first, more, second, out = (
        str(tmp_path / name) for name in ("first.h5", "more.csv", "second.h5", "out.h5")
    )
    assert main(["import", more, out]) == 2
    assert main(["import", more, out, "--add-to", first]) == 0
    assert "- 2 images added to the 4 of " in capsys.readouterr().out
    both, whole = jaxcal.load(out).calibration, jaxcal.load(tmp_path / "all.h5").calibration
    np.testing.assert_allclose(both.poses, whole.poses, atol=1e-12)
    np.testing.assert_array_equal(both.measurements, whole.measurements)
    # Numbers of frames would be those of two files.
    numbered = replace(jaxcal.load(first).calibration, frame=np.arange(4))
    more_numbered = replace(whole, frame=np.arange(6))
    assert joined(Recording(numbered), Recording(more_numbered)).calibration.frame is None
    assert main(["import", second, out, "--add-to", first]) == 0
    assert len(jaxcal.load(out)) == 8

    whole = jaxcal.load(first)
    bounded = replace(
        whole.calibration, max_elevation=np.ones(4), amplitude=np.ones(4), velocity=np.ones((4, 6))
    )
    jaxcal.save(replace(whole, calibration=bounded), tmp_path / "bounded.h5")
    assert main(["import", more, out, "--add-to", str(tmp_path / "bounded.h5")]) == 0
    assert "- bounds on the offsets, amplitudes are left out" in capsys.readouterr().out
    moving = np.isfinite(jaxcal.load(out).calibration.velocity).all(axis=1)
    assert moving.tolist() == [True] * 4 + [False] * 2

    # A single image, with the time of its pose.
    row = [np.array([9.0]), PIXELS[3:4] + 1, TRANSLATIONS[3:4] + 5, QUATERNIONS[3:4]]
    (tmp_path / "one.csv").write_text("\n".join(table(["time", *NAMES], row)))
    assert main(["import", str(tmp_path / "one.csv"), out, "--add-to", first]) == 0
    assert len(jaxcal.load(out)) == 5

    def refused(*arguments: str) -> str:
        assert main(["import", *arguments]) == 2
        return capsys.readouterr().err

    assert "is an input of this command" in refused(more, first, "--add-to", first)
    # Images that are added twice would count twice.
    assert "4 of its 4 images are in " in refused(first, out, "--add-to", first)
    again = str(tmp_path / "all.csv")
    assert "4 of its 6 images are in " in refused(again, out, "--add-to", first)
    assert "only --add-to goes with it" in refused(second, out, "--add-to", first, "--from", "A")
    sized = (more, out, "--add-to", first, "--spacing", "0.1", "0.1")
    assert "their pixels must be of one size" in refused(*sized)
    assert "it holds points, not pixels" in refused(more, out, "--add-to", first, "--units", "mm")
    assert "no such file" in refused(str(tmp_path / "none.h5"), out, "--add-to", first).lower()
