"""Quantiles of an error against plain bisection."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from jaxcal.diagnostics import intervals

FREEDOMS = (1.0, 1.7, 4.0, 20.3, 51.0, 1e3, np.inf)


def bisected(variances: np.ndarray, freedom: float, chance: float) -> float:
    """The quantile by nothing but bisection."""
    dimensions = len(variances)
    along = np.log(intervals._directions(dimensions) ** 2 @ variances)
    grid = np.linspace(np.log(1e-9), np.log(1e9), 4000)
    if np.isfinite(freedom):
        below = special.fdtr(dimensions, freedom, np.exp(grid) / dimensions)
    else:
        below = special.chdtr(dimensions, np.exp(grid))
    low, high = -50.0, 50.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        enough = np.interp(middle - along, grid, below).mean() >= chance
        low, high = (low, middle) if enough else (middle, high)
    return float(np.exp(0.5 * middle))


@pytest.mark.parametrize("freedom", FREEDOMS)
def test_quantiles_of_an_error_against_bisection(freedom):
    """Also of errors along a plane, along a line, and of none at all."""
    draws = np.random.default_rng(0).uniform(size=(12, 3))
    variances = np.concatenate(
        [draws, 1e-3 * draws**6, np.diag([1.0, 2.0, 3.0]), [[1, 1, 0], [1, 1e-9, 1e-12], [0, 0, 0]]]
    )
    for chance in (0.025, 0.5, 0.975):
        found = intervals.length_quantile(variances, freedom, chance)
        expected = [bisected(row, freedom, chance) if row.any() else 0.0 for row in variances]
        np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("dimensions", [3, 6, 8, 10, 11])
@pytest.mark.parametrize("freedom", [5.0, np.inf])
def test_quantiles_are_as_right_as_their_module_says(dimensions, freedom):
    """Errors alike along some of the axes and none along the others, whose law is known."""
    middle, low = (0.002, 0.01) if dimensions == 3 else (0.013, 0.09)
    for alike in range(1, dimensions + 1):
        variances = np.where(np.arange(dimensions) < alike, 1.0, 0.0)[None]
        for chance, right in ((0.025, low), (0.5, middle), (0.975, middle)):
            square = special.chdtri(alike, 1 - chance)
            if np.isfinite(freedom):
                square = alike * special.fdtri(alike, freedom, chance)
            if chance < 0.5 and alike == 1:
                right = max(right, 0.06)
            found = intervals.length_quantile(variances, freedom, chance)
            np.testing.assert_allclose(found, np.sqrt(square), rtol=right)
