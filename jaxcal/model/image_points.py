"""How a point of the image moves with the unknowns: shared by TRE, ``apply`` and pose design.

A pixel (u, v) lies at p = (s_u u, 0, k (s_v v + f - delay)) in the image frame, with pixel sizes s,
the factor k on the sound speed, the range f of row 0 and the delay in mm. Under the right
perturbation X Exp([v, omega]) and steps of the logarithms of s and k, to first order

    dp = v + omega x p + (x ds_u, 0, (z - o) ds_v + z dk - k ddelay),    o = k (f - delay),

so errors of the pixel size and of the origin can compensate each other: the uncertainty of a point
needs the covariance of all these unknowns, not of X alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from jaxcal.model.unknowns import TABLE, Blocks
from jaxcal.runtime.array_types import AnyArray, Float


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


def distance(
    first: Float[np.ndarray, "4 4"],
    second: Float[np.ndarray, "4 4"],
    stretch: Float[np.ndarray, " 2"],
    grid: Float[np.ndarray, "m 2"],
    face_mm: float,
) -> float:
    """How far apart two X put image points, root mean square, mm.

    Args:
        first: image to probe.
        second: another one.
        stretch: size of the second image's pixels over that of the first's, [lateral, axial].
        grid: [lateral, axial] of the points in the first image, mm.
        face_mm: range of pixel row 0.
    """
    zero, one = np.zeros(len(grid)), np.ones(len(grid))
    there = np.stack([grid[:, 0], zero, grid[:, 1], one])
    axial = face_mm + stretch[1] * (grid[:, 1] - face_mm)
    other = np.stack([stretch[0] * grid[:, 0], zero, axial, one])
    moved = (second @ other - first @ there)[:3]
    return math.sqrt(float(np.mean(np.sum(moved**2, axis=0))))
