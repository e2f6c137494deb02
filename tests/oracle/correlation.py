"""Covariances widened for errors that are alike in successive images, by matrices of all images."""

from __future__ import annotations

import numpy as np
from scipy.fft import dct
from scipy.stats import norm, t

CORRELATIONS = [0.04 + 0.08 * k for k in range(12)]
SHARES = (1 / 3, 2 / 3, 1.0)
FEWEST_IMAGES = 20

PRIOR_VARIANCE = 1e4
LEVER_MM = 100.0
FOLLOWING = 0.9
FOLLOWING_SHARES = (0.9, 0.97, 0.99, 0.997, 0.999, 1 - 1e-12)


def widened(
    covariance: np.ndarray,
    along: np.ndarray,
    errors: np.ndarray,
    variances: np.ndarray | None = None,
    path: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """The covariance of a fit in the proportion in which a correlation widens that of the errors.

    Args:
        covariance: (p, p) for independent errors.
        along: (3, n, p) Jacobian J by kind of error (lateral, range, offset), whitened.
        errors: (3, n) in SDs.
        variances: (3,) of the errors, where they are not in their own SDs.
        path: (n, 3, 3) rotations and (n, 3) origins of the poses, mm; without it they are random.
    """
    if errors.shape[1] < FEWEST_IMAGES:
        return covariance
    slow = 0.0 if path is None else slowness(*path)
    models = _models(errors.shape[1])
    prior = [0.5] + [0.5 * (1 - slow) / (len(models) - 1)] * (len(models) - 1)
    follows = slice(len(models), len(models) + 4 * len(FOLLOWING_SHARES))
    doubt = 0.0
    if path is not None and slow > 0:
        for share, further in (
            (FOLLOWING, _following(errors.shape[1], period(*path))),
            (1 - FOLLOWING, _others(errors.shape[1])),
        ):
            models = models + further
            prior = prior + [0.5 * slow * share / len(further)] * len(further)
        freedom = max(1.0, 2 * errors.shape[1] / period(*path))
        doubt = (t.ppf(0.975, freedom) / norm.ppf(0.975)) ** 2 - 1
    sizes = np.ones(3) if variances is None else variances
    # Turned by a rotation. In it covariances are diagonal, so that small variances are exact.
    cosines = dct(np.eye(errors.shape[1]), axis=0, norm="ortho")
    along, errors = np.einsum("mn,knp->kmp", cosines, along), errors @ cosines.T
    inverse = np.linalg.inv(np.einsum("knp,knq->pq", along, along))
    before = inverse @ np.einsum("k,knp,knq->pq", sizes, along, along) @ inverse
    found = _expected(models, np.array(prior), along, errors, follows, doubt)
    expected = zip(sizes, along, found, strict=True)
    after = inverse @ sum(v * j.T @ c @ j for v, j, c in expected) @ inverse
    # It makes no direction more certain: symmetric square roots, then eigenvalues of at least 1.
    values, vectors = np.linalg.eigh(before)
    root = (vectors * np.sqrt(values)) @ vectors.T
    values, vectors = np.linalg.eigh(np.linalg.inv(root) @ after @ np.linalg.inv(root))
    after = root @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ root
    return after * np.trace(covariance @ np.linalg.inv(before)) / len(before)


def _models(count: int) -> list[np.ndarray]:
    """(n, n) covariances of cosine transforms of errors with variance 1; the first: independent."""
    found = [np.eye(count)]
    for rho in CORRELATIONS:
        power = np.array(
            [1 / abs(1 - rho * np.exp(1j * np.pi * k / count)) ** 2 for k in range(count)]
        )
        correlated = np.diag(power / power.mean())
        found += [(1 - share) * np.eye(count) + share * correlated for share in SHARES]
    return found


def slowness(rotation: np.ndarray, origin: np.ndarray) -> float:
    """1 where steps are up to 0.2 of the distance of poses half a recording apart, 0 from 0.4."""

    def apart(i: int, j: int) -> float:
        cosine = np.clip((np.trace(rotation[i].T @ rotation[j]) - 1) / 2, -1, 1)
        chord = 2 * LEVER_MM * np.sin(np.arccos(cosine) / 2)
        return float(np.linalg.norm(origin[i] - origin[j]) + chord)

    count = len(origin)
    steps = np.median([apart(i, i + 1) for i in range(count - 1)])
    halves = np.median([apart(i, i - count // 2) for i in range(count)])
    return float(np.clip((0.4 - steps / halves) / 0.2, 0, 1))


def period(rotation: np.ndarray, origin: np.ndarray) -> float:
    """Of a sine whose mean square step is the same share of its variance, in images."""
    tips = [origin] + [origin + LEVER_MM * rotation[:, :, axis] for axis in range(3)]
    steps = sum(np.mean(np.linalg.norm(tip[1:] - tip[:-1], axis=1) ** 2) for tip in tips)
    spread = sum(np.mean(np.linalg.norm(tip - tip.mean(axis=0), axis=1) ** 2) for tip in tips)
    # The mean square of sin(x + d) - sin(x) is 2 - 2 cos d times the variance.
    return float(2 * np.pi / np.arccos(1 - steps / spread / 2))


def _following(count: int, period: float) -> list[np.ndarray]:
    """Those of errors that change about as quickly as the probe."""
    found = []
    for relative in (0.7, 1.0, 1.4, 2.0):
        at = 2 * np.pi / min(relative * period, 2.0 * count)
        power = []
        for k in range(count):
            ratio = (1 - np.cos(np.pi * k / count)) / (1 - np.cos(at))
            power.append((1 + (2 ** (1 / 16) - 1) * ratio) ** -16)
        correlated = np.diag(power / np.mean(power))
        found += [(1 - share) * np.eye(count) + share * correlated for share in FOLLOWING_SHARES]
    return found


def _others(count: int) -> list[np.ndarray]:
    """Of first order, which have fallen to half at periods from 4 to twice the number of images."""
    found = []
    for step in range(9):
        at = 2 * np.pi / (4 * (count / 2) ** (step / 8))
        power = [1 / (1 + (1 - np.cos(np.pi * k / count)) / (1 - np.cos(at))) for k in range(count)]
        correlated = np.diag(power / np.mean(power))
        found += [(1 - share) * np.eye(count) + share * correlated for share in SHARES]
    return found


def _expected(
    models: list[np.ndarray],
    prior: np.ndarray,
    along: np.ndarray,
    errors: np.ndarray,
    follows: slice,
    doubt: float,
) -> list[np.ndarray]:
    """The expected covariance of every kind of error, in units of its variance if independent.

    The variance under the models of errors that follow the movement grows by the doubt about it.
    """
    kinds, count, _ = along.shape
    inverses = [np.linalg.inv(model) for model in models]
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
                    + 2 * variance[k, g] / (PRIOR_VARIANCE * variance[k, 0])
                )
            if variance[k, 0] < 0.01:
                variance[k] = 1.0
                continue
            weight[k] = prior * np.exp(-0.5 * (twice - twice.min()))
            weight[k] /= weight[k].sum()
    by = weight * variance / variance[:, :1]
    by[:, follows] *= 1 + doubt * weight[:, follows].sum(axis=1, keepdims=True)
    return [np.einsum("g,gij->ij", each, models) for each in by]


def _fit(
    precision: list[np.ndarray], along: np.ndarray, errors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Information of a weighted fit to the errors, and what it leaves of them."""
    information = sum(j.T @ p @ j for j, p in zip(along, precision, strict=True))
    gradient = sum(j.T @ p @ e for j, p, e in zip(along, precision, errors, strict=True))
    return information, errors - along @ np.linalg.solve(information, gradient)
