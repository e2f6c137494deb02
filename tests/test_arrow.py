"""The eliminated system against the dense one."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxcal.solvers import arrow


def blocks(rng: np.random.Generator, images: int = 7, unknowns: int = 5):
    jacobian = rng.normal(size=(unknowns, images, 3))
    own = rng.normal(size=(images, 3))
    residual = rng.normal(size=(images, 3))
    dense = np.zeros((images * 3, unknowns + images))
    dense[:, :unknowns] = jacobian.reshape(unknowns, -1).T
    for i in range(images):
        dense[3 * i : 3 * i + 3, unknowns + i] = own[i]
    return jacobian, own, residual, dense


def build(jacobian, own, residual, offset, limit):
    return arrow.build(*(jnp.asarray(a) for a in (residual, jacobian, own, offset, limit)))


def test_damped_step_is_the_dense_one():
    jacobian, own, residual, dense = blocks(np.random.default_rng(0))
    made = build(jacobian, own, residual, np.zeros(7), np.full(7, np.inf))
    for damping in (0.0, 1e-3, 10.0):
        step, offsets = arrow.solve(made, jnp.asarray(damping))
        normal = dense.T @ dense
        normal += damping * np.diag(np.diag(normal))
        expected = -np.linalg.solve(normal, dense.T @ residual.ravel())
        np.testing.assert_allclose(np.concatenate([step, offsets]), expected, rtol=1e-9)


def test_schur_complement_is_the_marginal_information():
    jacobian, own, residual, dense = blocks(np.random.default_rng(1))
    made = build(jacobian, own, residual, np.zeros(7), np.full(7, np.inf))
    information, _ = arrow.schur(made)
    covariance = np.linalg.inv(dense.T @ dense)[:5, :5]
    np.testing.assert_allclose(np.linalg.inv(information), covariance, rtol=1e-9)


def test_offsets_pushed_against_their_bound_are_held():
    jacobian, own, residual, dense = blocks(np.random.default_rng(2))
    gradient = np.sum(own * residual, axis=1)
    limit = np.ones(7)
    # Descent runs against the gradient: a negative one pushes an offset at +1 outwards.
    offset = np.where(gradient < 0, 1.0, -1.0)
    offset[:3] *= -1
    made = build(jacobian, own, residual, offset, limit)
    np.testing.assert_array_equal(made.free, [1, 1, 1, 0, 0, 0, 0])
    step, moves = arrow.solve(made, jnp.asarray(0.0))
    columns = list(range(8))
    reduced = dense[:, columns]
    expected = -np.linalg.lstsq(reduced, residual.ravel())[0]
    np.testing.assert_allclose(np.concatenate([step, moves[:3]]), expected, rtol=1e-8)
    np.testing.assert_array_equal(moves[3:], 0)


def test_a_singular_direction_gets_no_step_and_spoils_nothing():
    rng = np.random.default_rng(3)
    jacobian, own, residual, _ = blocks(rng)
    jacobian[4] = jacobian[3]
    made = build(jacobian, own, residual, np.zeros(7), np.full(7, np.inf))
    step, _ = arrow.solve(made, jnp.asarray(0.0))
    reduced = build(jacobian[:4], own, residual, np.zeros(7), np.full(7, np.inf))
    expected, _ = arrow.solve(reduced, jnp.asarray(0.0))
    np.testing.assert_allclose(step[:3], expected[:3], rtol=1e-6)
    np.testing.assert_allclose(step[3] + step[4], expected[3], rtol=1e-6)


def test_stationarity_of_a_solved_linear_problem_vanishes():
    jacobian, own, residual, dense = blocks(np.random.default_rng(4))
    solution = -np.linalg.lstsq(dense, residual.ravel())[0]
    rest = residual + (dense @ solution).reshape(7, 3)
    made = build(jacobian, own, rest, solution[5:], np.full(7, np.inf))
    before = build(jacobian, own, residual, np.zeros(7), np.full(7, np.inf))
    assert arrow.stationarity(made) < 1e-14 < 1e-2 < arrow.stationarity(before)
