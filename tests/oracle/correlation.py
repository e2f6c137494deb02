"""Covariances widened for errors that are alike in successive images, by matrices of all images."""

from __future__ import annotations

import numpy as np
from scipy.fft import dct

CORRELATIONS = [0.04 + 0.08 * k for k in range(12)]
SHARES = (1 / 3, 2 / 3, 1.0)
FEWEST_IMAGES = 20


def widened(
    covariance: np.ndarray,
    along: np.ndarray,
    errors: np.ndarray,
    variances: np.ndarray | None = None,
) -> np.ndarray:
    """The covariance of a fit in the proportion in which a correlation widens that of the errors.

    Args:
        covariance: (p, p) for independent errors.
        along: (3, n, p) Jacobian J by kind of error (lateral, range, offset), whitened.
        errors: (3, n) in SDs.
        variances: (3,) of the errors, where they are not in their own SDs.
    """
    if errors.shape[1] < FEWEST_IMAGES:
        return covariance
    models = _models(errors.shape[1])
    sizes = np.ones(3) if variances is None else variances
    inverse = np.linalg.inv(np.einsum("knp,knq->pq", along, along))
    before = inverse @ np.einsum("k,knp,knq->pq", sizes, along, along) @ inverse
    expected = zip(sizes, along, _expected(models, along, errors), strict=True)
    after = inverse @ sum(v * j.T @ c @ j for v, j, c in expected) @ inverse
    # It makes no direction more certain: symmetric square roots, then eigenvalues of at least 1.
    values, vectors = np.linalg.eigh(before)
    root = (vectors * np.sqrt(values)) @ vectors.T
    values, vectors = np.linalg.eigh(np.linalg.inv(root) @ after @ np.linalg.inv(root))
    after = root @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ root
    return after * np.trace(covariance @ np.linalg.inv(before)) / len(before)


def _models(count: int) -> list[np.ndarray]:
    """(n, n) covariances of errors with variance 1 on average; the first are independent."""
    cosines, found = dct(np.eye(count), axis=0, norm="ortho"), [np.eye(count)]
    for rho in CORRELATIONS:
        power = np.array(
            [1 / abs(1 - rho * np.exp(1j * np.pi * k / count)) ** 2 for k in range(count)]
        )
        correlated = (cosines.T * (power / power.mean())) @ cosines
        found += [(1 - share) * np.eye(count) + share * correlated for share in SHARES]
    return found


def _expected(models: list[np.ndarray], along: np.ndarray, errors: np.ndarray) -> list[np.ndarray]:
    """The expected covariance of every kind of error, in units of its variance if independent."""
    kinds, count, _ = along.shape
    inverses = [np.linalg.inv(model) for model in models]
    prior = np.array([0.5] + [0.5 / (len(models) - 1)] * (len(models) - 1))
    variance = np.ones((kinds, len(models)))
    weight = np.zeros((kinds, len(models)))
    weight[:, 0] = 1.0
    for _ in range(3):
        for k in range(kinds):
            twice = np.zeros(len(models))
            others = [
                np.einsum("g,gij->ij", weight[j] / variance[j], inverses) if j != k else None
                for j in range(kinds)
            ]
            for g, inverse in enumerate(inverses):
                for _ in range(3):
                    precision = [inverse / variance[k, g] if o is None else o for o in others]
                    information, residual = _fit(precision, along, errors)
                    leverage = np.trace(
                        np.linalg.solve(information, along[k].T @ precision[k] @ along[k])
                    )
                    squares = residual[k] @ inverse @ residual[k]
                    variance[k, g] = squares / max(count - leverage, 0.1 * count)
                precision = [inverse / variance[k, g] if o is None else o for o in others]
                information, residual = _fit(precision, along, errors)
                twice[g] = (
                    sum(r @ p @ r for r, p in zip(residual, precision, strict=True))
                    + np.linalg.slogdet(information)[1]
                    + np.linalg.slogdet(models[g])[1]
                    + count * np.log(variance[k, g])
                )
            if variance[k, 0] < 0.01:
                variance[k] = 1.0
                continue
            weight[k] = prior * np.exp(-0.5 * (twice - twice.min()))
            weight[k] /= weight[k].sum()
    by = weight * variance / variance[:, :1]
    return [np.einsum("g,gij->ij", each, models) for each in by]


def _fit(
    precision: list[np.ndarray], along: np.ndarray, errors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Information of a weighted fit to the errors, and what it leaves of them."""
    information = sum(j.T @ p @ j for j, p in zip(along, precision, strict=True))
    gradient = sum(j.T @ p @ e for j, p, e in zip(along, precision, errors, strict=True))
    return information, errors - along @ np.linalg.solve(information, gradient)
