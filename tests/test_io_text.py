"""Text recordings: the cross-wire pair and comma-separated tables."""

from pathlib import Path

import numpy as np
import pytest
from conftest import random_poses
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import FormatError, InputError
from jaxcal.io import lines as text_files
from jaxcal.io import table
from jaxcal.io.importing.files import import_files
from jaxcal.io.importing.frame_poses import tool_poses
from jaxcal.io.importing.sources import ImportOptions, kind_of
from jaxcal.io.slicer import read_markups
from jaxcal.io.text import read_crosswire, read_pose_table, recording_of
from jaxcal.io.trackers import read_tracker

CROSSWIRE = Path(__file__).parents[2] / "shared" / "data" / "crosswire"


def read_csv(path, spacing_mm=None, **options):
    return recording_of(read_pose_table(path, **options), spacing_mm)


def header(rows=3):
    return "time_s," + ",".join(f"m{i}{j}" for i in range(rows) for j in range(4)) + ",u,v"


HEADER = header()


def csv_lines(count=5, rows=3, seed=0):
    generator = np.random.default_rng(seed)
    poses = random_poses(count, generator)
    points = generator.uniform(10, 500, (count, 2))
    time = np.arange(count) / 30
    table = np.column_stack([time, poses[:, :rows].reshape(count, -1), points])
    return [",".join(map(repr, row)) for row in table.tolist()], poses, points, time


@pytest.fixture
def pair(tmp_path):
    generator = np.random.default_rng(1)
    poses = random_poses(6, generator)
    pixels = generator.integers(0, 600, (6, 2)).astype(float)
    rows = [" ".join(map(repr, row)) for row in poses[:, :3].reshape(-1, 4).tolist()]
    (tmp_path / "poses.txt").write_text("\n".join(rows) + "\n")
    (tmp_path / "points.txt").write_text("".join(f"{u}\t{v}\n" for u, v in pixels))
    return tmp_path / "poses.txt", tmp_path / "points.txt", poses, pixels


def test_crosswire_pair(pair):
    recording = read_crosswire(*pair[:2], spacing_mm=(0.15, 0.14))
    images = recording.calibration
    assert images.kind == "pixel"
    np.testing.assert_allclose(images.poses, pair[2], atol=1e-12)
    np.testing.assert_array_equal(images.measurements, pair[3])
    np.testing.assert_array_equal(images.spacing_mm, [0.15, 0.14])
    assert recording.source == f"{pair[0]} with {pair[1]}"
    assert read_crosswire(str(pair[0]), str(pair[1])).calibration.spacing_mm is None


def test_real_crosswire_recording():
    if not CROSSWIRE.exists():
        pytest.skip("the cross-wire recording is not beside this checkout")
    names = ("crossWirePhantomTransformations.txt", "crossWirePhantom2DPoints.txt")
    images = read_crosswire(*(CROSSWIRE / name for name in names)).calibration
    given_rows = np.loadtxt(CROSSWIRE / names[0]).reshape(54, 3, 4)
    assert len(images) == 54
    np.testing.assert_array_equal(images.measurements, np.loadtxt(CROSSWIRE / names[1]))
    np.testing.assert_array_equal(images.poses[:, :3, 3], given_rows[:, :, 3])
    np.testing.assert_allclose(images.poses[:, :3, :3], given_rows[:, :, :3], atol=1e-3)
    gram = images.poses[:, :3, :3].swapaxes(1, 2) @ images.poses[:, :3, :3]
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (54, 1, 1)), atol=1e-12)


def test_whole_matrices_are_poses_too(pair):
    """MATLAB's users stack 4x4 matrices; no row of a rotation is zero."""
    rows = pair[0].read_text().splitlines()
    whole = [line for k in range(0, 18, 3) for line in (*rows[k : k + 3], "0 0 0 1")]
    pair[0].write_text("\n".join(whole))
    np.testing.assert_allclose(read_crosswire(*pair[:2]).calibration.poses, pair[2], atol=1e-12)
    pair[0].write_text("\n".join([*whole[:-1], "0 0 0 2"]))
    with pytest.raises(FormatError, match="8 poses but 6 points"):
        read_crosswire(*pair[:2])
    np.savetxt(pair[0], pair[2].swapaxes(1, 2).reshape(-1, 4))
    with pytest.raises(FormatError, match=r"poses\.txt:4: the matrices are transposed"):
        read_crosswire(*pair[:2])


@pytest.mark.parametrize("rows", [12, 16, 4])
@pytest.mark.parametrize("comma", [",", ", ", ";"])
def test_a_pair_may_have_a_matrix_in_a_row_and_commas(pair, rows, comma):
    """As numpy.savetxt and MATLAB's writematrix write arrays of matrices."""
    poses = pair[2][:, :3] if rows != 16 else pair[2]
    np.savetxt(pair[0], poses.reshape(-1, rows), delimiter=comma)
    np.savetxt(pair[1], pair[3], delimiter=comma)
    images = read_crosswire(*pair[:2], pose_units="cm").calibration
    np.testing.assert_allclose(images.poses[:, :3, :3], pair[2][:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(images.poses[:, :3, 3], 10 * pair[2][:, :3, 3], atol=1e-9)
    np.testing.assert_array_equal(images.measurements, pair[3])


@pytest.mark.parametrize("rows", [12, 16, 4])
@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_points_of_a_pair_may_have_a_header(pair, rows, order):
    """Poses as MATLAB writes them, and points that were picked in another program."""
    poses = pair[2][:, :3] if rows != 16 else pair[2]
    np.savetxt(pair[0], poses.reshape(-1, rows), delimiter=",")
    lines = [",".join(np.array(["u", "v"])[order])]
    lines += [",".join(map(repr, row)) for row in pair[3][:, order].tolist()]
    pair[1].write_text("\n".join(lines))
    images = import_files(pair[:2]).recording.calibration
    np.testing.assert_allclose(images.poses, pair[2], atol=1e-12)
    np.testing.assert_array_equal(images.measurements, pair[3])
    assert images.kind == "pixel"
    assert images.frame is None


@pytest.mark.parametrize(
    ("header", "told"),
    [
        ("frame,u,v", "its header names other columns than u and v, but .*poses.txt has no header"),
        ("time,u,v", "other columns .* keep u and v alone, one point for each pose in the same"),
        ("u,v,valid", "other columns"),
        ("u [mm],v [mm]", "its header says that points are in mm, but .*poses.txt has no header"),
        ("lateral,range", "its header says that points are in mm"),
        ("m11,m12", "columns 1 .'m11'. and 2 .'m12'. are not known"),
        ("x,y", "points in the image are named u and v"),
    ],
)
def test_headers_of_points_that_poses_without_one_do_not_go_with(pair, header, told):
    np.savetxt(pair[0], pair[2].reshape(-1, 16), delimiter=",")
    row = ",".join(["1"] * len(header.split(",")))
    pair[1].write_text("\n".join([header, *[row] * 6]))
    with pytest.raises(FormatError, match=rf"points\.txt: .*{told}"):
        import_files(pair[:2])


def test_a_pair_may_have_decimal_commas(pair):
    for path in pair[:2]:
        path.write_text(path.read_text().replace(".", ","))
    np.testing.assert_allclose(read_crosswire(*pair[:2]).calibration.poses, pair[2], atol=1e-12)


def test_crosswire_rows_that_are_not_whole_poses(pair):
    lines = pair[0].read_text().splitlines()
    pair[0].write_text("# comment\n\n" + "\n".join(lines[:-1]))
    with pytest.raises(FormatError, match=r"poses\.txt:19: 17 rows are not whole poses"):
        read_crosswire(*pair[:2])


def test_crosswire_counts_differ(pair):
    lines = pair[1].read_text().splitlines()
    pair[1].write_text("\n".join(lines[:-1]))
    with pytest.raises(FormatError, match=r"poses\.txt with .*points\.txt: 6 poses but 5 points"):
        read_crosswire(*pair[:2])


def test_crosswire_files_exchanged(pair):
    with pytest.raises(FormatError, match=r"points\.txt:1: 2 columns; 4 or 12 or 16 are needed"):
        read_crosswire(pair[1], pair[0])


def test_crosswire_reflection_names_the_file(pair):
    flipped = np.diag([-1.0, 1, 1]) @ pair[2][:, :3]
    np.savetxt(pair[0], flipped.reshape(-1, 4))
    with pytest.raises(InputError, match=r"^.*poses\.txt with .*: pose 0 is a reflection"):
        read_crosswire(*pair[:2])


@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(4, 9),
    rows=st.sampled_from([3, 4]),
    named=st.booleans(),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    mark=st.sampled_from(["", "\ufeff"]),
)
def test_csv_round_trip(tmp_path_factory, seed, count, rows, named, end, mark):
    lines, poses, points, time = csv_lines(count, rows, seed)
    if named:
        lines.insert(0, header(rows))
    lines[1:1] = ["", "  # a comment, with commas", "   "]
    path = tmp_path_factory.mktemp("csv") / "table.csv"
    path.write_bytes((mark + end.join(lines)).encode())
    images = read_csv(path).calibration
    assert images.kind == "pixel"
    np.testing.assert_allclose(images.poses, poses, atol=1e-12)
    np.testing.assert_array_equal(images.measurements, points)
    np.testing.assert_array_equal(images.time, time)


def test_csv_units(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("\n".join(csv_lines()[0]))
    assert read_csv(path, units="mm").calibration.kind == "point"
    spaced = read_csv(path, spacing_mm=(0.1, 0.2)).calibration
    np.testing.assert_array_equal(spaced.spacing_mm, [0.1, 0.2])
    with pytest.raises(InputError, match="belongs to pixels"):
        read_csv(path, units="mm", spacing_mm=(0.1, 0.2))


def edited(line, column, value):
    fields = line.split(",")
    fields[column] = value
    return ",".join(fields)


@pytest.mark.parametrize("value", ["x", "1_000", "0x10", "1.5.", "--1", "1 2"])
def test_csv_slip_names_line_and_column(tmp_path, value):
    lines = csv_lines()[0]
    lines[2] = edited(lines[2], 4, value)
    path = tmp_path / "table.csv"
    path.write_text("\n".join([HEADER, "", *lines]))
    with pytest.raises(FormatError, match=r"table\.csv:5: column 5 \('m03'\) is not a number: '"):
        read_csv(path)


def test_csv_slip_in_the_first_row_is_not_a_header(tmp_path):
    lines = csv_lines()[0]
    path = tmp_path / "table.csv"
    path.write_text("\n".join([edited(lines[0], 0, "t"), *lines[1:]]))
    with pytest.raises(FormatError, match=r"table\.csv:1: column 1 is not a number: 't'"):
        read_csv(path)


def test_csv_only_one_header(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("\n".join([HEADER, HEADER, *csv_lines()[0]]))
    with pytest.raises(FormatError, match=r"table\.csv:2: column 14 \('u'\) is not a number: 'u'"):
        read_csv(path)


@pytest.mark.parametrize("delimiter", [",", " ", ";"])
def test_a_header_that_numpy_made_a_comment(tmp_path, delimiter):
    path = tmp_path / "table.csv"
    names = ["v", "u", "z", "y", "x", "qw", "qx", "qy", "qz", "time"]
    rows = np.array([[9 - k, k, 3, 20 * k, 9 * k, 1, 0, 0, 0, k] for k in range(1, 9)], float)
    np.savetxt(path, rows, delimiter=delimiter, header="of the probe\n" + delimiter.join(names))
    images = read_csv(path).calibration
    np.testing.assert_allclose(images.poses[:, :3, 3], rows[:, [4, 3, 2]])
    np.testing.assert_allclose(images.measurements, rows[:, [1, 0]])
    tracked = tool_poses(path, ImportOptions())[0]
    np.testing.assert_allclose(tracked[:, :3, 3], rows[:, [4, 3, 2]])
    words = delimiter.join(["ten", "words", "for", "u", "and", "v", "are", "not", "a", "header"])
    for header in ("of the probe", words):
        np.savetxt(path, rows, delimiter=delimiter, header=header)
        with pytest.raises(FormatError, match="10 columns hold a quaternion: say whether"):
            read_csv(path)


@pytest.mark.parametrize(
    ("start", "mark", "parts"),
    [
        ("pose", ".", ("position", "orientation")),
        ("field.pose.pose", ".", ("position", "orientation")),
        ("/tracker/transform", "/", ("translation", "rotation")),
    ],
)
def test_a_header_of_paths_in_ros_messages(tmp_path, start, mark, parts):
    names = [mark.join((start, parts[0], axis)) for axis in "xyz"]
    names += [mark.join((start, parts[1], axis)) for axis in "wxyz"]
    rows = np.array([[k, 3 * k, 1, 1, 0, 0, 0, 9 - k, k, 1e9 * k] for k in range(1, 7)])
    path = tmp_path / "table.csv"
    header = ",".join([*names, "u", "v", "%time"])
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    images = recording_of(read_pose_table(path, pose_units="m")).calibration
    np.testing.assert_allclose(images.poses[:, :3, 3], 1000 * rows[:, :3])
    np.testing.assert_allclose(images.time, range(1, 7))
    np.testing.assert_allclose(images.poses[:, :3, :3], np.tile(np.eye(3), (6, 1, 1)))


def test_the_header_of_a_ros_message_gives_the_time(tmp_path):
    """As ``rostopic echo -p`` writes it; from a bag, ``%time`` is the time of the recording."""
    path, start = tmp_path / "table.csv", 1_600_000_000
    names = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    names += [f"field.pose.position.{axis}" for axis in "xyz"]
    names += [f"field.pose.orientation.{axis}" for axis in "xyzw"]
    rows = [f"{start}500000000,{k},{start + k}000000000,camera,1,2,{k},0,0,0,1" for k in range(6)]
    path.write_text("\n".join([",".join(names), *rows]))
    table = read_pose_table(path, pose_units="m")
    np.testing.assert_allclose(table.time, start + np.arange(6), atol=1e-6)
    assert table.time_stated
    assert table.frame is None
    told = "columns that are not read: '%time', 'field.header.seq', 'field.header.frame_id'"
    assert table.notes == [f"{path}: {told}"]
    names[0], names[1] = "field.header.stamp", "%time"
    path.write_text("\n".join([",".join(names), *rows]))
    with pytest.raises(FormatError, match="columns 1 and 3 are both time"):
        read_pose_table(path)
    # As bagpy writes it.
    names[:4] = "Time", "header.stamp.secs", "header.stamp.nsecs", "header.frame_id"
    names[4:] = [name.removeprefix("field.") for name in names[4:]]
    rows = [f"{start + 9},{start + k},{k}00000000,camera,1,2,{k},0,0,0,1" for k in range(6)]
    path.write_text("\n".join([",".join(names), *rows]))
    table = read_pose_table(path, pose_units="m")
    np.testing.assert_allclose(table.time, start + 1.1 * np.arange(6), atol=1e-6)
    assert table.notes == [f"{path}: columns that are not read: 'Time', 'header.frame_id'"]
    path.write_text(
        "\n".join([",".join(["frame", *names[1:]]), *rows]).replace("header.stamp.secs", "comment")
    )
    with pytest.raises(FormatError, match="nanoseconds of a time, but not its seconds"):
        read_pose_table(path)


def test_a_header_of_points_that_are_named_as_positions(tmp_path):
    (tmp_path / "table.csv").write_text("frame,x,y\n0,1,2\n")
    with pytest.raises(FormatError, match=r"x, y but not all of x, y and z \(points in the image"):
        read_pose_table(tmp_path / "table.csv")


def test_a_header_of_imagej_is_told_how_to_convert(tmp_path):
    (tmp_path / "table.csv").write_text(" ,Area,X,Y,Slice\n1,0,9.5,2,1\n")
    with pytest.raises(FormatError, match=r"column 5, 'Slice', is .* Take 1 from each slice"):
        read_pose_table(tmp_path / "table.csv")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda lines: [line + ",1" for line in lines],
            r":1: 16 columns without a header; 15 or 19",
        ),
        (lambda lines: [*lines[:3], lines[3] + ",1"], r":4: 16 columns, the rows before have 15"),
        (lambda lines: [*lines, *csv_lines(rows=4)[0]], r":6: 19 columns, the rows before have 15"),
        (lambda lines: [line.replace(",", " ", 3) for line in lines], r":1: 12 columns without"),
        (lambda lines: [HEADER], r": holds no rows of numbers"),
        (lambda lines: ["# nothing", "  "], r": holds no rows of numbers"),
        (lambda lines: [], r": is empty"),
        (lambda lines: [*lines, "1,2\0,3"], r":6: is not text .*zero byte"),
        (lambda lines: ["\0" + "1,2,3"], r":1: is not text .*zero byte"),
        (lambda lines: lines[:3], r": 3 used images are too few"),
        (lambda lines: [edited(lines[0], 3, "nan"), *lines], r":1: column 4 is nan"),
        (lambda lines: [edited(lines[0], 0, "inf"), *lines], r":1: column 1 is inf"),
    ],
)
def test_csv_refusals(tmp_path, change, message):
    path = tmp_path / "table.csv"
    path.write_text("\n".join(change(csv_lines()[0])))
    with pytest.raises(InputError, match=r"table\.csv" + message) as caught:
        read_csv(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"1,2\n\xff\xfe\n", "µ,\n\n".encode("utf-16"), b"\x89HDF\r\n"])
def test_csv_that_is_not_text(tmp_path, content):
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=r"table\.csv:[12]: is not text"):
        read_csv(path)


def test_the_kind_of_a_file_is_told_from_its_first_line(tmp_path):
    """Not from all of a large file: a damaged place far behind is not even looked at."""
    path = tmp_path / "table.csv"
    path.write_bytes(b"u,v\n" + b"1,2\n" * 100_000 + b"1,\xff\n")
    assert (kind_of(path), table.first_line(path)) == ("table", (",", True))
    with pytest.raises(FormatError, match=r"table\.csv:100002: is not text in UTF-8"):
        read_pose_table(path)


def test_points_between_thousands_are_not_read_as_decimal_signs(tmp_path):
    """A German spreadsheet writes -1686 as -1.686, beside 107,5: it was read as -1.686."""
    path = tmp_path / "table.csv"
    path.write_text("u;v\n107,5;1.686\n")
    with pytest.raises(FormatError, match=r"table\.csv:2: numbers have commas and points"):
        read_pose_table(path)
    for rows in ("107,5;686\n", "107.5;1.686\n"):
        path.write_text("u;v\n" + rows)
        assert len(read_pose_table(path)) == 1


def test_controls_in_a_slip_are_escaped(tmp_path):
    lines = csv_lines()[0]
    path = tmp_path / "table.csv"
    path.write_text("\n".join([edited(lines[0], 1, "\x1b[31m" + "x" * 1000), *lines]))
    with pytest.raises(FormatError) as caught:
        read_csv(path)
    assert "\x1b" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 120


def test_too_large_a_file_is_not_read(tmp_path):
    path = tmp_path / "table.csv"
    with open(path, "wb") as file:
        file.truncate(text_files.MAXIMUM_BYTES + 1)
    with pytest.raises(FormatError, match="too large"):
        read_csv(path)


def test_a_line_of_too_many_cells_is_not_read(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("u,v\n" + "1," * (text_files.LONGEST_LINE // 2) + "1\n")
    with pytest.raises(FormatError, match=r"table\.csv:2: is longer than 1048576 characters"):
        read_csv(path)


def test_a_table_of_too_many_rows_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "table.csv"
    monkeypatch.setattr(table, "MOST_ROWS", 3)
    path.write_text("u,v\n" + "1,2\n" * 3)
    assert len(read_pose_table(path)) == 3
    path.write_text("u,v\n" + "1,2\n" * 4)
    with pytest.raises(FormatError, match=r"table\.csv:5: more than 3 rows"):
        read_pose_table(path)


@pytest.mark.parametrize(
    ("name", "before", "read"),
    [
        ("t.csv", "u,v\n", table.read_table),
        ("t.csv", "", table.first_line),
        ("t.csv", "", read_tracker),
        ("p.fcsv", "", read_markups),
    ],
)
def test_a_cell_longer_than_the_module_csv_takes_is_named(tmp_path, name, before, read):
    line = 1 + before.count("\n")
    long = f'"{"1" * 140_000}",2\n'
    (tmp_path / name).write_text(before + long)
    with pytest.raises(FormatError, match=rf"{name}:{line}: field larger than field limit"):
        read(tmp_path / name)


def test_missing_directory_and_device(tmp_path):
    for path, message in (
        (tmp_path / "none", "no such file"),
        (tmp_path, "is a directory"),
        (Path("/dev/zero"), "not an ordinary file"),
        (tmp_path / "zero\0byte", "cannot be opened"),
    ):
        with pytest.raises(FormatError, match=message):
            read_csv(path)


def test_hdf5_in_the_place_of_text_is_told_as_what_it_is(tmp_path):
    """A recording that was given a name without .h5; an editor can save no such file as text."""
    path = tmp_path / "rec"
    path.write_bytes(b"\x89HDF\r\n\x1a\n\0\0")
    with pytest.raises(FormatError, match=r"rec: is HDF5, not text .*\.h5\)$"):
        read_pose_table(path)
