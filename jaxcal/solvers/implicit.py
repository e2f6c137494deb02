"""Derivatives of an optimum with respect to the data, without unrolling the solver.

At a solution the stationarity conditions F(unknowns, data) = 0 hold, so by the implicit function
theorem d unknowns = -(dF/d unknowns)^-1 dF/d data. Both derivatives of F come from the pass over
the images that the solvers take (:mod:`jaxcal.solvers.normal_equations`): the first is its exact
curvature, the second the derivative of its gradient. The pass eliminates the offset of every image;
an offset at its bound moves with the bound. For the self-tuned solve F also includes the conditions
of the SDs (:func:`jaxcal.solvers.reml.update_at`).

:func:`implicit_tangent` and :func:`self_tuned_tangent` return a step of the unknowns whose value is
zero and whose tangent is how the solution moves with the data; :func:`minimum` returns the cost
with its tangent. They are ``jax.custom_jvp`` functions whose rules call the functions themselves,
at the solution as it moves with the data, so they work in forward and reverse mode, to any order,
under vmap and jit. They are valid where the solution is an isolated minimum with a fixed active
set; ``Calibration.differentiable`` says whether that is so.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxcal import InputError
from jaxcal.model.batch import ImagePlanes, Iterate
from jaxcal.model.observations import MediumPrior, Observation
from jaxcal.runtime.jax_modes import in_standard_promotion
from jaxcal.solvers import dense, reml
from jaxcal.solvers.normal_equations import accumulate

STILL_MM, STILL_RAD = 1e-6, 1e-8
"""Largest tolerances with which an alternation stops near enough to the minimum to have
derivatives."""


@jax.custom_jvp
def implicit_tangent(
    iterate: Iterate,
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None = None,
) -> Float[Array, "p batch"]:
    """How the minimiser of an objective moves with the data and with given numbers.

    Args:
        iterate: the solution (not differentiated).
        observation: the objective.
        images: the data.
        medium: prior of further unknowns, or None.

    Returns:
        The step of the unknowns about the solution; zero in value.
    """
    del observation, images, medium
    return _no_step(iterate)


@implicit_tangent.defjvp
@in_standard_promotion
def _implicit_jvp(primals: tuple, tangents: tuple) -> tuple:
    iterate, observation, images, medium = primals
    step = implicit_tangent(*primals)
    # Higher derivatives need all this where the solution is, which moves with the data as well.
    here = iterate.moved(step)

    def gradient(
        observation: Observation, images: ImagePlanes, medium: MediumPrior | None
    ) -> Array:
        return accumulate(here, observation, images, None, medium).gradient

    _, moved = jax.jvp(gradient, primals[1:], tangents[1:])
    exact = jnp.ones_like(images.mask[:, 0])
    matrix = accumulate(here, observation, images, exact, medium).stacked()
    inverse, _ = dense.inverse_batch_last(matrix)
    onward = -dense.product_batch_last(inverse, moved)
    # A step from there, as a change of the step from the iterate.
    _, change = jax.jvp(
        lambda further: iterate.step_to(here.moved(further)), (jnp.zeros_like(step),), (onward,)
    )
    return step, change


@jax.custom_jvp
def self_tuned_tangent(
    iterate: Iterate,
    sigma: Float[Array, "k batch"],
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None,
) -> tuple[Float[Array, "p batch"], Float[Array, "k batch"]]:
    """How a self-tuned solution and its SDs move with the data.

    Args:
        iterate: the solution (not differentiated).
        sigma: its SDs, mm (not differentiated).
        observation: the objective; its SDs are held where too few images determine them.
        images: the data.
        medium: prior of further unknowns, or None.

    Returns:
        The step of the unknowns about the solution (zero in value), and the SDs.
    """
    del observation, images, medium
    return _no_step(iterate), sigma


@self_tuned_tangent.defjvp
@in_standard_promotion
def _self_tuned_jvp(primals: tuple, tangents: tuple) -> tuple:
    iterate, _, *data = primals
    count = iterate.unknowns
    # Higher derivatives need all this where the solution is, which moves with the data as well.
    attached, sigma = self_tuned_tangent(*primals)

    def conditions(unknowns: Array, *data) -> Array:
        moved, log_sigma = iterate.moved(unknowns[:count]), unknowns[count:]
        normal, updated = reml.update_at(moved, jnp.exp(log_sigma), *data)
        return jnp.concatenate([normal.gradient, log_sigma - jnp.log(updated)])

    here = jnp.concatenate([attached, jnp.log(sigma)])

    def along(direction: Array) -> Array:
        moving = jnp.broadcast_to(direction[:, None], here.shape)
        return jax.jvp(lambda unknowns: conditions(unknowns, *data), (here,), (moving,))[1]

    # Axes: condition, unknown, batch.
    matrix = jnp.moveaxis(jax.vmap(along)(jnp.eye(len(here), dtype=here.dtype)), 0, 1)
    _, moved = jax.jvp(lambda *data: conditions(here, *data), tuple(data), tuple(tangents[2:]))
    # The gradients' rows scale with 1/sigma^2, those of the SDs have no unit: balance the rows.
    scale = 1 / jnp.max(jnp.abs(matrix), axis=1)
    inverse = jax.vmap(dense.inverse, in_axes=-1, out_axes=-1)(scale[:, None] * matrix)
    step = -dense.product_batch_last(inverse, scale * moved)
    return (attached, sigma), (step[:count], sigma * step[count:])


@jax.custom_jvp
def minimum(
    cost: Float[Array, " batch"],
    iterate: Iterate,
    observation: Observation,
    images: ImagePlanes,
    medium: MediumPrior | None,
) -> Float[Array, " batch"]:
    """How the value of an objective at its minimiser moves with the data.

    Args:
        cost: the value that the solver found (not differentiated).
        iterate: the minimiser as a function of the data.
        observation: the objective, with its SDs as functions of the data.
        images: the data.
        medium: prior of further unknowns, or None.
    """
    del iterate, observation, images, medium
    return cost


@minimum.defjvp
@in_standard_promotion
def _minimum_jvp(primals: tuple, tangents: tuple) -> tuple:
    def value(
        iterate: Iterate, observation: Observation, images: ImagePlanes, medium: MediumPrior | None
    ) -> Array:
        return accumulate(iterate, observation, images, None, medium).cost

    return minimum(*primals), jax.jvp(value, primals[1:], tangents[1:])[1]


@jax.custom_jvp
def undefined_tangent(
    iterate: Iterate, observation: Observation, images: ImagePlanes
) -> Float[Array, "p batch"]:
    """:func:`implicit_tangent` of a method that stopped before the minimum, where it is undefined.

    Raises:
        InputError: when it is differentiated, with what to do.
    """
    del observation, images
    return _no_step(iterate)


@undefined_tangent.defjvp
def _undefined_jvp(primals: tuple, tangents: tuple) -> tuple:
    raise InputError(
        "the alternation stops before the minimum, where its answer has no derivative: "
        'differentiate method="joint" with prior="bounded", which has the same objective, or the '
        f"alternation with tolerance_mm <= {STILL_MM:g} and tolerance_rad <= {STILL_RAD:g}; "
        "Options(differentiate=False) makes the answer a constant"
    )


def _no_step(iterate: Iterate) -> Float[Array, "p batch"]:
    # These zeros must depend on a batched array: where a custom rule's tangent is batched and its
    # value is not, JAX (0.10.2) confuses the two when it linearises a scan over batches.
    zero = jnp.where(jnp.isfinite(iterate.translation[0]), 0.0, 0.0).astype(iterate.point.dtype)
    return jnp.broadcast_to(zero, (iterate.unknowns, *zero.shape))
