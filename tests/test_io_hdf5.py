"""Recordings in HDF5: what goes in comes out, and what is unsafe or wrong is refused."""

import dataclasses
import io
import os
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import random_poses
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import FormatError, InputError, MissingFileError, OutputError, load_calibration
from jaxcal.data.probe import LinearProbe
from jaxcal.data.recording import Images, MetresError, Recording, Truth, make_images
from jaxcal.io import hdf5, untrusted
from jaxcal.io.hdf5 import load, save
from jaxcal.study.results import open_results

ROOT = Path(__file__).parents[1]
COUNT = 6
OPTIONAL = ("mask", "covariance", "max_elevation", "amplitude", "time", "velocity")


def random_images(generator, kind, count, optional, elements=8):
    measurements = {
        "point": generator.uniform(5, 80, (count, 2)),
        "pixel": generator.integers(0, 600, (count, 2)).astype(float),
        "time_of_flight": generator.uniform(1e-5, 6e-5, (count, elements)),
    }[kind]
    if kind == "time_of_flight":
        measurements[generator.random(measurements.shape) < 0.2] = np.nan
    mask = generator.random(count) < 0.7
    mask[:4] = True
    factors = generator.normal(size=(count, 2, 2))
    values = {
        "mask": mask,
        "covariance": factors @ factors.swapaxes(1, 2) + np.eye(2),
        "max_elevation": generator.uniform(0, 3, count),
        "amplitude": generator.uniform(0, 4096, count),
        "time": np.sort(generator.uniform(0, 60, count)),
        "velocity": np.where(
            np.arange(count)[:, None] == 1, np.nan, generator.normal(size=(count, 6))
        ),
    }
    if kind == "pixel":
        values |= {"spacing_mm": generator.uniform(0.05, 0.3, 2), "frame_size": (640, 640)}
    if kind != "time_of_flight":
        values["face_offset_mm"] = 1.25
    chosen = {name: value for name, value in values.items() if name in optional}
    return make_images(random_poses(count, generator), measurements, kind, **chosen)


def random_recording(seed=0, kind="point", count=COUNT, optional=(), parts=("test", "truth")):
    generator = np.random.default_rng(seed)
    return Recording(
        calibration=random_images(generator, kind, count, optional),
        test=random_images(generator, kind, 5, optional) if "test" in parts else None,
        truth=Truth(
            random_poses(1, generator)[0],
            generator.normal(size=3) * 100,
            generator.uniform(-2, 2, count),
        )
        if "truth" in parts
        else None,
        probe=LinearProbe(8, 0.5, 1500.0) if kind == "time_of_flight" else None,
    )


def assert_same(first, second):
    assert type(first) is type(second)
    for field in dataclasses.fields(first):
        if not field.compare:
            continue
        one, other = getattr(first, field.name), getattr(second, field.name)
        if isinstance(one, Images | Truth | LinearProbe):
            assert_same(one, other)
        elif isinstance(one, np.ndarray):
            assert one.dtype == other.dtype
            if field.name in ("poses", "image_to_probe"):  # projected to SO(3) once more
                np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
            else:
                np.testing.assert_array_equal(one, other)
        else:
            assert one == other, field.name


@pytest.fixture
def path(tmp_path):
    """The smallest valid recording, as any other program would write it."""
    path = tmp_path / "rec.h5"
    generator = np.random.default_rng(3)
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "jaxcal-recording"
        file.attrs["version"] = 1
        file["calibration/pose"] = random_poses(COUNT, generator)
        file["calibration/point"] = generator.uniform(5, 80, (COUNT, 2))
    return path


def put(group, name, *arguments, **options):
    """Make a dataset, in the place of one that is there."""
    if name in group:
        del group[name]
    return group.create_dataset(name, *arguments, **options)


def add_probe(file, elements):
    values = {"kind": "linear", "elements": elements, "pitch_mm": 0.1, "sound_speed_m_s": 1490.0}
    file.create_group("probe").attrs.update(values)


def refused(path, message, error=FormatError):
    with pytest.raises(error, match=message) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert type(caught.value) in (InputError, FormatError, MetresError, MissingFileError)
    return str(caught.value)


# -- round trips


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["point", "pixel", "time_of_flight"]),
    count=st.integers(4, 12),
    optional=st.sets(st.sampled_from([*OPTIONAL, "spacing_mm", "face_offset_mm", "frame_size"])),
    parts=st.sets(st.sampled_from(["test", "truth"])),
)
def test_round_trip(tmp_path_factory, seed, kind, count, optional, parts):
    path = tmp_path_factory.mktemp("round") / "rec.h5"
    recording = random_recording(seed, kind, count, optional, parts)
    save(recording, path)
    loaded = load(path)
    assert_same(recording, loaded)
    assert loaded.source == str(path)


def test_smallest_recording(path):
    recording = load(str(path))
    with h5py.File(path) as file:
        np.testing.assert_array_equal(
            recording.calibration.measurements, file["calibration/point"][()]
        )
    assert recording.calibration.kind == "point"
    assert recording.test is recording.truth is recording.probe is None


def test_saved_file_is_marked_and_has_units(tmp_path):
    path = tmp_path / "rec.h5"
    save(random_recording(kind="pixel", optional=OPTIONAL), path)
    units = {}
    with h5py.File(path) as file:
        assert file.attrs["format"] == "jaxcal-recording"
        assert file.attrs["version"] == 1
        assert file.attrs["complete"]
        file.visititems(
            lambda name, item: (
                units.update({name: item.attrs["units"]})
                if isinstance(item, h5py.Dataset)
                else None
            )
        )
    assert units.pop("calibration/pixel") == "px"
    assert units.pop("calibration/covariance") == "px^2"
    assert units.pop("calibration/time") == "s"
    assert units.pop("calibration/velocity") == "mm/s, rad/s"
    assert {name for name in units if units[name] == "mm"} >= {
        "calibration/pose",
        "calibration/max_elevation",
        "truth/point",
    }
    assert all(units.values())
    assert os.listdir(tmp_path) == ["rec.h5"]


def test_same_recording_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        save(random_recording(), tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_other_programs_types(path):
    """float32 and big-endian numbers, integers for booleans, fixed-length text, [1] for scalars."""
    with h5py.File(path, "r+") as file:
        calibration = file["calibration"]
        expected = calibration["pose"][()].astype(np.float32).astype(np.float64)
        put(calibration, "pose", data=expected.astype(">f4"))
        put(calibration, "mask", data=np.array([1, 1, 1, 1, 1, 0], np.uint8))
        put(calibration, "time", data=np.arange(COUNT, dtype=np.int16))
        file.attrs["format"] = np.bytes_(b"jaxcal-recording")
        file.attrs["version"] = np.array([1.0])
        file.attrs["complete"] = np.array([1], np.uint8)
        calibration["point"].attrs["units"] = np.bytes_(b"millimetre")
    images = load(path).calibration
    np.testing.assert_array_equal(images.poses[:5, :3, 3], expected[:5, :3, 3])
    assert images.mask.tolist() == [True] * 5 + [False]
    assert images.time is not None
    np.testing.assert_array_equal(images.time[:5], np.arange(5))


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "gzip", "shuffle": True, "fletcher32": True},
        {"chunks": (2, 4, 4), "maxshape": (None, 4, 4)},
        {"fletcher32": True},
    ],
)
def test_chunked_and_packed_data(path, options):
    expected = load(path).calibration.poses
    with h5py.File(path, "r+") as file:
        put(file["calibration"], "pose", data=file["calibration/pose"][()], **options)
    np.testing.assert_allclose(load(path).calibration.poses, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("values", ["random", "constant"])
def test_large_packed_chunks(tmp_path, values):
    generator = np.random.default_rng(0)
    elements, count = 1024, 300
    times = np.full((count, elements), 3e-5)
    if values == "random":
        times *= generator.uniform(0.5, 2, times.shape)
    path = tmp_path / "rec.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "jaxcal-recording", "version": 1})
        add_probe(file, elements)
        file["calibration/pose"] = random_poses(count, generator)
        file["calibration"].create_dataset(
            "time_of_flight", data=times, chunks=times.shape, compression="gzip"
        )
    np.testing.assert_array_equal(load(path).calibration.measurements, times)


def test_links_inside_the_file_are_followed(path):
    expected = load(path).calibration
    with h5py.File(path, "r+") as file:
        file.move("calibration/pose", "store/deep/pose")
        file.move("calibration/point", "store/measured")
        file["alias"] = h5py.SoftLink("/./store")
        file["calibration/pose"] = h5py.SoftLink("/alias//deep/pose")
        file["calibration/here"] = h5py.SoftLink(".")
        file["calibration/kept"] = file["store/measured"]
        file["calibration/point"] = h5py.SoftLink("here/kept")
    assert_same(expected, load(path).calibration)


def test_points_are_preferred_to_the_times_they_came_from(path):
    with h5py.File(path, "r+") as file:
        file["calibration/time_of_flight"] = np.full((COUNT, 8), 3e-5)
    assert load(path).calibration.kind == "point"


def test_scale_on_the_group(path):
    with h5py.File(path, "r+") as file:
        file.move("calibration/point", "calibration/pixel")
        file["calibration"].attrs["spacing_mm"] = [0.1, 0.2]
        file["calibration"].attrs["face_offset_mm"] = 2.0
    assert load(path).calibration.face_offset_mm == 2.0
    with h5py.File(path, "r+") as file:
        file["calibration/pixel"].attrs["face_offset_mm"] = 3.0
    images = load(path).calibration
    np.testing.assert_array_equal(images.spacing_mm, [0.1, 0.2])
    assert images.face_offset_mm == 3.0


# -- files that are no recordings


@pytest.mark.parametrize("content", [b"hello\n", b"\x89HDF\r\n\x1a\n", b"\0" * 4096])
def test_not_hdf5(tmp_path, content):
    (tmp_path / "rec.h5").write_bytes(content)
    refused(tmp_path / "rec.h5", "not an HDF5 file|truncated or damaged")


@pytest.mark.parametrize("read", [load, load_calibration, open_results])
def test_a_missing_file_is_told_as_python_tells_it(read, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.npz: no such f") as told:
        read(tmp_path / "none.npz")
    assert type(told.value) is MissingFileError


def test_missing_empty_directory_device_and_name(tmp_path):
    refused(tmp_path / "none.h5", "no such file")
    (tmp_path / "empty.h5").touch()
    refused(tmp_path / "empty.h5", "is empty")
    refused(tmp_path, "is a directory")
    refused(Path("/dev/zero"), "not an ordinary file")
    refused(tmp_path / "zero\0byte", "cannot be opened")


def test_unreadable_file():
    # Not tmp_path: its parents are closed to the ordinary user that a superuser becomes here.
    with tempfile.NamedTemporaryFile() as file:
        file.write(b"anything")
        file.flush()
        os.chmod(file.name, 0)
        superuser = os.geteuid() == 0
        if superuser:
            os.seteuid(65534)
        try:
            refused(Path(file.name), "cannot be opened: Permission denied")
        finally:
            if superuser:
                os.seteuid(0)


@pytest.mark.parametrize("part", [0.02, 0.3, 0.7, 0.999])
def test_truncated(path, part):
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    refused(path, "truncated|not an HDF5 file")


def test_file_that_is_being_written(path):
    with h5py.File(path, "r+", locking=True):
        code = "import sys; from jaxcal.io.hdf5 import load; load(sys.argv[1])"
        process = subprocess.run(
            [sys.executable, "-c", code, str(path)],
            env={**os.environ, "PYTHONPATH": str(ROOT), "HDF5_USE_FILE_LOCKING": "TRUE"},
            capture_output=True,
            text=True,
            check=False,
        )
    assert process.stderr.splitlines()[-1] == (
        f"jaxcal.FormatError: {path}: is being written: close it in the program that writes it"
    )


def test_corrupt_chunk(path):
    with h5py.File(path, "r+") as file:
        values = file["calibration/pose"][()]
        put(file["calibration"], "pose", data=values, chunks=values.shape, fletcher32=True)
        offset = file["calibration/pose"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[offset + 5] ^= 255
    path.write_bytes(content)
    refused(path, "calibration/pose cannot be read")


def test_damaged_bytes_never_escape_as_other_errors(path):
    with h5py.File(path, "r+") as file:
        # Fixed-length text: a damaged length of the other kind makes HDF5 allocate gigabytes.
        file.attrs["format"] = np.bytes_(b"jaxcal-recording")
    content = path.read_bytes()
    generator = np.random.default_rng(0)
    for _ in range(150):
        damaged = bytearray(content)
        # The object headers and heaps stand first; flipped data would only be other numbers.
        for position in generator.integers(8, 2500, 3):
            damaged[position] = generator.integers(256)
        path.write_bytes(damaged)
        message = None
        try:
            load(path)
        except InputError as error:
            message = str(error)
        assert message is None or (message.startswith(f"{path}: ") and "\n" not in message)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("format", None, "not a recording: it has no attribute format"),
        ("format", "other", "its format is 'other'"),
        ("format", "\x1b[31m" + "x" * 999, r"its format is '\\x1b\[31mx*\.\.\.'"),
        ("format", "x" * 2000, "attribute format is too long"),
        ("format", np.bytes_(b"x" * 2000), "attribute format is too long"),
        ("format", ["jaxcal-recording"] * 2, "attribute format must be text, 1 of it"),
        ("format", np.zeros(8000, "u1"), "attribute format must be text"),
        ("format", h5py.Empty("S10"), "attribute format must be text"),
        ("version", None, "attribute version must be a whole number"),
        ("version", 2, "is version 2 .* understands version 1: update"),
        ("version", 0, "attribute version must be a whole number"),
        ("version", 1.5, "attribute version must be a whole number"),
        ("version", np.nan, "attribute version must be a whole number"),
        ("version", np.inf, "attribute version must be a whole number"),
        ("version", "1", "attribute version must be a number"),
        ("version", [1, 1], "attribute version must be a number"),
        ("version", np.ones((40, 40)), "attribute version must be a number"),
        ("version", 1 + 0j, "attribute version must be a number"),
        ("complete", False, "marked incomplete"),
        ("complete", 0, "marked incomplete"),
        ("complete", 2, "attribute complete must be true or false"),
        ("complete", "yes", "attribute complete must be true or false"),
        ("complete", [True, True], "attribute complete must be true or false"),
        ("units", "m", "is in units 'm', mm is needed"),
    ],
)
def test_header(path, name, value, message):
    with h5py.File(path, "r+") as file:
        if name in file.attrs:
            del file.attrs[name]
        if value is not None:
            file.attrs[name] = value
    refused(path, message)


# -- contents that are wrong


@pytest.mark.parametrize(
    ("where", "unit", "right"),
    [
        ("calibration", "m", "mm"),
        ("calibration/pose", "m", "mm"),
        ("calibration/point", "px", "mm"),
        ("calibration/time", "ms", "s"),
        ("calibration/covariance", "mm", r"mm\^2"),
        ("calibration/max_elevation", "cm", "mm"),
        ("calibration/velocity", "m/s, rad/s", "mm/s, rad/s"),
    ],
)
def test_wrong_units(path, where, unit, right):
    with h5py.File(path, "r+") as file:
        file["calibration/time"] = np.arange(COUNT)
        file["calibration/covariance"] = np.tile(np.eye(2), (COUNT, 1, 1))
        file["calibration/max_elevation"] = np.ones(COUNT)
        file["calibration/velocity"] = np.full((COUNT, 6), np.nan)
        file[where].attrs["units"] = right.replace("\\", "")
    load(path)
    with h5py.File(path, "r+") as file:
        file[where].attrs["units"] = unit
    refused(path, f"/{where} is in units '{unit}', {right} is needed")


@pytest.mark.parametrize("units", [3.0, ["mm", "mm"], "x" * 5000])
def test_units_that_are_no_text(path, units):
    with h5py.File(path, "r+") as file:
        file["calibration/pose"].attrs["units"] = units
    refused(path, "/calibration/pose: attribute units")


def test_pixels_have_square_pixels_for_covariance(path):
    with h5py.File(path, "r+") as file:
        file.move("calibration/point", "calibration/pixel")
        file["calibration/covariance"] = np.tile(np.eye(2), (COUNT, 1, 1))
        file["calibration/covariance"].attrs["units"] = "mm^2"
    refused(path, r"covariance is in units 'mm\^2', px\^2 is needed")


def flip(pose):
    return np.diag([-1.0, 1, 1, 1]) @ pose


def with_nan(values):
    return np.where(
        np.arange(len(values)).reshape(-1, *[1] * (values.ndim - 1)) == 2, np.nan, values
    )


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("pose", flip, "/calibration: pose 0 is a reflection"),
        ("pose", with_nan, "/calibration: pose 2 holds NaN"),
        ("pose", lambda pose: pose.swapaxes(1, 2), "not a rigid transform"),
        ("pose", lambda pose: pose[:3], "3 poses but 6 rows of point"),
        ("point", with_nan, "/calibration: point 2 holds NaN"),
        ("point", lambda point: point * 1e-3, "points look like metres"),
        ("mask", lambda _: np.arange(COUNT), "mask must hold booleans"),
        ("mask", lambda _: np.arange(COUNT) < 3, "3 used images are too few"),
        ("mask", lambda _: np.ones(COUNT - 1, bool), r"mask must have shape \(6,\)"),
        ("time", lambda _: np.full(COUNT, np.inf), "time 0 .* is NaN or Inf"),
        ("max_elevation", lambda _: -np.ones(COUNT), "max_elevation 0 .* is negative"),
        ("velocity", lambda _: np.full((COUNT, 6), np.inf), "velocity 0 .* holds a number beyond"),
        ("amplitude", lambda _: np.ones(COUNT + 1), r"amplitude must have shape \(6,\)"),
        ("covariance", lambda _: np.zeros((COUNT, 2, 2)), "covariance 0 .* is not symmetric"),
        (
            "covariance",
            lambda _: np.full((COUNT, 2, 2), 1e-30) * np.eye(2),
            "covariance 0 .* has an SD below",
        ),
    ],
)
def test_unusable_values(path, name, change, message):
    with h5py.File(path, "r+") as file:
        group = file["calibration"]
        put(group, name, data=change(group[name][()] if name in group else None))
    refused(path, message, InputError)


def test_poses_in_metres(path):
    with h5py.File(path, "r+") as file:
        file["calibration/pose"][:, :3, 3] *= 1e-3
    refused(path, r"poses look like metres; give them in mm$", InputError)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("pose", np.zeros((COUNT, 4)), r"/calibration/pose has shape \(6, 4\), \(images, 4, 4\)"),
        ("pose", np.zeros((COUNT, 4, 5)), r"\(6, 4, 5\), \(images, 4, 4\) is needed"),
        ("pose", 1.0, r"has shape \(\), \(images, 4, 4\) is needed"),
        ("pose", h5py.Empty("f8"), "has shape None"),
        ("point", np.zeros((COUNT, 3)), r"\(6, 3\), \(images, 2\) is needed"),
        ("mask", np.zeros((COUNT, 1), bool), r"\(6, 1\), \(images,\) is needed"),
        ("pose", np.zeros((COUNT, 4, 4), complex), "has type 'complex128', numbers are needed"),
        ("pose", np.zeros((COUNT, 4, 4), bool), "has type 'bool', numbers are needed"),
        ("point", np.zeros((COUNT, 2), "S8"), r"has type '\|S8'"),
        ("point", np.zeros((COUNT, 2), "V8"), r"has type '\|V8'"),
        ("point", np.zeros(COUNT, [("u", "f8"), ("v", "f8")]), "numbers are needed"),
        ("point", np.full((COUNT, 2), "1", object), "has type 'object'"),
        ("mask", np.ones(COUNT), "has type 'float64', numbers or booleans are needed"),
    ],
)
def test_wrong_shapes_and_types(path, name, data, message):
    with h5py.File(path, "r+") as file:
        put(file["calibration"], name, data=data)
    refused(path, message)


def test_variable_length_enum_and_array_types(path):
    enumeration = h5py.enum_dtype({"A": 0, "B": 1}, basetype="i4")
    for dtype in (h5py.vlen_dtype("f8"), enumeration, np.dtype("(2,)f8"), h5py.ref_dtype):
        with h5py.File(path, "r+") as file:
            put(file["calibration"], "point", (COUNT, 2), dtype=dtype)
        refused(path, "/calibration/point has type .*, numbers are needed")


@pytest.mark.parametrize("where", ["dataset", "attribute"])
@pytest.mark.parametrize("damage", ["exponent", "size of the exponent"])
def test_numbers_that_numpy_does_not_have(path, where, damage):
    """Damaged descriptions of numbers end the process in a build of HDF5 with assertions."""
    kind = h5py.h5t.IEEE_F64LE.copy()
    if damage == "exponent":
        kind.set_ebias(1000)
    else:
        kind.set_fields(63, 50, 11, 0, 50)
    with h5py.File(path, "r+") as file:
        images = file["calibration"]
        if where == "dataset":
            space = h5py.h5s.create_simple((COUNT, 4, 4))
            values = images.pop("pose")[()]
            made = h5py.h5d.create(images.id, b"pose", kind, space)
            made.write(h5py.h5s.ALL, h5py.h5s.ALL, values)
        else:
            value = np.array(images.attrs.pop("face_offset_mm", 0.0))
            made = h5py.h5a.create(
                images.id, b"face_offset_mm", kind, h5py.h5s.create(h5py.h5s.SCALAR)
            )
            made.write(value)
    refused(path, "/calibration.* holds numbers of an unusual or damaged type")


@pytest.mark.parametrize("name", ["pose", "point"])
def test_groups_and_types_for_datasets(path, name):
    with h5py.File(path, "r+") as file:
        del file["calibration"][name]
        file["calibration"].create_group(name)
    refused(path, f"/calibration/{name} must be a dataset")
    with h5py.File(path, "r+") as file:
        del file["calibration"][name]
        file["calibration"][name] = np.dtype("f8")
    refused(path, f"/calibration/{name} is neither a group nor a dataset")


@pytest.mark.parametrize("name", ["calibration", "test", "truth", "probe"])
def test_datasets_for_groups(path, name):
    with h5py.File(path, "r+") as file:
        put(file, name, data=1.0)
    refused(path, f"/{name} must be a group")


def test_missing_parts(path):
    with h5py.File(path, "r+") as file:
        file.move("calibration", "other")
    refused(path, "has no /calibration")
    with h5py.File(path, "r+") as file:
        file.move("other", "calibration")
        file.move("calibration/pose", "calibration/poses")
    refused(path, "/calibration/pose is missing")
    with h5py.File(path, "r+") as file:
        del file["calibration/point"]
    refused(path, "must hold one of point, pixel, time_of_flight; it has none")


def test_contradicting_measurements(path):
    with h5py.File(path, "r+") as file:
        file["calibration/pixel"] = file["calibration/point"][()]
    refused(path, "one of .*; it has point and pixel")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("spacing_mm", 0.1, "attribute spacing_mm must be a number, 2 of it"),
        ("spacing_mm", [0.1, 0.1, 0.1], "attribute spacing_mm must be a number, 2 of it"),
        ("spacing_mm", ["a", "b"], "attribute spacing_mm must be a number"),
        ("spacing_mm", [0.1, -0.1], "two positive numbers"),
        ("spacing_mm", [0.1, np.nan], "two positive numbers"),
        ("face_offset_mm", np.nan, "face_offset_mm must be finite"),
        ("frame_size", [640, 0], "frame_size must be two whole numbers"),
        ("frame_size", [640.5, 480], "frame_size must be two whole numbers"),
        ("frame_size", [np.nan, 480], "frame_size must be two whole numbers"),
        ("frame_size", [10, 10], "lies outside its frame of 10 x 10 px"),
        ("frame_size", 640, "attribute frame_size must be a number, 2 of it"),
        ("face_offset_mm", [1.0, 2.0], "attribute face_offset_mm must be a number"),
    ],
)
def test_bad_scale(path, name, value, message):
    with h5py.File(path, "r+") as file:
        file.move("calibration/point", "calibration/pixel")
        file["calibration/pixel"].attrs[name] = value
    refused(path, message, InputError)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "curvilinear"}, "attribute radius_mm is missing"),
        ({"kind": "curvilinear", "radius_mm": -60.0}, "radius must be in mm"),
        ({"kind": "curvilinear", "radius_mm": 0.5}, "more than half way round"),
        ({"kind": "phased"}, "attribute kind is 'phased', 'linear' or 'curvilinear' is needed"),
        ({"delay_s": 0.5}, "delay_s must be in s"),
        ({"delay_s": np.nan}, "delay_s must be in s"),
        ({"kind": None}, "attribute kind is missing"),
        ({"elements": None}, "attribute elements is missing"),
        ({"elements": 8.5}, "must be a whole number"),
        ({"elements": 1}, "2 to 65536 elements"),
        ({"elements": 9}, "has 8 columns, /probe has 9 elements"),
        ({"elements": np.nan}, "attribute elements is missing or not finite"),
        ({"pitch_mm": 0.0}, "pitch_mm must be in mm"),
        ({"pitch_mm": [0.5, 0.5]}, "attribute pitch_mm must be a number"),
        ({"sound_speed_m_s": None}, "attribute sound_speed_m_s is missing"),
        ({"sound_speed_m_s": 1.49}, "sound speed must be in m/s"),
    ],
)
def test_probe(tmp_path, changes, message):
    path = tmp_path / "rec.h5"
    save(random_recording(kind="time_of_flight"), path)
    with h5py.File(path, "r+") as file:
        for name, value in changes.items():
            if value is None:
                del file["probe"].attrs[name]
            else:
                file["probe"].attrs[name] = value
    refused(path, message, InputError)


def test_times_of_flight_need_a_probe(path):
    with h5py.File(path, "r+") as file:
        del file["calibration/point"]
        file["calibration/time_of_flight"] = np.full((COUNT, 8), 3e-5)
    refused(path, "time_of_flight needs /probe")


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("truth/point", None, "/truth must hold image_to_probe, point and elevation"),
        ("truth/point", np.zeros(2), r"/truth/point has shape \(2,\), \(3,\) is needed"),
        ("truth/point", np.full(3, np.nan), "/truth holds NaN"),
        ("truth/elevation", np.zeros(COUNT + 1), "has 7 rows for 6 images"),
        ("truth/image_to_probe", np.diag([1.0, 1, -1, 1]), "image_to_probe 0 is a reflection"),
        ("test/point", None, "/test must hold one of"),
        ("test/pose", None, "/test/pose is missing"),
        ("test/pose", np.zeros((5, 4, 4)), "/test: pose 0 is not a rigid transform"),
        ("test/mask", np.zeros(5, bool), "/test: 0 used images are too few"),
    ],
)
def test_malformed_truth_and_test(tmp_path, name, data, message):
    path = tmp_path / "rec.h5"
    save(random_recording(), path)
    with h5py.File(path, "r+") as file:
        if data is None:
            del file[name]
        else:
            put(file, name, data=data)
    refused(path, message, InputError)


def test_one_test_image_is_enough(path):
    with h5py.File(path, "r+") as file:
        file["test/pose"] = file["calibration/pose"][:1]
        file["test/point"] = file["calibration/point"][:1]
    recording = load(path)
    assert recording.test is not None
    assert len(recording.test) == 1


# -- files that are unsafe


@pytest.mark.parametrize("name", ["calibration", "calibration/pose", "calibration/mask"])
@pytest.mark.parametrize("through", ["external", "soft", "soft chain", "soft path"])
@pytest.mark.parametrize("there", [True, False])
def test_links_out_of_the_file(path, tmp_path, name, through, there):
    other = tmp_path / "other.h5"
    if there:
        path.rename(tmp_path / "copy.h5")
        path.write_bytes((tmp_path / "copy.h5").read_bytes())
        (tmp_path / "copy.h5").rename(other)
    with h5py.File(path, "r+") as file:
        if name in file:
            del file[name]
        outside = h5py.ExternalLink(other.name, name)
        if through == "external":
            file[name] = outside
        elif through == "soft path":
            file["outside"] = h5py.ExternalLink(other.name, "/")
            file[name] = h5py.SoftLink("////" * 40 + f"outside/{name}")
        else:
            file["hidden/outside"] = outside
            file["hop"] = h5py.SoftLink("/hidden")
            target = "/hidden/outside" if through == "soft" else "/hop/outside"
            file[name] = h5py.SoftLink(target)
    refused(path, "is a link to outside the file")


def test_circular_and_dangling_links(path):
    with h5py.File(path, "r+") as file:
        file["calibration/mask"] = h5py.SoftLink("/calibration/mask")
    refused(path, "/calibration/mask is a circular or too deep chain of links")
    for target in ("/nowhere", "/calibration/pose/inside", "/nowhere/inside", "sibling"):
        with h5py.File(path, "r+") as file:
            del file["calibration/mask"]
            file["calibration/mask"] = h5py.SoftLink(target)
        refused(path, "/calibration/mask is a link that leads nowhere")


def test_growing_chain_of_links_ends(path):
    with h5py.File(path, "r+") as file:
        file["calibration/mask"] = h5py.SoftLink("mask/" * 5000 + "mask")
    started = time.process_time()
    refused(path, "circular or too deep")
    assert time.process_time() - started < 2


@pytest.mark.parametrize("there", [True, False])
def test_virtual_dataset(path, tmp_path, there):
    with h5py.File(path, "r+") as file:
        values = file["calibration/point"][()]
        layout = h5py.VirtualLayout((COUNT, 2), "f8")
        layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "point", (COUNT, 2))
        del file["calibration/point"]
        file["calibration"].create_virtual_dataset("point", layout)
    if there:
        with h5py.File(tmp_path / "other.h5", "w") as file:
            file["point"] = values
    refused(path, "/calibration/point is a virtual dataset")


@pytest.mark.parametrize("there", [True, False])
def test_external_storage(path, tmp_path, there):
    with h5py.File(path, "r+") as file:
        del file["calibration/point"]
        file["calibration"].create_dataset(
            "point", (COUNT, 2), "f8", external=[(tmp_path / "raw.bin", 0, COUNT * 16)]
        )
    if there:
        (tmp_path / "raw.bin").write_bytes(np.full((COUNT, 2), 30.0).tobytes())
    refused(path, "/calibration/point is stored in another file")


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("pose", (10**12, 4, 4), "claims 1000000000000 images; at most 100000 are read"),
        ("pose", (6, 10**6, 10**6), r"\(images, 4, 4\) is needed"),
        ("point", (10**12, 2), "claims 1000000000000 images"),
        ("mask", (10**12,), "claims 1000000000000 images"),
        ("time_of_flight", (6, 10**12), "claims 1000000000000 elements; at most 4096"),
        ("time_of_flight", (100_000, 4096), "claims 3276800000 bytes"),
    ],
)
def test_absurd_sizes(path, name, shape, message):
    with h5py.File(path, "r+") as file:
        add_probe(file, 8)
        if name == "time_of_flight":
            del file["calibration/point"]
        chunks = tuple(min(length, 64) for length in shape)
        put(file["calibration"], name, shape, "u1" if name == "mask" else "f8", chunks=chunks)
    assert path.stat().st_size < 20_000
    refused(path, message)


def test_absurd_chunks(path):
    with h5py.File(path, "r+") as file:
        put(file["calibration"], "time", (COUNT,), "f8", chunks=(10**8,), maxshape=(None,))
    refused(path, "bytes for an array or chunk of shape")
    with h5py.File(path, "r+") as file:
        del file["calibration/time"], file["calibration/point"]
        add_probe(file, 256)
        put(file["calibration"], "time_of_flight", (100_000, 256), "f8", chunks=(1, 1))
    refused(path, "too many chunks")


def test_inflating_chunk(path):
    """A packed chunk that would inflate far beyond what it should hold."""
    import zlib

    deflate = zlib.compressobj(9)
    bomb = b"".join(deflate.compress(b"\0" * 2**20) for _ in range(64)) + deflate.flush()
    with h5py.File(path, "r+") as file:
        dataset = put(file["calibration"], "time", (COUNT,), "f8", chunks=(6,), compression="gzip")
        dataset.id.write_direct_chunk((0,), bomb)
    refused(path, "compressed chunk larger than its contents")
    with h5py.File(path, "r+") as file:
        dataset = put(
            file["calibration"], "time", (COUNT,), "f8", chunks=(50_000,), maxshape=(None,),
            compression="gzip",
        )  # fmt: skip
        deflate = zlib.compressobj(9)
        bomb = b"".join(deflate.compress(b"\0" * 2**20) for _ in range(128)) + deflate.flush()
        dataset.id.write_direct_chunk((0,), bomb)
    refused(path, "inflates beyond its size")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"compression": "lzf"}, r"compressed by filter 32000 \('lzf'\), which is not read"),
        ({"scaleoffset": 3}, "compressed by filter 6 .*, which is not read"),
        ({"compression": 32015, "allow_unknown_filter": True}, "filter 32015 "),
    ],
)
def test_unknown_filters(path, options, message):
    with h5py.File(path, "r+") as file:
        values = file["calibration/pose"][()]
        if "allow_unknown_filter" in options:
            put(file["calibration"], "pose", values.shape, "f8", chunks=values.shape, **options)
        else:
            put(file["calibration"], "pose", data=values, **options)
    refused(path, message)


def create_with_filters(group, name, codes):
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk((COUNT,))
    for code in codes:
        layout.set_filter(code, h5py.h5z.FLAG_OPTIONAL, (4,))
    space = h5py.h5s.create_simple((COUNT,))
    h5py.h5d.create(group.id, name, h5py.h5t.IEEE_F64LE, space, layout)


def test_filters_repeated_or_in_another_order(path):
    deflate, shuffle = h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE
    for codes, message in (
        ((deflate, deflate), "compressed twice by the same filter"),
        ((deflate, shuffle), "in an order that is not supported"),
    ):
        with h5py.File(path, "r+") as file:
            if "time" in file["calibration"]:
                del file["calibration/time"]
            create_with_filters(file["calibration"], b"time", codes)
        refused(path, message)


@pytest.mark.parametrize(
    ("index", "size"), [(0, 0), (1, 2**64 - 16), (1, 2**64 - 1), (3, 5000), (0, 4095)]
)
@pytest.mark.parametrize("reserved", [b"\0\0\0", b"abc"])
def test_heap_of_text_that_has_no_end(path, index, size, reserved):
    """On such a file HDF5 2.0 itself loops for ever, or reads beyond the heap."""
    content = bytearray(path.read_bytes())
    heap = content.index(b"GCOL")
    content[heap + 5 : heap + 8] = reserved
    content[heap + 16 : heap + 32] = struct.pack("<HHIQ", index, 1, 0, size)
    path.write_bytes(content)
    refused(path, "is damaged: a heap of text cannot be followed to its end")


def test_bytes_that_only_look_like_a_heap(path):
    with h5py.File(path, "r+") as file:
        file["note"] = np.frombuffer(b"GCOL\1\0\0\0" + b"\xff" * 100, np.uint8)
    load(path)


def test_huge_numbers_of_members_do_not_matter(path):
    with h5py.File(path, "r+") as file:
        for index in range(300):
            file["calibration"].attrs[f"a{index}"] = index
            file.create_group(f"group{index}")
    load(path)


def test_open_file_objects_are_read_the_same_way(path):
    with untrusted.open_root(io.BytesIO(path.read_bytes())) as root:
        found = untrusted.group(root, "calibration")
        assert found is not None
        assert str(found) == "/calibration"


# -- saving


def test_save_refuses_what_load_would(tmp_path):
    recording = random_recording()
    for changed, message in (
        (dataclasses.replace(recording.calibration, kind="time_of_flight"), "needs /probe"),
        (
            dataclasses.replace(recording.calibration, poses=np.zeros((COUNT, 4, 4))),
            "pose 0 is not a rigid",
        ),
    ):
        target = tmp_path / "rec.h5"
        with pytest.raises(InputError, match=message) as caught:
            save(dataclasses.replace(recording, calibration=changed), target)
        assert str(caught.value).startswith(str(target))
        assert not target.exists()


def test_save_where_it_cannot(tmp_path):
    for target in (tmp_path / "none" / "rec.h5", tmp_path):
        with pytest.raises(OutputError, match="cannot be written"):
            save(random_recording(), target)


def test_save_on_a_full_disk_keeps_the_old_file(tmp_path):
    path = tmp_path / "rec.h5"
    save(random_recording(1), path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(OutputError, match="File too large"):
            save(random_recording(2), path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert_same(random_recording(1), load(path))
    assert os.listdir(tmp_path) == ["rec.h5"]


def test_killed_while_saving_again_and_again(tmp_path):
    first, second = tmp_path / "first.h5", tmp_path / "second.h5"
    save(random_recording(1, count=4), first)
    save(random_recording(2, count=2000), second)
    code = (
        "import sys\n"
        "from jaxcal.io.hdf5 import load, save\n"
        "both = load(sys.argv[1]), load(sys.argv[2])\n"
        "while True:\n"
        "    for recording in both:\n"
        "        save(recording, sys.argv[3])\n"
        "        print('saved', flush=True)\n"
    )
    target = tmp_path / "out.h5"
    for delay in (0.0, 0.011, 0.023):
        with subprocess.Popen(
            [sys.executable, "-c", code, str(first), str(second), str(target)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "saved\n"
            time.sleep(delay)
            process.send_signal(signal.SIGKILL)
        assert len(load(target)) in (4, 2000)


def test_constants_are_the_contract():
    assert (hdf5.FORMAT, hdf5.VERSION) == ("jaxcal-recording", 1)
