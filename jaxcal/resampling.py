"""How a calibration fares on other images: cross-validation, influence and bootstrap.

All three solve many variants of one problem as a batch, through one compiled program:
cross-validation leaves out a fold of images at a time and looks at the images left out; influence
leaves out one image at a time and looks at what that does to X; the bootstrap draws as many images
as there are, with replacement, and looks at how far X scatters.

References: Stone 1974 (cross-validation); Efron and Tibshirani 1993, chapters 6 and 11.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcal.calibration import Calibration
from jaxcal.errors import InputError
from jaxcal.geometry import inverse_transform_points, transform_points
from jaxcal.options import check_values
from jaxcal.problem import Channels, Problem
from jaxcal.recording import MINIMUM_IMAGES, Recording
from jaxcal.solve import calibrate, calibrate_batch
from jaxcal.solvers import dense

DEFAULT_RESAMPLES = 200
"""Enough for an SD to within five per cent of itself."""


class CrossValidation(eqx.Module):
    """Images judged by calibrations that have not seen them.

    Attributes:
        fold: which fold an image was left out with; -1 for images not used.
        residual: of every image by the calibration without its fold: lateral error, range error and
            elevational offset of the target, mm, in the image's frame; NaN for images not used and
            where that calibration did not converge.
        rms: root mean square of those, each component by itself, mm.
        precision: Eq. 8 on the images left out: the spread of B_i X p_i, mm, each with the X that
            did not see image i and p_i in the plane. It holds the images' own offsets, too.
        converged: (folds,) whether the calibration without a fold converged.
    """

    fold: Int[Array, " n"]
    residual: Float[Array, "n 3"]
    rms: Float[Array, 3]
    precision: Float[Array, ""]
    converged: Bool[Array, " folds"]


class Influence(eqx.Module):
    """What leaving out an image does to X; NaN for images not used or if it then fails.

    Attributes:
        displacement: largest move of the image's corners and centre (see :func:`field_points`), mm.
        tangent: from X with all images to X without one: v (mm) and omega (rad) of X Exp([v,
            omega]).
        distance: the same in SDs of X: the square root of tangent' covariance^-1 tangent / 6.
    """

    displacement: Float[Array, " n"]
    tangent: Float[Array, "n 6"]
    distance: Float[Array, " n"]


class Bootstrap(eqx.Module):
    """X over resampled sets of images; resamples that did not converge are left out of the figures.

    Attributes:
        image_to_probe: X of every resample.
        converged: which of them converged.
        sd: SD of X over those: v (mm) and omega (rad) along and about the image's axes.
        field_points: [lateral, axial] where reproducibility is looked at, mm.
        reproducibility: mean distance from the mean there, mm.
    """

    image_to_probe: Float[Array, "resamples 4 4"]
    converged: Bool[Array, " resamples"]
    sd: Float[Array, 6]
    field_points: Float[Array, "points 2"]
    reproducibility: Float[Array, " points"]


def cross_validate(
    problem: Problem | Recording, folds: int | None = None, *, seed: int = 0, **arguments: Any
) -> CrossValidation:
    """Leave out a fold of images at a time and judge them by what the others say.

    Args:
        problem: one problem, with concrete values.
        folds: number of folds, the images shared out among them at random; by default one an image
            (leave-one-out).
        seed: of the shares.
        arguments: as for :func:`jaxcal.calibrate`.

    Raises:
        InputError: fewer than two folds, more than there are used images, or folds so large that
            fewer than 4 images remain.
    """
    problem = _one(problem)
    used = np.flatnonzero(np.asarray(problem.mask) > 0)
    count = len(used) if folds is None else folds
    if not 2 <= count <= len(used):
        raise InputError(f"folds must be between 2 and the {len(used)} used images, not {count}")
    if len(used) - -(-len(used) // count) < MINIMUM_IMAGES:
        raise InputError(
            f"{count} folds of {len(used)} images leave fewer than {MINIMUM_IMAGES} to calibrate on"
        )
    order = used if folds is None else np.random.default_rng(seed).permutation(used)
    fold = np.full(problem.images, -1)
    fold[order] = np.arange(len(used)) % count
    result = _without(problem, fold[None, :] == np.arange(count)[:, None], arguments)
    return _judge_left_out(problem, jnp.asarray(fold), result)


def influence(problem: Problem | Recording, **arguments: Any) -> Influence:
    """Leave out one image at a time and see where X goes: which images carry the answer.

    Args:
        problem: one problem, with concrete values.
        arguments: as for :func:`jaxcal.calibrate`.

    Raises:
        InputError: with four used images or fewer none can be left out.
    """
    problem = _one(problem)
    if int(np.sum(np.asarray(problem.mask) > 0)) <= MINIMUM_IMAGES:
        raise InputError(f"leaving out an image takes more than {MINIMUM_IMAGES} used images")
    whole = calibrate(problem, **arguments)
    result = _without(problem, np.eye(problem.images, dtype=bool), arguments)
    return _compare(problem, whole, result)


def bootstrap(
    problem: Problem | Recording,
    resamples: int = DEFAULT_RESAMPLES,
    *,
    seed: int = 0,
    **arguments: Any,
) -> Bootstrap:
    """Calibrate sets of as many images, drawn with replacement from those used.

    Args:
        problem: one problem, with concrete values.
        resamples: how many sets.
        seed: of the draws; set k is the same whatever the number of sets.
        arguments: as for :func:`jaxcal.calibrate`.

    Raises:
        InputError: fewer than two resamples.
    """
    problem = _one(problem)
    if resamples < 2:
        raise InputError(f"resamples must be at least 2, not {resamples}")
    used = np.flatnonzero(np.asarray(problem.mask) > 0)
    rows = np.stack(
        [np.random.default_rng([seed, k]).choice(used, len(used)) for k in range(resamples)]
    )
    result = calibrate_batch(_rows(problem, jnp.asarray(rows)), **arguments)
    whole = calibrate(problem, **arguments)
    return _scatter(problem, whole, result)


def field_points(result: Calibration, problem: Problem) -> Float[Array, "5 2"]:
    """Corners and centre of the rectangle that the target was seen in: [lateral, axial], mm."""
    points = _points_mm(result, problem)
    used = problem.mask[:, None] > 0
    low = jnp.min(jnp.where(used, points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(used, points, -jnp.inf), axis=0)
    corners = [[low[0], low[1]], [high[0], low[1]], [low[0], high[1]], [high[0], high[1]]]
    return jnp.concatenate([jnp.asarray(corners), 0.5 * (low + high)[None]])


def _one(problem: Problem | Recording) -> Problem:
    if isinstance(problem, Recording):
        problem = Problem.from_recording(problem)
    if problem.batch_shape:
        raise InputError("resampling takes one problem at a time, not a batch")
    check_values(problem)
    return problem


def _without(problem: Problem, left_out: np.ndarray, arguments: dict[str, Any]) -> Calibration:
    """A batch of calibrations, each without the images that its row of ``left_out`` marks."""
    count = len(left_out)
    batch = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), problem)
    kept = batch.mask * jnp.asarray(~left_out, problem.mask.dtype)
    return calibrate_batch(replace(batch, mask=kept), **arguments)


def _rows(problem: Problem, rows: Int[Array, "b n"]) -> Problem:
    """A batch of problems of the given images."""
    count = len(rows)

    def shared(leaf: Array | None) -> Array | None:
        return None if leaf is None else jnp.broadcast_to(leaf, (count, *leaf.shape))

    def taken(leaf: Array | None) -> Array | None:
        return None if leaf is None else leaf[rows]

    channels = problem.channels
    if channels is not None:
        channels = Channels(
            channels.distances[rows], channels.heard[rows],
            jnp.broadcast_to(channels.elements, (count, *channels.elements.shape)),
        )  # fmt: skip
    return replace(
        problem,
        **{name: taken(getattr(problem, name))
           for name in ("poses", "measurements", "mask", "covariance", "max_elevation")},
        **{name: shared(getattr(problem, name))
           for name in ("spacing", "face_offset", "sound_speed", "delay")},
        channels=channels,
    )  # fmt: skip


def _points_mm(result: Calibration, problem: Problem) -> Float[Array, "*batch n 2"]:
    """[lateral, range] of every image, mm, with the pixel scale of each calibration."""
    if result.scale_mm_per_px is None:
        return problem.measurements
    points = problem.measurements * result.scale_mm_per_px[..., None, :]
    return points.at[..., 1].add(problem.face_offset)


def _in_plane(points: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
    return jnp.stack([points[:, 0], jnp.zeros_like(points[:, 0]), points[:, 1]], axis=1)


@jax.jit
def _judge_left_out(
    problem: Problem, fold: Int[Array, " n"], result: Calibration
) -> CrossValidation:
    used = fold >= 0
    row = jnp.maximum(fold, 0)
    own = jnp.arange(problem.images)
    matrix = result.image_to_probe[row]
    points = _points_mm(result, problem)
    points = jnp.broadcast_to(points, (result.mask.shape[0], *points.shape[-2:]))[row, own]
    in_probe = inverse_transform_points(problem.poses, result.point[row])
    q = inverse_transform_points(matrix, in_probe)
    residual = jnp.stack(
        [q[:, 0] - points[:, 0], jnp.hypot(q[:, 1], q[:, 2]) - points[:, 1], q[:, 1]], axis=1
    )
    good = (used & result.converged[row])[:, None]
    count = jnp.sum(good)
    cloud = transform_points(problem.poses, transform_points(matrix, _in_plane(points)))
    mean = jnp.sum(jnp.where(good, cloud, 0.0), axis=0) / count
    spread = jnp.sum(jnp.where(good, (cloud - mean) ** 2, 0.0)) / (count - 1)
    mean_square = jnp.sum(jnp.where(good, residual**2, 0.0), axis=0) / count
    return CrossValidation(
        fold=fold,
        residual=jnp.where(good, residual, jnp.nan),
        rms=jnp.sqrt(mean_square),
        precision=jnp.sqrt(spread),
        converged=result.converged,
    )


@jax.jit
def _compare(problem: Problem, whole: Calibration, result: Calibration) -> Influence:
    tangent = _tangents(whole.image_to_probe, result.image_to_probe)
    points = _in_plane(field_points(whole, problem))
    before = transform_points(whole.image_to_probe, points)
    after = transform_points(result.image_to_probe[:, None], points[None])
    moved = jnp.max(jnp.linalg.norm(after - before, axis=-1), axis=1)
    scale = jnp.sqrt(jnp.diagonal(whole.covariance))
    correlation = whole.covariance / (scale[:, None] * scale[None, :])
    good = (problem.mask > 0) & result.converged
    return Influence(
        displacement=jnp.where(good, moved, jnp.nan),
        tangent=jnp.where(good[:, None], tangent, jnp.nan),
        distance=jnp.where(good, _mahalanobis(tangent / scale, correlation), jnp.nan),
    )


def _mahalanobis(
    standardised: Float[Array, "b 6"], correlation: Float[Array, "6 6"]
) -> Float[Array, " b"]:
    solved = dense.solve_positive(correlation, standardised.T)
    return jnp.sqrt(jnp.sum(standardised.T * solved, axis=0) / 6)


@jax.jit
def _scatter(problem: Problem, whole: Calibration, result: Calibration) -> Bootstrap:
    good = result.converged
    count = jnp.sum(good)
    tangent = jnp.where(good[:, None], _tangents(whole.image_to_probe, result.image_to_probe), 0.0)
    mean = jnp.sum(tangent, axis=0) / count
    square = jnp.sum(jnp.where(good[:, None], (tangent - mean) ** 2, 0.0), axis=0)
    points = field_points(whole, problem)
    images = transform_points(result.image_to_probe[:, None], _in_plane(points)[None])
    images = jnp.where(good[:, None, None], images, 0.0)
    centre = jnp.sum(images, axis=0) / count
    away = jnp.linalg.norm(images - centre, axis=-1)
    return Bootstrap(
        image_to_probe=result.image_to_probe,
        converged=good,
        sd=jnp.sqrt(square / (count - 1)),
        field_points=points,
        reproducibility=jnp.sum(jnp.where(good[:, None], away, 0.0), axis=0) / count,
    )


def _tangents(reference: Float[Array, "4 4"], moved: Float[Array, "b 4 4"]) -> Float[Array, "b 6"]:
    """[v, omega] with moved = reference Exp([v, omega]), Exp's translation taken as v."""
    turn = reference[:3, :3]
    relative = jnp.einsum("ji,bjk->bik", turn, moved[:, :3, :3])
    omega = jax.vmap(lambda matrix: jaxlie.SO3.from_matrix(matrix).log())(relative)
    shift = (moved[:, :3, 3] - reference[:3, 3]) @ turn
    return jnp.concatenate([shift, omega], axis=1)
