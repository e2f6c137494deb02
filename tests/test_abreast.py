"""The fast road of plain problems against the general one."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from conftest import problem

import jaxcal
from jaxcal import abreast, compiler

METHODS = {
    "conventional": {"method": "conventional"},
    "alternating": {"method": "alternating"},
    "self-tuned": {"method": "joint"},
    "given": {"method": "joint", "sigma": (0.2, 0.2, 1.0)},
}
FIELDS = ("image_to_probe", "point", "elevation", "elevation_sd", "sigma", "covariance", "rms",
          "condition", "weakest_sd")  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_both_roads_lead_to_the_same_calibration(name, monkeypatch):
    problems = jaxcal.stack([problem(k, images=15, elevation_mm=1.5, noise_mm=1) for k in range(3)])
    fast = jaxcal.calibrate_batch(problems, **METHODS[name])
    jax.clear_caches()
    monkeypatch.setattr(abreast, "plain", lambda *_: False)
    general = jaxcal.calibrate_batch(problems, **METHODS[name])
    jax.clear_caches()
    assert np.array_equal(fast.status_code, general.status_code)
    # Both stop at a relative change of the SDs of 1e-9, each on its own side.
    for field in FIELDS:
        a, b = np.asarray(getattr(fast, field)), np.asarray(getattr(general, field))
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-7, err_msg=field)


@pytest.mark.slow
def test_compiler_flags_change_rounding_only(monkeypatch):
    problems = jaxcal.stack([problem(k, images=15, elevation_mm=1.5, noise_mm=1) for k in range(3)])
    fast = jaxcal.calibrate_batch(problems, method="conventional")
    again = jaxcal.calibrate_batch(problems, method="conventional")
    assert np.array_equal(fast.image_to_probe, again.image_to_probe)
    from jaxcal import solve

    solve._chunks.cache_clear()
    monkeypatch.setenv(compiler.SWITCH, "0")
    assert compiler.fast_to_run("cpu") is None
    plain = jaxcal.calibrate_batch(problems, method="conventional")
    solve._chunks.cache_clear()
    np.testing.assert_allclose(fast.image_to_probe, plain.image_to_probe, rtol=0, atol=1e-12)
