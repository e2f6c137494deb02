"""The fast road of plain problems against the general one."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import problem

import jaxcal
from jaxcal import abreast, compiler
from jaxcal.options import DELAY_SD_S, SOUND_SPEED_SD_M_S, Request, prepare, with_bound
from jaxcal.pipeline import finish

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
    problems = jaxcal.stack(
        [problem(k, images=15, elevation_mm=1.5, noise_mm=1.0) for k in range(3)]
    )
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
    problems = jaxcal.stack(
        [problem(k, images=15, elevation_mm=1.5, noise_mm=1.0) for k in range(3)]
    )
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


FINDINGS = {
    "conventional": ("conventional", "auto", None, False),
    "alternating": ("alternating", "auto", None, False),
    "self-tuned": ("joint", "gaussian", None, False),
    "given": ("joint", "auto", (0.2, 0.2, 1.0), False),
    "robust": ("joint", "gaussian", None, True),
}


def asked(name: str) -> Request:
    """As :func:`jaxcal.calibrate_batch` makes it."""
    method, prior, sigma, robust = FINDINGS[name]
    return Request(method, prior, None, sigma, None, (), "auto", SOUND_SPEED_SD_M_S, DELAY_SD_S,
                   None, robust)  # fmt: skip


def hard_problems():
    """Ordinary ones, and one each with a left-out image, an outlier, parallel poses and NaN."""
    good = [problem(k, images=23, elevation_mm=1.5, noise_mm=1.0) for k in range(5)]
    rest = replace(good[1], mask=good[1].mask.at[3].set(0.0))
    outlier = replace(good[2], measurements=good[2].measurements.at[4, 0].add(30.0))
    parallel = replace(good[3], poses=good[3].poses.at[:, :3, :3].set(jnp.eye(3)))
    lost = replace(good[4], poses=good[4].poses.at[3, 0, 3].set(jnp.nan))
    return jaxcal.stack([good[0], rest, outlier, parallel, lost])


LONG = [pytest.param(name, marks=pytest.mark.slow) for name in FINDINGS if name != "conventional"]


@pytest.mark.parametrize("name", ["conventional", *LONG])
def test_findings_are_those_of_the_reference(name):
    """From the same solutions, everything that is said of them."""
    problems = hard_problems()
    plan, given = prepare(problems, asked(name))
    problems = with_bound(problems, given)

    @jax.jit
    def both(everything):
        used = jax.vmap(lambda one: abreast.agreeing(one, plan))(everything)
        images = abreast.Images.of(used)
        begun = abreast.from_scratch(images)
        solution = abreast.run_method(begun, images, used, given, plan)

        def reference(solution, used, whole):
            return finish(solution, used, whole, given, plan)

        return (
            abreast.finish_batch(plan, solution, used, everything, given),
            jax.vmap(reference)(solution, used, everything),
        )

    fast, slow = (found.with_problem(problems) for found in both(problems))
    assert fast.status.tolist() == [*["converged"] * 3, "unobservable", "failed"]
    assert np.array_equal(fast.differentiable, slow.differentiable)
    assert np.array_equal(fast.outlier, slow.outlier)
    sound = np.arange(3)
    # A direction has no sign.
    for field in ("weakest", "prior_direction"):
        a, b = (np.asarray(getattr(each, field))[sound] for each in (fast, slow))
        length = np.linalg.norm(b, axis=1)
        np.testing.assert_allclose(np.abs(np.sum(a * b, axis=1)), length**2, atol=1e-9)
    leaves = jax.tree_util.tree_leaves_with_path
    for (path, a), (_, b) in zip(leaves(fast), leaves(slow), strict=True):
        name = jax.tree_util.keystr(path)
        a, b = np.asarray(a, float)[sound], np.asarray(b, float)[sound]
        scale = np.nanmax(np.abs(b), initial=1e-12)
        np.testing.assert_allclose(a / scale, b / scale, atol=1e-9, rtol=0, err_msg=name)
    for field in ("covariance", "elevation_sd"):
        assert np.isnan(np.asarray(getattr(fast, field))[3]).all()


@pytest.mark.slow
def test_a_batch_has_the_derivatives_of_its_problems():
    problems = jaxcal.stack(
        [problem(k, images=12, elevation_mm=1.0, noise_mm=1.0) for k in range(3)]
    )
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)))

    def value(result):
        return jnp.sum(weight * result.image_to_probe) + jnp.sum(result.covariance)

    def batch(measurements):
        moved = replace(problems, measurements=measurements)
        # Chunks of two: the derivative passes the loop over them.
        return value(jaxcal.calibrate_batch(moved, "conventional", chunk=2))

    def alone(measurements, one):
        return value(jaxcal.calibrate(replace(one, measurements=measurements), "conventional"))

    together = jax.jit(jax.grad(batch))(problems.measurements)
    each = jax.jit(jax.vmap(jax.grad(alone)))(problems.measurements, problems)
    np.testing.assert_allclose(together, each, rtol=1e-6, atol=1e-9)
