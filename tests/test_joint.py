"""The joint solver against the alternation and scipy, and REML against its likelihood."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import angle, problem
from scipy.optimize import least_squares, minimize

import jaxcal
from jaxcal import Options
from jaxcal.model.parameters import Parameters, retract
from jaxcal.model.residuals import circle_residual, measurement_residual
from jaxcal.model.unknowns import RIGID

SETTINGS = [(0.5, 0.05, 0.25), (1.0, 0.5, 1.0), (2.0, 2.0, 1.0), (3.0, 0.5, 2.0), (5.0, 4.0, 4.0),
            (2.0, 10.0, 2.0), (5.0, 0.05, 0.5), (1.0, 2.0, 4.0)]  # fmt: skip


def parameters_of(result: jaxcal.Calibration) -> Parameters:
    matrix = jnp.asarray(result.image_to_probe)
    return Parameters.of(matrix[:3, :3], matrix[:3, 3], jnp.asarray(result.point))


@jax.jit
def errors_at(parameters: Parameters, step: jax.Array, data: jaxcal.Problem) -> jax.Array:
    return measurement_residual(retract(parameters, step, RIGID), data)


moved_to = jax.jit(partial(retract, blocks=RIGID))


@pytest.fixture(scope="module")
def same_objective():
    sound = [
        replace(problem(k, images=20, elevation_mm=e, noise_mm=s), max_elevation=jnp.full(20, m))
        for k in range(2)
        for e, s, m in SETTINGS
    ][:13]  # and three that have no answer: the next bucket of problems is 24
    lost, too_few, outside = (jax.tree.map(np.array, sound[0]) for _ in range(3))
    lost.poses[3, 0, 3] = np.nan
    too_few.mask[3:] = 0.0
    outside.max_elevation[3] = -1.0
    problems = jaxcal.stack([*sound, lost, too_few, outside])
    joint = jaxcal.calibrate_batch(problems, method="joint", prior="bounded").numpy()
    options = Options(tolerance_rad=1e-10, tolerance_mm=1e-10, max_rounds=1500)
    alternation = jaxcal.calibrate_batch(problems, "alternating", options=options).numpy()
    for found in (joint, alternation):
        assert found.status[len(sound) :].tolist() == ["failed"] * 3
    good = slice(0, len(sound))
    return jaxcal.stack(sound), joint[good], alternation[good]


def test_joint_reaches_the_alternations_objective_at_kkt_precision(same_objective):
    problems, joint, alternation = same_objective
    squares = np.sum(np.asarray(problems.measurements) ** 2, axis=(1, 2))
    allowed = np.asarray(alternation.convergence.cost) * (1 + 1e-8) + 1e-12 * squares
    assert (np.asarray(joint.convergence.cost) <= allowed).all()
    assert float(jnp.max(joint.convergence.stationarity)) <= 1e-8
    assert np.asarray(joint.converged).all()
    # It does so in a fraction of the rounds, and never leaves the bounds.
    assert np.sum(joint.convergence.iterations) < 0.3 * np.sum(alternation.convergence.iterations)
    assert (np.abs(joint.elevation) <= np.asarray(problems.max_elevation) + 1e-12).all()


def test_joint_agrees_with_scipy_where_observable(same_objective):
    problems, joint, _ = same_objective
    compared = 0

    @jax.jit
    def residual(unknowns, reference, alone):
        moved = retract(reference, unknowns[:9], RIGID)
        return circle_residual(moved, unknowns[9:], alone).ravel()

    jacobian = jax.jit(jax.jacfwd(residual))
    for k in range(len(SETTINGS)):
        alone = jax.tree.map(lambda leaf, k=k: np.asarray(np.asarray(leaf)[k]), problems)
        result = jax.tree.map(lambda leaf, k=k: np.asarray(np.asarray(leaf)[k]), joint)
        conventional = jaxcal.calibrate(alone, method="conventional").numpy()
        start = parameters_of(conventional)
        bound = np.concatenate([np.full(9, np.inf), alone.max_elevation])
        inside = 0.999 * np.clip(conventional.elevation, -alone.max_elevation, alone.max_elevation)
        first = np.concatenate([np.zeros(9), inside])
        fit = least_squares(
            lambda u, r=start, p=alone: np.asarray(residual(jnp.asarray(u), r, p)), first,
            lambda u, r=start, p=alone: np.asarray(jacobian(jnp.asarray(u), r, p)),
            bounds=(-bound, bound), x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15,
            max_nfev=2000,
        )  # fmt: skip
        assert float(result.convergence.cost) <= 2 * fit.cost * (1 + 1e-8) + 1e-9
        if np.isfinite(result.covariance).all() and float(
            result.convergence.cost
        ) > 2 * fit.cost * (1 - 1e-6):
            theirs = moved_to(start, jnp.asarray(fit.x[:9])).matrix()
            assert angle(theirs, result.image_to_probe) < 1e-4
            compared += 1
    assert compared >= len(SETTINGS) // 2


LAW = {"images": 30, "elevation_mm": 3.0, "noise_mm": 2.0}
SEEDS = range(16)


@pytest.fixture(scope="module")
def single() -> jaxcal.Problem:
    return problem(4, images=30, elevation_mm=2.0, noise_mm=2.0)


@pytest.fixture(scope="module")
def self_tuned(single) -> jaxcal.Calibration:
    """Of all seeds, and of the single problem."""
    problems = jaxcal.stack([*(problem(k, **LAW) for k in SEEDS), single])
    return jaxcal.calibrate_batch(problems, prior="gaussian").numpy()


def test_self_tuning_maximises_the_restricted_likelihood(self_tuned, single):
    data, result = single, self_tuned[len(SEEDS)]
    parameters = parameters_of(result)

    here = (parameters, jnp.zeros(9), data)
    residual = np.asarray(errors_at(*here))
    design = np.asarray(jax.jit(jax.jacfwd(errors_at, argnums=1))(*here))

    def negative_likelihood(log_sigma: np.ndarray) -> float:
        """Of the model linearised at the solution, the unknowns integrated out."""
        scale = np.exp(log_sigma)
        whitened = (design / scale[:, None]).reshape(-1, 9)
        values = (residual / scale).ravel()
        rest = values - whitened @ np.linalg.lstsq(whitened, values)[0]
        _, determinant = np.linalg.slogdet(whitened.T @ whitened)
        return 0.5 * rest @ rest + 0.5 * determinant + 30 * np.sum(log_sigma)

    best = minimize(negative_likelihood, np.zeros(3), method="Nelder-Mead",
                    options={"xatol": 1e-7, "fatol": 1e-10, "maxiter": 4000})  # fmt: skip
    np.testing.assert_allclose(result.sigma, np.exp(best.x), rtol=2e-4)


def test_self_tuned_beats_conventional_and_recovers_the_sds(self_tuned):
    truth = [jaxcal.simulate_recording(jaxcal.Protocol(**LAW), k) for k in SEEDS]
    results = {
        "conventional": [jaxcal.calibrate(problem(k, **LAW), "conventional") for k in SEEDS],
        "self-tuned": [self_tuned[k] for k in range(len(SEEDS))],
    }
    precision = {}
    for name, each in results.items():
        assert all(result.converged for result in each)
        precision[name] = np.mean([
            jaxcal.reconstruction_precision(r.image_to_probe, t.test.poses, t.test.measurements)
            for r, t in zip(each, truth, strict=True)
        ])  # fmt: skip
    realised = np.mean([np.sqrt(np.mean(t.truth.elevation**2)) for t in truth])
    assert precision["self-tuned"] < 0.9 * precision["conventional"]
    found = self_tuned.sigma[: len(SEEDS), 2].mean()
    assert float(found) == pytest.approx(realised, rel=0.05)


@pytest.fixture(scope="module")
def beside_own_covariances() -> jaxcal.Calibration:
    """Of 200 problems, of one recording, and of that with one covariance for all its images.

    And with one that is none.
    """
    recording = jaxcal.simulate_recording(
        jaxcal.Protocol(images=30, elevation_mm=2.0, noise_mm=2.0), 4
    )
    # Simulated problems have no medium, which points do not need.
    data = replace(jaxcal.Problem.from_recording(recording), sound_speed=None, delay=None)
    same = replace(data, covariance=jnp.asarray(np.tile(np.diag([4.0, 0.25]), (30, 1, 1))))
    signs = np.where(np.arange(30) == 3, -1.0, 1.0)[:, None, None]
    none = replace(data, covariance=jnp.asarray(signs * np.asarray(data.covariance)))
    protocol = jaxcal.Protocol(images=30, test_images=2, elevation_mm=2.0, noise_mm=2.0)

    @jax.jit
    @jax.vmap
    def drawn(seed):
        experiment = jaxcal.simulate(jax.random.key(seed), protocol)
        return replace(experiment.problem(), covariance=experiment.covariance)

    problems = jax.tree.map(
        lambda many, *each: np.concatenate([many, np.stack(each)]),
        drawn(jnp.arange(200)), data, same, none,
    )  # fmt: skip
    return jaxcal.calibrate_batch(problems, prior="gaussian").numpy()


def test_sds_beside_own_covariances_are_found(beside_own_covariances):
    """They are the units of the residuals as well, which must not stop the descent."""
    result = beside_own_covariances[:200]
    assert np.mean(np.asarray(result.converged)) >= 0.99
    assert np.median(result.convergence.variance_rounds) < 20


def test_given_covariances_set_the_weights(beside_own_covariances, self_tuned):
    weighted, same = beside_own_covariances[200], beside_own_covariances[201]
    plain = self_tuned[len(SEEDS)]
    assert beside_own_covariances.status[200:].tolist() == ["converged", "converged", "failed"]
    assert angle(weighted.image_to_probe, plain.image_to_probe) > 1e-5
    # One covariance for all images is no information: the answer is the plain one.
    np.testing.assert_allclose(same.image_to_probe, plain.image_to_probe, atol=1e-6)


def test_conventional_is_scipys_least_squares():
    data = problem(2, images=20, elevation_mm=2.0, noise_mm=2.0)
    result = jaxcal.calibrate(data, method="conventional")
    start = parameters_of(result)

    @jax.jit
    def residual(tangent):
        return circle_residual(retract(start, tangent, RIGID), jnp.zeros(20), data).ravel()

    away = 0.1 * np.random.default_rng(0).normal(size=9)
    slope = jax.jit(jax.jacfwd(residual))
    fit = least_squares(
        lambda u: np.asarray(residual(jnp.asarray(u))), away,
        jac=lambda u: np.asarray(slope(jnp.asarray(u))),  # pyright: ignore[reportArgumentType]
        method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15,
    )  # fmt: skip
    assert float(result.convergence.cost) == pytest.approx(2 * fit.cost, rel=1e-12)
    np.testing.assert_allclose(fit.x, 0, atol=1e-5)


def test_elevation_is_where_the_target_is_in_the_image(single):
    data = single
    result = jaxcal.calibrate(data, method="conventional")
    np.testing.assert_allclose(
        result.elevation,
        np.asarray(errors_at(parameters_of(result), jnp.zeros(9), data))[:, 2],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        result.rms, np.sqrt(float(result.convergence.cost) / 30), rtol=1e-12
    )  # Eq. 7's residuals are the in-plane ones
