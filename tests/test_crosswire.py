"""The real cross-wire recording: figures known from an independent least-squares solution."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxcal
from jaxcal.diagnostics.outliers import suspects
from jaxcal.io.text import read_crosswire


@pytest.fixture(scope="module")
def recording(real_data: Path) -> jaxcal.Recording:
    folder = real_data / "crosswire"
    return read_crosswire(
        folder / "crossWirePhantomTransformations.txt", folder / "crossWirePhantom2DPoints.txt"
    )


def test_conventional(recording):
    result = jaxcal.calibrate(recording, method="conventional", estimate=("scale",))
    assert result.status == "converged"
    assert float(result.rms) == pytest.approx(0.980, abs=0.001)
    np.testing.assert_allclose(result.scale_mm_per_px, [0.14782, 0.13981], atol=5e-5)
    np.testing.assert_allclose(result.image_to_probe[:3, 3], [43.63, -31.03, 7.10], atol=0.02)
    np.testing.assert_allclose(result.point, [201.41, 14.33, 33.84], atol=0.02)


def test_self_tuned(recording):
    result = jaxcal.calibrate(recording, method="joint", estimate=("scale",))
    assert result.status == "converged"
    np.testing.assert_allclose(result.sigma, [0.347, 0.438, 0.883], rtol=0.05)
    assert result.sigma_tuned
    # Heavy tails, not a bound: Gaussian offsets have 3, uniform ones 1.8.
    assert float(result.inspection.kurtosis[2]) == pytest.approx(4.0, abs=0.1)
    assert not np.asarray(result.outlier).any()
    names_what_an_eye_sees(result)


def test_a_stated_tracker_sd_hardly_changes_what_is_stated_of_x(recording):
    """By smooth errors of 500 SDs, of weight 0.4 %, the SD along depth was 12.9 mm, now 0.6."""
    given: dict[str, Any] = {"sigma": (0.35, 0.45, 0.9), "estimate": ("scale",)}
    without = jaxcal.calibrate(recording, **given)
    stated = jaxcal.calibrate(recording, tracker_sd=0.2, **given)
    widths = [np.sqrt(np.diag(np.asarray(each.covariance))) for each in (without, stated)]
    np.testing.assert_allclose(widths[1], widths[0], rtol=0.3)


def names_what_an_eye_sees(result: jaxcal.Calibration) -> None:
    """Images 11 to 13 stand out in range, and the elevational errors change slowly."""
    found = suspects(result)
    assert {each["image"] for each in found} >= {11, 12, 13}
    assert all(each["component"] == "range" for each in found)
    assert any("11 to 13 in a row (range errors to one side" in text for text in result.warnings)
    drifting = [text for text in result.warnings if "elevational offsets" in text]
    assert any("successive images" in text or "drift in the course" in text for text in drifting)
    assert result.wrong_frames is None
    assert result.notes == ()


@pytest.mark.slow
def test_the_robust_answer_names_them_too(recording):
    robust = jaxcal.calibrate(recording, estimate=("scale",), robust=True)
    names_what_an_eye_sees(robust)


@pytest.mark.slow
def test_three_sizes_of_error_predict_better_than_one(recording):
    """Leave-one-out log density, more than two of its standard errors above one size's."""
    scale: dict[str, Any] = {"estimate": ("scale",)}
    joint = jaxcal.cross_validate(recording, prior="gaussian", **scale)
    equal = jaxcal.cross_validate(recording, method="conventional", **scale)
    variance = np.asarray(equal.fold_cost)[:, None] / (3 * 53 - 11)
    squared = np.asarray(equal.residual) ** 2 / variance
    one_size = -0.5 * (squared + np.log(2 * np.pi * variance)).sum(axis=1)
    gained = np.asarray(joint.log_density) - one_size
    assert np.asarray(joint.converged).all()
    assert gained.sum() > 2 * gained.std(ddof=1) * np.sqrt(len(gained))


def test_without_spacing_the_scale_must_be_estimated(recording):
    with pytest.raises(jaxcal.InputError, match="estimate the scale"):
        jaxcal.calibrate(recording)
