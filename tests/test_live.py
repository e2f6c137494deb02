"""The seam to a bench: one image at a time, in memory."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import experiment

import jaxcal
from hw import LiveCalibration
from jaxcal.runtime import executables, program_cache

SIGMA_MM = (0.1, 0.1, 0.5)


def test_live_calibration_is_the_batch_one_and_compiles_once(tmp_path, monkeypatch):
    recording = experiment(0, images=12, noise_mm=0.1, elevation_mm=0.5)
    images = recording.calibration
    live = LiveCalibration(capacity=14, sigma=SIGMA_MM)
    executables.forget()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    result = None
    for k, (pose, point) in enumerate(zip(images.poses, images.measurements, strict=True)):
        result = live.add(pose, point)
        assert (result is None) == (k < 3)
    # From four images to twelve, of fourteen at most: one program.
    assert len(program_cache.entries()) == 1
    whole = jaxcal.calibrate(recording, sigma=SIGMA_MM)
    assert result.status == "converged"
    np.testing.assert_allclose(result.image_to_probe, whole.image_to_probe, atol=1e-7)
    assert result.elevation.shape == (12,)
    live.leave_out(4)
    assert int(live.solve().images_used) == 11


def test_bad_images_are_refused_and_not_kept():
    live = LiveCalibration(capacity=4)
    with pytest.raises(jaxcal.InputError, match="reflection"):
        live.add(np.diag([1.0, 1, -1, 1]), np.array([0.0, 50.0]))
    with pytest.raises(jaxcal.InputError, match="finite"):
        live.add(np.eye(4), np.array([np.nan, 50.0]))
    with pytest.raises(jaxcal.InputError, match="range that is not positive"):
        live.add(np.eye(4), np.array([0.0, -30.0]))
    with pytest.raises(jaxcal.InputError, match="measurement must be an array of real numbers"):
        live.add(np.eye(4), np.array(["0", "50"]))
    assert len(live) == 0
    with pytest.raises(jaxcal.InputError, match="no image 0"):
        live.leave_out(0)
    live.put(np.eye(4), np.array([0.0, 50.0]))
    with pytest.raises(jaxcal.InputError, match="index must be between 0 and 0, not 5"):
        live.leave_out(5)
    for capacity in (3, 10**6):
        with pytest.raises(jaxcal.InputError, match="capacity"):
            LiveCalibration(capacity=capacity)
    with pytest.raises(jaxcal.InputError, match="two positive numbers"):
        LiveCalibration(kind="pixel", spacing_mm=(0.1, -0.1))


def test_times_of_flight_come_to_what_the_file_comes_to():
    protocol = jaxcal.Protocol(images=12, noise_mm=0.1, elevation_mm=0.5, raw=True)
    recording = jaxcal.simulate_recording(protocol, 1)
    images = recording.calibration
    live = LiveCalibration(12, kind="time_of_flight", probe=recording.probe, method="conventional")
    result = None
    for pose, times in zip(images.poses, images.measurements, strict=True):
        times = times.copy()
        times[:3] = np.nan
        result = live.add(pose, times, max_elevation=0.5)
    whole = images.measurements.copy()
    whole[:, :3] = np.nan
    from_file = jaxcal.calibrate(
        jaxcal.Recording(
            jaxcal.make_images(images.poses, whole, "time_of_flight", max_elevation=0.5),
            probe=recording.probe,
        ),
        method="conventional",
    )
    np.testing.assert_allclose(result.image_to_probe, from_file.image_to_probe, atol=1e-9)
    assert live.problem().max_elevation is not None
    with pytest.raises(jaxcal.InputError, match="full"):
        live.add(images.poses[0], images.measurements[0])


def test_frames_that_cannot_be_times_of_flight_are_refused():
    with pytest.raises(jaxcal.InputError, match="probe"):
        LiveCalibration(4, kind="time_of_flight")
    live = LiveCalibration(4, kind="time_of_flight", probe=jaxcal.LinearProbe())
    for times, what in (
        (np.zeros(3), "128 times"),
        (np.full(128, np.nan), "only 0 lines"),
        (np.full(128, -1e-5), "negative"),
        (np.full(128, 40.0), "microseconds"),
    ):
        with pytest.raises(jaxcal.InputError, match=what):
            live.add(np.eye(4), times)
    with pytest.raises(jaxcal.InputError, match="max_elevation"):
        live.add(np.eye(4), np.full(128, 4e-5), max_elevation=-1.0)
    assert len(live) == 0
