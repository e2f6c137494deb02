"""Tracked sequences: PLUS's and Slicer's forms, other programs' readers, and files that lie."""

from __future__ import annotations

import gzip
import re
import subprocess
import sys
import zlib

import numpy as np
import pytest
from conftest import random_poses

from jaxcal import FormatError, InputError
from jaxcal.io import sequence_header
from jaxcal.io.frame_names import check_frames, path_between, split_name
from jaxcal.io.sequence_files import read_sequence, write_sequence

PROBE, REFERENCE = ("Probe", "Tracker"), ("Reference", "Tracker")


def written(path, count=5, **options):
    """A sequence of ours with its poses, and frames unless ``images`` is None."""
    rng = np.random.default_rng(3)
    transforms = {PROBE: random_poses(count), REFERENCE: random_poses(count, 1)}
    valid = {PROBE: np.arange(count) != 2}
    images = rng.integers(0, 256, (count, 6, 4), dtype=np.uint8)
    images = options.pop("images", images)
    time = 5.0 + np.arange(count) / 30
    write_sequence(path, transforms, time, valid=valid, images=images, **options)
    return transforms, valid, time, images


NAMES = ["a.igs.mha", "Übung 1.igs.mhd", "a.igs.nrrd"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("kind", ["uint8", "int16", "colour", "colour of 16 bits", "tracking"])
def test_round_trip(tmp_path, name, compressed, kind):
    rng = np.random.default_rng(0)
    images = {
        "uint8": rng.integers(0, 256, (5, 6, 4), dtype=np.uint8),
        "int16": rng.integers(-9000, 9000, (5, 6, 4), dtype=np.int16),
        "colour": np.repeat(rng.integers(0, 256, (5, 6, 4, 1), dtype=np.uint8), 3, axis=3),
        "colour of 16 bits": np.repeat(
            rng.integers(0, 9000, (5, 6, 4, 1), dtype=np.int16), 3, axis=3
        ),
        "tracking": None,
    }[kind]
    transforms, valid, time, _ = written(tmp_path / name, images=images, compressed=compressed)
    found = read_sequence(tmp_path / name)
    assert len(found) == 5
    np.testing.assert_array_equal(found.time, time)
    for pair, matrices in transforms.items():
        good = valid.get(pair, np.ones(5, bool))
        np.testing.assert_array_equal(found.valid[pair], good)
        np.testing.assert_array_equal(found.transforms[pair][good], matrices[good])
    if images is None:
        assert found.pixels is None
        with pytest.raises(FormatError, match="holds no pixels"):
            next(found.images())
        return
    grey = images[..., 0] if kind.startswith("colour") else images
    np.testing.assert_array_equal(np.array(list(found.images())), grey)
    np.testing.assert_array_equal(np.array(list(found.images([1, 4]))), grey[[1, 4]])


def test_a_nrrd_may_name_its_orientation_as_a_metaimage_does(tmp_path):
    *_, images = written(tmp_path / "s.igs.nrrd")
    content = (tmp_path / "s.igs.nrrd").read_bytes()
    content = content.replace(b"ultrasound image orientation:", b"UltrasoundImageOrientation:")
    (tmp_path / "s.igs.nrrd").write_bytes(content)
    found = np.array(list(read_sequence(tmp_path / "s.igs.nrrd").images()))
    np.testing.assert_array_equal(found, images)


@pytest.mark.parametrize("name", NAMES)
def test_other_readers(tmp_path, name):
    transforms, _, _, images = written(tmp_path / name)
    if name.endswith(".nrrd"):
        nrrd = pytest.importorskip("nrrd")
        array, header = nrrd.read(str(tmp_path / name))
        np.testing.assert_array_equal(array.transpose(2, 1, 0), images)
        assert header["ultrasound image orientation"] == "MFA"
        assert header["Seq_Frame0002_Status"] == "OK"
        read = header
    else:
        sitk = pytest.importorskip("SimpleITK")
        image = sitk.ReadImage(str(tmp_path / name))
        np.testing.assert_array_equal(sitk.GetArrayFromImage(image), images)
        read = {key: image.GetMetaData(key) for key in image.GetMetaDataKeys()}
        assert read["Seq_Frame0002_ImageStatus"] == "OK"
    assert read["Seq_Frame0002_ProbeToTrackerTransformStatus"] == "INVALID"
    numbers = np.array(read["Seq_Frame0003_ProbeToTrackerTransform"].split(), float)
    np.testing.assert_array_equal(numbers.reshape(4, 4), transforms[PROBE][3])
    assert (
        max(map(len, (tmp_path / name).read_bytes().split(b"ElementDataFile")[0].split(b"\n")))
        < 1000
    )


@pytest.mark.parametrize(
    ("orientation", "flip"),
    [("MF", np.s_[:, :]), ("UF", np.s_[:, ::-1]), ("MN", np.s_[::-1]), ("UN", np.s_[::-1, ::-1])],
)
def test_orientation_becomes_plus_image_frame(tmp_path, orientation, flip):
    *_, images = written(tmp_path / "a.mha", orientation=orientation)
    found = read_sequence(tmp_path / "a.mha")
    np.testing.assert_array_equal(next(found.images([3])), images[3][flip])


def edit(path, pattern, replacement, count=1):
    content = path.read_bytes()
    new, times = re.subn(pattern, replacement, content, count=count)
    assert times
    path.write_bytes(new)


@pytest.mark.parametrize("stated", [b"XX", b"??", b""])
def test_unknown_orientation_is_asked_for(tmp_path, stated):
    written(tmp_path / "a.mha")
    edit(tmp_path / "a.mha", rb"Orientation = MFA", b"Orientation = " + stated)
    found = read_sequence(tmp_path / "a.mha")
    with pytest.raises(FormatError, match="pixels are oriented: say it by --orientation"):
        next(found.images())
    assert next(found.images(orientation="UN")).shape == (6, 4)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("stated", ["FMA", "NU", "UNKNOWN", "MFAX"])
def test_an_orientation_that_is_not_known_is_no_unknown_one(tmp_path, name, stated):
    """A file that states something was said to state nothing; UNKNOWN was taken for UN."""
    written(tmp_path / name)
    path = tmp_path / name
    edit(path, rb"(?i)(orientation( = |:=))MFA", rb"\1" + stated.encode())
    with pytest.raises(FormatError, match=f"orientation '{stated}' is not read: only MF, UF, MN"):
        read_sequence(path)
    # As PLUS writes RF data; its transforms can be used.
    edit(path, rb"(?i)(image type( = |:=))BRIGHTNESS|(imagetype = )BRIGHTNESS", rb"\1\3RF_REAL")
    with pytest.raises(FormatError, match="holds 'RF_REAL' data"):
        next(read_sequence(path).images())


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (rb"\n", b"\r\n"),
        (rb"(Kinds = domain domain list\n)", rb"\1\1"),
        (rb"Kinds = domain domain list\n", b""),
        (rb"UltrasoundImageType = BRIGHTNESS", b"UltrasoundImageType = BRIGHTNESSBRIGHTNESS"),
        (rb"UltrasoundImageType = BRIGHTNESS", b"UltrasoundImageType = RGB_COLOR"),
        (rb"DimSize = 4 6 5", b"DimSize = 4  6 5              "),
        (rb"Transform = ", b"Transform ="),
        (rb"(Seq_Frame0001_\w+Transform = [^\n]*)", rb"\1 "),
        (rb"= LOCAL", b"= Local"),
        (rb"= LOCAL", b"= local"),
        (rb"Seq_Frame0000_Timestamp", b"Seq_Frame0000_Stylus = 1 0 0\nSeq_Frame0000_Timestamp"),
    ],
)  # fmt: skip
def test_forms_that_occur(tmp_path, old, new):
    """Line ends, blanks, repeated and missing fields: all of them stand in real files."""
    transforms, *_, images = written(tmp_path / "a.mha")
    content = (tmp_path / "a.mha").read_bytes()
    end = content.index(b"LOCAL\n") + 6
    head = re.sub(old, new, content[:end])
    (tmp_path / "a.mha").write_bytes(head + content[end:])
    found = read_sequence(tmp_path / "a.mha")
    np.testing.assert_array_equal(np.array(list(found.images())), images)
    np.testing.assert_array_equal(found.transforms[PROBE][0], transforms[PROBE][0])


def beside(path, line, *, before=b"", after=b"", big=False, compressed=False):
    """A sequence whose pixels are in a file beside it, with a line more in the header."""
    rng = np.random.default_rng(3)
    images = rng.integers(-9000, 9000, (5, 6, 4), dtype=np.int16)
    written(path, images=images, compressed=compressed)
    edit(path, rb"BinaryDataByteOrderMSB = False\n", b"")
    edit(path, rb"(ElementDataFile)", line + rb"\n\1")
    data = path.with_suffix(".zraw" if compressed else ".raw")
    pixels = images.astype(">i2").tobytes() if big else data.read_bytes()
    data.write_bytes(before + pixels + after)
    return images


@pytest.mark.parametrize(
    ("line", "how"),
    [
        (b"HeaderSize = 0", {}),
        (b"HeaderSize = 37", {"before": b"x" * 37}),
        (b"HeaderSize = -1", {"before": b"x" * 37}),
        (b"HeaderSize = 37", {"before": b"x" * 37, "compressed": True}),
        (b"ElementByteOrderMSB = True", {"big": True}),
        (b"BinaryDataByteOrderMSB = True\nElementByteOrderMSB = True", {"big": True}),
        (b"ElementByteOrderMSB = False", {}),
    ],
)
def test_pixels_beside_as_metaio_reads_them(tmp_path, line, how):
    """HeaderSize and MetaIO's other name of the order of bytes were passed over."""
    path = tmp_path / "a.mhd"
    images = beside(path, line, **how)
    np.testing.assert_array_equal(np.array(list(read_sequence(path).images())), images)
    sitk = pytest.importorskip("SimpleITK")
    np.testing.assert_array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(path))), images)


@pytest.mark.parametrize(
    ("line", "how", "message"),
    [
        (b"HeaderSize = 3", {}, "claims 240 bytes of pixels, the file holds 237"),
        (
            b"HeaderSize = -1",
            {"before": b"x", "compressed": True},
            "state where the compressed ones begin",
        ),
        (b"HeaderSize = -2", {}, "HeaderSize must be whole numbers, not '-2'"),
        (b"HeaderSize = 1 2", {}, "HeaderSize must be one number, not '1 2'"),
        (b"Comment = x", {"before": b"x" * 37}, "the file holds 277: correct the header's size"),
        (b"Comment = x", {"after": b"x"}, "claims 240 bytes of pixels, the file holds 241"),
        (b"ElementByteOrderMSB = yes", {}, "must be True or False, not 'yes'"),
        (
            b"BinaryDataByteOrderMSB = False\nElementByteOrderMSB = True",
            {},
            "BinaryDataByteOrderMSB and ElementByteOrderMSB contradict each other",
        ),
    ],
)
def test_pixels_beside_that_lie(tmp_path, line, how, message):
    beside(tmp_path / "a.mhd", line, **how)
    with pytest.raises(FormatError, match=re.escape(message)) as caught:
        read_sequence(tmp_path / "a.mhd")
    assert str(caught.value).startswith(str(tmp_path / "a.mhd"))


@pytest.mark.parametrize("name", ["a.mha", "a.nrrd"])
def test_more_pixels_than_claimed(tmp_path, name):
    written(tmp_path / name, compressed=False)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content + b"x")
    with pytest.raises(FormatError, match="claims 120 bytes of pixels, the file holds 121"):
        read_sequence(tmp_path / name)
    if name.endswith(".mha"):
        (tmp_path / name).write_bytes(content)
        edit(tmp_path / name, b"(ElementDataFile)", rb"HeaderSize = 9\n\1")
        with pytest.raises(FormatError, match="HeaderSize = '9': applies only to pixels in"):
            read_sequence(tmp_path / name)


@pytest.mark.parametrize("size", ["0 0 3", "1 1 3"])
@pytest.mark.parametrize("kind", ["MET_OTHER", "MET_UCHAR"])
def test_tracking_alone(tmp_path, size, kind):
    fields = "".join(
        f"Seq_Frame{k:04d}_ProbeToTrackerTransform = 1 0 0 {k} 0 1 0 0 0 0 1 0 0 0 0 1\n"
        f"Seq_Frame{k:04d}_ProbeToTrackerTransformStatus = {'OK' if k else 'OUT_OF_VIEW'}\n"
        for k in range(3)
    )
    head = f"ObjectType = Image\nNDims = 3\nDimSize = {size}\nElementType = {kind}\n"
    (tmp_path / "a.mha").write_text(head + fields + "ElementDataFile = LOCAL\n\0\0\0")
    found = read_sequence(tmp_path / "a.mha")
    assert found.pixels is None
    np.testing.assert_array_equal(found.valid[PROBE], [False, True, True])
    poses, valid = found.poses("Probe", "Tracker")
    assert valid.sum() == 2
    np.testing.assert_array_equal(poses[1:, 0, 3], [1, 2])


def test_many_frames(tmp_path):
    count = 10_001
    lines = ["ObjectType = Image", "NDims = 3", f"DimSize = 0 0 {count}", "ElementType = MET_OTHER"]
    lines += [f"Seq_Frame{k:04d}_Timestamp = {k / 100}" for k in range(count)]
    (tmp_path / "a.mha").write_text("\n".join([*lines, "ElementDataFile = LOCAL", ""]))
    assert read_sequence(tmp_path / "a.mha").time[-1] == 100.0


def test_way_through_the_frames(tmp_path):
    transforms, *_ = written(tmp_path / "a.mha")
    found = read_sequence(tmp_path / "a.mha")
    poses, valid = found.poses("Probe", "Reference")
    np.testing.assert_array_equal(valid, np.arange(5) != 2)
    expected = np.linalg.inv(transforms[REFERENCE]) @ transforms[PROBE]
    np.testing.assert_allclose(poses[valid], expected[valid], atol=1e-11)
    back, _ = found.poses("Reference", "Probe")
    np.testing.assert_allclose(
        back[valid] @ poses[valid], np.tile(np.eye(4), (4, 1, 1)), atol=1e-11
    )
    with pytest.raises(InputError, match="no transforms lead from 'Stylus' to 'Tracker'"):
        found.poses("Stylus", "Tracker")
    edit(
        tmp_path / "a.mha",
        rb"ReferenceToTrackerTransform = \S+ ",
        b"ReferenceToTrackerTransform = -9 ",
    )
    with pytest.raises(InputError, match="ReferenceToTrackerTransform of frame 0 is a reflection"):
        read_sequence(tmp_path / "a.mha").poses("Probe", "Reference")


def test_frame_names():
    assert split_name("ProbeToTracker") == ("Probe", "Tracker")
    assert split_name("imageToTransducerOriginPixel") == ("Image", "TransducerOriginPixel")
    assert split_name("ToolToTracker") == ("Tool", "Tracker")
    assert split_name("AToBToC") is None
    assert split_name("Stylus") is None
    assert path_between([("A", "B"), ("C", "B")], "A", "C") == [(0, False), (1, True)]
    assert path_between([("A", "B")], "A", "C") is None
    assert check_frames(("image", "probe")) == ("Image", "Probe")
    assert split_name("US_ProbeTo_Tracker-1") == ("US_Probe", "_Tracker-1")
    assert check_frames(("US_Probe", "Probe-2")) == ("US_Probe", "Probe-2")
    for name in ("", "a b", "ProbeToTracker", "1x", 'x"y', "GoTo", "ToA", "GoTo_A"):
        with pytest.raises(FormatError):
            check_frames((name, "Other"))


# Files that lie.

FIRST_NUMBER = rb"(Seq_Frame0001_\w+Transform = )\S+ "


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (rb"ElementDataFile = LOCAL", b"ElementDataFile = /etc/passwd", "only LOCAL, or"),
        (rb"ElementDataFile = LOCAL", b"ElementDataFile = ../x.raw", "only LOCAL, or"),
        (rb"ElementDataFile = LOCAL", b"ElementDataFile = LIST", "only LOCAL, or"),
        (rb"ElementDataFile = LOCAL", b"ElementDataFile = LIST 2D", "only LOCAL, or"),
        (rb"ElementDataFile = LOCAL", b"ElementDataFile = x%03d.raw 1 9 1", "only LOCAL, or"),
        (rb"ElementDataFile = LOCAL", b"ElementDataFile = none.raw", "none.raw: no such file"),
        (rb"DimSize = 4 6 5", b"DimSize = 100000 100000 1000", "larger than 67108864 bytes"),
        (rb"DimSize = 4 6 5", b"DimSize = 5000 2000 1000", "claims 10000000000 bytes of pixels"),
        (rb"DimSize = 4 6 5", b"DimSize = 4 6 2147483648", "claims 2147483648 frames"),
        (rb"DimSize = 4 6 5", b"DimSize = 4 6 99999999999999999999999", "must be whole numbers"),
        (rb"DimSize = 4 6 5", b"DimSize = -4 6 5", "must be whole numbers"),
        (rb"DimSize = 4 6 5", b"DimSize = 4 6", "DimSize has 2 numbers, NDims is 3"),
        (rb"DimSize = 4 6 5", b"DimSize = 4 6 4", "has fields of frame 4, but only 4 frames"),
        (rb"DimSize = 4 6 5", b"DimSize = 4 6 0", "holds no frames"),
        (rb"DimSize = 4 6 5", b"", "DimSize or ElementDataFile is missing"),
        (rb"Seq_Frame0001_", b"Seq_Frame_", "does not name a frame and a field"),
        (rb"Seq_Frame0001_", b"Seq_Frame4294967296_", "frame 4294967296; at most"),
        (rb"Seq_Frame0001_", b"Seq_Frame0000_", "is given twice"),
        (FIRST_NUMBER, rb"\1", ":24: a transform with status OK must have 16 numbers, not 15"),
        (FIRST_NUMBER, rb"\1nan ", ":24: a transform with status OK holds NaN"),
        (FIRST_NUMBER, rb"\1x ", "is not numbers"),
        (rb"(Seq_Frame0001_Timestamp = )\S+", rb"\1inf", "the time stamp holds NaN or Inf: 'inf'"),
        (rb"MET_UCHAR", b"MET_LONG_DOUBLE", "'MET_LONG_DOUBLE' is not read"),
        (rb"NDims = 3", b"NDims", "line 2 is not KEY = VALUE"),
    ],
)  # fmt: skip
def test_metaimage_that_lies(tmp_path, old, new, message):
    written(tmp_path / "a.mha")
    edit(tmp_path / "a.mha", old, new)
    with pytest.raises(FormatError, match=re.escape(message)) as caught:
        list(read_sequence(tmp_path / "a.mha").images())
    assert str(caught.value).startswith(str(tmp_path / "a.mha"))
    assert "\n" not in str(caught.value)


def test_reflected_pose(tmp_path):
    transforms, *_ = written(tmp_path / "a.mha")
    mirrored = transforms[PROBE] @ np.diag([1.0, 1, -1, 1])
    write_sequence(tmp_path / "a.mha", {PROBE: mirrored}, np.arange(5.0))
    with pytest.raises(InputError, match="ProbeToTrackerTransform of frame 0 is a reflection"):
        read_sequence(tmp_path / "a.mha").poses("Probe", "Tracker")


def test_pixels_beside_that_are_a_link_to_another_folder(tmp_path):
    written(tmp_path / "a.mhd")
    (tmp_path / "a.zraw").unlink()
    (tmp_path / "a.zraw").symlink_to("/etc/passwd")
    with pytest.raises(FormatError, match="is a link to another folder"):
        read_sequence(tmp_path / "a.mhd")


@pytest.mark.parametrize(
    ("named", "times"),
    [
        ('units: "mm" "mm" "mm" "s"', [0, 0.1, 0.2, 0.3, 0.5]),
        ('units: "mm" "mm" "mm" "ms"', [0, 1e-4, 2e-4, 3e-4, 5e-4]),
        ('labels: "x" "y" "z" "time"', [0, 0.1, 0.2, 0.3, 0.5]),
        ('labels: "x" "y" "z" "frame"', None),
        ("# nothing", None),
    ],
)
def test_times_of_slicers_volume_sequences(tmp_path, named, times):
    """They are values of an index, which need not be a time."""
    written(tmp_path / "a.seq.nrrd")
    edit(tmp_path / "a.seq.nrrd", rb"Seq_Frame\d+_[^\n]*\n", b"", count=0)
    edit(tmp_path / "a.seq.nrrd", rb"sizes: 4 6 5", b"sizes: 4 6 1 5")
    edit(tmp_path / "a.seq.nrrd", rb"domain domain list", b"domain domain domain list")
    values = f"{named}\naxis 3 index type:=numeric\naxis 3 index values:=0 0.1%200.2 0.3 0.5\n\n"
    edit(tmp_path / "a.seq.nrrd", rb"\n\n", b"\n" + values.encode())
    found = read_sequence(tmp_path / "a.seq.nrrd")
    np.testing.assert_allclose(found.time, np.full(5, np.nan) if times is None else times)
    assert len(list(found.images())) == 5
    for lie, message in ((b"0.1 x 0.3 0.5", "are not numbers"), (b"0 1", "2 index values for 5")):
        edit(tmp_path / "a.seq.nrrd", rb"values:=[^\n]*", b"values:=" + lie)
        if times is not None:
            with pytest.raises(FormatError, match=message):
                read_sequence(tmp_path / "a.seq.nrrd")


@pytest.mark.parametrize("packed", [False, True])
def test_frames_along_the_first_axis(tmp_path, monkeypatch, packed):
    """As Slicer documents its volume sequences: the numbers of all frames, pixel by pixel."""
    path, frames = tmp_path / "a.seq.nrrd", np.arange(5 * 6 * 4, dtype=">i2").reshape(5, 6, 4)
    head = [
        "NRRD0005",
        "type: short",
        "dimension: 4",
        "sizes: 5 4 6 1",
        "kinds: list space domain domain",
        'labels: "time" "" "" ""',
        "endian: big",
        f"encoding: {'gzip' if packed else 'raw'}",
        "axis 0 index type:=numeric",
        "axis 0 index values:=0 0.1 0.2 0.3 0.5",
        "DataNodeClassName:=vtkMRMLScalarVolumeNode",
    ]
    content = frames.transpose(1, 2, 0).tobytes()
    content = gzip.compress(content) if packed else content
    path.write_bytes("\n".join([*head, "", ""]).encode() + content)
    found = read_sequence(path)
    np.testing.assert_array_equal(found.time, [0, 0.1, 0.2, 0.3, 0.5])
    np.testing.assert_array_equal(list(found.images(orientation="MF")), frames)
    wanted = list(found.images([1, 4], orientation="UN"))
    np.testing.assert_array_equal(wanted, frames[[1, 4], ::-1, ::-1])
    monkeypatch.setattr(sequence_header, "_MOST_INTERLEAVED", 100)
    with pytest.raises(FormatError, match="list them along the last one"):
        read_sequence(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (rb"encoding: gzip", b"data file: ../x", r"has 'data file': .* \(save both as one file"),
        (rb"encoding: gzip", b"encoding: bzip2", "encoding 'bzip2' is not read"),
        (rb"sizes: 4 6 5", b"sizes: 4 6 2147483648", "claims 2147483648 frames"),
        (rb"sizes: 4 6 5", b"sizes: 100000 100000 1000", "larger than"),
        (rb"kinds: domain domain list", b"kinds: domain list domain", "no sequence of plane"),
        (rb"kinds: domain domain list", b"kinds: domain domain", "3 sizes, but 2 kinds"),
        (rb"type: uint8", b"type: block", "type 'block' is not read"),
        (rb"NRRD0004", b"NRRX0004", "is not an NRRD file"),
        (rb"\n\n", b"\n", "is not a field|is not read|in another file|are damaged|utf"),
    ],
)  # fmt: skip
def test_nrrd_that_lies(tmp_path, old, new, message):
    written(tmp_path / "a.nrrd")
    edit(tmp_path / "a.nrrd", old, new)
    with pytest.raises(FormatError, match=message) as caught:
        list(read_sequence(tmp_path / "a.nrrd").images())
    assert str(caught.value).startswith(str(tmp_path / "a.nrrd"))


def test_damaged_and_truncated_pixels(tmp_path):
    written(tmp_path / "a.mha")
    content = (tmp_path / "a.mha").read_bytes()
    for cut in (-1, -40):
        (tmp_path / "a.mha").write_bytes(content[:cut])
        with pytest.raises(FormatError, match=r"the pixels end at|claims|data is missing"):
            list(read_sequence(tmp_path / "a.mha").images())
    (tmp_path / "a.mha").write_bytes(content[:-60] + bytes(60))
    with pytest.raises(FormatError, match=r"damaged|end at"):
        list(read_sequence(tmp_path / "a.mha").images())


def test_stream_that_inflates_beyond_its_size(tmp_path):
    head = "ObjectType = Image\nNDims = 3\nCompressedData = True\nDimSize = 64 64 2\n"
    head += "ElementType = MET_UCHAR\nUltrasoundImageOrientation = MFA\nElementDataFile = LOCAL\n"
    (tmp_path / "a.mha").write_bytes(head.encode() + zlib.compress(bytes(64 * 64 * 2 + 1)))
    with pytest.raises(FormatError, match="inflate beyond their size"):
        list(read_sequence(tmp_path / "a.mha").images())


def test_a_bomb_takes_the_memory_of_one_frame(tmp_path):
    """20 frames of 16 MiB from a few hundred kB, read one by one."""
    packer = zlib.compressobj(1)
    packed = b"".join([*(packer.compress(bytes(2**24)) for _ in range(20)), packer.flush()])
    head = "ObjectType = Image\nNDims = 3\nCompressedData = True\nDimSize = 4096 4096 20\n"
    head += "ElementType = MET_UCHAR\nUltrasoundImageOrientation = MFA\nElementDataFile = LOCAL\n"
    (tmp_path / "a.mha").write_bytes(head.encode() + packed)
    code = (
        "import resource, sys; from jaxcal.io.sequence_files import read_sequence; "
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss; "
        "count = sum(1 for _ in read_sequence(sys.argv[1]).images()); "
        "print(count, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a.mha"], capture_output=True, text=True
    )
    count, grown = map(int, done.stdout.split())
    assert count == 20
    # ru_maxrss is in KiB, on a Mac in bytes.
    assert grown < 100 * 2**20 / (1 if sys.platform == "darwin" else 1024)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": np.array([0.0, 1, 1.0002])}, "same time stamp to the millisecond"),
        ({"time": np.array([0.0, np.nan, 1])}, "time stamp 1 is NaN"),
        ({"transforms": {("A b", "C"): random_poses(3)}}, "cannot name a coordinate frame"),
        ({"transforms": {PROBE: random_poses(2)}}, r"shape \(2, 4, 4\)"),
        ({"images": np.zeros((3, 4, 4))}, "uint8 or int16"),
        ({"path": "a.raw"}, "ends in .mha"),
        ({"path": "50%.mhd"}, r"50%\.mhd: ElementDataFile = '50%\.zraw': only LOCAL"),
        ({"transforms": {PROBE: np.full((3, 4, 4), np.nan)}}, "holds NaN"),
    ],
)
def test_what_cannot_be_written_is_not(tmp_path, change, message):
    arguments = {
        "path": "a.mha",
        "transforms": {PROBE: random_poses(3)},
        "time": np.arange(3.0),
    } | change
    path = tmp_path / arguments.pop("path")
    with pytest.raises(InputError, match=message):
        write_sequence(path, **arguments)
    assert not list(tmp_path.iterdir())


# Real files.

PLUS_FILES = {
    "NwirePhantomFreehand.igs.mha": (97, {PROBE: 97, REFERENCE: 97, ("Stylus", "Tracker"): 0}),
    "EightLandmarkPointsTrackedForPhantomRegistration.igs.mha": (
        1000, {REFERENCE: 1000, ("Stylus", "Tracker"): 1000},
    ),
    "TransformInterpolationTest.igs.mha": (500, {PROBE: 499, REFERENCE: 500}),
    "WaterTankBottomTranslationTrackerBuffer.igs.mha": (
        5000, {PROBE: 5000, REFERENCE: 5000, ("Stylus", "Tracker"): 5000},
    ),
    "WaterTankBottomTranslationVideoBuffer.igs.mha": (201, {}),
    "fCal_Test_Calibration_3NWires_fCal2.0.igs.mha": (
        190, {PROBE: 190, REFERENCE: 190, ("Stylus", "Tracker"): 190},
    ),
    "fCal_Test_Validation_3NWires_fCal2.0.igs.mha": (
        103, {PROBE: 103, REFERENCE: 103, ("Stylus", "Tracker"): 103},
    ),
    "NrrdSample.igs.nrrd": (1, {}),
    "ColorNrrdSample.igs.nrrd": (1, {}),
}  # fmt: skip


@pytest.mark.parametrize("name", PLUS_FILES)
def test_real_files_against_another_reader(real_data, name):
    path = real_data / "plus" / name
    count, valid = PLUS_FILES[name]
    found = read_sequence(path)
    assert len(found) == count
    assert {pair: int(good.sum()) for pair, good in found.valid.items()} == valid
    metadata, pixels = _independently(path)
    if metadata is None:
        pytest.skip("the independent reader cannot read this form")
    for pair in valid:
        for frame in range(0, count, 37):
            key = f"Seq_Frame{frame:04d}_{'To'.join(pair)}Transform"
            good = metadata.get(f"{key}Status", "OK") == "OK" and key in metadata
            assert found.valid[pair][frame] == good
            if good:
                numbers = np.array(metadata[key].split(), float).reshape(4, 4)
                np.testing.assert_array_equal(found.transforms[pair][frame], numbers)
    if found.pixels is not None:
        frames = np.array(list(found.images([0, count - 1] if count > 1 else [0])))
        expected = pixels[[0, -1]] if count > 1 else pixels[:1]
        if expected.ndim == 4:
            expected = np.rint(expected @ [0.299, 0.587, 0.114]).astype(np.uint8)
        np.testing.assert_array_equal(frames, expected)


def _independently(path):
    """Metadata and pixels (n, rows, columns[, channels]) by SimpleITK or pynrrd."""
    if path.name.endswith(".nrrd"):
        nrrd = pytest.importorskip("nrrd")
        array, header = nrrd.read(str(path))
        return header, array.transpose()[None] if array.ndim == 2 else array.transpose(2, 1, 0)[
            None
        ]
    sitk = pytest.importorskip("SimpleITK")
    if b"MET_OTHER" in path.read_bytes()[:2000]:
        # SimpleITK refuses this form: the fields by a search through the text instead.
        fields = re.findall(rb"^(Seq_\w+) = (.*?)\s*$", path.read_bytes(), re.MULTILINE)
        return {key.decode(): value.decode() for key, value in fields}, None
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    image = reader.Execute()
    metadata = {key: image.GetMetaData(key).strip() for key in image.GetMetaDataKeys()}
    return metadata, sitk.GetArrayFromImage(image)
