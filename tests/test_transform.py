"""A calibration in use: applied, saved and loaded in every format, without JAX."""

from __future__ import annotations

import datetime
import json
import re
import resource
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace

import h5py
import jaxtyping
import numpy as np
import pytest
from fastcrc import crc64

import jaxcal
from jaxcal import FormatError, InputError, OutputError
from jaxcal.cli.main import main
from jaxcal.data.poses import check_affine, quaternions_from_rotations, rotations_from_quaternions
from jaxcal.data.recording import Recording, make_images
from jaxcal.io.itk import itk_from_matrix, itk_text, matrix_from_itk, read_itk, write_itk
from jaxcal.io.ros import read_ros_yaml
from jaxcal.io.sequence_files import write_sequence
from jaxcal.io.serving import TransformServer
from jaxcal.io.tus_rec import read_scan
from jaxcal.result.saved import load_calibration
from jaxcal.result.transform import ImageTransform, transform_from_plus_matrix


def random_transform(seed: int = 0, scale=(0.148, 0.14), offset: float = 1.5) -> ImageTransform:
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4)
    matrix = np.eye(4)
    matrix[:3, :3] = rotations_from_quaternions(
        quaternion[None] / np.linalg.norm(quaternion), "xyzw"
    )[0]
    matrix[:3, 3] = rng.uniform(-150, 150, 3)
    root = rng.normal(size=(6, 6)) * [0.2, 0.2, 0.2, 0.01, 0.01, 0.01]
    return ImageTransform(
        matrix, None if scale is None else np.array(scale), offset, root.T @ root, 0.7, True
    )


@pytest.mark.parametrize("seed", range(3))
def test_plus_matrix_is_jaxcals_model(seed):
    """Eq. of the README, pixel by pixel, and PLUS's rule for the third column."""
    known = random_transform(seed)
    pixels = np.random.default_rng(seed).uniform(0, 600, (20, 2))
    s_u, s_v = known.scale_mm_per_px
    plane = np.stack(
        [s_u * pixels[:, 0], np.zeros(20), s_v * pixels[:, 1] + 1.5, np.ones(20)], axis=1
    )
    expected = (plane @ known.image_plane_to_probe.T)[:, :3]
    homogeneous = np.column_stack([pixels, np.zeros(20), np.ones(20)])
    matrix = known.plus_matrix()
    np.testing.assert_allclose((homogeneous @ matrix.T)[:, :3], expected, atol=1e-11)
    np.testing.assert_allclose(known.apply(pixels).points, expected, atol=1e-11)
    assert np.linalg.det(matrix[:3, :3]) > 0
    third = np.cross(matrix[:3, 0] / s_u, matrix[:3, 1] / s_v) * (s_u + s_v) / 2
    np.testing.assert_allclose(matrix[:3, 2], third, atol=1e-14)
    # The elevational axis is minus the third column's direction.
    assert matrix[:3, 2] @ known.image_plane_to_probe[:3, 1] < 0


@pytest.mark.parametrize(
    "extension", ["json", "xml", "tfm", "txt", "h5", "yaml", "csv", "npy", "npz"]
)
def test_saved_and_loaded(tmp_path, extension):
    known = replace(
        random_transform(), tre_factor=1.5, degrees_of_freedom=5.0, variance_factor=1.25
    )
    path = tmp_path / f"cal.{extension}"
    known.save(path)
    if extension == "xml":
        text = path.read_text()
        path.write_text(f"<PlusConfiguration><CoordinateDefinitions>{text}</CoordinateDefinitions>"
                        "</PlusConfiguration>")  # fmt: skip
    found = load_calibration(path)
    np.testing.assert_allclose(found.plus_matrix(), known.plus_matrix(), rtol=0, atol=1e-12)
    pixel = np.array([300.0, 400.0])
    np.testing.assert_allclose(found.apply(pixel).points, known.apply(pixel).points, atol=1e-12)
    np.testing.assert_allclose(
        found.image_plane_to_probe[:3, :3], known.image_plane_to_probe[:3, :3], atol=1e-13
    )
    if extension in ("json", "npz"):
        np.testing.assert_array_equal(found.covariance, known.covariance)
        assert (found.face_offset_mm, found.tre_factor) == (1.5, 1.5)
        assert (found.degrees_of_freedom, found.variance_factor) == (5.0, 1.25)
    if extension == "json":
        assert (found.error_mm, found.converged) == (0.7, True)
    if extension == "xml":
        # PLUS's own error is a trimmed mean: it goes back to PLUS, but is no RMS residual.
        found.save(tmp_path / "again.json")
        assert json.loads((tmp_path / "again.json").read_text())["rms_mm"] is None
        assert 'Error="0.7"' in found.text("plus")
        path.unlink()
        known.save(path)  # the element alone
        np.testing.assert_array_equal(load_calibration(path).plus_matrix(), found.plus_matrix())


@pytest.mark.parametrize("extension", ["json", "yaml", "npz"])
def test_points_in_mm_are_saved_and_loaded(tmp_path, extension):
    """The range of a measured range of 0 and the sound speed are no part of the rigid transform."""
    known = replace(random_transform(), scale_mm_per_px=None, range_factor=0.9991)
    known.save(tmp_path / f"cal.{extension}")
    found = load_calibration(tmp_path / f"cal.{extension}")
    assert (found.scale_mm_per_px, found.face_offset_mm, found.range_factor) == (None, 1.5, 0.9991)
    point = np.array([12.0, 40.0])
    np.testing.assert_allclose(found.apply(point).points, known.apply(point).points, atol=1e-12)


@pytest.mark.parametrize("held", ["[1]", "{", '{"face_offset_mm": "x"}', '{"range_factor": -1}'])
def test_yaml_that_lies(tmp_path, held):
    text = random_transform().text("ros")
    path = tmp_path / "cal.yaml"
    path.write_text(re.sub("(?m)^# jaxcal: .*$", f"# jaxcal: {held}", text))
    with pytest.raises(InputError, match=r"^\S+cal\.yaml:"):
        load_calibration(path)
    path.write_text(re.sub("(?m)^(# jaxcal: .*)$", r"\1\n\1", text))
    with pytest.raises(FormatError, match="must stand once"):
        load_calibration(path)


def test_npz_keeps_what_the_uncertainty_needs(tmp_path):
    """Estimated pixel sizes and sound speed included; older files have fewer names."""
    unknowns = ("translation", "rotation", "scale", "sound-speed")
    root = np.random.default_rng(1).normal(size=(9, 9)) * [*[0.2] * 3, *[0.01] * 3, *[0.004] * 3]
    covariance = root.T @ root
    known = replace(
        random_transform(), unknowns=unknowns, covariance=covariance[:6, :6],
        image_covariance=covariance, range_factor=0.99, probe_frame="Stylus",
        doubtful_unit="may be in cm",
    )  # fmt: skip
    for name in ("cal.npz", "cal.json"):
        known.save(tmp_path / name)
        found = load_calibration(tmp_path / name)
        expected, applied = (
            known.apply(np.array([400.0, 300.0])),
            found.apply(np.array([400.0, 300.0])),
        )
        np.testing.assert_array_equal(applied.points, expected.points)
        np.testing.assert_array_equal(applied.covariance, expected.covariance)
        assert (found.unknowns, found.converged, found.error_mm) == (unknowns, True, 0.7)
        assert (found.probe_frame, found.doubtful_unit) == ("Stylus", "may be in cm")
        assert "uncertain: may be in cm" in repr(found)
        assert found.date is not None
    old = ("image_plane_to_probe", "scale_mm_per_px", "covariance", "face_offset_mm")
    with np.load(tmp_path / "cal.npz") as file:
        np.savez(tmp_path / "old.npz", **{name: file[name] for name in old})
    found = load_calibration(tmp_path / "old.npz")
    np.testing.assert_array_equal(found.covariance, known.covariance)
    assert (found.image_covariance, found.converged, found.doubtful_unit) == (None, None, None)


@pytest.mark.parametrize("name", ["a.tfm", "a.npz", "a.npy", "a.xml", "a.yaml", "a.csv", "a.h5"])
def test_what_must_not_be_used_is_not_saved_for_others(tmp_path, name):
    lost = replace(random_transform(), converged=False)
    with pytest.raises(InputError, match="must not be used"):
        lost.save(tmp_path / name)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="must not be used"):
        lost.text("plus")
    lost.save(tmp_path / "cal.json")
    assert load_calibration(tmp_path / "cal.json").converged is False


def test_wrong_frames_are_not_handed_on(saved, tmp_path, capsys):
    saved.write_text(json.dumps(good_record() | {"wrong_frames": "the poses are inverted"}))
    assert main(["export", str(saved), str(tmp_path / "a.tfm"), "--slicer"]) == 2
    assert "must not be used" in capsys.readouterr().err


@pytest.fixture
def unchecked(monkeypatch):
    """As users call it, who may give a pair of numbers for an array."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


# OpenIGTLink's numbers are float32, which cannot hold this translation.
FAR = np.eye(4) + np.eye(4, k=3) * 1e300


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale_mm_per_px": (0.1, -0.1)}, "scale_mm_per_px must be positive"),
        ({"scale_mm_per_px": 0.1}, r"must have shape \(2,\), it has \(\)"),
        ({"scale_mm_per_px": ("a", 1)}, "scale_mm_per_px must be an array of real numbers"),
        ({"image_plane_to_probe": np.diag([1.0, 1, -1, 1])}, "is a reflection"),
        ({"image_plane_to_probe": np.diag([2.0, 1, 1, 1])}, "not a rotation"),
        ({"image_plane_to_probe": np.full((4, 4), np.nan)}, "holds NaN"),
        ({"covariance": np.full((6, 6), np.nan)}, "covariance holds NaN"),
        ({"covariance": -np.eye(6)}, "negative variance"),
        ({"range_factor": 0.0}, "range_factor must be positive"),
        ({"face_offset_mm": np.inf}, "face_offset_mm holds NaN or Inf"),
        ({"image_plane_to_probe": FAR}, "image_plane_to_probe holds a number beyond 1e\\+07"),
        ({"scale_mm_per_px": (1e300, 0.1)}, "scale_mm_per_px holds a number beyond"),
        ({"unknowns": ("translation", "rotation", "nonsense")}, "unknowns must be"),
        ({"image_covariance": np.eye(5)}, r"must have shape \(6, 6\)"),
        ({"error_mm": -1.0}, "error_mm must not be negative"),
        ({"probe_frame": 5}, "probe_frame must be text, not 5"),
        ({"source": 5}, "source must be text, not 5"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_transforms_that_cannot_be(change, message):
    with pytest.raises(InputError, match=message):
        replace(random_transform(), **change)


@pytest.mark.usefixtures("unchecked")
def test_a_pair_of_sizes_will_do_and_a_failed_one_is_not_written(tmp_path):
    made = ImageTransform(np.eye(4), (0.1, 0.2))
    assert made.plus_matrix()[2, 1] == 0.2
    lost = ImageTransform(np.full((4, 4), np.nan), converged=False, error_mm=np.nan)
    with pytest.raises(InputError, match="the solve had failed"):
        lost.save(tmp_path / "cal.json")


def test_npz_that_lies(tmp_path):
    path = tmp_path / "cal.npz"
    for content, message in (
        (b"PK\x03\x04", "holds no arrays of numbers"),
        ({"image_plane_to_probe": np.array([{}])}, "holds no arrays of numbers"),
        ({"image_plane_to_probe": np.eye(3)}, "must have shape"),
        ({"scale_mm_per_px": np.ones(2)}, "image_plane_to_probe is missing"),
    ):
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            np.savez(path, **content)
        with pytest.raises(FormatError, match=message):
            load_calibration(path)
    np.savez_compressed(path, image_plane_to_probe=np.zeros((4, 4)), more=np.zeros(10**6))
    assert path.stat().st_size < 10_000
    with pytest.raises(FormatError, match="more than a calibration"):
        load_calibration(path)


def test_one_format_at_a_time(saved, tmp_path, capsys):
    assert main(["export", str(saved), "--plus", "--slicer", str(tmp_path / "a.tfm")]) == 2
    assert "--plus and --slicer: one format at a time" in capsys.readouterr().err
    assert not list(tmp_path.glob("a.tfm"))


def test_ros_is_rigid_and_in_metres(tmp_path):
    known = random_transform()
    known.save(tmp_path / "cal.yaml")
    np.testing.assert_allclose(
        read_ros_yaml(tmp_path / "cal.yaml")[0], known.image_plane_to_probe, atol=1e-12
    )
    text = (tmp_path / "cal.yaml").read_text()
    x = float(re.search(r"--x (\S+) ", text)[1])
    assert x == pytest.approx(known.image_plane_to_probe[0, 3] / 1000)
    assert "--frame-id probe --child-frame-id image" in text
    # ROS tells upper case from lower.
    named = known.text("ros", frames=("US_Image", "tool0_Flange"))
    assert "--frame-id tool0_Flange --child-frame-id US_Image" in named
    assert "robot_effector_frame: tool0_Flange\n  tracking_base_frame: US_Image\n" in named
    for format, twice in (("ros", ("a", "a")), ("plus", ("image", "Image"))):
        with pytest.raises(InputError, match=r"another, not from (a to a|Image to Image)"):
            known.text(format, frames=twice)
    # A number without a point would be text in YAML 1.1.
    tiny = ImageTransform(np.eye(4) + np.pad([[1e-2]], ((0, 3), (3, 0))))
    assert "x: 1.0e-05\n" in tiny.text("ros")
    edited = tiny.text("ros").replace("qw: 1.0", "qw: 1.0  # the scalar")
    (tmp_path / "cal.yaml").write_text(edited)
    np.testing.assert_array_equal(read_ros_yaml(tmp_path / "cal.yaml")[0][:3, 0], [1, 0, 0])
    (tmp_path / "cal.yaml").write_text(edited.replace("qw: 1.0", "qw: 1.0#"))
    with pytest.raises(FormatError, match=r"qw is not a number: '1\.0#'"):
        read_ros_yaml(tmp_path / "cal.yaml")
    (tmp_path / "cal.yaml").write_text(edited.replace("  y: 0.0\n", "  y: -31.2\n"))
    with pytest.raises(FormatError, match=r"31\.2 m from the probe's frame: .* look like mm"):
        read_ros_yaml(tmp_path / "cal.yaml")
    # No pixels are needed, unlike everywhere else; the image may have had them.
    with pytest.raises(
        InputError, match=r"no pixel size is known, .* \(jaxcal export with --pixel"
    ):
        tiny.plus_matrix()


def test_ros_says_what_a_rigid_transform_cannot_hold(tmp_path, capsys):
    known = replace(random_transform(), range_factor=0.9991)
    known.save(tmp_path / "cal.json")
    assert main(["export", str(tmp_path / "cal.json"), str(tmp_path / "a.yaml"), "--ros"]) == 0
    lateral, axial = known.scale_mm_per_px / 1e3
    note = (
        f"multiply u by {lateral:.9g} m and v by {axial:.9g} m (a pixel's size), then multiply "
        "ranges by 0.9991 (the estimated sound speed), then add 0.0015 m"
    )
    assert f"- not in this rigid transform: {note}" in capsys.readouterr().out
    assert f"# not in this rigid transform: {note}" in (tmp_path / "a.yaml").read_text()
    assert "x lateral (along u), y elevational, z depth" in (tmp_path / "a.yaml").read_text()
    # With that both agree.
    pixel = np.array([300.0, 400.0])
    lateral, deep = known.scale_mm_per_px * pixel
    rigid, _ = read_ros_yaml(tmp_path / "a.yaml")
    found = rigid @ [lateral, 0.0, 0.9991 * deep + 1.5, 1.0]
    np.testing.assert_allclose(found[:3], known.apply(pixel).points[0], atol=1e-9)
    points = replace(random_transform(offset=0.0), scale_mm_per_px=None)
    assert "not in" not in points.text("ros")


def test_tus_rec_counts_from_one(tmp_path):
    known = random_transform()
    known.save(tmp_path / "calib_matrix.csv")
    lines = (tmp_path / "calib_matrix.csv").read_text().splitlines()
    assert len(lines) == 10
    scaling, rigid = (
        np.array([[float(cell) for cell in line.split(",")] for line in lines[k : k + 4]])
        for k in (1, 6)
    )
    pixel = np.array([17.0, 230.0])
    counted = rigid @ scaling @ [*(pixel + 1), 0, 1]
    np.testing.assert_allclose(counted[:3], known.apply(pixel).points[0], atol=1e-11)


def test_a_calib_matrix_with_further_lines(tmp_path):
    """UCL's own has a unit after a heading, and the lag of the images."""
    known = random_transform()
    path = tmp_path / "calib_matrix.csv"
    known.save(path)
    text = path.read_text()
    path.write_text(text.replace("_to_mm\n", "_to_mm_unit\n") + "time_difference\n0.2s\n")
    pixel = np.array([17.0, 230.0])
    found = load_calibration(path).apply(pixel).points
    np.testing.assert_allclose(found, known.apply(pixel).points, atol=1e-11)
    for wrong in (text.replace("spatial", "special"), text.splitlines()[0] + "\n"):
        path.write_text(wrong)
        with pytest.raises(InputError, match="its first ten lines are"):
            load_calibration(path)


def test_tus_rec_scan(tmp_path):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (5, 8, 9), dtype=np.uint8)
    transforms = np.tile(np.eye(4), (5, 1, 1))
    transforms[:, 0, 3] = np.arange(5)
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["tforms"] = transforms
        file.create_dataset("frames", data=frames, chunks=(1, 8, 9), compression="gzip")
    found = read_scan(tmp_path / "scan.h5")
    np.testing.assert_array_equal(found.poses("Tool", "Tracker")[0], transforms)
    np.testing.assert_array_equal(np.array(list(found.images([1, 3]))), frames[[1, 3]])
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(FormatError, match=r"other\.h5: is no scan of TUS-REC"):
        read_scan(tmp_path / "other.h5")
    with h5py.File(tmp_path / "rec.h5", "w") as file:
        file.create_group("calibration")
    with pytest.raises(FormatError, match=r"rec\.h5: is a recording of jaxcal already"):
        read_scan(tmp_path / "rec.h5")
    with pytest.raises(FormatError, match=r"rec\.h5: is a recording: calibrate it first"):
        load_calibration(tmp_path / "rec.h5")
    with h5py.File(tmp_path / "none.h5", "w") as file:
        file["tforms"] = transforms[:0]
    with pytest.raises(FormatError, match=r"none\.h5: holds no frames"):
        read_scan(tmp_path / "none.h5")


# ITK and Slicer.


def slicer_snippet(parameters, fixed):
    """Slicer's documented way from an ITK transform to its own matrix (script repository)."""
    lps = np.diag([-1.0, -1.0, 1.0, 1.0])
    linear, translation = np.reshape(parameters[:9], (3, 3)), np.array(parameters[9:])
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = translation + fixed - linear @ fixed
    return np.linalg.inv(lps @ matrix @ lps)


@pytest.mark.parametrize("fixed", [np.zeros(3), np.array([5.0, -3.0, 40.0])])
def test_slicers_documented_snippet(fixed):
    matrix = random_transform().plus_matrix()
    parameters = itk_from_matrix(matrix)
    # The same transform about another centre.
    linear = parameters[:9].reshape(3, 3)
    parameters[9:] += linear @ fixed - fixed
    np.testing.assert_allclose(slicer_snippet(parameters, fixed), matrix, rtol=0, atol=1e-12)
    found = matrix_from_itk("AffineTransform_double_3_3", parameters, fixed)
    np.testing.assert_allclose(found, matrix, rtol=0, atol=1e-12)


@pytest.mark.parametrize("extension", ["tfm", "txt", "h5"])
def test_itk_files_by_itk(tmp_path, extension):
    sitk = pytest.importorskip("SimpleITK")
    matrix = random_transform().plus_matrix()
    path = tmp_path / f"t.{extension}"
    write_itk(path, matrix)
    read = sitk.ReadTransform(str(path))
    np.testing.assert_array_equal(read.GetParameters(), itk_from_matrix(matrix))
    np.testing.assert_array_equal(read.GetFixedParameters(), [0, 0, 0])
    # And the other way, with a centre, and as rigid transforms.
    affine = sitk.AffineTransform(3)
    affine.SetCenter((1.0, 2.0, 3.0))
    affine.SetMatrix(itk_from_matrix(matrix)[:9].tolist())
    versor = sitk.VersorRigid3DTransform()
    versor.SetRotation((1.0, 2.0, -1.0), 0.7)
    versor.SetTranslation((4.0, 5.0, 6.0))
    versor.SetCenter((1.0, -2.0, 3.0))
    euler = sitk.Euler3DTransform((9.0, 8.0, 7.0), 0.3, -0.5, 0.9, (1.0, 2.0, 3.0))
    for transform in (affine, versor, euler):
        sitk.WriteTransform(transform, str(path))
        found = read_itk(path)
        lps = np.diag([-1.0, -1.0, 1.0])
        for point in np.random.default_rng(0).normal(size=(5, 3)) * 50:
            stored = lps @ np.array(transform.TransformPoint((lps @ point).tolist()))
            np.testing.assert_allclose((found @ [*stored, 1])[:3], point, atol=1e-9)


def test_itk_hdf5_on_a_full_disk(tmp_path):
    path = tmp_path / "t.h5"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OutputError, match=r"t\.h5: cannot be written: File too large"):
            write_itk(path, np.eye(4))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (itk_text(np.eye(4)).replace("#Insight", "#Outsight"), "its first line does not say so"),
        (itk_text(np.eye(4)).replace(" 1.0 ", " nan "), "holds NaN"),
        (itk_text(np.eye(4)).replace(" 1.0 ", " ", 1), "with 11 parameters is not read"),
        (itk_text(np.eye(4)).replace(" 1.0 ", " 0.0 "), "is singular"),
        (itk_text(np.eye(4)).replace("Affine", "BSpline"), "is not read"),
        (itk_text(np.eye(4)) + "Transform: X\n", "a second 'Transform'"),
        ("#Insight Transform File V1.0\n", "holds no transform"),
    ],
)
def test_itk_text_that_lies(tmp_path, text, message):
    (tmp_path / "t.tfm").write_text(text)
    with pytest.raises(FormatError, match=message) as caught:
        read_itk(tmp_path / "t.tfm")
    assert str(caught.value).startswith(str(tmp_path / "t.tfm"))


def test_itk_hdf5_that_claims_a_gigabyte_of_text(tmp_path):
    """A text of fixed size that is not stored is read as so many zeros."""
    path = tmp_path / "t.h5"
    write_itk(path, np.eye(4))
    kind = h5py.h5t.C_S1.copy()
    kind.set_size(2**30)
    with h5py.File(path, "a") as file:
        one = file["TransformGroup/0"]
        del one["TransformType"]
        h5py.h5d.create(one.id, b"TransformType", kind, h5py.h5s.create_simple((1,)))
    with pytest.raises(FormatError, match="TransformType is too long"):
        read_itk(path)


# Applying.


def test_apply_with_pose_and_covariance():
    """Against a Monte-Carlo simulation of the stated law."""
    known = random_transform(4)
    small = ImageTransform(
        known.image_plane_to_probe, known.scale_mm_per_px, 1.5, known.covariance * 1e-4
    )
    pose = random_transform(5).image_plane_to_probe
    pixel = np.array([300.0, 410.0])
    applied = small.apply(pixel, pose, pixel_sd_px=(0.1, 0.3))
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(np.zeros(6), small.covariance, 40_000)
    moved = pixel + rng.normal(size=(40_000, 2)) * [0.1, 0.3]
    s_u, s_v = small.scale_mm_per_px
    plane = np.stack([s_u * moved[:, 0], np.zeros(40_000), s_v * moved[:, 1] + 1.5], axis=1)
    plane = plane + draws[:, :3] + np.cross(draws[:, 3:], plane)
    x = pose @ small.image_plane_to_probe
    points = plane @ x[:3, :3].T + x[:3, 3]
    np.testing.assert_allclose(points.mean(axis=0), applied.points[0], atol=5e-3)
    spread = np.cov(points.T)
    np.testing.assert_allclose(applied.covariance[0], spread, atol=0.03 * np.trace(spread))


def test_places_in_the_image_plane_and_back():
    """The estimated sound speed makes pixels longer along the beam."""
    known = replace(random_transform(7, offset=1.5), range_factor=1.04)
    pixels = np.array([[300.0, 410.0], [-20.0, 3.0]])
    size = known.scale_mm_per_px * [1.0, 1.04]
    np.testing.assert_allclose(known.pixel_size_mm(), size)
    places = known.in_plane(pixels)
    np.testing.assert_allclose(places[:, [0, 2]], pixels * size + [0.0, 1.5])
    assert not places[:, 1].any()
    np.testing.assert_allclose(known.image_points(places[:, [0, 2]]), pixels)
    with pytest.raises(InputError, match="no pixel size is known"):
        random_transform(scale=None).pixel_size_mm()


def test_pixels_for_a_calibration_in_mm():
    known = random_transform(scale=None, offset=0.0)
    with_pixels = known.with_pixels((0.2, 0.1), (64.0, -10.0))
    millimetres = np.array([[3.0, 40.0], [-7.0, 12.0]])
    pixels = millimetres / [0.2, 0.1] + [64.0, -10.0]
    expected, found = known.apply(millimetres), with_pixels.apply(pixels)
    np.testing.assert_allclose(found.points, expected.points, atol=1e-11)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-11)
    with pytest.raises(InputError, match="pixels of its own"):
        with_pixels.with_pixels((1.0, 1.0))
    for size, origin, said in (
        ((0.2, 1e308), (0.0, 0.0), "no ultrasound image's is over 10 mm"),
        ((200.0, 200.0), (0.0, 0.0), "the spacing is 200 mm per pixel"),
        ((2e-4, 2e-4), (0.0, 0.0), "looks like metres"),
        ((1e-320, 0.1), (0.0, 0.0), "looks like metres"),
        ((np.nan, 0.1), (0.0, 0.0), "two positive numbers"),
        ((0.2, 0.1), (1e308, 0.0), "its origin two numbers up to 1e"),
        ((0.2, 0.1), (0.0, np.nan), "its origin two numbers up to 1e"),
    ):
        with pytest.raises(InputError, match=said):
            known.with_pixels(size, origin)


@pytest.mark.parametrize(
    ("pixels", "pose", "message"),
    [
        ([[1.0, 2, 3]], None, "shape"),
        ([[np.nan, 2]], None, "not NaN"),
        ([[1.0, 2]], np.eye(4)[None].repeat(2, 0), "1 pixels but 2 poses"),
        ([[1.0, 2]], np.diag([1.0, 1, -1, 1]), "is a reflection"),
        ([[1.0, 2]], np.eye(4, dtype=complex), "pose must be an array of real numbers"),
    ],
)
def test_apply_refuses(pixels, pose, message):
    with pytest.raises(InputError, match=message):
        random_transform().apply(np.array(pixels), pose)


# What is loaded.


def test_older_json(tmp_path):
    """Before version 1 the field had the name of PLUS's matrix."""
    known = random_transform(offset=0.0)
    record = {
        "method": "joint", "image_to_probe": known.image_plane_to_probe.tolist(),
        "scale_mm_per_px": known.scale_mm_per_px.tolist(), "jaxcal_version": "0.1.0",
    }  # fmt: skip
    (tmp_path / "old.json").write_text(json.dumps(record))
    found = load_calibration(tmp_path / "old.json")
    np.testing.assert_allclose(found.plus_matrix(), known.plus_matrix(), atol=1e-12)


def test_date_and_version_are_saved(tmp_path):
    """A file says when its calibration was made, also after it was read and written again."""
    made, again = tmp_path / "made.json", tmp_path / "again.json"
    before = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    random_transform().save(made)
    record = json.loads(made.read_text())
    date = datetime.datetime.fromisoformat(record["date"])
    assert before <= date <= datetime.datetime.now(datetime.UTC)
    assert record["jaxcal_version"] == jaxcal.__version__
    made.write_text(json.dumps(record | {"date": "2020-02-03T04:05:06Z"}))
    load_calibration(made).save(again)
    assert json.loads(again.read_text())["date"] == "2020-02-03T04:05:06Z"
    # PLUS has local times, without a zone.
    local = datetime.datetime(2020, 2, 3, 4, 5, 6, tzinfo=datetime.UTC).astimezone()
    config = tmp_path / "config.xml"
    config.write_text("<PlusConfiguration><CoordinateDefinitions /></PlusConfiguration>")
    assert main(["export", str(again), "--plus-config", str(config)]) == 0
    assert f'Date="{local:%Y.%m.%d %H:%M:%S}"' in config.read_text()


def good_record():
    return json.loads(random_transform().text("json"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "its format is 'other'"),
        ({"version": 2}, "understands version 1: update jaxcal"),
        ({"date": "2020-02-03T04:05:06"}, "date must be ISO 8601 with a time zone"),
        ({"date": [1]}, "date must be text"),
        ({"version": "x"}, "is version 'x'"),
        (
            {"image_plane_to_probe": None},
            "image_plane_to_probe is missing, or the solve had failed",
        ),
        ({"image_plane_to_probe": [1] * 15}, r"must have shape \(4, 4\), it has \(15,\)"),
        ({"image_plane_to_probe": "x"}, "must be numbers"),
        ({"image_plane_to_probe": [[None] * 4] * 4}, "image_plane_to_probe holds NaN or Inf"),
        (
            {"image_plane_to_probe": [[None] * 4] * 4, "converged": False},
            "image_plane_to_probe is missing, or the solve had failed",
        ),
        ({"scale_mm_per_px": [np.nan, np.nan]}, "scale_mm_per_px holds NaN or Inf"),
        ({"range_factor": np.inf}, "range_factor holds NaN or Inf"),
        ({"tre": {"factor": 0}}, "tre_factor must be positive"),
        ({"degrees_of_freedom": 0}, "degrees_of_freedom must be at least 1"),
        ({"variance_factor": 0.5}, "variance_factor must be at least 1"),
        ({"tre": {"factor": "x"}}, "factor must be numbers"),
        ({"converged": "false"}, "converged must be true, false or null"),
        ({"converged": 0}, "converged must be true, false or null"),
        ({"version": -1}, "is version '-1'"),
        ({"version": True}, "is version 'True'"),
        ({"image_plane_to_probe": np.diag([1, 1, -1, 1]).tolist()}, "is a reflection"),
        ({"scale_mm_per_px": [0, 1]}, "must be positive"),
        # What was changed in one matrix alone, or is missing, was passed over.
        ({"plus_image_to_probe": np.diag([0.148, 0.14, 0.1, 1]).tolist()}, "contradicts"),
        ({"scale_mm_per_px": None}, "plus_image_to_probe contradicts"),
        ({"face_offset_mm": None}, "plus_image_to_probe contradicts"),
        ({"plus_image_to_probe": "x"}, "must be numbers"),
        ({"covariance": [[1]]}, r"must have shape \(6, 6\)"),
        (
            {"covariance": np.eye(6).tolist(), "image_covariance": (4 * np.eye(6)).tolist()},
            "image_covariance contradicts covariance",
        ),
    ],
)
def test_json_that_lies(tmp_path, change, message):
    (tmp_path / "c.json").write_text(json.dumps(good_record() | change))
    with pytest.raises(InputError, match=message) as caught:
        load_calibration(tmp_path / "c.json")
    assert str(caught.value).startswith(str(tmp_path / "c.json"))


NEARLY_PARALLEL = np.eye(4)
"""Rows and columns of pixels along one direction: by rounding, its cosine with itself exceeds 1."""
NEARLY_PARALLEL[:3, :3] = 0.1 * np.array([[1, 1, -1], [2, 2 + 1e-9, 0], [1, 1, 0]])


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([0.1, -0.1, 0.1, 1]), "is a reflection"),
        (np.diag([0.1, 0, 0.1, 1]), "flat"),
        (np.diag([0.1, 1e-10, 0.1, 1]), "pixels have no size"),
        (np.diag([1.5e-4, 1.4e-4, 1.5e-4, 1]), "looks like metres"),
        (np.diag([150.0, 140.0, 150.0, 1]), "give it in mm"),
        (np.diag([0.1, np.nan, 0.1, 1]), "finite"),
        (np.diag([0.1, 0.1, 0.1, 2]), "last row"),
        (np.eye(4) + np.pad([[0.1]], ((0, 3), (1, 2))), "degrees apart: fCal fitted"),
        (NEARLY_PARALLEL, "are 0.000 degrees apart"),
        (random_transform().image_plane_to_probe, "the matrix is rigid, as if a pixel measured"),
    ],
)
def test_matrices_that_are_no_calibration(matrix, message):
    with pytest.raises(InputError, match=message):
        transform_from_plus_matrix(matrix)


def test_the_identity_of_a_configuration_is_no_calibration(tmp_path):
    """What PLUS's examples and a new transform of Slicer hold."""
    numbers = " ".join(str(value) for value in np.eye(4, dtype=int).ravel())
    (tmp_path / "c.xml").write_text(f'<Transform From="Image" To="Probe" Matrix="{numbers}" />')
    (tmp_path / "c.tfm").write_text(itk_text(np.eye(4)))
    for name in ("c.xml", "c.tfm"):
        with pytest.raises(InputError, match=rf"{name}: .* identity: it was not calibrated"):
            load_calibration(tmp_path / name)


def test_a_complex_matrix_is_no_calibration():
    with pytest.raises(InputError, match="the matrix must be an array of real numbers"):
        check_affine(np.eye(4, dtype=complex))


def test_json_bombs(tmp_path):
    (tmp_path / "c.json").write_text("[" * 100_000)
    with pytest.raises(FormatError, match="is not JSON"):
        load_calibration(tmp_path / "c.json")
    (tmp_path / "c.npy").write_bytes(b"\x80\x04cos\nsystem\n")
    with pytest.raises(FormatError, match="is not an array of numbers"):
        load_calibration(tmp_path / "c.npy")
    np.save(tmp_path / "c.npy", np.eye(4))
    content = (tmp_path / "c.npy").read_bytes()
    (tmp_path / "c.npy").write_bytes(content.replace(b"(4, 4)", b"((4, 4"))
    with pytest.raises(FormatError, match="is not an array of numbers"):
        load_calibration(tmp_path / "c.npy")
    np.savez(tmp_path / "c.npz", image_plane_to_probe=np.eye(4))
    content = (tmp_path / "c.npz").read_bytes()
    # A method of packing that nobody knows, in both of the archive's lists.
    for start, place in ((b"PK\3\4", 8), (b"PK\1\2", 10)):
        at = content.index(start) + place
        content = content[:at] + b"\x63\0" + content[at + 2 :]
    (tmp_path / "c.npz").write_bytes(content)
    with pytest.raises(FormatError, match="holds no arrays of numbers"):
        load_calibration(tmp_path / "c.npz")
    np.save(tmp_path / "c.npy", (0.1 + 1j) * np.eye(4))
    with pytest.raises(FormatError, match="is not an array of real numbers"):
        load_calibration(tmp_path / "c.npy")


def test_quaternions_there_and_back():
    quaternions = np.random.default_rng(0).normal(size=(50, 4))
    quaternions[:4] = np.eye(4)
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    quaternions *= np.where(quaternions[:, 3:] < 0, -1, 1)
    for quaternion, rotation in zip(
        quaternions, rotations_from_quaternions(quaternions, "xyzw"), strict=True
    ):
        found = quaternions_from_rotations(rotation[None])[0]
        assert min(np.abs(found - quaternion).max(), np.abs(found + quaternion).max()) < 1e-14
    first = rotations_from_quaternions(quaternions[:, [3, 0, 1, 2]], "wxyz")
    np.testing.assert_allclose(first, rotations_from_quaternions(quaternions, "xyzw"), atol=1e-14)


# Command lines.


@pytest.fixture
def saved(tmp_path):
    random_transform().save(tmp_path / "cal.json")
    return tmp_path / "cal.json"


@pytest.mark.parametrize("name", ["plus", "slicer", "itk", "ros", "tusrec", "numpy"])
def test_export_to_standard_output(saved, capsys, name):
    assert main(["export", str(saved), f"--{name}"]) == 0
    assert capsys.readouterr().out == random_transform().text(name)


@pytest.mark.usefixtures("unchecked")
def test_what_an_unknown_format_leaves_out_is_not_asked():
    with pytest.raises(InputError, match="'xyz' is not a format"):
        jaxcal.ImageTransform(np.eye(4)).left_out("xyz")


def test_the_ending_names_the_format(saved, tmp_path, capsys):
    for ending in ("xml", "tfm", "yaml", "csv", "npy", "npz"):
        out = tmp_path / f"a.{ending}"
        assert main(["export", str(saved), str(out)]) == 0
        np.testing.assert_allclose(
            load_calibration(out).plus_matrix(), random_transform().plus_matrix(), atol=1e-12
        )
    assert main(["export", str(saved), str(tmp_path / "a.doc")]) == 2
    assert "its extension names no format" in capsys.readouterr().err


def test_a_name_that_plus_refuses_is_told(saved, tmp_path, capsys):
    """NDI ToolBox calls its tools Port 1."""
    saved.write_text(json.dumps(good_record() | {"pose_frames": {"from": "Port 1", "to": "T"}}))
    note = "calls the probe's frame 'Port 1', which PLUS refuses: written as Probe"
    for name, said in (("plus", note), ("ros", note), ("slicer", None)):
        assert main(["export", str(saved), f"--{name}"]) == 0
        assert (said or "calls") not in (found := capsys.readouterr()).out
        assert found.err.count(note) == (said is not None)
    assert main(["export", str(saved), "--plus", "--probe-frame", "Wand"]) == 0
    found = capsys.readouterr()
    assert (found.err, 'To="Wand"' in found.out) == ("", True)
    load_calibration(saved).save(tmp_path / "again.json")
    assert load_calibration(tmp_path / "again.json").probe_frame == "Port 1"
    saved.write_text(json.dumps(good_record() | {"pose_frames": {"from": "Tip-1", "to": "T"}}))
    assert main(["export", str(saved), "--ros"]) == 2
    assert "'Tip-1' cannot name a frame in ROS: letters, digits, _ and /" in capsys.readouterr().err


def test_export_to_files(saved, tmp_path, capsys):
    for name, out in (("slicer", "a.tfm"), ("itk", "a.h5"), ("numpy", "a.npz"), ("numpy", "a.npy")):
        assert main(["export", str(saved), f"--{name}", str(tmp_path / out)]) == 0
    matrix = random_transform().plus_matrix()
    with np.load(tmp_path / "a.npz") as arrays:
        np.testing.assert_array_equal(arrays["plus_image_to_probe"], matrix)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), matrix)
    np.testing.assert_allclose(
        load_calibration(tmp_path / "a.h5").plus_matrix(), matrix, atol=1e-12
    )
    capsys.readouterr()
    assert main(["export", str(saved)]) == 2
    assert "name one format" in capsys.readouterr().err
    assert main(["export", str(saved), "--numpy", "--probe-frame", "tool0"]) == 2
    assert "--numpy names no frames" in capsys.readouterr().err


def test_what_did_not_converge_is_not_handed_on(saved, capsys):
    saved.write_text(json.dumps(good_record() | {"converged": False}))
    for command in (["export", "--plus"], ["apply", "--pixel", "1", "2"], ["serve"]):
        assert main([command[0], str(saved), *command[1:]]) == 2
        assert "must not be used" in capsys.readouterr().err


NOT_TWO_NAMES = """
import numpy as np
from jaxcal import ImageTransform, InputError
known = ImageTransform(np.eye(4), scale_mm_per_px=np.ones(2))
for form in ("plus", "ros"):
    for frames in ("Image", ("Image",), (), ("Image", 3), ("A", "B", "C")):
        try:
            print(form, frames, known.text(form, frames=frames))
        except InputError as error:
            assert str(error).startswith("frames must be two names"), error
    assert known.text(form, frames=["Image", "Probe"]) == known.text(form)
    assert known.text(form, frames=None) == known.text(form)
"""


def test_frames_are_two_names():
    """One name alone gave frames of its letters, I and m; others a raw error.

    In a process of its own: here annotations are checked, which they are not for a user.
    """
    done = subprocess.run(
        [sys.executable, "-c", NOT_TWO_NAMES], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_apply_to_a_table(saved, tmp_path, capsys):
    (tmp_path / "p.csv").write_text("v;u\n12,5;300\n40;7,25\n")
    assert main(["apply", str(saved), str(tmp_path / "p.csv"), "--pixel-sd", "0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    applied = random_transform().apply(np.array([[300, 12.5], [7.25, 40]]), pixel_sd_px=0.5)
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    sds = np.sqrt(np.diagonal(applied.covariance, axis1=1, axis2=2))
    np.testing.assert_array_equal(rows[:, :6], np.hstack([applied.points, sds]).round(6))
    upper = applied.covariance[:, [0, 0, 1], [1, 2, 2]]
    np.testing.assert_allclose(rows[:, 6:], upper, rtol=5e-6)
    (tmp_path / "p.csv").write_text("lateral,range\n1,2\n")
    assert main(["apply", str(saved), str(tmp_path / "p.csv")]) == 2
    assert "the calibration takes pixels" in capsys.readouterr().err


def test_apply_tells_of_ranges_that_begin_elsewhere(saved, tmp_path, capsys):
    known = random_transform()
    poses = np.tile(np.eye(4), (4, 1, 1))
    for offset in (known.face_offset_mm, known.face_offset_mm + 7):
        pixels = make_images(poses, np.full((4, 2), 50.0), "pixel", face_offset_mm=offset,
                             spacing_mm=known.scale_mm_per_px)  # fmt: skip
        jaxcal.save(Recording(pixels), tmp_path / "r.h5")
        assert main(["apply", str(saved), str(tmp_path / "r.h5")]) == 0
        told = f"- Ranges begin at {known.face_offset_mm:.6g} mm in "
        assert (told in capsys.readouterr().err) == (offset != known.face_offset_mm)


def test_apply_says_how_a_table_has_points_in_mm(tmp_path, capsys):
    random_transform(scale=None).save(tmp_path / "mm.json")
    (tmp_path / "px.csv").write_text("u,v\n1,50\n")
    (tmp_path / "mm.csv").write_text("u_mm,v_mm\n1,50\n")
    given = ["apply", str(tmp_path / "mm.json")]
    assert main([*given, str(tmp_path / "px.csv")]) == 2
    said = capsys.readouterr().err
    assert "holds pixels, the calibration takes points in mm (a table with them has u_mm" in said
    assert main([*given, str(tmp_path / "mm.csv")]) == 0
    raw = jaxcal.simulate_recording(jaxcal.Protocol(images=4, raw=True))
    jaxcal.save(raw, tmp_path / "raw.h5")
    assert main([*given, str(tmp_path / "raw.h5")]) == 2
    assert "holds times of flight, the calibration takes points in mm" in capsys.readouterr().err


def test_apply_tells_that_the_verdict_expects_more_than_the_covariance_says(tmp_path, capsys):
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=40), seed=3)
    points = np.array(recording.calibration.measurements)
    points[7, 0] += 12.0  # of another target
    images = replace(recording.calibration, measurements=points)
    result = jaxcal.calibrate(replace(recording, calibration=images))
    factor = result.record()["tre"]["factor"]
    assert factor > 1
    for name in ("c.json", "c.npz"):
        result.save(tmp_path / name)
        assert load_calibration(tmp_path / name).tre_factor == pytest.approx(factor)
    assert main(["apply", str(tmp_path / "c.json"), "--pixel", "1", "40"]) == 0
    assert f"its verdict expects errors {factor:.1f} times as large" in capsys.readouterr().err
    assert f"{factor:.1f} times as large" in repr(load_calibration(tmp_path / "c.json"))


def test_apply_refuses_options_of_a_table_where_none_is_read(saved, tmp_path, capsys):
    rest = ["--pose-units", "m", "--quaternion", "wxyz", "--skip-invalid", "--invert-poses"]
    for source in (["--pixel", "1", "2"], [str(tmp_path / "rec.h5")]):
        assert main(["apply", str(saved), *source, *rest]) == 2
        told = "--skip-invalid, --invert-poses: for tables, but no table is read"
        assert told in capsys.readouterr().err


def test_apply_refuses_options_of_poses_where_a_table_has_none(saved, tmp_path, capsys):
    uv = tmp_path / "uv.csv"
    uv.write_text("u,v\n1,2\n")
    for given in (["--quaternion", "wxyz"], ["--pose-units", "m"], ["--invert-poses"]):
        assert main(["apply", str(saved), str(uv), *given]) == 2
        assert f"{given[0]}: for poses, but {uv} holds none" in capsys.readouterr().err
    assert main(["apply", str(saved), str(uv), "--skip-invalid"]) == 0


def test_apply_refuses_poses_that_look_like_metres(saved, tmp_path, capsys):
    """Points came out as if the probe had hardly moved, without a word."""
    table = tmp_path / "p.csv"
    places = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 3))
    rows = [f"300,12,{x},{y},{z},0,0,0,1" for x, y, z in places.tolist()]
    table.write_text("\n".join(["u,v,x,y,z,qx,qy,qz,qw", *rows]))
    assert main(["apply", str(saved), str(table)]) == 2
    said = capsys.readouterr().err
    assert f"{table}: pose translations reach only" in said
    assert "look like metres; give them in mm (--pose-units m)" in said
    assert main(["apply", str(saved), str(table), "--pose-units", "m"]) == 0
    got = np.array([line.split(",")[:3] for line in capsys.readouterr().out.splitlines()[1:]])
    still = random_transform().apply(np.array([[300.0, 12.0]])).points
    np.testing.assert_array_equal(got.astype(float), (still + 1e3 * places).round(6))


def test_served_to_another_client():
    """pyigtl, which is not ours, gets the matrix at once, and again."""
    pyigtl = pytest.importorskip("pyigtl")
    matrix = random_transform().plus_matrix()
    stop = threading.Event()
    with TransformServer("ImageToProbe", matrix, port=0) as server:
        thread = threading.Thread(target=server.serve, args=(0.02, stop.is_set))
        thread.start()
        client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
        try:
            for _ in range(2):
                message = client.wait_for_message("ImageToProbe", timeout=180)
                np.testing.assert_allclose(message.matrix, matrix, atol=1e-4)
        finally:
            client.stop()
            stop.set()
            thread.join()


@pytest.mark.parametrize(
    ("frame", "options", "name"),
    [("UsProbe", [], b"ImageToUsProbe"), ("UsProbe", ["--name", "Mine"], b"Mine")],
)
def test_served_by_the_name_of_the_recordings_frame(saved, frame, options, name):
    saved.write_text(json.dumps(good_record() | {"pose_frames": {"from": frame, "to": "Tracker"}}))
    received = []
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def listen():
        try:
            for _ in range(200):
                with suppress(ConnectionRefusedError):
                    with socket.create_connection(("127.0.0.1", port), 10) as link:
                        received.append(link.recv(58, socket.MSG_WAITALL)[14:34].rstrip(b"\0"))
                    return
                time.sleep(0.02)
        finally:
            signal.raise_signal(signal.SIGINT)

    listener = threading.Thread(target=listen)
    listener.start()
    assert main(["serve", str(saved), "--port", str(port), *options]) == 130
    listener.join()
    assert received == [name]


@pytest.mark.parametrize("status", ["SUCCESS", "FAIL"])
def test_set_in_a_running_plus_server(saved, capsys, status):
    """By another implementation of OpenIGTLink, which streams and replies as PLUS does."""
    pyigtl = pytest.importorskip("pyigtl")
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    server = pyigtl.OpenIGTLinkServer(port=0, local_server=True)
    for number, handler in handlers.items():
        signal.signal(number, handler)
    image = pyigtl.ImageMessage(np.zeros((1, 40, 30), np.uint8), device_name="Image")
    received = []
    stop = threading.Event()

    def serve():
        while not stop.is_set():
            server.send_message(image)
            for message in server.get_latest_messages():
                received.append(message)
                reply = f'<CommandReply Name="UpdateTransform" Status="{status}" Message="said"/>'
                name = message.device_name.replace("CMD", "ACK")
                server.send_message(pyigtl.StringMessage(reply, device_name=name))
            stop.wait(0.02)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        port = server.server_address[1]
        code = main(["export", str(saved), "--plus-server", f"127.0.0.1:{port}"])
    finally:
        stop.set()
        thread.join()
        server.stop()
    output = capsys.readouterr()
    assert code == (0 if status == "SUCCESS" else 2)
    assert ("Image to Probe set; said" in output.out) == (status == "SUCCESS")
    assert ("refuses the transform: 'said'" in output.err) == (status == "FAIL")
    numbers = re.search(r'TransformValue="([^"]*)"', received[0].string)[1].split()
    sent = np.array(numbers, float).reshape(4, 4)
    np.testing.assert_allclose(sent, random_transform().plus_matrix(), atol=1e-12)


def test_a_plus_servers_reply_of_header_version_2(saved, capsys):
    """An extended header before the text, metadata after it."""
    text = b'<CommandReply Status="SUCCESS" Message="said"/>'
    content = struct.pack(">HH", 3, len(text)) + text
    metadata = struct.pack(">HHHI", 1, 1, 3, 1) + b"ab"
    body = struct.pack(">HHII", 12, 10, 2, 7) + content + metadata

    def serve(listener):
        link, _ = listener.accept()
        with link:
            device = link.recv(1 << 16)[14:34].replace(b"CMD", b"ACK")
            head = struct.pack(">H12s20sIIQQ", 2, b"STRING", device, 0, 0, len(body),
                               crc64.ecma_182(body))  # fmt: skip
            link.sendall(head + body)
            link.recv(1 << 16)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        port = listener.getsockname()[1]
        assert main(["export", str(saved), "--plus-server", f"127.0.0.1:{port}"]) == 0
        thread.join()
    assert "Image to Probe set; said" in capsys.readouterr().out


def test_no_plus_server(saved, capsys):
    with TransformServer("ImageToProbe", np.eye(4), port=0) as closed:
        port = closed.port
    assert main(["export", str(saved), "--plus-server", f"127.0.0.1:{port}"]) == 2
    assert "Connection refused" in capsys.readouterr().err


def test_served_once_in_ages():
    """Whoever connects gets the matrix at once, however rarely it is sent again."""
    asked = iter([False, False, True])
    with (
        TransformServer("ImageToProbe", np.eye(4), port=0) as server,
        socket.create_connection(("127.0.0.1", server.port), timeout=180) as client,
    ):
        # Ends the wait for the next time.
        client.sendall(b"?")
        server.serve(1e300, lambda: next(asked))
        assert client.recv(106)[2:34] == b"TRANSFORM".ljust(12, b"\0") + b"ImageToProbe".ljust(
            20, b"\0"
        )


def test_server_refuses():
    for name in ("TransducerOriginPixelsToProbe", "Image\nToProbe", ""):
        with pytest.raises(InputError, match="1 to 20 bytes"):
            TransformServer(name, np.eye(4), port=0)
    # An empty one would let every machine connect.
    for host, said in (("", "not an empty one"), ("\udcff", "cannot listen at")):
        with pytest.raises(InputError, match=said):
            TransformServer("ImageToProbe", np.eye(4), host, port=0)
    with (
        TransformServer("ImageToProbe", np.eye(4), port=0) as server,
        pytest.raises(InputError, match="cannot listen at"),
    ):
        TransformServer("ImageToProbe", np.eye(4), port=server.port)


def test_no_jax(saved, tmp_path):
    """Loading, applying, converting and reading recordings must not cost JAX's start-up time."""
    code = (
        "import sys, numpy as np, jaxcal; from jaxcal.cli.main import main\n"
        "c = jaxcal.load_calibration(sys.argv[1]); c.apply(np.ones((2, 2)))\n"
        "assert main(['export', sys.argv[1], '--plus']) == 0\n"
        "c.save(sys.argv[2] + '/a.h5'); jaxcal.load_calibration(sys.argv[2] + '/a.h5')\n"
        "open(sys.argv[2] + '/t.csv', 'w').write('u,v,x,y,z,qx,qy,qz,qw\\n' + ''.join(\n"
        "    f'{k},{2 * k},{k},0,9,0,0,0,1\\n' for k in range(1, 9)))\n"
        "assert main(['import', sys.argv[2] + '/t.csv', sys.argv[2] + '/r.h5']) == 0\n"
        "assert len(jaxcal.load(sys.argv[2] + '/r.h5')) == 8\n"
        "assert main(['apply', sys.argv[1], sys.argv[2] + '/r.h5', '--out', "
        "sys.argv[2] + '/p.csv']) == 0\n"
        "import jaxcal.io.importing.files, jaxcal.io.plus, jaxcal.io.trackers, jaxcal.io.serving\n"
        "loaded = {name.split('.')[0] for name in sys.modules}\n"
        "assert not loaded & {'jax', 'jaxlib', 'equinox', 'optimistix', 'matplotlib'}, loaded\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, saved, tmp_path], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    # Only that the table's ranges begin elsewhere than the calibration's.
    assert re.fullmatch("- Ranges begin at .* with the first.\n", done.stderr)


def test_a_transform_says_its_numbers_and_sds():
    sds = np.array([0.1, 0.2, 0.3, *np.radians([0.5, 0.6, 0.7])])
    known = ImageTransform(
        np.eye(4), scale_mm_per_px=np.array([0.15, 0.14]), covariance=np.diag(sds**2)
    )
    said = repr(known)
    assert "pixels (mm): 0.15 lateral, 0.14 axial" in said
    assert "SDs along and about the image's axes: 0.1, 0.2, 0.3 mm; 0.5, 0.6, 0.7 deg" in said
    assert "must not be used" not in said
    assert "must not be used" in repr(replace(known, converged=False))


def test_a_report_and_a_sequence_are_told_what_to_name_instead(tmp_path, capsys):
    known = random_transform()
    known.save(tmp_path / "calibration.json")
    assert main(["apply", str(tmp_path), "--pixel", "1", "2"]) == 2
    assert "is a folder: name the calibration.json in it" in capsys.readouterr().err
    write_sequence(tmp_path / "new.igs.mha", {("Probe", "Tracker"): np.eye(4)[None]}, np.zeros(1))
    command = ["apply", str(tmp_path / "calibration.json"), str(tmp_path / "new.igs.mha")]
    assert main(command) == 2
    assert "no points: import it with points (jaxcal import)" in capsys.readouterr().err
