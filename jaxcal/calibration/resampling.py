"""Cross-validation and bootstrap: one problem is solved many times, as one batch.

Cross-validation masks images out and calibrates from the rest; the precision of Eq. 8 is then that
of images that the calibration has not used. Leaving out one image at a time also shows how much
each image moves the answer (its influence). The bootstrap draws the images anew with replacement
and shows how the answer scatters (reproducibility).

Both run :func:`jaxcal.calibrate_batch` on masks or rows of the same problem: pure functions of
arrays (and a key), which work under jit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from jaxcal import InputError
from jaxcal.calibration.calibrate import (
    Request,
    calibrate,
    calibrate_batch,
    prepare,
    unknown_names,
)
from jaxcal.calibration.dependence import independent
from jaxcal.data.problem import Problem, as_problem
from jaxcal.data.recording import MINIMUM_IMAGES, Recording
from jaxcal.diagnostics.image_errors import noise_covariance
from jaxcal.diagnostics.intervals import range_of_row_zero
from jaxcal.diagnostics.metrics import calibration_reproducibility
from jaxcal.model.observations import factor_of
from jaxcal.model.parameters import Parameters
from jaxcal.model.residuals import measured_points, measurement_residual
from jaxcal.model.thresholds import MAD
from jaxcal.model.unknowns import split_further
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.arrays import each_image, is_traced
from jaxcal.runtime.given_values import LARGEST_SEED, check_key, check_made, whole_number
from jaxcal.runtime.jax_modes import in_own_modes
from jaxcal.runtime.messages import shown
from jaxcal.solvers import dense
from jaxcal.solvers.plan import SolvePlan

LARGEST_RESAMPLES = 100_000
"""Most resamples of a bootstrap."""
MOST_TOGETHER = 200_000
"""Most images, over all calibrations, that are solved in one batch: about 1 GiB."""


class CrossValidation(eqx.Module):
    """Errors of images under calibrations that did not use them.

    Attributes:
        residual: (n, 3) lateral, range and elevational errors of each held-out image, mm; 0 where
            not used.
        cloud: (n, 3) the target as reconstructed from each held-out image (in the plane), less the
            target of the calibration that held the image out, mm.
        precision: norm of the SD of ``cloud`` (Eq. 8 for images that were not used), mm.
        rms: root mean square length of ``cloud``, mm.
        log_density: (n,) log predictive density of each image's three errors under the noise model
            of the calibration that held the image out: Gaussian, offsets about their mean, with the
            tracker's errors and, where that calibration weighs by them, the images' own
            covariances; 0 where not used.
        moved: (n, 6) [v, omega] by which leaving the image (its fold) out moves X, right
            perturbation, mm and rad.
        influence: (n,) length of ``moved`` in SDs of X: sqrt(moved' Cov^-1 moved / 6); NaN without
            a covariance.
        image_to_probe: (folds, 4, 4) X of each fold.
        converged: (folds,) whether the solve of each fold converged.
        fold_cost: (n,) minimised objective of the calibration that held the image out.
        mask: (n,) 1 for used images.
        image_moved: (n,) how far leaving the image (its fold) out moves ``image_points``, as a root
            mean square over these points, estimated pixel sizes, sound speed and delay included,
            mm.
        image_points: (m, 2) [lateral, axial] of those points, mm: corners and middle of the box
            that the measured points fill.
    """

    residual: Float[Array, "n 3"]
    cloud: Float[Array, "n 3"]
    precision: Float[Array, ""]
    rms: Float[Array, ""]
    log_density: Float[Array, " n"]
    moved: Float[Array, "n 6"]
    influence: Float[Array, " n"]
    image_to_probe: Float[Array, "folds 4 4"]
    converged: Float[Array, " folds"]
    fold_cost: Float[Array, " n"]
    mask: Float[Array, " n"]
    image_moved: Float[Array, " n"]
    image_points: Float[Array, "m 2"]


class Bootstrap(eqx.Module):
    """How the answer scatters when the images are drawn anew.

    Attributes:
        image_to_probe: (k, 4, 4) X of each resample.
        converged: (k,) 1 where the resample's solve converged; the following use only those.
        spread: (6,) SD of X about the X of all images, [v, omega], mm and rad. It is computed from
            medians, so a few resamples with too few different images do not spoil it.
        reproducibility: (m,) mean distance of an image point from its mean over the resamples, mm,
            estimated pixel sizes, sound speed and delay included.
        image_points: (m, 2) [lateral, axial] of those points, mm: corners and middle of the box
            that the measured points fill.
    """

    image_to_probe: Float[Array, "k 4 4"]
    converged: Float[Array, " k"]
    spread: Float[Array, 6]
    reproducibility: Float[Array, " m"]
    image_points: Float[Array, "m 2"]


@in_own_modes
def cross_validate(
    problem: Problem | Recording,
    *,
    folds: int | None = None,
    result: Calibration | None = None,
    **arguments: Any,
) -> CrossValidation:
    """Hold out each image (or fold of images) in turn, and calibrate from the others.

    Args:
        problem: one problem or a recording.
        folds: image i belongs to fold i mod folds; by default every image is a fold of its own.
        result: the calibration of all images, if it exists already: by the same method, with the
            same prior, data and unknowns. Images that it left out as outliers are neither used nor
            held out.
        arguments: as for :func:`jaxcal.calibrate`.

    Raises:
        InputError: too few images, folds that are not from 2 to the number of images, options that
            contradict each other, or a result by another method than they ask for.
    """
    problem, plan, arguments = _one_problem(problem, arguments, "jaxcal.cross_validate")
    count = problem.images
    folds = count if folds is None else whole_number("folds", folds, 2, count)
    result = _full_calibration(problem, result, plan, arguments)
    problem = replace(problem, mask=jnp.asarray(result.mask, problem.mask.dtype))
    fold = np.arange(count) % folds
    rest = jnp.asarray(fold[None, :] != np.arange(folds)[:, None], problem.mask.dtype)
    _check_remaining(problem.mask, rest)

    def without(some: Int[Array, " k"]) -> Problem:
        many = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(some), *leaf.shape)), problem)
        return replace(many, mask=problem.mask * rest[some])

    fits = _in_batches(without, folds, count, arguments)
    return _compared(problem, result, fits, fold)


@jax.jit
def _compared(
    problem: Problem, result: Calibration, fits: Calibration, fold: Array
) -> CrossValidation:
    """The calibrations of the folds against that of all images, and against the held-out images.

    As one program: compiled operation by operation it takes several times as long.
    """
    # Arrays of all images for each image would need memory by the square of their number.
    few = replace(
        fits,
        mask=fits.mask[:, :1],
        elevation=fits.elevation[:, :1],
        problem=None,
        linearisation=replace(fits.linearisation, average_elevation_sd=None),
    )
    held = jax.tree.map(lambda leaf: leaf[fold], few)
    errors, cloud = _held_out_errors(held, problem)
    mask = problem.mask
    used = jnp.sum(mask)
    mean = jnp.sum(mask[:, None] * cloud, axis=0) / used
    moved = jax.vmap(relative_twist, (None, 0))(
        jnp.asarray(result.image_to_probe), held.image_to_probe
    )
    moved = mask[:, None] * moved
    points = _box_points(problem, result)
    whole = jnp.asarray(result.image_to_probe)
    image_moved = _rms_distance(_from_full_image(held, result, problem), whole, points) * mask
    return CrossValidation(
        residual=errors,
        cloud=cloud,
        precision=jnp.sqrt(jnp.sum(mask[:, None] * (cloud - mean) ** 2) / (used - 1)),
        rms=jnp.sqrt(jnp.sum(cloud**2) / used),
        log_density=mask * _log_density(fits, problem, fold, errors),
        moved=moved,
        influence=_length_in_sds(moved, jnp.asarray(result.covariance)),
        image_to_probe=jnp.asarray(fits.image_to_probe),
        converged=jnp.asarray(fits.converged, mask.dtype),
        fold_cost=held.cost,
        mask=mask,
        image_moved=image_moved,
        image_points=points,
    )


@in_own_modes
def bootstrap(
    problem: Problem | Recording,
    resamples: int = 200,
    key: Key[Array, ""] | int = 0,
    *,
    result: Calibration | None = None,
    **arguments: Any,
) -> Bootstrap:
    """Calibrate samples of the used images that are drawn with replacement.

    Args:
        problem: one problem or a recording.
        resamples: how many draws.
        key: of the draws, or a seed; draw k is fold_in(key, k).
        result: the calibration of all images, if it exists already: by the same method, with the
            same prior, data and unknowns. Images that it left out as outliers are not drawn.
        arguments: as for :func:`jaxcal.calibrate`.

    Raises:
        InputError: fewer than 2 resamples, options that contradict each other, or a result by
            another method than they ask for.
    """
    problem, plan, arguments = _one_problem(problem, arguments, "jaxcal.bootstrap")
    resamples = whole_number("resamples", resamples, 2, LARGEST_RESAMPLES)
    if isinstance(key, jax.Array):
        check_key("key", key)
        root = key
    else:
        root = jax.random.key(whole_number("key", key, 0, LARGEST_SEED))
    result = _full_calibration(problem, result, plan, arguments)
    mask = jnp.asarray(result.mask, problem.mask.dtype)
    problem = replace(problem, mask=mask)

    # Each draw has as many images as were used, since the mask leaves out the other rows.
    def drawn(some: Int[Array, " k"]) -> Problem:
        return _with_rows(problem, _rows(root, mask, some), mask)

    fits = _in_batches(drawn, resamples, problem.images, arguments)
    return _scatter(problem, result, fits)


def _in_batches(
    make: Callable[[Array], Problem], count: int, images: int, arguments: dict[str, Any]
) -> Calibration:
    """Calibrations of many versions of a problem, without their data.

    Args:
        make: the versions with some numbers.
        count: how many there are.
        images: in each of them.
        arguments: as for :func:`jaxcal.calibrate`.
    """
    # Outliers were found with all images.
    arguments = {**arguments, "robust": False}
    size, parts = max(MOST_TOGETHER // images, 1), []
    for start in range(0, count, size):
        fits = calibrate_batch(make(jnp.arange(start, min(start + size, count))), **arguments)
        short = replace(fits.linearisation, average_elevation_sd=None)
        parts.append(replace(fits, problem=None, linearisation=short))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


@jax.jit
def _rows(
    root: Key[Array, ""], mask: Float[Array, " n"], resamples: Int[Array, " k"]
) -> Int[Array, "k n"]:
    """Used images drawn with replacement, for each of these resamples."""
    cumulative = jnp.cumsum(mask)

    def draw(index: Array) -> Array:
        uniform = jax.random.uniform(jax.random.fold_in(root, index), mask.shape, mask.dtype)
        # The first image at which the count of used images exceeds the draw is always a used one.
        chosen = jnp.searchsorted(cumulative, uniform * cumulative[-1], side="right")
        return jnp.minimum(chosen, mask.shape[0] - 1)

    return jax.vmap(draw)(resamples)


@jax.jit
def _scatter(problem: Problem, result: Calibration, fits: Calibration) -> Bootstrap:
    """How the calibrations of the resamples scatter about that of all images."""
    converged = jnp.asarray(fits.converged, problem.mask.dtype)
    whole = jnp.asarray(result.image_to_probe)
    drawn = jnp.asarray(fits.image_to_probe)
    moved = jax.vmap(relative_twist, (None, 0))(whole, drawn)
    moved = jnp.where(converged[:, None] > 0, jnp.abs(moved), jnp.nan)
    points = _box_points(problem, result)
    # A resample that did not converge gets the X of all images, and adds nothing to the scatter.
    found = _from_full_image(fits, result, problem)
    transforms = jnp.where(converged[:, None, None] > 0, found, whole)
    share = jnp.maximum(jnp.mean(converged), 1e-9)
    return Bootstrap(
        image_to_probe=drawn,
        converged=converged,
        spread=MAD * jnp.nanmedian(moved, axis=0),
        reproducibility=jnp.asarray(calibration_reproducibility(transforms, points)) / share,
        image_points=points,
    )


def relative_twist(first: Float[Array, "4 4"], second: Float[Array, "4 4"]) -> Float[Array, 6]:
    """[v, omega] that take the first transform to the second: first Exp([v, omega]), mm and rad.

    It is exact for v. For omega the error is of third order, since a calibration moves by fractions
    of a degree.
    """
    rotation = first[:3, :3].T @ second[:3, :3]
    shift = first[:3, :3].T @ (second[:3, 3] - first[:3, 3])
    turn = 0.5 * jnp.stack(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return jnp.concatenate([shift, turn])


def _from_full_image(
    fits: Calibration, result: Calibration, problem: Problem
) -> Float[Array, "k 4 4"]:
    """Transforms from the image of the full calibration, in that calibration's mm, to the probe.

    Another calibration has pixels of another size, another sound speed and another delay, and puts
    the same pixel at another place z' = a (z - o) + o' of its image, with o the range of row 0.
    """
    origin, speed = range_of_row_zero(replace(result, problem=problem))
    origins, speeds = range_of_row_zero(replace(fits, problem=problem))
    lateral, axial = jnp.ones_like(speeds), jnp.asarray(speeds / speed)
    if fits.scale_mm_per_px is not None and result.scale_mm_per_px is not None:
        ratio = jnp.asarray(fits.scale_mm_per_px) / jnp.asarray(result.scale_mm_per_px)
        lateral, axial = ratio[:, 0], axial * ratio[:, 1]
    x = jnp.asarray(fits.image_to_probe)
    stretch = jnp.stack([lateral, jnp.ones_like(axial), axial], axis=1)
    shift = (origins - axial * origin)[:, None] * x[:, :3, 2]
    return (x.at[:, :3, :3].multiply(stretch[:, None])).at[:, :3, 3].add(shift)


def _rms_distance(
    transforms: Float[Array, "k 4 4"], whole: Float[Array, "4 4"], points: Float[Array, "m 2"]
) -> Float[Array, " k"]:
    """Root mean square distance of image points under each transform from those under ``whole``."""
    zero, one = jnp.zeros_like(points[:, 0]), jnp.ones_like(points[:, 0])
    there = jnp.stack([points[:, 0], zero, points[:, 1], one])
    moved = ((transforms - whole) @ there)[:, :3]
    return jnp.sqrt(jnp.mean(jnp.sum(moved**2, axis=1), axis=1))


def _full_calibration(
    problem: Problem, result: Calibration | None, plan: SolvePlan, arguments: dict[str, Any]
) -> Calibration:
    """The calibration of all images: the caller's, checked, or a new one."""
    if result is None:
        return calibrate(problem, **arguments)
    check_made("result", result, Calibration, "jaxcal.calibrate")
    if np.shape(result.mask) != (problem.images,):
        raise InputError(
            f"result must be the calibration of these {problem.images} images; its mask has shape "
            f"{np.shape(result.mask)}"
        )
    for name, own in (
        ("method", plan.method),
        ("prior", plan.reported_prior),
        ("data", "channels" if plan.channels else "points"),
        ("blocks", plan.blocks),
    ):
        given = getattr(result, name)
        if given != own:
            raise InputError(
                f"result has {name} {shown(given)}, and the arguments ask for {shown(own)}: give "
                "those that the result was made with, or no result"
            )
    return result


def _one_problem(
    problem: Problem | Recording, arguments: dict[str, Any], name: str
) -> tuple[Problem, SolvePlan, dict[str, Any]]:
    """One problem with its bounds, how it is solved, and the arguments without the bounds.

    If its values are concrete, every pose counts once.
    """
    problem = as_problem(problem, name)
    if problem.batch_shape:
        raise InputError("resampling takes one problem at a time, not a batch")
    for argument in arguments.keys() - {field.name for field in fields(Request)}:
        raise TypeError(f"{name}() got an unexpected keyword argument {argument!r}")
    estimate = unknown_names(arguments.get("estimate", ()))
    problem, plan, _ = prepare(problem, Request(**{**arguments, "estimate": estimate}), name)
    arguments = {name: value for name, value in arguments.items() if name != "max_elevation"}
    if any(is_traced(leaf) for leaf in jax.tree.leaves(problem)):
        return problem, plan, arguments
    alone = independent(problem, estimate)[0]
    # If JAX's 64 bits are off, a problem holds numpy arrays, which a traced index cannot index.
    return jax.tree.map(jnp.asarray, alone), plan, arguments


def _check_remaining(mask: Array, rest: Array) -> None:
    """Refuse folds without which too few images remain; ``rest`` is 1 outside of each fold."""
    if is_traced(mask):
        return
    least = int(np.min(np.sum(np.asarray(mask) * np.asarray(rest) > 0, axis=1)))
    if least < MINIMUM_IMAGES:
        raise InputError(
            f"holding out a fold leaves {least} images: at least {MINIMUM_IMAGES} are needed"
        )


def _with_rows(problem: Problem, rows: Array, mask: Float[Array, " n"]) -> Problem:
    """The problem with other rows of images in each of k copies."""

    def drawn(rows: Int[Array, " n"]) -> Problem:
        found = each_image(problem, lambda values, axis: jnp.take(values, rows, axis))
        return replace(found, mask=mask)

    return jax.vmap(drawn)(rows)


def _parameters(result: Calibration) -> Parameters:
    """The unknowns of a calibration of one problem, as the model has them."""
    matrix, values = jnp.asarray(result.image_to_probe), result.linearisation.further
    found = Parameters.of(matrix[:3, :3], matrix[:3, 3], jnp.asarray(result.point))
    if values is None:
        return found
    further = split_further(jnp.asarray(values), result.blocks)
    return found.with_further({name: jnp.stack(parts) for name, parts in further.items()})


def _held_out_errors(held: Calibration, problem: Problem) -> tuple[Array, Array]:
    """Errors and reconstructed target of image i through calibration i: (n, 3), (n, 3), mm."""

    def one(result: Calibration, image: Array) -> tuple[Array, Array]:
        parameters, alone = _parameters(result), _alone(problem, image)
        point = measured_points(parameters, alone)[0]
        in_image = jnp.stack([point[0], jnp.zeros_like(point[0]), point[1]])
        in_probe = parameters.rotation @ in_image + parameters.translation
        pose = problem.poses[image]
        there = pose[:3, :3] @ in_probe + pose[:3, 3]
        return measurement_residual(parameters, alone)[0], there - parameters.point

    errors, cloud = jax.vmap(one)(held, jnp.arange(problem.images))
    return errors, problem.mask[:, None] * cloud


def _alone(problem: Problem, image: Int[Array, ""]) -> Problem:
    """The problem of one image."""
    return each_image(problem, lambda values, axis: jnp.take(values, image[None], axis))


def _log_density(
    fits: Calibration, problem: Problem, fold: Int[Array, " n"], errors: Float[Array, "n 3"]
) -> Float[Array, " n"]:
    """Of the errors of every image under the noise model of its fold's calibration."""
    noise = jax.vmap(lambda fit: noise_covariance(fit, problem))(fits)
    noise = noise[fold, jnp.arange(problem.images)]
    lateral, distance, offset = errors.T
    if fits.offset_law is not None:
        offset = offset - fits.offset_law.mean[fold]
    planes = jnp.stack([noise[:, 0, 0], noise[:, 1, 0], noise[:, 1, 1]])
    first, mixed, second = (plane[0] for plane in factor_of(planes[:, None]))
    third = jnp.sqrt(noise[:, 2, 2])
    one = lateral / first
    squares = one**2 + ((distance - mixed * one) / second) ** 2 + (offset / third) ** 2
    return -0.5 * squares - jnp.log(first * second * third) - 1.5 * jnp.log(2 * jnp.pi)


def _length_in_sds(
    moved: Float[Array, "n 6"], covariance: Float[Array, "6 6"]
) -> Float[Array, " n"]:
    """sqrt(m' C^-1 m / 6) of every move m of X with the covariance C."""
    scale = jnp.sqrt(jnp.diagonal(covariance))
    # In SDs of the unknowns the matrix is a correlation matrix, well scaled for elimination.
    unit = moved / scale
    solved = dense.solve_positive(covariance / (scale[:, None] * scale), unit.T)
    return jnp.sqrt(jnp.sum(unit.T * solved, axis=0) / 6)


def _box_points(problem: Problem, result: Calibration) -> Float[Array, "5 2"]:
    """Corners and middle of the box that the used points fill, [lateral, axial], mm."""
    points = measured_points(_parameters(result), problem)
    seen = problem.mask[:, None] > 0
    low = jnp.min(jnp.where(seen, points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(seen, points, -jnp.inf), axis=0)
    share = jnp.asarray([[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0.5]], low.dtype)
    return (1 - share) * low + share * high
