"""The real cross-wire recording: figures known from an independent least-squares solution."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import jaxcal
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


def test_without_spacing_the_scale_must_be_estimated(recording):
    with pytest.raises(jaxcal.InputError, match="estimate the scale"):
        jaxcal.calibrate(recording)
