"""How good a calibration is: reconstruction precision and reproducibility."""

from __future__ import annotations

import numpy as np

from jaxcal import InputError
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import AnyArray, Bool, Float
from jaxcal.runtime.arrays import array_module, is_traced
from jaxcal.runtime.given_values import traceable_array, truth_array
from jaxcal.runtime.jax_modes import traceable


@traceable
def reconstruction_precision(
    image_to_probe: Float[AnyArray, "4 4"] | Calibration,
    poses: Float[AnyArray, "n 4 4"],
    points: Float[AnyArray, "n columns"],
    mask: Float[AnyArray, " n"] | Bool[AnyArray, " n"] | None = None,
) -> Float[AnyArray, ""]:
    """Point reconstruction precision, Eq. 8: norm of the SD of B_i X p_i over the images, mm.

    Args:
        image_to_probe: (4, 4) X, mm; or a calibration.
        poses: B_i of the *test* images, probe -> tracker, mm.
        points: (n, 2) [lateral, range], assumed in the plane, or (n, 3) in the image frame, mm.
        mask: (n,) True (or 1) for images to count; all by default. The others may hold anything.

    Returns:
        sqrt(sum over x, y, z of the unbiased variance (n - 1)), mm.

    Raises:
        InputError: shapes that do not agree, what are no numbers, a mask of other numbers than 0
            and 1, or fewer than two images to count.
    """
    given = image_to_probe
    x = given.image_to_probe if isinstance(given, Calibration) else given
    xp, x = array_module(x, poses, points, mask), traceable_array(x, "image_to_probe")
    poses, points = traceable_array(poses, "poses"), traceable_array(points, "points")
    if mask is not None and not is_traced(mask):
        mask = truth_array(mask, "mask")
    count = len(poses) if poses.ndim else 0
    for name, values, shapes in (
        ("image_to_probe", x, [(4, 4)]),
        ("poses", poses, [(count, 4, 4)]),
        ("points", points, [(count, 2), (count, 3)]),
        ("mask", mask, [(count,)]),
    ):
        if values is not None and np.shape(values) not in shapes:
            wanted = " or ".join(map(str, shapes))
            raise InputError(f"{name} must have shape {wanted}, not {np.shape(values)}")
    if mask is not None:
        poses = xp.where(mask[:, None, None] > 0, poses, 0.0)
        points = xp.where(mask[:, None] > 0, points, 0.0)
    cloud = reconstruct(x, poses, points)
    weight = xp.ones(poses.shape[0], cloud.dtype) if mask is None else mask
    weight = weight.astype(cloud.dtype)[:, None]
    count = xp.sum(weight)
    if not is_traced(count) and count < 2:
        raise InputError(f"a scatter needs at least two images, not {count:g}")
    mean = xp.sum(weight * cloud, axis=0) / count
    return xp.asarray(xp.sqrt(xp.sum(weight * (cloud - mean) ** 2) / (count - 1)))


@traceable
def reconstruct(
    image_to_probe: Float[AnyArray, "*images 4 4"],
    poses: Float[AnyArray, "n 4 4"],
    points: Float[AnyArray, "n columns"],
) -> Float[AnyArray, "n 3"]:
    """B_i X p_i: image points in the tracker's frame, mm; (n, 2) points lie in the plane.

    X is (4, 4), or (n, 4, 4) with one for each image.
    """
    xp = array_module(image_to_probe, poses, points)
    points = xp.asarray(points)
    if points.shape[1] == 2:
        points = xp.stack([points[:, 0], xp.zeros_like(points[:, 0]), points[:, 1]], axis=1)
    in_probe = _transformed(xp.asarray(image_to_probe), points)
    return _transformed(xp.asarray(poses), in_probe)


def _transformed(transform: AnyArray, points: AnyArray) -> AnyArray:
    """Points (..., 3) by transforms (..., 4, 4)."""
    rotation, translation = transform[..., :3, :3], transform[..., :3, 3]
    return (rotation @ points[..., None])[..., 0] + translation


@traceable
def calibration_reproducibility(
    transforms: Float[AnyArray, "k 4 4"], image_points: Float[AnyArray, "m 2"]
) -> Float[AnyArray, " m"]:
    """Scatter of repeated calibrations at image points: mean distance from their mean, mm.

    Args:
        transforms: X of k repeated calibrations of one set-up.
        image_points: [lateral, axial] of the points to look at, mm.

    Returns:
        For each point, mean over the calibrations of |X_k p - mean_k X_k p|, mm.

    Raises:
        InputError: fewer than two calibrations, other shapes, or what are no numbers.

    Source: calibration reproducibility, e.g. Hsu et al. 2009, section 6.2.
    """
    xp = array_module(transforms, image_points)
    transforms = traceable_array(transforms, "transforms")
    image_points = traceable_array(image_points, "image_points")
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or len(transforms) < 2:
        raise InputError(
            f"transforms must have shape (k, 4, 4), at least two, not {transforms.shape}"
        )
    if image_points.ndim != 2 or image_points.shape[1] != 2:
        raise InputError(f"image_points must have shape (m, 2), not {image_points.shape}")
    return distance_from_mean(transforms, image_points, xp.ones_like(transforms[:, 0, 0]))


def distance_from_mean(
    transforms: Float[AnyArray, "k 4 4"],
    image_points: Float[AnyArray, "m 2"],
    weight: Float[AnyArray, " k"],
) -> Float[AnyArray, " m"]:
    """The same by weighted means; NaN where all weights are zero."""
    apart, share = _from_mean(transforms, image_points, weight)
    return array_module(apart).sum(share * apart, axis=0)


def rms_from_mean(
    transforms: Float[AnyArray, "k 4 4"],
    image_points: Float[AnyArray, "m 2"],
    weight: Float[AnyArray, " k"],
) -> Float[AnyArray, " m"]:
    """Root mean square distance of image points from their weighted mean, mm.

    Unlike the mean distance it compares with what a covariance states. NaN where all weights are
    zero.
    """
    apart, share = _from_mean(transforms, image_points, weight)
    xp = array_module(apart)
    return xp.sqrt(xp.sum(share * apart**2, axis=0))


def _from_mean(
    transforms: Float[AnyArray, "k 4 4"],
    image_points: Float[AnyArray, "m 2"],
    weight: Float[AnyArray, " k"],
) -> tuple[Float[AnyArray, "k m"], Float[AnyArray, "k 1"]]:
    """Distances of image points from their weighted mean, and the weights as shares."""
    xp = array_module(transforms, image_points, weight)
    zero = xp.zeros_like(image_points[:, 0])
    points = xp.stack([image_points[:, 0], zero, image_points[:, 1]], axis=1)
    images = _transformed(transforms[:, None], points[None])
    total = xp.sum(weight)
    share = (weight / xp.where(total > 0, total, xp.nan))[:, None]
    mean = xp.sum(share[..., None] * images, axis=0)
    return xp.linalg.norm(images - mean, axis=-1), share
