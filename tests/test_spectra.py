"""Inverses and the ends of spectra, against numpy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.solvers import spectra


def drawn(spread: float) -> np.ndarray:
    """Seven positive definite 9x9 matrices with a unit diagonal, the last one the identity."""
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(7, 20, 9)) @ (np.eye(9) + spread * rng.normal(size=(7, 9, 9)))
    matrices = np.swapaxes(rows, 1, 2) @ rows
    size = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    matrices = matrices / size[:, :, None] / size[:, None]
    matrices[-1] = np.eye(9)
    return matrices


def test_inverses_and_ends():
    matrices = drawn(1.0)
    values, vectors = np.linalg.eigh(matrices)

    @jax.jit
    def found(lanes):
        inverse = spectra.inverses(lanes)
        return inverse, spectra.largest(lanes), spectra.largest(inverse)

    inverse, most, least = found(jnp.moveaxis(jnp.asarray(matrices), 0, -1))
    identity = matrices @ np.moveaxis(np.asarray(inverse), -1, 0)
    condition = values[:, -1] / values[:, 0]
    errors = np.max(np.abs(identity - np.eye(9)), axis=(1, 2))
    assert np.all(errors < 100 * np.finfo(float).eps * condition)
    np.testing.assert_allclose(most.value, values[:, -1], rtol=1e-13)
    assert np.all(np.abs(1 / least.value - values[:, 0]) < 1e-14 * values[:, -1])
    for each, column in ((most, -1), (least, 0)):
        # The identity's vector may be any.
        cosine = np.sum(np.asarray(each.vector).T * vectors[:, :, column], axis=1)[:-1]
        np.testing.assert_allclose(np.abs(cosine), 1, rtol=1e-9)
        np.testing.assert_allclose(np.sum(np.asarray(each.vector) ** 2, axis=0), 1, rtol=1e-13)


def test_an_indefinite_matrix_is_lost_alone():
    matrices = drawn(0.3)
    matrices[2, 0, 0] = -1.0
    inverse = np.moveaxis(
        np.asarray(jax.jit(spectra.inverses)(jnp.moveaxis(jnp.asarray(matrices), 0, -1))), -1, 0
    )
    others = np.arange(7) != 2
    assert np.isnan(inverse[2]).any()
    np.testing.assert_allclose(inverse[others], np.linalg.inv(matrices[others]), rtol=1e-9)
