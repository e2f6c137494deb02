"""The seam to a bench: one image at a time, in memory."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import experiment

import jaxcal
from hw import LiveCalibration
from jaxcal.solve import _solve_jit


def test_live_calibration_is_the_batch_one_and_compiles_once():
    recording = experiment(0, images=10, noise_mm=0.1, elevation_mm=0.5)
    images = recording.calibration
    live = LiveCalibration(capacity=12, method="conventional")
    result, compiled = None, 0
    for k, (pose, point) in enumerate(zip(images.poses, images.measurements, strict=True)):
        result = live.add(pose, point)
        if k == 3:
            compiled = _solve_jit._cache_size()
        assert (result is None) == (k < 3)
    whole = jaxcal.calibrate(recording, method="conventional")
    assert result.status == "converged"
    np.testing.assert_allclose(result.image_to_probe, whole.image_to_probe, atol=1e-7)
    assert result.elevation.shape == (10,)
    assert _solve_jit._cache_size() == compiled + 1  # only the ten-image problem was new
    live.leave_out(4)
    assert int(live.solve().images_used) == 9


def test_bad_images_are_refused_and_not_kept():
    live = LiveCalibration(capacity=4)
    with pytest.raises(jaxcal.InputError, match="reflection"):
        live.add(np.diag([1.0, 1, -1, 1]), np.array([0.0, 50.0]))
    with pytest.raises(jaxcal.InputError, match="finite"):
        live.add(np.eye(4), np.array([np.nan, 50.0]))
    assert len(live) == 0
    with pytest.raises(jaxcal.InputError, match="no image 0"):
        live.leave_out(0)
    with pytest.raises(jaxcal.InputError, match="capacity"):
        LiveCalibration(capacity=3)
