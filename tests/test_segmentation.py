from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from jaxcal.probe import L14_5
from jaxcal.segmentation.time_of_flight import fit_distances


def test_distance_fit_agrees_with_scipy_and_its_covariance_holds():
    rng = np.random.default_rng(0)
    elements = L14_5.element_lateral()
    truth = np.stack([rng.uniform(-29, 29, 400), rng.uniform(10, 90, 400)], axis=1)
    exact = np.hypot(truth[:, :1] - elements, truth[:, 1:])
    distances = exact + 0.5 * rng.normal(size=exact.shape)
    points, inverse = fit_distances(distances, elements)
    for k in range(0, 400, 40):

        def residual(p, k=k):
            return np.hypot(p[0] - elements, p[1]) - distances[k]

        np.testing.assert_allclose(points[k], least_squares(residual, truth[k]).x, atol=1e-5)
    error = points - truth
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(0.25 * np.asarray(inverse)), error)
    # Mean of 400 chi-squares with 2 degrees of freedom: 2 with an SD of 0.1.
    assert 1.7 < squared.mean() < 2.3


def test_exact_distances_give_the_point_from_anywhere_in_the_field():
    elements = L14_5.element_lateral()
    x, r = np.meshgrid(np.linspace(-40, 40, 9), np.linspace(5, 120, 9))
    exact = np.hypot(x[..., None] - elements, r[..., None])
    points, _ = fit_distances(exact, elements)
    np.testing.assert_allclose(points[..., 0], x, atol=1e-9)
    np.testing.assert_allclose(points[..., 1], r, atol=1e-9)
