"""The residuals of one problem, as arrays with one row an image.

They are the residuals of :mod:`jaxcal.model.observations` in the layout of public arrays, for
callers with a solver of their own and for code that takes one problem at a time. Images
left out give zeros.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal import InputError
from jaxcal.data.problem import Problem
from jaxcal.model.batch import ImagePlanes, Iterate, targets
from jaxcal.model.observations import ChannelDistances, FurtherUnknowns, Points, on_circle
from jaxcal.model.parameters import Parameters
from jaxcal.model.unknowns import FURTHER, RIGID


def _batch_of_one(
    parameters: Parameters, problem: Problem, *, channels: bool = False
) -> tuple[ImagePlanes, FurtherUnknowns, list[Array]]:
    """The images, the further unknowns and q of one problem, as planes of a batch of one."""
    alone = jax.tree.map(lambda leaf: leaf[None], (parameters, problem))
    images = ImagePlanes.of(alone[1], channels=channels)
    iterate = Iterate.of(alone[0], RIGID + FURTHER)
    return images, FurtherUnknowns.at(iterate), targets(iterate, images)[0]


def measured_points(parameters: Parameters, problem: Problem) -> Float[Array, "n 2"]:
    """Lateral position and range of every image, mm; without meaning where left out.

    Args:
        parameters: X, target and further unknowns.
        problem: the data.
    """
    images, further, _ = _batch_of_one(parameters, problem)
    return jnp.stack([plane[0] for plane in further.points(images)], axis=1)


def target_in_image(parameters: Parameters, problem: Problem) -> Float[Array, "n 3"]:
    """q_i = X^-1 B_i^-1 c: lateral, elevational, axial, mm; (0, 0, 1) where left out.

    Args:
        parameters: X, target and further unknowns.
        problem: the data.
    """
    q = jnp.stack([plane[0] for plane in _batch_of_one(parameters, problem)[2]], axis=1)
    unused = jnp.asarray([0.0, 0.0, 1.0], q.dtype)
    return jnp.where(problem.mask[:, None] > 0, q, unused)


def circle_residual(
    parameters: Parameters, elevation: Float[Array, " n"], problem: Problem
) -> Float[Array, "n 3"]:
    """q_i - p_i(y_i), mm, at given offsets y_i; its norm is |c - B_i X p_i| of Eq. 7.

    Args:
        parameters: X, target and further unknowns.
        elevation: the offsets y_i, mm; where one exceeds the image's range, its row is NaN.
        problem: the data.

    Raises:
        InputError: not one offset for each image.
    """
    if jnp.shape(elevation) != problem.mask.shape:
        raise InputError(
            f"elevation must have shape {problem.mask.shape}, not {jnp.shape(elevation)}"
        )
    images, further, q = _batch_of_one(parameters, problem)
    return _rows(on_circle(q, elevation[None], further, images), problem)


def measurement_residual(parameters: Parameters, problem: Problem) -> Float[Array, "n 3"]:
    """Lateral error, range error and elevational offset of every image, mm.

    Args:
        parameters: X, target and further unknowns.
        problem: the data.
    """
    images, further, q = _batch_of_one(parameters, problem)
    unit = Points(jnp.ones((3, 1), problem.mask.dtype))
    found = unit.components(q, further, images)
    return _rows([component.errors[0] for component in found], problem)


def channel_residual(parameters: Parameters, problem: Problem) -> Float[Array, "n elements"]:
    """Distance error of every element that heard the target, mm at the nominal sound speed.

    Args:
        parameters: X, target and further unknowns.
        problem: the data, with channels.
    """
    images, further, q = _batch_of_one(parameters, problem, channels=True)
    unit = ChannelDistances(jnp.ones((2, 1), problem.mask.dtype))
    distances = unit.components(q, further, images)[0]
    present = 1.0 if distances.present is None else distances.present[0]
    return problem.mask[:, None] * present * distances.errors[0][0]


def _rows(planes: list[Array], problem: Problem) -> Float[Array, "n columns"]:
    rows = jnp.stack([plane[0] for plane in planes], axis=1)
    return jnp.where(problem.mask[:, None] > 0, problem.mask[:, None] * rows, 0.0)
