"""How good a calibration is: reconstruction precision, reproducibility, residual RMS."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.geometry import AnyArray, transform_points
from jaxcal.precision import in_own_modes


@in_own_modes
def reconstruction_precision(
    image_to_probe: Float[AnyArray, "4 4"],
    poses: Float[AnyArray, "n 4 4"],
    points: Float[AnyArray, "n columns"],
    mask: Float[AnyArray, " n"] | None = None,
) -> Float[Array, ""]:
    """Point reconstruction precision, Eq. 8: norm of the SD of B_i X p_i over the images, mm.

    Args:
        image_to_probe: X.
        poses: B_i of the *test* images, probe -> tracker, mm.
        points: (n, 2) [lateral, range] taken in the plane, or (n, 3) points in the image frame, mm.
        mask: (n,) 1 for images to count; all by default.

    Returns:
        sqrt(sum over x, y, z of the unbiased variance (n - 1)), mm.
    """
    poses, points = jnp.asarray(poses), jnp.asarray(points)
    cloud = reconstruct(image_to_probe, poses, points)
    weight = jnp.ones(poses.shape[0], cloud.dtype) if mask is None else jnp.asarray(mask)
    weight = weight.astype(cloud.dtype)[:, None]
    count = jnp.sum(weight)
    mean = jnp.sum(weight * cloud, axis=0) / count
    return jnp.sqrt(jnp.sum(weight * (cloud - mean) ** 2) / (count - 1))


@in_own_modes
def reconstruct(
    image_to_probe: Float[AnyArray, "4 4"],
    poses: Float[AnyArray, "n 4 4"],
    points: Float[AnyArray, "n columns"],
) -> Float[Array, "n 3"]:
    """B_i X p_i: image points in the tracker's frame, mm; (n, 2) points lie in the plane."""
    points = jnp.asarray(points)
    if points.shape[1] == 2:
        points = jnp.stack([points[:, 0], jnp.zeros_like(points[:, 0]), points[:, 1]], axis=1)
    return transform_points(jnp.asarray(poses), transform_points(jnp.asarray(image_to_probe),
                                                                 points))  # fmt: skip


@in_own_modes
def calibration_reproducibility(
    transforms: Float[AnyArray, "k 4 4"], image_points: Float[AnyArray, "m 2"]
) -> Float[Array, " m"]:
    """How far repeated calibrations scatter at image points: mean distance from their mean, mm.

    Args:
        transforms: X of k repeated calibrations of one set-up.
        image_points: [lateral, axial] of the points to look at, mm; see :func:`image_corners`.

    Returns:
        For each point, mean over the calibrations of |X_k p - mean_k X_k p|, mm.

    Source: calibration reproducibility, e.g. Hsu et al. 2009, section 6.2.
    """
    transforms, image_points = jnp.asarray(transforms), jnp.asarray(image_points)
    zero = jnp.zeros_like(image_points[:, 0])
    points = jnp.stack([image_points[:, 0], zero, image_points[:, 1]], axis=1)
    images = transform_points(transforms[:, None], points[None])
    return jnp.mean(jnp.linalg.norm(images - jnp.mean(images, axis=0), axis=-1), axis=0)


@in_own_modes
def image_corners(width_mm: float, depth_mm: float) -> Float[Array, "5 2"]:
    """The four corners of a linear probe's image and its centre, [lateral, axial] mm."""
    half = 0.5 * width_mm
    return jnp.asarray(
        [[-half, 0.0], [half, 0.0], [-half, depth_mm], [half, depth_mm], [0.0, 0.5 * depth_mm]]
    )


@in_own_modes
def root_mean_square(
    residual: Float[AnyArray, "n 3"], mask: Float[AnyArray, " n"] | None = None
) -> Float[Array, ""]:
    """Root mean square length of residual vectors (mm) over the used images."""
    residual = jnp.asarray(residual)
    weight = jnp.ones(residual.shape[0], residual.dtype) if mask is None else jnp.asarray(mask)
    return jnp.sqrt(jnp.sum(weight[:, None] * residual**2) / jnp.sum(weight))
