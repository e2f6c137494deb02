"""The small linear algebra of the solvers against numpy's LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import problem

import jaxcal
from jaxcal import Options
from jaxcal.solvers import dense

RANDOM = np.random.default_rng(5)


def test_positive_systems_and_one_that_is_not():
    root = RANDOM.normal(size=(6, 9, 9))
    matrix = root @ root.swapaxes(1, 2) + 0.1 * np.eye(9)
    matrix[3] -= 5 * np.eye(9)
    rhs = RANDOM.normal(size=(6, 9, 2))
    got = np.asarray(jax.jit(jax.vmap(dense.solve_positive))(matrix, rhs))
    assert np.isnan(got[3]).all()
    good = [0, 1, 2, 4, 5]
    np.testing.assert_allclose(got[good], np.linalg.solve(matrix[good], rhs[good]), rtol=1e-9)


@pytest.mark.parametrize("size", [1, 2, 3, 5, 9, 10, 11])
def test_swept_matrices_and_one_that_is_not_positive(size: int):
    """Blocks of two and three rows, with and without rows added to fill the last block."""
    root = RANDOM.normal(size=(6, size, size + 3))
    matrix = root @ root.swapaxes(1, 2)
    unit = 10.0 ** RANDOM.uniform(-4, 4, size)  # mm and rad may be apart by as much
    matrix = matrix * unit * unit[:, None]
    bad = matrix.copy()
    bad[3, -1, -1] *= -1
    vector = RANDOM.normal(size=(6, size))

    def solve(matrix, vector):
        inverse, log_determinant = dense.inverse_batch_last(matrix)
        return inverse, log_determinant, dense.solve_batch_last(matrix, vector)

    got = jax.jit(solve)(jnp.moveaxis(bad, 0, -1), vector.T)
    inverse, log_determinant, solution = (np.moveaxis(np.asarray(part), -1, 0) for part in got)
    good = [0, 1, 2, 4, 5]
    for part in (inverse[3], log_determinant[3], solution[3]):
        assert not np.isfinite(part).any()
    scaled = inverse[good] * unit * unit[:, None]
    wanted = np.linalg.inv(matrix[good] / unit / unit[:, None])
    np.testing.assert_allclose(scaled, wanted, atol=1e-10 * np.abs(wanted).max())
    np.testing.assert_allclose(log_determinant[good], np.linalg.slogdet(matrix[good])[1])
    back = np.einsum("lij,lj->li", matrix[good], solution[good])
    largest = np.einsum("lij,lj->li", np.abs(matrix[good]), np.abs(solution[good]))
    np.testing.assert_array_less(np.abs(back - vector[good]), 1e-12 * largest)


def test_inverse_needs_pivots_and_has_a_derivative():
    matrix = RANDOM.normal(size=(5, 12, 12))
    matrix[:, 0, 0] = 0.0
    matrix[1] = np.eye(12)[::-1]
    got = jax.jit(jax.vmap(dense.inverse))(jnp.asarray(matrix))
    wanted = np.linalg.inv(matrix)
    np.testing.assert_allclose(got, wanted, atol=1e-11 * np.abs(wanted).max())
    gradient = jax.grad(lambda a: jnp.sum(dense.inverse(a)))(jnp.asarray(matrix[0]))
    by_hand = -np.outer(wanted[0].sum(axis=0), wanted[0].sum(axis=1))
    np.testing.assert_allclose(gradient, by_hand, atol=1e-9 * np.abs(by_hand).max())


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(("joint", "bounded"), marks=pytest.mark.slow),
        pytest.param(("joint", "auto"), marks=pytest.mark.slow),
        ("conventional", "auto"),
        ("alternating", "auto"),
    ],
)
def test_no_solver_calls_lapack(arguments: tuple):
    """Batched LAPACK calls can deadlock XLA's thread pool; see jaxcal.solvers.dense."""
    method, prior = arguments
    options = Options(tolerance_mm=1e-8, tolerance_rad=1e-10)

    def squares(problem: jaxcal.Problem):
        result = jaxcal.calibrate_batch(problem, method, prior, options=options)
        return jnp.sum(result.image_to_probe**2)

    batch = jaxcal.stack([problem(0, images=12), problem(1, images=12)])
    # The solve and its derivative in one program.
    program = jax.jit(jax.value_and_grad(squares)).lower(batch).as_text()
    assert "while" in program
    assert "lapack" not in program
