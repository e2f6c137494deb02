"""A start in closed form, so that nobody supplies a guess.

With r1 and r3 the lateral and axial columns of X's rotation, B_i X p_i = c of Eq. 7 is linear in
(a1, a3, t, c) with a1 = s1 r1 and a3 = s3 r3:

    R_i (u_i a1 + v_i a3 + t) + t_i - c = 0,         3 n equations, 12 unknowns,

whether the pixel scales s are known or not: unknown scales are |a1| and |a3|. The 3x2 matrix
[a1, a3] is projected to orthonormal columns (y = z cross x completes it, so no reflection
can arise), and t and c (and unknown scales) follow from the linear system with the rotation held.

The system is singular where the poses or the points (all on a line in the image) determine less
than 12 unknowns, and useless where few images and much noise drown it, although X's being a
rotation may still determine it. The start is then marked unsound, and
:func:`jaxcal.solvers.conventional.from_scratch` also tries the 24 rotations of the cube.

References: the linear form is the hand-eye (AX = XB family) elimination used for single-point
phantoms, e.g. Melvaer et al. 2012; the projection is Schoenemann's.
"""

from __future__ import annotations

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.model.parameters import Blocks, Parameters
from jaxcal.problem import Problem
from jaxcal.solvers import dense


class Start(eqx.Module):
    """A closed-form start.

    Attributes:
        parameters: the unknowns.
        sound: False where the linear system was degenerate or drowned in noise.
    """

    parameters: Parameters
    sound: Bool[Array, ""]


def closed_form(problem: Problem, blocks: Blocks) -> Start:
    """Solve the linear system for a start.

    Args:
        problem: one problem (no batch axes).
        blocks: the free unknowns; with "scale" among them the pixel scales are found as well.
    """
    rotation, sound = _linear_rotation(problem, "scale" in blocks)
    return Start(start_from_rotation(rotation, problem, blocks), sound)


def _points(problem: Problem) -> Float[Array, "n 2"]:
    points = problem.measurements * problem.spacing
    return points + jnp.stack([jnp.zeros_like(problem.face_offset), problem.face_offset])


def _lstsq(
    matrix: Float[Array, "m p"], vector: Float[Array, " m"]
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Least squares with unit columns, by SVD; also the ratio of the extreme singular values."""
    length = jnp.linalg.norm(matrix, axis=0)
    length = jnp.where(length > 0, length, 1.0)
    columns = matrix.shape[1]
    augmented = jnp.concatenate([matrix / length, vector[:, None]], axis=1)
    reduced = dense.triangularise(augmented, columns)
    found = dense.singular_values(reduced[:, :columns])
    s = found.values
    keep = s > 8 * jnp.finfo(s.dtype).eps * s[-1] * matrix.shape[0]
    inverse = jnp.where(keep, 1 / jnp.where(keep, s, 1.0), 0.0)
    along = found.scaled_left.T @ reduced[:, columns]
    return (found.right @ (inverse**2 * along)) / length, s[0] / s[-1]


def _linear_rotation(
    problem: Problem, estimate_scale: bool
) -> tuple[Float[Array, "3 3"], Bool[Array, ""]]:
    """X's rotation from the 12-unknown linear system, and whether that system was sound."""
    rotations, translations = problem.poses[:, :3, :3], problem.poses[:, :3, 3]
    weight = problem.mask
    points = _points(problem)
    # Deviations from the mean point decouple the rotation's columns from t.
    mean = jnp.sum(weight[:, None] * points, axis=0) / jnp.sum(weight)
    deviation = points - mean
    eye = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype), rotations.shape)
    system = jnp.concatenate(
        [deviation[:, :1, None] * rotations, deviation[:, 1:, None] * rotations, rotations, -eye],
        axis=2,
    )
    # The tracker's origin may be metres away; what matters is where the probes are.
    centre = jnp.sum(weight[:, None] * translations, axis=0) / jnp.sum(weight)
    rows = (weight[:, None, None] * system).reshape(-1, 12)
    rhs = (weight[:, None] * (centre - translations)).reshape(-1)
    solution, ratio = _lstsq(rows, rhs)
    columns = solution[:6].reshape(2, 3).T
    lengths = jnp.linalg.norm(columns, axis=0)
    safe = jnp.where(lengths > 0, lengths, 1.0)
    unit = columns / safe
    cosine = jnp.abs(unit[:, 0] @ unit[:, 1])
    sound = (cosine < 0.5) & jnp.all(lengths > 0)
    sound = sound & (ratio > 1e3 * jnp.finfo(points.dtype).eps)
    if not estimate_scale:
        sound = sound & jnp.all((lengths > 0.5) & (lengths < 2.0))
    # The nearest orthonormal pair to two unit vectors a, b has their sum and their difference
    # (orthogonal to each other) for its diagonals.
    a, b = jnp.where(sound, unit, jnp.eye(3, 2, dtype=unit.dtype)).T
    plus, minus = a + b, a - b
    plus, minus = plus / jnp.linalg.norm(plus), minus / jnp.linalg.norm(minus)
    lateral, axial = (plus + minus) / jnp.sqrt(2.0), (plus - minus) / jnp.sqrt(2.0)
    return jnp.stack([lateral, jnp.cross(axial, lateral), axial], axis=1), sound


def start_from_rotation(
    rotation: Float[Array, "3 3"], problem: Problem, blocks: Blocks
) -> Parameters:
    """t, c and (where free) the scales by linear least squares with X's rotation held."""
    rotations, translations = problem.poses[:, :3, :3], problem.poses[:, :3, 3]
    weight = problem.mask
    points = _points(problem)
    lateral = jnp.einsum("nij,j->ni", rotations, rotation[:, 0])
    axial = jnp.einsum("nij,j->ni", rotations, rotation[:, 2])
    eye = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype), rotations.shape)
    centre = jnp.sum(weight[:, None] * translations, axis=0) / jnp.sum(weight)
    rhs = centre - translations
    if "scale" in blocks:
        offset = problem.face_offset
        known = offset * axial
        parts = [
            (points[:, 0, None] * lateral)[..., None],
            ((points[:, 1] - offset)[:, None] * axial)[..., None],
            rotations,
            -eye,
        ]
        solution, _ = _weighted(jnp.concatenate(parts, axis=2), rhs - known, weight)
        # A negative scale means a rotation far off; its magnitude still is the best guess.
        scale = jnp.maximum(jnp.abs(solution[:2]), jnp.finfo(points.dtype).tiny)
        rest = solution[2:]
    else:
        known = points[:, :1] * lateral + points[:, 1:] * axial
        rest, _ = _weighted(jnp.concatenate([rotations, -eye], axis=2), rhs - known, weight)
        scale = jnp.ones(2, points.dtype)
    return Parameters(rotation, rest[:3], rest[3:] + centre, scale)


def _weighted(
    system: Float[Array, "n 3 p"], rhs: Float[Array, "n 3"], weight: Float[Array, " n"]
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    rows = (weight[:, None, None] * system).reshape(-1, system.shape[2])
    return _lstsq(rows, (weight[:, None] * rhs).reshape(-1))


def cube_rotations() -> np.ndarray:
    """The 24 rotations of the cube: no rotation is farther than 63 degrees from one of them."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return np.array(found)
