"""Proposals for a consensus: closed-form solutions of many small subsets of the images at once.

Every proposal solves the start's linear system (:mod:`jaxcal.solvers.start`) for a few images. Each
image's moments are formed once, and a subset's system is the sum of its images' moments.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxcal.data.geometry import origin_from_mean, orthonormal_pair
from jaxcal.data.problem import Problem
from jaxcal.model.parameters import Parameters
from jaxcal.model.residuals import measured_points
from jaxcal.model.unknowns import Blocks
from jaxcal.solvers import dense

MOST_PROPOSALS, FEWEST_PROPOSALS = 512, 256
"""Bounds on the number of subsets. If a third of a dozen images are outliers, one subset in 33 is
clean."""
SUBSET = 6
"""Images in a proposal's subset: four determine the linear system, two more steady it."""
SEED = 20261121


def subset_weights(used: Float[Array, " n"], size: int) -> Float[Array, "k n"]:
    """Weights (0 or 1) of the proposals' subsets, each of ``size`` used images.

    The draws are constants of the program: the same problem gives the same answer everywhere.
    """
    # With fewer images, fewer subsets are clean.
    count = int(np.clip(12_800 // used.shape[0], FEWEST_PROPOSALS, MOST_PROPOSALS))
    draws = np.random.default_rng(SEED).random((count, used.shape[0]))
    order = jnp.where(used > 0, jnp.asarray(draws, used.dtype), 2.0)

    def pick(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        order, chosen = state
        here = order == jnp.min(order, axis=1, keepdims=True)
        return jnp.where(here, 3.0, order), jnp.where(here, 1.0, chosen)

    chosen = jax.lax.fori_loop(0, size, pick, (order, jnp.zeros_like(order)))[1]
    return chosen * used


def subset_systems(
    rows: Float[Array, "n 3 p"], used: Float[Array, " n"], subsets: Float[Array, "k n"]
) -> Float[Array, "k p p"]:
    """Normal equations of every subset, as the sums of its images' moments.

    Args:
        rows: of every image's linear equations, the right-hand side as the last column.
        used: 1 for used images; the rows of the others may hold anything.
        subsets: weights of the images.
    """
    rows = jnp.where(used[:, None, None] > 0, rows, 0.0)
    moments = jnp.einsum("nia,nib->nab", rows, rows).reshape(len(used), -1)
    return (subsets @ moments).reshape(-1, rows.shape[2], rows.shape[2])


def linear_proposals(
    problem: Problem, subsets: Float[Array, "k n"], *, blocks: Blocks
) -> Parameters:
    """Solve the start's linear system (see :mod:`jaxcal.solvers.start`) for every subset at once.

    Args:
        problem: one problem.
        subsets: (k, n) weights.
        blocks: the unknowns; pixel scales or a sound speed among them are found as well.

    Returns:
        Parameters with a leading axis k.
    """
    rotations, translations = problem.poses[:, :3, :3], problem.poses[:, :3, 3]
    used = problem.mask
    total = jnp.sum(used)
    points = measured_points(nominal(problem), problem)
    points = jnp.where(used[:, None] > 0, points, 0.0)
    mean = jnp.sum(used[:, None] * points, axis=0) / total
    length = jnp.sqrt(jnp.sum(used[:, None] * (points - mean) ** 2) / total)
    length = jnp.where(length > 0, length, 1.0)
    deviation = (points - mean) / length
    centre = jnp.sum(used[:, None] * translations, axis=0) / total
    eye = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype), rotations.shape)
    rhs = (centre - translations) / length
    rows = jnp.concatenate(
        [
            deviation[:, :1, None] * rotations,
            deviation[:, 1:, None] * rotations,
            rotations,
            -eye,
            rhs[..., None],
        ],
        axis=2,
    )
    # In units of the points' spread all 12 unknowns and all moments are of order one.
    systems = subset_systems(rows, used, subsets)

    def solve(system: Float[Array, "13 13"]) -> Parameters:
        ridge = 1e3 * jnp.finfo(system.dtype).eps * jnp.trace(system) / 13
        matrix = system[:12, :12] + ridge * jnp.eye(12, dtype=system.dtype)
        # Two columns that nothing keeps orthonormal; then origin and target with a rotation held.
        columns = dense.solve_positive(matrix, system[:12, 12:])[:6, 0]
        first, third = columns[:3], columns[3:]
        sizes = jnp.stack([jnp.sqrt(jnp.sum(first**2)), jnp.sqrt(jnp.sum(third**2))])
        lateral, axial = orthonormal_pair(first / sizes[0], third / sizes[1])
        scale, speed = jnp.ones_like(sizes), jnp.ones_like(sizes[0])
        if "scale" in blocks:
            scale = sizes
        if "sound-speed" in blocks:
            speed = sizes[1]
            scale = scale.at[1].set(speed)
        known = jnp.concatenate([scale[0] * lateral, scale[1] * axial])
        rest = dense.solve_positive(
            matrix[6:, 6:], (system[6:12, 12] - system[6:12, :6] @ known)[:, None]
        )[:, 0]
        face = problem.face_offset
        of_mean = length * rest[:3]
        translation = origin_from_mean(of_mean, mean, lateral, axial, scale, face, speed * face)
        rotation = jnp.stack([lateral, jnp.cross(axial, lateral), axial], axis=1)
        point, pixel = length * rest[3:] + centre, scale.at[1].divide(speed)
        return replace(Parameters.of(rotation, translation, point, pixel), sound_speed=speed)

    return jax.vmap(solve)(systems)


def nominal(problem: Problem) -> Parameters:
    """X the identity, the target at the origin, and the given scales."""
    zero = jnp.zeros(3, problem.mask.dtype)
    return Parameters.of(jnp.eye(3, dtype=zero.dtype), zero, zero)
