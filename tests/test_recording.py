"""What a recording refuses, beyond what the readers' own tests hold."""

import copy
import dataclasses
import subprocess
import sys

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_poses

import jaxcal
from jaxcal import InputError, design


def arrays() -> dict:
    images = jaxcal.simulate_recording(jaxcal.Protocol(images=12)).calibration
    return {"poses": np.array(images.poses), "measurements": np.array(images.measurements)}


def test_rows_above_the_image_are_refused():
    """Columns that are exchanged or counted from the middle give an answer, and a wrong one."""
    given = arrays()
    pixels = given["measurements"] / [0.12, 0.1] + [200.0, 0.0]
    jaxcal.make_images(given["poses"], pixels, "pixel")
    changed = pixels.copy()
    changed[2, 1] = -40.0
    with pytest.raises(
        InputError, match=r"pixel 2 has row v = -40: .* are u and v .*without the target"
    ):
        jaxcal.make_images(given["poses"], changed, "pixel")
    changed[2, 1] = 0.0
    with pytest.raises(InputError, match="pixel 2 has a range that is not positive"):
        jaxcal.make_images(given["poses"], changed, "pixel")
    jaxcal.make_images(given["poses"], changed, "pixel", face_offset_mm=1.0)
    changed[2, 1] = 10.0
    with pytest.raises(InputError, match="pixel 2 has a range that is not positive"):
        jaxcal.make_images(
            given["poses"], changed, "pixel", spacing_mm=(0.12, 0.1), face_offset_mm=-1.5
        )


def test_pixels_as_shares_of_the_image_are_refused():
    pixels = np.random.default_rng(1).uniform(0.1, 0.9, (6, 2))
    with pytest.raises(InputError, match="shares of the image's width and height"):
        jaxcal.make_images(random_poses(6), pixels, "pixel")
    jaxcal.make_images(random_poses(6), 2 * pixels + 1, "pixel")
    jaxcal.make_images(random_poses(6), pixels, "point")


def test_numbers_of_jax_that_numpy_does_not_know_are_numbers():
    given = arrays()
    coarse = np.asarray(jnp.asarray(given["measurements"], jnp.bfloat16))
    images = jaxcal.make_images(given["poses"], coarse, "point")
    assert images.measurements.dtype == np.float64
    np.testing.assert_array_equal(images.measurements, np.asarray(coarse, float))


def test_recordings_can_be_compared_and_kept_in_sets():
    """Arrays have no single truth, so recordings are equal if they are the same."""
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=12))
    other = copy.deepcopy(recording)
    assert recording == recording
    assert recording != other
    assert recording.calibration != other.calibration
    assert len({recording, other, recording}) == 2
    candidates = design.make_candidates(count=12)
    for found in (jaxcal.ImageTransform(np.eye(4)), candidates, candidates.model):
        assert found != copy.deepcopy(found)
        assert len({found, found}) == 1


TRACED = """
import jax, jaxcal, numpy as np

poses = np.tile(np.eye(4), (4, 1, 1))
try:
    jax.grad(lambda points: jaxcal.Problem.from_arrays(poses, points).mask[0])(np.ones((4, 2)))
except jaxcal.InputError as error:
    print(error)
"""


def test_a_recording_says_what_it_holds_without_its_arrays():
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=12))
    said = repr(recording)
    assert said.startswith("Recording('")
    assert "Images(12 used of 12, points, with covariance" in said
    assert "test=Images(50 used of 50, points" in said
    assert "array" not in said


def test_a_problem_of_arrays_has_the_range_of_row_zero():
    given = arrays()
    made = jaxcal.Problem.from_arrays(**given, face_offset_mm=4.0)
    from_images = jaxcal.Problem.from_recording(jaxcal.make_images(**given, face_offset_mm=4.0))
    assert made.face_offset == from_images.face_offset == 4.0
    with pytest.raises(InputError, match="face_offset_mm"):
        jaxcal.Problem.from_arrays(**given, face_offset_mm=np.nan)
    times = np.full((len(given["poses"]), 8), 4e-5)
    with pytest.raises(InputError, match="belongs to points and pixels"):
        jaxcal.make_images(given["poses"], times, "time_of_flight", face_offset_mm=4.0)


def test_images_are_left_out_by_their_numbers():
    images = jaxcal.make_images(**arrays(), mask=np.arange(12) != 3)
    np.testing.assert_array_equal(
        np.flatnonzero(images.without(np.array([0, 3, 11])).mask), [1, 2, *range(4, 11)]
    )
    assert len(images.without([])) == 12
    # A mask is no list of numbers: it would leave out images 0 and 1.
    for bad, said in ((images.mask, "whole number"), ([12], "not 12"), ([-1], "not -1")):
        with pytest.raises(InputError, match=said):
            images.without(bad)
    with pytest.raises(InputError, match="a list of numbers"):
        images.without(np.array(3))


def test_numbers_of_frames_are_whole():
    given = arrays()
    numbers = np.array([0, 2, 3, *range(9, 18)])
    np.testing.assert_array_equal(jaxcal.make_images(**given, frame=numbers).frame, numbers)
    for bad in (0.5, -1, np.nan):
        with pytest.raises(InputError, match="frame 1 is no"):
            jaxcal.make_images(**given, frame=np.array([0, bad, *range(2, 12)]))


def test_traced_arrays_are_refused_in_words():
    # In another process: here, annotations are checked at every call.
    done = subprocess.run([sys.executable, "-c", TRACED], capture_output=True, text=True)
    assert "make the problem outside" in done.stdout, done.stderr


@pytest.mark.parametrize("name", ["poses", "measurements", "covariance"])
def test_numbers_beyond_any_measure_are_refused_with_their_row(name: str):
    given = arrays() | {"covariance": np.tile(np.eye(2), (12, 1, 1))}
    given[name][3].flat[1] = 1e200
    with pytest.raises(InputError, match=r"3 holds a number beyond 1e\+07"):
        jaxcal.make_images(**given)
    # An image left out may hold anything.
    jaxcal.make_images(**given, mask=np.arange(12) != 3)


@pytest.mark.parametrize("name", ["", " ", "\x1b[31mProbe", "Pro\nbe"])
def test_frames_have_names(tmp_path, name):
    """They are printed, and those of a file are not trusted."""
    recording = jaxcal.simulate_recording(jaxcal.Protocol(images=12))
    with pytest.raises(InputError, match="must be the names of two frames"):
        dataclasses.replace(recording, pose_frames=("Probe", name))
    path = tmp_path / "rec.h5"
    jaxcal.save(dataclasses.replace(recording, pose_frames=("Probe", "Tracker")), path)
    with h5py.File(path, "r+") as file:
        file["calibration"].attrs["pose_to"] = name
    with pytest.raises(InputError, match=r"rec\.h5: pose_frames must be the names") as caught:
        jaxcal.load(path)
    assert str(caught.value).isprintable()


def test_images_that_are_not_in_the_order_of_time_are_told():
    images = jaxcal.simulate_recording(jaxcal.Protocol(images=12), 3).calibration
    order = np.random.default_rng(1).permutation(12)
    # Recordings that were resumed or joined begin again.
    for time, told in ((order, True), (np.arange(12) % 4, False), (None, False)):
        timed = dataclasses.replace(images, time=None if time is None else np.array(time, float))
        said = "\n".join(jaxcal.calibrate(timed, "conventional").warnings)
        assert ("not in the order of their time stamps" in said) == told
