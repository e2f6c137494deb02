"""How a point of the image moves with the unknowns: shared by TRE, ``apply`` and pose design.

A pixel (u, v) lies at p = (s_u u, 0, k (s_v v + f - delay)) in the image frame, with pixel sizes s,
the factor k on the sound speed, the range f of row 0 and the delay in mm. Under the right
perturbation X Exp([v, omega]) and steps of the logarithms of s and k, to first order

    dp = v + omega x p + (x ds_u, 0, (z - o) ds_v + z dk - k ddelay),    o = k (f - delay),

so errors of the pixel size and of the origin can compensate each other: the uncertainty of a point
needs the covariance of all these unknowns, not of X alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcal.model.unknowns import TABLE, Blocks
from jaxcal.runtime.array_types import AnyArray, Float
from jaxcal.runtime.arrays import array_module


def point_jacobian(
    points: Float[Any, "*batch m 2"],
    blocks: Blocks,
    origin: Float[Any, "*batch"] | float = 0.0,
    speed: Float[Any, "*batch"] | float = 1.0,
    xp: Any = np,
) -> Float[Any, "*batch m 3 p"]:
    """Derivatives of image points by the unknowns (image frame; mm per mm, rad and log unit).

    Args:
        points: [lateral, axial], mm.
        blocks: the unknowns, in order; the columns of those that move no image point are zero.
        origin: o, range of pixel row 0, mm.
        speed: k, factor on the sound speed.
        xp: numpy or jax.numpy.
    """
    x, z = points[..., 0], points[..., 1]
    zero, one = xp.zeros_like(x), xp.ones_like(x)
    origin = xp.asarray(origin)[..., None] * one
    speed = xp.asarray(speed)[..., None] * one
    # The columns of I, those of omega x p with p = (x, 0, z), then those of the further unknowns.
    columns = {
        "translation": [(one, zero, zero), (zero, one, zero), (zero, zero, one)],
        "rotation": [(zero, -z, zero), (z, zero, -x), (zero, x, zero)],
        "scale": [(x, zero, zero), (zero, zero, z - origin)],
        "sound-speed": [(zero, zero, z)],
        "delay": [(zero, zero, -speed)],
    }
    chosen = []
    for block in blocks:
        still = [(zero, zero, zero)] * TABLE[block].size
        chosen += columns[block] if TABLE[block].in_image else still
    return xp.stack([xp.stack(column, axis=-1) for column in chosen], axis=-1)


def mean_of_squares(jacobian: Float[AnyArray, "*batch m 3 p"]) -> Float[np.ndarray, "*batch p p"]:
    """W with tr(W S) the mean squared error over m image points, for a covariance S."""
    jacobian = np.asarray(jacobian)
    return np.einsum("...mia,...mib->...ab", jacobian, jacobian) / jacobian.shape[-3]


def stretched(
    transforms: Float[AnyArray, "*k 4 4"],
    lateral: Float[Any, "*k"],
    axial: Float[Any, "*k"],
    shift: Float[Any, "*k"],
) -> Float[AnyArray, "*k 4 4"]:
    """Transforms of the points (lateral x, axial z + shift) of an image, as transforms of (x, z).

    Another size of a pixel, another sound speed or another delay moves points of an image so.

    Args:
        transforms: image to probe, mm.
        lateral: factor on lateral positions.
        axial: factor on axial positions.
        shift: of axial positions, mm.
    """
    xp = array_module(transforms, lateral, axial, shift)
    one = xp.ones_like(axial)
    # Columns of the rotation are stretched; the last column is the translation.
    stretch = xp.stack([lateral, one, axial, one], axis=-1)
    moved = shift[..., None] * transforms[..., :, 2]
    last = xp.asarray([0.0, 0.0, 0.0, 1.0])
    return transforms * stretch[..., None, :] + moved[..., None] * last


def rms_distance(
    transforms: Float[AnyArray, "*k 4 4"],
    whole: Float[AnyArray, "4 4"],
    points: Float[AnyArray, "m 2"],
) -> Float[AnyArray, "*k"]:
    """Root mean square distance of image points under each transform from those under ``whole``.

    Args:
        transforms: image to probe, mm.
        whole: the one to compare them with.
        points: [lateral, axial], mm.
    """
    xp = array_module(transforms, whole, points)
    zero, one = xp.zeros_like(points[:, 0]), xp.ones_like(points[:, 0])
    there = xp.stack([points[:, 0], zero, points[:, 1], one])
    moved = ((transforms - whole) @ there)[..., :3, :]
    return xp.asarray(xp.sqrt(xp.mean(xp.sum(moved**2, axis=-2), axis=-1)))
