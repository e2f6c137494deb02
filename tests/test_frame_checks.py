"""Wrong frames and units are named, and right ones are not accused."""

from __future__ import annotations

import re
from contextlib import nullcontext
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal import Problem
from jaxcal.cli.common import ExitCode, exit_code, verdict_code
from jaxcal.cli.plan import refuse_wrong_lengths
from jaxcal.data.poses import inverse_poses, vectors_from_rotations
from jaxcal.data.recording import make_images
from jaxcal.diagnostics.frame_checks import doubtful_unit, wrong_frames
from jaxcal.diagnostics.warnings import warnings
from jaxcal.diagnostics.wrong_angles import ORDERS, angles_about_axes, composed
from jaxcal.io.text import read_crosswire
from jaxcal.report.next_poses import next_poses_record
from jaxcal.report.record import calibration_record
from jaxcal.report.verdict import verdict

FILES = 6
BY_SYMMETRY = {("px, unknown", "u and v swapped")} | {
    (form, "u mirrored") for form in ("mm", "px, known", "px, unknown")
}
"""No fit can see these (:mod:`jaxcal.diagnostics.frame_checks`)."""
FREE_UNIT = ("px, unknown", "poses in cm")
"""A pixel of a hundredth of a millimetre is possible, but doubtful."""


@pytest.fixture(scope="module")
def slips():
    """The experiment, whose recordings and slips these are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[1] / "experiments")
        yield import_module("wrong_frames")


@pytest.mark.parametrize("form", ["mm", "px, known", "px, unknown"])
def test_every_slip_is_named_or_refused_and_no_right_file_is(slips, form):
    for slip, (make, words) in slips.SLIPS.items():
        for number in range(FILES):
            arrays = make(slips.recorded(number, form))
            try:
                problem = Problem.from_recording(arrays.images())
                said = wrong_frames(problem)
                in_doubt = (form, slip) == FREE_UNIT
                assert said or (doubtful_unit(problem) is not None) == in_doubt, (slip, number)
            except jaxcal.InputError as error:
                said = str(error)
            if slip == "none" or (form, slip) in BY_SYMMETRY or (form, slip) == FREE_UNIT:
                assert said is None, (slip, number)
            else:
                assert said is not None, (slip, number)
                assert any(word in said for word in words), said
                assert "\n" not in said


@pytest.mark.parametrize("order", ORDERS)
def test_angles_are_those_of_scipy(order):
    rotations = Rotation.random(30, random_state=1).as_matrix()
    angles = angles_about_axes(rotations, order)
    name = "".join("XYZ"[axis] for axis in order)
    expected = Rotation.from_matrix(rotations).as_euler(name)
    np.testing.assert_allclose(angles[:, list(order)], expected, atol=1e-9)
    np.testing.assert_allclose(composed(angles, order), rotations, atol=1e-12)
    # What the words say: capital letters are products in their order, small ones the other way.
    about_fixed = Rotation.from_euler(name[::-1].lower(), expected[:, ::-1]).as_matrix()
    np.testing.assert_allclose(about_fixed, rotations, atol=1e-12)


def test_rotation_vectors_are_those_of_scipy():
    turns = np.concatenate([Rotation.random(30, random_state=2).as_matrix(), np.eye(3)[None]])
    expected = Rotation.from_matrix(turns).as_rotvec()
    np.testing.assert_allclose(vectors_from_rotations(turns), expected, atol=1e-9)


def test_mirrored_rotations_are_not_taken_for_mirrored_translations(slips):
    """Both fit as well once one of them is reversed: the words name both, and do not choose."""
    right = slips.recorded(0, "mm")
    poses, mirror = right.poses.copy(), np.diag([1.0, -1.0, 1.0])
    poses[:, :3, :3] = mirror @ poses[:, :3, :3] @ mirror
    said = wrong_frames(Problem.from_recording(make_images(poses, right.points)))
    assert "wrong sign along y, or their rotations turn the wrong way about the other two" in said


def test_residuals_that_no_beam_explains_are_named(slips):
    """Quaternions whose x and z are exchanged turn poses in a way that nobody looks for."""
    right = slips.recorded(0, "mm")
    poses = right.poses.copy()
    numbers = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    poses[:, :3, :3] = Rotation.from_quat(numbers[:, [2, 1, 0, 3]]).as_matrix()
    for images, wrong in ((right.images(), False), (make_images(poses, right.points), True)):
        result = jaxcal.calibrate(jaxcal.Recording(images), "conventional")
        assert any("larger than a beam is thick" in text for text in result.warnings) == wrong


def test_whoever_has_wrong_frames_gets_neither_poses_nor_files(slips, tmp_path):
    make, _ = slips.SLIPS["inverse poses"]
    recording = jaxcal.Recording(make(slips.recorded(0, "mm")).images())
    result = jaxcal.calibrate(recording, "conventional")
    assert result.wrong_frames is not None
    assert next_poses_record(result, recording) is None
    # The matrix is shown, but never without the word right above it.
    shown, word = "image_plane_to_probe (mm)", ": do not use"
    for text in (str(result), result._repr_html_()):
        assert text.count(shown) == text.count(shown + word) == 1
        assert "error to expect" not in text
    with pytest.raises(jaxcal.InputError, match="must not be used"):
        result.save(tmp_path / "cal.npz")


def test_noise_outliers_and_few_images_are_no_slips(slips):
    """Right data of other kinds: exact, very noisy, with wild images, few, hardly turned."""
    for number in range(40):
        rng = np.random.default_rng([77, number])
        right = slips.recorded(number, "mm")
        points = right.points.copy()
        kind = number % 4
        if kind == 0:
            points += 3.0 * rng.normal(size=points.shape)
        elif kind == 1:
            points[:: rng.integers(5, 9)] += rng.uniform(-30, 30, (1, 2))
        chosen = slice(0, int(rng.integers(4, 9))) if kind == 2 else slice(None)
        points[:, 1] = np.maximum(points[:, 1], 1.0)
        assert wrong_frames(Problem.from_arrays(right.poses[chosen], points[chosen])) is None


def test_points_of_other_images_do_not_fit_together(slips):
    right = slips.recorded(3, "mm")
    order = np.random.default_rng(4).permutation(len(right.points))
    said = wrong_frames(Problem.from_arrays(right.poses, right.points[order]))
    assert said is not None
    assert "do not fit together" in said


@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("unit", ["mm", "px, known", "px, unknown"])
def test_a_few_poses_of_a_tool_not_seen_are_no_other_mistake(slips, count, unit):
    """One pose at the tracker's origin looked like lists that are 20 rows out of step."""
    for number in range(2):
        images = slips.recorded(number, unit).images()
        poses = images.poses.copy()
        poses[:, :3, 3] += [100.0, -50.0, -1500.0]
        poses[np.random.default_rng(number).permutation(len(poses))[:count]] = np.eye(4)
        said = wrong_frames(Problem.from_recording(replace(images, poses=poses)))
        assert said is not None
        assert said.startswith(f"{count} of {len(poses)} images that were compared do")
        assert "--robust" in said


def test_a_few_mirrored_images_are_asked_about():
    """The left of the image was exchanged with its right in part of the recording."""
    protocol = jaxcal.Protocol(images=40, noise_mm=0.2)
    images = jaxcal.simulate_recording(protocol, seed=2).calibration
    points = np.array(images.measurements)
    points[-13:, 0] *= -1
    said = wrong_frames(Problem.from_arrays(images.poses, points))
    assert said is not None
    assert "or mirrored images?" in said


def test_a_third_of_wrong_poses_is_not_taken_for_lists_out_of_step():
    """A shift by 20 rows made gross errors smaller, of images that still were 2 cm apart."""
    protocol = jaxcal.Protocol(images=40, noise_mm=0.2)
    images = jaxcal.simulate_recording(protocol, seed=2).calibration
    poses = np.array(images.poses)
    poses[-14:, :3, 3] /= 1000
    pixels = np.asarray(images.measurements) / [0.2, 0.15] + [200, 0]
    said = wrong_frames(Problem.from_arrays(poses, pixels, kind="pixel"))
    assert said is not None
    assert "do not fit together" in said


def test_a_wrong_spacing_is_told_with_the_right_one(slips):
    right = slips.recorded(5, "px, known")
    said = wrong_frames(Problem.from_recording(replace(right, spacing=(0.14, 0.12)).images()))
    assert said is not None
    told = re.search(r"the pixels are ([0-9.]+) x ([0-9.]+) mm, not 0.14 x 0.12", said)
    assert told is not None
    np.testing.assert_allclose([float(told[1]), float(told[2])], slips.SPACING_MM, rtol=0.02)
    # Who estimates the scale does not believe the spacing.
    data = Problem.from_recording(right.images())
    wrong = replace(data, spacing=1.4 * data.spacing)
    assert wrong_frames(wrong) is not None
    assert wrong_frames(wrong, ("scale",)) is None
    # But nobody mistakes it for a tenth.
    poses = np.array(data.poses)
    poses[:, :3, 3] /= 10
    said = wrong_frames(replace(data, poses=poses), ("scale",)) or ""
    assert re.match(r"the pixels come out as 0.0\d+ x 0.012 mm, .* have 0.1 x 0.12 mm: are", said)


def test_points_in_mm_have_no_spacing_to_correct(slips):
    """The advice was to estimate the scale, which is refused: points in mm have none."""
    right = slips.recorded(5, "mm")
    said = wrong_frames(Problem.from_arrays(right.poses, right.points * [1.6, 1.3]))
    assert said is not None
    assert "check what gave them their mm" in said
    assert "estimate" not in said
    assert 'pixel"' not in said
    # Only points that are longer than they should be, by the size of a pixel, may be pixels.
    said = wrong_frames(Problem.from_arrays(right.poses, right.points / [0.16, 0.13]))
    assert "are 0.16 and 0.13 times as long as given" in said
    assert 'or whether the points are pixels (kind="pixel" in Python, --units px at import)' in said
    # Pixels of 0.1 mm look like poses in cm.
    said = wrong_frames(Problem.from_arrays(right.poses, right.points * 10))
    assert "the poses are in cm" in said
    assert "and check whether the points are pixels" in said


def test_pixels_that_no_image_has_are_told(slips):
    """Poses in mm that were said to be in m, and in inches, which magnetic trackers send."""
    right = slips.recorded(2, "px, unknown")
    sizes = ((1000, r"1\d\d x 1\d\d"), (1 / 25.4, r"0\.003\d+ x 0\.004\d+"))
    for factor, size in sizes:
        poses = right.poses.copy()
        poses[:, :3, 3] *= factor
        said = wrong_frames(Problem.from_recording(replace(right, poses=poses).images()))
        assert said is not None
        assert re.match(rf"the pixels come out as {size} mm: are the poses", said)


def test_points_in_mm_that_are_taken_for_pixels_are_told(slips):
    """Pixels of just under 1 mm were taken for usual ones, larger ones for poses not in mm."""
    right = slips.recorded(2, "mm")
    for size, told in ((0.98, True), (1.02, True), (0.7, False)):
        problem = Problem.from_arrays(right.poses, right.points / size, kind="pixel")
        result = jaxcal.calibrate(problem, "conventional", estimate=("scale",))
        assert any("are u and v in mm" in text for text in warnings(result)) == told


def test_poses_composed_in_the_wrong_order_are_asked_about(slips):
    """Probe times inverse reference fits as well; X is then that to the reference's tracker."""
    right = slips.recorded(4, "mm")
    reference = np.eye(4)
    reference[:3, :3] = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix()
    reference[:3, 3] = [200.0, -300.0, 1500.0]
    for poses, asked in (
        (inverse_poses(reference[None]) @ right.poses, False),
        (right.poses @ inverse_poses(reference[None]), True),
    ):
        result = jaxcal.calibrate(
            jaxcal.Recording(make_images(poses, right.points)), "conventional"
        )
        assert result.wrong_frames is None
        said = [text for text in result.warnings if "from the origin of the probe's frame" in text]
        assert len(said) == asked
        assert not asked or "the target is 1.5 m from" in said[0]


def small_probe(factor: float, spacing: tuple[float, float] | None = None):
    """A probe of high frequency: every length a tenth, errors of 0.2 mm; poses in some unit."""
    rng = np.random.default_rng(8)
    turns = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, (30, 3))).as_matrix()
    seen = np.stack([rng.uniform(-5, 5, 30), rng.uniform(-0.2, 0.2, 30), rng.uniform(2, 12, 30)], 1)
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :3, :3] = turns
    at = [80.0, 20.0, 150.0] - np.einsum("nij,nj->ni", turns, seen + np.array([10, 5, 20]))
    poses[:, :3, 3] = factor * (at + 0.2 * rng.normal(size=(30, 3)))
    return make_images(poses, seen[:, [0, 2]] / 0.02 + [300, 0], "pixel", spacing_mm=spacing)


def test_a_unit_in_doubt_leaves_the_error_unknown_until_it_is_stated(slips):
    """Poses in cm or inches fit as well, and small probes have small pixels."""
    right = slips.recorded(3, "px, unknown")
    for factor in (0.1, 1.0):
        poses = right.poses.copy()
        poses[:, :3, 3] *= factor
        recording = jaxcal.Recording(replace(right, poses=poses).images())
        result = jaxcal.calibrate(recording, "conventional", estimate="scale")
        record = calibration_record(result, recording)
        doubted = factor < 1
        assert (record["doubtful_unit"] is not None) == doubted
        assert result.image_transform().doubtful_unit == record["doubtful_unit"]
        assert (record["verdict"] == "uncertain") == doubted
        assert (verdict_code(record) == ExitCode.UNCERTAIN) == doubted
        assert (record["tre"] is None) == doubted
        assert (next_poses_record(result, recording) is None) == doubted
        with pytest.raises(jaxcal.InputError, match="in cm") if doubted else nullcontext():
            refuse_wrong_lengths(result, "rec.h5")
        lines = verdict(record)
        said = "Uncertain: the poses' translations may be in cm or inches: the pixels"
        assert lines[0].startswith(said) == doubted
        assert ("--pose-units) or, if it is mm, the size of a pixel" in lines[0]) == doubted
        assert sum("may be in cm" in line for line in lines) == doubted
        # Further images are no help.
        assert not (doubted and any("Add images" in line for line in lines))
    for images, doubted in (
        (small_probe(1.0), False),
        (small_probe(0.1), True),
        (small_probe(0.1, (0.002, 0.002)), False),
        (small_probe(100.0), True),
    ):
        assert (doubtful_unit(Problem.from_recording(images)) is not None) == doubted


def test_the_verdict_is_do_not_use_and_the_exit_status_says_so(slips):
    right = slips.recorded(0, "mm")
    for poses, named in ((inverse_poses(right.poses), True), (right.poses, False)):
        recording = jaxcal.Recording(make_images(poses, right.points))
        result = jaxcal.calibrate(recording, "conventional")
        assert result.status == "converged"
        record = calibration_record(result, recording)
        lines = verdict(record)
        assert lines[0].startswith("Do not use: it looks as if") is named
        assert (exit_code([record]) == ExitCode.NOT_CONVERGED) is named
        assert (result.wrong_frames is not None) is named
        for part in ("verdict", "tre", "limits", "influence", "comparison"):
            # The conventional fit is not compared with itself.
            assert (record[part] is None) is (named or part == "comparison")
        if named:
            assert result.wrong_frames in result.warnings
            assert "invert them, or import with --invert-poses" in lines[0]
            # Said once, and nobody is sent to take further images.
            assert sum("invert them" in line for line in lines) == 1
            assert not any("Add images" in line or "tilted" in line for line in lines[-2:])


def test_mirrored_points_go_where_they_did(slips):
    """The symmetry that keeps mirrored pixels from being seen keeps them from doing harm."""
    right = slips.recorded(1, "px, unknown")
    places = []
    for arrays in (right, slips.flipped(right), slips.other_columns(right)):
        recording = jaxcal.Recording(arrays.images())
        result = jaxcal.calibrate(recording, "conventional", estimate=("scale",))
        assert result.wrong_frames is None
        places.append(result.apply(arrays.points).points)
    np.testing.assert_allclose(places[1], places[0], atol=1e-6)
    np.testing.assert_allclose(places[2], places[0], atol=1e-6)


def test_the_real_recording_and_its_wrong_twins(real_data):
    folder = real_data / "crosswire"
    images = read_crosswire(
        folder / "crossWirePhantomTransformations.txt", folder / "crossWirePhantom2DPoints.txt"
    ).calibration
    assert wrong_frames(Problem.from_recording(images)) is None
    assert doubtful_unit(Problem.from_recording(images)) is None
    other = images.poses.copy()
    other[:, :3, 3] /= 10
    assert doubtful_unit(Problem.from_recording(replace(images, poses=other))) is not None
    known = replace(images, spacing_mm=np.array([0.1478, 0.1398]))
    assert wrong_frames(Problem.from_recording(known)) is None
    turned = images.poses.copy()
    turned[:, :3, :3] = np.swapaxes(turned[:, :3, :3], 1, 2)
    for wrong, words in (
        (replace(images, poses=inverse_poses(images.poses)), "invert"),
        (replace(images, poses=turned), "transpose"),
        (replace(known, spacing_mm=np.array([1.478, 1.398])), "10 times too large"),
        (replace(known, poses=inverse_poses(images.poses)), "invert"),
    ):
        said = wrong_frames(Problem.from_recording(wrong))
        assert said is not None
        assert words in said
