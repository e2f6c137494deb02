"""The paper's first step: gradient descent on the Euclidean group over all pairs of images.

It minimises sum_{i<j} |B_i X p_i - B_j X p_j|^2, in which the target is not an unknown. Since
sum_{i<j} |a_i - a_j|^2 = n sum_i |a_i - mean a|^2, the pairs cost no more than the points, and the
minimiser is that of Eq. 7 with c the mean; only the path to it differs. The method is kept for
comparison.

Reference: Ackerman, Cheng, Boctor, Chirikjian, "Online ultrasound sensor calibration using gradient
descent on the Euclidean group", ICRA 2014.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from jaxcal.model.batch import ImagePlanes, Iterate
from jaxcal.model.observations import FurtherUnknowns, InPlane
from jaxcal.solvers.plan import Options
from jaxcal.solvers.with_optimistix import Fit

STEPS_PER_ITERATION = 100
"""Most steps for each of ``Options.max_iterations``: they cost little, and thousands are needed."""


class SteepestDescent(optx.AbstractGradientDescent):
    """optimistix's gradient descent with an Armijo search in place of a fixed step."""

    rtol: float
    atol: float
    norm: Callable
    descent: optx.SteepestDescent  # pyright: ignore[reportIncompatibleVariableOverride]
    search: optx.BacktrackingArmijo  # pyright: ignore[reportIncompatibleVariableOverride]
    verbose: Callable[..., None] = eqx.field(static=True, default=lambda **_: None)


def reconstructed(iterate: Iterate, images: ImagePlanes) -> Float[Array, "3 batch n"]:
    """B_i X p_i, the target as reconstructed from every image, in the tracker's frame, mm."""
    lateral, distance = FurtherUnknowns.at(iterate).points(images)
    in_probe = (
        iterate.rotation[:, 0, :, None] * lateral + iterate.rotation[:, 2, :, None] * distance
    )
    in_probe = in_probe + iterate.translation[..., None]
    poses = images.rotation.reshape(3, 3, *images.mask.shape)
    return jnp.sum(poses * in_probe, axis=1) + images.origin


def pairwise_gradient(start: Iterate, images: ImagePlanes, options: Options) -> Fit:
    """The historical gradient descent of one problem, from a start.

    Args:
        start: first value of the unknowns; pixel scales are held.
        images: the data, a batch of one.
        options: the descent stops after a step that lowers the objective by less than the share
            ``gradient_tolerance`` and moves X by less than that share of a radian, or of the lever
            arm.
    """
    count = images.used
    # Translation in units of the lever arm: one unit moves the target as far as a radian does.
    # Without this, steepest descent zigzags for tens of thousands of steps.
    squares = images.mask * (images.lateral**2 + images.distance**2)
    lever = jnp.sqrt(jnp.sum(squares, axis=1) / count)
    unit = jnp.concatenate([jnp.broadcast_to(lever, (3,)), jnp.ones(3, lever.dtype)])
    rest = jnp.zeros(start.unknowns - 6, lever.dtype)

    def moved(tangent: Float[Array, " 6"]) -> Iterate:
        return start.moved(jnp.concatenate([unit * tangent, rest])[:, None])

    def target(iterate: Iterate) -> Float[Array, "3 batch"]:
        return jnp.sum(images.mask * reconstructed(iterate, images), axis=2) / count

    def cost(tangent: Float[Array, " 6"], _: None) -> Float[Array, ""]:
        iterate = moved(tangent)
        away = reconstructed(iterate, images) - target(iterate)[..., None]
        # The mean square distance from the mean, in units of the lever arm: of order one.
        return jnp.sum(images.mask * away**2) / jnp.sum(count * lever**2)

    solver = SteepestDescent(
        rtol=options.gradient_tolerance,
        atol=options.gradient_tolerance,
        norm=optx.max_norm,
        descent=optx.SteepestDescent(),
        search=optx.BacktrackingArmijo(step_init=1.0),
    )
    steps = STEPS_PER_ITERATION * options.max_iterations
    found = optx.minimise(cost, solver, jnp.zeros(6, lever.dtype), max_steps=steps, throw=False)
    iterate = moved(found.value)
    iterate = eqx.tree_at(lambda it: it.point, iterate, target(iterate))
    return Fit.of(found, iterate, start, InPlane.of(images), images, None, options.trace)
