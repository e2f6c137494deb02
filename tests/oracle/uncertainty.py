"""Covariances from whole information matrices, observability by singular values, and Eq. 8."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from oracle.model import Data, Unknowns, circle, jacobian, place, points, size, target


def covariance(along: np.ndarray, count: int, variance: float = 1.0) -> np.ndarray:
    """Of the first ``count`` unknowns, from the whitened Jacobian by all of them."""
    scale = 1 / np.linalg.norm(along, axis=0)
    whole = np.linalg.inv((along * scale).T @ (along * scale)) * np.outer(scale, scale)
    return variance * whole[:count, :count]


def residual_variance(cost: float, images: int, unknowns: int, free_offsets: int = 0) -> float:
    """Of residuals in mm: cost over degrees of freedom, three residuals an image."""
    return cost / (3 * images - unknowns - free_offsets)


def axis_variances(along: np.ndarray, residual: np.ndarray, pooled: float) -> np.ndarray:
    """(3,) mm^2: of the errors along each axis, from a fit with equal weights.

    Args:
        along: (n, 3, p) Jacobian.
        residual: (n, 3) mm.
        pooled: variance of all residuals, which counts as half a residual of each axis.
    """
    orthonormal, _ = np.linalg.qr(along.reshape(-1, along.shape[-1]))
    left = 1 - np.sum(orthonormal**2, axis=1).reshape(residual.shape)
    return (np.sum(residual**2, axis=0) + pooled / 2) / (left.sum(axis=0) + 1 / 2)


def covariance_by_axis(along: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Of the unknowns of a fit with equal weights to errors of these variances."""
    each = np.broadcast_to(variances, along.shape[:2]).ravel()
    steps = np.linalg.pinv(along.reshape(-1, along.shape[-1]))
    return (steps * each) @ steps.T


def offset_sd(data: Data, u: Unknowns, blocks: tuple[str, ...], shared: np.ndarray) -> np.ndarray:
    """SD of q_iy, mm."""
    along = jacobian(lambda step: target(data, u.moved(step, blocks))[:, 1], size(blocks))
    return np.sqrt(np.einsum("na,ab,nb->n", along, shared, along))


@dataclass(frozen=True)
class Observability:
    """What singular values say, unknowns in mm at the lever arm.

    Attributes:
        condition: of the information: the square of the Jacobian's.
        weakest: (p,) unit vector.
        weakest_sd: mm.
        degenerate: the poses do not determine the unknowns, whatever the SDs.
    """

    condition: float
    weakest: np.ndarray
    weakest_sd: float
    degenerate: bool


def observability(
    data: Data, u: Unknowns, blocks: tuple[str, ...], along: np.ndarray, variance: float = 1.0
) -> Observability:
    """At a fit with the whitened Jacobian ``along`` (by the shared unknowns)."""
    lever = np.sqrt(np.mean(np.sum(np.stack(points(data, u)) ** 2, axis=0)))
    scale = np.ones(size(blocks))
    for name in ("rotation", "scale", "sound-speed"):
        if name in blocks:
            scale[place(blocks, name)] = lever
    values, right = np.linalg.svd(along / scale)[1:]
    design = jacobian(
        lambda step: circle(data, u.moved(step, blocks), np.zeros(len(data))), size(blocks)
    )
    plain = np.linalg.svd(design / scale)[1]
    return Observability(
        float((values[0] / values[-1]) ** 2),
        right[-1],
        float(np.sqrt(variance) / values[-1]),
        bool((plain[-1] / plain[0]) ** 2 < 1e-11),
    )


def reconstruction_precision(x: np.ndarray, poses: np.ndarray, image_points: np.ndarray) -> float:
    """Eq. 8: the root of the summed variances (n - 1) of B_i X p_i, mm."""
    places = []
    for pose, (lateral, axial) in zip(poses, image_points, strict=True):
        places.append((pose @ x @ [lateral, 0.0, axial, 1.0])[:3])
    return float(np.sqrt(np.var(np.array(places), axis=0, ddof=1).sum()))
