"""Self-tuned SDs: restricted maximum likelihood, maximised directly, and Helmert's iteration.

With residuals r of components k with SDs s_k, linearised where the weighted sum of squares is
least (r = r0 + J x), the restricted log likelihood is

    -sum n_k ln s_k - 1/2 ln |J' W J + P| - 1/2 min_x (r' W r + prior),   W = diag(1 / s_k^2),

P what is known of the unknowns beforehand. :func:`reml` maximises it over ln s and solves for the
unknowns again with these SDs, until both stand still. :func:`helmert` iterates
s_k^2 = |r_k|^2 / (n_k - leverage_k) densely. Where an image's covariance correlates components that
have SDs of their own, the two differ: Helmert's equation is unbiased but not the likelihood's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from oracle.least_squares import Fit, medium, minimise, standardised
from oracle.model import Data, Unknowns, channels, jacobian, size, target

Components = Callable[[Unknowns, np.ndarray], list[np.ndarray]]
"""Residuals by component, in units of the SDs, at unknowns and SDs."""


@dataclass(frozen=True)
class Tuned:
    """Self-tuned unknowns and SDs."""

    fit: Fit
    sigma: np.ndarray


def point_components(data: Data, shape: np.ndarray | None = None) -> Components:
    """Lateral position, range and offset."""
    return lambda u, sigma: standardised(data, u, sigma, shape)


def channel_components(data: Data) -> Components:
    """Element distances and offset."""
    heard = np.asarray(data.heard) > 0
    return lambda u, sigma: [channels(data, u)[heard] / sigma[0], target(data, u)[:, 1] / sigma[1]]


def solve(
    components: Components,
    u: Unknowns,
    sigma: np.ndarray,
    blocks: tuple[str, ...],
    medium_sd: np.ndarray | None,
    *,
    near: bool = True,
) -> Fit:
    """The weighted fit."""

    def residual(u: Unknowns) -> np.ndarray:
        parts = components(u, sigma)
        return np.concatenate(parts if medium_sd is None else [*parts, medium(u, medium_sd)])

    return minimise(residual, u, blocks, near=near)


def _first(components: Components, u: Unknowns, count: int) -> np.ndarray:
    parts = components(u, np.ones(count))
    sd = np.array([np.sqrt(np.mean(part.real**2)) for part in parts])
    return np.maximum(sd, 1e-3 * sd.max())


def helmert(
    components: Components,
    start: Unknowns,
    count: int,
    blocks: tuple[str, ...],
    medium_sd: np.ndarray | None = None,
    rounds: int = 400,
) -> Tuned:
    """Helmert's iteration to its fixed point; no SD below a thousandth of the largest."""
    sigma, u = _first(components, start, count), start
    change = np.inf
    for _ in range(rounds):
        fit = solve(components, u, sigma, blocks, medium_sd, near=change < 0.03)
        u = fit.unknowns
        along = fit.jacobian
        leverage = np.einsum("ra,ab,rb->r", along, np.linalg.inv(along.T @ along), along)
        new, at = sigma.copy(), 0
        for which, part in enumerate(components(u, sigma)):
            rows = slice(at, at + len(part))
            at += len(part)
            new[which] *= np.sqrt(np.sum(part**2) / (len(part) - leverage[rows].sum()))
        new = np.maximum(new, 1e-3 * new.max())
        change, sigma = np.abs(np.log(new / sigma)).max(), new
        if change < 1e-12:
            break
    return Tuned(solve(components, u, sigma, blocks, medium_sd), sigma)


def reml(
    components: Components,
    start: Unknowns,
    count: int,
    blocks: tuple[str, ...],
    medium_sd: np.ndarray | None = None,
) -> Tuned:
    """Restricted maximum likelihood, by Newton's method on the logarithms of the SDs."""
    log_sigma, u = np.log(_first(components, start, count)), start
    change = np.inf
    for _ in range(60):
        fit = solve(components, u, np.exp(log_sigma), blocks, medium_sd, near=change < 0.03)
        u = fit.unknowns
        unit = np.ones(count)
        r0 = components(u, unit)
        along = jacobian(
            lambda step, u=u, unit=unit: np.concatenate(components(u.moved(step, blocks), unit)),
            size(blocks),
        )
        edges = np.cumsum([0, *map(len, r0)])
        prior_r, prior_j = np.zeros(0), np.zeros((0, size(blocks)))
        if medium_sd is not None:
            prior_r = medium(u, medium_sd)
            prior_j = jacobian(
                lambda step, u=u: medium(u.moved(step, blocks), medium_sd), size(blocks)
            )

        def negative(log_s, r0=r0, along=along, edges=edges, pr=prior_r, pj=prior_j):
            """Minus the restricted log likelihood of the linear problem (complex log_s allowed)."""
            information = pj.T @ pj + 0j
            gradient = pj.T @ pr + 0j
            total = pr @ pr + 0j
            value = 0j
            for k, part in enumerate(r0):
                weight = np.exp(-2 * log_s[k])
                rows = along[edges[k] : edges[k + 1]]
                information = information + weight * rows.T @ rows
                gradient = gradient + weight * rows.T @ part
                total = total + weight * part @ part
                value = value + len(part) * log_s[k]
            value = value + 0.5 * np.log(np.linalg.det(information / information[0, 0]))
            value = value + 0.5 * len(information) * np.log(information[0, 0])
            return value + 0.5 * (total - gradient @ np.linalg.solve(information, gradient))

        def slope(log_s: np.ndarray, negative=negative) -> np.ndarray:
            unit = 1j * 1e-30 * np.eye(count)
            return np.array([negative(log_s + row).imag / 1e-30 for row in unit])

        before = log_sigma.copy()
        for _ in range(100):
            h = 1e-5 * np.eye(count)
            hessian = np.stack([(slope(log_sigma + e) - slope(log_sigma - e)) / 2e-5 for e in h])
            values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
            # Uphill curvature is turned about: a descent step always.
            step = -vectors @ ((vectors.T @ slope(log_sigma)) / np.maximum(np.abs(values), 1e-3))
            step /= max(1.0, np.abs(step).max())
            log_sigma = log_sigma + step
            if np.abs(step).max() < 1e-12:
                break
        change = np.abs(log_sigma - before).max()
        if change < 1e-12:
            break
    sigma = np.exp(log_sigma)
    return Tuned(solve(components, u, sigma, blocks, medium_sd), sigma)
