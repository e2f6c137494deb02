"""What the model says of an image: where the target is in it, and how far from the measurement.

With q_i = X^-1 B_i^-1 c, the target in image i's frame, and (x_i, r_i) the measured lateral
position and range, the target lies on a circle about the element line (the paper's Eq. 5):

    p_i(y) = (x_i, y, sqrt(r_i^2 - y^2)).

Two residuals follow. :func:`circle_residual` is the paper's: the three components of q_i -
p_i(y_i), equally weighted (Eq. 7 with y = 0; Fig. 4 and the bounded joint problem with y free).
:func:`measurement_residual` is in the coordinates that were measured: lateral, range, and the
elevational offset itself, each with its own noise.

Where the times of flight to all elements are there, :func:`channel_residual` is in these: what each
element should have heard less what it heard, sqrt(|q_i - e_k|^2) of Eqs. 5 and 6.

Images left out give zeros.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal.model.parameters import Parameters
from jaxcal.problem import Channels, Problem

LARGEST_ELEVATION = 0.95
"""Offsets are kept below this fraction of the range: at 1 the circle's tangent turns axial."""


def measured_points(parameters: Parameters, problem: Problem) -> Float[Array, "n 2"]:
    """Lateral position and range of every image, mm.

    Pixels are multiplied by spacing and scale; a range is a time of flight in disguise and follows
    sound speed and delay, while lateral positions come from where the elements are.
    """
    points = problem.measurements * (problem.spacing * parameters.scale)
    distance = points[:, 1] + problem.face_offset
    distance = (distance - parameters.delay) * parameters.sound_speed
    return jnp.stack([points[:, 0], distance], axis=1)


def target_in_image(parameters: Parameters, problem: Problem) -> Float[Array, "n 3"]:
    """q_i = X^-1 B_i^-1 c: lateral, elevational, axial, mm; (0, 0, 1) where left out."""
    rotations = problem.poses[:, :3, :3]
    in_probe = jnp.einsum("nji,nj->ni", rotations, parameters.point - problem.poses[:, :3, 3])
    q = (in_probe - parameters.translation) @ parameters.rotation
    # hypot has no derivative at 0, where an image left out may well put the target.
    unused = jnp.asarray([0.0, 0.0, 1.0], q.dtype)
    return jnp.where(problem.mask[:, None] > 0, q, unused)


def point_on_circle(
    points: Float[Array, "n 2"], elevation: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """p_i(y_i) of Eq. 5, mm; the elevation must stay below the range."""
    lateral, distance = points[:, 0], points[:, 1]
    axial = jnp.sqrt(jnp.maximum(distance**2 - elevation**2, (1e-6 * distance) ** 2))
    return jnp.stack([lateral, elevation, axial], axis=1)


def circle_residual(
    parameters: Parameters, elevation: Float[Array, " n"], problem: Problem
) -> Float[Array, "n 3"]:
    """q_i - p_i(y_i), mm; its norm is |c - B_i X p_i| of Eq. 7."""
    model = target_in_image(parameters, problem)
    measured = point_on_circle(measured_points(parameters, problem), elevation)
    return problem.mask[:, None] * (model - measured)


def closest_elevation(
    parameters: Parameters, bound: Float[Array, " n"], problem: Problem
) -> Float[Array, " n"]:
    """The y_i of the point closest to q_i on the arc |y| <= bound (the paper's section 2.4), mm.

    On the circle the distance grows with the angle away from q_i, so the closest point of the arc
    is the closest point of the circle where that lies on the arc, else the arc's nearer end.
    """
    q = target_in_image(parameters, problem)
    distance = measured_points(parameters, problem)[:, 1]
    on_circle = distance * q[:, 1] / jnp.hypot(q[:, 1], q[:, 2])
    # Behind the transducer the arc's nearer end is the one on q's side.
    behind = jnp.where(q[:, 1] < 0, -bound, bound)
    free = jnp.where(q[:, 2] > 0, on_circle, behind)
    return problem.mask * jnp.clip(free, -bound, bound)


def measurement_residual(
    parameters: Parameters, problem: Problem, shift: Float[Array, " n"] | None = None
) -> Float[Array, "n 3"]:
    """Lateral error, range error and elevational offset of every image, mm.

    Args:
        parameters: the unknowns.
        problem: the data.
        shift: (n,) mm by which the target's elevation differs from q_iy (tracker noise), or None.
    """
    q = target_in_image(parameters, problem)
    points = measured_points(parameters, problem)
    elevation = q[:, 1] if shift is None else q[:, 1] + shift
    residual = jnp.stack(
        [q[:, 0] - points[:, 0], jnp.hypot(elevation, q[:, 2]) - points[:, 1], elevation], axis=1
    )
    return problem.mask[:, None] * residual


def channel_residual(
    parameters: Parameters, channels: Channels, problem: Problem
) -> Float[Array, "n elements"]:
    """Distance error of every element that heard the target, mm at the nominal sound speed.

    With the sound speed s times the nominal one, and a delay worth d mm, an element at distance
    |q_i - e_k| measures |q_i - e_k| / s + d.
    """
    q = target_in_image(parameters, problem)
    apart = q[:, None, :] - channels.elements
    exact = jnp.sqrt(jnp.sum(apart**2, axis=-1))
    error = exact / parameters.sound_speed + parameters.delay - channels.distances
    return problem.mask[:, None] * channels.heard * error
