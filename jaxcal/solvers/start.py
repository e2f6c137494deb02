"""Where every method begins: a start in closed form, and the conventional fit from it.

(a1, a3) solve Eq. 7's normal equations (:mod:`jaxcal.solvers.closed_form.reduced_batch`). The 3x2
matrix [a1, a3] is projected to orthonormal columns (y = z cross x completes it, so no reflection
can arise), and t and c (and unknown scales) follow from the same sums.

The system is singular where the poses or the points (all on a line in the image) determine fewer
than 12 unknowns, and useless with few images and much noise. The constraint that X has a rotation
may still determine the answer then. The start is called sound if the least pivot is well above
rounding and the columns are far from parallel and (where the scales are known) of length near 1.
Where it is unsound, t and c for each of the 24 rotations of the cube follow from the same sums, and
the best of the fits from these starts is the answer.

References: the linear form is the hand-eye (AX = XB family) elimination used for single-point
phantoms, e.g. Melvaer et al. 2012; the projection is Schoenemann's.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxcal.data.geometry import origin_from_mean, orthonormal_pair
from jaxcal.model.batch import ImagePlanes, Iterate, barrier, choose
from jaxcal.model.observations import InPlane
from jaxcal.model.parameters import Parameters
from jaxcal.model.unknowns import FURTHER, TABLE, Blocks
from jaxcal.runtime.compiler import traced_once
from jaxcal.solvers import dense
from jaxcal.solvers.closed_form.reduced_batch import ReducedBatch
from jaxcal.solvers.closed_form.single import Start
from jaxcal.solvers.levenberg_marquardt import Minimum, minimise

LEAST_PIVOT = 1e-10
"""Least pivot of the normal matrix, scaled to a unit diagonal, with which a start is sound."""


class ConventionalStart(eqx.Module):
    """Conventional fits, and how they began.

    Attributes:
        fit: of Eq. 7; None where only its minimum is known.
        start: in closed form; where that was unsound, the fit itself.
        searched: whether a start had to be searched for.
    """

    fit: Minimum | None
    start: Iterate
    searched: Bool[Array, " batch"]

    @property
    def iterate(self) -> Iterate:
        """The conventional fit, from which most methods start."""
        return self.start if self.fit is None else self.fit.iterate

    @classmethod
    def of(cls, start: Start, blocks: Blocks) -> ConventionalStart:
        """From the closed forms' minima, with a leading axis."""
        places = start.rotation, start.translation, start.point, start.scale
        parameters = jax.vmap(Parameters.of)(*places)
        return cls(None, Iterate.of(parameters, blocks), start.searched)


def closed_form(
    images: ImagePlanes, blocks: Blocks
) -> tuple[Iterate, Bool[Array, " batch"], ReducedBatch]:
    """The start, whether it is sound, and the sums from which it is computed."""
    ridge = 2e-12 + 32 * float(jnp.finfo(images.mask.dtype).eps)
    sums = ReducedBatch.of(images, ridge)
    inverse, _ = dense.inverse_batch_last(sums.matrix)
    columns = barrier(dense.product_batch_last(inverse, sums.rhs))
    left = jnp.stack([sums.squares[k // 3] * inverse[k, k] for k in range(6)])
    smallest_pivot = jnp.minimum(sums.smallest_pivot, 1 / jnp.max(left, axis=0))
    a, b = columns[:3], columns[3:]
    long, deep = jnp.sqrt(jnp.sum(a * a, axis=0)), jnp.sqrt(jnp.sum(b * b, axis=0))
    cosine = jnp.abs(jnp.sum(a * b, axis=0)) / (long * deep)
    # Comparisons with NaN are false, so a start with NaN is not sound.
    sound = (smallest_pivot > LEAST_PIVOT) & (cosine < 0.5)
    for size_of in (long, deep):
        known = (size_of > 0.5) & (size_of < 2.0)
        sound = sound & ((size_of > 0) if "scale" in blocks else known)
    eye = jnp.eye(3, dtype=a.dtype)
    a = jnp.where(sound, a / long, eye[:, :1])
    b = jnp.where(sound, b / deep, eye[:, 1:2])
    lateral, axial = orthonormal_pair(a, b)
    return _with_rotation(sums, lateral, axial, blocks), sound, sums


def _with_rotation(reduced: ReducedBatch, lateral: Array, axial: Array, blocks: Blocks) -> Iterate:
    """X's origin, the target and free scales by linear least squares with X's rotation held.

    Args:
        reduced: the sums over the images.
        lateral: its first column, (3, batch).
        axial: its last column.
        blocks: the free unknowns.
    """
    one = jnp.ones_like(reduced.count)
    scale = jnp.stack([one, one])
    if "scale" in blocks:
        # A negative scale means a rotation far off; its magnitude still is the best guess.
        tiny = jnp.finfo(one.dtype).tiny
        scale = jnp.maximum(jnp.abs(_scales(reduced, lateral, axial)), tiny)
    columns = jnp.concatenate([scale[0] * lateral, scale[1] * axial])
    of_mean, target = reduced.origin_and_target(columns)
    face = reduced.face
    free = {name: [TABLE[name].nominal * one] * TABLE[name].size for name in FURTHER}
    free["scale"] = [*scale]
    values = [value for name in FURTHER if name in blocks for value in free[name]]
    return Iterate(
        jnp.stack([lateral, jnp.cross(axial, lateral, axis=0), axial], axis=1),
        origin_from_mean(of_mean, reduced.mean, lateral, axial, scale, face, face),
        reduced.centre + target,
        jnp.stack(values) if values else jnp.zeros((0, *one.shape), one.dtype),
        blocks,
    )


def _scales(reduced: ReducedBatch, lateral: Array, axial: Array) -> Float[Array, "2 batch"]:
    """The scales that fit best, given two columns of a rotation."""
    # The normal equations of the two scales, of which a1 and a3 are the multiples.
    by_lateral = dense.product_batch_last(reduced.matrix[:, :3], lateral)
    by_axial = dense.product_batch_last(reduced.matrix[3:, 3:], axial)
    first = jnp.sum(lateral * by_lateral[:3], axis=0)
    mixed = jnp.sum(axial * by_lateral[3:], axis=0)
    second = jnp.sum(axial * by_axial, axis=0)
    ridge = 16 * jnp.finfo(first.dtype).eps
    held = jnp.where(reduced.squares > 0, ridge * reduced.squares, 1.0)
    first, second = first + held[0], second + held[1]
    right = jnp.sum(lateral * reduced.rhs[:3], axis=0)
    deep = jnp.sum(axial * reduced.rhs[3:], axis=0)
    determinant = first * second - mixed * mixed
    return jnp.stack([second * right - mixed * deep, first * deep - mixed * right]) / determinant


def conventional(
    images: ImagePlanes,
    blocks: Blocks,
    *,
    max_steps: int = 100,
    undamped: bool = False,
    trace: int = 0,
    fitted: bool = True,
) -> ConventionalStart:
    """Conventional fits from the closed-form start, or the best of many where it is unsound.

    Args:
        images: the data.
        blocks: the free unknowns.
        max_steps: most passes of each fit.
        undamped: Gauss-Newton instead of Levenberg-Marquardt.
        trace: how many values of the objective to keep.
        fitted: refine sound starts too; otherwise they are returned as they are.
    """
    start, sound, sums = closed_form(images, blocks)
    cubes = jnp.asarray(cube_rotations(), images.mask.dtype)
    damping = 0.0 if undamped else 1e-3
    fit_from = partial(minimise, damping=damping, max_steps=max_steps, trace=trace, together=True)
    observation = InPlane.of(images)
    fit_from, empty = traced_once(fit_from, start, observation, images)

    # The loop's first round starts in closed form. It has further rounds only where some problem's
    # start was unsound, so the search costs nothing where it is not needed.
    def one_round(state: tuple) -> tuple:
        index, best = state
        cube = cubes[jnp.maximum(index - 1, 0)]
        cube = jnp.broadcast_to(cube[..., None], (3, 3, images.batch_size))
        first = choose(index == 0, start, _with_rotation(sums, cube[:, 0], cube[:, 2], blocks))
        fit = fit_from(barrier(first), observation, images)
        lower = (fit.cost < best.cost) | ~jnp.isfinite(best.cost)
        better = (index == 0) | (lower & ~sound)
        return index + 1, choose(better, fit, best)

    def unfinished(state: tuple) -> Bool[Array, ""]:
        once = fitted & (state[0] == 0)
        return once | (jnp.any(~sound) & (state[0] <= len(cubes)))

    _, fit = jax.lax.while_loop(unfinished, one_round, (jnp.zeros((), jnp.int32), empty))
    if not fitted:
        # A sound problem keeps its start, even if others needed the search.
        fit = replace(fit, iterate=choose(sound, start, fit.iterate))
    return ConventionalStart(fit, choose(sound, start, fit.iterate), jnp.logical_not(sound))


def cube_rotations() -> np.ndarray:
    """The cube's 24 rotations: no rotation is over 63 degrees from the nearest of them."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return np.array(found)
